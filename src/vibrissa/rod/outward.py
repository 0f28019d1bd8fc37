"""Integration of the rod equations from the base outward, for a known base wrench.

With n = RᵀF the force and m the moment in the whisker, both in the material frame,

    n' = n × u,   m' = m × u + n × e₁,   u = u₀(s) + c(s) ∘ m,   n(0) = F,   m(0) = M

up to the contact, and u = u₀ beyond it. Vectors v fixed in space obey v' = v × u in the material
frame; the axes of the whisker frame, and the position with r' = r × u + e₁, give the centreline.
The steps are those of the contact problem, cut at the contact and at the requested arc lengths.

The only external force acts where the moment vanishes: at the contact m(s_c) = 0, whatever the
direction of the force. A measured wrench never satisfies this exactly. Since

    d|m|²/ds = 2 m · (n × e₁),

the minima of the moment are the zeros of m · (n × e₁) with positive derivative.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, IntArray, Vector, inlined, kernel, share_out
from vibrissa.rod.discretization import Discretization, Rod
from vibrissa.rod.kernels import (
    LANES,
    STAGE,
    TURN,
    Pair,
    Piece,
    carried_rates,
    cross,
    get,
    piece_of,
    put,
    runge_kutta_step,
    section,
    turning,
)

#: Largest number of minima of the moment returned for one wrench.
MOST_PLACES = 6
# A step with more bending than this (rad) is no longer on the whisker, but beyond any contact.
_MOST_TURN = 1.5
_ROUNDS = 30  # rounds of false position for the zero within a step
_NOTHING = 1e-14  # lengths below this (over L) count as zero

# Buffer for four whiskers: curvatures of the stages; force and moment; the axes x, y, z and the
# position r in the material frame; and the step length.
_N = 7 * STAGE
_X = _N + 6 * LANES
_Z = _X + 6 * LANES
_H = _Z + 6 * LANES
_SIZE = _H + LANES


@inlined
def _rates(
    data: tuple[Array, Piece, float, float, float, bool],
    stage: int,
    left: float,
    i: int,
    n: Vector,
    m: Vector,
) -> Pair:
    """Derivatives of (n, m); the stage's curvature is stored if ``keep``."""
    b, piece, begin, share, loaded, keep = data
    u0, c = section(piece, begin + (1.0 - left) * share)
    u = turning(u0, c, (loaded * m[0], loaded * m[1], loaded * m[2]))
    if keep:
        put(b, stage * STAGE + TURN, i, u)
    dm, extent = cross(m, u), piece[3]
    return cross(n, u), (dm[0], dm[1] + extent * n[2], dm[2] - extent * n[1])


@inlined
def _step(
    b: Array, piece: Piece, width: float, low: float, high: float, load: float, keep: bool
) -> None:
    """Take each lane's step within a rod step: loaded from ``low`` on, or free up to ``high``."""
    for i in range(LANES):
        h = b[_H + i]
        at = low if load > 0.0 else high - h
        data = (b, piece, at / width, h / width, load, keep)
        n, m = runge_kutta_step(_rates, data, i, h, get(b, _N, i), get(b, _N + 3 * LANES, i))
        put(b, _N, i, n)
        put(b, _N + 3 * LANES, i, m)
    if keep:
        for i in range(LANES):
            v, w = get(b, _X, i), get(b, _X + 3 * LANES, i)
            v, w = runge_kutta_step(carried_rates, (b, 0.0), i, b[_H + i], v, w)
            put(b, _X, i, v)
            put(b, _X + 3 * LANES, i, w)
        for i in range(LANES):
            v, w = get(b, _Z, i), get(b, _Z + 3 * LANES, i)
            v, w = runge_kutta_step(carried_rates, (b, piece[3]), i, b[_H + i], v, w)
            put(b, _Z, i, v)
            put(b, _Z + 3 * LANES, i, w)


@inlined
def _load_lane(b: Array, i: int, value: Array) -> None:
    """Load lane i with (F, p), the axes at the base, and r = 0."""
    force, point = (value[0], value[1], value[2]), (value[3], value[4], value[5])
    put(b, _N, i, force)
    put(b, _N + 3 * LANES, i, cross(point, force))
    put(b, _X, i, (1.0, 0.0, 0.0))
    put(b, _X + 3 * LANES, i, (0.0, 1.0, 0.0))
    put(b, _Z, i, (0.0, 0.0, 1.0))
    put(b, _Z + 3 * LANES, i, (0.0, 0.0, 0.0))


@inlined
def _copy_position(b: Array, i: int, place: Array) -> None:
    """Copy the position r of lane i, in the whisker frame."""
    r = get(b, _Z + 3 * LANES, i)
    for a in range(3):
        axis = get(b, _X + 3 * a * LANES, i)
        place[a] = axis[0] * r[0] + axis[1] * r[1] + axis[2] * r[2]


@kernel
def _shapes(
    rod: Rod, values: Array, arc: Array, s: Array, places: Array, first: int, last: int
) -> None:
    """Fill positions (n, m, 3) at increasing s (m,), for values (F, p) and contacts at ``arc``."""
    b = np.zeros(_SIZE)
    for row in range(first, last, LANES):
        lanes, wanted = min(LANES, last - row), 0
        for i in range(LANES):
            _load_lane(b, i, values[min(row + i, last - 1)])
        for k in range(rod.start.shape[0]):
            here, end, extent = rod.start[k], rod.start[k] + rod.width[k], rod.extent[k]
            piece = piece_of(rod, k)
            while True:
                while wanted < s.shape[0] and s[wanted] <= here + 1e-12 and extent > 0.0:
                    for i in range(lanes):
                        _copy_position(b, i, places[row + i, wanted])
                    wanted += 1
                if here >= end - 1e-15:
                    break
                to = min(end, s[wanted]) if extent > 0.0 and wanted < s.shape[0] else end
                low, high = here - rod.start[k], to - rod.start[k]
                for load in (1.0, 0.0):
                    longest = 0.0
                    for i in range(LANES):
                        loaded = min(max(arc[min(row + i, last - 1)] - here, 0.0), to - here)
                        b[_H + i] = loaded if load > 0.0 else to - here - loaded
                        longest = max(longest, b[_H + i])
                    if longest > _NOTHING:
                        _step(b, piece, rod.width[k], low, high, load, True)
                here = to
        while wanted < s.shape[0]:
            for i in range(lanes):
                _copy_position(b, i, places[row + i, wanted])
            wanted += 1


@kernel
def _contact_forces(rod: Rod, values: Array, arc: Array, forces: Array) -> None:
    """Fill forces (n, 3) in the material frame at the contacts."""
    b = np.zeros(_SIZE)
    for row in range(0, forces.shape[0], LANES):
        for i in range(LANES):
            _load_lane(b, i, values[min(row + i, forces.shape[0] - 1)])
        for k in range(rod.start.shape[0]):
            for i in range(LANES):
                left = arc[min(row + i, forces.shape[0] - 1)] - rod.start[k]
                b[_H + i] = min(max(left, 0.0), rod.width[k])
            _step(b, piece_of(rod, k), rod.width[k], 0.0, 0.0, 1.0, False)
        for i in range(min(LANES, forces.shape[0] - row)):
            n = get(b, _N, i)
            forces[row + i, 0], forces[row + i, 1], forces[row + i, 2] = n[0], n[1], n[2]


@inlined
def _moment_slope(n: Vector, m: Vector) -> float:
    """Half of d|m|²/ds, which is m · (n × e₁)."""
    return float(m[1] * n[2] - m[2] * n[1])


@inlined
def _zero_in_step(
    b: Array, piece: Piece, width: float, n: Vector, m: Vector, before: float, after: float
) -> tuple[float, Vector]:
    """Zero of the moment's slope within a step, by false position (Illinois), and force there."""
    low, high, at_low, at_high = 0.0, width, before, after
    here, force = width, n
    for _ in range(_ROUNDS):
        if not at_high - at_low > 0.0:
            break
        here = low - at_low * (high - low) / (at_high - at_low)
        data = (b, piece, 0.0, here / width, 1.0, False)
        force, moment = runge_kutta_step(_rates, data, 0, here, n, m)
        at = _moment_slope(force, moment)
        if abs(at) <= 1e-15 * (abs(before) + abs(after)) or high - low < _NOTHING:
            break
        if at < 0.0:
            low, at_low, at_high = here, at, 0.5 * at_high
        else:
            high, at_high, at_low = here, at, 0.5 * at_low
    return here, force


@inlined
def _add(contacts: Array, count: int, s: float, force: Vector) -> int:
    """Append a contact (s, n) if there is room; return the count."""
    if count < contacts.shape[0]:
        contacts[count, 0] = s
        contacts[count, 1], contacts[count, 2], contacts[count, 3] = force[0], force[1], force[2]
        return count + 1
    return count


@kernel
def _vanishing_moments(
    rod: Rod, wrenches: Array, least: float, count: IntArray, contacts: Array, first: int, last: int
) -> None:
    """Fill contacts (n, MOST_PLACES, 4) at minima of the moment, and their number (n,)."""
    b = np.zeros(_SIZE)
    steps = rod.start.shape[0]
    for row in range(first, last):
        w, found = wrenches[row], 0
        n, m = (w[0], w[1], w[2]), (w[3], w[4], w[5])
        for k in range(steps):
            h, piece = rod.width[k], piece_of(rod, k)
            data = (b, piece, 0.0, 1.0, 1.0, False)
            rate, _ = _rates(data, 0, 1.0, 0, n, m)
            end, moment = runge_kutta_step(_rates, data, 0, h, n, m)
            turn = h * (abs(rate[0]) + abs(rate[1]) + abs(rate[2]))
            lost = not turn < _MOST_TURN * (abs(n[0]) + abs(n[1]) + abs(n[2]))
            before, after = _moment_slope(n, m), _moment_slope(end, moment)
            last_step = lost or k == steps - 1
            if not lost and rod.extent[k] > 0.0 and before < 0.0 <= after:
                here, force = _zero_in_step(b, piece, h, n, m, before, after)
                if rod.start[k] + here >= least:
                    found = _add(contacts[row], found, rod.start[k] + here, force)
            elif last_step and before < 0.0:
                # The moment still decreases at the end of the whisker, or of its integration.
                s = rod.start[k] + (0.0 if lost else h)
                found = _add(contacts[row], found, s, n if lost else end)
            if last_step:
                break
            n, m = end, moment
        count[row] = found


def shapes(discretization: Discretization, values: Array, arc: Array, s: Array) -> Array:
    """Centrelines (n, m, 3) of deflected whiskers at arc lengths s, non-dimensional."""
    places = np.full((len(values), s.size, 3), np.nan)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(arc))
    kept, where = np.ascontiguousarray(values[rows]), np.ascontiguousarray(arc[rows])
    found = np.empty((rows.size, s.size, 3))
    share_out(rows.size, _shapes, discretization.rod, kept, where, np.ascontiguousarray(s), found)
    places[rows] = found
    return places


def contact_forces(discretization: Discretization, values: Array, arc: Array) -> Array:
    """Contact forces (n, 3) in the material frame, for known base force and contact point."""
    forces = np.full((len(values), 3), np.nan)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(arc))
    at_contact = np.empty((rows.size, 3))
    _contact_forces(discretization.rod, values[rows], arc[rows], at_contact)
    forces[rows] = at_contact
    return forces


def vanishing_moments(
    discretization: Discretization, wrenches: Array, least: float
) -> tuple[IntArray, Array]:
    """Number (n,) of minima of the moment for wrenches (n, 6), and (s, n) (n, MOST_PLACES, 4)."""
    count = np.zeros(len(wrenches), np.int64)
    contacts = np.full((len(wrenches), MOST_PLACES, 4), np.nan)
    given = discretization.rod, np.ascontiguousarray(wrenches), least, count, contacts
    share_out(len(wrenches), _vanishing_moments, *given)
    return count, contacts
