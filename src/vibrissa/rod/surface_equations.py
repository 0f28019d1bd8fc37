"""The equations of one contact with a surface, with or without friction.

With (F, p, t) of :mod:`vibrissa.rod.contact_state`, d the surface's signed distance at p, n its
outward normal there, N = F·n the pressing force and T = F - N n the friction, four equations fix
(s_c, f_x, f_y, f_z):

- the surfaces touch, one whisker radius away from the centreline: d - a(s_c) + N/k = 0, with k the
  object's stiffness (1/k = 0: rigid);
- on the whisker's side it lies along the surface, t·n = 0; at its tip s_c = 1 instead;
- two for the friction, in the tangent plane: T = Π(T - c Δ), Π the projection onto the disc of
  radius µN and c > 0 any number. They say |T| ≤ µN, and either no sliding (Δ = 0) or T = -µN Δ/|Δ|.

Δ is how far the whisker's material has slid over the surface since the contact was last known, at
(p₁, t₁, s₁): the contact's way in space less its way along the whisker,

    Δ = p - p₁ - ½ (t + t₁)(s_c - s₁),

so a contact that rolls along both without slip has none. Friction acts on the centreline.

At zero force det of the four rows in the order above is negative wherever a surface first touches
(n, e₁, e₂ being right-handed): the whisker curves away from the surface and yields to a push. It
stays so along the branch that is stable and connected to rest, sticking or sliding, and vanishes at
its end, where the whisker slips off.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, kernel, solve

EITHER, STICKING, SLIDING = 0, 1, 2


@kernel
def surface_equations(
    contact: Array,
    state: Array,
    whisker_radius: float,
    whisker_slope: float,
    geometry: Array,
    lean: Array,
    softness: float,
    friction: float,
    earlier: Array,
    tip: bool,
    mode: int,
    jacobian: Array,
    step: Array,
) -> tuple[float, float, float, bool, bool]:
    """Residual and its derivatives, solved for Newton's step; lengths over L, forces over EI/L²."""
    n, e = geometry[1:4], np.empty((2, 3))
    least = 0
    for i in range(1, 3):
        if abs(n[i]) < abs(n[least]):
            least = i
    a, b = (least + 1) % 3, (least + 2) % 3
    size = 1.0 / np.sqrt(n[a] * n[a] + n[b] * n[b])
    e[0, least], e[0, a], e[0, b] = 0.0, n[b] * size, -n[a] * size
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        e[1, i] = n[j] * e[0, k] - n[k] * e[0, j]

    pressing, along, away = 0.0, 0.0, contact[0] - earlier[6]
    for i in range(3):
        pressing += (n[i] + lean[i]) * state[i, 0]
        along += (n[i] + lean[i]) * state[6 + i, 0]
    # The tangent plane's share of friction, way slid, and what is projected.
    push, way, wanted = np.empty(2), np.empty(2), np.empty(2)
    give = 0.0
    for j in range(1, 4):
        part = 0.0
        for i in range(3):
            part += n[i] * state[3 + i, 1 + j]
        give += part * part
    give = np.sqrt(give)
    limit = friction * max(pressing, 0.0)
    for r in range(2):
        push[r] = way[r] = 0.0
        for i in range(3):
            mean = 0.5 * (state[6 + i, 0] + earlier[3 + i])
            push[r] += e[r, i] * (state[i, 0] - pressing * lean[i])
            way[r] += e[r, i] * (state[3 + i, 0] - earlier[i] - away * mean)
        wanted[r] = push[r] - way[r] / give
    strength = np.hypot(wanted[0], wanted[1])
    beyond = bool(strength >= limit)
    sliding = beyond if mode == EITHER else mode == SLIDING
    if strength > 0.0:
        toward0, toward1 = wanted[0] / strength, wanted[1] / strength
    else:
        toward0, toward1 = 0.0, 0.0

    step[0] = -(geometry[0] - whisker_radius + softness * pressing)
    step[1] = -((contact[0] - 1.0) if tip else along)
    if sliding:
        step[2] = -give * (push[0] - limit * toward0)
        step[3] = -give * (push[1] - limit * toward1)
    else:
        step[2], step[3] = -way[0], -way[1]
    misfit = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2 + step[3] ** 2)

    turn = np.empty(3)
    d_push, d_way = np.empty(2), np.empty(2)
    for j in range(4):
        closer, d_along, d_pressing = 0.0, 0.0, 0.0
        for i in range(3):
            turn[i] = 0.0
            for k in range(3):
                turn[i] += geometry[4 + 3 * i + k] * state[3 + k, 1 + j]
            closer += n[i] * state[3 + i, 1 + j]
            d_along += n[i] * state[6 + i, 1 + j] + turn[i] * state[6 + i, 0]
            d_pressing += n[i] * state[i, 1 + j] + turn[i] * state[i, 0]
        jacobian[0, j] = closer + softness * d_pressing
        jacobian[1, j] = d_along
        for r in range(2):
            d_push[r] = d_way[r] = 0.0
            for i in range(3):
                d_push[r] += e[r, i] * (state[i, 1 + j] - pressing * turn[i])
                slid = state[3 + i, 1 + j] - 0.5 * away * state[6 + i, 1 + j]
                if j == 0:
                    slid -= 0.5 * (state[6 + i, 0] + earlier[3 + i])
                d_way[r] += e[r, i] * slid
        if j == 0:
            jacobian[0, j] -= whisker_slope
        if sliding:
            d0 = d_push[0] - d_way[0] / give
            d1 = d_push[1] - d_way[1] / give
            # Across the direction of sliding the projection turns what comes in.
            across = -toward1 * d0 + toward0 * d1
            turned = limit * across / strength if strength > 0.0 else 0.0
            d_limit = friction * d_pressing if pressing > 0.0 else 0.0
            jacobian[2, j] = give * (d_push[0] - d_limit * toward0 + turned * toward1)
            jacobian[3, j] = give * (d_push[1] - d_limit * toward1 - turned * toward0)
        else:
            jacobian[2, j], jacobian[3, j] = d_way[0], d_way[1]
    if tip:
        jacobian[1, 0], jacobian[1, 1], jacobian[1, 2], jacobian[1, 3] = 1.0, 0.0, 0.0, 0.0
    return misfit, solve(jacobian, step), pressing, sliding, sliding == beyond
