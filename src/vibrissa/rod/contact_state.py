"""One contact with any force, and the tangent of the whisker there, with all four derivatives.

Besides (n, q) of :mod:`vibrissa.rod.kernels` a third vector is integrated from the contact to the
base: the whisker's tangent at the contact, which as seen from the material frame obeys

    w' = w × u,    w(s_c) = e₁,

so that w(0) is that tangent in the whisker's frame. Surfaces need it: a smooth surface that touches
the side of a whisker has its normal at a right angle to it, whatever the friction. The unknowns are
(s_c, f_x, f_y, f_z); their derivatives δ(n, q, w) obey the variational equations, start as
-(n', q', w')(s_c) for s_c and as unit forces for the others, and run as four columns side by side.

Same steps and Runge-Kutta method as in :mod:`vibrissa.rod.kernels`, one contact at a time.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, inlined, kernel
from vibrissa.rod.discretization import Rod
from vibrissa.rod.equations import whisker_radius
from vibrissa.rod.shape import NODES, STAGES, WEIGHTS

STATES = 9
"""(F, p, t): base force, contact point, tangent at the contact; whisker frame, non-dimensional."""

_UNKNOWNS = 4
_COLUMNS = 1 + _UNKNOWNS


@inlined
def _rates(rod: Rod, k: int, t: float, y: Array, dy: Array) -> None:
    """Derivatives of (n, q, w) and of its tangents, rows of y (9, 5), at the fraction t of step k.

    Column 0 holds the values, the others the tangents.
    """
    c = rod.shape[k]
    radius = c[3, 0] + t * (c[3, 1] + t * (c[3, 2] + t * c[3, 3]))
    inverse = 1.0 / (radius * radius)
    inverse *= inverse
    soft0, soft1 = rod.twist[k] * inverse, rod.bending[k] * inverse
    n0, n1, n2 = y[0, 0], y[1, 0], y[2, 0]
    q0, q1, q2 = y[3, 0], y[4, 0], y[5, 0]
    u0 = c[0, 0] + t * (c[0, 1] + t * (c[0, 2] + t * c[0, 3])) + soft0 * (q1 * n2 - q2 * n1)
    u1 = c[1, 0] + t * (c[1, 1] + t * (c[1, 2] + t * c[1, 3])) + soft1 * (q2 * n0 - q0 * n2)
    u2 = c[2, 0] + t * (c[2, 1] + t * (c[2, 2] + t * c[2, 3])) + soft1 * (q0 * n1 - q1 * n0)
    for a in range(0, 9, 3):
        for j in range(_COLUMNS):
            dy[a, j] = y[a + 1, j] * u2 - y[a + 2, j] * u1
            dy[a + 1, j] = y[a + 2, j] * u0 - y[a, j] * u2
            dy[a + 2, j] = y[a, j] * u1 - y[a + 1, j] * u0
    dy[3, 0] -= rod.extent[k]
    for j in range(1, _COLUMNS):
        d0 = soft0 * (y[4, j] * n2 - y[5, j] * n1 + q1 * y[2, j] - q2 * y[1, j])
        d1 = soft1 * (y[5, j] * n0 - y[3, j] * n2 + q2 * y[0, j] - q0 * y[2, j])
        d2 = soft1 * (y[3, j] * n1 - y[4, j] * n0 + q0 * y[1, j] - q1 * y[0, j])
        for a in range(0, 9, 3):
            dy[a, j] += y[a + 1, 0] * d2 - y[a + 2, 0] * d1
            dy[a + 1, j] += y[a + 2, 0] * d0 - y[a, 0] * d2
            dy[a + 2, j] += y[a, 0] * d1 - y[a + 1, 0] * d0


@kernel
def contact_state(rod: Rod, contact: Array, state: Array) -> tuple[float, float]:
    """Integrate one contact to the base."""
    start, width = rod.start, rod.width
    s = contact[0]
    slopes = np.zeros((7, STATES, _COLUMNS))
    argument = np.empty((STATES, _COLUMNS))
    for a in range(STATES):
        for j in range(_COLUMNS):
            state[a, j] = 0.0
    for a in range(3):
        state[a, 0] = contact[1 + a]
        state[a, 2 + a] = 1.0
    state[6, 0] = 1.0
    at_contact = True
    for k in range(start.shape[0] - 1, -1, -1):
        if start[k] >= s:
            continue
        h = -min(s - start[k], width[k])
        if at_contact:
            _rates(rod, k, -h / width[k], state, slopes[0])
            for a in range(STATES):
                state[a, 1] = -slopes[0, a, 0]
            at_contact = False
        for stage in range(7):
            for a in range(STATES):
                for j in range(_COLUMNS):
                    argument[a, j] = state[a, j]
            for b in range(stage):
                weight = h * STAGES[stage, b]
                if weight != 0.0:
                    for a in range(STATES):
                        for j in range(_COLUMNS):
                            argument[a, j] += weight * slopes[b, a, j]
            _rates(rod, k, -h * (1.0 - NODES[stage]) / width[k], argument, slopes[stage])
        for stage in range(7):
            weight = h * WEIGHTS[stage]
            if weight != 0.0:
                for a in range(STATES):
                    for j in range(_COLUMNS):
                        state[a, j] += weight * slopes[stage, a, j]
    return whisker_radius(rod, s)
