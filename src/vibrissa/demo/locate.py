"""From the measured wrench to contact points, in the whisker's frame and in the laboratory.

A contact is felt where the bending moment M_B exceeds five standard deviations of its noise. Where
several contacts explain the signals, the one with the least force is taken; where the motion of the
base is known, the one that goes on from the frames around (`vibrissa.contour.continuity`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contour import continuing_candidates, covariance_to_laboratory, to_laboratory
from vibrissa.mapping import ContactMap
from vibrissa.mapping.contact_map import spherical
from vibrissa.quantities import attributes
from vibrissa.signals import base_signals
from vibrissa.status import Status, flag_attributes

Array = NDArray[np.float64]

TRIPLET = ("Fx", "MB", "MD")
"""What contacts are estimated from by default."""

FELT = 5.0
"""Bending moment from which a contact is felt, in standard deviations of its noise."""


def locate(
    contact_map: ContactMap,
    wrench: xr.Dataset,
    triplet: tuple[str, ...] = TRIPLET,
    *,
    force_noise: float,
    moment_noise: float,
) -> xr.Dataset:
    """Estimate the contact point in every frame in which a contact is felt.

    Parameters
    ----------
    contact_map : ContactMap
        Of the whisker.
    wrench : xarray.Dataset
        Dims time, space: ``force`` and ``moment`` as measured, whisker's frame, N and N·m.
    triplet : tuple of str
        The three signals to estimate from.
    force_noise, moment_noise : float
        Standard deviation of a component of force, N, and moment, N·m.

    Returns
    -------
    xarray.Dataset
        Dim time, all frames of ``wrench``: ``contact_point_whisker`` with ``covariance``,
        ``arc_length``, ``force`` at the base as the contact found would make it,
        ``candidate_points`` and their number ``candidates``, ``in_contact`` (felt) and ``status``.
        Where nothing is felt all is NaN and the status ``NO_CONTACT``.
    """
    force, moment = (wrench[name].transpose("time", "space").values for name in ("force", "moment"))
    known = np.isfinite(force).all(axis=1) & np.isfinite(moment).all(axis=1)
    with np.errstate(invalid="ignore"):
        felt = known & (np.hypot(moment[:, 1], moment[:, 2]) > FELT * moment_noise)
    noise = np.diag(np.repeat([force_noise**2, moment_noise**2], 3))
    found = contact_map.estimate(base_signals(force[felt], moment[felt]), triplet, noise)
    status = np.where(known, int(Status.NO_CONTACT), int(Status.MISSING)).astype(np.int8)
    status[felt] = found.status
    number = np.zeros(len(known), dtype=np.int64)
    number[felt] = found.n_candidates
    space = ("time", "space")
    flags = {**attributes("status"), **flag_attributes()}
    data: dict[str, Any] = {
        "contact_point_whisker": (space, _everywhere(felt, found.point)),
        "covariance": ((*space, "space_2"), _everywhere(felt, found.covariance)),
        "arc_length": ("time", _everywhere(felt, found.arc_length)),
        "force": (space, _everywhere(felt, found.force)),
        "candidates": ("time", number),
        "in_contact": ("time", felt),
    }
    data = {name: (*rest, attributes(name)) for name, rest in data.items()}
    data["candidate_points"] = (
        ("time", "candidate", "space"),
        _everywhere(felt, found.candidates),
        attributes("contact_point_whisker"),
    )
    data["status"] = ("time", status, flags)
    # A contact is felt above this bending moment, N·m.
    about = {
        "triplet": " ".join(triplet),
        "felt_above": FELT * moment_noise,
    }
    return xr.Dataset(data, {"time": wrench["time"], "space": list("xyz")}, about)


def _everywhere(rows: NDArray[np.bool_], values: Array) -> Array:
    """Values (n, ...) of some rows as values of all rows, the others NaN."""
    out = np.full((rows.size, *values.shape[1:]), np.nan)
    out[rows] = values
    return out


def in_laboratory(
    contacts: xr.Dataset, base_rotation: ArrayLike, base_position: ArrayLike
) -> xr.Dataset:
    """Bring contacts to the laboratory, and choose among candidates by continuity there.

    Parameters
    ----------
    contacts : xarray.Dataset
        Of `locate`.
    base_rotation : array_like (n, 3, 3)
        From the whisker's to the laboratory frame, frame by frame.
    base_position : array_like (n, 3)
        The base in the laboratory, m.

    Returns
    -------
    xarray.Dataset
        With ``contact_point``, ``contact_covariance`` and ``contact_normal`` (direction of the
        force, which without friction is that of the surface), laboratory frame. Where
        another candidate than the first was chosen, only its point is known and the rest is NaN.
    """
    rotation, position = np.asarray(base_rotation), np.asarray(base_position)
    points = contacts["candidate_points"].values
    lab = to_laboratory(points, rotation[:, None], position[:, None])
    felt = np.flatnonzero(contacts["in_contact"].values)
    chosen = np.full(len(points), -1)
    chosen[felt] = continuing_candidates(lab[felt], felt)
    rows = np.flatnonzero(chosen >= 0)
    first = chosen == 0
    placed = np.full((len(points), 3), np.nan)
    placed[rows] = lab[rows, chosen[rows]]
    local = np.full((len(points), 3), np.nan)
    local[rows] = points[rows, chosen[rows]]
    spread = covariance_to_laboratory(contacts["covariance"].values, rotation)
    normal = np.einsum("tij,tj->ti", rotation, contacts["force"].values)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    kept = contacts.where(xr.DataArray(first | (chosen < 0), dims="time")).assign(
        {name: contacts[name] for name in ("candidates", "in_contact", "status")}
    )
    lab_frame = {"reference_frame": "laboratory"}
    space = ("time", "space")
    return kept.assign(
        candidate_points=contacts["candidate_points"],
        contact_point_whisker=(space, local, attributes("contact_point_whisker")),
        contact_point=(space, placed, {**attributes("contact_point"), **lab_frame}),
        contact_covariance=(
            (*space, "space_2"),
            np.where(first[:, None, None], spread, np.nan),
            {**attributes("covariance"), **lab_frame},
        ),
        contact_normal=(
            space,
            np.where(first[:, None], normal, np.nan),
            {"units": "1", "long_name": "direction of the contact force", **lab_frame},
        ),
    )


def contact_columns(contacts: xr.Dataset) -> xr.Dataset:
    """Spread contacts over the columns of a table of contacts, whisker's frame.

    Parameters
    ----------
    contacts : xarray.Dataset
        Of `locate` or `in_laboratory`.

    Returns
    -------
    xarray.Dataset
        Dim time: x, y, z, r, theta, phi, sigma_x, sigma_y, sigma_z and status.
    """
    point = contacts["contact_point_whisker"].values
    variance = np.einsum("tii->ti", contacts["covariance"].values)
    values = np.concatenate([point, spherical(point), np.sqrt(variance)], axis=1)
    names = ("x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
    columns = {name: ("time", values[:, i], attributes(name)) for i, name in enumerate(names)}
    table = xr.Dataset(columns, {"time": contacts["time"]}, contacts.attrs)
    return table.assign(status=contacts["status"])
