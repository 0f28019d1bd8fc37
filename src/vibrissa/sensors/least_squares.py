"""Linear least squares that name what the data do not determine, and warnings of misfits."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_CONDITION = 1e4
"""Condition number, of columns scaled to one, from which unknowns are not determined."""


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
        raise ValueError(f"the data do not depend on {idle}: {advice}")
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


_MANY = 5.0
"""Residuals over the noise up to which the noise may have been stated too small."""


def warn_of_misfit(misfit: float, advice: str) -> None:
    """Warn where residuals are far larger than the noise."""
    if misfit > _MANY**2:
        warnings.warn(
            f"what is left unexplained is {math.sqrt(misfit):.0f} times the noise: check {advice}",
            stacklevel=3,
        )


def warn_of_surprise(log_factor: float, sigma: float) -> None:
    """Warn where loads contradict the modulus and radius that were stated for a whisker."""
    if abs(log_factor) > _MANY * sigma:
        warnings.warn(
            f"the loads make E r⁴ {math.exp(log_factor):.3g} times that of the given modulus and "
            f"radius, {abs(log_factor) / sigma if sigma else math.inf:.0f} standard deviations "
            "off: check their units, whether the radius is a diameter, and the readings' units",
            stacklevel=4,
        )
