"""One contact of a whisker with a surface, solved by Newton's method from one that is near."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vibrissa.numerics import Array
from vibrissa.objects import Placement, Surface
from vibrissa.rod.chart import LEAST_ARC
from vibrissa.rod.contact_state import STATES, contact_state
from vibrissa.rod.discretization import Discretization
from vibrissa.rod.surface_equations import EITHER, SLIDING, STICKING, surface_equations

_TOLERANCE = 1e-12
# So near a branch's end that rounding moves the solution, this is as good as it gets.
_AT_FOLD = 1e-9
_ROUNDS = 40
_SWITCHES = 6
# The longest Newton steps that a linearisation is trusted for: in s, in the contact's place (both
# over L), in the whisker's direction there, and in the surface's normal.
_LONGEST = np.array([0.15, 0.15, 0.4, 0.5])
_MOST_TURNED = 0.5  # cosine of the normal's turn in one step of the path
# A tip contact whose tangent points away from the surface by more than this is one of the side.
_OUTWARD = 1e-10


@dataclass(frozen=True, eq=False)
class Touch:
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


class TouchSolver:
    """Contacts of one whisker with surfaces."""

    def __init__(self, discretization: Discretization, surfaces: Sequence[Surface]) -> None:
        self.discretization, self._surfaces = discretization, surfaces
        scale = discretization.force / discretization.length
        self._softness = [scale / surface.stiffness for surface in surfaces]

    def start(self, surface: int, place: Placement, contact: Array) -> Touch:
        """Begin with a contact that only about meets the equations."""
        state = np.empty((STATES, 5))
        contact_state(self.discretization.rod, contact, state)
        point = place.outside(state[3:6, 0] * self.discretization.length)
        distance, normal, _ = self._surfaces[surface].local_geometry(point)
        tangent = place.rotation @ state[6:, 0]
        return Touch(
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

    def solve(self, last: Touch, place: Placement, friction: float) -> Touch | None:
        """Solve the contact at a placement, beginning with an earlier one; None if that fails."""
        found = self._newton(last, place, friction, EITHER)
        if found is None and friction > 0.0:
            # Newton's method may go round between sticking and sliding.
            for mode in (STICKING, SLIDING):
                found = self._newton(last, place, friction, mode)
                if found is not None:
                    break
        return found

    def _newton(self, last: Touch, place: Placement, friction: float, mode: int) -> Touch | None:
        d = self.discretization
        surface, softness = self._surfaces[last.surface], self._softness[last.surface]
        earlier = np.empty(7)
        earlier[:3] = (last.point - place.position) @ place.rotation / d.length
        earlier[3:6] = last.tangent @ place.rotation
        earlier[6] = last.contact[0]
        x, tip = last.contact.copy(), last.tip
        state, jacobian, step = np.empty((STATES, 5)), np.empty((4, 4)), np.empty(4)
        geometry, lean = np.empty(13), np.zeros(3)
        best: Touch | None = None
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
                best = Touch(
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
