"""Display of results that are plain datasets, in a notebook or a terminal.

Whiskers, deflections, maps and estimates have their own displays. Verdicts on triplets and
recordings are xarray types, whose display lists variables; `show` explains their content.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.identifiability import verdict_rows, verdict_table
from vibrissa.io import RECORDING_KIND
from vibrissa.recording import Recording
from vibrissa.sketch import BENT, CONTACT, MOST_CURVES, REST, Mark, card, table, thinned, views


@dataclass(frozen=True, repr=False)
class Shown:
    """A display: HTML in a notebook, text in a terminal."""

    html: str
    text: str

    def _repr_html_(self) -> str:
        return self.html

    def __repr__(self) -> str:
        return self.text


def show(result: Any) -> Shown:
    """Display a result at a glance.

    Parameters
    ----------
    result : Dataset or DataTree or other
        Verdicts from :func:`vibrissa.uniqueness`; a recording; or an object with a notebook
        display, such as a `Whisker`.

    Returns
    -------
    Shown
        Small picture and table with units; in a terminal, the table.

    Raises
    ------
    ValueError
        If ``result`` is none of these.
    """
    if isinstance(result, xr.Dataset) and "verdict" in result and "critical_cone" in result:
        rows, notes = verdict_rows(result)
        shown_notes = "".join(f"{escape(note)}<br>" for note in notes)
        return Shown(
            f"<div>{table(rows[1:], rows[0])}<small>{shown_notes}</small></div>",
            verdict_table(result),
        )
    if isinstance(result, xr.DataTree) and result.attrs.get("kind") == RECORDING_KIND:
        facts = _facts(result)
        width = max(len(name) for name, _ in facts)
        text = "\n".join(f"{name:{width}}  {value}" for name, value in facts)
        return Shown(card("Recording", facts, _picture(result)), text)
    if hasattr(result, "_repr_html_") and not isinstance(result, xr.Dataset | xr.DataTree):
        return Shown(result._repr_html_(), repr(result))
    raise ValueError(
        f"got {type(result).__name__}; verdicts of uniqueness, a recording, or a result of "
        "vibrissa is needed"
    )


def _facts(recording: xr.DataTree) -> list[tuple[str, str]]:
    """Facts about a recording, as labels and texts."""
    root = recording.to_dataset()
    time = root["time"].values
    facts = [("origin", str(recording.attrs.get("origin", "unknown")))]
    if time.size > 1:
        rate = 1.0 / float(np.median(np.diff(time)))
        facts.append(("time", f"{time.size} frames, {np.ptp(time):.4g} s, {rate:.6g} a second"))
    else:
        facts.append(("time", f"{time.size} frames"))
    if "whisker" in root.sizes:
        names = [str(name) for name in root["whisker"].values] if "whisker" in root.coords else []
        listed = f": {', '.join(names[:8])}{', …' if len(names) > 8 else ''}" if names else ""
        facts.append(("whiskers", f"{root.sizes['whisker']}{listed}"))
    if "in_contact" in root:
        share = 100.0 * float(root["in_contact"].mean())
        facts.append(("in contact", f"{share:.3g} % of the frames"))
    facts += [("object", thing.in_words()) for thing in Recording(recording).objects]
    if "cameras" in recording.children:
        facts.append(("cameras", str(recording["cameras"].to_dataset().sizes.get("view", 0))))
    return [*facts, ("groups", ", ".join(sorted(recording.children)))]


def _picture(recording: xr.DataTree) -> str:
    """Picture of some frames' whisker, the base, and the contact points, laboratory frame."""
    marks = []
    trial = Recording(recording)
    for name, colour, dots, label in (
        ("centerline", BENT, False, "whisker"),
        ("base_position", REST, True, "its base"),
        ("contact_point", CONTACT, True, "contacts"),
    ):
        if (values := trial.known(name, ("", "truth"))) is None:
            continue
        values = values if dots else thinned(values, MOST_CURVES)
        marks.append(Mark(values, colour, dots, 3.0 if dots else 0.7, label))
    return views(marks) if marks else ""
