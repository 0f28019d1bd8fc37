"""Evidence on one triplet of signals, on which its verdicts rest.

Samples spread over Ω are inverted exactly, which finds all twins of each; an evolution from the
best of them looks for twins farther from rest. The *critical cone* of a region is the smallest cone
about the resting whisker that all pairs of twins touch. The resolution comes from inverting signals
moved by a tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.contacts.contact_map import Domain
from vibrissa.identifiability.confirm import confirmed
from vibrissa.identifiability.fibres import deficient, fibres
from vibrissa.identifiability.folds import Local, local_evidence
from vibrissa.identifiability.regions import Samples, sample, spread
from vibrissa.identifiability.resolution import TOLERANCES, ambiguous
from vibrissa.identifiability.twins import (
    Pairs,
    better_twins,
    joined,
    triplet_derivatives,
    twins,
)
from vibrissa.numerics import AnyArray, Array
from vibrissa.signals import CIRCULAR, SIGNALS

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap
    from vibrissa.whisker import Whisker

UNIQUE, OFF_SURFACE, NOT_UNIQUE, EMPTY = (
    "unique",
    "unique off a surface",
    "not unique",
    "no contacts",
)
#: How many witnesses of each cell are kept.
WITNESSES = 3
# So many times more the regions without witnesses are searched.
_AGAIN = 4
# So many times the samples are looked at for signs of a fold: that costs little.
_WIDER = 8
# So many pairs at a time are found again on a finer rod, and so many times.
_CONFIRMED = 24
_ROUNDS = 20
# So many of the samples tell the resolution.
_PROBED = 512
# Fibres are followed from so many contacts of each region.
_FOLLOWED = 24
# A whisker is planar if it leaves the x-y plane by no more than this share of its length.
_PLANAR = 1e-9


@dataclass(frozen=True)
class Question:
    """What is asked."""

    contact_map: ContactMap
    regions: tuple[str, ...]
    separation: float
    cone: float
    domain: Domain
    samples: Samples
    wide: Samples
    span: Array
    probed: AnyArray
    plane: Samples | None
    normal: Array
    seed: int

    def volumes(self) -> Array:
        """Share of the contact points' space, outside the cone, that each region takes."""
        places, volume = self.samples.places, self.samples.volume
        outside = volume * (places.inside & (places.angle > self.cone))
        parts = [float((outside * places.members(r)).sum()) for r in self.regions]
        return np.array(parts) / max(float(outside.sum()), np.finfo(np.float64).tiny)


@dataclass
class Answer:
    """What one triplet gives, region by region."""

    verdict: list[str]
    critical_cone: Array
    local: Local
    twin_share: Array
    ambiguous: Array
    surface_angle: Array
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
    signals = samples.places.signals
    span = np.ptp(signals, axis=0)
    span[list(CIRCULAR)] = 2.0 * np.pi
    probed = np.flatnonzero(samples.places.inside & (samples.places.angle > cone))[:_PROBED]
    normal, bearing = _plane(contact_map.whisker)
    plane = None
    if bearing is not None:
        chart = spread(256, seed)
        chart[:, 1] = bearing + np.where(chart[:, 1] < np.pi, 0.0, np.pi)
        plane = sample(contact_map, chart, domain)
    return Question(
        contact_map,
        regions,
        separation,
        cone,
        domain,
        samples,
        wide,
        span,
        probed,
        plane,
        normal,
        seed,
    )


def _plane(whisker: Whisker) -> tuple[Array, float | None]:
    """Normal of the plane to which a whisker keeps, and the bearing of forces in it.

    The normal is z, and there is no bearing, if it keeps to none.
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


class _Cell(NamedTuple):
    """A verdict, its critical cone, witnesses, and the steps with which these agree."""

    verdict: str
    critical_cone: float
    witnesses: Pairs
    steps: int


def answer(question: Question, names: tuple[str, ...], resolution: bool) -> Answer:
    """All evidence on one triplet."""
    samples, span = question.samples, question.span[[SIGNALS.index(name) for name in names]]
    by_contact = triplet_derivatives(question.wide.places.values, question.wide.tangents, names)
    lost = deficient(question.contact_map, names, samples.places.contacts[:_PROBED], span)
    local = local_evidence(
        question.wide,
        by_contact,
        question.regions,
        question.cone,
        question.normal,
        lost is not None,
    )
    on_surface = None
    if lost is not None:
        tried = _some(question, samples)
        followed = np.union1d(tried, _farthest(question, samples))
        start = samples.rows(followed)
        pool = fibres(question.contact_map, names, lost, start.chart, start.places, question.domain)
        own = pool._replace(sample=followed[pool.sample])
    else:
        tried = np.arange(len(samples.chart))
        own = twins(question.contact_map, names, samples.chart, samples.places, question.domain)
        pool = _searched(question, names, own, local.beside)
        on_surface = _on_plane(question, names, span)
    own, pool = (p.rows(p.apart >= question.separation) for p in (own, pool))
    twin = _twinned(question, own)
    steps = lost or question.contact_map.steps
    cells = [
        _judge(question, names, pool, steps, on_surface, region) for region in question.regions
    ]
    verdict = [cell.verdict for cell in cells]
    # What a finer rod does not confirm was no twin.
    twin[[word != NOT_UNIQUE for word in verdict]] = False
    probed, hit = tried, twin[None, :, tried]
    if resolution and lost is None:
        probed = question.probed
        hit = ambiguous(
            question.contact_map,
            names,
            samples.places.rows(probed),
            twin[:, probed],
            span,
            question.regions,
            question.separation,
            question.cone,
            question.domain,
        )
    shares, surface_angle = _shares(question, hit if resolution else None, probed, verdict)
    return Answer(
        verdict=verdict,
        critical_cone=np.array([cell.critical_cone for cell in cells]),
        local=local,
        twin_share=_weighted(question, twin[:, tried], tried),
        ambiguous=shares,
        surface_angle=surface_angle,
        witnesses=[cell.witnesses for cell in cells],
        steps=[cell.steps for cell in cells],
    )


def _searched(question: Question, names: tuple[str, ...], own: Pairs, beside: AnyArray) -> Pairs:
    """Better twins than those of the samples, from these and from contacts beside folds.

    Regions that seem to have none outside the cone are searched again and again.
    """
    start = question.wide.rows(beside)
    more = twins(question.contact_map, names, start.chart, start.places, question.domain)
    pool = joined([own, more])
    rng = np.random.default_rng(question.seed)
    regions = question.regions
    for _ in range(1 + _AGAIN):
        found = better_twins(
            question.contact_map, names, pool, regions, question.separation, question.domain, rng
        )
        pool = joined([pool, found])
        far = pool.apart >= question.separation
        regions = tuple(
            region
            for region in regions
            if pool.angle[far & pool.members(region)].max(initial=0.0) <= question.cone
        )
        if not regions:
            break
    return pool


def _judge(
    question: Question,
    names: tuple[str, ...],
    pool: Pairs,
    steps: int,
    on_surface: tuple[Pairs, int] | None,
    region: str,
) -> _Cell:
    """Judge a region by the pairs there are, and those on the plane."""
    nothing = pool.rows(np.zeros(0, dtype=np.int64))
    places = question.wide.places
    if not (places.members(region) & (places.angle > question.cone)).any():
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
    kept: list[Pairs] = []
    critical = 0.0
    for start in range(0, _ROUNDS * _CONFIRMED, _CONFIRMED):
        tried = joined([tried, pairs.rows(order[start : start + _CONFIRMED])])
        if not len(tried.apart):
            break
        stays, angle = confirmed(question.contact_map, names, tried, steps, question.separation)
        if stays.any():
            kept.append(tried.rows(stays))
            critical = float(angle[stays].max())
            break
        tried = tried.rows(np.zeros(0, dtype=np.int64))
    return joined(kept) if kept else pairs.rows(np.zeros(0, dtype=np.int64)), critical


def _some(question: Question, samples: Samples) -> AnyArray:
    """A few samples outside the cone, of every region."""
    outside = samples.places.angle > question.cone
    rows: set[int] = set()
    for region in question.regions:
        rows.update(np.flatnonzero(samples.places.members(region) & outside)[:_FOLLOWED].tolist())
    return np.array(sorted(rows), dtype=np.int64)


def _farthest(question: Question, samples: Samples) -> AnyArray:
    """The samples farthest from rest, of every region."""
    order = np.argsort(-samples.places.angle, kind="stable")
    rows: set[int] = set()
    for region in question.regions:
        rows.update(order[samples.places.members(region)[order]][:_FOLLOWED].tolist())
    return np.array(sorted(rows), dtype=np.int64)


def _on_plane(question: Question, names: tuple[str, ...], span: Array) -> tuple[Pairs, int] | None:
    """Pairs in the plane of a planar whisker, if the triplet loses a dimension there."""
    if question.plane is None:
        return None
    plane = question.plane
    lost = deficient(question.contact_map, names, plane.places.contacts, span)
    if lost is None:
        return None
    start = plane.rows(np.union1d(_some(question, plane), _farthest(question, plane)))
    found = fibres(question.contact_map, names, lost, start.chart, start.places, question.domain)
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


def _weighted(question: Question, hit: AnyArray, rows: AnyArray) -> Array:
    """Share of each region's volume outside the cone, (..., regions), that is hit."""
    places, volume = question.samples.places.rows(rows), question.samples.volume[rows]
    outside = places.angle > question.cone
    out = np.full(hit.shape[:-1], np.nan)
    for i, region in enumerate(question.regions):
        weight = volume * (places.members(region) & outside)
        if weight.sum() > 0.0:
            out[..., i] = (hit[..., i, :] * weight).sum(axis=-1) / weight.sum()
    return out


def _shares(
    question: Question, probed: AnyArray | None, rows: AnyArray, verdict: list[str]
) -> tuple[Array, Array]:
    """Ambiguous shares (tolerances, regions), and elevations from the surface they reach to."""
    shape = (len(TOLERANCES), len(question.regions))
    shares, elevation = np.full(shape, np.nan), np.full(shape, np.nan)
    if probed is None:
        return shares, elevation
    hit = np.broadcast_to(probed, (*shape, rows.size))
    shares = _weighted(question, hit, rows)
    points = question.samples.places.values[rows, 3:]
    above = np.arcsin(np.abs(points @ question.normal) / np.linalg.norm(points, axis=1))
    for i, word in enumerate(verdict):
        if word == OFF_SURFACE:
            elevation[:, i] = (hit[:, i] * above).max(axis=1, initial=0.0)
    return shares, elevation
