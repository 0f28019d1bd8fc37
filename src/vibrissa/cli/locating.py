"""`vibrissa estimate`: from signals to contact points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import errors, output, progress_bars, shown

if TYPE_CHECKING:
    from xarray import Dataset

    from vibrissa.mapping import ContactMap
    from vibrissa.rod.arrays import Array
    from vibrissa.whisker import Whisker


def estimate(
    signals: Annotated[
        Path,
        typer.Argument(
            help="Table with time, Fx, Fy, Fz, Mx, My, Mz in SI units, or a recording.",
            metavar="SIGNALS",
        ),
    ],
    chart: Annotated[
        Path | None,
        typer.Option("--map", help="Of the whisker; simulated if not given.", metavar="FILE"),
    ] = None,
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV, where no map is given.", metavar="FILE"),
    ] = None,
    triplet: Annotated[
        str,
        typer.Option(
            "--signals",
            "--triplet",
            help="The signals to use, three or more of Fx, FT, FD, Mx, MB, MD.",
            metavar="A,B,C",
        ),
    ] = "Fx,MB,MD",
    method: Annotated[
        str,
        typer.Option(
            help="exact; or, of three signals, as the paper did: lookup or lookup-linear, in the "
            "map's grid, or network, trained first (ten seconds). These give one contact where "
            "there are several."
        ),
    ] = "exact",
    all_six: Annotated[
        bool,
        typer.Option(
            "--wrench", help="Use force and moment whole, without assuming that nothing rubs."
        ),
    ] = False,
    force_noise: Annotated[
        float, typer.Option(help="Standard deviation of a force component, µN.", min=0.0)
    ] = 1.0,
    moment_noise: Annotated[
        float, typer.Option(help="Standard deviation of a moment component, µN·m.", min=0.0)
    ] = 0.02,
    noise: Annotated[
        Path | None,
        typer.Option(
            help="Instead: covariance of Fx, Fy, Fz, Mx, My, Mz, six lines of six numbers, in SI "
            "units.",
            metavar="FILE",
        ),
    ] = None,
    path: Annotated[
        Path, typer.Option("--output", "-o", help="The contacts, CSV.", metavar="FILE")
    ] = Path("contacts.csv"),
) -> None:
    """Find the contact point for each row of signals, with its uncertainty.

    From three signals all contacts that give them exactly, from more by least squares; with
    --wrench whatever the friction, and no map is needed. Rows in which nothing is felt (M_B within
    five standard deviations of zero) have the status no_contact.
    Example: `vibrissa estimate signals.csv --map map.nc --signals Fx,FT,MB,MD -o contacts.csv`
    """
    from vibrissa.cli.sources import wrench_from
    from vibrissa.io import save_contacts
    from vibrissa.io.paths import CSV, check_writable
    from vibrissa.pipeline import contact_columns, locate, locate_from_wrench
    from vibrissa.signals import selection
    from vibrissa.status import describe

    check_writable(path, CSV)
    names = selection(triplet)
    _check_method(method, names, all_six)
    covariance, said = _noise(noise, force_noise, moment_noise)
    wrench, carried = wrench_from(signals)
    with progress_bars() as tell:
        if all_six:
            touched = _whisker(chart, whisker, carried)
            _check_scale(signals, wrench, touched)
            tell("contact points", 0, 1)
            found = locate_from_wrench(touched, wrench, covariance)
        else:
            contacts = _map(chart, whisker, carried, tell, grid=method.startswith("lookup"))
            _check_scale(signals, wrench, contacts.whisker)
            tell("contact points", 0, 1)
            found = locate(contacts, wrench, names, noise=covariance, method=method)
        tell("contact points", 1, 1)
    save_contacts(path, contact_columns(found))
    used = "force and moment whole" if all_six else f"signals ({', '.join(names)})"
    if method != "exact":
        used += f" by {method}"
    errors.print(
        f"{used}; {said}; "
        f"contacts are felt where M_B exceeds {shown('MB', found.attrs['felt_above'])}",
        highlight=False,
        soft_wrap=True,
    )
    for sentence, count in describe(found["status"].values).most_common():
        output.print(f"{count:6d}  {sentence}", highlight=False, soft_wrap=True)
    output.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _check_method(method: str, names: tuple[str, ...], all_six: bool) -> None:
    from vibrissa.mapping.approximation import APPROXIMATE

    if method not in ("exact", *APPROXIMATE):
        allowed = ", ".join(("exact", *APPROXIMATE))
        raise ValueError(f"--method is {method!r}; one of {allowed} is needed")
    if method == "exact":
        return
    if all_six:
        raise ValueError(f"--wrench uses force and moment whole; it has no --method {method}")
    if len(names) != 3:
        raise ValueError(
            f"--method {method} takes three signals; got {len(names)}: {', '.join(names)}"
        )


def _noise(path: Path | None, force_noise: float, moment_noise: float) -> tuple[Array, str]:
    """Covariance of force and moment, SI units, and how it was given."""
    import numpy as np

    from vibrissa.io.table import read_text, table_rows
    from vibrissa.pipeline import component_noise

    if path is None:
        covariance = component_noise(force_noise * 1e-6, moment_noise * 1e-6)
        return covariance, f"noise {force_noise:g} µN and {moment_noise:g} µN·m"
    try:
        rows = [[float(cell) for cell in cells] for _, cells in table_rows(read_text(path))]
        covariance = np.array(rows, dtype=np.float64)
    except ValueError as fault:
        raise ValueError(f"{path} is no covariance: {fault}") from None
    if covariance.shape != (6, 6):
        raise ValueError(f"{path} must hold six lines of six numbers; got {covariance.shape}")
    return covariance, f"noise of {path}"


def _whisker(chart: Path | None, whisker: Path | None, carried: Whisker | None) -> Whisker:
    """The whisker of a map, a file or a recording."""
    from vibrissa.cli.sources import map_from, whisker_from

    if chart is not None and whisker is not None:
        raise ValueError("give either --map or --whisker: a map already has its whisker")
    if chart is not None:
        return map_from(chart).whisker
    return carried if carried is not None and whisker is None else whisker_from(whisker)


def _check_scale(path: Path, wrench: Dataset, whisker: Whisker) -> None:
    from vibrissa.io.signals_table import check_scale

    try:
        check_scale(wrench, whisker)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from None


def _map(
    chart: Path | None, whisker: Path | None, carried: Whisker | None, tell: object, grid: bool
) -> ContactMap:
    """Read the map, or simulate that of the whisker, and say which; with the grid if needed."""
    from vibrissa.cli.sources import map_from
    from vibrissa.mapping import ContactMap

    if chart is not None and whisker is None:
        contacts = map_from(chart)
        if grid and contacts.grid is None:
            raise ValueError(
                f"{chart} has no grid to look up in: make it by `vibrissa map` without --no-grid"
            )
        return contacts
    chosen = _whisker(chart, whisker, carried)
    errors.print(f"no map given; simulating that of {chosen!r}", highlight=False, soft_wrap=True)
    assert callable(tell)
    tell("map of all contacts", 0, 1)
    contacts = ContactMap.simulate(chosen, grid=grid)
    tell("map of all contacts", 1, 1)
    return contacts
