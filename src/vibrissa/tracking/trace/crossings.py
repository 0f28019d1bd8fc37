"""Far ends of whiskers beyond their crossings in one view, decided over all frames.

Where two whiskers cross at a small angle, tracing may continue each along the other; as it follows
its own last line, it goes on doing so. In each frame two interpretations are compared: the traces,
and the traces with their far ends exchanged at the crossing. The cost of one depends on how smooth
both whiskers are and, little, on their lengths. From one frame to the next far ends move little, so
that a change of the interpretation costs more the clearer they are apart. The cheapest sequence
over all frames is found by the Viterbi algorithm.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array, Mask
from vibrissa.tracking.trace.ridge import smooth
from vibrissa.tracking.trace.trace import Trace, TraceOptions, distances

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
_ROUNDS = 3  # number of rounds over all pairs, since three whiskers may exchange their ends


class _Meeting(NamedTuple):
    """Point at which two whiskers may exchange their far ends in a frame."""

    beyond: tuple[Array, Array]  # their far parts
    exchanged: tuple[Trace, Trace]
    square: tuple[float, float]  # of the exchanged traces, as by `_square`
    gain: float  # cost of the traces minus that of the exchanged ones


def settle_crossings(
    rows: Sequence[Sequence[Trace]], fixed: Sequence[set[int]], options: TraceOptions
) -> list[list[Trace]]:
    """Traces of all whiskers of a view, with far ends as they are most probable over all frames.

    Some whiskers are fixed in some frames.
    """
    found = [list(row) for row in rows]
    changed = set(range(len(found)))
    for _ in range(_ROUNDS):
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
