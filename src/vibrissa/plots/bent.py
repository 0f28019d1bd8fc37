"""Bent whiskers beside the resting one, with contacts and forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from vibrissa.plots.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    Array,
    Width,
    box_axes,
    head,
    looking,
    new_figure,
    page_width,
    say,
)
from vibrissa.quantities import axis_label, to_display

_COLOURS = (BLUE, ORANGE, GREEN, INK)
_REST = "#c4c4c4"
_ARROW = 0.2
"""Length of the longest arrow, as a share of the whiskers' extent."""

_LEFT, _RIGHT, _BOTTOM, _TOP, _GAP = 10.0, 2.0, 8.5, 6.5, 10.0
"""Room around and between the views, mm on paper."""

_ROW = 4.0
"""Room of a row of the legend, mm."""

_NARROWEST = 0.11
"""Smallest half of an axis, as a share of the whiskers' extent."""


class _Drawn(NamedTuple):
    rest: Array
    lines: Array
    points: Array
    arrows: Array
    colours: list[str]
    labels: Sequence[str]


def bent_views(
    rest: ArrayLike,
    centerlines: ArrayLike,
    contact_points: ArrayLike | None = None,
    forces: ArrayLike | None = None,
    *,
    labels: Sequence[str] = (),
    width: Width = "double",
) -> Figure:
    """Draw a whisker bent in some ways, from above (x–y) and from the side (x–z), to one scale.

    Parameters
    ----------
    rest : array_like (n, 3)
        The resting whisker, from base to tip, whisker frame, m.
    centerlines : array_like (m, k, 3)
        The bent ones, m; those with NaN, which have no equilibrium, are left out.
    contact_points : array_like (m, 3), optional
        Where each is touched, m.
    forces : array_like (m, 3), optional
        On the whisker, whisker frame, N: drawn as arrows that end in the contact points, the
        longest a fifth as long as the whisker.
    labels : sequence of str, optional
        One for each. With up to four curves each has a colour of its own; more are shaded from
        first to last.
    width : {"single", "double"}
        Columns of the page: the views stand side by side in two, one below the other in one.

    Returns
    -------
    Figure
        Two axes, in mm; or the sentence "nothing bent".

    Raises
    ------
    ValueError
        If shapes do not fit, or there are forces without contact points.
    """
    straight, lines, points, force = _check(rest, centerlines, contact_points, forces)
    if labels and len(labels) != len(lines):
        raise ValueError(f"there are {len(labels)} labels for {len(lines)} bent whiskers")
    colours = _colours(len(lines))
    known = np.flatnonzero(np.isfinite(lines).all(axis=(1, 2)))
    with looking():
        if not known.size:
            figure = new_figure(width, 40.0, None)
            say(figure, "nothing bent")
            return figure
        extent = float(np.ptp(straight, axis=0).max())
        size = np.linalg.norm(force[known], axis=1)
        largest = float(np.nanmax(size)) if np.isfinite(size).any() else 0.0
        arrows = force[known] * (_ARROW * extent / largest if largest > 0.0 else np.nan)
        drawn = _Drawn(
            straight,
            lines[known],
            points[known],
            arrows,
            [colours[i] for i in known],
            [labels[int(i)] for i in known] if labels else (),
        )
        return _views(drawn, _limits(drawn, extent), width)


def _check(
    rest: ArrayLike,
    centerlines: ArrayLike,
    contact_points: ArrayLike | None,
    forces: ArrayLike | None,
) -> tuple[Array, Array, Array, Array]:
    """Places in mm, and forces, NaN where there are none."""
    straight, lines = to_display("centerline", rest), to_display("centerline", centerlines)
    none = np.full((len(lines), 3), np.nan) if lines.ndim else np.empty((0, 3))
    points = none if contact_points is None else to_display("contact_point", contact_points)
    force = none if forces is None else np.asarray(forces, dtype=np.float64)
    right = straight.ndim == 2 and lines.ndim == 3 and straight.shape[-1] == lines.shape[-1] == 3
    if not right or points.shape != none.shape or force.shape != none.shape:
        raise ValueError(
            f"rest, centerlines, contact points and forces have shapes {straight.shape}, "
            f"{lines.shape}, {points.shape} and {force.shape}; (n, 3), (m, k, 3), (m, 3) and "
            "(m, 3) are needed"
        )
    if forces is not None and contact_points is None:
        raise ValueError("there are forces without contact points: give both")
    return straight, lines, points, force


def _colours(count: int) -> list[str]:
    if count <= len(_COLOURS):
        return list(_COLOURS[:count])
    shades = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, count))
    return [mpl.colors.to_hex(shade) for shade in shades]


def _limits(drawn: _Drawn, extent: float) -> Array:
    """Limits (3, 2), mm, that hold whiskers and arrows."""
    parts = (drawn.rest, drawn.lines.reshape(-1, 3), drawn.points, drawn.points - drawn.arrows)
    everything = np.concatenate(parts)
    low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + 0.03 * extent
    half = np.maximum(half, _NARROWEST * extent)
    return np.stack([middle - half, middle + half], axis=1)


def _views(drawn: _Drawn, limits: Array, width: Width) -> Figure:
    page, span = page_width(width), np.ptp(limits, axis=1)
    beside = width == "double"
    room = page - _LEFT - _RIGHT
    scale = ((room - _GAP - _LEFT) / 2.0 if beside else room) / span[0]
    tall = scale * span[1:]
    below = 0.0 if beside else tall[1] + _GAP + _BOTTOM
    columns = 2 if beside else 1
    rows = -(-len(drawn.labels) // (2 * columns))
    height = (max(tall) if beside else tall[0]) + below + _BOTTOM + _TOP + _ROW * rows
    figure = new_figure(width, height, None)
    for number, j in enumerate((1, 2)):
        across = beside * number
        left = _LEFT + across * (scale * span[0] + _GAP + _LEFT)
        top = height - _TOP - _ROW * rows - (0.0 if beside else number * (tall[0] + _GAP + _BOTTOM))
        box = (left, top - tall[number], scale * span[0], tall[number])
        axes = box_axes(figure, box, xlim=limits[0], ylim=limits[j])
        _draw(axes, drawn, j)
        few = max(3, round(tall[number] / 10.0))
        axes.yaxis.set_major_locator(MaxNLocator(few, integer=True))
        axes.set(xlabel=axis_label("x"), ylabel=axis_label("xyz"[j]))
        head(axes, "ab"[number], ("from above", "from the side")[number])
    if drawn.labels:
        handles, texts = figure.axes[0].get_legend_handles_labels()
        # Above the views, from where the first begins.
        place = (_LEFT / page, 1.0 - 0.5 / height)
        figure.legend(
            handles, texts, loc="upper left", bbox_to_anchor=place, ncols=2 * columns, borderpad=0.0
        )
    return figure


def _draw(axes: Axes, drawn: _Drawn, j: int) -> None:
    """Whiskers, contacts and forces, seen along y or z."""
    rest = drawn.rest
    axes.plot(rest[:, 0], rest[:, j], color=_REST, linewidth=1.6, solid_capstyle="round")
    for i, (line, colour) in enumerate(zip(drawn.lines, drawn.colours, strict=True)):
        label = drawn.labels[i] if drawn.labels else None
        axes.plot(line[:, 0], line[:, j], color=colour, linewidth=1.1, label=label)
        point, arrow = drawn.points[i], drawn.arrows[i]
        if np.isfinite(arrow).all():
            axes.annotate(
                "",
                (point[0], point[j]),
                (point[0] - arrow[0], point[j] - arrow[j]),
                arrowprops={
                    "arrowstyle": "-|>,head_width=0.16,head_length=0.35",
                    "color": colour,
                    "linewidth": 1.0,
                    "shrinkA": 0.0,
                    "shrinkB": 0.0,
                },
            )
        axes.plot(point[0], point[j], "o", color=colour, markersize=2.6, zorder=5)
