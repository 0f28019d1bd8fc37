"""Least squares that refuse what the data do not determine, and say what that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Unknowns whose uncertainty would be amplified so much (columns scaled to one) are not determined.
_CONDITION = 1e4


class Solution(NamedTuple):
    """Unknowns (p, ...), (AᵀA)⁻¹ (p, p) and residuals (n, ...)."""

    unknowns: Array
    spread: Array
    residuals: Array


def solve(design: Array, values: Array, names: Sequence[str], advice: str) -> Solution:
    """Solve A x = y by least squares."""
    n, p = design.shape
    if n < p:
        raise ValueError(f"{n} equations do not determine {p} unknowns: {advice}")
    size = np.linalg.norm(design, axis=0)
    if not size.all():
        idle = ", ".join(name for name, s in zip(names, size, strict=True) if s == 0.0)
        raise ValueError(f"the data say nothing about {idle}: {advice}")
    u, singular, v = np.linalg.svd(design / size, full_matrices=False)
    if singular[-1] * _CONDITION < singular[0]:
        raise ValueError(f"the data do not determine {_combination(v[-1], names)}: {advice}")
    back = v.T / singular / size[:, None]
    unknowns = np.tensordot(back @ u.T, values, axes=1)
    residuals = values - np.tensordot(design, unknowns, axes=1)
    return Solution(unknowns, back @ back.T, residuals)


def _combination(direction: Array, names: Sequence[str]) -> str:
    largest = np.abs(direction).max()
    parts = [name for name, c in zip(names, direction, strict=True) if abs(c) > 0.1 * largest]
    return parts[0] if len(parts) == 1 else "how much comes from each of " + ", ".join(parts)
