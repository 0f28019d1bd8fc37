"""Where a study's results are kept: Zarr, in which each cell's numbers have their place.

    /whiskers   what each whisker is
    /cells      per whisker and task: status, seconds of CPU, which code found it, the hash of what
                was asked, and a checksum of all that is kept of it
    /TASK       the task's result for every whisker

A cell's numbers are written once, in place (`vibrissa.sweeps.rows`), and its status, one byte,
after everything else: a cell that is done is whole, whenever the run was killed, and of others
nothing counts. Groups and files are made aside and renamed. What was damaged since is found by
checksums (`vibrissa.sweeps.checksums`) when the store is opened, and done again.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import IO, Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from vibrissa.sweeps.checksums import DONE, FAILED, TOLD, checksum, damaged
from vibrissa.sweeps.found import Found, lay_out, seal
from vibrissa.sweeps.lock import hold
from vibrissa.sweeps.origin import origin, own
from vibrissa.sweeps.rows import make_rows
from vibrissa.sweeps.study import TAKEN, Cell, Study

NOT_ASKED, DAMAGED = -1, 3
DESCRIBED = {
    "length": "m",
    "base_radius": "m",
    "tip_radius": "m",
    "taper_ratio": "1",
    "youngs_modulus": "Pa",
    "turn": "rad",
}
"""What is told of every whisker, and its unit."""

FAILURES = ".failures"
_STUDY, _LOCK, _ALL = ".study.json", ".sweep.lock", ".zmetadata"
_LAYOUT, _UNCHECKED = 3, 2
_HASH, _SUM = 16, "checksum"
_CELLS: dict[str, tuple[str, Any]] = {
    "status": ("int8", 0),
    "seconds": ("float64", np.nan),
    "origin": ("int16", -1),
    "identity": (f"S{_HASH}", b""),
    "checksum": ("uint32", 0),
}
"""What is told of every cell: type, and what means that nothing is known."""


class Busy(ValueError):
    """Another run writes to the store."""


class _Damaged(Exception):
    """A group of the store cannot be read."""


class Store:
    """The results of one study, open for writing; to be used as a context manager.

    Parameters
    ----------
    path : str or path
        A folder, made if need be.
    study : Study
        Whose results.
    any_version : bool
        Whether it is gone on with though another version of vibrissa began it.

    Attributes
    ----------
    faults : list of str
        What of the store was so damaged that it was made anew.

    Raises
    ------
    Busy
        If another run has it open.
    ValueError
        If it holds the results of another study or of another version, or is no store.
    """

    def __init__(
        self, path: str | PathLike[str], study: Study, *, any_version: bool = False
    ) -> None:
        self.path = Path(path)
        self.study = study
        self._any_version = any_version
        self._lock: IO[str] | None = None
        self._found: dict[str, Found] = {}
        self.faults: list[str] = []
        self._columns = {name: k for k, name in enumerate(study.tasks)}

    def __enter__(self) -> Store:
        """Take the store, and make it if it is not there."""
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path} is a file; the folder of a store is needed")
        if self.path.exists() and any(self.path.iterdir()) and not self._known(_LOCK):
            raise ValueError(f"{self.path} is a folder with other things in it, and no store")
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            self._lock = hold(self.path / _LOCK)
        except BlockingIOError:
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
        if not self._known(_STUDY):
            for begun in TAKEN:  # perhaps for another study
                shutil.rmtree(self.path / begun, ignore_errors=True)
            self._make("whiskers", self._lay_out_whiskers)
            self._make("cells", self._lay_out_cells)
            self._note(_STUDY, {**_described(self.study), "origins": []})
        self._origin = self._admitted(noted(self.path))
        self._note(".zgroup", {"zarr_format": 2})
        self._note(".zattrs", {"kind": "vibrissa sweep", "study": self.study.name})
        self._whiskers = self._opened("whiskers", self._lay_out_whiskers)
        self._cells = self._opened("cells", self._lay_out_cells).rows
        for task in self.study.tasks:
            if self._known(task):
                with contextlib.suppress(_Damaged):
                    self._found[task] = self._checked(task)
        self._consolidate()

    def _opened(self, name: str, fill: Callable[[zarr.Group], None]) -> Found:
        """Open a group, or make it anew."""
        with contextlib.suppress(_Damaged):
            return self._checked(name)
        self._make(name, fill)
        return Found(self.path / name)

    def _checked(self, name: str) -> Found:
        """Open a group; one that cannot be read is removed, and what was in it is done again."""
        try:
            return Found(self.path / name)
        except ValueError as fault:
            self.faults.append(str(fault))
            shutil.rmtree(self.path / name, ignore_errors=True)
            raise _Damaged from fault

    def _note(self, name: str, content: dict[str, Any]) -> None:
        if name == _STUDY:
            content = {**content, _SUM: _sum(content)}
        part = self.path / f"{name}.part"
        part.write_text(json.dumps(content), encoding="utf-8")
        part.replace(self.path / name)

    def _consolidate(self) -> None:
        """Tell Zarr of all groups in one file, so that it looks at nothing else that is here."""
        metadata = {}
        for path in sorted(self.path.glob(f"*/{_ALL}")):
            known = json.loads(path.read_text(encoding="utf-8"))["metadata"]
            metadata.update({f"{path.parent.name}/{key}": known[key] for key in known})
        for name in (".zgroup", ".zattrs"):
            metadata[name] = json.loads((self.path / name).read_text(encoding="utf-8"))
        self._note(_ALL, {"zarr_consolidated_format": 1, "metadata": metadata})

    def _admitted(self, kept: dict[str, Any]) -> int:
        """Check that this study, done by this code, goes with what is there; number of the code."""
        said = _described(self.study)
        differing = [name for name in said if kept.get(name) != said[name]]
        if differing:
            raise ValueError(
                f"{self.path} holds the results of a study with other {' and '.join(differing)}: "
                "give another store, or remove this one"
            )
        origins: list[str] = kept["origins"]
        mine = origin()
        if mine not in origins:
            if origins and own(mine) not in map(own, origins) and not self._any_version:
                raise ValueError(
                    f"the results in {self.path} are of {own(origins[-1])}, this is {own(mine)}, "
                    "which may find others: give another store, or allow any version "
                    "(--any-version) and the store tells which cell is of which"
                )
            origins.append(mine)
            self._note(_STUDY, kept)
        return origins.index(mine)

    def _make(self, name: str, fill: Callable[[zarr.Group], None]) -> None:
        """Make a group aside, and put it in place whole."""
        if self._known(name):
            return
        aside = self.path / f".new-{name}"
        group = zarr.open_group(aside, mode="w", zarr_format=2)
        fill(group)
        seal(group)
        zarr.consolidate_metadata(aside, zarr_format=2)
        aside.rename(self.path / name)

    def _lay_out_whiskers(self, group: zarr.Group) -> None:
        specimens = self.study.specimens
        for name, words in (
            ("whisker", [one.name for one in specimens]),
            ("group", [one.group for one in specimens]),
        ):
            dims = {"_ARRAY_DIMENSIONS": ["whisker"]}
            group.create_array(name, data=np.array(words), chunks=(len(words),), attributes=dims)
        for name, unit in DESCRIBED.items():
            about = {"units": unit, "long_name": name.replace("_", " ")}
            make_rows(group, name, (len(specimens),), "float64", np.nan, ["whisker"], about)

    def _lay_out_cells(self, group: zarr.Group) -> None:
        study = self.study
        tasks = np.array(list(study.tasks))
        about = {"_ARRAY_DIMENSIONS": ["task"]}
        group.create_array("task", data=tasks, chunks=tasks.shape, attributes=about)
        asked = [[study.asks(task, one) for task in study.tasks] for one in study.specimens]
        for name, (kind, fill) in _CELLS.items():
            make_rows(group, name, np.shape(asked), kind, fill, ["whisker", "task"])
        group["status"][...] = np.where(asked, 0, NOT_ASKED)

    def statuses(self) -> NDArray[np.int8]:
        """Say what is there.

        Returns
        -------
        array (whisker, task) of int8
            0 where nothing is, 1 where a cell is done, 2 where it failed, 3 where what is there is
            not what was written.
        """
        told = {name: rows.read() for name, rows in self._cells.items()}
        identity = np.zeros((len(self.study.specimens), len(self._columns)), dtype=f"S{_HASH}")
        for cell in self.study.cells():
            identity[cell.index, self._columns[cell.task]] = cell.identity.encode()
        known = (told["identity"] == identity) & (identity != b"")
        found = [self._found.get(task) for task in self._columns]
        results = [[] if one is None else one.ordered for one in found]
        bad = damaged(told, self._whiskers.ordered, results)
        return np.where(bad, np.int8(DAMAGED), np.where(known, told["status"], np.int8(0)))

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
            failure, numbers = answer.get("failure") or "", b""
            if not failure:
                failure, numbers = self._write_result(cell, answer)
            said = self.path / FAILURES / f"{cell.task}-{cell.index}.txt"
            if failure:
                said.parent.mkdir(exist_ok=True)
                part = said.with_suffix(".part")
                part.write_text(f"{cell.specimen.name}\n{failure}", encoding="utf-8")
                part.replace(said)
            at = cell.index, self._columns[cell.task]
            told = {
                "seconds": answer["seconds"],
                "origin": self._origin,
                "identity": cell.identity.encode(),
                "status": FAILED if failure else DONE,
            }
            own = b"".join(self._cells[name].encoded(told[name]) for name in TOLD)
            told = {"checksum": checksum(own, numbers), **told}
            # The status last: one byte, of which no half can be written. With it all counts.
            for name, value in told.items():
                self._cells[name].write(value, *at)
            if not failure:
                said.unlink(missing_ok=True)
        except OSError as fault:
            raise OSError(
                fault.errno,
                f"{fault.strerror or fault}: nothing more can be written to {self.path}. What is "
                "there is whole; the same call goes on from it",
            ) from fault
        return not failure

    def _write_result(self, cell: Cell, answer: dict[str, Any]) -> tuple[str, bytes]:
        """Write a result: its numbers as bytes, or why it cannot be kept beside others."""
        result: xr.Dataset = answer["result"]
        if cell.task not in self._found:
            count = len(self.study.specimens)
            self._make(cell.task, lambda group: lay_out(group, result, count))
            self._consolidate()
            self._found[cell.task] = Found(self.path / cell.task)
        found = self._found[cell.task]
        if misfit := found.misfit(result):
            return misfit, b""
        numbers = found.write(result, cell.index)
        described = b""
        for name, rows in sorted(self._whiskers.rows.items()):
            described += rows.encoded(answer["whisker"][name])
            rows.write(answer["whisker"][name], cell.index)
        return "", described + numbers


def noted(path: Path) -> dict[str, Any]:
    """Read what a store says of itself."""
    if not (path / _STUDY).exists():
        raise ValueError(f"{path} is no store of a sweep")
    try:
        kept = json.loads((path / _STUDY).read_bytes())
    except ValueError:
        kept = None
    if isinstance(kept, dict) and kept.get("layout") not in (_LAYOUT, _UNCHECKED):
        raise ValueError(
            f"{path} is laid out as another version of vibrissa does: open it with that one, or "
            "give another store"
        )
    if not isinstance(kept, dict) or (kept["layout"] == _LAYOUT and kept.get(_SUM) != _sum(kept)):
        raise ValueError(
            f"{path / _STUDY} is damaged, which says what the store holds: put back a copy of it, "
            "or remove it, and the study is begun anew"
        )
    return kept


def _sum(kept: dict[str, Any]) -> int:
    """Checksum of what a store says of itself."""
    own = {name: value for name, value in kept.items() if name != _SUM}
    return checksum(json.dumps(own, sort_keys=True).encode())


def _described(study: Study) -> dict[str, Any]:
    """What two studies must have in common to share a store."""
    return {
        "layout": _LAYOUT,
        "name": study.name,
        "seed": study.seed,
        "whiskers": [[one.name, one.group, one.identity] for one in study.specimens],
        "tasks": json.loads(
            json.dumps({name: [kind, dict(how)] for name, (kind, how) in study.tasks.items()})
        ),
        "groups": {name: list(some) for name, some in study.groups.items()},
    }
