"""What measurements weigh, by the noise of the sensor, and which misfit is still noise.

Weights whiten: W with WᵀW = Σ⁻¹, so that W times an error has variance one in each component. A
component whose variance is zero counts as exact (next to the others). Directions in which the
covariance of the others is singular carry no information: a wrench obeys M · F = 0, and noise that
obeys it too has rank five.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.stats import chi2

from vibrissa.numerics import Array

#: Without noise to go by, components of force and moment count as known to this share of |F|, |M|.
TRUSTED = 0.01
# What counts as exact, in standard deviations of the rest.
_EXACT = 1e-6
# Eigenvalues of a correlation matrix below this are rounding.
_SINGULAR = 1e-10
# A measurement is explained if a perfect model would fit worse in one of a thousand.
_RARE = 1e-3
#: Contacts whose χ² differ by less cannot be told apart (the odds are below 200 to 1).
INDISTINCT = float(chi2.isf(_RARE, 1))


def trusted(wrenches: Array) -> Array:
    """Covariances (n, 6, 6) of (F, M) known to a share of |F| and |M|, for wrenches (n, 6)."""
    force, moment = (np.linalg.norm(part, axis=1) for part in (wrenches[:, :3], wrenches[:, 3:]))
    out = np.zeros((len(wrenches), 6, 6))
    for i in range(6):
        out[:, i, i] = (TRUSTED * (force if i < 3 else moment)) ** 2
    return out


def whitening(covariance: Array) -> Array:
    """Weights W with WᵀW = Σ⁻¹, shape (..., k, k), see the module; zero where Σ is not finite."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    noisy = variance > 0.0
    size = np.sqrt(np.where(noisy, variance, 1.0))
    typical = np.log(size).sum(axis=-1, keepdims=True) / np.maximum(
        noisy.sum(axis=-1, keepdims=True), 1
    )
    size = np.where(noisy, size, _EXACT * np.exp(typical))
    with np.errstate(all="ignore"):
        correlation = covariance / (size[..., :, None] * size[..., None, :])
    k = covariance.shape[-1]
    exact = (variance == 0.0)[..., None] & np.eye(k, dtype=bool)
    correlation = np.where(exact, 1.0, correlation)
    usable = np.asarray(np.isfinite(correlation).all(axis=(-2, -1)))[..., None, None]
    values, vectors = np.linalg.eigh(np.where(usable, correlation, np.eye(k)))
    root = np.where(values > _SINGULAR, 1.0 / np.sqrt(np.maximum(values, _SINGULAR)), 0.0)
    weights = root[..., :, None] * np.swapaxes(vectors, -1, -2) / size[..., None, :]
    return np.where(usable, weights, 0.0)


def rank(covariance: Array) -> int:
    """How many independent numbers a measurement with this covariance (k, k) tells."""
    weights = whitening(covariance)
    return int((np.abs(weights).max(axis=-1) > 0.0).sum())


@cache
def explained(degrees: int) -> float:
    """Largest χ² of a measurement that counts as explained, for so many degrees of freedom."""
    return float(chi2.isf(_RARE, max(degrees, 1)))
