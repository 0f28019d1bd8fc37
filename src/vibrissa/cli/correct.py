"""`vibrissa correct`: a window for the correction of traces."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import vibrissa as vb
from vibrissa.cli.options import with_options
from vibrissa.cli.terminal import say

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_ENDLESS = 1 << 31  # assumed number of frames of a video that does not state it


@with_options("corrections, .csv, which are added to those that it holds already")
def correct(video: Path, target: Path, trace: Path | None = None, view: int = 0) -> None:
    """Click the correct trace of a whisker in some frames, for `vibrissa track --corrections`.

    Click points from base to tip; the arrow keys change the frame, s saves, q saves and closes; the
    window shows all keys.
    Example: `vibrissa correct top.mp4 -o corrections.csv --trace trial.nc`
    """
    if view < 0:
        raise ValueError(f"--view is {view}; views are counted from 0")
    vb.io.check_writable(target, (".csv",))
    all_ = vb.io.load_corrections(target) if target.exists() else {}
    traces = {} if trace is None else _traces(trace, view)

    def save(found: dict[tuple[int, int], NDArray[np.float64]]) -> None:
        vb.io.save_corrections(target, {**all_, view: found})

    count = vb.io.video_info(video).frames or _ENDLESS
    found = vb.plots.correct(vb.io.FrameReader(video), count, all_.get(view), traces, save)
    say(f"{len(found)} corrected traces of view {view}")
    say(f"use them: vibrissa track … --corrections {target}")


def _traces(path: Path, view: int) -> dict[tuple[int, int], Any]:
    """Traces of a recording, by frame of the video and whisker."""
    data = vb.load_recording(path).to_dataset()
    if "trace" not in data:
        raise ValueError(f"{path} is a recording without traces")
    if view >= data.sizes["view"]:
        raise ValueError(f"{path} has {data.sizes['view']} views; there is no view {view}")
    lines = data["trace"].isel(view=view).values
    numbers = data["frame"].isel(view=view).values if "frame" in data else range(len(lines))
    return {
        (int(frame), whisker): line
        for frame, row in zip(numbers, lines, strict=True)
        for whisker, line in enumerate(row)
    }
