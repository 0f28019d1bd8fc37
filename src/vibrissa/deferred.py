"""Deferred imports of slow libraries, and of package members, at first use.

xarray imports pandas, and both take longer than finding a contact, so streams and single solutions
avoid them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import xarray as xr
    from scipy import (
        interpolate,
        linalg,
        ndimage,
        optimize,
        signal,
        sparse,
        spatial,
        special,
        stats,
    )
    from scipy.sparse import linalg as sparse_linalg
    from scipy.spatial import transform
else:

    class _Deferred:
        """A module that is imported on first access to an attribute."""

        def __init__(self, name: str) -> None:
            self._name = name

        def __getattr__(self, attribute: str) -> object:
            return getattr(import_module(self._name), attribute)

    xr = _Deferred("xarray")
    interpolate, linalg, ndimage, optimize = (
        _Deferred(f"scipy.{name}") for name in ("interpolate", "linalg", "ndimage", "optimize")
    )
    signal, sparse, spatial, special, stats = (
        _Deferred(f"scipy.{name}") for name in ("signal", "sparse", "spatial", "special", "stats")
    )
    sparse_linalg = _Deferred("scipy.sparse.linalg")
    transform = _Deferred("scipy.spatial.transform")


def names_from(
    package: str, homes: Mapping[str, str], modules: Collection[str] = ()
) -> Callable[[str], object]:
    """Create the ``__getattr__`` of a package from the modules in which its names are defined."""
    home = {name: module for module, names in homes.items() for name in names.split()}

    def attribute(name: str) -> object:
        if name in home:
            value = getattr(import_module(f"{package}.{home[name]}"), name)
            setattr(sys.modules[package], name, value)
            return value
        if name in modules:
            return import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return attribute


__all__ = [
    "interpolate",
    "linalg",
    "names_from",
    "ndimage",
    "optimize",
    "signal",
    "sparse",
    "sparse_linalg",
    "spatial",
    "special",
    "stats",
    "transform",
    "xr",
]
