"""Interpolation of base force and contact point between the nodes of a chart.

It is fifteen times as fast as integrating the rod. In each cell (F, p) is a blend of the cubics
along the cell's twelve edges that have the values and slopes of the nodes, as in
:mod:`vibrissa.rod.tree`. With l the linear and φ and χ the two Hermite weights of a corner's side
along an axis, and g = φ - l, a corner contributes

    (l l l + g l l + l g l + l l g) v + χ l l ∂v/∂η + l χ l ∂v/∂ψ + l l χ ∂v/∂ρ,

the three factors of a product belonging to η, ψ and ρ. All cubics are reproduced. Differences
between neighbouring contacts are accurate to about one part in a thousand: enough to explore the
uncertainty of a contact, not to locate it.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array, Vector, inlined, vectorised
from vibrissa.rod.chart import Fold, StableSet, along, log_fold_force
from vibrissa.rod.discretization import Rod

_PADDED = 8  # (F, p) and two of padding, for vectorisation
# Vectorisation needs one flat buffer: a corner's four rows, then the sums of values and slopes.
_SUMS = 4 * _PADDED
# Range of validity: ρ from one cell above rest, where the bearing is ill-defined, to slightly
# beyond the fold; η from slightly below the smallest arc length. Beyond the chart the outermost
# cells are extrapolated.
_LEAST, _MOST, _BEFORE = 1.0 / 16.0, 1.02, 1.0 / 32.0


class Charted(NamedTuple):
    """A rod with its chart, for the kernels."""

    rod: Rod
    fold: Fold
    nodes: Array  # (i, j, k, 32), from `interpolant`


@lru_cache(maxsize=16)
def interpolant(chart: StableSet) -> Array:
    """(F, p) at the chart's nodes, and its derivatives in cells along η, ψ, ρ: (i, j, k, 32)."""
    size = np.array([1.0, 2.0 * np.pi, 1.0]) / (np.array(chart.values.shape[:3]) - 1)
    nodes = np.zeros((*chart.values.shape[:3], 4, _PADDED))
    nodes[..., 0, :6] = chart.values
    nodes[..., 1:, :6] = np.swapaxes(chart.charted(chart.tangents) * size, -1, -2)
    return nodes.reshape(*chart.values.shape[:3], -1)


def charted_rod(chart: StableSet) -> Charted:
    """Rod, fold and interpolation table of a chart, for the kernels."""
    return Charted(chart.discretization.rod, chart.fold, interpolant(chart))


@inlined
def _side(t: float, upper: bool) -> tuple[float, float, float, float, float, float]:
    """Weights l, g and χ of one side of a cell at its fraction t, and their derivatives."""
    u = 1.0 - t
    bent = 6.0 * t * u
    if upper:
        return t, t * t * (3.0 - 2.0 * t) - t, -t * t * u, 1.0, bent - 1.0, t * (3.0 * t - 2.0)
    return u, u * u * (1.0 + 2.0 * t) - u, t * u * u, -1.0, 1.0 - bent, u * (1.0 - 3.0 * t)


@inlined
def _add_values(b: Array, n: int, v: float, x: float, y: float, z: float) -> None:
    """Add the corner in the buffer to the n sums of values, with the weights of its four rows."""
    for q in range(n):
        rows = v * b[q] + x * b[_PADDED + q]
        b[_SUMS + q] += rows + y * b[2 * _PADDED + q] + z * b[3 * _PADDED + q]


@inlined
def _add_slopes(
    b: Array,
    n: int,
    by_v: Vector,
    by_x: Vector,
    by_y: Vector,
    by_z: Vector,
) -> None:
    """Add the corner in the buffer to the n sums of slopes, with the derivatives of the weights."""
    for q in range(n):
        v, x, y, z = b[q], b[_PADDED + q], b[2 * _PADDED + q], b[3 * _PADDED + q]
        b[_SUMS + _PADDED + q] += by_v[0] * v + by_x[0] * x + by_y[0] * y + by_z[0] * z
        b[_SUMS + 2 * _PADDED + q] += by_v[1] * v + by_x[1] * x + by_y[1] * y + by_z[1] * z
        b[_SUMS + 3 * _PADDED + q] += by_v[2] * v + by_x[2] * x + by_y[2] * y + by_z[2] * z


@inlined
def _blend(nodes: Array, x: float, y: float, z: float, b: Array, slopes: bool) -> None:
    """Compute values, and if requested slopes, at (x, y, z) in cells; left in the buffer."""
    i = min(int(x), nodes.shape[0] - 2)
    j = min(int(y), nodes.shape[1] - 2)
    k = min(int(z), nodes.shape[2] - 2)
    size = nodes.shape[3]  # not a constant: short loops would be unrolled instead of vectorised
    for q in range(size):
        b[_SUMS + q] = 0.0
    for m in range(2):
        lx, gx, cx, dlx, dgx, dcx = _side(x - i, m == 1)
        for n in range(2):
            ly, gy, cy, dly, dgy, dcy = _side(y - j, n == 1)
            for o in range(2):
                lz, gz, cz, dlz, dgz, dcz = _side(z - k, o == 1)
                node = nodes[i + m, j + n, k + o]
                for q in range(size):
                    b[q] = node[q]
                _add_values(
                    b,
                    size // 4,
                    (lx + gx) * ly * lz + lx * (gy * lz + ly * gz),
                    cx * ly * lz,
                    lx * cy * lz,
                    lx * ly * cz,
                )
                if slopes:
                    by_v = (
                        (dlx + dgx) * ly * lz + dlx * (gy * lz + ly * gz),
                        (dly + dgy) * lx * lz + dly * (gx * lz + lx * gz),
                        (dlz + dgz) * lx * ly + dlz * (gx * ly + lx * gy),
                    )
                    by_x = (dcx * ly * lz, cx * dly * lz, cx * ly * dlz)
                    by_y = (dlx * cy * lz, lx * dcy * lz, lx * cy * dlz)
                    by_z = (dlx * ly * cz, lx * dly * cz, lx * ly * dcz)
                    _add_slopes(b, size // 4, by_v, by_x, by_y, by_z)


@vectorised
def interpolate(
    nodes: Array, fold: Fold, b: Array, x: Array, value: Array, tangents: Array, slopes: bool
) -> bool:
    """Fill (F, p), and if requested ∂(F, p)/∂x (6, 4), of a contact x = (s, 0, f_y, f_z).

    Return whether x is in the range of the interpolation; otherwise nothing is filled.
    """
    s, fy, fz = x[0], x[2], x[3]
    force = math.hypot(fy, fz)
    eta = along(fold.bounds, s)
    psi = math.atan2(fz, fy)
    log, by_eta, by_psi = log_fold_force(fold, eta, psi)
    rho = math.sqrt(force * math.exp(-log))
    if not (_LEAST <= rho <= _MOST and -_BEFORE <= eta <= 1.0):
        return False
    n, m, k = nodes.shape[0] - 1, nodes.shape[1] - 1, nodes.shape[2] - 1
    turn = psi / (2.0 * math.pi)
    _blend(nodes, n * eta, m * (turn - math.floor(turn)), k * rho, b, slopes)
    grading = fold.bounds[1]
    stretch = (1.0 - fold.bounds[0]) * (1.0 - grading + 2.0 * grading * (1.0 - eta))
    cos, sin, share = fy / force, fz / force, 0.5 * rho / force
    for q in range(6):
        value[q] = b[_SUMS + q]
    for q in range(6 if slopes else 0):
        along_eta, along_psi = (
            n * b[_SUMS + _PADDED + q],
            m / (2.0 * math.pi) * b[_SUMS + 2 * _PADDED + q],
        )
        along_rho = k * b[_SUMS + 3 * _PADDED + q]
        tangents[q, 0] = (along_eta - 0.5 * rho * by_eta * along_rho) / stretch
        tangents[q, 1] = 0.0
        tangents[q, 2] = share * along_rho * (cos + by_psi * sin) - along_psi * sin / force
        tangents[q, 3] = share * along_rho * (sin - by_psi * cos) + along_psi * cos / force
    return True
