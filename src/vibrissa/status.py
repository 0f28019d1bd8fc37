"""Statuses of loads and estimates, as sentences with advice.

A load without equilibrium, or signals that no contact explains, result in a row with a status, so
that one bad case does not stop a grid. The numbers are stored in datasets as CF flags and never
change their meaning: 0-9 for a load with a solution, 10-19 for a load without, 20-29 for estimates.
"""

from __future__ import annotations

import enum
from collections import Counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "Event",
    "Status",
    "counted",
    "describe",
    "flag_attributes",
    "is_ok",
    "names",
]
__dir__ = __all__.copy


class Status(enum.IntEnum):
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

    OK = 0, "The object touches the side of the whisker."
    TIP_CONTACT = (
        1,
        "The object touches the very tip of the whisker, and the force is normal to the object.",
    )
    NO_CONTACT = 2, "The object does not reach the whisker, so force and moment are zero."
    BEYOND_FOLD = (
        10,
        "The whisker has slipped off: the load lies beyond the fold that ends the stable branch.",
        "Move the object back toward the resting whisker; without friction a whisker of this "
        "shape and taper holds no contact there.",
    )
    BEYOND_TIP = (
        11,
        "The load lies beyond the tip: the whisker is too short for this contact.",
        "Move the object toward the base, or check the whisker's length and the unit of the "
        "points.",
    )
    TOO_PROXIMAL = (
        12,
        "The contact would lie closer to the base than the smallest arc length that is considered.",
        "Lower the smallest arc length (0.3 of the whisker's length by default), or move the "
        "object toward the tip.",
    )
    NOT_CONVERGED = (
        13,
        "The solver did not converge; nothing is known about this load.",
        "This is a defect of vibrissa: please report it with the whisker and the load.",
    )
    MISSING = (
        14,
        "The input of this row is missing or not finite.",
        "Check the row for NaN, for example frames in which the whisker was not tracked.",
    )
    TOO_STRONG = (
        15,
        "The force is so strong that it winds the whisker up in waves too short to compute.",
        "Check the force's unit (N), and the whisker's radius: forces scale with its fourth power.",
    )
    UNIQUE = 20, "Exactly one contact of this whisker explains the signals."
    AMBIGUOUS = (
        21,
        "Several contacts of this whisker explain the signals, or are probable with their noise.",
        "The candidates are listed, with noise by their probability: add a signal, or choose by "
        "continuity with the frames around.",
    )
    NOT_FRICTIONLESS = (
        22,
        "No frictionless contact on the side of this whisker explains the signals.",
        "Check the whisker's shape, taper and stiffness and the sensor's offset; with friction, "
        "estimate from all six signals.",
    )
    OUTSIDE_MAP = (
        23,
        "The signals lie outside the map.",
        "Simulate the map over a wider domain, or check the unit and frame of the signals.",
    )
    DEGENERATE = (
        24,
        "The signals do not determine a contact: force and moment are too small, or on this "
        "whisker contacts can move without changing these signals.",
        "Leave the row out, or choose other signals.",
    )
    NOT_ONE_CONTACT = (
        25,
        "No single contact of this whisker explains force and moment together.",
        "Check the whisker's shape, taper and stiffness and the sensor's offset and noise; perhaps "
        "more than one object touches.",
    )
    APPROXIMATE = (
        26,
        "A look-up table or network gave this contact, and cannot show whether others explain the "
        "signals too.",
    )
    UNDERDETERMINED = (
        27,
        "Fewer than three signals: a whole curve or surface of contacts explains them.",
        "The candidates are samples of it, and the covariance spans it: add a signal, or filter "
        "over time while the base moves.",
    )

    NOT_FELT = (
        28,
        "No contact is measured: force and moment are within their noise, so that nothing touches "
        "the whisker, or too lightly to be distinguished from nothing.",
    )
    OUTSIDE_PRIOR = (
        29,
        "Contacts of this whisker explain the signals, but none of those that are possible "
        "according to the prior.",
        "Widen the prior's region or limits of force, or check the sensor's axes and offset.",
    )

    def __new__(cls, code: int, explanation: str = "", advice: str = "") -> Status:
        """Create a member; the defaults let type checkers see that ``Status(code)`` is a lookup."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.explanation, member.advice, member.ok = explanation, advice, not advice
        return member

    def __str__(self) -> str:
        return f"{self.explanation} {self.advice}".rstrip()


class Event(enum.IntEnum):
    """Event of a contact: its onset, its loss, or a slip of its point."""

    NONE = 0
    ONSET = 1
    LOSS = 2
    SLIP = 3


_OK_CODES = np.array([status for status in Status if status.ok], dtype=np.int8)


def is_ok(codes: ArrayLike) -> NDArray[np.bool_]:
    """Determine which rows can be used as they are.

    Parameters
    ----------
    codes : array_like of int, any shape
        Numbers of :class:`Status`.

    Returns
    -------
    ndarray of bool, the shape of ``codes``
        True where :attr:`Status.ok` is true.
    """
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
    unknown = [number for number in numbers.tolist() if number not in known]
    if unknown:
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
    """Return the dataset attributes that describe the numbers of :class:`Status`, as CF flags.

    Parameters
    ----------
    kind : type
        :class:`Status`, or :class:`Event`.

    Returns
    -------
    dict
        ``flag_values`` (int8) and ``flag_meanings`` (words separated by spaces, in the same order).
    """
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
