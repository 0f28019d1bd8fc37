"""Continuation of contacts along the stable branch, from a known solution to the wanted one.

A problem is a set of three equations G(x; p) = 0. The parameters p move along a straight line from
their values at a known solution to the wanted ones. Newton's method corrects each step; the step is
halved where Newton's method fails to contract and doubled where it succeeds. A solution counts only
while det ∂G/∂x keeps its initial sign: its zero is the fold of that load, where the whisker slips
off. Where no step succeeds, the last state reached determines the status.

A side contact that slides to the tip is continued as a tip contact; a tip contact whose force turns
normal to the whisker is continued as a side contact.

The equations of each kind of contact have three unknowns x and seven parameters p:

- ``POINT``: the contact is at a given point. x = (s, f_y, f_z); p: the point.
- ``SIDE``: the whisker's side touches a peg. x = (s, λ, ψ) with f = λ (0, cos ψ, sin ψ); p: a point
  of the peg's axis, its direction, and its radius (negative: a line without thickness). With d the
  part of p - origin normal to the axis and F̂ = F/λ the force's direction: d = D F̂ and
  F̂·axis = 0, where D is the peg's radius plus the whisker's at s, or 0 for a line. Polar unknowns
  keep F̂ regular down to zero force.
- ``TIP``: the whisker's tip touches a peg: the same equations at s = 1 with a force that may have
  an axial component: x = (λ, α, ψ), f = λ (sin α, cos α cos ψ, cos α sin ψ), α ≤ 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array, IntArray, copy, inlined, kernel, norm3, solve3
from vibrissa.rod.chart import LEAST_ARC, Fold, fold_force
from vibrissa.rod.discretization import Rod
from vibrissa.rod.integration import integrate
from vibrissa.rod.kernels import (
    BUFFER_SIZE,
    LANES,
    lane_tangents,
    lane_value,
    normal_plane,
    set_lane,
    whisker_radius,
)
from vibrissa.rod.newton import ROUNDING, TOLERANCE
from vibrissa.status import Status

POINT, SIDE, TIP = 0, 1, 2

#: Force that stands for the limit of zero force at first contact, EI/L².
LEAST_FORCE = 1e-7
# Smallest steps as fractions of the path; points start within a cell of their target.
_SMALLEST_STEP = 2.0**-12
_SMALLEST_POINT_STEP = 2.0**-9
_MOST_ROUNDS = 30
# Largest number of changes between side and tip, so that a contact at the corner cannot alternate
# for ever.
_MOST_SWITCHES = 8
# Toward a fold det ∂G/∂x vanishes as the square root of the remaining path, and dx/dp diverges as
# its inverse. A path that cannot be followed is taken to have met a fold if det has fallen below
# this share of its initial value, or if the speed (in largest steps per path) has grown by this
# factor or exceeds this value.
_NEAR_FOLD = 0.5
_SPED_UP = 2.0
_FAST = 30.0
# Residual at which a contact is accepted that Newton's method cannot improve, because it is so near
# a fold that rounding displaces the solution by its square root.
_AT_FOLD = 8e-10

_OK = int(Status.OK)
_AT_TIP = int(Status.TIP_CONTACT)
_NO_CONTACT = int(Status.NO_CONTACT)
_BEYOND_FOLD = int(Status.BEYOND_FOLD)
_BEYOND_TIP = int(Status.BEYOND_TIP)
_PROXIMAL = int(Status.TOO_PROXIMAL)
_FAILED = int(Status.NOT_CONVERGED)
_RUNNING = -1

_UNSTABLE, _STABLE, _SOLVED = 0, 1, 2

# State of a path: its completed share and the step being tried; det ∂G/∂x at the start, and
# relative to it at the last solution; rounds of Newton's method and the size of the last one's
# step; the present speed and the least; the best residual at the end; whether the contact passed
# the tip, or was lost, in the last round; number of changes between side and tip.
_DONE, _STRIDE, _START, _RATIO, _ROUNDS, _SIZE = 0, 1, 2, 3, 4, 5
_SPEED, _SLOWEST, _BEST, _PAST_TIP, _LOST, _SWITCHES = 6, 7, 8, 9, 10, 11
_COLUMNS = 12


@inlined
def _contact_of(kind: int, x: Array, contact: Array) -> None:
    """Convert unknowns into (s, f_x, f_y, f_z)."""
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
def _by_unknowns(kind: int, x: Array, t: Array) -> None:
    """Convert derivatives by (s, f_y, f_z) or (f_x, f_y, f_z) into derivatives by the unknowns."""
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
def _across(p: Array, e: Array) -> None:
    """Fill e (3, 3) with two unit vectors normal to the peg's axis, and the axis itself."""
    first, second = normal_plane((p[3], p[4], p[5]))
    for i in range(3):
        e[0, i], e[1, i], e[2, i] = first[i], second[i], p[3 + i]


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
    which = 1 if kind == SIDE else 0  # index of the unknown that is the force's magnitude
    e = np.empty((3, 3))
    _across(p, e)
    distance, slope = 0.0, 0.0
    if p[6] >= 0.0:
        r, dr = whisker_radius(rod, x[0] if kind == SIDE else 1.0)
        distance = p[6] + radius * r
        slope = radius * dr if kind == SIDE else 0.0
    for a in range(3):
        d, push = 0.0, 0.0
        for i in range(3):
            w = e[a, i]
            push += w * value[i] / force
            if a < 2:
                d += w * (value[3 + i] - p[i])
        g[a] = push if a == 2 else d - distance * push
        for c in range(3):
            dd, dpush = 0.0, 0.0
            for i in range(3):
                w = e[a, i]
                dpush += w * t[i, c] / force
                if a < 2:
                    dd += w * t[3 + i, c]
            if c == which:
                dpush -= push / force
            j[a, c] = dpush if a == 2 else dd - distance * dpush
        if a < 2 and kind == SIDE:
            j[a, 0] -= slope * push


@inlined
def _largest_steps(kind: int, fold: Fold, x: Array) -> Array:
    """Largest change of each unknown in one step."""
    most = np.empty(3)
    if kind == POINT:
        most[0] = 0.15
        most[1] = most[2] = 0.4 * fold_force(fold, x[0], float(np.arctan2(x[2], x[1])))
    elif kind == SIDE:
        most[0], most[1], most[2] = 0.15, 0.4 * fold_force(fold, x[0], x[2]), 0.6
    else:
        most[0], most[1], most[2] = 0.6 * fold_force(fold, 1.0, x[2]), 0.6, 0.6
    return most


@inlined
def _initialize(path: Array) -> None:
    """Set the initial state of a path."""
    for column in range(_COLUMNS):
        path[column] = 0.0
    path[_STRIDE] = path[_RATIO] = 1.0
    path[_SLOWEST] = path[_BEST] = np.inf


@inlined
def _parameters(kind: int, begin: Array, end: Array, progress: float, p: Array) -> None:
    """Parameters at a fraction of the path; a peg's axis stays a unit vector."""
    for a in range(7):
        p[a] = begin[a] + progress * (end[a] - begin[a])
    if kind != POINT:
        length = np.sqrt(p[3] * p[3] + p[4] * p[4] + p[5] * p[5])
        for a in range(3, 6):
            p[a] /= length


@inlined
def _newton_update(kind: int, path: Array, step: Array, x: Array) -> None:
    """Take a Newton step of bounded length; keep s on the whisker and the force positive."""
    shorten = 1.0 / max(path[_SIZE], 1.0)
    for a in range(3):
        x[a] -= shorten * step[a]
    if kind != TIP:
        path[_PAST_TIP] = 1.0 if x[0] > 1.0 else 0.0
        x[0] = min(max(x[0], LEAST_ARC), 1.0)
    force = 1 if kind == SIDE else 0
    if kind != POINT and x[force] < 0.01 * LEAST_FORCE:
        path[_LOST] = 1.0
        x[force] = 0.01 * LEAST_FORCE
    path[_ROUNDS] += 1.0


@inlined
def _fails_to_contract(path: Array, size: float, smallest: float) -> bool:
    """Whether Newton's method fails to contract; ``size`` is its step over the largest step."""
    rounds = path[_ROUNDS]
    if rounds == 0.0:
        path[_SPEED] = size / path[_STRIDE]
        path[_SLOWEST] = min(path[_SLOWEST], path[_SPEED])
        return bool(size > 2.0 and path[_STRIDE] > smallest)
    return bool((rounds >= 2.0 and size > 0.95 * path[_SIZE] + 1e-9) or rounds >= _MOST_ROUNDS)


@inlined
def _switch(kind: int, path: Array, stride: float, x: Array, x_ok: Array) -> int:
    """Change from side to tip contact or back; return the new kind."""
    if kind == SIDE:
        x[0], x[1], x[2] = x_ok[1], 0.0, x_ok[2]
    else:
        x[1] = x[0]
        x[0] = 1.0
    copy(x, x_ok)
    path[_START] = path[_ROUNDS] = path[_PAST_TIP] = 0.0
    path[_STRIDE] = stride
    path[_SWITCHES] += 1.0
    return TIP if kind == SIDE else SIDE


@inlined
def _reason(kind: int, path: Array, x_ok: Array, proximal: float) -> int:
    """Status of a path that stops before its end."""
    if path[_LOST] > 0.0:
        return _NO_CONTACT
    if path[_PAST_TIP] > 0.0 or kind == TIP:
        return _BEYOND_TIP
    if x_ok[0] < proximal:
        return _PROXIMAL
    sped_up = path[_SPEED] > _SPED_UP * path[_SLOWEST] or not path[_SPEED] < _FAST
    return _BEYOND_FOLD if path[_RATIO] < _NEAR_FOLD or sped_up else _FAILED


@inlined
def _status_at_end(kind: int, s: float, proximal: float) -> int:
    """Status of a contact that reached the end of its path."""
    if s < proximal - ROUNDING:
        return _PROXIMAL
    return _AT_TIP if kind == TIP else _OK


class _Lanes(NamedTuple):
    """Problems that are followed side by side."""

    row: IntArray  # (4,), index of each lane's problem, -1 for none
    paths: Array  # (4, 12), states of the paths
    # (4, 3) Unknowns: present, of the last solution, and the best at the end of the path.
    x: Array
    x_ok: Array
    x_best: Array


@inlined
def _load_lanes(
    b: Array, waiting: int, last: int, running: int, lanes: _Lanes, kinds: IntArray, unknowns: Array
) -> tuple[int, int]:
    """Load all lanes; a lane whose path has ended takes the next problem."""
    row, x, contact = lanes.row, lanes.x, np.empty(4)
    for i in range(LANES):
        if row[i] < 0 and waiting < last:
            row[i] = waiting
            waiting += 1
            running += 1
            copy(unknowns[row[i]], x[i])
            copy(x[i], lanes.x_ok[i])
            _initialize(lanes.paths[i])
        if row[i] >= 0:
            _contact_of(kinds[row[i]], x[i], contact)
            tip = kinds[row[i]] == TIP
            set_lane(b, i, contact[0], contact[1], contact[2], contact[3], tip)
        else:
            set_lane(b, i, LEAST_ARC, 0.0, 0.0, 0.0, False)
    return waiting, running


@inlined
def _outcome(misfit: float, size: float, relative: float) -> int:
    """Whether the unknowns are stable, and whether they solve the equations."""
    if not (misfit < np.inf and relative > 0.0):
        return _UNSTABLE
    # Near zero force the direction is poorly determined, so the step must be small as well.
    small = (misfit <= TOLERANCE and size < 1e-6) or misfit <= 1e-3 * TOLERANCE
    return _SOLVED if small else _STABLE


@inlined
def _next_step(
    kind: int,
    progress: float,
    relative: float,
    outcome: int,
    size: float,
    step: Array,
    lanes: _Lanes,
    i: int,
    arc: float,
    proximal: float,
) -> tuple[int, int]:
    """Choose the action after a round of Newton's method; return status and kind of contact."""
    path, x, x_ok = lanes.paths[i], lanes.x[i], lanes.x_ok[i]
    smallest = _SMALLEST_POINT_STEP if kind == POINT else _SMALLEST_STEP
    may_switch = path[_SWITCHES] < _MOST_SWITCHES
    if outcome == _SOLVED:
        path[_DONE], path[_RATIO] = progress, relative
        copy(x, x_ok)
        path[_ROUNDS] = path[_PAST_TIP] = path[_LOST] = 0.0
        left = 1.0 - progress
        if kind == TIP and x[1] > 0.0 and may_switch:
            # A tip cannot exert an outward axial force: continue along the side.
            path[_BEST] = np.inf
            return _RUNNING, _switch(kind, path, min(path[_STRIDE], left), x, x_ok)
        if progress >= 1.0:
            return _status_at_end(kind, arc, proximal), kind
        path[_STRIDE] = min(2.0 * path[_STRIDE], left)
        return _RUNNING, kind
    if outcome == _STABLE and not _fails_to_contract(path, size, smallest):
        path[_SIZE] = size
        _newton_update(kind, path, step, x)
        return _RUNNING, kind
    if path[_STRIDE] > smallest:
        path[_STRIDE] *= 0.5
        path[_ROUNDS] = 0.0
        copy(x_ok, x)
        return _RUNNING, kind
    if path[_BEST] <= _AT_FOLD:
        copy(lanes.x_best[i], x_ok)
        return _status_at_end(kind, arc, proximal), kind
    if kind == SIDE and path[_PAST_TIP] > 0.0 and may_switch:
        return _RUNNING, _switch(kind, path, min(0.01, 1.0 - path[_DONE]), x, x_ok)
    return _reason(kind, path, x_ok, proximal), kind


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
    """Follow problems from ``begins`` to ``ends``, four at a time; see the module docstring."""
    b = np.zeros(BUFFER_SIZE)
    value, t, g, p = np.empty(6), np.empty((6, 3)), np.empty(3), np.empty(7)
    jacobian, step, row = np.empty((3, 3)), np.empty(3), np.full(LANES, -1)
    paths, x, x_ok = np.zeros((LANES, _COLUMNS)), np.empty((LANES, 3)), np.empty((LANES, 3))
    lanes = _Lanes(row, paths, x, x_ok, np.empty((LANES, 3)))
    waiting, running = first, 0
    while True:
        waiting, running = _load_lanes(b, waiting, last, running, lanes, kinds, unknowns)
        if running == 0:
            return
        integrate(rod, b, 3)
        for i in range(LANES):
            m = row[i]
            if m < 0:
                continue
            kind, path = kinds[m], paths[i]
            progress = path[_DONE] + path[_STRIDE]
            lane_value(b, i, value)
            lane_tangents(b, i, t)
            _by_unknowns(kind, x[i], t)
            _parameters(kind, begins[m], ends[m], progress, p)
            _equations(kind, rod, radius, x[i], p, value, t, g, jacobian)
            misfit, det = norm3(g), solve3(jacobian, g, step)
            if path[_START] == 0.0:
                path[_START] = det
            relative = det / path[_START]
            most = _largest_steps(kind, fold, x[i])
            size = max(abs(step[0]) / most[0], abs(step[1]) / most[1], abs(step[2]) / most[2])
            outcome = _outcome(misfit, size, relative)
            if outcome != _UNSTABLE and progress >= 1.0 and misfit < path[_BEST]:
                path[_BEST] = misfits[m] = misfit
                _contact_of(kind, x[i], contacts[m])
                copy(value, values[m])
                copy(x[i], lanes.x_best[i])
            status, kinds[m] = _next_step(
                kind, progress, relative, outcome, size, step, lanes, i, contacts[m, 0], proximal
            )
            if status != _RUNNING and not (outcome == _SOLVED or path[_BEST] <= _AT_FOLD):
                misfits[m] = misfit
            if status != _RUNNING:
                statuses[m] = status
                copy(x_ok[i], unknowns[m])
                row[i] = -1
                running -= 1
