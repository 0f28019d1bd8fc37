"""Anipose's table of triangulated points (CSV): ``tip_x, tip_y, tip_z, tip_error, tip_ncams, …``.

The unit is that of the calibration board, mostly mm, which the file does not say. Points have
already been turned by the matrix M and moved to the center that stand in its last columns.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Unpack

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.io.table import read_numbers
from vibrissa.io.tracks import SPACE, Labels, RawTracks, labelled

Array = NDArray[np.float64]


def load_anipose(path: str | PathLike[str], **labels: Unpack[Labels]) -> xr.Dataset:
    """Read points in space that Anipose triangulated.

    Parameters
    ----------
    path : str or path
        CSV of its folder ``pose-3d``.
    **labels
        fps, unit (needed), reference_frame; see `Labels`.

    Returns
    -------
    xarray.Dataset
        Tracks of one whisker with a ``centerline``; with ``reprojection_error``, pixels, and
        ``cameras``, how many saw each point.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is of another kind, cut short or empty, or the unit is not given.
    """
    return labelled(read_anipose(path), path, **labels)


def read_anipose(path: str | PathLike[str]) -> RawTracks:
    """Read a table of Anipose as raw tracks; see `load_anipose`."""
    path = Path(path)
    names, values = read_numbers(path)
    parts = [name.removesuffix("_ncams") for name in names if name.endswith("_ncams")]
    missing = [
        f"{part}_{axis}" for part in parts for axis in "xyz" if f"{part}_{axis}" not in names
    ]
    if not parts or missing:
        got = f"it lacks {', '.join(missing)}" if missing else "no column ends in _ncams"
        raise ValueError(f"{path} is no table of Anipose: {got}")

    def column(part: str, what: str) -> Array:
        name = f"{part}_{what}"
        return values[:, names.index(name)] if name in names else np.full(len(values), np.nan)

    points = np.stack(
        [np.stack([column(part, axis) for axis in "xyz"], axis=-1) for part in parts], axis=1
    )
    measured = {
        what: np.stack([column(part, what) for part in parts], axis=1)[:, None]
        for what in ("score", "error", "ncams")
    }
    # Where no camera saw a point the score is a placeholder above 1.
    score = np.where(measured["score"] > 1.0, np.nan, measured["score"])
    frames = values[:, names.index("fnum")] if "fnum" in names else np.arange(len(values))
    about = {"reprojection_error": ("pixel", "error"), "cameras": ("1", "ncams")}
    return RawTracks(
        software="Anipose",
        whiskers=["whisker"],
        space=points[:, None],
        space_confidence=score,
        nodes=parts,
        frames=frames.astype(np.int64),
        extra={
            name: xr.Variable(
                SPACE[:-1],
                measured[what],
                {"units": unit, "long_name": name.replace("_", " ")},
            )
            for name, (unit, what) in about.items()
        },
    )
