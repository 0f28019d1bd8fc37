"""What the text of a trial says, value by value, checked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.table import read_text, table_rows
from vibrissa.io.toml import number_array, quoted
from vibrissa.whisker.emergence import base_rotation

Array = NDArray[np.float64]

MM = 1e-3
_THREE = "three numbers are needed"
COLUMNS = ("time", "azimuth", "elevation", "roll", "x", "y", "z")
"""Columns of a table of motion."""


def only(said: Mapping[str, Any], allowed: set[str], where: str) -> None:
    """Raise a ValueError if something is said that is not known."""
    unknown = sorted(set(said) - allowed)
    if unknown:
        raise ValueError(
            f"{where} has {', '.join(unknown)}; known are {', '.join(sorted(allowed))}"
        )


def subtable(said: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Give what is said in a table, [name]."""
    table = said.get(name, {})
    if not isinstance(table, Mapping):
        raise ValueError(f"{name} is {quoted(table)}; it is written as a table, [{name}]")
    return table


def number(said: Mapping[str, Any], name: str, default: float) -> float:
    """Give a number, finite if it is said."""
    value = said.get(name, default)
    array = number_array(value, name, "a number is needed")
    if array.ndim or (name in said and not np.isfinite(array)):
        raise ValueError(f"{name} is {quoted(value)}; a number is needed")
    return float(array)


def three(said: Mapping[str, Any], name: str, default: Any = None) -> Array:
    """Give three numbers."""
    value = said.get(name, default)
    array = number_array(list(value) if isinstance(value, tuple) else value, name, _THREE)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} is {quoted(value)}; {_THREE}")
    return array


def turned(said: Mapping[str, Any]) -> Array:
    """Give the rotation that angles say."""
    return base_rotation(*np.radians(three(said, "angles", (0.0, 0.0, 0.0))))


def columns_of(path: Path) -> dict[str, Array]:
    """Columns of a table of motion; those that are missing are zero, but for the time."""
    rows = list(table_rows(read_text(path)))
    names = rows[0][1] if rows else []
    unknown = [name for name in names if name not in COLUMNS]
    if unknown or "time" not in names or len(rows) < 3:
        raise ValueError(
            f"{path} has columns {', '.join(names) or 'none'} and {max(len(rows) - 1, 0)} rows; "
            f"time and any of {', '.join(COLUMNS[1:])} in two rows or more are needed"
        )
    try:
        values = np.array([cells for _, cells in rows[1:]], dtype=np.float64)
    except ValueError:
        raise ValueError(
            f"{path} has a cell that is no number, or rows of different length"
        ) from None
    columns = dict(zip(names, values.T, strict=True))
    if not (np.isfinite(values).all() and (np.diff(columns["time"]) > 0.0).all()):
        raise ValueError(f"{path} has a number that is missing, or time that does not rise")
    return {name: columns.get(name, np.zeros(len(values))) for name in COLUMNS}
