"""Base signals over time as a table: columns ``time, Fx, Fy, Fz, Mx, My, Mz`` in s, N and N·m.

CSV, or a NetCDF file with variables of these names along one dimension. Lines that are empty or
begin with # are passed over, other columns are left alone, and an empty cell or ``nan`` is missing.
A name may carry a unit (:mod:`vibrissa.io.table`), ``Fx_mN`` or ``Mx (µN·m)``; other suffixes are
refused by name, and so are numbers that cannot be what they say: too large, or with a moment too
large or small for the force, as |M| / |F| is at most the distance of the contact.
"""

from __future__ import annotations

from itertools import zip_longest
from os import PathLike
from pathlib import Path

import numpy as np

from vibrissa.deferred import xr
from vibrissa.io.netcdf import is_netcdf, naming, read_dataset
from vibrissa.io.table import (
    is_number,
    read_rows,
    read_text,
    signal_columns,
    table_rows,
    unit_factor,
    units_of,
    write_table,
)
from vibrissa.numerics import Array
from vibrissa.quantities import attributes
from vibrissa.whisker import Whisker

COLUMNS = ("time", "Fx", "Fy", "Fz", "Mx", "My", "Mz")
"""Names of the columns, in the order in which they are written."""

NUMBERED = "there is no time, so the rows are numbered from 0 in its column"
"""Note on a table without time."""

_KINDS = {"t": "time", "F": "force", "M": "moment"}
# What a wire of steel as thick as a finger holds.
_LARGEST = {"F": (1e4, "N"), "M": (1e3, "N·m")}
# Seconds since any epoch are fewer.
_LATEST = 1e11
# Time between rows, s, of several from which it is likelier in ms.
_SLOW, _SEVERAL = 1.0, 10
_LEVER_ARMS = (1e-4, 1.0)
# Of whiskers bent to their fold 0.3 L from the base, forces and moments stay below 40 times these.
_LARGEST_SCALES = 100.0


def load_signals(path: str | PathLike[str]) -> xr.Dataset:
    """Read a table of base signals.

    Parameters
    ----------
    path : str or path
        CSV or NetCDF.

    Returns
    -------
    xarray.Dataset
        Dims time, space: ``force``, N, and ``moment``, N·m, in the whisker's frame at its base.
        Rows of a CSV without time are numbered from 0 instead. The attribute ``notes``, if there,
        states that, or where time does not increase.
    """
    path = Path(path)
    table = _netcdf(path) if is_netcdf(path) else _csv(path)
    notes = _notes(table[:, 0])
    if np.isnan(table[:, 0]).all():
        table[:, 0], notes = np.arange(len(table)), [NUMBERED]
    _check_time(path, table[:, 0])
    _check_magnitudes(path, table)
    _check_lever_arm(path, table)
    return _dataset(table).assign_attrs(notes=notes)


def _notes(time: Array) -> list[str]:
    """Note where time does not rise, as when trials stand one below the other."""
    known = np.flatnonzero(np.isfinite(time))
    step = np.diff(time[known])
    notes = []
    for wrong, fault in ((step < 0.0, "goes back"), (step == 0.0, "stands still")):
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            before, after = known[first], known[first + 1]
            notes.append(
                f"time {fault} in {int(wrong.sum())} of {time.size} rows, first in row "
                f"{after + 1}, from {time[before]:g} to {time[after]:g} s; rows are "
                "evaluated each on its own, in the order of the file"
            )
    if step.size >= _SEVERAL and (usual := float(np.median(step))) >= _SLOW:
        notes.append(
            f"rows are {usual:.3g} s apart: where time is in ms the column is called time_ms"
        )
    return notes


def check_scale(wrench: xr.Dataset, whisker: Whisker) -> None:
    """Refuse forces and moments that are far too large to have bent this whisker."""
    stiffness = whisker.base_bending_stiffness
    scales = {"force": stiffness / whisker.length**2, "moment": stiffness / whisker.length}
    faults = []
    for name, scale in scales.items():
        size = np.linalg.norm(wrench[name].values, axis=-1)
        size = size[np.isfinite(size)]
        typical = float(np.quantile(size, 0.95)) if size.size else 0.0
        if typical > _LARGEST_SCALES * scale:
            unit = attributes(name)["units"].replace(" ", "·")
            faults.append(
                f"the {name} reaches {typical:.3g} {unit}, {typical / scale:.2g} times the "
                f"{scale:.2g} {unit} that is natural to this whisker"
            )
    if faults:
        raise ValueError(
            f"{'; '.join(faults)}: these look like mN and mN·m, or µN and µN·m, given as N and "
            f"N·m (multiply by 1e-3 or 1e-6), or like another whisker than {whisker!r}"
        )


def save_signals(path: str | PathLike[str], signals: xr.Dataset) -> None:
    """Write a table of base signals as CSV, every number in full.

    Parameters
    ----------
    path : str or path
        Path of the table; an existing file is replaced.
    signals : xarray.Dataset
        Dims time, space: ``force`` and ``moment``.

    Raises
    ------
    ValueError
        If the dataset has other dims or lacks a variable.
    """
    missing = [name for name in ("time", "force", "moment") if name not in signals.variables]
    if missing:
        raise ValueError(f"signals lack {', '.join(missing)}")
    wrench = [signals[name] for name in ("force", "moment")]
    for variable in wrench:
        if variable.dims != ("time", "space"):
            raise ValueError(f"{variable.name} has dims {variable.dims}; time, space are needed")
    array = np.column_stack([signals["time"].values, *(v.values for v in wrench)]).astype(float)
    write_table(path, COLUMNS, array.tolist())


def _csv(path: Path) -> Array:
    """Columns (n, 7) of a CSV file."""
    rows = table_rows(read_text(path))
    header = next(rows, None)
    if header is None:
        raise ValueError(f"{path} is empty; a header {','.join(COLUMNS)} and rows are needed")
    names, later = header[1], list(rows)
    # Some programs write units in a line of their own.
    if later and not any(is_number(cell) for cell in later[0][1]):
        names = [f"{name} ({unit})" for name, unit in zip_longest(names, later[0][1], fillvalue="")]
        del later[0]
    columns, factors = _columns(path, names)
    values = read_rows(path, iter(later), len(names), columns)
    if not len(values):
        raise ValueError(f"{path} has a header but no rows")
    timed = len(columns) == len(COLUMNS)
    return values * factors if timed else np.insert(values * factors, 0, np.nan, axis=1)


def _columns(path: Path, header: list[str]) -> tuple[list[int], Array]:
    """Find each column and its unit; all that is wrong with the header is one error."""
    found, strange = signal_columns(header, COLUMNS)
    missing = [name for name in COLUMNS[1:] if name not in found and name not in strange]
    faults = [f"it lacks {', '.join(missing)}"] if missing else []
    if strange:
        cells = [cell for columns in strange.values() for cell in columns]
        kinds = dict.fromkeys(_KINDS[name[0]] for name in strange)
        units = ", ".join(units_of(kind) for kind in kinds)
        faults.append(f"{', '.join(cells)} are in no units that are known, such as {units}")
    if faults:
        got = ", ".join(header)
        if all(is_number(cell) for cell in header):
            faults = ["its first line is numbers, not names (lines with # are comments)"]
        raise ValueError(
            f"{path} is not a table of signals: {'; '.join(faults)}. It has the columns {got}; "
            f"{', '.join(COLUMNS)} are needed, in SI units or with one as in Fx_mN"
        )
    places = [found[name] for name in COLUMNS if name in found]
    twice = [header[place] for place, _ in places if header.count(header[place]) > 1]
    if twice:
        raise ValueError(f"{path} has the column {', '.join(twice)} more than once")
    return [place for place, _ in places], np.array([factor for _, factor in places])


def _netcdf(path: Path) -> Array:
    """Columns (n, 7) of a NetCDF file."""
    data = read_dataset(path)
    missing = [name for name in COLUMNS if name not in data.variables]
    if missing:
        got = ", ".join(str(name) for name in data.variables)
        raise ValueError(
            f"{path} is not a table of signals: it lacks {', '.join(missing)} (it has {got})"
        )
    with naming(path, "a table of signals"):
        columns = [_in_si(path, data[name]) for name in COLUMNS]
    if any(column.ndim != 1 for column in columns) or len({c.size for c in columns}) != 1:
        shapes = {name: c.shape for name, c in zip(COLUMNS, columns, strict=True)}
        raise ValueError(f"{path}: all columns must run along time; got shapes {shapes}")
    return np.column_stack(columns)


def _in_si(path: Path, variable: xr.DataArray) -> Array:
    """Values of a variable by its attribute ``units``, if it has one."""
    kind = _KINDS[str(variable.name)[0]]
    unit = str(variable.attrs.get("units", ""))
    factor = unit_factor(unit, kind)
    if factor is None:
        raise ValueError(f"{path}: {variable.name} is in {unit}; {units_of(kind)} are known")
    return np.asarray(variable.values, dtype=np.float64) * factor


def _check_time(path: Path, time: Array) -> None:
    late = np.flatnonzero(np.abs(time) > _LATEST)
    if late.size:
        raise ValueError(
            f"{path}: time is {time[late[0]]:.6g} s in row {late[0] + 1}, more than any date in "
            "seconds: if it is in ms, µs or ns, call the column time_ms, time_us or time_ns"
        )


def _check_magnitudes(path: Path, table: Array) -> None:
    faults = []
    for i, name in enumerate(COLUMNS[1:], start=1):
        largest, unit = _LARGEST[name[0]]
        values = np.abs(table[:, i])
        got = float(np.max(values, initial=0.0, where=np.isfinite(values)))
        if got > largest:
            faults.append(f"{name} reaches {got:.3g} {unit}")
        if np.isinf(values).any():
            faults.append(f"{name} has infinite values")
    if faults:
        raise ValueError(
            f"{path}: {'; '.join(faults)}. Forces on an animal's whisker are millinewtons at most, "
            "on a robot's a hundred newtons: the table must be in N and N·m"
        )


def _check_lever_arm(path: Path, table: Array) -> None:
    """Refuse forces and moments in units that do not belong together."""
    force, moment = (np.linalg.norm(table[:, part], axis=1) for part in (slice(1, 4), slice(4, 7)))
    known = np.isfinite(force + moment)
    if not known.any():
        return
    loaded = known & (force > 0.5 * np.quantile(force[known], 0.95))
    if not loaded.any():
        return
    arm = float(np.median(moment[loaded] / force[loaded]))
    least, most = _LEVER_ARMS
    if arm > most:
        advice = "moments look like mN·mm, µN·m or mN·m (multiply by 1e-6, 1e-6 or 1e-3)"
    elif 0 < arm < least:
        advice = "forces look like mN or µN (multiply by 1e-3 or 1e-6)"
    else:
        return
    if least < 1.0 / arm < most:
        advice += ", or force and moment are in each other's columns"
    raise ValueError(
        f"{path}: force and moment do not belong together: |M| / |F|, the distance of the contact "
        f"or less, is {arm:.2g} m, and {least:g} to {most:g} m is possible. The {advice}; the "
        "table must be in N and N·m"
    )


def _dataset(table: Array) -> xr.Dataset:
    frame = {"reference_frame": "whisker"}
    return xr.Dataset(
        {
            "force": (("time", "space"), table[:, 1:4], {**attributes("force"), **frame}),
            "moment": (("time", "space"), table[:, 4:7], {**attributes("moment"), **frame}),
        },
        {
            "time": xr.Variable("time", table[:, 0], attributes("time")),
            "space": list("xyz"),
        },
    )
