"""Rows of the rod's kernels, shared out over the cores of the CPU or the threads of a GPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from vibrissa.numerics import AnyArray, Translation, check_device, share_out
from vibrissa.rod import kernels


def share_rows(
    kernel: Callable[..., Any],
    tables: tuple[Any, ...],
    inputs: tuple[AnyArray, ...],
    outputs: tuple[AnyArray, ...],
    device: str = "cpu",
) -> None:
    """Call ``kernel(*tables, *inputs, *outputs, first, last)`` for parts that cover all rows.

    Parameters
    ----------
    kernel : callable
        Kernel that fills rows of the outputs.
    tables : tuple
        Arrays, numbers and named tuples of them that all rows share.
    inputs, outputs : tuple of (n, ...) array
        Arrays that a row reads, and those that it fills.
    device : str
        Name of the device, "cpu" or "cuda"; a rod with a weight is for the CPU alone.
    """
    if device == "cpu":
        share_out(
            len(inputs[0]),
            lambda first, last: kernel(*tables, *inputs, *outputs, first, last),
        )
        return
    check_device(device)
    _one_lane().run(kernel, tables, inputs, outputs)


@cache
def _one_lane() -> Translation:
    """A thread has one lane: all offsets in the lane buffer are multiples of their number."""
    offsets = {
        name: value // kernels.LANES
        for name, value in vars(kernels).items()
        if isinstance(value, int) and name.strip("_").isupper()
    }
    return Translation(offsets | {"integrate": kernels.integrate_weightless})
