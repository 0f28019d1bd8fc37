"""Surfaces of equal r, θ and φ, and what they become in the space of (F_x, M_B, M_D) (Fig. 3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from vibrissa import scene
from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.plots.space import (
    bounds,
    name_axes,
    paint,
    painted,
    signal_axes,
    signal_limits,
    signal_rows,
    space_axes,
    square,
)
from vibrissa.quantities import axis_label, quantity, to_display

_LEVELS = 3
_PAPER = {"r": (11.0, 15.0, 24.0), "theta": (-25.0, 5.0, 35.0), "phi": (-25.0, 5.0, 35.0)}
"""Values of the paper's surfaces, mm and degrees."""

_OPEN = (np.pi, 2.5 * np.pi)
"""Bearings drawn where solids and surfaces are cut open: all but a quarter."""


class _Panel(NamedTuple):
    """One of nine."""

    letter: str
    title: str
    box: style.Box


def contact_surfaces(
    samples: xr.Dataset, centerline: ArrayLike, *, width: style.Width = "double"
) -> Figure:
    """Draw surfaces of equal r, θ and φ among contacts, and in the space of three signals.

    For each of r, θ and φ: three surfaces on which it is the same, in the space of contact points;
    the same three in the space of (F_x, M_B, M_D); and the solid of all signals that contacts make,
    coloured by it. It is cut open where the force's bearing at the contact is
    between 90° and 180°, as are the signals of equal r. Contacts within
    2° of rest are left out. Where two colours meet in the solid, the signals do
    not determine the contact.

    Parameters
    ----------
    samples : Dataset
        ``ContactMap.to_dataset()``: all of the reachable space.
    centerline : array_like (k, 3)
        Resting whisker from base to tip, whisker frame, m.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Nine 3D axes and three colour bars.

    Raises
    ------
    ValueError
        If the dataset lacks something, or if there is no such width.
    """
    whole = scene.sample_contacts(samples, centerline)
    opened = scene.sample_contacts(samples, centerline, _OPEN)
    outside = scene.column("deflection")
    body = scene.solid_surface(opened, False, outside)
    line = to_display("centerline", centerline)
    contacts = bounds(np.concatenate([_places(body).reshape(-1, 3), line]))
    shell = scene.solid_surface(whole, True, outside)
    signals = signal_limits(signal_rows(shell))
    with style.looking():
        height, panels, rails = _sheet(width)
        figure = style.new_figure(width, height, None)
        for i, name in enumerate(scene.COORDINATES):
            norm, marks = levels(name, shell)
            values = to_display(name, scene.values_of(name, shell))
            if values.min() < min(_PAPER[name]) and max(_PAPER[name]) < values.max():
                marks = list(_PAPER[name])
            among, into, inside = panels[3 * i : 3 * i + 3]
            axes = _contact_axes(figure, among, contacts)
            surface, hues = _level_sets(whole, name, norm, marks)
            paint(axes, _places(surface), hues)
            axes.plot(*line.T, color="black", linewidth=1.2, zorder=10)
            _write_values(figure, among.box, name, norm, marks)
            axes = _cylinder(figure, into, signals)
            if name == "r":  # its surfaces lie one within the other
                surface, hues = _level_sets(opened, name, norm, marks)
            paint(axes, signal_rows(surface), hues)
            axes = _cylinder(figure, inside, signals)
            values = to_display(name, scene.values_of(name, body))
            paint(axes, signal_rows(body), painted(values, norm, style.sequential()), flat=0.8)
            coordinate_bar(figure, rails[i], name, norm, marks)
        style.conclude(
            figure,
            "Surfaces of equal r, θ and φ, and their signals in the space of ($F_x$, $M_B$, $M_D$)",
        )
        return figure


def _level_sets(
    nodes: Array, name: str, norm: Normalize, marks: list[float]
) -> tuple[Array, Array]:
    """Surfaces on which a coordinate has certain values, and their colours."""
    surfaces, hues = [], []
    for mark in marks:
        value = mark / quantity(name).display_factor
        surfaces.append(
            scene.clip(
                scene.level_surface(nodes, scene.column(name), value), scene.column("deflection")
            )
        )
        hues.append(np.tile(style.sequential()(norm(mark)), (len(surfaces[-1]), 1)))
    return np.concatenate(surfaces), np.concatenate(hues)


def _write_values(
    figure: Figure, box: style.Box, name: str, norm: Normalize, marks: Sequence[float]
) -> None:
    """Values of the surfaces, in their colours, below the title of their panel."""
    wide, tall = 25.4 * figure.get_size_inches()
    unit = quantity(name).display_unit
    for i, mark in enumerate(marks):
        text = f"{mark:g}{'' if unit == '°' else ' '}{unit}".replace("-", "−")
        place = (box[0] + 5.5 + 9.5 * i) / wide, (box[1] + box[3] - 3.6) / tall
        look: dict[str, Any] = {"fontsize": style.SMALL, "fontweight": "bold", "va": "top"}
        figure.text(*place, text, color=style.sequential()(norm(mark)), **look)


def _places(triangles: Array) -> Array:
    return to_display("contact_point", triangles[..., :3])


def levels(name: str, shell: Array) -> tuple[Normalize, list[float]]:
    """Limits of the colours, and round values for surfaces."""
    values = to_display(name, scene.values_of(name, shell))
    low, high = scene.robust_limits(values)
    locator = MaxNLocator(12, steps=[1, 2, 2.5, 5, 10])
    ticks = np.asarray(locator.tick_values(low, high))
    step = float(ticks[1] - ticks[0])
    middle = float(ticks[np.argmin(np.abs(ticks - 0.5 * (low + high)))])
    apart = max(1, round((high - low) / (_LEVELS + 1) / step)) * step
    marks = [middle + apart * i for i in (-1.0, 0.0, 1.0)]
    return Normalize(float(low), float(high)), marks


def _sheet(width: style.Width) -> tuple[float, list[_Panel], list[style.Box]]:
    """Height of the figure, panels (contacts, signals, solid of r, of θ, of φ), colour bars."""
    kinds = ("contacts of equal {}", "their signals", "all signals, coloured by {}")
    titles = [kind.format(f"${quantity(n).symbol}$") for n in scene.COORDINATES for kind in kinds]
    cells = [(row, side) for row in range(3) for side in range(3)]
    if width == "double":
        height, wide, tall = 141.0, 56.0, 46.5
        rails = [(169.5, height - 36.0 - tall * row, 1.6, 25.0) for row in range(3)]
    else:
        height, wide, tall = 191.0, 42.5, 38.0
        rails = [(48.0, 30.0 - 12.0 * row, 32.0, 1.6) for row in range(3)]
        # Contacts and signals side by side, the solids below.
        cells = [(row, k) if k < 2 else (3 + row // 2, row % 2) for row, k in cells]
    order = sorted(cells)
    panels = [
        _Panel(
            "abcdefghi"[order.index((row, side))],
            title,
            (wide * side, height - 1.0 - tall * (row + 1), wide, tall),
        )
        for (row, side), title in zip(cells, titles, strict=True)
    ]
    return height, panels, rails


def _contact_axes(figure: Figure, panel: _Panel, limits: Array) -> Any:
    style.corner_title(figure, panel.box, panel.letter, panel.title)
    left, bottom, width, height = square(panel.box)
    zoom = 0.87 if width > 50.0 else 0.82
    axes = space_axes(figure, (left - 2.0, bottom + 1.5, width, height), limits, zoom=zoom)
    name_axes(axes, (-8.0, -9.0, -10.5))
    return axes


def _cylinder(figure: Figure, panel: _Panel, limits: Array) -> Any:
    style.corner_title(figure, panel.box, panel.letter, panel.title)
    return signal_axes(figure, panel.box, limits)


def coordinate_bar(
    figure: Figure, place: style.Box, name: str, norm: Normalize, marks: list[float]
) -> None:
    """Draw a colour bar for a coordinate."""
    rail = style.box_axes(figure, place)
    upright = place[3] > place[2]
    bar = figure.colorbar(
        ScalarMappable(norm, style.sequential()),
        cax=rail,
        orientation="vertical" if upright else "horizontal",
    )
    style.plain(bar)
    bar.set_ticks(marks)
    rail.tick_params(length=2.0, pad=1.5)
    for mark in marks:
        (rail.axhline if upright else rail.axvline)(mark, color="white", linewidth=0.8)
    if upright:
        rail.set_title(axis_label(name), pad=4.0)
    else:
        rail.set_xlabel(axis_label(name), labelpad=1.0)


_SKIN = (0.62, 0.68, 0.75, 1.0)
_OPACITY = 0.22
_ROOM = 1.5


def solid_panels(
    figure: Figure,
    samples: xr.Dataset,
    centerline: ArrayLike,
    panels: Sequence[style.Box],
    measured: Array,
) -> tuple[list[Any], Array]:
    """Draw the solid of all signals that is near those measured (n, 3) once a panel; its limits."""
    nodes = scene.sample_contacts(samples, centerline)
    within: list[int] = []
    if np.isfinite(measured).all(axis=1).any():
        gentle = _gentle(nodes, measured)
        within = [nodes.shape[-1] + i for i in range(gentle.shape[-1])]
        nodes = np.concatenate([nodes, gentle], axis=-1)
    body = scene.solid_surface(nodes, True, scene.column("deflection"), *within)
    places = signal_rows(body)
    limits = signal_limits(places)
    solids = [signal_axes(figure, panel, limits) for panel in panels]
    for axes in solids:
        paint(axes, places, _SKIN, opacity=_OPACITY, flat=0.6)
    return solids, limits


def course_scales(
    figure: Figure, rails: Sequence[style.Box], coordinates: Array
) -> list[tuple[Array, Normalize]]:
    """Values of r, θ and φ (n, 3) in display units, each with its colours, shown on a bar."""
    scales = []
    for name, rail, column_of in zip(scene.COORDINATES, rails, coordinates.T, strict=True):
        values = to_display(name, column_of)
        norm = Normalize(*scene.robust_limits(values))
        low, high = float(norm.vmin or 0.0), float(norm.vmax or 1.0)
        ticks = MaxNLocator(4).tick_values(low, high)
        marks = [float(t) for t in ticks if low <= t <= high]
        coordinate_bar(figure, rail, name, norm, marks)
        scales.append((values, norm))
    return scales


def _gentle(nodes: Array, measured: Array) -> Array:
    """Margin of signals within 1.5 times those of a trial; negative beyond."""
    force, moment = _ROOM * np.nanmax(np.abs(measured[:, :2]), axis=0)
    tension = 1.0 - np.abs(scene.values_of("Fx", nodes)) / max(force, 1e-12)
    bending = 1.0 - scene.values_of("MB", nodes) / max(moment, 1e-15)
    return np.stack([tension, bending], axis=-1)
