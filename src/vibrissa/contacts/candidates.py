"""All contacts that explain measurements, and what noise leaves open about each; compiled.

Three signals have as many unknowns: every contact with T(ξ) = T is found from the search tree. More
signals are explained by least squares from where the tree has three quantities. Where no such
contact explains the measurement, the search starts again from the nodes of the chart that come
nearest, one for each of sixteen parts of it.

With noise that is not all. A contact near which T(Ω) ends or folds may be the true one although
noise has carried the signals out of its reach, and another, far away, explains them exactly. Such
contacts explain signals a little apart: the tree is asked for those two standard deviations to
either side, and χ² is minimised within Ω from what it finds and did not know. Then all candidates
are judged (:mod:`~vibrissa.contacts.posterior`); where the second order does not describe one of
them, they are compared by their likelihoods alone.

One measurement at a time, and many, go through the same rows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import MOST_CANDIDATES, Candidates
from vibrissa.contacts.inversion import PARTS, invert_rows, nearest_of
from vibrissa.contacts.least_squares import channel_equations, fit_rows, fit_within, whiten
from vibrissa.contacts.noise import INDISTINCT
from vibrissa.contacts.posterior import (
    CERTAIN,
    NORMAL_KURTOSIS,
    cholesky3,
    judge,
    rank,
    second_moment,
)
from vibrissa.contacts.weighing import Weighing, channel_covariance, weigh, weigh_any
from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, kernel, wrapped
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    LEAST_ARC,
    MOST_SEEDS,
    ROUNDING,
    Fold,
    Rod,
    SearchTree,
    along,
    chart_to_contact,
    evaluate,
    fold_force,
    integrate,
    lane_value,
    point_determinant,
    seeds,
    set_lane,
    stable,
)
from vibrissa.status import Status

_UNIQUE, _AMBIGUOUS = int(Status.UNIQUE), int(Status.AMBIGUOUS)
_OUTSIDE, _FRICTION = int(Status.OUTSIDE_MAP), int(Status.NOT_FRICTIONLESS)
#: Status of rows of three signals that no contact explains, whose reason is still to be found.
UNEXPLAINED = -1
_MOST_ROWS = MOST_SEEDS + PARTS
_TIMES = 8
# At the foot of a valley fits are slow, and most go the same way: one that is this near in χ² to a
# better one is given up if on the way there χ² does not rise by more than this.
_CLOSE, _SILL = 0.3, 0.01
# Contacts within this (over L, and ten times that relative to the force) are one.
_SAME = 1e-3
# Of candidates that explain signals equally well the one with less force comes first.
_FORCE = 1e-6
# How far apart signals are that the tree is asked for as well, in standard deviations.
_APART = 2.0
# What the tree finds there counts as known if it is this near to what is (of the chart's size, and
# of the way that the chart's slopes lead).
_NEAR, _ON_THE_WAY = 0.04, 0.5
# At most so many starts for one measurement.
_MOST_STARTS = 6
# So many of the chart's nodes must count for their moments to replace those about one contact.
_MANY = 30.0
# Squared Mahalanobis distance of three standard deviations of a point in space (99.73 %).
_OUTSIDE_REGION = 14.16
# Logarithm of the volume of a normal distribution of three coordinates, over its peak.
_LOG_NORMAL = 1.5 * math.log(2.0 * math.pi)
_MOST_LOG = 700.0
# Nodes whose χ², or the logarithm of whose density, is so much worse than the best do not count.
_NEGLIGIBLE = 50.0

# Row by row: x (n, 4), (F, p) (n, 6), ∂(F, p)/∂x (n, 6, 4), χ² (n,), and where a fit ended (n,):
# 2 on the map, 1 nearer to the base, 0 nowhere.
State = tuple[Array, Array, Array, Array, IntArray]


class Searched(NamedTuple):
    """What is searched, non-dimensional."""

    rod: Rod
    fold: Fold
    proximal: float
    tree: SearchTree
    where: IntArray
    codes: Array
    contacts: Array
    values: Array
    seen: Array
    turns: Array
    kinds: IntArray
    part: IntArray
    log_volume: Array


class Problem(NamedTuple):
    """How contacts are looked for.

    Whether three signals are solved exactly, whether noise is known, how often weights are taken
    at the contact, and the largest χ² that counts as explained.
    """

    exact: bool
    noisy: bool
    passes: int
    limit: float


@kernel
def explain_rows(
    of: Searched,
    how: Weighing,
    problem: Problem,
    targets: Array,
    measured: Array,
    out: Candidates,
    status: IntArray,
    again: bool,
    first: int,
    last: int,
) -> None:
    """Find the candidates of measurements by least squares; NaN rows are left alone.

    With noise they are completed and ranked before their status is known; ``again`` then states
    why the rows that are UNEXPLAINED have no contact.
    """
    x, values, chi = (
        np.empty(out.x.shape[1:]),
        np.empty(out.values.shape[1:]),
        np.empty(out.chi_squared.shape[1:]),
    )
    state = (
        np.zeros((_MOST_ROWS, 4)),
        np.zeros((_MOST_ROWS, 6)),
        np.zeros((_MOST_ROWS, 6, 4)),
        np.full(_MOST_ROWS, np.inf),
        np.zeros(_MOST_ROWS, np.int64),
    )
    for row in range(first, last):
        target, seen = targets[row], measured[row]
        if not _known(target) or (again and status[row] != UNEXPLAINED):
            continue
        if not again:
            x, values, chi = out.x[row], out.values[row], out.chi_squared[row]
        most, starts = _best(of, how, problem, target, seen, state, x, values, chi)
        if again:  # perhaps a contact nearer to the base than the map goes explains it
            starts = _everywhere(of, how, problem, target, seen, state, starts)
        else:
            out.number[row] = most
            if problem.noisy:
                continue
            if most > 0 and chi[0] <= problem.limit:
                status[row] = _UNIQUE if most == 1 else _AMBIGUOUS
                continue
        status[row] = _FRICTION
        for i in range(starts):
            if state[4][i] == 1 and state[3][i] <= problem.limit:
                status[row] = _OUTSIDE


@kernel
def settle_rows(
    of: Searched,
    how: Weighing,
    problem: Problem,
    targets: Array,
    measured: Array,
    out: Candidates,
    status: IntArray,
    first: int,
    last: int,
) -> None:
    """Complete the candidates of noisy measurements, judge and rank them."""
    room = _judging(MOST_CANDIDATES, targets.shape[1])
    for row in range(first, last):
        if not _known(targets[row]):
            continue
        settle(of, how, problem, targets[row], measured[row], row, out, room)
        status[row] = UNEXPLAINED
        if out.number[row] > 0 and out.chi_squared[row, 0] <= problem.limit:
            status[row] = _UNIQUE if out.probability[row, 0] > CERTAIN else _AMBIGUOUS


def estimate_rows(
    of: Searched,
    how: Weighing,
    problem: Problem,
    targets: Array,
    measured: Array,
    out: Candidates,
    status: IntArray,
    first: int,
    last: int,
) -> None:
    """Find, complete, judge and rank the candidates of measurements; NaN rows are left alone.

    Each stage is compiled by itself, so that whoever needs one does not wait for the others.
    """
    if problem.exact:
        _solve_rows(of, targets, measured, out, status, first, last)
    else:
        explain_rows(of, how, problem, targets, measured, out, status, False, first, last)
    if problem.noisy:
        settle_rows(of, how, problem, targets, measured, out, status, first, last)
        if not problem.exact and (status[first:last] == UNEXPLAINED).any():
            explain_rows(of, how, problem, targets, measured, out, status, True, first, last)


def _solve_rows(
    of: Searched,
    targets: Array,
    measured: Array,
    out: Candidates,
    status: IntArray,
    first: int,
    last: int,
) -> None:
    """Find the contacts that give three signals exactly."""
    n = last - first
    aims, xi = np.empty((n, 6)), np.empty((n, MOST_CANDIDATES, 3))
    number, values = out.number[first:last], out.values[first:last]
    _aim_rows(of.where, of.codes, targets[first:last], measured[first:last], aims)
    invert_rows(of.rod, of.fold, of.tree, of.proximal, aims, number, xi, values, 0, n)
    _keep_rows(number, xi, aims, out.x[first:last], out.chi_squared[first:last], status[first:last])


@kernel
def _aim_rows(where: IntArray, codes: Array, targets: Array, measured: Array, aims: Array) -> None:
    """Write the three measured signals and the codes of the cells that may hold them."""
    for i in range(len(targets)):
        known = _known(targets[i])
        for k in range(3):
            aims[i, k] = measured[i, where[k]] if known else np.nan
            aims[i, 3 + k] = codes[k]


@kernel
def _keep_rows(
    number: IntArray, xi: Array, aims: Array, x: Array, chi: Array, status: IntArray
) -> None:
    """Write solutions as candidates that explain the signals exactly."""
    for i in range(len(number)):
        if aims[i, 0] != aims[i, 0]:
            continue
        for c in range(number[i]):
            x[i, c, 0], x[i, c, 1] = xi[i, c, 0], 0.0
            x[i, c, 2], x[i, c, 3] = xi[i, c, 1], xi[i, c, 2]
            chi[i, c] = 0.0
        status[i] = UNEXPLAINED
        if number[i] > 0:
            status[i] = _UNIQUE if number[i] == 1 else _AMBIGUOUS


@inlined
def _known(target: Array) -> bool:
    total = 0.0
    for k in range(target.shape[0]):
        total += target[k]
    return bool(abs(total) < np.inf)


@kernel
def _best(
    of: Searched,
    how: Weighing,
    problem: Problem,
    target: Array,
    measured: Array,
    state: State,
    contacts: Array,
    solved: Array,
    chi: Array,
) -> tuple[int, int]:
    """Fill the contacts that explain a measurement best; how many, and how many fits there are."""
    x, values, tangents, misfits, inside = state
    limit = problem.limit
    x[:], tangents[:], misfits[:], inside[:] = 0.0, 0.0, np.inf, 0
    n = _seeded(of, measured, x, values)
    _fitted(of, how, problem, target, measured, state, 0, n)
    kept, good = np.empty(MOST_CANDIDATES, np.int64), _explained(misfits, inside, limit, n)
    if not (good or problem.noisy):
        n = _everywhere(of, how, problem, target, measured, state, n)
        good = _explained(misfits, inside, limit, n)
    number = _chosen(x, misfits, inside, limit, n, kept) if good else 0
    if not (good or problem.noisy):
        number = _nearest_fit(misfits, inside, n, kept)
    for i in range(number):
        copy(x[kept[i]], contacts[i])
        copy(values[kept[i]], solved[i])
        chi[i] = misfits[kept[i]]
    return number, n


@inlined
def _nearest_fit(misfits: Array, inside: IntArray, n: int, kept: IntArray) -> int:
    """Fill which fit on the map comes nearest; 1, or 0 if there is none."""
    number, best = 0, np.inf
    for row in range(n):
        if inside[row] == 2 and misfits[row] < best:
            kept[0], number, best = row, 1, misfits[row]
    return number


@kernel
def _seeded(of: Searched, measured: Array, x: Array, values: Array) -> int:
    """Fill contacts that about give three quantities; how many."""
    found, quality = np.empty((MOST_SEEDS, 3)), np.empty(MOST_SEEDS, np.int64)
    slopes, xi, three = np.empty((MOST_SEEDS, 3, 3)), np.empty(3), np.empty(3)
    for k in range(3):
        three[k] = measured[of.where[k]]
    n = int(seeds(of.tree, three, found, slopes, quality))
    for row in range(n):
        chart_to_contact(of.fold, found[row], xi)
        x[row, 0], x[row, 2], x[row, 3] = xi[0], xi[1], xi[2]
    evaluate(of.rod, x, values, np.empty((0, 6, 3)), 0, n)
    return n


@kernel
def _fitted(
    of: Searched,
    how: Weighing,
    problem: Problem,
    target: Array,
    measured: Array,
    state: State,
    first: int,
    last: int,
) -> None:
    """Fit from some rows; fill whether a fit is on the map (2), or nearer to the base (1)."""
    x, values, tangents, misfits, inside = state
    k, n = how.codes.shape[0], x.shape[0]
    targets, weights = np.empty((n, k)), np.empty((n, k, k))
    converged, rod, codes = np.zeros(n, np.bool_), of.rod, how.codes
    worth = problem.limit + INDISTINCT
    for _ in range(problem.passes):
        for row in range(first, last):
            copy(target, targets[row])
            if not weigh(how, values[row], measured, weights[row]):
                return
        fit_rows(
            rod,
            False,
            LEAST_ARC,
            codes,
            targets,
            weights,
            x,
            values,
            tangents,
            misfits,
            converged,
            first,
            last,
        )
        order = first + np.argsort(misfits[first:last])
        for i in range(last - first):
            row = order[i]
            for _again in range(_TIMES):
                if converged[row] or not misfits[row] <= worth:
                    break
                if _downhill(rod, codes, target, weights[row], x, misfits, inside, order[:i], row):
                    misfits[row] = np.inf
                    break
                fit_rows(
                    rod,
                    False,
                    LEAST_ARC,
                    codes,
                    targets,
                    weights,
                    x,
                    values,
                    tangents,
                    misfits,
                    converged,
                    row,
                    row + 1,
                )
            inside[row] = _where(of, x[row], tangents[row], misfits[row])


@inlined
def _where(of: Searched, x: Array, tangents: Array, misfit: float) -> int:
    """Whether a fit is on the map, 2, nearer to the base, 1, or neither, 0."""
    xi, by_xi = np.empty(3), np.empty((6, 3))
    xi[0], xi[1], xi[2] = x[0], x[2], x[3]
    for a in range(6):
        t = tangents[a]
        by_xi[a, 0], by_xi[a, 1], by_xi[a, 2] = t[0], t[2], t[3]
    sign = point_determinant(by_xi)
    if not misfit < np.inf:
        return 0
    if stable(of.fold, of.proximal, xi, sign):
        return 2
    return 1 if stable(of.fold, LEAST_ARC + ROUNDING, xi, sign) else 0


@kernel
def _downhill(
    rod: Rod,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    misfits: Array,
    inside: IntArray,
    others: IntArray,
    row: int,
) -> bool:
    """Whether from a contact the way to one on the map that fits a little better goes down.

    It goes where s and s f, about the moment, change evenly: valleys of χ² lie along those.
    """
    b, k = np.zeros(BUFFER_SIZE), codes.shape[0]
    value, at, t = np.empty(6), np.zeros(4), np.zeros((6, 4))
    residual, jacobian, mine = np.empty(k), np.empty((k, 4)), x[row]
    for other in others:
        near = misfits[other] <= misfits[row] <= misfits[other] + _CLOSE
        if not (near and inside[other] == 2):
            continue
        there = x[other]
        for i in range(LANES):
            share = (i + 1.0) / (LANES + 1.0)
            s = (1.0 - share) * mine[0] + share * there[0]
            near, far = (1.0 - share) * mine[0] / s, share * there[0] / s
            set_lane(
                b,
                i,
                s,
                0.0,
                near * mine[2] + far * there[2],
                near * mine[3] + far * there[3],
                False,
            )
        integrate(rod, b, 0)
        down, before = True, misfits[row]
        for i in range(LANES):
            lane_value(b, i, value)
            channel_equations(at, value, t, codes, target, residual, jacobian)
            misfit = 0.0
            for a in range(k):
                r = 0.0
                for c in range(k):
                    r += weights[a, c] * residual[c]
                misfit += r * r
            down = down and misfit <= before + _SILL
            before = misfit
        if down:
            return True
    return False


@inlined
def _explained(misfits: Array, inside: IntArray, limit: float, n: int) -> bool:
    found = False
    for row in range(n):
        found = found or (inside[row] == 2 and misfits[row] <= limit)
    return found


@kernel
def _everywhere(
    of: Searched,
    how: Weighing,
    problem: Problem,
    target: Array,
    measured: Array,
    state: State,
    n: int,
) -> int:
    """Fit from the nodes of all parts of the map that come nearest; how many rows there are."""
    x, values = state[0], state[1]
    nearest = np.full((1, PARTS), -1)
    nearest_of(of.seen, of.turns, of.part, of.kinds, how.mixing, target, nearest)
    rows = n
    for part in range(PARTS):
        node = nearest[0, part]
        if node < 0:
            continue
        c = of.contacts[node]
        x[rows, 0], x[rows, 1], x[rows, 2], x[rows, 3] = c[0], 0.0, c[1], c[2]
        copy(of.values[node], values[rows])
        rows += 1
    _fitted(of, how, problem, target, measured, state, n, rows)
    return rows


@inlined
def _chosen(
    x: Array, misfits: Array, inside: IntArray, limit: float, n: int, kept: IntArray
) -> int:
    """Fill which fits explain the measurement and are indistinguishable, the best first."""
    doubt, least = np.full(n, np.inf), np.inf
    for row in range(n):
        if inside[row] == 2:
            force = np.hypot(x[row, 2], x[row, 3])
            doubt[row] = misfits[row] + _FORCE * (1.0 + misfits[row]) * force / (1.0 + force)
            least = min(least, misfits[row])
    most, number = min(least + INDISTINCT, limit), 0
    for _ in range(n):
        row = int(np.argmin(doubt))
        if not doubt[row] < np.inf or number == MOST_CANDIDATES:
            break
        doubt[row] = np.inf
        if misfits[row] > most:
            continue
        new = True
        for i in range(number):
            other = x[kept[i]]
            size = 10.0 * _SAME * np.hypot(x[row, 2], x[row, 3])
            apart = np.hypot(other[2] - x[row, 2], other[3] - x[row, 3])
            new = new and not (abs(other[0] - x[row, 0]) < _SAME and apart < size)
        if new:
            kept[number] = row
            number += 1
    return number


@kernel
def chi_squared_of(how: Weighing, x: Array, value: Array, target: Array, measured: Array) -> float:
    """χ² of a contact; NaN where it cannot be weighed."""
    k = how.codes.shape[0]
    weights, residual, jacobian = np.empty((k, k)), np.empty(k), np.empty((k, 4))
    if not weigh_any(how, value, measured, weights):
        return np.nan
    channel_equations(x, value, np.zeros((6, 4)), how.codes, target, residual, jacobian)
    return whiten(weights, residual, jacobian, k, np.empty(k), np.empty((k, 4)))


@inlined
def _deviations(of: Searched, how: Weighing, value: Array, measured: Array, out: Array) -> None:
    """Standard deviations of the three quantities that the tree is asked for, near (F, p)."""
    k = how.codes.shape[0]
    if how.own[0, 0] > 0.0:  # a mix of components, white
        for q in range(3):
            out[q] = 1.0
        return
    sigma = np.empty((k, k))
    channel_covariance(how, value, measured, sigma)
    for q in range(3):
        i = of.where[q]
        code = how.codes[i]
        out[q] = sigma[i, i]
        if code > 5:  # components instead of a size (first) and its direction
            first = i if code % 2 == 0 else i - 1
            angle = measured[first + 1]
            along_y, along_z = math.cos(angle), math.sin(angle)
            if i > first:
                size = max(measured[first], 1e-300)
                along_y, along_z = -along_z / size, along_y / size
            out[q] = (
                along_y * along_y * sigma[first, first]
                + 2.0 * along_y * along_z * sigma[first, first + 1]
                + along_z * along_z * sigma[first + 1, first + 1]
            )
        out[q] = math.sqrt(out[q])


@inlined
def _chart_of(of: Searched, x: Array, out: Array) -> None:
    """Chart coordinates (η, ψ, ρ) of a contact x (4,)."""
    out[1] = math.atan2(x[3], x[2])
    out[0] = along(of.fold.bounds, x[0])
    out[2] = math.sqrt(math.hypot(x[2], x[3]) / fold_force(of.fold, x[0], out[1]))


@inlined
def _close(a: Array, b: Array, e: float, p: float, r: float) -> bool:
    """Whether two places in the chart are as near as this."""
    turn = abs(wrapped(a[1] - b[1])) / (2.0 * math.pi)
    turn *= min(a[2], b[2])  # near rest bearings are all one
    return bool(abs(a[0] - b[0]) <= e and turn <= p and abs(a[2] - b[2]) <= r)


@inlined
def _shifted(found: Array, slopes: Array, apart: Array, out: Array, way: Array) -> None:
    """Where a contact that explains signals ``apart`` away leads, by the chart's slopes."""
    for a in range(3):
        way[a] = 0.0
        for q in range(3):
            slope = slopes[a, q]
            if abs(slope) < np.inf:
                way[a] += slope * apart[q]
        out[a] = found[a] - way[a]
    out[0], out[2] = min(max(out[0], 0.0), 1.0), min(max(out[2], 0.02), 1.0)


@kernel
def _starts(
    of: Searched, sigma: Array, measured: Array, known: Array, number: int, starts: Array
) -> int:
    """Fill places in the chart to start from that are not known yet; how many."""
    found, quality = np.empty((MOST_SEEDS, 3)), np.empty(MOST_SEEDS, np.int64)
    slopes, target, apart = np.empty((MOST_SEEDS, 3, 3)), np.empty(3), np.zeros(3)
    place, way, count = np.empty(3), np.empty(3), 0
    for side in range(6):
        for q in range(3):
            apart[q] = 0.0
        apart[side // 2] = _APART * sigma[side // 2] * (1.0 - 2.0 * (side % 2))
        for q in range(3):
            target[q] = measured[of.where[q]] + apart[q]
        code = of.codes[side // 2]
        if not abs(apart[side // 2]) < np.inf or (code in (1.0, 4.0) and target[side // 2] <= 0.0):
            continue
        n = int(seeds(of.tree, target, found, slopes, quality))
        for i in range(n):
            if quality[i] == 0:
                continue
            _shifted(found[i], slopes[i], apart, place, way)
            e = _NEAR + _ON_THE_WAY * abs(way[0])
            p = _NEAR + _ON_THE_WAY * abs(way[1])
            r = _NEAR + _ON_THE_WAY * abs(way[2])
            new = count < _MOST_STARTS
            for c in range(number):
                new = new and not _close(known[c], place, e, p, r)
            for c in range(count):
                new = new and not _close(starts[c], place, _NEAR, _NEAR, _NEAR)
            if new:
                copy(place, starts[count])
                count += 1
    return count


@kernel
def _try(
    of: Searched,
    how: Weighing,
    passes: int,
    worth: float,
    target: Array,
    measured: Array,
    start: Array,
    number: int,
    x: Array,
    values: Array,
    misfits: Array,
) -> int:
    """Fit from a contact; add the result if it is new, and χ² at most ``worth``; how many then."""
    k = how.codes.shape[0]
    weights, value, tangents = np.empty((k, k)), np.empty((1, 6)), np.zeros((6, 4))
    if number == MOST_CANDIDATES:
        return number
    at, misfit = start.copy(), np.inf
    evaluate(of.rod, at.reshape(1, 4), value, np.empty((0, 6, 3)), 0, 1)
    for _ in range(passes):
        if not weigh_any(how, value[0], measured, weights):
            return number
        misfit = fit_within(
            of.rod, of.fold, of.proximal, how.codes, target, weights, at, value[0], tangents
        )
    if not misfit <= worth:  # but if nothing explains the measurement, the nearest is kept
        if number == 0 or (misfits[0] > worth and misfit < misfits[0]):
            copy(at, x[0])
            copy(value[0], values[0])
            misfits[0] = misfit
            return max(number, 1)
        return number
    for c in range(number):
        size = math.hypot(at[2], at[3])
        apart = math.hypot(x[c, 2] - at[2], x[c, 3] - at[3])
        if abs(x[c, 0] - at[0]) < _SAME and apart < 10.0 * _SAME * size:
            if not misfits[c] <= worth:
                copy(at, x[c])
                copy(value[0], values[c])
                misfits[c] = misfit
            return number
    copy(at, x[number])
    copy(value[0], values[number])
    misfits[number] = misfit
    return number + 1


@kernel
def complete(
    of: Searched,
    how: Weighing,
    passes: int,
    limit: float,
    target: Array,
    measured: Array,
    number: int,
    x: Array,
    values: Array,
    misfits: Array,
) -> int:
    """Add contacts of Ω that noise has hidden."""
    sigma, starts = np.empty(3), np.empty((_MOST_STARTS, 3))
    known, start, nodes = np.empty((MOST_CANDIDATES, 3)), np.zeros(4), np.full((1, PARTS), -1)
    least = np.inf
    for c in range(number):
        _chart_of(of, x[c], known[c])
        if misfits[c] < least:
            least = misfits[c]
    lost = not least <= limit
    if lost:
        nearest_of(of.seen, of.turns, of.part, of.kinds, how.mixing, target, nodes)
        node = 0
        while node < PARTS - 1 and nodes[0, node] < 0:
            node += 1
        _deviations(of, how, of.values[max(nodes[0, node], 0)], measured, sigma)
    else:
        _deviations(of, how, values[0], measured, sigma)
    worth = limit if lost else min(limit, least + INDISTINCT)
    xi = np.empty(3)
    for i in range(_starts(of, sigma, measured, known, number, starts)):
        chart_to_contact(of.fold, starts[i], xi)
        start[0], start[2], start[3] = xi[0], xi[1], xi[2]
        number = _try(of, how, passes, worth, target, measured, start, number, x, values, misfits)
    for c in range(number):
        lost = lost and not misfits[c] <= limit
    for i in range(PARTS if lost else 0):
        if nodes[0, i] >= 0:
            contact = of.contacts[nodes[0, i]]
            start[0], start[2], start[3] = contact[0], contact[1], contact[2]
            number = _try(
                of, how, passes, worth, target, measured, start, number, x, values, misfits
            )
    return _kept(limit, number, x, values, misfits)


@inlined
def _kept(limit: float, number: int, x: Array, values: Array, misfits: Array) -> int:
    """Keep candidates that explain a measurement, or the nearest one; how many."""
    best = 0
    for c in range(number):
        if misfits[c] < misfits[best]:
            best = c
    if number == 0 or not misfits[best] <= limit:
        if number > 0:
            copy(x[best], x[0])
            copy(values[best], values[0])
            misfits[0] = misfits[best]
        return min(number, 1)
    most, kept = min(limit, misfits[best] + INDISTINCT), 0
    for c in range(number):
        if misfits[c] <= most:
            copy(x[c], x[kept])
            copy(values[c], values[kept])
            misfits[kept] = misfits[c]
            kept += 1
    return kept


@kernel
def _over_the_map(
    of: Searched,
    how: Weighing,
    weights: Array,
    target: Array,
    point: Array,
    chi: float,
    log_mass: float,
    covariance: Array,
) -> float:
    """Share of the probability that the chart's nodes leave to other regions than a candidate's.

    Where noise leaves more open than the second order about one contact can describe, so that many
    nodes count, the covariance is replaced by the second moment of the posterior over them. The
    share outside three standard deviations is that of contact points or of the chart, whichever is
    larger: contact points of little volume, as near slip-off, are not left out.
    """
    q, nodes = of.seen.shape
    white, misfits, away = how.own[0, 0] > 0.0, np.empty(nodes), np.empty(q)
    largest, kept = -np.inf, 0
    for node in range(nodes):
        for i in range(q):
            away[i] = of.seen[i, node] - target[i]
            away[i] -= np.rint(away[i] * of.turns[i]) * 2.0 * np.pi
        misfit = 0.0
        for i in range(q):
            r = away[i]
            if not white:
                r = 0.0
                for c in range(q):
                    r += weights[i, c] * away[c]
            misfit += r * r
        misfits[node] = misfit
        largest = max(largest, of.log_volume[node] - 0.5 * misfit)
    points, density, likelihood = np.empty((nodes, 3)), np.empty(nodes), np.empty(nodes)
    total, squares = 0.0, 0.0
    for node in range(nodes):
        log = of.log_volume[node] - 0.5 * misfits[node]
        if log < largest - _NEGLIGIBLE and misfits[node] > chi + _NEGLIGIBLE:
            continue
        density[kept] = math.exp(log - largest)
        likelihood[kept] = math.exp(-0.5 * max(misfits[node] - chi, 0.0))
        total += density[kept]
        squares += density[kept] * density[kept]
        for a in range(3):
            points[kept, a] = of.values[node, 3 + a] - point[a]
        kept += 1
    if total * total > _MANY * squares:
        second_moment(points[:kept], density[:kept], total, NORMAL_KURTOSIS, covariance)
    root, back = np.zeros((3, 3)), np.empty(3)
    if not cholesky3(covariance, root):
        return 0.0
    mass, mass_out, like, like_out = 0.0, 0.0, 0.0, 0.0
    for node in range(kept):
        far = 0.0
        for a in range(3):
            back[a] = points[node, a]
            for c in range(a):
                back[a] -= root[a, c] * back[c]
            back[a] /= root[a, a]
            far += back[a] * back[a]
        if far > _OUTSIDE_REGION:
            mass_out += density[node]
            like_out += likelihood[node]
        else:
            mass += density[node]
            like += likelihood[node]
    # The nodes may be too far apart to see all of the candidate itself.
    mass = max(mass, math.exp(min(log_mass - largest, _MOST_LOG)))
    like = max(like, 1.0)
    return max(mass_out / (mass + mass_out), like_out / (like + like_out))


# Working memory of `settle`: aims, weights, tangents (n, 6, 4) and (n, 6, 3), covariances, log
# weights (as they count, and with volumes), probabilities, whether covariances are valid, order,
# and copies of x, (F, p) and χ².
Room = tuple[
    Array, Array, Array, Array, Array, Array, Array, AnyArray, IntArray, Array, Array, Array
]


@inlined
def _judging(most: int, k: int) -> Room:
    """Make the working memory of `settle`."""
    return (
        np.empty((most, k)),
        np.zeros((most, k, k)),
        np.zeros((most, 6, 4)),
        np.empty((most, 6, 3)),
        np.empty((most, 3, 3)),
        np.empty((2, most)),
        np.empty((1, most)),
        np.zeros(most, np.bool_),
        np.zeros((1, most), np.int64),
        np.empty((most, 4)),
        np.empty((most, 6)),
        np.empty(most),
    )


@kernel
def settle(
    of: Searched,
    how: Weighing,
    problem: Problem,
    target: Array,
    measured: Array,
    row: int,
    out: Candidates,
    room: Room,
) -> None:
    """Complete the candidates of a noisy measurement and rank them by probability."""
    aims, weights, tangents, third, spread, weight, chance, fine, order, x0, values0, chi0 = room
    x, values, chi = out.x[row], out.values[row], out.chi_squared[row]
    for c in range(out.number[row]):
        chi[c] = chi_squared_of(how, x[c], values[c], target, measured)
    n = complete(
        of, how, problem.passes, problem.limit, target, measured, out.number[row], x, values, chi
    )
    out.number[row] = n
    if n == 0:
        return
    evaluate(of.rod, x, values0, third, 0, n)
    for c in range(n):
        copy(target, aims[c])
        if not weigh_any(how, values[c], measured, weights[c]):
            weights[c, 0, 0] = np.nan
        for a in range(6):
            t = third[c, a]
            tangents[c, a, 0], tangents[c, a, 2], tangents[c, a, 3] = t[0], t[1], t[2]
    judge(
        of.rod,
        False,
        LEAST_ARC,
        of.proximal,
        how.codes,
        aims,
        weights,
        x,
        values,
        tangents,
        spread,
        weight[0],
        fine,
        0,
        n,
    )
    sound = True
    for c in range(n):
        sound = sound and fine[c]
        weight[1, c] = weight[0, c]
    for c in range(n):  # volumes that mean little are left out
        if not sound and weight[0, c] > -np.inf:
            weight[0, c] = -0.5 * chi[c]
    rank(weight, out.number[row : row + 1], chance, order)
    for c in range(n):
        copy(x[c], x0[c])
        copy(values[c], values0[c])
        chi0[c] = chi[c]
    for c in range(x.shape[0]):
        out.probability[row, c] = chance[0, c]
        if c >= n:
            chi[c], x[c], values[c] = np.nan, np.nan, np.nan
            continue
        old = order[0, c]
        copy(x0[old], x[c])
        copy(values0[old], values[c])
        chi[c], out.valid[row, c] = chi0[old], fine[old]
        for a in range(3):
            copy(spread[old, a], out.covariances[row, c, a])
    if out.probability[row, 0] > CERTAIN and not out.valid[row, 0]:
        seen, best = measured if how.own[0, 0] > 0.0 else target, order[0, 0]
        log_mass = weight[1, best] + _LOG_NORMAL
        outside = _over_the_map(
            of, how, weights[best], seen, values[0, 3:], chi[0], log_mass, out.covariances[row, 0]
        )
        out.probability[row, 0] *= 1.0 - outside
