"""The cylinder that contact points lie on.

A contact point p lies on the whisker's centreline, one whisker radius ρ off the surface. With q the
part of p − c across the axis (through c, along a) and n the surface normal there,

    q = (R + ρ) n.

**Where the normals are known** (they are the directions of the contact forces, which a whisker
without friction tells along with the points) these are two equations for each point, linear in c
and R, weighted by the inverse of the point's covariance Σ across the axis. The normals' own errors
are left out: where they come from noisy signals, a peg of 2.7 mm comes out some 0.01 mm too thin,
one to four of its standard deviations.

**Where they are not**, only |q| = R + ρ is left. Points are located badly in one direction and
well in the others; what counts is the spread along n = q/|q|, σ_n² = n·Σn. Spread along t = a × n
matters to second order: a point that has moved by τ along the tangent is farther from the axis by
τ²/(2|q|). Its mean σ_t²/(2|q|) is taken off, and its variance σ_t⁴/(2|q|²) added to σ_n². What
stays is a bias of some σ_t²/|q|, as each point brings its own unknown place on the circle. (Moving
each point to the foot of its error ellipse, orthogonal distance regression, is worse, and so is
integrating over all feet: the points touch only parts of the circle.)

In both cases outliers count less (soft L1), and points that scatter by more than half the radius
are left out where enough others are there: they tell nothing about a curve that small, and how far
they are believed depends on their own error.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import OptimizeResult, least_squares

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SOFT = 2.0
"""Residual, in standard deviations, from which points count less."""

_OUTLIER = 4.0
"""Residual, in standard deviations, from which a point counts as an outlier."""

_WIDE = 0.5
"""Spread, as a share of the cylinder's radius, beyond which a point is left out."""

_FLOOR = 1e-7
"""Smallest standard deviation, as a share of the points' extent, where their noise is zero."""

_SINGULAR = 1e-7
_ENOUGH = 50


@dataclass(frozen=True, eq=False)
class CylinderFit:
    """A fitted cylinder, in the frame of the points.

    Attributes
    ----------
    origin : array (3,)
        Point of the axis at the height of the points' mean, m.
    axis : array (3,)
        Unit vector along the axis; its largest component is positive.
    radius : float
        Of the surface, m.
    covariance : array (7, 7)
        Of (origin, axis, radius), m and 1; of rank 5, or 3 where the axis was given.
    residuals : array (n,)
        Distances of the whisker's surface from the cylinder's, m, positive outside; NaN for
        points that were missing.
    inliers : array (n,) of bool
        Points that were used and lie within four standard deviations.
    """

    origin: Array
    axis: Array
    radius: float
    covariance: Array = field(repr=False)
    residuals: Array = field(repr=False)
    inliers: Mask = field(repr=False)

    @property
    def diameter(self) -> float:
        """Of the surface, m."""
        return 2.0 * self.radius

    @property
    def diameter_sigma(self) -> float:
        """Standard deviation of the diameter, m."""
        return 2.0 * float(np.sqrt(self.covariance[6, 6]))

    @property
    def origin_sigma(self) -> Array:
        """Standard deviations (3,) of the coordinates of the origin, m."""
        sigma: Array = np.sqrt(np.diag(self.covariance)[:3])
        return sigma

    @property
    def rms(self) -> float:
        """Root mean square of the inliers' residuals, m."""
        return float(np.sqrt(np.mean(self.residuals[self.inliers] ** 2)))


class _Touches(NamedTuple):
    """Points about their mean, in units of their extent, and what is known of them."""

    position: Array
    covariance: Array | None
    whisker_radius: Array
    normal: Array | None

    def rows(self, which: Mask) -> _Touches:
        """Pick points."""
        picked = (None if values is None else values[which] for values in self)
        return _Touches(*picked)  # type: ignore[arg-type]


class _Cylinder(NamedTuple):
    """A cylinder in these units, with two unit vectors (2, 3) across its axis."""

    origin: Array
    axis: Array
    radius: float
    across: Array

    @classmethod
    def about(cls, origin: Array, axis: Array, radius: float, toward: Array) -> _Cylinder:
        """Make one whose first vector across the axis points ``toward`` as far as it can."""
        axis = axis / np.linalg.norm(axis)
        first = toward - (toward @ axis) * axis
        first = first / np.linalg.norm(first)
        return cls(origin, axis, radius, np.stack([first, np.cross(axis, first)]))

    def moved(self, step: Array) -> _Cylinder:
        """Change by two of the origin, one of the radius, and two or none of the axis.

        The vectors across go along smoothly, as derivatives by differences need them to.
        """
        origin = self.origin + step[:2] @ self.across
        axis = self.axis + step[3:] @ self.across[: step.size - 3]
        return _Cylinder.about(origin, axis, self.radius + float(step[2]), self.across[0])

    def gaps(self, touches: _Touches) -> Array:
        """Distances (n,) of the whisker's surface from the cylinder's."""
        away = (touches.position - self.origin) @ self.across.T
        distance: Array = np.linalg.norm(away, axis=1)
        return distance - self.radius - touches.whisker_radius


def fit_cylinder(
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    axis: ArrayLike | None = None,
    normals: ArrayLike | None = None,
) -> CylinderFit:
    """Fit a cylinder to contact points on parts of its surface.

    Parameters
    ----------
    points : array_like (n, 3)
        Contact points on the whisker's centreline, m, in any one frame; rows with NaN are left out.
    covariance : array_like (n, 3, 3), optional
        Of each point, m². Without it all points count the same, and their scatter tells the noise.
    whisker_radius : array_like (n,) or float, optional
        Of the whisker at each contact, m; 0 by default.
    axis : array_like (3,), optional
        Direction of the axis where it is known.
    normals : array_like (n, 3), optional
        Outward normals of the surface at the contacts, such as the directions of the contact
        forces; of any length but zero. With them the fit is several times more accurate.

    Returns
    -------
    CylinderFit
        The cylinder with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are fewer than 6 points (4 with a known axis), or if the
        points do not determine a cylinder, as on a line.
    """
    usable, touches, mean, extent = _checked(points, covariance, whisker_radius, normals)
    known = _known_axis(axis)
    count = 5 if known is None else 3
    if len(touches.position) <= count:
        raise ValueError(
            f"no cylinder: {len(touches.position)} usable points; at least {count + 1} are needed"
        )
    used = np.ones(len(touches.position), dtype=bool)
    best = _best(_starts(touches, known), touches, count)
    if touches.covariance is not None:
        narrow = _spread(best, touches.covariance) < _WIDE * best.radius
        if narrow.sum() >= _ENOUGH:
            used = narrow
            best = _best([best], touches.rows(used), count)
    best = best.moved(_solved(best, touches.rows(used), count, 1e-15).x)
    origin = best.origin - (best.origin @ best.axis) * best.axis
    turned = best.axis * np.sign(best.axis[np.argmax(np.abs(best.axis))])
    best = _Cylinder.about(origin, turned, best.radius, best.across[0])
    small, inside = _uncertainty(best, touches.rows(used), count)
    residuals = np.full(usable.size, np.nan)
    residuals[usable] = best.gaps(touches) * extent
    inliers = np.zeros(usable.size, dtype=bool)
    inliers[np.flatnonzero(usable)[used]] = inside
    return CylinderFit(
        origin=mean + extent * best.origin,
        axis=best.axis,
        radius=extent * best.radius,
        covariance=_widened(small, best.across, extent),
        residuals=residuals,
        inliers=inliers,
    )


def _checked(
    points: ArrayLike,
    covariance: ArrayLike | None,
    whisker_radius: ArrayLike | None,
    normals: ArrayLike | None,
) -> tuple[Mask, _Touches, Array, float]:
    """Which points are usable, they in units of their extent, their mean and extent."""
    p = np.asarray(points, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3:
        raise ValueError(f"points have shape {p.shape}; (n, 3) is needed")
    n = len(p)
    radius = np.zeros(n) if whisker_radius is None else np.asarray(whisker_radius, np.float64)
    s = None if covariance is None else np.asarray(covariance, dtype=np.float64)
    normal = None if normals is None else np.asarray(normals, dtype=np.float64)
    allowed: dict[str, tuple[Array | None, list[tuple[int, ...]]]] = {
        "whisker_radius": (radius, [(), (n,)]),
        "covariance": (s, [(n, 3, 3)]),
        "normals": (normal, [(n, 3)]),
    }
    faults = [
        f"{name} has shape {values.shape}; {' or '.join(map(str, shapes))} is needed"
        for name, (values, shapes) in allowed.items()
        if values is not None and values.shape not in shapes
    ]
    if faults:
        raise ValueError("no cylinder: " + "; ".join(faults))
    radius = np.broadcast_to(radius, (n,))
    usable = np.isfinite(p).all(axis=1) & np.isfinite(radius)
    if s is not None:
        usable &= np.isfinite(s).all(axis=(1, 2))
    if normal is not None:
        length = np.linalg.norm(normal, axis=1)
        usable &= np.isfinite(length) & (length > 0.0)
        normal = normal[usable] / length[usable, None]
    if not usable.any():
        raise ValueError("no cylinder: 0 usable points")
    mean = p[usable].mean(axis=0)
    centered = p[usable] - mean
    extent = float(np.sqrt((centered**2).sum(axis=1).mean()))
    flat = np.linalg.svd(centered, compute_uv=False)
    if len(flat) < 2 or not flat[1] > _SINGULAR * flat[0]:
        raise ValueError("no cylinder: all points lie on a line, or are the same")
    shared = None if s is None else s[usable] / extent**2
    return (
        usable,
        _Touches(centered / extent, shared, radius[usable] / extent, normal),
        mean,
        extent,
    )


def _known_axis(axis: ArrayLike | None) -> Array | None:
    if axis is None:
        return None
    known = np.asarray(axis, dtype=np.float64)
    if known.shape != (3,) or not 0.0 < np.linalg.norm(known) < np.inf:
        raise ValueError(f"axis is {known.tolist()}; three numbers, not all zero, are needed")
    unit: Array = known / np.linalg.norm(known)
    return unit


def _sideways(axis: Array) -> Array:
    """The coordinate axis that is most at right angles to an axis."""
    return np.asarray(np.eye(3)[int(np.argmin(np.abs(axis)))])


def _starts(touches: _Touches, known: Array | None) -> list[_Cylinder]:
    """Circles fitted algebraically across the likely axes."""
    axes = [known]
    if known is None:
        axes = [*np.linalg.svd(touches.position, full_matrices=False)[2], *np.eye(3)]
        if touches.normal is not None:
            axes.append(np.linalg.svd(touches.normal, full_matrices=False)[2][-1])
    weight = np.ones(len(touches.position))
    if touches.covariance is not None:
        weight = 1.0 / (np.trace(touches.covariance, axis1=1, axis2=2) + _FLOOR**2)
    root = np.sqrt(weight / weight.max())
    starts = []
    for axis in axes:
        assert axis is not None
        unit = _Cylinder.about(np.zeros(3), axis, 1.0, _sideways(axis))
        xy = touches.position @ unit.across.T
        # |xy|² = 2 c·xy + (R² − c²)
        system = np.column_stack([2.0 * xy, np.ones(len(xy))]) * root[:, None]
        solution = np.linalg.lstsq(system, (xy**2).sum(axis=1) * root, rcond=None)[0]
        center = solution[:2]
        size = np.sqrt(max(float(solution[2] + center @ center), 1e-12))
        radius = size - float(np.average(touches.whisker_radius, weights=weight))
        starts.append(unit._replace(origin=center @ unit.across, radius=max(radius, 1e-3 * size)))
    return starts


def _spread(cylinder: _Cylinder, covariance: Array) -> Array:
    """Largest standard deviation (n,) of each point across the axis."""
    widest = np.linalg.eigvalsh(cylinder.across @ covariance @ cylinder.across.T)[:, -1]
    return np.asarray(np.sqrt(np.maximum(widest, 0.0)))


def _misses(cylinder: _Cylinder, touches: _Touches) -> Array:
    """By how much each equation is missed, in standard deviations; (n,), or (2n,) with normals."""
    across = cylinder.across
    q = (touches.position - cylinder.origin) @ across.T
    spread = None if touches.covariance is None else across @ touches.covariance @ across.T
    far = cylinder.radius + touches.whisker_radius
    if touches.normal is not None:
        normal = touches.normal @ across.T
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        miss = q - far[:, None] * normal
        if spread is not None:
            root = np.linalg.cholesky(spread + _FLOOR**2 * np.eye(2))
            miss = np.linalg.solve(root, miss[..., None])[..., 0]
        return np.asarray(miss).reshape(-1)
    distance = np.linalg.norm(q, axis=1)
    if spread is None:
        return np.asarray(distance - far)
    normal = q / np.maximum(distance, _FLOOR)[:, None]
    tangent = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    along_normal = np.einsum("ni,nij,nj->n", normal, spread, normal)
    along_tangent = np.einsum("ni,nij,nj->n", tangent, spread, tangent)
    shift = along_tangent / (2.0 * np.maximum(np.abs(far), _FLOOR))
    sigma = np.sqrt(along_normal + 2.0 * shift**2 + _FLOOR**2)
    return np.asarray((distance - far - shift) / sigma)


def _solved(
    start: _Cylinder, touches: _Touches, count: int, tolerance: float = 1e-8, most: int = 50
) -> OptimizeResult:
    """Change a cylinder until it fits best."""

    def misses(step: Array) -> Array:
        return _misses(start.moved(step), touches)

    return least_squares(
        misses,
        np.zeros(count),
        jac="3-point",
        loss="linear" if touches.covariance is None else "soft_l1",
        f_scale=_SOFT,
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=None,
        max_nfev=most,
    )


def _best(starts: list[_Cylinder], touches: _Touches, count: int) -> _Cylinder:
    """Fit from every start, roughly; refine the best that is a cylinder of some size."""
    best, least = None, np.inf
    for start in starts:
        solved = _solved(start, touches, count, 1e-2, 10)
        cylinder = start.moved(solved.x)
        if 0.0 < cylinder.radius < 1e3 and solved.cost < least:
            best, least = cylinder, float(solved.cost)
    if best is None:
        raise ValueError("no cylinder: none of any size fits the points")
    return best.moved(_solved(best, touches, count).x)


def _uncertainty(cylinder: _Cylinder, touches: _Touches, count: int) -> tuple[Array, Mask]:
    """Covariance (count, count) of the steps, and which points lie within the limits."""
    solved = _solved(cylinder, touches, count)
    design, z = np.asarray(solved.jac), np.asarray(solved.fun)
    values = np.linalg.svd(design / np.linalg.norm(design, axis=0), compute_uv=False)
    if not values[-1] > _SINGULAR * values[0]:
        raise ValueError("no cylinder: the points do not determine one; touch it on other sides")
    free = max(z.size - count, 1)
    scatter = float((z**2).sum()) / free
    if touches.covariance is None:
        excess = scatter
        z = z / np.sqrt(max(scatter, np.finfo(np.float64).tiny))
    else:
        # Where points scatter more than they say, the fit is that much less certain.
        excess = max(1.0, float((z**2 / np.sqrt(1.0 + (z / _SOFT) ** 2)).sum()) / free)
    inside = (np.abs(z).reshape(len(touches.position), -1) < _OUTLIER).all(axis=1)
    return np.linalg.inv(design.T @ design) * excess, inside


def _widened(small: Array, across: Array, extent: float) -> Array:
    """Covariance of (origin, axis, radius) from that of the steps."""
    wide = np.zeros((7, len(small)))
    wide[:3, :2] = across.T * extent
    wide[6, 2] = extent
    wide[3:6, 3:] = across.T[:, : len(small) - 3]
    return np.asarray(wide @ small @ wide.T)
