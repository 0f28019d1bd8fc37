"""Sections about a map of contacts: whisker, signals and, if they are known, verdicts."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vibrissa.contacts import ContactMap
from vibrissa.identifiability import verdict_rows
from vibrissa.quantities import quantity, shown_unit, to_display
from vibrissa.report.page import Section, paragraph, table
from vibrissa.signals import SIGNALS
from vibrissa.status import describe


def chart_sections(contact_map: ContactMap, verdicts: xr.Dataset | None = None) -> list[Section]:
    """Describe a contact map, and which signals locate its contacts."""
    about = Section("map", "The map", contact_map._repr_html_() + _ranges(contact_map.to_dataset()))
    if verdicts is None:
        advice = paragraph(
            "Uniqueness has not been tested: `vibrissa uniqueness MAP -o FILE.nc` tests it, and "
            "`--uniqueness FILE.nc` shows the verdicts here."
        )
        return [about, Section("verdicts", "Verdicts", advice)]
    body = _verdicts(verdicts) + _witnesses(verdicts)
    return [about, Section("verdicts", "Which triplets are unique", body)]


def _ranges(samples: xr.Dataset) -> str:
    """Ranges of signals over all contacts, and their statuses."""
    rows = []
    for name in (*SIGNALS, "r", "theta", "phi"):
        factor, unit = shown_unit(name, samples[name].values)
        values = factor * samples[name].values
        ends = (f"{end:.4g}".replace("-", "−") for end in (np.nanmin(values), np.nanmax(values)))
        rows.append((f"{quantity(name).long_name} ({unit})", *ends))
    ranges = table(rows, ("quantity", "smallest", "largest"), "Ranges over all contacts of the map")
    counts = describe(samples["status"].values).most_common()
    ended = [(sentence, str(count)) for sentence, count in counts]
    return ranges + table(ended, ("status", "contacts"), "What limits the contacts")


def _verdicts(verdicts: xr.Dataset) -> str:
    if "critical_cone" not in verdicts or "notation" not in verdicts:
        rows = [
            (str(triplet), *(str(v) for v in verdicts["verdict"].sel(triplet=triplet).values))
            for triplet in verdicts["triplet"].values
        ]
        return table(rows, ("triplet", *map(str, verdicts["region"].values)), "Verdicts")
    (heading, *cells), notes = verdict_rows(verdicts)
    return table(cells, heading, "Verdicts by region") + "".join(
        paragraph(note, "note") for note in notes
    )


def _witnesses(verdicts: xr.Dataset) -> str:
    """The farthest pair of contacts with the same signals, by triplet."""
    if "witness_separation" not in verdicts:
        return ""
    apart = verdicts["witness_separation"].transpose("triplet", "region", "witness").values
    rows = []
    for triplet, cells in zip(verdicts["triplet"].values, apart, strict=True):
        if np.isfinite(cells).any():
            region, _ = np.unravel_index(int(np.nanargmax(cells)), cells.shape)
            farthest = float(to_display("contact_point", np.nanmax(cells)))
            name = str(verdicts["region"].values[region])
            rows.append((str(triplet), name, f"{farthest:.3f} mm"))
    if not rows:
        return paragraph("No two contacts with the same signals were found.")
    return table(
        rows,
        ("triplet", "region", "distance"),
        "Farthest pairs of contacts with the same signals",
        "Each pair proves that the triplet does not locate contacts in the region.",
    )
