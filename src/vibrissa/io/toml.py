"""Files of settings, TOML: faults are reported in a line that names the file."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.paths import check_readable

# So much of a value that is wrong is quoted.
_QUOTED = 60

_THREE_NUMBERS = "three numbers are needed"


def read_toml(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a TOML file."""
    path = check_readable(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        byte = f"byte {error.start} is {error.object[error.start]:#04x}"
        raise ValueError(f"{path} is not TOML in UTF-8: {byte}") from None
    with in_file(path):
        return parsed_toml(text)


def parsed_toml(text: str) -> dict[str, Any]:
    """Read TOML."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"it is not TOML: {error}") from None
    except RecursionError:
        raise ValueError(
            "it is not a settings file of vibrissa: its values are nested too deeply"
        ) from None


@contextmanager
def in_file(path: object) -> Iterator[None]:
    """Name the file in what is raised because of its content."""
    try:
        yield
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error


def number_array(
    value: Any, name: str, needed: str = "numbers, or lists of as many each, are needed"
) -> NDArray[np.float64]:
    """Read a number, or lists of them, from a value of TOML."""
    try:
        if _numeric(value):
            return np.array(value, dtype=np.float64)
    except (ValueError, OverflowError):  # lists of different lengths, or 1 with 400 zeros
        pass
    raise ValueError(f"{name} is {quoted(value)}; {needed}")


def check_keys(table: Mapping[str, Any], allowed: set[str], where: str) -> None:
    """Raise a ValueError if a table has an unknown key."""
    unknown = sorted(set(table) - allowed)
    if unknown:
        raise ValueError(
            f"{where} has {', '.join(unknown)}; known are {', '.join(sorted(allowed))}"
        )


def subtable(table: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Table [name] of a table; empty by default."""
    value = table.get(name, {})
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} is {quoted(value)}; it is written as a table, [{name}]")
    return value


def one_number(table: Mapping[str, Any], name: str, default: float) -> float:
    """Number of a table, finite if it is there."""
    value = table.get(name, default)
    array = number_array(value, name, "a number is needed")
    if array.ndim or (name in table and not np.isfinite(array)):
        raise ValueError(f"{name} is {quoted(value)}; a number is needed")
    return float(array)


def three_numbers(table: Mapping[str, Any], name: str, default: Any = None) -> NDArray[np.float64]:
    """Three numbers of a table."""
    value = table.get(name, default)
    array = number_array(list(value) if isinstance(value, tuple) else value, name, _THREE_NUMBERS)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} is {quoted(value)}; {_THREE_NUMBERS}")
    return array


def quoted(value: object) -> str:
    """Quote the beginning of a value."""
    try:
        text = repr(value)
    except ValueError:  # a whole number of more digits than Python writes
        text = "a number of thousands of digits"
    return text if len(text) <= _QUOTED else text[:_QUOTED] + "…"


def _numeric(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)
