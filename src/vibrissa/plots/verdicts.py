"""Figures of uniqueness verdicts on triplets (Table A), required resolution, and whiskers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Wedge
from matplotlib.ticker import NullLocator

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.quantities import quantity, to_display

# Verdicts and their words: a search can refute uniqueness but not prove it.
VERDICTS = ("unique", "unique off a surface", "not unique")
WORDS = {
    "unique": "unique (no counterexample found)",
    "unique off a surface": "unique off a surface",
    "not unique": "not unique (witness)",
}
PROVED = "unique (proved)"
EMPTY = "no contacts"  # the verdict on a region without contacts: nothing is drawn
_ROW = 4.2  # height of a row, mm
_HEAD, _FOOT = 11.0, 13.5
_KEY = (
    "numbers: largest distance (mm) of two contacts with the same signals",
    "critical cone: about rest, outside it no such pair was found",
    "; ambiguous: share of contacts that another one resembles within 0.1 % of ranges",
)
_LETTER = 1.25  # room for a letter of the key, mm
# Widths of the triplets' names, of a region's column and of the notation, mm.
_EDGES = {"single": (18.5, 7.3, 20.0), "double": (24.0, 13.5, 25.0)}
_TOLERANCE = 1e-3  # share of each signal's range at which the resolution is stated


def verdict_table(verdicts: xr.Dataset, *, width: style.Width = "double") -> Figure:
    """Draw the table of verdicts: a row for each triplet, a column for each region.

    A full disc stands for unique, one in a ring for proved unique, a half disc for unique off a
    surface, and an open ring for not unique. The chosen triplet is printed in blue with a mark. At
    double width, verdicts of "not unique" are followed by the largest distance between two contacts
    with the same signals. If the region "all" was judged, three more columns refer to all contacts:
    a lower bound of the critical cone, outside which no two contacts have the same signals; the
    share of contacts that have such a twin; and the share that another contact resembles within
    1e-3 of the signals' ranges.

    Parameters
    ----------
    verdicts : Dataset
        Result of ``vibrissa.uniqueness``: ``verdict`` over (triplet, region); if known with
        ``notation`` (triplet), ``witness_separation`` (triplet, region, witness), ``critical_cone``
        and ``twin_share`` (triplet, region), ``ambiguous_share`` (triplet, region,
        signal_tolerance) and the attribute ``chosen_triplet``.
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
    page = style.page_width(width)
    with style.looking():
        figure = style.new_figure(width, height, None)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, page), ylim=(height, 0.0))
        axes.set_axis_off()
        shares = verdicts.get("ambiguous_share")
        known = shares is not None and bool(np.isfinite(shares.values).any())
        _heads(axes, regions, width, page, known)
        chosen = str(verdicts.attrs.get("chosen_triplet", ""))
        proved = "evidence" in verdicts and bool((verdicts["evidence"] == "proved").any())
        for i, triplet in enumerate(triplets):
            _row(axes, verdicts.sel(triplet=triplet), i, triplet == chosen, width, page)
        explained = _KEY[:1] if "all" not in regions else (_KEY[0], _KEY[1] + known * _KEY[2])
        _key(axes, height, explained if width == "double" else (), proved)
        if "all" in regions:
            every = verdicts.sel(region="all")
            held = (every["verdict"] == VERDICTS[0]).values
            found = [triplet_label(t) for t, yes in zip(triplets, held, strict=True) if yes]
            sure = proved and bool((every["evidence"].values[held] == "proved").all())
            searched = "" if sure and found else ", as far as was searched"
            shown = ", ".join(f"({name})" for name in found) or "none"
            style.conclude(
                figure,
                f"Triplets that locate every contact{searched}: {shown} "
                f"({len(found)} of {len(triplets)})",
            )
        return figure


def _check(verdicts: xr.Dataset) -> None:
    if "verdict" not in verdicts or set(verdicts["verdict"].dims) != {"triplet", "region"}:
        raise ValueError(
            "the dataset has no verdict over triplet and region; that of vibrissa.uniqueness "
            "is needed"
        )
    if unknown := sorted(set(map(str, verdicts["verdict"].values.ravel())) - {*VERDICTS, EMPTY}):
        raise ValueError(f"unknown verdicts {unknown}; allowed are {', '.join(VERDICTS)}")


def triplet_label(triplet: str) -> str:
    """Write a triplet with its signals' symbols."""
    return "  ".join(f"${quantity(name).symbol}$" for name in triplet.split())


def _line(axes: Axes, y: float, page: float, weight: float) -> None:
    axes.plot([1.5, page - 1.5], [y, y], color=style.INK, linewidth=weight)


def _heads(axes: Axes, regions: list[str], width: style.Width, page: float, shares: bool) -> None:
    names, column, notation = _EDGES[width]
    base = _HEAD - 2.0
    look: dict[str, Any] = {"va": "bottom"}
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
        axes.text(left + notation + 13.0, base, "have a\ntwin", linespacing=1.1, **look)
    if width == "double" and "all" in regions and shares:
        axes.text(left + notation + 25.0, base, "ambiguous\nat 0.1 %", linespacing=1.1, **look)


def _row(
    axes: Axes, verdict: xr.Dataset, i: int, chosen: bool, width: style.Width, page: float
) -> None:
    names, column, notation = _EDGES[width]
    y = _HEAD + (i + 0.5) * _ROW
    if i % 2 == 0:
        axes.fill_between(
            [1.5, page - 1.5],
            y - 0.5 * _ROW,
            y + 0.5 * _ROW,
            color=style.SHADE,
            alpha=0.45,
            linewidth=0,
        )
    label = triplet_label(str(verdict["triplet"].values))
    axes.text(4.0, y, label, va="center", color=style.BLUE if chosen else style.INK)
    if chosen:
        axes.plot(2.6, y, marker=">", markersize=2.5, color=style.BLUE)
    for j, kind in enumerate(verdict["verdict"].values):
        x = names + (j + 0.5) * column
        proved = "evidence" in verdict and str(verdict["evidence"].values[j]) == "proved"
        _symbol(axes, x, y, PROVED if proved else str(kind))
        if width == "double":
            look: dict[str, Any] = {"fontsize": style.SMALL, "va": "center_baseline"}
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
    colour = style.MUTED if kind == "not unique" else style.BLUE
    axes.add_patch(Circle((x, y), size, facecolor="white", edgecolor=colour, linewidth=0.7))
    if kind == PROVED:
        axes.add_patch(Circle((x, y), 1.5 * size, fill=False, edgecolor=colour, linewidth=0.5))
    if kind in ("unique", PROVED):
        axes.add_patch(
            Circle((x, y), size, facecolor=style.BLUE, edgecolor=style.BLUE, linewidth=0.7)
        )
    elif kind == "unique off a surface":
        axes.add_patch(Wedge((x, y), size, 90.0, 270.0, facecolor=style.BLUE, linewidth=0.0))


def _separation(verdict: xr.Dataset, region: int) -> str:
    """Largest distance of two contacts with the same signals, mm."""
    if "witness_separation" not in verdict:
        return ""
    apart = to_display("contact_point", verdict["witness_separation"].isel(region=region).values)
    known = apart[np.isfinite(apart)]
    return f"{known.max():.1f}" if known.size else ""


def _evidence(axes: Axes, verdict: xr.Dataset, left: float, y: float) -> None:
    """Write the critical cone and the share with a twin; draw the share of ambiguous contacts."""
    look: dict[str, Any] = {"fontsize": style.SMALL, "va": "center"}
    if "critical_cone" in verdict:
        cone = float(np.degrees(verdict["critical_cone"].sel(region="all")))
        bound = f"≥{np.floor(10.0 * cone) / 10.0:.1f}°"
        text = "" if not np.isfinite(cone) else bound if cone > 0.0 else "none"
        axes.text(left + 9.5, y, text, ha="right", **look)
    if "twin_share" in verdict:
        cell = verdict.sel(region="all")
        twins = 100.0 * float(cell["twin_share"])
        rare = "rare" if str(cell["verdict"].values) == "not unique" else "none"
        share = f"{twins:#.{2 + (twins > 99.0)}g}".rstrip(".") + " %" if twins > 0.0 else rare
        axes.text(left + 20.5, y, share if np.isfinite(twins) else "", ha="right", **look)
    if "ambiguous_share" in verdict:
        alike = verdict["ambiguous_share"].sel(region="all")
        nearest = int(np.argmin(np.abs(np.log(alike["signal_tolerance"].values / _TOLERANCE))))
        value = float(alike.isel(signal_tolerance=nearest))
        if np.isfinite(value):
            axes.barh(y, 9.0 * value, 0.35 * _ROW, left + 25.0, color=style.MUTED)
            axes.text(left + 25.6 + 9.0 * value, y, f"{100.0 * value:.0f} %", **look)


def _key(axes: Axes, height: float, lines: Sequence[str], proved: bool) -> None:
    """Explain the symbols, and the columns in lines below them."""
    x, y, page = 3.5, height - _FOOT + 3.0, axes.get_xlim()[1]
    axes.plot([1.5, page - 1.5], [y - 3.0] * 2, color=style.INK, linewidth=0.9)
    for kind, text in {**({PROVED: PROVED} if proved else {}), **WORDS}.items():
        room = 4.5 + _LETTER * len(text)
        if x + room > page:
            x, y = 3.5, y + 3.5
        _symbol(axes, x, y, kind)
        axes.text(x + 2.4, y, text, fontsize=style.SMALL, va="center")
        x += room
    for line, text in enumerate(lines, start=1):
        axes.text(3.5, y + 3.5 * line, text, fontsize=style.SMALL, va="center")


# The three triplets that the paper finds unique for its γ whisker.
HIGHLIGHTED = ("Fx MB MD", "Mx MB MD", "Fx FD MD")
_LINES: tuple[tuple[str, Any, str], ...] = (
    (style.BLUE, "-", "o"),
    (style.ORANGE, "--", "s"),
    (style.GREEN, ":", "^"),
)
PAPERS_CONE = 2.0  # degrees that the paper leaves out about rest
# Degrees by which neighbours in a map of critical cones differ at most if it is continuous.
_JUMP = 25.0


def resolution(verdicts: xr.Dataset, *, width: style.Width = "double") -> Figure:
    """Draw how many contacts another one resembles, against the signals' tolerance.

    There is one panel per region. The paper's three triplets have colours, dashes and markers; the
    others are pale.

    Parameters
    ----------
    verdicts : Dataset
        Result of ``vibrissa.uniqueness``: ``ambiguous_share`` over (triplet, region,
        signal_tolerance), the tolerances as shares of each signal's range; with the attribute
        ``min_separation``, m, if known.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        One axes for each region.

    Raises
    ------
    ValueError
        If there are no such shares.
    """
    dims = {"triplet", "region", "signal_tolerance"}
    if "ambiguous_share" not in verdicts or set(verdicts["ambiguous_share"].dims) != dims:
        raise ValueError(
            "the dataset has no ambiguous_share over triplet, region and signal_tolerance; that of "
            "vibrissa.uniqueness is needed"
        )
    share = verdicts["ambiguous_share"].transpose("region", "triplet", "signal_tolerance")
    across = 3 if width == "double" else 2
    down = -(-share.sizes["region"] // across)
    with style.looking():
        figure = style.new_figure(width, 38.0 * down + 10.0, "constrained")
        grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        for i, axes in enumerate(grid.ravel()):
            if i >= share.sizes["region"]:
                axes.set_axis_off()
                continue
            _shares(axes, share.isel(region=i))
            style.head(axes, "abcdefghijkl"[i], str(share["region"].values[i]))
        for axes in grid[:, 0]:
            axes.set_ylabel("ambiguous contacts (%)")
        for axes in grid[-1]:
            axes.set_xlabel("tolerance (of range)")
        _resolution_key(figure, share)
        at = share.isel(region=0).sel(signal_tolerance=_TOLERANCE, method="nearest")
        if np.isfinite(at.values).any():
            known = [str(name) for name in at["triplet"].values]
            shown = (verdicts.attrs.get("chosen_triplet"), known[int(np.nanargmin(at.values))])
            left = [
                f"{100.0 * float(at.sel(triplet=name)):.0f} % ({triplet_label(name)})"
                for name in dict.fromkeys(shown)
                if name in known
            ]
            tolerance = f"{100.0 * float(at['signal_tolerance']):g} %"
            style.conclude(
                figure,
                f"Contacts ambiguous at {tolerance} of the signals' ranges: "
                f"{', at best '.join(left)}",
            )
        return figure


def _shares(axes: Axes, share: xr.DataArray) -> None:
    tolerance = share["signal_tolerance"].values
    axes.set(xscale="log", ylim=(-3.0, 103.0))
    axes.set_yticks([0.0, 25.0, 50.0, 75.0, 100.0])
    axes.xaxis.set_minor_locator(NullLocator())
    names = [str(name) for name in share["triplet"].values]
    percent = to_display("share", share.values)
    for name, values in zip(names, percent, strict=True):
        if name not in HIGHLIGHTED:
            axes.plot(tolerance, values, color="#c4c4c4", linewidth=0.5)
    for name, (colour, dashes, marker) in zip(HIGHLIGHTED, _LINES, strict=True):
        if name in names:
            axes.plot(
                tolerance,
                percent[names.index(name)],
                color=colour,
                linestyle=dashes,
                marker=marker,
                markersize=3.0,
                linewidth=1.1,
                clip_on=False,
            )


def _resolution_key(figure: Figure, share: xr.DataArray) -> None:
    known = set(map(str, share["triplet"].values))
    handles = [
        Line2D([], [], color=c, linestyle=d, marker=m, markersize=3.0, label=triplet_label(name))
        for name, (c, d, m) in zip(HIGHLIGHTED, _LINES, strict=True)
        if name in known
    ]
    if known - set(HIGHLIGHTED):
        handles.append(Line2D([], [], color="#c4c4c4", label="other triplets"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def critical_cones(cones: xr.Dataset, *, width: style.Width = "double") -> Figure:
    """Draw the critical cone of whiskers by curvature and taper.

    Parameters
    ----------
    cones : Dataset
        ``critical_cone`` over (triplet, taper_ratio, curvature), rad: the smallest cone about the
        resting whisker outside which no two contacts have the same signals, zero where there are
        none at all, NaN where it was not computed. ``taper_ratio`` is the radius at the base over
        that at the tip, ``curvature`` the coefficient of y = A x² times the length, A·L.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        One axes for each triplet, and a colour bar.

    Raises
    ------
    ValueError
        If there are no such cones.
    """
    dims = {"triplet", "taper_ratio", "curvature"}
    if "critical_cone" not in cones or set(cones["critical_cone"].dims) != dims:
        raise ValueError(
            "a critical_cone over triplet, taper_ratio and curvature is needed; got "
            f"{dict(cones.sizes)} with {', '.join(map(str, cones.data_vars)) or 'no variables'}"
        )
    cone = cones["critical_cone"].transpose("triplet", "taper_ratio", "curvature")
    degrees = np.degrees(cone.values)
    high = float(np.nanmax(degrees, initial=5.0))
    norm, colours = Normalize(0.0, high), style.sequential().reversed()
    count = cone.sizes["triplet"]
    with style.looking():
        shape = (1, count) if width == "double" else (count, 1)
        tall = 62.0 if width == "double" else 46.0 * count + 14.0
        figure = style.new_figure(width, tall, "constrained")
        grid = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
        for i, axes in enumerate(grid.ravel()):
            _cone_map(axes, cone.isel(triplet=i), degrees[i], norm, colours)
            known = degrees[i][np.isfinite(degrees[i])]
            narrow = f"{(known <= PAPERS_CONE).sum()} of {known.size} within {PAPERS_CONE:g}°"
            name = triplet_label(str(cone["triplet"].values[i]))
            style.head(axes, "abcdefghijkl"[i], f"{name}: {narrow}")
        style.conclude(
            figure,
            f"The critical cone of ({triplet_label(str(cone['triplet'].values[0]))}) "
            f"{_trend(degrees[0], 1)} with curvature and {_trend(degrees[0], 0)} with taper",
        )
        for axes in grid[:, 0]:
            axes.set_ylabel("base / tip radius")
        for axes in grid[-1]:
            axes.set_xlabel(r"curvature $A \cdot L$")
        bar = style.colour_bar(
            figure,
            ScalarMappable(norm, colours),
            ax=list(grid.ravel()),
            orientation="horizontal",
            shrink=0.5 if width == "double" else 0.9,
            aspect=35,
            pad=0.03,
        )
        dots = "; dots: none" if (degrees == 0.0).any() else ""
        hatched = "" if np.isfinite(degrees).all() else "; hatched: not computed"
        bar.set_label(f"critical cone (°){dots}{hatched}")
        bar.ax.axvline(PAPERS_CONE, color=style.INK, linewidth=0.9)
        return figure


def _trend(values: Array, axis: int) -> str:
    """Describe the overall change of values along an axis."""
    steps = np.diff(values, axis=axis)
    total = float(steps[np.isfinite(steps)].sum())
    return "grows" if total > 0.0 else "shrinks" if total < 0.0 else "does not change"


def _cone_map(
    axes: Axes, cone: xr.DataArray, degrees: Array, norm: Normalize, colours: Any
) -> None:
    """Draw a heat map with contours; whiskers without a result are hatched."""
    x = np.asarray(cone["curvature"].values, dtype=np.float64)
    y = np.asarray(cone["taper_ratio"].values, dtype=np.float64)
    across, up = _edges(x), np.exp(_edges(np.log(y)))
    axes.set(yscale="log", xlim=across[[0, -1]], ylim=up[[0, -1]], facecolor="white")
    axes.patch.set(hatch="//////", edgecolor="#b5b5b5", linewidth=0.0)
    axes.pcolormesh(across, up, degrees, norm=norm, cmap=colours, rasterized=True)
    known = np.isfinite(degrees)
    if known.any() and min(degrees.shape) > 1:
        _contours(axes, x, y, degrees, norm.vmax or 0.0)
    ticks = [t for t in (1, 2, 3, 5, 10, 15, 20, 30, 60) if up[0] <= t <= up[-1]]
    few = [t for t in ticks if t in (1, 2, 5, 15, 30, 60)]
    axes.set_yticks(few, labels=[f"{t}" for t in few])
    axes.minorticks_off()
    none = known & (degrees == 0.0)
    where = np.argwhere(none)
    # A dot: no two contacts have the same signals at all.
    axes.plot(x[where[:, 1]], y[where[:, 0]], ".", color=style.MUTED, markersize=1.5)


def _contours(axes: Axes, x: Array, y: Array, degrees: Array, high: float) -> None:
    levels = [level for level in (PAPERS_CONE, 5.0, 10.0, 20.0, 40.0, 80.0) if level < high]
    levels = [level for level in levels if np.nanmin(degrees) < level < np.nanmax(degrees)]
    if not levels:
        return
    widths = [1.1 if level == PAPERS_CONE else 0.5 for level in levels]
    # The cones of straight whiskers and of cylinders are far above those of their neighbours: a
    # triplet loses a dimension abruptly there, and contours are not drawn.
    exceptional = np.zeros(degrees.shape, dtype=bool)
    for grid, marks in ((degrees, exceptional), (degrees.T, exceptional.T)):
        rise = np.diff(grid, axis=0)
        marks[1:] |= rise > _JUMP
        marks[:-1] |= -rise > _JUMP
    shown = np.ma.masked_array(degrees, ~np.isfinite(degrees) | exceptional)
    lines = axes.contour(x, y, shown, levels=levels, colors=style.INK, linewidths=widths)
    axes.clabel(lines, fmt=lambda value: f"{value:g}°", fontsize=style.SMALL, inline_spacing=5)


def _edges(centres: Array) -> Array:
    """Edges of cells around given centres."""
    if centres.size == 1:
        return np.asarray(centres[0] + np.array([-0.5, 0.5]))
    between = 0.5 * (centres[1:] + centres[:-1])
    first, last = 2.0 * centres[0] - between[0], 2.0 * centres[-1] - between[-1]
    return np.concatenate([[first], between, [last]])
