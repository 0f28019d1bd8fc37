"""Which contacts explain measured signals, how surely, and why none does."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vibrissa.mapping.channels import Channels
from vibrissa.mapping.inversion import Contacts, invert, polish
from vibrissa.mapping.least_squares import least_squares
from vibrissa.mapping.minima import reliable, unknowns_covariance
from vibrissa.mapping.noise import SensorNoise
from vibrissa.mapping.weights import whitening
from vibrissa.rod.arrays import AnyArray, Array, IntArray
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.newton import TOLERANCE
from vibrissa.rod.reach import LEAST_ARC, with_normal_force
from vibrissa.signals import CIRCULAR, SIGNALS, signal_scales
from vibrissa.signals.base import signal_derivatives, signals_of
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap

# Signals this many times larger than any on the map are in another unit.
_FAR_BEYOND = 10.0


class Explanation(NamedTuple):
    """Rows × candidates, non-dimensional, NaN-padded.

    Their number (n,), arc lengths (n, k), (F, p) (n, k, 6), covariances of p (n, k, 3, 3); of each
    row misfit, status and whether the covariance of the first can be relied on (n,).
    """

    number: IntArray
    arc_lengths: Array
    values: Array
    covariances: Array
    misfit: Array
    status: IntArray
    linear: AnyArray


def by_triplet(
    contacts: ContactMap, names: tuple[str, ...], targets: Array, sensor: SensorNoise | None
) -> Explanation:
    """Find the contacts that give three signals exactly.

    Parameters
    ----------
    contacts : ContactMap
        The map.
    names : tuple of str
        The signals.
    targets : (n, 3) array
        Their values, non-dimensional.
    sensor : SensorNoise or None
        Noise.

    Returns
    -------
    Explanation
        Row by row.
    """
    found = invert(contacts.chart, contacts.tree(names), names, targets)
    status = np.where(found.number == 1, int(Status.UNIQUE), int(Status.AMBIGUOUS))
    misfit = np.zeros(len(targets))
    _explain_none(contacts, names, targets, found.number, status, misfit)
    covariances = np.full((*found.contacts.shape[:2], 3, 3), np.nan)
    linear = np.zeros(len(targets), np.bool_)
    if sensor is not None:
        covariances = _triplet_covariances(contacts, names, found, sensor, linear)
    return Explanation(
        found.number, found.contacts[..., 0], found.values, covariances, misfit, status, linear
    )


def by_least_squares(
    contacts: ContactMap, names: tuple[str, ...], targets: Array, sensor: SensorNoise | None
) -> Explanation:
    """Find the contacts that explain more than three signals best.

    Parameters
    ----------
    contacts : ContactMap
        The map.
    names : tuple of str
        The k signals.
    targets : (n, k) array
        Their values, non-dimensional.
    sensor : SensorNoise or None
        Noise.

    Returns
    -------
    Explanation
        Row by row.
    """
    n = len(targets)
    status, misfit = np.full(n, int(Status.MISSING)), np.full(n, np.nan)
    known = np.isfinite(targets).all(axis=1)
    nothing, beyond = _without_contact(contacts, names, targets)
    status[nothing], status[beyond] = int(Status.DEGENERATE), int(Status.OUTSIDE_MAP)
    rows = np.flatnonzero(known & ~nothing & ~beyond)
    found, status[rows] = least_squares(contacts, names, targets[rows], sensor)
    misfit[rows] = found.misfits[:, 0]
    most = found.contacts.shape[1]
    number, arc_lengths = np.zeros(n, np.int64), np.full((n, most), np.nan)
    values, covariances = np.full((n, most, 6), np.nan), np.full((n, most, 3, 3), np.nan)
    linear = np.zeros(n, np.bool_)
    number[rows], arc_lengths[rows], values[rows] = (
        found.number,
        found.contacts[..., 0],
        found.values,
    )
    if sensor is None:
        return Explanation(number, arc_lengths, values, covariances, misfit, status, linear)
    channels = Channels.of(names)
    row, place = np.nonzero(np.arange(most) < found.number[:, None])
    d = contacts.chart.discretization
    here, slopes = found.values[row, place], found.tangents[row, place]
    local = whitening(channels.covariance(sensor, targets[rows][row], here, d))
    spread = unknowns_covariance(channels.names, here, slopes, local, friction=False)
    by_x = slopes[:, 3:]
    covariances[rows[row], place] = by_x @ spread @ np.swapaxes(by_x, -1, -2)
    first = place == 0
    linear[rows[row[first]]] = reliable(
        d,
        channels.names,
        local[first],
        found.contacts[row, place][first],
        here[first],
        slopes[first],
        spread[first],
        LEAST_ARC,
    )
    return Explanation(number, arc_lengths, values, covariances, misfit, status, linear)


def _without_contact(
    contacts: ContactMap, names: tuple[str, ...], targets: Array
) -> tuple[AnyArray, AnyArray]:
    """Whether signals come from a whisker that touches nothing, and whether from none at all."""
    sizes = [k for k, name in enumerate(names) if not CIRCULAR[SIGNALS.index(name)]]
    values = contacts.chart.values.reshape(-1, 6)
    known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
    largest = np.abs(known[:, [SIGNALS.index(names[k]) for k in sizes]]).max(axis=0)
    # M_x is next to nothing on a planar whisker, but noise in it is not beyond the map for that.
    of_kind = {"F": np.abs(values[:, :3]).max(), "M": np.abs(known[:, 3:5]).max()}
    largest = np.maximum(largest, [0.1 * of_kind[names[k][0]] for k in sizes])
    felt = np.abs(targets[:, sizes])
    nothing = (felt == 0.0).all(axis=1) & bool(sizes)
    return nothing, (felt > _FAR_BEYOND * largest).any(axis=1)


def _explain_none(
    contacts: ContactMap,
    names: tuple[str, ...],
    targets: Array,
    number: IntArray,
    status: IntArray,
    misfit: Array,
) -> None:
    """Say why measurements without a contact have none."""
    missing = ~np.isfinite(targets).all(axis=1)
    status[missing], misfit[missing] = int(Status.MISSING), np.nan
    rows = np.flatnonzero((number == 0) & ~missing)
    if not rows.size:
        return
    chart = contacts.chart
    which = [SIGNALS.index(name) for name in names]
    values = chart.values.reshape(-1, 6)
    known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))[:, which]
    size = np.where([CIRCULAR[w] for w in which], 1.0, np.ptp(known, axis=0))
    _, nearest = cKDTree(_on_circle(known, which, size)).query(
        _on_circle(targets[rows], which, size)
    )
    away = known[nearest] - targets[rows]
    turned = np.array([CIRCULAR[w] for w in which])
    away = np.where(turned, (away + np.pi) % (2.0 * np.pi) - np.pi, away)
    span = np.where(turned, 2.0 * np.pi, size)
    misfit[rows] = np.abs(away / span).max(axis=1)
    # Perhaps a contact nearer to the base than the map goes explains them.
    start = chart.contacts.reshape(-1, 3)[nearest]
    xi, _, residual, sign = polish(chart, names, targets[rows], start)
    nearer = (residual <= TOLERANCE) & (sign > 0.0) & (xi[:, 0] < chart.proximal)
    status[rows] = np.where(nearer, int(Status.OUTSIDE_MAP), int(Status.NOT_FRICTIONLESS))
    nothing, beyond = _without_contact(contacts, names, targets[rows])
    status[rows[beyond]], status[rows[nothing]] = int(Status.OUTSIDE_MAP), int(Status.DEGENERATE)


def _on_circle(values: Array, which: list[int], size: Array) -> Array:
    """Signals as places in a space where distance means difference: angles on the unit circle."""
    parts = []
    for k, w in enumerate(which):
        v = values[:, k]
        parts += [np.cos(v), np.sin(v)] if CIRCULAR[w] else [v / size[k]]
    return np.stack(parts, axis=1)


def _triplet_covariances(
    contacts: ContactMap,
    names: tuple[str, ...],
    found: Contacts,
    sensor: SensorNoise,
    linear: AnyArray,
) -> Array:
    """Covariances (n, k, 3, 3) of the candidates' contact points; fills ``linear`` (n,)."""
    d = contacts.chart.discretization
    out = np.full((*found.contacts.shape[:2], 3, 3), np.nan)
    row, place = np.nonzero(np.arange(out.shape[1]) < found.number[:, None])
    if not row.size:
        return out
    x = with_normal_force(found.contacts[row, place])
    values, tangents = solve_forces(d, x, tangents=True)
    which = [SIGNALS.index(name) for name in names]
    by_contact = signal_derivatives(values, tangents)[:, which]
    sigma = _signal_covariance(sensor, names, values, d.force, d.moment)
    with np.errstate(all="ignore"):
        determined = np.abs(np.linalg.det(by_contact)) > 0.0
        good = determined & np.isfinite(by_contact).all(axis=(1, 2))
        inverse = np.full_like(by_contact, np.nan)
        inverse[good] = np.linalg.inv(by_contact[good])
        spread = inverse @ sigma @ np.swapaxes(inverse, -1, -2)
        out[row, place] = tangents[:, 3:] @ spread @ np.swapaxes(tangents[:, 3:], -1, -2)
    first = np.flatnonzero(place == 0)
    linear[row[first]] = reliable(
        d,
        names,
        whitening(sigma[first]),
        x[first],
        values[first],
        np.insert(tangents[first], 1, 0.0, axis=2),
        np.insert(np.insert(spread[first], 1, 0.0, axis=1), 1, 0.0, axis=2),
        LEAST_ARC,
    )
    return out


def _signal_covariance(
    sensor: SensorNoise, names: tuple[str, ...], values: Array, force: float, moment: float
) -> Array:
    """Covariance of the chosen signals, non-dimensional, (n, k, k)."""
    scale = signal_scales(names, force, moment)
    f, m = values[:, :3] * force, np.cross(values[:, 3:], values[:, :3]) * moment
    return sensor.covariance(names, f, m) / np.outer(scale, scale)
