"""The cylinder that contact points lie on.

With q the part of p − c across the axis (through c, along a), R its radius and ρ the whisker's,

    q = (R + ρ) n    and    n · a = 0.

Normals that count as exact are taken across the axis before, and tell nothing about its direction.
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
class CylinderFit(FittedShape):
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
        Points that were used and lie within what four standard deviations are in one dimension.
    chi_squared : array (n,)
        Squared misses of the points used, in standard deviations.
    equations : int
        Of each point; 0 if its noise is not known.
    """

    origin: Array
    axis: Array
    radius: float

    kind: ClassVar[str] = "cylinder"
    fields: ClassVar[dict[str, str]] = {
        "origin": "object_position",
        "axis": "object_axis",
        "radius": "object_radius",
    }

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

    def _distance(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(self._across(points), axis=-1) - self.radius)

    def _normals(self, points: Array) -> Array:
        across = self._across(points)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))

    def _curvature(self, points: Array) -> Array:
        tangent = np.cross(self.axis, self._normals(points))
        return np.asarray(tangent[..., :, None] * tangent[..., None, :] / self.radius)

    def _slopes(self, points: Array) -> Array:
        normal = self._normals(points)
        along = ((points - self.origin) @ self.axis)[..., None]
        return np.concatenate([-normal, -along * normal, -np.ones_like(along)], axis=-1)

    def _across(self, points: Array) -> Array:
        away = points - self.origin
        return np.asarray(away - (away @ self.axis)[..., None] * self.axis)


@dataclass(frozen=True, eq=False)
class _Cylinder(Candidate):
    """One in units of the points' extent, with two unit vectors (2, 3) across its axis."""

    origin: Array
    axis: Array
    size: float
    across: Array
    count: int

    @classmethod
    def about(cls, origin: Array, axis: Array, size: float, toward: Array, count: int) -> _Cylinder:
        """Make one whose first vector across the axis points ``toward`` as far as it can."""
        axis = axis / np.linalg.norm(axis)
        first = toward - (toward @ axis) * axis
        first = first / np.linalg.norm(first)
        return cls(origin, axis, size, np.stack([first, np.cross(axis, first)]), count)

    def moved(self, step: Array) -> _Cylinder:
        """Change by two of the origin, one of the radius, and two or none of the axis.

        The vectors across go along smoothly.
        """
        origin = self.origin + step[:2] @ self.across
        axis = self.axis + step[3:] @ self.across[: self.count - 3]
        size = self.size + float(step[2])
        return _Cylinder.about(origin, axis, size, self.across[0], self.count)

    def gaps(self, touches: Touches) -> Array:
        """See `Candidate.gaps`."""
        away = (touches.position - self.origin) @ self.across.T
        return np.asarray(np.linalg.norm(away, axis=1) - self.size - touches.whisker_radius)

    def local(self, touches: Touches) -> tuple[Array, Array]:
        """See `Candidate.local`."""
        away = (touches.position - self.origin) @ self.across.T
        away = away / np.maximum(np.linalg.norm(away, axis=1), FLOOR)[:, None]
        normal = away @ self.across
        tangent = np.cross(self.axis, normal)
        far = np.maximum(np.abs(self.size + touches.whisker_radius), FLOOR)[:, None, None]
        return normal, tangent[:, :, None] * tangent[:, None, :] / far

    def equations(self, touches: Touches) -> tuple[Array, Array]:
        """See `Candidate.equations`."""
        assert touches.normal is not None
        far = (self.size + touches.whisker_radius)[:, None]
        q = (touches.position - self.origin) @ self.across.T
        normal = touches.normal @ self.across.T
        n = len(q)
        if not touches.joint:
            normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
            return q - far * normal, np.broadcast_to(self.across, (n, 2, 3))
        by = np.zeros((n, 3, 6))
        by[:, :2, :3] = self.across
        by[:, :2, 3:] = -far[..., None] * self.across
        by[:, 2, 3:] = self.axis
        return np.column_stack([q - far * normal, touches.normal @ self.axis]), by

    def spread(self, covariance: Array) -> Array:
        """See `Candidate.spread`: across the axis."""
        widest = np.linalg.eigvalsh(self.across @ covariance @ self.across.T)[:, -1]
        return np.asarray(np.sqrt(np.maximum(widest, 0.0)))

    def steps(self) -> Array:
        """See `Candidate.steps`: of (origin, axis, radius)."""
        wide = np.zeros((7, self.count))
        wide[:3, :2] = self.across.T
        wide[6, 2] = 1.0
        wide[3:6, 3:] = self.across.T[:, : self.count - 3]
        return wide

    def upright(self) -> _Cylinder:
        """Put its origin at the height of the mean and its axis upward."""
        origin = self.origin - (self.origin @ self.axis) * self.axis
        axis = self.axis * np.sign(self.axis[np.argmax(np.abs(self.axis))])
        return _Cylinder.about(origin, axis, self.size, self.across[0], self.count)


def fit_cylinder(
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    axis: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    normal_covariance: ArrayLike | None = None,
    point_normal_covariance: ArrayLike | None = None,
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
    normal_covariance : array_like (n, 3, 3), optional
        Of each unit normal; without it they count as exact. With it they tell the direction of the
        axis too, several times more accurately than the points.
    point_normal_covariance : array_like (n, 3, 3), optional
        Of each point (rows) with its unit normal (columns), m; none by default. Where both come
        from the same few signals they err together (correlation 0.9 and more), and this matters.

    Returns
    -------
    CylinderFit
        The cylinder with its uncertainty.

    Raises
    ------
    ValueError
        If shapes are wrong, if there are fewer than 6 points (4 with a known axis), if a covariance
        is none, or if the points do not determine a cylinder, as on a line.
    """
    known = _known_axis(axis)
    count = 5 if known is None else 3
    given = checked(
        "cylinder",
        points,
        covariance,
        whisker_radius,
        normals,
        normal_covariance,
        point_normal_covariance,
        least=count + 1,
    )
    found = fitted("cylinder", _starts(given.touches, known, count), given, _Cylinder.upright)
    best = found.shape
    scale = np.repeat([given.extent, 1.0, given.extent], [3, 3, 1])
    return CylinderFit(
        origin=given.mean + given.extent * best.origin,
        axis=best.axis,
        radius=float(given.extent * best.size),
        covariance=found.covariance * scale[:, None] * scale,
        residuals=found.residuals,
        inliers=found.inliers,
        chi_squared=found.chi_squared,
        equations=found.equations,
    )


def _known_axis(axis: ArrayLike | None) -> Array | None:
    if axis is None:
        return None
    known = np.asarray(axis, dtype=np.float64)
    if known.shape != (3,) or not 0.0 < np.linalg.norm(known) < np.inf:
        raise ValueError(f"axis is {known.tolist()}; three numbers, not all zero, are needed")
    unit: Array = known / np.linalg.norm(known)
    return unit


def _starts(touches: Touches, known: Array | None, count: int) -> list[_Cylinder]:
    """Circles fitted algebraically across the likely axes."""
    axes = [known]
    if known is None:
        axes = [*np.linalg.svd(touches.position, full_matrices=False)[2], *np.eye(3)]
        if touches.normal is not None:
            axes.append(np.linalg.svd(touches.normal, full_matrices=False)[2][-1])
    weight = touches.weights()
    root = np.sqrt(weight)
    starts = []
    for axis in axes:
        assert axis is not None
        sideways = np.eye(3)[int(np.argmin(np.abs(axis)))]
        unit = _Cylinder.about(np.zeros(3), axis, 1.0, sideways, count)
        xy = touches.position @ unit.across.T
        # |xy|² = 2 c·xy + (R² − c²)
        system = np.column_stack([2.0 * xy, np.ones(len(xy))]) * root[:, None]
        solution = np.linalg.lstsq(system, (xy**2).sum(axis=1) * root, rcond=None)[0]
        center = solution[:2]
        size = np.sqrt(max(float(solution[2] + center @ center), 1e-12))
        radius = size - float(np.average(touches.whisker_radius, weights=weight))
        starts.append(
            _Cylinder.about(center @ unit.across, axis, max(radius, 1e-3 * size), sideways, count)
        )
    return starts
