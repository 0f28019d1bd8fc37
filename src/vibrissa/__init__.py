"""From what a whisker feels at its base to what it touched.

The names here are the public face of the package. Each is imported from its home when it is first
used, so that ``import vibrissa`` takes milliseconds and Numba, SciPy, xarray and Matplotlib load
only when needed.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vibrissa import samples
    from vibrissa.display import show
    from vibrissa.io import load_array, load_whisker
    from vibrissa.mapping import (
        ContactFilter,
        ContactMap,
        Estimate,
        Estimator,
        Prior,
        WrenchEstimate,
        best_triplet,
        critical_cones,
        estimate_from_wrench,
        sensitivity,
        sensitivity_findings,
        uniqueness,
    )
    from vibrissa.rod import Deflection, PegContact, PointContact, PointForce, deflect
    from vibrissa.signals import base_signals
    from vibrissa.status import Status
    from vibrissa.whisker import Whisker, WhiskerArray, whisker_array

__version__ = "0.1.0"

__all__ = [
    "ContactFilter",
    "ContactMap",
    "Deflection",
    "Estimate",
    "Estimator",
    "PegContact",
    "PointContact",
    "PointForce",
    "Prior",
    "Status",
    "Whisker",
    "WhiskerArray",
    "WrenchEstimate",
    "__version__",
    "base_signals",
    "best_triplet",
    "critical_cones",
    "deflect",
    "estimate_from_wrench",
    "load_array",
    "load_whisker",
    "samples",
    "sensitivity",
    "sensitivity_findings",
    "show",
    "uniqueness",
    "whisker_array",
]

_HOMES = {
    "ContactFilter": "vibrissa.mapping",
    "ContactMap": "vibrissa.mapping",
    "Deflection": "vibrissa.rod",
    "Estimate": "vibrissa.mapping",
    "Estimator": "vibrissa.mapping",
    "PegContact": "vibrissa.rod",
    "PointContact": "vibrissa.rod",
    "PointForce": "vibrissa.rod",
    "Prior": "vibrissa.mapping",
    "Status": "vibrissa.status",
    "Whisker": "vibrissa.whisker",
    "WhiskerArray": "vibrissa.whisker",
    "WrenchEstimate": "vibrissa.mapping",
    "base_signals": "vibrissa.signals",
    "best_triplet": "vibrissa.mapping",
    "critical_cones": "vibrissa.mapping",
    "deflect": "vibrissa.rod",
    "estimate_from_wrench": "vibrissa.mapping",
    "load_array": "vibrissa.io",
    "load_whisker": "vibrissa.io",
    "sensitivity": "vibrissa.mapping",
    "sensitivity_findings": "vibrissa.mapping",
    "show": "vibrissa.display",
    "uniqueness": "vibrissa.mapping",
    "whisker_array": "vibrissa.whisker",
}
_MODULES = {"samples"}


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return importlib.import_module(f"vibrissa.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'vibrissa' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
