"""Digitised centrelines as CSV.

The first line that is neither empty nor a comment (#) is the header. It names the coordinates and
with them the unit: `x_mm,y_mm,z_mm` (also `_um`, `_m`), or `x,y,z` in metres. Without z the points
lie in the plane z = 0. Other columns are left alone.
"""

from os import PathLike
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io.replace import replacing
from vibrissa.io.table import read_text, table_rows
from vibrissa.whisker import Whisker
from vibrissa.whisker.section import Properties

Array = NDArray[np.float64]

UNITS = {"": 1.0, "_m": 1.0, "_mm": 1e-3, "_um": 1e-6, "_µm": 1e-6}
"""Suffix of a column's name and the length it stands for, m."""

ALLOWED = "x_mm,y_mm,z_mm (also _um, _m) or x,y,z in metres; z may be left out"


def load_centerline(path: str | PathLike[str]) -> Array:
    """Read a digitised centreline.

    Parameters
    ----------
    path : str or path
        CSV file with columns `x_mm,y_mm,z_mm`, or `x,y,z` in metres.

    Returns
    -------
    array (n, 3)
        Points, m, in the file's frame and order.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is empty, has no header, lacks columns or has cells that are no numbers; all
        bad cells are named with their lines.
    """
    path = Path(path)
    rows = table_rows(read_text(path))
    header = next(rows, None)
    if header is None:
        raise ValueError(f"{path} is empty; a header {ALLOWED} and at least 4 points are needed")
    columns, factor = _columns(path, header[1])
    points, faults = [], []
    for line, cells in rows:
        try:
            points.append([float(cells[column]) for column in columns])
        except (ValueError, IndexError):
            faults.append(f"line {line} reads {','.join(cells)!r}")
    if faults:
        more = "" if len(faults) <= 5 else f"; and {len(faults) - 5} more lines"
        raise ValueError(
            f"{path} has cells that are no numbers, or too few: {'; '.join(faults[:5])}{more}"
        )
    array = np.array(points, dtype=np.float64).reshape(-1, len(columns)) * factor
    return array if len(columns) == 3 else np.column_stack([array, np.zeros(len(array))])


def _columns(path: Path, header: list[str]) -> tuple[list[int], float]:
    """Where the coordinates stand, and the length of their unit, m."""
    names = [name.lower() for name in header]
    for suffix, factor in UNITS.items():
        found = [f"{axis}{suffix}" for axis in "xyz" if f"{axis}{suffix}" in names]
        if found[:2] == [f"x{suffix}", f"y{suffix}"]:
            mixed = len(found) == 2 and any(f"z{other}" in names for other in UNITS)
            if mixed:
                break
            return [names.index(name) for name in found], factor
    try:
        [float(name) for name in header]
    except ValueError:
        raise ValueError(
            f"{path} has the columns {', '.join(header)}; {ALLOWED}, all in one unit, is needed"
        ) from None
    raise ValueError(f"{path} has no header: its first line is numbers; {ALLOWED} is needed")


def save_centerline(path: str | PathLike[str], points: ArrayLike) -> None:
    """Write a centreline as CSV in mm, to 1 nm.

    Parameters
    ----------
    path : str or path
        Where to write; an existing file is replaced.
    points : array (n, 3)
        Points, m.
    """
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points have shape {array.shape}; (n, 3) is needed")
    lines = ["x_mm,y_mm,z_mm", *(",".join(f"{x * 1e3:.6f}" for x in row) for row in array)]
    with replacing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def load_whisker(
    path: str | PathLike[str],
    *,
    noise: float | None = None,
    base: str | ArrayLike | None = None,
    **properties: Unpack[Properties],
) -> Whisker:
    """Read a digitised centreline and make a whisker of it.

    Parameters
    ----------
    path : str or path
        CSV file with columns `x_mm,y_mm,z_mm`, or `x,y,z` in metres.
    noise : float, optional
        Standard deviation of a coordinate, m; 0 asks for interpolation. By default it is estimated.
    base : {"first", "last"} or array (3,), optional
        Which end is the base: by name, or a point near it, m. By default the first.
    **properties
        Radius and material; see `Whisker`.

    Returns
    -------
    Whisker
        Named after the file unless a name is given.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it cannot be read or holds no centreline.
    """
    points = load_centerline(path)
    properties.setdefault("name", Path(path).stem)
    try:
        return Whisker.from_points(points, noise=noise, base=base, **properties)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from None
