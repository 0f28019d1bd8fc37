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
# coordinates y = A (T - base): A (3 rows), base, least y, largest y 6 edges (cells, 3, 40): the
# interpolant, T - base 7 folded (cells,): whether the map may fold inside, so that a cell may hold
# several solutions
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
        offsets, boxes = _boxes(points + base[:, None], circular, place)
        return cls(
            (
                grid,
                np.where(circular, 0.5 / np.pi, 0.0),
                offsets,
                boxes,
                place,
                aligned,
                _edges(corner, slope),
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


def _boxes(points: Array, circular: AnyArray, place: IntArray) -> tuple[IntArray, Array]:
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


@inlined
def _interpolate(edges: Array, x: Array, target: Array, misfit: Array, gradient: Array) -> None:
    """T - target (both relative to the cell's base) and ∂T/∂x at the place x of a cell."""
    x1, y1, z1 = x[0], x[1], x[2]
    x0, y0, z0 = 1.0 - x1, 1.0 - y1, 1.0 - z1
    for q in range(3):
        c = edges[q]
        total, gx, gy, gz = -target[q], 0.0, 0.0, 0.0
        for e in range(4):
            u = y1 if e >> 1 else y0
            v = z1 if e & 1 else z0
            du = 1.0 if e >> 1 else -1.0
            dv = 1.0 if e & 1 else -1.0
            n = 4 * e
            h = c[n] + x1 * (c[n + 1] + x1 * (c[n + 2] + x1 * c[n + 3]))
            total += u * v * h
            gx += u * v * (c[n + 1] + x1 * (2.0 * c[n + 2] + x1 * 3.0 * c[n + 3]))
            gy += du * v * h
            gz += u * dv * h
            u = x1 if e >> 1 else x0
            n = 16 + 3 * e
            h = y1 * (c[n] + y1 * (c[n + 1] + y1 * c[n + 2]))
            total += u * v * h
            gy += u * v * (c[n] + y1 * (2.0 * c[n + 1] + y1 * 3.0 * c[n + 2]))
            gx += du * v * h
            gz += u * dv * h
            v = y1 if e & 1 else y0
            n = 28 + 3 * e
            h = z1 * (c[n] + z1 * (c[n + 1] + z1 * c[n + 2]))
            total += u * v * h
            gz += u * v * (c[n] + z1 * (2.0 * c[n + 1] + z1 * 3.0 * c[n + 2]))
            gx += du * v * h
            gy += u * dv * h
        misfit[q] = total
        gradient[q, 0], gradient[q, 1], gradient[q, 2] = gx, gy, gz


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
def _invert(
    edges: Array, relative: Array, half: Array, work: Array, careful: bool, x: Array
) -> int:
    """Solve a cell's interpolant: 2 solved, 1 nearly so (a fold of the map), 0 not in the cell.

    If not solved, x is left where it missed least, by work[6, 0] of the cell's extent.
    """
    misfit, step, best, gradient = work[0], work[1], work[2], work[3:6]
    least = np.inf
    work[6, 0] = np.inf
    for n in range(8):
        _interpolate(edges, x, relative, misfit, gradient)
        away = max(abs(misfit[0]) / half[0], abs(misfit[1]) / half[1], abs(misfit[2]) / half[2])
        if away < least:
            least = away
            copy(x, best)
        if solve3(gradient, misfit, step) == 0.0:
            break
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
            _interpolate(edges, x, relative, misfit, gradient)
            return 2
    copy(best, x)
    work[6, 0] = least if _outside(x) <= 0.25 else np.inf
    return 1 if least <= _NEARLY and _outside(x) <= 0.25 else 0


@inlined
def _sides(edges: Array, relative: Array, half: Array, x: Array, work: Array, sides: Array) -> bool:
    """Go _SIDE from x both ways, as the interpolant changes least; whether a fold is between."""
    misfit, step, gradient = work[0], work[1], work[3:6]
    _interpolate(edges, x, relative, misfit, gradient)
    most = 0.0
    for q in range(3):
        b, c = (q + 1) % 3, (q + 2) % 3
        scale = 1.0 / (half[b] * half[c])
        d0 = scale * (gradient[b, 1] * gradient[c, 2] - gradient[b, 2] * gradient[c, 1])
        d1 = scale * (gradient[b, 2] * gradient[c, 0] - gradient[b, 0] * gradient[c, 2])
        d2 = scale * (gradient[b, 0] * gradient[c, 1] - gradient[b, 1] * gradient[c, 0])
        size = max(abs(d0), abs(d1), abs(d2))
        if size > most:
            most = size
            step[0], step[1], step[2] = d0 / size, d1 / size, d2 / size
    if most == 0.0:
        return False
    for a in range(3):
        sides[0, a], sides[1, a] = x[a] - _SIDE * step[a], x[a] + _SIDE * step[a]
    _interpolate(edges, sides[0], relative, misfit, gradient)
    det = solve3(gradient, misfit, step)
    _interpolate(edges, sides[1], relative, misfit, gradient)
    return bool(det * solve3(gradient, misfit, step) < 0.0)


@inlined
def _keep(
    grid: Array,
    place: IntArray,
    x: Array,
    gradient: Array,
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
    _inverse(gradient, grid[1], inverses[row])
    return max(count, row + 1)


@inlined
def _inverse(gradient: Array, size: Array, inverse: Array) -> None:
    """∂(η, ψ, ρ)/∂T from ∂T/∂x in cell widths; NaN where there is none."""
    unit, column = np.zeros(3), np.empty(3)
    for c in range(3):
        unit[c] = 1.0
        singular = solve3(gradient, unit, column) == 0.0
        unit[c] = 0.0
        for a in range(3):
            inverse[a, c] = np.nan if singular else column[a] * size[a]


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
    work, relative, x = np.empty((7, 3)), np.empty(3), np.empty(3)
    nearest, sides = np.empty(3), np.empty((2, 3))
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
            least = np.inf
            missed = care[child] == 2 and place[child, 2] >= _RESTING
            for start in range(9 if care[child] > 0 else 1):  # the place itself, then the corners
                if start > 0:
                    for a in range(3):
                        x[a] = (start - 1) >> a & 1
                solved = _invert(edges[child], relative, box[3:, c], work, care[child] > 0, x)
                missed = missed and solved < 2
                if missed and work[6, 0] < least:
                    least = work[6, 0]
                    copy(x, nearest)
                if solved > 0:
                    count = _keep(
                        grid, place[child], x, work[3:6], solved, found, inverses, quality, count
                    )
                if solved == 2 and care[child] < 2:
                    break
            if not missed or least > _MISSED:
                continue
            if _sides(edges[child], relative, box[3:, c], nearest, work, sides):
                for side in range(2):
                    count = _keep(
                        grid,
                        place[child],
                        sides[side],
                        work[3:6],
                        0,
                        found,
                        inverses,
                        quality,
                        count,
                    )
    return count
