"""What tracking takes for the whisker before it begins, in an image of each view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from vibrissa.plots.style import GREEN, ORANGE, RED, box_axes, looking, new_figure, page_width

Grey = NDArray[np.uint8]

_ROOM = 2.0
_TITLE = 6.0
_LINE = 4.0


def start_views(
    images: Sequence[Grey],
    lines: Sequence[ArrayLike],
    names: Sequence[str],
    confidence: float,
    remarks: Sequence[str] = (),
) -> Figure:
    """Draw the line that is taken for the whisker into an image of each view.

    Parameters
    ----------
    images : sequence of array (height, width)
        8 bit grey images, one for each view, of the same moment.
    lines : sequence of array_like (n, 2)
        Column and row from base to tip in each view; empty where nothing was found.
    names : sequence of str
        Names of the views.
    confidence : float
        Confidence in the line, 0 to 1.
    remarks : sequence of str
        Sentences that are written below the images, such as what there is to doubt.

    Returns
    -------
    Figure
        One panel for each view, in pixels of the image; the line is green if nothing is in doubt,
        else orange, and its base is circled.
    """
    wide = (page_width("double") - _ROOM * (len(images) - 1)) / len(images)
    heights = [wide * image.shape[0] / image.shape[1] for image in images]
    below = _LINE * len(remarks) + _ROOM
    colour = ORANGE if remarks else GREEN
    with looking():
        figure = new_figure("double", max(heights) + _TITLE + below, None)
        for view, (image, line, name) in enumerate(zip(images, lines, names, strict=True)):
            box = (view * (wide + _ROOM), below, wide, heights[view])
            rows, columns = image.shape
            axes = box_axes(figure, box, xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
            axes.set_axis_off()
            axes.imshow(image, cmap="gray", vmin=0, vmax=255, aspect="auto")
            places = np.asarray(line, dtype=np.float64).reshape(-1, 2)
            axes.plot(*places.T, color=colour, linewidth=0.8, alpha=0.8)
            axes.scatter(
                places[:1, 0], places[:1, 1], 60.0, facecolor="none", edgecolor=RED, linewidths=1.0
            )
            if len(places):
                said = f"confidence {confidence:.2f}"
                column, row = places[0]
                said = f"base at {column:.0f}, {row:.0f}, {said}"
            else:
                said = "no whisker"
            axes.set_title(f"{name}: {said}", loc="left", fontsize=7.0, pad=2.0)
        height = max(heights) + _TITLE + below
        for count, remark in enumerate(remarks):
            at = (below - _LINE * (count + 1)) / height
            figure.text(0.01, at, remark, fontsize=6.5, color=RED)
    return figure
