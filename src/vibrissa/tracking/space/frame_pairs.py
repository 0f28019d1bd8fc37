"""Pairs of simultaneous frames of two cameras.

Two views of one point give lines of sight that meet. For frames of different times the lines to the
whisker's base and tip pass each other at a distance; the offset between the videos is the one for
which they pass nearest. Frames that a camera dropped change the offset from there on, which steps
of the whisker show too (`vibrissa.tracking.space.frame_steps`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.numerics import Array
from vibrissa.tracking.space.frame_steps import Dropped, steps_over_dropped
from vibrissa.tracking.trace.trace import Trace, correlated

Pairs = NDArray[np.int64]

Traces = Sequence[Sequence[Sequence[Trace]]]
"""Traces by view, whisker and frame."""

_LARGEST = 30  # largest offset, frames
_SHIFTS = np.arange(-_LARGEST, _LARGEST + 1)

# Logarithm of the likelihood ratio by which an offset, or a change of it, must explain the views
# better; errors of the ends are assumed to have a Cauchy distribution.
_EVIDENCE = 15.0
_BLANK = np.log(3.0)  # cost of an end that is not seen in both frames: that of 1.4 scatters
_DROPPED = 10  # largest number of frames in a row that a camera drops unnoticed
_KNOWN = 10  # number of frames that must show an end of the whisker
_LOCATED = 0.3  # error with which an end is located in each frame by itself, pixels
_POWERS = (1.0, 0.5, 0.0)  # of the weights of frames whose errors are alike, for paths to compare
NEAR = 3  # offsets that differ by so many frames are not distinguished when one is confirmed


class Offsets(NamedTuple):
    """Offset of each frame of the first view (time,), and whether no other fits about as well."""

    shifts: Pairs
    determined: bool


def paired_frames(cameras: Sequence[Camera], traces: Traces, offset: int | None = 0) -> Pairs:
    """Find the simultaneous frames (time, view) of two or more videos.

    Frame 0 of the first video is frame ``offset`` of the others. If it is None, it is found, and
    dropped frames too, where they explain the views clearly better than none. Frames that only one
    camera dropped, as steps of the whisker show, have no partner.
    """
    pairs, gaps = _paired_by_offset(cameras, traces, offset)
    if not len(pairs):
        raise ValueError(f"no frames belong together: an offset of {offset} frames is too large")
    # When each view's image of a pair was taken, in frames, with those that it dropped.
    moments = np.tile(np.arange(len(pairs)), (len(cameras), 1))
    for gap in gaps:
        moments[gap.view, gap.frame :] += gap.missing if gap.certain else 0
    common = reduce(np.intersect1d, moments)
    at = [np.searchsorted(one, common) for one in moments]
    return np.stack([pairs[rows, v] for v, rows in enumerate(at)], axis=1)


def dropped_frames(
    cameras: Sequence[Camera], traces: Traces, offset: int | None = 0
) -> list[Dropped]:
    """Frames that one of several cameras dropped, by its own numbers of frames."""
    pairs, gaps = _paired_by_offset(cameras, traces, offset)
    return [gap._replace(frame=int(pairs[gap.frame, gap.view])) for gap in gaps]


def _paired_by_offset(
    cameras: Sequence[Camera], traces: Traces, offset: int | None
) -> tuple[Pairs, list[Dropped]]:
    """Simultaneous frames (time, view) by the videos' offset, and what it leaves of dropped ones.

    These are before rows of the pairs, not frames of the video.
    """
    first, *others = best_seen(traces)
    columns = [np.arange(len(first))]
    for camera, row in zip(cameras[1:], others, strict=True):
        if offset is not None:
            shift = np.full(len(first), offset)
        else:
            shift = clear_offsets(cameras[0], camera, first, row).shifts
        columns.append(columns[0] + shift)
    pairs = np.stack(columns, axis=1)
    # A frame that one camera dropped has no partner; of those that share one the first keeps it.
    usable = np.ones(len(pairs), dtype=bool)
    for k, row in enumerate((first, *others)):
        usable &= (pairs[:, k] >= 0) & (pairs[:, k] < len(row))
        usable[1:] &= np.diff(pairs[:, k]) > 0
    pairs = pairs[usable]
    if (np.diff(pairs, axis=0) > 1).any():
        return pairs, []
    views = [
        [[row[i] for i in column] for row in view]
        for view, column in zip(traces, pairs.T, strict=True)
    ]
    ends, gaps = best_seen(views), list[Dropped]()
    found = steps_over_dropped(views)
    for gap in found:
        until = min((g.frame for g in found if g.certain and g.frame > gap.frame), default=None)
        certain = gap.certain and _agree(cameras, ends, gap, gaps, until)
        gaps.append(gap._replace(certain=certain))
    return pairs, gaps


def _agree(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    gap: Dropped,
    before: Sequence[Dropped],
    until: int | None,
) -> bool:
    """Whether the views do not contradict that one of them dropped frames, until the next gap."""
    gained = 0.0
    for v in [gap.view] if gap.view else range(1, len(cameras)):
        stay = np.full(len(traces[0]), _LARGEST)
        for one in before:
            if one.certain and one.view in (0, v):
                stay[one.frame :] += -one.missing if one.view else one.missing
        changed = stay.copy()
        changed[gap.frame :] += -gap.missing if gap.view else gap.missing
        ends = _passing_ends(cameras[0], cameras[v], traces[0], traces[v])
        paths = [np.clip(path, 0, 2 * _LARGEST)[:until] for path in (stay, changed)]
        away = [[end[np.arange(len(path)), path] for end in ends] for path in paths]
        gained += _gained(*(np.array([one - _medians(one) for one in each]) for each in away))
    # Ends that hardly move, or are seen in few frames, agree better or worse by chance.
    return gained > -_EVIDENCE


def best_seen(traces: Traces) -> list[Sequence[Trace]]:
    """Traces, by view, of the whisker that is lost least often."""
    seen = [[sum(len(trace.line) > 0 for trace in row) for row in view] for view in traces]
    best = int(np.argmax(np.min(seen, axis=0)))
    return [view[best] for view in traces]


def clear_offsets(
    first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace], given: int = 0
) -> Offsets:
    """Offsets with which two videos agree clearly better than with the given one, or that one.

    An error of the calibration is common to all offsets, and does not count. Errors of the ends
    that last, as where hairs cover the base, count once for as long as they last.
    """
    column = given + _LARGEST
    ends = _passing_ends(first, second, a, b) if abs(given) <= _LARGEST else []
    ends = [one for one in ends if np.isfinite(one[:, column]).sum() >= _KNOWN]
    if not ends:
        return Offsets(np.full(len(a), given), False)
    usual = np.array([_medians(one) for one in ends])[:, None]
    alone = np.array(ends) - usual
    weights = np.array([1.0 / _alike(one[:, _costs(one).sum(axis=0).argmin()]) for one in alone])
    best = int(np.tensordot(weights, _costs(alone), axes=1).sum(axis=0).argmin())
    # Without synchrony the usual distance contains the lag; that of the best offset does not.
    away = np.array(ends) - usual[:, :, [best]]
    known = np.isfinite(alone[:, :, column]).any(axis=0).sum()
    chosen, before, row = alone[:, :, column], 0, np.arange(len(a))
    shifts = np.full(len(a), given)
    # No offset fits a film with dropped frames throughout, so that its errors seem to last longer.
    for power in _POWERS:
        path = _cheapest(np.tensordot(weights**power, _costs(away), axes=1))
        changed, changes = away[:, row, path], int((np.diff(path, prepend=column) != 0).sum())
        both = (np.isfinite(changed) & np.isfinite(chosen)).any(axis=0).sum()
        # At the end of what is considered there need not be a minimum.
        possible = np.abs(_SHIFTS[path]).max() < _LARGEST and 2 * both >= known
        needed = _EVIDENCE * (changes - before)
        if possible and needed > 0.0 and _gained(chosen, changed) > needed:
            chosen, before, shifts = changed, changes, _SHIFTS[path]
    if before:
        return Offsets(shifts, True)
    others = np.moveaxis(alone[:, :, np.abs(_SHIFTS - given) > NEAR], 2, 0)
    return Offsets(shifts, all(_gained(other, chosen) > _EVIDENCE for other in others))


def _passing_ends(
    first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace]
) -> list[Array]:
    """Distances (frame, offset) of lines to base and to tip, over their scatter; NaN if unseen."""
    ends = []
    for end in (0, -1):
        rows, others = (_shown(row, end) for row in (a, b))
        if min(len(rows), len(others)) < _KNOWN:
            continue
        passing = _passing(first, second, a, b, end)
        passing[~np.isin(np.arange(len(a)), rows)] = np.nan
        passing[~np.isin(np.arange(len(a))[:, None] + _SHIFTS, others)] = np.nan
        ends.append(passing / _scatter(passing))
    return ends


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


def _costs(away: Array) -> Array:
    """Costs of distances beyond the usual ones, in units of their scatter."""
    return np.where(np.isfinite(away), np.log1p(away**2), _BLANK)


def _alike(away: Array) -> float:
    """Number of frames in a row in which an end is displaced alike."""
    # Those displaced far count as in the cost.
    pulls = away / np.hypot(1.0, away)
    power = float(np.nanmean(pulls**2))
    # Each end is located anew in each frame, even if it is always at the same error.
    share = power / (power + _LOCATED**2)
    return 1.0 + (correlated([np.nan_to_num(pulls)[None]]) - 1.0) * share


def _gained(stay: Array, changed: Array) -> float:
    """Logarithm of the likelihood ratio of other distances (end, frame), where both are known."""
    gained = 0.0
    for one, other in zip(stay, changed, strict=True):
        both = np.isfinite(one) & np.isfinite(other)
        if both.any():
            gained += float((_costs(one) - _costs(other))[both].sum() / _alike(other))
    return gained


def _shown(traces: Sequence[Trace], end: int) -> NDArray[np.intp]:
    """Frames in which an end of the whisker is seen."""
    seen = [len(t.line) > 0 and (t.base_seen, t.tip_seen)[end] for t in traces]
    return np.flatnonzero(seen)


def _passing(
    first: Camera, second: Camera, a: Sequence[Trace], b: Sequence[Trace], end: int
) -> Array:
    """Signed distance (frame, offset), pixels, at which lines to one end pass; NaN if unseen."""
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
        jump = total[best] + _EVIDENCE
        came[i] = np.where(total <= jump, np.arange(width), best)
        total = np.minimum(total, jump) + cost[i]
    path = np.empty(count, dtype=np.intp)
    path[-1] = int(np.argmin(total))
    for i in range(count - 1, 0, -1):
        path[i - 1] = came[i, path[i]]
    return path
