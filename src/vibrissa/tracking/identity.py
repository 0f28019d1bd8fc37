"""Who is who in a row of whiskers, decided from all frames together.

In every frame some lines are seen. A *way* gives lines to whiskers, no two of them to one line;
who has none is lost. A way costs what its whiskers look unlike themselves, and what bases cost that
have changed places on the face. From frame to frame it costs what each whisker moves otherwise than
the row as a whole. The cheapest succession of ways through all frames counts, found forward and
backward (Viterbi); where another line is hardly dearer for a whisker, it is lost rather than
guessed.

Costs are minus logarithms of likelihoods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise, takewhile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.tracking.find import overlap
from vibrissa.tracking.likeness import ENOUGH, FEATURES, unlikeness, usual_look
from vibrissa.tracking.trace import STEP, Trace

Array = NDArray[np.float64]
Ways = NDArray[np.intp]

PLACES = np.arange(0, 31, 5)
"""Points at the beginning of a line by which it is told from others."""

SAME = 0.5
"""Share of a line that lies on another one if both are one whisker."""

_LOST = 6.0
_GONE = 3.0
_SWAPPED = 6.0
_DOUBT = 1.0
"""Costs: of being lost, of getting lost or being found, of two bases that clearly change places;
and by how much the best succession must be better than one that gives a whisker another line."""

_APART = 8.0
"""How far apart bases have clearly changed places, pixels."""

_ROUNDS = 3
"""How often it is learned how whiskers look."""

_SHIFT = 4.0
_TURN = 0.06
"""Standard deviations of a whisker's shift, pixels, and turn, rad, beside those of the row."""

_ROW = 3.0
"""How many times as far the row moves as a whole."""

_MOVED = 3.0
"""Standard deviations beyond which a motion counts no more: whiskers do jump."""

_KEPT = 48
_DEARER = 14.0
"""How many ways of a frame are looked at, and by how much they may be dearer than the cheapest."""


@dataclass
class Seen:
    """Lines that are seen in one frame."""

    lines: list[Trace]
    looks: list[Array]
    chosen: list[int]
    fixed: set[int] = field(default_factory=set)
    clear: bool = False

    def settle(self, whisker: int, trace: Trace) -> None:
        """Say where a whisker is."""
        self.chosen[whisker] = len(self.lines)
        self.fixed.add(whisker)
        self.lines.append(trace)
        self.looks.append(np.full(FEATURES, np.nan))


class _Frame(NamedTuple):
    ways: Ways  # (way, whisker), −1 if lost
    cost: Array  # (way,)


def decided(frames: Sequence[Seen], bases: Array) -> list[list[int]]:
    """Say which line each whisker has in each frame."""
    clashes = [_clashes(seen.lines) for seen in frames]
    motions = [_motions(a.lines, b.lines) for a, b in pairwise(frames)]
    everyone = set(range(len(bases)))
    strangers = {k for k in everyone if sum(seen.chosen[k] >= 0 for seen in frames) < ENOUGH}
    settled = [everyone, *(strangers | seen.fixed for seen in frames[1:])]
    # How whiskers look is learned of those who are who they are, and that by how they look. At
    # first they are who they are until it gets difficult.
    known = [(s, s.chosen) for s in (frames[0], *takewhile(lambda s: s.clear, frames[1:]))]
    for _ in range(_ROUNDS):
        looks = _known(known, len(bases))
        steps = [
            _ways(seen, clash, looks, bases, fixed)
            for seen, clash, fixed in zip(frames, clashes, settled, strict=True)
        ]
        chosen = _cheapest(frames, settled, steps, motions)
        known = list(zip(frames, chosen, strict=True))
    return chosen


def _known(known: Sequence[tuple[Seen, Sequence[int]]], count: int) -> list[tuple[Array, Array]]:
    """How each whisker usually looks."""
    return [
        usual_look([seen.looks[way[k]] for seen, way in known if way[k] >= 0]) for k in range(count)
    ]


def _cheapest(
    frames: Sequence[Seen],
    settled: Sequence[set[int]],
    steps: Sequence[_Frame],
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
        _sure(seen, fixed, step.ways, a + b)
        for seen, fixed, step, a, b in zip(frames, settled, steps, before, after[::-1], strict=True)
    ]


def _sure(seen: Seen, fixed: set[int], ways: Ways, total: Array) -> list[int]:
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
            if len(others) and others.min() < total.min() + _DOUBT:
                c = -1
        way.append(int(c))
    return way


def _one(line: Trace, other: Trace) -> bool:
    """Whether two lines begin as one, so that they cannot be two whiskers."""
    n = min(len(line.line), len(other.line), 3 * int(PLACES[-1]))
    return overlap(line.line[:n], other.line[:n], 1.5) >= 0.8


def _ways(
    seen: Seen,
    clash: NDArray[np.bool_],
    known: Sequence[tuple[Array, Array]],
    bases: Array,
    settled: set[int],
) -> _Frame:
    """The cheapest ways to give lines to whiskers in one frame."""
    count, lines = len(bases), seen.lines
    begin = np.array([trace.line[0] for trace in lines]).reshape(-1, 2)
    ways: list[list[int]] = [[]]
    cost = [0.0]
    taken = {seen.chosen[j] for j in settled}
    order = sorted(range(count), key=lambda k: k not in settled)
    for at, k in enumerate(order):
        if k in settled:
            options = [(seen.chosen[k], 0.0)]
        else:
            prices = [(c, unlikeness(look, *known[k])) for c, look in enumerate(seen.looks)]
            options = [(-1, _LOST)] + [
                (c, price) for c, price in prices if c not in taken and price < 2.0 * _LOST
            ]
        grown = []
        for way, spent in zip(ways, cost, strict=True):
            for c, price in options:
                if c >= 0 and k not in settled and any(d >= 0 and clash[c, d] for d in way):
                    continue
                swaps = 0.0
                for j, d in zip(order[:at], way, strict=True):
                    if c >= 0 and d >= 0:
                        swaps += _swapped(bases[k] - bases[j], begin[c] - begin[d])
                grown.append((spent + price + _SWAPPED * swaps, [*way, c]))
        grown.sort(key=lambda each: each[0])
        grown = [each for each in grown[:_KEPT] if each[0] <= grown[0][0] + _DEARER]
        cost, ways = [each[0] for each in grown], [each[1] for each in grown]
    return _Frame(np.array(ways, dtype=np.intp)[:, np.argsort(order)], np.array(cost))


def _clashes(lines: Sequence[Trace]) -> NDArray[np.bool_]:
    clash = np.eye(len(lines), dtype=bool)
    for a in range(len(lines)):
        for b in range(a):
            one, other = lines[a].line, lines[b].line
            clash[a, b] = clash[b, a] = overlap(one, other) >= SAME or overlap(other, one) >= SAME
    return clash


def _swapped(before: Array, now: Array) -> float:
    """How clearly two bases have changed places, 0 to 1."""
    along = float(before @ now) / max(float(np.linalg.norm(before)), 1e-9)
    return min(max(-along, 0.0) / _APART, 1.0)


def _motions(lines: Sequence[Trace], others: Sequence[Trace]) -> Array:
    """Shift and turn from each line to each of the next frame's; NaN where there is none."""
    motion = np.full((len(lines) + 1, len(others) + 1, 2), np.nan)
    for i, trace in enumerate(lines):
        for j, other in enumerate(others):
            motion[i + 1, j + 1] = _motion(trace.line, other.line)
    return motion / [_SHIFT, _TURN]


def _moves(motion: Array, one: Ways, other: Ways) -> Array:
    """What it costs to go from each way of a frame to each of the next, (way, way)."""
    moved = motion[one[:, None] + 1, other[None] + 1]
    row = _median(moved)
    away = np.minimum(np.nan_to_num(moved - row[:, :, None]) ** 2, _MOVED**2)
    gone = ((one[:, None] < 0) != (other[None] < 0)).sum(axis=2)
    whole = np.minimum((row / _ROW) ** 2, _MOVED**2)
    return np.asarray(0.5 * (away.sum(axis=(2, 3)) + whole.sum(axis=2)) + _GONE * gone)


def _median(moved: Array) -> Array:
    """Median over whiskers, 0 where none is seen."""
    missing: NDArray[np.bool_] = np.all(np.isnan(moved[..., 0]), axis=2)
    return np.asarray(np.nanmedian(np.where(missing[:, :, None, None], 0.0, moved), axis=2))


def _motion(line: Array, other: Array) -> Array:
    """Shift, pixels, and turn, rad, from the beginning of one line to that of another."""
    offset = sideways(line, other)
    arms = STEP * PLACES
    turn = float((offset - offset[0]) @ arms / (arms @ arms))
    return np.array([offset[0], turn])


def sideways(expected: Array, line: Array) -> Array:
    """Say how far a line is to the left (−dy, dx) of an expected one."""
    places = np.minimum(PLACES, min(len(expected), len(line)) - 1)
    tangent = np.gradient(expected[: PLACES[-1] + 2], axis=0)
    size = np.linalg.norm(tangent[places], axis=1, keepdims=True)
    tangent = tangent[places] / np.maximum(size, 1e-9)
    away = line[places] - expected[places]
    return np.asarray(away[:, 1] * tangent[:, 0] - away[:, 0] * tangent[:, 1])
