"""Tracks in files of our own: NetCDF, without loss, and CSV, a line for each point.

The lines of a table have the columns ``frame``, ``time`` (s), ``whisker``, ``view``, ``node`` and
then ``column``, ``row`` (pixels) or ``x``, ``y``, ``z`` (m, or with the unit at the end of the
name, as in ``x_mm``), and ``confidence``. Of these a table that somebody else made needs frame or
time, and the coordinates; points of one frame and whisker without a name are in their order from
the base.

Traces on their way are what is done of a video, kept while the rest is traced: those of some
whiskers from the first frame on, as one array of points with their number per frame, and a key of
the video and the settings.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import xr
from vibrissa.io.netcdf import COMPRESSED, kind_of, read_dataset, write_netcdf
from vibrissa.io.paths import CSV, NETCDF, check_writable, replacing
from vibrissa.io.table import Table, table_text
from vibrissa.io.tracks import KIND, UNITS, RawTracks

Array = NDArray[np.float64]

_LABELS = ("whisker", "view", "node")
_RECORDING = "vibrissa recording"
_VARIABLES = ("trace", "centerline", "confidence", "trace_confidence")


def save_tracks(path: str | PathLike[str], tracks: xr.Dataset) -> None:
    """Write tracks.

    Parameters
    ----------
    path : str or path
        Path of a NetCDF file or a table (CSV), by its ending; an existing file is replaced.
    tracks : xarray.Dataset
        Tracks as a reader returned them. A table holds the points and their confidence, either
        those in the image or those in space.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If these are not tracks, or a table is asked of tracks with both.
    """
    path = check_writable(path, (*NETCDF, *CSV))
    if tracks.attrs.get("kind") != KIND:
        raise ValueError(f"these are not tracks: kind is {tracks.attrs.get('kind', 'nothing')!r}")
    if path.suffix.lower() in CSV:
        text = _text(tracks)
        with replacing(path) as part:
            part.write_text(text, encoding="utf-8")
        return
    large = [str(name) for name, one in tracks.data_vars.items() if one.size > 1000]
    write_netcdf(path, tracks, {"/": dict.fromkeys(large, COMPRESSED)})


def load_own_tracks(path: str | PathLike[str]) -> xr.Dataset:
    """Read tracks that `save_tracks` wrote as NetCDF, or those of a recording."""
    path = Path(path)
    kind = kind_of(path)
    if kind not in (KIND, _RECORDING):
        raise ValueError(f"{path} holds {kind or 'data of another kind'}, not tracks")
    if kind == KIND:
        return read_dataset(path)
    tracks = read_dataset(path, names=_VARIABLES)
    if not {"trace", "centerline"} & set(tracks.data_vars):
        raise ValueError(f"{path} is a recording without a trace or a centreline")
    tracks.attrs |= {"kind": KIND, "source": path.name, "source_software": "vibrissa"}
    return tracks


def read_tracks_table(path: str | PathLike[str]) -> RawTracks:
    """Read a table of points as raw tracks."""
    path = Path(path)
    table = Table(path)
    table.names = [name.lower() for name in table.names]
    axes, unit = _coordinates(path, table.names)

    def numbers(name: str) -> Array | None:
        return table.numbers(name) if name in table.names else None

    frame, time = numbers("frame"), numbers("time")
    if frame is None and time is None:
        raise ValueError(f"{path} has neither a column frame nor time")
    clock = frame if frame is not None else time
    assert clock is not None
    moments, first, row = np.unique(clock, return_index=True, return_inverse=True)
    labels = {name: table.text(name) for name in _LABELS if name in table.names}
    whisker, who = _ordered(labels.get("whisker", ["whisker"] * len(row)))
    view, seen = _ordered(labels.get("view", [""] * len(row)))
    node, part = _ordered(labels.get("node") or _counted(row, who, seen))
    place = (row, who, seen, part)
    if len(np.unique(np.stack(place), axis=1).T) != len(row):
        raise ValueError(f"{path} has the same point of a whisker twice in one frame")
    shape = (moments.size, len(whisker), len(view), len(node))
    points, sure = np.full((*shape, len(axes)), np.nan), np.full(shape, np.nan)
    for i, axis in enumerate(axes):
        points[(*place, i)] = numbers(axis)
    confidence = numbers("confidence")
    if confidence is not None:
        sure[place] = confidence
    flat = len(axes) == 2
    return RawTracks(
        software="table",
        whiskers=whisker,
        views=[name for name in view if name],
        nodes=node if "node" in labels else None,
        image=points if flat else None,
        image_confidence=sure if flat else None,
        space=None if flat else points[:, :, 0],
        space_confidence=None if flat else sure[:, :, 0],
        frames=moments.astype(np.int64) if frame is not None else None,
        time=None if time is None else time[first],
        unit=unit,
    )


def _coordinates(path: Path, names: Sequence[str]) -> tuple[list[str], str]:
    """Names of the columns with coordinates, and the unit of points in space."""
    for pixels in (["column", "row"], ["x_px", "y_px"]):
        if set(pixels) <= set(names):
            return pixels, ""
    for unit in ("m", "mm", "um", "µm", "cm"):
        found = [f"{axis}_{unit}" for axis in "xyz"]
        if set(found) <= set(names):
            return found, unit
    if {"x", "y", "z"} <= set(names):
        return list("xyz"), "m"
    raise ValueError(
        f"{path} has the columns {', '.join(names)}; column, row (pixels) or x, y, z (m; also x_mm "
        f"and so on: {', '.join(UNITS)}) are needed"
    )


def _ordered(names: Sequence[Any]) -> tuple[list[str], NDArray[np.int64]]:
    """Names in the order they appear in, and which of them each row has."""
    order = {name: i for i, name in enumerate(dict.fromkeys(names))}
    return [str(name) for name in order], np.array([order[name] for name in names])


def _counted(*keys: NDArray[np.int64]) -> list[int]:
    """Count rows with the same keys."""
    counts: dict[tuple[int, ...], int] = {}
    out = []
    for key in zip(*(array.tolist() for array in keys), strict=True):
        counts[key] = counts.get(key, -1) + 1
        out.append(counts[key])
    return out


def _text(tracks: xr.Dataset) -> str:
    """Lines of a table."""
    points = [name for name in ("trace", "centerline") if name in tracks]
    if len(points) != 1:
        raise ValueError(
            f"tracks with {' and '.join(points) or 'no points'} are not a table; drop trace or "
            "centerline, or write NetCDF"
        )
    array = tracks[points[0]]
    dims = [str(dim) for dim in array.dims[:-1]]
    axes = ["column", "row"] if points == ["trace"] else ["x", "y", "z"]
    frames = tracks["frame"].values if "frame" in tracks else np.arange(tracks.sizes["time"])
    moments = [[str(int(frame))] for frame in frames]
    head = ["frame"]
    if tracks["time"].attrs.get("units") == "s":
        head.append("time")
        moments = [
            [*m, repr(float(t))] for m, t in zip(moments, tracks["time"].values, strict=True)
        ]
    places = list(itertools.product(*(_names(tracks, dim) for dim in dims[1:])))
    sure = tracks["confidence"].transpose(*dims).values
    numbers = np.concatenate([array.values, sure[..., None]], axis=-1)
    table = numbers.reshape(len(moments), len(places), -1).tolist()
    rows = (
        [*moment, *place, *row]
        for moment, each in zip(moments, table, strict=True)
        for place, row in zip(places, each, strict=True)
    )
    return table_text([*head, *dims[1:], *axes, "confidence"], rows)


def _names(tracks: xr.Dataset, dim: str) -> list[str]:
    if dim in tracks.coords:
        return [str(name) for name in tracks[dim].values]
    return [str(i) for i in range(tracks.sizes[dim])]


Row = tuple[Array, Array, NDArray[np.bool_], float, bool, bool]
"""Points (n, 2), standard deviations (n,), seen (n,), confidence, whether base and tip are."""


def save_traces(path: str | PathLike[str], key: str, traces: Sequence[Sequence[Row]]) -> None:
    """Write traces."""
    rows = [row for whisker in traces for row in whisker]
    columns = [np.concatenate([row[k] for row in rows]) if rows else np.empty(0) for k in range(3)]
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            key=np.array(key),
            whiskers=np.array(len(traces)),
            count=np.array([len(row[0]) for row in rows], dtype=np.int64),
            confidence=np.array([row[3] for row in rows]),
            ends=np.array([row[4:6] for row in rows], dtype=bool).reshape(-1, 2),
            line=columns[0].reshape(-1, 2),
            sigma=columns[1],
            seen=columns[2].astype(bool),
        )


def load_traces(path: str | PathLike[str], key: str) -> list[list[Row]] | None:
    """Read traces."""
    if not Path(path).is_file():
        return None
    try:
        with np.load(path) as file:
            if str(file["key"]) != key:
                return None
            count, whiskers = file["count"], int(file["whiskers"])
            parts = [np.split(file[name], np.cumsum(count)[:-1]) for name in _COLUMNS]
            confidence, ends = file["confidence"], file["ends"]
    except (OSError, ValueError, KeyError, BadZipFile):
        return None
    rows = [
        (line, sigma, seen, float(sure), bool(base), bool(tip))
        for line, sigma, seen, sure, (base, tip) in zip(*parts, confidence, ends, strict=True)
    ]
    each = len(rows) // max(whiskers, 1)
    return [rows[k * each : (k + 1) * each] for k in range(whiskers)]


_COLUMNS = ("line", "sigma", "seen")
