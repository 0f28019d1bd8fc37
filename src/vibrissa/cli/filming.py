"""`vibrissa movie`: a trial as movies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from vibrissa.cli.terminal import Force, Tell, free, output, progress_bars, refuse, stoppable

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from vibrissa.plots import Course

_KINDS = ("signals", "contour")
_LASTS = 45.0
"""How long a movie of a whole trial is to last at most, s, unless a step is given."""


def movie(
    path: Annotated[Path, typer.Argument(help="A recording, .nc.", metavar="TRIAL")],
    target: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="A folder, or for one kind a file .mp4.", metavar="DIR"
        ),
    ] = Path("movies"),
    kind: Annotated[str, typer.Option(help="signals, contour or both.")] = "both",
    videos: Annotated[
        list[Path] | None,
        typer.Option(
            "--video",
            help="The video of a view, top and then front; without videos the whisker is drawn as "
            "the cameras would see it.",
            metavar="FILE",
        ),
    ] = None,
    chart: Annotated[
        Path | None,
        typer.Option("--map", help="Of the whisker; simulated by default.", metavar="MAP"),
    ] = None,
    fps: Annotated[float, typer.Option(help="Frames per second at which it is shown.")] = 25.0,
    step: Annotated[
        int | None,
        typer.Option(help="Every how many frames of the trial; by default it lasts up to 45 s."),
    ] = None,
    start: Annotated[float | None, typer.Option("--from", help="Time of the first frame, s.")] = (
        None
    ),
    stop: Annotated[float | None, typer.Option("--to", help="Time of the last frame, s.")] = None,
    whisker: Annotated[int, typer.Option(help="Which whisker, from 0.")] = 0,
    force: Force = False,
) -> None:
    """Make movies of a trial: its signals in the solids of all contacts; the contour as it comes.

    Stopped with Ctrl-C it leaves what was done in a file NAME-part.mp4 that can be played.
    Example: `vibrissa movie trial.nc --video top.mp4 --video front.mp4 -o movies`
    """
    from vibrissa.io import load_recording
    from vibrissa.plots import course_of

    kinds = _chosen(kind)
    if "signals" not in kinds:
        refuse({"--map": chart}, "the movie of the contour shows no map")
    if "contour" not in kinds:
        refuse({"--video": videos}, "the movie of the signals shows no video")
    files = _files(target, path, kinds)
    free(files.values(), force)
    trial = load_recording(path)
    course = course_of(trial, whisker)
    rows = movie_rows(course.time, fps, step, start, stop)
    possible = _possible(kinds, course, rows, path)
    with progress_bars() as tell, stoppable() as stopped:
        for name in possible:
            frames = _FRAMES[name](trial, course, rows, whisker, videos or [], chart, tell)
            files[name].parent.mkdir(parents=True, exist_ok=True)
            _written(files[name], frames, (name, len(rows)), fps, tell, stopped)
            if stopped():
                raise typer.Exit(130)


def _chosen(kind: str) -> tuple[str, ...]:
    if kind == "both":
        return _KINDS
    if kind not in _KINDS:
        raise ValueError(f"--kind is {kind!r}; one of {', '.join(_KINDS)}, both is needed")
    return (kind,)


def _files(target: Path, trial: Path, kinds: Sequence[str]) -> dict[str, Path]:
    """Where each movie goes."""
    from vibrissa.io.paths import check_folder, check_writable

    if target.suffix.lower() == ".mp4":
        if len(kinds) > 1:
            raise ValueError(f"--output is the file {target}; for one file choose one --kind")
        check_writable(target)
        return {kinds[0]: target}
    check_folder(target)
    return {name: target / f"{trial.stem}-{name}.mp4" for name in kinds}


def movie_rows(
    time: NDArray[np.float64],
    fps: float,
    step: int | None = None,
    start: float | None = None,
    stop: float | None = None,
) -> NDArray[np.intp]:
    """Choose frames of a trial for a movie."""
    if not (np.isfinite(fps) and fps > 0.0):
        raise ValueError(f"--fps is {fps!r}; it must be positive")
    if step is not None and step < 1:
        raise ValueError(f"--step is {step}; 1 or more is needed")
    first = time[0] if start is None else start
    last = time[-1] if stop is None else stop
    rows = np.flatnonzero((time >= first - 1e-9) & (time <= last + 1e-9))
    if not rows.size:
        raise ValueError(
            f"there are no frames from {first:g} to {last:g} s; the trial has some from "
            f"{time[0]:g} to {time[-1]:g} s"
        )
    if step is None:
        step = int(np.ceil(rows.size / (_LASTS * fps)))
    return rows[::step]


def _possible(
    kinds: Sequence[str], course: Course, rows: NDArray[np.intp], path: Path
) -> list[str]:
    """Kinds for which the trial has what is needed; says what is lacking for others."""
    lacking = {}
    if course.signals is None:
        lacking["signals"] = f"no signals: `vibrissa signals {path}` makes them"
    span = slice(rows[0], rows[-1] + 1)
    if course.places is None:
        lacking["contour"] = f"no contact points: `vibrissa reconstruct {path}` makes them"
    elif not np.isfinite(course.places[span]).any():
        lacking["contour"] = "no contact points at these times"
    possible = [name for name in kinds if name not in lacking]
    reasons = [f"{path} has {lacking[name]}" for name in kinds if name in lacking]
    if not possible:
        raise ValueError("; ".join(dict.fromkeys(reasons)))
    for reason in reasons:
        output.print(f"{reason}; left out", highlight=False, soft_wrap=True)
    return possible


def _signal_frames(
    trial: xr.DataTree,
    course: Course,
    rows: NDArray[np.intp],
    whisker: int,
    videos: Sequence[Path],
    chart: Path | None,
    tell: Tell,
) -> Iterator[Any]:
    from vibrissa.cli.trial_views import map_of
    from vibrissa.plots import signal_frames

    contact_map = map_of(trial, chart, whisker, tell)
    return signal_frames(
        course, contact_map.to_dataset(), contact_map.whisker.centerline(101), rows
    )


def _contour_frames(
    trial: xr.DataTree,
    course: Course,
    rows: NDArray[np.intp],
    whisker: int,
    videos: Sequence[Path],
    chart: Path | None,
    tell: Tell,
) -> Iterator[Any]:
    from vibrissa.cli.trial_views import bodies_of, fits_of, sights_of
    from vibrissa.plots import contour_frames
    from vibrissa.recording import Recording

    rest = Recording(trial).whisker(whisker).centerline(101)
    sights = sights_of(trial, course, videos, rows)
    return contour_frames(course, rest, sights, rows, bodies_of(trial), fits_of(trial))


_FRAMES = {"signals": _signal_frames, "contour": _contour_frames}


def _written(
    path: Path,
    frames: Iterable[Any],
    about: tuple[str, int],
    fps: float,
    tell: Tell,
    stopped: Callable[[], bool],
) -> None:
    """Write a movie; if it is stopped, what was done goes beside it."""
    from vibrissa.io import write_movie

    name, total = about
    stage = f"movie of {'the contour' if name == 'contour' else name}"

    def counted() -> Iterator[Any]:
        tell(stage, 0, total)
        for done, frame in enumerate(frames, 1):
            yield frame
            tell(stage, done, total)
            if stopped():
                return

    part = path.with_name(f"{path.stem}-part.mp4")
    count = write_movie(part, counted(), fps)
    if count < total:
        what = f"stopped after {count} of {total} frames: {part} holds these"
    else:
        part.replace(path)
        what = f"wrote {path}, {count} frames, {count / fps:.1f} s"
    output.print(what, highlight=False, soft_wrap=True)
