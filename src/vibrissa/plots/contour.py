"""Contact points and the peg that they outline, from above and from the side (the paper's Fig. 6C).

Contact points lie on the whisker's centreline, one whisker radius (some 50 µm) off the surface.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike, NDArray

from vibrissa.plots.colours import shading
from vibrissa.plots.style import (
    MUTED,
    ORANGE,
    Array,
    Width,
    head,
    looking,
    new_figure,
    page_width,
    plain,
    robust_limits,
    say,
)
from vibrissa.quantities import axis_label, to_display


class _Cylinder(Protocol):
    """What a peg and a fitted cylinder have in common: laboratory frame, m."""

    @property
    def origin(self) -> Array:
        """Point (3,) of the axis."""

    @property
    def axis(self) -> Array:
        """Direction (3,) of the axis."""

    @property
    def radius(self) -> float:
        """Of the surface."""


_VIEWS = ((0, 1), (0, 2), (1, 2))
_NAMES = "xyz"
_TITLES = ("top", "front", "side")
_CHI2_95 = 5.991464547107979
"""95 % of a chi-square of two degrees of freedom."""

_MOST_ELLIPSES = 60
_LEFT, _GAP, _BAR, _BOTTOM, _TOP = 12.0, 10.0, 12.0, 8.5, 11.0
"""Room around and between the views, mm on paper."""


def contour_views(
    points: ArrayLike,
    peg: _Cylinder | None = None,
    fitted: _Cylinder | None = None,
    *,
    colour: ArrayLike | None = None,
    colour_name: str = "deflection_angle",
    covariance: ArrayLike | None = None,
    width: Width = "double",
) -> Figure:
    """Draw contact points from above (x–y), large, and from two sides (x–z and y–z).

    Parameters
    ----------
    points : array_like (n, 3)
        Contact points, laboratory frame, m; rows with NaN are left out.
    peg, fitted : cylinder, optional
        The true peg, filled grey, and the one fitted to the points, dashed: anything with
        ``origin`` (3,), m, ``axis`` (3,) and ``radius``, m, in the laboratory frame. From above a
        cylinder is cut at the median height of the points; from the side its outline is drawn.
    colour : array_like (n,), optional
        What colours the points, in SI units, such as deflection angle or time; the largest values
        are drawn last.
    colour_name : str
        Which quantity ``colour`` is.
    covariance : array_like (n, 3, 3), optional
        Of the points, laboratory frame, m²: draws 95 % ellipses about some of them.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Three axes of equal aspect in mm; how many points lie outside the first is written above
        it. Or the sentence "no contacts".

    Raises
    ------
    ValueError
        If shapes do not fit.
    """
    places = to_display("contact_point", points)
    shade = None if colour is None else to_display(colour_name, colour)
    spread = None if covariance is None else to_display("covariance", covariance)
    rows = _usable(places, shade, spread)
    pegs = [(c, look) for c, look in ((peg, _PEG), (fitted, _FITTED)) if c is not None]
    with looking():
        if rows.size == 0:
            figure = new_figure(width, 40.0, None)
            say(figure, "no contacts")
            return figure
        places, shade = places[rows], None if shade is None else shade[rows]
        limits = _limits(places, pegs[0][0] if pegs else None)
        room = _BAR if shade is not None else 3.0, _TOP if pegs else 6.5
        figure, panels = _panels(limits, width, *room)
        for axes, view in zip(panels, _VIEWS, strict=True):
            for cylinder, look in pegs:
                outline = _outline(cylinder, view, float(np.median(places[:, 2])), limits)
                axes.add_patch(Polygon(outline, closed=True, **look))
            if spread is not None:
                _ellipses(axes, places, spread[rows], view)
            across, up = places[:, view].T
            size = 5.0 if view == (0, 1) else 2.5
            dots = axes.scatter(across, up, size, zorder=3, **shading(shade))
        _note_outside(panels[0], places, limits)
        _legend(figure, panels, peg, fitted, spread is not None)
        if shade is not None:
            rail = figure.add_axes(_rail(figure))
            plain(figure.colorbar(dots, cax=rail, label=axis_label(colour_name)))
        return figure


def _rail(figure: Figure) -> tuple[float, float, float, float]:
    """Where the colour bar is, as shares of the figure."""
    page, height = figure.get_size_inches() * 25.4
    tall = 0.6 * (height - _BOTTOM - _TOP)
    return (page - _BAR + 2.0) / page, _BOTTOM / height, 2.0 / page, tall / height


_PEG: dict[str, Any] = {"facecolor": "#ececec", "edgecolor": MUTED, "linewidth": 0.8, "zorder": 1}
_FITTED: dict[str, Any] = {
    "facecolor": "none",
    "edgecolor": ORANGE,
    "linewidth": 1.0,
    "linestyle": (0, (4, 2)),
    "zorder": 4,
}


def _usable(places: Array, shade: Array | None, spread: Array | None) -> NDArray[np.intp]:
    """Rows in which nothing is missing, those of the largest shade last, to be drawn on top."""
    n = len(places)
    wanted = {
        "points": (places, (n, 3)),
        "colour": (shade, (n,)),
        "covariance": (spread, (n, 3, 3)),
    }
    faults = [
        f"{name} has shape {values.shape}; {shape} is needed"
        for name, (values, shape) in wanted.items()
        if values is not None and values.shape != shape
    ]
    if faults:
        raise ValueError("; ".join(faults))
    known = np.isfinite(places).all(axis=1)
    if shade is None:
        return np.flatnonzero(known)
    rows = np.flatnonzero(known & np.isfinite(shade))
    return rows[np.argsort(shade[rows], kind="stable")]


def _limits(places: Array, peg: _Cylinder | None) -> Array:
    """Limits (3, 2), mm: as wide along x as along y, and so that the peg fills the view."""
    limits = np.array([robust_limits(c) for c in places.T])
    if peg is None:
        middle, half = limits[:2].mean(axis=1), 0.55 * np.ptp(limits[:2], axis=1).max()
    else:
        middle = to_display("peg_position", peg.origin)[:2]
        radius = float(to_display("peg_radius", peg.radius))
        away = np.abs(places[:, :2] - middle).max(axis=1)
        half = np.clip(1.1 * np.quantile(away, 0.9), 1.5 * radius, 2.5 * radius)
    limits[:2] = middle[:, None] + half * np.array([-1.0, 1.0])
    tall = max(0.55 * float(np.ptp(limits[2])), 1.5 * float(half))
    limits[2] = limits[2].mean() + tall * np.array([-1.0, 1.0])
    return limits


def _panels(limits: Array, width: Width, right: float, above: float) -> tuple[Figure, list[Axes]]:
    """Three axes, all as tall as the view from above, with room in mm beside and above them."""
    page = page_width(width)
    across, tall = np.ptp(limits[0]), np.ptp(limits[2])
    size = (page - _LEFT - 2.0 * _GAP - right) / (1.0 + 2.0 * across / tall)
    height = size + _BOTTOM + above
    figure = new_figure(width, height, None)
    panels, left = [], _LEFT
    for i, (view, title) in enumerate(zip(_VIEWS, _TITLES, strict=True)):
        wide = size * float(np.ptp(limits[view[0]]) / np.ptp(limits[view[1]]))
        box = (left / page, _BOTTOM / height, wide / page, size / height)
        axes = figure.add_axes(box, xlim=limits[view[0]], ylim=limits[view[1]])
        axes.set(xlabel=axis_label(_NAMES[view[0]]), ylabel=axis_label(_NAMES[view[1]]))
        head(axes, "abc"[i], title)
        axes.locator_params(axis="x", nbins=5 if i == 0 else 3, integer=True)
        panels.append(axes)
        left += wide + _GAP
    return figure, panels


def _outline(cylinder: _Cylinder, view: tuple[int, int], height: float, limits: Array) -> Array:
    """Outline (k, 2), mm: from above the section at a height, from the side the silhouette."""
    origin = to_display("peg_position", cylinder.origin)
    radius = float(to_display("peg_radius", cylinder.radius))
    axis = np.asarray(cylinder.axis, dtype=np.float64)
    axis = axis / np.linalg.norm(axis)
    if view == (0, 1) and abs(axis[2]) > 0.2:
        first = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        turn = np.linspace(0.0, 2.0 * np.pi, 181)[:, None]
        circle = origin + radius * (np.cos(turn) * first + np.sin(turn) * np.cross(axis, first))
        # Along the axis, until all of the circle is at this height.
        circle += (height - circle[:, 2:]) / axis[2] * axis
        return np.asarray(circle[:, :2])
    i, j = view
    along = np.array([axis[i], axis[j]])
    along = along / max(float(np.linalg.norm(along)), 1e-12)
    across = radius * np.array([-along[1], along[0]])
    far = 2.0 * float(np.ptp(limits, axis=1).max()) * along
    middle = origin[[i, j]]
    # From where the axis passes nearest to the middle of the view.
    middle = middle + ((limits[[i, j]].mean(axis=1) - middle) @ along) * along
    return np.array(
        [middle - far + across, middle + far + across, middle + far - across, middle - far - across]
    )


def _ellipses(axes: Axes, places: Array, spread: Array, view: tuple[int, int]) -> None:
    """95 % ellipses about evenly chosen points, where they are no wider than the view."""
    i, j = view
    plane = spread[:, [i, j]][:, :, [i, j]]
    chosen = np.flatnonzero(np.isfinite(plane).all(axis=(1, 2)))
    widest = 0.25 * np.ptp(axes.get_xlim()) / np.sqrt(_CHI2_95)
    chosen = chosen[np.trace(plane[chosen], axis1=1, axis2=2) < widest**2]
    chosen = chosen[:: max(1, len(chosen) // _MOST_ELLIPSES)]
    plane = plane[chosen]
    size, direction = np.linalg.eigh(plane)
    size = 2.0 * np.sqrt(_CHI2_95 * np.clip(size, 0.0, None))
    angle = np.degrees(np.arctan2(direction[:, 1, 1], direction[:, 0, 1]))
    axes.add_collection(
        EllipseCollection(
            size[:, 1],
            size[:, 0],
            angle,
            units="xy",
            offsets=places[chosen][:, [i, j]],
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors=MUTED,
            linewidths=0.4,
            zorder=2,
        )
    )


def _note_outside(axes: Axes, places: Array, limits: Array) -> None:
    flat = places[:, :2]
    outside = int(((flat < limits[:2, 0]) | (flat > limits[:2, 1])).any(axis=1).sum())
    if outside:
        axes.set_title(f"{outside} outside", loc="right", fontsize=6.0, color=MUTED)


def _legend(
    figure: Figure,
    panels: list[Axes],
    peg: _Cylinder | None,
    fitted: _Cylinder | None,
    spread: bool,
) -> None:
    handles: list[Line2D | Polygon] = []
    corner = np.zeros((1, 2))
    if peg is not None:
        diameter = 2.0 * float(to_display("peg_radius", peg.radius))
        handles.append(Polygon(corner, label=f"peg, {diameter:.2f} mm", **_PEG))
    if fitted is not None:
        diameter = 2.0 * float(to_display("peg_radius", fitted.radius))
        handles.append(Polygon(corner, label=f"fitted, {diameter:.2f} mm", **_FITTED))
    if spread:
        look: dict[str, Any] = {"marker": "o", "markerfacecolor": "none", "linestyle": "none"}
        handles.append(Line2D([], [], color=MUTED, label="95 % ellipses", **look))
    if handles:
        place = (panels[0].get_position().x0 + 0.02, 1.0)
        figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=place,
            ncols=len(handles),
            borderaxespad=0.3,
        )
