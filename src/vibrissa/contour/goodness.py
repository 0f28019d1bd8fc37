"""How well contacts go with a shape: χ² per degree of freedom that few outliers hardly change."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from vibrissa.contour.touches import Array


def excess_of(chi_squared: Array, equations: int) -> float:
    """Tell by how much misses exceed what the noise says, few outliers doing no harm."""
    known = chi_squared[np.isfinite(chi_squared)]
    if not known.size or equations < 1:
        return float("nan")
    return float(np.median(known) / chi2.median(equations))


def evidence_of(chi_squared: Array, unknowns: int) -> float:
    """Give the Bayesian information criterion of a shape, few outliers doing little harm.

    Differences of more than ten between shapes are strong evidence for the one that has less.
    """
    cost = 8.0 * (np.sqrt(1.0 + 0.25 * chi_squared) - 1.0)
    return float(cost.sum() + unknowns * np.log(max(chi_squared.size, 1)))
