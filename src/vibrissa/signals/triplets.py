"""The twenty triplets of the six signals, and how a choice of signals is written."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from vibrissa.signals.base import SIGNALS

#: All choices of three of the six signals, in canonical order.
TRIPLETS = tuple(combinations(SIGNALS, 3))


def selection(
    signals: str | Sequence[str], least: int = 3, exactly: int | None = None
) -> tuple[str, ...]:
    """Read a choice of signals."""
    given = signals.replace(",", " ").split() if isinstance(signals, str) else list(signals)
    spelt = {name.lower(): name for name in SIGNALS}
    names = [spelt.get(str(name).lower(), name) for name in given]
    unknown = [name for name in names if name not in SIGNALS]
    enough = len(names) >= least if exactly is None else len(names) == exactly
    if unknown or len(set(names)) != len(names) or not enough:
        number = f"at least {least}" if exactly is None else f"exactly {exactly}"
        known = ", ".join(SIGNALS)
        raise ValueError(f"expected {number} different signals of {known}; got {signals!r}")
    return tuple(name for name in SIGNALS if name in names)
