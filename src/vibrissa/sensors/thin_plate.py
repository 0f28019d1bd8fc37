"""A Gaussian process with the thin-plate kernel, of readings over contact points.

    k(d) = a² (2 d³ − 3 R d² + R³) / R³ for distances d ≤ R

(Williams & Fitzgibbon, *Gaussian process implicit surfaces*, 2007): it has no length to be fitted
and does not fall back to its mean between points, as a squared exponential does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from vibrissa.numerics import Array

_RATIOS = np.logspace(-7, 1, 17)
"""Noise variance over that of the process; the one of largest marginal likelihood is taken."""


@dataclass(frozen=True, eq=False)
class ThinPlate:
    """Mean of a thin-plate Gaussian process; no two of its points are farther apart than its reach.

    Its noise is the standard deviation that was found.
    """

    points: Array
    weights: Array
    reach: float
    noise: Array

    @classmethod
    def fit(cls, points: Array, values: Array, ratio: float | None = None) -> ThinPlate:
        """Fit values (n, k) of zero mean; where no noise is stated, by the largest likelihood."""
        reach = 2.0 * float(np.linalg.norm(np.ptp(points, axis=0)))
        kernel = _kernel(cdist(points, points) / reach)
        n, k = values.shape
        weights, noise = np.empty((n, k)), np.empty(k)
        best = np.full(k, np.inf)
        for one in _RATIOS if ratio is None else (ratio,):
            factor = cho_factor(kernel + one * np.eye(n), lower=True)
            back = cho_solve(factor, values)
            variance = np.maximum(np.sum(values * back, axis=0) / n, np.finfo(np.float64).tiny)
            cost = n * np.log(variance) + 2.0 * np.log(np.diag(factor[0])).sum()
            better = cost < best
            best[better], weights[:, better] = cost[better], back[:, better]
            noise[better] = np.sqrt(one * variance[better])
        return cls(np.array(points), weights, reach, noise)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Mean (n, k) at points, and its derivatives (n, k, 3)."""
        x = np.minimum(cdist(points, self.points) / self.reach, 1.0)
        by_square = 6.0 * (x - 1.0) / self.reach**2  # (dk/dx) / (x R²)
        n, k = len(points), self.weights.shape[1]
        moments = self.weights[:, :, None] * self.points[:, None, :]
        slopes = (by_square @ self.weights)[:, :, None] * points[:, None, :]
        slopes -= (by_square @ moments.reshape(-1, 3 * k)).reshape(n, k, 3)
        return np.asarray(_kernel(x) @ self.weights), slopes


def _kernel(x: Array) -> Array:
    x = np.minimum(x, 1.0)
    return np.asarray((2.0 * x - 3.0) * x * x + 1.0)
