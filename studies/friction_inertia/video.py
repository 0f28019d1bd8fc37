"""What video alone gives: the paper's own test, and the filter of the base's pose."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

import vibrissa as vb
from friction_inertia.conditions import RATE, Recorded
from friction_inertia.methods import (
    TRIPLET,
    Pose,
    Truth,
    chart,
    located,
    poses_of,
    scored,
    sensed,
    truth_of,
)
from vibrissa.recording import Recording
from vibrissa.tracking import BasePose
from vibrissa.whisker import Whisker

CUTOFFS = (30.0, 50.0, 85.0, 120.0, 200.0, None)


def paper_test(trials: Sequence[Recorded]) -> dict[str, Any]:
    """Tracked contacts → signals of the frictionless model → contacts by its inverse.

    ``agreement`` is between the contact put in and the one that comes out, ``error`` that of the
    latter against the truth, in the laboratory; m. ``force`` and ``moment`` are the relative errors
    of the signals.
    """
    columns: dict[str, list[np.ndarray]] = {
        name: [] for name in ("agreement", "error", "force", "moment", "answered")
    }
    for trial in trials:
        truth, whisker = truth_of(trial.true), Recording(trial.tracked).whisker()
        rotation, position = poses_of(trial.tracked)["85 Hz"]
        root = trial.tracked.to_dataset().isel(whisker=0)
        point = in_whisker(root["contact_point"].values, (rotation, position))
        rows = np.flatnonzero(truth.touching & np.isfinite(point).all(axis=1))
        bent = vb.deflect(whisker, vb.PointContact(point[rows]))
        signals = vb.base_signals(bent.force, bent.moment)
        found = chart(whisker).estimate(signals, tuple(TRIPLET.split()))
        placed = np.einsum("tij,tj->ti", rotation[rows], found.point) + position[rows]
        columns["answered"].append(np.isfinite(found.point).all(axis=1))
        columns["agreement"].append(size(found.point - point[rows]))
        columns["error"].append(size(placed - truth.point[rows]))
        columns["force"].append(relative(bent.force, truth.force[rows]))
        columns["moment"].append(relative(bent.moment, truth.moment[rows]))
    values = {name: np.concatenate(parts) for name, parts in columns.items()}
    answered = values.pop("answered")
    out = {name: middle(value) for name, value in values.items()}
    return {**out, "count": int(answered.size), "none": float(1.0 - answered.mean())}


def cutoffs(trials: Sequence[Recorded]) -> dict[str, Any]:
    """Errors in contact by the cut-off of the pose; medians and 95 %."""
    contacts = [
        located(TRIPLET, sensed(trial.true), chart(Recording(trial.true).whisker()))
        for trial in trials
    ]
    out = {}
    for cutoff in CUTOFFS:
        columns: dict[str, list[np.ndarray]] = {}
        for trial, found in zip(trials, contacts, strict=True):
            for name, values in filtered_errors(trial, found, cutoff).items():
                columns.setdefault(name, []).append(values)
        name = "none" if cutoff is None else f"{cutoff:g}"
        out[name] = {key: middle(np.concatenate(parts)) for key, parts in columns.items()}
    return out


def filtered_errors(
    trial: Recorded, found: xr.Dataset, cutoff: float | None
) -> dict[str, np.ndarray]:
    """Errors of the pose, of the paper's signals, of contacts from the sensor, frame by frame."""
    truth, whisker = truth_of(trial.true), Recording(trial.tracked).whisker()
    measured = trial.tracked["measured"].to_dataset().isel(whisker=0)
    names = ("position", "azimuth", "elevation", "roll")
    unfiltered = BasePose(*(measured[f"unfiltered_base_{name}"].values for name in names))
    pose = unfiltered.filtered(RATE, cutoff)
    return pose_errors(trial, truth, whisker, found, (pose.rotation, pose.position))


def pose_errors(
    trial: Recorded, truth: Truth, whisker: Whisker, found: xr.Dataset, pose: Pose
) -> dict[str, np.ndarray]:
    rotation, position = pose
    root = trial.tracked.to_dataset().isel(whisker=0)
    point = in_whisker(root["contact_point"].values, pose)
    rows = np.flatnonzero(truth.touching & np.isfinite(point).all(axis=1))
    bent = vb.deflect(whisker, vb.PointContact(point[rows]))
    sensed = scored(found, truth, pose, trial.true, fits=False)
    direction = (rotation[rows, :, 0] * truth.pose[0][rows, :, 0]).sum(axis=1)
    turned = np.swapaxes(truth.pose[0][rows], 1, 2) @ rotation[rows]
    return {
        "place": size(position[rows] - truth.pose[1][rows]),
        "direction": np.arccos(np.clip(direction, -1.0, 1.0)),
        "roll": np.abs(np.arctan2(turned[:, 2, 1], turned[:, 1, 1])),
        "contact": size(point[rows] - truth.point_whisker[rows]),
        "force": relative(bent.force, truth.force[rows]),
        "moment": relative(bent.moment, truth.moment[rows]),
        "moved": sensed["pose_error"].values[rows],
        "sensed": sensed["distance"].values[rows],
    }


def in_whisker(points: np.ndarray, pose: Pose) -> np.ndarray:
    return np.einsum("tji,tj->ti", pose[0], points - pose[1])


def size(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1)


def relative(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return size(found - true) / size(true)


def middle(values: np.ndarray) -> list[float]:
    """Median and 95 % of what is known."""
    known = values[np.isfinite(values)]
    return np.quantile(known, [0.5, 0.95]).tolist() if known.size else [np.nan, np.nan]


def tracked_scores(trial: Recorded, method: str) -> dict[str, xr.Dataset]:
    """Scores of one method with the tracked poses, with the true and the tracked whisker's map."""
    truth, poses = truth_of(trial.true), poses_of(trial.tracked)
    true, seen = (chart(Recording(tree).whisker()) for tree in (trial.true, trial.tracked))
    wrench = sensed(trial.true)
    found = located(method, wrench, true)
    # Pegs are shown of the triplet only.
    fits = method == TRIPLET
    out = {name: scored(found, truth, pose, trial.true, fits) for name, pose in poses.items()}
    found = located(method, wrench, seen)
    return out | {"whisker": scored(found, truth, poses["rod"], trial.true, fits=False)}
