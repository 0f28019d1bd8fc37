"""Values as colours, and the legend of these."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vibrissa.plots import scale_of
from vibrissa.quantities import quantity, to_display
from vibrissa.scene import Array, Bytes, Colour, Ints
from vibrissa.viewer.readout import plain, symbol

WHISKER: Colour = (122, 96, 76)
REST: Colour = (150, 158, 168)
GHOST: Colour = (213, 94, 0)
CONTACT: Colour = (213, 94, 0)
FORCE: Colour = (0, 114, 178)
OBJECT: Colour = (160, 172, 186)
FIT: Colour = (0, 158, 115)
CLOUD: Colour = (150, 175, 200)

_NONE = (0.80, 0.82, 0.84)
_COUNTS = ((0.80, 0.82, 0.84), (0.35, 0.62, 0.80), (0.90, 0.55, 0.10), (0.75, 0.10, 0.15))
"""Colours of no, one, two, and more candidates."""


@dataclass(frozen=True)
class Legend:
    """Meaning of the colours."""

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
    """Colours of numbers of candidates, and their legend."""
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
