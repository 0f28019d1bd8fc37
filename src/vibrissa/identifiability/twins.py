"""Twins: distant contacts that have the same three signals.

Where the map ξ → T is regular, all contacts with the triplet of a given one are found exactly
(:mod:`vibrissa.contacts.fitting.inversion`); the distant ones are its twins.

Where a triplet has lost a dimension, contacts with equal triplets form curves, its *fibres*. A
straight whisker never twists: M_x = 0 everywhere. In a whisker of uniform stiffness and curvature
the axial force and the bending moment at the base are related, F_x = -M²/2EI for a straight
cylinder. Fibres are followed along the direction in which the triplet does not change.

Where the integration error exceeds the difference of the signals, two contacts can agree on the
discretised rod but not on the continuous one: a pair counts only if it is found again on a finer
rod.

A witness is a pair of twins for which the whisker is deflected again, as two whiskers.

All arrays are non-dimensional (lengths over L, forces over EI/L²), as in :mod:`vibrissa.rod`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.contacts import RANK, ContactMap, Domain, invert, polish, within_paper_bounds
from vibrissa.deferred import stats
from vibrissa.numerics import AnyArray, Array, IntArray, cross
from vibrissa.rod import (
    STEPS,
    Deflection,
    Discretization,
    Fold,
    PointForce,
    chart_of,
    contact_tangents,
    contacts_at,
    deflect,
    determinant,
    discretize,
    fold_forces,
    solve_forces,
    with_normal_force,
)
from vibrissa.signals import (
    SIGNALS,
    backward_offset,
    base_signals,
    circular_among,
    cone_angle,
    in_region,
    signal_derivatives,
    signals_of,
    within_turn,
)
from vibrissa.whisker import Whisker

_LEAST_LOAD = 0.01  # smallest ρ of samples: directions are undefined at zero force
_STEP = 1e-6  # step of the derivatives of the chart, a cube root of rounding


class ContactSet(NamedTuple):
    """Contacts and the regions to which they belong.

    xi (n, 3): ξ; values (n, 6): (F, p); angle: cone angle from rest, rad; backward: offset over L,
    positive if concave backward; tangent_x: x of the tangent, negative at a large deflection;
    inside: whether in the domain.
    """

    xi: Array
    values: Array
    angle: Array
    backward: Array
    tangent_x: Array
    inside: AnyArray

    def rows(self, which: AnyArray | slice) -> ContactSet:
        """Select rows."""
        return ContactSet(*(a[which] for a in self))

    def members(self, region: str) -> AnyArray:
        """Whether each contact belongs to a region, irrespective of the cone angle."""
        return self.inside & in_region(region, self.backward > 0.0, self.tangent_x < 0.0)

    @property
    def signals(self) -> Array:
        """The six signals (n, 6)."""
        force, point = self.values[:, :3], self.values[:, 3:]
        return signals_of(force, cross(point, force))


class Samples(NamedTuple):
    """Contacts spread over Ω.

    chart (n, 3): coordinates (η, ψ, ρ); the contacts; gradients (n, 6, 3): directions of the six
    signals' gradients; volume (n,): share of the volume of contact points, up to a common factor.
    """

    chart: Array
    contacts: ContactSet
    gradients: Array
    volume: Array

    def rows(self, which: AnyArray | slice) -> Samples:
        """Select rows."""
        return Samples(
            self.chart[which], self.contacts.rows(which), self.gradients[which], self.volume[which]
        )


def contact_set(
    contact_map: ContactMap,
    xi: Array,
    values: Array,
    domain: Domain,
    turned: AnyArray | slice = slice(None),
) -> ContactSet:
    """Determine the regions of contacts ξ (n, 3) with known (F, p) (n, 6).

    Tangents are computed only for contacts ``turned``; others count as not deflected far.
    """
    whisker, d = contact_map.whisker, contact_map.chart.discretization
    points = values[:, 3:] * d.length
    inside = np.ones(len(xi), dtype=bool)
    if domain == "paper":
        inside = within_paper_bounds(whisker, points)
    tangent_x = np.ones(len(xi))
    tangent_x[turned] = contact_tangents(d, with_normal_force(xi[turned]))[:, 0]
    return ContactSet(
        xi=xi,
        values=values,
        angle=cone_angle(whisker, points),
        backward=backward_offset(whisker, points) / d.length,
        tangent_x=tangent_x,
        inside=inside,
    )


def solve_chart(contact_map: ContactMap, chart: Array, domain: Domain) -> tuple[ContactSet, Array]:
    """Solve the contacts at chart coordinates (n, 3); also return ∂(F, p)/∂ξ (n, 6, 3)."""
    xi = contacts_at(contact_map.chart.fold, chart)
    d = contact_map.chart.discretization
    values, tangents = solve_forces(d, with_normal_force(xi), tangents=True)
    contacts = contact_set(contact_map, xi, values, domain)
    # The chart's fold is accurate to one part in a million; contacts beyond the true one are out.
    stable = determinant(tangents) > 0.0
    return contacts._replace(inside=contacts.inside & stable), tangents


def sample(contact_map: ContactMap, chart: Array, domain: Domain) -> Samples:
    """Solve the contacts at chart coordinates (n, 3), with gradients of signals and volumes."""
    contacts, tangents = solve_chart(contact_map, chart, domain)
    by_chart = tangents[:, 3:] @ _chart_derivatives(contact_map.chart.fold, chart)
    gradients = np.nan_to_num(signal_derivatives(contacts.values, tangents))
    size = np.linalg.norm(gradients, axis=2, keepdims=True)
    gradients /= np.where(size > 0.0, size, 1.0)
    return Samples(chart, contacts, gradients, np.abs(np.linalg.det(by_chart)))


def spread(number: int, seed: int | None) -> Array:
    """Low-discrepancy chart coordinates (n, 3), n a power of two; without a seed not scrambled."""
    rng = None if seed is None else np.random.default_rng(seed)
    sobol = stats.qmc.Sobol(3, scramble=seed is not None, seed=rng)
    unit = sobol.random_base2(max(1, int(np.ceil(np.log2(number)))))
    return in_chart(unit * [1.0, 2.0 * np.pi, 1.0])


def in_chart(chart: Array) -> Array:
    """Map chart coordinates (n, 3) into the chart: reflected at its faces, ψ modulo 2π."""
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


#: Agreement of twins' signals: forces over |F|, moments over |M|, angles in rad.
AGREEMENT = 1e-10
#: Displacement (over L) by a change of ``AGREEMENT``, above which a solution is not distinct from
#: its neighbours.
FIRM = 1e-3
#: Factor by which the number of steps is larger on the rod on which pairs are confirmed.
FINER = 4
# Largest displacement of a confirmed pair's second contact, as a share of the pair's distance.
_STEADY = 0.2
_SAME = 1e-4  # distance (over L) below which two solutions are the same contact
# Widths of the variation in the search for better twins, and pairs kept per region.
_WIDTHS = np.geomspace(0.2, 0.02, 9)
_KEPT = 16
# Length of a step along a fibre, in units in which the chart is about one wide; steps each way.
_STRIDE = 0.02
_STRIDES = 60
# Number of contacts from which other parts of a fibre are solved.
_SIMILAR = 16
# Number of Gauss-Newton steps in a correction, and relative cutoff of singular values.
_CORRECTIONS = 5
_RCOND = 1e-6


class Pairs(NamedTuple):
    """Pairs of contacts with equal triplets.

    chart (n, 3): coordinates of the first contact; sample (n,): index of the sample it came from;
    both contacts; apart (n,): their distance over L.
    """

    chart: Array
    sample: AnyArray
    first: ContactSet
    second: ContactSet
    apart: Array

    def rows(self, which: AnyArray) -> Pairs:
        """Select rows."""
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


class Search(NamedTuple):
    """Parameters of a search for twins: triplet, least distance over L, and domain."""

    contact_map: ContactMap
    names: tuple[str, ...]
    separation: float
    domain: Domain


def concatenate(parts: list[Pairs]) -> Pairs:
    """Concatenate lists of pairs; the sample indices are unchanged."""
    return Pairs(
        np.concatenate([p.chart for p in parts]),
        np.concatenate([p.sample for p in parts]),
        ContactSet(*(np.concatenate(a) for a in zip(*(p.first for p in parts), strict=True))),
        ContactSet(*(np.concatenate(a) for a in zip(*(p.second for p in parts), strict=True))),
        np.concatenate([p.apart for p in parts]),
    )


def signal_columns(names: tuple[str, ...]) -> list[int]:
    """Columns of the named signals among the six."""
    return [SIGNALS.index(name) for name in names]


def triplet_derivatives(values: Array, tangents: Array, names: tuple[str, ...]) -> Array:
    """∂T/∂ξ (n, k, 3); zero where a direction is undefined."""
    return np.asarray(np.nan_to_num(signal_derivatives(values, tangents)[:, signal_columns(names)]))


def twins(
    contact_map: ContactMap, names: tuple[str, ...], chart: Array, first: ContactSet, domain: Domain
) -> Pairs:
    """Find all twins of contacts ``first`` at chart coordinates (n, 3)."""
    targets = first.signals[:, signal_columns(names)]
    found = invert(contact_map.chart, contact_map.tree(names), names, targets)
    apart = np.linalg.norm(found.values[:, :, 3:] - first.values[:, None, 3:], axis=2)
    rows, columns = np.nonzero(apart >= _SAME)  # false for NaN
    xi, values = found.contacts[rows, columns], found.values[rows, columns]
    firm = _is_distinct(contact_map, names, xi)
    rows, columns, xi, values = rows[firm], columns[firm], xi[firm], values[firm]
    second = contact_set(contact_map, xi, values, domain)
    return Pairs(chart[rows], rows, first.rows(rows), second, apart[rows, columns])


def _is_distinct(contact_map: ContactMap, names: tuple[str, ...], xi: Array) -> AnyArray:
    """Whether solutions are displaced by at most ``FIRM`` if their signals change by AGREEMENT."""
    values, tangents = solve_forces(
        contact_map.chart.discretization, with_normal_force(xi), tangents=True
    )
    by_contact = triplet_derivatives(values, tangents, names)
    regular = np.abs(np.linalg.det(by_contact)) > 0.0
    moved = np.full(len(xi), np.inf)
    inverse = np.linalg.inv(by_contact[regular]) * sizes(values[regular], names)[:, None, :]
    moved[regular] = AGREEMENT * np.linalg.norm(tangents[regular, 3:] @ inverse, axis=(1, 2))
    return np.asarray(moved <= FIRM)


def better_twins(
    search: Search, pairs: Pairs, regions: tuple[str, ...], rng: np.random.Generator
) -> Pairs:
    """Search for twins farther from rest, in the neighbourhood of known pairs.

    An evolution: the pairs of each region that are farthest from rest and far enough apart are
    varied with decreasing width, and the twins of the varied contacts compete with them.
    """
    contact_map, names, separation, domain = search
    best = _select_best(pairs, regions, separation)
    for width in _WIDTHS:
        if not len(best.apart):
            break
        both = np.concatenate([best.chart, chart_of(contact_map.chart.fold, best.second.xi)])
        noise = width * rng.standard_normal(both.shape) * [1.0, np.pi, 1.0]
        # Differences of good pairs point along thin sets of them, which noise alone would miss.
        step = both[rng.permutation(len(both))] - both[rng.permutation(len(both))]
        step = within_turn(step, [False, True, False])
        chart = in_chart(np.concatenate([both + noise, both + 0.7 * step + 0.03 * noise]))
        varied, _ = solve_chart(contact_map, chart, domain)
        found = twins(contact_map, names, chart, varied, domain)
        best = _select_best(concatenate([best, found]), regions, separation)
    return best


def twins_near(
    contact_map: ContactMap, names: tuple[str, ...], first: Array, second: Array, domain: Domain
) -> tuple[ContactSet, ContactSet, AnyArray]:
    """Solve for the second contact of each pair; also return whether it is a twin."""
    chart = contact_map.chart
    values, _ = solve_forces(chart.discretization, with_normal_force(first))
    one = contact_set(contact_map, first, values, domain)
    second, values, misfit, _ = polish(chart, names, one.signals[:, signal_columns(names)], second)
    agrees = (misfit <= AGREEMENT) & stable(contact_map, first) & (second[:, 0] <= 1.0)
    second = np.where(agrees[:, None], second, first)
    values = np.where(agrees[:, None], values, one.values)
    agrees &= stable(contact_map, second) & _is_distinct(contact_map, names, second)
    return one, contact_set(contact_map, second, values, domain), agrees


def _select_best(pairs: Pairs, regions: tuple[str, ...], separation: float) -> Pairs:
    """The best pairs of each region, at most one from each part of the chart."""
    far = pairs.apart >= separation
    cells = np.floor(pairs.chart * [4.0, 4.0 / np.pi, 4.0] - 1e-9)
    part = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    chosen: set[int] = set()
    # Pairs that count, and candidates: far from rest, though not yet far enough apart.
    for score in (
        np.where(far, pairs.angle, -1.0),
        pairs.angle * np.minimum(pairs.apart / separation, 1.0) ** 2,
    ):
        order = np.argsort(-score, kind="stable")
        for region in regions:
            rows = order[pairs.members(region)[order]]
            _, first = np.unique(part[rows], return_index=True)
            chosen.update(rows[np.sort(first)[:_KEPT]].tolist())
    return pairs.rows(np.array(sorted(chosen), dtype=np.int64))


def sizes(values: Array, names: tuple[str, ...]) -> Array:
    """Scale of a difference of each signal (n, k): |F|, |M|, or 1 for directions."""
    force = np.linalg.norm(values[:, :3], axis=1)
    moment = np.linalg.norm(cross(values[:, 3:], values[:, :3]), axis=1)
    one = np.ones(len(values))
    scales = {"Fx": force, "FT": force, "FD": one, "Mx": moment, "MB": moment, "MD": one}
    return np.stack([scales[name] for name in names], axis=1)


def units(contact_map: ContactMap, xi: Array) -> Array:
    """Scale of a change of each unknown (n, 3): L, and the fold force at the contact."""
    force = fold_forces(contact_map.chart.fold, xi)
    return np.stack([np.ones(len(xi)), force, force], axis=1)


def stable(contact_map: ContactMap, xi: Array) -> AnyArray:
    """Whether contacts ξ (n, 3) are between rest and fold, within the map's arc lengths."""
    force = np.hypot(xi[:, 1], xi[:, 2])
    inside = (xi[:, 0] >= contact_map.chart.proximal) & (xi[:, 0] <= 1.0)
    return np.asarray(inside & (force > 0.0) & (force < units(contact_map, xi)[:, 1]))


def equations(
    discretization: Discretization, names: tuple[str, ...], xi: Array, targets: Array
) -> tuple[Array, Array, Array]:
    """T(ξ) - target (n, 3), ∂T/∂ξ (n, 3, 3) and (F, p) (n, 6)."""
    values, tangents = solve_forces(discretization, with_normal_force(xi), tangents=True)
    force, point = values[:, :3], values[:, 3:]
    away = signals_of(force, cross(point, force))[:, signal_columns(names)] - targets
    return (
        within_turn(away, circular_among(names)),
        triplet_derivatives(values, tangents, names),
        values,
    )


def correct(
    discretization: Discretization, names: tuple[str, ...], xi: Array, targets: Array, unit: Array
) -> tuple[Array, Array, Array]:
    """Move contacts the least distance to where they have given signals, by Gauss-Newton steps."""
    # Where steps diverge, or a fibre ends at rest and the scale vanishes, the misfit is infinite.
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        for _ in range(_CORRECTIONS):
            away, slope, _ = equations(discretization, names, xi, targets)
            inverse = np.linalg.pinv(slope * unit[:, None, :], rcond=_RCOND)
            xi = xi - np.einsum("nij,nj->ni", inverse, away) * unit
        away, _, values = equations(discretization, names, xi, targets)
        misfit = np.abs(away / sizes(values, names)).max(axis=1)
    return xi, values, np.where(np.isfinite(misfit), misfit, np.inf)


def signals_and_points(d: Discretization, names: tuple[str, ...], xi: Array) -> tuple[Array, Array]:
    """Named signals (n, k) and contact points (n, 3) of contacts ξ."""
    values, _ = solve_forces(d, with_normal_force(xi))
    force, point = values[:, :3], values[:, 3:]
    return signals_of(force, cross(point, force))[:, signal_columns(names)], point


def resolve_on_finer_rod(
    contact_map: ContactMap, names: tuple[str, ...], first: Array, second: Array, steps: int
) -> tuple[Array, Array]:
    """Solve for the second contact of each pair on a finer rod, with the first fixed.

    Returns both contact points (n, 2, 3), NaN where there is no such pair, and the displacement of
    the second (n,), over L.
    """
    coarse = discretize(contact_map.whisker, steps)
    finer = discretize(contact_map.whisker, FINER * steps)
    target, point = signals_and_points(finer, names, first)
    before, _ = solve_forces(coarse, with_normal_force(second))
    _, values, misfit = correct(finer, names, second, target, units(contact_map, second))
    points = np.stack([point, values[:, 3:]], axis=1)
    points[~(misfit <= AGREEMENT)] = np.nan
    return points, np.linalg.norm(points[:, 1] - before[:, 3:], axis=1)


def confirm(
    contact_map: ContactMap, names: tuple[str, ...], pairs: Pairs, steps: int, separation: float
) -> tuple[AnyArray, Array]:
    """Whether pairs are found again on a finer rod, and their cone angles there."""
    points, moved = resolve_on_finer_rod(contact_map, names, pairs.first.xi, pairs.second.xi, steps)
    apart = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    stays = (apart >= separation) & (moved <= _STEADY * apart)
    length = contact_map.chart.discretization.length
    angle = cone_angle(contact_map.whisker, points * length).min(axis=1)
    return np.asarray(stays), angle


def fibres(
    contact_map: ContactMap,
    names: tuple[str, ...],
    steps: int,
    chart: Array,
    first: ContactSet,
    others: ContactSet,
    separation: float,
    domain: Domain,
) -> Pairs:
    """Follow curves of equal triplets through contacts at which a dimension has been lost.

    A curve can have several parts: where the contact's normal passes the axis of the base, F_T is
    zero and F_D jumps by π. For contacts whose part is shorter than ``separation``, contacts of
    other parts are solved from the most similar of the contacts ``others``.
    """
    d = discretize(contact_map.whisker, steps)
    values, _ = solve_forces(d, with_normal_force(first.xi))
    first = contact_set(contact_map, first.xi, values, domain)
    targets = first.signals[:, signal_columns(names)]
    unit = units(contact_map, first.xi)
    rows, found = [], []
    alone = np.ones(len(chart), dtype=bool)
    for sense in (1.0, -1.0):
        running, xi = np.arange(len(chart)), first.xi
        direction = np.full(xi.shape, np.nan)
        for _ in range(_STRIDES):
            _, slope, _ = equations(d, names, xi, targets[running])
            direction = _null_direction(slope * unit[running, None, :], direction, sense)
            xi = xi + _STRIDE * direction * unit[running]
            xi, values, misfit = correct(d, names, xi, targets[running], unit[running])
            stays = (misfit <= AGREEMENT) & stable(contact_map, xi)
            xi, running, direction = xi[stays], running[stays], direction[stays]
            if not running.size:
                break
            rows.append(running)
            found.append(np.concatenate([xi, values[stays]], axis=1))
            apart = np.linalg.norm(values[stays, 3:] - first.values[running, 3:], axis=1)
            alone[running[apart >= separation]] = False
    running, xi = _similar(names, np.flatnonzero(alone), first, others, separation)
    xi, values, misfit = correct(d, names, xi, targets[running], units(contact_map, xi))
    stays = (misfit <= AGREEMENT) & stable(contact_map, xi)
    row = np.concatenate([*rows, running[stays]])
    both = np.concatenate([*found, np.concatenate([xi, values], axis=1)[stays]])
    second = contact_set(contact_map, both[:, :3], both[:, 3:], domain)
    apart = np.linalg.norm(second.values[:, 3:] - first.values[row, 3:], axis=1)
    return Pairs(chart[row], row, first.rows(row), second, apart)


def _similar(
    names: tuple[str, ...], rows: IntArray, first: ContactSet, others: ContactSet, separation: float
) -> tuple[IntArray, Array]:
    """Distant contacts ξ with the most similar signals, and the rows to which they belong."""
    columns = signal_columns(names)
    signals = others.signals[:, columns]
    span = np.ptp(signals, axis=0)
    weight = np.where(span > RANK, 1.0 / np.maximum(span, RANK), 0.0)
    running, xi = [], []
    for row in rows:
        away = within_turn(signals - first.signals[row, columns], circular_among(names)) * weight
        near = np.linalg.norm(others.values[:, 3:] - first.values[row, 3:], axis=1) < separation
        chosen = np.argsort(np.where(near, np.inf, np.linalg.norm(away, axis=1)))[:_SIMILAR]
        running.append(np.full(len(chosen), row))
        xi.append(others.xi[chosen])
    return np.concatenate([rows[:0], *running]), np.concatenate([first.xi[:0], *xi])


def _null_direction(slope: Array, before: Array, sense: float) -> Array:
    """Unit vectors (n, 3) along which T does not change, as close to ``before`` as possible."""
    _, singular, rows = np.linalg.svd(slope)
    null = singular <= RANK * singular[:, :1]
    null[:, 2] = True
    onto = np.einsum("nk,nki,ni->nk", null, rows, before)
    turned = np.einsum("nk,nki->ni", onto, rows)
    fresh = np.isnan(before).any(axis=1)
    turned[fresh] = sense * rows[fresh, 2]
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


# Nodes of witnesses' centrelines, and largest difference of a saved witness's signals from those of
# the whisker.
_NODES = 101
_AGREE = 1e-6
_NEEDED = {"witness_arc_length", "witness_contact_force", "witness_separation"}


def witness_pairs(
    whisker: Whisker, verdicts: xr.Dataset, triplets: Iterable[str]
) -> Iterator[tuple[str, xr.Dataset]]:
    """Deflect a whisker into the most distant pair of contacts with the same signals.

    Parameters
    ----------
    whisker : Whisker
        Whisker to which the verdicts belong.
    verdicts : xarray.Dataset
        Verdicts with witnesses, from `uniqueness`.
    triplets : iterable of str
        Names of triplets; those without a witness are omitted.

    Yields
    ------
    str
        Name of the triplet.
    xarray.Dataset
        Dims pair, node, space: ``rest`` and ``centerline`` of both whiskers, ``contact_point``,
        ``force``, ``arc_length`` and the six signals.

    Raises
    ------
    ValueError
        If the verdicts belong to another whisker.
    """
    if not set(verdicts.data_vars) >= _NEEDED:
        return
    known = set(map(str, verdicts["triplet"].values))
    for triplet in dict.fromkeys(triplets):
        if triplet not in known:
            continue
        found = verdicts.sel(triplet=triplet)
        if "all" in found["region"].values:
            found = found.sel(region=["all"])
        apart = found["witness_separation"].transpose("region", "witness").values
        if np.isfinite(apart).any():
            region, witness = np.unravel_index(np.nanargmax(apart), apart.shape)
            yield (
                triplet,
                _bend_witness(whisker, found.isel(region=int(region), witness=int(witness))),
            )


def _bend_witness(whisker: Whisker, witness: xr.Dataset) -> xr.Dataset:
    """Dataset of the two deflected whiskers of one witness."""
    force = witness["witness_contact_force"].transpose("pair", "component").values
    components = np.column_stack([np.zeros(2), force])
    load = PointForce(witness["witness_arc_length"].values, components=components)
    bent = deflect(whisker, load, steps=int(witness.get("witness_steps", STEPS)))
    signals = base_signals(bent.force, bent.moment)
    triplet = str(witness["triplet"].item())
    if "witness_signals" in witness:
        _check_whisker(bent, signals, triplet, witness["witness_signals"].values)
    data = xr.Dataset(
        {
            "rest": (("node", "space"), whisker.centerline(_NODES)),
            "centerline": (("pair", "node", "space"), bent.centerline(_NODES)),
            "contact_point": (("pair", "space"), bent.contact_point),
            "force": (("pair", "space"), bent.force),
            "arc_length": ("pair", bent.arc_length),
        },
        attrs={"triplet": triplet},
    )
    return data.assign({name: ("pair", values.values) for name, values in signals.items()})


def _check_whisker(
    bent: Deflection, signals: xr.Dataset, triplet: str, saved: NDArray[np.float64]
) -> None:
    """Raise a ValueError unless the first contact's signals are those saved with the verdicts."""
    names = triplet.split()
    here = np.array([signals[name].values[0] for name in names])
    force, moment = (float(np.linalg.norm(v[0])) for v in (bent.force, bent.moment))
    sizes = {"Fx": force, "FT": force, "Mx": moment, "MB": moment}
    gap = [
        abs(a - b) / sizes[name] if name in sizes else abs(np.angle(np.exp(1j * (a - b))))
        for name, a, b in zip(names, here, saved, strict=True)
    ]
    if not np.max(gap) < _AGREE:  # also if NaN: the whisker has no such contact
        raise ValueError(
            f"the verdicts are not of this map's whisker: for ({triplet}) the first contact of a "
            f"witness has the signals {here} here, and {saved} where the verdicts were made"
        )
