"""Contour points as CSV: ``time, whisker, x, y, z, sigma_x, …``, a line for each contact.

In SI units and the laboratory frame: the contact point on the whisker's centreline with its
standard deviations, the surface's outward normal there, the point of the surface, one whisker
radius away, and, where an object was fitted, how far the surface of the whisker is from it and
whether the contact is no outlier.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa.io.replace import replacing

COLUMNS = (
    *("time", "whisker", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z"),
    *("normal_x", "normal_y", "normal_z", "surface_x", "surface_y", "surface_z"),
    *("surface_distance", "inlier"),
)
"""Names of the columns, in their order."""


def save_contour(path: str | PathLike[str], contour: xr.Dataset) -> None:
    """Write contour points, every number in full.

    Parameters
    ----------
    path : str or path
        Where to write; an existing file is replaced.
    contour : xarray.Dataset
        Dim contact; a variable for each column. Those that it lacks are written as missing, but
        ``time``, ``x``, ``y`` and ``z`` must be there.

    Raises
    ------
    ValueError
        If a needed variable is not there, or one has another dim.
    """
    text = _text(contour)
    with replacing(path) as part:
        part.write_bytes(text.encode("utf-8"))


def holds_contour(path: str | PathLike[str], contour: xr.Dataset) -> bool:
    """Tell whether a file is just what `save_contour` writes of contour points."""
    return Path(path).read_bytes() == _text(contour).encode("utf-8")


def _text(contour: xr.Dataset) -> str:
    missing = [name for name in ("time", "x", "y", "z") if name not in contour.variables]
    if missing:
        raise ValueError(f"contour points lack {', '.join(missing)}")
    faults = [n for n in COLUMNS if n in contour.variables and contour[n].dims != ("contact",)]
    if faults:
        raise ValueError(f"{', '.join(faults)} must have the one dim contact")
    n = contour.sizes["contact"]
    columns = [
        contour[name].values if name in contour.variables else np.full(n, np.nan)
        for name in COLUMNS
    ]
    lines = [",".join(COLUMNS)]
    lines += [",".join(map(_cell, row)) for row in zip(*columns, strict=True)]
    return "\n".join(lines) + "\n"


def _cell(value: object) -> str:
    if isinstance(value, np.bool_):
        return str(int(value))
    if isinstance(value, np.floating):
        return repr(float(value))
    # A name with a comma or a quotation mark would tear the line.
    text = str(value)
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text
