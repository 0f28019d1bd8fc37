"""Mathematics as MathML, made when the site is built, so that pages need no script to show it."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_BLOCK = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Convert the formulas that Arithmatex has found in a page.

    Parameters
    ----------
    content : str
        The page, HTML.
    **_ : Any
        Other arguments of the event.

    Returns
    -------
    str
        The page with MathML.
    """
    content = _BLOCK.sub(lambda found: convert(html.unescape(found[1]), display="block"), content)
    return _INLINE.sub(lambda found: convert(html.unescape(found[1])), content)
