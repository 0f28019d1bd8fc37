"""The main job, step by step."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from os import PathLike
from pathlib import Path

import xarray as xr

from vibrissa import samples
from vibrissa.contacts import ContactMap
from vibrissa.contour import CylinderFit, shape_from_dataset
from vibrissa.demo.filming import SIMULATED, TRACKED, begin, filmed, tracked, video_files
from vibrissa.evaluation import (
    Scores,
    SignalRow,
    TrackingScores,
    contact_errors,
    score,
    signal_errors,
    tracking_scores,
    truth_of,
    with_truth,
)
from vibrissa.io import save_contacts, save_recording
from vibrissa.objects import Peg
from vibrissa.pipeline import (
    contact_columns,
    placed_by,
    signals_of,
    whisker_radii,
    with_contour,
    with_estimates,
    with_group,
)
from vibrissa.pipeline.estimates import Progress
from vibrissa.recording import Recording
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE
from vibrissa.simulation import facing_peg, measure, simulate, sweep_past
from vibrissa.whisker import Whisker

DURATION = 0.5
"""Of the trial, s."""

FULL_DURATION = 3.5
"""Of a trial like the paper's, s."""

DIM = {"whisker": 0}


@dataclass(frozen=True, eq=False)
class Located:
    """Contact points estimated from signals of one source, and how good they are.

    Parameters
    ----------
    recording : xarray.DataTree
        With the groups ``signals``, ``estimates`` and ``contour``.
    contacts : xarray.Dataset
        The estimates, dim time.
    errors : xarray.Dataset
        Of the contacts, dim time.
    fit : CylinderFit
        The peg fitted to them.
    scores : Scores
        The errors in numbers.
    signals : tuple of SignalRow
        Errors of the signals by deflection angle.
    """

    recording: xr.DataTree
    contacts: xr.Dataset
    errors: xr.Dataset
    fit: CylinderFit
    scores: Scores
    signals: tuple[SignalRow, ...]


@dataclass(frozen=True, eq=False)
class DemoResult:
    """What the main job gives.

    Parameters
    ----------
    whisker : Whisker
        That whisked.
    peg : Peg
        That it met.
    simulated : xarray.DataTree
        The trial with its truth and what the sensor read.
    contact_map : ContactMap
        By which contacts were found: of the whisker as it was tracked, or without video of the one
        that whisked.
    sensed : Located
        From what the sensor read, in the laboratory by the pose that was tracked, or without video
        by the true one.
    seen : Located or None
        The paper's way: from signals that the model gives for the contact point that was tracked.
    tracking : TrackingScores or None
        Errors of what was tracked.
    files : tuple of Path
        What was written.
    """

    whisker: Whisker
    peg: Peg
    simulated: xr.DataTree
    contact_map: ContactMap
    sensed: Located
    seen: Located | None
    tracking: TrackingScores | None
    files: tuple[Path, ...]


def run_demo(
    whisker: Whisker | None = None,
    output: str | PathLike[str] | None = None,
    *,
    seed: int = 0,
    noise: bool = True,
    duration: float = DURATION,
    rate: float = 1000.0,
    video: bool = True,
    progress: Progress | None = None,
) -> DemoResult:
    """Whisk against a peg, film it, feel it at the base, and find the peg again.

    Parameters
    ----------
    whisker : Whisker, optional
        By default the built-in γ whisker.
    output : str or path, optional
        Folder for the recordings, videos and tables, made if need be; by default nothing is kept.
        What is there already of the same trial is not done again.
    seed : int
        Of the trial's drifts, the sensor's noise and the videos'.
    noise : bool
        Whether the sensor has noise: 1 µN and 0.02 µN·m standard deviation a component.
    duration : float
        Of the trial, s.
    rate : float
        Frames per second.
    video : bool
        Whether the trial is filmed and tracked. If not, the base's true pose is taken.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.

    Returns
    -------
    DemoResult
        Everything, with how good it is.

    Raises
    ------
    ValueError
        If the whisker cannot whisk past the peg, too few contacts are felt to fit it, or files are
        in the way.
    """
    tell = progress or _silent
    whisker = samples.gamma() if whisker is None else whisker
    with _folder(output) as folder:
        begin(folder, whisker, seed=seed, noise=noise, duration=duration, rate=rate, video=video)
        trial = _simulated(whisker, seed, noise, duration, rate, tell)
        held, scores, seen = trial, None, None
        if video:
            trial = filmed(trial, folder, seed, tell)
            held = with_truth(tracked(trial, folder, tell), trial)
            scores = tracking_scores(held.to_dataset().isel(DIM), truth_of(held)[0])
        tell("map of all contacts", 0, 1)
        contact_map = ContactMap.simulate(Recording(held).whisker(), grid=False)
        tell("map of all contacts", 1, 1)
        read = placed_by(signals_of(trial, "sensor"), held) if video else signals_of(trial)
        sensed = _located(with_group(held, "signals", read), contact_map, seed)
        tell("contact points", 1, 2 if video else 1)
        if video:
            read = signals_of(held, "contact point")
            seen = _located(with_group(held, "signals", read), contact_map, seed)
            tell("contact points", 2, 2)
        (peg,) = Recording(trial).objects
        assert isinstance(peg, Peg)
        result = DemoResult(whisker, peg, trial, contact_map, sensed, seen, scores, ())
        return result if output is None else _written(result, folder, tell)


def _silent(stage: str, done: int, total: int) -> None:
    pass


@contextmanager
def _folder(output: str | PathLike[str] | None) -> Iterator[Path]:
    """The folder that is asked for, or one that goes away again."""
    if output is not None:
        yield Path(output)
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def _simulated(
    whisker: Whisker, seed: int, noise: bool, duration: float, rate: float, tell: Progress
) -> xr.DataTree:
    """The trial, with what a sensor at the whisker's base reads."""
    force_noise, moment_noise = (FORCE_NOISE, MOMENT_NOISE) if noise else (0.0, 0.0)
    peg = facing_peg(whisker)
    tell("how far to whisk", 0, 1)
    motion = sweep_past(whisker, peg, duration, rate, seed=seed)
    tell("how far to whisk", 1, 1)
    trial = simulate(whisker, motion, peg, progress=partial(tell, "whisking trial"))
    return measure(trial, force_noise, moment_noise, seed)


def _located(recording: xr.DataTree, contact_map: ContactMap, seed: int) -> Located:
    """Estimate contacts from a recording's signals, fit the peg, and compare with the truth."""
    recording = with_contour(with_estimates(recording, contact_maps=[contact_map]))
    contacts = recording["estimates"].to_dataset().isel(DIM)
    fit = shape_from_dataset(recording["contour"].to_dataset())
    assert isinstance(fit, CylinderFit)
    truth, whisker = truth_of(recording)
    (peg,) = Recording(recording).objects
    assert isinstance(peg, Peg)
    radii = whisker_radii(recording["truth"].to_dataset(), [whisker])[:, 0]
    known = truth.assign(
        radius=("time", radii),
        peg_position=("space", peg.origin),
        peg_axis=("space", peg.axis),
        peg_radius=((), peg.radius),
    )
    errors = contact_errors(contacts, truth, whisker, seed)
    signals = recording["signals"].to_dataset().isel(DIM)
    return Located(
        recording=recording,
        contacts=contacts,
        errors=errors,
        fit=fit,
        scores=score(contacts, known, errors, fit),
        signals=signal_errors(signals, truth, errors["deflection_angle"].values),
    )


def _written(result: DemoResult, folder: Path, tell: Progress) -> DemoResult:
    """Write everything and say where."""
    recordings = {"trial.nc": result.sensed.recording}
    if result.seen is not None:
        recordings["seen.nc"] = result.seen.recording
    for i, (name, recording) in enumerate(recordings.items()):
        tell("files", i, len(recordings) + 2)
        save_recording(folder / name, recording)
    tell("files", len(recordings), len(recordings) + 2)
    save_contacts(folder / "contacts.csv", contact_columns(result.sensed.contacts))
    result.contact_map.save(folder / "map.nc")
    tell("files", len(recordings) + 2, len(recordings) + 2)
    files = [folder / name for name in (*recordings, "contacts.csv", "map.nc")]
    if result.tracking is not None:
        files = [folder / SIMULATED, *video_files(folder), folder / TRACKED, *files]
    return replace(result, files=tuple(files))
