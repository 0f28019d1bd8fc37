"""The figure of an array of whiskers, or of a trial with one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

Draw = Callable[[], Any]

_CONTACTS = ("estimates", "truth")


def array_drawings(path: Path, width: Any) -> dict[str, Draw]:
    """Say what can be drawn of a face."""
    from vibrissa import plots
    from vibrissa.io import Kind, load_array, load_recording, recognise

    kind = None if path.is_dir() else recognise(path)
    if kind in (None, Kind.ARRAY, Kind.ARRAY_TABLE):
        face = load_array(path).to_tree()
        return {"array": lambda: plots.array_views(face, width=width)}
    if kind != Kind.RECORDING:
        return {}
    trial = load_recording(path)
    groups = {name: group for name in _CONTACTS if (group := trial.get(name)) is not None}
    groups["/"] = trial
    contacts = [name for name, group in groups.items() if "contact_point" in group.data_vars]
    lines = any("centerline" in group.data_vars for group in groups.values())
    if trial.sizes.get("whisker", 0) < 2 or not contacts or not lines:
        return {}
    return {"array": lambda: plots.array_views(trial, contacts=contacts[0], width=width)}
