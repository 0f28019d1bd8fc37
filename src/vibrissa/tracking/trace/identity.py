"""Several whiskers of one view: which line each of them has, in a frame and over all frames.

A *way* gives lines to whiskers, no two of them to one line; a whisker without a line is lost. A way
costs what its whiskers look unlike themselves, and what bases cost that have changed their order on
the face. Costs are negative logarithms of likelihoods. The sum is not one over whiskers, because of
lines that overlap and bases that swap, so that no linear assignment finds the cheapest way; a
search, cheapest first, does.

From frame to frame each whisker proposes lines. They cost the more, the farther they begin from
where the whisker is expected, and the shorter they are; the whole row may have turned and shifted
by more than was expected, at a price of its own. When all frames are known, motions other than the
row's cost too, and the cheapest succession of ways is found, forward and backward (Viterbi). A
whisker whose line might as well be another's is lost rather than guessed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import islice, pairwise, takewhile
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from vibrissa.io import Frame
from vibrissa.tracking.trace.clutter import NEAR, STILL, between_whiskers
from vibrissa.tracking.trace.curves import Curve, find_curves
from vibrissa.tracking.trace.follower import (
    ENOUGH,
    FEATURES,
    Appearance,
    Follower,
    features_of,
)
from vibrissa.tracking.trace.ridge import noise_level, traced
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.trace import STEP, Trace, even, given, overlap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Ways = NDArray[np.intp]
Way = tuple[int, ...]
"""Number of each whisker's line; −1 if it is lost."""

_POINTS = np.arange(0, 31, 5)
"""Points at the beginning of a line by which it is distinguished from others."""

_SAME = 0.5
"""Share of a line along another one from which both are one whisker."""

_LOST, _GONE, _SWAPPED = 6.0, 3.0, 6.0
"""Costs of being lost, of getting lost or being found, of two bases that clearly swap."""

_DOUBT, _DOUBT_OF_ALL = 0.6, 1.0
"""Least difference to a way that gives a whisker another line: in a frame, and in all frames."""

_APART = 8.0
"""Distance at which bases have clearly swapped, pixels."""

_SHORT = 3.0
"""Cost of a line that is hardly seen."""

_ROW_TURN, _ROW_SHIFT = 0.1, 5.0
"""Turn, rad, and shift, pixels, of the whole row in a frame that cost as much as a lost whisker."""

_UNLIKE = 3.0
"""Unlikeness above which a whisker's own line is in doubt."""

_NEAR = 40.0
"""Distance from a base within which lines begin that are searched without expectations, pixels."""

_MERGED = 0.8
"""Share of a line that lies on others from which they are not kept apart."""

_TRIED = 4
"""Number of lines that are measured for each whisker that is missing."""

_ALONG, _DIRECTION = 0.4, 10
"""Weight of a click's distance along a line, and number of points that give its direction."""

_LIKELY = 100.0
"""Score of a curve from which it is likely to be a whisker."""

_SAME_CURVE = 0.9
"""Share of a line along another one from which both are the same curve."""

_FEWEST, _POLYNOMIAL, _AHEAD = 15, 60, 150
"""Numbers of points: of a whisker's beginning, of what gives its bend, and by which it goes on."""

_LARGEST_TURN = 0.35
"""Largest turn of the row between frames beyond what was expected, rad."""

_ALIGNED = 0.7
"""Cosine of the largest angle between the directions of a line and of the expected one."""

_CLICK = 12.0
"""Distance from a click that costs as much as a lost whisker, pixels, at most half of that to the
next base."""

_ROUNDS = 3
"""Number of rounds in which the appearance of whiskers is learned."""

_SHIFT, _TURN = 4.0, 0.06
"""Standard deviations of a whisker's shift, pixels, and turn, rad, relative to the row's."""

_ROW = 3.0
"""Standard deviation of the row's motion as a whole, in units of these."""

_MOVED = 3.0
"""Standard deviations beyond which a motion counts no more: whiskers do jump."""

_KEPT, _DEARER = 48, 14.0
"""Largest number of ways of a frame, and the cost by which they may exceed the cheapest."""


@dataclass
class Seen:
    """Lines that are seen in one frame."""

    lines: list[Trace]
    features: list[Array]
    chosen: list[int]
    fixed: set[int] = field(default_factory=set)
    clear: bool = False

    def settle(self, whisker: int, trace: Trace) -> None:
        """Fix where a whisker is."""
        self.chosen[whisker] = len(self.lines)
        self.fixed.add(whisker)
        self.lines.append(trace)
        self.features.append(np.full(FEATURES, np.nan))


class Assignment:
    """Lines of a frame that are given to whiskers."""

    def __init__(self, lines: Sequence[Trace], bases: Array) -> None:
        self.clash = _clashes([trace.line for trace in lines])
        begin = np.array([trace.line[0] for trace in lines]).reshape(-1, 2)
        between = bases[:, None] - bases[None]
        size = np.maximum(np.linalg.norm(between, axis=2), 1e-9)[..., None, None]
        along = np.einsum("kjx,cdx->kjcd", between, begin[:, None] - begin[None]) / size
        # How clearly two bases have swapped, 0 to 1.
        self._swaps = _SWAPPED * np.clip(-along / _APART, 0.0, 1.0)

    def ways(
        self,
        price: Array,
        lost: Array,
        limit: float = np.inf,
        settled: frozenset[int] = frozenset(),
    ) -> Iterator[tuple[float, Way]]:
        """Costs below a limit and their ways, the cheapest first.

        A line (column of ``price``) that is twice as dear as a loss is never given. Settled
        whiskers may have lines that overlap.
        """
        order = sorted(range(len(price)), key=lambda k: k not in settled)
        options = [
            sorted(
                [(float(lost[k]), -1)]
                + [(float(price[k, c]), int(c)) for c in np.flatnonzero(price[k] < 2.0 * _LOST)]
            )
            for k in order
        ]
        # The least that the whiskers from each on cost.
        rest = np.cumsum([0.0, *(each[0][0] for each in options[::-1])])[::-1].tolist()
        heap: list[tuple[float, int, float, Way]] = [(rest[0], 0, 0.0, ())]
        while heap:
            _, depth, spent, way = heappop(heap)
            at = -depth
            if at == len(order):
                yield spent, tuple(c for _, c in sorted(zip(order, way, strict=True)))
                continue
            k = order[at]
            for cost, c in options[at]:
                total = spent + cost
                if not total + rest[at + 1] < limit:
                    break
                if c >= 0:
                    given_ = [(j, d) for j, d in zip(order, way, strict=False) if d >= 0]
                    if k not in settled and any(self.clash[c, d] for _, d in given_):
                        continue
                    total += sum(float(self._swaps[k, j, c, d]) for j, d in given_)
                bound = total + rest[at + 1]
                if bound < limit:
                    heappush(heap, (bound, depth - 1, total, (*way, c)))


def _clashes(lines: Sequence[Array]) -> Mask:
    """Which lines cannot belong to two whiskers: one runs along the other."""
    clash = np.eye(len(lines), dtype=bool)
    for a, one in enumerate(lines):
        for b, other in enumerate(lines[:a]):
            clash[a, b] = clash[b, a] = overlap(one, other) >= _SAME or overlap(other, one) >= _SAME
    return clash


# One frame.


def follow_row(
    followers: Sequence[Follower],
    frame: Frame,
    known: Mapping[int, ArrayLike],
    record: list[Seen] | None = None,
    scene: Scene | None = None,
) -> list[Trace]:
    """Find every whisker in the next frame; no two are the same."""
    noise = noise_level(frame)
    fixed = {k: given(points) for k, points in known.items()}
    free = [k for k in range(len(followers)) if k not in fixed]
    before = [follower.last for follower in followers]
    _part(followers, {k: trace.line for k, trace in fixed.items()}, frame, scene)
    own = {k: list(followers[k].along_expected(frame, noise)) for k in free}
    pool: list[Trace] = []
    if all(line is None for line in before) and free:
        chosen = clear = _begun(followers, fixed, frame, noise, scene)
    else:
        chosen = clear = _clearly(followers, own, fixed, frame)
    if len(clear) < len(free):
        own = {k: [clear[k]] if k in clear else traces for k, traces in own.items()}
        pool = _pool(followers, own, clear, fixed, frame, noise, scene)
        features = [features_of(frame, trace, followers[0].clutter) for trace in pool]
        apart = _distance_to_next(followers)
        lines = _assigned([followers[k] for k in free], pool, features, apart[free])
        chosen = {k: pool[c] for k, c in zip(free, lines, strict=True) if c >= 0}
    found = []
    for k, follower in enumerate(followers):
        if k in fixed:
            follower.restart(fixed[k])
            found.append(fixed[k])
        else:
            trace = chosen.get(k)
            found.append(follower.lose() if trace is None else follower.accept(trace))
    _carry(followers, before, found)
    seen = _seen(frame, pool, found, followers, set(fixed))
    for follower, c in zip(followers, seen.chosen, strict=True):
        if c >= 0:
            follower.remember(seen.features[c])
    if record is not None:
        record.append(seen)
    return found


def _part(
    followers: Sequence[Follower],
    lines: Mapping[int, Array],
    frame: Frame,
    scene: Scene | None,
) -> None:
    """Let nothing be measured where whiskers lie on one another, on known or expected lines."""
    every = [lines.get(k, follower.expected) for k, follower in enumerate(followers)]
    still = None if scene is None else scene.still
    near = NEAR * followers[0].options.scale
    parted = between_whiskers(every, still, (frame.shape[0], frame.shape[1]), near)
    for follower, line, clutter in zip(followers, every, parted, strict=True):
        alone = line is not None and clutter.hides(line).mean() < _MERGED
        follower.clutter = clutter if alone else clutter._replace(which=clutter.which & STILL)


def _begun(
    followers: Sequence[Follower],
    fixed: Mapping[int, Trace],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> dict[int, Trace]:
    """Whiskers in the first frame, each where it was clicked.

    Where whiskers cross, a line may go on as another one. So each is known up to there at first,
    and followed beyond as it bends until there, with what others hide left out.
    """
    options = followers[0].options
    scene = scene or Scene.of([frame], options.scale)
    free = [k for k in range(len(followers)) if k not in fixed]
    clicked = np.array([followers[k].base for k in free])
    every = [
        curve
        for curve in find_curves(frame, scene, options, begins=clicked)
        if all(overlap(curve.line, other.line) < _SAME for other in fixed.values())
    ]
    apart = _distance_to_next(followers)[free]
    price = np.array(
        [
            [_price(click, curve, half) for curve in every]
            for click, half in zip(clicked, 0.5 * apart, strict=True)
        ]
    ).reshape(len(free), len(every))
    rows, columns = linear_sum_assignment(np.minimum(price, 2.0 * _LOST))
    guesses = {
        free[i]: _up_to_a_crossing(every[c].line, [one.line for one in every])
        for i, c in zip(rows, columns, strict=True)
        if price[i, c] < 2.0 * _LOST
    }
    lines, found = guesses, dict[int, Trace]()
    given_ = {k: trace.line for k, trace in fixed.items()}
    for _ in range(_ROUNDS):
        _part(followers, {**lines, **given_}, frame, scene)
        found = {
            k: followers[k].along(frame, noise, guess, "tight") for k, guess in guesses.items()
        }
        lines = {k: trace.line for k, trace in found.items()}
    found = {k: trace for k, trace in found.items() if followers[k].long_enough(trace)}
    return _without_clashes(found, fixed)


def _price(click: Array, curve: Curve, half: float) -> float:
    """Cost of taking a curve for the whisker that was clicked."""
    away = _LOST * (_from_click(click, curve.line) / min(_CLICK, half)) ** 2
    return away + _SHORT / (1.0 + curve.score / _LIKELY)


def _up_to_a_crossing(line: Array, every: Sequence[Array]) -> Array:
    """The beginning of a line, until it meets another one, prolonged as a parabola."""
    line = even(line)
    others = [one for one in every if overlap(one, line) < _SAME_CURVE]
    if others:
        away, _ = cKDTree(np.concatenate(others)).query(line)
        met = np.flatnonzero((away < NEAR) & (np.arange(len(line)) >= _FEWEST))
        line = line[: met[0]] if met.size else line
    t = np.arange(len(line))[-_POLYNOMIAL:]
    shape = np.polynomial.polynomial.polyfit(t, line[-len(t) :], 2)
    ahead = np.arange(len(line), len(line) + _AHEAD)
    return np.concatenate([line, np.polynomial.polynomial.polyval(ahead, shape).T])


def _seen(
    frame: Frame,
    pool: Sequence[Trace],
    found: Sequence[Trace],
    followers: Sequence[Follower],
    fixed: set[int],
) -> Seen:
    """What a frame shows: lines that were considered, and who was found where."""
    lines = [trace for trace in found if len(trace.line)]
    lines += [trace for trace in pool if not any(trace.line is other.line for other in lines)]
    chosen = [
        next((c for c, trace in enumerate(lines) if trace.line is each.line), -1) for each in found
    ]
    whose = {c: followers[k].clutter for k, c in enumerate(chosen)}
    features = [
        features_of(frame, trace, whose.get(c, followers[0].clutter))
        for c, trace in enumerate(lines)
    ]
    return Seen(lines, features, chosen, fixed, clear=not pool)


def _clearly(
    followers: Sequence[Follower],
    own: Mapping[int, list[Trace]],
    fixed: Mapping[int, Trace],
    frame: Frame,
) -> dict[int, Trace]:
    """Whiskers about whose own lines there is no doubt."""
    chosen: dict[int, Trace] = {}
    for k, traces in own.items():
        follower, expected = followers[k], followers[k].expected
        if expected is None or not traces or follower.length_of(traces[-1]) < follower.wanted:
            continue
        if np.abs(sideways(expected, traces[-1].line)).mean() > 0.5 * follower.reach:
            continue
        if follower.appearance.unlikeness(features_of(frame, traces[-1], follower.clutter)) > (
            _UNLIKE
        ):
            continue
        chosen[k] = traces[-1]
    return _without_clashes(chosen, fixed)


def _without_clashes(chosen: Mapping[int, Trace], fixed: Mapping[int, Trace]) -> dict[int, Trace]:
    """Whiskers whose lines are nobody else's."""
    every = {**chosen, **fixed}
    clash = _clashes([trace.line for trace in every.values()])
    doubtful = {k for k, row in zip(every, clash, strict=True) if row.sum() > 1}
    return {k: trace for k, trace in chosen.items() if k not in doubtful}


def _pool(
    followers: Sequence[Follower],
    own: Mapping[int, list[Trace]],
    clear: Mapping[int, Trace],
    fixed: Mapping[int, Trace],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> list[Trace]:
    """Different lines that may be whiskers, the longest first."""
    proposed = [trace for traces in own.values() for trace in traces if len(trace.line)]
    options = followers[0].options
    missing = [followers[k] for k in own if k not in clear]
    taken = [trace.line for trace in (*clear.values(), *fixed.values())]
    still = None if scene is None else scene.still
    shape = (frame.shape[0], frame.shape[1])
    # For a whisker of which nothing is known yet all others are in the way.
    clutter = between_whiskers([*taken, None], still, shape, NEAR * options.scale)[-1]
    scene = scene or Scene.of([frame], options.scale)
    tried: list[Array] = [*taken]
    begins = np.array([follower.base for follower in followers])
    for curve in find_curves(frame, scene, options, begins=begins):
        if len(tried) - len(taken) >= _TRIED * len(missing):
            break
        if min(_from_click(follower.base, curve.line) for follower in missing) > _NEAR:
            continue
        if any(overlap(curve.line, other) >= _SAME for other in tried):
            continue
        tried.append(curve.line)
        proposed.append(traced(frame, noise, curve.line, options, clutter=clutter)[0])
    kept: list[Trace] = []
    for trace in sorted(proposed, key=lambda t: -t.support):
        if not len(trace.line):
            continue
        if any(overlap(trace.line, other.line) >= _SAME for other in fixed.values()):
            continue
        if not any(_one(trace, other, 4.0) for other in kept):
            kept.append(trace)
    return kept


def _from_click(click: Array, line: Array) -> float:
    """Distance of a click from the beginning of a line, pixels.

    Along the line's own direction a click may miss by more: the face hides where that begins.
    """
    ahead = line[min(_DIRECTION, len(line) - 1)] - line[0]
    ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
    away = line[0] - click
    along, across = float(away @ ahead), float(away[1] * ahead[0] - away[0] * ahead[1])
    return float(np.hypot(_ALONG * along, across))


def _distance_to_next(followers: Sequence[Follower]) -> Array:
    """Distance of each base from the nearest other one, pixels."""
    bases = np.array([follower.base for follower in followers])
    distance = np.linalg.norm(bases[:, None] - bases[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(np.maximum(distance.min(axis=1, initial=np.inf), 2.0))


def _one(trace: Trace, other: Trace, near: float = np.inf) -> bool:
    """Whether two lines begin as one, with first points so near, so that they are one whisker."""
    n = min(len(trace.line), len(other.line), 3 * int(_POINTS[-1]))
    if overlap(trace.line[:n], other.line[:n], 1.5) < 0.8:
        return False
    return float(np.linalg.norm(trace.line[0] - other.line[0])) < near


def _assigned(
    followers: Sequence[Follower], pool: Sequence[Trace], features: Sequence[Array], apart: Array
) -> Way:
    """The cheapest way, whatever the row's motion, without whiskers in doubt."""
    costs = _Costs.of(followers, pool, features, 0.5 * apart)
    problem = Assignment(pool, np.array([follower.base for follower in followers]).reshape(-1, 2))
    lost = np.full(len(followers), _LOST)
    least, best = np.inf, (0.0, 0.0, 0.0)
    for motion in costs.motions():
        cheapest = next(problem.ways(costs.after(*motion[1:]), lost, least - motion[0]), None)
        if cheapest is not None:
            least, best = cheapest[0] + motion[0], motion
    ways = problem.ways(costs.after(*best[1:]), lost, least - best[0] + _DOUBT)
    _, chosen = next(ways)
    others = [way for _, way in ways]

    def differs(c: int, d: int) -> bool:
        return c != d and (min(c, d) < 0 or not _one(pool[c], pool[d]))

    return tuple(
        -1 if any(differs(c, way[k]) for way in others) else c for k, c in enumerate(chosen)
    )


class _Costs(NamedTuple):
    """Costs of lines, by how far they begin from where each whisker is expected."""

    price: Array  # (whisker, line), what does not depend on how the row moves
    offsets: Array  # (whisker, line, point), pixels
    reach: Array  # (whisker, 1), pixels
    half: Array  # (whisker, 1), half of the distance to the next base, pixels
    seen: Mask  # (whisker,), before

    @classmethod
    def of(
        cls,
        followers: Sequence[Follower],
        pool: Sequence[Trace],
        features: Sequence[Array],
        half: Array,
    ) -> _Costs:
        shape = len(followers), len(pool)
        price, offsets = np.full(shape, np.inf), np.zeros((*shape, len(_POINTS)))
        longest = max((trace.support for trace in pool), default=1.0)
        for k, follower in enumerate(followers):
            expected = follower.expected
            for c, trace in enumerate(pool):
                if not follower.long_enough(trace):
                    continue
                if expected is None:
                    away = _from_click(follower.base, trace.line)
                    far = _LOST * (away / min(_CLICK, half[k])) ** 2
                elif _aligned(expected, trace.line) > _ALIGNED:
                    offsets[k, c], far = sideways(expected, trace.line), 0.0
                else:
                    continue
                share = min(1.0, trace.support / (follower.usual or longest))
                unlike = follower.appearance.unlikeness(features[c])
                price[k, c] = _SHORT * (1.0 - share) + unlike + far
        reach = np.array([[follower.reach] for follower in followers])
        seen = np.array([follower.expected is not None for follower in followers], dtype=bool)
        return cls(price, offsets, reach, half[:, None], seen)

    def motions(self) -> list[tuple[float, float, float]]:
        """Price, shift and turn of motions of the whole row that bring some whisker to some line.

        They are relative to what is expected; the cheapest comes first.
        """
        arms = STEP * _POINTS
        design = np.linalg.pinv(np.stack([np.ones(len(arms)), arms], axis=1))
        fits = self.offsets[np.isfinite(self.price) & self.seen[:, None]] @ design.T
        rounded = np.round(fits / [1.0, 0.02]) * [1.0, 0.02]
        both = np.concatenate([np.zeros((1, 2)), rounded, rounded * [0.0, 1.0]])
        # A row that shifts by half of its spacing might as well have shifted the other way.
        usable = (np.abs(both[:, 0]) < self.half.min()) & (np.abs(both[:, 1]) < _LARGEST_TURN)
        motions = np.unique(both[usable], axis=0)
        prices = _LOST * ((motions / [_ROW_SHIFT, _ROW_TURN]) ** 2).sum(axis=1)
        order = np.argsort(prices, kind="stable")
        return [(float(prices[i]), *motions[i].tolist()) for i in order]

    def after(self, shift: float, turn: float) -> Array:
        """Cost of each line for each whisker if the row has moved; infinite beyond its reach."""
        moved = (shift + turn * STEP * _POINTS) * self.seen[:, None, None]
        away = np.abs(self.offsets - moved)
        mean = away.mean(axis=2) / self.reach
        near = (mean <= 1.0) & (away[:, :, 0] <= self.half)
        return np.where(near, self.price + _LOST * mean**2, np.inf)


def _carry(
    followers: Sequence[Follower], before: Sequence[Array | None], found: Sequence[Trace]
) -> None:
    """Let those that are lost move as those that are found did."""
    turns, shifts = [], []
    for line, trace in zip(before, found, strict=True):
        if line is not None and len(trace.line):
            shifts.append(trace.line[0] - line[0])
            turns.append(_motion(line, trace.line)[1])
    if turns:
        for follower, trace in zip(followers, found, strict=True):
            if not len(trace.line):
                follower.carry(float(np.median(turns)), np.median(shifts, axis=0))


# All frames.


class _Step(NamedTuple):
    """The cheapest ways of a frame."""

    ways: Ways  # (way, whisker), −1 if lost
    cost: Array  # (way,)


def decided(frames: Sequence[Seen], bases: Array) -> list[list[int]]:
    """Line of each whisker in each frame."""
    problems = [Assignment(seen.lines, bases) for seen in frames]
    motions = [_motions(a.lines, b.lines) for a, b in pairwise(frames)]
    everyone = set(range(len(bases)))
    strangers = {k for k in everyone if sum(seen.chosen[k] >= 0 for seen in frames) < ENOUGH}
    settled = [everyone, *(strangers | seen.fixed for seen in frames[1:])]
    # The appearance of whiskers is learned where their identity is certain, and that depends on
    # the appearance. At first it is certain until it gets difficult.
    certain: list[tuple[Seen, Sequence[int]]] = [
        (s, s.chosen) for s in (frames[0], *takewhile(lambda s: s.clear, frames[1:]))
    ]
    chosen: list[list[int]] = []
    for _ in range(_ROUNDS):
        known = [
            Appearance.of([seen.features[way[k]] for seen, way in certain if way[k] >= 0])
            for k in sorted(everyone)
        ]
        steps = [
            _step(seen, problem, known, fixed)
            for seen, problem, fixed in zip(frames, problems, settled, strict=True)
        ]
        before, chosen = chosen, _cheapest(frames, settled, steps, motions)
        certain = list(zip(frames, chosen, strict=True))
        if chosen == before:
            break
    return chosen


def _step(seen: Seen, problem: Assignment, known: Sequence[Appearance], settled: set[int]) -> _Step:
    """The cheapest ways to give lines to whiskers in one frame."""
    price = np.array(
        [[each.unlikeness(features) for features in seen.features] for each in known]
    ).reshape(len(known), -1)
    lost = np.full(len(known), _LOST)
    price[:, [seen.chosen[k] for k in settled if seen.chosen[k] >= 0]] = np.inf
    for k in settled:
        c = seen.chosen[k]
        lost[k], price[k] = (np.inf if c >= 0 else 0.0), np.inf
        if c >= 0:
            price[k, c] = 0.0
    ways = list(islice(problem.ways(price, lost, settled=frozenset(settled)), _KEPT))
    ways = [each for each in ways if each[0] <= ways[0][0] + _DEARER]
    cost, lines = zip(*ways, strict=True)
    return _Step(np.array(lines, dtype=np.intp), np.array(cost))


def _cheapest(
    frames: Sequence[Seen],
    settled: Sequence[set[int]],
    steps: Sequence[_Step],
    motions: Sequence[Array],
) -> list[list[int]]:
    """The cheapest succession of ways, without whiskers in doubt."""
    moves = [
        _moves(motion, one.ways, other.ways)
        for motion, (one, other) in zip(motions, pairwise(steps), strict=True)
    ]
    before = [steps[0].cost]
    for step, move in zip(steps[1:], moves, strict=True):
        before.append(step.cost + (before[-1][:, None] + move).min(axis=0))
    after = [np.zeros(len(steps[-1].cost))]
    for step, move in zip(steps[:0:-1], moves[::-1], strict=True):
        after.append((move + (step.cost + after[-1])[None]).min(axis=1))
    return [
        _certain(seen, fixed, step.ways, a + b)
        for seen, fixed, step, a, b in zip(frames, settled, steps, before, after[::-1], strict=True)
    ]


def _certain(seen: Seen, fixed: set[int], ways: Ways, total: Array) -> list[int]:
    """The best way of a frame, without those for whom another line is hardly dearer."""
    best = ways[np.argmin(total)]
    way = []
    for k, c in enumerate(best):
        if c >= 0 and k not in fixed:
            differs = [
                d != c and (d < 0 or not _one(seen.lines[d], seen.lines[c]))
                for d in range(-1, len(seen.lines))
            ]
            others = total[np.array(differs, dtype=np.bool_)[ways[:, k] + 1]]
            if len(others) and others.min() < total.min() + _DOUBT_OF_ALL:
                c = -1
        way.append(int(c))
    return way


def _motions(lines: Sequence[Trace], others: Sequence[Trace]) -> Array:
    """Shift and turn from each line to each of the next frame's; NaN where there is none."""
    motion = np.full((len(lines) + 1, len(others) + 1, 2), np.nan)
    for i, trace in enumerate(lines):
        for j, other in enumerate(others):
            motion[i + 1, j + 1] = _motion(trace.line, other.line)
    return motion / [_SHIFT, _TURN]


def _moves(motion: Array, one: Ways, other: Ways) -> Array:
    """Cost of going from each way of a frame to each of the next, (way, way)."""
    moved = motion[one[:, None] + 1, other[None] + 1]
    missing: Mask = np.all(np.isnan(moved[..., 0]), axis=2)
    # The row moves as the median whisker does, and not at all where none is seen.
    row = np.nanmedian(np.where(missing[:, :, None, None], 0.0, moved), axis=2)
    away = np.minimum(np.nan_to_num(moved - row[:, :, None]) ** 2, _MOVED**2)
    gone = ((one[:, None] < 0) != (other[None] < 0)).sum(axis=2)
    whole = np.minimum((row / _ROW) ** 2, _MOVED**2)
    return np.asarray(0.5 * (away.sum(axis=(2, 3)) + whole.sum(axis=2)) + _GONE * gone)


def _motion(line: Array, other: Array) -> Array:
    """Shift, pixels, and turn, rad, from the beginning of one line to that of another."""
    offset, arms = sideways(line, other), STEP * _POINTS
    return np.array([offset[0], (offset - offset[0]) @ arms / (arms @ arms)])


def sideways(expected: Array, line: Array) -> Array:
    """How far a line is to the left (−dy, dx) of an expected one, at its first points, pixels."""
    points = np.minimum(_POINTS, min(len(expected), len(line)) - 1)
    tangent = np.gradient(expected[: _POINTS[-1] + 2], axis=0)
    size = np.linalg.norm(tangent[points], axis=1, keepdims=True)
    tangent = tangent[points] / np.maximum(size, 1e-9)
    away = line[points] - expected[points]
    return np.asarray(away[:, 1] * tangent[:, 0] - away[:, 0] * tangent[:, 1])


def _aligned(expected: Array, line: Array) -> float:
    """Cosine between the directions in which two lines begin."""
    i = min(int(_POINTS[-1]), len(expected) - 1, len(line) - 1)
    a, b = expected[i] - expected[0], line[i] - line[0]
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))
