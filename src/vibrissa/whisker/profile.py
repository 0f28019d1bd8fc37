"""Piecewise polynomial functions of arc length, and the integration of the resting shape.

On the interval [s_j, s_{j+1}] a profile is

    f(s) = Σ_k c_k τ^k,    τ = (2 s − s_j − s_{j+1}) / (s_{j+1} − s_j) ∈ [−1, 1],

so that all coefficients have the unit of f. Any function is converted to this form once, by
interpolation at Chebyshev points (interior ones: a jump at a declared break is evaluated on the
proper side), on intervals that are halved until points in between agree. Where halving ends without
agreement, a jump or kink is located by bisection and becomes an interval's end, unless there are so
many that the function is noise. Constants and linear ramps are represented exactly, smooth
functions to 1e-12 of their largest value.

A radius from samples consists of smooth pieces between the arc lengths at which it jumps or has a
kink. Neighbouring samples i, i + 1 are the two sides of a jump if the change between them can be
neither the continuation of the slopes g on either side, nor noise:

    x = r_{i+1} − r_i − h_i (g_{i−1} + g_{i+1}) / 2,    |x| > 3 |g_{i+1} − g_{i−1}| h_i,

with x most of the change itself and more than 5.5 standard deviations of the noise. The jump is
placed in the middle of the interval: averaged over its possible positions in the interval, the
compliance ∝ r⁻⁴ is then right. Two samples at one arc length, or much closer to each other than to
their neighbours, state a jump. A kink is where the straight lines through the samples on its two
sides intersect, if their slopes differ by more than 8 times the change of slope before and after
it, and by more than noise explains.

Each piece is a monotone cubic (PCHIP), which has no kinks and cannot overshoot below zero. The
noise is estimated from the smallest quarter of the differences, so that a staircase with two
samples per step is not taken for noise; a smooth profile with noise has neither jumps nor kinks.

The resting shape of a whisker is the integral of its intrinsic curvature:

    R' = R [u₀]ₓ,    r' = R e₁,    R(0) = 1,    r(0) = 0

R has columns (tangent, d1, d2) and u₀ = (twist, curvature about d1, curvature about d2), so that
R' e₁ = R (0, u_z, −u_y). Together they are one motion g = (R, r) with g' = g ξ, ξ = (u₀, e₁) in
se(3), integrated by the sixth-order Magnus method (Blanes, Casas & Ros 2000) on three Gauss points
per step, with the exponential in closed form. Points between nodes are reached by one shorter step
of the same kind, so they are as accurate as the nodes.

The planar parabola is the usual model of a whisker's intrinsic shape:

    y = A x²,    s = (sinh w cosh w + w) / (4 A),    κ(s) = 2 A / cosh³ w,    sinh w = 2 A x

It is specified by its arc length, not by its extent along x. w(s) is found by Newton's method,
which converges from any start because the equation is convex and increasing in w.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, exponential

Function = Callable[[Array], Array]
Side = Literal["right", "left"]

DEGREES = (1, 3, 7)  # degrees tried on an interval before it is halved

TOLERANCE = 1e-12
"""Largest error of the polynomials, relative to the function's largest value."""

FINEST = 512  # number of parts of the domain beyond which intervals are not halved
UNRESOLVED = 1e-7  # relative error above which a function counts as not resolved

MOST_SEARCHED = 64  # largest number of unresolved intervals in which jumps and kinks are located
# Smallest changes of value, and of slope times length, that count as a jump and as a kink, relative
# to the largest value.
JUMP, KINK = 1e-9, 1e-3


@dataclass(frozen=True, eq=False)
class Profile:
    """A piecewise polynomial function of arc length."""

    knots: Array  # (m + 1,), interval ends, m, increasing
    coefficients: Array  # (k + 1, m, ...), coefficients of τ^0 … τ^k, in the unit of the function
    error: float = 0.0  # largest error, relative to the largest value

    def __post_init__(self) -> None:
        knots = np.array(self.knots, dtype=np.float64)
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if knots.ndim != 1 or knots.size < 2 or not (np.diff(knots) > 0.0).all():
            raise ValueError("profile knots must be at least two increasing arc lengths")
        if coefficients.ndim < 2 or coefficients.shape[1] != knots.size - 1:
            raise ValueError(
                f"profile coefficients have shape {coefficients.shape}; with {knots.size} knots "
                f"(degree + 1, {knots.size - 1}, ...) is needed"
            )
        if not (np.isfinite(knots).all() and np.isfinite(coefficients).all()):
            raise ValueError("profile knots and coefficients must be finite")
        knots.flags.writeable = False
        coefficients.flags.writeable = False
        object.__setattr__(self, "knots", knots)
        object.__setattr__(self, "coefficients", coefficients)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one value: () for a radius, (3,) for a curvature."""
        return self.coefficients.shape[2:]

    def __call__(self, s: ArrayLike, side: Side = "right") -> Array:
        """Values (..., *shape) at arc lengths `s`, m; at a knot `side` selects the interval."""
        s = np.asarray(s, dtype=np.float64)
        last = self.knots.size - 2
        interval = np.clip(np.searchsorted(self.knots, s, side=side) - 1, 0, last)
        start, end = self.knots[interval], self.knots[interval + 1]
        tau = (2.0 * s - start - end) / (end - start)
        tau = tau.reshape(tau.shape + (1,) * len(self.shape))
        value: Array = self.coefficients[-1][interval]
        for coefficient in self.coefficients[-2::-1]:
            value = value * tau + coefficient[interval]
        # A constant must be NaN at NaN as well.
        return value + 0.0 * tau

    def breaks(self) -> Array:
        """Knots at which the function jumps or has a kink."""
        power = np.arange(len(self.coefficients)).reshape(-1, *(1,) * (1 + len(self.shape)))
        half = (np.diff(self.knots) / 2.0).reshape(-1, *(1,) * len(self.shape))
        signed = self.coefficients * (-1.0) ** power
        largest = float(np.abs(self.coefficients).sum(axis=0).max())
        value = signed.sum(axis=0)[1:] - self.coefficients.sum(axis=0)[:-1]
        start = -(power * signed).sum(axis=0) / half
        end = (power * self.coefficients).sum(axis=0) / half
        slope = (start[1:] - end[:-1]) * (self.knots[-1] - self.knots[0])
        rough = (np.abs(value) > JUMP * largest) | (np.abs(slope) > KINK * largest)
        return np.asarray(self.knots[1:-1][rough.any(axis=tuple(range(1, rough.ndim)))])

    def trimmed(self, length: float) -> Profile:
        """Drop the intervals that start at or beyond a length."""
        count = int(np.searchsorted(self.knots[:-1], length, side="left"))
        return Profile(self.knots[: count + 1], self.coefficients[:, :count], self.error)

    def scaled(self, length_factor: float, value_factor: float) -> Profile:
        """Scale arc length and values."""
        return Profile(self.knots * length_factor, self.coefficients * value_factor, self.error)

    def transformed(self, matrix: Array) -> Profile:
        """Multiply all values by a matrix."""
        return Profile(self.knots, self.coefficients @ matrix.T, self.error)


def constant(value: ArrayLike, length: float) -> Profile:
    """Return a constant profile."""
    array = np.asarray(value, dtype=np.float64)
    return Profile(np.array([0.0, length]), array[np.newaxis, np.newaxis])


def linear(start: float, end: float, length: float) -> Profile:
    """Return the linear ramp from `start` at 0 to `end` at `length`, m."""
    coefficients = np.array([[0.5 * (start + end)], [0.5 * (end - start)]])
    return Profile(np.array([0.0, length]), coefficients)


def approximate(
    function: Function, joints: Sequence[float] | Array, tolerance: float = TOLERANCE
) -> Profile:
    """Approximate a function by a piecewise polynomial, with knots at the joints and elsewhere."""
    joints = np.asarray(joints, dtype=np.float64)
    profile, unresolved = _approximate_by_halving(function, joints, tolerance)
    if 0 < len(unresolved) <= MOST_SEARCHED:
        singular = [_locate_singularity(function, *interval) for interval in unresolved]
        near = 1e-12 * (joints[-1] - joints[0])
        new = [s for s in singular if np.abs(joints - s).min() > near]
        profile, _ = _approximate_by_halving(function, np.unique([*joints, *new]), tolerance)
    return profile


def _approximate_by_halving(
    function: Function, joints: Array, tolerance: float
) -> tuple[Profile, list[tuple[float, float]]]:
    """Polynomials on intervals halved as far as allowed, and the unresolved intervals."""
    middles = 0.5 * (joints[1:] + joints[:-1])
    scale = float(np.abs(function(np.concatenate([joints, middles]))).max())
    shortest = (joints[-1] - joints[0]) / FINEST
    todo = [(float(a), float(b)) for a, b in pairwise(joints)][::-1]
    knots, pieces, worst, rough = [float(joints[0])], [], 0.0, []
    while todo:
        start, end = todo.pop()
        coefficients, error, largest = _best_polynomial(function, start, end, scale)
        scale = max(scale, largest)
        if error > tolerance * scale and end - start > shortest:
            middle = 0.5 * (start + end)
            todo += [(middle, end), (start, middle)]
            continue
        if error > UNRESOLVED * scale:
            rough.append((start, end))
        knots.append(end)
        pieces.append(coefficients)
        worst = max(worst, error)
    profile = Profile(
        np.array(knots), _stack_coefficients(pieces), worst / scale if scale > 0.0 else 0.0
    )
    return profile, rough


def _locate_singularity(function: Function, start: float, end: float) -> float:
    """Locate the worst jump or kink in an interval by bisection."""
    finest = 4.0 * np.finfo(np.float64).eps * max(abs(start), abs(end))
    while end - start > finest:
        middle = 0.5 * (start + end)
        halves = ((start, middle), (middle, end))
        errors = [_best_polynomial(function, a, b, 0.0)[1] for a, b in halves]
        if not any(errors):
            # The function is exactly linear on both sides of the middle.
            return middle
        start, end = halves[int(errors[1] > errors[0])]
    return 0.5 * (start + end)


def _chebyshev(n: int) -> Array:
    """Chebyshev points (n,) in (-1, 1)."""
    return np.asarray(np.cos(np.pi * (np.arange(n) + 0.5) / n))


_NODES = {d: _chebyshev(d + 1) for d in DEGREES}
_FITS = {d: np.linalg.inv(np.vander(nodes, increasing=True)) for d, nodes in _NODES.items()}
_CHECKS = _chebyshev(33)
_POWERS = np.vander(_CHECKS, max(DEGREES) + 1, increasing=True)


def _best_polynomial(
    function: Function, start: float, end: float, scale: float
) -> tuple[Array, float, float]:
    """Coefficients of the lowest sufficient degree on an interval, their error, and largest |f|."""
    tau = np.concatenate([*_NODES.values(), _CHECKS])
    values = function(0.5 * (start + end) + 0.5 * (end - start) * tau)
    checks = values[-_CHECKS.size :]
    largest = float(np.abs(values).max())
    first = 0
    for degree in DEGREES:
        at_nodes = values[first : first + degree + 1].reshape(degree + 1, -1)
        first += degree + 1
        flat = _FITS[degree] @ at_nodes
        found = _POWERS[:, : degree + 1] @ flat
        error = float(np.abs(found.reshape(checks.shape) - checks).max())
        if error <= 1e-2 * TOLERANCE * max(scale, largest):
            break
    return flat.reshape(degree + 1, *values.shape[1:]), error, largest


def _stack_coefficients(pieces: Sequence[Array]) -> Array:
    """Stack coefficients of different degree into (k + 1, m, ...)."""
    size = max(len(piece) for piece in pieces)
    stacked = np.zeros((size, len(pieces), *pieces[0].shape[1:]))
    for j, piece in enumerate(pieces):
        stacked[: len(piece), j] = piece
    return stacked


def array_function(function: Callable[..., object], shape: tuple[int, ...], what: str) -> Function:
    """Wrap a user's function of arc length so that it accepts arrays and its result is checked."""

    def one(s: float) -> Array:
        value = np.asarray(function(s), dtype=np.float64)
        if value.shape != shape:
            wanted = shape if shape else "a number"
            raise ValueError(f"{what}({s:.6g}) has shape {value.shape}; {wanted} is needed")
        return value

    def singly(s: Array) -> Array:
        return np.array([one(float(x)) for x in s]).reshape(s.shape + shape)

    def together(s: Array) -> Array:
        return np.asarray(function(s), dtype=np.float64)

    def takes_arrays(s: Array) -> bool:
        try:
            values = together(s)
        except (TypeError, ValueError, IndexError):
            return False
        if values.shape != s.shape + shape:
            return False
        try:
            alone = singly(s)
        except (TypeError, IndexError):  # it takes arrays only
            return True
        return bool(np.allclose(values, alone, rtol=1e-9, atol=1e-12, equal_nan=True))

    chosen: Function | None = None

    def checked(s: Array) -> Array:
        nonlocal chosen
        if chosen is None:
            chosen = together if takes_arrays(s[:5]) else singly
        values = chosen(s)
        bad = ~np.isfinite(values.reshape(s.size, -1)).all(axis=1)
        if bad.any():
            raise ValueError(f"{what}({s[bad][0]:.6g}) is {values[bad][0]}; it must be finite")
        return values

    return checked


MOST = 64  # number of jumps and kinks above which samples count as rounded, not as steps of a rod
# Thresholds of jumps in standard deviations of the noise, of kinks in changes of slope around, and
# of jumps in changes of slope; and share of the radius below which changes are ignored.
_SIGNIFICANT = 5.5
_TURNED = 8.0
_OUTSTANDING = 3.0
_NEGLIGIBLE = 1e-4
# Largest distance of two samples that state a jump, over their distances to the samples around.
_CLOSE = 2e-3
_MANY = 30  # number of samples from which noise can be distinguished from shape
# Least share of close pairs among the intervals of a rod that was sampled at the ends of its steps.
_PAIRED = 0.2
_QUARTILE = 0.3186  # first quartile of |x| for a normal distribution, in standard deviations


def sampled_radius(length: float, s: Array, r: Array) -> Profile:
    """Profile of a radius through samples r (n,) at arc lengths s (n,), with jumps and kinks."""
    ends = _split_at_jumps(s, r, jumps(s, r))
    if len(ends) - 1 > MOST:
        ends = _split_at_jumps(s, r, _stated_jumps(s, r), kinked=False)
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
    """Indices of the intervals between samples in which a radius jumps."""
    stated = _stated_jumps(s, r)
    found = [stated]
    for first, last in pairwise([0, *(stated + 1), s.size]):
        found.append(first + _detect_jumps(s[first:last], r[first:last]))
    return np.sort(np.concatenate(found))


def scatter(s: Array, r: Array) -> float:
    """Estimate the noise of samples relative to the radius, from their nearest neighbours."""
    if s.size < _MANY:
        return 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.diff(s)[:-1] / (s[2:] - s[:-2])
    misfit = r[1:-1] - (1.0 - share) * r[:-2] - share * r[2:]
    misfit /= r[1:-1] * np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
    return float(np.nanquantile(np.abs(misfit), 0.25)) / _QUARTILE


def _stated_jumps(s: Array, r: Array) -> NDArray[np.intp]:
    """Intervals whose samples are at one arc length or very close, and so state a jump."""
    h = np.diff(s)
    around = np.minimum(np.append(np.inf, h[:-1]), np.append(h[1:], np.inf))
    close = (h <= _CLOSE * around) & (np.abs(np.diff(r)) > _NEGLIGIBLE * r[1:])
    close &= np.isfinite(around)  # two samples are the ends of a cone
    # Randomly spaced points have some close pairs as well: those are tested like all others.
    return np.asarray(np.flatnonzero((h == 0.0) | (close & (close.mean() > _PAIRED))))


def _detect_jumps(s: Array, r: Array) -> NDArray[np.intp]:
    """Detect jumps among samples at increasing arc lengths."""
    if s.size < 4:
        return np.empty(0, dtype=np.intp)
    h, d = np.diff(s), np.diff(r)
    slope = d / h
    before, after = slope[:-2], slope[2:]
    excess = d[1:-1] - h[1:-1] * (before + after) / 2.0
    size, change, here = np.abs(excess), np.abs(d[1:-1]), r[1:-2]
    # Scatter of the excess due to independent samples, relative to that of their differences.
    left, right = h[1:-1] / h[:-2] / 2.0, h[1:-1] / h[2:] / 2.0
    weight = np.sqrt(((1.0 + left) ** 2 + (1.0 + right) ** 2 + left**2 + right**2) / 2.0)
    noise = weight * np.minimum(
        _noise_of_differences(d[1:-1], here), _noise_of_differences(excess / weight, here)
    )
    jump = (excess * d[1:-1] > 0.0) & (size > 0.5 * change) & (size < 2.0 * change)
    jump &= size > _OUTSTANDING * np.abs(after - before) * h[1:-1]
    jump &= size > np.maximum(_SIGNIFICANT * noise, _NEGLIGIBLE * here)
    return 1 + np.flatnonzero(jump)


def _noise_of_differences(differences: Array, r: Array) -> Array:
    """Standard deviations of differences, most of which may be jumps, at radii r (n,)."""
    same, share = np.quantile(np.abs([differences, differences / r]), 0.25, axis=1) / _QUARTILE
    return np.asarray(np.maximum(same, share * r))


def _split_at_jumps(
    s: Array, r: Array, before: NDArray[np.intp], kinked: bool = True
) -> list[tuple[Array, Array]]:
    """Samples of each smooth piece, with ends where it meets its neighbours."""
    pieces = []
    edges = [0, *(before + 1), s.size]
    for number, (first, last) in enumerate(pairwise(edges)):
        x, y = s[first:last], r[first:last]
        if number > 0:
            x, y = _extend_to_jump(x[::-1], y[::-1], s[first - 1], r[first - 1])
            x, y = x[::-1], y[::-1]
        if number < len(edges) - 2:
            x, y = _extend_to_jump(x, y, s[last], r[last])
        pieces += _split_at_kinks(x, y) if kinked else [(x, y)]
    return pieces


def _extend_to_jump(x: Array, y: Array, beyond: float, other: float) -> tuple[Array, Array]:
    """Extrapolate linearly to the middle of the next jump, but not past its other side."""
    end = 0.5 * (x[-1] + beyond)
    if end == x[-1]:
        # A piece of one sample between two stated jumps cannot occur: arc lengths repeat once.
        return x, y
    slope = (y[-1] - y[-2]) / (x[-1] - x[-2]) if x.size > 1 else 0.0
    value = np.clip(y[-1] + slope * (end - x[-1]), *sorted((y[-1], other)))
    return np.append(x, end), np.append(y, value)


def _split_at_kinks(x: Array, y: Array) -> list[tuple[Array, Array]]:
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
    """Arc lengths and values at which the slope of samples changes abruptly, increasing."""
    if x.size < 6:
        return []
    h = np.diff(x)
    slope = np.diff(y) / h
    turn = np.diff(slope)
    bend = turn / (h[1:] + h[:-1]) * 2.0
    # Interval i is between slopes i − 1 and i + 1; the bends outside are at samples i − 1, i + 2.
    change = turn[1:-2] + turn[2:-1]
    over = (h[1:-3] + h[3:-1]) / 2.0 + h[2:-2]
    around = np.maximum(np.abs(bend[:-3]), np.abs(bend[3:]))
    # Standard deviation of a turn of independent samples, in units of their noise.
    weight = np.sqrt(h[1:] ** -2.0 + h[:-1] ** -2.0 + (1.0 / h[1:] + 1.0 / h[:-1]) ** 2)
    noise = (
        _noise_of_differences(turn / weight, y[1:-1])[1:-2]
        * np.sqrt(2.0)
        * np.hypot(1 / h[1:-3], 1 / h[3:-1])
    )
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


Rate = Callable[[Array], Array]

STEPS = 96
"""Least number of steps along a whisker."""

TURN = 0.04  # largest rotation per step, rad, at which the method's error is close to rounding
_GAUSS = 0.5 + np.sqrt(15.0) / 10.0 * np.array([-1.0, 0.0, 1.0])

Screw = tuple[Array, Array]


def _bracket(left: Screw, right: Screw) -> Screw:
    """Commutator in se(3), with the sign required by g' = g ξ (opposite to g' = ξ g)."""
    (w1, v1), (w2, v2) = left, right
    return np.cross(w2, w1), np.cross(w2, v1) - np.cross(w1, v2)


def _combine(*terms: tuple[float, Screw]) -> Screw:
    """Linear combination of screws."""
    return (
        np.sum([factor * screw[0] for factor, screw in terms], axis=0),
        np.sum([factor * screw[1] for factor, screw in terms], axis=0),
    )


def advance(rate: Rate, start: Array, step: Array, direction: Array) -> tuple[Array, Array]:
    """Motions over the steps [start, start + step], all (...), m."""
    u = rate(start[..., np.newaxis] + _GAUSS * step[..., np.newaxis])
    h = step[..., np.newaxis]
    still = np.zeros_like(u[..., 0, :])
    a1 = (h * u[..., 1, :], h * np.broadcast_to(direction, still.shape))
    a2 = (np.sqrt(15.0) / 3.0 * h * (u[..., 2, :] - u[..., 0, :]), still)
    a3 = (10.0 / 3.0 * h * (u[..., 2, :] - 2.0 * u[..., 1, :] + u[..., 0, :]), still)
    c1 = _bracket(a1, a2)
    c2 = _bracket(a1, _combine((-1 / 30, a3), (-1 / 60, c1)))
    outer = _bracket(_combine((-20.0, a1), (-1.0, a3), (1.0, c1)), _combine((1.0, a2), (1.0, c2)))
    w, v = _combine((1.0, a1), (1 / 12, a3), (1 / 240, outer))
    rotation, mean = exponential(w)
    return rotation, (mean @ v[..., np.newaxis])[..., 0]


@dataclass(frozen=True, eq=False)
class Path:
    """Frames and points along a curve, stored at nodes and interpolated by one shorter step."""

    rate: Rate
    nodes: Array
    rotations: Array
    points: Array
    direction: Array

    @classmethod
    def integrate(cls, rate: Rate, joints: Array, direction: tuple[float, float, float]) -> Path:
        """Integrate from joints[0], where the frame is the identity, to joints[-1]."""
        nodes = _step_ends(rate, joints)
        along = np.array(direction)
        turns, moves = advance(rate, nodes[:-1], np.diff(nodes), along)
        rotations = np.empty((nodes.size, 3, 3))
        points = np.empty((nodes.size, 3))
        rotations[0], points[0] = np.eye(3), 0.0
        for k in range(nodes.size - 1):
            rotations[k + 1] = rotations[k] @ turns[k]
            points[k + 1] = points[k] + rotations[k] @ moves[k]
        return cls(rate, nodes, rotations, points, along)

    def at(self, s: Array) -> tuple[Array, Array]:
        """Frames (..., 3, 3) and points (..., 3), m, at arc lengths (...), m."""
        k = np.clip(np.searchsorted(self.nodes, s, side="right") - 1, 0, self.nodes.size - 2)
        turn, move = advance(self.rate, self.nodes[k], s - self.nodes[k], self.direction)
        frame = self.rotations[k]
        return frame @ turn, self.points[k] + (frame @ move[..., np.newaxis])[..., 0]


def _step_ends(rate: Rate, joints: Array) -> Array:
    """Joints, and sufficiently short equal steps between them."""
    longest = (joints[-1] - joints[0]) / STEPS
    ends = [joints[:1]]
    for start, end in pairwise(joints):
        inside = start + (end - start) * np.linspace(0.02, 0.98, 25)
        fastest = float(np.linalg.norm(rate(inside), axis=-1).max())
        count = int(np.ceil((end - start) * max(1.0 / longest, fastest / TURN) - 1e-9))
        ends.append(np.linspace(start, end, max(count, 1) + 1)[1:])
    return np.concatenate(ends)


def proximal_roll(points: Array, weights: Array) -> float:
    """Roll about x that brings the proximal part closest to the x–y plane, bending toward +y."""
    across = points[:, 1:]
    moments = (weights[:, np.newaxis] * across).T @ across
    _, axes = np.linalg.eigh(moments)
    y, z = axes[:, 1]
    if weights @ (across @ axes[:, 1]) < 0.0:
        y, z = -y, -z
    return float(np.arctan2(z, y))


def parabola_curvature(length: float, coefficient: float) -> Profile:
    """Intrinsic curvature of y = A x², bending toward +y."""
    if coefficient == 0.0:
        return constant(np.zeros(3), length)

    def curvature(s: Array) -> Array:
        w = _parabola_parameter(4.0 * coefficient * s)
        kappa = 2.0 * coefficient / np.cosh(w) ** 3
        return np.stack([np.zeros_like(s), np.zeros_like(s), kappa], axis=-1)

    return approximate(curvature, np.array([0.0, length]))


def _parabola_parameter(arc: Array) -> Array:
    """Solve sinh w cosh w + w = arc ≥ 0."""
    w = np.arcsinh(0.5 * arc)
    for _ in range(60):
        change = (0.5 * np.sinh(2.0 * w) + w - arc) / (2.0 * np.cosh(w) ** 2)
        w = w - change
        if np.abs(change).max(initial=0.0) < 1e-15 * (1.0 + np.abs(w).max(initial=0.0)):
            break
    return w
