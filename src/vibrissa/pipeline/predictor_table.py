"""Table of predictors of a trial for spike models and other statistical analyses.

Models that relate the responses of primary sensory neurons to a whisker's mechanics use 16
predictors: three components of force, three of moment, two angles of the whisker's base, and the
rates of change of these eight (Bush, Solla & Hartmann 2021, doi:10.1073/pnas.2020194118). The table
also contains the six signals, the rest of the base's pose, contacts and flags.
"""

from __future__ import annotations

import warnings

import numpy as np
import xarray as xr

from vibrissa.contacts import friction_assumed
from vibrissa.io import check_scale
from vibrissa.numerics import Array
from vibrissa.pipeline.events import EVENTS
from vibrissa.quantities import attributes
from vibrissa.recording import ONE_VIEW, Recording
from vibrissa.signals import base_signals
from vibrissa.status import Event, Status, flag_attributes
from vibrissa.whisker import angles_of

_COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
_ANGLES = ("base_azimuth", "base_elevation", "base_roll")
_RATE = "_rate"

# Names of the 16 columns that spike models use.
PREDICTORS = (*_COMPONENTS, *_ANGLES[:2], *(name + _RATE for name in (*_COMPONENTS, *_ANGLES[:2])))
# Columns that a single camera view cannot measure: they are zero up to rounding.
_UNSEEN = ("Fz", "Mx", "My", "base_elevation")

# Groups searched, in this order, for force, moment and pose.
_GROUPS = ("signals", "", "truth")


def predictors(recording: xr.DataTree) -> xr.Dataset:
    """Tabulate mechanical predictors of every frame and whisker of a trial.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording with force and moment, preferably in the group ``signals``. Contact points are
        those of the group ``estimates`` if there is one, otherwise those of the recording.

    Returns
    -------
    xarray.Dataset
        Variables over (time, whisker), SI units, each with ``units``, ``long_name`` and
        ``description``: the six components of force and moment, the signals, the angles and
        position of the base, the rates of change of components and angles, the contact point in
        the laboratory frame and its arc length, ``in_contact``, ``contact_probability``,
        ``status``, ``confidence``, ``event`` and ``onset_time`` with ``onset_sigma``. The
        attribute ``predictors`` lists the 16 predictors of spike models, or for a trial filmed by
        one camera the 8 that it measures.
        Missing values are NaN.

    Raises
    ------
    ValueError
        If force and moment are unknown.

    Warns
    -----
    UserWarning
        If force or moment is far too large for the recording's whisker, which suggests wrong units.
    """
    record = Recording(recording)
    force, moment = (record.known(name, _GROUPS) for name in ("force", "moment"))
    if force is None or moment is None:
        raise ValueError("the recording has no force and moment yet: run `vibrissa signals` first")
    for k, whisker in enumerate(record.whiskers if "whiskers" in record else ()):
        try:
            check_scale(force[:, k], moment[:, k], whisker)
        except ValueError as fault:
            warnings.warn(f"{record.names[k]}: {fault}", stacklevel=2)
    columns = dict(
        zip(_COMPONENTS, np.moveaxis(np.concatenate([force, moment], -1), -1, 0), strict=True)
    )
    signals = base_signals(force, moment)
    columns |= {name: signals[name].values for name in ("FT", "FD", "MB", "MD")}
    if (rotation := record.known("base_rotation", _GROUPS)) is not None:
        angles = np.full(rotation.shape[:-1], np.nan)
        posed = np.isfinite(rotation).all(axis=(-2, -1))
        angles[posed] = angles_of(rotation[posed])
        columns |= {name: angles[..., i] for i, name in enumerate(_ANGLES)}
    time = record.root.data["time"].values
    rates = {
        name + _RATE: _rate(columns[name], time)
        for name in (*_COMPONENTS, *_ANGLES)
        if name in columns
    }
    position = record.known("base_position", _GROUPS)
    point = record.known("contact_point", ("estimates", "", "truth"))
    arc = record.known("arc_length", ("estimates", "", "truth"))
    columns |= rates
    for name, values in (("base_position", position), ("contact_point", point)):
        if values is not None:
            columns |= {f"{name}_{axis}": values[..., i] for i, axis in enumerate("xyz")}
    others = {
        "arc_length": arc,
        "in_contact": record.known("in_contact", _GROUPS),
        "contact_probability": record.known("contact_probability", ("signals",)),
        "status": record.known("status", ("estimates", *_GROUPS)),
        "confidence": record.known("confidence", ("",)),
    }
    if (estimates := record.find("estimates")) and estimates.known("event") is not None:
        others |= {name: estimates.get(name) for name in EVENTS}  # NaN where there is no time
    columns |= {name: values for name, values in others.items() if values is not None}
    data = {
        name: xr.Variable(("time", "whisker"), values, _about(name))
        for name, values in columns.items()
    }
    about = ""
    if estimates is not None and estimates.known("contact_point") is not None:
        friction = float(estimates.data.attrs.get("friction", np.nan))
        about = "" if np.isnan(friction) else f" Estimated, {friction_assumed(friction)}."
    elif record.root.known("contact_point") is None:
        about = " True, as simulated."
    for name in (*(f"contact_point_{axis}" for axis in "xyz"), "arc_length"):
        if name in data:
            data[name].attrs["description"] += about
    coordinates = {"time": ("time", time, attributes("time")), "whisker": record.names}
    unseen = _UNSEEN if ONE_VIEW in recording.attrs.get("remarks", "") else ()
    there = [n for n in PREDICTORS if n in data and n.removesuffix(_RATE) not in unseen]
    return xr.Dataset(data, coordinates, {"predictors": " ".join(there)})


def _rate(values: Array, time: Array) -> Array:
    """Central differences over time (axis 0); NaN next to missing values."""
    if len(time) < 2:
        return np.full(values.shape, np.nan)
    return np.asarray(np.gradient(values, time, axis=0))


def _about(name: str) -> dict[str, object]:
    """Attributes of a column: unit, name and description."""
    if name in ("status", "event"):
        return {**attributes(name), **flag_attributes(Event if name == "event" else Status)}
    plain = name.removesuffix(_RATE)
    if plain != name:
        known = attributes(plain)
        return {
            "units": f"{known['units']}/s",
            "long_name": f"rate of change of {known['long_name']}",
            "description": "Central difference over the frames before and after.",
        }
    stem, _, axis = name.rpartition("_")
    if stem in ("base_position", "contact_point"):
        known = attributes(stem)
        return {
            **known,
            "long_name": f"{known['long_name']}, {axis}",
            "description": "Laboratory frame.",
        }
    return dict(attributes(name))
