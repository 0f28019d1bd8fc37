"""Solids of simple shape (pegs, spheres, planes, boxes), and all objects as datasets.

Each is a `vibrissa.objects.Surface` with closed forms of its signed distance d (negative inside),
the gradient of d, which is the outward normal n, and ∂n/∂x. Solids may be compliant: under a force
N the surface is displaced by N over its stiffness, locally and along the normal, and keeps its
shape elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vibrissa.deferred import xr
from vibrissa.numerics import Array, numbers
from vibrissa.objects.mesh import Mesh
from vibrissa.objects.surface import Surface
from vibrissa.quantities import attributes
from vibrissa.whisker import ORTHOGONALITY


class _Faults:
    """Collector of the faults in the parameters of one object."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._faults: list[str] = []

    def vector(self, name: str, value: Any, direction: bool = False) -> Array:
        """Check a vector of three finite numbers, normalise it if a direction; read-only."""
        vector = numbers(name, value).copy()
        if vector.shape != (3,) or not np.isfinite(vector).all():
            self._faults.append(f"{name} is {vector.tolist()}; three finite numbers are needed")
        elif direction:
            size = float(np.linalg.norm(vector))
            if size == 0.0:
                self._faults.append(f"{name} is (0, 0, 0), which is not a direction")
            # A unit vector is not normalised again, so that it is preserved to the last bit.
            elif abs(size - 1.0) > 4.0 * np.finfo(np.float64).eps:
                vector = vector / size
        vector.flags.writeable = False
        return vector

    def positive(self, name: str, value: Any, unit: str, also: str = "") -> float:
        """Check a positive number; ``also`` names another allowed value."""
        if np.ndim(value):
            self._faults.append(f"{name} has shape {np.shape(value)}; one number is needed")
            return np.nan
        number = float(value)
        allowed = number > 0.0 and (np.isfinite(number) or also == "infinite")
        if not (allowed or (also == "zero" and number == 0.0)):
            alternative = f", or {also}" if also else ""
            self._faults.append(
                f"{name} is {number!r}; it must be positive{alternative}, in {unit}"
            )
        return number

    def check(self, ok: bool, fault: str) -> None:
        """Add a fault if a condition does not hold."""
        if not ok:
            self._faults.append(fault)

    def raise_if_any(self) -> None:
        """Raise a ValueError with all faults, if there are any."""
        if self._faults:
            raise ValueError(f"no {self._what}: " + "; ".join(self._faults))


def _set_fields(thing: Any, faults: _Faults, **values: Any) -> None:
    """Check the fields that solids have in common, and set them and other values."""
    # Fields keep their order, so that messages are reproducible.
    for name, given in [(n, g) for n, g in vars(thing).items() if n not in values]:
        if name == "stiffness":
            values[name] = faults.positive(name, given, "N/m", "infinite")
        elif name == "radius":
            values[name] = faults.positive(name, given, "m")
        else:
            values[name] = faults.vector(name, given, direction=name != "origin")
    faults.raise_if_any()
    for name, value in values.items():
        object.__setattr__(thing, name, value)


def _mm(vector: Array) -> str:
    """Format a position in mm."""
    return "(" + ", ".join(f"{x * 1e3:z.3f}" for x in vector) + ") mm"


def _direction(vector: Array) -> str:
    """Format a unit vector."""
    return "(" + ", ".join(f"{x:z.3f}" for x in vector) + ")"


def _stiffness_text(stiffness: float) -> str:
    """Format a finite stiffness."""
    return "" if np.isinf(stiffness) else f", stiffness {stiffness:.3g} N/m"


@dataclass(frozen=True, eq=False)
class Peg(Surface):
    """A solid straight cylinder without ends.

    Parameters
    ----------
    origin : array_like (3,)
        Point on the axis in the laboratory frame, m.
    axis : array_like (3,)
        Direction of the axis in the laboratory frame, of any nonzero length; stored as a unit
        vector.
    radius : float
        Radius of its surface, m.
    stiffness : float
        Force over indentation, N/m; infinite if rigid.

    Examples
    --------
    >>> Peg(origin=[25e-3, 0.0, 0.0], axis=[0.0, 0.0, 1.0], radius=1.35e-3)
    Peg(origin=(25.000, 0.000, 0.000) mm, axis=(0.000, 0.000, 1.000), diameter 2.700 mm)
    """

    origin: Array
    axis: Array
    radius: float
    stiffness: float = np.inf

    def __post_init__(self) -> None:
        _set_fields(self, _Faults("peg"))

    def _distance(self, points: Array) -> Array:
        away = points - self.origin
        along = away @ self.axis
        distance: Array = np.linalg.norm(away - along[..., None] * self.axis, axis=-1) - self.radius
        return distance

    def _geometry(self, point: Array) -> tuple[float, Array, Array]:
        away = point - self.origin
        away = away - (away @ self.axis) * self.axis
        size = float(np.sqrt(away @ away))
        normal = away / size
        flat = np.eye(3) - np.outer(self.axis, self.axis) - np.outer(normal, normal)
        return size - self.radius, normal, flat / size

    def __repr__(self) -> str:
        return (
            f"Peg(origin={_mm(self.origin)}, axis={_direction(self.axis)}, diameter "
            f"{self.radius * 2e3:.3f} mm{_stiffness_text(self.stiffness)})"
        )


@dataclass(frozen=True, eq=False)
class Sphere(Surface):
    """A solid sphere.

    Parameters
    ----------
    origin : array_like (3,)
        Centre in the laboratory frame, m.
    radius : float
        Radius of the surface, m.
    stiffness : float
        Force over indentation, N/m; infinite if rigid.

    Examples
    --------
    >>> Sphere(origin=[25e-3, 0.0, 0.0], radius=5e-3)
    Sphere(origin=(25.000, 0.000, 0.000) mm, diameter 10.000 mm)
    """

    origin: Array
    radius: float
    stiffness: float = np.inf

    def __post_init__(self) -> None:
        _set_fields(self, _Faults("sphere"))

    def _distance(self, points: Array) -> Array:
        return np.asarray(np.linalg.norm(points - self.origin, axis=-1) - self.radius)

    def _geometry(self, point: Array) -> tuple[float, Array, Array]:
        away = point - self.origin
        size = float(np.sqrt(away @ away))
        normal = away / size
        return size - self.radius, normal, (np.eye(3) - np.outer(normal, normal)) / size

    def __repr__(self) -> str:
        return (
            f"Sphere(origin={_mm(self.origin)}, diameter {self.radius * 2e3:.3f} "
            f"mm{_stiffness_text(self.stiffness)})"
        )


@dataclass(frozen=True, eq=False)
class Plane(Surface):
    """A wall: the half-space behind a plane.

    Parameters
    ----------
    origin : array_like (3,)
        Point on the plane in the laboratory frame, m.
    normal : array_like (3,)
        Outward normal, toward the free side, of any nonzero length; stored as a unit vector.
    stiffness : float
        Force over indentation, N/m; infinite if rigid.

    Examples
    --------
    >>> Plane(origin=[0.0, 10e-3, 0.0], normal=[0.0, -1.0, 0.0])
    Plane(origin=(0.000, 10.000, 0.000) mm, normal=(0.000, -1.000, 0.000))
    """

    origin: Array
    normal: Array
    stiffness: float = np.inf

    def __post_init__(self) -> None:
        _set_fields(self, _Faults("plane"))

    def _distance(self, points: Array) -> Array:
        return np.asarray((points - self.origin) @ self.normal)

    def _geometry(self, point: Array) -> tuple[float, Array, Array]:
        return float((point - self.origin) @ self.normal), self.normal, np.zeros((3, 3))

    def __repr__(self) -> str:
        return (
            f"Plane(origin={_mm(self.origin)}, normal={_direction(self.normal)}"
            f"{_stiffness_text(self.stiffness)})"
        )


@dataclass(frozen=True, eq=False)
class Box(Surface):
    """A solid block with sharp or rounded edges.

    Parameters
    ----------
    origin : array_like (3,)
        Centre in the laboratory frame, m.
    size : array_like (3,)
        Lengths of the edges, m.
    rotation : array_like (3, 3)
        Rotation matrix whose columns are the directions of the edges in the laboratory frame.
    edge_radius : float
        Radius of edges and corners, m; 0 if sharp. A whisker contacts a sharp edge with its own
        radius.
    stiffness : float
        Force over indentation, N/m; infinite if rigid. A compliant box needs an edge radius larger
        than its indentation, because a sharp edge has no normal inside.

    Raises
    ------
    ValueError
        If a value is missing, the rotation is invalid, an edge or the stiffness is not positive, or
        the edge radius is more than half of an edge.

    Examples
    --------
    >>> Box(origin=[25e-3, 0.0, 0.0], size=[5e-3, 5e-3, 40e-3])
    Box(origin=(25.000, 0.000, 0.000) mm, size=(5.000, 5.000, 40.000) mm, edge radius 0.000 mm)
    """

    origin: Array
    size: Array
    rotation: Array = field(default_factory=lambda: np.eye(3))
    edge_radius: float = 0.0
    stiffness: float = np.inf

    def __post_init__(self) -> None:
        faults = _Faults("box")
        rotation = np.array(self.rotation, dtype=np.float64)
        turned = rotation.shape == (3, 3) and bool(np.isfinite(rotation).all())
        turned = turned and np.abs(rotation.T @ rotation - np.eye(3)).max() <= ORTHOGONALITY
        faults.check(turned and np.linalg.det(rotation) > 0.0, "rotation is not a rotation matrix")
        rotation.flags.writeable = False
        size = faults.vector("size", self.size)
        edge = faults.positive("edge_radius", self.edge_radius, "m", "zero")
        if size.shape == (3,):
            faults.check(bool((size > 0.0).all()), f"size is {size.tolist()}; it must be positive")
            faults.check(
                bool((2.0 * edge <= size).all()),
                f"edge_radius is {edge}; at most half of the shortest edge, {0.5 * size.min()} m",
            )
        _set_fields(self, faults, size=size, rotation=rotation, edge_radius=edge)

    def _distance(self, points: Array) -> Array:
        beyond = np.abs((points - self.origin) @ self.rotation)
        beyond = beyond - (0.5 * self.size - self.edge_radius)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        return np.asarray(outside + np.minimum(beyond.max(axis=-1), 0.0) - self.edge_radius)

    def _geometry(self, point: Array) -> tuple[float, Array, Array]:
        local = (point - self.origin) @ self.rotation
        beyond = np.abs(local) - (0.5 * self.size - self.edge_radius)
        over = beyond > 0.0
        if over.any():
            size = float(np.linalg.norm(beyond[over]))
            normal = np.where(over, beyond, 0.0) / size * np.sign(local)
            turn = (np.diag(over.astype(np.float64)) - np.outer(normal, normal)) / size
        else:
            face = int(beyond.argmax())
            size = float(beyond[face])
            normal = np.zeros(3)
            normal[face] = np.copysign(1.0, local[face])
            turn = np.zeros((3, 3))
        turned: Array = self.rotation @ turn @ self.rotation.T
        return size - self.edge_radius, self.rotation @ normal, turned

    def __repr__(self) -> str:
        return (
            f"Box(origin={_mm(self.origin)}, size={_mm(self.size)}, edge radius "
            f"{self.edge_radius * 1e3:.3f} mm{_stiffness_text(self.stiffness)})"
        )


# Fields of each kind of object, and names of their variables unless these are object_<field>.
_FIELDS: dict[str, tuple[type, str]] = {
    "peg": (Peg, "origin axis radius stiffness"),
    "sphere": (Sphere, "origin radius stiffness"),
    "plane": (Plane, "origin normal stiffness"),
    "box": (Box, "origin size rotation edge_radius stiffness"),
    "mesh": (Mesh, "vertices faces resolution stiffness"),
}
_NAMES = {"origin": "object_position", "normal": "object_axis"}
_DIMS: dict[str, tuple[str, ...]] = {
    "object_position": ("space",),
    "object_axis": ("space",),
    "object_size": ("object_axes",),
    "object_rotation": ("space", "object_axes"),
    "object_vertices": ("vertex", "space"),
    "object_faces": ("triangle", "corner"),
}


def objects_datasets(objects: Sequence[Surface]) -> dict[str, xr.Dataset]:
    """Convert objects to datasets, by index."""
    return {str(i): _to_dataset(thing) for i, thing in enumerate(objects)}


def _to_dataset(thing: Surface) -> xr.Dataset:
    """Convert an object to a dataset."""
    for kind, (known, fields) in _FIELDS.items():
        if isinstance(thing, known):
            rows = {
                name: xr.Variable(
                    _DIMS.get(name, ()), np.asarray(getattr(thing, field)), attributes(name)
                )
                for field, name in _variables(fields)
            }
            about = {"kind": kind, "reference_frame": "laboratory"}
            return xr.Dataset(rows, {"space": list("xyz")}, about)
    raise ValueError(f"{thing!r} is none of {', '.join(_FIELDS)}, and cannot be written")


def object_from_dataset(dataset: xr.Dataset) -> Surface:
    """Restore an object from its dataset."""
    kind = dataset.attrs.get("kind")
    if kind not in _FIELDS:
        raise ValueError(f"the object is of kind {kind!r}; it must be one of {', '.join(_FIELDS)}")
    known, fields = _FIELDS[kind]
    if missing := sorted({name for _, name in _variables(fields)} - set(dataset.data_vars)):
        raise ValueError(f"a {kind} in a file lacks {', '.join(missing)}")
    restored: Surface = known(**{field: dataset[n].values for field, n in _variables(fields)})
    return restored


def _variables(fields: str) -> list[tuple[str, str]]:
    """Fields of an object, and the names of their variables."""
    return [(field, _NAMES.get(field, f"object_{field}")) for field in fields.split()]
