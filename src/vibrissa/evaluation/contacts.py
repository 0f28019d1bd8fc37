"""How far the estimates are from the truth, and how far the noise says that they should be.

What to expect is drawn, not linearised: the estimated covariance of every contact gives as many
errors as there are replicates, each replicate is scored like the trial itself, and the median over
replicates is the prediction.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.contacts.contact_map import spherical
from vibrissa.contour import CylinderFit, axis_offset
from vibrissa.objects import Peg
from vibrissa.pipeline import ANGLE_CLASSES
from vibrissa.signals import nearest_on_rest, within_turn
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

ERRORS = ("error_r", "error_theta", "error_phi", "error_distance")
"""Errors by name: of r, θ, φ, and in space."""

REPLICATES = 25
ANGLES = ANGLE_CLASSES
"""Edges of the classes of deflection angle, degrees."""

_QUANTILES = (0.5, 0.95, 1.0)


@dataclass(frozen=True, eq=False)
class ErrorRow:
    """Errors of some contacts in one quantity.

    Parameters
    ----------
    quantity : str
        Name of the error in the table of quantities.
    label : str
        Which contacts.
    contacts : int
        How many contacts that have an estimate.
    measured, predicted : array (3,)
        Median, 95 % and largest size of the error, SI units; what the covariance predicts.
    """

    quantity: str
    label: str
    contacts: int
    measured: Array
    predicted: Array


@dataclass(frozen=True, eq=False)
class Scores:
    """All numbers of a trial.

    Parameters
    ----------
    touching : int
        Frames in which the whisker truly touches.
    felt : int
        Frames in which a contact is felt.
    false : int
        Frames in which one is felt that is not there.
    candidates : array (3,)
        Felt contacts with no, one, or several candidates.
    errors : tuple of ErrorRow
        Of r, θ, φ and in space, all contacts.
    by_angle : tuple of ErrorRow
        In space, by deflection angle.
    offset : array (3,)
        From the peg's true axis to the fitted one, m, at the height of the contacts.
    tilt : float
        Angle between the axes, rad.
    diameter_error : float
        Of the fitted peg, m.
    surface : array (3,)
        Median, 95 % and largest distance of the contacts from the true surface, m.
    """

    touching: int
    felt: int
    false: int
    candidates: NDArray[np.int64]
    errors: tuple[ErrorRow, ...]
    by_angle: tuple[ErrorRow, ...]
    offset: Array
    tilt: float
    diameter_error: float
    surface: Array

    @property
    def share_with_one(self) -> float:
        """Share of felt contacts with exactly one candidate."""
        return float(self.candidates[1] / max(self.felt, 1))


def contact_errors(
    contacts: xr.Dataset, truth: xr.Dataset, whisker: Whisker, seed: int = 0
) -> xr.Dataset:
    """Compare contacts with the truth, frame by frame.

    Parameters
    ----------
    contacts : xarray.Dataset
        Of `vibrissa.pipeline.estimates_of`, of one whisker, dim time.
    truth : xarray.Dataset
        Of the recording, dim time: ``contact_point``, ``contact_point_whisker``.
    whisker : Whisker
        The whisker as it truly is, not as it was tracked.
    seed : int
        Seed of the draws.

    Returns
    -------
    xarray.Dataset
        Dims time, replicate: the size of each error, ``…_predicted`` and ``deflection_angle``. r,
        θ and φ are in the whisker's frame, and the error in space is in the laboratory, so that it
        includes what places the whisker there.
    """
    point, true = (d["contact_point_whisker"].values for d in (contacts, truth))
    draw = np.random.default_rng(seed).normal(size=(REPLICATES, len(point), 3))
    deviation = np.einsum("tij,rtj->rti", _roots(contacts["covariance"].values), draw)
    placed = np.einsum("tij,rtj->rti", _roots(contacts["contact_covariance"].values), draw)
    away = contacts["contact_point"].values - truth["contact_point"].values
    errors = _with_size(_errors(point, true), away)
    drawn = _with_size(_errors(point + deviation, point), placed)
    data = {name: ("time", errors[..., i]) for i, name in enumerate(ERRORS)}
    predicted = {
        f"{name}_predicted": (("replicate", "time"), drawn[..., i]) for i, name in enumerate(ERRORS)
    }
    angles = {"deflection_angle": ("time", deflection_angle(truth, whisker))}
    return xr.Dataset({**data, **predicted, **angles}, {"time": contacts["time"]})


def deflection_angle(truth: xr.Dataset, whisker: Whisker) -> Array:
    """Angle by which the true contact has moved from the whisker at rest, seen from the base.

    Parameters
    ----------
    truth : xarray.Dataset
        Truth of one whisker, dim time: ``contact_point_whisker``.
    whisker : Whisker
        The whisker as it truly is: the shape that was tracked has other angles.

    Returns
    -------
    array (time,)
        Angles, rad; NaN without contact.
    """
    distance, arc_length = nearest_on_rest(whisker, truth["contact_point_whisker"].values)
    return np.asarray(np.arctan2(distance, arc_length))


def _errors(estimated: Array, true: Array) -> Array:
    """Sizes (..., 3) of the errors in r, θ, φ."""
    away = within_turn(spherical(estimated) - spherical(true), [False, True, False])
    return np.asarray(np.abs(away))


def _with_size(errors: Array, away: Array) -> Array:
    """Add the size of errors in space as a fourth column."""
    return np.concatenate([errors, np.linalg.norm(away, axis=-1, keepdims=True)], axis=-1)


def _roots(covariance: Array) -> Array:
    """Matrices A (n, 3, 3) with A Aᵀ = covariance, of any rank; NaN where it is."""
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    size, direction = np.linalg.eigh(np.where(known[:, None, None], covariance, 0.0))
    root = direction * np.sqrt(np.maximum(size, 0.0))[:, None, :]
    return np.where(known[:, None, None], root, np.nan)


def score(contacts: xr.Dataset, truth: xr.Dataset, errors: xr.Dataset, fit: CylinderFit) -> Scores:
    """Put all errors into numbers.

    Parameters
    ----------
    contacts : xarray.Dataset
        Of `vibrissa.pipeline.estimates_of`, of one whisker, dim time.
    truth : xarray.Dataset
        Dim time: ``in_contact``; and the peg's ``peg_position``, ``peg_axis``, ``peg_radius``.
    errors : xarray.Dataset
        Of `contact_errors`.
    fit : CylinderFit
        The fitted peg.

    Returns
    -------
    Scores
        The numbers.
    """
    felt = contacts["in_contact"].values
    touching = truth["in_contact"].values
    number = contacts["candidates"].values[felt]
    known = np.isfinite(errors["error_distance"].values)
    of_all, by_angle = error_rows(errors)
    origin, axis = truth["peg_position"].values, truth["peg_axis"].values
    radius = float(truth["peg_radius"])
    offset, tilt = axis_offset(fit.origin, fit.axis, origin, axis)
    points, whisker_radius = contacts["contact_point"].values, truth["radius"].values
    gap = Peg(origin, axis, radius).signed_distance(points[known]) - whisker_radius[known]
    return Scores(
        touching=int(touching.sum()),
        felt=int(felt.sum()),
        false=int((felt & ~touching).sum()),
        candidates=np.array([(number == 0).sum(), (number == 1).sum(), (number > 1).sum()]),
        errors=of_all,
        by_angle=by_angle,
        offset=offset,
        tilt=tilt,
        diameter_error=float(fit.diameter - 2.0 * radius),
        surface=_quantiles(np.abs(gap)),
    )


def error_rows(errors: xr.Dataset) -> tuple[tuple[ErrorRow, ...], tuple[ErrorRow, ...]]:
    """Sum up errors of contacts.

    Parameters
    ----------
    errors : xarray.Dataset
        Of `contact_errors`.

    Returns
    -------
    of_all : tuple of ErrorRow
        Of r, θ, φ and in space, all contacts that have an estimate.
    by_angle : tuple of ErrorRow
        In space, for each class of deflection angle that there is.
    """
    known = np.isfinite(errors["error_distance"].values)
    angle = np.degrees(errors["deflection_angle"].values)
    by_angle = []
    for low, high in itertools.pairwise(ANGLES):
        rows = known & (angle >= low) & (angle < high)
        if rows.any():
            by_angle.append(_row(errors, "error_distance", angle_label(low, high), rows))
    return tuple(_row(errors, name, "all", known) for name in ERRORS), tuple(by_angle)


def angle_label(low: float, high: float) -> str:
    """Name a class of deflection angle.

    Parameters
    ----------
    low, high : float
        Its bounds, degrees.

    Returns
    -------
    str
        Such as ``2–5°``.
    """
    return f"{low:g}–{high:g}°" if high < ANGLES[-1] else f"over {low:g}°"


def _row(errors: xr.Dataset, name: str, label: str, rows: NDArray[np.bool_]) -> ErrorRow:
    drawn = errors[f"{name}_predicted"].values[:, rows]
    drawn = drawn[:, np.isfinite(drawn).all(axis=0)]
    predicted = np.median([_quantiles(replicate) for replicate in drawn], axis=0)
    measured = _quantiles(errors[name].values[rows])
    return ErrorRow(name, label, int(rows.sum()), measured, predicted)


def _quantiles(values: Array) -> Array:
    """Median, 95 % and largest of values (n,)."""
    if values.size == 0:
        return np.full(len(_QUANTILES), np.nan)
    return np.asarray(np.quantile(values, _QUANTILES))
