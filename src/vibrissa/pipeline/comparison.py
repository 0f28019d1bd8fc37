"""How far estimated contacts lie from an object that is known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from vibrissa.contour import compare_with, distances_by
from vibrissa.objects import Surface
from vibrissa.pipeline.frames import EACH, estimates_in, whisker_radii
from vibrissa.quantities import attributes
from vibrissa.recording import Group, Recording
from vibrissa.signals import nearest_on_rest
from vibrissa.whisker import Whisker

ANGLE_CLASSES = (0.0, 2.0, 5.0, 10.0, 15.0, 90.0)
"""Edges of the classes of deflection angle, degrees."""

ANGLES = np.deg2rad(ANGLE_CLASSES)
"""The same, rad."""


def nearest_object(
    estimates: xr.Dataset, whiskers: Sequence[Whisker], objects: Sequence[Surface]
) -> int:
    """Find the object that contacts are nearest to."""
    if not objects:
        raise ValueError("no object is known to compare with")
    points = Group(estimates)["contact_point"]
    there = np.isfinite(points).all(axis=-1)
    if not there.any():
        raise ValueError("there are no contacts to compare with the objects")
    radius = whisker_radii(estimates, whiskers)[there]
    medians = [
        np.median(np.abs(thing.signed_distance(points[there]) - radius)) for thing in objects
    ]
    return int(np.argmin(medians))


def compare_contacts(
    recording: xr.DataTree,
    objects: Sequence[Surface] | None = None,
    whiskers: Sequence[Whisker] | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Compare the contacts of a recording with the known object that they are nearest to.

    Parameters
    ----------
    recording : xarray.DataTree
        With a group ``estimates``.
    objects : sequence of Surface, optional
        In the laboratory; by default those of the recording.
    whiskers : sequence of Whisker, optional
        By default those of the recording.
    seed : int
        Of the draws of what the covariance predicts.

    Returns
    -------
    xarray.Dataset
        Dims time, whisker: ``surface_distance`` and, over ``replicate`` too,
        ``surface_distance_predicted`` (`vibrissa.contour.compare_with`), and of each contact
        ``deflection_angle``, ``r`` and, where there are signals, ``MB``. Attribute ``object``: its
        number.

    Raises
    ------
    ValueError
        If there are no estimates, no contacts or no objects.
    """
    estimates = estimates_in(recording)
    trial, contacts = Recording(recording), Group(estimates)
    known = trial.objects if objects is None else tuple(objects)
    touching = trial.whiskers if whiskers is None else whiskers
    number = nearest_object(estimates, touching, known)
    spread = contacts["contact_covariance"]
    out = compare_with(
        known[number],
        contacts["contact_point"],
        spread if np.isfinite(spread).any() else None,
        whisker_radii(estimates, touching),
        dims=EACH,
        coords={name: estimates[name].variable for name in EACH if name in estimates.coords},
        seed=seed,
    )
    local = contacts["contact_point_whisker"]
    angle = np.full(local.shape[:2], np.nan)
    for k, whisker in enumerate(touching):
        rows = np.flatnonzero(np.isfinite(local[:, k]).all(axis=1))
        distance, arc_length = nearest_on_rest(whisker, local[rows, k])
        angle[rows, k] = np.arctan2(distance, arc_length)
    by = {"deflection_angle": angle, "r": np.linalg.norm(local, axis=-1)}
    if "signals" in trial:
        by["MB"] = trial["signals"]["MB"]
    out = out.assign({name: (EACH, v, attributes(name)) for name, v in by.items()})
    return out.assign_attrs(object=number)


def distances_by_class(compared: xr.Dataset) -> dict[str, xr.Dataset]:
    """Sum up distances from a known object by how the whisker was bent, where, and how it felt.

    Parameters
    ----------
    compared : xarray.Dataset
        Of `compare_contacts`.

    Returns
    -------
    dict
        Of `vibrissa.contour.distances_by`, by deflection angle, radial distance and bending moment.
    """
    tables = {}
    for name in ("deflection_angle", "r", "MB"):
        if name in compared:
            edges = ANGLES if name == "deflection_angle" else None
            tables[name] = distances_by(compared, name, compared[name].values, edges)
    return tables
