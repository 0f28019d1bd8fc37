"""SLEAP's analysis files (HDF5) and labels (``.slp``, through sleap-io).

An analysis file holds dense arrays of tracks, nodes and scores. Their dimensions are named in an
attribute where sleap-io wrote them, and are (track, xy, node, frame) in SLEAP's own. Labels are
lists of instances in frames, of one video or of several, which become views; sleap-io reads their
many versions.
"""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from numpy.typing import NDArray

from vibrissa.io.netcdf import opened
from vibrissa.io.paths import check_readable
from vibrissa.io.tracks import RawTracks

if TYPE_CHECKING:
    import sleap_io

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
        parts = [_of_video(labels, video) for video in labels.videos]
    except Exception as error:  # What sleap-io raises for a damaged file is not documented.
        raise ValueError(f"{path} cannot be read as labels of SLEAP ({error})") from error
    if not any(len(values) for _, values in parts):
        raise ValueError(f"{path} holds no labelled frame")
    start = min(first for first, values in parts if len(values))
    end = max(first + len(values) for first, values in parts)
    tracks, nodes = (max(values.shape[axis] for _, values in parts) for axis in (1, 2))
    found = np.full((end - start, tracks, len(parts), nodes, 3), np.nan)
    for view, (first, values) in enumerate(parts):
        rows = slice(first - start, first - start + len(values))
        found[rows, : values.shape[1], view] = values
    stems = [Path(str(video.filename)).stem for video in labels.videos]
    if len(set(stems)) < len(stems):
        stems = [f"view {i + 1}" for i in range(len(stems))]
    return RawTracks(
        software="SLEAP",
        whiskers=[track.name for track in labels.tracks] or _numbered(tracks),
        image=found[..., :2],
        image_confidence=_confidence(found[..., 2]),
        nodes=list(labels.skeletons[0].node_names),
        views=stems if len(stems) > 1 else (),
        frames=np.arange(start, end),
    )


def _of_video(labels: sleap_io.Labels, video: sleap_io.Video) -> tuple[int, Array]:
    """First frame of a video's labels, and these (frame, track, node, column, row and score)."""
    numbers = [frame.frame_idx for frame in labels.labeled_frames if frame.video == video]
    if not numbers:
        return 0, np.full((0, 1, 1, 3), np.nan)
    found = labels.numpy(video=video, untracked=not labels.tracks, return_confidence=True)
    # Versions of sleap-io begin at frame 0, or at the first that has a label.
    first = min(numbers) if len(found) == max(numbers) - min(numbers) + 1 else 0
    return first, found.astype(np.float64)


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
