"""Follower of one whisker in one view from frame to frame, with a model of its appearance.

The two frames before predict the next one: from the expected base a Kalman filter proceeds outward
along the expected curve (`vibrissa.tracking.trace.ridge.march`), past whatever hides the whisker;
the resulting curve is then measured across and smoothed. If less of it is supported than recently,
the frame is searched with fewer expectations: no motion, any curvature, any direction.

The appearance of a whisker, which identifies it where its position does not, consists of the length
that is seen, the darkness compared with the surroundings, from its base outward, and the turns from
one piece to the next. The first two are logarithms, so that differences are relative. Features of
parts that are not visible are NaN. An object that the whisker meets may bend it, which changes all
turns at once: the last feature states whether it meets one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.io import Frame
from vibrissa.numerics import Array
from vibrissa.tracking.trace.ends import OUTSIDE, grey_flanks, traced
from vibrissa.tracking.trace.ridge import FEWEST, march, measure, middle, noise_level, smooth
from vibrissa.tracking.trace.trace import (
    NOTHING,
    STEP,
    Clutter,
    Trace,
    TraceOptions,
    aligned,
    distances,
    overlap,
    tangent,
)

# Points of a trace over which darkness and direction are averaged.
_DARK = ((5, 25), (25, 50), (50, 80))
_ALONG = ((3, 11), (20, 28), (40, 48), (60, 68))
_TURNS = slice(1 + len(_DARK), len(_DARK) + len(_ALONG))
FEATURES = _TURNS.stop + 1
_MEETS = 15  # number of points from the base beyond which it meets objects

# Smallest standard deviation of a whisker's appearance between frames.
_SPREAD = np.array([0.12, *[0.15] * len(_DARK), *[0.03] * (len(_ALONG) - 1), 1.0])
# Factor of the spread toward shorter lengths: a whisker may be hidden, but is never longer.
_SHORTER = 3.0
# Standard deviations at which a difference saturates: contact bends, blur reduces contrast.
_MOST = 3.0
_HIDDEN = 2.0  # standard deviations that count where a line lacks a usual feature
_WEIGHT = 0.5  # weight of the sum of squares: pieces of one whisker do not change independently
ENOUGH = 5  # number of frames after which the appearance of a whisker is known
_REMEMBERED = 200  # number of frames over which its appearance is remembered
_LEARNED = 20  # number of frames from which it changes too slowly to be updated in each frame
_PROXIMAL = 30  # points at the beginning of a line by which it is compared with the expected one
_TURNED = 0.87  # cosine of the largest turn between frames of a whisker that is wholly seen, 30°
_COLD = 6  # number of lines near a base that are traced without expectations
# Number of frames after which a whisker that is seen shorter is searched without expectations.
_SEARCHED = 5
# Share of the usual length above which a whisker is certainly found, and the smallest share.
_WANTED, _LEAST = 0.85, 0.4
_BETTER = 1.1  # factor by which a line that is found without expectations must be longer
_REPEATED = 0.5  # largest distance of two marches along the same path, pixels
_CLICK = 20.0  # standard deviation of a click from the base of its whisker, pixels
# Smallest brightness on both sides of a whisker, relative to the bright parts of the image.
_BRIGHT = 0.35
_ASIDE = np.array([8.0])  # distance from a whisker at which its surroundings are measured, pixels
# Depth inside the face within which the base is searched after a click, pixels.
_AROUND = 36.0
# Standard deviations of offset, direction and curvature at the start, and drift of the last.
_SPREADS = {
    "tight": (np.array([1.0, 0.03, 2e-4]), 4e-5),
    "loose": (np.array([1.5, 0.10, 2e-3]), 3e-4),
    "cold": (np.array([2.0, 0.20, 4e-3]), 4e-4),
}


class Appearance(NamedTuple):
    """Usual appearance of a whisker, and its variation."""

    middle: Array
    spread: Array

    @classmethod
    def of(cls, features: Sequence[Array]) -> Appearance:
        """Appearance from the features in some frames."""
        if len(features) < ENOUGH:
            return cls(np.full(FEATURES, np.nan), _SPREAD)
        known = np.array(features)
        known[np.isinf(known)] = np.nan
        usual = _medians(known)
        spread = 1.4826 * _medians(np.abs(known - usual))
        return cls(usual, np.hypot(_SPREAD, np.nan_to_num(spread)))

    def unlikeness(self, features: Array) -> Array:
        """Negative log-likelihood (...) that lines of some features (..., n) are this whisker."""
        away = (features - self.middle) / self.spread
        length = away[..., 0]
        length[length < 0.0] /= _SHORTER
        missing = np.isnan(features) & np.isfinite(self.middle)
        away[missing & np.isfinite(features[..., :1])] = _HIDDEN
        away[np.isinf(features)] = 0.0
        square = np.nan_to_num(away) ** 2
        square[..., -1] = 0.0
        bent = features[..., -1] > 0.0
        square[bent, _TURNS.start] = square[bent, _TURNS].sum(axis=-1)
        square[bent, _TURNS.start + 1 : _TURNS.stop] = 0.0
        return np.asarray(0.5 * _WEIGHT * np.minimum(square, _MOST**2).sum(axis=-1))


def _medians(values: Array) -> Array:
    """Median of each column without NaN, without the checks of NumPy, which take longer."""
    count = np.isfinite(values).sum(axis=0)
    ordered, columns = np.sort(values, axis=0), np.arange(values.shape[1])
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)
    both = 0.5 * (ordered[low, columns] + ordered[high, columns])
    return np.asarray(np.where(count > 0, both, np.nan))


def features_of(frame: Frame, trace: Trace, clutter: Clutter = NOTHING) -> Array:
    """Features of a traced whisker: length, darkness and turns; infinite where others hide them."""
    features = np.full(FEATURES, np.nan)
    n = len(trace.line)
    if n < 2 or not trace.seen.any():
        return features
    points, amplitude, flank, support = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    line = np.ascontiguousarray(trace.line)
    measure(frame, line, 1, 1.0, 1.0, *NOTHING, points, amplitude, flank, support)
    contrast = amplitude / np.maximum(flank, 1.0)
    hidden = clutter.hides(line) & ~trace.seen
    features[0] = np.log(trace.support + STEP * float(hidden.sum()))
    for i, (a, b) in enumerate(_DARK):
        seen = contrast[a:b][trace.seen[a:b]]
        if 2 * len(seen) >= b - a:
            features[1 + i] = np.log(max(float(np.median(seen)), 1e-3))
        elif 2 * (len(seen) + hidden[a:b].sum()) >= b - a:
            features[1 + i] = np.inf
    steps = np.diff(line, axis=0)
    angle = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    along = [float(angle[a:b].mean()) if len(angle) >= b else np.nan for a, b in _ALONG]
    features[_TURNS] = np.diff(along)
    features[-1] = clutter.disturbs(line[_MEETS:]).any()
    return features


@dataclass
class Follower:
    """One whisker in one view, followed from frame to frame; its base is near the face's edge."""

    base: Array
    options: TraceOptions = field(default_factory=TraceOptions)
    _before: Trace | None = None
    _last: Trace | None = None
    _missing: int = 0
    _supports: list[float] = field(default_factory=list)
    _unsearched: int = 0
    _features: list[Array] = field(default_factory=list)
    _learned: int = 0
    appearance: Appearance = field(default_factory=lambda: Appearance.of(()))
    clutter: Clutter = NOTHING

    def restart(self, trace: Trace) -> None:
        """Continue from a trace of the last frame that is known to be correct."""
        self._before, self._last, self._missing = None, trace, 0
        self.base = trace.line[0]
        self._supports = [self.length_of(trace)]

    def follow(self, frame: Frame) -> Trace:
        """Find the whisker in the next frame, regardless of others; empty if it is lost."""
        noise, best = noise_level(frame), Trace.lost()
        for trace in self.along_expected(frame, noise):
            if self.length_of(trace) > self.length_of(best):
                best = trace
        length = self.length_of(best)
        steady = bool(self._supports) and length >= _WANTED * self._lately
        self._unsearched += 1
        belongs = self._belongs(best)
        waits = length >= self.wanted or (steady and self._unsearched < _SEARCHED)
        if not (belongs and waits):
            self._unsearched = 0
            # A trace without expectations must be better than one with them.
            least = _BETTER * length * belongs
            cold = max(self.from_base(frame, noise, least), key=self._worth, default=Trace.lost())
            if cold.support > least:
                best, belongs = cold, self._belongs(cold)
        return self.accept(best) if belongs else self.lose()

    def length_of(self, trace: Trace) -> float:
        """Length that is seen or hidden by clutter, pixels."""
        if trace.seen.all():
            return trace.support
        return trace.support + STEP * float(self.clutter.hides(trace.line[~trace.seen]).sum())

    @property
    def usual(self) -> float:
        """Length that is usually seen, pixels; 0 at first."""
        return median(self._supports) if self._supports else 0.0

    @property
    def _lately(self) -> float:
        """Length seen recently, pixels; it decreases as the whisker turns to the camera."""
        return median(self._supports[-3:]) if self._supports else 0.0

    @property
    def wanted(self) -> float:
        """Length above which the whisker is certainly found, pixels."""
        return _WANTED * self.usual if self._supports else np.inf

    @property
    def expected(self) -> Array | None:
        """Expected line in the next frame, (n, 2); None before the first one."""
        moving = self._moving
        return self.last if moving is None else moving

    @property
    def last(self) -> Array | None:
        """Line on which it was last seen, (n, 2)."""
        return None if self._last is None else self._last.line

    @property
    def _moving(self) -> Array | None:
        """Expected line if the motion continues; None if that is unknown."""
        if self._last is None or self._before is None or self._missing:
            return None
        before, last = self._before.line, self._last.line
        n = min(len(before), len(last))
        # Across only: the start of the visible part varies along the whisker without any motion.
        across = tangent(last[:n])[:, ::-1] * [-1.0 / STEP, 1.0 / STEP]
        velocity = ((last[:n] - before[:n]) * across).sum(axis=1, keepdims=True) * across
        beyond = np.repeat(velocity[-1:], len(last) - n, axis=0)
        return np.asarray(last + np.concatenate([velocity, beyond]))

    @property
    def reach(self) -> float:
        """Largest distance from the expected line, pixels; it grows while the whisker is lost."""
        return self.options.jump + min(self._missing, 60)

    def long_enough(self, trace: Trace) -> bool:
        """Whether a trace is long enough to be this whisker."""
        usual = self.usual if self._missing else min(self.usual, self._lately)
        least = max(self.options.shortest, _LEAST * usual)
        return self.length_of(trace) >= least and trace.support >= 0.5 * self.options.shortest

    def _belongs(self, trace: Trace) -> bool:
        """Whether a trace is long enough, and where the whisker may be."""
        expected, last = self.expected, self.last
        if expected is None or last is None or not self.long_enough(trace):
            return self.long_enough(trace)
        away = distances(expected[4:_PROXIMAL], trace.line[: 2 * _PROXIMAL])
        if middle(away) <= self.reach:
            return True
        # It may have turned about its base by more if all of it, and nothing else, is seen.
        share = self.length_of(trace) / max(self.usual, 1.0)
        base = distances(last[:1], trace.line[:_PROXIMAL])[0]
        whole = _WANTED <= share <= 1.0 / _WANTED and aligned(last, trace.line) > _TURNED
        return bool(whole and base <= self.options.jump)

    def accept(self, trace: Trace) -> Trace:
        """Accept a trace as the whisker in the next frame; less confident if it is short."""
        length = self.length_of(trace)
        usual = self.usual or length
        self._before = self._last if self._missing == 0 else None
        self._last, self._missing = trace, 0
        self.base = trace.line[0]
        self._supports = [*self._supports[-self.options.memory :], length]
        confidence = min(1.0, trace.confidence * min(1.0, length / max(usual, 1.0)))
        return trace._replace(confidence=confidence)

    def remember(self, features: Array) -> None:
        """Update its appearance from a frame in which it was found."""
        self._features = [*self._features[-_REMEMBERED + 1 :], features]
        self._learned += 1
        if self._learned <= _LEARNED or self._learned % ENOUGH == 0:
            self.appearance = Appearance.of(self._features)

    def lose(self) -> Trace:
        """Continue without the whisker in the next frame; an empty trace."""
        self._missing += 1
        return Trace.lost()

    def carry(self, angle: float, shift: Array) -> None:
        """While it is lost, turn the whisker about its base and shift it as the others."""
        if self._last is not None:
            line = _turned(self._last.line, angle) + shift
            self._last = self._last._replace(line=line)
            self.base = line[0]

    def along_expected(self, frame: Frame, noise: float) -> Iterator[Trace]:
        """Trace near the expected line, with fewer and fewer expectations, until found."""
        if self.last is None:
            return
        moving = self._moving
        guesses = [(self.last, "tight"), (self.last, "loose")]
        if moving is not None:
            guesses = [(moving, "tight"), (moving, "loose"), *guesses]
        tried: list[tuple[Array, Trace]] = []
        for guess in guesses:
            march = self._expected_march(frame, noise, *guess)
            # Marches along the same path are traced once.
            trace = next((one for line, one in tried if _repeats(march[0], line)), None)
            if trace is None:
                trace = self._finished(frame, noise, *march)
                tried.append((march[0], trace))
            yield trace
            if self.length_of(trace) >= self.wanted:
                return

    def along(self, frame: Frame, noise: float, guess: Array, manner: str) -> Trace:
        """Trace along an expected curve."""
        return self._finished(frame, noise, *self._expected_march(frame, noise, guess, manner))

    def _expected_march(
        self, frame: Frame, noise: float, guess: Array, manner: str
    ) -> tuple[Array, Array]:
        """Line and support of a march along an expected curve."""
        angle = np.arctan2(*(guess[1:] - guess[:-1]).T[::-1])
        turn = angle[1:] - angle[:-1]
        bend = (turn - 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))) / STEP
        wide = min(9, len(bend) | 1)
        half = wide // 2
        padded = np.concatenate([bend[:1].repeat(half), bend, bend[-1:].repeat(half)])
        bend = np.convolve(padded, np.full(wide, 1.0 / wide), mode="valid")
        extra = int(self.options.bridge / STEP) + 20
        bend = np.concatenate([bend, np.full(extra, bend[-20:].mean())])
        chord = guess[min(6, len(guess) - 1)] - guess[0]
        start = np.array([*guess[0], np.arctan2(chord[1], chord[0]) - 3.0 * STEP * bend[:6].mean()])
        return self._march(frame, noise, start, bend, manner)

    def from_base(self, frame: Frame, noise: float, least: float = 0.0) -> list[Trace]:
        """Trace in all directions from the base, except lines shorter than a length, pixels.

        The traces are distinct and on bright ground: lines on the face are fur.
        """
        bend = np.zeros(int(np.hypot(*frame.shape) / STEP))
        tries = []
        for angle in np.radians(np.arange(0.0, 360.0, 6.0)):
            away = 4.0 * self.options.scale * np.array([np.cos(angle), np.sin(angle)])
            start = np.array([*(self.base + away), angle])
            tries.append(self._march(frame, noise, start, bend, "cold"))
        tries.sort(key=lambda t: -float(np.minimum(t[1], 8.0).sum()))
        bright = _BRIGHT * float(np.percentile(frame[::8, ::8], 90.0))
        kept: list[Array] = []
        found: list[Trace] = []
        for line, support in tries:
            if len(found) == _COLD:
                break
            if len(line) < FEWEST or STEP * float((support > 0.0).sum()) + _AROUND < least:
                continue
            if any(_alike(line, other) for other in kept):
                continue
            kept.append(line)
            trace = self._finished(frame, noise, line, support, _AROUND)
            part = trace.line[3:23]
            if len(part) and middle(grey_flanks(frame, part, _ASIDE).ravel()) > bright:
                found.append(trace)
        return found

    def _worth(self, trace: Trace) -> float:
        """Seen length, reduced by the distance from its expected base, more for longer lines."""
        away = float(np.linalg.norm(trace.line[0] - self.base)) / _CLICK
        longer = _WANTED * trace.support / self.usual if self.usual else 1.0
        return trace.support * float(np.exp(-0.5 * away**2)) / max(longer, 1.0) ** 2

    def _march(
        self, frame: Frame, noise: float, start: Array, bend: Array, manner: str
    ) -> tuple[Array, Array]:
        """Line and support of a march."""
        line, support = np.empty((len(bend) + 1, 2)), np.empty(len(bend) + 1)
        o, how, clutter = self.options, _SPREADS[manner], self.clutter
        count = march(
            frame, start, bend, *how, STEP, o.bridge, noise, o.scale, *clutter, line, support
        )
        return line[:count], support[:count]

    def _finished(
        self, frame: Frame, noise: float, line: Array, support: Array, before: float = OUTSIDE
    ) -> Trace:
        """Smooth a marched line over hidden parts, then measure it."""
        if len(line) < FEWEST:
            return Trace.lost()
        line = smooth(line, np.where(support > 0.0, 4.0, 0.0), self.options.stiffness)
        return traced(frame, noise, line, self.options, before, self.clutter)[0]


def _turned(line: Array, angle: float) -> Array:
    """Rotate a line about its first point, from the columns toward the rows."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(line[0] + (line - line[0]) @ np.array([[c, s], [-s, c]]))


def _repeats(line: Array, other: Array) -> bool:
    """Whether a march follows the path of another one, to its end."""
    far = abs(len(line) - len(other)) > 1
    return not far and len(line) > 1 and overlap(line, other, _REPEATED) == 1.0


def _alike(line: Array, other: Array) -> bool:
    """Whether two lines begin in the same way."""
    n = min(len(line), len(other), 2 * _PROXIMAL)
    return bool(np.median(distances(line[n // 3 : n], other[: n + 5])) < 2.0)


def start_at(base: ArrayLike, options: TraceOptions | None = None) -> Follower:
    """Follower of the whisker that starts near a column and row."""
    point = np.asarray(base, dtype=np.float64)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ValueError(f"base is {point.tolist()}; a column and a row are needed")
    return Follower(point, options or TraceOptions())
