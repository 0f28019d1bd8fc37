"""Posterior covariance of a contact point, its validity, and the weight of a candidate.

A contact ξ explains measured channels with residuals r(u) = r̂ + B u + H_r(u, u)/2 in standard
deviations, where u are coordinates about a candidate along bent axes that are one standard
deviation long; its contact point is p(u) = p̂ + A u + H_p(u, u)/2
(:mod:`~vibrissa.contacts.uncertainty.expansion`).

The prior is uniform over the contact points of Ω, so the posterior density of u is
exp(-|r(u)|²/2) det ∂p/∂u within Ω and zero outside: beyond the tip, proximal to the limit, and
beyond the fold, where the determinant changes sign. It is integrated over nodes on rays, along
axes that are shortened where Ω, or a fold of the signals in second order, ends the density
sooner. Near slip-off the volumes nearly vanish although contacts occur there, so the covariance is
that of the mean of this density and of the one without volumes.

To first order the covariance of p is A Aᵀ. Near a fold of p this degenerates to a sheet, from which
contacts curve away; the second moment about p̂ does not. But where the sheet is bent, an ellipsoid
with the axes of the second moment contains distant contacts only if it is so large that it contains
98 % instead of 95 % of all. So contacts are weighted by their squared distance in the metric of the
second moment, E[d² (p - p̂)(p - p̂)ᵀ], which for normal distributions is that up to a factor. This
covariance is widened until the ellipsoid of three standard deviations contains the share that it
states: on each ray the position of the ellipsoid's surface and the probability beyond it are known.
A covariance is valid if the 95 % ellipsoid then contains about 95 %, and if the channels at both
ends of each axis agree with the second order.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import LEFT, THREE_SIGMA
from vibrissa.contacts.uncertainty.expansion import (
    Expansion,
    all_determined,
    cap_axes,
    empty_expansion,
    expand,
    first_order_covariance,
    missed_at_ends,
    principal_axes,
    second_order_size,
    shorten_axes,
    without_friction,
)
from vibrissa.numerics import Array, IntArray, cholesky, copy, inlined, kernel, quick_exp, solve
from vibrissa.rod import BUFFER_SIZE, Charted

#: Posterior probability above which a candidate is unique.
CERTAIN = 0.95
# Limits of a valid covariance: share in ellipsoids of 95 %; factor by which variances were widened;
# error of the second order, in standard deviations of the channels. Where variances are widened by
# more than the fourth number, distant contacts matter, of which the second order shows less.
_LEAST_HELD, _MOST_HELD, _MOST_WIDENED, _WIDENED = 0.93, 0.975, 2.5, 1.3
_MISSED, _MISSED_FAR = 0.1, 0.03
#: Squared radius of regions of 95 %.
HELD = 7.815
# Error of the second order above which a candidate is weighed to first order; and the most by which
# a node's log density may exceed that of the first order.
_BROKEN, _MOST_GAIN = 0.3, 3.0
TOO_FEW = 0.2  # smallest share of the nodes from which moments are meaningful
# Number of steps by which a covariance is widened; and a negligible probability.
_TRIALS, _NOTHING = 4, 1e-12
# Second order, of the point or the channels for one standard deviation along each axis, below which
# the first order suffices: variances differ by less than 4 %.
STRAIGHT = 0.06
# Second order below which its error is negligible (at most 0.01). Interpolated errors are
# themselves uncertain by a few hundredths: between these shares of the limit the rod is integrated.
_NEARLY_STRAIGHT, _SURE, _DOUBTFUL = 0.03, 0.6, 0.4
_RADII = 5  # nodes on each ray, one standard deviation apart


def _within(radius: float) -> tuple[float, float]:
    """Probability within a radius of standard normal distributions in three and five dimensions."""
    density = math.sqrt(2.0 / math.pi) * math.exp(-0.5 * radius**2)
    three = math.erf(radius / math.sqrt(2.0)) - radius * density
    return three, three - radius**3 * density / 3.0


def _along_rays() -> tuple[Array, Array, Array, Array]:
    """Nodes ±u on rays: u (3, n / 2), their weights, weights of the rays, and probability beyond.

    Rays are the axes and diagonals of a cube, with weights that integrate polynomials of degree 5
    over the sphere exactly. Along each, moments of a normal distribution are exact to the second.
    The last array is the probability beyond each radius, from zero on.
    """
    corners = np.array(list(product([1.0], [-1.0, 1.0], [-1.0, 1.0])))
    rays = np.concatenate([np.eye(3), corners / math.sqrt(3.0)])
    share = np.repeat([1.0 / 15.0, 3.0 / 40.0], [3, 4])
    square = np.arange(_RADII + 1.0) ** 2
    inner = np.array([_within(radius) for radius in range(_RADII)])
    below = np.append(inner, [[1.0, 1.0]], axis=0).T
    mass, moment = np.diff(below) * [[1.0], [3.0]]
    outer = (moment - square[:-1] * mass) / np.diff(square)
    by_radius = outer + np.append((mass - outer)[1:], 0.0)
    nodes = rays.T[:, :, None] * np.arange(1.0, _RADII + 1.0)
    beyond = 1.0 - np.array([_within(radius)[0] for radius in range(_RADII + 1)])
    weights = np.outer(share, by_radius)
    return np.ascontiguousarray(nodes.reshape(3, -1)), weights.reshape(-1), share, beyond


NODES, WEIGHTS, _SHARES, _BEYOND = _along_rays()


class Rays(NamedTuple):
    """Working memory for the nodes ±u.

    Displacements of the point (3, 2 m); densities (2 m,), with volumes and without; ∂p/∂u (3, 3,
    2 m), arc length, log density and squared distance; odd and even parts in u, and second
    derivatives, (m,); a Cholesky factor; logs of the probability beyond each node of a ray.
    """

    points: Array
    density: Array
    likely: Array
    slopes: Array
    arc: Array
    log: Array
    far: Array
    odd: Array
    even: Array
    bent: Array
    root: Array
    logs: Array


@inlined
def empty_rays() -> Rays:
    """Allocate the working memory."""
    half, pairs = NODES.shape[1], _SHARES.shape[0]
    return Rays(
        np.empty((3, 2 * half)),
        np.empty(2 * half),
        np.empty(2 * half),
        np.empty((3, 3, 2 * half)),
        np.empty(2 * half),
        np.empty(2 * half),
        np.empty(2 * half),
        np.empty(half),
        np.empty(half),
        np.empty(half),
        np.zeros((3, 3)),
        np.empty((2 * pairs, 1 + _RADII)),
    )


@inlined
def densities(model: Expansion, s: float, proximal: float, turn: float, rays: Rays) -> None:
    """Fill posterior densities at nodes ±u relative to the nodes' own, and contact points (3, 2 m).

    Parts that are odd or even in u are computed once for both signs. ``likely`` is the density
    without volumes, ``points`` are displacements of the contact point; ``turn`` is 1 for
    right-handed axes, -1 otherwise.
    """
    r0, by_r, bent_r, by_p, bent_p = model.r0, model.by_r, model.bent_r, model.by_p, model.bent_p
    axes, bent_s = model.axes, model.bent_s
    nodes, half = NODES, NODES.shape[1]
    points, density, likely, slopes, arc, log, _, odd, even, bent, _, _ = rays
    log[:], odd[:], even[:] = 0.0, 0.0, s
    for i in range(3):
        _change_of_slope(bent_s[i], nodes, bent)
        along, u = axes[0, i], nodes[i]
        for m in range(half):
            odd[m] += along * u[m]
            even[m] += 0.5 * bent[m] * u[m]
            log[m] += 0.5 * u[m] * u[m]
    for m in range(half):
        arc[m], arc[half + m], log[half + m] = even[m] + odd[m], even[m] - odd[m], log[m]
    for a in range(r0.shape[0]):
        here = r0[a]
        odd[:], even[:] = 0.0, here
        for i in range(3):
            _change_of_slope(bent_r[a, i], nodes, bent)
            first, u = by_r[a, i], nodes[i]
            for m in range(half):
                odd[m] += first * u[m]
                even[m] += 0.5 * bent[m] * u[m]
        for m in range(half):
            up, down = even[m] + odd[m], even[m] - odd[m]
            log[m] -= 0.5 * (up * up - here * here)
            log[half + m] -= 0.5 * (down * down - here * here)
    for a in range(3):
        odd[:], even[:] = 0.0, 0.0
        for i in range(3):
            _change_of_slope(bent_p[a, i], nodes, bent)
            first, u, slope = by_p[a, i], nodes[i], slopes[a, i]
            for m in range(half):
                slope[m], slope[half + m] = first + bent[m], first - bent[m]
                odd[m] += first * u[m]
                even[m] += 0.5 * bent[m] * u[m]
        for m in range(half):
            points[a, m], points[a, half + m] = even[m] + odd[m], even[m] - odd[m]
    a, b, c = slopes[0], slopes[1], slopes[2]
    for m in range(2 * half):
        det = turn * (
            a[0, m] * (b[1, m] * c[2, m] - b[2, m] * c[1, m])
            + a[1, m] * (b[2, m] * c[0, m] - b[0, m] * c[2, m])
            + a[2, m] * (b[0, m] * c[1, m] - b[1, m] * c[0, m])
        )
        inside = (arc[m] >= proximal) & (arc[m] <= 1.0) & (det > 0.0)
        likely[m] = quick_exp(min(log[m], _MOST_GAIN)) if inside else 0.0
        density[m] = det * likely[m]


@inlined
def _change_of_slope(bent: Array, nodes: Array, out: Array) -> None:
    """Fill the change of a slope at all nodes due to second derivatives (n,)."""
    out[:] = 0.0
    for q in range(nodes.shape[0]):
        change, u = bent[q], nodes[q]
        for m in range(out.shape[0]):
            out[m] += change * u[m]


@inlined
def squared_distances(root: Array, points: Array, out: Array) -> None:
    """Fill squared Mahalanobis distances (n,) of points (3, n), for the root of a covariance."""
    r00, r11, r22 = 1.0 / root[0, 0], 1.0 / root[1, 1], 1.0 / root[2, 2]
    r10, r20, r21 = root[1, 0], root[2, 0], root[2, 1]
    x, y, z = points[0], points[1], points[2]
    for k in range(out.shape[0]):
        a = r00 * x[k]
        b = r11 * (y[k] - r10 * a)
        c = r22 * (z[k] - r20 * a - r21 * b)
        out[k] = a * a + b * b + c * c


@inlined
def second_moment(points: Array, density: Array, total: float, covariance: Array) -> None:
    """Fill the second moment (3, 3) of points (3, n) with a density."""
    for a in range(3):
        for c in range(a + 1):
            covariance[a, c] = 0.0
            for k in range(points.shape[1]):
                covariance[a, c] += density[k] * points[a, k] * points[c, k]
            covariance[a, c] /= total
            covariance[c, a] = covariance[a, c]


@inlined
def _reaches(far: Array, density: Array, centre: float, logs: Array) -> None:
    """Make squared distances (rays, radii) monotonic; fill ``logs`` of the probability beyond."""
    last = far.shape[1]
    for ray in range(far.shape[0]):
        left = _BEYOND[last] * density[ray, last - 1]
        logs[ray, last] = math.log(left + _NOTHING)
        for k in range(last - 1, -1, -1):
            here = density[ray, k - 1] if k > 0 else centre
            left += 0.5 * (_BEYOND[k] - _BEYOND[k + 1]) * (here + density[ray, k])
            logs[ray, k] = math.log(left + _NOTHING)
        for k in range(1, last):
            far[ray, k] = max(far[ray, k], far[ray, k - 1])


@inlined
def _outside(far: Array, logs: Array, square: float) -> tuple[float, float]:
    """Probability beyond a squared distance, summed over pairs of rays, and its derivative."""
    total, slope, pairs = 0.0, 0.0, _SHARES.shape[0]
    for ray in range(far.shape[0]):
        k, last = 0, far.shape[1] - 1
        while k < last and far[ray, k] < square:
            k += 1
        near = far[ray, k - 1] if k > 0 else 0.0
        falls = (logs[ray, k + 1] - logs[ray, k]) / max(far[ray, k] - near, _NOTHING)
        falls = min(falls, 0.0)
        away = min(square - near, 2.0 * (far[ray, k] - near))
        left = _SHARES[ray % pairs] * quick_exp(logs[ray, k] + falls * away)
        total += left
        slope += left * falls
    return total, slope


@inlined
def _fitting(far: Array, logs: Array) -> tuple[float, float]:
    """Factor for the 3σ ellipsoid to contain its nominal share, and share in the 95 % one."""
    whole, _ = _outside(far, logs, 0.0)
    square = THREE_SIGMA
    for _ in range(_TRIALS):
        left, slope = _outside(far, logs, square)
        step = math.log(max(left / whole, _NOTHING) / LEFT) * left / min(slope, -_NOTHING)
        square = min(max(square - step, 0.5 * square), 2.0 * square)
    wider = max(square / THREE_SIGMA, 1.0)
    left, _ = _outside(far, logs, wider * HELD)
    return wider, 1.0 - left / whole


@inlined
def _moments(
    model: Expansion,
    s: float,
    proximal: float,
    turn: float,
    first_order: float,
    missed: float,
    covariance: Array,
    rays: Rays,
) -> tuple[float, bool]:
    """Fill the widened covariance; mean density, and whether the covariance is valid."""
    half, pairs = NODES.shape[1], _SHARES.shape[0]
    points, density, likely, root, far, logs = (
        rays.points,
        rays.density,
        rays.likely,
        rays.root,
        rays.far,
        rays.logs,
    )
    densities(model, s, proximal, turn, rays)
    middle = 1.0
    for m in range(half):
        middle -= 2.0 * WEIGHTS[m]
    mean, fits = middle * first_order, middle
    for m in range(2 * half):
        mean += WEIGHTS[m % half] * density[m]
        fits += WEIGHTS[m % half] * likely[m]
    if not mean < np.inf:  # contacts two standard deviations away are not in equilibrium
        return first_order, False
    centre = 0.5 * (1.0 / fits + first_order / mean)
    squares = middle * centre * centre
    for m in range(2 * half):
        likely[m] = 0.5 * (likely[m] / fits + density[m] / mean)
        density[m] = WEIGHTS[m % half] * likely[m]
        squares += density[m] * likely[m]
    if not squares * TOO_FEW < 1.0:
        # Too few of the nodes are in Ω: their moment is added to that of the first order.
        for a in range(3):
            for c in range(3):
                for m in range(2 * half):
                    covariance[a, c] += density[m] * points[a, m] * points[c, m]
        return mean, False
    second_moment(points, density, 1.0, covariance)
    if not cholesky(covariance, root):
        return mean, False
    squared_distances(root, points, far)
    if missed < _MISSED:
        total = 0.0
        for m in range(2 * half):
            density[m] *= far[m]
            total += density[m] * far[m]
        second_moment(points, density, total / 3.0, covariance)
        if not cholesky(covariance, root):
            return mean, False
        squared_distances(root, points, far)
    reach = far.reshape(2 * pairs, _RADII)
    _reaches(reach, likely.reshape(2 * pairs, _RADII), centre, logs)
    wider, held = _fitting(reach, logs)
    for a in range(3):
        for c in range(3):
            covariance[a, c] *= wider
    fair = _LEAST_HELD < held < _MOST_HELD and wider < _MOST_WIDENED
    return mean, fair and missed < (_MISSED if wider < _WIDENED else _MISSED_FAR)


@inlined
def _second_order(
    rod: Charted,
    b: Array,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    slopes: Array,
    j: Array,
    model: Expansion,
) -> tuple[float, float, bool]:
    """Fill the model; size of its second order, its error, and whether axes are shortened.

    Where interpolation between the map's nodes leaves no doubt, it is used. The size is NaN if the
    channels do not determine an unknown.
    """
    capped, bent, missed, short = cap_axes(x, model.axes), np.inf, np.inf, False
    for attempt in range(2):
        near = expand(rod, b, attempt == 0, codes, target, weights, x, slopes, j, model)
        if not all_determined(model):
            return np.nan, np.inf, False
        bent = second_order_size(model)
        short = shorten_axes(model) or capped
        missed = 0.0
        if not near or bent > _NEARLY_STRAIGHT:
            missed = missed_at_ends(rod, b, near, codes, target, weights, x, slopes, j, model)
        if not (near and _SURE * _MISSED < missed < _DOUBTFUL):
            break
        principal_axes(x, j, model.axes)
        cap_axes(x, model.axes)
    return bent, missed, short


class JudgeRoom(NamedTuple):
    """Working memory of `judge`.

    The rod's buffer, slopes of residuals (k, 3) and of the point (3, 3), zeros (3,), the expansion
    and the nodes.
    """

    buffer: Array
    j: Array
    slopes: Array
    nothing: Array
    model: Expansion
    rays: Rays


@inlined
def judge_room(k: int) -> JudgeRoom:
    """Allocate the working memory for k channels, once for many measurements."""
    return JudgeRoom(
        np.zeros(BUFFER_SIZE),
        np.empty((k, 3)),
        np.empty((3, 3)),
        np.zeros(3),
        empty_expansion(k),
        empty_rays(),
    )


@kernel
def judge(
    rod: Charted,
    proximal: float,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    tangents: Array,
    residuals: Array,
    jacobian: Array,
    covariance: Array,
    room: JudgeRoom,
) -> tuple[float, bool, bool]:
    """Judge a candidate of a measurement; see the module.

    Weights, x (4,), ∂(F, p)/∂ξ (6, 3), residuals and their slopes with respect to x (k, 4) are the
    candidate's. Fill the covariance of its contact point; return its log weight, whether the
    covariance is valid, and whether the second order describes the channels.
    """
    b, j, slopes, nothing, model, rays = room
    for a in range(3):
        for c in range(3):
            covariance[a, c] = np.nan
    without_friction(jacobian, j)
    if not principal_axes(x, j, model.axes):
        return -np.inf, False, False
    copy(residuals, model.r0)
    for a in range(3):
        copy(tangents[3 + a], slopes[a])
    bent, missed, short = _second_order(rod, b, codes, target, weights, x, slopes, j, model)
    if bent != bent:
        return -np.inf, False, False
    misfit, pulled, away = 0.0, 0.0, 0.0
    for a in range(codes.shape[0]):
        misfit += model.r0[a] * model.r0[a]
    first_order_covariance(model.by_p, covariance)
    for i in range(3):
        away += model.axes[0, i] ** 2
        pull = 0.0
        for a in range(codes.shape[0]):
            pull += model.r0[a] * model.by_r[a, i]
        pulled = max(pulled, abs(pull))
    away = 4.0 * math.sqrt(away)
    for a in range(3):
        copy(model.by_p[a], slopes[a])
    first_order, density, fair = abs(solve(slopes, nothing)), 0.0, True
    straight = proximal + away < x[0] < 1.0 - away and not short
    straight = straight and bent < STRAIGHT and pulled < STRAIGHT
    if not straight:
        for a in range(3):
            copy(model.axes[a], slopes[a])
        turn = math.copysign(1.0, solve(slopes, nothing))
        density, fair = _moments(model, x[0], proximal, turn, first_order, missed, covariance, rays)
    if straight or (missed > _BROKEN and first_order > 0.0 and not short):
        density = first_order
    weight = math.log(density) - 0.5 * misfit if density > 0.0 else -np.inf
    return weight, missed < _MISSED and fair, missed < _MISSED


@kernel
def rank(weight: Array, number: IntArray, probability: Array, order: IntArray) -> None:
    """Posterior probabilities of candidates, and their order by falling probability."""
    for row in range(number.shape[0]):
        n, log = number[row], weight[row]
        for i in range(order.shape[1]):
            order[row, i], probability[row, i] = i, np.nan
        for i in range(1, n):  # a stable sort: candidates of equal weight remain ordered by force
            place = i
            while place > 0 and log[order[row, place - 1]] < log[i]:
                order[row, place] = order[row, place - 1]
                place -= 1
            order[row, place] = i
        total = 0.0
        for i in range(n):
            away = log[order[row, i]] - log[order[row, 0]]
            probability[row, i] = math.exp(away) if away <= 0.0 else 1.0
            total += probability[row, i]
        for i in range(n):
            probability[row, i] /= total


def ranked(weight: Array, number: IntArray) -> tuple[Array, IntArray]:
    """Probabilities (rows, most) of candidates, and their order; see :func:`rank`."""
    probability, order = np.empty(weight.shape), np.empty(weight.shape, np.int64)
    rank(weight, number, probability, order)
    return probability, order
