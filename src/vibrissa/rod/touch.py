"""Contact of a whisker with a surface, with or without friction, solved by Newton's method.

With t the whisker's tangent at the contact (:func:`vibrissa.rod.kernels.contact_state`), d the
surface's signed distance at p, n its outward normal there, N = F·n the normal force and T = F - N n
the friction force, four equations determine (s_c, f_x, f_y, f_z):

- the surfaces touch, one whisker radius away from the centreline: d - a(s_c) + N/k = 0, with k the
  object's stiffness (1/k = 0: rigid);
- on its side the whisker is tangent to the surface, t·n = 0; at its tip s_c = 1 instead;
- two for the friction, in the tangent plane: T = Π(T - c Δ), Π the projection onto the disc of
  radius µN and c > 0 any number. They are equivalent to |T| ≤ µN and either sticking (Δ = 0) or
  sliding with T = -µN Δ/|Δ|.

Δ is the displacement of the whisker's material along the surface since the last solution
(p₁, t₁, s₁): the displacement of the contact in space minus that along the whisker,

    Δ = p - p₁ - ½ (t + t₁)(s_c - s₁),

which vanishes for a contact that rolls without slip. Friction acts on the centreline.

At zero force the determinant of the four rows in this order is negative wherever a surface first
touches (n, e₁, e₂ being right-handed): the whisker curves away from the surface and yields to a
push. It remains so along the stable branch connected to rest, sticking or sliding, and vanishes at
the branch's end, where the whisker slips off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vibrissa.numerics import Array, inlined, kernel, solve
from vibrissa.objects import Placement, Surface
from vibrissa.rod.chart import LEAST_ARC
from vibrissa.rod.discretization import Discretization
from vibrissa.rod.integration import relative_radius
from vibrissa.rod.kernels import contact_state, normal_plane

EITHER, STICKING, SLIDING = 0, 1, 2
# Number of state variables (F, p, t).
_STATES = 9
_TOLERANCE = 1e-12
# Residual at which a solution is accepted near a branch's end, where rounding displaces it.
_AT_FOLD = 1e-9
_ROUNDS = 40
_SWITCHES = 6
# Largest Newton steps: in s, in the contact's position (both over L), in the whisker's direction
# there, and in the surface's normal.
_LONGEST = (0.15, 0.15, 0.4, 0.5)
_MOST_TURNED = 0.5  # cosine of the largest rotation of the normal in one step of the path
# Component of the tangent along the normal above which a tip contact becomes one of the side.
_OUTWARD = 1e-10


@inlined
def _normal_compliance(n: Array, state: Array) -> float:
    """Compliance of the contact along the normal; it serves as c of the friction equations."""
    give = 0.0
    for j in range(2, 5):
        part = 0.0
        for i in range(3):
            part += n[i] * state[3 + i, j]
        give += part * part
    return float(np.sqrt(give))


@inlined
def _length_and_direction(v: Array) -> tuple[float, float, float]:
    """Length and direction of a vector (2,); the direction of a zero vector is zero."""
    size = np.hypot(v[0], v[1])
    if size > 0.0:
        return float(size), float(v[0] / size), float(v[1] / size)
    return 0.0, 0.0, 0.0


@kernel
def _surface_equations(
    contact: Array,
    state: Array,
    whisker_radius: float,
    whisker_slope: float,
    geometry: Array,
    lean: Array,
    softness: float,
    friction: float,
    earlier: Array,
    tip: bool,
    mode: int,
    step: Array,
) -> tuple[float, float, float, bool, bool]:
    """Compute Newton's step from residual and Jacobian; lengths over L, forces over EI/L².

    Returns the residual's norm, the Jacobian's determinant, the normal force, whether the contact
    slides, and whether this agrees with the friction cone.
    """
    n, e = geometry[1:4], np.empty((2, 3))
    e[0], e[1] = normal_plane((n[0], n[1], n[2]))
    pressing, along, away = 0.0, 0.0, contact[0] - earlier[6]
    for i in range(3):
        pressing += (n[i] + lean[i]) * state[i, 0]
        along += (n[i] + lean[i]) * state[6 + i, 0]
    # In the tangent plane: friction, displacement Δ, and the argument T - c Δ of the projection.
    push, way, wanted = np.zeros(2), np.zeros(2), np.empty(2)
    give = _normal_compliance(n, state)
    limit = friction * max(pressing, 0.0)
    for r in range(2):
        for i in range(3):
            mean = 0.5 * (state[6 + i, 0] + earlier[3 + i])
            push[r] += e[r, i] * (state[i, 0] - pressing * lean[i])
            way[r] += e[r, i] * (state[3 + i, 0] - earlier[i] - away * mean)
        wanted[r] = push[r] - way[r] / give
    strength, toward0, toward1 = _length_and_direction(wanted)
    beyond = bool(strength >= limit)
    sliding = beyond if mode == EITHER else mode == SLIDING

    step[0] = -(geometry[0] - whisker_radius + softness * pressing)
    step[1] = -((contact[0] - 1.0) if tip else along)
    if sliding:
        step[2] = -give * (push[0] - limit * toward0)
        step[3] = -give * (push[1] - limit * toward1)
    else:
        step[2], step[3] = -way[0], -way[1]
    misfit = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2 + step[3] ** 2)

    turn, jacobian = np.empty(3), np.empty((4, 4))
    d_push, d_way = np.empty(2), np.empty(2)
    for j in range(4):
        closer, d_along, d_pressing = 0.0, 0.0, 0.0
        for i in range(3):
            turn[i] = 0.0
            for k in range(3):
                turn[i] += geometry[4 + 3 * i + k] * state[3 + k, 1 + j]
            closer += n[i] * state[3 + i, 1 + j]
            d_along += n[i] * state[6 + i, 1 + j] + turn[i] * state[6 + i, 0]
            d_pressing += n[i] * state[i, 1 + j] + turn[i] * state[i, 0]
        jacobian[0, j] = closer + softness * d_pressing
        jacobian[1, j] = d_along
        for r in range(2):
            d_push[r] = d_way[r] = 0.0
            for i in range(3):
                d_push[r] += e[r, i] * (state[i, 1 + j] - pressing * turn[i])
                slid = state[3 + i, 1 + j] - 0.5 * away * state[6 + i, 1 + j]
                if j == 0:
                    slid -= 0.5 * (state[6 + i, 0] + earlier[3 + i])
                d_way[r] += e[r, i] * slid
        if j == 0:
            jacobian[0, j] -= whisker_slope
        if sliding:
            d0 = d_push[0] - d_way[0] / give
            d1 = d_push[1] - d_way[1] / give
            # Across the direction of sliding the derivative of the projection is a rotation.
            across = -toward1 * d0 + toward0 * d1
            turned = limit * across / strength if strength > 0.0 else 0.0
            d_limit = friction * d_pressing if pressing > 0.0 else 0.0
            jacobian[2, j] = give * (d_push[0] - d_limit * toward0 + turned * toward1)
            jacobian[3, j] = give * (d_push[1] - d_limit * toward1 - turned * toward0)
        else:
            jacobian[2, j], jacobian[3, j] = d_way[0], d_way[1]
    if tip:
        jacobian[1, 0], jacobian[1, 1], jacobian[1, 2], jacobian[1, 3] = 1.0, 0.0, 0.0, 0.0
    return misfit, solve(jacobian, step), pressing, sliding, sliding == beyond


@dataclass(frozen=True, eq=False)
class Touch:
    """A solved contact: surface index, (s, f), (F, p, t), and the state needed for friction."""

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
    """Solver for contacts of one whisker with surfaces."""

    def __init__(self, discretization: Discretization, surfaces: Sequence[Surface]) -> None:
        self.discretization, self._surfaces = discretization, surfaces
        scale = discretization.force / discretization.length
        self._softness = [scale / surface.stiffness for surface in surfaces]

    def start(self, surface: int, place: Placement, contact: Array) -> Touch:
        """Return an initial state from a contact that satisfies the equations approximately."""
        state = np.empty((_STATES, 5))
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
        """Solve the contact at a placement from an earlier one; None if that fails."""
        found = self._newton(last, place, friction, EITHER)
        if found is None and friction > 0.0:
            # Newton's method may alternate between sticking and sliding: impose each of them.
            for mode in (STICKING, SLIDING):
                found = self._newton(last, place, friction, mode)
                if found is not None:
                    break
        return found

    def _newton(self, last: Touch, place: Placement, friction: float, mode: int) -> Touch | None:
        """Solve with sticking or sliding imposed, or free to be either."""
        length = self.discretization.length
        earlier = np.concatenate(
            [
                (last.point - place.position) @ place.rotation / length,
                last.tangent @ place.rotation,
                last.contact[:1],
            ]
        )
        x, tip, step = last.contact.copy(), last.tip, np.empty(4)
        best: Touch | None = None
        size, past_tip, switches = np.inf, 0, 0
        settled = friction == 0.0 or mode != EITHER
        for rounds in range(_ROUNDS):
            # The first round predicts the contact to first order, with the surface's geometry at
            # the last contact; later rounds evaluate the surface itself.
            predicting = rounds == 0
            linear = self._linearise(last, place, x, tip, earlier, friction, mode, predicting, step)
            if linear is None:
                return None
            found, right, now = linear
            stable = found.determinant < 0.0
            if not (stable or friction > 0.0) or not np.isfinite(step).all():
                return best
            if not predicting and found.normal @ last.normal < _MOST_TURNED:
                return None
            good = right and stable and found.misfit <= _AT_FOLD
            if good and (best is None or found.misfit < best.misfit):
                best = found
            if found.misfit <= _TOLERANCE:
                outward = found.tangent @ found.normal > _OUTWARD
                if not (tip and outward and switches < _SWITCHES):
                    return best
                tip, best, size = False, None, np.inf
                switches += 1
                continue
            if predicting and now > 2.0:
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

    def _linearise(
        self,
        last: Touch,
        place: Placement,
        x: Array,
        tip: bool,
        earlier: Array,
        friction: float,
        mode: int,
        predicting: bool,
        step: Array,
    ) -> tuple[Touch, bool, float] | None:
        """The contact x, whether its friction is consistent, and its step over the largest step.

        Fills Newton's ``step``. Returns None where the whisker cannot be integrated.
        """
        d = self.discretization
        surface, rotation = self._surfaces[last.surface], place.rotation
        state, geometry, lean = np.empty((_STATES, 5)), np.empty(13), np.zeros(3)
        contact_state(d.rod, x, state)
        radius, slope = relative_radius(d.rod, x[0])
        point = place.outside(state[3:6, 0] * d.length)
        if not np.isfinite(point).all():
            return None
        distance, normal, turn = surface.local_geometry(last.point if predicting else point)
        turn = rotation.T @ turn @ rotation * d.length
        geometry[0], geometry[1:4], geometry[4:] = distance / d.length, normal @ rotation, turn.flat
        if predicting:
            moved = state[3:6, 0] - earlier[:3]
            geometry[0] += geometry[1:4] @ moved
            lean = turn @ moved
        misfit, determinant, pressing, sliding, right = _surface_equations(
            x,
            state,
            radius * d.radius,
            slope * d.radius,
            geometry,
            lean,
            self._softness[last.surface],
            friction,
            earlier,
            tip,
            mode,
            step,
        )
        change = state[3:, 1:] @ step
        parts = (step[:1], change[:3], change[3:], lean + turn @ change[:3])
        size = max(
            float(np.linalg.norm(part)) / longest
            for part, longest in zip(parts, _LONGEST, strict=True)
        )
        found = Touch(
            surface=last.surface,
            tip=tip,
            contact=x.copy(),
            state=state[:, 0].copy(),
            point=point,
            tangent=rotation @ state[6:, 0],
            normal=normal,
            distance=distance,
            misfit=np.inf if predicting else misfit,
            determinant=determinant,
            pressing=pressing,
            sliding=sliding,
        )
        return found, right, size
