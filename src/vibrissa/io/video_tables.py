"""The first column of tables over a video: ``time``, s, or ``frame``, a number from 0.

Contact points that were tracked otherwise, as CSV, for comparison.

Either places in the laboratory, m, or pixels in at least two views, a line each:

- ``time`` or ``frame``, ``x, y, z``, and ``whisker`` where there are several,
- ``view, frame, x, y``, column and row, and ``whisker``.

Views, frames and whiskers are counted from 0, frames in three dimensions being those of the first
video. Moments without contact are left out, or their numbers are empty.

How the head moves, as CSV: ``time`` or ``frame``, place and orientation in every row.

Place: ``x, y, z``, m, the origin of the head's frame in the laboratory. Orientation, from the
head's to the laboratory frame, in one of three ways:

- ``qw, qx, qy, qz``: a unit quaternion, real part first,
- ``r11, r12, r13, r21, …, r33``: a rotation matrix, row by row,
- ``azimuth, elevation, roll``, rad: R_z(azimuth) R_y(−elevation) R_x(roll).

``frame`` counts the frames of the first video from 0, ``time`` is seconds since its first frame.
Other columns are left alone.

Corrected traces, points that a person has confirmed, as CSV ``view,frame,whisker,x,y``: the points
of a whisker in one frame of one view (a number from 0), from base to tip, column and row in pixels,
a line each.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from vibrissa.deferred import xr
from vibrissa.io.table import Table, read_numbers, write_table
from vibrissa.numerics import Array
from vibrissa.quantities import attributes

_SHOWN = 5


def read_over_time(path: str | PathLike[str]) -> tuple[str, dict[str, Array]]:
    """Read a table whose rows are moments."""
    names, values = read_numbers(path)
    columns = dict(zip(names, values.T, strict=True))
    keys = [name for name in ("time", "frame") if name in columns]
    if len(keys) != 1:
        raise ValueError(
            f"{path} has the columns {', '.join(names)}; either time or frame must be one of them"
        )
    key = keys[0]
    moments = columns[key]
    if not np.isfinite(moments).all():
        raise ValueError(f"{path}: {key} is missing in row {_first(~np.isfinite(moments))}")
    if key == "frame" and (moments != np.round(moments)).any() | (moments < 0.0).any():
        row = _first((moments != np.round(moments)) | (moments < 0.0))
        raise ValueError(f"{path}: frame {moments[row - 1]:g} in row {row}; 0, 1, … are frames")
    return key, columns


def check_rising(path: str | PathLike[str], key: str, moments: Array) -> None:
    """Refuse moments that do not rise from row to row."""
    back = np.flatnonzero(np.diff(moments) <= 0.0)
    if back.size:
        i = int(back[0])
        raise ValueError(
            f"{path}: {key} does not rise: {moments[i]:g} is followed by {moments[i + 1]:g} (rows "
            f"{i + 1} and {i + 2}, and {back.size - 1} more times)"
        )


def moments_coordinate(key: str, moments: Array) -> xr.Variable:
    """Label moments."""
    if key == "time":
        return xr.Variable("time", moments, attributes("time"))
    about = {"units": "1", "long_name": "frame of the first video"}
    return xr.Variable("frame", moments.astype(np.int64), about)


def few(numbers: NDArray[np.int64]) -> str:
    """Write the first of some numbers."""
    text = ", ".join(str(int(n)) for n in numbers[:_SHOWN])
    return text + (f" and {len(numbers) - _SHOWN} more" if len(numbers) > _SHOWN else "")


def _first(mask: NDArray[np.bool_]) -> int:
    """Row of the first that is true, from 1."""
    return int(np.flatnonzero(mask)[0]) + 1


def load_contact_points(path: str | PathLike[str]) -> xr.Dataset:
    """Read contact points.

    Parameters
    ----------
    path : str or path
        CSV; see the module.

    Returns
    -------
    xarray.Dataset
        Dims ``time`` or ``frame``, and whisker: ``contact_point`` (…, space), laboratory frame, m;
        or ``contact_pixel`` (frame, whisker, view, image_axis). NaN where there is none.
    """
    path = Path(path)
    key, columns = read_over_time(path)
    in_views = "view" in columns
    axes = ("x", "y") if in_views else ("x", "y", "z")
    if not set(axes) <= set(columns) or (in_views and key == "time"):
        raise ValueError(
            f"{path} has the columns {', '.join(columns)}; time or frame, x, y, z, or view, frame, "
            "x, y are needed"
        )
    count = len(columns[key])
    moments, moment = np.unique(columns[key], return_inverse=True)
    whiskers, whisker = _numbers(path, columns.get("whisker", np.zeros(count)), "whisker")
    views, view = _numbers(path, columns.get("view", np.zeros(count)), "view")
    if in_views and len(views) < 2:
        raise ValueError(f"{path} covers view {views[0]} only; two are needed for a position")
    places = np.ravel_multi_index(
        (moment, whisker, view), (len(moments), len(whiskers), len(views))
    )
    _, first = np.unique(places, return_index=True)
    twice = np.setdiff1d(np.arange(count), first)
    if twice.size:
        raise ValueError(f"{path}: rows {few(twice + 1)} tell of a contact that an earlier one has")
    values = np.full((len(moments), len(whiskers), len(views), len(axes)), np.nan)
    values[moment, whisker, view] = np.stack([columns[axis] for axis in axes], axis=1)
    coordinates = {key: moments_coordinate(key, moments), "whisker": whiskers}
    if in_views:
        about = {"units": "pixel", "long_name": "contact point in the image"}
        return xr.Dataset(
            {"contact_pixel": ((key, "whisker", "view", "image_axis"), values, about)},
            coordinates | {"view": views, "image_axis": ["column", "row"]},
        )
    about = dict(attributes("contact_point")) | {"reference_frame": "laboratory"}
    return xr.Dataset(
        {"contact_point": ((key, "whisker", "space"), values[:, :, 0], about)},
        coordinates | {"space": list("xyz")},
    )


def _numbers(path: Path, column: Array, name: str) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Numbers that a column has, and the index of each of its rows among them."""
    wrong = np.flatnonzero(~(column >= 0.0) | (column != np.round(column)))
    if wrong.size:
        raise ValueError(f"{path}: {name} is not a number from 0 on in rows {few(wrong + 1)}")
    numbers, places = np.unique(column.astype(np.int64), return_inverse=True)
    return numbers, places


PLACE = ("x", "y", "z")
ANGLES = ("azimuth", "elevation", "roll")
QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))

_ROUNDED = 1e-3
"""Largest error of a quaternion's length and of a matrix's RᵀR: tables cut decimals."""


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
    values = np.stack([columns[name] for name in way], axis=1)
    holes = np.flatnonzero(~np.isfinite(np.column_stack([place, values])).all(axis=1))
    if holes.size:
        raise ValueError(
            f"{path}: numbers are missing in rows {few(holes + 1)}; the head's pose is needed in "
            "every row, so leave such rows out (by time, what is between rows is interpolated)"
        )
    turn = {QUATERNION: _of_quaternions, MATRIX: _of_matrices, ANGLES: _of_angles}[way](
        path, values
    )
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


def _of_quaternions(path: Path, values: Array) -> Array:
    size = np.linalg.norm(values, axis=1)
    _refuse(path, np.abs(size - 1.0) > _ROUNDED, "quaternions are not of unit length", size)
    return Rotation.from_quat(values[:, [1, 2, 3, 0]]).as_matrix()


def _of_matrices(path: Path, values: Array) -> Array:
    matrix = values.reshape(-1, 3, 3)
    off = np.abs(np.swapaxes(matrix, 1, 2) @ matrix - np.eye(3)).max(axis=(1, 2))
    _refuse(path, off > _ROUNDED, "matrices are not orthogonal, RᵀR − 1", off)
    sign = np.linalg.det(matrix)
    _refuse(path, sign < 0.0, "matrices mirror, determinant", sign)
    return Rotation.from_matrix(matrix).as_matrix()


def _of_angles(path: Path, values: Array) -> Array:
    steep = np.abs(values[:, 1])
    _refuse(
        path,
        steep > 0.5 * np.pi + 1e-9,
        "elevations are above π/2; angles are in rad",
        values[:, 1],
    )
    azimuth, elevation, roll = values.T
    turns = Rotation.from_euler("ZYX", np.stack([azimuth, -elevation, roll], axis=1))
    return turns.as_matrix()


def _refuse(path: Path, wrong: NDArray[np.bool_], what: str, value: Array) -> None:
    rows = np.flatnonzero(wrong)
    if rows.size:
        raise ValueError(f"{path}: {what}: {value[rows[0]]:.4g} in row {few(rows + 1)}")


CORRECTION_COLUMNS = ("view", "frame", "whisker", "x", "y")


def load_corrections(path: str | PathLike[str]) -> dict[int, dict[tuple[int, int], Array]]:
    """Read corrected traces.

    Parameters
    ----------
    path : str or path
        CSV file.

    Returns
    -------
    dict
        Points (n, 2) from base to tip, column and row, by view and then by frame and whisker.
    """
    table = Table(path, CORRECTION_COLUMNS)
    values = np.stack([table.numbers(name) for name in CORRECTION_COLUMNS], axis=1)
    numbers = values[:, :3]
    wrong = ~np.isfinite(values).all(axis=1) | (numbers < 0.0).any(axis=1)
    table.refuse(wrong | (numbers != np.round(numbers)).any(axis=1), "no point of a trace")
    points: dict[int, dict[tuple[int, int], list[Array]]] = {}
    for (view, frame, whisker), place in zip(
        numbers.astype(int).tolist(), values[:, 3:], strict=True
    ):
        points.setdefault(view, {}).setdefault((frame, whisker), []).append(place)
    short = [(v, *key) for v, each in points.items() for key, p in each.items() if len(p) < 2]
    if short:
        view, frame, whisker = short[0]
        raise ValueError(
            f"{path}: whisker {whisker} in frame {frame} of view {view} has one point; from base "
            "to tip at least two are needed"
        )
    return {view: {key: np.array(p) for key, p in each.items()} for view, each in points.items()}


def save_corrections(
    path: str | PathLike[str], corrections: Mapping[int, Mapping[tuple[int, int], ArrayLike]]
) -> None:
    """Write corrected traces so that `load_corrections` reads them.

    Parameters
    ----------
    path : str or path
        CSV file; an existing one is replaced once the new one is complete.
    corrections : mapping
        Points (n, 2) from base to tip, column and row, by view and then by frame and whisker.

    Raises
    ------
    ValueError
        If a trace has less than two points, or one that is not finite.
    """
    rows: list[list[float]] = []
    for view, each in sorted(corrections.items()):
        for (frame, whisker), points in sorted(each.items()):
            array = np.asarray(points, dtype=np.float64)
            if array.ndim != 2 or array.shape[1:] != (2,) or len(array) < 2:
                raise ValueError(
                    f"whisker {whisker} in frame {frame} of view {view}: points of shape "
                    f"{array.shape}; (n, 2), n ≥ 2, is needed"
                )
            if not np.isfinite(array).all():
                raise ValueError(
                    f"whisker {whisker} in frame {frame} of view {view} has points that are not "
                    "finite"
                )
            rows += [[view, frame, whisker, *place] for place in array.tolist()]
    write_table(path, CORRECTION_COLUMNS, rows)
