"""Pose of a whisker in its source frame, and emergence angles of its base.

The source frame is the one from which the whisker's points came:

    x_source = R x_whisker + o

`R` has the whisker's axes as columns (x along the base tangent, y toward the side to which it
bends) and `o` is its base point. Points transform with both, vectors (forces, directions) with `R`
alone; a moment about the base is a vector.

Azimuth, elevation and roll of the base describe how a whisker emerges from the face:

    R = R_z(azimuth) R_y(−elevation) R_x(roll)

maps the whisker's frame to a frame whose z is up, so that the base tangent is
(cos el cos az, cos el sin az, sin el). At zero roll the whisker's y axis, the side to which it
bends, is horizontal and points toward increasing azimuth. A whisker and its mirror image in the y–z
plane, one on each side of a face, have azimuths az and π − az, the same elevation, and rolls ro and
π − ro.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array, vectors as as_vectors

ORTHOGONALITY = 1e-6  # largest entry of RᵀR − 1 for a rotation, in float32 too


@dataclass(frozen=True, eq=False)
class Pose:
    """Rotation and origin of the whisker frame in its source frame.

    Parameters
    ----------
    rotation : array (3, 3)
        Columns are the whisker's x, y and z axis in the source frame.
    origin : array (3,)
        Base point of the whisker in the source frame, m.

    Examples
    --------
    >>> pose = Pose(origin=[0.0, 0.01, 0.0])
    >>> pose.to_source([1.0, 0.0, 0.0])
    array([1.  , 0.01, 0.  ])
    """

    rotation: Array = field(default_factory=lambda: np.eye(3))
    origin: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        origin = np.array(self.origin, dtype=np.float64)
        faults = []
        if rotation.shape != (3, 3) or not np.isfinite(rotation).all():
            faults.append(f"rotation has shape {rotation.shape}; a finite (3, 3) matrix is needed")
        elif np.abs(rotation.T @ rotation - np.eye(3)).max() > ORTHOGONALITY:
            faults.append("rotation is not orthogonal: its columns must be unit vectors at 90°")
        elif np.linalg.det(rotation) < 0.0:
            faults.append("rotation is a reflection; a right-handed frame is needed")
        if origin.shape != (3,) or not np.isfinite(origin).all():
            faults.append(f"origin is {self.origin!r}; three finite coordinates in m are needed")
        if faults:
            raise ValueError("no pose: " + "; ".join(faults))
        rotation.flags.writeable = False
        origin.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "origin", origin)

    def to_source(self, points: ArrayLike) -> Array:
        """Transform points from the whisker frame to the source frame.

        Parameters
        ----------
        points : array (..., 3)
            Points, m, whisker frame.

        Returns
        -------
        array (..., 3)
            Points, m, source frame.
        """
        return self.vectors_to_source(points) + self.origin

    def to_whisker(self, points: ArrayLike) -> Array:
        """Transform points from the source frame to the whisker frame.

        Parameters
        ----------
        points : array (..., 3)
            Points, m, source frame.

        Returns
        -------
        array (..., 3)
            Points, m, whisker frame.
        """
        return self.vectors_to_whisker(as_vectors("points", points) - self.origin)

    def vectors_to_source(self, vectors: ArrayLike) -> Array:
        """Rotate vectors from the whisker frame to the source frame.

        Parameters
        ----------
        vectors : array (..., 3)
            Vectors in any unit, whisker frame.

        Returns
        -------
        array (..., 3)
            The same vectors, source frame.
        """
        return as_vectors("vectors", vectors) @ self.rotation.T

    def vectors_to_whisker(self, vectors: ArrayLike) -> Array:
        """Rotate vectors from the source frame to the whisker frame.

        Parameters
        ----------
        vectors : array (..., 3)
            Vectors in any unit, source frame.

        Returns
        -------
        array (..., 3)
            The same vectors, whisker frame.
        """
        return as_vectors("vectors", vectors) @ self.rotation

    def __repr__(self) -> str:
        cosine = np.clip((np.trace(self.rotation) - 1.0) / 2.0, -1.0, 1.0)
        x, y, z = self.origin * 1e3
        angle = np.degrees(np.arccos(cosine))
        return f"Pose(origin=({x:z.3f}, {y:z.3f}, {z:z.3f}) mm, turned by {angle:.1f}°)"


def roll(angle: float) -> Array:
    """Rotation by `angle`, rad, about the x axis: columns (x, y', z')."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def least_turn(direction: ArrayLike) -> Array:
    """Rotation by the smallest angle that takes e_x to a unit vector (3,); about z if opposite."""
    x, y, z = np.asarray(direction, dtype=np.float64)
    rho2 = y * y + z * z
    if rho2 == 0.0:
        return np.diag([np.sign(x), np.sign(x), 1.0])
    # (1 − x)/ρ² = 1/(1 + x) without the cancellation near −e_x.
    w = (1.0 - x) / rho2 if x < 0.0 else 1.0 / (1.0 + x)
    yy, yz, zz = w * y * y, w * y * z, w * z * z
    return np.array([[x, -y, -z], [y, 1.0 - yy, -yz], [z, -yz, 1.0 - zz]])


def base_rotation(azimuth: ArrayLike, elevation: ArrayLike, roll: ArrayLike) -> Array:
    """Convert emergence angles into rotations.

    Parameters
    ----------
    azimuth, elevation, roll : array_like (...)
        Angles of the base, rad.

    Returns
    -------
    array (..., 3, 3)
        Rotation from the whisker's frame to that of the angles, R_z(azimuth) R_y(−elevation)
        R_x(roll).

    Examples
    --------
    >>> base_rotation(np.pi / 2, 0.0, 0.0).round(3)[:, 0]
    array([0., 1., 0.])
    """
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
    """Azimuth, elevation and roll (..., 3), rad: the inverse of `base_rotation`."""
    azimuth = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
    elevation = np.arcsin(np.clip(rotation[..., 2, 0], -1.0, 1.0))
    level = base_rotation(azimuth, elevation, 0.0 * azimuth)
    d1 = rotation[..., :, 1]
    across = (level[..., :, 1] * d1).sum(-1)
    up = (level[..., :, 2] * d1).sum(-1)
    return np.stack([azimuth, elevation, np.arctan2(up, across)], axis=-1)


def mirrored(angles: ArrayLike) -> Array:
    """Emergence angles of the mirror image in the y–z plane, on the other side of a face.

    Parameters
    ----------
    angles : array_like (..., 3)
        Azimuth, elevation and roll, rad.

    Returns
    -------
    array (..., 3)
        Angles of the mirror image.
    """
    azimuth, elevation, roll = np.moveaxis(np.asarray(angles, dtype=np.float64), -1, 0)
    return np.stack([np.pi - azimuth, elevation, np.pi - roll], axis=-1)
