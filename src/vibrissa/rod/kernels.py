"""Integration of the rod equations from the contact to the base, for four contacts at a time.

For a contact at arc length s_c with force f in the material frame at the contact (:doc:`theory`)::

    n' = n × u,   q' = q × u - e₁,   u = u₀(s) + c(s) ∘ (q × n),   n(s_c) = f,   q(s_c) = 0

with n = RᵀF the force and q = Rᵀ(p - r) the vector to the contact, both in the material frame, and
c the compliance (twist, bending, bending). At the base the material frame is the base frame, so
n(0) = F and q(0) = p: the solution *is* the base force and the contact point.

Everything is non-dimensional: lengths by L, forces by EI/L², moments by EI/L (EI at the base).

The tangents δ(n, q) with respect to the three unknowns obey the variational equations::

    δu = c ∘ (δq × n + q × δn),   δn' = δn × u + n × δu,   δq' = δq × u + q × δu

and start as -(n', q')(s_c) for s_c, and as unit forces for the components of f. The unknowns are
ξ = (s_c, f_y, f_z) for a contact on the whisker's side; for a contact at the very tip, where s_c
stays at L and the force need not be normal to the whisker, they are (f_x, f_y, f_z).

All lanes share the same steps; the step that contains a lane's contact is shortened to it, and the
steps beyond it have length zero, so there are no branches and no gathers, and the loop over lanes
vectorises. This requires the lane buffer to be one flat array with offsets known to the compiler.

The integrator, used for everything that follows the rod, is Butcher's explicit Runge-Kutta method
of order 6 with 7 stages (J. C. Butcher, *On Runge-Kutta processes of high order*, J. Austral. Math.
Soc. 4 (1964) 179-194): :func:`runge_kutta_step`, for two vectors at a time. A vector fixed in space
obeys v' = v × u in the material frame. A compliant base is a piece of rod without length
(``extent`` 0) before the first step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import numpy as np

from vibrissa.numerics import Array, Vector, inlined, kernel
from vibrissa.rod.discretization import Rod

#: A step of the rod: cubics of curvature and radius, compliances in twist and bending, extent.
Cubic: TypeAlias = tuple[float, float, float, float]
Piece: TypeAlias = tuple[tuple[Cubic, Cubic, Cubic, Cubic], float, float, float]
Pair: TypeAlias = tuple[Vector, Vector]
#: Two vectors in one tuple.
Six: TypeAlias = tuple[float, float, float, float, float, float]
Step = TypeVar("Step", Vector, Six)

LANES = 4
STAGE = 14 * LANES  # a stage stores n, q, u (3 each), the two compliances and δu (3)
TURN = 6 * LANES  # offset of u in a stage
_SOFT = 9 * LANES
_D_TURN = 11 * LANES
ARC = 7 * STAGE  # s_c
FORCE = ARC + LANES
LEVER = FORCE + 3 * LANES
TANGENT = LEVER + 3 * LANES  # three tangents of (n, q), or vectors fixed in space
_H = TANGENT + 18 * LANES  # step length, negative from the contact to the base
TIP = _H + LANES  # 1 where the first unknown is f_x instead of s_c
_MOVING = TIP + LANES  # tangent during its step
LEAN = _MOVING + 6 * LANES  # last direction of weight at the tip, material frame
BUFFER_SIZE = LEAN + 3 * LANES


@inlined
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def add(a: Vector, b: Vector) -> Vector:
    """Sum of vectors."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inlined
def normal_plane(n: Vector) -> Pair:
    """Two unit vectors such that they and the unit vector n are right-handed: e₁ × e₂ = n."""
    x, y, z = n
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        size = 1.0 / np.sqrt(y * y + z * z)
        first = (0.0, z * size, -y * size)
    elif abs(y) <= abs(z):
        size = 1.0 / np.sqrt(x * x + z * z)
        first = (-z * size, 0.0, x * size)
    else:
        size = 1.0 / np.sqrt(x * x + y * y)
        first = (y * size, -x * size, 0.0)
    return first, cross(n, first)


@inlined
def _axpy(y: Step, a: float, x: Step) -> Step:
    if len(y) == 6:  # resolved at compile time
        return (
            y[0] + a * x[0],
            y[1] + a * x[1],
            y[2] + a * x[2],
            y[3] + a * x[3],
            y[4] + a * x[4],
            y[5] + a * x[5],
        )
    return (y[0] + a * x[0], y[1] + a * x[1], y[2] + a * x[2])


@inlined
def get(b: Array, row: int, i: int) -> Vector:
    """Vector of lane i at a row of the buffer."""
    return (b[row + i], b[row + LANES + i], b[row + 2 * LANES + i])


@inlined
def put(b: Array, row: int, i: int, v: Vector) -> None:
    """Write a vector of lane i to a row of the buffer."""
    b[row + i] = v[0]
    b[row + LANES + i] = v[1]
    b[row + 2 * LANES + i] = v[2]


# Arguments of the stages in Butcher's tableau: y + h Σ a_j k_j.


@inlined
def _y2(y: Step, h: float, k1: Step) -> Step:
    return _axpy(y, h / 3.0, k1)


@inlined
def _y3(y: Step, h: float, k2: Step) -> Step:
    return _axpy(y, h * (2.0 / 3.0), k2)


@inlined
def _y4(y: Step, h: float, k1: Step, k2: Step, k3: Step) -> Step:
    return _axpy(_axpy(_axpy(y, h / 12.0, k1), h / 3.0, k2), -h / 12.0, k3)


@inlined
def _y5(y: Step, h: float, k1: Step, k2: Step, k3: Step, k4: Step) -> Step:
    y = _axpy(_axpy(y, -h / 16.0, k1), h * (9.0 / 8.0), k2)
    return _axpy(_axpy(y, h * (-3.0 / 16.0), k3), h * (-3.0 / 8.0), k4)


@inlined
def _y6(y: Step, h: float, k2: Step, k3: Step, k4: Step, k5: Step) -> Step:
    y = _axpy(_axpy(y, h * (9.0 / 8.0), k2), h * (-3.0 / 8.0), k3)
    return _axpy(_axpy(y, h * (-3.0 / 4.0), k4), h * 0.5, k5)


@inlined
def _y7(y: Step, h: float, k1: Step, k2: Step, k3: Step, k4: Step, k6: Step) -> Step:
    y = _axpy(_axpy(y, h * (9.0 / 44.0), k1), h * (-9.0 / 11.0), k2)
    y = _axpy(_axpy(y, h * (63.0 / 44.0), k3), h * (18.0 / 11.0), k4)
    return _axpy(y, h * (-16.0 / 11.0), k6)


@inlined
def _advance(y: Step, h: float, k1: Step, k3: Step, k4: Step, k5: Step, k6: Step, k7: Step) -> Step:
    y = _axpy(_axpy(y, h * (11.0 / 120.0), k1), h * (27.0 / 40.0), k3)
    y = _axpy(_axpy(y, h * (27.0 / 40.0), k4), h * (-4.0 / 15.0), k5)
    return _axpy(_axpy(y, h * (-4.0 / 15.0), k6), h * (11.0 / 120.0), k7)


@inlined
def runge_kutta_step(
    rates: Callable[..., tuple[Step, Step]], data: Any, i: int, h: float, x: Step, y: Step
) -> tuple[Step, Step]:
    """Take a step of length h with two vectors of lane i.

    ``rates(data, stage, left, i, x, y)`` returns their derivatives in a stage (from 0), where the
    fraction ``left`` of the step remains.
    """
    x1, y1 = rates(data, 0, 1.0, i, x, y)
    x2, y2 = rates(data, 1, 2.0 / 3.0, i, _y2(x, h, x1), _y2(y, h, y1))
    x3, y3 = rates(data, 2, 1.0 / 3.0, i, _y3(x, h, x2), _y3(y, h, y2))
    x4, y4 = rates(data, 3, 2.0 / 3.0, i, _y4(x, h, x1, x2, x3), _y4(y, h, y1, y2, y3))
    x5, y5 = rates(data, 4, 0.5, i, _y5(x, h, x1, x2, x3, x4), _y5(y, h, y1, y2, y3, y4))
    x6, y6 = rates(data, 5, 0.5, i, _y6(x, h, x2, x3, x4, x5), _y6(y, h, y2, y3, y4, y5))
    x7, y7 = rates(data, 6, 0.0, i, _y7(x, h, x1, x2, x3, x4, x6), _y7(y, h, y1, y2, y3, y4, y6))
    return _advance(x, h, x1, x3, x4, x5, x6, x7), _advance(y, h, y1, y3, y4, y5, y6, y7)


@inlined
def _cubic(shape: Array, k: int, j: int) -> Cubic:
    return (shape[k, j, 0], shape[k, j, 1], shape[k, j, 2], shape[k, j, 3])


@inlined
def _horner(c: Cubic, t: float) -> float:
    return c[0] + t * (c[1] + t * (c[2] + t * c[3]))


@inlined
def piece_of(rod: Rod, k: int) -> Piece:
    """Step k of the rod."""
    shape = rod.shape
    cubics = (_cubic(shape, k, 0), _cubic(shape, k, 1), _cubic(shape, k, 2), _cubic(shape, k, 3))
    return cubics, rod.twist[k], rod.bending[k], rod.extent[k]


@inlined
def section(piece: Piece, t: float) -> Pair:
    """Intrinsic curvature and compliance at the fraction t of a step."""
    shape, twist, bend, _ = piece
    r2 = _horner(shape[3], t)
    r2 = r2 * r2
    inverse = 1.0 / (r2 * r2)
    u0 = (_horner(shape[0], t), _horner(shape[1], t), _horner(shape[2], t))
    return u0, (twist * inverse, bend * inverse, bend * inverse)


@inlined
def turning(u0: Vector, c: Vector, m: Vector) -> Vector:
    """Curvature under a moment m."""
    return (u0[0] + c[0] * m[0], u0[1] + c[1] * m[1], u0[2] + c[2] * m[2])


@inlined
def _value_rates(
    data: tuple[Array, Piece, float, bool], stage: int, left: float, i: int, n: Vector, q: Vector
) -> Pair:
    """Derivatives of (n, q); the stage is stored if tangents follow."""
    b, piece, t, keep = data
    u0, c = section(piece, t * left)
    u = turning(u0, c, cross(q, n))
    if keep:
        row = stage * STAGE
        put(b, row, i, n)
        put(b, row + 3 * LANES, i, q)
        put(b, row + TURN, i, u)
        b[row + _SOFT + i] = c[0]
        b[row + _SOFT + LANES + i] = c[1]
    dq = cross(q, u)
    return cross(n, u), (dq[0] - piece[3], dq[1], dq[2])


@inlined
def _tangent_rates(
    data: tuple[Array, bool], stage: int, left: float, i: int, dn: Vector, dq: Vector
) -> Pair:
    """Derivatives of a tangent, from stages stored with the values; δu is stored if ``keep``."""
    b, keep = data
    row = stage * STAGE
    n, q, u = get(b, row, i), get(b, row + 3 * LANES, i), get(b, row + TURN, i)
    c0, c1 = b[row + _SOFT + i], b[row + _SOFT + LANES + i]
    dm = add(cross(dq, n), cross(q, dn))
    du = (c0 * dm[0], c1 * dm[1], c1 * dm[2])
    if keep:
        put(b, row + _D_TURN, i, du)
    return add(cross(dn, u), cross(n, du)), add(cross(dq, u), cross(q, du))


@inlined
def carried_rates(
    data: tuple[Array, float], stage: int, left: float, i: int, v: Vector, w: Vector
) -> Pair:
    """Derivatives of a vector fixed in space, and of one whose end moves along the rod."""
    b, extent = data
    u = get(b, stage * STAGE + TURN, i)
    dw = cross(w, u)
    return cross(v, u), (dw[0] + extent, dw[1], dw[2])


@inlined
def _d_carried_rates(
    data: tuple[Array], stage: int, left: float, i: int, v: Vector, dv: Vector
) -> Pair:
    """Derivatives of a vector fixed in space and of its tangent."""
    b, row = data[0], stage * STAGE
    u, du = get(b, row + TURN, i), get(b, row + _D_TURN, i)
    return cross(v, u), add(cross(dv, u), cross(v, du))


@inlined
def _value_step(rod: Rod, b: Array, k: int, tangents: bool) -> None:
    """Take step k with (n, q) of every lane; store the stages if tangents follow."""
    start, width, piece = rod.start[k], rod.width[k], piece_of(rod, k)
    inverse_width = 1.0 / width
    for i in range(LANES):
        s = b[ARC + i]
        h = min(max(s - start, 0.0), width)
        data = (b, piece, h * inverse_width, tangents)
        n0, q0 = get(b, FORCE, i), get(b, LEVER, i)
        n, q = runge_kutta_step(_value_rates, data, i, -h, n0, q0)
        put(b, FORCE, i, n)
        put(b, LEVER, i, q)
        if tangents:
            b[_H + i] = -h
            # The lane's contact is in this step: its s-tangent starts here.
            if s > start and s <= start + width and b[TIP + i] == 0.0:
                u = get(b, TURN, i)
                dq = cross(u, q0)
                put(b, TANGENT, i, cross(u, n0))
                put(b, TANGENT + 3 * LANES, i, (dq[0] + piece[3], dq[1], dq[2]))


@inlined
def _tangent_step(b: Array, row: int, keep: bool) -> None:
    """Take the same step with the tangent at ``row``, from the stages stored with the values."""
    for i in range(6 * LANES):
        b[_MOVING + i] = b[row + i]
    for i in range(LANES):
        n, q = get(b, _MOVING, i), get(b, _MOVING + 3 * LANES, i)
        n, q = runge_kutta_step(_tangent_rates, (b, keep), i, b[_H + i], n, q)
        put(b, _MOVING, i, n)
        put(b, _MOVING + 3 * LANES, i, q)
    for i in range(6 * LANES):
        b[row + i] = b[_MOVING + i]


@inlined
def _carry_step(b: Array, row: int) -> None:
    """Take the same step with a vector fixed in space."""
    for i in range(LANES):
        v = get(b, row, i)
        v, _ = runge_kutta_step(carried_rates, (b, 0.0), i, b[_H + i], v, v)
        put(b, row, i, v)


@inlined
def whisker_radius(rod: Rod, s: float) -> tuple[float, float]:
    """Radius relative to the base radius at s, and its derivative."""
    start, width, shape = rod.start, rod.width, rod.shape
    k = start.shape[0] - 1
    while k > 0 and start[k] > s:
        k -= 1
    t = (s - start[k]) / width[k]
    c = shape[k, 3]
    value = c[0] + t * (c[1] + t * (c[2] + t * c[3]))
    return value, (c[1] + t * (2.0 * c[2] + 3.0 * t * c[3])) / width[k]


@inlined
def set_lane(b: Array, i: int, s: float, fx: float, fy: float, fz: float, tip: bool) -> None:
    """Load lane i with a contact at s and its force; ``tip`` makes f_x the first unknown."""
    b[ARC + i] = s
    put(b, FORCE, i, (fx, fy, fz))
    put(b, LEVER, i, (0.0, 0.0, 0.0))
    b[TIP + i] = 1.0 if tip else 0.0
    for row in range(TANGENT, TANGENT + 18 * LANES, LANES):
        b[row + i] = 0.0
    if tip:
        b[TANGENT + i] = 1.0
    b[TANGENT + (6 + 1) * LANES + i] = 1.0
    b[TANGENT + (12 + 2) * LANES + i] = 1.0


@inlined
def set_all_lanes(b: Array, s: float, fx: float, fy: float, fz: float) -> None:
    """Load every lane with the same contact; first tangents are those of s, f_x, f_y, f_z."""
    for i in range(LANES):
        set_lane(b, i, s, fx, fy, fz, i > 0)
        for row in range(3):
            b[TANGENT + row * LANES + i] = 1.0 if i == row + 1 else 0.0


@inlined
def lanes_tangents(b: Array, tangents: Array) -> None:
    """Copy ∂(F, p)/∂(s, f_x, f_y, f_z) of the one contact in all lanes into ``tangents`` (6, 4)."""
    for row in range(6):
        for i in range(LANES):
            tangents[row, i] = b[TANGENT + row * LANES + i]


@inlined
def lane_value(b: Array, i: int, value: Array) -> None:
    """Copy (F, p) of lane i into ``value`` (6,)."""
    for j in range(6):
        value[j] = b[FORCE + j * LANES + i]


@inlined
def lane_tangents(b: Array, i: int, tangents: Array) -> None:
    """Copy ∂(F, p)/∂ξ of lane i into ``tangents`` (6, 3)."""
    for j in range(3):
        for row in range(6):
            tangents[row, j] = b[TANGENT + (6 * j + row) * LANES + i]


@inlined
def lane_slopes(b: Array, i: int, tangents: Array) -> None:
    """Copy ∂(F, p)/∂(s, f_x, f_y, f_z) of lane i into ``tangents`` (6, 4), without friction."""
    for row in range(6):
        t = tangents[row]
        t[0], t[1] = b[TANGENT + row * LANES + i], 0.0
        t[2] = b[TANGENT + (6 + row) * LANES + i]
        t[3] = b[TANGENT + (12 + row) * LANES + i]


@inlined
def _farthest(b: Array) -> float:
    """Arc length of the contact that is farthest from the base."""
    farthest = b[ARC]
    for i in range(1, LANES):
        farthest = max(farthest, b[ARC + i])
    return float(farthest)


@inlined
def integrate_weightless(rod: Rod, b: Array, tangents: int) -> None:
    """Integrate every lane from its contact to the base; see :func:`vibrissa.rod.integrate`."""
    start, farthest = rod.start, _farthest(b)
    for k in range(start.shape[0] - 1, -1, -1):
        if start[k] < farthest:
            if tangents > 0:
                _value_step(rod, b, k, True)
                for j in range(tangents):
                    _tangent_step(b, TANGENT + 6 * LANES * j, False)
            else:
                _value_step(rod, b, k, False)


@kernel
def carry_tangents(rod: Rod, contacts: Array, tangents: Array, first: int, last: int) -> None:
    """Compute unit tangents of the deflected whisker at many contacts."""
    b = np.zeros(BUFFER_SIZE)
    for row in range(first, last, LANES):
        for i in range(LANES):
            j = min(row + i, last - 1)
            set_lane(b, i, contacts[j, 0], contacts[j, 1], contacts[j, 2], contacts[j, 3], True)
            put(b, TANGENT, i, (1.0, 0.0, 0.0))
        farthest = _farthest(b)
        for k in range(rod.start.shape[0] - 1, -1, -1):
            if rod.start[k] < farthest:
                _value_step(rod, b, k, True)
                _carry_step(b, TANGENT)
        for i in range(min(LANES, last - row)):
            for j in range(3):
                tangents[row + i, j] = b[TANGENT + j * LANES + i]


@kernel
def contact_state(rod: Rod, contact: Array, state: Array) -> None:
    """Evaluate a contact (s, f) and its tangent t, with derivatives by (s, f_x, f_y, f_z).

    Fills ``state`` (9, 5): (F, p, t) in column 0, its derivatives in the others.
    """
    b = np.zeros(BUFFER_SIZE)
    s = contact[0]
    set_all_lanes(b, s, contact[1], contact[2], contact[3])
    carried = TANGENT + 6 * LANES  # rows of t and δt, in place of unused tangents
    for i in range(LANES):
        put(b, carried, i, (1.0, 0.0, 0.0))
        put(b, carried + 3 * LANES, i, (0.0, 0.0, 0.0))
    at_contact = True
    for k in range(rod.start.shape[0] - 1, -1, -1):
        if rod.start[k] >= s:
            continue
        _value_step(rod, b, k, True)
        if at_contact:  # there t' = e₁ × u
            b[carried + 4 * LANES] = b[TURN + 2 * LANES]
            b[carried + 5 * LANES] = -b[TURN + LANES]
            at_contact = False
        _tangent_step(b, TANGENT, True)
        for i in range(LANES):
            t, dt = get(b, carried, i), get(b, carried + 3 * LANES, i)
            t, dt = runge_kutta_step(_d_carried_rates, (b,), i, b[_H + i], t, dt)
            put(b, carried, i, t)
            put(b, carried + 3 * LANES, i, dt)
    for a in range(6):
        state[a, 0] = b[FORCE + a * LANES]
    for a in range(3):
        state[6 + a, 0] = b[carried + a * LANES]
    for i in range(LANES):
        for a in range(6):
            state[a, 1 + i] = b[TANGENT + a * LANES + i]
        for a in range(3):
            state[6 + a, 1 + i] = b[carried + (3 + a) * LANES + i]
