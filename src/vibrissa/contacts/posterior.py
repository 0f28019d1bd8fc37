"""What noise leaves open about a contact: covariance, its validity, and what a candidate weighs.

A contact ξ explains measured channels with residuals r = W (c(ξ) - c̃), in standard deviations.
About a candidate these and the contact point p are followed to second order along the principal
axes a_i of the noise seen in ξ:

    ξ = ξ̂ + Σ a_i u_i,    r(u) = r̂ + B u + H_r(u, u)/2,    p(u) = p̂ + A u + H_p(u, u)/2.

Contact points of Ω are equally probable beforehand, so that the posterior density of u is
exp(-|r(u)|²/2) det ∂p/∂u within Ω and zero outside: beyond the tip, before the proximal limit, and
beyond the fold, where the determinant changes its sign. It is summed over nodes on rays, along axes
that are shortened where Ω or the second order ends the density sooner, as at folds of the signals.
The volumes nearly vanish near slip-off, where a whisker may yet be: for the covariance the mean of
this density and of that without volumes counts.

To first order the covariance of p is A Aᵀ; near a fold of p that is a sheet that contacts leave,
and the second moment about p̂ is not. It is widened until the ellipsoid of three standard deviations
holds what it states: along each ray it is known where the ellipsoid ends, and how much probability
is beyond. A covariance is valid where the ellipsoid of 95 % then holds about that too, and where
the channels at both ends of each axis are those of the second order.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import gammainc

from vibrissa.contacts.least_squares import channel_equations, lane_contact, whiten
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    cholesky,
    copy,
    inlined,
    kernel,
    mahalanobis,
    quick_exp,
    solve,
)
from vibrissa.rod import BUFFER_SIZE, LANES, LEAST_ARC, Rod, integrate, lane_value, set_lane

#: A candidate more probable than this is the only one.
CERTAIN = 0.95
# How far along each axis the second order is taken from, and the other end is tried if there is
# room for the least, in standard deviations.
_REACH, _OTHER_END, _LEAST_END = 2.0, 3.0, 1.0
# Where a covariance can be relied on: what the second order misses at most there, in standard
# deviations of the channels; what ellipsoids of 95 % hold; and how much variances were widened.
_MISSED, _LEAST_HELD, _MOST_HELD, _MOST_WIDENED = 0.06, 0.93, 0.98, 1.7
# What is left outside three standard deviations, and the squares of these and of the 95 % region.
_LEFT, _THREE_SIGMA, _HELD = 0.0033, 14.156, 7.815
# Where the second order misses so much, densities are not to be trusted: the first order gives the
# weight of a candidate. A node's log density gains at most so much over the first order's.
_BROKEN, _MOST_GAIN = 0.3, 3.0
# With a smaller share of the nodes than this moments mean nothing.
_TOO_FEW = 0.2
# Steps by which a covariance is widened; and what is nothing among probabilities.
_TRIALS, _NOTHING = 4, 1e-12
# Below this second order (of the point, or the channels, for a standard deviation of each axis) the
# first will do: variances differ by less than 4 %.
_STRAIGHT = 0.06
# The longest axis, of s (and relative to the force, 1); and the largest second derivative of -log
# density along an axis, where its length is not changed: for a normal distribution it is 1.
_LONGEST, _SHARP = 0.25, 2.0
# Unknowns that a measurement determines this much worse than others it does not determine.
_OPEN = 1e-10
_SWEEPS = 12
# Nodes on each ray, a standard deviation apart.
_RADII = 5
#: Fourth moment of three coordinates that are normally distributed.
NORMAL_KURTOSIS = 15.0


def _along_rays() -> tuple[Array, Array, Array, Array]:
    """Nodes ±u on rays, of which u (3, n / 2); their weights, those of rays, and what is beyond.

    The axes and diagonals of a cube, weighted so that they integrate polynomials of degree 5 over
    the sphere; along each the moments of a normal distribution to the second, by radius, and the
    probability beyond each radius from zero on.
    """
    corners = np.array(list(product([1.0], [-1.0, 1.0], [-1.0, 1.0])))
    rays = np.concatenate([np.eye(3), corners / math.sqrt(3.0)])
    share = np.repeat([1.0 / 15.0, 3.0 / 40.0], [3, 4])
    square = np.arange(_RADII + 1.0) ** 2
    below = gammainc([[1.5], [2.5]], 0.5 * np.append(square[:-1], np.inf))
    mass, moment = np.diff(below) * [[1.0], [3.0]]
    outer = (moment - square[:-1] * mass) / np.diff(square)
    by_radius = outer + np.append((mass - outer)[1:], 0.0)
    nodes = rays.T[:, :, None] * np.arange(1.0, _RADII + 1.0)
    beyond = np.asarray(1.0 - gammainc(1.5, 0.5 * square))
    weights = np.outer(share, by_radius)
    return np.ascontiguousarray(nodes.reshape(3, -1)), weights.reshape(-1), share, beyond


_NODES, _WEIGHTS, _SHARES, _BEYOND = _along_rays()


class _Model(NamedTuple):
    """Working memory for one candidate: r̂ (k), B (k, 3), H_r (k, 3, 3); A, H_p; axes in columns."""

    r0: Array
    by_r: Array
    bent_r: Array
    by_p: Array
    bent_p: Array
    axes: Array


@inlined
def _principal(j: Array, axes: Array) -> bool:
    """Fill principal axes of the noise in ξ, one standard deviation long; whether there are all.

    One-sided Jacobi rotations make the columns of W ∂c/∂ξ, brought to length one, orthogonal.
    """
    k = j.shape[0]
    c, size = np.empty((k, 3)), np.empty(3)
    for p in range(3):
        total = 0.0
        for i in range(k):
            total += j[i, p] ** 2
        size[p] = math.sqrt(total)
        if not 0.0 < size[p] < np.inf:
            return False
        for i in range(3):
            axes[i, p] = 1.0 / size[p] if i == p else 0.0
        for i in range(k):
            c[i, p] = j[i, p] / size[p]
    for _ in range(_SWEEPS):
        largest = 0.0
        for p in range(2):
            for q in range(p + 1, 3):
                pp, qq, pq = 0.0, 0.0, 0.0
                for i in range(k):
                    pp += c[i, p] * c[i, p]
                    qq += c[i, q] * c[i, q]
                    pq += c[i, p] * c[i, q]
                if abs(pq) <= 1e-15 * math.sqrt(pp * qq):
                    continue
                largest = max(largest, abs(pq) / math.sqrt(pp * qq))
                zeta = (qq - pp) / (2.0 * pq)
                tan = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                cos = 1.0 / math.sqrt(1.0 + tan * tan)
                sin = cos * tan
                for i in range(k):
                    a, b = c[i, p], c[i, q]
                    c[i, p], c[i, q] = cos * a - sin * b, sin * a + cos * b
                for i in range(3):
                    a, b = axes[i, p], axes[i, q]
                    axes[i, p], axes[i, q] = cos * a - sin * b, sin * a + cos * b
        if largest < 1e-9:
            break
    known = True
    for p in range(3):  # longest first: rounding must not choose the axes' order either
        for q in range(p + 1, 3):
            pp, qq = 0.0, 0.0
            for i in range(k):
                pp += c[i, p] * c[i, p]
                qq += c[i, q] * c[i, q]
            if qq < pp:
                for i in range(k):
                    c[i, p], c[i, q] = c[i, q], c[i, p]
                for i in range(3):
                    axes[i, p], axes[i, q] = axes[i, q], axes[i, p]
        total = 0.0
        for i in range(k):
            total += c[i, p] * c[i, p]
        length = math.sqrt(total)
        known = known and length > _OPEN
        largest, best = -1.0, 0
        for i in range(3):  # rounding must not choose an axis's sign either
            share = abs(axes[i, p]) * size[i]
            if share > 1.001 * largest:
                largest, best = share, i
        scale = math.copysign(1.0 / max(length, _OPEN), axes[best, p])
        for i in range(3):
            axes[i, p] *= scale
    return known


@inlined
def _capped(x: Array, axes: Array) -> bool:
    """Shorten axes that leave the whisker, as where signals fold; whether any did."""
    force, capped = max(math.hypot(x[2], x[3]), 1e-300), False
    for i in range(3):
        size = max(abs(axes[0, i]) / _LONGEST, math.hypot(axes[1, i], axes[2, i]) / force)
        if size > 1.0:
            capped = True
            for a in range(3):
                axes[a, i] /= size
    return capped


@inlined
def _shortened(model: _Model) -> bool:
    """Shorten axes along which the second order ends the density sooner; whether there are any."""
    r0, by_r, bent_r, by_p, bent_p, axes = model
    k, share, some = r0.shape[0], np.ones(3), False
    for i in range(3):
        level, bent = 0.0, 0.0
        for a in range(k):
            level += by_r[a, i] ** 2 + r0[a] * bent_r[a, i, i]
            bent += bent_r[a, i, i] ** 2
        level = max(level, math.sqrt(bent))
        if level > _SHARP:
            share[i], some = 1.0 / math.sqrt(level), True
    for i in range(3 if some else 0):
        for a in range(k):
            by_r[a, i] *= share[i]
            for q in range(3):
                bent_r[a, i, q] *= share[i] * share[q]
        for a in range(3):
            axes[a, i] *= share[i]
            by_p[a, i] *= share[i]
            for q in range(3):
                bent_p[a, i, q] *= share[i] * share[q]
    return some


@inlined
def _room(x: Array, along: float, up: bool) -> float:
    """How many standard deviations there are on the whisker, one of which changes s by so much."""
    return float((1.0 - x[0] if up else x[0] - LEAST_ARC) / max(abs(along), _NOTHING))


@inlined
def _ends(x: Array, axes: Array, steps: Array, others: Array) -> None:
    """Fill how far to go along each axis, signed: where there is more room, and the other way."""
    for i in range(3):
        up, down = _room(x, axes[0, i], True), _room(x, axes[0, i], False)
        far, near = max(up, down), min(up, down)
        side = 1.0 if (up >= down) == (axes[0, i] >= 0.0) else -1.0
        steps[i], others[i] = side * min(_REACH, far), -side * min(_OTHER_END, near)


@inlined
def _load(b: Array, x: Array, axes: Array, steps: Array, moved: Array) -> None:
    """Load contacts displaced along the axes; ``moved`` (4, 4), of which the last is the third."""
    for i in range(LANES):
        at = min(i, 2)
        moved[i, 0], moved[i, 1] = x[0] + steps[at] * axes[0, at], 0.0
        moved[i, 2] = x[2] + steps[at] * axes[1, at]
        moved[i, 3] = x[3] + steps[at] * axes[2, at]
        set_lane(b, i, moved[i, 0], 0.0, moved[i, 2], moved[i, 3], False)


@inlined
def _by_axis(derivatives: Array, axes: Array, i: int) -> float:
    """One derivative along axis i."""
    return float(
        derivatives[0] * axes[0, i] + derivatives[1] * axes[1, i] + derivatives[2] * axes[2, i]
    )


@inlined
def _missed(model: _Model, i: int, h: float, r: Array) -> float:
    """What the second order misses of the channels' residuals on an axis, at the usual distance."""
    away = 0.0
    for a in range(r.shape[0]):
        by, bent = model.by_r[a, i], model.bent_r[a, i, i]
        away += (r[a] - model.r0[a] - h * by - 0.5 * h * h * bent) ** 2
    return math.sqrt(away) * (_REACH / abs(h)) ** 3


@inlined
def _second_order(
    rod: Rod,
    b: Array,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    slopes: Array,
    j: Array,
    model: _Model,
) -> float:
    """Fill B, H_r, A and H_p of the model; what they miss of the channels at the ends of the axes.

    Derivatives at contacts displaced along each axis tell the second order; as the contacts there
    are solved anyway, their channels tell what it misses. Those of the other ends do, too.
    """
    _, by_r, bent_r, by_p, bent_p, axes = model
    k, missed, steps, others = codes.shape[0], 0.0, np.empty(3), np.empty(3)
    moved, value, t, third = np.empty((LANES, 4)), np.empty(6), np.zeros((6, 4)), np.empty((6, 3))
    residual, jacobian, four = np.empty(k), np.empty((k, 4)), np.empty((k, 4))
    r, there = np.empty(k), np.empty((k, 3))
    for i in range(3):
        for a in range(k):
            by_r[a, i] = _by_axis(j[a], axes, i)
        for a in range(3):
            by_p[a, i] = _by_axis(slopes[a], axes, i)
    _ends(x, axes, steps, others)
    _load(b, x, axes, steps, moved)
    integrate(rod, b, 3)
    for i in range(3):
        h = steps[i]
        lane_contact(b, i, False, value, t, third)
        channel_equations(moved[i], value, t, codes, target, residual, jacobian)
        whiten(weights, residual, jacobian, k, r, four)
        _without_friction(four, there)
        for q in range(3):
            for a in range(k):
                bent_r[a, i, q] = (_by_axis(there[a], axes, q) - by_r[a, q]) / h
            for a in range(3):
                bent_p[a, i, q] = (_by_axis(third[3 + a], axes, q) - by_p[a, q]) / h
        missed = max(missed, _missed(model, i, h, r))
    _load(b, x, axes, others, moved)
    integrate(rod, b, 0)
    for i in range(3):
        if abs(others[i]) < _LEAST_END:
            continue
        lane_value(b, i, value)
        channel_equations(moved[i], value, t, codes, target, residual, jacobian)
        whiten(weights, residual, jacobian, k, r, four)
        missed = max(missed, _missed(model, i, others[i], r))
    return missed


@inlined
def _without_friction(four: Array, three: Array) -> None:
    """Copy derivatives by x (n, 4), those by ξ (n, 3)."""
    for a in range(four.shape[0]):
        three[a, 0], three[a, 1], three[a, 2] = four[a, 0], four[a, 2], four[a, 3]


@inlined
def _even(model: _Model) -> float:
    """Make second derivatives symmetric; how large they are in standard deviations of the point."""
    bent_r, by_p, bent_p = model.bent_r, model.by_p, model.bent_p
    for i in range(3):
        for q in range(i):
            for a in range(bent_r.shape[0]):
                bent_r[a, i, q] = bent_r[a, q, i] = 0.5 * (bent_r[a, i, q] + bent_r[a, q, i])
            for a in range(3):
                bent_p[a, i, q] = bent_p[a, q, i] = 0.5 * (bent_p[a, i, q] + bent_p[a, q, i])
    root, back, v = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    _first_order(by_p, v)
    if not cholesky(v, root):
        return np.inf
    largest = 0.0
    for i in range(3):
        for q in range(3):
            total = 0.0
            for a in range(bent_r.shape[0]):
                total += bent_r[a, i, q] ** 2
            for a in range(3):
                back[a] = bent_p[a, i, q]
            largest = max(largest, total + mahalanobis(root, back))
    return math.sqrt(largest)


@inlined
def _first_order(by_p: Array, covariance: Array) -> None:
    """Fill A Aᵀ."""
    for a in range(3):
        for c in range(3):
            covariance[a, c] = _by_axis(by_p[a], by_p.T, c)


@inlined
def _densities(
    model: _Model,
    s: float,
    proximal: float,
    turn: float,
    points: Array,
    density: Array,
    likely: Array,
) -> None:
    """Fill posterior densities at nodes ±u relative to the nodes' own, and points (3, 2 m).

    What is odd in u and what is even is shared by both. ``likely`` leaves volumes out. ``points``
    are displacements of the point; ``turn`` is 1 where the axes are right-handed, -1 otherwise.
    """
    r0, by_r, bent_r, by_p, bent_p, axes = model
    nodes, half = _NODES, _NODES.shape[1]
    slopes, arc = np.empty((3, 3, 2 * half)), np.full(2 * half, s)
    log = np.zeros(2 * half)
    odd, even, bent = np.empty(half), np.empty(half), np.empty(half)
    for i in range(3):
        along, u = axes[0, i], nodes[i]
        for m in range(half):
            arc[m] += along * u[m]
            log[m] += 0.5 * u[m] * u[m]
    for m in range(half):
        arc[half + m], log[half + m] = 2.0 * s - arc[m], log[m]
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
    """Fill what second derivatives (n,) change of a slope at all nodes."""
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
    """Fill the second moment (3, 3) of points (3, n) of some density."""
    for a in range(3):
        for c in range(a + 1):
            covariance[a, c] = 0.0
            for k in range(points.shape[1]):
                covariance[a, c] += density[k] * points[a, k] * points[c, k]
            covariance[a, c] /= total
            covariance[c, a] = covariance[a, c]


@inlined
def _reaches(far: Array, density: Array, centre: float, logs: Array) -> None:
    """Make squared distances along each ray (rays, radii) rise; fill the logs of what is beyond.

    ``logs`` (rays, 1 + radii) are those of the probability beyond the centre and each node.
    """
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
    """Factor by which an ellipsoid holds what it states at three deviations; what at 95 %."""
    whole, _ = _outside(far, logs, 0.0)
    square = _THREE_SIGMA
    for _ in range(_TRIALS):
        left, slope = _outside(far, logs, square)
        step = math.log(max(left / whole, _NOTHING) / _LEFT) * left / min(slope, -_NOTHING)
        square = min(max(square - step, 0.5 * square), 2.0 * square)
    wider = max(square / _THREE_SIGMA, 1.0)
    left, _ = _outside(far, logs, wider * _HELD)
    return wider, 1.0 - left / whole


@inlined
def _moments(
    model: _Model, s: float, proximal: float, turn: float, first_order: float, covariance: Array
) -> tuple[float, bool]:
    """Fill the second moment about the point, widened; mean density, and whether it can serve."""
    half, pairs = _NODES.shape[1], _SHARES.shape[0]
    points, density, likely = np.empty((3, 2 * half)), np.empty(2 * half), np.empty(2 * half)
    _densities(model, s, proximal, turn, points, density, likely)
    middle = 1.0
    for m in range(half):
        middle -= 2.0 * _WEIGHTS[m]
    mean, fits = middle * first_order, middle
    for m in range(2 * half):
        mean += _WEIGHTS[m % half] * density[m]
        fits += _WEIGHTS[m % half] * likely[m]
    centre = 0.5 * (1.0 / fits + first_order / mean)
    squares = middle * centre * centre
    for m in range(2 * half):
        likely[m] = 0.5 * (likely[m] / fits + density[m] / mean)
        density[m] = _WEIGHTS[m % half] * likely[m]
        squares += density[m] * likely[m]
    if not squares * _TOO_FEW < 1.0:
        for a in range(3):  # too few of the nodes are in Ω: what they say is added to first order
            for c in range(3):
                for m in range(2 * half):
                    covariance[a, c] += density[m] * points[a, m] * points[c, m]
        return mean, False
    second_moment(points, density, 1.0, covariance)
    root, far, logs = np.zeros((3, 3)), np.empty(2 * half), np.empty((2 * pairs, 1 + _RADII))
    if not cholesky(covariance, root):
        return mean, False
    squared_distances(root, points, far)
    reach = far.reshape(2 * pairs, _RADII)
    _reaches(reach, likely.reshape(2 * pairs, _RADII), centre, logs)
    wider, held = _fitting(reach, logs)
    for a in range(3):
        for c in range(3):
            covariance[a, c] *= wider
    return mean, _LEAST_HELD < held < _MOST_HELD and wider < _MOST_WIDENED


@kernel
def judge(
    rod: Rod,
    proximal: float,
    codes: IntArray,
    target: Array,
    weights: Array,
    contacts: Array,
    tangents: Array,
    residuals: Array,
    jacobians: Array,
    covariances: Array,
    weight: Array,
    valid: AnyArray,
    n: int,
) -> None:
    """Judge candidates of a measurement; see the module.

    Weights, x (n, 4), ∂(F, p)/∂ξ (n, 6, 3), residuals and their slopes by x (n, k, 4) are those of
    each; out come covariances of points, log weights, and whether covariances are valid.
    """
    k, b, nothing = codes.shape[0], np.zeros(BUFFER_SIZE), np.zeros(3)
    j, slopes = np.empty((k, 3)), np.empty((3, 3))
    model = _Model(
        np.empty(k),
        np.empty((k, 3)),
        np.empty((k, 3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3, 3)),
        np.empty((3, 3)),
    )
    r0, by_r, _, by_p, _, axes = model
    for row in range(n):
        x, covariance = contacts[row], covariances[row]
        weight[row], valid[row] = -np.inf, False
        covariance[:] = np.nan
        _without_friction(jacobians[row], j)
        if not _principal(j, axes):
            continue
        misfit, pulled, away = 0.0, 0.0, 0.0
        for a in range(k):
            r0[a] = residuals[row, a]
            misfit += r0[a] * r0[a]
        for a in range(3):
            copy(tangents[row, 3 + a], slopes[a])
        short = _capped(x, axes)
        missed = _second_order(rod, b, codes, target, weights[row], x, slopes, j, model)
        bent = _even(model)
        short = _shortened(model) or short
        _first_order(by_p, covariance)
        for i in range(3):
            away += axes[0, i] ** 2
            pull = 0.0
            for a in range(k):
                pull += r0[a] * by_r[a, i]
            pulled = max(pulled, abs(pull))
        away = 4.0 * math.sqrt(away)
        for a in range(3):
            copy(by_p[a], slopes[a])
        first_order, density, fair = abs(solve(slopes, nothing)), 0.0, True
        straight = proximal + away < x[0] < 1.0 - away and not short
        straight = straight and bent < _STRAIGHT and pulled < _STRAIGHT
        if not straight:
            for a in range(3):
                copy(axes[a], slopes[a])
            turn = math.copysign(1.0, solve(slopes, nothing))
            density, fair = _moments(model, x[0], proximal, turn, first_order, covariance)
        if straight or (missed > _BROKEN and first_order > 0.0 and not short):
            density = first_order
        weight[row] = math.log(density) - 0.5 * misfit if density > 0.0 else -np.inf
        valid[row] = missed < _MISSED and fair


@kernel
def rank(weight: Array, number: IntArray, probability: Array, order: IntArray) -> None:
    """Posterior probabilities of candidates, and their order by falling probability."""
    for row in range(number.shape[0]):
        n, log = number[row], weight[row]
        for i in range(order.shape[1]):
            order[row, i], probability[row, i] = i, np.nan
        for i in range(1, n):  # stable: candidates of equal weight stay by force
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
