"""Affine forms: numbers with their dependence on a box of unknowns, rounded outward.

A form with N symbols is a row of N + 3 numbers (c, a_1 … a_N, r, t) of a table. It stands for

    c + Σ a_i ε_i + r η,    -1 ≤ ε_i ≤ 1,  -1 ≤ η ≤ 1,

where the symbols ε_i are shared by all forms of a box (its unknowns, and remainders that are
carried along) and η belongs to the form alone. t ≥ |c| + Σ|a_i| + r is its size.

Rounding. All is IEEE 754 double precision, to nearest, u = 2⁻⁵³; results are not rounded outward
one by one, but r grows by a bound on all that was lost. A sum of m products of forms, z = Σ x y,
takes at most m + 6 roundings for each of its coefficients, so that these and r are together wrong
by at most (m + 6) u Σ t_x t_y (1 + 10⁻¹²). ``ROUNDING`` is 200 u: enough for m ≤ `TERMS` = 128
terms, also where a bound on t has itself been rounded. Underflow is covered by ``TINY``. Sizes are
rounded up by ``UP``, which covers sums of up to 40 terms.
"""

from __future__ import annotations

from vibrissa.numerics import Array, inlined_rigorous

#: Terms that a sum of products may have.
TERMS = 128
ROUNDING = 2.3e-14
UP = 1.0 + 1e-14
TINY = 1e-290


@inlined_rigorous
def clear(z: Array, k: int) -> None:
    """Set row k to zero."""
    for i in range(z.shape[1]):
        z[k, i] = 0.0


@inlined_rigorous
def copy_row(x: Array, i: int, z: Array, k: int) -> None:
    """Copy a form."""
    for j in range(z.shape[1]):
        z[k, j] = x[i, j]


@inlined_rigorous
def add_product(sign: float, x: Array, i: int, y: Array, j: int, z: Array, k: int) -> None:
    """z_k += ±x_i·y_j, not yet closed: its last number collects the sizes of the terms."""
    n = x.shape[1] - 3
    x0, y0 = sign * x[i, 0], y[j, 0]
    signed = sign * y0
    z[k, 0] += x0 * y0
    for a in range(1, n + 1):
        z[k, a] += x0 * y[j, a] + signed * x[i, a]
    big_x, big_y = abs(x0), abs(y0)
    size_x, size_y = x[i, n + 2], y[j, n + 2]
    z[k, n + 1] += big_x * y[j, n + 1] + big_y * x[i, n + 1] + (size_x - big_x) * (size_y - big_y)
    z[k, n + 2] += size_x * size_y


@inlined_rigorous
def add_multiple(factor: float, x: Array, i: int, z: Array, k: int) -> None:
    """z_k += factor·x_i, not yet closed."""
    n = x.shape[1] - 3
    for a in range(n + 1):
        z[k, a] += factor * x[i, a]
    z[k, n + 1] += abs(factor) * x[i, n + 1]
    z[k, n + 2] += abs(factor) * x[i, n + 2]


@inlined_rigorous
def close(z: Array, k: int, factor: float) -> None:
    """Multiply a finished sum by a factor > 0, add what rounding has lost, find the size."""
    n = z.shape[1] - 3
    size = factor * (z[k, n + 1] + ROUNDING * z[k, n + 2]) + TINY
    z[k, n + 1] = size
    for a in range(n + 1):
        z[k, a] *= factor
        size += abs(z[k, a])
    z[k, n + 2] = size * UP


@inlined_rigorous
def product(x: Array, i: int, y: Array, j: int, z: Array, k: int) -> None:
    """z_k = x_i·y_j; z_k is another row than these."""
    clear(z, k)
    add_product(1.0, x, i, y, j, z, k)
    close(z, k, 1.0)


@inlined_rigorous
def reciprocal(x: Array, i: int, z: Array, k: int) -> bool:
    """z_k = 1/x_i by the tangent at the centre; False where x_i may be zero or less."""
    n = x.shape[1] - 3
    c = x[i, 0]
    spread = (x[i, n + 2] - abs(c)) * UP + ROUNDING * x[i, n + 2]
    least = (c - spread) * (2.0 - UP)
    if not least > 0.0:
        return False
    slope = 1.0 / (c * c)
    z[k, 0] = 1.0 / c
    for a in range(1, n + 1):
        z[k, a] = -slope * x[i, a]
    z[k, n + 1] = slope * x[i, n + 1] + spread * spread * slope / least
    z[k, n + 2] = 1.0 / least + z[k, n + 1]
    close(z, k, 1.0)
    return True
