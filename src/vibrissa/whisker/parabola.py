"""The planar parabola, the usual picture of a whisker's intrinsic shape.

    y = A x²,    s = (sinh w cosh w + w) / (4 A),    κ(s) = 2 A / cosh³ w,    sinh w = 2 A x

It is given by its arc length, not by its extent along x. w(s) is found by Newton's method; the
left side is convex and increasing in w, so that it converges from anywhere.
"""

import numpy as np
from numpy.typing import NDArray

from vibrissa.whisker.profile import Profile, approximate, constant

Array = NDArray[np.float64]


def parabola_curvature(length: float, coefficient: float) -> Profile:
    """Intrinsic curvature of y = A x², bending toward +y."""
    if coefficient == 0.0:
        return constant(np.zeros(3), length)

    def curvature(s: Array) -> Array:
        w = _parameter(4.0 * coefficient * s)
        kappa = 2.0 * coefficient / np.cosh(w) ** 3
        return np.stack([np.zeros_like(s), np.zeros_like(s), kappa], axis=-1)

    return approximate(curvature, np.array([0.0, length]))


def _parameter(arc: Array) -> Array:
    """Solve sinh w cosh w + w = arc ≥ 0."""
    w = np.arcsinh(0.5 * arc)
    for _ in range(60):
        change = (0.5 * np.sinh(2.0 * w) + w - arc) / (2.0 * np.cosh(w) ** 2)
        w = w - change
        if np.abs(change).max(initial=0.0) < 1e-15 * (1.0 + np.abs(w).max(initial=0.0)):
            break
    return w
