"""Natural-neighbour interpolation of values at scattered points, as used by the paper.

If a query x were added to the points, its Voronoi cell would take volumes from the cells of its
neighbours; the shares λᵢ of these volumes are Sibson's weights. They are positive, sum to one, and
Σ λᵢ xᵢ = x, so linear functions are reproduced; they are smooth except at the points themselves.

The query changes the Delaunay triangulation only in its cavity, the tetrahedra whose circumspheres
contain it: they are replaced by the tetrahedra from x to the cavity's faces. The circumcentre of a
tetrahedron divides it among its vertices, by Voronoi cells, into the signed volumes::

    w_i(T) = Σ over edges ij and triangles ijk of T: |x_i − x_j|² (x_i − x_k)·(x_j − x_k) h / 24|N|²

with N = (x_j − x_i) × (x_k − x_i), and h = ± (c − x_i)·N the circumcentre's height over the
triangle, positive toward the fourth vertex. The volume taken from point i is the sum of w_i over
the cavity minus that over the new tetrahedra. No Voronoi cell is constructed, and cells may be
unbounded.

Four points on a circle form a flat tetrahedron; it belongs to no cell and is ignored. On the convex
hull, where volumes diverge, the weights tend to the barycentric ones; these are used where roundoff
dominates the volumes: closer than about 1e-11 to the hull, or to a point.

References
----------
R. Sibson, A vector identity for the Dirichlet tessellation, Math. Proc. Camb. Phil. Soc. 87 (1980).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay, QhullError
from threadpoolctl import threadpool_limits  # comes with scikit-learn

from vibrissa.numerics import Array, IntArray, copy, inlined, kernel, share_out

#: Vertices (n, 3); corners and neighbours (t, 4); circumcentres relative to the first corner
#: (t, 3); volumes w_i (t, 4); kinds of flat tetrahedra (t,).
Mesh = tuple[Array, IntArray, IntArray, Array, Array, IntArray]
#: Index of each vertex (n,) among a query's neighbours, or -1; the neighbours; their weights.
Found = tuple[IntArray, IntArray, Array]

_FLAT = 1e-12  # volume over the longest edge cubed below which a tetrahedron is flat
_SAME = 1e-13  # distance below which points coincide, in coordinates with ranges of about one
_ON_CIRCLE = 1e-6  # largest relative deviation of a point's power from zero for four on a circle
_REPRODUCED = 1e-9  # largest error, over the neighbours' distance, of a query from its weights


@inlined
def _add_cell_volumes(tetrahedron: Array, centre: Array, shares: Array) -> None:
    """Add w_i of a tetrahedron (4, 3) with known circumcentre to ``shares`` (4,)."""
    for last in range(4):
        i, j, k = (last + 1) % 4, (last + 2) % 4, (last + 3) % 4
        ax = tetrahedron[j, 0] - tetrahedron[i, 0]
        ay = tetrahedron[j, 1] - tetrahedron[i, 1]
        az = tetrahedron[j, 2] - tetrahedron[i, 2]
        bx = tetrahedron[k, 0] - tetrahedron[i, 0]
        by = tetrahedron[k, 1] - tetrahedron[i, 1]
        bz = tetrahedron[k, 2] - tetrahedron[i, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        square = nx * nx + ny * ny + nz * nz
        if square == 0.0:
            continue
        toward = (
            nx * (tetrahedron[last, 0] - tetrahedron[i, 0])
            + ny * (tetrahedron[last, 1] - tetrahedron[i, 1])
            + nz * (tetrahedron[last, 2] - tetrahedron[i, 2])
        )
        height = (
            nx * (centre[0] - tetrahedron[i, 0])
            + ny * (centre[1] - tetrahedron[i, 1])
            + nz * (centre[2] - tetrahedron[i, 2])
        )
        if toward < 0.0:
            height = -height
        aa, bb = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz
        ab = ax * bx + ay * by + az * bz
        factor = height / (24.0 * square)
        # The angles at k, j and i are opposite the edges ij, ik and jk.
        ij = factor * aa * (bb - ab)
        ik = factor * bb * (aa - ab)
        jk = factor * (aa + bb - 2.0 * ab) * ab
        shares[i] += ij + ik
        shares[j] += ij + jk
        shares[k] += ik + jk


@inlined
def _circumcentre(tetrahedron: Array, centre: Array) -> float:
    """Fill the circumcentre relative to the first vertex; return 6 × volume over longest edge³."""
    a0 = tetrahedron[1, 0] - tetrahedron[0, 0]
    a1 = tetrahedron[1, 1] - tetrahedron[0, 1]
    a2 = tetrahedron[1, 2] - tetrahedron[0, 2]
    b0 = tetrahedron[2, 0] - tetrahedron[0, 0]
    b1 = tetrahedron[2, 1] - tetrahedron[0, 1]
    b2 = tetrahedron[2, 2] - tetrahedron[0, 2]
    c0 = tetrahedron[3, 0] - tetrahedron[0, 0]
    c1 = tetrahedron[3, 1] - tetrahedron[0, 1]
    c2 = tetrahedron[3, 2] - tetrahedron[0, 2]
    bc0, bc1, bc2 = b1 * c2 - b2 * c1, b2 * c0 - b0 * c2, b0 * c1 - b1 * c0
    ca0, ca1, ca2 = c1 * a2 - c2 * a1, c2 * a0 - c0 * a2, c0 * a1 - c1 * a0
    ab0, ab1, ab2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    volume = a0 * bc0 + a1 * bc1 + a2 * bc2
    aa, bb, cc = (
        a0 * a0 + a1 * a1 + a2 * a2,
        b0 * b0 + b1 * b1 + b2 * b2,
        c0 * c0 + c1 * c1 + c2 * c2,
    )
    longest = np.sqrt(max(aa, bb, cc))
    if volume != 0.0:
        centre[0] = (aa * bc0 + bb * ca0 + cc * ab0) / (2.0 * volume)
        centre[1] = (aa * bc1 + bb * ca1 + cc * ab1) / (2.0 * volume)
        centre[2] = (aa * bc2 + bb * ca2 + cc * ab2) / (2.0 * volume)
    return float(abs(volume) / (longest * longest * longest))


@inlined
def _on_a_circle(tetrahedron: Array) -> bool:
    """Whether four coplanar points are on a circle."""
    a, b = tetrahedron[1] - tetrahedron[0], tetrahedron[2] - tetrahedron[0]
    d = tetrahedron[3] - tetrahedron[0]
    aa, bb, ab = np.sum(a * a), np.sum(b * b), np.sum(a * b)
    square = aa * bb - ab * ab
    if square <= 1e-20 * aa * bb:
        return False
    centre = (bb * (aa - ab) * a + aa * (bb - ab) * b) / (2.0 * square)
    power = np.sum(d * (d - 2.0 * centre))
    return bool(abs(power) < _ON_CIRCLE * np.sum(centre * centre))


@kernel
def measure(
    vertices: Array,
    corners: IntArray,
    centres: Array,
    shares: Array,
    flat: IntArray,
    first: int,
    last: int,
) -> None:
    """Compute circumcentres (relative to the first vertex) and volumes w_i of tetrahedra.

    ``flat``: 1 for four points on a circle, 2 for other coplanar points, which occur at the hull.
    """
    tetrahedron, centre = np.empty((4, 3)), np.empty(3)
    for t in range(first, last):
        for k in range(4):
            copy(vertices[corners[t, k]], tetrahedron[k])
        if _circumcentre(tetrahedron, centre) < _FLAT:
            flat[t] = 1 if _on_a_circle(tetrahedron) else 2
            continue
        copy(centre, centres[t])
        for c in range(3):
            centre[c] += tetrahedron[0, c]
        _add_cell_volumes(tetrahedron, centre, shares[t])


@inlined
def _contains(mesh: Mesh, t: int, query: Array) -> bool:
    """Whether the circumsphere of tetrahedron t contains the query."""
    vertices, corners, _, centres, _, flat = mesh
    if flat[t] > 0:
        return bool(flat[t] == 1)
    v = corners[t, 0]
    power = 0.0
    for c in range(3):
        away = query[c] - vertices[v, c]
        power += away * (away - 2.0 * centres[t, c])
    return bool(power < 0.0)


@inlined
def _distance2(a: Array, b: Array) -> float:
    """Squared distance of two points."""
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@inlined
def _volume(a: Array, b: Array, c: Array, d: Array) -> float:
    """Six times the signed volume of a tetrahedron."""
    x, y, z = a[0] - d[0], a[1] - d[1], a[2] - d[2]
    u, v, w = b[0] - d[0], b[1] - d[1], b[2] - d[2]
    p, q, r = c[0] - d[0], c[1] - d[1], c[2] - d[2]
    return float(x * (v * r - w * q) + y * (w * p - u * r) + z * (u * q - v * p))


@inlined
def _slot_of(v: int, found: Found, count: IntArray) -> int:
    """Index of vertex v among the neighbours; it is added if new."""
    slots, members, weights = found
    if slots[v] < 0:
        slots[v] = count[0]
        members[count[0]] = v
        weights[count[0]] = 0.0
        count[0] += 1
    return int(slots[v])


@kernel
def sibson_weights(
    mesh: Mesh, query: Array, start: int, mark: int, marks: IntArray, cavity: IntArray, found: Found
) -> int:
    """Compute the weights of the query's neighbours; return their number.

    ``marks`` (one per tetrahedron) must not contain ``mark``; the slots (one per vertex) are -1
    before and after.
    """
    vertices, corners, neighbours, _, shares, _ = mesh
    slots, members, weights = found
    for k in range(4):
        if _distance2(query, vertices[corners[start, k]]) <= _SAME**2:
            members[0], weights[0] = corners[start, k], 1.0
            return 1
    tetrahedron, centre, new = np.empty((4, 3)), np.empty(3), np.empty(4)
    copy(query, tetrahedron[0])
    count = np.zeros(1, np.int64)
    cavity[0], marks[start] = start, mark
    done, size = 0, 1
    while done < size:
        t = cavity[done]
        done += 1
        for k in range(4):
            weights[_slot_of(corners[t, k], found, count)] += shares[t, k]
            other = neighbours[t, k]
            if other >= 0 and marks[other] == mark:
                continue
            if other >= 0 and _contains(mesh, other, query):
                marks[other], cavity[size] = mark, other
                size += 1
                continue
            # A face of the cavity forms a new tetrahedron with the query.
            for c in range(1, 4):
                copy(vertices[corners[t, (k + c) % 4]], tetrahedron[c])
            if _circumcentre(tetrahedron, centre) < _FLAT:
                continue
            for c in range(3):
                centre[c] += query[c]
            new[:] = 0.0
            _add_cell_volumes(tetrahedron, centre, new)
            for c in range(1, 4):
                weights[_slot_of(corners[t, (k + c) % 4], found, count)] -= new[c]
    for j in range(count[0]):
        slots[members[j]] = -1
    if _normalise(vertices, query, count[0], members, weights):
        return int(count[0])
    return _barycentric(mesh, query, start, members, weights)


@inlined
def _normalise(
    vertices: Array, query: Array, count: int, members: IntArray, weights: Array
) -> bool:
    """Normalise the weights; return whether they are non-negative and reproduce the query."""
    total = 0.0
    for j in range(count):
        total += weights[j]
    ax = ay = az = farthest = least = 0.0
    for j in range(count):
        weights[j] /= total
        least = min(least, weights[j])
        vertex = vertices[members[j]]
        ax += weights[j] * (vertex[0] - query[0])
        ay += weights[j] * (vertex[1] - query[1])
        az += weights[j] * (vertex[2] - query[2])
        farthest = max(farthest, _distance2(vertex, query))
    error = np.sqrt((ax * ax + ay * ay + az * az) / farthest)
    return bool(error <= _REPRODUCED and least >= -_REPRODUCED)


@inlined
def _barycentric(mesh: Mesh, query: Array, t: int, members: IntArray, weights: Array) -> int:
    """Barycentric weights of the corners of the tetrahedron around the query."""
    vertices, corners = mesh[0], mesh[1]
    a, b = vertices[corners[t, 0]], vertices[corners[t, 1]]
    c, d = vertices[corners[t, 2]], vertices[corners[t, 3]]
    whole = _volume(a, b, c, d)
    weights[0] = _volume(query, b, c, d) / whole
    weights[1] = _volume(a, query, c, d) / whole
    weights[2] = _volume(a, b, query, d) / whole
    weights[3] = 1.0 - weights[0] - weights[1] - weights[2]
    for k in range(4):
        members[k] = corners[t, k]
    return 4


@kernel
def interpolate(
    mesh: Mesh,
    values: Array,
    queries: Array,
    inside: IntArray,
    natural: bool,
    out: Array,
    first: int,
    last: int,
) -> None:
    """Fill ``out`` for the queries inside a tetrahedron (``inside`` not -1)."""
    vertices, corners = mesh[0], mesh[1]
    n, tetrahedra = len(vertices), len(corners)
    found = (np.full(n, -1), np.empty(n, np.int64), np.empty(n))
    marks, cavity = np.full(tetrahedra, -1), np.empty(tetrahedra, np.int64)
    _, members, weights = found
    for row in range(first, last):
        start = inside[row]
        if start < 0:
            continue
        if natural:
            count = sibson_weights(mesh, queries[row], start, row, marks, cavity, found)
        else:
            count = _barycentric(mesh, queries[row], start, members, weights)
        for c in range(values.shape[1]):
            total = 0.0
            for j in range(count):
                total += weights[j] * values[members[j], c]
            out[row, c] = total


class NaturalNeighbour:
    """Natural-neighbour or linear interpolation of values at scattered points in space.

    Parameters
    ----------
    points : (n, 3) array_like
        Points at which the values are known; not all in one plane. Duplicates are ignored.
    values : (n, k) array_like
        Values at the points.
    scale : (3,) array_like, optional
        Divisors of the coordinates that make distances along all axes comparable; by default their
        ranges.

    Raises
    ------
    ValueError
        If shapes do not match, values are not finite, or all points are in one plane.
    """

    def __init__(
        self, points: ArrayLike, values: ArrayLike, scale: ArrayLike | None = None
    ) -> None:
        places = np.asarray(points, dtype=np.float64)
        self.values = np.ascontiguousarray(values, dtype=np.float64)
        if places.ndim != 2 or places.shape[1] != 3 or self.values.shape[:-1] != places.shape[:1]:
            raise ValueError(
                "points must be (n, 3) and values (n, k); "
                f"got {places.shape} and {self.values.shape}"
            )
        if not (np.isfinite(places).all() and np.isfinite(self.values).all()):
            raise ValueError("points and values must be finite")
        self.scale = np.ptp(places, axis=0) if scale is None else np.asarray(scale, np.float64)
        if self.scale.shape != (3,) or not (self.scale > 0.0).all():
            raise ValueError(
                "each coordinate needs a range, or a scale, above zero; "
                f"the scale is {self.scale.tolist()}"
            )
        try:
            self._triangulation = Delaunay(places / self.scale)
        except QhullError as error:
            raise ValueError("the points do not span space: all lie in one plane") from error
        self._mesh = _build_mesh(self._triangulation)
        with threadpool_limits(limits=1):  # threads of linear algebra wait for each other here
            _ = self._triangulation.transform

    def __call__(
        self, queries: ArrayLike, method: Literal["natural", "linear"] = "natural"
    ) -> Array:
        """Interpolate values at queries (m, 3); NaN outside the convex hull."""
        if method not in ("natural", "linear"):
            raise ValueError(f"method is 'natural' or 'linear'; got {method!r}")
        wanted, inside = self._locate(queries)
        out = np.full((len(wanted), self.values.shape[1]), np.nan)
        natural = method == "natural"
        share_out(
            len(wanted),
            lambda first, last: interpolate(
                self._mesh, self.values, wanted, inside, natural, out, first, last
            ),
        )
        return out

    def weights(self, query: ArrayLike) -> tuple[IntArray, Array]:
        """Sibson's weights of the points around a query.

        Parameters
        ----------
        query : (3,) array_like
            Position of the query.

        Returns
        -------
        indices : (j,) int array
            Indices of the natural neighbours; none outside the convex hull.
        weights : (j,) array
            Weights of these points; they sum to one.
        """
        wanted, inside = self._locate(np.asarray(query, dtype=np.float64)[None])
        if inside[0] < 0:
            return np.empty(0, np.int64), np.empty(0)
        n, tetrahedra = len(self._mesh[0]), len(self._mesh[1])
        found = (np.full(n, -1), np.empty(n, np.int64), np.empty(n))
        marks, cavity = np.full(tetrahedra, -1), np.empty(tetrahedra, np.int64)
        count = sibson_weights(self._mesh, wanted[0], int(inside[0]), 0, marks, cavity, found)
        _, members, weights = found
        return members[:count].copy(), weights[:count].copy()

    def _locate(self, queries: ArrayLike) -> tuple[Array, IntArray]:
        """Scaled queries (m, 3), and the tetrahedra that contain them, -1 outside."""
        wanted = np.asarray(queries, dtype=np.float64)
        if wanted.ndim != 2 or wanted.shape[1] != 3:
            raise ValueError(f"queries must be (m, 3); got {wanted.shape}")
        wanted = np.ascontiguousarray(wanted / self.scale)
        inside = np.full(len(wanted), -1)
        known = np.isfinite(wanted).all(axis=1)
        inside[known] = self._triangulation.find_simplex(wanted[known])
        return wanted, inside


def _build_mesh(triangulation: Delaunay) -> Mesh:
    """Mesh with circumcentres and volumes, from a Delaunay triangulation."""
    vertices = np.ascontiguousarray(triangulation.points)
    corners = triangulation.simplices.astype(np.int64)
    n = len(corners)
    centres, shares, flat = np.zeros((n, 3)), np.zeros((n, 4)), np.zeros(n, np.int64)
    share_out(n, lambda first, last: measure(vertices, corners, centres, shares, flat, first, last))
    return vertices, corners, triangulation.neighbors.astype(np.int64), centres, shares, flat
