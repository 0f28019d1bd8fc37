"""The table of predictors of a trial as CSV and for MATLAB.

CSV: first a line ``# name [unit]: meaning`` for each column, then the header and a line for each
frame and whisker. MATLAB: a matrix (frames, whiskers) for each column, ``time``, ``whisker``, the
names of the ``predictors`` of models of spikes, and ``units`` and ``descriptions`` by column.
"""

from __future__ import annotations

from os import PathLike

import numpy as np
import xarray as xr

from vibrissa.io.paths import CSV, check_writable, replacing
from vibrissa.io.table import table_text
from vibrissa.status import Status


def save_predictors(path: str | PathLike[str], table: xr.Dataset) -> None:
    """Write a table of predictors.

    Parameters
    ----------
    path : str or path
        File to write, ``.csv`` or ``.mat``; an existing file is replaced.
    table : xarray.Dataset
        Variables over (time, whisker), as `vibrissa.pipeline.predictors` returns them.

    Raises
    ------
    ValueError
        If the path has another ending.
    """
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
