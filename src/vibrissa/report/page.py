"""HTML of a report: sections, tables, figures, movies and the page around them.

Plain text is escaped in this module only; other code that writes HTML must escape its contents.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shlex
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np

from vibrissa._version import __version__
from vibrissa.quantities import shown_unit

# Security policy of the page: it may use embedded content only.
_POLICY = (
    "default-src 'none'; img-src data: blob:; media-src data:; style-src 'unsafe-inline'; "
    # The 3D drawing library compiles functions.
    "script-src 'unsafe-inline' 'unsafe-eval'"
)
_STYLE = Path(__file__).with_suffix(".css").read_text(encoding="utf-8")
_CODE = re.compile(r"`([^`]+)`")

# Names of sections in their order: results first, settings and provenance last.
_ORDER = (
    "results",
    "picture",
    "map",
    "verdicts",
    "space",
    "contour",
    "estimates",
    "signals",
    "tracking",
    "tracked",
    "whiskers",
    "figures",
    "movies",
    "events",
    "statuses",
    "recording",
    "settings",
    "provenance",
)


class Tile(NamedTuple):
    """A main number of the report and its meaning, plain text."""

    number: str
    meaning: str


class Section(NamedTuple):
    """A section of the page: its anchor, its title as plain text, and its HTML."""

    name: str
    title: str
    body: str


def table(
    rows: Iterable[Sequence[str]], heading: Sequence[str] = (), caption: str = "", note: str = ""
) -> str:
    """HTML of a table; the first column names the rows, and with a heading others are numbers."""
    kind = ' class="number"' if heading else ""
    parts = [f'<div class="scroll"><table class="{"data" if heading else "facts"}">']
    if caption:
        parts.append(f"<caption>{escape(caption)}</caption>")
    if heading:
        first, *others = map(escape, heading)
        cells = "".join(f'<th scope="col"{kind}>{cell}</th>' for cell in others)
        parts.append(f'<thead><tr><th scope="col">{first}</th>{cells}</tr></thead>')
    parts.append("<tbody>")
    for row in rows:
        first, *others = map(escape, row)
        cells = "".join(f"<td{kind}>{cell}</td>" for cell in others)
        parts.append(f'<tr><th scope="row">{first}</th>{cells}</tr>')
    parts.append("</tbody></table></div>")
    if note:
        parts.append(paragraph(note, "note"))
    return "".join(parts)


def paragraph(text: str, kind: str = "") -> str:
    """HTML of a paragraph."""
    named = f' class="{kind}"' if kind else ""
    return f"<p{named}>{_marked(text)}</p>"


def tiles(numbers: Iterable[Tile]) -> str:
    """HTML of the main numbers side by side."""
    items = "".join(
        f"<li><b>{escape(one.number)}</b><span>{_marked(one.meaning)}</span></li>"
        for one in numbers
    )
    return f'<ul class="tiles">{items}</ul>'


def _marked(text: str) -> str:
    """HTML of plain text, in which `code` is marked."""
    return _CODE.sub(r"<code>\1</code>", escape(text))


def document(title: str, about: str, sections: Sequence[Section], script: str = "") -> str:
    """Assemble a page.

    Parameters
    ----------
    title, about : str
        Heading, and a line below it, plain text.
    sections : sequence of Section
        Sections of the page, in any order; results are placed first, settings and provenance last.
    script : str
        JavaScript that the sections share.

    Returns
    -------
    str
        HTML of the complete file.
    """
    sections = sorted(sections, key=lambda s: _ORDER.index(s.name) if s.name in _ORDER else 0)
    links = "".join(f'<li><a href="#{escape(s.name)}">{escape(s.title)}</a></li>' for s in sections)
    bodies = "\n".join(
        f'<section id="{escape(s.name)}" aria-labelledby="{escape(s.name)}-title">'
        f'<h2 id="{escape(s.name)}-title">{escape(s.title)}</h2>\n{s.body}\n</section>'
        for s in sections
    )
    loaded = f"<script>{script}</script>\n" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n{loaded}</head>\n<body>\n"
        f"<header><h1>{escape(title)}</h1>{paragraph(about)}"
        f'<nav aria-label="Contents"><ul>{links}</ul></nav></header>\n'
        f"<main>\n{bodies}\n</main>\n</body>\n</html>\n"
    )


# Captions of figures, by name, in their order.
CAPTIONS = {
    "trial": "The trial at a glance: what the cameras see where the whisker is bent most, signals "
    "and contact over time, the trajectory in the space of signals, and estimated against known "
    "coordinates.",
    "signals": "All six signals over time.",
    "estimates": "Estimated against known coordinates of the contact in the whisker's frame.",
    "contact_places": "Contacts about the resting whisker and in the laboratory; grey: the object, "
    "where it is known; dashed: what was fitted.",
    "contour": "Contact points in the laboratory from three sides.",
    "whisker": "The resting whisker in its own frame, and how thick it is.",
    "signal_space": "All stable contacts of the whisker, coloured by their signals.",
    "contact_surfaces": "Contacts of equal r, θ and φ, and their position among all contacts in "
    "the space of three signals.",
    "sensitivity": "How the contact moves when a signal changes.",
    "solid": "A slice of the solid of all contacts.",
    "critical_cones": "Critical cones by curvature and taper.",
    "verdicts": "Verdicts by triplet and region.",
    "resolution": "Share of ambiguous contacts by how finely signals are measured.",
    "array": "The array and the face.",
}
_WITNESS = "witness_"


def figure_sections(pictures: Mapping[str, bytes]) -> list[Section]:
    """Embed figures."""
    known = [name for name in CAPTIONS if name in pictures]
    order = [*known, *(name for name in pictures if name not in CAPTIONS)]
    first = [name for name in ("contour", *order[:1]) if name in pictures][:1]
    parts = [_figure(name, pictures[name]) for name in order if name not in first]
    out = [Section("picture", "At a glance", _figure(name, pictures[name])) for name in first]
    return [*out, Section("figures", "Figures", "\n".join(parts))] if parts else out


def _figure(name: str, png: bytes) -> str:
    caption = CAPTIONS.get(name, name.replace("_", " "))
    if name.startswith(_WITNESS):
        triplet = ", ".join(name.removeprefix(_WITNESS).split("_"))
        caption = f"Two contacts with the same ({triplet}), which thus do not locate contacts."
    data = b64encode(png).decode("ascii")
    text = escape(caption)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{text}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def movies_section(movies: Sequence[Path], folder: Path, room: int) -> Section:
    """Embed movies as far as there is room, and link the others."""
    parts = []
    for path in movies:
        name = escape(path.name)
        # Base64 takes four characters for three bytes.
        size = 4 * (path.stat().st_size // 3 + 1)
        if size > room:
            where = quote(Path(os.path.relpath(path, folder)).as_posix())
            text = f"{path.stat().st_size / 1e6:.1f} MB: too large for the page; the file is next"
            parts.append(f'<p><a href="{escape(where)}">{name}</a></p>')
            parts.append(paragraph(f"{text} to it.", "note"))
            continue
        room -= size
        data = b64encode(path.read_bytes()).decode("ascii")
        parts.append(
            f'<figure><video controls muted preload="metadata" aria-label="{name}" '
            f'src="data:video/mp4;base64,{data}"></video><figcaption>{name}</figcaption></figure>'
        )
    return Section("movies", "Movies", "\n".join(parts))


_LEAST = 1e-5  # smallest value shown, in the display unit


def shown_value(name: str, value: float, digits: int = 3) -> str:
    """Write an SI value with its unit."""
    if not np.isfinite(value):
        return "–"
    factor, unit = shown_unit(name, value)
    number = value * factor
    # Smaller values are due to rounding.
    if 0.0 < abs(number) < _LEAST:
        return f"below {_LEAST:.5f}{'' if unit in ('', '°') else ' '}{unit}"
    text = f"{number:.0f}" if abs(number) >= 10.0**digits else f"{number:.{digits}g}"
    return f"{text.replace('-', '−')}{'' if unit in ('', '°') else ' '}{unit}"


def with_sigma(name: str, value: float, sigma: float) -> tuple[str, str]:
    """Format an SI value and its standard deviation, with decimals set by the latter."""
    factor, unit = shown_unit(name, value)
    spread = sigma * factor
    if not np.isfinite(value * spread) or spread < _LEAST:
        return shown_value(name, value, 4), shown_value(name, sigma, 2)
    decimals = int(np.clip(1.0 - np.floor(np.log10(spread)), 0, 5))
    numbers = (f"{x:z.{decimals}f}" for x in (value * factor, spread))
    end = f"{'' if unit in ('', '°') else ' '}{unit}"
    first, second = (f"{number.replace('-', '−')}{end}" for number in numbers)
    return first, second


_PACKAGES = ("numpy", "scipy", "numba", "xarray", "h5netcdf", "matplotlib", "av", "plotly")
_EPOCH = "SOURCE_DATE_EPOCH"


def provenance_section(command: Sequence[str], inputs: Sequence[Path], seed: int | None) -> Section:
    """Section with what reproduces a page; ``SOURCE_DATE_EPOCH`` is its date, UTC, if set."""
    drawn = "none: no random numbers are used"
    if seed is not None:
        drawn = f"{seed}, for the predicted errors"
    made = _date().strftime("%Y-%m-%d %H:%M:%S UTC")
    rows = [("command", shlex.join(command)), ("made", made), ("seed", drawn)]
    files = []
    for path in inputs:
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        size = f"{path.stat().st_size / 1e6:.3f} MB"
        files.append((str(path), size, f"SHA-256 {digest}"))
    body = table(rows) + table(files, caption="Files that were read")
    return Section("provenance", "Provenance", body + table(_versions(), caption="Versions"))


def _versions() -> list[tuple[str, str]]:
    rows = [
        ("vibrissa", __version__),
        ("Python", f"{platform.python_version()}, {platform.system()} {platform.machine()}"),
    ]
    for name in _PACKAGES:
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            rows.append((name, "not installed"))
    return rows


def _date() -> datetime:
    if (seconds := os.environ.get(_EPOCH)) is None:
        return datetime.now(UTC)
    try:
        return datetime.fromtimestamp(int(seconds), UTC)
    except (ValueError, OverflowError, OSError) as fault:
        raise ValueError(
            f"{_EPOCH} is {seconds!r}; whole seconds since 1970 are needed, as of `date +%s`"
        ) from fault
