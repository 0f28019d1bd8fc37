"""Numbers with units and sentences, as HTML."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape as _escape

import numpy as np

from vibrissa.quantities import quantity
from vibrissa.rod import Deflection
from vibrissa.signals import SIGNALS, signals_of
from vibrissa.status import Status

_GREEK = {"theta": "θ", "varphi": "φ", "sigma": "σ"}


def plain(text: str) -> str:
    """Text as HTML shows it."""
    return _escape(text, quote=False)


def symbol(name: str) -> str:
    """Write the symbol of a quantity: `F_x` as F with an index."""
    text = re.sub(r"\\math(?:rm|bf){(\w+)}", r"\1", quantity(name).symbol)
    text = re.sub(r"\\([a-z]+)", lambda found: _GREEK.get(found[1], found[1]), text)
    return re.sub(r"_(\w)", r"<sub>\1</sub>", text)


def number(name: str, value: float, digits: int = 4) -> str:
    """Write an SI value in the unit in which it is shown; a dash where it is missing.

    Angles have two decimals, other numbers so many digits but at most four decimals.
    """
    if not np.isfinite(value):
        return "–"
    q = quantity(name)
    shown = value * q.display_factor
    whole = np.floor(np.log10(abs(shown))) if shown else 0.0
    decimals = 2 if q.display_unit == "°" else int(np.clip(digits - 1 - whole, 0, 4))
    # Adding zero turns −0 into 0.
    text = f"{round(shown, decimals) + 0.0:.{decimals}f}".replace("-", "−")
    return f"{text}{'' if q.display_unit in ('', '°') else ' '}{q.display_unit}"


def table(rows: Mapping[str, float], heading: str = "") -> str:
    """Quantities and their values in two columns; each cell says whose it is."""
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
    return _framed(
        (head if heading else "")
        + f'<table style="width:100%;border-collapse:collapse;font-size:13px">{body}</table>'
    )


def sentence(status: Status, good: str | None = None) -> str:
    """Say what became of a load or an estimate, in the colour of good or bad news.

    Good news may be told in other words than those of the status.
    """
    words = good if good and status.ok else status.explanation
    colour = ("#e6f4ee", "#00614a") if status.ok else ("#fdece3", "#9c3d00")
    advice = f'<div style="margin-top:3px;opacity:.85">{plain(status.advice)}</div>'
    return (
        f'<div data-status="{status.name}" style="margin:0 12px 8px;padding:6px 9px;'
        f"border-radius:6px;font-size:13px;line-height:1.35;background:{colour[0]};"
        f'color:{colour[1]}">{plain(words)}{advice if status.advice else ""}</div>'
    )


def note(text: str) -> str:
    """A remark."""
    return (
        '<div data-note style="margin:0 12px 8px;font-size:13px;line-height:1.35;opacity:.8">'
        f"{plain(text)}</div>"
    )


def _framed(body: str) -> str:
    return f'<div style="margin:0 12px 8px">{body}</div>'


def of_deflection(bent: Deflection) -> str:
    """What became of the load, what the base feels, and where the contact is."""
    return sentence(Status(int(bent.status))) + numbers(bent)


def numbers(bent: Deflection) -> str:
    """What the base feels, and where the contact is."""
    signals = signals_of(np.asarray(bent.force), np.asarray(bent.moment))
    felt = dict(zip(SIGNALS, signals.tolist(), strict=True))
    x, y, z = np.asarray(bent.contact_point)
    where = {
        "arc_length": float(bent.arc_length),
        "r": float(np.linalg.norm([x, y, z])),
        "theta": float(np.arctan2(y, x)),
        "phi": float(np.arctan2(z, np.hypot(x, y))),
    }
    return table(felt, "At the base") + table(where, "Contact")
