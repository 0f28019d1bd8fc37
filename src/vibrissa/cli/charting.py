"""`vibrissa map`: all contacts of a whisker, and what they feel like."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vibrissa.cli.assumptions import Proximal, smallest_arc
from vibrissa.cli.terminal import Force, free, output, progress_bars

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker


def chart(
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV; by default a built-in γ whisker.", metavar="FILE"),
    ] = None,
    length: Annotated[
        float | None,
        typer.Option(help="Instead: of a straight whisker, mm.", min=0.0, metavar="MM"),
    ] = None,
    base_radius: Annotated[
        float | None, typer.Option(help="At the base, µm.", min=0.0, metavar="µM")
    ] = None,
    tip_radius: Annotated[
        float | None,
        typer.Option(help="At the tip, µm; by default 1/15 of the base's.", min=0.0, metavar="µM"),
    ] = None,
    modulus: Annotated[
        float | None, typer.Option(help="Young's modulus, GPa.", min=0.0, metavar="GPA")
    ] = None,
    poisson: Annotated[float | None, typer.Option(help="Poisson's ratio.", metavar="RATIO")] = None,
    proximal: Proximal = None,
    path: Annotated[
        Path, typer.Option("--output", "-o", help="The map, NetCDF.", metavar="FILE")
    ] = Path("map.nc"),
    grid: Annotated[
        bool, typer.Option(help="Whether the paper's grid of 237,765 points is solved too.")
    ] = True,
    force: Force = False,
) -> None:
    """Chart all stable contacts of a whisker, and the paper's grid.

    Radii, modulus and ratio are those of the file or, where not given, of an average whisker.
    Example: `vibrissa map --whisker C1.csv -o map.nc`; steel wire:
    `vibrissa map --length 300 --base-radius 500 --tip-radius 250 --modulus 200 --poisson 0.29`
    """
    from vibrissa.cli.sources import stated, tell_notes, whisker_from
    from vibrissa.contacts import ContactMap
    from vibrissa.io.paths import NETCDF, check_writable
    from vibrissa.whisker import Whisker

    check_writable(path, NETCDF)
    free([path], force)
    if length is not None and whisker is not None:
        raise ValueError("give either --whisker or the --length of a straight one")
    if length is None:
        chosen = whisker_from(whisker)
    else:
        chosen = Whisker.straight(1e-3 * length, **stated())
    chosen = _made(chosen, base_radius, tip_radius, modulus, poisson)
    tell_notes(chosen)
    with progress_bars() as tell:
        tell("map of all contacts", 0, 1)
        contact_map = ContactMap.simulate(
            chosen,
            grid=grid,
            progress=lambda done, total: tell("map of all contacts", done, total),
            proximal=smallest_arc(proximal),
        )
        tell("map of all contacts", 1, 1)
        contact_map.save(path)
    output.print(repr(contact_map), highlight=False, soft_wrap=True)
    output.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _made(
    whisker: Whisker,
    base_radius: float | None,
    tip_radius: float | None,
    modulus: float | None,
    poisson: float | None,
) -> Whisker:
    """The same shape of another thickness or material."""
    changes: dict[str, Any] = {}
    if base_radius is not None or tip_radius is not None:
        base = whisker.base_radius if base_radius is None else 1e-6 * base_radius
        changes["base_radius"] = base
        changes["tip_radius"] = base / 15.0 if tip_radius is None else 1e-6 * tip_radius
    if modulus is not None:
        changes["youngs_modulus"] = 1e9 * modulus
    if poisson is not None:
        changes["poisson_ratio"] = poisson
    return whisker.with_properties(**changes) if changes else whisker
