"""Opening what a study has found so far."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.sweeps.checksums import DONE, damaged
from vibrissa.sweeps.found import Found
from vibrissa.sweeps.rows import Rows
from vibrissa.sweeps.store import DAMAGED, DESCRIBED, FAILURES, noted


def open_sweep(path: str | PathLike[str]) -> xr.Dataset:
    """Open the results of a study as one dataset.

    Parameters
    ----------
    path : str or path
        Of the store; it may be written to meanwhile.

    Returns
    -------
    Dataset
        Over ``whisker`` and the dimensions of the tasks. Variables are called after their task and
        their name, ``uniqueness_verdict``; verdicts are words. A dimension along which a task has
        other values than one before it has the task's name before its own. With them what is told
        of every whisker, and over ``task`` ``seconds``, ``status``: 0 not done, 1 done, 2 failed,
        3 damaged, −1 not asked, and ``origin``, which of the codes in the attribute ``origins``
        found it. NaN, or an empty word, where nothing is known.

    Raises
    ------
    ValueError
        If it is no store, or so damaged that it cannot be read.
    """
    path = Path(path)
    kept = noted(path)
    tasks = list(kept["tasks"])
    told = Found(path / "cells")
    # First, for what is done then is whole.
    cells = {name: rows.read() for name, rows in told.rows.items()}
    whiskers = Found(path / "whiskers")
    results = {task: Found(path / task) for task in tasks if (path / task).exists()}
    status = cells["status"]
    if "checksum" in cells:
        each = [results[task].ordered if task in results else [] for task in tasks]
        status = np.where(damaged(cells, whiskers.ordered, each), np.int8(DAMAGED), status)
    out = _specimens(kept, whiskers, (status == DONE).any(axis=1))
    over = ("whisker", "task")
    out = out.assign_coords(task=tasks).assign(
        status=(over, status), seconds=(over, cells["seconds"]), origin=(over, cells["origin"])
    )
    for task, numbers in results.items():
        found = _group(path / task)
        known = xr.DataArray(status[:, tasks.index(task)] == DONE, dims="whisker")
        if not known.all() or not all(rows.whole() for rows in numbers.ordered):
            found = found.map(_known, rows=numbers.rows, done=known)
        found = _worded(found)
        found = found.rename({name: f"{task}_{name}" for name in found.data_vars})
        out = out.merge(found.rename(_differing(out, found, task)))
    return out.assign_attrs(study=kept["name"], origins=kept["origins"])


def _specimens(kept: dict[str, Any], whiskers: Found, known: NDArray[np.bool_]) -> xr.Dataset:
    """What each whisker is: its name and group as the study has them, and what describes it."""
    names, groups, _ = (list(words) for words in zip(*kept["whiskers"], strict=True))
    about = {
        name: (
            "whisker",
            np.where(known, whiskers.rows[name].read(), np.nan),
            {"units": unit, "long_name": name.replace("_", " ")},
        )
        for name, unit in DESCRIBED.items()
    }
    return xr.Dataset(coords={"whisker": names, "group": ("whisker", groups), **about})


def _known(data: xr.DataArray, rows: Mapping[str, Rows], done: xr.DataArray) -> xr.DataArray:
    """Read an array without what was damaged, or begun by a run that was killed."""
    read = data.copy(data=rows[str(data.name)].read())
    nothing = np.array(-1 if data.dtype.kind == "i" else np.nan, dtype=data.dtype)
    return read.where(done, nothing)


def _differing(out: xr.Dataset, found: xr.Dataset, task: str) -> dict[str, str]:
    """New names for dimensions along which a task has other values than those before it."""
    return {
        str(dim): f"{task}_{dim}"
        for dim in found.dims
        if dim in out.dims and dim != "whisker" and not out[dim].equals(found[dim])
    }


def _group(path: Path) -> xr.Dataset:
    data: xr.Dataset = xr.open_zarr(path, chunks=None, decode_cf=False)
    data = data.drop_attrs(deep=False)
    for each in data.variables.values():
        each.attrs.pop("_FillValue", None)
    return data


def _worded(data: xr.Dataset) -> xr.Dataset:
    """Put words in place of flags."""
    for name, variable in data.data_vars.items():
        meanings = variable.attrs.get("flag_meanings")
        if meanings:
            words = np.array([*(word.replace("_", " ") for word in meanings.split()), ""])
            about = {k: v for k, v in variable.attrs.items() if not k.startswith("flag_")}
            data[name] = (variable.dims, words[variable.values], about)
    return data


def failures(path: str | PathLike[str]) -> dict[str, str]:
    """Read what went wrong.

    Parameters
    ----------
    path : str or path
        Of the store.

    Returns
    -------
    dict
        By task and number of the whisker, such as ``uniqueness-12``: the whisker's name and the
        traceback.
    """
    found = {}
    for file in sorted((Path(path) / FAILURES).glob("*.txt")):
        with contextlib.suppress(FileNotFoundError):
            found[file.stem] = file.read_text(encoding="utf-8")
    return found
