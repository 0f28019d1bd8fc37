"""`vibrissa movie`: movies of a trial."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray

import vibrissa as vb
from vibrissa.cli.figures import NODES, TrialOptions, fits_of, lacking_of, sights_of
from vibrissa.cli.inputs import recording_from
from vibrissa.cli.options import free, refuse, with_options
from vibrissa.cli.terminal import Tell, progress_bars, say, stoppable
from vibrissa.deferred import xr

_KINDS = ("signals", "contour")
_LASTS = 45.0  # longest duration of a movie of a whole trial, s, unless a step is given


@dataclass(frozen=True)
class FrameOptions:
    """Options for the range of frames and the rate of a movie."""

    fps: float = 25.0
    step: int | None = None
    start: float | None = None
    stop: float | None = None

    def rows(self, time: NDArray[np.float64]) -> NDArray[np.intp]:
        """Indices of the frames to show."""
        if not (np.isfinite(self.fps) and self.fps > 0.0):
            raise ValueError(f"--fps is {self.fps!r}; it must be positive")
        if self.step is not None and self.step < 1:
            raise ValueError(f"--step is {self.step}; 1 or more is needed")
        first = time[0] if self.start is None else self.start
        last = time[-1] if self.stop is None else self.stop
        rows = np.flatnonzero((time >= first - 1e-9) & (time <= last + 1e-9))
        if not rows.size:
            raise ValueError(
                f"there are no frames from {first:g} to {last:g} s; the trial has some from "
                f"{time[0]:g} to {time[-1]:g} s"
            )
        return rows[:: self.step or int(np.ceil(rows.size / (_LASTS * self.fps)))]


@with_options("the movies, in a folder, or one kind as a file .mp4")
def movie(
    path: Path,
    of_trial: TrialOptions,
    frames: FrameOptions,
    kind: Literal["signals", "contour", "both"] = "both",
    target: Path = Path("movies"),
    force: bool = False,
) -> None:
    """Create movies of a trial: its signals in the solids of all contacts, and the growing contour.

    Without videos the whisker is drawn as the cameras would see it. After Ctrl-C the completed part
    remains in a playable file NAME-part.mp4.
    Example: `vibrissa movie trial.nc --video top.mp4 --video front.mp4 -o movies`
    """
    if kind == "contour":
        refuse({"--map": of_trial.map}, "the movie of the contour does not show a map")
    if kind == "signals":
        refuse({"--video": of_trial.videos}, "the movie of the signals does not show videos")
    kinds = _KINDS if kind == "both" else (kind,)
    make_movies(path, recording_from(path), target, kinds, of_trial, frames, force)


def make_movies(
    path: Path,
    trial: xr.DataTree,
    target: Path,
    kinds: Sequence[str],
    of_trial: TrialOptions,
    frames: FrameOptions,
    force: bool,
) -> list[Path]:
    """Create the movies for which a trial has the data."""
    files = _files(target, path, kinds)
    free(files.values(), force)
    of_trial = of_trial.of(trial)
    course = vb.scene.course_of(trial, of_trial.whisker)
    rows = frames.rows(course.time)
    lacking = dict(lacking_of(course, trial, path))
    if course.places is not None and not np.isfinite(course.places[rows[0] : rows[-1] + 1]).any():
        lacking["contour"] = "no contact points at these times"
    reasons = [f"{path} has {lacking[name]}" for name in kinds if name in lacking]
    possible = [name for name in kinds if name not in lacking]
    if not possible:
        raise ValueError("; ".join(dict.fromkeys(reasons)))
    for reason in reasons:
        say(f"{reason}; left out")
    with progress_bars() as tell, stoppable() as stopped:
        # Maps and videos are read before the first movie is drawn.
        images = {n: _frames(n, trial, course, rows, of_trial, tell) for n in possible}
        for name in possible:
            files[name].parent.mkdir(parents=True, exist_ok=True)
            _write(files[name], images[name], (name, len(rows)), frames.fps, tell, stopped)
            if stopped():
                raise typer.Exit(130)
    return [files[name] for name in possible]


def _files(target: Path, trial: Path, kinds: Sequence[str]) -> dict[str, Path]:
    """File of each movie."""
    if target.suffix.lower() == ".mp4":
        if len(kinds) > 1:
            raise ValueError(f"--output is the file {target}; for one file choose one --kind")
        vb.io.check_writable(target)
        return {kinds[0]: target}
    vb.io.check_folder(target)
    return {name: target / f"{trial.stem}-{name}.mp4" for name in kinds}


def _frames(
    name: str,
    trial: xr.DataTree,
    course: vb.scene.Course,
    rows: NDArray[np.intp],
    of_trial: TrialOptions,
    tell: Tell,
) -> Iterator[Any]:
    """Yield the images of a movie."""
    if name == "signals":
        contact_map = of_trial.contact_map(trial, tell)
        line = contact_map.whisker.centerline(NODES)
        return vb.plots.signal_frames(course, contact_map.to_dataset(), line, rows)
    known = vb.recording.Recording(trial)
    rest = known.whisker(of_trial.whisker).centerline(NODES)
    sights = sights_of(trial, course, of_trial.videos or (), rows)
    bodies = list(known.objects)
    return vb.plots.contour_frames(course, rest, sights, rows, bodies, fits_of(trial))


def _write(
    path: Path,
    frames: Iterable[Any],
    about: tuple[str, int],
    fps: float,
    tell: Tell,
    stopped: Callable[[], bool],
) -> None:
    """Write a movie; if it is interrupted, keep the completed part next to it."""
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
    count = vb.io.write_movie(part, counted(), fps)
    if count < total:
        say(f"stopped after {count} of {total} frames: {part} contains these")
        return
    part.replace(path)
    say(f"wrote {path}, {count} frames, {count / fps:.1f} s")
