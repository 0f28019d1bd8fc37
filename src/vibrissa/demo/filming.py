"""A trial in the folder of the demo: filmed and tracked. What is there is not done again."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr

import vibrissa
from vibrissa.io import load_recording, save_recording
from vibrissa.io.paths import replacing
from vibrissa.pipeline.estimates import Progress
from vibrissa.recording import Recording
from vibrissa.simulation import film, views_of
from vibrissa.simulation.film import with_true_traces
from vibrissa.tracking import TrackOptions, partial_traces, trace_file, track
from vibrissa.whisker import Whisker

SIMULATED, TRACKED = "simulated.nc", "tracked.nc"
WRITTEN = ("trial.nc", "seen.nc", "contacts.csv", "map.nc")
"""What is made anew each time, in this order."""

_SETTINGS = ".settings.json"
VIEWS = ("top", "front")
_PLACES = 9
_PROPERTIES = ("base_radius", "tip_radius", "youngs_modulus", "poisson_ratio")
"""What no camera sees, and a lab has from elsewhere."""


def begin(folder: Path, whisker: Whisker, **settings: object) -> None:
    """Make the folder, and clear away what was made there with other settings."""
    folder.mkdir(parents=True, exist_ok=True)
    places = np.linspace(0.0, whisker.length, _PLACES)
    shape = np.column_stack([whisker.centerline(_PLACES), whisker.radius(places)])
    said = {**settings, "whisker": shape.tolist(), "version": vibrissa.__version__}
    text = json.dumps(said, sort_keys=True)
    path = folder / _SETTINGS
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return
    files = [folder / SIMULATED, folder / TRACKED, *video_files(folder)]
    made = [*files, *(folder / name for name in WRITTEN)]
    there = [file.name for file in made if file.exists()]
    if there and not path.exists():
        raise ValueError(
            f"{folder} holds {', '.join(there)}, which this would replace: choose another folder"
        )
    for file in made:
        file.unlink(missing_ok=True)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def video_files(folder: Path) -> list[Path]:
    """Say where the videos of the demo are."""
    return [folder / f"{name}.mp4" for name in VIEWS]


def filmed(trial: xr.DataTree, folder: Path, seed: int, tell: Progress) -> xr.DataTree:
    """Film a trial, and keep it beside the videos."""
    path = folder / SIMULATED
    if path.exists():
        return load_recording(path)
    cameras = views_of(trial)
    for view, (camera, file) in enumerate(zip(cameras, video_files(folder), strict=True)):
        # A video is there only if it is whole.
        if not file.exists():
            told = partial(tell, f"filming, {camera.name}")
            film(trial, {camera.name: file}, [camera], seed=seed + view, progress=told)
    done = with_true_traces(trial, cameras)
    save_recording(path, done)
    return done


def tracked(trial: xr.DataTree, folder: Path, tell: Progress) -> xr.DataTree:
    """Track the whisker in the videos of a trial."""
    path = folder / TRACKED
    if path.exists():
        return load_recording(path)
    cameras = Recording(trial).cameras
    kept = [partial_traces(path, view) for view in range(len(VIEWS))]
    traces = [
        trace_file(file, kept[view], progress=partial(tell, f"tracing, {file.stem}"))
        for view, file in enumerate(video_files(folder))
    ]
    rate = 1.0 / float(np.median(np.diff(trial.to_dataset()["time"].values)))
    own = Recording(trial).whisker()
    properties = {name: getattr(own, name) for name in _PROPERTIES}
    found = track(cameras, traces, rate, TrackOptions(properties=properties), progress=tell)
    save_recording(path, found)
    for file in kept:
        file.unlink(missing_ok=True)
    return found
