"""Arguments of the estimation kernels and the results they pass on, each bundled as one reference.

A map, the noise and the settings comprise some forty arrays and numbers; unpacking them at each
call would take ten microseconds, as long as solving for a contact.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import numba
import numpy as np
from numba.core import types
from numba.experimental import structref

from vibrissa.contacts.contacts import MOST_CANDIDATES, candidates_within
from vibrissa.contacts.sensing.weighing import Weighing
from vibrissa.contacts.uncertainty.nodes import Searched
from vibrissa.numerics import AnyArray, Array, inlined, kernel

#: Largest number of starting points for one measurement.
MOST_STARTS = 6


class Problem(NamedTuple):
    """Settings of a search for contacts.

    Whether three signals are solved exactly, whether the noise is known, how often the weights are
    recomputed at the contact, and the largest χ² that counts as explained.
    """

    exact: bool
    noisy: bool
    passes: int
    limit: float


@structref.register
class _TaskType(types.StructRef):
    """Numba type of `Task`."""


class Task(structref.StructRefProxy):
    """Reference to the map, the weighing of measurements and the settings of the search."""

    of: Searched
    how: Weighing
    problem: Problem


_OF_TASK = ("of", "how", "problem")
structref.define_proxy(Task, _TaskType, _OF_TASK)


@kernel
def task(of: Searched, how: Weighing, problem: Problem) -> Task:
    """Store these in memory that kernels can refer to."""
    return Task(of, how, problem)  # type: ignore[no-untyped-call]


def type_of_task(of: Searched, how: Weighing, problem: Problem) -> types.Type:
    """Numba type of the reference that `task` would return."""
    kinds = map(numba.typeof, (of, how, problem))
    return _TaskType(tuple(zip(_OF_TASK, kinds, strict=True)))  # type: ignore[no-untyped-call]


in_memory = inlined(candidates_within)


@structref.register
class _DescriptionType(types.StructRef):
    """Numba type of `Description`."""


class Description(structref.StructRefProxy):
    """Reference to the description of noisy measurements' candidates, passed between kernels.

    Weights (n, m, k, k), ∂(F, p)/∂ξ (n, m, 6, 3), residuals (n, m, k) and their slopes
    (n, m, k, 4) in standard deviations; χ² and coordinates (n, l, 4) of contacts that are not
    candidates, and whether further ones may be probable (n,); index and logarithmic weight of the
    most probable candidate, and 1 if the second order describes its channels, else 0 (n, 3).
    """

    weights: Array
    third: Array
    residuals: Array
    jacobians: Array
    loose: Array
    others: AnyArray
    best: Array


_DESCRIBED = ("weights", "third", "residuals", "jacobians", "loose", "others", "best")
structref.define_proxy(Description, _DescriptionType, _DESCRIBED)


def type_of_description() -> types.Type:
    """Numba type of the reference that `description` returns."""
    two, three, four = (types.Array(types.float64, n, "C") for n in (2, 3, 4))
    kinds = four, four, three, four, three, types.Array(types.boolean, 1, "C"), two
    return _DescriptionType(tuple(zip(_DESCRIBED, kinds, strict=True)))  # type: ignore[no-untyped-call]


@kernel
def description(n: int, k: int) -> Description:
    """Allocate the description of the candidates of n measurements of k channels."""
    most = MOST_CANDIDATES
    return Description(  # type: ignore[no-untyped-call]
        np.zeros((n, most, k, k)),
        np.empty((n, most, 6, 3)),
        np.empty((n, most, k)),
        np.empty((n, most, k, 4)),
        np.empty((n, MOST_STARTS, 4)),
        np.empty(n, np.bool_),
        np.empty((n, 3)),
    )


_of_thread = threading.local()


def described_in_thread(n: int, k: int) -> Description:
    """Description for n measurements: the last one of this thread if it fits, else a new one."""
    kept: tuple[int, int, Description] | None = getattr(_of_thread, "kept", None)
    if kept is None or kept[0] < n or kept[1] != k:
        kept = _of_thread.kept = (n, k, description(n, k))
    return kept[2]
