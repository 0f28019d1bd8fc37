"""A trial as a movie: both views, contacts about the whisker, the contour (the S2 Movie)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import CircleCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from vibrissa.plots.colours import sequential
from vibrissa.plots.course import Course
from vibrissa.plots.outlines import Body, draw_body, one_scale, room_for
from vibrissa.plots.screen import (
    Picture,
    Screen,
    flat_line,
    flattened,
    moving_line,
    screen_figure,
)
from vibrissa.plots.sights import Sight, Window, part_of, scale_bar, seen, sight_axes
from vibrissa.plots.space import bounds, name_axes, space_axes
from vibrissa.plots.style import RED, Array, box_axes, looking, plain
from vibrissa.quantities import axis_label, to_display

_SIDES = ((0, 1), (0, 2), (1, 2))
_SIDE_BOXES = ((13.0, 9.5, 48.0, 40.0), (76.0, 9.5, 48.0, 40.0), (139.0, 9.5, 48.0, 40.0))
_SIGHT_BOXES = ((2.5, 57.0, 64.0, 48.0), (69.0, 57.0, 64.0, 48.0))
_SPACE_BOX = (131.5, 46.0, 66.0, 66.0)
_RAIL = (191.5, 9.5, 1.8, 30.0)
_CONTACT: dict[str, Any] = {
    "marker": "o",
    "markersize": 4.5,
    "color": "#f0e442",
    "markeredgecolor": "black",
    "markeredgewidth": 0.6,
    "linestyle": "none",
}


class _Part(NamedTuple):
    """A panel: what moves in it, and where that is in each frame of the trial."""

    line: Line2D
    lines: Array
    dot: Line2D
    dots: Array


class _Cloud(NamedTuple):
    """Points that stay, and where they lie in a panel."""

    points: CircleCollection
    places: Array


class _Sight(NamedTuple):
    """A panel for what a camera sees, and which part of its images is shown there."""

    axes: Axes
    low: Array
    high: Array
    size: tuple[int, int]


def contour_frames(
    course: Course,
    centerline: ArrayLike,
    sights: Sequence[Sight],
    rows: ArrayLike,
    bodies: Sequence[Body] = (),
    fitted: Sequence[Body] = (),
) -> Iterator[Picture]:
    """Draw the frames of a movie: what cameras see, and contacts as they come.

    Above both views with the traced whisker and the contact point, and contacts about the resting
    whisker; below contacts in the laboratory from above, from the front and from the side, with
    the objects if these are known. Colours of contacts tell their time.

    Parameters
    ----------
    course : Course
        Of the trial, with contact points.
    centerline : array_like (k, 3)
        Of the resting whisker, whisker frame, m.
    sights : sequence of Sight
        One or two views, each with an image for each row.
    rows : array_like (m,) of int
        Which frames of the trial, rising. Contacts in between are shown too.
    bodies, fitted : sequence of object
        Objects as they are, filled grey, and as they were fitted to contacts, dashed: with
        ``signed_distance``, laboratory frame, m.

    Returns
    -------
    iterator of array (720, 1280, 4)
        8 bit red, green, blue and opacity, one for each row.

    Raises
    ------
    ValueError
        If the trial has no contact points in these rows, there are no rows, or more than two views.
    """
    chosen = np.asarray(rows, dtype=np.intp)
    if chosen.size == 0:
        raise ValueError("no frames of the trial are chosen")
    if len(sights) > len(_SIGHT_BOXES):
        raise ValueError(f"there are {len(sights)} views; one or two can be shown")
    span = slice(chosen[0], chosen[-1] + 1)
    if course.places is None or not np.isfinite(course.places[span]).any():
        raise ValueError("the trial has no contact points from the first to the last chosen frame")
    return _frames(course, course.places, centerline, sights, chosen, (bodies, fitted))


def _frames(
    course: Course,
    places: Array,
    centerline: ArrayLike,
    sights: Sequence[Sight],
    rows: Any,
    bodies: tuple[Sequence[Body], Sequence[Body]],
) -> Iterator[Picture]:
    first, last = int(rows[0]), int(rows[-1])
    time = to_display("time", course.time)
    norm = Normalize(time[first], max(time[last], time[first] + 1e-3))
    with looking():
        figure = screen_figure()
        panels, parts = _views(figure, course, sights, slice(first, last + 1))
        clouds = []
        part, cloud = _about_whisker(figure, course, places, centerline, slice(first, last + 1))
        parts.append(part)
        clouds.append(cloud)
        for part, cloud in _sides(figure, course, places, bodies, slice(first, last + 1)):
            parts.append(part)
            clouds.append(cloud)
        _bar(figure, norm)
        clock = figure.text(0.0125, 0.985, "", va="top", fontsize=8.0, animated=True)
        screen = Screen(figure)
    windows = [Window(low, high, size, screen.pixels(axes)) for axes, low, high, size in panels]
    streams = [iter(sight.images) for sight in sights]
    colours = sequential()(norm(time))
    before = first - 1
    for row in rows:
        new = np.arange(before + 1, row + 1)
        new = new[np.isfinite(places[new]).all(axis=1)]
        before = int(row)
        if new.size:
            for points, there in clouds:
                points.set_offsets(there[new])
                points.set_facecolor(colours[new])
            screen.keep([points for points, _ in clouds])
        images = [
            (panel.axes, window.of(next(stream)))
            for panel, window, stream in zip(panels, windows, streams, strict=True)
        ]
        for line, lines, dot, dots in parts:
            line.set_data(*lines[row].T)
            dot.set_data(*dots[row : row + 1].T)
        clock.set_text(f"{time[row]:.3f} s" + (", in contact" if course.touching[row] else ""))
        drawn: list[Artist] = [artist for part in parts for artist in (part.line, part.dot)]
        yield screen.frame([*drawn, clock], images)


def _views(
    figure: Figure, course: Course, sights: Sequence[Sight], span: slice
) -> tuple[list[_Sight], list[_Part]]:
    """Panels for what the cameras see."""
    panels, parts = [], []
    views = [sight.view for sight in sights]
    for number, (view, box) in enumerate(zip(views, _SIGHT_BOXES, strict=False)):
        lines, dots = seen(course, views, number)
        low, high = part_of(lines[span], box[2:], view.size)
        axes = sight_axes(figure, box, low, high)
        axes.set_title(view.name, loc="right", pad=2.0)
        scale_bar(axes, course, view)
        line = moving_line(axes, color=RED, linewidth=0.8)
        dot = moving_line(axes, **_CONTACT)
        panels.append(_Sight(axes, low, high, view.size))
        parts.append(_Part(line, lines, dot, dots))
    return panels, parts


def _about_whisker(
    figure: Figure, course: Course, places: Array, centerline: ArrayLike, span: slice
) -> tuple[_Part, _Cloud]:
    """Contacts in the whisker's frame, with the resting and the deflected whisker."""
    rest = to_display("centerline", centerline)
    points = to_display("contact_point", course.at_base(places))
    count = len(course.time)
    lines = np.full((count, 2, 3), np.nan)
    if course.centerline is not None:
        lines = to_display("centerline", course.at_base(course.centerline))
    shown = [rest, points[span].reshape(-1, 3), lines[span][course.touching[span]].reshape(-1, 3)]
    axes = space_axes(figure, _SPACE_BOX, bounds(np.concatenate(shown)), zoom=0.9)
    name_axes(axes, (-7.0, -8.0, -9.0))
    axes.plot(*rest.T, color="black", linewidth=1.2)
    figure.text(0.72, 0.958, "contacts about the resting whisker", va="top", fontsize=7.0)
    cloud = CircleCollection(
        [0.7 * _dot_size(int(np.isfinite(points[span]).all(axis=1).sum()))],
        offsets=np.empty((0, 2)),
        offset_transform=axes.transData,
        animated=True,
    )
    figure.add_artist(cloud)
    line = flat_line(axes, color=RED, linewidth=0.8, animated=True)
    dot = flat_line(axes, animated=True, **_CONTACT)
    there = flattened(axes, points)
    return _Part(line, flattened(axes, lines), dot, there), _Cloud(cloud, there)


def _sides(
    figure: Figure,
    course: Course,
    places: Array,
    bodies: tuple[Sequence[Body], Sequence[Body]],
    span: slice,
) -> Iterator[tuple[_Part, _Cloud]]:
    """Contacts in the laboratory from three sides."""
    points = to_display("contact_point", places)
    known = points[span][np.isfinite(points[span]).all(axis=1)]
    limits = room_for(known, [*bodies[0], *bodies[1]])
    sizes = [box[2:] for box in _SIDE_BOXES]
    count = len(course.time)
    line = np.full((count, 2, 3), np.nan)
    if course.centerline is not None:
        line = to_display("centerline", course.centerline)
    ends = one_scale(limits, _SIDES, sizes)
    for view, both, box, title in zip(
        _SIDES, ends, _SIDE_BOXES, ("from above", "from the front", "from the side"), strict=True
    ):
        i, j = view
        axes = box_axes(figure, box, xlim=both[0], ylim=both[1])
        axes.set(xlabel=axis_label("xyz"[i]), ylabel=axis_label("xyz"[j]))
        axes.set_title(title, loc="left", pad=3.0)
        for group, look in zip(bodies, ("true", "fitted"), strict=True):
            for body in group:
                draw_body(axes, body, view, _window(limits, view, both), look)
        cloud = CircleCollection(
            [_dot_size(len(known))],
            offsets=np.empty((0, 2)),
            offset_transform=axes.transData,
            animated=True,
            zorder=3,
        )
        axes.add_collection(cloud, autolim=False)
        moving = moving_line(axes, color=RED, linewidth=0.8)
        dot = moving_line(axes, **_CONTACT)
        there = points[:, list(view)]
        yield _Part(moving, line[..., list(view)], dot, there), _Cloud(cloud, there)


def _dot_size(count: int) -> float:
    """Area of the dots for so many contacts, square points: many are drawn small."""
    return float(np.clip(7.0 * (300.0 / max(count, 1)) ** 0.7, 1.5, 7.0))


def _window(limits: Array, view: tuple[int, int], both: Array) -> Array:
    """Limits of a panel, and along the line of sight those of the contacts."""
    window = limits.copy()
    window[list(view)] = both
    return window


def _bar(figure: Figure, norm: Normalize) -> None:
    rail = box_axes(figure, _RAIL)
    bar = figure.colorbar(ScalarMappable(norm, sequential()), cax=rail)
    plain(bar)
    rail.set_title(axis_label("time"), fontsize=6.5, pad=4.0)
    rail.tick_params(length=2.0, pad=1.5)
