"""Statuses of loads and estimates; `status.csv` has their sentences and advice, a row for each.

A load without equilibrium, or signals that no contact explains, result in a row with a status, so
that one bad case does not stop a grid. The numbers are stored in datasets as CF flags and never
change their meaning: 0-9 for a load with a solution, 10-19 for a load without, 20-29 for estimates.
"""

from __future__ import annotations

import csv
import enum
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Event", "Status", "counted", "describe", "names"]
__dir__ = __all__.copy


class _OneCode(enum.EnumMeta):
    """Class of an enumeration that names the functions for arrays if it is called with one."""

    def __call__(cls, value: Any, *rest: Any, **options: Any) -> Any:
        if np.ndim(value):
            raise TypeError(
                f"{cls.__name__}() takes one number, not an array of shape {np.shape(value)}; "
                "vibrissa.status.names and describe take arrays"
            )
        return super().__call__(value, *rest, **options)


class Status(enum.IntEnum, metaclass=_OneCode):
    """Outcome of one load or one estimate.

    ``str(status)`` is a sentence of explanation, followed by one of advice if there is any.

    Attributes
    ----------
    explanation : str
        Sentence that states what happened.
    advice : str
        Sentence that states what to do; empty if nothing is to be done.
    ok : bool
        Whether the row can be used as it is, so that there is no advice.
    """

    explanation: str
    advice: str
    ok: bool

    OK = 0
    TIP_CONTACT = 1
    NO_CONTACT = 2
    BEYOND_FOLD = 10
    BEYOND_TIP = 11
    TOO_PROXIMAL = 12
    NOT_CONVERGED = 13
    MISSING = 14
    TOO_STRONG = 15
    UNIQUE = 20
    AMBIGUOUS = 21
    NOT_FRICTIONLESS = 22
    OUTSIDE_MAP = 23
    DEGENERATE = 24
    NOT_ONE_CONTACT = 25
    APPROXIMATE = 26
    UNDERDETERMINED = 27
    NOT_FELT = 28
    OUTSIDE_PRIOR = 29

    def __str__(self) -> str:
        return f"{self.explanation} {self.advice}".rstrip()


for _row in csv.DictReader(Path(__file__).with_suffix(".csv").read_text("utf-8").splitlines()):
    _status = Status[_row["name"]]
    _status.explanation, _status.advice = _row["explanation"], _row["advice"]
    _status.ok = not _status.advice


class Event(enum.IntEnum):
    """Event of a contact: its onset, its loss, or a slip of its point."""

    NONE = 0
    ONSET = 1
    LOSS = 2
    SLIP = 3


_OK_CODES = np.array([status for status in Status if status.ok], dtype=np.int8)


def is_ok(codes: ArrayLike) -> NDArray[np.bool_]:
    """Determine which rows can be used as they are, by their numbers of :class:`Status`."""
    return np.isin(np.asarray(codes), _OK_CODES)


def describe(codes: ArrayLike) -> Counter[str]:
    """Count the statuses of many rows, by their sentences.

    Parameters
    ----------
    codes : array_like of int, any shape
        Numbers of :class:`Status`.

    Returns
    -------
    collections.Counter
        Number of occurrences of each status, by its sentence.

    Raises
    ------
    ValueError
        If a number is not a status.

    Examples
    --------
    >>> for sentence, count in describe([0, 0, 2]).most_common():
    ...     print(count, sentence)
    2 The object touches the side of the whisker.
    1 The object does not reach the whisker, so force and moment are zero.
    """
    numbers, counts = np.unique(np.asarray(codes), return_counts=True)
    known = {int(status) for status in Status}
    if unknown := [number for number in numbers.tolist() if number not in known]:
        raise ValueError(f"{unknown} are not statuses; the statuses are {sorted(known)}.")
    return Counter(
        {
            str(Status(int(number))): count
            for number, count in zip(numbers.tolist(), counts.tolist(), strict=True)
        }
    )


def names(codes: ArrayLike) -> NDArray[np.str_]:
    """Return the names of the statuses of many rows.

    Parameters
    ----------
    codes : array_like of int, any shape
        Numbers of :class:`Status`.

    Returns
    -------
    array of str, same shape
        Name of each status.

    Raises
    ------
    ValueError
        If a number is not a status.

    Examples
    --------
    >>> names([0, 2]).tolist()
    ['OK', 'NO_CONTACT']
    """
    numbers = np.asarray(codes)
    describe(numbers)
    longest = max(len(status.name) for status in Status)
    out = np.empty(numbers.shape, dtype=f"U{longest}")
    for status in Status:
        out[numbers == int(status)] = status.name
    return out


def flag_attributes(kind: type[enum.IntEnum] = Status) -> dict[str, NDArray[np.int8] | str]:
    """Dataset attributes that describe the numbers of a status or an event, as CF flags."""
    return {
        "flag_values": np.array([int(one) for one in kind], dtype=np.int8),
        "flag_meanings": " ".join(one.name.lower() for one in kind),
    }


def counted(codes: ArrayLike) -> str:
    """Summarise the statuses of many rows in a short text.

    Parameters
    ----------
    codes : array_like of int, any shape
        Numbers of :class:`Status`.

    Returns
    -------
    str
        Names and numbers of occurrences, in order of the statuses' numbers.

    Examples
    --------
    >>> counted([0, 0, 2])
    'ok 2, no contact 1'
    """
    texts = (
        f"{Status(code).name.lower().replace('_', ' ')} {count}"
        for code, count in zip(*np.unique(codes, return_counts=True), strict=True)
    )
    return ", ".join(texts) or "none"
