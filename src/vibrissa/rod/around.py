"""Deflection of a whisker by rigid objects that may touch it at several points or along an arc.

The placements are first solved with one contact each (:mod:`vibrissa.rod.surfaces`). Where the
whisker bent by that contact would penetrate an object elsewhere, all contacts are solved together
(:mod:`vibrissa.rod.obstacles`), starting from the previous placement or from the one contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array, IntArray, Mask, rotation_matrices, without_blas_threads
from vibrissa.objects import Placement, Surface, listed_objects
from vibrissa.rod.deflection import Deflection, finite_vectors
from vibrissa.rod.discretization import discretize
from vibrissa.rod.obstacles import (
    ELEMENTS,
    Equilibrium,
    Grid,
    Obstacles,
    bend,
    solve_with_moving_nodes,
    strain_under_force,
    transfer_strain,
)
from vibrissa.rod.statics import check_objects
from vibrissa.rod.surfaces import Progress, SurfaceDeflection, follow_surfaces
from vibrissa.status import Status, counted

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

#: Penetration depth above which a second contact is assumed, m. A tapering whisker that lies along
#: a flat object penetrates less than this.
OVERLAP = 5e-6
# Number of points along the whisker at which penetration is evaluated; distance from the contact
# within which penetration of the same object is ignored, over L; rows evaluated at once.
_SAMPLES, _ASIDE, _ROWS = 129, 0.03, 512
_PRESSED = 5e-3  # initial penetration given to a whisker that objects do not reach, over L
_JUMP = 0.1  # largest displacement of a node from the previous placement, over L


@dataclass(frozen=True, eq=False, repr=False)
class ObstacleDeflection:
    """Deflection of a whisker by objects, at n placements with up to k contacts each.

    All vectors are in the whisker frame. Contacts are ordered from the base; contacts at
    neighbouring nodes represent an arc along which the force is distributed. Missing entries are
    NaN, or -1 for integers.

    Attributes
    ----------
    whisker : Whisker
        Whisker that is bent.
    force, moment : (n, 3) array
        Force and moment at the base, N and N·m; zero without contact, NaN where unsolved.
    arc_length : (n, k) array
        Arc lengths of the contacts from the base, m.
    contact_point, contact_force : (n, k, 3) array
        Contact points on the centreline, m, and contact forces, N.
    surface : (n, k) int array
        Index of the object at each contact.
    second_contact : (n,) bool array
        Whether the placement has more than one contact.
    several : (n,) bool array
        Whether all contacts of the placement were solved together.
    overlap : (n,) array
        Depth to which the whisker penetrates an object, m; zero where all contacts are solved.
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
        """Return the contact with the largest force at each placement.

        Returns
        -------
        tuple of arrays
            Arc lengths (n,), contact points (n, 3), forces (n, 3), and object indices (n,).
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
            Points, m; the resting whisker where there is no contact, NaN where unsolved.
        """
        lines = self._bent.centerline(n)
        for row, found in self._solved.items():
            lines[row] = found.centerline(n) * self.whisker.length
        return lines

    def __repr__(self) -> str:
        return f"<ObstacleDeflection at {self.status.size} placements: {counted(self.status)}>"


def deflect_around(
    whisker: Whisker,
    objects: Surface | Sequence[Surface],
    base_rotation: ArrayLike | None = None,
    base_position: ArrayLike | None = None,
    *,
    progress: Progress | None = None,
) -> ObstacleDeflection:
    """Deflect a whisker by rigid objects that may touch it anywhere, without friction.

    Parameters
    ----------
    whisker : Whisker
        Whisker; its weight is neglected.
    objects : Peg, Sphere, Plane, Box, Mesh or a sequence of them
        Objects in the laboratory.
    base_rotation : array_like, optional
        Rotations from the whisker's to the laboratory frame, shape (n, 3, 3) or (3, 3); by default
        the two frames coincide.
    base_position : array_like, optional
        Positions of the base, laboratory frame, m, shape (n, 3) or (3,); by default the origin.
    progress : callable, optional
        Function called after every placement with the number done and the total.

    Returns
    -------
    ObstacleDeflection
        Force and moment at the base, and all contacts of each placement.

    Notes
    -----
    Placements are solved in the order given, each starting from the previous one. A branch that
    cannot be followed with one contact ends with that contact, unless the previous placement had
    several. The contact force is normal to the object. Where there are several contacts on a
    tapering whisker, it therefore deviates from the normal of the centreline by the taper angle,
    0.1° for a rat's whisker.

    Examples
    --------
    A curved wire rests with its concave side on a pipe of smaller curvature:

    >>> wire = Whisker.from_curvature(0.1, lambda s: [0.0, 0.0, 8.0], base_radius=0.2e-3)
    >>> bent = deflect_around(wire, Peg([0.055, 0.14, 0.0], [0.0, 0.0, 1.0], radius=0.14))
    >>> (bent.arc_length[0, [0, 1, -1]] * 1e3).round(1)
    array([ 53.3,  55.2, 100. ])
    """
    solids = _rigid(objects)
    turn = np.eye(3) if base_rotation is None else rotation_matrices("base_rotation", base_rotation)
    move = np.zeros(3) if base_position is None else finite_vectors("base_position", base_position)
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
    """Return the objects as a list; raise a ValueError if one is compliant."""
    solids = listed_objects(objects)
    if soft := [repr(solid) for solid in solids if np.isfinite(solid.stiffness)]:
        raise ValueError(f"several contacts are solved with rigid objects only; got {soft[0]}")
    return solids


class NearObjects:
    """Equilibria of one whisker near rigid objects, shifted in the laboratory frame by (3,) L."""

    def __init__(
        self, whisker: Whisker, objects: Surface | Sequence[Surface], elements: int = ELEMENTS
    ) -> None:
        self._whisker, self._surfaces = whisker, _rigid(objects)
        self._grid, self._length = Grid.of(whisker, elements), whisker.length

    def reaching(self, place: Placement) -> Array:
        """Shift (3,) that brings objects into contact with the resting whisker; zero if in it."""
        s = np.linspace(0.0, 1.0, _SAMPLES) * self._length
        line, radius = place.outside(self._whisker.position(s)), self._whisker.radius(s)
        gaps = np.array([one.signed_distance(line) - radius for one in self._surfaces])
        which, at = np.unravel_index(np.argmin(gaps), gaps.shape)
        if gaps[which, at] < 0.0:
            return np.zeros(3)
        normal = self._surfaces[which].local_geometry(line[at])[1]
        return np.asarray(normal * (gaps[which, at] / self._length + _PRESSED))

    def from_outside(self, place: Placement, shift: Array) -> Equilibrium | None:
        """Equilibrium reached from a whisker that initially is clear of the objects."""
        there = self._shifted(place, shift)
        turn, move = there.rotation[None], there.position[None]
        found = follow_surfaces(self._whisker, self._surfaces, turn, move)
        if not _has_contact(found.bent.status)[0]:
            return None
        return _solve_from_one_contact(self._whisker, self._surfaces, there, found, 0, self._grid)

    def under_wrench(self, place: Placement, wrench: Array) -> tuple[Equilibrium, Array] | None:
        """Equilibrium and shift at which objects touch a whisker where one force bends it.

        The wrench (6,) at the base is non-dimensional. One force is where the moment vanishes on
        the rod that is integrated from the base; several that act together are near it.
        """
        force, moment, grid = wrench[:3], wrench[3:], self._grid
        size = float(np.linalg.norm(force))
        if size == 0.0:
            return None
        on_line = np.cross(force, moment) / size**2
        nodes = bend(grid, strain_under_force(grid, 1.0, force, on_line)).nodes
        left = np.cross(on_line - nodes, force) @ moment
        beyond = np.flatnonzero((left <= 0.0) & (grid.s >= grid.first))
        node = int(beyond[0]) if beyond.size else grid.s.size - 1
        strain = strain_under_force(grid, float(grid.s[node]), force, on_line)
        point = place.outside(bend(grid, strain).nodes[node] * self._length)
        gaps = [
            one.signed_distance(point) - grid.radius[node] * self._length for one in self._surfaces
        ]
        which = int(np.argmin(np.abs(gaps)))
        normal = self._surfaces[which].local_geometry(point)[1]
        shift = np.asarray(normal * (gaps[which] / self._length))
        pressing = np.zeros((len(self._surfaces), grid.s.size))
        pressing[which, node] = size
        obstacles = Obstacles(self._surfaces, self._shifted(place, shift), self._length)
        found = solve_with_moving_nodes(self._whisker, obstacles, grid, strain, pressing)
        return None if found is None or not found.contacts()[0].size else (found, shift)

    def moved(self, place: Placement, shift: Array, start: Equilibrium) -> Equilibrium | None:
        """Equilibrium continued from ``start``, with its nodes where they are but at contacts."""
        obstacles = Obstacles(self._surfaces, self._shifted(place, shift), self._length)
        begin = start.grid, start.strain, start.pressing
        return _continued(solve_with_moving_nodes(self._whisker, obstacles, *begin), start)

    def refined(self, place: Placement, shift: Array, start: Equilibrium) -> Equilibrium | None:
        """Equilibrium on this object's grid, continued from ``start`` on another grid."""
        obstacles = Obstacles(self._surfaces, self._shifted(place, shift), self._length)
        strain, pressing = transfer_strain(start, self._grid), start.pressing_on(self._grid)
        found = solve_with_moving_nodes(self._whisker, obstacles, self._grid, strain, pressing)
        return _continued(found, start)

    def _shifted(self, place: Placement, shift: Array) -> Placement:
        return Placement(place.rotation, place.position - shift * self._length)


@without_blas_threads
def around(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    found: SurfaceDeflection,
    several: bool = True,
) -> ObstacleDeflection:
    """Find placements with more than one contact, and if ``several`` solve all their contacts."""
    overlap = overlaps(whisker, surfaces, rotations, positions, found)
    second, solved = overlap > OVERLAP, dict[int, Equilibrium]()
    if several and second.any():
        solved = _solve_several_contacts(whisker, surfaces, rotations, positions, found, overlap)
    bent, d = found.bent, discretize(whisker)
    n, most = len(positions), max([1, *(one.contacts()[0].size for one in solved.values())])
    arc, surface = np.full((n, most), np.nan), np.full((n, most), -1)
    points, forces = np.full((n, most, 3), np.nan), np.full((n, most, 3), np.nan)
    force, moment, status = bent.force.copy(), bent.moment.copy(), bent.status.copy()
    touching = _has_contact(status)
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


def _has_contact(status: IntArray) -> Mask:
    return np.isin(status, (Status.OK, Status.TIP_CONTACT))


def _continued(found: Equilibrium | None, before: Equilibrium) -> Equilibrium | None:
    """An equilibrium with contacts that is near an earlier one; else None."""
    near = found is not None and found.contacts()[0].size and found.farthest(before) <= _JUMP
    return found if near else None


def _solve_several_contacts(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    found: SurfaceDeflection,
    overlap: Array,
) -> dict[int, Equilibrium]:
    """Equilibria of the placements with several contacts, by placement index."""
    solved: dict[int, Equilibrium] = {}
    touching = _has_contact(found.bent.status)
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
            start = transfer_strain(last, grid), last.pressing_on(grid)
            one = _continued(solve_with_moving_nodes(whisker, obstacles, grid, *start), last)
        if one is None and touching[i]:
            one = _solve_from_one_contact(whisker, surfaces, place, found, i, grid)
        last = one
        if one is not None:
            solved[i] = one
    return solved


def _solve_from_one_contact(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    place: Placement,
    found: SurfaceDeflection,
    row: int,
    grid: Grid,
) -> Equilibrium | None:
    """Equilibrium with all contacts, starting from the whisker bent by one contact."""
    bent, d = found.bent, discretize(whisker)
    arc = float(bent.arc_length[row]) / d.length
    force, point = bent.force[row] / d.force, bent.contact_point[row] / d.length
    pressing = np.zeros((len(surfaces), grid.s.size))
    nearest = int(np.argmin(np.abs(grid.s - arc)))
    pressing[found.surface[row], nearest] = np.linalg.norm(force)
    strain = strain_under_force(grid, arc, force, point)
    out = solve_with_moving_nodes(
        whisker, Obstacles(surfaces, place, d.length), grid, strain, pressing
    )
    # The other contacts may push the whisker off the objects altogether.
    return None if out is None or not out.contacts()[0].size else out


def overlaps(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    found: SurfaceDeflection,
) -> Array:
    """Penetration depth (n,) of the bent whisker into objects away from its contact, m."""
    bent = found.bent
    s = np.linspace(0.0, whisker.length, _SAMPLES)
    radius = whisker.radius(s)
    deepest = np.zeros(len(positions))
    # Without contact the resting whisker is already known to be clear of the objects.
    touching = np.flatnonzero(_has_contact(bent.status))
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
