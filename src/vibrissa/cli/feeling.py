"""`vibrissa signals`: what a whisker's base feels, from a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.terminal import Force, output, progress_bars, refuse, shown

if TYPE_CHECKING:
    import xarray as xr


def signals(
    recording: Annotated[
        Path,
        typer.Argument(help="A recording that was tracked or simulated, .nc.", metavar="TRIAL.nc"),
    ],
    path: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Where the recording goes with the signals added, .nc, by default to where it "
            "is; or the signals of its one whisker as a table, .csv.",
            metavar="FILE",
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            help="What they come from: contact point (the paper's way), rod (that fits the "
            "images) or sensor; by default the sensor if there is one, or else the contact point.",
            metavar="SOURCE",
        ),
    ] = None,
    cutoff: Annotated[
        float | None,
        typer.Option(
            help="Low pass of the pose the contact point is seen from, Hz; 85 by default, 0: none."
        ),
    ] = None,
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV, if the recording has no whisker.", metavar="FILE"),
    ] = None,
    force: Force = False,
) -> None:
    """Find force, moment and the six signals at the base in every frame.

    They are added to the recording as a group `signals`; what it already holds stays, but estimates
    and a contour that were made of other signals are left out. Example: `vibrissa signals trial.nc`
    """
    from vibrissa.cli.recordings import (
        free_beside,
        recording_from,
        say,
        tell_statuses,
        tell_written,
    )
    from vibrissa.cli.sources import tell_notes
    from vibrissa.io import save_recording, save_signals
    from vibrissa.io.paths import CSV, NETCDF, check_writable
    from vibrissa.pipeline import with_signals

    target = recording if path is None else path
    check_writable(target, (*NETCDF, *CSV))
    free_beside(recording, [target], force)
    tree = recording_from(recording)
    table = target.suffix.lower() in CSV
    if table and tree.sizes["whisker"] != 1:
        raise ValueError(
            f"{recording} is a recording of {tree.sizes['whisker']} whiskers; a table has those of "
            "one: give an --output that ends in .nc"
        )
    with progress_bars() as tell:
        tell("signals", 0, 1)
        options = signal_options(tree, source, cutoff, whisker)
        if options["whiskers"] is None:
            refuse({"--whisker": whisker}, f"signals of the {options['source']} need none")
        done = with_signals(tree, **options)
        tell("signals", 1, 1)
    tell_notes(*(options["whiskers"] or ()))
    say(described(done))
    found = done["signals"].to_dataset()
    tell_statuses(found["status"].values)
    _tell_largest(found)
    if table:
        save_signals(target, found.isel(whisker=0)[["force", "moment"]])
    else:
        save_recording(target, done)
    tell_written(target, recording, "signals")


def signal_options(
    tree: xr.DataTree, source: str | None, cutoff: float | None, whisker: Path | None
) -> dict[str, Any]:
    """Turn options of the command line into those of `signals_of`."""
    from vibrissa.cli.recordings import whiskers_for
    from vibrissa.pipeline import default_source
    from vibrissa.tracking.filtering import CUTOFF

    chosen = default_source(tree) if source is None else source.strip().replace("-", " ")
    if chosen != "contact point":
        if chosen in ("rod", "sensor"):
            refuse({"--cutoff": cutoff}, f"signals of the {chosen} have a pose of their own")
        return {"source": chosen, "whiskers": None}
    wanted = CUTOFF if cutoff is None else cutoff or None
    return {"source": chosen, "cutoff": wanted, "whiskers": whiskers_for(tree, whisker)}


def described(tree: xr.DataTree) -> str:
    """Say what signals come from."""
    about = tree["signals"].attrs
    source = str(about.get("source", "a source not known"))
    if source == "sensor":
        return "signals as the sensor read them"
    if source == "rod":
        return "signals of the rod that fits the images"
    cutoff = about.get("cutoff")
    filtered = "not filtered" if cutoff is None else f"filtered at {float(cutoff):g} Hz"
    modulus = (
        [
            float(group.to_dataset(inherit=False)["youngs_modulus"]) / 1e9
            for group in tree["whiskers"].children.values()
        ]
        if "whiskers" in tree.children
        else []
    )
    of = f", Young's modulus {modulus[0]:g} GPa" if modulus else ""
    return f"signals from the tracked contact point; the base's pose is {filtered}{of}"


def _tell_largest(found: xr.Dataset) -> None:
    import numpy as np

    for k, name in enumerate(found["whisker"].values):
        one = found.isel(whisker=k)
        with np.errstate(invalid="ignore"):
            largest = [
                shown(n, float(np.nanmax(np.linalg.norm(one[n].values, axis=-1), initial=0.0)), 3)
                for n in ("force", "moment")
            ]
        line = f"{name}: in contact in {int(one['in_contact'].sum())} of {one.sizes['time']} frames"
        output.print(
            f"{line}, up to {largest[0]} and {largest[1]}", highlight=False, soft_wrap=True
        )
