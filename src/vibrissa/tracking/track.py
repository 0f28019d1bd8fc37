"""From traces in two views to a recording: shape, pose, contact and wrench of every frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.io.recording import KIND
from vibrissa.quantities import attributes
from vibrissa.status import Status
from vibrissa.tracking.filtering import CUTOFF
from vibrissa.tracking.pose import BasePose, base_pose
from vibrissa.tracking.refine import Refined, RefineOptions, refine
from vibrissa.tracking.rest import RestShape, rest_shape, whisker_at_rest
from vibrissa.tracking.sight import Sight
from vibrissa.tracking.space import merge
from vibrissa.tracking.timing import paired_frames
from vibrissa.tracking.trace import Trace
from vibrissa.trial.cameras import Camera, cameras_dataset
from vibrissa.trial.recording import recorded
from vibrissa.whisker import Whisker
from vibrissa.whisker.emergence import angles_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Progress = Callable[[str, int, int], None]
"""Called with what is being done, and how much of how much is."""

IMAGE = ("time", "whisker", "view", "node", "image_axis")


@dataclass(frozen=True)
class TrackOptions:
    """How traces become a recording.

    Parameters
    ----------
    cutoff : float, optional
        Of the zero-phase low pass on the base's pose, Hz; None filters nothing.
    offset : int, optional
        Frames by which the other cameras began before the first; None finds it, and dropped frames.
    free : float
        Share of the frames that are free of contact, at least.
    refine : RefineOptions
        Of the fit of the rod.
    properties : mapping
        Radius and material of the whisker; see `vibrissa.Whisker`.
    """

    cutoff: float | None = CUTOFF
    offset: int | None = 0
    free: float = 0.1
    refine: RefineOptions = field(default_factory=RefineOptions)
    properties: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, eq=False)
class Tracked:
    """One whisker, tracked.

    Parameters
    ----------
    whisker : Whisker
        At rest.
    sight : Sight
        Its traces.
    curves : array (time, node, 3)
        Merged from the views, laboratory frame, m.
    covariance : array (time, node, 3, 3)
        Of the curves, m².
    shape : RestShape
        What it was taken from.
    pose : BasePose
        How it is held, filtered, the paper's way.
    touching : array (time,)
        Frames in contact.
    refined : Refined
        The rod that fits the traces.
    """

    whisker: Whisker
    sight: Sight
    curves: Array
    covariance: Array
    shape: RestShape
    pose: BasePose
    touching: Mask
    refined: Refined


def track(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Sequence[Trace]]],
    rate: float,
    options: TrackOptions | None = None,
    *,
    names: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> xr.DataTree:
    """Make a recording of the traces of one or more whiskers.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    traces : sequence of sequence of sequence of Trace
        View by view, whisker by whisker, frame by frame; the same whiskers in every view.
    rate : float
        Frames per second.
    options : TrackOptions, optional
        How.
    names : sequence of str, optional
        Of the whiskers.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    xarray.DataTree
        A recording. Its base pose, contact and wrench are those of the rod that fits the traces;
        the group ``measured`` holds what was measured before: the whisker merged from the views
        with its uncertainty, and the pose the paper's way.

    Raises
    ------
    ValueError
        If views and whiskers do not fit together, or a whisker is seen in too few frames.
    """
    options = options or TrackOptions()
    counts = {len(view) for view in traces}
    if len(traces) != len(cameras) or len(counts) != 1 or 0 in counts:
        raise ValueError(
            f"{len(cameras)} cameras and {[len(view) for view in traces]} whiskers in the views do "
            "not fit: every view needs all whiskers"
        )
    if not (np.isfinite(rate) and rate > 0.0):
        raise ValueError(f"rate is {rate!r}; it must be positive, in frames per second")
    pairs = paired_frames(cameras, [view[0] for view in traces], options.offset)
    found = []
    for k in range(counts.pop()):
        rows = [[view[k][i] for i in pairs[:, v]] for v, view in enumerate(traces)]
        name = names[k] if names is not None else f"whisker {k}"
        found.append(track_whisker(cameras, rows, rate, options, name, progress))
    return tracked_recording(cameras, found, pairs, rate)


def track_whisker(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    rate: float,
    options: TrackOptions,
    name: str = "whisker",
    progress: Progress | None = None,
) -> Tracked:
    """Track one whisker in space.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    traces : sequence of sequence of Trace
        View by view, frame by frame, frames that belong together.
    rate : float
        Frames per second.
    options : TrackOptions
        How.
    name : str
        Of the whisker.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    Tracked

    Raises
    ------
    ValueError
        If it is seen in too few frames.
    """
    tell = progress or _silent
    count = len(traces[0])
    curves = []
    for i, views in enumerate(zip(*traces, strict=True)):
        curves.append(merge(cameras, views))
        tell(f"{name} in space", i + 1, count)
    points = np.array([curve.points for curve in curves])
    tell(f"contact of {name}", 0, 2)
    shape = rest_shape(points, options.free)
    whisker = whisker_at_rest(shape, name, **options.properties)
    pose = base_pose(points, shape, whisker).filtered(rate, options.cutoff)
    tell(f"contact of {name}", 1, 2)
    known = np.isfinite(points).all(axis=(1, 2))
    touching = known & ~shape.free
    sight = Sight.of(traces)
    refined = refine(
        cameras, sight, whisker, pose, touching, points, rate, options.refine, points.shape[1]
    )
    tell(f"contact of {name}", 2, 2)
    covariance = np.array([curve.covariance for curve in curves])
    return Tracked(whisker, sight, points, covariance, shape, pose, touching, refined)


def tracked_recording(
    cameras: Sequence[Camera], found: Sequence[Tracked], pairs: NDArray[np.int64], rate: float
) -> xr.DataTree:
    """Write tracked whiskers as a recording.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    found : sequence of Tracked
        The whiskers.
    pairs : array (time, view)
        Frame numbers.
    rate : float
        Frames per second.

    Returns
    -------
    xarray.DataTree
        See `track`.
    """
    coordinates = {
        "time": xr.Variable("time", pairs[:, 0] / rate, attributes("time")),
        "whisker": [one.whisker.name for one in found],
        "view": [camera.name for camera in cameras],
        "space": list("xyz"),
        "whisker_axis": list("xyz"),
        "image_axis": ["column", "row"],
    }
    root = xr.concat([_variables(one) for one in found], "whisker").assign_coords(coordinates)
    frame = {"units": "1", "long_name": "frame of each video"}
    root = root.assign(frame=xr.Variable(("time", "view"), pairs, frame))
    root.attrs = {"kind": KIND, "origin": "tracked in video"}
    measured = xr.concat([_measured(one) for one in found], "whisker")
    groups = {
        "/": root,
        "/measured": measured,
        "/cameras": cameras_dataset(cameras).drop_vars("view"),
    }
    for k, one in enumerate(found):
        groups[f"/whiskers/{k}"] = one.whisker.to_dataset().drop_dims("node")
    return xr.DataTree.from_dict(groups)


def _variables(one: Tracked) -> xr.Dataset:
    """What is known of one whisker, dim whisker of length 1."""
    r = one.refined
    angles = angles_of(r.rotation)
    status = np.full(len(r.misfit), int(Status.MISSING), dtype=np.int8)
    fitted = np.isfinite(r.misfit)
    status[fitted] = int(Status.NO_CONTACT)
    status[fitted & one.touching] = int(Status.OK)
    confidence = np.where(fitted, one.sight.confidence.min(axis=1), 0.0)
    values = {
        "base_position": r.position,
        "base_rotation": r.rotation,
        "base_azimuth": angles[:, 0],
        "base_elevation": angles[:, 1],
        "base_roll": angles[:, 2],
        "centerline": r.centerline,
        "contact_point": r.contact_point,
        "contact_point_whisker": r.contact_point_whisker,
        "arc_length": r.arc_length,
        "force": r.force,
        "moment": r.moment,
        "in_contact": one.touching,
        "confidence": confidence,
        "status": status,
    }
    data = {name: recorded(name, array) for name, array in values.items()}
    spread = ("time", "whisker", "space", "space_")
    data["contact_covariance"] = xr.Variable(
        spread, r.contact_covariance[:, None], attributes("contact_covariance")
    )
    data["wrench_covariance"] = xr.Variable(
        ("time", "whisker", "component", "component_"),
        r.wrench_covariance[:, None],
        attributes("wrench_covariance"),
    )
    data["trace_misfit"] = xr.Variable(
        ("time", "whisker"), r.misfit[:, None], attributes("trace_misfit")
    )
    data["trace"] = xr.Variable(IMAGE, one.sight.line[:, None], attributes("trace"))
    for name, array in (
        ("trace_sigma", one.sight.sigma),
        ("trace_visible", one.sight.seen),
        ("trace_confidence", one.sight.confidence),
    ):
        dims = IMAGE[: array.ndim + 1]
        data[name] = xr.Variable(dims, array[:, None], attributes(name))
    return xr.Dataset(data)


def _measured(one: Tracked) -> xr.Dataset:
    """What was measured before the rod was fitted."""
    values = {
        "centerline": one.curves,
        "base_position": one.pose.position,
        "base_rotation": one.pose.rotation,
        "base_azimuth": one.pose.azimuth,
        "base_elevation": one.pose.elevation,
        "base_roll": one.pose.roll,
    }
    data = {name: recorded(name, array) for name, array in values.items()}
    sigma = np.sqrt(np.einsum("tnii->tni", one.covariance))
    about = attributes("centerline_sigma")
    dims = ("time", "whisker", "node", "space")
    data["centerline_sigma"] = xr.Variable(dims, sigma[:, None], about)
    data["deviation"] = xr.Variable(
        ("time", "whisker"), one.shape.deviation[:, None], attributes("deviation")
    )
    return xr.Dataset(data)


def _silent(stage: str, done: int, total: int) -> None:
    pass
