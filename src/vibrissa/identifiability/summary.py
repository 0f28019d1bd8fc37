"""Verdicts read as a whole: in short, as a table, as files, and the triplet to use."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa.identifiability.evidence import NOT_UNIQUE, OFF_SURFACE, UNIQUE
from vibrissa.io import check_writable, replacing, write_netcdf

# Parts of each region.
_PARTS = {
    "all": {"ELD", "CF", "CB", "ELD CF", "ELD CB"},
    "ELD": {"ELD CF", "ELD CB"},
    "CF": {"ELD CF"},
    "CB": {"ELD CB"},
    "ELD CF": set(),
    "ELD CB": set(),
}
_MARKS = {UNIQUE: "unique", OFF_SURFACE: "unique*", NOT_UNIQUE: "–"}
#: Endings of files that verdicts are written to.
ENDINGS = (".nc", ".csv")
# Tolerance whose ambiguous shares decide between triplets that are unique over the same region.
_DECIDING = 1e-3


def notation(words: Mapping[str, str]) -> str:
    """Verdicts of a triplet, by regions, in short."""
    word = {region: str(verdict) for region, verdict in words.items()}
    good = [region for region in word if word[region] in (UNIQUE, OFF_SURFACE)]
    # A part adds something only if it is unique where the whole is so off a surface.
    largest = [
        region
        for region in good
        if not any(region in _PARTS[other] and word[other] == word[region] for other in good)
        and not any(region in _PARTS[other] and word[other] == UNIQUE for other in good)
    ]
    names = [
        ("All" if r == "all" else r) + ("*" if word[r] == OFF_SURFACE else "") for r in largest
    ]
    return " / ".join(names) or "–"


def choice(verdicts: xr.Dataset) -> tuple[str, str]:
    """The triplet to use, with its region, as in the paper's Fig. 1C."""
    best: tuple[float, float, float] | None = None
    chosen = ("", "")
    share = verdicts.region_share.to_series()
    for triplet in verdicts.triplet.to_numpy():
        for region in verdicts.region.to_numpy():
            cell = verdicts.sel(triplet=triplet, region=region)
            word = str(cell.verdict.item())
            if word not in (UNIQUE, OFF_SURFACE):
                continue
            ambiguous = 0.0
            if "ambiguous_share" in verdicts:
                ambiguous = float(cell.ambiguous_share.sel(signal_tolerance=_DECIDING))
            rank = (-round(float(share[region]), 9), float(word == OFF_SURFACE), ambiguous)
            if best is None or rank < best:
                best, chosen = rank, (str(triplet), str(region))
    return chosen


def verdict_words(cell: xr.Dataset) -> str:
    """A verdict with its evidence, such as "unique (proved)"."""
    evidence = str(cell["evidence"].item()) if "evidence" in cell else ""
    return str(cell["verdict"].item()) + (f" ({evidence})" if evidence else "")


def verdict_table(verdicts: xr.Dataset) -> str:
    """Write verdicts as a table for people.

    Parameters
    ----------
    verdicts : Dataset
        Verdicts of :func:`vibrissa.uniqueness`.

    Returns
    -------
    str
        A row for each triplet: the critical cone in each region, with the verdict; in short.
    """
    rows, notes = verdict_rows(verdicts)
    width = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [
        "  ".join(c.ljust(w) for c, w in zip(row, width, strict=True)).rstrip() for row in rows
    ]
    return "\n".join([*lines, "", *notes])


def verdict_rows(verdicts: xr.Dataset) -> tuple[list[list[str]], list[str]]:
    """Arrange verdicts as the cells of a table."""
    regions = [str(r) for r in verdicts.region.to_numpy()]
    rows = [["triplet", *regions, "in short", "twins"]]
    for triplet in verdicts.triplet.to_numpy():
        row = [str(triplet)]
        for region in regions:
            cell = verdicts.sel(triplet=triplet, region=region)
            word = str(cell.verdict.item())
            mark = _MARKS.get(word, word)
            proved = "evidence" in cell and str(cell.evidence.item()) == "proved"
            found = np.rad2deg(float(cell.critical_cone))
            angle = f"≥{np.floor(10.0 * found) / 10.0:.1f}°"  # a lower bound
            row.append(angle if word == NOT_UNIQUE else mark + " (proved)" * proved)
        rows.append(
            [*row, str(verdicts.notation.sel(triplet=triplet).item()), twins_of(verdicts, triplet)]
        )
    chosen, region = verdicts.attrs["chosen_triplet"], verdicts.attrs["chosen_region"]
    use = "none is unique"
    if chosen:
        cell = verdicts.sel(triplet=chosen, region=region)
        use = f"({chosen.replace(' ', ', ')}), {verdict_words(cell)} in: {region}"
    cone = np.rad2deg(verdicts.attrs["cone"])
    return rows, [
        f"≥ an angle: not unique (witness), twins exist that far from rest, maybe farther. "
        f"Unique: unique (no counterexample found), unless proved. *: off {_surface(verdicts)}.",
        f"Twins: share of the contacts of {regions[0]} that have one, and their median distance.",
        f"Contacts within {cone:.3g}° of rest left out; domain: {verdicts.attrs['domain']}; "
        f"contacts nearer than {1e3 * verdicts.attrs['min_separation']:.3g} mm count as one.",
        f"The triplet to use: {use}.{_rarest(verdicts)}",
        *_certificate_note(verdicts),
    ]


def _rarest(verdicts: xr.Dataset) -> str:
    """The triplet that is not unique in the first region, with the fewest contacts with twins."""
    cells = verdicts.isel(region=0)
    share = cells.twin_share.where(cells.verdict == NOT_UNIQUE)
    if not share.notnull().any():
        return ""
    triplet = str(share.idxmin("triplet").item())
    name = f"({triplet.replace(' ', ', ')})"
    return f" Of the others fewest twins: {name}, {twins_of(verdicts, triplet)}."


def twins_of(verdicts: xr.Dataset, triplet: str) -> str:
    """Share of contacts that have a twin, in the first region, with the distance of twins."""
    if triplet not in verdicts["triplet"]:
        return "not asked"
    cell = verdicts.sel(triplet=triplet).isel(region=0)
    if str(cell.verdict.item()) != NOT_UNIQUE or "twin_distance" not in cell:
        return "–"
    share, distance = float(cell.twin_share), float(cell.twin_distance)
    if not share > 0.0:
        return "rare pairs"
    apart = f", {1e3 * distance:.2g} mm" if np.isfinite(distance) else ""
    return f"{100.0 * share:.3g} %{apart}"


def _certificate_note(verdicts: xr.Dataset) -> list[str]:
    """State what a grid shows of a proof."""
    if "determinant_cone" not in verdicts.attrs:
        return []
    angle, cone = (np.rad2deg(verdicts.attrs[name]) for name in ("determinant_cone", "cone"))
    signs = f"(Fx, MB, MD): on a grid, the signs that a proof outside {cone:.3g}° needs are"
    if verdicts.attrs["certificate_possible"]:
        keeps = (
            f"; the determinant keeps its sign outside {angle:.2f}°" if 0.0 < angle < np.inf else ""
        )
        return [f"{signs} right{keeps}."]
    where = "no proof of this kind can exist"
    if 0.0 < angle < np.inf:
        where = f"a proof is possible outside {max(angle, cone):.2f}° at best"
    return [f"{signs} wrong; {where}."]


def _surface(verdicts: xr.Dataset) -> str:
    names = sorted({str(s) for s in verdicts.surface.to_numpy().ravel()} - {""})
    return " or ".join(names) or "a surface of measure zero"


def save_uniqueness(verdicts: xr.Dataset, path: str | PathLike[str]) -> None:
    """Write verdicts with their evidence."""
    path = Path(path)
    check_writable(path, ENDINGS)
    if path.suffix == ".nc":
        write_netcdf(path, verdicts)
    else:
        with replacing(path) as part:
            part.write_text(_rows(verdicts), encoding="utf-8")


def _rows(verdicts: xr.Dataset) -> str:
    plain = [n for n, v in verdicts.data_vars.items() if v.dims == ("triplet", "region")]
    header = ["triplet", "region", *map(str, plain)]
    spread = [n for n in ("ambiguous_share", "surface_angle") if n in verdicts]
    header += [f"{n}_{t:g}" for n in spread for t in verdicts.signal_tolerance.to_numpy()]
    trained: list[float] = (
        verdicts["quantile"].values.tolist() if "network_error" in verdicts else []
    )
    header += [f"network_error_{q:g}" for q in trained]
    header += ["witness_separation", "witness_difference"]
    header += [
        f"witness_{v}_{i}" for i in (1, 2) for v in ("arc_length", "fy", "fz", "x", "y", "z")
    ]
    lines = [",".join(header)]
    for triplet in verdicts.triplet.to_numpy():
        for region in verdicts.region.to_numpy():
            cell = verdicts.sel(triplet=triplet, region=region)
            first = cell.isel(witness=0)
            values = [cell[n].item() for n in plain]
            values += [float(x) for n in spread for x in cell[n].to_numpy()]
            values += [float(cell["network_error"].sel(quantile=q)) for q in trained]
            values += [float(first.witness_separation), float(first.witness_difference)]
            for pair in ("first", "second"):
                one = first.sel(pair=pair)
                values += [float(one.witness_arc_length), *one.witness_contact_force.to_numpy()]
                values += list(one.witness_point.to_numpy())
            lines.append(",".join([str(triplet), str(region), *map(_cell, values)]))
    return "\n".join(lines) + "\n"


def _cell(value: object) -> str:
    if isinstance(value, str):
        return f'"{value}"' if "," in value else value
    return repr(float(value))  # type: ignore[arg-type]
