"""The six signals over time."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vibrissa.numerics import Array, Mask
from vibrissa.plots.style import BLUE, INK, SHADE, Width, conclude, head, looking, new_figure, say
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.recording import Group
from vibrissa.scene import DIRECTIONS

_COLUMNS = (("Fx", "FT", "FD"), ("Mx", "MB", "MD"))


def signals_over_time(
    signals: xr.Dataset,
    truth: xr.Dataset | None = None,
    *,
    whisker: int = 0,
    width: Width = "double",
) -> Figure:
    """Draw the six signals over time, forces on the left and moments on the right."""
    names = [name for column in _COLUMNS for name in column]
    if "time" not in signals.coords or not any(name in signals for name in names):
        raise ValueError(
            "time and some of Fx, FT, FD, Mx, MB, MD are needed (vibrissa.base_signals makes them "
            f"from force and moment); the dataset has {', '.join(map(str, signals.variables))}"
        )
    signals = Group(signals).whisker(whisker).data
    truth = None if truth is None else Group(truth).whisker(whisker).data
    time = to_display("time", signals["time"])
    if truth is not None and truth.sizes.get("time") != time.size:
        raise ValueError(f"the truth has {dict(truth.sizes)}, the signals {time.size} times")
    contact = _contact(signals)
    with looking():
        layout: tuple[int, int, float] = (3, 2, 92.0) if width == "double" else (6, 1, 130.0)
        figure = new_figure(width, layout[2], "constrained")
        if time.size == 0:
            say(figure, "no signals")
            return figure
        panels = figure.subplots(*layout[:2], sharex=True, squeeze=False)
        # Forces in the left column and moments in the right one; or one below the other.
        for axes, name, letter in zip(panels.T.flat, names, "abcdef", strict=True):
            _panel(axes, name, signals, truth, contact)
            head(axes, letter, quantity(name).long_name)
        for axes in panels[-1]:
            axes.set_xlabel(axis_label("time"))
            axes.set_xlim(time.min(), time.max() if time.size > 1 else time.min() + 1.0)
        figure.align_ylabels()
        _legend(figure, truth is not None, contact is not None)
        # Signals without a direction have their largest size where the whisker is loaded most.
        largest = [
            f"${quantity(n).symbol}$ up to {np.nanmax(to_display(n, signals[n]), initial=0.0):.3g} "
            f"{quantity(n).display_unit}"
            for n in ("FT", "MB")
            if n in signals
        ]
        count = "" if contact is None else f" in {len(intervals(time, contact))} contacts"
        if largest:
            conclude(figure, f"{' and '.join(largest)}{count}")
        return figure


def _contact(signals: xr.Dataset) -> Mask | None:
    if "in_contact" not in signals:
        return None
    return np.asarray(np.nan_to_num(signals["in_contact"].to_numpy().astype(np.float64)) > 0.5)


def intervals(time: Array, contact: Mask) -> Array:
    """Find when contacts begin and end."""
    if time.size < 2:
        return np.empty((0, 2))
    halfway = 0.5 * (time[1:] + time[:-1])
    edges = np.concatenate([time[:1], halfway, time[-1:]])
    change = np.diff(np.concatenate([[0], contact.astype(np.int8), [0]]))
    return np.stack([edges[change == 1], edges[change == -1]], axis=1)


def _panel(
    axes: Axes,
    name: str,
    signals: xr.Dataset,
    truth: xr.Dataset | None,
    contact: Mask | None,
) -> None:
    time = to_display("time", signals["time"])
    if contact is not None:
        for begin, end in intervals(time, contact):
            axes.axvspan(begin, end, color=SHADE, linewidth=0.0, zorder=0)
    if name not in DIRECTIONS:
        axes.axhline(0.0, color="#bfbfbf", linewidth=0.5, zorder=1)
    look: dict[str, Any] = (
        {"marker": ".", "markersize": 1.6, "linestyle": "none"} if name in DIRECTIONS else {}
    )
    if name in signals:
        axes.plot(time, _drawn(name, signals, contact), color=BLUE, zorder=2, **look)
    if truth is not None and name in truth:
        look["markersize"] = 0.8
        line = {"linewidth": 0.4} if name not in DIRECTIONS else look
        values = _drawn(name, truth, contact)
        axes.plot(time, values, color=INK, zorder=3, **line)
    axes.set_ylabel(axis_label(name))
    if name in DIRECTIONS:
        axes.set_ylim(-190.0, 190.0)
        axes.set_yticks([-180.0, -90.0, 0.0, 90.0, 180.0])


def _drawn(name: str, data: xr.Dataset, contact: Mask | None) -> Array:
    """Values in display units, of a direction only those in contact."""
    values = to_display(name, data[name])
    return (
        values if name not in DIRECTIONS or contact is None else np.where(contact, values, np.nan)
    )


def _legend(figure: Figure, truth: bool, contact: bool) -> None:
    handles: list[Line2D | Patch] = []
    if truth:
        handles += [Line2D([], [], color=BLUE, label="measured")]
        handles += [Line2D([], [], color=INK, linewidth=0.4, label="true")]
    if contact:
        handles += [Patch(facecolor=SHADE, label="in contact")]
    if handles:
        figure.legend(handles=handles, loc="outside upper right", ncols=len(handles))
