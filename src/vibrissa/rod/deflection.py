"""Loads that bend a whisker (any number at once), and the resulting deflections."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import xr
from vibrissa.numerics import Array, IntArray, numbers, vectors
from vibrissa.quantities import attributes
from vibrissa.rod.discretization import STEPS, discretize
from vibrissa.rod.gravity import evaluated, resting, trace
from vibrissa.rod.integration import solve_forces
from vibrissa.rod.outward import shapes
from vibrissa.sketch import (
    BENT,
    CONTACT,
    MOST_CURVES,
    REST,
    Mark,
    card,
    lines,
    shown,
    thinned,
    views,
)
from vibrissa.status import Status, counted, describe, flag_attributes

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

_MOST_TURNS = 4.0 * np.pi  # largest plausible direction, rad


def finite_vectors(name: str, value: ArrayLike) -> Array:
    """Return ``value`` as float64 (..., 3); raise a ValueError that states what is wrong."""
    return _numbers(name, value, vector=True)


def _numbers(name: str, value: ArrayLike, vector: bool) -> Array:
    """Return float64, (..., 3) for vectors; raise a ValueError that states what is wrong."""
    array = (vectors if vector else numbers)(name, value).copy()  # the caller may change theirs
    if np.isinf(array).any():
        raise ValueError(
            f"{name} has {int(np.isinf(array).sum())} infinite values; NaN means missing"
        )
    return array


def _directions(vectors: Array) -> Array:
    """Unit vectors, without overflow or underflow; (0, 0, 0) is unchanged."""
    largest = np.abs(vectors).max(axis=-1, keepdims=True)
    scaled = vectors / np.where(largest > 0.0, largest, 1.0)
    length = np.linalg.norm(scaled, axis=-1, keepdims=True)
    return np.asarray(scaled / np.where(length > 0.0, length, 1.0))


def _broadcast(**shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Common leading shape; raise a ValueError that lists the shapes if they do not broadcast."""
    try:
        return np.broadcast_shapes(*shapes.values())
    except ValueError as error:
        listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(f"leading shapes do not broadcast: {listed}") from error


@dataclass(frozen=True, eq=False)
class PointForce:
    """A given force at a given arc length.

    The equilibrium returned is the one that grows continuously from rest with the force, of which
    there is always exactly one. It need not be stable for an object at that position: the whisker
    may slip off. Only a force that winds the whisker up in waves too short to resolve gets a
    failure status instead.

    Parameters
    ----------
    arc_length : array_like
        Arc length s_c of the contact from the base, m, shape (...).
    magnitude : array_like, optional
        Size of a force normal to the whisker, N, shape (...).
    direction : array_like, optional
        Angle of the force from d1 toward d2 in the deflected material frame at the contact, rad,
        shape (...).
    components : tuple of array_like or array_like, optional
        Force (fx, fy, fz) in that frame instead, N, a tuple of three or shape (..., 3); fx along
        the tangent.

    Raises
    ------
    ValueError
        If shapes do not broadcast, if arc lengths are not positive, if a direction is more than two
        turns, or if neither or both ways of giving the force are used.
    """

    arc_length: Any
    magnitude: Any = None
    direction: Any = None
    components: Any = None

    def __post_init__(self) -> None:
        polar = self.magnitude is not None and self.direction is not None
        if polar == (self.components is not None) or (self.magnitude is None) != (
            self.direction is None
        ):
            raise ValueError(
                "give a PointForce either magnitude and direction, or components=(fx, fy, fz)"
            )
        s = _numbers("arc_length", self.arc_length, vector=False)
        if polar:
            size = _numbers("magnitude", self.magnitude, vector=False)
            angle = _numbers("direction", self.direction, vector=False)
            if (np.abs(angle) > _MOST_TURNS).any():
                raise ValueError(
                    f"direction is an angle in rad; got {np.nanmax(np.abs(angle)):g}, which looks "
                    "like degrees"
                )
            _broadcast(arc_length=s.shape, magnitude=size.shape, direction=angle.shape)
            across = size * np.cos(angle), size * np.sin(angle)
            force = np.stack(np.broadcast_arrays(0.0 * across[0], *across), axis=-1)
        else:
            parts = self.components
            if isinstance(parts, tuple):
                if len(parts) != 3:
                    raise ValueError(f"components must be (fx, fy, fz); got {len(parts)} of them")
                parts = np.stack(
                    np.broadcast_arrays(*(_numbers("components", p, vector=False) for p in parts)),
                    axis=-1,
                )
            force = _numbers("components", parts, vector=True)
        shape = _broadcast(arc_length=s.shape, force=force.shape[:-1])
        if (s <= 0.0).any():
            raise ValueError(
                f"arc_length must be positive (m from the base); the smallest is {np.nanmin(s)}"
            )
        object.__setattr__(self, "arc_length", np.broadcast_to(s, shape))
        object.__setattr__(self, "components", np.broadcast_to(force, (*shape, 3)))

    @property
    def shape(self) -> tuple[int, ...]:
        """Leading shape of the loads."""
        return tuple(np.shape(self.arc_length))


@dataclass(frozen=True, eq=False)
class PointContact:
    """A frictionless contact at a given point of the whisker's centreline.

    Parameters
    ----------
    points : array_like
        Contact points in the whisker frame, m, shape (..., 3); NaN or masked means missing.
    """

    points: Any

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _numbers("points", self.points, vector=True))

    @property
    def shape(self) -> tuple[int, ...]:
        """Leading shape of the loads."""
        return tuple(np.shape(self.points)[:-1])


@dataclass(frozen=True, eq=False)
class PegContact:
    """A frictionless contact with a straight peg.

    With radius zero the peg is a line that the whisker's centreline intersects. Otherwise it is a
    solid cylinder and the surfaces touch: the distance of the centreline from the peg's axis is the
    peg's radius plus the whisker's at the contact.

    Parameters
    ----------
    origin : array_like
        Point of the peg's axis in the whisker frame, m, shape (..., 3).
    axis : array_like
        Direction of the axis, any length but zero, shape (..., 3).
    radius : array_like
        Radius, m, shape (...); 0 for a line.
    side : array_like, optional
        Approximate direction of the force on the whisker, which determines on which side of the
        peg the whisker is, shape (..., 3). By default a line pushes away from the point of the
        resting whisker that is nearest to it, and a cylinder pushes the whisker out on the nearest
        side.
    start : Deflection, optional
        Earlier deflection by the same peg at another position, from which the solution is
        continued: the contact stays on its side, and slides or slips off as the peg moves. Where
        ``start`` has no contact, the whisker stays on the side of the peg where it was.

    Raises
    ------
    ValueError
        If shapes are wrong or do not broadcast, an axis is zero, a radius is negative, lines and
        cylinders are mixed, or both ``side`` and ``start`` are given.
    """

    origin: Any
    axis: Any
    radius: Any = 0.0
    side: Any = None
    start: Deflection | None = None

    def __post_init__(self) -> None:
        origin = _numbers("origin", self.origin, vector=True)
        axis = _numbers("axis", self.axis, vector=True)
        radius = _numbers("radius", self.radius, vector=False)
        shapes = {"origin": origin.shape[:-1], "axis": axis.shape[:-1], "radius": radius.shape}
        if (radius < 0.0).any():
            raise ValueError(
                f"a peg's radius must not be negative; the smallest is {np.nanmin(radius)} m"
            )
        if len(set((radius == 0.0).flat)) > 1:
            raise ValueError(
                "lines (radius 0) and cylinders cannot be mixed in one load: use two loads"
            )
        axis = _directions(axis)
        if (axis == 0.0).all(axis=-1).any():
            raise ValueError("a peg's axis must not be (0, 0, 0)")
        if self.side is not None and self.start is not None:
            raise ValueError("give a PegContact either side or start: start already fixes the side")
        if self.side is not None:
            side = _directions(_numbers("side", self.side, vector=True))
            shapes["side"] = side.shape[:-1]
            toward, along = np.broadcast_arrays(side, axis)
            across = np.cross(toward, along)
            if (np.linalg.norm(across, axis=-1) <= 1e-9).any():
                raise ValueError("side must not be (0, 0, 0) or along the peg's axis")
        if self.start is not None:
            if not isinstance(getattr(self.start, "load", None), PegContact):
                got = type(getattr(self.start, "load", self.start)).__name__
                raise ValueError(f"start must be a deflection by a PegContact; got one by {got}")
            shapes["start"] = self.start.status.shape
        shape = _broadcast(**shapes)
        object.__setattr__(self, "origin", np.broadcast_to(origin, (*shape, 3)))
        object.__setattr__(self, "axis", np.broadcast_to(axis, (*shape, 3)))
        object.__setattr__(self, "radius", np.broadcast_to(radius, shape))
        if self.side is not None:
            object.__setattr__(self, "side", np.broadcast_to(side, (*shape, 3)))

    @property
    def shape(self) -> tuple[int, ...]:
        """Leading shape of the loads."""
        return tuple(np.shape(self.radius))


Load = PointForce | PointContact | PegContact


def select_loads(load: Load, which: IntArray) -> Load:
    """Loads of flat indices ``which`` (n,)."""
    if isinstance(load, PointContact):
        return PointContact(np.reshape(load.points, (-1, 3))[which])
    if isinstance(load, PointForce):
        parts = np.reshape(load.components, (-1, 3))[which]
        return PointForce(np.reshape(load.arc_length, -1)[which], components=parts)
    if load.start is not None:
        raise ValueError("pegs with a start must all have the same gravity")
    side = None if load.side is None else np.reshape(load.side, (-1, 3))[which]
    origin, axis = (np.reshape(a, (-1, 3))[which] for a in (load.origin, load.axis))
    return PegContact(origin, axis, np.reshape(load.radius, -1)[which], side)


@dataclass(frozen=True, eq=False)
class Deflection:
    """Deflected whiskers, one for each load; all vectors are in the whisker frame.

    Attributes
    ----------
    whisker : Whisker
        Whisker that is bent.
    load : PointForce, PointContact or PegContact
        Load that bends it.
    force : (..., 3) array
        Force of the object on the whisker, N; zero without contact, NaN where unsolved.
    moment : (..., 3) array
        Moment about the base, N·m: contact_point × force, plus with gravity the change of the
        weight's moment since rest, as read by a sensor that was tared at rest.
    contact_point : (..., 3) array
        Contact point on the centreline, m; NaN without contact or where unsolved.
    arc_length : (...) array
        Arc length of the contact from the base, m.
    contact_force : (..., 3) array
        Force in the material frame at the contact (tangent, d1, d2), N.
    residual : (...) array
        Residual of the load's equations: lengths over L, directions; 0 for a PointForce.
    status : (...) int array
        :class:`~vibrissa.Status` of each load.
    steps : int
        Integration steps along the whisker.
    gravity : (..., 3) array or None
        Gravity of each load, whisker frame, m/s²; None if weight is neglected.
    """

    whisker: Whisker
    load: Load
    force: Array
    moment: Array
    contact_point: Array
    arc_length: Array
    contact_force: Array
    residual: Array
    status: IntArray
    steps: int = field(default=STEPS, repr=False)
    gravity: Array | None = None
    # Steps needed by each load, where some need more than ``steps``.
    _needed: IntArray | None = field(default=None, repr=False)

    def to_dataset(self) -> xr.Dataset:
        """Return the results as a dataset.

        Returns
        -------
        Dataset
            ``force``, ``moment``, ``contact_point``, ``arc_length``, ``residual`` and ``status``;
            leading dimensions are called ``load``, or ``load_0``, ``load_1``, ... if several.
        """
        count = self.status.ndim
        dims = ("load",) if count == 1 else tuple(f"load_{i}" for i in range(count))
        data: dict[str, Any] = {
            name: ((*dims, "space"), getattr(self, name), attributes(name))
            for name in ("force", "moment", "contact_point")
        } | {
            name: (dims, getattr(self, name), attributes(name))
            for name in ("arc_length", "residual")
        }
        data["status"] = (dims, self.status, {**attributes("status"), **flag_attributes()})
        return xr.Dataset(data, {"space": list("xyz")})

    def centerline(self, n: int = 100) -> Array:
        """Return the deflected centrelines.

        Parameters
        ----------
        n : int
            Number of points along the whisker, equally spaced in arc length from base to tip.

        Returns
        -------
        (..., n, 3) array
            Points, m; the resting whisker where there is no contact, NaN where unsolved.
        """
        if n < 2:
            raise ValueError(f"a centreline needs at least 2 points; got n={n}")
        rows = np.arange(self.status.size)
        return self._centerlines(rows, n).reshape(*self.status.shape, n, 3)

    def _centerlines(self, rows: IntArray, n: int) -> Array:
        """Centrelines (rows, n, 3) of the loads of these flat indices."""
        d = discretize(self.whisker, self.steps)
        needed = np.full(rows.size, self.steps) if self._needed is None else self._needed[rows]
        values = np.concatenate([self.force / d.force, self.contact_point / d.length], axis=-1)
        values = values.reshape(-1, 6)[rows]
        arc = self.arc_length.reshape(-1)[rows] / d.length
        free = np.flatnonzero(self.status.reshape(-1)[rows] == Status.NO_CONTACT)
        values[free, 3:], arc[free] = 0.0, 0.0
        if self.gravity is not None:
            force = np.nan_to_num(self.contact_force.reshape(-1, 3)[rows] / d.force)
            contacts = np.concatenate([arc[:, None], force], axis=1)
            return self._weighted_centerlines(rows, contacts, needed, n)
        # All whiskers without contact have the same centreline: it is computed for the first only.
        own = np.delete(np.arange(arc.size), free[1:])
        places = np.empty((arc.size, n, 3))
        for steps in np.unique(needed[own]):
            which, finer = own[needed[own] == steps], discretize(self.whisker, int(steps))
            line = shapes(finer, values[which], arc[which], np.linspace(0.0, 1.0, n))
            places[which] = line * d.length
        places[free[1:]] = places[free[:1]]
        return places

    def _weighted_centerlines(
        self, rows: IntArray, contacts: Array, needed: IntArray, n: int
    ) -> Array:
        assert self.gravity is not None
        gravity, places = self.gravity.reshape(-1, 3)[rows], np.full((rows.size, n, 3), np.nan)
        s = np.linspace(0.0, 1.0, n)
        for i in np.flatnonzero(np.isfinite(contacts[:, 0])):
            d = discretize(resting(self.whisker, gravity[i]), int(needed[i]))
            if d.rod.weight is None:
                values = solve_forces(d, contacts[i : i + 1])[0]
                places[i] = shapes(d, values, contacts[i : i + 1, 0], s)[0] * d.length
                continue
            lean = evaluated(d, contacts[i : i + 1]).leans[0]
            places[i] = trace(d, contacts[i], lean, s).places * d.length
        return places

    def __repr__(self) -> str:
        return f"<{self._title()}: {counted(self.status)}>"

    def _repr_html_(self) -> str:
        """Picture of the bent whiskers, the resting one and the contacts, with the numbers."""
        rest = Mark(self.whisker.centerline(41), REST, label="at rest")
        bent = self._centerlines(thinned(np.arange(self.status.size), MOST_CURVES), 41)
        picture = views(
            [
                rest,
                Mark(bent, BENT, label="bent"),
                Mark(self.contact_point, CONTACT, dots=True, width=4.0, label="contact"),
            ]
        )
        return card(self._title(), self._rows(), picture)

    def __str__(self) -> str:
        return lines(self._title(), self._rows())

    def _title(self) -> str:
        return f"Deflection of {self.status.shape or 'one'} by {type(self.load).__name__}"

    def _rows(self) -> list[tuple[str, str]]:
        """Labels and values of status, contact, force and moment; one load's status in words."""
        size = np.linalg.norm
        status = counted(self.status)
        if self.status.size == 1:
            status = next(iter(describe(self.status)))
        return [
            ("status", status),
            ("contact, distance from base", shown("r", size(self.contact_point, axis=-1))),
            ("contact, arc length", shown("arc_length", self.arc_length)),
            ("force", shown("force", size(self.force, axis=-1))),
            ("moment", shown("moment", size(self.moment, axis=-1))),
        ]
