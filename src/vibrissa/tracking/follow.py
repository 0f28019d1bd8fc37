"""Follow a whisker in one view from frame to frame.

Each frame is expected to show what the two before it lead to: from the expected base a Kalman
filter goes outward along the expected curve (`vibrissa.tracking.ridge.march`), past whatever hides
the whisker; the curve found is then measured across and smoothed. If less of it is supported than
was lately, the frame is looked at with fewer expectations: no movement, any curvature, any
direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io.video import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.ends import FEWEST, OUTSIDE, traced
from vibrissa.tracking.middle import smooth
from vibrissa.tracking.trace import STEP, Trace, TraceOptions

Array = NDArray[np.float64]

_PROXIMAL = 30

_AROUND = 36.0
"""How far inside the face the base is looked for where it is known by a click only, pixels."""


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
        self, frame: Frame, noise: float, line: Array, support: Array, before: float = OUTSIDE
    ) -> Trace:
        """Smooth a marched line over what is hidden, then measure it."""
        if len(line) < FEWEST:
            return Trace.lost()
        line = smooth(line, np.where(support > 0.0, 4.0, 0.0), self.options.stiffness)
        return traced(frame, noise, line, self.options, before)[0]


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
