"""Opening what a study has found so far."""

from __future__ import annotations

import contextlib
import json
from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr

from vibrissa.sweeps.store import DESCRIBED, FAILURES, STUDY


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
        of every whisker, and over ``task`` ``seconds`` and ``status``: 0 not done, 1 done, 2
        failed, −1 not asked. NaN, or an empty word, where nothing is known yet.

    Raises
    ------
    ValueError
        If it is no store.
    """
    path = Path(path)
    if not (path / STUDY).exists():
        raise ValueError(f"{path} is no store of a sweep")
    cells = _group(path / "cells")
    out = _group(path / "whiskers").set_coords(["group", *DESCRIBED])
    out = out.merge(cells[["status", "seconds"]])
    for task in map(str, cells["task"].values):
        if (path / task).exists():
            found = _group(path / task)
            found = found.rename({name: f"{task}_{name}" for name in found.data_vars})
            out = out.merge(found.rename(_differing(out, found, task)))
    kept = json.loads((path / STUDY).read_text(encoding="utf-8"))
    return out.assign_attrs(study=kept["name"])


def _differing(out: xr.Dataset, found: xr.Dataset, task: str) -> dict[str, str]:
    """New names for dimensions along which a task has other values than those before it."""
    return {
        str(dim): f"{task}_{dim}"
        for dim in found.dims
        if dim in out.dims and dim != "whisker" and not out[dim].equals(found[dim])
    }


def _group(path: Path) -> xr.Dataset:
    data: xr.Dataset = xr.open_zarr(
        path, consolidated=False, zarr_format=2, chunks=None, decode_cf=False
    )
    data = data.drop_attrs(deep=False)
    for each in data.variables.values():
        each.attrs.pop("_FillValue", None)
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
