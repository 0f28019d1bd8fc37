"""Grids of points for drawing: touched parts of fitted shapes, and error ellipsoids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contour.fitted_shape import FittedShape, check_variances
from vibrissa.contour.free_surface import FreeFit
from vibrissa.contour.simple_shapes import CylinderFit, PlaneFit, SphereFit, frame_across
from vibrissa.deferred import special
from vibrissa.numerics import Array
from vibrissa.quantities import attributes

_INWARD = 0.9  # largest depth of a free surface inside its base, over the radius
_OPEN_GAP = np.pi / 3.0  # gap between azimuths above which a shape is drawn open
_MARGIN = 0.15  # margin of a drawn surface around the points, over their extent


def surface_grid(shape: FittedShape, points: ArrayLike, count: int = 41) -> xr.Dataset:
    """Compute a grid over the touched part of a fitted shape.

    Parameters
    ----------
    shape : CylinderFit, SphereFit, PlaneFit or FreeFit
        Fitted shape.
    points : array_like (n, 3)
        Contact points, in the frame of the shape, m; rows with NaN are ignored.
    count : int
        Number of grid points along each of the two directions.

    Returns
    -------
    xarray.Dataset
        Dataset of dimensions u, v, space: ``surface_grid_point`` and its standard deviation
        ``surface_sigma`` normal to the surface, m; infinite where the surface is not known because
        the deviation from the simple shape would pass through its centre.
    """
    if count < 2:
        raise ValueError(f"count is {count}; at least 2 are needed")
    p = np.asarray(points, dtype=np.float64)
    p = p[np.isfinite(p).all(axis=-1)].reshape(-1, 3)
    if not len(p):
        raise ValueError("no grid: no points")
    base = shape.base if isinstance(shape, FreeFit) else shape
    grid = _base_grid(base, p, count)
    beyond = np.zeros(grid.shape[:-1], dtype=bool)
    if isinstance(shape, FreeFit):
        added, _ = shape.deviation(grid)
        # Far from all contacts the surface must not pass through the centre of the base.
        deepest = _INWARD * getattr(base, "radius", np.inf)
        beyond, added = added > deepest, np.minimum(added, deepest)
        grid = grid - added[..., None] * base.outward_normals(grid)
    sigma = np.where(beyond, np.inf, shape.distance_sigma(grid))
    data = {
        "surface_grid_point": (("u", "v", "space"), grid, attributes("surface_grid_point")),
        "surface_sigma": (("u", "v"), sigma, attributes("surface_sigma")),
    }
    return xr.Dataset(data, {"space": list("xyz")}, {"shape": shape.kind})


def _base_grid(base: FittedShape, points: Array, count: int) -> Array:
    """Grid (count, count, 3) over a simple shape."""
    if isinstance(base, PlaneFit):
        first, second = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)[2][:2]
        first = first - (first @ base.normal) * base.normal
        first = first / np.linalg.norm(first)
        second = np.cross(base.normal, first)
        away = points - base.origin
        u, v = (_covered_range(away @ axis, count) for axis in (first, second))
        return np.asarray(base.origin + u[:, None, None] * first + v[:, None] * second)
    if isinstance(base, CylinderFit):
        across = frame_across(base.axis)
        away = points - base.origin
        u = _covered_angles(np.arctan2(away @ across[1], away @ across[0]), count)[:, None, None]
        v = _covered_range(away @ base.axis, count)[:, None]
        round_ = np.cos(u) * across[0] + np.sin(u) * across[1]
        return np.asarray(base.origin + base.radius * round_ + v * base.axis)
    assert isinstance(base, SphereFit)
    normal = base.outward_normals(points)
    pole = np.linalg.svd(normal, full_matrices=True)[2][-1]
    across = frame_across(pole)
    u = _covered_angles(np.arctan2(normal @ across[1], normal @ across[0]), count)[:, None, None]
    latitude = np.arcsin(np.clip(normal @ pole, -1.0, 1.0))
    v = np.clip(_covered_range(latitude, count), -0.5 * np.pi, 0.5 * np.pi)[:, None]
    round_ = np.cos(v) * (np.cos(u) * across[0] + np.sin(u) * across[1]) + np.sin(v) * pole
    return np.asarray(base.origin + base.radius * round_)


def _covered_range(values: Array, count: int) -> Array:
    """Evenly spaced values over the range of ``values``, with margins."""
    low, high = float(values.min()), float(values.max())
    beyond = _MARGIN * (high - low)
    return np.linspace(low - beyond, high + beyond, count)


def _covered_angles(angles: Array, count: int) -> Array:
    """Evenly spaced angles over the covered part of the circle."""
    order = np.sort(angles)
    gaps = np.diff(order, append=order[0] + 2.0 * np.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] < _OPEN_GAP:
        return np.linspace(-np.pi, np.pi, count)
    start = order[(widest + 1) % len(order)]
    width = 2.0 * np.pi - gaps[widest]
    beyond = min(_MARGIN * width, 0.5 * gaps[widest])
    return np.linspace(start - beyond, start + width + beyond, count)


class Ellipsoids(NamedTuple):
    """Ellipsoids about points.

    Attributes
    ----------
    semiaxes : array (..., 3)
        Lengths of the semiaxes, m, longest first; NaN where the covariance is.
    directions : array (..., 3, 3)
        Unit vectors along the semiaxes, in rows, right-handed.
    """

    semiaxes: Array
    directions: Array


def ellipsoids(covariance: ArrayLike, share: float = 0.95) -> Ellipsoids:
    """Compute ellipsoids that contain points with a given probability.

    Parameters
    ----------
    covariance : array_like (..., 3, 3)
        Covariance of points with normally distributed errors, m².
    share : float
        Probability, between 0 and 1.

    Returns
    -------
    Ellipsoids
        Semiaxes and their directions.

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
    check_variances(size)
    axes = np.swapaxes(direction, -1, -2)[..., ::-1, :]
    axes = np.concatenate(
        [axes[..., :2, :], np.cross(axes[..., :1, :], axes[..., 1:2, :])], axis=-2
    )
    half = np.sqrt(special.chdtri(3, 1.0 - share) * np.maximum(size[..., ::-1], 0.0))
    return Ellipsoids(
        np.where(known[..., None], half, np.nan), np.where(known[..., None, None], axes, np.nan)
    )
