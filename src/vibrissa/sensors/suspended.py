"""Model of a whisker on a compliant suspension whose base motion is measured.

Typically a Hall sensor measures the motion of a magnet at the base. The contact force F and its
moment M about a pivot rotate the base by θ and shift it by u:

    θ = c_r M,    u = c_t F,    p = o + b + u + exp(θ) (D x − b),

where x(ξ), ξ = (s, f_y, f_z), is the contact point of the rod in the frame of its base section; o
is the base, o + b the pivot and D the orientation of the base at rest, in the sensor's frame. Each
channel reads

    y = w · φ,    φ = (1, θ, u / L, θ_i θ_j),

as the field of a magnet is not linear in its rotation and shift. The force is normal to the whisker
or, with friction µ, has the component µ |f| along it towards the tip. All equations are explicit in
ξ: the suspension does not affect the equations of the rod, and a compliant base costs no more than
a rigid one.

Internally, lengths are in units of L, forces of EI/L² and moments of EI/L. Readings determine the
compliances only relative to the whisker's stiffness; their SI values presume its stated modulus.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import transform
from vibrissa.numerics import AnyArray, Array, cross_matrix, exponential, numbers
from vibrissa.rod import discretize, solve_forces
from vibrissa.sensors.regression import ThinPlate
from vibrissa.status import Status
from vibrissa.whisker import Whisker

# Features of the base's motion that channels combine: rotation, rad, and shift in units of L.
FEATURES = (
    "1",
    *(f"θ{a}" for a in "xyz"),
    *(f"u{a}" for a in "xyz"),
    *(f"θ{a}θ{b}" for i, a in enumerate("xyz") for b in "xyz"[i:]),
)
_PAIRS = np.triu_indices(3)
# Steps of the path from rest to a contact, and Newton iterations after each step and the last.
_STEPS, _ROUNDS, _LAST_ROUNDS = 16, 4, 12
_SOLVED = 1e-8  # largest distance from the point, in units of L, of a solved contact
_MOST_ARC, _MOST_FORCE = 0.1, 3.0  # largest Newton steps of s, in L, and of the force, in EI/L²
_LEAST_ARC = 0.01  # smallest arc length of a contact, in units of L
_SMALL = 1e-6  # step of finite differences


class Touches(NamedTuple):
    """Contacts of a suspended whisker, non-dimensional: points and forces in the sensor's frame.

    Features describe the motion of the base (`FEATURES`); slopes are derivatives with respect to
    ξ = (s, f_y, f_z).
    """

    points: Array
    features: Array
    force: Array
    point_slopes: Array
    feature_slopes: Array


@dataclass(frozen=True, eq=False)
class SuspendedWhisker:
    """A whisker on a compliant suspension, with channels that measure the motion of its base.

    Parameters
    ----------
    whisker : Whisker
        Whisker; its pose is that of the base at rest in the sensor's frame.
    rotation_compliance : float
        Rotation of the base per moment about the pivot, rad/(N·m).
    shift_compliance : float
        Shift of the base per force, m/N.
    pivot : array_like (3,)
        Pivot relative to the base, sensor frame, m.
    friction : float
        Ratio of the force along the whisker, towards the tip, to the normal force at contacts.
    channels : sequence of str
        Names of the channels.
    readout : array_like (k, 13), optional
        Weights of `FEATURES` in each channel, in the channel's unit.
    noise : array_like (k,)
        Standard deviation of the model's error of a reading, most of which is the same in
        neighbouring contacts.
    residual : ThinPlate, optional
        Correction of the readings as a function of the contact point, m, sensor frame.
    drift : float or array_like (k,)
        Standard deviation of the change of readings from one recording to the next.
    """

    whisker: Whisker
    rotation_compliance: float
    shift_compliance: float
    pivot: Any = (0.0, 0.0, 0.0)
    friction: float = 0.0
    channels: tuple[str, ...] = ()
    readout: Any = field(default_factory=lambda: np.zeros((0, len(FEATURES))))
    noise: Any = ()
    residual: ThinPlate | None = None
    drift: Any = 0.0

    def __post_init__(self) -> None:
        k = len(self.channels)
        if np.size(self.drift) < 2:
            object.__setattr__(self, "drift", np.full(k, np.sum(self.drift)))
        shapes = {"pivot": (3,), "readout": (k, len(FEATURES)), "noise": (k,), "drift": (k,)}
        for name, shape in shapes.items():
            value = numbers(name, getattr(self, name))
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{name} has shape {value.shape}; finite {shape} is needed")
            object.__setattr__(self, name, value)
        for name in ("rotation_compliance", "shift_compliance"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} is {getattr(self, name)!r}; it must not be negative")

    @property
    def length(self) -> float:
        """Unit of length, m."""
        return self.whisker.length

    @property
    def uncertainty(self) -> Array:
        """Standard deviation (k,) of readings in a recording other than the calibration."""
        return np.asarray(np.hypot(self.noise, self.drift), dtype=np.float64)

    def touches(self, contacts: Array) -> Touches:
        """Contact points and base motions of known contacts, with derivatives.

        Parameters
        ----------
        contacts : (n, 3) array
            Contacts ξ = (s, f_y, f_z) over L and EI/L².

        Returns
        -------
        Touches
            Points and features of the contacts.
        """
        d = discretize(self.whisker)
        value, slope = self._rod(contacts)
        turn, pivot = self.whisker.pose.rotation, np.asarray(self.pivot) / d.length
        rotation, shift = self.rotation_compliance * d.moment, self.shift_compliance * d.force
        force, arm = value[:, :3] @ turn.T, value[:, 3:] @ turn.T - pivot
        d_force, d_arm = turn @ slope[:, :3], turn @ slope[:, 3:]
        angle = rotation * np.cross(arm, force)
        d_angle = rotation * (cross_matrix(arm) @ d_force - cross_matrix(force) @ d_arm)
        turned, mean = exponential(angle)
        spin = np.swapaxes(mean, 1, 2) @ d_angle
        pull = (turned @ force[:, :, None])[:, :, 0]
        d_pull = turned @ (d_force - cross_matrix(force) @ spin)
        base = self.whisker.pose.origin / d.length + pivot
        point = base + shift / d.length * pull + (turned @ arm[:, :, None])[:, :, 0]
        d_point = shift / d.length * d_pull + turned @ (d_arm - cross_matrix(arm) @ spin)
        i, j = _PAIRS
        n = len(contacts)
        features = (np.ones((n, 1)), angle, shift / d.length * pull, angle[:, i] * angle[:, j])
        product = d_angle[:, i] * angle[:, j, None] + angle[:, i, None] * d_angle[:, j]
        slopes = (np.zeros((n, 1, 3)), d_angle, shift / d.length * d_pull, product)
        return Touches(
            point, np.concatenate(features, axis=1), pull, d_point, np.concatenate(slopes, axis=1)
        )

    def _rod(self, contacts: Array) -> tuple[Array, Array]:
        """Force and point (n, 6) of the rod in its base frame, and their derivatives by ξ."""
        d = discretize(self.whisker)
        size = np.hypot(contacts[:, 1], contacts[:, 2])
        along = self.friction * size
        full = np.concatenate([contacts[:, :1], along[:, None], contacts[:, 1:]], axis=1)
        value, slope = solve_forces(d, full, tangents=True)
        if self.friction:
            ahead, _ = solve_forces(d, full + np.array([0.0, _SMALL, 0.0, 0.0]))
            unit = self.friction * contacts[:, 1:] / np.maximum(size, 1e-12)[:, None]
            slope[:, :, 1:] += ((ahead - value) / _SMALL)[:, :, None] * unit[:, None, :]
        return value, slope

    def solve(self, points: ArrayLike, start: Array | None = None) -> tuple[Array, AnyArray]:
        """Solve for the contacts at known points.

        Parameters
        ----------
        points : array_like (n, 3)
            Contact points, sensor frame, m.
        start : (n, 3) array, optional
            Nearby contacts ξ; by default contacts are followed from rest.

        Returns
        -------
        contacts : (n, 3) array
            Contacts ξ, non-dimensional.
        statuses : (n,) int array
            `Status` of each: ``OK``, or ``BEYOND_FOLD`` if there is no equilibrium with this
            friction.
        """
        target = numbers("points", points) / self.length
        if start is None:
            contacts, miss = self._from_rest(target)
        else:
            contacts, miss = self._newton(target, start, _LAST_ROUNDS)
            lost = np.flatnonzero(~(miss < _SOLVED))
            if lost.size:
                contacts[lost], miss[lost] = self._from_rest(target[lost])
        statuses = np.where(miss < _SOLVED, int(Status.OK), int(Status.BEYOND_FOLD))
        return contacts, statuses

    def _from_rest(self, target: Array) -> tuple[Array, Array]:
        """Follow contacts from the resting whisker by rotating their radius vector in steps."""
        base = self.whisker.pose.origin / self.length
        s = np.linspace(2.0 * _LEAST_ARC, 1.0, 400)
        rest = self.whisker.pose.vectors_to_source(self.whisker.position(s * self.length))
        rest = rest / self.length
        radius = np.linalg.norm(target - base, axis=1)
        nearest = np.abs(np.linalg.norm(rest, axis=1) - radius[:, None]).argmin(axis=1)
        a, b = rest[nearest], target - base
        axis = np.cross(a, b)
        size = np.linalg.norm(axis, axis=1)
        axis *= (np.arctan2(size, np.sum(a * b, axis=1)) / np.maximum(size, 1e-12))[:, None]
        a *= (radius / np.linalg.norm(a, axis=1))[:, None]
        contacts = np.stack([s[nearest], 0.0 * radius, 0.0 * radius], axis=1)
        miss = np.full(len(target), np.inf)
        for share in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
            on_path = base + transform.Rotation.from_rotvec(share * axis).apply(a)
            rounds = _ROUNDS if share < 1.0 else _LAST_ROUNDS
            contacts, miss = self._newton(on_path, contacts, rounds)
        return contacts, miss

    def _newton(self, target: Array, contacts: Array, rounds: int) -> tuple[Array, Array]:
        """Solve for contacts at points by Newton's method; also return the distances from these."""
        contacts = contacts.copy()
        for last in (*([False] * rounds), True):
            touch = self.touches(contacts)
            away = touch.points - target
            miss = np.abs(away).max(axis=1)
            if last or (miss < 0.1 * _SOLVED).all():
                break
            regular = np.abs(np.linalg.det(touch.point_slopes)) > 1e-14
            slopes = np.where(regular[:, None, None], touch.point_slopes, np.eye(3))
            step = np.nan_to_num(np.linalg.solve(slopes, away[:, :, None])[:, :, 0])
            most = np.maximum(
                np.abs(step[:, 0]) / _MOST_ARC, np.linalg.norm(step[:, 1:], axis=1) / _MOST_FORCE
            )
            contacts -= step / np.maximum(most, 1.0)[:, None]
            contacts[:, 0] = np.clip(contacts[:, 0], _LEAST_ARC, 1.0)
        return contacts, miss

    def readings(self, touches: Touches) -> tuple[Array, Array]:
        """Readings of contacts, and their derivatives with respect to ξ.

        Parameters
        ----------
        touches : Touches
            Contacts.

        Returns
        -------
        readings : (n, k) array
            Readings without noise.
        slopes : (n, k, 3) array
            Derivatives with respect to ξ.
        """
        weights = np.asarray(self.readout)
        values, slopes = touches.features @ weights.T, weights @ touches.feature_slopes
        if self.residual is not None:
            more, by_point = self.residual(touches.points * self.length)
            values = values + more
            slopes = slopes + by_point @ touches.point_slopes * self.length
        return values, slopes

    def read(self, points: ArrayLike, seed: int | None = None) -> tuple[Array, AnyArray]:
        """Simulate the readings of contacts at known points.

        Parameters
        ----------
        points : array_like (n, 3)
            Contact points, sensor frame, m.
        seed : int, optional
            Seed of the noise; by default no noise is added.

        Returns
        -------
        readings : (n, k) array
            Readings; NaN if there is no equilibrium.
        statuses : (n,) int array
            `Status` of each contact.
        """
        contacts, statuses = self.solve(points)
        values, _ = self.readings(self.touches(contacts))
        if seed is not None:
            values = values + np.random.default_rng(seed).normal(size=values.shape) * self.noise
        return np.where((statuses == int(Status.OK))[:, None], values, np.nan), statuses
