"""The plane that contact points lie on.

With N its outward normal, h its distance from the origin and ρ the whisker's radius,

    N · p = h + ρ    and    n · t = 0 for both t across N.

Normals without a covariance only tell on which side the whisker is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contour.robust import Candidate, fitted
from vibrissa.contour.shape import FittedShape
from vibrissa.contour.touches import Array, Checked, Touches, checked


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PlaneFit(FittedShape):
    """A fitted plane, in the frame of the points.

    Attributes
    ----------
    origin : array (3,)
        Its point nearest to the points' mean, m.
    normal : array (3,)
        Outward unit vector, toward the whisker.
    covariance : array (6, 6)
        Of (origin, normal), m and 1; of rank 3.
    residuals : array (n,)
        Distances of the whisker's surface from the plane, m, positive outside; NaN for points
        that were missing.
    inliers : array (n,) of bool
        Points that were used and lie within what four standard deviations are in one dimension.
    chi_squared : array (n,)
        Squared misses of the points used, in standard deviations.
    equations : int
        Of each point; 0 if its noise is not known.
    """

    origin: Array
    normal: Array

    kind: ClassVar[str] = "plane"
    fields: ClassVar[dict[str, str]] = {"origin": "object_position", "normal": "object_axis"}

    def _distance(self, points: Array) -> Array:
        return np.asarray((points - self.origin) @ self.normal)

    def _normals(self, points: Array) -> Array:
        return np.array(np.broadcast_to(self.normal, np.shape(points)))

    def _curvature(self, points: Array) -> Array:
        return np.zeros((*points.shape, 3))

    def _slopes(self, points: Array) -> Array:
        return np.concatenate([-self._normals(points), points - self.origin], axis=-1)


@dataclass(frozen=True, eq=False)
class _Plane(Candidate):
    """One in units of the points' extent, with two unit vectors (2, 3) in it."""

    normal: Array
    height: float
    along: Array
    count: int = 3
    size: float = 1.0

    @classmethod
    def across(cls, normal: Array, height: float, toward: Array) -> _Plane:
        """Make one whose first vector points ``toward`` as far as it can."""
        normal = normal / np.linalg.norm(normal)
        first = toward - (toward @ normal) * normal
        first = first / np.linalg.norm(first)
        return cls(normal, height, np.stack([first, np.cross(normal, first)]))

    def moved(self, step: Array) -> _Plane:
        """Change by one of the height and two of the normal."""
        normal = self.normal + step[1:] @ self.along
        return _Plane.across(normal, self.height + float(step[0]), self.along[0])

    def gaps(self, touches: Touches) -> Array:
        """See `Candidate.gaps`."""
        return np.asarray(touches.position @ self.normal - self.height - touches.whisker_radius)

    def local(self, touches: Touches) -> tuple[Array, Array]:
        """See `Candidate.local`."""
        n = len(touches.position)
        return np.broadcast_to(self.normal, (n, 3)), np.zeros((n, 3, 3))

    def equations(self, touches: Touches) -> tuple[Array, Array]:
        """See `Candidate.equations`."""
        gap, n = self.gaps(touches)[:, None], len(touches.position)
        if not touches.joint:
            return gap, np.broadcast_to(self.normal, (n, 1, 3))
        assert touches.normal is not None
        by = np.zeros((n, 3, 6))
        by[:, 0, :3] = self.normal
        by[:, 1:, 3:] = self.along
        return np.column_stack([gap, touches.normal @ self.along.T]), by

    def spread(self, covariance: Array) -> Array:
        """See `Candidate.spread`: in any direction."""
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0)))

    def steps(self) -> Array:
        """See `Candidate.steps`: of (origin, normal), the origin being the height along N."""
        wide = np.zeros((6, 3))
        wide[:3, 0] = self.normal
        wide[:3, 1:] = self.height * self.along.T
        wide[3:, 1:] = self.along.T
        return wide


def fit_plane(
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    normal_covariance: ArrayLike | None = None,
    point_normal_covariance: ArrayLike | None = None,
    outside: ArrayLike | None = None,
) -> PlaneFit:
    """Fit a plane to contact points on it.

    Parameters
    ----------
    points : array_like (n, 3)
        Contact points on the whisker's centreline, m, in any one frame; rows with NaN are left out.
    covariance : array_like (n, 3, 3), optional
        Of each point, m². Without it all points count the same, and their scatter tells the noise.
    whisker_radius : array_like (n,) or float, optional
        Of the whisker at each contact, m; 0 by default.
    normals : array_like (n, 3), optional
        Outward normals of the surface at the contacts, such as the directions of the contact
        forces; of any length but zero. Without ``normal_covariance`` only their side counts.
    normal_covariance : array_like (n, 3, 3), optional
        Of each unit normal.
    point_normal_covariance : array_like (n, 3, 3), optional
        Of each point (rows) with its unit normal (columns), m; none by default.
    outside : array_like (3,), optional
        A point on the free side, such as the whisker's base, where normals are not known. By
        default the largest component of the normal is positive.

    Returns
    -------
    PlaneFit
        The plane with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are fewer than 4 points, if a covariance is none, or if the
        points do not determine a plane, as on a line.
    """
    given = checked(
        "plane",
        points,
        covariance,
        whisker_radius,
        normals,
        normal_covariance,
        point_normal_covariance,
        least=4,
    )
    found = fitted("plane", [_start(given, outside)], given)
    best = found.shape
    scale = np.repeat([given.extent, 1.0], 3)
    return PlaneFit(
        origin=given.mean + given.extent * best.height * best.normal,
        normal=best.normal,
        covariance=found.covariance * scale[:, None] * scale,
        residuals=found.residuals,
        inliers=found.inliers,
        chi_squared=found.chi_squared,
        equations=found.equations,
    )


def _start(given: Checked, outside: ArrayLike | None) -> _Plane:
    """The plane across which the points spread least, facing the free side."""
    touches = given.touches
    weight = touches.weights()[:, None]
    middle = (weight * touches.position).sum(axis=0) / weight.sum()
    axes = np.linalg.svd((touches.position - middle) * np.sqrt(weight), full_matrices=False)[2]
    normal = axes[2]
    if touches.normal is not None:
        side = float(np.median(touches.normal @ normal))
    elif outside is not None:
        away = np.asarray(outside, dtype=np.float64)
        if away.shape != (3,) or not np.isfinite(away).all():
            raise ValueError(f"outside is {away.tolist()}; three finite numbers are needed")
        side = float((away - given.mean) / given.extent @ normal)
    else:
        side = float(normal[np.argmax(np.abs(normal))])
    normal = normal if side >= 0.0 else -normal
    height = float(middle @ normal - np.average(touches.whisker_radius, weights=weight[:, 0]))
    return _Plane.across(normal, height, axes[0])
