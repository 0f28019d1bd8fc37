"""A whisker carried past surfaces: it touches, bends, sticks or slides, slips off and springs back.

A surface is anything with a signed distance (`Surface`). The whisker's base moves from placement
to placement; between two of them the contact is followed on the stable branch of
:mod:`vibrissa.rod.surface_equations`, in steps that are halved where Newton's method struggles. A
branch that ends (the equations' determinant vanishes) or a force that would have to pull ends the
contact: the whisker then rests, free, or against whatever stands where it would rest. The first
surface that a free whisker meets holds it until that contact ends; others are passed through (and
can be told by the distance of the bent whisker from them).

Where the whisker would rest inside a surface from the very beginning, or after it slipped, it lies
against the side of it that is nearest: it is brought there, in thought and without friction, from
outside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.rod.arrays import Array, IntArray
from vibrissa.rod.contact_state import STATES, contact_state
from vibrissa.rod.deflection import Deflection, dimensional
from vibrissa.rod.discretize import STEPS, discretize
from vibrissa.rod.loads import PointForce
from vibrissa.rod.points import Solutions, point_solver
from vibrissa.rod.reach import LEAST_ARC
from vibrissa.rod.resting import ZOOM, ZOOMS, Resting
from vibrissa.rod.shape import shapes
from vibrissa.rod.surface import Placement, Surface, between
from vibrissa.rod.surface_equations import EITHER, SLIDING, STICKING, surface_equations
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

_TOLERANCE = 1e-12
# So near a branch's end that rounding moves the solution, this is as good as it gets.
_AT_FOLD = 1e-9
_ROUNDS = 40
_SMALLEST_STEP = 2.0**-12
_SWITCHES = 6
# The longest Newton steps that a linearisation is trusted for: in s, in the contact's place (both
# over L), in the whisker's direction there, and in the surface's normal.
_LONGEST = np.array([0.15, 0.15, 0.4, 0.5])
_MOST_TURNED = 0.5  # cosine of the normal's turn in one step of the path
# A tip contact whose tangent points away from the surface by more than this is one of the side.
_OUTWARD = 1e-10
# A det below this share of that at the start says that the branch was near its end.
_NEAR_FOLD = 0.5
# A contact that is only about right enters a surface by no more than this, over L.
_TOUCHING = 1e-5
# One of two contacts at once enters a surface by no more than this, over L.
_ENTERED = 2e-3
# Touches of the same surface are two if they are this far apart, over L.
_ELSEWHERE = 0.03
# A contact passes on to another this often in one frame.
_MOST_OTHERS = 3

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class SurfaceDeflection:
    """What became of a whisker carried past surfaces, n placements.

    Attributes
    ----------
    bent : Deflection
        Of the whisker, in its own frame, (n,); its load is the contact force that was found.
    surface : (n,) int array
        Which surface it touches; -1 for none.
    normal : (n, 3) array
        Outward normal of the surface there, in the surfaces' frame.
    surface_point : (n, 3) array
        Where on the surface, m, in the surfaces' frame; of a compliant one, as it would be
        undeformed.
    sliding : (n,) bool array
        Whether the contact slides (or the friction is at its limit); False without contact.
    """

    bent: Deflection
    surface: IntArray
    normal: Array
    surface_point: Array
    sliding: np.ndarray


@dataclass(frozen=True, eq=False)
class _Touch:
    """A solved contact: which surface, (s, f), (F, p, t), and what friction has to remember."""

    surface: int
    tip: bool
    contact: Array
    state: Array
    point: Array
    tangent: Array
    normal: Array
    distance: float
    misfit: float
    determinant: float
    pressing: float
    sliding: bool


class _Ended(NamedTuple):
    """A contact that has ended, and why: `Status.NO_CONTACT` if it was let go."""

    reason: Status


def follow_surfaces(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    rotations: Array,
    positions: Array,
    *,
    friction: float = 0.0,
    proximal: float = LEAST_ARC,
    steps: int = STEPS,
    progress: Progress | None = None,
) -> SurfaceDeflection:
    """Carry a whisker past surfaces, quasi-statically.

    Parameters
    ----------
    whisker : Whisker
        What bends.
    surfaces : sequence of Surface
        What it may touch.
    rotations : (n, 3, 3) array
        Of its base: from the whisker's frame to that of the surfaces.
    positions : (n, 3) array
        Of its base in the surfaces' frame, m.
    friction : float
        Coulomb's coefficient µ, for sticking and sliding alike.
    proximal : float
        Contacts at less than this share of the length from the base get a status, not an answer.
    steps : int
        Integration steps along the whisker.
    progress : callable, optional
        Told after every placement how many are done, of how many.

    Returns
    -------
    SurfaceDeflection
        One row a placement. Each goes on from the one before.

    Raises
    ------
    ValueError
        If the friction is negative.
    """
    if not (np.isfinite(friction) and friction >= 0.0):
        raise ValueError(f"friction is {friction!r}; a coefficient from 0 on is needed")
    follower = _Follower(whisker, surfaces, friction, steps)
    n = len(positions)
    solved = Solutions.empty(n)
    out = SurfaceDeflection(
        bent=None,  # type: ignore[arg-type]
        surface=np.full(n, -1),
        normal=np.full((n, 3), np.nan),
        surface_point=np.full((n, 3), np.nan),
        sliding=np.zeros(n, dtype=bool),
    )
    for i in range(n):
        found = follower.move_to(Placement(rotations[i], positions[i]))
        if isinstance(found, _Touch) and found.contact[0] < proximal:
            found = _Ended(Status.TOO_PROXIMAL)
        if isinstance(found, _Touch):
            solved.contacts[i], solved.values[i] = found.contact, found.state[:6]
            solved.misfits[i] = found.misfit
            solved.statuses[i] = int(Status.TIP_CONTACT if found.tip else Status.OK)
            out.surface[i], out.normal[i] = found.surface, found.normal
            out.surface_point[i] = found.point - found.distance * found.normal
            out.sliding[i] = found.sliding
        else:
            solved.statuses[i] = int(found.reason)
            if found.reason == Status.NO_CONTACT:
                solved.contacts[i, 1:] = solved.values[i, :3] = solved.misfits[i] = 0.0
        if progress is not None:
            progress(i + 1, n)
    d = follower.discretization
    load = PointForce(solved.contacts[:, 0] * d.length, components=solved.contacts[:, 1:] * d.force)
    bent = dimensional(whisker, load, d, solved, steps)
    return SurfaceDeflection(bent, out.surface, out.normal, out.surface_point, out.sliding)


class _Follower:
    """Where the whisker is now, and how it gets to the next placement."""

    def __init__(
        self, whisker: Whisker, surfaces: Sequence[Surface], friction: float, steps: int
    ) -> None:
        self.discretization = discretize(whisker, steps)
        self._whisker, self._steps = whisker, steps
        self._surfaces = surfaces
        self._friction = friction
        scale = self.discretization.force / self.discretization.length
        self._softness = [scale / surface.stiffness for surface in surfaces]
        self._rest = Resting(whisker, surfaces)
        self._placement: Placement | None = None
        self._found: _Touch | _Ended = _Ended(Status.NOT_CONVERGED)

    def move_to(self, now: Placement) -> _Touch | _Ended:
        """Go on to a placement."""
        before, self._placement = self._placement, now
        found = self._found
        if isinstance(found, _Touch):
            assert before is not None
            found = self._follow(found, before, now, self._friction)
            before = None  # it was not free there
        elif found.reason != Status.NO_CONTACT:
            before = None
        if isinstance(found, _Ended):
            found = self._from_rest(before, now)
        self._found = found
        return found

    # Touching

    def _from_rest(self, before: Placement | None, now: Placement) -> _Touch | _Ended:
        """Bend a whisker that was free before (or not: None), if anything is in its way."""
        ended = _Ended(Status.NO_CONTACT)
        if before is not None:
            meeting = self._rest.first_meeting(before, now)
            if meeting is None:
                return ended
            for friction in (self._friction, 0.0):
                found = self._enter(*meeting, now, friction)
                if isinstance(found, _Touch):
                    return found
        gaps = [self._rest.gap(i, now)[0] for i in range(len(self._surfaces))]
        for surface in np.argsort(gaps).tolist():
            if gaps[surface] >= 0.0:
                break
            outside = self._rest.outside(surface, now)
            if outside is None:
                found = _Ended(Status.NOT_CONVERGED)
            else:
                found = self._enter(surface, outside, now, now, 0.0)
            if isinstance(found, _Touch):
                return found
            if ended.reason == Status.NO_CONTACT:
                ended = found
        return ended

    def _enter(
        self, surface: int, touching: Placement, after: Placement, now: Placement, friction: float
    ) -> _Touch | _Ended:
        """Bend a whisker that touches at one placement, lies inside at the next, on to a third."""
        _, s = self._rest.gap(surface, touching)
        if s < LEAST_ARC:
            return _Ended(Status.TOO_PROXIMAL)
        touch = self._start(surface, touching, np.array([s, 0.0, 0.0, 0.0]))
        found = self._follow(touch, touching, after, friction)
        if isinstance(found, _Touch) and after is not now:
            found = self._follow(found, after, now, friction)
        return found

    def _start(self, surface: int, place: Placement, contact: Array) -> _Touch:
        """Begin with a contact that only about meets the equations."""
        state = np.empty((STATES, 5))
        contact_state(self.discretization.rod, contact, state)
        point = place.outside(state[3:6, 0] * self.discretization.length)
        distance, normal, _ = self._surfaces[surface].local_geometry(point)
        tangent = place.rotation @ state[6:, 0]
        return _Touch(
            surface=surface,
            tip=bool(contact[0] >= 1.0 and tangent @ normal < 0.0),
            contact=contact,
            state=state[:, 0].copy(),
            point=point,
            tangent=tangent,
            normal=normal,
            distance=distance,
            misfit=0.0,
            determinant=-np.inf,
            pressing=0.0,
            sliding=False,
        )

    # Following

    def _follow(
        self,
        touch: _Touch,
        before: Placement,
        now: Placement,
        friction: float,
        others: int = _MOST_OTHERS,
    ) -> _Touch | _Ended:
        """Follow a contact from one placement to another, and the next one if it ends there."""
        done, stride, largest = 0.0, 1.0, 0.0
        while done < 1.0:
            share = min(done + stride, 1.0)
            place = now if share == 1.0 else between(before, now, share)
            found = self._solve(touch, place, friction)
            if found is None or found.pressing < 0.0:
                stride *= 0.5
                if found is not None or stride < _SMALLEST_STEP:
                    reason = Status.NO_CONTACT if found else _reason(touch, largest)
                    here = between(before, now, done)
                    return self._pass_on(touch, here, now, friction, others) or _Ended(reason)
                continue
            touch, done, stride = found, share, 2.0 * stride
            largest = min(largest, found.determinant)
        return touch

    def _pass_on(
        self, touch: _Touch, here: Placement, now: Placement, friction: float, others: int
    ) -> _Touch | None:
        """Go on with another contact of a whisker whose contact has ended, if it has one."""
        if not others:
            return None
        other = self._other_touch(touch, here)
        if other is None:
            return None
        found = self._follow(other, here, now, friction, others - 1)
        return found if isinstance(found, _Touch) else self._other_touch(touch, now)

    def _other_touch(self, touch: _Touch, place: Placement) -> _Touch | None:
        """Where else the whisker, bent by one contact, lies against a surface: the next contact."""
        d = self.discretization
        solver = point_solver(self._whisker, LEAST_ARC, self._steps)
        for surface, solid in enumerate(self._surfaces):
            allowed = np.abs(self._rest.s - touch.contact[0]) > _ELSEWHERE
            allowed |= surface != touch.surface
            contact, value = touch.contact, touch.state[:6]
            gap, s, point = self._bent_gap(surface, place, contact, value, allowed)
            beside = surface == touch.surface and abs(s - touch.contact[0]) < 1.3 * _ELSEWHERE
            if gap > 0.0 or beside:
                continue
            # Held out at the point where it is deepest, and again where it then is, nearby.
            allowed = np.abs(self._rest.s - s) < _ELSEWHERE
            for _ in range(_ROUNDS):
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
                # It lies against two places at once, and neither alone would hold it: held at one
                # of them it enters the surface no more than this.
                held = self._start(surface, place, contact)
                force = place.rotation @ held.state[:3]
                if gap > -_ENTERED * d.length and force @ held.normal > 0.0:
                    return replace(
                        held, misfit=-gap / d.length, pressing=float(force @ held.normal)
                    )
        return None

    def _near(self, surface: int, place: Placement, contact: Array, s: float) -> _Touch | None:
        """Solve a contact that is about known, and about at s."""
        for guess in (s, contact[0]):
            start = self._start(surface, place, np.r_[guess, contact[1:]])
            found = self._solve(start, place, 0.0)
            if found is not None:
                return found
        return None

    def _bent_gap(
        self, surface: int, place: Placement, contact: Array, value: Array, allowed: np.ndarray
    ) -> tuple[float, float, Array]:
        """Smallest distance of the bent whisker from a surface, m, and s/L and point there.

        Only samples that are ``allowed`` are looked at, and what lies between them.
        """
        s = self._rest.s[allowed & (self._rest.s >= LEAST_ARC)]
        for _ in range(ZOOMS):
            line = shapes(self.discretization, value[None], contact[:1], s)[0]
            line *= self.discretization.length
            radius = np.interp(s, self._rest.s, self._rest.radius)
            gap = self._surfaces[surface].signed_distance(place.outside(line)) - radius
            i = int(np.argmin(gap))
            found = float(gap[i]), float(s[i]), line[i]
            s = np.linspace(s[max(i - 1, 0)], s[min(i + 1, s.size - 1)], ZOOM + 1)
        return found

    def _solve(self, last: _Touch, place: Placement, friction: float) -> _Touch | None:
        """Solve the contact at a placement, beginning with an earlier one; None if that fails."""
        found = self._newton(last, place, friction, EITHER)
        if found is None and friction > 0.0:
            # Newton's method may go round between sticking and sliding.
            for mode in (STICKING, SLIDING):
                found = self._newton(last, place, friction, mode)
                if found is not None:
                    break
        return found

    def _newton(self, last: _Touch, place: Placement, friction: float, mode: int) -> _Touch | None:
        d = self.discretization
        surface, softness = self._surfaces[last.surface], self._softness[last.surface]
        earlier = np.empty(7)
        earlier[:3] = (last.point - place.position) @ place.rotation / d.length
        earlier[3:6] = last.tangent @ place.rotation
        earlier[6] = last.contact[0]
        x, tip = last.contact.copy(), last.tip
        state, jacobian, step = np.empty((STATES, 5)), np.empty((4, 4)), np.empty(4)
        geometry, lean = np.empty(13), np.zeros(3)
        best: _Touch | None = None
        size, past_tip, switches = np.inf, 0, 0
        settled = friction == 0.0 or mode != EITHER
        for rounds in range(_ROUNDS):
            radius, slope = contact_state(d.rod, x, state)
            point = place.outside(state[3:6, 0] * d.length)
            if not np.isfinite(point).all():
                return None
            # The surface as it was where it last was touched predicts, to first order, where it is
            # touched now; then it counts as it is.
            predicting = rounds == 0
            distance, normal, turn = surface.local_geometry(last.point if predicting else point)
            geometry[0] = distance / d.length
            geometry[1:4] = normal @ place.rotation
            turn = place.rotation.T @ turn @ place.rotation * d.length
            geometry[4:] = turn.ravel()
            lean[:] = 0.0
            if predicting:
                moved = state[3:6, 0] - earlier[:3]
                geometry[0] += geometry[1:4] @ moved
                lean[:] = turn @ moved
            misfit, determinant, pressing, sliding, right = surface_equations(
                x,
                state,
                radius * d.radius,
                slope * d.radius,
                geometry,
                lean,
                softness,
                friction,
                earlier,
                tip,
                mode,
                jacobian,
                step,
            )
            stable = determinant < 0.0
            if not (stable or friction > 0.0) or not np.isfinite(step).all():
                return best
            if predicting:
                misfit = np.inf
            elif normal @ last.normal < _MOST_TURNED:
                return None
            if right and stable and misfit <= _AT_FOLD and (best is None or misfit < best.misfit):
                best = _Touch(
                    last.surface,
                    tip,
                    x.copy(),
                    state[:, 0].copy(),
                    point,
                    place.rotation @ state[6:, 0],
                    normal,
                    distance,
                    misfit,
                    determinant,
                    pressing,
                    sliding,
                )
            if misfit <= _TOLERANCE:
                if tip and state[6:, 0] @ geometry[1:4] > _OUTWARD and switches < _SWITCHES:
                    tip, best, size = False, None, np.inf
                    switches += 1
                    continue
                return best
            change = state[3:, 1:] @ step
            now = float(
                max(
                    abs(step[0]) / _LONGEST[0],
                    np.linalg.norm(change[:3]) / _LONGEST[1],
                    np.linalg.norm(change[3:]) / _LONGEST[2],
                    np.linalg.norm(lean + turn @ change[:3]) / _LONGEST[3],
                )
            )
            if rounds == 0 and now > 2.0:
                return None
            if rounds >= 3 + switches and now > 0.95 * size + 1e-9 and settled:
                return best
            size = now
            x += step / max(now, 1.0)
            if not tip and x[0] > 1.0:
                past_tip += 1
                if past_tip > 1 and switches < _SWITCHES:
                    tip, size, past_tip, best = True, np.inf, 0, None
                    switches += 1
            x[0] = min(max(x[0], LEAST_ARC), 1.0)
        return best


def _reason(touch: _Touch, largest: float) -> Status:
    """Why a contact could not be followed any further."""
    if touch.contact[0] <= LEAST_ARC * (1.0 + 1e-9):
        return Status.TOO_PROXIMAL
    if touch.tip:
        return Status.BEYOND_TIP
    near = touch.determinant > _NEAR_FOLD * largest
    return Status.BEYOND_FOLD if near or touch.sliding else Status.NOT_CONVERGED
