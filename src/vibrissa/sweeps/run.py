"""Execution of a study on this machine or on a cluster, and reading of its results.

Only the calling process writes; worker processes only compute. Results therefore do not depend on
the number of workers or on the assignment of cells. Only as many cells are in progress as keep the
workers busy, and results are discarded once written, so that memory does not grow with the study.

Each local worker has its own pipe and computes one cell at a time. If a worker dies, its cell is
known and no other is affected; if the calling process is killed, its workers end too.

Results are read as one dataset; failures and a short summary are available separately.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import uuid
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
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
    Store,
    described,
    origin,
    read_failures,
)
from vibrissa.sweeps.study import Cell, Study, answer
from vibrissa.sweeps.tasks import VERDICTS

_MM = 1e3


def open_sweep(path: str | PathLike[str]) -> xr.Dataset:
    """Read the results of a study as one dataset.

    Parameters
    ----------
    path : str or path
        Store of the study, which another process may be writing.

    Returns
    -------
    Dataset
        Results over ``whisker`` and the dimensions of the tasks. Variables are named after task and
        variable, as ``uniqueness_verdict``; verdicts are words. If a task's coordinates along a
        dimension differ from those of an earlier task, the name of the dimension is prefixed by
        that of the task. The dataset also contains the properties of every whisker and, over
        ``task``, ``seconds``, ``status`` (0 not done, 1 done, 2 failed, 3 damaged, −1 not
        requested) and ``origin``, the index in the attribute ``origins`` of the code that computed
        the result. Missing values are NaN or empty words.

    Raises
    ------
    ValueError
        If it is not a store, or too damaged to be read.
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
        renamed = {name: f"{task}_{name}" for name in data.data_vars}
        # Dimensions along which the coordinates differ from those of earlier tasks.
        for dim in {*out.dims} & {*data.dims} - {"whisker"}:
            if not out[dim].equals(data[dim]):
                renamed[dim] = f"{task}_{dim}"
        out = out.merge(data.rename(renamed), combine_attrs="override")
    return out


# Arrays over cells, arrays over whiskers, and the results of each task.
_Read = tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]], dict[str, xr.Dataset]]


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
    # Failures are read first, as cells may be completed during reading.
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
    """Read a store of the old layout, a Zarr group per task, without checking for damage."""
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
    """Group of a store of the old layout, as stored."""
    try:
        data: xr.Dataset = xr.open_zarr(path, chunks=None, decode_cf=False).load()
    except Exception as fault:  # the libraries' errors for damaged files are not documented
        raise ValueError(f"{path} is damaged: {' '.join(str(fault).split())[:200]}") from fault
    for each in data.variables.values():
        each.attrs.pop("_FillValue", None)
    return data.drop_attrs(deep=False)


def _worded(
    values: NDArray[Any], attributes: Mapping[Any, Any]
) -> tuple[NDArray[Any], dict[str, Any]]:
    """Convert flags to words; also return the remaining attributes."""
    about = {str(key): one for key, one in attributes.items() if not str(key).startswith("flag_")}
    if meanings := attributes.get("flag_meanings"):
        words = [word.replace("_", " ") for word in meanings.split()]
        values = np.array([*words, ""])[values.astype(int)]
    return values, about


def _results(cells: Cells) -> xr.Dataset:
    """Results of one task for all whiskers, with flags converted to words."""
    data: dict[str, Any] = {}
    for name, (dims, _, kind, attributes) in cells.layout.variables.items():
        values = cells.column("result", name, fill=-1 if kind == "<i1" else np.nan)
        data[name] = (("whisker", *dims), *_worded(values, attributes))
    coords = {name: (name, *one) for name, one in cells.layout.coordinates.items()}
    return xr.Dataset(data, coords)


def failures(path: str | PathLike[str]) -> dict[str, str]:
    """Read the failed cells and their errors.

    Parameters
    ----------
    path : str or path
        Store of the study.

    Returns
    -------
    dict
        Name of the whisker and traceback, by task and number of the whisker, as
        ``uniqueness-12``, of failed cells that have not been completed since.
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


def sweep_summary(found: xr.Dataset) -> Iterator[str]:
    """Yield the lines of a summary of the progress and the results of a study."""
    yield f"study {found.attrs.get('study', '')!r}: {found.sizes['whisker']} whiskers"
    for number, code in enumerate(np.atleast_1d(found.attrs["origins"])):
        yield f"  {int((found['origin'] == number).sum())} cells by {code}"
    for task in found["task"].values:
        status = found["status"].sel(task=task).values
        *counts, damaged = ((status == code).sum() for code in (DONE, FAILED, TO_DO, DAMAGED))
        seconds = float(np.nansum(found["seconds"].sel(task=task).values))
        again = f", {damaged} damaged (`vibrissa sweep` does them again)" if damaged else ""
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
            counts = [int((words == one).sum()) for one in VERDICTS]
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


Answers = Generator[tuple[Cell, dict[str, Any]], None, None]

_TRIES = 2  # attempts for a cell whose process dies, as the cell may not be the cause
_STARTS = 3  # successive processes that may die before they are ready
_PROCESS_DIED = (
    f"the process that worked on this cell died, {_TRIES} times: killed, or out of memory\n"
)
_AHEAD = 2  # cells in progress for each worker of a cluster
_PATIENCE = 20.0  # longest wait for a scheduler and its first worker, s
_WORKERS_DIED = "the workers that had this cell died (killed, or out of memory)\n"


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    cell: Cell
    ready: bool = False


def answers_by_processes(cells: Iterable[Cell], workers: int) -> Answers:
    """Yield the results of cells computed by processes on this machine."""
    waiting, again = iter(cells), deque[Cell]()
    deaths: Counter[tuple[str, int]] = Counter()
    stillborn = 0
    crew: dict[Connection, _Worker] = {}
    try:
        while True:
            while len(crew) < workers and (cell := _next(again, waiting)) is not None:
                worker = _hire(cell)
                crew[worker.pipe] = worker
            if not crew:
                return
            for pipe in wait(list(crew)):
                worker = crew[pipe]  # type: ignore[index]
                try:
                    found = worker.pipe.recv()
                except (EOFError, OSError):
                    _dismiss(crew.pop(worker.pipe))
                    died = worker.cell
                    if not worker.ready:
                        stillborn += 1
                        if stillborn >= _STARTS:
                            raise OSError(
                                f"{stillborn} processes died before they were ready, the last with "
                                f"exit code {worker.process.exitcode}. A script that calls this "
                                'must do so under if __name__ == "__main__"; workers=0 does '
                                "without processes"
                            ) from None
                        again.append(died)
                        continue
                    deaths[died.task, died.index] += 1
                    if deaths[died.task, died.index] < _TRIES:
                        again.append(died)
                    else:
                        yield died, {"failure": _PROCESS_DIED, "seconds": float("nan")}
                    continue
                if not worker.ready:
                    worker.ready, stillborn = True, 0
                    continue
                done = worker.cell
                # The worker gets its next cell before the result is handled.
                if (cell := _next(again, waiting)) is not None:
                    worker.cell = cell
                    _send(worker)
                else:
                    _dismiss(crew.pop(worker.pipe))
                yield done, found
    finally:
        for worker in crew.values():
            _dismiss(worker)


def _next(again: deque[Cell], waiting: Iterator[Cell]) -> Cell | None:
    return again.popleft() if again else next(waiting, None)


def _context() -> Any:
    """Context for starting processes: a fork server with all imports, or spawn."""
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["vibrissa.sweeps.study"])
    return context


def _hire(cell: Cell) -> _Worker:
    context = _context()
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,), daemon=True)
    process.start()
    theirs.close()
    worker = _Worker(process, ours, cell)
    _send(worker)
    return worker


def _send(worker: _Worker) -> None:
    with contextlib.suppress(OSError):  # the worker has died and closed its end of the pipe
        worker.pipe.send(worker.cell)


def _dismiss(worker: _Worker) -> None:
    worker.process.kill()
    worker.process.join()
    worker.pipe.close()


def _work(pipe: Connection) -> None:
    """Compute cells received from a pipe until killed."""
    # Ctrl-C reaches all processes of a terminal, and is handled by the calling one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    os.environ["VIBRISSA_THREADS"] = "1"  # there are other workers
    pipe.send(None)
    while True:
        pipe.send(answer(pipe.recv()))


def _follow_parent() -> None:
    """End this process when the calling process has ended."""
    if (parent := multiprocessing.parent_process()) is not None:
        wait([parent.sentinel])
        os._exit(1)


def answers_by_dask(cells: Iterable[Cell], scheduler: str, workers: int) -> Answers:
    """Yield the results of cells computed by a Dask cluster."""
    try:
        from distributed import Client, LocalCluster
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "a Dask cluster needs the extra: pip install 'vibrissa[cluster]'"
        ) from missing

    local = None
    if scheduler == "local":
        local = LocalCluster(
            n_workers=max(workers, 1),
            threads_per_worker=1,
            dashboard_address=None,
            env={"VIBRISSA_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
    try:
        client = Client(local or scheduler, timeout=_PATIENCE)
    except OSError as fault:
        raise ValueError(f"there is no Dask scheduler at {scheduler}: {fault}") from None
    try:
        _check_workers(client, scheduler)
        killed: list[Cell] = []
        for cell, found in _submitted(client, scheduler, cells):
            if found is None:
                killed.append(cell)
            else:
                yield cell, found
        # A dying worker loses all its cells: each is computed alone to find the cause.
        for suspect in killed:
            for cell, found in _submitted(client, scheduler, [suspect]):
                yield cell, found or {"failure": _WORKERS_DIED, "seconds": float("nan")}
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.close()
        if local is not None:
            local.close()


def _submitted(
    client: Any, scheduler: str, cells: Iterable[Cell]
) -> Iterator[tuple[Cell, dict[str, Any] | None]]:
    """Yield results as they arrive; None for a cell whose workers died."""
    from concurrent.futures import CancelledError

    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    waiting, asked = iter(cells), dict[str, Cell]()
    under_way = as_completed()

    def submit() -> None:
        if (cell := next(waiting, None)) is None:
            return
        # Keys are unique, as Dask would return the old result for the key of a failed cell.
        key = f"{cell.task}-{cell.index}-{uuid.uuid4().hex}"
        asked[key] = cell
        under_way.add(client.submit(answer, cell, key=key))

    for _ in range(_AHEAD * max(sum(client.nthreads().values()), 1)):
        submit()
    for future in under_way:
        cell = asked.pop(future.key)
        submit()
        try:
            yield cell, future.result()
        except KilledWorker:
            yield cell, None
        except (CancelledError, OSError) as fault:
            raise ValueError(
                f"the Dask scheduler at {scheduler} is gone. All written results are intact; the "
                "same call continues from them"
            ) from fault


def _check_workers(client: Any, scheduler: str) -> None:
    """Raise ValueError unless there are workers with the same code and libraries."""
    try:
        client.wait_for_workers(1, timeout=_PATIENCE)
    except TimeoutError:
        raise ValueError(f"the Dask scheduler at {scheduler} has no workers") from None
    mine = origin()
    for worker, its in client.run(origin).items():
        if its != mine:
            raise ValueError(f"{worker} has {its}; {mine} is needed, as here")


Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Outcome:
    """Numbers of cells computed, failed and existing in a run, and of damaged parts replaced."""

    done: int
    failed: int
    skipped: int
    failed_before: int
    damaged: int = 0
    faults: tuple[str, ...] = ()


def run_sweep(
    study: Study,
    path: str | PathLike[str],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    again: bool = False,
    any_version: bool = False,
    progress: Progress | None = None,
) -> Outcome:
    """Compute the cells of a study that are missing or damaged.

    Parameters
    ----------
    study : Study
        Study to run.
    path : str or path
        Store for the results, to which they are also written as a Zarr group ``results`` at the
        end.
    workers : int
        Number of processes on this machine; 0 computes in the calling process. A script with
        workers must call this function under ``if __name__ == "__main__"``.
    scheduler : str, optional
        Address of a Dask scheduler, or "local" for a Dask cluster with ``workers`` processes on
        this machine (extra ``cluster``).
    again : bool
        Whether cells that failed earlier are computed again.
    any_version : bool
        Whether to continue a store started by another version of vibrissa.
    progress : callable, optional
        Function called as ``progress(done, total)``, including existing cells.

    Returns
    -------
    Outcome
        Numbers of cells.

    Raises
    ------
    ValueError
        If the store is that of another study or version, another run is writing to it, or there is
        no such scheduler.
    OSError
        If a result cannot be written (earlier results remain intact), or no process started.
    """
    if workers < 0:
        raise ValueError(f"workers is {workers}; 0 or more are needed")
    with Store(path, study, any_version=any_version) as store:
        status = store.statuses()
        columns = {name: k for k, name in enumerate(study.tasks)}
        skip = np.isin(status, [DONE] if again else [DONE, FAILED])
        todo = (cell for cell in study.cells() if not skip[cell.index, columns[cell.task]])
        skipped, done, failed = int(skip.sum()), 0, 0
        before = 0 if again else int((status == FAILED).sum())
        report = progress or (lambda done, total: None)
        report(skipped, study.size)
        with closing(_answers(todo, workers, scheduler)) as answers:
            for cell, found in answers:
                failed += not store.write(cell, found)
                done += 1
                report(skipped + done, study.size)
        store.publish(open_sweep(path), changed=done > 0)
    return Outcome(
        done, failed, skipped, before, int((status == DAMAGED).sum()), tuple(store.faults)
    )


def _answers(cells: Iterable[Cell], workers: int, scheduler: str | None) -> Answers:
    if scheduler is not None:
        return answers_by_dask(cells, scheduler, workers)
    if workers:
        return answers_by_processes(cells, workers)
    return ((cell, answer(cell)) for cell in cells)
