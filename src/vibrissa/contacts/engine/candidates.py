"""All contacts that explain measurements; compiled.

Three signals have as many unknowns: every contact with T(ξ) = T is found from the search tree. More
signals are explained by least squares, starting from the contacts at which three quantities have
the measured values. If no such contact explains the measurement, fits start from the nodes of the
chart that come nearest, one in each of its sixteen parts. The treatment of noise is in
:mod:`~vibrissa.contacts.engine.ranking`.
"""

from __future__ import annotations

import numpy as np

from vibrissa.contacts.contacts import MOST_CANDIDATES
from vibrissa.contacts.engine.task import Problem, Task, in_memory
from vibrissa.contacts.fitting.inversion import invert_rows
from vibrissa.contacts.fitting.least_squares import (
    Fits,
    approach,
    channel_equations,
    fit_rows,
    same_contact,
    settled,
    stable_fit,
)
from vibrissa.contacts.sensing.noise import INDISTINCT
from vibrissa.contacts.sensing.weighing import Weighing, weigh
from vibrissa.contacts.uncertainty.nodes import PARTS, Searched, nearest_of
from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, kernel, order_of
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    LEAST_ARC,
    MOST_SEEDS,
    ROUNDING,
    Rod,
    chart_to_contact,
    evaluate,
    integrate,
    lane_value,
    seed_room,
    seeds,
    set_lane,
)
from vibrissa.status import Status

_UNIQUE, _AMBIGUOUS = int(Status.UNIQUE), int(Status.AMBIGUOUS)
_DEGENERATE = int(Status.DEGENERATE)
_OUTSIDE, _FRICTION = int(Status.OUTSIDE_MAP), int(Status.NOT_FRICTIONLESS)
#: Status of rows of three signals without a contact, before the reason is determined.
UNEXPLAINED = -1
_MOST_ROWS = MOST_SEEDS + PARTS
_TIMES = 8
# Difference of χ² to a better fit within which one is given up if χ² rises by no more than the
# second value on the path between them: near the floor of a valley fits are slow, and most end
# together.
_CLOSE, _SILL = 0.3, 0.01
# Of candidates that explain signals equally well, the one with less force comes first.
_FORCE = 1e-6

# By row: x (n, 4), (F, p) (n, 6), ∂(F, p)/∂x (n, 6, 4), χ² (n,), and where a fit ended (n,): 2 on
# the map, 1 nearer to the base, 0 neither.
State = tuple[Array, Array, Array, Array, IntArray]


@kernel
def explain_rows(
    task: Task,
    targets: Array,
    measured: Array,
    number: IntArray,
    flat: Array,
    valid: AnyArray,
    status: IntArray,
    again: bool,
    first: int,
    last: int,
) -> None:
    """Find the candidates of measurements by least squares; NaN rows stay as they are.

    With noise the candidates are completed and ranked before their status is determined; ``again``
    then states why the rows that are UNEXPLAINED have no contact.
    """
    of, how, problem, out = task.of, task.how, task.problem, in_memory(number, flat, valid)
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
        if not finite(target) or (again and status[row] != UNEXPLAINED):
            continue
        if not again:
            x, values, chi = out.x[row], out.values[row], out.chi_squared[row]
        most, starts = _best(of, how, problem, target, seen, state, x, values, chi)
        if again:  # perhaps a contact nearer to the base than the map's limit explains it
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
def solve_rows(
    task: Task,
    targets: Array,
    measured: Array,
    number: IntArray,
    flat: Array,
    valid: AnyArray,
    status: IntArray,
    first: int,
    last: int,
) -> None:
    """Find the contacts that give three signals exactly; NaN rows stay as they are."""
    of, out, n = task.of, in_memory(number, flat, valid), last - first
    aims, xi, loose = np.empty((n, 6)), np.empty((n, MOST_CANDIDATES, 3)), np.zeros(n, np.bool_)
    for i in range(n):
        row, known = first + i, finite(targets[first + i])
        for k in range(3):
            aims[i, k] = measured[row, of.where[k]] if known else np.nan
            aims[i, 3 + k] = of.codes[k]
    found, values = number[first:last], out.values[first:last]
    rod, fold, _ = of.charted
    invert_rows(rod, fold, of.tree, of.proximal, aims, found, xi, values, loose, 0, n)
    for i in range(n):
        if aims[i, 0] != aims[i, 0]:
            continue
        row = first + i
        if loose[i]:
            found[i], status[row] = 0, _DEGENERATE
            values[i] = np.nan
            continue
        for c in range(found[i]):
            x = out.x[row, c]
            x[0], x[1], x[2], x[3] = xi[i, c, 0], 0.0, xi[i, c, 1], xi[i, c, 2]
            out.chi_squared[row, c] = 0.0
        status[row] = UNEXPLAINED
        if found[i] > 0:
            status[row] = _UNIQUE if found[i] == 1 else _AMBIGUOUS


@inlined
def finite(target: Array) -> bool:
    """Whether all values of a measurement are finite."""
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
    """Fill the contacts that explain a measurement best; their number, and that of all fits."""
    x, values, tangents, misfits, inside = state
    limit = problem.limit
    x[:], tangents[:], misfits[:], inside[:] = 0.0, 0.0, np.inf, 0
    n = _seeded(of, how, target, measured, x, values)
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
    """Fill the index of the fit on the map that comes nearest; return 1, or 0 if there is none."""
    number, best = 0, np.inf
    for row in range(n):
        if inside[row] == 2 and misfits[row] < best:
            kept[0], number, best = row, 1, misfits[row]
    return number


@kernel
def _seeded(
    of: Searched, how: Weighing, target: Array, measured: Array, x: Array, values: Array
) -> int:
    """Fill contacts, and (F, p), that nearly give three quantities or all; their number."""
    room, xi, three, number = seed_room(), np.empty(3), np.empty(3), 0
    for k in range(3):
        three[k] = measured[of.where[k]]
    n = int(seeds(of.tree, three, room))
    for row in range(n):
        at, new = x[number], True
        chart_to_contact(of.charted.fold, room.found[row], xi)
        at[0], at[1], at[2], at[3] = xi[0], 0.0, xi[1], xi[2]
        approach(of.charted, how, target, measured, at)
        for other in range(number):
            new = new and not same_contact(at, x[other])
        number += 1 if new else 0
    evaluate(of.charted.rod, x, values, np.empty((0, 6, 3)), 0, number)
    return number


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
    """Fit from some rows; fill whether a fit is on the map (2) or nearer to the base (1)."""
    x, values, tangents, misfits, inside = state
    k, n = how.codes.shape[0], x.shape[0]
    targets, weights = np.empty((n, k)), np.empty((n, k, k))
    rod, codes = of.charted.rod, how.codes
    fits = Fits(x, values, tangents, misfits, np.zeros(n, np.bool_))
    worth, before, rest = problem.limit + INDISTINCT, x.copy(), False
    for _ in range(problem.passes):
        if rest:
            break
        rest = True
        for row in range(first, last):
            copy(x[row], before[row])
            copy(target, targets[row])
            if not weigh(how, values[row], measured, weights[row]):
                return
        fit_rows(rod, False, LEAST_ARC, codes, targets, weights, fits, first, last)
        order = first + order_of(misfits[first:last])
        for i in range(last - first):
            row = order[i]
            for _again in range(_TIMES):
                if fits.converged[row] or not misfits[row] <= worth:
                    break
                if _downhill(rod, codes, target, weights[row], x, misfits, inside, order[:i], row):
                    misfits[row] = np.inf
                    break
                fit_rows(rod, False, LEAST_ARC, codes, targets, weights, fits, row, row + 1)
            inside[row] = _where(of, x[row], tangents[row], misfits[row])
            rest = rest and (settled(before[row], x[row]) or not misfits[row] < np.inf)


@inlined
def _where(of: Searched, x: Array, tangents: Array, misfit: float) -> int:
    """Whether a fit is on the map, 2, nearer to the base, 1, or neither, 0."""
    if not misfit < np.inf:
        return 0
    if stable_fit(of.charted.fold, of.proximal, x, tangents):
        return 2
    return 1 if stable_fit(of.charted.fold, LEAST_ARC + ROUNDING, x, tangents) else 0


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
    """Whether χ² decreases on the path along a valley from a contact to a better one on the map."""
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
    """Fit from the nearest node of each part of the map; return the number of rows."""
    x, values = state[0], state[1]
    nearest = np.full(PARTS, -1)
    nearest_of(of, how.mixing, target, nearest)
    rows = n
    for part in range(PARTS):
        node = nearest[part]
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
    """Fill the fits that explain the measurement and are indistinguishable, the best first."""
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
            new = new and not same_contact(x[row], x[kept[i]])
        if new:
            kept[number] = row
            number += 1
    return number
