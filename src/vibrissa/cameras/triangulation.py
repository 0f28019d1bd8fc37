"""Points in space from the pixels of several views, with their covariance.

One view does not show how far away a point is: it is then taken to be in the laboratory's plane
z = 0, in which the paper's top view looks down on x and y.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.cameras.camera import Camera
from vibrissa.numerics import Array

_STEEP = 0.2
"""Smallest sine of the angle between a single camera's line of sight and the plane z = 0."""


def triangulate(
    cameras: Sequence[Camera], pixels: ArrayLike, sigma: ArrayLike = 1.0
) -> tuple[Array, Array]:
    """Find the points that cameras see.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of the views; the points of a single one are those in the plane z = 0.
    pixels : array_like (camera, ..., 2)
        Column and row at which each camera sees each point; NaN gives NaN.
    sigma : array_like
        Standard deviation of a pixel coordinate, broadcast to (camera, ...).

    Returns
    -------
    points : array (..., 3)
        Points that are seen nearest to the pixels, each weighted by its sigma, m.
    covariance : array (..., 3, 3)
        Covariance of the points, m².

    Raises
    ------
    ValueError
        If shapes do not fit, or a single camera looks along the plane z = 0.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    if not cameras or pixels.ndim < 2 or pixels.shape[0] != len(cameras):
        raise ValueError(
            f"{len(cameras)} cameras and pixels of shape {pixels.shape} do not fit; "
            "(camera, ..., 2) is needed"
        )
    if len(cameras) == 1:
        return _in_plane(cameras[0], pixels[0], np.broadcast_to(sigma, pixels.shape[:-1])[0])
    weight = 1.0 / np.broadcast_to(np.asarray(sigma, np.float64), pixels.shape[:-1])
    points = _nearest_to_rays(cameras, pixels)
    hessian = np.zeros((*points.shape, 3))
    for _ in range(8):
        hessian = np.zeros((*points.shape, 3))
        gradient = np.zeros(points.shape)
        for camera, wanted, w in zip(cameras, pixels, weight, strict=True):
            seen, slopes = camera.project_with_slopes(points)
            scaled = slopes * w[..., None, None]
            miss = (wanted - seen) * w[..., None]
            hessian += np.swapaxes(scaled, -1, -2) @ scaled
            gradient += (np.swapaxes(scaled, -1, -2) @ miss[..., None])[..., 0]
        step = np.linalg.solve(_regular(hessian), gradient[..., None])[..., 0]
        points = points + step
        if not np.nanmax(np.abs(step), initial=0.0) > 1e-12:
            break
    return points, np.asarray(np.linalg.inv(_regular(hessian)), dtype=np.float64)


def _in_plane(camera: Camera, pixels: Array, sigma: ArrayLike) -> tuple[Array, Array]:
    """Points (..., 3) of the plane z = 0, and their covariance, of which none is across it."""
    if abs(camera.rotation[2, 2]) < _STEEP:
        raise ValueError(
            f"camera {camera.name!r} looks along the plane z = 0 of the laboratory, in which what "
            "a single camera sees is taken to be; one is needed that looks down on it"
        )
    origin, direction = camera.rays(pixels)
    points = origin - direction * (origin[..., 2:] / direction[..., 2:])
    points[..., 2] = 0.0
    slopes = np.linalg.inv(camera.project_with_slopes(points)[1][..., :2])
    covariance = np.zeros((*points.shape, 3))
    inside = slopes @ np.swapaxes(slopes, -1, -2)
    covariance[..., :2, :2] = inside * np.square(sigma)[..., None, None]
    return points, covariance


def _regular(hessian: Array) -> Array:
    """Hessian of which parallel rays leave a finite, huge uncertainty; NaN stays NaN."""
    scale = np.trace(hessian, axis1=-2, axis2=-1)[..., None, None]
    floored: Array = hessian + 1e-12 * scale * np.eye(3)
    return floored


def _nearest_to_rays(cameras: Sequence[Camera], pixels: Array) -> Array:
    """Points (..., 3) that are nearest to all rays."""
    matrix: Array = np.zeros((*pixels.shape[1:-1], 3, 3))
    right: Array = np.zeros((*pixels.shape[1:-1], 3))
    for camera, seen in zip(cameras, pixels, strict=True):
        origin, direction = camera.rays(seen)
        across: Array = np.eye(3) - direction[..., :, None] * direction[..., None, :]
        matrix += across
        right += (across @ origin[..., None])[..., 0]
    solved = np.linalg.solve(_regular(matrix), right[..., None])[..., 0]
    return np.asarray(solved, dtype=np.float64)
