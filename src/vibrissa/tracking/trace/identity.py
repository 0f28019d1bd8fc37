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
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise, takewhile
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import Array, Mask, kernel
from vibrissa.tracking.trace.follower import ENOUGH, FEATURES, Appearance
from vibrissa.tracking.trace.ridge import normal
from vibrissa.tracking.trace.trace import STEP, Trace, overlap

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
    """Cheapest assignments by depth-first branch and bound; the bound is the last one kept.

    Options (whisker, 1 + line) are costs of being lost and of lines, ``ranked`` the lines in their
    order, −1 for being lost.
    """
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


class _Step(NamedTuple):
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
    return _Step(ways[near], cost[near])


def _cheapest(
    frames: Sequence[Seen],
    settled: Sequence[set[int]],
    steps: Sequence[_Step],
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
    """Cost of the row's motion, and of whiskers that move otherwise, get lost or are found.

    The row moves as the median whisker does, and not at all if none is seen.
    """
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
