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
from vibrissa.mapping import ContactMap, estimate_from_wrench
from vibrissa.mapping.contact_map import spherical
from vibrissa.quantities import attributes
from vibrissa.signals import base_signals
from vibrissa.status import Status, flag_attributes
from vibrissa.whisker import Whisker

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
    noise: Array,
    method: str = "exact",
) -> xr.Dataset:
    """Estimate the contact point in every frame in which a contact is felt.

    Parameters
    ----------
    contact_map : ContactMap
        Of the whisker.
    wrench : xarray.Dataset
        Dims time, space: ``force`` and ``moment`` as measured, whisker's frame, N and N·m.
    triplet : tuple of str
        The signals to estimate from, three or more.
    noise : array (6, 6)
        Covariance of (F, M), SI units; see `component_noise`.
    method : {"exact", "lookup", "lookup-linear", "network"}
        As of ``ContactMap.estimate``.

    Returns
    -------
    xarray.Dataset
        Dim time, all frames of ``wrench``: ``contact_point_whisker`` with ``covariance``,
        ``arc_length``, ``force`` at the base as the contact found would make it, the same of all
        candidates (``candidate_points``, ``candidate_covariance``, ...), their number
        ``candidates``, ``in_contact`` (felt) and ``status``.
        Where nothing is felt all is NaN and the status ``NO_CONTACT``.
    """
    force, moment, known, felt = _felt(wrench, noise)
    found = contact_map.estimate(base_signals(force[felt], moment[felt]), triplet, noise, method)
    columns = {
        "covariance": (found.candidate_covariances, attributes("covariance")),
        "arc_length": (found.candidate_arc_lengths, attributes("arc_length")),
        "force": (found.candidate_forces, attributes("force")),
        "points": (found.candidates, attributes("contact_point_whisker")),
    }
    status = np.where(known, int(Status.NO_CONTACT), int(Status.MISSING)).astype(np.int8)
    status[felt] = found.status
    number = np.zeros(len(known), dtype=np.int64)
    number[felt] = found.n_candidates
    data: dict[str, Any] = {
        "contact_point_whisker": _first(felt, *columns["points"]),
        "covariance": _first(felt, *columns["covariance"]),
        "arc_length": _first(felt, *columns["arc_length"]),
        "force": _first(felt, *columns["force"]),
        "candidates": ("time", number, attributes("candidates")),
        "in_contact": ("time", felt, attributes("in_contact")),
        "status": ("time", status, {**attributes("status"), **flag_attributes()}),
    }
    for name, (values, meaning) in columns.items():
        dims = ("time", "candidate", "space", "space_2")[: values.ndim]
        data[f"candidate_{name}"] = (dims, _everywhere(felt, values), meaning)
    # A contact is felt above this bending moment, N·m.
    about = {
        "triplet": " ".join(triplet),
        "felt_above": FELT * _moment_noise(noise),
    }
    return xr.Dataset(data, {"time": wrench["time"], "space": list("xyz")}, about)


def component_noise(force_noise: float, moment_noise: float) -> Array:
    """Covariance of a sensor whose components have independent noise.

    Parameters
    ----------
    force_noise, moment_noise : float
        Standard deviation of a component of force, N, and of moment, N·m.

    Returns
    -------
    array (6, 6)
        Of (F, M), SI units.
    """
    return np.diag(np.repeat([force_noise**2, moment_noise**2], 3))


def locate_from_wrench(whisker: Whisker, wrench: xr.Dataset, noise: Array) -> xr.Dataset:
    """Locate contacts from all six components, with friction or without.

    Parameters
    ----------
    whisker : Whisker
        What is touched.
    wrench : xarray.Dataset
        As for `locate`.
    noise : array (6, 6)
        Covariance of (F, M), SI units.

    Returns
    -------
    xarray.Dataset
        Dim time, all frames of ``wrench``: ``contact_point_whisker`` with ``covariance``,
        ``arc_length``, ``friction_angle``, ``in_contact`` (felt) and ``status``.
    """
    force, moment, known, felt = _felt(wrench, noise)
    found = estimate_from_wrench(whisker, force[felt], moment[felt], noise=noise)
    status = np.where(known, int(Status.NO_CONTACT), int(Status.MISSING)).astype(np.int8)
    status[felt] = found.status
    dims = ("time", "space", "space_2")
    parts = {
        "contact_point_whisker": found.point,
        "covariance": found.covariance,
        "arc_length": found.arc_length,
        "friction_angle": found.friction_angle,
    }
    data: dict[str, Any] = {
        name: (dims[: part.ndim], _everywhere(felt, part), attributes(name))
        for name, part in parts.items()
    }
    data["in_contact"] = ("time", felt, attributes("in_contact"))
    data["status"] = ("time", status, {**attributes("status"), **flag_attributes()})
    about = {"felt_above": FELT * _moment_noise(noise)}
    return xr.Dataset(data, {"time": wrench["time"], "space": list("xyz")}, about)


def _felt(
    wrench: xr.Dataset, noise: Array
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Force and moment (n, 3); in which frames they are known, and in which a contact is felt."""
    force, moment = (wrench[name].transpose("time", "space").values for name in ("force", "moment"))
    known = np.isfinite(force).all(axis=1) & np.isfinite(moment).all(axis=1)
    with np.errstate(invalid="ignore"):
        felt = known & (np.hypot(moment[:, 1], moment[:, 2]) > FELT * _moment_noise(noise))
    return force, moment, known, felt


def _moment_noise(noise: Array) -> float:
    """Standard deviation of a component of the bending moment, N·m."""
    return float(np.sqrt(0.5 * (noise[4, 4] + noise[5, 5])))


def _first(rows: NDArray[np.bool_], values: Array, about: dict[str, str]) -> Any:
    """The first candidates' values as a variable over all rows."""
    dims = ("time", "space", "space_2")[: values.ndim - 1]
    return dims, _everywhere(rows, values[:, 0]), about


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
        force, which without friction is that of the surface), laboratory frame; all of the
        candidate chosen.
    """
    rotation, position = np.asarray(base_rotation), np.asarray(base_position)
    points = contacts["candidate_points"].values
    lab = to_laboratory(points, rotation[:, None], position[:, None])
    felt = np.flatnonzero(contacts["in_contact"].values)
    chosen = np.full(len(points), -1)
    chosen[felt] = continuing_candidates(lab[felt], felt)
    rows = np.flatnonzero(chosen >= 0)
    kept = {
        name: _chosen(contacts[f"candidate_{source}"], chosen).assign_attrs(attributes(name))
        for name, source in (
            ("contact_point_whisker", "points"),
            ("covariance", "covariance"),
            ("arc_length", "arc_length"),
            ("force", "force"),
        )
    }
    placed = np.full((len(points), 3), np.nan)
    placed[rows] = lab[rows, chosen[rows]]
    spread = covariance_to_laboratory(kept["covariance"].values, rotation)
    normal = np.einsum("tij,tj->ti", rotation, kept["force"].values)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    lab_frame = {"reference_frame": "laboratory"}
    space = ("time", "space")
    return contacts.assign(kept).assign(
        contact_point=(space, placed, {**attributes("contact_point"), **lab_frame}),
        contact_covariance=(
            (*space, "space_2"),
            spread,
            {**attributes("covariance"), **lab_frame},
        ),
        contact_normal=(
            space,
            normal,
            {"units": "1", "long_name": "direction of the contact force", **lab_frame},
        ),
    )


def _chosen(candidates: xr.DataArray, chosen: NDArray[np.int64]) -> xr.DataArray:
    """One candidate of each frame; NaN where the number is -1."""
    which = xr.DataArray(np.maximum(chosen, 0), dims="time")
    return candidates.isel(candidate=which).where(xr.DataArray(chosen >= 0, dims="time"))


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
