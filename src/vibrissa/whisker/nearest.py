"""Nearest points of a curve in many short chords."""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, inlined, kernel


@inlined
def _square(places: Array, a: int, b: int, x: float, y: float, z: float) -> tuple[float, float]:
    """Square of the distance of a point from the chord between two places, and where along it."""
    cx, cy, cz = (
        places[b, 0] - places[a, 0],
        places[b, 1] - places[a, 1],
        places[b, 2] - places[a, 2],
    )
    x, y, z = x - places[a, 0], y - places[a, 1], z - places[a, 2]
    t = min(max((cx * x + cy * y + cz * z) / (cx * cx + cy * cy + cz * cz), 0.0), 1.0)
    x, y, z = x - t * cx, y - t * cy, z - t * cz
    return x * x + y * y + z * z, t


@kernel
def nearest_on_chords(
    places: Array, bulge: Array, points: Array, distance: Array, position: Array
) -> None:
    """Distance of points (n, 3) from the chords between places, and where along the places.

    Positions count places. ``bulge`` (m,) bounds how far the chords of each of m equal blocks are
    from the chord of the block: that is all of it that most points need.
    """
    blocks = bulge.shape[0]
    size = (places.shape[0] - 1) // blocks
    squares = np.empty(blocks)
    for row in range(points.shape[0]):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        least, first = np.inf, 0
        for k in range(blocks):
            squares[k] = _square(places, k * size, (k + 1) * size, x, y, z)[0]
            if squares[k] < least:
                least, first = squares[k], k
        best, away, at = np.inf, np.inf, np.nan
        for n in range(-1, blocks if least < np.inf else -1):  # the nearest block, then all
            k = first if n < 0 else n
            if n == first or squares[k] > (away + bulge[k]) ** 2:
                continue
            for j in range(k * size, (k + 1) * size):
                square, t = _square(places, j, j + 1, x, y, z)
                if square < best:
                    best, at = square, j + t
            away = np.sqrt(best)
        distance[row], position[row] = away if best < np.inf else np.nan, at
