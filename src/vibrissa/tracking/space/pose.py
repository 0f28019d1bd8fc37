"""Pose of the head and of the whisker's base in every frame, and low-pass filtering over time.

Base point and emergence angles are found by the paper's method. Without contact, the rest shape
fitted to the whisker gives them all. In contact, the direction of the base is that of the tangent
there; the roll, which a bent whisker does not show, follows azimuth and elevation as in the frames
without contact. Finally all are filtered over time without phase shift. A straight whisker shows no
roll at all; then its y axis is assumed to be level.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import ndimage, signal, transform
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.space.rest_shape import RestShape, aligned_lengths, motions
from vibrissa.tracking.trace.trace import interpolated
from vibrissa.whisker import Whisker, angles_of, base_rotation

CUTOFF = 85.0
"""The paper's cut-off, Hz."""

_ORDER = 2  # order of the Butterworth filter, which is applied forward and backward
_LATE = 1e-6  # fraction of a frame by which a table of times may be too short
_SMALL = 0.05  # share of the times between frames that may be smaller than the usual small one
# Share of the whisker over which the tangent at the base is fitted, largest one of what is seen,
# and share of the frames that may show less.
_TANGENT, _MOST, _HIDDEN = 0.2, 0.6, 0.1
# Share of the whisker over which the rest shape is fitted to a frame's shape: tips are uncertain.
_WHOLE = 0.85
# Difference of a roll from the usual one at that azimuth and elevation above which a frame is not
# free, rad and in standard deviations; a median of absolute values in these; number of iterations.
_ROLLED, _UNUSUAL, _MEDIAN, _ROUNDS = np.deg2rad(15.0), 5.0, 0.6745, 4
_SLOW = 7  # number of free frames whose median shows slow changes of the roll


def usual_cutoff(rate: float) -> float | None:
    """Default cut-off at a frame rate, Hz; None if there is nothing above it to be removed."""
    return CUTOFF if 0.5 * rate > CUTOFF else None


def low_pass(values: ArrayLike, rate: ArrayLike, cutoff: float | None = CUTOFF) -> Array:
    """Filter a signal forward and backward, without phase shift.

    Instead of the rate, times of frames can be given, s. They may be unequally spaced, and where
    more than a period of the cut-off is missing, the parts before and after are filtered
    separately.
    """
    array = np.array(values, dtype=np.float64)
    if cutoff is None:
        return array
    given = np.asarray(rate, dtype=np.float64)
    time: Array = given if given.ndim else np.arange(len(array)) / given
    usual = 1.0 / float(np.median(np.diff(time))) if time.size > 1 else np.inf
    if not 0.0 < cutoff < 0.5 * usual:
        raise ValueError(
            f"cutoff is {cutoff!r} Hz; it must be positive and below half of {usual:.6g} frames/s"
            + (", times being in s" if given.ndim else "")
        )
    for piece in pieces(time, cutoff):
        if (steps := np.diff(time[piece])).size:
            # Where the rate changes the smaller steps count, but not times that are almost equal.
            step = float(np.quantile(steps, _SMALL))
            at = (time[piece] - time[piece.start]) / step
            array[piece] = _filtered(array[piece], at, 1.0 / step, cutoff)
    return array


def pieces(time: Array, cutoff: float) -> list[slice]:
    """Runs of frames between which more than a period of the cut-off is missing."""
    ends = [0, *(np.flatnonzero(np.diff(time) > 1.0 / cutoff) + 1).tolist(), len(time)]
    return [slice(*pair) for pair in itertools.pairwise(ends)]


def _filtered(array: Array, at: Array, rate: float, cutoff: float) -> Array:
    """Filter frames at these numbers, between which and at NaN values are interpolated."""
    flat = array.reshape(len(array), -1)
    known = np.isfinite(flat)
    sections = signal.butter(_ORDER, cutoff, fs=rate, output="sos")
    frames = np.arange(np.ceil(at[-1] - _LATE) + 1.0)
    pad = min(len(frames) - 1, round(3.0 * rate / cutoff))
    for k in range(flat.shape[1]):
        if known[:, k].sum() < 2:
            continue
        whole = np.interp(frames, at[known[:, k]], flat[known[:, k], k])
        filtered = np.interp(at, frames, signal.sosfiltfilt(sections, whole, padlen=pad))
        flat[:, k] = np.where(known[:, k], filtered, np.nan)
    return flat.reshape(array.shape)


@dataclass(frozen=True, eq=False)
class HeadPose:
    """Position and orientation of the head in every frame."""

    position: Array  # (time, 3), origin of the head's frame in the laboratory frame, m
    rotation: Array  # (time, 3, 3), rotation from the head's to the laboratory frame

    @classmethod
    def still(cls, count: int) -> HeadPose:
        """Head whose frame is that of the laboratory."""
        return cls(np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3)))

    @classmethod
    def of(cls, table: xr.Dataset, frames: NDArray[np.int64], rate: float) -> HeadPose:
        """Find the head's pose in some frames."""
        place = np.asarray(table["head_position"].values, dtype=np.float64)
        turn = np.asarray(table["head_rotation"].values, dtype=np.float64)
        if "frame" in table["head_position"].dims:
            known = table["frame"].values
            rows = np.clip(np.searchsorted(known, frames), 0, len(known) - 1)
            missing = frames[known[rows] != frames]
            if missing.size:
                raise ValueError(
                    f"the head's pose is given for {len(known)} frames, {known[0]} to "
                    f"{known[-1]}; it is missing for {missing.size} frames of the video, the first "
                    f"of which is {missing[0]}"
                )
            return cls(place[rows], turn[rows])
        known, wanted = table["time"].values, frames / rate
        late = _LATE / rate
        if len(known) < 2 or wanted[0] < known[0] - late or wanted[-1] > known[-1] + late:
            raise ValueError(
                f"the head's pose is given from {known[0]:g} to {known[-1]:g} s in {len(known)} "
                f"rows; the video lasts from {wanted[0]:g} to {wanted[-1]:g} s"
            )
        at = np.clip(wanted, known[0], known[-1])
        turned = transform.Slerp(known, transform.Rotation.from_matrix(turn))(at).as_matrix()
        return cls(interpolated(at, known, place), turned)

    def rows(self, frames: NDArray[np.intp]) -> HeadPose:
        """Select frames."""
        return HeadPose(self.position[frames], self.rotation[frames])

    def seen_from(self, points: Array) -> Array:
        """Transform points from the laboratory's frame to the head's."""
        away = _by_frame(points) - self.position[:, None]
        return np.asarray(away @ self.rotation).reshape(points.shape)

    def put_in(self, points: Array) -> Array:
        """Transform points from the head's frame to the laboratory's."""
        flat = _by_frame(points) @ np.swapaxes(self.rotation, 1, 2)
        return np.asarray(flat + self.position[:, None]).reshape(points.shape)


def _by_frame(points: Array) -> Array:
    """Points (time, ..., 3) as a list in each frame, (time, n, 3)."""
    return points.reshape(len(points), math.prod(points.shape[1:-1]), 3)


@dataclass(frozen=True, eq=False)
class BasePose:
    """Pose of a whisker's base in every frame."""

    position: Array  # (time, 3), base point, laboratory frame, m; NaN where it is not known
    # (time,) Emergence angles, rad.
    azimuth: Array
    elevation: Array
    roll: Array

    @property
    def rotation(self) -> Array:
        """Rotation from the whisker's to the laboratory frame, (time, 3, 3)."""
        return base_rotation(self.azimuth, self.elevation, self.roll)

    def rows(self, frames: slice) -> BasePose:
        """Select frames."""
        return BasePose(*(getattr(self, name)[frames] for name in vars(self)))

    def filtered(self, rate: ArrayLike, cutoff: float | None = CUTOFF) -> BasePose:
        """Filter everything over time, at a rate or at times of frames, as `low_pass`."""
        angles = np.stack([self.azimuth, self.elevation, self.roll], axis=1)
        known = np.isfinite(angles).all(axis=1)
        angles[known] = np.unwrap(angles[known], axis=0)
        smooth = low_pass(angles, rate, cutoff)
        return BasePose(low_pass(self.position, rate, cutoff), *smooth.T)


def base_pose(curves: Array, shape: RestShape, whisker: Whisker) -> BasePose:
    """Find the pose of the whisker's base, frame by frame.

    Parameters
    ----------
    curves : array (time, node, 3)
        Points of the whisker in the laboratory, equally spaced from base to tip, m; NaN where it is
        missing.
    shape : RestShape
        Rest shape, with the frames that are free of contact.
    whisker : Whisker
        Whisker made of it.

    Returns
    -------
    BasePose
        Pose before it is filtered.
    """
    seen, spacing, shapes = seen_shapes(curves, shape)
    rotation, position = _put_on(curves, seen, shapes, shape, whisker)
    free = shape.still[seen]
    angles = _emergence(rotation, seen, free)
    if whisker.is_straight:
        # Nothing shows its roll; its y axis is assumed to be level.
        angles[:, 2] = np.where(np.isfinite(angles[:, 2]), 0.0, np.nan)
        rotation = base_rotation(*angles.T)
    touching = np.flatnonzero(seen)[~free]
    if touching.size and not free.any():
        angles[seen], position[seen] = _always_bent(shapes, spacing, angles[seen], shape, whisker)
    elif touching.size:
        local, start = tangents(shapes, spacing, whisker.length)
        # The fitted tangent differs from the whisker's as it does without contact.
        bias = np.median(np.einsum("tji,tj->ti", rotation[seen][free], local[free]), axis=0)
        offset = np.median(
            np.einsum("tji,tj->ti", rotation[seen][free], (start - position[seen])[free]), axis=0
        )
        guess = angles.copy()
        direction = local[~free]
        for _ in range(3):
            guess[touching, 2] = roll_like(angles, guess, shape.still)[touching]
            turned = base_rotation(*guess[touching].T)
            corrected = direction - (turned @ bias - turned[:, :, 0])
            guess[touching, :2] = _azimuth_elevation(corrected)
        angles = guess
        position[touching] = start[~free] - base_rotation(*angles[touching].T) @ offset
    return BasePose(position, *angles.T)


def rolled_over(curves: Array, shape: RestShape, whisker: Whisker) -> Mask:
    """Frames that resemble the rest shape only if the whisker is rolled as in no other frame.

    Contact that bends a whisker against its intrinsic bend makes it momentarily resemble that.
    """
    alike = shape.still.copy()
    if whisker.is_straight or not alike.any():
        return np.zeros(len(alike), dtype=np.bool_)
    seen, _, shapes = seen_shapes(curves, shape)
    rotation, _ = _put_on(curves, seen, shapes, shape, whisker)
    angles = _emergence(rotation, seen, alike[seen])
    for _ in range(_ROUNDS):
        away = np.abs(angles[:, 2] - roll_like(angles, angles, alike, 2 * _SLOW + 1))
        usual = float(np.median(away[alike])) / _MEDIAN
        alike = shape.still & (away < max(_UNUSUAL * usual, _ROLLED))
    return np.asarray(shape.free & (away >= max(_UNUSUAL * usual, _ROLLED)))


def seen_shapes(curves: Array, shape: RestShape) -> tuple[Mask, float, Array]:
    """Frames that show the whisker, and spacing and points of their shapes at equal lengths."""
    seen: Mask = np.all(np.isfinite(curves), axis=(1, 2))
    return seen, *aligned_lengths(curves[seen], shape.spacing)


def _put_on(
    curves: Array, seen: Mask, shapes: Array, shape: RestShape, whisker: Whisker
) -> tuple[Array, Array]:
    """Rotations and positions of the base that fit the rest shape to each shape."""
    rotation, position = np.full((len(seen), 3, 3), np.nan), np.full((len(seen), 3), np.nan)
    most = int(_WHOLE * min(curves.shape[1], len(shape.points)))
    known = np.minimum(np.isfinite(shapes[:, :, 0]).sum(axis=1), most)
    back = [
        motions(shape.points[None, :n], part[:n]) for n, part in zip(known, shapes, strict=True)
    ]
    turn = np.concatenate([b[0] for b in back])
    rotation[seen] = turn @ whisker.pose.rotation
    position[seen] = turn @ whisker.pose.origin + np.concatenate([b[1] for b in back])
    return rotation, position


def _emergence(rotation: Array, seen: Mask, free: Mask) -> Array:
    """Emergence angles (time, 3), with rolls within half a turn of their mean direction."""
    angles = angles_of(rotation)
    usual = float(np.angle(np.exp(1j * angles[seen, 2])[free if free.any() else ...].sum()))
    angles[:, 2] = usual + np.angle(np.exp(1j * (angles[:, 2] - usual)))
    return angles


def _always_bent(
    shapes: Array, spacing: float, angles: Array, shape: RestShape, whisker: Whisker
) -> tuple[Array, Array]:
    """Angles (time, 3) and base points (time, 3) if no frame is free; the roll is constant."""
    local, start = tangents(shapes, spacing, whisker.length)
    # The known shape gives the difference of the fitted tangent and its start from the whisker's.
    unit, begin = tangents(shape.points[None], spacing, whisker.length)
    upright = whisker.pose.rotation.T
    angles = angles.copy()
    for _ in range(3):
        turned = base_rotation(*angles.T)
        direction = local - (turned @ (upright @ unit[0]) - turned[:, :, 0])
        angles[:, :2] = _azimuth_elevation(direction)
    turned = base_rotation(*angles.T)
    return angles, start - turned @ (upright @ (begin[0] - whisker.pose.origin))


def _azimuth_elevation(direction: Array) -> Array:
    """Azimuth and elevation (time, 2) of directions of the base tangent, rad."""
    x, y, z = direction.T
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=1)


def tangents(shapes: Array, spacing: float, length: float) -> tuple[Array, Array]:
    """Unit tangents (time, 3) and points (time, 3) at the base, from a cubic over its beginning."""
    # A whisker may be much longer than what all views show of it, in some frames.
    shown = np.quantile(np.isfinite(shapes[:, :, 0]).sum(axis=1), _HIDDEN)
    count = max(6, min(int(_TANGENT * length / spacing), int(_MOST * shown)))
    s = np.arange(count) * spacing
    fit: Array = np.linalg.pinv(np.vander(s, 4, increasing=True))
    coefficients = np.einsum("kn,tni->tki", fit, shapes[:, :count])
    tangent = coefficients[:, 1]
    unit: Array = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    return unit, coefficients[:, 0]


def roll_like(known: Array, guess: Array, free: Mask, slow: int = _SLOW) -> Array:
    """Roll as a linear function of azimuth and elevation, as without contact, plus slow changes."""
    usable = free & np.isfinite(known).all(axis=1)
    design = np.column_stack([np.ones(usable.sum()), known[usable, :2]])
    middle = design.mean(axis=0)
    # With little motion a slope is not determined, and then none is used.
    pull = np.diag([0.0, 1e-3, 1e-3]) * usable.sum()
    center = design - np.array([0.0, *middle[1:]])
    slope = np.linalg.solve(center.T @ center + pull, center.T @ known[usable, 2])
    line: Array = slope[0] + (guess[:, :2] - middle[1:]) @ slope[1:]
    frames = np.arange(len(known))
    # At onset a contact is so light that its first frames count as free, though bent.
    left = ndimage.median_filter(known[usable, 2] - center @ slope, slow, mode="nearest")
    return np.asarray(line + np.interp(frames, frames[usable], left), dtype=np.float64)
