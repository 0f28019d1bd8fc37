"""Signals over time as a picture that is drawn once, and a cursor that moves over it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.quantities import quantity, to_display
from vibrissa.viewer.drawing import Array
from vibrissa.viewer.readout import symbol

ROWS = (("Fx", "FT"), ("Mx", "MB"), ("FD", "MD"))
WIDTH, ROW, LEFT = 300.0, 62.0, 40.0
_COLOURS = ("#0072b2", "#d55e00")
_MOST = 700
"""Points of a line; each stands for the least and the largest value around it."""


def chart(time: Array, signals: dict[str, Array], felt: NDArray[np.bool_]) -> str:
    """Draw the six signals over time."""
    parts = [_shade(time, felt)]
    for row, names in enumerate(ROWS):
        parts.append(_row(time, signals, names, row * ROW))
    end = f"{1e3 * (time[-1] - time[0]):.0f} ms"
    foot = height() - 3.0
    parts.append(_text(LEFT, foot, "0", "start") + _text(WIDTH, foot, end, "end"))
    return _svg("".join(parts))


def height() -> float:
    """Of the chart, pixels per :data:`WIDTH` of them."""
    return len(ROWS) * ROW + 14.0


def cursor(share: float) -> str:
    """A line at a share of the time, to be laid over the chart."""
    x = LEFT + (WIDTH - LEFT) * share
    line = (
        f'<line x1="{x:.2f}" x2="{x:.2f}" y1="0" y2="{len(ROWS) * ROW:.0f}" stroke="currentColor" '
        f'stroke-width="1.2" data-cursor="{share:.4f}"/>'
    )
    return f'<div style="margin-top:{-100.0 * height() / WIDTH:.3f}%">{_svg(line)}</div>'


def _svg(body: str) -> str:
    return (
        f'<svg viewBox="0 0 {WIDTH:.0f} {height():.0f}" style="display:block;width:100%" '
        f'font-family="sans-serif" font-size="8.5">{body}</svg>'
    )


def _text(x: float, y: float, text: str, anchor: str, colour: str = "#777") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">{text}</text>'


def _x(time: Array, at: Array) -> Array:
    return np.asarray(LEFT + (WIDTH - LEFT) * (at - time[0]) / max(time[-1] - time[0], 1e-12))


def _shade(time: Array, felt: NDArray[np.bool_]) -> str:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], felt, [False]]).astype(int)))
    out = []
    for first, beyond in edges.reshape(-1, 2):
        x, end = _x(time, time[[first, beyond - 1]])
        out.append(
            f'<rect x="{x:.1f}" width="{max(end - x, 0.4):.1f}" y="0" '
            f'height="{len(ROWS) * ROW:.0f}" fill="#7895b2" fill-opacity="0.17"/>'
        )
    return "".join(out)


def _row(time: Array, signals: dict[str, Array], names: tuple[str, str], top: float) -> str:
    """Two signals of one unit in one row."""
    shown = {name: to_display(name, signals[name]) for name in names}
    low, high = _limits(np.concatenate(list(shown.values())), quantity(names[0]).display_unit)
    inside, bottom = ROW - 12.0, top + ROW - 4.0
    unit = quantity(names[0]).display_unit
    out = [
        f'<line x1="{LEFT}" x2="{WIDTH}" y1="{bottom:.1f}" y2="{bottom:.1f}" stroke="#8888"/>',
        _text(LEFT - 3.0, top + 11.0, _brief(high), "end"),
        _text(LEFT - 3.0, bottom, _brief(low), "end"),
        _text(LEFT - 3.0, top + 0.5 * ROW + 3.0, unit, "end"),
    ]
    for i, name in enumerate(names):
        x, values = _thinned(time, shown[name])
        y = bottom - inside * (values - low) / (high - low)
        out.append(_path(_x(time, x), y, _COLOURS[i], direction=name in ("FD", "MD")))
        words = symbol(name).replace("<sub>", '<tspan dy="2" font-size="6.5">')
        words = words.replace("</sub>", "</tspan>")
        out.append(_text(LEFT + 4.0 + 17.0 * i, top + 10.0, words, "start", _COLOURS[i]))
    return "".join(out)


def _limits(values: Array, unit: str) -> tuple[float, float]:
    if unit == "°":
        return -180.0, 180.0
    if not np.isfinite(values).any():
        return 0.0, 1.0
    low, high = min(float(np.nanmin(values)), 0.0), max(float(np.nanmax(values)), 0.0)
    return (low, high) if high > low else (low - 1.0, high + 1.0)


def _brief(value: float) -> str:
    return f"{value:.3g}".replace("-", "−")


def _thinned(time: Array, values: Array) -> tuple[Array, Array]:
    """Few enough points, with the extremes of what they stand for."""
    step = int(np.ceil(2 * time.size / _MOST))
    if step <= 1:
        return time, values
    count = time.size // step * step
    blocks = values[:count].reshape(-1, step)
    known = np.isfinite(blocks).any(axis=1)
    least, most = np.full((2, len(blocks)), np.nan)
    least[known], most[known] = np.nanmin(blocks[known], axis=1), np.nanmax(blocks[known], axis=1)
    return np.repeat(time[:count:step], 2), np.stack([least, most], axis=1).ravel()


def _path(x: Array, y: Array, colour: str, direction: bool) -> str:
    """A line that is broken where values are missing, or where a direction goes round."""
    broken = ~np.isfinite(y)
    jump = np.zeros(y.size, dtype=bool)
    if direction:
        with np.errstate(invalid="ignore"):
            jump[1:] = np.abs(np.diff(y)) > 0.5 * ROW
    starts = broken | jump
    starts[1:] |= broken[:-1]
    starts[0] = True
    words = [
        f"{'M' if start else 'L'}{a:.1f} {b:.1f}"
        for a, b, start, gone in zip(x, y, starts, broken, strict=True)
        if not gone
    ]
    return f'<path d="{"".join(words)}" fill="none" stroke="{colour}" stroke-width="0.9"/>'
