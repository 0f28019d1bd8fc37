"""`vibrissa view`: look at a whisker, a map or a trial in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vibrissa.cli.terminal import output


def view(
    path: Annotated[
        Path | None,
        typer.Argument(
            help="A whisker (CSV or NetCDF), a map or a trial (NetCDF); by default the built-in γ "
            "whisker.",
            metavar="[WHISKER | MAP | TRIAL]",
        ),
    ] = None,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on; 0.0.0.0 lets other machines in.", metavar="HOST"),
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(help="Port to listen on; by default the first free one from 8080."),
    ] = None,
    browser: Annotated[bool, typer.Option(help="Whether the browser is opened.")] = True,
) -> None:
    """Bend a whisker with the mouse and see what it feels.

    Serves a page on this machine until Ctrl-C. Example: `vibrissa view whisker.csv`
    """
    from vibrissa.cli.sources import whisker_from
    from vibrissa.viewer import view as serve

    with serve(whisker_from(path), host=host, port=port) as viewer:
        output.print(f"{viewer.url}   Ctrl-C ends it", highlight=False, soft_wrap=True)
        if browser:
            import webbrowser

            webbrowser.open(viewer.url)
        try:
            viewer.wait()
        except KeyboardInterrupt:
            output.print("stopped")
