"""The figure of an array of whiskers, or of a trial with one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

Draw = Callable[[], Any]


def array_drawings(path: Path, width: Any) -> dict[str, Draw]:
    """Say what can be drawn of a face.

    Parameters
    ----------
    path : Path
        A file.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    dict of str to callable
        Names of figures, and what draws them: none, unless it holds an array of whiskers, or is the
        recording of a simulated trial of several.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged.
    """
    from vibrissa import plots
    from vibrissa.io import Kind, load_array, load_recording, recognise

    kind = None if path.is_dir() else recognise(path)
    if kind in (None, Kind.ARRAY, Kind.ARRAY_TABLE):
        tree = load_array(path).to_tree()
    elif kind == Kind.RECORDING:
        tree = load_recording(path)
        if tree.sizes.get("whisker", 0) < 2 or "truth" not in tree.children:
            return {}
    else:
        return {}
    return {"array": lambda: plots.array_views(tree, width=width)}
