"""Rows of whiskers that lie on one another in a view: traced anew by another view.

By one view alone it may be unknown which line is whose; the views then disagree about where
whiskers begin and end. The view in which they lie on one another least, or the steadiest of those
that are about as clear, guides the others
(`vibrissa.tracking.trace.guided`), if they agree better afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.cameras import Camera
from vibrissa.io import Frame
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.space.frame_pairs import Traces, paired_frames
from vibrissa.tracking.trace.guided import Frames, trace_guided
from vibrissa.tracking.trace.start import base_gap
from vibrissa.tracking.trace.trace import Trace, TraceOptions, overlap

# Distance of bases of two views, pixels, and those of tips, as shares of the length, where both are
# seen to end and where one may fade, up to which they may be those of one whisker.
_BASES, _TIPS, _FADING = 8.0, 0.1, 0.4
# Share of the frames in which the views show one whisker, from which nothing is traced anew.
_AGREES = 0.9
# Difference of the shares of whiskers that lie on others up to which views are about as clear; and
# change of a whisker's length from its usual one, as a share, up to which it is traced steadily.
_ALIKE, _STEADY = 0.02, 0.2
# Log likelihood by which a whisker's line is to be more probable than others in the median frame,
# for it to be sure: below zero, most frames by themselves show another one, and only motion and
# bend decide; more is needed where the views do not agree about the whisker.
_SURE, _CLEAR = 0.0, 4.0
_LARGEST = 20  # number of whiskers of a row up to which lines can be combined


def retraced(
    cameras: Sequence[Camera],
    videos: Sequence[Frames],
    bases: Sequence[Sequence[ArrayLike]],
    traces: Traces,
    options: TraceOptions | None = None,
    *,
    offset: int | None = 0,
    corrections: Mapping[int, Mapping[tuple[int, int], ArrayLike]] | None = None,
    samples: Sequence[Sequence[Frame]],
    masks: Sequence[Mask | None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[list[list[Trace]]], list[str]]:
    """Trace a row anew in the views that contradict the clearest one.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of the views.
    videos : sequence of callable
        Functions that give the frames of each view, each time from the first.
    bases : sequence of sequence of array_like (2,)
        Column and row where each whisker leaves the face in the first frame that all views show,
        view by view.
    traces : sequence of sequence of sequence of Trace
        Traces of each view by itself (`trace_video`), by view, whisker and frame.
    options : TraceOptions, optional
        Settings of tracing.
    offset : int, optional
        Number of frames by which the other cameras began earlier than the first; None to find it.
    corrections : mapping, optional
        Points along whiskers in some frames by view, as in `trace_video`.
    samples : sequence of sequence of array (height, width)
        Frames spread over each video.
    masks : sequence of (array (height, width) of bool, or None), optional
        Pixels of each view in which no whisker is measured.
    progress : callable, optional
        Function that is called after every frame with the view and the number of frames done.

    Returns
    -------
    traces : list of list of list of Trace
        Traces by view, whisker and frame; new ones where the views agree better by them.
    remarks : list of str
        Views that were traced anew, and how well they agreed before and agree now.
    """
    found, remarks = [[list(row) for row in view] for view in traces], list[str]()
    if len(cameras) < 2 or not 2 <= len(found[0]) <= _LARGEST:
        return found, remarks
    shares = np.array([_lies_on_others(view) for view in found])
    clear = np.flatnonzero(shares < shares.min() + _ALIKE)
    guide = int(max(clear, key=lambda view: _steadiness(found[view])))
    pairs = paired_frames(cameras, found, offset)
    for v, camera in enumerate(cameras):
        both = [guide, v]
        rows = [_in_pairs(found[view], pairs[:, view]) for view in both]
        before = _agreement([cameras[view] for view in both], rows).mean()
        if v == guide or before >= _AGREES:
            continue
        known = [_as_seen_by(row, pairs[:, v], len(found[v][0])) for row in rows[0]]
        new, margins = trace_guided(
            videos[v],
            bases[v],
            (cameras[guide], camera),
            known,
            options,
            corrections=(corrections or {}).get(v, {}),
            sample=samples[v],
            mask=masks[v] if masks is not None else None,
            progress=None if progress is None else partial(progress, v),
        )
        rows[1] = _in_pairs(new, pairs[:, v])
        agreement = _agreement([cameras[view] for view in both], rows)
        after = agreement.mean()
        if after > before:
            found[v] = new
            remarks.append(
                f"in {camera.name} whiskers lie on one another: they were traced anew by where "
                f"{cameras[guide].name} shows them. Before, both views showed one whisker in "
                f"{100.0 * before:.0f} % of the frames, now in {100.0 * after:.0f} %."
            )
            seen = np.array([any(len(trace.line) for trace in row) for row in new])
            unsure = seen & (margins < np.where(agreement < _AGREES, _CLEAR, _SURE))
            if unsure.any():
                remarks.append(
                    f"not sure which lines in {camera.name} are those of "
                    f"{', '.join(f'whisker {k}' for k in np.flatnonzero(unsure))}: others are "
                    "about as probable. Compare traces and video (vibrissa correct)."
                )
    return found, remarks


def _lies_on_others(view: Sequence[Sequence[Trace]]) -> float:
    """Mean share of whiskers that lies on others, or is lost."""
    shares = [
        max((overlap(line, other) for other in others if other is not line), default=0.0)
        if len(line)
        else 1.0
        for others in ([trace.line for trace in row] for row in zip(*view, strict=True))
        for line in others
    ]
    return float(np.mean(shares))


def _steadiness(view: Sequence[Sequence[Trace]]) -> float:
    """Share of the frames in which whiskers are as long as usual."""
    lengths = np.array([[len(trace.line) for trace in row] for row in view], dtype=np.float64)
    usual = np.array([np.median(row[row > 0]) if (row > 0).any() else np.inf for row in lengths])
    return float((np.abs(lengths / usual[:, None] - 1.0) < _STEADY).mean())


def _in_pairs(view: Sequence[Sequence[Trace]], frames: NDArray[np.int64]) -> list[list[Trace]]:
    """Traces of the frames that belong together with those of other views."""
    return [[row[i] for i in frames] for row in view]


def _as_seen_by(row: Sequence[Trace], frames: NDArray[np.int64], count: int) -> list[Trace]:
    """Traces of another view in the frames of a view; empty ones if it has none."""
    known = [Trace.lost()] * count
    for i, trace in zip(frames.tolist(), row, strict=True):
        known[i] = trace
    return known


def _agreement(cameras: Sequence[Camera], rows: Sequence[Sequence[Sequence[Trace]]]) -> Array:
    """Share of the frames (whisker,) in which two views show one whisker."""
    shares = []
    for row in zip(*rows, strict=True):
        seen = [pair for pair in zip(*row, strict=True) if all(len(trace.line) for trace in pair)]
        if not seen:
            shares.append(0.0)
            continue
        ends = np.array([[[t.line[0], t.line[-1]] for t in pair] for pair in seen])
        gaps: Array = base_gap(cameras, np.moveaxis(ends, 1, 0))
        length = np.array([min(trace.length for trace in pair) for pair in seen])
        whole = np.array([all(trace.tip_seen for trace in pair) for pair in seen])
        agree = (gaps[:, 0] < _BASES) & (gaps[:, 1] < np.where(whole, _TIPS, _FADING) * length)
        shares.append(float(agree.sum() / len(row[0])))
    return np.array(shares)
