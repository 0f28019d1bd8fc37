"""The contacts that explain more than three signals, or a mix, best: one measurement at a time.

The search tree tells about where three quantities have their values; χ² of all that is measured is
minimised from there. Where no such contact explains the measurement, the search starts again from
the nodes of the chart that come nearest, one for each of sixteen parts of it. What batches do with
arrays is in :mod:`~vibrissa.contacts.least_squares`.
"""

from __future__ import annotations

import numpy as np

from vibrissa.contacts.fitting import _fit, channel_equations
from vibrissa.contacts.inversion import MOST_CANDIDATES
from vibrissa.contacts.least_squares import PARTS, nearest_of
from vibrissa.contacts.locating import Searched, Trail, conclude, near
from vibrissa.contacts.posterior import CERTAIN
from vibrissa.contacts.weighing import Weighing, weigh
from vibrissa.contacts.whitening import INDISTINCT
from vibrissa.numerics import Array, IntArray, copy, inlined, kernel
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
    point_determinant,
    seeds,
    set_lane,
    stable,
)
from vibrissa.status import Status

_UNIQUE, _AMBIGUOUS = int(Status.UNIQUE), int(Status.AMBIGUOUS)
_OUTSIDE, _FRICTION = int(Status.OUTSIDE_MAP), int(Status.NOT_FRICTIONLESS)
_MOST_STARTS = MOST_SEEDS + 1 + PARTS
_TIMES = 8
# At the foot of a valley fits are slow, and most go the same way: one that is this near in χ² to a
# better one is given up if on the way there χ² does not rise by more than this.
_CLOSE, _SILL = 0.3, 0.01
# Contacts within this (over L, and ten times that relative to the force) are one.
_SAME = 1e-3
# Of candidates that explain signals equally well the one with less force comes first.
_FORCE = 1e-6

# Row by row: x (n, 4), (F, p) (n, 6), ∂(F, p)/∂x (n, 6, 4), χ² (n,), and where a fit ended (n,):
# 2 on the map, 1 nearer to the base, 0 nowhere.
State = tuple[Array, Array, Array, Array, IntArray]


@kernel
def explain(
    of: Searched,
    how: Weighing,
    noisy: bool,
    passes: int,
    limit: float,
    target: Array,
    measured: Array,
    trail: Trail,
    found: Array,
    probability: Array,
) -> tuple[int, int, int, float, bool]:
    """Find the contacts that explain more than three signals, or a mix, best."""
    x, values = np.zeros((_MOST_STARTS, 4)), np.zeros((_MOST_STARTS, 6))
    tangents, misfits = np.zeros((_MOST_STARTS, 6, 4)), np.full(_MOST_STARTS, np.inf)
    inside = np.zeros(_MOST_STARTS, np.int64)
    n = _starts(of, measured, trail, x, values)
    state = (x, values, tangents, misfits, inside)
    _fitted(of, how, passes, limit + INDISTINCT, target, measured, state, 0, n)
    kept, good = np.empty(MOST_CANDIDATES, np.int64), _explained(misfits, inside, limit, n)
    if not (good or noisy):
        n = _everywhere(of, how, passes, limit, target, measured, state, n)
        good = _explained(misfits, inside, limit, n)
    number = _chosen(x, misfits, inside, limit, n, kept) if good else 0
    if not (good or noisy):
        number = _nearest_fit(misfits, inside, n, kept)
    contacts, solved = np.zeros((1, MOST_CANDIDATES, 4)), np.empty((1, MOST_CANDIDATES, 6))
    for i in range(number):
        copy(x[kept[i]], contacts[0, i])
        copy(values[kept[i]], solved[0, i])
    least = misfits[kept[0]] if number > 0 else np.nan
    number, continuing, misfit, valid = conclude(
        of,
        how,
        noisy,
        passes,
        limit,
        target,
        measured,
        trail,
        number,
        contacts,
        solved,
        found,
        probability,
    )
    if not noisy:
        misfit = least
    elif misfit <= limit:
        good = True
    else:  # perhaps a contact nearer to the base than the map goes explains it
        n = _everywhere(of, how, passes, limit, target, measured, state, n)
    sure = probability[0, 0] > CERTAIN if noisy else number == 1
    status = _UNIQUE if sure else _AMBIGUOUS
    if not good:
        status = _FRICTION
        for row in range(n):
            if inside[row] == 1 and misfits[row] <= limit:
                status = _OUTSIDE
    return number, status, continuing, misfit, valid


@inlined
def _nearest_fit(misfits: Array, inside: IntArray, n: int, kept: IntArray) -> int:
    """Fill which fit on the map comes nearest; 1, or 0 if there is none."""
    number, best = 0, np.inf
    for row in range(n):
        if inside[row] == 2 and misfits[row] < best:
            kept[0], number, best = row, 1, misfits[row]
    return number


@kernel
def _starts(of: Searched, measured: Array, trail: Trail, x: Array, values: Array) -> int:
    """Fill contacts that about give three quantities, and the one followed so far; how many."""
    found, quality = np.empty((MOST_SEEDS, 3)), np.empty(MOST_SEEDS, np.int64)
    slopes, xi, three = np.empty((MOST_SEEDS, 3, 3)), np.empty(3), np.empty(3)
    for k in range(3):
        three[k] = measured[of.where[k]]
    n = int(seeds(of.tree, three, found, slopes, quality))
    for row in range(n):
        chart_to_contact(of.fold, found[row], xi)
        x[row, 0], x[row, 2], x[row, 3] = xi[0], xi[1], xi[2]
    evaluate(of.rod, x, values, np.empty((0, 6, 3)), 0, n)
    if trail.number[0] > 0 and not near(trail, values, n):
        last = trail.contact[0]
        x[n, 0], x[n, 2], x[n, 3] = last[0], last[1], last[2]
        copy(trail.value[0], values[n])
        n += 1
    return n


@kernel
def _fitted(
    of: Searched,
    how: Weighing,
    passes: int,
    worth: float,
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
    for _ in range(passes):
        for row in range(first, last):
            copy(target, targets[row])
            if not weigh(how, values[row], measured, weights[row]):
                return
        _fit(
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
                if _known(rod, codes, target, weights[row], x, misfits, inside, order[:i], row):
                    misfits[row] = np.inf
                    break
                _fit(
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
def _known(
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
    passes: int,
    limit: float,
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
    _fitted(of, how, passes, limit + INDISTINCT, target, measured, state, n, rows)
    return rows


@inlined
def _chosen(
    x: Array, misfits: Array, inside: IntArray, limit: float, n: int, kept: IntArray
) -> int:
    """Fill which fits explain the measurement and cannot be told apart, the best first."""
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
