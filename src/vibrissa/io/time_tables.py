"""Tables over time: reading of base signals; writing of contacts, contour points and predictors.

**Base signals**: columns ``time, Fx, Fy, Fz, Mx, My, Mz`` in s, N and N·m, as CSV, or a NetCDF file
with variables of these names along one dimension. Empty lines, lines that begin with # and other
columns are ignored; an empty cell or ``nan`` is missing. A name may have a unit
(:mod:`vibrissa.io.table`), ``Fx_mN`` or ``Mx (µN·m)``; other suffixes are errors, and so are
implausible values: too large, or with moments too large or small for the forces, as |M| / |F| is at
most the distance of the contact.

**Contact points** (CSV): ``time, x, y, z, r, theta, phi, sigma_x, …, status``, in SI units and the
whisker frame; the status is written by name, and missing values as ``nan``. Estimates also have the
assumed ``friction``, the same in all rows; ``event`` (none, onset, loss, slip); and the time of the
current contact's onset, ``onset_time``, with its standard deviation ``onset_sigma``. Estimates
around known objects have the arc lengths of the first and the last contact, ``arc_length`` and
``last_arc_length``, and the displacement of the objects in the laboratory frame, ``shift_x``,
``shift_y``, ``shift_z``.

**Contour points** (CSV): ``time, whisker, x, y, z, sigma_x, …``, one row per contact, in SI units
and the laboratory frame: the contact point on the whisker's centreline with its standard
deviations, the surface's outward normal there, the point on the surface, one whisker radius away,
and, if an object was fitted, the distance of the whisker's surface from it and a flag for inliers.

**Predictors** of a trial: as CSV, with one line ``# name [unit]: meaning`` per column, the header,
and one row per frame and whisker; or for MATLAB, with a matrix (frames, whiskers) per column,
``time``, ``whisker``, the names of the ``predictors`` of spike models, and ``units`` and
``descriptions`` by column.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from os import PathLike
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import xr
from vibrissa.io.netcdf import is_netcdf, naming, read_dataset
from vibrissa.io.paths import CSV, check_writable, replacing
from vibrissa.io.table import (
    Table,
    check_one_column_each,
    in_file,
    is_number,
    read_rows,
    read_text,
    signal_columns,
    table_rows,
    table_text,
    unit_factor,
    units_of,
    write_table,
)
from vibrissa.numerics import Array
from vibrissa.quantities import attributes
from vibrissa.status import Event, Status, flag_attributes
from vibrissa.whisker import Whisker

# Names of the columns, in the order in which they are written.
COLUMNS = ("time", "Fx", "Fy", "Fz", "Mx", "My", "Mz")
# Note for tables without time.
NUMBERED = "there is no time, so the rows are numbered from 0 in its column"
_KINDS = {"t": "time", "F": "force", "M": "moment"}
_LARGEST = {"F": (1e4, "N"), "M": (1e3, "N·m")}  # strength of a steel wire as thick as a finger
_LATEST = 1e11  # largest plausible time since any epoch, s
# Interval between rows, s, above which the unit of time is probably ms; smallest number of rows.
_SLOW, _SEVERAL = 1.0, 10
_LEVER_ARMS = (1e-4, 1.0)
# Largest plausible force and moment, in units of the whisker's scales: for contacts at 0.3 L they
# stay below 40 up to slip-off.
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
        Dataset with dimensions time, space: ``force``, N, and ``moment``, N·m, at the base, in the
        whisker frame. Without a time column, rows are numbered from 0. The attribute ``notes``, if
        present, states this, or where time does not increase.
    """
    time, force, moment, notes = read_signals(Path(path))
    frame = {"reference_frame": "whisker"}
    return xr.Dataset(
        {
            "force": (("time", "space"), force, {**attributes("force"), **frame}),
            "moment": (("time", "space"), moment, {**attributes("moment"), **frame}),
        },
        {"time": ("time", time, attributes("time")), "space": list("xyz")},
        {"notes": notes},
    )


def read_signals(path: Path) -> tuple[Array, Array, Array, list[str]]:
    """Time (n,), force and moment (n, 3), and notes of a table of base signals."""
    table = _netcdf(path) if is_netcdf(path) else _csv(path)
    notes = time_notes(table[:, 0])
    if np.isnan(table[:, 0]).all():
        table[:, 0], notes = np.arange(len(table)), [NUMBERED]
    late = np.flatnonzero(np.abs(table[:, 0]) > _LATEST)
    if late.size:
        raise ValueError(
            f"{path}: time is {table[late[0], 0]:.6g} s in row {late[0] + 1}, more than any date "
            "in seconds: if it is in ms, µs or ns, call the column time_ms, time_us or time_ns"
        )
    _check_magnitudes(path, table)
    _check_lever_arm(path, table)
    return table[:, 0], table[:, 1:4], table[:, 4:7], notes


def time_notes(time: Array) -> list[str]:
    """Notes on times that are missing or do not increase, and on implausible steps."""
    known = np.flatnonzero(np.isfinite(time))
    step = np.diff(time[known])
    notes = []
    if known.size < time.size:
        first = int(np.flatnonzero(~np.isfinite(time))[0])
        notes.append(
            f"time is missing in {time.size - known.size} of {time.size} rows, first in row "
            f"{first + 1}; what depends on it, as onsets, is unknown there"
        )
    for wrong, fault in ((step < 0.0, "goes back"), (step == 0.0, "stands still")):
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            before, after = known[first], known[first + 1]
            notes.append(
                f"time {fault} in {int(wrong.sum())} of {time.size} rows, first in row "
                f"{after + 1}, from {time[before]:g} to {time[after]:g} s; rows are "
                "evaluated each on its own, in the order of the file"
            )
    if usual := slow_steps(time):
        notes.append(
            f"rows are {usual:.3g} s apart: where time is in ms the column is called time_ms"
        )
    return notes


def slow_steps(time: Array) -> float:
    """Usual interval between times, s, if it is so long that these may be in ms; otherwise 0."""
    step = np.diff(time[np.isfinite(time)])
    usual = float(np.median(step)) if step.size >= _SEVERAL else 0.0
    return usual if usual >= _SLOW else 0.0


def check_scale(force: ArrayLike, moment: ArrayLike, whisker: Whisker) -> None:
    """Raise ValueError for forces and moments far too large for this whisker."""
    stiffness = whisker.base_bending_stiffness
    scales = {
        "force": (force, stiffness / whisker.length**2),
        "moment": (moment, stiffness / whisker.length),
    }
    faults = []
    for name, (values, scale) in scales.items():
        size = np.linalg.norm(values, axis=-1)
        size = size[np.isfinite(size)]
        typical = float(np.quantile(size, 0.95)) if size.size else 0.0
        if typical > _LARGEST_SCALES * scale:
            unit = attributes(name)["units"].replace(" ", "·")
            faults.append(
                f"the {name} reaches {typical:.3g} {unit}, {typical / scale:.2g} times this "
                f"whisker's scale of {scale:.2g} {unit}"
            )
    if faults:
        raise ValueError(
            f"{'; '.join(faults)}: these look like mN and mN·m, or µN and µN·m, given as N and "
            f"N·m (multiply by 1e-3 or 1e-6), or like another whisker than {whisker!r}"
        )


def save_signals(path: str | PathLike[str], signals: xr.Dataset) -> None:
    """Write a table of base signals as CSV, with full precision.

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
    if missing := [name for name in ("time", "force", "moment") if name not in signals.variables]:
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
    if (header := next(rows, None)) is None:
        raise ValueError(f"{path} is empty; a header {','.join(COLUMNS)} and rows are needed")
    names, later = header[1], list(rows)
    # Some programs write units in a separate line.
    if later and not any(is_number(cell) for cell in later[0][1]):
        names = [f"{name} ({unit})" for name, unit in zip_longest(names, later[0][1], fillvalue="")]
        del later[0]
    if "whisker" in names:
        at = names.index("whisker")
        if len(several := dict.fromkeys(row[at] for _, row in later if at < len(row))) > 1:
            raise ValueError(
                f"{path} has the signals of {len(several)} whiskers, {', '.join(several)}; one "
                "table each is needed, or the recording"
            )
    columns, factors = _signal_places(path, names)
    values = read_rows(path, iter(later), len(names), columns)
    if not len(values):
        raise ValueError(f"{path} has a header but no rows")
    timed = len(columns) == len(COLUMNS)
    return values * factors if timed else np.insert(values * factors, 0, np.nan, axis=1)


def _signal_places(path: Path, header: list[str]) -> tuple[list[int], Array]:
    """Indices and units of the columns; raise one ValueError for all faults of the header."""
    with in_file(path):
        check_one_column_each(header, COLUMNS)
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
    return [place for place, _ in places], np.array([factor for _, factor in places])


def _netcdf(path: Path) -> Array:
    """Columns (n, 7) of a NetCDF file."""
    data = read_dataset(path)
    if missing := [name for name in COLUMNS if name not in data.variables]:
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
    if (factor := unit_factor(unit, kind)) is None:
        raise ValueError(f"{path}: {variable.name} is in {unit}; {units_of(kind)} are known")
    return np.asarray(variable.values, dtype=np.float64) * factor


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
    """Raise ValueError for forces and moments in inconsistent units."""
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
        f"{path}: force and moment are inconsistent: |M| / |F|, at most the distance of the "
        f"contact, is {arm:.2g} m, and {least:g} to {most:g} m is possible. The {advice}; the "
        "table must be in N and N·m"
    )


# Names of the numeric columns, in order; the last column is the status.
NUMBERS = ("time", "x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
# Numeric columns that are written only if the dataset has them.
_AROUND = ("arc_length", "last_arc_length", "shift_x", "shift_y", "shift_z")
_OPTIONAL = (*_AROUND, "one_contact", "friction", "onset_time", "onset_sigma")
# Columns of names before the status, with their enumerations, also written only if present.
_FLAGS: dict[str, type[Status | Event]] = {"event": Event}
# Variables of estimated contacts from which columns are made.
_ESTIMATED = {"contact_point", "covariance", "r", "theta", "phi", "status"}


@runtime_checkable
class Estimated(Protocol):
    """Estimated contacts, `Contacts`."""

    def to_dataset(self) -> xr.Dataset:
        """Contacts with all their variables."""


def save_contacts(
    path: str | PathLike[str], contacts: xr.Dataset | Mapping[str, ArrayLike] | Estimated
) -> None:
    """Write contact points as CSV, with full precision.

    Parameters
    ----------
    path : str or path
        Path of the table; an existing file is replaced.
    contacts : Contacts, xarray.Dataset, or mapping of name to array (n,)
        Estimated contacts of measurements in a row, numbered from 0 where they have no time; or
        a variable for each column, dim time. Columns that it lacks are written as missing, but
        ``time``, ``x``, ``y``, ``z`` and ``status`` must be there.

    Raises
    ------
    ValueError
        If a needed variable is not there, or one has another dim.
    """
    if isinstance(contacts, Estimated):
        contacts = contacts.to_dataset()
    # Columns in a mapping need no xarray, which takes long to import.
    if not _ESTIMATED - set(contacts) and isinstance(contacts, xr.Dataset):
        contacts = _of_estimates(contacts)
    numbers = (*NUMBERS, *(name for name in _OPTIONAL if name in contacts))
    flags = (*(name for name in _FLAGS if name in contacts), "status")
    columns = _columns(contacts, "contacts", (*numbers, *flags), "time", ("status",))
    table = np.column_stack(columns[: len(numbers)]).tolist()
    words = [
        [_FLAGS.get(name, Status)(int(code)).name.lower() for code in codes]
        for name, codes in zip(flags, columns[len(numbers) :], strict=True)
    ]
    rows = ([*row, *word] for row, *word in zip(table, *words, strict=True))
    write_table(path, (*numbers, *flags), rows)


def _of_estimates(contacts: xr.Dataset) -> dict[str, ArrayLike]:
    """Columns of estimated contacts (`Contacts.to_dataset`), whisker frame."""
    point = contacts["contact_point"]
    if point.ndim != 2:
        raise ValueError(
            f"a table has one contact in each row; got contacts of shape {point.shape[:-1]}"
        )
    variance = np.diagonal(contacts["covariance"].values, axis1=-2, axis2=-1)
    out = dict(zip("xyz", point.values.T, strict=True))
    out |= {f"sigma_{axis}": np.sqrt(v) for axis, v in zip("xyz", variance.T, strict=True)}
    time = contacts["time"].values if "time" in contacts else np.arange(float(len(point)))
    kept = {name: contacts[name].values for name in ("r", "theta", "phi", "status")}
    friction = np.full(len(point), contacts.attrs.get("friction", np.nan))
    return {"time": time, **out, **kept, "friction": friction}


def _columns(
    data: xr.Dataset | Mapping[str, ArrayLike],
    what: str,
    names: Sequence[str],
    dim: str,
    needed: Sequence[str] = (),
) -> list[np.ndarray]:
    """Columns along the dimension of a table; missing ones are NaN."""
    if missing := [n for n in ("time", "x", "y", "z", *needed) if n not in data]:
        raise ValueError(f"{what} lack {', '.join(missing)}")
    there = [name for name in names if name in data]
    if faults := [name for name in there if getattr(data[name], "dims", (dim,)) != (dim,)]:
        raise ValueError(f"{', '.join(faults)} must have the one dim {dim}")
    columns = {name: np.asarray(data[name]) for name in there}
    nothing = np.full(len(columns[there[0]]), np.nan)
    return [columns.get(name, nothing) for name in names]


def load_contacts(path: str | PathLike[str]) -> xr.Dataset:
    """Read contact points written by `save_contacts`.

    Parameters
    ----------
    path : str or path
        The CSV file.

    Returns
    -------
    xarray.Dataset
        Dim time; a variable for each column, ``status`` as its number.
    """
    there = Table(path).names
    numbers = (*NUMBERS, *(name for name in _OPTIONAL if name in there))
    flags = (*(name for name in _FLAGS if name in there), "status")
    table = Table(path, (*numbers, *flags))
    columns = {name: xr.Variable("time", table.numbers(name), attributes(name)) for name in numbers}
    for flag in flags:
        kind = _FLAGS.get(flag, Status)
        codes = [kind.__members__.get(name.upper()) for name in table.text(flag)]
        table.refuse(np.array([code is None for code in codes], dtype=bool), "no contact")
        about = {**attributes(flag), **flag_attributes(kind)}
        columns[flag] = xr.Variable("time", np.array(codes, dtype=np.int8), about)
    return xr.Dataset({k: v for k, v in columns.items() if k != "time"}, {"time": columns["time"]})


def events_in(contacts: xr.Dataset) -> Iterator[tuple[float, str, str, float]]:
    """Yield time, s, whisker, event and an onset's standard deviation, s, of events, in order."""
    names = ("event", "onset_time", "onset_sigma")
    if not set(names) <= set(contacts):
        return
    codes, begun, sigma = (contacts[one].transpose("time", "whisker").values for one in names)
    time, whiskers = contacts["time"].values, contacts["whisker"].values
    for i, k in np.argwhere(codes != Event.NONE).tolist():
        event, name = Event(int(codes[i, k])), str(whiskers[k])
        if event == Event.ONSET:
            yield float(begun[i, k]), name, "onset", float(sigma[i, k])
        else:
            yield float(time[i]), name, event.name.lower(), np.nan


# Names of the columns, in their order.
CONTOUR = (
    *("time", "whisker", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z"),
    *("normal_x", "normal_y", "normal_z", "surface_x", "surface_y", "surface_z"),
    *("surface_distance", "inlier"),
)

MATLAB_PREDICTORS = b"MATLAB 5.0 MAT-file, table of predictors by vibrissa"


def save_contour(path: str | PathLike[str], contour: xr.Dataset) -> None:
    """Write contour points as CSV, with full precision.

    Parameters
    ----------
    path : str or path
        Path of the table; an existing file is replaced.
    contour : xarray.Dataset
        Dim contact; a variable for each column. Those that it lacks are written as missing, but
        ``time``, ``x``, ``y`` and ``z`` must be there.

    Raises
    ------
    ValueError
        If a needed variable is not there, or one has another dim.
    """
    content = _contour_content(contour)
    with replacing(path) as part:
        part.write_bytes(content)


def holds_contour(path: str | PathLike[str], contour: xr.Dataset) -> bool:
    """Whether a file is identical to what `save_contour` would write."""
    return Path(path).read_bytes() == _contour_content(contour)


def _contour_content(contour: xr.Dataset) -> bytes:
    columns = _columns(contour, "contour points", CONTOUR, "contact")
    plain = [(one.astype(int) if one.dtype == bool else one).tolist() for one in columns]
    return table_text(CONTOUR, zip(*plain, strict=True)).encode()


def save_predictors(path: str | PathLike[str], table: xr.Dataset) -> None:
    """Write a table of predictors."""
    path = check_writable(path, (*CSV, ".mat"))
    columns = {str(name): one.transpose("time", "whisker") for name, one in table.items()}
    with replacing(path) as part:
        if path.suffix.lower() == ".mat":
            _write_matlab(part, table, columns)
        else:
            part.write_text(_text(table, columns), encoding="utf-8")


def meaning(variable: xr.DataArray) -> str:
    """Long name and description of a variable, in a line."""
    return f"{variable.attrs['long_name']}. {variable.attrs.get('description', '')}".strip()


def _text(table: xr.Dataset, columns: dict[str, xr.DataArray]) -> str:
    about = [f"# predictors of models of spikes: {table.attrs['predictors']}"]
    about += [f"# {name} [{one.attrs['units']}]: {meaning(one)}" for name, one in columns.items()]
    time, whiskers = table["time"].values.tolist(), table["whisker"].values.tolist()
    values = [_plain(name, one.values) for name, one in columns.items()]
    rows = (
        [moment, whisker, *(column[i][k] for column in values)]
        for i, moment in enumerate(time)
        for k, whisker in enumerate(whiskers)
    )
    # Readers that skip comments drop the rest of a line after a # that is not quoted.
    marked = any("#" in str(name) for name in whiskers)
    return "\n".join(about) + "\n" + table_text(("time", "whisker", *columns), rows, marked)


def _plain(name: str, values: np.ndarray) -> list[list[object]]:
    """Values as written: flags as 0 and 1, statuses and events by name."""
    kind = Status if name == "status" else _FLAGS.get(name)
    if kind is not None:
        return [[kind(int(code)).name.lower() for code in row] for row in values]
    found: list[list[object]] = (values.astype(int) if values.dtype == bool else values).tolist()
    return found


def _write_matlab(path: PathLike[str], table: xr.Dataset, columns: dict[str, xr.DataArray]) -> None:
    from scipy.io import savemat

    content = {
        "time": table["time"].values[:, None],
        "whisker": np.array(table["whisker"].values.tolist(), dtype=object),
        "predictors": np.array(table.attrs["predictors"].split(), dtype=object),
        "units": {name: one.attrs["units"] for name, one in columns.items()},
        "descriptions": {name: meaning(one) for name, one in columns.items()},
        "statuses": {status.name.lower(): int(status) for status in Status},
        "events": {event.name.lower(): int(event) for event in Event},
        **{name: one.values for name, one in columns.items()},
    }
    savemat(path, content, appendmat=False, long_field_names=True, oned_as="column")
    # The text at the start is free. SciPy writes the time there, and equal tables would differ.
    with Path(path).open("r+b") as file:
        file.write(MATLAB_PREDICTORS.ljust(116))
