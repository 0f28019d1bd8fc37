"""Estimated against true contact points (the paper's Fig. 4E)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.plots.style import (
    MUTED,
    SMALL,
    conclude,
    head,
    looking,
    new_figure,
    plain,
    say,
    shading,
    usable_rows,
)
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import COORDINATES, robust_limits


def estimated_against_true(
    true_spherical: ArrayLike,
    estimated_spherical: ArrayLike,
    *,
    time: ArrayLike | None = None,
    colour: ArrayLike | None = None,
    colour_name: str = "deflection_angle",
    known_as: str = "true",
) -> Figure:
    """Draw estimated against true r, θ and φ; below, over time: their course, and the error.

    Parameters
    ----------
    true_spherical, estimated_spherical : array_like (n, 3)
        (r, θ, φ) of the contact points, whisker frame, m and rad; rows with NaN are left out.
    time : array_like (n,), optional
        Times of the frames, s; without them the courses over time are left out.
    colour : array_like (n,), optional
        Values that colour the points, SI units: by default the time, if known.
    colour_name : str
        Name of the quantity ``colour``.
    known_as : str
        Word on the axes for the values that count as true, such as "tracked".

    Returns
    -------
    Figure
        Two columns wide, three panels a row, in mm and degrees; or the sentence "no contacts".
        Limits follow the true values, and nine tenths of the errors; how much lies outside, and the
        median size of the error, are written above.

    Raises
    ------
    ValueError
        If shapes differ.
    """
    shades, name = (time, "time") if colour is None else (colour, colour_name)
    true, estimated, seconds, shade = _usable(true_spherical, estimated_spherical, time, shades)
    seconds = None if seconds is None else to_display("time", seconds)
    shade = None if shade is None else to_display(name, shade)
    with looking():
        figure = new_figure("double", 58.0 if seconds is None else 125.0, "constrained")
        if len(true) == 0:
            say(figure, "no contacts")
            return figure
        rows = 1 if seconds is None else 3
        ratios = [2.1, 1.0, 1.0][:rows]
        panels = figure.subplots(rows, 3, squeeze=False, height_ratios=ratios)
        look = shading(shade)
        for i, axis in enumerate(COORDINATES):
            pair = to_display(axis, true[:, i]), to_display(axis, estimated[:, i])
            dots = against(panels[0, i], axis, pair, look, known_as)
            head(panels[0, i], "abc"[i], quantity(axis).long_name)
            if seconds is not None:
                _course(panels[1, i], axis, seconds, pair, look)
                _errors(panels[2, i], axis, seconds, pair, look)
        if shade is not None:
            # As tall as the panels of the first row, to their right.
            place: dict[str, Any] = {
                "shrink": 0.8 if rows == 1 else 0.4,
                "aspect": 22,
                "anchor": (0.0, 0.95),
            }
            plain(figure.colorbar(dots, ax=panels, label=axis_label(name), pad=0.01, **place))
        figure.align_ylabels(panels[:, 0])
        conclude(figure, f"{len(true)} contacts: {error_words(true, estimated)}")
        return figure


def error_words(true: Array, estimated: Array) -> str:
    """Median errors of r, θ and φ, of coordinates in m and rad."""
    parts = []
    for i, name in enumerate(COORDINATES):
        pair = to_display(name, true[:, i]), to_display(name, estimated[:, i])
        row = quantity(name)
        unit = row.display_unit if row.display_unit == "°" else f" {row.display_unit}"
        error = np.median(np.abs(_difference(name, *pair)))
        parts.append(f"{error:.2g}{unit} in ${row.symbol}$")
    return f"median error {parts[0]}, {parts[1]} and {parts[2]}"


def _usable(
    true: ArrayLike, estimated: ArrayLike, time: ArrayLike | None, shade: ArrayLike | None
) -> tuple[Array, Array, Array | None, Array | None]:
    """Rows in which nothing is missing; those of the largest shade last, to be drawn on top."""
    points = np.asarray(true, np.float64), np.asarray(estimated, np.float64)
    times = [None if values is None else np.asarray(values, np.float64) for values in (time, shade)]
    n = points[0].shape[:1]
    named = zip(("true_spherical", "estimated_spherical"), points, strict=True)
    shapes = {name: (values, (*n, 3)) for name, values in named}
    rows = usable_rows(times[1], shapes | {"time": (times[0], n), "colour": (times[1], n)})
    seconds, shades = (None if values is None else values[rows] for values in times)
    return points[0][rows], points[1][rows], seconds, shades


def _difference(name: str, true: Array, estimated: Array) -> Array:
    """Estimate minus truth; of the azimuth, the short way round."""
    away = estimated - true
    return (away + 180.0) % 360.0 - 180.0 if name == "theta" else away


def _range(true: Array, estimated: Array) -> Array:
    """Limits that hold all that is true and most of the estimates, but not the wildest."""
    low, high = robust_limits(true, share=1.0)
    span = high - low
    least, most = robust_limits(estimated, share=0.95)
    low, high = min(low, max(least, low - 0.5 * span)), max(high, min(most, high + 0.5 * span))
    room = 0.06 * (high - low)
    return np.array([low - room, high + room])


def against(
    axes: Axes, name: str, pair: tuple[Array, Array], look: dict[str, Any], known_as: str = "true"
) -> PathCollection:
    """Draw an estimated coordinate against the true one."""
    true, estimated = pair
    limits = _range(*pair)
    axes.plot(limits, limits, color=MUTED, linewidth=0.6, zorder=1)
    dots = axes.scatter(true, estimated, s=4.0, zorder=2, **look)
    axes.set(xlim=limits, ylim=limits, aspect="equal")
    axes.set(xlabel=f"{known_as} {axis_label(name)}", ylabel=f"estimated {axis_label(name)}")
    outside = int(((estimated < limits[0]) | (estimated > limits[1])).sum())
    if outside:
        _remark(axes, f"{outside} of {true.size} outside")
    return dots


def _course(
    axes: Axes, name: str, time: Array, pair: tuple[Array, Array], look: dict[str, Any]
) -> None:
    axes.scatter(time, pair[1], s=3.0, zorder=2, **look)
    axes.plot(*_broken(time, pair[0]), color=MUTED, linewidth=1.4, zorder=1)
    axes.set_ylim(*_range(*pair))
    axes.set_ylabel(axis_label(name))
    axes.tick_params(labelbottom=False)


def _errors(
    axes: Axes, name: str, time: Array, pair: tuple[Array, Array], look: dict[str, Any]
) -> None:
    error = _difference(name, *pair)
    axes.axhline(0.0, color=MUTED, linewidth=0.6, zorder=1)
    axes.scatter(time, error, s=3.0, zorder=2, **look)
    axes.set_ylim(*1.1 * robust_limits(error, share=0.9, symmetric=True))
    axes.set(xlabel=axis_label("time"), ylabel=axis_label(f"error_{name}"))
    unit = quantity(name).display_unit
    size = f"{np.median(np.abs(error)):.2g}{'' if unit == '°' else ' '}{unit}"
    _remark(axes, f"median {size}, {_within(error, axes.get_ylim())} % shown")


def _within(values: Array, limits: tuple[float, float]) -> int:
    """Share of values between limits, in whole per cent."""
    return round(100.0 * float(np.mean((values >= limits[0]) & (values <= limits[1]))))


def _remark(axes: Axes, words: str) -> None:
    """Write above the upper right corner of a panel."""
    axes.set_title(words, loc="right", fontsize=SMALL, color=MUTED, pad=3.0)


def _broken(time: Array, values: Array) -> tuple[Array, Array]:
    """A line with gaps where no frames are."""
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    step = np.diff(time)
    if step.size == 0:
        return time, values
    gaps = np.flatnonzero(step > 3.0 * np.median(step)) + 1
    return np.insert(time, gaps, np.nan), np.insert(values, gaps, np.nan)
