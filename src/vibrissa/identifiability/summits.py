"""Local maxima of the cone angle among pairs of twins.

Pairs (ξ1, ξ2) with T(ξ1) = T(ξ2) form a three-dimensional set. On it the smaller of the two cone
angles is maximised by climbs, subject to margins that must not be negative: of the region, the
separation, the fold and the ends of the whisker. At a maximum mostly several margins vanish, so
that a linear program finds it: each step maximises the linearised angle within a trust region, once
more with the margins found there (a second-order correction), and returns to the set by Newton's
method. Violated margins are penalised in proportion, so that a climb may start outside its region.

Directions are equal where the cross product of the two transverse vectors vanishes, and magnitudes
where their squares agree. These equations are regular also where a transverse vector is zero, as it
is on some paths to a maximum. Where a triplet collapses, as in the plane of a planar whisker, all
pairs satisfy them: climbs avoid contacts where det ∂T/∂ξ vanishes for both. On a whisker of slight
taper this determinant is small everywhere; there, climbs are continued until twins are no longer
distinct.
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
    concatenate,
    contact_set,
    twins_near,
    units,
)
from vibrissa.numerics import AnyArray, Array, IntArray, cross, inlined, kernel, norm3, solve
from vibrissa.rod import chart_of, discretize, solve_forces, with_normal_force
from vibrissa.signals import FD, FX, MD, MX, SIGNALS

# Factor by which an iteration reduces the complementarity, share of the distance to the faces that
# a step may take, and complementarity at which the iteration ends.
_SHRINK, _NEARLY, _DONE = 0.04, 0.97, 1e-12
_ITERATIONS = 25


@kernel
def steepest(levels: Array, slopes: Array, within: Array, cost: float, steps: Array) -> None:
    """Find steps (n, 3) in boxes that maximise the lower of two levels minus a penalty.

    ``levels`` (n, 2 + m) and their ``slopes`` (n, 3, 2 + m): the two levels, then margins whose
    worst violation is penalised by ``cost``; ``within`` (n,): half widths of the boxes. A
    primal-dual interior-point method: the unknowns are the step over the size of its box, the level
    t, and the worst violation e; t - cost·e is maximised.
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


@inlined
def _vector(signal: int, value: Array, tangents: Array, vector: Array, slopes: Array) -> None:
    """Force or moment at the base, whichever a signal is a component of, and its derivatives."""
    for i in range(3):
        vector[i] = value[i]
        for c in range(3):
            slopes[i, c] = tangents[i, c]
    for i in range(3 if signal >= MX else 0):
        j, k = (i + 1) % 3, (i + 2) % 3
        vector[i] = value[3 + j] * value[k] - value[3 + k] * value[j]
        for c in range(3):
            slopes[i, c] = value[3 + j] * tangents[k, c] - value[3 + k] * tangents[j, c]
            slopes[i, c] += tangents[3 + j, c] * value[k] - tangents[3 + k, c] * value[j]


@kernel
def equate(values: Array, tangents: Array, which: IntArray, away: Array, slope: Array) -> None:
    """Evaluate the equations of pairs; see the module.

    ``values`` (n, 2, 6) are (F, p) of both contacts, ``tangents`` (n, 2, 6, 3) their derivatives by
    each contact's unknowns. Fills ``away`` (n, 3) and its derivatives ``slope`` (n, 3, 2, 3).
    """
    vectors, slopes, normals = np.empty((2, 3)), np.empty((2, 3, 3)), np.empty((2, 3))
    a, b = vectors[0], vectors[1]
    for row in range(values.shape[0]):
        for n in range(3):
            signal = which[n]
            for p in range(2):
                _vector(signal, values[row, p], tangents[row, p], vectors[p], slopes[p])
            size = np.sqrt(norm3(a) * norm3(b))
            for i in range(3):
                a[i] /= size
                b[i] /= size
            normals[:] = 0.0
            if signal in (FX, MX):
                away[row, n] = a[0] - b[0]
                normals[0, 0], normals[1, 0] = 1.0, -1.0
            elif signal in (FD, MD):
                away[row, n] = a[1] * b[2] - a[2] * b[1]
                normals[0, 1], normals[0, 2] = b[2], -b[1]
                normals[1, 1], normals[1, 2] = -a[2], a[1]
            else:
                away[row, n] = 0.5 * (a[1] * a[1] + a[2] * a[2] - b[1] * b[1] - b[2] * b[2])
                for i in range(1, 3):
                    normals[0, i], normals[1, i] = a[i], -b[i]
            for p in range(2):
                for c in range(3):
                    total = 0.0
                    for i in range(3):
                        total += normals[p, i] * slopes[p, i, c]
                    slope[row, n, p, c] = total / size


class _Round(NamedTuple):
    """A round of climbs: their number per region, their steps, and the penalty of a violation, rad.

    ``finer``: on the finer rod. ``firm``: twins must be distinct; else det ∂T/∂ξ must not be small.
    """

    most: int
    steps: int
    cost: float
    finer: bool = False
    firm: bool = False


# Rounds, each of which continues the best climbs. They end on a finer rod, on which witnesses must
# be confirmed: at a maximum margins vanish, and integration errors would violate them.
_ROUNDS = (
    _Round(20, 8, 30.0),
    _Round(6, 12, 30.0),
    _Round(2, 30, 1000.0),
    _Round(2, 6, 1000.0, finer=True),
    _Round(2, 60, 1000.0, firm=True),
    _Round(2, 6, 1000.0, finer=True, firm=True),
)
# For a quarter as many additional climbs violations cost this much: at a lower cost, violation may
# pay, and all other climbs may leave a region.
_STRICT = 1000.0
# Number of parts into which each axis of the chart is divided; starts are in different parts.
_PARTS = np.array([3.0, 3.0 / np.pi, 3.0])
# Trust regions, in units of L and of the fold force: the initial one, that on the finer rod, the
# largest, and that at which climbs end.
_FIRST, _FINE, _LARGEST, _LAST = 0.1, 1e-3, 0.3, 1e-5
_LEAST_GAIN = 1e-5  # predicted gain below which a climb ends, rad
_KEPT = 1e-5  # reserve subtracted from each margin, so that no maximum violates one
_SAME = 1e-6  # climbs of a region whose merits differ by less than this coincide, rad
# Least scalar product of the transverse vectors, over their magnitudes and those of the whole
# vectors. In firm rounds the margin is that of its square root, as the product vanishes with the
# square of the transverse components.
_FACING = 1e-4
# Number of Newton steps back to the set, the misfit allowed after them, and the misfit at which no
# step is needed.
_CORRECTIONS, _MISFIT, _EXACT = 2, 1e-6, 1e-12
# Lower bound of the larger determinant of a pair, over the lengths of the gradients.
_REGULAR = 1e-4
# In firm rounds, largest displacement of one contact by a change of the signals by ``AGREEMENT``,
# over L: less than is allowed for a twin.
_MOVED = 0.1 * FIRM
# Climbs are continued if one of these margins, which come first, is below this.
_HELD = 0.05
_STEEP = 0.1  # scale of the logarithm that serves as margin, so that no penalty permits violation
# Step of the derivatives of margins, and ridge that regularises singular equations.
_STEP, _RIDGE = 1e-5, 1e-14


class _State(NamedTuple):
    """Pairs during a climb: contacts (n, 2, 3), linearised equations (n, 3, 6), levels and merit.

    distinct (n, 2): how well signals determine each contact, 1 at the limit; levels (n, 2 + m):
    both cone angles, then margins; merit (n,), -inf off the set.
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
class _Objective:
    """Objective of climbs: the search, the penalty of a violation, rad, and the kind of margin."""

    search: Search
    cost: float
    firm: bool

    def units(self, xi: Array) -> Array:
        """Scale of a change of contacts (n, 2, 3)."""
        return units(self.search.contact_map, xi.reshape(-1, 3)).reshape(xi.shape)

    # A pair that diverges has no signals, and so no merit.
    @np.errstate(divide="ignore", invalid="ignore")
    def at(self, xi: Array, signs: Array) -> _State:
        """Pairs with equal triplets closest to contacts (n, 2, 3), by Newton; signs of regions."""
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
        """Evaluate values, equations and derivatives.

        Returns (F, p) (n, 2, 6), differences of the triplets (n, 3), their derivatives (n, 3, 6),
        and ∂p/∂ξ (n, 2, 3, 3).
        """
        d = self.search.contact_map.chart.discretization
        values, tangents = solve_forces(d, with_normal_force(xi.reshape(-1, 3)), tangents=True)
        by_xi = tangents * unit.reshape(-1, 1, 3)
        pairs = len(xi)
        values, by_xi = values.reshape(pairs, 2, 6), by_xi.reshape(pairs, 2, 6, 3)
        away, slope = np.empty((pairs, 3)), np.empty((pairs, 3, 2, 3))
        which = np.array([SIGNALS.index(name) for name in self.search.names])
        equate(values, by_xi, which, away, slope)
        return values, away, slope.reshape(pairs, 3, 6), by_xi[:, :, 3:]

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
        """How well signals determine each contact of pairs, (n, 2); at least 1 is required."""
        rows = slope.reshape(-1, 3, 2, 3).swapaxes(1, 2)
        if not self.firm:
            size = np.linalg.norm(rows, axis=3).prod(axis=2)
            return np.asarray(np.abs(np.linalg.det(rows)) / np.maximum(_REGULAR * size, _RIDGE))
        # Rows are derivatives of signals, over |F|, |M| or in rad, multiplied by these.
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
        """Unit vectors (n, 2, 3) of force or moment, whichever a signal is a component of."""
        force = values[..., :3]
        a = force if name[0] == "F" else cross(values[..., 3:], force)
        return np.asarray(a / np.linalg.norm(a, axis=2, keepdims=True))

    def _facing(self, values: Array) -> Array:
        """Margins (n, k) by which transverse vectors of direction signals have the same sense."""
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
        """Basis (n, 3, 2, 3) of steps in the set, and derivatives (n, 3, m) of the levels."""
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
    """Maximise the cone angle from the best pairs of each pool and region.

    The maximum found depends on the start, so the largest is a lower bound. Each pool has its own
    climbs, so that none displaces another's.
    """
    signs = np.array(
        [[("CB" in r) * 1.0 - ("CF" in r), float("ELD" in r)] for r in regions]
    ).reshape(-1, 2)
    starts = [_select_starts(search, pairs, signs) for pairs in pools]
    number = np.concatenate([k * len(regions) + found[0] for k, found in enumerate(starts)])
    xi = np.concatenate([found[1] for found in starts])
    if not number.size:
        return pools[0].rows(number)
    signs = signs[number % len(regions)]
    count = sum(name[1] == "D" for name in search.names)
    rods, ends = {False: search, True: _on_finer_rod(search)}, []
    size = np.full(len(xi), _FIRST)
    objective = _Objective(search, _ROUNDS[0].cost, firm=False)
    state = objective.at(xi, signs)
    for one in _ROUNDS:
        if one.firm:
            number = number % len(regions)  # all pools' together
        merit = np.where(np.isfinite(state.merit), _merit(state.levels, one.cost), -np.inf)
        strict = np.where(np.isfinite(merit), _merit(state.levels, _STRICT), -np.inf)
        kept = np.union1d(
            _largest_merits(merit, number, one.most), _largest_merits(strict, number, one.most // 4)
        )
        number, signs, size = number[kept], signs[kept], size[kept]
        state = state.rows(kept)._replace(merit=merit[kept])
        objective = _Objective(rods[one.finer], one.cost, one.firm)
        if one.finer or one.firm:
            held = state.levels[:, 2:][:, : 1 + count].min(axis=1) < _HELD
            state = objective.at(state.xi, signs)
            going = np.isfinite(state.merit) & (one.finer | held)
            size = np.where(going, _FINE if one.finer else _FIRST, 0.0)
        for _ in range(one.steps):
            active = np.flatnonzero(size > _LAST)
            if not active.size:
                break
            _advance(objective, state, signs, size, active)
        if one.finer:
            ends.append(_solve_second_contacts(objective.search, state))
    return concatenate(ends)


def _solve_second_contacts(search: Search, state: _State) -> Pairs:
    """Solve for the second contact of each pair, which signals determine better than the first."""
    turned = state.distinct[:, 0] > state.distinct[:, 1]
    xi = np.where(turned[:, None, None], state.xi[:, ::-1], state.xi)
    contact_map, names, _, domain = search
    first, second, agrees = twins_near(contact_map, names, xi[:, 0], xi[:, 1], domain)
    apart = np.linalg.norm(second.values[:, 3:] - first.values[:, 3:], axis=1)
    chart = chart_of(contact_map.chart.fold, first.xi)
    return Pairs(chart, np.zeros(len(chart), np.int64), first, second, apart).rows(agrees)


def _on_finer_rod(search: Search) -> Search:
    """The same search on the finer rod, on which witnesses are confirmed."""
    contact_map = search.contact_map
    finer = discretize(contact_map.whisker, FINER * contact_map.steps)
    chart = replace(contact_map.chart, discretization=finer)
    return search._replace(contact_map=replace(contact_map, chart=chart))


def _select_starts(search: Search, pairs: Pairs, signs: Array) -> tuple[AnyArray, Array]:
    """Region indices and contacts of the best pairs of each region, in parts of the chart."""
    xi = np.stack([pairs.first.xi, pairs.second.xi], axis=1)
    # A pair and its exchange are equivalent: put the more distal contact first.
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


def _largest_merits(merit: Array, number: AnyArray, most: int) -> AnyArray:
    """Rows with the largest merits of each region."""
    order = np.lexsort([-merit, number])
    order = order[np.isfinite(merit[order])]
    again = (np.diff(number[order]) == 0) & (np.diff(merit[order]) > -_SAME)
    order = np.delete(order, 1 + np.flatnonzero(again))
    place = np.arange(len(order)) - np.searchsorted(number[order], number[order])
    return np.asarray(order[place < most])


def _merit(levels: Array, cost: float) -> Array:
    """The smaller angle minus the penalty of the worst violated margin."""
    return np.asarray(
        levels[..., :2].min(axis=-1) - cost * np.maximum(-levels[..., 2:], 0.0).max(axis=-1)
    )


def _advance(
    objective: _Objective, state: _State, signs: Array, size: Array, active: AnyArray
) -> None:
    """Take one step of the active climbs, and update their trust regions."""
    here, signs, within = state.rows(active), signs[active], size[active]
    basis, slopes = objective.slopes(here, signs)
    step, promised = _solve_program(here.levels, slopes, within, objective.cost)
    trial = objective.at(here.xi + np.einsum("nk,nkpi->npi", step, basis), signs)
    promised = promised - here.merit
    # Where the margins are nonlinear, once more with their values at the first trial.
    again = np.flatnonzero(np.isfinite(trial.merit) & (trial.merit - here.merit < 0.75 * promised))
    if again.size:
        bent = trial.levels - here.levels - np.einsum("nk,nkm->nm", step, slopes)
        step, _ = _solve_program(
            (here.levels + bent)[again], slopes[again], within[again], objective.cost
        )
        moved = here.xi[again] + np.einsum("nk,nkpi->npi", step, basis[again])
        second = objective.at(moved, signs[again])
        better = second.merit > trial.merit[again]
        trial.replace(again[better], second.rows(better))
    gain = trial.merit - here.merit
    up = gain > 0.05 * np.maximum(promised, 0.0)
    state.replace(active[up], trial.rows(up))
    within = within * np.where(gain > 0.7 * promised, 2.0, np.where(up, 1.0, 0.35))
    size[active] = np.where(promised < _LEAST_GAIN, 0.0, np.minimum(within, _LARGEST))


def _solve_program(levels: Array, slopes: Array, within: Array, cost: float) -> tuple[Array, Array]:
    """Steps (n, 3) in boxes that maximise the linearised merit, and that merit (n,)."""
    step = np.zeros((len(levels), 3))
    steepest(levels, slopes, within, cost, step)
    return step, _merit(levels + np.einsum("nk,nkm->nm", step, slopes), cost)
