"""Tracked whiskers as a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera
from vibrissa.objects import Surface
from vibrissa.recording import coordinates, recorded, recording_tree
from vibrissa.status import Status
from vibrissa.tracking.contact import Contacts
from vibrissa.tracking.filtering import CUTOFF
from vibrissa.tracking.head import HeadPose
from vibrissa.whisker import angles_of

if TYPE_CHECKING:
    from vibrissa.tracking.track import Tracked


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
    root = xr.concat([_variables(one) for one in found], "whisker").assign_coords(
        coordinates(pairs[:, 0] / rate, [one.whisker.name for one in found])
        | {"view": [camera.name for camera in cameras], "image_axis": ["column", "row"]}
    )
    root = root.assign(frame=recorded("frame", pairs))
    if head is None:
        root = root.drop_vars("base_position_head")
    else:
        moves = {"head_position": head.position, "head_rotation": head.rotation}
        root = root.assign(_labelled(moves))
    measured = xr.concat([_measured(one) for one in found], "whisker")
    if cutoff is not None:
        measured.attrs["cutoff"] = cutoff
    return recording_tree(
        root,
        [one.whisker for one in found],
        "tracked in video",
        groups={"measured": measured},
        objects=objects or None,
        cameras=cameras,
    )


def _labelled(values: Mapping[str, Any]) -> dict[str, xr.Variable]:
    return {name: recorded(name, array) for name, array in values.items()}


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
        "contact_covariance": r.contact_covariance,
        "wrench_covariance": r.wrench_covariance,
        "pose_covariance": r.pose_covariance,
        "pose_wrench_covariance": r.pose_wrench_covariance,
        "trace_misfit": r.misfit,
        "trace": one.sight.line,
        "trace_sigma": one.sight.sigma,
        "trace_visible": one.sight.seen,
        "trace_confidence": one.sight.confidence,
    }
    return xr.Dataset(_labelled(values))


def _measured(one: Tracked) -> xr.Dataset:
    """What was measured before the rod was fitted."""
    values = {
        "centerline": one.curves,
        "base_position": one.head.put_in(one.pose.position),
        "base_rotation": one.head.rotation @ one.pose.rotation,
        "base_azimuth": one.pose.azimuth,
        "base_elevation": one.pose.elevation,
        "base_roll": one.pose.roll,
        # What another cut-off is tried on.
        "unfiltered_base_position": one.head.put_in(one.unfiltered.position),
        "unfiltered_base_azimuth": one.unfiltered.azimuth,
        "unfiltered_base_elevation": one.unfiltered.elevation,
        "unfiltered_base_roll": one.unfiltered.roll,
        "centerline_sigma": np.sqrt(np.einsum("tnii->tni", one.covariance)),
        "deviation": one.shape.deviation,
    }
    contacts = {} if one.contacts is None else _contacts(one.contacts)
    return xr.Dataset(_labelled(values) | contacts)


def _contacts(other: Contacts) -> dict[str, xr.Variable]:
    """Contact points that do not come from the rod, and how far they are from its own."""
    values = {
        "contact_point": other.points,
        "arc_length": other.arc_length,
        "contact_difference": other.difference,
    }
    data = _labelled(values)
    for variable in data.values():
        variable.attrs["source"] = other.source
    return data
