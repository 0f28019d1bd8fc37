"""Script of a simulated trial: whiskers, objects, motion, head and sensor; in mm and degrees.

Scripts are TOML, and every key is optional. `EXAMPLE` shows all keys.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from vibrissa.io import (
    check_keys,
    load_array,
    one_number,
    parsed_toml,
    quoted,
    read_text,
    subtable,
    table_rows,
    three_numbers,
)
from vibrissa.numerics import Array
from vibrissa.objects import Box, Mesh, Peg, Plane, Sphere, Surface
from vibrissa.sensors import COMPONENTS, Sensor
from vibrissa.simulation.dynamics import Dynamics
from vibrissa.simulation.motion import (
    Motion,
    head_path,
    protracted,
    shared_whisking,
    sweep_past,
    tabulated,
    whisking,
    within_reach,
)
from vibrissa.whisker import Whisker, WhiskerArray, base_rotation, whisker_array

_MOST_FRAMES = 10_000_000  # largest number of frames of a trial
# Every key of a script, with its default.
EXAMPLE = Path(__file__).with_name("example.toml").read_text(encoding="utf-8")
_MICRO = 1e-6
_TOP = {"duration", "rate", "friction", "seed"}
_TOP |= {"whisker", "array", "object", "motion", "head", "sensor", "dynamics"}
# Default motion of an array's head: forward, toward the object.
_ADVANCE = MappingProxyType({"to_position": [0.0, 14.0, 0.0]})
MM = 1e-3
COLUMNS = ("time", "azimuth", "elevation", "roll", "x", "y", "z")  # columns of a table of motion
_DEGREES = ("amplitude", "set_point", "elevation_drift")
_SHARES = ("frequency", "protraction", "variation")

_PER_COMPONENT = ("noise", "bias", "drift", "resolution")


@dataclass(frozen=True, eq=False)
class Script:
    """Whiskers, objects, motion and sensor of a trial."""

    whisker: Whisker | WhiskerArray
    objects: tuple[Surface, ...]
    motion: Motion | Mapping[str, Motion]  # of each base, by the name of the whisker
    friction: float
    sensor: Sensor
    seed: int
    dynamics: Dynamics | None = None


def read_script(
    text: str, folder: Path, read_whisker: Callable[[Path | None], Whisker], **changes: Any
) -> Script:
    """Read a trial from the text of its script, in which ``changes`` replace values."""
    table = parsed_toml(text)
    given = {name: value for name, value in changes.items() if value is not None}
    table |= {k: given[k] for k in ("duration", "rate", "friction", "seed") if k in given}
    check_keys(table, _TOP, "the trial")
    moves = dict(subtable(table, "motion"))
    moves |= {k: given[k] for k in ("frequency", "row", "protraction") if k in given}
    whisker = _whisker(table, given, folder, read_whisker)
    objects = _objects(table, given, folder, whisker)
    sensor = dict(subtable(table, "sensor"))
    if given.get("noise") is False:
        sensor = {k: v for k, v in sensor.items() if k in ("channels", "mixing")}
        sensor |= {"force_noise": 0.0, "moment_noise": 0.0}
    seed = int(one_number(table, "seed", 0.0))
    if moves.get("kind") == "table" and "duration" in table:
        raise ValueError("duration is given, but a motion of kind table has its own duration")
    usual = 3.5 if isinstance(whisker, Whisker) else 0.5
    duration, rate = one_number(table, "duration", usual), one_number(table, "rate", 1000.0)
    if not 0.0 < duration * rate <= _MOST_FRAMES:
        raise ValueError(
            f"duration is {duration:g} s and rate {rate:g} frames/s; both must be positive, and a "
            f"trial has at most {_MOST_FRAMES:,} frames"
        )
    head = subtable(table, "head")
    motion: Motion | Mapping[str, Motion]
    if isinstance(whisker, Whisker):
        motion = motion_of(moves, whisker, objects, folder, duration, rate, seed)
        motion = motion.on_head(*head_of(head, folder, motion.time)) if head else motion
    else:
        common = array_motion_of(moves, folder, duration, rate, seed)
        motion = protracted(whisker, common, *head_of(head or _ADVANCE, folder, common.time))
    return Script(
        whisker=whisker,
        objects=objects,
        motion=motion,
        friction=one_number(table, "friction", 0.0),
        sensor=_sensor(sensor),
        seed=seed,
        dynamics=_dynamics(table, given.get("dynamic") is True),
    )


def _whisker(
    table: Mapping[str, Any],
    given: Mapping[str, Any],
    folder: Path,
    read_whisker: Callable[[Path | None], Whisker],
) -> Whisker | WhiskerArray:
    """Whisker or array of whiskers of a script."""
    alone = "whisker" in given or "whisker" in table
    together = {"array", "side", "whiskers"} & set(given) or "array" in table
    if alone and together:
        raise ValueError("both a whisker and an array are given; give one of them")
    if together:
        return _array(subtable(table, "array"), given, folder)
    about = subtable(table, "whisker")
    check_keys(about, {"file"}, "[whisker]")
    return read_whisker(
        given.get("whisker", folder / str(about["file"]) if "file" in about else None)
    )


def _array(table: Mapping[str, Any], given: Mapping[str, Any], folder: Path) -> WhiskerArray:
    """Selected whiskers of the array."""
    check_keys(table, {"file", "side", "rows", "columns", "whiskers"}, "[array]")
    choice: dict[str, Any] = {"side": str(given.get("side", table.get("side", "both")))}
    names = given.get("whiskers", table.get("whiskers"))
    by_place = {key: table[key] for key in ("rows", "columns") if key in table}
    if by_place and "whiskers" in table:
        raise ValueError(f"[array] has both whiskers and {', '.join(by_place)}; give one")
    if names is None:
        choice |= by_place
    else:
        choice["names"] = [names] if isinstance(names, str) else names
    file = str(given.get("array", folder / str(table["file"]) if "file" in table else "average"))
    return whisker_array(**choice) if file == "average" else load_array(file).select(**choice)


def _objects(
    table: Mapping[str, Any],
    given: Mapping[str, Any],
    folder: Path,
    whisker: Whisker | WhiskerArray,
) -> tuple[Surface, ...]:
    """Objects; by default one within reach."""
    things = table.get("object", [])
    if not isinstance(things, list):
        raise ValueError("objects are written as [[object]], in double brackets")
    if "object" in given and things:
        raise ValueError("an object is given, but the script already has objects")
    known = tuple(object_of(thing, folder) for thing in things)
    return known or (within_reach(whisker, given.get("object")),)


def read_objects(text: str, folder: Path) -> tuple[Surface, ...]:
    """Objects of a script; its other contents are ignored."""
    things = parsed_toml(text).get("object", [])
    if not isinstance(things, list) or not things:
        raise ValueError("there is no object; one is written as [[object]], in double brackets")
    return tuple(object_of(thing, folder) for thing in things)


def _dynamics(table: Mapping[str, Any], wanted: bool) -> Dynamics | None:
    """Inertia and damping, if the script states them or ``wanted`` is true."""
    if not (wanted or "dynamics" in table):
        return None
    how = subtable(table, "dynamics")
    check_keys(how, {"density", "damping_ratio", "segments", "step"}, "[dynamics]")
    usual = Dynamics()
    density = how.get("density", usual.density)
    if not (isinstance(density, list | tuple) and len(density) == 2):
        raise ValueError(f"density is {density!r}; those at base and tip are needed")
    return Dynamics(
        density=(float(density[0]), float(density[1])),
        damping_ratio=one_number(how, "damping_ratio", usual.damping_ratio),
        segments=int(one_number(how, "segments", usual.segments)),
        step=one_number(how, "step", usual.step * 1e3) * 1e-3,
    )


def _sensor(table: Mapping[str, Any]) -> Sensor:
    """Sensor; noise values of force and moment are propagated to its channels."""
    own = {f"{part}_{name}" for part in ("force", "moment") for name in _PER_COMPONENT}
    check_keys(table, own | {"channels", "mixing", "relative_noise", "gain_error"}, "[sensor]")
    channels = tuple(str(name) for name in table.get("channels", COMPONENTS))
    plain = Sensor(channels, table.get("mixing"))
    numbers: dict[str, Any] = {}
    for name in _PER_COMPONENT:
        usual = (1.0, 0.02) if name == "noise" else (0.0, 0.0)
        force = one_number(table, f"force_{name}", usual[0]) * _MICRO
        moment = one_number(table, f"moment_{name}", usual[1]) * _MICRO
        if name != "bias" and min(force, moment) < 0.0:
            part = "force" if force < 0.0 else "moment"
            raise ValueError(f"{part}_{name} is {table[f'{part}_{name}']}; 0 or more is needed")
        each = np.repeat([force, moment], 3)
        mix = np.asarray(plain.mixing)
        numbers[name] = mix @ each if name == "bias" else np.sqrt(mix**2 @ each**2)
    for name in ("relative_noise", "gain_error"):
        numbers[name] = one_number(table, name, 0.0)
    return Sensor(channels, table.get("mixing"), **numbers)


def object_of(table: Any, folder: Path) -> Surface:
    """Object described by a table."""
    if not isinstance(table, Mapping):
        raise ValueError(f"an object is {quoted(table)}; it is written as [[object]]")
    kind = table.get("kind", "peg")
    keys = {
        "peg": {"position", "axis", "diameter"},
        "sphere": {"position", "diameter"},
        "plane": {"position", "normal"},
        "box": {"position", "size", "angles", "edge_radius"},
        "mesh": {"file", "unit", "resolution"},
    }
    if not isinstance(kind, str) or kind not in keys:
        raise ValueError(f"an object's kind is {quoted(kind)}; one of {', '.join(keys)} is needed")
    check_keys(table, keys[kind] | {"kind", "stiffness"}, f"an object of kind {kind}")
    stiffness = one_number(table, "stiffness", np.inf)
    if kind == "mesh":
        if "file" not in table:
            raise ValueError(
                'an object of kind mesh needs a file (STL, OBJ or PLY), as file = "body.stl"'
            )
        resolution = table.get("resolution")
        return Mesh.load(
            folder / str(table["file"]),
            one_number(table, "unit", 1.0) * MM,
            resolution=None if resolution is None else one_number(table, "resolution", 0.0) * MM,
            stiffness=stiffness,
        )
    position = three_numbers(table, "position") * MM
    radius = 0.5 * one_number(table, "diameter", 2.7) * MM
    if kind == "peg":
        return Peg(position, three_numbers(table, "axis", (0.0, 0.0, 1.0)), radius, stiffness)
    if kind == "sphere":
        return Sphere(position, radius, stiffness)
    if kind == "plane":
        return Plane(position, three_numbers(table, "normal"), stiffness)
    edge = one_number(table, "edge_radius", 0.0) * MM
    return Box(position, three_numbers(table, "size") * MM, turned(table), edge, stiffness)


def motion_of(
    table: dict[str, Any],
    whisker: Whisker,
    objects: tuple[Surface, ...],
    folder: Path,
    duration: float,
    rate: float,
    seed: int,
) -> Motion:
    """Motion of the base of one whisker relative to the head."""
    kind = table.pop("kind", "past")
    if kind == "table":
        return _tabulated(table, folder, rate)
    check_keys(table, {*_DEGREES, *_SHARES, "elevation", "position_drift", "row"}, "[motion]")
    how = _numbers(table, (*_DEGREES, "elevation"))
    how.setdefault("position_drift", 0.03 * whisker.length)
    row = str(table.get("row", "C"))
    first = objects[0]
    if kind == "past" and isinstance(first, Peg | Sphere | Box):
        return sweep_past(whisker, first, duration, rate, row=row, seed=seed, **how)
    if kind not in ("past", "whisking"):
        raise ValueError(f"the motion's kind is {quoted(kind)}; past, whisking or table is needed")
    return whisking(duration, rate, row=row, seed=seed, **how)


def array_motion_of(
    table: dict[str, Any], folder: Path, duration: float, rate: float, seed: int
) -> Motion:
    """Motion shared by all whiskers of an array, relative to their rest pose."""
    kind = table.pop("kind", "whisking")
    if kind == "table":
        return _tabulated(table, folder, rate)
    if kind != "whisking":
        raise ValueError(
            f"the motion of an array is of kind {quoted(kind)}; whisking or table is needed"
        )
    check_keys(table, {*_DEGREES, *_SHARES, "position_drift"}, "[motion] of an array")
    return shared_whisking(duration, rate, seed=seed, **_numbers(table, _DEGREES))


def _numbers(table: Mapping[str, Any], degrees: tuple[str, ...]) -> dict[str, Any]:
    """Parameters of whisking, in SI units."""
    how: dict[str, Any] = {name: one_number(table, name, 0.0) for name in _SHARES if name in table}
    how |= {name: np.radians(one_number(table, name, 0.0)) for name in degrees if name in table}
    if "position_drift" in table:
        how["position_drift"] = one_number(table, "position_drift", 0.0) * MM
    return how


def _tabulated(table: Mapping[str, Any], folder: Path, rate: float) -> Motion:
    """Motion read from a table in a file."""
    check_keys(table, {"file"}, "a motion of kind table")
    columns = columns_of(folder / str(table.get("file", "")))
    place = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    time, *angles = (columns[name] for name in COLUMNS[:4])
    return tabulated(time, angles[0], angles[1], angles[2], place, rate=rate)


def head_of(table: Mapping[str, Any], folder: Path, time: Array) -> tuple[Array, Array]:
    """Rotations (n, 3, 3) and positions (n, 3) of the head."""
    ends = {"position", "angles", "to_position", "to_angles"}
    check_keys(table, {"file"} if "file" in table else ends, "[head]")
    if "file" not in table:
        poses = {name: three_numbers(table, name) for name in ends if name in table}
        units = {name: np.radians(1.0) if name.endswith("angles") else MM for name in poses}
        return head_path(time, **{name: units[name] * poses[name] for name in poses})
    columns = columns_of(folder / str(table["file"]))
    if columns["time"][0] > time[0] or columns["time"][-1] < time[-1]:
        raise ValueError(
            f"the head moves from {columns['time'][0]} to {columns['time'][-1]} s; the whisker "
            f"whisks from {time[0]} to {time[-1]} s"
        )
    at = {name: np.interp(time, columns["time"], columns[name]) for name in COLUMNS[1:]}
    turn = base_rotation(at["azimuth"], at["elevation"], at["roll"])
    return turn, np.stack([at[axis] for axis in "xyz"], axis=-1)


def turned(table: Mapping[str, Any]) -> Array:
    """Rotation matrix of the angles of a table."""
    return base_rotation(*np.radians(three_numbers(table, "angles", (0.0, 0.0, 0.0))))


def columns_of(path: Path) -> dict[str, Array]:
    """Columns of a table of motion; missing columns other than the time are zero."""
    rows = list(table_rows(read_text(path)))
    names = rows[0][1] if rows else []
    unknown = [name for name in names if name not in COLUMNS]
    if unknown or "time" not in names or len(rows) < 3:
        raise ValueError(
            f"{path} has columns {', '.join(names) or 'none'} and {max(len(rows) - 1, 0)} rows; "
            f"time and any of {', '.join(COLUMNS[1:])} in two rows or more are needed"
        )
    try:
        values = np.array([cells for _, cells in rows[1:]], dtype=np.float64)
    except ValueError:
        raise ValueError(
            f"{path} has a cell that is not a number, or rows of different length"
        ) from None
    columns = dict(zip(names, values.T, strict=True))
    if not (np.isfinite(values).all() and (np.diff(columns["time"]) > 0.0).all()):
        raise ValueError(f"{path} has a number that is missing, or time that does not increase")
    return {name: columns.get(name, np.zeros(len(values))) for name in COLUMNS}
