"""How far contact points and fitted axes lie from a peg that is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def surface_distances(
    points: ArrayLike,
    origin: ArrayLike,
    axis: ArrayLike,
    radius: float,
    whisker_radius: ArrayLike = 0.0,
) -> Array:
    """Signed distances of the whisker's surface from a cylinder's.

    Parameters
    ----------
    points : array_like (..., 3)
        Contact points on the whisker's centreline, m.
    origin, axis : array_like (3,)
        A point, m, and the direction of the cylinder's axis, in the frame of the points.
    radius : float
        Of the cylinder, m.
    whisker_radius : array_like (...)
        Of the whisker at the contacts, m.

    Returns
    -------
    array (...)
        m; positive outside, zero where the surfaces touch.

    Examples
    --------
    >>> float(surface_distances([3.0, 0.0, 7.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 2.0, 0.5))
    0.5
    """
    direction = np.asarray(axis, dtype=np.float64)
    direction = direction / np.linalg.norm(direction)
    away = np.asarray(points, dtype=np.float64) - np.asarray(origin, dtype=np.float64)
    across = away - (away @ direction)[..., None] * direction
    return np.asarray(np.linalg.norm(across, axis=-1) - radius - np.asarray(whisker_radius))


def axis_offset(
    origin: ArrayLike, axis: ArrayLike, true_origin: ArrayLike, true_axis: ArrayLike
) -> tuple[Array, float]:
    """Say how far one axis lies from another.

    Parameters
    ----------
    origin, axis : array_like (3,)
        A point, m, and the direction of the axis in question; the offset is taken at this point.
    true_origin, true_axis : array_like (3,)
        A point and the direction of the axis it should be.

    Returns
    -------
    offset : array (3,)
        From the true axis to ``origin``, at right angles to the true axis, m.
    tilt : float
        Angle between the axes, rad, at most a quarter turn.
    """
    direction, true = (np.asarray(a, dtype=np.float64) for a in (axis, true_axis))
    direction, true = direction / np.linalg.norm(direction), true / np.linalg.norm(true)
    away = np.asarray(origin, dtype=np.float64) - np.asarray(true_origin, dtype=np.float64)
    offset = away - (away @ true) * true
    # From the cross product: the arc cosine loses half the digits of a small angle.
    tilt = np.arctan2(np.linalg.norm(np.cross(direction, true)), abs(direction @ true))
    return offset, float(tilt)
