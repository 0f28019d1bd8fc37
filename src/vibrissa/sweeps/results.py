"""Opening what a study has found so far."""

from __future__ import annotations

import contextlib
from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa.sweeps.store import DESCRIBED, DONE, FAILURES, noted


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
        −1 not asked, and ``origin``, which of the codes in the attribute ``origins`` found it. NaN,
        or an empty word, where nothing is known yet.

    Raises
    ------
    ValueError
        If it is no store.
    """
    path = Path(path)
    kept = noted(path)
    # First, for what is done then is whole.
    cells = _group(path / "cells")[["status", "seconds", "origin"]].load()
    out = _group(path / "whiskers").set_coords(["group", *DESCRIBED]).merge(cells)
    for task in map(str, cells["task"].values):
        if (path / task).exists():
            found = _group(path / task)
            status = cells["status"].sel(task=task, drop=True)
            if (status == 0).any():
                found = found.map(_known, done=status == DONE, keep_attrs=True)
            found = _worded(found)
            found = found.rename({name: f"{task}_{name}" for name in found.data_vars})
            out = out.merge(found.rename(_differing(out, found, task)))
    return out.assign_attrs(study=kept["name"], origins=kept["origins"])


def _known(data: xr.DataArray, done: xr.DataArray) -> xr.DataArray:
    """Leave out what a run that was killed had begun to write."""
    nothing = np.array(-1 if data.dtype.kind == "i" else np.nan, dtype=data.dtype)
    return data.where(done, nothing)


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
