"""Identity of a whisker on the face: side, row and column.

The rows of large whiskers on a rat's cheek are called A (the uppermost) to E, the columns 1 to 6
from the back to the front. The four hindmost whiskers stand between the rows and have Greek
letters; each counts with the row above it (α, between A and B, with A). They are column 0 here.
Published equations number them 0 or 1, which is dealt with there (`vibrissa.whisker.morphology`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, cast

Side = Literal["left", "right"]

ROWS = "ABCDE"
"""Rows, from the top down."""

GREEK = ("α", "β", "γ", "δ")
"""Whiskers of column 0, in rows A to D."""

_SPELLED = ("alpha", "beta", "gamma", "delta")
_SIDES: dict[str, Side] = {"l": "left", "left": "left", "r": "right", "right": "right"}
_PATTERN = re.compile(
    r"(?:(?P<before>left|right|l|r)[\s_-]*)?"
    r"(?:(?P<row>[a-e])[\s_-]*0*(?P<column>\d)|(?P<greek>" + "|".join((*GREEK, *_SPELLED)) + "))"
    r"(?:[\s_-]*(?P<after>left|right|l|r))?",
)


@dataclass(frozen=True)
class Identity:
    """Name of a whisker in parts.

    Parameters
    ----------
    row : {"A", "B", "C", "D", "E"}
        Row, from the top down.
    column : int
        0 for the Greek whiskers, then 1 to 6 (of some animals 9) from the back to the front.
    side : {"left", "right"} or None
        Side of the animal; None where it is not stated.

    Raises
    ------
    ValueError
        If there is no such row, column or side.
    """

    row: str
    column: int
    side: Side | None = None

    def __post_init__(self) -> None:
        """Check all three."""
        faults = []
        if self.row not in tuple(ROWS):
            faults.append(f"row is {self.row!r}; one of {', '.join(ROWS)} is needed")
        if self.column not in range(10):
            faults.append(f"column is {self.column!r}; a whole number from 0 (Greek) is needed")
        if self.side not in (None, "left", "right"):
            faults.append(f"side is {self.side!r}; left or right is needed")
        if faults:
            raise ValueError("no whisker's name: " + "; ".join(faults))

    @classmethod
    def of(cls, name: str) -> Identity:
        """Read a whisker's name.

        Parameters
        ----------
        name : str
            Row and column such as ``C2``, a Greek letter or its name (``γ``, ``gamma``, also
            ``C0``), with or without a side before or after it: ``LC2``, ``left C2``,
            ``C2_right``. Capitals do not matter.

        Returns
        -------
        Identity

        Raises
        ------
        ValueError
            If it is not a whisker's name.

        Examples
        --------
        >>> Identity.of("left gamma")
        Identity(row='C', column=0, side='left')
        """
        found = _PATTERN.fullmatch(name.strip().lower())
        if found is None or (found["before"] and found["after"]):
            raise ValueError(
                f"{name!r} is not a whisker's name; row and column such as C2, or alpha, beta, "
                "gamma, delta (α, β, γ, δ), after L or R (left, right) where both sides count, are "
                "needed"
            )
        side = found["before"] or found["after"]
        side = _SIDES[side] if side else None
        if greek := found["greek"]:
            letters = _SPELLED if greek in _SPELLED else GREEK
            return cls(ROWS[letters.index(greek)], 0, side)
        return cls(found["row"].upper(), int(found["column"]), side)

    def on(self, side: Side | None) -> Identity:
        """Put the same whisker on another side.

        Parameters
        ----------
        side : {"left", "right"} or None
            Side of the face.

        Returns
        -------
        Identity
        """
        return Identity(self.row, self.column, side)

    @property
    def row_number(self) -> int:
        """1 for row A to 5 for row E."""
        return ROWS.index(self.row) + 1

    @property
    def name(self) -> str:
        """Name as it is written everywhere: ``C2``, ``γ``, ``LC2``, ``Rγ``."""
        bare = f"{self.row}{self.column}"
        if self.column == 0 and self.row in ROWS[: len(GREEK)]:
            bare = GREEK[self.row_number - 1]
        return (cast(str, self.side)[0].upper() if self.side else "") + bare

    @property
    def sort_key(self) -> tuple[str, str, int]:
        """Left before right, then by row, then from the back to the front."""
        return (self.side or "", self.row, self.column)
