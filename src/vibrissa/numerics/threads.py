"""Many rows, all cores: kernels release the GIL, so plain threads share the rows out."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

# Below this many rows starting a thread costs more than it saves.
_SERIAL = 256
_PIECES_PER_THREAD = 4


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    # One pool a process: threads do not survive a fork.
    return ThreadPoolExecutor(max_workers=threads(), thread_name_prefix="vibrissa")


def threads() -> int:
    """Return the number of cores that this process may use; ``VIBRISSA_THREADS`` overrides it."""
    wanted = os.environ.get("VIBRISSA_THREADS")
    if wanted is not None:
        return max(1, int(wanted))
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_out(rows: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(first, last)`` for pieces that cover all rows, on all cores."""
    if rows <= _SERIAL or threads() == 1:
        if rows:
            work(0, rows)
        return
    pieces = min(threads() * _PIECES_PER_THREAD, -(-rows // (_SERIAL // 2)))
    edges = np.linspace(0, rows, pieces + 1).astype(int)
    list(_pool(os.getpid()).map(work, edges[:-1].tolist(), edges[1:].tolist()))
