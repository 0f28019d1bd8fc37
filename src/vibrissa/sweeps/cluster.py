"""Doing cells on a Dask cluster."""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Generator, Iterable, Iterator
from typing import Any

from vibrissa.sweeps.origin import origin
from vibrissa.sweeps.study import Cell, answer

_AHEAD = 2
_PATIENCE = 20.0
"""How long to wait for a scheduler and its first worker, s."""
_DIED = "the workers that had this cell died (killed, or out of memory)\n"


def answers_by_dask(
    cells: Iterable[Cell], scheduler: str, workers: int
) -> Generator[tuple[Cell, dict[str, Any]], None, None]:
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
        _check(client, scheduler)
        killed: list[Cell] = []
        for cell, found in _round(client, scheduler, cells):
            if found is None:
                killed.append(cell)
            else:
                yield cell, found
        # A worker that dies takes others' cells with it: who is to blame shows when it is alone.
        for suspect in killed:
            for cell, found in _round(client, scheduler, [suspect]):
                yield cell, found or {"failure": _DIED, "seconds": float("nan")}
    finally:
        with contextlib.suppress(OSError, TimeoutError):
            client.close()
        if local is not None:
            local.close()


def _round(
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


def _check(client: Any, scheduler: str) -> None:
    """Whether there are workers that compute as this process does."""
    try:
        client.wait_for_workers(1, timeout=_PATIENCE)
    except TimeoutError:
        raise ValueError(f"the Dask scheduler at {scheduler} has no workers") from None
    mine = origin()
    for worker, its in client.run(origin).items():
        if its != mine:
            raise ValueError(f"{worker} has {its}; {mine} is needed, as here")
