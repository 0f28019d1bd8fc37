"""Many rows, all cores: kernels release the GIL, so plain threads share the rows out."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

from vibrissa.numerics.arrays import Array
from vibrissa.rod.discretize import Discretization
from vibrissa.rod.kernels import carry_tangents, evaluate

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


def solve_forces(
    discretization: Discretization, contacts: Array, tangents: bool = False
) -> tuple[Array, Array]:
    """Base force and contact point of contacts whose force is known, non-dimensional."""
    contacts = np.ascontiguousarray(contacts, dtype=np.float64)
    n = contacts.shape[0]
    values = np.empty((n, 6))
    derivatives = np.empty((n if tangents else 0, 6, 3))
    rod = discretization.rod
    share_out(n, lambda first, last: evaluate(rod, contacts, values, derivatives, first, last))
    return values, derivatives


def contact_tangents(discretization: Discretization, contacts: Array) -> Array:
    """Unit tangents of the deflected whisker at its contacts, base frame."""
    contacts = np.ascontiguousarray(contacts, dtype=np.float64)
    tangents = np.empty((len(contacts), 3))
    rod = discretization.rod
    share_out(
        len(contacts), lambda first, last: carry_tangents(rod, contacts, tangents, first, last)
    )
    return tangents
