"""The solid that the contacts fill in the space of three signals (the paper's S1 Fig. C).

One signal is held: on the plane of the other two, lines of equal r, θ and φ of the contact, and the
error of a look-up table. Next to it the whole solid, coloured by that error: the third signal,
such as the axial force, upward, the moment as components M_B cos M_D, M_B sin M_D.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator

from vibrissa.numerics import Array
from vibrissa.plots import style
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import robust_limits

_PANELS = ("r", "theta", "phi", "error_distance")
_CIRCLES = {"MD": ("MB", "My", "Mz"), "FD": ("FT", "Fy", "Fz")}
"""Directions, the size that belongs to each, and the components that both make."""

_STEPS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Errors, mm, that have a tick."""

_MOST = 12_000
_NOTHING = 0.1
"""Angles below this, degrees, are not worth lines: a planar whisker stays in its plane."""


def solid_slices(
    plane: xr.Dataset, solid: xr.Dataset | None = None, *, width: style.Width = "double"
) -> Figure:
    """Draw a slice through the solid of contacts in the space of three signals, and the solid.

    Parameters
    ----------
    plane : Dataset
        Result of ``vibrissa.paper.signal_slice``: ``r``, ``theta``, ``phi`` and, if known,
        ``error_distance`` over two signals, SI units; NaN outside the solid.
    solid : Dataset, optional
        Contacts with the three signals and ``error_distance``, such as the nodes of a map; with
        ``small_deflection`` if those are to be left out.
    width : {"single", "double"}
        Width in columns of a page.

    Returns
    -------
    Figure
        A panel for each of r, θ, φ and the error, in mm and degrees, and the solid; or the sentence
        "no contacts".

    Raises
    ------
    ValueError
        If something is missing, or the triplet has no direction to wind the solid about.
    """
    missing = [name for name in ("r", "theta", "phi") if name not in plane]
    if missing or plane["r"].ndim != 2:
        raise ValueError(f"the slice lacks {', '.join(missing) or 'its two dimensions'}")
    names = [n for n in _PANELS if n in plane and np.isfinite(plane[n].values).any()]
    with style.looking():
        shape = (1, 3) if solid is None and width == "double" and len(names) == 3 else (2, 2)
        tall = 90.0 if shape == (2, 2) else 55.0
        if solid is not None:
            tall = 98.0 if width == "double" else 158.0
        figure = style.new_figure(width, tall, "constrained")
        if not names:
            style.say(figure, "no contacts")
            return figure
        if solid is None:
            _slices(figure, plane, names, "abcd", shape)
            return figure
        if width == "double":
            parts = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.0, 1.35])
        else:
            parts = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.15])
        finding = _solid(parts.flat[0], solid, plane)
        _slices(parts.flat[1], plane, names, "bcde")
        style.conclude(figure, finding)
        return figure


def _slices(
    figure: Figure | SubFigure,
    plane: xr.Dataset,
    names: list[str],
    letters: str,
    shape: tuple[int, int] = (2, 2),
) -> None:
    grid = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    panels = grid.ravel()
    # The dimension that is a size lies on the vertical axis, that with both signs on the other.
    dims = sorted(map(str, plane["r"].dims), key=lambda n: n in ("FT", "MB"))
    x, y = (to_display(n, plane[n].to_numpy()) for n in dims)
    # Before anything is drawn, as labels of lines are fitted to the axes as they are.
    known = np.isfinite(plane["r"].transpose(*dims).to_numpy())
    for i, (axis, values) in enumerate(zip("xy", (x, y), strict=True)):
        there = values[known.any(axis=1 - i)]
        style.scale_near_zero(
            panels[0], axis, np.array([there.min(), there.max()]), _width(plane, dims[i])
        )
    for axes, name, letter in zip(panels, names, letters, strict=False):
        values = to_display(name, plane[name].transpose(*dims[::-1]).to_numpy())
        _lines(axes, x, y, values, name)
        style.head(axes, letter, _title(name))
    if "small_deflection" in plane:
        near = plane["small_deflection"].transpose(*dims[::-1]).to_numpy()
        for axes in panels[: len(names)]:
            shade = np.where(near, 1.0, np.nan)
            axes.pcolormesh(x, y, shade, cmap="gray", vmin=0.0, vmax=1.6, rasterized=True)
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    for axes in grid[-1]:
        axes.set_xlabel(axis_label(dims[0]))
    for axes in grid[:, 0]:
        axes.set_ylabel(axis_label(dims[1]))


def _width(plane: xr.Dataset, name: str) -> float | None:
    width = plane[name].attrs.get("linear_width")
    return None if width is None else float(to_display(name, width))


def _title(name: str) -> str:
    q = quantity(name)
    return f"{q.long_name} ({q.display_unit})"


def _lines(axes: Axes, x: Array, y: Array, values: Array, name: str) -> None:
    """Values in colour, with labelled lines where they are equal."""
    error = name == "error_distance"
    low, high = robust_limits(values, 0.96)
    if not error and max(abs(low), abs(high)) < _NOTHING and quantity(name).display_unit == "°":
        axes.pcolormesh(
            x, y, np.where(np.isfinite(values), 0.0, np.nan), cmap="gray", vmin=-9, vmax=2
        )
        words = f"within {np.nanmax(np.abs(values)):.1g}° of zero"
        axes.text(0.5, 0.9, words, transform=axes.transAxes, ha="center", color=style.MUTED)
        return
    signed = not error and min(-low, high) > 0.1 * max(-low, high)
    if signed:
        low, high = -max(-low, high), max(-low, high)
    norm = LogNorm(*_decades(values)) if error else Normalize(low, high)
    look: dict[str, Any] = {
        "cmap": style.diverging() if signed else style.sequential(),
        "norm": norm,
    }
    mesh = axes.pcolormesh(x, y, values, rasterized=True, **look)
    if error:
        _error_bar(_rail(axes, mesh))
        return
    steps = MaxNLocator(5).tick_values(low, high)
    steps = steps[(steps >= low) & (steps <= high)]
    axes.contour(x, y, values, steps, colors=style.INK, linewidths=0.5, linestyles="solid")
    bar = _rail(axes, mesh)
    bar.set_ticks(steps, labels=[f"{step:g}".replace("-", "−") for step in steps])
    # The lines in the panel are at the ticks.
    bar.ax.vlines(
        steps, 0.0, 1.0, colors=style.INK, linewidths=0.5, transform=bar.ax.get_xaxis_transform()
    )


def _rail(axes: Axes, mesh: Any) -> Colorbar:
    """A colour bar in the upper right corner of a panel, which the solid leaves empty."""
    rail = axes.inset_axes((0.38, 0.93, 0.58, 0.035))
    bar: Colorbar = axes.figure.colorbar(mesh, cax=rail, orientation="horizontal", extend="both")
    style.plain(bar)
    bar.ax.tick_params(length=2.0, pad=1.5)
    bar.minorticks_off()
    return bar


def _decades(values: Array) -> tuple[float, float]:
    """Limits of a logarithmic scale of errors, at most two decades."""
    high = float(robust_limits(values, 0.96)[1]) or 1.0
    low = float(robust_limits(values, 0.9)[0])
    return max(low, 0.01 * high), high


def _solid(figure: Figure | SubFigure, solid: xr.Dataset, plane: xr.Dataset) -> str:
    """Draw the solid, and state what its errors are."""
    names = str(plane.attrs.get("triplet", "Fx MB MD")).split()
    turn = next((n for n in names if n in _CIRCLES and _CIRCLES[n][0] in names), None)
    if turn is None:
        raise ValueError(f"a solid needs a direction and its size; the triplet is {names}")
    size, across, along = _CIRCLES[turn]
    upward = next(n for n in names if n not in (turn, size))
    lacking = [n for n in (*names, "error_distance") if n not in solid]
    if lacking:
        raise ValueError(f"the solid lacks {', '.join(lacking)}")
    dims = solid[size].dims
    rows = {n: solid[n].transpose(*dims).to_numpy().ravel() for n in (*names, "error_distance")}
    kept = np.isfinite(np.stack(list(rows.values()))).all(axis=0)
    if "small_deflection" in solid:
        kept &= ~solid["small_deflection"].transpose(*dims).to_numpy().ravel().astype(bool)
    first = to_display(across, rows[size] * np.cos(rows[turn]))
    second = to_display(along, rows[size] * np.sin(rows[turn]))
    third, error = (
        to_display(upward, rows[upward]),
        to_display("error_distance", rows["error_distance"]),
    )
    every = kept.copy()
    # The half before the plane of the slice is taken away, so that the inside is seen.
    value = float(plane.attrs.get("value", -0.5 * np.pi))
    if plane.attrs.get("fixed", turn) == turn:
        kept &= np.sin(rows[turn] - value) <= 0.02
    shown = np.flatnonzero(kept)
    shown = np.random.default_rng(0).permutation(shown)[:_MOST]
    shown = shown[np.argsort(error[shown], kind="stable")]
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    dots = axes.scatter(
        first[shown],
        second[shown],
        third[shown],
        c=error[shown],
        s=2.5,
        cmap=style.sequential(),
        norm=LogNorm(*_decades(error[shown])),
        linewidths=0.0,
        depthshade=False,
        rasterized=True,
    )
    _frame(axes, (across, along, upward))
    bar = figure.colorbar(
        dots, ax=axes, orientation="horizontal", extend="both", shrink=0.7, aspect=28, pad=0.08
    )
    _error_bar(bar)
    bar.ax.set_xlabel(axis_label("error_distance"))
    figure.text(0.02, 0.98, "a", fontsize=style.LARGE, fontweight="bold", va="top")
    figure.text(0.07, 0.98, "look-up table's error, cut at the slice", va="top")
    middle, wide = np.median(error[every]), np.quantile(error[every], 0.95)
    return f"The look-up table's error is {middle:.2g} mm in the median, {wide:.2g} mm at 95 %"


def _error_bar(bar: Colorbar) -> None:
    style.plain(bar)
    low, high = bar.mappable.get_clim()
    ticks = [t for t in _STEPS if (low or 0.0) <= t <= (high or np.inf)]
    bar.set_ticks(ticks, labels=[f"{t:g}" for t in ticks])
    bar.minorticks_off()
    bar.ax.tick_params(length=2.0, pad=1.5)


def _frame(axes: Any, names: tuple[str, str, str]) -> None:
    axes.patch.set_visible(False)
    axes.view_init(16.0, -25.0)
    axes.set_box_aspect((1.0, 1.0, 1.1), zoom=1.1)
    for name, letter, pad in zip(names, "xyz", (-8.0, -8.0, -1.0), strict=True):
        axis = getattr(axes, f"{letter}axis")
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set(color=style.MUTED, linewidth=0.5)
        axis._axinfo["grid"].update(color="#e2e2e2", linewidth=0.4)
        axis.set_label_text(axis_label(name))
        axis.labelpad = pad
    axes.tick_params(pad=-3.0)
    axes.tick_params(axis="z", pad=0.0)
    axes.locator_params(nbins=4)
