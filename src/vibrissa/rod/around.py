"""A whisker carried past objects that may touch it in several points, or along an arc.

Placements with one contact are those of :mod:`vibrissa.rod.surfaces`. Where the whisker bent by one
contact reaches into an object elsewhere, all contacts are solved together
(:mod:`vibrissa.rod.obstacles`), from the placement before or from that one contact on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array, IntArray, Mask, rotation_matrices
from vibrissa.objects import Placement, Surface
from vibrissa.rod.deflection import Deflection, vectors
from vibrissa.rod.discretization import discretize
from vibrissa.rod.obstacles import (
    ELEMENTS,
    Equilibrium,
    Grid,
    Obstacles,
    bent_by_one,
    settled,
    solve_at,
    strain_on,
)
from vibrissa.rod.statics import check_objects
from vibrissa.rod.surfaces import Progress, SurfaceDeflection, follow_surfaces
from vibrissa.status import Status, counted

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

#: Overlap from which a second contact counts, m; a tapering whisker along a flat one has less.
OVERLAP = 5e-6
# Points along the whisker at which a second contact is searched, and the distance of one with the
# same object from the first, over L. So many rows at once.
_SAMPLES, _ASIDE, _ROWS = 129, 0.03, 512
_PRESSED = 5e-3  # a whisker that objects do not reach is pressed by so much to begin with, over L
_JUMP = 0.1  # continued from the placement before, no node moves farther, over L


@dataclass(frozen=True, eq=False, repr=False)
class ObstacleDeflection:
    """Whisker against objects, at n placements, with up to k contacts each.

    All in the whisker frame. Contacts are in order from the base; those in a row next to each other
    stand for an arc, along which their forces are spread. What is not there is NaN, or -1.

    Attributes
    ----------
    whisker : Whisker
        Whisker that is bent.
    force, moment : (n, 3) array
        Force and moment at the base, N and N·m; zero without contact, NaN without an answer.
    arc_length : (n, k) array
        Arc lengths of the contacts from the base, m.
    contact_point, contact_force : (n, k, 3) array
        Contacts on the centreline, m, and forces there, N.
    surface : (n, k) int array
        Numbers of the objects that touch there.
    second_contact : (n,) bool array
        Whether one contact alone is not all.
    several : (n,) bool array
        Whether all contacts are solved together, as they are where one is not all.
    overlap : (n,) array
        Depth to which the whisker reaches into an object, m: zero where all contacts are solved.
    status : (n,) int array
        :class:`~vibrissa.Status` of each placement.
    """

    whisker: Whisker
    force: Array
    moment: Array
    arc_length: Array
    contact_point: Array
    contact_force: Array
    surface: IntArray
    second_contact: Mask
    several: Mask
    overlap: Array
    status: IntArray
    _bent: Deflection
    _solved: dict[int, Equilibrium]

    def strongest(self) -> tuple[Array, Array, Array, IntArray]:
        """Return of each placement the contact with the largest force.

        Returns
        -------
        tuple of arrays
            Arc lengths (n,), contact points (n, 3), forces (n, 3), and objects (n,).
        """
        force = np.linalg.norm(self.contact_force, axis=-1)
        rows = np.arange(len(force))
        which = np.where(np.isfinite(force), force, -1.0).argmax(axis=1)
        every = self.arc_length, self.contact_point, self.contact_force
        arc, point, push = (each[rows, which] for each in every)
        return arc, point, push, self.surface[rows, which]

    def centerline(self, n: int = 100) -> Array:
        """Return the deflected centrelines.

        Parameters
        ----------
        n : int
            Number of points along the whisker, equally spaced in arc length from base to tip.

        Returns
        -------
        (..., n, 3) array
            Points, m; the resting whisker where there is no contact, NaN where there is no answer.
        """
        lines = self._bent.centerline(n)
        for row, found in self._solved.items():
            lines[row] = found.centerline(n) * self.whisker.length
        return lines

    def __repr__(self) -> str:
        """Number of placements, and how many have each status."""
        return f"<ObstacleDeflection at {self.status.size} placements: {counted(self.status)}>"


def deflect_around(
    whisker: Whisker,
    objects: Surface | Sequence[Surface],
    base_rotation: ArrayLike | None = None,
    base_position: ArrayLike | None = None,
    *,
    progress: Progress | None = None,
) -> ObstacleDeflection:
    """Deflect a whisker by rigid objects that touch it wherever it meets them, without friction.

    Parameters
    ----------
    whisker : Whisker
        Whisker, without weight.
    objects : Peg, Sphere, Plane, Box, Mesh or a sequence of them
        Objects in the laboratory.
    base_rotation : array_like, optional
        Rotations from the whisker's to the laboratory frame, shape (n, 3, 3) or (3, 3); by default
        the whisker's frame is the laboratory's.
    base_position : array_like, optional
        Positions of the base, laboratory frame, m, shape (n, 3) or (3,); by default the origin.
    progress : callable, optional
        Function called after every placement with the numbers of those done and of all.

    Returns
    -------
    ObstacleDeflection
        Force and moment at the base, and all contacts.

    Raises
    ------
    ValueError
        If shapes do not match or an object is not rigid.

    Notes
    -----
    Placements are passed one after the other. A branch that one contact cannot follow ends with
    that contact, unless the placement before had several. Against an object the force is normal to
    the object: where there are several contacts it leans, on a tapering whisker, from the normal
    of the centreline by the taper, 0.1° for a whisker of a rat.

    Examples
    --------
    A wire lies with its hollow side on a pipe that is bent less than it is:

    >>> wire = Whisker.from_curvature(0.1, lambda s: [0.0, 0.0, 8.0], base_radius=0.2e-3)
    >>> bent = deflect_around(wire, Peg([0.055, 0.14, 0.0], [0.0, 0.0, 1.0], radius=0.14))
    >>> (bent.arc_length[0, [0, 1, -1]] * 1e3).round(1)
    array([ 53.3,  55.2, 100. ])
    """
    solids = _rigid(objects)
    turn = np.eye(3) if base_rotation is None else rotation_matrices("base_rotation", base_rotation)
    move = np.zeros(3) if base_position is None else vectors("base_position", base_position)
    if turn.ndim < 2 or turn.shape[-2] != 3 or turn.ndim > 3 or move.ndim > 2:
        raise ValueError(
            "base_rotation must have shape (n, 3, 3) or (3, 3) and base_position (n, 3) or (3,); "
            f"got {turn.shape} and {move.shape}"
        )
    count = max(len(turn) if turn.ndim == 3 else 1, len(move) if move.ndim == 2 else 1)
    try:
        turn, move = np.broadcast_to(turn, (count, 3, 3)), np.broadcast_to(move, (count, 3))
    except ValueError as error:
        raise ValueError(
            f"{len(turn)} rotations and {len(move)} positions of the base do not match"
        ) from error
    check_objects(whisker, solids, move)
    found = follow_surfaces(whisker, solids, turn, move, progress=progress)
    return around(whisker, solids, turn, move, found)


def _rigid(objects: Surface | Sequence[Surface]) -> list[Surface]:
    solids = list(objects) if isinstance(objects, Sequence) else [objects]
    soft = [repr(solid) for solid in solids if np.isfinite(solid.stiffness)]
    if soft:
        raise ValueError(f"several contacts are solved with rigid objects only; got {soft[0]}")
    return solids


class NearObjects:
    """One whisker near rigid objects that are shifted (3,) in the laboratory, over L."""

    def __init__(
        self, whisker: Whisker, objects: Surface | Sequence[Surface], elements: int = ELEMENTS
    ) -> None:
        self._whisker, self._surfaces = whisker, _rigid(objects)
        self._grid, self._length = Grid.of(whisker, elements), whisker.length

    def reaching(self, place: Placement) -> Array | None:
        """Shift of the objects, none where they touch, toward a whisker that they do not reach."""
        s = np.linspace(0.0, 1.0, _SAMPLES) * self._length
        line, radius = place.outside(self._whisker.position(s)), self._whisker.radius(s)
        gaps = np.array([one.signed_distance(line) - radius for one in self._surfaces])
        which, at = np.unravel_index(np.argmin(gaps), gaps.shape)
        if gaps[which, at] < 0.0:
            return np.zeros(3)
        normal = self._surfaces[which].local_geometry(line[at])[1]
        return np.asarray(normal * (gaps[which, at] / self._length + _PRESSED))

    def from_outside(self, place: Placement, shift: Array) -> Equilibrium | None:
        """Equilibrium that a whisker comes to that rested clear of the objects."""
        there = self._shifted(place, shift)
        turn, move = there.rotation[None], there.position[None]
        found = follow_surfaces(self._whisker, self._surfaces, turn, move)
        if not _touching(found.bent.status)[0]:
            return None
        return _from_one(self._whisker, self._surfaces, there, found, 0, self._grid)

    def moved(
        self, place: Placement, shift: Array, start: Equilibrium, settle: bool = True
    ) -> Equilibrium | None:
        """Equilibrium from another one on; unless it is to settle, nodes stay where they are."""
        obstacles = Obstacles(self._surfaces, self._shifted(place, shift), self._length)
        begin = start.grid, start.strain, start.pressing
        if settle:
            found = settled(self._whisker, obstacles, *begin)
        else:
            found = solve_at(obstacles, *begin)
        if found is None or not found.contacts()[0].size or found.farthest(start) > _JUMP:
            return None
        return found

    def refined(self, place: Placement, shift: Array, start: Equilibrium) -> Equilibrium | None:
        """Equilibrium near one with other nodes."""
        obstacles = Obstacles(self._surfaces, self._shifted(place, shift), self._length)
        strain, pressing = strain_on(start, self._grid), start.pressing_on(self._grid)
        found = settled(self._whisker, obstacles, self._grid, strain, pressing)
        if found is None or not found.contacts()[0].size or found.farthest(start) > _JUMP:
            return None
        return found

    def _shifted(self, place: Placement, shift: Array) -> Placement:
        return Placement(place.rotation, place.position - shift * self._length)


def around(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    found: SurfaceDeflection,
    several: bool = True,
) -> ObstacleDeflection:
    """Solve all contacts of placements at which one contact is not all, or only find these."""
    overlap = overlaps(whisker, surfaces, rotations, positions, found)
    second, solved = overlap > OVERLAP, dict[int, Equilibrium]()
    if several and second.any():
        solved = _solved(whisker, surfaces, rotations, positions, found, overlap)
    bent, d = found.bent, discretize(whisker)
    n, most = len(positions), max([1, *(one.contacts()[0].size for one in solved.values())])
    arc, surface = np.full((n, most), np.nan), np.full((n, most), -1)
    points, forces = np.full((n, most, 3), np.nan), np.full((n, most, 3), np.nan)
    force, moment, status = bent.force.copy(), bent.moment.copy(), bent.status.copy()
    touching = _touching(status)
    arc[touching, 0], surface[touching, 0] = bent.arc_length[touching], found.surface[touching]
    points[touching, 0], forces[touching, 0] = bent.contact_point[touching], bent.force[touching]
    together = np.zeros(n, dtype=bool)
    for row, one in solved.items():
        together[row] = True
        s, which, place, push = one.contacts()
        arc[row], surface[row], points[row], forces[row] = np.nan, -1, np.nan, np.nan
        arc[row, : s.size], surface[row, : s.size] = s * d.length, which
        points[row, : s.size], forces[row, : s.size] = place * d.length, push * d.force
        if s[0] <= one.grid.first:
            force[row] = moment[row] = arc[row] = points[row] = forces[row] = np.nan
            status[row], surface[row] = int(Status.TOO_PROXIMAL), -1
            continue
        force[row] = push.sum(axis=0) * d.force
        moment[row] = np.cross(place, push).sum(axis=0) * d.moment
        overlap[row] = 0.0
        status[row] = int(Status.TIP_CONTACT if s.size == 1 and s[0] == 1.0 else Status.OK)
    return ObstacleDeflection(
        whisker,
        force,
        moment,
        arc,
        points,
        forces,
        surface,
        second | together,
        together,
        overlap,
        status,
        bent,
        solved,
    )


def _touching(status: IntArray) -> Mask:
    return np.isin(status, (Status.OK, Status.TIP_CONTACT))


def _solved(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    found: SurfaceDeflection,
    overlap: Array,
) -> dict[int, Equilibrium]:
    """Placements with several contacts, by number."""
    solved: dict[int, Equilibrium] = {}
    touching = _touching(found.bent.status)
    last: Equilibrium | None = None
    for i in range(len(positions)):
        if overlap[i] <= OVERLAP and (touching[i] or last is None):
            last = None
            continue
        grid = Grid.of(whisker)
        place = Placement(rotations[i], positions[i])
        one = None
        if last is not None:
            obstacles = Obstacles(surfaces, place, whisker.length)
            one = settled(whisker, obstacles, grid, strain_on(last, grid), last.pressing_on(grid))
            if one is None or not one.contacts()[0].size or one.farthest(last) > _JUMP:
                one = None
        if one is None and touching[i]:
            one = _from_one(whisker, surfaces, place, found, i, grid)
        last = one
        if one is not None:
            solved[i] = one
    return solved


def _from_one(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    place: Placement,
    found: SurfaceDeflection,
    row: int,
    grid: Grid,
) -> Equilibrium | None:
    """Equilibrium that a whisker bent by one contact comes to."""
    bent, d = found.bent, discretize(whisker)
    arc = float(bent.arc_length[row]) / d.length
    force, point = bent.force[row] / d.force, bent.contact_point[row] / d.length
    pressing = np.zeros((len(surfaces), grid.s.size))
    nearest = int(np.argmin(np.abs(grid.s - arc)))
    pressing[found.surface[row], nearest] = np.linalg.norm(force)
    strain = bent_by_one(grid, arc, force, point)
    out = settled(whisker, Obstacles(surfaces, place, d.length), grid, strain, pressing)
    # Pushed off by another object, a whisker may be free.
    return None if out is None or not out.contacts()[0].size else out


def overlaps(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    found: SurfaceDeflection,
) -> Array:
    """Depth (n,) of the bent whisker in objects away from its contact, m."""
    bent = found.bent
    s = np.linspace(0.0, whisker.length, _SAMPLES)
    radius = whisker.radius(s)
    deepest = np.zeros(len(positions))
    # A whisker at rest was found to be free before.
    touching = np.flatnonzero(_touching(bent.status))
    if not touching.size:
        return deepest
    lines = bent.centerline(_SAMPLES)
    for first in range(0, touching.size, _ROWS):
        rows = touching[first : first + _ROWS]
        line = lines[rows] @ np.swapaxes(rotations[rows], 1, 2) + positions[rows, None]
        near = np.abs(s - bent.arc_length[rows, None]) < _ASIDE * whisker.length
        for i, solid in enumerate(surfaces):
            gap = solid.signed_distance(line) - radius
            gap[near & (found.surface[rows, None] == i)] = np.inf
            deepest[rows] = np.maximum(deepest[rows], -gap.min(axis=1))
    return deepest
