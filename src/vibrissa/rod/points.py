"""The contact at a given point: seeds from the chart, Newton, and a reason where there is none."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from vibrissa.rod.arrays import AnyArray, Array, IntArray, Rod
from vibrissa.rod.batch import share_out, solve_forces
from vibrissa.rod.compiled import copy, inlined, kernel
from vibrissa.rod.continuation import follow
from vibrissa.rod.equations import POINT
from vibrissa.rod.kernels import BUFFER_SIZE, LANES
from vibrissa.rod.newton import TOLERANCE, newton_group, norm3, stable, start_from
from vibrissa.rod.preimage import Preimages, Tree
from vibrissa.rod.reach import (
    Fold,
    Reach,
    chart_to_contact,
    contacts_at,
    reach,
    with_normal_force,
)
from vibrissa.rod.seeds import MOST_SEEDS, seeds
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

# A point without a seed is unreachable, and the nearest face of the chart tells why. This near to
# a face (over L) it is approached from inside instead, in case the interpolant misjudges; and this
# near to the resting whisker, where bearings have no meaning and there may be no seed.
_NEAR = 0.01
# Points along each edge of the chart's faces.
_FACE = 65


class Solutions(NamedTuple):
    """Solved rows, non-dimensional: (s, f) at the contact, (F, p), residual, status."""

    contacts: Array
    values: Array
    misfits: Array
    statuses: IntArray

    @classmethod
    def empty(cls, n: int) -> Solutions:
        """Return n rows without an answer."""
        missing = np.full(n, int(Status.MISSING))
        return cls(np.full((n, 4), np.nan), np.full((n, 6), np.nan), np.full(n, np.nan), missing)

    def put(self, rows: IntArray, part: Solutions) -> None:
        """Set rows."""
        for mine, theirs in zip(self, part, strict=True):
            mine[rows] = theirs


@inlined
def _at_point(
    value: Array, tangents: Array, wanted: bool, target: Array, residual: Array, jacobian: Array
) -> float:
    for a in range(3):
        residual[a] = value[3 + a] - target[a]
        if wanted:
            for c in range(3):
                jacobian[a, c] = tangents[3 + a, c]
    return norm3(residual)


@kernel
def _solve_points(
    rod: Rod,
    fold: Fold,
    tree: Tree,
    proximal: float,
    points: Array,
    xi: Array,
    values: Array,
    misfits: Array,
    solved: IntArray,
    first: int,
    last: int,
) -> None:
    """Solve contact points (n, 3) where the chart has a seed that leads to a stable solution."""
    b = np.zeros(BUFFER_SIZE)
    found, quality = np.empty((MOST_SEEDS, 3)), np.empty(MOST_SEEDS, np.int64)
    slopes = np.empty((MOST_SEEDS, 3, 3))
    charts, inverses = np.empty((LANES, 3)), np.empty((LANES, 3, 3))
    rows, targets, group = np.empty(LANES, np.int64), np.empty((LANES, 3)), np.empty((LANES, 3))
    group_values, group_misfits = np.empty((LANES, 6)), np.empty(LANES)
    signs = np.empty(LANES)
    count = 0
    for row in range(first, last):
        solved[row] = 0
        n = seeds(tree, points[row], found, slopes, quality)
        if n > 0:
            solved[row] = -1
            best = 0
            for i in range(1, n):
                # Of two solutions near the fold the one with less force is the stable one.
                better = quality[i] > quality[best]
                if better or (quality[i] == quality[best] and found[i, 2] < found[best, 2]):
                    best = i
            rows[count] = row
            copy(points[row], targets[count])
            chart_to_contact(fold, found[best], group[count])
            start_from(found[best], slopes[best], quality[best], charts[count], inverses[count])
            count += 1
        if count == LANES or (row == last - 1 and count > 0):
            newton_group(
                _at_point,
                rod,
                fold,
                b,
                count,
                targets,
                charts,
                inverses,
                group,
                group_values,
                group_misfits,
                signs,
            )
            for i in range(count):
                if group_misfits[i] <= TOLERANCE and stable(fold, proximal, group[i], signs[i]):
                    solved[rows[i]] = 1
                    copy(group[i], xi[rows[i]])
                    copy(group_values[i], values[rows[i]])
                    misfits[rows[i]] = group_misfits[i]
            count = 0


class PointSolver:
    """Contact at a point, for one whisker: tables made once, then microseconds a point.

    Parameters
    ----------
    chart : Reach
        The whisker's stable contacts.
    """

    def __init__(self, chart: Reach) -> None:
        self.chart = chart
        points = np.ascontiguousarray(chart.values[..., 3:])
        self._tree = Preimages.of(
            chart, points, chart.tangents[..., 3:, :], (False, False, False)
        ).tree
        # Paths start short of the fold, where there is room to move.
        inner = points[:, :-1, :-1].reshape(-1, 3)
        self._contacts = chart.contacts[:, :-1, :-1].reshape(-1, 3)
        self._nearest = cKDTree(inner)
        places, reasons = zip(*_faces(chart), strict=True)
        self._faces = cKDTree(np.concatenate(places))
        self._rest = cKDTree(_at_rest(chart))
        self._reasons = np.concatenate(
            [np.full(len(p), int(r)) for p, r in zip(places, reasons, strict=True)]
        )

    def solve(self, points: Array) -> Solutions:
        """Solve contact points.

        Parameters
        ----------
        points : (n, 3) array
            Contact points over L; rows with NaN are passed over.

        Returns
        -------
        Solutions
            Row by row; NaN where there is no solution.
        """
        n = len(points)
        out = Solutions.empty(n)
        contacts, values, misfits, statuses = out
        there = np.flatnonzero(np.isfinite(points).all(axis=1))
        wanted = np.ascontiguousarray(points[there])
        xi, found = np.empty((there.size, 3)), np.empty((there.size, 6))
        residuals, solved = np.empty(there.size), np.zeros(there.size, np.int64)
        chart = self.chart
        rod, fold = chart.discretization.rod, chart.fold
        share_out(
            there.size,
            lambda first, last: _solve_points(
                rod,
                fold,
                self._tree,
                chart.proximal,
                wanted,
                xi,
                found,
                residuals,
                solved,
                first,
                last,
            ),
        )
        good = solved == 1
        rows = there[good]
        contacts[rows, 0], contacts[rows, 1], contacts[rows, 2:] = xi[good, 0], 0.0, xi[good, 1:]
        values[rows], misfits[rows], statuses[rows] = found[good], residuals[good], int(Status.OK)
        self._approach(wanted[~good], solved[~good] < 0, there[~good], out)
        return out

    def _approach(self, points: Array, seeded: AnyArray, rows: IntArray, out: Solutions) -> None:
        """Follow points without a ready seed from the nearest known contact; say why it fails."""
        if not rows.size:
            return
        away, face = self._faces.query(points)
        out.statuses[rows] = self._reasons[face]
        near = np.flatnonzero((away < _NEAR) | seeded | (self._rest.query(points)[0] < _NEAR))
        points, rows = points[near], rows[near]
        _, start = self._nearest.query(points)
        begins, ends = np.zeros((rows.size, 7)), np.zeros((rows.size, 7))
        begins[:, :3], ends[:, :3] = self._nearest.data[start], points
        solved = follow_all(
            self.chart, begins, ends, np.full(rows.size, POINT), self._contacts[start].copy()
        )
        out.statuses[rows] = solved.statuses
        out.misfits[rows] = solved.misfits
        good = solved.statuses == Status.OK
        out.contacts[rows[good]], out.values[rows[good]] = (
            solved.contacts[good],
            solved.values[good],
        )


def _faces(chart: Reach) -> list[tuple[Array, Status]]:
    """Places on the chart's outer faces (n, 3), and what lies beyond each."""
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
        faces.append((solve_forces(chart.discretization, contacts)[0][:, 3:], reason))
    return faces


def _at_rest(chart: Reach) -> Array:
    """Places along the resting whisker, (n, 3)."""
    contacts = np.zeros((_FACE, 4))
    contacts[:, 0] = np.linspace(chart.proximal, 1.0, _FACE)
    return solve_forces(chart.discretization, contacts)[0][:, 3:]


def follow_all(
    chart: Reach, begins: Array, ends: Array, kinds: IntArray, unknowns: Array
) -> Solutions:
    """Run :func:`~vibrissa.rod.continuation.follow` over all rows, updating the unknowns."""
    n = len(begins)
    out = Solutions.empty(n)
    discretization = chart.discretization
    share_out(
        n,
        lambda first, last: follow(
            discretization.rod,
            chart.fold,
            discretization.radius,
            chart.proximal,
            begins,
            ends,
            kinds,
            unknowns,
            *out,
            first,
            last,
        ),
    )
    return out


@lru_cache(maxsize=16)
def point_solver(whisker: Whisker, proximal: float, steps: int) -> PointSolver:
    """Return the point solver of a whisker, made on first use."""
    return PointSolver(reach(whisker, proximal=proximal, steps=steps))
