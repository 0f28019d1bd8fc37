"""Contact points over time as CSV: ``time, x, y, z, r, theta, phi, sigma_x, …, status``.

In SI units and the whisker's frame; the status is written by its name, and missing is ``nan``.

Contour points as CSV: ``time, whisker, x, y, z, sigma_x, …``, a line for each contact.

In SI units and the laboratory frame: the contact point on the whisker's centreline with its
standard deviations, the surface's outward normal there, the point of the surface, one whisker
radius away, and, where an object was fitted, how far the surface of the whisker is from it and
whether the contact is not an outlier.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa.io.paths import replacing
from vibrissa.io.table import Table, table_text, write_table
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
    rows = ([*row, name] for row, name in zip(table.tolist(), names, strict=True))
    write_table(path, (*NUMBERS, "status"), rows)


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
    table = Table(path, (*NUMBERS, "status"))
    codes = [Status.__members__.get(name.upper()) for name in table.text("status")]
    table.refuse(np.array([code is None for code in codes], dtype=bool), "no contact")
    columns = {name: xr.Variable("time", table.numbers(name), attributes(name)) for name in NUMBERS}
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
        Where to write; an existing file is replaced.
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
    missing = [name for name in ("time", "x", "y", "z") if name not in contour.variables]
    if missing:
        raise ValueError(f"contour points lack {', '.join(missing)}")
    faults = [n for n in CONTOUR if n in contour.variables and contour[n].dims != ("contact",)]
    if faults:
        raise ValueError(f"{', '.join(faults)} must have the one dim contact")
    n = contour.sizes["contact"]
    columns = [
        contour[name].values if name in contour.variables else np.full(n, np.nan)
        for name in CONTOUR
    ]
    plain = [(one.astype(int) if one.dtype == bool else one).tolist() for one in columns]
    return table_text(CONTOUR, zip(*plain, strict=True))
