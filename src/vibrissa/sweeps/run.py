"""Doing the cells of a study, on this machine or on a cluster.

One process, the one that calls, writes; others only compute. So results do not hang on how many
there are, nor on which of them did what. At any time only as many cells are under way as keep the
workers busy, and nothing is kept of those that are written: memory does not grow with the study.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from vibrissa.sweeps.checksums import DONE, FAILED
from vibrissa.sweeps.store import DAMAGED, Store
from vibrissa.sweeps.study import Cell, Study, answer

Progress = Callable[[int, int], None]
Answers = Generator[tuple[Cell, dict[str, Any]], None, None]


@dataclass(frozen=True)
class Outcome:
    """What a run did.

    Parameters
    ----------
    done, failed, skipped : int
        Cells done now, those of them that failed, and those that were there before.
    failed_before : int
        Of those that were there before, the ones that had failed.
    damaged : int
        Cells that were there before, but not as they had been written; they were done again.
    faults : tuple of str
        What of the store was so damaged that it was made anew.
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
    """Do what is not done yet of a study, and again what was damaged since.

    Parameters
    ----------
    study : Study
        What to do.
    path : str or path
        Of the store.
    workers : int
        Processes on this machine; 0 does everything in this one. A script that asks for any calls
        this under ``if __name__ == "__main__"``.
    scheduler : str, optional
        Address of a Dask scheduler, or "local" for a Dask cluster with ``workers`` processes on
        this machine (extra ``cluster``).
    again : bool
        Whether cells that failed before are tried again.
    any_version : bool
        Whether a store that another version of vibrissa began is gone on with.
    progress : callable, optional
        Called as ``progress(done, total)``, cells that were there before included.

    Returns
    -------
    Outcome
        How many cells.

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
        tell = progress or _silent
        tell(skipped, study.size)
        with closing(_answers(todo, workers, scheduler)) as answers:
            for cell, found in answers:
                failed += not store.write(cell, found)
                done += 1
                tell(skipped + done, study.size)
    return Outcome(
        done, failed, skipped, before, int((status == DAMAGED).sum()), tuple(store.faults)
    )


def _silent(done: int, total: int) -> None:
    pass


def _answers(cells: Iterable[Cell], workers: int, scheduler: str | None) -> Answers:
    if scheduler is not None:
        from vibrissa.sweeps.cluster import answers_by_dask

        return answers_by_dask(cells, scheduler, workers)
    if workers:
        from vibrissa.sweeps.workers import answers_by_processes

        return answers_by_processes(cells, workers)
    return ((cell, answer(cell)) for cell in cells)
