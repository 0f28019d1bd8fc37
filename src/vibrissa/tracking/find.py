"""Find whiskers in a frame of which nothing is known.

Places that are darker than both of their sides, whichever way one looks, are where lines may be;
from the darkest on each is followed both ways, and what it covers is done with. A line is a whisker
if it begins at something dark, the face, or else at its darker end, where it is thicker.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.video import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.ends import traced
from vibrissa.tracking.trace import STEP, Trace, TraceOptions

Array = NDArray[np.float64]

_GRID = 3
_CLEAR = 5.0
_SEEDS = 4000


class Found(NamedTuple):
    """A whisker in one frame.

    Attributes
    ----------
    trace : Trace
        From base to tip.
    from_face : bool
        Whether it begins at something dark.
    """

    trace: Trace
    from_face: bool


def find_whiskers(frame: Frame, options: TraceOptions | None = None) -> list[Found]:
    """Find all whiskers of a frame.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.
    options : TraceOptions, optional
        How whiskers are traced; ``shortest`` says what is too short to be one.

    Returns
    -------
    list of Found
        The one that is seen over the longest way first; those that begin at the face before others.
    """
    o = options or TraceOptions()
    noise = ridge.noise_level(frame)
    seeds = np.empty((_SEEDS, 4))
    count = ridge.seeds(frame, _GRID, 5.0 * noise, o.scale, seeds)
    seeds = seeds[:count][np.argsort(-seeds[:count, 3])]
    taken = np.zeros(frame.shape, dtype=np.bool_)
    found: list[Found] = []
    for column, row, angle, _ in seeds:
        if taken[int(row), int(column)]:
            continue
        line = _both_ways(frame, noise, np.array([column, row]), angle, o)
        _take(taken, line if len(line) else np.array([[column, row]]))
        if STEP * len(line) >= o.shortest:
            found += _whisker(frame, noise, line, o)
    found = _distinct(found)
    return sorted(found, key=lambda f: (not f.from_face, -f.trace.support))


def _both_ways(frame: Frame, noise: float, place: Array, angle: float, o: TraceOptions) -> Array:
    bend = np.zeros(int(np.hypot(*frame.shape) / STEP))
    halves = []
    for turn in (0.0, np.pi):
        start = np.array([*place, angle + turn])
        line, support = np.empty((len(bend) + 1, 2)), np.empty(len(bend) + 1)
        spread = np.array([1.0, 0.2, 4e-3])
        # What is not known yet is not followed across gaps.
        count = ridge.march(
            frame, start, bend, spread, 3e-4, STEP, 12.0, noise, o.scale, line, support
        )
        halves.append(line[:count])
    return np.concatenate([halves[1][::-1], halves[0][1:]])


def _take(taken: NDArray[np.bool_], line: Array) -> None:
    """Mark what is near a line."""
    height, width = taken.shape
    reach = int(_CLEAR)
    for column, row in line.astype(int):
        taken[
            max(row - reach, 0) : min(row + reach + 1, height),
            max(column - reach, 0) : min(column + reach + 1, width),
        ] = True


def _whisker(frame: Frame, noise: float, line: Array, o: TraceOptions) -> list[Found]:
    """Say which end is the base, and trace from there."""
    best: list[Found] = []
    for way in (line, line[::-1]):
        trace, from_face = traced(frame, noise, way, o)
        if trace.support < o.shortest:
            continue
        found = Found(trace, from_face)
        if not best or (from_face, darker_inward(frame, noise, trace, o)) > (
            best[0].from_face,
            darker_inward(frame, noise, best[0].trace, o),
        ):
            best = [found]
    return best


def darker_inward(frame: Frame, noise: float, trace: Trace, options: TraceOptions) -> float:
    """Say how much darker the first third of a whisker is than the last.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.
    noise : float
        Of the image.
    trace : Trace
        Of the whisker.
    options : TraceOptions
        How it is traced.

    Returns
    -------
    float
        Grey values; below zero if it is fainter there.
    """
    line = np.ascontiguousarray(trace.line)
    columns = [np.empty(len(line)) for _ in range(4)]
    # Twice as wide as else, so that a thick base is measured too.
    ridge.measure(frame, line, 0, noise, 2.0 * options.scale, *columns)
    third = len(line) // 3
    return float(np.median(columns[1][:third]) - np.median(columns[1][-third:]))


def _distinct(found: list[Found]) -> list[Found]:
    """Leave out what runs mostly along a better supported one."""
    kept: list[Found] = []
    for candidate in sorted(found, key=lambda f: (not f.from_face, -f.trace.support)):
        line = candidate.trace.line
        if all(overlap(line, other.trace.line) < 0.5 for other in kept):
            kept.append(candidate)
    return kept


def overlap(line: Array, other: Array, near: float = 3.0) -> float:
    """Say which share of a line runs along another.

    Parameters
    ----------
    line, other : array (n, 2), array (m, 2)
        Columns and rows.
    near : float
        How near is the same, pixels.

    Returns
    -------
    float
        Between 0 and 1.
    """
    from scipy.spatial import cKDTree

    if not len(line) or not len(other):
        return 0.0
    distance, _ = cKDTree(other).query(line, distance_upper_bound=near)
    return float(np.isfinite(distance).mean())
