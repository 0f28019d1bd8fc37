"""Completing, judging and ranking candidates under noise; compiled.

Noise may have carried the signals of the true contact out of T(Ω), across its boundary or a fold,
while another contact, far away, explains them exactly. Such hidden candidates are searched for in
three steps:

1. List the cells of the chart that may contain signals within two standard deviations of the
   measured ones, and group them into basins (:mod:`~vibrissa.contacts.uncertainty.basins`).
2. In each basin that no known candidate explains through its slopes, minimise χ² within Ω. If this
   reaches no minimum, as in long flat valleys, the basin adds no candidate, but the nodes of the
   chart show how probable the contacts there are.
3. If a contact and its mirror image in the plane of a planar whisker have the same signals, start
   also from the images of the known candidates. Flat valleys
   (:mod:`~vibrissa.contacts.uncertainty.flat_valleys`) can join both into one basin.

All candidates are then judged (:mod:`~vibrissa.contacts.uncertainty.posterior`). The probability
density of the measurement at a candidate follows from the noise there; the density of a direction
decreases with the size of its vector. A prior that is uniform in volume nearly vanishes near
slip-off, where contacts nevertheless occur, so probabilities are the mean of those with volumes and
those from likelihoods alone. If the second-order expansion does not describe one of the candidates,
only the likelihoods count, the valley of χ² through the best candidate is followed, and the nodes
of the chart are evaluated too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import MOST_CANDIDATES, Candidates, Room
from vibrissa.contacts.engine.candidates import UNEXPLAINED, explain_rows, finite, solve_rows
from vibrissa.contacts.engine.task import (
    MOST_STARTS,
    Description,
    Problem,
    Task,
    described_in_thread,
    description,
    in_memory,
    task,
    type_of_description,
    type_of_task,
)
from vibrissa.contacts.fitting.fit_within import FitRoom, fit_room, fit_within
from vibrissa.contacts.fitting.least_squares import channel_equations, same_contact, settled, whiten
from vibrissa.contacts.sensing.channels import Channels
from vibrissa.contacts.sensing.noise import INDISTINCT
from vibrissa.contacts.sensing.weighing import Weighing, sharpness, weigh_any, weighing_of
from vibrissa.contacts.uncertainty.basins import BasinsRoom, basins_room, slacks, starts_of_basins
from vibrissa.contacts.uncertainty.flat_valleys import follow_valley
from vibrissa.contacts.uncertainty.nodes import (
    PARTS,
    Searched,
    described_by_nodes,
    nearest_of,
    outside_share,
    probable_nodes,
)
from vibrissa.contacts.uncertainty.posterior import CERTAIN, judge, judge_room, rank
from vibrissa.numerics import (
    AnyArray,
    Array,
    Call,
    IntArray,
    compile_together,
    copy,
    inlined,
    kernel,
)
from vibrissa.rod import LANES, Rod, evaluate
from vibrissa.signals import FT, FX, MB, MD, SIGNALS
from vibrissa.status import Status

_UNIQUE, _AMBIGUOUS = int(Status.UNIQUE), int(Status.AMBIGUOUS)
# Distance, in standard deviations, within which the tree lists cells: normally, and if no known
# candidate explains the measurement.
_APART, _FAR_APART = 2.0, 4.0
# Change of χ² with the weights at the contact below which a fit is a minimum with these weights.
_SAME_WEIGHTS = 0.1
# Rows that pass from kernel to kernel together; the description of each takes about 4 kB.
_AT_ONCE = 128
# Logarithm of the integral of a three-dimensional normal density with a peak of one.
_LOG_NORMAL = 1.5 * math.log(2.0 * math.pi)


class _Work(NamedTuple):
    """Working memory of `complete_rows`, of m candidates and k channels.

    (F, p) (m, 6), derivatives of one with respect to x (6, 4), χ² (m,), residuals (k,) and their
    slopes (k, 4); starting contacts (n, 4), one of them, and the nearest nodes.
    """

    values: Array
    tangents: Array
    misfits: Array
    residual: Array
    jacobian: Array
    starts: Array
    start: Array
    nodes: IntArray
    basins: BasinsRoom
    fit: FitRoom


class _Row(NamedTuple):
    """A measurement: target (k,), measured values, x (m, 4), (F, p) and χ² of its candidates.

    ``loose`` (n, 4) is for χ² and points of further contacts that explain it as well.
    """

    target: Array
    measured: Array
    x: Array
    values: Array
    misfits: Array
    loose: Array


@inlined
def _work(k: int) -> _Work:
    """Allocate the working memory of `complete_rows`."""
    return _Work(
        np.empty((MOST_CANDIDATES, 6)),
        np.zeros((6, 4)),
        np.empty(MOST_CANDIDATES),
        np.empty(k),
        np.empty((k, 4)),
        np.empty((MOST_STARTS, 4)),
        np.empty(4),
        np.empty(PARTS, np.int64),
        basins_room(),
        fit_room(k),
    )


@kernel
def chi_squared_of(how: Weighing, x: Array, value: Array, target: Array, measured: Array) -> float:
    """χ² of a contact; NaN if its weights cannot be computed."""
    k = how.codes.shape[0]
    weights, residual, jacobian = np.empty((k, k)), np.empty(k), np.empty((k, 4))
    if not weigh_any(how, value, measured, weights):
        return np.nan
    channel_equations(x, value, np.zeros((6, 4)), how.codes, target, residual, jacobian)
    return whiten(weights, residual, jacobian, k, np.empty(k), np.empty((k, 4)))


@kernel
def _try(
    of: Searched,
    how: Weighing,
    passes: int,
    worth: float,
    row: _Row,
    start: Array,
    number: int,
    room: FitRoom,
) -> tuple[int, bool]:
    """Fit from a starting contact, and add the result if it is a new minimum of at most ``worth``.

    Return the number of minima, and whether the fit ended at a contact that is not one of them
    although its χ² is small, a loose one.
    """
    target, measured, x, values, misfits, loose = row
    if number == MOST_CANDIDATES:
        return number, True
    at, misfit, known, least = start.copy(), np.inf, False, False
    value, tangents = np.empty(6), np.zeros((6, 4))
    lost = number == 0 or not misfits[0] <= worth
    most = np.inf if lost else worth
    before = start.copy()
    for _ in range(passes):
        copy(at, before)
        misfit, least = fit_within(
            of.charted,
            of.proximal,
            how,
            how.codes,
            False,
            target,
            measured,
            at,
            value,
            tangents,
            most,
            x[:number],
            misfits,
            room,
        )
        for c in range(number):
            known = known or same_contact(at, x[c])
        if known or not misfit < np.inf or settled(before, at):
            break
    if passes > 1 and misfit < np.inf:  # with weights at the contact before
        old, misfit = misfit, chi_squared_of(how, at, value, target, measured)
        least = least and abs(misfit - old) < _SAME_WEIGHTS
    if known or not misfit < np.inf:
        return number, False
    if lost and (number == 0 or misfit < misfits[0]):  # the best so far, whatever its χ²
        copy(at, x[0])
        copy(value, values[0])
        misfits[0] = misfit
        return max(number, 1), misfit <= worth and not least
    if not (least and misfit <= worth):
        other = misfit <= worth
        for i in range(loose.shape[0] if other else 0):
            if loose[i, 0] == np.inf:
                loose[i, 0] = misfit
                copy(value[3:], loose[i, 1:])
                break
        return number, other
    copy(at, x[number])
    copy(value, values[number])
    misfits[number] = misfit
    return number + 1, False


@kernel
def complete(
    of: Searched,
    how: Weighing,
    problem: Problem,
    row: _Row,
    number: int,
    residuals: Array,
    jacobians: Array,
    room: _Work,
) -> tuple[int, bool]:
    """Add contacts of Ω that noise has hidden, given residuals and slopes of the known candidates.

    Return the number of candidates, and whether other contacts may be probable.
    """
    target, measured, x, values, misfits, loose = row
    passes, limit = problem.passes, problem.limit
    starts, start, nodes, slack = room.starts, room.start, room.nodes, room.basins.slack
    least, loose[:] = np.inf, np.inf
    for c in range(number):
        least = min(least, misfits[c])
    lost = not least <= limit
    if lost:
        nodes[:] = -1
        nearest_of(of, how.mixing, target, nodes)
        node = 0
        while node < PARTS - 1 and nodes[node] < 0:
            node += 1
        slacks(of, how, _FAR_APART, of.values[max(nodes[node], 0)], measured, slack)
    else:
        slacks(of, how, _APART, values[0], measured, slack)
    worth, known = (limit, 0) if lost else (min(limit, least + INDISTINCT), number)
    n, others = starts_of_basins(of, measured, x, residuals, jacobians, known, starts, room.basins)
    for i in range(n):
        number, other = _try(of, how, passes, worth, row, starts[i], number, room.fit)
        others = others or other
    for c in range(number if _mirrored(how) else 0):
        copy(x[c], start)
        start[3] = -start[3]  # high above a narrow valley's floor; not abandoned early
        number, other = _try(of, how, passes, np.inf, row, start, number, room.fit)
        others = others or other
    for c in range(number):
        lost = lost and not misfits[c] <= limit
    for i in range(PARTS if lost else 0):
        if nodes[i] >= 0:
            contact = of.contacts[nodes[i]]
            start[0], start[1], start[2], start[3] = contact[0], 0.0, contact[1], contact[2]
            number, other = _try(of, how, passes, worth, row, start, number, room.fit)
            others = others or other
    return _kept(limit, number, x, values, misfits), others


@inlined
def _mirrored(how: Weighing) -> bool:
    """Whether the mirror image in the plane of a planar whisker has the same channels."""
    mirrored = True
    for code in how.codes:
        mirrored = mirrored and code in (FX, FT, MB)
    return mirrored


@inlined
def _kept(limit: float, number: int, x: Array, values: Array, misfits: Array) -> int:
    """Keep the candidates that explain a measurement, or else the best one; return their number."""
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
def _weighed(
    of: Searched,
    how: Weighing,
    row: _Row,
    first: int,
    n: int,
    room: _Work,
    described: tuple[Array, Array, Array, Array],
) -> None:
    """Fill χ², weights, ∂(F, p)/∂ξ (known before ``first``), residuals and slopes of candidates."""
    target, measured, x, values, _, _ = row
    weights, third, residuals, jacobians = described
    k, residual, jacobian = how.codes.shape[0], room.residual, room.jacobian
    if first < n:
        evaluate(of.charted.rod, x, room.values, third, first, n)
    for c in range(n):
        if not weigh_any(how, values[c], measured, weights[c]):
            weights[c, 0, 0] = np.nan
        for a in range(6):
            t, by_x = third[c, a], room.tangents[a]
            by_x[0], by_x[2], by_x[3] = t[0], t[1], t[2]
        channel_equations(x[c], values[c], room.tangents, how.codes, target, residual, jacobian)
        room.misfits[c] = whiten(weights[c], residual, jacobian, k, residuals[c], jacobians[c])


@kernel
def complete_rows(
    task: Task,
    targets: Array,
    measured: Array,
    number: IntArray,
    flat: Array,
    valid: AnyArray,
    about: Description,
    first: int,
    last: int,
) -> None:
    """Complete and describe the candidates of noisy measurements."""
    of, how, problem, out = task.of, task.how, task.problem, in_memory(number, flat, valid)
    known = np.empty((MOST_CANDIDATES, 4))
    room = _work(how.codes.shape[0])
    lanes, forces, tangents = np.zeros((LANES, 4)), np.empty((LANES, 6)), np.empty((LANES, 6, 3))
    for row in range(first, last):
        target, i, before = targets[row], row - first, number[row]
        lane = i % LANES
        if lane == 0:  # evaluate the first candidates of the next rows together, in SIMD lanes
            side = min(LANES, last - row)
            for n in range(side):
                lanes[n, 0] = 1.0
                if number[row + n] > 0:
                    copy(out.x[row + n, 0], lanes[n])
            evaluate(of.charted.rod, lanes, forces, tangents, 0, side)
        if not finite(target):
            continue
        x, values, chi = out.x[row], out.values[row], out.chi_squared[row]
        residuals, jacobians = about.residuals[i], about.jacobians[i]
        described = about.weights[i], about.third[i], residuals, jacobians
        one = _Row(target, measured[row], x, values, chi, about.loose[i])
        for a in range(6):
            copy(tangents[lane, a], about.third[i, 0, a])
        if before > 0:
            _weighed(of, how, one, 1, before, room, described)
        for c in range(before):
            chi[c] = room.misfits[c]
            copy(x[c], known[c])
        n, about.others[i] = complete(of, how, problem, one, before, residuals, jacobians, room)
        changed = n > before
        for c in range(n):
            changed = changed or x[c, 0] != known[c, 0] or x[c, 2] != known[c, 2]
        if changed:
            _weighed(of, how, one, 0, n, room, described)
        number[row] = n


@inlined
def _both_priors(weight: Array, chi: Array, n: int, sound: bool) -> None:
    """Fill log weights that combine both priors, from log weights with volumes and χ²."""
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
def _units(of: Searched, how: Weighing, value: Array) -> Array:
    """Sizes (q,) of the vectors of directions at (F, p); zero where weights do not depend on it."""
    out = np.zeros(of.turns.shape[0])
    for i in range(out.shape[0]):
        if of.turns[i] > 0.0 and not how.deviations[0] >= 0.0:
            out[i] = math.hypot(value[1], value[2])
            if how.codes[i] == MD:
                my = value[5] * value[0] - value[3] * value[2]
                out[i] = math.hypot(my, value[3] * value[1] - value[4] * value[0])
    return out


class _Judged(NamedTuple):
    """Working memory of `judge_rows`, by candidate.

    Covariances (m, 3, 3), log weights (combined, and with volumes) (2, m), probabilities (1, m),
    validity of the covariances, whether the second order describes the channels, order (1, m);
    copies of x, (F, p) and χ².
    """

    spread: Array
    weight: Array
    chance: Array
    fine: AnyArray
    described: AnyArray
    order: IntArray
    x: Array
    values: Array
    misfits: Array


@inlined
def _judging(most: int) -> _Judged:
    """Allocate the working memory of `judge_rows`."""
    return _Judged(
        np.empty((most, 3, 3)),
        np.empty((2, most)),
        np.empty((1, most)),
        np.zeros(most, np.bool_),
        np.zeros(most, np.bool_),
        np.zeros((1, most), np.int64),
        np.empty((most, 4)),
        np.empty((most, 6)),
        np.empty(most),
    )


@inlined
def _put_in_order(row: int, n: int, out: Candidates, room: _Judged) -> None:
    """Write n candidates, with all that belongs to them, by falling probability."""
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
def judge_rows(
    task: Task,
    targets: Array,
    measured: Array,
    number: IntArray,
    flat: Array,
    valid: AnyArray,
    status: IntArray,
    about: Description,
    first: int,
    last: int,
) -> None:
    """Judge the candidates left by `complete_rows`, and rank them by probability."""
    of, how, limit, out = task.of, task.how, task.problem.limit, in_memory(number, flat, valid)
    room, judging = _judging(MOST_CANDIDATES), judge_room(how.codes.shape[0])
    weight, fine = room.weight, room.fine
    for row in range(first, last):
        target, i, n, chi = targets[row], row - first, number[row], out.chi_squared[row]
        if not finite(target):
            continue
        status[row] = UNEXPLAINED
        if n == 0:
            continue
        sound = True
        for c in range(n):
            weight[1, c], fine[c], room.described[c] = judge(
                of.charted,
                of.proximal,
                how.codes,
                target,
                about.weights[i, c],
                out.x[row, c],
                about.third[i, c],
                about.residuals[i, c],
                about.jacobians[i, c],
                room.spread[c],
                judging,
            )
            sound = sound and fine[c]
            sharp = sharpness(about.weights[i, c])
            room.misfits[c] = chi[c] - 2.0 * sharp
            weight[1, c] += sharp
            weight[0, c] = weight[1, c]
        _both_priors(weight, room.misfits, n, sound)
        rank(weight, number[row : row + 1], room.chance, room.order)
        _put_in_order(row, n, out, room)
        best = room.order[0, 0]
        about.best[i, 0], about.best[i, 1] = best, weight[1, best]
        about.best[i, 2] = 1.0 if room.described[best] else 0.0
        if chi[0] <= limit:
            status[row] = _UNIQUE if out.probability[row, 0] > CERTAIN else _AMBIGUOUS


@kernel
def leave_rows(
    task: Task,
    targets: Array,
    measured: Array,
    number: IntArray,
    flat: Array,
    valid: AnyArray,
    status: IntArray,
    about: Description,
    first: int,
    last: int,
) -> None:
    """Lower the probability of first candidates by the posterior outside their regions."""
    of, how, out = task.of, task.how, in_memory(number, flat, valid)
    white = how.own[0, 0] > 0.0
    for row in range(first, last):
        target, i = targets[row], row - first
        if not finite(target) or number[row] == 0 or not out.probability[row, 0] > CERTAIN:
            continue
        if not about.others[i] and out.valid[row, 0]:
            continue
        best, described = int(about.best[i, 0]), about.best[i, 2] > 0.0
        weights, spread = about.weights[i, best], out.covariances[row, 0]
        value, chi = out.values[row, 0], out.chi_squared[row, 0]
        seen, unit = measured[row] if white else target, _units(of, how, value)
        points, likely = probable_nodes(of, white, weights, unit, seen, value[3:], chi)
        bent = not described or (_mirrored(how) and not out.valid[row, 0])
        if bent and not described_by_nodes(points, likely, spread):
            x = out.x[row, 0]
            follow_valley(of.charted, of.proximal, how, target, measured[row], x, spread)
        log_mass = about.best[i, 1] - sharpness(weights) + _LOG_NORMAL
        share = outside_share(points, likely, value[3:], chi, log_mass, spread, about.loose[i])
        out.probability[row, 0] *= 1.0 - share
        if status[row] == _UNIQUE and not out.probability[row, 0] > CERTAIN:
            status[row] = _AMBIGUOUS


def stages(of: Searched, how: Weighing, problem: Problem) -> tuple[list[Call], list[Call]]:
    """Kernels for noisy measurements and their arguments, in halves that compile equally long."""
    channels = np.empty((0, how.codes.shape[0]))
    status, about = np.empty(0, np.int64), type_of_description()
    given = type_of_task(of, how, problem), channels, channels, *Room.of(0)
    find: Call = (solve_rows, (*given, status, 0, 0))
    if not problem.exact:
        find = (explain_rows, (*given, status, False, 0, 0))
    judged = *given, status, about, 0, 0
    # What they have in common is translated once: the weights at a contact, and nodes.
    here: list[Call] = [(task, (of, how, problem)), (complete_rows, (*given, about, 0, 0))]
    here.append((leave_rows, judged))
    return here, [(judge_rows, judged), (description, (0, 0)), find]


def stages_ahead(rod: Rod) -> list[Call]:
    """Kernels for noise of three signals that another process compiles while a chart is made."""
    of, problem = Searched.none(rod), Problem(exact=True, noisy=True, passes=1, limit=0.0)
    how = weighing_of(Channels.of(SIGNALS[:3]), None, 1.0, 1.0, np.ones(3))
    here, there = stages(of, how, problem)
    return [*there, here[-1]]


def compile_stages(of: Searched, how: Weighing, problem: Problem) -> None:
    """Compile the kernels for noisy measurements in two processes, unless they are cached."""
    if not judge_rows.overloads:  # type: ignore[attr-defined]
        compile_together(*stages(of, how, problem))


def estimate_rows(
    task: Task,
    problem: Problem,
    targets: Array,
    measured: Array,
    room: Room,
    status: IntArray,
    first: int,
    last: int,
) -> None:
    """Find, complete, judge and rank the candidates of measurements; NaN rows stay as they are.

    Each stage is compiled separately: a caller that needs one does not wait for the others, and two
    processes can share the work.
    """
    given = targets, measured, *room
    if problem.exact:
        solve_rows(task, *given, status, first, last)
    else:
        explain_rows(task, *given, status, False, first, last)
    if not problem.noisy:
        return
    about = described_in_thread(min(last - first, _AT_ONCE), targets.shape[1])
    for start in range(first, last, _AT_ONCE):
        end = min(start + _AT_ONCE, last)
        complete_rows(task, *given, about, start, end)
        judge_rows(task, *given, status, about, start, end)
        leave_rows(task, *given, status, about, start, end)
    if not problem.exact and (status[first:last] == UNEXPLAINED).any():
        explain_rows(task, *given, status, True, first, last)
