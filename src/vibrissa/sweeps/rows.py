"""Zarr arrays of which one whisker's numbers are written at a time, in place.

A chunk of an uncompressed Zarr array is a file of its numbers in C order and nothing else. So what
belongs to one whisker stands at a known place, and writing it is writing these bytes: no chunk is
read, encoded or replaced, a file holds thousands of whiskers, and any Zarr library reads it.

A chunk's file is made aside, full of what means that nothing is known, and put in place by renaming
it. So a disk that is full is mostly noticed before anything of a whisker is written.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import ArrayLike, NDArray

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
    """Make an array of which the first dimension is the whisker, with nothing in it."""
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


def is_rows(array: zarr.Array[Any]) -> bool:
    """Tell whether an array is one of `make_rows`."""
    return not array.compressors


class Rows:
    """An array made by `make_rows`, to be written to and read from."""

    def __init__(self, path: Path) -> None:
        array = zarr.open_array(path, mode="r", zarr_format=2)
        self._path = path
        self._chunk = array.chunks
        self._fill = array.fill_value
        self.dtype = array.dtype
        self._rest = ".0" * (array.ndim - 1)
        sizes = [*array.chunks[1:], array.dtype.itemsize]
        self._steps = [int(np.prod(sizes[k:])) for k in range(array.ndim)]
        self.count, self.shape, self.block = array.shape[0], array.shape[1:], array.chunks[0]

    def write(self, values: ArrayLike, index: int, column: int = 0) -> None:
        """Write a whisker's numbers, or those from a column on."""
        block, row = divmod(index, self._chunk[0])
        path = f"{self._path}/{block}{self._rest}"
        try:
            file = open(path, "r+b")  # noqa: SIM115
        except FileNotFoundError:
            self._make(Path(path))
            file = open(path, "r+b")  # noqa: SIM115
        with file:
            file.seek(row * self._steps[0] + (column * self._steps[1] if column else 0))
            file.write(self.encoded(values))

    def encoded(self, values: ArrayLike | None) -> bytes:
        """Numbers as they are written."""
        if values is None:
            values = np.full(self.shape, self._fill)
        return np.asarray(values, dtype=self.dtype).tobytes()

    def blocks(self) -> Iterator[NDArray[Any]]:
        """Read all numbers, chunk by chunk."""
        for first in range(0, self.count, self._chunk[0]):
            block = np.full(self._chunk, self._fill, dtype=self.dtype)
            with contextlib.suppress(FileNotFoundError):
                content = self._file(first // self._chunk[0]).read_bytes()[: block.nbytes]
                block.reshape(-1).view(np.uint8)[: len(content)] = np.frombuffer(content, np.uint8)
            yield block[: self.count - first]

    def read(self) -> NDArray[Any]:
        """Read all numbers."""
        return np.concatenate(list(self.blocks()))

    def whole(self) -> bool:
        """Tell whether Zarr can read it."""
        size = int(np.prod(self._chunk)) * self.dtype.itemsize
        files = map(self._file, range(-(-self.count // self._chunk[0])))
        return all(file.stat().st_size == size for file in files if file.exists())

    def _file(self, block: int) -> Path:
        return self._path / f"{block}{self._rest}"

    def _make(self, path: Path) -> None:
        part = path.with_name(f"{path.name}.part")
        part.write_bytes(np.full(self._chunk, self._fill, dtype=self.dtype).tobytes())
        part.replace(path)
