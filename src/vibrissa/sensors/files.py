"""Files of sensors, and descriptions of tables from a positioning stage.

Sensors are described in TOML files, in SI units (docs: Robot whiskers, The sensor). Only channels
and noise are required. A matrix that seems to have the wrong name, ``mixing`` or ``calibration``,
is an error: for a sensor that is small compared with a metre, readings per N·m are larger than
those per N.

Tables of a positioning stage (touches at known points, the resting shape, sweeps) have a
description in TOML as well (docs: Robot whiskers, A Hall sensor), which a calibrated sensor's
NetCDF file includes. Files are relative to the description's folder.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vibrissa.deferred import xr
from vibrissa.io import (
    check_keys,
    in_file,
    is_netcdf,
    number_array,
    one_number,
    parsed_toml,
    quoted,
    read_dataset,
    read_numbers,
    read_text,
    read_toml,
    replacing,
    subtable,
    three_numbers,
    write_netcdf,
)
from vibrissa.numerics import Array
from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.regression import ThinPlate
from vibrissa.sensors.sensor import Sensor
from vibrissa.sensors.suspended import FEATURES, SuspendedWhisker
from vibrissa.sensors.suspension import SuspensionCalibration
from vibrissa.whisker import Whisker

_FARTHEST = 1.0  # distance of a sensor from the base, m, above which it may be in mm
_NUMBERS = ("noise", "bias", "drift", "resolution", "largest", "gain_error")
_OTHERS = ("relative_noise", "mixing_error", "mixing_covariance")
_TOP = {"channels", "mixing", "calibration", *_NUMBERS, *_OTHERS, "frame", "weight"}
_FRAME = {"axes", "position", "reaction"}
_WEIGHT = {"mass", "moment"}
# Smallest ratio of two sizes (readings per N·m and per N) that differ, and largest of similar ones.
_APART, _ALIKE = 3.0, 2.0


def load_sensor(path: str | PathLike[str]) -> Sensor:
    """Read a sensor from a TOML file.

    Parameters
    ----------
    path : str or path
        Path of the TOML file.

    Returns
    -------
    Sensor
        Sensor that the file describes.
    """
    path = Path(path)
    if is_netcdf(path):
        raise ValueError(f"{path} is NetCDF; a sensor is described in TOML{_only_for_sweeps(path)}")
    table = read_toml(path)
    try:
        return _described(table)
    except ValueError as error:
        raise ValueError(f"{path} describes no sensor: {error}") from error


def _only_for_sweeps(path: Path) -> str:
    """What a calibrated suspended whisker is for; empty for other files."""
    suspended = read_dataset(path).attrs.get("kind") == KIND
    return ", and a suspended whisker is only for sweeps (`vibrissa estimate`)" * suspended


def _described(table: dict[str, Any]) -> Sensor:
    """Sensor described by the contents of a file."""
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
            raise ValueError("calibration is the inverse of mixing: give one of them")
        values["mixing"] = _inverted(number_array(table["calibration"], "calibration"))
    elif _has_halves(values.get("mixing")) and _apart(values["mixing"].T):
        raise ValueError(
            "mixing seems to lead from the channels to forces and moments, as its last three rows "
            "are the small ones; if so, name it calibration"
        )
    _check_lever(values.get("mixing"))
    position = three_numbers(frame, "position", [0.0, 0.0, 0.0])
    if (away := float(np.linalg.norm(position))) > _FARTHEST:
        warnings.warn(
            f"the sensor's position is {away:.4g} m from the base of the whisker: is it in mm?",
            stacklevel=5,
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
            position=position,
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
    """Mixing (k, 6) as the inverse of a matrix (6, k) from channels to forces and moments."""
    if calibration.ndim != 2 or len(calibration) != 6 or calibration.shape[1] < 6:
        raise ValueError(
            f"calibration has shape {calibration.shape}; six rows are needed, for Fx, Fy, Fz, Mx, "
            "My, Mz, with a number for each of six or more channels"
        )
    if np.linalg.matrix_rank(calibration) < 6:
        raise ValueError("calibration has no inverse: its six rows are not independent")
    if calibration.shape == (6, 6) and _apart(calibration):
        raise ValueError(
            "calibration seems to lead from forces and moments to the channels, as its last three "
            "columns are the large ones; if so, name it mixing"
        )
    return np.linalg.pinv(calibration)


def _check_lever(mixing: Any) -> None:
    """Warn if a sensor is implausibly insensitive to moments compared with forces."""
    if np.shape(mixing)[1:] != (6,):
        return
    force, moment = np.linalg.norm(mixing[:, :3]), np.linalg.norm(mixing[:, 3:])
    if force > _APART * moment > 0.0:
        warnings.warn(
            f"a force of 1 N causes the same reading as a moment of {force / moment:.3g} N·m: is "
            "the matrix the inverse (mixing: from forces and moments to the channels; calibration: "
            "from the channels to forces and moments), or in units other than N and N·m?",
            stacklevel=5,
        )


def _has_halves(matrix: Any) -> bool:
    """Whether a matrix is (6, 6), and no half of its rows or columns is zero."""
    if np.shape(matrix) != (6, 6):
        return False
    return all(half.any() for m in (matrix, matrix.T) for half in (m[:3], m[3:]))


def _apart(matrix: Any) -> bool:
    """Whether the columns of forces and moments differ in size as in a mixing, and rows do not."""
    lines, columns = (np.linalg.norm(m[3:]) / np.linalg.norm(m[:3]) for m in (matrix, matrix.T))
    differ = max(columns, 1.0 / columns) > _APART
    return bool(differ and max(lines, 1.0 / lines) < _ALIKE)


def _axes(value: Any) -> Any:
    """Names of axes, or a matrix of numbers."""
    named = isinstance(value, list) and all(isinstance(name, str) for name in value)
    if named or isinstance(value, str):
        return value
    axes = number_array(value, "axes")
    if axes.shape != (3, 3):
        raise ValueError(f"axes is {quoted(value)}; three names, or three rows of three numbers")
    return axes


def save_sensor(path: str | PathLike[str], sensor: Sensor) -> None:
    """Write a sensor to a file for `load_sensor`, with full precision.

    Parameters
    ----------
    path : str or path
        Path to write to; an existing file is replaced.
    sensor : Sensor
        Sensor to write.
    """
    if not isinstance(sensor, Sensor):
        raise TypeError(f"save_sensor(path, sensor) needs a Sensor; got {type(sensor).__name__}")
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
    """Array as TOML text."""
    return str(np.asarray(values, dtype=np.float64).tolist())


_UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6}
_STAGE_KEYS = {"unit", "readings", "position", "touches", "shape", "whisker", "sweep"}
_TOUCHES = {"file", "origin", "axes", "farthest", "base_sigma", "rest", "drift", "largest"}
_SHAPE = {"file", "columns", "leave_out"}
_WHISKER = {"base_radius", "tip_radius", "youngs_modulus", "noise"}
_SWEEP = {"origin", "axes", "moves"}
_WHISKERS = (1e-3, 5.0)  # lengths of whiskers on a stage, m; others are in another unit
_AT_BASE = 1e-6  # distance from the base up to which a probe is at the base, m


class StageTouches(NamedTuple):
    """Touches read from a table."""

    points: Array  # (n, 3), sensor frame, m
    readings: Array
    rest: Array | None  # as stated, or the median of rows with the probe at the base
    drift: Array  # standard deviation from one recording to the next; zero if unknown


class StageSweep(NamedTuple):
    """Sweep read from a table."""

    readings: Array
    position: Array  # (n, 3), of the sensor's origin in the frame of the touched object, m
    rotation: Array  # (3, 3), from the sensor's frame to that of the object


@dataclass(frozen=True)
class Stage:
    """Description of the tables of a positioning stage."""

    text: str
    folder: Path = Path()

    def __post_init__(self) -> None:
        table = parsed_toml(self.text)
        check_keys(table, _STAGE_KEYS, "the description of the stage")
        for name, keys in (("touches", _TOUCHES), ("whisker", _WHISKER), ("sweep", _SWEEP)):
            check_keys(subtable(table, name), keys, f"[{name}]")
        shapes = table.get("shape", [])
        if not isinstance(shapes, list) or not all(isinstance(s, Mapping) for s in shapes):
            raise ValueError(f"shape is {quoted(shapes)}; write [[shape]] for each table")
        for shape in shapes:
            check_keys(shape, _SHAPE, "[[shape]]")
        if table.get("unit", "mm") not in _UNITS:
            raise ValueError(f"unit is {quoted(table['unit'])}; known are {', '.join(_UNITS)}")

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Stage:
        """Read a description."""
        with in_file(path):
            return cls(read_text(path), Path(path).parent)

    @property
    def _table(self) -> dict[str, Any]:
        return parsed_toml(self.text)

    @property
    def _unit(self) -> float:
        return _UNITS[self._table.get("unit", "mm")]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels."""
        return _names(self._table, "readings")

    @property
    def base_sigma(self) -> float:
        """Standard deviation of the stated position of the base, m."""
        return self._unit * one_number(subtable(self._table, "touches"), "base_sigma", 0.15)

    def _columns(self, file: Any, names: tuple[str, ...]) -> Array:
        """Columns of a table; relative paths are relative to the description."""
        if isinstance(file, Path):
            path = file
        elif isinstance(file, str):
            path = self.folder / file
        else:
            raise ValueError(f"file is {quoted(file)}; the name of a table is needed")
        known, values = read_numbers(path)
        if missing := [name for name in names if name not in known]:
            got = ", ".join(name for name in known if name)
            raise ValueError(f"{path} lacks {', '.join(missing)}; its columns are {got}")
        return values[:, [known.index(name) for name in names]]

    def touches(self) -> StageTouches:
        """Touches of the whisker at known points."""
        own = subtable(self._table, "touches")
        position = self._columns(own.get("file"), _names(self._table, "position"))
        readings = self._columns(own.get("file"), self.channels)
        axes = _directions(own, "touches")
        points = self._unit * (position - three_numbers(own, "origin", (0.0, 0.0, 0.0))) @ axes
        radius = np.linalg.norm(points, axis=1)
        rest = radius <= _AT_BASE
        touched = ~rest & (radius <= self._unit * one_number(own, "farthest", np.inf))
        if "largest" in own:
            largest = number_array(own["largest"], "largest")
            if largest.shape not in ((), readings.shape[1:]):
                raise ValueError(
                    f"largest is {quoted(own['largest'])}; a number, or one per channel, is needed"
                )
            touched &= (np.abs(readings) < largest).all(axis=1)
        if not touched.any():
            near, far = (end / self._unit for end in (radius.min(), radius.max()))
            raise ValueError(
                f"{own['file']}: no row is a touch; probes are {near:.3g} to {far:.3g} "
                f"{self._table.get('unit', 'mm')} from the base: are origin, columns, unit, "
                "farthest and largest right?"
            )
        free = np.median(readings[rest], axis=0) if rest.any() else None
        drift = np.zeros(len(self.channels))
        if "rest" in own:
            stated = number_array(own["rest"], "rest")
            if free is not None and stated.shape == free.shape:
                drift = np.abs(free - stated)
            free = stated
        if "drift" in own:
            drift = number_array(own["drift"], "drift")
        return StageTouches(points[touched], readings[touched], free, drift)

    def whisker(self) -> Whisker:
        """Whisker at rest, in the sensor's frame, with the base at the origin."""
        shapes = self._table.get("shape", [])
        if not shapes:
            raise ValueError("[[shape]] is missing: points along the whisker at rest are needed")
        found: dict[str, Array] = {}
        tables = [self._shape(shape) for shape in shapes]
        found |= tables[0]
        for other in tables[1:]:
            shared = [name for name in other if name in tables[0]]
            for name in set(other) - set(found):
                if not shared:
                    raise ValueError("two tables of the shape have no coordinate in common")
                found[name] = _read_off(other[shared[0]], other[name], found[shared[0]], shared[0])
        if lacking := [name for name in "xyz" if name not in found]:
            raise ValueError(f"the shape lacks {', '.join(lacking)}: name its columns")
        points = np.stack([found[name] for name in "xyz"], axis=1)
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        apart = steps > _AT_BASE
        if not _WHISKERS[0] <= steps.sum() <= _WHISKERS[1]:
            raise ValueError(
                f"the points of [[shape]] are {steps.sum():.3g} m from end to end: is the unit "
                f"{self._table.get('unit', 'mm')!r} right?"
            )
        own = subtable(self._table, "whisker")
        usual = 1e-4 / self._unit
        noise = self._unit * one_number(own, "noise", 0.0)
        return Whisker.from_points(
            points[np.append(True, apart)],
            noise=noise or None,
            youngs_modulus=one_number(own, "youngs_modulus", 200e9),
            any_length=True,
            base_radius=self._unit * one_number(own, "base_radius", usual),
            tip_radius=self._unit * one_number(own, "tip_radius", usual),
        )

    def _shape(self, shape: Mapping[str, Any]) -> dict[str, Array]:
        """Coordinates of a table of the shape, m, relative to its first point."""
        columns = shape.get("columns", {"x": "px", "y": "py", "z": "pz"})
        if not isinstance(columns, Mapping) or not set(columns) <= set("xyz"):
            raise ValueError(f"columns is {quoted(columns)}; as {{x = 'px', y = 'py'}} is needed")
        values = self._columns(shape.get("file"), tuple(columns.values()))
        wrong = number_array(shape.get("leave_out", []), "leave_out").astype(int)
        values = np.delete(values, wrong, axis=0)
        return dict(zip(columns, self._unit * (values - values[0]).T, strict=True))

    def sweep(self, path: str | PathLike[str]) -> StageSweep:
        """Read a sweep from a table."""
        own = subtable(self._table, "sweep")
        moves = own.get("moves", "sensor")
        if moves not in ("sensor", "object"):
            raise ValueError(f"moves is {quoted(moves)}; 'sensor' or 'object' is needed")
        axes = _directions(own, "sweep")
        touched = subtable(self._table, "touches").get("file")
        if isinstance(touched, str) and (self.folder / touched).resolve() == Path(path).resolve():
            raise ValueError(
                f"{path} has the touches of the calibration; a sweep is needed, whose samples "
                "follow one another along one motion"
            )
        position = self._columns(Path(path), _names(self._table, "position"))
        position = self._unit * (position - three_numbers(own, "origin", (0.0, 0.0, 0.0)))
        return StageSweep(
            self._columns(Path(path), self.channels),
            position if moves == "sensor" else -position,
            axes,
        )


def _names(table: Mapping[str, Any], key: str) -> tuple[str, ...]:
    """Names of columns under a key."""
    names = table.get(key)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{key} is {quoted(names)}; the names of columns are needed")
    if key == "position" and len(names) != 3:
        raise ValueError(f"position is {quoted(names)}; the columns of x, y and z are needed")
    return tuple(names)


def _directions(table: Mapping[str, Any], where: str) -> Array:
    """Axes of the sensor (columns) in the stage's frame."""
    axes = table.get("axes", ["x", "y", "z"])
    with in_file(f"[{where}]"):
        return np.asarray(SensorFrame(axes=axes).axes)


def _read_off(known: Array, values: Array, wanted: Array, name: str) -> Array:
    """Interpolate values at given values of a shared coordinate."""
    forward = known if known[-1] >= known[0] else -known
    order = np.argsort(forward, kind="stable")
    if np.abs(forward[order] - forward).max() > 0.1 * np.ptp(known):
        raise ValueError(f"{name} is not monotone along the shape: it cannot be interpolated")
    sign = 1.0 if known[-1] >= known[0] else -1.0
    return np.interp(sign * wanted, forward[order], values[order])


# Dimensions and unit of the stored fields of a sensor; an empty unit is that of the channel.
_STORED: dict[str, tuple[tuple[str, ...], str]] = {
    "rotation_compliance": ((), "rad N-1 m-1"),
    "shift_compliance": ((), "m N-1"),
    "pivot": (("space",), "m"),
    "friction": ((), "1"),
    "readout": (("channel", "feature"), ""),
    "noise": (("channel",), ""),
    "drift": (("channel",), ""),
}


def save_suspended(
    path: str | PathLike[str], calibration: SuspensionCalibration, stage: Stage
) -> None:
    """Write a calibrated sensor to a file for `load_suspended`."""
    sensor = calibration.sensor
    channel, unknown = ("channel", list(sensor.channels)), ("unknown", list(calibration.names))
    stored = {
        name: (dims, getattr(sensor, name), {"units": unit} if unit else None)
        for name, (dims, unit) in _STORED.items()
    }
    data = xr.Dataset(
        {
            **stored,
            "value": ("unknown", calibration.values),
            "covariance": (("unknown", "unknown_"), calibration.covariance),
            "readout_covariance": (
                ("channel", "feature", "feature_"),
                calibration.readout_covariance,
            ),
            "residual": ("channel", calibration.residual),
        },
        {channel[0]: channel[1], unknown[0]: unknown[1], "feature": list(FEATURES)},
        {"kind": KIND, "stage": stage.text, "undetermined": ", ".join(calibration.undetermined)},
    )
    if sensor.residual is not None:
        data["plate_points"] = (("touch", "space"), sensor.residual.points, {"units": "m"})
        data["plate_weights"] = (("touch", "channel"), sensor.residual.weights)
        data["plate_reach"] = ((), sensor.residual.reach, {"units": "m"})
    parts = {"/": data, "whisker": sensor.whisker.to_dataset()}
    write_netcdf(path, xr.DataTree.from_dict(parts))


KIND = "suspended whisker"


def load_suspended(path: str | PathLike[str]) -> tuple[SuspendedWhisker, Stage]:
    """Read a calibrated sensor, and the description of its stage."""
    data = read_dataset(path) if is_netcdf(path) else xr.Dataset()
    if data.attrs.get("kind") != KIND:
        raise ValueError(
            f"{path} does not contain a calibrated suspended whisker, as written by "
            "`vibrissa calibrate`"
        )
    residual = None
    if "plate_points" in data:
        residual = ThinPlate(
            data["plate_points"].values,
            data["plate_weights"].values,
            float(data["plate_reach"]),
            data["noise"].values,
        )
    stored: dict[str, Any] = {name: data[name].values[()] for name in _STORED if name in data}
    sensor = SuspendedWhisker(
        Whisker.from_dataset(read_dataset(path, "whisker")),
        channels=tuple(str(name) for name in data["channel"].values),
        residual=residual,
        **stored,
    )
    return sensor, Stage(str(data.attrs["stage"]), Path(path).parent)
