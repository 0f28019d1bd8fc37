"""What a recording holds, in a few numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from vibrissa.contour import shape_from_dataset
from vibrissa.pipeline.stages import STAGES
from vibrissa.recording import Recording

_BEFORE = ("signals", "", "truth")
"""Groups in which contacts are looked for, the best known first."""


@dataclass(frozen=True)
class TrialSummary:
    """What a recording holds.

    Parameters
    ----------
    origin : str
        Sentence that states where the recording comes from.
    whiskers : list of str
        Names of the whiskers.
    frames : int
        Number of frames.
    duration : float
        Number of frames times the time between two, s.
    in_contact : int, optional
        Number of frames in which a whisker is in contact; None where that is not known.
    contacts : int, optional
        Number of uninterrupted contacts of all whiskers.
    largest_force, largest_moment : float
        Largest force, N, and moment, N·m, in contact; NaN where there is none.
    estimated : int
        Number of frames and whiskers with an estimated contact point.
    stages : tuple of str
        Stages that are there, of ``signals``, ``estimates`` and ``contour``.
    fitted : str
        Fitted object in words; empty where there is none.
    known : str
        Objects that are known, in words; empty where there are none.
    distance : float
        Median distance of contact points from the fitted object, m.
    """

    origin: str
    whiskers: list[str]
    frames: int
    duration: float
    in_contact: int | None
    contacts: int | None
    largest_force: float
    largest_moment: float
    estimated: int
    stages: tuple[str, ...]
    fitted: str
    known: str
    distance: float


def summarise(recording: xr.DataTree) -> TrialSummary:
    """Summarise a recording."""
    record = Recording(recording)
    time = record.root.data["time"].values
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    touching = record.known("in_contact", _BEFORE)
    contacts = None
    if touching is not None:
        begins = np.diff(touching.astype(int), axis=0, prepend=0) == 1
        contacts = int(begins.sum())
    largest = {
        name: _largest(record.known(name, _BEFORE), touching) for name in ("force", "moment")
    }
    estimated = 0
    if (estimates := record.find("estimates")) and "in_contact" in estimates:
        estimated = int(estimates["in_contact"].sum())
    fitted, distance = "", np.nan
    if "contour" in recording.children:
        contour = recording["contour"].to_dataset()
        fitted = repr(shape_from_dataset(contour)).strip("<>")
        if "surface_distance" in contour:
            away = np.abs(contour["surface_distance"].values)
            distance = float(np.nanmedian(away)) if np.isfinite(away).any() else np.nan
    return TrialSummary(
        origin=str(recording.attrs.get("origin", "its origin is not stated")),
        whiskers=record.names,
        frames=len(time),
        duration=step * len(time),
        in_contact=None if touching is None else int(touching.any(axis=1).sum()),
        contacts=contacts,
        largest_force=largest["force"],
        largest_moment=largest["moment"],
        estimated=estimated,
        stages=tuple(stage for stage in STAGES if stage in recording.children),
        fitted=fitted,
        known="; ".join(repr(known) for known in record.objects),
        distance=distance,
    )


def _largest(values: np.ndarray | None, touching: np.ndarray | None) -> float:
    """Largest length of vectors (time, whisker, 3) where there is contact."""
    if values is None or touching is None:
        return np.nan
    sizes = np.linalg.norm(values, axis=-1)[touching]
    return float(np.nanmax(sizes)) if np.isfinite(sizes).any() else np.nan
