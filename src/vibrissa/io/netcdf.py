"""Datasets and trees of datasets as NetCDF-4 files.

They are written in memory and then to the disk with ordinary calls, because HDF5 takes the whole
interpreter down when a disk that is full lets it not close a file. So writing takes as much memory
as the file is large, compressed, beside the data.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import xarray as xr

from vibrissa.io.hdf5 import opened
from vibrissa.io.paths import NETCDF, refuse_whisk
from vibrissa.io.replace import replacing

_SIGNATURE = b"\x89HDF\r\n\x1a\n"

COMPRESSED: Mapping[str, Any] = {"zlib": True, "complevel": 1, "shuffle": True}
"""How large variables are encoded, without loss."""


def is_netcdf(path: str | PathLike[str]) -> bool:
    """Tell whether a file is to be read as NetCDF-4.

    Parameters
    ----------
    path : str or path
        The file; it need not exist.

    Returns
    -------
    bool
        Whether it begins as HDF5, of which NetCDF-4 is a kind, or is named like one.
    """
    path = Path(path)
    if path.suffix.lower() in NETCDF:
        return True
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(_SIGNATURE)) == _SIGNATURE


def kind_of(path: str | PathLike[str]) -> str:
    """Read what a NetCDF-4 file says it holds.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    str
        Its attribute ``kind``, such as ``vibrissa recording``; empty if it has none.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is a folder, empty, cut off, or no NetCDF-4 file.
    """
    try:
        with opened(path, "NetCDF-4") as file:
            kind = file.attrs.get("kind", "")
    except ValueError:
        refuse_whisk(path)
        raise
    return kind.decode("utf-8", "replace") if isinstance(kind, bytes) else str(kind)


def read_dataset(
    path: str | PathLike[str], group: str | None = None, names: Sequence[str] | None = None
) -> xr.Dataset:
    """Read the dataset of one group."""
    with (
        opened(path, "NetCDF-4", soft_links=False),
        xr.open_dataset(path, engine="h5netcdf", group=group) as data,
    ):
        wanted = data if names is None else data[[name for name in names if name in data]]
        # How this file was encoded is nothing to the next one, and may be damaged.
        return wanted.load().drop_encoding()


def read_tree(path: str | PathLike[str]) -> xr.DataTree:
    """Read the datasets of all groups; see `read_dataset`."""
    with (
        opened(path, "NetCDF-4", soft_links=False),
        xr.open_datatree(path, engine="h5netcdf") as tree,
    ):
        loaded = {one.path: one.to_dataset(inherit=False).load() for one in tree.subtree}
        return xr.DataTree.from_dict({path: one.drop_encoding() for path, one in loaded.items()})


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
