"""The fit of simple shapes to contacts: few outliers, equations by contact, a stated spread.

A contact point p lies on the whisker's centreline, one whisker radius ρ off the surface; n is the
surface's outward normal there. For a surface with signed distance d and its gradient N,

    d(p) = ρ    and    N(p) = n.

**With normals and their covariance** both are used. Each shape writes them as equations that are
linear in p and n, E (p, n) = e, and their misses are weighed by the inverse of E Σ Eᵀ, Σ being the
joint covariance (6 × 6) of p and n. Their correlation counts: three signals determine a contact by
three unknowns, so that Σ is of rank three, and where the point is wrong along the whisker the
normal is turned with it (correlation 0.9 and more).

**With normals alone** these count as exact, and the equations hold in two or three directions.

**Without normals** d(p) = ρ is left. Points are located badly in one direction and well in the
others; what counts is the spread along the normal, σ² = N·ΣN. Spread along a curved surface
matters to second order: with the curvature H = ∂N/∂p a scattered point is tr(HΣ)/2 farther out in
the mean, which is subtracted, and tr(HΣHΣ)/2 is added to σ². What stays is a bias of that order, as
each point brings its own unknown location on the surface. (Moving each point to the foot of its
error ellipse, orthogonal distance regression, is worse, and so is integrating over all feet: the
points are on parts of the object only.)

In all cases outliers count less (soft L1), and points that scatter by more than half the object's
radius are left out where enough others are there: they contain little about a curve that small, and
how much they count depends on their own error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contour.fitted_shape import FLOOR, Checked, Touches, checked, excess_of, whitened
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

_SOFT = 2.0  # residual, in standard deviations, from which points count less
# Chance of missing by as much as counts as an outlier: that of four standard deviations.
_OUTLIER = math.erfc(4.0 / math.sqrt(2.0))
_WIDE = 0.5  # spread, as a share of the shape's size, beyond which a point is left out
_ENOUGH = 50  # number of points with less spread from which wide ones are left out
TO_SIGMA = 1.4826  # standard deviation over the median size of normally distributed numbers
_ROUGH = 1e-2  # standard deviation to begin with, as a share of the extent, where it is not known
_ROUNDS = 4  # number of times that the noise is estimated from the scatter
_PRECISE = 1e-6  # tolerance up to which derivatives are central differences
_SINGULAR = 1e-7  # least over largest singular value from which the parameters are determined
_HOLLOW = 3.0  # standard deviations below zero from which a radius is that of a hollow
# Squared misses, relative to what is stated, from which most normals contradict the points.
_ALIKE = 4.0
_LARGEST = 1e3  # size, in units of the extent, from which a shape is of no size
# Options that apply to some shapes only, and what they must be.
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
    *,
    axis: ArrayLike | None = None,
    outside: ArrayLike | None = None,
) -> SimpleShape:
    """Fit a simple shape to contact points on parts of its surface.

    Parameters
    ----------
    kind : {"plane", "sphere", "cylinder"}
        Shape of the object.
    points : array_like (n, 3)
        Contact points on the whisker's centreline, m, in any one frame; rows with NaN are left out.
    covariance : array_like (n, 3, 3), optional
        Covariance of each point, m². Without it all points count the same, and their scatter gives
        the noise.
    whisker_radius : array_like (n,) or float, optional
        Radius of the whisker at each contact, m; 0 by default.
    normals : array_like (n, 3), optional
        Outward normals of the surface at the contacts, such as the directions of the contact
        forces; of any length but zero. With them a fit is several times more accurate. Of a plane
        without ``normal_covariance`` only their side counts.
    normal_covariance : array_like (n, 3, 3), optional
        Covariance of each unit normal; without it they count as exact. With it they determine the
        axis of a cylinder too, several times more accurately than the points.
    point_normal_covariance : array_like (n, 3, 3), optional
        Covariance of each point (rows) with its unit normal (columns), m; none by default. Where
        both come from the same few signals their errors are correlated (0.9 and more), and this
        matters.
    axis : array_like (3,), optional
        Direction of a cylinder's axis where it is known.
    outside : array_like (3,), optional
        Point on the free side of a plane, such as the whisker's base, where normals are not known.
        By default the largest component of its normal is positive.

    Returns
    -------
    CylinderFit, SphereFit or PlaneFit
        Shape with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are too few points (4 for a plane, 5 for a sphere, 6 for a
        cylinder, 4 with a known axis), if a covariance is none, or if the points do not determine
        the shape, as on a line.
    """
    if kind not in SHAPES:
        raise ValueError(f"the shape is {kind!r}; it must be one of {', '.join(SHAPES)}")
    declared = SHAPES[kind]
    known = {"axis": axis, "outside": outside}
    for name, value in known.items():
        if value is not None:
            _check_known(kind, name, np.asarray(value, dtype=np.float64))
    count = declared.steps if axis is None else declared.steps - 2
    given = checked(
        kind,
        points,
        least=count + 1,
        covariance=covariance,
        whisker_radius=whisker_radius,
        normals=normals,
        normal_covariance=normal_covariance,
        point_normal_covariance=point_normal_covariance,
    )
    starts = declared.starts(given, outside if axis is None else axis)
    return _fitted([_Posed.at(shape, toward, count) for shape, toward in starts], given)


def _check_known(kind: str, name: str, value: Array) -> None:
    of, needed = _NEEDS[name]
    if kind != of:
        raise ValueError(f"{name} is given; only a {of} has one, and the shape is {kind!r}")
    usable = value.shape == (3,) and np.isfinite(value).all()
    if not usable or (name == "axis" and not value.any()):
        raise ValueError(f"{name} is {value.tolist()}; {needed}")


@dataclass(frozen=True, eq=False)
class _Posed:
    """A shape that is being fitted, with the frame of its steps, of which so many are free."""

    shape: SimpleShape
    frame: Array
    count: int

    @classmethod
    def at(cls, shape: SimpleShape, toward: Array, count: int) -> _Posed:
        """Shape with the frame whose first vector points ``toward`` as far as it can."""
        return cls(shape, frame_across(shape.direction, toward), count)

    def moved(self, step: Array) -> _Posed:
        """Same, changed by a step."""
        return _Posed.at(self.shape.moved(step, self.frame), self.frame[0], self.count)

    def misses(self, touches: Touches) -> Array:
        """Misses (n, m) of the equations, in standard deviations."""
        spread = touches.covariance
        assert spread is not None
        if touches.normal is not None:
            miss, by = self.shape.misses(touches, self.frame)
            return whitened(miss, by @ spread @ np.swapaxes(by, 1, 2))
        normal, curvature = self.shape.local(touches)
        bent = curvature @ spread
        shift = 0.5 * np.trace(bent, axis1=1, axis2=2)
        variance = np.einsum("ni,nij,nj->n", normal, spread, normal)
        variance = variance + 0.5 * np.einsum("nij,nji->n", bent, bent) + FLOOR**2
        return np.asarray((self.shape.gaps(touches) - shift) / np.sqrt(variance))[:, None]

    def spread(self, covariance: Array) -> Array:
        """Largest standard deviation (n,) of points of covariance (n, 3, 3) that matters."""
        directions = self.shape.relevant(self.frame)
        widest = np.linalg.eigvalsh(directions @ covariance @ directions.T)[:, -1]
        return np.asarray(np.sqrt(np.maximum(widest, 0.0)))


def _fitted(starts: Sequence[_Posed], given: Checked) -> SimpleShape:
    """Fit a shape to contacts."""
    touches = given.touches
    if touches.covariance is None:
        touches, starts = _scattered(starts, touches)
    used = np.ones(len(touches.position), dtype=bool)
    best = _best(starts, touches)
    if given.touches.point_covariance is not None:
        narrow = best.spread(given.touches.point_covariance) < _WIDE * best.shape.size
        if narrow.sum() >= _ENOUGH:
            used = narrow
            best = _best([best], touches.rows(used))
    best = best.moved(_solved(best, touches.rows(used), 1e-15).x)
    if not best.shape.size > 0.0:
        best = _solid(best, touches.rows(used))
    best = _Posed.at(best.shape.arranged(), best.frame[0], best.count)
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


def _solid(best: _Posed, touches: Touches) -> _Posed:
    """The shape of positive size that is as probable as a fit of negative size allows."""
    covariance, _, squares, equations = _uncertainty(best, touches)
    size, sigma = best.shape.size, float(np.sqrt(covariance[-1, -1]))
    contradicted = float(np.median(squares)) > _ALIKE * equations
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


def _scattered(starts: Sequence[_Posed], touches: Touches) -> tuple[Touches, Sequence[_Posed]]:
    """Contacts with one covariance, the same in all directions, by how they scatter."""
    noise, n = _ROUGH, len(touches.position)
    for _ in range(_ROUNDS):
        alike = touches._replace(covariance=np.broadcast_to(noise**2 * np.eye(3), (n, 3, 3)))
        best = _best(starts, alike)
        starts = [best]
        size = np.abs(noise * best.misses(alike))
        noise = max(TO_SIGMA * float(np.median(size)), FLOOR)
    return alike, starts


def _solved(
    start: _Posed, touches: Touches, tolerance: float = 1e-8, most: int = 50
) -> optimize.OptimizeResult:
    """Change a shape until it fits best."""

    def misses(step: Array) -> Array:
        return start.moved(step).misses(touches).reshape(-1)

    return optimize.least_squares(
        misses,
        np.zeros(start.count),
        jac="2-point" if tolerance > _PRECISE else "3-point",
        loss="soft_l1",
        f_scale=_SOFT,
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        gtol=None,
        max_nfev=most,
    )


def _best(starts: Sequence[_Posed], touches: Touches) -> _Posed:
    """Fit from every start, roughly; refine the best that is of some size."""
    best, least = None, np.inf
    for start in starts:
        solved = _solved(start, touches, 1e-2, 10)
        moved = start.moved(solved.x)
        if 0.0 < moved.shape.size < _LARGEST and solved.cost < least:
            best, least = moved, float(solved.cost)
    if best is None:
        raise ValueError(f"no {starts[0].shape.kind}: none of any size fits the points")
    return best.moved(_solved(best, touches).x)


def _uncertainty(best: _Posed, touches: Touches) -> tuple[Array, float, Array, int]:
    """Covariance of the parameters as stated, and by how much contacts scatter more than stated."""
    solved = _solved(best, touches, most=1)
    design, z = np.asarray(solved.jac), np.asarray(solved.fun)
    size = np.linalg.norm(design, axis=0)
    determined = bool((size > 0.0).all())
    if determined:
        values = np.linalg.svd(design / size, compute_uv=False)
        determined = bool(values[-1] > _SINGULAR * values[0])
    if not determined:
        raise ValueError(
            f"no {best.shape.kind}: the points do not determine one; touch it at more positions or "
            "on other sides"
        )
    free = max(z.size - best.count, 1)
    misses = z.reshape(len(touches.position), -1)
    squares, equations = (misses**2).sum(axis=1), misses.shape[1]
    # Where points scatter more than stated the fit is that much less certain: a little by a few
    # that are far off, but fully where most of them are off, as on an object of another shape.
    soft = float((z**2 / np.sqrt(1.0 + (z / _SOFT) ** 2)).sum()) / free
    excess = max(1.0, soft, excess_of(squares, equations))
    slopes = best.shape.step_slopes(best.frame)[:, : best.count]
    return slopes @ np.linalg.inv(design.T @ design) @ slopes.T, excess, squares, equations
