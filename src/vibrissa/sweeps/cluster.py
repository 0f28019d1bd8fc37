"""Doing cells on a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from vibrissa.sweeps.study import Cell, answer

_AHEAD = 2
_PATIENCE = 20.0
"""How long to wait for a scheduler, s."""


def answers_by_dask(
    cells: Iterable[Cell], scheduler: str, workers: int
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Answers from a Dask cluster.

    Parameters
    ----------
    cells : iterable of Cell
        What to do.
    scheduler : str
        Its address, or "local": a cluster on this machine, for as long as it takes.
    workers : int
        Of a local one.

    Yields
    ------
    cell : Cell
        What was asked.
    answer : dict
        Of `vibrissa.sweeps.study.answer`.

    Raises
    ------
    ValueError
        If there is no such scheduler, or it goes away; what was written before is whole.
    ModuleNotFoundError
        If Dask is not installed.
    """
    try:
        from distributed import Client, LocalCluster, as_completed
        from distributed.scheduler import KilledWorker
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
    waiting = iter(cells)
    try:
        under_way = as_completed()
        asked: dict[str, Cell] = {}

        def submit() -> None:
            cell = next(waiting, None)
            if cell is not None:
                future = client.submit(
                    answer, cell, key=f"{cell.task}-{cell.index}-{cell.identity}"
                )
                asked[future.key] = cell
                under_way.add(future)

        for _ in range(_AHEAD * max(sum(client.nthreads().values()), 1)):
            submit()
        for future in under_way:
            cell = asked.pop(future.key)
            submit()
            if future.status == "cancelled":
                raise ValueError(f"the Dask scheduler at {scheduler} is gone: call again to go on")
            try:
                yield cell, future.result()
            except KilledWorker as fault:
                yield cell, {"failure": f"{fault}\n", "seconds": float("nan")}
    finally:
        client.close()
        if local is not None:
            local.close()
