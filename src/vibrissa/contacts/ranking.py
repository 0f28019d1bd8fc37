"""Candidates under noise: hidden ones are added, all are judged and ranked; compiled.

A contact near which T(Ω) ends or folds may be the true one although noise has carried the signals
out of its reach, and another, far away, explains them exactly. So the cells of the chart that may
hold signals within two standard deviations of the measured ones are listed. They form basins,
separated by cells that come less near; in each that known contacts do not explain by their slopes
χ² is minimised within Ω. Where that leads to no least χ², as in long flat valleys, there is no
candidate, but the chart's nodes show what else is probable.

All candidates are judged (:mod:`~vibrissa.contacts.posterior`). The volumes of contact points that
they stand for nearly vanish near slip-off, where a whisker may yet be: probabilities are the mean
of those by volumes and of those by likelihoods alone. Where the second order does not describe one
of the candidates, likelihoods count alone, and the nodes are asked too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.candidates import (
    UNEXPLAINED,
    Problem,
    Searched,
    explain_rows,
    finite,
    solve_rows,
)
from vibrissa.contacts.contacts import MOST_CANDIDATES, Candidates
from vibrissa.contacts.inversion import PARTS, nearest_of
from vibrissa.contacts.least_squares import channel_equations, fit_within, same_contact, whiten
from vibrissa.contacts.noise import INDISTINCT
from vibrissa.contacts.posterior import CERTAIN, NORMAL_KURTOSIS, judge, rank, second_moment
from vibrissa.contacts.weighing import Weighing, channel_covariance, weigh_any
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    cholesky,
    copy,
    inlined,
    kernel,
    mahalanobis,
)
from vibrissa.rod import (
    LEAST_ARC,
    MOST_CELLS,
    along,
    cells_around,
    chart_to_contact,
    evaluate,
    fold_force,
)
from vibrissa.signals import FY, MY
from vibrissa.status import Status

_UNIQUE, _AMBIGUOUS = int(Status.UNIQUE), int(Status.AMBIGUOUS)
# How far apart signals are that the tree is asked for as well, in standard deviations; and where
# nothing that is known explains the measurement.
_APART, _FAR_APART = 2.0, 4.0
# The most that this can be; more than half a turn.
_WIDEST = 1e3
# Between two basins cells must miss the measurement by so much more, relative to the slack.
_SILL = 0.5
# What a known contact explains by its slopes: χ² of three quantities, each up to the slack away,
# and as much again for what cells are wrong by.
_LINEAR = 25.0
# At most so many starts for one measurement.
_MOST_STARTS = 6
# So many of the chart's nodes must count for their moments to replace those about one contact.
_MANY = 30.0
# Squared Mahalanobis distance of three standard deviations of a point in space (99.73 %).
_OUTSIDE_REGION = 14.16
# Logarithm of the volume of a normal distribution of three coordinates, over its peak.
_LOG_NORMAL = 1.5 * math.log(2.0 * math.pi)
_MOST_LOG = 700.0
# Nodes whose χ² is so much worse than the best candidate's do not count.
_NEGLIGIBLE = 60.0


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
        if code >= FY:  # components instead of a size (first) and its direction
            first = i if code in (FY, MY) else i - 1
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
def _adjacent(of: Searched, a: int, b: int) -> bool:
    """Whether two cells of the chart touch; near rest bearings are all one."""
    one, other = of.tree.place[a], of.tree.place[b]
    around = round(2.0 * math.pi / of.tree.grid[1, 1])
    turn = abs(one[1] - other[1])
    near = min(turn, around - turn) <= 1 or one[2] + other[2] == 0
    return bool(near and abs(one[0] - other[0]) <= 1 and abs(one[2] - other[2]) <= 1)


@inlined
def _holds(of: Searched, cell: int, position: Array) -> bool:
    """Whether a position in the chart is in a cell or next to it."""
    place, grid, apart = of.tree.place[cell], of.tree.grid, np.empty(3)
    for a in range(3):
        apart[a] = abs((position[a] - grid[0, a]) / grid[1, a] - place[a] - 0.5)
    apart[1] = min(apart[1], 2.0 * math.pi / grid[1, 1] - apart[1])
    return bool(max(apart[0], apart[2]) <= 1.5 and (apart[1] <= 1.5 or place[2] == 0))


@inlined
def _root(parent: IntArray, i: int) -> int:
    """Which basin a cell belongs to."""
    while parent[i] != i:
        i = parent[i]
    return i


@kernel
def _basins(
    of: Searched, cells: IntArray, away: Array, n: int, order: IntArray, parent: IntArray
) -> None:
    """Fill the order of cells by how far they miss, and the basin (its best cell) of each.

    Cells that touch are of one basin unless they are separated by a sill.
    """
    for i in range(n):
        place = i
        while place > 0 and away[order[place - 1]] > away[i]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = i
    for nth in range(n):
        i = order[nth]
        parent[i] = i
        for before in range(nth):
            j = order[before]
            mine, theirs = _root(parent, i), _root(parent, j)
            if mine == theirs or not _adjacent(of, cells[i], cells[j]):
                continue
            if away[mine] < away[theirs]:
                mine, theirs = theirs, mine
            if away[i] - away[mine] <= _SILL:
                parent[mine] = theirs


@inlined
def _by_slopes(x: Array, r: Array, j: Array, xi: Array) -> float:
    """χ² at a contact ξ by the slopes of a known one; it bends little in s and s f."""
    total, ds = 0.0, xi[0] - x[0]
    dy = (xi[0] * (xi[1] - x[2])) / x[0]
    dz = (xi[0] * (xi[2] - x[3])) / x[0]
    for a in range(r.shape[0]):
        away = r[a] + j[a, 0] * ds + j[a, 2] * dy + j[a, 3] * dz
        total += away * away
    return total


@kernel
def _starts(
    of: Searched,
    apart: float,
    sigma: Array,
    measured: Array,
    x: Array,
    residuals: Array,
    jacobians: Array,
    number: int,
    starts: Array,
) -> tuple[int, bool]:
    """Fill contacts to start from, one for each basin that known contacts x do not explain.

    Return how many there are, and whether there are more.
    """
    target, slack, known = np.empty(3), np.empty(3), np.empty((MOST_CANDIDATES, 3))
    cells, order = np.empty(MOST_CELLS, np.int64), np.empty(MOST_CELLS, np.int64)
    spots, away = np.empty((MOST_CELLS, 3)), np.empty(MOST_CELLS)
    parent, kept, count = np.empty(MOST_CELLS, np.int64), 0, 0
    for q in range(3):
        target[q], slack[q] = measured[of.where[q]], min(apart * sigma[q], _WIDEST)
    n = cells_around(of.tree, target, slack, cells, spots, away)
    for c in range(number):
        _chart_of(of, x[c], known[c])
    for i in range(n):
        xi, new = starts[0, 1:], True
        chart_to_contact(of.fold, spots[i], xi)
        for c in range(number):
            new = new and not _holds(of, cells[i], known[c])
            new = new and not _by_slopes(x[c], residuals[c], jacobians[c], xi) < _LINEAR
        if new:
            cells[kept], away[kept] = cells[i], away[i]
            copy(spots[i], spots[kept])
            kept += 1
    _basins(of, cells, away, kept, order, parent)
    for nth in range(kept):
        i = order[nth]
        if parent[i] == i:
            if count == starts.shape[0]:
                return count, True
            start = starts[count]
            chart_to_contact(of.fold, spots[i], start[1:])
            start[0], start[1] = start[1], 0.0
            count += 1
    return count, n == MOST_CELLS


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
) -> tuple[int, bool]:
    """Fit from a contact; add the result if it is a new least χ², at most ``worth``.

    Return how many there are then, and whether the fit ended elsewhere although χ² is so small.
    """
    k = how.codes.shape[0]
    weights, value, tangents = np.empty((k, k)), np.empty((1, 6)), np.zeros((6, 4))
    if number == MOST_CANDIDATES:
        return number, True
    at, misfit, known, least = start.copy(), np.inf, False, False
    evaluate(of.rod, at.reshape(1, 4), value, np.empty((0, 6, 3)), 0, 1)
    for _ in range(passes):
        if not weigh_any(how, value[0], measured, weights):
            return number, False
        most = worth if number > 0 and misfits[0] <= worth else np.inf
        misfit, least = fit_within(
            of.rod,
            of.fold,
            of.proximal,
            how.codes,
            target,
            weights,
            at,
            value[0],
            tangents,
            most,
            x[:number],
        )
        for c in range(number):
            known = known or same_contact(at, x[c])
        if known:
            break
    lost = number == 0 or not misfits[0] <= worth
    if lost and (number == 0 or misfit < misfits[0]):  # the nearest so far, whatever it is
        copy(at, x[0])
        copy(value[0], values[0])
        misfits[0] = misfit
        return max(number, 1), misfit <= worth and not least
    if known or not (least and misfit <= worth):
        return number, not known and misfit <= worth
    copy(at, x[number])
    copy(value[0], values[number])
    misfits[number] = misfit
    return number + 1, False


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
    residuals: Array,
    jacobians: Array,
) -> tuple[int, bool]:
    """Add contacts of Ω that noise has hidden, given residuals and slopes of those that are known.

    Return how many there are then, and whether others may be probable that are not among them.
    """
    sigma, starts = np.empty(3), np.empty((_MOST_STARTS, 4))
    start, nodes, least = np.zeros(4), np.full((1, PARTS), -1), np.inf
    for c in range(number):
        least = min(least, misfits[c])
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
    apart = _FAR_APART if lost else _APART
    n, others = _starts(
        of, apart, sigma, measured, x, residuals, jacobians, 0 if lost else number, starts
    )
    for i in range(n):
        number, other = _try(
            of, how, passes, worth, target, measured, starts[i], number, x, values, misfits
        )
        others = others or other
    for c in range(number):
        lost = lost and not misfits[c] <= limit
    for i in range(PARTS if lost else 0):
        if nodes[0, i] >= 0:
            contact = of.contacts[nodes[0, i]]
            start[0], start[2], start[3] = contact[0], contact[1], contact[2]
            number, other = _try(
                of, how, passes, worth, target, measured, start, number, x, values, misfits
            )
            others = others or other
    return _kept(limit, number, x, values, misfits), others


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


@inlined
def _near_blocks(
    of: Searched, weights: Array, target: Array, most: float, blocks: IntArray
) -> tuple[int, int]:
    """List blocks of nodes that may have a χ² of ``most``; how many, with how many nodes.

    Each whitened residual is within bounds over a block, as the channels are.
    """
    q, number, nodes, away = of.turns.shape[0], 0, 0, np.empty(of.turns.shape[0])
    for n in range(blocks.shape[0]):
        least = 0.0
        for i in range(q):
            away[i] = of.extent[0, i, n] - target[i]
            away[i] -= 2.0 * np.pi * np.rint(away[i] * of.turns[i])
        for i in range(q):
            middle, half = 0.0, 0.0
            for c in range(q):
                middle += weights[i, c] * away[c]
                half += abs(weights[i, c]) * of.extent[1, c, n]
            least += max(abs(middle) - half, 0.0) ** 2
        if least <= most:
            blocks[number] = n
            number, nodes = number + 1, nodes + of.blocks[n + 1] - of.blocks[n]
    return number, nodes


@inlined
def _misfits_of_block(
    of: Searched, weights: Array, target: Array, n: int, misfits: Array
) -> tuple[int, int]:
    """Fill χ² at the nodes of a block; the first of them, and how many there are."""
    q, first = of.turns.shape[0], of.blocks[n]
    number = of.blocks[n + 1] - first
    away, r = np.empty((q, number)), np.empty(number)
    for i in range(q):
        seen, turn, aim, mine = of.seen[i], of.turns[i], target[i], away[i]
        for k in range(number):
            mine[k] = seen[first + k] - aim
        for k in range(number if turn > 0.0 else 0):
            mine[k] -= np.rint(mine[k] * turn) * 2.0 * np.pi
    for k in range(number):
        misfits[k] = 0.0
    for i in range(q):
        r[:] = 0.0
        for c in range(q):
            w, mine = weights[i, c], away[c]
            for k in range(number if w != 0.0 else 0):
                r[k] += w * mine[k]
        for k in range(number):
            misfits[k] += r[k] * r[k]
    return first, number


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
    if how.own[0, 0] > 0.0:  # what is seen is white
        weights = np.eye(of.turns.shape[0])
    blocks = np.empty(of.blocks.shape[0] - 1, np.int64)
    near, nodes = _near_blocks(of, weights, target, chi + _NEGLIGIBLE, blocks)
    points, misfits = np.empty((3, nodes)), np.empty(nodes)
    density, likelihood, kept = np.empty(nodes), np.empty(nodes), 0
    total, squares = 0.0, 0.0
    for i in range(near):
        first, number = _misfits_of_block(of, weights, target, blocks[i], misfits)
        for k in range(number):
            if not misfits[k] < chi + _NEGLIGIBLE:
                continue
            fits = math.exp(0.5 * (chi - misfits[k]))
            density[kept], likelihood[kept] = of.volume[first + k] * fits, min(fits, 1.0)
            total += density[kept]
            squares += density[kept] * density[kept]
            for a in range(3):
                points[a, kept] = of.values[first + k, 3 + a] - point[a]
            kept += 1
    if total * total > _MANY * squares:
        second_moment(points[:, :kept], density[:kept], total, NORMAL_KURTOSIS, covariance)
    root, back = np.zeros((3, 3)), np.empty(3)
    if not cholesky(covariance, root):
        return 0.0
    mass, mass_out, like, like_out = 0.0, 0.0, 0.0, 0.0
    for k in range(kept):
        for a in range(3):
            back[a] = points[a, k]
        if mahalanobis(root, back) > _OUTSIDE_REGION:
            mass_out += density[k]
            like_out += likelihood[k]
        else:
            mass += density[k]
            like += likelihood[k]
    # The nodes may be too far apart to see all of the candidate itself.
    mass = max(mass, math.exp(min(log_mass + 0.5 * chi, _MOST_LOG)), 1e-300)
    like = max(like, 1.0)
    return max(mass_out / (mass + mass_out), like_out / (like + like_out))


class _Room(NamedTuple):
    """Working memory of `settle`, by candidate.

    Targets, weights, ∂(F, p)/∂x (n, 6, 4) and ∂(F, p)/∂ξ (n, 6, 3), residuals and slopes in
    standard deviations; covariances, log weights (as they count, and with volumes), probabilities,
    whether covariances are valid, order; and copies of x, (F, p) and χ².
    """

    aims: Array
    weights: Array
    tangents: Array
    third: Array
    residuals: Array
    jacobians: Array
    spread: Array
    weight: Array
    chance: Array
    fine: AnyArray
    order: IntArray
    x: Array
    values: Array
    misfits: Array


@inlined
def _judging(most: int, k: int) -> _Room:
    """Make the working memory of `settle`."""
    return _Room(
        np.empty((most, k)),
        np.zeros((most, k, k)),
        np.zeros((most, 6, 4)),
        np.empty((most, 6, 3)),
        np.empty((most, k)),
        np.empty((most, k, 4)),
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
def _weighed(
    of: Searched,
    how: Weighing,
    target: Array,
    measured: Array,
    x: Array,
    values: Array,
    n: int,
    room: _Room,
) -> None:
    """Fill the first half of the working memory, and χ², of n candidates."""
    k = how.codes.shape[0]
    residual, jacobian = np.empty(k), np.empty((k, 4))
    evaluate(of.rod, x, room.values, room.third, 0, n)
    for c in range(n):
        copy(target, room.aims[c])
        if not weigh_any(how, values[c], measured, room.weights[c]):
            room.weights[c, 0, 0] = np.nan
        for a in range(6):
            t, by_x = room.third[c, a], room.tangents[c, a]
            by_x[0], by_x[2], by_x[3] = t[0], t[1], t[2]
        channel_equations(x[c], values[c], room.tangents[c], how.codes, target, residual, jacobian)
        room.misfits[c] = whiten(
            room.weights[c], residual, jacobian, k, room.residuals[c], room.jacobians[c]
        )


@inlined
def _both_priors(weight: Array, chi: Array, n: int, sound: bool) -> None:
    """Fill the log weights that count from those with volumes, and χ²."""
    by_volume, by_fit, volumes, fits = -np.inf, -np.inf, 0.0, 0.0
    for c in range(n):
        by_volume = max(by_volume, weight[1, c])
        if chi[c] < np.inf:
            by_fit = max(by_fit, -0.5 * chi[c])
    for c in range(n):
        volumes += math.exp(weight[1, c] - by_volume)
        if chi[c] < np.inf:
            fits += math.exp(-0.5 * chi[c] - by_fit)
    for c in range(n):
        if by_fit > -np.inf:
            share = math.exp(-0.5 * chi[c] - by_fit) / fits if chi[c] < np.inf else 0.0
            if sound and by_volume > -np.inf:
                share += math.exp(weight[1, c] - by_volume) / volumes
            weight[0, c] = math.log(share)


@inlined
def _put_in_order(row: int, n: int, out: Candidates, room: _Room) -> None:
    """Write n candidates with what is known of them by falling probability."""
    x, values, chi = out.x[row], out.values[row], out.chi_squared[row]
    for c in range(n):
        copy(x[c], room.x[c])
        copy(values[c], room.values[c])
        room.misfits[c] = chi[c]
    for c in range(x.shape[0]):
        out.probability[row, c] = room.chance[0, c]
        if c >= n:
            chi[c], x[c], values[c] = np.nan, np.nan, np.nan
            continue
        old = room.order[0, c]
        copy(room.x[old], x[c])
        copy(room.values[old], values[c])
        chi[c], out.valid[row, c] = room.misfits[old], room.fine[old]
        for a in range(3):
            copy(room.spread[old, a], out.covariances[row, c, a])


@kernel
def settle(
    of: Searched,
    how: Weighing,
    problem: Problem,
    target: Array,
    measured: Array,
    row: int,
    out: Candidates,
    room: _Room,
) -> None:
    """Complete the candidates of a noisy measurement and rank them by probability."""
    weight, chance, fine, order = room.weight, room.chance, room.fine, room.order
    x, values, chi = out.x[row], out.values[row], out.chi_squared[row]
    number = out.number[row]
    if number > 0:
        _weighed(of, how, target, measured, x, values, number, room)
    for c in range(number):
        chi[c] = room.misfits[c]
        copy(x[c], room.x[c])
    n, others = complete(
        of,
        how,
        problem.passes,
        problem.limit,
        target,
        measured,
        number,
        x,
        values,
        chi,
        room.residuals,
        room.jacobians,
    )
    out.number[row] = n
    if n == 0:
        return
    changed = n > number
    for c in range(n):
        changed = changed or x[c, 0] != room.x[c, 0] or x[c, 2] != room.x[c, 2]
    if changed:
        _weighed(of, how, target, measured, x, values, n, room)
    judge(
        of.rod,
        False,
        LEAST_ARC,
        of.proximal,
        how.codes,
        room.aims,
        room.weights,
        x,
        values,
        room.tangents,
        room.spread,
        weight[1],
        fine,
        0,
        n,
    )
    sound = True
    for c in range(n):
        sound = sound and fine[c]
        weight[0, c] = weight[1, c]
    _both_priors(weight, chi, n, sound)
    rank(weight, out.number[row : row + 1], chance, order)
    _put_in_order(row, n, out, room)
    if out.probability[row, 0] > CERTAIN and (others or not out.valid[row, 0]):
        seen, best = measured if how.own[0, 0] > 0.0 else target, order[0, 0]
        log_mass = weight[1, best] + _LOG_NORMAL
        outside = _over_the_map(
            of,
            how,
            room.weights[best],
            seen,
            values[0, 3:],
            chi[0],
            log_mass,
            out.covariances[row, 0],
        )
        out.probability[row, 0] *= 1.0 - outside


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
        if not finite(targets[row]):
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
        solve_rows(of, targets, measured, out, status, first, last)
    else:
        explain_rows(of, how, problem, targets, measured, out, status, False, first, last)
    if problem.noisy:
        settle_rows(of, how, problem, targets, measured, out, status, first, last)
        if not problem.exact and (status[first:last] == UNEXPLAINED).any():
            explain_rows(of, how, problem, targets, measured, out, status, True, first, last)
