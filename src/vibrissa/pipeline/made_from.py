"""Checksums of the inputs of each stage, to detect later edits of a recording.

Each frame and whisker has its own checksum, which therefore survives selection and reordering.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from vibrissa.recording import VARIABLES, Recording, recorded

MADE_FROM = "made_from"
_POSE = ("base_position", "base_rotation", "pose_covariance")
_WRENCH = ("force", "moment", "wrench_covariance", "in_contact")
_POINT = ("contact_point", "contact_covariance", "in_contact")
_ANGLES = tuple(f"unfiltered_base_{name}" for name in ("position", "azimuth", "elevation", "roll"))
# Groups and variables from which each stage is computed.
_INPUTS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "signals": {
        "": (*_WRENCH, "reading", *_POINT[:2], *_POSE, "head_position", "head_rotation"),
        "measured": ("contact_point", *_ANGLES),
    },
    "estimates": {"signals": (*_WRENCH, *_POSE, "status", "pose_wrench_covariance")},
    "contour": {"estimates": (*_POINT, "contact_normal", "normal_covariance", "arc_length")},
}


def made_from(recording: xr.DataTree, stage: str) -> xr.Variable:
    """Checksums (time, whisker) of the values from which a stage is computed."""
    record = Recording(recording)
    shape = tuple(record.root.data.sizes[dim] for dim in ("time", "whisker"))
    parts = [np.zeros((*shape, 1))]
    for name, variables in _INPUTS[stage].items():
        for variable in variables if name == "" or name in record else ():
            if (values := record[name].get(variable)) is not None:
                each = shape[1] if "whisker" in VARIABLES[variable].dims else 1
                values = values.reshape(shape[0], each, -1)
                parts.append(np.broadcast_to(values, (*shape, values.shape[2])))
    numbers = np.concatenate(parts, axis=2, dtype=np.float64) + 0.0  # −0 is 0
    numbers[np.isnan(numbers)] = np.nan
    # With odd factors, any change of a single value changes the sum (modulo 2^64).
    factors = np.random.default_rng(0).integers(2**62, size=numbers.shape[2], dtype=np.uint64)
    total = np.einsum("twi,i->tw", numbers.view(np.uint64), 2 * factors + 1)
    return recorded(MADE_FROM, total.view(np.int64))


def edited(recording: xr.DataTree) -> list[str]:
    """Stages whose inputs in the recording have changed since they were computed."""
    present = [(name, recording.children[name]) for name in _INPUTS if name in recording.children]
    return [
        name
        for name, group in present
        if MADE_FROM in group
        and not np.array_equal(np.asarray(group[MADE_FROM]), made_from(recording, name))
    ]
