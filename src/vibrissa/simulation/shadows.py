"""What objects hide from a camera, for any object that knows its signed distance.

Along a line of sight the distance to the nearest surface is also how far one may go without meeting
it, so that few steps lead past an object or into it. The least distance on the way says how much of
a pixel the object covers, to a fraction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera
from vibrissa.objects.surface import Surface

Array = NDArray[np.float64]

REACH = 0.15
"""How far before and behind the scene an object is looked for, m."""

_STEPS = 200
_COARSE = 8
_SOFT = 3.0


def hidden(points: Array, camera: Camera, objects: Sequence[Surface]) -> Array:
    """Say which points are hidden by an object."""
    flat = points.reshape(-1, 3)
    out = np.zeros(len(flat))
    known = np.isfinite(flat).all(axis=1)
    _, away = camera.rays(camera.project(flat[known]))
    step = 1.0 / _pixels_per_m(camera, flat[known].mean(axis=0)) if known.any() else 1.0
    for thing in objects:
        nearest = _least(thing, flat[known], -away, REACH, 0.5 * step)
        out[known] = np.maximum(out[known], nearest < -0.25 * step)
    return out.reshape(points.shape[:-1])


def silhouette(camera: Camera, objects: Sequence[Surface], center: Array, soft: float) -> Array:
    """Say how much of each pixel objects cover."""
    from scipy.special import ndtr

    width, height = camera.size
    covered = np.zeros((height, width))
    if not objects:
        return covered
    scale = _pixels_per_m(camera, center)
    margin = _COARSE + (_SOFT + 1.0) * soft
    rows, columns = np.arange(0, height + _COARSE, _COARSE), np.arange(0, width + _COARSE, _COARSE)
    corners = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    for thing in objects:
        rough = _nearest(camera, thing, corners, center, scale) * scale
        inside = rough < -margin
        near = np.abs(rough) <= margin
        for column, row in corners[inside]:
            covered[_block(row), _block(column)] = 1.0
        mask = np.zeros((height, width), dtype=bool)
        for column, row in corners[near]:
            mask[_block(row), _block(column)] = True
        pixels = np.stack(np.nonzero(mask)[::-1], axis=-1)
        if len(pixels):
            distance = _nearest(camera, thing, pixels, center, scale) * scale
            covered[mask] = np.maximum(covered[mask], ndtr(-distance / soft))
    return covered


def _block(place: int) -> slice:
    """Pixels that are nearest to a corner."""
    return slice(max(place - _COARSE // 2, 0), place + _COARSE // 2)


def _pixels_per_m(camera: Camera, point: Array) -> float:
    return float(np.linalg.norm(camera.project_with_slopes(point)[1]) / np.sqrt(2.0))


def _nearest(
    camera: Camera, thing: Surface, pixels: NDArray[np.int64], center: Array, scale: float
) -> Array:
    """Least distance of an object from the lines of sight, m."""
    origin, direction = camera.rays(pixels)
    along = ((center - origin) * direction).sum(axis=1) - REACH
    start = origin + along[:, None] * direction
    return _least(thing, start, direction, 2.0 * REACH, 0.5 / scale)


def _least(thing: Surface, start: Array, way: Array, reach: float, step: float) -> Array:
    """Least signed distance on the way from each start (n, 3), m."""
    least = np.full(len(start), np.inf)
    gone = np.zeros(len(start))
    active = np.arange(len(start))
    for _ in range(_STEPS):
        distance = thing.signed_distance(start[active] + gone[active, None] * way[active])
        least[active] = np.minimum(least[active], distance)
        gone[active] += np.maximum(np.abs(distance), step)
        # Deep inside nothing more is to be known.
        active = active[(gone[active] < reach) & (least[active] > -20.0 * step)]
        if not active.size:
            break
    return least
