"""Mean, covariance and mass of the posterior density of a contact point, to second order; compiled.

A contact ξ̂ explains channels best, among them a prior of the point p. Each contact point of Ω has
the density exp(-|r|²/2), which is zero outside: beyond the tip, proximal to the limit, and beyond
the fold. With residuals and point to second order in u
(:mod:`~vibrissa.contacts.uncertainty.expansion`), moments of this density are summed over nodes,

    ∫ g(p(u)) exp(-|r(u)|²/2) det ∂p/∂u du.

At a fold of p, where a whisker slips off, the determinant vanishes: to first order the density is a
sheet without volume, and its maximum is on the boundary of Ω. To second order it has the thickness
and the volume of the contacts that the noise does not distinguish from those at the fold.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.fitting.least_squares import Fits, channel_equations, whiten
from vibrissa.contacts.uncertainty.expansion import (
    Expansion,
    all_determined,
    cap_axes,
    empty_expansion,
    expand,
    first_order_covariance,
    principal_axes,
    second_order_size,
    shorten_axes,
    without_friction,
)
from vibrissa.contacts.uncertainty.posterior import (
    NODES,
    STRAIGHT,
    TOO_FEW,
    WEIGHTS,
    Rays,
    densities,
    empty_rays,
)
from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, kernel, shared, solve
from vibrissa.rod import BUFFER_SIZE, Charted


class Onset(NamedTuple):
    """Prior of a contact at its onset: the density (m² + u²)^(-3/2) at distance u from rest.

    The resting centreline (n, 3) at equal steps of s from 0 to 1, and m; if m is 0, all contact
    points are equally probable.
    """

    rest: Array
    reach: float


@inlined
def _from_rest(rest: Array, s: float, point: Array) -> float:
    """Squared distance of a contact point at s from its position at rest, on (n, 3) points."""
    last = rest.shape[0] - 1
    i = min(max(int(s * last), 0), last - 1)
    share, total = s * last - i, 0.0
    for a in range(3):
        total += (point[a] - (1.0 - share) * rest[i, a] - share * rest[i + 1, a]) ** 2
    return total


@inlined
def _expect(
    model: Expansion, x: Array, value: Array, onset: Onset, points: Array, out: Array
) -> None:
    """Multiply densities at nodes ±u by the prior relative to its value at the centre."""
    half, at = NODES.shape[1], np.empty(3)
    square = onset.reach * onset.reach
    here = square + _from_rest(onset.rest, x[0], value[3:])
    for m in range(2 * half):
        side, s = 1.0 if m < half else -1.0, x[0]
        for i in range(3):
            u = NODES[i, m % half]
            s += side * model.axes[0, i] * u
            for q in range(3):
                s += 0.5 * model.bent_s[i, q] * u * NODES[q, m % half]
            at[i] = value[3 + i] + points[i, m]
        out[m] *= (here / (square + _from_rest(onset.rest, min(max(s, 0.0), 1.0), at))) ** 1.5


@inlined
def _over_nodes(
    model: Expansion,
    x: Array,
    value: Array,
    proximal: float,
    turn: float,
    onset: Onset,
    first_order: float,
    rays: Rays,
    shift: Array,
    covariance: Array,
) -> float:
    """Fill the mean minus p̂ and the covariance, from those to first order; return the mass."""
    half = NODES.shape[1]
    points, density = rays.points, rays.density
    densities(model, x[0], proximal, turn, rays)
    if onset.reach > 0.0:
        _expect(model, x, value, onset, points, density)
    middle = 1.0
    for m in range(half):
        middle -= 2.0 * WEIGHTS[m]
    mass = middle * first_order
    squares = middle * first_order * first_order
    for m in range(2 * half):
        share = WEIGHTS[m % half] * density[m]
        mass += share
        squares += share * density[m]
        density[m] = share
    if not mass > 0.0:
        return first_order
    if not squares * TOO_FEW < mass * mass:
        # Too few nodes are in Ω: their moments are added to those of the first order.
        for a in range(3):
            for c in range(3):
                for m in range(2 * half):
                    covariance[a, c] += density[m] * points[a, m] * points[c, m] / mass
        return mass
    for a in range(3):
        for m in range(2 * half):
            shift[a] += density[m] * points[a, m] / mass
    for a in range(3):
        for c in range(3):
            covariance[a, c] = -shift[a] * shift[c]
            for m in range(2 * half):
                covariance[a, c] += density[m] * points[a, m] * points[c, m] / mass
    return mass


@inlined
def _or_as_noise(x: Array, j: Array, scale: Array) -> None:
    """Fill x, with its force increased to that which noise alone would give.

    Axes are limited relative to the force, which may change by many times its own size for a
    contact lighter than the noise; without any force they would have no length.
    """
    least = np.inf
    for p in range(1, 3):
        size = 0.0
        for a in range(j.shape[0]):
            size += j[a, p] * j[a, p]
        least = min(least, size)
    copy(x, scale)
    scale[2], scale[3] = max(math.hypot(x[2], x[3]), 1.0 / math.sqrt(max(least, 1e-300))), 0.0


@shared
def moments(
    rod: Charted,
    proximal: float,
    onset: Onset,
    codes: IntArray,
    target: Array,
    weights: Array,
    x: Array,
    value: Array,
    tangents: Array,
    linear: bool,
    shift: Array,
    covariance: Array,
    by_channels: Array,
) -> float:
    """Fill mean minus contact point, covariance, and ∂p̂/∂(weighted channels), (3, k).

    For a contact x with (F, p) and ∂(F, p)/∂x (6, 4) of minimum χ² in Ω. Return the mass of the
    density relative to exp(-χ²/2) (2π)^(3/2) and to the onset prior, both at x; NaN if the channels
    do not determine the point. If ``linear``, the first order is used.
    """
    k, b, nothing = codes.shape[0], np.zeros(BUFFER_SIZE), np.zeros(3)
    residual, jacobian, four = np.empty(k), np.empty((k, 4)), np.empty((k, 4))
    j, slopes, scale = np.empty((k, 3)), np.empty((3, 3)), np.empty(4)
    model, rays = empty_expansion(k), empty_rays()
    r0, by_r, by_p, axes = model.r0, model.by_r, model.by_p, model.axes
    channel_equations(x, value, tangents, codes, target, residual, jacobian)
    whiten(weights, residual, jacobian, k, r0, four)
    without_friction(four, j)
    without_friction(tangents[3:], slopes)
    _or_as_noise(x, j, scale)
    if not principal_axes(scale, j, axes):
        return np.nan
    short = cap_axes(scale, axes)
    expand(rod, b, False, codes, target, weights, x, slopes, j, model)
    if not all_determined(model):
        return np.nan
    bent = second_order_size(model)
    short = shorten_axes(model) or short
    first_order_covariance(by_p, covariance)
    shift[:] = 0.0
    pulled, away = 0.0, 0.0
    for i in range(3):
        away += axes[0, i] ** 2
        pull = 0.0
        for a in range(k):
            pull += r0[a] * by_r[a, i]
        pulled = max(pulled, abs(pull))
        for a in range(3):
            for c in range(k):
                step = by_p[a, i] * by_r[c, i]
                by_channels[a, c] = step if i == 0 else by_channels[a, c] + step
    away = 4.0 * math.sqrt(away)
    for a in range(3):
        copy(by_p[a], slopes[a])
    first_order = abs(solve(slopes, nothing))
    straight = proximal + away < x[0] < 1.0 - away and not short and onset.reach == 0.0
    if linear or (straight and bent < STRAIGHT and pulled < STRAIGHT):
        return first_order
    for a in range(3):
        copy(axes[a], slopes[a])
    turn = math.copysign(1.0, solve(slopes, nothing))
    return _over_nodes(model, x, value, proximal, turn, onset, first_order, rays, shift, covariance)


@kernel
def moments_of_rows(
    rod: Charted,
    proximal: float,
    onset: Onset,
    codes: IntArray,
    targets: Array,
    weights: Array,
    fits: Fits,
    linear: AnyArray,
    shifts: Array,
    covariances: Array,
    by_channels: Array,
    masses: Array,
) -> None:
    """Fill the results of `moments` for rows of contacts."""
    for row in range(len(targets)):
        masses[row] = moments(
            rod,
            proximal,
            onset,
            codes,
            targets[row],
            weights[row],
            fits.contacts[row],
            fits.values[row],
            fits.tangents[row],
            linear[row],
            shifts[row],
            covariances[row],
            by_channels[row],
        )
