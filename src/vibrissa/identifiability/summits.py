"""Summits: pairs of twins from which no step leads farther from rest.

Pairs (ξ1, ξ2) with T(ξ1) = T(ξ2) are a three-dimensional set. On it the smaller of the two cone
angles is climbed subject to margins that must not be negative: of the region, the separation, the
fold and the ends of the whisker. A summit is mostly where several margins vanish, so that a linear
program finds it: each step maximises the linearised angle within a trust region, once more with
the margins that were found there (a second-order correction), and returns to the set by Newton's
method. Margins that are violated cost in proportion, so that a climb may begin outside its region.

Directions are equal where the cross product of the two transverse vectors vanishes, and sizes where
their squares agree: equations that are regular also where a transverse vector is zero, through
which ridges lead. Where a triplet collapses, as on the plane of a planar whisker, all pairs solve
them: climbs keep off contacts where det ∂T/∂ξ vanishes for both. On a whisker of slight taper it is
small everywhere; so climbs go on from where they end to where twins stop to be distinct.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vibrissa.identifiability.twins import (
    AGREEMENT,
    FINER,
    FIRM,
    Pairs,
    Search,
    contact_set,
    joined,
    twins_near,
    units,
)
from vibrissa.numerics import AnyArray, Array, cross, kernel, solve
from vibrissa.rod import chart_of, discretize, solve_forces, with_normal_force

# By what an iteration shrinks the complementarity, how near to the faces it goes, and the
# complementarity at which it ends.
_SHRINK, _NEARLY, _DONE = 0.04, 0.97, 1e-12
_ITERATIONS = 25


@kernel
def steepest(levels: Array, slopes: Array, within: Array, cost: float, steps: Array) -> None:
    """Steps (n, 3) in boxes that raise the lower of two levels most, less the worst violation.

    ``levels`` (n, 2 + m) and their ``slopes`` (n, 3, 2 + m): the two, then margins that may not be
    negative but at a cost; ``within`` (n,): half widths of the boxes. A primal-dual interior
    method: unknowns are the step over the size of its box, the level reached t, and the worst
    violation e; maximised is t - cost·e.
    """
    n, m = levels.shape
    count = m + 7
    matrix, room = np.zeros((count, 5)), np.ones(count)
    slack, dual, target, ds = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    normal, x, dx, aim = np.empty((5, 5)), np.empty(5), np.empty(5), np.zeros(5)
    aim[3], aim[4] = 1.0, -cost
    for k in range(m):
        matrix[k, 3 if k < 2 else 4] = -1.0 if k < 2 else 1.0
    for a in range(3):
        matrix[m + a, a], matrix[m + 3 + a, a] = 1.0, -1.0
    matrix[m + 6, 4], room[m + 6] = 1.0, 0.0
    for row in range(n):
        least, worst = min(levels[row, 0], levels[row, 1]), 0.0
        for k in range(m):
            room[k] = (levels[row, k] - (least if k < 2 else 0.0)) / within[row]
            if k >= 2:
                worst = max(worst, -room[k])
            for a in range(3):
                matrix[k, a] = slopes[row, a, k]
        x[0] = x[1] = x[2] = 0.0
        x[3], x[4] = -1.0, 1.0 + worst
        for k in range(count):
            slack[k] = matrix[k, 3] * x[3] + matrix[k, 4] * x[4] + room[k]
            dual[k] = 1.0 / slack[k]
        for _ in range(_ITERATIONS):
            mean = 0.0
            for k in range(count):
                mean += slack[k] * dual[k] / count
            if mean < _DONE:
                break
            for a in range(5):
                dx[a] = aim[a]
                for c in range(5):
                    normal[a, c] = 0.0
            for k in range(count):
                target[k] = _SHRINK * mean / slack[k]
                weight = dual[k] / slack[k]
                for a in range(5):
                    dx[a] += matrix[k, a] * target[k]
                    for c in range(5):
                        normal[a, c] += weight * matrix[k, a] * matrix[k, c]
            if solve(normal, dx) == 0.0:
                break
            primal, other = 1.0, 1.0
            for k in range(count):
                ds[k] = 0.0
                for a in range(5):
                    ds[k] += matrix[k, a] * dx[a]
                target[k] -= dual[k] * (1.0 + ds[k] / slack[k])  # the step of the dual
                if ds[k] < 0.0:
                    primal = min(primal, -_NEARLY * slack[k] / ds[k])
                if target[k] < 0.0:
                    other = min(other, -_NEARLY * dual[k] / target[k])
            for a in range(5):
                x[a] += primal * dx[a]
            for k in range(count):
                slack[k] += primal * ds[k]
                dual[k] += other * target[k]
        for a in range(3):
            steps[row, a] = x[a] * within[row]


class _Round(NamedTuple):
    """Climbs of each region, the steps they take, and the cost of a violated margin, rad.

    On the finer rod or not; kept off where twins stop to be distinct, or where det ∂T/∂ξ is small.
    """

    most: int
    steps: int
    cost: float
    finer: bool = False
    firm: bool = False


# Rounds that go on with the best of them, and end on a finer rod, where witnesses must hold: a
# summit is where margins vanish, and what the integration errs by would violate them.
_ROUNDS = (
    _Round(20, 8, 30.0),
    _Round(6, 12, 30.0),
    _Round(2, 30, 1000.0),
    _Round(2, 6, 1000.0, finer=True),
    _Round(2, 60, 1000.0, firm=True),
    _Round(2, 6, 1000.0, finer=True, firm=True),
)
# Of a quarter as many again violations cost so much: where they pay, all others may leave a region.
_STRICT = 1000.0
# Starts of a region are in different parts of the chart, so many an axis.
_PARTS = np.array([3.0, 3.0 / np.pi, 3.0])
# Trust regions, in units of L and of the fold force: the first, that on the finer rod, the largest,
# and where climbs end.
_FIRST, _FINE, _LARGEST, _LAST = 0.1, 1e-3, 0.3, 1e-5
_LEAST_GAIN = 1e-5  # a climb also ends where the linear program promises no more than this, rad
_KEPT = 1e-5  # what is kept of each margin so that no summit violates one
_SAME = 1e-6  # climbs of a region whose merits differ by less than this are at the same summit, rad
# Transverse vectors face each other at least so far, over their whole sizes; where climbs go on,
# the same of the root, as the product vanishes with the square of what both have left.
_FACING = 1e-4
# Newton steps back to the set, the misfit that they may leave for the next, and that at which none
# is needed.
_CORRECTIONS, _MISFIT, _EXACT = 2, 1e-6, 1e-12
# The larger determinant of a pair, over the lengths of the gradients, is at least this.
_REGULAR = 1e-4
# Where climbs go on, a change of the signals by ``AGREEMENT`` moves one contact by no more than
# this, over L: less than a twin may be moved.
_MOVED = 0.1 * FIRM
# Climbs go on where one of these margins, which come first, is less than this.
_HELD = 0.05
_STEEP = 0.1  # its logarithm, so scaled, is the margin: no cost lets a pair through
# Step of the derivatives of margins, and its ridge against singular equations.
_STEP, _RIDGE = 1e-5, 1e-14


class _State(NamedTuple):
    """Pairs on the way: contacts (n, 2, 3), linearised equations (n, 3, 6), angles and margins.

    Distinct (n, 2): how far signals fix each contact, 1 where hardly; levels (n, 2 + m): both cone
    angles, then margins; merit (n,), -inf off the set.
    """

    xi: Array
    slope: Array
    distinct: Array
    levels: Array
    merit: Array

    def rows(self, which: AnyArray) -> _State:
        return _State(*(a[which] for a in self))

    def replace(self, which: AnyArray, other: _State) -> None:
        for mine, theirs in zip(self, other, strict=True):
            mine[which] = theirs


@dataclass(frozen=True)
class _Mountain:
    """What is climbed, the cost of a violated margin, rad, and what climbs are kept off."""

    search: Search
    cost: float
    firm: bool

    def units(self, xi: Array) -> Array:
        """Scale of a change of contacts (n, 2, 3)."""
        return units(self.search.contact_map, xi.reshape(-1, 3)).reshape(xi.shape)

    def at(self, xi: Array, signs: Array) -> _State:
        """Pairs of equal triplets next to contacts (n, 2, 3), of regions with such signs."""
        # A pair that runs off has no signals, and so no merit.
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._at(xi, signs)

    def _at(self, xi: Array, signs: Array) -> _State:
        unit = self.units(xi)
        for step in range(_CORRECTIONS + 1):
            values, away, slope, by_point = self._equations(xi, unit)
            if (np.abs(away) <= _EXACT).all():
                break
            if step < _CORRECTIONS:
                square = slope @ slope.swapaxes(1, 2)
                ridge = _RIDGE * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(3)
                back = slope.swapaxes(1, 2) @ np.linalg.solve(square + ridge, away[..., None])
                xi = xi - back.reshape(xi.shape) * unit
        distinct = self._distinct(values, slope, by_point)
        levels, inside = self.levels(xi, values, distinct, signs)
        merit = _merit(levels, self.cost)
        merit[~(inside & (np.abs(away).max(axis=1) <= _MISFIT) & np.isfinite(merit))] = -np.inf
        return _State(xi, slope, distinct, levels, merit)

    def _equations(self, xi: Array, unit: Array) -> tuple[Array, Array, Array, Array]:
        """(F, p) (n, 2, 6), triplets' differences (n, 3), their slopes (n, 3, 6).

        And ∂p/∂ξ (n, 2, 3, 3).
        """
        d = self.search.contact_map.chart.discretization
        values, tangents = solve_forces(d, with_normal_force(xi.reshape(-1, 3)), tangents=True)
        by_xi = tangents * unit.reshape(-1, 1, 3)
        vectors = {"F": (values[:, :3], by_xi[:, :3])}
        if any(name[0] == "M" for name in self.search.names):
            force, point = values[:, :3], values[:, 3:]
            turned = cross(by_xi[:, 3:].swapaxes(1, 2), force[:, None])
            turned += cross(point[:, None], by_xi[:, :3].swapaxes(1, 2))
            vectors["M"] = cross(point, force), turned.swapaxes(1, 2)
        away, slope = np.empty((len(xi), 3)), np.empty((len(xi), 3, 2, 3))
        for k, name in enumerate(self.search.names):
            vector, by = (v.reshape(len(xi), 2, *v.shape[1:]) for v in vectors[name[0]])
            size = np.einsum("npi,npi->np", vector, vector).prod(axis=1)[:, None, None] ** 0.25
            vector = vector / size
            (a_x, a_y, a_z), (b_x, b_y, b_z) = vector.transpose(1, 2, 0)
            normals = np.zeros((len(xi), 2, 3))
            if name[1] == "x":
                away[:, k] = a_x - b_x
                normals[:, 0, 0], normals[:, 1, 0] = 1.0, -1.0
            elif name[1] == "D":
                away[:, k] = a_y * b_z - a_z * b_y
                normals[:, 0, 1], normals[:, 0, 2] = b_z, -b_y
                normals[:, 1, 1], normals[:, 1, 2] = -a_z, a_y
            else:
                away[:, k] = 0.5 * (a_y * a_y + a_z * a_z - b_y * b_y - b_z * b_z)
                normals[:, 0, 1:], normals[:, 1, 1:] = vector[:, 0, 1:], -vector[:, 1, 1:]
            slope[:, k] = np.einsum("npi,npix->npx", normals / size, by)
        by_point = by_xi[:, 3:].reshape(-1, 2, 3, 3)
        return values.reshape(-1, 2, 6), away, slope.reshape(-1, 3, 6), by_point

    def levels(
        self, xi: Array, values: Array, distinct: Array, signs: Array
    ) -> tuple[Array, AnyArray]:
        """Both cone angles and the margins (n, 2 + m), and whether both are inside the domain."""
        contact_map, _, separation, domain = self.search
        flat = xi.reshape(-1, 3)
        turned = np.repeat(signs[:, 1] != 0.0, 2)
        one = contact_set(contact_map, flat, values.reshape(-1, 6), domain, turned)
        room = 1.0 - np.hypot(flat[:, 1], flat[:, 2]) / units(contact_map, flat)[:, 1]
        ends = (1.0 - flat[:, 0], flat[:, 0] - contact_map.chart.proximal, room)
        pairs = [a.reshape(-1, 2) for a in (one.angle, one.backward, one.tangent_x, *ends)]
        margins = [
            _STEEP * np.log(np.maximum(distinct.max(axis=1), _RIDGE))[:, None],
            self._facing(values),
            *(
                np.where(sign[:, None] == 0.0, 1.0, sign[:, None] * margin)
                for sign, margin in zip(signs.T, pairs[1:3], strict=True)
            ),
            *pairs[3:],
            np.linalg.norm(values[:, 0, 3:] - values[:, 1, 3:], axis=1)[:, None] - separation,
        ]
        levels = np.concatenate([pairs[0], np.concatenate(margins, axis=1) - _KEPT], axis=1)
        return levels, np.asarray(one.inside.reshape(-1, 2).all(axis=1))

    def _distinct(self, values: Array, slope: Array, by_point: Array) -> Array:
        """How far signals fix each contact of pairs, (n, 2): climbs are kept off less than 1."""
        rows = slope.reshape(-1, 3, 2, 3).swapaxes(1, 2)
        if not self.firm:
            size = np.linalg.norm(rows, axis=3).prod(axis=2)
            return np.asarray(np.abs(np.linalg.det(rows)) / np.maximum(_REGULAR * size, _RIDGE))
        # Rows are derivatives of signals, over |F|, |M| and in rad, times these.
        scale = np.ones((len(rows), 2, 3))
        for k, name in enumerate(self.search.names):
            if name[1] != "x":
                across = np.linalg.norm(self._direction(values, name)[..., 1:], axis=2)
                scale[..., k] = across.prod(axis=1)[:, None] if name[1] == "D" else across
        minors = [cross(rows[:, :, (k + 1) % 3], rows[:, :, (k + 2) % 3]) for k in range(3)]
        determinant = np.abs(np.einsum("npi,npi->np", rows[:, :, 0], minors[0]))
        moves = by_point @ (np.stack(minors, axis=-1) * scale[:, :, None])
        size = AGREEMENT * np.linalg.norm(moves, axis=(2, 3))
        return np.asarray(_MOVED * determinant / np.maximum(size, np.finfo(np.float64).tiny))

    def _direction(self, values: Array, name: str) -> Array:
        """Directions (n, 2, 3) of the vector that a signal is of."""
        force = values[..., :3]
        a = force if name[0] == "F" else cross(values[..., 3:], force)
        return np.asarray(a / np.linalg.norm(a, axis=2, keepdims=True))

    def _facing(self, values: Array) -> Array:
        """How far the transverse vectors of direction signals face each other, (n, k)."""
        out = np.empty((len(values), 0))
        for name in self.search.names:
            if name[1] == "D":
                a = self._direction(values, name)
                facing, least = np.einsum("ni,ni->n", a[:, 0, 1:], a[:, 1, 1:]), _FACING
                if self.firm:
                    facing, least = np.sign(facing) * np.sqrt(np.abs(facing)), _FACING**0.5
                out = np.concatenate([out, facing[:, None] - least], axis=1)
        return out

    def slopes(self, state: _State, signs: Array) -> tuple[Array, Array]:
        """A basis of steps in the set (n, 3, 2, 3), and the levels' slopes along it (n, 3, m)."""
        free = np.linalg.svd(state.slope)[2][:, 3:].reshape(-1, 3, 2, 3)
        unit = self.units(state.xi)
        basis = free * unit[:, None]
        moved = (state.xi[:, None] + _STEP * basis).reshape(-1, 2, 3)
        values, _, slope, by_point = self._equations(moved, np.repeat(unit, 3, axis=0))
        distinct = self._distinct(values, slope, by_point)
        levels, _ = self.levels(moved, values, distinct, np.repeat(signs, 3, axis=0))
        slopes = (levels.reshape(len(basis), 3, -1) - state.levels[:, None]) / _STEP
        return basis, slopes


def farthest_twins(search: Search, pools: Sequence[Pairs], regions: tuple[str, ...]) -> Pairs:
    """Climb from the best pairs of each pool and region to where their cone angle is largest.

    Where a climb ends depends on where it begins: the largest is a lower bound. Each pool has its
    own climbs, so that none crowds out another.
    """
    signs = np.array(
        [[("CB" in r) * 1.0 - ("CF" in r), float("ELD" in r)] for r in regions]
    ).reshape(-1, 2)
    starts = [_starts(search, pairs, signs) for pairs in pools]
    number = np.concatenate([k * len(regions) + found[0] for k, found in enumerate(starts)])
    xi = np.concatenate([found[1] for found in starts])
    if not number.size:
        return pools[0].rows(number)
    signs = signs[number % len(regions)]
    count = sum(name[1] == "D" for name in search.names)
    rods, ends = {False: search, True: _finer(search)}, []
    size = np.full(len(xi), _FIRST)
    mountain = _Mountain(search, _ROUNDS[0].cost, firm=False)
    state = mountain.at(xi, signs)
    for one in _ROUNDS:
        if one.firm:
            number = number % len(regions)  # all pools' together
        merit = np.where(np.isfinite(state.merit), _merit(state.levels, one.cost), -np.inf)
        strict = np.where(np.isfinite(merit), _merit(state.levels, _STRICT), -np.inf)
        kept = np.union1d(
            _leading(merit, number, one.most), _leading(strict, number, one.most // 4)
        )
        number, signs, size = number[kept], signs[kept], size[kept]
        state = state.rows(kept)._replace(merit=merit[kept])
        mountain = _Mountain(rods[one.finer], one.cost, one.firm)
        if one.finer or one.firm:
            held = state.levels[:, 2:][:, : 1 + count].min(axis=1) < _HELD
            state = mountain.at(state.xi, signs)
            going = np.isfinite(state.merit) & (one.finer | held)
            size = np.where(going, _FINE if one.finer else _FIRST, 0.0)
        for _ in range(one.steps):
            active = np.flatnonzero(size > _LAST)
            if not active.size:
                break
            _step(mountain, state, signs, size, active)
        if one.finer:
            ends.append(_solved(mountain.search, state))
    return joined(ends)


def _solved(search: Search, state: _State) -> Pairs:
    """Pairs whose second contact is solved for, from where its signals fix it better."""
    turned = state.distinct[:, 0] > state.distinct[:, 1]
    xi = np.where(turned[:, None, None], state.xi[:, ::-1], state.xi)
    contact_map, names, _, domain = search
    first, second, agrees = twins_near(contact_map, names, xi[:, 0], xi[:, 1], domain)
    apart = np.linalg.norm(second.values[:, 3:] - first.values[:, 3:], axis=1)
    chart = chart_of(contact_map.chart.fold, first.xi)
    return Pairs(chart, np.zeros(len(chart), np.int64), first, second, apart).rows(agrees)


def _finer(search: Search) -> Search:
    """The same on the rod that witnesses are confirmed on."""
    contact_map = search.contact_map
    finer = discretize(contact_map.whisker, FINER * contact_map.steps)
    chart = replace(contact_map.chart, discretization=finer)
    return search._replace(contact_map=replace(contact_map, chart=chart))


def _starts(search: Search, pairs: Pairs, signs: Array) -> tuple[AnyArray, Array]:
    """The best pairs of each region, in different parts of charts: its number, their contacts."""
    xi = np.stack([pairs.first.xi, pairs.second.xi], axis=1)
    # A pair and the same the other way round are one: the outer contact comes first.
    swapped = xi[:, 0, 0] < xi[:, 1, 0]
    xi[swapped] = xi[swapped, ::-1]
    charts = [chart_of(search.contact_map.chart.fold, xi[:, k]) for k in (0, 1)]
    cells = np.floor(np.concatenate(charts, axis=1) * np.tile(_PARTS, 2) - 1e-9)
    part = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    both = (pairs.first, pairs.second)
    numbers, starts, begin = [], [], _ROUNDS[0]
    for i, (side, small) in enumerate(signs):
        margins = [m for one in both for m in (side * one.backward, small * one.tangent_x)]
        margins.append(pairs.apart - search.separation)
        levels = np.stack([*(one.angle for one in both), *margins], axis=1)
        chosen: set[int] = set()
        for cost, most in ((begin.cost, begin.most), (_STRICT, begin.most // 4)):
            order = np.argsort(-_merit(levels, cost), kind="stable")
            _, first = np.unique(part[order], return_index=True)
            chosen.update(order[np.sort(first)[:most]].tolist())
        starts.append(xi[sorted(chosen)])
        numbers.append(np.full(len(chosen), i))
    return np.concatenate(numbers), np.concatenate(starts)


def _leading(merit: Array, number: AnyArray, most: int) -> AnyArray:
    """Rows of the largest merits of each region."""
    order = np.lexsort([-merit, number])
    order = order[np.isfinite(merit[order])]
    again = (np.diff(number[order]) == 0) & (np.diff(merit[order]) > -_SAME)
    order = np.delete(order, 1 + np.flatnonzero(again))
    place = np.arange(len(order)) - np.searchsorted(number[order], number[order])
    return np.asarray(order[place < most])


def _merit(levels: Array, cost: float) -> Array:
    """The smaller angle, less what the worst violated margin costs."""
    return np.asarray(
        levels[..., :2].min(axis=-1) - cost * np.maximum(-levels[..., 2:], 0.0).max(axis=-1)
    )


def _step(mountain: _Mountain, state: _State, signs: Array, size: Array, active: AnyArray) -> None:
    """One step of the climbs that go on, and their new trust regions."""
    here, signs, within = state.rows(active), signs[active], size[active]
    basis, slopes = mountain.slopes(here, signs)
    step, promised = _program(here.levels, slopes, within, mountain.cost)
    trial = mountain.at(here.xi + np.einsum("nk,nkpi->npi", step, basis), signs)
    promised = promised - here.merit
    # Where the margins bend, once more with what they were there.
    again = np.flatnonzero(np.isfinite(trial.merit) & (trial.merit - here.merit < 0.75 * promised))
    if again.size:
        bent = trial.levels - here.levels - np.einsum("nk,nkm->nm", step, slopes)
        step, _ = _program((here.levels + bent)[again], slopes[again], within[again], mountain.cost)
        moved = here.xi[again] + np.einsum("nk,nkpi->npi", step, basis[again])
        second = mountain.at(moved, signs[again])
        better = second.merit > trial.merit[again]
        trial.replace(again[better], second.rows(better))
    gain = trial.merit - here.merit
    up = gain > 0.05 * np.maximum(promised, 0.0)
    state.replace(active[up], trial.rows(up))
    within = within * np.where(gain > 0.7 * promised, 2.0, np.where(up, 1.0, 0.35))
    size[active] = np.where(promised < _LEAST_GAIN, 0.0, np.minimum(within, _LARGEST))


def _program(levels: Array, slopes: Array, within: Array, cost: float) -> tuple[Array, Array]:
    """Steps (n, 3) in boxes that maximise the linearised merit, and that merit (n,)."""
    step = np.zeros((len(levels), 3))
    steepest(levels, slopes, within, cost, step)
    return step, _merit(levels + np.einsum("nk,nkm->nm", step, slopes), cost)
