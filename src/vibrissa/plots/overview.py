"""Overview of a trial: frames, signals, trajectory in signal space, estimates (Fig. 4).

Camera views show a part of the image with the traced whisker and the contact point.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array, spherical
from vibrissa.plots import style
from vibrissa.plots.contact_surfaces import course_scales, solid_panels
from vibrissa.plots.contacts import against
from vibrissa.plots.signals import intervals
from vibrissa.plots.space import coloured_segments, drop_lines, signal_places
from vibrissa.quantities import axis_label, to_display
from vibrissa.scene import COORDINATES, TRIPLET, Course

if TYPE_CHECKING:
    from vibrissa.cameras import Camera

Grey = NDArray[np.uint8]

_ROOM = 0.08
_LIGHT = 235  # grey value beyond the edge of an image


class Sight(NamedTuple):
    """One view of a trial."""

    view: Camera
    images: Iterable[Grey]


def seen(course: Course, views: Sequence[Camera], number: int) -> tuple[Array, Array]:
    """Positions of whisker and contact in the images of a view."""
    count = len(course.time)
    if number < len(course.traces):
        line = course.traces[number]
    elif course.centerline is not None:
        line = views[number].project(course.centerline)
    else:
        line = np.full((count, 2, 2), np.nan)
    if course.places is None:
        return line, np.full((count, 2), np.nan)
    return line, views[number].project(course.places)


def part_of(lines: Array, shape: tuple[float, float], size: tuple[int, int]) -> tuple[Array, Array]:
    """Lower and upper corner of the part of the images in which a whisker moves."""
    places = lines.reshape(-1, 2)
    places = places[np.isfinite(places).all(axis=1)]
    whole = np.asarray(size, dtype=np.float64)
    if len(places):
        low, high = np.quantile(places, [0.002, 0.998], axis=0)
    else:
        low, high = np.zeros(2), whole
    span = (1.0 + 2.0 * _ROOM) * np.maximum(high - low, 16.0)
    extent = max(span / np.asarray(shape)) * np.asarray(shape)
    low = 0.5 * (low + high - extent)
    inside = np.clip(low, 0.0, whole - extent)
    low = np.where(extent <= whole, inside, 0.5 * (whole - extent))
    return low - 0.5, low + extent - 0.5


class Window:
    """Part of images, resampled to the size of a panel by area averaging."""

    def __init__(
        self, low: Array, high: Array, size: tuple[int, int], panel: tuple[int, int]
    ) -> None:
        across, down = (_averaging(low[n], high[n], size[n], panel[n]) for n in (0, 1))
        self._size = size
        self._down, self._across = down, across.T.tocsr()
        covered = np.outer(down.sum(axis=1), across.sum(axis=1))
        self._beyond = np.float32(_LIGHT) * (1.0 - covered.astype(np.float32))

    def of(self, image: Grey) -> Grey:
        """Resample the part of an image."""
        if image.shape != self._size[::-1]:
            raise ValueError(
                f"an image has {image.shape[1]} × {image.shape[0]} pixels; the camera has "
                f"{self._size[0]} × {self._size[1]}"
            )
        part = self._down @ image.astype(np.float32) @ self._across + self._beyond
        return np.asarray(part + 0.5, dtype=np.uint8)


def _averaging(low: float, high: float, size: int, count: int) -> Any:
    """Matrix (count, size) of the weights of image pixels in the pixels of a panel."""
    from scipy.sparse import csr_matrix

    ends = np.linspace(low, high, count + 1) + 0.5
    pixels = np.arange(size)
    first, last = ends[:-1, None], ends[1:, None]
    shares = np.clip(np.minimum(last, pixels + 1.0) - np.maximum(first, pixels), 0.0, None)
    return csr_matrix((shares / (last - first)).astype(np.float32))


def sight_axes(figure: Figure, box: style.Box, low: Array, high: Array) -> Axes:
    """Add a panel for a part of an image."""
    axes = style.box_axes(figure, box, xlim=(low[0], high[0]), ylim=(high[1], low[1]))
    axes.set_axis_off()
    return axes


def scale_bar(axes: Axes, course: Course, view: Camera) -> None:
    """Draw a bar of 5 mm below the right end of an image."""
    base = np.nanmean(course.position, axis=0)
    ends = view.project(base + 0.5e-3 * np.concatenate([np.eye(3), -np.eye(3)]))
    pixels = 5.0 * float(np.linalg.norm(ends[:3] - ends[3:], axis=1).max())
    left, right = axes.get_xlim()
    share = pixels / (right - left)
    if 0.0 < share < 1.0:
        size_bar(axes, share, "5 mm")


def size_bar(axes: Axes, share: float, words: str) -> None:
    """Draw a bar over a share of the width below the right end of an image."""
    place: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
    axes.plot([1.0 - share, 1.0], [-0.035, -0.035], color=style.INK, linewidth=1.2, **place)
    axes.annotate(
        words,
        (1.0 - share, -0.035),
        xycoords="axes fraction",
        xytext=(-3.0, 0.0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=style.SMALL,
    )


_GAP, _TITLE, _LINE = 2.0, 6.0, 4.0  # gap between images, title, and a line of a remark, mm


def start_views(
    images: Sequence[Grey],
    candidates: Sequence[tuple[Sequence[ArrayLike], float]],
    names: Sequence[str],
    remarks: Sequence[str] = (),
) -> Figure:
    """Draw candidate whiskers, with their confidence, on an image of each view."""
    wide = (style.page_width("double") - _GAP * (len(images) - 1)) / len(images)
    heights = [wide * image.shape[0] / image.shape[1] for image in images]
    below = _LINE * len(remarks) + _GAP
    with style.looking():
        figure = style.new_figure("double", max(heights) + _TITLE + below, None)
        for view, (image, name) in enumerate(zip(images, names, strict=True)):
            box = (view * (wide + _GAP), below, wide, heights[view])
            rows, columns = image.shape
            axes = style.box_axes(figure, box, xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
            axes.set_axis_off()
            axes.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto")
            caption = "no whisker"
            for number, (lines, confidence) in enumerate(candidates, 1):
                line = np.asarray(lines[view], dtype=np.float64).reshape(-1, 2)
                if not len(line):
                    continue
                if number == 1:
                    caption = f"1 begins at {line[0, 0]:.0f}, {line[0, 1]:.0f}"
                    caption += f", confidence {confidence:.2f}"
                _candidate(axes, line, number, confidence, style.ORANGE if remarks else style.GREEN)
            axes.set_title(f"{name}: {caption}", loc="left", pad=2.0)
        height = max(heights) + _TITLE + below
        for count, remark in enumerate(remarks):
            at = (below - _LINE * (count + 1)) / height
            figure.text(0.01, at, remark, color=style.RED)
    return figure


def _candidate(axes: Axes, line: Array, number: int, confidence: float, colour: str) -> None:
    """Draw a line with its number and a circle at its base; all but the first fainter."""
    first = number == 1
    colour = colour if first else style.BLUE
    axes.plot(*line.T, color=colour, linewidth=0.8, alpha=0.8, linestyle="-" if first else ":")
    at = line[:1, 0], line[:1, 1]
    axes.scatter(
        *at, s=60.0, facecolor="none", edgecolor=style.RED if first else style.BLUE, linewidths=1.0
    )
    text = f"{number}" if first else f"{number} ({confidence:.2f})"
    axes.annotate(text, line[0], xytext=(5.0, 5.0), textcoords="offset points", color=colour)


_DOTS_PER_MM = 300.0 / 25.4
_CONTACT: dict[str, Any] = {"facecolor": "#f0e442", "edgecolor": "black", "linewidths": 0.5}


class _Sheet(NamedTuple):
    """Positions of the panels, mm."""

    height: float
    sights: tuple[style.Box, ...]
    curves: tuple[style.Box, ...]
    legend: float
    solids: tuple[style.Box, ...]
    rails: tuple[style.Box, ...]
    against: tuple[style.Box, ...]


def key_frames(course: Course) -> NDArray[np.intp]:
    """Choose two representative frames in contact."""
    rows = np.flatnonzero(course.touching)
    if not rows.size:
        return np.array([0, len(course.time) - 1], dtype=np.intp)
    if course.signals is None:
        return rows[[rows.size // 3, 2 * rows.size // 3]]
    size = np.nan_to_num(course.signals["MB"][rows])
    turn = course.signals["MD"][rows]
    most = int(np.argmax(size))
    across = np.cos(turn - turn[most]) < 0.0
    other = int(np.argmax(np.where(across, size, -1.0))) if across.any() else rows.size // 2
    return np.sort(rows[[most, other]])


def trial_overview(
    course: Course,
    samples: xr.Dataset,
    centerline: ArrayLike,
    sights: Sequence[Sight] = (),
    rows: ArrayLike = (),
    *,
    width: style.Width = "double",
) -> Figure:
    """Draw a trial: camera views, signals and contacts over time, solids, estimates.

    The camera views show the traced whisker in red, and the contact point. Below are the three
    signals and the coordinates of the contact over time, with contacts shaded; the trajectory in
    signal space, coloured by r, θ and φ; and, at double width only, estimated against known
    coordinates.

    Parameters
    ----------
    course : Course
        Trial with signals.
    samples : Dataset
        ``ContactMap.to_dataset()`` of the whisker.
    centerline : array_like (k, 3)
        Resting whisker, whisker frame, m.
    sights : sequence of Sight
        One or two views, each with an image for each row.
    rows : array_like (m,) of int
        Indices of one or two frames to show, increasing.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Images, six axes over time in display units, three 3D axes, and scatter plots.

    Raises
    ------
    ValueError
        If the trial has no signals, or there are more than two views or rows.
    """
    if course.signals is None:
        raise ValueError("the trial has no signals: F_x, M_B and M_D are needed")
    shown = np.asarray(rows, dtype=np.intp).reshape(-1)
    if len(sights) > 2 or shown.size > 2:
        raise ValueError(f"{len(sights)} views in {shown.size} frames; two in two can be shown")
    most = 2 if width == "double" else 1
    shown = shown[-most:] if sights else shown[:0]
    compared = width == "double" and course.known is not None and course.estimated is not None
    sheet = _sheet(width, len(sights) * shown.size, compared)
    with style.looking():
        figure = style.new_figure(width, sheet.height, None)
        _images(figure, sheet.sights, course, sights, shown)
        whole = slice(0, len(course.time))
        curves = curves_over_time(figure, sheet.curves, course, course.signals, whole)
        curve_legend(
            figure, course, (1.0 - 2.0 / style.page_width(width), sheet.legend / sheet.height)
        )
        for row in shown:
            for axes, _ in curves:
                axes.axvline(float(course.time[row]), color=style.ORANGE, linewidth=0.6)
        _trajectory(figure, sheet, course, samples, centerline, shown)
        if compared:
            _compared(figure, sheet.against, course)
        _letters(figure, sheet)
        style.conclude(figure, _finding(course))
        return figure


def _spans(course: Course, span: slice = slice(None)) -> Array:
    """Start and end times (n, 2) of contacts, s; frames without a pose do not end a contact."""
    seen = np.asarray(np.isfinite(course.position).all(axis=1))
    return intervals(course.time[span], course.touching[span], seen[span])


def _finding(course: Course) -> str:
    """Describe number and strength of contacts, and the accuracy of their positions."""
    assert course.signals is not None
    count = len(_spans(course))
    largest = np.nanmax(to_display("MB", course.signals["MB"]), initial=0.0)
    words = f"{count} contact{'' if count == 1 else 's'}, bending moments up to {largest:.2g} µN·m"
    if course.known is None or course.estimated is None:
        return words
    away = to_display("r", np.linalg.norm(course.estimated - course.known, axis=1))
    if not np.isfinite(away).any():
        return words
    distance = f"median distance from {course.known_as} contact points"
    return f"{words}; {distance} {np.nanmedian(away):.2g} mm"


def _sheet(width: style.Width, images: int, compared: bool) -> _Sheet:
    """Lay the panels out from below."""
    if width == "double":
        bottom = 56.0 if compared else 0.0
        scatter = tuple((14.0 + 55.0 * i, 10.0, 38.0, 38.0) for i in range(3)) if compared else ()
        solids = tuple((59.0 * i, bottom, 56.0, 46.5) for i in range(3))
        rails = tuple((59.0 * i + 50.8, bottom + 10.5, 1.6, 22.0) for i in range(3))
        low = bottom + 59.0
        curves = tuple(
            (left, low + 16.5 * (2 - i), 74.0, 14.0) for left in (12.0, 102.0) for i in range(3)
        )
        top, wide = low + 47.0, (178.0 - 3.0 * 1.5) / 4.0
    else:
        solids = ((0.0, 38.0, 42.5, 38.0), (42.5, 38.0, 42.5, 38.0), (0.0, 0.0, 42.5, 38.0))
        rails = tuple((48.0, 32.0 - 12.0 * i, 32.0, 1.6) for i in range(3))
        scatter = ()
        low = 86.5
        # All six share one axis of time.
        curves = tuple((12.0, low + 13.0 * (5 - i), 71.0, 11.0) for i in range(6))
        top, wide = low + 76.0, 41.75
    sights = tuple((i * (wide + 1.5), top + 11.5, wide, 34.0) for i in range(images))
    height = top + (50.5 if images else 7.0)
    return _Sheet(height, sights, curves, top + 1.5, solids, rails, scatter)


def _images(
    figure: Figure,
    boxes: Sequence[style.Box],
    course: Course,
    sights: Sequence[Sight],
    rows: NDArray[np.intp],
) -> None:
    """Draw all views of the chosen frames."""
    views = [sight.view for sight in sights]
    streams = [iter(sight.images) for sight in sights]
    places = iter(boxes)
    for count, row in enumerate(rows):
        for number, (view, stream) in enumerate(zip(views, streams, strict=True)):
            box = next(places)
            lines, dots = seen(course, views, number)
            low, high = part_of(lines[course.touching], box[2:], view.size)
            axes = sight_axes(figure, box, low, high)
            panel = round(box[2] * _DOTS_PER_MM), round(box[3] * _DOTS_PER_MM)
            part = Window(low, high, view.size, panel).of(next(stream))
            extent = (low[0], high[0], high[1], low[1])
            axes.imshow(part, cmap="gray", vmin=0, vmax=255, extent=extent, aspect="auto")
            axes.plot(*lines[row].T, **style.TRACE, label="whisker")
            axes.scatter(dots[row, 0], dots[row, 1], 9.0, zorder=5, **_CONTACT, label="contact")
            when = f"{to_display('time', course.time[row]):.3f} s"
            axes.set_title(f"{view.name}, {when}", loc="right", pad=2.0)
            if count == 0:
                scale_bar(axes, course, view)
            if count == number == 0:
                look: dict[str, Any] = {"borderpad": 0.0, "columnspacing": 1.0}
                axes.legend(loc="center left", bbox_to_anchor=(0.0, -0.035), ncols=2, **look)


def _trajectory(
    figure: Figure,
    sheet: _Sheet,
    course: Course,
    samples: xr.Dataset,
    centerline: ArrayLike,
    rows: NDArray[np.intp],
) -> None:
    """Draw the trial in the space of signals, coloured by r, θ and φ; mark the shown frames."""
    from mpl_toolkits.mplot3d.art3d import Line3DCollection  # type: ignore[import-untyped]

    assert course.signals is not None
    measured = np.stack([course.signals[name] for name in TRIPLET], axis=1)
    measured[~course.touching] = np.nan
    trajectory = signal_places(*measured.T)
    solids, limits = solid_panels(figure, samples, centerline, sheet.solids, measured)
    points = course.known if course.estimated is None else course.estimated
    for axes in solids:
        for row in rows[np.isfinite(trajectory[rows]).all(axis=1)]:
            drop_lines(axes, limits, trajectory[row])
            axes.scatter(*trajectory[row], s=9.0, color=style.ORANGE, zorder=13, depthshade=False)
    if points is None:
        for axes in solids:
            axes.plot(*trajectory.T, color=style.INK, linewidth=0.7, zorder=12)
        return
    scales = course_scales(figure, sheet.rails, spherical(points))
    for axes, (values, norm) in zip(solids, scales, strict=True):
        segments, means = coloured_segments(trajectory, values)
        path = Line3DCollection(
            segments, cmap=style.sequential(), norm=norm, linewidths=1.2, zorder=12
        )
        path.set_array(means)
        axes.add_collection3d(path, autolim=False)


def _compared(figure: Figure, boxes: Sequence[style.Box], course: Course) -> None:
    """Draw estimated against known coordinates, coloured by time."""
    assert course.known is not None
    assert course.estimated is not None
    known, estimated = spherical(course.known), spherical(course.estimated)
    rows = np.isfinite(known).all(axis=1) & np.isfinite(estimated).all(axis=1)
    if not rows.any():
        figure.text(
            0.5, 0.5 * boxes[0][3] / boxes[0][1], "no contacts", color=style.MUTED, ha="center"
        )
        return
    look = style.shading(to_display("time", course.time[rows]))
    for i, (name, box) in enumerate(zip(COORDINATES, boxes, strict=True)):
        pair = to_display(name, known[rows, i]), to_display(name, estimated[rows, i])
        dots = against(style.box_axes(figure, box), name, pair, look, course.known_as)
    left, bottom, wide, tall = boxes[-1]
    rail = style.box_axes(figure, (left + wide + 2.5, bottom, 1.8, 0.6 * tall))
    style.colour_bar(figure, dots, cax=rail, label=axis_label("time"))


def _letters(figure: Figure, sheet: _Sheet) -> None:
    """Label the panels with bold letters, row by row."""
    wide, tall = 25.4 * figure.get_size_inches()
    rows = [
        [(box[0], box[1] + box[3] + 1.0) for box in sheet.sights[:1]],
        [(0.0, sheet.curves[0][1] + sheet.curves[0][3] + 1.5)],
        [(box[0], box[1] + box[3] - 2.5) for box in sheet.solids],
        [(box[0] - 11.0, box[1] + box[3] + 3.0) for box in sheet.against],
    ]
    places = [place for row in rows for place in row]
    for letter, (x, y) in zip("abcdefghij", places, strict=False):
        place = (max(x, 0.0) + 1.0) / wide, y / tall
        figure.text(*place, letter, fontsize=style.LARGE, fontweight="bold", va="bottom")


class Curve(NamedTuple):
    """Panel over time, and its foreground values in display units, over the whole trial."""

    axes: Axes
    values: Array


def curves_over_time(
    figure: Figure,
    boxes: Sequence[style.Box],
    course: Course,
    signals: dict[str, Array],
    span: slice,
) -> list[Curve]:
    """Draw F_x, M_B, M_D, r, θ and φ over time."""
    time = to_display("time", course.time)
    first, last = time[span][0], time[span][-1]
    contacts = _spans(course, span)
    known, estimated = (
        None if points is None else spherical(points) for points in (course.known, course.estimated)
    )
    lowest = {left: min(b for at, b, _, _ in boxes if at == left) for left, *_ in boxes}
    curves = []
    for i, (name, box) in enumerate(zip((*TRIPLET, *COORDINATES), boxes, strict=True)):
        axes = style.box_axes(figure, box)
        for begin, end in contacts:
            axes.axvspan(begin, end, color=style.SHADE, linewidth=0.0, zorder=0)
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
        axes.set_ylabel(axis_label(name), fontsize=style.SMALL)
        axes.locator_params(axis="y", nbins=4)
        if box[1] > lowest[box[0]]:
            axes.tick_params(labelbottom=False)
        else:
            axes.set_xlabel(axis_label("time"))
        curves.append(Curve(axes, values))
    for left in lowest:
        stacked = [c.axes for c, box in zip(curves, boxes, strict=True) if box[0] == left]
        figure.align_ylabels(stacked)
    return curves


def _signal(axes: Axes, name: str, time: Array, values: Array) -> None:
    if name == "MD":
        axes.plot(time, values, ".", color=style.BLUE, markersize=1.6)
        axes.set_ylim(-190.0, 190.0)
        axes.set_yticks([-180.0, 0.0, 180.0])
        return
    axes.axhline(0.0, color="#bfbfbf", linewidth=0.5, zorder=1)
    axes.plot(time, values, color=style.BLUE)


def _coordinate(
    axes: Axes,
    name: str,
    time: Array,
    span: slice,
    points: tuple[Array | None, Array | None],
    column: int,
    true: bool,
) -> Array:
    """Draw a coordinate over time; return the foreground values."""
    shown = np.full(time.size, np.nan)
    limits = []
    known, estimated = points
    if known is not None:
        shown = to_display(name, known[:, column])
        axes.plot(time[span], shown[span], color=style.MUTED, linewidth=1.6, zorder=1)
        # Tracked values may contain outliers; true values do not.
        limits.append(_ends(shown[span], 0.0 if true else 0.01))
    if estimated is not None:
        shown = to_display(name, estimated[:, column])
        axes.plot(time[span], shown[span], ".", color=style.BLUE, markersize=1.6, zorder=2)
        limits.append(_ends(shown[span], 0.01))
    found = np.array(limits).reshape(-1, 2)
    found = found[np.isfinite(found).all(axis=1)]
    if len(found):
        low, high = found[:, 0].min(), found[:, 1].max()
        room = max(0.06 * (high - low), 1e-3)
        axes.set_ylim(low - room, high + room)
    else:
        axes.text(0.5, 0.5, "not known", transform=axes.transAxes, ha="center", color=style.MUTED)
    return shown


def _ends(values: Array, left_out: float) -> Array:
    """Limits of the values without a share at either end; NaN if there are none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return np.full(2, np.nan)
    return np.asarray(np.quantile(finite, [left_out, 1.0 - left_out]))


def curve_legend(figure: Figure, course: Course, place: tuple[float, float]) -> None:
    """Draw a legend of the shades, lines and dots of :func:`curves_over_time`."""
    handles: list[Line2D | Patch] = [Patch(facecolor=style.SHADE, label="in contact")]
    if course.known is not None:
        handles.append(Line2D([], [], color=style.MUTED, linewidth=1.6, label=course.known_as))
    if course.estimated is not None:
        look: dict[str, Any] = {"marker": ".", "markersize": 4.0, "linestyle": "none"}
        handles.append(Line2D([], [], color=style.BLUE, label="estimated", **look))
    figure.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=place,
        ncols=len(handles),
        borderaxespad=0.0,
    )
