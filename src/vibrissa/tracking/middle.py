"""The middle of a whisker that is about known: measured across the line, and smoothed.

The smoothing is least squares with a penalty on third differences, each point counting by its own
uncertainty, so that what is hidden is bridged by a curve of even bend.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.io import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.trace import STEP, TraceOptions

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SUPPORTED = 2.5
_MEDIAN = 0.455
"""Of the square of a standard normal number."""


class Fit(NamedTuple):
    """What was measured along a line."""

    amplitude: Array
    sigma: Array
    seen: Mask
    open: Mask
    noise: float

    def part(self, rows: slice) -> Fit:
        """Give some of the points."""
        return Fit(
            self.amplitude[rows], self.sigma[rows], self.seen[rows], self.open[rows], self.noise
        )


def smoothed(
    frame: Frame, line: Array, gate: int, noise: float, options: TraceOptions, skipped: int = 0
) -> tuple[Array, Fit]:
    """Measure across a line and smooth it."""
    n = len(line)
    offset, amplitude, flank, support = (np.empty(n) for _ in range(4))
    ridge.measure(frame, line, gate, noise, options.scale, offset, amplitude, flank, support)
    seen = (support > _SUPPORTED) & (amplitude > 0.0)
    variance = ridge.SLOPE_VARIANCE * (noise * options.scale / np.maximum(amplitude, 1e-3)) ** 2
    seen[:skipped] = False
    weight = np.where(seen, 1.0 / (variance + 0.03**2), 0.0)
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    measured = line + offset[:, None] * normal
    better = smooth(measured, weight, options.stiffness)
    # What lies far from its neighbours counts less, the second time.
    miss = ((measured - better) ** 2).sum(axis=1) * weight
    # Compression takes noise away where nothing is, and adds it where something is.
    excess = max(1.0, float(np.median(miss[seen])) / _MEDIAN) if seen.any() else 1.0
    weight, miss = weight / excess, miss / excess
    weight = np.where(miss > 9.0, weight * 9.0 / np.maximum(miss, 9.0), weight)
    better = smooth(measured, weight, options.stiffness)
    information = np.convolve(weight, np.ones(min(9, n)), mode="same")
    places = np.arange(n)
    known = np.flatnonzero(seen)
    away = np.full(n, 1e3) if not known.size else _distance_to(places, known)
    sigma = 1.0 / np.sqrt(np.maximum(information, 1.0)) + 0.05 * (0.1 * STEP * away) ** 1.5
    open_ = flank > 0.6 * np.median(flank)
    return better, Fit(amplitude, sigma, seen, open_, noise * float(np.sqrt(excess)))


def smooth(line: Array, weight: Array, stiffness: float) -> Array:
    """Smooth a line."""
    out = np.empty_like(line)
    for k in range(2):
        column = np.empty(len(line))
        ridge.smooth(line[:, k] - line[0, k], weight, stiffness, column)
        out[:, k] = column + line[0, k]
    return out


def _distance_to(places: NDArray[np.intp], known: NDArray[np.intp]) -> Array:
    """How far each place is from the nearest known one."""
    after = np.clip(np.searchsorted(known, places), 0, len(known) - 1)
    before = np.clip(after - 1, 0, None)
    nearest = np.minimum(np.abs(known[after] - places), np.abs(places - known[before]))
    return np.asarray(nearest, dtype=np.float64)
