"""Reader of poses and signals from Neurodata Without Borders files, which are HDF5.

**Poses** (ndx-pose): a `PoseEstimation` contains one series per node, in pixels of one camera or in
space; a `MultiCameraPoseEstimation` (ndx-pose 0.4 and later) contains points in space and one
PoseEstimation per camera. Each such container is a whisker; separate PoseEstimations that differ
only in their camera are views of one whisker.

**Poses of bases, signals and contacts**: `save_nwb` writes one series per quantity and whisker,
named after both, such as ``force_C2``. These need no extension of NWB and also exist for simulated
trials without traces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vibrissa.deferred import xr
from vibrissa.io.netcdf import opened
from vibrissa.io.tracks import RawTracks
from vibrissa.numerics import Array
from vibrissa.quantities import attributes

_PIXELS = ("pixels", "pixel", "px")
_LENGTHS = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetres"), "cm"),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetres"), "mm"),
    **dict.fromkeys(("um", "µm", "micrometer", "micrometers", "micrometres", "microns"), "um"),
}


@dataclass(frozen=True, eq=False)
class _Series:
    """Points of all nodes of one whisker, in one view or in space."""

    nodes: Sequence[str]
    points: Array
    confidence: Array
    time: Array
    unit: str
    frame: str


def read_nwb(path: str | PathLike[str]) -> RawTracks:
    """Read an NWB file as raw tracks."""
    path = Path(path)
    with opened(path, "an NWB file with poses") as file:
        if "nwb_version" not in file.attrs:
            raise ValueError(f"{path} is not an NWB file: it has no nwb_version")
        space, image = _found(file)
    if not space and not image:
        raise ValueError(
            f"{path} has no poses: no PoseEstimation contains a series of points; "
            "forces and poses of the base are read by load_nwb_series"
        )
    every = [*space.values(), *image.values()]
    time = every[0].time
    if any(not np.array_equal(one.time, time) for one in every):
        raise ValueError(f"{path} has poses at different times; common times are needed")
    nodes = list(dict.fromkeys(node for one in every for node in one.nodes))
    whiskers = list(dict.fromkeys([*space, *(who for who, _ in image)]))
    views = list(dict.fromkeys(view for _, view in image))
    units = {one.unit for one in space.values()}
    frames = {one.frame for one in space.values()}
    if len(units) > 1 or len(frames) > 1:
        raise ValueError(f"{path} has points in several units or frames: {units}, {frames}")
    space_table = _table(space, (whiskers,), nodes, time.size, 3) if space else None
    image_table = _table(image, (whiskers, views), nodes, time.size, 2) if image else None
    return RawTracks(
        software="NWB",
        whiskers=whiskers,
        views=views,
        nodes=nodes,
        time=time,
        space=None if space_table is None else space_table[..., :3],
        space_confidence=None if space_table is None else space_table[..., 3],
        image=None if image_table is None else image_table[..., :2],
        image_confidence=None if image_table is None else image_table[..., 2],
        unit=units.pop() if units else "",
        reference_frame=frames.pop() if frames else "",
    )


def _found(file: h5py.File) -> tuple[dict[str, _Series], dict[tuple[str, str], _Series]]:
    """Find points in space by whisker, and points in images by whisker and view."""
    groups: dict[str, h5py.Group] = {}

    def note(name: str, item: Any) -> None:
        if isinstance(item, h5py.Group) and _type(item) in ("PoseEstimation", _MANY):
            groups[name] = item

    file.visititems(note)
    space: dict[str, _Series] = {}
    image: dict[tuple[str, str], _Series] = {}
    inside = {
        f"{name}/{child}" for name, one in groups.items() if _type(one) == _MANY for child in one
    }
    for name, group in groups.items():
        who = name.rpartition("/")[2]
        if _type(group) == _MANY:
            if (series := _series(group)) is not None:
                space[who] = series
            for child in group.values():
                if _type(child) == "PoseEstimation" and (series := _series(child)) is not None:
                    image[who, _view(child)] = series
    lone = {n: g for n, g in groups.items() if _type(g) != _MANY and n not in inside}
    series_of = {name: one for name, group in lone.items() if (one := _series(group)) is not None}
    cameras = [_view(lone[name]) for name in series_of]
    one_whisker = (
        len(cameras) > 1
        and len(set(cameras)) == len(cameras)
        and len({tuple(series.nodes) for series in series_of.values()}) == 1
    )
    for name, series in series_of.items():
        who = "whisker" if one_whisker else name.rpartition("/")[2]
        if series.points.shape[-1] == 3:
            space[who] = series
        else:
            image[who, _view(lone[name]) if one_whisker else "camera"] = series
    return space, image


_MANY = "MultiCameraPoseEstimation"


def _type(item: Any) -> str:
    return str(item.attrs.get("neurodata_type", ""))


def _view(group: h5py.Group) -> str:
    """Name of the camera of a container, or of the container itself."""
    for key, item in group.items():
        if _type(item) in ("Device", "CalibratedCamera"):
            link = group.get(key, getlink=True)
            name = link.path if isinstance(link, h5py.SoftLink) else key
            return str(name).rpartition("/")[2]
    return str(group.name).rpartition("/")[2]


def _series(group: h5py.Group) -> _Series | None:
    """Points of all nodes of one container; None if it has none."""
    children = {name: one for name, one in group.items() if _type(one) == "PoseEstimationSeries"}
    if not children:
        return None
    # Before ndx-pose 0.2 the names of nodes were in the container itself.
    skeleton = next((one for one in group.values() if _type(one) == "Skeleton"), group)
    order = skeleton["nodes"].asstr()[:] if "nodes" in skeleton else []
    nodes = [str(name) for name in order if name in children]
    nodes += [name for name in children if name not in nodes]
    first = children[nodes[0]]
    time = series_time(first)
    points, sure = [], []
    for name in nodes:
        values = _points(children[name])
        if len(values) != time.size or not np.array_equal(series_time(children[name]), time):
            raise ValueError(
                f"{children[name].name} has times that differ from those of {nodes[0]}"
            )
        points.append(values)
        known = "confidence" in children[name]
        sure.append(
            series_values(children[name], "confidence") if known else np.full(time.size, np.nan)
        )
        if sure[-1].shape != time.shape:
            raise ValueError(
                f"{children[name].name} has a confidence of another size than its data"
            )
    if len({one.shape[1] for one in points}) != 1:
        raise ValueError(f"{group.name} has nodes in the plane and others in space")
    units = {str(children[name]["data"].attrs.get("unit", "")).lower() for name in nodes}
    if len(units) > 1:
        stated = " and in ".join(sorted(unit or "no stated unit" for unit in units))
        raise ValueError(f"{group.name} has nodes in {stated}")
    (unit,) = units
    flat = points[0].shape[1] == 2
    if unit and unit not in (_PIXELS if flat else _LENGTHS):
        raise ValueError(f"{group.name} has positions in {unit}; pixels or a length is needed")
    frame = first.get("reference_frame")
    stated = "" if frame is None else str(frame.asstr()[()])
    return _Series(
        nodes,
        np.stack(points, axis=1),
        np.stack(sure, axis=1),
        time,
        "" if flat else _LENGTHS.get(unit, ""),
        "" if stated == "unknown" else stated,
    )


def _points(series: h5py.Group) -> Array:
    """Positions (time, 2 or 3) in the stated unit."""
    values = series_values(series, "data")
    if values.ndim != 2 or values.shape[1] not in (2, 3):
        raise ValueError(
            f"{series.name} has data of shape {values.shape}; (times, 2) or (times, 3) is needed"
        )
    about = series["data"].attrs
    return values * _number(series, about, "conversion", 1.0) + _number(
        series, about, "offset", 0.0
    )


def _number(item: h5py.HLObject, attributes: Mapping[str, Any], name: str, usual: float) -> float:
    try:
        return float(attributes.get(name, usual))
    except (TypeError, ValueError):
        raise ValueError(f"{item.name} has the {name} {attributes[name]!r}, not a number") from None


def series_time(series: h5py.Group) -> Array:
    """Times of a series."""
    if "timestamps" in series:
        return series_values(series, "timestamps")
    if "starting_time" not in series:
        raise ValueError(f"{series.name} has neither timestamps nor a starting_time")
    start = series_values(series, "starting_time")
    rate = _number(series, series["starting_time"].attrs, "rate", np.nan)
    if not (start.shape == () and 0.0 < rate < np.inf):
        raise ValueError(
            f"{series.name} has a starting_time of rate {rate}; it must be positive and finite"
        )
    return np.asarray(start + np.arange(len(series_values(series, "data"))) / rate)


def series_values(series: h5py.Group, name: str) -> Array:
    """Values of one dataset of a series, which must be numbers."""
    data = series.get(name)
    if not isinstance(data, h5py.Dataset):
        raise ValueError(f"{series.name} has no {name}")
    if data.dtype.kind not in "fiub":
        raise ValueError(f"{data.name} is of type {data.dtype}; numbers are needed")
    return np.asarray(data[()], dtype=np.float64)


def _table(
    found: Mapping[Any, _Series],
    names: tuple[Sequence[str], ...],
    nodes: Sequence[str],
    frames: int,
    width: int,
) -> Array:
    """Coordinates and confidence (time, whisker[, view], node, width + 1)."""
    table = np.full((frames, *map(len, names), len(nodes), width + 1), np.nan)
    for key, series in found.items():
        keys = key if isinstance(key, tuple) else (key,)
        part = table
        for axis, name in zip(names, keys, strict=True):
            part = part[:, axis.index(name)]
        columns = [nodes.index(node) for node in series.nodes]
        part[:, columns, :width] = series.points
        part[:, columns, width] = series.confidence
    return table


# Dimensions in addition to time and whisker; longer names precede those that are their prefixes.
_SPACE = ("space",)
_SERIES: dict[str, tuple[str, ...]] = {
    "base_position": _SPACE,
    "base_rotation": (*_SPACE, "whisker_axis"),
    "contact_point_whisker": _SPACE,
    "contact_point": _SPACE,
    "force": _SPACE,
    "moment": _SPACE,
}
_HEAD: dict[str, tuple[str, ...]] = {
    "head_position": _SPACE,
    "head_rotation": (*_SPACE, "head_axis"),
}


def load_nwb_series(path: str | PathLike[str]) -> xr.Dataset:
    """Read poses, forces, moments and contact points of an NWB file that `save_nwb` wrote.

    Parameters
    ----------
    path : str or path
        The ``.nwb`` file.

    Returns
    -------
    xarray.Dataset
        Dataset with dimensions time, whisker, space, like the root of a recording: those of
        ``base_position``, ``base_rotation``, ``contact_point``, ``contact_point_whisker``,
        ``force``, ``moment``, ``head_position`` and ``head_rotation`` that the file contains; SI
        units.
    """
    path = Path(path)
    with opened(path, "an NWB file") as file:
        behavior = file.get("processing/behavior")
        found = {} if behavior is None else _found_series(behavior)
        if not found:
            raise ValueError(
                f"{path} has no series of {', '.join(_SERIES)}, named after quantity and whisker: "
                "it was not written by save_nwb"
            )
        time = series_time(next(iter(found.values())))
        if any(not np.array_equal(series_time(series), time) for series in found.values()):
            raise ValueError(f"{path} has series at different times; common times are needed")
        values = {key: series_values(series, "data") for key, series in found.items()}
    for (name, who), array in values.items():
        shape = (time.size, *(3,) * len((_SERIES | _HEAD)[name]))
        if array.shape != shape:
            raise ValueError(
                f"{path} has {name} {who} of shape {array.shape}; {shape} is needed".replace(
                    "  ", " "
                )
            )
    whiskers = list(dict.fromkeys(who for _, who in values if who))
    data = {}
    for name, axes in (_SERIES | _HEAD).items():
        of = {who: array for (n, who), array in values.items() if n == name}
        if name in _HEAD and of:
            data[name] = (("time", *axes), of[""], attributes(name))
        elif of:
            missing = np.full(next(iter(of.values())).shape, np.nan)
            each = np.stack([of.get(who, missing) for who in whiskers], axis=1)
            data[name] = (("time", "whisker", *axes), each, attributes(name))
    named: dict[str, list[str]] = {dim: list("xyz") for dim in ("space", "whisker_axis")}
    coordinates = {"time": ("time", time, attributes("time")), "whisker": whiskers, **named}
    return xr.Dataset(data, coordinates)


def _found_series(behavior: h5py.Group) -> dict[tuple[str, str], h5py.Group]:
    """Series by quantity and whisker; the whisker of head series is empty."""
    found = {}
    for key, item in behavior.items():
        name = str(key)
        if not isinstance(item, h5py.Group) or "data" not in item:
            continue
        if name in _HEAD:
            found[name, ""] = item
            continue
        for variable in _SERIES:
            if name.startswith(f"{variable}_"):
                found[variable, name.removeprefix(f"{variable}_")] = item
                break
    return found
