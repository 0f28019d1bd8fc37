"""The command `vibrissa` and its verbs."""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from rich.text import Text

from vibrissa.cli import (
    bend,
    calibrating,
    charting,
    contouring,
    correcting,
    feeling,
    figures,
    filming,
    information,
    judging,
    locating,
    reporting,
    sensing,
    simulating,
    streaming,
    sweeping,
    tracking,
    viewing,
    whole_job,
)
from vibrissa.cli.sources import about_whisker
from vibrissa.cli.terminal import errors, output

HELP = """From what a whisker feels at its base to what it touched.

Numbers typed and printed are in mm, µN, µN·m and degrees unless an option says otherwise; files
hold SI units. No file that is there is replaced without --force; stages are added to a recording
where it is.
"""

app = typer.Typer(
    help=HELP,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(about_whisker(whole_job.demo))
app.command("deflect")(about_whisker(bend.bend))
app.command("map")(about_whisker(charting.chart))
app.command("uniqueness")(judging.uniqueness)
app.command("simulate")(about_whisker(simulating.simulate))
app.command("track")(about_whisker(tracking.track))
app.command("correct")(correcting.correct)
app.command("calibrate")(calibrating.calibrate)
app.command("sensitivity")(sensing.sensitivity)
app.command("signals")(about_whisker(feeling.signals))
app.command("estimate")(about_whisker(locating.estimate))
app.command("reconstruct")(about_whisker(contouring.reconstruct))
app.command("stream")(about_whisker(streaming.stream))
app.command("figures")(figures.figures)
app.command("view")(about_whisker(viewing.view))
app.command("movie")(filming.movie)
app.command("report")(reporting.report)
app.command("sweep")(sweeping.sweep)
app.command("info")(information.info)


def _version(asked: bool) -> None:
    if asked:
        from vibrissa import __version__

        output.print(f"vibrissa {__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", help="Print the version.", callback=_version, is_eager=True),
    ] = False,
) -> None:
    """Take the options that belong to no verb."""


def main() -> None:
    """Run the command line; a fault of the input is one message and exit status 2."""
    try:
        app()
    except (ValueError, OSError, ModuleNotFoundError) as error:
        said = Text.assemble(("Error:", "bold red"), " ", str(error))
        errors.print(said, highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        errors.print("stopped")
        sys.exit(130)
