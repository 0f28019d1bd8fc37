"""`vibrissa demo`: the main job from end to end."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import output, progress_bars, shown

if TYPE_CHECKING:
    from rich.table import Table

    from vibrissa.demo import DemoResult, ErrorRow


def demo(
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV; by default a built-in γ whisker.", metavar="FILE"),
    ] = None,
    folder: Annotated[
        Path, typer.Option("--output", "-o", help="Where files go.", metavar="DIR")
    ] = Path("vibrissa-demo"),
    seed: Annotated[int, typer.Option(help="Of the whisks and of the noise.")] = 0,
    noise: Annotated[
        bool, typer.Option(help="Whether the sensor has noise: 1 µN and 0.02 µN·m.")
    ] = True,
    duration: Annotated[float, typer.Option(help="Of the trial, s.")] = 3.0,
    rate: Annotated[float, typer.Option(help="Frames per second.")] = 1000.0,
) -> None:
    """Whisk against a peg, feel it at the base, and find it again.

    A whisker sweeps past a peg and back; from three signals at its base come contact points, and
    from those the peg. Example: `vibrissa demo --output try --seed 1`
    """
    from vibrissa.cli.sources import whisker_from
    from vibrissa.demo import run_demo
    from vibrissa.io.paths import check_folder

    check_folder(folder)
    chosen = whisker_from(whisker)
    output.print(f"{chosen!r}", highlight=False, soft_wrap=True)
    with progress_bars() as tell:
        result = run_demo(
            chosen,
            folder,
            seed=seed,
            noise=noise,
            duration=duration,
            rate=rate,
            progress=tell,
        )
    _report(result, noise)


def _report(result: DemoResult, noise: bool) -> None:
    scores = result.scores
    none, one, several = scores.candidates
    felt = shown("MB", result.contacts.attrs["felt_above"], 3)
    output.print()
    for line in (
        f"{result.contacts.sizes['time']} frames, {scores.touching} in contact",
        f"{scores.felt} contacts felt (M_B over {felt}), {scores.false} of them false",
        f"estimated from ({', '.join(result.contacts.attrs['triplet'].split())}) only",
        f"{100 * scores.share_with_one:.1f} % have exactly one candidate ({one}); {none} none, as "
        f"noise can have it; {several} several, of which the one that goes on from the frames "
        "around is taken",
    ):
        output.print(line, highlight=False, soft_wrap=True)
    output.print()
    output.print(_table("Error of the contact point", "of", scores.errors, noise, _coordinate))
    output.print(
        _table("3D error by deflection angle", "angle", scores.by_angle, noise, lambda r: r.label)
    )
    output.print(_peg_table(result))
    for file in result.files:
        output.print(f"wrote {file}", highlight=False, soft_wrap=True)


def _coordinate(row: ErrorRow) -> str:
    return {"error_r": "r", "error_theta": "θ", "error_phi": "φ"}.get(row.quantity, "3D")


def _table(title: str, first: str, rows: tuple[ErrorRow, ...], noise: bool, label: object) -> Table:
    """Errors as measured and, with noise, as predicted."""
    from rich.table import Table

    assert callable(label)
    table = Table(title=title, title_justify="left", caption_justify="left")
    for name, side in ((first, "left"), ("contacts", "right")):
        table.add_column(name, justify="left" if side == "left" else "right")
    for name in ("median", "95 %", "largest"):
        table.add_column(name, justify="right")
    if noise:
        table.caption = "* what the estimates' own covariance predicts"
        for name in ("median*", "95 %*"):
            table.add_column(name, justify="right", style="cyan")
    for row in rows:
        values = [*row.measured, *(row.predicted[:2] if noise else ())]
        cells = [shown(row.quantity, float(value), 3) for value in values]
        table.add_row(label(row), str(row.contacts), *cells)
    return table


def _peg_table(result: DemoResult) -> Table:
    """The peg, fitted and true."""
    from rich.table import Table

    fit, peg, scores = result.fit, result.peg, result.scores
    away = shown("peg_position", float((scores.offset**2).sum() ** 0.5), 2)
    table = Table(title="The peg", title_justify="left", caption_justify="left")
    for name in ("", "fitted", "true", "error", "its sigma"):
        table.add_column(name, justify="right" if name else "left")
    true = fit.origin - scores.offset
    for i, name in enumerate("xy"):
        values = (fit.origin[i], true[i], scores.offset[i], fit.origin_sigma[i])
        cells = (f"{1e3 * float(value):.4f} mm" for value in values)
        table.add_row(f"axis, {name}", *cells)
    diameters = (fit.diameter, 2 * peg.radius, scores.diameter_error, fit.diameter_sigma)
    table.add_row("diameter", *(f"{1e3 * float(value):.4f} mm" for value in diameters))
    table.add_row("tilt", "", "", shown("base_azimuth", scores.tilt, 2), "")
    table.caption = f"its axis is {away} from the true one"
    return table
