"""A trial as a movie: signals, their way through three solids, r, θ and φ (the S1 Movie)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from vibrissa.plots.course import TRIPLET, Course, spherical
from vibrissa.plots.cylinder import signal_places
from vibrissa.plots.screen import (
    HEIGHT,
    WIDTH,
    Picture,
    Screen,
    flat_line,
    flattened,
    moving_line,
    screen_figure,
)
from vibrissa.plots.signals import intervals
from vibrissa.plots.solid_panels import COORDINATES, solid_panels
from vibrissa.plots.style import BLUE, INK, MUTED, ORANGE, SHADE, Array, box_axes, looking
from vibrissa.quantities import axis_label, to_display

_TRAIL = 0.05
"""How long the way just gone stays bold, s."""

_ROWS = (35.0, 21.5, 8.0)
_TALL = 12.0
_TURNING = ("MD", "theta", "phi")


class _Curve(NamedTuple):
    """A panel over time with what moves in it."""

    values: Array
    cursor: Line2D
    dot: Line2D


def signal_frames(
    course: Course, samples: xr.Dataset, centerline: ArrayLike, rows: ArrayLike
) -> Iterator[Picture]:
    """Draw the frames of a movie: signals, a dot in the three solids, r, θ and φ over time.

    Parameters
    ----------
    course : Course
        Of the trial, with signals.
    samples : Dataset
        ``ContactMap.to_dataset()`` of the whisker.
    centerline : array_like (k, 3)
        Of the resting whisker, whisker frame, m.
    rows : array_like (m,) of int
        Which frames of the trial, rising; time axes reach from the first to the last.

    Returns
    -------
    iterator of array (720, 1280, 4)
        8 bit red, green, blue and opacity, one for each row.

    Raises
    ------
    ValueError
        If the trial has no signals, or there are no rows.
    """
    if course.signals is None:
        raise ValueError("the trial has no signals: F_x, M_B and M_D are needed")
    chosen = np.asarray(rows, dtype=np.intp)
    if chosen.size == 0:
        raise ValueError("no frames of the trial are chosen")
    return _frames(course, course.signals, samples, centerline, chosen)


def _frames(
    course: Course,
    signals: dict[str, Array],
    samples: xr.Dataset,
    centerline: ArrayLike,
    rows: Any,
) -> Iterator[Picture]:
    first, last = int(rows[0]), int(rows[-1])
    with looking():
        figure = screen_figure()
        panels = [(66.5 * i + 0.5, 52.5, 66.5, 58.0) for i in range(3)]
        rails = [(66.5 * i + 62.0, 66.0, 1.6, 24.0) for i in range(3)]
        felt = np.stack([signals[name] for name in TRIPLET], axis=1)
        felt[~course.touching] = np.nan
        solids = solid_panels(figure, samples, centerline, panels, rails, felt[first : last + 1])
        places = signal_places(*felt.T)
        ways = [flattened(axes, places) for axes in solids]
        for axes, way in zip(solids, ways, strict=True):
            path = flat_line(axes, color=INK, linewidth=0.35, alpha=0.6)
            path.set_data(*way[first : last + 1].T)
        curves = _curves(figure, course, signals, first, last)
        clock = figure.text(0.5, 0.985, "", ha="center", va="top", fontsize=8.0, animated=True)
        trails = [flat_line(a, color=ORANGE, linewidth=1.6, animated=True) for a in solids]
        look = {"markeredgecolor": "white", "markeredgewidth": 0.6, "linestyle": "none"}
        dots = [
            flat_line(a, marker="o", markersize=5.5, color=ORANGE, animated=True, **look)
            for a in solids
        ]
        screen = Screen(figure)
    time = to_display("time", course.time)
    moving = [curve.cursor for curve in curves] + [curve.dot for curve in curves]
    for row in rows:
        begin = int(np.searchsorted(course.time, course.time[row] - _TRAIL))
        begin = max(begin, first)
        for way, trail, dot in zip(ways, trails, dots, strict=True):
            trail.set_data(*way[begin : row + 1].T)
            dot.set_data(*way[row : row + 1].T)
        for curve in curves:
            curve.cursor.set_xdata([time[row], time[row]])
            curve.dot.set_data([time[row]], curve.values[row : row + 1])
        clock.set_text(f"{time[row]:.3f} s" + (", in contact" if course.touching[row] else ""))
        yield screen.frame([*trails, *dots, *moving, clock])


def _curves(
    figure: Figure, course: Course, signals: dict[str, Array], first: int, last: int
) -> list[_Curve]:
    """Signals at the left, coordinates at the right."""
    span = slice(first, last + 1)
    time = to_display("time", course.time)
    contacts = intervals(time[span], course.touching[span])
    known, estimated = (
        None if points is None else spherical(points) for points in (course.known, course.estimated)
    )
    curves = []
    for i, (name, bottom) in enumerate(zip((*TRIPLET, *COORDINATES), _ROWS * 2, strict=True)):
        left, wide = (14.0, 83.0) if i < 3 else (115.0, 86.0)
        axes = box_axes(figure, (left, bottom, wide, _TALL))
        for begin, end in contacts:
            axes.axvspan(begin, end, color=SHADE, linewidth=0.0, zorder=0)
        if i < 3:
            values = to_display(name, signals[name])
            if name == "MD":
                values = np.where(course.touching, values, np.nan)
            _points_or_line(axes, name, time[span], values[span])
        else:
            values = _coordinate(axes, name, time, span, (known, estimated), i - 3)
        axes.set_xlim(time[first], max(time[last], time[first] + 1e-3))
        axes.set_ylabel(axis_label(name), fontsize=6.0)
        axes.locator_params(axis="y", nbins=4)
        if i % 3 < 2:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel(axis_label("time"))
        cursor = axes.axvline(time[first], color=ORANGE, linewidth=0.8, animated=True)
        dot = moving_line(axes, marker="o", markersize=3.5, color=ORANGE, zorder=5)
        curves.append(_Curve(values, cursor, dot))
    figure.align_ylabels(figure.axes[-3:])
    _legend(figure, course)
    return curves


def _points_or_line(axes: Axes, name: str, time: Array, values: Array) -> None:
    if name in _TURNING:
        axes.plot(time, values, ".", color=BLUE, markersize=1.6)
        axes.set_ylim(-190.0, 190.0)
        axes.set_yticks([-180.0, 0.0, 180.0])
        return
    axes.axhline(0.0, color="#bfbfbf", linewidth=0.5, zorder=1)
    axes.plot(time, values, color=BLUE)


def _coordinate(
    axes: Axes,
    name: str,
    time: Array,
    span: slice,
    points: tuple[Array | None, Array | None],
    column: int,
) -> Array:
    """Draw a coordinate over time; what the dot follows."""
    shown = np.full(time.size, np.nan)
    limits = []
    known, estimated = points
    if known is not None:
        shown = to_display(name, known[:, column])
        axes.plot(time[span], shown[span], color=MUTED, linewidth=1.6, zorder=1)
        limits.append(shown[span])
    if estimated is not None:
        shown = to_display(name, estimated[:, column])
        axes.plot(time[span], shown[span], ".", color=BLUE, markersize=1.6, zorder=2)
        limits.append(shown[span])
    if limits:
        axes.set_ylim(*_limits(limits))
    else:
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", color=MUTED)
    return shown


def _limits(courses: list[Array]) -> tuple[float, float]:
    """All of the first, and of others most."""
    ends = [np.nanquantile(v, q) for v, q in zip(courses, ([0.0, 1.0], [0.01, 0.99]), strict=False)]
    low, high = min(e[0] for e in ends), max(e[1] for e in ends)
    room = max(0.06 * (high - low), 1e-3)
    return float(low - room), float(high + room)


def _legend(figure: Figure, course: Course) -> None:
    handles: list[Line2D | Patch] = [Patch(facecolor=SHADE, label="in contact")]
    if course.known is not None:
        handles.append(Line2D([], [], color=MUTED, linewidth=1.6, label=course.known_as))
    if course.estimated is not None:
        look: dict[str, Any] = {"marker": ".", "markersize": 4.0, "linestyle": "none"}
        handles.append(Line2D([], [], color=BLUE, label="estimated", **look))
    figure.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0 - 2.0 / WIDTH, 48.0 / HEIGHT),
        ncols=len(handles),
        borderaxespad=0.0,
    )
