"""Smoothing splines whose strength follows from the noise.

Through points y_i at parameters t_i ∈ [0, 1] goes the curve f that minimises

    Σ |y_i − f(t_i)|² + λ ∫ |f‴|² dt,

a quintic spline with f‴ = f⁗ = 0 at both ends. Penalising the third derivative leaves the curvature
at the base free (a cubic smoothing spline would make it zero there) and keeps a parabola, the usual
whisker, whatever λ is. The spline is written by its values at sites, f = Σ N_j(t) v_j, with natural
cardinal splines N_j. With A_ij = N_j(t_i), K = ∫ N‴ N‴ᵀ and the hat matrix H = A (AᵀA + λK)⁻¹ Aᵀ,
λ follows from

- the noise, where it is stated: the least RSS + 2 ρ σ² c tr H, an unbiased estimate of the squared
  distance to the true curve (Mallows; the discrepancy principle RSS = σ² c (n − tr H) has the same
  aim, but hangs on how much the noise of one sample happens to differ from σ);
- else generalised cross-validation: the least RSS / (n − ρ tr H)². Plain cross-validation, ρ = 1,
  follows the noise of short data at times; counting each degree of freedom as ρ = 1.2 to 1.4 of
  them ends that (Kim & Gu 2004).

Points are free to slide along the curve, so that residuals have c = d − 1 components in d
dimensions.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.linalg import eigh, qr, solve_triangular, svd

Array = NDArray[np.float64]

SITES = 48
"""Values that a smoothing spline has at most, per coordinate."""

COST = 1.3
"""ρ, what a degree of freedom counts."""

LEVELS = 90
"""Values of λ that are compared."""


def natural_spline(t: Array, values: Array) -> BSpline:
    """Interpolate with a quintic spline that has no third and fourth derivative at the ends."""
    zero = np.zeros(values.shape[1:])
    # The stubs know conditions by name only.
    ends: Any = ([(3, zero), (4, zero)], [(3, zero), (4, zero)])
    return make_interp_spline(t, values, k=5, bc_type=ends)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A smoothing spline and what is known about it."""

    curve: BSpline
    residuals: Array
    freedom: float

    def noise(self, components: int) -> float:
        """Standard deviation per coordinate that the residuals tell of."""
        left = max(len(self.residuals) - self.freedom, 1e-3)
        return float(np.sqrt(np.sum(self.residuals**2) / (components * left)))


def smooth(t: Array, points: Array, noise: float | None, components: int) -> Smoothed:
    """Fit a smoothing spline."""
    n = len(t)
    cardinal, roughness = _cardinal()
    # The least λ does nothing to what n points can show, and makes the system regular where there
    # are fewer points than sites.
    least = 1e-6 * n / (np.pi * min(n, SITES)) ** 6
    design = np.asarray(cardinal(t))
    weights, axes = eigh(design.T @ design)
    shown_part = np.sqrt(np.clip(weights, 0.0, None))[:, np.newaxis] * axes.T
    rough_part = np.sqrt(least) * roughness
    # Modes that are orthogonal in both AᵀA and K. K itself is not formed: squared, the roughness of
    # a smooth curve would drown in the rounding of the rough ones.
    basis, triangle = qr(np.vstack([shown_part, rough_part]), mode="economic")
    _, rough, turned = svd(basis[SITES:], full_matrices=False)
    modes = solve_triangular(triangle, turned.T)
    shown = design @ modes
    rates = rough**2 / least
    loads = shown.T @ points

    def fit(level: float) -> tuple[Array, Array, Array]:
        damping = 1.0 / (1.0 + (level - least) * rates)
        weights = damping[:, np.newaxis] * loads
        return weights, points - shown @ weights, damping * (1.0 - rough**2)

    levels = np.geomspace(least, 10.0 * n, LEVELS)
    rss, freedom = np.empty((2, LEVELS))
    for k, level in enumerate(levels):
        _, residuals, hat = fit(level)
        rss[k], freedom[k] = np.sum(residuals**2), hat.sum()
    if noise is None:
        left = n - COST * freedom
        allowed = left > 0.0
        level = float(levels[allowed][(rss[allowed] / left[allowed] ** 2).argmin()])
    else:
        level = float(levels[(rss + 2.0 * COST * noise**2 * components * freedom).argmin()])
    weights, residuals, hat = fit(level)
    return Smoothed(
        BSpline(cardinal.t, cardinal.c @ (modes @ weights), 5), residuals, float(hat.sum())
    )


@cache
def _cardinal() -> tuple[BSpline, Array]:
    """Give N and the triangle D with DᵀD = ∫ N‴ N‴ᵀ dt, on equally spaced sites."""
    sites = np.linspace(0.0, 1.0, SITES)
    cardinal = natural_spline(sites, np.eye(SITES))
    # Three Gauss points are exact where N‴ is a parabola.
    points, weights = np.polynomial.legendre.leggauss(3)
    halves = 0.5 * np.diff(sites)[:, np.newaxis]
    middles = 0.5 * (sites[1:] + sites[:-1])[:, np.newaxis]
    thirds = np.asarray(cardinal.derivative(3)((middles + halves * points).ravel()))
    rough = np.sqrt((halves * weights).ravel())[:, np.newaxis] * thirds
    return cardinal, np.asarray(qr(rough, mode="r")[0][:SITES])
