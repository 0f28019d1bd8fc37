"""Radii of a rat's whisker by the published regressions of `vibrissa.whisker.morphology`."""

from __future__ import annotations

import numpy as np

from vibrissa.whisker import morphology
from vibrissa.whisker.identity import ROWS, Identity

ANY = "any"
"""Name of a whisker of unknown row and column, of which only the length tells."""

_ALIKE = 5e-3
"""Difference of length within which whiskers count as alike, m: about half a column."""


def published_radii(name: str, length: float) -> tuple[float, float]:
    """Radii of a rat's whisker by row, column and length (Belli et al. 2017)."""
    if name != ANY:
        identity = Identity.of(name)
        which = np.array([[identity.row_number, identity.column]])
        weight = np.ones(1)
    else:
        which = np.array(
            [(1 + i, column) for i, row in enumerate(ROWS) for column in morphology.MEASURED[row]]
        )
        away = (length - morphology.arc_length(*which.T)) / _ALIKE
        weight = np.exp(-0.5 * (away**2 - (away**2).min()))
    row, column = which.T
    base = np.average(morphology.base_radius(row, column, length), weights=weight)
    tip = np.average(morphology.tip_radius(row, column, length), weights=weight)
    return float(base), float(tip)


def published_note(name: str) -> str:
    """Say where such radii come from."""
    if name == ANY:
        which = "its length, of a rat's whisker of unknown row and column"
    else:
        which = f"its length, of a rat's whisker {Identity.of(name).name}"
    return f"radius by published regressions (Belli et al. 2017) from {which}; not measured"
