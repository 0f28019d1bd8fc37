"""Figures of contacts in the whisker and laboratory frames (Fig. 6), and of errors (Fig. 4E)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.plots.space import Body, draw_body, draw_head, head_of, one_scale
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import COORDINATES, Course, deflection_angles, robust_limits

_SNAPSHOTS = 7
# Visible part of the head: its eyes and the snout, mm.
_FACE = np.array([[-11.0, -26.0, 2.0], [11.0, -26.0, 2.0], [0.0, 0.0, 0.0]])
_ROOM = 2.0  # margin of the views, mm
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
    """Draw contacts in the whisker frame and the laboratory frame, in two views each.

    In the whisker frame, contacts are around the resting whisker, which is black. In the laboratory
    frame they outline the object, and are drawn with the deflected whisker at some times and a
    sketch of the head.

    Parameters
    ----------
    course : Course
        Trial with contact points.
    centerline : array_like (k, 3)
        Resting whisker, whisker frame, m.
    bodies, fitted : sequence of object
        Known objects, filled grey, and shapes fitted to contacts, dashed: with
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
        own = course.at_base(course.places)
        rows = np.flatnonzero(np.isfinite(course.places + own).all(axis=1))
        if not rows.size:
            return style.sentence("no contacts of which the base is known", width)
        own = own[rows]
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
        bar = style.colour_bar(figure, dots, cax=style.box_axes(figure, rail))
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
    """Draw panels with the resting whisker."""
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
    """Draw panels with the head, the whisker at some times, and objects."""
    points = to_display("contact_point", places)
    lines = _snapshots(course)
    rat = head_of(course)
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
    """Whisker (m, k, 3) at a few times in contact, mm."""
    if course.centerline is None:
        return np.full((1, 2, 3), np.nan)
    rows = np.flatnonzero(course.touching & np.isfinite(course.centerline).all(axis=(1, 2)))
    few = rows[np.linspace(0, max(len(rows) - 1, 0), min(_SNAPSHOTS, len(rows))).astype(int)]
    return to_display("centerline", course.centerline[few])


def _inner(points: Array) -> Array:
    """Limits of all points but the outermost."""
    return np.quantile(points, [0.02, 0.98], axis=0)


def _limits(points: Array) -> Array:
    low, high = points.min(axis=0), points.max(axis=0)
    return np.stack([low - _ROOM, high + _ROOM], axis=1)


def estimated_against_true(
    true_spherical: ArrayLike,
    estimated_spherical: ArrayLike,
    *,
    time: ArrayLike | None = None,
    colour: ArrayLike | None = None,
    colour_name: str = "deflection_angle",
    known_as: str = "true",
) -> Figure:
    """Draw estimated against true r, θ and φ, and below both and the error over time.

    Parameters
    ----------
    true_spherical, estimated_spherical : array_like (n, 3)
        (r, θ, φ) of the contact points, whisker frame, m and rad; rows with NaN are left out.
    time : array_like (n,), optional
        Times of the frames, s; without them nothing is drawn over time.
    colour : array_like (n,), optional
        Values that colour the points, SI units: by default the time, if known.
    colour_name : str
        Name of the quantity ``colour``.
    known_as : str
        Word on the axes for the values that count as true, such as "tracked".

    Returns
    -------
    Figure
        Two columns wide, three panels a row, in mm and degrees; or the sentence "no contacts".
        Limits include the true values and 90 % of the errors; the number of values outside and the
        median absolute error are written above.

    Raises
    ------
    ValueError
        If shapes differ.
    """
    shades, name = (time, "time") if colour is None else (colour, colour_name)
    true, estimated, seconds, shade = _usable(true_spherical, estimated_spherical, time, shades)
    seconds = None if seconds is None else to_display("time", seconds)
    shade = None if shade is None else to_display(name, shade)
    with style.looking():
        figure = style.new_figure("double", 58.0 if seconds is None else 125.0, "constrained")
        if len(true) == 0:
            style.say(figure, "no contacts")
            return figure
        rows = 1 if seconds is None else 3
        ratios = [2.1, 1.0, 1.0][:rows]
        panels = figure.subplots(rows, 3, squeeze=False, height_ratios=ratios)
        look = style.shading(shade)
        for i, axis in enumerate(COORDINATES):
            pair = to_display(axis, true[:, i]), to_display(axis, estimated[:, i])
            dots = against(panels[0, i], axis, pair, look, known_as)
            style.head(panels[0, i], "abc"[i], quantity(axis).long_name)
            if seconds is not None:
                _course(panels[1, i], axis, seconds, pair, look)
                _errors(panels[2, i], axis, seconds, pair, look)
                _remark(panels[1, i], f"dots: estimated; line: {known_as}" if i == 0 else "")
        if shade is not None:
            # As tall as the panels of the first row, to their right.
            place: dict[str, Any] = {
                "shrink": 0.8 if rows == 1 else 0.4,
                "aspect": 22,
                "anchor": (0.0, 0.95),
            }
            style.colour_bar(figure, dots, ax=panels, label=axis_label(name), pad=0.01, **place)
        figure.align_ylabels(panels[:, 0])
        style.conclude(figure, f"{len(true)} contacts: {error_words(true, estimated, known_as)}")
        return figure


def error_words(true: Array, estimated: Array, known_as: str = "true") -> str:
    """Median errors of r, θ and φ, of coordinates in m and rad; of tracked ones: differences."""
    parts = []
    for i, name in enumerate(COORDINATES):
        pair = to_display(name, true[:, i]), to_display(name, estimated[:, i])
        row = quantity(name)
        unit = row.display_unit if row.display_unit == "°" else f" {row.display_unit}"
        error = np.median(np.abs(_difference(name, *pair)))
        parts.append(f"{error:.2g}{unit} in ${row.symbol}$")
    what = "error" if known_as == "true" else f"difference from {known_as} ones"
    return f"median {what} {parts[0]}, {parts[1]} and {parts[2]}"


def _usable(
    true: ArrayLike, estimated: ArrayLike, time: ArrayLike | None, shade: ArrayLike | None
) -> tuple[Array, Array, Array | None, Array | None]:
    """Rows in which nothing is missing; those of the largest shade last, to be drawn on top."""
    points = np.asarray(true, np.float64), np.asarray(estimated, np.float64)
    times = [None if values is None else np.asarray(values, np.float64) for values in (time, shade)]
    n = points[0].shape[:1]
    named = zip(("true_spherical", "estimated_spherical"), points, strict=True)
    shapes = {name: (values, (*n, 3)) for name, values in named}
    rows = style.usable_rows(times[1], shapes | {"time": (times[0], n), "colour": (times[1], n)})
    seconds, shades = (None if values is None else values[rows] for values in times)
    return points[0][rows], points[1][rows], seconds, shades


def _difference(name: str, true: Array, estimated: Array) -> Array:
    """Estimate minus truth, wrapped for the azimuth."""
    away = estimated - true
    return (away + 180.0) % 360.0 - 180.0 if name == "theta" else away


def _range(true: Array, estimated: Array) -> Array:
    """Limits that include all true values and most of the estimates, but no outliers."""
    low, high = robust_limits(true, share=1.0)
    span = high - low
    least, most = robust_limits(estimated, share=0.95)
    low, high = min(low, max(least, low - 0.5 * span)), max(high, min(most, high + 0.5 * span))
    room = 0.06 * (high - low)
    return np.array([low - room, high + room])


def against(
    axes: Axes, name: str, pair: tuple[Array, Array], look: dict[str, Any], known_as: str = "true"
) -> PathCollection:
    """Draw an estimated coordinate against the true one."""
    true, estimated = pair
    limits = _range(*pair)
    axes.plot(limits, limits, color=style.MUTED, linewidth=0.6, zorder=1)
    dots = axes.scatter(true, estimated, s=4.0, zorder=2, **look)
    axes.set(xlim=limits, ylim=limits, aspect="equal")
    axes.set(xlabel=f"{known_as} {axis_label(name)}", ylabel=f"estimated {axis_label(name)}")
    if outside := int(((estimated < limits[0]) | (estimated > limits[1])).sum()):
        _remark(axes, f"{outside} of {true.size} outside")
    return dots


def _course(
    axes: Axes, name: str, time: Array, pair: tuple[Array, Array], look: dict[str, Any]
) -> None:
    axes.scatter(time, pair[1], s=3.0, zorder=2, **look)
    axes.plot(*_broken(time, pair[0]), color=style.MUTED, linewidth=1.4, zorder=1)
    axes.set_ylim(*_range(*pair))
    axes.set_ylabel(axis_label(name))
    axes.tick_params(labelbottom=False)


def _errors(
    axes: Axes, name: str, time: Array, pair: tuple[Array, Array], look: dict[str, Any]
) -> None:
    error = _difference(name, *pair)
    axes.axhline(0.0, color=style.MUTED, linewidth=0.6, zorder=1)
    axes.scatter(time, error, s=3.0, zorder=2, **look)
    axes.set_ylim(*1.1 * robust_limits(error, share=0.9, symmetric=True))
    axes.set(xlabel=axis_label("time"), ylabel=axis_label(f"error_{name}"))
    unit = quantity(name).display_unit
    size = f"{np.median(np.abs(error)):.2g}{'' if unit == '°' else ' '}{unit}"
    low, high = axes.get_ylim()
    shown = 100.0 * float(np.mean((error >= low) & (error <= high)))
    _remark(axes, f"median {size}, {round(shown)} % shown")


def _remark(axes: Axes, words: str) -> None:
    """Write a text above the upper right corner of a panel."""
    axes.set_title(words, loc="right", fontsize=style.SMALL, color=style.MUTED, pad=3.0)


def _broken(time: Array, values: Array) -> tuple[Array, Array]:
    """Line over time with gaps where frames are missing."""
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    step = np.diff(time)
    if step.size == 0:
        return time, values
    gaps = np.flatnonzero(step > 3.0 * np.median(step)) + 1
    return np.insert(time, gaps, np.nan), np.insert(values, gaps, np.nan)
