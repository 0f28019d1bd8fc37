"""Interactive viewer of whiskers, maps and trials in the browser.

Drawings and texts are computed from states by pure functions; only the binding to the page imports
viser (extra ``view``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vibrissa.viewer.server import Served, Viewer, view, view_stream

__all__ = ["Served", "Viewer", "view", "view_stream"]
__dir__ = __all__.copy


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
