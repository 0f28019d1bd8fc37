"""Digitised centrelines as CSV.

The first line that is neither empty nor a comment (#) is the header. It names the coordinates and
with them the unit: `x_mm,y_mm,z_mm` (also `_um`, `_cm`, `_m`; `x (mm)`), or `x,y,z` in metres.
Without z the points lie in the plane z = 0. A column `radius_um` or `diameter_um`, in any of these
units or that of the coordinates, is the thickness of the whisker there; where its cells are empty,
the radius goes on smoothly between its neighbours, and at the ends as it was. Where it jumps, one
point may stand in two rows with two radii. Other columns are left alone, and so are rows without
any coordinate.
"""

import re
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.io.table import (
    LENGTHS,
    is_number,
    read_rows,
    read_text,
    table_rows,
    unit_factor,
    write_table,
)
from vibrissa.numerics import Array
from vibrissa.whisker import Properties, Whisker

UNITS = {"": 1.0, "_m": 1.0, "_mm": 1e-3, "_um": 1e-6, "_µm": 1e-6}
"""Suffix of a column's name and the length it stands for, m."""

ALLOWED = "x_mm,y_mm,z_mm (also _um, _cm, _m) or x,y,z in metres; z may be left out"

_COORDINATE = re.compile(r"([xyz])(?![a-z0-9])(.*)", re.IGNORECASE)
_THICKNESS = re.compile(r"(radius|diameter)(?![a-z0-9])(.*)", re.IGNORECASE)
_THINNEST, _THICKEST = 1e-5, 0.1
_TAPERED = 0.01
"""Share of the mean radius by which an end is thicker, at least, that counts as the base."""

_SURE = 4.0
"""Standard errors by which it is thicker, at least."""


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
    return _table(Path(path))[0]


def _table(path: Path) -> tuple[Array, Array | None, str]:
    """Points (n, 3) and, if stated, radii (n,), m; and the unit of the coordinates."""
    rows = table_rows(read_text(path))
    header = next(rows, None)
    if header is None:
        raise ValueError(f"{path} is empty; a header {ALLOWED} and at least 4 points are needed")
    columns, factor = _columns(path, header[1])
    thickness = _thickness(path, header[1], factor)
    places = [*columns, *(place for place, _ in thickness)]
    array = read_rows(path, rows, len(header[1]), places)
    array = array[np.isfinite(array[:, : len(columns)]).any(axis=1)]
    points = array[:, : len(columns)] * factor
    if len(columns) == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    unit = next(name for name, length in LENGTHS.items() if length == factor)
    return points, array[:, -1] * thickness[0][1] if thickness else None, unit


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
        if match is None:
            continue
        factor = unit_factor(match[2], "length")
        if factor is None:
            continue
        unit = factor if match[2].strip() else coordinates
        found.append((place, unit if match[1].lower() == "radius" else 0.5 * unit))
    if len(found) > 1:
        names = " and ".join(header[place] for place, _ in found)
        raise ValueError(f"{path} has {names}; one of them is needed, or none")
    return found


def check_slender(radius: float, length: float) -> None:
    """Refuse a radius whose unit is not the stated one."""
    if not _THINNEST < radius / length < _THICKEST:
        raise ValueError(
            f"the radius is {radius * 1e6:.4g} µm on a whisker of {length * 1e3:.4g} mm; its "
            "column must be called by its unit, such as radius_um"
        )


def tells_radius(path: str | PathLike[str]) -> bool:
    """Tell whether a table of a centreline has a column of radii."""
    return _table(Path(path))[1] is not None


def save_centerline(path: str | PathLike[str], points: ArrayLike) -> None:
    """Write a centreline as CSV in mm, to 1 nm.

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
    """Read a digitised centreline and make a whisker of it.

    Parameters
    ----------
    path : str or path
        CSV file with columns `x_mm,y_mm,z_mm`, or `x,y,z` in metres.
    noise : float, optional
        Standard deviation of a coordinate, m; 0 asks for interpolation. By default it is estimated.
    base : {"first", "last"} or array (3,), optional
        End that is the base: by name, or a point near it, m. By default the thicker one where the
        file has radii that differ, and otherwise the first.
    **properties
        Radius and material; see `Whisker`. A radius that is given counts more than the file's.

    Returns
    -------
    Whisker
        Named after the file unless a name is given.
    """
    points, radii, unit = _table(Path(path))
    properties.setdefault("name", Path(path).stem)
    stated = {
        name
        for name in ("radius", "base_radius", "tip_radius", "rat")
        if properties.get(name) is not None
    }
    try:
        if radii is None or stated:
            return Whisker.from_points(points, noise=noise, base=base, **properties)
        return _tapered(points, radii, noise, base, properties)
    except ValueError as fault:
        raise ValueError(f"{path}: {fault} (by the header coordinates are in {unit})") from None


def _tapered(
    points: Array,
    radii: Array,
    noise: float | None,
    base: str | ArrayLike | None,
    properties: Properties,
) -> Whisker:
    """A whisker with the radius that was measured along it; its thicker end is the base."""
    known = np.isfinite(radii)
    if not known.any():
        return Whisker.from_points(points, noise=noise, base=base, **properties)
    faults = [f"{radii[i] * 1e6:g} µm at point {i + 1}" for i in np.flatnonzero(radii <= 0.0)]
    if faults:
        raise ValueError(
            f"the radius must be positive; it is {'; '.join(faults[:5])} (leave the cell empty "
            "where it was too thin to be measured)"
        )
    notes: tuple[str, ...] = ()
    if base is None and _thickens(radii[known]):
        base = "last"
        notes = ("its thicker end, the last point of the file, was taken as the base",)
    # A point in two rows states two radii; rows that repeat their radius too are kept, and refused.
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    jump = (steps == 0.0) & (np.diff(radii) != 0.0)
    whisker = Whisker.from_points(
        points[np.append(True, ~jump)], noise=noise, base=base, **properties
    )
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


def _thickens(radii: Array) -> bool:
    """Whether the last of some radii belong to the thicker end, beyond their scatter."""
    if radii.size < 2:
        return False
    x = np.linspace(-0.5, 0.5, radii.size)
    slope = x @ radii / (x @ x)
    rest = radii - radii.mean() - slope * x
    error = np.sqrt(rest @ rest / max(radii.size - 2, 1) / (x @ x))
    return bool(slope > max(_TAPERED * radii.mean(), _SURE * error))
