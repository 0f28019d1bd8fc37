"""The paper's way to signals: the tracked contact point, seen from the filtered base.

A table of contact points that was given to the tracker counts more than the points it found.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vibrissa.pipeline.frames import needed, one_whisker
from vibrissa.pipeline.laboratory import cross_matrices
from vibrissa.pipeline.slopes import wrench_slopes
from vibrissa.recording import Group, Recording, recorded
from vibrissa.rod import PointContact, deflect
from vibrissa.status import Status
from vibrissa.tracking import CUTOFF, BasePose, HeadPose
from vibrissa.whisker import Whisker, angles_of

Array = NDArray[np.float64]


class Pose(NamedTuple):
    """How one whisker is held, frame by frame, laboratory frame."""

    rotation: Array
    position: Array
    covariance: Array


def paper_pose(recording: Recording, cutoff: float | None) -> list[Pose]:
    """How each whisker is held, filtered: from before the rod was fitted, or the recording's own.

    What is filtered is how it is held relative to the head.
    """
    root = recording.root
    head = HeadPose.still(root.data.sizes["time"])
    if "head_position" in root and "head_rotation" in root:
        head = HeadPose(root["head_position"], root["head_rotation"])
    rate, cutoff = _rate(root.data["time"].values, cutoff)
    measured = recording.find("measured")
    if measured is not None and "base_azimuth" not in measured:
        measured = None
    prefix = "unfiltered_"
    if measured is None:
        needed(root.data, ("contact_point", "base_position", "base_rotation"), "contact point")
    elif f"{prefix}base_azimuth" not in measured:
        if measured.data.attrs.get("cutoff", CUTOFF) != cutoff:
            raise ValueError(
                f"the pose of this recording is kept as it was filtered; a cut-off of {cutoff} Hz "
                "needs the unfiltered one: track the videos again"
            )
        prefix, cutoff = "", None
    poses = []
    for k, own in enumerate(root.each_whisker()):
        if measured is None:
            place = own["base_position"]
            angles = angles_of(np.swapaxes(head.rotation, 1, 2) @ own["base_rotation"]).T
        else:
            one = measured.whisker(k)
            place = one[f"{prefix}base_position"]
            names = ("azimuth", "elevation", "roll")
            angles = np.stack([one[f"{prefix}base_{name}"] for name in names])
        pose = BasePose(head.seen_from(place), *angles).filtered(rate, cutoff)
        rotation, position = head.rotation @ pose.rotation, head.put_in(pose.position)
        poses.append(Pose(rotation, position, _pose_covariance(own, rotation, position)))
    return poses


def _rate(time: Array, cutoff: float | None) -> tuple[float, float | None]:
    """Frames per second, and the cut-off; a single frame is not filtered."""
    if time.size < 2:
        return 1.0, None
    step = float(np.median(np.diff(time)))
    if not step > 0.0:
        raise ValueError(f"the times of the frames must rise; the usual step is {step} s")
    return 1.0 / step, cutoff


def _pose_covariance(own: Group, rotation: Array, position: Array) -> Array:
    """Covariance (time, 6, 6) of a pose beside that of the recording.

    As far as they differ, which is hardly of the same cause, the recording's counts as the truth,
    within its own covariance.
    """
    out = np.zeros((len(rotation), 6, 6))
    if "pose_covariance" not in own:
        return out
    out += own["pose_covariance"]
    turned = own["base_rotation"]
    there = np.isfinite(turned.sum(axis=(1, 2)) + rotation.sum(axis=(1, 2)))
    if "in_contact" in own:
        there &= own["in_contact"]
    if not there.any():
        return out
    turn = Rotation.from_matrix(rotation[there] @ np.swapaxes(turned[there], 1, 2)).as_rotvec()
    shift = (position - own["base_position"])[there]
    away = np.concatenate([shift, turn], axis=1)
    return np.asarray(out + away.T @ away / len(away))


def signals_by_point(
    one: Group,
    given: Array | None,
    pose: Pose,
    whisker: Whisker,
    proximal: float,
) -> xr.Dataset:
    """Give the signals of the rod that passes through the tracked contact point."""
    rotation, position = pose.rotation, pose.position
    point = one["contact_point"]
    told = np.zeros(len(point), dtype=bool)
    if given is not None:
        told = np.asarray(np.isfinite(given).all(axis=1))
        point = np.where(told[:, None], given, point)
    held = np.isfinite(rotation.sum(axis=(1, 2)) + position.sum(axis=1))
    touching = np.isfinite(point).all(axis=1)
    if "in_contact" in one:
        touching = told | one["in_contact"]
    local = np.einsum("tji,tj->ti", rotation, point - position)
    bent = deflect(whisker, PointContact(local[touching]), proximal=proximal)
    status = np.where(held, int(Status.NO_CONTACT), int(Status.MISSING))
    status[touching] = bent.status
    wrench = {}
    for name, values in (("force", bent.force), ("moment", bent.moment)):
        wrench[name] = np.where(held[:, None], 0.0, np.nan) * np.ones(3)
        wrench[name][touching] = values
    data = one_whisker(
        {
            **wrench,
            "base_position": position,
            "base_rotation": rotation,
            "in_contact": touching & held,
        },
        status,
    )
    if "contact_covariance" not in one:
        return data
    slopes = np.zeros((len(point), 6, 3))
    slopes[touching] = wrench_slopes(whisker, bent.arc_length, bent.contact_force)
    slopes = slopes @ np.swapaxes(rotation, 1, 2)
    spread = one["contact_covariance"]
    spread = np.where(touching[:, None, None], spread, 0.0)
    spread[told] = np.nan
    # The point is seen from a base that is a little elsewhere and turned by a little.
    moved = np.concatenate(
        [-np.eye(3) + np.zeros_like(spread), cross_matrices(point - position)], 2
    )
    moved = np.where(touching[:, None, None], moved, 0.0)
    both = pose.covariance @ np.swapaxes(moved, 1, 2)
    squares = {
        "wrench_covariance": slopes @ (spread + moved @ both) @ np.swapaxes(slopes, 1, 2),
        "pose_covariance": pose.covariance,
        "pose_wrench_covariance": both @ np.swapaxes(slopes, 1, 2),
    }
    return data.assign({name: recorded(name, square) for name, square in squares.items()})
