"""Length, intrinsic curvature and pose of a whisker from digitised points.

1. A smoothing spline X(t) is fitted to the points, with t the arc length along the curve itself:
   points are projected onto the fitted curve, given the arc length found there, and fitted again.
   (The chord length of noisy points increases with their number and serves as a first guess only.)
2. Its curvature vector κ = dT/ds is computed, and the rotation-minimising frame
   R' = [T × κ]ₓ R, which does not spin about its tangent.
3. In that frame u₀ = (0, −κ·d2, κ·d1).

The base is the point of the curve nearest the first point, the tip that nearest the last.

Arc length s(t) = ∫ |X′| dt is integrated by Gauss quadrature between the knots of X, and inverted
by Newton's method.

The smoothing spline through points y_i at parameters t_i ∈ [0, 1] is the curve f that minimises

    Σ |y_i − f(t_i)|² + λ ∫ |f‴|² dt,

a quintic spline with f‴ = f⁗ = 0 at both ends. Penalising the third derivative leaves the curvature
at the base free (a cubic smoothing spline would make it zero there) and reproduces a parabola, the
usual shape of a whisker, for any λ. The spline is represented by its values at sites,
f = Σ N_j(t) v_j, with natural cardinal splines N_j. With A_ij = N_j(t_i), K = ∫ N‴ N‴ᵀ and the hat
matrix H = A (AᵀA + λK)⁻¹ Aᵀ, λ is determined by

- the noise σ, where it is given: it minimises RSS + 2 ρ σ² c tr H, an unbiased estimate of the
  squared distance to the true curve (Mallows). The discrepancy principle RSS = σ² c (n − tr H) has
  the same aim, but depends on how much the noise of one sample happens to differ from σ;
- else generalised cross-validation: it minimises RSS / (n − ρ tr H)². Plain cross-validation,
  ρ = 1, sometimes follows the noise of short data; counting each degree of freedom as ρ = 1.2 to
  1.4 of them prevents this (Kim & Gu 2004).

Points are free to slide along the curve, so that residuals have c = d − 1 components in d
dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import interpolate, linalg, special
from vibrissa.numerics import Array, numbers
from vibrissa.whisker.pose import Pose, least_turn
from vibrissa.whisker.profile import Path, Profile, approximate, constant
from vibrissa.whisker.section import LONGEST, length_faults

ROUNDS = 12  # largest number of times that points are projected and fitted again
GROUPS = 24  # number of points of the first guess; more are averaged in groups
SIGNIFICANCE = 0.01  # probability that the noise of a straight line is taken for curvature
#: Largest noise that may be stated, over the extent of the points.
SCATTERED = 0.1

# Difference of a hint's distances to both ends, in lengths, below which it is ambiguous.
HINT_MARGIN = 0.1

#: Largest noise that is accepted unless it was stated, over the extent of the points.
SCATTER = 0.08
#: Largest noise of points that count as a straight line, unless stated, over their extent.
STRAIGHT = 0.02

WANDERING = 4.0  # length of a curve, over the extent of its points, above which they are unordered


@dataclass(frozen=True, eq=False)
class Digitized:
    """Shape found from points, in a frame along the base tangent with arbitrary roll."""

    length: float
    curvature: Profile
    pose: Pose
    noise: float


def digitize(
    points: ArrayLike, noise: float | None, base: str | ArrayLike | None, any_length: bool = False
) -> Digitized:
    """Determine length, intrinsic curvature and pose from digitised points."""
    array = checked_points(points, noise, any_length)
    array = array[::-1] if _starts_at_tip(array, base) else array
    line = _Line.fitted(array)
    if line.deviation <= 1e-9 * line.extent:
        return line.digitized(noise or 0.0, any_length)
    # From here on, lengths are relative to the data's extent, and positions to their middle.
    middle, unit = array.mean(axis=0), line.extent
    scaled = (array - middle) / unit
    components = max(int(np.linalg.matrix_rank(scaled, tol=1e-9)) - 1, 1)
    relative = None if noise is None else noise / unit
    fit, parameters = _fit_curve(scaled, relative, components)
    found = fit.noise(components) if len(fit.residuals) else 0.0
    _require_curve(fit.curve, found, relative)
    _require_order(parameters, found)
    sigma = found * unit if noise is None else noise
    if len(fit.residuals) and line.explains(array, fit, components, unit, noise):
        sigma = line.noise(components) if noise is None else noise
        return line.digitized(sigma, any_length)
    curve = interpolate.BSpline(fit.curve.t, fit.curve.c * unit + middle, 5)
    digitized = _from_curve(curve, float(parameters[0]), float(parameters[-1]), sigma)
    _require_length(digitized.length, any_length)
    return digitized


def checked_points(
    points: ArrayLike, noise: float | None = None, any_length: bool = False
) -> Array:
    """Return points as (n, 3), m, or raise a ValueError that lists every fault."""
    array = numbers("points", points)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"points have shape {array.shape}; (n, 3) or (n, 2) is needed")
    faults = []
    if noise is not None and not (np.isfinite(noise) and noise >= 0.0):
        faults.append(f"noise is {noise!r} m; None or a number that is not negative is allowed")
    if len(array) < 4:
        faults.append(f"the number of points is {len(array)}; at least 4 are needed")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        faults.append(f"points must be finite; rows {_rows(bad)} are not (counted from 0)")
    good = array[np.isfinite(array).all(axis=1)]
    if len(good) > 1:
        _, first = np.unique(array, axis=0, return_index=True)
        repeated = np.setdiff1d(np.setdiff1d(np.arange(len(array)), first), bad)
        if repeated.size:
            faults.append(f"rows {_rows(repeated)} repeat earlier points (counted from 0)")
        extent = float(np.linalg.norm(np.ptp(good, axis=0)))
        if not extent:
            faults += ["all points coincide: " + fault for fault in length_faults(extent)]
        elif extent > LONGEST:
            faults += length_faults(extent, any_length)
        if noise is not None and 0.0 < SCATTERED * extent < noise:
            faults.append(
                f"noise is {noise:.4g} m for points that extend over {extent:.4g} m: it is the "
                "standard deviation of a coordinate, in m"
            )
    if faults:
        raise ValueError("no whisker in these points: " + "; ".join(faults))
    return array if array.shape[1] == 3 else np.column_stack([array, np.zeros(len(array))])


def _rows(indices: NDArray[np.intp], most: int = 8) -> str:
    """List row indices, at most ``most`` of them."""
    shown = ", ".join(str(i) for i in indices[:most])
    return shown if indices.size <= most else f"{shown}, … ({indices.size} in all)"


def _starts_at_tip(points: Array, base: str | ArrayLike | None) -> bool:
    """Whether the base is the last point."""
    if base is None or (isinstance(base, str) and base == "first"):
        return False
    if isinstance(base, str) and base == "last":
        return True
    if isinstance(base, str):
        raise ValueError(f'base is {base!r}; "first", "last" or a point near the base is allowed')
    hint = np.asarray(base, dtype=np.float64)
    if hint.shape == (2,):
        hint = np.append(hint, 0.0)
    if hint.shape != (3,) or not np.isfinite(hint).all():
        raise ValueError(
            f'base is {base!r}; "first", "last" or a finite point (3,) near the base is allowed'
        )
    first, last = (float(np.linalg.norm(points[end] - hint)) for end in (0, -1))
    apart = np.linalg.norm(points[-1] - points[0])
    if abs(first - last) < HINT_MARGIN * apart or min(first, last) > apart:
        raise ValueError(
            f"base is {hint.tolist()} m, which is {first:.4g} m from the first point and "
            f"{last:.4g} m from the last: it does not identify the base; give a nearer point, "
            '"first" or "last"'
        )
    return last < first


@dataclass(frozen=True, eq=False)
class _Line:
    """The straight line nearest to the points, with the points' positions relative to it."""

    start: Array
    direction: Array
    length: float
    extent: float
    along: Array
    deviation: float
    rss: float

    @classmethod
    def fitted(cls, points: Array) -> _Line:
        """Least-squares line through points (n, 3)."""
        middle = points.mean(axis=0)
        direction = np.linalg.svd(points - middle, full_matrices=False)[2][0]
        if (points[-1] - points[0]) @ direction < 0.0:
            direction = -direction
        along = (points - middle) @ direction
        across = points - middle - along[:, np.newaxis] * direction
        return cls(
            middle + along[0] * direction,
            direction,
            float(along[-1] - along[0]),
            2.0 * float(np.linalg.norm(points - middle, axis=1).max()),
            along,
            float(np.linalg.norm(across, axis=1).max()),
            float(np.sum(across**2)),
        )

    def explains(
        self, points: Array, fit: Smoothed, components: int, unit: float, noise: float | None
    ) -> bool:
        """Whether the points' distances from the line are explained by noise."""
        n = len(points)
        if noise is not None:
            limit = special.chdtri(components * (n - 2), SIGNIFICANCE)
            return bool(self.rss <= noise**2 * limit)
        rss = float(np.sum(fit.residuals**2)) * unit**2
        left, spent = components * (n - fit.freedom), components * (fit.freedom - 2.0)
        # With few points the test has no power: displacements this large are curvature, not noise.
        if left <= 0.0 or rss <= 0.0 or self.noise(components) > STRAIGHT * self.extent:
            return False
        ratio = (self.rss - rss) / spent / (rss / left)
        return bool(special.fdtrc(spent, left, ratio) > SIGNIFICANCE)

    def noise(self, components: int) -> float:
        """Standard deviation per coordinate of points about the line, m."""
        return float(np.sqrt(self.rss / (components * (len(self.along) - 2))))

    def digitized(self, noise: float, any_length: bool) -> Digitized:
        """Result for a straight whisker."""
        _require_order(self.along / self.extent, noise / self.extent)
        _require_length(self.length, any_length)
        pose = Pose(least_turn(self.direction), self.start)
        return Digitized(self.length, constant(np.zeros(3), self.length), pose, noise)


def _fit_curve(points: Array, noise: float | None, components: int) -> tuple[Smoothed, Array]:
    """Fit a curve and find the parameter of every point on it."""
    if noise == 0.0:
        return _interpolate(points)
    groups = np.array_split(points, min(len(points), GROUPS))
    vertices = np.array([group.mean(axis=0) for group in groups])
    t = _unit_interval(_chord_lengths(vertices))
    if len(vertices) < len(points):
        # Averaging leaves less noise than was stated, by an amount that need not be known here.
        curve = smooth(t, vertices, None, components).curve
        at = np.linspace(0.0, 1.0, len(points))
        t = _unit_interval(nearest_parameters(curve, points, at, 2.0 / GROUPS))
    for _ in range(ROUNDS):
        fit = smooth(t, points, noise, components)
        arc = ArcLength(fit.curve)
        feet = nearest_parameters(fit.curve, points, t, 0.1)
        new = _unit_interval(arc.length(feet))
        settled = np.abs(new - t).max() < 1e-7
        t = new
        if settled:
            break
    return fit, feet


def _interpolate(points: Array) -> tuple[Smoothed, Array]:
    """Fit a curve through all points, without smoothing."""
    t = _unit_interval(_chord_lengths(points))
    for _ in range(ROUNDS):
        curve = natural_spline(t, points)
        new = _unit_interval(ArcLength(curve).length(t))
        if np.abs(new - t).max() < 1e-12:
            break
        t = new
    curve = natural_spline(t, points)
    return Smoothed(curve, np.empty((0, 3)), float(len(points))), t


def _chord_lengths(points: Array) -> Array:
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def _unit_interval(t: Array) -> Array:
    return np.asarray((t - t.min()) / np.ptp(t))


def _require_curve(curve: interpolate.BSpline, found: float, stated: float | None) -> None:
    """Raise a ValueError if points are far from any smooth curve, or the curve is too long."""
    if found > SCATTER and (stated is None or found > 2.0 * stated):
        raise ValueError(
            f"no whisker in these points: they scatter by {100.0 * found:.3g} % of their extent "
            f"about a smooth curve, more than the {100.0 * SCATTER:.0f} % allowed; they must be in "
            "order from base to tip"
        )
    if ArcLength(curve).total > WANDERING:
        raise ValueError(
            "no whisker in these points: the curve through them is more than "
            f"{WANDERING:g} times as long as they extend; they must be in order from base to tip"
        )


def _require_order(parameters: Array, noise: float) -> None:
    """Raise a ValueError if points go back along the fitted curve farther than noise explains."""
    back = np.maximum.accumulate(parameters) - parameters
    worst = int(back.argmax())
    if back[worst] > 10.0 * noise + 0.02:
        raise ValueError(
            f"no whisker in these points: they are not in order along it; row {worst} lies "
            f"{100.0 * back[worst]:.0f} % of the length behind an earlier one (rows counted from "
            "the base)"
        )


def _require_length(length: float, any_length: bool) -> None:
    if faults := length_faults(length, any_length):
        raise ValueError("no whisker in these points: " + "; ".join(faults))


def _from_curve(curve: interpolate.BSpline, start: float, end: float, noise: float) -> Digitized:
    """Compute length, base frame and curvature of a fitted curve."""
    if end <= start:
        raise ValueError(
            "no whisker in these points: the last lies before the first along the curve through "
            "all of them; they must be in order from base to tip"
        )
    arc = ArcLength(curve, start, end)
    first, second = curve.derivative(1), curve.derivative(2)

    def rotation_rate(s: Array) -> Array:
        t = arc.parameter(s)
        velocity, acceleration = np.asarray(first(t)), np.asarray(second(t))
        speed = np.linalg.norm(velocity, axis=-1, keepdims=True)
        return np.asarray(np.cross(velocity, acceleration) / speed**3)

    spin = approximate(rotation_rate, arc.ends, tolerance=1e-11)
    turning = _total_turning(spin)
    if turning > 2.0 * np.pi:
        raise ValueError(
            f"no whisker in these points: the curve through them turns by {np.degrees(turning):.0f}"
            "° in all, more than the 360° allowed; they are not in order along the whisker, or "
            "much noisier than stated"
        )
    rotation = least_turn(np.asarray(first(start)) / np.linalg.norm(first(start)))
    # (Rᵀ)' = Rᵀ [−ω]ₓ: in the source frame, the transposed frame rotates at the rate −ω.
    path = Path.integrate(lambda s: -spin(s), spin.knots, (0.0, 0.0, 0.0))

    def curvature(s: Array) -> Array:
        to_base = path.at(s)[0]
        value = (to_base @ spin(s)[..., np.newaxis])[..., 0] @ rotation
        value[..., 0] = 0.0
        return value

    profile = approximate(curvature, spin.knots, tolerance=1e-10)
    pose = Pose(rotation, np.asarray(curve(start)))
    return Digitized(arc.total, profile, pose, noise)


def _total_turning(spin: Profile) -> float:
    s = np.linspace(spin.knots[0], spin.knots[-1], 2001)
    return float(np.linalg.norm(spin(s), axis=1).mean() * (s[-1] - s[0]))


_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(12)


class ArcLength:
    """Arc length of a spline curve between two parameters."""

    def __init__(
        self, curve: interpolate.BSpline, start: float | None = None, end: float | None = None
    ) -> None:
        knots = np.unique(curve.t)
        start = float(knots[0]) if start is None else start
        end = float(knots[-1]) if end is None else end
        slack = 1e-6 * (end - start)
        inside = knots[(knots > start + slack) & (knots < end - slack)]
        self._velocity = curve.derivative(1)
        self._knots = np.concatenate([[start], inside, [end]])
        pieces = self._segment_lengths(self._knots[:-1], self._knots[1:])
        self.ends: Array = np.append(0.0, np.cumsum(pieces))
        self.total = float(self.ends[-1])

    def _speed(self, t: Array) -> Array:
        return np.asarray(np.linalg.norm(self._velocity(t), axis=-1))

    def _segment_lengths(self, start: Array, end: Array) -> Array:
        half = 0.5 * (end - start)
        t = 0.5 * (start + end)[..., np.newaxis] + half[..., np.newaxis] * _POINTS
        return np.asarray(half * (self._speed(t) @ _WEIGHTS))

    def length(self, t: Array) -> Array:
        """Arc lengths (...) at parameters (...)."""
        k = np.clip(np.searchsorted(self._knots, t, side="right") - 1, 0, self._knots.size - 2)
        return np.asarray(self.ends[k] + self._segment_lengths(self._knots[k], t))

    def parameter(self, s: Array) -> Array:
        """Parameters (...) at arc lengths (...)."""
        t = np.interp(s, self.ends, self._knots)
        for _ in range(30):
            change = (self.length(t) - s) / self._speed(t)
            t = t - change
            if np.abs(change).max(initial=0.0) < 1e-14 * (self._knots[-1] - self._knots[0]):
                break
        return np.asarray(t)


def nearest_parameters(
    curve: interpolate.BSpline, points: Array, guesses: Array, window: float
) -> Array:
    """Parameters (n,) of the nearest points on a curve, each within a window about its guess."""
    grid = np.linspace(-0.02, 1.02, 521)
    apart = np.sum((points[:, np.newaxis] - np.asarray(curve(grid))) ** 2, axis=-1)
    apart[np.abs(grid - guesses[:, np.newaxis]) > window] = np.inf
    t: Array = grid[apart.argmin(axis=1)]
    first, second = curve.derivative(1), curve.derivative(2)
    for _ in range(8):
        gap, velocity = np.asarray(curve(t)) - points, np.asarray(first(t))
        slope = np.sum(gap * velocity, axis=1)
        speed2 = np.sum(velocity**2, axis=1)
        bend = speed2 + np.sum(gap * np.asarray(second(t)), axis=1)
        change = -slope / np.maximum(bend, 0.3 * speed2)
        t = np.clip(t + np.clip(change, -0.01, 0.01), grid[0], grid[-1])
        if np.abs(change).max() < 1e-12:
            break
    return t


SITES = 48  # number of values, per coordinate, by which a smoothing spline is represented
COST = 1.3  # ρ, the weight of a degree of freedom
LEVELS = 90  # number of values of λ that are compared


def natural_spline(t: Array, values: Array) -> interpolate.BSpline:
    """Interpolate by a quintic spline with zero third and fourth derivatives at the ends."""
    zero = np.zeros(values.shape[1:])
    # The type stubs accept conditions by name only.
    ends: Any = ([(3, zero), (4, zero)], [(3, zero), (4, zero)])
    return interpolate.make_interp_spline(t, values, k=5, bc_type=ends)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A smoothing spline, with its residuals and its degrees of freedom."""

    curve: interpolate.BSpline
    residuals: Array
    freedom: float

    def noise(self, components: int) -> float:
        """Standard deviation per coordinate, estimated from the residuals."""
        left = max(len(self.residuals) - self.freedom, 1e-3)
        return float(np.sqrt(np.sum(self.residuals**2) / (components * left)))


def smooth(t: Array, points: Array, noise: float | None, components: int) -> Smoothed:
    """Fit a smoothing spline."""
    n = len(t)
    cardinal, roughness = _cardinal()
    # The smallest λ does not affect what n points can resolve, and makes the system regular where
    # there are fewer points than sites.
    least = 1e-6 * n / (np.pi * min(n, SITES)) ** 6
    design = np.asarray(cardinal(t))
    weights, axes = linalg.eigh(design.T @ design)
    shown_part = np.sqrt(np.clip(weights, 0.0, None))[:, np.newaxis] * axes.T
    rough_part = np.sqrt(least) * roughness
    # Modes that are orthogonal in both AᵀA and K. K itself is not formed: when squared, the
    # roughness of a smooth curve would be lost in the rounding errors of the rough ones.
    basis, triangle = linalg.qr(np.vstack([shown_part, rough_part]), mode="economic")
    _, rough, turned = linalg.svd(basis[SITES:], full_matrices=False)
    modes = linalg.solve_triangular(triangle, turned.T)
    shown = design @ modes
    # The last three modes are the parabolas, which have no roughness.
    rates = rough[:-3] ** 2 / least
    loads = shown.T @ points

    def fit(level: float) -> tuple[Array, Array, Array]:
        damping = np.append(1.0 / (1.0 + (level - least) * rates), np.ones(3))
        weights = damping[:, np.newaxis] * loads
        return weights, points - shown @ weights, damping * (1.0 - rough**2)

    # At the last level only a parabola is left, which is exactly planar.
    levels = np.append(np.geomspace(least, 10.0 * n, LEVELS), np.inf)
    rss, freedom = np.empty((2, len(levels)))
    for k, level in enumerate(levels):
        _, residuals, hat = fit(level)
        rss[k], freedom[k] = np.sum(residuals**2), hat.sum()
    if noise is None:
        left = n - COST * freedom
        allowed = left > 0.0
        level = float(levels[allowed][(rss[allowed] / left[allowed] ** 2).argmin()])
    else:
        level = float(levels[(rss + 2.0 * COST * noise**2 * components * freedom).argmin()])
    weights, residuals, hat = fit(level)
    return Smoothed(
        interpolate.BSpline(cardinal.t, cardinal.c @ (modes @ weights), 5),
        residuals,
        float(hat.sum()),
    )


@cache
def _cardinal() -> tuple[interpolate.BSpline, Array]:
    """Return N and the triangular D with DᵀD = ∫ N‴ N‴ᵀ dt, on equally spaced sites."""
    sites = np.linspace(0.0, 1.0, SITES)
    cardinal = natural_spline(sites, np.eye(SITES))
    # Three Gauss points are exact because N‴ is piecewise quadratic.
    points, weights = np.polynomial.legendre.leggauss(3)
    halves = 0.5 * np.diff(sites)[:, np.newaxis]
    middles = 0.5 * (sites[1:] + sites[:-1])[:, np.newaxis]
    thirds = np.asarray(cardinal.derivative(3)((middles + halves * points).ravel()))
    rough = np.sqrt((halves * weights).ravel())[:, np.newaxis] * thirds
    return cardinal, np.asarray(linalg.qr(rough, mode="r")[0][:SITES])
