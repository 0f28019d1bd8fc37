"""Thin lines in a difference image, candidate curves composed of them, and the whiskers of a frame.

With the image D smoothed by a Gaussian of standard deviation σ, λ the lower eigenvalue of its
second derivatives and n the eigenvector, a ridge passes through a pixel if λ < 0 and its top, at
t = −(∇D·n) / λ along n, is within the pixel (Steger 1998). Its strength is −σ²λ.

A segment, a chain of ridge points, ends where something hides or crosses the whisker. Two ends are
joined if one smooth curve passes through both segments; the cheapest join is made first, and each
end is joined once. A curve is more likely to be a whisker the longer it is seen and the more it
fades toward its tip, and if it begins at a large body at the border of the image, as the face is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.io import Frame
from vibrissa.numerics import Mask, inlined, kernel
from vibrissa.tracking.trace.ends import traced
from vibrissa.tracking.trace.ridge import noise_level
from vibrissa.tracking.trace.scene import Bodies, Image, Scene, blurred
from vibrissa.tracking.trace.trace import Trace, TraceOptions, arc_lengths, interpolated, overlap

Array = NDArray[np.float64]

SIGMA = 1.6  # smoothing, pixels, for a whisker of typical width
# Strength of points that belong to a line, and of those that start one, in units of the noise.
_LEAST, _CLEAR = 2.0, 4.0
_QUIET = 0.4  # smallest assumed noise of an image, grey values
_STEP = 4.0  # distance between two points of a curve above which something is hidden, pixels
_SHORTEST = 9  # number of points of the shortest segment
_ROUND = 0.6  # largest second derivative along a line, relative to that across it
_MOST = 60_000  # largest number of ridge points of a frame


class Segment(NamedTuple):
    """A line without gaps."""

    points: Array
    strength: Array

    @property
    def reversed(self) -> Segment:
        """The same segment from its other end."""
        return Segment(self.points[::-1], self.strength[::-1])


def smoothed(
    difference: Image, bodies: Bodies, scale: float = 1.0
) -> tuple[Image, NDArray[np.float64]]:
    """Smoothed difference image; strength per second derivative on open ground and on bodies."""
    sigma = SIGMA * scale
    smooth = blurred(difference, sigma)
    factors = np.zeros(2)
    for kind in range(2):
        values = np.empty(difference.size // 16 + 1)
        count = roughness(smooth, bodies.label, bool(kind), values)
        if count:
            noise = max(1.4826 * float(np.median(values[:count])) * sigma**2, _QUIET)
            factors[kind] = sigma**2 / noise
    return smooth, factors


def segments(difference: Image, bodies: Bodies, scale: float = 1.0) -> list[Segment]:
    """Find the lines of a difference image, except on bodies."""
    smooth, factors = smoothed(difference, bodies, scale)
    factors[1] = 0.0
    points, index = np.empty((_MOST, 4)), np.full(difference.shape, -1, dtype=np.int32)
    count = ridge_points(smooth, bodies.label, factors, _LEAST, points, index)
    order = np.argsort(-points[:count, 3])
    order = order[points[order, 3] > _CLEAR]
    member, first = np.empty(count, dtype=np.int32), np.empty(count + 1, dtype=np.int32)
    number = link(points, index, order, _SHORTEST, member, first)
    return [
        Segment(points[chosen, :2], points[chosen, 3])
        for chosen in (member[first[i] : first[i + 1]] for i in range(number))
    ]


@kernel
def roughness(smooth: Any, label: Any, inside: bool, out: Any) -> int:
    """Absolute differences of second derivatives along rows and columns, on a sparse grid."""
    rows, columns = smooth.shape
    count = 0
    for row in range(4, min(rows - 4, 2 * label.shape[0]), 5):
        for column in range(4, min(columns - 4, 2 * label.shape[1]), 5):
            if (label[row // 2, column // 2] != 0) == inside and count < out.shape[0]:
                across = smooth[row, column - 1] + smooth[row, column + 1]
                down = smooth[row - 1, column] + smooth[row + 1, column]
                out[count] = abs(across - down)
                count += 1
    return count


@inlined
def near_body(label: Any, row: int, column: int) -> Any:
    """1 if there is a body at a pixel of the frame or next to it, else 0."""
    i, j = row // 2, column // 2
    for a in range(max(i - 1, 0), min(i + 2, label.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, label.shape[1])):
            if label[a, b] != 0:
                return 1
    return 0


@kernel
def ridge_points(
    smooth: Any, label: Any, factors: Any, least: float, points: Any, index: Any
) -> int:
    """Find pixels through which a ridge passes."""
    rows, columns = smooth.shape
    count = 0
    highest = max(factors[0], factors[1])
    for row in range(3, rows - 3):
        for column in range(3, columns - 3):
            twice = 2.0 * smooth[row, column]
            xx = smooth[row, column - 1] + smooth[row, column + 1] - twice
            yy = smooth[row - 1, column] + smooth[row + 1, column] - twice
            xy = 0.25 * (
                smooth[row - 1, column - 1]
                + smooth[row + 1, column + 1]
                - smooth[row - 1, column + 1]
                - smooth[row + 1, column - 1]
            )
            mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
            root = math.sqrt(half * half + xy * xy)
            lower = mean - root
            if -lower * highest <= least or abs(mean + root) > _ROUND * abs(lower):
                continue
            strength = -lower * factors[near_body(label, row, column)]
            if strength <= least:
                continue
            along = 0.5 * math.atan2(xy, half)
            nx, ny = -math.sin(along), math.cos(along)
            gx = 0.5 * (smooth[row, column + 1] - smooth[row, column - 1])
            gy = 0.5 * (smooth[row + 1, column] - smooth[row - 1, column])
            t = -(gx * nx + gy * ny) / lower
            if abs(t * nx) > 0.65 or abs(t * ny) > 0.65:
                continue
            if count == points.shape[0]:
                return count
            points[count, 0], points[count, 1] = column + t * nx, row + t * ny
            points[count, 2], points[count, 3] = along, strength
            index[row, column] = count
            count += 1
    return count


@kernel
def link(points: Any, index: Any, order: Any, shortest: int, member: Any, first: Any) -> int:
    """Link points into chains."""
    used = np.zeros(points.shape[0], np.bool_)
    way = np.empty(2 * points.shape[0] + 1, np.int32)
    number, filled, middle = 0, 0, points.shape[0]
    first[0] = 0
    for seed in order:
        if used[seed]:
            continue
        used[seed] = True
        ends = [middle, middle]
        way[middle] = seed
        for side in range(2):
            step = 1 - 2 * side
            angle = points[seed, 2] + math.pi * side
            ends[side] = _walk(points, index, used, seed, angle, way, middle, step)
        count = ends[0] - ends[1] + 1
        if count >= shortest and filled + count <= member.shape[0]:
            for k in range(count):
                member[filled + k] = way[ends[1] + k]
            filled += count
            number += 1
            first[number] = filled
    return number


@kernel
def _walk(
    points: Any, index: Any, used: Any, seed: int, angle: float, way: Any, at: int, step: int
) -> int:
    """Walk from point to point in one direction; return the index in ``way`` of the last."""
    rows, columns = index.shape
    here = seed
    while True:
        cos, sin = math.cos(angle), math.sin(angle)
        best, least, turn = -1, 2.6, 0.0
        column, row = round(points[here, 0]), round(points[here, 1])
        for i in range(max(row - 2, 0), min(row + 3, rows)):
            for j in range(max(column - 2, 0), min(column + 3, columns)):
                k = index[i, j]
                if k < 0 or used[k]:
                    continue
                dx, dy = points[k, 0] - points[here, 0], points[k, 1] - points[here, 1]
                far = math.sqrt(dx * dx + dy * dy) + 1e-9
                ahead = (dx * cos + dy * sin) / far
                if ahead < 0.6:
                    continue
                own = math.cos(points[k, 2] - angle)
                if abs(own) < 0.8:
                    continue
                cost = far + 1.5 * math.acos(min(ahead, 1.0)) + math.acos(min(abs(own), 1.0))
                if cost < least:
                    best, least = k, cost
                    turn = points[k, 2] if own > 0.0 else points[k, 2] + math.pi
        if best < 0:
            return at
        # A broad ridge has adjacent parallel points, which are not a second line.
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                if index[i, j] >= 0:
                    used[index[i, j]] = True
        used[best] = True
        at += step
        way[at] = best
        here, angle = best, turn


_GAP = 160.0  # largest distance between two ends that are joined, pixels
_BEGINS = 6.0  # distance from the beginning of a whisker up to which no ends are joined, pixels
_OPEN = 30.0  # largest part of a join that may be open ground, pixels
_BENT = 0.7  # largest angle between the end of a segment and the chord of a join, rad
# Numbers of points from which a segment is long, and of those that are used of it.
_LONG, _PART = 40, 250
# Points next to a join that are skipped: what hides or crosses the whisker displaces them.
_SPOILT = 10
_EXACT = 0.5  # standard deviation of points of one curve about a polynomial, pixels
# Standard deviation of the log of the ratio of strengths of two segments of one whisker.
_LIKE = 0.7
_COST = 12.0  # largest cost of a join
_DIRECTION = 12  # number of points from which the direction of an end is taken
# Largest distance of a whisker's first point from the body that it comes from, pixels.
_HIDDEN = 24.0
# Exponent of the ratio of strengths at base and tip, and the largest ratio that counts.
_TAPER, _FADES = 0.8, 4.0
# Score of a curve that begins at a face, at another body, at none.
_AT_FACE, _AT_BODY, _ALONE = 1.0, 0.6, 0.35
# Half width of a line's darkness, pixels, and number of points over which its direction is
# constant.
_ACROSS, _SKIPPED = 6, 5
_TURNING = 2.0  # largest turn of a whisker, rad
# Standard deviation of the direction about a smooth one that halves the score of a curve, rad.
_RAGGED = 0.35
_FAINT = 0.7  # darkness, as a share of that of the rest, below which a line's beginning is fur
_EVEN = 6.0  # distance of the points between which the direction is measured, pixels


class Curve(NamedTuple):
    """Candidate whisker in one frame of one view."""

    line: Array
    length: float
    from_face: bool
    score: float
    moved: float


def find_curves(
    frame: Frame, scene: Scene, options: TraceOptions, begins: Array | None = None
) -> list[Curve]:
    """Find candidate whiskers in a frame; some begin on the face at points ``begins`` (n, 2)."""
    bodies, gain = scene.bodies(frame), scene.gain(frame)
    curves, difference = [], scene.difference(frame)
    parts = segments(difference, bodies, options.scale)
    for chain in joined(parts, bodies, begins):
        step = np.hypot(*np.diff(chain.points, axis=0).T)
        # Hidden parts at a join do not count as seen.
        length = float(step[step < _STEP].sum())
        if len(chain.points) >= _DIRECTION and length >= options.shortest:
            moved = scene.moved(frame, chain.points, gain)
            dark = chain._replace(strength=_darkness(difference, chain.points, options.scale))
            ends = [_bare(one) if options.bright else one for one in (dark, dark.reversed)]
            both = (_begun(part, bodies, length, moved) for part in ends)
            curves += [curve for curve in both if curve is not None]
    return sorted(curves, key=lambda curve: -curve.score)


def joined(found: Sequence[Segment], bodies: Bodies, begins: Array | None = None) -> list[Segment]:
    """Join segments of one curve, but not behind a face, nor where whiskers begin."""
    if not found:
        return []
    begins = np.empty((0, 2)) if begins is None else begins
    # End 2 k is the first of segment k, end 2 k + 1 its last; directions point outward.
    at = np.array([p for one in found for p in (one.points[0], one.points[-1])])
    toward = np.array(
        [d for one in found for d in (_outward(one.points[::-1]), _outward(one.points))]
    )
    chord = at[None] - at[:, None]
    far = np.hypot(chord[..., 0], chord[..., 1])
    unit = chord / np.maximum(far, 1e-9)[..., None]
    leaving = (unit * toward[:, None]).sum(axis=2)
    arriving = -(unit * toward[None]).sum(axis=2)
    near = (far < _GAP) & (leaving > np.cos(_BENT)) & (arriving > np.cos(_BENT))
    i, j = np.nonzero(np.triu(near))
    several = i // 2 != j // 2
    i, j = i[several], j[several]
    may = _hidden(at[i], at[j], bodies, bodies.near(begins))
    for begin in begins:
        may &= _apart(begin, at[i], at[j]) > _BEGINS
    joins = []
    for a, b in zip(i[may], j[may], strict=True):
        cost = _cost(_ending(found, a), _ending(found, b), float(far[a, b]))
        if cost < _COST:
            joins.append((cost, int(a), int(b)))
    return _chained(found, sorted(joins))


def _outward(points: Array) -> Array:
    """Unit vector in the direction of a segment's end."""
    part = points[-_DIRECTION:]
    return _unit(part[-1] - part[0])


def _unit(vector: Array) -> Array:
    return np.asarray(vector / max(float(np.hypot(*vector)), 1e-9))


def _ending(found: Sequence[Segment], end: int) -> Segment:
    """The segment of an end, ordered so that the end comes last."""
    one = found[end // 2]
    return one if end % 2 else one.reversed


def _hidden(starts: Array, ends: Array, bodies: Bodies, faces: Sequence[int]) -> Mask:
    """Pairs of ends, each (n, 2), with little open ground between them."""
    chord = ends - starts
    far = np.hypot(*chord.T)
    steps = far.astype(np.int64)
    pair = np.repeat(np.arange(len(far)), steps + 1)
    step = np.arange(len(pair)) - np.searchsorted(pair, pair)
    points = starts[pair] + (step / np.maximum(steps, 1)[pair])[:, None] * chord[pair]
    shown = np.isin(bodies.at(points), [0, *faces])
    return np.asarray((far <= _OPEN) | (np.bincount(pair, shown, len(far)) <= _OPEN))


def _apart(point: Array, starts: Array, ends: Array) -> Array:
    """Distance of a point from each chord between two ends, each (n, 2)."""
    chord = ends - starts
    square = np.maximum((chord**2).sum(axis=1), 1e-9)
    share = (((point - starts) * chord).sum(axis=1) / square).clip(0.0, 1.0)
    return np.asarray(np.linalg.norm(starts + share[:, None] * chord - point, axis=1))


def _cost(one: Segment, other: Segment, far: float) -> float:
    """Cost of joining two segments, each ending at the join."""
    before, after = one.points[-_PART:], other.points[-_PART:][::-1]
    ratio = np.log(np.median(one.strength[-_LONG:]) / np.median(other.strength[-_LONG:]))
    cost = 0.5 * (ratio / _LIKE) ** 2 + far / _GAP
    if min(len(before), len(after)) > _LONG:
        spoilt = _SPOILT if far > 3.0 else 0
        both, degree = np.concatenate([before[: len(before) - spoilt], after[spoilt:]]), 4
    else:
        # A short segment gives only an arc, which is extrapolated into the middle of the other.
        both, degree = np.concatenate([before[-_LONG:], after[:_LONG]]), 2
    axis = _unit(both[-1] - both[0])
    x = (both - both[0]) @ axis
    y = (both - both[0]) @ [-axis[1], axis[0]]
    x = 2.0 * (x - x.min()) / max(float(np.ptp(x)), 1e-9) - 1.0
    return float(cost + np.mean(_left_of(x, y, degree) ** 2) / (2.0 * _EXACT**2))


def _left_of(x: Array, y: Array, degree: int) -> Array:
    """Residuals of values about the best polynomial."""
    basis = np.vander(x, degree + 1)
    return np.asarray(y - basis @ np.linalg.lstsq(basis, y)[0])


def _chained(found: Sequence[Segment], joins: Sequence[tuple[float, int, int]]) -> list[Segment]:
    """Chains of segments, each end joined at most once."""
    partner: dict[int, int] = {}
    group = list(range(len(found)))

    def root(k: int) -> int:
        while group[k] != k:
            k = group[k]
        return k

    for _, i, j in joins:
        if i in partner or j in partner or root(i // 2) == root(j // 2):
            continue
        partner[i], partner[j] = j, i
        group[root(i // 2)] = root(j // 2)
    chains = []
    for start in range(2 * len(found)):
        if start in partner:
            continue
        end, parts = start, []
        while True:
            # From this end of a segment to its other one, and on to the next segment.
            parts.append(_ending(found, end ^ 1))
            if end ^ 1 not in partner:
                break
            end = partner[end ^ 1]
        if start <= end ^ 1:
            chains.append(Segment(*(np.concatenate(one) for one in zip(*parts, strict=True))))
    return chains


def _darkness(difference: Image, line: Array, scale: float) -> Array:
    """Darkness of each point of a line, summed across it; larger where a whisker is wider."""
    offsets = scale * np.arange(-_ACROSS, _ACROSS + 1)
    direction = np.repeat(np.gradient(line[::_SKIPPED], axis=0), _SKIPPED, axis=0)[: len(line)]
    normal = direction[:, ::-1] * [-1.0, 1.0]
    normal /= np.maximum(np.hypot(*normal.T), 1e-9)[:, None]
    points = np.rint(line[:, None] + offsets[:, None] * normal[:, None]).astype(np.intp)
    rows, columns = difference.shape
    grey = difference[points[..., 1].clip(0, rows - 1), points[..., 0].clip(0, columns - 1)]
    around = np.minimum(grey[:, 0], grey[:, -1])[:, None]
    return np.asarray(np.maximum((grey - around).sum(axis=1), 1.0), dtype=np.float64)


def _bare(chain: Segment) -> Segment:
    """Line without streaks of the fur before it.

    A bright whisker is at least as clear before dark fur, which then is not a body, as elsewhere.
    """
    near = chain.strength[: len(chain.strength) // 2]
    count = np.arange(1, len(near))
    before = np.cumsum(near)[:-1] / count
    after = (near.sum() - before * count) / (len(near) - count)
    # Where two constants describe the darkness best; the taper of a tip is better described by a
    # straight line.
    explained = count * (len(near) - count) * (after - before) ** 2 / len(near) ** 2
    first = int(np.argmax(explained)) + 1
    line = np.cov(np.arange(len(near)), near)
    step = explained[first - 1] > line[0, 1] ** 2 / line[0, 0]
    first *= int(step and before[first - 1] < _FAINT * after[first - 1])
    return Segment(chain.points[first:], chain.strength[first:])


def _begun(chain: Segment, bodies: Bodies, length: float, moved: float) -> Curve | None:
    """Start a curve at a body, if there is one, and score its likeness to a whisker."""
    line, strength = chain
    turns = np.unwrap(np.arctan2(*_even_steps(line).T[::-1]))
    if np.ptp(turns) > _TURNING:
        return None
    base, body = _body_before(line, bodies)
    from_face = bool(bodies.face[body]) if body else False
    worth = _AT_FACE if from_face else _AT_BODY if body else _ALONE
    third = max(len(strength) // 3, 1)
    ratio = float(np.median(strength[:third]) / np.median(strength[-third:]))
    ratio = min(max(ratio, 1.0 / _FADES), _FADES)
    wavers = float(np.std(_left_of(np.linspace(-1.0, 1.0, len(turns)), turns, 4)))
    smooth = 1.0 / (1.0 + (wavers / _RAGGED) ** 2)
    if body:
        line = np.concatenate([base[None], line])
    return Curve(line, length, from_face, length * ratio**_TAPER * worth * smooth, moved)


def _even_steps(line: Array) -> Array:
    """Points along a line in steps of about six pixels."""
    s = arc_lengths(line)
    wanted = np.linspace(0.0, s[-1], max(int(s[-1] / _EVEN), 6))
    return np.diff(interpolated(wanted, s, line), axis=0)


def _body_before(line: Array, bodies: Bodies) -> tuple[Array, int]:
    """Point where a line, extrapolated before its start, enters a body, and its label or 0."""
    back = _unit(line[0] - line[min(_DIRECTION, len(line) - 1)])
    before = line[0] + np.arange(0.0, _HIDDEN, 0.5)[:, None] * back
    body = bodies.at(before)
    inside = np.flatnonzero(body)
    if not inside.size:
        return line[0], 0
    return before[inside[0]], int(body[inside[0]])


class Found(NamedTuple):
    """Whisker in one frame."""

    trace: Trace  # from base to tip
    from_face: bool  # whether it begins at something dark


def find_whiskers(frame: Frame, options: TraceOptions | None = None) -> list[Found]:
    """Find all whiskers of a frame."""
    options = options or TraceOptions()
    noise = noise_level(frame)
    found: list[Found] = []
    for curve in find_curves(frame, Scene.of([frame], options.scale), options):
        if any(overlap(curve.line, other.trace.line) >= 0.5 for other in found):
            continue
        trace, from_face = traced(frame, noise, curve.line, options)
        if trace.support >= options.shortest:
            found.append(Found(trace, from_face))
    return sorted(found, key=lambda one: not one.from_face)
