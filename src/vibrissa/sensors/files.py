"""Sensors as TOML, in SI units.

    channels = ["Fx", "My", "Mz"]
    mixing = [[1, 0, 0, 0, 0, 0], …]   # a line a channel: of Fx, Fy, Fz, Mx, My, Mz
    noise = [1e-6, 2e-8, 2e-8]         # standard deviations; or one number for all
    bias = 0.0
    gain_error = 0.01                  # relative standard deviation, the same error in all readings
    mixing_error = 0.01                # or a matrix of standard deviations, as mixing
    mixing_covariance = [[[1e-6, …], …], …]   # a channel: 7 × 7, of its mixing and offset

    [frame]
    axes = ["x", "-z", "y"]            # or a 3 × 3 matrix, the sensor's axes in its columns
    position = [0, 0, -0.004]          # m
    reaction = false

    [weight]
    mass = 0.002                       # kg
    moment = [0, 0, 0]                 # kg·m

Everything but channels and noise may be left out. Channels that are components in other units
need one number only: ``mixing = 1e3`` for mN and mN·m (= N·mm). Noise, bias and the largest reading
are in the channels' units.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.io import (
    check_keys,
    number_array,
    one_number,
    quoted,
    read_toml,
    replacing,
    subtable,
    three_numbers,
)
from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.sensor import Sensor

_NUMBERS = ("noise", "bias", "drift", "resolution", "largest", "gain_error")
_OTHERS = ("relative_noise", "mixing_error", "mixing_covariance")
_TOP = {"channels", "mixing", *_NUMBERS, *_OTHERS, "frame", "weight"}
_FRAME = {"axes", "position", "reaction"}
_WEIGHT = {"mass", "moment"}


def load_sensor(path: str | PathLike[str]) -> Sensor:
    """Sensor of a file.

    Parameters
    ----------
    path : str or path
        Path of the TOML file.

    Returns
    -------
    Sensor
        Sensor that the file describes.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not TOML, has unknown keys, or does not describe a sensor.
    """
    path = Path(path)
    table = read_toml(path)
    try:
        return _described(table)
    except ValueError as error:
        raise ValueError(f"{path} describes no sensor: {error}") from error


def _described(table: dict[str, Any]) -> Sensor:
    """Sensor that a file describes."""
    frame, weight = subtable(table, "frame"), subtable(table, "weight")
    check_keys(table, _TOP, "the file")
    check_keys(frame, _FRAME, "[frame]")
    check_keys(weight, _WEIGHT, "[weight]")
    values: dict[str, Any] = {}
    if "channels" in table:
        names = table["channels"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"channels is {quoted(names)}; a list of names is needed")
        values["channels"] = names
    for name in ("mixing", *_NUMBERS, *_OTHERS):
        if name in table:
            values[name] = number_array(table[name], name)
    if "relative_noise" in table:
        values["relative_noise"] = one_number(table, "relative_noise", 0.0)
    reaction = frame.get("reaction", False)
    if not isinstance(reaction, bool):
        raise ValueError(f"reaction is {quoted(reaction)}; true or false is needed")
    sensor = Sensor(
        **values,
        frame=SensorFrame(
            axes=_axes(frame.get("axes", ["x", "y", "z"])),
            position=three_numbers(frame, "position", [0.0, 0.0, 0.0]),
            reaction=reaction,
        ),
        mass=one_number(weight, "mass", 0.0),
        mass_moment=three_numbers(weight, "moment", [0.0, 0.0, 0.0]),
    )
    if "noise" not in table:
        raise ValueError(
            "noise is needed: the standard deviation of each channel, in its unit, or one "
            "number for all; which contacts are detected and with what uncertainty depends on it"
        )
    return sensor


def _axes(value: Any) -> Any:
    """Axes by name as they are, or the numbers of a matrix."""
    named = isinstance(value, list) and all(isinstance(name, str) for name in value)
    if named or isinstance(value, str):
        return value
    axes = number_array(value, "axes")
    if axes.shape != (3, 3):
        raise ValueError(f"axes is {quoted(value)}; three names, or three rows of three numbers")
    return axes


def save_sensor(path: str | PathLike[str], sensor: Sensor) -> None:
    """Write a sensor that `load_sensor` reads, every number in full.

    Parameters
    ----------
    path : str or path
        Path to write to; an existing file is replaced.
    sensor : Sensor
        Sensor to write.
    """
    lines = [f"channels = [{', '.join(_text(name) for name in sensor.channels)}]"]
    lines.append(f"mixing = {_array(sensor.mixing)}")
    lines += [f"{name} = {_array(getattr(sensor, name))}" for name in _NUMBERS]
    lines.append(f"relative_noise = {float(sensor.relative_noise)!r}")
    lines += [
        f"{name} = {_array(getattr(sensor, name))}"
        for name in ("mixing_error", "mixing_covariance")
        if getattr(sensor, name).any()
    ]
    lines += ["", "[frame]", f"axes = {_array(sensor.frame.axes)}"]
    lines.append(f"position = {_array(sensor.frame.position)}")
    lines.append(f"reaction = {'true' if sensor.frame.reaction else 'false'}")
    lines += ["", "[weight]", f"mass = {float(sensor.mass)!r}"]
    lines += [f"moment = {_array(sensor.mass_moment)}", ""]
    with replacing(path) as part:
        part.write_text("\n".join(lines), encoding="utf-8")


def _text(name: str) -> str:
    return '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _array(values: Any) -> str:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0:
        return repr(float(array))
    if array.ndim == 1:
        return "[" + ", ".join(repr(float(value)) for value in array) + "]"
    return "[" + ", ".join(_array(row) for row in array) + "]"
