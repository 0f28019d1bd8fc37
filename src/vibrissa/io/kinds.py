"""What a file is, told by its content."""

from __future__ import annotations

import re
from enum import StrEnum
from os import PathLike
from pathlib import Path

import h5py

from vibrissa.io.columns import signal_column
from vibrissa.io.corrections import COLUMNS as CORRECTIONS
from vibrissa.io.hdf5 import opened
from vibrissa.io.head import ANGLES, MATRIX, QUATERNION
from vibrissa.io.netcdf import kind_of
from vibrissa.io.pandas_table import pandas_tables
from vibrissa.io.paths import check_readable
from vibrissa.io.table import read_text, table_rows
from vibrissa.io.whisk import MEASUREMENTS, WHISKERS


class Kind(StrEnum):
    """Kinds of files, in the words that are shown."""

    WHISKERS = "traces of whisk (.whiskers)"
    MEASUREMENTS = "measurements of whisk (.measurements)"
    DEEPLABCUT = "table of DeepLabCut or LightningPose"
    SLEAP_ANALYSIS = "analysis file of SLEAP"
    SLEAP_LABELS = "labels of SLEAP (.slp)"
    ANIPOSE = "table of Anipose"
    MOVEMENT = "poses of movement"
    NWB = "NWB file"
    MATLAB = "MATLAB file"
    TRACKS = "vibrissa tracks"
    TRACKS_TABLE = "table of points"
    RECORDING = "vibrissa recording"
    ARRAY = "vibrissa whisker array"
    NETCDF = "NetCDF file"
    SIGNALS = "table of signals"
    CONTACTS = "table of contacts"
    HEAD = "table of the head's pose"
    CORRECTIONS = "table of corrections"
    ARRAY_TABLE = "table of whiskers"
    CENTERLINE = "centreline of a whisker"
    CALIBRATION = "calibration of cameras"
    VIDEO = "video"
    UNKNOWN = "unknown"


def recognise(path: str | PathLike[str]) -> Kind:
    """Tell what kind a file is, by its content rather than its name.

    Parameters
    ----------
    path : str or path
        The file.

    Returns
    -------
    Kind
        As far as its beginning tells; ``UNKNOWN`` if nothing fits.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is a folder, empty, or HDF5 that is cut short.
    """
    path = check_readable(path)
    with path.open("rb") as file:
        head = file.read(128)
    for magic, kind in ((WHISKERS[:10], Kind.WHISKERS), (MEASUREMENTS[:6], Kind.MEASUREMENTS)):
        if head.startswith(magic):
            return kind
    if head.startswith(b"MATLAB"):
        return Kind.MATLAB
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        return _of_hdf5(path)
    # Matroska, MP4 and QuickTime, AVI.
    if head.startswith(b"\x1aE\xdf\xa3") or head[4:8] == b"ftyp" or head[8:12] == b"AVI ":
        return Kind.VIDEO
    if b"\0" in head:
        return Kind.UNKNOWN
    return _of_text(path)


def _of_hdf5(path: Path) -> Kind:
    with opened(path, "a file of a known kind") as file:
        names = set(file)
        if "nwb_version" in file.attrs:
            return Kind.NWB
        if {"tracks", "node_names"} <= names:
            return Kind.SLEAP_ANALYSIS
        if {"metadata", "frames", "instances"} <= names:
            return Kind.SLEAP_LABELS
        if next(pandas_tables(file), None) is not None:
            return Kind.DEEPLABCUT
        if "position" in names and names & {"keypoints", "keypoint"}:
            return Kind.MOVEMENT
        if any("MATLAB_class" in item.attrs for item in file.values()):
            return Kind.MATLAB
        netcdf = "_NCProperties" in file.attrs or any(
            "DIMENSION_LIST" in item.attrs
            for item in file.values()
            if isinstance(item, h5py.Dataset)
        )
    known = {str(kind): kind for kind in (Kind.TRACKS, Kind.RECORDING, Kind.ARRAY)}
    return known.get(kind_of(path), Kind.NETCDF) if netcdf else Kind.UNKNOWN


def _of_text(path: Path) -> Kind:
    try:
        first = next(table_rows(read_text(path)), None)
    except ValueError:
        return Kind.UNKNOWN
    if first is None:
        return Kind.UNKNOWN
    names = [name.lower() for name in first[1]]
    if names[0].startswith("["):
        return Kind.CALIBRATION
    plain = {re.split(r"[ _/(\[]", name)[0] for name in names}
    if names[0] in ("scorer", "individuals", "bodyparts"):
        return Kind.DEEPLABCUT
    if any(name.endswith("_ncams") for name in names):
        return Kind.ANIPOSE
    if {"Fx", "Mx"} <= {signal_column(name)[0] for name in first[1]}:
        return Kind.SIGNALS
    if {"theta", "phi", "status"} <= set(names):
        return Kind.CONTACTS
    if tuple(names) == CORRECTIONS:
        return Kind.CORRECTIONS
    moments = {"frame", "time"} & plain
    if moments and any(set(way) <= set(names) for way in (QUATERNION, MATRIX, ANGLES)):
        return Kind.HEAD
    if moments and ({"x", "y"} <= plain or {"column", "row"} <= plain):
        return Kind.TRACKS_TABLE
    if {"name", "coefficient", "length"} <= plain:
        return Kind.ARRAY_TABLE
    if {"x", "y"} <= plain:
        return Kind.CENTERLINE
    return Kind.UNKNOWN
