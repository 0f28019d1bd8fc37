"""Search tree over the cells of a chart, by the values of three quantities.

Three quantities T (the contact point's coordinates, or three base signals) are known with their
exact derivatives at the nodes of the chart (:mod:`vibrissa.rod.chart`). In each cell T is a cubic
blended between the cell's twelve edges: with H the cubic Hermite curve along an edge and V the
straight line between its ends, Σ w H over the four edges along η plus Σ w (H - V) over those along
ψ and ρ, w the bilinear weights across. It reproduces all cubics, so its error is of fourth order;
the Bézier points of the edges bound it.

Quantities that vanish at rest in proportion to the force or to its square are divided by it, and by
one of them in the coordinates aligned with a cell, so that cells at rest are as regular as others.

Boxes around the cells' values, and around those of 2 × 2 × 2 neighbours, and so on, form a tree;
the cells that may contain a target are those whose boxes, and all boxes above them, contain it, and
which still contain it in coordinates aligned with the cell (:mod:`vibrissa.rod.search`). Angles are
compared on the circle.

Length and direction of a vector of the plane, such as the transverse force, are not smooth where
the vector vanishes, and cannot be interpolated by polynomials there. Cells where it may vanish are
*polar*: they interpolate the two components of the vector instead.

**Balance.** Along an unloaded part of a rod of constant section and intrinsic curvature u₀

    n·e₁ + m·u₀ + ½ m·B⁻¹m

is constant, n and m being force and moment in the material frame. At a contact without friction it
is zero, as n is normal to the rod and m vanishes, so that at the base F_x = -M·u₀ - ½ M·B⁻¹M. Of a
wire, F_x is thus nearly a function of the moment, and what distinguishes contacts is the small rest

    H = F_x + M·u₀ + ½ M·B⁻¹M,

in which terms that need components of M that are not measured are left out. Of any whisker, H and
the other signals contain the same information as F_x and the others, but H can be interpolated, and
cells interpolate it instead of F_x.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, kernel
from vibrissa.rod.chart import LEAST_LOAD, Fold, StableSet
from vibrissa.rod.discretization import Rod


class Balance(NamedTuple):
    """How H depends on three quantities."""

    # (4,) Indices of F_x, M_B, M_D and M_x among the quantities; -1 for none.
    parts: IntArray
    # (5,) Weights of M_B²/2, M_B cos β, M_B sin β, M_x and M_x²/2, with β = M_D.
    weights: Array

    @classmethod
    def none(cls) -> Balance:
        """Return a balance that leaves quantities as they are."""
        return cls(np.full(4, -1), np.zeros(5))

    @classmethod
    def of(cls, rod: Rod, parts: list[int]) -> Balance:
        """Balance at the base of a rod; see ``parts``."""
        at_base = int(np.searchsorted(rod.start, 0.0))
        twist, by_y, by_z = rod.shape[at_base, :3, 0]
        weights = np.array([1.0, by_y, by_z, twist, rod.twist[at_base]])
        present = np.array(parts) >= 0
        weights *= present[[1, 2, 2, 3, 3]] & present[[1, 1, 1, 3, 3]] & present[0]
        return cls(np.array(parts), weights)


@inlined
def balanced(balance: Balance, values: Array, out: Array, slopes: Array) -> None:
    """Fill three quantities with H instead of F_x, and the derivatives of H by the others."""
    parts, w = balance.parts, balance.weights
    for q in range(3):
        out[q] = values[q]
    slopes[0] = slopes[1] = slopes[2] = 0.0
    if parts[0] < 0:
        return
    if parts[1] >= 0:
        size, cos, sin = values[parts[1]], 0.0, 0.0
        if parts[2] >= 0:
            cos, sin = np.cos(values[parts[2]]), np.sin(values[parts[2]])
            slopes[parts[2]] = size * (w[2] * cos - w[1] * sin)
        along = w[1] * cos + w[2] * sin
        out[parts[0]] += size * (0.5 * w[0] * size + along)
        slopes[parts[1]] = w[0] * size + along
    if parts[3] >= 0:
        twist = values[parts[3]]
        out[parts[0]] += twist * (w[3] + 0.5 * w[4] * twist)
        slopes[parts[3]] = w[3] + w[4] * twist


@kernel
def balance_rows(balance: Balance, values: Array, slopes: Array) -> None:
    """Replace F_x by H in values (n, 3) and derivatives (n, 3, 3) by any coordinates."""
    out, by, first = np.empty(3), np.empty(3), balance.parts[0]
    for row in range(values.shape[0] if first >= 0 else 0):
        balanced(balance, values[row], out, by)
        copy(out, values[row])
        for q in range(3):
            for a in range(3):
                slopes[row, first, a] += by[q] * slopes[row, q, a]


_MARGIN = 0.08  # boxes are widened by this share of their size for what the cubic misses
# A quantity whose ratio to the force is at rest below this share of the largest one vanishes at
# rest in proportion to the square of the force.
_FASTER = 1e-6
# A quantity has one sign in a cell if its least absolute value exceeds this share of the largest.
_SIGNED = 0.1
# Relative determinant of a cell's linear part below which the cell is not aligned.
_FLAT = 1e-3
#: A cell may contain a fold, and so two solutions, if at a corner the volume spanned by the slopes
#: is below this share of the largest, or of opposite sign.
FOLDED = 0.03
#: One start may miss a cell's only solution if that share is below this, or if the cell is larger
#: than the next in its own aligned coordinates, in which the unit cube is 1.
EVEN = 0.1
_SHEARED = 3.0
# Angle (to either side, rad) through which a vector turns in a cell in which it may vanish.
_TURNED = 0.9


class SearchTree(NamedTuple):
    """Cells of a chart and the values of three quantities in them, for the kernels."""

    fold: Fold  # fold force over the chart
    grid: Array  # (2, 3), chart coordinates of the first corner, and size of a cell
    turns: Array  # (3,), 1/2π for angles, 0 for other quantities
    offsets: IntArray  # (levels + 1,), first row of each level in ``boxes``
    boxes: Array  # (m, 6, 8), middle and half width of the values in eight sibling blocks
    balance: Balance  # quantities that cells interpolate
    # (3,) Power of the force that quantities vanish with at rest: 1, 2, or 0 if they do not; and
    # their sizes over it, 0 for the latter.
    powers: IntArray
    scale: Array
    place: IntArray  # (n, 3), position of each cell in the grid
    # (n, 6, 3) Coordinates in which a cell is nearly the unit cube (inverse, origin), and its
    # extent in them (lower, upper).
    frame: Array
    # (n, 7, 3) The same for quantities over one of those that vanish at rest, and the root of that
    # one; and half widths of the interpolated values.
    blown: Array
    # (n,) Index of that one, from 1, with its sign in the cell; 0 if none has one sign: then the
    # quantities themselves are used.
    pivot: IntArray
    edges: Array  # (n, 160), coefficients of the cells' interpolants
    # (n,) Starts needed by a cell: 0 one, 1 several until one is solved, 2 all of them.
    care: IntArray
    polar: IntArray  # (n,), row of a polar cell among the polar ones, -1 for other cells
    vector: Polar  # polar cells

    @classmethod
    def none(cls) -> SearchTree:
        """Return a tree without cells, as an example of the types."""
        one, two, three = (np.empty((0,) * n) for n in (1, 2, 3))
        count, place = np.empty(0, np.int64), np.empty((0, 3), np.int64)
        cells = count, one, place, three, three, count, two, count, count, Polar.none()
        return cls(Fold(one, three), two, one, count, three, Balance.none(), *cells)


class PlaneVector(NamedTuple):
    """A vector of the plane whose length, direction, or both are among the quantities."""

    values: Array  # (i, j, k, 2), components at the chart's nodes
    derivatives: Array  # (i, j, k, 2, 3), derivatives of the values by ξ there
    # Index of its length and of its direction among the quantities, -1 if it is not one of them.
    length: int
    direction: int
    # Components of its lever, if the other quantity is its moment about the axis, and their
    # derivatives by ξ.
    lever: tuple[Array, Array] | None = None


def search_tree(
    chart: StableSet,
    values: Array,
    derivatives: Array,
    angles: tuple[bool, ...],
    plane: PlaneVector | None = None,
    vanishing: tuple[bool, ...] = (False, False, False),
    balance: Balance | None = None,
) -> SearchTree:
    """Build the tree for the search for contacts with given values of three quantities.

    ``values`` (i, j, k, 3) are those at the chart's nodes, ``derivatives`` (i, j, k, 3, 3) theirs
    by ξ. ``plane`` is the vector whose length, direction, or both are among the quantities, and
    ``balance`` that of force and moment, if F_x is. Flags state which are angles, and which
    vanish at rest.
    """
    size = np.array([1.0, 2.0 * np.pi, 1.0]) / (np.array(values.shape[:3]) - 1)
    circular = np.array(angles)
    place = _octree_order(tuple(n - 1 for n in values.shape[:3]))
    slopes, balance = chart.charted(derivatives) * size, balance or Balance.none()
    cells = _Cells.of(place, values, slopes, circular)
    low, high = cells.extent()
    frame = _aligned_coordinates(cells)
    values, slopes = values.copy(), np.ascontiguousarray(slopes)
    balance_rows(balance, values.reshape(-1, 3), slopes.reshape(-1, 3, 3))
    cells = _Cells.of(place, values, slopes, circular)
    powers, scale, smooth, smooth_slopes = _smooth(chart, values, slopes, np.array(vanishing))
    interpolated = _Cells.of(place, smooth, smooth_slopes, np.append(circular, False))
    half = 0.5 * np.subtract(*interpolated.extent()[::-1])[:, None, :3]
    interpolated.corner[...] += np.where([*(powers > 0), True], interpolated.base, 0.0)
    blown, pivot = _blown_up(cells, interpolated, powers, scale, place[:, 2])
    in_blown = _aligned_coordinates(blown)
    care = _starts_needed(blown.slope, in_blown)
    if powers.any():  # equations of quantities that are not of one sign are far from linear at rest
        care[(pivot == 0) & (place[:, 2] == 0) & (care == 0)] = 1
    polar = Polar.none()
    if plane is not None:
        slopes = chart.charted(plane.derivatives) * size
        vector = _Cells.of(place, plane.values, slopes, np.zeros(2, dtype=bool))
        extent = 0.5 * np.subtract(*cells.extent()[::-1])
        polar = Polar.of(cells, vector, plane.length, plane.direction, extent)
        if plane.length >= 0:
            low[polar.rows, plane.length] = 0.0
            high[polar.rows, plane.length] = polar.frame[:, 7]
        if plane.direction >= 0:
            low[polar.rows, plane.direction] = -np.pi
            high[polar.rows, plane.direction] = np.pi
        if plane.lever is not None:
            slopes = chart.charted(plane.lever[1]) * size
            lever = _Cells.of(place[polar.rows], plane.lever[0], slopes, np.zeros(2, dtype=bool))
            least, most = lever.extent()
            wide = (0.5 + _MARGIN) * (most - least)
            polar = polar._replace(lever=np.concatenate([0.5 * (least + most), wide], axis=1))
        care[polar.rows] = 2
    offsets, boxes = _bounding_boxes(low, high, circular)
    row = np.full(len(place), -1)
    row[polar.rows] = np.arange(len(polar.rows))
    return SearchTree(
        chart.fold,
        np.stack([np.zeros(3), size]),
        np.where(circular, 0.5 / np.pi, 0.0),
        offsets,
        boxes,
        balance,
        powers,
        scale,
        place,
        frame,
        np.ascontiguousarray(np.concatenate([in_blown, half], axis=1)),
        pivot,
        _edge_coefficients(interpolated),
        care,
        row,
        polar,
    )


class _Cells(NamedTuple):
    """Quantities in cells.

    base (cells, q): values at the first corner; corner (2, 2, 2, cells, q): values relative to it;
    slope (2, 2, 2, cells, q, 3): derivatives in cell widths.
    """

    base: Array
    corner: Array
    slope: Array

    @classmethod
    def of(cls, place: IntArray, values: Array, slopes: Array, circular: AnyArray) -> _Cells:
        """Take them from the nodes of the chart."""
        i, j, k = place.T
        index = _corners(place)
        corner, slope = values[index], slopes[index]
        corner = corner - corner[0, 0, 0]
        if circular.any():
            turns = np.round(corner[..., circular] / (2.0 * np.pi))
            corner[..., circular] -= 2.0 * np.pi * turns
        return cls(values[i, j, k], corner, slope)

    def _inward(self, axis: int) -> Array:
        """A third of the slopes along an axis, directed from each corner into the cell."""
        sign = np.array([1.0, -1.0]).reshape([2 if a == axis else 1 for a in range(5)])
        return np.asarray(self.slope[..., axis] * (sign / 3.0))

    def points(self) -> Array:
        """Bézier points (64, cells, q) relative to the base: corners moved along any axes."""
        moved = np.empty((8, *self.corner.shape))
        moved[0] = self.corner
        for axis, first in enumerate((1, 2, 4)):  # with it, each subset of the axes before
            np.add(moved[:first], self._inward(axis), out=moved[first : 2 * first])
        return moved.reshape(64, *self.base.shape)

    def extent(self) -> tuple[Array, Array]:
        """Least and largest of the Bézier points, (cells, q) each."""
        low, high = self.corner, self.corner
        for axis in range(3):
            inward = self._inward(axis)
            low, high = low + np.minimum(inward, 0.0), high + np.maximum(inward, 0.0)
        return self.base + low.min(axis=(0, 1, 2)), self.base + high.max(axis=(0, 1, 2))

    def slopes(self) -> Array:
        """Mean slopes between corners: (cells, q, 3)."""
        columns = [np.diff(self.corner, axis=axis).mean(axis=(0, 1, 2)) for axis in range(3)]
        return np.stack(columns, axis=-1)

    def linear(self) -> Array:
        """Mean slopes, and middle and half width of the remainder: (cells, q, 5)."""
        slopes = self.slopes()
        ends = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1)
        corner = self.corner - np.einsum("cqa,ijka->ijkcq", slopes, ends)
        low, high = _Cells(np.zeros_like(self.base), corner, self.slope - slopes).extent()
        rest = np.stack([0.5 * (low + high), (0.5 + _MARGIN) * (high - low)], axis=-1)
        return np.concatenate([slopes, rest], axis=-1)


class Polar(NamedTuple):
    """Polar cells and the values of the vector and the other quantities in them."""

    rows: IntArray  # (p,), their indices among all cells
    edges: Array  # (p, 160), coefficients of their interpolants
    frame: Array  # (p, 8), base values, and the sizes used as the cell's extent
    linear: Array  # (p, 4, 5), mean slopes, and middle and half width of the remainder
    # (p, 8, 2) Volumes spanned by the slopes at the corners, for each component of the vector.
    volumes: Array
    # (4,) Indices of length, direction and the others among the quantities; -1 for none.
    roles: IntArray
    # (p, 4) Middle and half width of the lever (y, z) of the vector in each cell, if the third
    # quantity is the moment of the vector, which vanishes with it; else without rows.
    lever: Array

    @classmethod
    def none(cls) -> Polar:
        """Return an instance without polar cells."""
        edges, frame, lever = np.empty((0, 160)), np.empty((0, 8)), np.empty((0, 4))
        linear, volumes = np.empty((0, 4, 5)), np.empty((0, 8, 2))
        return cls(np.empty(0, int), edges, frame, linear, volumes, np.full(4, -1), lever)

    @classmethod
    def of(cls, cells: _Cells, vector: _Cells, length: int, direction: int, half: Array) -> Polar:
        """Find the cells in which a vector may vanish; half (cells, 3): extents of quantities."""
        y, z = np.moveaxis(vector.points() + vector.base, -1, 0)
        size = np.sqrt(y * y + z * z)
        some = np.where(size > 0.0, size, 1.0)
        y, z = y / some, z / some
        middle = np.stack([y.mean(axis=0), z.mean(axis=0)])
        middle /= np.maximum(np.linalg.norm(middle, axis=0), 1e-300)
        rows = np.flatnonzero((y * middle[0] + z * middle[1]).min(axis=0) < np.cos(_TURNED))
        others = [q for q in range(3) if q not in (length, direction)]
        remaining = _Cells(
            cells.base[:, others], cells.corner[..., others], cells.slope[..., others, :]
        )
        both = _Cells(
            np.concatenate([a.base[rows] for a in (vector, remaining)], axis=-1),
            np.concatenate([a.corner[:, :, :, rows] for a in (vector, remaining)], axis=-1),
            np.concatenate([a.slope[:, :, :, rows] for a in (vector, remaining)], axis=-2),
        )
        longest = (1.0 + _MARGIN) * size[:, rows].max(axis=0)
        frame = np.zeros((len(rows), 8))
        frame[:, : both.base.shape[1]] = both.base
        frame[:, 4:] = longest[:, None]
        frame[:, 7 - len(others) : 7] = half[rows][:, others] + 1e-12
        linear = np.zeros((len(rows), 4, 5))
        linear[:, : both.base.shape[1]] = both.linear()
        roles = np.full(4, -1)
        roles[: 2 + len(others)] = length, direction, *others
        return cls(
            rows,
            _edge_coefficients(both),
            frame,
            linear,
            _spanned_volumes(both.slope, len(others)),
            roles,
            np.empty((0, 4)),
        )


def _spanned_volumes(slope: Array, others: int) -> Array:
    """Volumes of `Polar.volumes`, relative to the slopes' lengths."""
    slope = np.moveaxis(slope.reshape(8, *slope.shape[3:]), 0, 1)
    out = np.zeros((len(slope), 8, 2))
    size = np.linalg.norm(slope[..., 2:, :], axis=-1).prod(axis=-1)
    size *= np.linalg.norm(slope[..., :2, :], axis=(-2, -1)) ** (3 - others)
    size = np.where(size > 0.0, size, 1.0)
    if others == 1:
        out[..., 0] = np.linalg.det(slope) / size
        return out
    for component in range(2):
        out[..., component] = np.linalg.det(slope[..., [component, 2, 3], :]) / size
    return out


def _corners(place: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Indices of the cells' corners among the nodes: (2, 2, 2, cells)."""
    two = np.arange(2)[:, None]
    i, j, k = place.T
    return i + two[:, None, None], j + two[:, None], k + two


def _smooth(
    chart: StableSet, values: Array, slopes: Array, vanishing: AnyArray
) -> tuple[IntArray, Array, Array, Array]:
    """What cells interpolate, at the nodes, with its slopes; see `SearchTree.powers` for the rest.

    What vanishes at rest is divided by the force or its square, and 1/√f* in cells joins it.
    """
    powers = vanishing.astype(np.int64)
    out, by = _over_force(chart, values, slopes, powers)
    size = np.abs(out[..., :3]).max(axis=(0, 1, 2))
    powers[vanishing & (np.abs(out[:, :, 0, :3]).max(axis=(0, 1)) < _FASTER * size)] = 2
    if (powers == 2).any():
        if not (powers == 1).any():  # no other quantity determines the force
            powers[:] = 0
        out, by = _over_force(chart, values, slopes, powers)
        size = np.abs(out[..., :3]).max(axis=(0, 1, 2))
    return powers, np.where(powers > 0, size, 0.0), out, by


def _over_force(
    chart: StableSet, values: Array, slopes: Array, powers: IntArray
) -> tuple[Array, Array]:
    """Quantities at the nodes over powers of the force, and 1/√f* in cells, with their slopes."""
    grid, step = values.shape[:3], chart.loads[1]
    loads = np.maximum(chart.loads, LEAST_LOAD) / step
    log, by_eta, by_psi = np.moveaxis(chart.fold.log_force[:, :, None, :3], -1, 0)
    rise = np.empty((*grid, 3))
    rise[..., 0], rise[..., 1], rise[..., 2] = by_eta / (grid[0] - 1), by_psi, 2.0 / loads
    rise[..., 1] *= 2.0 * np.pi / (grid[1] - 1)
    force = (np.exp(log) * (step * loads) ** 2)[..., None] ** powers
    out, by = np.empty((*grid, 4)), np.zeros((*grid, 4, 3))
    out[..., :3], out[..., 3] = values / force, np.exp(-0.5 * log) / step
    by[..., :3, :] = slopes / force[..., None]
    by[..., :3, :] -= (powers * out[..., :3])[..., None] * rise[..., None, :]
    by[..., 3, :2] = -0.5 * out[..., 3, None] * rise[..., :2]
    if powers.any():  # near rest all of it is linear in the force, ρ²: the nodes lead there
        out[:, :, 0] -= 0.5 * loads[0] * by[:, :, 0, :, 2]
        by[:, :, 0, :, 2] = 0.0
        rest = loads[0] ** 2 / (loads[1] ** 2 - loads[0] ** 2)
        by[:, :, 0, :, :2] -= rest * (by[:, :, 1, :, :2] - by[:, :, 0, :, :2])
    return out, by


def _blown_up(
    cells: _Cells, interpolated: _Cells, powers: IntArray, scale: Array, layer: IntArray
) -> tuple[_Cells, IntArray]:
    """Quantities over the one that vanishes at rest and nowhere else in a cell, and its root.

    These are regular at rest. Return which one it is, see `SearchTree.pivot`.
    """
    if not powers.any():
        whole = cells._replace(corner=cells.corner - cells.corner[0, 0, 0])
        return whole, np.zeros(len(cells.base), np.int64)
    value, slope = interpolated.corner[..., :3], interpolated.slope[..., :3, :]
    sign = np.sign(value[0, 0, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        least = np.where(powers == 1, (sign * value).min(axis=(0, 1, 2)) / scale, -np.inf)
        number = np.argmax(least, axis=-1)
        every = np.arange(len(number))
        most = np.abs(value).max(axis=(0, 1, 2))[every, number] / scale[number]
        usable = least[every, number] > _SIGNED * most
        over, by = value[..., every, number], slope[..., every, number, :]
        power = over[..., None] ** powers
        ratio = value / power
        by_over = (powers * value / over[..., None])[..., None] * by[..., None, :]
        by_ratio = (slope - by_over) / power[..., None]
        root = np.sqrt(np.abs(over)) / interpolated.corner[..., 3]
        shrink = interpolated.slope[..., 3, :] / interpolated.corner[..., 3, None]
        load = (layer + np.arange(2)[:, None]) * root
        by_load = load[..., None] * (0.5 * by / over[..., None] - shrink)
    by_load[..., 2] += root
    pivots = np.arange(3) == number[:, None]
    blown = np.where(pivots, load[..., None], np.where(powers > 0, ratio, value))
    by_blown = np.where((powers > 0)[:, None], by_ratio, slope)
    by_blown = np.where(pivots[..., None], by_load[..., None, :], by_blown)
    corner = np.where(usable[:, None], blown, cells.corner)
    base = np.where((powers > 0) & usable[:, None], corner[0, 0, 0], cells.base)
    corner = corner - corner[0, 0, 0]
    out = _Cells(base, corner, np.where(usable[:, None, None], by_blown, cells.slope))
    return out, np.where(usable, sign[every, number] * (number + 1), 0.0).astype(np.int64)


def _octree_order(cells: tuple[int, ...]) -> IntArray:
    """Order cells (i, j, k) so that runs of 8 are 2 × 2 × 2 blocks, runs of 64 blocks of those."""
    depth = int(np.log2(min(cells)))
    if any(n % 2**depth for n in cells):
        raise ValueError(f"the chart has {cells} cells; they must be multiples of {2**depth}")
    place = np.stack(np.meshgrid(*(np.arange(n >> depth) for n in cells), indexing="ij"), axis=-1)
    place = place.reshape(-1, 3)
    block = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)
    for _ in range(depth):
        place = (2 * place[:, None] + block).reshape(-1, 3)
    return np.ascontiguousarray(place)


def _bounding_boxes(low: Array, high: Array, circular: AnyArray) -> tuple[IntArray, Array]:
    """Middle and half width of the values in cells and in larger blocks, 8 siblings a row."""
    grow = _MARGIN * (high - low) + 1e-12
    low, high = low - grow, high + grow
    levels = []
    while True:
        half = 0.5 * (high - low)
        half = np.where(circular & (half > np.pi), np.inf, half)
        box = np.concatenate([0.5 * (low + high), half], axis=-1)
        lone = len(box) % 8
        if lone:  # fill the row of the few blocks at the top with boxes that contain nothing
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


def _aligned_coordinates(cells: _Cells) -> Array:
    """Coordinates in which each cell is nearly the unit cube, and its extent in them."""
    linear = cells.slopes()
    with np.errstate(divide="ignore", invalid="ignore"):
        even = linear / np.linalg.norm(linear, axis=2, keepdims=True)  # independent of units
        flatness = np.abs(np.linalg.det(even)) / np.prod(np.linalg.norm(even, axis=1), axis=-1)
    usable = flatness > _FLAT
    inverse = np.zeros_like(linear)
    inverse[usable] = np.linalg.inv(linear[usable])
    corner = (inverse @ cells.corner[..., None])[..., 0]
    low, high = _Cells(np.zeros_like(cells.base), corner, inverse @ cells.slope).extent()
    grow = _MARGIN * (high - low) + 1e-9
    return np.ascontiguousarray(
        np.concatenate(
            [inverse, cells.base[:, None], (low - grow)[:, None], (high + grow)[:, None]], axis=1
        )
    )


def _edge_coefficients(cells: _Cells) -> Array:
    """Coefficients of the interpolants, quantities and padding interleaved: (cells, 160).

    In order: cubics along η at the corners of (ψ, ρ), then corrections along ψ and along ρ.
    """
    n, q = cells.base.shape
    out = np.zeros((n, 40, 4))
    place = 0
    for axis in range(3):
        v, d = np.moveaxis(cells.corner, axis, 0), np.moveaxis(cells.slope[..., axis], axis, 0)
        rise = v[1] - v[0]
        square = 3.0 * rise - 2.0 * d[0] - d[1]
        cube = d[0] + d[1] - 2.0 * rise
        terms = [v[0], d[0], square, cube] if axis == 0 else [d[0] - rise, square, cube]
        for edge in np.ndindex(2, 2):
            for term in terms:
                out[:, place, :q] = term[edge]
                place += 1
    return out.reshape(n, 160)


def _starts_needed(slope: Array, aligned: Array) -> IntArray:
    """Number of starts that a cell needs: 0 one, 1 several until one is solved, 2 all of them."""
    det = np.linalg.det(slope)
    # Slopes along ρ vanish at rest, which is not a fold. Those along ψ may vanish on one: where
    # signals are the same on either side of the plane of a planar whisker.
    length = np.linalg.norm(slope, axis=-2)
    length[..., :2] = length[..., :2].max(axis=(0, 1, 2))
    size = np.prod(length, axis=-1)
    flatness = (det / np.where(size > 0.0, size, 1.0)).reshape(8, -1)
    flatness *= np.sign(flatness[0])
    least, most = flatness.min(axis=0), np.abs(flatness).max(axis=0)
    sheared = (aligned[:, 5] - aligned[:, 4]).max(axis=1) > _SHEARED
    sheared |= ~aligned[:, :3].any(axis=(1, 2))  # not aligned
    return np.where(least <= FOLDED * most, 2, np.where((least <= EVEN * most) | sheared, 1, 0))
