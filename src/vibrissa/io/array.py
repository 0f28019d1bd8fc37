"""Arrays of whiskers: our own files, a lab's table, or a folder of digitised centrelines.

All are in one frame, that of the head: origin at the tip of the snout (or anywhere on the midline),
x to the animal's right, y forward, z up.

**Table** (CSV), a line a whisker. The unit stands at the end of a column's name: ``_mm``, ``_um``
or ``_m`` for lengths, ``_deg`` or ``_rad`` for angles.

| columns | |
|---|---|
| `name` | row and column: C2, gamma; L or R before it, or the side is that of the base |
| `x_mm, y_mm, z_mm` | base point |
| `azimuth_deg, elevation_deg, roll_deg` | as `vibrissa.whisker.emergence` has them; or |
| `r11, r12, … r33` | the rotation from the whisker's to the head's frame, row by row |
| `length_mm` | arc length |
| `coefficient_per_mm` | A of the whisker's shape y = A x² (also ``_per_m``) |
| `base_radius_um, tip_radius_um` | may be left out: then they are the published ones of its name |

Other columns are left alone.

**Folder**: a CSV file each with columns ``x_mm,y_mm,z_mm`` (`load_centerline`), from base to tip,
named after the whisker: ``C2.csv``, ``left_gamma.csv``.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from vibrissa.io.array_table import few, table_lines, whiskers_from_table
from vibrissa.io.centerline import load_whisker, tells_radius
from vibrissa.io.hdf5 import naming
from vibrissa.io.netcdf import is_netcdf, kind_of, read_tree, write_netcdf
from vibrissa.io.replace import replacing
from vibrissa.io.whisker_stack import separate_whiskers, stacked_whiskers
from vibrissa.whisker import Whisker
from vibrissa.whisker.array import WhiskerArray
from vibrissa.whisker.array_dataset import KIND
from vibrissa.whisker.identity import Identity


def load_array(
    path: str | PathLike[str], *, base: str | ArrayLike | None = None, noise: float | None = None
) -> WhiskerArray:
    """Read an array of whiskers.

    Parameters
    ----------
    path : str or path
        What `save_array` wrote (``.nc``), a table of whiskers (``.csv``), or a folder of
        centrelines, a file each.
    base : {"first", "last"} or array_like (3,), optional
        Of centrelines: which end is the base; see `load_whisker`.
    noise : float, optional
        Of centrelines: standard deviation of a coordinate, m; see `load_whisker`.

    Returns
    -------
    WhiskerArray
        Poses lead to the frame of the file.

    Raises
    ------
    FileNotFoundError
        If there is no such file or folder.
    ValueError
        If it holds no whiskers, a name is no whisker's, a column is missing or a cell no number.

    Warns
    -----
    UserWarning
        If a whisker of a table is more curved than any of a rat.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file or folder {path}")
    if path.is_dir():
        return _folder(path, base, noise)
    if is_netcdf(path):
        return _netcdf(path)
    return _array(path, whiskers_from_table(path))


def save_array(path: str | PathLike[str], array: WhiskerArray) -> None:
    """Write an array of whiskers.

    Parameters
    ----------
    path : str or path
        ``.nc``: without loss, whatever the whiskers' shapes. ``.csv``: a table, for whiskers that
        are parabolas with a linear taper, such as an average rat's.
    array : WhiskerArray
        What is written.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If a table was asked for and a whisker is of another shape.
    """
    path = Path(path)
    if path.suffix.lower() != ".csv":
        write_netcdf(path, stacked_whiskers(array.to_tree()))
        return
    with replacing(path) as part:
        part.write_text("\n".join(table_lines(array)) + "\n", encoding="utf-8")


def _netcdf(path: Path) -> WhiskerArray:
    kind = kind_of(path)
    if kind != KIND:
        raise ValueError(f"{path} holds {kind or 'data of another kind'}, not an array of whiskers")
    tree = read_tree(path)
    with naming(path, "an array of whiskers"):
        return WhiskerArray.from_tree(separate_whiskers(tree))


def _folder(path: Path, base: Any, noise: float | None) -> WhiskerArray:
    """A digitised centreline each."""
    files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".csv")
    if not files:
        raise ValueError(f"{path} {_of_folder(path)}")
    whiskers, faults = [], []
    for file in files:
        try:
            identity = Identity.of(file.stem)
            whisker = load_whisker(file, base=base, noise=noise)
        except ValueError as fault:
            faults.append(f"{file.name}: {fault}")
            continue
        if not tells_radius(file):
            whisker = whisker.with_properties(rat=identity.name)
        whiskers.append(whisker)
    if faults:
        raise ValueError(f"{path}: {few(faults)}")
    return _array(path, whiskers)


def _of_folder(path: Path) -> str:
    """Why a folder is no folder of centrelines."""
    names = sorted(file.name for file in path.iterdir())
    if {".zgroup", ".zarray", "zarr.json"}.intersection(names):
        return "is a Zarr folder, as NWB can be kept in; save it as HDF5, in one file .nwb"
    held = few(names) if names else "nothing"
    return f"is a folder of {held}; one of centrelines, such as C2.csv, or a file is needed"


def _array(path: Path, whiskers: Sequence[Whisker]) -> WhiskerArray:
    try:
        return WhiskerArray(whiskers)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from None
