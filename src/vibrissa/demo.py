"""Demonstration of the whole pipeline on a simulated trial, compared with the truth.

Results are written to a folder. Files of the same trial that already exist there are reused.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa import evaluation, samples, simulation
from vibrissa._version import __version__
from vibrissa.contacts import ContactMap
from vibrissa.contour import CylinderFit, shape_from_dataset
from vibrissa.io import load_recording, replacing, save_contacts, save_recording
from vibrissa.objects import Peg
from vibrissa.pipeline import (
    Progress,
    contact_columns,
    placed_by,
    signals_of,
    whisker_radii,
    with_contour,
    with_estimates,
    with_group,
)
from vibrissa.recording import Recording
from vibrissa.sensors import FORCE_NOISE, MOMENT_NOISE
from vibrissa.tracking import TrackOptions, partial_traces, trace_file, track
from vibrissa.whisker import Whisker

DURATION = 0.5
"""Duration of the trial, s."""

FULL_DURATION = 3.5
"""Duration of a trial like the paper's, s."""

SIMULATED, TRACKED = "simulated.nc", "tracked.nc"
"""Recordings that are reused in later runs, as videos are."""

_VIEWS = ("top", "front")
# Files that are written again in each run.
_WRITTEN = ("trial.nc", "seen.nc", "contacts.csv", "map.nc")
_SETTINGS = ".settings.json"
_NODES = 9  # number of points by which whiskers are compared
# Properties that cameras cannot measure, and that a laboratory knows from other measurements.
_PROPERTIES = ("base_radius", "tip_radius", "youngs_modulus", "poisson_ratio")
_DIM = {"whisker": 0}


@dataclass(frozen=True, eq=False)
class Located:
    """Contacts estimated from signals of one source, with their errors.

    The recording has the groups ``signals``, ``estimates`` and ``contour``; `contacts` are its
    estimates and `fit` the peg fitted to them. Errors are given by frame, as summary, and for the
    signals.
    """

    recording: xr.DataTree
    contacts: xr.Dataset
    errors: xr.Dataset
    fit: CylinderFit
    scores: evaluation.Scores
    signals: tuple[evaluation.SignalRow, ...]


@dataclass(frozen=True, eq=False)
class DemoResult:
    """Results of the demonstration: the simulated trial, and all estimates.

    Contacts are estimated by the map of the tracked whisker, or of the true one without video:
    `sensed` from the readings of the sensor, transformed to the laboratory frame by the tracked
    pose (the true one without video), and `seen` by the paper's method, from signals computed for
    the tracked contact point.
    """

    whisker: Whisker
    peg: Peg
    simulated: xr.DataTree
    contact_map: ContactMap
    sensed: Located
    seen: Located | None
    tracking: evaluation.TrackingScores | None
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
    """Simulate whisking against a peg, with videos and a sensor, and reconstruct the peg.

    Recordings, videos and tables are written to the folder ``output``, which is created if needed;
    by default nothing is kept. Existing results of the same trial are reused. Without ``video`` the
    true pose of the base is used. ValueError is raised if the whisker cannot whisk past the peg,
    there are too few contacts to fit it, or other files would be replaced.
    """
    tell = progress or (lambda stage, done, total: None)
    whisker = samples.gamma() if whisker is None else whisker
    with tempfile.TemporaryDirectory() if output is None else nullcontext(output) as place:
        folder = Path(place)
        begin(folder, whisker, seed=seed, noise=noise, duration=duration, rate=rate, video=video)
        trial = _simulated(whisker, seed, noise, duration, rate, tell)
        held, scores, seen = trial, None, None
        if video:
            trial = _filmed(trial, folder, seed, tell)
            held = evaluation.with_truth(_tracked(trial, folder, tell), trial)
            scores = evaluation.tracking_scores(
                held.to_dataset().isel(_DIM), evaluation.truth_of(held)[0]
            )
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
        files: tuple[Path, ...] = ()
        if output is not None:
            files = _written(folder, sensed, seen, contact_map, tell)
        (peg,) = Recording(trial).pegs
        return DemoResult(whisker, peg, trial, contact_map, sensed, seen, scores, files)


def begin(folder: Path, whisker: Whisker, **settings: object) -> None:
    """Create the folder, and remove results made there with other settings."""
    folder.mkdir(parents=True, exist_ok=True)
    arc_length = np.linspace(0.0, whisker.length, _NODES)
    shape = np.column_stack([whisker.centerline(_NODES), whisker.radius(arc_length)])
    about = {**settings, "whisker": shape.tolist(), "version": __version__}
    text = json.dumps(about, sort_keys=True)
    path = folder / _SETTINGS
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return
    kept = [folder / SIMULATED, folder / TRACKED, *video_files(folder)]
    made = [*kept, *(folder / name for name in _WRITTEN)]
    there = [file.name for file in made if file.exists()]
    if there and not path.exists():
        raise ValueError(
            f"{folder} contains {', '.join(there)}, which would be replaced: choose another folder"
        )
    for file in made:
        file.unlink(missing_ok=True)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def video_files(folder: Path) -> list[Path]:
    """List the videos of the demo, one for each view."""
    return [folder / f"{name}.mp4" for name in _VIEWS]


def _simulated(
    whisker: Whisker, seed: int, noise: bool, duration: float, rate: float, tell: Progress
) -> xr.DataTree:
    """Simulated trial, with the readings of a sensor at the whisker's base."""
    force_noise, moment_noise = (FORCE_NOISE, MOMENT_NOISE) if noise else (0.0, 0.0)
    peg = simulation.facing_peg(whisker)
    tell("how far to whisk", 0, 1)
    motion = simulation.sweep_past(whisker, peg, duration, rate, seed=seed)
    tell("how far to whisk", 1, 1)
    trial = simulation.simulate(whisker, motion, peg, progress=partial(tell, "whisking trial"))
    return simulation.measure(trial, force_noise, moment_noise, seed)


def _filmed(trial: xr.DataTree, folder: Path, seed: int, tell: Progress) -> xr.DataTree:
    """Trial with cameras and true traces; missing videos are rendered."""
    path = folder / SIMULATED
    if path.exists():
        return load_recording(path)
    cameras = simulation.views_of(trial)
    for view, (camera, file) in enumerate(zip(cameras, video_files(folder), strict=True)):
        # An existing video is complete.
        if not file.exists():
            report = partial(tell, f"filming, {camera.name}")
            simulation.film(trial, {camera.name: file}, [camera], seed=seed + view, progress=report)
    done = simulation.with_true_traces(trial, cameras)
    save_recording(path, done)
    return done


def _tracked(trial: xr.DataTree, folder: Path, tell: Progress) -> xr.DataTree:
    """Recording tracked in the videos of a trial."""
    path = folder / TRACKED
    if path.exists():
        return load_recording(path)
    kept = [partial_traces(path, view) for view in range(len(_VIEWS))]
    traces = [
        trace_file(file, kept[view], progress=partial(tell, f"tracing, {file.stem}"))
        for view, file in enumerate(video_files(folder))
    ]
    rate = 1.0 / float(np.median(np.diff(trial.to_dataset()["time"].values)))
    own = Recording(trial).whisker()
    how = TrackOptions(properties={name: getattr(own, name) for name in _PROPERTIES})
    found = track(Recording(trial).cameras, traces, rate, how, progress=tell)
    save_recording(path, found)
    for file in kept:
        file.unlink(missing_ok=True)
    return found


def _located(recording: xr.DataTree, contact_map: ContactMap, seed: int) -> Located:
    """Estimate contacts from a recording's signals, fit the peg, and compare with the truth."""
    recording = with_contour(with_estimates(recording, contact_maps=[contact_map]))
    (peg,) = Recording(recording).pegs
    contacts = recording["estimates"].to_dataset().isel(_DIM)
    fit = shape_from_dataset(recording["contour"].to_dataset())
    assert isinstance(fit, CylinderFit)
    truth, whisker = evaluation.truth_of(recording)
    radii = whisker_radii(recording["truth"].to_dataset(), [whisker])[:, 0]
    errors = evaluation.contact_errors(contacts, truth, whisker, seed)
    signals = recording["signals"].to_dataset().isel(_DIM)
    return Located(
        recording=recording,
        contacts=contacts,
        errors=errors,
        fit=fit,
        scores=evaluation.score(contacts, truth, errors, fit, peg, radii),
        signals=evaluation.signal_errors(signals, truth, errors["deflection_angle"].values),
    )


def _written(
    folder: Path, sensed: Located, seen: Located | None, contact_map: ContactMap, tell: Progress
) -> tuple[Path, ...]:
    """Write all results and return their paths."""
    recordings = {"trial.nc": sensed.recording}
    if seen is not None:
        recordings["seen.nc"] = seen.recording
    count = len(recordings) + 2
    for i, (name, recording) in enumerate(recordings.items()):
        tell("files", i, count)
        save_recording(folder / name, recording)
    tell("files", len(recordings), count)
    save_contacts(folder / "contacts.csv", contact_columns(sensed.contacts))
    contact_map.save(folder / "map.nc")
    tell("files", count, count)
    files = [folder / name for name in (*recordings, "contacts.csv", "map.nc")]
    if seen is not None:
        files = [folder / SIMULATED, *video_files(folder), folder / TRACKED, *files]
    return tuple(files)
