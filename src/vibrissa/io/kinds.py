"""Recognition of file formats by content, and reading of tracks in any known format."""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Unpack

import h5py

from vibrissa.deferred import xr
from vibrissa.io.annotations import ANGLES, CORRECTION_COLUMNS, MATRIX, QUATERNION
from vibrissa.io.keypoints import (
    pandas_tables,
    read_anipose,
    read_deeplabcut,
    read_movement,
    read_sleap_analysis,
    read_sleap_labels,
)
from vibrissa.io.matlab import read_matlab
from vibrissa.io.netcdf import kind_of, opened
from vibrissa.io.nwb import read_nwb
from vibrissa.io.paths import check_readable, without_part
from vibrissa.io.table import read_text, signal_column, table_rows
from vibrissa.io.time_tables import CONTOUR, MATLAB_PREDICTORS
from vibrissa.io.tracks import (
    Labels,
    RawTracks,
    labelled,
    load_own_tracks,
    read_tracks_table,
    timed,
)
from vibrissa.io.whisk import MEASUREMENTS, WHISKERS, read_measurements, read_whiskers


class Kind(StrEnum):
    """Kinds of files; values are descriptions for messages."""

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
    CONTOUR = "table of contour points, as vibrissa reconstruct writes it"
    PREDICTORS = "table of predictors, as vibrissa export writes it"
    HEAD = "table of the head's pose"
    CORRECTIONS = "table of corrections"
    ARRAY_TABLE = "table of whiskers"
    CENTERLINE = "centreline of a whisker"
    CALIBRATION = "calibration of cameras"
    VIDEO = "video"
    UNKNOWN = "unknown"


def recognise(path: str | PathLike[str]) -> Kind:
    """Recognise the kind of a file by its content rather than its name.

    Parameters
    ----------
    path : str or path
        Path of the file.

    Returns
    -------
    Kind
        Kind of the file; ``UNKNOWN`` if it is not recognised.

    Raises
    ------
    FileNotFoundError
        If the file does not exist.
    ValueError
        If it is a folder, empty, or truncated HDF5.
    """
    path, _ = without_part(check_readable(path))
    with path.open("rb") as file:
        head = file.read(128)
    for magic, kind in ((WHISKERS[:10], Kind.WHISKERS), (MEASUREMENTS[:6], Kind.MEASUREMENTS)):
        if head.startswith(magic):
            return kind
    if head.startswith(b"MATLAB"):
        return Kind.PREDICTORS if head.startswith(MATLAB_PREDICTORS) else Kind.MATLAB
    if head.startswith(b"\x89HDF\r\n\x1a\n"):
        return _of_hdf5(path)
    # Matroska, MP4 and QuickTime, AVI.
    if head.startswith(b"\x1aE\xdf\xa3") or head[4:8] == b"ftyp" or head[8:12] == b"AVI ":
        return Kind.VIDEO
    if b"\0" in head and not head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
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
    if {"Fx", "Fx_rate"} <= set(first[1]):
        return Kind.PREDICTORS
    if set(CONTOUR) <= set(names):
        return Kind.CONTOUR
    if {"Fx", "Mx"} <= {signal_column(name)[0] for name in first[1]}:
        return Kind.SIGNALS
    if {"theta", "phi", "status"} <= set(names):
        return Kind.CONTACTS
    if tuple(names) == CORRECTION_COLUMNS:
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


# Readers of other programs' files, by kind.
READERS: Mapping[Kind, Callable[[Path], RawTracks]] = MappingProxyType(
    {
        Kind.WHISKERS: read_whiskers,
        Kind.MEASUREMENTS: read_measurements,
        Kind.DEEPLABCUT: read_deeplabcut,
        Kind.SLEAP_ANALYSIS: read_sleap_analysis,
        Kind.SLEAP_LABELS: read_sleap_labels,
        Kind.ANIPOSE: read_anipose,
        Kind.MOVEMENT: read_movement,
        Kind.NWB: read_nwb,
        Kind.MATLAB: read_matlab,
        Kind.TRACKS_TABLE: read_tracks_table,
    }
)


def load_tracks(
    path: str | PathLike[str], kind: Kind | None = None, **labels: Unpack[Labels]
) -> xr.Dataset:
    """Read tracks from a file in any known format.

    Supported are files of whisk, DeepLabCut, LightningPose, SLEAP, Anipose, movement, NWB
    (ndx-pose) and MATLAB, tables of points, and vibrissa's own tracks and recordings.
    `load_matlab` chooses among several variables.

    Parameters
    ----------
    path : str or path
        Path of the file.
    kind : Kind, optional
        Kind of the file; by default it is recognised by content.
    **labels
        Metadata that the file may lack: fps (frames per second), view (name of the camera), and
        for points in space unit ("m", "cm", "mm" or "um") and reference_frame; see `Labels`.

    Returns
    -------
    xarray.Dataset
        ``trace`` (time, whisker, view, node, image_axis) in pixels for points in images,
        ``centerline`` (time, whisker, node, space) in m for points in space, and ``confidence``.
        Missing values are NaN. Attributes name the source.
    """
    path = Path(path)
    kind = recognise(path) if kind is None else kind
    if kind in (Kind.TRACKS, Kind.RECORDING):
        fps = labels.pop("fps", None)
        if labels:
            raise ValueError(f"{path} is a {kind}, which states {', '.join(labels)} itself")
        return timed(load_own_tracks(path), path, fps)
    if kind not in READERS:
        raise ValueError(
            f"{path} does not contain tracks in a known format (it is: {kind}). Known are: "
            f"{'; '.join(READERS)}; {Kind.TRACKS}; {Kind.RECORDING}"
        )
    return labelled(READERS[kind](path), path, **labels)
