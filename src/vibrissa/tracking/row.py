"""Whiskers of one view told apart: who is who is decided for all of them together.

Every whisker proposes lines along which it may lie. A line costs a whisker the more, the farther
its beginning is from where the whisker is expected, and the shorter it is; no two whiskers lie on
one line; bases keep their order on the face; and a whisker that takes no line is lost, which costs
as much as a line at the limit. The whole row may have turned and shifted by more than was expected,
at a price of its own. The cheapest way to give lines to whiskers counts; a whisker whose line might
as well be another's is lost rather than guessed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.find import find_whiskers, overlap
from vibrissa.tracking.follow import Follower
from vibrissa.tracking.identity import PLACES, SAME, Seen, sideways
from vibrissa.tracking.likeness import look_of, unlikeness
from vibrissa.tracking.trace import STEP, Trace, given

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LOST = 1.0
_SHORT = 0.5
_SWAPPED = 1.0
_DOUBT = 0.1
"""Costs: of being lost, of a line that is hardly seen, of two bases that change places; and by how
much the best way must be better than one that gives a whisker another line."""

_TURN = 0.1
_SHIFT = 5.0
"""Turn, rad, and shift, pixels, of the whole row that cost as much as a lost whisker."""

_UNLIKE = 6.0
"""Unlikeness (`vibrissa.tracking.likeness`) that costs as much as a lost whisker."""

_NEAR = 40.0
"""How far from a base lines begin that are looked at without expectations, pixels."""

_LARGEST_TURN = 0.35
_ALIGNED = 0.7
"""Cosine of the largest angle between where a line begins to go and where it is expected to."""

_CLICK = 12.0
"""How far from where it is said to begin a whisker may be found at the price of a lost one, at most
half of the way to the next."""


def follow_row(
    followers: Sequence[Follower],
    frame: Frame,
    known: Mapping[int, ArrayLike],
    record: list[Seen] | None = None,
) -> list[Trace]:
    """Find every whisker in the next frame; no two are the same."""
    noise = ridge.noise_level(frame)
    fixed = {k: given(points) for k, points in known.items()}
    free = [k for k in range(len(followers)) if k not in fixed]
    own = {k: list(followers[k].along_expected(frame, noise)) for k in free}
    before = [follower.last for follower in followers]
    chosen = _clearly(followers, own, fixed, frame)
    pool: list[Trace] = []
    if chosen is None:
        apart = _apart(followers)
        pool = _pool(followers, own, fixed, frame, noise, apart)
        looks = [look_of(frame, trace) for trace in pool]
        chosen = _assigned([followers[k] for k in free], free, pool, looks, apart[free])
    found = []
    for k, follower in enumerate(followers):
        if k in fixed:
            follower.restart(fixed[k])
            found.append(fixed[k])
        else:
            trace = chosen.get(k)
            found.append(follower.lose() if trace is None else follower.accept(trace))
    _carry(followers, before, found)
    seen = _seen(frame, pool, found, set(fixed))
    for follower, c in zip(followers, seen.chosen, strict=True):
        if c >= 0:
            follower.remember(seen.looks[c])
    if record is not None:
        record.append(seen)
    return found


def _seen(frame: Frame, pool: Sequence[Trace], found: Sequence[Trace], fixed: set[int]) -> Seen:
    """What a frame shows: lines that were looked at, and who was found where."""
    lines = [trace for trace in found if len(trace.line)]
    lines += [trace for trace in pool if not any(trace.line is other.line for other in lines)]
    chosen = [
        next((c for c, trace in enumerate(lines) if trace.line is each.line), -1) for each in found
    ]
    looks = [look_of(frame, trace) for trace in lines]
    return Seen(lines, looks, chosen, fixed, clear=not pool)


def _clearly(
    followers: Sequence[Follower],
    own: Mapping[int, list[Trace]],
    fixed: Mapping[int, Trace],
    frame: Frame,
) -> dict[int, Trace] | None:
    """The whiskers' own lines if there is no doubt about any."""
    chosen: dict[int, Trace] = {}
    for k, traces in own.items():
        follower = followers[k]
        if not traces or traces[-1].support < follower.wanted:
            return None
        expected = follower.expected
        if expected is None or np.abs(sideways(expected, traces[-1].line)).mean() > (
            0.5 * follower.reach
        ):
            return None
        if unlikeness(look_of(frame, traces[-1]), *follower.usual_look) > 0.5 * _UNLIKE:
            return None
        chosen[k] = traces[-1]
    lines = [trace.line for trace in (*chosen.values(), *fixed.values())]
    for a in range(len(lines)):
        for b in range(a):
            if overlap(lines[a], lines[b]) >= SAME or overlap(lines[b], lines[a]) >= SAME:
                return None
    return chosen


def _pool(
    followers: Sequence[Follower],
    own: Mapping[int, list[Trace]],
    fixed: Mapping[int, Trace],
    frame: Frame,
    noise: float,
    apart: Array,
) -> list[Trace]:
    """Different lines that may be whiskers, the longest first."""
    proposed: list[Trace] = []
    for k, traces in own.items():
        follower = followers[k]
        proposed += traces
        if not any(trace.support >= follower.wanted for trace in traces):
            proposed += follower.along_turned(frame, noise)
            if follower.expected is None:
                proposed += follower.from_base(frame, noise, apart[k])
    bases = np.array([follower.base for follower in followers])
    for found in find_whiskers(frame, followers[0].options):
        if np.linalg.norm(bases - found.trace.line[0], axis=1).min() < _NEAR:
            proposed.append(found.trace)
    kept: list[Trace] = []
    for trace in sorted(proposed, key=lambda t: -t.support):
        if not len(trace.line):
            continue
        if any(overlap(trace.line, other.line) >= SAME for other in fixed.values()):
            continue
        if not any(_equal(trace.line, other.line) for other in kept):
            kept.append(trace)
    return kept


def _apart(followers: Sequence[Follower]) -> Array:
    """How far each base is from the nearest other one, pixels."""
    bases = np.array([follower.base for follower in followers])
    distance = np.linalg.norm(bases[:, None] - bases[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(np.maximum(distance.min(axis=1, initial=np.inf), 2.0))


def _equal(line: Array, other: Array) -> bool:
    n = min(len(line), len(other), 3 * int(PLACES[-1]))
    if overlap(line[:n], other[:n], 1.5) < 0.8:
        return False
    return float(np.linalg.norm(line[0] - other[0])) < 4.0


def _assigned(
    followers: Sequence[Follower],
    names: Sequence[int],
    pool: Sequence[Trace],
    looks: Sequence[Array],
    apart: Array,
) -> dict[int, Trace]:
    """The cheapest way to give lines to whiskers, without those in doubt."""
    costs = _Costs.of(followers, pool, looks, 0.5 * apart)
    problem = _Row(followers, pool, costs.price)
    best: list[int] = []
    least, motion = np.inf, (0.0, 0.0)
    for extra, shift, turn in costs.motions():
        total, way = problem.cheapest(costs.after(shift, turn), least - extra)
        if way:
            best, least, motion = way, total + extra, (shift, turn)
    table = costs.after(*motion)
    limit = problem.cheapest(table, np.inf)[0] + _DOUBT
    chosen = {}
    for k, c in enumerate(best):
        if c < 0:
            continue
        other = table.copy()
        other[k, c] = np.inf
        if not problem.cheapest(other, limit)[1]:
            chosen[names[k]] = pool[c]
    return chosen


def _aligned(expected: Array, line: Array) -> float:
    """Cosine between the directions in which two lines begin."""
    i = min(int(PLACES[-1]), len(expected) - 1, len(line) - 1)
    a, b = expected[i] - expected[0], line[i] - line[0]
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))


class _Costs(NamedTuple):
    """What lines cost whiskers, by how far they begin from where they are expected."""

    price: Array  # (whisker, line), what does not depend on how the row moves
    offsets: Array  # (whisker, line, place), pixels
    reach: Array  # (whisker, 1), pixels
    apart: Array  # (whisker, 1), half of the way to the next base, pixels
    seen: Mask  # (whisker,), before

    @classmethod
    def of(
        cls,
        followers: Sequence[Follower],
        pool: Sequence[Trace],
        looks: Sequence[Array],
        half: Array,
    ) -> _Costs:
        shape = len(followers), len(pool)
        price, offsets = np.full(shape, np.inf), np.zeros((*shape, len(PLACES)))
        longest = max((trace.support for trace in pool), default=1.0)
        for k, follower in enumerate(followers):
            expected = follower.expected
            for c, trace in enumerate(pool):
                if not follower.long_enough(trace):
                    continue
                share = trace.support / (follower.usual or longest)
                price[k, c] = _SHORT * (1.0 - min(1.0, share))
                price[k, c] += unlikeness(looks[c], *follower.usual_look) / _UNLIKE
                if expected is None:
                    away = float(np.linalg.norm(trace.line[0] - follower.base))
                    price[k, c] += (away / min(_CLICK, half[k])) ** 2
                elif _aligned(expected, trace.line) > _ALIGNED:
                    offsets[k, c] = sideways(expected, trace.line)
                else:
                    price[k, c] = np.inf
        reach = np.array([[follower.reach] for follower in followers])
        seen = np.array([follower.expected is not None for follower in followers])
        return cls(price, offsets, reach, half[:, None], seen)

    def motions(self) -> list[tuple[float, float, float]]:
        """Price, shift and turn of motions of the whole row that bring some whisker to some line.

        They are beside what is expected; the cheapest comes first.
        """
        arms = STEP * PLACES
        design = np.linalg.pinv(np.stack([np.ones(len(arms)), arms], axis=1))
        fits = self.offsets[np.isfinite(self.price) & self.seen[:, None]] @ design.T
        rounded = np.round(fits / [1.0, 0.02]) * [1.0, 0.02]
        both = np.concatenate([np.zeros((1, 2)), rounded, rounded * [0.0, 1.0]])
        # A row that shifts by half of its spacing might as well have shifted the other way.
        usable = (np.abs(both[:, 0]) < self.apart.min()) & (np.abs(both[:, 1]) < _LARGEST_TURN)
        motions = np.unique(both[usable], axis=0)
        prices = ((motions / [_SHIFT, _TURN]) ** 2).sum(axis=1)
        order = np.argsort(prices, kind="stable")
        return [(float(prices[i]), float(motions[i, 0]), float(motions[i, 1])) for i in order]

    def after(self, shift: float, turn: float) -> Array:
        """Cost of each line for each whisker if the row has moved; infinite beyond its reach."""
        moved = (shift + turn * STEP * PLACES) * self.seen[:, None, None]
        away = np.abs(self.offsets - moved)
        mean = away.mean(axis=2) / self.reach
        near = (mean <= 1.0) & (away[:, :, 0] <= self.apart)
        return np.where(near, self.price + mean**2, np.inf)


class _Row:
    """Ways to give lines to whiskers."""

    def __init__(self, followers: Sequence[Follower], pool: Sequence[Trace], price: Array) -> None:
        self.bases = np.array([follower.base for follower in followers])
        self.begin = np.array([trace.line[0] for trace in pool]).reshape(-1, 2)
        used = np.flatnonzero(np.isfinite(price).any(axis=0)).tolist()
        self.conflict = np.zeros((len(pool), len(pool)), dtype=bool)
        for a in used:
            for b in used:
                if a != b and overlap(pool[a].line, pool[b].line) >= SAME:
                    self.conflict[a, b] = self.conflict[b, a] = True

    def cheapest(self, costs: Array, limit: float) -> tuple[float, list[int]]:
        """Cost and line of each whisker, −1 if it is lost; no lines if it costs the limit."""
        count = len(costs)
        options = [
            [(-1, _LOST)] + [(int(c), float(row[c])) for c in np.flatnonzero(row < 2.0 * _LOST)]
            for row in costs
        ]
        for each in options:
            each.sort(key=lambda option: option[1])
        # The least that the whiskers from each on cost.
        rest = np.concatenate([np.cumsum([each[0][1] for each in options][::-1])[::-1], [0.0]])
        best: list[int] = []
        least = limit

        def go(k: int, spent: float, way: list[int]) -> None:
            nonlocal best, least
            if k == count:
                best, least = list(way), spent
                return
            for c, cost in options[k]:
                total = spent + cost
                if total + rest[k + 1] >= least:
                    return
                if c >= 0:
                    if any(d == c or (d >= 0 and self.conflict[c, d]) for d in way):
                        continue
                    total += self._swapped(k, c, way)
                    if total + rest[k + 1] >= least:
                        continue
                go(k + 1, total, [*way, c])

        go(0, 0.0, [])
        return least, best

    def _swapped(self, k: int, c: int, way: list[int]) -> float:
        """What it costs that bases change places."""
        cost = 0.0
        for j, d in enumerate(way):
            if d >= 0:
                before, now = self.bases[k] - self.bases[j], self.begin[c] - self.begin[d]
                cost += _SWAPPED * float(before @ now < 0.0)
        return cost


def _carry(
    followers: Sequence[Follower], before: Sequence[Array | None], found: Sequence[Trace]
) -> None:
    """Let those that are lost move as those that are found did."""
    turns, shifts = [], []
    for line, trace in zip(before, found, strict=True):
        if line is not None and len(trace.line):
            arms = STEP * PLACES
            offset = sideways(line, trace.line)
            shifts.append(trace.line[0] - line[0])
            turns.append(float((offset - offset[0]) @ arms / (arms @ arms)))
    if turns:
        for follower, trace in zip(followers, found, strict=True):
            if not len(trace.line):
                follower.carry(float(np.median(turns)), np.median(shifts, axis=0))
