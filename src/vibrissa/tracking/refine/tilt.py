"""Turns out of the image of a whisker that is filmed by one camera.

A whisker that is rotated by an angle θ about an axis in the image looks compressed across the axis,
by cos θ. If the axis is normal to the whisker, as when it rises, it looks shorter, and its
curvature larger by 1/cos²θ; if the axis is the whisker's own, as when it rolls, its curvature looks
smaller by cos θ, and its length as it is. Which of both it is, over a film, follows from the
lengths that are seen at different curvatures; if the tip is not seen, it is assumed to rise, which
changes the image more. θ is relative to the pose in which the whisker turns least.

Contact bends a whisker, too. There θ follows the azimuth of the base as in frames without contact.
The sign of θ is not shown by a distant camera, and does not matter in the plane of the image.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vibrissa.deferred import transform
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.refine.fit import RodFit
from vibrissa.tracking.space.pose import HeadPose, roll_like, seen_shapes, tangents
from vibrissa.tracking.space.rest_shape import (
    RestShape,
    differences,
    known_rest,
    turned_change,
)
from vibrissa.whisker import Pose, Whisker

# Share of the rest shape that a frame must show, and number of such frames from which turns follow.
_SHOWN, _FEWEST = 0.85, 8
# Smallest range of the apparent curvature that is a turn, smallest change of the shape by it, in
# usual deviations from the rest shape, and percentiles that are left out of the range. Of a nearly
# straight whisker errors of the traces change the curvature most.
_VISIBLE, _CLEAR, _TAILS = 0.03, 2.0, 2.0
# Change of the logarithm of the length with that of the curvature below which a whisker rises,
# where it is −1/2, and does not roll, where it is 0.
_RISES = -0.2
# Standard deviation of the logarithm of the apparent curvature of a whisker in contact: least,
# and as a share of how far it is from the usual one without contact.
_UNSURE, _ASTRAY = 0.03, 0.3
# Largest distance of a known whisker from its plane for one view, as a share of its length.
_IN_PLANE = 0.02
_FLAT = np.diag([1.0, 1.0, 1e-3])  # projection that leaves covariances regular


class Plane(NamedTuple):
    """Plane in which a whisker bends, frame by frame."""

    head: HeadPose | None  # frame in which it is z = 0; None if it is the image
    unsure: Array  # (time,), standard deviation of the logarithm of the curvature seen

    @property
    def turned(self) -> float:
        """Usual largest angle by which it turns out of the image, rad."""
        if self.head is None:
            return 0.0
        return float(np.arccos(np.percentile(self.head.rotation[:, 2, 2], 5.0)))


def plane_of(curves: Array, shape: RestShape, tips: Mask) -> Plane:
    """Plane in which a whisker bends that one camera films."""
    unsure = np.full(len(curves), _UNSURE)
    seen, spacing, shapes = seen_shapes(curves, shape)
    n = int(_SHOWN * len(shape.points))
    whole = np.isfinite(shapes[:, :n, 0]).all(axis=1)
    if (shape.still[seen] & whole).sum() < _FEWEST:
        return Plane(None, unsure)
    local, _ = tangents(shapes, spacing, shape.length)
    known = np.full((len(curves), 3), np.nan)
    known[seen, 0], known[:, 1] = np.unwrap(np.arctan2(local[:, 1], local[:, 0])), 0.0
    bent = np.full(len(shapes), np.nan)
    bent[whole] = differences(shapes[whole, :n], shape.points[:n])[1]
    known[seen, 2] = np.log1p(bent)
    free = shape.still & np.isfinite(known).all(axis=1)
    curvature = roll_like(known, known, free)
    curvature[free] = known[free, 2]  # measured, not expected
    usual = np.median(curvature[free])
    unsure = np.hypot(_UNSURE, _ASTRAY * np.nan_to_num(curvature - usual))
    low, high = np.percentile(curvature[seen], [_TAILS, 100.0 - _TAILS])
    moves = (high - low) * np.linalg.norm(turned_change(shape.points[:n])) / n**0.5
    if high - low < _VISIBLE or moves < _CLEAR * shape.noise:
        return Plane(None, unsure)
    lengths = np.linalg.norm(np.diff(curves, axis=1), axis=2).sum(axis=1)
    ends = free & tips
    rises = True
    if ends.sum() >= _FEWEST:
        x, y = curvature[ends], np.log(lengths[ends])
        x = x - x.mean()
        rises = bool(x @ (y - y.mean()) < _RISES * (x @ x))
    less = 0.5 * (low - curvature) if rises else curvature - high
    angle = np.arccos(np.exp(np.minimum(np.nan_to_num(less), 0.0)))
    axis = np.zeros((len(curves), 3))
    axis[seen] = local
    if rises:
        axis = np.stack([-axis[:, 1], axis[:, 0], axis[:, 2]], axis=1)
    turn = transform.Rotation.from_rotvec(angle[:, None] * axis).as_matrix()
    base = np.nan_to_num(curves[:, 0])
    return Plane(HeadPose(base - np.einsum("tij,tj->ti", turn, base), turn), unsure)


def unturned(curves: Array, plane: HeadPose) -> Array:
    """Curves in the image as curves in the planes that turn out of it."""
    back = np.linalg.inv(plane.rotation[:, :2, :2])
    flat = np.zeros_like(curves)
    flat[..., :2] = np.einsum("tij,tnj->tni", back, (curves - plane.position[:, None])[..., :2])
    flat[~np.isfinite(curves).all(axis=2)] = np.nan
    return flat


def projected(fit: RodFit, plane: HeadPose) -> RodFit:
    """The fit in the plane of the image: what is across it is left out."""
    turn, back = plane.rotation, np.swapaxes(plane.rotation, 1, 2)
    rotation = back @ fit.rotation
    upright = np.swapaxes(rotation, 1, 2)
    pose, wrench = np.zeros((2, len(turn), 6, 6))
    pose[:, :3, :3] = pose[:, 3:, 3:] = back
    wrench[:, :3, :3] = upright @ _FLAT @ turn @ rotation
    wrench[:, 3:, 3:] = upright @ np.diag([0.0, 0.0, 1.0]) @ turn @ rotation
    shared = fit.shared.copy()
    shared[..., :3] = fit.shared[..., :3] @ _FLAT
    shared[..., 3:9] = np.einsum("tij,tej->tei", pose, fit.shared[..., 3:9])
    shared[..., 9:] = np.einsum("tij,tej->tei", wrench, fit.shared[..., 9:])
    level = np.array([1.0, 1.0, 0.0])
    position, contact = fit.position * level, fit.contact_point * level
    load = np.einsum("tij,tj->ti", wrench, np.concatenate([fit.force, fit.moment], axis=1))
    level_force = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    return replace(
        fit,
        rotation=rotation,
        position=position,
        contact_point=contact,
        contact_point_whisker=np.einsum("tij,tj->ti", upright, contact - position),
        contact_covariance=_FLAT @ fit.contact_covariance @ _FLAT,
        shared=shared,
        force=(load * level_force)[:, :3],
        moment=(load * level_force)[:, 3:],
        wrench_covariance=wrench @ fit.wrench_covariance @ np.swapaxes(wrench, 1, 2),
        pose_covariance=pose @ fit.pose_covariance @ np.swapaxes(pose, 1, 2),
        pose_wrench_covariance=pose @ fit.pose_wrench_covariance @ np.swapaxes(wrench, 1, 2),
        centerline=fit.centerline * level,
    )


def known_flat(curves: Array, whisker: Whisker, free: float) -> tuple[RestShape, Whisker]:
    """Place a known whisker in the plane of a single view, on the side that fits."""
    away = float(np.abs(whisker.centerline()[:, 2]).max())
    most = _IN_PLANE * whisker.length
    if away > most:
        raise ValueError(
            f"the known whisker leaves its plane by {1e3 * away:.2f} mm; for one view "
            f"{100.0 * _IN_PLANE:g} % of its length, {1e3 * most:.2f} mm, are "
            "allowed: film it from two sides, or leave --whisker out"
        )
    sides = [transform.Rotation.from_rotvec([turn, 0.0, 0.0]).as_matrix() for turn in (0.0, np.pi)]
    laid = [replace(whisker, pose=Pose(turn, np.zeros(3))) for turn in sides]
    shapes = [known_rest(curves, one, free) for one in laid]
    return min(zip(shapes, laid, strict=True), key=lambda pair: pair[0].noise)
