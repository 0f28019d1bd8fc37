"""Tables of DeepLabCut and LightningPose: CSV, and pandas tables in HDF5.

Each column is headed by scorer, (individual,) body part and coordinate: x, y, likelihood in pixels,
or x, y, z where DeepLabCut has triangulated two views. Other coordinates, such as the spread of an
ensemble, are left alone. An individual is a whisker, its body parts the whisker's nodes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Unpack

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.io.hdf5 import opened
from vibrissa.io.netcdf import is_netcdf
from vibrissa.io.pandas_table import pandas_tables, read_table
from vibrissa.io.paths import check_readable
from vibrissa.io.table import read_text, table_rows
from vibrissa.io.tracks import Labels, RawTracks, labelled

Array = NDArray[np.float64]
Names = list[tuple[str, ...]]

_LEVELS = ("scorer", "individuals", "bodyparts", "coords")
_NEEDED = "Columns headed by scorer, bodyparts (after individuals, if any) and coords are needed"
_LIGHTNING = re.compile("heatmap|regression|lightning|ensemble|eks", re.IGNORECASE)


def load_deeplabcut(path: str | PathLike[str], **labels: Unpack[Labels]) -> xr.Dataset:
    """Read what DeepLabCut or LightningPose found, or what was labelled for it.

    Parameters
    ----------
    path : str or path
        CSV or HDF5.
    **labels
        fps, view; unit and reference_frame where the points are in space; see `Labels`.

    Returns
    -------
    xarray.Dataset
        Tracks.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is of another kind, cut short or empty.
    """
    return labelled(read_deeplabcut(path), path, **labels)


def read_deeplabcut(path: str | PathLike[str]) -> RawTracks:
    """Read a table of DeepLabCut or LightningPose as raw tracks; see `load_deeplabcut`."""
    path = check_readable(path)
    names, values, index = _hdf5(path) if is_netcdf(path) else _csv(path)
    if len(set(names)) != len(names):
        raise ValueError(f"{path} has two columns of the same name")
    individuals = list(dict.fromkeys(name[1] for name in names))
    parts = list(dict.fromkeys(name[2] for name in names))
    axes = "xyz" if any(name[3] == "z" for name in names) else "xy"
    shape = (len(values), len(individuals), len(parts))
    points, sure = np.full((*shape, len(axes)), np.nan), np.full(shape, np.nan)
    for name, column in zip(names, values.T, strict=True):
        place = individuals.index(name[1]), parts.index(name[2])
        if name[3] in axes:
            points[:, *place, axes.index(name[3])] = column
        elif name[3] in ("likelihood", "confidence"):
            sure[:, *place] = column
    scorer = names[0][0]
    flat = len(axes) == 2
    return RawTracks(
        software="LightningPose" if _LIGHTNING.match(scorer) else "DeepLabCut",
        whiskers=[name or "whisker" for name in individuals],
        image=points[:, :, None] if flat else None,
        image_confidence=sure[:, :, None] if flat else None,
        space=None if flat else points,
        space_confidence=None if flat else sure,
        nodes=parts,
        frames=_frames(path, index, len(values)),
        about={"scorer": scorer},
    )


def _four_levels(path: Path, name: tuple[str, ...]) -> tuple[str, ...]:
    """Scorer, individual (empty if there are none), body part, coordinate."""
    if len(name) not in (3, 4):
        raise ValueError(f"{path} has columns such as {'/'.join(name)}. {_NEEDED}")
    return name if len(name) == 4 else (name[0], "", *name[1:])


def _csv(path: Path) -> tuple[Names, Array, list[str]]:
    rows = table_rows(read_text(path))
    header = _header(path, rows)
    levels = [header[level] for level in _LEVELS if level in header]
    if len({len(level) for level in levels}) != 1:
        raise ValueError(f"{path} has lines of different length in its header")
    # Labelled images are named in one or three columns of their own, without a coordinate.
    first = next((i for i, cell in enumerate(header["coords"]) if i and cell), 1)
    names = [_four_levels(path, name) for name in list(zip(*levels, strict=True))[first:]]
    values, index = [], []
    for line, cells in rows:
        if cells[0] in _LEVELS:
            raise ValueError(
                f"{path}: line {line} is a header row once more, {cells[0]}; tables one below the "
                "other are to be read each on its own"
            )
        try:
            numbers = [float(cell) if cell else np.nan for cell in cells[first:]]
        except ValueError:
            raise ValueError(f"{path}: line {line} has cells that are no numbers") from None
        if len(numbers) != len(names):
            raise ValueError(
                f"{path}: line {line} has {len(cells)} cells and the header {len(names) + first}; "
                "it may be cut short"
            )
        values.append(numbers)
        index.append(cells[first - 1])
    if not values:
        raise ValueError(f"{path} has a header but no rows")
    return names, np.array(values), index


def _header(path: Path, rows: Iterator[tuple[int, list[str]]]) -> dict[str, list[str]]:
    """Header rows by the words that they begin with, up to the coordinates."""
    header: dict[str, list[str]] = {}
    other = ""
    for line, cells in rows:
        if cells[0] in header:
            raise ValueError(f"{path}: line {line} is the header row {cells[0]} a second time")
        if cells[0] not in _LEVELS:
            other = f"; then a line begins with {cells[0]!r}"
            break
        header[cells[0]] = cells
        if cells[0] == "coords":
            break
    missing = [name for name in ("scorer", "bodyparts", "coords") if name not in header]
    if missing:
        raise ValueError(
            f"{path} is no table of DeepLabCut, or cut short: its header rows are "
            f"{', '.join(header) or 'none'}{other}; it lacks {', '.join(missing)}. {_NEEDED}"
        )
    return header


def _hdf5(path: Path) -> tuple[Names, Array, list[str]]:
    with opened(path, "a table of DeepLabCut") as file:
        for _, group in pandas_tables(file):
            names, values, index = read_table(group)
            if names and names[0][-1] in "xyz":
                return [_four_levels(path, name) for name in names], values, index
    raise ValueError(f"{path} is no table of DeepLabCut. {_NEEDED}")


def _frames(path: Path, index: list[str], count: int) -> NDArray[np.int64]:
    """Numbers of the frames: of the rows, or of the images, such as img0042.png."""
    numbers = [re.search(r"(\d+)(?:\.0)?(?:\.[A-Za-z]+)?$", cell) for cell in index]
    if not index or any(number is None for number in numbers):
        return np.arange(count)
    frames = np.array([int(number[1]) for number in numbers if number is not None])
    return frames if len(np.unique(frames)) == count else np.arange(count)
