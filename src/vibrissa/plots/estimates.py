"""Estimated against true contact points (the paper's Fig. 4E)."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.plots.colours import sequential
from vibrissa.plots.style import (
    INK,
    LOOK,
    MUTED,
    Array,
    mark_panel,
    new_figure,
    robust_limits,
    say,
)
from vibrissa.quantities import axis_label, quantity, to_display

_COORDINATES = ("r", "theta", "phi")


def estimated_against_true(
    true_spherical: ArrayLike,
    estimated_spherical: ArrayLike,
    *,
    time: ArrayLike | None = None,
    colour: ArrayLike | None = None,
    colour_name: str = "deflection_angle",
) -> Figure:
    """Draw estimated against true r, θ and φ; below, over time: their course, and the error.

    Parameters
    ----------
    true_spherical, estimated_spherical : array_like (n, 3)
        (r, θ, φ) of the contact points, whisker frame, m and rad; rows with NaN are left out.
    time : array_like (n,), optional
        Of the frames, s; without it the courses over time are left out.
    colour : array_like (n,), optional
        What colours the points, in SI units: by default the time, if known.
    colour_name : str
        Which quantity ``colour`` is.

    Returns
    -------
    Figure
        Two columns wide, three panels a row, in mm and degrees; or the sentence "no contacts".
        Limits follow the true values; how many estimates lie outside is written in the panel.

    Raises
    ------
    ValueError
        If shapes differ.
    """
    true, estimated = (_rows(a) for a in (true_spherical, estimated_spherical))
    extra = {"time": time, "colour": colour}
    given = {k: np.asarray(v, dtype=np.float64) for k, v in extra.items() if v is not None}
    if true.shape != estimated.shape or any(v.shape != true.shape[:1] for v in given.values()):
        shapes = ", ".join(str(v.shape) for v in (true, estimated, *given.values()))
        raise ValueError(f"true, estimated and what goes with them have shapes {shapes}")
    known = np.isfinite(true).all(axis=1) & np.isfinite(estimated).all(axis=1)
    for values in given.values():
        known &= np.isfinite(values)
    true, estimated = true[known], estimated[known]
    seconds = to_display("time", given["time"][known]) if time is not None else None
    shade, label = seconds, axis_label("time")
    if colour is not None:
        shade = to_display(colour_name, given["colour"][known])
        label = axis_label(colour_name)
    with mpl.rc_context(dict(LOOK)):
        figure = new_figure("double", 68.0 if seconds is None else 140.0, "constrained")
        if len(true) == 0:
            say(figure, "no contacts")
            return figure
        rows = 1 if seconds is None else 3
        ratios = [2.3, 1.0, 1.0][:rows]
        panels = figure.subplots(rows, 3, squeeze=False, height_ratios=ratios)
        look = {"c": shade, "cmap": sequential()} if shade is not None else {"color": INK}
        if shade is not None:
            look["vmin"], look["vmax"] = robust_limits(shade)
        for i, name in enumerate(_COORDINATES):
            values = to_display(name, true[:, i]), to_display(name, estimated[:, i])
            dots = _against(panels[0, i], name, *values, look)
            mark_panel(panels[0, i], "abc"[i], -0.12)
            if seconds is not None:
                _course(panels[1, i], name, seconds, *values, look)
                _errors(panels[2, i], name, seconds, *values, look)
        if shade is not None:
            bar = figure.colorbar(dots, ax=panels, label=label, aspect=50, pad=0.01)
            bar.outline.set_linewidth(0.0)  # type: ignore[operator]
        figure.align_ylabels(panels[:, 0])
        return figure


def _rows(values: ArrayLike) -> Array:
    rows = np.asarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise ValueError(f"spherical coordinates have shape {rows.shape}; (n, 3) is needed")
    return rows


def _difference(name: str, true: Array, estimated: Array) -> Array:
    """Estimate minus truth; of the azimuth, the short way round."""
    away = estimated - true
    return (away + 180.0) % 360.0 - 180.0 if name == "theta" else away


def _against(
    axes: Axes, name: str, true: Array, estimated: Array, look: dict[str, object]
) -> PathCollection:
    low, high = robust_limits(true, share=1.0)
    room = 0.06 * (high - low)
    limits = (low - room, high + room)
    axes.plot(limits, limits, color=MUTED, linewidth=0.6, zorder=1)
    dots = axes.scatter(true, estimated, s=4.0, linewidths=0.0, zorder=2, **look)  # type: ignore[arg-type]
    axes.set(xlim=limits, ylim=limits, aspect="equal", title=quantity(name).long_name)
    axes.set(xlabel=f"true {axis_label(name)}", ylabel=f"estimated {axis_label(name)}")
    error = np.median(np.abs(_difference(name, true, estimated)))
    unit = quantity(name).display_unit
    outside = int(((estimated < limits[0]) | (estimated > limits[1])).sum())
    words = f"median |error| {error:.2g}{'' if unit == '°' else ' '}{unit}"
    if outside:
        words += f"\n{outside} of {true.size} outside"
    axes.text(0.04, 0.97, words, transform=axes.transAxes, va="top", fontsize=6.0)
    return dots


def _course(
    axes: Axes, name: str, time: Array, true: Array, estimated: Array, look: dict[str, object]
) -> None:
    low, high = robust_limits(true, share=1.0)
    axes.scatter(time, estimated, s=3.0, linewidths=0.0, zorder=2, **look)  # type: ignore[arg-type]
    axes.plot(*_broken(time, true), color=INK, linewidth=0.6, zorder=3)
    axes.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    axes.set_ylabel(axis_label(name))
    axes.tick_params(labelbottom=False)


def _errors(
    axes: Axes, name: str, time: Array, true: Array, estimated: Array, look: dict[str, object]
) -> None:
    error = _difference(name, true, estimated)
    axes.axhline(0.0, color=MUTED, linewidth=0.6, zorder=1)
    axes.scatter(time, error, s=3.0, linewidths=0.0, zorder=2, **look)  # type: ignore[arg-type]
    axes.set_ylim(1.1 * robust_limits(error, share=0.96, symmetric=True))
    axes.set(xlabel=axis_label("time"), ylabel=axis_label(f"error_{name}"))


def _broken(time: Array, values: Array) -> tuple[Array, Array]:
    """A line with gaps where no frames are."""
    step = np.diff(time)
    if step.size == 0:
        return time, values
    gaps = np.flatnonzero(step > 3.0 * np.median(step)) + 1
    return np.insert(time, gaps, np.nan), np.insert(values, gaps, np.nan)
