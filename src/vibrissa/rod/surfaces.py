"""Quasi-static motion of a whisker past surfaces, with contact, friction, slip-off and release.

A surface is any object with a signed distance (`Surface`). The whisker's base moves from placement
to placement; between two of them the contact is followed on the stable branch of
:mod:`vibrissa.rod.touch`, in steps that are halved where Newton's method fails. The contact ends
where the branch ends (the determinant of the equations vanishes) or where the force would have to
pull. The whisker then returns to rest, unless a surface is in the way of the resting whisker. The
first surface that a free whisker meets holds it until that contact ends; other surfaces are
penetrated (which shows in the distance of the bent whisker from them).

Where the resting whisker would be inside a surface, at the start or after slip-off, it comes to
bear against that surface's nearest side: it is moved there from outside, without friction. A
contact that ends while the bent whisker also touches a surface elsewhere, as on two edges of a box,
is continued with that other contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, IntArray
from vibrissa.objects import Placement, Surface, between
from vibrissa.rod.chart import LEAST_ARC
from vibrissa.rod.deflection import Deflection, PointForce
from vibrissa.rod.discretization import STEPS, discretize
from vibrissa.rod.outward import shapes
from vibrissa.rod.pegs import Rest
from vibrissa.rod.points import Solutions, point_solver
from vibrissa.rod.statics import dimensional
from vibrissa.rod.touch import Touch, TouchSolver
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

# Determinant, as a share of its largest value, below which a branch is near its end.
_NEAR_FOLD = 0.5
_TOUCHING = 1e-5  # largest penetration of an approximate contact, over L
_ENTERED = 2e-3  # largest penetration at one of two simultaneous contacts, over L
_ELSEWHERE = 0.03  # distance above which contacts with the same surface are distinct, over L
_MOST_OTHERS = 3  # largest number of times that a contact is replaced by another in one frame
_MOST_ROUNDS = 40  # largest number of rounds in the search for the next contact
_SMALLEST_STEP = 2.0**-12  # smallest step between placements, as a share of their distance

# Every which sample of the resting whisker is used to detect contact, and the motion of a free
# whisker, m, after which contact is checked again.
_EVERY = 4
_CHECK_DISTANCE = 1e-4
# Number of parts into which the interval around the nearest sample is divided, and how often.
_ZOOM, _ZOOMS = 16, 4
_DIRECTIONS = 16  # number of directions tried to move a whisker out of a surface

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class SurfaceDeflection:
    """Deflection of a whisker moved past surfaces, at n placements."""

    bent: Deflection  # base force and moment, contact and status at each placement
    surface: IntArray  # (n,), index of the touched surface, -1 without contact
    normal: Array  # (n, 3), outward normals of the surface at the contacts, laboratory frame
    surface_point: Array  # (n, 3), contact point on the surface, laboratory frame, m
    sliding: np.ndarray  # (n,), whether the contact slides rather than sticks


def follow_surfaces(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    *,
    friction: float = 0.0,
    progress: Progress | None = None,
) -> SurfaceDeflection:
    """Move a whisker past surfaces, quasi-statically, through n placements in order."""
    if not (np.isfinite(friction) and friction >= 0.0):
        raise ValueError(f"friction is {friction!r}; it must be a finite coefficient, 0 or more")
    follower = _Follower(whisker, surfaces, friction)
    n = len(positions)
    solved, surface, sliding = Solutions.empty(n), np.full(n, -1), np.zeros(n, dtype=bool)
    normal, surface_point = np.full((2, n, 3), np.nan)
    for i in range(n):
        found = follower.move_to(Placement(rotations[i], positions[i]))
        if isinstance(found, Touch):
            solved.contacts[i], solved.values[i] = found.contact, found.state[:6]
            solved.misfits[i] = found.misfit
            solved.statuses[i] = int(Status.TIP_CONTACT if found.tip else Status.OK)
            surface[i], normal[i], sliding[i] = found.surface, found.normal, found.sliding
            surface_point[i] = found.point - found.distance * found.normal
        else:
            solved.statuses[i] = int(found)
            if found == Status.NO_CONTACT:
                solved.contacts[i, 1:] = solved.values[i, :3] = solved.misfits[i] = 0.0
        if progress is not None:
            progress(i + 1, n)
    d = follower.discretization
    load = PointForce(solved.contacts[:, 0] * d.length, components=solved.contacts[:, 1:] * d.force)
    bent = dimensional(whisker, load, solved, STEPS)
    return SurfaceDeflection(bent, surface, normal, surface_point, sliding)


class _Resting:
    """The resting whisker, and its distance from surfaces."""

    def __init__(self, whisker: Whisker, surfaces: Sequence[Surface]) -> None:
        rest = Rest.of(whisker)
        every = slice(None, None, _EVERY)
        self._surfaces, self._length = surfaces, whisker.length
        self.s: Array = rest.s[every]
        self.place: Array = rest.position[every] * whisker.length
        self.radius: Array = rest.radius[every] * whisker.length
        self._tangent = rest.frame[every, :, 0]
        slope = self._tangent * whisker.length
        self._line = interpolate.CubicHermiteSpline(self.s, self.place, slope)

    def at(self, s: Array) -> tuple[Array, Array]:
        """Positions (n, 3) and radii (n,) at s/L, m, by cubic interpolation of the samples."""
        return self._line(s), np.interp(s, self.s, self.radius)

    def direction(self, s: float) -> Array:
        """Unit tangent (3,) near s/L."""
        return np.asarray(self._tangent[int(np.argmin(np.abs(self.s - s)))])

    def gap(self, surface: int, place: Placement) -> tuple[float, float]:
        """Smallest distance between resting whisker and surface, m, and its s/L."""
        solid = self._surfaces[surface]
        gap = solid.signed_distance(place.outside(self.place)) - self.radius
        i = int(np.argmin(gap))
        least, at = float(gap[i]), float(self.s[i])
        spacing = (self.s[1] - self.s[0]) * self._length
        if abs(least) > spacing:
            return least, at
        # Between samples it may be nearer, especially near an edge.
        inner = np.concatenate([[np.inf], gap, [np.inf]])
        dips = (inner[1:-1] <= inner[:-2]) & (inner[1:-1] <= inner[2:])
        for dip in np.flatnonzero(dips & (gap < least + 0.5 * spacing)).tolist():
            low, high = self.s[max(dip - 1, 0)], self.s[min(dip + 1, gap.size - 1)]
            for _ in range(_ZOOMS):
                s = np.linspace(low, high, _ZOOM + 1)
                place_s, radius = self.at(s)
                gap_s = solid.signed_distance(place.outside(place_s)) - radius
                j = int(np.argmin(gap_s))
                if gap_s[j] < least:
                    least, at = float(gap_s[j]), float(s[j])
                low, high = s[max(j - 1, 0)], s[min(j + 1, _ZOOM)]
        return least, at

    def first_meeting(
        self, before: Placement, now: Placement
    ) -> tuple[int, Placement, Placement] | None:
        """First surface that the free whisker meets, the placement at contact and one after it."""
        way = np.linalg.norm(now.outside(self.place) - before.outside(self.place), axis=1).max()
        near = [i for i in range(len(self._surfaces)) if self.gap(i, now)[0] < way]
        if not near:
            return None
        looks = int(np.ceil(way / _CHECK_DISTANCE)) + 1
        last = 0.0
        for look in range(1, looks + 1):
            share = look / looks
            place = between(before, now, share)
            first: tuple[float, int] | None = None
            for i in near:
                if self.gap(i, place)[0] < 0.0:
                    at = self.meeting(i, before, now, last, share)
                    first = (at, i) if first is None else min(first, (at, i))
            if first is not None:
                return first[1], between(before, now, first[0]), place
            last = share
        return None

    def meeting(
        self, surface: int, before: Placement, now: Placement, low: float, high: float
    ) -> float:
        """Share of the motion at which a surface is met, between a clear and a penetrating one."""
        for _ in range(12):
            middle = 0.5 * (low + high)
            if self.gap(surface, between(before, now, middle))[0] < 0.0:
                high = middle
            else:
                low = middle
        return high

    def outside(self, surface: int, now: Placement) -> Placement | None:
        """Placement at which a whisker that would rest inside a surface touches it from outside.

        It touches the nearest side; None if there is none within two lengths.
        """
        _, s = self.gap(surface, now)
        place, slope = self.at(np.array([s]))[0][0], self.direction(s)
        _, normal, _ = self._surfaces[surface].local_geometry(now.outside(place))
        along = now.rotation @ slope
        toward = normal - (normal @ along) * along
        if np.linalg.norm(toward) < 1e-6:
            toward = now.rotation[:, 1] - (now.rotation[:, 1] @ along) * along
        toward = toward / np.linalg.norm(toward)
        across = np.cross(along, toward)
        angles = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
        ways = np.cos(angles)[:, None] * toward + np.sin(angles)[:, None] * across
        far = [self._way_out(surface, now, way) for way in ways]
        # Distances that differ only by rounding are equal: then the surface's own normal is taken.
        nearest = int(np.argmin(np.array(far) * np.r_[1.0 - 1e-6, np.ones(_DIRECTIONS - 1)]))
        if not np.isfinite(far[nearest]):
            return None
        clear = Placement(now.rotation, now.position + far[nearest] * ways[nearest])
        return between(clear, now, self.meeting(surface, clear, now, 0.0, 1.0))

    def _way_out(self, surface: int, now: Placement, way: Array) -> float:
        """Distance by which a resting whisker must move along a unit vector to be clear, m."""
        length = self._length
        distances = length * np.r_[np.linspace(0.0, 0.5, 65)[1:], 0.6, 0.8, 1.0, 1.5, 2.0]
        line = now.outside(self.place) + distances[:, None, None] * way
        gap = self._surfaces[surface].signed_distance(line) - self.radius
        clear = np.flatnonzero(gap.min(axis=1) > 0.0)
        return float(distances[clear[0]]) if clear.size else np.inf


class _Follower:
    """Present placement and contact of the whisker, and its motion to the next placement."""

    def __init__(self, whisker: Whisker, surfaces: Sequence[Surface], friction: float) -> None:
        self.discretization = discretize(whisker)
        self._whisker, self._surfaces, self._friction = whisker, surfaces, friction
        self._solver = TouchSolver(self.discretization, surfaces)
        self._rest = _Resting(whisker, surfaces)
        self._placement: Placement | None = None
        self._found: Touch | Status = Status.NOT_CONVERGED

    def move_to(self, now: Placement) -> Touch | Status:
        """Move to a placement; return the contact or why there is none."""
        before, self._placement = self._placement, now
        found = self._found
        if isinstance(found, Touch):
            assert before is not None
            found = self._follow(found, before, now, self._friction)
            before = None  # the whisker was not free there
        elif found != Status.NO_CONTACT:
            before = None
        if isinstance(found, Status):
            found = self._from_rest(before, now)
        self._found = found
        return found

    # Onset of contact

    def _from_rest(self, before: Placement | None, now: Placement) -> Touch | Status:
        """Solve a whisker that was free at ``before``, or was not (None)."""
        ended = Status.NO_CONTACT
        if before is not None:
            if (meeting := self._rest.first_meeting(before, now)) is None:
                return ended
            for friction in (self._friction, 0.0):
                found = self._enter(*meeting, now, friction)
                if isinstance(found, Touch):
                    return found
        gaps = [self._rest.gap(i, now)[0] for i in range(len(self._surfaces))]
        for surface in np.argsort(gaps).tolist():
            if gaps[surface] >= 0.0:
                break
            if (outside := self._rest.outside(surface, now)) is None:
                found = Status.NOT_CONVERGED
            else:
                found = self._enter(surface, outside, now, now, 0.0)
            if isinstance(found, Touch):
                return found
            if ended == Status.NO_CONTACT:
                ended = found
        return ended

    def _enter(
        self, surface: int, touching: Placement, after: Placement, now: Placement, friction: float
    ) -> Touch | Status:
        """Bend a whisker from first contact, through a penetrating placement, to ``now``."""
        _, s = self._rest.gap(surface, touching)
        if s < LEAST_ARC:
            return Status.TOO_PROXIMAL
        touch = self._solver.start(surface, touching, np.array([s, 0.0, 0.0, 0.0]))
        found = self._follow(touch, touching, after, friction)
        if isinstance(found, Touch) and after is not now:
            found = self._follow(found, after, now, friction)
        return found

    # Continuation

    def _follow(
        self,
        touch: Touch,
        before: Placement,
        now: Placement,
        friction: float,
        others: int = _MOST_OTHERS,
    ) -> Touch | Status:
        """Follow a contact between placements; if it ends, go on with another one."""
        done, stride, largest = 0.0, 1.0, 0.0
        while done < 1.0:
            share = min(done + stride, 1.0)
            place = now if share == 1.0 else between(before, now, share)
            found = self._solver.solve(touch, place, friction)
            if found is None or found.pressing < 0.0:
                stride *= 0.5
                if found is not None or stride < _SMALLEST_STEP:
                    reason = Status.NO_CONTACT if found else _status_at_end(touch, largest)
                    here = between(before, now, done)
                    return self._pass_on(touch, here, now, friction, others) or reason
                continue
            touch, done, stride = found, share, 2.0 * stride
            largest = min(largest, found.determinant)
        return touch

    def _pass_on(
        self, touch: Touch, here: Placement, now: Placement, friction: float, others: int
    ) -> Touch | None:
        """Continue with another contact of a whisker whose contact has ended, if there is one."""
        if not others:
            return None
        if (other := self._other_touch(touch, here)) is None:
            return None
        found = self._follow(other, here, now, friction, others - 1)
        return found if isinstance(found, Touch) else self._other_touch(touch, now)

    def _other_touch(self, touch: Touch, place: Placement) -> Touch | None:
        """Another contact of the whisker, as bent by one contact, with any of the surfaces."""
        d = self.discretization
        solver = point_solver(self._whisker, LEAST_ARC, STEPS)
        for surface, solid in enumerate(self._surfaces):
            allowed = np.abs(self._rest.s - touch.contact[0]) > _ELSEWHERE
            allowed |= surface != touch.surface
            contact, value = touch.contact, touch.state[:6]
            gap, s, point = self._bent_gap(surface, place, contact, value, allowed)
            same_touch = surface == touch.surface and abs(s - touch.contact[0]) < 1.3 * _ELSEWHERE
            if gap > 0.0 or same_touch:
                continue
            # Push the deepest point out, then the point that is then deepest nearby, and so on.
            allowed = np.abs(self._rest.s - s) < _ELSEWHERE
            for _ in range(_MOST_ROUNDS):
                _, normal, _ = solid.local_geometry(place.outside(point))
                target = point - gap * (normal @ place.rotation)
                solved = solver.solve(target[None] / d.length)
                if solved.statuses[0] != Status.OK:
                    break
                contact, value = solved.contacts[0], solved.values[0]
                gap, s, point = self._bent_gap(surface, place, contact, value, allowed)
                if gap > -_TOUCHING * d.length:
                    found = self._near(surface, place, contact, s)
                    if found is not None:
                        same = surface == touch.surface
                        if same and abs(found.contact[0] - touch.contact[0]) < _ELSEWHERE:
                            break
                        return found
            else:
                # Two contacts at once, neither of which alone holds the whisker: with one of them
                # solved, the penetration at the other is at most this.
                held = self._solver.start(surface, place, contact)
                force = place.rotation @ held.state[:3]
                if gap > -_ENTERED * d.length and force @ held.normal > 0.0:
                    return replace(
                        held, misfit=-gap / d.length, pressing=float(force @ held.normal)
                    )
        return None

    def _near(self, surface: int, place: Placement, contact: Array, s: float) -> Touch | None:
        """Solve a contact from an approximate one, starting at s or at its own arc length."""
        for guess in (s, contact[0]):
            start = self._solver.start(surface, place, np.r_[guess, contact[1:]])
            if (found := self._solver.solve(start, place, 0.0)) is not None:
                return found
        return None

    def _bent_gap(
        self, surface: int, place: Placement, contact: Array, value: Array, allowed: np.ndarray
    ) -> tuple[float, float, Array]:
        """Smallest distance of the bent whisker from a surface, m, its s/L and its point.

        Only samples that are ``allowed``, and the intervals next to the nearest, are searched.
        """
        s = self._rest.s[allowed & (self._rest.s >= LEAST_ARC)]
        for _ in range(_ZOOMS):
            line = shapes(self.discretization, value[None], contact[:1], s)[0]
            line *= self.discretization.length
            radius = np.interp(s, self._rest.s, self._rest.radius)
            gap = self._surfaces[surface].signed_distance(place.outside(line)) - radius
            i = int(np.argmin(gap))
            found = float(gap[i]), float(s[i]), line[i]
            s = np.linspace(s[max(i - 1, 0)], s[min(i + 1, s.size - 1)], _ZOOM + 1)
        return found


def _status_at_end(touch: Touch, largest: float) -> Status:
    """Status that explains why a contact could not be followed further."""
    if touch.contact[0] <= LEAST_ARC * (1.0 + 1e-9):
        return Status.TOO_PROXIMAL
    if touch.tip:
        return Status.BEYOND_TIP
    near = touch.determinant > _NEAR_FOLD * largest
    return Status.BEYOND_FOLD if near or touch.sliding else Status.NOT_CONVERGED
