"""Files of settings, TOML: what is wrong with one is said in a line that names it."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.io.paths import check_readable

# So much of a value that is wrong is quoted.
_QUOTED = 60


def read_toml(path: str | PathLike[str]) -> dict[str, Any]:
    """Read a TOML file.

    Parameters
    ----------
    path : str or path
        File in UTF-8.

    Returns
    -------
    dict
        Values by key.
    """
    path = check_readable(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        byte = f"byte {error.start} is {error.object[error.start]:#04x}"
        raise ValueError(f"{path} is no TOML in UTF-8: {byte}") from None
    with in_file(path):
        return parsed_toml(text)


def parsed_toml(text: str) -> dict[str, Any]:
    """Read TOML.

    Parameters
    ----------
    text : str
        Text of a TOML file.

    Returns
    -------
    dict
        Values by key.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"it is no TOML: {error}") from None
    except RecursionError:
        raise ValueError("it is no TOML of ours: its values are nested too deeply") from None


@contextmanager
def in_file(path: object) -> Iterator[None]:
    """Name the file in what is raised because of its content.

    Parameters
    ----------
    path : object
        File, or the part of it that is read.

    Yields
    ------
    None
        The context in which it is read.
    """
    try:
        yield
    except ValueError as error:
        if str(path) in str(error):
            raise
        raise ValueError(f"{path}: {error}") from error


def number_array(
    value: Any, name: str, needed: str = "numbers, or lists of as many each, are needed"
) -> NDArray[np.float64]:
    """Read a number, or lists of them, from a value of TOML.

    Parameters
    ----------
    value : object
        Value as TOML has it.
    name : str
        Name of the value, for messages.
    needed : str
        Sentence on what is needed, for messages.

    Returns
    -------
    array
        Numbers in as many dimensions as the lists have.
    """
    try:
        if _numeric(value):
            return np.array(value, dtype=np.float64)
    except (ValueError, OverflowError):  # lists of different lengths, or 1 with 400 zeros
        pass
    raise ValueError(f"{name} is {quoted(value)}; {needed}")


def quoted(value: object) -> str:
    """Quote the beginning of a value.

    Parameters
    ----------
    value : object
        Value of any type.

    Returns
    -------
    str
        Text of at most some sixty characters.
    """
    try:
        text = repr(value)
    except ValueError:  # a whole number of more digits than Python writes
        text = "a number of thousands of digits"
    return text if len(text) <= _QUOTED else text[:_QUOTED] + "…"


def _numeric(value: Any) -> bool:
    if isinstance(value, list):
        return all(map(_numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)
