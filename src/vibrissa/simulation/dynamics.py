"""Dynamic simulation of a whisker: collisions, vibration, and bending by its own inertia.

The chain of :mod:`vibrissa.simulation.chain` obeys d'Alembert's principle: for every δθ

    Σ m δx·ẍ + δθ·(K (θ - θ₀) + η K θ̇) = Σ δp·F,

where x are the point masses, p the contacts, and η = 2 ζ/ω₁ is a material damping that gives the
first vibration mode the damping ratio ζ (that of higher modes is larger in proportion to their
frequency). The base moves along a spline through its poses in the frames. Initially the whisker
moves with the base without bending or, if an object is in its way, settles against it with the base
at rest. Velocities and accelerations are second-order backward differences (BDF2) of positions in
the laboratory frame. The step is implicit, solved by Newton's method, and stable for any stiffness;
vibrations too fast for the step decay.

An object is touched where the distance of the smooth centreline from its surface has a minimum
below the whisker's radius. The normal force is proportional to the indentation, with the stiffness
of the object or, for a rigid one, a stiffness that keeps the indentation at micrometres. Friction
is µ times this force, opposite to the sliding velocity of the whisker's material.

The wrench at the base is that of the objects minus the rate of change of the masses' momentum.

`inertial_wrench` computes the part of the wrench due to inertia and damping for known contact
points: the chain is moved at its base and slides without friction through a given point of the
laboratory frame during contact, and vibrates freely otherwise. A chain without mass and damping
through the same points gives the static wrench; the difference is the inertial part. The
discretisation error of the chain, of second order in the length of links, cancels largely.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vibrissa.deferred import interpolate, linalg, transform
from vibrissa.numerics import AnyArray, Array, IntArray, contacts_in, exponential
from vibrissa.objects import Surface
from vibrissa.simulation.chain import Chain, bezier, configure, inertia, jacobian
from vibrissa.simulation.motion import Motion
from vibrissa.whisker import Whisker

Progress = Callable[[int, int], None]

# Density of a rat's whisker at base and tip, kg/m³ (Yang et al. 2019).
DENSITY = (1220.0, 1632.0)
# Damping ratio of the first mode: the middle of 0.11 to 0.17 (Hartmann et al. 2003).
DAMPING_RATIO = 0.14
# Time for which the base is initially at rest, if the resting whisker intersects an object, s.
_SETTLE = 0.06
_MOST_DAMPED = 2.0  # largest damping ratio; a larger value is taken for a percentage
_LIGHTEST = 10.0  # smallest density, that of a foam, kg/m³
_AT_ONCE = 4096  # number of steps whose base poses are computed together
_EAGER = 8  # number of iterations with the full derivative of friction, before its secant
_MOST_TURNED = 0.3  # largest rotation of a joint in one iteration, rad
_PARTS = 4  # number of samples of the distance from objects on each segment
_NEAR = 1e-4  # gap below which a minimum of the distance is refined, m
_ZOOM = np.linspace(-1.0, 1.0, 9) / _PARTS  # offsets at which a minimum is refined, in segments
_CREEP = 1e-3  # speed below which friction is regularised, m/s
_RIGID = 200.0  # stiffness of rigid objects, which are indented by micrometres, N/m


@dataclass(frozen=True)
class Dynamics:
    """Inertia and damping of a whisker, and parameters of its dynamic simulation.

    Parameters
    ----------
    density : tuple of float
        Density at base and tip, kg/m³.
    damping_ratio : float
        Damping ratio of the first vibration mode.
    segments : int
        Number of segments of the whisker, more than three.
    step : float
        Longest time step, s.
    """

    density: tuple[float, float] = DENSITY
    damping_ratio: float = DAMPING_RATIO
    segments: int = 32
    step: float = 1e-4

    def __post_init__(self) -> None:
        numbers = {
            "density": min(self.density) if np.shape(self.density) == (2,) else np.nan,
            "segments": self.segments - 3,
            "step": self.step,
        }
        faults = [
            f"{name} is {getattr(self, name)!r}; it must be positive"
            + (", more than three" if name == "segments" else "")
            for name, value in numbers.items()
            if not (np.isfinite(value) and value > 0.0)
        ]
        if not 0.0 <= self.damping_ratio <= _MOST_DAMPED:
            faults.append(
                f"damping_ratio is {self.damping_ratio!r}; 0 to {_MOST_DAMPED:g} (14 % is 0.14)"
            )
        # A density in g/cm³ would be a thousandth of that in kg/m³.
        if not faults and min(self.density) < _LIGHTEST:
            faults.append(f"density is {self.density!r}; it is in kg/m³: 1 g/cm³ is 1000")
        if faults:
            raise ValueError("the dynamics are not valid: " + "; ".join(faults))


def resonances(whisker: Whisker, dynamics: Dynamics | None = None, count: int = 3) -> Array:
    """Lowest resonance frequencies (count,) of a whisker held at its base only, Hz."""
    dynamics = dynamics or Dynamics()
    return frequencies(Chain.of(whisker, dynamics.density, dynamics.segments), count)


def move_dynamically(
    whisker: Whisker,
    surfaces: Sequence[Surface],
    motion: Motion,
    dynamics: Dynamics,
    *,
    friction: float = 0.0,
    progress: Progress | None = None,
) -> list[Moment]:
    """Simulate the motion of a whisker among objects; return its state in every frame."""
    chain = Chain.of(whisker, dynamics.density, dynamics.segments)
    frame = float(np.diff(motion.time).min())
    parts = int(np.ceil(frame / dynamics.step * (1.0 - 1e-9)))
    walk = Walk(
        whisker,
        chain,
        surfaces,
        damping_time(chain, dynamics.damping_ratio),
        [s.stiffness if np.isfinite(s.stiffness) else _RIGID for s in surfaces],
        friction,
        frame / parts,
    )
    path = Path(motion.time, motion.base_rotation, motion.base_position, frame / parts)
    if not walk.begin(*path.at(np.arange(4))):
        still = path.at(np.zeros(1, dtype=int))
        for _ in range(int(np.ceil(_SETTLE / path.step))):
            walk.step(still[0][0], still[1][0])
    moments: list[Moment] = []
    for first in range(0, path.count, _AT_ONCE):
        numbers = np.arange(first, min(first + _AT_ONCE, path.count))
        for number, rotation, place in zip(numbers.tolist(), *path.at(numbers), strict=True):
            moment = walk.step(rotation, place)
            if number in path.frames:
                moments.append(moment)
                if progress is not None:
                    progress(len(moments), len(motion))
    return moments


class Path:
    """Poses of the base at equal time steps, by a spline through the frames."""

    def __init__(self, time: Array, rotation: Array, position: Array, step: float) -> None:
        time = time - time[0]
        self._turn = transform.RotationSpline(time, transform.Rotation.from_matrix(rotation))
        self._shift = interpolate.CubicSpline(time, position, axis=0)
        self._last = float(time[-1])
        self.step, self.count = step, round(time[-1] / step) + 1
        self.frames = set(np.round(time / step).astype(int).tolist())

    def at(self, numbers: IntArray) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and positions (n, 3) of the base at steps."""
        time = np.minimum(numbers * self.step, self._last)
        return self._turn(time).as_matrix(), self._shift(time)


class Contact(NamedTuple):
    """Contact of the centreline with an object.

    Attributes are the index of the object, the arc length, the segment with the weights (3,) of its
    control points, the point on the centreline, the (negative) gap and the object's normal.
    """

    surface: int
    arc_length: float
    segment: int
    weights: Array
    point: Array
    gap: float
    normal: Array


@dataclass(frozen=True, eq=False)
class Moment:
    """State of the whisker in one frame and its wrench at the base, laboratory frame, SI units.

    ``contact_force`` and ``sliding`` are those of the strongest contact, which comes first.
    """

    force: Array
    moment: Array
    controls: Array
    nodes: Array
    contacts: tuple[Contact, ...]
    contact_force: Array
    sliding: bool

    def centerline(self, n: int) -> Array:
        """Points (n, 3) of the centreline, equally spaced in arc length."""
        s = np.linspace(0.0, self.nodes[-1], n)
        segment = np.clip(np.searchsorted(self.nodes, s) - 1, 0, self.nodes.size - 2)
        part = (s - self.nodes[segment]) / np.diff(self.nodes)[segment]
        return np.asarray(np.einsum("kc,kci->ki", bezier(part), self.controls[segment]))


def frequencies(chain: Chain, count: int) -> Array:
    """Lowest resonance frequencies (count,) of a chain clamped at its base, Hz."""
    slow, _ = slowest(at_rest(chain), count)
    return np.asarray(1.0 / np.sqrt(slow) / (2.0 * np.pi))


def slowest(state: State, count: int) -> tuple[Array, Array]:
    """Inverse squares (count,) of the lowest angular frequencies, and their modes (n, count)."""
    # The stiffness is regular; the mass need not be, as twist of a straight whisker moves no mass.
    stiffness = state.chain.stiffness.ravel()
    which = [stiffness.size - count, stiffness.size - 1]
    slow, modes = linalg.eigh(state.matrix, np.diag(stiffness), subset_by_index=which)
    return slow[::-1], modes[:, ::-1]


def damping_time(chain: Chain, ratio: float) -> float:
    """Time constant η of material damping that gives the first mode a damping ratio, s."""
    return ratio / (np.pi * float(frequencies(chain, 1)[0]))


def at_rest(chain: Chain) -> State:
    """State of a chain at rest, with its mass matrix."""
    state = State(chain)
    state.move(chain.rest, np.eye(3), np.zeros(3))
    state.accelerate(np.zeros_like(state.masses))
    return state


class State:
    """Current state of the links; its arrays are overwritten in every iteration."""

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
        """Set the joint rotations θ (m, 3) and the pose of the base."""
        chain = self.chain
        configure(
            *exponential(theta),
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

    def accelerate(self, pull: Array) -> None:
        """Fill the generalised forces of ``pull`` (k, 3) on the masses, and the mass matrix."""
        mass, link = self.chain.mass, self.chain.mass_link
        joints = self.pivots, self.turns
        inertia(self.masses, mass, link, pull, *joints, self.residual, self.matrix)


class History(NamedTuple):
    """Values and rates of change of one quantity in the last two steps."""

    value: Array
    before: Array
    rate: Array
    rate_before: Array

    @classmethod
    def still(cls, value: Array) -> History:
        """History of a constant."""
        zero = np.zeros_like(value)
        return cls(value.copy(), value.copy(), zero, zero)

    @classmethod
    def before_first(cls, values: Array, step: float) -> History:
        """History at the first of four values (4, ...), extrapolated backward by a cubic."""
        # Newton's formula with the differences of the first four values.
        one, two, three = (np.diff(values, k, axis=0)[0] for k in (1, 2, 3))
        value = [
            values[0] - k * one + k * (k + 1) / 2 * two - k * (k + 1) * (k + 2) / 6 * three
            for k in (1, 2, 3, 4)
        ]
        rates = [(1.5 * value[k] - 2.0 * value[k + 1] + 0.5 * value[k + 2]) / step for k in (0, 1)]
        return cls(value[0], value[1], rates[0], rates[1])

    def rate_of(self, now: Array, step: float) -> Array:
        """Rate of change at the new value."""
        return np.asarray((1.5 * now - 2.0 * self.value + 0.5 * self.before) / step)

    def acceleration_of(self, rate: Array, step: float) -> Array:
        """Acceleration at the new rate."""
        return np.asarray((1.5 * rate - 2.0 * self.rate + 0.5 * self.rate_before) / step)

    def then(self, now: Array, step: float) -> History:
        """History after one more step, with the new value."""
        return History(now.copy(), self.value, self.rate_of(now, step), self.rate)


class Walk:
    """Time integration of a whisker among objects."""

    turned = 1e-9
    """Largest rotation of a joint in the last iteration of a step, rad."""

    rounds = 60
    """Largest number of Newton iterations in a step."""

    def __init__(
        self,
        whisker: Whisker,
        chain: Chain,
        surfaces: Sequence[Surface],
        damping: float,
        stiffness: Sequence[float],
        friction: float,
        step: float,
    ) -> None:
        self._chain, self._surfaces, self._step = chain, surfaces, step
        self._friction, self._damping, self._stiffness = friction, damping, stiffness
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
        """Set the initial state from the first four poses of the base; return whether it is free.

        If the unbent whisker touches no object, it starts unbent and moving with the base;
        otherwise it starts unbent and at rest.
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
        """Advance by one step to a new pose of the base."""
        chain, state = self._chain, self._state
        h, theta = self._step, self._theta.value.copy()
        rate = 1.5 / h
        spring = chain.stiffness * (1.0 + self._damping * rate)
        pull = np.zeros_like(state.masses)
        touching: list[tuple[Contact, Array, bool]] = []
        lost = regained = False
        for rounds in range(self.rounds):
            state.move(theta, rotation, base)
            speed = self._masses.rate_of(state.masses, h)
            pull = chain.mass[:, None] * self._masses.acceleration_of(speed, h)
            state.accelerate(pull)
            turning = self._theta.rate_of(theta, h)
            elastic = chain.stiffness * (theta - chain.rest + self._damping * turning)
            residual: Array = state.residual + elastic.ravel()
            matrix = rate**2 * state.matrix
            matrix[np.diag_indices_from(matrix)] += spring.ravel()
            # Near sticking, Newton's method overshoots; the secant of friction does not.
            eager = rounds < _EAGER
            before = bool(touching)
            touching = [
                self._push(contact, residual, matrix, eager) for contact in self._contacts()
            ]
            # Where a contact slides off, full steps may alternate between too much force and none.
            lost |= before and not touching
            regained |= lost and bool(touching)
            change = np.linalg.solve(matrix, residual).reshape(theta.shape)
            largest = float(np.abs(change).max())
            share = 0.5 if regained and touching else 1.0
            theta -= change * min(share, _MOST_TURNED / max(largest, 1e-300))
            if largest < self.turned:
                break
        self._theta = self._theta.then(theta, h)
        self._masses = self._masses.then(state.masses, h)
        self._controls = self._controls.then(state.controls, h)
        return self._moment(base, pull, touching)

    def _contacts(self) -> list[Contact]:
        """Contacts of the whisker with all objects."""
        contacts = []
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
                    contacts.append(contact)
        return contacts

    def _nearest(self, number: int, dip: int) -> Contact:
        """Contact at the refined minimum of the distance near a sample."""
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
        """Distances of the centreline from an object, at positions in (fractional) segments."""
        segment = np.minimum(at.astype(int), self._chain.nodes.size - 2)
        place = np.einsum("kc,kci->ki", bezier(at - segment), self._state.controls[segment])
        return self._surfaces[number].signed_distance(place)

    def _push(
        self, contact: Contact, residual: Array, matrix: Array, eager: bool
    ) -> tuple[Contact, Array, bool]:
        """Add a contact's force and its derivative to the equations; return force and sliding."""
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
            drag = self._friction * pressing / fast
            force = force - drag * speed
            rate = 1.5 / self._step * drag
            sliding = bool(np.linalg.norm(speed) > _CREEP)
            flat = moves - np.outer(normal, across)
            along = (speed / fast) @ flat
            matrix += rate * flat.T @ flat
            if eager:
                matrix -= rate * np.outer(along, along)
            matrix -= self._friction * stiffness * np.outer(along, across)
        residual -= force @ moves
        return contact, force, sliding

    def _moment(
        self, base: Array, pull: Array, touching: Sequence[tuple[Contact, Array, bool]]
    ) -> Moment:
        """Wrench at the base, and shape of the whisker."""
        force = -pull.sum(axis=0)
        moment = -np.cross(self._state.masses - base, pull).sum(axis=0)
        for contact, push, _ in touching:
            force = force + push
            moment = moment + np.cross(contact.point - base, push)
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


# Parameters of `inertial_wrench`.
_SEGMENTS = 16  # number of segments of the chains
_STEP = 0.4  # longest time step, in radians of the first vibration mode
_HOLD = 5e3  # stiffness of the constraint at the point, in units of EI/L³ at the base
_WEIGHTLESS = 1e-6  # mass of the massless chain, relative to that of the whisker
_PROXIMAL = 0.02  # smallest arc length of the constraint, in units of L


def inertial_wrench(
    whisker: Whisker,
    dynamics: Dynamics,
    time: Array,
    rotation: Array,
    position: Array,
    points: Array,
    arc_length: Array,
    most: float = np.inf,
) -> tuple[Array, Array]:
    """Parts of the wrench (n, 6) and the contact force (n, 3) due to inertia, base frame, SI units.

    Both include damping. The contact force is zero without contact. The centreline is constrained
    to pass through ``points`` (n, 3), laboratory frame, NaN without contact; of ``arc_length`` (n,)
    only the value in the first frame of a contact is used. Where the massless chain would need a
    force above ``most``, the point is replaced by that of the nearest other frame; if this does not
    suffice, the contact ends there.
    """
    frame = float(time[-1] - time[0]) / (len(time) - 1)
    chain = Chain.of(whisker, dynamics.density, _SEGMENTS)
    parts = int(np.ceil(frame * 2.0 * np.pi * float(frequencies(chain, 1)[0]) / _STEP))
    damping = damping_time(chain, dynamics.damping_ratio)
    light = Chain.of(whisker, (_WEIGHTLESS * dynamics.density[0],) * 2, _SEGMENTS)
    still = Path(time, rotation, position, frame)
    for instead in (_nearest, _until, None):
        resting, force = _Held(whisker, light, 0.0, frame).wrench(still, points, arc_length)
        wrong = np.linalg.norm(force, axis=1) > most
        if instead is None or not wrong.any():
            break
        points = instead(points, wrong)
    path = Path(time, rotation, position, frame / parts)
    moving, pushed = _Held(whisker, chain, damping, path.step).wrench(path, points, arc_length)
    return moving - resting, pushed - force


def _nearest(points: Array, wrong: AnyArray) -> Array:
    """Replace the points of wrong frames by those of the nearest other frames."""
    right = np.flatnonzero(np.isfinite(points).all(axis=1) & ~wrong)
    if not right.size:
        return np.full_like(points, np.nan)
    out = points.copy()
    for row in np.flatnonzero(wrong):
        out[row] = points[right[np.argmin(np.abs(right - row))]]
    return out


def _until(points: Array, wrong: AnyArray) -> Array:
    """Remove the points of contacts from their first wrong frame on."""
    out = points.copy()
    for row in range(len(points)):
        if wrong[row] or (row and np.isfinite(points[row - 1]).all() and np.isnan(out[row - 1, 0])):
            out[row] = np.nan
    return out


class _Held(Walk):
    """Chain constrained to slide through one point."""

    turned = 1e-6
    rounds = 12

    def __init__(self, whisker: Whisker, chain: Chain, damping: float, step: float) -> None:
        bending = whisker.youngs_modulus * np.pi / 4.0 * whisker.base_radius**4
        stiffness = _HOLD * bending / whisker.length**3
        super().__init__(whisker, chain, (), damping, (stiffness,), 0.0, step)
        self._point: Array | None = None
        self._at = 0.0

    def wrench(self, path: Path, points: Array, arc_length: Array) -> tuple[Array, Array]:
        """Wrench (n, 6) and constraint force (n, 3) in every frame, base frame."""
        parts = (path.count - 1) // (len(points) - 1)
        turns, places = path.at(np.arange(path.count))
        # Between frames of one contact the point is interpolated.
        time = np.arange(path.count) / parts
        first, share = time.astype(int), np.arange(path.count) % parts
        held = np.full((path.count, 3), np.nan)
        for begun, end in contacts_in(~np.isnan(points[:, 0])):
            steps = slice(parts * begun, parts * (end - 1) + 1)
            held[steps] = points[begun]
            if end - begun > 1:
                frames = np.arange(begun, end)
                held[steps] = interpolate.CubicSpline(frames, points[begun:end])(time[steps])
        self.begin(turns[:4], places[:4])
        out, force = np.empty((len(points), 6)), np.zeros((len(points), 3))
        for number, (turn, place, point) in enumerate(zip(turns, places, held, strict=True)):
            there = bool(np.isfinite(point).all())
            if there and self._point is None:
                self._at = float(arc_length[first[number]])
            self._point = point if there else None
            moment = self.step(turn, place)
            if share[number] == 0:
                out[first[number]] = np.concatenate([moment.force @ turn, moment.moment @ turn])
                for contact in moment.contacts:
                    force[first[number]] -= self._stiffness[0] * contact.gap * contact.normal @ turn
        return out, force

    def _contacts(self) -> list[Contact]:
        """Constraint at the point, as two contacts in directions across the whisker."""
        if self._point is None:
            return []
        nodes = self._chain.nodes
        for _ in range(3):
            segment = int(np.clip(np.searchsorted(nodes, self._at) - 1, 0, nodes.size - 2))
            part = (self._at - nodes[segment]) / (nodes[segment + 1] - nodes[segment])
            controls = self._state.controls[segment]
            weights = bezier(np.array(part))
            place = weights @ controls
            tangent = (1.0 - part) * (controls[1] - controls[0]) + part * (
                controls[2] - controls[1]
            )
            tangent /= np.linalg.norm(tangent)
            moved = self._at + float((self._point - place) @ tangent)
            self._at = float(np.clip(moved, _PROXIMAL * nodes[-1], nodes[-1]))
        away = place - self._point
        return [
            Contact(0, self._at, segment, weights, place, float(away @ one), one)
            for one in np.linalg.svd(tangent[None])[2][1:]
        ]
