"""`vibrissa simulate`: a trial whose truth is known."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import Force, free, output, progress_bars, shown

if TYPE_CHECKING:
    import xarray as xr


def simulate(
    script: Annotated[
        Path | None,
        typer.Argument(help="The trial as TOML; `--example` prints one.", metavar="TRIAL.toml"),
    ] = None,
    path: Annotated[
        Path, typer.Option("--output", "-o", help="Recording to write, .nc.", metavar="FILE")
    ] = Path("trial.nc"),
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV; by default a built-in γ whisker.", metavar="FILE"),
    ] = None,
    array: Annotated[
        str | None,
        typer.Option(
            help="All whiskers of a face: `average` for an average rat's, or a file or folder.",
            metavar="FILE|average",
        ),
    ] = None,
    side: Annotated[
        str | None, typer.Option(help="Of the array: both (by default), left or right.")
    ] = None,
    whiskers: Annotated[
        str | None,
        typer.Option(help="Of the array: names, such as `C1,C2,gamma`.", metavar="NAMES"),
    ] = None,
    thing: Annotated[
        str | None,
        typer.Option(
            "--object", help="What stands within reach: peg, sphere, box or plane.", metavar="KIND"
        ),
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Of the trial, s; 3.5 by default, 0.5 of an array.")
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Frames per second; 1000 by default.")] = None,
    frequency: Annotated[
        float | None, typer.Option(help="Whisks per second; 5 by default.")
    ] = None,
    protraction: Annotated[
        float | None, typer.Option(help="Share of a whisk that goes forward, 0.3 to 0.7.")
    ] = None,
    row: Annotated[
        str | None,
        typer.Option(
            help="Of one whisker: its row, A to E, by which elevation and roll follow the azimuth; "
            "C by default."
        ),
    ] = None,
    friction: Annotated[
        float | None, typer.Option(help="Coulomb's coefficient; 0 by default.")
    ] = None,
    dynamic: Annotated[
        bool,
        typer.Option("--dynamic", help="With inertia and damping: half a minute a second or so."),
    ] = False,
    noise: Annotated[
        bool, typer.Option(help="Whether the sensor has noise: by default 1 µN and 0.02 µN·m.")
    ] = True,
    seed: Annotated[int | None, typer.Option(help="Of the whisks and of the noise.", min=0)] = None,
    film: Annotated[
        Path | None,
        typer.Option(help="Where videos of the two views go as well.", metavar="DIR"),
    ] = None,
    example: Annotated[
        bool, typer.Option("--example", help="Print a trial with all that one can say, and stop.")
    ] = False,
    force: Force = False,
) -> None:
    """Simulate a whisking trial among objects, with its truth.

    By default the trial of the demo: a γ whisker sweeps past a peg and back. Options count more
    than the file. Examples: `vibrissa simulate --duration 0.5 --friction 0.3 -o trial.nc`;
    `vibrissa simulate --array average --object sphere -o face.nc`
    """
    from vibrissa.cli.sources import tell_notes, whisker_from
    from vibrissa.io import save_recording
    from vibrissa.io.paths import NETCDF, check_writable
    from vibrissa.io.table import read_text
    from vibrissa.io.toml import in_file
    from vibrissa.simulation import measure
    from vibrissa.simulation import simulate as simulated
    from vibrissa.simulation.script import EXAMPLE, read_script
    from vibrissa.whisker import Whisker

    if example:
        output.out(EXAMPLE, highlight=False, end="")
        return
    check_writable(path, NETCDF)
    free([path, *(() if film is None else _films(film))], force)
    with progress_bars() as tell:
        tell("how far to whisk", 0, 1)
        with nullcontext() if script is None else in_file(script):
            plan = read_script(
                "" if script is None else read_text(script),
                Path() if script is None else script.parent,
                whisker_from,
                whisker=whisker,
                array=array,
                side=side,
                whiskers=None if whiskers is None else whiskers.replace(",", " ").split(),
                object=thing,
                duration=duration,
                rate=rate,
                frequency=frequency,
                protraction=protraction,
                row=row,
                friction=friction,
                dynamic=dynamic,
                noise=noise,
                seed=seed,
            )
        tell("how far to whisk", 1, 1)
        trial = simulated(
            plan.whisker,
            plan.motion,
            plan.objects,
            friction=plan.friction,
            dynamics=plan.dynamics,
            progress=lambda done, total: tell("whisking trial", done, total),
        )
        trial = measure(trial, seed=plan.seed, sensor=plan.sensor)
        save_recording(path, trial)
    output.print(f"{plan.whisker!r}", highlight=False, soft_wrap=True)
    if isinstance(plan.whisker, Whisker):
        tell_notes(plan.whisker)
    for solid in plan.objects:
        output.print(f"{solid!r}", highlight=False, soft_wrap=True)
    _tell(trial)
    output.print(f"wrote {path}", highlight=False, soft_wrap=True)
    if film is not None:
        _film(trial, path, film, plan.seed)


def _tell(trial: xr.DataTree) -> None:
    """What happened, in a few lines."""
    import numpy as np

    from vibrissa.status import describe

    truth = trial["truth"].to_dataset()
    names = trial.to_dataset()["whisker"].values.tolist()
    for sentence, count in describe(truth["status"].values.ravel()).most_common():
        output.print(f"{count:6d} frames: {sentence}", highlight=False, soft_wrap=True)
    contact = truth["in_contact"].values.astype(bool)
    begun = contact[0].astype(int) + (np.diff(contact.astype(int), axis=0) == 1).sum(axis=0)
    if len(names) > 1:
        touched = [f"{name} {count}" for name, count in zip(names, begun, strict=True) if count]
        who = f"{len(touched)} of {len(names)} whiskers touched; contacts: "
        output.print(who + (", ".join(touched) or "none"), highlight=False, soft_wrap=True)
    largest = [
        shown(name, float(np.nanmax(np.linalg.norm(truth[name].values, axis=-1))), 3)
        for name in ("force", "moment")
    ]
    output.print(
        f"{begun.sum()} contacts, up to {largest[0]} and {largest[1]}",
        highlight=False,
        soft_wrap=True,
    )
    second = int(truth["second_contact"].values.sum())
    if second:
        output.print(
            f"in {second} frames a whisker would touch elsewhere too (second_contact), which is "
            "not in the forces",
            highlight=False,
            soft_wrap=True,
        )


def _films(folder: Path) -> list[Path]:
    """Where the videos of the two views go."""
    return [folder / f"{view}.mkv" for view in ("top", "front")]


def _film(trial: xr.DataTree, path: Path, folder: Path, seed: int) -> None:
    """Film the trial, and add cameras and true traces to the recording."""
    from vibrissa.io import save_recording
    from vibrissa.simulation import film, views_of

    folder.mkdir(parents=True, exist_ok=True)
    cameras = views_of(trial)
    files = dict(zip([camera.name for camera in cameras], _films(folder), strict=True))
    with progress_bars() as tell:
        filmed = film(
            trial,
            files,
            cameras,
            seed=seed,
            progress=lambda done, total: tell("filming", done, total),
        )
        save_recording(path, filmed)
    for file in files.values():
        output.print(f"wrote {file}", highlight=False, soft_wrap=True)
