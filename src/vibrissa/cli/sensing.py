"""`vibrissa sensitivity`: how far the contact point moves when a signal changes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import Force, free, output, progress_bars, shown

if TYPE_CHECKING:
    from rich.table import Table
    from xarray import Dataset


def sensitivity(
    chart: Annotated[Path, typer.Argument(help="The map, NetCDF.", metavar="MAP")],
    triplet: Annotated[
        str, typer.Option(help="The three signals that locate the contact.", metavar="A,B,C")
    ] = "Fx,MB,MD",
    trial: Annotated[
        Path | None,
        typer.Option(
            help="Only the contacts of this recording or table of signals; else all on the map.",
            metavar="FILE",
        ),
    ] = None,
    force_noise: Annotated[
        float, typer.Option(help="Standard deviation of a force component, µN.", min=0.0)
    ] = 1.0,
    moment_noise: Annotated[
        float, typer.Option(help="Standard deviation of a moment component, µN·m.", min=0.0)
    ] = 0.02,
    path: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Everything, NetCDF; SI units.", metavar="FILE"),
    ] = None,
    force: Force = False,
) -> None:
    """Say how the contact point depends on three signals, and which three would be the best.

    Derivatives are exact. Contacts within 2° of rest are left out of the tables, not of the file.
    Example: `vibrissa sensitivity map.nc --triplet Fx,MB,MD -o sensitivity.nc`
    """
    import numpy as np

    from vibrissa.cli.sources import map_from
    from vibrissa.identifiability import best_triplet
    from vibrissa.identifiability import sensitivity as derivatives
    from vibrissa.io.paths import NETCDF, check_writable
    from vibrissa.numerics import contact_weights
    from vibrissa.paper import sensitivity_findings
    from vibrissa.signals import selection

    if path is not None:
        check_writable(path, NETCDF)
        free([path], force)
    names = selection([name.strip() for name in triplet.split(",")], exactly=3)
    contact_map = map_from(chart)
    noise = np.diag(np.repeat([(force_noise * 1e-6) ** 2, (moment_noise * 1e-6) ** 2], 3))
    at = None if trial is None else _contacts_of(trial, moment_noise * 1e-6)
    with progress_bars() as tell:
        tell("derivatives", 0, 2)
        found = derivatives(contact_map, names, at, noise=noise)
        tell("derivatives", 1, 2)
        rivals = best_triplet(contact_map, noise, at)
        tell("derivatives", 2, 2)
    if not contact_weights(found).any():
        raise ValueError(f"{trial or chart} holds no contact farther than 2° from rest")
    output.print(f"{contact_map.whisker!r}", highlight=False, soft_wrap=True)
    output.print(_derivative_table(found, sensitivity_findings(found)))
    output.print(_rival_table(rivals, names, force_noise, moment_noise))
    if path is not None:
        _save(path, found)
        output.print(f"wrote {path}", highlight=False, soft_wrap=True)


def _contacts_of(path: Path, moment_noise: float) -> Dataset:
    """Contact points or, where they are not known, signals of a trial; NaN where nothing is felt.

    As for estimates, a contact is felt where M_B exceeds five standard deviations of its noise.
    """
    from vibrissa.cli.sources import wrench_from
    from vibrissa.io import kind_of, load_recording
    from vibrissa.io.netcdf import is_netcdf
    from vibrissa.pipeline import FELT
    from vibrissa.signals import base_signals

    if is_netcdf(path) and kind_of(path) == "vibrissa recording":
        recording = load_recording(path).to_dataset(inherit=False)
        if "contact_point_whisker" in recording:
            return recording
    wrench, _ = wrench_from(path)
    felt = base_signals(wrench["force"], wrench["moment"])["MB"] > FELT * moment_noise
    return wrench[["force", "moment"]].where(felt)


def _derivative_table(found: Dataset, findings: Dataset) -> Table:
    """Median sizes, where they are large, and what differs between the sides."""
    from rich.table import Table

    from vibrissa.quantities import quantity

    table = Table(
        title="Sensitivity of the contact point",
        caption="medians of absolute values. × small: where that signal is in its smallest fifth, "
        "over where it is in its largest; CB/CF: concave backward over concave forward; motion: "
        "share of the contact's squared motion that goes this way",
        title_justify="left",
        caption_justify="left",
    )
    by = [str(n) for n in findings["sorted_by"].values]
    table.add_column("of")
    headings = [f"× small {n}" for n in by]
    for heading in ("by", "median", "unit", *headings, "CB/CF", "motion"):
        table.add_column(heading, justify="left" if heading in ("by", "unit") else "right")
    for signal in map(str, findings["signal"].values):
        below = quantity(signal)
        for coordinate in ("r", "theta", "phi"):
            above = quantity(coordinate)
            entry = findings.sel(coordinate=coordinate, signal=signal)
            factor = above.display_factor / below.display_factor
            table.add_row(
                {"theta": "θ", "phi": "φ"}.get(coordinate, coordinate),
                signal,
                f"{float(entry['median_size']) * factor:.3g}",
                f"{above.display_unit}/{_bracketed(below.display_unit)}",
                *(_ratio(float(entry["small_over_large"].sel(sorted_by=n))) for n in by),
                _ratio(float(entry["backward_over_forward"])),
                f"{100.0 * float(entry['share_of_motion']):.0f} %",
            )
        table.add_section()
    return table


def _ratio(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"


def _bracketed(unit: str) -> str:
    return f"({unit})" if "·" in unit else unit


def _rival_table(
    rivals: Dataset, names: tuple[str, ...], force_noise: float, moment_noise: float
) -> Table:
    """The triplets that are best most often, and the one that was asked for."""
    import numpy as np
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=f"Which triplet for a sensor with {force_noise:g} µN and {moment_noise:g} µN·m noise",
        caption="3D error (RMS) predicted for small noise; whether a triplet is unique is another "
        "question: vibrissa uniqueness",
        title_justify="left",
        caption_justify="left",
    )
    for heading in ("triplet", "best in", "median error", "where best", "determines"):
        table.add_column(heading, justify="left" if heading == "triplet" else "right")
    order = np.argsort(-rivals["share"].values, kind="stable")
    shown_rows = [i for i in order[:5] if rivals["share"].values[i] > 0.0]
    asked = list(rivals["triplet"].values).index(" ".join(names))
    for i in dict.fromkeys([*shown_rows, asked]):
        row = rivals.isel(triplet=i)
        label = str(row["triplet"].values)
        table.add_row(
            Text(label, style="bold" if i == asked else ""),
            f"{100.0 * float(row['share']):.1f} %",
            _error(float(row["median_error"])),
            _error(float(row["median_error_where_best"])),
            f"{100.0 * float(row['determined']):.1f} %",
        )
    return table


def _error(value: float) -> str:
    return shown("predicted_error", value, 3) if value == value else "-"


def _save(path: Path, found: Dataset) -> None:
    from vibrissa.io.netcdf import COMPRESSED, write_netcdf

    floats = [str(name) for name, v in found.data_vars.items() if v.dtype.kind == "f"]
    about = found.assign_attrs(kind="vibrissa sensitivity")
    write_netcdf(path, about, {"/": dict.fromkeys(floats, COMPRESSED)})
