"""The equations of the loads whose path is followed: contact at a point, side or tip on a peg.

Each has three unknowns x and parameters p (7):

- ``POINT``: the contact is at a point. x = (s, f_y, f_z); p: the point.
- ``SIDE``: the whisker's side on a peg. x = (s, λ, ψ) with f = λ (0, cos ψ, sin ψ); p: a point of
  the peg's axis, its direction, and its radius (negative: a line without thickness). With d the
  part of p - origin normal to the axis and F̂ = F/λ the force's direction: d = D F̂ and F̂·axis = 0,
  D the peg's radius plus the whisker's at s, or 0 for a line. Polar unknowns keep F̂ regular down to
  zero force.
- ``TIP``: the whisker's tip on a peg, the same equations at s = 1 with the force free to lean back:
  x = (λ, α, ψ), f = λ (sin α, cos α cos ψ, cos α sin ψ), α ≤ 0.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, inlined
from vibrissa.rod.chart import Fold, fold_force
from vibrissa.rod.discretization import Rod

POINT, SIDE, TIP = 0, 1, 2


@inlined
def contact_of(kind: int, x: Array, contact: Array) -> None:
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
def by_unknowns(kind: int, x: Array, t: Array) -> None:
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
    start, width, shape = rod.start, rod.width, rod.shape
    k = start.shape[0] - 1
    while k > 0 and start[k] > s:
        k -= 1
    t = (s - start[k]) / width[k]
    c = shape[k, 3]
    value = c[0] + t * (c[1] + t * (c[2] + t * c[3]))
    return value, (c[1] + t * (2.0 * c[2] + 3.0 * t * c[3])) / width[k]


@inlined
def equations(
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
def longest_step(kind: int, fold: Fold, x: Array) -> Array:
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
