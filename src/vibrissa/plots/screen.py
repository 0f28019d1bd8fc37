"""Frames of movies: what stays is drawn once, what moves is drawn on top of it.

A figure of three solids takes seconds to draw, a dot in it no time at all. So the figure is drawn
once and kept as a picture; for every frame the picture is put back and only moving artists are
drawn, and now and then one of them is drawn into the picture for good.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from vibrissa.plots.style import Array, looking, sized_figure

Picture = NDArray[np.uint8]

WIDTH, HEIGHT = 203.2, 114.3
"""Of a movie's figure, mm: lettering is as large in it as on a page of two columns."""

SIZE = (1280, 720)
"""Of a movie, pixels."""

_DPI = 160.0


def screen_figure() -> Figure:
    """Make the empty figure of a movie."""
    figure = sized_figure(WIDTH, HEIGHT)
    figure.set_dpi(_DPI)
    return figure


class Screen:
    """A figure of which only some artists move."""

    def __init__(self, figure: Figure) -> None:
        self._figure = figure
        # Matplotlib gives this canvas no types.
        self._agg = cast("Any", FigureCanvasAgg(figure))
        with looking():
            self._agg.draw()
        self._background = self._agg.copy_from_bbox(figure.bbox)

    def keep(self, artists: Iterable[Artist]) -> None:
        """Draw artists into all frames from now on."""
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
        """Tell how large a panel is."""
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
    """Add a line that moves."""
    (line,) = axes.plot([], [], animated=True, **look)
    assert isinstance(line, Line2D)
    return line


def flat_line(axes: Any, **look: Any) -> Line2D:
    """Add a line to axes in space that lies on the paper, see :func:`flattened`."""
    line = Line2D([], [], transform=axes.transData, **look)
    line.set_clip_on(False)
    axes.figure.add_artist(line)
    return line


def flattened(axes: Any, places: Array) -> Array:
    """Say where places in space lie on the paper."""
    from mpl_toolkits.mplot3d import proj3d  # type: ignore[import-untyped]

    # Matplotlib sets the size of the box of space only while it draws.
    axes.apply_aspect()
    flat = places.reshape(-1, 3)
    x, y, _ = proj3d.proj_transform(*flat.T, axes.get_proj())
    return np.stack([np.asarray(x), np.asarray(y)], axis=-1).reshape(*places.shape[:-1], 2)
