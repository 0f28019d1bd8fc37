"""Arrays of whiskers: our own files, a lab's table, or a folder of digitised centrelines.

All are in one frame, that of the head: origin at the tip of the snout (or anywhere on the midline),
x to the animal's right, y forward, z up.

**Table** (CSV), a line a whisker. The unit stands at the end of a column's name: ``_mm``, ``_um``
or ``_m`` for lengths, ``_deg`` or ``_rad`` for angles.

| columns | |
|---|---|
| `name` | row and column: C2, gamma; L or R before it, or the side is that of the base |
| `x_mm, y_mm, z_mm` | base point |
| `azimuth_deg, elevation_deg, roll_deg` | as `vibrissa.whisker.pose` has them; or |
| `r11, r12, … r33` | the rotation from the whisker's to the head's frame, row by row |
| `length_mm` | arc length |
| `coefficient_per_mm` | A of the whisker's shape y = A x² (also ``_per_m``) |
| `base_radius_um, tip_radius_um` | may be left out: then they are the published ones of its name |

Other columns are left alone.

**Folder**: a CSV file each with columns ``x_mm,y_mm,z_mm`` (`load_centerline`), from base to tip,
named after the whisker: ``C2.csv``, ``left_gamma.csv``.

A lab's own whiskers as a table; the columns are listed in `vibrissa.io.array`.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.io.centerline import UNITS, check_slender, load_whisker, tells_radius
from vibrissa.io.netcdf import is_netcdf, kind_of, naming, read_tree, write_netcdf
from vibrissa.io.recording import separate_whiskers, stacked_whiskers
from vibrissa.io.table import Table, few_faults, write_table
from vibrissa.numerics import Array
from vibrissa.whisker import (
    Identity,
    Pose,
    Whisker,
    WhiskerArray,
    angles_of,
    base_rotation,
    morphology,
    parabola_curvature,
    published_note,
    published_radii,
)


def load_array(
    path: str | PathLike[str], *, base: str | ArrayLike | None = None, noise: float | None = None
) -> WhiskerArray:
    """Read an array of whiskers.

    Parameters
    ----------
    path : str or path
        File of `save_array` (``.nc``), a table of whiskers (``.csv``), or a folder of centrelines,
        a file each.
    base : {"first", "last"} or array_like (3,), optional
        End of a centreline that is the base; see `load_whisker`.
    noise : float, optional
        Standard deviation of a coordinate of centrelines, m; see `load_whisker`.

    Returns
    -------
    WhiskerArray
        Poses lead to the frame of the file.

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
        Array that is written.

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
    write_table(path, *_as_table(array))


def _netcdf(path: Path) -> WhiskerArray:
    kind = kind_of(path)
    if kind != WhiskerArray.kind:
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
        raise ValueError(f"{path}: {few_faults(faults)}")
    return _array(path, whiskers)


def _of_folder(path: Path) -> str:
    """Why a folder is not a folder of centrelines."""
    names = sorted(file.name for file in path.iterdir())
    if {".zgroup", ".zarray", "zarr.json"}.intersection(names):
        return "is a Zarr folder, as NWB can be kept in; save it as HDF5, in one file .nwb"
    held = few_faults(names) if names else "nothing"
    return f"is a folder of {held}; one of centrelines, such as C2.csv, or a file is needed"


def _array(path: Path, whiskers: Sequence[Whisker]) -> WhiskerArray:
    try:
        return WhiskerArray(whiskers)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault}") from None


_ANGLES = ("azimuth", "elevation", "roll")
_ROTATION = tuple(f"r{i}{j}" for i in "123" for j in "123")
_TURNS = {"_deg": np.pi / 180.0, "_rad": 1.0}
_CURVATURES = {"_per_mm": 1e3, "_per_m": 1.0}
_PLAIN = {"": 1.0}
_RADII = ("base_radius", "tip_radius")
_NEEDED = (
    "name, x_mm, y_mm, z_mm, azimuth_deg, elevation_deg, roll_deg, length_mm and coefficient_per_mm"
)
_NEARLY = 1e-3
"""Largest entry of RᵀR − 1 that rounding in a table explains."""


def whiskers_from_table(path: Path) -> list[Whisker]:
    """Read a table of whiskers."""
    columns = _Columns(path)
    place = np.stack([columns.values(axis, UNITS) for axis in "xyz"], axis=-1)
    length = columns.values("length", UNITS)
    coefficient = columns.values("coefficient", _CURVATURES)
    radii = {name: columns.values(name, UNITS) for name in _RADII if columns.has(name, UNITS)}
    rotation = _rotations(columns)
    columns.tell()
    whiskers = []
    for i, name in enumerate(columns.text("name")):
        own = {key: float(values[i]) for key, values in radii.items()}
        try:
            pose = Pose(rotation[i], place[i])
            whiskers.append(_whisker(name, pose, float(length[i]), float(coefficient[i]), own))
        except ValueError as fault:
            columns.faults.append(f"line {columns.lines[i]}: {fault}")
    columns.tell()
    return whiskers


def _whisker(
    name: str, pose: Pose, length: float, coefficient: float, radii: dict[str, float]
) -> Whisker:
    """One line's whisker."""
    published = dict(zip(_RADII, published_radii(name, length), strict=True))
    stated: Any = published | radii
    whisker = Whisker.parabola(length, coefficient, name=name, **stated)
    if len(radii) < len(published):
        whisker = replace(whisker, notes=(*whisker.notes, published_note(name)))
    for radius in radii.values():
        check_slender(radius, length)
    bound = float(morphology.curvature_bound(length))
    if abs(coefficient) > bound:
        warnings.warn(
            f"{name}: its coefficient, {coefficient * 1e-3:.4g} per mm, is larger than that of any "
            f"rat's whisker of this length ({bound * 1e-3:.4f} per mm): check the units",
            stacklevel=4,
        )
    # A negative coefficient turns the whisker's frame within that of the table.
    return replace(whisker, pose=Pose(pose.rotation @ whisker.pose.rotation, pose.origin))


class _Columns(Table):
    """Numbers of a table by name, in SI units, and what is wrong with it."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.faults: list[str] = []
        stated = ", ".join(self.names)
        self.names = [name.lower() for name in self.names]
        if "name" not in self.names:
            raise ValueError(f"{path} has the columns {stated}; {_NEEDED} are needed")

    def tell(self) -> None:
        """Raise a ValueError with all faults, if there are any."""
        if self.faults:
            raise ValueError(f"{self.path}: {few_faults(self.faults)}")

    def has(self, name: str, units: Mapping[str, float]) -> bool:
        """Whether there is such a quantity, in any of the units."""
        return any(name + suffix in self.names for suffix in units)

    def values(self, name: str, units: Mapping[str, float]) -> Array:
        """Values of a quantity; NaN, and a fault, where there is none."""
        values = np.full(len(self.lines), np.nan)
        suffix = next((suffix for suffix in units if name + suffix in self.names), None)
        if suffix is None:
            allowed = " or ".join(name + suffix for suffix in units if suffix) or name
            self.faults.append(f"there is no column {allowed}")
            return values
        for i, cell in enumerate(self.text(name + suffix)):
            try:
                values[i] = float(cell)
            except ValueError:
                self.faults.append(f"line {self.lines[i]} has no number for {name}: {cell!r}")
        return values * units[suffix]


def _rotations(columns: _Columns) -> Array:
    """Rotations (n, 3, 3), from angles or from matrices."""
    if not columns.has("r11", _PLAIN):
        return base_rotation(*(columns.values(name, _TURNS) for name in _ANGLES))
    entries = np.stack([columns.values(name, _PLAIN) for name in _ROTATION], axis=-1)
    if columns.faults:
        return entries
    matrix = entries.reshape(-1, 3, 3)
    off = np.abs(np.swapaxes(matrix, 1, 2) @ matrix - np.eye(3)).max(axis=(1, 2))
    for i in np.flatnonzero(~(off <= _NEARLY) | (np.linalg.det(matrix) < 0.0)):
        columns.faults.append(
            f"line {columns.lines[i]}: r11 … r33 are not a rotation, whose columns are a "
            "right-handed frame of unit vectors"
        )
    if columns.faults:
        return matrix
    # What rounding in the table left over is taken away: the nearest rotation.
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def _as_table(array: WhiskerArray) -> tuple[list[str], list[list[str]]]:
    """Write whiskers as the header and the rows of a table."""
    header = ["name", "x_mm", "y_mm", "z_mm", *(f"{name}_deg" for name in _ANGLES)]
    header += ["length_mm", "coefficient_per_mm", "base_radius_um", "tip_radius_um"]
    rows = []
    for name, whisker in array.items():
        angles = np.degrees(angles_of(whisker.pose.rotation))
        numbers = [*(1e3 * whisker.pose.origin), *angles, 1e3 * whisker.length]
        numbers += [1e-3 * _coefficient(whisker), 1e6 * whisker.base_radius]
        numbers += [1e6 * whisker.tip_radius]
        rows.append([name, *(f"{value:.12g}" for value in numbers)])
    return header, rows


def _coefficient(whisker: Whisker) -> float:
    """A of a whisker on y = A x² with a linear taper."""
    s = np.linspace(0.0, whisker.length, 33)
    coefficient = 0.5 * float(whisker.curvature(0.0)[2])
    parabola = parabola_curvature(whisker.length, max(coefficient, 0.0))(s)
    taper = np.linspace(whisker.base_radius, whisker.tip_radius, s.size)
    bent = np.abs(whisker.curvature(s) - parabola).max() * whisker.length
    if bent > 1e-6 or np.abs(whisker.radius(s) / taper - 1.0).max() > 1e-6:
        raise ValueError(
            f"{whisker.name} is not a planar parabola with a linear taper, which is all that a "
            "table holds; NetCDF (.nc) keeps it"
        )
    return coefficient
