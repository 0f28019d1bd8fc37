"""What one task found, of all whiskers: a Zarr group like the first whisker's dataset."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from vibrissa.sweeps.rows import Rows, make_rows


class Found:
    """The arrays of a task, open for writing.

    Parameters
    ----------
    path : Path
        Of the group, made by `lay_out`.
    """

    def __init__(self, path: Path) -> None:
        self._rows: dict[str, Rows] = {}
        self._coordinates: dict[str, NDArray[Any]] = {}
        for name, array in zarr.open_group(path, mode="r", zarr_format=2).arrays():
            if array.attrs["_ARRAY_DIMENSIONS"][:1] == ["whisker"]:
                self._rows[name] = Rows(path / name)
            else:
                self._coordinates[name] = np.asarray(array[...])

    def misfit(self, result: xr.Dataset) -> str:
        """Say what keeps a result from standing beside those of other whiskers.

        Parameters
        ----------
        result : Dataset
            Of one whisker.

        Returns
        -------
        str
            Empty if nothing does.
        """
        # Variables, not data arrays, which take longer to make than to write.
        for name, variable in result.variables.items():
            others = self._coordinates.get(str(name))
            rows = self._rows.get(str(name))
            if others is not None and not _same(others, variable.values):
                return f"{name} is {variable.values}, that of other whiskers {others}\n"
            if others is None and rows is None:
                return f"{name} is no result of other whiskers\n"
            if rows is not None and rows.shape != variable.shape:
                return (
                    f"{name} has shape {variable.shape}, that of other whiskers has {rows.shape}\n"
                )
        return ""

    def write(self, result: xr.Dataset, index: int) -> None:
        """Write a whisker's result.

        Parameters
        ----------
        result : Dataset
            One without a `misfit`.
        index : int
            Number of the whisker.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        for name, variable in result.variables.items():
            if name in self._rows:
                self._rows[str(name)].write(variable.values, index)


def lay_out(group: zarr.Group, result: xr.Dataset, count: int) -> None:
    """Make the arrays of a task.

    Parameters
    ----------
    group : zarr.Group
        An empty one.
    result : Dataset
        A first whisker's result, whose coordinates those of all others share.
    count : int
        Number of whiskers.
    """
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
