"""Datasets of *movement* (NetCDF): ``position`` and ``confidence`` of keypoints.

Up to its version 0.16 the dimensions are called individuals and keypoints, since 0.17 individual
and keypoint. Datasets of several cameras have a dimension ``view``. Positions in a plane are pixels
unless the attribute ``space_unit`` states another.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import xr
from vibrissa.io.netcdf import naming, read_dataset
from vibrissa.io.tracks import RawTracks

Array = NDArray[np.float64]
Frames = NDArray[np.int64]

_NAMES = {"individuals": "individual", "keypoints": "keypoint"}
_DIMS = ("time", "individual", "view", "keypoint", "space")
_PIXELS = ("", "px", "pixel", "pixels")


def read_movement(path: str | PathLike[str]) -> RawTracks:
    """Read a poses dataset as raw tracks."""
    path = Path(path)
    with naming(path, "a poses dataset of movement"):
        return _raw(path, read_dataset(path))


def _raw(path: Path, poses: xr.Dataset) -> RawTracks:
    poses = poses.rename({old: new for old, new in _NAMES.items() if old in poses.dims})
    if "position" not in poses or not {"time", "keypoint", "space"} <= set(poses["position"].dims):
        got = ", ".join(str(name) for name in poses.variables) or "nothing"
        raise ValueError(
            f"{path} is not a poses dataset of movement: it has {got}, and position along time, "
            "space, keypoint(s) and individual(s) is needed"
        )
    views = [str(name) for name in poses["view"].values] if "view" in poses.dims else []
    if "individual" not in poses.dims:
        poses = poses.expand_dims(individual=["whisker"])
    if not views:
        poses = poses.expand_dims("view")
    points = poses["position"].transpose(*_DIMS).values.astype(np.float64)
    sure = None
    if "confidence" in poses:
        sure = poses["confidence"].transpose(*_DIMS[:-1]).values.astype(np.float64)
    unit = str(poses.attrs.get("space_unit", ""))
    flat = points.shape[-1] == 2
    fps, time, frames = _clock(poses)
    if flat and unit not in _PIXELS:
        raise ValueError(f"{path} has positions in a plane in {unit}; pixels are needed")
    if not flat and points.shape[2] > 1:
        raise ValueError(f"{path} has points in space for {points.shape[2]} views; one is needed")
    return RawTracks(
        software=f"movement ({poses.attrs.get('source_software', 'unknown')})",
        whiskers=[str(name) for name in poses["individual"].values],
        image=points if flat else None,
        image_confidence=sure if flat else None,
        space=None if flat else points[:, :, 0],
        space_confidence=None if flat or sure is None else sure[:, :, 0],
        nodes=[str(name) for name in poses["keypoint"].values],
        views=views,
        unit="" if unit in _PIXELS else unit,
        fps=fps,
        time=time,
        frames=frames,
    )


def _clock(poses: xr.Dataset) -> tuple[float | None, Array | None, Frames | None]:
    """Frames a second, times and numbers of the frames, as far as they are known."""
    fps = poses.attrs.get("fps")
    time = poses["time"].values.astype(np.float64)
    if poses.attrs.get("time_unit", "frames") == "frames":
        return None, None, time.astype(np.int64)
    if fps is None:
        return None, time, None
    return float(fps), time, np.rint(time * float(fps)).astype(np.int64)
