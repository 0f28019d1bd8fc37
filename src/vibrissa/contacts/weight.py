"""Contacts of a whisker that bends under its own weight.

The resting whisker sags. A whisker without weight that has this shape at rest proposes contacts:
near the truth where gravity acts across the whisker, and within a few per cent of the length where
it acts along it. They are then fitted to the signals with the whole weight
(:mod:`vibrissa.rod.gravity`).

A sensor that was tared at rest reads, up to the moment μ of the weight about the base (μ₀ at rest),

    F = φ(0),   M = p × F + μ - μ₀,

so that M · F ≠ 0. Tared under another gravity, it reads the difference of the two resting wrenches
in addition, which is the same for every contact.

The direction of gravity and the density are known to standard deviations; their errors θ are shared
by all measurements. With T the signals, p the contact point, K the gain ∂x/∂T of the fit and a
subscript for derivatives at a fixed contact x, the error of the contact point is
p_x K (ε - T_θ θ) + p_θ θ. To second order along each principal axis u of the noise in x, p changes
by h = (p_uu - p_x K T_uu)/2 at unchanged signals; its second moment is added to the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from vibrissa.contacts.channels import CHANNELS, CIRCULAR, WRENCH, Channels
from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.contacts import Candidates, Contacts, contacts_of
from vibrissa.contacts.least_squares import Fits
from vibrissa.contacts.noise import Noise, SensorNoise, explained, rank, sensor_noise, whitening
from vibrissa.contacts.posterior import CERTAIN, ranked
from vibrissa.contacts.prior import Prior, possible_candidates
from vibrissa.contacts.readout import check_signals
from vibrissa.contacts.search import estimate
from vibrissa.contacts.wrench import chosen, estimate_components, friction_angle
from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod import Discretization, discretize, evaluated, resting
from vibrissa.signals import (
    labelled_wrench,
    measured,
    selection,
    signal_scales,
    signals_of,
    wrench_derivatives,
)
from vibrissa.status import Status
from vibrissa.whisker import Whisker

# Rounds of the fit, and the longest steps of arc length (over L) and of force (its own size, and
# EI/L²) in one.
_ROUNDS = 30
_LONGEST, _STRONGER, _LEAST_FORCE = 0.1, 0.5, 0.05
# A fit has ended when its step is this small, or the damping this large.
_SETTLED, _MOST_DAMPING = 1e-10, 1e8
# Least arc length of a contact, over L.
_PROXIMAL = 0.05
# What exact signals are met to, in χ² of signals known to 1 %.
_EXACT = 1e-8
# Noise, in units of force and moment and in rad, within which the whisker without weight proposes
# contacts of signals that it does not explain.
_NEAR = 0.01
# Turn of gravity (rad) and relative change of density for derivatives.
_NUDGE = 1e-4
# The second order is taken from this far along each axis, in standard deviations; the covariance is
# relied on where the contact point moves there by less than one in addition.
_REACH, _BENT = 2.0, 1.0
_MOST = 8
# Friction angles scatter by so much: of contacts that explain a wrench equally well, those that
# need less friction come first.
_LIKELY = np.deg2rad(20.0)
_NO_ERRORS = np.zeros((0, 6, 7))


@dataclass(frozen=True)
class Gravity:
    """Gravity that a whisker bends under, and how well it is known.

    Attributes
    ----------
    acceleration : tuple of float
        Gravitational acceleration minus that of the base, whisker frame, m/s², such as
        ``(0, 0, -9.81)`` for a level whisker.
    tare : tuple of float, optional
        Gravity, whisker frame, m/s², when the sensor was tared with the whisker at rest; by default
        as it is now. Zeros: a sensor that reads the weight.
    direction_sigma : float
        Standard deviation of gravity's direction about each axis across it, rad.
    density_sigma : float
        Relative standard deviation of the whisker's density.
    """

    acceleration: tuple[float, float, float]
    tare: tuple[float, float, float] | None = None
    direction_sigma: float = 0.0
    density_sigma: float = 0.0

    def __post_init__(self) -> None:
        """Check the standard deviations."""
        for name in ("direction_sigma", "density_sigma"):
            sigma = getattr(self, name)
            if not 0.0 <= sigma < np.inf:
                raise ValueError(f"{name} is a standard deviation, not negative; got {sigma!r}")

    @classmethod
    def of(cls, gravity: Gravity | ArrayLike | None) -> Gravity | None:
        """Read gravity, stated as such or as an acceleration; None where there is none.

        Parameters
        ----------
        gravity : Gravity, (3,) array_like or None
            Gravity, or its acceleration, m/s².

        Returns
        -------
        Gravity or None
            Gravity, unless it is zero and the sensor was tared under it.
        """
        if gravity is None:
            return None
        if not isinstance(gravity, Gravity):
            values = np.asarray(gravity, dtype=np.float64)
            if values.shape != (3,):
                raise ValueError(
                    f"gravity is (x, y, z) in m/s², in the whisker frame; got {gravity!r}"
                )
            gravity = cls((float(values[0]), float(values[1]), float(values[2])))
        return gravity if any(gravity.acceleration) or gravity.tare is not None else None


class _Model(NamedTuple):
    """Readings (n, 6), contact points (n, 3), derivatives of (F, p) (n, 6, 4) and of readings.

    ``leans`` are the directions of weight at the tip, to begin the next solution with.
    """

    wrench: Array
    values: Array
    tangents: Array
    d_wrench: Array
    leans: Array

    def rows(self, kept: AnyArray) -> _Model:
        """Some of them."""
        parts: list[Any] = [part[kept] for part in self]
        return _Model(*parts)


class _Sensor:
    """What a tared sensor reads of contacts; non-dimensional."""

    def __init__(self, whisker: Whisker, gravity: Array, tare: Array | None) -> None:
        rest = resting(whisker, gravity)
        self.rest, self.d = rest, discretize(rest)
        self.moment = rest.moment / self.d.moment
        self.shift = np.zeros(6)
        if tare is not None:
            before = resting(whisker, tare)
            self.shift[:3] = (rest.force - before.force) / self.d.force
            self.shift[3:] = (rest.moment - before.moment) / self.d.moment

    def read(self, x: Array, leans: Array | None = None) -> _Model:
        """Readings of contacts x (n, 4), less the shift."""
        solved = evaluated(self.d, x, leans, tangents=True)
        values, slopes = solved.states[:, :6].copy(), solved.tangents
        force, point = values[:, :3], values[:, 3:]
        moment = np.cross(point, force) + solved.states[:, 9:12] - self.moment
        d_moment = np.cross(slopes[:, 3:6], force[..., None], axis=1) + slopes[:, 9:12]
        d_moment += np.cross(point[..., None], slopes[:, :3], axis=1)
        return _Model(
            np.concatenate([force, moment], axis=1),
            values,
            slopes[:, :6].copy(),
            np.concatenate([slopes[:, :3], d_moment], axis=1),
            solved.leans,
        )


def _channels(names: tuple[str, ...], wrench: Array) -> tuple[Array, Array]:
    """Channels (n, k) of readings (n, 6), and their derivatives (n, k, 6)."""
    force, moment, parts = wrench[:, :3], wrench[:, 3:], [1, 2, 4, 5]
    which = [CHANNELS.index(name) for name in names]
    unit = np.broadcast_to(np.eye(6)[parts], (len(wrench), 4, 6))
    values = np.concatenate([signals_of(force, moment), wrench[:, parts]], axis=1)
    slopes = np.concatenate([wrench_derivatives(force, moment), unit], axis=1)
    return values[:, which], slopes[:, which]


class _Fitter:
    """Weighted least squares of contacts under weight."""

    def __init__(
        self,
        whisker: Whisker,
        gravity: Gravity,
        channels: Channels,
        sensor: SensorNoise | None,
        stiffness_sigma: float,
    ) -> None:
        self.channels, self.sensor = channels, sensor
        self.friction = channels.signals == WRENCH
        self.free = [0, 1, 2, 3] if self.friction else [0, 2, 3]
        self._turned = np.array([CIRCULAR[CHANNELS.index(name)] for name in channels.names])
        now = np.array(gravity.acceleration)
        tare = None if gravity.tare is None else np.array(gravity.tare)
        self.now = _Sensor(whisker, now, tare)
        self.d: Discretization = self.now.d
        self._nudged: list[tuple[_Sensor, float]] = []
        if gravity.direction_sigma > 0.0:
            for axis in np.linalg.svd(now[None])[2][1:]:
                turn = Rotation.from_rotvec(_NUDGE * axis)
                before = None if tare is None else turn.apply(tare)
                nudged = _Sensor(whisker, turn.apply(now), before)
                self._nudged.append((nudged, gravity.direction_sigma / _NUDGE))
        # A stiffer whisker bends less under the same weight, as a lighter one does.
        lighter = float(np.hypot(gravity.density_sigma, stiffness_sigma))
        if lighter > 0.0:
            assert whisker.density is not None
            heavier = whisker.with_properties(density=whisker.density * (1.0 + _NUDGE))
            self._nudged.append((_Sensor(heavier, now, tare), lighter / _NUDGE))

    def fit(self, flat: Array, targets: Array, x: Array) -> Fits:
        """Fit contacts from starts x (n, 4) to measured signals and their channels, row by row."""
        if not self.friction:
            x = x * [1.0, 0.0, 1.0, 1.0]
        model = self.now.read(x)
        for _ in range(2):  # noise depends on where the contact is
            weights = self.weights(flat, x, model)
            x, model, misfit = self._iterate(x, model, targets, weights)
        return Fits(x, model.values, model.tangents, misfit, np.isfinite(misfit))

    def weights(self, flat: Array, x: Array, model: _Model) -> Array:
        """Whitening of the channels, by noise and shared errors together."""
        change, _ = self._by_errors(x, model)
        sigma = self.channels.covariance(self.sensor, flat, model.values, self.d)
        return whitening(sigma + change @ np.swapaxes(change, 1, 2))

    def _iterate(
        self, x: Array, model: _Model, target: Array, weights: Array
    ) -> tuple[Array, _Model, Array]:
        """Damped Gauss-Newton steps; contacts, their model, and χ²."""
        x, model = x.copy(), _Model(*(part.copy() for part in model))
        misfit = self._misfit(model, target, weights)
        damping, busy = np.zeros(len(x)), np.isfinite(misfit)
        for _ in range(_ROUNDS):
            which = np.flatnonzero(busy)
            if not which.size:
                break
            part = model.rows(which)
            step = self._step(x[which], part, target[which], weights[which], damping[which])
            tried = x[which].copy()
            tried[:, self.free] += step
            tried[:, 0] = np.clip(tried[:, 0], _PROXIMAL, 1.0)
            new = self.now.read(tried, part.leans)
            now = self._misfit(new, target[which], weights[which])
            better = now <= misfit[which] * (1.0 + 1e-12) + 1e-24
            small = np.abs(tried - x[which]).max(axis=1) < _SETTLED
            good = which[better]
            x[good], misfit[good] = tried[better], now[better]
            for mine, theirs in zip(model, new, strict=True):
                mine[good] = theirs[better]
            damping[which] = np.where(better, 0.1 * damping[which], 10.0 * damping[which] + 1e-4)
            busy[which] = ~small & (damping[which] < _MOST_DAMPING)
        return x, model, misfit

    def _within_turn(self, difference: Array) -> Array:
        """Differences of channels, those of angles within half a turn."""
        turned = np.arctan2(np.sin(difference), np.cos(difference))
        return np.where(self._turned, turned, difference)

    def _misfit(self, model: _Model, target: Array, weights: Array) -> Array:
        off = self._within_turn(target - _channels(self.channels.names, model.wrench)[0])
        out = np.asarray((np.einsum("nij,nj->ni", weights, off) ** 2).sum(axis=1))
        return np.where(np.isfinite(out), out, np.inf)

    def _step(
        self, x: Array, model: _Model, target: Array, weights: Array, damping: Array
    ) -> Array:
        values, slopes = _channels(self.channels.names, model.wrench)
        off = self._within_turn(target - values)
        a = np.nan_to_num(weights @ slopes @ model.d_wrench[..., self.free])
        b = np.nan_to_num(np.einsum("nij,nj->ni", weights, off))
        size = np.linalg.norm(a, axis=1)
        size = np.where(size > 0.0, size, 1.0)
        a /= size[:, None, :]
        ridge = (damping[:, None, None] + 1e-14) * np.eye(len(self.free))
        normal = np.swapaxes(a, 1, 2) @ a + ridge
        step = np.linalg.solve(normal, np.einsum("nij,ni->nj", a, b)[..., None])[..., 0] / size
        force = np.linalg.norm(x[:, 1:], axis=1)
        most = np.abs(step[:, 0]) / _LONGEST
        stronger = np.linalg.norm(step[:, 1:], axis=1) / (_STRONGER * force + _LEAST_FORCE)
        return np.asarray(step / np.maximum(1.0, np.maximum(most, stronger))[:, None])

    def _by_errors(self, x: Array, model: _Model) -> tuple[Array, Array]:
        """What errors of one standard deviation change of channels and points at fixed contacts."""
        wrench, points = np.zeros((len(x), 6, 0)), np.zeros((len(x), 3, 0))
        for nudged, share in self._nudged:
            other = nudged.read(x, model.leans)
            shift = nudged.shift - self.now.shift
            change = (other.wrench + shift - model.wrench) * share
            moved = (other.values - model.values)[:, 3:] * share
            wrench = np.concatenate([wrench, change[..., None]], axis=2)
            points = np.concatenate([points, moved[..., None]], axis=2)
        return _channels(self.channels.names, model.wrench)[1] @ wrench, points

    def covariance(self, flat: Array, x: Array) -> tuple[Array, AnyArray]:
        """Covariances (n, 3, 3) of contact points, and whether they are valid."""
        model = self.now.read(x)
        weights = self.weights(flat, x, model)
        _, slopes = _channels(self.channels.names, model.wrench)
        a = np.nan_to_num(weights @ slopes @ model.d_wrench[..., self.free])
        gain = np.linalg.pinv(a, rcond=1e-9) @ weights
        moved = model.tangents[:, 3:][..., self.free] @ gain
        change, points = self._by_errors(x, model)
        # The weights are those of noise and shared errors together; the noise is what is left.
        whole = np.linalg.pinv(np.swapaxes(weights, 1, 2) @ weights, rcond=1e-15)
        own = whole - change @ np.swapaxes(change, 1, 2)
        shared = points - moved @ change
        out = moved @ own @ np.swapaxes(moved, 1, 2) + shared @ np.swapaxes(shared, 1, 2)
        bends = self._bends(x, model, a, moved)
        valid = np.isfinite(bends).all(axis=(1, 2))
        bends = np.nan_to_num(bends)
        inverse = np.linalg.pinv(out, rcond=1e-12, hermitian=True)
        far = _REACH**2 * np.sqrt(np.einsum("nai,nab,nbi->ni", bends, inverse, bends).max(axis=1))
        mean = bends.sum(axis=2)
        out += 2.0 * bends @ np.swapaxes(bends, 1, 2) + mean[:, :, None] * mean[:, None, :]
        return np.asarray(out), np.asarray(valid & (far < _BENT))

    def _bends(self, x: Array, model: _Model, a: Array, moved: Array) -> Array:
        """Second-order changes h (n, 3, k) of points along the principal axes of the noise in x."""
        _, singular, v = np.linalg.svd(a, full_matrices=False)
        axes = np.swapaxes(v, 1, 2) / np.maximum(singular, 1e-300)[:, None, :]
        values = _channels(self.channels.names, model.wrench)[0]
        out = np.zeros((len(x), 3, len(self.free)))
        for i in range(len(self.free)):
            point, channel = np.zeros((len(x), 3)), np.zeros_like(values)
            inside = np.ones(len(x), np.bool_)
            for way in (_REACH, -_REACH):
                there = x.copy()
                there[:, self.free] += way * axes[:, :, i]
                inside &= (there[:, 0] >= _PROXIMAL) & (there[:, 0] <= 1.0)
                there = np.where(inside[:, None], there, x)
                other = self.now.read(there, model.leans)
                point = point + other.values[:, 3:] - model.values[:, 3:]
                at, _ = _channels(self.channels.names, other.wrench)
                channel = channel + self._within_turn(at - values)
            bend = point - np.einsum("nab,nb->na", moved, channel)
            out[:, :, i] = np.where(inside[:, None], bend / (2.0 * _REACH**2), np.nan)
        return out


def estimate_with_weight(
    whisker: Whisker,
    sagged: ChartedWhisker | None,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    using: str | Sequence[str],
    noise: Noise | None,
    errors: Array,
    prior: Prior | None,
    gravity: Gravity,
    stiffness_sigma: float,
) -> Contacts:
    """Find contacts of a whisker under its weight, as `ContactMap.estimate` does."""
    names = WRENCH if using == "wrench" else selection(using)
    sensor = sensor_noise(noise, names, errors)
    if sensor is None and (gravity.direction_sigma or gravity.density_sigma):
        raise ValueError("the uncertainty of the weight adds to that of a sensor: give its noise")
    if names == WRENCH:
        channels = Channels(WRENCH, WRENCH)
        if "force" in signals and "moment" in signals:
            force, moment, dims, coords = labelled_wrench(signals["force"], signals["moment"])
            values = np.concatenate([force, moment], axis=-1)
        else:
            values, dims, coords = measured(signals, WRENCH)
    else:
        channels = Channels.of(names)
        values, dims, coords = measured(signals, names)
        check_signals(values, names)
    fitter = _Fitter(whisker, gravity, channels, sensor, stiffness_sigma)
    d = fitter.d
    scale = signal_scales(names, d.force, d.moment)
    flat = values.reshape(-1, len(names)) / scale
    targets = channels.targets(flat) - _shifts(channels.names, fitter.now.shift)
    proposed = _proposed(fitter.now.rest.shape(), sagged, channels, targets, scale)
    found, status = _fitted(fitter, flat, targets, proposed)
    if prior is not None:
        some = found.number > 0
        found = found.allowed_first(possible_candidates(prior, whisker, d, found))
        status[some & (found.number == 0)] = int(Status.OUTSIDE_PRIOR)
    chi_squared = found.chi_squared[:, 0]
    return contacts_of(found, status, chi_squared, d, names, values.shape[:-1], dims, coords)


def _shifts(names: tuple[str, ...], shift: Array) -> Array:
    """What a shift of (F, M) adds to channels."""
    out = np.zeros(len(names))
    for i, name in enumerate(names):
        if name in WRENCH:
            out[i] = shift[WRENCH.index(name)]
        elif shift[[1, 2] if name.startswith("F") else [4, 5]].any():
            pair = "FT and FD" if name.startswith("F") else "MB and MD"
            raise ValueError(f"a tare under another gravity needs both {pair}; got {name} alone")
    return out


def _proposed(
    shape: Whisker,
    sagged: ChartedWhisker | None,
    channels: Channels,
    targets: Array,
    scale: Array,
) -> list[Contacts]:
    """Contacts of a whisker without weight that has the sagged shape: near the signals, and exact.

    Signals just beyond those of its map have none that is exact; light contacts are found by these.
    """
    values = targets.copy()
    for i in channels.pairs():
        y, z = targets[:, i], targets[:, i + 1]
        values[:, i], values[:, i + 1] = np.hypot(y, z), np.arctan2(z, y)
    values *= scale
    exact = dict(zip(channels.signals, values.T, strict=True))
    if sagged is None:
        return [estimate_components(shape, exact, None, _NO_ERRORS, None)]
    near = {name: _NEAR * size for name, size in zip(channels.signals, scale, strict=True)}
    return [
        estimate(sagged, exact, channels.signals, noise, _NO_ERRORS, None) for noise in (near, None)
    ]


def _fitted(
    fitter: _Fitter, flat: Array, targets: Array, proposed: list[Contacts]
) -> tuple[Candidates, IntArray]:
    """Candidates by rank, and statuses."""
    d, n = fitter.d, len(flat)
    arc = np.concatenate([one.candidates.arc_length for one in proposed], axis=1)
    force = np.concatenate([one.candidates.contact_force for one in proposed], axis=1)
    row, place = np.nonzero(np.isfinite(arc))
    seeds = np.column_stack([arc[row, place] / d.length, force[row, place] / d.force])
    fits = fitter.fit(flat[row], targets[row], seeds)
    degrees = len(targets[0]) - len(fitter.free) if n else 0
    if fitter.friction and fitter.sensor is not None:
        degrees = rank(fitter.channels.covariance(fitter.sensor, flat[:1], np.ones((1, 6)), d)[0])
        degrees -= len(fitter.free)
    exact = fitter.sensor is None and degrees == 0
    limit = _EXACT if exact else explained(degrees)
    doubt = np.linalg.norm(fits.contacts[:, 1:], axis=1)
    if fitter.friction:
        doubt = fits.misfits + (friction_angle(fits.contacts) / _LIKELY) ** 2
    kept = chosen(n, row, fits, doubt, limit, _MOST)
    found = Candidates.room(n, _MOST)._replace(
        number=kept.number, x=kept.contacts, values=kept.values, chi_squared=kept.misfits
    )
    if fitter.sensor is not None:
        found = _ranked(fitter, flat, found)
    first = found.probability[:, 0]
    sure = np.where(np.isfinite(first), first > CERTAIN, found.number == 1)
    status = np.where(sure, int(Status.UNIQUE), int(Status.AMBIGUOUS))
    unexplained = Status.NOT_ONE_CONTACT if fitter.friction else Status.NOT_FRICTIONLESS
    status[~(found.chi_squared[:, 0] <= limit)] = int(unexplained)
    none = found.number == 0
    status[none] = np.asarray(proposed[0].status)[none]
    if exact:
        lost = status == int(unexplained)
        found = found.allowed_first(np.isfinite(found.chi_squared) & ~lost[:, None])
    return found, status


def _ranked(fitter: _Fitter, flat: Array, found: Candidates) -> Candidates:
    """Candidates by probability, with what noise leaves open."""
    row, place = np.nonzero(np.isfinite(found.chi_squared))
    x = found.x[row, place]
    covariance, valid = fitter.covariance(flat[row], x)
    found.covariances[row, place], found.valid[row, place] = covariance, valid
    log = 0.5 * np.linalg.slogdet(covariance)[1] - 0.5 * found.chi_squared[row, place]
    if fitter.friction:
        log -= 0.5 * (friction_angle(x) / _LIKELY) ** 2
    weight = np.full(found.chi_squared.shape, -np.inf)
    weight[row, place] = np.where(np.isfinite(log), log, -np.inf)
    probability, order = ranked(weight, found.number)
    line = np.arange(len(order))[:, None]
    found = Candidates(found.number, *(part[line, order] for part in found[1:]))
    return found._replace(probability=probability)
