"""Surfaces in the chart of contacts, as triangles whose corners are rows of the chart.

The skin of the chart, surfaces of equal value inside it (marching tetrahedra: each cell is six
tetrahedra, each of which a level crosses in one triangle or two), and what remains of triangles
where a column is positive. New corners lie on edges, where rows are interpolated linearly.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from vibrissa.plots.style import Array, Mask

_QUAD = ((0, 1, 2), (0, 2, 3))


def skin(nodes: Array, closed: bool) -> Array:
    """Triangles on the outside of a chart."""
    faces = [nodes[:, :, -1], nodes[0], nodes[-1]]
    if not closed:
        faces += [nodes[:, 0], nodes[:, -1]]
    return np.concatenate([_triangulated(face) for face in faces])


def _triangulated(face: Array) -> Array:
    """Two triangles for each cell of a face (m, n, k)."""
    corners = np.stack([face[:-1, :-1], face[1:, :-1], face[1:, 1:], face[:-1, 1:]], axis=2)
    corners = corners.reshape(-1, 4, face.shape[-1])
    return np.concatenate([corners[:, pick] for pick in _QUAD])


def level(nodes: Array, column: int, value: float) -> Array:
    """Triangles on which a column has a given value."""
    rows = nodes.reshape(-1, nodes.shape[-1])
    height = rows[:, column] - value
    corners = _tetrahedra(nodes.shape[:3])
    above = height[corners] > 0.0
    count = above.sum(axis=1)
    pieces = []
    # Corners above come first; an edge between one above and one below is crossed.
    for several, edges in (
        (1, ((0, 1), (0, 2), (0, 3))),
        (3, ((3, 0), (3, 1), (3, 2))),
        (2, ((0, 2), (0, 3), (1, 3), (1, 2))),
    ):
        cut = corners[count == several]
        order = np.argsort(~above[count == several], axis=1, kind="stable")
        cut = np.take_along_axis(cut, order, axis=1)
        places = np.stack([_crossing(rows[cut], height[cut], *edge) for edge in edges], axis=1)
        pieces += [places[:, pick] for pick in (_QUAD if several == 2 else ((0, 1, 2),))]
    return np.concatenate(pieces)


@lru_cache(maxsize=4)
def _tetrahedra(shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Nodes (n, 4) of six tetrahedra for each cell, all along the same diagonal."""
    index = np.arange(np.prod(shape), dtype=np.intp).reshape(shape)
    a, b, c = shape
    corner = {
        step: index[
            step[0] : a - 1 + step[0], step[1] : b - 1 + step[1], step[2] : c - 1 + step[2]
        ].ravel()
        for step in product((0, 1), repeat=3)
    }
    pieces = []
    for order in permutations(range(3)):
        step = [0, 0, 0]
        path = [corner[0, 0, 0]]
        for axis in order:
            step[axis] = 1
            path.append(corner[step[0], step[1], step[2]])
        pieces.append(np.stack(path, axis=1))
    return np.concatenate(pieces)


def _crossing(rows: Array, height: Array, i: int, j: int) -> Array:
    """Rows (n, k) at which the height is zero between corners i and j."""
    share = height[:, i] / (height[:, i] - height[:, j])
    return np.asarray(rows[:, i] + share[:, None] * (rows[:, j] - rows[:, i]))


def clipped(triangles: Array, column: int) -> Array:
    """What remains of triangles where a column is positive."""
    height = triangles[..., column]
    inside: Mask = height > 0.0
    count = inside.sum(axis=1)

    def sorted_cut(several: int) -> tuple[Array, Array]:
        chosen = count == several
        order = np.argsort(~inside[chosen], axis=1, kind="stable")
        rows = np.take_along_axis(triangles[chosen], order[..., None], axis=1)
        return rows, np.take_along_axis(height[chosen], order, axis=1)

    one, low = sorted_cut(1)
    tip = np.stack([one[:, 0], _crossing(one, low, 0, 1), _crossing(one, low, 0, 2)], axis=1)
    two, low = sorted_cut(2)
    trunk = np.stack(
        [two[:, 0], two[:, 1], _crossing(two, low, 1, 2), _crossing(two, low, 0, 2)], axis=1
    )
    return np.concatenate([triangles[count == 3], tip, *(trunk[:, pick] for pick in _QUAD)])


def refined(triangles: Array, chosen: Mask, times: int = 3) -> Array:
    """Halve the edges of some triangles, so that they can be coloured finely."""
    pieces = triangles[chosen]
    for _ in range(times):
        middles = 0.5 * (pieces + np.roll(pieces, -1, axis=1))
        corners = [
            np.stack([pieces[:, i], middles[:, i], middles[:, i - 1]], axis=1) for i in range(3)
        ]
        pieces = np.concatenate([middles, *corners])
    return np.concatenate([triangles[~chosen], pieces])


def solid(nodes: Array, closed: bool, *columns: int) -> Array:
    """Triangles around the contacts where some columns are positive."""
    around = []
    for cut in (None, *columns):
        part = skin(nodes, closed) if cut is None else level(nodes, cut, 0.0)
        for other in columns:
            if other != cut:
                part = clipped(part, other)
        around.append(part)
    return np.concatenate(around)
