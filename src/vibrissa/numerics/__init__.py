"""Support for compiled kernels: array types, compilation, threads, small linear systems.

What needs Numba or xarray is imported when it is first used, so that array types cost nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from vibrissa.numerics.arrays import AnyArray, Array, IntArray, Vector
from vibrissa.numerics.threads import share_out, threads

if TYPE_CHECKING:
    from vibrissa.numerics.algebra import cholesky, norm3, solve, solve3, wrapped
    from vibrissa.numerics.compiled import (
        copy,
        inlined,
        inlined_rigorous,
        kernel,
        rigorous,
        specialised,
    )
    from vibrissa.numerics.device import Translation, check_device
    from vibrissa.numerics.quantiles import contact_weights, weighted_quantile

__all__ = [
    "AnyArray",
    "Array",
    "IntArray",
    "Translation",
    "Vector",
    "check_device",
    "cholesky",
    "contact_weights",
    "copy",
    "inlined",
    "inlined_rigorous",
    "kernel",
    "norm3",
    "rigorous",
    "share_out",
    "solve",
    "solve3",
    "specialised",
    "threads",
    "weighted_quantile",
    "wrapped",
]

_HOMES = {
    "algebra": ("cholesky", "norm3", "solve", "solve3", "wrapped"),
    "compiled": ("copy", "inlined", "inlined_rigorous", "kernel", "rigorous", "specialised"),
    "device": ("Translation", "check_device"),
    "quantiles": ("contact_weights", "weighted_quantile"),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'vibrissa.numerics' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"vibrissa.numerics.{_HOME[name]}"), name)
    globals()[name] = value
    return value
