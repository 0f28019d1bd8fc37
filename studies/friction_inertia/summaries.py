"""Errors of many frames in a few numbers, SI units; angles of classes in degrees."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.evaluation import ANGLES
from vibrissa.status import Status

TARGET = 1.3
"""An error is as expected if it is below so many times the predicted one plus the pose's."""

RUBBED = np.radians(0.5)
"""Friction angle from which friction has a direction."""

SOME = 0.1
"""Share of contacts with friction from which its direction is asked for."""

FLAGS = (Status.NOT_FRICTIONLESS, Status.NOT_ONE_CONTACT, Status.BEYOND_TIP, Status.TOO_PROXIMAL)
LABELS = tuple(
    f"{low:g}–{high:g}°" if high < 90.0 else f"over {low:g}°"
    for low, high in itertools.pairwise(ANGLES)
)


def summary(trials: Sequence[xr.Dataset], classes: bool = True) -> dict[str, Any]:
    """Scores of one method in one condition; ``trials`` as of `friction_inertia.methods.scored`."""
    rows = xr.concat([t.assign_attrs({}) for t in trials], "frame", combine_attrs="drop")
    detected, touching = rows["detected"].values, rows["touching"].values
    both = detected & touching
    here = rows.isel(frame=both)
    out: dict[str, Any] = {
        "touching": int(touching.sum()),
        "detected": int(both.sum()),
        "false": int((detected & ~touching).sum()),
        "none": share(~np.isfinite(here["distance"].values)),
        "several": share(here["candidates"].values > 1),
        "flagged": share(np.isin(here["status"].values, FLAGS)),
        "bias": np.nanmedian(here["error"].values, axis=0).tolist(),
        "pulled": pulled(here),
        "all": errors(here),
        "unflagged": errors(here.isel(frame=~np.isin(here["status"].values, FLAGS))),
        "peg": {name: middle([t.attrs[name] for t in trials]) for name in trials[0].attrs},
    }
    angle = here["deflection"].values
    pairs = zip(LABELS, itertools.pairwise(ANGLES), strict=True)
    if classes:
        out["classes"] = {
            label: errors(here.isel(frame=(angle >= low) & (angle < high)))
            for label, (low, high) in pairs
        }
    if "friction_found" in here:
        out["friction"] = friction(here)
    return out


def errors(rows: xr.Dataset) -> dict[str, float]:
    """3D error: median and 95 %, what the covariance predicts of both, what the pose adds."""
    both = {
        "contacts": rows.sizes["frame"],
        "flagged": share(np.isin(rows["status"].values, FLAGS)),
    }
    known = np.isfinite(rows["distance"].values)
    distance, drawn = rows["distance"].values[known], rows["predicted"].values[known]
    drawn = drawn[np.isfinite(drawn).all(axis=1)]
    names = ("median", "high", "predicted", "predicted_high", "pose")
    if not len(distance) or not len(drawn):
        return {**both, **dict.fromkeys(names, np.nan), "count": 0}
    measured = np.quantile(distance, [0.5, 0.95])
    predicted = np.median(np.quantile(drawn, [0.5, 0.95], axis=0), axis=1)
    pose = np.median(rows["pose_error"].values[known])
    values = [float(v) for v in (*measured, *predicted, pose)]
    return {**both, **dict(zip(names, values, strict=True)), "count": len(distance)}


def pulled(rows: xr.Dataset) -> float:
    """Median error along the whisker in the direction in which friction pulls, m."""
    angle, along = rows["friction_angle"].values, rows["error"].values[:, 0]
    rubbed = (np.abs(angle) > RUBBED) & np.isfinite(along)
    enough = rubbed.mean() > SOME if rubbed.size else False
    return float(np.median((np.sign(angle) * along)[rubbed])) if enough else float("nan")


def limit(row: dict[str, float]) -> float:
    """Below which the median error is as expected, m."""
    return TARGET * row["predicted"] + row["pose"]


def friction(rows: xr.Dataset) -> dict[str, float]:
    """The wrench's friction angle against the true one, rad."""
    true, found, sigma = (
        rows[name].values for name in ("friction_angle", "friction_found", "friction_sigma")
    )
    known = np.isfinite(true) & np.isfinite(found) & np.isfinite(sigma)
    true, found, sigma = true[known], found[known], sigma[known]
    away = found - true
    return {
        "true": float(np.median(np.abs(true))),
        "found": float(np.median(np.abs(found))),
        "bias": float(np.median(away)),
        "error": float(np.median(np.abs(away))),
        # The median of a normal deviate's size is 0.674 standard deviations.
        "predicted": float(0.6745 * np.median(sigma)),
        "within": share(np.abs(away) < 2.0 * sigma),
    }


def middle(values: Sequence[float]) -> float:
    """Median of what is known."""
    known = [v for v in values if np.isfinite(v)]
    return float(np.median(known)) if known else float("nan")


def share(which: np.ndarray) -> float:
    return float(np.mean(which)) if which.size else float("nan")
