"""Steps in time of a chain among objects; see :mod:`vibrissa.simulation.dynamics`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from vibrissa.numerics import Array, IntArray
from vibrissa.objects.surface import Surface
from vibrissa.simulation.chain import Chain, bezier, configure, inertia, jacobian, solve_definite
from vibrissa.whisker import Whisker

_ROUNDS = 60
_EAGER = 8
# A round that turns no joint by more than this ends a step, rad.
_TURNED = 1e-9
_MOST_TURNED = 0.3
_PARTS = 4  # samples a segment
# Minima of the distance nearer than this are looked at closely, m.
_NEAR = 1e-4
_ZOOM = np.linspace(-1.0, 1.0, 9) / _PARTS
# Sliding slower than this, m/s, is held up by less than full friction.
_CREEP = 1e-3


class Contact(NamedTuple):
    """One contact: which object, arc length, control points' numbers and weights, gap, normal."""

    surface: int
    arc_length: float
    segment: int
    weights: Array
    place: Array
    gap: float
    normal: Array


@dataclass(frozen=True, eq=False)
class Moment:
    """A moment of the movement, laboratory frame, SI units."""

    force: Array
    moment: Array
    controls: Array
    nodes: Array
    contacts: tuple[Contact, ...]
    contact_force: Array
    sliding: bool

    def centerline(self, n: int) -> Array:
        """Give the centreline."""
        s = np.linspace(0.0, self.nodes[-1], n)
        segment = np.clip(np.searchsorted(self.nodes, s) - 1, 0, self.nodes.size - 2)
        part = (s - self.nodes[segment]) / np.diff(self.nodes)[segment]
        return np.asarray(np.einsum("kc,kci->ki", bezier(part), self.controls[segment]))


def frequencies(chain: Chain, count: int) -> Array:
    """Lowest frequencies of a chain at rest, held at its base: (count,), Hz."""
    state = State(chain)
    state.move(chain.rest, np.eye(3), np.zeros(3))
    inertia(
        state.masses,
        chain.mass,
        chain.mass_link,
        np.zeros_like(state.masses),
        state.pivots,
        state.turns,
        state.residual,
        state.matrix,
    )
    # The stiffness is regular, the mass need not be: twist of a straight whisker has none.
    n = chain.stiffness.size
    slow = eigh(
        state.matrix,
        np.diag(chain.stiffness.ravel()),
        eigvals_only=True,
        subset_by_index=[n - count, n - 1],
    )
    return np.asarray(1.0 / np.sqrt(slow[::-1]) / (2.0 * np.pi))


class State:
    """The links now; arrays that are written again in every round."""

    def __init__(self, chain: Chain) -> None:
        m = chain.joints.size
        self.chain = chain
        self.frames, self.pivots = np.empty((m + 1, 3, 3)), np.empty((m, 3))
        self.turns = np.empty((m, 3, 3))
        self.residual, self.matrix = np.empty(3 * m), np.empty((3 * m, 3 * m))
        self.base = np.zeros(3)
        self.masses = np.empty((chain.mass.size, 3))
        self.controls = np.empty((chain.nodes.size - 1, 3, 3))

    def move(self, theta: Array, rotation: Array, base: Array) -> None:
        """Turn the joints and place the base."""
        chain = self.chain
        configure(
            theta,
            chain.joints,
            np.ascontiguousarray(rotation),
            np.ascontiguousarray(base),
            self.frames,
            self.pivots,
            self.turns,
        )
        self.base = base
        self.masses = chain.places(self.frames, self.pivots, base, chain.mass_arc, chain.mass_link)
        self.controls = chain.controls(self.frames, self.pivots, base)


class History(NamedTuple):
    """What one quantity was in the last two steps, and its rate."""

    value: Array
    before: Array
    rate: Array
    rate_before: Array

    @classmethod
    def still(cls, value: Array) -> History:
        """Have been the same all along."""
        zero = np.zeros_like(value)
        return cls(value.copy(), value.copy(), zero, zero)

    @classmethod
    def before_first(cls, values: Array, step: float) -> History:
        """What led to values (4, ...) that go on smoothly: the history of the first of them."""
        # Newton's backward differences, through the first four.
        one, two, three = (np.diff(values, k, axis=0)[0] for k in (1, 2, 3))
        value = [
            values[0] - k * one + k * (k + 1) / 2 * two - k * (k + 1) * (k + 2) / 6 * three
            for k in (1, 2, 3, 4)
        ]
        rates = [(1.5 * value[k] - 2.0 * value[k + 1] + 0.5 * value[k + 2]) / step for k in (0, 1)]
        return cls(value[0], value[1], rates[0], rates[1])

    def rate_of(self, now: Array, step: float) -> Array:
        """Rate that a value now would have."""
        return np.asarray((1.5 * now - 2.0 * self.value + 0.5 * self.before) / step)

    def acceleration_of(self, rate: Array, step: float) -> Array:
        """Acceleration that a rate now would have."""
        return np.asarray((1.5 * rate - 2.0 * self.rate + 0.5 * self.rate_before) / step)

    def then(self, now: Array, step: float) -> History:
        """Go on by one step."""
        return History(now.copy(), self.value, self.rate_of(now, step), self.rate)


class Walk:
    """The whisker, step by step."""

    def __init__(
        self,
        whisker: Whisker,
        chain: Chain,
        surfaces: Sequence[Surface],
        damping_ratio: float,
        stiffness: float,
        friction: float,
        step: float,
    ) -> None:
        self._chain, self._surfaces, self._step = chain, surfaces, step
        self._friction = friction
        self._stiffness = [
            solid.stiffness if np.isfinite(solid.stiffness) else stiffness for solid in surfaces
        ]
        first = 2.0 * np.pi * frequencies(chain, 1)[0]
        self._damping = 2.0 * damping_ratio / float(first)
        self._state = State(chain)
        t = np.arange(_PARTS) / _PARTS
        n = chain.nodes.size - 1
        self._segment = np.append(np.repeat(np.arange(n), _PARTS), n - 1)
        self._part = np.append(np.tile(t, n), 1.0)
        self._arc = chain.nodes[self._segment] + self._part * np.diff(chain.nodes)[self._segment]
        self._radius = whisker.radius(np.minimum(self._arc, whisker.length))
        self._weights = bezier(self._part)
        self._links: IntArray = np.arange(n + 1) + (1 if chain.soft_base else 0)
        self._theta = self._masses = self._controls = History.still(np.zeros(1))

    def begin(self, rotations: Array, places: Array) -> bool:
        """Begin unbent, moved along by the first placements (4, ...), if nothing is in the way.

        Otherwise begin unbent and still. Tell whether it was free.
        """
        state, rest = self._state, self._chain.rest
        state.move(rest, rotations[0], places[0])
        free = not self._contacts()
        self._theta = History.still(rest)
        self._masses, self._controls = History.still(state.masses), History.still(state.controls)
        if free:
            masses, controls = [], []
            for rotation, place in zip(rotations, places, strict=True):
                state.move(rest, rotation, place)
                masses.append(state.masses)
                controls.append(state.controls)
            self._masses = History.before_first(np.array(masses), self._step)
            self._controls = History.before_first(np.array(controls), self._step)
        return free

    def step(self, rotation: Array, base: Array) -> Moment:
        """Go on by one step, to a placement of the base."""
        chain, state = self._chain, self._state
        h, theta = self._step, self._theta.value.copy()
        rate = 1.5 / h
        spring = chain.stiffness * (1.0 + self._damping * rate)
        pull = np.zeros_like(state.masses)
        touching: list[tuple[Contact, Array, bool]] = []
        for rounds in range(_ROUNDS):
            state.move(theta, rotation, base)
            speed = self._masses.rate_of(state.masses, h)
            pull = chain.mass[:, None] * self._masses.acceleration_of(speed, h)
            inertia(
                state.masses,
                chain.mass,
                chain.mass_link,
                pull,
                state.pivots,
                state.turns,
                state.residual,
                state.matrix,
            )
            turning = self._theta.rate_of(theta, h)
            elastic = chain.stiffness * (theta - chain.rest + self._damping * turning)
            residual: Array = state.residual + elastic.ravel()
            matrix = rate**2 * state.matrix
            matrix[np.diag_indices_from(matrix)] += spring.ravel()
            # Near sticking Newton's method overshoots, where the secant of friction does not.
            eager = rounds < _EAGER
            touching = [
                self._push(contact, residual, matrix, eager) for contact in self._contacts()
            ]
            if self._friction > 0.0 and touching:
                residual[:] = np.linalg.solve(matrix, residual)
            else:
                solve_definite(matrix, residual)
            change = residual.reshape(theta.shape)
            largest = float(np.abs(change).max())
            theta -= change * min(1.0, _MOST_TURNED / max(largest, 1e-300))
            if largest < _TURNED:
                break
        self._theta = self._theta.then(theta, h)
        self._masses = self._masses.then(state.masses, h)
        self._controls = self._controls.then(state.controls, h)
        return self._felt(base, pull, touching)

    def _contacts(self) -> list[Contact]:
        """Where the whisker touches."""
        found = []
        controls = self._state.controls
        line = np.einsum("kc,kci->ki", self._weights, controls[self._segment])
        for number, solid in enumerate(self._surfaces):
            away = solid.signed_distance(line)
            near = away < self._radius + _NEAR
            if not near.any():
                continue
            inner = np.concatenate([[np.inf], away, [np.inf]])
            dips = (inner[1:-1] < inner[:-2]) & (inner[1:-1] <= inner[2:]) & near
            for dip in np.flatnonzero(dips).tolist():
                contact = self._nearest(number, dip)
                if contact.gap < 0.0:
                    found.append(contact)
        return found

    def _nearest(self, number: int, dip: int) -> Contact:
        """The minimum of the distance near a sample."""
        at = np.clip(self._segment[dip] + self._part[dip] + _ZOOM, 0.0, self._chain.nodes.size - 1)
        away = self._away(number, at)
        i = int(np.argmin(away))
        if 0 < i < at.size - 1:
            bend = away[i - 1] - 2.0 * away[i] + away[i + 1]
            lean = 0.5 * (away[i + 1] - away[i - 1])
            part = -lean / bend if bend > 0.0 else 0.0
            best = float(at[i] + np.clip(part, -1.0, 1.0) * (at[i + 1] - at[i]))
        else:
            best = float(at[i])
        segment = min(int(best), self._chain.nodes.size - 2)
        weights = bezier(np.array(best - segment))
        place = weights @ self._state.controls[segment]
        distance, normal, _ = self._surfaces[number].local_geometry(place)
        nodes = self._chain.nodes
        arc = nodes[segment] + (best - segment) * (nodes[segment + 1] - nodes[segment])
        radius = float(np.interp(arc, self._arc, self._radius))
        return Contact(number, float(arc), segment, weights, place, distance - radius, normal)

    def _away(self, number: int, at: Array) -> Array:
        """Distances of the centreline from an object, at segments and fractions of them."""
        segment = np.minimum(at.astype(int), self._chain.nodes.size - 2)
        place = np.einsum("kc,kci->ki", bezier(at - segment), self._state.controls[segment])
        return self._surfaces[number].signed_distance(place)

    def _push(
        self, contact: Contact, residual: Array, matrix: Array, eager: bool
    ) -> tuple[Contact, Array, bool]:
        """Add a contact's force, and how it changes, to the equations."""
        state, segment = self._state, contact.segment
        links = self._links[[segment, segment, segment + 1]]
        points = state.controls[segment]
        moves = jacobian(points, links, contact.weights, state.pivots, state.turns)
        stiffness = self._stiffness[contact.surface]
        normal, pressing = contact.normal, -stiffness * contact.gap
        force = pressing * normal
        across = normal @ moves
        matrix += stiffness * np.outer(across, across)
        sliding = True
        if self._friction > 0.0:
            rates = self._controls.rate_of(state.controls, self._step)[segment]
            speed = contact.weights @ rates
            speed = speed - (speed @ normal) * normal
            fast = float(np.sqrt(speed @ speed + _CREEP**2))
            hold = self._friction * pressing / fast
            force = force - hold * speed
            rate = 1.5 / self._step * hold
            sliding = bool(np.linalg.norm(speed) > _CREEP)
            flat = moves - np.outer(normal, across)
            along = (speed / fast) @ flat
            matrix += rate * flat.T @ flat
            if eager:
                matrix -= rate * np.outer(along, along)
            matrix -= self._friction * stiffness * np.outer(along, across)
        residual -= force @ moves
        return contact, force, sliding

    def _felt(
        self, base: Array, pull: Array, touching: Sequence[tuple[Contact, Array, bool]]
    ) -> Moment:
        """What the base feels, and where the whisker is."""
        force = -pull.sum(axis=0)
        moment = -np.cross(self._state.masses - base, pull).sum(axis=0)
        for contact, push, _ in touching:
            force = force + push
            moment = moment + np.cross(contact.place - base, push)
        ordered = sorted(touching, key=lambda one: -float(np.linalg.norm(one[1])))
        return Moment(
            force=force,
            moment=moment,
            controls=self._state.controls.copy(),
            nodes=self._chain.nodes,
            contacts=tuple(contact for contact, _, _ in ordered),
            contact_force=ordered[0][1] if ordered else np.full(3, np.nan),
            sliding=bool(ordered and ordered[0][2]),
        )
