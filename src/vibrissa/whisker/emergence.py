"""How a whisker leaves the face: azimuth, elevation and roll of its base.

    R = R_z(azimuth) R_y(−elevation) R_x(roll)

takes the whisker's frame to the one it stands in, whose z is up, so that the base tangent is
(cos el cos az, cos el sin az, sin el). At zero roll the whisker's y axis, the side it bends to, is
level and points to rising azimuth. A whisker and its mirror image in the y–z plane, one on each
side of a face, have azimuths az and π − az, the same elevation, and rolls ro and π − ro.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def base_rotation(azimuth: ArrayLike, elevation: ArrayLike, roll: ArrayLike) -> Array:
    """Turn emergence angles into rotations."""
    az, el, ro = np.broadcast_arrays(azimuth, elevation, roll)
    ca, sa = np.cos(az), np.sin(az)
    ce, se = np.cos(el), np.sin(el)
    cr, sr = np.cos(ro), np.sin(ro)
    tangent = np.stack([ca * ce, sa * ce, se], axis=-1)
    level = np.stack([-sa, ca, np.zeros_like(ca)], axis=-1)
    up = np.stack([-ca * se, -sa * se, ce], axis=-1)
    d1 = cr[..., None] * level + sr[..., None] * up
    d2 = cr[..., None] * up - sr[..., None] * level
    return np.stack([tangent, d1, d2], axis=-1)


def angles_of(rotation: Array) -> Array:
    """Say the emergence angles of orientations of the base."""
    azimuth = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    elevation = np.arcsin(np.clip(rotation[..., 2, 0], -1.0, 1.0))
    level = base_rotation(azimuth, elevation, 0.0 * azimuth)
    d1 = rotation[..., :, 1]
    across = (level[..., :, 1] * d1).sum(-1)
    up = (level[..., :, 2] * d1).sum(-1)
    return np.stack([azimuth, elevation, np.arctan2(up, across)], axis=-1)


def mirrored(angles: ArrayLike) -> Array:
    """Mirror emergence angles in the y–z plane, to the other side of a face."""
    azimuth, elevation, roll = np.moveaxis(np.asarray(angles, dtype=np.float64), -1, 0)
    return np.stack([np.pi - azimuth, elevation, np.pi - roll], axis=-1)
