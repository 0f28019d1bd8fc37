"""What is simulated, filmed and tracked: one recording a condition and seed, kept in a folder."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import xarray as xr

import vibrissa as vb
from vibrissa.io import load_recording, read_video, save_recording
from vibrissa.recording import Recording
from vibrissa.simulation import Dynamics, facing_peg, film, measure, simulate, sweep_past
from vibrissa.tracking import trace_video, track

RATE = 1000.0
NODES = 257
VIEWS = ("top", "front")


@dataclass(frozen=True)
class Condition:
    """One kind of trial."""

    name: str
    label: str
    friction: float = 0.0
    dynamic: bool = False
    frequency: float = 5.0
    filmed: int = 2
    """How many of its trials are filmed."""
    of: str = ""
    """Name of the condition whose trials these are, with the inertia removed; else its own."""


CONDITIONS = (
    Condition("friction-0", "no friction"),
    Condition("friction-01", "friction 0.1", 0.1),
    Condition("friction-03", "friction 0.3", 0.3),
    Condition("friction-05", "friction 0.5", 0.5),
    Condition("dynamic", "inertia", dynamic=True, filmed=1),
    Condition("removed", "inertia removed", dynamic=True, filmed=0, of="dynamic"),
    Condition("dynamic-friction-03", "inertia, friction 0.3", 0.3, dynamic=True),
    Condition(
        "removed-friction-03",
        "inertia removed, friction 0.3",
        0.3,
        dynamic=True,
        filmed=0,
        of="dynamic-friction-03",
    ),
)

FAST = Condition("fast", "no friction, 10 whisks a second", frequency=10.0, filmed=1)
"""For the filter of the base's pose only."""


@dataclass(frozen=True)
class Recorded:
    """A trial as it was, with the sensor's readings at the top, and as it was tracked, or None."""

    condition: Condition
    seed: int
    true: xr.DataTree
    tracked: xr.DataTree | None


def whisker() -> vb.Whisker:
    return vb.samples.gamma()


def recorded(
    condition: Condition, seed: int, duration: float, folder: Path, video: bool
) -> Recorded:
    """Find a condition's recordings in the folder, or make them."""
    stem = f"{condition.of or condition.name}-{duration:g}s-{seed}"
    true = _kept(folder / f"{stem}.nc", lambda: _simulated(condition, seed, duration))
    tracked = None
    if video:
        tracked = _kept(folder / f"{stem}-tracked.nc", lambda: _tracked(true, seed, folder))
    return Recorded(condition, seed, true, tracked)


def _kept(path: Path, make: Callable[[], xr.DataTree]) -> xr.DataTree:
    if not path.exists():
        print(f"making {path.name}", flush=True)
        # Under another name at first: what was interrupted is not taken for whole.
        begun = path.with_name(f"begun-{path.name}")
        save_recording(begun, make())
        begun.replace(path)
    return load_recording(path)


def _simulated(condition: Condition, seed: int, duration: float) -> xr.DataTree:
    peg = facing_peg(whisker())
    motion = sweep_past(whisker(), peg, duration, RATE, seed=seed, frequency=condition.frequency)
    dynamics = Dynamics() if condition.dynamic else None
    trial = simulate(
        whisker(), motion, peg, friction=condition.friction, dynamics=dynamics, nodes=NODES
    )
    return measure(trial, seed=seed)


def _tracked(trial: xr.DataTree, seed: int, folder: Path) -> xr.DataTree:
    """Film a trial, track the whisker in the two videos, and throw these away."""
    paths = {view: folder / f"begun-{view}.mp4" for view in VIEWS}
    cameras = Recording(film(trial, paths, seed=seed)).cameras
    traces = [trace_video(read_video(paths[camera.name])) for camera in cameras]
    for path in paths.values():
        path.unlink()
    return track(cameras, traces, RATE)
