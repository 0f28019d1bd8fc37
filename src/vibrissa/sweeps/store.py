"""Store of a study's results: one record per cell, appended to the file of its task.

    .study.json      description of the study, and of the codes that computed results
    TASK.json        layout of a result of the task: variables, dimensions, coordinates
    TASK.cells       records of completed cells, all of the same size
    failures.jsonl   one line per failed cell
    results/         dataset of :func:`~vibrissa.sweeps.open_sweep` as Zarr, written after each run

Records and lines contain their CRC-32. An incomplete record that a killed run left at the end of a
file is ignored, and removed by the next run; a damaged record is detected by its checksum, and its
cell is computed again. Descriptions are written to a temporary file and renamed.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import IO, Any
from zlib import crc32

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa._version import __version__
from vibrissa.io import held
from vibrissa.sweeps.study import Cell, Study

NOT_ASKED, TO_DO, DONE, FAILED, DAMAGED = -1, 0, 1, 2, 3  # statuses of cells
# Numeric properties of every whisker, and their units.
DESCRIBED = {
    "length": "m",
    "base_radius": "m",
    "tip_radius": "m",
    "taper_ratio": "1",
    "youngs_modulus": "Pa",
    "turn": "rad",
}
_STUDY, _LOCK, _FAILURES, RESULTS = ".study.json", ".sweep.lock", "failures.jsonl", "results"
LAYOUT = 4
OLD_LAYOUTS = (2, 3)  # old layouts, with a Zarr group per task, which can be read but not written
_SUM = "checksum"
_LIBRARIES = ("numpy", "scipy", "numba")
# Modules that compute a cell; results depend on these and the packages that they import.
_COMPUTING = ("study", "tasks")
_SOURCES = {".csv", ".py", ".toml"}
_IMPORTED = re.compile(r"(?:from|import) vibrissa\.(\w+)")


class Busy(ValueError):
    """Error raised if another run is writing to the store."""


@cache
def origin() -> str:
    """Description of the version, the sources and the libraries of this process."""
    digest = hashlib.sha256()
    for source in computing_sources():
        digest.update(source.read_bytes())
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    return f"vibrissa {__version__} (sources {digest.hexdigest()[:12]}), {libraries}"


def computing_sources() -> list[Path]:
    """Source files on which results depend: the computing modules and the packages they import."""
    package = Path(__file__).parents[1]
    sources = {package / "sweeps" / f"{name}.py" for name in _COMPUTING}
    left = set(sources)
    while left:
        for name in {*_IMPORTED.findall(left.pop().read_text(encoding="utf-8"))} - {"sweeps"}:
            files = {*package.glob(f"{name}.*"), *(package / name).rglob("*")}
            more = {file for file in files if file.suffix in _SOURCES}
            left |= more - sources
            sources |= more
    return sorted(sources)


@dataclass(frozen=True)
class Layout:
    """Layout of a task's results: (dims, shape, dtype, attributes) of each variable."""

    variables: Mapping[str, tuple[list[str], list[int], str, dict[str, Any]]]
    coordinates: Mapping[str, tuple[list[Any], dict[str, Any]]]

    @classmethod
    def of(cls, result: xr.Dataset) -> Layout:
        """Layout of a result, with words stored as flags."""
        return cls(
            {
                str(name): (
                    list(map(str, one.dims)),
                    list(one.shape),
                    "<i1" if one.dtype.kind in "ib" else "<f8",
                    _plain(one.attrs),
                )
                for name, one in result.data_vars.items()
            },
            {
                str(name): (one.values.tolist(), _plain(one.attrs))
                for name, one in result.coords.items()
            },
        )

    @classmethod
    def read(cls, folder: Path, task: str) -> Layout | None:
        """Read the layout of a task; None if there is none."""
        path = folder / f"{task}.json"
        if not path.exists():
            return None
        if (kept := _read_json(path)) is None:
            raise ValueError(
                f"{path} is damaged: `vibrissa sweep` with the same study computes the task again"
            )
        return cls(kept["variables"], kept["coordinates"])

    @property
    def record(self) -> np.dtype[np.void]:
        """Data type of a record."""
        values = [
            (name, kind, tuple(shape)) for name, (_, shape, kind, _) in self.variables.items()
        ]
        head = [("index", "<i4"), ("origin", "<i2"), ("seconds", "<f8"), ("identity", "S16")]
        whisker = [(name, "<f8") for name in DESCRIBED]
        return np.dtype([(_SUM, "<u4"), *head, ("whisker", whisker), ("result", values)])

    def misfit(self, result: xr.Dataset) -> str:
        """Describe why a result does not match this layout; empty if it does."""
        names = {*map(str, result.variables)}
        for name in sorted(names ^ {*self.variables, *self.coordinates}):
            return f"{name} is a result of this whisker or of others, and not of both\n"
        for name, (values, _) in self.coordinates.items():
            own = result.variables[name].values
            if not _same(np.asarray(values), own):
                return f"{name} is {own}, that of other whiskers {values}\n"
        for name, (_, shape, _, _) in self.variables.items():
            own_shape = result.variables[name].shape
            if list(own_shape) != shape:
                return f"{name} has shape {own_shape}, that of other whiskers has {tuple(shape)}\n"
        return ""


@dataclass(frozen=True)
class Cells:
    """Records of the completed cells of one task, and which are damaged."""

    layout: Layout
    records: NDArray[np.void]
    rows: NDArray[np.int64]
    damaged: NDArray[np.bool_]

    @classmethod
    def read(cls, folder: Path, task: str, count: int) -> Cells | None:
        """Read the records of a task for ``count`` whiskers; None if there are none."""
        if (layout := Layout.read(folder, task)) is None:
            return None
        content = b""
        with contextlib.suppress(FileNotFoundError):
            content = _cells(folder, task).read_bytes()
        size = layout.record.itemsize
        records = np.frombuffer(content, layout.record, len(content) // size)
        whole = np.fromiter(
            (
                crc32(content[start + 4 : start + size])
                for start in range(0, len(records) * size, size)
            ),
            np.uint32,
            len(records),
        )
        index = records["index"]
        known = (index >= 0) & (index < count)
        good = known & (whole == records[_SUM])
        rows = np.full(count, -1)
        rows[index[good]] = np.flatnonzero(good)
        damaged = np.zeros(count, dtype=bool)
        damaged[index[known & ~good]] = True
        return cls(layout, records, rows, damaged & (rows < 0))

    @property
    def done(self) -> NDArray[np.bool_]:
        """Mask of the whiskers whose cell is completed."""
        return self.rows >= 0

    def column(self, *names: str, fill: Any) -> NDArray[Any]:
        """Field of the records of all whiskers; ``fill`` where there is no record."""
        values: NDArray[Any] = self.records
        for name in names:
            values = values[name]
        out = np.full(
            (len(self.rows), *values.shape[1:]), fill, dtype=values.dtype.newbyteorder("=")
        )
        out[self.done] = values[self.rows[self.done]]
        return out


class Store:
    """Context manager of a study's store, open for writing.

    The folder is created if needed. A store started by another version of vibrissa is an error
    unless any version is allowed; `Busy` is raised if another run has the store open. `faults` are
    damaged parts that were replaced.
    """

    def __init__(
        self, path: str | PathLike[str], study: Study, *, any_version: bool = False
    ) -> None:
        self.path = Path(path)
        self.study = study
        self.faults: list[str] = []
        self._any_version = any_version
        self._lock: IO[str] | None = None
        self._layouts: dict[str, Layout] = {}

    def __enter__(self) -> Store:
        """Lock the store, and create it if needed."""
        if self.path.exists() and not self.path.is_dir():
            raise ValueError(f"{self.path} is a file; the folder of a store is needed")
        if self.path.exists() and any(self.path.iterdir()) and not (self.path / _LOCK).exists():
            raise ValueError(f"{self.path} is a folder with other contents, not a store")
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock = (self.path / _LOCK).open("a", encoding="utf-8")
        if not held(self._lock.fileno()):
            self.__exit__()
            raise Busy(f"another run is writing to {self.path}; wait until it has ended")
        try:
            self._begin()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *fault: object) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _begin(self) -> None:
        if not (self.path / _STUDY).exists():
            for left in (*self.path.glob("*.json"), *self.path.glob("*.cells")):
                left.unlink()  # it may belong to another study
            (self.path / _FAILURES).unlink(missing_ok=True)
            _write_json(self.path / _STUDY, {**_described(self.study), "origins": []})
        self._origin = self._admitted(described(self.path))
        for task in self.study.tasks:
            records = _cells(self.path, task)
            try:
                layout = Layout.read(self.path, task)
            except ValueError as fault:
                self._remove(task, str(fault))
                continue
            if layout is None and records.exists():
                self._remove(task, f"{self.path / task}.json is gone: its task is done again")
            elif layout is not None:
                self._layouts[task] = layout
                if records.exists():
                    _cut(records, records.stat().st_size % layout.record.itemsize)
        lines = self.path / _FAILURES
        if lines.exists():
            content = lines.read_bytes()
            _cut(lines, len(content) - content.rfind(b"\n") - 1)

    def _remove(self, task: str, fault: str) -> None:
        self.faults.append(fault)
        _cells(self.path, task).unlink(missing_ok=True)
        (self.path / f"{task}.json").unlink(missing_ok=True)

    def _admitted(self, kept: dict[str, Any]) -> int:
        """Check that study and code match the store; return the index of the code."""
        own = _described(self.study)
        if differing := [name for name in own if kept.get(name) != own[name]]:
            raise ValueError(
                f"{self.path} contains results of a study with other {' and '.join(differing)}: "
                "give another store, or remove this one"
            )
        origins: list[str] = kept["origins"]
        mine = origin()
        if mine not in origins:
            this, known = _version(mine), [*map(_version, origins)]
            if origins and this not in known and not self._any_version:
                raise ValueError(
                    f"the results in {self.path} were computed by {known[-1]}, and this is {this}, "
                    "whose results may differ: give another store, or allow any version "
                    "(--any-version); the store then records the version of each cell"
                )
            origins.append(mine)
            _write_json(self.path / _STUDY, kept)
        return origins.index(mine)

    def statuses(self) -> NDArray[np.int8]:
        """Read the statuses (whisker, task) of all cells."""
        columns = {name: k for k, name in enumerate(self.study.tasks)}
        count = len(self.study.specimens)
        asked = np.zeros((count, len(columns)), dtype="S16")
        for cell in self.study.cells():
            asked[cell.index, columns[cell.task]] = cell.identity.encode()
        out = np.zeros(asked.shape, dtype=np.int8)
        for task, k in columns.items():
            if (cells := Cells.read(self.path, task, count)) is not None:
                same = cells.column("identity", fill=b"") == asked[:, k]
                out[:, k] = np.where(cells.done & same, DONE, np.where(cells.damaged, DAMAGED, 0))
        for failure in read_failures(self.path):
            at = failure["index"], columns.get(failure["task"], -1)
            if failure["identity"].encode() == asked[at] and out[at] != DONE:
                out[at] = FAILED
        return out

    def write(self, cell: Cell, answer: Mapping[str, Any]) -> bool:
        """Write the result or the failure of a cell."""
        if failure := answer.get("failure") or self._kept(cell, answer):
            line = {
                "task": cell.task,
                "index": cell.index,
                "identity": cell.identity,
                "origin": self._origin,
                "seconds": answer["seconds"],
                "failure": f"{cell.specimen.name}\n{failure}",
            }
            text = json.dumps(line).encode()
            _append(self.path / _FAILURES, b"%08x %s\n" % (crc32(text), text))
        return not failure

    def _kept(self, cell: Cell, answer: Mapping[str, Any]) -> str:
        """Append a result; return the reason if it does not match the others, else empty."""
        result: xr.Dataset = answer["result"]
        if (layout := self._layouts.get(cell.task)) is None:
            layout = Layout.of(result)
            content = {"variables": layout.variables, "coordinates": layout.coordinates}
            _write_json(self.path / f"{cell.task}.json", content)
            self._layouts[cell.task] = layout
        elif misfit := layout.misfit(result):
            return misfit
        record = np.zeros(1, layout.record)
        head = (cell.index, self._origin, answer["seconds"], cell.identity.encode())
        whisker = tuple(answer["whisker"][name] for name in DESCRIBED)
        values = tuple(result.variables[name].values for name in layout.variables)
        record[0] = (0, *head, whisker, values)
        record[_SUM] = crc32(record.tobytes()[4:])
        _append(_cells(self.path, cell.task), record.tobytes())
        return ""

    def publish(self, results: xr.Dataset, changed: bool) -> None:
        """Write all results as Zarr, unless an unchanged complete copy exists."""
        if not changed and (there := self.path / RESULTS).exists():
            # The libraries' errors for damaged files are not documented.
            with contextlib.suppress(Exception):
                if xr.open_zarr(there, zarr_format=2).load().equals(results):
                    return
            self.faults.append(f"{there} was damaged or of an earlier run, and is written anew")
        aside = self.path / f".new-{RESULTS}"
        with _naming(aside):
            shutil.rmtree(aside, ignore_errors=True)
            results.to_zarr(aside, mode="w", zarr_format=2, consolidated=True)
            shutil.rmtree(self.path / RESULTS, ignore_errors=True)
            aside.rename(self.path / RESULTS)


def described(path: Path, layouts: Collection[int] = (LAYOUT,)) -> dict[str, Any]:
    """Read the description of a store's study and of the codes that computed its results."""
    file = path / _STUDY
    if not file.exists():
        raise ValueError(f"{path} is not a store of a sweep")
    kept: Any = None
    with contextlib.suppress(ValueError):
        kept = json.loads(file.read_bytes())
    if isinstance(kept, dict) and kept.get("layout") not in layouts:
        able = "its results can be shown (`vibrissa sweep show`), but it cannot be continued"
        raise ValueError(
            f"{path} has the layout of another version of vibrissa: "
            f"{able if kept.get('layout') in OLD_LAYOUTS else 'open it with that one'}; "
            "to run the study again give another store"
        )
    unchecked = isinstance(kept, dict) and kept.get("layout") == min(OLD_LAYOUTS)
    if not isinstance(kept, dict) or (kept.pop(_SUM, None) != _sum(kept) and not unchecked):
        raise ValueError(
            f"{file} is damaged, which describes the store: restore a copy of it, or remove it to "
            "start the study again"
        )
    return kept


def read_failures(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the failed cells; cells of damaged lines count as not computed."""
    with contextlib.suppress(FileNotFoundError):
        for line in (path / _FAILURES).read_bytes().splitlines():
            total, _, text = line.partition(b" ")
            if total == b"%08x" % crc32(text):
                yield json.loads(text)


def _described(study: Study) -> dict[str, Any]:
    """Properties that must agree for studies to share a store."""
    content = {
        "layout": LAYOUT,
        "name": study.name,
        "seed": study.seed,
        "whiskers": [[one.name, one.group, one.identity] for one in study.specimens],
        "tasks": {name: [kind, dict(how)] for name, (kind, how) in study.tasks.items()},
        "groups": {name: list(some) for name, some in study.groups.items()},
    }
    as_read: dict[str, Any] = json.loads(json.dumps(content))
    return as_read


def _version(name: str) -> str:
    """Vibrissa's part of an origin."""
    return name.partition(",")[0]


def _cells(folder: Path, task: str) -> Path:
    return folder / f"{task}.cells"


def _sum(content: Mapping[str, Any]) -> int:
    return crc32(json.dumps(content, sort_keys=True).encode())


def _read_json(path: Path) -> dict[str, Any] | None:
    """Read a file written by `_write_json`; None if it is damaged."""
    with contextlib.suppress(ValueError):
        kept = json.loads(path.read_bytes())
        if isinstance(kept, dict) and kept.pop(_SUM, None) == _sum(kept):
            return kept
    return None


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a description with its checksum to a temporary file, and rename it."""
    part = path.with_name(f"{path.name}.part")
    with _naming(path):
        part.write_text(json.dumps({**content, _SUM: _sum(content)}), encoding="utf-8")
        part.replace(path)


def _append(path: Path, content: bytes) -> None:
    """Append to a file; an incomplete write is undone."""
    with _naming(path), path.open("ab", buffering=0) as file:
        before, left = file.tell(), memoryview(content)
        try:
            while left:
                left = left[file.write(left) :]
        except OSError:
            with contextlib.suppress(OSError):
                file.truncate(before)
            raise


def _cut(path: Path, size: int) -> None:
    """Remove the last ``size`` bytes of a file, a partial record left by a killed run."""
    if size:
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size - size)


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Add the name of the file, and advice, to errors of writing."""
    try:
        yield
    except OSError as fault:
        raise OSError(
            fault.errno,
            f"{fault.strerror or fault}: {path} cannot be written. All written results are intact; "
            "the same call continues from them",
        ) from fault


def _plain(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    return {
        str(key): value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        for key, value in attributes.items()
    }


def _same(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Whether coordinates agree up to rounding."""
    if first.shape != second.shape:
        return False
    if first.dtype.kind == "f":
        return bool(np.allclose(first, second, rtol=1e-12, atol=0.0))
    return bool(np.array_equal(first, second))
