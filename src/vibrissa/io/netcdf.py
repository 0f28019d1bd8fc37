"""Files in HDF5, opened as what somebody else may have damaged or made to do harm.

Before anything is read, everything in a file is looked at: nothing may lead out of it (external
links, external storage, virtual datasets), go round in circles, or claim to be larger than a file
of its size can hold, and no type may be built by name. What is read after that can still be
damaged; whatever the libraries raise then becomes one error that names the file.

Datasets and trees of datasets as NetCDF-4 files.

They are written in memory and then to the disk with ordinary calls, because HDF5 takes the whole
interpreter down when a disk that is full lets it not close a file. So writing takes as much memory
as the compressed file, in addition to the data.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
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

# Deflate, the densest of the filters that are read, makes at most 1032 bytes of one.
_DENSEST = 1100
ALWAYS_ALLOWED = 1 << 28
"""Bytes that any file may claim to hold."""

_TICK = 100_000_000  # time by which clocks of file systems may be behind, ns, with room
_HEAP = b"GCOL\1\0\0\0"

# Name of a dimension that has no coordinates.
_NO_DATA = b"This is a netCDF dimension but not a netCDF variable"
_FORMAT = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "_nc3_strict"}
_FORMAT |= {"_NCProperties", "_Netcdf4Coordinates", "_Netcdf4Dimid"}
"""Attributes by which NetCDF-4 is kept in HDF5."""


@contextmanager
def opened(path: str | PathLike[str], what: str, *, soft_links: bool = True) -> Iterator[h5py.File]:
    """Open a file in HDF5 for reading, once it has been found harmless."""
    path = check_readable(path)
    refuse_whisk(path)
    about, now = path.stat(), time_ns()
    changed = about.st_ctime_ns
    # What is changed again within a tick of the clock has the same time.
    version = about.st_dev, about.st_ino, changed, now if abs(now - changed) < _TICK else 0
    with naming(path, what):
        _check(path.absolute(), about.st_size, soft_links, version)
        with h5py.File(path, "r") as file:
            yield file


@contextmanager
def naming(path: Path, what: str) -> Iterator[None]:
    """Turn whatever is raised while a file is read into one error that names it."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise ValueError(
            f"{path} cannot be read as {what}: it is of another format, cut off or damaged "
            f"({_line(error)})"
        ) from error
    except ValueError as error:
        # Those of our own name the file already.
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {_line(error)}") from error
    except Exception as error:  # What libraries raise for a damaged file is not documented.
        raise ValueError(f"{path} is not {what} as it is known, or damaged: {error!r}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or repr(error)


def _check_heaps(path: Path) -> None:
    """Refuse heaps with an entry of no size, through which the library would go for ever."""
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
                # That of free space counts its own head.
                entry += length if number == 0 else 16 + -(-length // 8) * 8
            start = content.find(_HEAP, start + 4)


def _items(file: h5py.File, soft_links: bool) -> Iterator[tuple[str, h5py.HLObject]]:
    """All that a file holds, each once; raise at a link that leads out of it or in a circle."""
    groups: list[tuple[str, h5py.Group]] = [("", file)]
    while groups:
        above, group = groups.pop()
        if h5o.get_info(group.id).rc > 1:
            raise ValueError(f"the group {above or '/'} is in several places, which is not read")
        yield above or "/", group
        for key in group:
            name = f"{above}/{key}"
            link = group.id.links.get_info(key.encode("utf-8", "surrogateescape")).type
            if link == h5l.TYPE_SOFT and soft_links:
                continue
            if link != h5l.TYPE_HARD:
                what = "soft link" if link == h5l.TYPE_SOFT else "link out of the file"
                raise ValueError(f"{name} is a {what}, which is not followed")
            item = group[key]
            if isinstance(item, h5py.Group):
                groups.append((name, item))
            else:
                yield name, item


@lru_cache(maxsize=64)
def _check(path: Path, size: int, soft_links: bool, version: tuple[int, ...]) -> None:
    """Refuse what may do harm; a file that is as it was, which `version` shows, is checked once."""
    _check_heaps(path)
    with h5py.File(path, "r") as file:
        _check_items(file, size, soft_links)


def _check_items(file: h5py.File, size: int, soft_links: bool) -> None:
    """Refuse data kept elsewhere, and more of them than a file of `size` bytes holds."""
    claimed = 0
    for name, item in _items(file, soft_links):
        for key in item.attrs:
            attribute = item.attrs.get_id(key)
            _check_type(f"the attribute {key} of {name}", attribute.get_type())
            claimed += _bytes(attribute.shape, attribute.get_type())
            # The library would read past the end of a list that is too long or too short.
            if key == "DIMENSION_LIST" and attribute.shape != (item.ndim,):
                raise ValueError(f"{name} has {item.ndim} dimensions, and scales of others")
        if isinstance(item, h5py.Dataset):
            claimed += _checked_size(name, item)
            if not (soft_links or _is_plain(item)):
                raise ValueError(f"{name} is neither numbers nor text")
        if claimed > max(ALWAYS_ALLOWED, _DENSEST * size):
            raise ValueError(
                f"{name} and what comes before it claim to hold {claimed / 1e9:.3g} GB, more than "
                f"a file of {size / 1e3:.3g} kB can: it is damaged, or made to fill the memory"
            )


def _checked_size(name: str, data: h5py.Dataset) -> int:
    """Bytes that reading a dataset takes; raise if they are kept elsewhere."""
    _check_type(name, data.id.get_type())
    layout = data.id.get_create_plist()
    if layout.get_external_count() or layout.get_layout() == h5d.VIRTUAL:
        raise ValueError(f"the data of {name} are kept in other files, which are not read")
    chunk = layout.get_chunk() if layout.get_layout() == h5d.CHUNKED else ()
    return max(_bytes(shape, data.id.get_type()) for shape in (data.id.shape, chunk))


def _bytes(shape: tuple[int, ...] | None, kind: h5t.TypeID) -> int:
    return math.prod(shape or ()) * int(kind.get_size())


def _is_plain(data: h5py.Dataset) -> bool:
    """Whether a variable of NetCDF-4 holds real numbers or text, as all that are known do."""
    plain = data.dtype.kind in "biufSU" or h5py.check_string_dtype(data.dtype) is not None
    return plain and data.shape is not None


def _as_text(value: str | bytes) -> str:
    """Decode text strictly: h5py lets bytes through that are not UTF-8 and cannot be printed."""
    raw = value if isinstance(value, bytes) else value.encode("utf-8", "surrogateescape")
    return raw.decode("utf-8")


def _check_type(name: str, kind: h5t.TypeID) -> None:
    """Refuse bytes without a meaning, for which a file may name any type of NumPy's."""
    if kind.get_class() == h5t.OPAQUE or kind.detect_class(h5t.OPAQUE):
        raise ValueError(f"{name} holds opaque bytes, which are not read")


_SIGNATURE = b"\x89HDF\r\n\x1a\n"

# Encoding of large variables, without loss.
COMPRESSED: Mapping[str, Any] = {"zlib": True, "complevel": 1, "shuffle": True}


def is_netcdf(path: str | PathLike[str]) -> bool:
    """Tell whether a file is to be read as NetCDF-4."""
    path = Path(path)
    if path.suffix.lower() in NETCDF:
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def kind_of(path: str | PathLike[str]) -> str:
    """Read the kind of content that a NetCDF-4 file states."""
    with opened(path, "NetCDF-4") as file:
        return _kind(file)


def _kind(file: h5py.File) -> str:
    kind = file.attrs.get("kind", "")
    return _as_text(kind) if isinstance(kind, str | bytes) else str(kind)


def read_dataset(
    path: str | PathLike[str], group: str | None = None, names: Sequence[str] | None = None
) -> xr.Dataset:
    """Read the dataset of one group; of its variables those by name and their coordinates."""
    with opened(path, "NetCDF-4", soft_links=False) as file:
        data = _dataset(file[group or "/"], _names_by_address(file), names)
    return data if names is None else data[[name for name in names if name in data]]


class Group(NamedTuple):
    """Numbers and attributes of a group, as they are in a file."""

    variables: dict[str, AnyArray]
    attrs: dict[str, Any]


def read_groups(
    path: str | PathLike[str], names: Sequence[str], empty: Collection[str] = ()
) -> dict[str, Group]:
    """Read groups, those that are ``empty`` without variables, without xarray, for the time."""
    with opened(path, "NetCDF-4", soft_links=False) as file:
        return {name: _group(file[name], name not in empty) for name in names if name in file}


def _group(group: h5py.Group, full: bool) -> Group:
    known = dict(group.items()) if full else {}
    data = {name: item for name, item in known.items() if isinstance(item, h5py.Dataset)}
    numbers = {name: item[()] for name, item in data.items() if item.dtype.kind in "fiu"}
    return Group(numbers, {name: _plain(value) for name, value in group.attrs.items()})


def _plain(value: Any) -> Any:
    """Turn an attribute into text or, if it is an array of one, a number."""
    if isinstance(value, str | bytes):
        return _as_text(value)
    return value.item() if getattr(value, "size", 0) == 1 else value


def read_tree(path: str | PathLike[str], kind: str, what: str) -> xr.DataTree:
    """Read the datasets of all groups of a file of one kind.

    xarray decodes what h5py reads: its own backend asks for the encoding of each variable as well,
    which takes four times as long.
    """
    with opened(path, "NetCDF-4", soft_links=False) as file:
        if (found := _kind(file)) != kind:
            raise ValueError(f"{path} holds {found or 'data of another kind'}, not {what}")
        known = _names_by_address(file)
        return xr.DataTree.from_dict({str(one.name): _dataset(one, known) for one in _groups(file)})


def _groups(group: h5py.Group) -> Iterator[h5py.Group]:
    """The group itself and all below it, in the order of the file."""
    yield group
    for item in group.values():
        if isinstance(item, h5py.Group):
            yield from _groups(item)


def _names_by_address(file: h5py.File) -> dict[int, str]:
    """Names of all variables: the library looks long for that of what a reference leads to."""
    each = (item for group in _groups(file) for item in group.items())
    return {_address(item.id): name for name, item in each if isinstance(item, h5py.Dataset)}


def _address(item: h5py.h5g.GroupID | h5d.DatasetID) -> int:
    return int(h5o.get_info(item).addr)


def _dataset(
    group: h5py.Group, known: Mapping[int, str], names: Sequence[str] | None = None
) -> xr.Dataset:
    """Read the variables and attributes of a group, or those by name and their coordinates."""
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
    """Names of the dimensions of a variable; of one that is a dimension itself, its own."""
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
    """Attributes but those of the format, with text as such."""
    return {name: _attribute(item.attrs[name]) for name in item.attrs if name not in _FORMAT}


def _attribute(value: Any) -> Any:
    """Give what is not an array of several as itself, and text as a list."""
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
    """Give the bytes of the file that `write_netcdf` writes."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    tree = xr.DataTree(data) if isinstance(data, xr.Dataset) else data
    image = io.BytesIO()
    with h5netcdf.File(image, "w") as file:
        for node in tree.subtree:
            store = H5NetCDFStore(file, group=node.path, mode="a")
            # A coordinate that a group inherits is written only where it is.
            dataset = node.to_dataset(inherit=node is tree)
            dataset.dump_to_store(store, encoding=(encoding or {}).get(node.path))
    return image.getbuffer()
