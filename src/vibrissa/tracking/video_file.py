"""Tracing a video file, so that what is done is kept when it is stopped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vibrissa.io import Frame, load_traces, read_video, save_traces, video_frames, video_info
from vibrissa.tracking.begin import FRAMES
from vibrissa.tracking.trace import Trace, TraceOptions
from vibrissa.tracking.view import trace_video

if TYPE_CHECKING:
    from vibrissa.tracking.view import Corrections


def partial_traces(recording: str | PathLike[str], view: int) -> Path:
    """Say where the traces of a view are kept until the recording made of them is written.

    Parameters
    ----------
    recording : str or path
        The recording.
    view : int
        Number of the view.

    Returns
    -------
    Path
        A hidden file beside it.
    """
    recording = Path(recording)
    return recording.with_name(f".{recording.name}.view{view}.npz")


_SPAN = 400
"""From how many frames at the beginning of a film those for its start are taken."""


def start_frames(
    videos: Sequence[str | PathLike[str]], offset: int = 0
) -> tuple[list[int], list[list[Frame]]]:
    """Read frames of the beginning of a film, from which its whisker can be found.

    Parameters
    ----------
    videos : sequence of str or path
        The video of each view.
    offset : int
        Frames by which the other cameras began before the first.

    Returns
    -------
    numbers : list of int
        Numbers of the frames in the first video.
    frames : list of list of array (height, width)
        View by view, frames of the same moments.

    Raises
    ------
    ValueError
        If a video has no frames of these moments.
    """
    firsts = [max(-offset, 0), *(max(offset, 0) for _ in videos[1:])]
    pairs = list(zip(videos, firsts, strict=True))
    left = [(video_info(video).frames or _SPAN + first) - first for video, first in pairs]
    span = max(1, min(_SPAN, *left))
    rows = np.unique(np.linspace(0, span - 1, min(FRAMES, span)).astype(int))
    try:
        frames = [list(video_frames(video, first + rows)) for video, first in pairs]
    except ValueError:
        # Not every file says truly how many frames it has.
        rows = np.arange(FRAMES)
        frames = [list(islice(read_video(v), first, first + FRAMES)) for v, first in pairs]
    count = min(len(view) for view in frames)
    if not count:
        raise ValueError(f"{', '.join(map(str, videos))}: there is no frame of all views")
    return (firsts[0] + rows[:count]).tolist(), [view[:count] for view in frames]


def trace_file(
    video: str | PathLike[str],
    partial: str | PathLike[str],
    bases: Any = None,
    options: TraceOptions | None = None,
    *,
    corrections: Corrections | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[list[Trace]]:
    """Trace the whiskers of a video file, or go on where it was stopped.

    Parameters
    ----------
    video : str or path
        The video.
    partial : str or path
        Where traces are kept, also when the work is stopped by an exception such as
        ``KeyboardInterrupt``; whoever is done with them removes the file. Traces of another video,
        or made with other settings, are not taken.
    bases : sequence of (column, row), optional
        As of `trace_video`.
    options : TraceOptions, optional
        How.
    corrections : mapping, optional
        As of `trace_video`.
    progress : callable, optional
        Called as ``progress(done, total)`` with numbers of frames.

    Returns
    -------
    list of list of Trace
        Whisker by whisker, frame by frame.
    """
    video, partial = Path(video), Path(partial)
    about = video.stat()
    fixed = sorted((key, np.asarray(at).tolist()) for key, at in (corrections or {}).items())
    key = f"{video.resolve()} {about.st_size} {about.st_mtime_ns} {bases} {fixed} {options}"
    begun = load_traces(partial, key) or []
    rows = [[Trace(*row) for row in whisker] for whisker in begun]
    kept: list[list[Trace]] = []
    total = max(video_info(video).frames, 1)

    def tell(done: int) -> None:
        if progress is not None:
            progress(done, max(total, done))

    try:
        traces = trace_video(
            read_video(video),
            bases,
            options,
            corrections=corrections,
            begun=rows,
            kept=kept,
            progress=tell,
        )
    finally:
        if kept and kept[0]:
            done = min(len(row) for row in kept)
            save_traces(partial, key, [[(*t,) for t in row[:done]] for row in kept])
    if progress is not None:
        progress(len(traces[0]), len(traces[0]))
    return traces
