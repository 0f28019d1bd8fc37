"""Notebook display of results: small pictures, tables with units, progress bars.

A picture is a few lines of SVG, so that displaying a value does not load a plotting library: the
whisker's x–y and x–z planes at one scale, with a scale bar of round length. Figures are in
`vibrissa.plots`.
"""

from __future__ import annotations

import importlib
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.quantities import quantity, shown_unit

if TYPE_CHECKING:
    from rich.console import Console

Array = NDArray[np.float64]
_Kind = TypeVar("_Kind", bound=np.generic)

REST = "#8a8a8a"
BENT = "#0072b2"
CONTACT = "#d55e00"

MOST_CURVES = 40
MOST_POINTS = 800

# Width of a panel, its margin, and the gap between panels, pixels; least height over width.
_PANEL, _MARGIN, _GAP = 260.0, 14.0, 18.0
_LEAST = 0.25
_STYLE = "border-collapse:collapse;font-size:90%"
_CELL = "text-align:left;padding:1px 10px 1px 0;vertical-align:top"
_NAME = ";white-space:nowrap"


@dataclass(frozen=True)
class Mark:
    """Curves or points of one colour."""

    places: ArrayLike  # (..., n, 3), m, in any common frame; NaN is ignored
    colour: str  # CSS colour
    dots: bool = False
    width: float = 1.5  # width of lines or diameter of dots, pixels
    label: str = ""


def views(marks: Sequence[Mark]) -> str:
    """Draw marks, from back to front, in the x–y and x–z planes; empty if all are NaN."""
    every = np.concatenate([np.asarray(mark.places, dtype=float).reshape(-1, 3) for mark in marks])
    every = every[np.isfinite(every).all(axis=1)]
    if not len(every):
        return ""
    low, high = every.min(axis=0), every.max(axis=0)
    extent = float((high - low).max()) or 1.0
    scale = (_PANEL - 2.0 * _MARGIN) / extent
    heights = [max(_LEAST * _PANEL, scale * (high - low)[j] + 2.0 * _MARGIN) for j in (1, 2)]
    height = max(heights)
    parts = []
    for k, j in enumerate((1, 2)):
        left = k * (_PANEL + _GAP)
        middle = 0.5 * (low + high)[[0, j]]
        centre = np.array([left + 0.5 * _PANEL, 0.5 * height])
        for mark in marks:
            flat = np.asarray(mark.places, dtype=float)[..., [0, j]]
            pixels = centre + (flat - middle) * scale * [1.0, -1.0]
            parts.append(_mark_svg(mark, pixels))
        parts.append(_text(left + 2.0, 11.0, f"x–{'xyz'[j]}"))
    # A scale bar of round length, below the left panel.
    length, x, y = round_step(extent / 3.0), _MARGIN, height + 6.0
    line = f'<path d="M{x} {y}h{length * scale:.1f}" stroke="currentColor" stroke-width="2"/>'
    parts += [line, _text(x + length * scale + 5.0, y + 4.0, f"{length * 1e3:g} mm")]
    labels = [
        f'<span style="color:{mark.colour}">{"●" if mark.dots else "━"}</span> {escape(mark.label)}'
        for mark in marks
        if mark.label and np.isfinite(np.asarray(mark.places, dtype=float)).any()
    ]
    legend = f"<br><small>{' &emsp; '.join(labels)}</small>" if labels else ""
    width = 2.0 * _PANEL + _GAP
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height + 16:.0f}" '
        f'viewBox="0 0 {width:.0f} {height + 16:.0f}" role="img" '
        f'style="max-width:100%;height:auto">'
        f"{''.join(parts)}</svg>{legend}"
    )


def _mark_svg(mark: Mark, pixels: Array) -> str:
    """SVG of one mark, at positions (..., n, 2) in pixels."""
    if mark.dots:
        points = pixels.reshape(-1, 2)
        points = thinned(points[np.isfinite(points).all(axis=1)], MOST_POINTS)
        # A line of zero length with round ends is a dot: one element for all of them.
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
        ends = ' stroke-linecap="round"'
    else:
        curves = thinned(pixels.reshape(-1, *pixels.shape[-2:]), MOST_CURVES)
        known = [curve[np.isfinite(curve).all(axis=1)] for curve in curves]
        path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in c) for c in known if len(c))
        ends = ""
    return (
        f'<path d="{path}" fill="none" stroke="{mark.colour}" stroke-width="{mark.width}"{ends}/>'
    )


def thinned(values: NDArray[_Kind], most: int) -> NDArray[_Kind]:
    """Select at most ``most`` rows, evenly spaced, including the first and the last."""
    if len(values) <= most:
        return values
    rows: NDArray[_Kind] = values[np.linspace(0, len(values) - 1, most).astype(int)]
    return rows


def round_step(size: float) -> float:
    """Largest of 1, 2 and 5 times a power of ten that is at most ``size``."""
    size *= 1.0 + 1e-9  # so that a third of 300 mm is a round length despite rounding
    power = 10.0 ** np.floor(np.log10(size))
    return float(max(f for f in (1.0, 2.0, 5.0) if f * power <= size) * power)


def _text(x: float, y: float, text: str) -> str:
    """SVG of a text."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="11" fill="currentColor" '
        f'font-family="sans-serif">{escape(text)}</text>'
    )


def card(title: str, rows: Sequence[tuple[str, str]], picture: str = "") -> str:
    """Return HTML with a title, a picture and a table of names and values."""
    return f"<div><strong>{escape(title)}</strong><br>{picture}{table(rows)}</div>"


def lines(title: str, rows: Sequence[tuple[str, str]]) -> str:
    """Format a title and a table of names and values for a terminal of 80 columns."""
    width = max(len(name) for name, _ in rows) + 4
    filled = [
        textwrap.fill(f"  {name:{width - 4}}  {value}", 80, subsequent_indent=" " * width)
        for name, value in rows
    ]
    return "\n".join([title, *filled])


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table for a terminal, of which later rows may be shorter than the first."""
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    return [
        "  " + "  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=False))
        for row in rows
    ]


def table(rows: Sequence[Sequence[str]], heading: Sequence[str] = ()) -> str:
    """Return an HTML table."""
    head = "".join(f'<th style="{_CELL}">{escape(cell)}</th>' for cell in heading)
    body = "".join(
        "<tr>"
        + "".join(
            f'<td style="{_CELL}{_NAME if i == 0 else ""}">{escape(cell)}</td>'
            for i, cell in enumerate(row)
        )
        + "</tr>"
        for row in rows
    )
    head = f"<tr>{head}</tr>" if head else ""
    return f'<table style="{_STYLE}">{head}{body}</table>'


def shown(name: str, values: ArrayLike) -> str:
    """Format a quantity: the single value, or the median and the range of several."""
    known = np.asarray(values, dtype=np.float64).reshape(-1)
    known = known[np.isfinite(known)]
    if not known.size:
        return "–"
    factor, unit = shown_unit(name, known)
    known = known * factor
    rounding = 1e-6 if unit == "°" else 1e-9 * abs(known).max()
    known = np.where(abs(known) < rounding, 0.0, known)
    middle = f"{np.median(known):.4g}{'' if unit in ('', '°') else ' '}{unit}"
    least, largest = f"{known.min():.4g}", f"{known.max():.4g}"
    if least != largest:
        middle += f" ({least} to {largest})"
    return middle.replace("-", "−")


def symbol(name: str) -> str:
    """Return the symbol of a quantity without mathtext."""
    plain = quantity(name).symbol.replace("\\mathrm", "")
    for command, letter in (("\\theta", "θ"), ("\\phi", "φ"), ("\\varphi", "φ")):
        plain = plain.replace(command, letter)
    return plain.replace("{", "").replace("}", "")


@contextmanager
def progress(console: Console | None = None) -> Iterator[Callable[..., None]]:
    """Show a progress bar for each stage of a computation, in a notebook or a terminal.

    Parameters
    ----------
    console : rich.console.Console, optional
        Terminal to write to; by default the notebook, if there is one, or standard error.

    Yields
    ------
    callable
        Function to be passed as ``progress=``; called as ``(done, total)`` or
        ``(stage, done, total)``.
    """
    stages: dict[str, Any] = {}

    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    if console is None and shell is not None and hasattr(shell, "kernel"):
        notebook: Any = importlib.import_module("IPython.display")
        handle = notebook.display(notebook.HTML(""), display_id=True)

        def show(stage: str, done: int, total: int) -> None:
            stages[stage] = (
                f'<progress value="{done}" max="{total}"></progress> {escape(stage)} {done}/{total}'
            )
            handle.update(notebook.HTML("<br>".join(stages.values())))

        yield lambda *report: show(*_report(*report))
        return

    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (
        SpinnerColumn(finished_text="[green]✓"),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console or Console(stderr=True)) as bars:

        def tell(*report: Any) -> None:
            stage, done, total = _report(*report)
            if stage not in stages:
                stages[stage] = bars.add_task(stage, total=total)
            bars.update(stages[stage], completed=done, total=total)

        yield tell


def _report(*report: Any) -> tuple[str, int, int]:
    """Stage, which not all computations name, number done, and total."""
    *stage, done, total = report
    return (stage[0] if stage else "done"), done, total
