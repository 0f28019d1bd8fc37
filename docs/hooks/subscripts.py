"""Symbols such as F_x with their subscripts set low, in text but not in code or formulas."""

import re
from typing import Any

_KEPT = re.compile(
    r"(<(code|pre|math|script|style|svg)\b.*?</\2>|<[^>]*>)", re.DOTALL | re.IGNORECASE
)
_SYMBOL = re.compile(r"(?<![A-Za-z0-9_])([A-Za-zα-ωΑ-Ωµ]|EI)_([A-Za-z0-9]{1,8})(?![A-Za-z0-9_])")


def on_page_content(content: str, **_: Any) -> str:
    """Set subscripts in a page.

    Parameters
    ----------
    content : str
        The page, HTML.
    **_ : Any
        Other arguments of the event.

    Returns
    -------
    str
        The page with ``<sub>``.
    """
    out, end = [], 0
    for kept in _KEPT.finditer(content):
        out += [_SYMBOL.sub(r"\1<sub>\2</sub>", content[end : kept.start()]), kept[0]]
        end = kept.end()
    return "".join([*out, _SYMBOL.sub(r"\1<sub>\2</sub>", content[end:])])
