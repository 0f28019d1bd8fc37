"""How far traces are to be trusted, told by what is left of them when the rod is fitted.

The standard deviations of a trace come from the noise of its image. What compression, blur or a
pattern of the background add is not in them, and what is left goes together from point to point,
for traces are smooth. So the variance of traces, in units of what they claim, is taken from the
residuals m of the fit,

    v = τ Σ m² / (N − τ p),    τ = 1 + 2 Σ ρ_k,

with N residuals and p numbers that were fitted to them; τ, the sum of their correlations over the
places of the rod, says how many neighbours count as one. A frame that fits worse than is usual is
trusted less.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LEAST = 0.05
"""Correlation that counts as none."""

_FREE = 0.25
"""Share of the residuals that are free, at least, however many numbers are fitted."""


def trace_variance(misses: Sequence[Array], fitted: Array) -> Array:
    """Say by how much the variance of traces differs from what they claim."""
    square = np.sum([(one**2).sum(axis=1) for one in misses], axis=0)
    count = np.sum([(one != 0.0).sum(axis=1) for one in misses], axis=0)
    shown = count > 0
    if not square[shown].any():
        return np.ones(len(square))
    together = _together(misses)
    # Most frames are right, so that the median of them is.
    usual = float(np.median(square[shown] / count[shown]))
    spent = together * float(fitted[shown].sum()) / float(count[shown].sum())
    each = np.where(shown, square / np.maximum(count, 1), usual)
    variance = together * np.maximum(each, usual) / max(1.0 - spent, _FREE)
    # By what the whisker's shape is wrong all frames are: better than they claim they are not.
    return np.asarray(np.maximum(variance, 1.0))


def _together(misses: Sequence[Array]) -> float:
    """How many neighbouring residuals count as one."""
    total, most = 1.0, min(one.shape[1] for one in misses) // 2
    size = sum(float((one**2).mean()) for one in misses)
    for lag in range(1, most):
        both = sum(float((one[:, lag:] * one[:, :-lag]).mean()) for one in misses)
        if both < _LEAST * size:
            break
        total += 2.0 * both / size
    return total
