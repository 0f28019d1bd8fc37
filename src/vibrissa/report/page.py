"""The page itself: sections, tables and the frame about them, as HTML.

Plain text becomes HTML here and nowhere else; whoever makes a body by hand escapes what is in it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import NamedTuple

_POLICY = (
    "default-src 'none'; img-src data: blob:; media-src data:; style-src 'unsafe-inline'; "
    # The library that draws in 3D compiles functions.
    "script-src 'unsafe-inline' 'unsafe-eval'"
)
"""What the page may load: only what is in it."""

# Figures are those of the paper, dark on white, and the page is white as they are: on a dark one
# they would glare.
_STYLE = """
:root { color-scheme: only light; --ink: #1b1b1b; --paper: #ffffff; --soft: #5c5c5c;
  --line: #d5d0ca; --band: #f6f3ef; --link: #6b3d2e; }
body { margin: 0 auto; padding: 1.5rem; max-width: 70rem; color: var(--ink);
  background: var(--paper); font: 16px/1.5 system-ui, sans-serif; }
a { color: var(--link); }
h1 { margin: 0; font-size: 1.7rem; }
h2 { margin: 2.5rem 0 0.6rem; font-size: 1.25rem; border-bottom: 1px solid var(--line); }
header p, figcaption, .note { color: var(--soft); }
nav ul { padding: 0; display: flex; flex-wrap: wrap; gap: 0.3rem 1.2rem; list-style: none; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 0.8rem 0; font-size: 0.92rem; }
caption { text-align: left; font-weight: 600; padding: 0.2rem 0; white-space: nowrap; }
th, td { padding: 0.15rem 1.1rem 0.15rem 0.3rem; text-align: left; vertical-align: top; }
thead th { border-bottom: 2px solid var(--line); }
tbody th { font-weight: 500; }
.data tbody tr:nth-child(even) { background: var(--band); }
.facts td { overflow-wrap: anywhere; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
code { overflow-wrap: anywhere; font-size: 0.92em; }
figure { margin: 1.2rem 0; }
figure img, video { display: block; max-width: 100%; height: auto; }
svg { max-width: 100%; height: auto; }
.space { height: 34rem; overflow: hidden; }
@media (max-width: 44rem) { figure { overflow-x: auto; } figure img { max-width: none;
  width: 44rem; } caption { white-space: normal; } }
@media print { nav, .space { display: none; } }
"""


_CODE = re.compile(r"`([^`]+)`")


class Section(NamedTuple):
    """A part of the page.

    Attributes
    ----------
    name : str
        Within the page's address; letters, digits and hyphens.
    title : str
        Plain text.
    body : str
        HTML.
    """

    name: str
    title: str
    body: str


def table(
    rows: Iterable[Sequence[str]],
    heading: Sequence[str] = (),
    caption: str = "",
    note: str = "",
) -> str:
    """Lay out a table; the first column names the rows, and under a heading others are numbers.

    Parameters
    ----------
    rows : iterable of sequence of str
        Plain text.
    heading : sequence of str
        Of the columns; none: names and what belongs to them.
    caption, note : str
        Plain text above and below.

    Returns
    -------
    str
        HTML.
    """
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
    """Write a paragraph."""
    named = f' class="{kind}"' if kind else ""
    told = _CODE.sub(r"<code>\1</code>", escape(text))
    return f"<p{named}>{told}</p>"


def document(title: str, about: str, sections: Sequence[Section], script: str = "") -> str:
    """Put a page together.

    Parameters
    ----------
    title, about : str
        Plain text: its heading, and a line below.
    sections : sequence of Section
        In their order.
    script : str
        JavaScript that sections need, once.

    Returns
    -------
    str
        HTML, the whole file.
    """
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
