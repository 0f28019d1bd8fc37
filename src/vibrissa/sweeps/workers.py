"""Doing cells in processes on this machine.

Each process has one cell at a time and a pipe of its own. So when one dies it is known which cell
it had, and no other is touched; and when the calling process is killed, its workers see it.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections import Counter, deque
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from vibrissa.sweeps.study import Cell, answer

_TRIES = 2
"""A cell whose process dies may not be to blame: somebody killed it, or memory ran out."""
_STARTS = 3
"""Processes that may die, one after the other, before they are ready."""
_DIED = f"the process that worked on this cell died, {_TRIES} times: killed, or out of memory\n"


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    cell: Cell
    ready: bool = False


def answers_by_processes(
    cells: Iterable[Cell], workers: int
) -> Generator[tuple[Cell, dict[str, Any]], None, None]:
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
                        yield died, {"failure": _DIED, "seconds": float("nan")}
                    continue
                if not worker.ready:
                    worker.ready, stillborn = True, 0
                    continue
                done = worker.cell
                # It goes on before the answer is dealt with.
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
    with contextlib.suppress(OSError):  # it died: its end of the pipe will tell
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
    # Ctrl-C goes to all processes of a terminal; the one that called says what becomes of it.
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
