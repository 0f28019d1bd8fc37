"""Whiskers, maps and trials on a page in the browser, to take hold of and turn about.

What turns states into drawings and texts is pure; only the binding imports viser (extra ``view``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vibrissa.viewer.server import Served, Viewer, view, view_stream

__all__ = [
    "Served",
    "Viewer",
    "view",
    "view_stream",
]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module 'vibrissa.viewer' has no attribute {name!r}")
    try:
        from vibrissa.viewer import server
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "vibrissa":
            raise
        raise ModuleNotFoundError(
            "the viewer needs viser: pip install 'vibrissa[view]'", name=error.name
        ) from error
    return getattr(server, name)
