"""What estimates ask of the kernels, and what these hand on to each other, as one reference each.

A map, the noise and the settings are some forty arrays and numbers; taking them apart at each call
costs ten microseconds, as much as solving for a contact.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import numba
import numpy as np
from numba.core import types
from numba.experimental import structref

from vibrissa.contacts.contacts import MOST_CANDIDATES, candidates_within
from vibrissa.contacts.nodes import Searched
from vibrissa.contacts.weighing import Weighing
from vibrissa.numerics import AnyArray, Array, inlined, kernel

#: At most so many starts for one measurement.
MOST_STARTS = 6


class Problem(NamedTuple):
    """How contacts are looked for.

    Whether three signals are solved exactly, whether noise is known, how often weights are taken
    at the contact, and the largest χ² that counts as explained.
    """

    exact: bool
    noisy: bool
    passes: int
    limit: float


@structref.register
class _TaskType(types.StructRef):
    """Type of `Task` in kernels."""


class Task(structref.StructRefProxy):
    """What is searched, how measurements are weighed, and how contacts are looked for."""

    of: Searched
    how: Weighing
    problem: Problem


_OF_TASK = ("of", "how", "problem")
structref.define_proxy(Task, _TaskType, _OF_TASK)


@kernel
def task(of: Searched, how: Weighing, problem: Problem) -> Task:
    """Keep these where kernels find them."""
    return Task(of, how, problem)  # type: ignore[no-untyped-call]


def type_of_task(of: Searched, how: Weighing, problem: Problem) -> types.Type:
    """Return the type that `task` gives these in kernels."""
    kinds = map(numba.typeof, (of, how, problem))
    return _TaskType(tuple(zip(_OF_TASK, kinds, strict=True)))  # type: ignore[no-untyped-call]


in_memory = inlined(candidates_within)


@structref.register
class _DescriptionType(types.StructRef):
    """Type of `Description` in kernels."""


class Description(structref.StructRefProxy):
    """What describes the candidates of noisy measurements, from one kernel to the next.

    Weights (n, m, k, k), ∂(F, p)/∂ξ (n, m, 6, 3), residuals (n, m, k) and their slopes
    (n, m, k, 4) in standard deviations; χ² and points (n, l, 4) of contacts that are not
    candidates, and whether others may be probable (n,).
    """

    weights: Array
    third: Array
    residuals: Array
    jacobians: Array
    loose: Array
    others: AnyArray


_DESCRIBED = ("weights", "third", "residuals", "jacobians", "loose", "others")
structref.define_proxy(Description, _DescriptionType, _DESCRIBED)


def type_of_description() -> types.Type:
    """Return the type that `description` makes."""
    three, four = (types.Array(types.float64, n, "C") for n in (3, 4))
    kinds = four, four, three, four, three, types.Array(types.boolean, 1, "C")
    return _DescriptionType(tuple(zip(_DESCRIBED, kinds, strict=True)))  # type: ignore[no-untyped-call]


@kernel
def description(n: int, k: int) -> Description:
    """Make room to describe the candidates of n measurements of k channels."""
    most = MOST_CANDIDATES
    return Description(  # type: ignore[no-untyped-call]
        np.zeros((n, most, k, k)),
        np.empty((n, most, 6, 3)),
        np.empty((n, most, k)),
        np.empty((n, most, k, 4)),
        np.empty((n, MOST_STARTS, 4)),
        np.empty(n, np.bool_),
    )


_of_thread = threading.local()


def described_in_thread(n: int, k: int) -> Description:
    """Return room for n measurements, that which this thread has had before if it fits."""
    kept: tuple[int, int, Description] | None = getattr(_of_thread, "kept", None)
    if kept is None or kept[0] < n or kept[1] != k:
        kept = _of_thread.kept = (n, k, description(n, k))
    return kept[2]
