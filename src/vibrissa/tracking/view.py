"""Trace the whiskers of one video, told apart by where they begin."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io import Frame
from vibrissa.tracking.begin import is_bright, negative
from vibrissa.tracking.find import find_whiskers, overlap
from vibrissa.tracking.follow import Follower, start_at
from vibrissa.tracking.identity import Seen, decided
from vibrissa.tracking.likeness import look_of
from vibrissa.tracking.row import follow_row
from vibrissa.tracking.trace import Trace, TraceOptions, given

Array = NDArray[np.float64]

Progress = Callable[[int], None]
"""Called with the number of frames done."""

Corrections = Mapping[tuple[int, int], ArrayLike]
"""By frame and whisker: points (n, 2) along it from base to tip, column and row."""

KEPT = 64
"""How many frames a correction can change before its own."""

_AGREES = 0.9


def trace_video(
    frames: Iterable[Frame],
    bases: Sequence[ArrayLike] | None = None,
    options: TraceOptions | None = None,
    *,
    corrections: Corrections | None = None,
    begun: Sequence[Sequence[Trace]] = (),
    kept: list[list[Trace]] | None = None,
    progress: Progress | None = None,
) -> list[list[Trace]]:
    """Trace whiskers from frame to frame.

    Parameters
    ----------
    frames : iterable of array (height, width)
        Grey values.
    bases : sequence of array_like (2,), optional
        Where each whisker leaves the face in the first frame, column and row, to about 10 pixels.
        By default one whisker, the one that is best seen.
    options : TraceOptions, optional
        How they are traced.
    corrections : mapping, optional
        Traces that are right in some frames: taken as they are, and followed from there forward,
        and backward as far as that changes anything, at most `KEPT` frames.
    begun : sequence of sequence of Trace
        What was traced of the first frames before: taken as it is.
    kept : list, optional
        Filled with the result while it is made, for who is interrupted.
    progress : callable, optional
        Told after every frame how many are done.

    Returns
    -------
    list of list of Trace
        For each whisker its traces, frame by frame; empty ones where it was not found.

    Raises
    ------
    ValueError
        If no whisker is found in the first frame, or a correction is for none of the whiskers.
    """
    options = options or TraceOptions()
    corrections = corrections or {}
    followers: list[Follower] = []
    traces: list[list[Trace]] = [] if kept is None else kept
    done = len(begun[0]) if begun else 0
    recent: deque[Frame] = deque(maxlen=KEPT)
    seen: list[Seen] = []
    starts = np.empty((0, 2))
    bright, shape = False, (0, 0)
    for i, frame in enumerate(frames):
        if i == 0:
            bright = is_bright(frame, bases, options)
            shape = frame.shape
        if frame.shape != shape:
            raise ValueError(
                f"frame {i} has {frame.shape[1]} × {frame.shape[0]} pixels and those before it "
                f"{shape[1]} × {shape[0]}: a video is needed whose frames are of one size"
            )
        frame = negative(frame) if bright else frame
        if i == 0:
            if done:
                places = bases if bases is not None else [None] * len(begun)
                followers = [
                    _resumed(row, base, options) for row, base in zip(begun, places, strict=True)
                ]
            else:
                followers = [start_at(base, options) for base in _bases(frame, bases, options)]
            begins = [follower.base for follower in followers] if bases is None else bases
            starts = np.array(begins, dtype=np.float64)
            traces[:] = [list(row) for row in begun] or [[] for _ in followers]
            _check(corrections, len(followers))
        if i < done:
            recent.append(frame)
            if len(followers) > 1:
                seen.append(_seen_before(frame, [row[i] for row in traces], followers))
            continue
        known = {k: p for (j, k), p in corrections.items() if j == i}
        found = follow_all(followers, frame, known, seen)
        for trace, row in zip(found, traces, strict=True):
            row.append(trace)
        for k in range(len(followers)):
            if (i, k) in corrections:
                _backward(traces[k], recent, k, corrections, options, seen)
        recent.append(frame)
        if progress is not None:
            progress(i + 1)
    if len(followers) > 1 and done < len(traces[0]):
        _settle(traces, seen, starts)
    return traces


def _seen_before(frame: Frame, found: Sequence[Trace], followers: Sequence[Follower]) -> Seen:
    """What a frame showed that is not traced again."""
    lines = [trace for trace in found if len(trace.line)]
    looks = [look_of(frame, trace) for trace in lines]
    chosen, rest = [], iter(range(len(lines)))
    for follower, trace in zip(followers, found, strict=True):
        chosen.append(next(rest) if len(trace.line) else -1)
        if chosen[-1] >= 0:
            follower.remember(looks[chosen[-1]])
    return Seen(lines, looks, chosen, clear=min(chosen) >= 0)


def _settle(traces: list[list[Trace]], seen: Sequence[Seen], starts: Array) -> None:
    """Tell from all frames together who is who."""
    for i, way in enumerate(decided(seen, starts)):
        for row, c in zip(traces, way, strict=True):
            row[i] = seen[i].lines[c] if c >= 0 else Trace.lost()


def _bases(
    frame: Frame, bases: Sequence[ArrayLike] | None, options: TraceOptions
) -> Sequence[ArrayLike]:
    if bases is not None:
        return bases
    found = find_whiskers(frame, options)
    if not found:
        raise ValueError("no whisker was found in the first frame: say where one begins")
    return [found[0].trace.line[0]]


def _resumed(row: Sequence[Trace], base: ArrayLike | None, options: TraceOptions) -> Follower:
    """Go on after traces that are done, as if they had just been made."""
    if base is None:
        base = next((trace.line[0] for trace in row if len(trace.line)), None)
    if base is None:
        raise ValueError("the frames that were traced before show no whisker")
    follower = start_at(base, options)
    for trace in row:
        if len(trace.line):
            follower.accept(trace)
        else:
            follower.lose()
    return follower


def _check(corrections: Corrections, count: int) -> None:
    wrong = sorted({k for _, k in corrections if not 0 <= k < count})
    if wrong:
        raise ValueError(f"corrections are for whiskers {wrong}; there are {count}, from 0")


def follow_all(
    followers: Sequence[Follower],
    frame: Frame,
    known: Mapping[int, ArrayLike],
    record: list[Seen] | None = None,
) -> list[Trace]:
    """Find every whisker in the next frame."""
    if len(followers) > 1:
        return follow_row(followers, frame, known, record)
    (follower,) = followers
    if not known:
        return [follower.follow(frame)]
    trace = given(known[0])
    follower.restart(trace)
    return [trace]


def _backward(
    row: list[Trace],
    recent: Sequence[Frame],
    whisker: int,
    corrections: Corrections,
    options: TraceOptions,
    seen: Sequence[Seen],
) -> None:
    """Trace back from a corrected frame, the last of the row, until nothing changes."""
    follower = Follower(row[-1].line[0], options)
    follower.restart(row[-1])
    for back, frame in enumerate(reversed(recent)):
        i = len(row) - 2 - back
        if (i, whisker) in corrections:
            return
        trace = follower.follow(frame)
        if overlap(trace.line, row[i].line, 1.0) > _AGREES:
            return
        # The way that sees more is right; what was lost before is found now.
        if trace.support > 0.9 * row[i].support:
            row[i] = trace
            if seen:
                seen[i].settle(whisker, trace)
