"""Exchange of traces between whiskers of a row where both views together contradict the tracing.

Where two whiskers cross in one view, tracing may continue each along the other. The other view then
disagrees, and the whisker in space has an impossible shape. Its true shape and the path of its base
are known from other frames. In a frame in doubt, lines are therefore exchanged in each view, as a
whole or from the crossing on: the pair of lines is chosen that has the whisker's shape and base, if
it fits far better than any other pair. Otherwise the whisker is lost in that frame. So is a whisker
that was not traced in a view: of what is left, a neighbour's line fits best.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from vibrissa.cameras import Camera, triangulate
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.space.curve import merged
from vibrissa.tracking.space.rest_shape import motions
from vibrissa.tracking.trace.start import base_gap
from vibrissa.tracking.trace.trace import Trace, arc_lengths, interpolated

_SHOWN, _LONGER = 0.6, 1.15  # shortest and longest curve, as a share of the whisker's length
_CROSS = 4.0  # distance of two lines that cross, pixels
_FEWEST = 8  # smallest number of points of each line before and after that
_NEAR = 6.0  # distance from lines of sight at which bases of two views are one, pixels
# Percentile of the deviations in other frames that counts as usual; factor by which a deviation may
# exceed it; deviation that is always allowed, pixels; and factor by which the next best pair must
# deviate more.
_USUAL, _ALIKE, _PIXELS, _CLEARER = 80.0, 1.5, 0.5, 2.0

Row = Sequence[Sequence[Trace]]
"""Traces of one whisker, view by view, frame by frame."""


class Known(NamedTuple):
    """Properties of a whisker by the frames without doubt."""

    curves: Array  # (time, node, 3), laboratory, m; NaN where it is lost
    rest: Array  # (n, 3), equally spaced, m
    doubtful: Mask  # (time,)
    wrong: Mask  # (time,): lost unless an exchange explains the views
    # Misfits of the bent rod to pairs of traces in some frames, if contact bends it in frames
    # without doubt, and the misfit that is usual there.
    bent: Callable[[Sequence[int], Sequence[Sequence[Trace]]], Array] | None = None
    misfit: float = 0.0


def exchanged(
    cameras: Sequence[Camera], rows: Sequence[Row], known: Sequence[Known | None]
) -> list[list[list[Trace]]]:
    """Traces of all whiskers, exchanged where in doubt, or lost; one always in doubt keeps them."""
    found = [[list(view) for view in row] for row in rows]
    looks = {k: _Look.of(k, known, cameras) for k, one in enumerate(known) if one is not None}
    count = len(rows[0][0])
    free = [
        {k for k, one in enumerate(known) if one is None or one.doubtful[i]} for i in range(count)
    ]
    lines = [
        [_lines({k: rows[k][v][i] for k in sorted(free[i])}) for v in range(len(cameras))]
        for i in range(count)
    ]
    offers: list[list[tuple[float, int, Pair]]] = [[] for _ in range(count)]
    for k, look in looks.items():
        traced = [all(len(view[i].line) for view in rows[k]) for i in range(count)]
        doubtful = [k in one and shown for one, shown in zip(free, traced, strict=True)]
        for i, (unlike, pair) in _offers(cameras, look, doubtful, lines).items():
            offers[i].append((unlike, k, pair))
    for i in range(count):
        taken: set[tuple[int, int, int]] = set()
        settled = set[int]()
        for _, k, pair in sorted(offers[i], key=lambda offer: offer[0]):
            mine = {(v, end, one.parts[end]) for v, one in enumerate(pair) for end in range(2)}
            if not taken & mine:
                taken |= mine
                settled.add(k)
                for v, one in enumerate(pair):
                    found[k][v][i] = one.trace
        for k in free[i] & set(looks) - settled:
            lent = any((v, end, k) in taken for v in range(len(cameras)) for end in range(2))
            if lent or looks[k].wrong[i]:
                for view in found[k]:
                    view[i] = Trace.lost()
    return found


class _Line(NamedTuple):
    """Line of a view, and the indices of the whiskers to which its two parts were assigned."""

    trace: Trace
    parts: tuple[int, int]


Pair = tuple[_Line, ...]
"""Lines of all views that may be one whisker."""


def _lines(traces: Mapping[int, Trace]) -> list[_Line]:
    """Lines of a view, and those that continue along another one from their crossing."""
    seen = [(j, trace) for j, trace in traces.items() if len(trace.line)]
    lines = [_Line(trace, (j, j)) for j, trace in seen]
    for (j, one), (k, other) in permutations(seen, 2):
        away = np.linalg.norm(one.line[:, None] - other.line[None], axis=2)
        a, b = (int(n) for n in np.unravel_index(np.argmin(away), away.shape))
        if away[a, b] < _CROSS and min(a, len(other.line) - b) > _FEWEST:
            trace = one._replace(
                line=np.concatenate([one.line[:a], other.line[b:]]),
                sigma=np.concatenate([one.sigma[:a], other.sigma[b:]]),
                seen=np.concatenate([one.seen[:a], other.seen[b:]]),
                tip_seen=other.tip_seen,
            )
            lines.append(_Line(trace, (j, k)))
    return lines


def _offers(
    cameras: Sequence[Camera],
    look: _Look,
    doubtful: Sequence[bool],
    lines: Sequence[Sequence[Sequence[_Line]]],
) -> dict[int, tuple[float, Pair]]:
    """Pairs of lines that clearly show the whisker, as it rests, or else as the rod is bent."""
    offers, left = dict[int, tuple[float, Pair]](), dict[int, list[tuple[Array, Pair]]]()
    for i in np.flatnonzero(doubtful).tolist():
        every = _pairs(cameras, look, lines[i], i)
        deviations = [_deviation(curve, look.rest) for curve, _ in every]
        offer = _clearest(every, deviations, look.usual, look.usual)
        if offer is not None:
            offers[i] = offer
        elif every:
            left[i] = every
    if look.bent is None or not left:
        return offers
    frames = [i for i, every in left.items() for _ in every]
    misfits = look.bent(
        frames, [[one.trace for one in pair] for every in left.values() for _, pair in every]
    )
    for i, every in left.items():
        some = misfits[np.array(frames) == i].tolist()
        offer = _clearest(every, some, _ALIKE * look.misfit, look.usual)
        if offer is not None:
            offers[i] = offer
    return offers


def _pairs(
    cameras: Sequence[Camera], look: _Look, lines: Sequence[Sequence[_Line]], frame: int
) -> list[tuple[Array, Pair]]:
    """Pairs of lines that begin at the whisker's base, and the curves that they show."""
    wholes = [[one for one in view if one.parts[0] == one.parts[1]] for view in lines]
    every = []
    for whole in product(*wholes):
        begin = np.stack([one.trace.line[:1] for one in whole])
        base = triangulate(cameras, begin)[0][0]
        if base_gap(cameras, begin)[0] < _NEAR and look.begins(base, frame):
            # At most one view has a line that continues along another.
            pairs = [whole]
            for v, one in enumerate(whole):
                other = [
                    line for line in lines[v] if line.parts[0] == one.parts[0] and line is not one
                ]
                pairs += [(*whole[:v], line, *whole[v + 1 :]) for line in other]
            curves = merged(cameras, ([one.trace for one in pair] for pair in pairs))
            every += [(curve.points, pair) for curve, pair in zip(curves, pairs, strict=True)]
    return every


def _clearest(
    every: Sequence[tuple[Array, Pair]], deviations: Sequence[float], usual: float, differs: float
) -> tuple[float, Pair] | None:
    """Pair that deviates least, if as usual, and far less than those with another curve."""
    if not every:
        return None
    best = int(np.argmin(deviations))
    curve, pair = every[best]
    for (points, _), deviation in zip(every, deviations, strict=True):
        apart = np.linalg.norm(points - curve, axis=1).max() > differs
        if apart and deviation < _CLEARER * deviations[best]:
            return None
    return (deviations[best] / usual, pair) if deviations[best] < usual else None


class _Look(NamedTuple):
    """Shape of a whisker and path of its base, by which it is recognised."""

    rest: Array
    usual: float  # deviation from the shape that may be, m
    base: Array  # (time, 3), m
    near: float  # distance from there at which it may be, m
    wrong: Mask  # (time,): lost unless an exchange explains the views
    bent: Callable[[Sequence[int], Sequence[Sequence[Trace]]], Array] | None
    misfit: float

    @classmethod
    def of(cls, k: int, known: Sequence[Known | None], cameras: Sequence[Camera]) -> _Look:
        paths = {j: _path(one) for j, one in enumerate(known) if one is not None}
        one = known[k]
        assert one is not None
        deviations = [_deviation(curve, one.rest) for curve in one.curves[~one.doubtful]]
        finite = [size for size in deviations if np.isfinite(size)]
        usual = float(np.percentile(finite, _USUAL)) if finite else 0.0
        away = [np.linalg.norm(paths[k] - p, axis=1).mean() for j, p in paths.items() if j != k]
        pixel = 1.0 / np.linalg.norm(cameras[0].project_with_slopes(one.rest.mean(axis=0))[1], 2)
        usual = max(_ALIKE * usual, _PIXELS * float(pixel))
        near = 0.5 * float(min(away, default=np.inf))
        return cls(one.rest, usual, paths[k], near, one.wrong, one.bent, one.misfit)

    def begins(self, base: Array, frame: int) -> bool:
        """Whether its base may be at this position."""
        return bool(np.linalg.norm(base - self.base[frame]) < self.near)


def _path(one: Known) -> Array:
    """Base in every frame, interpolated between frames without doubt; NaN if there are none."""
    clear, frames = np.flatnonzero(~one.doubtful), np.arange(len(one.doubtful), dtype=np.float64)
    if not clear.size:
        return np.full((len(frames), 3), np.nan)
    return interpolated(frames, clear, one.curves[clear, 0])


def _deviation(curve: Array, rest: Array) -> float:
    """Root mean square distance of a curve (n, 3) from a shape fitted to it by rigid motion."""
    if not np.isfinite(curve).all():
        return np.inf
    s, own = arc_lengths(curve), arc_lengths(rest)
    if not _SHOWN * own[-1] < s[-1] < _LONGER * own[-1]:
        return np.inf
    part = rest[own <= s[-1]]
    shape = interpolated(own[: len(part)], s, curve)
    rotation, shift = motions(shape[None], part)
    return float(np.sqrt((((shape @ rotation[0].T + shift[0]) - part) ** 2).sum(axis=1).mean()))
