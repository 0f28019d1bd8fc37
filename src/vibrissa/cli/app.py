"""Command `vibrissa` with its verbs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated

import typer
from rich.text import Text

import vibrissa as vb
from vibrissa.cli.batch import batch
from vibrissa.cli.calibrate import calibrate
from vibrissa.cli.correct import correct
from vibrissa.cli.deflect import deflect
from vibrissa.cli.demo import demo
from vibrissa.cli.estimate import estimate
from vibrissa.cli.export import export
from vibrissa.cli.figures import figures
from vibrissa.cli.import_ import import_tracks
from vibrissa.cli.info import info
from vibrissa.cli.map import simulate_map
from vibrissa.cli.movie import movie
from vibrissa.cli.reconstruct import reconstruct
from vibrissa.cli.report import report
from vibrissa.cli.sensitivity import sensitivity
from vibrissa.cli.signals import signals
from vibrissa.cli.simulate import simulate
from vibrissa.cli.stream import stream
from vibrissa.cli.sweep import sweep
from vibrissa.cli.terminal import (
    errors,
    output,
    remark,
    repeat_lost_interrupts,
    spell_out,
    warnings_as_notes,
)
from vibrissa.cli.track import track
from vibrissa.cli.uniqueness import uniqueness
from vibrissa.cli.view import view

HELP = """From the forces at a whisker's base to what it touched.

Lengths typed and printed are in mm, forces in µN, moments in µN·m and angles in degrees; files hold
SI units. Existing files are not replaced without --force; stages are added to the recording itself.
"""

# Verbs, in the order in which they are listed.
VERBS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "deflect": deflect,
    "map": simulate_map,
    "uniqueness": uniqueness,
    "sensitivity": sensitivity,
    "simulate": simulate,
    "track": track,
    "import": import_tracks,
    "calibrate": calibrate,
    "correct": correct,
    "signals": signals,
    "estimate": estimate,
    "reconstruct": reconstruct,
    "export": export,
    "batch": batch,
    "figures": figures,
    "movie": movie,
    "report": report,
    "view": view,
    "stream": stream,
    "sweep": sweep,
    "info": info,
}
app = typer.Typer(
    help=HELP,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _name, _verb in VERBS.items():
    app.command(_name)(_verb)


def _version(asked: bool) -> None:
    if asked:
        output.print(f"vibrissa {vb.__version__}", highlight=False)
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Process the options that precede the verb."""


def main() -> None:
    """Run the command line; an error of the input gives one message and exit status 2."""
    spell_out()
    repeat_lost_interrupts()
    try:
        with warnings_as_notes():
            app()
    except (ValueError, OSError, ModuleNotFoundError) as error:
        message = Text.assemble(("Error:", "bold red"), " ", str(error))
        errors.print(message, highlight=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        remark("stopped")
        sys.exit(130)
