"""The sphere that contact points lie on.

With c its centre, R its radius and ρ the whisker's, p − c = (R + ρ) n.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contour.robust import Candidate, fitted
from vibrissa.contour.shape import FittedShape
from vibrissa.contour.touches import FLOOR, Array, Touches, checked


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SphereFit(FittedShape):
    """A fitted sphere, in the frame of the points.

    Attributes
    ----------
    origin : array (3,)
        Its centre, m.
    radius : float
        Of the surface, m.
    covariance : array (4, 4)
        Of (origin, radius), m².
    residuals : array (n,)
        Distances of the whisker's surface from the sphere's, m, positive outside; NaN for
        points that were missing.
    inliers : array (n,) of bool
        Points that were used and lie within what four standard deviations are in one dimension.
    chi_squared : array (n,)
        Squared misses of the points used, in standard deviations.
    equations : int
        Of each point; 0 if its noise is not known.
    """

    origin: Array
    radius: float

    kind: ClassVar[str] = "sphere"
    fields: ClassVar[dict[str, str]] = {"origin": "object_position", "radius": "object_radius"}

    @property
    def diameter(self) -> float:
        """Of the surface, m."""
        return 2.0 * self.radius

    @property
    def diameter_sigma(self) -> float:
        """Standard deviation of the diameter, m."""
        return 2.0 * float(np.sqrt(self.covariance[3, 3]))

    def _distance(self, points: Array) -> Array:
        away = points - self.origin
        return np.asarray(np.linalg.norm(away, axis=-1) - self.radius)

    def _normals(self, points: Array) -> Array:
        away = points - self.origin
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(away / np.linalg.norm(away, axis=-1, keepdims=True))

    def _curvature(self, points: Array) -> Array:
        normal = self._normals(points)
        flat = np.eye(3) - normal[..., :, None] * normal[..., None, :]
        return np.asarray(flat / self.radius)

    def _slopes(self, points: Array) -> Array:
        normal = self._normals(points)
        return np.concatenate([-normal, -np.ones((*normal.shape[:-1], 1))], axis=-1)


@dataclass(frozen=True, eq=False)
class _Sphere(Candidate):
    """One in units of the points' extent."""

    origin: Array
    size: float
    count: int = 4

    def moved(self, step: Array) -> _Sphere:
        """Change by three of the origin and one of the radius."""
        return _Sphere(self.origin + step[:3], self.size + float(step[3]))

    def gaps(self, touches: Touches) -> Array:
        """See `Candidate.gaps`."""
        away = np.linalg.norm(touches.position - self.origin, axis=1)
        return np.asarray(away - self.size - touches.whisker_radius)

    def local(self, touches: Touches) -> tuple[Array, Array]:
        """See `Candidate.local`."""
        away = touches.position - self.origin
        normal = away / np.maximum(np.linalg.norm(away, axis=1), FLOOR)[:, None]
        flat = np.eye(3) - normal[:, :, None] * normal[:, None, :]
        far = np.maximum(np.abs(self.size + touches.whisker_radius), FLOOR)
        return normal, flat / far[:, None, None]

    def equations(self, touches: Touches) -> tuple[Array, Array]:
        """See `Candidate.equations`."""
        assert touches.normal is not None
        far = self.size + touches.whisker_radius
        n = len(far)
        by = np.zeros((n, 3, 6))
        by[:, :, :3] = np.eye(3)
        by[:, :, 3:] = -far[:, None, None] * np.eye(3)
        miss = touches.position - self.origin - far[:, None] * touches.normal
        return miss, by if touches.joint else by[:, :, :3]

    def spread(self, covariance: Array) -> Array:
        """See `Candidate.spread`: in any direction."""
        return np.asarray(np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, -1], 0.0)))

    def steps(self) -> Array:
        """See `Candidate.steps`: of (origin, radius)."""
        return np.eye(4)


def fit_sphere(
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    normal_covariance: ArrayLike | None = None,
    point_normal_covariance: ArrayLike | None = None,
) -> SphereFit:
    """Fit a sphere to contact points on parts of its surface.

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
        forces; of any length but zero.
    normal_covariance : array_like (n, 3, 3), optional
        Of each unit normal; without it they count as exact.
    point_normal_covariance : array_like (n, 3, 3), optional
        Of each point (rows) with its unit normal (columns), m; none by default.

    Returns
    -------
    SphereFit
        The sphere with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are fewer than 5 points, if a covariance is none, or if the
        points do not determine a sphere, as on a line, or on a circle without normals.
    """
    given = checked(
        "sphere",
        points,
        covariance,
        whisker_radius,
        normals,
        normal_covariance,
        point_normal_covariance,
        least=5,
    )
    found = fitted("sphere", _starts(given.touches), given)
    return SphereFit(
        origin=given.mean + given.extent * found.shape.origin,
        radius=float(given.extent * found.shape.size),
        covariance=found.covariance * given.extent**2,
        residuals=found.residuals,
        inliers=found.inliers,
        chi_squared=found.chi_squared,
        equations=found.equations,
    )


def _starts(touches: Touches) -> list[_Sphere]:
    """Spheres fitted algebraically to the points, and linearly to points and normals."""
    p, n = touches.position, len(touches.position)
    weight = touches.weights()
    root = np.sqrt(weight)
    whisker = float(np.average(touches.whisker_radius, weights=weight))
    # |p|² = 2 c·p + (R² − c²)
    system = np.column_stack([2.0 * p, np.ones(n)]) * root[:, None]
    solution = np.linalg.lstsq(system, (p**2).sum(axis=1) * root, rcond=None)[0]
    size = np.sqrt(max(float(solution[3] + solution[:3] @ solution[:3]), 1e-12))
    starts = [_Sphere(solution[:3], max(size - whisker, 1e-3 * size))]
    if touches.normal is not None:
        # p = c + (R + ρ) n
        system = np.concatenate(
            [np.broadcast_to(np.eye(3), (n, 3, 3)), touches.normal[:, :, None]], axis=2
        )
        right = p - touches.whisker_radius[:, None] * touches.normal
        solution = np.linalg.lstsq(
            (system * root[:, None, None]).reshape(-1, 4),
            (right * root[:, None]).reshape(-1),
            rcond=None,
        )[0]
        starts.append(_Sphere(solution[:3], max(float(solution[3]), 1e-3)))
    return starts
