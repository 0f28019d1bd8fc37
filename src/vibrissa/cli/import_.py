"""`vibrissa import`: conversion of other trackers' files to a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import vibrissa as vb
from vibrissa.cli.inputs import TrackedOptions, cameras_from, filtered_at, objects_from
from vibrissa.cli.options import check_new, with_options
from vibrissa.cli.terminal import progress_bars, remark
from vibrissa.cli.track import print_tracked
from vibrissa.deferred import xr

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray


_VIEWS = ("top", "front")  # default names of views


@with_options("the recording, .nc")
def import_tracks(
    tracks: list[Path],
    target: Path,
    own: TrackedOptions,
    cameras: Path | None = None,
    pixel_size: float | None = None,
    rate: float | None = None,
    unit: Literal["m", "cm", "mm", "um"] | None = None,
    names: str | None = None,
    point_sigma: float | None = None,
    base_radius: float | None = None,
    tip_radius: float | None = None,
    length: float | None = None,
    cutoff: float | None = None,
    fur: float = 0.0,
    objects: Path | None = None,
    force: bool = False,
) -> None:
    """Create a recording from whiskers tracked by another program.

    Two files are two views of the same whiskers. One file may contain points in space, several
    views, or one view, in whose plane the whisker is then assumed to remain. The rod is fitted to
    the points as `vibrissa track` fits it to videos; the next step is `vibrissa reconstruct`.
    Example: `vibrissa import topDLC.csv frontDLC.csv --pixel-size 0.058 --rate 1000 -o trial.nc`
    """
    check_new(target, vb.io.NETCDF, force)
    views = None if cameras is None else cameras_from(cameras)
    found = _tracks(tracks, rate, unit, views)
    traces = vb.tracking.tracker_traces(
        found,
        views,
        pixel_size=None if pixel_size is None else 1e-3 * pixel_size,
        names=None if names is None else names.replace(",", " ").split(),
        sigma=_sigma(point_sigma, found),
        tip=length is None,
    )
    for note in traces.notes:
        remark(f"note: {note}")
    # Twelve digits remove the rounding errors of differences of times.
    per_second = float(f"{1.0 / float(np.median(np.diff(found['time'].values))):.12g}")
    how = vb.tracking.TrackOptions(
        cutoff=filtered_at(cutoff, per_second, found.sizes["time"] / per_second),
        length=own.tracked_length(length),
        fur=own.hidden(fur),
        **own.tracked(base_radius, tip_radius),
    )
    known: dict[str, Any] = {} if objects is None else {"objects": objects_from(objects)}
    with progress_bars() as tell:
        result = vb.tracking.track(
            traces.cameras,
            traces.traces,
            per_second,
            how,
            names=traces.names,
            progress=tell,
            **known,
        )
    result.attrs["origin"] = (
        f"tracked by {found.attrs['source_software']} in {found.attrs['source']}"
    )
    vb.io.save_recording(target, result)
    print_tracked(result, target)


def _sigma(stated: float | None, tracks: xr.Dataset) -> float | None:
    """Standard deviation of points: in pixels, or converted from mm to m."""
    if stated is None:
        return None
    if not 0.0 < stated < 100.0:
        raise ValueError(f"--point-sigma is {stated:g}; it must be more than 0 and less than 100")
    return 1e-3 * stated if "centerline" in tracks else stated


def _tracks(
    paths: Sequence[Path],
    rate: float | None,
    unit: str | None,
    cameras: Sequence[vb.cameras.Camera] | None,
) -> xr.Dataset:
    """Read the tracks of all views, with every frame from the first to the last."""
    given: dict[str, Any] = {"fps": rate, "unit": unit}
    labels: Any = {name: value for name, value in given.items() if value is not None}
    parts = [vb.load_tracks(path, **labels) for path in paths]
    _check_frames(paths, [part["frame"].values for part in parts])
    if len(paths) > 1:
        if cameras is None and len(paths) > len(_VIEWS):
            raise ValueError(f"{len(paths)} views are given; their --cameras are needed")
        named = _VIEWS if cameras is None else [f"{path.parent.name}/{path.stem}" for path in paths]
        if any(part.sizes.get("view", 1) > 1 for part in parts):
            raise ValueError("several files must contain one view each")
        if spatial := [str(p) for p, part in zip(paths, parts, strict=True) if "trace" not in part]:
            raise ValueError(f"{', '.join(spatial)}: points in space must be in a single file")
        together = [
            part.assign_coords(view=[name]) for part, name in zip(parts, named, strict=False)
        ]
        found = vb.io.join_views(*together)
        found.attrs |= {k: parts[0].attrs[k] for k in ("source_software",)}
    else:
        found = parts[0]
    if found["time"].attrs.get("units") != "s":
        raise ValueError(f"{paths[0]} does not state the frame rate: give --rate")
    if usual := vb.io.slow_steps(found["time"].values):
        remark(
            f"note: frames are {usual:.3g} s apart: time has to be in seconds (--rate: frames a "
            "second), and forces and contacts are filtered wrongly if it is in ms"
        )
    frames = found["frame"].values
    every = np.arange(frames.min(), frames.max() + 1)
    if len(every) > len(frames):
        # What no row holds is a whisker that is lost.
        rows = found.swap_dims(time="frame").drop_vars("time").reindex(frame=every)
        step = np.median(np.diff(found["time"].values) / np.diff(frames))
        found = rows.assign_coords(time=("frame", step * every)).swap_dims(frame="time")
    return found


def _check_frames(paths: Sequence[Path], numbers: Sequence[NDArray[Any]]) -> None:
    """Raise ValueError unless the frames of every view increase, and views have some in common."""
    for path, frames in zip(paths, numbers, strict=True):
        if len(frames) < 2:
            raise ValueError(f"{path} contains one frame; a trial of several is needed")
        wrong = np.flatnonzero(np.diff(frames) <= 0)
        if wrong.size:
            before, after = frames[wrong[0] : wrong[0] + 2]
            raise ValueError(
                f"{path}: frame {after} follows frame {before}; numbers of frames must increase"
            )
    first = max(frames[0] for frames in numbers)
    last = min(frames[-1] for frames in numbers)
    if first > last:
        spans = (f"{p} {f[0]} to {f[-1]}" for p, f in zip(paths, numbers, strict=True))
        raise ValueError(f"the views have no frames in common: {', '.join(spans)}")
