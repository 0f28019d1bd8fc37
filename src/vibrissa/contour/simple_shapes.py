"""Plane, sphere and cylinder as parametric shapes that can be fitted to contacts.

With p a contact's point on the whisker's centreline, n the surface's outward normal there and ρ the
whisker's radius, the equations of contacts with normals are

    cylinder (q the part of p − c normal to the axis a through c):  q = (R + ρ) n,  n · a = 0,
    sphere (centre c):  p − c = (R + ρ) n,
    plane (normal N, height h):  N · p = h + ρ,  n · t = 0 for both t normal to N.

Normals that count as exact are first projected normal to a cylinder's axis, and contain no
information on its direction; for a plane they only determine on which side the whisker is.

During a fit lengths are in units of the points' extent. The shape moves by steps in a frame: two
unit vectors (2, 3) normal to its direction, which the fit updates smoothly.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contour.fitted_shape import DIRECTION, FLOOR, Checked, FittedShape, Touches
from vibrissa.numerics import Array, cross

# Smallest initial radius, over that of the surface on which the points are.
_SMALLEST = 1e-3
_TINY = 1e-12  # smallest initial squared radius, over the extent squared


def _spiral_directions(number: int) -> Array:
    """Directions (n, 3) spread evenly over a hemisphere, along a spiral of golden angles."""
    height = (np.arange(number) + 0.5) / number
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(number)
    across = np.sqrt(1.0 - height**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), height])


# Candidate axes, and number of those to which circles fit best from which a fit starts: the axis of
# few points on a short arc is along none of their principal directions.
_AXES, _MOST_AXES = _spiral_directions(64), 6


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SimpleShape(FittedShape):
    """A shape with few parameters."""

    origin: Array

    steps: ClassVar[int]
    """Number of free steps."""

    @classmethod
    @abstractmethod
    def starts(cls, given: Checked, known: ArrayLike | None) -> list[tuple[Self, Array]]:
        """Initial shapes for a fit, and the direction of their frame's first vector.

        ``known`` is a cylinder's axis, or a point on a plane's free side.
        """

    @property
    def direction(self) -> Array:
        """Unit vector (3,) to which the frame is normal; arbitrary for a shape without one."""
        return np.array([0.0, 0.0, 1.0])

    @property
    def size(self) -> float:
        """Length with which a point's scatter is compared; must be positive."""
        return 1.0

    @abstractmethod
    def moved(self, step: Array, frame: Array) -> Self:
        """Shape after a step; a smooth function, so that it can be differentiated numerically."""

    @abstractmethod
    def step_slopes(self, frame: Array) -> Array:
        """Derivatives (parameters, steps) of the parameters by a step."""

    @abstractmethod
    def misses(self, touches: Touches, frame: Array) -> tuple[Array, Array]:
        """Residuals (n, m) of contacts with normals, and their derivatives (n, m, 3 or 6)."""

    def relevant(self, frame: Array) -> Array:
        """Directions (k, 3) along which the scatter of a point matters."""
        return np.eye(3)

    def arranged(self) -> Self:
        """The same shape in standard form."""
        return self

    def gaps(self, touches: Touches) -> Array:
        """Distances (n,) of the whisker's surface from the shape's."""
        return np.asarray(self._distance(touches.position) - touches.whisker_radius)

    def local(self, touches: Touches) -> tuple[Array, Array]:
        """Normals (n, 3) at the points and their derivatives (n, 3, 3)."""
        points = touches.position
        return self._normals(points), self._curvature(points, touches.whisker_radius)

    def scaled(self, given: Checked) -> Self:
        """The same shape in the frame and unit in which the points are fitted."""
        shift = replace(self, origin=self.origin - given.mean)
        return replace(shift, **shift._lengths(1.0 / given.extent))

    def in_metres(self, given: Checked, **statistics: Any) -> Self:
        """The same shape in the frame and unit of the points, with the statistics of its fit."""
        lengths = self._lengths(given.extent)
        lengths["origin"] = given.mean + lengths["origin"]
        return replace(self, **lengths, **statistics)

    def _lengths(self, factor: float) -> dict[str, Any]:
        """Lengths among the fields, multiplied by a factor."""
        return {
            name: factor * getattr(self, name)
            for name, quantity in self.fields.items()
            if quantity != DIRECTION
        }


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class RoundShape(SimpleShape):
    """A shape whose surface is at constant distance from a centre, an axis or a point."""

    radius: float

    @abstractmethod
    def _away(self, points: Array) -> Array:
        """Vectors (..., 3) from the centre to points."""

    @property
    def size(self) -> float:
        """Radius of the surface."""
        return self.radius

    @property
    def diameter(self) -> float:
        """Diameter of the surface, m."""
        return 2.0 * self.radius

    @property
    def diameter_sigma(self) -> float:
        """Standard deviation of the diameter, m."""
        return 2.0 * self.sigma["radius"]

    @property
    def origin_sigma(self) -> Array:
        """Standard deviations (3,) of the coordinates of the origin, m."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    def _distance(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(self._away(points), axis=-1) - self.radius)

    def _normals(self, points: Array) -> Array:
        away = self._away(points)
        size = np.linalg.norm(away, axis=-1, keepdims=True)
        return np.asarray(away / np.where(size > 0.0, size, 1.0))

    def _far(self, height: Array | float) -> Array:
        """Distances (..., 1, 1) from the centre at a height above the surface."""
        far = np.maximum(np.abs(self.radius + np.asarray(height)), FLOOR)
        return np.asarray(far[..., None, None])


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Cylinder(RoundShape):
    """A cylinder."""

    axis: Array

    kind: ClassVar[str] = "cylinder"
    fields: ClassVar[dict[str, str]] = {
        "origin": "object_position",
        "axis": "object_axis",
        "radius": "object_radius",
    }
    steps: ClassVar[int] = 5
    """Two of the origin, one of the radius, two of the axis, which are omitted if it is known."""

    @classmethod
    def starts(cls, given: Checked, known: ArrayLike | None) -> list[tuple[Self, Array]]:
        """Circles fitted algebraically normal to the likely axes."""
        touches = given.touches
        axes = [np.asarray(known, dtype=np.float64)]
        if known is None:
            axes = [*np.linalg.svd(touches.position, full_matrices=False)[2], *np.eye(3)]
            if touches.normal is not None:
                axes.append(np.linalg.svd(touches.normal, full_matrices=False)[2][-1])
        weight = touches.weights()
        whisker = float(np.average(touches.whisker_radius, weights=weight))

        def around(axis: Array) -> tuple[Self, Array]:
            axis = axis / np.linalg.norm(axis)
            sideways = np.eye(3)[int(np.argmin(np.abs(axis)))]
            frame = frame_across(axis, sideways)
            center, size = _fit_algebraically(touches.position @ frame.T, weight)
            radius = max(size - whisker, _SMALLEST * size)
            return cls(origin=center @ frame, axis=axis, radius=radius), sideways

        shapes: list[tuple[Self, Array]] = [around(axis) for axis in axes]
        if known is None:
            others: list[tuple[Self, Array]] = [around(axis) for axis in _AXES]
            missed = [np.median(np.abs(shape.gaps(touches))) for shape, _ in others]
            shapes += [others[i] for i in np.argsort(missed)[:_MOST_AXES]]
        return shapes

    @property
    def direction(self) -> Array:
        """Direction of the axis."""
        return self.axis

    def moved(self, step: Array, frame: Array) -> Self:
        """See `SimpleShape.moved`."""
        axis = self.axis + step[3:] @ frame[: len(step) - 3]
        return type(self)(
            origin=self.origin + step[:2] @ frame,
            axis=axis / np.linalg.norm(axis),
            radius=self.radius + float(step[2]),
        )

    def step_slopes(self, frame: Array) -> Array:
        """See `SimpleShape.step_slopes`."""
        slopes = np.zeros((7, 5))
        slopes[:3, :2] = slopes[3:6, 3:] = frame.T
        slopes[6, 2] = 1.0
        return slopes

    def misses(self, touches: Touches, frame: Array) -> tuple[Array, Array]:
        """See `SimpleShape.misses`."""
        assert touches.normal is not None
        far = (self.radius + touches.whisker_radius)[:, None]
        q = (touches.position - self.origin) @ frame.T
        normal = touches.normal @ frame.T
        n = len(q)
        # A normal along the axis has no direction across it.
        along = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), FLOOR)
        if not touches.joint:
            return q - far * along, np.broadcast_to(frame, (n, 2, 3))
        by = np.zeros((n, 3, 6))
        by[:, :2, :3] = frame
        # A turned normal moves along the chord of an arc, whose radial component is half of that of
        # the arc's tangent.
        chord = np.eye(2) - 0.5 * along[:, :, None] * along[:, None, :]
        by[:, :2, 3:] = -far[..., None] * (chord @ frame)
        by[:, 2, 3:] = self.axis
        return np.column_stack([q - far * normal, touches.normal @ self.axis]), by

    def relevant(self, frame: Array) -> Array:
        """See `SimpleShape.relevant`: the directions normal to the axis."""
        return frame

    def arranged(self) -> Self:
        """The same cylinder with its origin at the height of the mean, and its axis upward."""
        origin = self.origin - (self.origin @ self.axis) * self.axis
        return replace(self, origin=origin, axis=_upward(self.axis))

    def _away(self, points: Array) -> Array:
        away = points - self.origin
        return np.asarray(away - (away @ self.axis)[..., None] * self.axis)

    def _curvature(self, points: Array, height: Array | float = 0.0) -> Array:
        tangent = np.cross(self.axis, self._normals(points))
        return np.asarray(tangent[..., :, None] * tangent[..., None, :] / self._far(height))

    def _slopes(self, points: Array) -> Array:
        normal = self._normals(points)
        along = ((points - self.origin) @ self.axis)[..., None]
        return np.concatenate([-normal, -along * normal, -np.ones_like(along)], axis=-1)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Sphere(RoundShape):
    """A sphere."""

    kind: ClassVar[str] = "sphere"
    fields: ClassVar[dict[str, str]] = {"origin": "object_position", "radius": "object_radius"}
    steps: ClassVar[int] = 4
    """Three of the origin, one of the radius."""

    @classmethod
    def starts(cls, given: Checked, known: ArrayLike | None) -> list[tuple[Self, Array]]:
        """Spheres fitted algebraically to the points, and linearly to points and normals."""
        touches = given.touches
        p, n, weight = touches.position, len(touches.position), touches.weights()
        whisker = float(np.average(touches.whisker_radius, weights=weight))
        center, size = _fit_algebraically(p, weight)
        any_ = np.array([1.0, 0.0, 0.0])
        shapes = [(cls(origin=center, radius=max(size - whisker, _SMALLEST * size)), any_)]
        if touches.normal is not None:
            # p = c + (R + ρ) n
            normal = touches.normal[:, :, None]
            system = np.concatenate([np.broadcast_to(np.eye(3), (n, 3, 3)), normal], axis=2)
            right = p - touches.whisker_radius[:, None] * touches.normal
            root = np.sqrt(weight)
            solution = np.linalg.lstsq(
                (system * root[:, None, None]).reshape(-1, 4),
                (right * root[:, None]).reshape(-1),
                rcond=None,
            )[0]
            radius = max(float(solution[3]), _SMALLEST)
            shapes.append((cls(origin=solution[:3], radius=radius), any_))
        return shapes

    def moved(self, step: Array, frame: Array) -> Self:
        """See `SimpleShape.moved`."""
        return type(self)(origin=self.origin + step[:3], radius=self.radius + float(step[3]))

    def step_slopes(self, frame: Array) -> Array:
        """See `SimpleShape.step_slopes`."""
        return np.eye(4)

    def misses(self, touches: Touches, frame: Array) -> tuple[Array, Array]:
        """See `SimpleShape.misses`."""
        assert touches.normal is not None
        far = self.radius + touches.whisker_radius
        by = np.zeros((len(far), 3, 6))
        by[:, :, :3] = np.eye(3)
        by[:, :, 3:] = -far[:, None, None] * np.eye(3)
        miss = touches.position - self.origin - far[:, None] * touches.normal
        return miss, by if touches.joint else by[:, :, :3]

    def _away(self, points: Array) -> Array:
        return np.asarray(points - self.origin)

    def _curvature(self, points: Array, height: Array | float = 0.0) -> Array:
        normal = self._normals(points)
        flat = np.eye(3) - normal[..., :, None] * normal[..., None, :]
        return np.asarray(flat / self._far(height))

    def _slopes(self, points: Array) -> Array:
        normal = self._normals(points)
        return np.concatenate([-normal, -np.ones((*normal.shape[:-1], 1))], axis=-1)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Plane(SimpleShape):
    """A plane."""

    normal: Array

    kind: ClassVar[str] = "plane"
    fields: ClassVar[dict[str, str]] = {"origin": "object_position", "normal": "object_axis"}
    steps: ClassVar[int] = 3
    """One of the height, two of the normal."""

    @classmethod
    def starts(cls, given: Checked, known: ArrayLike | None) -> list[tuple[Self, Array]]:
        """The plane normal to which the points scatter least, facing the free side."""
        touches = given.touches
        weight = touches.weights()[:, None]
        middle = (weight * touches.position).sum(axis=0) / weight.sum()
        spread = (touches.position - middle) * np.sqrt(weight)
        widest, _, normal = np.linalg.svd(spread, full_matrices=False)[2]
        if touches.normal is not None:
            side = float(np.median(touches.normal @ normal))
        elif known is not None:
            outside = np.asarray(known, dtype=np.float64)
            side = float((outside - given.mean) / given.extent @ normal)
        else:
            side = float(normal @ _upward(normal))
        normal = normal if side >= 0.0 else -normal
        height = middle @ normal - np.average(touches.whisker_radius, weights=weight[:, 0])
        return [(cls(origin=height * normal, normal=normal), widest)]

    @property
    def direction(self) -> Array:
        """The plane's normal."""
        return self.normal

    def moved(self, step: Array, frame: Array) -> Self:
        """See `SimpleShape.moved`."""
        normal = self.normal + step[1:] @ frame
        normal = normal / np.linalg.norm(normal)
        height = self.origin @ self.normal + float(step[0])
        return type(self)(origin=height * normal, normal=normal)

    def step_slopes(self, frame: Array) -> Array:
        """See `SimpleShape.step_slopes`: the origin is at the height along the normal."""
        slopes = np.zeros((6, 3))
        slopes[:3, 0] = self.normal
        slopes[:3, 1:] = (self.origin @ self.normal) * frame.T
        slopes[3:, 1:] = frame.T
        return slopes

    def misses(self, touches: Touches, frame: Array) -> tuple[Array, Array]:
        """See `SimpleShape.misses`."""
        gap, n = self.gaps(touches)[:, None], len(touches.position)
        if not touches.joint:
            return gap, np.broadcast_to(self.normal, (n, 1, 3))
        assert touches.normal is not None
        by = np.zeros((n, 3, 6))
        by[:, 0, :3] = self.normal
        by[:, 1:, 3:] = frame
        return np.column_stack([gap, touches.normal @ frame.T]), by

    def _distance(self, points: Array) -> Array:
        return np.asarray((points - self.origin) @ self.normal)

    def _normals(self, points: Array) -> Array:
        return np.broadcast_to(self.normal, np.shape(points))

    def _curvature(self, points: Array, height: Array | float = 0.0) -> Array:
        return np.zeros((*points.shape, 3))

    def _slopes(self, points: Array) -> Array:
        return np.concatenate([-self._normals(points), points - self.origin], axis=-1)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class CylinderFit(Cylinder):
    """A fitted cylinder, in the frame of the points.

    Attributes
    ----------
    origin : array (3,)
        Point on the axis at the height of the points' mean, m.
    axis : array (3,)
        Unit vector along the axis; its largest component is positive.
    radius : float
        Radius of the surface, m.
    covariance : array (7, 7)
        Covariance of (origin, axis, radius), m and 1; of rank 5, or 3 if the axis was given.
    """


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SphereFit(Sphere):
    """A fitted sphere, in the frame of the points.

    Attributes
    ----------
    origin : array (3,)
        Centre, m.
    radius : float
        Radius of the surface, m.
    covariance : array (4, 4)
        Covariance of (origin, radius), m².
    """


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PlaneFit(Plane):
    """A fitted plane, in the frame of the points.

    Attributes
    ----------
    origin : array (3,)
        Point of the plane closest to the points' mean, m.
    normal : array (3,)
        Outward unit vector, toward the whisker.
    covariance : array (6, 6)
        Covariance of (origin, normal), m and 1; of rank 3.
    """


# Shapes by kind, simpler ones first.
SHAPES: dict[str, type[SimpleShape]] = {
    shape.kind: shape for shape in (PlaneFit, SphereFit, CylinderFit)
}


def frame_across(direction: Array, toward: Array | None = None) -> Array:
    """Two unit vectors (..., 2, 3) normal to directions, the first closest to ``toward``."""
    if toward is None:
        toward = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=-1)])
    along = (toward * direction).sum(axis=-1, keepdims=True)
    first = toward - along * direction
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, cross(direction, first)], axis=-2)


def _upward(direction: Array) -> Array:
    """The direction or its opposite, such that its largest component is positive."""
    return np.asarray(direction * np.sign(direction[np.argmax(np.abs(direction))]))


def _fit_algebraically(points: Array, weight: Array) -> tuple[Array, float]:
    """Centre and radius of a circle or sphere, fitted algebraically to points (n, 2 or 3)."""
    root = np.sqrt(weight)
    # |x|² = 2 c·x + (R² − c²)
    system = np.column_stack([2.0 * points, np.ones(len(points))]) * root[:, None]
    solution = np.linalg.lstsq(system, (points**2).sum(axis=1) * root, rcond=None)[0]
    center = solution[:-1]
    return center, float(np.sqrt(max(float(solution[-1] + center @ center), _TINY)))
