"""A trial as a movie: signals, their way through three solids, r, θ and φ (the S1 Movie)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from vibrissa.plots.course import TRIPLET, Course
from vibrissa.plots.curves import Curve, curve_legend, curves_over_time
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
from vibrissa.plots.solid_panels import solid_panels
from vibrissa.plots.style import INK, ORANGE, Array, looking
from vibrissa.quantities import to_display

_TRAIL = 0.05
"""How long the way just gone stays bold, s."""

_BOXES = tuple(
    (left, bottom, wide, 12.0)
    for left, wide in ((14.0, 83.0), (115.0, 86.0))
    for bottom in (35.0, 21.5, 8.0)
)


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
    time = to_display("time", course.time)
    with looking():
        figure = screen_figure()
        panels = [(66.5 * i + 0.5, 52.5, 66.5, 58.0) for i in range(3)]
        rails = [(66.5 * i + 59.7, 66.0, 1.6, 24.0) for i in range(3)]
        felt = np.stack([signals[name] for name in TRIPLET], axis=1)
        felt[~course.touching] = np.nan
        solids = solid_panels(figure, samples, centerline, panels, rails, felt[first : last + 1])
        places = signal_places(*felt.T)
        ways = [flattened(axes, places) for axes in solids]
        for axes, way in zip(solids, ways, strict=True):
            path = flat_line(axes, color=INK, linewidth=0.3, alpha=0.4)
            path.set_data(*way[first : last + 1].T)
        curves = curves_over_time(figure, _BOXES, course, signals, slice(first, last + 1))
        curve_legend(figure, course, (1.0 - 2.0 / WIDTH, 48.0 / HEIGHT))
        marks = [_mark(curve, time[first]) for curve in curves]
        clock = figure.text(0.5, 0.985, "", ha="center", va="top", fontsize=8.0, animated=True)
        trails = [flat_line(a, color=ORANGE, linewidth=1.6, animated=True) for a in solids]
        look = {"markeredgecolor": "white", "markeredgewidth": 0.6, "linestyle": "none"}
        dots = [
            flat_line(a, marker="o", markersize=5.5, color=ORANGE, animated=True, **look)
            for a in solids
        ]
        screen = Screen(figure)
    moving = [cursor for cursor, _ in marks] + [dot for _, dot in marks]
    for row in rows:
        begin = int(np.searchsorted(course.time, course.time[row] - _TRAIL))
        begin = max(begin, first)
        for way, trail, dot in zip(ways, trails, dots, strict=True):
            trail.set_data(*way[begin : row + 1].T)
            dot.set_data(*way[row : row + 1].T)
        for curve, (cursor, point) in zip(curves, marks, strict=True):
            cursor.set_xdata([time[row], time[row]])
            point.set_data([time[row]], curve.values[row : row + 1])
        clock.set_text(f"{time[row]:.3f} s" + (", in contact" if course.touching[row] else ""))
        yield screen.frame([*trails, *dots, *moving, clock])


def _mark(curve: Curve, time: float) -> tuple[Line2D, Line2D]:
    """A cursor and a dot that move over a curve."""
    cursor = curve.axes.axvline(time, color=ORANGE, linewidth=0.8, animated=True)
    dot = moving_line(curve.axes, marker="o", markersize=3.5, color=ORANGE, zorder=5)
    return cursor, dot
