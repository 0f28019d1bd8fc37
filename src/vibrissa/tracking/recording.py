"""Tracked whiskers, and the recording that is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface
from vibrissa.recording import coordinates, recorded, recording_tree
from vibrissa.status import Status
from vibrissa.tracking.contact_points import ContactPoints
from vibrissa.tracking.refine.fit import RodFit
from vibrissa.tracking.refine.trace_series import TraceSeries
from vibrissa.tracking.space.pose import CUTOFF, BasePose, HeadPose
from vibrissa.tracking.space.rest_shape import Length, RestShape
from vibrissa.whisker import Whisker, angles_of


@dataclass(frozen=True, eq=False)
class Tracked:
    """One whisker, tracked.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest.
    traces : TraceSeries
        Traces of it in the views.
    curves : array (time, node, 3)
        Points merged from the views, laboratory frame, m.
    covariance : array (time, node, 3, 3)
        Covariance of the curves, m².
    shape : RestShape
        Shape from which the whisker was taken.
    pose : BasePose
        Pose of the base relative to the head, filtered, by the paper's method.
    unfiltered : BasePose
        Pose before filtering.
    touching : array (time,)
        Whether the whisker is in contact in each frame.
    fit : RodFit
        Rod that fits the traces.
    head : HeadPose
        Pose of the head in these frames.
    length : Length
        Length of the whisker; its standard deviation is 0 where it is given.
    contacts : ContactPoints, optional
        Contact points that do not come from the rod.
    """

    whisker: Whisker
    traces: TraceSeries
    curves: Array
    covariance: Array
    shape: RestShape
    pose: BasePose
    unfiltered: BasePose
    touching: Mask
    fit: RodFit
    head: HeadPose
    length: Length
    contacts: ContactPoints | None = None


def tracked_recording(
    cameras: Sequence[Camera],
    found: Sequence[Tracked],
    pairs: NDArray[np.int64],
    rate: float,
    head: HeadPose | None = None,
    objects: Sequence[Surface] = (),
    cutoff: float | None = CUTOFF,
) -> xr.DataTree:
    """Make a recording of tracked whiskers."""
    errors = max(one.fit.shared.shape[1] for one in found)
    root = xr.concat([_variables(one, errors) for one in found], "whisker").assign_coords(
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


def _variables(one: Tracked, errors: int) -> xr.Dataset:
    """Variables of one whisker, dim whisker of length 1, with so many shared errors."""
    fit, traces = one.fit, one.traces
    shared = np.pad(fit.shared, ((0, 0), (0, errors - fit.shared.shape[1]), (0, 0)))
    angles = angles_of(np.swapaxes(one.head.rotation, 1, 2) @ fit.rotation)
    fitted = np.isfinite(fit.misfit)
    status = np.full(len(fit.misfit), int(Status.MISSING), dtype=np.int8)
    status[fitted] = int(Status.NO_CONTACT)
    status[fitted & one.touching] = int(Status.OK)
    values = {
        "base_position": fit.position,
        "base_rotation": fit.rotation,
        "base_position_head": one.head.seen_from(fit.position),
        "base_azimuth": angles[:, 0],
        "base_elevation": angles[:, 1],
        "base_roll": angles[:, 2],
        "centerline": fit.centerline,
        "contact_point": fit.contact_point,
        "contact_point_whisker": fit.contact_point_whisker,
        "arc_length": fit.arc_length,
        "force": fit.force,
        "moment": fit.moment,
        "in_contact": one.touching,
        "confidence": np.where(fitted, traces.confidence.min(axis=1), 0.0),
        "status": status,
        "contact_covariance": fit.contact_covariance,
        "contact_shared": shared[..., :3],
        "pose_shared": shared[..., 3:9],
        "wrench_shared": shared[..., 9:],
        "wrench_covariance": fit.wrench_covariance,
        "pose_covariance": fit.pose_covariance,
        "pose_wrench_covariance": fit.pose_wrench_covariance,
        "trace_misfit": fit.misfit,
        "trace": traces.line,
        "trace_sigma": traces.sigma,
        "trace_visible": traces.seen,
        "trace_confidence": traces.confidence,
    }
    return xr.Dataset(_labelled(values))


def _measured(one: Tracked) -> xr.Dataset:
    """Measurements from before the rod was fitted."""
    values = {
        "centerline": one.curves,
        **_pose(one, one.pose),
        "base_rotation": one.head.rotation @ one.pose.rotation,
        # What another cut-off is tried on.
        **{f"unfiltered_{name}": array for name, array in _pose(one, one.unfiltered).items()},
        "centerline_sigma": np.sqrt(np.einsum("tnii->tni", one.covariance)),
        "deviation": one.shape.deviation,
    }
    data = _labelled(values)
    if one.contacts is not None:
        contacts = _labelled(
            {
                "contact_point": one.contacts.points,
                "arc_length": one.contacts.arc_length,
                "contact_difference": one.contacts.difference,
            }
        )
        for variable in contacts.values():
            variable.attrs["source"] = one.contacts.source
        data |= contacts
    return xr.Dataset(data)


def _pose(one: Tracked, pose: BasePose) -> dict[str, Array]:
    return {
        "base_position": one.head.put_in(pose.position),
        "base_azimuth": pose.azimuth,
        "base_elevation": pose.elevation,
        "base_roll": pose.roll,
    }
