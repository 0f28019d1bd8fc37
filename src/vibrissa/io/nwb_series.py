"""What NWB files of ours hold beside traces: how whiskers are held, what they feel and touch.

`save_nwb` writes a series for each quantity and whisker, called as the quantity and the whisker,
such as ``force_C2``. They need no extension of NWB, so that a simulated trial, which nobody traced,
comes back as well.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import h5py
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.io.hdf5 import opened
from vibrissa.io.nwb import series_time, series_values
from vibrissa.quantities import attributes

Array = NDArray[np.float64]

_AXES = ("space",)
_EACH: dict[str, tuple[str, ...]] = {
    "base_position": _AXES,
    "base_rotation": (*_AXES, "whisker_axis"),
    "contact_point_whisker": _AXES,
    "contact_point": _AXES,
    "force": _AXES,
    "moment": _AXES,
}
"""Dimensions beside time and whisker; longer names before those that they begin with."""

_OF_HEAD: dict[str, tuple[str, ...]] = {
    "head_position": _AXES,
    "head_rotation": (*_AXES, "head_axis"),
}


def load_nwb_series(path: str | PathLike[str]) -> xr.Dataset:
    """Read poses, forces, moments and contact points of an NWB file that `save_nwb` wrote.

    Parameters
    ----------
    path : str or path
        The ``.nwb`` file.

    Returns
    -------
    xarray.Dataset
        Dims time, whisker, space, as at the top of a recording: of ``base_position``,
        ``base_rotation``, ``contact_point``, ``contact_point_whisker``, ``force``, ``moment``,
        ``head_position`` and ``head_rotation`` what the file has; SI units.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is of another kind, cut short, has no such series, or their times differ.
    """
    path = Path(path)
    with opened(path, "an NWB file") as file:
        behavior = file.get("processing/behavior")
        found = {} if behavior is None else _found(behavior)
        if not found:
            raise ValueError(
                f"{path} has no series of {', '.join(_EACH)}, called as these and the whisker: it "
                "was not written by save_nwb"
            )
        time = series_time(next(iter(found.values())))
        if any(not np.array_equal(series_time(series), time) for series in found.values()):
            raise ValueError(f"{path} has series at different times; one clock is needed")
        values = {key: series_values(series, "data") for key, series in found.items()}
    for (name, who), array in values.items():
        shape = (time.size, *(3,) * len((_EACH | _OF_HEAD)[name]))
        if array.shape != shape:
            raise ValueError(
                f"{path} has {name} {who} of shape {array.shape}; {shape} is needed".replace(
                    "  ", " "
                )
            )
    whiskers = list(dict.fromkeys(who for _, who in values if who))
    data = {}
    for name, axes in (_EACH | _OF_HEAD).items():
        of = {who: array for (n, who), array in values.items() if n == name}
        if name in _OF_HEAD and of:
            data[name] = (("time", *axes), of[""], attributes(name))
        elif of:
            missing = np.full(next(iter(of.values())).shape, np.nan)
            each = np.stack([of.get(who, missing) for who in whiskers], axis=1)
            data[name] = (("time", "whisker", *axes), each, attributes(name))
    named: dict[str, list[str]] = {dim: list("xyz") for dim in ("space", "whisker_axis")}
    coordinates = {"time": ("time", time, attributes("time")), "whisker": whiskers, **named}
    return xr.Dataset(data, coordinates)


def _found(behavior: h5py.Group) -> dict[tuple[str, str], h5py.Group]:
    """Series by quantity and whisker; of the head by quantity and nothing."""
    found = {}
    for key, item in behavior.items():
        name = str(key)
        if not isinstance(item, h5py.Group) or "data" not in item:
            continue
        if name in _OF_HEAD:
            found[name, ""] = item
            continue
        for variable in _EACH:
            if name.startswith(f"{variable}_"):
                found[variable, name.removeprefix(f"{variable}_")] = item
                break
    return found
