"""Where a known base wrench leaves the whisker: the rod equations from the base outward.

With n = RᵀF the force and m the moment that the whisker carries, both in the material frame,

    n' = n × u,   m' = m × u + n × e₁,   u = u₀(s) + c(s) ∘ m,   n(0) = F,   m(0) = M,

and the only external force acts where the moment has vanished: at the contact, m(s_c) = 0, whatever
the direction of the force. A measured wrench never meets that exactly. Since

    d|m|²/ds = 2 m · (n × e₁),

the places where the moment comes nearest to zero are the zeros of m · (n × e₁) with rising sign.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, IntArray, copy, inlined, kernel, share_out
from vibrissa.rod.discretization import Discretization, Rod
from vibrissa.rod.shape import NODES, STAGES, WEIGHTS

#: At most so many places are kept for one wrench.
MOST_PLACES = 6
# What is bent more than this (rad) in one step is no rod any more, but what lies beyond a contact.
_MOST_TURN = 1.5


@inlined
def _rates(rod: Rod, k: int, t: float, y: Array, dy: Array) -> None:
    """Derivatives of (n, m), 6 numbers, at the fraction t of step k."""
    c, extent = rod.shape[k], rod.extent[k]
    r = c[3, 0] + t * (c[3, 1] + t * (c[3, 2] + t * c[3, 3]))
    compliance = 1.0 / (r * r * r * r)
    bend = compliance * rod.bending[k]
    u0 = c[0, 0] + t * (c[0, 1] + t * (c[0, 2] + t * c[0, 3])) + compliance * rod.twist[k] * y[3]
    u1 = c[1, 0] + t * (c[1, 1] + t * (c[1, 2] + t * c[1, 3])) + bend * y[4]
    u2 = c[2, 0] + t * (c[2, 1] + t * (c[2, 2] + t * c[2, 3])) + bend * y[5]
    for i in range(0, 6, 3):
        dy[i] = y[i + 1] * u2 - y[i + 2] * u1
        dy[i + 1] = y[i + 2] * u0 - y[i] * u2
        dy[i + 2] = y[i] * u1 - y[i + 1] * u0
    dy[4] += extent * y[2]
    dy[5] -= extent * y[1]


@inlined
def _advance(
    rod: Rod, k: int, h: float, y: Array, slopes: Array, argument: Array, end: Array
) -> None:
    """(n, m) at a distance h into step k, from y at its beginning."""
    width = rod.width[k]
    for stage in range(7):
        for a in range(6):
            argument[a] = y[a]
            for b in range(stage):
                argument[a] += h * STAGES[stage, b] * slopes[b, a]
        _rates(rod, k, NODES[stage] * h / width, argument, slopes[stage])
    for a in range(6):
        end[a] = y[a]
        for stage in range(7):
            end[a] += h * WEIGHTS[stage] * slopes[stage, a]


@inlined
def _slope(y: Array) -> float:
    """Half of d|m|²/ds, m · (n × e₁)."""
    return float(y[4] * y[2] - y[5] * y[1])


@kernel
def _places(
    rod: Rod, wrenches: Array, least: float, count: IntArray, contacts: Array, first: int, last: int
) -> None:
    start, width, extent = rod.start, rod.width, rod.extent
    y, end, inside = np.empty(6), np.empty(6), np.empty(6)
    slopes, argument = np.empty((7, 6)), np.empty(6)
    for row in range(first, last):
        copy(wrenches[row], y)
        n = 0
        for k in range(start.shape[0]):
            h = width[k]
            _advance(rod, k, h, y, slopes, argument, end)
            turn = abs(h * slopes[0, 0]) + abs(h * slopes[0, 1]) + abs(h * slopes[0, 2])
            force = abs(y[0]) + abs(y[1]) + abs(y[2])
            lost = not turn < _MOST_TURN * force
            before, after = _slope(y), _slope(end)
            last_step = lost or k == start.shape[0] - 1
            if not lost and extent[k] > 0.0 and before < 0.0 <= after:
                # False position in the step, Illinois' way.
                low, high, at_low, at_high = 0.0, h, before, after
                here = h
                for _ in range(30):
                    if not at_high - at_low > 0.0:
                        break
                    here = low - at_low * (high - low) / (at_high - at_low)
                    _advance(rod, k, here, y, slopes, argument, inside)
                    at = _slope(inside)
                    if abs(at) <= 1e-15 * (abs(before) + abs(after)) or high - low < 1e-14:
                        break
                    if at < 0.0:
                        low, at_low, at_high = here, at, 0.5 * at_high
                    else:
                        high, at_high, at_low = here, at, 0.5 * at_low
                if here == h:
                    copy(end, inside)
                if n < contacts.shape[1] and start[k] + here >= least:
                    contacts[row, n, 0] = start[k] + here
                    for a in range(3):
                        contacts[row, n, 1 + a] = inside[a]
                    n += 1
            elif last_step and before < 0.0 and n < contacts.shape[1]:
                # Still falling where the whisker, or the sense of going on, ends.
                at_end = not lost
                contacts[row, n, 0] = start[k] + (h if at_end else 0.0)
                for a in range(3):
                    contacts[row, n, 1 + a] = end[a] if at_end else y[a]
                n += 1
            if last_step:
                break
            copy(end, y)
        count[row] = n


def vanishing_moments(
    discretization: Discretization, wrenches: Array, least: float
) -> tuple[IntArray, Array]:
    """Find where the moment in the whisker comes nearest to zero, for known base wrenches.

    Parameters
    ----------
    discretization : Discretization
        Rod.
    wrenches : (n, 6) array
        Base force and moment, non-dimensional.
    least : float
        Smallest arc length of a contact, over L.

    Returns
    -------
    count : (n,) int array
        Number of contacts found.
    contacts : (n, MOST_PLACES, 4) array
        Arc length and force in the material frame of each; NaN beyond the count.
    """
    count = np.zeros(len(wrenches), np.int64)
    contacts = np.full((len(wrenches), MOST_PLACES, 4), np.nan)
    rod, wrenches = discretization.rod, np.ascontiguousarray(wrenches)
    share_out(
        len(wrenches),
        lambda first, last: _places(rod, wrenches, least, count, contacts, first, last),
    )
    return count, contacts
