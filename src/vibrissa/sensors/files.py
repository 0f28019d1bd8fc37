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
from numpy.typing import NDArray

from vibrissa.io import number_array, quoted, read_toml, replacing
from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.sensor import Sensor

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
    said = read_toml(path)
    try:
        return _described(said)
    except ValueError as error:
        raise ValueError(f"{path} describes no sensor: {error}") from error


def _described(said: dict[str, Any]) -> Sensor:
    """The sensor that a file describes."""
    frame, weight = _table(said, "frame"), _table(said, "weight")
    _only(said, _TOP, "the file")
    _only(frame, _FRAME, "[frame]")
    _only(weight, _WEIGHT, "[weight]")
    how: dict[str, Any] = {}
    if "channels" in said:
        names = said["channels"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"channels is {quoted(names)}; a list of names is needed")
        how["channels"] = names
    for name in ("mixing", *_NUMBERS, *_OTHERS):
        if name in said:
            how[name] = number_array(said[name], name)
    if "relative_noise" in said:
        how["relative_noise"] = _one(said["relative_noise"], "relative_noise")
    reaction = frame.get("reaction", False)
    if not isinstance(reaction, bool):
        raise ValueError(f"reaction is {quoted(reaction)}; true or false is needed")
    sensor = Sensor(
        **how,
        frame=SensorFrame(
            axes=_axes(frame.get("axes", ["x", "y", "z"])),
            position=_three(frame.get("position", [0.0, 0.0, 0.0]), "position"),
            reaction=reaction,
        ),
        mass=_one(weight.get("mass", 0.0), "mass"),
        mass_moment=_three(weight.get("moment", [0.0, 0.0, 0.0]), "moment"),
    )
    if "noise" not in said:
        raise ValueError(
            "noise is needed: the standard deviation of each channel, in its unit, or one "
            "number for all; what is felt and how surely depends on it"
        )
    return sensor


def _table(said: dict[str, Any], name: str) -> dict[str, Any]:
    table = said.get(name, {})
    if not isinstance(table, dict):
        raise ValueError(f"{name} is {quoted(table)}; it is written as a table, [{name}]")
    return table


def _only(table: dict[str, Any], known: set[str], where: str) -> None:
    unknown = sorted(set(table) - known)
    if unknown:
        raise ValueError(
            f"{where} has {', '.join(unknown)}; it may have {', '.join(sorted(known))}"
        )


def _one(value: Any, name: str) -> float:
    array = number_array(value, name)
    if array.ndim:
        raise ValueError(f"{name} is {quoted(value)}; one number is needed")
    return float(array)


def _three(value: Any, name: str) -> NDArray[np.float64]:
    array = number_array(value, name)
    if array.shape != (3,):
        raise ValueError(f"{name} is {quoted(value)}; three numbers are needed")
    return array


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
