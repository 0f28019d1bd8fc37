"""Cameras as files and as the group of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

import numpy as np
import xarray as xr

from vibrissa.cameras.camera import Camera
from vibrissa.io import in_file, read_calibration, write_calibration
from vibrissa.quantities import attributes

_VARIABLES: dict[str, tuple[str, tuple[str, ...]]] = {
    "camera_matrix": ("matrix", ("row", "column")),
    "camera_rotation": ("rotation", ("row", "column")),
    "camera_translation": ("translation", ("row",)),
    "camera_distortion": ("distortion", ("coefficient",)),
    "image_size": ("size", ("side",)),
    "projection": ("projection", ()),
}
"""Attribute of a camera, and dimensions, of each variable."""


def load_cameras(path: str | PathLike[str], unit: float = 1e-3) -> tuple[Camera, ...]:
    """Read calibrated cameras.

    Parameters
    ----------
    path : str or path
        File in Anipose's TOML (`vibrissa.io.anipose`).
    unit : float
        Unit of the file's lengths, m; that of the board that calibrated the cameras, usually mm.

    Returns
    -------
    tuple of Camera
        Cameras in the file's order.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not a calibration, or one with faults.
    """
    from scipy.spatial.transform import Rotation

    cameras = []
    for table in read_calibration(path):
        kind = table.get("projection", "perspective")
        scale = np.diag([1.0 / unit, 1.0 / unit, 1.0]) if kind == "orthographic" else np.eye(3)
        with in_file(path):
            camera = Camera(
                matrix=np.asarray(table["matrix"]) @ scale,
                rotation=Rotation.from_rotvec(table["rotation"]).as_matrix(),
                translation=np.asarray(table["translation"]) * unit,
                distortion=np.asarray(table["distortions"]),
                size=(table["size"][0], table["size"][1]),
                projection=kind,
                name=str(table["name"]),
            )
        cameras.append(camera)
    return tuple(cameras)


def save_cameras(path: str | PathLike[str], cameras: Sequence[Camera], unit: float = 1e-3) -> None:
    """Write cameras so that `load_cameras`, and for perspective ones Anipose, can read them.

    Parameters
    ----------
    path : str or path
        File to write, usually with the ending ``.toml``.
    cameras : sequence of Camera
        Cameras of the views.
    unit : float
        Unit of the file's lengths, m.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    """
    from scipy.spatial.transform import Rotation

    tables = []
    for camera in cameras:
        flat = camera.projection == "orthographic"
        scale = np.diag([unit, unit, 1.0]) if flat else np.eye(3)
        table = {
            "name": camera.name,
            "size": camera.size,
            "matrix": (camera.matrix @ scale).tolist(),
            "distortions": camera.distortion.tolist(),
            "rotation": Rotation.from_matrix(camera.rotation).as_rotvec().tolist(),
            "translation": (camera.translation / unit).tolist(),
        }
        tables.append(table | ({"projection": camera.projection} if flat else {}))
    write_calibration(path, tables)


def cameras_dataset(cameras: Sequence[Camera]) -> xr.Dataset:
    """Write cameras as a dataset, the group ``cameras`` of a recording."""
    return xr.Dataset(
        {
            name: (
                ("view", *axes),
                np.array([getattr(camera, part) for camera in cameras]),
                attributes(name),
            )
            for name, (part, axes) in _VARIABLES.items()
        },
        {"view": [camera.name for camera in cameras]},
        {"reference_frame": "laboratory"},
    )


def cameras_from_dataset(dataset: xr.Dataset) -> tuple[Camera, ...]:
    """Read the cameras that `cameras_dataset` wrote."""
    return tuple(
        Camera(
            matrix=row["camera_matrix"].values,
            rotation=row["camera_rotation"].values,
            translation=row["camera_translation"].values,
            distortion=row["camera_distortion"].values,
            size=(int(row["image_size"][0]), int(row["image_size"][1])),
            projection=str(row["projection"].values),  # type: ignore[arg-type]
            name=str(row["view"].values),
        )
        for row in (dataset.isel(view=i) for i in range(dataset.sizes["view"]))
    )
