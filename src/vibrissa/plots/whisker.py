"""The whisker in three views, drawn with its taper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.quantities import axis_label, to_display

_MAGNIFICATIONS = (1, 2, 3, 5, 10, 20, 50, 100)
_WIDE = 0.02
"""Drawn width at the base, as a share of the whisker's extent, that is aimed at."""

_LEFT, _RIGHT, _BOTTOM, _TOP, _GAP = 10.0, 2.0, 8.5, 6.5, 3.5
"""Room around and between the views, mm on paper."""


_NARROWEST = 0.09
"""Smallest half of an axis, as a share of the whisker's extent."""


def whisker_views(
    centerline: ArrayLike,
    radius: ArrayLike,
    *,
    name: str | None = None,
    magnification: float | None = None,
    assumed: Sequence[str] = (),
    width: style.Width = "single",
) -> Figure:
    """Draw a whisker from above (x–y), from the side (x–z) and along its base (z–y), to one scale.

    Parameters
    ----------
    centerline : array_like (n, 3)
        Points from base to tip, whisker frame, m; those with NaN are left out.
    radius : array_like (n,) or float
        Radius of the whisker at these points, m.
    name : str, optional
        Written above.
    magnification : float, optional
        Factor by which the whisker is drawn too wide; chosen by default so that the base is easily
        seen, and always stated in the figure.
    assumed : sequence of str
        Properties of the whisker that were not measured; written under the magnification.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Three axes, in mm, or a sentence if there are fewer than two points.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    points = to_display("centerline", centerline)
    radii = to_display("x", radius)
    if points.ndim != 2 or points.shape[1] != 3 or radii.shape not in ((), (len(points),)):
        raise ValueError(
            f"centerline and radius have shapes {points.shape} and {radii.shape}; "
            "(n, 3) and (n,) are needed"
        )
    radii = np.broadcast_to(radii, (len(points),))
    known = np.isfinite(points).all(axis=1) & np.isfinite(radii)
    points, radii = points[known], radii[known]
    with style.looking():
        if len(points) < 2:
            return style.sentence("no whisker", width)
        figure, axes, magnification = _views(points, radii, magnification, width)
        _caption(axes, name, magnification, assumed)
        return figure


def _views(
    points: Array, radii: Array, magnification: float | None, width: style.Width
) -> tuple[Figure, Axes, float]:
    extent = float(np.ptp(points, axis=0).max())
    if magnification is None:
        aim = _WIDE * extent / (2.0 * max(radii.max(), 1e-9))
        magnification = max([m for m in _MAGNIFICATIONS if m <= aim], default=1)
    margin = magnification * radii.max() + 0.02 * extent
    limits = style.limits_around(points, margin, _NARROWEST * extent)
    span = np.ptp(limits, axis=1)
    page = style.page_width(width)
    scale = (page - _LEFT - _RIGHT - _GAP) / (span[0] + span[2])  # mm on paper per mm
    height = _BOTTOM + _GAP + _TOP + scale * (span[1] + span[2])
    figure = style.new_figure(width, height, None)

    def place(left: float, bottom: float, i: int, j: int) -> Axes:
        box = (left, bottom, scale * span[i], scale * span[j])
        axes = style.box_axes(figure, box, xlim=limits[i], ylim=limits[j])
        outline = _tube(points[:, [i, j]], magnification * radii)
        axes.add_patch(PathPatch(outline, facecolor=style.INK, edgecolor="none"))
        return axes

    right, above = _LEFT + scale * span[0] + _GAP, _BOTTOM + scale * span[2] + _GAP
    top = place(_LEFT, above, 0, 1)
    side = place(_LEFT, _BOTTOM, 0, 2)
    end = place(right, above, 2, 1)
    top.tick_params(labelbottom=False)
    end.tick_params(labelleft=False)
    top.set_ylabel(axis_label("y"))
    side.set(xlabel=axis_label("x"), ylabel=axis_label("z"))
    end.set_xlabel(axis_label("z"))
    few = max(3, round(scale * span[1] / 12.0))
    for axis, ticks in ((top.yaxis, few), (end.yaxis, few), (side.yaxis, 3), (end.xaxis, 3)):
        axis.set_major_locator(MaxNLocator(ticks, integer=True))
    return figure, top, magnification


def _tube(places: Array, radii: Array) -> Path:
    """Outline of a tube seen from the side: what lies between its places, and discs at some."""
    step = np.diff(places, axis=0)
    length = np.hypot(*step.T)
    along = step / np.where(length > 0.0, length, 1.0)[:, None]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    near, far = places[:-1], places[1:]
    a, b = radii[:-1, None] * normal, radii[1:, None] * normal
    corners = np.stack([near + a, near - a, far - b, far + b, near + a], axis=1)
    straight = np.einsum("ni,ni->n", along[1:], along[:-1]) > 0.995
    joined = straight & (np.minimum(length[1:], length[:-1]) > 0.1 * radii[1:-1])
    open_ends = np.concatenate([[True], ~joined, [True]])
    disc = Path.unit_circle()
    discs = [
        Path(place + radius * disc.vertices, disc.codes)
        for place, radius in zip(places[open_ends], radii[open_ends], strict=True)
    ]
    return Path.make_compound_path(*(Path(loop, closed=True) for loop in corners), *discs)


def _caption(axes: Axes, name: str | None, magnification: float, assumed: Sequence[str]) -> None:
    """Say whose views these are, how much too wide, and what is assumed."""
    axes.set_title(name or "whisker", loc="left", fontweight="bold")
    lines = [f"width × {magnification:g}" if magnification != 1 else "true width"]
    lines += [f"assumed: {one}" for one in assumed]
    axes.text(
        0.02,
        0.97,
        "\n".join(lines),
        transform=axes.transAxes,
        va="top",
        color=style.MUTED,
        fontsize=style.SMALL,
    )
