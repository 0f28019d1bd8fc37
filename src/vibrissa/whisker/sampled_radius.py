"""Radius from samples: smooth pieces between the arc lengths at which it jumps or has a kink.

Neighbouring samples i, i + 1 are taken as the two sides of a jump where the change between them
cannot be the continuation of the slopes g on either side, nor noise:

    x = r_{i+1} − r_i − h_i (g_{i−1} + g_{i+1}) / 2,    |x| > 3 |g_{i+1} − g_{i−1}| h_i,

with x most of the change itself and more than 5.5 standard deviations of the noise. The jump is in
the middle of the interval: on average over where in the interval it may be, the compliance ∝ r⁻⁴
is then right. Two samples at one arc length, or so close to each other that nobody samples a slope
like that, state a jump. A kink is where the straight
lines through the samples on its two sides meet, if their slopes differ by more than 8 times what
the slopes change before and after it, and more than the noise lets them.

Each piece is a monotone cubic (PCHIP), which has no kinks and cannot overshoot below zero. The
noise comes from the smallest quarter of the differences, so that a staircase of two samples a step
does not pass for noise; a smooth profile with noise has neither jumps nor kinks.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import interpolate
from vibrissa.whisker.profile import Profile, approximate

Array = NDArray[np.float64]

MOST = 64
"""Jumps and kinks beyond which samples count as rounded, not as a rod with so many steps."""

_SIGNIFICANT = 5.5
_TURNED = 8.0
_OUTSTANDING = 3.0
_NEGLIGIBLE = 1e-4
"""Share of the radius below which a change is not looked at."""

_CLOSE = 2e-3
"""Distance of two samples that state a jump, at most, in distances to the samples around them."""

_MANY = 30
"""Number of samples from which on noise can be distinguished from shape."""

_PAIRED = 0.2
"""Share of close pairs among the intervals of a rod that was sampled at the ends of its steps."""

_QUARTILE = 0.3186
"""First quartile of |x| where x is normally distributed, in standard deviations."""


def sampled_radius(length: float, s: Array, r: Array) -> Profile:
    """Join samples of a radius."""
    ends = _pieces(s, r, jumps(s, r))
    if len(ends) - 1 > MOST:
        ends = _pieces(s, r, _stated(s, r), kinked=False)
    parts = [interpolate.PchipInterpolator(x, y) for x, y in ends]
    edges = np.array([x[0] for x, _ in ends[1:]])

    def radius(x: Array) -> Array:
        x = np.clip(x, s[0], s[-1])
        piece = np.searchsorted(edges, x, side="right")
        values = np.empty(x.shape)
        for j in np.unique(piece):
            values[piece == j] = parts[j](x[piece == j])
        return values

    knots = np.unique(np.concatenate([x for x, _ in ends]))
    inner = knots[(knots > 1e-9 * length) & (knots < (1.0 - 1e-9) * length)]
    return approximate(radius, np.concatenate([[0.0], inner, [length]]))


def jumps(s: Array, r: Array) -> NDArray[np.intp]:
    """Find the intervals between samples in which a radius jumps."""
    stated = _stated(s, r)
    found = [stated]
    for first, last in pairwise([0, *(stated + 1), s.size]):
        found.append(first + _jumps(s[first:last], r[first:last]))
    return np.sort(np.concatenate(found))


def scatter(s: Array, r: Array) -> float:
    """Estimate the noise of samples, as a share of the radius, from their nearest neighbours."""
    if s.size < _MANY:
        return 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.diff(s)[:-1] / (s[2:] - s[:-2])
    misfit = r[1:-1] - (1.0 - share) * r[:-2] - share * r[2:]
    misfit /= r[1:-1] * np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
    return float(np.nanquantile(np.abs(misfit), 0.25)) / _QUARTILE


def _stated(s: Array, r: Array) -> NDArray[np.intp]:
    """Jumps between two samples at one arc length, or next to it."""
    h = np.diff(s)
    around = np.minimum(np.append(np.inf, h[:-1]), np.append(h[1:], np.inf))
    close = (h <= _CLOSE * around) & (np.abs(np.diff(r)) > _NEGLIGIBLE * r[1:])
    # Points at random spacings have a few close pairs too: those are judged as all others are.
    found: NDArray[np.intp] = np.flatnonzero((h == 0.0) | (close & (close.mean() > _PAIRED)))
    return found


def _jumps(s: Array, r: Array) -> NDArray[np.intp]:
    """Jumps among samples at rising arc lengths."""
    if s.size < 4:
        return np.empty(0, dtype=np.intp)
    h, d = np.diff(s), np.diff(r)
    slope = d / h
    before, after = slope[:-2], slope[2:]
    excess = d[1:-1] - h[1:-1] * (before + after) / 2.0
    size, change, here = np.abs(excess), np.abs(d[1:-1]), r[1:-2]
    # How independent samples scatter in the excess, compared with their differences.
    left, right = h[1:-1] / h[:-2] / 2.0, h[1:-1] / h[2:] / 2.0
    weight = np.sqrt(((1.0 + left) ** 2 + (1.0 + right) ** 2 + left**2 + right**2) / 2.0)
    noise = weight * np.minimum(_noise(d[1:-1], here), _noise(excess / weight, here))
    jump = (excess * d[1:-1] > 0.0) & (size > 0.5 * change) & (size < 2.0 * change)
    jump &= size > _OUTSTANDING * np.abs(after - before) * h[1:-1]
    jump &= size > np.maximum(_SIGNIFICANT * noise, _NEGLIGIBLE * here)
    return 1 + np.flatnonzero(jump)


def _noise(differences: Array, r: Array) -> Array:
    """Standard deviations of differences, most of which may be jumps, at radii r.

    Noise may be as large everywhere, or as large a share of the radius: the larger counts.
    """
    same, share = np.quantile(np.abs([differences, differences / r]), 0.25, axis=1) / _QUARTILE
    noise: Array = np.maximum(same, share * r)
    return noise


def _pieces(
    s: Array, r: Array, before: NDArray[np.intp], kinked: bool = True
) -> list[tuple[Array, Array]]:
    """Samples of each smooth piece, with ends where it meets its neighbours."""
    pieces = []
    edges = [0, *(before + 1), s.size]
    for number, (first, last) in enumerate(pairwise(edges)):
        x, y = s[first:last], r[first:last]
        if number > 0:
            x, y = _extended(x[::-1], y[::-1], s[first - 1], r[first - 1])
            x, y = x[::-1], y[::-1]
        if number < len(edges) - 2:
            x, y = _extended(x, y, s[last], r[last])
        pieces += _between_kinks(x, y) if kinked else [(x, y)]
    return pieces


def _extended(x: Array, y: Array, beyond: float, other: float) -> tuple[Array, Array]:
    """Go on straight to the middle of the jump that follows, but not past its other side."""
    end = 0.5 * (x[-1] + beyond)
    if end == x[-1]:
        # A piece of one sample between two stated jumps is not possible: arc lengths repeat twice.
        return x, y
    slope = (y[-1] - y[-2]) / (x[-1] - x[-2]) if x.size > 1 else 0.0
    value = np.clip(y[-1] + slope * (end - x[-1]), *sorted((y[-1], other)))
    return np.append(x, end), np.append(y, value)


def _between_kinks(x: Array, y: Array) -> list[tuple[Array, Array]]:
    """Cut a piece at its kinks."""
    pieces = []
    for end, value in _kinks(x, y):
        near = 1e-6 * (x[-1] - x[0])
        here = x < end - near
        pieces.append((np.append(x[here], end), np.append(y[here], value)))
        rest = x > end + near
        x, y = np.append(end, x[rest]), np.append(value, y[rest])
    return [*pieces, (x, y)]


def _kinks(x: Array, y: Array) -> list[tuple[float, float]]:
    """Places where the slope of samples changes at once: arc lengths and values, rising."""
    if x.size < 6:
        return []
    h = np.diff(x)
    slope = np.diff(y) / h
    turn = np.diff(slope)
    bend = turn / (h[1:] + h[:-1]) * 2.0
    # In interval i, from slope i − 1 to slope i + 1; the bends outside are at samples i − 1, i + 2.
    change = turn[1:-2] + turn[2:-1]
    over = (h[1:-3] + h[3:-1]) / 2.0 + h[2:-2]
    around = np.maximum(np.abs(bend[:-3]), np.abs(bend[3:]))
    # A turn of independent samples scatters by their noise times this.
    weight = np.sqrt(h[1:] ** -2.0 + h[:-1] ** -2.0 + (1.0 / h[1:] + 1.0 / h[:-1]) ** 2)
    noise = _noise(turn / weight, y[1:-1])[1:-2] * np.sqrt(2.0) * np.hypot(1 / h[1:-3], 1 / h[3:-1])
    kink = np.abs(change) > _TURNED * np.maximum(around * over, noise)
    kink &= np.abs(change) * h[2:-2] > _NEGLIGIBLE * y[2:-3]
    found: list[tuple[float, float]] = []
    for i in 2 + np.flatnonzero(kink):
        along = (y[i + 1] - y[i] - slope[i + 1] * (x[i + 1] - x[i])) / (slope[i - 1] - slope[i + 1])
        if not -1e-6 <= along / (x[i + 1] - x[i]) <= 1.0 + 1e-6:
            continue
        end = float(x[i] + along)
        if not found or end - found[-1][0] > 0.1 * (x[i + 1] - x[i]):
            found.append((end, float(y[i] + slope[i - 1] * along)))
    return found
