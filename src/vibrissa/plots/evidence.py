"""How well triplets of signals tell contacts apart: by tolerance, and by the whisker's shape."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from vibrissa.plots.colours import sequential
from vibrissa.plots.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    Array,
    Width,
    head,
    looking,
    new_figure,
    plain,
)
from vibrissa.plots.verdicts import triplet_label
from vibrissa.quantities import to_display

HIGHLIGHTED = ("Fx MB MD", "Mx MB MD", "Fx FD MD")
"""The three triplets that the paper finds unique for its γ whisker."""

_LINES: tuple[tuple[str, Any, str], ...] = (
    (BLUE, "-", "o"),
    (ORANGE, "--", "s"),
    (GREEN, ":", "^"),
)
_PAPERS_CONE = 2.0
"""Degrees that the paper leaves out about rest."""
_JUMP = 25.0
"""Degrees by which neighbours in a map of critical cones differ at most if it is continuous."""


def resolution(verdicts: xr.Dataset, *, width: Width = "double") -> Figure:
    """Draw how many contacts another one resembles, against the signals' tolerance.

    A panel for each region. The paper's three triplets stand out by colour, dashes and markers; the
    others are pale.

    Parameters
    ----------
    verdicts : Dataset
        As of ``vibrissa.uniqueness``: ``ambiguous_share`` over (triplet, region,
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
    with looking():
        figure = new_figure(width, 38.0 * down + 10.0, "constrained")
        grid = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False)
        for i, axes in enumerate(grid.ravel()):
            if i >= share.sizes["region"]:
                axes.set_axis_off()
                continue
            _shares(axes, share.isel(region=i))
            head(axes, "abcdefghijkl"[i], str(share["region"].values[i]))
        for axes in grid[:, 0]:
            axes.set_ylabel("ambiguous contacts (%)")
        for axes in grid[-1]:
            axes.set_xlabel("tolerance (of range)")
        _resolution_key(figure, share)
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


def critical_cones(cones: xr.Dataset, *, width: Width = "double") -> Figure:
    """Draw outside which cone about rest contacts are told apart, by curvature and taper.

    Parameters
    ----------
    cones : Dataset
        ``critical_cone`` over (triplet, taper_ratio, curvature), rad: the smallest cone about the
        resting whisker outside which no two contacts feel the same, zero where there are none at
        all, NaN where it was not computed. ``taper_ratio`` is the radius at the base over that at
        the tip, ``curvature`` the coefficient of y = A x² times the length, A·L.
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
    norm, colours = Normalize(0.0, high), sequential().reversed()
    count = cone.sizes["triplet"]
    with looking():
        shape = (1, count) if width == "double" else (count, 1)
        tall = 62.0 if width == "double" else 46.0 * count + 14.0
        figure = new_figure(width, tall, "constrained")
        grid = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
        for i, axes in enumerate(grid.ravel()):
            _cone_map(axes, cone.isel(triplet=i), degrees[i], norm, colours)
            head(axes, "abcdefghijkl"[i], triplet_label(str(cone["triplet"].values[i])))
        for axes in grid[:, 0]:
            axes.set_ylabel("base / tip radius")
        for axes in grid[-1]:
            axes.set_xlabel(r"curvature $A \cdot L$")
        bar = figure.colorbar(
            ScalarMappable(norm, colours),
            ax=list(grid.ravel()),
            orientation="horizontal",
            shrink=0.5 if width == "double" else 0.9,
            aspect=35,
            pad=0.03,
        )
        plain(bar)
        bar.set_label(_cone_label(degrees))
        bar.ax.axvline(_PAPERS_CONE, color=INK, linewidth=0.9)
        return figure


def _cone_map(
    axes: Axes, cone: xr.DataArray, degrees: Array, norm: Normalize, colours: Any
) -> None:
    """Heat map with contours; what was not computed is hatched."""
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
    # A dot says that no two contacts feel the same at all.
    axes.plot(x[where[:, 1]], y[where[:, 0]], ".", color=MUTED, markersize=1.5)


def _contours(axes: Axes, x: Array, y: Array, degrees: Array, high: float) -> None:
    levels = [level for level in (_PAPERS_CONE, 5.0, 10.0, 20.0, 40.0, 80.0) if level < high]
    levels = [level for level in levels if np.nanmin(degrees) < level < np.nanmax(degrees)]
    if not levels:
        return
    widths = [1.1 if level == _PAPERS_CONE else 0.5 for level in levels]
    shown = np.ma.masked_array(degrees, ~np.isfinite(degrees) | _exceptional(degrees))
    lines = axes.contour(x, y, shown, levels=levels, colors=INK, linewidths=widths)
    axes.clabel(lines, fmt=lambda value: f"{value:g}°", fontsize=5.5, inline_spacing=2)


def _exceptional(degrees: Array) -> NDArray[np.bool_]:
    """Which whiskers stand far above a neighbour, as straight ones and cylinders do.

    There a triplet loses a dimension; nothing leads gradually up to them, so contours keep off.
    """
    out = np.zeros(degrees.shape, dtype=bool)
    for grid, marks in ((degrees, out), (degrees.T, out.T)):
        rise = np.diff(grid, axis=0)
        marks[1:] |= rise > _JUMP
        marks[:-1] |= -rise > _JUMP
    return out


def _cone_label(degrees: Array) -> str:
    label = "critical cone (°)"
    if (degrees == 0.0).any():
        label += "; dots: none"
    return label if np.isfinite(degrees).all() else f"{label}; hatched: not computed"


def _edges(centres: Array) -> Array:
    """Edges of cells around given places."""
    if centres.size == 1:
        return np.asarray(centres[0] + np.array([-0.5, 0.5]))
    between = 0.5 * (centres[1:] + centres[:-1])
    first, last = 2.0 * centres[0] - between[0], 2.0 * centres[-1] - between[-1]
    return np.concatenate([[first], between, [last]])
