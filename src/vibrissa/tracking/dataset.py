"""Tracked whiskers as a recording."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera
from vibrissa.cameras.files import cameras_dataset
from vibrissa.io.recording import KIND
from vibrissa.objects.dataset import objects_datasets
from vibrissa.objects.surface import Surface
from vibrissa.quantities import attributes
from vibrissa.recording.tree import head_variables, recorded
from vibrissa.status import Status
from vibrissa.tracking.contact import Contacts
from vibrissa.tracking.filtering import CUTOFF
from vibrissa.tracking.head import HeadPose
from vibrissa.whisker.emergence import angles_of

if TYPE_CHECKING:
    from vibrissa.tracking.track import Tracked

IMAGE = ("time", "whisker", "view", "node", "image_axis")


def tracked_recording(
    cameras: Sequence[Camera],
    found: Sequence[Tracked],
    pairs: NDArray[np.int64],
    rate: float,
    head: HeadPose | None = None,
    objects: Sequence[Surface] = (),
    cutoff: float | None = CUTOFF,
) -> xr.DataTree:
    """Write tracked whiskers as a recording."""
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
    if head is None:
        root = root.drop_vars("base_position_head")
    else:
        root = root.assign(head_variables(head.position, head.rotation))
    root.attrs = {"kind": KIND, "origin": "tracked in video"}
    measured = xr.concat([_measured(one) for one in found], "whisker")
    if cutoff is not None:
        measured.attrs["cutoff"] = cutoff
    groups = {
        "/": root,
        "/measured": measured,
        "/cameras": cameras_dataset(cameras).drop_vars("view"),
    }
    for k, one in enumerate(found):
        groups[f"/whiskers/{k}"] = one.whisker.to_dataset().drop_dims("node")
    if objects:
        groups["/objects"] = xr.Dataset(attrs={"reference_frame": "laboratory"})
    for name, dataset in objects_datasets(objects).items():
        groups[f"/objects/{name}"] = dataset.drop_vars("space")
    return xr.DataTree.from_dict(groups)


def _variables(one: Tracked) -> xr.Dataset:
    """What is known of one whisker, dim whisker of length 1."""
    r = one.refined
    angles = angles_of(np.swapaxes(one.head.rotation, 1, 2) @ r.rotation)
    status = np.full(len(r.misfit), int(Status.MISSING), dtype=np.int8)
    fitted = np.isfinite(r.misfit)
    status[fitted] = int(Status.NO_CONTACT)
    status[fitted & one.touching] = int(Status.OK)
    confidence = np.where(fitted, one.sight.confidence.min(axis=1), 0.0)
    values = {
        "base_position": r.position,
        "base_rotation": r.rotation,
        "base_position_head": one.head.seen_from(r.position),
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
    for name, covariance, axes in (
        ("pose_covariance", r.pose_covariance, ("pose", "pose_")),
        ("pose_wrench_covariance", r.pose_wrench_covariance, ("pose", "component_")),
    ):
        data[name] = xr.Variable(("time", "whisker", *axes), covariance[:, None], attributes(name))
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
        "base_position": one.head.put_in(one.pose.position),
        "base_rotation": one.head.rotation @ one.pose.rotation,
        "base_azimuth": one.pose.azimuth,
        "base_elevation": one.pose.elevation,
        "base_roll": one.pose.roll,
    }
    data = {name: recorded(name, array) for name, array in values.items()}
    # What another cut-off is tried on.
    for name, array in (
        ("base_position", one.head.put_in(one.unfiltered.position)),
        ("base_azimuth", one.unfiltered.azimuth),
        ("base_elevation", one.unfiltered.elevation),
        ("base_roll", one.unfiltered.roll),
    ):
        raw = recorded(name, array)
        raw.attrs["long_name"] += ", unfiltered"
        data[f"unfiltered_{name}"] = raw
    sigma = np.sqrt(np.einsum("tnii->tni", one.covariance))
    about = attributes("centerline_sigma")
    dims = ("time", "whisker", "node", "space")
    data["centerline_sigma"] = xr.Variable(dims, sigma[:, None], about)
    data["deviation"] = xr.Variable(
        ("time", "whisker"), one.shape.deviation[:, None], attributes("deviation")
    )
    return xr.Dataset(data) if one.contacts is None else xr.Dataset(data | _contacts(one.contacts))


def _contacts(other: Contacts) -> dict[str, xr.Variable]:
    """Contact points that do not come from the rod, and how far they are from its own."""
    values = {
        "contact_point": other.points,
        "arc_length": other.arc_length,
        "contact_difference": other.difference,
    }
    data = {name: recorded(name, array) for name, array in values.items()}
    for variable in data.values():
        variable.attrs["source"] = other.source
    return data
