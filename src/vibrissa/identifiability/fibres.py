"""Fibres: curves of contacts with equal triplets, where a triplet has lost a dimension.

A straight whisker never twists: M_x = 0 everywhere. In a whisker of one stiffness and one curvature
the axial force and the bending moment at the base are related, F_x = -M²/2EI for a straight
cylinder. Then the contacts with equal triplets form curves, which are followed along the direction
in which the triplet does not change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.contact_map import Domain
from vibrissa.identifiability.regions import ContactSet, contact_set, sample, spread
from vibrissa.identifiability.twins import (
    AGREEMENT,
    Pairs,
    corrected,
    equations,
    signal_columns,
    triplet_derivatives,
    units,
)
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import discretize, solve_forces, with_normal_force
from vibrissa.signals import circular_among

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

# Length of a step in units in which the chart is about one wide, and how many each way.
_STRIDE = 0.02
_STRIDES = 60
# Singular values smaller than this share of the largest count as zero.
_RANK = 1e-8
# A triplet has lost a dimension if it has at all but this share of the contacts.
_LOST = 0.99
# Where the equations relate signals to each other, the integration does so to its own error, which
# with so many times the steps is below ``_RANK``.
_FINER = 8
# Contacts that decide whether signals determine contacts at all.
_TRIED = 256


def determining(contact_map: ContactMap, names: tuple[str, ...]) -> bool:
    """Whether signals determine contacts, but for single ones."""
    contacts = sample(contact_map, spread(_TRIED, seed=0), "reachable").contacts
    which = signal_columns(names)
    circular = circular_among(names)
    span = np.where(circular, 2.0 * np.pi, np.ptp(contacts.signals[:, which], axis=0))
    return deficient(contact_map, names, contacts.xi, span) is None


def deficient(
    contact_map: ContactMap, names: tuple[str, ...], xi: Array, span: Array
) -> int | None:
    """Number of steps with which a triplet has lost a dimension at contacts; None if it has not."""
    # A signal without a range is zero everywhere, but for rounding.
    weight = np.where(span > _RANK, 1.0 / np.maximum(span, _RANK), 0.0)
    unit = units(contact_map, xi)
    for steps in (contact_map.steps, _FINER * contact_map.steps):
        d = discretize(contact_map.whisker, steps)
        values, tangents = solve_forces(d, with_normal_force(xi), tangents=True)
        slope = triplet_derivatives(values, tangents, names) * unit[:, None, :]
        singular = np.linalg.svd(slope * weight[:, None], compute_uv=False)
        if (singular[:, 2] <= _RANK * singular[:, 0]).mean() > _LOST:
            return steps
    return None


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
            stays = (misfit <= AGREEMENT) & _stable(contact_map, xi)
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
    null = singular <= _RANK * singular[:, :1]
    null[:, 2] = True
    onto = np.einsum("nk,nki,ni->nk", null, rows, before)
    turned = np.einsum("nk,nki->ni", onto, rows)
    fresh = np.isnan(before).any(axis=1)
    turned[fresh] = sense * rows[fresh, 2]
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def _stable(contact_map: ContactMap, xi: Array) -> AnyArray:
    force = np.hypot(xi[:, 1], xi[:, 2])
    inside = (xi[:, 0] >= contact_map.chart.proximal) & (xi[:, 0] <= 1.0)
    return np.asarray(inside & (force > 0.0) & (force < units(contact_map, xi)[:, 1]))
