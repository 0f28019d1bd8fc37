"""Reader of whiskers from MATLAB files, version 5 (by SciPy) and 7.3 (HDF5).

There is no standard layout. Those in common use are recognised:

- a struct array with fields x, y, z and optionally time and id: one entry per frame (and whisker),
- a cell array with a matrix (points, 3) for each frame,
- three variables whose names differ in x, y and z: cell arrays of vectors, or matrices (frame,
  point),
- one array (frame, point, 3), (point, 3, frame) or (3, point, frame).

With two coordinates instead of three, points are in pixels. Frames may have different numbers of
points; zeros after the last point are padding.

Variables of both file versions are converted to the same Python values: numbers to arrays with
MATLAB's dimensions, cell arrays to lists, struct arrays to lists of dicts. Anything else (text,
functions, objects of classes) is ignored.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import h5py
import numpy as np

from vibrissa.deferred import xr
from vibrissa.io.netcdf import opened
from vibrissa.io.paths import check_readable
from vibrissa.io.tracks import Labels, RawTracks, labelled
from vibrissa.numerics import Array


@dataclass(frozen=True, eq=False)
class _Frames:
    """Points of each entry of a recognised layout, with its frame and whisker."""

    points: Sequence[Array]
    frames: Sequence[float] | None = None
    whiskers: Sequence[int] | None = None


def load_matlab(
    path: str | PathLike[str], variable: str | None = None, **labels: Unpack[Labels]
) -> xr.Dataset:
    """Read whiskers frame by frame.

    Parameters
    ----------
    path : str or path
        The ``.mat`` file.
    variable : str, optional
        Name of the variable with the whiskers, or of the three with x, y and z, separated by
        commas. Required only if there are several candidates.
    **labels
        Metadata: fps; unit (required for points in space) and reference_frame, or view; see
        `Labels`.

    Returns
    -------
    xarray.Dataset
        Tracks.
    """
    return labelled(read_matlab(path, variable), path, **labels)


def read_matlab(path: str | PathLike[str], variable: str | None = None) -> RawTracks:
    """Read a MATLAB file as raw tracks; see `load_matlab`."""
    path = Path(path)
    values = matlab_values(path)
    found = dict(_candidates(values))
    if variable is not None:
        found = {name: one for name, one in found.items() if name == variable}
    if not found:
        raise ValueError(
            f"{path} has no whiskers frame by frame{f' in {variable}' if variable else ''}; it has "
            f"{', '.join(values) or 'no variables'}. A struct array with x, y, z, a cell array of "
            "matrices (points, 3), three variables for x, y and z, or one array (frame, point, 3) "
            "is needed"
        )
    if len(found) > 1:
        raise ValueError(
            f"{path} may have whiskers in {' and in '.join(found)}; choose one by variable="
        )
    ((name, frames),) = found.items()
    return _tracks(path, name, frames)


def _candidates(values: Mapping[str, Any]) -> Iterator[tuple[str, _Frames]]:
    for name, value in values.items():
        if isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
            yield from _structs(name, value)
        elif isinstance(value, list) and value:
            yield from _cells(name, value)
        elif isinstance(value, np.ndarray) and value.ndim == 3 and 3 in value.shape:
            axis = 2 if value.shape[2] == 3 else value.shape.index(3)
            # In MATLAB, frames are usually stacked along the last dimension.
            frame = 0 if axis == 2 else 2
            yield name, _Frames(list(np.moveaxis(value, (frame, axis), (0, 2))))
    yield from _triples(values)


def _structs(name: str, value: list[dict[str, Any]]) -> Iterator[tuple[str, _Frames]]:
    fields = {field.lower(): field for field in value[0]}
    if not {"x", "y"} <= set(fields):
        return
    axes = [fields[axis] for axis in "xyz" if axis in fields]
    points = [_columns([entry[axis] for axis in axes]) for entry in value]
    if any(one is None for one in points):
        return
    time = _scalars(value, fields.get("time"))
    who = _scalars(value, fields.get("id"))
    kept = [one for one in points if one is not None]
    whiskers = None if time is None else _numbers(time, who)
    yield name, _Frames(kept, time, whiskers)


def _cells(name: str, value: list[Any]) -> Iterator[tuple[str, _Frames]]:
    arrays = [np.asarray(one) for one in value if isinstance(one, np.ndarray)]
    if len(arrays) != len(value):
        return
    filled = [one for one in arrays if one.size]
    for width in (3, 2):
        if filled and all(one.ndim == 2 and one.shape[1] == width for one in filled):
            yield name, _Frames([one.reshape(-1, width) for one in arrays])
            return
        if filled and all(one.ndim == 2 and one.shape[0] == width for one in filled):
            yield name, _Frames([one.reshape(width, -1).T for one in arrays])
            return


def _triples(values: Mapping[str, Any]) -> Iterator[tuple[str, _Frames]]:
    """Yield triples of variables such as x, y, z; xw3d, yw3d, zw3d; tracked_x, …, tracked_z."""
    for name in values:
        for i, letter in enumerate(name):
            if letter not in "xX":
                continue
            axes = "xyz" if letter == "x" else "XYZ"
            names = [name[:i] + axis + name[i + 1 :] for axis in axes]
            if not all(other in values for other in names):
                continue
            three = [values[other] for other in names]
            if all(isinstance(one, np.ndarray) and one.ndim == 2 for one in three):
                three = [list(one) for one in three]
            if not all(isinstance(one, list) for one in three):
                continue
            if len({len(one) for one in three}) != 1:
                continue
            points = [_columns(parts) for parts in zip(*three, strict=True)]
            if all(one is not None for one in points):
                yield ",".join(names), _Frames([one for one in points if one is not None])


def _columns(parts: Sequence[Any]) -> Array | None:
    """Stack coordinates as columns; None if they are not vectors of equal length."""
    if not all(isinstance(part, np.ndarray) for part in parts):
        return None
    vectors = [np.asarray(part, dtype=np.float64).reshape(-1) for part in parts]
    return np.stack(vectors, axis=1) if len({one.size for one in vectors}) == 1 else None


def _scalars(entries: list[dict[str, Any]], field: str | None) -> list[float] | None:
    """Value of a scalar field of each entry; None if an entry lacks it."""
    if field is None:
        return None
    values = [np.asarray(entry[field]).reshape(-1) for entry in entries]
    if any(value.size != 1 or value.dtype.kind not in "fiu" for value in values):
        return None
    return [float(value[0]) for value in values]


def _numbers(time: list[float], who: list[float] | None) -> list[int]:
    """Whisker number of each entry, by its id or by its order within a frame."""
    if who is not None and len(set(zip(time, who, strict=True))) == len(time):
        return [int(one) for one in who]
    counts: dict[float, itertools.count[int]] = {}
    return [next(counts.setdefault(at, itertools.count())) for at in time]


def _tracks(path: Path, name: str, found: _Frames) -> RawTracks:
    points = []
    for one in found.points:  # zeros and NaN after the last point are padding
        one = np.asarray(one, dtype=np.float64)
        there = np.flatnonzero((np.nan_to_num(one) != 0.0).any(axis=1))
        points.append(one[: there[-1] + 1 if there.size else 0])
    if not any(len(one) for one in points):
        raise ValueError(f"{path}: {name} has no points in any frame")
    at = np.arange(len(points), dtype=np.float64) if found.frames is None else found.frames
    moments, row = np.unique(np.asarray(at, dtype=np.float64), return_inverse=True)
    who = np.zeros(len(points), dtype=int) if found.whiskers is None else found.whiskers
    whiskers, column = np.unique(who, return_inverse=True)
    width = points[0].shape[1]
    table = np.full((moments.size, whiskers.size, max(map(len, points)), width), np.nan)
    for i, one in enumerate(points):
        table[row[i], column[i], : len(one)] = one
    whole = bool((moments == np.rint(moments)).all())
    return RawTracks.of(
        table[:, :, None],
        None,
        software="MATLAB",
        whiskers=[str(one) for one in whiskers] if whiskers.size > 1 else ["whisker"],
        frames=moments.astype(np.int64) if whole else None,
        time=None if whole else moments,
        about={"variable": name},
    )


# Known types of elements in version 5: integers, floats, matrices, compressed data, text.
_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_ELEMENTS = {*range(1, 8), 9, 12, 13, _MATRIX, _COMPRESSED, 16, 17, 18}


def matlab_values(path: str | PathLike[str]) -> dict[str, Any]:
    """Read the variables of a MATLAB file."""
    path = check_readable(path)
    with path.open("rb") as file:
        head = file.read(_HEADER)
    if h5py.is_hdf5(path):
        with opened(path, "a MATLAB file") as file:
            found = {name: _of_hdf5(file, item) for name, item in file.items() if name[0] != "#"}
    elif head.startswith(b"MATLAB 7.3"):
        raise ValueError(f"{path} is cut short: it begins as a MATLAB file of version 7.3")
    else:
        found = _version_5(path)
    return {name: value for name, value in found.items() if value is not None}


def _version_5(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        file = path.read_bytes()
        _check_elements(file[_HEADER:], "<" if file[_HEADER - 2 : _HEADER] == b"IM" else ">")
        content = loadmat(path)
    except Exception as error:  # SciPy's errors for damaged files are of many kinds.
        raise ValueError(
            f"{path} cannot be read as a MATLAB file: it is of another format, cut short or "
            f"damaged ({error})"
        ) from error
    return {name: _of_scipy(value) for name, value in content.items() if name[:2] != "__"}


def _check_elements(content: bytes, order: str) -> None:
    """Raise ValueError for elements of unknown type, at which the library would crash."""
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        start = at + 8
        # All elements but compressed ones are padded to a multiple of eight bytes.
        after = start + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if kind >> 16:  # small element: its data, up to four bytes, are in the tag itself
            kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if kind not in _ELEMENTS:
            raise ValueError(f"it has an element of the unknown type {kind}")
        part = content[start : start + size]
        if kind in (_MATRIX, _COMPRESSED):
            _check_elements(zlib.decompress(part) if kind == _COMPRESSED else part, order)
        at = after


def _of_scipy(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return None
    if value.dtype.names is not None:
        entries = value.reshape(-1, order="F")
        return [{name: _of_scipy(one[name]) for name in value.dtype.names} for one in entries]
    if value.dtype == object:
        return [_of_scipy(one) for one in value.reshape(-1, order="F")]
    return value if value.dtype.kind in "fiub" else None


def _of_hdf5(file: h5py.File, item: Any) -> Any:
    kind = item.attrs.get("MATLAB_class", b"")
    if isinstance(item, h5py.Group):
        return _structs_of(file, item) if kind == b"struct" else None
    if kind == b"cell":
        return [_of_hdf5(file, file[reference]) for reference in item[:].reshape(-1)]
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros([int(size) for size in item[:]]) if item.ndim == 1 else np.zeros((0, 0))
    numbers = item.dtype.kind in "fiub" and kind not in (b"char", b"function_handle")
    # In MATLAB the first dimension varies fastest.
    return np.asarray(item[:]).T if numbers else None


def _structs_of(file: h5py.File, group: h5py.Group) -> list[dict[str, Any]]:
    """Entries of a struct array; the fields of a single entry are stored without references."""
    fields: Mapping[str, Any] = dict(group.items())
    many = bool(fields) and all(
        isinstance(field, h5py.Dataset)
        and field.dtype == h5py.ref_dtype
        and "MATLAB_class" not in field.attrs
        for field in fields.values()
    )
    if not many:
        return [{name: _of_hdf5(file, field) for name, field in fields.items()}]
    columns = {name: field[:].reshape(-1) for name, field in fields.items()}
    count = min(len(column) for column in columns.values())
    return [
        {name: _of_hdf5(file, file[column[i]]) for name, column in columns.items()}
        for i in range(count)
    ]
