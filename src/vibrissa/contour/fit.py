"""Robust fits of simple shapes to contacts, with the covariance of the parameters.

A contact point p is on the whisker's centreline, one whisker radius ρ from the surface, whose
outward normal there is n. For a surface with signed distance d and its gradient N,

    d(p) = ρ    and    N(p) = n.

**With normals and their covariance** both equations are used. Each shape states them as equations
linear in p and n, E (p, n) = e, and their residuals are weighted by the inverse of E Σ Eᵀ, where Σ
is the joint covariance (6 × 6) of p and n. The correlation matters: three signals determine a
contact by three unknowns, so that Σ has rank three, and an error of the point along the whisker
comes with a rotation of the normal (correlation 0.9 and more).

**With normals alone** these count as exact, and the equations hold in two or three directions.

**Without normals** d(p) = ρ remains. Points are poorly located in one direction and well in the
others; what matters is the variance along the normal, σ² = N·ΣN. Scatter along a curved surface
matters to second order: with the curvature H = ∂N/∂p a scattered point is on average tr(HΣ)/2
farther out, which is subtracted, and tr(HΣHΣ)/2 is added to σ². A bias of that order remains, as
each point adds its own unknown location on the surface. (Moving each point to the foot of its error
ellipse, orthogonal distance regression, is worse, and so is integrating over all feet, because the
points are on parts of the object only.)

In all cases outliers are downweighted (soft L1). Points that scatter by more than half the object's
radius are excluded if there are enough others: they contain little information on such a strong
curvature, and their weights depend on their own errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contour.fitted_shape import (
    FLOOR,
    Checked,
    FittedShape,
    Touches,
    check_contacts,
    excess_of,
    whiten,
)
from vibrissa.contour.simple_shapes import (
    SHAPES,
    CylinderFit,
    PlaneFit,
    SimpleShape,
    SphereFit,
    frame_across,
)
from vibrissa.deferred import optimize, special
from vibrissa.numerics import Array

_SOFT = 2.0  # residual, in standard deviations, above which points are downweighted
# Tail probability of an outlier: that of four standard deviations.
_OUTLIER = math.erfc(4.0 / math.sqrt(2.0))
_WIDE = 0.5  # standard deviation, over the shape's size, above which a point is excluded
_ENOUGH = 50  # number of other points needed to exclude such points
TO_SIGMA = 1.4826  # ratio of standard deviation and median absolute value of a normal distribution
_ROUGH = 1e-2  # initial standard deviation if unknown, over the extent
_ROUNDS = 4  # number of times that the noise is estimated from the scatter
_PRECISE = 1e-6  # tolerance below which derivatives are central differences
_SINGULAR = 1e-7  # least ratio of singular values at which the parameters are determined
_HOLLOW = 3.0  # standard deviations below zero beyond which a radius is that of a hollow
# Median of squared residuals, per equation, above which normals contradict the points.
_CONTRADICTION = 4.0
_LARGEST = 1e3  # size, over the extent, above which a shape counts as infinitely large
# Options for particular shapes only, and requirements on them.
_NEEDS = {
    "axis": ("cylinder", "three numbers, not all zero, are needed"),
    "outside": ("plane", "three finite numbers are needed"),
}


@overload
def fit_shape(kind: Literal["cylinder"], *points: Any, **known: Any) -> CylinderFit: ...
@overload
def fit_shape(kind: Literal["sphere"], *points: Any, **known: Any) -> SphereFit: ...
@overload
def fit_shape(kind: Literal["plane"], *points: Any, **known: Any) -> PlaneFit: ...
@overload
def fit_shape(kind: str, *points: Any, **known: Any) -> SimpleShape: ...
def fit_shape(
    kind: str,
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    normal_covariance: ArrayLike | None = None,
    point_normal_covariance: ArrayLike | None = None,
    shared: ArrayLike | None = None,
    *,
    axis: ArrayLike | None = None,
    outside: ArrayLike | None = None,
    start: FittedShape | None = None,
) -> SimpleShape:
    """Fit a simple shape to contact points on parts of its surface.

    Parameters
    ----------
    kind : {"plane", "sphere", "cylinder"}
        Shape of the object.
    points : array_like (n, 3)
        Contact points on the whisker's centreline, m, in any common frame; rows with NaN are
        ignored.
    covariance : array_like (n, 3, 3), optional
        Covariance of each point, m². Without it all points have equal weights, and the noise is
        estimated from their scatter.
    whisker_radius : array_like (n,) or float, optional
        Radius of the whisker at each contact, m; 0 by default.
    normals : array_like (n, 3), optional
        Outward normals of the surface at the contacts, such as the directions of the contact
        forces; of any nonzero length. They make a fit several times more accurate. Without
        ``normal_covariance``, a plane's normals only determine its free side.
    normal_covariance : array_like (n, 3, 3), optional
        Covariance of each unit normal; without it they count as exact. With it they also determine
        the axis of a cylinder, several times more accurately than the points.
    point_normal_covariance : array_like (n, 3, 3), optional
        Covariance of each point (rows) with its unit normal (columns), m; zero by default. Where
        both come from the same few signals their errors are correlated (0.9 and more), and this
        matters.
    shared : array_like (n, k, 6), optional
        Changes of each point and unit normal by one standard deviation of k errors that contacts
        share, in addition to their own covariance: unlike these, they do not become smaller with
        the number of contacts.
    axis : array_like (3,), optional
        Known direction of a cylinder's axis.
    outside : array_like (3,), optional
        Point on the free side of a plane, such as the whisker's base, if normals are unknown. By
        default the largest component of the normal is positive.
    start : CylinderFit, SphereFit or PlaneFit, optional
        Fit to similar points, of the same kind and with the same ``axis``. The best shape is then
        not searched for, but found from this one, in a fraction of the time.

    Returns
    -------
    CylinderFit, SphereFit or PlaneFit
        Shape with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are too few points (4 for a plane, 5 for a sphere, 6 for a
        cylinder, 4 with a known axis), if a covariance is invalid, or if the points do not
        determine the shape, such as points on a line.
    """
    if str(kind) not in SHAPES:
        raise ValueError(f"the shape is {kind!r:.40}; it must be one of {', '.join(SHAPES)}")
    declared = SHAPES[kind]
    known = {"axis": axis, "outside": outside}
    for name, value in known.items():
        if value is not None:
            _check_known(kind, name, np.asarray(value, dtype=np.float64))
    count = declared.steps if axis is None else declared.steps - 2
    given = check_contacts(
        kind,
        points,
        least=count + 1,
        covariance=covariance,
        whisker_radius=whisker_radius,
        normals=normals,
        normal_covariance=normal_covariance,
        point_normal_covariance=point_normal_covariance,
        shared=shared,
    )
    if start is not None:
        if not isinstance(start, declared):
            raise ValueError(f"start is a {start.kind}, and the shape is {kind!r}")
        near = start.scaled(given)
        return _fit([_SteppedShape(near, frame_across(near.direction), count)], given)
    starts = declared.starts(given, outside if axis is None else axis)
    return _fit([_SteppedShape.at(shape, toward, count) for shape, toward in starts], given)


def _check_known(kind: str, name: str, value: Array) -> None:
    """Check an option that applies to one kind of shape only."""
    of, needed = _NEEDS[name]
    if kind != of:
        raise ValueError(f"{name} is given; only a {of} has one, and the shape is {kind!r}")
    usable = value.shape == (3,) and np.isfinite(value).all()
    if not usable or (name == "axis" and not value.any()):
        raise ValueError(f"{name} is {value.tolist()}; {needed}")


@dataclass(frozen=True, eq=False)
class _SteppedShape:
    """A shape during a fit, with the frame of its steps and the number of free ones."""

    shape: SimpleShape
    frame: Array
    count: int

    @classmethod
    def at(cls, shape: SimpleShape, toward: Array, count: int) -> _SteppedShape:
        """Shape with the frame whose first vector is as close to ``toward`` as possible."""
        return cls(shape, frame_across(shape.direction, toward), count)

    def moved(self, step: Array) -> _SteppedShape:
        """Shape after a step."""
        return _SteppedShape.at(self.shape.moved(step, self.frame), self.frame[0], self.count)

    def misses(self, touches: Touches) -> Array:
        """Residuals (n, m) of the equations, in standard deviations."""
        spread = touches.covariance
        assert spread is not None
        if touches.normal is not None:
            miss, by = self.shape.misses(touches, self.frame)
            shared = touches.shared
            moved = None if shared is None else by @ np.swapaxes(shared, 1, 2)
            return whiten(miss, by @ spread @ np.swapaxes(by, 1, 2), moved)
        normal, curvature = self.shape.local(touches)
        bent = curvature @ spread
        shift = 0.5 * np.trace(bent, axis1=1, axis2=2)
        variance = np.einsum("ni,nij,nj->n", normal, spread, normal)
        variance = variance + 0.5 * np.einsum("nij,nji->n", bent, bent) + FLOOR**2
        return np.asarray((self.shape.gaps(touches) - shift) / np.sqrt(variance))[:, None]

    def spread(self, covariance: Array) -> Array:
        """Largest relevant standard deviation (n,) of points of covariance (n, 3, 3)."""
        directions = self.shape.relevant(self.frame)
        widest = np.linalg.eigvalsh(directions @ covariance @ directions.T)[:, -1]
        return np.asarray(np.sqrt(np.maximum(widest, 0.0)))


def _fit(starts: Sequence[_SteppedShape], given: Checked) -> SimpleShape:
    """Fit a shape to checked contacts from several starts."""
    touches = given.touches
    if touches.covariance is None:
        touches, starts = _with_estimated_noise(starts, touches)
    used = np.ones(len(touches.position), dtype=bool)
    best = _fit_best(starts, touches)
    if given.touches.point_covariance is not None:
        narrow = best.spread(given.touches.point_covariance) < _WIDE * best.shape.size
        if narrow.sum() >= _ENOUGH:
            used = narrow
            best = _fit_best([best], touches.rows(used))
    best = best.moved(_minimise(best, touches.rows(used), 1e-11).x)
    if not abs(best.shape.size) < _LARGEST:
        raise ValueError(_infinite(best))
    if not best.shape.size > 0.0:
        best = _with_positive_size(best, touches.rows(used))
    best = _SteppedShape.at(best.shape.arranged(), best.frame[0], best.count)
    covariance, excess, squares, equations = _uncertainty(best, touches.rows(used))
    covariance = covariance * excess
    scale = np.where(best.shape.directions, 1.0, given.extent)
    residuals, chi_squared = np.full((2, given.usable.size), np.nan)
    residuals[given.usable] = best.shape.gaps(touches) * given.extent
    chi_squared[np.flatnonzero(given.usable)[used]] = squares
    return best.shape.in_metres(
        given,
        covariance=covariance * scale[:, None] * scale,
        residuals=residuals,
        inliers=np.asarray(chi_squared < special.chdtri(equations, _OUTLIER)),
        chi_squared=chi_squared,
        equations=0 if given.touches.covariance is None else equations,
    )


def _with_positive_size(best: _SteppedShape, touches: Touches) -> _SteppedShape:
    """Replace a negative size by its expectation given that it is positive."""
    covariance, _, squares, equations = _uncertainty(best, touches)
    size, sigma = best.shape.size, float(np.sqrt(covariance[-1, -1]))
    contradicted = float(np.median(squares)) > _CONTRADICTION * equations
    if contradicted or not size > -_HOLLOW * sigma:
        raise ValueError(
            f"no {best.shape.kind}: points and normals fit only a hollow one, of negative radius; "
            "forces are not normals where there is friction or inertia: leave the normals out"
        )
    share = size / sigma
    hazard = np.exp(-0.5 * share**2 - special.log_ndtr(share)) / np.sqrt(2.0 * np.pi)
    positive = size + sigma * hazard
    slopes = best.shape.step_slopes(best.frame)[:, : best.count]
    steps = np.linalg.pinv(slopes) @ covariance[:, -1]
    return best.moved(steps * (positive - size) / covariance[-1, -1])


def _with_estimated_noise(
    starts: Sequence[_SteppedShape], touches: Touches
) -> tuple[Touches, Sequence[_SteppedShape]]:
    """Contacts with one isotropic covariance, estimated from their scatter; and improved starts."""
    noise, n = _ROUGH, len(touches.position)
    for _ in range(_ROUNDS):
        alike = touches._replace(covariance=np.broadcast_to(noise**2 * np.eye(3), (n, 3, 3)))
        best = _fit_best(starts, alike)
        starts = [best]
        size = np.abs(noise * best.misses(alike))
        noise = max(TO_SIGMA * float(np.median(size)), FLOOR)
    return alike, starts


def _minimise(
    start: _SteppedShape, touches: Touches, tolerance: float = 1e-8, most: int = 50
) -> optimize.OptimizeResult:
    """Minimise the robust misfit of a shape."""
    return _least_squares(start, lambda at: _softened(at.misses(touches)), tolerance, most)


def _least_squares(
    start: _SteppedShape, misses: Callable[[_SteppedShape], Array], tolerance: float, most: int
) -> optimize.OptimizeResult:
    def residuals(step: Array) -> Array:
        return misses(start.moved(step)).reshape(-1)

    return optimize.least_squares(
        residuals,
        np.zeros(start.count),
        jac="2-point" if tolerance > _PRECISE else "3-point",
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=None,
        max_nfev=most,
    )


def _excess(misses: Array) -> Array:
    """Square (n, 1) of each contact's residuals (n, m), over that from which it is downweighted."""
    return np.asarray((misses**2).sum(axis=1, keepdims=True) / _SOFT**2)


def _softened(misses: Array) -> Array:
    """Scale residuals (n, m), those of a contact alike, so that their squares are smooth L1."""
    return np.asarray(misses * np.sqrt(2.0 / (1.0 + np.sqrt(1.0 + _excess(misses)))))


def _fit_best(starts: Sequence[_SteppedShape], touches: Touches) -> _SteppedShape:
    """Fit roughly from every start, and refine the best one of finite size."""
    found: list[tuple[bool, float, _SteppedShape]] = []
    for start in starts:
        solved = _minimise(start, touches, 1e-2, 10)
        moved = start.moved(solved.x)
        if abs(moved.shape.size) < _LARGEST:
            found.append((moved.shape.size <= 0.0, float(solved.cost), moved))
    if not found:
        raise ValueError(_infinite(starts[0]))
    # The size of a thin object may be fitted as negative; a positive one is preferred.
    *_, best = min(found, key=lambda each: each[:2])
    return best.moved(_minimise(best, touches).x)


def _infinite(start: _SteppedShape) -> str:
    """Message that only an infinitely large shape fits."""
    return (
        f"no {start.shape.kind}: none of finite size fits the points; the object may be a plane "
        "there, or forces may not be normals (friction, inertia, their signs, poses)"
    )


def _uncertainty(best: _SteppedShape, touches: Touches) -> tuple[Array, float, Array, int]:
    """Covariance of the parameters, excess of the scatter over the stated noise, and residuals."""
    solved = _least_squares(best, lambda at: at.misses(touches), 1e-8, 1)
    misses = np.asarray(solved.fun).reshape(len(touches.position), -1)
    squares, equations = (misses**2).sum(axis=1), misses.shape[1]
    weights = 1.0 / np.sqrt(1.0 + _excess(misses)[:, 0])
    design = np.asarray(solved.jac) * np.sqrt(weights).repeat(equations)[:, None]
    size = np.linalg.norm(design, axis=0)
    determined = bool(size.min() > _SINGULAR * size.max())
    if determined:
        values = np.linalg.svd(design / size, compute_uv=False)
        determined = bool(values[-1] > _SINGULAR * values[0])
    if not determined:
        raise ValueError(
            f"no {best.shape.kind}: the points do not determine one; touch it at more positions or "
            "on other sides"
        )
    # Scatter beyond the stated noise makes the fit less certain: slightly if due to a few outliers,
    # fully if due to most points, as for an object of another shape.
    soft = float(weights @ squares) / max(misses.size - best.count, 1)
    excess = max(1.0, soft, excess_of(squares, equations))
    slopes = best.shape.step_slopes(best.frame)[:, : best.count]
    return slopes @ np.linalg.inv(design.T @ design) @ slopes.T, excess, squares, equations
