"""Recordings of tracked whiskers.

Contact points that do not come from the fitted rod are marked by a person, or are the points of the
whisker nearest to a known object. They are compared with the contact points of the fitted rod. The
rod does not depend on the points of a person, so agreement confirms both. It does depend on a known
object, on whose surface its contacts are; the difference then shows how well the measured whisker
agrees with the object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface
from vibrissa.recording import coordinates, recorded, recording_tree
from vibrissa.status import Status
from vibrissa.tracking.refine.fit import RodFit
from vibrissa.tracking.refine.rods import TraceSeries
from vibrissa.tracking.space.pose import CUTOFF, BasePose, HeadPose
from vibrissa.tracking.space.rest_shape import Length, RestShape
from vibrissa.whisker import Whisker, angles_of

_NEAR = 0.5  # largest difference between the time of a frame and that of its row in a table, frames


class ContactPoints(NamedTuple):
    """Contact points of one whisker, and their distances from those of the rod."""

    points: Array
    arc_length: Array
    difference: Array
    source: str


def contacts_at(
    objects: Sequence[Surface], curves: Array, touching: NDArray[np.bool_], rod: RodFit
) -> ContactPoints:
    """Contact points as the points of the whisker that are nearest to an object."""
    points = np.full((len(curves), 3), np.nan)
    rows = np.flatnonzero(touching & np.isfinite(curves).all(axis=(1, 2)))
    if rows.size:
        distance = np.min([thing.signed_distance(curves[rows]) for thing in objects], axis=0)
        points[rows] = _at(curves[rows], _lowest(distance))
    return _compared(points, rod, "nearest to the object")


def given_contacts(
    table: xr.Dataset,
    cameras: Sequence[Camera],
    pairs: NDArray[np.int64],
    rate: float,
    whisker: int,
    rod: RodFit,
) -> ContactPoints:
    """Read contact points from a table."""
    points = np.full((len(pairs), 3), np.nan)
    number = table["whisker"].values
    if not np.isin(whisker, number):
        return _compared(points, rod, "table")
    one = table.isel(whisker=int(np.flatnonzero(number == whisker)[0]))
    if "contact_pixel" in one:
        views = one["view"].values
        if views.max() >= len(cameras):
            raise ValueError(f"contact points are given in view {views.max()}, counted from 0")
        pixels = np.full((len(cameras), len(pairs), 2), np.nan)
        for column, view in enumerate(views):
            rows, known = _rows(one["frame"].values, pairs[:, view], 0.0)
            pixels[view, rows] = one["contact_pixel"].values[known, column]
        seen = np.isfinite(pixels).all(axis=(0, 2))
        if seen.any():
            points[seen] = triangulate(cameras, pixels[:, seen])[0]
    elif "time" in one.dims:
        rows, known = _rows(one["time"].values * rate, pairs[:, 0].astype(float), _NEAR)
        points[rows] = one["contact_point"].values[known]
    else:
        rows, known = _rows(one["frame"].values, pairs[:, 0], 0.0)
        points[rows] = one["contact_point"].values[known]
    if not np.isfinite(points).any():
        raise ValueError("the table of contact points has no frame of the videos")
    return _compared(points, rod, "table")


def outside_video(table: xr.Dataset, pairs: NDArray[np.int64], rate: float) -> list[str]:
    """Report the number of rows in a table of contact points for which the videos have no frame."""
    timed = "time" in table.dims
    known = table["time"].values * rate if timed else table["frame"].values.astype(float)
    within = _NEAR if timed else 0.0
    first, last = pairs.min() - within, pairs.max() + within
    outside = known[(known < first) | (known > last)]
    if not outside.size:
        return []
    where = [f"{x / rate:g} s" if timed else f"frame {x:.0f}" for x in (known.min(), known.max())]
    return [
        f"{outside.size} of the {known.size} moments in the table of contact points (from "
        f"{where[0]} to {where[1]}) are outside of the videos, frames {pairs.min()} to "
        f"{pairs.max()}, and are left out: check where it counts its frames from."
    ]


def _rows(
    known: NDArray[np.generic], wanted: NDArray[np.generic], within: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of the wanted times that are in the table, and of the nearest rows."""
    order = np.argsort(known, kind="stable")
    sorted_ = np.asarray(known, dtype=np.float64)[order]
    target = np.asarray(wanted, dtype=np.float64)
    right = np.clip(np.searchsorted(sorted_, target), 0, len(sorted_) - 1)
    left = np.maximum(right - 1, 0)
    nearer = np.abs(sorted_[left] - target) < np.abs(sorted_[right] - target)
    at = np.where(nearer, left, right)
    rows = np.flatnonzero(np.abs(sorted_[at] - target) <= within)
    return rows, order[at[rows]]


def _lowest(distance: Array) -> Array:
    """Index (t,) of the minimum of rows (t, n), refined by a parabola."""
    n = distance.shape[1]
    row = np.arange(len(distance))
    k = np.clip(np.argmin(distance, axis=1), 1, n - 2)
    a, b, c = distance[row, k - 1], distance[row, k], distance[row, k + 1]
    bend = a - 2.0 * b + c
    shift = np.where(bend > 0.0, 0.5 * (a - c) / np.where(bend > 0.0, bend, 1.0), 0.0)
    return np.asarray(np.clip(k + np.clip(shift, -1.0, 1.0), 0.0, n - 1.0))


def _at(curves: Array, index: Array) -> Array:
    """Points (t, 3) of curves (t, n, 3) at indices between their nodes."""
    row = np.arange(len(curves))
    low = np.minimum(index.astype(int), curves.shape[1] - 2)
    share = (index - low)[:, None]
    return np.asarray((1.0 - share) * curves[row, low] + share * curves[row, low + 1])


def _compared(points: Array, rod: RodFit, source: str) -> ContactPoints:
    away = np.linalg.norm(rod.centerline - points[:, None], axis=2)
    known = np.isfinite(away).all(axis=1)
    arc = np.full(len(points), np.nan)
    steps = np.linalg.norm(np.diff(rod.centerline[known], axis=1), axis=2)
    arc[known] = _lowest(away[known] ** 2) * steps.mean(axis=1)
    difference = np.linalg.norm(points - rod.contact_point, axis=1)
    return ContactPoints(points, arc, difference, source)


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
    """Assemble a recording of tracked whiskers."""
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
    """Variables of one whisker, with a whisker dimension of length 1, and so many shared errors."""
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
        # For tests with another cut-off.
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
