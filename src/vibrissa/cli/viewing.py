"""`vibrissa view`: look at a whisker, a map or a trial in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import output

if TYPE_CHECKING:
    import xarray as xr

    from vibrissa.contacts import ContactMap
    from vibrissa.whisker import Whisker


def view(
    path: Annotated[
        Path | None,
        typer.Argument(
            help="A whisker (CSV or NetCDF), a map or a trial (NetCDF); by default the built-in γ "
            "whisker.",
            metavar="[WHISKER | MAP | TRIAL]",
        ),
    ] = None,
    videos: Annotated[
        list[Path] | None,
        typer.Option(
            "--video",
            help="Of a trial: the video of each of its cameras, in their order.",
            metavar="FILE",
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
    """Bend a whisker with the mouse and see what it feels; look at a map; watch a trial.

    Serves a page on this machine until Ctrl-C. Example: `vibrissa view trial.nc --video top.mp4
    --video front.mp4`
    """
    from vibrissa.cli.sources import map_from, refuse_stated, tell_notes, whisker_from
    from vibrissa.io import is_netcdf, kind_of, load_recording
    from vibrissa.viewer import view as serve

    kind = kind_of(path) if path is not None and is_netcdf(path) else ""
    shown: Whisker | ContactMap | xr.DataTree
    if kind in ("vibrissa contact map", "vibrissa recording"):
        refuse_stated(path)
    if kind == "vibrissa contact map" and path is not None:
        shown = map_from(path)
    elif kind == "vibrissa recording" and path is not None:
        shown = load_recording(path)
    else:
        shown = whisker_from(path)
        tell_notes(shown)
    try:
        with serve(shown, videos=videos or (), host=host, port=port) as viewer:
            output.print(f"{viewer.url}   Ctrl-C ends it", highlight=False, soft_wrap=True)
            if browser:
                import webbrowser

                webbrowser.open(viewer.url)
            viewer.wait()
    except KeyboardInterrupt:
        output.print("stopped")
