"""How finely signals must be measured: contacts that are ambiguous within a tolerance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.contact_map import Domain
from vibrissa.contacts.inversion import invert
from vibrissa.identifiability.regions import Places, place
from vibrissa.numerics import AnyArray, Array
from vibrissa.signals import SIGNALS

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

#: Shares of each signal's range within which signals count as equal.
TOLERANCES = (1e-6, 1e-4, 1e-3, 1e-2)
# The corners of the box of a tolerance and the middles of its faces.
_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
_MOVES = np.concatenate([_CORNERS, np.eye(3), -np.eye(3)])


def ambiguous(
    contact_map: ContactMap,
    names: tuple[str, ...],
    own: Places,
    twinned: AnyArray,
    span: Array,
    regions: tuple[str, ...],
    separation: float,
    cone: float,
    domain: Domain,
) -> AnyArray:
    """Whether contacts have another one, far away, with nearly the same signals.

    Signals are moved to the corners and to the middles of the faces of the box of each tolerance,
    and inverted there.
    """
    which = [SIGNALS.index(name) for name in names]
    belongs = np.stack([own.members(region) for region in regions])
    out = np.zeros((len(TOLERANCES), *twinned.shape), dtype=bool)
    active = np.flatnonzero((belongs & ~twinned).any(axis=0))
    # From the widest on: what is told apart within a tolerance is so within a narrower one.
    for t in reversed(range(len(TOLERANCES))):
        if not active.size:
            break
        targets = own.signals[active][:, None, which] + TOLERANCES[t] * span * _MOVES
        found = invert(contact_map.chart, contact_map.tree(names), names, targets.reshape(-1, 3))
        points = found.values[:, :, 3:].reshape(active.size, -1, 3)
        away = np.linalg.norm(points - own.values[active, None, 3:], axis=2)
        i, j = np.nonzero(away >= separation)
        other = place(
            contact_map,
            found.contacts.reshape(active.size, -1, 3)[i, j],
            found.values.reshape(active.size, -1, 6)[i, j],
            domain,
        )
        for k, region in enumerate(regions):
            hit = other.members(region) & (other.angle > cone)
            out[t, k, active[i[hit]]] = True
        out[t] &= belongs
        active = active[(out[t] & ~twinned)[:, active].any(axis=0)]
    return np.asarray(np.logical_or.accumulate(out | twinned, axis=0))
