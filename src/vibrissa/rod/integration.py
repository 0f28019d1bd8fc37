"""Integration of the rod equations: base force and contact point of contacts, and derivatives.

Kernels call :func:`integrate` for the contacts in a buffer (:mod:`vibrissa.rod.kernels`). A rod
with weight is integrated by a kernel of its own (:mod:`vibrissa.rod.weight`), compiled only where
needed, so that a rod without weight is not slowed down. Rows are distributed over the cores of the
CPU or the threads of a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from vibrissa.numerics import (
    AnyArray,
    Array,
    Translation,
    check_device,
    inlined,
    kernel,
    share_out,
    specialised,
)
from vibrissa.rod import kernels
from vibrissa.rod.discretization import Discretization, Rod, Weight
from vibrissa.rod.kernels import (
    BUFFER_SIZE,
    LANES,
    carry_tangents,
    integrate_weightless,
    lane_tangents,
    lane_value,
    lanes_tangents,
    set_all_lanes,
    set_lane,
    whisker_radius,
)
from vibrissa.rod.weight import integrate_weighted


@inlined
def _integrate(rod: Rod, b: Array, tangents: int, weight: Weight | None) -> None:
    """Integrate every lane, with or without weight."""
    if weight is None:  # resolved at compile time
        integrate_weightless(rod, b, tangents)
    else:
        integrate_weighted(rod, weight, b, tangents)


@specialised
def integrate(rod: Rod, b: Array, tangents: int) -> None:
    """Integrate every lane from its contact to the base, with its first ``tangents`` tangents."""
    _integrate(rod, b, tangents, rod.weight)


@kernel
def evaluate(
    rod: Rod, contacts: Array, values: Array, tangents: Array, first: int, last: int
) -> None:
    """Evaluate base force and contact point of contacts, and tangents if the array has rows."""
    b, four = np.zeros(BUFFER_SIZE), np.empty((6, 4))
    wanted = tangents.shape[0] > 0
    if LANES > 1 and wanted and last == first + 1:  # one contact: a lane for each of its tangents
        c = contacts[first]
        set_all_lanes(b, c[0], c[1], c[2], c[3])
        integrate(rod, b, 1)
        lane_value(b, 0, values[first])
        lanes_tangents(b, four)
        for a in range(6):
            t = tangents[first, a]
            t[0], t[1], t[2] = four[a, 0], four[a, 2], four[a, 3]
        return
    for row in range(first, last, LANES):
        for i in range(LANES):
            j = min(row + i, last - 1)
            set_lane(b, i, contacts[j, 0], contacts[j, 1], contacts[j, 2], contacts[j, 3], False)
        integrate(rod, b, 3 if wanted else 0)
        for i in range(min(LANES, last - row)):
            lane_value(b, i, values[row + i])
            if wanted:
                lane_tangents(b, i, tangents[row + i])


@kernel
def relative_radius(rod: Rod, s: float) -> tuple[float, float]:
    """Radius of the whisker over the base radius at s, and its derivative."""
    return whisker_radius(rod, s)


def solve_forces(
    discretization: Discretization, contacts: Array, tangents: bool = False, device: str = "cpu"
) -> tuple[Array, Array]:
    """Compute base force and contact point of contacts with known force, non-dimensional.

    Parameters
    ----------
    discretization : Discretization
        Rod.
    contacts : (n, 4) array
        Arc length and force in the material frame there, (s, f_x, f_y, f_z).
    tangents : bool
        Whether to compute derivatives.
    device : str
        Device on which to compute, "cpu" or "cuda".

    Returns
    -------
    values : (n, 6) array
        Base force and contact point (F, p).
    tangents : (n, 6, 3) array
        Derivatives by ξ = (s, f_y, f_z); no rows unless requested.
    """
    contacts = np.ascontiguousarray(contacts, dtype=np.float64)
    n = contacts.shape[0]
    values = np.empty((n, 6))
    derivatives = np.empty((n if tangents else 0, 6, 3))
    share_rows(evaluate, (discretization.rod,), (contacts,), (values, derivatives), device)
    return values, derivatives


def contact_tangents(discretization: Discretization, contacts: Array) -> Array:
    """Unit tangents (n, 3) of the deflected whisker at contacts (n, 4), in its own frame."""
    contacts = np.ascontiguousarray(contacts, dtype=np.float64)
    tangents = np.empty((len(contacts), 3))
    share_out(len(contacts), carry_tangents, discretization.rod, contacts, tangents)
    return tangents


def share_rows(
    kernel: Callable[..., Any],
    tables: tuple[Any, ...],
    inputs: tuple[AnyArray, ...],
    outputs: tuple[AnyArray, ...],
    device: str = "cpu",
) -> None:
    """Call ``kernel(*tables, *inputs, *outputs, first, last)`` on parts that cover all rows.

    The tables (arrays, numbers, and named tuples of them) are common to all rows; each row reads
    its inputs and fills its outputs, each (n, ...). A rod with weight requires the device "cpu".
    """
    if device == "cpu":
        share_out(len(inputs[0]), kernel, *tables, *inputs, *outputs)
        return
    check_device(device)
    _one_lane().run(kernel, tables, inputs, outputs)


@cache
def _one_lane() -> Translation:
    """Translation to one lane per thread: offsets in the lane buffer are divided by LANES."""
    offsets = {
        name: value // kernels.LANES
        for name, value in vars(kernels).items()
        if isinstance(value, int) and name.strip("_").isupper()
    }
    return Translation(offsets | {"integrate": kernels.integrate_weightless})
