"""The scene of a trial as its text says it: objects, how whiskers move, how the head moves."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.toml import quoted
from vibrissa.objects.mesh import Mesh
from vibrissa.objects.solids import Box, Peg, Plane, Sphere
from vibrissa.objects.surface import Surface
from vibrissa.simulation.array_motion import head_path, shared_whisking
from vibrissa.simulation.motion import Motion, tabulated, whisking
from vibrissa.simulation.plan import sweep_past
from vibrissa.simulation.values import COLUMNS, MM, columns_of, number, only, three, turned
from vibrissa.whisker import Whisker
from vibrissa.whisker.emergence import base_rotation

Array = NDArray[np.float64]


def object_of(said: Any, folder: Path) -> Surface:
    """Make an object."""
    if not isinstance(said, Mapping):
        raise ValueError(f"an object is {quoted(said)}; it is written as [[object]]")
    kind = said.get("kind", "peg")
    keys = {
        "peg": {"position", "axis", "diameter"},
        "sphere": {"position", "diameter"},
        "plane": {"position", "normal"},
        "box": {"position", "size", "angles", "edge_radius"},
        "mesh": {"file", "unit", "resolution"},
    }
    if not isinstance(kind, str) or kind not in keys:
        raise ValueError(f"an object's kind is {quoted(kind)}; one of {', '.join(keys)} is needed")
    only(said, keys[kind] | {"kind", "stiffness"}, f"an object of kind {kind}")
    stiffness = number(said, "stiffness", np.inf)
    if kind == "mesh":
        if "file" not in said:
            raise ValueError(
                'an object of kind mesh is a file: file = "body.stl" (STL, OBJ or PLY) is needed'
            )
        resolution = said.get("resolution")
        return Mesh.load(
            folder / str(said["file"]),
            number(said, "unit", 1.0) * MM,
            resolution=None if resolution is None else number(said, "resolution", 0.0) * MM,
            stiffness=stiffness,
        )
    position = three(said, "position") * MM
    radius = 0.5 * number(said, "diameter", 2.7) * MM
    if kind == "peg":
        return Peg(position, three(said, "axis", (0.0, 0.0, 1.0)), radius, stiffness)
    if kind == "sphere":
        return Sphere(position, radius, stiffness)
    if kind == "plane":
        return Plane(position, three(said, "normal"), stiffness)
    edge = number(said, "edge_radius", 0.0) * MM
    return Box(position, three(said, "size") * MM, turned(said), edge, stiffness)


_DEGREES = ("amplitude", "set_point", "elevation_drift")
_SHARES = ("frequency", "protraction", "variation")


def motion_of(
    said: dict[str, Any],
    whisker: Whisker,
    objects: tuple[Surface, ...],
    folder: Path,
    duration: float,
    rate: float,
    seed: int,
) -> Motion:
    """Say how the base of one whisker moves on the head."""
    kind = said.pop("kind", "past")
    if kind == "table":
        return _tabulated(said, folder, rate)
    only(said, {*_DEGREES, *_SHARES, "elevation", "position_drift", "row"}, "[motion]")
    how = _numbers(said, (*_DEGREES, "elevation"))
    how.setdefault("position_drift", 0.03 * whisker.length)
    row = str(said.get("row", "C"))
    first = objects[0]
    if kind == "past" and isinstance(first, Peg | Sphere | Box):
        return sweep_past(whisker, first, duration, rate, row=row, seed=seed, **how)
    if kind not in ("past", "whisking"):
        raise ValueError(f"the motion's kind is {quoted(kind)}; past, whisking or table is needed")
    return whisking(duration, rate, row=row, seed=seed, **how)


def array_motion_of(
    said: dict[str, Any], folder: Path, duration: float, rate: float, seed: int
) -> Motion:
    """Say how the whiskers of an array move about their rest, all in the same way."""
    kind = said.pop("kind", "whisking")
    if kind == "table":
        return _tabulated(said, folder, rate)
    if kind != "whisking":
        raise ValueError(
            f"the motion of an array is of kind {quoted(kind)}; whisking or table is needed"
        )
    only(said, {*_DEGREES, *_SHARES, "position_drift"}, "[motion] of an array")
    return shared_whisking(duration, rate, seed=seed, **_numbers(said, _DEGREES))


def _numbers(said: Mapping[str, Any], degrees: tuple[str, ...]) -> dict[str, Any]:
    """What is said of whisking, in SI units."""
    how: dict[str, Any] = {name: number(said, name, 0.0) for name in _SHARES if name in said}
    how |= {name: np.radians(number(said, name, 0.0)) for name in degrees if name in said}
    if "position_drift" in said:
        how["position_drift"] = number(said, "position_drift", 0.0) * MM
    return how


def _tabulated(said: Mapping[str, Any], folder: Path, rate: float) -> Motion:
    only(said, {"file"}, "a motion of kind table")
    columns = columns_of(folder / str(said.get("file", "")))
    place = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    return tabulated(
        columns["time"],
        columns["azimuth"],
        columns["elevation"],
        columns["roll"],
        place,
        rate=rate,
    )


def head_of(said: Mapping[str, Any], folder: Path, time: Array) -> tuple[Array, Array]:
    """Say how the head moves."""
    ends = {"position", "angles", "to_position", "to_angles"}
    only(said, {*ends, "file"}, "[head]")
    if "file" not in said:
        poses = {name: three(said, name) for name in ends if name in said}
        units = {name: np.radians(1.0) if name.endswith("angles") else MM for name in poses}
        return head_path(time, **{name: units[name] * poses[name] for name in poses})
    columns = columns_of(folder / str(said["file"]))
    if columns["time"][0] > time[0] or columns["time"][-1] < time[-1]:
        raise ValueError(
            f"the head moves from {columns['time'][0]} to {columns['time'][-1]} s; the whisker "
            f"whisks from {time[0]} to {time[-1]} s"
        )
    at = {name: np.interp(time, columns["time"], columns[name]) for name in COLUMNS[1:]}
    turn = base_rotation(at["azimuth"], at["elevation"], at["roll"])
    return turn, np.stack([at[axis] for axis in "xyz"], axis=-1)
