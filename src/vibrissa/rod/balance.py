"""The balance of force and moment along a uniform rod, which makes F_x depend on the moment.

Along an unloaded part of a rod of constant section and intrinsic curvature u₀

    n·e₁ + m·u₀ + ½ m·B⁻¹m

is constant, n and m being force and moment in the material frame. At a contact without friction it
is zero, as n is normal to the rod and m vanishes, so that at the base F_x = -M·u₀ - ½ M·B⁻¹M. Of a
wire, F_x is thus nearly a function of the moment, and what distinguishes contacts is the small rest

    H = F_x + M·u₀ + ½ M·B⁻¹M,

in which terms that need components of M that are not measured are left out. Of any whisker, H and
the other signals contain the same information as F_x and the others, but H can be interpolated.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array, IntArray, copy, inlined, kernel
from vibrissa.rod.discretization import Rod


class Balance(NamedTuple):
    """How H depends on three quantities."""

    # (4,) Indices of F_x, M_B, M_D and M_x among the quantities; -1 for none.
    parts: IntArray
    # (5,) Weights of M_B²/2, M_B cos β, M_B sin β, M_x and M_x²/2, with β = M_D.
    weights: Array

    @classmethod
    def none(cls) -> Balance:
        """Return a balance that leaves quantities as they are."""
        return cls(np.full(4, -1), np.zeros(5))

    @classmethod
    def of(cls, rod: Rod, parts: list[int]) -> Balance:
        """Balance at the base of a rod; see ``parts``."""
        at_base = int(np.searchsorted(rod.start, 0.0))
        twist, by_y, by_z = rod.shape[at_base, :3, 0]
        weights = np.array([1.0, by_y, by_z, twist, rod.twist[at_base]])
        present = np.array(parts) >= 0
        weights *= present[[1, 2, 2, 3, 3]] & present[[1, 1, 1, 3, 3]] & present[0]
        return cls(np.array(parts), weights)


@inlined
def balanced(balance: Balance, values: Array, out: Array, slopes: Array) -> None:
    """Fill three quantities with H instead of F_x, and the derivatives of H by the others."""
    parts, w = balance.parts, balance.weights
    for q in range(3):
        out[q] = values[q]
    slopes[0] = slopes[1] = slopes[2] = 0.0
    if parts[0] < 0:
        return
    if parts[1] >= 0:
        size, cos, sin = values[parts[1]], 0.0, 0.0
        if parts[2] >= 0:
            cos, sin = np.cos(values[parts[2]]), np.sin(values[parts[2]])
            slopes[parts[2]] = size * (w[2] * cos - w[1] * sin)
        along = w[1] * cos + w[2] * sin
        out[parts[0]] += size * (0.5 * w[0] * size + along)
        slopes[parts[1]] = w[0] * size + along
    if parts[3] >= 0:
        twist = values[parts[3]]
        out[parts[0]] += twist * (w[3] + 0.5 * w[4] * twist)
        slopes[parts[3]] = w[3] + w[4] * twist


@kernel
def balance_rows(balance: Balance, values: Array, slopes: Array) -> None:
    """Replace F_x by H in values (n, 3) and derivatives (n, 3, 3) by any coordinates."""
    out, by, first = np.empty(3), np.empty(3), balance.parts[0]
    for row in range(values.shape[0] if first >= 0 else 0):
        balanced(balance, values[row], out, by)
        copy(out, values[row])
        for q in range(3):
            for a in range(3):
                slopes[row, first, a] += by[q] * slopes[row, q, a]
