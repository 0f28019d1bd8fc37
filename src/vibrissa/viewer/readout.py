"""HTML and SVG of numbers, sentences and signals over time, and colours of values."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape as _escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import Array
from vibrissa.plots import scale_of
from vibrissa.quantities import quantity, shown_unit, to_display
from vibrissa.rod import Deflection
from vibrissa.scene import Bytes, Colour, Ints
from vibrissa.signals import SIGNALS, signals_of, spherical
from vibrissa.sketch import round_step
from vibrissa.status import Status

_GREEK = {"theta": "θ", "varphi": "φ", "sigma": "σ"}


def plain(text: str) -> str:
    """Escape text for HTML."""
    return _escape(text, quote=False)


def symbol(name: str) -> str:
    """HTML of the symbol of a quantity: `F_x` as F with an index."""
    text = re.sub(r"\\math(?:rm|bf){(\w+)}", r"\1", quantity(name).symbol)
    text = re.sub(r"\\([a-z]+)", lambda found: _GREEK.get(found[1], found[1]), text)
    return re.sub(r"_(\w)", r"<sub>\1</sub>", text)


def number(name: str, value: float, digits: int = 4) -> str:
    """Format an SI value in its most readable unit; a dash if it is missing."""
    if not np.isfinite(value):
        return "–"
    factor, unit = shown_unit(name, value)
    shown = value * factor
    whole = np.floor(np.log10(abs(shown))) if shown else 0.0
    decimals = 2 if unit == "°" else int(np.clip(digits - 1 - whole, 0, 4))
    text = f"{shown:z.{decimals}f}".replace("-", "−")
    return f"{text}{'' if unit in ('', '°') else ' '}{unit}"


def table(rows: Mapping[str, float], heading: str = "") -> str:
    """HTML table of quantities and their values."""
    cells = [
        f'<td style="padding:1px 0;opacity:.75" title="{_escape(quantity(name).long_name)}">'
        f"<i>{symbol(name)}</i></td>"
        f'<td data-quantity="{name}" style="padding:1px 10px 1px 4px;text-align:right;'
        f'font-variant-numeric:tabular-nums;white-space:nowrap">{number(name, value)}</td>'
        for name, value in rows.items()
    ]
    lines = ["".join(cells[i : i + 2]) for i in range(0, len(cells), 2)]
    head = f'<div style="font-weight:600;margin-bottom:2px">{plain(heading)}</div>'
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return (
        f'<div style="margin:0 12px 8px">{head if heading else ""}'
        f'<table style="width:100%;border-collapse:collapse;font-size:13px">{body}</table></div>'
    )


def _by_mode(what: str, light: str, dark: str) -> str:
    """CSS of a colour in light and dark mode; browsers without modes use the light one."""
    return f"{what}:{light};{what}:light-dark({light},{dark});"


# Background and text by success.
_BY_SUCCESS = {
    True: (_by_mode("background", "#e6f4ee", "#0f3d30"), _by_mode("color", "#00614a", "#9fe3cb")),
    False: (_by_mode("background", "#fdece3", "#4a2713"), _by_mode("color", "#9c3d00", "#ffc9a3")),
}


def sentence(status: Status, good: str | None = None) -> str:
    """HTML of the status of a load or an estimate, coloured by success."""
    words = good if good and status.ok else status.explanation
    paper, ink = _BY_SUCCESS[bool(status.ok)]
    advice = f'<div style="margin-top:3px;opacity:.85">{plain(status.advice)}</div>'
    return (
        f'<div data-status="{status.name}" style="margin:0 12px 8px;padding:6px 9px;'
        f"border-radius:6px;font-size:13px;line-height:1.35;{paper}{ink}"
        f'">{plain(words)}{advice if status.advice else ""}</div>'
    )


def note(text: str) -> str:
    """HTML of a remark."""
    return (
        '<div data-note style="margin:0 12px 8px;font-size:13px;line-height:1.35;opacity:.8">'
        f"{plain(text)}</div>"
    )


_HELP = {
    "drag": "rotate the view; with the right button: shift it",
    "wheel": "zoom",
    "a": "show everything",
}
_TRIAL_HELP = {
    "space": "play or pause",
    ", and .": "one frame back or ahead",
    "p and n": "previous or next onset of a contact",
    "Home, End": "first or last frame",
    "timeline, signals": "click or drag: go to a time",
    "contact point": "click: go to its time",
}


def instructions(trial: bool) -> str:
    """HTML table of what mouse and keys do, with or without a trial."""
    rows = "".join(
        f'<tr><td style="white-space:nowrap;padding-right:10px;vertical-align:top">{key}</td>'
        f"<td>{does}</td></tr>"
        for key, does in (_HELP | _TRIAL_HELP if trial else _HELP).items()
    )
    return f'<table style="margin:0 12px 8px;font-size:13px;line-height:1.35">{rows}</table>'


def of_deflection(bent: Deflection) -> str:
    """HTML with status of the load, signals at the base, and contact point."""
    return sentence(Status(int(bent.status))) + numbers(bent)


def numbers(bent: Deflection) -> str:
    """HTML tables of the signals at the base and the contact point."""
    signals = signals_of(np.asarray(bent.force), np.asarray(bent.moment))
    measured = dict(zip(SIGNALS, signals.tolist(), strict=True))
    where = (float(bent.arc_length), *spherical(np.asarray(bent.contact_point)).tolist())
    contact = dict(zip(("arc_length", "r", "theta", "phi"), where, strict=True))
    return table(measured, "At the base") + table(contact, "Contact")


ROWS = (("Fx", "FT"), ("Mx", "MB"), ("FD", "MD"))
WIDTH, ROW, LEFT = 300.0, 62.0, 40.0
_COLOURS = ("#0072b2", "#d55e00")
_MOST = 700  # largest number of points of a line, which has the extremes of the values around each


def chart(time: Array, signals: dict[str, Array], touching: NDArray[np.bool_]) -> str:
    """SVG of the six signals over time."""
    parts = [_shade(time, touching, len(ROWS) * ROW)]
    for row, names in enumerate(ROWS):
        parts.append(_row(time, signals, names, row * ROW))
    end = f"{1e3 * (time[-1] - time[0]):.0f} ms"
    foot = height() - 3.0
    parts.append(_text(LEFT, foot, "0", "start") + _text(WIDTH, foot, end, "end"))
    return _svg("".join(parts), height())


def height() -> float:
    """Height of the chart, pixels per :data:`WIDTH` of them."""
    return len(ROWS) * ROW + 14.0


def cursor(share: float, *, strip: bool = False) -> str:
    """SVG of a line at a share of the time, to be overlaid on the chart or the timeline."""
    x = LEFT + (WIDTH - LEFT) * share
    tall, end = (STRIP, 12.0) if strip else (height(), len(ROWS) * ROW)
    line = (
        f'<line x1="{x:.2f}" x2="{x:.2f}" y1="0" y2="{end:.0f}" stroke="currentColor" '
        f'stroke-width="1.2" data-cursor="{share:.4f}"/>'
    )
    return f'<div style="margin-top:{-100.0 * tall / WIDTH:.3f}%">{_svg(line, tall)}</div>'


PAD = 8  # empty pixels at the right of a plot over time, as assumed by the page's script
STRIP = 20.0  # height of the timeline, pixels per :data:`WIDTH` of them


def timeline(time: Array, touching: NDArray[np.bool_], onsets: NDArray[np.int64]) -> str:
    """SVG of contacts, onsets and a time axis in ms of a whole trial."""
    duration = 1e3 * float(time[-1] - time[0])
    parts = [_shade(time, touching, 10.0)]
    parts += [
        f'<line x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="10" stroke="#d55e00"/>'
        for x in _x(time, time[onsets])
    ]
    for at in np.arange(0.0, 1.001 * duration, round_step(max(duration, 1e-3) / 3.0)):
        x = LEFT + (WIDTH - LEFT) * at / max(duration, 1e-9)
        anchor = "end" if x > WIDTH - 8.0 else "middle"
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="10" y2="12" stroke="#888"/>')
        parts.append(_text(x, STRIP - 1.0, f"{at:g}", anchor))
    parts.append(_text(LEFT - 14.0, STRIP - 1.0, "ms", "end"))
    return _svg("".join(parts), STRIP, " data-timeline")


def _svg(body: str, tall: float, mark: str = "") -> str:
    """SVG over time, in which the page's script handles the mouse."""
    return (
        f'<svg{mark} data-seek="{LEFT / WIDTH:.4f}" viewBox="0 0 {WIDTH:.0f} {tall:.0f}" '
        f'style="display:block;width:100%;padding-right:{PAD}px;box-sizing:border-box;'
        f'cursor:pointer;touch-action:pan-y;user-select:none" font-family="sans-serif" '
        f'font-size="8.5">{body}</svg>'
    )


def _text(x: float, y: float, text: str, anchor: str, colour: str = "#777") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}">{text}</text>'


def _x(time: Array, at: Array) -> Array:
    return np.asarray(LEFT + (WIDTH - LEFT) * (at - time[0]) / max(time[-1] - time[0], 1e-12))


def _shade(time: Array, touching: NDArray[np.bool_], tall: float) -> str:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], touching, [False]]).astype(int)))
    out = []
    for first, beyond in edges.reshape(-1, 2):
        x, end = _x(time, time[[first, beyond - 1]])
        out.append(
            f'<rect x="{x:.1f}" width="{max(end - x, 0.4):.1f}" y="0" '
            f'height="{tall:.0f}" fill="#7895b2" fill-opacity="0.3"/>'
        )
    return "".join(out)


def _row(time: Array, signals: dict[str, Array], names: tuple[str, str], top: float) -> str:
    """SVG of a row with two signals of the same unit."""
    shown = {name: to_display(name, signals[name]) for name in names}
    low, high = _limits(np.concatenate(list(shown.values())), quantity(names[0]).display_unit)
    inside, bottom = ROW - 12.0, top + ROW - 4.0
    unit = quantity(names[0]).display_unit
    out = [
        f'<line x1="{LEFT}" x2="{WIDTH}" y1="{bottom:.1f}" y2="{bottom:.1f}" stroke="#8888"/>',
        _text(LEFT - 3.0, top + 11.0, _brief(high), "end"),
        _text(LEFT - 3.0, bottom, _brief(low), "end"),
        _text(LEFT - 3.0, top + 0.5 * ROW + 7.0, unit, "end"),
    ]
    for i, name in enumerate(names):
        x, values = _thinned(time, shown[name])
        y = bottom - inside * (values - low) / (high - low)
        out.append(_path(_x(time, x), y, _COLOURS[i], direction=name in ("FD", "MD")))
        words = symbol(name).replace("<sub>", '<tspan dy="2" font-size="6.5">')
        words = words.replace("</sub>", "</tspan>")
        out.append(_text(2.0 + 17.0 * i, top + 0.5 * ROW - 4.0, words, "start", _COLOURS[i]))
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
    """Reduce a signal to few points that keep its extremes."""
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
    """SVG path, interrupted at missing values and where a direction wraps around."""
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


WHISKER: Colour = (122, 96, 76)
REST: Colour = (150, 158, 168)
GHOST: Colour = (213, 94, 0)
CONTACT: Colour = (213, 94, 0)
FORCE: Colour = (0, 114, 178)
OBJECT: Colour = (160, 172, 186)
FIT: Colour = (0, 158, 115)
CLOUD: Colour = (150, 175, 200)

# Colours of no, one, two, and more candidates.
_NONE = (0.80, 0.82, 0.84)
_COUNTS = ((0.80, 0.82, 0.84), (0.35, 0.62, 0.80), (0.90, 0.55, 0.10), (0.75, 0.10, 0.15))


@dataclass(frozen=True)
class Legend:
    """Legend of colours."""

    title: str
    steps: tuple[tuple[str, str], ...]
    smooth: bool = True

    def html(self) -> str:
        """The legend as HTML."""
        colours = [colour for colour, _ in self.steps]
        words = [word for _, word in self.steps if word or not self.smooth]
        if self.smooth:
            filling = f"linear-gradient(to right,{','.join(colours)})"
        else:
            share = 100.0 / len(colours)
            parts = [
                f"{colour} {share * i:.1f}% {share * (i + 1):.1f}%"
                for i, colour in enumerate(colours)
            ]
            filling = f"linear-gradient(to right,{','.join(parts)})"
        align = "space-between" if self.smooth else "space-around"
        below = "".join(f"<span>{plain(word)}</span>" for word in words)
        return (
            f'<div data-legend style="margin:0 12px 8px;font-size:12px">{self.title}'
            f'<div style="height:9px;border-radius:3px;margin:3px 0;background:{filling}"></div>'
            f'<div style="display:flex;justify-content:{align}">{below}</div></div>'
        )


def shaded(name: str, values: Array) -> tuple[Bytes, Legend]:
    """Colours (..., 3) of values of a quantity, SI units, and their legend.

    The outermost 2 % of the values share the colours of the ends. What is missing is grey.
    """
    shown = to_display(name, values)
    norm, colours = scale_of(name, shown)
    share = np.ma.filled(norm(np.ma.masked_invalid(shown), clip=True), np.nan)
    rgb = np.array(colours(np.nan_to_num(share)), dtype=np.float64)[..., :3]
    rgb[~np.isfinite(share)] = _NONE
    marks = np.asarray(norm.inverse(np.array(_MARKS)), dtype=np.float64)
    return _bytes(rgb), _ramp(name, colours, marks.tolist())


def counted(numbers: Ints) -> tuple[Bytes, Legend]:
    """Colours (..., 3) of numbers of candidates, and their legend."""
    rgb = np.array(_COUNTS)[np.clip(numbers, 0, 3)]
    words = ("none found", "one", "two", "more")
    steps = tuple((_css(np.array(c)), word) for c, word in zip(_COUNTS, words, strict=True))
    return _bytes(rgb), Legend("Contacts with the same signals", steps, smooth=False)


def _ramp(name: str, colours: Any, marks: list[float]) -> Legend:
    q = quantity(name)
    unit = f" ({q.display_unit})" if q.display_unit else ""
    words = [f"{mark:.3g}".replace("-", "−") for mark in marks]
    steps = [
        (_css(np.array(colours(share))[:3]), words[round(2 * share)] if share in _MARKS else "")
        for share in np.linspace(0.0, 1.0, 9)
    ]
    return Legend(f"<i>{symbol(name)}</i>{unit}: {plain(q.long_name)}", tuple(steps))


_MARKS = (0.0, 0.5, 1.0)


def _css(rgb: Array) -> str:
    r, g, b = np.round(255.0 * rgb).astype(int).tolist()
    return f"rgb({r},{g},{b})"


def _bytes(rgb: Array) -> Bytes:
    return np.asarray(np.round(255.0 * rgb), dtype=np.uint8)
