"""`vibrissa map`: all contacts of a whisker, and what they feel like."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vibrissa.cli.terminal import output, progress_bars


def chart(
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV; by default a built-in γ whisker.", metavar="FILE"),
    ] = None,
    path: Annotated[
        Path, typer.Option("--output", "-o", help="The map, NetCDF.", metavar="FILE")
    ] = Path("map.nc"),
    grid: Annotated[
        bool, typer.Option(help="Whether the paper's grid of 237,765 points is solved too.")
    ] = True,
) -> None:
    """Chart all stable contacts of a whisker, and the paper's grid.

    Example: `vibrissa map --whisker C1.csv -o map.nc`
    """
    from vibrissa.cli.sources import whisker_from
    from vibrissa.io.paths import NETCDF, check_writable
    from vibrissa.mapping import ContactMap

    check_writable(path, NETCDF)
    chosen = whisker_from(whisker)
    with progress_bars() as tell:
        tell("map of all contacts", 0, 1)
        contacts = ContactMap.simulate(
            chosen, grid=grid, progress=lambda done, total: tell("map of all contacts", done, total)
        )
        tell("map of all contacts", 1, 1)
        contacts.save(path)
    output.print(repr(contacts), highlight=False, soft_wrap=True)
    output.print(f"wrote {path}", highlight=False, soft_wrap=True)
