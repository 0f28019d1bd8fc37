"""Pairs of simultaneous frames of two cameras.

Two views of one point give lines of sight that meet. For frames of different times the lines to the
whisker's base and tip pass each other at a distance; the offset between the videos is the one for
which they pass nearest. Frames that a camera dropped change the offset from there on.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.numerics import Array
from vibrissa.tracking.trace.trace import Trace, correlated

Pairs = NDArray[np.int64]

_LARGEST = 30  # largest offset, frames
_SHIFTS = np.arange(-_LARGEST, _LARGEST + 1)

_SWITCH = 40.0  # cost of a change of the offset
_WORST = 6.0  # largest cost of a frame: square of the distance at which lines pass over its scatter
_CLEARLY = 20.0  # cost by which another offset must fit better than the given one
# Largest share of the cost of the given offset that remains with one that explains the misfit.
_LEFT = 0.65
_DROPPED = 10  # largest number of frames in a row that a camera drops unnoticed
_KNOWN = 10  # number of frames that must show an end of the whisker
_LOCATED = 0.3  # error with which an end is located in each frame by itself, pixels


def paired_frames(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    offset: int | None = 0,
) -> Pairs:
    """Find the simultaneous frames of two or more videos.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of the views.
    traces : sequence of sequence of Trace
        Traces of one whisker, view by view, frame by frame.
    offset : int, optional
        Number of frames by which the other videos began earlier than the first: its frame 0 is
        their frame ``offset``. None: it is found, and dropped frames too.

    Returns
    -------
    array (time, view)
        Frame numbers that belong together.

    Raises
    ------
    ValueError
        If no frames belong together, or the whisker is seen in too few to find the offset.
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
    """Offsets with which two videos fit clearly better, by run; empty if there are none.

    An error of the calibration is common to all offsets, and does not count.
    """
    ends = []
    for end in (0, -1):
        rows, other = (_shown(row, end) for row in (a, b))
        if min(len(rows), len(other)) < _KNOWN or abs(offset) > _LARGEST:
            continue
        passing = _passing(first, second, a, b, end)
        passing[~np.isin(np.arange(len(a)), rows)] = np.nan
        partner = np.arange(len(a))[:, None] + _SHIFTS
        passing[~np.isin(partner, other)] = np.nan
        passing /= _scatter(passing)
        if np.isfinite(passing[:, offset + _LARGEST]).sum() >= _KNOWN:
            ends.append(passing)
    if not ends:
        return np.empty(0, dtype=np.int64)
    away, fits, blank = _compared(ends)
    cost = _costs(away)
    path = _cheapest(cost + blank)
    if (np.abs(_SHIFTS[path]) == _LARGEST).any():
        # No minimum, as it is at the end of what is considered.
        return np.empty(0, dtype=np.int64)
    switched = np.concatenate([[True], np.diff(path) != 0])
    changed = _SWITCH * int(switched[1:].sum()) + _CLEARLY
    row, column = np.arange(len(a)), offset + _LARGEST
    both = (blank[row, path] == 0.0) & (blank[:, column] == 0.0)
    if 2 * both.sum() < (blank[:, column] == 0.0).sum():
        return np.empty(0, dtype=np.int64)
    left, given = cost[row, path][both].sum(), fits[both, column].sum()
    # A base that begins at another hair for a while is one error, not one in each frame.
    away = [np.nan_to_num(one[row, path]) for one in away]
    power = float(np.mean([(one**2).mean() for one in away]))
    alike = 1.0 + (correlated([one[None] for one in away]) - 1.0) * power / (power + _LOCATED**2)
    # With wrong optics some offset always explains a little; a true one leaves only noise.
    if left + alike * changed >= given or left > _LEFT * given:
        return np.empty(0, dtype=np.int64)
    return np.asarray(_SHIFTS[path[switched]])


def _medians(passing: Array) -> Array:
    """Usual distance by offset; 0 for offsets without any frame."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nan_to_num(np.nanmedian(passing, axis=0)))


def _scatter(passing: Array) -> float:
    """Standard deviation of distances with the best offset, a pixel at least.

    Where both cameras show the whisker along itself, as those of a top and a front view may, it is
    that of where its ends are seen to be, along it.
    """
    enough = 2 * np.isfinite(passing).sum(axis=0) > len(passing)
    away = 1.4826 * _medians(np.abs(passing - _medians(passing)))
    return max(1.0, float(away[enough].min(initial=np.inf))) if enough.any() else 1.0


def _compared(ends: Sequence[Array]) -> tuple[list[Array], Array, Array]:
    """Distances beyond the usual one with the best offset; costs of all offsets, also of blanks.

    Without synchrony the usual distance contains the lag; that of the best offset does not.
    """
    blank = np.sum([np.where(np.isfinite(one), 0.0, 0.5 * _WORST) for one in ends], axis=0)
    usual = [_medians(one) for one in ends]
    fits = _costs([one - middle for one, middle in zip(ends, usual, strict=True)])
    best = int(np.argmin((fits + blank).sum(axis=0)))
    return [one - middle[best] for one, middle in zip(ends, usual, strict=True)], fits, blank


def _costs(away: Sequence[Array]) -> Array:
    """Costs (frame, offset) of distances beyond the usual one; 0 where unknown."""
    return np.asarray(sum(np.minimum(np.nan_to_num(one) ** 2, _WORST) for one in away))


def _shown(traces: Sequence[Trace], end: int) -> NDArray[np.intp]:
    """Frames in which an end of the whisker is seen."""
    seen = [len(t.line) > 0 and (t.base_seen, t.tip_seen)[end] for t in traces]
    return np.flatnonzero(seen)


def _shifts(first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace]) -> Pairs:
    """Offset of each frame of the first view, by the cheapest path through all offsets."""
    few = "the whisker is seen in too few frames to find the cameras' offset"
    if not all(any(len(trace.line) for trace in row) for row in (a, b)):
        raise ValueError(few)
    ends = [_passing(first, second, a, b, end) for end in (0, -1)]
    if sum(np.isfinite(one).sum() for one in ends) < _KNOWN * len(_SHIFTS):
        raise ValueError(few)
    away, _, blank = _compared([one / _scatter(one) for one in ends])
    return _SHIFTS[_cheapest(_costs(away) + blank)]


def _passing(
    first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace], end: int
) -> Array:
    """Distance (frame, offset), pixels, at which lines to one end pass; NaN if one is unseen.

    Its sign is the side on which they pass.
    """
    ends = [
        np.array([t.line[end] if len(t.line) else (np.nan, np.nan) for t in row]) for row in (a, b)
    ]
    (here, ahead), (there, toward) = first.rays(ends[0]), second.rays(ends[1])
    passing = np.full((len(a), len(_SHIFTS)), np.nan)
    for k, shift in enumerate(_SHIFTS.tolist()):
        rows = np.arange(max(0, -shift), max(0, min(len(a), len(b) - shift)))
        normal = np.cross(ahead[rows], toward[rows + shift])
        away = ((there[rows + shift] - here[rows]) * normal).sum(axis=1)
        passing[rows, k] = away / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    # The scale of the first view where the whisker is; moments do not matter for that.
    pixels = [row[np.flatnonzero(np.isfinite(row[:, 0]))[0]] for row in ends]
    place, _ = triangulate((first, second), np.stack(pixels))
    scale = float(np.linalg.norm(first.project_with_slopes(place)[1], axis=0).max())
    return passing * scale


def _cheapest(cost: Array) -> NDArray[np.intp]:
    """Path through (time, offset) that changes its offset seldom, and by few frames."""
    count, width = cost.shape
    total, came = cost[0].copy(), np.zeros(cost.shape, dtype=np.intp)
    window = 2 * _DROPPED + 1
    for i in range(1, count):
        around = sliding_window_view(np.pad(total, _DROPPED, constant_values=np.inf), window)
        best = np.arange(width) - _DROPPED + around.argmin(axis=1)
        jump = total[best] + _SWITCH
        came[i] = np.where(total <= jump, np.arange(width), best)
        total = np.minimum(total, jump) + cost[i]
    path = np.empty(count, dtype=np.intp)
    path[-1] = int(np.argmin(total))
    for i in range(count - 1, 0, -1):
        path[i - 1] = came[i, path[i]]
    return path
