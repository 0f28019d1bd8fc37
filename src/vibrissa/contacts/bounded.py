"""The contact of least χ² in Ω, on its boundary where noise has carried the measurement out of it.

In z = (s, ψ, λ), with bearing ψ and λ the force over the fold force f*(s, ψ),

    ξ = (s, λ f* cos ψ, λ f* sin ψ),   proximal ≤ s ≤ 1,   λ ≤ 1,

Ω is a box, so that Gauss-Newton steps, damped as Levenberg and Marquardt do where one fails, can be
confined to it: what would leave it stays on its face as long as χ² falls outward there. Where three
signals fold, det ∂T/∂ξ = 0, the damping leads to the fold itself.
"""

from __future__ import annotations

import math

import numpy as np

from vibrissa.contacts.fitting import channel_equations, whiten
from vibrissa.numerics import Array, IntArray, copy, inlined, kernel, solve3
from vibrissa.rod import (
    BUFFER_SIZE,
    Fold,
    Rod,
    fold_force,
    integrate,
    lane_value,
    lanes_tangents,
    set_all_lanes,
)

_ROUNDS = 40
_MOST_DAMPING = 1e8
# A step that promises less of χ² (as a share of it, and by itself) is not taken.
_IDLE, _LITTLE = 1e-7, 1e-10
# The longest steps of s, ψ and λ.
_LONGEST = (0.1, 0.5, 0.25)
# The chart knows the fold to a part in a million: as near to it contacts are still stable.
_MOST_LOAD = 1.0 - 1e-5
# Steps for derivatives of the fold force, which is smooth.
_SMALL = 1e-5


@inlined
def _contact(fold: Fold, z: Array, x: Array, frame: Array) -> None:
    """Fill the contact x (4,) at z, and ∂x/∂z (4, 3)."""
    s, psi, load = z[0], z[1], z[2]
    cos, sin, force = math.cos(psi), math.sin(psi), fold_force(fold, s, psi)
    by_s = fold_force(fold, s + _SMALL, psi) - fold_force(fold, s - _SMALL, psi)
    by_psi = fold_force(fold, s, psi + _SMALL) - fold_force(fold, s, psi - _SMALL)
    by_s, by_psi = by_s / (2.0 * _SMALL), by_psi / (2.0 * _SMALL)
    x[0], x[1], x[2], x[3] = s, 0.0, load * force * cos, load * force * sin
    for a in range(4):
        for p in range(3):
            frame[a, p] = 0.0
    frame[0, 0] = 1.0
    frame[2, 0], frame[3, 0] = load * by_s * cos, load * by_s * sin
    frame[2, 1], frame[3, 1] = (
        load * (by_psi * cos - force * sin),
        load * (by_psi * sin + force * cos),
    )
    frame[2, 2], frame[3, 2] = force * cos, force * sin


@inlined
def _confine(fold: Fold, proximal: float, z: Array) -> None:
    """Bring z into the box; a force that has turned round has the opposite bearing."""
    z[0] = min(max(z[0], proximal), 1.0)
    if z[2] < 0.0:
        force = fold_force(fold, z[0], z[1])
        z[1] += math.pi
        z[2] *= -force / fold_force(fold, z[0], z[1])
    z[2] = min(z[2], _MOST_LOAD)


@inlined
def _next(
    r: Array, j: Array, k: int, proximal: float, z: Array, damping: float, work: Array, step: Array
) -> float:
    """Fill a damped step within the box; χ² that it promises to gain, negative for no step."""
    a, right, back = work[:3], work[3], work[4]
    fixed = np.zeros(3, np.bool_)
    for _ in range(3):
        for p in range(3):
            right[p] = 0.0
            for i in range(k):
                right[p] -= j[i, p] * r[i]
            for q in range(3):
                a[p, q] = 0.0
                for i in range(k):
                    a[p, q] += j[i, p] * j[i, q]
            a[p, p] *= 1.0 + damping
            back[p] = right[p]
        for p in range(3):
            if fixed[p] or a[p, p] == 0.0:
                for q in range(3):
                    a[p, q] = a[q, p] = 0.0
                a[p, p], right[p] = 1.0, 0.0
        size = a[0, 0] * a[1, 1] * a[2, 2]
        if not abs(solve3(a, right, step)) > 1e-14 * size:
            return -1.0
        leaves_s = (z[0] >= 1.0 and step[0] > 0.0) or (z[0] <= proximal and step[0] < 0.0)
        leaves_load = z[2] >= _MOST_LOAD and step[2] > 0.0
        if not (leaves_s or leaves_load):
            break
        fixed[0] = fixed[0] or leaves_s
        fixed[2] = fixed[2] or leaves_load
    gain = 0.0
    for p in range(3):
        gain += back[p] * step[p]
    return gain


@kernel
def fit_within(
    rod: Rod,
    fold: Fold,
    proximal: float,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    value: Array,
    tangents: Array,
) -> float:
    """Find the contact of least χ² in Ω, downhill from another."""
    b, k = np.zeros(BUFFER_SIZE), codes.shape[0]
    z, to, step = np.empty(3), np.empty(3), np.zeros(3)
    at, frame, work = np.empty(4), np.empty((4, 3)), np.empty((5, 3))
    v, t = np.empty(6), np.zeros((6, 4))
    residual, jacobian = np.empty(k), np.empty((k, 4))
    trial_r, trial_j, r, j = np.empty(k), np.empty((k, 4)), np.empty(k), np.empty((k, 3))
    to[0], to[1] = x[0], math.atan2(x[3], x[2])
    to[2] = math.hypot(x[2], x[3]) / fold_force(fold, to[0], to[1])
    best, damping = np.inf, 0.0
    for _ in range(_ROUNDS):
        _confine(fold, proximal, to)
        _contact(fold, to, at, frame)
        set_all_lanes(b, at[0], at[1], at[2], at[3])
        integrate(rod, b, 1)
        lane_value(b, 0, v)
        lanes_tangents(b, t)
        channel_equations(at, v, t, codes, target, residual, jacobian)
        misfit = whiten(weights, residual, jacobian, k, trial_r, trial_j)
        if misfit < best:
            best, damping = misfit, 0.0 if damping < 1e-5 else 0.1 * damping
            copy(to, z)
            copy(at, x)
            copy(v, value)
            copy(trial_r, r)
            for a in range(6):
                copy(t[a], tangents[a])
            for i in range(k):
                for p in range(3):
                    j[i, p] = 0.0
                    for a in range(4):
                        j[i, p] += trial_j[i, a] * frame[a, p]
        elif best == np.inf:
            return best
        else:
            damping = max(10.0 * damping, 1e-2)
        gain = _next(r, j, k, proximal, z, damping, work, step)
        while gain < 0.0 and damping <= _MOST_DAMPING:
            damping = max(10.0 * damping, 1e-8)
            gain = _next(r, j, k, proximal, z, damping, work, step)
        if gain <= _IDLE * best + _LITTLE or damping > _MOST_DAMPING:
            break
        shorten = 1.0
        for p in range(3):
            shorten = min(shorten, _LONGEST[p] / max(abs(step[p]), 1e-300))
        for p in range(3):
            to[p] = z[p] + shorten * step[p]
    return best
