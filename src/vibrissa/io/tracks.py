"""Tracks: positions of whiskers in every frame, from any tracker.

Readers of other programs' files return :class:`RawTracks`, which :func:`labelled` validates and
converts to a dataset with the variables of a recording:

    trace             (time, whisker, view, node, image_axis)   pixels, column and row
    centerline        (time, whisker, node, space)              m, in ``reference_frame``
    confidence        (time, whisker[, view], node)             0 to 1, NaN where none is given
    trace_confidence  the same of the trace, where there is a centreline too

with ``time`` in seconds, or in frames if the frame rate is unknown. An animal, track or instance of
other programs is a whisker, and a body part or keypoint is a node of it, from base to tip. Missing
values are NaN; points at exactly zero without a confidence count as missing.

Vibrissa's own files are NetCDF, without loss, and CSV, one row per point. Tables have the columns
``frame``, ``time`` (s), ``whisker``, ``view``, ``node``, then ``column``, ``row`` (pixels) or
``x``, ``y``, ``z`` (m, or with the unit at the end of the name, as in ``x_mm``), and
``confidence``. Only frame or time, and the coordinates, are required; without node names, points of
a whisker in a frame are in order from the base.

Partial traces of a video are stored while the rest is traced: those of some whiskers from the first
frame on, as one array of points with the number of points per frame, and a key that identifies the
video and the settings.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Self, TypedDict, Unpack
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import xr
from vibrissa.io.netcdf import COMPRESSED, kind_of, read_dataset, write_netcdf
from vibrissa.io.paths import CSV, NETCDF, check_writable, replacing
from vibrissa.io.table import Table, signal_columns, table_text
from vibrissa.numerics import Array
from vibrissa.quantities import attributes

KIND = "vibrissa tracks"
"""Value of the attribute ``kind`` of tracks."""

# Units of length that can be stated, and their size, m.
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6}
# Smallest and largest plausible extent of a whisker, m.
SHORTEST, LONGEST = 0.5e-3, 1.0
# Relative difference of frame rates that are the same but for rounding.
_ROUNDED = 5e-3
# Largest confidence that is read; peaks of confidence maps can exceed 1.
SUREST = 2.0
IMAGE = ("time", "whisker", "view", "node", "image_axis")
SPACE = ("time", "whisker", "node", "space")


class Labels(TypedDict, total=False):
    """Metadata that files of other programs may lack.

    ``fps`` is the frame rate, Hz, by default that of the file; without one, time is in frames.
    ``view`` is the name of the camera of points in pixels, by default that of the file, or
    ``camera``. ``unit`` is the unit of points in space, "m", "cm", "mm" or "um", if the file does
    not state it. ``reference_frame`` is the frame of points in space, by default that of the file,
    or ``laboratory``.
    """

    fps: float
    view: str
    unit: str
    reference_frame: str


@dataclass(frozen=True, eq=False)
class RawTracks:
    """Contents of a tracker's file before conversion."""

    software: str  # name of the program that wrote the file
    whiskers: Sequence[str]  # names of the whiskers
    # (time, whisker, view, node, 2), column and row of points in images, pixels.
    image: Array | None = None
    space: Array | None = None  # (time, whisker, node, 3), points in space, in ``unit``
    # Confidence of each of these points, 0 to 1.
    image_confidence: Array | None = None
    space_confidence: Array | None = None
    nodes: Sequence[str] | None = None  # names of the points along a whisker
    views: Sequence[str] = ()  # names of the views
    frames: NDArray[np.integer[Any]] | None = None  # (time,), numbers of the frames
    time: Array | None = None  # (time,), times, s
    fps: float | None = None  # frames per second
    # Unit and frame of points in space; empty if the file does not state them.
    unit: str = ""
    reference_frame: str = ""
    usual_unit: str = ""  # unit that files of this format have unless another one is stated
    # Further variables of the format.
    extra: Mapping[str, xr.Variable] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)  # further attributes of the format

    @classmethod
    def of(cls, points: Array, confidence: Array | None, **others: Any) -> Self:
        """Tracks of points (time, whisker, view, node, 2 or 3): those in space have one view."""
        if points.shape[-1] == 2:
            return cls(image=points, image_confidence=confidence, **others)
        sure = None if confidence is None else confidence[:, :, 0]
        return cls(space=points[:, :, 0], space_confidence=sure, **others)


def labelled(raw: RawTracks, path: str | PathLike[str], **labels: Unpack[Labels]) -> xr.Dataset:
    """Validate tracks and convert them to a labelled dataset in SI units."""
    path = Path(path)
    _check_size(raw, path)
    data: dict[str, xr.Variable] = {}
    coordinates: dict[str, Any] = {"whisker": list(raw.whiskers)}
    about: dict[str, Any] = {
        "kind": KIND,
        "source": path.name,
        "source_software": raw.software,
        **raw.about,
    }
    if raw.image is not None:
        sure = raw.image_confidence
        points, sure = _without_zeros(raw.image, sure)
        data["trace"] = xr.Variable(IMAGE, points, attributes("trace"))
        name = "confidence" if raw.space is None else "trace_confidence"
        data[name] = xr.Variable(IMAGE[:-1], sure, attributes("confidence"))
        coordinates |= {"view": _views(raw, path, labels), "image_axis": ["column", "row"]}
    if raw.space is not None:
        unit = _stated(path, "unit", raw.unit, labels.get("unit")) or raw.usual_unit
        points, sure = _without_zeros(raw.space, raw.space_confidence)
        frame = _stated(path, "reference_frame", raw.reference_frame, labels.get("reference_frame"))
        data["centerline"] = xr.Variable(
            SPACE,
            points * _factor(path, unit, points, fixed=bool(raw.unit)),
            {**attributes("centerline"), "reference_frame": frame or "laboratory"},
        )
        data["confidence"] = xr.Variable(SPACE[:-1], sure, attributes("confidence"))
        coordinates["space"] = list("xyz")
    if raw.nodes is not None:
        coordinates["node"] = list(raw.nodes)
    return xr.Dataset(
        {**data, **raw.extra}, {**_clock(raw, path, labels.get("fps")), **coordinates}, about
    )


def _check_size(raw: RawTracks, path: Path) -> None:
    arrays = [array for array in (raw.image, raw.space) if array is not None]
    empty = {
        "frame": any(array.shape[0] == 0 for array in arrays),
        "whisker": any(array.shape[1] == 0 for array in arrays),
        "point": not arrays or any(array.shape[-2] == 0 for array in arrays),
    }
    for name, missing in empty.items():
        if missing:
            raise ValueError(f"{path} contains no {name}")
    for sure in (raw.image_confidence, raw.space_confidence):
        if sure is not None and (most := np.nanmax(sure, initial=0.0)) > SUREST:
            raise ValueError(
                f"{path}: confidences are up to {most:.4g}; numbers from 0 to 1 are needed, not "
                "percentages"
            )


def _without_zeros(points: Array, sure: Array | None) -> tuple[Array, Array]:
    """Set points at exactly zero without a confidence to NaN."""
    sure = np.full(points.shape[:-1], np.nan) if sure is None else np.array(sure, dtype=np.float64)
    zero = (points == 0.0).all(axis=-1) & ~(sure > 0.0)
    # In space, the base of a single whisker may be at the origin; a point in an image hardly is.
    if points.shape[-1] == 3:
        zero &= (sure == 0.0) | zero.all(axis=-1, keepdims=True)
    missing = zero | np.isnan(points).any(axis=-1)
    points = np.where(missing[..., None], np.nan, points)
    return points, np.where(missing, np.nan, sure)


def _stated(path: Path, name: str, stated: str, given: str | None) -> str:
    """Value stated in the file or given by the caller; the two must agree."""
    if stated and given and stated != given:
        raise ValueError(f"{path} states the {name} {stated!r}, but {given!r} is given")
    return stated or given or ""


def _factor(path: Path, unit: str, points: Array, fixed: bool) -> float:
    """Length of the points' unit, m; the unit is ``fixed`` if the file states it."""
    if unit not in UNITS:
        got = f"{unit!r} is not known" if unit else "the file does not state it"
        raise ValueError(
            f"{path}: the unit of its points in space is needed, one of {', '.join(UNITS)}; {got}"
        )
    known = np.isfinite(points).all(axis=(-2, -1))
    spans = np.ptp(points[known], axis=-2).max(axis=-1)
    span = float(np.median(spans)) if spans.size else 0.0
    if span == 0.0 or SHORTEST <= span * UNITS[unit] <= LONGEST:
        return UNITS[unit]
    likely = [name for name in ("mm", "um", "cm", "m") if 2e-3 <= span * UNITS[name] <= 0.5]
    advice = "correct the header" if fixed else "state it, unit= in Python or --unit of import"
    raise ValueError(
        f"{path}: in {unit} its whiskers reach across {span * UNITS[unit]:.3g} m, but "
        f"{SHORTEST:g} to {LONGEST:g} m are possible"
        + (f"; if they are in {' or '.join(likely)}, {advice}" if likely else "")
    )


def _views(raw: RawTracks, path: Path, labels: Labels) -> list[str]:
    assert raw.image is not None
    count, given = raw.image.shape[2], labels.get("view")
    if given is None:
        return list(raw.views) or ["camera"]
    if count != 1:
        raise ValueError(f"{path} has {count} views, {', '.join(raw.views)}; they keep their names")
    return [given]


def _clock(raw: RawTracks, path: Path, fps: float | None) -> dict[str, Any]:
    """Coordinates ``time`` and ``frame``."""
    array = raw.image if raw.image is not None else raw.space
    assert array is not None
    frames = _counted_frames(raw.time, len(array)) if raw.frames is None else raw.frames
    stated = raw.fps or (None if raw.time is None else _rate_of(frames, raw.time))
    rate = _agreed_rate(path, stated, fps)
    about = attributes("time")
    if raw.time is not None:
        time = np.asarray(raw.time, dtype=np.float64)
    elif rate is not None:
        time = frames / rate
    else:
        time = frames.astype(np.float64)
        about = {
            "units": "frame",
            "long_name": "frame",
            "description": "How many frames there are a second is not known.",
        }
    number = {"units": "1", "long_name": "number of the frame", "description": "From the source."}
    return {
        "time": xr.Variable("time", time, about),
        "frame": xr.Variable("time", frames.astype(np.int64), number),
    }


def _rate_of(frames: NDArray[np.integer[Any]], time: Array) -> float | None:
    """Frames per second, of numbers of frames and their times, s."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rate = float(np.median(np.diff(frames) / np.diff(time))) if len(time) > 1 else np.nan
    return rate if np.isfinite(rate) and rate > 0.0 else None


def _agreed_rate(path: Path, stated: float | None, given: float | None) -> float | None:
    """Frames per second stated by the file or given by the caller; the two must agree."""
    if given is not None and not (np.isfinite(given) and given > 0.0):
        raise ValueError(f"fps is {given!r}; it must be positive")
    if stated is not None and given is not None and abs(given / stated - 1.0) > _ROUNDED:
        raise ValueError(f"{path} states {stated:g} frames per second, but {given:g} is given")
    return stated or given


def timed(tracks: xr.Dataset, path: Path, fps: float | None) -> xr.Dataset:
    """Tracks with times in seconds, if they or the caller state the frame rate."""
    time = tracks["time"]
    frames = tracks["frame"].values if "frame" in tracks.coords else np.arange(len(time))
    in_seconds = time.attrs.get("units") == "s"
    rate = _agreed_rate(path, _rate_of(frames, time.values) if in_seconds else None, fps)
    if in_seconds or rate is None:
        return tracks
    return tracks.assign_coords(time=("time", frames / rate, attributes("time")))


def _counted_frames(time: Array | None, count: int) -> NDArray[np.integer[Any]]:
    """Numbers of frames from 0, with gaps where the time has some."""
    plain = np.arange(count)
    if time is None or count < 3:
        return plain
    step = float(np.median(np.diff(time)))
    if not (np.isfinite(step) and step > 0.0):
        return plain
    frames = np.round((np.asarray(time) - time[0]) / step)
    # Times that are too irregular to number frames leave them in their order.
    return frames.astype(np.int64) if (np.diff(frames) >= 1.0).all() else plain


def join_views(*tracks: xr.Dataset) -> xr.Dataset:
    """Combine tracks of one trial from several cameras.

    Parameters
    ----------
    *tracks : xarray.Dataset
        Tracks with a ``trace`` and distinct names of views. Whiskers and nodes are matched by name,
        times by frame; what a view lacks is NaN.

    Returns
    -------
    xarray.Dataset
        Tracks of all views.

    Raises
    ------
    ValueError
        If there is no trace, views share a name, times do not agree, or views have no whisker or
        node in common.
    """
    if not tracks or any("trace" not in one for one in tracks):
        raise ValueError("each of the tracks to join needs a trace, and there must be some")
    names = [str(name) for one in tracks for name in one["view"].values]
    if len(set(names)) != len(names):
        raise ValueError(f"the views are called {', '.join(names)}; their names must differ")
    units = {one["time"].attrs.get("units", "") for one in tracks}
    if len(units) != 1:
        raise ValueError("some tracks have times in seconds and some do not: give fps to all")
    parts = [one.swap_dims(time="frame") for one in tracks]
    # Of two points, follicle and tip, the curvature gives the line between them.
    wanted = ["trace", "confidence"]
    wanted += ["trace_curvature"] if all("trace_curvature" in one for one in tracks) else []
    points = [part[wanted].drop_vars("time") for part in parts]
    # Nodes without names are matched by their numbers.
    points = [
        one if "node" in one.coords else one.assign_coords(node=np.arange(one.sizes["node"]))
        for one in points
    ]
    for dim in ("whisker", "node"):
        if not set.intersection(*(set(one.indexes[dim]) for one in points)):
            listed = "; ".join(", ".join(map(str, one.indexes[dim])) for one in points)
            raise ValueError(
                f"the views have no {dim} in common ({listed}): the same names are needed in all"
            )
    # Joining sorts names, but nodes run from the base to the tip.
    order = {
        dim: list(dict.fromkeys(name for one in points for name in one.indexes[dim]))
        for dim in ("whisker", "node")
    }
    joined = xr.concat(
        points,
        "view",
        join="outer",
        coords="minimal",
        compat="override",
        combine_attrs="drop_conflicts",
    )
    time = parts[0]["time"]
    for part in parts[1:]:
        both = np.intersect1d(time["frame"], part["frame"])
        apart = np.abs(time.sel(frame=both).values - part["time"].sel(frame=both).values)
        step = np.median(np.diff(time.values)) if time.size > 1 else np.inf
        if apart.size and apart.max() > 0.5 * step:
            raise ValueError(
                f"the same frames are {apart.max():.3g} {units.pop()} apart in "
                f"{tracks[0].attrs.get('source')} and {part.attrs.get('source')}"
            )
        time = time.combine_first(part["time"])
    moments = time.sel(frame=joined["frame"]).values
    joined = joined.sel(order)
    if all("node" not in one.coords for one in tracks):
        joined = joined.drop_vars("node")
    joined = joined.rename_dims(frame="time").reset_index("frame")
    joined = joined.assign_coords(time=("time", moments, tracks[0]["time"].attrs)).transpose(*IMAGE)
    joined.attrs["source"] = ", ".join(str(one.attrs.get("source", "")) for one in tracks)
    return joined


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
        If these are not tracks, or tracks with both are to be written as a table.
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
    """Read tracks from NetCDF written by `save_tracks`, or from a recording."""
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
    # Units may be in parentheses or brackets: x (mm), time [ms].
    table.names = [re.sub(r"\s*[(\[](.*)[)\]]", r"_\1", name.lower()) for name in table.names]
    axes, unit = _coordinates(path, table.names)

    def numbers(name: str) -> Array | None:
        return table.numbers(name) if name in table.names else None

    frame, time = numbers("frame"), None
    if found := signal_columns(table.names, ["time"])[0]:
        column, factor = found["time"]
        time = factor * table.numbers(table.names[column])
    clock = frame if frame is not None else time
    if clock is None:
        raise ValueError(f"{path} has neither a column frame nor time (s; also time_ms)")
    table.refuse(np.isnan(clock), "a point without a frame or time")
    moments, first, row = np.unique(clock, return_index=True, return_inverse=True)
    labels = {name: table.text(name) for name in _LABELS if name in table.names}
    whisker, who = _ordered(labels.get("whisker", ["whisker"] * len(row)))
    view, seen = _ordered(labels.get("view", [""] * len(row)))
    names: Sequence[Any] = labels.get("node") or _counted(row, who, seen)
    if "node" in labels and all(name.isdecimal() for name in names):
        names = [int(name) for name in names]  # numbers are sorted
    node, part = _ordered(names)
    place = (row, who, seen, part)
    if len(np.unique(np.stack(place), axis=1).T) != len(row):
        raise ValueError(f"{path} has the same point of a whisker twice in one frame")
    shape = (moments.size, len(whisker), len(view), len(node))
    points, sure = np.full((*shape, len(axes)), np.nan), np.full(shape, np.nan)
    for i, axis in enumerate(axes):
        points[(*place, i)] = numbers(axis)
    if (confidence := numbers("confidence")) is not None:
        sure[place] = confidence
    return RawTracks.of(
        points,
        sure,
        software="table",
        whiskers=whisker,
        views=[name for name in view if name],
        nodes=node if "node" in labels else None,
        frames=moments.astype(np.int64) if frame is not None else None,
        time=None if time is None else time[first],
        unit=unit,
        usual_unit="m",
    )


def _coordinates(path: Path, names: Sequence[str]) -> tuple[list[str], str]:
    """Names of the columns of coordinates, and the unit of points in space."""
    for pixels in (["column", "row"], ["x_px", "y_px"]):
        if set(pixels) <= set(names):
            return pixels, ""
    for unit in ("m", "mm", "um", "µm", "cm"):
        found = [f"{axis}_{unit}" for axis in "xyz"]
        if set(found) <= set(names):
            return found, unit
    if {"x", "y", "z"} <= set(names):
        return list("xyz"), ""
    raise ValueError(
        f"{path} has the columns {', '.join(names)}; column, row or x_px, y_px (pixels), or x, y, "
        f"z (m; also x_mm and so on: {', '.join(UNITS)}) are needed"
    )


def _ordered(names: Sequence[Any]) -> tuple[list[str], NDArray[np.int64]]:
    """Distinct names in order of appearance, or numbers in order, and the index for each row."""
    known = dict.fromkeys(names)
    numbered = all(isinstance(name, int) for name in known)
    order = {name: i for i, name in enumerate(sorted(known) if numbered else known)}
    return [str(name) for name in order], np.array([order[name] for name in names])


def _counted(*keys: NDArray[np.int64]) -> list[int]:
    """Running number of each row among the rows with the same keys."""
    counts: dict[tuple[int, ...], int] = {}
    out = []
    for key in zip(*(array.tolist() for array in keys), strict=True):
        counts[key] = counts.get(key, -1) + 1
        out.append(counts[key])
    return out


def _text(tracks: xr.Dataset) -> str:
    """Text of a table."""
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


# Points (n, 2), deviations (n,), visibility (n,), confidence, visibility of base and of tip, skew,
# sparse. The last is not stored, as traces of videos never are sparse.
Row = tuple[Array, Array, NDArray[np.bool_], float, bool, bool, float, bool]


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
            numbers=np.array([row[3:7] for row in rows], dtype=np.float64).reshape(-1, 4),
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
            numbers = file["numbers"]
    except (OSError, ValueError, KeyError, BadZipFile):
        return None
    rows = [
        (line, sigma, seen, float(sure), bool(base), bool(tip), float(skew), False)
        for line, sigma, seen, (sure, base, tip, skew) in zip(*parts, numbers, strict=True)
    ]
    each = len(rows) // max(whiskers, 1)
    return [rows[k * each : (k + 1) * each] for k in range(whiskers)]


_COLUMNS = ("line", "sigma", "seen")
