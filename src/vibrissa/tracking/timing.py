"""Which frames of two cameras belong together.

Two views of one point look along lines that meet. In frames of different times the lines to the
whisker's base and tip pass each other at a distance; the shift between the videos is the one for
which they pass nearest. Frames that a camera dropped change the shift from there on.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera
from vibrissa.cameras.triangulation import triangulate
from vibrissa.tracking.trace import Trace

Array = NDArray[np.float64]
Pairs = NDArray[np.int64]

LARGEST = 30
"""Largest shift that is looked for, frames."""

_SWITCH = 40.0
_WORST = 6.0
_CLEARLY = 20.0
"""By how much another shift must fit better than what is said."""

_KNOWN = 10
"""Frames that show an end, from which something can be told."""


def paired_frames(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    offset: int | None = 0,
) -> Pairs:
    """Say which frames of two or more videos show the same moment.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    traces : sequence of sequence of Trace
        Of one whisker, view by view, frame by frame.
    offset : int, optional
        By how many frames the other videos began earlier than the first: its frame 0 is their frame
        ``offset``. None finds it out, and dropped frames too.

    Returns
    -------
    array (time, view)
        Frame numbers that belong together.

    Raises
    ------
    ValueError
        If no frames belong together, or the whisker is seen in too few to find it out.
    """
    columns = [np.arange(len(traces[0]))]
    for camera, row in zip(cameras[1:], traces[1:], strict=True):
        if offset is not None:
            shift = np.full(len(traces[0]), offset)
        else:
            shift = _shifts(cameras[0], camera, traces[0], row)
        columns.append(columns[0] + shift)
    pairs = np.stack(columns, axis=1)
    # A frame that one camera dropped has no partner; of those that share one the first keeps it.
    usable = np.ones(len(pairs), dtype=bool)
    for k, row in enumerate(traces):
        usable &= (pairs[:, k] >= 0) & (pairs[:, k] < len(row))
        usable[1:] &= np.diff(pairs[:, k]) > 0
    if not usable.any():
        raise ValueError(f"no frames belong together: an offset of {offset} frames is too large")
    return pairs[usable]


def better_offset(
    first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace], offset: int
) -> Pairs:
    """Say whether two videos fit clearly better with another shift between them.

    What a calibration is off by all shifts share, and it does not count.
    """
    cost = np.zeros((len(a), 2 * LARGEST + 1))
    for end in (0, -1):
        rows, other = (_shown(row, end) for row in (a, b))
        if min(len(rows), len(other)) < _KNOWN or abs(offset) > LARGEST:
            continue
        gap = np.full(cost.shape, np.nan)
        here, there = _rays(first, a, end), _rays(second, b, end)
        for k in range(cost.shape[1]):
            mine = rows[np.isin(rows + k - LARGEST, other)]
            partner = mine + k - LARGEST
            gap[mine, k] = _passing(
                (here[0][mine], here[1][mine]), (there[0][partner], there[1][partner])
            )
        told = gap[:, offset + LARGEST]
        if np.isfinite(told).sum() < _KNOWN:
            continue
        away = (gap - np.nanmedian(told)) * _pixels_per_m(first, second, a, b, end)
        cost += np.where(np.isfinite(away), np.minimum(away**2, _WORST), 0.5 * _WORST)
    way = _cheapest(cost)
    changed = _SWITCH * int((np.diff(way) != 0).sum()) + _CLEARLY
    frames = np.arange(len(a))
    if cost[frames, way].sum() + changed >= cost[:, offset + LARGEST].sum():
        return np.empty(0, dtype=np.int64)
    return np.asarray(way[np.concatenate([[True], np.diff(way) != 0])] - LARGEST, dtype=np.int64)


def _shown(traces: Sequence[Trace], end: int) -> NDArray[np.intp]:
    """Frames in which an end of the whisker is seen."""
    seen = [len(t.line) > 0 and (t.base_seen, t.tip_seen)[end] for t in traces]
    return np.flatnonzero(seen)


def _shifts(first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace]) -> Pairs:
    """Shift of each frame of the first view, by the cheapest way through all shifts."""
    count = len(a)
    shifts = np.arange(-LARGEST, LARGEST + 1)
    if not all(any(len(trace.line) for trace in row) for row in (a, b)):
        raise ValueError("the whisker is seen in too few frames to find the cameras' offset")
    cost = np.full((count, len(shifts)), _WORST)
    seen = 0
    for end in (0, -1):
        here, there = _rays(first, a, end), _rays(second, b, end)
        scale = _pixels_per_m(first, second, a, b, end)
        for k, shift in enumerate(shifts):
            frames = np.arange(count) + shift
            inside = (frames >= 0) & (frames < len(b))
            rows, partner = np.flatnonzero(inside), frames[inside]
            gap = _distance((here[0][rows], here[1][rows]), (there[0][partner], there[1][partner]))
            known = np.isfinite(gap)
            seen += int(known.sum())
            value = np.minimum((gap[known] * scale) ** 2, _WORST)
            cost[rows[known], k] += value - 0.5 * _WORST
    if seen < 10 * len(shifts):
        raise ValueError("the whisker is seen in too few frames to find the cameras' offset")
    return shifts[_cheapest(cost)]


def _pixels_per_m(
    first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace], end: int
) -> float:
    """Scale of the first view where the whisker is; moments do not matter for that."""
    pixels = [next(t.line[end] for t in row if len(t.line)) for row in (a, b)]
    place, _ = triangulate((first, second), np.stack(pixels))
    return float(np.linalg.norm(first.project_with_slopes(place)[1], axis=0).max())


def _rays(camera: Camera, traces: Sequence[Trace], end: int) -> tuple[Array, Array]:
    pixels = np.array([t.line[end] if len(t.line) else (np.nan, np.nan) for t in traces])
    return camera.rays(pixels)


def _distance(one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Between lines, m."""
    distance: Array = np.abs(_passing(one, other))
    return distance


def _passing(one: tuple[Array, Array], other: tuple[Array, Array]) -> Array:
    """Distance between lines, m; its sign says on which side they pass."""
    normal = np.cross(one[1], other[1])
    size = np.linalg.norm(normal, axis=1)
    away = ((other[0] - one[0]) * normal).sum(axis=1)
    distance: Array = away / np.maximum(size, 1e-12)
    return distance


def _cheapest(cost: Array) -> NDArray[np.intp]:
    """Way through (time, shift) that seldom changes its shift."""
    count, width = cost.shape
    total, came = cost[0].copy(), np.zeros(cost.shape, dtype=np.intp)
    for i in range(1, count):
        best = int(np.argmin(total))
        jump = total[best] + _SWITCH
        came[i] = np.where(total <= jump, np.arange(width), best)
        total = np.minimum(total, jump) + cost[i]
    way = np.empty(count, dtype=np.intp)
    way[-1] = int(np.argmin(total))
    for i in range(count - 1, 0, -1):
        way[i - 1] = came[i, way[i]]
    return way
