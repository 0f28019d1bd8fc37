"""Weighted least-squares fits of contacts to measured signals, four contacts at a time.

A contact has the unknowns x = (s, f_x, f_y, f_z), or without friction (s, f_y, f_z), and determines
channels c(x): signals, or components of force and moment. Measured channels c̃ with covariance
Σ = (WᵀW)⁻¹ are explained best where

    χ²(x) = |W (c(x) - c̃)|²

is a minimum. It is reached by Gauss-Newton steps with the exact Jacobian of the rod, damped as by
Levenberg and Marquardt where one fails. The contact may not leave the whisker: at the tip (and at
the smallest arc length considered) only the force is free. All quantities are non-dimensional.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.sensing.channels import FITTED, RATIO, channel_derivatives
from vibrissa.contacts.sensing.weighing import Weighing, weigh_any
from vibrissa.numerics import (
    AnyArray,
    Array,
    IntArray,
    cholesky,
    copy,
    inlined,
    kernel,
    share_out,
    shared,
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

# Iterations after which a fit goes on only if its χ² may still count: most fits take 5, but in
# narrow, bent valleys a few take a hundred.
_ROUNDS = 15
#: Largest number of continuations by as many iterations.
TIMES = 8
# Step, relative to the length and to the force, below which it is the last, taken to first order;
# and the same for a damped step.
_LAST = 1e-6
_SMALL = 1e-9
# Predicted decrease of χ², as a share of it, below which a step is the last.
_IDLE = 1e-8
_IDLE_NEAR = 1e-3  # the same for interpolated contacts, to which steps are accurate
_FIRST_ROUNDS = 4  # steps on interpolated contacts before the rod is integrated
_LONGEST = 0.1
_MOST_DAMPING = 1e8
_SETTLED = 1e-5  # contacts within this (over L, and relative to the force) have the same weights
_SAME = 1e-3  # contacts within this (over L, and ten times it relative to the force) are the same


class Fits(NamedTuple):
    """Fits by row: x (n, 4), (F, p) (n, 6), ∂(F, p)/∂x (n, 6, 4), χ² (n,), convergence (n,)."""

    contacts: Array
    values: Array
    tangents: Array
    misfits: Array
    converged: AnyArray


@inlined
def ratio_slopes(x: Array, by: Array) -> float:
    """Ratio of the force along the whisker to that across it; fill its derivatives (4,)."""
    normal = np.sqrt(x[2] * x[2] + x[3] * x[3])
    by[0], by[1] = 0.0, 1.0 / normal
    by[2], by[3] = -x[1] * x[2] / normal**3, -x[1] * x[3] / normal**3
    return float(x[1] / normal)


@inlined
def channel_equations(
    x: Array, v: Array, t: Array, codes: IntArray, targets: Array, residual: Array, jacobian: Array
) -> None:
    """Fill channels of x and (F, p), or (F, p, μ), minus targets (k,); derivatives (k, 4) in x."""
    signal_equations(x[0], v, t, True, codes, residual, jacobian)
    for k in range(codes.shape[0]):
        if codes[k] == RATIO:
            residual[k] = ratio_slopes(x, jacobian[k])
        residual[k] -= targets[k]
        if codes[k] in (FD, MD):
            residual[k] = wrapped(residual[k])


@inlined
def contact_equations(
    rod: Charted, work: Array, near: bool, x: Array, value: Array, tangents: Array
) -> None:
    """Fill (F, p) and ∂(F, p)/∂x (6, 4) of a contact, interpolated on the map if ``near``."""
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
    """Solve (jᵀj + damping diag) step = -jᵀr for the free unknowns, by Cholesky's method."""
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
    """Fill row 6 of the work with x after a damped step; return its relative size, or -1."""
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
    """Copy (F, p) and ∂(F, p)/∂x (6, 4) of a contact; with friction from its two lanes."""
    lane_value(b, lane, value)
    lane_slopes(b, lane, t)
    if friction:
        lane_tangents(b, lane + 1, third)
        for a in range(6):
            t[a, 1] = third[a, 0]


@inlined
def _integrate_active(rod: Rod, b: Array, to: Array, n: int, lanes: int, active: AnyArray) -> int:
    """Integrate n contacts of ``lanes`` lanes each; number of active ones, -1 if one by itself."""
    number, only = 0, 0
    for i in range(n):
        if active[i]:
            number, only = number + 1, i
    if number == 0:
        return 0
    if number == 1:  # its tangents in separate lanes
        set_all_lanes(b, to[only, 0], to[only, 1], to[only, 2], to[only, 3])
    else:
        for i in range(LANES):
            c = to[min(i // lanes, n - 1)]
            set_lane(b, i, c[0], c[1], c[2], c[3], i % lanes == 1)
    integrate(rod, b, 1 if number == 1 else 3)
    return -1 if number == 1 else number


@shared
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
    """Fit contacts for some rows, four at a time (two with friction)."""
    contacts, values, tangents, misfits, converged = fits
    b, k = np.zeros(BUFFER_SIZE), codes.shape[0]
    value, t, third = np.empty(6), np.zeros((6, 4)), np.empty((6, 3))
    residual, jacobian = np.empty(k), np.empty((k, 4))
    trial_r, trial_j = np.empty(k), np.empty((k, 4))
    r, j = np.empty((LANES, k)), np.empty((LANES, k, 4))
    to, work = np.empty((LANES, 4)), np.empty((7, 4))
    damping, active = np.empty(LANES), np.zeros(LANES, np.bool_)
    # With friction a contact takes two lanes, whose tangents differ in the first unknown.
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
    """Take the first steps of a fit without friction on interpolated contacts."""
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
    """Whether a fit without friction is stable and distal to an arc length; tangents (6, 4)."""
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
    """Whether fits without friction are stable contacts distal to an arc length, (n,)."""
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
    """Fit contacts to measured channels; slow fits continue, unless their χ² exceeds ``worth``."""
    rod, codes = discretization.rod, np.array([FITTED.index(name) for name in channels])

    def fitted(which: IntArray, contacts: Array) -> Fits:
        n = len(which)
        out = Fits(
            np.array(contacts, dtype=np.float64),
            np.full((n, 6), np.nan),
            np.zeros((n, 6, 4)),
            np.full(n, np.inf),
            np.zeros(n, np.bool_),
        )
        aims, own = np.ascontiguousarray(targets[which]), np.ascontiguousarray(weights[which])
        share_out(n, partial(fit_rows, rod, friction, least, codes, aims, own, out))
        return out

    out = fitted(np.arange(len(targets)), contacts)
    for _ in range(TIMES):
        slow = np.flatnonzero(~out.converged & (out.misfits <= worth))
        if not slow.size:
            break
        for mine, theirs in zip(out, fitted(slow, out.contacts[slow]), strict=True):
            mine[slow] = theirs
    return out


@inlined
def settled(before: Array, after: Array) -> bool:
    """Whether weights at the contact reached would lead to about the same contact x (4,)."""
    apart = math.hypot(after[2] - before[2], after[3] - before[3])
    near = abs(after[0] - before[0]) < _SETTLED
    return bool(near and apart < _SETTLED * math.hypot(after[2], after[3]))


@inlined
def same_contact(a: Array, b: Array) -> bool:
    """Whether two contacts x (4,) are the same."""
    apart = math.hypot(a[2] - b[2], a[3] - b[3])
    return bool(abs(a[0] - b[0]) < _SAME and apart < 10.0 * _SAME * math.hypot(a[2], a[3]))


def unknowns_covariance(
    names: tuple[str, ...], values: Array, tangents: Array, weights: Array, *, friction: bool
) -> Array:
    """Covariances (JᵀΣ⁻¹J)⁻¹ of x, (n, 4, 4); NaN where the channels do not determine x."""
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
