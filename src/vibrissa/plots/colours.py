"""Colormaps: sequential, diverging, and one that closes on itself for directions.

The cyclic one is a circle in the plane of lightness and of blue against yellow in OKLab
(B. Ottosson 2020, https://bottosson.github.io/posts/oklab/), the plane that every common kind of
colour vision sees; green against red is added for those who see it. Equal turns are therefore about
equal steps in colour, and nothing is so pale that it is lost on white paper.
"""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Colormap, ListedColormap

from vibrissa.plots.style import INK, Array, robust_limits

_LIGHTNESS, _RADIUS, _YELLOW, _RED = 0.62, 0.20, 0.115, 0.06
"""Centre and radius in lightness, radii in b (yellow) and a (red), within the gamut of sRGB."""

_LMS_FROM_LAB = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_RGB_FROM_LMS = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


def _srgb(lab: Array) -> Array:
    """SRGB (..., 3) in [0, 1] of OKLab (..., 3)."""
    linear = np.clip((lab @ _LMS_FROM_LAB.T) ** 3 @ _RGB_FROM_LMS.T, 0.0, 1.0)
    encoded: Array = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055
    )
    return encoded


def cyclic() -> Colormap:
    """Colormap for directions over one turn, from −π to π."""
    turn = np.linspace(-np.pi, np.pi, 512, endpoint=False)
    lab = np.stack(
        [
            _LIGHTNESS + _RADIUS * np.cos(turn),
            -_RED * np.cos(turn),
            _YELLOW * np.sin(turn),
        ],
        axis=-1,
    )
    return ListedColormap(_srgb(lab), name="vibrissa_cyclic")


def sequential() -> Colormap:
    """Colormap for what grows from one end, without the pale end that is lost on white paper."""
    return ListedColormap(
        mpl.colormaps["viridis"](np.linspace(0.0, 0.93, 256)), name="vibrissa_sequential"
    )


def diverging() -> Colormap:
    """Colormap for what has a sign."""
    return mpl.colormaps["coolwarm"]


def shading(values: Array | None) -> dict[str, Any]:
    """What tells a scatter plot how to colour its points."""
    if values is None:
        return {"color": INK, "linewidths": 0.0}
    low, high = robust_limits(values)
    return {"c": values, "cmap": sequential(), "vmin": low, "vmax": high, "linewidths": 0.0}
