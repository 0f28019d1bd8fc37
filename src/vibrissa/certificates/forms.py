"""Taylor models: numbers and their dependence on a box of unknowns, rounded outward.

A form is a polynomial of degree ``DEGREE`` in the unknowns ε_i of a box and a remainder,

    Σ_α a_α ε^α + r η,    -1 ≤ ε_i ≤ 1,  -1 ≤ η ≤ 1,

where the ε_i are shared by all forms of a box and η belongs to one form alone. A form is a row of a
table: the coefficients a_α by degree, r, for each d the sum C_d of |a_α| over degrees up to d, and
its size t ≥ C_q + r. Forms without unknowns are centres and radii, of degree 0. `LANES` boxes are
computed together: tables are (rows, columns, lanes).

Rounding. All arithmetic is IEEE 754 double precision, to nearest, u = 2⁻⁵³; results are not rounded
outward one by one, but r grows by a bound on all rounding errors. A coefficient of a product of two
forms is a sum of at most 8 products of coefficients; one of a sum of m such products takes at most
8 m + 6 roundings (multiplication and addition may be fused, which saves one). All |a_α b_β|
together are at most t_x t_y, so that the error of all coefficients together is at most
(8 m + 6) u Σ t_x t_y (1 + 10⁻¹²). The omitted products of degrees above q are bounded by
t_x t_y - Σ_d (C_d - C_{d-1})(x) C_{q-d}(y), remainders included, with an error of at most
20 u t_x t_y per term. ``ROUNDING`` is 1080 u: enough for m ≤ 128, also where a bound on t
has itself been rounded. Underflow is covered by ``TINY``. Sizes are rounded up by ``UP``, which
covers sums of up to 80 terms.
"""

from __future__ import annotations

from itertools import product as combinations
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from vibrissa.numerics import Array, inlined_rigorous

LANES = 8
DEGREE = 3
ROUNDING = 1.2e-13
UP = 1.0 + 2e-14
TINY = 1e-290


def monomials(unknowns: int, degree: int) -> list[tuple[int, ...]]:
    """Exponents of all monomials, by degree; linear ones in the order of the unknowns."""
    exponents = combinations(range(degree + 1), repeat=unknowns)
    return sorted(
        (e for e in exponents if sum(e) <= degree), key=lambda e: (sum(e), [-x for x in e])
    )


def columns(unknowns: int) -> int:
    """Number of columns of a table of forms."""
    degree = DEGREE if unknowns else 0
    return len(monomials(unknowns, degree)) + degree + 3


def _pure_powers(unknowns: int) -> Any:
    """Columns (unknowns, DEGREE + 1) of the powers of each unknown by itself."""
    rows = monomials(unknowns, DEGREE)
    axes = np.eye(unknowns, dtype=int)
    return np.array([[rows.index(tuple(k * a)) for k in range(DEGREE + 1)] for a in axes])


PURE_2, PURE_3 = _pure_powers(2), _pure_powers(3)
_ENDS = [[len(monomials(n, d)) for d in range(DEGREE + 1)] for n in (2, 3)]
_ENDS_2, _ENDS_3 = np.array(_ENDS[0]), np.array(_ENDS[1])
COLUMNS_0, COLUMNS_2, COLUMNS_3 = columns(0), columns(2), columns(3)


def _multiplier(unknowns: int) -> Any:
    """Compile z_k += sign x_i y_j, all lanes at once, for forms in ``unknowns`` unknowns."""
    degree = DEGREE if unknowns else 0
    rows = monomials(unknowns, degree)
    number, width = len(rows), columns(unknowns)
    parts = [
        [
            (rows.index(a), rows.index(b))
            for a in rows
            for b in rows
            if tuple(p + q for p, q in zip(a, b, strict=True)) == one
        ]
        for one in rows
    ]
    lanes = ir.VectorType(ir.DoubleType(), LANES)

    @intrinsic
    def multiply(_: Any, sign: Any, x: Any, i: Any, y: Any, j: Any, z: Any, k: Any) -> Any:
        if {table.layout for table in (x, y, z)} != {"C"}:
            raise TypeError("tables of forms are contiguous")

        def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            def row(table: int) -> list[Any]:
                array = context.make_array(signature.args[table])(context, builder, given[table])
                start = builder.mul(given[table + 1], ir.IntType(64)(width * LANES))
                at = (builder.add(start, ir.IntType(64)(c * LANES)) for c in range(width))
                return [
                    builder.bitcast(builder.gep(array.data, [a]), lanes.as_pointer()) for a in at
                ]

            def load(pointer: Any) -> Any:
                return builder.load(pointer, align=8)

            def plus(total: Any, a: Any, b: Any) -> Any:
                fused = ("contract",)
                return builder.fadd(total, builder.fmul(a, b, flags=fused), flags=fused)

            left, right, out = row(1), row(3), row(5)
            a, b, total = ([load(pointer) for pointer in one] for one in (left, right, out))
            signs = ir.Constant(lanes, ir.Undefined)
            for lane in range(LANES):
                signs = builder.insert_element(signs, given[0], ir.IntType(32)(lane))
            signed = [builder.fmul(one, signs) for one in a[:number]]
            for c, pairs in enumerate(parts):
                for p, q in pairs:
                    total[c] = plus(total[c], signed[p], b[q])
            size = builder.fmul(a[-1], b[-1])
            left_out, below = size, None
            for d in range(degree + 1):
                up_to = a[number + 1 + d]
                share = up_to if below is None else builder.fsub(up_to, below)
                below = up_to
                kept = builder.fmul(share, b[number + 1 + degree - d])
                left_out = builder.fsub(left_out, kept)
            total[number] = builder.fadd(total[number], left_out)
            total[-1] = builder.fadd(total[-1], size)
            for c in (*range(number + 1), width - 1):
                builder.store(total[c], out[c], align=8)
            return context.get_dummy_value()

        return types.void(sign, x, i, y, j, z, k), generate

    return multiply


_multiply_0, _multiply_2, _multiply_3 = _multiplier(0), _multiplier(2), _multiplier(3)


@inlined_rigorous
def add_product(sign: float, x: Array, i: int, y: Array, j: int, z: Array, k: int) -> None:
    """z_k += ±x_i·y_j, to be closed afterwards: the last column collects the terms' sizes."""
    if x.shape[1] == COLUMNS_3:
        _multiply_3(sign, x, i, y, j, z, k)
    elif x.shape[1] == COLUMNS_2:
        _multiply_2(sign, x, i, y, j, z, k)
    else:
        _multiply_0(sign, x, i, y, j, z, k)


@inlined_rigorous
def coefficients(x: Array) -> int:
    """Number of coefficients of the forms of a table; the remainder follows them."""
    return 1 if x.shape[1] == COLUMNS_0 else int(x.shape[1] - DEGREE - 3)


@inlined_rigorous
def clear(z: Array, k: int) -> None:
    """Set row k to zero."""
    for i in range(z.shape[1]):
        for lane in range(LANES):
            z[k, i, lane] = 0.0


@inlined_rigorous
def copy_row(x: Array, i: int, z: Array, k: int) -> None:
    """Copy a form."""
    for j in range(z.shape[1]):
        for lane in range(LANES):
            z[k, j, lane] = x[i, j, lane]


@inlined_rigorous
def add_multiple(factor: float, x: Array, i: int, z: Array, k: int) -> None:
    """z_k += factor·x_i, to be closed afterwards."""
    n, last = coefficients(x), x.shape[1] - 1
    for a in range(n):
        for lane in range(LANES):
            z[k, a, lane] += factor * x[i, a, lane]
    for lane in range(LANES):
        z[k, n, lane] += abs(factor) * x[i, n, lane]
        z[k, last, lane] += abs(factor) * x[i, last, lane]


@inlined_rigorous
def close(z: Array, k: int, factor: float) -> None:
    """Multiply a completed sum by a factor > 0, add the rounding error, and compute the sizes."""
    n, last = coefficients(z), z.shape[1] - 1
    for lane in range(LANES):
        z[k, n, lane] = factor * (z[k, n, lane] + ROUNDING * z[k, last, lane]) + TINY
        z[k, last, lane] = 0.0
    first = 0
    for d in range(last - n - 1):
        end = 1
        if z.shape[1] == COLUMNS_3:
            end = _ENDS_3[d]
        elif z.shape[1] == COLUMNS_2:
            end = _ENDS_2[d]
        for a in range(first, end):
            for lane in range(LANES):
                z[k, a, lane] *= factor
                z[k, last, lane] += abs(z[k, a, lane])
        for lane in range(LANES):
            z[k, n + 1 + d, lane] = z[k, last, lane]
        first = end
    for lane in range(LANES):
        z[k, last, lane] = (z[k, last, lane] + z[k, n, lane]) * UP


@inlined_rigorous
def product(x: Array, i: int, y: Array, j: int, z: Array, k: int) -> None:
    """z_k = x_i·y_j; z_k must be another row than these."""
    clear(z, k)
    add_product(1.0, x, i, y, j, z, k)
    close(z, k, 1.0)


@inlined_rigorous
def reciprocal(x: Array, i: int, z: Array, k: int, work: Array) -> None:
    """z_k = 1/x_i by its series about the centre; NaN where x_i may be zero or negative.

    With x = c (1 - δ): 1/x = Σ_{d≤q} δ^d / c + δ^{q+1} / (c (1 - δ)). Uses three rows of ``work``.
    """
    n, last = coefficients(x), x.shape[1] - 1
    delta, power, total = 0, 1, 2
    clear(work, power)
    clear(work, total)
    for lane in range(LANES):
        inverse = 1.0 / x[i, 0, lane] if x[i, 0, lane] > 0.0 else np.nan
        work[total, 0, lane] = inverse
        work[total, last, lane] = abs(inverse)
        work[delta, 0, lane] = 0.0
        for a in range(1, n):
            work[delta, a, lane] = -x[i, a, lane] * inverse
        work[delta, n, lane] = x[i, n, lane] * inverse
        work[delta, last, lane] = x[i, last, lane] * inverse  # covers one more division and product
    close(work, delta, 1.0)
    close(work, total, 1.0)
    copy_row(work, total, work, power)
    for _ in range(last - n - 2):
        product(work, power, work, delta, z, k)
        copy_row(z, k, work, power)
        add_multiple(1.0, z, k, work, total)
        close(work, total, 1.0)
    product(work, power, work, delta, z, k)
    for lane in range(LANES):
        size = work[delta, last, lane]
        rest = z[k, last, lane] / (1.0 - size) * UP if size < 0.9 else np.nan
        work[total, n, lane] += rest
    close(work, total, 1.0)
    copy_row(work, total, z, k)
