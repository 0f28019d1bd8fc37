"""Contact points that were tracked otherwise, as CSV, for comparison.

Either places in the laboratory, m, or pixels in at least two views, a line each:

- ``time`` or ``frame``, ``x, y, z``, and ``whisker`` where there are several,
- ``view, frame, x, y``, column and row, and ``whisker``.

Views, frames and whiskers are counted from 0, frames in three dimensions being those of the first
video. Moments without contact are left out, or their numbers are empty.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.io.over_time import few, moments_coordinate, read_over_time
from vibrissa.quantities import attributes

Array = NDArray[np.float64]


def load_contact_points(path: str | PathLike[str]) -> xr.Dataset:
    """Read contact points.

    Parameters
    ----------
    path : str or path
        CSV; see the module.

    Returns
    -------
    xarray.Dataset
        Dims ``time`` or ``frame``, and whisker: ``contact_point`` (…, space), laboratory frame, m;
        or ``contact_pixel`` (frame, whisker, view, image_axis). NaN where there is none.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it has other columns, or two lines of the same moment, whisker and view.
    """
    path = Path(path)
    key, columns = read_over_time(path)
    in_views = "view" in columns
    axes = ("x", "y") if in_views else ("x", "y", "z")
    if not set(axes) <= set(columns) or (in_views and key == "time"):
        raise ValueError(
            f"{path} has the columns {', '.join(columns)}; time or frame, x, y, z, or view, frame, "
            "x, y are needed"
        )
    count = len(columns[key])
    moments, moment = np.unique(columns[key], return_inverse=True)
    whiskers, whisker = _numbers(path, columns.get("whisker", np.zeros(count)), "whisker")
    views, view = _numbers(path, columns.get("view", np.zeros(count)), "view")
    if in_views and len(views) < 2:
        raise ValueError(f"{path} tells of view {views[0]} only; two are needed for a place")
    places = np.ravel_multi_index(
        (moment, whisker, view), (len(moments), len(whiskers), len(views))
    )
    _, first = np.unique(places, return_index=True)
    twice = np.setdiff1d(np.arange(count), first)
    if twice.size:
        raise ValueError(f"{path}: rows {few(twice + 1)} tell of a contact that an earlier one has")
    values = np.full((len(moments), len(whiskers), len(views), len(axes)), np.nan)
    values[moment, whisker, view] = np.stack([columns[axis] for axis in axes], axis=1)
    coordinates = {key: moments_coordinate(key, moments), "whisker": whiskers}
    if in_views:
        about = {"units": "pixel", "long_name": "contact point in the image"}
        return xr.Dataset(
            {"contact_pixel": ((key, "whisker", "view", "image_axis"), values, about)},
            coordinates | {"view": views, "image_axis": ["column", "row"]},
        )
    about = dict(attributes("contact_point")) | {"reference_frame": "laboratory"}
    return xr.Dataset(
        {"contact_point": ((key, "whisker", "space"), values[:, :, 0], about)},
        coordinates | {"space": list("xyz")},
    )


def _numbers(path: Path, column: Array, name: str) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """Which numbers a column has, and where each of its rows is among them."""
    wrong = np.flatnonzero(~(column >= 0.0) | (column != np.round(column)))
    if wrong.size:
        raise ValueError(f"{path}: {name} is no number from 0 on in rows {few(wrong + 1)}")
    numbers, places = np.unique(column.astype(np.int64), return_inverse=True)
    return numbers, places
