"""The first column of tables over a video: ``time``, s, or ``frame``, a number from 0."""

from __future__ import annotations

from os import PathLike

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.io.table import read_numbers
from vibrissa.quantities import attributes

Array = NDArray[np.float64]

_SHOWN = 5


def read_over_time(path: str | PathLike[str]) -> tuple[str, dict[str, Array]]:
    """Read a table whose rows are moments."""
    names, values = read_numbers(path)
    columns = dict(zip(names, values.T, strict=True))
    keys = [name for name in ("time", "frame") if name in columns]
    if len(keys) != 1:
        raise ValueError(
            f"{path} has the columns {', '.join(names)}; either time or frame must be one of them"
        )
    key = keys[0]
    moments = columns[key]
    if not np.isfinite(moments).all():
        raise ValueError(f"{path}: {key} is missing in row {_first(~np.isfinite(moments))}")
    if key == "frame" and (moments != np.round(moments)).any() | (moments < 0.0).any():
        row = _first((moments != np.round(moments)) | (moments < 0.0))
        raise ValueError(f"{path}: frame {moments[row - 1]:g} in row {row}; 0, 1, … are frames")
    return key, columns


def check_rising(path: str | PathLike[str], key: str, moments: Array) -> None:
    """Refuse moments that do not rise from row to row."""
    back = np.flatnonzero(np.diff(moments) <= 0.0)
    if back.size:
        i = int(back[0])
        raise ValueError(
            f"{path}: {key} does not rise: {moments[i]:g} is followed by {moments[i + 1]:g} (rows "
            f"{i + 1} and {i + 2}, and {back.size - 1} more times)"
        )


def moments_coordinate(key: str, moments: Array) -> xr.Variable:
    """Label moments."""
    if key == "time":
        return xr.Variable("time", moments, attributes("time"))
    about = {"units": "1", "long_name": "frame of the first video"}
    return xr.Variable("frame", moments.astype(np.int64), about)


def few(numbers: NDArray[np.int64]) -> str:
    """Write the first of some numbers."""
    text = ", ".join(str(int(n)) for n in numbers[:_SHOWN])
    return text + (f" and {len(numbers) - _SHOWN} more" if len(numbers) > _SHOWN else "")


def _first(mask: NDArray[np.bool_]) -> int:
    """Row of the first that is true, from 1."""
    return int(np.flatnonzero(mask)[0]) + 1
