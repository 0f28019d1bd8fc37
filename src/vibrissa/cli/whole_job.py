"""`vibrissa demo`: the main job from end to end."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import Tell, output, progress_bars, shown

if TYPE_CHECKING:
    from rich.table import Table

    from vibrissa.demo import DemoResult, ErrorRow, Located, TrackingScores

_NODES = 101
_SENSED = "felt by a sensor"
_SEEN = "the paper's way"


def demo(
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV; by default a built-in γ whisker.", metavar="FILE"),
    ] = None,
    folder: Annotated[
        Path, typer.Option("--output", "-o", help="Where files go.", metavar="DIR")
    ] = Path("vibrissa-demo"),
    full: Annotated[
        bool | None,
        typer.Option(
            "--full/--quick",
            help="3.5 s of video, as in the paper, or half a second.",
            show_default="quick",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the whisks and of the noise.", min=0)] = 0,
    noise: Annotated[
        bool, typer.Option(help="Whether the sensor has noise: 1 µN and 0.02 µN·m.")
    ] = True,
    video: Annotated[
        bool,
        typer.Option(help="Whether the trial is filmed and tracked, or the true pose is taken."),
    ] = True,
    duration: Annotated[
        float | None, typer.Option(help="Of the trial, s, instead of --quick or --full.")
    ] = None,
    rate: Annotated[float, typer.Option(help="Frames per second.")] = 1000.0,
) -> None:
    """Whisk against a peg, film it, feel it at the base, and find the peg again.

    A whisker sweeps past a peg and back before two cameras. Its track tells how its base is held,
    three signals at its base where it touches, and the contact points draw the peg. All stages are
    compared with the truth. Stopped with Ctrl-C it goes on from there when it is called again.
    Example: `vibrissa demo --output try --seed 1`
    """
    from vibrissa.cli.sources import tell_notes, whisker_from
    from vibrissa.demo import run_demo
    from vibrissa.demo.run import DURATION, FULL_DURATION
    from vibrissa.io.paths import check_folder

    if duration is not None and full is not None:
        raise ValueError("give either --duration or one of --full and --quick")
    check_folder(folder)
    chosen = whisker_from(whisker)
    output.print(f"{chosen!r}", highlight=False, soft_wrap=True)
    tell_notes(chosen)
    if duration is None:
        duration = FULL_DURATION if full else DURATION
    with progress_bars() as tell:
        result = run_demo(
            chosen,
            folder,
            seed=seed,
            noise=noise,
            duration=duration,
            rate=rate,
            video=video,
            progress=tell,
        )
        pictures = _pictures(result, folder, tell)
    _report(result, noise)
    for file in (*result.files, *pictures):
        output.print(f"wrote {file}", highlight=False, soft_wrap=True)


def _pictures(result: DemoResult, folder: Path, tell: Tell) -> list[Path]:
    """The figures of the trial, and signals over the space of all contacts."""
    from vibrissa import plots
    from vibrissa.cli.trial_figures import trial_drawings
    from vibrissa.demo.filming import video_files

    videos = [] if result.tracking is None else video_files(folder)
    drawings = trial_drawings(folder / "trial.nc", "double", videos, folder / "map.nc", 0, tell)
    chart = result.contact_map
    line = chart.whisker.centerline(_NODES)
    drawings["signal_space"] = lambda: plots.signal_clouds(chart.to_dataset(), line)
    files = []
    for i, (name, draw) in enumerate(drawings.items()):
        tell("figures", i, len(drawings))
        files += plots.save(draw(), folder / name, formats=("png",))
    tell("figures", len(drawings), len(drawings))
    return files


def _report(result: DemoResult, noise: bool) -> None:
    from vibrissa.evaluation import caution

    sensed = result.sensed
    scores = sensed.scores
    none, one, several = scores.candidates
    felt = shown("MB", sensed.contacts.attrs["felt_above"], 3)
    output.print()
    for line in (
        f"{sensed.contacts.sizes['time']} frames, {scores.touching} in contact",
        f"{scores.felt} contacts felt (M_B over {felt}), {scores.false} of them false",
        f"estimated from ({', '.join(sensed.contacts.attrs['signals'].split())}) only",
        f"{100 * scores.share_with_one:.1f} % have exactly one candidate ({one}); {none} none, as "
        f"noise can have it; {several} several, of which the one that goes on from the frames "
        "around is taken",
    ):
        output.print(line, highlight=False, soft_wrap=True)
    output.print()
    if result.tracking is not None:
        output.print(_tracking_table(result.tracking))
    if result.seen is not None:
        output.print(_signal_table(sensed, result.seen))
    output.print(_table("Error of the contact point", "of", scores.errors, noise, _coordinate))
    output.print(
        _table("3D error by deflection angle", "angle", scores.by_angle, noise, lambda r: r.label)
    )
    if result.seen is not None:
        rows = result.seen.scores.by_angle
        title = f"The same {_SEEN}*, signals and map being of one model"
        output.print(_table(title, "angle", rows, False, lambda r: r.label))
        said = caution(result.seen.contacts.attrs["source"])
        output.print(f"* {said}", highlight=False, soft_wrap=True)
        output.print()
    output.print(_peg_table(result))


def _tracking_table(scores: TrackingScores) -> Table:
    from rich.table import Table

    title = f"Tracking: {scores.lost} of {scores.frames} frames lost, contact told from none in "
    table = Table(title=f"{title}{100 * scores.told:.1f} %", title_justify="left")
    table.add_column("error of")
    for name in ("median", "95 %"):
        table.add_column(name, justify="right")
    for name, pixels in zip(("top", "front"), scores.trace, strict=True):
        table.add_row(f"trace, {name}", *(f"{value:.3f} px" for value in pixels))
    for name, lengths in (
        ("centreline in space", scores.centerline),
        ("base", scores.base),
        ("contact point", scores.contact),
    ):
        table.add_row(name, *(f"{1e6 * value:.1f} µm" for value in lengths))
    return table


def _signal_table(sensed: Located, seen: Located) -> Table:
    """Errors of force and moment by deflection angle, from both sources."""
    from rich.table import Table

    table = Table(title="Signals, median error by deflection angle", title_justify="left")
    table.add_column("angle")
    for name in ("force", "moment"):
        table.add_column(f"{name}: sensor", justify="right")
        table.add_column(_SEEN, justify="right")
    of_seen = {row.label: row for row in seen.signals}
    for row in sensed.signals:
        cells = []
        for name in ("force", "moment"):
            for source in (row, of_seen.get(row.label)):
                error = None if source is None else getattr(source, name)[0]
                cells.append("–" if error is None else f"{100 * error:.2g} %")
        table.add_row(row.label, *cells)
    return table


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
    from rich.text import Text

    found = {_SENSED: result.sensed}
    if result.seen is not None:
        found[_SEEN] = result.seen
    table = Table(title="The peg", title_justify="left", caption_justify="left")
    for name in ("", "fitted", "true", "error", "its sigma"):
        table.add_column(name, justify="right" if name else "left")
    for name, one in found.items():
        fit, scores = one.fit, one.scores
        true = fit.origin - scores.offset
        if len(found) > 1:
            table.add_row(Text(name, style="bold"))
        for i, axis in enumerate("xy"):
            values = (fit.origin[i], true[i], scores.offset[i], fit.origin_sigma[i])
            cells = (f"{1e3 * float(value):.4f} mm" for value in values)
            table.add_row(f"axis, {axis}", *cells)
        lengths = (fit.diameter, 2 * result.peg.radius, scores.diameter_error, fit.diameter_sigma)
        table.add_row("diameter", *(f"{1e3 * float(value):.4f} mm" for value in lengths))
        table.add_row("tilt", "", "", shown("base_azimuth", scores.tilt, 2), "")
        table.add_section()
    away = shown("peg_position", float((result.sensed.scores.offset**2).sum() ** 0.5), 2)
    table.caption = f"its axis, {_SENSED}, is {away} from the true one"
    return table
