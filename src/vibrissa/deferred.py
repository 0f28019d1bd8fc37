"""Libraries that take long to import, imported where they are first used.

xarray brings pandas, and both take longer than finding a contact: a stream or a single solution
does without them.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr
    from scipy import interpolate, linalg, ndimage, optimize, signal, spatial, special, stats
    from scipy.sparse import linalg as sparse_linalg
    from scipy.spatial import transform
else:

    class _Deferred:
        """A module that is imported when something of it is asked for."""

        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> object:
            return getattr(import_module(self._name), attribute)

    xr = _Deferred("xarray")
    interpolate, linalg, ndimage, optimize = (
        _Deferred(f"scipy.{name}") for name in ("interpolate", "linalg", "ndimage", "optimize")
    )
    signal, spatial, special, stats = (
        _Deferred(f"scipy.{name}") for name in ("signal", "spatial", "special", "stats")
    )
    sparse_linalg = _Deferred("scipy.sparse.linalg")
    transform = _Deferred("scipy.spatial.transform")

__all__ = [
    "interpolate",
    "linalg",
    "ndimage",
    "optimize",
    "signal",
    "sparse_linalg",
    "spatial",
    "special",
    "stats",
    "transform",
    "xr",
]
