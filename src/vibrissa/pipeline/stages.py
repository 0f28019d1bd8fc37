"""The stages of a recording: its groups signals, estimates and contour, added one after another.

Adding a group first computes missing earlier ones and removes the later ones, which depend on it.
The functions return a new recording and leave the one passed unchanged.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Collection
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.contacts import friction_assumed
from vibrissa.contour import FittedShape, shape_from_dataset
from vibrissa.io import events_in
from vibrissa.numerics import contacts_in
from vibrissa.pipeline.checks import (
    MADE_FROM,
    check_recording,
    edited,
    estimates_in,
    made_from,
    signals_in,
)
from vibrissa.pipeline.estimates import Progress, estimates_of, largest_of
from vibrissa.pipeline.reconstruction import AGREES, reconstruct
from vibrissa.pipeline.signals import signals_of
from vibrissa.recording import Recording
from vibrissa.status import Status

STAGES = ("signals", "estimates", "contour")  # groups in the order in which they are computed


def due_stages(recording: xr.DataTree, last: str, asked: Collection[str] = ()) -> tuple[str, ...]:
    """Stages that have to be computed, in order, to bring the stage ``last`` up to date.

    ``last`` itself is always due. An earlier stage is due if it is missing or named in ``asked``,
    if its inputs were edited since it was computed, or if a stage before it is due.
    """
    for name in (last, *asked):
        if name not in STAGES:
            raise ValueError(f"the stage is called {name!r}; one of {', '.join(STAGES)} is needed")
    first, asked = STAGES.index(last), {*asked, *edited(recording)}
    for number in reversed(range(first)):
        if STAGES[number] in recording.children and not asked & set(STAGES[: number + 1]):
            break
        first = number
    return STAGES[first : STAGES.index(last) + 1]


def without_faulty_stages(recording: xr.DataTree) -> xr.DataTree:
    """Remove groups of stages that lack variables or hold other than numbers; warn of each."""
    for name, read in (("signals", signals_in), ("estimates", estimates_in)):
        if name in recording.children:
            try:
                read(recording)
            except ValueError as fault:
                warnings.warn(f"{fault}; until then it is ignored", stacklevel=2)
                recording = recording.drop_nodes(name)
    return recording


def with_group(recording: xr.DataTree, name: str, dataset: xr.Dataset) -> xr.DataTree:
    """Add the group of a stage to a recording, and remove the groups of later stages."""
    if name not in STAGES:
        raise ValueError(f"the group is called {name!r}; one of {', '.join(STAGES)} is needed")
    check_recording(recording)
    root = recording.to_dataset()
    shapes = [tuple(data.sizes.get(d) for d in ("time", "whisker")) for data in (dataset, root)]
    if shapes[0] != shapes[1] or not np.allclose(dataset["time"], root["time"], rtol=0, atol=1e-6):
        raise ValueError(
            f"the {name} have frames and whiskers {shapes[0]} and the recording {shapes[1]}, or "
            "their times differ"
        )
    own = dataset.drop_vars([n for n in dataset.coords if n in root.coords])
    own[MADE_FROM] = made_from(recording, name)
    later = STAGES[STAGES.index(name) :]
    groups = {
        group.path: group.to_dataset(inherit=False)
        for group in recording.subtree
        if group.path.split("/")[1] not in later
    }
    return xr.DataTree.from_dict({**groups, f"/{name}": own})


def with_signals(recording: xr.DataTree, *args: Any, **options: Any) -> xr.DataTree:
    """Add the group ``signals``.

    Parameters
    ----------
    recording : xarray.DataTree
        Tracked, simulated or measured recording.
    *args, **options
        Arguments of `signals_of`.

    Returns
    -------
    xarray.DataTree
        Recording with the group.
    """
    return with_group(recording, "signals", signals_of(recording, *args, **options))


def with_estimates(
    recording: xr.DataTree, *args: Any, progress: Progress | None = None, **options: Any
) -> xr.DataTree:
    """Add the group ``estimates``, and ``signals`` if missing.

    Parameters
    ----------
    recording : xarray.DataTree
        Tracked, simulated or measured recording.
    *args
        Arguments of `estimates_of`.
    progress : callable, optional
        Function called as ``progress(stage, done, total)``.
    **options
        Arguments of `estimates_of`.

    Returns
    -------
    xarray.DataTree
        Recording with the group.
    """
    if "signals" in due_stages(recording, "estimates"):
        recording = with_signals(recording, whiskers=options.get("whiskers"))
    estimates = estimates_of(recording, *args, progress=progress, **options)
    return with_group(recording, "estimates", estimates)


def with_contour(
    recording: xr.DataTree, *args: Any, progress: Progress | None = None, **options: Any
) -> xr.DataTree:
    """Add the group ``contour``, and ``signals`` and ``estimates`` if missing.

    Parameters
    ----------
    recording : xarray.DataTree
        Tracked, simulated or measured recording.
    *args
        Arguments of `reconstruct`.
    progress : callable, optional
        Function called as ``progress(stage, done, total)``.
    **options
        Arguments of `reconstruct`.

    Returns
    -------
    xarray.DataTree
        Recording with the group.

    Warns
    -----
    UserWarning
        If the contacts do not fit the shape.
    """
    if "estimates" in due_stages(recording, "contour"):
        recording = with_estimates(recording, whiskers=options.get("whiskers"), progress=progress)
    contour = reconstruct(recording, *args, **options)
    if (misfit := float(contour.attrs["misfit"])) > AGREES:
        warnings.warn(
            f"the contacts do not fit the shape {contour.attrs['shape']!r} (χ² per degree of "
            f"freedom {misfit:.3g}): the object has another one, or errors are larger than stated",
            UserWarning,
            stacklevel=2,
        )
    return with_group(recording, "contour", contour)


_BEFORE = ("signals", "", "truth")  # groups searched for contacts, in this order


class TrialSummary:
    """Summary of a recording in words and numbers, SI units.

    ``in_contact`` and ``contacts`` are the number of frames in contact and the number of
    uninterrupted contacts of all whiskers, None if unknown. ``extent`` is the largest range of
    motion of a base. ``estimated`` counts the estimates of all frames and whiskers, ``assumption``
    describes the friction they assume, and ``events`` counts onsets, losses and slips. ``fitted``
    describes the fitted ``shape``, ``known`` the known objects, and ``distance`` is the median
    distance of contacts from the fitted shape.
    """

    def __init__(self, recording: xr.DataTree) -> None:
        record = Recording(recording)
        self.origin = str(recording.attrs.get("origin", "its origin is not stated"))
        self.whiskers = record.names
        self.stages = tuple(stage for stage in STAGES if stage in recording.children)
        self.known = "; ".join(known.in_words() for known in record.objects)
        time = record.root.data["time"]
        self.frames, timed = time.size, time.size > 1 and not time.attrs.get("numbered")
        self.duration = self.frames * float(np.median(np.diff(time.values))) if timed else 0.0
        touching = record.known("in_contact", _BEFORE)
        self.in_contact = None if touching is None else int(touching.any(axis=1).sum())
        self.contacts = None
        if touching is not None:
            status = record.known("status", _BEFORE)
            seen = np.ones_like(touching) if status is None else status != Status.MISSING
            each = zip(touching.T, seen.T, strict=True)
            self.contacts = sum(len(contacts_in(*one)) for one in each)
        self.largest_force, self.largest_moment = (
            _largest(record.known(name, _BEFORE), touching) for name in ("force", "moment")
        )
        self.extent = np.nan
        if (place := record.known("base_position", _BEFORE)) is not None:
            span = np.nanmax(place, axis=0) - np.nanmin(place, axis=0)
            self.extent = float(np.linalg.norm(span, axis=-1).max())
        self.estimated, self.assumption, self.events = 0, "", Counter[str]()
        if (estimates := record.find("estimates")) and "in_contact" in estimates:
            self.estimated = int(estimates["in_contact"].sum())
            if "friction" in (about := estimates.data.attrs):
                self.assumption = friction_assumed(float(about["friction"]))
            self.events = Counter(event for _, _, event, _ in events_in(estimates.data))
        self.fitted, self.distance = "", np.nan
        self.shape: FittedShape | None = None
        if "contour" in recording.children:
            contour = recording["contour"].to_dataset()
            self.shape = shape_from_dataset(contour)
            self.fitted = repr(self.shape).strip("<>")
            if self.shape.misfit > AGREES:
                self.fitted += (
                    "; the contacts do not fit it (χ² per degree of freedom "
                    f"{self.shape.misfit:.3g})"
                )
            if "surface_distance" in contour:
                away = np.abs(contour["surface_distance"].values)
                if "inlier" in contour:  # as in `FittedShape.median`
                    away = away[contour["inlier"].values > 0]
                self.distance = float(np.nanmedian(away)) if np.isfinite(away).any() else np.nan


def _largest(values: np.ndarray | None, touching: np.ndarray | None) -> float:
    """Largest length of vectors (time, whisker, 3) in contact; NaN if unknown."""
    if values is None or touching is None:
        return np.nan
    return largest_of(np.linalg.norm(values, axis=-1)[touching])
