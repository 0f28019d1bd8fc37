"""What estimates ask of the kernels, handed over as one reference.

A map, the noise and the settings are some forty arrays and numbers; taking them apart at each call
costs ten microseconds, as much as solving for a contact.
"""

from __future__ import annotations

from typing import NamedTuple

from numba.core import types
from numba.experimental import structref

from vibrissa.contacts.contacts import candidates_within
from vibrissa.contacts.nodes import Searched
from vibrissa.contacts.weighing import Weighing
from vibrissa.numerics import inlined, kernel


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


structref.define_proxy(Task, _TaskType, ["of", "how", "problem"])


@kernel
def task(of: Searched, how: Weighing, problem: Problem) -> Task:
    """Keep these where kernels find them."""
    return Task(of, how, problem)  # type: ignore[no-untyped-call]


in_memory = inlined(candidates_within)
