"""From the measured wrench to contact points in the whisker's frame.

A contact is felt where the bending moment M_B exceeds five standard deviations of its noise. Where
several contacts explain the signals, the one with the least force is taken, until their places in
the laboratory tell which goes on from the frames around (`vibrissa.pipeline.laboratory`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from vibrissa.contacts import (
    WRENCH,
    ContactMap,
    Prior,
    common_covariance,
    common_errors,
    estimate_from_wrench,
)
from vibrissa.pipeline.slopes import contact_normals, gains
from vibrissa.quantities import attributes
from vibrissa.recording import Group
from vibrissa.signals import base_signals, selection
from vibrissa.status import Status, flag_attributes
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

TRIPLET = ("Fx", "MB", "MD")
"""What contacts are estimated from by default."""

FELT = 5.0
"""Bending moment from which a contact is felt, in standard deviations of its noise."""

_WHISKER = {"reference_frame": "whisker"}


class _Candidates(NamedTuple):
    """Of the frames in which a contact is felt: rows × candidates, padded with NaN, SI units."""

    points: Array
    arc_lengths: Array
    forces: Array
    contact_forces: Array
    number: NDArray[np.int64]
    status: NDArray[np.int64]


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


def locate(
    contact_map: ContactMap,
    wrench: xr.Dataset,
    triplet: tuple[str, ...] = TRIPLET,
    *,
    noise: ArrayLike | None,
    method: str = "exact",
    errors: Mapping[str, Any] | None = None,
    prior: Prior | None = None,
) -> xr.Dataset:
    """Estimate the contact point in every frame in which a contact is felt.

    Parameters
    ----------
    contact_map : ContactMap
        Of the whisker.
    wrench : xarray.Dataset
        Dims time, space: ``force`` and ``moment`` as measured, whisker's frame, N and N·m. Where it
        has ``in_contact``, nothing is felt in other frames.
    triplet : tuple of str
        The signals to estimate from, three or more.
    noise : array_like (6, 6) or (time, 6, 6), optional
        Covariance of (F, M), SI units, of all frames or of each; see `component_noise`. None: not
        known; then there are no covariances, and a contact is felt wherever M_B is not zero.
    method : {"exact", "lookup", "lookup-linear", "network"}
        Exact, or one of the paper's methods, as of :func:`vibrissa.paper.estimate`.
    errors : mapping of str to float, optional
        ``stiffness_sigma``, ``gain_sigma`` and ``mixing_sigma``, as of ``ContactMap.estimate``:
        the same errors in all frames. They need noise.
    prior : Prior, optional
        Which contacts are possible; others are left out of the candidates.

    Returns
    -------
    xarray.Dataset
        Dim time, all frames of ``wrench``: ``contact_point_whisker`` with ``covariance``,
        ``arc_length``, ``force`` at the base as the contact found would make it, the same of all
        candidates (``candidate_points``, ``candidate_covariance``, ...), their number
        ``candidates``, ``in_contact`` (felt) and ``status``; and of the candidates what leads from
        an error of the wrench to one of the contact, ``candidate_gain``, with the covariance of the
        wrench by noise and errors, ``wrench_covariance``. Covariances are those of the exact way in
        every method. Where nothing is felt all is NaN, and the status ``NOT_FELT``, or
        ``NO_CONTACT`` where force and moment are zero or ``in_contact`` says so.

    Raises
    ------
    ValueError
        If the noise does not fit.
    """
    names = selection(triplet)
    felt = _Felt.of(wrench, noise, errors)
    signals = base_signals(felt.force[felt.rows], felt.moment[felt.rows])
    if method == "exact":
        found = contact_map.estimate(signals, names, felt.typical, prior=prior, **(errors or {}))
    else:
        from vibrissa.paper import estimate  # it loads what only comparisons need

        found = estimate(contact_map, signals, names, method=method, prior=prior)
    every = found.candidates
    candidates = _Candidates(
        every.point,
        every.arc_length,
        every.force,
        every.contact_force,
        found.n_candidates,
        found.status,
    )
    stated = every.covariance if method == "exact" else None
    return _located(contact_map.whisker, names, felt, candidates, stated)


def unfelt(
    whisker: Whisker,
    wrench: xr.Dataset,
    triplet: tuple[str, ...] = TRIPLET,
    *,
    noise: ArrayLike | None,
) -> xr.Dataset | None:
    """Say what `locate` would, without a map, where no contact is felt in any frame."""
    felt = _Felt.of(wrench, noise)
    if felt.rows.any():
        return None
    points, numbers = np.empty((0, 1, 3)), np.empty(0, dtype=np.int64)
    none = _Candidates(points, points[..., 0], points, points, numbers, numbers)
    return _located(whisker, selection(triplet), felt, none)


def locate_from_wrench(
    whisker: Whisker,
    wrench: xr.Dataset,
    noise: ArrayLike | None,
    errors: Mapping[str, Any] | None = None,
    prior: Prior | None = None,
) -> xr.Dataset:
    """Locate contacts from all six components, with friction or without.

    Parameters
    ----------
    whisker : Whisker
        What is touched.
    wrench : xarray.Dataset
        As for `locate`.
    noise : array_like (6, 6) or (time, 6, 6), optional
        As for `locate`.
    errors : mapping of str to float, optional
        As for `locate`.
    prior : Prior, optional
        As for `locate`.

    Returns
    -------
    xarray.Dataset
        As of `locate`, with ``friction_angle``.
    """
    felt = _Felt.of(wrench, noise, errors)
    found = estimate_from_wrench(
        whisker,
        felt.force[felt.rows],
        felt.moment[felt.rows],
        noise=felt.typical,
        prior=prior,
        **(errors or {}),
    )
    every = found.candidates
    candidates = _Candidates(
        every.point,
        every.arc_length,
        every.force,
        every.contact_force,
        found.n_candidates,
        found.status,
    )
    return _located(whisker, WRENCH, felt, candidates, every.covariance)


class _Felt(NamedTuple):
    """What is measured: force, moment (n, 3), their covariance (n, 6, 6), NaN if not known.

    And in which frames they are known, in which a contact is felt and in which there is none, (n,);
    the noise of all frames together, (6, 6), if there is any; errors that all frames share
    (k, 6, 7); M_B from which contacts are felt, N·m; and whether all frames are as noisy.
    """

    time: xr.Variable
    force: Array
    moment: Array
    covariance: Array
    known: NDArray[np.bool_]
    rows: NDArray[np.bool_]
    free: NDArray[np.bool_]
    typical: Array | None
    errors: Array
    above: float
    steady: bool

    @classmethod
    def of(
        cls, wrench: xr.Dataset, noise: ArrayLike | None, errors: Mapping[str, Any] | None = None
    ) -> _Felt:
        """Look at a measured wrench."""
        force, moment = (Group(wrench)[name] for name in ("force", "moment"))
        n = len(force)
        covariance = _noise_of_frames(noise, n)
        known = np.isfinite(force.sum(axis=1) + moment.sum(axis=1))
        size = np.hypot(moment[:, 1], moment[:, 2])
        least = 0.0 * size
        if noise is not None:
            least = FELT * np.sqrt(0.5 * (covariance[:, 4, 4] + covariance[:, 5, 5]))
            least = np.nan_to_num(least)
        with np.errstate(invalid="ignore"):
            rows = known & (size > least)
        free = known & ~force.any(axis=1) & ~moment.any(axis=1)
        if "in_contact" in wrench:
            touching = Group(wrench)["in_contact"]
            rows &= touching
            free |= known & ~touching
        above = float(np.median(least[rows])) if rows.any() else float(np.nanmax(least, initial=0))
        typical, steady = None, bool((covariance == covariance[:1]).all())
        if noise is not None:
            typical = covariance[0] if steady else _typical(covariance[rows])
        shared = common_errors(**(errors or {}))
        if len(shared):
            whole = np.concatenate([force, moment], axis=1)
            covariance = covariance + common_covariance(shared, np.eye(6), whole)
        time = wrench["time"].variable
        return cls(
            time, force, moment, covariance, known, rows, free, typical, shared, above, steady
        )


def _noise_of_frames(noise: ArrayLike | None, n: int) -> Array:
    """Covariances (n, 6, 6)."""
    if noise is None:
        return np.full((n, 6, 6), np.nan)
    array = np.asarray(noise, dtype=np.float64)
    if array.shape not in ((6, 6), (n, 6, 6)):
        raise ValueError(f"noise has shape {array.shape}; (6, 6) or ({n}, 6, 6) is needed")
    return np.broadcast_to(array, (n, 6, 6))


def _typical(covariance: Array) -> Array | None:
    """Of sensors as noisy as those of the frames (n, 6, 6) usually are, equally in all axes."""
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    variances = variances[np.isfinite(variances).all(axis=1)]
    if not variances.size:
        return None
    force, moment = (np.sqrt(np.median(v.mean(axis=1))) for v in np.hsplit(variances, 2))
    return component_noise(float(force), float(moment))


def _located(
    whisker: Whisker,
    names: tuple[str, ...],
    felt: _Felt,
    found: _Candidates,
    stated: Array | None = None,
) -> xr.Dataset:
    """Write candidates of the felt frames as a dataset of all frames.

    Covariances are those ``stated`` (n, some, 3, 3) by the estimate, which hold what they say up to
    slip-off, where all frames are as noisy as it took them to be; otherwise of first order.
    """
    rows = felt.rows
    shape = found.arc_lengths.shape
    flat = (found.arc_lengths.reshape(-1), found.contact_forces.reshape(-1, 3))
    gain = gains(whisker, names, *flat, felt.typical, felt.errors).reshape(*shape, 6, 6)
    normals = contact_normals(whisker, *flat).reshape(*shape, 3)
    point_gain = gain[..., :3, :]
    spread = point_gain @ felt.covariance[rows][:, None] @ np.swapaxes(point_gain, -1, -2)
    if stated is not None and felt.steady:
        first = spread[:, : stated.shape[1]]
        first[:] = np.where(np.isfinite(stated), stated, first)
    status = np.where(felt.known, int(Status.NOT_FELT), int(Status.MISSING)).astype(np.int8)
    status[felt.free] = int(Status.NO_CONTACT)
    status[rows] = found.status
    number = np.zeros(rows.size, dtype=np.int64)
    number[rows] = found.number
    columns = {
        "points": ("contact_point_whisker", found.points),
        "covariance": ("covariance", spread),
        "arc_length": ("arc_length", found.arc_lengths),
        "force": ("force", found.forces),
    }
    data: dict[str, Any] = {}
    for short, (name, values) in columns.items():
        dims = ("time", "candidate", "space", "space_2")[: values.ndim]
        everywhere = _everywhere(rows, values)
        data[name] = ((dims[0], *dims[2:]), everywhere[:, 0], attributes(name))
        data[f"candidate_{short}"] = (dims, everywhere, attributes(name))
    data["candidate_normal"] = (
        ("time", "candidate", "space"),
        _everywhere(rows, normals),
        attributes("contact_normal") | _WHISKER,
    )
    data["candidate_gain"] = (
        ("time", "candidate", "contact_component", "component"),
        _everywhere(rows, gain),
        {"units": "(m, 1)/(N, N m)", "long_name": "contact point and normal by force and moment"},
    )
    if names == WRENCH:
        angle = np.arctan2(
            found.contact_forces[:, 0, 0], np.linalg.norm(found.contact_forces[:, 0, 1:], axis=-1)
        )
        data["friction_angle"] = ("time", _everywhere(rows, angle), attributes("friction_angle"))
    data["wrench_covariance"] = (
        ("time", "component", "component_"),
        felt.covariance,
        attributes("wrench_covariance"),
    )
    data["candidates"] = ("time", number, attributes("candidates"))
    data["in_contact"] = ("time", rows, attributes("in_contact"))
    data["status"] = ("time", status, {**attributes("status"), **flag_attributes()})
    about = {"triplet": " ".join(names), "felt_above": felt.above}
    return xr.Dataset(data, {"time": felt.time, "space": list("xyz")}, about)


def _everywhere(rows: NDArray[np.bool_], values: Array) -> Array:
    """Values (n, ...) of some rows as values of all rows, the others NaN."""
    out = np.full((rows.size, *values.shape[1:]), np.nan)
    out[rows] = values
    return out
