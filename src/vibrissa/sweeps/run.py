"""A run of a study, on this machine or on a cluster.

One process, the one that calls, writes; others only compute. So results do not depend on how many
there are, nor on which of them did what. At any time only as many cells are under way as keep the
workers busy, and nothing is kept of those that are written: memory does not grow with the study.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from os import PathLike

import numpy as np

from vibrissa.sweeps.executors import Answers, answers_by_dask, answers_by_processes
from vibrissa.sweeps.results import open_sweep
from vibrissa.sweeps.store import DAMAGED, DONE, FAILED, RESULTS, Store
from vibrissa.sweeps.study import Cell, Study, answer

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Outcome:
    """What a run did.

    Parameters
    ----------
    done, failed, skipped : int
        Numbers of cells done now, of those of them that failed, and of those that were there
        before.
    failed_before : int
        Number of cells that were there before and had failed.
    damaged : int
        Number of cells that were there before, but not as they had been written; they were done
        again.
    faults : tuple of str
        Parts of the store that were damaged and made anew.
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
        report = progress or _silent
        report(skipped, study.size)
        with closing(_answers(todo, workers, scheduler)) as answers:
            for cell, found in answers:
                failed += not store.write(cell, found)
                done += 1
                report(skipped + done, study.size)
        if done or not (store.path / RESULTS).exists():
            store.publish(open_sweep(path))
    return Outcome(
        done, failed, skipped, before, int((status == DAMAGED).sum()), tuple(store.faults)
    )


def _silent(done: int, total: int) -> None:
    pass


def _answers(cells: Iterable[Cell], workers: int, scheduler: str | None) -> Answers:
    if scheduler is not None:
        return answers_by_dask(cells, scheduler, workers)
    if workers:
        return answers_by_processes(cells, workers)
    return ((cell, answer(cell)) for cell in cells)
