"""Two contacts that a whisker cannot tell apart by three signals, side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vibrissa.plots.chart import DIRECTIONS, SIGNALS
from vibrissa.plots.style import (
    BLUE,
    INK,
    MUTED,
    ORANGE,
    SHADE,
    Array,
    Width,
    looking,
    new_figure,
    page_width,
)
from vibrissa.plots.verdicts import triplet_label
from vibrissa.quantities import axis_label, quantity, to_display

_COLOURS = (BLUE, ORANGE)
_DASHES = ("-", (0, (5, 1.5)))
_NAMES = ("A", "B")
_ARROW = 0.22
"""Length of the longer force's arrow, as a share of the whisker's extent."""

_CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}

_NARROWEST = 0.11
"""Smallest half of an axis, as a share of the whisker's extent."""

_TABLE = 70.0
"""Room of the table beside the views, mm; its height is as large where it lies below."""


def witness_pair(witness: xr.Dataset, *, width: Width = "double") -> Figure:
    """Draw two bent whiskers that feel the same by three signals, and list all six.

    Parameters
    ----------
    witness : Dataset
        In the whisker frame, SI units: ``rest`` (node, space) and ``centerline`` (pair, node,
        space), m; ``contact_point`` (pair, space), m; ``force`` (pair, space), N; ``arc_length``
        (pair), m; the six signals ``Fx`` … ``MD`` (pair). The attribute ``triplet`` names the three
        that are the same, such as ``"Fx MB MD"``.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        From above (x–y), from the side (x–z) and a table.

    Raises
    ------
    ValueError
        If something is missing or not finite, or if there are not two contacts.
    """
    triplet = _check(witness)
    extent = float(np.ptp(to_display("centerline", witness["rest"].values), axis=0).max())
    limits = _limits(witness, extent)
    span = np.ptp(limits, axis=1)
    page = page_width(width)
    beside = width == "double"
    left, gap, bottom, top = 12.0, 3.0, 9.0, 6.0
    room = page - left - 2.0 - (_TABLE + 6.0 if beside else 0.0)
    scale = min(room / span[0], 70.0 / (span[1] + span[2]))
    views = bottom + gap + top + scale * (span[1] + span[2])
    height = max(views, 60.0) if beside else views + 52.0
    shift = height - views
    with looking():
        figure = new_figure(width, height, None)

        def place(low: float, j: int) -> Axes:
            box = (left / page, low / height, scale * span[0] / page, scale * span[j] / height)
            axes = figure.add_axes(box, xlim=limits[0], ylim=limits[j])
            _draw(axes, witness, j, extent)
            axes.set_ylabel(axis_label("xyz"[j]))
            few = max(3, round(scale * span[j] / 10.0))
            axes.yaxis.set_major_locator(MaxNLocator(few, integer=True))
            return axes

        side = place(shift + bottom, 2)
        above = place(shift + bottom + scale * span[2] + gap, 1)
        above.tick_params(labelbottom=False)
        side.set_xlabel(axis_label("x"))
        title = f"the same {triplet_label(' '.join(triplet))}"
        figure.text(left / page, 1.0 - 4.0 / height, title, fontsize=7.0)
        start = left + scale * span[0] + 8.0 if beside else 3.0
        box = (
            start / page,
            (height - 58.0) / height if beside else 0.0,
            (page - start - 1.5) / page,
            (57.0 if beside else 50.0) / height,
        )
        _table(figure, box, witness, triplet)
        return figure


def _check(witness: xr.Dataset) -> tuple[str, ...]:
    needed = ("rest", "centerline", "contact_point", "force", "arc_length", *SIGNALS)
    missing = [name for name in needed if name not in witness]
    if missing:
        raise ValueError(f"the witness lacks {', '.join(missing)}")
    if witness.sizes.get("pair") != 2:
        raise ValueError(f"a witness is a pair of contacts; got {witness.sizes.get('pair', 0)}")
    lacking = [name for name in needed if not np.isfinite(witness[name].values).all()]
    if lacking:
        raise ValueError(f"the witness has missing values in {', '.join(lacking)}")
    triplet = tuple(str(witness.attrs.get("triplet", "")).split())
    if len(triplet) < 1 or not set(triplet) <= set(SIGNALS):
        raise ValueError(
            f"the witness's triplet is {witness.attrs.get('triplet')!r}; names of signals are "
            f"needed, of {', '.join(SIGNALS)}"
        )
    return triplet


def _sizes(witness: xr.Dataset) -> Array:
    """Sizes of the two forces, N."""
    force = witness["force"].transpose("pair", "space").values
    return np.asarray(np.linalg.norm(force, axis=1))


def _arrows(witness: xr.Dataset, extent: float) -> Array:
    """Forces (pair, space) as lengths in mm."""
    force = witness["force"].transpose("pair", "space").values
    return np.asarray(_ARROW * extent * force / _sizes(witness).max())


def _limits(witness: xr.Dataset, extent: float) -> Array:
    """Limits (3, 2) that hold whiskers and arrows."""
    lines = to_display("centerline", witness["centerline"].transpose(..., "space").values)
    rest = to_display("centerline", witness["rest"].transpose(..., "space").values)
    points = to_display("contact_point", witness["contact_point"].transpose(..., "space").values)
    ends = points - 1.3 * _arrows(witness, extent)  # with the letters at their tails
    everything = np.concatenate([lines.reshape(-1, 3), rest, points, ends])
    low, high = everything.min(axis=0), everything.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) + 0.03 * extent
    half = np.maximum(half, _NARROWEST * extent)
    return np.stack([middle - half, middle + half], axis=1)


def _draw(axes: Axes, witness: xr.Dataset, j: int, extent: float) -> None:
    """The resting and the two bent whiskers, seen along y or z."""
    rest = to_display("centerline", witness["rest"].transpose("node", "space").values)
    axes.plot(rest[:, 0], rest[:, j], color="#c4c4c4", linewidth=1.6, solid_capstyle="round")
    arrows = _arrows(witness, extent)
    for i, (colour, dashes, name) in enumerate(zip(_COLOURS, _DASHES, _NAMES, strict=True)):
        one = witness.isel(pair=i)
        line = to_display("centerline", one["centerline"].transpose("node", "space").values)
        point = to_display("contact_point", one["contact_point"].values)
        axes.plot(line[:, 0], line[:, j], color=colour, linestyle=dashes, linewidth=1.2)
        start = point - arrows[i]
        axes.annotate(
            "",
            (point[0], point[j]),
            (start[0], start[j]),
            arrowprops={
                "arrowstyle": "-|>,head_width=0.16,head_length=0.35",
                "color": colour,
                "linewidth": 1.1,
                "shrinkA": 0.0,
                "shrinkB": 0.0,
            },
        )
        axes.plot(point[0], point[j], "o", color=colour, markersize=2.6, zorder=5)
        if j == 1:
            tail = start - 0.2 * arrows[i]
            axes.text(tail[0], tail[1], name, color=colour, fontweight="bold", **_CENTRED)


def _table(
    figure: Figure,
    box: tuple[float, float, float, float],
    witness: xr.Dataset,
    triplet: tuple[str, ...],
) -> None:
    """Signals and contacts of both, what is the same shaded."""
    axes = figure.add_axes(box, xlim=(0.0, 1.0), ylim=(13.2, -0.6))
    axes.set_axis_off()
    look: dict[str, Any] = {"va": "center_baseline", "fontsize": 6.5}
    for x, name, colour in zip((0.62, 0.97), _NAMES, _COLOURS, strict=True):
        axes.text(x, 0.0, name, color=colour, fontweight="bold", ha="right", **look)
    axes.axhline(0.6, color=INK, linewidth=0.5)
    rows: list[tuple[str, Array]] = [(name, witness[name].values) for name in SIGNALS]
    rows += [("arc_length", witness["arc_length"].values)]
    rows += [("force", _sizes(witness))]
    for i, (name, values) in enumerate(rows):
        y = i + 1.2 + (0.3 if i >= len(SIGNALS) else 0.0)
        same = name in triplet
        if same:
            axes.fill_between([0.0, 1.0], y - 0.5, y + 0.5, color=SHADE, linewidth=0.0)
        symbol = "$|\\mathbf{F}|$" if name == "force" else f"${_symbol(name)}$"
        axes.text(0.02, y, f"{symbol}  ({quantity(name).display_unit})", **look)
        for x, value in zip((0.62, 0.97), to_display(name, values), strict=True):
            text = _number(float(value), 7 if same else 4)
            axes.text(x, y, text, ha="right", color=INK if same else MUTED, **look)
    axes.axhline(9.2, color=INK, linewidth=0.5)
    for line, text in enumerate(_sentences(witness, triplet)):
        axes.text(0.02, 10.0 + line, text, **(look | {"fontsize": 6.0}))


def _symbol(name: str) -> str:
    return "s_c" if name == "arc_length" else quantity(name).symbol


def _number(value: float, digits: int) -> str:
    return f"{value:#.{digits}g}".rstrip(".").replace("-", "−")


def _sentences(witness: xr.Dataset, triplet: tuple[str, ...]) -> list[str]:
    """How equal the signals are, and how far apart the contacts."""
    apart = float(np.linalg.norm(np.diff(witness["contact_point"].values, axis=0)))
    step = np.diff(witness["rest"].transpose("node", "space").values, axis=0)
    length = float(np.linalg.norm(step, axis=1).sum())
    return [
        f"the shaded signals differ by {_power(_difference(witness, triplet))} of their size",
        f"the contacts lie {1e3 * apart:.2f} mm = {apart / length:.3f} $L$ apart",
        "arrows: force on the whisker; grey: at rest",
    ]


def _power(value: float) -> str:
    if value == 0.0:
        return "0"
    digits, power = f"{value:.0e}".split("e")
    return rf"${digits} \cdot 10^{{{int(power)}}}$"


def _difference(witness: xr.Dataset, triplet: tuple[str, ...]) -> float:
    """Largest relative difference of the signals that are the same; of directions, in rad."""
    worst = 0.0
    for name in triplet:
        one, other = (float(v) for v in witness[name].values)
        if name in DIRECTIONS:
            gap = abs(np.angle(np.exp(1j * (one - other))))
        else:
            gap = abs(one - other) / max(abs(one), abs(other), 1e-300)
        worst = max(worst, float(gap))
    return worst
