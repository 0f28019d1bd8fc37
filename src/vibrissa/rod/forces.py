"""Equilibria of known forces: explicit, but their integration needs steps as short as they bend.

Whatever its size, a force that is given in the deflected frame at the contact has one equilibrium,
which grows from rest with the force; nothing is iterated. A strong force winds the whisker up,
however, in waves as short as √(EI / force), and steps that are good up to slip-off do not follow
them. The size of the force is an invariant of the equations, and its error is the sign that steps
are too long. Where it shows, the steps are halved until that changes nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod.discretization import MOST_STEPS, discretize
from vibrissa.rod.kernels import solve_forces

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

# Relative error of the force's size up to which the steps are not in question; base force and
# contact point are then good to some 1e-5 (relative to the force and to L).
_KEPT = 1e-6
# What shorter steps may change, relative to the force and to L.
_SETTLED = 1e-4


def solve_known_forces(
    whisker: Whisker, contacts: Array, steps: int
) -> tuple[Array, IntArray, AnyArray]:
    """Base force and contact point of known forces of any size, non-dimensional."""
    values = solve_forces(discretize(whisker, steps), contacts)[0]
    needed = np.full(len(contacts), steps)
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.linalg.norm(contacts[:, 1:], axis=1)
        kept = np.abs(np.linalg.norm(values[:, :3], axis=1) - size) <= _KEPT * size
        scale = np.where(np.arange(6) < 3, size[:, None], 1.0)
        rows = np.flatnonzero(~kept)
        while rows.size and 2 * steps <= MOST_STEPS:
            steps *= 2
            finer = solve_forces(discretize(whisker, steps), contacts[rows])[0]
            settled = (np.abs(finer - values[rows]) <= _SETTLED * scale[rows]).all(axis=1)
            # Halving changes nothing while the whole contact is within the first step.
            error = np.abs(np.linalg.norm(finer[:, :3], axis=1) - size[rows])
            settled &= error <= _SETTLED * size[rows]
            rows, finer = rows[~settled], finer[~settled]
            values[rows], needed[rows] = finer, min(2 * steps, MOST_STEPS)
    good = np.ones(len(contacts), dtype=bool)
    good[rows] = False
    return values, needed, good
