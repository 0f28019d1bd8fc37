"""Samples of the curve or surface of contacts that explain fewer than three signals.

A contact has three unknowns ξ = (s, f_y, f_z). Two signals leave a curve: at each of a few stations
of the map, the forces that give both. One signal leaves a surface: at each station and in each
direction of the force. Where the set passes through the chart follows from the signals at its
nodes; from there Newton's method on the rod finds a point of it exactly, at the same station, by
the shortest step where one signal leaves the force open.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import Candidates
from vibrissa.contacts.engine.readout import Measurement, Mixed, Named
from vibrissa.contacts.fitting.least_squares import channel_equations
from vibrissa.contacts.sensing.channels import CIRCULAR, channels_of
from vibrissa.contacts.sensing.weighing import Weighing, weigh
from vibrissa.numerics import AnyArray, Array, copy, inlined, kernel
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    Fold,
    Rod,
    StableSet,
    chart_to_contact,
    integrate,
    lane_tangents,
    lane_value,
    point_determinant,
    set_lane,
    stable,
    with_normal_force,
)

# Stride through the chart's stations, and for a surface also through its bearings.
_STATIONS = 2
_BEARINGS = 4
_MOST = 1024  # largest number of samples
# Step, relative to the force, below which it is the last, taken to first order.
_LAST = 3e-5
_ROUNDS = 15
_FAR, _SOON = 0.1, 5  # distance above which a start is given up after these iterations
# Bilinear signals intersect in a face, or no farther (in cell widths) from its middle.
_BESIDE = 1.5
_ONE = 0.1  # intersections from adjacent faces within this (in cell widths) are the same
# Smallest force of a starting point, as a share of a cell, for one signal and for two.
_REST = (0.05, 0.5)
_SAME = 1e-4  # two samples of a station within this, relative to the force, are the same
# Ratio of information, relative to other directions, below which signals do not determine a
# direction.
_OPEN = 1e-14


class Sections(NamedTuple):
    """Chart of a whisker at some stations, non-dimensional except for the units."""

    rod: Rod
    fold: Fold
    proximal: float
    stations: Array
    bearings: Array
    loads: Array
    seen: Array
    turns: AnyArray


class Ambiguity:
    """Samples of the contacts that explain one or two signals."""

    def __init__(self, chart: StableSet, readout: Named | Mixed) -> None:
        how = readout.how
        codes = how.codes.tolist()
        named = isinstance(readout, Named)
        self._how = how
        self._sections = Sections(
            chart.discretization.rod,
            chart.fold,
            chart.proximal,
            np.linspace(0.0, 1.0, len(chart.stations))[::_STATIONS],
            chart.bearings,
            chart.loads,
            np.ascontiguousarray(channels_of(chart.values)[::_STATIONS][..., codes] @ how.mixing.T),
            np.array([named and CIRCULAR[code] for code in codes])[: len(how.mixing)],
        )

    def samples(self, measurement: Measurement) -> tuple[Candidates, int, Array]:
        """Sample the set: candidates, index of the middle one, their covariance about it."""
        xi, values = np.empty((_MOST, 3)), np.empty((_MOST, 6))
        across, covariance = np.zeros((_MOST, 3, 3)), np.empty((3, 3))
        n, middle = sample(
            self._sections,
            self._how,
            measurement.target,
            measurement.measured,
            xi,
            values,
            across,
            covariance,
        )
        out = Candidates.room(1, n)
        out.number[0], out.x[0], out.values[0] = n, with_normal_force(xi[:n]), values[:n]
        out.covariances[0] = across[:n]
        return out, middle, covariance


@kernel
def sample(
    of: Sections,
    how: Weighing,
    target: Array,
    measured: Array,
    xi: Array,
    values: Array,
    across: Array,
    covariance: Array,
) -> tuple[int, int]:
    """Sample the contacts that explain one or two signals."""
    tangents = np.empty((_MOST, 6, 3))
    n = _starts(of, how, target, xi)
    n = _met(of, how, target, n, xi, values, tangents)
    for row in range(n):
        _across(how, measured, xi[row], values[row], tangents[row], across[row])
    return n, _middle(values[:n, 3:], across, covariance)


@inlined
def _middle(points: Array, across: Array, covariance: Array) -> int:
    """Index of the sample nearest to the mean; fill the covariance about it, its own included."""
    n, mean, chosen, least = points.shape[0], np.zeros(3), 0, np.inf
    for row in range(n):
        for a in range(3):
            mean[a] += points[row, a] / n
    for row in range(n):
        away = 0.0
        for a in range(3):
            away += (points[row, a] - mean[a]) ** 2
        if away < least:
            chosen, least = row, away
    for a in range(3):
        for c in range(3):
            total = 0.0
            for row in range(n):
                total += (points[row, a] - points[chosen, a]) * (points[row, c] - points[chosen, c])
                total += across[row, a, c]
            covariance[a, c] = total / max(n, 1)
    return chosen


@kernel
def _starts(of: Sections, how: Weighing, target: Array, starts: Array) -> int:
    """Fill ξ near which the set passes through the sections; return their number."""
    q = of.seen.shape[3]
    wanted = np.zeros(q)
    for i in range(q):
        for a in range(how.codes.shape[0]):
            wanted[i] += how.mixing[i, a] * target[a]
    away = np.empty((of.bearings.shape[0], of.loads.shape[0], q))
    sign = np.empty(away.shape[:2], np.int8)
    at, crossings, place, n = np.empty((_MOST, 2)), np.empty((2, 2)), np.empty(3), 0
    for station in range(of.stations.shape[0]):
        first = n
        for j in range(away.shape[0]):
            for k in range(away.shape[1]):
                bits = 0
                for i in range(q):
                    d = of.seen[station, j, k, i] - wanted[i]
                    if of.turns[i]:
                        d -= 2.0 * np.pi * np.rint(d / (2.0 * np.pi))
                    away[j, k, i] = d
                    bits |= (1 << i) if d > 0.0 else 0
                sign[j, k] = bits
            step, rest = (1, _REST[1]) if q > 1 else (_BEARINGS, _REST[0])
        for j in range(0, away.shape[0] - 1, step):
            for k in range(away.shape[1] - 1):
                met = sign[j, k] ^ sign[j, k + 1]
                if q > 1:
                    met |= (sign[j, k] ^ sign[j + 1, k]) | (sign[j, k] ^ sign[j + 1, k + 1])
                if met != (1 << q) - 1:
                    continue
                if _turned(away, of.turns, j, k, q):
                    continue
                if q == 1:
                    crossings[0, 0] = 0.0
                    crossings[0, 1] = away[j, k, 0] / (away[j, k, 0] - away[j, k + 1, 0])
                count = 1 if q == 1 else _crossings(away, j, k, crossings)
                for crossing in range(count):
                    u, v = j + crossings[crossing, 0], max(k + crossings[crossing, 1], rest)
                    new = True
                    for other in range(first, n):
                        distance = max(abs(u - at[other, 0]), abs(v - at[other, 1]))
                        new = new and (q == 1 or distance > _ONE)
                    if not new:
                        continue
                    if n == _MOST:
                        return n
                    at[n, 0], at[n, 1] = u, v
                    place[0] = of.stations[station]
                    place[1] = of.bearings[0] + u * (of.bearings[1] - of.bearings[0])
                    place[2] = min(v * (of.loads[1] - of.loads[0]), 1.0)
                    chart_to_contact(of.fold, place, starts[n])
                    n += 1
    return n


@inlined
def _turned(away: Array, turns: AnyArray, j: int, k: int, q: int) -> bool:
    """Whether a direction merely jumps by a full turn in a face, or along the load."""
    turned = False
    for i in range(q):
        a, b = away[j, k, i], away[j, k + 1, i]
        most, least = max(a, b), min(a, b)
        if q > 1:
            a, b = away[j + 1, k, i], away[j + 1, k + 1, i]
            most, least = max(most, a, b), min(least, a, b)
        turned = turned or (turns[i] and most - least >= np.pi)
    return turned


@inlined
def _crossings(away: Array, j: int, k: int, crossings: Array) -> int:
    """Fill the intersections of two signals, taken as bilinear, in or near a face; their number.

    They are in cell widths from its corner (j, k); where the curves miss each other, the middle,
    near which they almost touch.
    """
    c = np.empty((2, 4))
    for i in range(2):
        a00, a01 = away[j, k, i], away[j, k + 1, i]
        a10, a11 = away[j + 1, k, i], away[j + 1, k + 1, i]
        scale = 1.0 / (abs(a00) + abs(a01) + abs(a10) + abs(a11))
        c[i, 0], c[i, 1] = scale * a00, scale * (a10 - a00)
        c[i, 2], c[i, 3] = scale * (a01 - a00), scale * (a11 - a10 - a01 + a00)
    # At (u, v) in a face: eliminating v gives a u² + b u + d = 0.
    a = c[1, 1] * c[0, 3] - c[0, 1] * c[1, 3]
    b = c[1, 0] * c[0, 3] + c[1, 1] * c[0, 2] - c[0, 0] * c[1, 3] - c[0, 1] * c[1, 2]
    d = c[1, 0] * c[0, 2] - c[0, 0] * c[1, 2]
    if b * b < 4.0 * a * d:
        crossings[0, 0] = crossings[0, 1] = 0.5
        return 1
    q = -0.5 * (b + np.sqrt(b * b - 4.0 * a * d) * (1.0 if b > 0.0 else -1.0))
    count = 0
    for root in range(2):
        u = d / q if root == 0 else q / a
        first, second = c[0, 2] + c[0, 3] * u, c[1, 2] + c[1, 3] * u
        row, slope = (0, first) if abs(first) > abs(second) else (1, second)
        v = -(c[row, 0] + c[row, 1] * u) / slope
        if max(abs(u - 0.5), abs(v - 0.5)) <= _BESIDE:
            crossings[count, 0], crossings[count, 1] = u, v
            count += 1
    return count


@kernel
def _met(
    of: Sections, how: Weighing, target: Array, n: int, xi: Array, values: Array, tangents: Array
) -> int:
    """Move starts at their stations onto the set; return the number of stable, distinct ones."""
    b, row, rounds = np.zeros(BUFFER_SIZE), np.full(LANES, -1), np.zeros(LANES, np.int64)
    k, q = how.codes.shape[0], how.mixing.shape[0]
    x, value, third, t = np.zeros(4), np.empty(6), np.empty((6, 3)), np.zeros((6, 4))
    residual, jacobian, step = np.empty(k), np.empty((k, 4)), np.empty(2)
    good = np.zeros(n, np.bool_)
    following = 0
    while True:
        busy = -1
        for i in range(LANES):
            if row[i] < 0 and following < n:
                row[i], rounds[i] = following, 0
                following += 1
            busy = max(busy, row[i])
        if busy < 0:
            break
        for i in range(LANES):
            c = xi[row[i] if row[i] >= 0 else busy]
            set_lane(b, i, c[0], 0.0, c[1], c[2], False)
        integrate(of.rod, b, 3)
        for i in range(LANES):
            if row[i] < 0:
                continue
            c = xi[row[i]]
            lane_value(b, i, value)
            lane_tangents(b, i, third)
            for a in range(6):
                t[a, 0], t[a, 2], t[a, 3] = third[a, 0], third[a, 1], third[a, 2]
            x[0], x[2], x[3] = c[0], c[1], c[2]
            channel_equations(x, value, t, how.codes, target, residual, jacobian)
            force = np.sqrt(c[1] * c[1] + c[2] * c[2])
            size = _shortest(how.mixing, residual, jacobian, q, k, step) / force
            rounds[i] += 1
            shorten = 1.0 / max(2.0 * size, 1.0)
            for a in range(2):
                step[a] *= shorten
                c[1 + a] += step[a]
            if size <= _LAST:
                for a in range(6):
                    value[a] += third[a, 1] * step[0] + third[a, 2] * step[1]
                    copy(third[a], tangents[row[i], a])
                copy(value, values[row[i]])
                good[row[i]] = stable(of.fold, of.proximal, c, point_determinant(third))
                row[i] = -1
            elif not size < (_FAR if rounds[i] >= _SOON else np.inf) or rounds[i] == _ROUNDS:
                row[i] = -1
    kept = 0
    for i in range(n):
        new = good[i]
        for other in range(kept):
            force = np.hypot(xi[i, 1], xi[i, 2])
            apart = abs(xi[other, 1] - xi[i, 1]) + abs(xi[other, 2] - xi[i, 2])
            if xi[other, 0] == xi[i, 0] and apart < _SAME * force:
                new = False
        if new:
            copy(xi[i], xi[kept])
            copy(values[i], values[kept])
            for a in range(6):
                copy(tangents[i, a], tangents[kept, a])
            kept += 1
    return kept


@inlined
def _shortest(
    mixing: Array, residual: Array, jacobian: Array, q: int, k: int, step: Array
) -> float:
    """Fill the shortest step of (f_y, f_z) that meets one or two signals; return its length."""
    j, r = np.zeros((2, 2)), np.zeros(2)
    for i in range(q):
        for a in range(k):
            r[i] += mixing[i, a] * residual[a]
            j[i, 0] += mixing[i, a] * jacobian[a, 2]
            j[i, 1] += mixing[i, a] * jacobian[a, 3]
    if q == 1:
        back = -r[0] / (j[0, 0] * j[0, 0] + j[0, 1] * j[0, 1])
        step[0], step[1] = back * j[0, 0], back * j[0, 1]
    else:
        det = j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]
        step[0] = (j[0, 1] * r[1] - j[1, 1] * r[0]) / det
        step[1] = (j[1, 0] * r[0] - j[0, 0] * r[1]) / det
    return float(np.sqrt(step[0] * step[0] + step[1] * step[1]))


@kernel
def _across(
    how: Weighing, measured: Array, xi: Array, value: Array, tangent: Array, out: Array
) -> None:
    """Fill the covariance (3, 3) of the contact point due to noise, across the set."""
    k, q = how.codes.shape[0], how.mixing.shape[0]
    weights, x, t = np.empty((k, k)), np.zeros(4), np.zeros((6, 4))
    residual, jacobian = np.empty(k), np.empty((k, 4))
    if not weigh(how, value, measured, weights):
        return
    force = np.hypot(xi[1], xi[2])
    x[0], x[2], x[3] = xi[0], xi[1], xi[2]
    for a in range(6):  # forces relative to their size
        t[a, 0], t[a, 2], t[a, 3] = tangent[a, 0], force * tangent[a, 1], force * tangent[a, 2]
    channel_equations(x, value, t, how.codes, np.zeros(k), residual, jacobian)
    j, gram, root = np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((3, 2))
    for i in range(q):
        for c in range(3):
            for a in range(k):
                j[i, c] += weights[i, a] * jacobian[a, 0 if c == 0 else c + 1]
    for i in range(2):
        for c in range(2):
            gram[i, c] = j[i, 0] * j[c, 0] + j[i, 1] * j[c, 1] + j[i, 2] * j[c, 2]
    det = gram[0, 0] * gram[1, 1] - gram[0, 1] * gram[1, 0]
    if q == 1 or not det > _OPEN * gram[0, 0] * gram[1, 1]:
        more = 1 if gram[1, 1] > gram[0, 0] else 0  # the direction that is determined better
        for c in range(2):
            j[1 - more, c], gram[1 - more, c], gram[c, 1 - more] = 0.0, 0.0, 0.0
        j[1 - more, 2], gram[1 - more, 1 - more] = 0.0, 1.0
        det = gram[0, 0] * gram[1, 1]
    for a in range(3):
        p0 = p1 = 0.0
        for c in range(3):
            slope = t[3 + a, 0 if c == 0 else c + 1]
            p0 += slope * j[0, c]
            p1 += slope * j[1, c]
        root[a, 0] = (p0 * gram[1, 1] - p1 * gram[1, 0]) / det
        root[a, 1] = (p1 * gram[0, 0] - p0 * gram[0, 1]) / det
    # (Jᵀ G⁻¹)(G⁻¹ J) as root rootᵀ with root = ∂p/∂ξ J⁺.
    for a in range(3):
        for c in range(3):
            out[a, c] = root[a, 0] * root[c, 0] + root[a, 1] * root[c, 1]
