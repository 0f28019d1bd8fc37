"""Numbers as they stand in the page."""

from __future__ import annotations

import numpy as np

from vibrissa.quantities import shown_unit

_LEAST = 1e-5
"""In a display unit; nothing is known so well."""


def shown_value(name: str, value: float, digits: int = 4) -> str:
    """Write an SI value with its unit."""
    if not np.isfinite(value):
        return "–"
    factor, unit = shown_unit(name, value)
    number = value * factor
    # What is smaller is so by rounding.
    if 0.0 < abs(number) < _LEAST:
        return f"below {_LEAST:g}{'' if unit in ('', '°') else ' '}{unit}"
    text = f"{number:.0f}" if abs(number) >= 10.0**digits else f"{number:.{digits}g}"
    return f"{text.replace('-', '−')}{'' if unit in ('', '°') else ' '}{unit}"
