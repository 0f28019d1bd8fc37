"""All contacts that noise leaves open: what explains a measurement exactly is not all.

A contact near which T(Ω) ends or folds may be the true one although noise has carried the signals
out of its reach, and another, far away, explains them exactly. Such contacts explain signals a
little apart: the search tree is asked for those two standard deviations to either side, and χ² is
minimised within Ω from what it finds and did not know. If nothing explains a measurement so, the
search starts from the nodes of the chart that come nearest.

Then all candidates are judged (:mod:`~vibrissa.contacts.posterior`); where the second order does
not describe one of them, they are compared by their likelihoods alone. Batches call this row by
row, as streams do.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.bounded import fit_within
from vibrissa.contacts.fitting import channel_equations, whiten
from vibrissa.contacts.inversion import MOST_CANDIDATES
from vibrissa.contacts.least_squares import PARTS, nearest_of
from vibrissa.contacts.posterior import CERTAIN, NORMAL_KURTOSIS, judge, rank, second_moment
from vibrissa.contacts.weighing import Weighing, _covariance, weigh
from vibrissa.contacts.whitening import INDISTINCT
from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, kernel, wrapped
from vibrissa.rod import LEAST_ARC, MOST_SEEDS, along, chart_to_contact, evaluate, fold_force, seeds

if TYPE_CHECKING:
    from vibrissa.contacts.locating import Searched

# How far apart signals are that the tree is asked for as well, in standard deviations.
_APART = 2.0
# What the tree finds there counts as known if it is this near to what is (of the chart's size, and
# of the way that the chart's slopes lead).
_NEAR, _ON_THE_WAY = 0.04, 0.5
# At most so many starts for one measurement.
_MOST_STARTS = 6
# Contacts within this (over L, and ten times that relative to the force) are one.
_SAME = 1e-3
# So many of the chart's nodes must count for their moments to replace those about one contact.
_MANY = 30.0
# Eigenvalues of a correlation matrix below this are rounding; what counts as exact, relative to the
# other deviations.
_SINGULAR, _EXACT = 1e-10, 1e-6


@kernel
def weigh_any(how: Weighing, value: Array, measured: Array, out: Array) -> bool:
    """Fill weights W (k, k) as `weigh`, also for singular noise; False where there is none."""
    if weigh(how, value, measured, out):
        return True
    k = how.codes.shape[0]
    sigma, size = np.empty((k, k)), np.empty(k)
    _covariance(how, value, measured, sigma)
    typical, noisy = 0.0, 0
    for i in range(k):
        for j in range(k):
            if not abs(sigma[i, j]) < np.inf:
                return False
        if sigma[i, i] > 0.0:
            typical, noisy = typical + 0.5 * math.log(sigma[i, i]), noisy + 1
    for i in range(k):
        exact = _EXACT * math.exp(typical / max(noisy, 1))
        size[i] = math.sqrt(sigma[i, i]) if sigma[i, i] > 0.0 else exact
    for i in range(k):
        for j in range(k):
            sigma[i, j] /= size[i] * size[j]
        if sigma[i, i] == 0.0:
            sigma[i, i] = 1.0
    least, vectors = np.linalg.eigh(sigma)
    for i in range(k):
        root = 1.0 / math.sqrt(least[i]) if least[i] > _SINGULAR else 0.0
        for j in range(k):
            out[i, j] = root * vectors[j, i] / size[j]
    return True


@inlined
def _misfit(how: Weighing, x: Array, value: Array, target: Array, measured: Array) -> float:
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
    _covariance(how, value, measured, sigma)
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
    of: Searched, how: Weighing, weights: Array, target: Array, point: Array, covariance: Array
) -> None:
    """Replace a covariance by the second moment of the posterior over the chart's nodes.

    That is where noise leaves more open than the second order about one contact can describe, so
    that many nodes count; otherwise the covariance stays.
    """
    q, nodes = of.seen.shape
    white, points, log = how.own[0, 0] > 0.0, np.empty((nodes, 3)), np.empty(nodes)
    away, largest, total, squares = np.empty(q), -np.inf, 0.0, 0.0
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
        log[node] = math.log(of.volume[node]) - 0.5 * misfit
        largest = max(largest, log[node])
    for node in range(nodes):
        log[node] = math.exp(log[node] - largest)
        total += log[node]
        squares += log[node] * log[node]
        for a in range(3):
            points[node, a] = of.values[node, 3 + a] - point[a]
    if total * total > _MANY * squares:
        second_moment(points, log, total, NORMAL_KURTOSIS, covariance)


@kernel
def settle(
    of: Searched,
    how: Weighing,
    passes: int,
    limit: float,
    targets: Array,
    measured: Array,
    number: IntArray,
    x: Array,
    values: Array,
    misfits: Array,
    covariances: Array,
    probability: Array,
    valid: AnyArray,
    first: int,
    last: int,
) -> None:
    """Complete the candidates of noisy measurements and rank them by probability."""
    most, k = x.shape[1], targets.shape[1]
    aims, weights, weight = np.empty((most, k)), np.zeros((most, k, k)), np.empty((1, most))
    tangents, third = np.zeros((most, 6, 4)), np.empty((most, 6, 3))
    fine, order = np.zeros(most, np.bool_), np.zeros((1, most), np.int64)
    spread, chance = np.empty((most, 3, 3)), np.empty((1, most))
    x0, values0, misfits0 = np.empty((most, 4)), np.empty((most, 6)), np.empty(most)
    for row in range(first, last):
        if not abs(targets[row].sum()) < np.inf:
            continue
        for c in range(number[row]):
            misfits[row, c] = _misfit(how, x[row, c], values[row, c], targets[row], measured[row])
        n = complete(
            of,
            how,
            passes,
            limit,
            targets[row],
            measured[row],
            number[row],
            x[row],
            values[row],
            misfits[row],
        )
        number[row] = n
        if n == 0:
            continue
        evaluate(of.rod, x[row], values0, third, 0, n)
        for c in range(n):
            copy(targets[row], aims[c])
            if not weigh_any(how, values[row, c], measured[row], weights[c]):
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
            x[row],
            values[row],
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
        for c in range(n):  # volumes that mean little are left out
            if not sound and weight[0, c] > -np.inf:
                weight[0, c] = -0.5 * misfits[row, c]
        number_here = np.array([n])
        rank(weight, number_here, chance, order)
        for c in range(n):
            copy(x[row, c], x0[c])
            copy(values[row, c], values0[c])
            misfits0[c] = misfits[row, c]
        for c in range(most):
            probability[row, c] = chance[0, c]
            if c >= n:
                misfits[row, c] = np.nan
                for a in range(4):
                    x[row, c, a] = np.nan
                for a in range(6):
                    values[row, c, a] = np.nan
                continue
            old = order[0, c]
            copy(x0[old], x[row, c])
            copy(values0[old], values[row, c])
            misfits[row, c] = misfits0[old]
            for a in range(3):
                copy(spread[old, a], covariances[row, c, a])
        valid[row] = fine[order[0, 0]]
        if probability[row, 0] > CERTAIN and not valid[row]:
            seen = measured[row] if how.own[0, 0] > 0.0 else targets[row]
            best = weights[order[0, 0]]
            _over_the_map(of, how, best, seen, values[row, 0, 3:], covariances[row, 0])
