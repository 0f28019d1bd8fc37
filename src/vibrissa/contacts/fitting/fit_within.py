"""Least-squares contact within Ω that explains measured signals, without friction; compiled.

A fit stays within Ω, or on its boundary if noise has carried the measurement out of T(Ω): a step
that would leave Ω slides along the face, in the coordinates (s, ψ, λ) of the chart, as long as χ²
falls outward there. Elsewhere steps are straight in s and in s f, the moment about the base, along
which valleys of χ² extend. Where signals fold, or valleys are bent, JᵀJ is a poor model of the
Hessian: the contribution of the residuals' curvature is updated from one contact to the next, as in
NL2SOL (J. E. Dennis, D. M. Gay, R. E. Welsch, *An adaptive nonlinear least-squares algorithm*, ACM
Trans. Math. Softw. 7 (1981) 348-368).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.fitting.least_squares import (
    TIMES,
    Fits,
    channel_equations,
    contact_equations,
    fit_rows,
    same_contact,
    stable_fit,
    whiten,
)
from vibrissa.contacts.sensing.weighing import Weighing, weigh_any
from vibrissa.numerics import Array, IntArray, cholesky, copy, inlined, kernel, shared, solve_root
from vibrissa.rod import BUFFER_SIZE, Charted, Fold, fold_force

_MOST_DAMPING = 1e8
_LONGEST = 0.1
_ROUNDS = 100
# Smallest predicted decrease of χ² for which a step is taken, relative and absolute.
_IDLE, _LITTLE = 1e-6, 1e-9
_IDLE_NEAR = 1e-3  # the same for interpolated contacts, to which steps are accurate
# The same, relative to the excess of χ² over ``worth``, for undamped steps or after many
# iterations.
_SLOW, _PATIENCE, _LATE = 0.05, 3, 25
# Limits of χ² by the slopes of a fit at a known contact, absolute and as a share of the fall of χ²
# to it: below both, χ² falls all the way, and the fit would end at that contact.
_FORESEEN, _DOWNHILL = 1.0, 0.25
_WILD = 4.0  # factor of χ² above which a contact is not used to update the curvature
# Where a fit ends, χ² must be level in each unknown alone: the possible decrease is at most the
# square of this.
_LEVEL = 0.03
# Longest steps: of s; at the fold, of ψ and λ; elsewhere, of the moment, as a share of itself or of
# that at the fold.
_LONGEST_TURN, _LONGEST_FALL, _LONGEST_SHARE = 0.5, 0.25, 0.5
# The chart's fold is accurate to 1e-6: contacts as near to it are still stable.
_MOST_LOAD = 1.0 - 1e-5
_AT_FOLD = 1.0 - 1e-12  # distance within which a contact is at the fold, despite rounding
_NUDGE = 1e-5  # steps for finite differences of the fold force, which is smooth


@inlined
def _confine(fold: Fold, proximal: float, x: Array) -> bool:
    """Move a contact into Ω; whether it is at the fold."""
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
    """Fill ∂ξ/∂z (3, 3) of a fit's coordinates z, in units of their longest steps.

    These are s and the moment; at the fold s, ψ and the relative decrease of the force.
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
    """Fill the contact reached by a step in the coordinates of `_directions`."""
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
    """Fill Jᵀr, JᵀJ, and the contribution of the residuals' curvature, in a fit's coordinates."""
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
    """Update the residuals' curvature, Σ r ∂²r/∂ξ² (3, 3), from their values at another contact."""
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
    """Fill a damped step within Ω; return slope and curvature of χ²/2 along it, or (1, 0) for none.

    ``ends`` states whether s can neither decrease nor increase, and whether the force cannot.
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
    """Whether χ² decreases nowhere except out of Ω."""
    for p in range(3):
        slope = gradient[p]
        if p == 0 and ((ends[1] and slope < 0.0) or (ends[0] and slope > 0.0)):
            continue
        if not (p == 2 and ends[2]) and slope * slope > _LEVEL * _LEVEL * normal[p, p]:
            return False
    return True


@inlined
def by_slopes(x: Array, r: Array, j: Array, other: Array) -> float:
    """χ² at another contact, linear in s and s f, in which it bends little."""
    total, ds = 0.0, other[0] - x[0]
    dy = other[0] * (other[2] - x[2]) / x[0]
    dz = other[0] * (other[3] - x[3]) / x[0]
    for a in range(r.shape[0]):
        away = r[a] + j[a, 0] * ds + j[a, 2] * dy + j[a, 3] * dz
        total += away * away
    return total


class FitRoom(NamedTuple):
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


@inlined
def fit_room(k: int) -> FitRoom:
    """Allocate memory for fits of k channels."""
    return FitRoom(
        np.zeros(BUFFER_SIZE),
        np.empty((k, k)),
        np.empty(4),
        np.empty(6),
        np.zeros((6, 4)),
        np.empty(k),
        np.empty((k, 4)),
        np.empty(k),
        np.empty((k, 4)),
        np.empty(k),
        np.empty((k, 4)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
        np.empty(3),
    )


@shared
def fit_within(
    rod: Charted,
    proximal: float,
    how: Weighing,
    codes: IntArray,
    weighed: bool,
    target: Array,
    measured: Array,
    x: Array,
    value: Array,
    tangents: Array,
    worth: float,
    known: Array,
    misfits: Array,
    room: FitRoom,
) -> tuple[float, bool]:
    """Descend from a contact to the minimum of χ² in Ω, for some of the channels.

    If they are ``weighed`` the room contains their weights; else those of a measurement at the
    start are used. The fit is abandoned if it ends above ``worth``, and x becomes a known contact,
    with χ² in ``misfits``, if the descent leads to one that is worth it. Return χ², and whether it
    is a minimum. If ``worth`` is finite, contacts are interpolated up to the end, where the rod is
    integrated, and a fit from the fold leaves it only from the minimum on it, which may be one.
    """
    b, weights, to, v, t, residual, jacobian, r, j, r_there, j_there = room[:11]
    frame, second, normal, bent, root, gradient, step = room[11:]
    fold, k = rod.fold, codes.shape[0]
    copy(x, to)
    second[:], best, damping, promised, folded = 0.0, np.inf, 0.0, 0.0, False
    ends, near, begun, held = (False, False, False), worth < np.inf, False, False
    for n in range(_ROUNDS):
        folded_there = _confine(fold, proximal, to)
        held = (near and folded_there) if n == 0 else held
        contact_equations(rod, b, near, to, v, t)
        if not (begun or weighed or weigh_any(how, v, measured, weights)):
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
                sure = misfits[c] <= worth < np.inf and not held
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
        ends = (x[0] <= proximal, x[0] >= 1.0, folded and (held or gradient[2] >= 0.0))
        slope, curve = _step_within(gradient, normal, bent, damping, ends, root, step)
        while slope > 0.0 and damping <= _MOST_DAMPING:
            damping = max(4.0 * damping, 1e-3)
            slope, curve = _step_within(gradient, normal, bent, damping, ends, root, step)
        gain = -2.0 * slope - curve
        idle = gain <= (_IDLE_NEAR if near else _IDLE) * best + _LITTLE
        slow = n >= _PATIENCE and (damping == 0.0 or n >= _LATE) and gain < _SLOW * (best - worth)
        if near and (idle or slow or damping > _MOST_DAMPING):
            copy(x, to)
            second[:], best, damping, promised, begun = 0.0, np.inf, 0.0, 0.0, False
            near, held = held, False
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


@kernel
def fit_rows_within(
    rod: Charted,
    proximal: float,
    how: Weighing,
    codes: IntArray,
    targets: Array,
    measured: Array,
    weights: Array,
    fits: Fits,
) -> None:
    """Fit contacts in Ω to rows of channels, of targets (n, k) and weights (n, k, k).

    First in SIMD lanes, where most remain in Ω; those that leave it start anew, one by one.
    """
    start, known, misfits = fits.contacts.copy(), np.zeros((0, 4)), np.zeros(0)
    room = fit_room(codes.shape[0])
    fit_rows(rod.rod, False, proximal, codes, targets, weights, fits, 0, len(targets))
    for row in range(len(targets)):
        x, value, tangents = fits.contacts[row], fits.values[row], fits.tangents[row]
        for _ in range(TIMES):
            if fits.converged[row] or not fits.misfits[row] < np.inf:
                break
            fit_rows(rod.rod, False, proximal, codes, targets, weights, fits, row, row + 1)
        if fits.misfits[row] < np.inf and stable_fit(rod.fold, proximal, x, tangents):
            continue
        copy(start[row], x)
        for i in range(codes.shape[0]):
            copy(weights[row, i], room.weights[i])
        fits.misfits[row], _ = fit_within(
            rod,
            proximal,
            how,
            codes,
            True,
            targets[row],
            measured,
            x,
            value,
            tangents,
            np.inf,
            known,
            misfits,
            room,
        )
