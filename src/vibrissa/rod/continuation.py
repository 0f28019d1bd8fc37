"""Loads followed from a known state to the one asked for, on the stable branch all the way.

A problem is a set of three equations G(x; parameters) = 0. The parameters move along a straight
line from where the solution is known to where it is wanted; Newton's method corrects each step, the
step is halved where it struggles and doubled where it does not. A solution counts only while det
∂G/∂x keeps the sign it started with: the zero is that load's fold, where the whisker slips off.
Where no step succeeds, the state reached tells why.

Three kinds of problem, with their unknowns x and parameters:

- ``POINT``: the contact is at a point. x = (s, f_y, f_z); parameters: the point.
- ``SIDE``: the whisker's side on a peg. x = (s, λ, ψ) with f = λ (0, cos ψ, sin ψ); parameters: a
  point of the
  peg's axis, its direction, and its radius (negative: a line without thickness). With d the part of
  p - origin
  normal to the axis and F̂ = F/λ the force's direction: d = D F̂ and F̂·axis = 0, D the peg's
  radius plus the
  whisker's at s, or 0 for a line. Polar unknowns keep F̂ regular down to zero force.
- ``TIP``: the whisker's tip on a peg, the same equations at s = 1 with the force free to lean back:
  x = (λ, α, ψ), f = λ (sin α, cos α cos ψ, cos α sin ψ), α ≤ 0. A side contact that slides to the
  tip goes on as this one; a tip contact whose force turns normal to the whisker goes on along the
  side.
"""

from __future__ import annotations

import numpy as np

from vibrissa.rod.arrays import Array, IntArray, Rod
from vibrissa.rod.compiled import inlined, kernel
from vibrissa.rod.kernels import BUFFER_SIZE, LANES, integrate, lane_tangents, lane_value, set_lane
from vibrissa.rod.newton import ROUNDING, TOLERANCE, norm3
from vibrissa.rod.preimage import solve3
from vibrissa.rod.reach import LEAST_ARC, Fold, fold_force
from vibrissa.status import Status

POINT, SIDE, TIP = 0, 1, 2
#: A force this small (EI/L²) only says where an object touches.
LEAST_FORCE = 1e-7
# Fractions of the path; points start within a cell of their target.
_SMALLEST_STEP = 2.0**-12
_SMALLEST_POINT_STEP = 2.0**-9
_MOST_ITERATIONS = 30
# Toward a fold det ∂G/∂x vanishes and the solution moves ever faster along the path, both like a
# square root of what is left to it. A path that cannot be followed has met a fold if det has fallen
# below this share of its start, or if the speed (in longest steps per path) has grown by this
# factor or is as high as this.
_NEAR_FOLD = 0.5
# So near a fold that the solution moves by the square root of the rounding, a contact that Newton's
# method cannot improve is one if it meets the equations to this.
_AT_FOLD = 3e-10
_SPED_UP = 2.0
_FAST = 30.0

_OK = int(Status.OK)
_AT_TIP = int(Status.TIP_CONTACT)
_NO_CONTACT = int(Status.NO_CONTACT)
_FOLD = int(Status.BEYOND_FOLD)
_BEYOND_TIP = int(Status.BEYOND_TIP)
_PROXIMAL = int(Status.TOO_PROXIMAL)
_FAILED = int(Status.NOT_CONVERGED)


@inlined
def _contact(kind: int, x: Array, contact: Array) -> None:
    """Turn unknowns into (s, f_x, f_y, f_z)."""
    if kind == POINT:
        contact[0], contact[1], contact[2], contact[3] = x[0], 0.0, x[1], x[2]
    elif kind == SIDE:
        contact[0], contact[1] = x[0], 0.0
        contact[2], contact[3] = x[1] * np.cos(x[2]), x[1] * np.sin(x[2])
    else:
        normal = x[0] * np.cos(x[1])
        contact[0], contact[1] = 1.0, x[0] * np.sin(x[1])
        contact[2], contact[3] = normal * np.cos(x[2]), normal * np.sin(x[2])


@inlined
def _polar_tangents(kind: int, x: Array, t: Array) -> None:
    """Turn derivatives with respect to (s, f_y, f_z) or (f_x, f_y, f_z) into ones by unknowns."""
    if kind == POINT:
        return
    for row in range(6):
        a, b, c = t[row, 0], t[row, 1], t[row, 2]
        if kind == SIDE:
            cos, sin = np.cos(x[2]), np.sin(x[2])
            t[row, 1] = cos * b + sin * c
            t[row, 2] = x[1] * (cos * c - sin * b)
        else:
            cos, sin, up, out = np.cos(x[2]), np.sin(x[2]), np.sin(x[1]), np.cos(x[1])
            normal = cos * b + sin * c
            t[row, 0] = up * a + out * normal
            t[row, 1] = x[0] * (out * a - up * normal)
            t[row, 2] = x[0] * out * (cos * c - sin * b)


@inlined
def whisker_radius(rod: Rod, s: float) -> tuple[float, float]:
    """Radius relative to the base radius at s, and its derivative."""
    start, width, shape = rod[0], rod[1], rod[5]
    k = start.shape[0] - 1
    while k > 0 and start[k] > s:
        k -= 1
    t = (s - start[k]) / width[k]
    c = shape[k, 3]
    value = c[0] + t * (c[1] + t * (c[2] + t * c[3]))
    return value, (c[1] + t * (2.0 * c[2] + 3.0 * t * c[3])) / width[k]


@inlined
def _equations(
    kind: int,
    rod: Rod,
    radius: float,
    x: Array,
    p: Array,
    value: Array,
    t: Array,
    g: Array,
    j: Array,
) -> None:
    """G and ∂G/∂x from (F, p) and their derivatives with respect to x."""
    if kind == POINT:
        for a in range(3):
            g[a] = value[3 + a] - p[a]
            for c in range(3):
                j[a, c] = t[3 + a, c]
        return
    force = x[1] if kind == SIDE else x[0]
    which = 1 if kind == SIDE else 0  # the unknown that is the force's size
    # Two directions normal to the axis.
    ax, ay, az = p[3], p[4], p[5]
    e = np.empty((2, 3))
    if abs(ax) <= abs(ay) and abs(ax) <= abs(az):
        n = 1.0 / np.sqrt(ay * ay + az * az)
        e[0, 0], e[0, 1], e[0, 2] = 0.0, az * n, -ay * n
    elif abs(ay) <= abs(az):
        n = 1.0 / np.sqrt(ax * ax + az * az)
        e[0, 0], e[0, 1], e[0, 2] = -az * n, 0.0, ax * n
    else:
        n = 1.0 / np.sqrt(ax * ax + ay * ay)
        e[0, 0], e[0, 1], e[0, 2] = ay * n, -ax * n, 0.0
    e[1, 0] = ay * e[0, 2] - az * e[0, 1]
    e[1, 1] = az * e[0, 0] - ax * e[0, 2]
    e[1, 2] = ax * e[0, 1] - ay * e[0, 0]
    distance, slope = 0.0, 0.0
    if p[6] >= 0.0:
        r, dr = whisker_radius(rod, x[0] if kind == SIDE else 1.0)
        distance = p[6] + radius * r
        slope = radius * dr if kind == SIDE else 0.0
    for a in range(3):
        d, push = 0.0, 0.0
        for i in range(3):
            w = p[3 + i] if a == 2 else e[a, i]
            push += w * value[i] / force
            if a < 2:
                d += w * (value[3 + i] - p[i])
        g[a] = push if a == 2 else d - distance * push
        for c in range(3):
            dd, dpush = 0.0, 0.0
            for i in range(3):
                w = p[3 + i] if a == 2 else e[a, i]
                dpush += w * t[i, c] / force
                if a < 2:
                    dd += w * t[3 + i, c]
            if c == which:
                dpush -= push / force
            j[a, c] = dpush if a == 2 else dd - distance * dpush
        if a < 2 and kind == SIDE:
            j[a, 0] -= slope * push


@inlined
def _limit(kind: int, fold: Fold, x: Array) -> Array:
    """How far each unknown may go in one step."""
    most = np.empty(3)
    if kind == POINT:
        most[0] = 0.15
        most[1] = most[2] = 0.4 * fold_force(fold, x[0], float(np.arctan2(x[2], x[1])))
    elif kind == SIDE:
        most[0], most[1], most[2] = 0.15, 0.4 * fold_force(fold, x[0], x[2]), 0.6
    else:
        most[0], most[1], most[2] = 0.6 * fold_force(fold, 1.0, x[2]), 0.6, 0.6
    return most


@kernel
def follow(
    rod: Rod,
    fold: Fold,
    radius: float,
    proximal: float,
    begins: Array,
    ends: Array,
    kinds: IntArray,
    unknowns: Array,
    contacts: Array,
    values: Array,
    misfits: Array,
    statuses: IntArray,
    first: int,
    last: int,
) -> None:
    """Follow problems from ``begins`` to ``ends``, four at a time; see the module.

    Parameters
    ----------
    rod, fold : tuples of arrays
        The whisker and its fold forces.
    radius : float
        Base radius over L.
    proximal : float
        Smallest s_c/L that counts.
    begins, ends : (n, 7) arrays
        Parameters where the solution is known and where it is wanted.
    kinds : (n,) int array
        Kind of each problem; replaced by the kind it ended as.
    unknowns : (n, 3) array
        Solutions at ``begins`` (approximately); replaced by those at ``ends``, or by the last on
        the way.
    contacts : (n, 4) array
        Filled with (s, f_x, f_y, f_z).
    values : (n, 6) array
        Filled with (F, p).
    misfits : (n,) array
        Filled with the residual's norm.
    statuses : (n,) int array
        Filled with a :class:`Status`.
    first, last : int
        The rows to do.
    """
    b = np.zeros(BUFFER_SIZE)
    value, t, g = np.empty(6), np.empty((6, 3)), np.empty(3)
    jacobian, step, contact, p = np.empty((3, 3)), np.empty(3), np.empty(4), np.empty(7)
    row = np.full(LANES, -1)
    x, x_ok = np.empty((LANES, 3)), np.empty((LANES, 3))
    done, stride = np.zeros(LANES), np.zeros(LANES)
    sign, ratio = np.zeros(LANES), np.zeros(LANES)
    last_size, rounds = np.zeros(LANES), np.zeros(LANES, np.int64)
    best, x_best, values_best = np.zeros(LANES), np.empty((LANES, 3)), np.empty((LANES, 6))
    speed, first_speed = np.zeros(LANES), np.zeros(LANES)
    clipped, lost = np.zeros(LANES, np.bool_), np.zeros(LANES, np.bool_)
    waiting, running = first, 0
    while True:
        for i in range(LANES):
            if row[i] < 0 and waiting < last:
                row[i] = waiting
                waiting += 1
                running += 1
                x[i] = unknowns[row[i]]
                x_ok[i] = x[i]
                done[i], stride[i], sign[i], ratio[i] = 0.0, 1.0, 0.0, 1.0
                rounds[i], clipped[i], lost[i] = 0, False, False
                first_speed[i], best[i] = np.inf, np.inf
            if row[i] >= 0:
                _contact(kinds[row[i]], x[i], contact)
                set_lane(b, i, contact[0], contact[1], contact[2], contact[3], kinds[row[i]] == TIP)
            else:
                set_lane(b, i, 0.1, 0.0, 0.0, 0.0, False)
        if running == 0:
            return
        integrate(rod, b, True)
        for i in range(LANES):
            m = row[i]
            if m < 0:
                continue
            kind = kinds[m]
            lane_value(b, i, value)
            lane_tangents(b, i, t)
            _polar_tangents(kind, x[i], t)
            smallest = _SMALLEST_POINT_STEP if kind == POINT else _SMALLEST_STEP
            progress = done[i] + stride[i]
            for a in range(7):
                p[a] = begins[m, a] + progress * (ends[m, a] - begins[m, a])
            if kind != POINT:
                length = np.sqrt(p[3] * p[3] + p[4] * p[4] + p[5] * p[5])
                for a in range(3, 6):
                    p[a] /= length
            _equations(kind, rod, radius, x[i], p, value, t, g, jacobian)
            misfit = norm3(g)
            det = solve3(jacobian, g, step)
            if sign[i] == 0.0:
                sign[i] = det
            relative = det / sign[i]
            failed = not (misfit < np.inf) or not relative > 0.0
            if progress >= 1.0 and misfit < best[i] and relative > 0.0:
                best[i], x_best[i], values_best[i] = misfit, x[i], value
            most = _limit(kind, fold, x[i])
            size = 0.0
            for a in range(3):
                size = max(size, abs(step[a]) / most[a])
            # Near zero force the direction is loose: solved means the step is small as well.
            solved = (misfit <= TOLERANCE and size < 1e-6) or misfit <= 1e-3 * TOLERANCE
            if solved and not failed:
                done[i] = progress
                ratio[i] = relative
                x_ok[i] = x[i]
                clipped[i], lost[i] = False, False
                _contact(kind, x[i], contact)
                contacts[m] = contact
                values[m] = value
                misfits[m] = misfit
                if kind == TIP and x[i, 1] > 0.0:
                    # The force leans outward, which a tip cannot give: the contact moves along the
                    # side.
                    force, psi = x[i, 0], x[i, 2]
                    kinds[m] = SIDE
                    x[i, 0], x[i, 1], x[i, 2] = 1.0, force, psi
                    x_ok[i] = x[i]
                    sign[i], stride[i] = (
                        0.0,
                        0.0 if progress >= 1.0 else min(stride[i], 1.0 - progress),
                    )
                    rounds[i] = 0
                    continue
                if progress >= 1.0:
                    unknowns[m] = x[i]
                    statuses[m] = _AT_TIP if kind == TIP else _OK
                    if contact[0] < proximal - ROUNDING:
                        statuses[m] = _PROXIMAL
                    row[i] = -1
                    running -= 1
                    continue
                stride[i] = min(2.0 * stride[i], 1.0 - progress)
                rounds[i] = 0
                continue
            if rounds[i] == 0:
                speed[i] = size / stride[i]
                first_speed[i] = min(first_speed[i], speed[i])
                failed = failed or (size > 2.0 and stride[i] > smallest)
            elif rounds[i] >= 2:
                failed = failed or size > 0.95 * last_size[i] + 1e-9
            failed = failed or rounds[i] >= _MOST_ITERATIONS
            if not failed:
                shorten = 1.0 / max(size, 1.0)
                for a in range(3):
                    x[i, a] -= shorten * step[a]
                if kind != TIP:
                    clipped[i] = x[i, 0] > 1.0
                    x[i, 0] = min(max(x[i, 0], LEAST_ARC), 1.0)
                force = 1 if kind == SIDE else 0
                if kind != POINT and x[i, force] < 0.01 * LEAST_FORCE:
                    lost[i] = True
                    x[i, force] = 0.01 * LEAST_FORCE
                last_size[i] = size
                rounds[i] += 1
                continue
            if stride[i] > smallest:
                stride[i] *= 0.5
                x[i] = x_ok[i]
                rounds[i] = 0
                continue
            # No step succeeds.
            if best[i] <= _AT_FOLD:
                _contact(kind, x_best[i], contact)
                contacts[m], values[m], misfits[m] = contact, values_best[i], best[i]
                unknowns[m] = x_best[i]
                statuses[m] = _AT_TIP if kind == TIP else _OK
                if contact[0] < proximal - ROUNDING:
                    statuses[m] = _PROXIMAL
                row[i] = -1
                running -= 1
                continue
            if kind == SIDE and clipped[i]:
                kinds[m] = TIP
                x[i, 0], x[i, 1], x[i, 2] = x_ok[i, 1], 0.0, x_ok[i, 2]
                x_ok[i] = x[i]
                sign[i], stride[i], rounds[i] = 0.0, min(0.01, 1.0 - done[i]), 0
                clipped[i] = False
                continue
            if lost[i]:
                statuses[m] = _NO_CONTACT
            elif clipped[i] or kind == TIP:
                statuses[m] = _BEYOND_TIP
            elif (
                ratio[i] < _NEAR_FOLD
                or speed[i] > _SPED_UP * first_speed[i]
                or not speed[i] < _FAST
            ):
                statuses[m] = _FOLD
            elif x_ok[i, 0] < proximal:
                statuses[m] = _PROXIMAL
            else:
                statuses[m] = _FAILED
            unknowns[m] = x_ok[i]
            misfits[m] = misfit
            row[i] = -1
            running -= 1
