"""How far contact points lie from a known object, by deflection angle, distance, signal size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vibrissa.plots.style import INK, MUTED, ORANGE, Width, head, looking, new_figure, say
from vibrissa.quantities import axis_label, quantity, to_display

_HEIGHT = 52.0


def distances_by_class(summaries: Sequence[xr.Dataset], *, width: Width = "double") -> Figure:
    """Draw distances from the surface by classes, beside what the covariance predicts.

    Parameters
    ----------
    summaries : sequence of xarray.Dataset
        Of `vibrissa.contour.distances_by`: one panel each.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Median and 95 % of the sizes of the distances, µm, on a logarithmic scale: filled as
        measured, open as predicted. The number of contacts stands below each class. Or the
        sentence "no contacts".
    """
    shown = [s for s in summaries if int(s["contacts"].sum())]
    with looking():
        if not shown:
            figure = new_figure(width, 40.0, None)
            say(figure, "no contacts")
            return figure
        figure = new_figure(width, _HEIGHT, "constrained")
        panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
        for i, (axes, summary) in enumerate(zip(panels, shown, strict=True)):
            _panel(axes, summary)
            name = quantity(summary.attrs["quantity"]).long_name
            head(axes, "abc"[i] if i < 3 else "", f"by {name}")
        panels[0].set_ylabel(axis_label("surface_distance").replace("d", "|d|", 1))
        panels[0].set_yscale("log")
        handles, labels = panels[0].get_legend_handles_labels()
        panels[0].yaxis.set_major_formatter("{x:g}")
        figure.legend(handles, labels, loc="outside upper right", ncols=len(labels))
        return figure


def _panel(axes: Axes, summary: xr.Dataset) -> None:
    place = np.arange(summary.sizes["class"])
    for name, label, colour, beside in (
        ("median", "median", INK, -0.12),
        ("largest_95", "95 %", ORANGE, 0.12),
    ):
        measured = to_display("surface_distance", summary[name])
        predicted = to_display("surface_distance", summary[f"{name}_predicted"])
        axes.plot(place + beside, measured, "o", color=colour, markersize=4.0, label=label)
        if np.isfinite(predicted).any():
            axes.plot(
                place + beside,
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
    marks = [
        f"{a:.3g}–\n{b:.3g}\n({int(n)})"
        for a, b, n in zip(lower, upper, summary["contacts"].values, strict=True)
    ]
    axes.set_xticks(place, marks, fontsize=6.0)
    axes.set_xlim(-0.5, len(place) - 0.5)
    axes.set_xlabel(axis_label(name))
    axes.grid(axis="y", color=MUTED, alpha=0.25, linewidth=0.4)
