"""Equilibrium of a whisker against rigid objects, with any number of contact points and arcs.

Quasi-static and frictionless. The elastic energy is minimal among all shapes that penetrate no
object,

    minimise ½ ∫ (u - u₀)·B (u - u₀) ds   with   d(r(s_j)) - a(s_j) ≥ 0 at nodes s_j,

where d is an object's signed distance and a the whisker's radius. The multipliers λ_j ≥ 0 are the
normal forces; at each node λ_j or the gap is zero. Where the whisker follows an object along an
arc, the force per length is λ_j over the node spacing, and λ at the ends of the arc includes the
concentrated forces there. A contact is on the whisker's side, or at the last node on its tip. On a
smooth convex object the outer end of an arc is the tip, or where the whisker's intrinsic curvature
equals that of the object: only there does the moment vanish, as it must beyond all contacts.

On each element between two nodes, u is linear through its values at two Gauss points; frames follow
from Magnus' method and positions from the same series, both of fourth order. Turning a
cross-section by δθ moves all distal points by δθ × (r_j - r), so the moment there is
Σ (r_j - r) × λ_j n_j: equilibrium holds at the Gauss points. Each round of Newton's method, with
the exact second derivatives of the Lagrangian, solves the dual of the quadratic problem with all
linearised gaps. A contact at a single point gets a node of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.deferred import interpolate, linalg, optimize
from vibrissa.numerics import Array, IntArray, Mask, contacts_in, exponential
from vibrissa.objects import Placement, Surface
from vibrissa.rod.chart import LEAST_ARC

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

# Number of elements of the whisker, and of a compliant base.
ELEMENTS, _JOINT_ELEMENTS = 32, 4
_TAPER_EXPONENT = 0.4
_ROUNDS, _TOLERANCE = 60, 1e-10
_LONGEST = 0.2  # largest rotation of a cross-section in one round, rad
_NEAR = 0.05  # gaps smaller than this, over L, may close in one round
# Largest number of times that nodes move to single contacts, and the move, over L, that ends this.
_MOVES, _MOVED = 6, 1e-6
_SHARED = 0.02  # error of the end of an arc, over the node spacing
_COMPARED_POINTS = 33  # points at which two shapes are compared
# Smallest spacing of nodes after a move, as a share of that before.
_APART = 0.2
_AHEAD = 1e-6  # step for the slope of the radius, toward the tip, over L
_ROOT = np.sqrt(3.0)
_STAGES = np.array([[0.25, 0.25 - _ROOT / 6.0], [0.25 + _ROOT / 6.0, 0.25]])
_GAUSS = np.array([0.5 - _ROOT / 6.0, 0.5 + _ROOT / 6.0])


class Grid(NamedTuple):
    """Elements of a whisker, non-dimensional; those of a compliant base have zero extent."""

    s: Array  # (n + 1,), arc lengths of the nodes; 0 in a compliant base
    # (n,) Widths of the elements, and centreline length per width.
    width: Array
    extent: Array
    stations: Array  # (n, 2), arc lengths of the Gauss points
    # (n, 2, 3) Intrinsic curvature, and stiffness in twist and bending there.
    rest: Array
    stiffness: Array
    # (n + 1,) Radius of the whisker at the nodes, and its derivative.
    radius: Array
    slope: Array
    fixed: Mask  # (n + 1,), nodes at ends and kinks, which stay where they are

    @property
    def first(self) -> float:
        """Arc length of the first node that can be in contact."""
        return float(self.s[self.s > LEAST_ARC][0])

    @classmethod
    def of(cls, whisker: Whisker, elements: int = ELEMENTS) -> Grid:
        """Grid of elements that are shorter where the whisker is thin, with nodes at kinks."""
        s = np.linspace(0.0, 1.0, 2049)
        density = (whisker.radius(s * whisker.length) / whisker.base_radius) ** -_TAPER_EXPONENT
        even = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
        nodes = np.interp(np.linspace(0.0, even[-1], elements + 1), even, s)
        for kink in np.array(whisker.breaks) / whisker.length:
            nodes[1 + np.argmin(np.abs(nodes[1:-1] - kink))] = kink
        return cls.at(whisker, nodes)

    @classmethod
    def at(cls, whisker: Whisker, nodes: Array) -> Grid:
        """Grid of elements between nodes (n + 1,) of the whisker, after those of its base."""
        length, joint = whisker.length, 0 if whisker.base_stiffness is None else _JOINT_ELEMENTS
        width = np.diff(nodes)
        t, weights = np.polynomial.legendre.leggauss(4)
        inside = (0.5 * (nodes[1:] + nodes[:-1]))[:, None] + 0.5 * width[:, None] * t
        curvature = whisker.curvature(inside * length) * length
        soft = (whisker.radius(inside * length) / whisker.base_radius) ** -4.0
        # Values at the Gauss points of the linear function nearest to these samples.
        line = 0.5 * weights + np.outer([-1.0, 1.0], 0.5 * _ROOT * weights * t)
        rest = np.einsum("pg,kgi->kpi", line, curvature)
        stiffness = 1.0 / np.multiply.outer(
            np.einsum("pg,kg->kp", line, soft), [1.0 + whisker.poisson_ratio, 1.0, 1.0]
        )
        at = nodes * length  # where the radius jumps, the thicker side touches first
        radius = np.maximum(whisker.radius(at), whisker.radius(at, side="left")) / length
        kinks = np.array([0.0, *whisker.breaks, length]) / length
        fixed = np.abs(nodes[:, None] - kinks).min(axis=1) < 1e-12
        stations = nodes[:-1, None] + width[:, None] * _GAUSS
        ahead = np.minimum(at + _AHEAD * length, length)
        slope = whisker.radius(ahead, side="left") - whisker.radius(ahead - _AHEAD * length)
        slope /= _AHEAD * length
        if not joint:
            parts = nodes, width, np.ones(width.size), stations, rest, stiffness
            return cls(*parts, radius, slope, fixed)
        assert whisker.base_stiffness is not None
        bending, twist = whisker.base_stiffness
        scale = whisker.base_bending_stiffness / length
        spring = np.broadcast_to(np.array([twist, bending, bending]) / scale, (joint, 2, 3))
        none = np.zeros(joint)
        return cls(
            np.r_[none, nodes],
            np.r_[np.full(joint, 1.0 / joint), width],
            np.r_[none, np.ones(width.size)],
            np.concatenate([np.zeros((joint, 2)), stations]),
            np.concatenate([np.zeros((joint, 2, 3)), rest]),
            np.concatenate([spring, stiffness]),
            np.r_[none, radius],
            np.r_[none, slope],
            np.r_[none == 0.0, fixed],
        )


class Shape(NamedTuple):
    """Positions and frames at the nodes (n + 1, ...) and at the Gauss points (2n, ...)."""

    nodes: Array
    frames: Array
    stations: Array
    turned: Array


def bend(grid: Grid, strain: Array) -> Shape:
    """Integrate the resting curvature plus ``strain`` (n, 2, 3) from base to tip."""
    u = grid.rest + strain
    h = grid.width[:, None]
    turn = 0.5 * h * (u[:, 0] + u[:, 1]) + _ROOT / 12.0 * h**2 * np.cross(u[:, 0], u[:, 1])
    whole, mean = exponential(turn)
    half, _ = exponential(0.5 * turn)
    frames = np.empty((len(h) + 1, 3, 3))
    frames[0] = np.eye(3)
    for i, step in enumerate(whole):
        frames[i + 1] = frames[i] @ step
    e = np.array([1.0, 0.0, 0.0])
    bow = _ROOT / 12.0 * h * np.cross(u[:, 1] - u[:, 0], e)
    step = mean[:, :, 0] - np.einsum("kij,kj->ki", half, bow)
    step = (h * grid.extent[:, None]) * np.einsum("kij,kj->ki", frames[:-1], step)
    nodes = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)])
    part, mean = exponential(np.einsum("pq,kqi->kpi", _STAGES, u) * h[:, None])
    away = (h * grid.extent[:, None] * _GAUSS)[..., None] * mean[..., 0]
    stations = nodes[:-1, None] + np.einsum("kij,kpj->kpi", frames[:-1], away)
    turned = frames[:-1, None] @ part
    return Shape(nodes, frames, stations.reshape(-1, 3), turned.reshape(-1, 3, 3))


class Obstacles:
    """Objects in the frame of the base, non-dimensional."""

    def __init__(self, surfaces: Sequence[Surface], place: Placement, length: float) -> None:
        self._surfaces, self._place, self._length = surfaces, place, length

    def gaps(self, points: Array, radius: Array) -> Array:
        """Distances (surfaces, n) between the whisker's surface at points and the objects."""
        outside = self._place.outside(points * self._length)
        distances = [surface.signed_distance(outside) for surface in self._surfaces]
        return np.array(distances) / self._length - radius

    def normals(self, points: Array, surface: IntArray) -> tuple[Array, Array]:
        """Normals (n, 3) of surfaces at points, and their derivatives (n, 3, 3)."""
        turn = self._place.rotation
        outside = self._place.outside(points * self._length)
        found = [
            self._surfaces[i].local_geometry(p)
            for i, p in zip(surface.tolist(), outside, strict=True)
        ]
        normal = np.array([one[1] for one in found]).reshape(-1, 3)
        curved = np.array([one[2] for one in found]).reshape(-1, 3, 3)
        return normal @ turn, turn.T @ curved @ turn * self._length


class Equilibrium(NamedTuple):
    """Equilibrium of a whisker against objects, non-dimensional, in the whisker frame."""

    grid: Grid  # elements
    strain: Array  # (n, 2, 3), curvature minus that at rest, at the Gauss points
    pressing: Array  # (surfaces, n + 1), normal forces at the nodes
    # (n + 1, 3) and (n + 1, 3, 3) Positions and frames of the nodes.
    nodes: Array
    frames: Array
    # (surfaces, n + 1, 3) Outward normals of the objects at the nodes they touch, else 0.
    normals: Array

    def contacts(self) -> tuple[Array, IntArray, Array, Array]:
        """Arc lengths (k,), object indices, positions (k, 3) and forces (k, 3), ordered by s."""
        node, surface = np.nonzero(self.pressing.T > 0.0)
        push = self.pressing[surface, node, None] * self.normals[surface, node]
        return self.grid.s[node], surface, self.nodes[node], push

    def wrench(self) -> Array:
        """Force and moment (6,) at the base."""
        _, _, place, push = self.contacts()
        return np.concatenate([push.sum(axis=0), np.cross(place, push).sum(axis=0)])

    def first_contact(self) -> tuple[float, Array, Array]:
        """Arc length, position (3,) and standard deviation (3,) of the most proximal contact.

        The concentrated force at the end of an arc is shared by the two nodes next to it, from
        which the end is interpolated. The deviation is along the whisker.
        """
        s, _, _, push = self.contacts()
        node = np.searchsorted(self.grid.s, s)
        row = node - node[0] == np.arange(node.size)
        share = np.linalg.norm(push[:3], axis=1) * row[:3]
        share = np.append(share, np.zeros(3 - share.size))
        inner = np.array([share[0], max(share[1] - share[2], 0.0)])[: s.size]
        at = float(inner @ s[:2] / inner.sum())
        spline = self._spline()
        apart = s[1] - s[0] if row[:2].sum() > 1 else 0.0
        return at, spline(at), _SHARED * apart * spline(at, 1)

    def pressing_on(self, grid: Grid) -> Array:
        """Normal forces at the nearest nodes of another grid, (surfaces, n + 1)."""
        s, surface, _, push = self.contacts()
        out = np.zeros((len(self.pressing), grid.s.size))
        near = np.abs(grid.s[:, None] - s).argmin(axis=0)
        np.add.at(out, (surface, near), np.linalg.norm(push, axis=1))
        return out

    def centerline(self, n: int) -> Array:
        """Points (n, 3), equally spaced in arc length."""
        return np.asarray(self._spline()(np.linspace(0.0, 1.0, n)))

    def _spline(self) -> interpolate.CubicHermiteSpline:
        """Hermite spline of the centreline over s, without the base."""
        on = slice(np.count_nonzero(self.grid.extent == 0.0), None)
        return interpolate.CubicHermiteSpline(
            self.grid.s[on], self.nodes[on], self.frames[on, :, 0]
        )

    def farthest(self, other: Equilibrium) -> float:
        """Largest distance between two shapes at equal arc lengths."""
        away = self.centerline(_COMPARED_POINTS) - other.centerline(_COMPARED_POINTS)
        return float(np.linalg.norm(away, axis=1).max())


def solve_at_nodes(
    obstacles: Obstacles, grid: Grid, strain: Array, pressing: Array
) -> Equilibrium | None:
    """Solve by Newton's method from a guess, at fixed nodes; None if it does not converge."""
    weight = (0.5 * grid.width[:, None, None] * grid.stiffness).reshape(-1)
    for _ in range(_ROUNDS):
        shape = bend(grid, strain)
        if not np.isfinite(shape.nodes).all():
            return None
        gaps = obstacles.gaps(shape.nodes, grid.radius)
        near = (grid.s >= grid.first) & ((gaps < _NEAR) | (pressing > 0.0))
        surface, node = np.nonzero(near)
        normal, curved = obstacles.normals(shape.nodes[node], surface)
        force = pressing[surface, node]
        moves, bends = _derivatives(grid, shape, node, force, normal, curved)
        slopes = np.einsum("jxi,ji->jx", moves, normal)
        found = _solve_quadratic_problem(
            np.diag(weight) - bends, weight, weight * strain.ravel(), slopes, gaps[near]
        )
        if found is None:
            return None
        step, force = found
        step = step.reshape(strain.shape)
        turn = np.cumsum((0.5 * grid.width[:, None, None] * step).reshape(-1, 3), axis=0)
        size = float(np.linalg.norm(turn, axis=1).max())
        share = min(1.0, _LONGEST / max(size, 1e-300))
        strain = strain + share * step
        pressing = (1.0 - share) * pressing
        pressing[surface, node] += share * force
        if size < _TOLERANCE:
            normals = np.zeros((*pressing.shape, 3))
            normals[surface, node] = normal * (force > 0.0)[:, None]
            return Equilibrium(grid, strain, pressing, shape.nodes, shape.frames, normals)
    return None


def _derivatives(
    grid: Grid, shape: Shape, node: IntArray, force: Array, normal: Array, curved: Array
) -> tuple[Array, Array]:
    """Derivatives of nodes by strains (j, 6n, 3), and second derivatives (6n, 6n) of Σ λ gap."""
    count = len(shape.stations)
    axes = np.repeat(0.5 * grid.width, 2)[:, None, None] * np.swapaxes(shape.turned, 1, 2)
    away = shape.nodes[node][:, None] - shape.stations
    away[np.arange(count) >= 2 * node[:, None]] = 0.0
    moves = np.cross(axes, away[:, :, None, :])
    # Two rotations, the first nearer to the base: n·(a × (b × c)) = a·((b × c) × n).
    pulled = np.cross(moves, (force[:, None] * normal)[:, None, None, :]).sum(axis=0)
    bends = axes.reshape(-1, 3) @ pulled.reshape(-1, 3).T
    order = np.sign(np.arange(count)[None] - np.arange(count)[:, None])
    bends *= np.kron(0.5 * (1 + order), np.ones((3, 3)))
    bends += bends.T
    moves = moves.reshape(len(node), 3 * count, 3)
    pushed = force > 0.0
    rolled = np.einsum("j,jxi,jik->jxk", force[pushed], moves[pushed], curved[pushed])
    bends += np.einsum("jxk,jyk->xy", rolled, moves[pushed], optimize=True)
    return moves, bends


def _solve_quadratic_problem(
    matrix: Array, weight: Array, slope: Array, gap_slopes: Array, gaps: Array
) -> tuple[Array, Array] | None:
    """Step and multipliers that minimise the energy with all linearised gaps non-negative."""
    try:
        factor = linalg.cho_factor(matrix)
    except np.linalg.LinAlgError:
        factor = linalg.cho_factor(np.diag(weight))
    free = -linalg.cho_solve(factor, slope)
    if not len(gaps):
        return free, np.zeros(0)
    yielded = linalg.cho_solve(factor, gap_slopes.T)
    compliance = gap_slopes @ yielded
    scale = 1.0 / np.sqrt(np.diag(compliance))
    compliance = compliance * scale[:, None] * scale + 1e-13 * np.eye(len(gaps))
    try:
        root = np.linalg.cholesky(compliance)
        wanted = -np.linalg.solve(root, (gaps + gap_slopes @ free) * scale)
        force = optimize.nnls(root.T, wanted, maxiter=100 * len(gaps))[0] * scale
    except (np.linalg.LinAlgError, RuntimeError):
        return None
    return free + yielded @ force, force


def solve_with_moving_nodes(
    whisker: Whisker, obstacles: Obstacles, grid: Grid, strain: Array, pressing: Array
) -> Equilibrium | None:
    """Solve, moving nodes to where contacts at single points are; None if it fails."""
    found = solve_at_nodes(obstacles, grid, strain, pressing)
    for _ in range(_MOVES):
        if found is None:
            return None
        nodes = _nodes_at_contacts(found, obstacles)
        if np.abs(nodes - found.grid.s).max() < _MOVED:
            return found
        grid = Grid.at(whisker, nodes[found.grid.s.size - np.count_nonzero(nodes) - 1 :])
        found = solve_at_nodes(obstacles, grid, transfer_strain(found, grid), found.pressing)
    return found


def transfer_strain(found: Equilibrium, grid: Grid) -> Array:
    """Strains on another grid that have the moments of an equilibrium."""
    moment, out = found.grid.stiffness * found.strain, np.empty_like(grid.stiffness)
    before, now = found.grid.extent > 0.0, grid.extent > 0.0
    out[~now] = moment[~before]
    known, wanted = found.grid.stations[before].ravel(), grid.stations[now].ravel()
    for i in range(3):
        out[now, :, i] = np.interp(wanted, known, moment[before, :, i].ravel()).reshape(-1, 2)
    return np.asarray(out / grid.stiffness)


def _nodes_at_contacts(found: Equilibrium, obstacles: Obstacles) -> Array:
    """Arc lengths of the nodes, with one moved to each contact at a single point."""
    grid, nodes = found.grid, found.grid.s.copy()
    last = nodes.size - 1
    for i, pressed in enumerate(found.pressing > 0.0):
        for first, stop in contacts_in(pressed):
            if stop - first > 2:
                continue
            around = np.arange(max(first - 1, 1), min(stop, last) + 1)
            normal, curved = obstacles.normals(found.nodes[around], np.full(around.size, i))
            along = found.frames[around, :, 0]
            slope = np.einsum("ji,ji->j", along, normal) - grid.slope[around]
            rising = np.flatnonzero((slope[:-1] < 0.0) & (slope[1:] >= 0.0))
            if not rising.size:
                continue  # contact of the tip
            k = int(rising[0])
            a, b = grid.s[around[k]], grid.s[around[k + 1]]
            at = a - slope[k] * (b - a) / (slope[k + 1] - slope[k])
            pair = [k, k + 1] if at - a < b - at else [k + 1, k]
            free = [j for j in pair if not grid.fixed[around[j]]]
            if not free:
                continue
            # Here the slope increases as the whisker bends and the surface curves away.
            j, near = free[0], int(around[free[0]])
            turning = (along[k + 1] - along[k]) @ normal[j] / (b - a)
            steep = turning + along[j] @ curved[j] @ along[j]
            at = np.clip(grid.s[near] - slope[j] / steep, a, b) if steep > 0.0 else at
            low, high = grid.s[near - 1], grid.s[near + 1]
            keep = _APART * (grid.s[near] - low), _APART * (high - grid.s[near])
            nodes[near] = np.clip(at, low + keep[0], high - keep[1])
    return nodes


def strain_under_force(grid: Grid, arc: float, force: Array, point: Array) -> Array:
    """Strains (n, 2, 3) of a whisker bent by one force at an arc length, from the base outward."""
    strain = np.zeros_like(grid.rest)
    frame, place, e = np.eye(3), np.zeros(3), np.array([1.0, 0.0, 0.0])
    for i, (h, extent) in enumerate(zip(grid.width, grid.extent, strict=True)):
        for k in range(2):
            for _ in range(2):
                part, mean = exponential(_GAUSS[k] * h * (grid.rest[i, k] + strain[i, k]))
                at = place + extent * _GAUSS[k] * h * (frame @ mean @ e)
                loaded = extent == 0.0 or grid.stations[i, k] < arc
                moment = np.cross(point - at, force) if loaded else np.zeros(3)
                strain[i, k] = (frame @ part).T @ moment / grid.stiffness[i, k]
        part, mean = exponential(h * (grid.rest[i] + strain[i]).mean(axis=0))
        place = place + extent * h * (frame @ mean @ e)
        frame = frame @ part
    return strain
