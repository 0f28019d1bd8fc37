"""Contacts that explain measured signals best: weighted least squares, four contacts side by side.

A contact has the unknowns x = (s, f_x, f_y, f_z), or without friction (s, f_y, f_z), and gives
channels c(x): signals, or components of force and moment. Measured channels c̃ with covariance
Σ = (WᵀW)⁻¹ are explained best where

    χ²(x) = |W (c(x) - c̃)|²

is least: Gauss-Newton steps with the exact Jacobian of the rod, damped as Levenberg and Marquardt
do where one fails. The contact may not leave the whisker: at the tip (and at the smallest arc
length considered) only the force is free. Everything is non-dimensional.

Without friction a fit may also be kept within Ω, on its boundary where noise has carried the
measurement out of it. In z = (s, ψ, λ), with bearing ψ and λ the force over the fold force
f*(s, ψ),

    ξ = (s, λ f* cos ψ, λ f* sin ψ),   proximal ≤ s ≤ 1,   λ ≤ 1,

Ω is a box, to which steps can be confined: what would leave it stays on its face as long as χ²
falls outward there. Where three signals fold, det ∂T/∂ξ = 0, the damping leads to the fold itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.channels import FITTED, RATIO, channel_derivatives
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    cholesky,
    copy,
    inlined,
    kernel,
    share_out,
    solve3,
    wrapped,
)
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    Discretization,
    Fold,
    Rod,
    StableSet,
    fold_force,
    integrate,
    lane_tangents,
    lane_value,
    lanes_tangents,
    point_determinant,
    set_all_lanes,
    set_lane,
    stable,
)
from vibrissa.signals import FD, MD, signal_equations

# Some valleys of χ² are narrow and bent: most fits take 5 rounds, but a few a hundred. What is not
# at rest after so many goes on only if it may still count.
_ROUNDS = 15
_TIMES = 8
# A step this small, relative to the length and to the force, is the last, and taken to first order;
# a damped one only if it is smaller still.
_LAST = 1e-6
_SMALL = 1e-9
# So is one that promises to lower χ² by no more than this share of it.
_IDLE = 1e-8
_LONGEST = 0.1
_MOST_DAMPING = 1e8
_ROUNDS_WITHIN = 100
# A step that promises less of χ² (as a share of it, and by itself) is not taken.
_IDLE_WITHIN, _LITTLE = 1e-7, 1e-10
# Nor is one that promises less of what χ² is above what counts.
_SLOW = 0.05
# Where a fit within Ω ends χ² must be level in each unknown by itself: what that could still gain
# is at most the square of this.
_LEVEL = 0.03
# The longest steps of s, ψ and λ.
_LONGEST_WITHIN = (0.1, 0.5, 0.25)
# The chart knows the fold to a part in a million: as near to it contacts are still stable.
_MOST_LOAD = 1.0 - 1e-5
# Steps for derivatives of the fold force, which is smooth.
_NUDGE = 1e-5


class Fits(NamedTuple):
    """Row by row: x (n, 4), (F, p) (n, 6), ∂(F, p)/∂x (n, 6, 4), χ² (n,), whether at rest (n,)."""

    contacts: Array
    values: Array
    tangents: Array
    misfits: Array
    converged: AnyArray


@inlined
def channel_equations(
    x: Array,
    v: Array,
    t: Array,
    codes: IntArray,
    targets: Array,
    residual: Array,
    jacobian: Array,
) -> None:
    """Channels of x and (F, p) minus targets (k,), and their derivatives by x (k, 4)."""
    signal_equations(x[0], v, t, True, codes, residual, jacobian)
    for k in range(codes.shape[0]):
        if codes[k] == RATIO:
            normal = np.sqrt(x[2] * x[2] + x[3] * x[3])
            residual[k] = x[1] / normal
            jacobian[k, 0], jacobian[k, 1] = 0.0, 1.0 / normal
            jacobian[k, 2], jacobian[k, 3] = -x[1] * x[2] / normal**3, -x[1] * x[3] / normal**3
        residual[k] -= targets[k]
        if codes[k] in (FD, MD):
            residual[k] = wrapped(residual[k])


@inlined
def whiten(w: Array, residual: Array, jacobian: Array, k: int, r: Array, j: Array) -> float:
    """Fill r = W residual, j = W jacobian; return |r|²."""
    total = 0.0
    for a in range(k):
        r[a] = 0.0
        for c in range(4):
            j[a, c] = 0.0
        for b in range(k):
            r[a] += w[a, b] * residual[b]
            for c in range(4):
                j[a, c] += w[a, b] * jacobian[b, c]
        total += r[a] * r[a]
    return float(total)


@inlined
def _damped_step(
    r: Array, j: Array, k: int, damping: float, fixed: Array, a: Array, step: Array
) -> bool:
    """Solve (jᵀj + damping diag) step = -jᵀr over the unknowns that are not fixed, by Cholesky."""
    for p in range(4):
        for q in range(p + 1):
            total = 0.0
            for i in range(k):
                total += j[i, p] * j[i, q]
            a[p, q] = 0.0 if fixed[p] + fixed[q] > 0.0 else total
        if fixed[p] > 0.0:
            a[p, p] = 1.0
        else:
            a[p, p] *= 1.0 + damping
        total = 0.0
        for i in range(k):
            total -= j[i, p] * r[i]
        step[p] = 0.0 if fixed[p] > 0.0 else total
    if not cholesky(a, a):
        return False
    for p in range(4):
        for i in range(p):
            step[p] -= a[p, i] * step[i]
        step[p] /= a[p, p]
    for p in range(3, -1, -1):
        for i in range(p + 1, 4):
            step[p] -= a[i, p] * step[i]
        step[p] /= a[p, p]
    return True


@inlined
def _next(
    x: Array, r: Array, j: Array, k: int, damping: float, least: float, free: bool, work: Array
) -> float:
    """Fill row 6 of the work with x after a damped step; return its relative size, or -1.

    The size is 0 where the step would gain nothing.
    """
    a, fixed, step, to = work[:4], work[4], work[5], work[6]
    for p in range(4):
        fixed[p] = 0.0
    if not free:
        fixed[1] = 1.0
    if not _damped_step(r, j, k, damping, fixed, a, step):
        return -1.0
    if (x[0] >= 1.0 and step[0] > 0.0) or (x[0] <= least and step[0] < 0.0):
        fixed[0] = 1.0
        if not _damped_step(r, j, k, damping, fixed, a, step):
            return -1.0
    force = np.sqrt(x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
    change = np.sqrt(step[1] * step[1] + step[2] * step[2] + step[3] * step[3])
    size = max(abs(step[0]), change / force)
    shorten = 1.0 / max(abs(step[0]) / _LONGEST, change / (0.5 * force), 1.0)
    for p in range(4):
        to[p] = x[p] + shorten * step[p]
    to[0] = min(max(to[0], least), 1.0)
    total, gain = 0.0, 0.0
    for i in range(k):
        total += r[i] * r[i]
        for p in range(4):
            gain -= r[i] * j[i, p] * step[p]
    return 0.0 if gain <= _IDLE * total else float(size)


@inlined
def _finish(
    x: Array, value: Array, t: Array, r: Array, j: Array, k: int, step: Array, to: Array
) -> float:
    """Take a step to first order: x becomes ``to``; return χ² there."""
    for p in range(4):
        step[p] = to[p] - x[p]
        x[p] = to[p]
    for a in range(6):
        for p in range(4):
            value[a] += t[a, p] * step[p]
    total = 0.0
    for i in range(k):
        away = r[i]
        for p in range(4):
            away += j[i, p] * step[p]
        total += away * away
    return float(total)


@inlined
def lane_contact(b: Array, lane: int, friction: bool, value: Array, t: Array, third: Array) -> None:
    """Copy (F, p) and ∂(F, p)/∂x (6, 4) of a contact; with friction of its two lanes."""
    lane_value(b, lane, value)
    lane_tangents(b, lane, third)
    for a in range(6):
        t[a, 0], t[a, 1], t[a, 2], t[a, 3] = third[a, 0], 0.0, third[a, 1], third[a, 2]
    if friction:
        lane_tangents(b, lane + 1, third)
        for a in range(6):
            t[a, 1] = third[a, 0]


@inlined
def _integrate_active(rod: Rod, b: Array, to: Array, n: int, lanes: int, active: AnyArray) -> int:
    """Integrate n contacts, ``lanes`` lanes each; how many are active, -1 if one by itself."""
    number, only = 0, 0
    for i in range(n):
        if active[i]:
            number, only = number + 1, i
    if number == 0:
        return 0
    if number == 1:  # its tangents side by side
        set_all_lanes(b, to[only, 0], to[only, 1], to[only, 2], to[only, 3])
    else:
        for i in range(LANES):
            c = to[min(i // lanes, n - 1)]
            set_lane(b, i, c[0], c[1], c[2], c[3], i % lanes == 1)
    integrate(rod, b, 1 if number == 1 else 3)
    return -1 if number == 1 else number


@kernel
def fit_rows(
    rod: Rod,
    free: bool,
    least: float,
    codes: IntArray,
    targets: Array,
    weights: Array,
    fits: Fits,
    first: int,
    last: int,
) -> None:
    """Fit contacts for some rows, four side by side (two with friction)."""
    contacts, values, tangents, misfits, converged = fits
    b, k = np.zeros(BUFFER_SIZE), codes.shape[0]
    value, t, third = np.empty(6), np.zeros((6, 4)), np.empty((6, 3))
    residual, jacobian = np.empty(k), np.empty((k, 4))
    trial_r, trial_j = np.empty(k), np.empty((k, 4))
    r, j = np.empty((LANES, k)), np.empty((LANES, k, 4))
    to, work = np.empty((LANES, 4)), np.empty((7, 4))
    damping, active = np.empty(LANES), np.zeros(LANES, np.bool_)
    # With friction a contact takes two lanes: their tangents differ in the first unknown.
    lanes = 2 if free else 1
    for row in range(first, last, LANES // lanes):
        n = min(LANES // lanes, last - row)
        for i in range(n):
            copy(contacts[row + i], to[i])
            damping[i], active[i] = 0.0, True
            misfits[row + i], converged[row + i] = np.inf, False
        for _ in range(_ROUNDS):
            number = _integrate_active(rod, b, to, n, lanes, active)
            if number == 0:
                break
            for i in range(n):
                if not active[i]:
                    continue
                at = row + i
                if number < 0:
                    lane_value(b, 0, value)
                    lanes_tangents(b, t)
                    for a in range(0 if free else 6):
                        t[a, 1] = 0.0
                else:
                    lane_contact(b, lanes * i, free, value, t, third)
                channel_equations(to[i], value, t, codes, targets[at], residual, jacobian)
                misfit = whiten(weights[at], residual, jacobian, k, trial_r, trial_j)
                if misfit < misfits[at]:
                    damping[i] = 0.0 if damping[i] < 1e-5 else 0.1 * damping[i]
                    misfits[at] = misfit
                    copy(to[i], contacts[at])
                    copy(value, values[at])
                    for a in range(6):
                        copy(t[a], tangents[at, a])
                    for a in range(k):
                        r[i, a] = trial_r[a]
                        copy(trial_j[a], j[i, a])
                elif misfits[at] == np.inf:
                    active[i] = False
                    continue
                else:
                    damping[i] = max(10.0 * damping[i], 1e-2)
                size = _next(contacts[at], r[i], j[i], k, damping[i], least, free, work)
                while size < 0.0 and damping[i] <= _MOST_DAMPING:
                    damping[i] = max(10.0 * damping[i], 1e-8)
                    size = _next(contacts[at], r[i], j[i], k, damping[i], least, free, work)
                active[i] = size >= 0.0
                if size > (_LAST if damping[i] == 0.0 else _SMALL):
                    copy(work[6], to[i])
                elif active[i]:
                    misfits[at] = _finish(
                        contacts[at], values[at], tangents[at], r[i], j[i], k, work[5], work[6]
                    )
                    converged[at], active[i] = True, False


@kernel
def _charted(
    fold: Fold,
    proximal: float,
    contacts: Array,
    tangents: Array,
    found: AnyArray,
    first: int,
    last: int,
) -> None:
    xi, by_xi = np.empty(3), np.empty((6, 3))
    for row in range(first, last):
        xi[0], xi[1], xi[2] = contacts[row, 0], contacts[row, 2], contacts[row, 3]
        for a in range(6):
            t = tangents[row, a]
            by_xi[a, 0], by_xi[a, 1], by_xi[a, 2] = t[0], t[2], t[3]
        found[row] = stable(fold, proximal, xi, point_determinant(by_xi))


def charted(chart: StableSet, fits: Fits, proximal: float) -> AnyArray:
    """Whether fits without friction are stable contacts beyond an arc length, (n,)."""
    found = np.zeros(len(fits.contacts), np.bool_)
    share_out(
        len(found),
        lambda first, last: _charted(
            chart.fold, proximal, fits.contacts, fits.tangents, found, first, last
        ),
    )
    return found


def fit(
    discretization: Discretization,
    channels: tuple[str, ...],
    targets: Array,
    weights: Array,
    contacts: Array,
    *,
    friction: bool,
    least: float,
    worth: float = np.inf,
) -> Fits:
    """Fit contacts to measured channels."""
    out = _once(discretization, channels, targets, weights, contacts, friction, least)
    for _ in range(_TIMES):
        slow = np.flatnonzero(~out.converged & (out.misfits <= worth))
        if not slow.size:
            break
        further = _once(
            discretization,
            channels,
            targets[slow],
            weights[slow],
            out.contacts[slow],
            friction,
            least,
        )
        for mine, theirs in zip(out, further, strict=True):
            mine[slow] = theirs
    return out


def _once(
    discretization: Discretization,
    channels: tuple[str, ...],
    targets: Array,
    weights: Array,
    contacts: Array,
    friction: bool,
    least: float,
) -> Fits:
    n = len(targets)
    out = Fits(
        np.array(contacts, dtype=np.float64),
        np.full((n, 6), np.nan),
        np.zeros((n, 6, 4)),
        np.full(n, np.inf),
        np.zeros(n, np.bool_),
    )
    codes = np.array([FITTED.index(name) for name in channels])
    rod = discretization.rod
    targets, weights = np.ascontiguousarray(targets), np.ascontiguousarray(weights)
    share_out(
        n,
        lambda first, last: fit_rows(
            rod, friction, least, codes, targets, weights, out, first, last
        ),
    )
    return out


@inlined
def _contact(fold: Fold, z: Array, x: Array, frame: Array) -> None:
    """Fill the contact x (4,) at z, and ∂x/∂z (4, 3)."""
    s, psi, load = z[0], z[1], z[2]
    cos, sin, force = math.cos(psi), math.sin(psi), fold_force(fold, s, psi)
    by_s = fold_force(fold, s + _NUDGE, psi) - fold_force(fold, s - _NUDGE, psi)
    by_psi = fold_force(fold, s, psi + _NUDGE) - fold_force(fold, s, psi - _NUDGE)
    by_s, by_psi = by_s / (2.0 * _NUDGE), by_psi / (2.0 * _NUDGE)
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
def _next_within(
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


@inlined
def _level(r: Array, j: Array, k: int, proximal: float, z: Array) -> bool:
    """Whether χ² falls nowhere but out of the box."""
    for p in range(3):
        slope, size = 0.0, 0.0
        for i in range(k):
            slope += j[i, p] * r[i]
            size += j[i, p] * j[i, p]
        outward = (p == 0 and z[0] >= 1.0) or (p == 2 and z[2] >= _MOST_LOAD)
        if (outward and slope < 0.0) or (p == 0 and z[0] <= proximal and slope > 0.0):
            continue
        if slope * slope > _LEVEL * _LEVEL * size:
            return False
    return True


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
    worth: float,
) -> tuple[float, bool]:
    """Find the contact of least χ² in Ω, downhill from another; given up if above ``worth``.

    Return χ², and whether it is a least one.
    """
    b, k = np.zeros(BUFFER_SIZE), codes.shape[0]
    z, to, step = np.empty(3), np.empty(3), np.zeros(3)
    at, frame, work = np.empty(4), np.empty((4, 3)), np.empty((5, 3))
    v, t = np.empty(6), np.zeros((6, 4))
    residual, jacobian = np.empty(k), np.empty((k, 4))
    trial_r, trial_j, r, j = np.empty(k), np.empty((k, 4)), np.empty(k), np.empty((k, 3))
    to[0], to[1] = x[0], math.atan2(x[3], x[2])
    to[2] = math.hypot(x[2], x[3]) / fold_force(fold, to[0], to[1])
    best, damping = np.inf, 0.0
    for _ in range(_ROUNDS_WITHIN):
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
            return best, False
        else:
            damping = max(10.0 * damping, 1e-2)
        gain = _next_within(r, j, k, proximal, z, damping, work, step)
        while gain < 0.0 and damping <= _MOST_DAMPING:
            damping = max(10.0 * damping, 1e-8)
            gain = _next_within(r, j, k, proximal, z, damping, work, step)
        if gain <= _IDLE_WITHIN * best + _LITTLE or damping > _MOST_DAMPING:
            return best, _level(r, j, k, proximal, z)
        if gain < _SLOW * (best - worth):
            break
        shorten = 1.0
        for p in range(3):
            shorten = min(shorten, _LONGEST_WITHIN[p] / max(abs(step[p]), 1e-300))
        for p in range(3):
            to[p] = z[p] + shorten * step[p]
    return best, False


def unknowns_covariance(
    names: tuple[str, ...], values: Array, tangents: Array, weights: Array, *, friction: bool
) -> Array:
    """Covariances of x, (n, 4, 4): (JᵀΣ⁻¹J)⁻¹; NaN where the channels do not determine x."""
    free = [0, 1, 2, 3] if friction else [0, 2, 3]
    j = weights @ channel_derivatives(values, tangents[..., free], names)
    out = np.zeros((len(values), 4, 4))
    usable: AnyArray = np.asarray(np.isfinite(j).all(axis=(1, 2)))
    size = np.where(
        usable[:, None], np.linalg.norm(np.where(usable[:, None, None], j, 1.0), axis=1), 1.0
    )
    usable &= (size > 0.0).all(axis=1)
    scaled = np.where(usable[:, None, None], j / np.where(size > 0.0, size, 1.0)[:, None, :], 0.0)
    _, singular, v = np.linalg.svd(scaled, full_matrices=False)
    usable &= singular[:, -1] > 1e-10
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.swapaxes(v, -1, -2) / singular[:, None, :] / size[:, :, None]
    out[np.ix_(range(len(out)), free, free)] = root @ np.swapaxes(root, -1, -2)
    out[~usable] = np.nan
    return out
