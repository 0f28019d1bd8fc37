"""Triangulated surfaces and marks for pictures, without a renderer.

**Solids** are the sets of stable contacts of a map, sampled finely and cut open, with surfaces of
equal value in them. A map has contact point and signals at the nodes of a grid over arc length,
bearing and load. Between nodes both are smooth and are interpolated by cubic splines, for pictures
only. Every node is one row of numbers, with columns named in :data:`COLUMNS`, so that cut surfaces
have contact points and all signals at their vertices. Directions are stored as vector components,
which are smooth where angles jump.

**Marks**, in mm, are bodies, clouds, arrows, lines and labels. Limits of colours and axes are those
that contain most values, and square-root scales show small ones.

**Shapes** are tubes along whiskers, ellipsoids, the objects of a recording, and a head. A surface
is a pair of vertices (n, 3) and faces (m, 3) of vertex indices; triangles share vertices where it
is smooth. Lengths are returned in the unit of the input, except for objects and the head, which are
returned in mm. The head is a sketch, not based on a measured one: a series of sections whose sides
pass near the base points of an average rat's whiskers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations, product
from math import sqrt
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import interpolate, spatial
from vibrissa.numerics import Array, Mask, spherical
from vibrissa.quantities import to_display

SIGNALS = ("Fx", "FT", "FD", "Mx", "MB", "MD")
DIRECTIONS = ("FD", "MD")
COORDINATES = ("r", "theta", "phi")
COLUMNS = (
    *("x", "y", "z", "r", "theta", "phi"),
    *("Fx", "FT cos FD", "FT sin FD", "Mx", "MB cos MD", "MB sin MD"),
    *("arc_length", "deflection"),
)
"""SI units; ``deflection`` is the distance outside the cone of small deflections, m."""

_COLUMN = {name: i for i, name in enumerate(COLUMNS)}
_DIMS = ("station", "bearing", "load")
_CONE = np.deg2rad(2.0)
_SHAPE = (36, 72, 24)  # number of cells of the whole chart in ``_SHAPE``


def column(name: str) -> int:
    """Index of a quantity's column."""
    return _COLUMN[name]


def values_of(name: str, rows: Array) -> Array:
    """Return a signal, a coordinate or another column of rows (..., k)."""
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
    """Sample the contacts of a map as finely as a picture requires, as rows (l, m, n, k)."""
    names = ("contact_point", "arc_length", *SIGNALS)
    if missing := [name for name in names if name not in samples]:
        raise ValueError(f"the map lacks {', '.join(missing)}")
    if absent := [dim for dim in _DIMS if dim not in samples["Fx"].dims]:
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
    return _complete_rows(
        _refine(nodes, axes, bearings, shape or _SHAPE), np.asarray(centerline, dtype=np.float64)
    )


def _refine(
    nodes: Array,
    axes: list[Array],
    bearings: tuple[float, float] | None,
    shape: tuple[int, int, int],
) -> Array:
    """Interpolate nodes on a finer grid, in a range of bearings."""
    station, bearing, load = axes
    start, stop = (bearing[0], bearing[-1]) if bearings is None else bearings
    around = max(2, round(shape[1] * (stop - start) / (2.0 * np.pi)))
    nodes = interpolate.CubicSpline(station, nodes, axis=0)(
        np.linspace(station[0], station[-1], shape[0] + 1)
    )
    nodes[:, -1] = nodes[:, 0]  # equal but for rounding
    wrapped = interpolate.CubicSpline(bearing, nodes, axis=1, bc_type="periodic")
    nodes = wrapped(np.linspace(start, stop, around + 1))
    fine = interpolate.CubicSpline(load, nodes, axis=2)(
        np.linspace(load[0], load[-1], shape[2] + 1)
    )
    return np.asarray(fine, dtype=np.float64)


def _complete_rows(nodes: Array, line: Array) -> Array:
    """Add the columns that follow from contact points (the first three columns)."""
    point = nodes[..., :3]
    outside = outside_cone(point.reshape(-1, 3), line).reshape(point.shape[:-1])
    return np.concatenate([point, spherical(point), nodes[..., 3:], outside[..., None]], axis=-1)


def outside_cone(points: Array, centerline: Array) -> Array:
    """Distance of contacts outside the cone of small deflections."""
    distance, arc_length = nearest_at_rest(points, centerline)
    return np.asarray(distance - arc_length * np.tan(_CONE))


def nearest_at_rest(points: Array, centerline: Array) -> tuple[Array, Array]:
    """Distance of contacts from the resting whisker, and arc length of the closest point."""
    count = max(2000, len(centerline))
    at = np.linspace(0.0, len(centerline) - 1.0, count)
    fine = np.stack([np.interp(at, np.arange(len(centerline)), c) for c in centerline.T], axis=1)
    step = np.linalg.norm(np.diff(fine, axis=0), axis=1)
    arc_length = np.concatenate([[0.0], np.cumsum(step)])
    distance, nearest = spatial.cKDTree(fine).query(points)
    return np.asarray(distance), arc_length[nearest]


_QUAD = ((0, 1, 2), (0, 2, 3))


def skin(nodes: Array, closed: bool) -> Array:
    """Triangles (n, 3, k) of the outer faces of a chart."""
    faces = [nodes[:, :, -1], nodes[0], nodes[-1]]
    if not closed:
        faces += [nodes[:, 0], nodes[:, -1]]
    return np.concatenate([_triangulate(face) for face in faces])


def _triangulate(face: Array) -> Array:
    """Triangles of a face (m, n, k), two per cell."""
    corners = np.stack([face[:-1, :-1], face[1:, :-1], face[1:, 1:], face[:-1, 1:]], axis=2)
    corners = corners.reshape(-1, 4, face.shape[-1])
    return np.concatenate([corners[:, pick] for pick in _QUAD])


def level_surface(nodes: Array, column: int, value: float) -> Array:
    """Triangles (n, 3, k) of the surface on which a column has a given value."""
    rows = nodes.reshape(-1, nodes.shape[-1])
    height = rows[:, column] - value
    corners = _tetrahedra(nodes.shape[:3])
    above = height[corners] > 0.0
    count = above.sum(axis=1)
    pieces = []
    # Corners above come first; edges between a corner above and one below are crossed.
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
    """Nodes (n, 4) of six tetrahedra per cell, all along the same diagonal."""
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
    """Rows (n, k) on the edges between corners i and j at which the height is zero."""
    share = height[:, i] / (height[:, i] - height[:, j])
    return np.asarray(rows[:, i] + share[:, None] * (rows[:, j] - rows[:, i]))


def clip(triangles: Array, column: int) -> Array:
    """Cut off the parts of triangles in which a column is negative."""
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
    """Subdivide some triangles by halving their edges, so that they can be coloured finely."""
    pieces = triangles[chosen]
    for _ in range(times):
        middles = 0.5 * (pieces + np.roll(pieces, -1, axis=1))
        corners = [
            np.stack([pieces[:, i], middles[:, i], middles[:, i - 1]], axis=1) for i in range(3)
        ]
        pieces = np.concatenate([middles, *corners])
    return np.concatenate([triangles[~chosen], pieces])


def solid_surface(nodes: Array, closed: bool, *columns: int) -> Array:
    """Triangles of the surface around the contacts for which all given columns are positive."""
    around = []
    for cut in (None, *columns):
        part = skin(nodes, closed) if cut is None else level_surface(nodes, cut, 0.0)
        for other in columns:
            if other != cut:
                part = clip(part, other)
        around.append(part)
    return np.concatenate(around)


Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Colour = tuple[int, int, int]
Side = Literal["front", "back", "double"]


@dataclass(frozen=True, eq=False)
class Body:
    """A surface of one colour."""

    vertices: Array  # (n, 3), mm, shared where the surface is smooth
    faces: Ints  # (m, 3)
    colour: Colour
    opacity: float | None = None
    side: Side = "front"
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # shift of all vertices, mm


@dataclass(frozen=True, eq=False)
class Painted:
    """A surface of many colours, or a large one: it is fast to draw."""

    triangles: Array  # (n, 3, 3), mm
    colours: Bytes  # (n, 3, 3), of the corners
    opacity: float | None = None
    side: Side = "double"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points."""

    points: Array  # (n, 3), mm
    colours: Bytes  # (n, 3)
    size: float  # width of a point, mm


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows that are drawn together."""

    start: Array  # (n, 3), mm
    end: Array
    colours: Bytes  # (n, 3)
    thickness: float  # radius of the shafts, mm


@dataclass(frozen=True, eq=False)
class Line:
    """Straight segments of one colour."""

    pieces: Array  # (n, 2, 3), ends of each, mm
    colour: Colour
    width: float = 2.0  # pixels


@dataclass(frozen=True, eq=False)
class Label:
    """A short text."""

    position: Array  # (3,), lower left corner, mm
    text: str


# Marks by name; marks missing from the next drawing are removed.
Mark = Body | Painted | Cloud | Arrows | Line | Label
Drawing = Mapping[str, Mark]


def pieces(points: Array) -> Array:
    """Cut a polyline into its finite segments (n, 2, 3)."""
    parts = np.stack([points[:-1], points[1:]], axis=1)
    return np.asarray(parts[np.isfinite(parts).all(axis=(1, 2))])


def robust_limits(values: ArrayLike, share: float = 0.98, symmetric: bool = False) -> Array:
    """Limits that contain most of the finite values."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return np.array([-1.0 if symmetric else 0.0, 1.0])
    low, high = np.quantile(finite, [(1.0 - share) / 2.0, (1.0 + share) / 2.0])
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    if not high - low > 1e-12 * max(abs(high), abs(low)):
        room = 0.05 * abs(high) or 1.0
        low, high = low - room, high + room
    return np.array([low, high])


def root(values: ArrayLike) -> Array:
    """Square roots of magnitudes with signs kept, for scales on which small values are visible."""
    x = np.asarray(values, dtype=np.float64)
    return np.asarray(np.sign(x) * np.sqrt(np.abs(x)))


def squared(values: ArrayLike) -> Array:
    """Squares with signs kept: the inverse of `root`."""
    x = np.asarray(values, dtype=np.float64)
    return np.asarray(np.sign(x) * np.square(x))


_SIDES = 8  # number of corners of a whisker's cross-section
# Sections of the head.
_SECTIONS = np.array(
    [
        # forward, half width, middle height, half height; mm
        [0.6, 0.1, -1.6, 0.1],
        [0.3, 1.4, -1.6, 1.3],
        [-1.0, 3.4, -3.2, 3.2],
        [-3.0, 5.2, -4.2, 4.6],
        [-6.0, 6.9, -4.8, 5.9],
        [-10.0, 8.0, -4.9, 7.0],
        [-15.0, 9.0, -4.6, 8.2],
        [-22.0, 10.8, -3.6, 9.8],
        [-30.0, 12.3, -2.4, 10.8],
        [-37.0, 12.0, -1.8, 10.6],
        [-43.0, 9.5, -1.8, 9.0],
        [-46.0, 5.5, -2.2, 5.5],
        [-47.0, 0.1, -2.4, 0.1],
    ]
)
_EYES = np.array([[10.3, -24.0, 2.2], [-10.3, -24.0, 2.2]])
_EYE, _AROUND = 1.5, 40


def across(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors that form a right-handed frame with a direction."""
    along = direction / np.linalg.norm(direction)
    helper = np.eye(3)[np.argmin(np.abs(along))]
    first = np.cross(along, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(along, first)


@lru_cache(maxsize=32)
def _faces(rows: int, columns: int, closed: bool = False) -> Ints:
    """Faces, two per cell, of a grid of points, which may be closed in the second direction."""
    number = np.arange(rows * columns).reshape(rows, columns)
    if closed:
        number = np.concatenate([number, number[:, :1]], axis=1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    halves = [np.stack([p.ravel() for p in half], axis=1) for half in ((a, d, c), (a, c, b))]
    return np.concatenate(halves)


def sheet(grid: Array) -> tuple[Array, Ints]:
    """Surface through the points of a grid."""
    return grid.reshape(-1, 3), _faces(*grid.shape[:2])


def tube(line: Array, radius: Array, sides: int = _SIDES) -> tuple[Array, Ints]:
    """Closed tube around a polyline."""
    tangents = np.gradient(line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = np.array(_transport_normal(across(tangents[0])[0].tolist(), tangents.tolist()))
    turn = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = np.cos(turn)[:, None] * normals[:, None]
    ring += np.sin(turn)[:, None] * np.cross(tangents, normals)[:, None]
    walls = line[:, None] + radius[:, None, None] * ring
    return np.concatenate([walls.reshape(-1, 3), line[[0, -1]]]), _tube_faces(len(line), sides)


def _transport_normal(normal: list[float], tangents: list[list[float]]) -> list[list[float]]:
    """Parallel transport of a normal; plain numbers are faster than small arrays here."""
    x, y, z = normal
    out = []
    for a, b, c in tangents:
        along = x * a + y * b + z * c
        x, y, z = x - along * a, y - along * b, z - along * c
        size = sqrt(x * x + y * y + z * z)
        x, y, z = x / size, y / size, z / size
        out.append([x, y, z])
    return out


@lru_cache(maxsize=32)
def _tube_faces(count: int, sides: int) -> Ints:
    """Faces of a tube, including its ends."""
    around = np.arange(sides)
    beyond = (around + 1) % sides
    first, last = count * sides, (count - 1) * sides
    ends = [
        np.stack([np.full(sides, first), beyond, around], axis=1),
        np.stack([np.full(sides, first + 1), last + around, last + beyond], axis=1),
    ]
    return np.concatenate([_faces(count, sides, closed=True), *ends])


def cylinder(
    origin: Array, axis: Array, radius: float, length: float, sides: int = 32
) -> tuple[Array, Ints]:
    """Closed cylinder."""
    along = 0.5 * length * axis / np.linalg.norm(axis)
    return tube(np.stack([origin - along, origin + along]), np.full(2, radius), sides)


def ellipsoid(centre: Array, axes: Array, around: int = 24) -> tuple[Array, Ints]:
    """Surface of an ellipsoid with semiaxes in the columns of ``axes``."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, around // 2 + 1)
    longitude = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    lat, lon = np.meshgrid(latitude, longitude, indexing="ij")
    ball = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    axes = axes * np.where(np.linalg.det(axes) < 0.0, np.array([1.0, 1.0, -1.0]), 1.0)
    return centre + ball.reshape(-1, 3) @ axes.T, _faces(len(latitude), around, closed=True)


def error_ellipsoid(
    centre: Array, covariance: Array, sigmas: float, most: float = np.inf
) -> tuple[Array, Ints]:
    """Error ellipsoid of an uncertain position."""
    values, directions = np.linalg.eigh(covariance)
    sizes = np.minimum(sigmas * np.sqrt(np.clip(values, 0.0, None)), most)
    return ellipsoid(centre, directions * sizes)


def head_surfaces(rotation: Array, position: Array) -> tuple[Array, Array]:
    """Triangles of a sketch of a rat's head, and of its eyes, mm."""
    turn = np.linspace(0.0, 2.0 * np.pi, _AROUND)
    # Smooth interpolation between the sections, which are closer together near the snout.
    number = np.arange(len(_SECTIONS))
    fine = np.linspace(0.0, number[-1], 6 * number[-1] + 1)
    forward, half, middle, tall = interpolate.PchipInterpolator(number, _SECTIONS)(fine).T[
        ..., None
    ]
    parts = half * np.cos(turn), forward, middle + tall * np.sin(turn)
    skin = sheet(np.stack(np.broadcast_arrays(*parts), axis=-1))
    balls = [ellipsoid(eye, _EYE * np.eye(3), 16) for eye in _EYES]
    surfaces = [np.concatenate([v[f] for v, f in group]) for group in ([skin], balls)]
    moved = [s @ rotation.T + to_display("head_position", position) for s in surfaces]
    return moved[0], moved[1]


def object_surface(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    """Surface of an object of a recording, within limits (3, 2) if unbounded, mm."""
    kind = str(thing.attrs.get("kind"))
    if kind not in _KINDS:
        raise ValueError(f"an object is of kind {kind!r}; one of {', '.join(_KINDS)} is known")
    return _KINDS[kind](thing, limits)


def is_bounded(thing: xr.Dataset) -> bool:
    """Whether an object of a recording is bounded."""
    return thing.attrs.get("kind") in ("sphere", "box", "mesh")


def _mm(thing: xr.Dataset, name: str) -> Array:
    return to_display(name, thing[name].values)


def _sphere(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    return ellipsoid(_mm(thing, "object_position"), _mm(thing, "object_radius") * np.eye(3), 48)


def _peg(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    axis, origin = thing["object_axis"].values, _mm(thing, "object_position")
    first, second = across(axis)
    ends = _visible_range(limits, origin, axis)
    turn = np.linspace(0.0, 2.0 * np.pi, 49)[:, None]
    ring = _mm(thing, "object_radius") * (np.cos(turn) * first + np.sin(turn) * second)
    return sheet(origin + ends[:, None, None] * axis + ring)


def _visible_range(limits: Array, origin: Array, axis: Array) -> Array:
    """Range (2,) along a line that is within limits; if there is none, a range near the middle."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort((limits - origin[:, None]) / axis[:, None], axis=1)
    crossing = np.abs(axis) > 1e-9
    first, last = ends[crossing, 0].max(), ends[crossing, 1].min()
    if first < last:
        return np.array([first, last])
    middle = float((limits.mean(axis=1) - origin) @ axis)
    return np.asarray(middle + 0.5 * np.ptp(limits, axis=1).max() * np.array([-1.0, 1.0]))


def _plane(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    normal, origin = thing["object_axis"].values, _mm(thing, "object_position")
    first, second = across(normal)
    middle, half = limits.mean(axis=1), 0.5 * np.ptp(limits, axis=1).max()
    foot = middle - ((middle - origin) @ normal) * normal
    side = np.linspace(-half, half, 13)
    return sheet(foot + side[:, None, None] * first + side[:, None] * second)


def _box(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    half = 0.5 * _mm(thing, "object_size")
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    # Sides share no vertices, so that edges remain sharp.
    sides = [np.insert(square, k, end, axis=1) * half for k in range(3) for end in (-1.0, 1.0)]
    rotation = thing["object_rotation"].values
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(6)[:, None, None]
    vertices = _mm(thing, "object_position") + np.concatenate(sides) @ rotation.T
    return vertices, faces.reshape(-1, 3)


def _mesh(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    return _mm(thing, "object_vertices"), thing["object_faces"].values.astype(np.int64)


_KINDS: dict[str, Callable[[xr.Dataset, Array], tuple[Array, Ints]]] = {
    "peg": _peg,
    "sphere": _sphere,
    "plane": _plane,
    "box": _box,
    "mesh": _mesh,
}
