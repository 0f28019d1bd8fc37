"""Zarr arrays of which one whisker's numbers are written at a time, in place.

A chunk of an uncompressed Zarr array is a file of its numbers in C order and nothing else. So what
belongs to one whisker stands at a known place, and writing it is writing these bytes: no chunk is
read, encoded or replaced, a file holds thousands of whiskers, and any Zarr library reads it.

A chunk's file is made aside, full of what means that nothing is known, and put in place by renaming
it. So a disk that is full is mostly noticed before anything of a whisker is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import ArrayLike

WHISKERS = 4096
"""Whiskers to a chunk."""


def make_rows(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    dtype: str,
    fill: Any,
    dims: list[str],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Make an array of which the first dimension is the whisker, with nothing in it.

    Parameters
    ----------
    group : zarr.Group
        Where.
    name : str
        Its name.
    shape : tuple of int
        Whiskers first.
    dtype : str
        Of its numbers.
    fill : scalar
        What means that nothing is known.
    dims : list of str
        Names of the dimensions.
    attributes : mapping, optional
        Of the array.
    """
    group.create_array(
        name,
        shape=shape,
        chunks=(min(shape[0], WHISKERS), *shape[1:]),
        dtype=np.dtype(dtype).newbyteorder("<"),
        fill_value=fill,
        compressors=None,
        filters=None,
        attributes={**(attributes or {}), "_ARRAY_DIMENSIONS": dims},
    )


class Rows:
    """An array made by `make_rows`, to be written to.

    Parameters
    ----------
    path : Path
        Its folder.
    """

    def __init__(self, path: Path) -> None:
        array = zarr.open_array(path, mode="r", zarr_format=2)
        self._path = path
        self._chunk = array.chunks
        self._fill = array.fill_value
        self._dtype = array.dtype
        self._rest = ".0" * (array.ndim - 1)
        sizes = [*array.chunks[1:], array.dtype.itemsize]
        self._steps = [int(np.prod(sizes[k:])) for k in range(array.ndim)]
        self.shape = array.shape[1:]

    def write(self, values: ArrayLike, index: int, column: int = 0) -> None:
        """Write a whisker's numbers, or those from a column on.

        Parameters
        ----------
        values : array_like
            As many as there are, or one of a column.
        index : int
            Number of the whisker.
        column : int
            Of the second dimension.

        Raises
        ------
        OSError
            If they cannot be written.
        """
        block, row = divmod(index, self._chunk[0])
        path = f"{self._path}/{block}{self._rest}"
        try:
            file = open(path, "r+b")  # noqa: SIM115
        except FileNotFoundError:
            self._make(Path(path))
            file = open(path, "r+b")  # noqa: SIM115
        with file:
            file.seek(row * self._steps[0] + (column * self._steps[1] if column else 0))
            file.write(np.asarray(values, dtype=self._dtype).tobytes())

    def _make(self, path: Path) -> None:
        part = path.with_name(f"{path.name}.part")
        part.write_bytes(np.full(self._chunk, self._fill, dtype=self._dtype).tobytes())
        part.replace(path)
