"""Where a study's results are kept: Zarr, a chunk for each cell, so that any can be written alone.

    /whiskers   what each whisker is
    /cells      per whisker and task: status, seconds of CPU, and the hash of what was asked
    /TASK       the task's result for every whisker

A chunk is written to a file of its own and put in place by renaming it. The hash of a cell is
written after everything else of it, so that a cell whose hash is there is whole, whenever the run
was killed. Groups are made aside and renamed as well.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import shutil
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from vibrissa.sweeps.study import Cell, Study

Array = NDArray[np.float64]

DONE, FAILED = 1, 2
DESCRIBED = {
    "length": "m",
    "base_radius": "m",
    "tip_radius": "m",
    "taper_ratio": "1",
    "youngs_modulus": "Pa",
    "tip_turn": "rad",
}
"""What is told of every whisker, and its unit."""

_LOCK, _STUDY, _FAILURES = ".lock", ".study.json", ".failures"
_HASH = 16


class Busy(ValueError):
    """Another run writes to the store."""


class Store:
    """The results of one study, open for writing; to be used as a context manager.

    Parameters
    ----------
    path : str or path
        A folder, made if need be.
    study : Study
        Whose results.

    Raises
    ------
    Busy
        If another run has it open.
    ValueError
        If it holds the results of another study, or is no store.
    """

    def __init__(self, path: str | PathLike[str], study: Study) -> None:
        self.path = Path(path)
        self.study = study
        self._lock: IO[str] | None = None
        self._results: dict[str, zarr.Group] = {}
        self._columns = {name: k for k, name in enumerate(study.tasks)}

    def __enter__(self) -> Store:
        """Take the store, and make it if it is not there."""
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path} is a file; the folder of a store is needed")
        if self.path.exists() and any(self.path.iterdir()) and not self._known(_LOCK):
            raise ValueError(f"{self.path} is a folder with other things in it, and no store")
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock = (self.path / _LOCK).open("a")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._lock.close()
            raise Busy(f"another run is writing to {self.path}; wait until it has ended") from None
        try:
            self._begin()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *fault: object) -> None:
        """Let go of the store."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _known(self, name: str) -> bool:
        return (self.path / name).exists()

    def _begin(self) -> None:
        for left in self.path.glob(".new-*"):
            shutil.rmtree(left)
        said = _described(self.study)
        if not self._known(_STUDY):
            self._make("whiskers", self._make_whiskers)
            self._make("cells", self._make_cells)
            root = zarr.open_group(self.path, mode="a", zarr_format=2)
            root.attrs.update({"kind": "vibrissa sweep", "study": self.study.name})
            part = self.path / f"{_STUDY}.part"
            part.write_text(json.dumps(said), encoding="utf-8")
            part.replace(self.path / _STUDY)
        kept = json.loads((self.path / _STUDY).read_text(encoding="utf-8"))
        differing = [name for name in said if kept.get(name) != said[name]]
        if differing:
            raise ValueError(
                f"{self.path} holds the results of a study with other {' and '.join(differing)}: "
                "give another store, or remove this one"
            )
        self._cells = zarr.open_group(self.path / "cells", mode="r+", zarr_format=2)
        self._whiskers = zarr.open_group(self.path / "whiskers", mode="r+", zarr_format=2)
        for task in self.study.tasks:
            if self._known(task):
                self._results[task] = zarr.open_group(self.path / task, mode="r+", zarr_format=2)

    def _make(self, name: str, fill: Any) -> None:
        """Make a group aside, and put it in place whole."""
        if self._known(name):
            return
        aside = self.path / f".new-{name}"
        fill(zarr.open_group(aside, mode="w", zarr_format=2))
        aside.rename(self.path / name)

    def _make_whiskers(self, group: zarr.Group) -> None:
        names = np.array([specimen.name for specimen in self.study.specimens])
        dims = {"_ARRAY_DIMENSIONS": ["whisker"]}
        group.create_array("whisker", data=names, chunks=names.shape, attributes=dims)
        for name, unit in DESCRIBED.items():
            about = {"units": unit, "long_name": name.replace("_", " "), **dims}
            group.create_array(
                name,
                shape=names.shape,
                chunks=(1,),
                dtype="float64",
                fill_value=np.nan,
                attributes=about,
            )

    def _make_cells(self, group: zarr.Group) -> None:
        shape = (len(self.study.specimens), len(self.study.tasks))
        dims = {"_ARRAY_DIMENSIONS": ["whisker", "task"]}
        tasks = np.array(list(self.study.tasks))
        about = {"_ARRAY_DIMENSIONS": ["task"]}
        group.create_array("task", data=tasks, chunks=tasks.shape, attributes=about)
        for name, kind, fill in (
            ("status", "int8", 0),
            ("seconds", "float64", np.nan),
            ("identity", f"S{_HASH}", b""),
        ):
            group.create_array(
                name, shape=shape, chunks=(1, 1), dtype=kind, fill_value=fill, attributes=dims
            )

    def statuses(self) -> NDArray[np.int8]:
        """Say what is there.

        Returns
        -------
        array (whisker, task) of int8
            0 where nothing is, 1 where a cell is done, 2 where it failed.
        """
        status = np.zeros((len(self.study.specimens), len(self.study.tasks)), dtype=np.int8)
        identity, said = self._cells["identity"][:], self._cells["status"][:]
        for cell in self.study.cells():
            at = cell.index, self._columns[cell.task]
            if identity[at] == cell.identity.encode():
                status[at] = said[at]
        return status

    def write(self, cell: Cell, answer: dict[str, Any]) -> None:
        """Keep what became of a cell.

        Parameters
        ----------
        cell : Cell
            What was asked.
        answer : dict
            Of `vibrissa.sweeps.study.answer`.
        """
        at = cell.index, self._columns[cell.task]
        failure = self.path / _FAILURES / f"{cell.task}-{cell.index}.txt"
        if "failure" in answer:
            failure.parent.mkdir(exist_ok=True)
            part = failure.with_suffix(".part")
            part.write_text(f"{cell.specimen.name}\n{answer['failure']}", encoding="utf-8")
            part.replace(failure)
        else:
            self._write_result(cell, answer["result"])
            for name, value in answer["whisker"].items():
                self._whiskers[name][cell.index] = value
            failure.unlink(missing_ok=True)
        self._cells["seconds"][at] = answer["seconds"]
        self._cells["status"][at] = FAILED if "failure" in answer else DONE
        self._cells["identity"][at] = cell.identity.encode()

    def _write_result(self, cell: Cell, result: xr.Dataset) -> None:
        if cell.task not in self._results:
            self._make(cell.task, lambda group: self._fill_task(group, result))
            group = zarr.open_group(self.path / cell.task, mode="r+", zarr_format=2)
            self._results[cell.task] = group
        group = self._results[cell.task]
        for name, variable in result.data_vars.items():
            array = group[str(name)]
            if array.shape[1:] != variable.shape:
                raise ValueError(
                    f"{name} of {cell.specimen.name} has shape {variable.shape}, that of other "
                    f"whiskers {array.shape[1:]}"
                )
            array[cell.index] = variable.values

    def _fill_task(self, group: zarr.Group, result: xr.Dataset) -> None:
        """Make the arrays of a task like those of a first result."""
        count = len(self.study.specimens)
        for name, variable in result.data_vars.items():
            words = variable.dtype.kind in "ib"
            group.create_array(
                str(name),
                shape=(count, *variable.shape),
                chunks=(1, *variable.shape),
                dtype=np.int8 if words else np.float64,
                fill_value=-1 if words else np.nan,
                attributes={
                    **{key: _plain(value) for key, value in variable.attrs.items()},
                    "_ARRAY_DIMENSIONS": ["whisker", *map(str, variable.dims)],
                },
            )
        for name, coordinate in result.coords.items():
            values = coordinate.values
            values = values.astype(str) if values.dtype.kind in "OU" else values
            group.create_array(
                str(name),
                data=values,
                chunks=values.shape or (),
                attributes={
                    **{key: _plain(value) for key, value in coordinate.attrs.items()},
                    "_ARRAY_DIMENSIONS": [str(name)] if values.ndim else [],
                },
            )


def _described(study: Study) -> dict[str, Any]:
    """What two studies must have in common to share a store."""
    return {
        "name": study.name,
        "seed": study.seed,
        "whiskers": [[one.name, one.identity] for one in study.specimens],
        "tasks": json.loads(
            json.dumps({name: [kind, dict(how)] for name, (kind, how) in study.tasks.items()})
        ),
    }


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


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
        their name, ``uniqueness_verdict``; verdicts are words. With them what is told of every
        whisker, and ``status`` and ``seconds`` over ``task``. NaN, or no word, where nothing is
        known yet.

    Raises
    ------
    ValueError
        If it is no store.
    """
    path = Path(path)
    if not (path / _STUDY).exists():
        raise ValueError(f"{path} is no store of a sweep")
    parts = [_group(path / "whiskers").set_coords(list(DESCRIBED))]
    cells = _group(path / "cells")
    parts.append(cells[["status", "seconds"]])
    for task in cells["task"].values:
        if (path / str(task)).exists():
            found = _group(path / str(task))
            parts.append(found.rename({name: f"{task}_{name}" for name in found.data_vars}))
    out = xr.merge(parts, join="outer", combine_attrs="drop")
    out.attrs = {"study": json.loads((path / _STUDY).read_text(encoding="utf-8"))["name"]}
    return out


def _group(path: Path) -> xr.Dataset:
    data = xr.open_zarr(path, consolidated=False, zarr_format=2, chunks=None, decode_cf=False)
    data = data.drop_attrs(deep=False)
    for name, variable in data.data_vars.items():
        meanings = variable.attrs.get("flag_meanings")
        if meanings:
            words = np.array([*(word.replace("_", " ") for word in meanings.split()), ""])
            data[name] = variable.copy(data=words[variable.values])
            data[name].attrs = {
                key: value for key, value in variable.attrs.items() if not key.startswith("flag_")
            }
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
    for file in sorted((Path(path) / _FAILURES).glob("*.txt")):
        with contextlib.suppress(FileNotFoundError):
            found[file.stem] = file.read_text(encoding="utf-8")
    return found
