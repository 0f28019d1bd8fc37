"""How well contacts go with a shape: χ² per degree of freedom that few outliers hardly change."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from vibrissa.contour.touches import Array


def excess_of(chi_squared: Array, equations: int) -> float:
    """Tell by how much misses exceed what the noise says, few outliers doing no harm.

    Parameters
    ----------
    chi_squared : array (n,)
        Squared misses of contacts in standard deviations; NaN is left out.
    equations : int
        Of each contact.

    Returns
    -------
    float
        Their median over that of the χ² distribution: χ² per degree of freedom, 1 where shape and
        noise are right; NaN if there are none.
    """
    known = chi_squared[np.isfinite(chi_squared)]
    if not known.size or equations < 1:
        return float("nan")
    return float(np.median(known) / chi2.median(equations))


def evidence_of(chi_squared: Array, unknowns: int) -> float:
    """Give the Bayesian information criterion of a shape, few outliers doing little harm.

    Differences of more than ten between shapes are strong evidence for the one that has less.

    Parameters
    ----------
    chi_squared : array (n,)
        Squared misses of the same contacts for every shape, in standard deviations.
    unknowns : int
        How many numbers the shape has.

    Returns
    -------
    float
        Σ ρ(χ²) + k ln n, with ρ(χ²) = 8 (√(1 + χ²/4) − 1), as contacts count in the fit.
    """
    cost = 8.0 * (np.sqrt(1.0 + 0.25 * chi_squared) - 1.0)
    return float(cost.sum() + unknowns * np.log(max(chi_squared.size, 1)))
