"""Arc length along a parametric curve, and the nearest points on it.

    s(t) = ∫ |X′| dt

is integrated by Gauss's rule between the knots of the spline X and inverted by Newton's method.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

Array = NDArray[np.float64]

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(12)


class ArcLength:
    """Arc length of a spline curve between two parameters."""

    def __init__(
        self, curve: BSpline, start: float | None = None, end: float | None = None
    ) -> None:
        knots = np.unique(curve.t)
        start = float(knots[0]) if start is None else start
        end = float(knots[-1]) if end is None else end
        slack = 1e-6 * (end - start)
        inside = knots[(knots > start + slack) & (knots < end - slack)]
        self._velocity = curve.derivative(1)
        self._knots = np.concatenate([[start], inside, [end]])
        pieces = self._between(self._knots[:-1], self._knots[1:])
        self.ends: Array = np.append(0.0, np.cumsum(pieces))
        self.total = float(self.ends[-1])

    def _speed(self, t: Array) -> Array:
        return np.asarray(np.linalg.norm(self._velocity(t), axis=-1))

    def _between(self, start: Array, end: Array) -> Array:
        half = 0.5 * (end - start)
        t = 0.5 * (start + end)[..., np.newaxis] + half[..., np.newaxis] * _POINTS
        lengths: Array = half * (self._speed(t) @ _WEIGHTS)
        return lengths

    def length(self, t: Array) -> Array:
        """Arc lengths (...) at parameters (...)."""
        k = np.clip(np.searchsorted(self._knots, t, side="right") - 1, 0, self._knots.size - 2)
        lengths: Array = self.ends[k] + self._between(self._knots[k], t)
        return lengths

    def parameter(self, s: Array) -> Array:
        """Parameters (...) at arc lengths (...)."""
        t = np.interp(s, self.ends, self._knots)
        for _ in range(30):
            change = (self.length(t) - s) / self._speed(t)
            t = t - change
            if np.abs(change).max(initial=0.0) < 1e-14 * (self._knots[-1] - self._knots[0]):
                break
        return np.asarray(t)


def nearest_parameters(curve: BSpline, points: Array, guesses: Array, window: float) -> Array:
    """Find the nearest points on a curve, each within a window of parameters."""
    grid = np.linspace(-0.02, 1.02, 521)
    apart = np.sum((points[:, np.newaxis] - np.asarray(curve(grid))) ** 2, axis=-1)
    apart[np.abs(grid - guesses[:, np.newaxis]) > window] = np.inf
    t: Array = grid[apart.argmin(axis=1)]
    first, second = curve.derivative(1), curve.derivative(2)
    for _ in range(8):
        gap, velocity = np.asarray(curve(t)) - points, np.asarray(first(t))
        slope = np.sum(gap * velocity, axis=1)
        speed2 = np.sum(velocity**2, axis=1)
        bend = speed2 + np.sum(gap * np.asarray(second(t)), axis=1)
        change = -slope / np.maximum(bend, 0.3 * speed2)
        t = np.clip(t + np.clip(change, -0.01, 0.01), grid[0], grid[-1])
        if np.abs(change).max() < 1e-12:
            break
    return t
