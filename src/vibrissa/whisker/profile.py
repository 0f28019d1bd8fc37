"""Functions of arc length as piecewise polynomials.

On the interval [s_j, s_{j+1}] a profile is

    f(s) = Σ_k c_k τ^k,    τ = (2 s − s_j − s_{j+1}) / (s_{j+1} − s_j) ∈ [−1, 1],

so that all coefficients have the unit of f. Any function is brought into this form once, by
interpolation at Chebyshev points (interior ones: a jump at a declared break is seen from the
proper side) on intervals that are halved until points in between agree. Where halving ends without
that, a jump or kink is searched for by bisection and becomes an interval's end, unless there are so
many that the function is noise. Constants and straight ramps come out exactly, smooth functions to
1e-12 of their largest value.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Function = Callable[[Array], Array]
Side = Literal["right", "left"]

DEGREES = (1, 3, 7)
"""Degrees tried on an interval before it is halved."""

TOLERANCE = 1e-12
"""Largest error of the polynomials, relative to the function's largest value."""

FINEST = 512
"""Parts of the domain below which an interval is not halved any more."""

UNRESOLVED = 1e-7
"""Relative error above which a function counts as not resolved."""


MOST_SEARCHED = 64
"""Intervals not resolved, at most, in which jumps and kinks are searched for."""

JUMP, KINK = 1e-9, 1e-3
"""Smallest changes of value and of slope times length, relative to the largest value, that count as
a jump and as a kink."""


@dataclass(frozen=True, eq=False)
class Profile:
    """A piecewise polynomial function of arc length.

    Parameters
    ----------
    knots : array (m + 1,)
        Interval ends, m, increasing.
    coefficients : array (k + 1, m, ...)
        Coefficients of τ^0 … τ^k on each interval, in the unit of the function.
    error : float
        Largest error found when the profile was made, relative to its largest value.
    """

    knots: Array
    coefficients: Array
    error: float = 0.0

    def __post_init__(self) -> None:
        """Take read-only copies and check that they fit together."""
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
        """Values at arc lengths `s` (...), m, as (..., *shape); NaN gives NaN.

        At a knot `side` selects the interval; outside the knots the last polynomial goes on.
        """
        s = np.asarray(s, dtype=np.float64)
        last = self.knots.size - 2
        interval = np.clip(np.searchsorted(self.knots, s, side=side) - 1, 0, last)
        start, end = self.knots[interval], self.knots[interval + 1]
        tau = (2.0 * s - start - end) / (end - start)
        tau = tau.reshape(tau.shape + (1,) * len(self.shape))
        value: Array = self.coefficients[-1][interval]
        for coefficient in self.coefficients[-2::-1]:
            value = value * tau + coefficient[interval]
        # A constant is NaN at NaN too.
        return value + 0.0 * tau

    def breaks(self) -> Array:
        """Find the knots at which the function jumps or has a kink."""
        power = np.arange(len(self.coefficients)).reshape(-1, *(1,) * (1 + len(self.shape)))
        half = (np.diff(self.knots) / 2.0).reshape(-1, *(1,) * len(self.shape))
        signed = self.coefficients * (-1.0) ** power
        largest = float(np.abs(self.coefficients).sum(axis=0).max())
        value = signed.sum(axis=0)[1:] - self.coefficients.sum(axis=0)[:-1]
        start = -(power * signed).sum(axis=0) / half
        end = (power * self.coefficients).sum(axis=0) / half
        slope = (start[1:] - end[:-1]) * (self.knots[-1] - self.knots[0])
        rough = (np.abs(value) > JUMP * largest) | (np.abs(slope) > KINK * largest)
        found: Array = self.knots[1:-1][rough.any(axis=tuple(range(1, rough.ndim)))]
        return found

    def trimmed(self, length: float) -> "Profile":
        """Drop the intervals that begin at or beyond a length."""
        count = int(np.searchsorted(self.knots[:-1], length, side="left"))
        return Profile(self.knots[: count + 1], self.coefficients[:, :count], self.error)

    def scaled(self, length_factor: float, value_factor: float) -> "Profile":
        """Stretch arc length and multiply values."""
        return Profile(self.knots * length_factor, self.coefficients * value_factor, self.error)

    def transformed(self, matrix: Array) -> "Profile":
        """Multiply every value by a matrix."""
        return Profile(self.knots, self.coefficients @ matrix.T, self.error)


def constant(value: ArrayLike, length: float) -> Profile:
    """Make a profile that has one value from the base to the tip."""
    array = np.asarray(value, dtype=np.float64)
    return Profile(np.array([0.0, length]), array[np.newaxis, np.newaxis])


def linear(start: float, end: float, length: float) -> Profile:
    """Give the straight ramp from `start` at 0 to `end` at `length`, m."""
    coefficients = np.array([[0.5 * (start + end)], [0.5 * (end - start)]])
    return Profile(np.array([0.0, length]), coefficients)


def approximate(
    function: Function, joints: Sequence[float] | Array, tolerance: float = TOLERANCE
) -> Profile:
    """Bring a function into piecewise polynomial form."""
    joints = np.asarray(joints, dtype=np.float64)
    profile, unresolved = _halved(function, joints, tolerance)
    if 0 < len(unresolved) <= MOST_SEARCHED:
        singular = [_singular(function, *interval) for interval in unresolved]
        near = 1e-12 * (joints[-1] - joints[0])
        new = [s for s in singular if np.abs(joints - s).min() > near]
        profile, _ = _halved(function, np.unique([*joints, *new]), tolerance)
    return profile


def _halved(
    function: Function, joints: Array, tolerance: float
) -> tuple[Profile, list[tuple[float, float]]]:
    """Polynomials on intervals halved as far as allowed, and the intervals not resolved."""
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
    profile = Profile(np.array(knots), _padded(pieces), worst / scale if scale > 0.0 else 0.0)
    return profile, rough


def _singular(function: Function, start: float, end: float) -> float:
    """Bisect to the worst jump or kink in an interval."""
    finest = 4.0 * np.finfo(np.float64).eps * max(abs(start), abs(end))
    while end - start > finest:
        middle = 0.5 * (start + end)
        halves = ((start, middle), (middle, end))
        errors = [_best_polynomial(function, a, b, 0.0)[1] for a, b in halves]
        if not any(errors):
            # What is left is exactly straight on both sides of the middle.
            return middle
        start, end = halves[int(errors[1] > errors[0])]
    return 0.5 * (start + end)


_CHECKS = np.cos(np.pi * (np.arange(33) + 0.5) / 33.0)


def _best_polynomial(
    function: Function, start: float, end: float, scale: float
) -> tuple[Array, float, float]:
    """Coefficients of the lowest sufficient degree on an interval, their error, the largest |f|."""
    nodes = {d: np.cos(np.pi * (np.arange(d + 1) + 0.5) / (d + 1)) for d in DEGREES}
    tau = np.concatenate([*nodes.values(), _CHECKS])
    values = function(0.5 * (start + end) + 0.5 * (end - start) * tau)
    checks = values[-_CHECKS.size :]
    largest = float(np.abs(values).max())
    first = 0
    for degree in DEGREES:
        at_nodes = values[first : first + degree + 1].reshape(degree + 1, -1)
        first += degree + 1
        flat = np.linalg.solve(np.vander(nodes[degree], increasing=True), at_nodes)
        found = np.vander(_CHECKS, degree + 1, increasing=True) @ flat
        error = float(np.abs(found.reshape(checks.shape) - checks).max())
        if error <= 1e-2 * TOLERANCE * max(scale, largest):
            break
    return flat.reshape(degree + 1, *values.shape[1:]), error, largest


def _padded(pieces: Sequence[Array]) -> Array:
    """Stack coefficients of different degree into (k + 1, m, ...)."""
    size = max(len(piece) for piece in pieces)
    stacked = np.zeros((size, len(pieces), *pieces[0].shape[1:]))
    for j, piece in enumerate(pieces):
        stacked[: len(piece), j] = piece
    return stacked


def array_function(function: Callable[..., object], shape: tuple[int, ...], what: str) -> Function:
    """Make a caller's function of arc length take arrays, and check what it returns."""

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
        return values.shape == s.shape + shape and bool(
            np.allclose(values, singly(s), rtol=1e-9, atol=1e-12, equal_nan=True)
        )

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
