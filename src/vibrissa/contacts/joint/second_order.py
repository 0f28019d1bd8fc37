"""Shared unknowns of fitted contacts, and their covariances to second order; compiled.

The mathematics is that of :mod:`~vibrissa.contacts.joint.joint_fit`. With n unknowns of a contact,
m shared ones and k channels, a contact has r = k + m residuals, and one more with a prior of the
friction ratio; u = n + m unknowns in all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.fitting.least_squares import ratio_slopes
from vibrissa.contacts.joint.weighted_fit import finite_or_zero
from vibrissa.numerics import AnyArray, Array, IntArray, inlined, kernel, solve, wrapped
from vibrissa.signals import FD, MD, signal_equations

# Displacement along each axis for the second order, in standard deviations. Limits of a valid
# covariance: difference of the channels there from the second order, in standard deviations;
# kurtosis relative to a normal distribution's; and effective share of the cloud. Below the last
# share the covariance is that of the first order.
_REACH = 2.0
_MISSED, _TAILED, _COUNTING, _TOO_FEW = 0.03, 1.8, 0.3, 0.1
# Longest axis of the arc length, over L (and of the force, 1), and largest curvature of the log
# density along an axis.
_LONGEST, _SHARP = 0.25, 2.0
# Largest gain of the cloud's log density over that of a normal distribution.
_MOST_GAIN = 3.0
#: Share of the largest singular value below which one counts as zero.
SINGULAR = 1e-9
_SINGULAR = 1e-12  # the same of a covariance's eigenvalues


class Unknowns(NamedTuple):
    """Codes of the channels, unknowns of the contact, least arc length, and σ of the ratio."""

    codes: IntArray
    free: IntArray
    least: float
    ratio_sigma: float


@inlined
def _product(w: Array, v: Array, out: Array) -> None:
    """Fill out = W v."""
    for i in range(w.shape[0]):
        out[i] = 0.0
        for j in range(v.shape[0]):
            out[i] += w[i, j] * v[j]


@kernel
def join_rows(
    how: Unknowns,
    targets: Array,
    x: Array,
    values: Array,
    tangents: Array,
    noise: tuple[Array, Array, Array],
    moved: Array,
    misfit: Array,
    residuals: Array,
    design: Array,
    point: Array,
) -> None:
    """Fill χ² (n,), residuals (n, r), their derivatives (n, r, u) and the point's (n, 3, u).

    ``noise`` is the sensor's weights (n, k, k), effects of shared unknowns on channels (n, k, m),
    and weights with these; ``moved`` (n, 6, m) are effects on (F, p), which is moved by them.
    """
    own, change, whole = noise
    codes, free = how.codes, how.free
    k, n, m = codes.shape[0], free.shape[0], moved.shape[2]
    channel, slope, away = np.empty(k), np.empty((k, 4)), np.empty(k)
    residual, left, c, by_ratio = np.empty(k), np.empty(k), np.empty(m), np.empty(4)
    for row in range(x.shape[0]):
        signal_equations(0.0, values[row], tangents[row], True, codes, channel, slope)
        for i in range(k):
            away[i] = targets[row, i] - channel[i]
            if codes[i] in (FD, MD):
                away[i] = wrapped(away[i])
        _product(whole[row], away, residual)
        misfit[row] = 0.0
        for i in range(k):
            misfit[row] += residual[i] ** 2
        for a in range(m):
            c[a] = 0.0
            for i in range(k):
                for j in range(k):
                    c[a] += whole[row, i, j] * change[row, j, a] * residual[i]
        for i in range(k):
            for a in range(m):
                away[i] -= change[row, i, a] * c[a]
        _product(own[row], away, left)
        for i in range(k):
            residuals[row, i] = -left[i]
            for p in range(n + m):
                design[row, i, p] = 0.0
                for j in range(k):
                    by = slope[j, free[p]] if p < n else change[row, j, p - n]
                    design[row, i, p] += own[row, i, j] * by
        for a in range(m):
            residuals[row, k + a] = c[a]
            for p in range(n + m):
                design[row, k + a, p] = 1.0 if p == n + a else 0.0
        if how.ratio_sigma < np.inf:
            residuals[row, k + m] = ratio_slopes(x[row], by_ratio) / how.ratio_sigma
            for p in range(n + m):
                by = by_ratio[free[p]] if p < n else 0.0
                design[row, k + m, p] = by / how.ratio_sigma
        for a in range(6):
            for b in range(m):
                values[row, a] += finite_or_zero(moved[row, a, b]) * finite_or_zero(c[b])
        for a in range(3):
            for p in range(n):
                point[row, a, p] = tangents[row, 3 + a, free[p]]
            for b in range(m):
                point[row, a, n + b] = finite_or_zero(moved[row, 3 + a, b])


@kernel
def displace_rows(
    how: Unknowns,
    x: Array,
    design: Array,
    point: Array,
    axes: Array,
    steps: Array,
    there: Array,
    first: Array,
    known: AnyArray,
) -> None:
    """Fill principal axes (n, u, u) in columns, and contacts (n, u, 4) displaced along them.

    Fill also the displacements (n, u), the covariances (n, 3, 3) to first order, and whether the
    unknowns are determined.
    """
    free = how.free
    r, u, n = design.shape[1], axes.shape[1], free.shape[0]
    clean, across = np.empty((r, u)), np.empty(3)
    for row in range(x.shape[0]):
        for i in range(r):
            for p in range(u):
                clean[i, p] = finite_or_zero(design[row, i, p])
        _, singular, v = np.linalg.svd(clean, False)
        known[row] = singular[-1] > SINGULAR * singular[0] and r >= u
        first[row] = 0.0
        for a in range(singular.shape[0]):
            for i in range(3):
                across[i] = 0.0
                for p in range(u):
                    across[i] += point[row, i, p] * v[a, p]
            inverse = 1.0 / singular[a] if singular[a] > SINGULAR * singular[0] else 0.0
            for i in range(3):
                for j in range(3):
                    first[row, i, j] += across[i] * inverse * (across[j] * inverse)
        force = np.sqrt(x[row, 1] ** 2 + x[row, 2] ** 2 + x[row, 3] ** 2)
        for a in range(u):
            stronger, step = 0.0, 0.0
            for p in range(u):
                axes[row, p, a] = v[a, p] / singular[a] if known[row] else 0.0
                if 0 < p < n:
                    stronger += axes[row, p, a] ** 2
            longest = max(1.0, abs(axes[row, 0, a]) / _LONGEST, np.sqrt(stronger) / force)
            for p in range(u):
                axes[row, p, a] /= longest
            along = axes[row, 0, a]
            if along != 0.0:
                up, down = (1.0 - x[row, 0]) / abs(along), (x[row, 0] - how.least) / abs(along)
                if along < 0.0:
                    up, down = down, up
                up, down = min(up, _REACH), min(down, _REACH)
                step = up if up >= down else -down
            else:
                step = _REACH
            steps[row, a] = step
            for p in range(4):
                there[row, a, p] = x[row, p]
            for p in range(n):
                there[row, a, free[p]] += step * axes[row, p, a]


@inlined
def _slopes(
    how: Unknowns, weights: Array, value: Array, t: Array, x: Array, channel: Array, out: Array
) -> None:
    """Fill channels (k,), and derivatives by x of the point, the friction angle and channels."""
    k, free = how.codes.shape[0], how.free
    n = free.shape[0]
    slope, by = np.empty((k, 4)), np.empty(4)
    signal_equations(0.0, value, t, True, how.codes, channel, slope)
    first = out.shape[0] - k
    for p in range(n):
        for a in range(3):
            out[a, p] = t[3 + a, free[p]]
        for i in range(k):
            out[first + i, p] = 0.0
            for j in range(k):
                out[first + i, p] += weights[i, j] * slope[j, free[p]]
    if n == 4:
        ratio = ratio_slopes(x, by)
        for p in range(4):
            out[3, p] = by[p] / (1.0 + ratio * ratio)


@inlined
def _bend(
    how: Unknowns,
    weights: Array,
    axes: Array,
    steps: Array,
    here: tuple[Array, Array, Array],
    there: tuple[Array, Array, Array],
    changes: Array,
    second: Array,
) -> float:
    """Fill changes of derivatives along axes, and second derivatives (q, u, u); channels' error."""
    k, u = how.codes.shape[0], axes.shape[1]
    q, n = changes.shape[1], changes.shape[2]
    seen, other, turned, off = np.empty(k), np.empty(k), np.empty(k), np.empty(k)
    _slopes(how, weights, here[0], here[1], here[2], seen, changes[0])
    worst = 0.0
    for a in range(u):
        change, step = changes[1 + a], steps[a]
        _slopes(how, weights, there[0][a], there[1][a], there[2][a], other, change)
        for i in range(k):
            turned[i] = other[i] - seen[i]
            if how.codes[i] in (FD, MD):
                turned[i] = wrapped(turned[i])
        _product(weights, turned, off)
        total = 0.0
        for i in range(k):
            for p in range(n):
                mean = 0.5 * (changes[0, q - k + i, p] + change[q - k + i, p])
                off[i] -= step * mean * axes[p, a]
            total += off[i] ** 2
        far = np.sqrt(total) * (_REACH / abs(step)) ** 3
        worst = max(worst, far) if abs(far) < np.inf else np.inf
        for i in range(q):
            for p in range(n):
                change[i, p] = (change[i, p] - changes[0, i, p]) / step
    for i in range(q):
        for a in range(u):
            for b in range(u):
                second[i, a, b] = 0.0
                for p in range(n):
                    one, two = changes[1 + a, i, p], changes[1 + b, i, p]
                    second[i, a, b] += 0.5 * finite_or_zero(one) * axes[p, b]
                    second[i, a, b] += 0.5 * finite_or_zero(two) * axes[p, a]
    for a in range(u):
        for i in range(q):
            for p in range(n):
                changes[1 + a, i, p] = finite_or_zero(changes[1 + a, i, p])
    return worst


@inlined
def _determinant(changes: Array, u: Array, a: Array, unused: Array) -> float:
    """Determinant of the derivatives of the point (and the angle) at a displacement."""
    n = a.shape[0]
    for i in range(n):
        for p in range(n):
            a[i, p] = changes[0, i, p]
            for b in range(u.shape[0]):
                a[i, p] += u[b] * changes[1 + b, i, p]
    return solve(a, unused)


@inlined
def _displaced(by: Array, bent: Array, u: Array, i: int) -> float:
    """Change of one quantity, to second order."""
    total = 0.0
    for a in range(u.shape[0]):
        total += by[i, a] * u[a]
        for b in range(u.shape[0]):
            total += 0.5 * bent[i, a, b] * u[a] * u[b]
    return total


@inlined
def _roots(covariance: Array, root: Array) -> bool:
    """Fill rows whose products with a vector have the squared length of its distance."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += abs(covariance[i, j])
    if not total < np.inf:
        return False
    size, vectors = np.linalg.eigh(covariance)
    largest = max(abs(size[0]), abs(size[2]))
    for a in range(3):
        inverse = 1.0 / np.sqrt(size[a]) if size[a] > _SINGULAR * largest else 0.0
        for i in range(3):
            root[a, i] = inverse * vectors[i, a]
    return True


@inlined
def _fourth(root: Array, v: Array) -> float:
    """Fourth power of the distance of v."""
    total = 0.0
    for a in range(3):
        off = root[a, 0] * v[0] + root[a, 1] * v[1] + root[a, 2] * v[2]
        total += off * off
    return total * total


@inlined
def _moments(first: Array, linear: Array, points: Array, density: Array, out: Array) -> bool:
    """Fill the covariance (3, 3) of a cloud (c, 3) with density (c,); whether it is usable."""
    size, total, squares = density.shape[0], 0.0, 0.0
    for d in density:
        total += d
        squares += d * d
    total = max(total, 1e-300)
    counting = total**2 / (size * max(squares, 1e-300))
    few = not counting > _TOO_FEW
    for i in range(3):
        for j in range(3):
            out[i, j] = 0.0
            for c in range(size):
                out[i, j] += density[c] / total * points[c, i] * points[c, j]
    root = np.empty((3, 3))
    if not _roots(first if few else out, root):
        return False
    tailed, normal = 0.0, 0.0
    for c in range(size):
        tailed += density[c] / total * _fourth(root, points[c])
    if not _roots(first, root):
        return False
    for c in range(size):
        normal += _fourth(root, linear[c]) / size
    tailed /= max(normal, 1e-300)
    wider = max(tailed, 1.0) ** 0.75 / max(counting, _TOO_FEW)
    for i in range(3):
        for j in range(3):
            out[i, j] = first[i, j] + out[i, j] if few else out[i, j] * wider
    return tailed < _TAILED and counting > _COUNTING


@kernel
def cloud_rows(
    how: Unknowns,
    weights: Array,
    contacts: tuple[Array, Array, Array],
    displaced: tuple[Array, Array, Array],
    joint: tuple[Array, Array, Array],
    principal: tuple[Array, Array],
    node: Array,
    first: Array,
    covariance: Array,
    valid: AnyArray,
) -> None:
    """Fill covariances (n, 3, 3) of contact points from clouds, and whether they are valid.

    ``contacts`` and ``displaced`` are values, derivatives and x; ``joint`` residuals and the
    derivatives of these and of the points; ``principal`` axes and displacements along them.
    """
    k, n, u = how.codes.shape[0], how.free.shape[0], node.shape[1]
    number, all_r = node.shape[0], joint[0].shape[1]
    q = k + n  # with friction its angle is a row, so that those above the channels are square
    changes, second = np.empty((1 + u, q, n)), np.empty((q, u, u))
    by_r, by_p, bent_r = np.empty((all_r, u)), np.empty((3, u)), np.zeros((all_r, u, u))
    shorten, at, square, unused = np.empty(u), np.empty(u), np.empty((n, n)), np.zeros(n)
    linear, points, density = np.empty((number, 3)), np.empty((number, 3)), np.empty(number)
    none = np.zeros((3, u, u))
    for row in range(first.shape[0]):
        axes, residual = principal[0][row], joint[0][row]
        here = contacts[0][row], contacts[1][row], contacts[2][row]
        there = displaced[0][row], displaced[1][row], displaced[2][row]
        steps = principal[1][row]
        missed = _bend(how, weights[row], axes, steps, here, there, changes, second)
        misfit = 0.0
        for i in range(all_r):
            misfit += residual[i] ** 2
            for a in range(u):
                by_r[i, a] = 0.0
                for p in range(u):
                    by_r[i, a] += finite_or_zero(joint[1][row, i, p]) * axes[p, a]
                for b in range(u):
                    bent_r[i, a, b] = second[q - k + i, a, b] if i < k else 0.0
        for a in range(u):
            level, bent = 0.0, 0.0
            for i in range(all_r):
                level += by_r[i, a] ** 2 + residual[i] * bent_r[i, a, a]
                bent += bent_r[i, a, a] ** 2
            level = max(level, np.sqrt(bent))
            shorten[a] = max(level, _SHARP) ** -0.5 if level > _SHARP else 1.0
            for i in range(3):
                by_p[i, a] = 0.0
                for p in range(u):
                    by_p[i, a] += joint[2][row, i, p] * axes[p, a]
            at[a] = 0.0
        level = _determinant(changes, at, square, unused)
        for c in range(number):
            arc, log = contacts[2][row, 0], misfit
            for a in range(u):
                at[a] = node[c, a] * shorten[a]
                arc += at[a] * axes[0, a]
                log += node[c, a] ** 2
            for i in range(all_r):
                log -= (residual[i] + _displaced(by_r, bent_r, at, i)) ** 2
            det = _determinant(changes, at, square, unused) / level
            det = abs(det) if n == 4 else max(det, 0.0)
            det *= np.exp(min(max(0.5 * log, -700.0), _MOST_GAIN))
            outside = arc < how.least or arc > 1.0
            density[c] = 0.0 if outside else finite_or_zero(det)
            for i in range(3):
                linear[c, i] = _displaced(by_p, none, at, i)
                points[c, i] = _displaced(by_p, second, at, i)
        fair = _moments(first[row], linear, points, density, covariance[row])
        valid[row] = valid[row] and fair and missed < _MISSED
