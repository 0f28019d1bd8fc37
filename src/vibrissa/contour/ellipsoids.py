"""Where contact points may be: ellipsoids that hold them with a given probability."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from vibrissa.contour.touches import Array


class Ellipsoids(NamedTuple):
    """Ellipsoids about points.

    Attributes
    ----------
    semiaxes : array (..., 3)
        Their lengths, m, the longest first; NaN where the covariance is.
    directions : array (..., 3, 3)
        Unit vectors along them, in rows, right-handed.
    """

    semiaxes: Array
    directions: Array

    def surface(self, points: ArrayLike, count: int = 21) -> Array:
        """Lay grids over them.

        Parameters
        ----------
        points : array_like (..., 3)
            Their centres, m.
        count : int
            Points of a grid in each of its two directions.

        Returns
        -------
        array (..., count, count, 3)
            Points of the ellipsoids, m.
        """
        u, v = np.meshgrid(
            np.linspace(0.0, 2.0 * np.pi, count), np.linspace(0.0, np.pi, count), indexing="ij"
        )
        ball = np.stack([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)], axis=-1)
        stretched = self.semiaxes[..., :, None] * self.directions
        away = np.einsum("uvk,...ki->...uvi", ball, stretched)
        return np.asarray(np.asarray(points, dtype=np.float64)[..., None, None, :] + away)


def ellipsoids(covariance: ArrayLike, share: float = 0.95) -> Ellipsoids:
    """Give the ellipsoids that hold points with a given probability.

    Parameters
    ----------
    covariance : array_like (..., 3, 3)
        Of points with normally distributed errors, m².
    share : float
        The probability, between 0 and 1.

    Returns
    -------
    Ellipsoids
        Semiaxes and their directions, ready to be drawn.

    Raises
    ------
    ValueError
        If the shape is wrong, or the share is not between 0 and 1.

    Examples
    --------
    >>> ellipsoids(np.diag([1.0, 4.0, 9.0])).semiaxes.round(2)
    array([8.39, 5.59, 2.8 ])
    """
    s = np.asarray(covariance, dtype=np.float64)
    if s.ndim < 2 or s.shape[-2:] != (3, 3):
        raise ValueError(f"covariance has shape {s.shape}; (..., 3, 3) is needed")
    if not 0.0 < share < 1.0:
        raise ValueError(f"share is {share!r}; it must be between 0 and 1")
    known = np.asarray(np.isfinite(s).all(axis=(-2, -1)))
    size, direction = np.linalg.eigh(np.where(known[..., None, None], s, np.eye(3)))
    axes = np.swapaxes(direction, -1, -2)[..., ::-1, :]
    axes = np.concatenate(
        [axes[..., :2, :], np.cross(axes[..., :1, :], axes[..., 1:2, :])], axis=-2
    )
    half = np.sqrt(chi2.ppf(share, 3) * np.maximum(size[..., ::-1], 0.0))
    return Ellipsoids(
        np.where(known[..., None], half, np.nan), np.where(known[..., None, None], axes, np.nan)
    )
