"""Contacts in the space of three signals: surfaces of equal r, θ and φ (Fig. 3), and slices.

Slices are drawn as in the paper's S1 Fig. C: one signal is fixed, and the plane of the other two
shows lines of equal r, θ and φ of the contact, and the error of a look-up table. Next to it the
whole solid is coloured by that error, with the third signal, such as the axial force, as the height
and the moment as components M_B cos M_D, M_B sin M_D.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import FuncNorm, LogNorm, Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from vibrissa import scene
from vibrissa.numerics import Array
from vibrissa.plots import space, style
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import robust_limits

_LEVELS = 3
# Values of the paper's surfaces, mm and degrees.
_PAPER = {"r": (11.0, 15.0, 24.0), "theta": (-25.0, 5.0, 35.0), "phi": (-25.0, 5.0, 35.0)}
# Bearings drawn where solids and surfaces are cut open: all but a quarter.
_OPEN = (np.pi, 2.5 * np.pi)


_Panel = tuple[str, str, style.Box]  # letter, title and position


def contact_surfaces(
    samples: xr.Dataset, centerline: ArrayLike, *, width: style.Width = "double"
) -> Figure:
    """Draw surfaces of equal r, θ and φ among contacts, and in the space of three signals.

    For each of r, θ and φ: three surfaces on which it is the same, in the space of contact points;
    the same three in the space of (F_x, M_B, M_D); and the solid of all signals that contacts make,
    coloured by it. It is cut open where the force's bearing at the contact is between 90° and 180°,
    as are the signals of equal r. Contacts within 2° of rest are left out. Where two colours meet
    in the solid, the signals do not determine the contact.

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
    contacts = space.bounds(np.concatenate([space.contact_points(body).reshape(-1, 3), line]))
    shell = scene.solid_surface(whole, True, outside)
    signals = space.signal_limits(space.signal_rows(shell))
    with style.looking():
        height, panels, rails = _sheet(width)
        figure = style.new_figure(width, height, None)
        for i, name in enumerate(scene.COORDINATES):
            norm, marks = levels(name, shell)
            values = to_display(name, scene.values_of(name, shell))
            if values.min() < min(_PAPER[name]) and max(_PAPER[name]) < values.max():
                marks = list(_PAPER[name])
            norm = _spread(norm, marks)
            among, into, inside = (box for *_, box in panels[3 * i : 3 * i + 3])
            for letter, title, box in panels[3 * i : 3 * i + 3]:
                style.corner_title(figure, box, letter, title)
            left, bottom, side, _ = space.square(among)
            box, zoom = (left - 2.0, bottom + 1.5, side, side), 0.87 if side > 50.0 else 0.82
            axes = space.space_axes(figure, box, contacts, zoom=zoom)
            space.name_axes(axes, (-8.0, -9.0, -10.5))
            surface, hues = _level_sets(whole, name, norm, marks)
            space.paint(axes, space.contact_points(surface), hues)
            if name == "r":
                finding = _finding(surface, marks)
            axes.plot(*line.T, color="black", linewidth=1.2, zorder=10)
            _write_values(figure, among, name, norm, marks)
            axes = space.signal_axes(figure, into, signals)
            if name == "r":  # its surfaces enclose one another
                surface, hues = _level_sets(opened, name, norm, marks)
            space.paint(axes, space.signal_rows(surface), hues)
            axes = space.signal_axes(figure, inside, signals)
            values = to_display(name, scene.values_of(name, body))
            hues = space.painted(values, norm, style.sequential())
            space.paint(axes, space.signal_rows(body), hues, flat=0.8)
            coordinate_bar(figure, rails[i], name, norm, marks)
        style.conclude(figure, finding)
        return figure


def _spread(norm: Normalize, marks: Sequence[float]) -> Normalize:
    """Limits of colours between which the surfaces are equally far apart."""
    ends = [norm.vmin, *marks, norm.vmax]
    shares = np.linspace(0.0, 1.0, len(ends))
    ways = partial(np.interp, xp=ends, fp=shares), partial(np.interp, xp=shares, fp=ends)
    return FuncNorm(ways, vmin=norm.vmin, vmax=norm.vmax)


def _finding(surface: Array, marks: Sequence[float]) -> str:
    """State the largest bending moments of the surfaces of equal r, triangles (n, 3, columns)."""
    r = to_display("r", scene.values_of("r", surface)).mean(axis=1)
    moment = to_display("MB", scene.values_of("MB", surface)).max(axis=1)
    which = np.abs(r[:, None] - np.asarray(marks)).argmin(axis=1)
    there = [i for i in range(len(marks)) if (which == i).any()]
    at = ", ".join(f"{marks[i]:g}" for i in there)
    largest = ", ".join(f"{moment[which == i].max():.2g}" for i in there)
    return f"Contacts at $r$ = {at} mm have $M_B$ up to {largest} µN·m"


def _level_sets(
    nodes: Array, name: str, norm: Normalize, marks: list[float]
) -> tuple[Array, Array]:
    """Surfaces of constant values of a coordinate, and their colours."""
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
        place = (box[0] + 5.5 + 12.0 * i) / wide, (box[1] + box[3] - 3.6) / tall
        look: dict[str, Any] = {"fontsize": style.SMALL, "fontweight": "bold", "va": "top"}
        figure.text(*place, text, color=style.sequential()(norm(mark)), **look)


def levels(name: str, shell: Array) -> tuple[Normalize, list[float]]:
    """Limits of the colours, and round values of the surfaces."""
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
        (
            "abcdefghi"[order.index((row, side))],
            title,
            (wide * side, height - 1.0 - tall * (row + 1), wide, tall),
        )
        for (row, side), title in zip(cells, titles, strict=True)
    ]
    return height, panels, rails


def coordinate_bar(
    figure: Figure, place: style.Box, name: str, norm: Normalize, marks: list[float]
) -> None:
    """Draw a colour bar for a coordinate."""
    rail = style.box_axes(figure, place)
    upright = place[3] > place[2]
    bar = style.colour_bar(
        figure,
        ScalarMappable(norm, style.sequential()),
        cax=rail,
        orientation="vertical" if upright else "horizontal",
    )
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
    """Draw the solid of signals near the measured ones (n, 3) in each panel; return its limits."""
    nodes = scene.sample_contacts(samples, centerline)
    within: list[int] = []
    if np.isfinite(measured).all(axis=1).any():
        # Margins of signals within 1.5 times those of the trial; negative beyond.
        force, moment = _ROOM * np.nanmax(np.abs(measured[:, :2]), axis=0)
        tension = 1.0 - np.abs(scene.values_of("Fx", nodes)) / max(force, 1e-12)
        bending = 1.0 - scene.values_of("MB", nodes) / max(moment, 1e-15)
        within = [nodes.shape[-1], nodes.shape[-1] + 1]
        nodes = np.concatenate([nodes, np.stack([tension, bending], axis=-1)], axis=-1)
    body = scene.solid_surface(nodes, True, scene.column("deflection"), *within)
    places = space.signal_rows(body)
    limits = space.signal_limits(places)
    solids = [space.signal_axes(figure, panel, limits) for panel in panels]
    for axes in solids:
        space.paint(axes, places, _SKIN, opacity=_OPACITY, flat=0.6)
    return solids, limits


def course_scales(
    figure: Figure, rails: Sequence[style.Box], coordinates: Array
) -> list[tuple[Array, Normalize]]:
    """Values of r, θ and φ (n, 3) in display units, with colours and colour bars."""
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


# Directions, the size that belongs to each, and the components that both make.
_PANELS = ("r", "theta", "phi", "error_distance")
_CIRCLES = {"MD": ("MB", "My", "Mz"), "FD": ("FT", "Fy", "Fz")}
_STEPS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)  # errors, mm, that have a tick
_MOST = 12_000
# Angles below this, degrees, are not worth lines: a planar whisker stays in its plane.
_NOTHING = 0.1


def solid_slices(
    plane: xr.Dataset, solid: xr.Dataset | None = None, *, width: style.Width = "double"
) -> Figure:
    """Draw a slice through the solid of contacts in the space of three signals, and the solid.

    Parameters
    ----------
    plane : Dataset
        Result of ``vibrissa.paper.signal_slice``: ``r``, ``theta``, ``phi`` and, if known,
        ``error_distance`` over two signals, SI units; NaN outside the solid.
    solid : Dataset, optional
        Contacts with the three signals and ``error_distance``, such as the nodes of a map; with
        ``small_deflection`` if those are to be left out.
    width : {"single", "double"}
        Width in columns of a page.

    Returns
    -------
    Figure
        A panel for each of r, θ, φ and the error, in mm and degrees, and the solid; or the sentence
        "no contacts".

    Raises
    ------
    ValueError
        If something is missing, or the triplet has no direction to wind the solid about.
    """
    missing = [name for name in ("r", "theta", "phi") if name not in plane]
    if missing or plane["r"].ndim != 2:
        raise ValueError(f"the slice lacks {', '.join(missing) or 'its two dimensions'}")
    names = [n for n in _PANELS if n in plane and np.isfinite(plane[n].values).any()]
    with style.looking():
        shape = (1, 3) if solid is None and width == "double" and len(names) == 3 else (2, 2)
        tall = 90.0 if shape == (2, 2) else 55.0
        if solid is not None:
            tall = 98.0 if width == "double" else 158.0
        figure = style.new_figure(width, tall, "constrained")
        if not names:
            style.say(figure, "no contacts")
            return figure
        if solid is None:
            _slices(figure, plane, names, "abcd", shape)
            return figure
        if width == "double":
            parts = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.0, 1.35])
        else:
            parts = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.15])
        finding = _solid(parts.flat[0], solid, plane)
        _slices(parts.flat[1], plane, names, "bcde")
        style.conclude(figure, finding)
        return figure


def _slices(
    figure: Figure | SubFigure,
    plane: xr.Dataset,
    names: list[str],
    letters: str,
    shape: tuple[int, int] = (2, 2),
) -> None:
    grid = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    panels = grid.ravel()
    # The signal that is a size is on the vertical axis, the one with both signs on the other.
    dims = sorted(map(str, plane["r"].dims), key=lambda n: n in ("FT", "MB"))
    x, y = (to_display(n, plane[n].to_numpy()) for n in dims)
    # Scales are set before anything is drawn, as labels of lines are fitted to the axes.
    known = np.isfinite(plane["r"].transpose(*dims).to_numpy())
    for i, (axis, values) in enumerate(zip("xy", (x, y), strict=True)):
        there = values[known.any(axis=1 - i)]
        width = plane[dims[i]].attrs.get("linear_width")
        width = None if width is None else float(to_display(dims[i], width))
        style.scale_near_zero(panels[0], axis, np.array([there.min(), there.max()]), width)
    for axes, name, letter in zip(panels, names, letters, strict=False):
        values = to_display(name, plane[name].transpose(*dims[::-1]).to_numpy())
        _lines(axes, x, y, values, name)
        style.head(axes, letter, f"{quantity(name).long_name} ({quantity(name).display_unit})")
    if "small_deflection" in plane:
        near = plane["small_deflection"].transpose(*dims[::-1]).to_numpy()
        for axes in panels[: len(names)]:
            shade = np.where(near, 1.0, np.nan)
            axes.pcolormesh(x, y, shade, cmap="gray", vmin=0.0, vmax=1.6, rasterized=True)
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel(axis_label(dims[0]))
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(dims[1]))


def _lines(axes: Axes, x: Array, y: Array, values: Array, name: str) -> None:
    """Draw values in colour, with labelled contour lines."""
    error = name == "error_distance"
    low, high = robust_limits(values, 0.96)
    if not error and max(abs(low), abs(high)) < _NOTHING and quantity(name).display_unit == "°":
        axes.pcolormesh(
            x, y, np.where(np.isfinite(values), 0.0, np.nan), cmap="gray", vmin=-9, vmax=2
        )
        words = "zero: in the whisker's plane" if name == "phi" else "zero"
        axes.text(0.5, 0.9, words, transform=axes.transAxes, ha="center", color=style.MUTED)
        return
    signed = not error and min(-low, high) > 0.1 * max(-low, high)
    if signed:
        low, high = -max(-low, high), max(-low, high)
    norm = LogNorm(*_decades(values)) if error else Normalize(low, high)
    look: dict[str, Any] = {
        "cmap": style.diverging() if signed else style.sequential(),
        "norm": norm,
    }
    mesh = axes.pcolormesh(x, y, values, rasterized=True, **look)
    if error:
        _error_bar(_rail(axes, mesh))
        return
    steps = MaxNLocator(5).tick_values(low, high)
    steps = steps[(steps >= low) & (steps <= high)]
    axes.contour(x, y, values, steps, colors=style.INK, linewidths=0.5, linestyles="solid")
    bar = _rail(axes, mesh)
    bar.set_ticks(steps, labels=[f"{step:g}".replace("-", "−") for step in steps])
    # The lines in the panel are at the ticks.
    bar.ax.vlines(
        steps, 0.0, 1.0, colors=style.INK, linewidths=0.5, transform=bar.ax.get_xaxis_transform()
    )


def _rail(axes: Axes, mesh: Any) -> Colorbar:
    """A colour bar in the upper right corner of a panel, which the solid leaves empty."""
    rail = axes.inset_axes((0.38, 0.93, 0.58, 0.035))
    how = {"orientation": "horizontal", "extend": "both"}
    bar = style.colour_bar(axes.figure, mesh, cax=rail, **how)
    bar.ax.tick_params(length=2.0, pad=1.5)
    bar.minorticks_off()
    return bar


def _decades(values: Array) -> tuple[float, float]:
    """Limits of a logarithmic scale of errors, at most two decades."""
    high = float(robust_limits(values, 0.96)[1]) or 1.0
    low = float(robust_limits(values, 0.9)[0])
    return max(low, 0.01 * high), high


def _solid(figure: Figure | SubFigure, solid: xr.Dataset, plane: xr.Dataset) -> str:
    """Draw the solid, and describe the errors."""
    names = str(plane.attrs.get("triplet", "Fx MB MD")).split()
    turn = next((n for n in names if n in _CIRCLES and _CIRCLES[n][0] in names), None)
    if turn is None:
        raise ValueError(f"a solid needs a direction and its size; the triplet is {names}")
    size, across, along = _CIRCLES[turn]
    upward = next(n for n in names if n not in (turn, size))
    if lacking := [n for n in (*names, "error_distance") if n not in solid]:
        raise ValueError(f"the solid lacks {', '.join(lacking)}")
    dims = solid[size].dims
    rows = {n: solid[n].transpose(*dims).to_numpy().ravel() for n in (*names, "error_distance")}
    kept = np.isfinite(np.stack(list(rows.values()))).all(axis=0)
    if "small_deflection" in solid:
        kept &= ~solid["small_deflection"].transpose(*dims).to_numpy().ravel().astype(bool)
    first = to_display(across, rows[size] * np.cos(rows[turn]))
    second = to_display(along, rows[size] * np.sin(rows[turn]))
    third, error = (to_display(n, rows[n]) for n in (upward, "error_distance"))
    every = kept.copy()
    # The half in front of the plane of the slice is omitted, so that the inside is visible.
    value = float(plane.attrs.get("value", -0.5 * np.pi))
    if plane.attrs.get("fixed", turn) == turn:
        kept &= np.sin(rows[turn] - value) <= 0.02
    shown = np.flatnonzero(kept)
    shown = np.random.default_rng(0).permutation(shown)[:_MOST]
    shown = shown[np.argsort(error[shown], kind="stable")]
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    dots = axes.scatter(
        first[shown],
        second[shown],
        third[shown],
        c=error[shown],
        s=2.5,
        cmap=style.sequential(),
        norm=LogNorm(*_decades(error[shown])),
        linewidths=0.0,
        depthshade=False,
        rasterized=True,
    )
    axes.patch.set_visible(False)
    axes.view_init(16.0, -25.0)
    axes.set_box_aspect((1.0, 1.0, 1.1), zoom=1.1)
    space.plain_frame(axes)
    space.name_axes(axes, (-8.0, -8.0, -1.0), (across, along, upward))
    axes.tick_params(pad=-3.0)
    axes.tick_params(axis="z", pad=0.0)
    place = {"ax": axes, "shrink": 0.7, "aspect": 28, "pad": 0.08}
    bar = style.colour_bar(figure, dots, orientation="horizontal", extend="both", **place)
    _error_bar(bar)
    bar.ax.set_xlabel(axis_label("error_distance"))
    figure.text(0.02, 0.98, "a", fontsize=style.LARGE, fontweight="bold", va="top")
    figure.text(0.07, 0.98, "look-up table's error, cut at the slice", va="top")
    middle, wide = np.median(error[every]), np.quantile(error[every], 0.95)
    return f"The look-up table's error is {middle:.2g} mm in the median, {wide:.2g} mm at 95 %"


def _error_bar(bar: Colorbar) -> None:
    low, high = bar.mappable.get_clim()
    ticks = [t for t in _STEPS if (low or 0.0) <= t <= (high or np.inf)]
    bar.set_ticks(ticks, labels=[f"{t:g}" for t in ticks])
    bar.minorticks_off()
    bar.ax.tick_params(length=2.0, pad=1.5)
