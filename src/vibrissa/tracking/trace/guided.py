"""Whiskers of a row in one view, by the traces of another view.

A row seen from the front lies on itself: bases are a few pixels apart, and whiskers cross next to
them. By this view alone it is hardly known which line is whose. Another view shows the same
whiskers apart, and leaves one unknown for each of their points: the distance t along its epipolar
line. A whisker is smooth, so that t is about a parabola along it. In each frame:

1. For each whisker, all parabolas are tried; those along which the image is most like a dark line
   are its candidates. The whisker ends where the other view shows its tip: a line that goes on
   there is another one's.
2. The candidates of all whiskers are combined. What is seen counts once, and bases are where they
   were clicked.

Over all frames, the sequence of combinations is chosen in which whiskers move least apart from the
motion of the whole row, and keep their bend. Costs are negative log-likelihoods.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.cameras import Camera
from vibrissa.io import Frame
from vibrissa.numerics import Array, Mask, inlined, kernel, vectorised, without_blas_threads
from vibrissa.tracking.trace.curves import smoothed
from vibrissa.tracking.trace.ends import prolonged, traced
from vibrissa.tracking.trace.identity import Seen, Step, Ways, cheapest_sequence
from vibrissa.tracking.trace.ridge import noise_level
from vibrissa.tracking.trace.scene import Image, Scene
from vibrissa.tracking.trace.start import epipolar_lines, is_bright
from vibrissa.tracking.trace.trace import (
    NEAR,
    Trace,
    TraceOptions,
    arc_lengths,
    between_whiskers,
    given,
    interpolated,
    tangent,
)
from vibrissa.tracking.trace.video import Shift, Surroundings

_SPACING = 4.0  # distance of points at which the image is compared with a line, pixels
# Steps of t at the base and of the tip and the middle, pixels; largest t of the base, pixels, of
# the tip and of the middle from the chord, as shares of the length.
_BASE_STEP, _FAR_STEP = 2.0, 2.5
_BASE_MOST, _TIP_MOST, _BEND_MOST = 6.0, 1.0, 0.2
_STRONGEST, _BRIGHTEST = 5.0, 1.0  # strengths at which darkness and brightness saturate
_WORTH = 0.1  # likelihood that is gained by a point, for each unit of strength
_CANDIDATES, _COMBINED = 6, 2e5  # largest number for a whisker, and of their combinations
_SHOWN = 0.8  # smallest mean strength of a candidate
_DISTINCT = 7.0  # difference of tip or middle from which candidates are different, pixels
# Standard deviations of a base from its click, compared with the mean of the row, and of that mean
# from its expected motion, pixels.
_BASE, _ROW = 2.0, 4.0
# Weight of a point of a chosen line where others hide the whisker, 1/pixel².
_HELD = 0.02
_ASTRAY = 3.0  # standard deviations of a base from which a trace is on something else
# Beyond a tip: distances at which a line would go on, pixels, and the share of the length by which
# they are larger; distances to the side; strength that counts as none; cost of a unit of strength
# at each of these distances, and the largest cost.
_BEYOND, _LONGER, _ASIDE = np.arange(6.0, 41.0, 4.0), 0.02, (-3.0, -1.5, 0.0, 1.5, 3.0)
_NOTHING, _GOES_ON, _CLEAR = 0.5, 0.3, 5.0
_LAST = 3  # number of points before the tip that give its direction
_SAME = 3.0  # distance within which two lines show the same, pixels
_KEPT = 64  # number of combinations of a frame that are kept
# Standard deviations of middle and tip from the motion of the row in a frame, and of the bend of a
# whisker from its usual one, at least, pixels; standard deviations at which this saturates.
_MIDDLE, _TIP, _BEND, _MOST = 4.0, 6.0, 3.0, 3.0
_ROUNDS = 3  # number of rounds in which bends are learned
_BLOCK = 1000  # number of frames that are decided together, which limits memory
_BENDING = 60  # number of last points of a trace by which it is continued to its usual length
_USUAL = 75.0  # percentile of a whisker's length where its tip is seen that is its usual one
# Share of a line on others from which it cannot be measured apart from them; standard deviations
# that are added then, and where others hide a whisker, pixels.
_MERGED, _SHARED, _HIDDEN = 0.8, 1.5, 1.0


class _Guide(NamedTuple):
    """A whisker in a frame by another view: epipolar lines of its points, from base to tip."""

    points: Array  # (n, 2), pixels
    along: Array  # (n, 2), unit vectors
    ends: bool  # whether the tip is seen there

    def line(self, t: Array) -> Array:
        """Points (n, 2) at distances (n,) along the epipolar lines."""
        return np.asarray(self.points + t[:, None] * self.along)

    def at(self, point: Array) -> float:
        """Distance along the epipolar line of the base at which it is nearest to a point."""
        return float((point - self.points[0]) @ self.along[0])


class _Candidate(NamedTuple):
    """A line that may be a whisker."""

    line: Array  # (n, 2)
    strength: Array  # (n,), of the image along it
    cost: float
    place: Array  # (3,), t of base, middle and tip compared with the expected base, pixels


class _Choice(NamedTuple):
    """Lines of a frame, by whisker, and the cheapest combinations of them."""

    lines: list[_Candidate]
    ways: Ways  # (way, whisker), index of a line, or −1
    cost: Array  # (way,)

    @property
    def begins(self) -> float:
        """Mean t of the bases in the cheapest combination."""
        places = np.array([self.lines[n].place[0] for n in self.ways[0] if n >= 0])
        known = places[np.isfinite(places)]
        return float(known.mean()) if known.size else 0.0


Frames = Callable[[], Iterable[Frame]]
"""Function that gives the frames of a video, each time from the first."""


@without_blas_threads
def trace_guided(
    frames: Frames,
    bases: Sequence[ArrayLike],
    cameras: tuple[Camera, Camera],
    known: Sequence[Sequence[Trace]],
    options: TraceOptions | None = None,
    *,
    corrections: Mapping[tuple[int, int], ArrayLike] | None = None,
    sample: Sequence[Frame],
    mask: Mask | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[list[list[Trace]], Array]:
    """Trace the whiskers of a row where another view shows them.

    ``cameras`` are those of the other view and of this one, ``known`` the traces of the other view
    in the frames of this one, whisker by whisker, empty where they are lost. Other arguments are
    those of `trace_video`, and so are the traces returned. With them comes by how much, in the
    median, the log likelihood of the row falls if a whisker's line is another one (whisker,).
    """
    options, corrections = options or TraceOptions(), corrections or {}
    report = progress or (lambda done: None)
    starts = np.array(bases, dtype=np.float64)
    bright = is_bright(sample[:1], [bases], options)
    around = Surroundings.of(sample, starts, options, mask, bright)
    guides = [_guides(cameras, row) for row in known]
    moved = 0.0  # the row of bases, along the epipolar lines
    choices, chosen, shifts = list[_Choice](), list[list[Array]](), list[Shift]()
    margins = list[Array]()
    for i, image in enumerate(frames()):
        frame, shift = around.clear(image)
        shifts.append(shift)
        scene = around.scene
        darkness, factors = smoothed(scene.difference(frame), scene.bodies(frame))
        lines = []
        for k, row in enumerate(guides):
            guide = row[i] if i < len(row) else None
            if (i, k) in corrections:
                line = given(np.asarray(corrections[i, k]) - shift[:2]).line
                lines.append([_Candidate(line, np.zeros(len(line)), -np.inf, np.full(3, np.nan))])
            elif guide is None:
                lines.append([])
            else:
                lines.append(_candidates(guide, guide.at(starts[k]) + moved, darkness, factors[0]))
        choices.append(_combined(lines))
        moved += choices[-1].begins
        if len(choices) == _BLOCK:
            chosen += _over_all_frames(choices, margins)
            choices.clear()
        report(i + 1)
    chosen += _over_all_frames(choices, margins)
    rows: list[list[Trace]] = [[] for _ in guides]
    for i, image in enumerate(frames()):
        frame, shift = around.clear(image)
        measured = _measured(frame, around.scene, chosen[i], options)
        for k, (own, trace) in enumerate(zip(rows, measured, strict=True)):
            stated = corrections.get((i, k))
            own.append(trace if stated is None else given(np.asarray(stated) - shift[:2]))
    around.finish(rows, corrections, shifts)
    return [_confident(row) for row in rows], _median(np.array(margins))


def _guides(cameras: tuple[Camera, Camera], row: Sequence[Trace]) -> list[_Guide | None]:
    """Epipolar lines of a whisker, continued to its usual length, in each frame; None if lost."""
    whole = [len(trace.line) for trace in row if len(trace.line) and trace.tip_seen]
    usual = int(np.percentile(whole, _USUAL)) if whole else 0
    lines, ends = list[Array](), list[bool]()
    for trace in row:
        line = trace.line
        if len(line) > 1:
            if not trace.tip_seen and usual > len(line):
                line = prolonged(line, _BENDING, usual - len(line))
            s = arc_lengths(line)
            wanted = np.linspace(0.0, s[-1], max(int(s[-1] / _SPACING), 2 * _LAST) + 1)
            line = interpolated(wanted, s, line)
        lines.append(line)
        ends.append(trace.tip_seen)
    points, along = epipolar_lines(np.concatenate([*lines, np.empty((0, 2))]), *cameras)
    parts = np.cumsum([len(line) for line in lines])[:-1]
    each = zip(np.split(points, parts), np.split(along, parts), ends, strict=True)
    return [_Guide(*one) if len(one[0]) > 1 else None for one in each]


def _candidates(guide: _Guide, expected: float, darkness: Image, factor: float) -> list[_Candidate]:
    """Smooth dark lines along the epipolar lines, the most probable first."""
    count = len(guide.points)
    length = _SPACING * (count - 1)
    begins = np.arange(-_BASE_MOST, _BASE_MOST + 0.1, _BASE_STEP)
    tips = np.arange(-_TIP_MOST * length, _TIP_MOST * length, _FAR_STEP)
    bends = np.arange(-_BEND_MOST * length, _BEND_MOST * length + 0.1, _FAR_STEP)
    gains = np.empty((len(begins), len(tips), len(bends)))
    try_parabolas(darkness, factor, guide.points, guide.along, expected, begins, tips, bends, gains)
    total = _WORTH * gains - 0.5 * (begins[:, None, None] / np.hypot(_BASE, _ROW)) ** 2
    best = total.max(axis=0)
    middles, found = 0.5 * tips[:, None] + bends, list[_Candidate]()
    while len(found) < _CANDIDATES:
        i, j = (int(n) for n in np.unravel_index(np.argmax(best), best.shape))
        if best[i, j] < _WORTH * _SHOWN * (count - 1):
            break
        k = int(np.argmax(total[:, i, j]))
        begin = begins[k]
        u = np.linspace(0.0, 1.0, count)
        t = begin + (tips[i] - begin) * u + 4.0 * bends[j] * u * (1.0 - u)
        line = guide.line(expected + t)
        place = np.array([begin, t[count // 2], tips[i]])
        cost = _goes_on(line, darkness, factor) if guide.ends else 0.0
        strength = strengths(line, darkness, factor)
        found.append(_Candidate(line, strength, cost - _WORTH * float(gains[k, i, j]), place))
        near = (np.abs(tips - tips[i]) < _DISTINCT)[:, None]
        best[near & (np.abs(middles - middles[i, j]) < _DISTINCT)] = -np.inf
    return found


def _goes_on(line: Array, darkness: Image, factor: float) -> float:
    """Cost of a line that is seen to go on beyond the whisker's tip."""
    ahead = line[-1] - line[-1 - _LAST]
    ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
    further = line[-1] + (_BEYOND + _LONGER * _SPACING * len(line))[:, None] * ahead
    across = ahead[::-1] * [-1.0, 1.0]
    seen = [strengths(further + a * across, darkness, factor) - _NOTHING for a in _ASIDE]
    return min(_GOES_ON * max(float(one.clip(0.0).sum()) for one in seen), _CLEAR)


def strengths(line: Array, darkness: Image, factor: float) -> Array:
    """Strength of the image along a line (n, 2), at each of its points."""
    found, ahead = np.empty(len(line)), tangent(line)
    strengths_at(darkness, factor, np.ascontiguousarray(line), np.ascontiguousarray(ahead), found)
    return found


@kernel
def strengths_at(darkness: Any, factor: float, line: Any, ahead: Any, found: Any) -> None:
    """Strength of a smoothed image of darkness along a line; outside, that of bright ground."""
    for j in range(len(line)):
        found[j] = strength_at(darkness, factor, line[j, 0], line[j, 1], ahead[j, 0], ahead[j, 1])


@inlined
def strength_at(darkness: Any, factor: float, x: float, y: float, dx: float, dy: float) -> float:
    """Curvature of a smoothed image across a line, in units of its noise."""
    column, row = int(x + 0.5), int(y + 0.5)
    if x < 1.0 or y < 1.0 or column > darkness.shape[1] - 2 or row > darkness.shape[0] - 2:
        return -_BRIGHTEST
    p = darkness[row - 1 : row + 2, column - 1 : column + 2]
    xx = p[1, 0] + p[1, 2] - 2.0 * p[1, 1]
    yy = p[0, 1] + p[2, 1] - 2.0 * p[1, 1]
    xy = 0.25 * (p[0, 0] + p[2, 2] - p[0, 2] - p[2, 0])
    square = dx * dx + dy * dy + 1e-9
    value = -factor * (dy * dy * xx - 2.0 * dx * dy * xy + dx * dx * yy) / square
    return float(min(max(value, -_BRIGHTEST), _STRONGEST))


@vectorised
def try_parabolas(
    darkness: Any,
    factor: float,
    points: Any,
    along: Any,
    expected: float,
    begins: Any,
    tips: Any,
    bends: Any,
    gains: Any,
) -> None:
    """Sums of strengths along parabolas t(u), for all t at the base and the tip, and all bends.

    They are −∞ where a first part, of a third or more, shows nothing.
    """
    count = len(points)
    third, shares = count // 3 + 1, np.linspace(0.0, 1.0, count)
    far = begins[-1] + max(-tips[0], tips[-1]) * shares + 2.0
    far += 4.0 * max(-bends[0], bends[-1]) * shares * (1.0 - shares)
    table, squares = tabulated(darkness, factor, points, along, expected, far)
    origin = 0.5 * table.shape[1]
    # Of each parabola: t, the t before, the sum, what `add_strengths` uses, its ends and its bend.
    work, place = np.empty((10, gains.size), np.float32), np.empty(gains.size, np.int32)
    begin, tip, bend, number = work[7], work[8], work[9], np.empty(gains.size, np.intp)
    left, several = 0, len(bends)
    for a in range(len(begins)):
        for b in range(len(tips)):
            first = left
            own, at = work[:, first : first + several], place[first : first + several]
            for c in range(several):
                own[1, c], own[2, c], own[9, c] = begins[a], 0.0, bends[c]
            for j in range(1, third + 1):
                u = shares[j]
                chord, arch = begins[a] + (tips[b] - begins[a]) * u, 4.0 * u * (1.0 - u)
                for c in range(several):
                    own[0, c] = chord + arch * bends[c]
                add_strengths(table[j], squares[j], origin, own, at)
            for c in range(several):
                if own[2, c] >= _SHOWN * third:
                    work[:3, left] = own[:3, c]
                    begin[left], tip[left], bend[left] = begins[a], tips[b], bends[c]
                    number[left] = (a * len(tips) + b) * several + c
                    left += 1
    some, at = work[:, :left], place[:left]
    for j in range(third + 1, count):
        u = shares[j]
        for c in range(left):
            some[0, c] = begin[c] + (tip[c] - begin[c]) * u + 4.0 * u * (1.0 - u) * bend[c]
        add_strengths(table[j], squares[j], origin, some, at)
        for c in range(left):
            some[2, c] = some[2, c] if some[2, c] >= _SHOWN * j else -np.inf
    gains[:] = -np.inf
    every = gains.reshape(-1)
    for c in range(left):
        every[number[c]] = some[2, c]


@inlined
def add_strengths(table: Any, squares: Any, origin: float, work: Any, place: Any) -> None:
    """Add the strengths at one point, for many parabolas; loops are apart to be vectorised."""
    t, before, total, step = work[0], work[1], work[2], work[3]
    zero, one, two = work[4], work[5], work[6]
    least, most = np.float32(-_BRIGHTEST), np.float32(_STRONGEST)
    start, square, slope = np.float32(origin + 0.5), squares[0], squares[1]
    for c in range(len(place)):
        step[c] = t[c] - before[c]
        place[c] = np.int32(t[c] + start)
        before[c] = t[c]
    for c in range(len(place)):
        row = table[np.uint32(place[c])]
        zero[c], one[c], two[c] = row[0], row[1], row[2]
    for c in range(len(place)):
        value = zero[c] + step[c] * (one[c] + step[c] * two[c])
        value /= square + step[c] * (slope + step[c]) + np.float32(1e-9)
        total[c] += min(max(value, least), most)


@inlined
def tabulated(
    darkness: Any, factor: float, points: Any, along: Any, expected: float, far: Any
) -> tuple[Any, Any]:
    """Strength of the image on the epipolar lines of all points, by t and its change Δt.

    The normal of a line is linear in the change from one point to the next, so that the curvature
    of the image across it is a parabola of Δt, and so is the square of that normal. Coefficients
    are (point, t, 3), for t up to ``far`` (point,) from the expected one, which is in the middle,
    and (point, 2).
    """
    middle = int(far.max()) + 1
    table = np.empty((len(points), 2 * middle, 4), np.float32)
    squares = np.zeros((len(points), 2), np.float32)
    last_row, last_column = darkness.shape[0] - 2, darkness.shape[1] - 2
    for j in range(1, len(points)):
        gx, gy = points[j, 0] - points[j - 1, 0], points[j, 1] - points[j - 1, 1]
        ax, ay = along[j, 0], along[j, 1]
        square, slope = gx * gx + gy * gy, 2.0 * (gx * ax + gy * ay)
        squares[j, 0], squares[j, 1] = square, slope
        for i in range(middle - int(far[j]), middle + int(far[j]) + 1):
            t = expected + i - middle
            column, row = int(points[j, 0] + t * ax + 0.5), int(points[j, 1] + t * ay + 0.5)
            if min(row, column) < 1 or row > last_row or column > last_column:
                # Bright ground.
                table[j, i, 0], table[j, i, 1] = -_BRIGHTEST * square, -_BRIGHTEST * slope
                table[j, i, 2] = -_BRIGHTEST
                continue
            p = darkness[row - 1 : row + 2, column - 1 : column + 2]
            xx = -factor * (p[1, 0] + p[1, 2] - 2.0 * p[1, 1])
            yy = -factor * (p[0, 1] + p[2, 1] - 2.0 * p[1, 1])
            xy = -factor * 0.25 * (p[0, 0] + p[2, 2] - p[0, 2] - p[2, 0])
            table[j, i, 0] = gy * gy * xx - 2.0 * gx * gy * xy + gx * gx * yy
            table[j, i, 1] = 2.0 * (gy * ay * xx - (gx * ay + gy * ax) * xy + gx * ax * yy)
            table[j, i, 2] = ay * ay * xx - 2.0 * ax * ay * xy + ax * ax * yy
    return table, squares


def _combined(lines: Sequence[Sequence[_Candidate]]) -> _Choice:
    """The cheapest combinations of candidates of all whiskers."""
    count = len(lines)
    most = max(1, int(_COMBINED ** (1.0 / count)) - 1)
    some = [row[:most] for row in lines]
    # The last choice of each is that the whisker is lost, if no person gave its line.
    sizes = [len(row) + 1 for row in some]
    total = _cost_of_bases(some)
    for k, row in enumerate(some):
        fixed = bool(row) and np.isneginf(row[0].cost)
        own = [0.0, np.inf] if fixed else [*(one.cost for one in row), 0.0]
        total += np.expand_dims(own, [j for j in range(count) if j != k])
    for j, k in combinations(range(count), 2):
        both = np.zeros((sizes[j], sizes[k]))
        for a, one in enumerate(some[j]):
            for b, other in enumerate(some[k]):
                shown = one.line, one.strength, other.line, other.strength
                both[a, b] = _WORTH * shown_twice(*shown, _SAME)
        total += np.expand_dims(both, [m for m in range(count) if m not in (j, k)])
    flat = total.ravel()
    best = np.argpartition(flat, min(_KEPT, flat.size) - 1)[:_KEPT]
    best = best[np.argsort(flat[best])]
    best = best[np.isfinite(flat[best])]
    ways = np.stack(np.unravel_index(best, sizes), axis=1)
    first = np.cumsum([0, *(len(row) for row in some[:-1])])
    lost = ways == np.array(sizes) - 1
    every = [one for row in some for one in row]
    return _Choice(every, np.where(lost, -1, ways + first), flat[best])


def _cost_of_bases(lines: Sequence[Sequence[_Candidate]]) -> Array:
    """Cost of all combinations by where whiskers begin: like the others, and as expected."""
    count = len(lines)
    sums = [np.zeros([len(row) + 1 for row in lines]) for _ in range(3)]
    for k, row in enumerate(lines):
        begins = np.array([*(one.place[0] for one in row), np.nan])
        known = np.isfinite(begins)
        begins = np.where(known, begins, 0.0)
        for total, own in zip(sums, (known, begins, begins**2), strict=True):
            total += np.expand_dims(own, [j for j in range(count) if j != k])
    number, first, second = sums
    mean = first / np.maximum(number, 1.0)
    apart = second - number * mean**2
    return np.asarray(0.5 * (apart / _BASE**2 + mean**2 / _ROW**2))


@kernel
def shown_twice(line: Any, strength: Any, other: Any, also: Any, near: float) -> float:
    """Sum of the strengths along a line, or those of another one if smaller, where it is near."""
    total = 0.0
    for i in range(len(line)):
        least, at = near * near, -1
        for j in range(len(other)):
            square = (line[i, 0] - other[j, 0]) ** 2 + (line[i, 1] - other[j, 1]) ** 2
            if square < least:
                least, at = square, j
        if at >= 0:
            total += max(min(strength[i], also[at]), 0.0)
    return total


def _over_all_frames(choices: Sequence[_Choice], margins: list[Array]) -> list[list[Array]]:
    """Lines of all whiskers in each frame, empty if lost; their margins are added to a list."""
    if not choices:
        return []
    places = [
        np.array([one.place for one in c.lines] + [np.full(3, np.nan)]) for c in choices
    ]  # the last of them is that of lost whiskers, −1
    motions = [_motion(a, b) for a, b in pairwise(places)]
    frames = [Seen([_as_trace(one.line) for one in c.lines], [], []) for c in choices]
    settled = [set[int]() for _ in choices]
    bends, costs = [_bends(place) for place in places], [c.cost for c in choices]
    chosen: list[list[int]] = []
    for _ in range(_ROUNDS):
        steps = [Step(c.ways, cost) for c, cost in zip(choices, costs, strict=True)]
        chosen = cheapest_sequence(frames, settled, steps, motions)
        own = np.array([bend[way] for bend, way in zip(bends, chosen, strict=True)])
        usual = _median(own)
        spread = np.maximum(1.4826 * _median(np.abs(own - usual)), _BEND)
        away = [(bend[c.ways] - usual) / spread for c, bend in zip(choices, bends, strict=True)]
        costs = [
            c.cost + 0.5 * np.minimum(np.nan_to_num(one) ** 2, _MOST**2).sum(axis=1)
            for c, one in zip(choices, away, strict=True)
        ]
    every = zip(choices, costs, places, chosen, strict=True)
    margins += [_margins(c.ways, cost, place[:, 1:], way) for c, cost, place, way in every]
    return [
        [c.lines[n].line if n >= 0 else np.empty((0, 2)) for n in way]
        for c, way in zip(choices, chosen, strict=True)
    ]


def _margins(ways: Ways, cost: Array, place: Array, way: Sequence[int]) -> Array:
    """Cost (whisker,) of another line, or none, than in a way; NaN if lost or not a cheap way."""
    away = np.abs(place[ways] - place[list(way)]).max(axis=2)
    other = np.where(~(away <= 2.0 * _DISTINCT), cost[:, None], cost.max())
    own = cost[(ways == way).all(axis=1)]
    known = (np.array(way) >= 0) & (len(own) > 0)
    return np.where(known, other.min(axis=0) - own.sum(), np.nan)


def _motion(one: Array, other: Array) -> Array:
    """Motion of middle and tip from each line to each of the next frame's, as costs need it."""
    motion = other[None, :, 1:] - one[:, None, 1:]
    # In the order of `cheapest_sequence`, which begins with lost whiskers.
    return np.asarray(np.roll(motion, 1, axis=(0, 1)) / [_MIDDLE, _TIP])


def _bends(place: Array) -> Array:
    """Distance of the middle of each line from its chord, along the epipolar lines, pixels."""
    return np.asarray(place[:, 1] - 0.5 * (place[:, 0] + place[:, 2]))


def _median(values: Array) -> Array:
    """Median over frames, 0 where a whisker is never seen."""
    seen = np.isfinite(values)
    columns = [row[ok] for row, ok in zip(values.T, seen.T, strict=True)]
    return np.array([np.median(one) if len(one) else 0.0 for one in columns])


def _as_trace(line: Array) -> Trace:
    return Trace(line, np.ones(len(line)), np.ones(len(line), dtype=bool), 1.0)


def _measured(
    frame: Frame, scene: Scene, lines: Sequence[Array], options: TraceOptions
) -> list[Trace]:
    """Traces near the lines of all whiskers, which are not measured where they overlap."""
    noise, near = noise_level(frame), NEAR * options.scale
    shape = (frame.shape[0], frame.shape[1])
    parted = between_whiskers(list(lines), scene.bits, shape, near)
    traces = []
    for line, clutter in zip(lines, parted, strict=True):
        trace = Trace.lost()
        if len(line):
            apart = clutter.hides(line).mean() < _MERGED
            clutter = clutter if apart else clutter.still_only
            trace = traced(frame, noise, line, options, clutter=clutter, held=_HELD)[0]
            if len(trace.line) and np.hypot(*(trace.line[0] - line[0])) > _ASTRAY * _BASE:
                trace = Trace.lost()
            unsure = np.where(clutter.hides(trace.line) & ~trace.seen, _HIDDEN, 0.0)
            unsure = unsure if apart else np.full(len(unsure), _SHARED)
            trace = trace._replace(sigma=np.hypot(trace.sigma, unsure))
        traces.append(trace if trace.support >= 0.5 * options.shortest else Trace.lost())
    return traces


def _confident(row: Sequence[Trace]) -> list[Trace]:
    """Traces that are less confident the shorter they are compared with the whisker's others."""
    lengths = [trace.support for trace in row if len(trace.line)]
    usual = max(float(np.median(lengths)), 1.0) if lengths else 1.0
    return [t._replace(confidence=t.confidence * min(1.0, t.support / usual)) for t in row]
