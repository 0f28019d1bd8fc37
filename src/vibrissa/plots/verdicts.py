"""Which triplets of signals locate a contact, as a table (the paper's Table A)."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Wedge

from vibrissa.plots.style import BLUE, INK, MUTED, SHADE, Width, looking, new_figure, page_width
from vibrissa.quantities import quantity, to_display

VERDICTS = ("unique", "unique off a surface", "not unique")
EMPTY = "no contacts"
"""The verdict on a region without contacts: nothing is drawn."""

_ROW = 4.2
"""Height of a row, mm."""

_HEAD, _FOOT = 11.0, 8.0
_EDGES = {"single": (18.5, 7.3, 20.0), "double": (24.0, 13.5, 36.0)}
"""Widths of the triplets' names, of a region's column and of the notation, mm."""

_TOLERANCE = 1e-3
"""Of each signal's range, at which resolution is told."""


def verdict_table(verdicts: xr.Dataset, *, width: Width = "double") -> Figure:
    """Draw the table of verdicts: a row for each triplet, a column for each region.

    A full disc stands for unique, a half one for unique off a surface, an open ring for not unique.
    The triplet chosen is printed in blue, with a mark. At double width, what is not unique is given
    with the largest distance of two contacts that feel the same, and two more columns follow: the
    critical cone, outside which no two contacts feel the same, and the share of contacts that
    another one resembles within 1e-3 of the signals' ranges, both of all contacts and only if
    the region "all" was judged.

    Parameters
    ----------
    verdicts : Dataset
        As of ``vibrissa.uniqueness``: ``verdict`` over (triplet, region); with ``notation``
        (triplet), ``witness_separation`` (triplet, region, witness), ``critical_cone`` (triplet,
        region), ``ambiguous_share`` (triplet, region, signal_tolerance) and the attribute
        ``chosen_triplet``, if known.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        One axes.

    Raises
    ------
    ValueError
        If there are no verdicts, or if one is unknown.
    """
    _check(verdicts)
    triplets = [str(t) for t in verdicts["triplet"].values]
    regions = [str(r) for r in verdicts["region"].values]
    height = _HEAD + _FOOT + _ROW * len(triplets)
    page = page_width(width)
    with looking():
        figure = new_figure(width, height, None)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, page), ylim=(height, 0.0))
        axes.set_axis_off()
        shares = verdicts.get("ambiguous_share")
        told = shares is not None and bool(np.isfinite(shares.values).any())
        _heads(axes, regions, width, page, told)
        chosen = str(verdicts.attrs.get("chosen_triplet", ""))
        for i, triplet in enumerate(triplets):
            _row(axes, verdicts.sel(triplet=triplet), i, triplet == chosen, width, page)
        _key(axes, height, width)
        return figure


def _check(verdicts: xr.Dataset) -> None:
    if "verdict" not in verdicts or set(verdicts["verdict"].dims) != {"triplet", "region"}:
        raise ValueError(
            "the dataset has no verdict over triplet and region; that of vibrissa.uniqueness "
            "is needed"
        )
    unknown = sorted(set(map(str, verdicts["verdict"].values.ravel())) - {*VERDICTS, EMPTY})
    if unknown:
        raise ValueError(f"unknown verdicts {unknown}; allowed are {', '.join(VERDICTS)}")


def triplet_label(triplet: str) -> str:
    """Write a triplet with its signals' symbols."""
    return "  ".join(f"${quantity(name).symbol}$" for name in triplet.split())


def _line(axes: Axes, y: float, page: float, weight: float) -> None:
    axes.plot([1.5, page - 1.5], [y, y], color=INK, linewidth=weight)


def _heads(axes: Axes, regions: list[str], width: Width, page: float, shares: bool) -> None:
    names, column, notation = _EDGES[width]
    base = _HEAD - 2.0
    look: dict[str, Any] = {"fontsize": 6.5, "va": "bottom"}
    _line(axes, 1.5, page, 0.9)
    _line(axes, _HEAD - 1.0, page, 0.5)
    axes.text(4.0, base, "triplet", **look)
    for j, region in enumerate(regions):
        text = region.replace(" ", "\n")
        axes.text(names + (j + 0.5) * column, base, text, ha="center", linespacing=1.1, **look)
    left = names + len(regions) * column + 2.0
    axes.text(left, base, "unique for", **look)
    if width == "double" and "all" in regions:
        axes.text(left + notation + 1.0, base, "critical\ncone", linespacing=1.1, **look)
    if width == "double" and "all" in regions and shares:
        axes.text(left + notation + 14.0, base, "ambiguous\nat 0.1 %", linespacing=1.1, **look)


def _row(axes: Axes, verdict: xr.Dataset, i: int, chosen: bool, width: Width, page: float) -> None:
    names, column, notation = _EDGES[width]
    y = _HEAD + (i + 0.5) * _ROW
    if i % 2 == 0:
        axes.fill_between(
            [1.5, page - 1.5], y - 0.5 * _ROW, y + 0.5 * _ROW, color=SHADE, alpha=0.45, linewidth=0
        )
    label = triplet_label(str(verdict["triplet"].values))
    axes.text(4.0, y, label, fontsize=6.5, va="center", color=BLUE if chosen else INK)
    if chosen:
        axes.plot(2.6, y, marker=">", markersize=2.5, color=BLUE)
    for j, kind in enumerate(verdict["verdict"].values):
        x = names + (j + 0.5) * column
        _symbol(axes, x, y, str(kind))
        if width == "double":
            look: dict[str, Any] = {"fontsize": 5.5, "va": "center_baseline"}
            axes.text(x + 1.8, y, _separation(verdict, j), **look)
    left = names + verdict.sizes["region"] * column + 2.0
    if "notation" in verdict:
        notation_text = str(verdict["notation"].values)
        size = 5.5 if width == "double" or len(notation_text) < 14 else 4.8
        axes.text(left, y, notation_text, fontsize=size, va="center")
    if width == "double" and "all" in verdict["region"].values:
        _evidence(axes, verdict, left + notation, y)


def _symbol(axes: Axes, x: float, y: float, kind: str) -> None:
    if kind == EMPTY:
        return
    size = 1.15
    colour = MUTED if kind == "not unique" else BLUE
    axes.add_patch(Circle((x, y), size, facecolor="white", edgecolor=colour, linewidth=0.7))
    if kind == "unique":
        axes.add_patch(Circle((x, y), size, facecolor=BLUE, edgecolor=BLUE, linewidth=0.7))
    elif kind == "unique off a surface":
        axes.add_patch(Wedge((x, y), size, 90.0, 270.0, facecolor=BLUE, linewidth=0.0))


def _separation(verdict: xr.Dataset, region: int) -> str:
    """Largest distance of two contacts that feel the same, mm."""
    if "witness_separation" not in verdict:
        return ""
    apart = to_display("contact_point", verdict["witness_separation"].isel(region=region).values)
    known = apart[np.isfinite(apart)]
    return f"{known.max():.1f}" if known.size else ""


def _evidence(axes: Axes, verdict: xr.Dataset, left: float, y: float) -> None:
    """Critical cone, and the share of ambiguous contacts as a bar, of all contacts."""
    look: dict[str, Any] = {"fontsize": 5.5, "va": "center"}
    if "critical_cone" in verdict:
        cone = float(np.degrees(verdict["critical_cone"].sel(region="all")))
        text = "" if not np.isfinite(cone) else f"{cone:.1f}°" if cone > 0.0 else "none"
        axes.text(left + 8.5, y, text, ha="right", **look)
    if "ambiguous_share" in verdict:
        share = verdict["ambiguous_share"].sel(region="all")
        nearest = int(np.argmin(np.abs(np.log(share["signal_tolerance"].values / _TOLERANCE))))
        value = float(share.isel(signal_tolerance=nearest))
        if np.isfinite(value):
            axes.barh(y, 9.0 * value, 0.35 * _ROW, left + 14.0, color=MUTED)
            axes.text(left + 14.6 + 9.0 * value, y, f"{100.0 * value:.0f} %", **look)


def _key(axes: Axes, height: float, width: Width) -> None:
    """What the symbols mean."""
    y = height - _FOOT + 3.0
    axes.plot([1.5, axes.get_xlim()[1] - 1.5], [y - 3.0] * 2, color=INK, linewidth=0.9)
    x = 3.5
    for kind, room in zip(VERDICTS, (14.0, 30.0, 20.0), strict=True):
        _symbol(axes, x, y, kind)
        axes.text(x + 2.2, y, kind, fontsize=6.0, va="center")
        x += room
    if width == "double":
        text = "numbers: largest distance (mm) of two contacts that feel the same"
        axes.text(x, y, text, fontsize=6.0, va="center")
