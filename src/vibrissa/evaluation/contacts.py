"""Errors of estimated contacts compared with the truth and with those predicted by the noise.

Predictions are drawn, not linearised: the estimated covariance of every contact gives as many
errors as there are replicates, each replicate is scored like the trial itself, and the median over
replicates is the prediction.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.contour import CylinderFit, axis_offset
from vibrissa.numerics import Array
from vibrissa.objects import Peg
from vibrissa.pipeline import ANGLE_CLASSES
from vibrissa.signals import nearest_on_rest, spherical, within_turn
from vibrissa.whisker import Whisker

ERRORS = ("error_r", "error_theta", "error_phi", "error_distance")
"""Names of the errors of r, θ, φ, and of the distance in space."""

REPLICATES = 25
ANGLES = ANGLE_CLASSES
"""Edges of the classes of deflection angle, degrees."""

_QUANTILES = (0.5, 0.95, 1.0)


@dataclass(frozen=True, eq=False)
class ErrorRow:
    """Errors of some contacts in one quantity: median, 95 % and largest size, SI units.

    As measured, and as the covariance predicts; `contacts` is the number with an estimate.
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
        Number of frames in which the whisker truly touches.
    detected : int
        Number of frames in which a contact is detected.
    false : int
        Number of frames in which a contact is detected without a true one.
    candidates : array (3,)
        Numbers of detected contacts with no, one, or several candidates.
    errors : tuple of ErrorRow
        Errors of r, θ, φ and in space, all contacts.
    by_angle : tuple of ErrorRow
        Errors in space, by deflection angle.
    offset : array (3,)
        Vector from the peg's true axis to the fitted one, m, at the height of the contacts.
    tilt : float
        Angle between the axes, rad.
    diameter_error : float
        Error of the fitted peg's diameter, m.
    surface : array (3,)
        Median, 95 % and largest distance of the contacts from the true surface, m.
    """

    touching: int
    detected: int
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
        """Share of detected contacts with exactly one candidate."""
        return float(self.candidates[1] / max(self.detected, 1))


def contact_errors(
    contacts: xr.Dataset, truth: xr.Dataset, whisker: Whisker, seed: int = 0
) -> xr.Dataset:
    """Compare contacts with the truth, frame by frame.

    Parameters
    ----------
    contacts : xarray.Dataset
        Dataset of `vibrissa.pipeline.estimates_of`, of one whisker, dimension time.
    truth : xarray.Dataset
        Truth of the recording, dimension time: ``contact_point``, ``contact_point_whisker``.
    whisker : Whisker
        True whisker, not as it was tracked.
    seed : int
        Seed of the draws.

    Returns
    -------
    xarray.Dataset
        Dataset of dimensions time, replicate: the size of each error, ``…_predicted`` and
        ``deflection_angle``. r, θ and φ are in the whisker's frame, and the error in space is in
        the laboratory, so that it includes that of the pose.
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
        Truth of one whisker, dimension time: ``contact_point_whisker``.
    whisker : Whisker
        True whisker: the shape that was tracked has other angles.

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


def score(
    contacts: xr.Dataset,
    truth: xr.Dataset,
    errors: xr.Dataset,
    fit: CylinderFit,
    peg: Peg,
    radius: Array,
) -> Scores:
    """Scores of a trial with a peg, at whose contacts the whisker has these radii (time,), m."""
    detected = contacts["in_contact"].values
    touching = truth["in_contact"].values
    number = contacts["candidates"].values[detected]
    known = np.isfinite(errors["error_distance"].values)
    of_all, by_angle = error_rows(errors)
    offset, tilt = axis_offset(fit.origin, fit.axis, peg.origin, peg.axis)
    gap = peg.signed_distance(contacts["contact_point"].values[known]) - radius[known]
    return Scores(
        touching=int(touching.sum()),
        detected=int(detected.sum()),
        false=int((detected & ~touching).sum()),
        candidates=np.array([(number == 0).sum(), (number == 1).sum(), (number > 1).sum()]),
        errors=of_all,
        by_angle=by_angle,
        offset=offset,
        tilt=tilt,
        diameter_error=float(fit.diameter - 2.0 * peg.radius),
        surface=_quantiles(np.abs(gap)),
    )


def error_rows(errors: xr.Dataset) -> tuple[tuple[ErrorRow, ...], tuple[ErrorRow, ...]]:
    """Summarise errors of contacts."""
    known = np.isfinite(errors["error_distance"].values)
    angle = np.degrees(errors["deflection_angle"].values)
    by_angle = []
    for low, high in itertools.pairwise(ANGLES):
        rows = known & (angle >= low) & (angle < high)
        if rows.any():
            by_angle.append(_row(errors, "error_distance", angle_label(low, high), rows))
    return tuple(_row(errors, name, "all", known) for name in ERRORS), tuple(by_angle)


def angle_label(low: float, high: float) -> str:
    """Name a class of deflection angle."""
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
