"""The picture on the first page: a bent whisker, its base signals, and the contour of a peg."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

import vibrissa as vb
from vibrissa.contour import CylinderFit, shape_from_dataset
from vibrissa.numerics import Array
from vibrissa.objects import Peg
from vibrissa.plots import key_frames
from vibrissa.plots.contact_surfaces import coordinate_bar, levels
from vibrissa.plots.space import (
    bounds,
    drop_lines,
    name_axes,
    outline,
    paint,
    painted,
    signal_axes,
    signal_limits,
    signal_places,
    signal_rows,
    space_axes,
)
from vibrissa.plots.style import (
    BLUE,
    INK,
    MUTED,
    ORANGE,
    box_axes,
    looking,
    sequential,
    sized_figure,
)
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.recording import Recording
from vibrissa.scene import (
    TRIPLET,
    Course,
    column,
    course_of,
    sample_contacts,
    solid_surface,
    values_of,
)
from vibrissa.signals import SIGNALS

WIDTH, HEIGHT = 182.0, 121.0
HEADS = (
    (2.0, "A whisker is bent,"),
    (66.0, "three signals locate the contacts,"),
    (130.5, "and the contacts draw the peg."),
)
SKIN, PEG = (0.62, 0.72, 0.82, 1.0), (0.85, 0.85, 0.85, 1.0)
OPEN = np.radians([-205.0, 40.0])
"""Bearings of the force that remain where the solids are cut open."""

ROOM = 1.5
"""Solids end where contacts are so many times as strong as any of the trial."""

REACH, ARROW = 9.0, 9.0
"""Half of the piece of peg that is drawn, and the arrow of the force, mm."""

SHARP = 0.1
"""Contacts whose standard deviation, mm, is larger are paler."""

TRUE: dict[str, Any] = {"facecolor": "#e4e4e4", "edgecolor": MUTED, "linewidth": 0.6, "zorder": 1}
FITTED: dict[str, Any] = {
    "facecolor": "none",
    "edgecolor": INK,
    "linewidth": 1.0,
    "linestyle": (0, (4, 2)),
    "zorder": 4,
}


def title_picture(trial: xr.DataTree, contact_map: vb.ContactMap) -> Figure:
    """Draw a trial with signals, estimates and a fitted peg, of one whisker and its map."""
    course = course_of(trial)
    assert course.signals is not None
    # Shortly before the whisker, bent most, slips off.
    moment = max(key_frames(course), key=lambda row: course.signals["MB"][row]) - 3
    (peg,) = Recording(trial).objects
    fit = shape_from_dataset(trial["contour"].to_dataset())
    assert isinstance(peg, Peg)
    assert isinstance(fit, CylinderFit)
    samples, line = contact_map.to_dataset(), contact_map.whisker.centerline(101)
    now = trial["signals"].to_dataset().isel(whisker=0, time=moment)
    with looking():
        figure = sized_figure(WIDTH, HEIGHT)
        for left, words in HEADS:
            write(figure, left, HEIGHT - 5.0, words, fontsize=8.5)
        bent(figure, course, samples, line, peg, moment, now["force"].values)
        readings(figure, now)
        solids(figure, course, samples, line, moment)
        contour(figure, trial, peg, fit, moment)
        return figure


def write(figure: Figure, x: float, y: float, words: str, **look: Any) -> None:
    """A word at a place in mm."""
    figure.text(x / WIDTH, y / HEIGHT, words, **look)


def bent(
    figure: Figure,
    course: Course,
    samples: xr.Dataset,
    line: Array,
    peg: Peg,
    moment: int,
    force: Array,
) -> None:
    """The whisker at that moment in the space that its contacts can reach, whisker frame."""
    shell = solid_surface(sample_contacts(samples, line), True, column("deflection"))
    places = to_display("contact_point", shell[..., :3])
    assert course.centerline is not None
    assert course.known is not None
    now = to_display("centerline", course.at_base(course.centerline))[moment]
    rest = to_display("centerline", line)
    limits = bounds(np.concatenate([places.reshape(-1, 3), rest, now]))
    axes = space_axes(figure, (-7.0, 40.0, 71.0, 71.0), limits, (38.0, -66.0), zoom=0.9)
    name_axes(axes, (-8.0, -9.0, -7.5))
    paint(axes, places, SKIN, opacity=0.13)
    paint(axes, peg_triangles(course, peg, moment), PEG)
    draw_whisker(axes, rest, MUTED, 8)
    draw_whisker(axes, now, INK, 10)
    touch = to_display("contact_point", course.known[moment])
    arrow = ARROW * force / np.linalg.norm(force)
    axes.quiver(*(touch - arrow), *arrow, color=ORANGE, linewidth=1.2, zorder=11)
    axes.scatter(*touch, s=14.0, color=ORANGE, zorder=12, depthshade=False)


def draw_whisker(axes: Any, line: Array, colour: str, zorder: int) -> None:
    """From a thick base to a thin tip."""
    parts = np.array_split(np.arange(len(line)), 25)
    for i, part in enumerate(parts):
        look = {"color": colour, "linewidth": 2.4 - 0.075 * i, "solid_capstyle": "round"}
        axes.plot(*line[part[0] : part[-1] + 2].T, zorder=zorder, **look)


def peg_triangles(course: Course, peg: Peg, moment: int) -> Array:
    """A piece of the peg about the contact in the whisker's frame, mm."""
    assert course.places is not None
    turn = np.linspace(0.0, 2.0 * np.pi, 49)
    axis = peg.axis / np.linalg.norm(peg.axis)
    first = np.cross(axis, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    ring = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * np.cross(axis, first)
    middle = peg.origin + ((course.places[moment] - peg.origin) @ axis) * axis
    low, high = (middle + 1e-3 * way * REACH * axis + peg.radius * ring for way in (-1, 1))
    top = np.broadcast_to(middle + 1e-3 * REACH * axis, (48, 3))
    parts = (
        (low[:-1], low[1:], high[1:]),
        (low[:-1], high[1:], high[:-1]),
        (high[:-1], high[1:], top),
    )
    corners = np.concatenate([np.stack(part, axis=1) for part in parts])
    away = (corners - course.position[moment]) @ course.rotation[moment]
    return to_display("contact_point", away)


def readings(figure: Figure, now: xr.Dataset) -> None:
    """What the sensor reads at that moment; the three that are used stand out."""
    write(figure, 4.0, 31.0, "measured at its base:", fontsize=7.0)
    for i, name in enumerate(SIGNALS):
        value, unit = float(to_display(name, now[name].values)), quantity(name).display_unit
        used = name in TRIPLET
        look = {"fontsize": 7.5 if used else 7.0, "color": ORANGE if used else MUTED}
        x, y = 4.0 + 26.0 * (i // 3), 23.5 - 6.5 * (i % 3)
        write(figure, x, y, f"${quantity(name).symbol}$", **look)
        gap = "" if unit == "°" else " "
        digits = 0 if abs(value) >= 10.0 else 2
        number = f"{value:.{digits}f}{gap}{unit}".replace("-", "−")
        write(figure, x + 6.0, y, number, **look)


def solids(figure: Figure, course: Course, samples: xr.Dataset, line: Array, moment: int) -> None:
    """All signals, coloured by r, θ and φ, and the way of the trial through them."""
    assert course.signals is not None
    way = np.stack([course.signals[name] for name in TRIPLET], axis=1)
    way[~course.touching] = np.nan
    strongest = ROOM * np.nanmax(np.abs(way[:, :2]), axis=0)
    nodes = sample_contacts(samples, line, tuple(OPEN))
    pairs = zip(TRIPLET[:2], strongest, strict=True)
    within = [1.0 - np.abs(values_of(name, nodes)) / most for name, most in pairs]
    count = nodes.shape[-1]
    nodes = np.concatenate([nodes, np.stack(within, axis=-1)], axis=-1)
    body = solid_surface(nodes, False, column("deflection"), count, count + 1)
    limits = signal_limits(signal_rows(body))
    course_way = signal_places(*way.T)
    for i, name in enumerate(("r", "theta", "phi")):
        axes = signal_axes(figure, (65.5, 79.0 - 37.0 * i, 51.0, 30.0), limits)
        norm, marks = levels(name, body)
        values = to_display(name, values_of(name, body))
        paint(axes, signal_rows(body), painted(values, norm, sequential()), flat=0.8)
        coordinate_bar(figure, (118.0, 85.5 - 37.0 * i, 1.6, 15.0), name, norm, marks)
        axes.plot(*course_way.T, color=ORANGE, linewidth=0.7, zorder=12)
        axes.scatter(*course_way[moment], s=14.0, color=ORANGE, zorder=14, depthshade=False)
        drop_lines(axes, limits, course_way[moment])


def contour(figure: Figure, trial: xr.DataTree, peg: Peg, fit: CylinderFit, moment: int) -> None:
    """Contact points and the peg, from above and from the front."""
    found = trial["estimates"].to_dataset().isel(whisker=0)
    points = to_display("contact_point", found["contact_point"].values)
    spread = found["contact_covariance"].transpose("time", ...).values
    sigma = 1e3 * np.sqrt(np.trace(spread, axis1=1, axis2=2))
    middle, half = to_display("object_position", peg.origin), 1.9e3 * peg.radius
    sharp = np.nanquantile(points[sigma < 10.0 * SHARP, 2], [0.0, 1.0])
    both = np.array([-1.0, 1.0])
    limits = np.stack([*(middle[:2, None] + half * both), sharp + 0.7 * both])
    for view, box in (((0, 1), (139.0, 68.5, 41.0, 41.0)), ((0, 2), (139.0, 9.0, 41.0, 47.0))):
        axes = box_axes(figure, box, xlim=limits[view[0]], ylim=limits[view[1]])
        axes.set(xlabel=axis_label("xyz"[view[0]]), ylabel=axis_label("xyz"[view[1]]))
        axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        for body, look in ((peg, TRUE), (fit, FITTED)):
            axes.add_patch(Polygon(outline(body, view, float(points[moment, 2]), limits), **look))
        dots(axes, points[:, view], sigma, moment)
        if view == (0, 1):
            name_pegs(axes, middle, peg, fit)


def name_pegs(axes: Axes, middle: Array, peg: Peg, fit: CylinderFit) -> None:
    """Diameters, inside of the peg."""
    sigma = f"{to_display('object_radius', 2.0 * fit.sigma['radius']):.2f}"
    true, found = (2.0 * to_display("object_radius", body.radius) for body in (peg, fit))
    words = ((0.45, MUTED, f"peg: {true:.2f} mm"), (0.0, INK, "fitted:"))
    words += ((-0.3, INK, f"{found:.2f} ± {sigma} mm"),)
    for up, colour, text in words:
        axes.text(
            middle[0], middle[1] + up, text, color=colour, fontsize=6.0, ha="center", va="center"
        )


def dots(axes: Axes, points: Array, sigma: Array, moment: int) -> None:
    """Contacts, the better known the bolder."""
    known = np.isfinite(points).all(axis=1) & np.isfinite(sigma)
    bold = np.clip(SHARP / sigma[known], 0.06, 0.9)
    axes.scatter(*points[known].T, s=4.0, color=BLUE, alpha=bold, linewidths=0.0, zorder=3)
    axes.scatter(*points[moment], s=14.0, color=ORANGE, linewidths=0.0, zorder=6)
