"""Posterior of a contact with friction along bent valleys of χ² on the whisker; compiled.

A wrench determines the force well, but hardly the position of a contact near a thin tip: χ² has
long, bent valleys, which no expansion about the minimum describes. So a valley is followed from
the minimum both ways along the arc length s, until χ² has risen enough or the whisker ends. At each
s a Gauss-Newton step leads to the force of minimum χ², of covariance C_f to first order; where it
is long, s changes by less. With a uniform prior of contact points p and friction angles φ, the
density of s is

    exp(-χ²/2) |∂(p, φ)/∂(s, f)| √det C_f;

with a uniform prior of s and f it is that without the second factor. The mean of both is used. The
weight of a valley is the integral of the first with a normal prior of friction angles: the minimum
of χ² may have much friction, but a contact farther along the valley none.
Contact points are a mixture of normal distributions along the valley. The covariance is their
second moment about the contact, widened until the share of the mixture beyond three standard
deviations is the nominal one. The squared distance of each part is approximated by a shifted χ²
distribution with the same three cumulants (H. Liu, Y. Tang, H. H. Zhang, *A new chi-square
approximation to the distribution of non-negative definite quadratic forms in non-central normal
variables*, Comput. Stat. Data Anal. 53 (2009) 853-856), whose cube root is nearly normal.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import LEFT, THREE_SIGMA
from vibrissa.contacts.fitting.least_squares import channel_equations, lane_contact, whiten
from vibrissa.contacts.sensing.channels import FITTED
from vibrissa.contacts.uncertainty.posterior import HELD
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    cholesky,
    copy,
    inlined,
    kernel,
    mahalanobis,
    share_out,
    solve,
    solve_root,
)
from vibrissa.rod import BUFFER_SIZE, Discretization, Rod, integrate, set_lane

# Largest numbers of steps each way, and of steps that are tried; the first one in standard
# deviations of s, and its limits over L. Equal steps of one standard deviation integrate a normal
# distribution to 1e-7.
_STEPS, _TRIED = 16, 28
_FIRST, _SHORTEST, _LONGEST = 1.0, 1e-9, 0.05
# Height of χ² above the minimum to which a valley is followed, and from which it counts as closed,
# so that the covariance may be valid.
HIGH, CLOSED = 30.0, 9.0
# Factor of the next step's length, by the rise of χ² on the last step; for a normal distribution
# all steps are equal.
_PACE = ((0.4, 2.0), (0.8, 1.3), (12.0, 1.0), (math.inf, 0.6))
# Largest rise of χ² on a step before the valley is closed (7 for a normal distribution), and
# largest fall of χ² from the end of a step to the floor, which grows with the fourth power of the
# step. A longer step has left the valley, as near a thin tip, and is tried again, shorter; if this
# has not helped so many times, the valley turns back in s, and the longer step is taken.
_MOST_RISE, _MOST_FALL, _SHORTER, _REFUSED = 12.0, 4.0, 0.35, 4
_LARGEST_CHANGE = 0.5  # largest change of the force's moment in a step, as a share of it
# Largest factor by which a covariance is widened, and bisections to find it.
_WIDEST, _BISECTIONS = 8.0, 8
# Limits of a valid covariance: share in ellipsoids of 95 %, and the factor of widening.
_LEAST_HELD, _MOST_HELD, _MOST_WIDENED = 0.93, 0.98, 1.7
#: Standard deviation of friction angles, by which valleys are weighed.
LIKELY_FRICTION = math.radians(20.0)
_NOTHING = 1e-6  # negligible variances, relative to that of the whole mixture


class Valleys(NamedTuple):
    """Covariances of points (n, 3, 3), log weights (n,), and validity (n,) of candidates."""

    covariances: Array
    weight: Array
    valid: AnyArray

    @classmethod
    def room(cls, n: int) -> Valleys:
        """Results for n contacts, not computed yet."""
        return cls(np.full((n, 3, 3), np.nan), np.full(n, -np.inf), np.zeros(n, np.bool_))


# Row of a node along a valley: s, χ², logs of densities (with volumes, without, and here one with
# volumes and the prior of friction), point (3), its covariance (3, 3).
Nodes = tuple[Array, Array, Array, Array, Array]


@inlined
def _node(
    x: Array,
    value: Array,
    t: Array,
    codes: IntArray,
    target: Array,
    weights: Array,
    nodes: Nodes,
    i: int,
    along: Array,
) -> tuple[float, float]:
    """Fill a node at the arc length of x, moved to minimum χ².

    Return the variance of s alone, which is negative if χ² has no minimum, and the fall of χ².
    ``along`` becomes ∂f/∂s of the valley.
    """
    s, misfits, logs, points, spreads = nodes
    k = codes.shape[0]
    residual, jacobian = np.empty(k), np.empty((k, 4))
    r, j, whole = np.empty(k), np.empty((k, 4)), np.zeros((4, 4))
    normal, root, down, column = np.empty((3, 3)), np.zeros((3, 3)), np.empty(3), np.empty(3)
    channel_equations(x, value, t, codes, target, residual, jacobian)
    chi, steep = whiten(weights, residual, jacobian, k, r, j), 0.0
    for a in range(3):
        down[a], along[a] = 0.0, 0.0
        for m in range(k):
            down[a] -= j[m, 1 + a] * r[m]
            along[a] -= j[m, 1 + a] * j[m, 0]
        for c in range(3):
            normal[a, c] = 0.0
            for m in range(k):
                normal[a, c] += j[m, 1 + a] * j[m, 1 + c]
    if not (chi < np.inf and cholesky(normal, root)):
        return -1.0, np.inf
    for m in range(k):
        steep += j[m, 0] * j[m, 0]
    copy(along, column)
    steep -= mahalanobis(root, column)
    solve_root(root, along)
    copy(down, column)
    fall = mahalanobis(root, column)
    chi -= fall
    solve_root(root, down)
    s[i], misfits[i] = x[0], chi
    across = np.empty((3, 3))
    for a in range(3):
        copy(t[3 + a], whole[a])
        points[i, a] = value[3 + a]
        for c in range(3):
            points[i, a] += t[3 + a, 1 + c] * down[c]
            across[a, c] = t[3 + a, 1 + c]
        mahalanobis(root, across[a])
    for a in range(3):
        for c in range(3):
            spreads[i, a, c] = 0.0
            for m in range(3):
                spreads[i, a, c] += across[a, m] * across[c, m]
    side = math.hypot(x[2], x[3])
    size = side * side + x[1] * x[1]
    whole[3, 1] = side / size
    whole[3, 2], whole[3, 3] = -x[1] * x[2] / (side * size), -x[1] * x[3] / (side * size)
    logs[i, 1] = -0.5 * chi - math.log(root[0, 0] * root[1, 1] * root[2, 2])
    logs[i, 0] = logs[i, 1] + math.log(abs(solve(whole, np.zeros(4))) + 1e-300)
    for a in range(3):
        x[1 + a] += down[a]
    angle = math.atan2(x[1], math.hypot(x[2], x[3])) / LIKELY_FRICTION
    logs[i, 2] = logs[i, 0] - 0.5 * angle * angle
    return 1.0 / steep if steep > 0.0 else np.inf, fall


@inlined
def _ahead(x: Array, along: Array, step: float, least: float, to: Array) -> None:
    """Fill the contact one step farther along a valley, which is nearly straight in s and s f."""
    ds = min(max(x[0] + step, least), 1.0) - x[0]
    moment, change = 0.0, 0.0
    for a in range(3):
        moment += (x[0] * x[1 + a]) ** 2
        change += (ds * (x[1 + a] + x[0] * along[a])) ** 2
    share = min(1.0, _LARGEST_CHANGE * math.sqrt(moment / max(change, 1e-300)))
    to[0] = x[0] + ds
    for a in range(3):
        by = share * ds * (x[1 + a] + x[0] * along[a])
        to[1 + a] = (x[0] * x[1 + a] + by) / to[0]


@inlined
def pace(rise: float) -> float:
    """Factor of the next step's length after a step on which χ² rose by ``rise``."""
    for most, factor in _PACE:
        if rise < most:
            return factor
    return 1.0


@inlined
def _followed(
    rod: Rod,
    b: Array,
    least: float,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    value: Array,
    tangents: Array,
    nodes: Nodes,
) -> tuple[int, int]:
    """Fill the nodes of a valley, the contact in the middle; return the range of their indices."""
    misfits = nodes[1]
    at, to, along = np.empty((2, 4)), np.empty((2, 4)), np.empty((2, 3))
    third, t, v, known = np.empty((6, 3)), np.zeros((6, 4)), np.empty(6), np.empty(3)
    steps, active, number = np.empty(2), np.ones(2, np.bool_), np.zeros(2, np.int64)
    refused = np.zeros(2, np.int64)
    copy(x, at[0])
    variance, _ = _node(at[0], value, tangents, codes, target, weights, nodes, _STEPS, along[0])
    if variance < 0.0:
        return 0, 0
    copy(at[0], at[1])
    copy(along[0], along[1])
    steps[0] = min(max(_FIRST * math.sqrt(variance), _SHORTEST), _LONGEST)
    steps[1] = -steps[0]
    for _ in range(_TRIED):
        for way in range(2):
            active[way] = active[way] and (at[way, 0] < 1.0 if way == 0 else at[way, 0] > least)
            active[way] = active[way] and number[way] < _STEPS
            _ahead(at[way], along[way], steps[way], least, to[way])
            c = to[way] if active[way] else x
            for lane in range(2 * way, 2 * way + 2):
                set_lane(b, lane, c[0], c[1], c[2], c[3], lane % 2 == 1)
        if not (active[0] or active[1]):
            break
        integrate(rod, b, 3)
        for way in range(2):
            if not active[way]:
                continue
            i = _STEPS + (1 - 2 * way) * (number[way] + 1)
            before = misfits[_STEPS + (1 - 2 * way) * number[way]]
            lane_contact(b, 2 * way, True, v, t, third)
            copy(along[way], known)
            left, fall = _node(to[way], v, t, codes, target, weights, nodes, i, along[way])
            rise = misfits[i] - before
            far = rise > _MOST_RISE or fall > _MOST_FALL
            if far and refused[way] <= _REFUSED and before < misfits[_STEPS] + CLOSED:
                refused[way] += 1
                by = _SHORTER if refused[way] <= _REFUSED else _SHORTER**-_REFUSED
                steps[way] = by * (to[way, 0] - at[way, 0])
                copy(known, along[way])
                continue
            refused[way] = 0
            if left < 0.0:
                active[way] = False
                continue
            number[way] += 1
            copy(to[way], at[way])
            active[way] = misfits[i] < misfits[_STEPS] + HIGH
            steps[way] *= min(pace(rise), (0.5 * _MOST_FALL / max(fall, 1e-300)) ** 0.25)
    return _STEPS - number[1], _STEPS + number[0] + 1


@inlined
def shares_of(nodes: Nodes, first: int, last: int, shares: Array) -> None:
    """Fill the probabilities of nodes."""
    s, logs = nodes[0], nodes[2]
    middle = s.shape[0] // 2
    mass = np.zeros(2)
    for d in range(2):
        for i in range(first, last):
            low, high = s[max(i - 1, first)], s[min(i + 1, last - 1)]
            mass[d] += 0.5 * (high - low) * math.exp(logs[i, d] - logs[middle, d])
    for i in range(first, last):
        step, shares[i] = 0.5 * (s[min(i + 1, last - 1)] - s[max(i - 1, first)]), 0.0
        for d in range(2):
            shares[i] += 0.5 * step * math.exp(logs[i, d] - logs[middle, d]) / mass[d]


@inlined
def _weight(nodes: Nodes, first: int, last: int) -> float:
    """Log integral of the density with the prior of friction."""
    s, logs, mass = nodes[0], nodes[2], 0.0
    middle = s.shape[0] // 2
    for i in range(first, last):
        step = 0.5 * (s[min(i + 1, last - 1)] - s[max(i - 1, first)])
        mass += step * math.exp(logs[i, 2] - logs[middle, 0])
    return float(math.log(mass + 1e-300) + logs[middle, 0])


@inlined
def _beyond(cumulants: Array, shares: Array, first: int, last: int, square: float) -> float:
    """Probability of a mixture beyond a squared distance; see the module."""
    total = 0.0
    for i in range(first, last):
        mean, spread, skew = cumulants[i]
        degrees = spread**3 / skew**2
        size = max(1.0 + (square - mean) / math.sqrt(spread * degrees), 0.0)
        away = size ** (1.0 / 3.0) - 1.0 + 2.0 / (9.0 * degrees)
        total += 0.5 * shares[i] * math.erfc(1.5 * math.sqrt(degrees) * away)
    return total


@inlined
def mixture(
    nodes: Nodes, first: int, last: int, shares: Array, point: Array, covariance: Array
) -> bool:
    """Fill the widened second moment of a mixture about a point; whether it is valid."""
    points, spreads = nodes[3], nodes[4]
    root, y, z, cumulants = np.zeros((3, 3)), np.empty(3), np.empty((3, 3)), np.empty_like(points)
    covariance[:] = 0.0
    for i in range(first, last):
        for a in range(3):
            for c in range(3):
                away = (points[i, a] - point[a]) * (points[i, c] - point[c])
                covariance[a, c] += shares[i] * (spreads[i, a, c] + away)
    if not cholesky(covariance, root):
        return False
    for i in range(first, last):
        for a in range(3):
            y[a] = points[i, a] - point[a]
            copy(spreads[i, a], z[a])
            mahalanobis(root, z[a])
        mean, spread, skew = mahalanobis(root, y), 0.0, 0.0
        for c in range(3):
            column = z[:, c].copy()
            mahalanobis(root, column)
            for a in range(3):
                z[a, c] = column[a]
        for a in range(3):
            z[a, a] += _NOTHING
            mean += z[a, a]
        for a in range(3):
            moved = 0.0
            for c in range(3):
                moved += z[a, c] * y[c]
                square = z[a, 0] * z[0, c] + z[a, 1] * z[1, c] + z[a, 2] * z[2, c]
                spread += z[a, c] * z[a, c]
                skew += z[a, c] * square
            spread += 2.0 * y[a] * moved
            skew += 3.0 * moved * moved
        cumulants[i, 0], cumulants[i, 1], cumulants[i, 2] = mean, spread, skew
    wider, most = 1.0, _WIDEST
    if _beyond(cumulants, shares, first, last, THREE_SIGMA) > LEFT:
        for _ in range(_BISECTIONS):
            middle = math.sqrt(wider * most)
            if _beyond(cumulants, shares, first, last, middle * THREE_SIGMA) > LEFT:
                wider = middle
            else:
                most = middle
        wider = most
    covariance *= wider
    held = 1.0 - _beyond(cumulants, shares, first, last, wider * HELD)
    return _LEAST_HELD < held < _MOST_HELD and wider < _MOST_WIDENED


@kernel
def _valley_rows(
    rod: Rod,
    least: float,
    codes: IntArray,
    targets: Array,
    weights: Array,
    contacts: Array,
    values: Array,
    tangents: Array,
    out: Valleys,
    first: int,
    last: int,
) -> None:
    most = 2 * _STEPS + 1
    b, shares = np.zeros(BUFFER_SIZE), np.empty(most)
    nodes = (
        np.empty(most),
        np.empty(most),
        np.empty((most, 3)),
        np.empty((most, 3)),
        np.empty((most, 3, 3)),
    )
    covariances, weight, valid = out
    for row in range(first, last):
        begin, end = _followed(
            rod,
            b,
            least,
            codes,
            targets[row],
            weights[row],
            contacts[row],
            values[row],
            tangents[row],
            nodes,
        )
        if end - begin < 2:
            continue
        weight[row] = _weight(nodes, begin, end)
        shares_of(nodes, begin, end, shares)
        fair = mixture(nodes, begin, end, shares, values[row, 3:], covariances[row])
        enough = nodes[1][_STEPS] + CLOSED
        closed = nodes[1][begin] > enough and nodes[1][end - 1] > enough
        valid[row] = closed and fair


def valleys(
    discretization: Discretization,
    names: tuple[str, ...],
    targets: Array,
    weights: Array,
    contacts: Array,
    values: Array,
    tangents: Array,
    least: float,
) -> Valleys:
    """Follow the valleys of contacts with friction that explain measured channels.

    Weights of the channels, contacts x (n, 4), (F, p) and their derivatives with respect to x are
    those of fits; no contact is proximal to ``least``.
    """
    n, rod = len(contacts), discretization.rod
    out = Valleys.room(n)
    codes = np.array([FITTED.index(name) for name in names])
    targets, weights = np.ascontiguousarray(targets), np.ascontiguousarray(weights)
    share_out(
        n,
        partial(_valley_rows, rod, least, codes, targets, weights, contacts, values, tangents, out),
    )
    return out
