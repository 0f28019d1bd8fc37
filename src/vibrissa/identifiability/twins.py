"""Twins: contacts far apart that give the same three signals.

Where the map ξ → T is regular, all contacts with the triplet of a given one are found exactly
(:mod:`vibrissa.contacts.inversion`); those far from it are its twins. Where it is not, see
:mod:`vibrissa.identifiability.fibres`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.contacts.contact_map import Domain
from vibrissa.contacts.inversion import invert
from vibrissa.identifiability.regions import Places, in_chart, place, sample
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import chart_of, solve_forces, with_normal_force
from vibrissa.signals import SIGNALS, signal_derivatives, within_turn

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

#: Signals of twins agree to this, forces relative to |F| and moments to |M|, angles in rad.
AGREEMENT = 1e-10
# A solution that such a difference of the signals could move by more than this (over L) is not
# told apart from its neighbours.
_FIRM = 1e-3
# Nearer than this (over L) two solutions are the same contact.
_SAME = 1e-4
# The search for better twins starts wide, ends fine, and keeps so many of each region.
_WIDTHS = np.geomspace(0.2, 0.002, 16)
_KEPT = 16


class Pairs(NamedTuple):
    """Pairs of contacts with equal triplets."""

    chart: Array
    sample: AnyArray
    first: Places
    second: Places
    apart: Array

    def rows(self, which: AnyArray) -> Pairs:
        """Pick some."""
        return Pairs(
            self.chart[which],
            self.sample[which],
            self.first.rows(which),
            self.second.rows(which),
            self.apart[which],
        )

    def members(self, region: str) -> AnyArray:
        """Whether both contacts of a pair belong to a region."""
        return np.asarray(self.first.members(region) & self.second.members(region))

    @property
    def angle(self) -> Array:
        """The smaller of the two contacts' cone angles, rad."""
        return np.minimum(self.first.angle, self.second.angle)


def joined(parts: list[Pairs]) -> Pairs:
    """All pairs of several lists; their samples keep their numbers."""
    return Pairs(
        np.concatenate([p.chart for p in parts]),
        np.concatenate([p.sample for p in parts]),
        Places(*(np.concatenate(a) for a in zip(*(p.first for p in parts), strict=True))),
        Places(*(np.concatenate(a) for a in zip(*(p.second for p in parts), strict=True))),
        np.concatenate([p.apart for p in parts]),
    )


def triplet_derivatives(values: Array, tangents: Array, names: tuple[str, ...]) -> Array:
    """∂T/∂ξ (n, k, 3); zero where a direction has no value."""
    which = [SIGNALS.index(name) for name in names]
    return np.asarray(np.nan_to_num(signal_derivatives(values, tangents)[:, which]))


def twins(
    contact_map: ContactMap,
    names: tuple[str, ...],
    chart: Array,
    first: Places,
    domain: Domain,
    least: float = _SAME,
) -> Pairs:
    """Find all twins of contacts."""
    which = [SIGNALS.index(name) for name in names]
    found = invert(contact_map.chart, contact_map.tree(names), names, first.signals[:, which])
    apart = np.linalg.norm(found.values[:, :, 3:] - first.values[:, None, 3:], axis=2)
    rows, columns = np.nonzero(apart >= least)  # NaN is not
    xi, values = found.contacts[rows, columns], found.values[rows, columns]
    firm = _firm(contact_map, names, xi)
    rows, columns, xi, values = rows[firm], columns[firm], xi[firm], values[firm]
    second = place(contact_map, xi, values, domain)
    return Pairs(chart[rows], rows, first.rows(rows), second, apart[rows, columns])


def _firm(contact_map: ContactMap, names: tuple[str, ...], xi: Array) -> AnyArray:
    """Whether solutions stay where they are when their signals change by ``AGREEMENT``."""
    values, tangents = solve_forces(
        contact_map.chart.discretization, with_normal_force(xi), tangents=True
    )
    by_contact = triplet_derivatives(values, tangents, names)
    regular = np.abs(np.linalg.det(by_contact)) > 0.0
    moved = np.full(len(xi), np.inf)
    inverse = np.linalg.inv(by_contact[regular]) * sizes(values[regular], names)[:, None, :]
    moved[regular] = AGREEMENT * np.linalg.norm(tangents[regular, 3:] @ inverse, axis=(1, 2))
    return np.asarray(moved <= _FIRM)


def better_twins(
    contact_map: ContactMap,
    names: tuple[str, ...],
    pairs: Pairs,
    regions: tuple[str, ...],
    separation: float,
    domain: Domain,
    rng: np.random.Generator,
) -> Pairs:
    """Look for twins farther from rest than those known, near them.

    An evolution: the pairs of each region that are farthest apart, and among those far enough
    apart farthest from rest, are varied, ever more finely, and whatever twins the varied contacts
    have compete with them.
    """
    best = _best(pairs, regions, separation)
    for width in _WIDTHS:
        if not len(best.apart):
            break
        both = np.concatenate([best.chart, chart_of(contact_map.chart.fold, best.second.contacts)])
        noise = width * rng.standard_normal(both.shape) * [1.0, np.pi, 1.0]
        # Differences of good ones point along thin sets of them, which noise alone would miss.
        step = both[rng.permutation(len(both))] - both[rng.permutation(len(both))]
        step = within_turn(step, [False, True, False])
        chart = in_chart(np.concatenate([both + noise, both + 0.7 * step + 0.03 * noise]))
        found = twins(contact_map, names, chart, sample(contact_map, chart, domain).places, domain)
        best = _best(joined([best, found]), regions, separation)
    return best


def _best(pairs: Pairs, regions: tuple[str, ...], separation: float) -> Pairs:
    """The best pairs of each region, at most one of each part of the chart so that they differ."""
    far = pairs.apart >= separation
    part = np.floor(pairs.chart * [4.0, 4.0 / np.pi, 4.0] - 1e-9)
    chosen: set[int] = set()
    # Those that count, and those that promise to: far from rest, though not yet far apart.
    for score in (
        np.where(far, pairs.angle, -1.0),
        pairs.angle * np.minimum(pairs.apart / separation, 1.0) ** 2,
    ):
        order = np.argsort(-score, kind="stable")
        for region in regions:
            rows = order[pairs.members(region)[order]]
            _, first = np.unique(part[rows], axis=0, return_index=True)
            chosen.update(rows[np.sort(first)[:_KEPT]].tolist())
    return pairs.rows(np.array(sorted(chosen), dtype=np.int64))


def sizes(values: Array, names: tuple[str, ...]) -> Array:
    """What a difference of each signal is small beside (n, k): |F|, |M|, or 1 for directions."""
    force = np.linalg.norm(values[:, :3], axis=1)
    moment = np.linalg.norm(np.cross(values[:, 3:], values[:, :3]), axis=1)
    one = np.ones(len(values))
    sizes = {"Fx": force, "FT": force, "FD": one, "Mx": moment, "MB": moment, "MD": one}
    return np.stack([sizes[name] for name in names], axis=1)
