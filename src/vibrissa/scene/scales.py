"""Limits of colours and axes: those that hold most values, and roots that show small ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.scene.marks import Array


def robust_limits(values: ArrayLike, share: float = 0.98, symmetric: bool = False) -> Array:
    """Give limits between which most of the finite values are."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return np.array([-1.0 if symmetric else 0.0, 1.0])
    low, high = np.quantile(finite, [(1.0 - share) / 2.0, (1.0 + share) / 2.0])
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    if not high - low > 1e-12 * max(abs(high), abs(low)):
        room = 0.05 * abs(high) or 1.0
        low, high = low - room, high + room
    return np.array([low, high])


def root(values: ArrayLike) -> Array:
    """Take square roots of sizes and keep signs, for scales on which small values are seen."""
    x = np.asarray(values, dtype=np.float64)
    return np.asarray(np.sign(x) * np.sqrt(np.abs(x)))


def squared(values: ArrayLike) -> Array:
    """Take squares and keep signs: the inverse of `root`."""
    x = np.asarray(values, dtype=np.float64)
    return np.asarray(np.sign(x) * np.square(x))
