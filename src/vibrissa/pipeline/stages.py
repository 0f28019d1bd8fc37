"""The stages of a recording: signals, estimates and contour, each one more group.

A stage makes the stages before it that are missing, and removes the later ones, which depend on it.
Nothing else changes, and the recording that was passed stays as it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.contacts import friction_assumed
from vibrissa.contour import FittedShape, shape_from_dataset
from vibrissa.io import events_in
from vibrissa.numerics import contacts_in
from vibrissa.pipeline.estimates import Progress, estimates_of
from vibrissa.pipeline.frames import check_recording
from vibrissa.pipeline.made_from import MADE_FROM, edited, made_from
from vibrissa.pipeline.reconstruct import reconstruct
from vibrissa.pipeline.signals import signals_of
from vibrissa.recording import Recording
from vibrissa.status import Status

STAGES = ("signals", "estimates", "contour")  # groups in the order in which they are made


def due_stages(recording: xr.DataTree, last: str, asked: Collection[str] = ()) -> tuple[str, ...]:
    """Stages that have to be made, in order, so that the last one is new.

    One before it is due if it is missing, if it is asked for, if what it was made of was edited
    since, or if one that it depends on is due.
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


def with_group(recording: xr.DataTree, name: str, dataset: xr.Dataset) -> xr.DataTree:
    """Add the group of a stage to a recording."""
    if name not in STAGES:
        raise ValueError(f"the group is called {name!r}; one of {', '.join(STAGES)} is needed")
    check_recording(recording)
    root = recording.to_dataset()
    shapes = [tuple(data.sizes.get(d) for d in ("time", "whisker")) for data in (dataset, root)]
    if shapes[0] != shapes[1] or not np.allclose(dataset["time"], root["time"], rtol=0, atol=1e-6):
        raise ValueError(
            f"the {name} have frames and whiskers {shapes[0]}, the recording {shapes[1]}, or they "
            "are of other times"
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
        Recording, tracked, simulated or measured.
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
    """Add the group ``estimates``, and ``signals`` where there are none.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording, tracked, simulated or measured.
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
    """Add the group ``contour``, and ``signals`` and ``estimates`` where there are none.

    Parameters
    ----------
    recording : xarray.DataTree
        Recording, tracked, simulated or measured.
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
    """
    if "estimates" in due_stages(recording, "contour"):
        recording = with_estimates(recording, whiskers=options.get("whiskers"), progress=progress)
    return with_group(recording, "contour", reconstruct(recording, *args, **options))


_BEFORE = ("signals", "", "truth")  # groups in which contacts are looked for, the best known first


@dataclass(frozen=True)
class TrialSummary:
    """Summary of a recording: what it is in words, numbers of frames and contacts, SI units.

    ``in_contact`` and ``contacts``, frames in contact and uninterrupted contacts of all whiskers,
    are None where that is not known; bases move within ``extent``; ``estimated`` counts frames and
    whiskers with an estimate, ``assumption`` is what these assume of friction, and ``events``
    counts onsets, losses and slips. ``fitted`` is the fitted ``shape`` in words.
    """

    origin: str
    whiskers: list[str]
    frames: int
    duration: float
    extent: float
    in_contact: int | None
    contacts: int | None
    largest_force: float
    largest_moment: float
    estimated: int
    assumption: str
    events: Counter[str]
    stages: tuple[str, ...]
    fitted: str
    shape: FittedShape | None
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
        status = record.known("status", _BEFORE)
        seen = np.ones_like(touching) if status is None else status != Status.MISSING
        contacts = sum(len(contacts_in(*one)) for one in zip(touching.T, seen.T, strict=True))
    largest = {
        name: _largest(record.known(name, _BEFORE), touching) for name in ("force", "moment")
    }
    extent = np.nan
    if (place := record.known("base_position", _BEFORE)) is not None:
        extent = float(
            np.linalg.norm(np.nanmax(place, axis=0) - np.nanmin(place, axis=0), axis=-1).max()
        )
    estimated, assumption, events = 0, "", Counter[str]()
    if (estimates := record.find("estimates")) and "in_contact" in estimates:
        estimated = int(estimates["in_contact"].sum())
        if "friction" in (about := estimates.data.attrs):
            assumption = friction_assumed(float(about["friction"]))
        events = Counter(event for _, _, event, _ in events_in(estimates.data))
    fitted, shape, distance = "", None, np.nan
    if "contour" in recording.children:
        contour = recording["contour"].to_dataset()
        shape = shape_from_dataset(contour)
        fitted = repr(shape).strip("<>")
        if "surface_distance" in contour:
            away = np.abs(contour["surface_distance"].values)
            if "inlier" in contour:  # as `FittedShape.median`
                away = away[contour["inlier"].values > 0]
            distance = float(np.nanmedian(away)) if np.isfinite(away).any() else np.nan
    return TrialSummary(
        origin=str(recording.attrs.get("origin", "its origin is not stated")),
        whiskers=record.names,
        frames=len(time),
        duration=step * len(time),
        extent=extent,
        in_contact=None if touching is None else int(touching.any(axis=1).sum()),
        contacts=contacts,
        largest_force=largest["force"],
        largest_moment=largest["moment"],
        estimated=estimated,
        assumption=assumption,
        events=events,
        stages=tuple(stage for stage in STAGES if stage in recording.children),
        fitted=fitted,
        shape=shape,
        known="; ".join(known.in_words() for known in record.objects),
        distance=distance,
    )


def _largest(values: np.ndarray | None, touching: np.ndarray | None) -> float:
    """Largest length of vectors (time, whisker, 3) where there is contact."""
    if values is None or touching is None:
        return np.nan
    sizes = np.linalg.norm(values, axis=-1)[touching]
    return float(np.nanmax(sizes)) if np.isfinite(sizes).any() else np.nan
