"""What one task found, of all whiskers: a Zarr group like the first whisker's dataset."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from vibrissa.sweeps.rows import Rows, is_rows, make_rows

_ALL, _SUM = ".zmetadata", "checksum"


class Found:
    """The arrays of a task, open for writing and reading."""

    def __init__(self, path: Path) -> None:
        self.rows: dict[str, Rows] = {}
        self.coordinates: dict[str, NDArray[Any]] = {}
        try:
            known = json.loads((path / _ALL).read_text(encoding="utf-8"))["metadata"]
            # All that the group was made of must be there, as it was.
            if any(
                json.loads((path / key).read_text(encoding="utf-8")) != known[key] for key in known
            ):
                raise ValueError("its description has changed")
            for name, array in zarr.open_group(path, mode="r", zarr_format=2).arrays():
                if is_rows(array):
                    self.rows[name] = Rows(path / name)
                else:
                    self.coordinates[name] = np.asarray(array[...])
            told = known[".zattrs"].get(_SUM)
            if told is not None and told != _sum_of(self.coordinates):
                raise ValueError("its coordinates have changed")
        except Exception as fault:  # of a damaged file, libraries raise whatever they stumble over
            reason = " ".join(str(fault).split())[:200] or type(fault).__name__
            raise ValueError(
                f"{path} is damaged ({reason}): `vibrissa sweep` with the same study does it again"
            ) from fault

    @property
    def ordered(self) -> list[Rows]:
        """Arrays of numbers, in the order of their names."""
        return [self.rows[name] for name in sorted(self.rows)]

    def misfit(self, result: xr.Dataset) -> str:
        """Say what keeps a result from standing beside those of other whiskers."""
        # Variables, not data arrays, which take longer to make than to write.
        for name, variable in result.variables.items():
            others = self.coordinates.get(str(name))
            rows = self.rows.get(str(name))
            if others is not None and not _same(others, variable.values):
                return f"{name} is {variable.values}, that of other whiskers {others}\n"
            if others is None and rows is None:
                return f"{name} is no result of other whiskers\n"
            if rows is not None and rows.shape != variable.shape:
                return (
                    f"{name} has shape {variable.shape}, that of other whiskers has {rows.shape}\n"
                )
        return ""

    def write(self, result: xr.Dataset, index: int) -> bytes:
        """Write a whisker's result."""
        content = []
        for name, rows in sorted(self.rows.items()):
            content.append(rows.encoded(result.variables[name].values if name in result else None))
            rows.write(np.frombuffer(content[-1], rows.dtype).reshape(rows.shape), index)
        return b"".join(content)


def lay_out(group: zarr.Group, result: xr.Dataset, count: int) -> None:
    """Make the arrays of a task."""
    for name, variable in result.data_vars.items():
        word = variable.dtype.kind in "ib"
        make_rows(
            group,
            str(name),
            (count, *variable.shape),
            "int8" if word else "float64",
            -1 if word else np.nan,
            ["whisker", *map(str, variable.dims)],
            _plain(variable.attrs),
        )
    for name, coordinate in result.coords.items():
        values = coordinate.values
        group.create_array(
            str(name),
            data=values.astype(str) if values.dtype.kind in "OU" else values,
            chunks=values.shape,
            attributes={**_plain(coordinate.attrs), "_ARRAY_DIMENSIONS": [str(name)]},
        )


def seal(group: zarr.Group) -> None:
    """Note the checksum of all arrays of a group that are not written to any more."""
    fixed = {name: np.asarray(one[...]) for name, one in group.arrays() if not is_rows(one)}
    group.attrs[_SUM] = _sum_of(fixed)


def _sum_of(arrays: Mapping[str, NDArray[Any]]) -> int:
    """Checksum of arrays by name."""
    return crc32(json.dumps({name: arrays[name].tolist() for name in sorted(arrays)}).encode())


def _plain(attributes: dict[Any, Any]) -> dict[str, Any]:
    return {
        str(key): value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in attributes.items()
    }


def _same(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Whether coordinates agree, to what another machine's rounding may change."""
    if first.shape != second.shape:
        return False
    if first.dtype.kind == "f":
        return bool(np.allclose(first, second, rtol=1e-12, atol=0.0))
    return bool(np.array_equal(first, second))
