"""Clutter: where something else in a view disturbs the measurement of a whisker.

Next to another whisker, or to an edge or a line that never moves, the image is dark because of that
and not because of the whisker. Such pixels are marked; a trace is bridged over them, and its
uncertainty grows with the distance from where it is seen. Each source of clutter has a bit: one for
everything that is static, and one for each whisker, so that no whisker hides itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import inlined, kernel

Array = NDArray[np.float64]
Bits = NDArray[np.uint32]
Mask = NDArray[np.bool_]

# Distance within which another whisker disturbs, pixels, for a whisker of typical width.
NEAR = 5.0
# Bits of static objects that hide whiskers, and of those in front of or next to which they are
# seen.
STILL, EDGE = np.uint32(1), np.uint32(2)
_WHISKERS = 30  # number of bits for whiskers


class Clutter(NamedTuple):
    """Clutter for one whisker: pixels with any of the selected bits."""

    bits: Bits
    which: int

    def hides(self, points: Array) -> Mask:
        """Whether clutter hides points (n, 2)."""
        return self._at(points, self.which)

    def disturbs(self, points: Array) -> Mask:
        """Whether something static is behind points (n, 2) or next to them."""
        return self._at(points, int(EDGE))

    def _at(self, points: Array, which: int) -> Mask:
        rows, columns = self.bits.shape
        column, row = np.rint(points).astype(np.intp).T
        found = self.bits[row.clip(0, rows - 1), column.clip(0, columns - 1)]
        return np.asarray((found & np.uint32(which)) != 0)

    @property
    def still_only(self) -> Clutter:
        """The static clutter, without other whiskers."""
        return self._replace(which=int(STILL))


NOTHING = Clutter(np.zeros((1, 1), dtype=np.uint32), 0)  # no clutter


@inlined
def in_the_way(bits: Any, which: Any, x: float, y: float) -> Any:
    """Whether a point has any of the selected bits."""
    row = min(max(int(y + 0.5), 0), bits.shape[0] - 1)
    column = min(max(int(x + 0.5), 0), bits.shape[1] - 1)
    return (bits[row, column] & which) != 0


def between_whiskers(
    lines: Sequence[Array | None], still: Bits | None, shape: tuple[int, int], near: float = NEAR
) -> list[Clutter]:
    """Clutter for each of several whiskers, whose lines (n, 2) are approximately known, or None."""
    bits = np.zeros(shape, np.uint32) if still is None else still.copy()
    for k, line in enumerate(lines):
        if line is not None and len(line):
            paint(bits, np.ascontiguousarray(line), near, np.uint32(_own(k)))
    every = (1 << 32) - 1 - int(EDGE)
    return [Clutter(bits, every & ~_own(k)) for k in range(len(lines))]


def _own(whisker: int) -> int:
    return 1 << (2 + whisker % _WHISKERS)


@kernel
def paint(bits: Any, line: Any, near: float, bit: Any) -> None:
    """Mark the pixels near a line."""
    rows, columns = bits.shape
    for k in range(line.shape[0]):
        x, y = line[k, 0], line[k, 1]
        for row in range(max(0, math.ceil(y - near)), min(rows, math.floor(y + near) + 1)):
            for column in range(
                max(0, math.ceil(x - near)), min(columns, math.floor(x + near) + 1)
            ):
                if (row - y) ** 2 + (column - x) ** 2 <= near * near:
                    bits[row, column] |= bit
