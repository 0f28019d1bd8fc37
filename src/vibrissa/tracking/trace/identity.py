"""Identity of several whiskers of one view over all frames.

An *assignment* gives lines to whiskers, each line to at most one; a whisker without a line is lost.
Its cost is the unlikeness of the whiskers to their usual appearance, plus a cost for bases that
have changed their order on the face. Costs are negative log-likelihoods. Because of lines that
overlap and bases that swap, the sum does not separate over whiskers, so that no linear assignment
gives the minimum; a branch-and-bound search does.

From frame to frame lines are proposed (`vibrissa.tracking.trace.row`). When all frames are known,
motions other than the row's have a cost too, and the cheapest sequence of assignments is found
forward and backward (Viterbi). A whisker whose line could equally be another's is lost rather than
guessed.

Where two whiskers cross at a small angle, tracing may continue each along the other; as it follows
its own last line, it goes on doing so. In each frame the traces are compared with those whose far
ends are exchanged at the crossing, by how smooth both whiskers are and, little, by their lengths.
From one frame to the next far ends move little, so that a change costs more the clearer they are
apart. The cheapest sequence over all frames is again found by the Viterbi algorithm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise, takewhile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import Array, Mask, kernel
from vibrissa.tracking.trace.follower import ENOUGH, FEATURES, Appearance
from vibrissa.tracking.trace.ridge import normal, smooth
from vibrissa.tracking.trace.trace import STEP, Trace, TraceOptions, distances, overlap

# Index of each whisker's line; −1 if it is lost.
Ways = NDArray[np.intp]
# Points at the beginning of a line by which it is distinguished from others.
POINTS = np.arange(0, 31, 5)
SAME = 0.5  # share of a line along another one from which both are one whisker
# Costs of being lost, of getting lost or being found, of two bases that clearly swap.
LOST, _GONE, _SWAPPED = 6.0, 3.0, 6.0
_DOUBT = 1.0  # least difference to a succession of ways that gives a whisker another line
_APART = 8.0  # distance at which bases have clearly swapped, pixels
_ROUNDS = 3  # number of rounds in which the appearance of whiskers is learned
# Standard deviations of a whisker's shift, pixels, and turn, rad, relative to the row's.
_SHIFT, _TURN = 4.0, 0.06
_ROW = 3.0  # standard deviation of the row's motion as a whole, in units of these
_MOVED = 3.0  # standard deviations at which the cost of a motion saturates, since whiskers do jump
# Largest shift, pixels, and turn, rad, of a whisker at rest from one frame to the next.
_STAYS, _STAYS_TURN = 1.5, 0.04
# Largest number of ways of a frame, and the cost by which they may exceed the cheapest.
_KEPT, _DEARER = 48, 14.0


@dataclass
class Seen:
    """Lines seen in one frame."""

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
    """Lines of a frame to be assigned to whiskers."""

    def __init__(self, lines: Sequence[Trace], bases: Array) -> None:
        self.clash = clashes([trace.line for trace in lines])
        begin = np.array([trace.line[0] for trace in lines]).reshape(-1, 2)
        between = bases[:, None] - bases[None]
        size = np.maximum(np.linalg.norm(between, axis=2), 1e-9)[..., None, None]
        along = np.einsum("kjx,cdx->kjcd", between, begin[:, None] - begin[None]) / size
        # Degree to which two bases have swapped, 0 to 1.
        self.swaps = _SWAPPED * np.clip(-along / _APART, 0.0, 1.0)

    def ways(
        self,
        price: Array,
        lost: Array,
        limit: float = np.inf,
        settled: frozenset[int] = frozenset(),
        most: int = _KEPT,
    ) -> tuple[Array, Ways]:
        """Costs below a limit and their assignments, at most so many, the cheapest first.

        A line (column of ``price``) that costs twice as much as a loss is never assigned. Settled
        whiskers may have overlapping lines.
        """
        order = np.array(sorted(range(len(price)), key=lambda k: k not in settled), dtype=np.intp)
        options = np.concatenate([lost[:, None], np.where(price < 2.0 * LOST, price, np.inf)], 1)
        ranked = np.argsort(options, axis=1, kind="stable") - 1
        free = np.array([k not in settled for k in range(len(price))], dtype=np.bool_)
        cost, way = np.full(most, np.inf), np.empty((most, len(price)), dtype=np.intp)
        count = cheapest_ways(
            options, ranked, order, free, self.clash, self.swaps, limit, cost, way
        )
        return cost[:count], way[:count]


@kernel
def cheapest_ways(
    options: Any,
    ranked: Any,
    order: Any,
    free: Any,
    clash: Any,
    swaps: Any,
    limit: float,
    cost: Any,
    way: Any,
) -> int:
    """Cheapest assignments by depth-first branch and bound; the bound is the last one kept."""
    n, most, count = len(order), len(cost), 0
    # The smallest cost of each whisker and all later ones.
    rest = np.zeros(n + 1)
    for depth in range(n - 1, -1, -1):
        k = order[depth]
        rest[depth] = rest[depth + 1] + options[k, ranked[k, 0] + 1]
    spent, at, given = np.zeros(n + 1), np.zeros(n + 1, np.intp), np.full(n, -1, np.intp)
    depth = 0
    while depth >= 0:
        bound = limit if count < most else min(limit, cost[most - 1])
        if depth == n:
            if spent[n] < bound:
                i = min(count, most - 1)
                while i > 0 and cost[i - 1] > spent[n]:
                    cost[i], way[i] = cost[i - 1], way[i - 1]
                    i -= 1
                cost[i], way[i] = spent[n], given
                count = min(count + 1, most)
            depth -= 1
            continue
        k = order[depth]
        c = ranked[k, at[depth]] if at[depth] < ranked.shape[1] else -2
        if c == -2 or not spent[depth] + options[k, c + 1] + rest[depth + 1] < bound:
            at[depth] = 0
            depth -= 1
            continue
        at[depth] += 1
        total = spent[depth] + options[k, c + 1]
        if c >= 0:
            for j in order[:depth]:
                d = given[j]
                if d >= 0:
                    total += swaps[k, j, c, d]
                    if free[k] and clash[c, d]:
                        total = np.inf
        if total + rest[depth + 1] < bound:
            given[k] = c
            depth += 1
            spent[depth] = total
    return count


def clashes(lines: Sequence[Array]) -> Mask:
    """Whether lines cannot belong to two whiskers: one runs along the other."""
    clash = np.eye(len(lines), dtype=bool)
    for a, one in enumerate(lines):
        for b, other in enumerate(lines[:a]):
            clash[a, b] = clash[b, a] = overlap(one, other) >= SAME or overlap(other, one) >= SAME
    return clash


class Step(NamedTuple):
    """The cheapest assignments of a frame."""

    ways: Ways  # (way, whisker), −1 if lost
    cost: Array  # (way,)


def decided(frames: Sequence[Seen], bases: Array) -> list[list[int]]:
    """Line of each whisker in each frame."""
    problems = [Assignment(seen.lines, bases) for seen in frames]
    motions = [_motions(a.lines, b.lines) for a, b in pairwise(frames)]
    everyone = set(range(len(bases)))
    strangers = {k for k in everyone if sum(seen.chosen[k] >= 0 for seen in frames) < ENOUGH}
    settled = [everyone, *(strangers | seen.fixed for seen in frames[1:])]
    rest = _at_rest(frames, motions)
    settled[1 : 1 + rest] = [everyone] * rest
    # The appearance of whiskers is learned where their identity is certain, and that depends on
    # the appearance. At first it is certain until it gets difficult.
    easy = (*frames[: 1 + rest], *takewhile(lambda seen: seen.clear, frames[1 + rest :]))
    certain: list[tuple[Seen, Sequence[int]]] = [(seen, seen.chosen) for seen in easy]
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
        before, chosen = chosen, cheapest_sequence(frames, settled, steps, motions)
        certain = list(zip(frames, chosen, strict=True))
        if chosen == before:
            break
    return chosen


def _at_rest(frames: Sequence[Seen], motions: Sequence[Array]) -> int:
    """Number of frames after the first to which all whiskers that are seen have stayed in place.

    Up to there each is where it was clicked. Else a row could be renamed for one that is hidden.
    """
    for i, (one, other, motion) in enumerate(zip(frames, frames[1:], motions, strict=False)):
        both = zip(one.chosen, other.chosen, strict=True)
        moved = np.array([motion[c + 1, d + 1] for c, d in both if c >= 0]).reshape(-1, 2)
        if not (np.abs(moved * [_SHIFT, _TURN]) < [_STAYS, _STAYS_TURN]).all():
            return i
    return len(motions)


def _step(seen: Seen, problem: Assignment, known: Sequence[Appearance], settled: set[int]) -> Step:
    """The cheapest assignments of one frame."""
    features = np.array(seen.features).reshape(-1, FEATURES)
    price = np.array([each.unlikeness(features) for each in known])
    lost = np.full(len(known), LOST)
    price[:, [seen.chosen[k] for k in settled if seen.chosen[k] >= 0]] = np.inf
    for k in settled:
        c = seen.chosen[k]
        lost[k], price[k] = (np.inf if c >= 0 else 0.0), np.inf
        if c >= 0:
            price[k, c] = 0.0
    cost, ways = problem.ways(price, lost, settled=frozenset(settled))
    near = cost <= cost[0] + _DEARER
    return Step(ways[near], cost[near])


def cheapest_sequence(
    frames: Sequence[Seen],
    settled: Sequence[set[int]],
    steps: Sequence[Step],
    motions: Sequence[Array],
) -> list[list[int]]:
    """The cheapest sequence of assignments, without whiskers in doubt."""
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
    """The best assignment of a frame, without whiskers for which another line costs hardly more."""
    best = ways[np.argmin(total)]
    way = []
    for k, c in enumerate(best):
        if c >= 0 and k not in fixed:
            near = ways[total < total.min() + _DOUBT, k]
            if any(d < 0 or not same_whisker(seen.lines[d], seen.lines[c]) for d in {*near} - {c}):
                c = -1
        way.append(int(c))
    return way


def same_whisker(trace: Trace, other: Trace, near: float = np.inf) -> bool:
    """Whether two lines begin so similarly that they are one whisker."""
    n = min(len(trace.line), len(other.line), 3 * int(POINTS[-1]))
    if overlap(trace.line[:n], other.line[:n], 1.5) < 0.8:
        return False
    return float(np.linalg.norm(trace.line[0] - other.line[0])) < near


def _motions(lines: Sequence[Trace], others: Sequence[Trace]) -> Array:
    """Shift and turn from each line to each of the next frame's; NaN if undefined."""
    motion = np.full((len(lines) + 1, len(others) + 1, 2), np.nan)
    for i, trace in enumerate(lines):
        for j, other in enumerate(others):
            motion[i + 1, j + 1] = motion_between(trace.line, other.line)
    return motion / [_SHIFT, _TURN]


def _moves(motion: Array, one: Ways, other: Ways) -> Array:
    """Cost of going from each way of a frame to each of the next, (way, way)."""
    cost = np.empty((len(one), len(other)))
    costs_of_moves(motion, one, other, cost)
    return cost


@kernel
def costs_of_moves(motion: Any, one: Any, other: Any, cost: Any) -> None:
    """Cost of the row's motion, and of whiskers that move otherwise, get lost or are found."""
    steps = np.empty(one.shape[1])
    for i in range(len(one)):
        for j in range(len(other)):
            total = 0.0
            for axis in range(motion.shape[2]):
                count = 0
                for k in range(one.shape[1]):
                    step = motion[one[i, k] + 1, other[j, k] + 1, axis]
                    if math.isnan(step):
                        continue
                    at = count
                    while at > 0 and steps[at - 1] > step:
                        steps[at] = steps[at - 1]
                        at -= 1
                    steps[at] = step
                    count += 1
                if count == 0:
                    continue
                row = 0.5 * (steps[(count - 1) // 2] + steps[count // 2])
                total += 0.5 * min((row / _ROW) ** 2, _MOVED**2)
                for k in range(count):
                    total += 0.5 * min((steps[k] - row) ** 2, _MOVED**2)
            for k in range(one.shape[1]):
                if (one[i, k] < 0) != (other[j, k] < 0):
                    total += _GONE
            cost[i, j] = total


def motion_between(line: Array, other: Array) -> Array:
    """Shift, pixels, and turn, rad, from the beginning of one line to that of another."""
    offset, arms = sideways(line, other), STEP * POINTS
    return np.array([offset[0], (offset - offset[0]) @ arms / (arms @ arms)])


def sideways(expected: Array, line: Array) -> Array:
    """Distance of a line to the left (−dy, dx) of an expected one, at its first points, pixels."""
    away = np.empty(len(POINTS))
    distances_across(np.ascontiguousarray(expected), np.ascontiguousarray(line), POINTS, away)
    return away


@kernel
def distances_across(expected: Any, line: Any, points: Any, away: Any) -> None:
    """Distances of points of a line to the left of points of another one with equal index."""
    last = min(expected.shape[0], line.shape[0]) - 1
    for i in range(len(points)):
        k = min(points[i], last)
        nx, ny = normal(expected, k)
        away[i] = (line[k, 0] - expected[k, 0]) * nx + (line[k, 1] - expected[k, 1]) * ny


_NEAR = 5.0  # distance of two lines that meet, pixels
_FEWEST = 10  # smallest number of points of each line before and beyond the meeting
# Degree of the polynomials of smooth curves, distance of a whisker's points from one that is always
# there, pixels, and number of independent distances.
_DEGREE, _ROUGH, _INDEPENDENT = 4, 0.05, 6
# Standard deviation of the logarithm of a whisker's length, and the largest cost of one.
_LENGTH, _MOST = 0.15, 0.5
# Cost of an exchange in a frame, largest cost of another interpretation than before, and motion of
# far ends that counts as none, pixels.
_EXCHANGED, _CHANGED, _STILL = 0.2, 10.0, 1.0
_PASSES = 3  # number of rounds over all pairs, since three whiskers may exchange their ends


class _Meeting(NamedTuple):
    """Point at which two whiskers may exchange their far ends in a frame."""

    beyond: tuple[Array, Array]  # their far parts
    exchanged: tuple[Trace, Trace]
    square: tuple[float, float]  # of the exchanged traces, as by `_square`
    gain: float  # cost of the traces minus that of the exchanged ones


def settle_crossings(
    rows: Sequence[Sequence[Trace]], fixed: Sequence[set[int]], options: TraceOptions
) -> list[list[Trace]]:
    """Traces of all whiskers of a view, with far ends as they are most probable over all frames."""
    found = [list(row) for row in rows]
    changed = set(range(len(found)))
    for _ in range(_PASSES):
        before, changed = changed, set()
        usual = [_usual_length(row) for row in found]
        squares = [[_square(trace) for trace in row] for row in found]
        for j, k in combinations(range(len(found)), 2):
            if not {j, k} & (before | changed):
                continue
            meetings = [
                None
                if {j, k} & held
                else _meeting(one, other, sum(square), (usual[j], usual[k]), options)
                for one, other, held, *square in zip(
                    found[j], found[k], fixed, squares[j], squares[k], strict=True
                )
            ]
            if all(meeting is None or meeting.gain <= 0.0 for meeting in meetings):
                continue
            exchanged = _exchanged(found[j], found[k], meetings)
            for i, meeting in enumerate(meetings):
                if meeting is not None and exchanged[i]:
                    found[j][i], found[k][i] = meeting.exchanged
                    squares[j][i], squares[k][i] = meeting.square
                    changed |= {j, k}
        if not changed:
            break
    return found


def _usual_length(row: Sequence[Trace]) -> float:
    """Median of a whisker's numbers of points; NaN if it is never seen."""
    lengths = [len(trace.line) for trace in row if len(trace.line)]
    return float(np.median(lengths)) if lengths else np.nan


def _meeting(
    one: Trace, other: Trace, square: float, usual: tuple[float, float], options: TraceOptions
) -> _Meeting | None:
    """The best point at which far ends may be exchanged, if there is one."""
    if min(one.seen.sum(), other.seen.sum()) < 2 * _FEWEST:
        return None
    away = distances(one.line, other.line)
    near = np.flatnonzero(away < _NEAR)
    if not near.size:
        return None
    before = _unlikely(square, (len(one.line), len(other.line)), usual)
    best = None
    for stretch in np.split(near, np.flatnonzero(np.diff(near) > 1) + 1):
        a, last = int(stretch[np.argmin(away[stretch])]), int(stretch[-1])
        b, end = (int(np.argmin(np.hypot(*(other.line - one.line[n]).T))) for n in (a, last))
        end = max(b, end)
        if min(a, b, len(one.line) - last, len(other.line) - end) < _FEWEST:
            continue
        both = _joined(one, a, other, b, options), _joined(other, b, one, a, options)
        if min(trace.seen.sum() for trace in both) < 2 * _FEWEST:
            continue
        crossed = _square(both[0]), _square(both[1])
        gain = before - _unlikely(sum(crossed), (len(both[0].line), len(both[1].line)), usual)
        if best is None or gain - _EXCHANGED > best.gain:
            beyond = one.line[last:], other.line[end:]
            best = _Meeting(beyond, both, crossed, gain - _EXCHANGED)
    return best


def _joined(one: Trace, a: int, other: Trace, b: int, options: TraceOptions) -> Trace:
    """A whisker up to one of its points, and another one from there on, smoothly."""
    line, sigma, seen = (
        np.concatenate([x[:a], y[b:]])
        for x, y in ((one.line, other.line), (one.sigma, other.sigma), (one.seen, other.seen))
    )
    line = smooth(line, seen / sigma**2, options.stiffness)
    return one._replace(line=line, sigma=sigma, seen=seen, tip_seen=other.tip_seen)


def _unlikely(square: float, points: tuple[int, int], usual: tuple[float, float]) -> float:
    """Negative log-likelihood of two traces that should be smooth and as long as usual."""
    away = (np.log(n / one) / _LENGTH for n, one in zip(points, usual, strict=True))
    length = sum(min(0.5 * one**2, _MOST) for one in away)
    return float(0.5 * _INDEPENDENT * np.log(square + _ROUGH**2) + length)


def _square(trace: Trace) -> float:
    """Mean square distance of what is seen of a whisker from a smooth curve, pixels²."""
    points = trace.line[trace.seen]
    if len(points) <= _DEGREE:
        return 0.0
    basis = np.vander(np.linspace(-1.0, 1.0, len(trace.line))[trace.seen], _DEGREE + 1)
    left = points - basis @ np.linalg.solve(basis.T @ basis, basis.T @ points)
    return float((left**2).sum() / len(points))


def _exchanged(
    one: Sequence[Trace], other: Sequence[Trace], meetings: Sequence[_Meeting | None]
) -> Mask:
    """Frames in which two whiskers exchange their far ends, by the cheapest sequence."""
    # Costs of the traces (0) and of their exchange (1) up to each frame, and what came before.
    total, came = np.zeros(2), np.zeros((len(meetings), 2), dtype=np.intp)
    for i, meeting in enumerate(meetings):
        change = _change(one, other, meetings, i) if i else 0.0
        steps = total[:, None] + np.where(np.eye(2) > 0.0, max(-change, 0.0), max(change, 0.0))
        came[i], total = np.argmin(steps, axis=0), steps.min(axis=0)
        if meeting is not None:
            total[1] -= meeting.gain
        elif len(one[i].line) and len(other[i].line):
            total[1] = np.inf
    state, states = int(np.argmin(total)), []
    for before in came[::-1]:
        states.append(state)
        state = int(before[state])
    return np.array(states[::-1], dtype=bool) & [meeting is not None for meeting in meetings]


def _change(
    one: Sequence[Trace], other: Sequence[Trace], meetings: Sequence[_Meeting | None], i: int
) -> float:
    """Cost by which a change of the interpretation in a frame exceeds that of none."""
    now, then = (one[i], other[i]), (one[i - 1], other[i - 1])
    if not all(len(trace.line) for trace in (*now, *then)):
        return 0.0
    meeting, before = meetings[i], meetings[i - 1]
    if meeting is not None:
        far, whole = meeting.beyond, [trace.line for trace in then]
    elif before is not None:
        far, whole = before.beyond, [trace.line for trace in now]
    else:
        return _CHANGED
    kept = sum(float(distances(part, line).mean()) for part, line in zip(far, whole, strict=True))
    crossed = sum(
        float(distances(part, line).mean()) for part, line in zip(far, whole[::-1], strict=True)
    )
    return _CHANGED * (crossed - kept) / (crossed + kept + _STILL)
