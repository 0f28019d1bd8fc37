"""Which contacts explain measured signals, how surely, and why none does."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vibrissa.contacts.inversion import invert, polish
from vibrissa.contacts.least_squares import least_squares
from vibrissa.contacts.noise import SensorNoise
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod import TOLERANCE, with_normal_force
from vibrissa.signals import CIRCULAR, SIGNALS, circular_among, signals_of, within_turn
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

# Signals this many times larger than any on the map are in another unit.
_FAR_BEYOND = 10.0
# What is nearest to signals farther away is the same, and squares of distances are still numbers.
_FARTHEST = 1e100


class Bounds(NamedTuple):
    """How large forces and moments are that contacts of a map give."""

    sizes: list[int]
    largest: Array

    @classmethod
    def of(cls, contact_map: ContactMap, names: tuple[str, ...]) -> Bounds:
        """Find them for signals of a map."""
        sizes = [k for k, name in enumerate(names) if not CIRCULAR[SIGNALS.index(name)]]
        values = contact_map.chart.values.reshape(-1, 6)
        known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
        largest = np.abs(known[:, [SIGNALS.index(names[k]) for k in sizes]]).max(axis=0)
        # M_x is next to nothing on a planar whisker, but for that noise in it is not out of bounds.
        of_kind = {"F": np.abs(values[:, :3]).max(), "M": np.abs(known[:, 3:5]).max()}
        return cls(sizes, np.maximum(largest, [0.1 * of_kind[names[k][0]] for k in sizes]))

    def nothing(self, targets: Array) -> AnyArray:
        """Whether signals (n, k) come from a whisker that touches nothing, shape (n,)."""
        return np.asarray((targets[:, self.sizes] == 0.0).all(axis=1) & bool(self.sizes))

    def exceeded(self, targets: Array) -> AnyArray:
        """Whether signals (n, k) are far larger than any on the map, shape (n,)."""
        return np.asarray((np.abs(targets[:, self.sizes]) > _FAR_BEYOND * self.largest).any(axis=1))

    def most(self) -> list[tuple[int, float]]:
        """For each of these signals, what it can be at most."""
        return list(zip(self.sizes, (_FAR_BEYOND * self.largest).tolist(), strict=True))


class Explanation(NamedTuple):
    """Rows × candidates, non-dimensional, NaN-padded.

    Their number (n,), arc length and force in the material frame (n, k, 4), (F, p) (n, k, 6),
    covariances of p (n, k, 3, 3); of each row misfit, status and whether the covariance of the
    first can be relied on (n,); posterior probabilities (n, k).
    """

    number: IntArray
    contacts: Array
    values: Array
    covariances: Array
    misfit: Array
    status: IntArray
    linear: AnyArray
    probability: Array

    @classmethod
    def without_noise(
        cls, number: IntArray, contacts: Array, values: Array, misfit: Array, status: IntArray
    ) -> Explanation:
        """Leave out what only noise tells."""
        n, k = contacts.shape[:2]
        return cls(
            number,
            contacts,
            values,
            np.full((n, k, 3, 3), np.nan),
            misfit,
            status,
            np.zeros(n, np.bool_),
            np.full((n, k), np.nan),
        )


def by_triplet(contact_map: ContactMap, names: tuple[str, ...], targets: Array) -> Explanation:
    """Find the contacts that give three signals exactly."""
    found = invert(contact_map.chart, contact_map.tree(names), names, targets)
    status = np.where(found.number == 1, int(Status.UNIQUE), int(Status.AMBIGUOUS))
    misfit = np.zeros(len(targets))
    missing = ~np.isfinite(targets).all(axis=1)
    status[missing], misfit[missing] = int(Status.MISSING), np.nan
    rows = np.flatnonzero((found.number == 0) & ~missing)
    if rows.size:
        status[rows], misfit[rows] = why_none(contact_map, names, targets[rows])
    xi = with_normal_force(found.contacts.reshape(-1, 3)).reshape(*found.contacts.shape[:2], 4)
    return Explanation.without_noise(found.number, xi, found.values, misfit, status)


def by_least_squares(
    contact_map: ContactMap, names: tuple[str, ...], targets: Array, sensor: SensorNoise | None
) -> Explanation:
    """Find the contacts that explain more than three signals best."""
    n = len(targets)
    status, misfit = np.full(n, int(Status.MISSING)), np.full(n, np.nan)
    known = np.isfinite(targets).all(axis=1)
    bounds = Bounds.of(contact_map, names)
    nothing, beyond = bounds.nothing(targets) & known, bounds.exceeded(targets) & known
    status[nothing], status[beyond] = int(Status.DEGENERATE), int(Status.OUTSIDE_MAP)
    rows = np.flatnonzero(known & ~nothing & ~beyond)
    found, status[rows] = least_squares(contact_map, names, targets[rows], sensor)
    misfit[rows] = found.misfits[:, 0]
    most = found.contacts.shape[1]
    number, xi = np.zeros(n, np.int64), np.full((n, most, 3), np.nan)
    values = np.full((n, most, 6), np.nan)
    number[rows], xi[rows], values[rows] = (
        found.number,
        found.contacts[..., [0, 2, 3]],
        found.values,
    )
    whole = with_normal_force(xi.reshape(-1, 3)).reshape(n, most, 4)
    return Explanation.without_noise(number, whole, values, misfit, status)


def undetermined(targets: Array) -> Explanation:
    """Explain signals that do not determine contacts: by none."""
    n = len(targets)
    known = np.isfinite(targets).all(axis=1)
    return Explanation.without_noise(
        number=np.zeros(n, np.int64),
        contacts=np.full((n, 1, 4), np.nan),
        values=np.full((n, 1, 6), np.nan),
        misfit=np.full(n, np.nan),
        status=np.where(known, int(Status.DEGENERATE), int(Status.MISSING)),
    )


def why_none(
    contact_map: ContactMap, names: tuple[str, ...], targets: Array
) -> tuple[IntArray, Array]:
    """Say why three signals have no contact."""
    chart, turned = contact_map.chart, circular_among(names)
    known, size, tree, bounds = seen(contact_map, names)
    _, nearest = tree.query(_on_circle(targets, turned, size))
    away = within_turn(known[nearest] - targets, turned)
    span = np.where(turned, 2.0 * np.pi, size)
    misfit = np.abs(away / span).max(axis=1)
    # Perhaps a contact nearer to the base than the map goes explains them.
    start = chart.contacts.reshape(-1, 3)[nearest]
    xi, _, residual, sign = polish(chart, names, targets, start)
    nearer = (residual <= TOLERANCE) & (sign > 0.0) & (xi[:, 0] < chart.proximal)
    nearer |= bounds.exceeded(targets)
    status = np.where(nearer, int(Status.OUTSIDE_MAP), int(Status.NOT_FRICTIONLESS))
    status[bounds.nothing(targets)] = int(Status.DEGENERATE)
    return status, misfit


@lru_cache(maxsize=16)
def seen(contact_map: ContactMap, names: tuple[str, ...]) -> tuple[Array, Array, cKDTree, Bounds]:
    """Signals (n, k) at the chart's nodes, their ranges, the same as a tree, and their bounds."""
    values = contact_map.chart.values.reshape(-1, 6)
    which = [SIGNALS.index(name) for name in names]
    known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))[:, which]
    turned = circular_among(names)
    size = np.where(turned, 1.0, np.ptp(known, axis=0))
    tree = cKDTree(_on_circle(known, turned, size))
    return known, size, tree, Bounds.of(contact_map, names)


def _on_circle(values: Array, turned: AnyArray, size: Array) -> Array:
    """Signals as places in a space where distance means difference: angles on the unit circle."""
    parts = []
    for k, turns in enumerate(turned.tolist()):
        v = values[:, k]
        parts += [np.cos(v), np.sin(v)] if turns else [np.clip(v / size[k], -_FARTHEST, _FARTHEST)]
    return np.stack(parts, axis=1)


def check_signals(values: Array, names: tuple[str, ...]) -> None:
    """Refuse what no sensor in SI units can say."""
    for k, name in enumerate(names):
        if name in ("FT", "MB") and (values[..., k] < 0.0).any():
            raise ValueError(
                f"{name} is a size and cannot be negative; got {np.nanmin(values[..., k])}"
            )
        if CIRCULAR[SIGNALS.index(name)] and (np.abs(values[..., k]) > 2.0 * np.pi).any():
            largest = np.nanmax(np.abs(values[..., k]))
            raise ValueError(
                f"{name} is an angle in rad; got {largest:g}, which looks like degrees"
            )
