"""Linear least squares with a check of identifiability, and thin-plate Gaussian processes.

The Gaussian process models readings as a function of the contact point, with the thin-plate kernel

    k(d) = a² (2 d³ − 3 R d² + R³) / R³ for distances d ≤ R

(Williams & Fitzgibbon, *Gaussian process implicit surfaces*, 2007): unlike the squared exponential,
it has no length scale to be fitted and does not revert to the mean between points.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vibrissa.deferred import linalg, spatial
from vibrissa.numerics import Array

# Largest condition number, with columns scaled to length one, at which unknowns are determined.
_CONDITION = 1e4


class Solution(NamedTuple):
    """Unknowns (p, ...), (AᵀA)⁻¹ (p, p) and residuals (n, ...)."""

    unknowns: Array
    spread: Array
    residuals: Array


def solve(design: Array, values: Array, names: Sequence[str], advice: str) -> Solution:
    """Solve A x = y by least squares; raise ValueError that names undetermined unknowns."""
    n, p = design.shape
    if n < p:
        raise ValueError(f"{n} equations do not determine {p} unknowns: {advice}")
    size = np.linalg.norm(design, axis=0)
    if not size.all():
        idle = ", ".join(name for name, s in zip(names, size, strict=True) if s == 0.0)
        raise ValueError(f"the data do not depend on {idle}: {advice}")
    u, singular, v = np.linalg.svd(design / size, full_matrices=False)
    if singular[-1] * _CONDITION < singular[0]:
        raise ValueError(f"the data do not determine {_combination(v[-1], names)}: {advice}")
    back = v.T / singular / size[:, None]
    unknowns = np.tensordot(back @ u.T, values, axes=1)
    residuals = values - np.tensordot(design, unknowns, axes=1)
    return Solution(unknowns, back @ back.T, residuals)


def _combination(direction: Array, names: Sequence[str]) -> str:
    """Describe the undetermined combination of unknowns."""
    largest = np.abs(direction).max()
    parts = [name for name, c in zip(names, direction, strict=True) if abs(c) > 0.1 * largest]
    return parts[0] if len(parts) == 1 else "how much comes from each of " + ", ".join(parts)


_MANY = 5.0  # ratio of residuals to noise above which the user is warned
# Ratios between which the noise seems stated in another unit; exact readings leave less.
_FEW, _EXACT = 1e-2, 1e-4


def warn_of_misfit(misfit: float, advice: str, stacklevel: int = 3) -> None:
    """Warn if residuals and noise differ in size; ``misfit`` is χ² per degree of freedom."""
    if _EXACT**2 < misfit < _FEW**2:
        warnings.warn(
            f"the residuals are only {math.sqrt(misfit):.2g} times the noise: are the readings and "
            "the sensor's noise in the same units?",
            stacklevel=stacklevel,
        )
    if misfit > _MANY**2:
        warnings.warn(
            f"the residuals are {math.sqrt(misfit):.0f} times the noise: check {advice}",
            stacklevel=stacklevel,
        )


def warn_of_surprise(log_factor: float, sigma: float) -> None:
    """Warn if loads contradict a whisker's stated modulus and radius."""
    if abs(log_factor) > _MANY * sigma:
        warnings.warn(
            f"E r⁴ by the loads is {math.exp(log_factor):.3g} times that of the given modulus and "
            f"radius, {abs(log_factor) / sigma if sigma else math.inf:.0f} standard deviations "
            "away: check their units, whether the radius is a diameter, and the readings' units",
            stacklevel=4,
        )


# Candidate ratios of the noise variance to that of the process.
_RATIOS = np.logspace(-7, 1, 17)


@dataclass(frozen=True, eq=False)
class ThinPlate:
    """Mean of a thin-plate Gaussian process of k quantities, with fitted noise (k,).

    ``reach`` is the R of the kernel, at least the distance between any two ``points`` (n, 3).
    """

    points: Array
    weights: Array
    reach: float
    noise: Array

    @classmethod
    def fit(cls, points: Array, values: Array, ratio: float | None = None) -> ThinPlate:
        """Fit values (n, k) of zero mean at points (n, 3).

        ``ratio`` is the ratio of noise variance to that of the process, by default that of maximum
        marginal likelihood for each quantity.
        """
        reach = 2.0 * float(np.linalg.norm(np.ptp(points, axis=0)))
        kernel = _kernel(spatial.distance.cdist(points, points) / reach)
        n, k = values.shape
        weights, noise = np.empty((n, k)), np.empty(k)
        best = np.full(k, np.inf)
        for one in _RATIOS if ratio is None else (ratio,):
            factor = linalg.cho_factor(kernel + one * np.eye(n), lower=True)
            back = linalg.cho_solve(factor, values)
            variance = np.maximum(np.sum(values * back, axis=0) / n, np.finfo(np.float64).tiny)
            cost = n * np.log(variance) + 2.0 * np.log(np.diag(factor[0])).sum()
            better = cost < best
            best[better], weights[:, better] = cost[better], back[:, better]
            noise[better] = np.sqrt(one * variance[better])
        return cls(np.array(points), weights, reach, noise)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Mean (n, k) at points, and its derivatives (n, k, 3)."""
        x = np.minimum(spatial.distance.cdist(points, self.points) / self.reach, 1.0)
        by_square = 6.0 * (x - 1.0) / self.reach**2  # (dk/dx) / (x R²)
        n, k = len(points), self.weights.shape[1]
        moments = self.weights[:, :, None] * self.points[:, None, :]
        slopes = (by_square @ self.weights)[:, :, None] * points[:, None, :]
        slopes -= (by_square @ moments.reshape(-1, 3 * k)).reshape(n, k, 3)
        return np.asarray(_kernel(x) @ self.weights), slopes


def _kernel(x: Array) -> Array:
    """Kernel at distances x, in units of R."""
    x = np.minimum(x, 1.0)
    return np.asarray((2.0 * x - 3.0) * x * x + 1.0)
