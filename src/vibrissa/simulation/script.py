"""A trial as a text says it: whiskers, objects, motion, head, sensor; in mm and °.

The text is TOML, and everything in it may be left out. `EXAMPLE` has all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from vibrissa.io.array import load_array
from vibrissa.io.toml import parsed_toml
from vibrissa.objects.surface import Surface
from vibrissa.sensors import COMPONENTS, Sensor
from vibrissa.simulation.array_motion import protracted
from vibrissa.simulation.dynamics import Dynamics
from vibrissa.simulation.motion import Motion
from vibrissa.simulation.plan import within_reach
from vibrissa.simulation.scene import array_motion_of, head_of, motion_of, object_of
from vibrissa.simulation.values import number, only, subtable
from vibrissa.whisker import Whisker, WhiskerArray, whisker_array

_MOST_FRAMES = 10_000_000
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

# [array]               # instead of one whisker all of a face, in the head's frame: snout at the
#                       # origin, x to the right, y forward, z up; they whisk about their rest
# file = "rat7.csv"     # a table or a folder of centrelines; by default an average rat's
# side = "both"         # or left, right
# rows = "ABCDE"
# columns = [0, 1, 2, 3, 4, 5, 6]   # 0 is the Greek one
# whiskers = ["C2", "gamma"]        # instead of rows and columns

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
# to_position, to_angles    # the same at the end; it goes there smoothly
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

_MICRO = 1e-6
_TOP = {"duration", "rate", "friction", "seed"}
_TOP |= {"whisker", "array", "object", "motion", "head", "sensor", "dynamics"}
_ADVANCE = MappingProxyType({"to_position": [0.0, 14.0, 0.0]})
"""How the head of an array moves, if nothing is said: forward, toward what stands there."""

_PER_COMPONENT = ("noise", "bias", "drift", "resolution")


@dataclass(frozen=True, eq=False)
class Script:
    """What is to be simulated."""

    whisker: Whisker | WhiskerArray
    objects: tuple[Surface, ...]
    motion: Motion | Mapping[str, Motion]
    friction: float
    sensor: Sensor
    seed: int
    dynamics: Dynamics | None = None


def read_script(
    text: str, folder: Path, read_whisker: Callable[[Path | None], Whisker], **changes: Any
) -> Script:
    """Read a trial."""
    said = parsed_toml(text)
    given = {name: value for name, value in changes.items() if value is not None}
    said |= {k: given[k] for k in ("duration", "rate", "friction", "seed") if k in given}
    only(said, _TOP, "the trial")
    moves = dict(subtable(said, "motion"))
    moves |= {k: given[k] for k in ("frequency", "row", "protraction") if k in given}
    whisker = _whisker(said, given, folder, read_whisker)
    objects = _objects(said, given, folder, whisker)
    sensor = dict(subtable(said, "sensor"))
    if given.get("noise") is False:
        sensor = {k: v for k, v in sensor.items() if k in ("channels", "mixing")}
        sensor |= {"force_noise": 0.0, "moment_noise": 0.0}
    seed = int(number(said, "seed", 0.0))
    usual = 3.5 if isinstance(whisker, Whisker) else 0.5
    duration, rate = number(said, "duration", usual), number(said, "rate", 1000.0)
    if not 0.0 < duration * rate <= _MOST_FRAMES:
        raise ValueError(
            f"duration is {duration:g} s and rate {rate:g} frames/s; both are positive, and a "
            f"trial has up to {_MOST_FRAMES:,} frames"
        )
    head = subtable(said, "head")
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
        friction=number(said, "friction", 0.0),
        sensor=_sensor(sensor),
        seed=seed,
        dynamics=_dynamics(said, given.get("dynamic") is True),
    )


def _whisker(
    said: Mapping[str, Any],
    given: Mapping[str, Any],
    folder: Path,
    read_whisker: Callable[[Path | None], Whisker],
) -> Whisker | WhiskerArray:
    """The whisker, or the array."""
    alone = "whisker" in given or "whisker" in said
    together = {"array", "side", "whiskers"} & set(given) or "array" in said
    if alone and together:
        raise ValueError("both a whisker and an array are asked for; one of them is needed")
    if together:
        return _array(subtable(said, "array"), given, folder)
    about = subtable(said, "whisker")
    only(about, {"file"}, "[whisker]")
    return read_whisker(
        given.get("whisker", folder / str(about["file"]) if "file" in about else None)
    )


def _array(said: Mapping[str, Any], given: Mapping[str, Any], folder: Path) -> WhiskerArray:
    """The array, and of it what was chosen."""
    only(said, {"file", "side", "rows", "columns", "whiskers"}, "[array]")
    choice: dict[str, Any] = {"side": str(given.get("side", said.get("side", "both")))}
    names = given.get("whiskers", said.get("whiskers"))
    if names is None:
        choice |= {key: said[key] for key in ("rows", "columns") if key in said}
    else:
        choice["names"] = [names] if isinstance(names, str) else names
    file = str(given.get("array", folder / str(said["file"]) if "file" in said else "average"))
    return whisker_array(**choice) if file == "average" else load_array(file).select(**choice)


def _objects(
    said: Mapping[str, Any],
    given: Mapping[str, Any],
    folder: Path,
    whisker: Whisker | WhiskerArray,
) -> tuple[Surface, ...]:
    """The objects; if none is said, one within reach."""
    things = said.get("object", [])
    if not isinstance(things, list):
        raise ValueError("objects are written as [[object]], in double brackets")
    if "object" in given and things:
        raise ValueError("an object is asked for beside those that the text says")
    known = tuple(object_of(thing, folder) for thing in things)
    return known or (within_reach(whisker, given.get("object")),)


def read_objects(text: str, folder: Path) -> tuple[Surface, ...]:
    """Read the objects of a trial, and nothing else of it."""
    things = parsed_toml(text).get("object", [])
    if not isinstance(things, list) or not things:
        raise ValueError("there is no object; one is written as [[object]], in double brackets")
    return tuple(object_of(thing, folder) for thing in things)


def _dynamics(said: Mapping[str, Any], wanted: bool) -> Dynamics | None:
    """Inertia and damping, where they are said or wanted."""
    if not (wanted or "dynamics" in said):
        return None
    how = subtable(said, "dynamics")
    only(how, {"density", "damping_ratio", "segments", "step"}, "[dynamics]")
    usual = Dynamics()
    density = how.get("density", usual.density)
    if not (isinstance(density, list | tuple) and len(density) == 2):
        raise ValueError(f"density is {density!r}; those at base and tip are needed")
    return Dynamics(
        density=(float(density[0]), float(density[1])),
        damping_ratio=number(how, "damping_ratio", usual.damping_ratio),
        segments=int(number(how, "segments", usual.segments)),
        step=number(how, "step", usual.step * 1e3) * 1e-3,
    )


def _sensor(said: Mapping[str, Any]) -> Sensor:
    """The sensor; what is said of forces and moments is what it is of channels' components."""
    own = {f"{part}_{name}" for part in ("force", "moment") for name in _PER_COMPONENT}
    only(said, own | {"channels", "mixing", "relative_noise", "gain_error"}, "[sensor]")
    channels = tuple(str(name) for name in said.get("channels", COMPONENTS))
    plain = Sensor(channels, said.get("mixing"))
    numbers: dict[str, Any] = {}
    for name in _PER_COMPONENT:
        usual = (1.0, 0.02) if name == "noise" else (0.0, 0.0)
        force = number(said, f"force_{name}", usual[0]) * _MICRO
        moment = number(said, f"moment_{name}", usual[1]) * _MICRO
        if name != "bias" and min(force, moment) < 0.0:
            part = "force" if force < 0.0 else "moment"
            raise ValueError(f"{part}_{name} is {said[f'{part}_{name}']}; 0 or more is needed")
        each = np.repeat([force, moment], 3)
        mix = np.asarray(plain.mixing)
        numbers[name] = mix @ each if name == "bias" else np.sqrt(mix**2 @ each**2)
    for name in ("relative_noise", "gain_error"):
        numbers[name] = number(said, name, 0.0)
    return Sensor(channels, said.get("mixing"), **numbers)
