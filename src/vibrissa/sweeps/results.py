"""Results of a study so far: as one dataset, its failures, and a summary in a few lines."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.sweeps.store import (
    DAMAGED,
    DESCRIBED,
    DONE,
    FAILED,
    LAYOUT,
    NOT_ASKED,
    OLD_LAYOUTS,
    TO_DO,
    Cells,
    described,
    read_failures,
)

_MM = 1e3


def open_sweep(path: str | PathLike[str]) -> xr.Dataset:
    """Read the results of a study as one dataset.

    Parameters
    ----------
    path : str or path
        Store of the study; it may be written to meanwhile.

    Returns
    -------
    Dataset
        Over ``whisker`` and the dimensions of the tasks. Variables are named after their task and
        their name, ``uniqueness_verdict``; verdicts are words. A dimension along which a task has
        other values than one before it has the task's name before its own. With them the numbers
        that describe every whisker, and over ``task`` ``seconds``, ``status``: 0 not done, 1 done,
        2 failed, 3 damaged, −1 not asked, and ``origin``, the number of the code, in the attribute
        ``origins``, that found it. NaN, or an empty word, where nothing is known.

    Raises
    ------
    ValueError
        If it is not a store, or so damaged that it cannot be read.
    """
    path = Path(path)
    kept = described(path, (LAYOUT, *OLD_LAYOUTS))
    names, groups, _ = (list(words) for words in zip(*kept["whiskers"], strict=True))
    read = _records if kept["layout"] == LAYOUT else _arrays
    cells, numbers, found = read(path, kept, names, groups)
    about = {
        name: ("whisker", values, {"units": DESCRIBED[name], "long_name": name.replace("_", " ")})
        for name, values in numbers.items()
    }
    out = xr.Dataset(
        {name: (("whisker", "task"), values) for name, values in cells.items()},
        {"whisker": names, "group": ("whisker", groups), **about, "task": list(kept["tasks"])},
        {"study": kept["name"], "origins": kept["origins"]},
    )
    for task, data in found.items():
        data = data.rename({name: f"{task}_{name}" for name in data.data_vars})
        out = out.merge(data.rename(_differing(out, data, task)), combine_attrs="override")
    return out


_Read = tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]], dict[str, xr.Dataset]]
"""Arrays over cells, arrays over whiskers, and the results of each task."""


def _records(path: Path, kept: dict[str, Any], names: list[str], groups: list[str]) -> _Read:
    """Read the records of a store."""
    tasks = list(kept["tasks"])
    shape = len(names), len(tasks)
    asked = np.array(
        [[t not in kept["groups"] or g in kept["groups"][t] for t in tasks] for g in groups]
    )
    status = np.where(asked, TO_DO, NOT_ASKED).astype(np.int8)
    seconds, origin = np.full(shape, np.nan), np.full(shape, -1, dtype=np.int16)
    numbers = {name: np.full(len(names), np.nan) for name in DESCRIBED}
    found = {}
    # First, for a cell may be done while this is read.
    failed = list(read_failures(path))
    for k, task in enumerate(tasks):
        if (cells := Cells.read(path, task, len(names))) is None:
            continue
        found[task] = cells
        status[cells.done, k], status[cells.damaged, k] = DONE, DAMAGED
        seconds[:, k] = cells.column("seconds", fill=np.nan)
        origin[:, k] = cells.column("origin", fill=-1)
        for name, values in numbers.items():
            values[cells.done] = cells.column("whisker", name, fill=np.nan)[cells.done]
    for failure in failed:
        at = failure["index"], tasks.index(failure["task"])
        if status[at] != DONE:
            status[at], seconds[at], origin[at] = FAILED, failure["seconds"], failure["origin"]
    over_cells = {"status": status, "seconds": seconds, "origin": origin}
    return over_cells, numbers, {task: _results(cells) for task, cells in found.items()}


def _arrays(path: Path, kept: dict[str, Any], names: list[str], groups: list[str]) -> _Read:
    """Read a store of before, a Zarr group for each task, without looking for damage in it."""
    cells, whiskers = (_group(path / name) for name in ("cells", "whiskers"))
    status = cells["status"].values.astype(np.int8)
    some = (status == DONE).any(axis=1)
    numbers = {name: np.where(some, whiskers[name].values, np.nan) for name in DESCRIBED}
    found = {}
    for k, task in enumerate(kept["tasks"]):
        if not (path / task).exists():
            continue
        data = _group(path / task)
        done = status[:, k] == DONE
        for name, one in data.data_vars.items():
            nothing = -1 if one.dtype.kind == "i" else np.nan
            rows = done.reshape(-1, *[1] * (one.ndim - 1))
            data[name] = (one.dims, *_worded(np.where(rows, one.values, nothing), one.attrs))
        found[task] = data
    over_cells = {"status": status} | {name: cells[name].values for name in ("seconds", "origin")}
    return over_cells, numbers, found


def _group(path: Path) -> xr.Dataset:
    """A group of a store of before, as it is stored."""
    try:
        data: xr.Dataset = xr.open_zarr(path, chunks=None, decode_cf=False).load()
    except Exception as fault:  # of a damaged file, libraries raise whatever they meet
        raise ValueError(f"{path} is damaged: {' '.join(str(fault).split())[:200]}") from fault
    for each in data.variables.values():
        each.attrs.pop("_FillValue", None)
    return data.drop_attrs(deep=False)


def _worded(
    values: NDArray[Any], attributes: Mapping[Any, Any]
) -> tuple[NDArray[Any], dict[str, Any]]:
    """Words in place of flags, and the attributes that remain."""
    about = {str(key): one for key, one in attributes.items() if not str(key).startswith("flag_")}
    if meanings := attributes.get("flag_meanings"):
        words = [word.replace("_", " ") for word in meanings.split()]
        values = np.array([*words, ""])[values.astype(int)]
    return values, about


def _results(cells: Cells) -> xr.Dataset:
    """Results of one task, of all whiskers; words in place of flags."""
    data: dict[str, Any] = {}
    for name, (dims, _, kind, attributes) in cells.layout.variables.items():
        values = cells.column("result", name, fill=-1 if kind == "<i1" else np.nan)
        data[name] = (("whisker", *dims), *_worded(values, attributes))
    coords = {name: (name, *one) for name, one in cells.layout.coordinates.items()}
    return xr.Dataset(data, coords)


def _differing(out: xr.Dataset, found: xr.Dataset, task: str) -> dict[str, str]:
    """New names for dimensions along which a task has other values than those before it."""
    return {
        str(dim): f"{task}_{dim}"
        for dim in found.dims
        if dim in out.dims and dim != "whisker" and not out[dim].equals(found[dim])
    }


def failures(path: str | PathLike[str]) -> dict[str, str]:
    """Read which cells failed, and why.

    Parameters
    ----------
    path : str or path
        Store of the study.

    Returns
    -------
    dict
        Whisker's name and traceback by task and number of the whisker, such as ``uniqueness-12``;
        of cells that have not been done since.
    """
    path = Path(path)
    kept = described(path, (LAYOUT, *OLD_LAYOUTS))
    if kept["layout"] != LAYOUT:
        texts = sorted(path.glob(".failures/*.txt"))
        return {text.stem: text.read_text(encoding="utf-8") for text in texts}
    last = {(one["task"], one["index"]): one["failure"] for one in read_failures(path)}
    done = {task: Cells.read(path, task, len(kept["whiskers"])) for task in kept["tasks"]}
    return {
        f"{task}-{index}": text
        for (task, index), text in sorted(last.items())
        if (cells := done.get(task)) is None or not cells.done[index]
    }


def sweep_summary(found: xr.Dataset) -> str:
    """Summarise how far a study is, and what it found."""
    return "\n".join(_lines(found))


def _lines(found: xr.Dataset) -> Iterator[str]:
    yield f"study {found.attrs.get('study', '')!r}: {found.sizes['whisker']} whiskers"
    for number, origin in enumerate(np.atleast_1d(found.attrs["origins"])):
        yield f"  {int((found['origin'] == number).sum())} cells by {origin}"
    for task in found["task"].values:
        status = found["status"].sel(task=task).values
        counts = [int((status == code).sum()) for code in (1, 2, 0)]
        seconds = float(np.nansum(found["seconds"].sel(task=task).values))
        spoilt = int((status == 3).sum())
        again = f", {spoilt} damaged (`vibrissa sweep` does them again)" if spoilt else ""
        yield "  {}: {} done, {} failed, {} to do{}; {:.0f} s of CPU".format(
            task, *counts, again, seconds
        )
    groups = list(dict.fromkeys(map(str, found["group"].values)))
    for task in map(str, found["task"].values):
        for group in groups:
            rows = found.isel(whisker=found["group"].values == group)
            yield from _verdicts(rows, task, group)
            yield from _errors(rows, task, group)


def _verdicts(rows: xr.Dataset, task: str, group: str) -> Iterator[str]:
    name = f"{task}_verdict"
    if name not in rows or not (rows[name] != "").any():
        return
    yield (
        f"{task}, {group}: unique (no counterexample found) | the same off a surface | "
        "not unique (witness); critical cone: median, largest; contacts with a twin: the same"
    )
    verdict, cone, twins = (rows[f"{task}_{n}"] for n in ("verdict", "critical_cone", "twin_share"))
    _, first, second = verdict.dims
    for a in rows[first].values:
        for b in rows[second].values:
            at = {first: a, second: b}
            words = verdict.sel(at).values
            counts = [
                int((words == one).sum())
                for one in ("unique", "unique off a surface", "not unique")
            ]
            degrees = np.degrees(cone.sel(at).values[words != ""])
            if degrees.size:
                label = str(a) if rows.sizes[second] == 1 else f"{a}, {b}"
                middle, high = np.nanmedian(degrees), np.nanmax(degrees)
                tally = "{:4d} | {:4d} | {:4d}".format(*counts)
                share = 100.0 * twins.sel(at).values[words != ""]
                twin = f"{np.nanmedian(share):.3g} %, {np.nanmax(share):.3g} %"
                yield f"  {label:10s} {tally};  {middle:5.2f}°, {high:5.2f}°;  {twin}"


def _errors(rows: xr.Dataset, task: str, group: str) -> Iterator[str]:
    name = f"{task}_median_error"
    if name not in rows or not np.isfinite(rows[name].values).any():
        return
    yield f"{task}, {group}: error of the contact point, mm: median of whiskers, largest"
    error = rows[name]
    dim = error.dims[1]
    for label in rows[dim].values:
        values = error.sel({dim: label}).values * _MM
        if np.isfinite(values).any():
            yield f"  {label!s:10s} {np.nanmedian(values):.3g}, {np.nanmax(values):.3g}"
