"""Validation of recordings before each stage, and construction of labelled signal datasets."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.numerics import Array
from vibrissa.pipeline.made_from import edited
from vibrissa.quantities import unit_fault
from vibrissa.recording import Group, faults_in, recorded
from vibrissa.signals import base_signals
from vibrissa.whisker import Whisker

EACH = ("time", "whisker")  # dimensions of contacts
# Covariances of the wrench and the pose, and their cross-covariance.
SQUARES = ("wrench_covariance", "pose_covariance", "pose_wrench_covariance")
# Required variables of the group ``signals``.
MEASURED = ("force", "moment", "base_position", "base_rotation", "in_contact", "status")
# Required variables of the group ``estimates``.
ESTIMATED = (
    "contact_point",
    "contact_covariance",
    "contact_normal",
    "normal_covariance",
    "point_normal_covariance",
    "contact_point_whisker",
    "arc_length",
    "in_contact",
    "status",
)


def check_recording(recording: xr.DataTree) -> None:
    """Raise ValueError unless a recording has frames and whiskers, and variables of valid shape."""
    root = recording.to_dataset(inherit=False)
    missing = [name for name in ("time", "whisker") if name not in root.dims]
    if missing:
        got = ", ".join(str(name) for name in root.dims) or "none"
        raise ValueError(
            f"the recording lacks the dimensions {', '.join(missing)}; it has {got}: a tracked, "
            "simulated or measured recording is needed (one whisker: isel(whisker=[0]))"
        )
    faults = [*faults_in(root), *_label_faults(root)]
    for name in ("truth", "measured"):  # later groups are computed anew
        group = recording.children.get(name)
        found = [] if group is None else faults_in(group.to_dataset())
        faults += [f"in the group {name}, {fault}" for fault in found]
    time = np.asarray(root["time"].values)
    if time.size == 0 or root.sizes["whisker"] == 0:
        faults.append(f"it has {time.size} frames of {root.sizes['whisker']} whiskers")
    elif time.dtype.kind not in "fiu":
        faults.append(f"its time is {time.dtype}; numbers are needed, in seconds")
    elif not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        faults.append("its time does not increase from frame to frame, or is missing in some")
    if faults:
        raise ValueError(f"the recording cannot be used: {'; '.join(faults)}")
    if changed := edited(recording):
        warnings.warn(
            f"the recording was edited after its {changed[0]} had been computed: these, and all "
            "that depends on them, are out of date until `vibrissa reconstruct` has run",
            UserWarning,
            stacklevel=1,
        )


def _label_faults(root: xr.Dataset) -> list[str]:
    """List faults of the time and whisker coordinates."""
    if bare := [f"it is without a coordinate {d}" for d in ("time", "whisker") if d not in root]:
        return bare
    faults = [fault] if (fault := unit_fault("time", root["time"].attrs.get("units", "s"))) else []
    names = [str(name) for name in root["whisker"].values]
    if len(set(names)) < len(names):
        faults.append(f"whiskers share a name: {', '.join(names)}")
    return faults


def names_of(data: xr.Dataset) -> str:
    """Names of the variables of a dataset, as text for a message."""
    return ", ".join(sorted(map(str, data.data_vars))) or "no variables"


def needed(root: xr.Dataset, names: Sequence[str], source: str) -> None:
    """Raise ValueError if the root lacks variables that signals of this source require."""
    missing = [name for name in names if name not in root]
    if not missing:
        return
    raise ValueError(
        f"signals from the {source} need {', '.join(missing)}; the recording has {names_of(root)}"
    )


def one_whisker(values: Mapping[str, Any], status: NDArray[np.int64]) -> xr.Dataset:
    """Dataset of one whisker's variables and six signals; dimension ``whisker`` of length one."""
    six = base_signals(values["force"], values["moment"])
    known = {
        **values,
        "status": np.asarray(status, dtype=np.int8),
        **{str(name): signal.values for name, signal in six.data_vars.items()},
    }
    return xr.Dataset({name: recorded(name, array) for name, array in known.items()})


def with_coordinates(data: xr.Dataset, root: xr.Dataset, about: Mapping[str, Any]) -> xr.Dataset:
    """Assign the coordinates of a recording, and attributes, to a dataset."""
    names = ("time", "whisker", "space", "whisker_axis")
    coordinates = {name: root[name].variable for name in names if name in root.coords}
    return data.assign_coords({"space": list("xyz"), **coordinates}).assign_attrs(about)


def estimates_in(recording: xr.DataTree) -> xr.Dataset:
    """Group ``estimates`` of a recording, checked for completeness."""
    return _group_in(recording, "estimates", ESTIMATED)


def signals_in(recording: xr.DataTree) -> xr.Dataset:
    """Group ``signals`` of a recording, checked for completeness."""
    return _group_in(recording, "signals", MEASURED)


# Function and command-line verb that compute each group.
_VERBS = {"signals": ("signals_of", "signals"), "estimates": ("estimates_of", "estimate")}


def _group_in(recording: xr.DataTree, name: str, needs: Sequence[str]) -> xr.Dataset:
    """Group of a recording, with all variables that later stages need."""
    group = recording.children.get(name)
    function, verb = _VERBS[name]
    if group is None:
        got = ", ".join(sorted(recording.children)) or "no groups"
        raise ValueError(
            f"the recording has no group {name} (it has {got}): compute it first by {function} or "
            f"`vibrissa {verb}`"
        )
    data = group.to_dataset()
    missing = [variable for variable in needs if variable not in data]
    faults = [f"it lacks {', '.join(missing)}"] if missing else []
    faults += faults_in(data)
    if faults:
        raise ValueError(
            f"the group {name} of the recording cannot be used: {'; '.join(faults)}; compute it "
            f"again by `vibrissa {verb}`"
        )
    return data


def whisker_radii(estimates: xr.Dataset, whiskers: Sequence[Whisker]) -> Array:
    """Radii (time, whisker) of the whiskers at their contacts, m; NaN without contact."""
    arc_length = Group(estimates)["arc_length"]
    radius = np.full(arc_length.shape, np.nan)
    for k, whisker in enumerate(whiskers):
        known = np.isfinite(arc_length[:, k])
        radius[known, k] = whisker.radius(arc_length[known, k])
    return radius
