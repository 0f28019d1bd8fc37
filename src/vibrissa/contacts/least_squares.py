"""Contacts that explain measured signals best: weighted least squares, four contacts side by side.

A contact has the unknowns x = (s, f_x, f_y, f_z), or without friction (s, f_y, f_z), and gives
channels c(x): signals, or components of force and moment. Measured channels c̃ with covariance
Σ = (WᵀW)⁻¹ are explained best where

    χ²(x) = |W (c(x) - c̃)|²

is least: Gauss-Newton steps with the exact Jacobian of the rod, damped as Levenberg and Marquardt
do where one fails. The contact may not leave the whisker: at the tip (and at the smallest arc
length considered) only the force is free. Everything is non-dimensional.

Without friction a fit may also be kept within Ω, on its boundary where noise has carried the
measurement out of it: what would leave it stays on its face, in the coordinates (s, ψ, λ) of the
chart, as long as χ² falls outward there. Elsewhere steps are straight in s and in s f, the moment
about the base, along which valleys of χ² run. Where signals fold, or valleys are bent, JᵀJ is a
poor model of χ²: what the curvature of the residuals adds to it is learnt from one contact to the
next, as NL2SOL does (J. E. Dennis, D. M. Gay, R. E. Welsch, *An adaptive nonlinear least-squares
algorithm*, ACM Trans. Math. Softw. 7 (1981) 348-368).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.channels import FITTED, RATIO, channel_derivatives
from vibrissa.contacts.weighing import Weighing, weigh_any
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    cholesky,
    copy,
    inlined,
    kernel,
    share_out,
    solve_root,
    wrapped,
)
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    LEAST_ARC,
    Charted,
    Discretization,
    Fold,
    Rod,
    StableSet,
    fold_force,
    integrate,
    interpolate,
    lane_slopes,
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
_IDLE_WITHIN, _LITTLE = 1e-6, 1e-9
_IDLE_NEAR = 1e-3  # between the map's nodes, where steps are good to about that
_FIRST_ROUNDS = 4  # so many steps there before the rod is integrated
# Nor is one that, undamped or after many rounds, promises less of what χ² is above what counts.
_SLOW, _PATIENCE, _LATE = 0.05, 3, 25
# Where the slopes of a fit miss a known contact by so much (χ²), and by no more than this share of
# the fall of χ² to there, χ² falls all the way: that contact is where the fit would end.
_FORESEEN, _DOWNHILL = 1.0, 0.25
_WILD = 4.0  # where χ² rises by more than this factor contacts teach nothing of its curvature
# Where a fit within Ω ends χ² must be level in each unknown by itself: what that could still gain
# is at most the square of this.
_LEVEL = 0.03
# The longest steps of s; at the fold of ψ and λ; elsewhere of the moment, as a share of itself or
# of that of the fold.
_LONGEST_TURN, _LONGEST_FALL, _LONGEST_SHARE = 0.5, 0.25, 0.5
# The chart knows the fold to a part in a million: as near to it contacts are still stable.
_MOST_LOAD = 1.0 - 1e-5
_AT_FOLD = 1.0 - 1e-12  # what is as near to that is at the fold, whatever rounding makes of it
_NUDGE = 1e-5  # steps for derivatives of the fold force, which is smooth
_SAME = 1e-3  # contacts within this (over L, and ten times that relative to the force) are one


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
def contact_equations(
    rod: Charted, work: Array, near: bool, x: Array, value: Array, tangents: Array
) -> None:
    """Fill (F, p) and ∂(F, p)/∂x (6, 4) of a contact; between the map's nodes if ``near``.

    Where it is not on the map the rod is integrated.
    """
    if near and interpolate(rod.nodes, rod.fold, work, x, value, tangents, True):
        return
    set_all_lanes(work, x[0], x[1], x[2], x[3])
    integrate(rod.rod, work, 1)
    lane_value(work, 0, value)
    lanes_tangents(work, tangents)


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
    solve_root(a, step)
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
    lane_slopes(b, lane, t)
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
def approach(rod: Charted, how: Weighing, target: Array, measured: Array, x: Array) -> None:
    """Take the first steps of a fit without friction between the map's nodes."""
    k, best = how.codes.shape[0], np.inf
    b, value, t, weights = np.empty(BUFFER_SIZE), np.empty(6), np.zeros((6, 4)), np.zeros((k, k))
    residual, jacobian, work = np.empty(k), np.empty((k, 4)), np.empty((7, 4))
    r, j, before = np.empty(k), np.empty((k, 4)), x.copy()
    for n in range(_FIRST_ROUNDS):
        if not interpolate(rod.nodes, rod.fold, b, x, value, t, True):
            break
        if n == 0 and not weigh_any(how, value, measured, weights):
            break
        channel_equations(x, value, t, how.codes, target, residual, jacobian)
        misfit = whiten(weights, residual, jacobian, k, r, j)
        if not misfit < best:
            break
        best = misfit
        copy(x, before)
        if not _next(x, r, j, k, 0.0, LEAST_ARC, False, work) > _IDLE_NEAR:
            break
        copy(work[6], x)
    copy(before, x)


@inlined
def stable_fit(fold: Fold, proximal: float, x: Array, tangents: Array) -> bool:
    """Whether a fit without friction is stable and beyond an arc length; tangents (6, 4)."""
    xi, by_xi = np.empty(3), np.empty((6, 3))
    xi[0], xi[1], xi[2] = x[0], x[2], x[3]
    for a in range(6):
        t = tangents[a]
        by_xi[a, 0], by_xi[a, 1], by_xi[a, 2] = t[0], t[2], t[3]
    return stable(fold, proximal, xi, point_determinant(by_xi))


@kernel
def _charted(fold: Fold, proximal: float, fits: Fits, found: AnyArray) -> None:
    for row in range(found.shape[0]):
        found[row] = stable_fit(fold, proximal, fits.contacts[row], fits.tangents[row])


def charted(chart: StableSet, fits: Fits, proximal: float) -> AnyArray:
    """Whether fits without friction are stable contacts beyond an arc length, (n,)."""
    found = np.zeros(len(fits.contacts), np.bool_)
    _charted(chart.fold, proximal, fits, found)
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
def same_contact(a: Array, b: Array) -> bool:
    """Whether two contacts x (4,) are one."""
    apart = math.hypot(a[2] - b[2], a[3] - b[3])
    return bool(abs(a[0] - b[0]) < _SAME and apart < 10.0 * _SAME * math.hypot(a[2], a[3]))


@inlined
def _confine(fold: Fold, proximal: float, x: Array) -> bool:
    """Bring a contact into Ω; whether it is at the fold."""
    x[0] = min(max(x[0], proximal), 1.0)
    force = math.hypot(x[2], x[3])
    most = _MOST_LOAD * fold_force(fold, x[0], math.atan2(x[3], x[2]))
    if force < _AT_FOLD * most:
        return False
    x[2] *= most / force
    x[3] *= most / force
    return True


@inlined
def _directions(fold: Fold, x: Array, folded: bool, frame: Array) -> None:
    """Fill ∂ξ/∂z (3, 3) of the coordinates of a fit, in units of their longest steps.

    These are s and the moment; at the fold s, ψ and the share by which the force falls.
    """
    s, fy, fz = x[0], x[2], x[3]
    psi, force = math.atan2(fz, fy), math.hypot(fy, fz)
    frame[0, 0], frame[0, 1], frame[0, 2] = _LONGEST, 0.0, 0.0
    if not folded:
        most = max(_LONGEST_SHARE * force, _LONGEST_FALL * fold_force(fold, s, psi))
        frame[1, 0], frame[2, 0] = -_LONGEST * fy / s, -_LONGEST * fz / s
        frame[1, 1], frame[2, 1], frame[1, 2], frame[2, 2] = most, 0.0, 0.0, most
        return
    by_s = fold_force(fold, s + _NUDGE, psi) - fold_force(fold, s - _NUDGE, psi)
    by_psi = fold_force(fold, s, psi + _NUDGE) - fold_force(fold, s, psi - _NUDGE)
    by_s *= _LONGEST * _MOST_LOAD / (2.0 * _NUDGE * force)
    by_psi *= _LONGEST_TURN * _MOST_LOAD / (2.0 * _NUDGE * force)
    frame[1, 0], frame[2, 0] = by_s * fy, by_s * fz
    frame[1, 1] = by_psi * fy - _LONGEST_TURN * fz
    frame[2, 1] = by_psi * fz + _LONGEST_TURN * fy
    frame[1, 2], frame[2, 2] = -_LONGEST_FALL * fy, -_LONGEST_FALL * fz


@inlined
def _go(
    fold: Fold, proximal: float, x: Array, folded: bool, frame: Array, step: Array, to: Array
) -> None:
    """Fill the contact that a step in the coordinates of `_directions` leads to."""
    s = min(max(x[0] + _LONGEST * step[0], proximal), 1.0)
    to[0], to[1] = s, 0.0
    if folded:
        psi = math.atan2(x[3], x[2]) + _LONGEST_TURN * step[1]
        force = (1.0 - _LONGEST_FALL * step[2]) * _MOST_LOAD * fold_force(fold, s, psi)
        to[2], to[3] = force * math.cos(psi), force * math.sin(psi)
    else:
        for a in range(2):
            to[2 + a] = x[0] * (x[2 + a] + frame[1 + a, 1 + a] * step[1 + a]) / s


@inlined
def _normal_equations(
    r: Array, j: Array, second: Array, frame: Array, gradient: Array, normal: Array, bent: Array
) -> None:
    """Fill Jᵀr, JᵀJ, and what the curvature of the residuals adds to it, in a fit's coordinates."""
    along = np.empty((r.shape[0], 3))
    for p in range(3):
        gradient[p] = 0.0
        for i in range(r.shape[0]):
            along[i, p] = j[i, 0] * frame[0, p] + j[i, 2] * frame[1, p] + j[i, 3] * frame[2, p]
            gradient[p] += along[i, p] * r[i]
    for p in range(3):
        for q in range(p + 1):
            normal[p, q] = bent[p, q] = 0.0
            for i in range(r.shape[0]):
                normal[p, q] += along[i, p] * along[i, q]
            for a in range(3):
                for c in range(3):
                    bent[p, q] += frame[a, p] * second[a, c] * frame[c, q]
            normal[q, p], bent[q, p] = normal[p, q], bent[p, q]


@inlined
def _bend(
    second: Array, x: Array, to: Array, r: Array, j: Array, r_there: Array, j_there: Array
) -> None:
    """Update the residuals' curvature, Σ r ∂²r/∂ξ² (3, 3), by those at another contact."""
    d, rise, missed = np.empty(3), np.empty(3), np.empty(3)
    along, size, new, steep, far = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(3):
        q = p + (1 if p > 0 else 0)
        d[p], rise[p], missed[p] = to[q] - x[q], 0.0, 0.0
        for i in range(r.shape[0]):
            rise[p] += j_there[i, q] * r_there[i] - j[i, q] * r[i]
            missed[p] += (j_there[i, q] - j[i, q]) * r_there[i]
        along += rise[p] * d[p]
        new += missed[p] * d[p]
        steep += rise[p] * rise[p]
        far += d[p] * d[p]
    for p in range(3):
        for q in range(3):
            size += d[p] * second[p, q] * d[q]
    if not along * along > 1e-24 * steep * far:
        return
    share = min(abs(new / size), 1.0) if size != 0.0 else 1.0
    left = 0.0
    for p in range(3):
        for q in range(3):
            second[p, q] *= share
            missed[p] -= second[p, q] * d[q]
        left += missed[p] * d[p]
    for p in range(3):
        for q in range(3):
            second[p, q] += (missed[p] * rise[q] + rise[p] * missed[q]) / along
            second[p, q] -= left * rise[p] * rise[q] / (along * along)


@inlined
def _step_within(
    gradient: Array,
    normal: Array,
    bent: Array,
    damping: float,
    ends: tuple[bool, bool, bool],
    root: Array,
    step: Array,
) -> tuple[float, float]:
    """Fill a damped step within Ω; slope and curvature of χ²/2 along it, of which 1, 0 for none.

    ``ends`` states whether s cannot fall or rise, and whether the force cannot.
    """
    held = False
    for _ in range(2):
        for p in range(3):
            fixed = normal[p, p] == 0.0 or (p == 0 and held) or (p == 2 and ends[2])
            step[p] = 0.0 if fixed else -gradient[p]
            for q in range(p + 1):
                root[p, q] = normal[p, q] + bent[p, q]
                if fixed or normal[q, q] == 0.0 or (q == 0 and held):
                    root[p, q] = 0.0
            root[p, p] = 1.0 if fixed else root[p, p] + damping * normal[p, p]
        if not cholesky(root, root):
            return 1.0, 0.0
        solve_root(root, step)
        if held or not ((ends[0] and step[0] < 0.0) or (ends[1] and step[0] > 0.0)):
            break
        held = True
    slope, curve = 0.0, 0.0
    for p in range(3):
        slope += gradient[p] * step[p]
        for q in range(3):
            curve += step[p] * (normal[p, q] + bent[p, q]) * step[q]
    return slope, curve


@inlined
def _level(gradient: Array, normal: Array, ends: tuple[bool, bool, bool]) -> bool:
    """Whether χ² falls nowhere but out of Ω."""
    for p in range(3):
        slope = gradient[p]
        if p == 0 and ((ends[1] and slope < 0.0) or (ends[0] and slope > 0.0)):
            continue
        if not (p == 2 and ends[2]) and slope * slope > _LEVEL * _LEVEL * normal[p, p]:
            return False
    return True


@inlined
def by_slopes(x: Array, r: Array, j: Array, other: Array) -> float:
    """χ² at another contact by the slopes at one; it bends little in s and s f."""
    total, ds = 0.0, other[0] - x[0]
    dy = other[0] * (other[2] - x[2]) / x[0]
    dz = other[0] * (other[3] - x[3]) / x[0]
    for a in range(r.shape[0]):
        away = r[a] + j[a, 0] * ds + j[a, 2] * dy + j[a, 3] * dz
        total += away * away
    return total


class _Room(NamedTuple):
    """Working memory of a fit.

    The rod's buffer; weights (k, k); a contact (4,) with (F, p) and ∂(F, p)/∂x (6, 4); residuals
    and slopes of channels (k, 4), and in standard deviations, here and there; ∂ξ/∂z (3, 3),
    curvature of the residuals, JᵀJ, that curvature in z, a Cholesky factor, gradient and step.
    """

    b: Array
    weights: Array
    to: Array
    v: Array
    t: Array
    residual: Array
    jacobian: Array
    r: Array
    j: Array
    r_there: Array
    j_there: Array
    frame: Array
    second: Array
    normal: Array
    bent: Array
    root: Array
    gradient: Array
    step: Array


@kernel
def fit_within(
    rod: Charted,
    proximal: float,
    how: Weighing,
    target: Array,
    measured: Array,
    x: Array,
    value: Array,
    tangents: Array,
    worth: float,
    known: Array,
    misfits: Array,
) -> tuple[float, bool]:
    """Find the contact of least χ² in Ω, downhill from another, with the weights of that one.

    It is given up if above ``worth``. Where the way leads to a contact that is known and worth it,
    with its χ² in ``misfits``, x becomes that. Return χ², and whether it is a least one. If
    worth is limited the way is that between the map's nodes; from its end the rod is integrated.
    """
    k = how.codes.shape[0]
    room = _Room(
        np.zeros(BUFFER_SIZE),
        np.empty((k, k)),
        x.copy(),
        np.empty(6),
        np.zeros((6, 4)),
        np.empty(k),
        np.empty((k, 4)),
        np.empty(k),
        np.empty((k, 4)),
        np.empty(k),
        np.empty((k, 4)),
        np.empty((3, 3)),
        np.zeros((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
    )
    return _fit_within(
        rod, proximal, how, target, measured, x, value, tangents, worth, known, misfits, room
    )


@kernel
def _fit_within(
    rod: Charted,
    proximal: float,
    how: Weighing,
    target: Array,
    measured: Array,
    x: Array,
    value: Array,
    tangents: Array,
    worth: float,
    known: Array,
    misfits: Array,
    room: _Room,
) -> tuple[float, bool]:
    """Fit a contact; arrays made by another function are not counted at each use."""
    b, weights, to, v, t, residual, jacobian, r, j, r_there, j_there = room[:11]
    frame, second, normal, bent, root, gradient, step = room[11:]
    codes, fold = how.codes, rod.fold
    k = codes.shape[0]
    best, damping, promised, folded = np.inf, 0.0, 0.0, False
    ends, near, begun = (False, False, False), worth < np.inf, False
    for n in range(_ROUNDS_WITHIN):
        folded_there = _confine(fold, proximal, to)
        contact_equations(rod, b, near, to, v, t)
        if not begun and not weigh_any(how, v, measured, weights):
            break
        channel_equations(to, v, t, codes, target, residual, jacobian)
        misfit = whiten(weights, residual, jacobian, k, r_there, j_there)
        if begun and misfit < _WILD * best:
            _bend(second, x, to, r, j, r_there, j_there)
        if misfit < best:
            if best - misfit > 0.75 * promised:
                damping = 0.0 if damping < 1e-5 else 0.1 * damping
            elif best - misfit < 0.25 * promised:
                damping = max(2.0 * damping, 1e-3)
            best, folded = misfit, folded_there
            copy(to, x)
            copy(v, value)
            copy(r_there, r)
            for a in range(6):
                copy(t[a], tangents[a])
            for i in range(k):
                copy(j_there[i], j[i])
            for c in range(known.shape[0]):
                left = math.sqrt(by_slopes(x, r, j, known[c])) + math.sqrt(misfits[c])
                sure = misfits[c] <= worth < np.inf
                sure = sure and left * left < min(_FORESEEN, _DOWNHILL * (best - misfits[c]))
                if sure or same_contact(x, known[c]):
                    copy(known[c], x)
                    return best, False
            _directions(fold, x, folded, frame)
            begun = True
        elif best == np.inf:
            return best, False
        else:
            damping = max(4.0 * damping, 1e-2)
        _normal_equations(r, j, second, frame, gradient, normal, bent)
        ends = (x[0] <= proximal, x[0] >= 1.0, folded and gradient[2] >= 0.0)
        slope, curve = _step_within(gradient, normal, bent, damping, ends, root, step)
        while slope > 0.0 and damping <= _MOST_DAMPING:
            damping = max(4.0 * damping, 1e-3)
            slope, curve = _step_within(gradient, normal, bent, damping, ends, root, step)
        gain = -2.0 * slope - curve
        idle = gain <= (_IDLE_NEAR if near else _IDLE_WITHIN) * best + _LITTLE
        slow = n >= _PATIENCE and (damping == 0.0 or n >= _LATE) and gain < _SLOW * (best - worth)
        if near and (idle or slow or damping > _MOST_DAMPING):
            copy(x, to)
            second[:], best, damping, promised, near, begun = 0.0, np.inf, 0.0, 0.0, False, False
            continue
        if idle or damping > _MOST_DAMPING:
            return best, _level(gradient, normal, ends)
        if slow:
            break
        size = max(abs(step[0]), abs(step[1]), abs(step[2]), 1.0)
        for p in range(3):
            step[p] /= size
        promised = (-2.0 * slope - curve / size) / size
        _go(fold, proximal, x, folded, frame, step, to)
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
