"""What MATLAB files hold, of version 5 and 7.3, as the same plain values.

Numbers are arrays with MATLAB's dimensions, cell arrays are lists, struct arrays lists of dicts;
what is anything else (text, functions, objects of classes) is left out.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vibrissa.io.hdf5 import opened
from vibrissa.io.paths import check_readable

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_ELEMENTS = {*range(1, 8), 9, 12, 13, _MATRIX, _COMPRESSED, 16, 17, 18}
"""Kinds of elements of version 5: integers, floats, matrices, what is compressed, text."""


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
    """Refuse elements of kinds that there are none of, at which the library crashes."""
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        start = at + 8
        # All but what is compressed is filled up to a multiple of eight bytes.
        after = start + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if kind >> 16:  # of up to four bytes, which stand in the tag itself
            kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if kind not in _ELEMENTS:
            raise ValueError(f"it has an element of the kind {kind}, which there is not")
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
        return _struct(file, item) if kind == b"struct" else None
    if kind == b"cell":
        return [_of_hdf5(file, file[reference]) for reference in item[:].reshape(-1)]
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros([int(size) for size in item[:]]) if item.ndim == 1 else np.zeros((0, 0))
    numbers = item.dtype.kind in "fiub" and kind not in (b"char", b"function_handle")
    # MATLAB's first dimension runs fastest.
    return np.asarray(item[:]).T if numbers else None


def _struct(file: h5py.File, group: h5py.Group) -> list[dict[str, Any]]:
    """Entries of a struct array; of one entry the fields are stored as they are."""
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
