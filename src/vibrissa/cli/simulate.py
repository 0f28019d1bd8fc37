"""`vibrissa simulate`: simulation of a trial with ground truth."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

import vibrissa as vb
from vibrissa.cli.inputs import WhiskerOptions, print_notes, print_statuses
from vibrissa.cli.options import free, with_options
from vibrissa.cli.terminal import output, progress_bars, say, shown
from vibrissa.deferred import xr


@dataclass(frozen=True)
class PlanOptions:
    """Options that override the script of a trial, with the names of `read_script`."""

    array: str | None = None
    side: Literal["both", "left", "right"] | None = None
    names: str | None = None
    object: Literal["peg", "sphere", "box", "plane"] | None = None
    duration: float | None = None
    rate: float | None = None
    frequency: float | None = None
    protraction: float | None = None
    row: Literal["A", "B", "C", "D", "E"] | None = None
    friction: float | None = None
    dynamic: bool = False
    noise: bool = True
    seed: int | None = None

    def changes(self) -> dict[str, Any]:
        """Options by the names of `read_script`."""
        names = None if self.names is None else self.names.replace(",", " ").split()
        return {name: v for name, v in asdict(self).items() if name != "names"} | {
            "whiskers": names
        }


@with_options("the recording, .nc")
def simulate(
    own: WhiskerOptions,
    wanted: PlanOptions,
    script: Path | None = None,
    target: Path = Path("trial.nc"),
    film: Path | None = None,
    example: bool = False,
    force: bool = False,
) -> None:
    """Simulate a whisking trial among objects, with its ground truth.

    By default the trial is that of the demo: a γ whisker sweeps past a peg and back, for 3.5 s (an
    array: 0.5 s). Options override the script.
    Example: `vibrissa simulate --duration 0.5 --friction 0.3 -o trial.nc`;
    `vibrissa simulate --array average --object sphere -o face.nc`
    """
    if example:
        output.out(vb.simulation.EXAMPLE, highlight=False, end="")
        return
    vb.io.check_writable(target, vb.io.NETCDF)
    free([target, *(() if film is None else _films(film))], force)
    with progress_bars() as tell:
        tell("how far to whisk", 0, 1)
        text, folder = ("", Path()) if script is None else (vb.io.read_text(script), script.parent)
        with nullcontext() if script is None else vb.io.in_file(script):
            plan = vb.simulation.read_script(
                text, folder, own.read, whisker=own.whisker, **wanted.changes()
            )
        tell("how far to whisk", 1, 1)
        trial = vb.simulation.simulate(
            plan.whisker,
            plan.motion,
            plan.objects,
            friction=plan.friction,
            dynamics=plan.dynamics,
            progress=lambda done, total: tell("whisking trial", done, total),
        )
        trial = vb.simulation.measure(trial, seed=plan.seed, sensor=plan.sensor)
        vb.io.save_recording(target, trial)
    say(repr(plan.whisker))
    if isinstance(plan.whisker, vb.Whisker):
        print_notes(plan.whisker)
    for solid in plan.objects:
        say(repr(solid))
    _report(trial)
    say(f"wrote {target}")
    if film is not None:
        _film(trial, target, film, plan.seed)


def _report(trial: xr.DataTree) -> None:
    """Summarise the trial in a few lines."""
    truth = trial["truth"].to_dataset()
    names = trial.to_dataset()["whisker"].values.tolist()
    print_statuses(truth["status"].values.ravel(), "frames:")
    contact = truth["in_contact"].values.astype(int)
    begun = contact[0] + (np.diff(contact, axis=0) == 1).sum(axis=0)
    if len(names) > 1:
        touched = [f"{name} {count}" for name, count in zip(names, begun, strict=True) if count]
        contacts = ", ".join(touched) or "none"
        say(f"{len(touched)} of {len(names)} whiskers touched; contacts: {contacts}")
    largest = [
        shown(name, float(np.nanmax(np.linalg.norm(truth[name].values, axis=-1))), 3)
        for name in ("force", "moment")
    ]
    count = int(begun.sum())
    say(f"{count} contact{'s' * (count != 1)}, up to {largest[0]} and {largest[1]}")
    several, overlap = truth["second_contact"].values, truth["overlap"].values > 0.0
    if solved := int((several & ~overlap).sum()):
        say(f"in {solved} frames a whisker has several contacts, all of them in the forces")
    if missing := int((several & overlap).sum()):
        say(
            f"in {missing} frames a whisker would have a second contact (second_contact), which "
            "the forces do not include"
        )


def _films(folder: Path) -> list[Path]:
    """Paths of the videos of the two views."""
    return [folder / f"{view}.mkv" for view in ("top", "front")]


def _film(trial: xr.DataTree, path: Path, folder: Path, seed: int) -> None:
    """Render videos of the trial, and add cameras and true traces to the recording."""
    folder.mkdir(parents=True, exist_ok=True)
    cameras = vb.simulation.views_of(trial)
    files = dict(zip([camera.name for camera in cameras], _films(folder), strict=True))
    with progress_bars() as tell:
        filmed = vb.simulation.film(
            trial,
            files,
            cameras,
            seed=seed,
            progress=lambda done, total: tell("filming", done, total),
        )
        vb.io.save_recording(path, filmed)
    for file in files.values():
        say(f"wrote {file}")
