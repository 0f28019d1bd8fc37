"""Which code found a result: versions, and a hash of the sources that numbers come from."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

from vibrissa._version import __version__

COMPUTING = (
    "quantities.py",
    "quantities.csv",
    "sketch.py",
    "status.py",
    "whisker",
    "io",
    "rod",
    "signals",
    "numerics",
    "objects",
    "sensors",
    "contacts",
    "identifiability",
    "paper",
    "sweeps/population.py",
    "sweeps/study.py",
    "sweeps/tasks.py",
)
"""Of the package, what results hang on."""
_LIBRARIES = ("numpy", "scipy", "numba")


@cache
def origin() -> str:
    """Say which code this process computes with."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for name in COMPUTING:
        path = package / name
        for source in sorted(path.glob("*.py")) if path.is_dir() else [path]:
            digest.update(source.read_bytes())
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return f"vibrissa {__version__} (sources {digest.hexdigest()[:12]}), {libraries}"


def own(said: str) -> str:
    """Tell the part of an origin that is vibrissa's."""
    return said.partition(",")[0]
