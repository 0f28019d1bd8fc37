"""Contact points over time as CSV: ``time, x, y, z, r, theta, phi, sigma_x, …, status``.

In SI units and the whisker's frame; the status is written by its name, and missing is ``nan``.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa.io.replace import replacing
from vibrissa.io.table import read_text, table_rows
from vibrissa.quantities import attributes
from vibrissa.status import Status, flag_attributes

NUMBERS = ("time", "x", "y", "z", "r", "theta", "phi", "sigma_x", "sigma_y", "sigma_z")
"""Names of the columns with numbers, in their order; the last column is the status."""


def save_contacts(path: str | PathLike[str], contacts: xr.Dataset) -> None:
    """Write contact points, every number in full.

    Parameters
    ----------
    path : str or path
        Where to write; an existing file is replaced.
    contacts : xarray.Dataset
        Dim time; a variable for each column. Columns that it lacks are written as missing, but
        ``time``, ``x``, ``y``, ``z`` and ``status`` must be there.

    Raises
    ------
    ValueError
        If a needed variable is not there, or one has another dim.
    """
    missing = [n for n in ("time", "x", "y", "z", "status") if n not in contacts.variables]
    if missing:
        raise ValueError(f"contacts lack {', '.join(missing)}")
    n = contacts.sizes["time"]
    faults = [n for n in (*NUMBERS, "status") if n in contacts and contacts[n].dims != ("time",)]
    if faults:
        raise ValueError(f"{', '.join(faults)} must have the one dim time")
    table = np.column_stack(
        [contacts[name].values if name in contacts else np.full(n, np.nan) for name in NUMBERS]
    )
    names = [Status(int(code)).name.lower() for code in contacts["status"].values]
    lines = [",".join((*NUMBERS, "status"))]
    lines += [
        ",".join((*(repr(float(x)) for x in row), name))
        for row, name in zip(table, names, strict=True)
    ]
    with replacing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


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

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it has another header, a row that cannot be read or a status that does not exist.
    """
    path = Path(path)
    rows = table_rows(read_text(path))
    header = next(rows, None)
    expected = [*NUMBERS, "status"]
    if header is None or header[1] != expected:
        got = "is empty" if header is None else f"has the columns {', '.join(header[1])}"
        raise ValueError(f"{path} {got}; {', '.join(expected)} are needed")
    values, codes = [], []
    for line, cells in rows:
        try:
            *numbers, name = cells
            values.append([float(cell) for cell in numbers])
            codes.append(int(Status[name.upper()]))
            if len(numbers) != len(NUMBERS):
                raise ValueError
        except (ValueError, KeyError):
            raise ValueError(
                f"{path}: line {line} reads {','.join(cells)!r}, which is no contact"
            ) from None
    table = np.array(values, dtype=np.float64).reshape(-1, len(NUMBERS))
    columns = {
        name: xr.Variable("time", table[:, i], attributes(name)) for i, name in enumerate(NUMBERS)
    }
    about = {**attributes("status"), **flag_attributes()}
    columns["status"] = xr.Variable("time", np.array(codes, dtype=np.int8), about)
    return xr.Dataset({k: v for k, v in columns.items() if k != "time"}, {"time": columns["time"]})
