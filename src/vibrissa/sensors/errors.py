"""Errors that all readings of a sensor share: of gain, of the mixing, of a calibration.

A channel that is taken to read a w + b, but reads (a + δa) w + b + δb, is wrong by (δa, δb) (w, 1)
in every reading of the wrench w: averaging does not help. Such errors are written as independent
ones of standard deviation one, each a matrix E (k, 7) by which the k channels are wrong,
ε E (w, 1); so the covariance of readings gets Σ E (w, 1) (w, 1)ᵀ Eᵀ.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Eigenvalues of a matrix of correlations below this are rounding.
_ROUNDING = 1e-12


def by_gain(mixing: Array, sigma: Array) -> Array:
    """Errors of gain."""
    which = np.flatnonzero(sigma > 0.0)
    out = np.zeros((which.size, len(mixing), 7))
    out[range(which.size), which, :6] = sigma[which, None] * mixing[which]
    return out


def by_mixing(mixing: Array, sigma: Array) -> Array:
    """Errors of the mixing."""
    if sigma.ndim == 0:
        largest = np.abs(mixing.reshape(-1, 2, 3)).max(axis=2)
        sigma = sigma * np.repeat(largest, 3, axis=1)
    channel, component = np.nonzero(sigma)
    out = np.zeros((channel.size, len(mixing), 7))
    out[range(channel.size), channel, component] = sigma[channel, component]
    return out


def by_calibration(covariance: Array) -> Array:
    """Errors of what a calibration has found."""
    found = [np.zeros((0, len(covariance), 7))]
    for channel, own in enumerate(covariance):
        size = np.sqrt(np.diag(own))
        size = np.where(size > 0.0, size, 1.0)
        values, axes = np.linalg.eigh(own / np.outer(size, size))
        kept = values > _ROUNDING
        errors = np.zeros((int(kept.sum()), len(covariance), 7))
        errors[:, channel] = (axes[:, kept] * np.sqrt(values[kept])).T * size
        found.append(errors)
    return np.concatenate(found)


def with_offset(covariance: Array, variance: Array) -> Array:
    """Covariance of mixing and offset once the offset was found anew, by itself."""
    out = covariance.copy()
    out[:, 6, :] = out[:, :, 6] = 0.0
    out[:, 6, 6] = variance
    return out


def checked_covariance(given: Any, channels: int) -> tuple[Array, list[str]]:
    """Check covariances of mixing and offset."""
    shape = (channels, 7, 7)
    if given is None:
        return np.zeros(shape), []
    covariance = np.asarray(given, dtype=np.float64)
    if covariance.shape != shape or not np.isfinite(covariance).all():
        return covariance, [
            f"mixing_covariance has shape {covariance.shape}; finite {shape} is needed"
        ]
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    size = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    correlation = covariance / (size[:, :, None] * size[:, None, :])
    if not np.allclose(correlation, np.swapaxes(correlation, 1, 2), rtol=0.0, atol=1e-9):
        return covariance, ["mixing_covariance is not symmetric"]
    least = float(np.linalg.eigvalsh(correlation).min(initial=0.0))
    if (variances < 0.0).any() or least < -1e-9:
        return covariance, ["mixing_covariance has negative eigenvalues, so it is no covariance"]
    return covariance, []
