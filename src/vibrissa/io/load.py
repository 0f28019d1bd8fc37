"""Tracks from any file that is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Unpack

import xarray as xr

from vibrissa.io.anipose import read_anipose
from vibrissa.io.deeplabcut import read_deeplabcut
from vibrissa.io.kinds import Kind, recognise
from vibrissa.io.matlab import read_matlab
from vibrissa.io.movement import read_movement
from vibrissa.io.nwb import read_nwb
from vibrissa.io.sleap import read_sleap_analysis, read_sleap_labels
from vibrissa.io.tracks import Labels, RawTracks, labelled
from vibrissa.io.tracks_file import load_own_tracks, read_tracks_table
from vibrissa.io.whisk import read_measurements, read_whiskers

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
"""What reads the files of other programs, by their kind."""


def load_tracks(path: str | PathLike[str], **labels: Unpack[Labels]) -> xr.Dataset:
    """Read tracks, whatever program made them.

    Known are files of whisk, DeepLabCut, LightningPose, SLEAP, Anipose, movement, NWB (ndx-pose)
    and MATLAB, tables of points, and our own tracks and recordings. Readers of one format, such
    as `load_whiskers` or `load_matlab`, may have more to choose.

    Parameters
    ----------
    path : str or path
        The file; its kind is told by its content.
    **labels
        What the file may not say: fps (frames per second), view (name of the camera), and for
        points in space unit ("m", "cm", "mm" or "um") and reference_frame; see `Labels`.

    Returns
    -------
    xarray.Dataset
        ``trace`` (time, whisker, view, node, image_axis) in pixels for points in images,
        ``centerline`` (time, whisker, node, space) in m for points in space, and ``confidence``.
        Missing is NaN. Attributes say the source.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is of no known kind, cut short or empty, if a unit is needed and not given, or if
        what it says is contradicted.
    """
    path = Path(path)
    kind = recognise(path)
    if kind in (Kind.TRACKS, Kind.RECORDING):
        if labels:
            raise ValueError(f"{path} is a {kind}, which says itself what {', '.join(labels)} is")
        return load_own_tracks(path)
    if kind not in READERS:
        raise ValueError(
            f"{path} holds no tracks that are known (its kind: {kind}). Known are: "
            f"{'; '.join(READERS)}; {Kind.TRACKS}; {Kind.RECORDING}"
        )
    return labelled(READERS[kind](path), path, **labels)
