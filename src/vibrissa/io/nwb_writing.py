"""Writer of recordings as Neurodata Without Borders files (pynwb, ndx-pose 0.4 or later).

    devices              a CalibratedCamera for each view whose calibration is known, else a Device
    processing/behavior  for each whisker a MultiCameraPoseEstimation: its centreline in space, node
                         by node, in metres, and a PoseEstimation in pixels for each view;
                         ``contact_point_…`` and ``base_position_…`` in metres, ``base_rotation_…``
                         (time, 3, 3), ``force_…`` in newtons and ``moment_…`` in newton-metres;
                         and the pose of the head, if it moves
    intervals/contacts   start and end of the contacts of each whisker

Missing values are NaN. The truth of a simulated trial is omitted.
"""

from __future__ import annotations

import importlib
import io
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from os import PathLike
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from vibrissa.deferred import xr
from vibrissa.io.paths import NWB, check_writable, replacing
from vibrissa.io.time_tables import events_in
from vibrissa.numerics import Array, contacts_in
from vibrissa.status import Status

if TYPE_CHECKING:
    from pynwb import NWBFile


_TURN = "Rotation from the {} to the laboratory frame; its columns are the axes"
_SERIES = {
    "contact_point": ("meters", "Where the whisker touches the object; x, y, z"),
    "contact_point_whisker": ("meters", "Where the whisker touches the object; x, y, z"),
    "base_position": ("meters", "Base of the whisker; x, y, z"),
    "base_rotation": ("n.a.", _TURN.format("whisker's")),
    "force": ("newtons", "Force of the object on the whisker; x, y, z"),
    "moment": ("newton-metres", "Moment of that force about the whisker's base; x, y, z"),
    "head_position": ("meters", "Origin of the head's frame; x, y, z"),
    "head_rotation": ("n.a.", _TURN.format("head's")),
}
_SERIES |= {
    name: _SERIES[name.partition("_")[2]]
    for name in (
        "estimates_contact_point",
        *(f"signals_{name}" for name in ("base_position", "force", "moment")),
    )
}
# Remark on quantities that differ from those in the table of predictors.
_NOT_OF = "As recorded; that of the {0} is the series with {0} before its name"
# Fields of the subject that validators require, with values that stand for unknown.
_NOBODY = {"subject_id": "unknown", "sex": "U", "age": "P0D/", "description": "not stated"}

_VECTORS = 2  # number of dimensions of vectors over time


@dataclass(frozen=True)
class Session:
    """Metadata of the experiment that NWB requires and a recording lacks.

    Parameters
    ----------
    start : datetime
        Start time of the recording, with time zone.
    description : str
        Description of the session.
    identifier : str
        Globally unique identifier of the file; by default a random one.
    subject : mapping
        Fields of the animal, as in NWB: subject_id, species, sex, age, description, …. Missing
        ones are written as unknown: sex "U", an age of 0 days or more ("P0D/").
    about : mapping
        Other fields of NWB: experimenter, institution, lab, keywords, ….
    """

    start: datetime
    description: str = "Whisking against objects"
    identifier: str = field(default_factory=lambda: str(uuid.uuid4()))
    subject: Mapping[str, Any] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.start.tzinfo is None:
            raise ValueError(f"start is {self.start}, without a time zone; NWB needs one")


def save_nwb(
    path: str | PathLike[str],
    recording: xr.DataTree | xr.Dataset,
    session: Session,
    predictors: xr.Dataset | None = None,
) -> None:
    """Write a recording, or tracks, as NWB.

    Parameters
    ----------
    path : str or path
        Path with the ending ``.nwb``; an existing file is replaced once the new one is complete.
    recording : xarray.DataTree or Dataset
        Recording, with the group ``cameras`` if cameras are calibrated, or tracks. Missing
        quantities are omitted.
    session : Session
        Metadata of the experiment.
    predictors : xarray.Dataset, optional
        Table of `vibrissa.pipeline.predictors`, whose 16 predictors of spike models are written as
        one series per whisker.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ModuleNotFoundError
        If pynwb or ndx-pose is not installed.
    ValueError
        If the path has another ending, time is not in seconds, or there is nothing to write.
    """
    path = check_writable(path, NWB)
    for module in ("pynwb", "ndx_pose"):
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("to write NWB, install vibrissa[nwb]") from error
    from pynwb import NWBHDF5IO

    data = recording.to_dataset() if isinstance(recording, xr.DataTree) else recording
    _check(data)
    cameras = None
    if isinstance(recording, xr.DataTree) and "cameras" in recording.children:
        # The names of the views may be defined in the root group.
        cameras = recording.children["cameras"].to_dataset()
    file = _file(session)
    _fill(file, _completed(data, predictors), cameras, predictors)
    with replacing(path) as part:
        # In memory first, for the reason given in :mod:`vibrissa.io.netcdf`.
        image = io.BytesIO()
        with h5py.File(image, "w") as content, NWBHDF5IO(mode="w", file=content) as out:
            out.write(file)
        part.write_bytes(image.getbuffer())


def _check(data: xr.Dataset) -> None:
    if "time" not in data.coords or data["time"].attrs.get("units", "s") != "s":
        raise ValueError("the time of what is to be written is not in seconds: give fps")
    if "whisker" not in data.dims:
        raise ValueError("what is to be written has no dimension whisker")
    known = {"trace", "centerline", *_SERIES} - {"head_position", "head_rotation"}
    if not known & set(data.data_vars):
        raise ValueError(f"there is nothing to write: none of {', '.join(sorted(known))}")


def _completed(data: xr.Dataset, table: xr.Dataset | None) -> xr.Dataset:
    """Add the contacts of a table of predictors, and a remark to quantities that differ from it."""
    if table is None:
        return data
    found = {n: table[n] for n in ("in_contact",) if n in table and n not in data}
    of = {name: [f"{name}_{x}" for x in "xyz"] for name in ("contact_point", "base_position")}
    of |= {name: [f"{name[0].upper()}{x}" for x in "xyz"] for name in ("force", "moment")}
    for name, columns in of.items():
        if not set(columns) <= set(table):
            continue
        values = xr.concat([table[n] for n in columns], "space", combine_attrs="drop")
        if name == "contact_point":
            values.attrs["about"] = table[columns[0]].attrs.get("description", "")
        if name not in data and name == "contact_point":
            found[name] = values
        elif name in data and not np.array_equal(
            values.transpose(*data[name].dims), data[name], equal_nan=True
        ):
            other = "estimates" if name == "contact_point" else "signals"
            found[name] = data[name].assign_attrs(about=_NOT_OF.format(other))
            found[f"{other}_{name}"] = values.assign_attrs(reference_frame=_frame(data[name]))
    return data.assign(found)


def _frame(values: xr.DataArray) -> str:
    return str(values.attrs.get("reference_frame", "laboratory"))


def _file(session: Session) -> NWBFile:
    from pynwb import NWBFile
    from pynwb.file import Subject

    return NWBFile(
        session_description=session.description,
        identifier=session.identifier,
        session_start_time=session.start,
        subject=Subject(**{**_NOBODY, **session.subject}),
        **session.about,
    )


def _fill(
    file: NWBFile, data: xr.Dataset, cameras: xr.Dataset | None, predictors: xr.Dataset | None
) -> None:
    from ndx_pose import Skeletons

    behavior = file.create_processing_module(
        "behavior", "Whiskers, forces at their bases, and contacts"
    )
    clock = _clock(data["time"].values)
    poses = {"trace", "centerline"} & set(data.data_vars)
    skeletons = Skeletons(skeletons=[])
    if poses:
        behavior.add(skeletons)
    devices = {}
    if "trace" in data:
        for i, name in enumerate(data["view"].values.tolist()):
            devices[name] = _camera(str(name), i, cameras)
            file.add_device(devices[name])
    for i, name in enumerate(_names(data)):
        whisker = data.isel(whisker=i)
        if poses:
            behavior.add(_pose(name, whisker, clock, devices, skeletons))
        for series in _series(whisker, clock, name):
            behavior.add(series)
        if predictors is not None:
            behavior.add(_predictors(predictors, i, name, clock))
    for series in _series(data, clock):
        behavior.add(series)
    if "in_contact" in data:
        _add_contacts(file, data)
    if predictors is not None:
        _add_events(file, predictors)


def _names(data: xr.Dataset) -> list[str]:
    """Names of the whiskers, with characters that NWB does not allow replaced."""
    names = data["whisker"].values if "whisker" in data.coords else range(data.sizes["whisker"])
    return [_allowed(str(name)) for name in names]


def _allowed(name: str) -> str:
    return name.replace("/", "_").replace(":", "_") or "whisker"


def _clock(time: Array) -> dict[str, Any]:
    """Rate if frames are evenly spaced to one part in a million, otherwise all times."""
    steps = np.diff(time)
    if steps.size and np.allclose(steps, steps.mean(), rtol=1e-6, atol=1e-9 * abs(time[-1])):
        return {"starting_time": float(time[0]), "rate": float(1.0 / steps.mean())}
    return {"timestamps": time}


def _camera(name: str, index: int, cameras: xr.Dataset | None) -> Any:
    from ndx_pose import CalibratedCamera
    from pynwb.device import Device

    if cameras is None or name not in cameras["view"].values:
        return Device(name=_allowed(name), description=f"High-speed camera, view {name}")
    one = cameras.sel(view=name)
    kind = str(one["projection"].values) if "projection" in one else "perspective"
    scale = "pixels per metre" if kind == "orthographic" else "pixels"
    more = {}
    if "camera_distortion" in one and kind != "orthographic":
        more["distortion_coefficients"] = one["camera_distortion"].values
    return CalibratedCamera(
        name=_allowed(name),
        description=f"High-speed camera, view {name}; {kind} projection, focal lengths in {scale}, "
        "translation in metres",
        intrinsic_matrix=one["camera_matrix"].values,
        rotation_matrix=one["camera_rotation"].values,
        translation_vector=one["camera_translation"].values,
        **more,
    )


def _pose(
    name: str, whisker: xr.Dataset, clock: dict[str, Any], devices: dict[Any, Any], skeletons: Any
) -> Any:
    """Container of one whisker: centreline in space and traces in the views."""
    from ndx_pose import MultiCameraPoseEstimation, PoseEstimation, Skeleton

    nodes = _nodes(whisker)
    edges = np.stack([np.arange(len(nodes) - 1), np.arange(1, len(nodes))], axis=1)
    small = np.uint8 if len(nodes) <= 256 else np.uint16
    skeleton = Skeleton(name=f"whisker_{name}", nodes=nodes, edges=edges.astype(small))
    skeletons.add_skeletons(skeleton)
    source = str(whisker.attrs.get("source_software", "vibrissa"))
    about = {"scorer": source, "source_software": source, "skeleton": skeleton}
    views = []
    for view, device in devices.items():
        trace = whisker["trace"].sel(view=view).transpose("time", "node", "image_axis").values
        label = "trace_confidence" if "trace_confidence" in whisker else "confidence"
        frame = "Middle of the top left pixel; column to the right, row downward"
        sure = _confidence(whisker, label, view)
        views.append(
            PoseEstimation(
                name=_allowed(str(view)),
                description=f"Trace of the whisker in the view {view}, from base to tip",
                pose_estimation_series=_points(nodes, trace, sure, "pixels", frame, clock),
                device=device,
                **about,
            )
        )
    space = []
    if "centerline" in whisker:
        line = whisker["centerline"].transpose("time", "node", "space")
        frame = _frame(line)
        sure = _confidence(whisker, "confidence", None)
        space = _points(nodes, line.values, sure, "meters", frame, clock)
    return MultiCameraPoseEstimation(
        name=name,
        description="Centreline of the whisker, from base to tip",
        pose_estimation_series=space,
        pose_estimations=views,
        **about,
    )


def _nodes(whisker: xr.Dataset) -> list[str]:
    if "node" in whisker.coords:
        return [_allowed(str(name)) for name in whisker["node"].values]
    count = whisker.sizes["node"]
    digits = len(str(count - 1))
    return [f"node_{i:0{digits}d}" for i in range(count)]


def _confidence(whisker: xr.Dataset, name: str, view: object) -> Array | None:
    """Confidence (time, node), expanded from one value per frame if needed; None if unknown."""
    if name not in whisker:
        return None
    sure = whisker[name]
    if "view" in sure.dims:
        if view is None:
            return None
        sure = sure.sel(view=view)
    if "node" not in sure.dims:
        sure = sure.expand_dims(node=whisker.sizes["node"])
    values: Array = sure.transpose("time", "node").values
    return values if np.isfinite(values).any() else None


def _points(
    nodes: list[str],
    points: Array,
    sure: Array | None,
    unit: str,
    frame: str,
    clock: dict[str, Any],
) -> list[Any]:
    """Series of all nodes."""
    from ndx_pose import PoseEstimationSeries

    return [
        PoseEstimationSeries(
            name=node,
            description=f"Node {i} of {len(nodes)} from the base",
            data=_squeezed(points[:, i]),
            unit=unit,
            reference_frame=frame,
            confidence=None if sure is None else sure[:, i],
            confidence_definition=None if sure is None else "From 0 (none) to 1",
            **clock,
        )
        for i, node in enumerate(nodes)
    ]


def _squeezed(values: Array) -> Any:
    from pynwb import H5DataIO

    return H5DataIO(values, compression="gzip", compression_opts=1, shuffle=True)


def _series(data: xr.Dataset, clock: dict[str, Any], whisker: str | None = None) -> Iterator[Any]:
    """Yield the series over time of one whisker, or of the head."""
    from pynwb import TimeSeries
    from pynwb.behavior import SpatialSeries

    for variable, (unit, text) in _SERIES.items():
        if variable not in data or variable.startswith("head_") != (whisker is None):
            continue
        values = data[variable].transpose("time", "space", ...)
        frame = _frame(values)
        if values.attrs.get("about"):
            text += f". {values.attrs['about'].rstrip('.')}"
        made: Any = TimeSeries
        named = {"name": variable if whisker is None else f"{variable}_{whisker}", "unit": unit}
        if unit == "meters":
            made = SpatialSeries
            named["reference_frame"] = frame
        elif values.ndim == _VECTORS:
            text += f", reference_frame: {frame}"
        yield made(
            description=f"{text}; NaN where there is none",
            data=_squeezed(values.values),
            **named,
            **clock,
        )


def _predictors(table: xr.Dataset, whisker: int, name: str, clock: dict[str, Any]) -> Any:
    """Predictors of spike models, as columns of one series."""
    from pynwb import TimeSeries

    columns = table.attrs["predictors"].split()
    one = table.isel(whisker=whisker)
    units = ", ".join(f"{column} ({one[column].attrs['units']})" for column in columns)
    return TimeSeries(
        name=f"predictors_{name}",
        description=f"Columns: {units}; NaN where there is none",
        comments=" ".join(columns),
        data=_squeezed(np.stack([one[column].values for column in columns], axis=1)),
        unit="n.a.",
        **clock,
    )


_EVENTS = "Onset, loss and slip of contacts, each from its time on for the length of a frame"


def _step(data: xr.Dataset) -> float:
    """Time between frames, s."""
    time = data["time"].values
    return float(np.median(np.diff(time))) if time.size > 1 else 0.0


def _add_events(file: NWBFile, table: xr.Dataset) -> None:
    """Add onset, loss and slip as intervals of one frame, as NWB requires a duration."""
    from pynwb.epoch import TimeIntervals

    found = sorted(events_in(table))
    if not found:
        return
    rows = TimeIntervals(name="contact_events", description=_EVENTS)
    step = _step(table)
    rows.add_column("whisker", "Name of the whisker")
    rows.add_column("event", "What happened: onset, loss or slip")
    rows.add_column("sigma", "Standard deviation of an onset, s; NaN where it is not known")
    for time, name, event, sigma in found:
        known = {"whisker": _allowed(name), "event": event, "sigma": sigma}
        rows.add_interval(start_time=time, stop_time=time + step, **known)
    file.add_time_intervals(rows)


def _add_contacts(file: NWBFile, data: xr.Dataset) -> None:
    """Add the intervals of contact of each whisker."""
    from pynwb.epoch import TimeIntervals

    time = data["time"].values
    step = _step(data)
    rows = []
    touching = np.nan_to_num(data["in_contact"].transpose("whisker", "time").values) > 0.5
    seen = np.ones_like(touching)
    if "status" in data:
        seen = data["status"].transpose("whisker", "time").values != Status.MISSING
    for name, *one in zip(_names(data), touching, seen, strict=True):
        rows += [(float(time[i]), float(time[j - 1]) + step, name) for i, j in contacts_in(*one)]
    if not rows:
        return
    table = TimeIntervals(
        name="contacts", description="From the first frame of a contact to the end of its last"
    )
    table.add_column("whisker", "Name of the whisker")
    for start, stop, name in sorted(rows):
        table.add_interval(start_time=start, stop_time=stop, whisker=name)
    file.add_time_intervals(table)
