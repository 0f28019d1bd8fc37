"""Solver for the frictionless contact at a given point.

Newton's method starts from seeds of the chart. For some whiskers the contact point is not injective
on Ω: a nearly cylindrical helix may touch one point in two ways. The answer is the equilibrium of
least force. A solution is therefore ambiguous where another seed has less force, or where the point
is so near the resting whisker that a light contact is possible. There, and where no seed leads to a
solution, contacts are followed from all starts, and the one of least force that arrives is taken.
Where there is none, the nearest face of the chart determines the status.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from vibrissa.deferred import spatial
from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, kernel, norm3, share_out
from vibrissa.rod.chart import (
    LEAST_ARC,
    Fold,
    StableSet,
    arc_length,
    chart_to_contact,
    contacts_at,
    fold_force,
    fold_forces,
    stable_set,
    with_normal_force,
)
from vibrissa.rod.continuation import POINT, follow
from vibrissa.rod.discretization import Bendable, Rod, discretize
from vibrissa.rod.integration import share_rows, solve_forces
from vibrissa.rod.kernels import BUFFER_SIZE, LANES
from vibrissa.rod.newton import ABOVE_FOLD, TOLERANCE, group_room, newton_group, stable, start_from
from vibrissa.rod.search import MOST_SEEDS, compile_seeds, seed_room, seeds
from vibrissa.rod.tree import SearchTree, search_tree
from vibrissa.status import Status

# A point without a seed is unreachable, and the nearest face of the chart determines the status.
# Points within this distance (over L) of a face are nevertheless approached from inside, in case of
# an error of the interpolant; and those within it of the resting whisker, where bearings are
# ill-defined and there may be no seed, are approached from there.
_NEAR = 0.01
_FACE = 65  # points along each edge of the chart's faces
_RESTING = 33  # points along the resting whisker, as a polygon
# Points within this distance of the resting whisker (over L) are solved from there. Contacts with
# more than this ρ (root of the share of the fold force) are not light.
_LIGHT = 1e-3
_HEAVY = 0.25
_APART = 0.05  # seeds closer than this in η and ρ lead to the same solution
# Largest number of starts followed for one point, and largest ρ at which they start.
_STARTS = 8
_SHORT_OF_FOLD = 0.99
_REACHED_RESIDUAL = 1e-9  # largest residual of a point that was reached, possibly at a fold
# Larger coordinates (over L) are clipped, because their squares might overflow.
_LARGEST_COORDINATE = 1e3


class Solutions(NamedTuple):
    """Solved rows, non-dimensional: (s, f) at the contact, (F, p), residual and status."""

    contacts: Array
    values: Array
    misfits: Array
    statuses: IntArray

    @classmethod
    def empty(cls, n: int) -> Solutions:
        """Return n rows without a solution."""
        missing = np.full(n, int(Status.MISSING))
        return cls(np.full((n, 4), np.nan), np.full((n, 6), np.nan), np.full(n, np.nan), missing)

    def put(self, rows: IntArray, part: Solutions) -> None:
        """Replace rows."""
        for mine, theirs in zip(self, part, strict=True):
            mine[rows] = theirs


@inlined
def _point_equation(
    value: Array, tangents: Array, wanted: bool, target: Array, residual: Array, jacobian: Array
) -> float:
    """Equation p = target; see :mod:`vibrissa.rod.newton`."""
    for a in range(3):
        residual[a] = value[3 + a] - target[a]
        if wanted:
            for c in range(3):
                jacobian[a, c] = tangents[3 + a, c]
    return norm3(residual)


@inlined
def _force(fold: Fold, chart: Array) -> float:
    """Force of a seed (η, ψ, ρ)."""
    strength = fold_force(fold, arc_length(fold.bounds, chart[0]), chart[1])
    return float(chart[2] * chart[2] * strength)


@inlined
def _apart(a: Array, b: Array) -> bool:
    """Whether two seeds lead to different solutions."""
    return bool(max(abs(a[0] - b[0]), abs(a[2] - b[2])) > _APART)


@inlined
def _near_rest(resting: Array, point: Array) -> bool:
    """Whether a point may be within ``_NEAR`` of the resting whisker."""
    x, y, z = point[0], point[1], point[2]
    reached = (_NEAR + 0.5 / (_RESTING - 1)) ** 2
    near = 0
    for i in range(resting.shape[1]):  # without branches, so that it vectorises
        u, v, w = resting[0, i] - x, resting[1, i] - y, resting[2, i] - z
        near |= 1 if u * u + v * v + w * w < reached else 0
    return near == 1


@inlined
def _touch(resting: Array, point: Array) -> tuple[float, float]:
    """Closest point of the resting whisker: its arc length, and the squared distance."""
    last = resting.shape[1] - 1
    least, where = np.inf, 0.0
    for i in range(last):
        along = length = here = 0.0
        for a in range(3):
            side, away = resting[a, i + 1] - resting[a, i], point[a] - resting[a, i]
            along, length, here = along + side * away, length + side * side, here + away * away
        part = min(max(along / length, 0.0), 1.0)
        distance = here + part * (part * length - 2.0 * along)
        if distance < least:
            least, where = distance, (i + part) / last
    return LEAST_ARC + (1.0 - LEAST_ARC) * where, least


@inlined
def _light_touch(resting: Array, point: Array) -> float:
    """Arc length of the closest point of the resting whisker if it is very close; else 0."""
    if not _near_rest(resting, point):
        return 0.0
    touch, distance = _touch(resting, point)
    return touch if distance < _LIGHT * _LIGHT else 0.0


@inlined
def _best_seed(found: Array, quality: IntArray, n: int) -> int:
    """Index of the seed to start from; of two near the fold, the one of less force is stable."""
    best = 0
    for i in range(1, n):
        better = quality[i] > quality[best]
        if better or (quality[i] == quality[best] and found[i, 2] < found[best, 2]):
            best = i
    return best


@inlined
def _is_ambiguous(
    fold: Fold, resting: Array, point: Array, found: Array, n: int, best: int
) -> bool:
    """Whether there may be a contact of less force than the best seed's."""
    for i in range(n):
        other = i != best and _apart(found[i], found[best])
        if other and _force(fold, found[i]) < _force(fold, found[best]):
            return True
    if found[best, 2] < _HEAVY or not _near_rest(resting, point):
        return False
    return bool(_touch(resting, point)[1] < _NEAR * _NEAR)


@kernel
def _find_starts(
    fold: Fold,
    tree: SearchTree,
    resting: Array,
    points: Array,
    starts: Array,
    first: int,
    last: int,
) -> None:
    """Fill contacts (n, _STARTS, 3) from which points may be reached, by increasing force.

    Near the resting whisker the first is its closest point, without force; the others are seeds.
    Unused entries are NaN.
    """
    room, forces = seed_room(), np.empty(MOST_SEEDS)
    found, quality = room.found, room.quality
    for row in range(first, last):
        count = 0
        arc, distance = _touch(resting, points[row])
        if distance < _NEAR * _NEAR:
            starts[row, 0, 0], starts[row, 0, 1], starts[row, 0, 2] = arc, 0.0, 0.0
            count = 1
        n = seeds(tree, points[row], room)
        for i in range(n):
            forces[i] = _force(fold, found[i])
        while count < _STARTS and n > 0:
            least = best = int(np.argmin(forces[:n]))
            if forces[least] == np.inf:
                break
            for i in range(n):
                if not _apart(found[i], found[least]):
                    forces[i] = np.inf
                    best = i if quality[i] > quality[best] else best
            found[best, 0] = min(max(found[best, 0], 0.0), 1.0)
            found[best, 2] = min(found[best, 2], _SHORT_OF_FOLD)
            chart_to_contact(fold, found[best], starts[row, count])
            count += 1
        for i in range(count, _STARTS):
            for a in range(3):
                starts[row, i, a] = np.nan


@kernel
def _solve_points(
    rod: Rod,
    fold: Fold,
    tree: SearchTree,
    resting: Array,
    proximal: float,
    points: Array,
    xi: Array,
    values: Array,
    misfits: Array,
    solved: IntArray,
    first: int,
    last: int,
) -> None:
    """Solve points (n, 3) from the chart's seeds, or from rest if very near to it.

    ``solved`` is 1 if solved, 2 if solved but ambiguous, -1 if unsolved but possibly reachable by
    continuation (there are seeds or the resting whisker is near), and 0 if unreachable.
    """
    b = np.zeros(BUFFER_SIZE)
    room = seed_room()
    found, slopes, quality = room.found, room.inverses, room.quality
    group = group_room(np.empty((LANES, 3)))
    charts, inverses = group.charts, group.inverses
    rows, doubt = np.empty(LANES, np.int64), np.zeros(LANES, np.bool_)
    count = 0
    for row in range(first, last):
        rows[count], doubt[count] = row, False
        copy(points[row], group.targets[count])
        touch = _light_touch(resting, points[row])
        n = 0 if touch > 0.0 else seeds(tree, points[row], room)
        if touch > 0.0:
            group.xi[count, 0], group.xi[count, 1], group.xi[count, 2] = touch, 0.0, 0.0
            charts[count, 2], inverses[count, 0, 0] = 0.0, np.nan
        elif n > 0:
            best = _best_seed(found, quality, n)
            doubt[count] = _is_ambiguous(fold, resting, points[row], found, n, best)
            chart_to_contact(fold, found[best], group.xi[count])
            start_from(found[best], slopes[best], quality[best], charts[count], inverses[count])
        if touch > 0.0 or n > 0:
            solved[row] = -1
            count += 1
        else:
            solved[row] = -1 if _near_rest(resting, points[row]) else 0
        if count == LANES or (row == last - 1 and count > 0):
            newton_group(_point_equation, rod, fold, b, count, group)
            for i in range(count):
                reached = group.misfits[i] <= TOLERANCE
                if reached and stable(fold, proximal, group.xi[i], group.signs[i]):
                    solved[rows[i]] = 2 if doubt[i] else 1
                    copy(group.xi[i], xi[rows[i]])
                    copy(group.values[i], values[rows[i]])
                    misfits[rows[i]] = group.misfits[i]
            count = 0


class PointSolver:
    """Solver for contacts at points, for one whisker; tables are built once."""

    def __init__(self, chart: StableSet) -> None:
        self.chart = chart
        points = np.ascontiguousarray(chart.values[..., 3:])
        self._tree = search_tree(chart, points, chart.tangents[..., 3:, :], (False, False, False))
        self._resting = _resting_points(chart)

    @cached_property
    def _inner(self) -> tuple[Array, spatial.cKDTree]:
        """Contacts from which paths start, away from the fold, and a tree of their points."""
        points = self.chart.values[:, :-1, :-1, 3:].reshape(-1, 3)
        held = np.isfinite(points).all(axis=1)
        return self.chart.contacts[:, :-1, :-1].reshape(-1, 3)[held], spatial.cKDTree(points[held])

    @cached_property
    def _beyond(self) -> tuple[IntArray, spatial.cKDTree]:
        """Status beyond each of the points on the chart's faces, and a tree of the points."""
        places, reasons = zip(*_face_points(self.chart), strict=True)
        numbers = [np.full(len(p), int(r)) for p, r in zip(places, reasons, strict=True)]
        return np.concatenate(numbers), spatial.cKDTree(np.concatenate(places))

    def solve(self, points: Array, device: str = "cpu") -> Solutions:
        """Find the contact of least force at each point (n, 3)."""
        n = len(points)
        out = Solutions.empty(n)
        contacts, values, misfits, statuses = out
        there = np.flatnonzero(~np.isnan(points).any(axis=1))
        wanted = np.clip(points[there], -_LARGEST_COORDINATE, _LARGEST_COORDINATE)
        xi, found = np.empty((there.size, 3)), np.empty((there.size, 6))
        residuals, solved = np.empty(there.size), np.zeros(there.size, np.int64)
        chart = self.chart
        tables = chart.discretization.rod, chart.fold, self._tree, self._resting, chart.proximal
        share_rows(_solve_points, tables, (wanted,), (xi, found, residuals, solved), device)
        good = solved > 0
        rows = there[good]
        contacts[rows, 0], contacts[rows, 1], contacts[rows, 2:] = xi[good, 0], 0.0, xi[good, 1:]
        values[rows], misfits[rows], statuses[rows] = found[good], residuals[good], int(Status.OK)
        open_rows = np.flatnonzero((solved < 0) | (solved == 2))
        if open_rows.size:
            self._from_starts(wanted[open_rows], there[open_rows], out)
        lost = np.flatnonzero(np.isin(statuses[there], (Status.MISSING, Status.NOT_CONVERGED)))
        self._approach(wanted[lost], solved[lost] < 0, there[lost], out)
        return out

    def _from_starts(self, points: Array, rows: IntArray, out: Solutions) -> None:
        """Follow contacts from all starts; keep those of less force than the present ones."""
        least = np.hypot(out.contacts[rows, 2], out.contacts[rows, 3])
        least[np.isnan(least)] = np.inf
        starts = np.empty((rows.size, _STARTS, 3))
        tables = self.chart.fold, self._tree, self._resting
        share_out(rows.size, _find_starts, *tables, points, starts)
        for start in np.moveaxis(starts, 1, 0):
            which = np.flatnonzero(np.hypot(start[:, 1], start[:, 2]) < least)
            solved = self._follow(start[which], points[which])
            force = np.hypot(solved.contacts[:, 2], solved.contacts[:, 3])
            # A contact of less force takes precedence even before the proximal limit.
            reached = np.isin(solved.statuses, (Status.OK, Status.TOO_PROXIMAL))
            reached &= solved.misfits < _REACHED_RESIDUAL
            better = (reached & (force < least[which])) | (least[which] == np.inf)
            out.put(rows[which[better]], Solutions(*(part[better] for part in solved)))
            least[which] = np.where(reached, np.minimum(force, least[which]), least[which])
        _clear_unsolved(out, rows)

    def _approach(self, points: Array, hopeful: AnyArray, rows: IntArray, out: Solutions) -> None:
        """Follow points from the nearest known contact if promising; set the status of others."""
        if not rows.size:
            return
        reasons, faces = self._beyond
        away, face = faces.query(points)
        out.statuses[rows] = reasons[face]
        near = np.flatnonzero((away < _NEAR) | hopeful)
        contacts, inner = self._inner
        _, start = inner.query(points[near])
        out.put(rows[near], self._follow(contacts[start], points[near]))
        _clear_unsolved(out, rows)

    def _follow(self, starts: Array, points: Array) -> Solutions:
        """Follow contacts ξ (n, 3) to points (n, 3)."""
        begins, ends = np.zeros((len(points), 7)), np.zeros((len(points), 7))
        at_start = solve_forces(self.chart.discretization, with_normal_force(starts))[0]
        begins[:, :3], ends[:, :3] = at_start[:, 3:], points
        solved = follow_all(self.chart, begins, ends, np.full(len(points), POINT), starts.copy())
        # A step may cross the fold to where the determinant has its initial sign again.
        ends = solved.contacts[:, [0, 2, 3]]
        strength = fold_forces(self.chart.fold, ends)
        beyond = np.hypot(ends[:, 1], ends[:, 2]) > ABOVE_FOLD * strength
        solved.statuses[beyond & (solved.statuses == Status.OK)] = int(Status.BEYOND_FOLD)
        return solved


def _clear_unsolved(out: Solutions, rows: IntArray) -> None:
    """Remove the contact from rows with another status than OK."""
    lost = rows[out.statuses[rows] != Status.OK]
    out.contacts[lost], out.values[lost] = np.nan, np.nan


def _face_points(chart: StableSet) -> list[tuple[Array, Status]]:
    """Points (n, 3) on each of the chart's outer faces, and the status beyond that face."""
    eta, rho = np.linspace(0.0, 1.0, _FACE), np.linspace(0.0, 1.0, _FACE)
    psi = np.linspace(0.0, 2.0 * np.pi, 2 * _FACE, endpoint=False)
    faces = []
    for axes, reason in (
        ((eta, psi, rho[-1:]), Status.BEYOND_FOLD),
        ((eta[-1:], psi, rho), Status.BEYOND_TIP),
        ((eta[:1], psi, rho), Status.TOO_PROXIMAL),
    ):
        place = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        contacts = with_normal_force(contacts_at(chart.fold, place))
        points = solve_forces(chart.discretization, contacts)[0][:, 3:]
        # At a very thin tip the interpolated fold force may be too large to integrate.
        faces.append((points[np.isfinite(points).all(axis=1)], reason))
    return faces


def _resting_points(chart: StableSet) -> Array:
    """Points along the resting whisker from ``LEAST_ARC`` to the tip, (3, n)."""
    contacts = np.zeros((_RESTING, 4))
    contacts[:, 0] = np.linspace(LEAST_ARC, 1.0, _RESTING)
    return np.ascontiguousarray(solve_forces(chart.discretization, contacts)[0][:, 3:].T)


def follow_all(
    chart: StableSet, begins: Array, ends: Array, kinds: IntArray, unknowns: Array
) -> Solutions:
    """Run :func:`~vibrissa.rod.continuation.follow` over all rows, updating the unknowns."""
    out, d = Solutions.empty(len(begins)), chart.discretization
    tables = d.rod, chart.fold, d.radius, chart.proximal
    share_out(len(begins), follow, *tables, begins, ends, kinds, unknowns, *out)
    return out


@lru_cache(maxsize=16)
def point_solver(whisker: Bendable, proximal: float, steps: int) -> PointSolver:
    """Return the point solver of a whisker; cached."""
    compile_seeds(discretize(whisker, steps).rod)
    return PointSolver(stable_set(whisker, proximal=proximal, steps=steps))
