"""Fibres: curves of contacts with equal triplets, where a triplet has lost a dimension.

A straight whisker never twists: M_x = 0 everywhere. In a whisker of one stiffness and one curvature
the axial force and the bending moment at the base are related, F_x = -M²/2EI for a straight
cylinder. Then the contacts with equal triplets form curves, which are followed along the direction
in which the triplet does not change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts import RANK, Domain
from vibrissa.identifiability.regions import ContactSet, contact_set
from vibrissa.identifiability.twins import (
    AGREEMENT,
    Pairs,
    corrected,
    equations,
    signal_columns,
    stable,
    units,
)
from vibrissa.numerics import Array
from vibrissa.rod import discretize, solve_forces, with_normal_force

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

# Length of a step in units in which the chart is about one wide, and how many each way.
_STRIDE = 0.02
_STRIDES = 60


def fibres(
    contact_map: ContactMap,
    names: tuple[str, ...],
    steps: int,
    chart: Array,
    first: ContactSet,
    domain: Domain,
) -> Pairs:
    """Follow the curves of equal triplets through contacts where these have lost a dimension."""
    d = discretize(contact_map.whisker, steps)
    values, _ = solve_forces(d, with_normal_force(first.xi))
    first = contact_set(contact_map, first.xi, values, domain)
    targets = first.signals[:, signal_columns(names)]
    unit = units(contact_map, first.xi)
    rows, found = [], []
    for sense in (1.0, -1.0):
        running, xi = np.arange(len(chart)), first.xi
        direction = np.full(xi.shape, np.nan)
        for _ in range(_STRIDES):
            _, slope, _ = equations(d, names, xi, targets[running])
            direction = _along(slope * unit[running, None, :], direction, sense)
            xi = xi + _STRIDE * direction * unit[running]
            xi, values, misfit = corrected(d, names, xi, targets[running], unit[running])
            stays = (misfit <= AGREEMENT) & stable(contact_map, xi)
            xi, running, direction = xi[stays], running[stays], direction[stays]
            if not running.size:
                break
            rows.append(running)
            found.append(np.concatenate([xi, values[stays]], axis=1))
    row = np.concatenate(rows) if rows else np.zeros(0, dtype=np.int64)
    both = np.concatenate(found) if found else np.zeros((0, 9))
    second = contact_set(contact_map, both[:, :3], both[:, 3:], domain)
    apart = np.linalg.norm(second.values[:, 3:] - first.values[row, 3:], axis=1)
    return Pairs(chart[row], row, first.rows(row), second, apart)


def _along(slope: Array, before: Array, sense: float) -> Array:
    """Unit vectors (n, 3) in which T does not change, as near to those before as there are."""
    _, singular, rows = np.linalg.svd(slope)
    null = singular <= RANK * singular[:, :1]
    null[:, 2] = True
    onto = np.einsum("nk,nki,ni->nk", null, rows, before)
    turned = np.einsum("nk,nki->ni", onto, rows)
    fresh = np.isnan(before).any(axis=1)
    turned[fresh] = sense * rows[fresh, 2]
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))
