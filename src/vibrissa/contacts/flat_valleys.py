"""What noise leaves open where the second order does not describe it: bent valleys; compiled.

Where χ² hardly determines one unknown, its valley may be long and bent, and so narrow that neither
an expansion about a contact nor the nodes of the chart describe it: of a contact ξ in the plane of
a planar whisker some signals do not change, to first order, with the bearing of the force. The
valley is followed both ways along the longest principal axis a_0 of the noise in ξ, by steps of
length l; at each, steps of Gauss and Newton along the others, a_1 and a_2, lead to its floor. The
density along it, with weights W that are those at each node, is

    exp(-χ²/2) |det W| det ∂p/∂ξ |det(∂ξ/∂l, a_1, a_2)|,

or that without volumes; the mean of both counts, as in :mod:`~vibrissa.contacts.valleys`.
"""

from __future__ import annotations

import math

import numpy as np

from vibrissa.contacts.expansion import axis_length, principal_axes, without_friction
from vibrissa.contacts.least_squares import channel_equations, lane_contact, whiten
from vibrissa.contacts.valleys import CLOSED, HIGH, Nodes, mixture, pace, shares_of
from vibrissa.contacts.weighing import Weighing, sharpness, weigh_any
from vibrissa.numerics import AnyArray, Array, copy, inlined, kernel, solve
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    LEAST_ARC,
    Rod,
    integrate,
    point_determinant,
    set_lane,
)

_STEPS, _ROUNDS = 12, 40  # steps each way at most, and how often contacts are evaluated for them
# The first step, in standard deviations, and at most; and the longest: as a share of the force, or
# of a quarter of L.
_FIRST, _SHORT, _LONGEST = 0.5, 0.02, 0.5
# On the floor of a valley χ² could fall by no more than this across it; so often is it looked for.
_FLOOR, _TRIALS = 0.01, 4
# A step is halved where its correction, relative to it, or its turn (as a cosine) is too large.
_LARGEST, _STRAIGHT = 2.5, 0.5
_SHORTEST = 2e-3
_FEW = 5  # a valley of fewer nodes is not described by them


@inlined
def _cosine(x: Array, a: Array, b: Array) -> float:
    """Cosine of the angle between two changes of ξ, relative to s and the force."""
    share = (x[2] * x[2] + x[3] * x[3]) / (x[0] * x[0])
    ab = share * a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    aa = share * a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    bb = share * b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    return float(ab / math.sqrt(aa * bb))


@inlined
def _node(
    x: Array,
    value: Array,
    t: Array,
    third: Array,
    how: Weighing,
    target: Array,
    measured: Array,
    nodes: Nodes,
    i: int,
    along: Array,
) -> float:
    """Fill a node, moved across the valley as x is; what χ² falls by then, negative for none.

    ``along`` becomes the valley's standard deviation, on the same side.
    """
    _, misfits, logs, points, spreads = nodes
    codes = how.codes
    k = codes.shape[0]
    residual, jacobian, weights = np.empty(k), np.empty((k, 4)), np.zeros((k, k))
    r, four, j = np.empty(k), np.empty((k, 4)), np.empty((k, 3))
    axes, frame, move, ahead = np.empty((3, 3)), np.empty((3, 3)), np.zeros(3), np.empty(3)
    if not weigh_any(how, value, measured, weights):
        return -1.0
    channel_equations(x, value, t, codes, target, residual, jacobian)
    chi, falls = whiten(weights, residual, jacobian, k, r, four), 0.0
    without_friction(four, j)
    if not (chi < np.inf and principal_axes(x, j, axes)):
        return -1.0
    for m in range(1, 3):
        slope = 0.0
        for a in range(k):
            slope += r[a] * (j[a, 0] * axes[0, m] + j[a, 1] * axes[1, m] + j[a, 2] * axes[2, m])
        falls += slope * slope
        for a in range(3):
            move[a] -= slope * axes[a, m]
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
    logs[i, 0] = logs[i, 1] + math.log(max(volume, 1e-300))
    shorter = min(1.0, _LONGEST / max(axis_length(x, move), 1e-300))
    x[0] += shorter * move[0]
    x[2] += shorter * move[1]
    x[3] += shorter * move[2]
    return falls if volume > 0.0 else -1.0


@inlined
def _ahead(x: Array, along: Array, step: float, to: Array) -> None:
    """Fill the contact a step farther."""
    share = step / axis_length(x, along)
    to[0] = min(max(x[0] + share * along[0], LEAST_ARC), 1.0)
    to[1], to[2], to[3] = 0.0, x[2] + share * along[1], x[3] + share * along[2]


@inlined
def _described(
    nodes: Nodes, first: int, last: int, ended: AnyArray, point: Array, covariance: Array
) -> bool:
    """Replace a covariance by that of the nodes, if these reach both ends."""
    misfits, least = nodes[1], np.inf
    for i in range(first, last):
        least = min(least, misfits[i])
    high = misfits[first] > least + CLOSED, misfits[last - 1] > least + CLOSED
    if last - first < _FEW or not ((high[1] or ended[0]) and (high[0] or ended[1])):
        return False
    shares, spread = np.empty(misfits.shape[0]), np.empty((3, 3))
    shares_of(nodes, first, last, shares)
    mixture(nodes, first, last, shares, point, spread)
    for a in range(3):
        for c in range(3):
            covariance[a, c] = spread[a, c] + (covariance[a, c] if ended[0] or ended[1] else 0.0)
    return True


@kernel
def follow_valley(
    rod: Rod,
    proximal: float,
    how: Weighing,
    target: Array,
    measured: Array,
    x: Array,
    covariance: Array,
) -> bool:
    """Replace a covariance by that of the valley through x (4,); whether it has both ends.

    It ends where χ² has risen enough, or with Ω: as it may go on along the fold, its covariance is
    then added.
    """
    b, most = np.zeros(BUFFER_SIZE), 2 * _STEPS + 1
    nodes = (
        np.zeros(most),
        np.full(most, np.inf),
        np.empty((most, 2)),
        np.empty((most, 3)),
        np.empty((most, 3, 3)),
    )
    places, misfits = nodes[0], nodes[1]
    at, to, along, turned = np.empty((2, 4)), np.empty((2, 4)), np.empty((2, 3)), np.empty(3)
    value, t, third, gone = np.empty(6), np.zeros((6, 4)), np.empty((6, 3)), np.empty(3)
    steps, number, tries = np.empty(2), np.zeros(2, np.int64), np.zeros(2, np.int64)
    active, ended = np.ones(2, np.bool_), np.zeros(2, np.bool_)
    floor, point = np.empty(4), np.empty(3)
    for lane in range(LANES):
        set_lane(b, lane, x[0], 0.0, x[2], x[3], False)
    integrate(rod, b, 3)
    lane_contact(b, 0, False, value, t, third)
    copy(x, floor)
    turned[0], turned[1], turned[2] = 0.0, -x[3], x[2]
    if _node(floor, value, t, third, how, target, measured, nodes, _STEPS, turned) < 0.0:
        return False
    copy(value[3:], point)
    for way in range(2):
        copy(x, at[way])
        for a in range(3):
            along[way, a] = turned[a] if way == 0 else -turned[a]
        steps[way] = min(_FIRST * axis_length(x, turned), _SHORT)
        _ahead(at[way], along[way], steps[way], to[way])
    for _ in range(_ROUNDS):
        if not (active[0] or active[1]):
            break
        for lane in range(LANES):
            c = to[lane // 2] if active[lane // 2] else x
            set_lane(b, lane, c[0], 0.0, c[2], c[3], False)
        integrate(rod, b, 3)
        for way in range(2):
            if not active[way]:
                continue
            side = 1 - 2 * way
            i = _STEPS + side * (number[way] + 1)
            before = misfits[i - side]
            lane_contact(b, 2 * way, False, value, t, third)
            copy(along[way], turned)
            falls = _node(to[way], value, t, third, how, target, measured, nodes, i, turned)
            tries[way] += 1
            if falls >= _FLOOR and tries[way] < _TRIALS:
                to[way, 0] = min(max(to[way, 0], LEAST_ARC), 1.0)
                continue
            for a in range(3):
                gone[a] = to[way, min(a, 1) + a] - at[way, min(a, 1) + a]
            tries[way] = 0
            edge = falls < 0.0 or not proximal <= to[way, 0] <= 1.0
            good = not edge and falls < _FLOOR
            good = good and axis_length(at[way], gone) < _LARGEST * steps[way]
            if good and _cosine(to[way], turned, along[way]) > _STRAIGHT:
                places[i] = places[i - side] + side * steps[way]
                number[way] += 1
                copy(to[way], at[way])
                copy(turned, along[way])
                active[way] = misfits[i] < misfits[_STEPS] + HIGH and number[way] < _STEPS
                steps[way] = min(pace(misfits[i] - before) * steps[way], _LONGEST)
            else:
                steps[way] *= 0.5
                active[way] = steps[way] > _SHORTEST
                ended[way] = edge
            _ahead(at[way], along[way], steps[way], to[way])
    return _described(nodes, _STEPS - number[1], _STEPS + number[0] + 1, ended, point, covariance)
