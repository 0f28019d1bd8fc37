"""SLEAP's analysis files (HDF5) and labels (``.slp``, through sleap-io).

An analysis file holds dense arrays of tracks, nodes and scores. Their dimensions are named in an
attribute where sleap-io wrote them, and are (track, xy, node, frame) in SLEAP's own. Labels are
lists of instances in frames; sleap-io knows their many versions.
"""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from vibrissa.io.netcdf import opened
from vibrissa.io.paths import check_readable
from vibrissa.io.tracks import RawTracks

Array = NDArray[np.float64]

_OWN = {"tracks": ("track", "xy", "node", "frame"), "point_scores": ("track", "node", "frame")}


def read_sleap_analysis(path: str | PathLike[str]) -> RawTracks:
    """Read an analysis file (``.h5``) as raw tracks."""
    path = Path(path)
    with opened(path, "an analysis file of SLEAP") as file:
        if "tracks" not in file or "node_names" not in file:
            raise ValueError(
                f"{path} is not an analysis file of SLEAP: it lacks tracks or node_names"
            )
        points = _ordered(file["tracks"], ("frame", "track", "node", "xy"))
        sure = None
        if "point_scores" in file:
            sure = _ordered(file["point_scores"], ("frame", "track", "node"))
        nodes = [str(name) for name in file["node_names"].asstr()[:]]
        names = [str(name) for name in file["track_names"].asstr()[:]] if _any(file) else []
        fps = file.attrs.get("fps")
    whiskers = names or _numbered(points.shape[1])
    if points.shape[1:] != (len(whiskers), len(nodes), 2):
        raise ValueError(
            f"{path}: tracks have shape {points.shape}, and names are given for {len(whiskers)} "
            f"tracks and {len(nodes)} nodes"
        )
    return RawTracks(
        software="SLEAP",
        whiskers=whiskers,
        image=points[:, :, None],
        image_confidence=None if sure is None else _confidence(sure)[:, :, None],
        nodes=nodes,
        fps=None if fps is None else float(fps),
    )


def read_sleap_labels(path: str | PathLike[str]) -> RawTracks:
    """Read labels as raw tracks."""
    path = check_readable(path)
    try:
        import sleap_io
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{path} holds labels of SLEAP: to read them, install vibrissa[labs], or export the "
            "tracks from SLEAP as an analysis file"
        ) from error
    with opened(path, "labels of SLEAP") as file:
        if "frames" not in file or "instances" not in file:
            raise ValueError(f"{path} holds no labels of SLEAP: it lacks frames or instances")
    try:
        labels = sleap_io.load_slp(path, open_videos=False)
        if len(labels.videos) != 1:
            raise ValueError(f"it has labels of {len(labels.videos)} videos, not of one")
        found = labels.numpy(untracked=not labels.tracks, return_confidence=True)
        labelled_frames = [frame.frame_idx for frame in labels.labeled_frames]
    except Exception as error:  # What sleap-io raises for a damaged file is not documented.
        raise ValueError(f"{path} cannot be read as labels of SLEAP ({error})") from error
    # Versions of sleap-io begin at frame 0, or at the first that has a label.
    first, last = min(labelled_frames, default=0), max(labelled_frames, default=0)
    start = first if len(found) == last - first + 1 else 0
    nodes = list(labels.skeletons[0].node_names)
    names = [track.name for track in labels.tracks] or _numbered(found.shape[1])
    return RawTracks(
        software="SLEAP",
        whiskers=names,
        image=found[:, :, None, :, :2].astype(np.float64),
        image_confidence=_confidence(found[:, :, None, :, 2].astype(np.float64)),
        nodes=nodes,
        frames=np.arange(len(found)) + start,
    )


def _ordered(array: h5py.Dataset, wanted: tuple[str, ...]) -> Array:
    """Bring the dimensions of an array in order."""
    stated = array.attrs.get("dims")
    dims = tuple(json.loads(stated)) if stated is not None else _OWN[array.name.strip("/")]
    values: Array = np.asarray(array[:], dtype=np.float64)
    if sorted(dims) != sorted(wanted) or values.ndim != len(wanted):
        raise ValueError(f"{array.name} has dimensions {dims} of sizes {values.shape}")
    return values.transpose([dims.index(dim) for dim in wanted])


def _any(file: h5py.File) -> bool:
    return "track_names" in file and file["track_names"].size > 0


def _numbered(count: int) -> list[str]:
    return [str(i) for i in range(count)] if count != 1 else ["whisker"]


def _confidence(scores: Array) -> Array:
    """Scores are peaks of confidence maps, which noise can lift a little over 1."""
    return np.clip(scores, 0.0, 1.0)
