"""Least-squares fits of contacts of a rod with weight; compiled.

With weight the base carries the moment p × F + μ, where μ is the change of the weight's moment
since rest, and the rod is integrated by kernels of its own (:mod:`vibrissa.rod.weight`). Contacts
are fitted by Gauss-Newton steps of limited length, damped as by Levenberg and Marquardt where one
fails. All quantities are non-dimensional.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.fitting.least_squares import channel_equations, whiten
from vibrissa.contacts.sensing.weighing import Weighing, gradients, whitened, wrench_covariance
from vibrissa.numerics import Array, IntArray, copy, inlined, kernel, solve
from vibrissa.rod import Rod, Weight, evaluate_weighted

# Iterations of a fit, and the longest step of each: of arc length (over L) and of force (over its
# own size, and over EI/L²).
_ROUNDS = 30
_LONGEST, _STRONGER, _LEAST_FORCE = 0.1, 0.5, 0.05
# A fit has ended when its step is this small, or the damping this large.
_SETTLED, _MOST_DAMPING = 1e-8, 1e8


class Aim(NamedTuple):
    """What contacts of a rod with weight are fitted to.

    Codes of channels, and of what is held; the moment of the weight at rest; whether the force
    along the whisker is unknown; and the smallest arc length.
    """

    codes: IntArray
    rest: Array
    friction: bool
    least: float


@inlined
def finite_or_zero(value: float) -> float:
    """The value, or zero if it is not finite."""
    return value if abs(value) < np.inf else 0.0


@inlined
def moment_of(value: Array, moment: Array) -> None:
    """Fill the moment (3,) for (F, p) or (F, p, μ)."""
    fx, fy, fz, px, py, pz = value[0], value[1], value[2], value[3], value[4], value[5]
    moment[0] = py * fz - pz * fy
    moment[1] = pz * fx - px * fz
    moment[2] = px * fy - py * fx
    if value.shape[0] > 6:
        for a in range(3):
            moment[a] += value[6 + a]


@inlined
def _weights_of(spread: Array, sigma: Array, weights: Array) -> None:
    """Fill weights (k, k) of a covariance, zero where it is not finite."""
    for i in range(spread.shape[0]):
        copy(spread[i], sigma[i])
    if not whitened(sigma, weights):
        for i in range(spread.shape[0]):
            for j in range(spread.shape[0]):
                weights[i, j] = 0.0


@kernel
def weigh_rows(
    how: Weighing,
    values: Array,
    measured: Array,
    effects: Array,
    own: Array,
    change: Array,
    spread: Array,
    whole: Array,
) -> None:
    """Fill the noise of channels at contacts with (F, p) or (F, p, μ), row by row.

    ``effects`` (n, 6, m) are those of shared unknowns on (F, M). Fills the weights (n, k, k) of the
    sensor alone, effects on channels (n, k, m), the covariance with these, and its weights.
    """
    k, m = how.codes.shape[0], effects.shape[2]
    moment, g, sigma = np.empty(3), np.empty((k, 6)), np.empty((k, k))
    for row in range(values.shape[0]):
        force = values[row, :3]
        moment_of(values[row], moment)
        wrench_covariance(how, force, moment, measured[row], spread[row])
        gradients(how.codes, force, moment, g)
        _weights_of(spread[row], sigma, own[row])
        for i in range(k):
            for c in range(m):
                change[row, i, c] = 0.0
                for a in range(6):
                    change[row, i, c] += g[i, a] * effects[row, a, c]
        for i in range(k):
            for j in range(k):
                for c in range(m):
                    spread[row, i, j] += change[row, i, c] * change[row, j, c]
        if m > 0:
            _weights_of(spread[row], sigma, whole[row])
        else:
            for i in range(k):
                copy(own[row, i], whole[row, i])


@inlined
def _misfit(
    aim: Aim, x: Array, value: Array, t: Array, target: Array, w: Array, r: Array, j: Array
) -> float:
    """Fill weighted differences (k,) from a target and derivatives (k, 4); return χ²."""
    k = aim.codes.shape[0]
    away, slope = np.empty(k), np.empty((k, 4))
    channel_equations(x, value, t, aim.codes, target, away, slope)
    total = whiten(w, away, slope, k, r, j)
    for i in range(k):
        r[i] = finite_or_zero(r[i])
        for c in range(4):
            j[i, c] = finite_or_zero(j[i, c])
    return total if abs(total) < np.inf else np.inf


@inlined
def _step(x: Array, r: Array, j: Array, damping: float, free: IntArray, step: Array) -> bool:
    """Fill the damped step (4,) of limited length."""
    k, n = r.shape[0], free.shape[0]
    size, normal, b = np.empty(n), np.empty((n, n)), np.empty(n)
    for p in range(n):
        total = 0.0
        for i in range(k):
            total += j[i, free[p]] ** 2
        size[p] = np.sqrt(total) if total > 0.0 else 1.0
    for p in range(n):
        b[p] = 0.0
        for i in range(k):
            b[p] -= j[i, free[p]] / size[p] * r[i]
        for q in range(n):
            normal[p, q] = damping + 1e-14 if p == q else 0.0
            for i in range(k):
                normal[p, q] += j[i, free[p]] / size[p] * (j[i, free[q]] / size[q])
    if solve(normal, b) == 0.0:
        return False
    for p in range(4):
        step[p] = 0.0
    for p in range(n):
        step[free[p]] = b[p] / size[p]
    force = np.sqrt(x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
    stronger = np.sqrt(step[1] * step[1] + step[2] * step[2] + step[3] * step[3])
    stronger /= _STRONGER * force + _LEAST_FORCE
    shorten = 1.0 / max(1.0, abs(step[0]) / _LONGEST, stronger)
    for p in range(4):
        step[p] *= shorten
    return True


@inlined
def _solve(
    rod: Rod, weight: Weight, rest: Array, x: Array, lean: Array, value: Array, t: Array
) -> None:
    """Fill (F, p, μ) (1, 9) of a contact (1, 4), and derivatives (1, 9, 4), from a direction."""
    states, slopes, turned = np.empty((1, 13)), np.empty((1, 12, 4)), np.empty((1, 12, 3))
    evaluate_weighted(rod, weight, x, lean, states, slopes, turned, 0, 1)
    for a in range(9):
        at = a if a < 6 else a + 3
        value[0, a] = states[0, at] - (0.0 if a < 6 else rest[a - 6])
        copy(slopes[0, at], t[0, a])


@kernel
def fit_weighted(
    rod: Rod,
    weight: Weight,
    aim: Aim,
    targets: Array,
    weights: Array,
    x: Array,
    values: Array,
    tangents: Array,
    leans: Array,
    misfits: Array,
    first: int,
    last: int,
) -> None:
    """Fit contacts x (n, 4), whose values, derivatives and directions at the tip are known."""
    k = aim.codes.shape[0]
    free = np.array([0, 1, 2, 3]) if aim.friction else np.array([0, 2, 3])
    r, j, other_r, other_j = np.empty(k), np.empty((k, 4)), np.empty(k), np.empty((k, 4))
    step, to, lean = np.zeros(4), np.empty((1, 4)), np.empty((1, 3))
    value, t = np.empty((1, 9)), np.empty((1, 9, 4))
    for row in range(first, last):
        target, w = targets[row], weights[row]
        misfits[row] = _misfit(aim, x[row], values[row], tangents[row], target, w, r, j)
        damping, rounds, busy = 0.0, 0, misfits[row] < np.inf
        while busy and rounds < _ROUNDS:
            rounds += 1
            if not _step(x[row], r, j, damping, free, step):
                damping = 10.0 * damping + 1e-4
                busy = damping < _MOST_DAMPING
                continue
            largest = 0.0
            for p in range(4):
                to[0, p] = x[row, p] + step[p]
            to[0, 0] = min(max(to[0, 0], aim.least), 1.0)
            for p in range(4):
                largest = max(largest, abs(to[0, p] - x[row, p]))
            copy(leans[row], lean[0])
            _solve(rod, weight, aim.rest, to, lean, value, t)
            misfit = _misfit(aim, to[0], value[0], t[0], target, w, other_r, other_j)
            if misfit <= misfits[row] * (1.0 + 1e-12) + 1e-24:
                misfits[row] = misfit
                copy(to[0], x[row])
                copy(value[0], values[row])
                copy(lean[0], leans[row])
                for a in range(9):
                    copy(t[0, a], tangents[row, a])
                for i in range(k):
                    r[i] = other_r[i]
                    copy(other_j[i], j[i])
                damping *= 0.1
            else:
                damping = 10.0 * damping + 1e-4
            busy = largest >= _SETTLED and damping < _MOST_DAMPING
