"""All stable contacts as solids: sampled finely, cut open, and surfaces of equal value in them.

A map has contact point and signals at the nodes of a grid over arc length, bearing and load. In
between both are smooth and are interpolated by cubic splines, for pictures only. Every node carries
one row of numbers, its columns named in :data:`COLUMNS`, so that what is cut out carries the
contact point and all signals along. Directions are carried as the components of a vector, which are
smooth where angles jump.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import permutations, product

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array, Mask

SIGNALS = ("Fx", "FT", "FD", "Mx", "MB", "MD")
DIRECTIONS = ("FD", "MD")
COORDINATES = ("r", "theta", "phi")
COLUMNS = (
    *("x", "y", "z", "r", "theta", "phi"),
    *("Fx", "FT cos FD", "FT sin FD", "Mx", "MB cos MD", "MB sin MD"),
    *("arc_length", "deflection"),
)
"""SI units; ``deflection`` is how far outside the cone of small deflections a contact lies, m."""

_COLUMN = {name: i for i, name in enumerate(COLUMNS)}
_DIMS = ("station", "bearing", "load")
_CONE = np.deg2rad(2.0)
_SHAPE = (36, 72, 24)
"""Cells of the whole chart."""


def column(name: str) -> int:
    """Give the column of a quantity."""
    return _COLUMN[name]


def values_of(name: str, rows: Array) -> Array:
    """Take a signal, a coordinate or another column out of rows."""
    if name in _COLUMN:
        return np.asarray(rows[..., _COLUMN[name]])
    kind = name[0]
    size, direction = ("FT", "FD") if kind == "F" else ("MB", "MD")
    first, second = (rows[..., _COLUMN[f"{size} {f} {direction}"]] for f in ("cos", "sin"))
    return np.hypot(first, second) if name == size else np.arctan2(second, first)


def sample_contacts(
    samples: xr.Dataset,
    centerline: ArrayLike,
    bearings: tuple[float, float] | None = None,
    shape: tuple[int, int, int] | None = None,
) -> Array:
    """Sample the contacts of a map as finely as a picture needs."""
    names = ("contact_point", "arc_length", *SIGNALS)
    missing = [name for name in names if name not in samples]
    if missing:
        raise ValueError(f"the map lacks {', '.join(missing)}")
    absent = [dim for dim in _DIMS if dim not in samples["Fx"].dims]
    if absent:
        raise ValueError(
            f"the map has no dimension {', '.join(absent)}; the chart of a map is needed, "
            "as of ContactMap.to_dataset()"
        )
    signals = {name: samples[name].transpose(*_DIMS).to_numpy() for name in SIGNALS}
    vectors = [
        signals[size] * turn(signals[direction])
        for size, direction in (("FT", "FD"), ("MB", "MD"))
        for turn in (np.cos, np.sin)
    ]
    point = samples["contact_point"].transpose(*_DIMS, "space").to_numpy()
    scalars = (signals["Fx"], *vectors[:2], signals["Mx"], *vectors[2:])
    arc = samples["arc_length"].transpose(*_DIMS).to_numpy()
    nodes = np.concatenate([point, np.stack([*scalars, arc], axis=-1)], axis=-1)
    if not np.isfinite(nodes).all():
        raise ValueError("the map lacks some values; all of the reachable space is needed")
    axes = [np.asarray(samples[dim].to_numpy(), dtype=np.float64) for dim in _DIMS]
    return _rows(
        _refined(nodes, axes, bearings, shape or _SHAPE), np.asarray(centerline, dtype=np.float64)
    )


def _refined(
    nodes: Array,
    axes: list[Array],
    bearings: tuple[float, float] | None,
    shape: tuple[int, int, int],
) -> Array:
    from scipy.interpolate import CubicSpline  # a fifth of a second, so only where it is needed

    station, bearing, load = axes
    start, stop = (bearing[0], bearing[-1]) if bearings is None else bearings
    around = max(2, round(shape[1] * (stop - start) / (2.0 * np.pi)))
    nodes = CubicSpline(station, nodes, axis=0)(np.linspace(station[0], station[-1], shape[0] + 1))
    nodes[:, -1] = nodes[:, 0]  # equal but for rounding
    wrapped = CubicSpline(bearing, nodes, axis=1, bc_type="periodic")
    nodes = wrapped(np.linspace(start, stop, around + 1))
    fine = CubicSpline(load, nodes, axis=2)(np.linspace(load[0], load[-1], shape[2] + 1))
    return np.asarray(fine, dtype=np.float64)


def _rows(nodes: Array, line: Array) -> Array:
    """Add what follows from contact points (the first three columns) to interpolated nodes."""
    point = nodes[..., :3]
    x, y, z = np.moveaxis(point, -1, 0)
    ball = np.stack(
        [np.linalg.norm(point, axis=-1), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1
    )
    outside = outside_cone(point.reshape(-1, 3), line).reshape(x.shape)
    return np.concatenate([point, ball, nodes[..., 3:], outside[..., None]], axis=-1)


def outside_cone(points: Array, centerline: Array) -> Array:
    """Distance of contacts from the cone of small deflections."""
    distance, arc_length = nearest_at_rest(points, centerline)
    return np.asarray(distance - arc_length * np.tan(_CONE))


def nearest_at_rest(points: Array, centerline: Array) -> tuple[Array, Array]:
    """Distance of contacts from the resting whisker."""
    from scipy.spatial import cKDTree

    count = max(2000, len(centerline))
    at = np.linspace(0.0, len(centerline) - 1.0, count)
    fine = np.stack([np.interp(at, np.arange(len(centerline)), c) for c in centerline.T], axis=1)
    step = np.linalg.norm(np.diff(fine, axis=0), axis=1)
    arc_length = np.concatenate([[0.0], np.cumsum(step)])
    distance, nearest = cKDTree(fine).query(points)
    return np.asarray(distance), arc_length[nearest]


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


def level_surface(nodes: Array, column: int, value: float) -> Array:
    """Find the surface on which a column has a given value."""
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


def clip(triangles: Array, column: int) -> Array:
    """Cut triangles off where a column is negative."""
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


def subdivide(triangles: Array, chosen: Mask, times: int = 3) -> Array:
    """Halve the edges of some triangles, so that they can be coloured finely."""
    pieces = triangles[chosen]
    for _ in range(times):
        middles = 0.5 * (pieces + np.roll(pieces, -1, axis=1))
        corners = [
            np.stack([pieces[:, i], middles[:, i], middles[:, i - 1]], axis=1) for i in range(3)
        ]
        pieces = np.concatenate([middles, *corners])
    return np.concatenate([triangles[~chosen], pieces])


def solid_surface(nodes: Array, closed: bool, *columns: int) -> Array:
    """Find the surface around the contacts where some columns are positive."""
    around = []
    for cut in (None, *columns):
        part = skin(nodes, closed) if cut is None else level_surface(nodes, cut, 0.0)
        for other in columns:
            if other != cut:
                part = clip(part, other)
        around.append(part)
    return np.concatenate(around)
