"""Recordings of tracked whiskers.

Contact points that do not come from the fitted rod are marked by a person, or are the points of the
whisker nearest to a known object. They are compared with the contact points of the fitted rod. The
rod does not depend on the points of a person, so agreement confirms both. It does depend on a known
object, on whose surface its contacts are; the difference then shows how well the measured whisker
agrees with the object.

Remarks state what to know before results are believed, one sentence each: what would make results
wrong without any other sign, and what to do about it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
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
from vibrissa.tracking.refine.hook import Hook
from vibrissa.tracking.refine.inertia import Inertia
from vibrissa.tracking.refine.optics import Optics
from vibrissa.tracking.refine.peg import UncertainPeg
from vibrissa.tracking.refine.rods import TraceSeries
from vibrissa.tracking.space.frame_pairs import (
    NEAR,
    Traces,
    best_seen,
    clear_offsets,
    dropped_frames,
)
from vibrissa.tracking.space.pose import CUTOFF, BasePose, HeadPose
from vibrissa.tracking.space.rest_shape import Length, RestShape
from vibrissa.tracking.trace.start import base_gap
from vibrissa.tracking.trace.steady import slow_motion
from vibrissa.tracking.trace.trace import Trace, doubtful_frames
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
    """One whisker, tracked."""

    whisker: Whisker  # at rest
    traces: TraceSeries
    curves: Array  # (time, node, 3), merged from the views, laboratory frame, m
    covariance: Array  # (time, node, 3, 3), of the curves, m²
    shape: RestShape  # from which the whisker was taken
    pose: BasePose  # of the base relative to the head, filtered, by the paper's method
    unfiltered: BasePose  # pose before filtering
    touching: Mask  # (time,), whether the whisker is in contact
    fit: RodFit
    head: HeadPose  # its pose in these frames
    length: Length  # with a standard deviation of 0 where it is given
    peg: UncertainPeg | None = None  # that it touches, found in the images
    unlike: UncertainPeg | None = None  # one that images show, but how it bends contradicts
    scale: float = np.nan  # standard deviation of the logarithm of all forces; see `scale_sigma`
    hook: Hook | None = None  # of its traces at the base
    inertia: Inertia | None = None  # what its mass bends
    turned: float = 0.0  # by how much its curvature shows that it leaves the only view's plane, rad
    contacts: ContactPoints | None = None  # those that do not come from the rod


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
        "wrench_scale_sigma": one.scale,
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


_TURNED = np.radians(16.0)  # turn from which a whisker leaves the plane of a single view
# Misfit that is unusual, and the share of such frames above which there is a remark.
_STRANGE, _OFTEN = 2.0, 0.05
# Share of the uncertainty of contact points due to the cameras above which there is a remark.
_MOST = 0.7
# Relative standard deviation of a stated length of fur, and that of one not stated, m.
_FUR_KNOWN, _FUR_USUAL = 0.25, 0.8e-3
_APART = 2.0  # unusual distance between the bases of several views, pixels
# Slow motion of a camera above which there is a remark, pixels, and as a share of its shaking.
_SLOW, _MOSTLY = 0.25, 0.8
_BEYOND = 0.05  # share of the length beyond what is seen from which a contact is not seen
# Bending below which contacts are not detected, over the length, above which there is a remark.
_COARSE = 2e-3
_FEWEST = 8  # smallest number of frames to decide whether a whisker leaves the plane
_LEAST = 3  # smallest number of frames that show the whisker in all views, with its base
_FAR = 10.0  # distance between the bases of several views above which they differ, pixels
_SHARE = 0.03  # the same as a share of the whisker's length


def remarks_on_shaking(cameras: Sequence[Camera], traces: Sequence[Sequence[Trace]]) -> list[str]:
    """Report which cameras shake, and how accurately the shaking is measured."""
    shifts = [np.array([trace.shift for trace in row]) for row in traces]
    found = []
    for camera, shift in zip(cameras, shifts, strict=True):
        size, left = shift[:, :2].std(axis=0), shift[:, 2:].mean(axis=0)
        if size.any():
            found.append(
                f"{camera.name} shakes by {size[0]:.2f} pixels along columns and {size[1]:.2f} "
                "along rows (standard deviations), as static edges in its images show; traces are "
                f"shifted back, with errors of {left[0]:.2f} and {left[1]:.2f} pixels."
            )
            slow = float(slow_motion(shift[:, None, :2]).max())
            if slow > max(_SLOW, _MOSTLY * float(size.max())):
                found[-1] += (
                    f" Part of this is slow, or a step, of {2.0 * slow:.1f} pixels: it is unknown "
                    "at which moment the camera had its calibrated position, so that all contact "
                    "points may be shifted together (which their covariances include)."
                )
        elif np.isnan(left).any() and any(other[:, :2].any() for other in shifts):
            found.append(
                f"it is unknown whether {camera.name} shakes, too: the covariances assume that it "
                "shakes as much as the other camera."
            )
    return found


def remarks_on_optics(one: Tracked, optics: Optics | None, name: str) -> list[str]:
    """Report displacements of contact points due to unknown optics, if these dominate the error."""
    if optics is None:
        return []
    moved = np.linalg.norm(optics.displacements(one.fit.contact_point), axis=(0, 2))
    spread = np.sqrt(np.trace(one.fit.contact_covariance, axis1=1, axis2=2))
    if not np.isfinite(moved).any() or np.nanmedian(moved / spread) < _MOST:
        return []
    state = "State the distance of the lenses (--distance, in m; inf for telecentric ones), or c"
    state = "C" if optics.distance is not None else state
    return [
        f"{name}: the cameras are not calibrated, so that contact points are uncertain by "
        f"{1e6 * np.nanmedian(moved):.0f} µm (median; their covariances include this, that of an "
        f"object fitted to them does not). {state}alibrate them (vibrissa calibrate, --cameras)."
    ]


def unexplained_frames(misfit: Array) -> Mask:
    """Frames whose traces the rod does not explain, by their misfits; empty if they are few."""
    strange = np.nan_to_num(misfit) > _STRANGE
    return np.asarray(strange & (strange.mean() > _OFTEN))


def remarks_on(
    cameras: Sequence[Camera], series: TraceSeries, length: Length, misfit: Array, name: str
) -> list[str]:
    """Report what is unusual about a tracked whisker."""
    found = []
    gap = usual_gap(cameras, series)
    if gap > _APART:
        found.append(
            f"{name}: its base is seen {gap:.1f} pixels from where the other view shows it "
            "(median); with a good calibration it is less than one."
        )
    seen = np.isfinite(series.line[:, :, 0, 0])
    outside = int((seen & (series.ends[:, :, 0] < 0.5)).any(axis=1).sum())
    if outside:
        found.append(
            f"{name}: in {outside} frames a view does not show its base; they are left out."
        )
    strange = int(unexplained_frames(misfit).sum())
    if strange:
        found.append(
            f"{name}: in {strange} frames the bent rod does not explain the traces (trace_misfit "
            f"above {_STRANGE:g}): they are on something else, or the whisker is bent by its "
            "inertia or by a second contact. Results of these frames are unreliable."
        )
    if np.isnan(length.sigma):
        found.append(
            f"{name}: its tip is not visible, and it is not bent enough to show its length; it is "
            f"at least {1e3 * length.value:.1f} mm long. Contacts need its true length: state it "
            "(--length)."
        )
    elif length.sigma > 0.0 and not length.seen:
        found.append(
            f"{name}: its tip is too faint to be seen, or outside of the image; its bending shows "
            f"that it is {1e3 * length.value:.1f} ± {1e3 * length.sigma:.1f} mm long, which all "
            "covariances include."
        )
    return found


def remarks_on_unseen_contacts(one: Tracked, name: str) -> list[str]:
    """Report contacts beyond what is seen of a whisker, as behind an object or off the image."""
    arcs = one.fit.arc_length
    shown = np.linalg.norm(np.diff(one.curves, axis=1), axis=2).sum(axis=1)
    far = _BEYOND * one.length.value
    count, unseen = int(np.isfinite(arcs).sum()), int((arcs > shown + far).sum())
    if not unseen:
        return []
    length = "" if one.length.seen else "its length (--length) or "
    return [
        f"not sure where {name} touches: in {unseen} of {count} frames in contact that is beyond "
        "what is seen of it, and follows from how the part before it bends. Film more of "
        f"the whisker, or state {length}what it touches (--objects)."
    ]


def remarks_on_peg(one: Tracked, name: str) -> list[str]:
    """Report the peg that was found in the images, as it would be stated, or why it is not used."""
    if one.unlike is not None:
        return [
            f"{name} touches what looks like a round peg of {2e3 * one.unlike.expected.radius:.3f} "
            "mm in both views, but bends otherwise than on it, and its contacts are not fitted on "
            "it: it may not be round, may move, or the cameras may not be as stated. State what it "
            "touches, if it is known (--objects)."
        ]
    if one.peg is None:
        return []
    peg = one.peg.expected
    vectors = 1e3 * peg.origin, peg.axis
    position, axis = (", ".join(f"{x:z.3f}" for x in vector) for vector in vectors)
    return [
        f"{name} touches a peg that both views show, and its contacts are fitted on it: diameter "
        f"{2e3 * peg.radius:.3f} ± {2e3 * one.peg.radius_sigma:.3f} mm, position [{position}] mm, "
        f"axis [{axis}]. If it touches something else, state that (--objects), or --no-find-peg."
    ]


def remarks_on_rest(one: Tracked, name: str) -> list[str]:
    """Report contacts that are too light to be distinguished from errors of the traces."""
    least = one.shape.undetected
    if least <= _COARSE * one.length.value:
        return []
    free, count = int(one.shape.free.sum()), int(np.isfinite(one.shape.deviation).sum())
    return [
        f"{name}: its shapes in the {free} of {count} frames taken to be free of contact differ by "
        f"up to {1e6 * least:.0f} µm (root mean square along it), as traces scatter: contacts that "
        "bend it by less are not found, and their frames counted as free."
    ]


def remarks_on_row(exchanges: int, left_out: int, name: str) -> list[str]:
    """Frames in which a whisker of a row had another one's traces."""
    found = []
    if exchanges:
        found.append(
            f"{name}: in {exchanges} frames its trace was exchanged with a neighbour's, as its "
            "shape and base in both views then agree with the other frames."
        )
    if left_out:
        found.append(
            f"{name}: in {left_out} frames the bent rod does not explain the traces (a misfit "
            f"above {_STRANGE:g} and far above its usual one), as where one of them is a "
            "neighbour's: they are left out (confidence 0, status MISSING). Compare traces and "
            "video (vibrissa correct)."
        )
    return found


def remarks_on_following(
    cameras: Sequence[Camera], rows: Sequence[Sequence[Trace]], name: str
) -> list[str]:
    """Report views in which a whisker is often lost, or differs from the frame before."""
    counts = [int(doubtful_frames(row).sum()) for row in rows]
    return [
        f"not sure: in {count} of {len(row)} frames {camera.name} loses {name}, or sees its length "
        "jump or a hook in it, as if something else was followed. Compare traces and video "
        "(vibrissa correct)."
        for camera, row, count in zip(cameras, rows, counts, strict=True)
        if count
    ]


def remarks_on_bases(
    cameras: Sequence[Camera],
    shown: Sequence[Sequence[Trace]],
    used: Sequence[Sequence[Trace]],
    scaled: bool,
    name: str,
) -> list[str]:
    """Report views in which a whisker is seen from closer to its base than in the other view."""
    found = []
    for camera, before, after in zip(cameras, shown, used, strict=True):
        both = [(a.length, b.length) for a, b in zip(before, after, strict=True) if len(a.line)]
        if not both:
            continue
        cut = float(np.median([a - b for a, b in both]))
        if cut > _APART:
            stated = f", before which {camera.name} shows the stated radius" if scaled else ""
            found.append(
                f"{name}: {camera.name} shows {cut:.0f} pixels more of it near its base than the "
                f"other view (median); the first point that both show is used as base{stated}."
            )
    return found


def remarks_on_hook(one: Tracked, name: str) -> list[str]:
    """Report a part at the base over which traces are not on the whisker."""
    if one.hook is None:
        return []
    over = 1e3 * one.hook.share * one.shape.length
    largest = float(np.linalg.norm(one.hook.aside, axis=1).max())
    return [
        f"{name}: over {over:.1f} mm next to its base its traces are on something else in all "
        "frames, such as fur, a hair or a neighbour that was cut, up to "
        f"{1e6 * largest:.0f} µm from it: it is taken to go on there as smoothly as beyond, and "
        f"its base to be known to {1e6 * one.hook.sigma:.0f} µm."
    ]


def force_scale(whisker: Whisker, hidden: float) -> float:
    """Factor of all forces if the whisker's radius is that at this distance before its base, m."""
    at_edge, at_tip = whisker.radius(np.array([0.0, whisker.length]))
    # Forces scale with the fourth power of the radius, which decreases linearly along the whisker.
    return float((1.0 + (1.0 - at_tip / at_edge) * hidden / whisker.length) ** 4)


def scale_sigma(whisker: Whisker, fur: float, more: float) -> float:
    """Standard deviation of the logarithm of the scale that all forces of a whisker share.

    Fur hides a length before the view that shows most of it, m, or one that is not stated (0), and
    one view hides more.
    """
    unknown = _FUR_KNOWN * fur if fur > 0.0 else _FUR_USUAL
    return float(np.log(force_scale(whisker, float(np.hypot(unknown, _FUR_KNOWN * more)))))


def remarks_on_fur(one: Tracked, fur: float, name: str) -> list[str]:
    """Report the common error of all forces, if any, due to fur over the base."""
    if not np.isfinite(one.scale):
        return []
    error = (
        f"one error of all its forces and moments, {100.0 * one.scale:.1f} % (standard deviation), "
        "which is in no covariance (wrench_scale_sigma)"
    )
    if fur == 0.0:
        percent = 100.0 * (force_scale(one.whisker, 1e-3) - 1.0)
        return [
            f"{name}: its radius is taken to be stated where it is first seen. If it is that where "
            f"the whisker leaves the skin, all forces and moments are {percent:.0f} % too large "
            "for each millimetre that fur hides: state how much that is (--fur). Unstated, it is "
            f"{error}."
        ]
    hidden = f"{1e3 * fur:g} ± {1e3 * _FUR_KNOWN * fur:.2g} mm"
    return [
        f"{name}: {hidden} of its base are taken to be hidden by fur; what is not known of that is "
        f"{error}. They are those where the fur ends."
    ]


def remarks_on_plane(one: Tracked, name: str) -> list[str]:
    """Report how far a whisker may leave the plane of the only view, and the effect on contacts."""
    tips = one.traces.ends.all(axis=(1, 2)) & np.isfinite(one.curves).all(axis=(1, 2))
    signs, turned = [], one.turned
    if tips.sum() >= _FEWEST:
        lengths = np.linalg.norm(np.diff(one.curves[tips], axis=1), axis=2).sum(axis=1)
        short, long = np.percentile(lengths, [5.0, 95.0])
        signs.append(
            f"it is seen {1e3 * short:.1f} to {1e3 * long:.1f} mm long (5 and 95 % of the frames "
            "that show its tip)"
        )
        turned = max(turned, float(np.arccos(short / long)))
    if one.turned:
        signs.append("its curvature without contact changes")
    if not signs:
        return [f"{name}: too few frames show its tip to see whether it leaves the plane."]
    seen = f"{name}: {', and '.join(signs)}, "
    if turned < _TURNED:
        away = np.linalg.norm(one.fit.contact_point - one.fit.position, axis=1)
        deep = np.sin(turned) * float(np.nan_to_num(away).max())
        return [
            f"{seen}which does not exclude that it leaves the plane by "
            f"{np.degrees(turned):.0f}°: contact points may be {1e3 * deep:.1f} mm nearer to the "
            "camera or farther from it, which is in no covariance."
        ]
    assumed = "turns in contact as it does without" if one.turned else "stays in the plane"
    return [
        f"{seen}as if it turned out of the image by up to {np.degrees(turned):.0f}°. "
        "Contact is where it bends as no turn does: the lightest contacts are missed, and contact "
        f"points and forces assume that it {assumed}. How deep they are is unknown. A second view "
        "(or a mirror, --views) shows it."
    ]


def remarks_on_time(cameras: Sequence[Camera], traces: Traces, offset: int | None) -> list[str]:
    """Report cameras that seem not to be synchronous, offsets found, and dropped frames."""
    found = []
    first, *others = best_seen(traces)
    for view, frame, count, certain in dropped_frames(cameras, traces, offset):
        name, frames = cameras[view].name, f"{count} frame{'s' * (count > 1)}"
        shown = (
            f"before its frame {frame}: there the whisker takes {1 + count} of its steps at once "
            "in this view only"
        )
        if certain:
            late = f" Times count its frames, so that later ones are {count} too early."
            found.append(
                f"{name} dropped {frames} {shown}. Later frames are paired accordingly; record "
                f"without losses, as not all of them show.{late * (view == 0)}"
            )
        else:
            found.append(
                f"not sure: {name} may have dropped {frames} {shown}. If so, the views are out of "
                f"step by {count} from there on: compare the videos."
            )
    for camera, row in zip(cameras[1:], others, strict=True):
        shifts, determined = clear_offsets(cameras[0], camera, first, row, offset or 0)
        runs = [shift for shift, _ in groupby(shifts.tolist())]
        listed, names = ", ".join(map(str, runs)), f"{cameras[0].name} and {camera.name}"
        if offset is None and determined:
            found.append(
                f"{names}: an offset of {listed} frames was found (to within {NEAR}); if this is "
                "impossible, state the right one (--offset)."
            )
        elif offset is None:
            found.append(
                f"{names}: the views do not determine their offset, and 0 is kept; if they did not "
                "start together, state it (--offset)."
            )
        elif runs != [offset]:
            found.append(
                f"{names} are out of step: with an offset of {listed} "
                f"frames instead of {offset} they agree better. Track with --offset auto; in files "
                "of other trackers, correct the numbers of the frames."
            )
    return found


def check_views(cameras: Sequence[Camera], series: TraceSeries, name: str) -> None:
    """Check that the views show one and the same whisker, from its base on."""
    seen = np.isfinite(series.line[:, :, 0, 0])
    whole = seen & (series.ends[:, :, 0] > 0.5)
    if seen.all(axis=1).sum() >= _LEAST > whole.all(axis=1).sum():
        rows = zip(cameras, seen.sum(axis=0), whole.sum(axis=0), strict=True)
        listed = ", ".join(f"{c.name} in {base} of {all_} frames" for c, all_, base in rows)
        raise ValueError(
            f"the border of the image cuts off the base of {name}, which is shown by {listed}: "
            "film it from its base on, or use a larger part of the image (--views)"
        )
    gap = usual_gap(cameras, series)
    lengths = np.linalg.norm(np.diff(series.line, axis=2), axis=3).sum(axis=2)
    allowed = max(_FAR, _SHARE * float(np.nanmax(lengths, initial=0.0)))
    if gap > allowed:
        raise ValueError(
            f"the views do not show one whisker: where they see the base of {name}, their lines of "
            f"sight pass each other by {gap:.0f} pixels (median). Check the order of the views, "
            "the cameras' calibration, and that all are of the same whisker from its base on; of "
            "videos, state where it begins in each (`vibrissa track --base`)"
        )


def usual_gap(cameras: Sequence[Camera], series: TraceSeries) -> float:
    """Typical distance of the base in each view from where all views together locate it, pixels."""
    rows = (series.ends[:, :, 0] > 0.5).all(axis=1)
    if not rows.any():
        return 0.0
    return float(np.median(base_gap(cameras, np.swapaxes(series.line[rows, :, 0], 0, 1))))


def pixel_at(cameras: Sequence[Camera], curves: Array) -> float:
    """Size of a pixel at a whisker, m, in the coarsest view."""
    seen = curves[np.isfinite(curves).all(axis=(1, 2))]
    if not len(seen):
        return 0.0
    base = np.median(seen[:, 0], axis=0)[None]
    scales = [np.linalg.norm(c.project_with_slopes(base)[1], axis=-1).max() for c in cameras]
    return float(1.0 / min(scales))
