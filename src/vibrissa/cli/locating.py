"""`vibrissa estimate`: from signals to contact points."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import errors, output, progress_bars, shown

if TYPE_CHECKING:
    from xarray import Dataset

    from vibrissa.mapping import ContactMap
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
        str, typer.Option(help="The three signals to use.", metavar="A,B,C")
    ] = "Fx,MB,MD",
    force_noise: Annotated[
        float, typer.Option(help="Standard deviation of a force component, µN.", min=0.0)
    ] = 1.0,
    moment_noise: Annotated[
        float, typer.Option(help="Standard deviation of a moment component, µN·m.", min=0.0)
    ] = 0.02,
    path: Annotated[
        Path, typer.Option("--output", "-o", help="The contacts, CSV.", metavar="FILE")
    ] = Path("contacts.csv"),
) -> None:
    """Find the contact point for each row of signals, with its uncertainty.

    Rows in which nothing is felt (M_B within five standard deviations of zero) have the status
    no_contact. Example: `vibrissa estimate signals.csv --map map.nc -o contacts.csv`
    """
    from vibrissa.cli.sources import wrench_from
    from vibrissa.demo import contact_columns, locate
    from vibrissa.io import save_contacts
    from vibrissa.io.paths import CSV, check_writable
    from vibrissa.signals import selection
    from vibrissa.status import describe

    check_writable(path, CSV)
    names = selection([name.strip() for name in triplet.split(",")], exactly=3)
    wrench, carried = wrench_from(signals)
    with progress_bars() as tell:
        contacts = _map(chart, whisker, carried, tell)
        _check_scale(signals, wrench, contacts.whisker)
        tell("contact points", 0, 1)
        found = locate(
            contacts,
            wrench,
            names,
            force_noise=force_noise * 1e-6,
            moment_noise=moment_noise * 1e-6,
        )
        tell("contact points", 1, 1)
    save_contacts(path, contact_columns(found))
    errors.print(
        f"triplet ({', '.join(names)}); noise {force_noise:g} µN and {moment_noise:g} µN·m; "
        f"contacts are felt where M_B exceeds {shown('MB', found.attrs['felt_above'])}",
        highlight=False,
        soft_wrap=True,
    )
    for sentence, count in describe(found["status"].values).most_common():
        output.print(f"{count:6d}  {sentence}", highlight=False, soft_wrap=True)
    output.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _check_scale(path: Path, wrench: Dataset, whisker: Whisker) -> None:
    from vibrissa.io.signals_table import check_scale

    try:
        check_scale(wrench, whisker)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from None


def _map(
    chart: Path | None, whisker: Path | None, carried: Whisker | None, tell: object
) -> ContactMap:
    """Read the map, or simulate that of the whisker, and say which."""
    from vibrissa.cli.sources import map_from, whisker_from
    from vibrissa.mapping import ContactMap

    if chart is not None and whisker is not None:
        raise ValueError("give either --map or --whisker: a map already has its whisker")
    if chart is not None:
        return map_from(chart)
    chosen = carried if carried is not None and whisker is None else whisker_from(whisker)
    errors.print(f"no map given; simulating that of {chosen!r}", highlight=False, soft_wrap=True)
    assert callable(tell)
    tell("map of all contacts", 0, 1)
    contacts = ContactMap.simulate(chosen, grid=False)
    tell("map of all contacts", 1, 1)
    return contacts
