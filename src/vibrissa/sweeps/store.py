"""Where a study's results are kept: Zarr, a chunk for each cell, so that any can be written alone.

    /whiskers   what each whisker is
    /cells      per whisker and task: status, seconds of CPU, and the hash of what was asked
    /TASK       the task's result for every whisker

A chunk is written to a file of its own and put in place by renaming it. The hash of a cell is
written after everything else of it, so that a cell whose hash is there is whole, whenever the run
was killed. Groups are made aside and renamed as well.
"""

from __future__ import annotations

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

from vibrissa.sweeps.study import TAKEN, Cell, Study

Array = NDArray[np.float64]

NOT_ASKED, DONE, FAILED = -1, 1, 2
DESCRIBED = {
    "length": "m",
    "base_radius": "m",
    "tip_radius": "m",
    "taper_ratio": "1",
    "youngs_modulus": "Pa",
    "turn": "rad",
}
"""What is told of every whisker, and its unit."""

STUDY, FAILURES = ".study.json", ".failures"
_LOCK = ".sweep.lock"
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
        if not self._known(STUDY):
            for begun in TAKEN:  # perhaps for another study
                shutil.rmtree(self.path / begun, ignore_errors=True)
            self._make("whiskers", self._make_whiskers)
            self._make("cells", self._make_cells)
            root = zarr.open_group(self.path, mode="a", zarr_format=2)
            root.attrs.update({"kind": "vibrissa sweep", "study": self.study.name})
            part = self.path / f"{STUDY}.part"
            part.write_text(json.dumps(said), encoding="utf-8")
            part.replace(self.path / STUDY)
        kept = json.loads((self.path / STUDY).read_text(encoding="utf-8"))
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
        groups = np.array([specimen.group for specimen in self.study.specimens])
        group.create_array("group", data=groups, chunks=groups.shape, attributes=dims)
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
        study = self.study
        asked = [[study.asks(task, one) for task in study.tasks] for one in study.specimens]
        for name, kind, fill in (
            ("status", "int8", 0),
            ("seconds", "float64", np.nan),
            ("identity", f"S{_HASH}", b""),
        ):
            group.create_array(
                name, shape=shape, chunks=(1, 1), dtype=kind, fill_value=fill, attributes=dims
            )
        group["status"][...] = np.where(asked, 0, NOT_ASKED)

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

    def write(self, cell: Cell, answer: dict[str, Any]) -> bool:
        """Keep what became of a cell.

        Parameters
        ----------
        cell : Cell
            What was asked.
        answer : dict
            Of `vibrissa.sweeps.study.answer`.

        Returns
        -------
        bool
            Whether it is done; false if it failed, also where its result does not go with those
            of other whiskers.

        Raises
        ------
        OSError
            If it cannot be written; it is then as if it had not been done, and what was written
            before is whole.
        """
        try:
            failure = answer.get("failure") or self._write_result(cell, answer["result"])
            self._write_failure(cell, failure)
            if not failure:
                for name, value in answer["whisker"].items():
                    self._whiskers[name][cell.index] = value
            at = cell.index, self._columns[cell.task]
            self._cells["seconds"][at] = answer["seconds"]
            self._cells["status"][at] = FAILED if failure else DONE
            self._cells["identity"][at] = cell.identity.encode()
        except OSError as fault:
            raise OSError(
                fault.errno,
                f"{fault.strerror or fault}: nothing more can be written to {self.path}. What is "
                "there is whole; the same call goes on from it",
            ) from fault
        return not failure

    def _write_failure(self, cell: Cell, failure: str) -> None:
        path = self.path / FAILURES / f"{cell.task}-{cell.index}.txt"
        if not failure:
            path.unlink(missing_ok=True)
            return
        path.parent.mkdir(exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(f"{cell.specimen.name}\n{failure}", encoding="utf-8")
        part.replace(path)

    def _write_result(self, cell: Cell, result: xr.Dataset) -> str:
        """Write a result, or say why it cannot be kept beside those of other whiskers."""
        if cell.task not in self._results:
            self._make(cell.task, lambda group: self._fill_task(group, result))
            group = zarr.open_group(self.path / cell.task, mode="r+", zarr_format=2)
            self._results[cell.task] = group
        group = self._results[cell.task]
        if misfit := _misfit(group, result):
            return misfit
        for name, variable in result.data_vars.items():
            group[str(name)][cell.index] = variable.values
        return ""

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


def _misfit(group: zarr.Group, result: xr.Dataset) -> str:
    """What keeps a result from being one of a group's."""
    for name, variable in result.variables.items():
        if name not in group:
            return f"{name} is no result of other whiskers\n"
        array = group[str(name)]
        others = array.shape if name in result.coords else array.shape[1:]
        if others != variable.shape:
            return f"{name} has shape {variable.shape}, that of other whiskers has {others}\n"
        if name in result.coords and not _same(array[...], variable.values):
            return f"{name} is {variable.values}, that of other whiskers {array[...]}\n"
    return ""


def _same(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Whether coordinates agree, to what another machine's rounding may change."""
    if first.dtype.kind == "f":
        return bool(np.allclose(first, second, rtol=1e-12, atol=0.0))
    return bool(np.array_equal(first, second))


def _described(study: Study) -> dict[str, Any]:
    """What two studies must have in common to share a store."""
    return {
        "name": study.name,
        "seed": study.seed,
        "whiskers": [[one.name, one.group, one.identity] for one in study.specimens],
        "tasks": json.loads(
            json.dumps({name: [kind, dict(how)] for name, (kind, how) in study.tasks.items()})
        ),
        "groups": {name: list(some) for name, some in study.groups.items()},
    }


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
