"""What a recording and its videos give to figures and movies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from vibrissa.cameras import Camera
    from vibrissa.contacts import ContactMap
    from vibrissa.contour import FittedShape
    from vibrissa.objects.surface import Surface
    from vibrissa.plots import Course, Sight

_LIGHT, _DARK = 235.0, 70.0
_MOST = 2


def sights_of(
    trial: xr.DataTree, course: Course, videos: Sequence[Path], rows: NDArray[np.intp]
) -> list[Sight]:
    """Give what the cameras of a trial see in some frames."""
    from vibrissa.io import video_frames
    from vibrissa.plots import Sight

    cameras = _cameras(trial)
    if videos and len(videos) != len(cameras):
        raise ValueError(
            f"the trial has {len(cameras)} cameras; there are {len(videos)} videos: give one "
            "--video for each"
        )
    sights = []
    for number, camera in enumerate(cameras[:_MOST]):
        if videos:
            frames = _frames(course, number, rows)
            _check(videos[number], camera, frames)
            images: Iterable[Any] = video_frames(videos[number], frames)
        else:
            images = repeat(_backdrop(trial, camera, course))
        sights.append(Sight(camera, images))
    return sights


def _cameras(trial: xr.DataTree) -> tuple[Camera, ...]:
    """Cameras of a recording; for a simulated trial without, two that look at it."""
    from vibrissa.recording import Recording
    from vibrissa.simulation import views_of

    if "cameras" in trial.children:
        return Recording(trial).cameras
    if "truth" in trial.children and "centerline" in trial["truth"]:
        return views_of(trial)
    return ()


def _frames(course: Course, number: int, rows: NDArray[np.intp]) -> list[int]:
    """Numbers of frames in a video."""
    if course.frames is None:
        return [int(row) for row in rows]
    return [int(frame) for frame in course.frames[rows, number]]


def _check(video: Path, camera: Camera, frames: Sequence[int]) -> None:
    from vibrissa.io import video_info

    info = video_info(video)
    if (info.width, info.height) != tuple(camera.size):
        raise ValueError(
            f"{video} has {info.width} × {info.height} pixels, the camera {camera.name!r} has "
            f"{camera.size[0]} × {camera.size[1]}: is it the video of another view?"
        )
    if 0 < info.frames <= max(frames):
        raise ValueError(f"{video} has {info.frames} frames; frame {max(frames)} is needed")


def _backdrop(trial: xr.DataTree, camera: Camera, course: Course) -> Any:
    """Objects as a camera sees them, on even light."""
    from vibrissa.simulation.shadows import silhouette

    middle = np.nanmean(course.position, axis=0)
    covered = silhouette(camera, bodies_of(trial), middle, 0.7)
    return np.asarray(_LIGHT * (1.0 - covered) + _DARK * covered, dtype=np.uint8)


def bodies_of(trial: xr.DataTree) -> list[Surface]:
    """List the objects of a trial, as far as they are known."""
    from vibrissa.recording import Recording

    return list(Recording(trial).objects)


def fits_of(trial: xr.DataTree) -> list[FittedShape]:
    """List the shapes that were fitted to the contacts of a trial."""
    from vibrissa.contour import shape_from_dataset

    if "contour" not in trial.children:
        return []
    return [shape_from_dataset(trial["contour"].to_dataset())]


def map_of(trial: xr.DataTree, path: Path | None, whisker: int, tell: Any) -> ContactMap:
    """Read the map of a trial's whisker, or simulate it."""
    from vibrissa.cli.sources import map_from
    from vibrissa.contacts import ContactMap
    from vibrissa.recording import Recording

    own = Recording(trial).whisker(whisker)
    if path is None:
        stage = "map of all contacts"
        tell(stage, 0, 1)
        made = ContactMap.simulate(
            own, grid=False, progress=lambda done, total: tell(stage, done, total)
        )
        tell(stage, 1, 1)
        return made
    found = map_from(path)
    if not np.isclose(found.whisker.length, own.length, rtol=1e-6):
        raise ValueError(
            f"{path} is the map of a whisker of {1e3 * found.whisker.length:.3f} mm, that of the "
            f"trial has {1e3 * own.length:.3f} mm: leave --map out to have its own"
        )
    return found
