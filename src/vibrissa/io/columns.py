"""Names and units of columns as labs write them.

A force along x may be called ``Fx``, ``fx``, ``Force X`` or ``wrench.force.x``, a moment ``Mx``,
``Tx``, ``torque_x``; the unit, if any, follows: ``Fx_mN``, ``Fx (mN)``, ``Fx [mN]``, ``Fx/mN``.
Without one it is SI.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import product
from types import MappingProxyType

_SMALLER = {"": 1.0, "m": 1e-3, "u": 1e-6, "n": 1e-9}
LENGTHS: Mapping[str, float] = MappingProxyType({"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6})
"""Units of length, with how many metres they are; µ is written u."""

_UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
        "length": LENGTHS,
        "force": {f"{p}N": factor for p, factor in _SMALLER.items()},
        "moment": {
            f"{p}N{unit}": factor * LENGTHS[unit]
            for (p, factor), unit in product(_SMALLER.items(), ("m", "cm", "mm"))
        },
        "angle": {"rad": 1.0, "deg": 0.017453292519943295, "°": 0.017453292519943295},
    }
)
_KINDS = {"t": "time", "F": "force", "M": "moment", "T": "force", "B": "moment", "D": "angle"}

_COMPONENT = re.compile(
    r"(?:.*[./])?(force|moment|torque|[FMT])[ _.]?([xyz])(?![a-z0-9])(.*)", re.IGNORECASE
)
# A capital T alone is a temperature.
_OTHER = re.compile(r"((?i:FT|FD|MB|MD|time[ _]?stamp|time)|t)(?![A-Za-z0-9])(.*)")
_BETWEEN = re.compile(r"[\s·⋅×*.^_-]")


def signal_column(header: str) -> tuple[str, float | None]:
    """Tell which signal a column holds, and in which unit."""
    text = header.strip()
    if match := _COMPONENT.fullmatch(text):
        name = ("F" if match[1][0] in "Ff" else "M") + match[2].lower()
        return name, unit_factor(match[3], "force" if name[0] == "F" else "moment")
    if match := _OTHER.fullmatch(text):
        known = match[1].upper()
        name = "time" if known[0] == "T" else known
        kind = "time" if name == "time" else _KINDS[known[1]]
        return name, unit_factor(match[2], kind)
    return "", None


def unit_factor(text: str, kind: str) -> float | None:
    """Read a unit."""
    bare = text.strip().lstrip("_/,: ").strip("()[] ")
    unit = _BETWEEN.sub("", bare).replace("µ", "u").replace("μ", "u")
    if kind in ("time", "length"):
        unit = unit.lower()
    return _UNITS[kind].get(unit) if unit else 1.0


def units_of(kind: str) -> str:
    """List the units of a kind, for messages."""
    return ", ".join(_UNITS[kind])


def signal_columns(
    header: Sequence[str], names: Sequence[str]
) -> tuple[dict[str, tuple[int, float]], dict[str, list[str]]]:
    """Find signals among columns."""
    known = [signal_column(cell) for cell in header]
    found: dict[str, tuple[int, float]] = {}
    strange: dict[str, list[str]] = {}
    for name in names:
        here = [i for i, (which, _) in enumerate(known) if which == name]
        here.sort(key=lambda i: header[i] != name)
        usable = [(i, factor) for i in here if (factor := known[i][1]) is not None]
        if usable:
            found[name] = usable[0]
        elif here:
            strange[name] = [header[i] for i in here]
    return found, strange
