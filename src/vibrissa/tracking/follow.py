"""Follow a whisker in one view from frame to frame.

Each frame is expected to show what the two before it lead to: from the expected base a Kalman
filter goes outward along the expected curve (`vibrissa.tracking.ridge.march`), past whatever hides
the whisker; the curve found is then measured across and smoothed. If less of it is supported than
was lately, the frame is looked at with fewer expectations: no movement, any curvature, any
direction.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.ends import FEWEST, OUTSIDE, traced
from vibrissa.tracking.likeness import usual_look
from vibrissa.tracking.middle import smooth
from vibrissa.tracking.trace import STEP, Trace, TraceOptions

Array = NDArray[np.float64]

_PROXIMAL = 30

_COLD = 6
"""How many whiskers are looked at that begin near a base."""

_SEARCHED = 5
"""In each so many frames one that is seen shorter than usual is looked for without expectations."""

_CLICK = 20.0
"""How far from a base its whisker may well begin, pixels."""

_BRIGHT = 0.35
"""How bright it is beside a whisker at least, relative to the bright parts of the image."""

_LOOKS = 200
"""Frames over which is remembered how it looks."""

_TURNS = np.radians([-6.0, 6.0, -12.0, 12.0, -18.0, 18.0])

_AROUND = 36.0
"""How far inside the face the base is looked for where it is known by a click only, pixels."""


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
    _unsearched: int = 0
    _looks: list[Array] = field(default_factory=list)
    _usual_look: tuple[Array, Array] = field(default_factory=lambda: usual_look(()))

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

    def follow(self, frame: Frame) -> Trace:
        """Find the whisker in the next frame, without looking at others.

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
        best = Trace.lost()
        for trace in self.along_expected(frame, noise):
            if trace.support > best.support:
                best = trace
        # A whisker may be seen shorter because it turns toward the camera, frame after frame.
        steady = best.support >= 0.85 * float(np.median(self._supports[-3:] or [np.inf]))
        self._unsearched += 1
        if best.support < self.wanted and not (steady and self._unsearched < _SEARCHED):
            self._unsearched = 0
            cold = max(self.from_base(frame, noise), key=self._worth, default=Trace.lost())
            # What is as good without expectations as with them is no better.
            if cold.support > 1.1 * best.support:
                best = cold
        return self.accept(best) if self.belongs(best) else self.lose()

    @property
    def usual(self) -> float:
        """Length that is usually seen, pixels; 0 before anything was."""
        return float(np.median(self._supports)) if self._supports else 0.0

    @property
    def wanted(self) -> float:
        """Length with which it is found without doubt, pixels."""
        return 0.85 * self.usual if self._supports else np.inf

    @property
    def expected(self) -> Array | None:
        """Where the next frame is expected to show it, (n, 2); None before it was ever seen."""
        if self._last is None:
            return None
        if self._before is not None and self._missing == 0:
            return _ahead(self._before.line, self._last.line)
        return self._last.line

    @property
    def last(self) -> Array | None:
        """Where it was seen last, (n, 2)."""
        return None if self._last is None else self._last.line

    @property
    def reach(self) -> float:
        """How far from there it may be, pixels: the farther, the longer it is lost."""
        return self.options.jump + min(self._missing, 60)

    def long_enough(self, trace: Trace) -> bool:
        """Say whether a trace is long enough to be this whisker.

        Parameters
        ----------
        trace : Trace
            In the next frame.

        Returns
        -------
        bool
        """
        return trace.support >= max(self.options.shortest, 0.4 * self.usual)

    def belongs(self, trace: Trace) -> bool:
        """Say whether a trace is long enough, and where the whisker may be.

        Parameters
        ----------
        trace : Trace
            In the next frame.

        Returns
        -------
        bool
            False: it is noise, or another whisker.
        """
        expected = self.expected
        if expected is None or not self.long_enough(trace):
            return self.long_enough(trace)
        n = min(len(expected), len(trace.line), _PROXIMAL)
        away = np.linalg.norm(expected[4:n] - trace.line[4:n], axis=1)
        return float(np.median(away)) <= self.reach

    def accept(self, trace: Trace) -> Trace:
        """Take a trace for the whisker in the next frame.

        Parameters
        ----------
        trace : Trace
            That belongs to it.

        Returns
        -------
        Trace
            The same, less trusted if it is shorter than usual.
        """
        usual = self.usual or trace.support
        self._before = self._last if self._missing == 0 else None
        self._last, self._missing = trace, 0
        self.base = trace.line[0]
        self._supports = [*self._supports[-self.options.memory :], trace.support]
        confidence = min(1.0, trace.confidence * min(1.0, trace.support / max(usual, 1.0)))
        return trace._replace(confidence=confidence)

    @property
    def usual_look(self) -> tuple[Array, Array]:
        """How it usually looks, and by how much that differs (`vibrissa.tracking.likeness`)."""
        return self._usual_look

    def remember(self, look: Array) -> None:
        """Learn how it looks.

        Parameters
        ----------
        look : array
            In a frame in which it was found.
        """
        self._looks = [*self._looks[-_LOOKS + 1 :], look]
        self._usual_look = usual_look(self._looks)

    def lose(self) -> Trace:
        """Go on without the whisker in the next frame.

        Returns
        -------
        Trace
            An empty one.
        """
        self._missing += 1
        return Trace.lost()

    def carry(self, angle: float, shift: Array) -> None:
        """Let the whisker, while it is lost, move as others do.

        Parameters
        ----------
        angle : float
            By which it turns about its base, rad, from the columns toward the rows.
        shift : array (2,)
            By which its base moves.
        """
        if self._last is not None:
            line = turned_line(self._last.line, angle) + shift
            self._last = self._last._replace(line=line)
            self.base = line[0]

    def along_expected(self, frame: Frame, noise: float) -> Iterator[Trace]:
        """Trace along where it is expected, until it is found without doubt.

        Parameters
        ----------
        frame : array (height, width)
            Grey values.
        noise : float
            Of the image.

        Yields
        ------
        Trace
            With fewer and fewer expectations.
        """
        for guess in self._guesses():
            trace = self._along(frame, noise, *guess)
            yield trace
            if trace.support >= self.wanted:
                return

    def along_turned(self, frame: Frame, noise: float) -> Iterator[Trace]:
        """Trace along where it would be had it turned about its base.

        Parameters
        ----------
        frame : array (height, width)
            Grey values.
        noise : float
            Of the image.

        Yields
        ------
        Trace
            Of one turn after the other.
        """
        expected = self.expected
        if expected is not None:
            for angle in _TURNS:
                yield self._along(frame, noise, turned_line(expected, angle), "loose")

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

    def from_base(self, frame: Frame, noise: float, apart: float = np.inf) -> list[Trace]:
        """Trace in any direction from the base, without expectations.

        Parameters
        ----------
        frame : array (height, width)
            Grey values.
        noise : float
            Of the image.
        apart : float
            How far the base is from that of another whisker, pixels.

        Returns
        -------
        list of Trace
            Different ones, that run where it is bright: what is seen on the face is fur.
        """
        bend = np.zeros(int(np.hypot(*frame.shape) / STEP))
        tries = []
        for angle in np.radians(np.arange(0.0, 360.0, 6.0)):
            away = 4.0 * self.options.scale * np.array([np.cos(angle), np.sin(angle)])
            start = np.array([*(self.base + away), angle])
            line, support = self._march(frame, noise, start, bend, "cold", apart / 6.0)
            tries.append((line, support))
        tries.sort(key=lambda t: -float(np.minimum(t[1], 8.0).sum()))
        bright = _BRIGHT * float(np.percentile(frame[::8, ::8], 90.0))
        kept: list[Array] = []
        found: list[Trace] = []
        for line, support in tries:
            if len(found) == _COLD:
                break
            if len(line) < FEWEST or any(_alike(line, other) for other in kept):
                continue
            kept.append(line)
            trace = self._finished(frame, noise, line, support, _AROUND)
            if len(trace.line) and _surroundings(frame, trace.line) > bright:
                found.append(trace)
        return found

    def _worth(self, trace: Trace) -> float:
        """Length that is seen, less the farther from where it is to begin."""
        away = float(np.linalg.norm(trace.line[0] - self.base)) / _CLICK
        return trace.support * float(np.exp(-0.5 * away**2))

    def _march(
        self,
        frame: Frame,
        noise: float,
        start: Array,
        bend: Array,
        manner: str,
        beside: float = np.inf,
    ) -> tuple[Array, Array]:
        spread, drift = _SPREADS[manner]
        spread = np.array([min(spread[0], beside), *spread[1:]])
        line, support = np.empty((len(bend) + 1, 2)), np.empty(len(bend) + 1)
        o = self.options
        count = ridge.march(
            frame, start, bend, spread, drift, STEP, o.bridge, noise, o.scale, line, support
        )
        return line[:count], support[:count]

    def _finished(
        self, frame: Frame, noise: float, line: Array, support: Array, before: float = OUTSIDE
    ) -> Trace:
        """Smooth a marched line over what is hidden, then measure it."""
        if len(line) < FEWEST:
            return Trace.lost()
        line = smooth(line, np.where(support > 0.0, 4.0, 0.0), self.options.stiffness)
        return traced(frame, noise, line, self.options, before)[0]


def turned_line(line: Array, angle: float) -> Array:
    """Turn a line about its first point."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(line[0] + (line - line[0]) @ np.array([[c, s], [-s, c]]))


def _alike(line: Array, other: Array) -> bool:
    """Whether two lines begin in the same way."""
    n = min(len(line), len(other), 2 * _PROXIMAL)
    distance = np.linalg.norm(line[n // 3 : n, None] - other[None, : n + 5], axis=2).min(axis=1)
    return bool(np.median(distance) < 2.0)


def _surroundings(frame: Frame, line: Array) -> float:
    """Grey value beside the beginning of a line."""
    part = np.ascontiguousarray(line[3:23])
    levels = np.empty((len(part), 2))
    ridge.beside(frame, part, 8.0, levels)
    return float(np.median(levels)) if len(part) else 0.0


def _ahead(before: Array, last: Array) -> Array:
    """Where a line goes if it moves on as it did."""
    n = min(len(before), len(last))
    velocity = last[:n] - before[:n]
    if n < len(last):
        velocity = np.concatenate([velocity, np.repeat(velocity[-1:], len(last) - n, axis=0)])
    return last + velocity


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
