"""A run of a study, on this machine or on a cluster.

One process, the one that calls, writes; others only compute. So results do not depend on how many
there are, nor on which of them did what. At any time only as many cells are under way as keep the
workers busy, and nothing is kept of those that are written: memory does not grow with the study.

Each process of this machine has one cell at a time and a pipe of its own. So when one dies it is
known which cell it had, and no other is touched; and when the calling process is killed, its
workers end too.
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
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from os import PathLike
from typing import Any

import numpy as np

from vibrissa.sweeps.results import open_sweep
from vibrissa.sweeps.store import DAMAGED, DONE, FAILED, Store, origin
from vibrissa.sweeps.study import Cell, Study, answer

Answers = Generator[tuple[Cell, dict[str, Any]], None, None]

_TRIES = 2
"""A cell whose process dies may not be to blame: somebody killed it, or memory ran out."""
_STARTS = 3
"""Processes that may die, one after the other, before they are ready."""
_PROCESS_DIED = (
    f"the process that worked on this cell died, {_TRIES} times: killed, or out of memory\n"
)
_AHEAD = 2
"""Cells under way for each worker of a cluster."""
_PATIENCE = 20.0
"""Longest wait for a scheduler and its first worker, s."""
_WORKERS_DIED = "the workers that had this cell died (killed, or out of memory)\n"


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    cell: Cell
    ready: bool = False


def answers_by_processes(cells: Iterable[Cell], workers: int) -> Answers:
    """Answers from processes on this machine."""
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
                        _check_start(stillborn, worker)
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
                # It continues before the answer is handled.
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
    """Processes that begin alike; where fork is safe, from one that has imported all they need."""
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
    with contextlib.suppress(OSError):  # it died: its end of the pipe is closed
        worker.pipe.send(worker.cell)


def _dismiss(worker: _Worker) -> None:
    worker.process.kill()
    worker.process.join()
    worker.pipe.close()


def _check_start(count: int, worker: _Worker) -> None:
    if count >= _STARTS:
        raise OSError(
            f"{count} processes died before they were ready, the last with exit code "
            f"{worker.process.exitcode}. A script that calls this must do so under "
            'if __name__ == "__main__"; workers=0 does without processes'
        )


def _work(pipe: Connection) -> None:
    """Do what comes, until killed."""
    # Ctrl-C goes to all processes of a terminal; the one that called handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    os.environ["VIBRISSA_THREADS"] = "1"  # there are other workers
    pipe.send(None)
    while True:
        pipe.send(answer(pipe.recv()))


def _follow_parent() -> None:
    """End when the process that called is gone."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def answers_by_dask(cells: Iterable[Cell], scheduler: str, workers: int) -> Answers:
    """Answers from a Dask cluster."""
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
        # A worker that dies takes others' cells with it: who is to blame shows when it is alone.
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
    """Answers, as they come; None for a cell with which workers died."""
    from concurrent.futures import CancelledError

    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    waiting, asked = iter(cells), dict[str, Cell]()
    under_way = as_completed()

    def submit() -> None:
        if (cell := next(waiting, None)) is None:
            return
        # Never the same again: Dask would give the old answer to a question that failed before.
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
                f"the Dask scheduler at {scheduler} is gone. What is written is whole; the same "
                "call goes on from it"
            ) from fault


def _check_workers(client: Any, scheduler: str) -> None:
    """Whether there are workers that compute as this process does."""
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
    """Outcome of a run: numbers of cells, and parts of the store that were damaged and made anew.

    Of cells done now, of those of them that failed, and of those that were there before: skipped,
    or with a failure, or damaged, which were done again.
    """

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
    """Do the cells of a study that are not done yet, and those that were damaged since.

    Parameters
    ----------
    study : Study
        The study.
    path : str or path
        Store for its results; it also gets all of them as a Zarr group ``results`` at the end.
    workers : int
        Number of processes on this machine; 0 does everything in this one. A script that asks
        for any calls this under ``if __name__ == "__main__"``.
    scheduler : str, optional
        Address of a Dask scheduler, or "local" for a Dask cluster with ``workers`` processes on
        this machine (extra ``cluster``).
    again : bool
        Whether cells that failed before are tried again.
    any_version : bool
        Whether a store that another version of vibrissa began is continued.
    progress : callable, optional
        Function called as ``progress(done, total)``, cells that were there before included.

    Returns
    -------
    Outcome
        Numbers of cells.

    Raises
    ------
    ValueError
        If the store is of another study or version or being written to, or there is no such
        scheduler.
    OSError
        If a result cannot be written (what was written before is whole), or no process started.
    """
    if workers < 0:
        raise ValueError(f"workers is {workers}; 0 or more are needed")
    with Store(path, study, any_version=any_version) as store:
        status = store.statuses()
        columns = {name: k for k, name in enumerate(study.tasks)}
        ready = [DONE] if again else [DONE, FAILED]
        skip = np.isin(status, ready)
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
