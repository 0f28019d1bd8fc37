"""Whether a store still holds what was written: a checksum of every cell.

Disks, copies and synchronised folders cut files, lose them or put others in their place, and a
chunk that is gone reads as numbers that are not known. The CRC-32 of a cell is over what is told of
it (status, seconds, origin, identity), and where it is done over its numbers and what describes its
whisker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from vibrissa.sweeps.rows import Rows

Bytes = bytes | memoryview

DONE, FAILED = 1, 2
"""Statuses of cells of which something is kept."""

TOLD = ("status", "seconds", "origin", "identity")
"""What is told of a cell, in the order of the checksum."""


def checksum(told: Bytes, numbers: Bytes = b"") -> int:
    """Checksum of one cell."""
    return crc32(numbers, crc32(told))


def damaged(
    cells: Mapping[str, NDArray[np.generic]],
    whiskers: Sequence[Rows],
    results: Sequence[Sequence[Rows]],
) -> NDArray[np.bool_]:
    """Find cells that do not hold what was written."""
    status, sums = cells["status"], cells["checksum"]
    kept = np.isin(status, (DONE, FAILED))
    out = np.asarray((sums != 0) & ~kept)
    # A run that was killed leaves one; more of them have lost their status since.
    out &= out.sum() > 1
    described = _joined([rows.read() for rows in whiskers])
    starts = range(0, len(status), whiskers[0].block)
    for k, rows in enumerate(results):
        told = _joined([cells[name][:, k] for name in TOLD])
        for first, *arrays in zip(starts, *(one.blocks() for one in rows), strict=True):
            part = slice(first, first + whiskers[0].block)
            numbers = _joined([described[part], *arrays])
            for i in np.flatnonzero(kept[part, k]).tolist():
                at = first + i, k
                own = numbers[i].data if status[at] == DONE else b""
                out[at] = checksum(told[first + i].data, own) != sums[at]
    return out


def _joined(arrays: Sequence[NDArray[np.generic]]) -> NDArray[np.uint8]:
    """Bytes (whisker, ...) of arrays, one after the other."""
    return np.concatenate(
        [np.ascontiguousarray(one).reshape(len(one), -1).view(np.uint8) for one in arrays], axis=1
    )
