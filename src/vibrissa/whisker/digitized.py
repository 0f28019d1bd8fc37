"""From digitised points to a whisker's intrinsic curvature.

1. A smoothing spline X(t) through the points, t being arc length along the curve itself: points are
   projected onto the fitted curve, given the arc length found there, and fitted again. (The chord
   length of noisy points grows with their number and is used for a first guess only.)
2. Its curvature vector κ = dT/ds, and the rotation-minimising frame R' = [T × κ]ₓ R, which does not
   spin about its tangent.
3. In that frame u₀ = (0, −κ·d2, κ·d1).

The base is the point of the curve nearest the first point, the tip that nearest the last.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline
from scipy.stats import chi2
from scipy.stats import f as fisher

from vibrissa.whisker.curve import ArcLength, nearest_parameters
from vibrissa.whisker.pose import Pose, least_turn
from vibrissa.whisker.profile import Profile, approximate, constant
from vibrissa.whisker.rest import Path
from vibrissa.whisker.section import LONGEST, length_faults
from vibrissa.whisker.smoothing import Smoothed, natural_spline, smooth

Array = NDArray[np.float64]

ROUNDS = 12
"""Times at most that points are projected and fitted again."""

GROUPS = 24
"""Points of the first guess; more are averaged in groups."""

SIGNIFICANCE = 0.01
"""Chance that straight noise passes for curvature."""

HINT_MARGIN = 0.1
"""Difference of a base hint's distances to both ends, in lengths, below which it tells nothing."""


SCATTER = 0.08
#: Noise that a straight line may leave to points, as a share of their extent, unless it is stated.
STRAIGHT = 0.02
"""Largest noise, in extents of the points, that is believed unless it was stated."""

WANDERING = 4.0
"""Length of a curve, in extents of its points, beyond which they are not in order."""


@dataclass(frozen=True, eq=False)
class Digitized:
    """The shape found in points, in a frame along the base tangent with any roll."""

    length: float
    curvature: Profile
    pose: Pose
    noise: float


def digitize(
    points: ArrayLike,
    noise: float | None,
    base: str | ArrayLike | None,
    any_length: bool = False,
) -> Digitized:
    """Find length, intrinsic curvature and pose in digitised points."""
    array = checked_points(points, noise, any_length)
    array = array[::-1] if _starts_at_tip(array, base) else array
    line = _Line.fitted(array)
    if line.deviation <= 1e-9 * line.extent:
        return line.digitized(noise or 0.0, any_length)
    # Lengths are counted in extents of the data from here on, about its middle.
    middle, unit = array.mean(axis=0), line.extent
    scaled = (array - middle) / unit
    components = max(int(np.linalg.matrix_rank(scaled, tol=1e-9)) - 1, 1)
    relative = None if noise is None else noise / unit
    fit, parameters = _fitted(scaled, relative, components)
    found = fit.noise(components) if len(fit.residuals) else 0.0
    _require_curve(fit.curve, found, relative)
    _require_order(parameters, found)
    sigma = found * unit if noise is None else noise
    if len(fit.residuals) and line.explains(array, fit, components, unit, noise):
        sigma = line.noise(components) if noise is None else noise
        return line.digitized(sigma, any_length)
    curve = BSpline(fit.curve.t, fit.curve.c * unit + middle, 5)
    digitized = _measured(curve, float(parameters[0]), float(parameters[-1]), sigma)
    _require_length(digitized.length, any_length)
    return digitized


def checked_points(
    points: ArrayLike, noise: float | None = None, any_length: bool = False
) -> Array:
    """Return points as (n, 3), m, or raise a ValueError that names every fault."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ValueError(f"points have shape {array.shape}; (n, 3) or (n, 2) is needed")
    faults = []
    if noise is not None and not (np.isfinite(noise) and noise >= 0.0):
        faults.append(f"noise is {noise!r} m; None or a number that is not negative is allowed")
    if len(array) < 4:
        faults.append(f"there are {len(array)} points; at least 4 are needed")
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
            faults += ["all points are one: " + fault for fault in length_faults(extent)]
        elif extent > LONGEST:
            faults += length_faults(extent, any_length)
    if faults:
        raise ValueError("no whisker in these points: " + "; ".join(faults))
    return array if array.shape[1] == 3 else np.column_stack([array, np.zeros(len(array))])


def _rows(indices: NDArray[np.intp], most: int = 8) -> str:
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
    if abs(first - last) < HINT_MARGIN * np.linalg.norm(points[-1] - points[0]):
        raise ValueError(
            f"base is {hint.tolist()} m, which is {first:.4g} m from the first point and "
            f"{last:.4g} m from the last: it does not tell them apart; give a nearer point, "
            '"first" or "last"'
        )
    return last < first


@dataclass(frozen=True, eq=False)
class _Line:
    """The straight line nearest the points, and how they lie along and about it."""

    start: Array
    direction: Array
    length: float
    extent: float
    along: Array
    deviation: float
    rss: float

    @classmethod
    def fitted(cls, points: Array) -> "_Line":
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
        """Whether the points are no farther from the line than noise puts them."""
        n = len(points)
        if noise is not None:
            limit = chi2.ppf(1.0 - SIGNIFICANCE, components * (n - 2))
            return bool(self.rss <= noise**2 * limit)
        rss = float(np.sum(fit.residuals**2)) * unit**2
        left, spent = components * (n - fit.freedom), components * (fit.freedom - 2.0)
        # A few points leave the test no power: curvature that moves them this far is no noise.
        if left <= 0.0 or rss <= 0.0 or self.noise(components) > STRAIGHT * self.extent:
            return False
        ratio = (self.rss - rss) / spent / (rss / left)
        return bool(fisher.sf(ratio, spent, left) > SIGNIFICANCE)

    def noise(self, components: int) -> float:
        """Standard deviation per coordinate of points about the line, m."""
        return float(np.sqrt(self.rss / (components * (len(self.along) - 2))))

    def digitized(self, noise: float, any_length: bool) -> Digitized:
        _require_order(self.along / self.extent, noise / self.extent)
        _require_length(self.length, any_length)
        pose = Pose(least_turn(self.direction), self.start)
        return Digitized(self.length, constant(np.zeros(3), self.length), pose, noise)


def _fitted(points: Array, noise: float | None, components: int) -> tuple[Smoothed, Array]:
    """Fit a curve and find the parameter of every point on it."""
    if noise == 0.0:
        return _interpolated(points)
    groups = np.array_split(points, min(len(points), GROUPS))
    vertices = np.array([group.mean(axis=0) for group in groups])
    t = _unit_interval(_chords(vertices))
    if len(vertices) < len(points):
        # Averaging has left less noise than was stated; its amount need not be known here.
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


def _interpolated(points: Array) -> tuple[Smoothed, Array]:
    t = _unit_interval(_chords(points))
    for _ in range(ROUNDS):
        curve = natural_spline(t, points)
        new = _unit_interval(ArcLength(curve).length(t))
        if np.abs(new - t).max() < 1e-12:
            break
        t = new
    curve = natural_spline(t, points)
    return Smoothed(curve, np.empty((0, 3)), float(len(points))), t


def _chords(points: Array) -> Array:
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def _unit_interval(t: Array) -> Array:
    unit: Array = (t - t.min()) / np.ptp(t)
    return unit


def _require_curve(curve: BSpline, found: float, stated: float | None) -> None:
    """Refuse points that are far from any smooth curve, or joined by a curve that wanders."""
    if found > SCATTER and (stated is None or found > 2.0 * stated):
        raise ValueError(
            f"no whisker in these points: they scatter by {100.0 * found:.0f} % of their extent "
            f"about a smooth curve, more than the {100.0 * SCATTER:.0f} % allowed; they must be in "
            "order from base to tip"
        )
    if ArcLength(curve).total > WANDERING:
        raise ValueError(
            "no whisker in these points: the curve through them is more than "
            f"{WANDERING:g} times as long as they extend; they must be in order from base to tip"
        )


def _require_order(parameters: Array, noise: float) -> None:
    """Refuse points that go back along the fitted curve farther than noise takes them."""
    back = np.maximum.accumulate(parameters) - parameters
    worst = int(back.argmax())
    if back[worst] > 10.0 * noise + 0.02:
        raise ValueError(
            f"no whisker in these points: they are not in order along it; row {worst} lies "
            f"{100.0 * back[worst]:.0f} % of the length behind an earlier one (rows counted from "
            "the base)"
        )


def _require_length(length: float, any_length: bool) -> None:
    faults = length_faults(length, any_length)
    if faults:
        raise ValueError("no whisker in these points: " + "; ".join(faults))


def _measured(curve: BSpline, start: float, end: float, noise: float) -> Digitized:
    """Measure length, base frame and curvature of a fitted curve."""
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
        rate: Array = np.cross(velocity, acceleration) / speed**3
        return rate

    spin = approximate(rotation_rate, arc.ends, tolerance=1e-11)
    turning = _total_turning(spin)
    if turning > 2.0 * np.pi:
        raise ValueError(
            f"no whisker in these points: the curve through them turns by {np.degrees(turning):.0f}"
            "° in all, more than the 360° allowed; they are not in order along the whisker, or "
            "much noisier than stated"
        )
    rotation = least_turn(np.asarray(first(start)) / np.linalg.norm(first(start)))
    # (Rᵀ)' = Rᵀ [−ω]ₓ: the transposed frame turns with the rate −ω seen from the source frame.
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
