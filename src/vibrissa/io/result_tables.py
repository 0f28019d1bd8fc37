"""Contact points, contour points and predictors over time, as tables.

Contact points as CSV: ``time, x, y, z, r, theta, phi, sigma_x, …, status``. In SI units and the
whisker's frame; the status is written by its name, and missing is ``nan``.

Contour points as CSV: ``time, whisker, x, y, z, sigma_x, …``, a line for each contact. In SI units
and the laboratory frame: the contact point on the whisker's centreline with its standard
deviations, the surface's outward normal there, the point of the surface, one whisker radius away,
and, where an object was fitted, how far the surface of the whisker is from it and whether the
contact is not an outlier.

Predictors of a trial as CSV, first a line ``# name [unit]: meaning`` for each column, then the
header and a line for each frame and whisker; or for MATLAB, a matrix (frames, whiskers) for each
column, ``time``, ``whisker``, the names of the ``predictors`` of models of spikes, and ``units``
and ``descriptions`` by column.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from vibrissa.deferred import xr
from vibrissa.io.paths import CSV, check_writable, replacing
from vibrissa.io.table import Table, table_text, write_table
from vibrissa.quantities import attributes
from vibrissa.status import Status, flag_attributes

NUMBERS = ("time", "x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
"""Names of the columns with numbers, in their order; the last column is the status."""

_OPTIONAL = ("one_contact",)
"""Columns before the status that are written where there is something to write."""


def save_contacts(path: str | PathLike[str], contacts: xr.Dataset) -> None:
    """Write contact points, every number in full.

    Parameters
    ----------
    path : str or path
        Path of the table; an existing file is replaced.
    contacts : xarray.Dataset
        Dim time; a variable for each column. Columns that it lacks are written as missing, but
        ``time``, ``x``, ``y``, ``z`` and ``status`` must be there.

    Raises
    ------
    ValueError
        If a needed variable is not there, or one has another dim.
    """
    names = (*NUMBERS, *(name for name in _OPTIONAL if name in contacts), "status")
    *numbers, codes = _columns(contacts, "contacts", names, "time", ("status",))
    words = [Status(int(code)).name.lower() for code in codes]
    table = np.column_stack(numbers).tolist()
    rows = ([*row, word] for row, word in zip(table, words, strict=True))
    write_table(path, names, rows)


def _columns(
    data: xr.Dataset, what: str, names: Sequence[str], dim: str, needed: Sequence[str] = ()
) -> list[np.ndarray]:
    """Columns along the one dimension of a table, NaN where there are none."""
    missing = [n for n in ("time", "x", "y", "z", *needed) if n not in data.variables]
    if missing:
        raise ValueError(f"{what} lack {', '.join(missing)}")
    there = [name for name in names if name in data.variables]
    faults = [name for name in there if data[name].dims != (dim,)]
    if faults:
        raise ValueError(f"{', '.join(faults)} must have the one dim {dim}")
    nothing = np.full(data.sizes[dim], np.nan)
    return [data[name].values if name in there else nothing for name in names]


def load_contacts(path: str | PathLike[str]) -> xr.Dataset:
    """Read contact points that `save_contacts` wrote.

    Parameters
    ----------
    path : str or path
        The CSV file.

    Returns
    -------
    xarray.Dataset
        Dim time; a variable for each column, ``status`` as its number.
    """
    numbers = (*NUMBERS, *(name for name in _OPTIONAL if name in Table(path).names))
    table = Table(path, (*numbers, "status"))
    codes = [Status.__members__.get(name.upper()) for name in table.text("status")]
    table.refuse(np.array([code is None for code in codes], dtype=bool), "no contact")
    columns = {name: xr.Variable("time", table.numbers(name), attributes(name)) for name in numbers}
    about = {**attributes("status"), **flag_attributes()}
    columns["status"] = xr.Variable("time", np.array(codes, dtype=np.int8), about)
    return xr.Dataset({k: v for k, v in columns.items() if k != "time"}, {"time": columns["time"]})


CONTOUR = (
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
        Path of the table; an existing file is replaced.
    contour : xarray.Dataset
        Dim contact; a variable for each column. Those that it lacks are written as missing, but
        ``time``, ``x``, ``y`` and ``z`` must be there.

    Raises
    ------
    ValueError
        If a needed variable is not there, or one has another dim.
    """
    text = _contour_text(contour)
    with replacing(path) as part:
        part.write_bytes(text.encode("utf-8"))


def holds_contour(path: str | PathLike[str], contour: xr.Dataset) -> bool:
    """Tell whether a file is just what `save_contour` writes of contour points."""
    return Path(path).read_bytes() == _contour_text(contour).encode("utf-8")


def _contour_text(contour: xr.Dataset) -> str:
    columns = _columns(contour, "contour points", CONTOUR, "contact")
    plain = [(one.astype(int) if one.dtype == bool else one).tolist() for one in columns]
    return table_text(CONTOUR, zip(*plain, strict=True))


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
    return "\n".join(about) + "\n" + table_text(("time", "whisker", *columns), rows)


def _plain(name: str, values: np.ndarray) -> list[list[object]]:
    """Numbers as they are written: flags as 0 and 1, statuses by name."""
    if name == "status":
        return [[Status(int(code)).name.lower() for code in row] for row in values]
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
        **{name: one.values for name, one in columns.items()},
    }
    savemat(path, content, appendmat=False, long_field_names=True, oned_as="column")
