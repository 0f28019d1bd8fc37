"""From the whisker's frame to the laboratory: x_lab = R x_whisker + o."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def to_laboratory(points: ArrayLike, base_rotation: ArrayLike, base_position: ArrayLike) -> Array:
    """Bring points from the whisker's to the laboratory frame.

    Parameters
    ----------
    points : array_like (..., 3)
        In the whisker's frame, m; NaN stays NaN.
    base_rotation : array_like (..., 3, 3)
        From the whisker's to the laboratory frame; broadcasts with the points.
    base_position : array_like (..., 3)
        The whisker's base in the laboratory frame, m.

    Returns
    -------
    array (..., 3)
        In the laboratory frame, m.

    Examples
    --------
    >>> to_laboratory([1.0, 0.0, 0.0], np.eye(3), [0.0, 2.0, 0.0])
    array([1., 2., 0.])
    """
    p = np.asarray(points, dtype=np.float64)
    turned = np.einsum("...ij,...j->...i", np.asarray(base_rotation, dtype=np.float64), p)
    return np.asarray(turned + np.asarray(base_position, dtype=np.float64))


def covariance_to_laboratory(covariance: ArrayLike, base_rotation: ArrayLike) -> Array:
    """Turn covariances of points from the whisker's to the laboratory frame.

    Parameters
    ----------
    covariance : array_like (..., 3, 3)
        In the whisker's frame, m².
    base_rotation : array_like (..., 3, 3)
        From the whisker's to the laboratory frame; broadcasts with the covariances.

    Returns
    -------
    array (..., 3, 3)
        In the laboratory frame, m².
    """
    rotation = np.asarray(base_rotation, dtype=np.float64)
    turned = rotation @ np.asarray(covariance, dtype=np.float64) @ np.swapaxes(rotation, -1, -2)
    return np.asarray(turned, dtype=np.float64)
