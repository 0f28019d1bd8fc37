"""A trial as a text says it: whisker, objects, motion, head, sensor; lengths in mm, angles in °.

The text is TOML, and everything in it may be left out. `EXAMPLE` has all of it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.table import read_text, table_rows
from vibrissa.rod.surface import Surface
from vibrissa.sensing import COMPONENTS, Sensor
from vibrissa.trial.dynamics import Dynamics
from vibrissa.trial.mesh import Mesh
from vibrissa.trial.motion import Motion, tabulated, whisking
from vibrissa.trial.objects import Box, Peg, Plane, Sphere
from vibrissa.trial.plan import facing_peg, sweep_past
from vibrissa.whisker import Whisker
from vibrissa.whisker.emergence import base_rotation

Array = NDArray[np.float64]

EXAMPLE = """\
# A trial for `vibrissa simulate`: lengths in mm, angles in degrees, forces in µN, moments in µN·m.
# What is left out has the value shown here, unless something else is said.

duration = 3.5          # s
rate = 1000.0           # frames per second
friction = 0.0          # Coulomb's coefficient between whisker and objects
seed = 0                # of drifts and noise

# [dynamics]            # inertia and damping; without it the whisker moves quasi-statically
# density = [1220.0, 1632.0]  # at base and tip, kg/m³
# damping_ratio = 0.14  # of the first vibration
# segments = 32
# step = 0.1            # ms

# [whisker]
# file = "C1.csv"       # its centreline; by default a built-in γ whisker

# The objects; by default one peg within reach. More of them: repeat [[object]].
[[object]]
kind = "peg"            # or sphere, plane, box, mesh
position = [26.0, 0.0, 0.0]
axis = [0.0, 0.0, 1.0]
diameter = 2.7
# stiffness = 10.0      # N/m; rigid by default
# A sphere has position and diameter; a plane position and normal (toward the free side); a box
# position, size = [x, y, z], angles = [azimuth, elevation, roll] and edge_radius; a mesh file,
# unit (what 1 in the file is, mm) and resolution.

[motion]
kind = "past"           # past the first object and back; or "whisking", or "table"
row = "C"               # of the array: how elevation and roll follow the azimuth
frequency = 5.0         # whisks per second
protraction = 0.5       # share of a whisk that goes forward, 0.3 to 0.7
variation = 0.05        # drift of amplitude and set point, as a share of the amplitude
elevation = 0.0         # at the set point
elevation_drift = 4.0
# position_drift = 1.2  # by default 3 % of the whisker's length
# amplitude = 30.0      # half of the sweep; "past" finds what it takes
# set_point = 0.0
# file = "motion.csv"   # of a table: columns time, azimuth, elevation, roll, x, y, z (s, rad, m)

# [head]                # moves everything but the objects
# position = [0.0, 0.0, 0.0]
# angles = [0.0, 0.0, 0.0]  # azimuth, elevation, roll
# file = "head.csv"     # instead: columns as of a motion

[sensor]
# channels = ["Fx", "My", "Mz"]     # all six by default
# mixing = [[1, 0, 0, 0, 0, 0], …]  # what each channel reads of Fx, Fy, Fz (N), Mx, My, Mz (N·m)
force_noise = 1.0       # white
moment_noise = 0.02
force_bias = 0.0
moment_bias = 0.0
force_drift = 0.0       # random walk, after one second
moment_drift = 0.0
force_resolution = 0.0
moment_resolution = 0.0
relative_noise = 0.0
gain_error = 0.0
"""
"""Every key of a trial, with its default."""

_MM = 1e-3
_MICRO = 1e-6
_COLUMNS = ("time", "azimuth", "elevation", "roll", "x", "y", "z")
_TOP = {"duration", "rate", "friction", "seed"}
_TOP |= {"whisker", "object", "motion", "head", "sensor", "dynamics"}
_PER_COMPONENT = ("noise", "bias", "drift", "resolution")


@dataclass(frozen=True, eq=False)
class Script:
    """What is to be simulated.

    Parameters
    ----------
    whisker : Whisker
        That whisks.
    objects : tuple
        That it may meet.
    motion : Motion
        Of its base.
    friction : float
        Coulomb's coefficient.
    sensor : Sensor
        At its base.
    seed : int
        Of the sensor's noise.
    dynamics : Dynamics, optional
        Inertia and damping; None: quasi-static.
    """

    whisker: Whisker
    objects: tuple[Surface, ...]
    motion: Motion
    friction: float
    sensor: Sensor
    seed: int
    dynamics: Dynamics | None = None


def read_script(
    text: str, folder: Path, read_whisker: Callable[[Path | None], Whisker], **changes: Any
) -> Script:
    """Read a trial.

    Parameters
    ----------
    text : str
        TOML; may be empty.
    folder : Path
        Where files that it names are.
    read_whisker : callable
        Makes a whisker of a file, or of None the default one.
    **changes
        ``duration``, ``rate``, ``friction``, ``seed``, ``whisker`` (a file), ``frequency``,
        ``row``, ``protraction``, ``noise`` and ``dynamic`` (bool), which count instead of what
        the text says, where not None.

    Returns
    -------
    Script
        The trial.

    Raises
    ------
    ValueError
        If it is no TOML, has unknown keys, or says what cannot be.
    """
    said = _parsed(text)
    given = {name: value for name, value in changes.items() if value is not None}
    said |= {k: given[k] for k in ("duration", "rate", "friction", "seed") if k in given}
    _only(said, _TOP, "the trial")
    moves = dict(_table(said, "motion"))
    moves |= {k: given[k] for k in ("frequency", "row", "protraction") if k in given}
    about = _table(said, "whisker")
    _only(about, {"file"}, "[whisker]")
    file = given.get("whisker", folder / str(about["file"]) if "file" in about else None)
    whisker = read_whisker(file)
    things = said.get("object", [])
    if not isinstance(things, list):
        raise ValueError("objects are written as [[object]], in double brackets")
    objects = tuple(_object(thing, folder) for thing in things) or (facing_peg(whisker),)
    sensor = dict(_table(said, "sensor"))
    if given.get("noise") is False:
        sensor = {k: v for k, v in sensor.items() if k in ("channels", "mixing")}
        sensor |= {"force_noise": 0.0, "moment_noise": 0.0}
    seed = int(_number(said, "seed", 0.0))
    duration, rate = _number(said, "duration", 3.5), _number(said, "rate", 1000.0)
    motion = _motion(moves, whisker, objects, folder, duration, rate, seed)
    return Script(
        whisker=whisker,
        objects=objects,
        motion=_on_head(motion, _table(said, "head"), folder),
        friction=_number(said, "friction", 0.0),
        sensor=_sensor(sensor),
        seed=seed,
        dynamics=_dynamics(said, given.get("dynamic") is True),
    )


def read_objects(text: str, folder: Path) -> tuple[Surface, ...]:
    """Read the objects of a trial, and nothing else of it.

    Parameters
    ----------
    text : str
        TOML with ``[[object]]``.
    folder : Path
        Where files that it names are.

    Returns
    -------
    tuple
        Laboratory frame.

    Raises
    ------
    ValueError
        If it is no TOML, has no object, or an object says what cannot be.
    """
    things = _parsed(text).get("object", [])
    if not isinstance(things, list) or not things:
        raise ValueError("there is no object; one is written as [[object]], in double brackets")
    return tuple(_object(thing, folder) for thing in things)


def _parsed(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"the trial is no TOML: {error}") from None


def _dynamics(said: Mapping[str, Any], wanted: bool) -> Dynamics | None:
    """Inertia and damping, where they are said or wanted."""
    if not (wanted or "dynamics" in said):
        return None
    how = _table(said, "dynamics")
    _only(how, {"density", "damping_ratio", "segments", "step"}, "[dynamics]")
    usual = Dynamics()
    density = how.get("density", usual.density)
    if not (isinstance(density, list | tuple) and len(density) == 2):
        raise ValueError(f"density is {density!r}; those at base and tip are needed")
    return Dynamics(
        density=(float(density[0]), float(density[1])),
        damping_ratio=_number(how, "damping_ratio", usual.damping_ratio),
        segments=int(_number(how, "segments", usual.segments)),
        step=_number(how, "step", usual.step * 1e3) * 1e-3,
    )


def _only(said: Mapping[str, Any], allowed: set[str], where: str) -> None:
    unknown = sorted(set(said) - allowed)
    if unknown:
        raise ValueError(
            f"{where} has {', '.join(unknown)}; known are {', '.join(sorted(allowed))}"
        )


def _table(said: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    table = said.get(name, {})
    if not isinstance(table, Mapping):
        raise ValueError(f"{name} is {table!r}; it is written as a table, [{name}]")
    return table


def _number(said: Mapping[str, Any], name: str, default: float) -> float:
    value = said.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} is {value!r}; a number is needed")
    return float(value)


def _three(said: Mapping[str, Any], name: str, default: Any = None) -> Array:
    value = said.get(name, default)
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (3,):
        raise ValueError(f"{name} is {value!r}; three numbers are needed")
    return array


def _turned(said: Mapping[str, Any]) -> Array:
    return base_rotation(*np.radians(_three(said, "angles", (0.0, 0.0, 0.0))))


def _object(said: Any, folder: Path) -> Surface:
    """One object."""
    if not isinstance(said, Mapping):
        raise ValueError(f"an object is {said!r}; it is written as [[object]]")
    kind = said.get("kind", "peg")
    keys = {
        "peg": {"position", "axis", "diameter"},
        "sphere": {"position", "diameter"},
        "plane": {"position", "normal"},
        "box": {"position", "size", "angles", "edge_radius"},
        "mesh": {"file", "unit", "resolution"},
    }
    if kind not in keys:
        raise ValueError(f"an object's kind is {kind!r}; one of {', '.join(keys)} is needed")
    _only(said, keys[kind] | {"kind", "stiffness"}, f"an object of kind {kind}")
    stiffness = _number(said, "stiffness", np.inf)
    if kind == "mesh":
        resolution = said.get("resolution")
        return Mesh.load(
            folder / str(said.get("file", "")),
            _number(said, "unit", 1.0) * _MM,
            resolution=None if resolution is None else _number(said, "resolution", 0.0) * _MM,
            stiffness=stiffness,
        )
    position = _three(said, "position") * _MM
    radius = 0.5 * _number(said, "diameter", 2.7) * _MM
    if kind == "peg":
        return Peg(position, _three(said, "axis", (0.0, 0.0, 1.0)), radius, stiffness)
    if kind == "sphere":
        return Sphere(position, radius, stiffness)
    if kind == "plane":
        return Plane(position, _three(said, "normal"), stiffness)
    edge = _number(said, "edge_radius", 0.0) * _MM
    return Box(position, _three(said, "size") * _MM, _turned(said), edge, stiffness)


def _motion(
    said: dict[str, Any],
    whisker: Whisker,
    objects: tuple[Surface, ...],
    folder: Path,
    duration: float,
    rate: float,
    seed: int,
) -> Motion:
    """How the base moves."""
    kind = said.pop("kind", "past")
    if kind == "table":
        _only(said, {"file"}, "a motion of kind table")
        columns = _columns(folder / str(said.get("file", "")))
        place = np.stack([columns[axis] for axis in "xyz"], axis=-1)
        return tabulated(
            columns["time"],
            columns["azimuth"],
            columns["elevation"],
            columns["roll"],
            place,
            rate=rate,
        )
    degrees = ("amplitude", "set_point", "elevation", "elevation_drift")
    plain = ("frequency", "protraction", "variation")
    _only(said, {*degrees, *plain, "position_drift", "row"}, "[motion]")
    how: dict[str, Any] = {name: _number(said, name, 0.0) for name in plain if name in said}
    how |= {name: np.radians(_number(said, name, 0.0)) for name in degrees if name in said}
    how["position_drift"] = 0.03 * whisker.length
    if "position_drift" in said:
        how["position_drift"] = _number(said, "position_drift", 0.0) * _MM
    row = str(said.get("row", "C"))
    first = objects[0]
    if kind == "past" and isinstance(first, Peg | Sphere | Box):
        return sweep_past(whisker, first, duration, rate, row=row, seed=seed, **how)
    if kind not in ("past", "whisking"):
        raise ValueError(f"the motion's kind is {kind!r}; past, whisking or table is needed")
    return whisking(duration, rate, row=row, seed=seed, **how)


def _on_head(motion: Motion, said: Mapping[str, Any], folder: Path) -> Motion:
    """Put the motion on a head, if there is one."""
    if not said:
        return motion
    _only(said, {"position", "angles", "file"}, "[head]")
    if "file" not in said:
        return motion.on_head(_turned(said), _three(said, "position", (0.0, 0.0, 0.0)) * _MM)
    columns = _columns(folder / str(said["file"]))
    if columns["time"][0] > motion.time[0] or columns["time"][-1] < motion.time[-1]:
        raise ValueError(
            f"the head moves from {columns['time'][0]} to {columns['time'][-1]} s; the whisker "
            f"whisks from {motion.time[0]} to {motion.time[-1]} s"
        )
    at = {name: np.interp(motion.time, columns["time"], columns[name]) for name in _COLUMNS[1:]}
    turn = base_rotation(at["azimuth"], at["elevation"], at["roll"])
    return motion.on_head(turn, np.stack([at[axis] for axis in "xyz"], axis=-1))


def _columns(path: Path) -> dict[str, Array]:
    """Columns of a table of motion; those that are missing are zero, but for the time."""
    rows = list(table_rows(read_text(path)))
    names = rows[0][1] if rows else []
    unknown = [name for name in names if name not in _COLUMNS]
    if unknown or "time" not in names or len(rows) < 3:
        raise ValueError(
            f"{path} has columns {', '.join(names) or 'none'} and {max(len(rows) - 1, 0)} rows; "
            f"time and any of {', '.join(_COLUMNS[1:])} in two rows or more are needed"
        )
    try:
        values = np.array([cells for _, cells in rows[1:]], dtype=np.float64)
    except ValueError:
        raise ValueError(
            f"{path} has a cell that is no number, or rows of different length"
        ) from None
    columns = dict(zip(names, values.T, strict=True))
    return {name: columns.get(name, np.zeros(len(values))) for name in _COLUMNS}


def _sensor(said: Mapping[str, Any]) -> Sensor:
    """The sensor; what is said of forces and moments is what it is of channels' components."""
    own = {f"{part}_{name}" for part in ("force", "moment") for name in _PER_COMPONENT}
    _only(said, own | {"channels", "mixing", "relative_noise", "gain_error"}, "[sensor]")
    channels = tuple(str(name) for name in said.get("channels", COMPONENTS))
    plain = Sensor(channels, said.get("mixing"))
    numbers: dict[str, Any] = {}
    for name in _PER_COMPONENT:
        usual = (1.0, 0.02) if name == "noise" else (0.0, 0.0)
        force = _number(said, f"force_{name}", usual[0]) * _MICRO
        moment = _number(said, f"moment_{name}", usual[1]) * _MICRO
        each = np.repeat([force, moment], 3)
        mix = np.asarray(plain.mixing)
        numbers[name] = mix @ each if name == "bias" else np.sqrt(mix**2 @ each**2)
    for name in ("relative_noise", "gain_error"):
        numbers[name] = _number(said, name, 0.0)
    return Sensor(channels, said.get("mixing"), **numbers)
