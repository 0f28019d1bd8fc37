"""Say it where a calibration's model does not explain its data."""

from __future__ import annotations

import math
import warnings

# Residuals up to so many times the noise may come from noise that was stated too small.
_MANY = 5.0


def warn_of_misfit(misfit: float, advice: str) -> None:
    """Warn where residuals are far larger than the noise."""
    if misfit > _MANY**2:
        warnings.warn(
            f"what is left unexplained is {math.sqrt(misfit):.0f} times the noise: check {advice}",
            stacklevel=3,
        )


def warn_of_surprise(log_factor: float, sigma: float) -> None:
    """Warn where loads contradict what was known of a whisker's modulus and radius."""
    if abs(log_factor) > _MANY * sigma:
        warnings.warn(
            f"the loads make E r⁴ {math.exp(log_factor):.3g} times that of the given modulus and "
            f"radius, {abs(log_factor) / sigma if sigma else math.inf:.0f} standard deviations "
            "off: check their units, whether the radius is a diameter, and the readings' units",
            stacklevel=4,
        )
