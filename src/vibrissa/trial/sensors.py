"""A force and torque sensor at the base: what it reads, and how wrongly.

A sensor has channels, each a linear mix of the six components (F_x, F_y, F_z, M_x, M_y, M_z):

    reading = round((1 + g)(1 + ε)(A w) + b + d(t) + n),

with the mixing A, an error of gain g and noise ε relative to the signal, a bias b, a drift d that
is a random walk, white noise n, and rounding to the channel's resolution. The usual sensor has the
six components themselves as channels; whiskers of robots often have two or three.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.quantities import attributes

Array = NDArray[np.float64]

FORCE_NOISE = 1e-6
"""Standard deviation of a component of the measured force, N."""

MOMENT_NOISE = 0.02e-6
"""Standard deviation of a component of the measured moment, N·m."""

COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""What a mix is made of, in this order."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """What a sensor at the base reads.

    Quantities of channels are numbers for all of them or one number each, in the channel's unit:
    that of the component it reads (N, N·m), or what the mixing makes of those.

    Parameters
    ----------
    channels : sequence of str
        Their names. Without a mixing, which components are read.
    mixing : array_like (k, 6), optional
        What each of the k channels reads of (Fx, Fy, Fz, Mx, My, Mz).
    noise : array_like, optional
        Standard deviation of white noise; by default that of `FORCE_NOISE` and `MOMENT_NOISE` in
        every component.
    bias : array_like
        Constant offset.
    drift : array_like
        Standard deviation of a random walk after one second; it begins at zero.
    resolution : array_like
        Readings are rounded to multiples of this; 0 for none.
    relative_noise : float
        Standard deviation of white noise relative to the signal.
    gain_error : float
        Standard deviation of the channels' errors of gain, which are drawn once.

    Raises
    ------
    ValueError
        If numbers do not fit or are negative where they cannot be.

    Examples
    --------
    >>> Sensor(channels=("Fx", "My", "Mz"), resolution=[1e-6, 1e-8, 1e-8]).mixing.shape
    (3, 6)
    """

    channels: Sequence[str] = COMPONENTS
    mixing: Any = None
    noise: Any = None
    bias: Any = 0.0
    drift: Any = 0.0
    resolution: Any = 0.0
    relative_noise: float = 0.0
    gain_error: float = 0.0

    def __post_init__(self) -> None:
        """Check, and give every channel its numbers."""
        faults = []
        names = tuple(self.channels)
        if not names or len(set(names)) != len(names):
            faults.append(f"channels are {names}; different names, at least one, are needed")
        if self.mixing is None:
            unknown = [name for name in names if name not in COMPONENTS]
            if unknown:
                known = ", ".join(COMPONENTS)
                faults.append(f"channels {unknown} are none of {known}, and there is no mixing")
            rows = [[float(name == component) for component in COMPONENTS] for name in names]
            mixing = np.array(rows).reshape(-1, 6)
        else:
            mixing = np.array(self.mixing, dtype=np.float64)
            if mixing.shape != (len(names), 6) or not np.isfinite(mixing).all():
                faults.append(
                    f"mixing has shape {mixing.shape}; finite ({len(names)}, 6) is needed"
                )
        usual = np.repeat([FORCE_NOISE, MOMENT_NOISE], 3)
        numbers = {"mixing": mixing, "channels": names}
        for name in ("noise", "bias", "drift", "resolution"):
            value = getattr(self, name)
            if value is None and mixing.shape == (len(names), 6):
                value = np.sqrt(mixing**2 @ usual**2)
            array = np.asarray(value, dtype=np.float64)
            if array.shape not in ((), (len(names),)) or not np.isfinite(array).all():
                faults.append(f"{name} has shape {array.shape}; () or ({len(names)},) is needed")
            elif name != "bias" and (array < 0.0).any():
                faults.append(f"{name} is {array.tolist()}; it must not be negative")
            else:
                numbers[name] = np.broadcast_to(array, (len(names),))
        for name in ("relative_noise", "gain_error"):
            share = float(getattr(self, name))
            if not (np.isfinite(share) and share >= 0.0):
                faults.append(f"{name} is {share!r}; it must not be negative")
        if faults:
            raise ValueError("no sensor: " + "; ".join(faults))
        for name, value in numbers.items():
            object.__setattr__(self, name, value)

    @property
    def reads_wrench(self) -> bool:
        """Whether the channels are the six components, in their order."""
        return self.channels == COMPONENTS and bool((self.mixing == np.eye(6)).all())

    def read(self, time: ArrayLike, wrench: ArrayLike, seed: int = 0) -> Array:
        """Read a wrench over time.

        Parameters
        ----------
        time : array_like (n,)
            Of the samples, s.
        wrench : array_like (n, 6)
            Force, N, and moment, N·m, of the base; NaN gives NaN.
        seed : int
            Of all that is random.

        Returns
        -------
        array (n, k)
            The channels.
        """
        at, true = np.asarray(time, dtype=np.float64), np.asarray(wrench, dtype=np.float64)
        generator = np.random.default_rng(seed)
        reading = true @ self.mixing.T
        size = reading.shape
        noise = generator.normal(size=size) * self.noise
        if self.relative_noise > 0.0:
            reading = reading * (1.0 + generator.normal(scale=self.relative_noise, size=size))
        if self.gain_error > 0.0:
            reading = reading * (1.0 + generator.normal(scale=self.gain_error, size=size[1]))
        reading = reading + self.bias + noise
        if (self.drift > 0.0).any():
            steps = np.sqrt(np.diff(at, prepend=at[:1]))
            walk = generator.normal(size=size) * steps[:, None] * self.drift
            reading = reading + np.cumsum(walk, axis=0)
        coarse = self.resolution > 0.0
        steps = np.where(coarse, self.resolution, 1.0)
        return np.asarray(np.where(coarse, np.round(reading / steps) * steps, reading))


def measure(
    recording: xr.DataTree,
    force_noise: float = FORCE_NOISE,
    moment_noise: float = MOMENT_NOISE,
    seed: int = 0,
    *,
    sensor: Sensor | None = None,
) -> xr.DataTree:
    """Measure the wrench of a simulated trial.

    Parameters
    ----------
    recording : xarray.DataTree
        A recording with ``force`` and ``moment`` in the group ``truth``.
    force_noise : float
        Standard deviation of each component of the force, N: white, Gaussian.
    moment_noise : float
        Standard deviation of each component of the moment, N·m.
    seed : int
        Of the noise.
    sensor : Sensor, optional
        Instead of one with that noise only.

    Returns
    -------
    xarray.DataTree
        A new recording, whose ``force`` and ``moment`` at the top are what the sensor reads and say
        in the attribute ``noise`` how much of that it has. Missing frames stay missing. A sensor
        with other channels gives ``reading`` and its ``mixing`` instead of them.

    Raises
    ------
    ValueError
        If a noise is negative, or if the recording has no true wrench.
    """
    for name, value in (("force_noise", force_noise), ("moment_noise", moment_noise)):
        if not (np.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} is {value!r}; it must not be negative")
    truth = recording.children.get("truth")
    if truth is None or not {"force", "moment"} <= set(truth.data_vars):
        raise ValueError("the recording has no true force and moment to measure")
    if sensor is None:
        sensor = Sensor(noise=np.repeat([force_noise, moment_noise], 3))
    names = ("force", "moment")
    true = {name: truth[name].variable.transpose("time", "whisker", "space") for name in names}
    wrench = np.concatenate([true[name].values for name in names], axis=-1)
    time = np.asarray(recording.to_dataset()["time"].values, dtype=np.float64)
    # One sensor a whisker: each has noise of its own.
    readings = [sensor.read(time, wrench[:, i], seed + i) for i in range(wrench.shape[1])]
    reading = np.stack(readings, axis=1)
    measured = recording.copy()
    if sensor.reads_wrench:
        rows = {
            name: xr.Variable(
                true[name].dims,
                reading[..., part],
                {**true[name].attrs, "noise": _one(sensor.noise[part])},
            )
            for name, part in (("force", slice(0, 3)), ("moment", slice(3, 6)))
        }
        measured.dataset = recording.to_dataset().assign(rows)
        return measured
    noise = {"noise": np.asarray(sensor.noise)}
    dataset = recording.to_dataset().drop_vars(names, errors="ignore")
    measured.dataset = dataset.assign(
        reading=(("time", "whisker", "channel"), reading, attributes("reading") | noise),
        mixing=(("channel", "component"), np.asarray(sensor.mixing), attributes("mixing")),
    ).assign_coords(channel=list(sensor.channels), component=list(COMPONENTS))
    return measured


def _one(values: Array) -> float | Array:
    """One number where all are the same."""
    return float(values[0]) if (values == values[0]).all() else values
