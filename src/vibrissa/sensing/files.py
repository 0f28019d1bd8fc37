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

import tomllib
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from vibrissa.io.replace import replacing
from vibrissa.io.table import read_text
from vibrissa.sensing.frame import SensorFrame
from vibrissa.sensing.sensor import Sensor

_NUMBERS = ("noise", "bias", "drift", "resolution", "largest", "gain_error")
_OTHERS = ("relative_noise", "mixing_error", "mixing_covariance")
_TOP = {"channels", "mixing", *_NUMBERS, *_OTHERS, "frame", "weight"}
_FRAME = {"axes", "position", "reaction"}
_WEIGHT = {"mass", "moment"}


def load_sensor(path: str | PathLike[str]) -> Sensor:
    """Read a sensor.

    Parameters
    ----------
    path : str or path
        TOML file.

    Returns
    -------
    Sensor
        As it says.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no TOML, has unknown keys, or describes no sensor.
    """
    path = Path(path)
    try:
        said = tomllib.loads(read_text(path))
        frame, weight = said.get("frame", {}), said.get("weight", {})
        for what, table, known in (
            ("the file", said, _TOP),
            ("[frame]", frame, _FRAME),
            ("[weight]", weight, _WEIGHT),
        ):
            unknown = sorted(set(table) - known)
            if unknown:
                raise ValueError(
                    f"{what} has {', '.join(unknown)}; it may have {', '.join(sorted(known))}"
                )
        given = {name: said[name] for name in (*_NUMBERS, *_OTHERS) if name in said}
        how: dict[str, Any] = {"channels": said["channels"]} if "channels" in said else {}
        sensor = Sensor(
            **how,
            mixing=said.get("mixing"),
            **given,
            frame=SensorFrame(**frame),
            mass=weight.get("mass", 0.0),
            mass_moment=weight.get("moment", (0.0, 0.0, 0.0)),
        )
        if "noise" not in said:
            raise ValueError(
                "noise is needed: the standard deviation of each channel, in its unit, or one "
                "number for all; what is felt and how surely depends on it"
            )
        return sensor
    except (tomllib.TOMLDecodeError, TypeError, ValueError) as error:
        raise ValueError(f"{path} describes no sensor: {error}") from error


def save_sensor(path: str | PathLike[str], sensor: Sensor) -> None:
    """Write a sensor that `load_sensor` reads, every number in full.

    Parameters
    ----------
    path : str or path
        Where to write; an existing file is replaced.
    sensor : Sensor
        Which.
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
