"""Contacts that explain measured signals best: weighted least squares, four contacts side by side.

A contact has the unknowns x = (s, f_x, f_y, f_z), or without friction (s, f_y, f_z), and gives
channels c(x): signals, or components of force and moment. Measured channels c̃ with covariance
Σ = (WᵀW)⁻¹ are explained best where

    χ²(x) = |W (c(x) - c̃)|²

is least: Gauss-Newton steps with the exact Jacobian of the rod, damped as Levenberg and Marquardt
do where one fails. The contact may not leave the whisker: at the tip (and at the smallest arc
length considered) only the force is free. Everything is non-dimensional.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.channels import FITTED
from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, kernel, share_out, wrapped
from vibrissa.rod import (
    BUFFER_SIZE,
    LANES,
    Discretization,
    Fold,
    Rod,
    StableSet,
    integrate,
    lane_tangents,
    lane_value,
    lanes_tangents,
    point_determinant,
    set_all_lanes,
    set_lane,
    stable,
)
from vibrissa.signals import signal_equations

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
        residual[k] -= targets[k]
        if codes[k] == 2 or codes[k] == 5:
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
    for p in range(4):
        for q in range(p + 1):
            total = a[p, q]
            for i in range(q):
                total -= a[p, i] * a[q, i]
            if p > q:
                a[p, q] = total / a[q, q]
            elif total > 1e-14 * a[p, p]:
                a[p, p] = np.sqrt(total)
            else:
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


@kernel
def _fit(
    rod: Rod,
    free: bool,
    least: float,
    codes: IntArray,
    targets: Array,
    weights: Array,
    contacts: Array,
    values: Array,
    tangents: Array,
    misfits: Array,
    converged: AnyArray,
    first: int,
    last: int,
) -> None:
    b = np.zeros(BUFFER_SIZE)
    k = codes.shape[0]
    value, t, third = np.empty(6), np.zeros((6, 4)), np.empty((6, 3))
    residual, jacobian = np.empty(k), np.empty((k, 4))
    trial_r, trial_j = np.empty(k), np.empty((k, 4))
    r, j = np.empty((LANES, k)), np.empty((LANES, k, 4))
    x, to, work = np.empty((LANES, 4)), np.empty((LANES, 4)), np.empty((7, 4))
    damping = np.empty(LANES)
    active = np.zeros(LANES, np.bool_)
    # With friction a contact takes two lanes: their tangents differ in the first unknown.
    lanes = 2 if free else 1
    together = LANES // lanes
    for row in range(first, last, together):
        n = min(together, last - row)
        for i in range(n):
            copy(contacts[row + i], to[i])
            damping[i], active[i] = 0.0, True
            misfits[row + i], converged[row + i] = np.inf, False
        for _ in range(_ROUNDS):
            number, only = 0, 0
            for i in range(n):
                if active[i]:
                    number, only = number + 1, i
            if number == 0:
                break
            alone = number == 1  # its tangents side by side
            if alone:
                set_all_lanes(b, to[only, 0], to[only, 1], to[only, 2], to[only, 3])
            else:
                for i in range(LANES):
                    c = to[min(i // lanes, n - 1)]
                    set_lane(b, i, c[0], c[1], c[2], c[3], i % lanes == 1)
            integrate(rod, b, 1 if alone else 3)
            for i in range(n):
                if not active[i]:
                    continue
                lane_value(b, lanes * i, value)
                if alone:
                    lanes_tangents(b, t)
                else:
                    lane_tangents(b, lanes * i, third)
                    for a in range(6):
                        t[a, 0], t[a, 2], t[a, 3] = third[a, 0], third[a, 1], third[a, 2]
                    if free:
                        lane_tangents(b, lanes * i + 1, third)
                        for a in range(6):
                            t[a, 1] = third[a, 0]
                if not free:
                    for a in range(6):
                        t[a, 1] = 0.0
                at = row + i
                channel_equations(to[i], value, t, codes, targets[at], residual, jacobian)
                misfit = whiten(weights[at], residual, jacobian, k, trial_r, trial_j)
                if misfit < misfits[at]:
                    damping[i] = 0.0 if damping[i] < 1e-5 else 0.1 * damping[i]
                    misfits[at] = misfit
                    copy(to[i], contacts[at])
                    copy(to[i], x[i])
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
                size = _next(x[i], r[i], j[i], k, damping[i], least, free, work)
                while size < 0.0 and damping[i] <= _MOST_DAMPING:
                    damping[i] = max(10.0 * damping[i], 1e-8)
                    size = _next(x[i], r[i], j[i], k, damping[i], least, free, work)
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
        lambda first, last: _fit(rod, friction, least, codes, targets, weights, *out, first, last),
    )
    return out
