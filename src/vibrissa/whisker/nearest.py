"""Nearest points on a polyline with many short chords."""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, inlined, kernel


@inlined
def _squared_distance(
    nodes: Array, a: int, b: int, x: float, y: float, z: float
) -> tuple[float, float]:
    """Squared distance of a point from the chord between two nodes, and position on the chord."""
    cx, cy, cz = (
        nodes[b, 0] - nodes[a, 0],
        nodes[b, 1] - nodes[a, 1],
        nodes[b, 2] - nodes[a, 2],
    )
    x, y, z = x - nodes[a, 0], y - nodes[a, 1], z - nodes[a, 2]
    t = min(max((cx * x + cy * y + cz * z) / (cx * cx + cy * cy + cz * cz), 0.0), 1.0)
    x, y, z = x - t * cx, y - t * cy, z - t * cz
    return x * x + y * y + z * z, t


@kernel
def nearest_on_chords(
    nodes: Array, bulge: Array, points: Array, distance: Array, position: Array
) -> None:
    """Compute distances (n,) of points (n, 3) from the polyline, and positions along it.

    Positions are in units of nodes. ``bulge`` (m,) bounds the distance of the chords in each of m
    equal blocks from the block's own chord, so that most blocks need not be searched.
    """
    blocks = bulge.shape[0]
    size = (nodes.shape[0] - 1) // blocks
    squares = np.empty(blocks)
    for row in range(points.shape[0]):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        least, first = np.inf, 0
        for k in range(blocks):
            squares[k] = _squared_distance(nodes, k * size, (k + 1) * size, x, y, z)[0]
            if squares[k] < least:
                least, first = squares[k], k
        best, away, at = np.inf, np.inf, np.nan
        for n in range(-1, blocks if least < np.inf else -1):  # first the nearest block, then all
            k = first if n < 0 else n
            if n == first or squares[k] > (away + bulge[k]) ** 2:
                continue
            for j in range(k * size, (k + 1) * size):
                square, t = _squared_distance(nodes, j, j + 1, x, y, z)
                if square < best:
                    best, at = square, j + t
            away = np.sqrt(best)
        distance[row], position[row] = away if best < np.inf else np.nan, at
