"""Files of whiskers: digitised centrelines (CSV), and arrays of whiskers.

**Centreline**: the first line that is neither empty nor a comment (#) is the header, which states
the coordinates and their unit: `x_mm,y_mm,z_mm` (also `_um`, `_cm`, `_m`; `x (mm)`), or `x,y,z` in
metres. Without z the points are in the plane z = 0. A column `radius_um` or `diameter_um`, in any
of these units or that of the coordinates, is the thickness of the whisker; in empty cells the
radius is interpolated, and constant at the ends. At a discontinuity of the radius, a point may be
in two rows with two radii. Other columns and rows without coordinates are ignored.

**Arrays** are vibrissa's own files, tables, or folders of centrelines. All whiskers are in the head
frame: origin at the tip of the snout (or anywhere on the midline), x to the animal's right, y
forward, z up.

**Table** of an array (CSV), one row per whisker. The name of a column ends with its unit: ``_mm``,
``_um`` or ``_m`` for lengths, ``_deg`` or ``_rad`` for angles.

| columns | |
|---|---|
| `name` | row and column: C2, gamma; with L or R before it, else the side follows from the base |
| `x_mm, y_mm, z_mm` | base point |
| `azimuth_deg, elevation_deg, roll_deg` | angles as defined in `vibrissa.whisker.pose`; or |
| `r11, r12, … r33` | the rotation from the whisker frame to the head frame, row by row |
| `length_mm` | arc length |
| `coefficient_per_mm` | A of the whisker's shape y = A x² (also ``_per_m``) |
| `base_radius_um, tip_radius_um` | optional; by default the published ones for its name |

Other columns are ignored.

**Folder** of an array: one CSV file per whisker with columns ``x_mm,y_mm,z_mm``
(`load_centerline`), from base to tip, named after the whisker: ``C2.csv``, ``left_gamma.csv``.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.io.netcdf import is_netcdf, naming, read_tree, write_netcdf
from vibrissa.io.recording import separate_whiskers, stacked_whiskers
from vibrissa.io.table import (
    LENGTHS,
    Table,
    few_faults,
    in_file,
    is_number,
    read_rows,
    read_text,
    table_rows,
    unit_factor,
    write_table,
)
from vibrissa.numerics import AnyArray, Array
from vibrissa.whisker import (
    Identity,
    Pose,
    Properties,
    Whisker,
    WhiskerArray,
    angles_of,
    base_rotation,
    morphology,
    parabola_curvature,
    published_note,
    published_radii,
)

# Suffix of a column's name and the length it stands for, m.
UNITS = {"": 1.0, "_m": 1.0, "_mm": 1e-3, "_um": 1e-6, "_µm": 1e-6}
ALLOWED = "x_mm,y_mm,z_mm (also _um, _cm, _m) or x,y,z in metres; z may be left out"

# Smallest relative difference of thickness that determines the base.
_COORDINATE = re.compile(r"([xyz])(?![a-z0-9])(.*)", re.IGNORECASE)
_THICKNESS = re.compile(r"(radius|diameter)(?![a-z0-9])(.*)", re.IGNORECASE)
_THINNEST, _THICKEST = 1e-5, 0.1
_TAPERED = 0.01
_STATED = ("radius", "base_radius", "tip_radius", "rat")  # properties that determine the radii
# Columns that name the whisker to which a point belongs.
_NAMING = frozenset({"whisker", "whisker_id", "name", "label", "id"})
_FEWEST = 3  # smallest mean number of points per whisker in a table of several whiskers
_SURE = 4.0  # smallest difference of thickness that determines the base, in standard errors
_PLANAR = "the file has no column z: the whisker was taken to be planar"
_FIRST = (
    "the first point of the file was taken as the base; base='last' (Python) or --base-end last "
    "takes the other end"
)


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
    """
    return _table(Path(path)).points


class _Centreline(NamedTuple):
    """Points (n, 3) and, if stated, radii (n,), m; unit of the coordinates; notes."""

    points: Array
    radii: Array | None
    unit: str
    notes: tuple[str, ...]


def _table(path: Path) -> _Centreline:
    whole = list(table_rows(read_text(path)))
    if not whole:
        raise ValueError(f"{path} is empty; a header {ALLOWED} and at least 4 points are needed")
    header, rows = whole[0], iter(whole[1:])
    _check_one_whisker(path, header[1], whole[1:])
    columns, factor = _columns(path, header[1])
    thickness = _thickness(path, header[1], factor)
    places = [*columns, *(place for place, _ in thickness)]
    array = read_rows(path, rows, len(header[1]), places)
    finite = np.isfinite(array)
    known = np.asarray(finite[:, : len(columns)].any(axis=1))
    notes = _left_out(known, np.asarray(finite.any(axis=1)))
    array = array[known]
    points = array[:, : len(columns)] * factor
    if len(columns) < 3:
        points = np.column_stack([points, np.zeros(len(points))])
        notes.append(_PLANAR)
    others = [name for place, name in enumerate(header[1]) if name and place not in places]
    if others and not thickness:
        notes.append(f"no column radius or diameter was found, and not read: {', '.join(others)}")
    unit = next(name for name, length in LENGTHS.items() if length == factor)
    radii = array[:, -1] * thickness[0][1] if thickness else None
    if radii is not None and not np.isfinite(radii).any():
        radii = None
    return _Centreline(points, radii, unit, tuple(notes))


def _check_one_whisker(path: Path, header: list[str], rows: list[tuple[int, list[str]]]) -> None:
    """Raise ValueError for a table with points of several whiskers."""
    place = next((i for i, name in enumerate(header) if name.lower() in _NAMING), None)
    if place is None:
        return
    names = list(dict.fromkeys(cells[place] for _, cells in rows if place < len(cells)))
    # A name with very few rows is that of a point, not of a whisker.
    if 1 < len(names) <= len(rows) / _FEWEST:
        raise ValueError(
            f"{path} has points of {len(names)} whiskers by its column {header[place]}: "
            f"{few_faults(names)}; a file for each is needed, named after it, such as C2.csv "
            "(a folder of them is an array of whiskers)"
        )


def _left_out(known: AnyArray, filled: AnyArray) -> list[str]:
    """Notes on rows without coordinates, except empty ones at the end of a file."""
    last = int(np.flatnonzero(filled)[-1]) + 1 if filled.any() else 0
    missing = np.flatnonzero(~known[:last])
    if not missing.size:
        return []
    ends = "" if known[0] and known[last - 1] else ", an end of the whisker among them"
    rows = few_faults([f"row {i + 1}" for i in missing])
    return [f"rows without coordinates were left out{ends}: {rows}"]


def _columns(path: Path, header: list[str]) -> tuple[list[int], float]:
    """Indices of the coordinates' columns, and the length of their unit, m."""
    found: dict[float, dict[str, int]] = {}
    for place, name in enumerate(header):
        match = _COORDINATE.fullmatch(name)
        if match and (factor := unit_factor(match[2], "length")) is not None:
            found.setdefault(factor, {}).setdefault(match[1].lower(), place)
    elsewhere = sum("z" in axes for axes in found.values())
    for factor, axes in found.items():
        if {"x", "y"} <= set(axes) and ("z" in axes or not elsewhere):
            return [axes[axis] for axis in "xyz" if axis in axes], factor
    if not all(is_number(name) for name in header):
        raise ValueError(
            f"{path} has the columns {', '.join(header)}; {ALLOWED}, all in one unit, is needed"
        )
    raise ValueError(f"{path} has no header: its first line is numbers; {ALLOWED} is needed")


def _thickness(path: Path, header: list[str], coordinates: float) -> list[tuple[int, float]]:
    """Columns of radius or diameter, and the factor to a radius in m; at most one."""
    found = []
    for place, name in enumerate(header):
        match = _THICKNESS.fullmatch(name)
        if match and (factor := unit_factor(match[2], "length")) is not None:
            unit = factor if match[2].strip() else coordinates
            found.append((place, unit if match[1].lower() == "radius" else 0.5 * unit))
    if len(found) > 1:
        names = " and ".join(header[place] for place, _ in found)
        raise ValueError(f"{path} has {names}; one of them is needed, or none")
    return found


def check_slender(radius: float, length: float) -> None:
    """Raise ValueError for an implausible radius, as in another unit than stated."""
    if not _THINNEST < radius / length < _THICKEST:
        raise ValueError(
            f"the radius is {radius * 1e6:.4g} µm on a whisker of {length * 1e3:.4g} mm; the name "
            "of its column must state its unit, as radius_um does"
        )


def save_centerline(path: str | PathLike[str], points: ArrayLike) -> None:
    """Write a centreline as CSV in mm, with a resolution of 1 nm.

    Parameters
    ----------
    path : str or path
        Path of the table; an existing file is replaced.
    points : array (n, 3)
        Points, m.
    """
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"points have shape {array.shape}; (n, 3) is needed")
    rows = ([f"{x * 1e3:.6f}" for x in row] for row in array)
    write_table(path, ("x_mm", "y_mm", "z_mm"), rows)


def load_whisker(
    path: str | PathLike[str],
    *,
    noise: float | None = None,
    base: str | ArrayLike | None = None,
    **properties: Unpack[Properties],
) -> Whisker:
    """Read a digitised centreline and construct a whisker from it.

    Parameters
    ----------
    path : str or path
        CSV file with columns `x_mm,y_mm,z_mm`, or `x,y,z` in metres. Without z the whisker is
        assumed to be planar, as its notes state.
    noise : float, optional
        Standard deviation of a coordinate, m; 0 for interpolation. By default it is estimated.
    base : {"first", "last"} or array (3,), optional
        End that is the base: by name, or a point near it, m. By default the thicker end if the file
        has radii that differ, otherwise the first point.
    **properties
        Radius and material; see `Whisker`. They take precedence over the radii in the file, which
        then determine the base only.

    Returns
    -------
    Whisker
        Whisker named after the file, unless a name is given.
    """
    points, radii, unit, notes = _table(Path(path))
    properties.setdefault("name", Path(path).stem)
    try:
        if radii is None:
            whisker = Whisker.from_points(points, noise=noise, base=base, **properties)
            notes = (_FIRST, *notes) if base is None else notes
        else:
            whisker = _tapered(points, radii, noise, base, properties)
    except ValueError as fault:
        raise ValueError(
            f"{path}: {fault} (by the header, coordinates are in {unit}; columns in millimetres "
            "must be named x_mm, y_mm, z_mm)"
        ) from None
    return replace(whisker, notes=(*whisker.notes, *notes)) if notes else whisker


def _tapered(
    points: Array,
    radii: Array,
    noise: float | None,
    base: str | ArrayLike | None,
    properties: Properties,
) -> Whisker:
    """Whisker with radii measured along it, unless they are stated; the thicker end is the base."""
    known = np.isfinite(radii)
    replaced = any(properties.get(name) is not None for name in _STATED)
    faults = [f"{radii[i] * 1e6:g} µm at point {i + 1}" for i in np.flatnonzero(radii <= 0.0)]
    if faults and not replaced:
        raise ValueError(
            f"the radius must be positive; it is {'; '.join(faults[:5])} (leave the cell empty "
            "where it was too thin to be measured)"
        )
    notes: tuple[str, ...] = ()
    if base is None:
        thicker = _thicker_end(radii[known])
        if thicker == "last":
            notes = ("its thicker end, the last point of the file, was taken as the base",)
        base, notes = thicker, notes if thicker else (_FIRST,)
    # A point in two rows may have two radii; rows that also repeat the radius raise an error later.
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    jump = (steps == 0.0) & (np.diff(radii) != 0.0)
    whisker = Whisker.from_points(
        points[np.append(True, ~jump)], noise=noise, base=base, **properties
    )
    if replaced:
        return replace(whisker, notes=(*whisker.notes, *notes))
    s = np.append(0.0, np.cumsum(steps)) / steps.sum() * whisker.length
    first, last = (np.linalg.norm(points[end] - whisker.pose.origin) for end in (0, -1))
    if last < first:
        s, radii, known = (whisker.length - s)[::-1], radii[::-1], known[::-1]
    check_slender(float(radii[known].max()), whisker.length)
    samples = np.column_stack([s, radii])[known]
    if samples[0, 0] > 0.0:
        samples = np.vstack([[0.0, samples[0, 1]], samples])
    if samples[-1, 0] < whisker.length:
        samples = np.vstack([samples, [whisker.length, samples[-1, 1]]])
    whisker = whisker.with_properties(radius=samples)
    return replace(whisker, notes=(*whisker.notes, *notes))


def _thicker_end(radii: Array) -> str | None:
    """The end, "first" or "last", at which the whisker is significantly thicker."""
    if radii.size < 2:
        return None
    x = np.linspace(-0.5, 0.5, radii.size)
    slope = x @ radii / (x @ x)
    rest = radii - radii.mean() - slope * x
    error = np.sqrt(rest @ rest / max(radii.size - 2, 1) / (x @ x))
    if abs(slope) <= max(_TAPERED * radii.mean(), _SURE * error):
        return None
    return "last" if slope > 0.0 else "first"


def load_array(
    path: str | PathLike[str], *, base: str | ArrayLike | None = None, noise: float | None = None
) -> WhiskerArray:
    """Read an array of whiskers.

    Parameters
    ----------
    path : str or path
        File written by `save_array` (``.nc``), table of whiskers (``.csv``), or folder of
        centrelines, one file per whisker.
    base : {"first", "last"} or array_like (3,), optional
        End of a centreline that is the base; see `load_whisker`.
    noise : float, optional
        Standard deviation of a coordinate of centrelines, m; see `load_whisker`.

    Returns
    -------
    WhiskerArray
        Whiskers with their poses in the frame of the file.

    Warns
    -----
    UserWarning
        If a whisker of a table is more curved than any whisker of a rat.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is no file or folder {path}")
    if path.is_dir():
        return _folder(path, base, noise)
    if is_netcdf(path):
        tree = read_tree(path, WhiskerArray.kind, "an array of whiskers")
        with naming(path, "an array of whiskers"):
            return WhiskerArray.from_tree(separate_whiskers(tree))
    with in_file(path):
        return WhiskerArray(whiskers_from_table(path))


def save_array(path: str | PathLike[str], array: WhiskerArray) -> None:
    """Write an array of whiskers.

    Parameters
    ----------
    path : str or path
        Path ending in ``.nc``, without loss for any whiskers, or in ``.csv``, a table for whiskers
        that are parabolas with a linear taper, such as those of an average rat.
    array : WhiskerArray
        Array to write.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    ValueError
        If a table is to be written and a whisker has another shape.
    """
    if Path(path).suffix.lower() == ".csv":
        write_table(path, *_as_table(array))
    else:
        write_netcdf(path, stacked_whiskers(array.to_tree()))


def _folder(path: Path, base: Any, noise: float | None) -> WhiskerArray:
    """Array from a folder with one digitised centreline per whisker."""
    files = sorted(file for file in path.iterdir() if file.suffix.lower() == ".csv")
    whiskers, faults, unnamed = [], [], []
    for file in files:
        try:
            identity = Identity.of(file.stem)
        except ValueError as fault:
            unnamed.append(file.name)
            advice = str(fault)
            continue
        try:
            whisker = load_whisker(file, base=base, noise=noise)
        except ValueError as fault:
            faults.append(f"{file.name}: {fault}")
            continue
        if _table(file).radii is None:
            whisker = whisker.with_properties(rat=identity.name)
        whiskers.append(whisker)
    if len(unnamed) == len(files):
        raise ValueError(f"{path} {_of_folder(path)}")
    if unnamed:
        faults.insert(0, f"{', '.join(unnamed)}: {advice}")
    if faults:
        raise ValueError(f"{path}: {few_faults(faults)}")
    with in_file(path):
        return WhiskerArray(whiskers)


def _of_folder(path: Path) -> str:
    """Describe why a folder is not a folder of centrelines."""
    names = sorted(file.name for file in path.iterdir())
    if {".zgroup", ".zarray", "zarr.json"}.intersection(names):
        return "is a Zarr folder, as NWB can be kept in; save it as HDF5, in one file .nwb"
    held = few_faults(names) if names else "nothing"
    return f"is a folder of {held}; one of centrelines, such as C2.csv, or a file is needed"


# Largest entry of RᵀR − 1 that rounding in a table explains.
_ANGLES = ("azimuth", "elevation", "roll")
_ROTATION = tuple(f"r{i}{j}" for i in "123" for j in "123")
_TURNS = {"_deg": np.pi / 180.0, "_rad": 1.0}
_DEG = {"_deg": 1.0}
# Largest numbers of degrees that are probably radians, and of angles; and largest distance of
# bases, over the longest whisker.
_RADIANS, _TWO_TURNS, _FAR_APART = 6.3, 720.0, 20.0
_CURVATURES = {"_per_mm": 1e3, "_per_m": 1.0}
_PLAIN = {"": 1.0}
_RADII = ("base_radius", "tip_radius")
_NEEDED = (
    "name, x_mm, y_mm, z_mm, azimuth_deg, elevation_deg, roll_deg, length_mm and coefficient_per_mm"
)
_NEARLY = 1e-3


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
    for doubt in _doubted_poses(columns, whiskers):
        warnings.warn(f"{path}: {doubt}", stacklevel=3)
    return whiskers


def _doubted_poses(columns: _Columns, whiskers: Sequence[Whisker]) -> Iterator[str]:
    """Reasons why angles or positions of bases are probably in another unit."""
    stated = [columns.values(f"{name}_deg", _PLAIN) for name in _ANGLES if columns.has(name, _DEG)]
    if len(whiskers) > 1 and stated and 0.0 < np.abs(stated).max() <= _RADIANS:
        yield "all angles are below 6.3 degrees, as if they were in radians; name columns _rad then"
    if stated and np.abs(stated).max() > _TWO_TURNS:
        yield f"an angle is {np.abs(stated).max():.4g} degrees, more than two turns"
    bases = np.array([one.pose.origin for one in whiskers])
    apart = np.linalg.norm(bases[:, None] - bases, axis=2)
    longest = max(one.length for one in whiskers)
    if apart.max() > _FAR_APART * longest:
        yield (
            f"bases are {apart.max():.3g} m apart, and the longest whisker is {longest:.3g} m: are "
            "their positions in the unit of their columns?"
        )
    thick = np.array([one.base_radius for one in whiskers])
    close = (apart < thick[:, None] + thick) & ~np.eye(len(bases), dtype=bool)
    if close.any():
        one, other = (whiskers[i].name for i in np.argwhere(close)[0])
        yield f"the bases of {one} and {other} overlap: are positions in the unit of their columns?"


def _whisker(
    name: str, pose: Pose, length: float, coefficient: float, radii: dict[str, float]
) -> Whisker:
    """Whisker described by one row of a table."""
    published = dict(zip(_RADII, published_radii(name, length), strict=True))
    stated: Any = published | radii
    whisker = Whisker.parabola(length, coefficient, name=name, **stated)
    if len(radii) < len(published):
        whisker = replace(whisker, notes=(*whisker.notes, published_note(name, length)))
    for radius in radii.values():
        check_slender(radius, length)
    bound = float(morphology.curvature_bound(length))
    if abs(coefficient) > bound:
        warnings.warn(
            f"{name}: its coefficient, {coefficient * 1e-3:.4g} per mm, is larger than that of any "
            f"rat's whisker of this length ({bound * 1e-3:.4f} per mm): check the units",
            stacklevel=4,
        )
    # A negative coefficient rotates the whisker frame relative to that of the table.
    return replace(whisker, pose=Pose(pose.rotation @ whisker.pose.rotation, pose.origin))


class _Columns(Table):
    """Columns of a table in SI units, with a list of faults."""

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
        """Values of a quantity; missing ones are NaN and recorded as faults."""
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
    # The nearest rotation removes rounding errors of the table.
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def _as_table(array: WhiskerArray) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table of whiskers."""
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
            f"{whisker.name} is not a planar parabola with a linear taper, as a table requires; "
            "NetCDF (.nc) supports any shape"
        )
    return coefficient
