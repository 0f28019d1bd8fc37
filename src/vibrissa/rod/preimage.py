"""Which contacts give these three numbers: all preimages of a map from the chart.

Three quantities T (the contact point's coordinates, or three base signals) are known with their
exact derivatives at the nodes of the chart (:mod:`vibrissa.rod.reach`). In each cell T is the cubic
blended between the cell's twelve edges: with H the cubic Hermite curve along an edge and V the
straight line between its ends, Σ w H over the four edges along η plus Σ w (H - V) over those along
ψ and ρ, w the bilinear weights across. It reproduces all cubics, so its error is of fourth order;
the Bézier points of the edges bound it.

Boxes around the cells' values, and around those of 2 × 2 × 2 neighbours, and so on, form a tree;
the cells that may contain a target are those whose boxes, and all boxes above them, contain it, and
which still contain it in coordinates aligned with the cell. In each the interpolant is inverted by
Newton's method, which gives seeds so near the exact solution that it converges at once. Angles are
compared on the circle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibrissa.rod.arrays import AnyArray, Array, IntArray
from vibrissa.rod.compiled import copy, inlined, kernel
from vibrissa.rod.reach import Reach

# For the kernels:
# 0 grid (2, 3): origin and size of a cell in (η, ψ, ρ)
# 1 turns (3,): 1/2π for an angle, 0 otherwise
# 2 offsets (levels + 1,): first row of each level in 3; a node's eight children are row
# offsets[level] + node 3 boxes (rows, 6, 8): middle and half width of the three quantities, for
# eight sibling nodes 4 place (cells, 3): (i, j, k) of a cell 5 frame (cells, 6, 3): aligned
# coordinates y = A (T - base): A (3 rows), base, least y, largest y 6 edges (cells, 160): the
# interpolant, T - base, the three quantities side by side 7 care (cells,): how many starts a cell
# needs, see _care
Tree = tuple[Array, Array, IntArray, Array, IntArray, Array, Array, IntArray]

#: At most so many contacts are found for one target.
MOST_SEEDS = 32
# A solution may lie this far outside a cell (in cell widths) and still be its own: neighbours
# overlap.
_OVERLAP = 0.05
# What the interpolant misses by this share of a cell's extent at most, the map itself may reach.
_NEARLY = 0.02
# Boxes are widened by this share of their size for what the cubic misses.
_MARGIN = 0.08
# Where a cell that may hold a fold has no solution but misses one by this share of its extent at
# most, the map may have two, one to either side of the fold; starts this far from it (in cell
# widths) lead to them.
_MISSED = 0.3
_SIDE = 0.2
# In the first cells from rest, where signals vanish, misses are common and tell of no fold.
_RESTING = 3
_STACK = 256
# Cells whose linear part is flatter than this (det relative to the product of its columns) are not
# aligned.
_FLAT = 1e-3
# A cell may hold a fold, and so two solutions, if at a corner the volume that its edges' slopes
# span is below this share of the largest, or has another sign.
_FOLDED = 0.03
# One start may fail to find the one solution where that share is below this, or where the cell in
# its own aligned coordinates is larger than this; the unit cube is 1.
_EVEN = 0.1
_SHEARED = 3.0


@dataclass(frozen=True, eq=False)
class Preimages:
    """Subdivision tree of three quantities over a chart.

    Attributes
    ----------
    tree : tuple of arrays
        For the kernels.
    """

    tree: Tree

    @classmethod
    def of(
        cls, reach: Reach, values: Array, derivatives: Array, angles: tuple[bool, ...]
    ) -> Preimages:
        """Build the tree.

        Parameters
        ----------
        reach : Reach
            The chart; its numbers of cells are powers of two, that along ψ the largest.
        values : (n, m, k, 3) array
            Quantities at the chart's nodes.
        derivatives : (n, m, k, 3, 3) array
            Their derivatives with respect to ξ there.
        angles : tuple of bool
            Which of them are angles, rad.

        Returns
        -------
        Preimages
            Ready to be searched.
        """
        size = np.array([1.0, 2.0 * np.pi, 1.0]) / (np.array(values.shape[:3]) - 1)
        grid = np.stack([np.zeros(3), size])
        circular = np.array(angles)
        place = _octree_order(tuple(n - 1 for n in values.shape[:3]))
        corner, slope = _corners(place, values, reach.charted(derivatives) * size, circular)
        base = values[tuple(place.T)]
        points = _bezier_points(corner, slope)
        aligned = _aligned(corner, points, base)
        offsets, boxes = _boxes(points + base[:, None], circular)
        return cls(
            (
                grid,
                np.where(circular, 0.5 / np.pi, 0.0),
                offsets,
                boxes,
                place,
                aligned,
                _side_by_side(_edges(corner, slope)),
                _care(slope, aligned),
            )
        )


def _octree_order(cells: tuple[int, ...]) -> IntArray:
    """Cells (i, j, k) so that each run of 8 is a 2 × 2 × 2 block, each run of 64 one of those."""
    depth = int(np.log2(min(cells)))
    if any(n % 2**depth for n in cells):
        raise ValueError(f"the chart has {cells} cells; they must be multiples of {2**depth}")
    place = np.stack(np.meshgrid(*(np.arange(n >> depth) for n in cells), indexing="ij"), axis=-1)
    place = place.reshape(-1, 3)
    block = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
    for _ in range(depth):
        place = (2 * place[:, None] + block).reshape(-1, 3)
    return np.ascontiguousarray(place)


def _corners(
    place: IntArray, values: Array, slopes: Array, circular: AnyArray
) -> tuple[Array, Array]:
    """Values relative to the first corner (cells, 2, 2, 2, 3) and slopes (cells, 2, 2, 2, 3, 3)."""
    i, j, k = (place[:, a, None, None, None] for a in range(3))
    two = np.arange(2)
    index = (i + two[:, None, None], j + two[:, None], k + two)
    corner, slope = values[index], slopes[index]
    corner = corner - corner[:, :1, :1, :1]
    turns = np.round(corner / (2.0 * np.pi))
    return np.where(circular, corner - 2.0 * np.pi * turns, corner), slope


def _bezier_points(corner: Array, slope: Array) -> Array:
    """Corners moved inward by a third of their slopes along any of the axes: (cells, 64, 3)."""
    inward = np.empty_like(slope)
    for axis in range(3):
        sign = np.array([1.0, -1.0]).reshape([2 if a == axis else 1 for a in range(3)])
        inward[..., axis] = slope[..., axis] * sign[..., None] / 3.0
    subsets = (np.arange(8)[:, None] >> np.arange(3)) & 1
    moved = corner[..., None, :] + np.einsum("...qa,na->...nq", inward, subsets)
    return np.asarray(moved.reshape(len(corner), 64, 3))


def _boxes(points: Array, circular: AnyArray) -> tuple[IntArray, Array]:
    """Middle and half width of the values in each cell and in larger blocks, 8 siblings a row."""
    low, high = points.min(axis=1), points.max(axis=1)
    grow = _MARGIN * (high - low) + 1e-12
    low, high = low - grow, high + grow
    levels = []
    while True:
        half = 0.5 * (high - low)
        half = np.where(circular & (half > np.pi), np.inf, half)
        box = np.concatenate([0.5 * (low + high), half], axis=-1)
        lone = len(box) % 8
        if lone:  # the few blocks at the top: fill the row with boxes that contain nothing
            box = np.concatenate([box, np.full((8 - lone, 6), -1.0)])
        levels.append(box.reshape(-1, 8, 6).transpose(0, 2, 1))
        if len(box) == 8:
            break
        low, high = low.reshape(-1, 8, 3), high.reshape(-1, 8, 3)
        middle = 0.5 * (low + high)
        turns = np.round((middle - middle[:, :1]) / (2.0 * np.pi))
        shift = np.where(circular, 2.0 * np.pi * turns, 0.0)
        low, high = (low - shift).min(axis=1), (high - shift).max(axis=1)
    levels = levels[::-1]
    offsets = np.cumsum([0, *(len(level) for level in levels)])
    return offsets, np.ascontiguousarray(np.concatenate(levels))


def _aligned(corner: Array, points: Array, base: Array) -> Array:
    """Coordinates in which a cell is nearly the unit cube, and its extent in them."""
    columns = [np.diff(corner, axis=axis).mean(axis=(1, 2, 3)) for axis in (1, 2, 3)]
    linear = np.stack(columns, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        even = linear / np.linalg.norm(linear, axis=2, keepdims=True)  # whatever the units
        flatness = np.abs(np.linalg.det(even)) / np.prod(np.linalg.norm(even, axis=1), axis=-1)
    usable = flatness > _FLAT
    inverse = np.zeros_like(linear)
    inverse[usable] = np.linalg.inv(linear[usable])
    y = np.einsum("cij,cnj->cni", inverse, points)
    low, high = y.min(axis=1), y.max(axis=1)
    grow = _MARGIN * (high - low) + 1e-9
    return np.ascontiguousarray(
        np.concatenate(
            [inverse, base[:, None], (low - grow)[:, None], (high + grow)[:, None]], axis=1
        )
    )


def _edges(corner: Array, slope: Array) -> Array:
    """Coefficients: cubics along η at the corners of (ψ, ρ), corrections along ψ and along ρ."""
    parts = []
    for axis in range(3):
        v = np.moveaxis(corner, axis + 1, 1)
        d = np.moveaxis(slope[..., axis], axis + 1, 1)
        rise = v[:, 1] - v[:, 0]
        square = 3.0 * rise - 2.0 * d[:, 0] - d[:, 1]
        cube = d[:, 0] + d[:, 1] - 2.0 * rise
        terms = [v[:, 0], d[:, 0], square, cube] if axis == 0 else [d[:, 0] - rise, square, cube]
        edge = np.stack(terms, axis=-1)  # (cells, 2, 2, q, terms)
        parts.append(np.moveaxis(edge, 3, 1).reshape(len(corner), 3, -1))
    return np.ascontiguousarray(np.concatenate(parts, axis=-1))


def _side_by_side(edges: Array) -> Array:
    """Coefficients (cells, 3, 40) as (cells, 160): quantities and padding side by side."""
    out = np.zeros((len(edges), edges.shape[2], 4))
    out[..., :3] = edges.transpose(0, 2, 1)
    return out.reshape(len(edges), -1)


def _care(slope: Array, aligned: Array) -> IntArray:
    """How many starts a cell needs: 0 one, 1 several until one is solved, 2 all of them."""
    det = np.linalg.det(slope)
    size = np.prod(np.linalg.norm(slope, axis=-2), axis=-1)
    flatness = (det / np.where(size > 0.0, size, 1.0)).reshape(len(slope), 8)
    flatness *= np.sign(flatness[:, :1])
    least, most = flatness.min(axis=1), np.abs(flatness).max(axis=1)
    sheared = (aligned[:, 5] - aligned[:, 4]).max(axis=1) > _SHEARED
    sheared |= ~aligned[:, :3].any(axis=(1, 2))  # not aligned
    return np.where(least <= _FOLDED * most, 2, np.where((least <= _EVEN * most) | sheared, 1, 0))


@inlined
def wrapped(angle: float) -> float:
    """Angle in [-π, π]."""
    return float(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))


# The interpolant's four lanes, three quantities and padding, lie in one flat buffer, without which
# the compiler does not put them side by side: coefficients, T - target and ∂T/∂x there, T of the
# target relative to the cell's base.
_MISFIT = 160
_SLOPES = _MISFIT + 4
_RELATIVE = _SLOPES + 12
_BUFFER = _RELATIVE + 4


@inlined
def _cubic(b: Array, n: int, q: int, t: float) -> tuple[float, float]:
    """Quantity q along an edge whose four coefficients start at n, and its slope."""
    c1, c2, c3 = b[4 * n + 4 + q], b[4 * n + 8 + q], b[4 * n + 12 + q]
    return b[4 * n + q] + t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + t * 3.0 * c3)


@inlined
def _bulge(b: Array, n: int, q: int, t: float) -> tuple[float, float]:
    """What a cubic along an edge adds to the straight line between its ends, and its slope."""
    c1, c2, c3 = b[4 * n + q], b[4 * n + 4 + q], b[4 * n + 8 + q]
    return t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + t * 3.0 * c3)


@inlined
def _interpolate(b: Array, x: Array) -> None:
    """Leave T - target and ∂T/∂x at the place x of a cell in the buffer."""
    x1, y1, z1 = x[0], x[1], x[2]
    x0, y0, z0 = 1.0 - x1, 1.0 - y1, 1.0 - z1
    for q in range(4):
        a0, s0 = _cubic(b, 0, q, x1)
        a1, s1 = _cubic(b, 4, q, x1)
        a2, s2 = _cubic(b, 8, q, x1)
        a3, s3 = _cubic(b, 12, q, x1)
        total = y0 * (z0 * a0 + z1 * a1) + y1 * (z0 * a2 + z1 * a3) - b[_RELATIVE + q]
        gx = y0 * (z0 * s0 + z1 * s1) + y1 * (z0 * s2 + z1 * s3)
        gy = z0 * (a2 - a0) + z1 * (a3 - a1)
        gz = y0 * (a1 - a0) + y1 * (a3 - a2)
        a0, s0 = _bulge(b, 16, q, y1)
        a1, s1 = _bulge(b, 19, q, y1)
        a2, s2 = _bulge(b, 22, q, y1)
        a3, s3 = _bulge(b, 25, q, y1)
        total += x0 * (z0 * a0 + z1 * a1) + x1 * (z0 * a2 + z1 * a3)
        gx += z0 * (a2 - a0) + z1 * (a3 - a1)
        gy += x0 * (z0 * s0 + z1 * s1) + x1 * (z0 * s2 + z1 * s3)
        gz += x0 * (a1 - a0) + x1 * (a3 - a2)
        a0, s0 = _bulge(b, 28, q, z1)
        a1, s1 = _bulge(b, 31, q, z1)
        a2, s2 = _bulge(b, 34, q, z1)
        a3, s3 = _bulge(b, 37, q, z1)
        b[_MISFIT + q] = total + x0 * (y0 * a0 + y1 * a1) + x1 * (y0 * a2 + y1 * a3)
        b[_SLOPES + q] = gx + y0 * (a2 - a0) + y1 * (a3 - a1)
        b[_SLOPES + 4 + q] = gy + x0 * (a1 - a0) + x1 * (a3 - a2)
        b[_SLOPES + 8 + q] = gz + x0 * (y0 * s0 + y1 * s1) + x1 * (y0 * s2 + y1 * s3)


@inlined
def _adjugate(b: Array, rows: Array) -> float:
    """Fill rows (3, 3) with det ∂T/∂x times its inverse; return det."""
    for a in range(3):
        u, v = _SLOPES + 4 * ((a + 1) % 3), _SLOPES + 4 * ((a + 2) % 3)
        rows[a, 0] = b[u + 1] * b[v + 2] - b[u + 2] * b[v + 1]
        rows[a, 1] = b[u + 2] * b[v] - b[u] * b[v + 2]
        rows[a, 2] = b[u] * b[v + 1] - b[u + 1] * b[v]
    d = _SLOPES
    return float(b[d] * rows[0, 0] + b[d + 1] * rows[0, 1] + b[d + 2] * rows[0, 2])


@inlined
def solve3(a: Array, r: Array, x: Array) -> float:
    """Solve a x = r by Cramer's rule; return det a (x is not set if that is 0)."""
    c0 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    c1 = a[1, 2] * a[2, 0] - a[1, 0] * a[2, 2]
    c2 = a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0]
    det = a[0, 0] * c0 + a[0, 1] * c1 + a[0, 2] * c2
    if det != 0.0:
        inverse = 1.0 / det
        x[0] = inverse * (
            c0 * r[0]
            + (a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]) * r[1]
            + (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]) * r[2]
        )
        x[1] = inverse * (
            c1 * r[0]
            + (a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]) * r[1]
            + (a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]) * r[2]
        )
        x[2] = inverse * (
            c2 * r[0]
            + (a[0, 1] * a[2, 0] - a[0, 0] * a[2, 1]) * r[1]
            + (a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]) * r[2]
        )
    return float(det)


@inlined
def _outside(x: Array) -> float:
    """How far a place lies outside its cell, in cell widths."""
    return float(max(abs(x[0] - 0.5), abs(x[1] - 0.5), abs(x[2] - 0.5)) - 0.5)


@inlined
def _locate(tree: Tree, cell: int, target: Array, relative: Array, x: Array) -> bool:
    """Whether a cell may contain the target; if so, about where."""
    turns, frame = tree[1], tree[5][cell]
    for q in range(3):
        d = target[q] - frame[3, q]
        relative[q] = d - 2.0 * np.pi * np.rint(d * turns[q])
    for a in range(3):
        y = frame[a, 0] * relative[0] + frame[a, 1] * relative[1] + frame[a, 2] * relative[2]
        if y < frame[4, a] or y > frame[5, a]:
            return False
        x[a] = min(max(y, 0.0), 1.0)
    return True


@inlined
def _invert(b: Array, half: Array, work: Array, careful: bool, x: Array) -> int:
    """Solve a cell's interpolant: 2 solved, 1 nearly so (a fold of the map), 0 not in the cell.

    If not solved, x is left where it missed least, by work[5, 0] of the cell's extent.
    """
    rows, step, best = work[:3], work[3], work[4]
    least, done = np.inf, False
    work[5, 0] = np.inf
    for n in range(9):
        _interpolate(b, x)
        if done:
            return 2
        if n == 8:
            break
        m0, m1, m2 = b[_MISFIT], b[_MISFIT + 1], b[_MISFIT + 2]
        away = max(abs(m0) / half[0], abs(m1) / half[1], abs(m2) / half[2])
        if away < least:
            least = away
            for a in range(3):
                best[a] = x[a]
        det = _adjugate(b, rows)
        if det == 0.0:
            break
        for a in range(3):
            step[a] = (rows[a, 0] * m0 + rows[a, 1] * m1 + rows[a, 2] * m2) / det
        size = max(abs(step[0]), abs(step[1]), abs(step[2]))
        if n == 0 and not careful:  # nearly linear: the first step tells which cell it is in
            reach = max(
                abs(x[0] - step[0] - 0.5), abs(x[1] - step[1] - 0.5), abs(x[2] - step[2] - 0.5)
            )
            if reach > 1.3:
                return 0
        shorten = min(1.0, 0.6 / max(size, 1e-300))
        for a in range(3):
            x[a] = min(max(x[a] - shorten * step[a], -0.5), 1.5)
        if size < 2e-2:  # the next step would be of its square
            if _outside(x) > _OVERLAP:
                return 0
            done = True
    for a in range(3):
        x[a] = best[a]
    work[5, 0] = least if _outside(x) <= 0.25 else np.inf
    return 1 if least <= _NEARLY and _outside(x) <= 0.25 else 0


@inlined
def _sides(b: Array, half: Array, x: Array, work: Array, sides: Array) -> bool:
    """Go _SIDE from x both ways, as the interpolant changes least; whether a fold is between."""
    rows, step = work[:3], work[3]
    sign = 1.0
    for at in range(3):
        if at == 0:
            copy(x, sides[2])
        else:
            for a in range(3):
                sides[2, a] = sides[at - 1, a]
        _interpolate(b, sides[2])
        if at > 0:
            sign *= _adjugate(b, rows)
            continue
        most = 0.0
        for q in range(3):
            u, v = _SLOPES + (q + 1) % 3, _SLOPES + (q + 2) % 3
            scale = 1.0 / (half[(q + 1) % 3] * half[(q + 2) % 3])
            d0 = scale * (b[u + 4] * b[v + 8] - b[u + 8] * b[v + 4])
            d1 = scale * (b[u + 8] * b[v] - b[u] * b[v + 8])
            d2 = scale * (b[u] * b[v + 4] - b[u + 4] * b[v])
            size = max(abs(d0), abs(d1), abs(d2))
            if size > most:
                most = size
                step[0], step[1], step[2] = d0 / size, d1 / size, d2 / size
        if most == 0.0:
            return False
        for a in range(3):
            sides[0, a], sides[1, a] = x[a] - _SIDE * step[a], x[a] + _SIDE * step[a]
    return bool(sign < 0.0)


@inlined
def _keep(
    grid: Array,
    place: IntArray,
    x: Array,
    b: Array,
    work: Array,
    solved: int,
    found: Array,
    inverses: Array,
    quality: IntArray,
    count: int,
) -> int:
    """Add a seed unless neighbours found it; what is solved replaces what is not."""
    eta = grid[0, 0] + grid[1, 0] * (place[0] + x[0])
    psi = grid[0, 1] + grid[1, 1] * (place[1] + x[1])
    rho = grid[0, 2] + grid[1, 2] * (place[2] + x[2])
    row = count
    for n in range(count):
        apart = max(
            abs(eta - found[n, 0]) / grid[1, 0],
            abs(wrapped(psi - found[n, 1])) / grid[1, 1],
            abs(rho - found[n, 2]) / grid[1, 2],
        )
        both = solved + quality[n]
        if apart < 0.02 or (both < 4 and apart < (0.5 if both > 1 else 0.15)):
            if solved <= quality[n]:
                return count
            row = n
            break
    if row == MOST_SEEDS:
        return count
    found[row, 0], found[row, 1], found[row, 2] = eta, psi, rho
    quality[row] = solved
    det = _adjugate(b, work)
    for a in range(3):
        for c in range(3):  # ∂(η, ψ, ρ)/∂T from ∂T/∂x in cell widths
            inverses[row, a, c] = np.nan if det == 0.0 else work[a, c] * grid[1, a] / det
    return max(count, row + 1)


@kernel
def seeds(tree: Tree, target: Array, found: Array, inverses: Array, quality: IntArray) -> int:
    """All contacts that may have the target's values, as chart coordinates.

    Parameters
    ----------
    tree : tuple of arrays
        See :class:`Preimages`.
    target : (3,) array
        The values.
    found : (MOST_SEEDS, 3) array
        Filled with (η, ψ, ρ).
    inverses : (MOST_SEEDS, 3, 3) array
        Filled with the interpolant's ∂(η, ψ, ρ)/∂T there.
    quality : (MOST_SEEDS,) int array
        Filled with 2 (the interpolant is solved), 1 (nearly so: near a fold of the map) or 0 (it
        is missed: to one side of a fold).

    Returns
    -------
    int
        How many.
    """
    grid, turns, offsets, boxes, place = tree[0], tree[1], tree[2], tree[3], tree[4]
    edges, care = tree[6], tree[7]
    levels = offsets.shape[0] - 1
    stack = np.empty((_STACK, 2), np.int64)
    inside = np.empty(8, np.bool_)
    work, relative, x = np.empty((6, 3)), np.empty(3), np.empty(3)
    b = np.zeros(_BUFFER)
    nearest, sides, half = np.empty(3), np.empty((3, 3)), np.empty(3)
    count, top = 0, 1
    stack[0, 0], stack[0, 1] = 0, 0
    t0, t1, t2 = target[0], target[1], target[2]
    while top > 0:
        top -= 1
        level, node = stack[top, 0], stack[top, 1]
        box = boxes[offsets[level] + node]
        for c in range(8):
            d0, d1, d2 = t0 - box[0, c], t1 - box[1, c], t2 - box[2, c]
            d0 -= 2.0 * np.pi * np.rint(d0 * turns[0])
            d1 -= 2.0 * np.pi * np.rint(d1 * turns[1])
            d2 -= 2.0 * np.pi * np.rint(d2 * turns[2])
            inside[c] = (abs(d0) <= box[3, c]) & (abs(d1) <= box[4, c]) & (abs(d2) <= box[5, c])
        for c in range(8):
            if not inside[c]:
                continue
            child = 8 * node + c
            if level < levels - 1:
                if top < _STACK:
                    stack[top, 0], stack[top, 1] = level + 1, child
                    top += 1
                continue
            if not _locate(tree, child, target, relative, x):
                continue
            careful, edge = care[child], edges[child]
            for k in range(_MISFIT):
                b[k] = edge[k]
            for a in range(3):
                half[a], b[_RELATIVE + a] = box[3 + a, c], relative[a]
            least = np.inf
            missed = careful == 2 and place[child, 2] >= _RESTING
            for start in range(9 if careful > 0 else 1):  # the place itself, then the corners
                if start > 0:
                    for a in range(3):
                        x[a] = (start - 1) >> a & 1
                solved = _invert(b, half, work, careful > 0, x)
                missed = missed and solved < 2
                if missed and work[5, 0] < least:
                    least = work[5, 0]
                    copy(x, nearest)
                if solved > 0:
                    count = _keep(
                        grid, place[child], x, b, work, solved, found, inverses, quality, count
                    )
                if solved == 2 and careful < 2:
                    break
            if not missed or least > _MISSED:
                continue
            if _sides(b, half, nearest, work, sides):
                for side in range(2):
                    count = _keep(
                        grid,
                        place[child],
                        sides[side],
                        b,
                        work,
                        0,
                        found,
                        inverses,
                        quality,
                        count,
                    )
    return count
