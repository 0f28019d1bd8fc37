"""Contacts about the whisker and in the laboratory (the paper's Fig. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.plots.objects import Body, draw_body, draw_head, head_of, one_scale
from vibrissa.quantities import axis_label, to_display
from vibrissa.scene import Course, deflection_angles

_SNAPSHOTS = 7
_FACE = np.array([[-11.0, -26.0, 2.0], [11.0, -26.0, 2.0], [0.0, 0.0, 0.0]])
"""Visible part of the head: its eyes and the snout, mm."""

_ROOM = 2.0
"""Around what is to be seen, mm."""

_VIEWS = ((0, 1), (0, 2), (0, 1), (1, 2))
_TITLES = (
    "about the whisker, top",
    "about the whisker, front",
    "in the laboratory, top",
    "in the laboratory, side",
)


def contact_places(
    course: Course,
    centerline: ArrayLike,
    bodies: Sequence[Body] = (),
    fitted: Sequence[Body] = (),
    *,
    colour: Literal["time", "deflection_angle"] = "time",
    width: style.Width = "double",
) -> Figure:
    """Draw contacts in the whisker's frame and in the laboratory, each from two sides.

    In the whisker's frame they lie about the resting whisker, drawn black; in the laboratory, with
    the deflected whisker at some times and a simple head at its base, they gather where the object
    is.

    Parameters
    ----------
    course : Course
        The trial.
    centerline : array_like (k, 3)
        Resting whisker, whisker frame, m.
    bodies, fitted : sequence of object
        Objects as they are, filled grey, and as they were fitted to contacts, dashed: with
        ``signed_distance``, laboratory frame, m.
    colour : {"time", "deflection_angle"}
        Quantity that colours the contacts: their time, or the angle at the base between the resting
        whisker and the contact.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Four axes in mm, each of equal aspect, and a colour bar; or the sentence "no contacts".

    Raises
    ------
    ValueError
        If ``colour`` is another.
    """
    if colour not in ("time", "deflection_angle"):
        raise ValueError(f"colour is {colour!r}; time or deflection_angle is needed")
    line = np.asarray(centerline, dtype=np.float64)
    with style.looking():
        if course.places is None or not np.isfinite(course.places).any():
            return style.sentence("no contacts", width)
        rows = np.flatnonzero(np.isfinite(course.places).all(axis=1))
        own = course.at_base(course.places)[rows]
        shade = course.time[rows]
        if colour == "deflection_angle":
            shade = deflection_angles(course, line)[rows]
        shade = to_display(colour, shade)
        height, boxes, rail = _sheet(width)
        figure = style.new_figure(width, height, None)
        about = _about(figure, boxes[:2], own, line)
        there = _laboratory(figure, boxes[2:], course, course.places[rows], (bodies, fitted))
        own, lab = (to_display("contact_point", p) for p in (own, course.places[rows]))
        look: dict[str, Any] = style.shading(shade)
        size = 3.0 if width == "double" else 1.5
        for i, (axes, view) in enumerate(zip(about + there, _VIEWS, strict=True)):
            across, up = (own if i < len(about) else lab)[:, list(view)].T
            dots = axes.scatter(across, up, size, zorder=3, **look)
            axes.set(xlabel=axis_label("xyz"[view[0]]), ylabel=axis_label("xyz"[view[1]]))
            style.head(axes, "abcd"[i], _TITLES[i], left=4.0)
        bar = figure.colorbar(dots, cax=style.box_axes(figure, rail))
        style.plain(bar)
        bar.ax.set_title(axis_label(colour), pad=4.0)
        near, far = np.nanpercentile(np.linalg.norm(own, axis=1), [5.0, 95.0])
        style.conclude(
            figure,
            f"{len(own)} contact points, 90 % of them {near:.0f} to {far:.0f} mm from the base",
        )
        return figure


def _sheet(width: style.Width) -> tuple[float, tuple[style.Box, ...], style.Box]:
    """Height of the figure, panels and colour bar, mm."""
    if width == "double":
        wide, top, below = 70.0, 34.0, 54.0
        left = (11.0, 93.0)
    else:
        wide, top, below = 26.5, 22.0, 28.0
        left = (10.5, 47.5)
    bottom = 8.5
    upper = bottom + below + 14.0
    boxes = tuple((x, upper, wide, top) for x in left) + tuple(
        (x, bottom, wide, below) for x in left
    )
    return upper + top + 6.5, boxes, (left[1] + wide + 2.0, bottom, 1.8, 0.6 * below)


def _about(figure: Figure, boxes: Sequence[style.Box], own: Array, line: Array) -> list[Axes]:
    """Panels about the resting whisker."""
    rest, points = to_display("centerline", line), to_display("contact_point", own)
    limits = _limits(np.concatenate([rest, _inner(points)]))
    found = []
    views = _VIEWS[:2]
    ends = one_scale(limits, views, [box[2:] for box in boxes])
    for box, view, both in zip(boxes, views, ends, strict=True):
        axes = style.box_axes(figure, box, xlim=both[0], ylim=both[1])
        axes.plot(*rest[:, list(view)].T, color=style.INK, linewidth=1.0, zorder=2)
        found.append(axes)
    return found


def _laboratory(
    figure: Figure,
    boxes: Sequence[style.Box],
    course: Course,
    places: Array,
    bodies: tuple[Sequence[Body], Sequence[Body]],
) -> list[Axes]:
    """Panels with the head, the whisker at some times, and objects."""
    points = to_display("contact_point", places)
    lines = _snapshots(course)
    rat = head_of(course)
    # The head is seen as far as its eyes.
    face = 1e3 * rat.snout + _FACE @ rat.axes.T
    shown = np.concatenate([lines.reshape(-1, 3), _inner(points), face])
    limits = _limits(shown[np.isfinite(shown).all(axis=1)])
    views = _VIEWS[2:]
    ends = one_scale(limits, views, [box[2:] for box in boxes])
    found = []
    for box, view, both in zip(boxes, views, ends, strict=True):
        axes = style.box_axes(figure, box, xlim=both[0], ylim=both[1])
        draw_head(axes, rat, view)
        window = limits.copy()
        window[list(view)] = both
        for group, look in zip(bodies, ("true", "fitted"), strict=True):
            for body in group:
                draw_body(axes, body, view, window, look)
        for one in lines:
            axes.plot(*one[:, list(view)].T, color=style.MUTED, linewidth=0.4, zorder=2)
        found.append(axes)
    return found


def _snapshots(course: Course) -> Array:
    """The whisker (m, k, 3) at a few times in contact, mm."""
    if course.centerline is None:
        return np.full((1, 2, 3), np.nan)
    rows = np.flatnonzero(course.touching & np.isfinite(course.centerline).all(axis=(1, 2)))
    few = rows[np.linspace(0, max(len(rows) - 1, 0), min(_SNAPSHOTS, len(rows))).astype(int)]
    return to_display("centerline", course.centerline[few])


def _inner(points: Array) -> Array:
    """Lowest and highest of all points but the outermost."""
    return np.quantile(points, [0.02, 0.98], axis=0)


def _limits(points: Array) -> Array:
    low, high = points.min(axis=0), points.max(axis=0)
    return np.stack([low - _ROOM, high + _ROOM], axis=1)
