"""The rod equations, integrated from the contact to the base, for four contacts at a time.

For a contact at arc length s_c with force f in the material frame there (:doc:`theory`)::

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

All lanes share the same steps; the step that holds a lane's contact is shortened to it and the
steps beyond it have length zero, so there are no branches and no gathers, and the loop over lanes
vectorises. That needs the lane buffer to be one flat array with offsets known to the compiler.

The integrator is Butcher's explicit Runge-Kutta method of order 6 with 7 stages (J. C. Butcher, *On
Runge-Kutta processes of high order*, J. Austral. Math. Soc. 4 (1964) 179-194). A base of finite
stiffness is a piece of rod without length (``extent`` 0) ahead of the first step.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, Vector, inlined, kernel, share_out
from vibrissa.rod.discretization import Discretization, Rod

LANES = 4
_STAGE = 11 * LANES  # a stage keeps n, q, u (3 each) and the two compliances, for the tangents
_ARC = 7 * _STAGE  # s_c
_N = _ARC + LANES
_Q = _N + 3 * LANES
_TANGENT = _Q + 3 * LANES  # three tangents of (n, q)
_H = _TANGENT + 18 * LANES  # the step, negative: from the contact to the base
_TIP = _H + LANES  # 1 where the first unknown is f_x instead of s_c
_MOVING = _TIP + LANES  # the tangent that takes a step
BUFFER_SIZE = _MOVING + 6 * LANES


@inlined
def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inlined
def _add(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inlined
def _axpy(y: Vector, a: float, x: Vector) -> Vector:
    return (y[0] + a * x[0], y[1] + a * x[1], y[2] + a * x[2])


@inlined
def _get(b: Array, row: int, i: int) -> Vector:
    return (b[row + i], b[row + LANES + i], b[row + 2 * LANES + i])


@inlined
def _put(b: Array, row: int, i: int, v: Vector) -> None:
    b[row + i] = v[0]
    b[row + LANES + i] = v[1]
    b[row + 2 * LANES + i] = v[2]


# Butcher's tableau, a stage's argument each: y + h Σ a_j k_j.


@inlined
def _y2(y: Vector, h: float, k1: Vector) -> Vector:
    return _axpy(y, h / 3.0, k1)


@inlined
def _y3(y: Vector, h: float, k2: Vector) -> Vector:
    return _axpy(y, h * (2.0 / 3.0), k2)


@inlined
def _y4(y: Vector, h: float, k1: Vector, k2: Vector, k3: Vector) -> Vector:
    return _axpy(_axpy(_axpy(y, h / 12.0, k1), h / 3.0, k2), -h / 12.0, k3)


@inlined
def _y5(y: Vector, h: float, k1: Vector, k2: Vector, k3: Vector, k4: Vector) -> Vector:
    y = _axpy(_axpy(y, -h / 16.0, k1), h * (9.0 / 8.0), k2)
    return _axpy(_axpy(y, h * (-3.0 / 16.0), k3), h * (-3.0 / 8.0), k4)


@inlined
def _y6(y: Vector, h: float, k2: Vector, k3: Vector, k4: Vector, k5: Vector) -> Vector:
    y = _axpy(_axpy(y, h * (9.0 / 8.0), k2), h * (-3.0 / 8.0), k3)
    return _axpy(_axpy(y, h * (-3.0 / 4.0), k4), h * 0.5, k5)


@inlined
def _y7(y: Vector, h: float, k1: Vector, k2: Vector, k3: Vector, k4: Vector, k6: Vector) -> Vector:
    y = _axpy(_axpy(y, h * (9.0 / 44.0), k1), h * (-9.0 / 11.0), k2)
    y = _axpy(_axpy(y, h * (63.0 / 44.0), k3), h * (18.0 / 11.0), k4)
    return _axpy(y, h * (-16.0 / 11.0), k6)


@inlined
def _advance(
    y: Vector, h: float, k1: Vector, k3: Vector, k4: Vector, k5: Vector, k6: Vector, k7: Vector
) -> Vector:
    y = _axpy(_axpy(y, h * (11.0 / 120.0), k1), h * (27.0 / 40.0), k3)
    y = _axpy(_axpy(y, h * (27.0 / 40.0), k4), h * (-4.0 / 15.0), k5)
    return _axpy(_axpy(y, h * (-4.0 / 15.0), k6), h * (11.0 / 120.0), k7)


@inlined
def _horner(c: tuple[float, float, float, float], t: float) -> float:
    return c[0] + t * (c[1] + t * (c[2] + t * c[3]))


@inlined
def _polynomial(shape: Array, k: int, j: int) -> tuple[float, float, float, float]:
    return (shape[k, j, 0], shape[k, j, 1], shape[k, j, 2], shape[k, j, 3])


@inlined
def _rate(
    n: Vector, q: Vector, u0: Vector, c: Vector, extent: float
) -> tuple[Vector, Vector, Vector]:
    m = _cross(q, n)
    u = (u0[0] + c[0] * m[0], u0[1] + c[1] * m[1], u0[2] + c[2] * m[2])
    dq = _cross(q, u)
    return u, _cross(n, u), (dq[0] - extent, dq[1], dq[2])


@inlined
def _keep(b: Array, stage: int, i: int, n: Vector, q: Vector, u: Vector, c: Vector) -> None:
    row = stage * _STAGE
    _put(b, row, i, n)
    _put(b, row + 3 * LANES, i, q)
    _put(b, row + 6 * LANES, i, u)
    b[row + 9 * LANES + i] = c[0]
    b[row + 10 * LANES + i] = c[1]


@inlined
def _tangent_rate(b: Array, stage: int, i: int, dn: Vector, dq: Vector) -> tuple[Vector, Vector]:
    row = stage * _STAGE
    n = _get(b, row, i)
    q = _get(b, row + 3 * LANES, i)
    u = _get(b, row + 6 * LANES, i)
    twist, bend = b[row + 9 * LANES + i], b[row + 10 * LANES + i]
    m = _add(_cross(dq, n), _cross(q, dn))
    du = (twist * m[0], bend * m[1], bend * m[2])
    return _add(_cross(dn, u), _cross(n, du)), _add(_cross(dq, u), _cross(q, du))


@inlined
def _section(
    shape: tuple[tuple[float, float, float, float], ...], twist: float, bend: float, t: float
) -> tuple[Vector, Vector]:
    """Intrinsic curvature and compliance at the fraction t of a step."""
    r2 = _horner(shape[3], t)
    r2 = r2 * r2
    inverse = 1.0 / (r2 * r2)
    u0 = (_horner(shape[0], t), _horner(shape[1], t), _horner(shape[2], t))
    return u0, (twist * inverse, bend * inverse, bend * inverse)


@inlined
def _value_step(rod: Rod, b: Array, k: int, tangents: bool) -> None:
    """Take step k with (n, q) of every lane; keep the stages if tangents follow."""
    start, width, extent, twist, bend = (
        rod.start[k],
        rod.width[k],
        rod.extent[k],
        rod.twist[k],
        rod.bending[k],
    )
    shape = (
        _polynomial(rod.shape, k, 0),
        _polynomial(rod.shape, k, 1),
        _polynomial(rod.shape, k, 2),
        _polynomial(rod.shape, k, 3),
    )
    inverse_width = 1.0 / width
    for i in range(LANES):
        s = b[_ARC + i]
        h = min(max(s - start, 0.0), width)
        t = h * inverse_width
        n, q = _get(b, _N, i), _get(b, _Q, i)

        u0, c = _section(shape, twist, bend, t)
        u, n1, q1 = _rate(n, q, u0, c, extent)
        if tangents:
            b[_H + i] = -h
            _keep(b, 0, i, n, q, u, c)
            # The lane's contact lies in this step: its s-tangent starts here.
            if s > start and s <= start + width and b[_TIP + i] == 0.0:
                _put(b, _TANGENT, i, (-n1[0], -n1[1], -n1[2]))
                _put(b, _TANGENT + 3 * LANES, i, (-q1[0], -q1[1], -q1[2]))
        h = -h

        u0, c = _section(shape, twist, bend, t * (2.0 / 3.0))
        nn, qq = _y2(n, h, n1), _y2(q, h, q1)
        u, n2, q2 = _rate(nn, qq, u0, c, extent)
        if tangents:
            _keep(b, 1, i, nn, qq, u, c)

        v0, d = _section(shape, twist, bend, t * (1.0 / 3.0))
        nn, qq = _y3(n, h, n2), _y3(q, h, q2)
        u, n3, q3 = _rate(nn, qq, v0, d, extent)
        if tangents:
            _keep(b, 2, i, nn, qq, u, d)

        nn, qq = _y4(n, h, n1, n2, n3), _y4(q, h, q1, q2, q3)
        u, n4, q4 = _rate(nn, qq, u0, c, extent)
        if tangents:
            _keep(b, 3, i, nn, qq, u, c)

        u0, c = _section(shape, twist, bend, t * 0.5)
        nn, qq = _y5(n, h, n1, n2, n3, n4), _y5(q, h, q1, q2, q3, q4)
        u, n5, q5 = _rate(nn, qq, u0, c, extent)
        if tangents:
            _keep(b, 4, i, nn, qq, u, c)

        nn, qq = _y6(n, h, n2, n3, n4, n5), _y6(q, h, q2, q3, q4, q5)
        u, n6, q6 = _rate(nn, qq, u0, c, extent)
        if tangents:
            _keep(b, 5, i, nn, qq, u, c)

        u0, c = _section(shape, twist, bend, 0.0)
        nn, qq = _y7(n, h, n1, n2, n3, n4, n6), _y7(q, h, q1, q2, q3, q4, q6)
        u, n7, q7 = _rate(nn, qq, u0, c, extent)
        if tangents:
            _keep(b, 6, i, nn, qq, u, c)

        _put(b, _N, i, _advance(n, h, n1, n3, n4, n5, n6, n7))
        _put(b, _Q, i, _advance(q, h, q1, q3, q4, q5, q6, q7))


@inlined
def _tangent_step(b: Array, row: int) -> None:
    """Take the same step with the tangent at ``row``, on the stages that the values left."""
    for i in range(6 * LANES):
        b[_MOVING + i] = b[row + i]
    for i in range(LANES):
        h = b[_H + i]
        n, q = _get(b, _MOVING, i), _get(b, _MOVING + 3 * LANES, i)
        n1, q1 = _tangent_rate(b, 0, i, n, q)
        n2, q2 = _tangent_rate(b, 1, i, _y2(n, h, n1), _y2(q, h, q1))
        n3, q3 = _tangent_rate(b, 2, i, _y3(n, h, n2), _y3(q, h, q2))
        n4, q4 = _tangent_rate(b, 3, i, _y4(n, h, n1, n2, n3), _y4(q, h, q1, q2, q3))
        n5, q5 = _tangent_rate(b, 4, i, _y5(n, h, n1, n2, n3, n4), _y5(q, h, q1, q2, q3, q4))
        n6, q6 = _tangent_rate(b, 5, i, _y6(n, h, n2, n3, n4, n5), _y6(q, h, q2, q3, q4, q5))
        n7, q7 = _tangent_rate(
            b, 6, i, _y7(n, h, n1, n2, n3, n4, n6), _y7(q, h, q1, q2, q3, q4, q6)
        )
        _put(b, _MOVING, i, _advance(n, h, n1, n3, n4, n5, n6, n7))
        _put(b, _MOVING + 3 * LANES, i, _advance(q, h, q1, q3, q4, q5, q6, q7))
    for i in range(6 * LANES):
        b[row + i] = b[_MOVING + i]


@inlined
def set_lane(b: Array, i: int, s: float, fx: float, fy: float, fz: float, tip: bool) -> None:
    """Load lane i with a contact at s and its force; ``tip`` makes f_x the first unknown."""
    b[_ARC + i] = s
    _put(b, _N, i, (fx, fy, fz))
    _put(b, _Q, i, (0.0, 0.0, 0.0))
    b[_TIP + i] = 1.0 if tip else 0.0
    for row in range(_TANGENT, _TANGENT + 18 * LANES, LANES):
        b[row + i] = 0.0
    if tip:
        b[_TANGENT + i] = 1.0
    b[_TANGENT + (6 + 1) * LANES + i] = 1.0
    b[_TANGENT + (12 + 2) * LANES + i] = 1.0


@inlined
def set_all_lanes(b: Array, s: float, fx: float, fy: float, fz: float) -> None:
    """Load every lane with one contact; their first tangents are those of s, f_x, f_y, f_z."""
    for i in range(LANES):
        set_lane(b, i, s, fx, fy, fz, i > 0)
        for row in range(3):
            b[_TANGENT + row * LANES + i] = 1.0 if i == row + 1 else 0.0


@inlined
def lanes_tangents(b: Array, tangents: Array) -> None:
    """Copy ∂(F, p)/∂(s, f_x, f_y, f_z) of the one contact in all lanes into ``tangents`` (6, 4)."""
    for row in range(6):
        for i in range(LANES):
            tangents[row, i] = b[_TANGENT + row * LANES + i]


@inlined
def lane_value(b: Array, i: int, value: Array) -> None:
    """Copy (F, p) of lane i into ``value`` (6,)."""
    for j in range(6):
        value[j] = b[_N + j * LANES + i]


@inlined
def lane_tangents(b: Array, i: int, tangents: Array) -> None:
    """Copy ∂(F, p)/∂ξ of lane i into ``tangents`` (6, 3)."""
    for j in range(3):
        for row in range(6):
            tangents[row, j] = b[_TANGENT + (6 * j + row) * LANES + i]


@inlined
def _carry_step(b: Array, row: int) -> None:
    """Take the same step with a vector that is fixed in space: v' = v × u in the material frame."""
    for i in range(LANES):
        h, v = b[_H + i], _get(b, row, i)
        u = 6 * LANES
        v1 = _cross(v, _get(b, u, i))
        v2 = _cross(_y2(v, h, v1), _get(b, _STAGE + u, i))
        v3 = _cross(_y3(v, h, v2), _get(b, 2 * _STAGE + u, i))
        v4 = _cross(_y4(v, h, v1, v2, v3), _get(b, 3 * _STAGE + u, i))
        v5 = _cross(_y5(v, h, v1, v2, v3, v4), _get(b, 4 * _STAGE + u, i))
        v6 = _cross(_y6(v, h, v2, v3, v4, v5), _get(b, 5 * _STAGE + u, i))
        v7 = _cross(_y7(v, h, v1, v2, v3, v4, v6), _get(b, 6 * _STAGE + u, i))
        _put(b, row, i, _advance(v, h, v1, v3, v4, v5, v6, v7))


@kernel
def integrate(rod: Rod, b: Array, tangents: int) -> None:
    """Integrate every lane from its contact to the base, with its first so many tangents."""
    start = rod.start
    farthest = b[_ARC]
    for i in range(1, LANES):
        farthest = max(farthest, b[_ARC + i])
    for k in range(start.shape[0] - 1, -1, -1):
        if start[k] < farthest:
            if tangents > 0:
                _value_step(rod, b, k, True)
                for j in range(tangents):
                    _tangent_step(b, _TANGENT + 6 * LANES * j)
            else:
                _value_step(rod, b, k, False)


@kernel
def evaluate(
    rod: Rod, contacts: Array, values: Array, tangents: Array, first: int, last: int
) -> None:
    """Base force and contact point of many contacts."""
    b, four = np.zeros(BUFFER_SIZE), np.empty((6, 4))
    wanted = tangents.shape[0] > 0
    if wanted and last == first + 1:  # a contact by itself: its tangents side by side
        c = contacts[first]
        set_all_lanes(b, c[0], c[1], c[2], c[3])
        integrate(rod, b, 1)
        lane_value(b, 0, values[first])
        lanes_tangents(b, four)
        for a in range(6):
            t = tangents[first, a]
            t[0], t[1], t[2] = four[a, 0], four[a, 2], four[a, 3]
        return
    for row in range(first, last, LANES):
        for i in range(LANES):
            j = min(row + i, last - 1)
            set_lane(b, i, contacts[j, 0], contacts[j, 1], contacts[j, 2], contacts[j, 3], False)
        integrate(rod, b, 3 if wanted else 0)
        for i in range(min(LANES, last - row)):
            lane_value(b, i, values[row + i])
            if wanted:
                lane_tangents(b, i, tangents[row + i])


@kernel
def _carry_tangents(rod: Rod, contacts: Array, tangents: Array, first: int, last: int) -> None:
    """Unit tangents of the deflected whisker at its contacts, in the base frame."""
    b = np.zeros(BUFFER_SIZE)
    for row in range(first, last, LANES):
        for i in range(LANES):
            j = min(row + i, last - 1)
            set_lane(b, i, contacts[j, 0], contacts[j, 1], contacts[j, 2], contacts[j, 3], True)
            _put(b, _TANGENT, i, (1.0, 0.0, 0.0))
        for k in range(rod.start.shape[0] - 1, -1, -1):
            _value_step(rod, b, k, True)
            _carry_step(b, _TANGENT)
        for i in range(min(LANES, last - row)):
            for j in range(3):
                tangents[row + i, j] = b[_TANGENT + j * LANES + i]


def solve_forces(
    discretization: Discretization, contacts: Array, tangents: bool = False
) -> tuple[Array, Array]:
    """Base force and contact point of contacts whose force is known, non-dimensional.

    Parameters
    ----------
    discretization : Discretization
        Rod.
    contacts : (n, 4) array
        Arc length and force in the material frame there, (s, f_x, f_y, f_z).
    tangents : bool
        Whether derivatives are wanted.

    Returns
    -------
    values : (n, 6) array
        Base force and contact point (F, p).
    tangents : (n, 6, 3) array
        Derivatives by ξ = (s, f_y, f_z); no rows unless wanted.
    """
    contacts = np.ascontiguousarray(contacts, dtype=np.float64)
    n = contacts.shape[0]
    values = np.empty((n, 6))
    derivatives = np.empty((n if tangents else 0, 6, 3))
    rod = discretization.rod
    share_out(n, lambda first, last: evaluate(rod, contacts, values, derivatives, first, last))
    return values, derivatives


def contact_tangents(discretization: Discretization, contacts: Array) -> Array:
    """Unit tangents of the deflected whisker at its contacts.

    Parameters
    ----------
    discretization : Discretization
        Rod.
    contacts : (n, 4) array
        Arc length and force in the material frame there, (s, f_x, f_y, f_z).

    Returns
    -------
    (n, 3) array
        Tangents in the whisker frame.
    """
    contacts = np.ascontiguousarray(contacts, dtype=np.float64)
    tangents = np.empty((len(contacts), 3))
    rod = discretization.rod
    share_out(
        len(contacts), lambda first, last: _carry_tangents(rod, contacts, tangents, first, last)
    )
    return tangents
