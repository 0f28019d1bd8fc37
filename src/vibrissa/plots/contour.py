"""Figures of contact points with the object they outline (Fig. 6C), and distances from it.

Contact points are on the whisker's centreline, one whisker radius (some 50 µm) off the surface.
Pegs, cylinders and fitted spheres are drawn in outline. Other objects are drawn as a section at the
median position of the contacts, and known ones from the side as a silhouette. A fitted surface is
drawn with its 95 % band, and ends where it is too uncertain.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.plots import space, style
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import robust_limits

_VIEWS = ((0, 1), (0, 2), (1, 2))
_NAMES = "xyz"
_TITLES = ("top", "front", "side")
_CHI2_95 = 5.991464547107979  # 95 % of a chi-square of two degrees of freedom
_MOST_ELLIPSES = 60
# Room around and between the views, mm on paper.
_LEFT, _GAP, _BAR, _BOTTOM, _TOP = 12.0, 12.0, 15.0, 8.5, 11.0


def contour_views(
    points: ArrayLike,
    known: space.Body | None = None,
    fitted: space.Body | None = None,
    *,
    colour: ArrayLike | None = None,
    colour_name: str = "deflection_angle",
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike | None = None,
    width: style.Width = "double",
) -> Figure:
    """Draw contact points from above (x–y), large, and from two sides (x–z and y–z).

    Parameters
    ----------
    points : array_like (n, 3)
        Contact points, laboratory frame, m; rows with NaN are left out.
    known, fitted : object, optional
        Object that was touched, filled grey, and shape fitted to the points, dashed: anything with
        ``signed_distance(points)``, m, in the laboratory frame, such as objects of a trial and
        fitted shapes. With ``distance_sigma(points)``, m, its 95 % band is drawn. What has
        ``origin`` (3,), m, ``axis`` (3,) and ``radius``, m, is a cylinder.
    colour : array_like (n,), optional
        Values that colour the points, SI units, such as deflection angle or time; the largest are
        drawn last.
    colour_name : str
        Name of the quantity ``colour``.
    covariance : array_like (n, 3, 3), optional
        Covariances of the points, laboratory frame, m²: 95 % ellipses are drawn about some of them.
    whisker_radius : array_like (n,), optional
        Radius of the whisker at each point, m, which is on its centreline: the title then states
        the distance of the whisker's side from the surface.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Three axes of equal aspect in mm; how many points lie outside the first is written above
        it; or the sentence "no contacts".

    Raises
    ------
    ValueError
        If shapes do not fit.
    """
    places = to_display("contact_point", points)
    shade = None if colour is None else to_display(colour_name, colour)
    spread = None if covariance is None else to_display("covariance", covariance)
    n = len(places)
    shapes = {"points": (places, (n, 3)), "colour": (shade, (n,))}
    rows = style.usable_rows(shade, shapes)
    if spread is not None and spread.shape != (n, 3, 3):
        raise ValueError(f"covariance has shape {spread.shape}; {(n, 3, 3)} is needed")
    both = ((known, "true"), (fitted, "fitted"))
    bodies = [(body, look) for body, look in both if body is not None]
    with style.looking():
        if rows.size == 0:
            return style.sentence("no contacts", width)
        places, shade = places[rows], None if shade is None else shade[rows]
        limits = _limits(places, bodies[0][0] if bodies else None)
        room = _BAR if shade is not None else 3.0, _TOP if bodies else 6.5
        figure, panels = _panels(limits, width, *room)
        for axes, view in zip(panels, _VIEWS, strict=True):
            for body, look in bodies:
                _draw(axes, body, look, view, places, limits)
            if spread is not None:
                _ellipses(axes, places, spread[rows], view)
            across, up = places[:, view].T
            size = 5.0 if view == (0, 1) else 2.5
            dots = axes.scatter(across, up, size, zorder=3, **style.shading(shade))
        flat = places[:, :2]
        if outside := int(((flat < limits[:2, 0]) | (flat > limits[:2, 1])).any(axis=1).sum()):
            look_of: dict[str, Any] = {"fontsize": style.SMALL, "color": style.MUTED}
            panels[0].set_title(f"{outside} outside", loc="right", **look_of)
        _legend(figure, panels, known, fitted, spread is not None)
        if bodies and hasattr(bodies[-1][0], "signed_distance"):
            radius = np.zeros(n) if whisker_radius is None else np.broadcast_to(whisker_radius, n)
            away = bodies[-1][0].signed_distance(np.asarray(points, dtype=np.float64)[rows])
            thing = "whisker's centreline" if whisker_radius is None else "whisker"
            median = np.nanmedian(np.abs(to_display("r", away - radius[rows])))
            # A nanometre is rounding, of contacts that are the truth.
            nearby = f"{median:.2g} mm" if median >= 0.01 else f"{1e3 * median:.2g} µm"
            where = f"within {nearby} of" if median > 1e-6 else "on"
            style.conclude(
                figure,
                f"{len(away)} contact points: in half of them the {thing} is {where} the "
                f"{bodies[-1][1]} surface",
            )
        if shade is not None:
            page, height = 25.4 * figure.get_size_inches()
            box = page - _BAR + 2.0, _BOTTOM, 2.0, 0.6 * (height - _BOTTOM - _TOP)
            rail = style.box_axes(figure, box)
            style.colour_bar(figure, dots, cax=rail, label=axis_label(colour_name))
        return figure


def _draw(
    axes: Axes, body: space.Body, look: str, view: tuple[int, int], places: Array, limits: Array
) -> None:
    """Draw an object in one view, except for fitted surfaces that face the view."""
    middle = np.median(places, axis=0)
    if space.is_cylinder(body):
        shown = space.outline(body, view, float(middle[2]), limits)
        axes.add_patch(Polygon(shown, closed=True, **_LOOKS[look]))
    elif look == "true" and view != (0, 1):
        space.draw_body(axes, body, view, limits, look)
    elif look == "true" or not space.lies_flat(body, view, places):
        if hasattr(body, "radius"):  # a sphere's outline is its section through the centre
            middle = to_display("object_position", getattr(body, "origin"))  # noqa: B009
        depth = float(middle[3 - sum(view)])
        space.draw_section(axes, body, view, depth, limits, look)
    axes.set(xlim=limits[view[0]], ylim=limits[view[1]])


_PEG: dict[str, Any] = {
    "facecolor": "#ececec",
    "edgecolor": style.MUTED,
    "linewidth": 0.8,
    "zorder": 1,
}
_FITTED: dict[str, Any] = {
    "facecolor": "none",
    "edgecolor": style.ORANGE,
    "linewidth": 1.0,
    "linestyle": (0, (4, 2)),
    "zorder": 4,
}
_LOOKS = {"true": _PEG, "fitted": _FITTED}


def _limits(places: Array, body: space.Body | None) -> Array:
    """Limits (3, 2), mm, equally wide along x and y, and suitable for round objects."""
    limits = np.array([robust_limits(c) for c in places.T])
    radius = float(to_display("object_radius", getattr(body, "radius", np.nan)))
    if np.isnan(radius):
        middle, half = limits[:2].mean(axis=1), 0.55 * np.ptp(limits[:2], axis=1).max()
    else:
        middle = to_display("object_position", getattr(body, "origin"))[:2]  # noqa: B009
        away = np.abs(places[:, :2] - middle).max(axis=1)
        half = np.clip(1.1 * np.quantile(away, 0.9), 1.5 * radius, 2.5 * radius)
    limits[:2] = middle[:, None] + half * np.array([-1.0, 1.0])
    tall = max(0.55 * float(np.ptp(limits[2])), 1.5 * float(half))
    limits[2] = limits[2].mean() + tall * np.array([-1.0, 1.0])
    return limits


def _panels(
    limits: Array, width: style.Width, right: float, above: float
) -> tuple[Figure, list[Axes]]:
    """Create three axes as tall as the view from above, with margins to the right and above, mm."""
    page = style.page_width(width)
    across, tall = np.ptp(limits[0]), np.ptp(limits[2])
    size = (page - _LEFT - 2.0 * _GAP - right) / (1.0 + 2.0 * across / tall)
    height = size + _BOTTOM + above
    figure = style.new_figure(width, height, None)
    panels, left = [], _LEFT
    for i, (view, title) in enumerate(zip(_VIEWS, _TITLES, strict=True)):
        wide = size * float(np.ptp(limits[view[0]]) / np.ptp(limits[view[1]]))
        box = (left, _BOTTOM, wide, size)
        axes = style.box_axes(figure, box, xlim=limits[view[0]], ylim=limits[view[1]])
        axes.set(xlabel=axis_label(_NAMES[view[0]]), ylabel=axis_label(_NAMES[view[1]]))
        style.head(axes, "abc"[i], title)
        few = 3 if wide > 10.0 else 1
        axes.locator_params(axis="x", nbins=5 if i == 0 else few, integer=True)
        panels.append(axes)
        left += wide + _GAP
    return figure, panels


def _ellipses(axes: Axes, places: Array, spread: Array, view: tuple[int, int]) -> None:
    """Draw 95 % ellipses of evenly selected points, unless they are wider than the view."""
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
            edgecolors=style.MUTED,
            linewidths=0.4,
            zorder=2,
        )
    )


def _legend(
    figure: Figure,
    panels: list[Axes],
    known: space.Body | None,
    fitted: space.Body | None,
    spread: bool,
) -> None:
    handles: list[Line2D | Polygon] = []
    corner = np.zeros((1, 2))
    if known is not None:
        name = "peg" if space.is_cylinder(known) else "object"
        handles.append(Polygon(corner, label=f"{name}{_across(known)}", **_PEG))
    if fitted is not None:
        handles.append(Polygon(corner, label=f"fitted{_across(fitted)}", **_FITTED))
        if space.has_band(fitted):
            handles.append(Polygon(corner, label="95 % band", **space.BAND))
    if spread:
        look: dict[str, Any] = {"marker": "o", "markerfacecolor": "none", "linestyle": "none"}
        handles.append(Line2D([], [], color=style.MUTED, label="95 % ellipses", **look))
    if handles:
        place = (panels[0].get_position().x0 + 0.02, 1.0)
        figure.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=place,
            ncols=len(handles),
            borderaxespad=0.3,
        )


def _across(body: space.Body) -> str:
    """Diameter of a shape, if it has one."""
    radius = getattr(body, "radius", None)
    return "" if radius is None else f", {2.0 * float(to_display('object_radius', radius)):.2f} mm"


_HEIGHT = 52.0
# Largest distance shown, µm; predictions for the lightest contacts have no upper limit.
_FARTHEST = 1e5


def distances_by_class(summaries: Sequence[xr.Dataset], *, width: style.Width = "double") -> Figure:
    """Draw distances from the surface by classes, with what the covariance predicts.

    Parameters
    ----------
    summaries : sequence of xarray.Dataset
        Results of `vibrissa.contour.distances_by`, one panel each.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Median and 95 % of the sizes of the distances, µm, on a logarithmic scale that ends at
        100 mm; filled markers are measured, open ones predicted. The number of contacts is below
        each class. Or the sentence "no contacts".
    """
    shown = [s for s in summaries if int(s["contacts"].sum())]
    with style.looking():
        if not shown:
            return style.sentence("no contacts", width)
        figure = style.new_figure(width, _HEIGHT, "constrained")
        panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
        for i, (axes, summary) in enumerate(zip(panels, shown, strict=True)):
            _panel(axes, summary)
            name = quantity(summary.attrs["quantity"]).long_name
            style.head(axes, "abc"[i] if i < 3 else "", f"by {name}")
        panels[0].set_ylabel(axis_label("surface_distance").replace("d", "|d|", 1))
        panels[0].set_yscale("log")
        handles, labels = panels[0].get_legend_handles_labels()
        panels[0].yaxis.set_major_formatter("{x:,g}")
        panels[0].set_ylim(top=_FARTHEST)
        figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
        medians = to_display("surface_distance", shown[0]["median"].values)
        first = quantity(shown[0].attrs["quantity"]).long_name
        style.conclude(
            figure,
            f"Median distance from the surface: {np.nanmin(medians):.0f} to "
            f"{np.nanmax(medians):,.0f} µm, by class of {first}",
        )
        return figure


def _panel(axes: Axes, summary: xr.Dataset) -> None:
    place = np.arange(summary.sizes["class"])
    for name, label, colour, aside in (
        ("median", "median", style.INK, -0.12),
        ("largest_95", "95 %", style.ORANGE, 0.12),
    ):
        measured = to_display("surface_distance", summary[name])
        predicted = to_display("surface_distance", summary[f"{name}_predicted"])
        axes.plot(place + aside, measured, "o", color=colour, markersize=4.0, label=label)
        if np.isfinite(predicted).any():
            axes.plot(
                place + aside,
                predicted,
                "o",
                color=colour,
                markersize=7.0,
                markerfacecolor="none",
                markeredgewidth=0.8,
                label=f"{label}, predicted",
            )
    name = summary.attrs["quantity"]
    ends = [summary[end].values for end in ("lower", "upper")]
    lower, upper = (to_display(name, v) for v in ends)
    short = name == "deflection_angle"  # whole degrees, which need one line
    marks = [
        f"{a:.3g}–{'' if short else chr(10)}{b:.3g}\n({int(n)})"
        for a, b, n in zip(lower, upper, summary["contacts"].values, strict=True)
    ]
    axes.set_xticks(place, marks)
    axes.set_xlim(-0.5, len(place) - 0.5)
    axes.set_xlabel(axis_label(name))
    axes.grid(axis="y", color=style.MUTED, alpha=0.25, linewidth=0.4)
