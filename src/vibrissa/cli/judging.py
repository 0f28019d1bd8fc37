"""`vibrissa uniqueness`: which signals locate a contact."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import Force, free, output, progress_bars

if TYPE_CHECKING:
    from xarray import Dataset

# Enough for the signals to agree to 1e-10 when the pair is bent again.
_DIGITS = 14


def uniqueness(
    chart: Annotated[Path, typer.Argument(help="The map, NetCDF.", metavar="MAP")],
    triplets: Annotated[
        list[str] | None,
        typer.Option(
            "--triplet", help="Only this one; may be repeated. Default: all 20.", metavar="A,B,C"
        ),
    ] = None,
    regions: Annotated[
        list[str] | None,
        typer.Option(
            "--region",
            help="all, ELD, CF, CB, 'ELD CF' or 'ELD CB'; may be repeated. Default: all six.",
            metavar="REGION",
        ),
    ] = None,
    domain: Annotated[
        str, typer.Option(help="reachable: all contacts; paper: those within the paper's grid.")
    ] = "reachable",
    cone: Annotated[
        float,
        typer.Option(help="Contacts within this angle about rest are left out, degrees.", min=0.0),
    ] = 2.0,
    min_separation: Annotated[
        float,
        typer.Option(help="Contacts nearer to each other count as one; share of the length."),
    ] = 0.025,
    samples: Annotated[int, typer.Option(help="How many contacts are tried.", min=16)] = 4096,
    resolution: Annotated[
        bool, typer.Option(help="Whether to tell how finely signals must be measured.")
    ] = True,
    network: Annotated[
        bool,
        typer.Option(
            "--network", help="Also train a network for each triplet, as the paper did; slow."
        ),
    ] = False,
    path: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="All evidence, .nc or .csv.", metavar="FILE"),
    ] = None,
    force: Force = False,
) -> None:
    """Tell which triplets of signals locate the contact uniquely, with witnesses where not.

    Example: `vibrissa uniqueness map.nc -o uniqueness.nc`
    """
    import numpy as np

    from vibrissa.cli.sources import map_from
    from vibrissa.identifiability import save_uniqueness, verdict_table
    from vibrissa.identifiability import uniqueness as judge
    from vibrissa.identifiability.summary import ENDINGS
    from vibrissa.io.paths import check_writable
    from vibrissa.paper import with_network_errors

    if path is not None:
        check_writable(path, ENDINGS)
        free([path], force)
    contact_map = map_from(chart)
    with progress_bars() as tell:
        tell("verdicts", 0, 1)
        found = judge(
            contact_map,
            triplets or "all",
            regions or "all",
            cone=float(np.deg2rad(cone)),
            domain=domain,  # type: ignore[arg-type]
            min_separation=min_separation,
            samples=samples,
            resolution=resolution,
            progress=lambda done, total: tell("verdicts", done, total),
        )
        if network:
            found = with_network_errors(
                contact_map, found, progress=lambda done, total: tell("networks", done, total)
            )
    output.print(f"{contact_map.whisker!r}\n", highlight=False, soft_wrap=True)
    output.print(verdict_table(found), highlight=False, soft_wrap=True, markup=False)
    _print_witness(found)
    if path is not None:
        save_uniqueness(found, path)
        output.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _print_witness(found: Dataset) -> None:
    """One witness in numbers, so that it can be bent again."""
    import numpy as np

    from vibrissa.cli.terminal import shown

    apart = found["witness_separation"].isel(witness=0).max("region").to_series().dropna()
    if apart.empty:
        return
    # Of the triplet that people ask about, if it has one.
    triplet = "Fx MB MD" if "Fx MB MD" in apart.index else str(apart.index[0])
    row = found.sel(triplet=triplet).isel(witness=0)
    cell = row.isel(region=int(np.nanargmax(row["witness_separation"].values)))
    lines = [
        f"\nA witness for ({triplet.replace(' ', ', ')}), {cell['region'].item()}: two contacts "
        f"{shown('contact_point', float(cell['witness_separation']))} apart that feel the same, "
        f"with {int(cell['witness_steps'])} integration steps."
    ]
    for pair in ("first", "second"):
        one = cell.sel(pair=pair)
        fy, fz = one["witness_contact_force"].values
        lines.append(
            f"  at {shown('arc_length', float(one['witness_arc_length']), _DIGITS)} with the force "
            f"({shown('Fx', fy, _DIGITS)}, {shown('Fx', fz, _DIGITS)}) along d1 and d2"
        )
    values = zip(triplet.split(), cell["witness_signals"].values, strict=True)
    lines.append("  " + ", ".join(f"{name} {shown(name, value, 10)}" for name, value in values))
    output.print("\n".join(lines), highlight=False, soft_wrap=True)
