"""Figures and movies inside the page."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from urllib.parse import quote

from vibrissa.report.page import Section, paragraph

CAPTIONS = {
    "trial": "The trial at a glance: what the cameras see where the whisker is bent most, signals "
    "and contact over time, the way of the signals through the solids of all contacts, and "
    "estimated against known coordinates.",
    "signals": "All six signals over time.",
    "estimates": "Estimated against known coordinates of the contact in the whisker's frame.",
    "contact_places": "Contacts about the resting whisker and in the laboratory; grey: the object, "
    "where it is known; dashed: what was fitted.",
    "contour": "Contact points in the laboratory from three sides.",
    "whisker": "The resting whisker in its own frame, and how thick it is.",
    "signal_space": "All contacts that the whisker can hold, coloured by what they feel like.",
    "contact_surfaces": "Contacts of equal r, θ and φ, and where they lie among all "
    "contacts in the space of three signals.",
    "sensitivity": "How the contact moves when a signal changes.",
    "solid": "A slice of the solid of all contacts.",
    "critical_cones": "Critical cones by curvature and taper.",
    "verdicts": "Verdicts by triplet and region.",
    "resolution": "Share of ambiguous contacts by how finely signals are measured.",
    "array": "The array and the face.",
}
"""What figures show, by name, in the order in which they come."""

_WITNESS = "witness_"


def figure_sections(pictures: Mapping[str, bytes]) -> Section:
    """Embed figures.

    Parameters
    ----------
    pictures : mapping of str to bytes
        PNG by name of the figure.

    Returns
    -------
    Section
        All of them, with captions.
    """
    # What tells most comes first.
    known = [name for name in CAPTIONS if name in pictures]
    order = [*known, *(name for name in pictures if name not in CAPTIONS)]
    parts = [_figure(name, pictures[name]) for name in order]
    return Section("figures", "Figures", "\n".join(parts))


def _figure(name: str, png: bytes) -> str:
    said = CAPTIONS.get(name, name.replace("_", " "))
    if name.startswith(_WITNESS):
        triplet = ", ".join(name.removeprefix(_WITNESS).split("_"))
        said = f"Two contacts that feel the same by ({triplet})."
    data = b64encode(png).decode("ascii")
    text = escape(said)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{text}">'
        f"<figcaption>{text}</figcaption></figure>"
    )


def movies_section(movies: Sequence[Path], folder: Path, room: int) -> Section:
    """Embed movies as far as there is room, and link the others.

    Parameters
    ----------
    movies : sequence of Path
        MP4.
    folder : Path
        Of the page, from which links lead.
    room : int
        How many characters they may take.

    Returns
    -------
    Section
        With a player for each that is embedded.
    """
    parts = []
    for path in movies:
        name = escape(path.name)
        # Four characters for three bytes.
        size = 4 * (path.stat().st_size // 3 + 1)
        if size > room:
            parts.append(_link(path, folder))
            continue
        room -= size
        data = b64encode(path.read_bytes()).decode("ascii")
        parts.append(
            f'<figure><video controls muted preload="metadata" aria-label="{name}" '
            f'src="data:video/mp4;base64,{data}"></video><figcaption>{name}</figcaption></figure>'
        )
    return Section("movies", "Movies", "\n".join(parts))


def _link(path: Path, folder: Path) -> str:
    """A link to a movie that is too large to be in the page."""
    where = Path(os.path.relpath(path, folder)).as_posix()
    size = f"{path.stat().st_size / 1e6:.1f} MB"
    told = paragraph(f"{size}: too large to be in the page, it lies beside it.", "note")
    return f'<p><a href="{escape(quote(where))}">{escape(path.name)}</a></p>{told}'
