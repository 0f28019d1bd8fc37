"""Contacts with the regions that they belong to: what the search for twins works on.

All arrays are non-dimensional (lengths over L, forces over EI/L²), as in :mod:`vibrissa.rod`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.contacts import Domain, within_paper_bounds
from vibrissa.deferred import stats
from vibrissa.numerics import AnyArray, Array, cross
from vibrissa.rod import (
    Fold,
    contact_tangents,
    contacts_at,
    determinant,
    solve_forces,
    with_normal_force,
)
from vibrissa.signals import backward_offset, cone_angle, in_region, signals_of

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

# Directions have no value at zero force: samples are kept off it.
_LEAST_LOAD = 0.01
# Step of the derivatives of the chart, a cube root of rounding.
_STEP = 1e-6


class ContactSet(NamedTuple):
    """Contacts with the regions they belong to.

    ξ (n, 3); (F, p) (n, 6); cone angle from rest, rad; offset backward over L, positive where
    concave backward; x of the tangent, negative where deflected far; whether inside the domain.
    """

    xi: Array
    values: Array
    angle: Array
    backward: Array
    tangent_x: Array
    inside: AnyArray

    def rows(self, which: AnyArray | slice) -> ContactSet:
        """Pick some."""
        return ContactSet(*(a[which] for a in self))

    def members(self, region: str) -> AnyArray:
        """Whether each belongs to a region, whatever its angle."""
        return self.inside & in_region(region, self.backward > 0.0, self.tangent_x < 0.0)

    @property
    def signals(self) -> Array:
        """The six signals (n, 6)."""
        force, point = self.values[:, :3], self.values[:, 3:]
        return signals_of(force, cross(point, force))


class Samples(NamedTuple):
    """Contacts spread over Ω.

    Chart coordinates (η, ψ, ρ) (n, 3); the contacts; ∂(F, p)/∂ξ (n, 6, 3); each one's share of the
    volume of contact points (n,), up to a common factor.
    """

    chart: Array
    contacts: ContactSet
    tangents: Array
    volume: Array

    def rows(self, which: AnyArray | slice) -> Samples:
        """Pick some."""
        return Samples(
            self.chart[which], self.contacts.rows(which), self.tangents[which], self.volume[which]
        )


def contact_set(contact_map: ContactMap, xi: Array, values: Array, domain: Domain) -> ContactSet:
    """Find the regions of contacts ξ (n, 3) with known (F, p) (n, 6)."""
    whisker, d = contact_map.whisker, contact_map.chart.discretization
    points = values[:, 3:] * d.length
    inside = np.ones(len(xi), dtype=bool)
    if domain == "paper":
        inside = within_paper_bounds(whisker, points)
    return ContactSet(
        xi=xi,
        values=values,
        angle=cone_angle(whisker, points),
        backward=backward_offset(whisker, points) / d.length,
        tangent_x=contact_tangents(d, with_normal_force(xi))[:, 0],
        inside=inside,
    )


def solved(contact_map: ContactMap, chart: Array, domain: Domain) -> tuple[ContactSet, Array]:
    """Solve the contacts at chart coordinates (n, 3); ∂(F, p)/∂ξ (n, 6, 3) too."""
    xi = contacts_at(contact_map.chart.fold, chart)
    d = contact_map.chart.discretization
    values, tangents = solve_forces(d, with_normal_force(xi), tangents=True)
    contacts = contact_set(contact_map, xi, values, domain)
    # The chart has the fold to a part in a million: contacts beyond it do not count.
    stable = determinant(tangents) > 0.0
    return contacts._replace(inside=contacts.inside & stable), tangents


def sample(contact_map: ContactMap, chart: Array, domain: Domain) -> Samples:
    """Solve the contacts at chart coordinates (n, 3), with what they stand for."""
    contacts, tangents = solved(contact_map, chart, domain)
    by_chart = tangents[:, 3:] @ _chart_derivatives(contact_map.chart.fold, chart)
    return Samples(chart, contacts, tangents, np.abs(np.linalg.det(by_chart)))


def spread(number: int, seed: int | None) -> Array:
    """Low-discrepancy chart coordinates (n, 3), at least ``number`` of them: a power of two.

    Without a seed they are not scrambled.
    """
    rng = None if seed is None else np.random.default_rng(seed)
    sobol = stats.qmc.Sobol(3, scramble=seed is not None, seed=rng)
    unit = sobol.random_base2(max(1, int(np.ceil(np.log2(number)))))
    return in_chart(unit * [1.0, 2.0 * np.pi, 1.0])


def in_chart(chart: Array) -> Array:
    """Bring chart coordinates (n, 3) back into the chart: reflected at its faces, ψ on a circle."""
    chart = np.array(chart)
    for axis in (0, 2):
        x = np.abs(chart[:, axis]) % 2.0
        chart[:, axis] = np.minimum(x, 2.0 - x)
    chart[:, 1] %= 2.0 * np.pi
    chart[:, 2] = np.maximum(chart[:, 2], _LEAST_LOAD)
    return chart


def _chart_derivatives(fold: Fold, chart: Array) -> Array:
    """∂ξ/∂(η, ψ, ρ), (n, 3, 3), by central differences of the chart itself."""
    columns = [
        (contacts_at(fold, chart + step) - contacts_at(fold, chart - step)) / (2.0 * _STEP)
        for step in _STEP * np.eye(3)
    ]
    return np.stack(columns, axis=-1)
