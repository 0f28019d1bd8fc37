"""Small linear systems, Cholesky factors, angles and orders for use in kernels."""

from __future__ import annotations

import numpy as np

from vibrissa.numerics.arrays import Array, IntArray
from vibrissa.numerics.compiled import inlined

# Smallest share of a variance that other coordinates leave unexplained; below, it is singular.
_SINGULAR = 1e-14


@inlined
def wrapped(angle: float) -> float:
    """Angle in [-π, π]."""
    return float(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))


@inlined
def quick_exp(x: float) -> float:
    """Exponential, accurate to one part in 10⁷ from -20 to 20; loops over it vectorise."""
    power = max(x, -700.0) / 4096.0
    power = 1.0 + power * (1.0 + power * (0.5 + power / 6.0))
    for _ in range(12):  # 4096 = 2¹²
        power *= power
    return power


@inlined
def norm3(v: Array) -> float:
    """Euclidean length."""
    return float(np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]))


@inlined
def solve3(a: Array, r: Array, x: Array) -> float:
    """Solve a x = r by Cramer's rule; return det a (if it is 0, x is not set)."""
    c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    det = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
    if det != 0.0:
        inverse = 1.0 / det
        x[0] = inverse * (
            c0 * r[0]
            + (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]) * r[1]
            + (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]) * r[2]
        )
        x[1] = inverse * (
            c1 * r[0]
            + (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]) * r[1]
            + (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]) * r[2]
        )
        x[2] = inverse * (
            c2 * r[0]
            + (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1]) * r[1]
            + (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) * r[2]
        )
    return float(det)


@inlined
def solve(a: Array, x: Array) -> float:
    """Solve a y = x in place, with pivoting (y in x; a is overwritten); return det a."""
    n, det = x.shape[0], 1.0
    for c in range(n):
        pivot = c
        for r in range(c + 1, n):
            if abs(a[r, c]) > abs(a[pivot, c]):
                pivot = r
        if pivot != c:
            det = -det
            for k in range(n):
                a[c, k], a[pivot, k] = a[pivot, k], a[c, k]
            x[c], x[pivot] = x[pivot], x[c]
        det *= a[c, c]
        if a[c, c] == 0.0:
            return 0.0
        for r in range(c + 1, n):
            factor = a[r, c] / a[c, c]
            for k in range(c, n):
                a[r, k] -= factor * a[c, k]
            x[r] -= factor * x[c]
    for c in range(n - 1, -1, -1):
        for k in range(c + 1, n):
            x[c] -= a[c, k] * x[k]
        x[c] /= a[c, c]
    return det


@inlined
def cholesky(v: Array, root: Array) -> bool:
    """Fill the lower Cholesky factor of a covariance, possibly in place; False if singular."""
    for a in range(v.shape[0]):
        for c in range(a + 1):
            total = v[a, c]
            for i in range(c):
                total -= root[a, i] * root[c, i]
            if a > c:
                root[a, c] = total / root[c, c]
            elif total > _SINGULAR * v[a, a]:
                root[a, a] = np.sqrt(total)
            else:
                return False
    return True


@inlined
def forward(root: Array, x: Array) -> None:
    """Solve root y = x in place for a lower triangular root."""
    for a in range(x.shape[0]):
        for c in range(a):
            x[a] -= root[a, c] * x[c]
        x[a] /= root[a, a]


@inlined
def solve_root(root: Array, x: Array) -> None:
    """Solve root rootᵀ y = x in place for a lower triangular root."""
    forward(root, x)
    for a in range(x.shape[0] - 1, -1, -1):
        for c in range(a + 1, x.shape[0]):
            x[a] -= root[c, a] * x[c]
        x[a] /= root[a, a]


@inlined
def mahalanobis(root: Array, x: Array) -> float:
    """Squared Mahalanobis distance of x for the Cholesky factor of a covariance; overwrites x."""
    forward(root, x)
    total = 0.0
    for a in range(x.shape[0]):
        total += x[a] * x[a]
    return total


@inlined
def order_of(values: Array) -> IntArray:
    """Indices that sort a few values, smallest first and NaN last."""
    order = np.empty(values.shape[0], np.int64)
    for i in range(values.shape[0]):
        k = i
        while k > 0 and (
            values[order[k - 1]] > values[i]
            or (np.isnan(values[order[k - 1]]) and not np.isnan(values[i]))
        ):
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    return order
