"""Safe reading of HDF5, and datasets and trees of datasets as NetCDF-4 files.

Files may be damaged or malicious. Before reading, all objects of a file are checked: they must not
refer to other files (external links, external storage, virtual datasets), form cycles, claim more
data than a file of this size can contain, or have types that are constructed by name. Errors of the
libraries while reading are converted to one ValueError that names the file.

Files are first written in memory and then to disk with ordinary calls, because HDF5 aborts the
interpreter if it cannot close a file on a full disk. Writing therefore needs memory for the
compressed file in addition to the data.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from itertools import count
from mmap import ACCESS_READ, mmap
from os import PathLike
from pathlib import Path
from time import time_ns
from typing import Any, NamedTuple

import h5py
import numpy as np
from h5py import h5d, h5l, h5o, h5r, h5t

from vibrissa.deferred import xr
from vibrissa.io.paths import NETCDF, check_readable, refuse_whisk, replacing
from vibrissa.numerics import AnyArray

# Largest ratio of compression: deflate, the densest supported filter, reaches 1032.
_DENSEST = 1100
ALWAYS_ALLOWED = 1 << 28
"""Size of the data that a file of any size may claim to contain, bytes."""

_TICK = 100_000_000  # upper bound of the resolution of file times, ns
_HEAP = b"GCOL\1\0\0\0"

# Name of a dimension that has no coordinates.
_NO_DATA = b"This is a netCDF dimension but not a netCDF variable"
_FORMAT = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "_nc3_strict"}
_FORMAT |= {"_NCProperties", "_Netcdf4Coordinates", "_Netcdf4Dimid"}
"""Attributes by which NetCDF-4 is kept in HDF5."""


@contextmanager
def opened(path: str | PathLike[str], what: str, *, soft_links: bool = True) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading after checking that it is harmless."""
    path = check_readable(path)
    refuse_whisk(path)
    about, now = path.stat(), time_ns()
    changed = about.st_ctime_ns
    # A file changed again within the resolution of its times may have the same time.
    version = about.st_dev, about.st_ino, changed, now if abs(now - changed) < _TICK else 0
    with naming(path, what):
        faults = _check(path.absolute(), about.st_size, version)
        if faults and not soft_links:
            raise ValueError(faults[0])
        with h5py.File(path, "r") as file:
            yield file


@contextmanager
def naming(path: Path, what: str) -> Iterator[None]:
    """Convert errors raised while reading a file to a ValueError that names it."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise ValueError(
            f"{path} cannot be read as {what}: it is of another format, cut off or damaged "
            f"({_line(error)})"
        ) from error
    except ValueError as error:
        # Our own errors already name the file.
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {_line(error)}") from error
    except KeyError as error:
        raise ValueError(
            f"{path} is incomplete or damaged: something that it refers to is missing, for example "
            f"a dimension such as `time` that has been deleted ({error})"
        ) from error
    except Exception as error:  # The libraries' errors for damaged files are not documented.
        raise ValueError(f"{path} is not {what} in a known form, or damaged: {error!r}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or repr(error)


def _check_heaps(path: Path) -> None:
    """Raise ValueError for heaps with an entry of size zero, on which the library would hang."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        start = content.find(_HEAP)
        while start >= 0:
            (size,) = struct.unpack_from("<Q", content, start + 8)
            end = min(start + size, len(content))
            entry = start + 16
            while entry + 16 <= end:
                number, length = struct.unpack_from("<H6xQ", content, entry)
                if number == 0 and length == 0:
                    raise ValueError("a heap of text is damaged")
                # The size of the free space includes its header.
                entry += length if number == 0 else 16 + -(-length // 8) * 8
            start = content.find(_HEAP, start + 4)


def _items(file: h5py.File, faults: list[str]) -> Iterator[tuple[str, h5py.HLObject]]:
    """Yield all objects of a file once; soft links are faults, external links and cycles errors."""
    groups: list[tuple[str, h5py.Group]] = [("", file)]
    while groups:
        above, group = groups.pop()
        if h5o.get_info(group.id).rc > 1:
            raise ValueError(f"the group {above or '/'} is in several places, which is not read")
        yield above or "/", group
        for key in group:
            name = f"{above}/{key}"
            link = group.id.links.get_info(key.encode("utf-8", "surrogateescape")).type
            if link == h5l.TYPE_SOFT:
                faults.append(f"{name} is a soft link, which is not followed")
                continue
            if link != h5l.TYPE_HARD:
                raise ValueError(f"{name} is a link out of the file, which is not followed")
            item = group[key]
            if isinstance(item, h5py.Group):
                groups.append((name, item))
            else:
                yield name, item


@lru_cache(maxsize=64)
def _check(path: Path, size: int, version: tuple[int, ...]) -> list[str]:
    """Raise ValueError for harmful files; list what NetCDF-4 files do not have.

    ``version`` marks changes of the file, as results are cached.
    """
    _check_heaps(path)
    with h5py.File(path, "r") as file:
        return _check_items(file, size)


def _check_items(file: h5py.File, size: int) -> list[str]:
    """Raise ValueError for external data, or more data than ``size`` bytes can contain.

    Return soft links, and data other than numbers and text.
    """
    claimed, faults = 0, list[str]()
    for name, item in _items(file, faults):
        for key in item.attrs:
            attribute = item.attrs.get_id(key)
            _check_type(f"the attribute {key} of {name}", attribute.get_type())
            claimed += _bytes(attribute.shape, attribute.get_type())
            # The library would read beyond the end of a list of the wrong length.
            if key == "DIMENSION_LIST" and attribute.shape != (item.ndim,):
                raise ValueError(f"{name} has {item.ndim} dimensions, and scales of others")
        if isinstance(item, h5py.Dataset):
            claimed += _checked_size(name, item)
            text = h5py.check_string_dtype(item.dtype) is not None
            if item.shape is None or not (item.dtype.kind in "biufSU" or text):
                faults.append(f"{name} is neither numbers nor text")
        if claimed > max(ALWAYS_ALLOWED, _DENSEST * size):
            raise ValueError(
                f"{name} and what comes before it claim to hold {claimed / 1e9:.3g} GB, more than "
                f"a file of {size / 1e3:.3g} kB can: it is damaged, or made to fill the memory"
            )
    return faults


def _checked_size(name: str, data: h5py.Dataset) -> int:
    """Size of a dataset in memory, bytes; raise ValueError if its data are external."""
    _check_type(name, data.id.get_type())
    layout = data.id.get_create_plist()
    if layout.get_external_count() or layout.get_layout() == h5d.VIRTUAL:
        raise ValueError(f"the data of {name} are kept in other files, which are not read")
    chunk = layout.get_chunk() if layout.get_layout() == h5d.CHUNKED else ()
    return max(_bytes(shape, data.id.get_type()) for shape in (data.id.shape, chunk))


def _bytes(shape: tuple[int, ...] | None, kind: h5t.TypeID) -> int:
    return math.prod(shape or ()) * int(kind.get_size())


def _as_text(value: str | bytes) -> str:
    """Decode text strictly: h5py accepts bytes that are not UTF-8 and cannot be printed."""
    raw = value if isinstance(value, bytes) else value.encode("utf-8", "surrogateescape")
    return raw.decode("utf-8")


def _check_type(name: str, kind: h5t.TypeID) -> None:
    """Raise ValueError for opaque bytes, for which a file may name any NumPy type."""
    if kind.get_class() == h5t.OPAQUE or kind.detect_class(h5t.OPAQUE):
        raise ValueError(f"{name} holds opaque bytes, which are not read")


_SIGNATURE = b"\x89HDF\r\n\x1a\n"

# Encoding of large variables, without loss.
COMPRESSED: Mapping[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


def is_netcdf(path: str | PathLike[str]) -> bool:
    """Whether a file is NetCDF-4, by its ending or its first bytes."""
    path = Path(path)
    if path.suffix.lower() in NETCDF:
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def kind_of(path: str | PathLike[str]) -> str:
    """Attribute ``kind`` of a NetCDF-4 file."""
    with opened(path, "NetCDF-4") as file:
        return _kind(file)


def _kind(file: h5py.File) -> str:
    kind = file.attrs.get("kind", "")
    return _as_text(kind) if isinstance(kind, str | bytes) else str(kind)


def read_dataset(
    path: str | PathLike[str], group: str | None = None, names: Sequence[str] | None = None
) -> xr.Dataset:
    """Read the dataset of one group, or only its variables ``names`` and their coordinates."""
    return read_parts(path, {group or "/": names})[group or "/"]


def read_parts(
    path: str | PathLike[str], parts: Mapping[str, Sequence[str] | None]
) -> dict[str, xr.Dataset]:
    """Read groups, each with all variables (None) or only some and their coordinates."""
    with opened(path, "NetCDF-4", soft_links=False) as file:
        known = _names_by_address(file)
        found = {group: _dataset(file[group], known, names) for group, names in parts.items()}
    return {
        group: data if parts[group] is None else data[[n for n in parts[group] or () if n in data]]
        for group, data in found.items()
    }


class Group(NamedTuple):
    """Arrays and attributes of a group, as stored."""

    variables: dict[str, AnyArray]
    attrs: dict[str, Any]


def read_groups(
    path: str | PathLike[str], names: Sequence[str], empty: Collection[str] = ()
) -> dict[str, Group]:
    """Read groups without xarray, for speed; of groups in ``empty`` only the attributes."""
    with opened(path, "NetCDF-4", soft_links=False) as file:
        return {name: _group(file[name], name not in empty) for name in names if name in file}


def _group(group: h5py.Group, full: bool) -> Group:
    known = dict(group.items()) if full else {}
    data = {name: item for name, item in known.items() if isinstance(item, h5py.Dataset)}
    numbers = {name: item[()] for name, item in data.items() if item.dtype.kind in "fiu"}
    return Group(numbers, _attributes(group))


def read_tree(path: str | PathLike[str], kind: str, what: str) -> xr.DataTree:
    """Read the datasets of all groups of a file of one kind.

    Data are read by h5py and decoded by xarray, whose own backend takes four times as long because
    it also queries the encoding of each variable.
    """
    with opened(path, "NetCDF-4", soft_links=False) as file:
        if (found := _kind(file)) != kind:
            raise ValueError(f"{path} contains {found or 'data of another kind'}, not {what}")
        known = _names_by_address(file)
        return xr.DataTree.from_dict(
            {str(one.name): _dataset(one, known) for one in all_groups(file)}
        )


def all_groups(group: h5py.Group) -> Iterator[h5py.Group]:
    """Yield the group itself and all groups below it, in the order of the file."""
    yield group
    for item in group.values():
        if isinstance(item, h5py.Group):
            yield from all_groups(item)


def _names_by_address(file: h5py.File) -> dict[int, str]:
    """Names of all variables by address; the library is slow to find the name for a reference."""
    each = (item for group in all_groups(file) for item in group.items())
    return {_address(item.id): name for name, item in each if isinstance(item, h5py.Dataset)}


def _address(item: h5py.h5g.GroupID | h5d.DatasetID) -> int:
    return int(h5o.get_info(item).addr)


def _dataset(
    group: h5py.Group, known: Mapping[int, str], names: Sequence[str] | None = None
) -> xr.Dataset:
    """Read a group's attributes, and all variables or only ``names`` and their coordinates."""
    found = {
        name: (_dims(name, item, known), item, _attributes(item))
        for name, item in group.items()
        if isinstance(item, h5py.Dataset) and not item.attrs.get("NAME", b"").startswith(_NO_DATA)
    }
    about = _attributes(group)
    if names is not None:
        wanted = {name for name in names if name in found}
        for dims, _, attrs in [found[name] for name in wanted]:
            wanted |= {*dims, *str(attrs.get("coordinates", "")).split()}
        wanted |= {*str(about.get("coordinates", "")).split()}
        found = {name: variable for name, variable in found.items() if name in wanted}
    read = {name: (dims, _values(item), attrs) for name, (dims, item, attrs) in found.items()}
    return xr.decode_cf(xr.Dataset(read, attrs=about)).load().drop_encoding()


def _dims(name: str, data: h5py.Dataset, known: Mapping[int, str]) -> list[str]:
    """Names of the dimensions of a variable; a dimension's own variable has its own name."""
    scales = data.attrs.get("DIMENSION_LIST", ())
    if len(scales) < data.ndim:
        if data.ndim > 1 or "CLASS" not in data.attrs:
            raise ValueError(f"{name} has dimensions without names")
        return [name]
    return [known[_address(h5r.dereference(axis[0], data.id))] for axis in scales]


def _values(data: h5py.Dataset) -> AnyArray:
    text = h5py.check_string_dtype(data.dtype)
    return np.asarray(data.asstr()[()], str) if text and text.length is None else data[()]


def _attributes(item: h5py.HLObject) -> dict[str, Any]:
    """Attributes other than those of the format, with text decoded."""
    return {name: _attribute(item.attrs[name]) for name in item.attrs if name not in _FORMAT}


def _attribute(value: Any) -> Any:
    """Convert arrays of one element to scalars, and arrays of text to lists."""
    if isinstance(value, h5py.Empty):
        return "" if h5py.check_string_dtype(value.dtype) else np.array([], value.dtype)
    array = np.atleast_1d(value)
    texts = [_as_text(each) for each in array.flat] if array.dtype.kind in "OSU" else array
    return texts[0] if len(texts) == 1 else texts


def write_netcdf(
    path: str | PathLike[str],
    data: xr.Dataset | xr.DataTree,
    encoding: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write a dataset, or a tree with a group for each dataset."""
    with replacing(path) as part:
        part.write_bytes(netcdf_image(data, encoding))


def netcdf_image(
    data: xr.Dataset | xr.DataTree, encoding: Mapping[str, Mapping[str, Any]] | None = None
) -> memoryview:
    """Bytes of the file that `write_netcdf` writes.

    Data are encoded by xarray and written by h5py: xarray's own backend takes five times as long
    because it looks up each variable and its dimensions many times.
    """
    tree = xr.DataTree(data) if isinstance(data, xr.Dataset) else data
    image = io.BytesIO()
    # The NetCDF library needs the order of creation.
    with h5py.File(image, "w", track_order=True) as file:
        about = f"version=2,h5py={h5py.__version__},hdf5={h5py.version.hdf5_version}"
        file.attrs["_NCProperties"] = np.bytes_(about)
        scales: dict[str, dict[str, h5py.Dataset]] = {}
        numbers = count()
        for node in tree.subtree:
            group = file if node is tree else file.create_group(node.path, track_order=True)
            # An inherited coordinate is written only in the group that defines it.
            dataset = node.to_dataset(inherit=node is tree).drop_encoding()
            above = {} if node is tree or node.parent is None else scales[node.parent.path]
            compressed = (encoding or {}).get(node.path, {})
            scales[node.path] = _write(group, dataset, compressed, above, numbers)
    return image.getbuffer()


def _write(
    group: h5py.Group,
    dataset: xr.Dataset,
    encoding: Mapping[str, Mapping[str, Any]],
    above: Mapping[str, h5py.Dataset],
    numbers: Iterator[int],
) -> dict[str, h5py.Dataset]:
    """Write a dataset; return the scales of its dimensions and of those ``above``."""
    variables, attrs = xr.conventions.cf_encoder(
        *xr.conventions.encode_dataset_coordinates(dataset)
    )
    _set_attributes(group, attrs)
    new = {d: n for d, n in dataset.sizes.items() if d in variables or d not in above}
    written = {
        dim: group.create_dataset(dim, (size,), ">f4", maxshape=(size or None,), track_order=True)
        for dim, size in new.items()
        if dim not in variables
    }
    for name, variable in variables.items():
        written[name] = _write_variable(group, name, variable, encoding.get(name, {}))
    for dim, size in new.items():
        label = str(dim).encode() if dim in variables else _NO_DATA + b".%10d" % size
        written[dim].make_scale(label)
        written[dim].attrs["_Netcdf4Dimid"] = np.int32(next(numbers))
    scales = {**above, **{str(dim): written[dim] for dim in new}}
    for name in variables.keys() - new.keys():
        used = [scales[dim] for dim in variables[name].dims]
        for axis, scale in zip(written[name].dims, used, strict=True):
            axis.attach_scale(scale)
        if used:
            identities = [scale.attrs["_Netcdf4Dimid"] for scale in used]
            written[name].attrs["_Netcdf4Coordinates"] = np.array(identities, np.int32)
    return scales


def _write_variable(
    group: h5py.Group, name: str, variable: xr.Variable, encoding: Mapping[str, Any]
) -> h5py.Dataset:
    text = variable.dtype.kind in "OU"
    data = group.create_dataset(
        name,
        data=variable.values.astype(object) if text else variable.values,
        dtype=h5py.string_dtype() if text else None,
        # A dimension of length zero is an unlimited one in NetCDF.
        maxshape=tuple(size or None for size in variable.shape),
        fillvalue=variable.attrs.get("_FillValue"),
        track_order=True,
        **(encoding if variable.ndim else {}),
    )
    _set_attributes(data, variable.attrs)
    return data


def _set_attributes(item: h5py.HLObject, attrs: Mapping[str, Any]) -> None:
    """Set attributes; NetCDF has no scalar numbers but arrays of one."""
    for name, value in attrs.items():
        item.attrs[name] = value if isinstance(value, str | list) else np.atleast_1d(value)
