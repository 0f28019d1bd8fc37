"""Doing the cells of a study, on this machine or on a cluster.

One process, the one that calls, writes; others only compute. So results do not hang on how many
there are, nor on which of them did what. At any time only as many cells are under way as keep the
workers busy.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from os import PathLike
from typing import Any

from vibrissa.sweeps.store import DONE, FAILED, Store
from vibrissa.sweeps.study import Cell, Study, answer

Progress = Callable[[int, int], None]
Answers = Iterator[tuple[Cell, dict[str, Any]]]

_AHEAD = 2
"""Cells that wait for each worker."""

_DIED = "the process that worked on this cell died (killed, or out of memory)\n"


@dataclass(frozen=True)
class Outcome:
    """What a run did.

    Parameters
    ----------
    done, failed, skipped : int
        Cells done now, those of them that failed, and those that were there before.
    failed_before : int
        Of those that were there before, the ones that had failed.
    """

    done: int
    failed: int
    skipped: int
    failed_before: int


def run_sweep(
    study: Study,
    path: str | PathLike[str],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    again: bool = False,
    progress: Progress | None = None,
) -> Outcome:
    """Do what is not done yet of a study.

    Parameters
    ----------
    study : Study
        What to do.
    path : str or path
        Of the store.
    workers : int
        Processes on this machine; 0 does everything in this one.
    scheduler : str, optional
        Address of a Dask scheduler, or "local" for a Dask cluster with ``workers`` processes on
        this machine (extra ``cluster``).
    again : bool
        Whether cells that failed before are tried again.
    progress : callable, optional
        Called as ``progress(done, total)``, cells that were there before included.

    Returns
    -------
    Outcome
        How many cells.

    Raises
    ------
    ValueError
        If the store is of another study or being written to, or there is no such scheduler.
    OSError
        If a result cannot be written; what was written before is whole.
    """
    if workers < 0:
        raise ValueError(f"workers is {workers}; 0 or more are needed")
    with Store(path, study) as store:
        status = store.statuses()
        columns = {name: k for k, name in enumerate(study.tasks)}
        ready = {DONE} if again else {DONE, FAILED}
        todo = [
            cell for cell in study.cells() if status[cell.index, columns[cell.task]] not in ready
        ]
        skipped, failed = study.size - len(todo), 0
        before = 0 if again else int((status == FAILED).sum())
        tell = progress or _silent
        tell(skipped, study.size)
        for number, (cell, found) in enumerate(_answers(todo, workers, scheduler), 1):
            store.write(cell, found)
            failed += "failure" in found
            tell(skipped + number, study.size)
    return Outcome(len(todo), failed, skipped, before)


def _silent(done: int, total: int) -> None:
    pass


def _answers(cells: Iterable[Cell], workers: int, scheduler: str | None) -> Answers:
    if scheduler is not None:
        from vibrissa.sweeps.cluster import answers_by_dask

        return answers_by_dask(cells, scheduler, workers)
    return _by_pool(cells, workers) if workers else ((cell, answer(cell)) for cell in cells)


def single_threaded() -> None:
    """Let kernels of this process, not yet loaded, use one thread: there are other workers."""
    os.environ["VIBRISSA_THREADS"] = "1"
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _by_pool(cells: Iterable[Cell], workers: int) -> Answers:
    """Answers from processes on this machine.

    When one of them dies the pool is lost, and nobody knows whose fault it was: the cells that were
    under way are done one by one, and the one that takes its process with it has failed.
    """
    waiting = iter(cells)
    while True:
        suspects: list[Cell] = []
        yield from _round(waiting, workers, suspects)
        if not suspects:
            return
        for cell in suspects:
            guilty: list[Cell] = []
            yield from _round(iter([cell]), 1, guilty)
            for one in guilty:
                yield one, {"failure": _DIED, "seconds": float("nan")}


def _round(waiting: Iterator[Cell], workers: int, suspects: list[Cell]) -> Answers:
    """Answers of one pool until all is done or it is lost; then suspects are what was under way."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, initializer=single_threaded)
    running: dict[Future[dict[str, Any]], Cell] = {}
    try:
        while True:
            while len(running) < _AHEAD * workers:
                cell = next(waiting, None)
                if cell is None:
                    break
                try:
                    running[pool.submit(answer, cell)] = cell
                except BrokenProcessPool:
                    suspects.append(cell)
                    break
            if not running:
                return
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                cell = running.pop(future)
                try:
                    found = future.result()
                except BrokenProcessPool:
                    suspects.append(cell)
                    continue
                yield cell, found
            if suspects:
                for future, cell in _ended(running):
                    try:
                        yield cell, future.result()
                    except BrokenProcessPool:
                        suspects.append(cell)
                return
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _ended(running: dict[Future[dict[str, Any]], Cell]) -> Iterator[tuple[Any, Cell]]:
    """What was under way when a pool was lost, once each knows what became of it."""
    left = deque(running.items())
    wait(running)
    running.clear()
    yield from left
