"""How the whisker is held in every frame: base point and emergence angles, the paper's way.

Without contact the rest shape, put on the whisker, says all. In contact the direction of the base
is that of the tangent there; the roll, which a bent whisker does not show, follows the azimuth and
the elevation as it does in the frames without contact. At the end all is filtered over time without
phase shift. A straight whisker shows no roll at all; then its y axis is taken as level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.tracking.filtering import CUTOFF, low_pass
from vibrissa.tracking.rest import RestShape, aligned_lengths, motions
from vibrissa.whisker import Whisker, angles_of, base_rotation

Array = NDArray[np.float64]

_TANGENT = 0.2
"""Share of the whisker over which the tangent at the base is fitted."""

_WHOLE = 0.85


@dataclass(frozen=True, eq=False)
class BasePose:
    """How a whisker is held.

    Parameters
    ----------
    position : array (time, 3)
        Of the base, laboratory frame, m; NaN where it is not known.
    azimuth, elevation, roll : array (time,)
        Emergence angles, rad.
    """

    position: Array
    azimuth: Array
    elevation: Array
    roll: Array

    @property
    def rotation(self) -> Array:
        """From the whisker's to the laboratory frame, (time, 3, 3)."""
        return base_rotation(self.azimuth, self.elevation, self.roll)

    def filtered(self, rate: float, cutoff: float | None = CUTOFF) -> BasePose:
        """Filter everything over time.

        Parameters
        ----------
        rate : float
            Frames per second.
        cutoff : float, optional
            Hz; None filters nothing.

        Returns
        -------
        BasePose
            Without what is faster.
        """
        angles = np.stack([self.azimuth, self.elevation, self.roll], axis=1)
        known = np.isfinite(angles).all(axis=1)
        angles[known] = np.unwrap(angles[known], axis=0)
        smooth = low_pass(angles, rate, cutoff)
        return BasePose(low_pass(self.position, rate, cutoff), *smooth.T)


def base_pose(curves: Array, shape: RestShape, whisker: Whisker) -> BasePose:
    """Find how the whisker is held, frame by frame.

    Parameters
    ----------
    curves : array (time, node, 3)
        The whisker in the laboratory, equally spaced from base to tip, m; NaN where it is missing.
    shape : RestShape
        The rest shape, with the frames that are free of contact.
    whisker : Whisker
        Made of it.

    Returns
    -------
    BasePose
        Unfiltered.
    """
    n = len(curves)
    rotation, position = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    seen = np.isfinite(curves).all(axis=(1, 2))
    spacing, shapes = aligned_lengths(curves[seen], shape.spacing)
    most = int(_WHOLE * min(curves.shape[1], len(shape.points)))
    known = np.minimum(np.isfinite(shapes[:, :, 0]).sum(axis=1), most)
    free = shape.free[seen]
    back = [
        motions(shape.points[None, :n], part[:n]) for n, part in zip(known, shapes, strict=True)
    ]
    turn = np.concatenate([b[0] for b in back])
    shift = np.concatenate([b[1] for b in back])
    rotation[seen] = turn @ whisker.pose.rotation
    position[seen] = turn @ whisker.pose.origin + shift
    angles = angles_of(rotation)
    if whisker.is_straight:
        # Nothing shows its roll; its y axis is taken as level.
        angles[:, 2] = np.where(np.isfinite(angles[:, 2]), 0.0, np.nan)
        rotation = base_rotation(*angles.T)
    touching = np.flatnonzero(seen)[~free]
    if touching.size and not free.any():
        angles[seen], position[seen] = _always_bent(shapes, spacing, angles[seen], shape, whisker)
    elif touching.size:
        local, start = _tangents(shapes, spacing, whisker.length)
        # The fitted tangent differs from the whisker's by what it differs without contact.
        bias = np.median(np.einsum("tji,tj->ti", rotation[seen][free], local[free]), axis=0)
        offset = np.median(
            np.einsum("tji,tj->ti", rotation[seen][free], (start - position[seen])[free]), axis=0
        )
        guess = angles.copy()
        direction = local[~free]
        for _ in range(3):
            guess[touching, 2] = _roll_like(angles, guess, shape.free)[touching]
            turned = base_rotation(*guess[touching].T)
            corrected = direction - (turned @ bias - turned[:, :, 0])
            guess[touching, 0] = np.arctan2(corrected[:, 1], corrected[:, 0])
            guess[touching, 1] = np.arctan2(
                corrected[:, 2], np.hypot(corrected[:, 0], corrected[:, 1])
            )
        angles = guess
        position[touching] = start[~free] - base_rotation(*angles[touching].T) @ offset
    return BasePose(position, *angles.T)


def _always_bent(
    shapes: Array, spacing: float, angles: Array, shape: RestShape, whisker: Whisker
) -> tuple[Array, Array]:
    """Angles (time, 3) and places (time, 3) where no frame is free; the roll stays as it is."""
    local, start = _tangents(shapes, spacing, whisker.length)
    # The known shape says by what the fitted tangent and its start differ from the whisker's.
    unit, begin = _tangents(shape.points[None], spacing, whisker.length)
    upright = whisker.pose.rotation.T
    angles = angles.copy()
    for _ in range(3):
        turned = base_rotation(*angles.T)
        direction = local - (turned @ (upright @ unit[0]) - turned[:, :, 0])
        angles[:, 0] = np.arctan2(direction[:, 1], direction[:, 0])
        angles[:, 1] = np.arctan2(direction[:, 2], np.hypot(*direction[:, :2].T))
    turned = base_rotation(*angles.T)
    return angles, start - turned @ (upright @ (begin[0] - whisker.pose.origin))


def _tangents(shapes: Array, spacing: float, length: float) -> tuple[Array, Array]:
    """Unit tangents (time, 3) and points (time, 3) at the base, from a cubic over its beginning."""
    count = max(6, int(_TANGENT * length / spacing))
    s = np.arange(count) * spacing
    fit: Array = np.linalg.pinv(np.vander(s, 4, increasing=True))
    coefficients = np.einsum("kn,tni->tki", fit, shapes[:, :count])
    tangent = coefficients[:, 1]
    unit: Array = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    return unit, coefficients[:, 0]


def _roll_like(known: Array, guess: Array, free: NDArray[np.bool_]) -> Array:
    """Roll as a linear function of azimuth and elevation, as without contact; plus slow changes."""
    usable = free & np.isfinite(known).all(axis=1)
    design = np.column_stack([np.ones(usable.sum()), known[usable, :2]])
    middle = design.mean(axis=0)
    # With little movement a slope is not known, and then none is used.
    pull = np.diag([0.0, 1e-3, 1e-3]) * usable.sum()
    center = design - np.array([0.0, *middle[1:]])
    slope = np.linalg.solve(center.T @ center + pull, center.T @ known[usable, 2])
    line: Array = slope[0] + (guess[:, :2] - middle[1:]) @ slope[1:]
    frames = np.arange(len(known))
    left = np.interp(frames, frames[usable], known[usable, 2] - line[usable])
    return np.asarray(line + left, dtype=np.float64)
