"""Posterior along bent valleys of χ² that the second order does not describe; compiled.

If χ² hardly depends on one unknown, its valley may be long and bent, and so narrow that neither an
expansion about a contact nor the nodes of the chart describe it. For a contact ξ in the plane of a
planar whisker, some signals do not change to first order with the bearing of the force. The valley
is followed both ways along the longest principal axis a_0 of the noise in ξ, by steps of length l,
each bent as the last one was; at each, Gauss-Newton steps along the other axes, a_1 and a_2, lead
to its floor within the whisker. The density along it, with weights W computed at each node, is

    exp(-χ²/2) |det W| det ∂p/∂ξ |det(∂ξ/∂l, a_1, a_2)|,

or that without volumes; the mean of both is used, as in
:mod:`~vibrissa.contacts.uncertainty.valleys`.
"""

from __future__ import annotations

import math

import numpy as np

from vibrissa.contacts.fitting.least_squares import channel_equations, contact_equations, whiten
from vibrissa.contacts.sensing.weighing import Weighing, sharpness, weigh_any
from vibrissa.contacts.uncertainty.expansion import axis_length, principal_axes, without_friction
from vibrissa.contacts.uncertainty.valleys import CLOSED, Nodes, mixture, pace, shares_of
from vibrissa.numerics import Array, copy, inlined, kernel, solve
from vibrissa.rod import BUFFER_SIZE, Charted, point_determinant

_STEPS, _ROUNDS = 12, 40  # largest numbers of steps each way, and of evaluations of contacts
# First step, in standard deviations, and its limit; and the longest step: as a share of the force,
# or of a quarter of L.
_FIRST, _SHORT, _LONGEST = 0.5, 0.02, 0.5
# Largest fall of χ² across the floor of a valley, and iterations to reach the floor.
_FLOOR, _TRIALS = 0.01, 4
# Ratio of this fall to the one before above which the floor is not found.
_SLOW = 0.3
# Limits of the change of ξ relative to the step, and of the cosine of its turn, outside which the
# step is halved.
_SMALLEST, _LARGEST, _STRAIGHT = 0.3, 2.5, 0.5
# Height of χ² above the minimum to which a valley is followed.
_HIGH = 16.0
# Limits near the fold: it is expected within one more step, and the valley ends near it, as shares
# of the distance to it and of the valley so far.
_BEFORE, _NEAR = 0.9, 0.05
_SHORTEST = 2e-3
_FLAT = 1e-30  # negligible volumes
_FEW = 5  # fewest nodes that describe a valley


@inlined
def _cosine(x: Array, a: Array, b: Array) -> float:
    """Cosine of the angle between two changes of ξ, relative to s and the force."""
    share = (x[2] * x[2] + x[3] * x[3]) / (x[0] * x[0])
    ab = share * a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    aa = share * a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    bb = share * b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    return float(ab / math.sqrt(aa * bb))


@inlined
def _floor_of(x: Array, r: Array, j: Array, axes: Array, proximal: float, move: Array) -> float:
    """Fill the move across a valley to its floor within the whisker; return the fall of χ²."""
    away, steep, square, falls = np.zeros(3), 0.0, 0.0, 0.0
    for m in range(1, 3):
        for a in range(r.shape[0]):
            by = j[a, 0] * axes[0, m] + j[a, 1] * axes[1, m] + j[a, 2] * axes[2, m]
            away[m] -= r[a] * by
        steep += axes[0, m] * away[m]
        square += axes[0, m] * axes[0, m]
        falls += away[m] * away[m]
    left = min(max(x[0] + steep, proximal), 1.0) - x[0] - steep
    if left != 0.0:
        for m in range(1, 3):
            away[m] += axes[0, m] * left / square
        falls -= left * left / square
    for a in range(3):
        move[a] = axes[a, 1] * away[1] + axes[a, 2] * away[2]
    return falls


@inlined
def _node(
    x: Array,
    value: Array,
    t: Array,
    proximal: float,
    how: Weighing,
    target: Array,
    measured: Array,
    nodes: Nodes,
    i: int,
    along: Array,
) -> tuple[float, float]:
    """Fill a node, moved across the valley as x is; return the last fall of χ² and det ∂p/∂ξ.

    ``along`` becomes the valley's standard deviation, on the same side. If there is no valley the
    determinant is negative.
    """
    _, misfits, logs, points, spreads = nodes
    codes = how.codes
    k = codes.shape[0]
    residual, jacobian, weights = np.empty(k), np.empty((k, 4)), np.zeros((k, k))
    r, four, j, third = np.empty(k), np.empty((k, 4)), np.empty((k, 3)), np.empty((6, 3))
    axes, frame, move, ahead = np.empty((3, 3)), np.empty((3, 3)), np.zeros(3), np.empty(3)
    if not weigh_any(how, value, measured, weights):
        return 0.0, -np.inf
    channel_equations(x, value, t, codes, target, residual, jacobian)
    chi = whiten(weights, residual, jacobian, k, r, four)
    without_friction(four, j)
    if not (chi < np.inf and principal_axes(x, j, axes)):
        return 0.0, -np.inf
    without_friction(t, third)
    falls = _floor_of(x, r, j, axes, proximal, move)
    for a in range(3):
        ahead[a] = axes[a, 0]
    size, side = axis_length(x, ahead), math.copysign(1.0, _cosine(x, ahead, along))
    spreads[i] = 0.0
    for a in range(3):
        along[a] = side * ahead[a]
        frame[a, 0], frame[a, 1], frame[a, 2] = ahead[a] / size, axes[a, 1], axes[a, 2]
        points[i, a] = value[3 + a]
        for c in range(3):
            points[i, a] += third[3 + a, c] * move[c]
    for m in range(1, 3):
        for a in range(3):
            ahead[a] = 0.0
            for c in range(3):
                ahead[a] += third[3 + a, c] * axes[c, m]
        for a in range(3):
            for c in range(3):
                spreads[i, a, c] += ahead[a] * ahead[c]
    volume = point_determinant(third)
    misfits[i] = chi - falls
    logs[i, 1] = math.log(abs(solve(frame, ahead)) + 1e-300) - 0.5 * misfits[i]
    logs[i, 1] += sharpness(weights)
    logs[i, 0] = logs[i, 1] + math.log(max(volume, _FLAT))
    shorter = min(1.0, _LONGEST / max(axis_length(x, move), 1e-300))
    x[0] = min(max(x[0] + shorter * move[0], proximal), 1.0)
    x[2] += shorter * move[1]
    x[3] += shorter * move[2]
    return falls, volume


@inlined
def _ahead(x: Array, along: Array, bend: Array, step: float, proximal: float, to: Array) -> float:
    """Fill the contact one step farther along a bending direction; return the step's length."""
    size, turn = axis_length(x, along), axis_length(x, bend)
    up = along[0] / size
    room = (1.0 - x[0]) / up if up > 0.0 else (x[0] - proximal) / max(-up, 1e-300)
    step = min(step, room)
    share, bent = step / size, 0.5 * step * min(step, 1.0 / max(turn, 1e-300))
    to[0] = min(max(x[0] + share * along[0] + bent * bend[0], proximal), 1.0)
    to[1] = 0.0
    to[2] = x[2] + share * along[1] + bent * bend[1]
    to[3] = x[3] + share * along[2] + bent * bend[2]
    return step


@inlined
def _one_way(
    rod: Charted,
    proximal: float,
    how: Weighing,
    target: Array,
    measured: Array,
    start: Array,
    volume: float,
    side: int,
    nodes: Nodes,
    along: Array,
) -> tuple[int, bool]:
    """Fill the nodes on one side of the start; return their number, and whether they end with Ω."""
    places, misfits = nodes[0], nodes[1]
    b, value, t = np.zeros(BUFFER_SIZE), np.empty(6), np.zeros((6, 4))
    at, to, turned, gone = start.copy(), np.zeros(4), np.empty(3), np.empty(3)
    bend = np.zeros(3)
    step, number, spent, ended = min(_FIRST * axis_length(start, along), _SHORT), 0, 0, False
    while number < _STEPS and spent < _ROUNDS:
        i = _STEPS + side * (number + 1)
        wanted, step = step, _ahead(at, along, bend, step, proximal, to)
        if step < _SHORTEST or (ended and step < _NEAR * abs(places[i - side])):
            return number, ended or step < wanted
        falls, there, trials = np.inf, 1.0, 0
        for _ in range(_TRIALS):
            contact_equations(rod, b, True, to, value, t)
            copy(along, turned)
            before = falls
            falls, there = _node(to, value, t, proximal, how, target, measured, nodes, i, turned)
            spent, trials = spent + 1, trials + 1
            if there <= 0.0 or falls < _FLOOR or falls > _SLOW * before:
                break
        if there <= 0.0:  # beyond the fold, where the determinant vanishes
            ended = True
            step *= max(_BEFORE * volume / max(volume - there, 1e-300), 0.1)
            continue
        for a in range(3):
            gone[a] = to[min(a, 1) + a] - at[min(a, 1) + a]
        if not (
            falls < _FLOOR
            and _SMALLEST * step < axis_length(at, gone) < _LARGEST * step
            and _cosine(to, turned, along) > _STRAIGHT
        ):
            step *= 0.5
            continue
        old, new = axis_length(at, along), axis_length(to, turned)
        for a in range(3):
            bend[a] = (turned[a] / new - along[a] / old) / step
        places[i] = places[i - side] + side * step
        number, volume = number + 1, there
        copy(to, at)
        copy(turned, along)
        if not misfits[i] < misfits[_STEPS] + _HIGH:
            break
        longer = pace(misfits[i] - misfits[i - side]) if trials < _TRIALS - 1 else 1.0
        step = min(longer * step, _LONGEST)
    return number, ended


@inlined
def _described(
    nodes: Nodes, first: int, last: int, more: bool, point: Array, covariance: Array
) -> None:
    """Replace a covariance by that of the nodes, or add it if the valley may go on (``more``)."""
    shares, spread = np.empty(nodes[0].shape[0]), np.empty((3, 3))
    shares_of(nodes, first, last, shares)
    mixture(nodes, first, last, shares, point, spread)
    for a in range(3):
        for c in range(3):
            covariance[a, c] = spread[a, c] + (covariance[a, c] if more else 0.0)


@kernel
def follow_valley(
    rod: Charted,
    proximal: float,
    how: Weighing,
    target: Array,
    measured: Array,
    x: Array,
    covariance: Array,
) -> None:
    """Replace a covariance by that of the valley through x (4,), if enough of it is found.

    The valley ends where χ² has risen enough, or with Ω. As it may continue there along the fold,
    or farther than it is followed, its covariance is then added instead.
    """
    b, most = np.zeros(BUFFER_SIZE), 2 * _STEPS + 1
    nodes = (
        np.zeros(most),
        np.full(most, np.inf),
        np.empty((most, 2)),
        np.empty((most, 3)),
        np.empty((most, 3, 3)),
    )
    misfits, value, t, number = nodes[1], np.empty(6), np.zeros((6, 4)), np.zeros(2, np.int64)
    floor, point, along, turned = x.copy(), np.empty(3), np.empty(3), np.empty(3)
    more, least = False, np.inf
    contact_equations(rod, b, True, x, value, t)
    turned[0], turned[1], turned[2] = 0.0, -x[3], x[2]
    _, volume = _node(floor, value, t, proximal, how, target, measured, nodes, _STEPS, turned)
    if not volume > -np.inf:
        return
    copy(value[3:], point)
    volume = max(volume, 0.0)
    for way in range(2):
        side = 1 - 2 * way
        for a in range(3):
            along[a] = side * turned[a]
        number[way], ended = _one_way(
            rod, proximal, how, target, measured, x, volume, side, nodes, along
        )
        more = more or ended
    first, last = _STEPS - number[1], _STEPS + number[0] + 1
    for i in range(first, last):
        least = min(least, misfits[i])
    more = more or min(misfits[first], misfits[last - 1]) < least + CLOSED
    if last - first >= _FEW:
        _described(nodes, first, last, more, point, covariance)
