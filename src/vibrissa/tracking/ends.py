"""Where a whisker begins and ends in an image: it leaves the dark face, and it fades at its tip."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.io import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.middle import Fit, smoothed
from vibrissa.tracking.trace import STEP, Trace, TraceOptions, even

Array = NDArray[np.float64]

OUTSIDE = 12.0
"""How far inside the face the base is looked for, pixels."""

FEWEST = 12
"""Points of the shortest line that is looked at."""

_FUR = 3
_BEYOND = 12
"""How many points beyond the last that is seen are looked at to find the tip."""

_BORDER = 8.0
"""How near the border of the image a line may end because the image does, pixels."""

_CLEAR = 3.0
"""By how many standard deviations, in each of its last points, a line must be darker than what is
beyond for it to be seen to end there: then its end is known to a point."""

_SMOOTHED = 0.6
"""Noise below which an image is none as a sensor gives it, grey values: twice that of rounding."""

_LAST = 10
"""Points, and half as many beyond, from which that is told."""

_BESIDE = (4.0, 7.0)
"""How far beside the whisker the face's edge is looked for, pixels."""


def traced(
    frame: Frame, noise: float, line: Array, options: TraceOptions, before: float = OUTSIDE
) -> tuple[Trace, bool]:
    """Trace a whisker that is about known, and find its ends."""
    line = _lengthened(even(line))
    for gate in (3, 2):
        line = even(smoothed(frame, line, gate, noise, options)[0])
        if len(line) < FEWEST:
            # Where nothing is seen, nothing holds the line apart.
            return Trace.lost(), False
    line, from_face = with_base(frame, line, before)
    if before > OUTSIDE and len(line) >= FEWEST:
        # What was only guessed is measured before it counts.
        line = even(smoothed(frame, line, 3, noise, options, _FUR if from_face else 0)[0])
    if len(line) < FEWEST:
        return Trace.lost(), False
    if not from_face:
        # Without a face it begins as it ends: where the line does.
        line = _lengthened(line[::-1])[::-1]
    line, fit = smoothed(frame, line, 1, noise, options, _FUR if from_face else 0)
    first = 0 if from_face else len(line) - tip(fit.part(slice(None, None, -1)))
    last = tip(fit)
    if last - first < FEWEST:
        return Trace.lost(), False
    # An image without noise was smoothed, as by compression, and what is faint went with it.
    tip_seen = noise > _SMOOTHED and _inside(frame, line[last - 1])
    tip_seen = tip_seen and _stops(frame, line, fit, last)
    line, fit = line[first:last], fit.part(slice(first, last))
    trusted = min(1.0, float(fit.seen.sum() / max(fit.open.sum(), 1)))
    return Trace(line, fit.sigma, fit.seen, trusted, _inside(frame, line[0]), tip_seen), from_face


def with_base(frame: Frame, line: Array, before: float) -> tuple[Array, bool]:
    """Let a line begin where the whisker leaves the face."""
    longer = even(line, -before)
    near, far = (_edge(frame, longer[:40], distance) for distance in _BESIDE)
    if near is None:
        return line, False
    at = near
    if far is not None and abs(far - near) < 2.0:
        # The face is round: to second order in the distance, its edge on the whisker itself.
        a, b = _BESIDE
        at = near + (near - far) * a * a / (b * b - a * a)
    return even(longer, max(at, 0.0) * STEP), True


def _edge(frame: Frame, line: Array, distance: float) -> float | None:
    """Where along a line it comes out of the dark, the mean of both sides; in points."""
    levels = np.empty((len(line), 2))
    ridge.beside(frame, line, distance, levels)
    places = []
    for level in levels.T:
        bright, dark = float(np.median(level[len(level) // 2 :])), float(level.min())
        half = 0.5 * (bright + dark)
        last = int(np.flatnonzero(level <= half)[-1])
        if dark > 0.6 * bright or last + 1 >= len(level):
            return None
        places.append(last + (half - level[last]) / (level[last + 1] - level[last]))
    return float(np.mean(places))


def tip(fit: Fit) -> int:
    """Say how many points of a line belong to the whisker.

    Beyond the tip the line is as light as its surroundings; before it, it goes on being about as
    dark as it was. The end is where that is most likely, by the sum of log-likelihood ratios.
    """
    sigma = fit.noise * np.sqrt(ridge.DEPTH_VARIANCE)
    amplitude = np.where(fit.open, fit.amplitude, 0.0)
    count = np.convolve(fit.open.astype(float), np.ones(20))[: len(amplitude)]
    recent = np.convolve(np.maximum(amplitude, 0.0), np.ones(20))[: len(amplitude)]
    # What the twenty points before were; the whisker tapers, so that it may be fainter.
    usual = 0.6 * np.concatenate([[0.0], (recent / np.maximum(count, 1.0))[:-1]])
    gain = np.where(fit.open, (amplitude * usual - 0.5 * usual**2) / sigma**2, 0.0)
    return int(np.argmax(np.cumsum(np.clip(gain, -8.0, 8.0)))) + 1


def _stops(frame: Frame, line: Array, fit: Fit, count: int) -> bool:
    """Whether a line of so many points is seen to end, not to fade or to run behind something."""
    before, after = slice(max(count - _LAST, 0), count), slice(count, count + _LAST // 2)
    if not fit.open[after].any() or fit.open[before].mean() < 0.5 or fit.open[after].mean() < 0.5:
        return False
    levels = np.empty((len(line[before]), 2))
    ridge.beside(frame, np.ascontiguousarray(line[before]), _BESIDE[0], levels)
    if np.median(levels) >= np.iinfo(frame.dtype).max:
        # Where the light is more than the image holds, what is faint does not show.
        return False
    sigma = fit.noise * np.sqrt(ridge.DEPTH_VARIANCE)
    return bool(fit.amplitude[before][fit.open[before]].mean() > _CLEAR * sigma)


def _inside(frame: Frame, place: Array) -> bool:
    """Whether a place is not at the border of the image."""
    far = np.array(frame.shape[::-1]) - 1.0 - _BORDER
    return bool((place > _BORDER).all() and (place < far).all())


def _lengthened(line: Array) -> Array:
    """Go on beyond the tip, as a parabola, so that the tip can be seen to end."""
    t = np.arange(min(len(line), 30))
    ahead = len(t) + np.arange(_BEYOND)
    shape = np.polynomial.polynomial.polyfit(t, line[-len(t) :], 2)
    more = np.polynomial.polynomial.polyval(ahead, shape).T
    return np.concatenate([line, more])
