"""The three solids of signals, coloured by r, θ and φ, that one can look into (Fig. 4C).

Solids are translucent, so that a trial's way through the signals is seen inside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.plots.chart import column, fine_chart, values_of
from vibrissa.plots.colours import sequential
from vibrissa.plots.cylinder import Box, felt, signal_axes, signal_limits
from vibrissa.plots.solids import solid
from vibrissa.plots.space import paint, painted
from vibrissa.plots.style import Array
from vibrissa.plots.surfaces import coordinate_bar, levels
from vibrissa.quantities import to_display

COORDINATES = ("r", "theta", "phi")

_OPACITY = 0.22
_ROOM = 1.5


def solid_panels(
    figure: Figure,
    samples: xr.Dataset,
    centerline: ArrayLike,
    panels: Sequence[Box],
    rails: Sequence[Box],
    way: Array | None = None,
) -> list[Any]:
    """Draw the signals of all contacts three times, coloured by r, θ and φ."""
    nodes = fine_chart(samples, centerline)
    within: list[int] = []
    if way is not None and np.isfinite(way).all(axis=1).any():
        gentle = _gentle(nodes, way)
        within = [nodes.shape[-1] + i for i in range(gentle.shape[-1])]
        nodes = np.concatenate([nodes, gentle], axis=-1)
    body = solid(nodes, True, column("deflection"), *within)
    places = felt(body)
    limits = signal_limits(places)
    found = []
    for name, panel, rail in zip(COORDINATES, panels, rails, strict=True):
        norm, marks = levels(name, body)
        axes = signal_axes(figure, panel, limits)
        values = to_display(name, values_of(name, body))
        colours = painted(values, norm, sequential())
        paint(axes, places, colours, opacity=_OPACITY, flat=0.9)
        coordinate_bar(figure, rail, name, norm, marks)
        found.append(axes)
    return found


def _gentle(nodes: Array, way: Array) -> Array:
    """How far signals are within what a trial reaches, and half as much again; negative beyond."""
    force, moment = _ROOM * np.nanmax(np.abs(way[:, :2]), axis=0)
    tension = 1.0 - np.abs(values_of("Fx", nodes)) / max(force, 1e-12)
    bending = 1.0 - values_of("MB", nodes) / max(moment, 1e-15)
    return np.stack([tension, bending], axis=-1)
