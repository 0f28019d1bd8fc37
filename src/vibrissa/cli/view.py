"""`vibrissa view`: interactive view of a whisker, a map or a trial in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import vibrissa as vb
from vibrissa.cli.inputs import MAP, RECORDING, WhiskerOptions, kind_in, print_notes, recording_from
from vibrissa.cli.options import refuse, with_options
from vibrissa.cli.terminal import say
from vibrissa.deferred import xr


@with_options()
def view(
    path: Path | None = None,
    videos: list[Path] | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
    browser: bool = True,
    rat: str | None = None,
    any_length: bool = False,
    base_end: Literal["first", "last"] | None = None,
    live: str | None = None,
) -> None:
    """Bend a whisker with the mouse and view its signals, or view a map or a trial.

    Serves a page on this machine until Ctrl-C. Example: `vibrissa view trial.nc --video top.mp4
    --video front.mp4`

    With --stream HOST:PORT the results that `vibrissa stream --send udp://HOST:PORT` sends there
    are drawn as they arrive. Example: `vibrissa view wire.nc --stream 127.0.0.1:5006`
    """
    kind = "" if path is None else kind_in(path)
    viewed: vb.Whisker | vb.ContactMap | xr.DataTree
    if path is not None and kind in (MAP, RECORDING):
        options = {"--rat": rat, "--any-length": any_length, "--base-end": base_end}
        refuse(options, f"{path} is not the file of a whisker")
        viewed = vb.ContactMap.load(path, live is None) if kind == MAP else recording_from(path)
    else:
        viewed = WhiskerOptions(path, rat, any_length, base_end).read()
        print_notes(viewed)
    served: vb.viewer.Served
    try:
        if live is None:
            served = vb.viewer.view(viewed, videos=videos or (), host=host, port=port)
        else:
            refuse({"--video": videos or None}, "a stream has no videos")
            whisker = viewed.whisker if isinstance(viewed, vb.ContactMap) else viewed
            if not isinstance(whisker, vb.Whisker):
                raise ValueError("--stream needs a whisker or its map, and this is a recording")
            served = vb.viewer.view_stream(whisker, live, host=host, port=port)
        with served as viewer:
            say(f"{viewer.url}   Ctrl-C ends it")
            if browser:
                import webbrowser

                webbrowser.open(viewer.url)
            viewer.wait()
    except KeyboardInterrupt:
        say("stopped")
