"""The deflected whisker: the rod equations from the base outward, with the base force known.

With F and p the material frame R = (t, d₁, d₂) and the place r follow from

    t' = u_z d₁ - u_y d₂,   d₁' = u_x d₂ - u_z t,   d₂' = u_y t - u_x d₁,   r' = t,
    u = u₀ + c ∘ Rᵀ((p - r) × F) up to the contact, u₀ beyond it,

integrated with the same method and on the same steps as the contact problem, cut at the contact and
at the places that are asked for.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, copy, inlined, kernel, share_out
from vibrissa.rod.discretization import Discretization, Rod

WEIGHTS = np.array([11.0, 0.0, 81.0, 81.0, -32.0, -32.0, 11.0]) / 120.0
NODES = np.array([0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0 / 3.0, 0.5, 0.5, 1.0])
STAGES = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1.0 / 3.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 2.0 / 3.0, 0.0, 0.0, 0.0, 0.0],
        [1.0 / 12.0, 1.0 / 3.0, -1.0 / 12.0, 0.0, 0.0, 0.0],
        [-1.0 / 16.0, 9.0 / 8.0, -3.0 / 16.0, -3.0 / 8.0, 0.0, 0.0],
        [0.0, 9.0 / 8.0, -3.0 / 8.0, -3.0 / 4.0, 0.5, 0.0],
        [9.0 / 44.0, -9.0 / 11.0, 63.0 / 44.0, 18.0 / 11.0, 0.0, -16.0 / 11.0],
    ]
)


@inlined
def _rates(
    rod: Rod, k: int, t: float, loaded: bool, force: Array, point: Array, y: Array, dy: Array
) -> None:
    """Derivatives of (r, t, d₁, d₂), 12 numbers, at the fraction t of step k."""
    c = rod.shape[k]
    u = np.empty(3)
    for a in range(3):
        u[a] = c[a, 0] + t * (c[a, 1] + t * (c[a, 2] + t * c[a, 3]))
    if loaded:
        r = c[3, 0] + t * (c[3, 1] + t * (c[3, 2] + t * c[3, 3]))
        compliance = 1.0 / (r * r * r * r)
        x0, x1, x2 = point[0] - y[0], point[1] - y[1], point[2] - y[2]
        m0 = x1 * force[2] - x2 * force[1]
        m1 = x2 * force[0] - x0 * force[2]
        m2 = x0 * force[1] - x1 * force[0]
        for a in range(3):
            m = y[3 + 3 * a] * m0 + y[4 + 3 * a] * m1 + y[5 + 3 * a] * m2
            u[a] += compliance * (rod.twist[k] if a == 0 else rod.bending[k]) * m
    for i in range(3):
        t_i, d1, d2 = y[3 + i], y[6 + i], y[9 + i]
        dy[i] = rod.extent[k] * t_i
        dy[3 + i] = u[2] * d1 - u[1] * d2
        dy[6 + i] = u[0] * d2 - u[2] * t_i
        dy[9 + i] = u[1] * t_i - u[0] * d1


@kernel
def _shapes(
    rod: Rod, values: Array, arc: Array, s: Array, places: Array, first: int, last: int
) -> None:
    """Places (n, m, 3) at increasing arc lengths s (m,), for values (F, p) and contacts at arc."""
    start, width = rod.start, rod.width
    y, argument, slopes = np.empty(12), np.empty(12), np.empty((7, 12))
    for row in range(first, last):
        force, point, contact = values[row, :3], values[row, 3:], arc[row]
        for a in range(12):
            y[a] = 0.0
        y[3] = y[7] = y[11] = 1.0
        wanted = 0
        for k in range(start.shape[0]):
            here, end = start[k], start[k] + width[k]
            while True:
                while wanted < s.shape[0] and s[wanted] <= here + 1e-12 and rod.extent[k] > 0.0:
                    copy(y, places[row, wanted])
                    wanted += 1
                if here >= end - 1e-15:
                    break
                to = end
                if rod.extent[k] > 0.0 and wanted < s.shape[0]:
                    to = min(to, s[wanted])
                loaded = here < contact - 1e-14
                if loaded:
                    to = min(to, contact)
                h = to - here
                for stage in range(7):
                    for a in range(12):
                        argument[a] = y[a]
                        for b in range(stage):
                            argument[a] += h * STAGES[stage, b] * slopes[b, a]
                    t = (here + NODES[stage] * h - start[k]) / width[k]
                    _rates(rod, k, t, loaded, force, point, argument, slopes[stage])
                for stage in range(7):
                    for a in range(12):
                        y[a] += h * WEIGHTS[stage] * slopes[stage, a]
                here = to
        while wanted < s.shape[0]:
            copy(y, places[row, wanted])
            wanted += 1


def shapes(discretization: Discretization, values: Array, arc: Array, s: Array) -> Array:
    """Centrelines of deflected whiskers, non-dimensional.

    Parameters
    ----------
    discretization : Discretization
        Rod.
    values : (n, 6) array
        Base force and contact point (F, p) of each whisker.
    arc : (n,) array
        Arc length of each contact, over L.
    s : (m,) array
        Arc lengths of the wanted points, over L, increasing.

    Returns
    -------
    (n, m, 3) array
        Points over L, whisker frame; NaN where a row has no values.
    """
    places = np.full((len(values), s.size, 3), np.nan)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(arc))
    kept, where = np.ascontiguousarray(values[rows]), np.ascontiguousarray(arc[rows])
    found = np.empty((rows.size, s.size, 3))
    rod, s = discretization.rod, np.ascontiguousarray(s)
    share_out(rows.size, lambda first, last: _shapes(rod, kept, where, s, found, first, last))
    places[rows] = found
    return places


def contact_frames(discretization: Discretization, values: Array, arc: Array) -> Array:
    """Material frames of deflected whiskers where they are touched.

    Parameters
    ----------
    discretization : Discretization
        Rod.
    values : (n, 6) array
        Base force and contact point (F, p) of each whisker, non-dimensional.
    arc : (n,) array
        Arc length of each contact, over L.

    Returns
    -------
    (n, 3, 3) array
        Frames with columns (tangent, d1, d2), whisker frame; NaN where a row has no values.
    """
    frames = np.full((len(values), 3, 3), np.nan)
    rows = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(arc))
    # Contacts at the same arc length, such as the nodes of a chart, go together.
    lengths, group = np.unique(arc[rows], return_inverse=True)
    order = np.argsort(group, kind="stable")
    edges = np.searchsorted(group[order], np.arange(lengths.size + 1))
    kept = np.ascontiguousarray(values[rows[order]])
    found = np.empty((rows.size, 1, 12))
    where, rod = np.repeat(lengths, np.diff(edges)), discretization.rod
    for k in range(lengths.size):
        _shapes(rod, kept, where, lengths[k : k + 1], found, int(edges[k]), int(edges[k + 1]))
    frames[rows[order]] = np.swapaxes(found[:, 0, 3:].reshape(-1, 3, 3), -1, -2)
    return frames
