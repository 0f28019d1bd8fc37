"""`vibrissa track`: from two videos to a recording."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.sources import whisker_from
from vibrissa.cli.terminal import Force, free, numbers, progress_bars, refuse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import xarray as xr

    from vibrissa.cameras import Camera
    from vibrissa.tracking import TraceOptions, TrackOptions

_MICRO = 1e-6
_WIDEST = 1.0
"""What views of a whisker may be wide at most, m."""


def track(
    videos: Annotated[
        list[Path],
        typer.Argument(
            help="The video of each view, top and then front; of several trials one after the "
            "other.",
            metavar="VIDEO...",
        ),
    ],
    recording: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Recording to write, .nc; of several trials a folder for them.",
            metavar="FILE",
        ),
    ],
    pixel_size: Annotated[
        float | None,
        typer.Option(
            help="What a pixel of both views sees, m, without --cameras; 58e-6 by default."
        ),
    ] = None,
    fps: Annotated[float, typer.Option(help="Frames per second at which it was filmed.")] = 1000.0,
    cameras: Annotated[
        Path | None,
        typer.Option(
            help="Calibrated cameras: Anipose's TOML, mm, or those of a recording (.nc).",
            metavar="FILE",
        ),
    ] = None,
    base: Annotated[
        list[str] | None,
        typer.Option(
            help="Column and row where a whisker leaves the face in the first frame, view by view "
            "and then whisker by whisker; by default the whisker is traced that all views show: "
            "start.png, beside the recording, shows which.",
            metavar="X,Y",
        ),
    ] = None,
    corrections: Annotated[
        Path | None,
        typer.Option(help="Corrected traces: CSV of view,frame,whisker,x,y.", metavar="FILE"),
    ] = None,
    offset: Annotated[
        str, typer.Option(help="Frames by which the second camera began earlier, or auto.")
    ] = "0",
    cutoff: Annotated[float, typer.Option(help="Low pass of the base's pose, Hz; 0: none.")] = 85.0,
    whisker: Annotated[
        Path | None,
        typer.Option(
            help="The whisker at rest, where it is known: digitised (CSV), or of a recording or "
            "map (.nc). By default it is taken from the frames without contact.",
            metavar="FILE",
        ),
    ] = None,
    base_radius: Annotated[
        float | None,
        typer.Option(help="Of the whisker at its base, µm; by default 100, or as in --whisker."),
    ] = None,
    head: Annotated[
        Path | None,
        typer.Option(
            help="How the head moves: CSV of frame (or time), x, y, z and qw, qx, qy, qz (or a "
            "matrix, or azimuth, elevation, roll), or a recording.",
            metavar="FILE",
        ),
    ] = None,
    contact: Annotated[
        Path | None,
        typer.Option(
            help="Contact points tracked otherwise, to compare with: CSV of frame (or time), x, "
            "y, z, m, or of view, frame, x, y in pixels.",
            metavar="FILE",
        ),
    ] = None,
    thing: Annotated[
        Path | None,
        typer.Option(
            "--object",
            help="What stands there: TOML with [[object]] as a trial has, or a recording; the "
            "contact is also taken where the whisker is nearest to it.",
            metavar="FILE",
        ),
    ] = None,
    width: Annotated[
        float, typer.Option(help="Of the whisker's base in the images, pixels, at least 3.")
    ] = 3.0,
    jump: Annotated[
        float,
        typer.Option(
            help="How far a whisker may be from where the frames before lead one to expect it, "
            "pixels; what is farther away is another whisker."
        ),
    ] = 5.0,
    bright: Annotated[
        bool | None,
        typer.Option(
            "--bright/--dark",
            help="Whether whiskers are bright on dark; by default the first frame tells.",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Track a whisker in two videos: its shape, how it is held, its contact, what its base feels.

    The result is a recording. Stopped with Ctrl-C it goes on from there when it is called again.
    Example: `vibrissa track top.mp4 front.mp4 --pixel-size 58e-6 --fps 1000 -o trial.nc`
    """
    from vibrissa.io import load_corrections
    from vibrissa.io.paths import check_readable
    from vibrissa.tracking import TraceOptions, TrackOptions

    for path in videos:
        check_readable(path)
    if offset != "auto" and not offset.lstrip("+-").isdigit():
        raise ValueError(f"--offset is {offset!r}; a number of frames or auto is needed")
    views = _cameras(videos, cameras, pixel_size)
    count = len(views)
    alone = {"--corrections": corrections, "--head": head, "--contact": contact}
    trials = _trials(videos, count, recording, alone)
    free(trials, force)
    _check_numbers(fps, cutoff, base_radius)
    _check_pixels(width=width, jump=jump)
    places = _bases(base or [], views)
    fixed = {} if corrections is None else load_corrections(corrections)
    unknown = sorted(view for view in fixed if view >= count)
    if unknown:
        raise ValueError(f"{corrections} corrects view {unknown[0]}; views are counted from 0")
    properties: dict[str, Any] = (
        {} if base_radius is None else {"base_radius": base_radius * _MICRO}
    )
    known = None if whisker is None else whisker_from(whisker).with_properties(**properties)
    how = TrackOptions(
        cutoff=cutoff or None,
        offset=None if offset == "auto" else int(offset),
        properties=properties,
        whisker=known,
    )
    beside = _beside(head, contact, thing)
    if "head" in beside:
        _check_head(beside["head"], videos[0], fps)
    trace = TraceOptions(scale=max(width / 3.0, 1.0), jump=jump, bright=bright)
    for file, trial in trials.items():
        picture = file.with_name("start.png" if len(trials) == 1 else f"{file.stem}.start.png")
        _tracked(trial, file, picture, views, fps, places, fixed, trace, how, beside)


def _tracked(
    videos: Sequence[Path],
    recording: Path,
    picture: Path,
    cameras: tuple[Camera, ...],
    fps: float,
    places: Sequence[Any],
    corrections: Any,
    options: TraceOptions,
    how: TrackOptions,
    beside: Mapping[str, Any],
) -> None:
    """Track one trial and say what was found."""
    from vibrissa.cli.track_report import tell_lengths, tell_recording
    from vibrissa.io import save_recording
    from vibrissa.tracking import partial_traces, trace_file
    from vibrissa.tracking import track as tracked

    if places[0] is None:
        places, options = _found(videos, picture, cameras, options, how.offset or 0)
    kept = [partial_traces(recording, view) for view in range(len(videos))]
    with progress_bars() as tell:
        traces = [
            trace_file(
                path,
                kept[view],
                places[view],
                options,
                corrections=corrections.get(view, {}),
                progress=partial(tell, f"trace {path.name}"),
            )
            for view, path in enumerate(videos)
        ]
        result = tracked(cameras, traces, fps, how, progress=tell, **beside)
    tell_lengths(videos, traces, result.sizes["time"])
    save_recording(recording, result)
    for file in kept:
        file.unlink(missing_ok=True)
    tell_recording(result, recording)


def _found(
    videos: Sequence[Path],
    picture: Path,
    cameras: tuple[Camera, ...],
    options: TraceOptions,
    offset: int,
) -> tuple[list[Any], TraceOptions]:
    """Find the whisker, and show what is taken for it before any time is spent on it."""
    from dataclasses import replace

    from vibrissa.cli.track_report import tell_start
    from vibrissa.plots import save, start_views
    from vibrissa.tracking import find_start, start_frames

    numbers, frames = start_frames(videos, offset)
    start = find_start(cameras, frames, options)
    names = [camera.name for camera in cameras]
    images = [view[start.frame] for view in frames]
    remarks = [f"frame {numbers[start.frame]} of {videos[0].name}: {why}" for why in start.doubts]
    figure = start_views(images, start.lines, names, start.confidence, remarks)
    save(figure, picture.with_suffix(""), ("png",))
    if start.bases is None:
        raise ValueError(
            f"where the whisker begins was not found: {start.doubts[0]}. See {picture}, and say "
            "where it leaves the face, once for each view: "
            + " ".join("--base X,Y" for _ in videos)
        )
    tell_start(start, names, picture)
    return [[base.tolist()] for base in start.bases], replace(options, bright=start.bright)


def _cameras(
    videos: Sequence[Path], path: Path | None, pixel_size: float | None
) -> tuple[Camera, ...]:
    from vibrissa.cameras import load_cameras, orthogonal_views
    from vibrissa.cameras.camera import PIXEL_SIZE
    from vibrissa.io import load_recording, video_info
    from vibrissa.io.paths import NETCDF
    from vibrissa.recording import Recording

    if path is not None:
        refuse({"--pixel-size": pixel_size}, "the --cameras tell it")
        if path.suffix.lower() in NETCDF:
            cameras = Recording(load_recording(path)).cameras
        else:
            cameras = load_cameras(path)
        if len(cameras) < 2:
            raise ValueError(
                f"{path} tells of one camera, {cameras[0].name!r}; a whisker in space is seen by "
                "two or more: calibrate them together, or leave --cameras out"
            )
        if len(videos) % len(cameras):
            raise ValueError(
                f"{path} tells of {len(cameras)} cameras; there are {len(videos)} videos"
            )
        _check_sizes(videos, path, cameras)
        return cameras
    if len(videos) % 2:
        raise ValueError(f"{len(videos)} videos: give two a trial, or their cameras with --cameras")
    sizes = [(info.width, info.height) for info in map(video_info, videos)]
    if len(set(sizes)) > 1:
        raise ValueError(f"the videos differ in size, {sorted(set(sizes))}: give --cameras")
    pixel_size = PIXEL_SIZE if pixel_size is None else pixel_size
    wide = pixel_size * sizes[0][0]
    if not 0.0 < wide <= _WIDEST:
        raise ValueError(
            f"--pixel-size is {pixel_size:g} m, by which the views are {wide:g} m wide; it is in "
            "metres, such as 58e-6"
        )
    return orthogonal_views(pixel_size, sizes[0])


def _check_sizes(videos: Sequence[Path], path: Path, cameras: tuple[Camera, ...]) -> None:
    """Make sure that each camera was calibrated with images of its video's size."""
    from vibrissa.io import video_info

    for i, video in enumerate(videos):
        camera, info = cameras[i % len(cameras)], video_info(video)
        if (info.width, info.height) != tuple(camera.size):
            raise ValueError(
                f"{video} is {info.width} × {info.height} pixels; {path} calibrates camera "
                f"{camera.name!r} for {camera.size[0]} × {camera.size[1]}: calibrate with images "
                "of the video's size, or give the videos in the cameras' order"
            )


def _trials(
    videos: Sequence[Path], count: int, recording: Path, alone: Mapping[str, Path | None]
) -> dict[Path, Sequence[Path]]:
    """Videos of each trial, by the recording that they give."""
    from vibrissa.io.paths import NETCDF, check_writable

    trials = [videos[i : i + count] for i in range(0, len(videos), count)]
    files = [recording]
    if len(trials) > 1:
        refuse(alone, "it is for one trial; track that by itself")
        if not recording.is_dir():
            raise ValueError(f"--output is {recording}; for several trials a folder is needed")
        files = [recording / f"{trial[0].stem}.nc" for trial in trials]
        if len(set(files)) < len(files):
            raise ValueError("two trials would have one file: their first videos share a name")
    for file in files:
        check_writable(file, NETCDF)
    _check_twice(trials)
    return dict(zip(files, trials, strict=True))


def _check_pixels(**options: float) -> None:
    for name, pixels in options.items():
        if not 0.0 < pixels < float("inf"):
            raise ValueError(f"--{name} is {pixels:g}; pixels, more than 0, are needed")


def _check_numbers(fps: float, cutoff: float, base_radius: float | None) -> None:
    """Find out before the work what would end it."""
    if not 0.0 < fps < float("inf"):
        raise ValueError(f"--fps is {fps:g}; frames per second, more than 0, are needed")
    if not 0.0 <= cutoff < 0.5 * fps:
        raise ValueError(
            f"--cutoff is {cutoff:g} Hz; it must be below half of {fps:g} frames/s, or 0 for none"
        )
    if base_radius is not None and not 0.0 < base_radius < float("inf"):
        raise ValueError(f"--base-radius is {base_radius:g} µm; it must be positive")


def _check_twice(trials: Sequence[Sequence[Path]]) -> None:
    """One video cannot show a whisker from two sides."""
    for trial in trials:
        if len({path.resolve() for path in trial}) < len(trial):
            names = ", ".join(map(str, trial))
            raise ValueError(f"{names}: a video is there twice; each view needs its own")


def _beside(head: Path | None, contact: Path | None, thing: Path | None) -> dict[str, Any]:
    """What is known besides the videos."""
    from vibrissa.io import load_contact_points, load_head, load_recording
    from vibrissa.io.paths import NETCDF
    from vibrissa.io.table import read_text
    from vibrissa.io.toml import in_file
    from vibrissa.recording import Recording
    from vibrissa.simulation.script import read_objects

    if contact is not None and thing is not None:
        raise ValueError("--contact and --object both say where the contact is; give one of them")
    beside: dict[str, Any] = {}
    if head is not None and head.suffix.lower() in NETCDF:
        beside["head"] = load_recording(head).to_dataset()
        if "head_rotation" not in beside["head"]:
            raise ValueError(f"{head} is a recording that tells of no head")
    elif head is not None:
        beside["head"] = load_head(head)
    if contact is not None:
        beside["contacts"] = load_contact_points(contact)
    if thing is not None and thing.suffix.lower() in NETCDF:
        beside["objects"] = Recording(load_recording(thing)).objects
        if not beside["objects"]:
            raise ValueError(f"{thing} is a recording without objects")
    elif thing is not None:
        with in_file(thing):
            beside["objects"] = read_objects(read_text(thing), thing.parent)
    return beside


def _check_head(head: xr.Dataset, video: Path, fps: float) -> None:
    """Find out before the work whether the head is known in all frames."""
    import numpy as np

    from vibrissa.io import video_info
    from vibrissa.tracking import HeadPose

    frames = video_info(video).frames
    if frames:
        HeadPose.of(head, np.arange(frames), fps)


def _bases(texts: Sequence[str], cameras: Sequence[Camera]) -> list[list[list[float]] | None]:
    """Bases of each view; None: to be found."""
    views = len(cameras)
    if not texts:
        return [None] * views
    places = [numbers(text, ("x", "y"), "--base") for text in texts]
    if len(places) % views:
        raise ValueError(f"there are {len(places)} --base for {views} views; each needs as many")
    each = len(places) // views
    for i, (x, y) in enumerate(places):
        width, height = cameras[i // each].size
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise ValueError(
                f"--base {texts[i]} lies outside of view {i // each}, {width} × {height} pixels"
            )
    return [places[v * each : (v + 1) * each] for v in range(views)]
