"""Evidence on whether a triplet of signals locates contacts, from which verdicts are derived.

Samples spread over Ω are inverted exactly, which finds all twins of each; an evolution that starts
from the best of them searches for twins farther from rest. The *critical cone* of a region is the
smallest cone about the resting whisker outside which there are no twins. Local evidence is the sign
of det ∂T/∂p, which changes where the map from contacts to the triplet folds. The resolution with
which signals must be measured is found by inverting signals displaced by a tolerance.
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
    concatenate,
    confirm,
    contact_set,
    fibres,
    in_chart,
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
#: Number of witnesses stored per triplet and region.
WITNESSES = 3
#: Tolerances within which signals count as equal, as shares of each signal's range.
TOLERANCES = (1e-6, 1e-4, 1e-3, 1e-2)
_WIDER = 8  # samples searched for folds, which is cheap, per sample that is inverted
_AGAIN = 4  # further searches of regions without witnesses
# Largest numbers of samples common to all seeds: those inverted, and those searched for folds; and
# number of contacts beyond a fold, the farthest from rest, inverted per region.
_FIXED, _FIXED_WIDE = 2048, 32768
_BEYOND = 48
# Number of pairs verified on a finer rod at a time, and of such rounds.
_BATCH = 24
_ROUNDS = 20
# Largest number of contacts with the rarer sign of det ∂T/∂p that are inverted for regions without
# witnesses.
_RARE = 2048
_PROBED = 512  # samples at which the resolution is evaluated
# Number of contacts per region from which fibres are followed, and near folds that are inverted.
_FOLLOWED = 24
_NEAR_FOLDS = 24
_IN_PLANE = 256  # contacts sampled in the plane of a planar whisker
# Number of contacts, common to all seeds, near the plane in which any whisker begins, and their
# largest bearing from it, rad; signals of which two lose a dimension in the plane of a planar one.
_NEAR_PLANE, _BEARING = 256, 0.2
_COLLAPSING = frozenset({"Mx", "FD", "MD"})
# Largest deviation of a planar whisker from its plane, over the length.
_PLANAR = 1e-9
# Corners of the box of a tolerance, and middles of its faces, in the order tried.
_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
_MOVES = (_CORNERS[::7], _CORNERS[1:7], np.concatenate([np.eye(3), -np.eye(3)]))


class Local(NamedTuple):
    """Local evidence by region.

    minority (regions,): share of the volume in which the determinant has the rarer sign; one_sided
    (regions,): the same with the two sides of the whisker's plane separated; angle (regions, 2):
    least and largest cone angle of contacts with the rarer sign of their side, rad; near_folds:
    indices of samples near folds; rarer (regions, wide samples): whether a sample has the rarer
    sign.
    """

    minority: Array
    one_sided: Array
    angle: Array
    near_folds: AnyArray
    rarer: AnyArray


@dataclass(frozen=True)
class Problem:
    """Setup common to all triplets: map, regions, thresholds, and samples."""

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
        """Share of the contact points' volume outside the cone that each region occupies."""
        contacts, volume = self.samples.contacts, self.samples.volume
        outside = volume * (contacts.inside & (contacts.angle > self.cone))
        parts = [float((outside * contacts.members(r)).sum()) for r in self.regions]
        return np.array(parts) / max(float(outside.sum()), np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Evidence:
    """Evidence on one triplet by region.

    variables: arrays (regions, ...) by their names in the dataset; witnesses: pairs of contacts of
    each region; steps: integration steps with which they agree.
    """

    variables: dict[str, AnyArray]
    witnesses: list[Pairs]
    steps: list[int]


def prepare(
    contact_map: ContactMap,
    regions: tuple[str, ...],
    separation: float,
    cone: float,
    domain: Domain,
    number: int,
    seed: int,
) -> Problem:
    """Draw samples over Ω, and compute what is common to all triplets."""
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
    return Problem(
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
    """Normal of the plane of a whisker and bearing of forces in it; z and None if not planar."""
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

    If a whisker deviates little from this plane, triplets nearly collapse in it, and have twins
    far apart.
    """
    chart = spread(number, None)
    side, turn = np.divmod(chart[:, 1], np.pi)
    chart[:, 1] = np.pi * side + _BEARING * (2.0 * turn / np.pi - 1.0) ** 3  # densest in the plane
    return in_chart(chart)


class _Cell(NamedTuple):
    """Verdict of a region, its critical cone, witnesses, and the steps with which they agree."""

    verdict: str
    critical_cone: float
    witnesses: Pairs
    steps: int


def gather_evidence(problem: Problem, names: tuple[str, ...], resolution: bool) -> Evidence:
    """Gather all evidence on one triplet."""
    samples, span = problem.samples, problem.span[signal_columns(names)]
    lost = deficient(problem.contact_map, names, samples.contacts.xi[:_PROBED], span)
    local = (
        _empty_local(problem, problem.wide)
        if lost is not None
        else _local(problem, names, problem.wide)
    )
    on_surface: tuple[Pairs, int] | None = None
    if lost is not None:
        pool, followed, tried = _fibres(problem, names, lost, samples)
        own = pool._replace(sample=followed[pool.sample])
    else:
        tried = np.arange(len(samples.chart))
        outside = np.flatnonzero(samples.contacts.inside & (samples.contacts.angle > problem.cone))
        own = _twins_of(problem, names, samples.rows(outside))
        own = own._replace(sample=outside[own.sample])
        pool = _search_twins(problem, names, own, local)
        on_surface = _pairs_in_plane(problem, names, span)
    own, pool = (p.rows(p.apart >= problem.separation) for p in (own, pool))
    twin = _has_twin(problem, own)
    steps = lost or problem.contact_map.steps
    cells = [_judge(problem, names, pool, steps, on_surface, region) for region in problem.regions]
    verdict = [cell.verdict for cell in cells]
    # A pair that is not confirmed on a finer rod is not a pair of twins.
    twin[[word != NOT_UNIQUE for word in verdict]] = False
    probed, hit = tried, twin[None, :, tried]
    if resolution and lost is None:
        probed = problem.probed
        hit = _ambiguous(problem, names, samples.contacts.rows(probed), twin[:, probed], span)
    variables = {
        "verdict": np.array(verdict),
        "critical_cone": np.array([cell.critical_cone for cell in cells]),
        "minority_share": local.minority,
        "minority_share_one_side": local.one_sided,
        "fold_angle": local.angle,
        "twin_share": _weighted_shares(problem, twin[:, tried], tried),
        "twin_distance": _distances(problem, own, verdict),
    }
    if resolution:
        shares, elevation = _shares(problem, hit, probed, verdict)
        variables |= {"ambiguous_share": shares.T, "surface_angle": elevation.T}
    return Evidence(variables, [cell.witnesses for cell in cells], [cell.steps for cell in cells])


def _search_twins(problem: Problem, names: tuple[str, ...], own: Pairs, local: Local) -> Pairs:
    """Search for twins farther from rest, repeatedly in regions that seem to have none.

    A contact at which det ∂T/∂p has the rarer sign has a twin, perhaps in another region.
    """
    wide = problem.wide
    pool = concatenate([own, _twins_of(problem, names, wide.rows(local.near_folds))])
    without = _regions_without_witness(problem, pool, problem.regions)
    rare = wide.contacts.angle > problem.cone
    rare &= np.any([local.rarer[problem.regions.index(r)] for r in without], axis=0)
    pool = concatenate([pool, _twins_of(problem, names, wide.rows(np.flatnonzero(rare)[:_RARE]))])
    search = Search(problem.contact_map, names, problem.separation, problem.domain)
    # Climbs start at pairs common to all seeds, and at those of this seed if these are farther.
    spread_out = _twins_of(
        problem, names, problem.fixed.rows(slice(min(_FIXED, len(problem.samples.chart))))
    )
    better = better_twins(search, spread_out, problem.regions, np.random.default_rng(0))
    fixed = [concatenate([spread_out, better]), _twins_beyond_folds(problem, names)]
    if len(_COLLAPSING.intersection(names)) >= 2:
        fixed.append(_twins_of(problem, names, problem.near_plane))
    summits = farthest_twins(search, fixed, problem.regions)
    reached = _farthest_angles(problem, concatenate([*fixed, summits]), problem.regions)
    beaten = _farthest_angles(problem, pool, problem.regions) > reached
    regions = tuple(np.array(problem.regions)[beaten].tolist())
    pool = concatenate([pool, *fixed, summits])
    if regions:
        pool = concatenate([pool, farthest_twins(search, [pool], regions)])
    rng = np.random.default_rng(problem.seed)
    for _ in range(_AGAIN):
        regions = _regions_without_witness(problem, pool, problem.regions)
        if not regions:
            break
        found = better_twins(search, pool, regions, rng)
        pool = concatenate([pool, found, farthest_twins(search, [found], regions)])
    return pool


def _twins_of(problem: Problem, names: tuple[str, ...], start: Samples) -> Pairs:
    """Find the twins of samples."""
    return twins(problem.contact_map, names, start.chart, start.contacts, problem.domain)


def _twins_beyond_folds(problem: Problem, names: tuple[str, ...]) -> Pairs:
    """Twins of contacts near folds and beyond them, common to all seeds."""
    local = _local(problem, names, problem.fixed)
    angle = problem.fixed.contacts.angle
    rows = [local.near_folds]
    for rarer in local.rarer:
        there = np.flatnonzero(rarer)
        rows.append(there[np.argsort(-angle[there], kind="stable")[:_BEYOND]])
    return _twins_of(problem, names, problem.fixed.rows(np.unique(np.concatenate(rows))))


def _farthest_angles(problem: Problem, pool: Pairs, regions: tuple[str, ...]) -> Array:
    """Largest cone angle of a pair in each region, 0 if there is none."""
    angle = np.where(pool.apart >= problem.separation, pool.angle, 0.0)
    return np.array([angle[pool.members(region)].max(initial=0.0) for region in regions])


def _regions_without_witness(
    problem: Problem, pool: Pairs, regions: tuple[str, ...]
) -> tuple[str, ...]:
    """Regions without a pair outside the cone."""
    near = _farthest_angles(problem, pool, regions) <= problem.cone
    return tuple(np.array(regions)[near].tolist())


def _judge(
    problem: Problem,
    names: tuple[str, ...],
    pool: Pairs,
    steps: int,
    on_surface: tuple[Pairs, int] | None,
    region: str,
) -> _Cell:
    """Judge a region from the pairs found in general, and those in the whisker's plane."""
    nothing = pool.rows(np.flatnonzero(pool.apart < 0.0))
    contacts = problem.wide.contacts
    if not (contacts.members(region) & (contacts.angle > problem.cone)).any():
        return _Cell(EMPTY, 0.0, nothing, steps)
    pairs, critical = _confirm_on_finer_rod(problem, names, pool.rows(pool.members(region)), steps)
    if critical > problem.cone:
        return _Cell(NOT_UNIQUE, critical, _farthest_apart(problem, pairs, WITNESSES), steps)
    if on_surface is not None:
        there, steps_there = on_surface
        pairs, found = _confirm_on_finer_rod(
            problem, names, there.rows(there.members(region)), steps_there
        )
        if found > problem.cone:
            chosen = _farthest_apart(problem, pairs, WITNESSES)
            return _Cell(OFF_SURFACE, critical, chosen, steps_there)
    return _Cell(UNIQUE, critical, nothing, steps)


def _confirm_on_finer_rod(
    problem: Problem, names: tuple[str, ...], pairs: Pairs, steps: int
) -> tuple[Pairs, float]:
    """Pairs that are confirmed on a finer rod, and their largest cone angle.

    The pairs farthest apart are tried first, together with those farthest from rest, a batch at a
    time until some are confirmed.
    """
    order = np.argsort(-pairs.angle, kind="stable")
    tried = _farthest_apart(problem, pairs, _BATCH)
    nothing = pairs.rows(order[:0])
    for start in range(0, _ROUNDS * _BATCH, _BATCH):
        tried = concatenate([tried, pairs.rows(order[start : start + _BATCH])])
        if not len(tried.apart):
            break
        stays, angle = confirm(problem.contact_map, names, tried, steps, problem.separation)
        if stays.any():
            return tried.rows(stays), float(angle[stays].max())
        tried = nothing
    return nothing, 0.0


def _fibres(
    problem: Problem, names: tuple[str, ...], steps: int, samples: Samples
) -> tuple[Pairs, AnyArray, AnyArray]:
    """Pairs on the fibres through a few samples, and the indices of these.

    The samples are the first outside the cone, and those farthest from rest, of every region; last
    returned are the indices of the former.
    """
    contacts = samples.contacts
    outside, followed = (
        np.unique(np.concatenate([o[contacts.members(r)[o]][:_FOLLOWED] for r in problem.regions]))
        for o in (
            np.flatnonzero(contacts.angle > problem.cone),
            np.argsort(-contacts.angle, kind="stable"),
        )
    )
    followed = np.union1d(outside, followed)
    start = samples.rows(followed)
    found = fibres(
        problem.contact_map,
        names,
        steps,
        start.chart,
        start.contacts,
        problem.wide.contacts,
        problem.separation,
        problem.domain,
    )
    return found, followed, outside


def _pairs_in_plane(
    problem: Problem, names: tuple[str, ...], span: Array
) -> tuple[Pairs, int] | None:
    """Pairs in the plane of a planar whisker, if the triplet loses a dimension there."""
    if problem.plane is None:
        return None
    plane = problem.plane
    if (lost := deficient(problem.contact_map, names, plane.contacts.xi, span)) is None:
        return None
    found, _, _ = _fibres(problem, names, lost, plane)
    return found.rows(found.apart >= problem.separation), lost


def _farthest_apart(problem: Problem, pairs: Pairs, most: int) -> Pairs:
    """Pairs outside the cone that are farthest apart, with first contacts not close together."""
    rows = np.flatnonzero(pairs.angle > problem.cone)
    rows = rows[np.argsort(-pairs.apart[rows], kind="stable")]
    points = pairs.first.values[:, 3:]
    kept: list[int] = []
    for row in rows.tolist():
        away = np.linalg.norm(points[kept] - points[row], axis=1)
        if (away >= problem.separation).all():
            kept.append(row)
        if len(kept) == most:
            break
    return pairs.rows(np.array(kept, dtype=np.int64))


def _has_twin(problem: Problem, pairs: Pairs) -> AnyArray:
    """Whether each sample has an exact twin in its region outside the cone: (regions, n)."""
    out = np.zeros((len(problem.regions), len(problem.samples.chart)), dtype=bool)
    for i, region in enumerate(problem.regions):
        out[i, pairs.sample[pairs.members(region) & (pairs.angle > problem.cone)]] = True
    return out


def _distances(problem: Problem, pairs: Pairs, verdict: list[str]) -> Array:
    """Median distance of twins outside the cone by region, m; NaN where there are none."""
    length = problem.contact_map.chart.discretization.length
    out = np.full(len(problem.regions), np.nan)
    for i, region in enumerate(problem.regions):
        there = pairs.members(region) & (pairs.angle > problem.cone)
        if verdict[i] == NOT_UNIQUE and there.any():
            out[i] = length * np.median(pairs.apart[there])
    return out


def _weighted_shares(problem: Problem, hit: AnyArray, rows: AnyArray) -> Array:
    """Share (..., regions) of each region's volume outside the cone for which ``hit`` holds."""
    contacts, volume = problem.samples.contacts.rows(rows), problem.samples.volume[rows]
    outside = contacts.angle > problem.cone
    out = np.full(hit.shape[:-1], np.nan)
    for i, region in enumerate(problem.regions):
        weight = volume * (contacts.members(region) & outside)
        if weight.sum() > 0.0:
            out[..., i] = (hit[..., i, :] * weight).sum(axis=-1) / weight.sum()
    return out


def _shares(
    problem: Problem, ambiguous: AnyArray, rows: AnyArray, verdict: list[str]
) -> tuple[Array, Array]:
    """Ambiguous shares (tolerances, regions), and their largest elevations from the plane."""
    shape = (len(TOLERANCES), len(problem.regions))
    elevation = np.full(shape, np.nan)
    hit = np.broadcast_to(ambiguous, (*shape, rows.size))
    points = problem.samples.contacts.values[rows, 3:]
    above = np.arcsin(
        np.abs(_distance_from_plane(points, problem)) / np.linalg.norm(points, axis=1)
    )
    for i, word in enumerate(verdict):
        if word == OFF_SURFACE:
            elevation[:, i] = (hit[:, i] * above).max(axis=1, initial=0.0)
    return _weighted_shares(problem, hit, rows), elevation


def _empty_local(problem: Problem, samples: Samples) -> Local:
    """Local evidence of a triplet without a determinant."""
    n = len(problem.regions)
    return Local(
        np.full(n, np.nan),
        np.full(n, np.nan),
        np.full((n, 2), np.nan),
        np.zeros(0, dtype=int),
        np.zeros((n, len(samples.chart)), dtype=bool),
    )


def _local(problem: Problem, names: tuple[str, ...], samples: Samples) -> Local:
    """Find where det ∂T/∂p changes its sign among samples.

    Where T collapses in the plane of a planar whisker, the sign may change there although T does
    not fold: with M_x and M_D, for example, both of which change sign with z. Therefore the two
    sides of the plane are also evaluated separately.
    """
    out, contacts, volume = _empty_local(problem, samples), samples.contacts, samples.volume
    # Determinant of the unit gradients; in Ω det ∂p/∂ξ > 0.
    det = np.linalg.det(samples.gradients[:, signal_columns(names)])
    above = _distance_from_plane(contacts.values[:, 3:], problem) > 0.0
    outside = contacts.angle > problem.cone
    near: set[int] = set()
    for i, region in enumerate(problem.regions):
        inside = contacts.members(region) & outside
        total = volume[inside].sum()
        if total == 0.0:
            continue
        out.minority[i] = volume[_rarer_sign(det, inside, volume)[0]].sum() / total
        rare = np.zeros(len(det), dtype=bool)
        for side in (inside & above, inside & ~above):
            rarer, common = _rarer_sign(det, side, volume)
            rare |= rarer
            rows = np.flatnonzero(side)
            near.update(rows[np.argsort(common * det[rows])[: _NEAR_FOLDS // 2]].tolist())
        out.rarer[i] = rare
        out.one_sided[i] = volume[rare].sum() / total
        if rare.any():
            out.angle[i] = contacts.angle[rare].min(), contacts.angle[rare].max()
    return out._replace(near_folds=np.array(sorted(near), dtype=np.int64))


def _distance_from_plane(points: Array, problem: Problem) -> Array:
    """Distances (n,) from the whisker's plane, without BLAS, whose idle threads would compete."""
    return np.asarray((points * problem.normal).sum(axis=1))


def _rarer_sign(det: Array, inside: AnyArray, volume: Array) -> tuple[AnyArray, float]:
    """Contacts with the rarer sign of det, and the more common sign."""
    up, down = inside & (det > 0.0), inside & (det < 0.0)
    if volume[up].sum() < volume[down].sum():
        return up, -1.0
    return down, 1.0


def _ambiguous(
    problem: Problem, names: tuple[str, ...], own: ContactSet, twinned: AnyArray, span: Array
) -> AnyArray:
    """Whether contacts have a distant one with nearly the same signals: (tolerances, regions, n).

    Signals are displaced to the corners and the middles of the faces of the box of each tolerance,
    and inverted there.
    """
    contact_map = problem.contact_map
    signals = own.signals[:, signal_columns(names)]
    belongs = np.stack([own.members(region) for region in problem.regions])
    out = np.zeros((len(TOLERANCES), *twinned.shape), dtype=bool)
    active = np.flatnonzero((belongs & ~twinned).any(axis=0))
    # From the widest on: contacts separated at one tolerance are separated at a narrower one too.
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
            i, j = np.nonzero(away >= problem.separation)
            other = contact_set(
                contact_map,
                found.contacts.reshape(asked.size, -1, 3)[i, j],
                found.values.reshape(asked.size, -1, 6)[i, j],
                problem.domain,
            )
            for k, region in enumerate(problem.regions):
                hit = other.members(region) & (other.angle > problem.cone)
                out[t, k, asked[i[hit]]] = True
        out[t] &= belongs
        active = active[(out[t] & ~twinned)[:, active].any(axis=0)]
    return np.asarray(np.logical_or.accumulate(out | twinned, axis=0))
