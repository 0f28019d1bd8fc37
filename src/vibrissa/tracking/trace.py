"""Trace a whisker in one view: its middle, frame after frame, to a fraction of a pixel.

Each frame is expected to show what the two before it lead to: from the expected base a Kalman
filter goes outward along the expected curve (`vibrissa.tracking.ridge.march`), past whatever hides
the whisker; the curve found is then measured across and smoothed. If less of it is supported than
was lately, the frame is looked at with fewer expectations: no movement, any curvature, any
direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io.video import Frame
from vibrissa.tracking import ridge

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEP = 2.0
"""Between points of a trace, pixels."""

_SUPPORTED = 2.5
_FEWEST = 12
_PROXIMAL = 30
_FUR = 3
_BEYOND = 12
"""How many points beyond the last that is seen are looked at to find the tip."""

_BESIDE = (4.0, 7.0)
"""How far beside the whisker the face's edge is looked for, pixels."""

_OUTSIDE = 12.0
"""How far inside the face the base is looked for, pixels."""

_AROUND = 36.0
"""The same where the base is known by a click only."""


@dataclass(frozen=True)
class TraceOptions:
    """How a whisker is traced.

    Parameters
    ----------
    bridge : float
        Longest piece that may be hidden, pixels.
    stiffness : float
        Of the smoothing, which lets through waves along the whisker longer than about
        6 · stiffness^(1/6) steps where it is seen to 0.1 pixel.
    scale : float
        Distance of samples across the whisker, pixels: about a third of its width at the base, but
        not below 1.
    shortest : float
        Shortest whisker that counts, pixels.
    jump : float
        How far the whisker's first 60 pixels may be from where they are expected, pixels. What is
        farther away is another whisker. Each frame in which it is lost adds a pixel.
    memory : int
        Frames over which the usual length is remembered.
    """

    bridge: float = 90.0
    stiffness: float = 3e5
    scale: float = 1.0
    shortest: float = 40.0
    jump: float = 5.0
    memory: int = 25


class Trace(NamedTuple):
    """A whisker in one frame of one view.

    Parameters
    ----------
    line : array (n, 2)
        Column and row from base to tip, `STEP` pixels apart.
    sigma : array (n,)
        Standard deviation across, pixels.
    seen : array (n,)
        Whether each point is seen, not bridged.
    confidence : float
        Between 0 and 1.
    """

    line: Array
    sigma: Array
    seen: Mask
    confidence: float

    @classmethod
    def lost(cls) -> Trace:
        """Make a trace of nothing, with confidence 0.

        Returns
        -------
        Trace
            Without points.
        """
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0, dtype=bool), 0.0)

    @property
    def length(self) -> float:
        """Along the line, pixels."""
        return STEP * max(len(self.line) - 1, 0)

    @property
    def support(self) -> float:
        """Length that is seen, pixels."""
        return STEP * float(self.seen.sum())


Memory = tuple[Array, Trace | None, Trace | None, int, list[float]]
"""What a `Follower` knows."""

_SPREADS = {
    "tight": (np.array([1.0, 0.03, 2e-4]), 4e-5),
    "loose": (np.array([1.5, 0.10, 2e-3]), 3e-4),
    "cold": (np.array([2.0, 0.20, 4e-3]), 4e-4),
}


@dataclass
class Follower:
    """One whisker in one view, from frame to frame.

    Parameters
    ----------
    base : array (2,)
        About where it leaves the face, column and row.
    options : TraceOptions
        How it is traced.
    """

    base: Array
    options: TraceOptions = field(default_factory=TraceOptions)
    _before: Trace | None = None
    _last: Trace | None = None
    _missing: int = 0
    _supports: list[float] = field(default_factory=list)

    def restart(self, trace: Trace) -> None:
        """Go on from a trace that is known to be right.

        Parameters
        ----------
        trace : Trace
            In the frame before the next.
        """
        self._before, self._last, self._missing = None, trace, 0
        self.base = trace.line[0]
        self._supports = [trace.support]

    def memory(self) -> Memory:
        """Give what is known so far, so that a frame can be taken back with `forget`.

        Returns
        -------
        tuple
            For `forget` only.
        """
        return self.base, self._before, self._last, self._missing, self._supports

    def forget(self, memory: Memory) -> None:
        """Go back to what was known, the whisker being lost now.

        Parameters
        ----------
        memory : tuple
            Of `memory`.
        """
        self.base, self._before, self._last, self._missing, self._supports = memory
        self._missing += 1

    def follow(self, frame: Frame) -> Trace:
        """Find the whisker in the next frame.

        Parameters
        ----------
        frame : array (height, width)
            Grey values.

        Returns
        -------
        Trace
            Empty if it is lost.
        """
        noise = ridge.noise_level(frame)
        wanted = 0.85 * float(np.median(self._supports)) if self._supports else np.inf
        best = Trace.lost()
        for guess in self._guesses():
            trace = self._along(frame, noise, *guess)
            if trace.support > best.support:
                best = trace
            if best.support >= wanted:
                break
        else:
            cold = self._from_base(frame, noise)
            # What is as good without expectations as with them is no better.
            if cold.support > 1.1 * best.support:
                best = cold
        return self._remember(best)

    def _guesses(self) -> list[tuple[Array, str]]:
        if self._last is None:
            return []
        last, guesses = self._last.line, []
        if self._before is not None and self._missing == 0:
            guesses.append((_ahead(self._before.line, last), "tight"))
        guesses += [(last, "tight"), (last, "loose")]
        if len(guesses) == 3:
            guesses.insert(1, (guesses[0][0], "loose"))
        return guesses

    def _remember(self, trace: Trace) -> Trace:
        usual = float(np.median(self._supports)) if self._supports else trace.support
        if trace.support < max(self.options.shortest, 0.4 * usual) or self._jumped(trace):
            self._missing += 1
            return Trace.lost()
        self._before, self._last, self._missing = self._last, trace, 0
        if self._missing:
            self._before = None
        self.base = trace.line[0]
        self._supports = [*self._supports[-self.options.memory :], trace.support]
        confidence = min(1.0, trace.confidence * min(1.0, trace.support / max(usual, 1.0)))
        return trace._replace(confidence=confidence)

    def _jumped(self, trace: Trace) -> bool:
        """Whether a trace begins elsewhere: then it is that of another whisker."""
        if self._last is None:
            return False
        last = self._last.line
        if self._before is not None and self._missing == 0:
            last = _ahead(self._before.line, last)
        n = min(len(last), len(trace.line), _PROXIMAL)
        away = np.linalg.norm(last[4:n] - trace.line[4:n], axis=1)
        # The longer it is lost, the farther it may have gone.
        return float(np.median(away)) > self.options.jump + min(self._missing, 60)

    def _along(self, frame: Frame, noise: float, guess: Array, manner: str) -> Trace:
        """Trace along an expected curve."""
        tangent = np.arctan2(*np.diff(guess, axis=0).T[::-1])
        bend = np.diff(np.unwrap(tangent)) / STEP
        wide = min(9, len(bend) | 1)
        padded = np.pad(bend, wide // 2, mode="edge")
        bend = np.convolve(padded, np.ones(wide) / wide, mode="valid")
        extra = int(self.options.bridge / STEP) + 20
        bend = np.concatenate([bend, np.full(extra, bend[-20:].mean())])
        chord = guess[min(6, len(guess) - 1)] - guess[0]
        start = np.array([*guess[0], np.arctan2(chord[1], chord[0]) - 3.0 * STEP * bend[:6].mean()])
        return self._finished(frame, noise, *self._march(frame, noise, start, bend, manner))

    def _from_base(self, frame: Frame, noise: float) -> Trace:
        """Trace in any direction from the base, without expectations."""
        bend = np.zeros(int(np.hypot(*frame.shape) / STEP))
        tries = []
        for angle in np.radians(np.arange(0.0, 360.0, 6.0)):
            away = 4.0 * self.options.scale * np.array([np.cos(angle), np.sin(angle)])
            start = np.array([*(self.base + away), angle])
            line, support = self._march(frame, noise, start, bend, "cold")
            tries.append((line, support))
        tries.sort(key=lambda t: -float(np.minimum(t[1], 8.0).sum()))
        finished = [self._finished(frame, noise, *t, _AROUND) for t in tries[:3]]
        return max(finished, key=lambda trace: trace.support)

    def _march(
        self, frame: Frame, noise: float, start: Array, bend: Array, manner: str
    ) -> tuple[Array, Array]:
        spread, drift = _SPREADS[manner]
        line, support = np.empty((len(bend) + 1, 2)), np.empty(len(bend) + 1)
        o = self.options
        count = ridge.march(
            frame, start, bend, spread, drift, STEP, o.bridge, noise, o.scale, line, support
        )
        return line[:count], support[:count]

    def _finished(
        self, frame: Frame, noise: float, line: Array, support: Array, before: float | None = None
    ) -> Trace:
        """Smooth a marched line over what is hidden, then measure it."""
        if len(line) < _FEWEST:
            return Trace.lost()
        line = _smooth(line, np.where(support > 0.0, 4.0, 0.0), self.options.stiffness)
        return traced(frame, noise, line, self.options, before or _OUTSIDE)[0]


class _Fit(NamedTuple):
    """What was measured along a line."""

    amplitude: Array
    sigma: Array
    seen: Mask
    open: Mask  # not beside or behind something dark


def traced(
    frame: Frame, noise: float, line: Array, options: TraceOptions, before: float = 12.0
) -> tuple[Trace, bool]:
    """Trace a whisker that is about known, and find its ends.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.
    noise : float
        Of the image.
    line : array (n, 2)
        Within three pixels of the whisker, from about the base to about the tip.
    options : TraceOptions
        How.
    before : float
        How far before its beginning the face may end, pixels.

    Returns
    -------
    trace : Trace
        Empty if there is nothing.
    from_face : bool
        Whether it begins at something dark.
    """
    line = _lengthened(even(line))
    for gate in (3, 2):
        line = even(smoothed(frame, line, gate, noise, options)[0])
    line, from_face = with_base(frame, line, before)
    if before > _OUTSIDE:
        # What was only guessed is measured before it counts.
        line = even(smoothed(frame, line, 3, noise, options, _FUR if from_face else 0)[0])
    line, fit = smoothed(frame, line, 1, noise, options, _FUR if from_face else 0)
    count = tip(fit, noise)
    if count < _FEWEST:
        return Trace.lost(), False
    seen = fit.seen[:count]
    trusted = min(1.0, float(seen.sum() / max(fit.open[:count].sum(), 1)))
    return Trace(line[:count], fit.sigma[:count], seen, trusted), from_face


def smoothed(
    frame: Frame, line: Array, gate: int, noise: float, options: TraceOptions, skipped: int = 0
) -> tuple[Array, _Fit]:
    """Measure across a line and smooth it.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.
    line : array (n, 2)
        Near the whisker.
    gate : int
        How far from it to look, samples.
    noise : float
        Of the image.
    options : TraceOptions
        How.
    skipped : int
        Points at the base that are not measured, because the face's edge is beside them.

    Returns
    -------
    line : array (n, 2)
        Nearer the whisker, point by point.
    fit : _Fit
        What was measured.
    """
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
    better = _smooth(measured, weight, options.stiffness)
    # What lies far from its neighbours counts less, the second time.
    miss = ((measured - better) ** 2).sum(axis=1) * weight
    weight = np.where(miss > 9.0, weight * 9.0 / np.maximum(miss, 9.0), weight)
    better = _smooth(measured, weight, options.stiffness)
    information = np.convolve(weight, np.ones(min(9, n)), mode="same")
    places = np.arange(n)
    known = np.flatnonzero(seen)
    away = np.full(n, 1e3) if not known.size else _distance_to(places, known)
    sigma = 1.0 / np.sqrt(np.maximum(information, 1.0)) + 0.05 * (0.1 * STEP * away) ** 1.5
    open_ = flank > 0.6 * np.median(flank)
    return better, _Fit(amplitude, sigma, seen, open_)


def _smooth(line: Array, weight: Array, stiffness: float) -> Array:
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


def _lengthened(line: Array) -> Array:
    """Go on beyond the tip, as a parabola, so that the tip can be seen to end."""
    t = np.arange(min(len(line), 30))
    ahead = len(t) + np.arange(_BEYOND)
    shape = np.polynomial.polynomial.polyfit(t, line[-len(t) :], 2)
    more = np.polynomial.polynomial.polyval(ahead, shape).T
    return np.concatenate([line, more])


def even(line: Array, start: float = 0.0) -> Array:
    """Put points `STEP` apart along a line (n, 2), from an arc length on; below zero: before it."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    wanted = np.arange(start, s[-1] + 1e-9, STEP)
    if start < 0.0:
        direction = (line[min(4, len(line) - 1)] - line[0]) / s[min(4, len(line) - 1)]
        s = np.concatenate([[start], s])
        line = np.concatenate([[line[0] + start * direction], line])
    return np.stack([np.interp(wanted, s, line[:, k]) for k in range(2)], axis=1)


def with_base(frame: Frame, line: Array, before: float) -> tuple[Array, bool]:
    """Let a line begin where the whisker leaves the face.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.
    line : array (n, 2)
        From about there outward.
    before : float
        How far before its beginning that may be, pixels.

    Returns
    -------
    line : array (m, 2)
        From the base on; the same line if nothing dark is at its beginning.
    from_face : bool
        Whether there is.
    """
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


def tip(fit: _Fit, noise: float) -> int:
    """Say how many points of a line belong to the whisker.

    Beyond the tip the line is as light as its surroundings; before it, it goes on being about as
    dark as it was. The end is where that is most likely, by the sum of log-likelihood ratios.

    Parameters
    ----------
    fit : _Fit
        Measured along the line and beyond the tip.
    noise : float
        Of the image.

    Returns
    -------
    int
        Points up to the tip.
    """
    sigma = noise * np.sqrt(ridge.DEPTH_VARIANCE)
    amplitude = np.where(fit.open, fit.amplitude, 0.0)
    count = np.convolve(fit.open.astype(float), np.ones(20))[: len(amplitude)]
    recent = np.convolve(np.maximum(amplitude, 0.0), np.ones(20))[: len(amplitude)]
    # What the twenty points before were; the whisker tapers, so that it may be fainter.
    usual = 0.6 * np.concatenate([[0.0], (recent / np.maximum(count, 1.0))[:-1]])
    gain = np.where(fit.open, (amplitude * usual - 0.5 * usual**2) / sigma**2, 0.0)
    return int(np.argmax(np.cumsum(np.clip(gain, -8.0, 8.0)))) + 1


def _ahead(before: Array, last: Array) -> Array:
    """Where a line goes if it moves on as it did."""
    n = min(len(before), len(last))
    velocity = last[:n] - before[:n]
    if n < len(last):
        velocity = np.concatenate([velocity, np.repeat(velocity[-1:], len(last) - n, axis=0)])
    return last + velocity


def given(points: ArrayLike) -> Trace:
    """Make a trace of points that a person says are right.

    Parameters
    ----------
    points : array_like (n, 2)
        Column and row, from base to tip; at least two.

    Returns
    -------
    Trace
        A smooth curve through them, known to half a pixel.

    Raises
    ------
    ValueError
        If there are less than two points, or they are no finite pixels.
    """
    from scipy.interpolate import make_interp_spline

    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < 2 or not np.isfinite(array).all():
        raise ValueError(f"points of shape {array.shape} are no trace; (n, 2), n ≥ 2, is needed")
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(array, axis=0), axis=1))])
    if not (np.diff(s) > 0.0).all():
        raise ValueError("two points of a trace are the same")
    spline = make_interp_spline(s, array, k=min(3, len(array) - 1))
    line = even(np.asarray(spline(np.linspace(0.0, s[-1], int(s[-1]) + 2))))
    return Trace(line, np.full(len(line), 0.5), np.ones(len(line), dtype=bool), 1.0)


def start_at(base: ArrayLike, options: TraceOptions | None = None) -> Follower:
    """Begin to follow the whisker that starts about at a place.

    Parameters
    ----------
    base : array_like (2,)
        Column and row, pixels.
    options : TraceOptions, optional
        How it is traced.

    Returns
    -------
    Follower

    Raises
    ------
    ValueError
        If the base is no place.
    """
    place = np.asarray(base, dtype=np.float64)
    if place.shape != (2,) or not np.isfinite(place).all():
        raise ValueError(f"base is {place.tolist()}; a column and a row are needed")
    return Follower(place, options or TraceOptions())
