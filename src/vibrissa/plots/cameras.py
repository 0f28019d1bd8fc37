"""Views of the cameras: a part of an image with the traced whisker and the contact point."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.scene import Course

Grey = NDArray[np.uint8]

_ROOM = 0.08
_LIGHT = 235
"""Grey value beyond the edge of an image."""


class _View(Protocol):
    """A camera."""

    @property
    def name(self) -> str:
        """Name of the view."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of its images, pixels."""

    def project(self, points: ArrayLike) -> Array:
        """Column and row (..., 2), pixels, of points (..., 3), laboratory frame, m."""


class Sight(NamedTuple):
    """One view of a trial."""

    view: _View
    images: Iterable[Grey]


def seen(course: Course, views: Sequence[_View], number: int) -> tuple[Array, Array]:
    """Tell where whisker and contact are in the images of a view."""
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
    """Choose the part of images in which a whisker moves."""
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
    """A part of images, brought to the size of a panel by averaging over areas."""

    def __init__(
        self, low: Array, high: Array, size: tuple[int, int], panel: tuple[int, int]
    ) -> None:
        across, down = (_averaging(low[n], high[n], size[n], panel[n]) for n in (0, 1))
        self._size = size
        self._down, self._across = down, across.T.tocsr()
        covered = np.outer(down.sum(axis=1), across.sum(axis=1))
        self._beyond = np.float32(_LIGHT) * (1.0 - covered.astype(np.float32))

    def of(self, image: Grey) -> Grey:
        """Show the part."""
        if image.shape != self._size[::-1]:
            raise ValueError(
                f"an image has {image.shape[1]} × {image.shape[0]} pixels; the camera has "
                f"{self._size[0]} × {self._size[1]}"
            )
        part = self._down @ image.astype(np.float32) @ self._across + self._beyond
        return np.asarray(part + 0.5, dtype=np.uint8)


def _averaging(low: float, high: float, size: int, count: int) -> Any:
    """Matrix (count, size) of the share of each pixel of an image in each of a panel."""
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


def scale_bar(axes: Axes, course: Course, view: _View) -> None:
    """Draw a bar of 5 mm below the right end of an image."""
    base = np.nanmean(course.position, axis=0)
    ends = view.project(base + 0.5e-3 * np.concatenate([np.eye(3), -np.eye(3)]))
    pixels = 5.0 * float(np.linalg.norm(ends[:3] - ends[3:], axis=1).max())
    left, right = axes.get_xlim()
    share = pixels / (right - left)
    if not 0.0 < share < 1.0:
        return
    place: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
    axes.plot([1.0 - share, 1.0], [-0.035, -0.035], color=style.INK, linewidth=1.2, **place)
    axes.annotate(
        "5 mm",
        (1.0 - share, -0.035),
        xycoords="axes fraction",
        xytext=(-3.0, 0.0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=style.SMALL,
    )


_GAP = 2.0
_TITLE = 6.0
_LINE = 4.0


def start_views(
    images: Sequence[Grey],
    candidates: Sequence[tuple[Sequence[ArrayLike], float]],
    names: Sequence[str],
    remarks: Sequence[str] = (),
) -> Figure:
    """Draw lines that may be the whisker, with their confidence, into an image of each view."""
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
