"""Model of a force and torque sensor at the whisker's base, with its errors.

A sensor has channels, each a linear mixture of the components (F_x, F_y, F_z, M_x, M_y, M_z):

    reading = round((1 + g)(1 + ε)(A w) + b + d(t) + n),    at most ± the largest reading,

with the mixing A, a gain error g and noise ε relative to the signal, a bias b, a drift d that is a
random walk, white noise n, and rounding to the channel's resolution. By default the channels are
the six components themselves; robotic whiskers often have two or three channels.

The wrench w is in the sensor's own frame: H = A X⁻¹ is the mixing of the wrench at the whisker's
base, with X of :class:`~vibrissa.sensors.SensorFrame`. The weight that the sensor carries is added
to the wrench of the contact: (m g, m c × g) for a mass m with its centre at c, with g in the frame
of the base.

:meth:`Sensor.read` simulates readings, :meth:`Sensor.compensated` removes offset and weight from
readings, and :meth:`Sensor.to_wrench` converts them to force and moment at the base.

Noise differs from reading to reading. Errors of gain, mixing and calibration are the same in all
readings, so that averaging does not reduce them: a channel with the stated response a w + b and the
true one (a + δa) w + b + δb has the error (δa, δb) (w, 1) in every reading of the wrench w. Such
errors are represented by independent variables ε of standard deviation one, each with a matrix E
(k, 7) of the errors ε E (w, 1) of the k channels; they add Σ E (w, 1) (w, 1)ᵀ Eᵀ to the covariance
of readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array, Mask, numbers, rotation_matrices
from vibrissa.sensors.frame import SensorFrame

FORCE_NOISE = 1e-6
"""Standard deviation of a component of the measured force, N."""

MOMENT_NOISE = 0.02e-6
"""Standard deviation of a component of the measured moment, N·m."""

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""Components of the wrench, in this order."""

GRAVITY = (0.0, 0.0, -9.80665)
"""Gravitational acceleration in the laboratory frame, m/s²."""

_UNREAD = 1e-9  # relative size below which a combination of components is not measured
_ROUNDING = 1e-12  # size below which eigenvalues of a correlation matrix are due to rounding
# Size above which asymmetries and negative eigenvalues of a correlation matrix are errors.
_INDEFINITE = 1e-9
_DRIFTED = 2.0  # time for which an offset has drifted since it was measured, as in streams, s


@dataclass(frozen=True, eq=False)
class Sensor:
    """A force and torque sensor at the base of a whisker.

    Values of channels are one number for all or one per channel, in the unit of the channel: that
    of its component (N, N·m), or the one implied by its mixing.

    Parameters
    ----------
    channels : sequence of str
        Names of the channels. Without a mixing, these are the measured components.
    mixing : array_like (k, 6), optional
        Weights of (Fx, Fy, Fz, Mx, My, Mz) in each of the k channels. If channels are components,
        one number for all or one per channel suffices: 1e3 for mN and mN·m (= N·mm).
    noise : array_like, optional
        Standard deviation of white noise; by default that of `FORCE_NOISE` and `MOMENT_NOISE` in
        every component.
    bias : array_like
        Constant offset.
    drift : array_like
        Standard deviation, after one second, of a random walk that starts at zero. Streams follow
        it while the whisker is free; contacts have the uncertainty of the walk of two seconds.
    resolution : array_like
        Resolution to whose multiples readings are rounded; 0 for no rounding.
    largest : array_like
        Size of the largest reading. A reading that reaches it is saturated and counts as missing.
        The default, infinity, stands for no limit.
    relative_noise : float
        Standard deviation of white noise relative to the signal.
    gain_error : array_like
        Relative standard deviation of the channels' gain errors, which are the same in all readings
        and independent among channels.
    mixing_error : float or array_like (k, 6)
        Standard deviation of the errors of the mixing, the same in all readings. An array states
        that of each entry, in its unit; one number is relative to the channel's largest weight of a
        force or of a moment, and so includes cross-talk among forces and among moments.
    mixing_covariance : array_like (k, 7, 7), optional
        Covariance of each channel's mixing of the six components and, last, its offset, as
        determined by a calibration; in addition to the two stated errors.
    frame : SensorFrame
        Frame of the sensor; by default the whisker frame.
    mass : float
        Mass carried by the sensor, kg, whose weight is part of the readings.
    mass_moment : array_like (3,)
        First moment of that mass, mass times centre, whisker frame, kg·m.

    Examples
    --------
    >>> Sensor(channels=("Fx", "My", "Mz"), resolution=[1e-6, 1e-8, 1e-8]).mixing.shape
    (3, 6)
    >>> Sensor(mixing=1e3, noise=[3, 3, 3, 0.1, 0.1, 0.1]).mixing[5, 5]  # in mN and N·mm
    np.float64(1000.0)
    """

    channels: Sequence[str] = COMPONENTS
    mixing: Any = None
    noise: Any = None
    bias: Any = 0.0
    drift: Any = 0.0
    resolution: Any = 0.0
    largest: Any = np.inf
    relative_noise: float = 0.0
    gain_error: Any = 0.0
    mixing_error: Any = 0.0
    mixing_covariance: Any = None
    frame: SensorFrame = field(default_factory=SensorFrame)
    mass: float = 0.0
    mass_moment: Any = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Validate the fields, and expand values to all channels."""
        names = tuple(self.channels)
        faults: list[str] = []
        if not names or len(set(names)) != len(names):
            faults.append(f"channels are {names}; different names, at least one, are needed")
        mixing = _checked_mixing(names, self.mixing, faults)
        values: dict[str, Any] = {"channels": names, "mixing": mixing}
        values |= _checked_numbers(self, mixing, len(names), faults)
        values["mixing_error"] = numbers("mixing_error", self.mixing_error, COMPONENTS)
        values["mixing_covariance"] = _checked_covariance(
            self.mixing_covariance, len(names), faults
        )
        error, moment = values["mixing_error"], numbers("mass_moment", self.mass_moment)
        if error.shape not in ((), (len(names), 6)):
            faults.append(
                f"mixing_error has shape {error.shape}; () or ({len(names)}, 6) is needed"
            )
        elif not (np.isfinite(error) & (error >= 0.0)).all():
            faults.append(f"mixing_error is {error.tolist()}; it must be finite and not negative")
        shares = ("relative_noise", "gain_error", *(["mixing_error"] if not error.ndim else []))
        faults += [
            f"{name} is {getattr(self, name)!r}; it is a share: 5 % is 0.05"
            for name in shares
            if np.any(np.asarray(getattr(self, name), dtype=np.float64) > 1.0)
        ]
        for name in ("relative_noise", "mass"):
            number = getattr(self, name)
            if not (np.isfinite(number) and number >= 0.0):
                faults.append(f"{name} is {number!r}; it must not be negative")
        if moment.shape != (3,) or not np.isfinite(moment).all():
            faults.append(f"mass_moment is {self.mass_moment!r}; three numbers, kg·m, are needed")
        values["mass_moment"] = moment
        if not isinstance(self.frame, SensorFrame):
            faults.append(f"frame is {self.frame!r}; a SensorFrame is needed")
        if faults:
            raise ValueError("the sensor is not valid: " + "; ".join(faults))
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        noise = ", ".join(f"{n} {s:.3g}" for n, s in zip(self.channels, self.noise, strict=True))
        return f"<Sensor of {len(self.channels)} channels, with noise: {noise}>"

    @property
    def reads_wrench(self) -> bool:
        """Whether the channels are the six components at the whisker's base, in this order."""
        return self.channels == COMPONENTS and bool((self.base_mixing == np.eye(6)).all())

    @cached_property
    def base_mixing(self) -> Array:
        """Mixing H (k, 6) of (F, M) at the whisker's base."""
        plain = (self.frame.to_base() == np.eye(6)).all()
        return np.asarray(self.mixing if plain else self.mixing @ self.frame.from_base())

    def covariance(self, reading: ArrayLike = 0.0) -> Array:
        """Covariance of the noise of one reading: white noise, relative noise and rounding.

        Parameters
        ----------
        reading : array_like (k,)
            Reading, which scales the relative noise.

        Returns
        -------
        array (k, k)
            Diagonal covariance, without drift and `common_errors`.
        """
        relative = self.relative_noise * numbers("reading", reading, self.channels, any_unit=True)
        variance = self.noise**2 + self.resolution**2 / 12.0 + relative**2
        return np.diag(variance)

    @cached_property
    def common_errors(self) -> Array:
        """Errors E (n, k, 7) of gain, mixing and offset that all readings share.

        The n errors are independent: each adds ε E (F, M, 1) to the readings of the wrench (F, M)
        at the whisker's base, with one ε of standard deviation 1 for all readings.
        """
        own = np.concatenate(
            [
                _by_gain(self.mixing, self.gain_error),
                _by_mixing(self.mixing, self.mixing_error),
                _by_calibration(self.mixing_covariance),
            ]
        )
        if len(own):
            own[..., :6] = own[..., :6] @ self.frame.from_base()
        return own

    @property
    def drift_errors(self) -> Array:
        """Errors (n, k, 7) of the offset as in `common_errors`, those of a drift of two seconds."""
        errors = np.zeros((len(self.channels), len(self.channels), 7))
        errors[..., 6] = np.diag(np.sqrt(_DRIFTED) * self.drift)
        drifts: Mask = self.drift > 0.0
        return errors[drifts]

    @property
    def unsteadiness(self) -> float:
        """Largest deviation by noise and a drift of two seconds, relative to that of the noise."""
        noise = np.diag(self.covariance())
        some = noise > 0.0
        ratio = _DRIFTED * self.drift[some] ** 2 / noise[some]
        return float(np.sqrt(1.0 + ratio.max(initial=0.0)))

    def with_new_offset(self, readings: int, bias: ArrayLike | None = None) -> Sensor:
        """Copy of the sensor with an offset determined as the mean of readings.

        Parameters
        ----------
        readings : int
            Number of readings in the mean.
        bias : array_like (k,), optional
            New offset; by default the current one.

        Returns
        -------
        Sensor
            Sensor whose `mixing_covariance` contains the variance of the new offset.
        """
        variance = np.diag(self.covariance()) / readings
        return replace(
            self,
            bias=self.bias if bias is None else bias,
            mixing_covariance=with_offset(self.mixing_covariance, variance),
        )

    def weight(self, rotation: ArrayLike, gravity: ArrayLike = GRAVITY) -> Array:
        """Wrench at the base due to the weight that the sensor carries.

        Parameters
        ----------
        rotation : array_like (..., 3, 3)
            Rotation from the whisker frame to the laboratory frame.
        gravity : array_like (3,)
            Gravitational acceleration in the laboratory frame, m/s².

        Returns
        -------
        array (..., 6)
            Wrench (F, M), whisker frame, N and N·m.
        """
        g = numbers("gravity", gravity) @ rotation_matrices("rotation", rotation)
        return np.concatenate([self.mass * g, np.cross(self.mass_moment, g)], axis=-1)

    def compensated(
        self, readings: ArrayLike, rotation: ArrayLike | None = None, gravity: ArrayLike = GRAVITY
    ) -> Array:
        """Remove offset and weight from readings, which leaves H (F, M) of the contact and noise.

        Parameters
        ----------
        readings : array_like (..., k)
            Readings of the channels.
        rotation : array_like (..., 3, 3), optional
            Rotation from the whisker's to the laboratory frame; needed where the sensor carries a
            mass.
        gravity : array_like (3,)
            Acceleration in the laboratory frame, m/s².

        Returns
        -------
        array (..., k)
            Readings in the units of the channels; NaN if saturated.
        """
        # Components themselves are in SI units.
        any_unit = not (self.mixing == 1.0).any()
        values = numbers("readings", readings, self.channels, any_unit=any_unit)
        if values.shape[-1:] != (len(self.channels),):
            raise ValueError(
                f"readings of {', '.join(self.channels)} have a last axis of "
                f"{len(self.channels)}; got shape {values.shape}"
            )
        values = np.asarray(np.where(np.abs(values) < self.largest, values, np.nan) - self.bias)
        if self.mass == 0.0 and not self.mass_moment.any():
            return values
        if rotation is None:
            raise ValueError(
                "the sensor carries a mass, so the rotation from whisker to laboratory is needed "
                "to remove its weight"
            )
        return np.asarray(values - self.weight(rotation, gravity) @ self.base_mixing.T)

    def to_wrench(
        self, readings: ArrayLike, rotation: ArrayLike | None = None, gravity: ArrayLike = GRAVITY
    ) -> tuple[Array, Array]:
        """Estimate force and moment at the whisker's base by weighted least squares.

        Parameters
        ----------
        readings : array_like (..., k)
            Readings of the channels, six or more.
        rotation : array_like (..., 3, 3), optional
            Rotation from the whisker's to the laboratory frame; needed where the sensor carries a
            mass.
        gravity : array_like (3,)
            Acceleration in the laboratory frame, m/s².

        Returns
        -------
        wrench : array (..., 6)
            Wrench (F, M), whisker frame, N and N·m.
        covariance : array (6, 6)
            Covariance of its noise, without `common_errors`.

        Raises
        ------
        ValueError
            If the channels do not determine all six components.
        """
        h, noise = self.base_mixing, np.sqrt(np.diag(self.covariance()))
        weight = 1.0 / np.where(noise > 0.0, noise, 1.0)
        size = np.linalg.norm(h, axis=0)
        if h.shape[0] < 6 or np.linalg.cond(h / np.where(size > 0.0, size, 1.0)) > 1.0 / _UNREAD:
            raise ValueError(
                f"the channels {', '.join(self.channels)} do not determine all six components of "
                "force and moment: estimate contacts from the channels themselves"
            )
        back = np.linalg.pinv(weight[:, None] * h) * weight
        wrench = self.compensated(readings, rotation, gravity) @ back.T
        return np.asarray(wrench), np.asarray(back @ self.covariance() @ back.T)

    def read(
        self, time: ArrayLike, wrench: ArrayLike, seed: int = 0, rotation: ArrayLike | None = None
    ) -> Array:
        """Simulate readings of a wrench over time.

        Parameters
        ----------
        time : array_like (n,)
            Times of the samples, s, not decreasing.
        wrench : array_like (n, 6)
            Force, N, and moment, N·m, at the whisker's base; NaN gives NaN.
        seed : int
            Seed of the random errors.
        rotation : array_like (n, 3, 3), optional
            Rotation from the whisker's to the laboratory frame; needed where the sensor carries a
            mass.

        Returns
        -------
        array (n, k)
            Readings of the channels.
        """
        at, true = numbers("time", time), numbers("wrench", wrench, COMPONENTS)
        if at.ndim != 1 or true.shape != (at.size, 6):
            raise ValueError(
                f"times (n,) and wrenches (n, 6) are needed; got {at.shape} and {true.shape}"
            )
        if not np.isfinite(at).all() or (np.diff(at) < 0.0).any():
            raise ValueError(f"times must be finite and not decrease; got {_first_fault(at)}")
        generator = np.random.default_rng(seed)
        if self.mass > 0.0 or self.mass_moment.any():
            if rotation is None:
                raise ValueError("the sensor carries a mass, so the rotation is needed")
            true = true + self.weight(rotation)
        reading = true @ self.base_mixing.T
        size = reading.shape
        noise = generator.normal(size=size) * self.noise
        if self.relative_noise > 0.0:
            reading = reading * (1.0 + generator.normal(scale=self.relative_noise, size=size))
        errors = self.common_errors
        wrong = np.tensordot(generator.normal(size=len(errors)), errors, axes=1)
        reading = reading + true @ wrong[:, :6].T + wrong[:, 6]
        reading = reading + self.bias + noise
        if (self.drift > 0.0).any():
            steps = np.sqrt(np.diff(at, prepend=at[:1]))
            walk = generator.normal(size=size) * steps[:, None] * self.drift
            reading = reading + np.cumsum(walk, axis=0)
        coarse = self.resolution > 0.0
        steps = np.where(coarse, self.resolution, 1.0)
        reading = np.where(coarse, np.round(reading / steps) * steps, reading)
        return np.asarray(np.clip(reading, -self.largest, self.largest))


def _checked_mixing(names: tuple[str, ...], mixing: Any, faults: list[str]) -> Array:
    """Mixing (k, 6) of channels; errors are appended to ``faults``."""
    array = numbers("mixing", 1.0 if mixing is None else mixing, COMPONENTS).copy()
    if array.ndim < 2:
        if unknown := [name for name in names if name not in COMPONENTS]:
            known = ", ".join(COMPONENTS)
            faults.append(f"channels {unknown} are not among {known}, so mixing (k, 6) is needed")
        rows = [[float(name == component) for component in COMPONENTS] for name in names]
        if array.shape not in ((), (len(names),)):
            faults.append(f"mixing has shape {array.shape}; one number per channel is needed")
            array = np.ones(())
        array = array[..., None] * np.array(rows).reshape(-1, 6)
    if array.shape != (len(names), 6) or not np.isfinite(array).all():
        faults.append(f"mixing has shape {array.shape}; finite ({len(names)}, 6) is needed")
    return np.asarray(array)


def _checked_numbers(
    sensor: Sensor, mixing: Array, channels: int, faults: list[str]
) -> dict[str, Array]:
    """Values (k,) of all channels by name; errors are appended to ``faults``."""
    usual = np.repeat([FORCE_NOISE, MOMENT_NOISE], 3)
    checked = {}
    for name in ("noise", "bias", "drift", "resolution", "largest", "gain_error"):
        value = getattr(sensor, name)
        if value is None and mixing.shape == (channels, 6):
            value = np.sqrt(mixing**2 @ usual**2)
        array = numbers(name, value, sensor.channels)
        finite = np.isfinite(array) | ((name == "largest") & (array == np.inf))
        if array.shape not in ((), (channels,)):
            faults.append(f"{name} has shape {array.shape}; () or ({channels},) is needed")
        elif not finite.all():
            faults.append(f"{name} is {array.tolist()}; it must be finite")
        elif name == "largest" and not (array > 0.0).all():
            faults.append(f"{name} is {array.tolist()}; it must be positive")
        elif name != "bias" and (array < 0.0).any():
            faults.append(f"{name} is {array.tolist()}; it must not be negative")
        else:
            checked[name] = np.broadcast_to(array, (channels,))
    return checked


def _first_fault(time: Array) -> str:
    """Describe the first time that decreases or is not finite."""
    bad = ~np.isfinite(time)
    bad[1:] |= np.diff(time) < 0.0
    i = int(bad.argmax())
    return f"{time[i]} s" + (f" after {time[i - 1]} s" if i else "") + f" at index {i}"


def _by_gain(mixing: Array, sigma: Array) -> Array:
    """Shared errors (n, k, 7) of gain."""
    which = np.flatnonzero(sigma > 0.0)
    out = np.zeros((which.size, len(mixing), 7))
    out[range(which.size), which, :6] = sigma[which, None] * mixing[which]
    return out


def _by_mixing(mixing: Array, sigma: Array) -> Array:
    """Shared errors (n, k, 7) of the mixing."""
    if sigma.ndim == 0:
        largest = np.abs(mixing.reshape(-1, 2, 3)).max(axis=2)
        sigma = sigma * np.repeat(largest, 3, axis=1)
    channel, component = np.nonzero(sigma)
    out = np.zeros((channel.size, len(mixing), 7))
    out[range(channel.size), channel, component] = sigma[channel, component]
    return out


def _by_calibration(covariance: Array) -> Array:
    """Shared errors (n, k, 7) equivalent to the covariance (k, 7, 7) of a calibration."""
    found = [np.zeros((0, len(covariance), 7))]
    for channel, own in enumerate(covariance):
        size = np.sqrt(np.diag(own))
        size = np.where(size > 0.0, size, 1.0)
        values, axes = np.linalg.eigh(own / np.outer(size, size))
        kept = values > _ROUNDING
        errors = np.zeros((int(kept.sum()), len(covariance), 7))
        errors[:, channel] = (axes[:, kept] * np.sqrt(values[kept])).T * size
        found.append(errors)
    return np.concatenate(found)


def with_offset(covariance: Array, variance: Array) -> Array:
    """Covariance (k, 7, 7) of mixing and offset after the offset alone was measured again."""
    out = covariance.copy()
    out[:, 6, :] = out[:, :, 6] = 0.0
    out[:, 6, 6] = variance
    return out


def _checked_covariance(value: Any, channels: int, faults: list[str]) -> Array:
    """Covariance (k, 7, 7) of mixing and offset; errors are appended to ``faults``."""
    shape = (channels, 7, 7)
    covariance = numbers("mixing_covariance", np.zeros(shape) if value is None else value)
    if covariance.shape != shape or not np.isfinite(covariance).all():
        faults.append(f"mixing_covariance has shape {covariance.shape}; finite {shape} is needed")
        return covariance
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    size = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    correlation = covariance / (size[:, :, None] * size[:, None, :])
    if not np.allclose(correlation, np.swapaxes(correlation, 1, 2), rtol=0.0, atol=_INDEFINITE):
        faults.append("mixing_covariance is not symmetric")
    elif (variances < 0.0).any() or np.linalg.eigvalsh(correlation).min() < -_INDEFINITE:
        faults.append("mixing_covariance has negative eigenvalues, so it is not a covariance")
    return covariance
