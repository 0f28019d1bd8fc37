"""The figures of the main job."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from vibrissa.mapping.contact_map import spherical
from vibrissa.signals import base_signals

if TYPE_CHECKING:
    from vibrissa.demo.run import DemoResult

_NODES = 101


def draw(result: DemoResult, folder: Path, progress: Callable[[int, int], None]) -> list[Path]:
    """Draw the whisker, the signals, the estimates and the contour.

    Parameters
    ----------
    result : DemoResult
        Of the main job.
    folder : Path
        Where to.
    progress : callable
        Called with the number of figures done and of all.

    Returns
    -------
    list of Path
        The files, PNG.
    """
    from vibrissa import plots

    whisker, contacts = result.contact_map.whisker, result.sensed.contacts
    line = whisker.centerline(_NODES)
    radius = whisker.radius(np.linspace(0.0, whisker.length, _NODES))
    felt = contacts["in_contact"].values
    truth = result.simulated["truth"].to_dataset().isel(whisker=0)
    angle = result.sensed.errors["deflection_angle"].values
    space = result.contact_map.to_dataset()
    figures: dict[str, Callable[[], Any]] = {
        "whisker": lambda: plots.whisker_views(line, radius, name=whisker.name),
        "signal_space": lambda: plots.signal_clouds(space, line),
        "signals": lambda: plots.signals_over_time(
            _signals(result.sensed.recording["signals"].to_dataset(), contacts["in_contact"]),
            _signals(result.simulated["truth"].to_dataset(), truth["in_contact"]),
        ),
        "estimates": lambda: plots.estimated_against_true(
            spherical(truth["contact_point_whisker"].values[felt]),
            spherical(contacts["contact_point_whisker"].values[felt]),
            time=contacts["time"].values[felt],
            colour=angle[felt],
        ),
        "contour": lambda: plots.contour_views(
            contacts["contact_point"].values[felt],
            result.peg,
            result.sensed.fit,
            colour=angle[felt],
        ),
    }
    files = []
    for i, (name, figure) in enumerate(figures.items()):
        progress(i, len(figures))
        files += plots.save(figure(), folder / name, formats=("png",))
    progress(len(figures), len(figures))
    return files


def _signals(data: xr.Dataset, in_contact: xr.DataArray) -> xr.Dataset:
    """Six signals over time, and when there is contact."""
    data = data.isel(whisker=0)
    signals = base_signals(data["force"], data["moment"])
    return signals.assign_coords(time=data["time"]).assign(in_contact=in_contact)
