"""Figures of the six signals over time, and over the reachable space (the paper's Fig. 2)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from vibrissa import scene
from vibrissa.numerics import Array, Mask, contacts_in
from vibrissa.plots import style
from vibrissa.plots.space import (
    AZIMUTH,
    ELEVATION,
    bounds,
    contact_points,
    name_axes,
    paint,
    painted,
    space_axes,
)
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.recording import Group
from vibrissa.scene import DIRECTIONS
from vibrissa.status import Status

_COLUMNS = (("Fx", "FT", "FD"), ("Mx", "MB", "MD"))


def signals_over_time(
    signals: xr.Dataset,
    truth: xr.Dataset | None = None,
    *,
    whisker: int = 0,
    width: style.Width = "double",
) -> Figure:
    """Draw the six signals over time, forces on the left and moments on the right."""
    names = [name for column in _COLUMNS for name in column]
    if "time" not in signals.coords or not any(name in signals for name in names):
        raise ValueError(
            "time and some of Fx, FT, FD, Mx, MB, MD are needed (vibrissa.base_signals makes them "
            f"from force and moment); the dataset has {', '.join(map(str, signals.variables))}"
        )
    signals = Group(signals).whisker(whisker).data
    truth = None if truth is None else Group(truth).whisker(whisker).data
    time = to_display("time", signals["time"])
    if truth is not None and truth.sizes.get("time") != time.size:
        raise ValueError(f"the truth has {dict(truth.sizes)}, the signals {time.size} times")
    contact, seen, spans = None, None, np.empty((0, 2))
    if "status" in signals:
        seen = np.asarray(signals["status"] != Status.MISSING)
    if "in_contact" in signals:
        touching = signals["in_contact"].to_numpy().astype(np.float64)
        contact = np.asarray(np.nan_to_num(touching) > 0.5)
        spans = intervals(time, contact, seen)
    with style.looking():
        layout: tuple[int, int, float] = (3, 2, 92.0) if width == "double" else (6, 1, 130.0)
        figure = style.new_figure(width, layout[2], "constrained")
        if time.size == 0:
            style.say(figure, "no signals")
            return figure
        panels = figure.subplots(*layout[:2], sharex=True, squeeze=False)
        # Forces in the left column and moments in the right one; or one below the other.
        for axes, name, letter in zip(panels.T.flat, names, "abcdef", strict=True):
            _panel(axes, name, signals, truth, contact)
            for begin, end in spans:
                axes.axvspan(begin, end, color=style.SHADE, linewidth=0.0, zorder=0)
            style.head(axes, letter, quantity(name).long_name)
        for axes in panels[-1]:
            axes.set_xlabel(axis_label("time"))
            axes.set_xlim(time.min(), time.max() if time.size > 1 else time.min() + 1.0)
        figure.align_ylabels()
        _legend(figure, truth is not None, contact is not None)
        # Signals without a direction have their largest size where the whisker is loaded most.
        largest = [
            f"${quantity(n).symbol}$ up to {np.nanmax(to_display(n, signals[n]), initial=0.0):.3g} "
            f"{quantity(n).display_unit}"
            for n in ("FT", "MB")
            if n in signals
        ]
        count = (
            "" if contact is None else f" in {len(spans)} contact{'' if len(spans) == 1 else 's'}"
        )
        if largest:
            style.conclude(figure, f"{' and '.join(largest)}{count}")
        return figure


def intervals(time: Array, contact: Mask, known: Mask | None = None) -> Array:
    """First and last times of contacts; ``known`` marks the frames with data."""
    if time.size < 2:
        return np.empty((0, 2))
    halfway = 0.5 * (time[1:] + time[:-1])
    edges = np.concatenate([time[:1], halfway, time[-1:]])
    return np.array([(edges[a], edges[b]) for a, b in contacts_in(contact, known)]).reshape(-1, 2)


def _panel(
    axes: Axes, name: str, signals: xr.Dataset, truth: xr.Dataset | None, contact: Mask | None
) -> None:
    time = to_display("time", signals["time"])
    if name not in DIRECTIONS:
        axes.axhline(0.0, color="#bfbfbf", linewidth=0.5, zorder=1)
    look: dict[str, Any] = (
        {"marker": ".", "markersize": 1.6, "linestyle": "none"} if name in DIRECTIONS else {}
    )
    if name in signals:
        axes.plot(time, _drawn(name, signals, contact), color=style.BLUE, zorder=2, **look)
    if truth is not None and name in truth:
        look["markersize"] = 0.8
        line = {"linewidth": 0.4} if name not in DIRECTIONS else look
        values = _drawn(name, truth, contact)
        axes.plot(time, values, color=style.INK, zorder=3, **line)
    axes.set_ylabel(axis_label(name))
    if name in DIRECTIONS:
        axes.set_ylim(-190.0, 190.0)
        axes.set_yticks([-180.0, -90.0, 0.0, 90.0, 180.0])


def _drawn(name: str, data: xr.Dataset, contact: Mask | None) -> Array:
    """Values in display units; directions only in contact."""
    values = to_display(name, data[name])
    return (
        values if name not in DIRECTIONS or contact is None else np.where(contact, values, np.nan)
    )


def _legend(figure: Figure, truth: bool, contact: bool) -> None:
    handles: list[Line2D | Patch] = []
    if truth:
        handles += [Line2D([], [], color=style.BLUE, label="measured")]
        handles += [Line2D([], [], color=style.INK, linewidth=0.4, label="true")]
    if contact:
        handles += [Patch(facecolor=style.SHADE, label="in contact")]
    if handles:
        figure.legend(handles=handles, loc="outside upper right", ncols=len(handles))


# Colour of the reachable space where it does not represent a signal.
_SKIN = (0.80, 0.85, 0.90, 1.0)
_TITLES = {"FD": "direction of $F_T$", "MD": "direction of $M_B$"}


class _Sheet(NamedTuple):
    """Positions of the panels."""

    height: float
    space: style.Box
    front: style.Box
    signals: tuple[style.Box, ...]


def _sheet(width: style.Width) -> _Sheet:
    if width == "single":
        cells = [(42.5 * (i % 2), 78.0 - 39.0 * (i // 2), 42.5, 38.0) for i in range(6)]
        return _Sheet(167.0, (0.0, 117.0, 56.0, 49.0), (57.0, 117.0, 28.0, 49.0), tuple(cells))
    cells = [(58.0 + 40.0 * (i % 3), 39.5 - 39.0 * (i // 3), 40.0, 38.0) for i in range(6)]
    return _Sheet(78.5, (0.0, 30.5, 58.0, 47.0), (0.0, -2.0, 58.0, 32.5), tuple(cells))


def signal_clouds(
    samples: xr.Dataset, centerline: ArrayLike, *, width: style.Width = "double"
) -> Figure:
    """Draw the reachable space of a whisker, and the six signals over it.

    The reachable space is shown from the side and from the tip, and then once for each signal,
    coloured by it: forces above, moments below. The quarter that faces the viewer is removed along
    the resting whisker, so that the inside is visible. Small deflections (2° about rest) are left
    out as in the paper. Colours of forces and moments are on a square-root scale without the
    outermost 2 % of the values, for which the colour bar has a pointed end. An inset shows where
    the whisker is pulled (F_x > 0), which happens only if it is curved.

    Parameters
    ----------
    samples : Dataset
        ``ContactMap.to_dataset()``: all of the reachable space.
    centerline : array_like (k, 3)
        Resting whisker from base to tip, whisker frame, m; drawn in black.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        3D axes, all to one scale except for the inset, and six colour bars.

    Raises
    ------
    ValueError
        If the dataset lacks something, or if there is no such width.
    """
    # The bearings that remain when the quarter facing the viewer is removed.
    toward = float(np.arctan2(np.sign(ELEVATION), np.sign(np.sin(np.radians(AZIMUTH)))))
    kept = toward + np.pi / 4.0, toward + 7.0 * np.pi / 4.0
    nodes = scene.sample_contacts(samples, centerline, kept)
    whole = scene.sample_contacts(samples, centerline)
    outside = scene.column("deflection")
    triangles = scene.solid_surface(nodes, False, outside)
    line = to_display("centerline", centerline)
    limits = bounds(np.concatenate([contact_points(triangles).reshape(-1, 3), line]))
    view = ELEVATION, AZIMUTH
    sheet = _sheet(width)
    with style.looking():
        figure = style.new_figure(width, sheet.height, None)
        _reach(figure, sheet, triangles, line, limits, view)
        for i, (name, cell) in enumerate(zip(scene.SIGNALS, sheet.signals, strict=True)):
            style.corner_title(
                figure, cell, "cdefgh"[i], _TITLES.get(name, quantity(name).long_name)
            )
            every = to_display(name, scene.values_of(name, whole))
            norm, colours = style.scale_of(name, every)
            # 3D axes are square and reach beyond their panel.
            left, bottom, side = cell[0] - 0.07 * cell[2], cell[1] + 0.5 * cell[3], 1.1 * cell[2]
            square = left, bottom - 0.5 * side, side, side
            axes = space_axes(figure, square, limits, view, zoom=0.97, frame=False)
            body = triangles
            if name in scene.DIRECTIONS:
                # Where a force reverses, directions differ much within a triangle.
                turn = scene.values_of(name, triangles)
                gap = np.abs(np.angle(np.exp(1j * (turn - np.roll(turn, 1, axis=1)))))
                body = scene.subdivide(triangles, gap.max(axis=1) > np.pi / 4.0)
            shown = to_display(name, scene.values_of(name, body))
            bending = np.abs(scene.values_of("MB", whole)).max()
            if name == "Mx" and np.abs(scene.values_of("Mx", whole)).max() < 1e-9 * bending:
                _body(axes, triangles, np.array(_SKIN), line)  # as of a straight whisker
                wide, tall = 25.4 * figure.get_size_inches()
                x, y = (cell[0] + 0.5 * cell[2]) / wide, (cell[1] + 6.0) / tall
                figure.text(x, y, "$M_x = 0$ everywhere", ha="center", va="center")
                continue
            _body(axes, body, _mean(name, shown, norm, colours), line)
            ends = 2 * (every.min() < (norm.vmin or 0.0)) + (every.max() > (norm.vmax or 0.0))
            _bar(figure, cell, norm, colours, ("neither", "max", "min", "both")[ends], name)
        _pulled(figure, sheet.signals[0], nodes, line, view)
        style.conclude(figure, _finding(whole))
        return figure


def _finding(nodes: Array) -> str:
    """Describe the ranges of contacts and signals."""
    near, far, push, pull, bend = (
        f"{float(f'{np.quantile(to_display(name, scene.values_of(name, nodes)), share):.2g}'):g}"
        for name, share in (("r", 0.01), ("r", 0.99), ("Fx", 0.01), ("Fx", 0.99), ("MB", 0.99))
    )
    return (
        f"Contacts {near} to {far} mm from the base have $F_x$ from {push} to {pull} µN and $M_B$ "
        f"up to {bend} µN·m (98 % of the samples)"
    ).replace("-", "−")


def _mean(name: str, values: Array, norm: Normalize, colours: Colormap) -> Array:
    """Colours of triangles; directions are averaged on the circle."""
    if name not in scene.DIRECTIONS:
        return painted(values, norm, colours)
    turn = np.radians(values)
    mean = np.degrees(np.arctan2(np.sin(turn).sum(axis=1), np.cos(turn).sum(axis=1)))
    return painted(mean[:, None], norm, colours)


def _reach(
    figure: Figure,
    sheet: _Sheet,
    triangles: Array,
    line: Array,
    limits: Array,
    view: tuple[float, float],
) -> None:
    """Draw the reachable space from the side, and from in front of the tip."""
    colours = np.broadcast_to(np.array(_SKIN), (len(triangles), 4))
    left, bottom, width, height = sheet.space
    box = left - 0.03 * width, bottom + 0.5 * (height - width), width, width
    axes = space_axes(figure, box, limits, view, zoom=0.88)
    name_axes(axes, (-8.0, -9.0, -10.5))
    _body(axes, triangles, colours, line, 0.55)
    style.corner_title(figure, sheet.space, "a", "reachable contacts")
    left, bottom, width, height = sheet.front
    side = min(width, height)
    box = left + 0.5 * (width - side), bottom + 0.45 * (height - side), side, side
    front = space_axes(figure, box, limits, (0.0, 0.0), zoom=1.35, frame=False)
    front.set_proj_type("ortho")
    _body(front, triangles, colours, line, 0.55)
    # Bars of 5 mm along y and z at the lower left of the view from the tip.
    corner = np.array([limits[0, 1], limits[1, 0] - 1.0, limits[2, 0]])
    for i, name in ((1, "y"), (2, "z")):
        end = corner.copy()
        end[i] += 5.0
        front.plot(*np.stack([corner, end]).T, color=style.INK, linewidth=0.8, zorder=11)
        end[i] += 1.6
        front.text(*end, f"${name}$", fontsize=style.SMALL, ha="center", va="center")
    corner += np.array([0.0, 2.0, -2.6])
    front.text(*corner, "5 mm", fontsize=style.SMALL, ha="center", va="center")
    style.corner_title(figure, sheet.front, "b", "from the tip")


def _body(axes: Any, triangles: Array, colours: Array, line: Array, flat: float = 0.75) -> None:
    paint(axes, contact_points(triangles), colours, flat=flat)
    axes.plot(*line.T, color="black", linewidth=1.2, zorder=10, solid_capstyle="round")


def _pulled(
    figure: Figure, cell: style.Box, nodes: Array, line: Array, view: tuple[float, float]
) -> None:
    """Draw an inset of the contacts that pull the whisker, with its own colours."""
    triangles = scene.solid_surface(nodes, False, scene.column("deflection"), scene.column("Fx"))
    if not len(triangles):
        return
    left, bottom, width, height = cell
    limits = bounds(np.concatenate([contact_points(triangles).reshape(-1, 3), line]))
    side = 0.42 * width
    box = left + width - 1.03 * side, bottom + 0.845 * height - 0.5 * side, side, side
    axes = space_axes(figure, box, limits, view, zoom=1.1, frame=False)
    values = to_display("Fx", scene.values_of("Fx", triangles))
    norm, colours = Normalize(0.0, float(values.max())), style.sequential()
    _body(axes, triangles, painted(values, norm, colours), line, 1.0)
    axes.lines[0].set_linewidth(0.7)
    start, end = left + 0.66 * width, bottom + 0.91 * height
    rail = style.box_axes(figure, (start, end, 0.22 * width, 1.0))
    mapped = ScalarMappable(norm, colours)
    bar = style.colour_bar(figure, mapped, cax=rail, orientation="horizontal")
    rail.xaxis.set_ticks_position("top")
    bar.set_ticks([0.0, values.max()], labels=["$F_x$ > 0", f"{values.max():.2g} µN"])
    rail.tick_params(length=0.0, pad=1.0)


def _bar(
    figure: Figure, cell: style.Box, norm: Normalize, colours: Colormap, ends: str, name: str
) -> None:
    """Draw a colour bar at the lower end of a panel."""
    left, bottom, width, _ = cell
    rail = style.box_axes(figure, (left + 0.2 * width, bottom + 6.8, 0.6 * width, 1.5))
    mapped = ScalarMappable(norm, colours)
    bar = style.colour_bar(figure, mapped, cax=rail, extend=ends, orientation="horizontal")
    bar.ax.tick_params(length=2.0, pad=1.5)
    bar.ax.set_xlabel(axis_label(name), labelpad=1.0)
    assert norm.vmin is not None
    assert norm.vmax is not None
    if name in scene.DIRECTIONS:
        bar.set_ticks([-180.0, -90.0, 0.0, 90.0, 180.0])
    else:
        marks = _round_roots(norm.vmin, norm.vmax)
        bar.set_ticks(marks, labels=[f"{mark:g}".replace("-", "−") for mark in marks])
    bar.minorticks_off()


def _round_roots(low: float, high: float) -> list[float]:
    """Round numbers spaced about evenly on a square-root scale."""
    largest = max(abs(low), abs(high))
    step = 10.0 ** np.floor(np.log10(largest))
    step *= max(f for f in (1.0, 2.0, 5.0) if f * step <= largest)
    marks = [0.0]
    for sign, end, other in ((-1.0, -low, high), (1.0, high, -low)):
        shares = (1.0,) if other > 0.1 * largest else (1.0, 0.25)
        marks += [sign * f * step for f in shares if f * step <= end and end > 0.1 * largest]
    return sorted(float(f"{mark:.3g}") for mark in marks)
