"""Validated integration of the rod from the contact to the base.

In a step from s₀ to s₀ - h, the Taylor coefficients x_0 … x_{p-1} of all variables are forms: their
polynomials represent the dependence on the unknowns, so that remainders, which a rotation enlarges
step by step, contain only terms of high degree. For the remainder of the step an interval box B is
proposed; if Σ_{k<p} x_k t^k + t^p x_p(B) ⊂ B for all t in the step, solutions exist and stay in B,
and h^p x_p(B) bounds the terms omitted by the polynomial (the *high-order enclosure* of Nedialkov,
Jackson and Corliss). x_p(B) is computed by the same recursion without unknowns. The contact's arc
length enters through the first step alone, whose length is a form; later nodes are numbers. Each of
the `LANES` boxes has its own steps; a box that has reached the end of a piece takes steps of zero
length until the others have too.
"""

from __future__ import annotations

import numpy as np

from vibrissa.certificates.equations import ExactRod, Program
from vibrissa.certificates.forms import (
    LANES,
    ROUNDING,
    UP,
    add_multiple,
    add_product,
    clear,
    close,
    coefficients,
    copy_row,
    product,
    reciprocal,
)
from vibrissa.numerics import AnyArray, Array, inlined_rigorous

_MOST_STEPS = 400
_MOST_TRIALS = 12
_NEAR_EDGE = 0.05  # a step is extended to the end of a piece if less than this share would remain
# Rows of given variables: after the three curvatures the radius, its slope, one, and the twist.
_RADIUS, _SLOPE, _ONE, _TWIST = range(3, 7)


@inlined_rigorous
def recursion(program: Program, x: Array, rows: int, order: int) -> None:
    """Compute Taylor coefficients, rows from v·rows: of states up to ``order``, else one less."""
    last = x.shape[1] - 1
    for k in range(order):
        for stage in (1, 2):
            for v in range(program.kind.size):
                if program.kind[v] != stage:
                    continue
                row = v * rows + k + stage - 1
                clear(x, row)
                for o in range(program.first[v], program.first[v + 1]):
                    a, b, sign = program.left[o], program.right[o], program.sign[o]
                    low = k if program.constant[b] else 0
                    high = 0 if program.constant[a] else k
                    for i in range(low, high + 1):
                        # A closed form has a nonzero size; any other is zero in all lanes.
                        if x[a * rows + i, last, 0] != 0.0 and x[b * rows + k - i, last, 0] != 0.0:
                            add_product(sign, x, a * rows + i, x, b * rows + k - i, x, row)
                close(x, row, 1.0 if stage == 1 else 1.0 / (k + 1))


@inlined_rigorous
def set_number(value: float, spread: float, z: Array, k: int) -> None:
    """Set a row to a number with an uncertainty, in all lanes."""
    n = coefficients(z)
    clear(z, k)
    for lane in range(LANES):
        z[k, 0, lane], z[k, n, lane] = value, spread
        z[k, z.shape[1] - 1, lane] = abs(value)
    close(z, k, 1.0)


@inlined_rigorous
def set_rod_coefficients(
    rod: ExactRod, piece: int, s: Array, x: Array, rows: int, order: int, work: Array
) -> None:
    """Compute Taylor coefficients in t of curvatures and radius at s - t; ``work`` is scratch."""
    size = rod.coefficients.shape[2]
    local, scale, spare, row = 0, 1, 2, 3
    for i in range(5 * rows):
        clear(x, i)
    for i in range(4):
        largest = 0.0
        for j in range(size):
            middle, radius = rod.coefficients[piece, i, j, 0], rod.coefficients[piece, i, j, 1]
            set_number(middle, radius, work, row + j)
            largest = max(largest, abs(middle))
        if largest == 0.0:
            continue
        set_number(rod.local[piece, i, 0, 0], rod.local[piece, i, 0, 1], work, scale)
        set_number(rod.local[piece, i, 1, 0], rod.local[piece, i, 1, 1], work, local)
        add_product(1.0, work, scale, s, 0, work, local)
        close(work, local, 1.0)
        for k in range(size):
            for j in range(size - 2, k - 1, -1):
                clear(work, spare)
                add_product(1.0, work, local, work, row + j + 1, work, spare)
                add_multiple(1.0, work, row + j, work, spare)
                close(work, spare, 1.0)
                copy_row(work, spare, work, row + j)
        for lane in range(LANES):
            work[scale, 0, lane] *= -1.0
        for k in range(1, size):  # multiply by dτ/dt = -scale, k times
            for j in range(k, size):
                product(work, row + j, work, scale, work, spare)
                copy_row(work, spare, work, row + j)
        for k in range(min(size, order + 1)):
            copy_row(work, row + k, x, i * rows + k)
    for k in range(min(size - 1, order)):
        copy_row(x, _RADIUS * rows + k + 1, x, _SLOPE * rows + k)
        close(x, _SLOPE * rows + k, k + 1.0)


@inlined_rigorous
def step_length(
    program: Program, x: Array, lane: int, rows: int, order: int, tolerance: float
) -> float:
    """Step length at which the last Taylor coefficients are a small share of the states."""
    groups, n = program.groups.shape
    size = x.shape[1] - 1
    length = np.inf
    for group in range(groups):
        for half in range(n // 3):
            scale, last, before = 1e-3, 0.0, 0.0
            for i in range(half * 3, half * 3 + 3):
                row = program.groups[group, i] * rows
                scale = max(scale, x[row, size, lane])
                last = max(last, x[row + order - 1, size, lane])
                before = max(before, x[row + order - 2, size, lane])
            if last > 0.0:
                length = min(length, (tolerance * scale / last) ** (1.0 / (order - 1)))
            if before > 0.0:
                length = min(length, (tolerance * scale / before) ** (1.0 / (order - 2)))
    return length


@inlined_rigorous
def propose(
    program: Program, x: Array, y: Array, rows: int, order: int, longest: Array, proposed: Array
) -> None:
    """Set the first rows of y to the ranges over a step, including the proposed remainders."""
    last = x.shape[1] - 1
    for v in range(_ONE, program.kind.size):
        if program.kind[v] == 1:
            continue
        row = v * rows
        for lane in range(LANES):
            width = x[row, last, lane] - abs(x[row, 0, lane])
            if program.kind[v] == 2:
                factor = 1.0
                for k in range(1, order):
                    factor *= longest[lane] * UP
                    width += x[row + k, last, lane] * factor
                width += proposed[v, lane]
            y[row, 0, lane], y[row, 1, lane] = x[row, 0, lane], width * UP
            y[row, 3, lane] = x[row, last, lane]
        close(y, row, 1.0)


@inlined_rigorous
def remainder(
    program: Program,
    rod: ExactRod,
    piece: int,
    s: Array,
    longest: Array,
    x: Array,
    y: Array,
    order: int,
    work: Array,
    failed: AnyArray,
    rest: Array,
) -> None:
    """Bound t^p x_p over a step, (variables, lanes) in ``rest``; mark lanes that have no bound."""
    rows = order + 1
    last = x.shape[1] - 1
    where, power = np.zeros((1, 4, LANES)), np.ones(LANES)
    for lane in range(LANES):
        for _k in range(1, order):
            power[lane] *= longest[lane] * UP
        for v in range(program.kind.size):
            row = v * rows
            expected = x[row + order - 1, last, lane] * power[lane]
            rest[v, lane] = expected + 1e-9 * x[row, last, lane] + 1e-12
        power[lane] *= longest[lane] * UP
        spread = (s[0, last, lane] - abs(s[0, 0, lane])) * UP + ROUNDING * s[0, last, lane]
        where[0, 0, lane] = s[0, 0, lane] - 0.5 * longest[lane]
        where[0, 1, lane] = (0.5 * longest[lane] + spread) * UP + ROUNDING
    close(where, 0, 1.0)
    set_rod_coefficients(rod, piece, where, y, rows, order, work)
    holds = np.zeros(LANES, dtype=np.bool_)
    for _ in range(_MOST_TRIALS):
        propose(program, x, y, rows, order, longest, rest)
        recursion(program, y, rows, order)
        every = True
        for lane in range(LANES):
            holds[lane] = True
            for v in range(program.kind.size):
                if program.kind[v] != 2 or failed[lane]:
                    continue
                need = y[v * rows + order, 3, lane] * power[lane] * UP
                if not need <= rest[v, lane]:
                    holds[lane] = every = False
                    rest[v, lane] = 2.0 * need
                    failed[lane] = not need < 1e6
        if every:
            break
    for lane in range(LANES):
        failed[lane] = failed[lane] or not holds[lane]
        for v in range(program.kind.size):
            rest[v, lane] = y[v * rows + order, 3, lane] * power[lane] * UP


@inlined_rigorous
def first_piece(rod: ExactRod, s: float) -> int:
    """Index of the piece that contains a contact; at an end, the proximal one."""
    piece = int(rod.edges.shape[0] - 2)
    while piece > 0 and rod.edges[piece] >= s:
        piece -= 1
    return piece


@inlined_rigorous
def choose_nodes(
    program: Program,
    x: Array,
    rows: int,
    order: int,
    tolerance: float,
    edge: float,
    s: Array,
    h: Array,
    failed: AnyArray,
) -> bool:
    """Choose the next node of each lane; return whether all are at the end of the piece.

    The steps are written to h, the nodes to s. A step is at least 1.5 times the spread of the
    contacts' arc lengths, and ends with the piece.
    """
    n, last = coefficients(x), x.shape[1] - 1
    copy_row(s, 0, h, 0)
    clear(s, 0)
    done = True
    for lane in range(LANES):
        at = h[0, 0, lane]
        wide = 1.5 * (h[0, last, lane] - abs(at))
        node = at - max(step_length(program, x, lane, rows, order, tolerance), wide)
        if failed[lane] or node < edge + _NEAR_EDGE * (at - edge):
            node = edge
        done = done and node == edge
        s[0, 0, lane] = node
        h[0, 0, lane] = 0.0 if failed[lane] else at - node
        h[0, n, lane] += ROUNDING
    close(h, 0, 1.0)
    return done


@inlined_rigorous
def advance(
    program: Program, x: Array, rows: int, order: int, h: Array, rest: Array, state: Array
) -> None:
    """States at the end of a step: the polynomials by Horner's scheme, plus the remainders."""
    groups, states = program.groups.shape
    spare = np.zeros((1, x.shape[1], LANES))
    for group in range(groups):
        for i in range(states):
            v, to = program.groups[group, i], group * states + i
            copy_row(x, v * rows + order - 1, state, to)
            for k in range(order - 2, -1, -1):
                clear(spare, 0)
                add_product(1.0, state, to, h, 0, spare, 0)
                add_multiple(1.0, x, v * rows + k, spare, 0)
                close(spare, 0, 1.0)
                copy_row(spare, 0, state, to)
            for lane in range(LANES):
                state[to, coefficients(x), lane] += rest[v, lane]
            close(state, to, 1.0)


@inlined_rigorous
def enclose(
    program: Program,
    rod: ExactRod,
    piece: int,
    arc_length: Array,
    load: Array,
    state: Array,
    order: int,
    tolerance: float,
) -> None:
    """Enclose the states at the base, with their derivatives; NaN where this fails.

    The contacts' arc lengths (1, columns, lanes) are in one piece; ``load`` is the given variable
    after the common ones, if the equations have one. ``state`` (states, columns, lanes) contains on
    entry the states of all groups at the contact, except the derivative by s_c, which is computed;
    on return the states at the base. ``order`` is that of the Taylor polynomials, ``tolerance`` the
    ratio of the last coefficient to the states that determines a step.
    """
    width, rows, size = arc_length.shape[1], order + 1, program.kind.size
    groups, states = program.groups.shape
    x, y = np.zeros((size * rows, width, LANES)), np.zeros((size * rows, 4, LANES))
    work = np.zeros((3 + rod.coefficients.shape[2], width, LANES))
    coarse = np.zeros((3 + rod.coefficients.shape[2], 4, LANES))
    s, h = arc_length.copy(), np.zeros((1, width, LANES))
    failed, rest = np.zeros(LANES, dtype=np.bool_), np.zeros((size, LANES))
    for table in (x, y):
        set_number(1.0, 0.0, table, _ONE * rows)
        set_number(rod.twist[0], rod.twist[1], table, _TWIST * rows)
    g = _TWIST + 1
    if program.kind[g] == 0:
        copy_row(load, 0, x, g * rows)
        g += 1
    has_started = False
    for _ in range(_MOST_STEPS):
        set_rod_coefficients(rod, piece, s, x, rows, order, work)
        reciprocal(x, _RADIUS * rows, x, g * rows, work)
        for group in range(groups):
            for i in range(states):
                copy_row(state, group * states + i, x, program.groups[group, i] * rows)
        if (
            not has_started
        ):  # the contact moves and the load with it: the derivative starts as dx/dt
            recursion(program, x, rows, 1)
            for i in range(states):
                row = program.groups[0, i] * rows + 1
                copy_row(x, row, x, program.groups[1, i] * rows)
            has_started = True
        recursion(program, x, rows, order - 1)
        copy_row(s, 0, work, 0)
        done = choose_nodes(program, x, rows, order, tolerance, rod.edges[piece], s, h, failed)
        remainder(program, rod, piece, work[:1], h[0, width - 1], x, y, order, coarse, failed, rest)
        advance(program, x, rows, order, h, rest, state)
        close(s, 0, 1.0)
        if done:
            piece -= 1
        if piece < 0:
            break
    for lane in range(LANES):
        if failed[lane] or piece >= 0:
            state[:, :, lane] = np.nan
