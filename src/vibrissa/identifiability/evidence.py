"""Evidence on one triplet of signals, on which its verdicts rest.

Samples spread over Ω are inverted exactly, which finds all twins of each; an evolution from the
best of them looks for twins farther from rest. The *critical cone* of a region is the smallest cone
about the resting whisker that all pairs of twins touch. Local evidence is the sign of det ∂T/∂p,
which changes where the map from contacts to the triplet folds. The resolution, how finely signals
must be measured, comes from inverting signals moved by a tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vibrissa.contacts import ContactMap, Domain, deficient, invert
from vibrissa.identifiability.summits import farthest_twins
from vibrissa.identifiability.twins import (
    ContactSet,
    Pairs,
    Samples,
    Search,
    better_twins,
    confirmed,
    contact_set,
    fibres,
    in_chart,
    joined,
    sample,
    signal_columns,
    spread,
    twins,
)
from vibrissa.numerics import AnyArray, Array
from vibrissa.signals import CIRCULAR
from vibrissa.whisker import Whisker

UNIQUE, OFF_SURFACE, NOT_UNIQUE, EMPTY = (
    "unique",
    "unique off a surface",
    "not unique",
    "no contacts",
)
#: Number of witnesses kept of each triplet and region.
WITNESSES = 3
#: Shares of each signal's range within which signals count as equal.
TOLERANCES = (1e-6, 1e-4, 1e-3, 1e-2)
_WIDER = 8  # samples in which folds are looked for, per sample that is inverted: they cost little
_AGAIN = 4  # further searches of regions without witnesses
# Samples that are the same for every seed: those that are inverted, and those in which folds are
# looked for; and contacts of each region beyond a fold, the farthest from rest, that are inverted.
_FIXED, _FIXED_WIDE = 2048, 32768
_BEYOND = 48
# Pairs found again on a finer rod at a time, and how many times at most.
_CONFIRMED = 24
_ROUNDS = 20
_RARE = 2048  # contacts whose sign of det ∂T/∂p is the rarer, of regions without witnesses
_PROBED = 512  # samples that the resolution is probed at
# Contacts of each region from which fibres are followed, and at which folds are searched.
_FOLLOWED = 24
_NEAR_FOLDS = 24
_IN_PLANE = 256  # contacts in the plane of a planar whisker that are tried
# Contacts near the plane in which any whisker begins, the same for every seed, with the largest
# bearing from it, rad; and signals of which two lose a dimension in the plane of a planar one.
_NEAR_PLANE, _BEARING = 256, 0.2
_COLLAPSING = frozenset({"Mx", "FD", "MD"})
# A whisker is planar if it leaves its plane by no more than this share of its length.
_PLANAR = 1e-9
# The corners of the box of a tolerance and the middles of its faces.
_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
_MOVES = (_CORNERS[::7], _CORNERS[1:7], np.concatenate([np.eye(3), -np.eye(3)]))


class Local(NamedTuple):
    """Local evidence, region by region.

    minority (regions,): share of the volume in which the determinant has the rarer sign; one_sided
    (regions,): the same with the two sides of the whisker's plane separated; angle (regions, 2):
    least and largest cone angle of contacts with the rarer sign of their side, rad; near_folds:
    samples near folds; rarer (regions, wide samples): whether the sign is the rarer one there.
    """

    minority: Array
    one_sided: Array
    angle: Array
    near_folds: AnyArray
    rarer: AnyArray


@dataclass(frozen=True)
class Question:
    """What is asked of every triplet, with the samples that answer it."""

    contact_map: ContactMap
    regions: tuple[str, ...]
    separation: float
    cone: float
    domain: Domain
    samples: Samples
    fixed: Samples
    near_plane: Samples
    wide: Samples
    span: Array
    probed: AnyArray
    plane: Samples | None
    normal: Array
    seed: int

    def volumes(self) -> Array:
        """Share of the contact points' space, outside the cone, that each region takes."""
        contacts, volume = self.samples.contacts, self.samples.volume
        outside = volume * (contacts.inside & (contacts.angle > self.cone))
        parts = [float((outside * contacts.members(r)).sum()) for r in self.regions]
        return np.array(parts) / max(float(outside.sum()), np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Answer:
    """Evidence on one triplet, region by region.

    variables: arrays (regions, ...) by their names in the dataset; witnesses: pairs of contacts,
    with the integration steps with which they agree.
    """

    variables: dict[str, AnyArray]
    witnesses: list[Pairs]
    steps: list[int]


def ask(
    contact_map: ContactMap,
    regions: tuple[str, ...],
    separation: float,
    cone: float,
    domain: Domain,
    number: int,
    seed: int,
) -> Question:
    """Spread samples over Ω and find what all triplets share."""
    wide = sample(contact_map, spread(_WIDER * number, seed), domain)
    samples = wide.rows(slice(len(wide.chart) // _WIDER))
    signals = samples.contacts.signals
    span = np.ptp(signals, axis=0)
    span[list(CIRCULAR)] = 2.0 * np.pi
    probed = np.flatnonzero(samples.contacts.inside & (samples.contacts.angle > cone))[:_PROBED]
    normal, bearing = _plane(contact_map.whisker)
    plane = None
    if bearing is not None:
        chart = spread(_IN_PLANE, seed)
        chart[:, 1] = bearing + np.where(chart[:, 1] < np.pi, 0.0, np.pi)
        plane = sample(contact_map, chart, domain)
    return Question(
        contact_map,
        regions,
        separation,
        cone,
        domain,
        samples,
        sample(contact_map, spread(min(_FIXED_WIDE, _WIDER * number), None), domain),
        sample(contact_map, _near_plane(min(_NEAR_PLANE, number)), domain),
        wide,
        span,
        probed,
        plane,
        normal,
        seed,
    )


def _plane(whisker: Whisker) -> tuple[Array, float | None]:
    """Normal of the plane of a whisker, and the bearing of forces in it.

    The normal is z, and there is no bearing, if the whisker is not planar.
    """
    line = whisker.centerline(101)
    normal = np.array([0.0, 0.0, 1.0])
    if not whisker.is_straight:
        found = np.linalg.svd(line)[2][2]
        if np.abs(line @ found).max() <= _PLANAR * whisker.length:
            normal = found if found[2] >= 0.0 else -found
    if np.abs(line @ normal).max() > _PLANAR * whisker.length:
        return normal, None
    across = np.cross(normal, [1.0, 0.0, 0.0])
    return normal, float(np.arctan2(across[2], across[1]))


def _near_plane(number: int) -> Array:
    """Chart coordinates (n, 3) near the plane in which the whisker begins.

    There triplets of a whisker that leaves it little nearly collapse, and have twins far apart.
    """
    chart = spread(number, None)
    side, turn = np.divmod(chart[:, 1], np.pi)
    chart[:, 1] = np.pi * side + _BEARING * (2.0 * turn / np.pi - 1.0) ** 3  # densest in it
    return in_chart(chart)


class _Cell(NamedTuple):
    """A verdict, its critical cone, witnesses, and the steps with which these agree."""

    verdict: str
    critical_cone: float
    witnesses: Pairs
    steps: int


def answer(question: Question, names: tuple[str, ...], resolution: bool) -> Answer:
    """All evidence on one triplet."""
    samples, span = question.samples, question.span[signal_columns(names)]
    lost = deficient(question.contact_map, names, samples.contacts.xi[:_PROBED], span)
    local = (
        _nothing_local(question, question.wide)
        if lost is not None
        else _local(question, names, question.wide)
    )
    on_surface: tuple[Pairs, int] | None = None
    if lost is not None:
        tried = _some(question, samples.contacts)
        followed = np.union1d(tried, _farthest(question, samples.contacts))
        start = samples.rows(followed)
        pool = fibres(
            question.contact_map, names, lost, start.chart, start.contacts, question.domain
        )
        own = pool._replace(sample=followed[pool.sample])
    else:
        tried = np.arange(len(samples.chart))
        outside = np.flatnonzero(samples.contacts.inside & (samples.contacts.angle > question.cone))
        own = _twins_of(question, names, samples.rows(outside))
        own = own._replace(sample=outside[own.sample])
        pool = _searched(question, names, own, local)
        on_surface = _on_plane(question, names, span)
    own, pool = (p.rows(p.apart >= question.separation) for p in (own, pool))
    twin = _twinned(question, own)
    steps = lost or question.contact_map.steps
    cells = [
        _judge(question, names, pool, steps, on_surface, region) for region in question.regions
    ]
    verdict = [cell.verdict for cell in cells]
    # What a finer rod does not confirm was not a twin.
    twin[[word != NOT_UNIQUE for word in verdict]] = False
    probed, hit = tried, twin[None, :, tried]
    if resolution and lost is None:
        probed = question.probed
        hit = _ambiguous(question, names, samples.contacts.rows(probed), twin[:, probed], span)
    variables = {
        "verdict": np.array(verdict),
        "critical_cone": np.array([cell.critical_cone for cell in cells]),
        "minority_share": local.minority,
        "minority_share_one_side": local.one_sided,
        "fold_angle": local.angle,
        "twin_share": _weighted(question, twin[:, tried], tried),
        "twin_distance": _distances(question, own, verdict),
    }
    if resolution:
        shares, elevation = _shares(question, hit, probed, verdict)
        variables |= {"ambiguous_share": shares.T, "surface_angle": elevation.T}
    return Answer(variables, [cell.witnesses for cell in cells], [cell.steps for cell in cells])


def _searched(question: Question, names: tuple[str, ...], own: Pairs, local: Local) -> Pairs:
    """Better twins than those of the samples, from these and from contacts near folds.

    Regions that seem to have none outside the cone are searched several times. Where the sign of
    det ∂T/∂p is the rarer, a contact has a twin, though that may be in another region.
    """
    wide = question.wide
    pool = joined([own, _twins_of(question, names, wide.rows(local.near_folds))])
    without = _without_witness(question, pool, question.regions)
    rare = wide.contacts.angle > question.cone
    rare &= np.any([local.rarer[question.regions.index(r)] for r in without], axis=0)
    pool = joined([pool, _twins_of(question, names, wide.rows(np.flatnonzero(rare)[:_RARE]))])
    search = Search(question.contact_map, names, question.separation, question.domain)
    # Climbs begin at the same pairs for every seed, and at its own only where these are farther.
    spread_out = _twins_of(
        question, names, question.fixed.rows(slice(min(_FIXED, len(question.samples.chart))))
    )
    better = better_twins(search, spread_out, question.regions, np.random.default_rng(0))
    fixed = [joined([spread_out, better]), _twins_beyond_folds(question, names)]
    if len(_COLLAPSING.intersection(names)) >= 2:
        fixed.append(_twins_of(question, names, question.near_plane))
    summits = farthest_twins(search, fixed, question.regions)
    reached = _farthest_angles(question, joined([*fixed, summits]), question.regions)
    beaten = _farthest_angles(question, pool, question.regions) > reached
    regions = tuple(np.array(question.regions)[beaten].tolist())
    pool = joined([pool, *fixed, summits])
    if regions:
        pool = joined([pool, farthest_twins(search, [pool], regions)])
    rng = np.random.default_rng(question.seed)
    for _ in range(_AGAIN):
        regions = _without_witness(question, pool, question.regions)
        if not regions:
            break
        found = better_twins(search, pool, regions, rng)
        pool = joined([pool, found, farthest_twins(search, [found], regions)])
    return pool


def _twins_of(question: Question, names: tuple[str, ...], start: Samples) -> Pairs:
    return twins(question.contact_map, names, start.chart, start.contacts, question.domain)


def _twins_beyond_folds(question: Question, names: tuple[str, ...]) -> Pairs:
    """Twins of contacts that are the same for every seed, near folds and beyond them."""
    local = _local(question, names, question.fixed)
    angle = question.fixed.contacts.angle
    rows = [local.near_folds]
    for rarer in local.rarer:
        there = np.flatnonzero(rarer)
        rows.append(there[np.argsort(-angle[there], kind="stable")[:_BEYOND]])
    return _twins_of(question, names, question.fixed.rows(np.unique(np.concatenate(rows))))


def _farthest_angles(question: Question, pool: Pairs, regions: tuple[str, ...]) -> Array:
    """The largest cone angle of a pair of each region, 0 where there is none."""
    angle = np.where(pool.apart >= question.separation, pool.angle, 0.0)
    return np.array([angle[pool.members(region)].max(initial=0.0) for region in regions])


def _without_witness(question: Question, pool: Pairs, regions: tuple[str, ...]) -> tuple[str, ...]:
    """Regions of which no pair is outside the cone."""
    near = _farthest_angles(question, pool, regions) <= question.cone
    return tuple(np.array(regions)[near].tolist())


def _judge(
    question: Question,
    names: tuple[str, ...],
    pool: Pairs,
    steps: int,
    on_surface: tuple[Pairs, int] | None,
    region: str,
) -> _Cell:
    """Judge a region by the pairs there are, and those on the plane."""
    nothing = pool.rows(np.flatnonzero(pool.apart < 0.0))
    contacts = question.wide.contacts
    if not (contacts.members(region) & (contacts.angle > question.cone)).any():
        return _Cell(EMPTY, 0.0, nothing, steps)
    pairs, critical = _confirmed(question, names, pool.rows(pool.members(region)), steps)
    if critical > question.cone:
        return _Cell(NOT_UNIQUE, critical, _chosen(question, pairs, WITNESSES), steps)
    if on_surface is not None:
        there, steps_there = on_surface
        pairs, found = _confirmed(question, names, there.rows(there.members(region)), steps_there)
        if found > question.cone:
            chosen = _chosen(question, pairs, WITNESSES)
            return _Cell(OFF_SURFACE, critical, chosen, steps_there)
    return _Cell(UNIQUE, critical, nothing, steps)


def _confirmed(
    question: Question, names: tuple[str, ...], pairs: Pairs, steps: int
) -> tuple[Pairs, float]:
    """The best of the pairs that a finer rod confirms, and their largest angle.

    Tried are those farthest apart and, a few at a time until some are confirmed, those farthest
    from rest.
    """
    order = np.argsort(-pairs.angle, kind="stable")
    tried = _chosen(question, pairs, _CONFIRMED)
    nothing = pairs.rows(order[:0])
    for start in range(0, _ROUNDS * _CONFIRMED, _CONFIRMED):
        tried = joined([tried, pairs.rows(order[start : start + _CONFIRMED])])
        if not len(tried.apart):
            break
        stays, angle = confirmed(question.contact_map, names, tried, steps, question.separation)
        if stays.any():
            return tried.rows(stays), float(angle[stays].max())
        tried = nothing
    return nothing, 0.0


def _some(question: Question, contacts: ContactSet) -> AnyArray:
    """A few contacts outside the cone, of every region."""
    outside = np.flatnonzero(contacts.angle > question.cone)
    return _first_of_regions(question, contacts, outside)


def _farthest(question: Question, contacts: ContactSet) -> AnyArray:
    """The contacts farthest from rest, of every region."""
    return _first_of_regions(question, contacts, np.argsort(-contacts.angle, kind="stable"))


def _first_of_regions(question: Question, contacts: ContactSet, order: AnyArray) -> AnyArray:
    chosen = [order[contacts.members(region)[order]][:_FOLLOWED] for region in question.regions]
    return np.unique(np.concatenate(chosen))


def _on_plane(question: Question, names: tuple[str, ...], span: Array) -> tuple[Pairs, int] | None:
    """Pairs in the plane of a planar whisker, if the triplet loses a dimension there."""
    if question.plane is None:
        return None
    plane = question.plane
    lost = deficient(question.contact_map, names, plane.contacts.xi, span)
    if lost is None:
        return None
    followed = np.union1d(_some(question, plane.contacts), _farthest(question, plane.contacts))
    start = plane.rows(followed)
    found = fibres(question.contact_map, names, lost, start.chart, start.contacts, question.domain)
    return found.rows(found.apart >= question.separation), lost


def _chosen(question: Question, pairs: Pairs, most: int) -> Pairs:
    """The pairs outside the cone that are farthest apart, none near another."""
    rows = np.flatnonzero(pairs.angle > question.cone)
    rows = rows[np.argsort(-pairs.apart[rows], kind="stable")]
    points = pairs.first.values[:, 3:]
    kept: list[int] = []
    for row in rows.tolist():
        away = np.linalg.norm(points[kept] - points[row], axis=1)
        if (away >= question.separation).all():
            kept.append(row)
        if len(kept) == most:
            break
    return pairs.rows(np.array(kept, dtype=np.int64))


def _twinned(question: Question, pairs: Pairs) -> AnyArray:
    """Whether each sample has an exact twin in its region, outside the cone: (regions, n)."""
    out = np.zeros((len(question.regions), len(question.samples.chart)), dtype=bool)
    for i, region in enumerate(question.regions):
        out[i, pairs.sample[pairs.members(region) & (pairs.angle > question.cone)]] = True
    return out


def _distances(question: Question, pairs: Pairs, verdict: list[str]) -> Array:
    """Median distance of twins outside the cone, region by region, m; NaN where there are none."""
    length = question.contact_map.chart.discretization.length
    out = np.full(len(question.regions), np.nan)
    for i, region in enumerate(question.regions):
        there = pairs.members(region) & (pairs.angle > question.cone)
        if verdict[i] == NOT_UNIQUE and there.any():
            out[i] = length * np.median(pairs.apart[there])
    return out


def _weighted(question: Question, hit: AnyArray, rows: AnyArray) -> Array:
    """Share of each region's volume outside the cone, (..., regions), that is hit."""
    contacts, volume = question.samples.contacts.rows(rows), question.samples.volume[rows]
    outside = contacts.angle > question.cone
    out = np.full(hit.shape[:-1], np.nan)
    for i, region in enumerate(question.regions):
        weight = volume * (contacts.members(region) & outside)
        if weight.sum() > 0.0:
            out[..., i] = (hit[..., i, :] * weight).sum(axis=-1) / weight.sum()
    return out


def _shares(
    question: Question, ambiguous: AnyArray, rows: AnyArray, verdict: list[str]
) -> tuple[Array, Array]:
    """Ambiguous shares (tolerances, regions), and their largest elevations from the surface."""
    shape = (len(TOLERANCES), len(question.regions))
    elevation = np.full(shape, np.nan)
    hit = np.broadcast_to(ambiguous, (*shape, rows.size))
    points = question.samples.contacts.values[rows, 3:]
    above = np.arcsin(np.abs(_above(points, question)) / np.linalg.norm(points, axis=1))
    for i, word in enumerate(verdict):
        if word == OFF_SURFACE:
            elevation[:, i] = (hit[:, i] * above).max(axis=1, initial=0.0)
    return _weighted(question, hit, rows), elevation


def _nothing_local(question: Question, samples: Samples) -> Local:
    n = len(question.regions)
    return Local(
        np.full(n, np.nan),
        np.full(n, np.nan),
        np.full((n, 2), np.nan),
        np.zeros(0, dtype=int),
        np.zeros((n, len(samples.chart)), dtype=bool),
    )


def _local(question: Question, names: tuple[str, ...], samples: Samples) -> Local:
    """Where det ∂T/∂p changes its sign among samples.

    Where T collapses on the plane of a planar whisker, the sign may change there although T does
    not fold: with M_x and M_D, for example, both of which change sign with z. So the two sides of
    the plane are also taken separately.
    """
    out, contacts, volume = _nothing_local(question, samples), samples.contacts, samples.volume
    # How nearly the gradients lie in a plane. det ∂p/∂ξ > 0 in Ω.
    det = np.linalg.det(samples.gradients[:, signal_columns(names)])
    above = _above(contacts.values[:, 3:], question) > 0.0
    outside = contacts.angle > question.cone
    near: set[int] = set()
    for i, region in enumerate(question.regions):
        inside = contacts.members(region) & outside
        total = volume[inside].sum()
        if total == 0.0:
            continue
        out.minority[i] = volume[_rarer(det, inside, volume)[0]].sum() / total
        rare = np.zeros(len(det), dtype=bool)
        for side in (inside & above, inside & ~above):
            rarer, common = _rarer(det, side, volume)
            rare |= rarer
            rows = np.flatnonzero(side)
            near.update(rows[np.argsort(common * det[rows])[: _NEAR_FOLDS // 2]].tolist())
        out.rarer[i] = rare
        out.one_sided[i] = volume[rare].sum() / total
        if rare.any():
            out.angle[i] = contacts.angle[rare].min(), contacts.angle[rare].max()
    return out._replace(near_folds=np.array(sorted(near), dtype=np.int64))


def _above(points: Array, question: Question) -> Array:
    """Distances (n,) of points from the whisker's plane.

    BLAS would share out the product, and its idle threads go on taking the kernels' time.
    """
    return np.asarray((points * question.normal).sum(axis=1))


def _rarer(det: Array, inside: AnyArray, volume: Array) -> tuple[AnyArray, float]:
    """Contacts with the rarer sign, and the sign that is more common."""
    up, down = inside & (det > 0.0), inside & (det < 0.0)
    if volume[up].sum() < volume[down].sum():
        return up, -1.0
    return down, 1.0


def _ambiguous(
    question: Question, names: tuple[str, ...], own: ContactSet, twinned: AnyArray, span: Array
) -> AnyArray:
    """Whether contacts have another one, far away, with nearly the same signals.

    Signals are moved to the corners and to the middles of the faces of the box of each tolerance,
    and inverted there: (tolerances, regions, n).
    """
    contact_map = question.contact_map
    signals = own.signals[:, signal_columns(names)]
    belongs = np.stack([own.members(region) for region in question.regions])
    out = np.zeros((len(TOLERANCES), *twinned.shape), dtype=bool)
    active = np.flatnonzero((belongs & ~twinned).any(axis=0))
    # From the widest on: contacts separated by a tolerance are separated by a narrower one too.
    for t in reversed(range(len(TOLERANCES))):
        if not active.size:
            break
        for moves in _MOVES:
            asked = active[(belongs & ~twinned & ~out[t])[:, active].any(axis=0)]
            if not asked.size:
                break
            targets = signals[asked][:, None] + TOLERANCES[t] * span * moves
            found = invert(
                contact_map.chart, contact_map.tree(names), names, targets.reshape(-1, 3)
            )
            points = found.values[:, :, 3:].reshape(asked.size, -1, 3)
            away = np.linalg.norm(points - own.values[asked, None, 3:], axis=2)
            i, j = np.nonzero(away >= question.separation)
            other = contact_set(
                contact_map,
                found.contacts.reshape(asked.size, -1, 3)[i, j],
                found.values.reshape(asked.size, -1, 6)[i, j],
                question.domain,
            )
            for k, region in enumerate(question.regions):
                hit = other.members(region) & (other.angle > question.cone)
                out[t, k, asked[i[hit]]] = True
        out[t] &= belongs
        active = active[(out[t] & ~twinned)[:, active].any(axis=0)]
    return np.asarray(np.logical_or.accumulate(out | twinned, axis=0))
