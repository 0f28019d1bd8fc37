"""Numbers and figures of a run on a page of the documentation: blocks between marks.

A block begins with ``<!-- NAME -->`` and ends with ``<!-- end -->``, each on a line of its own;
what is around the blocks is written by hand.
"""

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

WIDTH = 1200

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_TAIL = "<!-- end -->\n"


def put(pages: Path | Sequence[Path], blocks: Mapping[str, str]) -> None:
    """Put texts between their marks; each mark must be once on one of the pages."""
    files = [pages] if isinstance(pages, Path) else list(pages)
    texts = [page.read_text(encoding="utf-8") for page in files]
    for name, block in blocks.items():
        head = f"<!-- {name} -->\n"
        marked = [i for i, text in enumerate(texts) for _ in range(text.count(head))]
        if len(marked) != 1:
            names = ", ".join(map(str, files))
            raise ValueError(f"{names}: {len(marked)} marks {head.strip()}; one is needed")
        before, rest = texts[marked[0]].split(head)
        texts[marked[0]] = f"{before}{head}\n{block}\n\n{_TAIL}{rest.split(_TAIL, 1)[1]}"
    for page, text in zip(files, texts, strict=True):
        page.write_text(text, encoding="utf-8")


def save(figure: Figure, path: Path) -> None:
    """Write a figure for the screen, in 256 colours."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    image = Image.open(drawn).convert("RGB")
    height = round(image.height * WIDTH / image.width)
    small = image.resize((WIDTH, height), Image.Resampling.LANCZOS)
    small.quantize(256, Image.Quantize.MEDIANCUT).save(path, optimize=True)


def table(head: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """Markdown; the first columns are text, the others numbers."""
    sides = [":---"] * texts + ["---:"] * (len(head) - texts)
    lines = [head, sides, *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def power(value: float) -> str:
    """Two digits and a power of ten: 1.6 × 10⁻⁷."""
    if not value:
        return "0"
    digits, exponent = f"{value:.1e}".split("e")
    return f"{digits} × 10{str(int(exponent)).translate(_RAISED)}"


def few(value: float, digits: int = 2) -> str:
    """So many digits, without powers of ten."""
    if not np.isfinite(value):
        return "–"
    places = max(digits - 1 - int(np.floor(np.log10(abs(value)))), 0) if value else 0
    rounded = round(value, digits - 1 - int(np.floor(np.log10(abs(value))))) if value else 0.0
    return f"{rounded:,.{places}f}".replace("-", "−")


def percent(share: float, digits: int = 2) -> str:
    return f"{few(100 * share, digits)} %"
