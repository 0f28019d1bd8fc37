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

All samples of a touch in a sweep over objects with a known motion are estimated together
(`follow_sweep`). The unknowns are the contact ξ_k of each sample and the error b_k of the readings,
which changes slowly: the error of the calibrated model and the drift of the sensor. The most
probable values minimise

    Σ w_k |y(ξ_k) + b_k − y_k|² / (ε σ)² + Σ |b_k − a_k b_(k−1)|² / ((1 − a_k²) σ²)
      + Σ (n · Δp_k)² / (ν² ℓ d_k) + Σ |Δp_k − n (n · Δp_k)|² / (τ² ℓ d_k),

where σ is the noise and drift of the sensor, d the motion of the base between samples and Δp the
step of the contact point in the laboratory frame. A contact slides along the surface of the object,
whose normal n is the direction of the force, so that it hardly moves along n. The position of the
first contact need not be known.

Variances refer to the path of the base, so that contacts and covariances do not depend on the
number of samples along it: the variance of steps grows with d, that of b with the distance over
which it changes, and samples less than w₀ apart have reduced weights w = min(1, d / w₀).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import linalg, sparse_linalg, transform
from vibrissa.numerics import (
    AnyArray,
    Array,
    contacts_in,
    cross_matrix,
    exponential,
    numbers,
    rotation_matrices,
)
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


# Standard deviations of the error that varies from sample to sample and of the slowly varying one,
# relative to that of the calibration's residuals.
WHITE, BIAS = 0.5, 1.0
PERSISTENCE = 0.1  # motion of the base over which the slowly varying error changes, m
GRAIN = 0.3e-3  # motion of the base below which samples share their error, m
# Motion of contact points along and across the force, relative to the motion of the base, while the
# base moves by `STRETCH`, m. For three sweeps past a cylinder and a cone, the likelihood is largest
# for 0.2 across the force (of 0.12 to 0.8), and hardly depends on the value along it from 0.006 to
# 0.03.
NORMAL, SLIDING, STRETCH = 0.017, 0.2, 5e-3
_LEAST_STEP = 1e-6  # smallest motion of the base between two samples, in units of L
_FEWEST = 5
_TOUCHED = 4.0  # change of a reading in contact, in standard deviations of noise and drift
_STARTS = (0.45, 0.65, 0.85)
# Largest number of steps, and relative gain at which they end: at 1e-4 the error is up to 0.4 mm.
_SWEEP_ROUNDS, _ENOUGH = 100, 1e-6
_MOST_STEP = 0.1
_SWEEP_LEAST_ARC = 0.05
_HELD = 1e12  # factor on the Hessian's diagonal that fixes an arc length at the end of its range
# Number of shared errors of a touch: offset, slope and curvature over time in three channels.
_SHARED = 9


class SweptContacts(NamedTuple):
    """Contacts along a sweep.

    Attributes
    ----------
    points : (n, 3) array
        Contact points, laboratory frame, m; NaN without contact.
    covariance : (n, 3, 3) array
        Covariances of the points, m².
    normal : (n, 3) array
        Direction of the force on the whisker, laboratory frame, which is the surface normal.
    arc_length : (n,) array
        Arc lengths of the contacts, m.
    in_contact : (n,) bool array
        Whether the whisker is in contact.
    bias : (n, k) array
        Estimated slowly varying errors of the readings, in the units of the channels.
    shared : (m, n, 3) array
        Displacements of all points, m, by one standard deviation of each error that the samples of
        a touch share; the covariance includes them.
    """

    points: Array
    covariance: Array
    normal: Array
    arc_length: Array
    in_contact: AnyArray
    bias: Array
    shared: Array


def follow_sweep(
    sensor: SuspendedWhisker,
    readings: ArrayLike,
    position: ArrayLike,
    rotation: ArrayLike | None = None,
    *,
    rest: ArrayLike | None = None,
) -> SweptContacts:
    """Estimate the contacts during a sweep, with their onset and loss.

    Parameters
    ----------
    sensor : SuspendedWhisker
        Calibrated sensor.
    readings : array_like (n, k)
        Readings of its channels in order of time, at equal or unequal steps.
    position : array_like (n, 3)
        Positions of the sensor's origin in the laboratory frame, m.
    rotation : array_like (3, 3) or (n, 3, 3), optional
        Rotation from the sensor's frame to the laboratory frame; by default the identity.
    rest : array_like (k,) or (n, k), optional
        Readings of the untouched whisker, of each sample if they drift during the sweep; by
        default those of the first sample.

    Returns
    -------
    SweptContacts
        Contact points with covariance, and the surface normal there.
    """
    y = numbers("readings", readings, sensor.channels, any_unit=True)
    base = numbers("position", position)
    k = len(sensor.channels)
    turn = np.eye(3) if rotation is None else rotation_matrices("rotation", rotation)
    if y.ndim != 2 or y.shape[1] != k or base.shape != (len(y), 3) or turn.shape[-2:] != (3, 3):
        raise ValueError(
            f"readings (n, {k}), positions (n, 3) and rotations (3, 3) or (n, 3, 3) are needed; "
            f"got {y.shape}, {base.shape} and {turn.shape}"
        )
    turn = np.broadcast_to(turn, (len(y), 3, 3))
    _check_sweep(sensor, y, base)
    free = y[0] if rest is None else numbers("rest", rest, any_unit=True)
    if free.shape not in ((k,), y.shape):
        raise ValueError(f"rest ({k},) or {y.shape} is needed; got {free.shape}")
    change = y - free
    touching = np.any(np.abs(change) > _TOUCHED * sensor.uncertainty, axis=1)
    n = len(y)
    out = SweptContacts(
        np.full((n, 3), np.nan),
        np.full((n, 3, 3), np.nan),
        np.full((n, 3), np.nan),
        np.full(n, np.nan),
        np.zeros(n, dtype=bool),
        np.full((n, k), np.nan),
        np.zeros((0, n, 3)),
    )
    for first, last in contacts_in(touching):
        if last - first < _FEWEST:
            continue
        rows = slice(first, last)
        touch = _Touch(sensor, change[rows] + sensor.readout[:, 0], base[rows], turn[rows])
        *each, errors = touch.contacts()
        for mine, found in zip(out[:-1], each, strict=True):
            mine[rows] = found
        around = ((0, 0), (first, n - last), (0, 0))
        out = out._replace(shared=np.concatenate([out.shared, np.pad(errors, around)]))
    return out


def _check_sweep(sensor: SuspendedWhisker, readings: Array, base: Array) -> None:
    """Raise ValueError if numbers are missing, or steps are longer than the whisker."""
    if not len(readings):
        raise ValueError("a sweep without samples has no contacts; got 0 readings")
    known = np.isfinite(readings).all(axis=1) & np.isfinite(base).all(axis=1)
    if not known.all():
        which = ", ".join(str(i) for i in np.flatnonzero(~known)[:5])
        raise ValueError(
            f"readings or positions are missing in {(~known).sum()} samples (from 0: {which}): "
            "leave these samples out"
        )
    step = float(np.median(np.linalg.norm(np.diff(base, axis=0), axis=1))) if len(base) > 1 else 0.0
    if step > sensor.whisker.length:
        raise ValueError(
            f"the base moves by {step:.3g} m from one sample to the next, which is more than the "
            f"whisker's length, {sensor.whisker.length:.3g} m: is the unit of the positions right?"
        )


class _State(NamedTuple):
    """Unknowns of all samples, with the resulting model values."""

    contacts: Array
    bias: Array
    touches: Touches
    points: Array
    misfit: Array
    slopes: Array


class _Touch:
    """Estimation problem of the samples of one touch; lengths are in units of the whisker's."""

    def __init__(self, sensor: SuspendedWhisker, readings: Array, base: Array, turn: Array) -> None:
        self.sensor, self.readings, self.turn = sensor, readings, turn
        self.base = base / sensor.length
        noise = sensor.uncertainty
        moved = np.linalg.norm(np.diff(self.base, axis=0), axis=1) + _LEAST_STEP
        apart = np.convolve(np.pad(moved, 1, mode="edge"), [0.5, 0.5], "valid") * sensor.length
        # Samples with the base at rest together have the weight of one.
        share = np.clip(apart / GRAIN, 1.0 / len(apart), 1.0)
        self.weight = share[:, None] / (WHITE * noise) ** 2
        self.kept = np.exp(-moved * sensor.length / PERSISTENCE)[:, None]
        self.first = 1.0 / (BIAS * noise) ** 2
        self.change = self.first / (1.0 - self.kept**2)
        stretch = moved * STRETCH / sensor.length
        self.normal, self.sliding = 1.0 / (NORMAL**2 * stretch), 1.0 / (SLIDING**2 * stretch)

    def state(self, contacts: Array, bias: Array) -> _State:
        """Evaluate the model for given unknowns."""
        touches = self.sensor.touches(contacts)
        points = self.base + (self.turn @ touches.points[:, :, None])[:, :, 0]
        values, slopes = self.sensor.readings(touches)
        return _State(contacts, bias, touches, points, values + bias - self.readings, slopes)

    def cost(self, at: _State, metric: Array) -> float:
        """Function to be minimised, for given weights of the steps."""
        step, drift = np.diff(at.points, axis=0), at.bias[1:] - self.kept * at.bias[:-1]
        cost = (at.misfit**2 * self.weight).sum() + (at.bias[0] ** 2 * self.first).sum()
        cost += np.einsum("ki,kij,kj->", step, metric, step) + (drift**2 * self.change).sum()
        return float(cost)

    def normals(self, touches: Touches) -> Array:
        """Directions (n, 3) of the forces, laboratory frame."""
        force = (self.turn @ touches.force[:, :, None])[:, :, 0]
        return np.asarray(force / np.maximum(np.linalg.norm(force, axis=1), 1e-12)[:, None])

    def metric(self, touches: Touches) -> Array:
        """Weights of the steps between samples (n - 1, 3, 3)."""
        n = self.normals(touches)
        n = n[1:] + n[:-1]
        n /= np.maximum(np.linalg.norm(n, axis=1), 1e-12)[:, None]
        along = n[:, :, None] * n[:, None, :]
        return np.asarray(
            self.normal[:, None, None] * along + self.sliding[:, None, None] * (np.eye(3) - along)
        )

    def system(self, at: _State, metric: Array) -> tuple[Array, Array]:
        """Gradient (n, m) and banded Hessian of half the cost, by contacts and bias."""
        n, k = at.bias.shape
        size = 3 + k
        point = self.turn @ at.touches.point_slopes
        both = np.concatenate([at.slopes, np.broadcast_to(np.eye(k), (n, k, k))], axis=2)
        gradient = np.einsum("kai,ka,ka->ki", both, self.weight, at.misfit)
        own = np.einsum("kai,ka,kaj->kij", both, self.weight, both)
        pull = (metric @ np.diff(at.points, axis=0)[:, :, None])[:, :, 0]
        gradient[1:, :3] += np.einsum("kji,kj->ki", point[1:], pull)
        gradient[:-1, :3] -= np.einsum("kji,kj->ki", point[:-1], pull)
        after, before = metric @ point[1:], metric @ point[:-1]
        own[1:, :3, :3] += np.swapaxes(point[1:], 1, 2) @ after
        own[:-1, :3, :3] += np.swapaxes(point[:-1], 1, 2) @ before
        cross = np.zeros((n - 1, size, size))
        cross[:, :3, :3] = -np.swapaxes(point[1:], 1, 2) @ before
        drift = (at.bias[1:] - self.kept * at.bias[:-1]) * self.change
        gradient[0, 3:] += at.bias[0] * self.first
        gradient[1:, 3:] += drift
        gradient[:-1, 3:] -= self.kept * drift
        i = np.arange(3, size)
        own[0, i, i] += self.first
        own[1:, i, i] += self.change
        own[:-1, i, i] += self.kept**2 * self.change
        cross[:, i, i] = -self.kept * self.change
        s, pushed = at.contacts[:, 0], gradient[:, 0]
        held = ((s >= 1.0) & (pushed < 0.0)) | ((s <= _SWEEP_LEAST_ARC) & (pushed > 0.0))
        gradient[held, 0] = 0.0
        own[held, 0, 0] *= _HELD
        return gradient, _banded(own, cross)

    def minimise(self, start: float) -> tuple[_State, Array, float]:
        """Minimise the cost from contacts at one arc length; also return weights and cost."""
        n, k = self.readings.shape
        at, damping = self.state(np.tile([start, 1e-3, 1e-3], (n, 1)), np.zeros((n, k))), 1e-2
        for _ in range(_SWEEP_ROUNDS):
            metric = self.metric(at.touches)
            cost = self.cost(at, metric)
            gradient, band = self.system(at, metric)
            while damping < 1e8:
                damped = band.copy()
                damped[0] *= 1.0 + damping
                try:
                    step = -linalg.solveh_banded(damped, gradient.ravel(), lower=True).reshape(
                        n, -1
                    )
                except np.linalg.LinAlgError:
                    damping *= 10.0
                    continue
                step /= max(np.abs(step[:, 0]).max() / _MOST_STEP, 1.0)
                contacts = at.contacts + step[:, :3]
                contacts[:, 0] = np.clip(contacts[:, 0], _SWEEP_LEAST_ARC, 1.0)
                new = self.state(contacts, at.bias + step[:, 3:])
                if (after := self.cost(new, metric)) < cost:
                    break
                damping *= 10.0
            else:
                break
            at, damping = new, max(0.1 * damping, 1e-9)
            if cost - after < _ENOUGH * cost:
                break
        metric = self.metric(at.touches)
        return at, metric, self.cost(at, metric)

    def contacts(self) -> SweptContacts:
        """Most probable contacts."""
        at, metric, _ = min(map(self.minimise, _STARTS), key=lambda one: one[2])
        root = linalg.cholesky_banded(self.system(at, metric)[1], lower=True)
        point = self.turn @ at.touches.point_slopes * self.sensor.length
        spread = _inverse_blocks(root, len(point))[:, :3, :3]
        return SweptContacts(
            at.points * self.sensor.length,
            point @ spread @ np.swapaxes(point, 1, 2),
            self.normals(at.touches),
            at.contacts[:, 0] * self.sensor.length,
            np.ones(len(point), dtype=bool),
            at.bias,
            _largest_errors(root, point),
        )


def _banded(own: Array, cross: Array) -> Array:
    """Lower band of a block-tridiagonal symmetric matrix."""
    n, size, _ = own.shape
    band = np.zeros((2 * size, n * size))
    for i in range(size):
        for j in range(size):
            if j <= i:
                band[i - j, j::size] = own[:, i, j]
            band[size + i - j, j : size * (n - 1) : size] = cross[:, i, j]
    return band


def _inverse_blocks(root: Array, n: int) -> Array:
    """Diagonal blocks of (L Lᵀ)⁻¹ for the band of a block-bidiagonal L, by backward recursion."""
    size = len(root) // 2
    i, j = np.indices((size, size))
    columns = size * np.arange(n)[:, None, None] + j
    back = np.linalg.inv(np.where(i >= j, root[np.maximum(i - j, 0), columns], 0.0))
    below = root[size + i - j, columns] @ back
    out = np.swapaxes(back, 1, 2) @ back
    for k in range(n - 2, -1, -1):
        out[k] += below[k].T @ out[k + 1] @ below[k]
    return np.asarray(out)


def _largest_errors(root: Array, point: Array) -> Array:
    """Displacements of all points by one standard deviation of each of their largest errors."""
    n = len(point)

    def spread(vector: Array) -> Array:
        full = np.zeros((n, len(root) // 2))
        full[:, :3] = np.einsum("kai,ka->ki", point, vector.reshape(n, 3))
        full = linalg.cho_solve_banded((root, True), full.ravel()).reshape(n, -1)
        return np.asarray(np.einsum("kai,ki->ka", point, full[:, :3]).ravel())

    joint = sparse_linalg.LinearOperator((3 * n, 3 * n), matvec=spread, dtype=np.float64)
    size, shifts = sparse_linalg.eigsh(joint, k=_SHARED, v0=np.ones(3 * n))
    return np.asarray((np.sqrt(np.maximum(size, 0.0)) * shifts).T.reshape(_SHARED, n, 3))
