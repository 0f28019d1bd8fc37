"""Movies of trials, in which the static background is drawn once.

A figure of three solids takes seconds to draw, a marker hardly any time. The figure is therefore
drawn once and stored as a picture; for every frame the picture is restored and only animated
artists are drawn. Some of these are eventually added to the picture permanently.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import xarray as xr
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import CircleCollection, LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array, spherical
from vibrissa.plots import overview, space, style
from vibrissa.plots.contact_surfaces import course_scales, solid_panels
from vibrissa.quantities import axis_label, to_display
from vibrissa.scene import TRIPLET, Course

Picture = NDArray[np.uint8]

# Size of a movie's figure, mm: lettering is as large in it as on a page of two columns.
WIDTH, HEIGHT = 203.2, 114.3
SIZE = (1280, 720)  # size of a movie, pixels
_DPI = 160.0


def screen_figure() -> Figure:
    """Create the empty figure of a movie."""
    figure = style.sized_figure(WIDTH, HEIGHT)
    figure.set_dpi(_DPI)
    return figure


class Screen:
    """Figure of which only some artists are redrawn in each frame."""

    def __init__(self, figure: Figure) -> None:
        self._figure = figure
        # Matplotlib gives this canvas no types.
        self._agg = cast("Any", FigureCanvasAgg(figure))
        with style.looking():
            self._agg.draw()
        self._background = self._agg.copy_from_bbox(figure.bbox)

    def keep(self, artists: Iterable[Artist]) -> None:
        """Add artists that are drawn in all further frames."""
        self._agg.restore_region(self._background)
        self._draw(artists)
        self._background = self._agg.copy_from_bbox(self._figure.bbox)

    def frame(
        self, artists: Iterable[Artist], images: Iterable[tuple[Axes, Picture]] = ()
    ) -> Picture:
        """Draw one frame."""
        self._agg.restore_region(self._background)
        buffer = np.asarray(self._agg.buffer_rgba())
        for axes, image in images:
            left, top, width, height = self._place(axes)
            buffer[top : top + height, left : left + width, :3] = image[..., None]
        self._draw(artists)
        return buffer.copy()

    def pixels(self, axes: Axes) -> tuple[int, int]:
        """Size of a panel, pixels."""
        return self._place(axes)[2:]

    def _place(self, axes: Axes) -> tuple[int, int, int, int]:
        """Left, top, width and height, pixels from the upper left."""
        (left, bottom), (right, top) = np.round(axes.bbox.get_points()).astype(int)
        return left, SIZE[1] - top, right - left, top - bottom

    def _draw(self, artists: Iterable[Artist]) -> None:
        renderer = self._agg.get_renderer()
        for artist in artists:
            artist.draw(renderer)


def moving_line(axes: Any, **look: Any) -> Line2D:
    """Add an animated line."""
    (line,) = axes.plot([], [], animated=True, **look)
    assert isinstance(line, Line2D)
    return line


def flat_line(axes: Any, **look: Any) -> Line2D:
    """Add a line to 3D axes in the plane of projection; see :func:`flattened`."""
    line = Line2D([], [], transform=axes.transData, **look)
    line.set_clip_on(False)
    axes.figure.add_artist(line)
    return line


def flattened(axes: Any, places: Array) -> Array:
    """Project positions in space to the figure."""
    from mpl_toolkits.mplot3d import proj3d  # type: ignore[import-untyped]

    # Matplotlib sets the size of the box of space only while it draws.
    axes.apply_aspect()
    flat = places.reshape(-1, 3)
    x, y, _ = proj3d.proj_transform(*flat.T, axes.get_proj())
    return np.stack([np.asarray(x), np.asarray(y)], axis=-1).reshape(*places.shape[:-1], 2)


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
    """Panel with animated artists, and their positions in each frame of the trial."""

    line: Line2D
    lines: Array
    dot: Line2D
    dots: Array


class _Cloud(NamedTuple):
    """Static points, and their positions in a panel."""

    points: CircleCollection
    places: Array


# Distance from a contact within which an outline appears, as a share of the view's width.
_REVEALED = 0.05
# Looks of the outlines of true objects and of fitted shapes.
_OUTLINES: tuple[dict[str, Any], ...] = (
    {"color": style.MUTED, "linewidth": 1.6, "zorder": 1.5},
    {"color": style.ORANGE, "linewidth": 0.9, "zorder": 2.0},
)


class _Outline:
    """Outline (n, 2, 2) that is revealed near contacts."""

    def __init__(self, axes: Axes, segments: Array, reach: float, look: dict[str, Any]) -> None:
        self.lines = LineCollection([], animated=True, **look)
        axes.add_collection(self.lines, autolim=False)
        self._segments, self._reach = segments, reach
        self._shown = np.zeros(len(segments), dtype=bool)

    def reveal(self, contacts: Array | None) -> None:
        """Show the part near contacts (n, 2); all of it without contacts."""
        middle = self._segments.mean(axis=1)
        if contacts is None:
            self._shown[:] = True
        elif middle.size:
            away = np.linalg.norm(middle[:, None] - contacts, axis=-1)
            self._shown |= away.min(axis=1) < self._reach
        self.lines.set_segments(list(self._segments[self._shown]))


class _Sight(NamedTuple):
    """Panel for a camera view, and the part of its images shown there."""

    axes: Axes
    low: Array
    high: Array
    size: tuple[int, int]


def contour_frames(
    course: Course,
    centerline: ArrayLike,
    sights: Sequence[overview.Sight],
    rows: ArrayLike,
    bodies: Sequence[space.Body] = (),
    fitted: Sequence[space.Body] = (),
) -> Iterator[Picture]:
    """Draw the frames of a movie: camera views, and a contour that grows contact by contact.

    The upper row shows the camera views with the traced whisker and the contact point, and contacts
    around the resting whisker; the lower row shows contacts in the laboratory from above, the front
    and the side, coloured by time. The outlines of objects and fitted shapes appear near contacts,
    and are complete in the last frame.

    Parameters
    ----------
    course : Course
        Trial with contact points.
    centerline : array_like (k, 3)
        Resting whisker, whisker frame, m.
    sights : sequence of Sight
        One or two views, each with an image for each row.
    rows : array_like (m,) of int
        Indices of the trial's frames, increasing. Contacts in between are shown too.
    bodies, fitted : sequence of object
        True objects, grey, and shapes fitted to the contacts, orange: with ``signed_distance``,
        laboratory frame, m.

    Returns
    -------
    iterator of array (720, 1280, 4)
        Images with 8-bit red, green, blue and opacity, one per row.

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
    return _contour_frames(course, course.places, centerline, sights, chosen, (bodies, fitted))


def _contour_frames(
    course: Course,
    places: Array,
    centerline: ArrayLike,
    sights: Sequence[overview.Sight],
    rows: Any,
    bodies: tuple[Sequence[space.Body], Sequence[space.Body]],
) -> Iterator[Picture]:
    first, last = int(rows[0]), int(rows[-1])
    span = slice(first, last + 1)
    time = to_display("time", course.time)
    norm = Normalize(time[first], max(time[last], time[first] + 1e-3))
    with style.looking():
        figure = screen_figure()
        panels, parts = _views(figure, course, sights, span)
        part, cloud = _about_whisker(figure, course, places, centerline, span)
        parts.append(part)
        clouds, outlines = [cloud], []
        for part, cloud, lines_of in _sides(figure, course, places, bodies, span):
            parts.append(part)
            clouds.append(cloud)
            outlines += [(outline, cloud.places) for outline in lines_of]
        rail = style.box_axes(figure, _RAIL)
        style.colour_bar(figure, ScalarMappable(norm, style.sequential()), cax=rail)
        rail.set_title(axis_label("time"), pad=4.0)
        rail.tick_params(length=2.0, pad=1.5)
        clock = figure.text(0.0125, 0.985, "", va="top", fontsize=style.LARGE, animated=True)
        screen = Screen(figure)
    windows = [
        overview.Window(low, high, size, screen.pixels(axes)) for axes, low, high, size in panels
    ]
    streams = [iter(sight.images) for sight in sights]
    colours = style.sequential()(norm(time))
    before = first - 1
    for row in rows:
        new = np.arange(before + 1, row + 1)
        new = new[np.isfinite(places[new]).all(axis=1)]
        before = int(row)
        if new.size:
            for points, there in clouds:
                points.set_offsets(there[new])
                points.set_facecolor(colours[new])
            for outline, there in outlines:
                outline.reveal(there[new])
        if row == rows[-1]:
            for outline, _ in outlines:
                outline.reveal(None)
        if new.size or row == rows[-1]:
            grown = [outline.lines for outline, _ in outlines]
            screen.keep([*grown, *(points for points, _ in clouds)])
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
    figure: Figure, course: Course, sights: Sequence[overview.Sight], span: slice
) -> tuple[list[_Sight], list[_Part]]:
    """Create panels for the camera views."""
    panels, parts = [], []
    views = [sight.view for sight in sights]
    for number, (view, box) in enumerate(zip(views, _SIGHT_BOXES, strict=False)):
        lines, dots = overview.seen(course, views, number)
        low, high = overview.part_of(lines[span], box[2:], view.size)
        axes = overview.sight_axes(figure, box, low, high)
        axes.set_title(view.name, loc="right", pad=2.0)
        overview.scale_bar(axes, course, view)
        line = moving_line(axes, **style.TRACE)
        dot = moving_line(axes, **_CONTACT)
        panels.append(_Sight(axes, low, high, view.size))
        parts.append(_Part(line, lines, dot, dots))
    return panels, parts


def _about_whisker(
    figure: Figure, course: Course, places: Array, centerline: ArrayLike, span: slice
) -> tuple[_Part, _Cloud]:
    """Draw contacts in the whisker's frame, with the resting and the deflected whisker."""
    rest = to_display("centerline", centerline)
    points = to_display("contact_point", course.at_base(places))
    count = len(course.time)
    lines = np.full((count, 2, 3), np.nan)
    if course.centerline is not None:
        lines = to_display("centerline", course.at_base(course.centerline))
    shown = [rest, points[span].reshape(-1, 3), lines[span][course.touching[span]].reshape(-1, 3)]
    axes = space.space_axes(figure, _SPACE_BOX, space.bounds(np.concatenate(shown)), zoom=0.9)
    space.name_axes(axes, (-7.0, -8.0, -9.0))
    axes.plot(*rest.T, color="black", linewidth=1.2)
    figure.text(0.72, 0.958, "contacts about the resting whisker", va="top")
    cloud = CircleCollection(
        [0.7 * _dot_size(int(np.isfinite(points[span]).all(axis=1).sum()))],
        offsets=np.empty((0, 2)),
        offset_transform=axes.transData,
        animated=True,
    )
    figure.add_artist(cloud)
    line = flat_line(axes, animated=True, **style.TRACE)
    dot = flat_line(axes, animated=True, **_CONTACT)
    there = flattened(axes, points)
    return _Part(line, flattened(axes, lines), dot, there), _Cloud(cloud, there)


def _sides(
    figure: Figure,
    course: Course,
    places: Array,
    bodies: tuple[Sequence[space.Body], Sequence[space.Body]],
    span: slice,
) -> Iterator[tuple[_Part, _Cloud, list[_Outline]]]:
    """Draw contacts in the laboratory from three sides; yield panels with hidden outlines."""
    points = to_display("contact_point", places)
    known = points[span][np.isfinite(points[span]).all(axis=1)]
    limits = space.room_for(known, [*bodies[0], *bodies[1]])
    sizes = [box[2:] for box in _SIDE_BOXES]
    count = len(course.time)
    line = np.full((count, 2, 3), np.nan)
    if course.centerline is not None:
        line = to_display("centerline", course.centerline)
    ends = space.one_scale(limits, _SIDES, sizes)
    for view, both, box, title in zip(
        _SIDES, ends, _SIDE_BOXES, ("from above", "from the front", "from the side"), strict=True
    ):
        i, j = view
        axes = style.box_axes(figure, box, xlim=both[0], ylim=both[1])
        axes.set(xlabel=axis_label("xyz"[i]), ylabel=axis_label("xyz"[j]))
        axes.set_title(title, loc="left", pad=3.0)
        window = limits.copy()
        window[list(view)] = both
        reach = _REVEALED * float(np.ptp(both[0]))
        outlines = [
            _Outline(axes, space.outline_segments(body, view, window), reach, look)
            for group, look in zip(bodies, _OUTLINES, strict=True)
            for body in group
        ]
        cloud = CircleCollection(
            [_dot_size(len(known))],
            offsets=np.empty((0, 2)),
            offset_transform=axes.transData,
            animated=True,
            zorder=3,
        )
        axes.add_collection(cloud, autolim=False)
        moving = moving_line(axes, **style.TRACE)
        dot = moving_line(axes, **_CONTACT)
        there = points[:, list(view)]
        yield _Part(moving, line[..., list(view)], dot, there), _Cloud(cloud, there), outlines


def _dot_size(count: int) -> float:
    """Area of the markers for a number of contacts, square points."""
    return float(np.clip(7.0 * (300.0 / max(count, 1)) ** 0.7, 1.5, 7.0))


_TRAIL = 0.05  # duration of the path behind the dot that is drawn bold, s
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
        Trial with signals.
    samples : Dataset
        ``ContactMap.to_dataset()`` of the whisker.
    centerline : array_like (k, 3)
        Resting whisker, whisker frame, m.
    rows : array_like (m,) of int
        Indices of the trial's frames, increasing; time axes range from the first to the last.

    Returns
    -------
    iterator of array (720, 1280, 4)
        Images with 8-bit red, green, blue and opacity, one per row.

    Raises
    ------
    ValueError
        If the trial has no signals, or there are no rows.
    """
    if course.signals is None:
        raise ValueError("the trial has no signals: compute them first, by pipeline.with_signals")
    chosen = np.asarray(rows, dtype=np.intp)
    if chosen.size == 0:
        raise ValueError("no frames of the trial are chosen")
    return _signal_frames(course, course.signals, samples, centerline, chosen)


def _signal_frames(
    course: Course, signals: dict[str, Array], samples: xr.Dataset, centerline: ArrayLike, rows: Any
) -> Iterator[Picture]:
    first, last = int(rows[0]), int(rows[-1])
    time = to_display("time", course.time)
    with style.looking():
        figure = screen_figure()
        panels = [(66.5 * i + 0.5, 52.5, 66.5, 58.0) for i in range(3)]
        rails = [(66.5 * i + 59.7, 66.0, 1.6, 24.0) for i in range(3)]
        measured = np.stack([signals[name] for name in TRIPLET], axis=1)
        measured[~course.touching] = np.nan
        span = slice(first, last + 1)
        solids, _ = solid_panels(figure, samples, centerline, panels, measured[span])
        places = space.signal_places(*measured.T)
        ways = [flattened(axes, places) for axes in solids]
        points = course.known if course.estimated is None else course.estimated
        coordinates = np.full(places.shape, np.nan) if points is None else spherical(points)
        scales = course_scales(figure, rails, coordinates[span])
        for axes, way, (shade, norm) in zip(solids, ways, scales, strict=True):
            segments, means = space.coloured_segments(way[span], shade)
            path = LineCollection(
                list(segments), cmap=style.sequential(), norm=norm, linewidths=1.0
            )
            path.set(array=means, transform=axes.transData, clip_on=False)
            figure.add_artist(path)
        curves = overview.curves_over_time(figure, _BOXES, course, signals, span)
        overview.curve_legend(figure, course, (1.0 - 2.0 / WIDTH, 48.0 / HEIGHT))
        dot_look = {"marker": "o", "color": style.ORANGE}
        cursors = [
            curve.axes.axvline(time[first], color=style.ORANGE, linewidth=0.8, animated=True)
            for curve in curves
        ]
        values = [moving_line(c.axes, markersize=3.5, zorder=5, **dot_look) for c in curves]
        clock = figure.text(0.0125, 0.985, "", va="top", fontsize=style.LARGE, animated=True)
        trails = [flat_line(a, color=style.INK, linewidth=0.6, animated=True) for a in solids]
        look = {"markeredgecolor": "white", "markeredgewidth": 0.6, "linestyle": "none"}
        dots = [flat_line(a, markersize=5.5, animated=True, **dot_look, **look) for a in solids]
        screen = Screen(figure)
    for row in rows:
        begin = int(np.searchsorted(course.time, course.time[row] - _TRAIL))
        begin = max(begin, first)
        for way, trail, dot in zip(ways, trails, dots, strict=True):
            trail.set_data(*way[begin : row + 1].T)
            dot.set_data(*way[row : row + 1].T)
        for curve, cursor, point in zip(curves, cursors, values, strict=True):
            cursor.set_xdata([time[row], time[row]])
            point.set_data([time[row]], curve.values[row : row + 1])
        clock.set_text(f"{time[row]:.3f} s" + (", in contact" if course.touching[row] else ""))
        yield screen.frame([*trails, *dots, *cursors, *values, clock])
