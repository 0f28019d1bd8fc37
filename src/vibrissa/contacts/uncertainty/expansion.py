"""Second-order expansion of channels and contact point along valleys of χ²; compiled.

A contact ξ explains measured channels with residuals r = W (c(ξ) - c̃), in standard deviations. The
residuals and the contact point p are expanded to second order along the principal axes a_i of the
noise in ξ:

    ξ = ξ̂ + Σ a_i (u_i + C_i(u, u)/2),    r(u) = r̂ + B u + H_r(u, u)/2,
    p(u) = p̂ + A u + H_p(u, u)/2.

Valleys of χ² may be bent in ξ, for example where only the direction of a force is unknown. C bends
the axes so that they follow the valleys: it removes from H_r the part that a change along axes
other than the displaced ones can cancel. Axes are shortened where Ω, or a fold of the signals in
second order, ends the density sooner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.fitting.least_squares import channel_equations, whiten
from vibrissa.numerics import Array, IntArray, cholesky, copy, inlined, mahalanobis
from vibrissa.rod import (
    LANES,
    LEAST_ARC,
    Charted,
    integrate,
    interpolate,
    lane_slopes,
    lane_value,
    set_lane,
)

# Displacement along each axis from which second derivatives are taken, and the smallest one at
# which the other end is tried, in standard deviations.
_REACH, _OTHER_END, _LEAST_END = 2.0, 3.0, 1.0
_TRIALS, _NOTHING = 4, 1e-12  # times that steps are shortened at most; negligible
# Smallest squared length of an axis's column of B for which it bends others; the length is 1 unless
# the axis was shortened.
_DETERMINED = 0.5
# Longest axis in s (relative to the force it is 1); and the largest second derivative of -log
# density along an axis that is not shortened; for a normal distribution it is 1.
_LONGEST, _SHARP = 0.25, 2.0
# Ratio of uncertainties above which a measurement does not determine an unknown.
_OPEN = 1e-8
_SWEEPS = 12


class Expansion(NamedTuple):
    """Working memory for one candidate.

    r̂ (k), B (k, 3), H_r (k, 3, 3); A, H_p; axes in columns; C (3, 3, 3), and ∂²s/∂u² (3, 3). Then
    r̂ and the derivatives of r (k, 3) and p (3, 3) with respect to ξ, computed as for displaced
    contacts (integrated or interpolated); for these x (3, 4), (F, p) (3, 6) and ∂(F, p)/∂x
    (3, 6, 4); r (k) and the derivatives of one of them. Last, residuals, their slopes with respect
    to x (k, 4), the same in standard deviations, and steps (3, 3).
    """

    r0: Array
    by_r: Array
    bent_r: Array
    by_p: Array
    bent_p: Array
    axes: Array
    bends: Array
    bent_s: Array
    here_r: Array
    here_j: Array
    here_slopes: Array
    moved: Array
    values: Array
    tangents: Array
    r: Array
    j: Array
    slopes: Array
    residual: Array
    jacobian: Array
    four: Array
    steps: Array


@inlined
def empty_expansion(k: int) -> Expansion:
    """Allocate the working memory for k channels."""
    return Expansion(
        np.empty(k),
        np.empty((k, 3)),
        np.empty((k, 3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3, 3)),
        np.empty((3, 3)),
        np.empty(k),
        np.empty((k, 3)),
        np.empty((3, 3)),
        np.empty((3, 4)),
        np.empty((3, 6)),
        np.zeros((3, 6, 4)),
        np.empty(k),
        np.empty((k, 3)),
        np.empty((3, 3)),
        np.empty(k),
        np.empty((k, 4)),
        np.empty((k, 4)),
        np.empty((3, 3)),
    )


@inlined
def principal_axes(x: Array, j: Array, axes: Array) -> bool:
    """Fill principal axes of the noise in ξ, one standard deviation long; whether there are any.

    One-sided Jacobi rotations make the normalised columns of W ∂c/∂ξ orthogonal. The axis of an
    unknown that is not determined within its longest change remains shorter: where its derivatives
    vanish, as in a plane of symmetry, they have no direction.
    """
    k, force = j.shape[0], max(math.hypot(x[2], x[3]), 1e-300)
    c, size = np.empty((k, 3)), np.empty(3)
    for p in range(3):
        total = 0.0
        for i in range(k):
            total += j[i, p] ** 2
        size[p] = max(math.sqrt(total), 1.0 / (_LONGEST if p == 0 else force))
        if not size[p] < np.inf:
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
    for p in range(3):  # longest first, so that rounding does not determine the order of the axes
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
        length = max(math.sqrt(total), _OPEN)
        largest, best = -1.0, 0
        for i in range(3):  # nor the sign of an axis
            share = abs(axes[i, p]) * size[i]
            if share > 1.001 * largest:
                largest, best = share, i
        scale = math.copysign(1.0 / length, axes[best, p])
        for i in range(3):
            axes[i, p] *= scale
    return True


@inlined
def all_determined(model: Expansion) -> bool:
    """Whether residuals change along all axes, in first or second order."""
    by_r, bent_r, largest, least = model.by_r, model.bent_r, 0.0, np.inf
    for i in range(3):
        change = 0.0
        for a in range(by_r.shape[0]):
            change += by_r[a, i] ** 2 + bent_r[a, i, i] ** 2
        largest, least = max(largest, change), min(least, change)
    return bool(least > _OPEN * _OPEN * largest)


@inlined
def axis_length(x: Array, axis: Array) -> float:
    """Length of a change of ξ in units of the longest axis."""
    force = max(math.hypot(x[2], x[3]), 1e-300)
    return float(max(abs(axis[0]) / _LONGEST, math.hypot(axis[1], axis[2]) / force))


@inlined
def cap_axes(x: Array, axes: Array) -> bool:
    """Shorten axes that leave the whisker, as where signals fold; whether any was shortened."""
    capped = False
    for i in range(3):
        size = axis_length(x, axes[:, i])
        if size > 1.0:
            capped = True
            for a in range(3):
                axes[a, i] /= size
    return capped


@inlined
def shorten_axes(model: Expansion) -> bool:
    """Shorten axes along which the second order ends the density sooner; whether any was."""
    r0, by_r, bent_r, by_p, bent_p = model.r0, model.by_r, model.bent_r, model.by_p, model.bent_p
    axes, bends, bent_s, share = model.axes, model.bends, model.bent_s, model.steps[0]
    k, some = r0.shape[0], False
    for i in range(3):
        share[i] = 1.0
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
            bent_s[i, a] *= share[i] * share[a]
            for q in range(3):
                bent_p[a, i, q] *= share[i] * share[q]
                bends[a, i, q] *= share[i] * share[q] / share[a]
    return some


@inlined
def _room(x: Array, along: float, up: bool) -> float:
    """Standard deviations that fit on the whisker, where one changes s by ``along``."""
    return float((1.0 - x[0] if up else x[0] - LEAST_ARC) / max(abs(along), _NOTHING))


@inlined
def _ends(x: Array, axes: Array, steps: Array, others: Array) -> None:
    """Fill signed displacements along each axis: toward the side with more room, and the other."""
    for i in range(3):
        up, down = _room(x, axes[0, i], True), _room(x, axes[0, i], False)
        far, near = max(up, down), min(up, down)
        side = 1.0 if (up >= down) == (axes[0, i] >= 0.0) else -1.0
        steps[i], others[i] = side * min(_REACH, far), -side * min(_OTHER_END, near)


@inlined
def _displace(x: Array, model: Expansion, steps: Array, moved: Array) -> None:
    """Fill contacts (3, 4) displaced along the bent axes, as far as these stay on the whisker."""
    axes, bends, bent_s = model.axes, model.bends, model.bent_s
    for i in range(3):
        for _ in range(_TRIALS):
            s = x[0] + steps[i] * (axes[0, i] + 0.5 * steps[i] * bent_s[i, i])
            if not LEAST_ARC <= s <= 1.0:
                steps[i] *= 0.5
        h = steps[i]
        for c in range(3):
            change = h * axes[c, i]
            for a in range(3):
                change += 0.5 * h * h * axes[c, a] * bends[a, i, i]
            moved[i, min(c, 1) + c] = x[min(c, 1) + c] + change
        moved[i, 0], moved[i, 1] = min(max(moved[i, 0], LEAST_ARC), 1.0), 0.0


@inlined
def _follow(rod: Charted, work: Array, near: bool, model: Expansion, slopes: int) -> bool:
    """Fill (F, p), and ∂(F, p)/∂x, of displaced contacts; whether the map was interpolated."""
    moved, values, tangents = model.moved, model.values, model.tangents
    for i in range(3):
        near = near and interpolate(
            rod.nodes, rod.fold, work, moved[i], values[i], tangents[i], slopes > 0
        )
    if near:
        return True
    for i in range(LANES):
        x = moved[min(i, 2)]
        set_lane(work, i, x[0], 0.0, x[2], x[3], False)
    integrate(rod.rod, work, slopes)
    for i in range(3):
        lane_value(work, i, values[i])
        if slopes > 0:
            lane_slopes(work, i, tangents[i])
    return False


@inlined
def _by_axis(derivatives: Array, axes: Array, i: int) -> float:
    """Derivative along axis i."""
    return float(
        derivatives[0] * axes[0, i] + derivatives[1] * axes[1, i] + derivatives[2] * axes[2, i]
    )


@inlined
def _missed(model: Expansion, i: int, h: float) -> float:
    """Error of the second order of r on an axis, at the usual distance."""
    away = 0.0
    for a in range(model.r.shape[0]):
        by, bent = _by_axis(model.here_j[a], model.axes, i), model.bent_r[a, i, i]
        away += (model.r[a] - model.here_r[a] - h * by - 0.5 * h * h * bent) ** 2
    return math.sqrt(away) * (_REACH / abs(h)) ** 3


@inlined
def _weigh(
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    value: Array,
    tangents: Array,
    model: Expansion,
    r: Array,
    j: Array,
    slopes: Array,
) -> None:
    """Fill r and the derivatives of r (k, 3) and p (3, 3) with respect to ξ at a contact."""
    channel_equations(x, value, tangents, codes, target, model.residual, model.jacobian)
    whiten(weights, model.residual, model.jacobian, codes.shape[0], r, model.four)
    without_friction(model.four, j)
    for a in range(3):
        t, by = tangents[3 + a], slopes[a]
        by[0], by[1], by[2] = t[0], t[2], t[3]


@inlined
def _here(
    rod: Charted,
    work: Array,
    near: bool,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    slopes: Array,
    j: Array,
    model: Expansion,
) -> bool:
    """Fill r̂ and derivatives with respect to ξ, interpolated if ``near``; whether this succeeds."""
    here = model.here_r, model.here_j, model.here_slopes
    value, tangents = model.values[0], model.tangents[0]
    if near and interpolate(rod.nodes, rod.fold, work, x, value, tangents, True):
        _weigh(codes, target, weights, x, value, tangents, model, *here)
        return True
    copy(model.r0, model.here_r)
    for a in range(j.shape[0]):
        copy(j[a], model.here_j[a])
    for a in range(3):
        copy(slopes[a], model.here_slopes[a])
    return False


@inlined
def expand(
    rod: Charted,
    work: Array,
    near: bool,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    slopes: Array,
    j: Array,
    model: Expansion,
) -> bool:
    """Fill B, H_r, A, H_p and C of the model from derivatives at contacts displaced along axes.

    Displacements are smaller along an axis that leaves a bent valley, or that the second order
    ends. Contacts are interpolated if ``near`` and if all are on the map; return whether they were.
    """
    by_r, bent_r, by_p, bent_p, axes = (
        model.by_r,
        model.bent_r,
        model.by_p,
        model.bent_p,
        model.axes,
    )
    k, steps, nearer = codes.shape[0], model.steps[0], True
    for i in range(3):
        for a in range(k):
            by_r[a, i] = _by_axis(j[a], axes, i)
        for a in range(3):
            by_p[a, i] = _by_axis(slopes[a], axes, i)
    _ends(x, axes, steps, model.steps[1])
    model.bends[:], model.bent_s[:] = 0.0, 0.0
    near = _here(rod, work, near, codes, target, weights, x, slopes, j, model)
    for _ in range(_TRIALS):
        if not nearer:
            break
        nearer = False
        _displace(x, model, steps, model.moved)
        if near and not _follow(rod, work, True, model, 3):
            near = _here(rod, work, False, codes, target, weights, x, slopes, j, model)
        elif not near:
            _follow(rod, work, False, model, 3)
        for i in range(3):
            h, away = steps[i], 0.0
            there = model.r, model.j, model.slopes
            value, tangents = model.values[i], model.tangents[i]
            _weigh(codes, target, weights, model.moved[i], value, tangents, model, *there)
            for a in range(k):
                for q in range(3):
                    model.j[a, q] -= model.here_j[a, q]
                for q in range(3):
                    bent_r[a, i, q] = _by_axis(model.j[a], axes, q) / h
            for a in range(3):
                for q in range(3):
                    model.slopes[a, q] -= model.here_slopes[a, q]
                for q in range(3):
                    bent_p[a, i, q] = _by_axis(model.slopes[a], axes, q) / h
            for a in range(k):
                away += bent_r[a, i, i] ** 2
            most = _REACH / math.sqrt(max(math.sqrt(away), 1.0))
            if abs(h) > _SHARP * most:
                steps[i], nearer = math.copysign(most, h), True
    _even(model)
    _bend(model)
    return near


@inlined
def missed_at_ends(
    rod: Charted,
    work: Array,
    near: bool,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    slopes: Array,
    j: Array,
    model: Expansion,
) -> float:
    """Error of the second order of the channels at both ends of the bent axes."""
    missed, room = 0.0, model.steps[2]
    _ends(x, model.axes, model.steps[0], model.steps[1])
    for end in range(2):
        steps = model.steps[end]
        copy(steps, room)
        _displace(x, model, steps, model.moved)
        if not _follow(rod, work, near, model, 0) and near:
            near = _here(rod, work, False, codes, target, weights, x, slopes, j, model)
        for i in range(3):
            if abs(steps[i]) >= _LEAST_END:
                value, tangents = model.values[i], model.tangents[i]
                channel_equations(
                    model.moved[i], value, tangents, codes, target, model.residual, model.jacobian
                )
                whiten(weights, model.residual, model.jacobian, codes.shape[0], model.r, model.four)
                missed = max(missed, _missed(model, i, steps[i]))
            elif abs(room[i]) >= _LEAST_END:  # the axis bends too much to be followed
                missed = np.inf
    return missed


@inlined
def _bend(model: Expansion) -> None:
    """Fill C, and transform second derivatives to the bent axes.

    A change along axis m cancels what displacements along two other axes do to the residuals, if
    these determine it, as in a bent valley. The effect of an axis on itself, as near folds, stays.
    """
    by_r, bent_r, by_p, bent_p = model.by_r, model.bent_r, model.by_p, model.bent_p
    axes, bends, bent_s = model.axes, model.bends, model.bent_s
    for m in range(3):
        size = 0.0
        for a in range(by_r.shape[0]):
            size += by_r[a, m] ** 2
        if size < _DETERMINED:
            continue
        for i in range(3):
            for q in range(3):
                if m not in (i, q):
                    for a in range(by_r.shape[0]):
                        bends[m, i, q] -= by_r[a, m] * bent_r[a, i, q] / size
    for m in range(3):
        for i in range(3):
            for q in range(3):
                bent_s[i, q] += axes[0, m] * bends[m, i, q]
                for a in range(by_r.shape[0]):
                    bent_r[a, i, q] += by_r[a, m] * bends[m, i, q]
                for a in range(3):
                    bent_p[a, i, q] += by_p[a, m] * bends[m, i, q]


@inlined
def without_friction(four: Array, three: Array) -> None:
    """Copy derivatives with respect to x (n, 4) to those with respect to ξ (n, 3)."""
    for a in range(four.shape[0]):
        three[a, 0], three[a, 1], three[a, 2] = four[a, 0], four[a, 2], four[a, 3]


@inlined
def _even(model: Expansion) -> None:
    """Make second derivatives symmetric."""
    bent_r, bent_p = model.bent_r, model.bent_p
    for i in range(3):
        for q in range(i):
            for a in range(bent_r.shape[0]):
                bent_r[a, i, q] = bent_r[a, q, i] = 0.5 * (bent_r[a, i, q] + bent_r[a, q, i])
            for a in range(3):
                bent_p[a, i, q] = bent_p[a, q, i] = 0.5 * (bent_p[a, i, q] + bent_p[a, q, i])


@inlined
def second_order_size(model: Expansion) -> float:
    """Size of the second derivatives, in standard deviations of the channels and of the point."""
    bent_r, by_p, bent_p = model.bent_r, model.by_p, model.bent_p
    root, back, v = np.zeros((3, 3)), np.empty(3), np.empty((3, 3))
    first_order_covariance(by_p, v)
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
def first_order_covariance(by_p: Array, covariance: Array) -> None:
    """Fill A Aᵀ."""
    for a in range(3):
        for c in range(3):
            covariance[a, c] = _by_axis(by_p[a], by_p.T, c)
