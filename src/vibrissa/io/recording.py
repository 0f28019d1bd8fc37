"""Recordings as NetCDF-4 files with groups, without loss.

Every float is kept to the last bit; arrays are compressed. Any reader of NetCDF or HDF5 can open
the file; what the groups and variables mean is told by their own attributes and in
:mod:`vibrissa.recording.schema`. In the file several whiskers stand side by side in one group
(:mod:`vibrissa.io.whisker_stack`).
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import xarray as xr

from vibrissa.io.hdf5 import naming
from vibrissa.io.netcdf import COMPRESSED, kind_of, read_tree, write_netcdf
from vibrissa.io.whisker_stack import separate_whiskers, stacked_whiskers

KIND = "vibrissa recording"
"""What the attribute ``kind`` of a recording says."""

_SMALLEST = 1000


def save_recording(path: str | PathLike[str], recording: xr.DataTree) -> None:
    """Write a recording.

    Parameters
    ----------
    path : str or path
        Where to write, usually with the ending ``.nc``; an existing file is replaced once the new
        one is complete.
    recording : xarray.DataTree
        Its attribute ``kind`` says that it is one.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If the tree is no recording.
    """
    if recording.attrs.get("kind") != KIND:
        kind = recording.attrs.get("kind", "nothing")
        raise ValueError(f"this is no recording: its attribute kind says {kind!r}, not {KIND!r}")
    written = stacked_whiskers(recording)
    encoding = {
        group.path: {
            str(name): COMPRESSED
            for name, variable in group.to_dataset(inherit=False).data_vars.items()
            if variable.dtype.kind in "fiub" and variable.size >= _SMALLEST
        }
        for group in written.subtree
    }
    write_netcdf(path, written, encoding)


def load_recording(path: str | PathLike[str]) -> xr.DataTree:
    """Read a recording.

    Parameters
    ----------
    path : str or path
        NetCDF file that `save_recording` wrote.

    Returns
    -------
    xarray.DataTree
        All of it, in memory.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is empty, cut off, no NetCDF-4 file, or holds something else.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind != KIND:
        raise ValueError(f"{path} holds {kind or 'data of another kind'}, not a recording")
    tree = read_tree(path)
    with naming(path, "a recording"):
        return separate_whiskers(tree)
