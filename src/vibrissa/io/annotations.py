"""Annotations of a recording's videos: contact points, head pose, corrected traces and clicks.

Tables are CSV. Their first column is ``time``, in seconds since the first frame of the first video,
or ``frame``, counted from 0. Views and whiskers are counted from 0 too; unknown columns are
ignored.

**Contact points** tracked by other means: ``x, y, z``, m, laboratory frame, or
``view, frame, x, y``, column and row in at least two views; and ``whisker`` if there are several.
Times without contact are omitted, or their cells are empty.

**Pose of the head**: ``x, y, z``, m, the origin of the head frame in the laboratory frame, and the
rotation from the head frame to the laboratory frame in one of three forms:

- ``qw, qx, qy, qz``: a unit quaternion, real part first,
- ``r11, r12, r13, r21, …, r33``: a rotation matrix, row by row,
- ``azimuth, elevation, roll``, rad: R_z(azimuth) R_y(−elevation) R_x(roll).

**Corrected traces**, confirmed by a person, ``view,frame,whisker,x,y``: one row for each point of a
whisker in one frame of one view, from base to tip, column and row in pixels.

**Clicks** in the images, TOML; pixels, column and row. Masks are excluded from tracking; if there
are regions, everything outside them is excluded.

    videos = ["top.mp4", "front.mp4"]
    pixel_size = 0.058                                # mm
    [[view]]
    base = [[61.0, 304.0]]                            # whisker by whisker, in the first frame
    mask = [[[270.0, 0.0], [310.0, 0.0], [290.0, 300.0]]]     # corners of each polygon
    region = [[[0.0, 0.0], [400.0, 0.0], [400.0, 511.0], [0.0, 511.0]]]
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import transform, xr
from vibrissa.io.paths import check_writable
from vibrissa.io.table import (
    Table,
    check_keys,
    in_file,
    number_array,
    quoted,
    read_numbers,
    read_toml,
    write_table,
)
from vibrissa.numerics import Array, Mask
from vibrissa.quantities import attributes

_SHOWN = 5


def read_over_time(path: str | PathLike[str]) -> tuple[str, dict[str, Array]]:
    """Read a table over time; return ``time`` or ``frame``, whichever it has, and its columns."""
    names, values = read_numbers(path)
    columns = dict(zip(names, values.T, strict=True))
    keys = [name for name in ("time", "frame") if name in columns]
    if len(keys) != 1:
        raise ValueError(
            f"{path} has the columns {', '.join(names)}; either time or frame must be one of them"
        )
    key = keys[0]
    moments = columns[key]
    missing = np.flatnonzero(~np.isfinite(moments))
    if missing.size:
        raise ValueError(f"{path}: {key} is missing in row {missing[0] + 1}")
    wrong = np.flatnonzero((moments != np.round(moments)) | (moments < 0.0))
    if key == "frame" and wrong.size:
        found = f"frame {moments[wrong[0]]:g} in row {wrong[0] + 1}"
        raise ValueError(f"{path}: {found}; 0, 1, … are frames")
    return key, columns


def moments_coordinate(key: str, moments: Array) -> xr.Variable:
    """Coordinate ``time`` or ``frame``."""
    if key == "time":
        return xr.Variable("time", moments, attributes("time"))
    about = {"units": "1", "long_name": "frame of the first video"}
    return xr.Variable("frame", moments.astype(np.int64), about)


def few(numbers: NDArray[np.int64]) -> str:
    """Format the first of some numbers for a message."""
    text = ", ".join(str(int(n)) for n in numbers[:_SHOWN])
    return text + (f" and {len(numbers) - _SHOWN} more" if len(numbers) > _SHOWN else "")


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
        raise ValueError(f"{path}: rows {few(twice + 1)} repeat a contact of an earlier row")
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
    """Distinct whole numbers of a column, and the index among them for each row."""
    wrong = np.flatnonzero(~(column >= 0.0) | (column != np.round(column)))
    if wrong.size:
        raise ValueError(f"{path}: {name} is not a whole number from 0 in rows {few(wrong + 1)}")
    numbers, places = np.unique(column.astype(np.int64), return_inverse=True)
    return numbers, places


PLACE = ("x", "y", "z")
ANGLES = ("azimuth", "elevation", "roll")
QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))

_ROUNDED = 1e-3  # largest rounding error of a quaternion's length and of a matrix's RᵀR


def load_head(path: str | PathLike[str]) -> xr.Dataset:
    """Read the motion of the head.

    Parameters
    ----------
    path : str or path
        CSV; see the module.

    Returns
    -------
    xarray.Dataset
        Dim ``time`` or ``frame``: ``head_position`` (…, space), m, and ``head_rotation``
        (…, space, head_axis), from the head frame to the laboratory frame.
    """
    path = Path(path)
    key, columns = read_over_time(path)
    ways = [way for way in (QUATERNION, MATRIX, ANGLES) if set(way) <= set(columns)]
    if not set(PLACE) <= set(columns) or len(ways) != 1:
        raise ValueError(
            f"{path} has the columns {', '.join(columns)}; x, y, z and an orientation are needed: "
            f"{', '.join(QUATERNION)}, or r11, r12, …, r33, or {', '.join(ANGLES)}"
        )
    way = ways[0]
    moments = columns[key]
    back = np.flatnonzero(np.diff(moments) <= 0.0)
    if back.size:
        i = int(back[0])
        raise ValueError(
            f"{path}: {key} does not increase: {moments[i]:g} is followed by {moments[i + 1]:g} "
            f"(rows {i + 1} and {i + 2}, and {back.size - 1} more times)"
        )
    place = np.stack([columns[name] for name in PLACE], axis=1)
    values = np.stack([columns[name] for name in way], axis=1)
    holes = np.flatnonzero(~np.isfinite(np.column_stack([place, values])).all(axis=1))
    if holes.size:
        raise ValueError(
            f"{path}: numbers are missing in rows {few(holes + 1)}; the head's pose is needed in "
            "every row: omit such rows (in a table by time, poses are interpolated)"
        )
    turn = _rotations(path, way, values).as_matrix()
    return xr.Dataset(
        {
            "head_position": (
                (key, "space"),
                place,
                attributes("head_position") | {"reference_frame": "laboratory"},
            ),
            "head_rotation": ((key, "space", "head_axis"), turn, attributes("head_rotation")),
        },
        {key: moments_coordinate(key, moments), "space": list("xyz")},
    )


def _rotations(path: Path, way: tuple[str, ...], values: Array) -> transform.Rotation:
    """Rotations in one of the three forms; raise ValueError for invalid ones."""
    if way == QUATERNION:
        size = np.linalg.norm(values, axis=1)
        _refuse(path, np.abs(size - 1.0) > _ROUNDED, "quaternions are not of unit length", size)
        return transform.Rotation.from_quat(values[:, [1, 2, 3, 0]])
    if way == MATRIX:
        matrix = values.reshape(-1, 3, 3)
        off = np.abs(np.swapaxes(matrix, 1, 2) @ matrix - np.eye(3)).max(axis=(1, 2))
        _refuse(path, off > _ROUNDED, "matrices are not orthogonal, RᵀR − 1", off)
        sign = np.linalg.det(matrix)
        _refuse(path, sign < 0.0, "matrices mirror, determinant", sign)
        return transform.Rotation.from_matrix(matrix)
    steep = np.abs(values[:, 1]) > 0.5 * np.pi + 1e-9
    _refuse(path, steep, "elevations are above π/2; angles are in rad", values[:, 1])
    return transform.Rotation.from_euler("ZYX", values * [1.0, -1.0, 1.0])


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

    Raises
    ------
    ValueError
        If a row is not a point of a trace or is repeated, or the rows of a trace are apart, as in
        a table that was sorted by another column.
    """
    table = Table(path, CORRECTION_COLUMNS)
    values = np.stack([table.numbers(name) for name in CORRECTION_COLUMNS], axis=1)
    numbers = values[:, :3]
    wrong = ~np.isfinite(values).all(axis=1) | (numbers < 0.0).any(axis=1)
    table.refuse(wrong | (numbers != np.round(numbers)).any(axis=1), "no point of a trace")
    table.refuse(_repeated(values), "there already")
    begins = (np.diff(numbers, axis=0, prepend=np.nan) != 0.0).any(axis=1)
    again = np.flatnonzero(begins)[_repeated(numbers[begins])]
    table.refuse(
        np.isin(np.arange(len(values)), again),
        "of a trace that ended further up; the rows of a trace follow each other, from base to tip",
    )
    points: dict[int, dict[tuple[int, int], list[Array]]] = {}
    for (view, frame, whisker), place in zip(
        numbers.astype(int).tolist(), values[:, 3:], strict=True
    ):
        points.setdefault(view, {}).setdefault((frame, whisker), []).append(place)
    if short := [(v, *key) for v, each in points.items() for key, p in each.items() if len(p) < 2]:
        view, frame, whisker = short[0]
        raise ValueError(
            f"{path}: whisker {whisker} in frame {frame} of view {view} has one point; from base "
            "to tip at least two are needed"
        )
    return {view: {key: np.array(p) for key, p in each.items()} for view, each in points.items()}


def _repeated(rows: Array) -> NDArray[np.bool_]:
    """Rows that are identical to one before."""
    repeated = np.ones(len(rows), dtype=bool)
    repeated[np.unique(rows, axis=0, return_index=True)[1]] = False
    return repeated


def save_corrections(
    path: str | PathLike[str], corrections: Mapping[int, Mapping[tuple[int, int], ArrayLike]]
) -> None:
    """Write corrected traces (n, 2), by view and (frame, whisker), for `load_corrections`."""
    rows: list[list[float]] = []
    for view, each in sorted(corrections.items()):
        for (frame, whisker), points in sorted(each.items()):
            array = np.asarray(points, dtype=np.float64)
            which = f"whisker {whisker} in frame {frame} of view {view}"
            if array.ndim != 2 or array.shape[1:] != (2,) or len(array) < 2:
                raise ValueError(
                    f"{which}: its points are {array.shape}; (n, 2), n ≥ 2, are needed"
                )
            if not np.isfinite(array).all():
                raise ValueError(f"{which} has points that are not finite")
            rows += [[view, frame, whisker, *place] for place in array.tolist()]
    write_table(path, CORRECTION_COLUMNS, rows)


Points = tuple[tuple[float, float], ...]

_FEWEST = 3  # number of corners of a polygon, at least


@dataclass(frozen=True)
class ViewClicks:
    """Clicks in one view."""

    base: Points = ()
    mask: tuple[Points, ...] = ()
    region: tuple[Points, ...] = ()

    def masked(self, size: Sequence[int]) -> Mask | None:
        """Mask of the pixels (height, width) excluded from tracking; None if there are none."""
        masked = _inside(self.mask, size) if self.mask else None
        return together([masked, ~_inside(self.region, size) if self.region else None])


def together(masks: Iterable[Mask | None]) -> Mask | None:
    """Union of masks of one view; None if there is none."""
    shown = [mask for mask in masks if mask is not None]
    if len({mask.shape for mask in shown}) > 1:
        sizes = sorted({f"{mask.shape[1]} × {mask.shape[0]}" for mask in shown})
        raise ValueError(
            f"masks of one view have {' and '.join(sizes)} pixels; they must have the video's size"
        )
    return np.logical_or.reduce(shown) if shown else None


@dataclass(frozen=True)
class Clicks:
    """Clicks in the images of all views."""

    views: tuple[ViewClicks, ...]
    videos: tuple[str, ...] = ()
    pixel_size: float | None = None


def _inside(polygons: Iterable[Points], size: Sequence[int]) -> Mask:
    """Mask of the pixels (height, width) whose centre is inside any of the polygons."""
    width, height = size
    x, y = np.arange(width)[None], np.arange(height)[:, None]
    whole = np.zeros((height, width), dtype=bool)
    for polygon in polygons:
        inside = np.zeros_like(whole)
        for (x0, y0), (x1, y1) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            if y0 != y1:
                # A ray to the right crosses the outline an odd number of times.
                crossing = x0 + (y - y0) * ((x1 - x0) / (y1 - y0))
                inside ^= ((y0 > y) != (y1 > y)) & (x < crossing)
        whole |= inside
    return whole


def polygon_of(points: ArrayLike, name: str) -> Points:
    """Validate the corners (n, 2) of a polygon."""
    array = number_array(points, name, "corners [column, row] are needed")
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < _FEWEST:
        raise ValueError(f"{name} is {quoted(points)}; at least three corners are needed")
    return tuple((float(x), float(y)) for x, y in array)


def load_clicks(path: str | PathLike[str]) -> Clicks:
    """Read the clicks in the images of a recording."""
    table = read_toml(path)
    with in_file(path):
        check_keys(table, {"videos", "pixel_size", "view"}, "it")
        views = table.get("view")
        if not isinstance(views, list) or not all(isinstance(view, dict) for view in views):
            raise ValueError("it has no [[view]]; one for each view is needed")
        if (size := table.get("pixel_size")) is not None:
            size = 1e-3 * float(number_array(size, "pixel_size"))
            if not 0.0 < size < np.inf:
                raise ValueError(f"pixel_size is {1e3 * size:g}; it must be positive, mm")
        read = tuple(_view(view, i) for i, view in enumerate(views))
        return Clicks(read, tuple(map(str, table.get("videos", ()))), size)


def _view(table: dict[str, Any], number: int) -> ViewClicks:
    check_keys(table, {"base", "mask", "region"}, f"view {number}")
    bases = number_array(table.get("base", []), f"base of view {number}")
    if bases.size and (bases.ndim != 2 or bases.shape[1] != 2 or not np.isfinite(bases).all()):
        raise ValueError(f"base of view {number} is {quoted(table['base'])}; [[x, y], …] is needed")
    areas = {}
    for name in ("mask", "region"):
        polygons = table.get(name, [])
        if not isinstance(polygons, list):
            raise ValueError(f"{name} of view {number} is {quoted(polygons)}; a list is needed")
        areas[name] = tuple(polygon_of(one, f"{name} of view {number}") for one in polygons)
    return ViewClicks(tuple((float(x), float(y)) for x, y in bases.reshape(-1, 2)), **areas)


def save_clicks(path: str | PathLike[str], clicks: Clicks) -> None:
    """Write the clicks in the images of a recording."""
    check_writable(path, (".toml",))
    lines = [f"videos = {json.dumps(clicks.videos, ensure_ascii=False)}"]
    if clicks.pixel_size is not None:
        lines.append(f"pixel_size = {1e3 * clicks.pixel_size!r}")
    for view in clicks.views:
        lines.append("\n[[view]]")
        names = ("base", "mask", "region")
        lines += [f"{name} = {_listed(getattr(view, name))}" for name in names]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _listed(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_listed, value))}]"
    return repr(round(float(value), 2))
