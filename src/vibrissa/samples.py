"""Built-in whiskers with published dimensions.

`gamma` represents a γ whisker of a rat: 40 mm long, in its plane the parabola y = A x² with
A·L = 0.4, and out of the plane by 1.5 mm at the tip (real ones are planar to 0.3 mm over the
proximal 65 %: Towal et al. 2011; here the deviation begins at 0.6 L, with a curvature that grows
with the square of the distance from there). Base radius, taper and material are those of Huet,
Emnett & Hartmann (2022). The others are the four canonical rods, straight or curved, tapered or
cylindrical.
"""

import numpy as np
from numpy.typing import NDArray

from vibrissa.whisker import Whisker, parabola_curvature

__all__ = ["curved", "curved_cylinder", "gamma", "straight", "straight_cylinder"]
__dir__ = __all__.copy

LENGTH = 40e-3
COEFFICIENT = 10.0
OUT_OF_PLANE = 0.6
"""Share of the length at which the γ whisker leaves its plane."""

TIP_HEIGHT = 1.5e-3
"""Approximate distance of the γ whisker's tip from that plane, m."""


def gamma() -> Whisker:
    """Return a γ whisker, the built-in default.

    Returns
    -------
    Whisker
        40 mm, intrinsically curved in three dimensions, base radius 100 µm, tip a fifteenth of it.
    """
    planar = parabola_curvature(LENGTH, COEFFICIENT)
    start = OUT_OF_PLANE * LENGTH
    span = LENGTH - start
    # Twice integrated, κ (x/span)² gives κ span² / 12 at the end.
    largest = 12.0 * TIP_HEIGHT / span**2

    def curvature(s: NDArray[np.float64]) -> NDArray[np.float64]:
        value = planar(s)
        value[..., 1] = -largest * (np.clip(s - start, 0.0, None) / span) ** 2
        return value

    return Whisker.from_curvature(LENGTH, curvature, breaks=(start,), name="gamma").aligned()


def straight() -> Whisker:
    """Return a straight tapered whisker of 40 mm.

    Returns
    -------
    Whisker
        Base radius 100 µm, tip a fifteenth of it.
    """
    return Whisker.straight(LENGTH, name="straight")


def straight_cylinder() -> Whisker:
    """Return a straight cylinder of 40 mm, radius 100 µm.

    Returns
    -------
    Whisker
        Straight cantilever of constant section.
    """
    return Whisker.straight(LENGTH, tip_radius=100e-6, name="straight cylinder")


def curved() -> Whisker:
    """Return a planar tapered whisker of 40 mm on y = 10 x².

    Returns
    -------
    Whisker
        Base radius 100 µm, tip a fifteenth of it.
    """
    return Whisker.parabola(LENGTH, COEFFICIENT, name="curved")


def curved_cylinder() -> Whisker:
    """Return a planar cylinder of 40 mm, radius 100 µm, on y = 10 x².

    Returns
    -------
    Whisker
        Curved as `curved`, but not tapered.
    """
    return Whisker.parabola(LENGTH, COEFFICIENT, tip_radius=100e-6, name="curved cylinder")
