"""Tracks: where whiskers were in every frame, as any tracker saw them.

Every reader of another program's files fills in :class:`RawTracks`; :func:`labelled` is the one
border where these are checked and named. Beyond it they are a dataset like a recording's:

    trace             (time, whisker, view, node, image_axis)   pixels, column and row
    centerline        (time, whisker, node, space)              m, in ``reference_frame``
    confidence        (time, whisker[, view], node)             0 to 1, NaN where none is given
    trace_confidence  the same of the trace, where there is a centreline too

with ``time`` in seconds, or in frames where the frame rate is unknown. An animal,
track or instance of other programs is a whisker, and a body part or keypoint a node of it, from
the base to the tip. Missing is NaN: also points at exactly zero that no confidence speaks for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import xr
from vibrissa.quantities import attributes

Array = NDArray[np.float64]

KIND = "vibrissa tracks"
"""Value of the attribute ``kind`` of tracks."""

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6}
"""Units of length that can be stated, and their size, m."""

LONGEST = 1.0
"""No whisker reaches across more in one frame, m."""

IMAGE = ("time", "whisker", "view", "node", "image_axis")
SPACE = ("time", "whisker", "node", "space")


class Labels(TypedDict, total=False):
    """Facts that files of other programs may lack.

    ``fps``: frames per second; by default that of the file, else time counts frames. ``view``: name
    of the camera of a file with pixels; by default that of the file, or ``camera``. ``unit``: of
    points in space, "m", "cm", "mm" or "um", where the file does not say. ``reference_frame``: of
    points in space; by default that of the file, or ``laboratory``.
    """

    fps: float
    view: str
    unit: str
    reference_frame: str


@dataclass(frozen=True, eq=False)
class RawTracks:
    """Contents of a tracker's file as they are.

    Parameters
    ----------
    software : str
        Name of the program that wrote the file.
    whiskers : sequence of str
        Names of the whiskers.
    image : array (time, whisker, view, node, 2), optional
        Column and row of points in images, pixels.
    space : array (time, whisker, node, 3), optional
        Points in space, in ``unit``.
    image_confidence, space_confidence : array, optional
        Confidence of each of these points, 0 to 1.
    nodes : sequence of str, optional
        Names of the points along a whisker.
    views : sequence of str
        Names of the views.
    frames : array (time,) of int, optional
        Numbers of the frames.
    time : array (time,), optional
        Times, s.
    fps : float, optional
        Frames per second.
    unit, reference_frame : str
        Unit and frame of points in space; empty where the file does not state them.
    extra : mapping of str to xarray.Variable
        Further variables of the format.
    about : mapping
        Further attributes of the format.
    """

    software: str
    whiskers: Sequence[str]
    image: Array | None = None
    space: Array | None = None
    image_confidence: Array | None = None
    space_confidence: Array | None = None
    nodes: Sequence[str] | None = None
    views: Sequence[str] = ()
    frames: NDArray[np.integer[Any]] | None = None
    time: Array | None = None
    fps: float | None = None
    unit: str = ""
    reference_frame: str = ""
    extra: Mapping[str, xr.Variable] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)


def labelled(raw: RawTracks, path: str | PathLike[str], **labels: Unpack[Labels]) -> xr.Dataset:
    """Check tracks, bring them to SI units and name everything."""
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
        unit = _stated(path, "unit", raw.unit, labels.get("unit"))
        points, sure = _without_zeros(raw.space, raw.space_confidence)
        frame = _stated(path, "reference_frame", raw.reference_frame, labels.get("reference_frame"))
        data["centerline"] = xr.Variable(
            SPACE,
            points * _factor(path, unit, points),
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
            raise ValueError(f"{path} holds no {name}")


def _without_zeros(points: Array, sure: Array | None) -> tuple[Array, Array]:
    """Mark points at exactly zero as missing where no confidence speaks for them."""
    sure = np.full(points.shape[:-1], np.nan) if sure is None else np.array(sure, dtype=np.float64)
    zero = (points == 0.0).all(axis=-1) & ~(sure > 0.0)
    # A lone whisker's base may truly be at the origin of space; a pixel never is by chance.
    if points.shape[-1] == 3:
        zero &= (sure == 0.0) | zero.all(axis=-1, keepdims=True)
    missing = zero | np.isnan(points).any(axis=-1)
    points = np.where(missing[..., None], np.nan, points)
    return points, np.where(missing, np.nan, sure)


def _stated(path: Path, name: str, stated: str, given: str | None) -> str:
    """Value in the file, or the one given; they must agree."""
    if stated and given and stated != given:
        raise ValueError(f"{path} states the {name} {stated!r}, but {given!r} is given")
    return stated or given or ""


def _factor(path: Path, unit: str, points: Array) -> float:
    """Length of the points' unit, m."""
    if unit not in UNITS:
        got = f"{unit!r} is not known" if unit else "the file does not say it"
        raise ValueError(
            f"{path}: the unit of its points in space is needed, one of {', '.join(UNITS)}; {got}"
        )
    known = np.isfinite(points).all(axis=(-2, -1))
    spans = np.ptp(points[known], axis=-2).max(axis=-1) * UNITS[unit]
    span = float(np.median(spans)) if spans.size else 0.0
    if span > LONGEST:
        raise ValueError(
            f"{path}: in {unit} its whiskers reach across {span:.3g} m, and {LONGEST:g} m is the "
            "most that is possible; are these millimetres or micrometres?"
        )
    return UNITS[unit]


def _views(raw: RawTracks, path: Path, labels: Labels) -> list[str]:
    assert raw.image is not None
    count, given = raw.image.shape[2], labels.get("view")
    if given is None:
        return list(raw.views) or ["camera"]
    if count != 1:
        raise ValueError(f"{path} has {count} views, {', '.join(raw.views)}; they keep their names")
    return [given]


def _clock(raw: RawTracks, path: Path, fps: float | None) -> dict[str, Any]:
    """Coordinates time and frame."""
    array = raw.image if raw.image is not None else raw.space
    assert array is not None
    frames = np.arange(len(array)) if raw.frames is None else np.asarray(raw.frames)
    if fps is not None and not (np.isfinite(fps) and fps > 0.0):
        raise ValueError(f"fps is {fps!r}; it must be positive")
    if raw.fps is not None and fps is not None and abs(fps / raw.fps - 1.0) > 1e-3:
        raise ValueError(f"{path} states {raw.fps:g} frames per second, but {fps:g} is given")
    rate = raw.fps if raw.fps is not None else fps
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


def join_views(*tracks: xr.Dataset) -> xr.Dataset:
    """Put tracks of one trial by several cameras together.

    Parameters
    ----------
    *tracks : xarray.Dataset
        Each with a ``trace``, and views with names of their own. Whiskers and nodes are matched by
        their names, times by their frame; what one view lacks is NaN there.

    Returns
    -------
    xarray.Dataset
        Tracks of all views.

    Raises
    ------
    ValueError
        If there is no trace, views share a name, or times do not agree.
    """
    if not tracks or any("trace" not in one for one in tracks):
        raise ValueError("each of the tracks to join needs a trace, and there must be some")
    names = [str(name) for one in tracks for name in one["view"].values]
    if len(set(names)) != len(names):
        raise ValueError(f"the views are called {', '.join(names)}; each needs a name of its own")
    units = {one["time"].attrs.get("units", "") for one in tracks}
    if len(units) != 1:
        raise ValueError("some tracks know their time in seconds and some do not: give fps to all")
    parts = [one.swap_dims(time="frame") for one in tracks]
    points = [_with_nodes(part[["trace", "confidence"]].drop_vars("time")) for part in parts]
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


def _with_nodes(tracks: xr.Dataset) -> xr.Dataset:
    """Number nodes without names, so that they are matched."""
    if "node" in tracks.coords:
        return tracks
    return tracks.assign_coords(node=np.arange(tracks.sizes["node"]))
