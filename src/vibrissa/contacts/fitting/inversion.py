"""All stable contacts that have three given signals.

The subdivision tree of the chart for the triplet supplies a seed for each contact; Newton's method
on T(ξ) = T_measured, with H (:mod:`vibrissa.rod.tree`) instead of F_x, makes it exact. Residuals
are relative: forces to |F|, moments to |M|, angles in rad. Where small errors of the signals would
move a contact far, the signals do not determine it.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import MOST_CANDIDATES
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    copy,
    inlined,
    kernel,
    share_out,
    shared,
    solve3,
    wrapped,
)
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    TOLERANCE,
    Balance,
    Fold,
    Group,
    PlaneVector,
    Rod,
    SearchTree,
    StableSet,
    balance_rows,
    balanced,
    chart_to_contact,
    group_room,
    integrate,
    lane_value,
    lanes_tangents,
    newton_group,
    search_tree,
    seed_room,
    seeds,
    set_all_lanes,
    stable,
    start_from,
)
from vibrissa.signals import (
    CIRCULAR,
    FD,
    FX,
    MB,
    MD,
    MX,
    SIGNALS,
    signal_derivatives,
    signal_equations,
    signals_of,
)

_SAME = 1e-7  # two solutions within this (relative to L and to the force) are the same
# Relative error of signals, about that of the integration, and how far (over L) it may move a
# contact that the signals determine.
_ERROR, _MOVED = 1e-7, 0.01
# Share of that up to which the slopes of an interpolant, in units of the chart, are trusted.
_CERTAIN = 0.01
# Number of targets above which they are sorted, so that the tree's nodes stay in the cache.
_MANY = 1000
_RANK_BITS = 5
# The signals of a :class:`~vibrissa.rod.Balance`.
_BALANCED = (FX, MB, MD, MX)


class Solutions(NamedTuple):
    """Contacts that explain measurements, non-dimensional, sorted by force.

    number (n,); contacts ξ (n, MOST_CANDIDATES, 3) and (F, p) (n, MOST_CANDIDATES, 6), NaN-padded.
    """

    number: IntArray
    contacts: Array
    values: Array


def triplet_tree(chart: StableSet, triplet: tuple[str, ...]) -> SearchTree:
    """Build the subdivision tree of three signals over a chart."""
    which = [SIGNALS.index(name) for name in triplet]
    force, point = chart.values[..., :3], chart.values[..., 3:]
    values = signals_of(force, np.cross(point, force))[..., which]
    derivatives = signal_derivatives(chart.values, chart.tangents)[..., which, :]
    angles = tuple(CIRCULAR[w] for w in which)
    plane = _plane(chart, triplet)
    vanishing = tuple(not turns for turns in angles)
    balance, values = _balance_of(chart, triplet), np.ascontiguousarray(values)
    return search_tree(chart, values, derivatives, angles, plane, vanishing, balance)


def _balance_of(chart: StableSet, triplet: tuple[str, ...]) -> Balance:
    """Balance of force and moment as far as it concerns three signals."""
    names = [SIGNALS[code] for code in _BALANCED]
    parts = [triplet.index(name) if name in triplet else -1 for name in names]
    return Balance.of(chart.discretization.rod, parts)


def _plane(chart: StableSet, triplet: tuple[str, ...]) -> PlaneVector | None:
    """Transverse force or bending moment, if its size or direction is in the triplet."""
    force, point = chart.values[..., :3], chart.values[..., 3:]
    d_force, d_point = chart.tangents[..., :3, :], chart.tangents[..., 3:, :]
    for size, direction in (("FT", "FD"), ("MB", "MD")):
        if size not in triplet and direction not in triplet:
            continue
        vector, slopes = force, d_force
        if size == "MB":
            vector = np.cross(point, force)
            slopes = np.cross(d_point, force[..., None], axis=-2)
            slopes = slopes + np.cross(point[..., None], d_force, axis=-2)
        length, turn = (triplet.index(n) if n in triplet else -1 for n in (size, direction))
        lever = None
        if triplet == ("FT", "FD", "Mx"):
            lever = point[..., 1:], d_point[..., 1:, :]
        return PlaneVector(vector[..., 1:], slopes[..., 1:, :], length, turn, lever)
    return None


def invert(
    chart: StableSet, tree: SearchTree, triplet: tuple[str, ...], targets: Array
) -> Solutions:
    """Find all stable contacts for each measured triplet."""
    if len(targets) > _MANY:
        order = _by_neighbourhood(targets)
        found = _inverted(chart, tree, triplet, targets[order])
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        return Solutions(found.number[place], found.contacts[place], found.values[place])
    return _inverted(chart, tree, triplet, targets)


def _by_neighbourhood(targets: Array) -> IntArray:
    """Indices that sort targets so that neighbours are adjacent (Z-order of ranks)."""
    code = np.zeros(len(targets), np.int64)
    shares = np.linspace(0.0, 1.0, 2**_RANK_BITS + 1)[1:-1]
    for c, column in enumerate(targets.T):
        sample = column[:: max(1, len(column) // 1000)]
        edges = np.sort(sample)[(shares * len(sample)).astype(int)]
        rank = np.searchsorted(edges, column)
        for bit in range(_RANK_BITS):
            code |= ((rank >> bit) & 1) << (3 * bit + c)
    return np.argsort(code, kind="stable")


def _inverted(
    chart: StableSet, tree: SearchTree, triplet: tuple[str, ...], targets: Array
) -> Solutions:
    n = len(targets)
    out = Solutions(
        np.zeros(n, np.int64),
        np.full((n, MOST_CANDIDATES, 3), np.nan),
        np.full((n, MOST_CANDIDATES, 6), np.nan),
    )
    targets = _with_choice(targets, triplet)
    rod, loose = chart.discretization.rod, np.zeros(n, dtype=bool)
    share_out(
        n,
        lambda first, last: invert_rows(
            rod, chart.fold, tree, chart.proximal, targets, *out, loose, first, last
        ),
    )
    return out


def polish(
    chart: StableSet, triplet: tuple[str, ...], targets: Array, contacts: Array
) -> tuple[Array, Array, Array, Array]:
    """Refine contacts, stable or not, by Newton's method on T(ξ) = target."""
    n = len(targets)
    xi = np.array(contacts, dtype=np.float64)
    values, misfits, signs = np.full((n, 6), np.nan), np.full(n, np.inf), np.full(n, np.nan)
    rod, fold, balance = chart.discretization.rod, chart.fold, _balance_of(chart, triplet)
    targets = _with_choice(targets, triplet)
    aims = np.ascontiguousarray(targets[:, :3])
    balance_rows(balance, aims, np.zeros((n, 3, 3)))
    targets[:, :3], targets[:, 6:] = aims, balance.weights
    share_out(
        n,
        lambda first, last: polish_rows(
            rod, fold, targets, xi, values, misfits, signs, first, last
        ),
    )
    return xi, values, misfits, signs


def _with_choice(targets: Array, triplet: tuple[str, ...]) -> Array:
    """Each target followed by the codes of its signals, as the equations expect it."""
    which = [float(SIGNALS.index(name)) for name in triplet]
    return np.concatenate([targets, np.tile([*which, *np.zeros(5)], (len(targets), 1))], axis=1)


@inlined
def _sizes(value: Array) -> tuple[float, float]:
    """Sizes of force and moment of (F, p)."""
    fx, fy, fz = value[0], value[1], value[2]
    px, py, pz = value[3], value[4], value[5]
    mx, my, mz = py * fz - pz * fy, pz * fx - px * fz, px * fy - py * fx
    return (
        float(np.sqrt(fx * fx + fy * fy + fz * fz)),
        float(np.sqrt(mx * mx + my * my + mz * mz)),
    )


@inlined
def _size_of(signal: int, sizes: tuple[float, float]) -> float:
    """Unit of a signal's residual, from the sizes of force and moment."""
    if signal in (FD, MD):
        return 1.0
    return sizes[0] if signal < MX else sizes[1]


@inlined
def _balance(which: IntArray, weights: Array, wanted: bool, values: Array, jacobian: Array) -> None:
    """Replace F_x by H in three signals and, if ``wanted``, in their derivatives."""
    parts, slopes = np.full(4, -1), np.empty(3)
    for k in range(3):
        for part in range(4):
            if which[k] == _BALANCED[part]:
                parts[part] = k
    balanced(Balance(parts, weights), values, values, slopes)
    if wanted:
        for k in range(3):
            for a in range(3):
                jacobian[parts[0], a] += slopes[k] * jacobian[k, a]


@inlined
def _match(
    value: Array, tangents: Array, wanted: bool, target: Array, residual: Array, jacobian: Array
) -> float:
    which = np.empty(3, np.int64)
    for k in range(3):
        which[k] = int(target[3 + k])
    signal_equations(0.0, value, tangents, wanted, which, residual, jacobian)
    if target[6] != 0.0 or target[10] != 0.0:
        _balance(which, target[6:], wanted, residual, jacobian)
    sizes, total = _sizes(value), 0.0
    for k in range(3):
        residual[k] -= target[k]
        w = which[k]
        if w in (FD, MD):
            residual[k] = wrapped(residual[k])
        total += (residual[k] / _size_of(w, sizes)) ** 2
    return float(np.sqrt(total))


@inlined
def _add(
    row: int, xi: Array, value: Array, count: IntArray, contacts: Array, values: Array
) -> None:
    """Insert a solution by rising force, unless it is already there."""
    force = np.hypot(xi[1], xi[2])
    n = count[row]
    place = n
    for k in range(n):
        other = contacts[row, k]
        away = max(abs(xi[0] - other[0]), np.hypot(xi[1] - other[1], xi[2] - other[2]) / force)
        if away < _SAME:
            return
        if place == n and np.hypot(other[1], other[2]) > force:
            place = k
    if place >= MOST_CANDIDATES:
        return
    for k in range(min(n, MOST_CANDIDATES - 1), place, -1):
        copy(contacts[row, k - 1], contacts[row, k])
        copy(values[row, k - 1], values[row, k])
    copy(xi, contacts[row, place])
    copy(value, values[row, place])
    count[row] = min(n + 1, MOST_CANDIDATES)


@inlined
def _certain(inverse: Array, value: Array, target: Array) -> bool:
    """Whether ∂chart/∂T of an interpolant shows that the signals determine a contact."""
    sizes, most = _sizes(value), 0.0
    for k in range(3):
        size = _size_of(int(target[3 + k]), sizes)
        for a in range(3):
            most = max(most, abs(inverse[a, k]) * size)
    return bool(inverse[0, 0] == inverse[0, 0] and _ERROR * most < _CERTAIN * _MOVED)


@kernel
def _moves_far(rod: Rod, b: Array, xi: Array, target: Array, step: Array) -> bool:
    """Whether errors of the integration move a contact by 1 % of the length along ``step``."""
    value, tangents, four = np.empty(6), np.empty((6, 3)), np.empty((6, 4))
    residual, jacobian, moves = np.empty(3), np.empty((3, 3)), np.empty(3)
    set_all_lanes(b, xi[0], 0.0, xi[1], xi[2])
    integrate(rod, b, 1)
    lane_value(b, 0, value)
    lanes_tangents(b, four)
    for a in range(6):
        tangents[a, 0], tangents[a, 1], tangents[a, 2] = four[a, 0], four[a, 2], four[a, 3]
    _match(value, tangents, True, target, residual, jacobian)
    sizes, farthest = _sizes(value), 0.0
    step[:] = 0.0
    for k in range(3):
        residual[:] = 0.0
        residual[k] = _ERROR * _size_of(int(target[3 + k]), sizes)
        if solve3(jacobian, residual, moves) == 0.0:
            return True
        for a in range(3, 6):
            moved = 0.0
            for c in range(3):
                moved += tangents[a, c] * moves[c]
            if not abs(moved) < np.inf:
                return True
            if abs(moved) > farthest:
                farthest = abs(moved)
                for c in range(3):
                    step[c] = _MOVED / farthest * moves[c]
    return farthest >= _MOVED


@kernel
def _determined(rod: Rod, b: Array, xi: Array, target: Array) -> bool:
    """Whether signals determine a contact in spite of the errors of the integration.

    Where two contacts merge they do: the derivatives are singular there only, not 1 % away.
    """
    step, further, nearby = np.empty(3), np.empty(3), np.empty(3)
    if not _moves_far(rod, b, xi, target, step):
        return True
    for sign in (-1.0, 1.0):
        for c in range(3):
            nearby[c] = xi[c] + sign * step[c]
        if not _moves_far(rod, b, nearby, target, further):
            return True
    return False


@shared
def invert_rows(
    rod: Rod,
    fold: Fold,
    tree: SearchTree,
    proximal: float,
    targets: Array,
    number: IntArray,
    contacts: Array,
    values: Array,
    loose: AnyArray,
    first: int,
    last: int,
) -> None:
    """Find all stable contacts that give three signals; ``loose`` (n,) marks undetermined ones."""
    b = np.zeros(BUFFER_SIZE)
    room = seed_room()
    found, slopes, quality = room.found, room.inverses, room.quality
    rows, group = np.empty(LANES, np.int64), group_room(np.empty((LANES, 11)))
    charts, inverses, group_targets = group.charts, group.inverses, group.targets
    waiting = 0
    for row in range(first, last + 1):
        n = 0
        if row < last:
            n = seeds(tree, targets[row], room)
        elif waiting > 0:
            n = 1  # the last ones, fewer than there are lanes
        for seed in range(n):
            if row < last:
                rows[waiting] = row
                copy(room.aim, group_targets[waiting, :3])
                copy(targets[row, 3:], group_targets[waiting, 3:6])
                copy(tree.balance.weights, group_targets[waiting, 6:])
                chart_to_contact(fold, found[seed], group.xi[waiting])
                start_from(
                    found[seed], slopes[seed], quality[seed], charts[waiting], inverses[waiting]
                )
                waiting += 1
            if waiting < LANES and row < last:
                continue
            newton_group(_match, rod, fold, b, waiting, group)
            for i in range(waiting):
                xi, misfit = group.xi[i], group.misfits[i]
                if not (misfit <= _ERROR and stable(fold, proximal, xi, group.signs[i])):
                    continue
                if not _certain(inverses[i], group.values[i], group_targets[i]):
                    loose[rows[i]] |= not _determined(rod, b, xi, group_targets[i])
                if misfit <= TOLERANCE:
                    _add(rows[i], xi, group.values[i], number, contacts, values)
            waiting = 0


@kernel
def polish_rows(
    rod: Rod,
    fold: Fold,
    targets: Array,
    xi: Array,
    values: Array,
    misfits: Array,
    signs: Array,
    first: int,
    last: int,
) -> None:
    """Refine contacts by Newton's method on T(ξ) = target for some rows, four at a time."""
    b = np.zeros(BUFFER_SIZE)
    charts, inverses = np.zeros((LANES, 3)), np.full((LANES, 3, 3), np.nan)
    for row in range(first, last, LANES):
        end = min(row + LANES, last)
        group = Group(
            targets[row:end],
            charts,
            inverses,
            xi[row:end],
            values[row:end],
            misfits[row:end],
            signs[row:end],
        )
        newton_group(_match, rod, fold, b, end - row, group)


@lru_cache(maxsize=64)
def seeding_triplet(chart: StableSet, names: tuple[str, ...]) -> tuple[str, ...]:
    """Choose the three signals with the smallest error ellipsoids, in the median over the chart."""
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
