"""How the head moves, as CSV: ``time`` or ``frame``, place and orientation in every row.

Place: ``x, y, z``, m, the origin of the head's frame in the laboratory. Orientation, from the
head's to the laboratory frame, in one of three ways:

- ``qw, qx, qy, qz``: a unit quaternion, real part first,
- ``r11, r12, r13, r21, …, r33``: a rotation matrix, row by row,
- ``azimuth, elevation, roll``, rad: R_z(azimuth) R_y(−elevation) R_x(roll).

``frame`` counts the frames of the first video from 0, ``time`` is seconds since its first frame.
Other columns are left alone.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vibrissa.io.over_time import check_rising, few, moments_coordinate, read_over_time
from vibrissa.quantities import attributes

Array = NDArray[np.float64]

PLACE = ("x", "y", "z")
ANGLES = ("azimuth", "elevation", "roll")
QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))

_ROUNDED = 1e-3
"""By how much a quaternion's length and a matrix's RᵀR may miss 1: decimals are cut in tables."""


def load_head(path: str | PathLike[str]) -> xr.Dataset:
    """Read how the head moves.

    Parameters
    ----------
    path : str or path
        CSV; see the module.

    Returns
    -------
    xarray.Dataset
        Dim ``time`` or ``frame``: ``head_position`` (…, space), m, and ``head_rotation``
        (…, space, head_axis), from the head's to the laboratory frame.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If columns or numbers are missing, rows are not in order, or an orientation is none.
    """
    path = Path(path)
    key, columns = read_over_time(path)
    ways = [way for way in (QUATERNION, MATRIX, ANGLES) if set(way) <= set(columns)]
    if not set(PLACE) <= set(columns) or len(ways) != 1:
        raise ValueError(
            f"{path} has the columns {', '.join(columns)}; x, y, z and one way of orientation are "
            f"needed: {', '.join(QUATERNION)}, or r11, r12, …, r33, or {', '.join(ANGLES)}"
        )
    way = ways[0]
    check_rising(path, key, columns[key])
    place = np.stack([columns[name] for name in PLACE], axis=1)
    said = np.stack([columns[name] for name in way], axis=1)
    holes = np.flatnonzero(~np.isfinite(np.column_stack([place, said])).all(axis=1))
    if holes.size:
        raise ValueError(
            f"{path}: numbers are missing in rows {few(holes + 1)}; the head's pose is needed in "
            "every row, so leave such rows out (by time, what is between rows is interpolated)"
        )
    turn = {QUATERNION: _of_quaternions, MATRIX: _of_matrices, ANGLES: _of_angles}[way](path, said)
    return xr.Dataset(
        {
            "head_position": (
                (key, "space"),
                place,
                attributes("head_position") | {"reference_frame": "laboratory"},
            ),
            "head_rotation": ((key, "space", "head_axis"), turn, attributes("head_rotation")),
        },
        {key: moments_coordinate(key, columns[key]), "space": list("xyz")},
    )


def _of_quaternions(path: Path, said: Array) -> Array:
    size = np.linalg.norm(said, axis=1)
    _refuse(path, np.abs(size - 1.0) > _ROUNDED, "quaternions are not of unit length", size)
    return Rotation.from_quat(said[:, [1, 2, 3, 0]]).as_matrix()


def _of_matrices(path: Path, said: Array) -> Array:
    matrix = said.reshape(-1, 3, 3)
    off = np.abs(np.swapaxes(matrix, 1, 2) @ matrix - np.eye(3)).max(axis=(1, 2))
    _refuse(path, off > _ROUNDED, "matrices are not orthogonal, RᵀR − 1", off)
    sign = np.linalg.det(matrix)
    _refuse(path, sign < 0.0, "matrices mirror, determinant", sign)
    return Rotation.from_matrix(matrix).as_matrix()


def _of_angles(path: Path, said: Array) -> Array:
    steep = np.abs(said[:, 1])
    _refuse(
        path, steep > 0.5 * np.pi + 1e-9, "elevations are above π/2; angles are in rad", said[:, 1]
    )
    azimuth, elevation, roll = said.T
    turns = Rotation.from_euler("ZYX", np.stack([azimuth, -elevation, roll], axis=1))
    return turns.as_matrix()


def _refuse(path: Path, wrong: NDArray[np.bool_], what: str, value: Array) -> None:
    rows = np.flatnonzero(wrong)
    if rows.size:
        raise ValueError(f"{path}: {what}: {value[rows[0]]:.4g} in row {few(rows + 1)}")
