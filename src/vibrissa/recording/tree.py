"""The recording: one tree of labelled datasets for all that is known of a trial.

    /            time, whisker, space: base_position, base_rotation, base_azimuth, …, force, moment
    /truth       the same names and more, as they truly are (simulated trials only)
    /whiskers/0  the first whisker along the dimension ``whisker``, and so on
    /objects/0   the first object that stands in the laboratory, and so on

A group cannot be called ``whisker``: a file has one name space for groups and dimensions. Points
are in the laboratory frame except those called ``…_whisker``; force and moment are in the
whisker's frame at its base, the force being that of the object on the whisker. Missing is NaN.
Forces and moments at the top are what the sensor reads, in contact or not; contact points there
are estimates.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras.camera import Camera
from vibrissa.cameras.files import cameras_from_dataset
from vibrissa.io.recording import KIND
from vibrissa.objects.dataset import object_from_dataset, objects_datasets
from vibrissa.objects.solids import Peg
from vibrissa.objects.surface import Surface
from vibrissa.quantities import attributes
from vibrissa.status import flag_attributes
from vibrissa.whisker import Whisker

if TYPE_CHECKING:
    from vibrissa.simulation.motion import Motion

Array = NDArray[np.float64]

_FRAMES = {
    "base_position": "laboratory",
    "base_position_head": "head",
    "centerline": "laboratory",
    "contact_point": "laboratory",
    "contact_point_whisker": "whisker",
    "force": "whisker",
    "moment": "whisker",
    "contact_force": "laboratory",
    "head_position": "laboratory",
    "surface_point": "laboratory",
    "surface_normal": "laboratory",
}
_DIMS: Mapping[str, tuple[str, ...]] = {
    "base_position": ("time", "whisker", "space"),
    "base_position_head": ("time", "whisker", "space"),
    "base_rotation": ("time", "whisker", "space", "whisker_axis"),
    "base_azimuth": ("time", "whisker"),
    "base_elevation": ("time", "whisker"),
    "base_roll": ("time", "whisker"),
    "centerline": ("time", "whisker", "node", "space"),
    "contact_point": ("time", "whisker", "space"),
    "contact_point_whisker": ("time", "whisker", "space"),
    "arc_length": ("time", "whisker"),
    "force": ("time", "whisker", "space"),
    "moment": ("time", "whisker", "space"),
    "in_contact": ("time", "whisker"),
    "confidence": ("time", "whisker"),
    "status": ("time", "whisker"),
    "contact_force": ("time", "whisker", "space"),
    "contact_object": ("time", "whisker"),
    "surface_point": ("time", "whisker", "space"),
    "surface_normal": ("time", "whisker", "space"),
    "sliding": ("time", "whisker"),
    "overlap": ("time", "whisker"),
    "second_contact": ("time", "whisker"),
    "contact_difference": ("time", "whisker"),
}
_OF_HEAD: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"head_position": ("time", "space"), "head_rotation": ("time", "space", "head_axis")}
)


def recorded(name: str, *values: Any) -> xr.Variable:
    """Label one variable of a recording."""
    about: dict[str, Any] = dict(attributes(name))
    if name in _FRAMES:
        about["reference_frame"] = _FRAMES[name]
    if name == "status":
        about |= flag_attributes()
    return xr.Variable(_DIMS[name], np.stack(values, axis=1), about)


def variable_faults(data: xr.Dataset) -> list[str]:
    """Say which variables of a recording, or of one of its groups, are not as they should be."""
    faults = []
    for name, dims in _DIMS.items():
        if name not in data:
            continue
        variable = data[name]
        axes = [dim for dim in dims if dim in ("space", "whisker_axis")]
        if set(variable.dims) != set(dims):
            got = ", ".join(map(str, variable.dims))
            faults.append(f"{name} has the dimensions ({got}); ({', '.join(dims)}) are needed")
        elif any(variable.sizes[axis] != 3 for axis in axes):
            faults.append(f"{name} has sizes {dict(variable.sizes)}; space is of 3 dimensions")
        elif variable.dtype.kind not in "fiub":
            faults.append(f"{name} holds {variable.dtype}, no numbers")
    return faults


def trial_recording(
    whiskers: Sequence[Whisker],
    motions: Sequence[Motion],
    objects: Sequence[Surface],
    truths: Sequence[Mapping[str, Any]],
    origin: str,
) -> xr.DataTree:
    """Write a simulated trial as a recording."""
    pose = {
        "base_position": [motion.base_position for motion in motions],
        "base_rotation": [motion.base_rotation for motion in motions],
        "base_azimuth": [motion.azimuth for motion in motions],
        "base_elevation": [motion.elevation for motion in motions],
        "base_roll": [motion.roll for motion in motions],
    }
    known = {name: [truth[name] for truth in truths] for name in truths[0]}
    wrench = {name: known[name] for name in ("force", "moment")}
    root = xr.Dataset(
        {name: recorded(name, *values) for name, values in (pose | wrench).items()}
        | head_variables(motions[0].head_position, motions[0].head_rotation),
        _coordinates(motions[0].time, [whisker.name for whisker in whiskers]),
        {"kind": KIND, "origin": origin},
    )
    groups: dict[str, xr.Dataset] = {
        "/": root,
        "/truth": xr.Dataset({name: recorded(name, *values) for name, values in known.items()}),
        "/objects": xr.Dataset(attrs={"reference_frame": "laboratory"}),
    }
    for i, whisker in enumerate(whiskers):
        # Its centreline is for readers of lone whisker files, and its nodes are others than ours.
        groups[f"/whiskers/{i}"] = whisker.to_dataset().drop_dims("node")
    for name, dataset in objects_datasets(objects).items():
        # The coordinates of the root are seen from below.
        groups[f"/objects/{name}"] = dataset.drop_vars("space")
    return xr.DataTree.from_dict(groups)


def head_variables(position: Array | None, rotation: Array | None) -> dict[str, xr.Variable]:
    """Label how the head moves, if it does."""
    values = {"head_position": position, "head_rotation": rotation}
    return {
        name: xr.Variable(
            _OF_HEAD[name],
            array,
            attributes(name) | ({"reference_frame": _FRAMES[name]} if name in _FRAMES else {}),
        )
        for name, array in values.items()
        if array is not None
    }


def _coordinates(time: Array, names: Sequence[str]) -> dict[Hashable, Any]:
    return {
        "time": xr.Variable("time", time, attributes("time")),
        "whisker": list(names),
        "space": list("xyz"),
        "whisker_axis": list("xyz"),
    }


def recorded_whisker(recording: xr.DataTree, index: int = 0) -> Whisker:
    """Make the whisker of a recording again.

    Parameters
    ----------
    recording : xarray.DataTree
        The recording.
    index : int
        Which one, along the dimension ``whisker``.

    Returns
    -------
    Whisker
        As it was recorded.

    Raises
    ------
    ValueError
        If the recording carries no such whisker.
    """
    whiskers = recording.children.get("whiskers")
    if whiskers is None or str(index) not in whiskers.children:
        count = 0 if whiskers is None else len(whiskers.children)
        raise ValueError(f"whisker {index} was asked for; the recording carries {count} of them")
    return Whisker.from_dataset(whiskers.children[str(index)].to_dataset(inherit=False))


def recorded_cameras(recording: xr.DataTree) -> tuple[Camera, ...]:
    """List the cameras of a recording.

    Parameters
    ----------
    recording : xarray.DataTree
        Filmed or tracked.

    Returns
    -------
    tuple of Camera
        View by view.

    Raises
    ------
    ValueError
        If it has none.
    """
    cameras = recording.children.get("cameras")
    if cameras is None:
        raise ValueError("the recording tells of no cameras")
    return cameras_from_dataset(cameras.to_dataset())


def recorded_objects(recording: xr.DataTree) -> tuple[Surface, ...]:
    """List the objects of a recording.

    Parameters
    ----------
    recording : xarray.DataTree
        The recording.

    Returns
    -------
    tuple
        Laboratory frame; none if the recording tells of no objects.
    """
    objects = recording.children.get("objects")
    if objects is None:
        return ()
    numbers = sorted(objects.children, key=int)
    return tuple(object_from_dataset(objects.children[i].to_dataset()) for i in numbers)


def recorded_pegs(recording: xr.DataTree) -> tuple[Peg, ...]:
    """List the pegs of a recording.

    Parameters
    ----------
    recording : xarray.DataTree
        The recording.

    Returns
    -------
    tuple of Peg
        Laboratory frame; none if the recording tells of no pegs.
    """
    return tuple(thing for thing in recorded_objects(recording) if isinstance(thing, Peg))
