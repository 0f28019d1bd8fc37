"""Signals and coordinates of the contact over the time of a trial, contact shaded."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vibrissa.plots.course import TRIPLET, Course, spherical
from vibrissa.plots.cylinder import Box
from vibrissa.plots.signals import intervals
from vibrissa.plots.solid_panels import COORDINATES
from vibrissa.plots.style import BLUE, MUTED, SHADE, Array, box_axes
from vibrissa.quantities import axis_label, to_display


class Curve(NamedTuple):
    """A panel over time, and what is drawn in it last, in display units, over all of the trial."""

    axes: Axes
    values: Array


def curves_over_time(
    figure: Figure, boxes: Sequence[Box], course: Course, signals: dict[str, Array], span: slice
) -> list[Curve]:
    """Draw F_x, M_B, M_D, r, θ and φ over time."""
    time = to_display("time", course.time)
    first, last = time[span][0], time[span][-1]
    contacts = intervals(time[span], course.touching[span])
    known, estimated = (
        None if points is None else spherical(points) for points in (course.known, course.estimated)
    )
    lowest = {left: min(b for at, b, _, _ in boxes if at == left) for left, *_ in boxes}
    curves = []
    for i, (name, box) in enumerate(zip((*TRIPLET, *COORDINATES), boxes, strict=True)):
        axes = box_axes(figure, box)
        for begin, end in contacts:
            axes.axvspan(begin, end, color=SHADE, linewidth=0.0, zorder=0)
        if name in TRIPLET:
            values = to_display(name, signals[name])
            if name == "MD":
                values = np.where(course.touching, values, np.nan)
            _signal(axes, name, time[span], values[span])
        else:
            true = course.known_as == "true"
            column = i - len(TRIPLET)
            values = _coordinate(axes, name, time, span, (known, estimated), column, true)
        axes.set_xlim(first, max(last, first + 1e-3))
        axes.set_ylabel(axis_label(name), fontsize=6.0)
        axes.locator_params(axis="y", nbins=4)
        if box[1] > lowest[box[0]]:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel(axis_label("time"))
        curves.append(Curve(axes, values))
    for left in lowest:
        beside = [c.axes for c, box in zip(curves, boxes, strict=True) if box[0] == left]
        figure.align_ylabels(beside)
    return curves


def _signal(axes: Axes, name: str, time: Array, values: Array) -> None:
    if name == "MD":
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
    true: bool,
) -> Array:
    """Draw a coordinate over time; give what was drawn last."""
    shown = np.full(time.size, np.nan)
    limits = []
    known, estimated = points
    if known is not None:
        shown = to_display(name, known[:, column])
        axes.plot(time[span], shown[span], color=MUTED, linewidth=1.6, zorder=1)
        # What is tracked may be wrong now and then, what is true is not.
        limits.append(_ends(shown[span], 0.0 if true else 0.01))
    if estimated is not None:
        shown = to_display(name, estimated[:, column])
        axes.plot(time[span], shown[span], ".", color=BLUE, markersize=1.6, zorder=2)
        limits.append(_ends(shown[span], 0.01))
    found = np.array(limits).reshape(-1, 2)
    found = found[np.isfinite(found).all(axis=1)]
    if len(found):
        low, high = found[:, 0].min(), found[:, 1].max()
        room = max(0.06 * (high - low), 1e-3)
        axes.set_ylim(low - room, high + room)
    else:
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", color=MUTED)
    return shown


def _ends(values: Array, left_out: float) -> Array:
    """Lowest and highest value, but for a share at either end; NaN if there are none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(2, np.nan)
    return np.asarray(np.quantile(finite, [left_out, 1.0 - left_out]))


def curve_legend(figure: Figure, course: Course, place: tuple[float, float]) -> None:
    """Say what shades, lines and dots of :func:`curves_over_time` mean."""
    handles: list[Line2D | Patch] = [Patch(facecolor=SHADE, label="in contact")]
    if course.known is not None:
        handles.append(Line2D([], [], color=MUTED, linewidth=1.6, label=course.known_as))
    if course.estimated is not None:
        look: dict[str, Any] = {"marker": ".", "markersize": 4.0, "linestyle": "none"}
        handles.append(Line2D([], [], color=BLUE, label="estimated", **look))
    figure.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=place,
        ncols=len(handles),
        borderaxespad=0.0,
    )
