"""The variables of a recording, declared once: dimensions, frame, type, and the groups with them.

    /            what is known of the trial: the base's pose, and what was measured or tracked
    /truth       the same names and more, as they truly are (simulated trials only)
    /measured    what tracking found before the rod was fitted
    /signals     force, moment and the six signals of every frame
    /estimates   contact points from the signals
    /whiskers/0  the first whisker along the dimension ``whisker``, and so on
    /cameras     the views
    /objects/0   the first object in the laboratory, and so on

A group cannot be called ``whisker``: a file has one name space for groups and dimensions. Missing
is NaN. Force and moment act at the whisker's base, the force being that of the object on the
whisker; at the top they are what the sensor reads, in contact or not, and contact points there are
estimates. Units and long names are those of :mod:`vibrissa.quantities`.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.quantities import attributes
from vibrissa.status import flag_attributes


@dataclass(frozen=True)
class RecordedVariable:
    """Declaration of one variable of a recording.

    Dimensions in the order of the arrays that `Group` returns; groups that may hold it, of which
    the empty name is the recording itself; the frame of its components, empty for what has none;
    and the type of its values, "float", "bool" or "int".
    """

    dims: tuple[str, ...]
    groups: tuple[str, ...]
    frame: str = ""
    kind: str = "float"


_EACH = ("time", "whisker")
_VECTOR = (*_EACH, "space")
_POINTS = (*_EACH, "node", "space")
_TURN = (*_VECTOR, "whisker_axis")
_SQUARE = (*_VECTOR, "space_")
_IMAGE = (*_EACH, "view", "node", "image_axis")
_ANGLES = ("base_azimuth", "base_elevation", "base_roll")

_ANYWHERE = ("", "truth", "measured", "signals", "estimates")
_POSED = ("", "truth", "measured", "signals")
_FORCED = ("", "truth", "signals", "estimates")
_TOP, _TRUTH, _MEASURED = ("",), ("truth",), ("measured",)
_SIGNALS, _ESTIMATES = ("signals",), ("estimates",)
_SEEN = ("", "truth")
_LAB, _WHISKER, _HEAD = "laboratory", "whisker", "head"

VARIABLES: Mapping[str, RecordedVariable] = MappingProxyType(
    {
        # How the whisker is held
        "base_position": RecordedVariable(_VECTOR, _POSED, _LAB),
        "base_rotation": RecordedVariable(_TURN, _POSED),
        **{name: RecordedVariable(_EACH, ("", "measured")) for name in _ANGLES},
        "base_position_head": RecordedVariable(_VECTOR, _TOP, _HEAD),
        "head_position": RecordedVariable(("time", "space"), _TOP, _LAB),
        "head_rotation": RecordedVariable(("time", "space", "head_axis"), _TOP),
        "pose_covariance": RecordedVariable((*_EACH, "pose", "pose_"), ("", "signals")),
        "pose_shared": RecordedVariable((*_EACH, "error", "pose"), _TOP),
        "unfiltered_base_position": RecordedVariable(_VECTOR, _MEASURED, _LAB),
        **{f"unfiltered_{name}": RecordedVariable(_EACH, _MEASURED) for name in _ANGLES},
        # Where it is
        "centerline": RecordedVariable(_POINTS, ("", "truth", "measured"), _LAB),
        "centerline_sigma": RecordedVariable(_POINTS, _MEASURED),
        "deviation": RecordedVariable(_EACH, _MEASURED),
        "frame": RecordedVariable(("time", "view"), _TOP, kind="int"),
        "trace": RecordedVariable(_IMAGE, _SEEN),
        "trace_sigma": RecordedVariable(_IMAGE[:-1], _TOP),
        "trace_visible": RecordedVariable(_IMAGE[:-1], _SEEN, kind="bool"),
        "trace_confidence": RecordedVariable(_IMAGE[:-2], _TOP),
        "trace_misfit": RecordedVariable(_EACH, _TOP),
        # What it touches
        "contact_point": RecordedVariable(_VECTOR, ("", "truth", "measured", "estimates"), _LAB),
        "contact_point_whisker": RecordedVariable(_VECTOR, ("", "truth", "estimates"), _WHISKER),
        "contact_covariance": RecordedVariable(_SQUARE, ("", "estimates"), _LAB),
        "contact_shared": RecordedVariable((*_EACH, "error", "space"), ("", "estimates"), _LAB),
        "covariance": RecordedVariable(_SQUARE, _ESTIMATES, _WHISKER),
        "contact_normal": RecordedVariable(_VECTOR, _ESTIMATES, _LAB),
        "normal_covariance": RecordedVariable(_SQUARE, _ESTIMATES, _LAB),
        "point_normal_covariance": RecordedVariable(_SQUARE, _ESTIMATES, _LAB),
        "arc_length": RecordedVariable(_EACH, ("", "truth", "measured", "estimates")),
        "contact_difference": RecordedVariable(_EACH, _MEASURED),
        "contact_force": RecordedVariable(_VECTOR, _TRUTH, _LAB),
        "contact_object": RecordedVariable(_EACH, _TRUTH, kind="int"),
        "surface_point": RecordedVariable(_VECTOR, _TRUTH, _LAB),
        "surface_normal": RecordedVariable(_VECTOR, _TRUTH, _LAB),
        "sliding": RecordedVariable(_EACH, _TRUTH, kind="bool"),
        "overlap": RecordedVariable(_EACH, _TRUTH),
        "second_contact": RecordedVariable(_EACH, _TRUTH, kind="bool"),
        "friction_angle": RecordedVariable(_EACH, _ESTIMATES),
        "one_contact": RecordedVariable(_EACH, _ESTIMATES),
        "candidates": RecordedVariable(_EACH, _ESTIMATES, kind="int"),
        "in_contact": RecordedVariable(_EACH, _ANYWHERE, kind="bool"),
        "confidence": RecordedVariable(_EACH, ("", "truth")),
        "status": RecordedVariable(_EACH, _ANYWHERE, kind="int"),
        # What its base measures
        "force": RecordedVariable(_VECTOR, _FORCED, _WHISKER),
        "moment": RecordedVariable(_VECTOR, _FORCED, _WHISKER),
        **{
            name: RecordedVariable(_EACH, _SIGNALS) for name in ("Fx", "FT", "FD", "Mx", "MB", "MD")
        },
        "wrench_covariance": RecordedVariable(
            (*_EACH, "component", "component_"), ("", "signals"), _WHISKER
        ),
        "wrench_shared": RecordedVariable((*_EACH, "error", "component"), _TOP, _WHISKER),
        "pose_wrench_covariance": RecordedVariable((*_EACH, "pose", "component_"), ("", "signals")),
        "reading": RecordedVariable((*_EACH, "channel"), _TOP),
        "mixing": RecordedVariable(("channel", "component"), _TOP),
    }
)
"""Every variable that runs along the frames of a recording, by name."""

_AXES = frozenset({"space", "whisker_axis", "head_axis", "space_"})
_SELECTED = frozenset({"time", "whisker", "view"})
"""Dimensions that a dataset of one frame, whisker or view lacks."""

_ALSO_CALLED = MappingProxyType({"true_node": "node", "space_2": "space_"})
"""Dimensions that go by another name, where a dataset has two of a kind."""

_NUMBERS = "fiub"


def recorded(name: str, values: ArrayLike) -> xr.Variable:
    """Label one variable of a recording."""
    about = _declared(name)
    array = np.asarray(values)
    if "whisker" in about.dims and array.ndim == len(about.dims) - 1:
        array = np.expand_dims(array, about.dims.index("whisker"))
    if array.ndim != len(about.dims):
        raise ValueError(
            f"{name} has the shape {array.shape}; ({', '.join(about.dims)}) are needed"
        )
    plain = name.removeprefix("unfiltered_")
    labels: dict[str, Any] = dict(attributes(plain))
    if plain != name:
        labels["long_name"] += ", unfiltered"
    if about.frame:
        labels["reference_frame"] = about.frame
    if name == "status":
        labels |= flag_attributes()
    return xr.Variable(about.dims, array, labels)


def coordinates(time: ArrayLike, names: Sequence[str]) -> dict[Hashable, Any]:
    """List the coordinates of a recording."""
    return {
        "time": xr.Variable("time", np.asarray(time), attributes("time")),
        "whisker": list(names),
        "space": list("xyz"),
        "whisker_axis": list("xyz"),
    }


def faults_in(data: xr.Dataset) -> list[str]:
    """List what is wrong with the variables of a recording or of one of its groups."""
    faults = (_fault(name, data[name].variable, frozenset()) for name in VARIABLES if name in data)
    return [fault for fault in faults if fault]


def ordered(name: str, variable: xr.Variable) -> NDArray[Any]:
    """Give the values of a variable in the declared order and type; a missing truth is False."""
    fault = _fault(name, variable, _SELECTED)
    if fault:
        raise ValueError(fault)
    wanted = _declared(name)
    called = {_ALSO_CALLED.get(str(dim), str(dim)): dim for dim in variable.dims}
    values = variable.transpose(*(called[dim] for dim in wanted.dims if dim in called)).values
    if wanted.kind == "bool":
        return np.asarray(np.nan_to_num(values) > 0.0)
    return np.asarray(values, dtype=np.float64) if wanted.kind == "float" else values


def _declared(name: str) -> RecordedVariable:
    if name not in VARIABLES:
        raise ValueError(f"{name} is not a variable of a recording; these are {list(VARIABLES)}")
    return VARIABLES[name]


def _fault(name: str, variable: xr.Variable, selected: frozenset[str]) -> str:
    """State what is wrong with a variable, of whose dimensions those selected may be missing."""
    dims = _declared(name).dims
    sizes = {_ALSO_CALLED.get(str(dim), str(dim)): n for dim, n in variable.sizes.items()}
    if not set(dims) - selected <= set(sizes) <= set(dims):
        got = ", ".join(map(str, variable.dims))
        return f"{name} has the dimensions ({got}); ({', '.join(dims)}) are needed"
    if any(sizes[axis] != 3 for axis in _AXES & set(sizes)):
        return f"{name} has sizes {dict(variable.sizes)}; space has 3 dimensions"
    if variable.dtype.kind not in _NUMBERS:
        return f"{name} holds {variable.dtype}, not numbers"
    return ""
