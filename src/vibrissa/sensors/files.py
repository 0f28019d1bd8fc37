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

A maker's matrix may be given the other way round, from the channels to Fx, Fy, Fz, Mx, My, Mz, as
``calibration`` (6 lines, a number a channel) instead of ``mixing``. A matrix that seems to be under
the wrong name is refused: of a sensor that is small compared with a metre, readings per N·m are
larger than those per N.

Everything but channels and noise may be left out. Channels that are components in other units
need one number only: ``mixing = 1e3`` for mN and mN·m (= N·mm). Noise, bias and the largest reading
are in the channels' units.
"""

from __future__ import annotations

import json
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
_TOP = {"channels", "mixing", "calibration", *_NUMBERS, *_OTHERS, "frame", "weight"}
_FRAME = {"axes", "position", "reaction"}
_WEIGHT = {"mass", "moment"}
_APART, _ALIKE = 3.0, 2.0
"""Ratios of readings per N·m and per N from which they differ, and up to which they are alike."""


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
    if "calibration" in table:
        if "mixing" in table:
            raise ValueError("calibration is another form of mixing: one of them is needed")
        values["mixing"] = _inverted(number_array(table["calibration"], "calibration"))
    elif _has_halves(values.get("mixing")) and _apart(values["mixing"].T):
        raise ValueError(
            "mixing seems to lead from the channels to forces and moments, as its lines of moments "
            "are the small ones; if so, name it calibration"
        )
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


def _inverted(calibration: Any) -> Any:
    """Mixing (k, 6) of a matrix (6, k) from channels to forces and moments."""
    if calibration.ndim != 2 or len(calibration) != 6 or calibration.shape[1] < 6:
        raise ValueError(
            f"calibration has shape {calibration.shape}; six lines are needed, of Fx, Fy, Fz, Mx, "
            "My, Mz, with a number for each of six or more channels"
        )
    if np.linalg.matrix_rank(calibration) < 6:
        raise ValueError("calibration has no inverse: its six lines are not independent")
    if calibration.shape == (6, 6) and _apart(calibration):
        raise ValueError(
            "calibration seems to lead from forces and moments to the channels, as its columns of "
            "moments are the large ones; if so, name it mixing"
        )
    return np.linalg.pinv(calibration)


def _has_halves(matrix: Any) -> bool:
    """Whether a matrix is (6, 6), and none of the halves of its lines and columns is zero."""
    if np.shape(matrix) != (6, 6):
        return False
    return all(half.any() for m in (matrix, matrix.T) for half in (m[:3], m[3:]))


def _apart(matrix: Any) -> bool:
    """Whether columns (6, 6) of forces and moments differ in size as of wrenches, and lines not."""
    lines, columns = (np.linalg.norm(m[3:]) / np.linalg.norm(m[:3]) for m in (matrix, matrix.T))
    differ = max(columns, 1.0 / columns) > _APART
    return bool(differ and max(lines, 1.0 / lines) < _ALIKE)


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
    lines = [f"channels = {json.dumps(sensor.channels, ensure_ascii=False)}"]
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


def _array(values: Any) -> str:
    return str(np.asarray(values, dtype=np.float64).tolist())
