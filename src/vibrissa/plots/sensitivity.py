"""Figure of the nine derivatives of the contact point over the signals (the paper's Fig. 5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from vibrissa.numerics import Array, Mask, small_over_large, weighted_quantile
from vibrissa.plots import style
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import COORDINATES, DIRECTIONS, robust_limits

STATIONS = 25
SHARE = 0.99
_PAPER = ("MD", "MB", "Fx")
# Quantiles that are drawn, which of them is the median, and which bound the two bands.
_SHARES = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
_MEDIAN = 2
_BANDS = ((0, 4), (1, 3))
_HEIGHTS = {"single": 104.0, "double": 125.0}
# Signals that reach so many times their lowest tenth get an axis that is wider near zero.
_SKEWED = 30.0
_LEAST = 0.01  # share of the contacts of a side that a station needs for its median to be drawn
# Half width of a window, in distances of stations. Signals of the paper's grid are bunched, as its
# radii are 2 mm apart: medians of narrower windows would zigzag.
_HALF = 2.0


@dataclass(frozen=True, eq=False)
class _Contacts:
    """Contacts outside the cone around rest, as rows in display units."""

    signals: dict[str, Array]
    derivatives: dict[tuple[str, str], Array]
    weight: Array
    backward: Mask
    in_grid: bool  # they are those of the paper's grid


def derivative_label(coordinate: str, signal: str) -> str:
    r"""Label the axis of a derivative."""
    above, below = quantity(coordinate), quantity(signal)
    unit = f"{above.display_unit} per {below.display_unit}"
    return rf"$\partial {above.symbol}/\partial {below.symbol}$ ({unit})"


def sensitivity_panels(data: xr.Dataset, *, width: style.Width = "double") -> Figure:
    """Draw the derivatives of r, θ and φ with respect to three signals, over these signals.

    The nine panels have a row per coordinate and a column per signal. Each shows the derivative
    over the signal, for concave forward and concave backward contacts (weighted by the volume that
    they represent, if known): running medians, and bands that contain 50 % and 80 % of the
    contacts, in windows whose weights decrease from the middle to the ends. Axes include the
    central 99 % of the signals; contacts within 2° of rest are left out. The axis of a signal with
    most values near zero is linear there and logarithmic beyond.

    Parameters
    ----------
    data : Dataset
        Result of ``vibrissa.sensitivity``, SI units; ``at="grid"`` fills the panels best.
    width : {"single", "double"}
        Width in columns of a page.

    Returns
    -------
    Figure
        Panels of derivatives in mm and degrees by µN, µN·m and degrees; or the sentence "no
        contacts".

    Raises
    ------
    ValueError
        If the dataset lacks the derivatives, the signals or the regions.
    """
    contacts = _contacts(data)
    names = list(contacts.signals)
    with style.looking():
        figure = style.new_figure(width, _HEIGHTS.get(width, 0.0), "constrained")
        if not contacts.weight.any():
            style.say(figure, "no contacts")
            return figure
        panels = figure.subplots(3, 3, sharex="col", squeeze=False)
        for i, coordinate in enumerate(COORDINATES):
            for j, name in enumerate(names):
                axes = panels[i, j]
                _panel(axes, contacts, coordinate, name, small=width == "single")
                letter = "abcdefghi"[3 * i + j]
                axes.set_title(letter, loc="left", fontsize=style.LARGE, fontweight="bold", pad=2.0)
                if i == 2:
                    axes.set_xlabel(axis_label(name))
        labels = (("concave forward", style.BLUE), ("concave backward", style.ORANGE))
        figure.legend(
            handles=[
                *(
                    Line2D([], [], color=_darker(c), label=f"{words}, median")
                    for words, c in labels
                ),
                Patch(color=style.MUTED, alpha=0.6, linewidth=0.0, label="50 % of contacts"),
                Patch(color=style.MUTED, alpha=0.25, linewidth=0.0, label="80 %"),
            ],
            loc="outside upper center",
            ncols=4 if width == "double" else 2,
            borderpad=0.0,
        )
        if finding := _finding(contacts):
            style.conclude(figure, finding)
        return figure


def _finding(contacts: _Contacts) -> str:
    """Describe the ratios of slopes where signals are small and where they are large."""
    parts = []
    for name in (n for n in contacts.signals if n not in DIRECTIONS):
        slopes = np.abs(contacts.derivatives["r", name])
        ratio = small_over_large(slopes, contacts.signals[name], contacts.weight)
        if 0.0 < ratio < np.inf:
            symbol = rf"$\partial r/\partial {quantity(name).symbol}$"
            parts.append(f"{ratio:.0f} times ({symbol})")
    if not parts:
        return ""
    where = " in the paper's grid" if contacts.in_grid else ""
    return f"Noise moves light contacts{where} {' and '.join(parts)} as far as strong ones"


def _contacts(data: xr.Dataset) -> _Contacts:
    if "sensitivity" not in data or "signal" not in data.coords:
        raise ValueError("the data lack sensitivity: make them with vibrissa.sensitivity")
    names = [str(name) for name in data["signal"].values]
    missing = [
        n for n in (*names, "small_deflection", "concave_backward") if n not in data.data_vars
    ]
    if missing:
        raise ValueError(f"the data lack {', '.join(missing)}")
    if set(names) == set(_PAPER):
        names = list(_PAPER)
    dims = data[names[0]].dims
    weight = data["volume"] if "volume" in data else xr.ones_like(data[names[0]])
    jacobian = data["sensitivity"].transpose(*dims, "coordinate", "signal")
    known = jacobian.notnull().all(("coordinate", "signal"))
    weight = weight.where(known & ~data["small_deflection"], 0.0)

    def row(values: xr.DataArray) -> Array:
        return np.asarray(values.transpose(*dims).to_numpy().ravel())

    derivatives = {
        (c, n): to_display(c, row(jacobian.sel(coordinate=c, signal=n)))
        / quantity(n).display_factor
        for c in COORDINATES
        for n in names
    }
    signals = {n: to_display(n, row(data[n])) for n in names}
    return _Contacts(
        signals,
        derivatives,
        row(weight),
        np.asarray(row(data["concave_backward"]), dtype=bool),
        in_grid=data.attrs.get("at") == "grid",
    )


def _panel(axes: Axes, contacts: _Contacts, coordinate: str, name: str, *, small: bool) -> None:
    kept = contacts.weight > 0.0
    x, y = contacts.signals[name][kept], contacts.derivatives[coordinate, name][kept]
    weight, backward = contacts.weight[kept], contacts.backward[kept]
    direction = name in DIRECTIONS
    central = np.array([0.5 - SHARE / 2, 0.5 + SHARE / 2])
    limits = np.array([-180.0, 180.0])
    if not direction:
        limits = robust_limits(weighted_quantile(x, weight, central), 1.0)  # never equal
    bend = _bend(x, weight, direction)
    axes.axhline(0.0, color=style.MUTED, linewidth=0.5, zorder=0)
    on_axis, of_axis = _scales(bend)
    low, high = on_axis(limits).tolist()
    edges = np.linspace(low, high, STATIONS + 1)
    bands = []
    for side, colour in ((~backward, style.BLUE), (backward, style.ORANGE)):
        middle, curves = _spread(on_axis(x[side]), y[side], weight[side], edges)
        middle = of_axis(middle)
        bands.append(curves)
        for (low, high), opacity in zip(_BANDS, (0.15, 0.3), strict=True):
            axes.fill_between(
                middle, curves[low], curves[high], color=colour, alpha=opacity, linewidth=0.0
            )
        axes.plot(middle, curves[_MEDIAN], color=_darker(colour), linewidth=1.0)
    heights = robust_limits(np.concatenate(bands, axis=1), 1.0)
    style.scale_near_zero(axes, "x", limits, bend)
    axes.set_ylim(*heights)
    if direction:
        axes.set_xticks([-180.0, 0.0, 180.0] if small else [-180.0, -90.0, 0.0, 90.0, 180.0])
    elif bend is None:
        axes.xaxis.set_major_locator(MaxNLocator(3 if small else 5))
    axes.yaxis.set_major_locator(MaxNLocator(4 if small else 5))
    axes.set_ylabel(
        derivative_label(coordinate, name), labelpad=1.0, fontsize=6.0 if small else 7.0
    )


def _bend(x: Array, weight: Array, direction: bool) -> float | None:
    """Value above which an axis is logarithmic; None for a linear axis."""
    if direction:
        return None
    low, high = weighted_quantile(np.abs(x), weight, np.array([0.1, SHARE]))
    return float(low) if 0.0 < low * _SKEWED < high else None


def _scales(bend: float | None) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Functions from a signal to its position on the axis, and back."""
    if bend is None:
        return np.asarray, np.asarray
    return (lambda x: np.arcsinh(x / bend)), (lambda at: bend * np.sinh(at))


def _darker(colour: str) -> str:
    red, green, blue = 0.6 * np.array(to_rgb(colour)) + 0.4 * np.array(to_rgb(style.INK))
    return to_hex((red, green, blue))


def _spread(x: Array, y: Array, weight: Array, edges: Array) -> tuple[Array, Array]:
    """Means of x and weighted quantiles of y in windows about stations; NaN at those with few."""
    step = edges[1] - edges[0]
    middle = np.full(edges.size - 1, np.nan)
    curves = np.full((len(_SHARES), edges.size - 1), np.nan)
    for k, station in enumerate(edges[:-1] + 0.5 * step):
        away = np.abs(x - station) / step
        if weight[away < 0.5].sum() > _LEAST * weight.sum():
            near = weight * (1.0 - np.minimum(away / _HALF, 1.0) ** 3) ** 3
            middle[k] = np.average(x, weights=near)
            curves[:, k] = weighted_quantile(y, near, _SHARES)
    return middle, curves
