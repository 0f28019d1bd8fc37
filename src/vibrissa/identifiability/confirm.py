"""Pairs of contacts found again on a finer rod: what is left of a witness when the steps shrink.

Where the integration errs by more than the signals differ, two contacts can agree on the rod as it
is cut and not in truth. A pair counts only if it stays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.identifiability.fibres import corrected, units
from vibrissa.identifiability.twins import AGREEMENT, Pairs
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import discretize, solve_forces, with_normal_force
from vibrissa.signals import SIGNALS, cone_angle, signals_of

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

#: Pairs are found again with so many times the integration steps.
FINER = 4
# A pair stays if its second contact moves by less than this share of the distance between them.
_STEADY = 0.2


def found_again(
    contact_map: ContactMap, names: tuple[str, ...], first: Array, second: Array, steps: int
) -> tuple[Array, Array]:
    """Solve for the second contact of each pair on a finer rod, with the first as it is."""
    which = [SIGNALS.index(name) for name in names]
    coarse = discretize(contact_map.whisker, steps)
    finer = discretize(contact_map.whisker, FINER * steps)
    at_first, _ = solve_forces(finer, with_normal_force(first))
    before, _ = solve_forces(coarse, with_normal_force(second))
    force, point = at_first[:, :3], at_first[:, 3:]
    target = signals_of(force, np.cross(point, force))[:, which]
    _, values, misfit = corrected(finer, names, second, target, units(contact_map, second))
    points = np.stack([point, values[:, 3:]], axis=1)
    points[~(misfit <= AGREEMENT)] = np.nan
    return points, np.linalg.norm(points[:, 1] - before[:, 3:], axis=1)


def confirmed(
    contact_map: ContactMap,
    names: tuple[str, ...],
    pairs: Pairs,
    steps: int,
    separation: float,
) -> tuple[AnyArray, Array]:
    """Whether pairs stay on a finer rod."""
    points, moved = found_again(
        contact_map, names, pairs.first.contacts, pairs.second.contacts, steps
    )
    apart = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    stays = (apart >= separation) & (moved <= _STEADY * apart)
    length = contact_map.chart.discretization.length
    angle = cone_angle(contact_map.whisker, points * length).min(axis=1)
    return np.asarray(stays), angle
