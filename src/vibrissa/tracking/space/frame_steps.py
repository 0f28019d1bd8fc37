"""Frames that a recorder repeated or dropped, as the steps of a whisker from frame to frame show.

Where a frame repeats the one before, a whisker stops for one frame and makes up for it in the next,
which no whisker does. Where a camera dropped g frames, a whisker in even motion takes a step of
1 + g of its steps at once. So it does where something lets it go, but then in all views: a camera
by itself dropped frames if the others show an even motion meanwhile.

Steps s are distances across the whisker (point,). An even motion makes them a smooth function of
time: with cubic interpolation between the two steps before and after, at distances a and b from the
middle of the step over g frames,

    s = (1 + g) [w_a (s₋₁ + s₊₁) + w_b (s₋₂ + s₊₂)],

with w_a = b² / 2(b² − a²) and w_b = −a² / 2(b² − a²).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.numerics import Array
from vibrissa.tracking.trace.trace import Trace, normals

# Largest number of frames in a row that repeat one; smallest step of an even motion that includes
# them, pixels; their own steps, as a share of that and at most, pixels; and the least of the step
# before them, as a share of the even one.
_RUN, _MOVES, _STOPS, _SAME, _EVENLY = 3, 0.35, 0.3, 0.25, 0.4
_SEVERAL = 3  # number of such frames of a video from which the recorder repeats frames
_ALONG = np.linspace(0.1, 0.9, 9)  # shares of a trace at which its step is measured
_PROXIMAL, _NEARER = 5, 6  # numbers of them of parts that move otherwise than far ones
_WINDOW = 5  # number of steps that show whether the middle one is even
_TINY = 1e-12
# Largest number of dropped frames that a step shows; smallest even step in the view that dropped
# them and in another one, pixels.
_GAP, _SHOWS, _STEADY = 3, 0.3, 0.25
# Largest deviations from steps over dropped frames, of their size and of the rest, and the same
# from even steps of the other view; and how much neighbouring steps may differ where that is sure.
_SIZE, _REST, _EVEN_SIZE, _EVEN_REST, _LIKE = 0.13, 0.13, 0.2, 0.26, 0.4


def without_repeats(
    cameras: Sequence[Camera], rows: Sequence[Sequence[Sequence[Trace]]]
) -> tuple[list[list[list[Trace]]], list[str]]:
    """Traces by whisker, view and frame without those of repeated frames, and remarks on these."""
    kept, remarks = [[list(row) for row in one] for one in rows], []
    for v, camera in enumerate(cameras):
        stops = [repeated_frames(one[v]) for one in rows]
        # A camera that repeats a frame stops all whiskers, of which some may be lost or rest.
        most = len(stops) // 2
        every = sorted(set[int]().union(*stops))
        repeats = [i for i in every if sum(i in own for own in stops) > most]
        if len(repeats) < _SEVERAL:
            continue
        for one in kept:
            for i in repeats:
                one[v][i] = Trace.lost()
        listed = ", ".join(map(str, repeats[:5])) + ", …" * (len(repeats) > 5)
        remarks.append(
            f"{camera.name}: {len(repeats)} of {len(kept[0][v])} frames repeat the one before "
            f"({listed}), as where frames were dropped or the frame rate was converted; whiskers "
            "move on in the next. They are left out: record or convert every frame once."
        )
    return kept, remarks


def repeated_frames(row: Sequence[Trace]) -> set[int]:
    """Frames in which a moving whisker is where it was in the frame before."""
    steps = _steps(row)
    # Far parts of a whisker that touches move otherwise than their base.
    return _stopped(steps) | _stopped(steps[:, :_PROXIMAL])


def _stopped(steps: Array) -> set[int]:
    """Frames with no step (frame, point), from one frame to the next, in the midst of a motion."""
    sizes, found = np.sqrt(np.mean(steps**2, axis=1)), set[int]()
    for i in range(2, len(steps) - 1):
        for after in range(i + 1, min(i + _RUN + 1, len(steps))):
            usual = sizes[after] / (after - i + 1)
            evenly = np.mean(steps[i - 1] * steps[after]) > _EVENLY * usual * sizes[after]
            still = (sizes[i:after] < min(_STOPS * usual, _SAME)).all()
            if usual > _MOVES and evenly and still:
                found |= set(range(i, after))
    return found


def _steps(row: Sequence[Trace]) -> Array:
    """Steps (frame, point) from the frame before; NaN if unseen."""
    unseen = np.full(len(_ALONG), np.nan)
    steps = [unseen, *(_step(a, b) for a, b in pairwise(row))]
    return np.array(steps).reshape(-1, len(_ALONG))


def _step(before: Trace, after: Trace) -> Array:
    """Distances, across a whisker, by which it moves from one frame to the next; NaN if unseen."""
    n = min(len(before.line), len(after.line))
    if n < len(_ALONG):
        return np.full(len(_ALONG), np.nan)
    at = np.rint(_ALONG * (n - 1)).astype(np.intp)
    moved = after.line[at] - before.line[at]
    return np.asarray((moved * normals(before.line)[at]).sum(axis=1))


class Dropped(NamedTuple):
    """Frames that a camera dropped while the others did not."""

    view: int
    frame: int  # the first one after them
    missing: int
    certain: bool


def steps_over_dropped(views: Sequence[Sequence[Sequence[Trace]]]) -> list[Dropped]:
    """Find frames that one of the cameras dropped, by simultaneous traces by view and whisker.

    A camera drops them for all whiskers: most of those that move evenly in the other views show it.
    """
    if len(views) < 2:
        return []
    steps = [[_without_repeated(row) for row in view] for view in views]
    even = np.array([[_over(own, 0, _STEADY, _EVEN_SIZE, _EVEN_REST) for own in v] for v in steps])
    found = dict[tuple[int, int], Dropped]()
    for view, rows in enumerate(steps):
        others = np.delete(even, view, axis=0).min(axis=0)
        for missing in range(1, _GAP + 1):
            jumps = np.array([_over(own, missing, _SHOWS, _SIZE, _REST) for own in rows])
            shown = np.minimum(jumps, others)
            most = 2 * (shown > 0).sum(axis=0) > (others > 0).sum(axis=0)
            for i in np.flatnonzero(most):
                certain = bool(shown[:, i].max() > 1)
                if certain or (view, int(i)) not in found:
                    found[view, int(i)] = Dropped(view, int(i), missing, certain)
    return sorted(found.values(), key=lambda gap: gap.frame)


def _without_repeated(row: Sequence[Trace]) -> Array:
    """Steps (frame, point) without those of repeated frames."""
    repeats = repeated_frames(row)
    return _steps([Trace.lost() if i in repeats else t for i, t in enumerate(row)])


def _over(steps: Array, gap: int, least: float, size: float, rest: float) -> NDArray[np.int64]:
    """Frames whose step is that of an even motion over a gap before it: 2 if clearly, 1, or 0."""
    near, far = 1.0 + 0.5 * gap, 2.0 + 0.5 * gap
    weights = np.array([far**2, -(near**2)]) / (2.0 * (far**2 - near**2))
    found = np.zeros(len(steps), dtype=np.int64)
    if len(steps) < _WINDOW:
        return found
    # Far parts of a whisker that touches move otherwise than its base.
    for own in (steps, steps[:, :_NEARER]):
        around = sliding_window_view(own, _WINDOW, axis=0)
        before, here, after = (around[..., k] for k in (1, 2, 3))
        even = weights[0] * (before + after) + weights[1] * (around[..., 0] + around[..., 4])
        square = np.maximum((even**2).sum(axis=1), _TINY)
        share = (here * even).sum(axis=1) / square
        off = np.sqrt(((here - share[:, None] * even) ** 2).sum(axis=1) / square)
        fits = (np.abs(share / (1 + gap) - 1.0) < size) & (off < rest * (1 + gap))
        fits &= square > least**2 * own.shape[1]
        # The steps next to one over a gap have it among those around them.
        fits &= (gap == 0) | ((around**2).sum(axis=1).argmax(axis=1) == _WINDOW // 2)
        alike = ((after - before) ** 2).sum(axis=1) < _LIKE**2 * square
        found[2:-2] = np.maximum(found[2:-2], fits * (1 + alike))
    return found
