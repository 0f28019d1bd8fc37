"""The main job, step by step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa import samples
from vibrissa.contour import CylinderFit
from vibrissa.demo.scores import Scores, contact_errors, score
from vibrissa.io import save_contacts, save_recording
from vibrissa.mapping import ContactMap
from vibrissa.pipeline import (
    TRIPLET,
    component_noise,
    contact_columns,
    fit_contacts,
    in_laboratory,
    locate,
    whisker_radii,
)
from vibrissa.sensing import FORCE_NOISE, MOMENT_NOISE
from vibrissa.trial import Motion, Peg, facing_peg, measure, simulate, sweep_past
from vibrissa.trial.recording import recorded
from vibrissa.whisker import Whisker

Progress = Callable[[str, int, int], None]
"""Called with what is being done, and how much of how much is."""


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What the main job gives.

    Parameters
    ----------
    whisker : Whisker
        That whisked.
    peg : Peg
        That it met.
    contact_map : ContactMap
        Of the whisker.
    recording : xarray.DataTree
        The trial: motion, measured wrench and estimated contacts; the truth in its group.
    contacts : xarray.Dataset
        The estimated contacts, dim time, whisker's and laboratory frame.
    errors : xarray.Dataset
        Of the contacts, dim time.
    fit : CylinderFit
        The peg fitted to them.
    scores : Scores
        The errors in numbers.
    files : tuple of Path
        What was written.
    """

    whisker: Whisker
    peg: Peg
    contact_map: ContactMap
    recording: xr.DataTree
    contacts: xr.Dataset
    errors: xr.Dataset
    fit: CylinderFit
    scores: Scores
    files: tuple[Path, ...]


def run_demo(
    whisker: Whisker | None = None,
    output: str | PathLike[str] | None = None,
    *,
    seed: int = 0,
    noise: bool = True,
    duration: float = 3.0,
    rate: float = 1000.0,
    progress: Progress | None = None,
) -> DemoResult:
    """Whisk against a peg, feel it at the base, and find it again.

    Parameters
    ----------
    whisker : Whisker, optional
        By default the built-in γ whisker.
    output : str or path, optional
        Folder for ``trial.nc``, ``contacts.csv``, ``map.nc`` and the figures, made if need be; by
        default nothing is written.
    seed : int
        Of the trial's drifts and the sensor's noise.
    noise : bool
        Whether the sensor has noise: 1 µN and 0.02 µN·m standard deviation a component.
    duration : float
        Of the trial, s.
    rate : float
        Frames per second.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    DemoResult
        Everything, with how good it is.

    Raises
    ------
    ValueError
        If the whisker cannot whisk past the peg, or too few contacts are felt to fit it.
    """
    tell = progress or _silent
    whisker = samples.gamma() if whisker is None else whisker
    force_noise, moment_noise = (FORCE_NOISE, MOMENT_NOISE) if noise else (0.0, 0.0)
    peg = facing_peg(whisker)
    tell("how far to whisk", 0, 1)
    motion = sweep_past(whisker, peg, duration, rate, seed=seed)
    tell("how far to whisk", 1, 1)
    tell("map of all contacts", 0, 1)
    contact_map = ContactMap.simulate(
        whisker, progress=lambda done, total: tell("map of all contacts", done, total)
    )
    trial = simulate(
        whisker, motion, peg, progress=lambda done, total: tell("whisking trial", done, total)
    )
    recording = measure(trial, force_noise, moment_noise, seed)
    tell("contact points from signals", 0, 1)
    contacts = locate(
        contact_map,
        recording.to_dataset()[["force", "moment"]].isel(whisker=0),
        TRIPLET,
        noise=component_noise(force_noise, moment_noise),
    )
    contacts = in_laboratory(contacts, motion.base_rotation, motion.base_position)
    tell("contact points from signals", 1, 1)
    fit = fit_contacts(contacts.expand_dims("whisker", 1), [whisker])
    assert isinstance(fit, CylinderFit)
    truth = _truth(recording, whisker, peg)
    errors = contact_errors(contacts, truth, whisker, seed)
    recording = with_estimates(recording, contacts)
    result = DemoResult(
        whisker=whisker,
        peg=peg,
        contact_map=contact_map,
        recording=recording,
        contacts=contacts,
        errors=errors,
        fit=fit,
        scores=score(contacts, truth, errors, fit),
        files=(),
    )
    return result if output is None else _written(result, Path(output), motion, tell)


def _silent(stage: str, done: int, total: int) -> None:
    pass


def _truth(recording: xr.DataTree, whisker: Whisker, peg: Peg) -> xr.Dataset:
    """What truly happened, dim time, with the peg and the whisker's radius at the contact."""
    truth = recording["truth"].to_dataset().isel(whisker=0)
    return truth.assign(
        radius=("time", whisker_radii(truth.expand_dims("whisker", 1), [whisker])[:, 0]),
        peg_position=("space", peg.origin),
        peg_axis=("space", peg.axis),
        peg_radius=((), peg.radius),
    )


def with_estimates(recording: xr.DataTree, contacts: xr.Dataset) -> xr.DataTree:
    """Add estimated contacts to a recording of one whisker.

    Parameters
    ----------
    recording : xarray.DataTree
        The recording.
    contacts : xarray.Dataset
        Of `vibrissa.pipeline.in_laboratory`.

    Returns
    -------
    xarray.DataTree
        A new one, with contact points, arc length, status, whether a contact is felt, and a
        confidence of one over the number of candidates.
    """
    number = contacts["candidates"].values
    confidence = np.where(number > 0, 1.0 / np.maximum(number, 1), 0.0)
    names = ("contact_point", "contact_point_whisker", "arc_length", "in_contact", "status")
    values = {name: contacts[name].values for name in names} | {"confidence": confidence}
    out = recording.copy()
    estimated = {name: recorded(name, array) for name, array in values.items()}
    out.dataset = recording.to_dataset().assign(estimated)
    return out


def _written(result: DemoResult, folder: Path, motion: Motion, tell: Progress) -> DemoResult:
    """Write everything and say where."""
    from dataclasses import replace

    from vibrissa.demo.pictures import draw

    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name for name in ("trial.nc", "contacts.csv", "map.nc")]
    tell("files", 0, 3)
    save_recording(files[0], result.recording)
    tell("files", 1, 3)
    save_contacts(files[1], contact_columns(result.contacts))
    tell("files", 2, 3)
    result.contact_map.save(files[2])
    tell("files", 3, 3)
    pictures = draw(result, folder, lambda done, total: tell("figures", done, total))
    return replace(result, files=(*files, *pictures))
