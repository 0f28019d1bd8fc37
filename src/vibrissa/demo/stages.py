"""How far tracks and signals are from the truth: the stages before the estimates."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from vibrissa.demo.scores import ANGLES, angle_label

Array = NDArray[np.float64]

_SPREAD = (50.0, 95.0)


@dataclass(frozen=True, eq=False)
class TrackingScores:
    """How well a whisker was tracked: medians and 95 %, SI units but for pixels.

    Parameters
    ----------
    frames, lost : int
        Of the videos, and those in which the whisker was not found.
    trace : array (view, 2)
        Distance of traced points from the whisker in the image, pixels.
    centerline : array (2,)
        Of points in space from the whisker's centreline, m.
    base : array (2,)
        Of the whisker's base, m.
    contact : array (2,)
        Of the contact point, m, in frames that truly are in contact and were found to be.
    told : float
        Share of the frames in which contact is told from none.
    """

    frames: int
    lost: int
    trace: Array
    centerline: Array
    base: Array
    contact: Array
    told: float


@dataclass(frozen=True, eq=False)
class SignalRow:
    """Errors of force and moment in a class of deflection angle.

    Parameters
    ----------
    label : str
        Which contacts.
    contacts : int
        How many.
    force, moment : array (2,)
        Median and 95 % of the size of the error over that of the vector, laboratory frame.
    """

    label: str
    contacts: int
    force: Array
    moment: Array


def tracking_scores(tracked: xr.Dataset, simulated: xr.DataTree) -> TrackingScores:
    """Compare what was tracked with the truth.

    Parameters
    ----------
    tracked : xarray.Dataset
        Of a tracked recording, one whisker.
    simulated : xarray.DataTree
        The same trial, filmed, in the same frames.

    Returns
    -------
    TrackingScores
        The numbers.
    """
    truth = simulated["truth"].to_dataset().isel(whisker=0)
    true_base = simulated.to_dataset()["base_position"].isel(whisker=0).values
    traced = tracked["trace"].transpose("view", "time", "node", "image_axis").values
    seen = tracked["trace_visible"].transpose("view", "time", "node").values.astype(bool)
    drawn = [refined(one) for one in truth["trace"].transpose("view", "time", ...).values]
    inside = [
        distances[visible]
        for distances, visible in zip(map(from_curves, traced, drawn), seen, strict=True)
    ]
    order = ("time", "node", "space")
    lines = [data["centerline"].transpose(*order).values for data in (tracked, truth)]
    away = np.linalg.norm(tracked["contact_point"].values - truth["contact_point"].values, axis=-1)
    touching = [data["in_contact"].values.astype(bool) for data in (tracked, truth)]
    return TrackingScores(
        frames=tracked.sizes["time"],
        lost=int((tracked["confidence"].values == 0.0).sum()),
        trace=np.array([spread(pixels) for pixels in inside]),
        centerline=spread(from_curves(lines[0], refined(lines[1]))),
        base=spread(np.linalg.norm(tracked["base_position"].values - true_base, axis=-1)),
        contact=spread(away[touching[0] & touching[1]]),
        told=float((touching[0] == touching[1]).mean()),
    )


def signal_errors(
    signals: xr.Dataset, simulated: xr.DataTree, angle: Array
) -> tuple[SignalRow, ...]:
    """Compare force and moment with the truth, by deflection angle.

    Parameters
    ----------
    signals : xarray.Dataset
        The group ``signals``, one whisker.
    simulated : xarray.DataTree
        The same trial in the same frames.
    angle : array (time,)
        Deflection angle, rad.

    Returns
    -------
    tuple of SignalRow
        One for each class that there is.
    """
    truth = simulated["truth"].to_dataset().isel(whisker=0)
    turned = simulated.to_dataset()["base_rotation"].isel(whisker=0).values
    errors = {}
    for name in ("force", "moment"):
        true = np.einsum("tij,tj->ti", turned, truth[name].values)
        found = np.einsum("tij,tj->ti", signals["base_rotation"].values, signals[name].values)
        with np.errstate(invalid="ignore", divide="ignore"):
            errors[name] = np.linalg.norm(found - true, axis=1) / np.linalg.norm(true, axis=1)
    known = truth["in_contact"].values.astype(bool) & signals["in_contact"].values.astype(bool)
    known &= np.isfinite(errors["force"]) & np.isfinite(errors["moment"])
    rows = []
    for low, high in itertools.pairwise(ANGLES):
        some = known & (angle >= np.radians(low)) & (angle < np.radians(high))
        if some.any():
            both = (spread(errors[name][some]) for name in ("force", "moment"))
            rows.append(SignalRow(angle_label(low, high), int(some.sum()), *both))
    return tuple(rows)


def refined(curves: Array, times: int = 8) -> Array:
    """Take more points of smooth curves, whose chords would cut their bends.

    Parameters
    ----------
    curves : array (time, m, d)
        Points at equal steps; a curve with NaN stays the polygon that it is.
    times : int
        How many steps for one.

    Returns
    -------
    array (time, (m - 1) times + 1, d)
        Cubics through the points.
    """
    steps = np.arange(curves.shape[1])
    at = np.linspace(0.0, steps[-1], times * int(steps[-1]) + 1)
    before = np.minimum(at.astype(int), steps[-1] - 1)
    share = (at - before)[:, None]
    fine = (1.0 - share) * curves[:, before] + share * curves[:, before + 1]
    known = np.isfinite(curves).all(axis=(1, 2))
    if known.any():
        fine[known] = make_interp_spline(steps, curves[known], axis=1)(at)
    return np.asarray(fine)


def from_curves(points: Array, curves: Array) -> Array:
    """Distances of points from curves, frame by frame.

    Parameters
    ----------
    points : array (time, n, d)
        NaN stays NaN.
    curves : array (time, m, d)
        Corners of polygonal curves.

    Returns
    -------
    array (time, n)
        Of each point from the curve of its frame, in the unit of the points.
    """
    out = np.full(points.shape[:2], np.nan)
    for i, (some, curve) in enumerate(zip(points, curves, strict=True)):
        start, step = curve[:-1], np.diff(curve, axis=0)
        away = some[:, None] - start
        squared = np.einsum("md,md->m", step, step)
        share = np.clip(np.einsum("nmd,md->nm", away, step) / squared, 0.0, 1.0)
        foot = away - share[..., None] * step
        distance = np.linalg.norm(foot, axis=-1)
        known = np.isfinite(distance).any(axis=1)
        out[i, known] = np.nanmin(distance[known], axis=1)
    return out


def spread(values: Array) -> Array:
    """Median and 95 % of what is known.

    Parameters
    ----------
    values : array
        Any shape; NaN is left out.

    Returns
    -------
    array (2,)
        NaN if nothing is known.
    """
    known = values[np.isfinite(values)]
    return np.percentile(known, _SPREAD) if known.size else np.full(2, np.nan)
