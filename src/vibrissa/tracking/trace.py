"""A whisker in one frame of one view: its middle, to a fraction of a pixel, from base to tip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEP = 2.0
"""Between points of a trace, pixels."""


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
    bright : bool, optional
        Whether whiskers are bright on dark; by default the first frame tells.
    """

    bridge: float = 90.0
    stiffness: float = 3e5
    scale: float = 1.0
    shortest: float = 40.0
    jump: float = 5.0
    memory: int = 25
    bright: bool | None = None


class Trace(NamedTuple):
    """A whisker in one frame of one view.

    Attributes
    ----------
    line : array (n, 2)
        Column and row from base to tip, `STEP` pixels apart.
    sigma : array (n,)
        Standard deviation across, pixels.
    seen : array (n,)
        Whether each point is seen, not bridged.
    confidence : float
        Between 0 and 1.
    base_seen, tip_seen : bool
        Whether the whisker is seen to begin and to end there. If not it goes on outside of the
        image, or fades into the noise.
    """

    line: Array
    sigma: Array
    seen: Mask
    confidence: float
    base_seen: bool = True
    tip_seen: bool = True

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


def given(points: ArrayLike) -> Trace:
    """Make a trace of points that a person says are right."""
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


def even(line: Array, start: float = 0.0) -> Array:
    """Put points `STEP` apart along a line (n, 2), from an arc length on; below zero: before it."""
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    wanted = np.arange(start, s[-1] + 1e-9, STEP)
    if start < 0.0:
        direction = (line[min(4, len(line) - 1)] - line[0]) / s[min(4, len(line) - 1)]
        s = np.concatenate([[start], s])
        line = np.concatenate([[line[0] + start * direction], line])
    return np.stack([np.interp(wanted, s, line[:, k]) for k in range(2)], axis=1)
