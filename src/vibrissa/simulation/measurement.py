"""Measurement of a simulated trial by a sensor at the base."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.recording import Recording, recorded
from vibrissa.sensors import COMPONENTS, FORCE_NOISE, MOMENT_NOISE, Sensor

Array = NDArray[np.float64]


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
        Recording with ``force`` and ``moment`` in the group ``truth``.
    force_noise : float
        Standard deviation of each component of the force, N: white, Gaussian.
    moment_noise : float
        Standard deviation of each component of the moment, N·m.
    seed : int
        Seed of the noise.
    sensor : Sensor, optional
        Sensor instead of one with that noise only.

    Returns
    -------
    xarray.DataTree
        New recording, whose ``force`` and ``moment`` at the top are the sensor's readings, with
        their noise in the attribute ``noise``. Missing frames stay missing. A sensor with other
        channels gives ``reading`` and its ``mixing`` instead of them.

    Raises
    ------
    ValueError
        If a noise is negative, or if the recording has no true wrench.
    """
    for name, value in (("force_noise", force_noise), ("moment_noise", moment_noise)):
        if not (np.isfinite(value) and value >= 0.0):
            raise ValueError(f"{name} is {value!r}; it must not be negative")
    names = ("force", "moment")
    truth = Recording(recording).find("truth")
    if truth is None or not all(name in truth for name in names):
        raise ValueError("the recording has no true force and moment to measure")
    if sensor is None:
        sensor = Sensor(noise=np.repeat([force_noise, moment_noise], 3))
    wrench = np.concatenate([truth[name] for name in names], axis=-1)
    time = np.asarray(recording.to_dataset()["time"].values, dtype=np.float64)
    # One sensor a whisker: each has noise of its own.
    readings = [sensor.read(time, wrench[:, i], seed + i) for i in range(wrench.shape[1])]
    reading = np.stack(readings, axis=1)
    measured = recording.copy()
    if sensor.reads_wrench:
        parts = {"force": slice(0, 3), "moment": slice(3, 6)}
        rows = {name: recorded(name, reading[..., part]) for name, part in parts.items()}
        for name, part in parts.items():
            rows[name].attrs["noise"] = _one(sensor.noise[part])
        measured.dataset = recording.to_dataset().assign(rows)
        return measured
    channels = recorded("reading", reading)
    channels.attrs["noise"] = np.asarray(sensor.noise)
    dataset = recording.to_dataset().drop_vars(names, errors="ignore")
    measured.dataset = dataset.assign(
        reading=channels, mixing=recorded("mixing", sensor.mixing)
    ).assign_coords(channel=list(sensor.channels), component=list(COMPONENTS))
    return measured


def _one(values: Array) -> float | Array:
    """One number where all are the same."""
    return float(values[0]) if (values == values[0]).all() else values
