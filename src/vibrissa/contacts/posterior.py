"""What noise leaves open about a contact: covariance, its validity, and what a candidate weighs.

A contact x explains measured channels with residuals r = W (c(x) - c̃), in standard deviations, and
gives outputs y: the contact point p, and with friction the friction angle. About the candidate both
are followed to second order along N axes a_i, the principal axes of the noise seen in x:

    x = x̂ + Σ a_i u_i,    r(u) = r̂ + B u + H_r(u, u)/2,    y(u) = ŷ + A u + H_y(u, u)/2.

Contact points of Ω are equally probable beforehand, so that the posterior density of u is
exp(-|r(u)|²/2) det ∂y/∂u within Ω and zero outside: beyond the tip, before the proximal limit, and
without friction beyond the fold, where the determinant changes its sign. Its moments are sums over
nodes u_k, normally distributed, along axes that are shortened where Ω or the second order ends the
density sooner, as at folds of the signals. To first order the covariance of p is A Aᵀ; near a fold
of p that is a sheet that contacts leave, and the second moment about p̂ is not. Tails longer than a
normal distribution's show in the kurtosis κ, relative to a normal distribution's (Mardia,
Biometrika 57, 1970), and in nodes of uneven density, of which a share η counts, (Σ w)²/(n Σ w²). So
that stated regions hold these too, the covariance is widened by κ^(3/4)/η, which makes 95 % regions
hold 93 to 97 % of simulated contacts, and 3σ regions at least 99.6 %, up to the fold.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from vibrissa.contacts.channels import FITTED
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
    share_out,
    solve,
)
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    Discretization,
    Rod,
    integrate,
    set_lane,
)

#: A candidate more probable than this is the only one.
CERTAIN = 0.95
# How far along each axis the second order is taken from, in standard deviations.
_REACH = 2.0
# What the second order misses there (in standard deviations of the channels) where a covariance can
# be relied on, the largest kurtosis relative to a normal distribution's, and the least share of the
# nodes that counts.
_MISSED, _TAILED, _COUNTING = 0.03, 1.8, 0.3
# Where the second order misses so much, densities are not to be trusted: the first order gives the
# weight of a candidate. A node's log density gains at most so much over the first order's.
_BROKEN, _MOST_GAIN = 0.3, 3.0
# With a smaller share than this moments mean nothing.
_TOO_FEW = 0.1
# Below this second order (of the point, or the channels, for a standard deviation of each axis) the
# first will do: variances differ by less than 4 %.
_STRAIGHT = 0.06
# The longest axis, of s (and relative to the force, 1); and the largest second derivative of -log
# density along an axis, where its length is not changed: for a normal distribution it is 1.
_LONGEST, _SHARP = 0.25, 2.0
# Unknowns that a measurement determines this much worse than others it does not determine.
_OPEN = 1e-10
_NODES = 64
_SWEEPS = 12


def _normal(dimension: int) -> Array:
    """Nodes ±u, of which u (dimension, n / 2), with the covariance of a normal distribution.

    An additive recurrence with the powers of the root of g^(d + 1) = g + 1 fills the cube evenly.
    """
    g = 1.0
    for _ in range(60):
        g = (1.0 + g) ** (1.0 / (dimension + 1))
    steps = g ** -np.arange(1.0, dimension + 1)
    half = ndtri((0.5 + np.arange(1, _NODES // 2 + 1)[:, None] * steps) % 1.0)
    nodes = np.concatenate([half, -half])
    root = np.linalg.cholesky(nodes.T @ nodes / _NODES)
    return np.ascontiguousarray((half @ np.linalg.inv(root).T).T)


def _kurtosis(half: Array) -> float:
    return float(((half**2).sum(axis=0) ** 2).mean())


#: Fourth moment of three coordinates that are normally distributed.
NORMAL_KURTOSIS = 15.0
_NODES_3, _NODES_4 = _normal(3), _normal(4)
# Fourth moment of the point's three coordinates: of the nodes, and with friction, where they are
# three of four unknowns, that of a normal distribution.
_KURTOSIS_3, _KURTOSIS_4 = _kurtosis(_NODES_3), _kurtosis(_NODES_4[:3])

# Working memory for one candidate: r̂ (k), B (k, 4), H_r (k, 4, 4); A (4, 4), H_y (4, 4, 4); axes
# (4, 4), in columns, by unknown.
Model = tuple[Array, Array, Array, Array, Array, Array]


@inlined
def _outputs(x: Array, t: Array, friction: bool, slopes: Array) -> None:
    """Fill ∂y/∂x (4, 4): of the contact point, and of the friction angle."""
    for a in range(3):
        copy(t[3 + a], slopes[a])
    if friction:
        normal = math.hypot(x[2], x[3])
        size = normal * normal + x[1] * x[1]
        slopes[3, 0], slopes[3, 1] = 0.0, normal / size
        slopes[3, 2] = -x[1] * x[2] / (normal * size)
        slopes[3, 3] = -x[1] * x[3] / (normal * size)


@inlined
def _principal(j: Array, k: int, unknowns: IntArray, axes: Array) -> bool:
    """Fill principal axes of the noise in x, one standard deviation long; whether there are all.

    One-sided Jacobi rotations make the columns of W ∂c/∂x, brought to length one, orthogonal.
    """
    n = unknowns.shape[0]
    c, size = np.empty((k, n)), np.empty(n)
    for i in range(4):
        for p in range(4):
            axes[i, p] = 0.0
    for p in range(n):
        total = 0.0
        for i in range(k):
            total += j[i, unknowns[p]] ** 2
        size[p] = math.sqrt(total)
        if not 0.0 < size[p] < np.inf:
            return False
        axes[unknowns[p], p] = 1.0 / size[p]
        for i in range(k):
            c[i, p] = j[i, unknowns[p]] / size[p]
    for _ in range(_SWEEPS):
        largest = 0.0
        for p in range(n - 1):
            for q in range(p + 1, n):
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
                for i in range(4):
                    a, b = axes[i, p], axes[i, q]
                    axes[i, p], axes[i, q] = cos * a - sin * b, sin * a + cos * b
        if largest < 1e-9:
            break
    known = True
    for p in range(n):  # longest first: rounding must not choose the axes' order either
        for q in range(p + 1, n):
            pp, qq = 0.0, 0.0
            for i in range(k):
                pp += c[i, p] * c[i, p]
                qq += c[i, q] * c[i, q]
            if qq < pp:
                for i in range(k):
                    c[i, p], c[i, q] = c[i, q], c[i, p]
                for i in range(4):
                    axes[i, p], axes[i, q] = axes[i, q], axes[i, p]
        total = 0.0
        for i in range(k):
            total += c[i, p] * c[i, p]
        length = math.sqrt(total)
        known = known and length > _OPEN
        largest, best = -1.0, 0
        for i in range(n):  # rounding must not choose an axis's sign: nodes are not symmetric
            share = abs(axes[unknowns[i], p]) * size[i]
            if share > 1.001 * largest:
                largest, best = share, unknowns[i]
        scale = math.copysign(1.0 / max(length, _OPEN), axes[best, p])
        for i in range(4):
            axes[i, p] *= scale
    return known


@inlined
def _capped(x: Array, axes: Array, n: int) -> bool:
    """Shorten axes that leave the whisker, as where signals fold; whether any did."""
    force, capped = math.sqrt(x[1] * x[1] + x[2] * x[2] + x[3] * x[3]), False
    for i in range(n):
        change = math.sqrt(axes[1, i] ** 2 + axes[2, i] ** 2 + axes[3, i] ** 2)
        size = max(abs(axes[0, i]) / _LONGEST, change / max(force, 1e-300))
        if size > 1.0:
            capped = True
            for a in range(4):
                axes[a, i] /= size
    return capped


@inlined
def _shortened(model: Model, n: int) -> bool:
    """Shorten axes along which the second order ends the density sooner; whether there are any."""
    r0, by_r, bent_r, by_y, bent_y, axes = model
    k, share, some = r0.shape[0], np.ones(4), False
    for i in range(n):
        level, bent = 0.0, 0.0
        for a in range(k):
            level += by_r[a, i] ** 2 + r0[a] * bent_r[a, i, i]
            bent += bent_r[a, i, i] ** 2
        level = max(level, math.sqrt(bent))
        if level > _SHARP:
            share[i], some = 1.0 / math.sqrt(level), True
    for i in range(n if some else 0):
        for a in range(k):
            by_r[a, i] *= share[i]
            for q in range(n):
                bent_r[a, i, q] *= share[i] * share[q]
        for a in range(4):
            axes[a, i] *= share[i]
            by_y[a, i] *= share[i]
            for q in range(n):
                bent_y[a, i, q] *= share[i] * share[q]
    return some


@inlined
def _step(x: Array, axes: Array, i: int, least: float) -> float:
    """How far to go along an axis, signed: to the side on which there is more room."""
    along = axes[0, i]
    if along == 0.0:
        return _REACH
    up, down = (1.0 - x[0]) / abs(along), (x[0] - least) / abs(along)
    if along < 0.0:
        up, down = down, up
    return float(min(_REACH, up) if up >= down else -min(_REACH, down))


@inlined
def _load(
    b: Array, x: Array, axes: Array, steps: Array, first: int, lanes: int, moved: Array
) -> None:
    """Load displaced contacts, ``lanes`` lanes each, from axis ``first`` on; ``moved`` (4, 4)."""
    n = steps.shape[0]
    for i in range(LANES):
        at = min(first + i // lanes, n - 1)
        for a in range(4):
            moved[i, a] = x[a] + steps[at] * axes[a, at]
        set_lane(b, i, moved[i, 0], moved[i, 1], moved[i, 2], moved[i, 3], i % lanes == 1)


@inlined
def _by_axes(derivatives: Array, axes: Array, row: int, n: int, i: int) -> float:
    """One derivative along axis i."""
    total = 0.0
    for a in range(4):
        total += derivatives[row, a] * axes[a, i]
    return total


@inlined
def _second_order(
    rod: Rod,
    b: Array,
    friction: bool,
    least: float,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    slopes: Array,
    j: Array,
    n: int,
    model: Model,
) -> float:
    """Fill B, H_r, A and H_y of the model; what they miss of the channels at the ends of the steps.

    Derivatives at contacts displaced along each axis tell the second order; as the contacts there
    are solved anyway, their channels tell what it misses.
    """
    r0, by_r, bent_r, by_y, bent_y, axes = model
    k, lanes, missed = codes.shape[0], 2 if friction else 1, 0.0
    steps, moved, third = np.empty(n), np.empty((LANES, 4)), np.empty((6, 3))
    value, t, slopes_there = np.empty(6), np.zeros((6, 4)), np.zeros((4, 4))
    residual, jacobian = np.empty(k), np.empty((k, 4))
    r, there = np.empty(k), np.empty((k, 4))
    for i in range(n):
        steps[i] = _step(x, axes, i, least)
        for a in range(k):
            by_r[a, i] = _by_axes(j, axes, a, n, i)
        for a in range(4):
            by_y[a, i] = _by_axes(slopes, axes, a, n, i)
    for first in range(0, n, LANES // lanes):
        _load(b, x, axes, steps, first, lanes, moved)
        integrate(rod, b, 3)
        for i in range(first, min(first + LANES // lanes, n)):
            lane = lanes * (i - first)
            lane_contact(b, lane, friction, value, t, third)
            channel_equations(moved[lane], value, t, codes, target, residual, jacobian)
            whiten(weights, residual, jacobian, k, r, there)
            _outputs(moved[lane], t, friction, slopes_there)
            h = steps[i]
            for q in range(n):
                for a in range(k):
                    bent_r[a, i, q] = (_by_axes(there, axes, a, n, q) - by_r[a, q]) / h
                for a in range(4):
                    bent_y[a, i, q] = (_by_axes(slopes_there, axes, a, n, q) - by_y[a, q]) / h
            away = 0.0
            for a in range(k):
                away += (r[a] - r0[a] - h * by_r[a, i] - 0.5 * h * h * bent_r[a, i, i]) ** 2
            missed = max(missed, math.sqrt(away) * (_REACH / abs(h)) ** 3)
    return missed


@inlined
def _even(model: Model, n: int) -> float:
    """Make second derivatives symmetric; how large they are in standard deviations of the point."""
    bent_r, by_y, bent_y = model[2], model[3], model[4]
    for a in range(bent_r.shape[0]):
        for i in range(n):
            for q in range(i):
                bent_r[a, i, q] = bent_r[a, q, i] = 0.5 * (bent_r[a, i, q] + bent_r[a, q, i])
    for a in range(4):
        for i in range(n):
            for q in range(i):
                bent_y[a, i, q] = bent_y[a, q, i] = 0.5 * (bent_y[a, i, q] + bent_y[a, q, i])
    root, back, v = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    for a in range(3):
        for c in range(3):
            v[a, c] = 0.0
            for i in range(n):
                v[a, c] += by_y[a, i] * by_y[c, i]
    if not cholesky(v, root):
        return np.inf
    largest = 0.0
    for i in range(n):
        for q in range(n):
            total = 0.0
            for a in range(bent_r.shape[0]):
                total += bent_r[a, i, q] ** 2
            for a in range(3):
                back[a] = bent_y[a, i, q]
            largest = max(largest, total + mahalanobis(root, back))
    return math.sqrt(largest)


@inlined
def _densities(
    model: Model,
    nodes: Array,
    s: float,
    proximal: float,
    friction: bool,
    turn: float,
    points: Array,
    density: Array,
) -> None:
    """Fill posterior densities at nodes ±u relative to the nodes' own, and points (3, 2 m).

    Of the nodes u (n, m) is given; what is odd in u and what is even is shared by both. ``points``
    are displacements of the point; ``turn`` is 1 where the axes are right-handed, -1 otherwise.
    """
    r0, by_r, bent_r, by_y, bent_y, axes = model
    n, half = nodes.shape
    slopes, arc = np.empty((n, n, 2 * half)), np.full(2 * half, s)
    log = np.zeros(2 * half)
    odd, even, bent = np.empty(half), np.empty(half), np.empty(half)
    for i in range(n):
        along, u = axes[0, i], nodes[i]
        for m in range(half):
            arc[m] += along * u[m]
            log[m] += 0.5 * u[m] * u[m]
    for m in range(half):
        arc[half + m], log[half + m] = 2.0 * s - arc[m], log[m]
    for a in range(r0.shape[0]):
        here = r0[a]
        odd[:], even[:] = 0.0, here
        for i in range(n):
            _change_of_slope(bent_r[a, i], nodes, bent)
            first, u = by_r[a, i], nodes[i]
            for m in range(half):
                odd[m] += first * u[m]
                even[m] += 0.5 * bent[m] * u[m]
        for m in range(half):
            up, down = even[m] + odd[m], even[m] - odd[m]
            log[m] -= 0.5 * (up * up - here * here)
            log[half + m] -= 0.5 * (down * down - here * here)
    for a in range(n):
        odd[:], even[:] = 0.0, 0.0
        for i in range(n):
            _change_of_slope(bent_y[a, i], nodes, bent)
            first, u, slope = by_y[a, i], nodes[i], slopes[a, i]
            for m in range(half):
                slope[m], slope[half + m] = first + bent[m], first - bent[m]
                odd[m] += first * u[m]
                even[m] += 0.5 * bent[m] * u[m]
        if a < 3:
            moved = points[a]
            for m in range(half):
                moved[m], moved[half + m] = even[m] + odd[m], even[m] - odd[m]
    _determinants(slopes, density)
    for m in range(2 * half):
        det = turn * density[m]
        det = abs(det) if friction else max(det, 0.0)
        inside = (arc[m] >= proximal) & (arc[m] <= 1.0)
        density[m] = det * quick_exp(min(log[m], _MOST_GAIN)) if inside else 0.0


@inlined
def _determinants(matrices: Array, out: Array) -> None:
    """Determinants of matrices (n, n, m), n three or four."""
    n = matrices.shape[0]
    if n == 3:  # side by side
        a, b, c = matrices[0], matrices[1], matrices[2]
        for m in range(out.shape[0]):
            out[m] = (
                a[0, m] * (b[1, m] * c[2, m] - b[2, m] * c[1, m])
                + a[1, m] * (b[2, m] * c[0, m] - b[0, m] * c[2, m])
                + a[2, m] * (b[0, m] * c[1, m] - b[1, m] * c[0, m])
            )
        return
    matrix, nothing = np.empty((n, n)), np.zeros(n)
    for m in range(out.shape[0]):
        for p in range(n):
            for q in range(n):
                matrix[p, q] = matrices[p, q, m]
        out[m] = solve(matrix, nothing)


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
def second_moment(
    points: Array, density: Array, total: float, normal: float, covariance: Array
) -> float:
    """Fill the second moment (3, 3) of points (3, n) of some density, widened for their tails.

    Their kurtosis is returned, relative to what is normal; infinite where there is none.
    """
    root, far = np.zeros((3, 3)), np.empty(points.shape[1])
    xx, xy, xz, yy, yz, zz, fourth = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(points.shape[1]):
        x, y, z = points[0, k], points[1, k], points[2, k]
        wx, wy = density[k] * x, density[k] * y
        xx, xy, xz = xx + wx * x, xy + wx * y, xz + wx * z
        yy, yz, zz = yy + wy * y, yz + wy * z, zz + density[k] * z * z
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = xx / total, yy / total, zz / total
    covariance[0, 1] = covariance[1, 0] = xy / total
    covariance[0, 2] = covariance[2, 0] = xz / total
    covariance[1, 2] = covariance[2, 1] = yz / total
    if not cholesky(covariance, root):
        return np.inf
    squared_distances(root, points, far)
    for k in range(points.shape[1]):
        fourth += density[k] * far[k] * far[k]
    tailed = fourth / (total * normal)
    wider = max(tailed, 1.0) ** 0.75
    for a in range(3):
        for c in range(3):
            covariance[a, c] *= wider
    return tailed


@inlined
def _moments(
    model: Model,
    nodes: Array,
    s: float,
    proximal: float,
    friction: bool,
    turn: float,
    covariance: Array,
) -> tuple[float, bool]:
    """Fill the second moment about the point, widened; mean density, and whether it can serve."""
    number = 2 * nodes.shape[1]
    points, density, total, squares = np.empty((3, number)), np.empty(number), 0.0, 0.0
    _densities(model, nodes, s, proximal, friction, turn, points, density)
    for k in range(number):
        total += density[k]
        squares += density[k] * density[k]
    counting = total * total / (number * squares) if squares > 0.0 else 0.0
    if not counting > _TOO_FEW:
        for a in range(3):  # too few of the nodes are in Ω: what they say is added to first order
            for c in range(3):
                for k in range(number):
                    share = density[k] / total if total > 0.0 else 0.0
                    covariance[a, c] += share * points[a, k] * points[c, k]
        return total / number, False
    normal = _KURTOSIS_4 if friction else _KURTOSIS_3
    tailed = second_moment(points, density, total, normal, covariance)
    for a in range(3):
        for c in range(3):
            covariance[a, c] /= counting
    return total / number, tailed < _TAILED and counting > _COUNTING


@kernel
def judge(
    rod: Rod,
    friction: bool,
    least: float,
    proximal: float,
    codes: IntArray,
    targets: Array,
    weights: Array,
    contacts: Array,
    values: Array,
    tangents: Array,
    covariances: Array,
    weight: Array,
    valid: AnyArray,
    first: int,
    last: int,
) -> None:
    """Judge candidates; see the module."""
    k, n = codes.shape[0], 4 if friction else 3
    b, unknowns = np.zeros(BUFFER_SIZE), np.empty(n, np.int64)
    for i in range(n):
        unknowns[i] = i if friction or i == 0 else i + 1
    residual, jacobian = np.empty(k), np.empty((k, 4))
    r0, j, slopes = np.empty(k), np.empty((k, 4)), np.zeros((4, 4))
    by_r, bent_r = np.zeros((k, 4)), np.zeros((k, 4, 4))
    by_y, bent_y, axes = np.zeros((4, 4)), np.zeros((4, 4, 4)), np.zeros((4, 4))
    nothing = np.zeros(n)
    model = (r0, by_r, bent_r, by_y, bent_y, axes)
    for row in range(first, last):
        x, covariance = contacts[row], covariances[row]
        weight[row], valid[row] = -np.inf, False
        for a in range(3):
            for c in range(3):
                covariance[a, c] = np.nan
        if not values[row, 0] < np.inf:
            continue
        channel_equations(x, values[row], tangents[row], codes, targets[row], residual, jacobian)
        misfit = whiten(weights[row], residual, jacobian, k, r0, j)
        if not _principal(j, k, unknowns, axes):
            continue
        _outputs(x, tangents[row], friction, slopes)
        short = _capped(x, axes, n)
        missed = _second_order(
            rod, b, friction, least, codes, targets[row], weights[row], x, slopes, j, n, model
        )
        bent, away = _even(model, n), 0.0
        short = _shortened(model, n) or short
        for a in range(3):
            for c in range(3):
                covariance[a, c] = 0.0
                for i in range(n):
                    covariance[a, c] += by_y[a, i] * by_y[c, i]
        pulled = 0.0
        for i in range(n):
            away += axes[0, i] ** 2
            pull = 0.0
            for a in range(k):
                pull += r0[a] * by_r[a, i]
            pulled = max(pulled, abs(pull))
        away = 4.0 * math.sqrt(away)
        inside = proximal + away < x[0] < 1.0 - away
        for a in range(4):
            copy(by_y[a], slopes[a])
        first_order, density, fair = abs(solve(slopes, nothing)), 0.0, True
        straight = inside and bent < _STRAIGHT and pulled < _STRAIGHT and not short
        if not straight:
            for p in range(n):
                for q in range(n):
                    slopes[p, q] = axes[unknowns[p], q]
            turn = math.copysign(1.0, solve(slopes, nothing))
            nodes = _NODES_4 if friction else _NODES_3
            density, fair = _moments(model, nodes, x[0], proximal, friction, turn, covariance)
            for a in range(4):
                for q in range(4):
                    slopes[a, q] = 0.0
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


class Judgement(NamedTuple):
    """Covariances of points (n, 3, 3), log weights (n,), and validity (n,) of candidates."""

    covariances: Array
    weight: Array
    valid: AnyArray


def judged(
    discretization: Discretization,
    names: tuple[str, ...],
    targets: Array,
    weights: Array,
    contacts: Array,
    values: Array,
    tangents: Array,
    *,
    friction: bool,
    least: float,
    proximal: float,
) -> Judgement:
    """Judge candidates of many measurements; the arguments are those of :func:`judge`."""
    n, rod = len(contacts), discretization.rod
    out = Judgement(np.full((n, 3, 3), np.nan), np.full(n, -np.inf), np.zeros(n, np.bool_))
    codes = np.array([FITTED.index(name) for name in names])
    targets, weights = np.ascontiguousarray(targets), np.ascontiguousarray(weights)
    share_out(
        n,
        lambda first, last: judge(
            rod,
            friction,
            least,
            proximal,
            codes,
            targets,
            weights,
            contacts,
            values,
            tangents,
            *out,
            first,
            last,
        ),
    )
    return out


def ranked(weight: Array, number: IntArray) -> tuple[Array, IntArray]:
    """Probabilities (rows, most) of candidates, and their order; see :func:`rank`."""
    probability, order = np.empty(weight.shape), np.empty(weight.shape, np.int64)
    rank(weight, number, probability, order)
    return probability, order
