"""Contacts from more signals than unknowns: all minima of χ² among the stable contacts.

A contact that explains k > 3 signals also explains any three of them, nearly. So the contacts that
give the best determined three exactly are where the search starts; from each of them, χ² of all
signals is minimised. What has no such start, or no minimum that explains the signals, starts again
from the nodes of the chart that come nearest, one for each of sixteen parts of it.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.channels import CHANNELS, CIRCULAR, Channels, channels_of
from vibrissa.contacts.fitting import Fits, charted, fit
from vibrissa.contacts.inversion import invert
from vibrissa.contacts.minima import Candidates, candidates
from vibrissa.contacts.noise import SensorNoise
from vibrissa.contacts.whitening import INDISTINCT, explained, rank, whitening
from vibrissa.numerics import Array, IntArray, kernel, share_out
from vibrissa.rod import LEAST_ARC, ROUNDING, StableSet, solve_forces, with_normal_force
from vibrissa.signals import SIGNALS, signal_derivatives, signals_of
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

#: At most so many candidates are kept.
MOST = 8
_UNKNOWNS = 3
PARTS = 16
# Of candidates that explain signals equally well the one with less force comes first.
_FORCE = 1e-6


@lru_cache(maxsize=64)
def seeding_triplet(chart: StableSet, names: tuple[str, ...]) -> tuple[str, ...]:
    """The three signals among these that determine contacts best, as seen over the chart.

    Judged by the median volume of the error ellipsoid, with forces and moments known to a share of
    their size.
    """
    values = chart.values[::2, ::4, 1::2].reshape(-1, 6)
    tangents = chart.tangents[::2, ::4, 1::2].reshape(-1, 6, 3)
    force, moment = values[:, :3], np.cross(values[:, 3:], values[:, :3])
    known = signals_of(force, moment)
    f, m = np.linalg.norm(force, axis=1), np.linalg.norm(moment, axis=1)
    with np.errstate(all="ignore"):
        sigma = np.stack([f, f, f / known[:, 1], m, m, m / known[:, 4]], axis=1)
        slopes = signal_derivatives(values, tangents) / sigma[:, :, None]
        size = np.linalg.norm(slopes, axis=1, keepdims=True)
        slopes = np.nan_to_num(slopes / size)

        def volume(triplet: tuple[str, ...]) -> float:
            which = [SIGNALS.index(name) for name in triplet]
            return float(np.median(np.abs(np.linalg.det(slopes[:, which]))))

        return max(combinations(names, 3), key=volume)


def least_squares(
    contact_map: ContactMap,
    names: tuple[str, ...],
    measured: Array,
    sensor: SensorNoise | None,
    starts: Array | None = None,
) -> tuple[Candidates, IntArray]:
    """Find the contacts that explain more than three signals best."""
    chart, channels = contact_map.chart, Channels.of(names)
    triplet = seeding_triplet(chart, names)
    three = measured[:, [names.index(name) for name in triplet]]
    exact = invert(chart, contact_map.tree(triplet), triplet, three)
    row, place = np.nonzero(np.arange(exact.contacts.shape[1]) < exact.number[:, None])
    seeds = exact.contacts[row, place]
    if starts is not None:
        more = np.flatnonzero(np.isfinite(starts).all(axis=1))
        row, seeds = np.concatenate([row, more]), np.concatenate([seeds, starts[more]])
    limit = largest_misfit(channels, sensor, contact_map)
    fits = nearby(chart, channels, sensor, measured[row], seeds, limit)
    inside = charted(chart, fits, chart.proximal)
    lost = np.ones(len(measured), np.bool_)
    lost[row[inside & (fits.misfits <= limit)]] = False
    again = np.flatnonzero(lost)
    if again.size:
        nodes = nearest_nodes(chart, channels, measured[again])
        there = nodes >= 0
        more = np.repeat(again, PARTS).reshape(-1, PARTS)[there]
        seeds = chart.contacts.reshape(-1, 3)[nodes[there]]
        others = nearby(chart, channels, sensor, measured[more], seeds, limit)
        row = np.concatenate([row, more])
        fits = Fits(*(np.concatenate(pair) for pair in zip(fits, others, strict=True)))
        inside = charted(chart, fits, chart.proximal)
    doubt = by_doubt(fits)
    kept = np.flatnonzero(inside)
    found = candidates(
        len(measured), row[kept], Fits(*(a[kept] for a in fits)), doubt[kept], limit, MOST
    )
    status = np.where(found.number > 1, int(Status.AMBIGUOUS), int(Status.UNIQUE))
    status[~(found.misfits[:, 0] <= limit)] = int(Status.NOT_FRICTIONLESS)
    # Perhaps a contact nearer to the base than the map goes explains them.
    nearer = charted(chart, fits, LEAST_ARC + ROUNDING) & ~inside & (fits.misfits <= limit)
    outside = np.zeros(len(measured), np.bool_)
    outside[row[nearer]] = True
    status[outside & (status == Status.NOT_FRICTIONLESS)] = int(Status.OUTSIDE_MAP)
    return found, status


def by_doubt(fits: Fits) -> Array:
    """What fits are sorted by: χ², and where that is the same the force."""
    force = np.hypot(fits.contacts[:, 2], fits.contacts[:, 3])
    return np.asarray(fits.misfits + _FORCE * (1.0 + fits.misfits) * force / (1.0 + force))


def largest_misfit(
    channels: Channels, sensor: SensorNoise | None, contact_map: ContactMap
) -> float:
    """Largest χ² of what counts as explained."""
    degrees = len(channels.names)
    if sensor is not None and sensor.wrench is not None:
        node = contact_map.chart.values[-1, :1, -1]
        d = contact_map.chart.discretization
        covariance = channels.covariance(sensor, np.ones((1, degrees)), node, d)
        degrees = rank(covariance[0])
    return explained(degrees - _UNKNOWNS)


def constant_weights(channels: Channels, sensor: SensorNoise | None) -> bool:
    """Whether the weights of channels are the same for all contacts."""
    if sensor is None or sensor.errors[..., :6].any():
        return False
    return sensor.deviations is not None or not set(channels.names) & {"FT", "FD", "MB", "MD"}


def _weights(
    chart: StableSet, channels: Channels, sensor: SensorNoise | None, measured: Array, values: Array
) -> Array:
    return whitening(channels.covariance(sensor, measured, values, chart.discretization))


def nearby(
    chart: StableSet,
    channels: Channels,
    sensor: SensorNoise | None,
    measured: Array,
    seeds: Array,
    limit: float,
    values: Array | None = None,
) -> Fits:
    """Find the minima of χ² next to seeds, with the weights that hold there."""
    d = chart.discretization
    contacts = with_normal_force(seeds)
    if values is None:
        values, _ = solve_forces(d, contacts)
    targets = channels.targets(measured)
    # Weights that depend on the contact are taken there once it is nearly known.
    settled = constant_weights(channels, sensor)
    for _ in range(1 if settled else 2):
        weights = _weights(chart, channels, sensor, measured, values)
        fits = fit(
            d,
            channels.names,
            targets,
            weights,
            contacts,
            friction=False,
            least=LEAST_ARC,
            worth=limit + INDISTINCT,
        )
        contacts, values = fits.contacts, np.where(np.isfinite(fits.values), fits.values, values)
    return fits


def nearest_nodes(chart: StableSet, channels: Channels, measured: Array) -> IntArray:
    """The chart's nodes that come nearest to measured signals, in each part of the chart."""
    known = at_nodes(chart, channels.names)
    targets = channels.targets(measured)
    which = [CHANNELS.index(name) for name in channels.names]
    # Forces are compared relative to the force, moments to the moment, and directions in rad.
    scale = np.ones_like(targets)
    for kind in ("F", "M"):
        same = [k for k, w in enumerate(which) if CHANNELS[w][0] == kind and not CIRCULAR[w]]
        size = np.linalg.norm(targets[:, same], axis=1, keepdims=True)
        scale[:, same] = 1.0 / np.where(size > 0.0, size, 1.0)
    out = np.full((len(targets), PARTS), -1)
    share_out(len(targets), lambda first, last: _nearest(*known, targets, scale, out, first, last))
    return out


@lru_cache(maxsize=64)
def at_nodes(chart: StableSet, names: tuple[str, ...]) -> tuple[Array, Array, IntArray]:
    """Channels (k, nodes) at the chart's nodes, 1/2π for those that are angles, and each's part."""
    which = [CHANNELS.index(name) for name in names]
    known = np.ascontiguousarray(channels_of(chart.values.reshape(-1, 6))[:, which].T)
    turns = np.array([0.5 / np.pi if CIRCULAR[w] else 0.0 for w in which])
    return known, turns, parts(chart)


def parts(chart: StableSet) -> IntArray:
    """To which of sixteen parts of the chart each of its nodes belongs, flat."""
    n, m, k = chart.values.shape[:3]
    i, j, _ = np.meshgrid(np.arange(n), np.arange(m), np.arange(k), indexing="ij")
    return np.asarray((4 * (4 * i // n) + (4 * j // m) % 4).reshape(-1))


@lru_cache(maxsize=16)
def volumes(chart: StableSet) -> Array:
    """Volumes of contact points that the chart's nodes stand for, flat."""
    size = np.abs(np.linalg.det(chart.tangents[..., 3:, :] @ chart.frames))
    for axis in range(3):  # nodes on its faces stand for half a cell
        ends = np.ones(size.shape[axis])
        ends[[0, -1]] = 0.5
        size = size * np.expand_dims(ends, [i for i in range(3) if i != axis])
    return np.asarray(np.maximum(size, np.finfo(float).tiny).reshape(-1))


@kernel
def _nearest(
    known: Array,
    turns: Array,
    part: IntArray,
    targets: Array,
    scale: Array,
    out: IntArray,
    first: int,
    last: int,
) -> None:
    nodes = known.shape[1]
    least, total = np.empty(out.shape[1]), np.empty(nodes)
    for row in range(first, last):
        least[:], total[:] = np.inf, 0.0
        for k in range(known.shape[0]):
            target, size, turn = targets[row, k], scale[row, k], turns[k]
            seen = known[k]
            for node in range(nodes):
                away = seen[node] - target
                away -= np.rint(away * turn) * 2.0 * np.pi
                total[node] += (away * size) ** 2
        for node in range(nodes):
            p = part[node]
            if total[node] < least[p]:
                least[p] = total[node]
                out[row, p] = node


@kernel
def nearest_of(
    known: Array,
    turns: Array,
    part: IntArray,
    kinds: IntArray,
    mixing: Array,
    target: Array,
    out: IntArray,
) -> None:
    """Fill the nodes of all parts of the chart that come nearest to one measurement."""
    q, k = known.shape[0], target.shape[0]
    wanted, scale = np.zeros((1, q)), np.ones((1, q))
    sizes = np.zeros(2)
    for i in range(q):
        for c in range(k):
            wanted[0, i] += mixing[i, c] * target[c]
        if kinds[i] < 2:
            sizes[kinds[i]] += wanted[0, i] ** 2
    for i in range(q):
        if kinds[i] < 2 and sizes[kinds[i]] > 0.0:
            scale[0, i] = 1.0 / np.sqrt(sizes[kinds[i]])
    _nearest(known, turns, part, wanted, scale, out, 0, 1)
