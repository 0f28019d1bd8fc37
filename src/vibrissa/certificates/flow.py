"""Validated integration of the rod from the contact to the base.

One step from s₀ to s₀ - h. The Taylor coefficients x_0 … x_{p-1} of all variables are affine forms.
For the remainder an interval box B is proposed; if Σ_{k<p} x_k t^k + t^p x_p(B) ⊂ B for all t in
the step, solutions exist and stay in B, and h^p x_p(B) bounds what the polynomial leaves out (the
*high-order enclosure* of Nedialkov, Jackson and Corliss). x_p(B) comes from the same recursion with
no symbols. The contact's arc length enters through the first step alone, whose length is a form;
later nodes are numbers.

Against wrapping, the remainders of the states are not boxes along the axes, which a rotation would
enlarge step by step, but are carried in symbols of their own (Lohner's parallelepipeds): after each
step the new remainders, small boxes, are taken into these symbols, by stretching the parallelepiped
(or, where its edges have become nearly parallel, by a box along the axes). Remainders
of derivatives by an unknown have symbols of their own; no product joins those of two unknowns.
"""

from __future__ import annotations

import numpy as np

from vibrissa.certificates.equations import ExactRod, Program
from vibrissa.certificates.forms import (
    ROUNDING,
    TINY,
    UP,
    add_multiple,
    add_product,
    clear,
    close,
    copy_row,
    product,
    reciprocal,
)
from vibrissa.numerics import Array, inlined_rigorous, rigorous

#: Outcomes of an integration.
ENCLOSED, NO_ENCLOSURE, TOO_MANY_STEPS = range(3)
_MOST_STEPS = 400
_MOST_TRIALS = 12
# Edges of a parallelepiped are nearly parallel if a pivot of their matrix is less than this.
_PIVOT = 1e-7
# A step ends at the end of a piece if that is nearer than this share of the way.
_NEAR_EDGE = 0.05
# Boxes end at the edges of pieces; only outward rounding may exceed these.
_ROUNDED = 1e-13


@inlined_rigorous
def recursion(program: Program, x: Array, rows: int, order: int) -> None:
    """Taylor coefficients of all variables, of states up to an order, of others up to one less.

    The coefficients of variable v are the rows from v·rows on.
    """
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
                        if x[a * rows + i, last] != 0.0 and x[b * rows + k - i, last] != 0.0:
                            add_product(sign, x, a * rows + i, x, b * rows + k - i, x, row)
                close(x, row, 1.0 if stage == 1 else 1.0 / (k + 1))


@inlined_rigorous
def set_known(
    rod: ExactRod, piece: int, s: Array, x: Array, rows: int, order: int, work: Array
) -> None:
    """Taylor coefficients in t of curvatures and radius, at s - t. Rows of work are spare."""
    n = x.shape[1] - 3
    size = rod.coefficients.shape[2]
    local, scale, spare, row = 0, 1, 2, 3
    for i in range(5 * rows):
        clear(x, i)
    for i in range(4):
        largest = 0.0
        for j in range(size):
            clear(work, row + j)
            work[row + j, 0] = rod.coefficients[piece, i, j, 0]
            work[row + j, n + 1] = rod.coefficients[piece, i, j, 1]
            close(work, row + j, 1.0)
            largest = max(largest, abs(work[row + j, 0]))
        if largest == 0.0:
            continue
        clear(work, scale)
        work[scale, 0], work[scale, n + 1] = rod.local[piece, i, 0, 0], rod.local[piece, i, 0, 1]
        close(work, scale, 1.0)
        clear(work, local)
        work[local, 0], work[local, n + 1] = rod.local[piece, i, 1, 0], rod.local[piece, i, 1, 1]
        work[local, n + 2] = abs(work[local, 0])
        add_product(1.0, work, scale, s, 0, work, local)
        close(work, local, 1.0)
        for k in range(size):
            for j in range(size - 2, k - 1, -1):
                clear(work, spare)
                add_product(1.0, work, local, work, row + j + 1, work, spare)
                add_multiple(1.0, work, row + j, work, spare)
                close(work, spare, 1.0)
                copy_row(work, spare, work, row + j)
        for a in range(n + 1):
            work[scale, a] *= -1.0
        for k in range(1, size):  # by dτ/dt = -scale, k times
            for j in range(k, size):
                product(work, row + j, work, scale, work, spare)
                copy_row(work, spare, work, row + j)
        for k in range(min(size, order + 1)):
            copy_row(work, row + k, x, i * rows + k)
    for k in range(min(size - 1, order)):
        copy_row(x, 3 * rows + k + 1, x, 4 * rows + k)
        close(x, 4 * rows + k, k + 1.0)


@inlined_rigorous
def invert(a: Array, inverse: Array) -> bool:
    """Approximate inverse by Gauss and Jordan, columns scaled; False if nearly singular."""
    n = a.shape[0]
    m = np.empty((n, 2 * n))
    for j in range(n):
        length = 0.0
        for i in range(n):
            length = max(length, abs(a[i, j]))
        if not length > 0.0:
            return False
        for i in range(n):
            m[i, j] = a[i, j] / length
            m[i, n + j] = 1.0 if i == j else 0.0
        inverse[0, j] = length
    for j in range(n):
        best = j
        for i in range(j + 1, n):
            if abs(m[i, j]) > abs(m[best, j]):
                best = i
        if not abs(m[best, j]) > _PIVOT:
            return False
        pivot = 1.0 / m[best, j]
        for k in range(2 * n):
            value = m[best, k]
            m[best, k] = m[j, k]
            m[j, k] = value * pivot
        for i in range(n):
            if i != j:
                factor = m[i, j]
                for k in range(2 * n):
                    m[i, k] -= factor * m[j, k]
    for i in range(n):
        length = inverse[0, i]
        for j in range(n):
            m[i, n + j] /= length
    for i in range(n):
        for j in range(n):
            inverse[i, j] = m[i, n + j]
    return True


@inlined_rigorous
def stretched(
    a: Array, r: Array, basis: Array, inverse: Array, out: Array, left: Array, change: Array
) -> float:
    """Parallelepiped along a basis that contains a ε + r η but for what is left; its size.

    a ε + r η = basis (inverse (a ε + r η)) + (1 - basis inverse) (a ε + r η), whatever the
    matrix ``inverse`` is; the second term, and what rounding loses, goes into ``left``. The new
    symbols ε' are inverse (a ε + r η) over their bounds, which are the first row of ``change``;
    its second row bounds how much the old ε differ from these bounds times ε'.
    """
    n = r.shape[0]
    wide = np.empty(n)
    for i in range(n):
        wide[i] = r[i]
        for j in range(n):
            wide[i] += abs(a[i, j])
        left[i] = 0.0
    for j in range(n):
        fresh = TINY
        for k in range(n):
            fresh += abs(inverse[j, k]) * (r[k] + ROUNDING * wide[k])
        stretch, differs = fresh, fresh
        for column in range(n):
            value = 0.0
            for k in range(n):
                value += inverse[j, k] * a[k, column]
            stretch += abs(value)
            differs += abs(value - 1.0) if column == j else abs(value)
        stretch *= UP
        change[0, j], change[1, j] = stretch, differs * UP
        for i in range(n):
            out[i, j] = basis[i, j] * stretch
            left[i] += ROUNDING * abs(out[i, j]) + TINY
    size = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            defect, magnitude = (-1.0, 1.0) if i == j else (0.0, 0.0)
            for k in range(n):
                defect += basis[i, k] * inverse[k, j]
                magnitude += abs(basis[i, k] * inverse[k, j])
            left[i] += (abs(defect) + ROUNDING * magnitude) * wide[j]
            row += abs(out[i, j])
        left[i] = left[i] * UP
        size += (row + left[i]) / (wide[i] + TINY)
    return size


@inlined_rigorous
def absorb(program: Program, state: Array, unknowns: int) -> None:
    """Take the remainders of all states into the symbols that carry them.

    The derivatives depend on the symbols of the values too, which get a new meaning: these
    coefficients are turned into the new symbols, and where that cannot be done into remainders.
    """
    groups, n = program.groups.shape
    last = state.shape[1] - 1
    a, r = np.empty((n, n)), np.empty(n)
    along, axes, inverse = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    left, left_axes, unit = np.empty(n), np.empty(n), np.eye(n)
    change, unused = np.empty((2, n)), np.empty((2, n))
    for group in range(groups):
        at = 1 + unknowns + (n if group else 0)
        for i in range(n):
            r[i] = state[group * n + i, last - 1]
            for j in range(n):
                a[i, j] = state[group * n + i, at + j]
        size = stretched(a, r, unit, unit, axes, left_axes, unused)
        better = invert(a, inverse) and stretched(a, r, a, inverse, along, left, change) < size
        for i in range(n):
            for j in range(n):
                state[group * n + i, at + j] = along[i, j] if better else axes[i, j]
            state[group * n + i, last - 1] = left[i] if better else left_axes[i]
            close(state, group * n + i, 1.0)
        if group == 0:
            for row in range(n, groups * n):
                for j in range(n):
                    old = state[row, at + j]
                    state[row, at + j] = old * change[0, j] if better else 0.0
                    lost = change[1, j] + ROUNDING * change[0, j] if better else 1.0
                    state[row, last - 1] += abs(old) * lost


@inlined_rigorous
def step_length(program: Program, x: Array, rows: int, order: int, tolerance: float) -> float:
    """Length at which the last Taylor coefficients are a small share of the states."""
    groups, n = program.groups.shape
    size = x.shape[1] - 1
    length = np.inf
    for group in range(groups):
        for half in range(n // 3):
            scale, last, before = 1e-3, 0.0, 0.0
            for i in range(half * 3, half * 3 + 3):
                row = program.groups[group, i] * rows
                scale = max(scale, x[row, size])
                last = max(last, x[row + order - 1, size])
                before = max(before, x[row + order - 2, size])
            if last > 0.0:
                length = min(length, (tolerance * scale / last) ** (1.0 / (order - 1)))
            if before > 0.0:
                length = min(length, (tolerance * scale / before) ** (1.0 / (order - 2)))
    return length


@inlined_rigorous
def remainder(
    program: Program,
    rod: ExactRod,
    piece: int,
    s: Array,
    longest: float,
    x: Array,
    y: Array,
    order: int,
    work: Array,
) -> bool:
    """Bound t^p x_p over a step: magnitudes in the last column of y; False if none is found."""
    rows = order + 1
    last = x.shape[1] - 1
    proposed = np.zeros(program.kind.size)
    for v in range(program.kind.size):
        row = v * rows
        if program.kind[v] == 2:
            expected = x[row + order - 1, last] * longest ** (order - 1)
            proposed[v] = expected + 1e-9 * x[row, last] + 1e-12
    spread = (s[0, last] - abs(s[0, 0])) * UP + ROUNDING * s[0, last]
    where = np.zeros((1, 3))
    where[0, 0] = s[0, 0] - 0.5 * longest
    where[0, 1] = (0.5 * longest + spread) * UP + ROUNDING
    close(where, 0, 1.0)
    set_known(rod, piece, where, y, rows, order, work)
    power = longest**order * UP
    for _ in range(_MOST_TRIALS):
        for v in range(5, program.kind.size):
            if program.kind[v] == 1:
                continue
            row = v * rows
            width = x[row, last] - abs(x[row, 0])
            if program.kind[v] == 2:
                factor = 1.0
                for k in range(1, order):
                    factor *= longest * UP
                    width += x[row + k, last] * factor
                width += proposed[v]
            y[row, 0], y[row, 1], y[row, 2] = x[row, 0], width * UP, 0.0
            close(y, row, 1.0)
        recursion(program, y, rows, order)
        holds = True
        for v in range(program.kind.size):
            if program.kind[v] == 2:
                need = y[v * rows + order, 2] * power * UP
                if not need <= proposed[v]:
                    holds = False
                    proposed[v] = 2.0 * need
                    if not need < 1e6:
                        return False
        if holds:
            return True
    return False


@rigorous
def enclose(
    program: Program,
    rod: ExactRod,
    arc_length: Array,
    load: Array,
    state: Array,
    unknowns: int,
    order: int,
    tolerance: float,
) -> int:
    """Enclose the states at the base, with their derivatives.

    Parameters
    ----------
    program : Program
        Equations.
    rod : ExactRod
        Whisker.
    arc_length : (1, n) array
        Arc length of the contact, a form.
    load : (1, n) array
        Value of the given variable after the known ones, if the equations have one.
    state : (states, n) array
        States of all groups at the contact, forms; that of the derivative by s_c is found. On
        return, the states at the base.
    unknowns : int
        Number of symbols that are unknowns of the box; the others carry remainders.
    order : int
        Order of the Taylor polynomials.
    tolerance : float
        Share of the states to which the last Taylor coefficient falls in a step.

    Returns
    -------
    int
        One of ``ENCLOSED``, ``NO_ENCLOSURE``, ``TOO_MANY_STEPS``.
    """
    last = arc_length.shape[1] - 1
    n = last - 2
    rows = order + 1
    groups, states = program.groups.shape
    x = np.zeros((program.kind.size * rows, last + 1))
    y = np.zeros((program.kind.size * rows, 3))
    work = np.zeros((3 + rod.coefficients.shape[2], last + 1))
    coarse = np.zeros((3 + rod.coefficients.shape[2], 3))
    s, h, spare = arc_length.copy(), np.zeros((1, last + 1)), np.zeros((2, last + 1))
    for table in (x, y):
        end = table.shape[1] - 1
        table[5 * rows, 0], table[5 * rows, end] = 1.0, 1.0
        table[6 * rows, 0], table[6 * rows, end - 1] = rod.twist
        close(table, 6 * rows, 1.0)
    g = 7
    if program.kind[7] == 0:
        g = 8
        copy_row(load, 0, x, 7 * rows)
    piece = rod.edges.shape[0] - 2
    while piece > 0 and rod.edges[piece] >= s[0, 0]:
        piece -= 1
    spread = (s[0, last] - abs(s[0, 0])) * UP
    beyond = max(rod.edges[piece] - s[0, 0], s[0, 0] - rod.edges[piece + 1]) + spread
    if beyond > _ROUNDED:  # contacts on both sides of an edge have different equations
        return NO_ENCLOSURE
    for steps in range(_MOST_STEPS):
        set_known(rod, piece, s, x, rows, order, work)
        if not reciprocal(x, 3 * rows, x, g * rows):
            return NO_ENCLOSURE
        for group in range(groups):
            for i in range(states):
                copy_row(state, group * states + i, x, program.groups[group, i] * rows)
        if steps == 0:  # the contact moves and the load with it: the derivative starts as dx/dt
            recursion(program, x, rows, 1)
            for i in range(states):
                row = program.groups[0, i] * rows + 1
                copy_row(x, row, x, program.groups[1, i] * rows)
        recursion(program, x, rows, order - 1)
        wide = 1.5 * (s[0, last] - abs(s[0, 0]))
        node = s[0, 0] - max(step_length(program, x, rows, order, tolerance), wide)
        edge = rod.edges[piece]
        done = node < edge + _NEAR_EDGE * (s[0, 0] - edge)
        if done:
            node = edge
        copy_row(s, 0, h, 0)
        h[0, 0] = s[0, 0] - node
        h[0, n + 1] += ROUNDING
        close(h, 0, 1.0)
        longest = h[0, last]
        if not remainder(program, rod, piece, s, longest, x, y, order, coarse):
            return NO_ENCLOSURE
        power = longest**order * UP
        for group in range(groups):
            for i in range(states):
                row, to = program.groups[group, i] * rows, group * states + i
                copy_row(x, row + order - 1, state, to)
                for k in range(order - 2, -1, -1):
                    clear(spare, 0)
                    add_product(1.0, state, to, h, 0, spare, 0)
                    add_multiple(1.0, x, row + k, spare, 0)
                    close(spare, 0, 1.0)
                    copy_row(spare, 0, state, to)
                state[to, n + 1] += y[row + order, 2] * power * UP
                close(state, to, 1.0)
        if n > unknowns:
            absorb(program, state, unknowns)
        clear(s, 0)
        s[0, 0] = node
        close(s, 0, 1.0)
        if done:
            if piece == 0:
                return ENCLOSED
            piece -= 1
    return TOO_MANY_STEPS
