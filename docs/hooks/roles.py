"""Links in docstrings: what Sphinx writes as a role becomes a reference to the API pages."""

import re
from typing import Any

_ROLE = re.compile(
    r":(?:class|func|meth|attr|data|mod|exc):<code>(~?)([\w.]+)</code>|:doc:<code>(\w+)</code>"
)


def _linked(found: re.Match[str]) -> str:
    short, name, page = found.groups()
    if page:
        return f"<em>{page}</em>"
    shown = name.rpartition(".")[2] if short else name
    return f'<autoref optional identifier="{name}"><code>{shown}</code></autoref>'


def on_page_content(content: str, **_: Any) -> str:
    """Turn the roles of a page into references, plain where there is no such name.

    Parameters
    ----------
    content : str
        The page, HTML.
    **_ : Any
        Other arguments of the event.

    Returns
    -------
    str
        The page with references.
    """
    return _ROLE.sub(_linked, content)
