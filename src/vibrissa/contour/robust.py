"""What all fits of simple shapes share: equations by contact, few outliers, an honest spread.

A contact point p lies on the whisker's centreline, one whisker radius ρ off the surface; n is the
surface's outward normal there. For a surface with signed distance d and its gradient N,

    d(p) = ρ    and    N(p) = n.

**With normals and their covariance** both are used. Each shape writes them as three equations that
are linear in p and n, E (p, n) = e, and their misses are weighed by the inverse of E Σ Eᵀ, Σ being
the joint covariance (6 × 6) of p and n. What joins them counts: three signals tell a contact by
three unknowns, so that Σ is of rank three, and where the point is wrong along the whisker the
normal is turned with it (correlation 0.9 and more).

**With normals alone** these count as exact, and the equations hold in two or three directions.

**Without normals** d(p) = ρ is left. Points are located badly in one direction and well in the
others; what counts is the spread along the normal, σ² = N·ΣN. Spread along a curved surface
matters to second order: with the curvature H = ∂N/∂p a scattered point lies tr(HΣ)/2 farther out in
the mean, which is taken off, and tr(HΣHΣ)/2 is added to σ². What stays is a bias of that order, as
each point brings its own unknown place on the surface. (Moving each point to the foot of its error
ellipse, orthogonal distance regression, is worse, and so is integrating over all feet: the points
touch only parts of the object.)

In all cases outliers count less (soft L1), and points that scatter by more than half the object's
radius are left out where enough others are there: they tell little about a curve that small, and
how far they are believed depends on their own error.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Self, TypeVar

import numpy as np
from scipy.optimize import OptimizeResult, least_squares
from scipy.stats import chi2

from vibrissa.contour.goodness import excess_of
from vibrissa.contour.touches import FLOOR, Array, Checked, Mask, Touches, whitened

_SOFT = 2.0
"""Residual, in standard deviations, from which points count less."""

_OUTLIER = float(chi2.sf(16.0, 1))
"""Chance of missing by as much as counts as an outlier: that of four standard deviations."""

_WIDE = 0.5
"""Spread, as a share of the shape's size, beyond which a point is left out."""

_TO_SIGMA = 1.4826
"""Standard deviation over the median size of normally distributed numbers."""

_ROUGH = 1e-2
"""Standard deviation to begin with, as a share of the extent, where it is not known."""

_ROUNDS = 4
_PRECISE = 1e-6
_SINGULAR = 1e-7
_ENOUGH = 50
_LARGEST = 1e3


class Candidate(ABC):
    """A shape that is being fitted, in units of the points' extent."""

    count: int
    size: float

    @abstractmethod
    def moved(self, step: Array) -> Self:
        """Change by a step (count,), smoothly, as derivatives by differences need it."""

    @abstractmethod
    def gaps(self, touches: Touches) -> Array:
        """Distances (n,) of the whisker's surface from the shape's."""

    @abstractmethod
    def local(self, touches: Touches) -> tuple[Array, Array]:
        """Normals (n, 3) and their derivatives (n, 3, 3) at the points."""

    @abstractmethod
    def equations(self, touches: Touches) -> tuple[Array, Array]:
        """By how much contacts with normals miss (n, m), and the derivatives (n, m, 3 or 6)."""

    @abstractmethod
    def spread(self, covariance: Array) -> Array:
        """Largest standard deviation (n,) of points of covariance (n, 3, 3) that matters."""

    @abstractmethod
    def steps(self) -> Array:
        """Derivatives (parameters, count) of the shape's parameters by a step."""


T = TypeVar("T", bound=Candidate)


@dataclass(frozen=True, eq=False)
class Found(Generic[T]):
    """A fitted shape."""

    shape: T
    covariance: Array
    residuals: Array
    inliers: Mask
    chi_squared: Array
    equations: int


def fitted(
    what: str, starts: Sequence[T], given: Checked, arranged: Callable[[T], T] | None = None
) -> Found[T]:
    """Fit a shape to contacts."""
    touches = given.touches
    if touches.covariance is None:
        touches, starts = _scattered(what, starts, touches)
    used = np.ones(len(touches.position), dtype=bool)
    best = _best(what, starts, touches)
    if given.touches.point_covariance is not None:
        narrow = best.spread(given.touches.point_covariance) < _WIDE * best.size
        if narrow.sum() >= _ENOUGH:
            used = narrow
            best = _best(what, [best], touches.rows(used))
    best = best.moved(_solved(best, touches.rows(used), 1e-15).x)
    if not best.size > 0.0:
        # Equations with normals are linear in the radius and know no sign.
        raise ValueError(
            f"no {what}: points and normals fit only a hollow one, of negative radius; forces are "
            "no normals where there is friction or inertia: leave the normals out"
        )
    best = best if arranged is None else arranged(best)
    covariance, squares, equations = _uncertainty(what, best, touches.rows(used))
    residuals, chi_squared = np.full((2, given.usable.size), np.nan)
    residuals[given.usable] = best.gaps(touches) * given.extent
    chi_squared[np.flatnonzero(given.usable)[used]] = squares
    inliers = np.asarray(chi_squared < chi2.isf(_OUTLIER, equations))
    if given.touches.covariance is None:
        equations = 0
    return Found(best, covariance, residuals, inliers, chi_squared, equations)


def _scattered(what: str, starts: Sequence[T], touches: Touches) -> tuple[Touches, Sequence[T]]:
    """Give all contacts one covariance, the same in all directions, by how they scatter.

    Also where to start from with it.
    """
    noise, n = _ROUGH, len(touches.position)
    for _ in range(_ROUNDS):
        alike = touches._replace(covariance=np.broadcast_to(noise**2 * np.eye(3), (n, 3, 3)))
        best = _best(what, starts, alike)
        starts = [best]
        size = np.abs(noise * _misses(best, alike))
        noise = max(_TO_SIGMA * float(np.median(size)), FLOOR)
    return alike, starts


def _misses(shape: Candidate, touches: Touches) -> Array:
    """By how much each equation is missed, (n, m), in standard deviations."""
    spread = touches.covariance
    assert spread is not None
    if touches.normal is not None:
        miss, by = shape.equations(touches)
        return whitened(miss, by @ spread @ np.swapaxes(by, 1, 2))
    gap = shape.gaps(touches)
    normal, curvature = shape.local(touches)
    bent = curvature @ spread
    shift = 0.5 * np.trace(bent, axis1=1, axis2=2)
    variance = np.einsum("ni,nij,nj->n", normal, spread, normal)
    variance = variance + 0.5 * np.einsum("nij,nji->n", bent, bent) + FLOOR**2
    return np.asarray((gap - shift) / np.sqrt(variance))[:, None]


def _solved(
    start: Candidate, touches: Touches, tolerance: float = 1e-8, most: int = 50
) -> OptimizeResult:
    """Change a shape until it fits best."""

    def misses(step: Array) -> Array:
        return _misses(start.moved(step), touches).reshape(-1)

    return least_squares(
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


def _best(what: str, starts: Sequence[T], touches: Touches) -> T:
    """Fit from every start, roughly; refine the best that is of some size."""
    best, least = None, np.inf
    for start in starts:
        solved = _solved(start, touches, 1e-2, 10)
        shape = start.moved(solved.x)
        if 0.0 < shape.size < _LARGEST and solved.cost < least:
            best, least = shape, float(solved.cost)
    if best is None:
        raise ValueError(f"no {what}: none of any size fits the points")
    return best.moved(_solved(best, touches).x)


def _uncertainty(what: str, shape: Candidate, touches: Touches) -> tuple[Array, Array, int]:
    """Covariance of the parameters; the squared miss of each contact, and its equations' number."""
    solved = _solved(shape, touches, most=1)
    design, z = np.asarray(solved.jac), np.asarray(solved.fun)
    size = np.linalg.norm(design, axis=0)
    determined = bool((size > 0.0).all())
    if determined:
        values = np.linalg.svd(design / size, compute_uv=False)
        determined = bool(values[-1] > _SINGULAR * values[0])
    if not determined:
        raise ValueError(
            f"no {what}: the points do not determine one; touch it in more places or on other sides"
        )
    free = max(z.size - shape.count, 1)
    misses = z.reshape(len(touches.position), -1)
    squares, equations = (misses**2).sum(axis=1), misses.shape[1]
    # Where points scatter more than they say, the fit is that much less certain: by a few that are
    # far off a little, but fully where most of them are off, as on an object of another shape.
    soft = float((z**2 / np.sqrt(1.0 + (z / _SOFT) ** 2)).sum()) / free
    excess = max(1.0, soft, excess_of(squares, equations))
    steps = shape.steps()
    covariance = steps @ np.linalg.inv(design.T @ design) @ steps.T * excess
    return covariance, squares, equations
