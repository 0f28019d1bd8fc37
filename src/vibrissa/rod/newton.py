"""Newton's method for contacts of the rod, four at a time.

A problem that starts from a seed of the chart (:mod:`vibrissa.rod.tree`) first takes chord steps in
the chart's coordinates with the interpolant's own Jacobian, which is accurate to one part in a
thousand: three or four evaluations of the rod, no derivatives. Problems not solved by these take
Newton steps in ξ. The exact Jacobian costs four times as much as the values, so it is recomputed
only after a chord step that reduces the residual less than tenfold.

An *equation* is an inlined function

    equation(value (6,), tangents (6, 3), wanted, target, residual (3,), jacobian (3, 3)) -> misfit

that computes the ``residual`` to be zeroed and, if ``wanted``, its ``jacobian`` with respect to ξ,
from base force and contact point, and returns the residual's norm in units in which 1 is large.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from vibrissa.numerics import AnyArray, Array, copy, inlined, solve3
from vibrissa.rod.chart import LEAST_ARC, Fold, chart_to_contact, fold_force
from vibrissa.rod.discretization import Rod
from vibrissa.rod.integration import integrate
from vibrissa.rod.kernels import (
    LANES,
    lane_tangents,
    lane_value,
    lanes_tangents,
    set_all_lanes,
    set_lane,
)

#: Residual norm below which an equation is solved.
TOLERANCE = 1e-11
#: Distance (over L) beyond the tip or the proximal limit that is attributed to rounding.
ROUNDING = 1e-9
# Largest number of rounds; near a fold of the equations convergence is only linear.
_ROUNDS = 30
# Largest number of rounds with a fresh Jacobian that may fail to reduce the best residual.
_MOST_FAILURES = 4
_CHORD_ROUNDS = 6
# Share of the fold force above which the determinant is evaluated at the solution itself.
_NEAR_FOLD = 0.97
#: The interpolated fold force is accurate to a few parts in 10⁴; up to this multiple of it the sign
#: of the determinant decides on stability.
ABOVE_FOLD = 1.01


class Group(NamedTuple):
    """Up to four problems that are solved side by side; see :func:`group_room`."""

    targets: Array  # (4, n), targets of the equation
    charts: Array  # (4, 3), chart coordinates of the seeds
    inverses: Array  # (4, 3, 3), their derivatives by the residual, NaN where they are not known
    xi: Array  # (4, 3), contacts: at first where to start, at last the solutions
    values: Array  # (4, 6), base force and contact point (F, p)
    misfits: Array  # (4,), norms of the residuals
    signs: Array  # (4,), det ∂p/∂ξ, or 1 where it need not be evaluated


@inlined
def group_room(targets: Array) -> Group:
    """Allocate a group with an array for its targets."""
    return Group(
        targets,
        np.empty((LANES, 3)),
        np.empty((LANES, 3, 3)),
        np.empty((LANES, 3)),
        np.empty((LANES, 6)),
        np.empty(LANES),
        np.empty(LANES),
    )


@inlined
def limited_step(fold: Fold, xi: Array, step: Array) -> None:
    """Take a step of ξ = (s, f_y, f_z), shortened to where the linearisation can be trusted."""
    strength = fold_force(fold, xi[0], float(np.arctan2(xi[2], xi[1])))
    longest = max(abs(step[0]) / 0.1, float(np.hypot(step[1], step[2])) / (0.3 * strength))
    shorten = 1.0 / max(longest, 1.0)
    xi[0] = min(max(xi[0] + shorten * step[0], LEAST_ARC), 1.0)
    xi[1] += shorten * step[1]
    xi[2] += shorten * step[2]


@inlined
def _chord_rounds(
    equation: Callable[..., Any], rod: Rod, fold: Fold, b: Array, count: int, group: Group
) -> None:
    """Take chord steps for the rows with finite ``inverses``; see :func:`newton_group`."""
    targets, charts, inverses, xi, values, misfits = group[:6]
    value, residual = np.empty(6), np.empty(3)
    tangents, jacobian = np.empty((6, 3)), np.empty((3, 3))
    active = np.zeros(LANES, np.bool_)
    busy = False
    for i in range(count):
        active[i] = inverses[i, 0, 0] == inverses[i, 0, 0]
        busy = busy or active[i]
    for _ in range(_CHORD_ROUNDS):
        if not busy:
            return
        for i in range(LANES):
            j = i if i < count else 0
            set_lane(b, i, xi[j, 0], 0.0, xi[j, 1], xi[j, 2], False)
        integrate(rod, b, 0)
        busy = False
        for i in range(count):
            if not active[i]:
                continue
            lane_value(b, i, value)
            misfit = equation(value, tangents, False, targets[i], residual, jacobian)
            if not misfit < 0.3 * misfits[i]:
                active[i] = False
                misfits[i] = np.inf
                continue
            misfits[i] = misfit
            copy(value, values[i])
            active[i] = misfit > TOLERANCE
            if active[i]:
                busy = True
                for a in range(3):
                    for c in range(3):
                        charts[i, a] -= inverses[i, a, c] * residual[c]
                chart_to_contact(fold, charts[i], xi[i])


@inlined
def _integrate_rows(
    rod: Rod, b: Array, count: int, xi: Array, active: AnyArray, stale: AnyArray
) -> tuple[bool, bool]:
    """Integrate all rows; return whether with tangents, and whether only one row had them."""
    wanted, number, only = False, 0, 0
    for i in range(count):
        if active[i]:
            wanted = wanted or stale[i]
            number, only = number + 1, i
    alone = LANES > 1 and wanted and number == 1  # a lane for each of its tangents
    if alone:
        set_all_lanes(b, xi[only, 0], 0.0, xi[only, 1], xi[only, 2])
    else:
        for i in range(LANES):
            j = i if i < count else 0
            set_lane(b, i, xi[j, 0], 0.0, xi[j, 1], xi[j, 2], False)
    integrate(rod, b, 1 if alone else (3 if wanted else 0))
    return wanted, alone


@inlined
def _row_tangents(b: Array, i: int, alone: bool, tangents: Array) -> None:
    """Copy ∂(F, p)/∂ξ of a row."""
    if not alone:
        lane_tangents(b, i, tangents)
        return
    four = np.empty((6, 4))
    lanes_tangents(b, four)
    for a in range(6):
        tangents[a, 0], tangents[a, 1], tangents[a, 2] = four[a, 0], four[a, 2], four[a, 3]


@inlined
def newton_group(
    equation: Callable[..., Any], rod: Rod, fold: Fold, b: Array, count: int, group: Group
) -> None:
    """Solve up to four problems in parallel, in place; the first ``count`` rows are used."""
    targets, charts, xi, values = group.targets, group.charts, group.xi, group.values
    misfits, signs = group.misfits, group.signs
    value, tangents = np.empty(6), np.empty((6, 3))
    residual, step = np.empty(3), np.empty(3)
    jacobians = np.empty((LANES, 3, 3))
    active, stale = np.zeros(LANES, np.bool_), np.ones(LANES, np.bool_)
    hard, failures = np.zeros(LANES, np.bool_), np.zeros(LANES, np.int64)
    for i in range(count):
        misfits[i] = np.inf
    _chord_rounds(equation, rod, fold, b, count, group)
    busy = False
    for i in range(count):
        signs[i] = 1.0
        active[i] = stale[i] = not misfits[i] <= TOLERANCE or charts[i, 2] > _NEAR_FOLD
        misfits[i] = np.inf if active[i] else misfits[i]
        busy = busy or active[i]
    for i in range(count, LANES):
        active[i] = stale[i] = False
    if not busy:
        return
    for _ in range(_ROUNDS):
        wanted, alone = _integrate_rows(rod, b, count, xi, active, stale)
        busy = False
        for i in range(count):
            if not active[i]:
                continue
            lane_value(b, i, value)
            if wanted:
                _row_tangents(b, i, alone, tangents)
                signs[i] = point_determinant(tangents)
            misfit = equation(value, tangents, wanted, targets[i], residual, jacobians[i])
            stale[i] = not misfit < 0.1 * misfits[i]
            # Once a chord step has failed, more of them gain nothing.
            hard[i] = hard[i] or (stale[i] and not wanted)
            if wanted and not misfit < misfits[i]:
                failures[i] += 1
            if wanted or not stale[i] or misfit <= TOLERANCE:
                misfits[i] = misfit
                copy(value, values[i])
                if misfit <= TOLERANCE and not wanted and not stale[i]:
                    # Near the fold the sign of the determinant must be that of the solution itself.
                    strength = fold_force(fold, xi[i, 0], float(np.arctan2(xi[i, 2], xi[i, 1])))
                    stale[i] = bool(np.hypot(xi[i, 1], xi[i, 2]) > _NEAR_FOLD * strength)
                    active[i] = stale[i]
                    busy = busy or stale[i]
                    continue
                if misfit <= TOLERANCE or not misfit < np.inf or failures[i] > _MOST_FAILURES:
                    active[i] = False
                    continue
                if wanted:
                    stale[i] = hard[i]
                if solve3(jacobians[i], residual, step) == 0.0:
                    active[i] = False
                    continue
                for c in range(3):
                    step[c] = -step[c]
                limited_step(fold, xi[i], step)
            busy = True
        if not busy:
            break


@inlined
def start_from(found: Array, slopes: Array, quality: int, chart: Array, inverse: Array) -> None:
    """Initialise a row of :func:`newton_group` from a seed; one of poor quality has no inverse."""
    copy(found, chart)
    for a in range(3):
        for c in range(3):
            inverse[a, c] = slopes[a, c] if quality == 2 else np.nan


@inlined
def point_determinant(tangents: Array) -> float:
    """Det ∂p/∂ξ of tangents (6, 3)."""
    a, b = tangents[3:, 0], tangents[3:, 1]
    c = tangents[3:, 2]
    return float(
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@inlined
def stable(fold: Fold, proximal: float, xi: Array, sign: float) -> bool:
    """Whether a solution is in the charted stable set, up to rounding."""
    if not (sign > 0.0 and xi[0] >= proximal - ROUNDING):
        return False
    strength = fold_force(fold, xi[0], float(np.arctan2(xi[2], xi[1])))
    return bool(np.hypot(xi[1], xi[2]) <= ABOVE_FOLD * strength)
