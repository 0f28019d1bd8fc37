"""From segments of lines to whiskers: what is one curve is joined, and it begins at a body.

A segment ends where something hides or crosses the whisker. Two ends are joined if one smooth curve
goes through both segments; the cheapest join comes first, and each end is joined once. A curve is a
whisker the more surely, the longer it is seen, the more it fades toward its tip, and if it begins
at a body that is large and at the border of the image, as the face is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.io import Frame
from vibrissa.tracking.lines import Segment, segments
from vibrissa.tracking.scene import Bodies, Scene
from vibrissa.tracking.trace import TraceOptions

Array = NDArray[np.float64]

_GAP = 160.0
"""Longest way between two ends that are joined, pixels."""

_OPEN = 30.0
"""How much of it may be open ground, pixels."""

_BENT = 0.7
"""How far the ends of a join may point beside each other, rad."""

_LONG, _PART = 40, 250
"""Points from which a segment is long, and that are looked at of it."""

_SPOILT = 10
"""Points next to a join that are left out: what hides or crosses the whisker draws them aside."""

_EXACT = 0.5
"""How far points of one curve are beside a polynomial, pixels."""

_LIKE = 0.7
"""Standard deviation of the log of the ratio of strengths of two segments of one whisker."""

_COST = 12.0
"""Cost of the dearest join."""

_DIRECTION = 12
"""Points from which the direction of an end is taken."""

_HIDDEN = 24.0
"""How far a whisker may begin from the body that it comes from, pixels."""

_TAPER = 0.8
_FADES = 4.0
"""Exponent of the ratio of strengths at base and tip, and the largest ratio that counts."""

_AT_FACE, _AT_BODY, _ALONE = 1.0, 0.6, 0.35
"""Worth of a curve that begins at a face, at another body, at none."""

_TURNING = 2.0
"""How far a whisker turns at most, rad."""

_RAGGED = 0.35
"""How far the direction wavers about that of a smooth curve, rad, by which its worth is halved."""


class Curve(NamedTuple):
    """What may be a whisker, in one frame of one view."""

    line: Array
    length: float
    from_face: bool
    score: float
    moved: float


def find_curves(
    frame: Frame, scene: Scene, options: TraceOptions, inside: bool = False
) -> list[Curve]:
    """Find what may be whiskers in a frame."""
    bodies = scene.bodies(frame)
    found = segments(scene.difference(frame), bodies, options.scale, inside)
    curves = []
    for chain in joined(found, bodies):
        moved = float(scene.moved(frame, chain.places).mean())
        for way in (chain, Segment(chain.places[::-1], chain.strength[::-1])):
            curve = _begun(way, bodies, moved)
            if curve is not None and curve.length >= options.shortest:
                curves.append(curve)
    return sorted(curves, key=lambda curve: -curve.score)


def joined(found: Sequence[Segment], bodies: Bodies) -> list[Segment]:
    """Join segments that are parts of one curve."""
    if not found:
        return []
    # End 2 k is the first of segment k, end 2 k + 1 its last; directions point outward.
    at = np.array([p for one in found for p in (one.places[0], one.places[-1])])
    toward = np.array(
        [d for one in found for d in (_outward(one.places[::-1]), _outward(one.places))]
    )
    chord = at[None] - at[:, None]
    far = np.hypot(chord[..., 0], chord[..., 1])
    unit = chord / np.maximum(far, 1e-9)[..., None]
    leaving = (unit * toward[:, None]).sum(axis=2)
    arriving = -(unit * toward[None]).sum(axis=2)
    near = (far < _GAP) & (leaving > np.cos(_BENT)) & (arriving > np.cos(_BENT))
    joins = []
    for i, j in np.argwhere(near):
        if i < j and i // 2 != j // 2 and _hidden(at[i], at[j], found, bodies):
            cost = _cost(_ending(found, i), _ending(found, j), float(far[i, j]))
            if cost < _COST:
                joins.append((cost, int(i), int(j)))
    return _chained(found, sorted(joins))


def _outward(places: Array) -> Array:
    part = places[-_DIRECTION:]
    way = part[-1] - part[0]
    return np.asarray(way / max(float(np.hypot(*way)), 1e-9))


def _ending(found: Sequence[Segment], end: int) -> Segment:
    """The segment of an end, which comes last."""
    one = found[end // 2]
    return one if end % 2 else Segment(one.places[::-1], one.strength[::-1])


def _hidden(start: Array, end: Array, found: Sequence[Segment], bodies: Bodies) -> bool:
    """Whether little of the way between two ends is open ground."""
    far = float(np.hypot(*(end - start)))
    if far <= _OPEN:
        return True
    way = start + np.linspace(0.0, 1.0, int(far) + 1)[:, None] * (end - start)
    return float((bodies.at(way) == 0).sum()) <= _OPEN


def _cost(one: Segment, other: Segment, far: float) -> float:
    """What it costs to take two segments, each ending at the join, for one curve."""
    before, after = one.places[-_PART:], other.places[-_PART:][::-1]
    ratio = np.log(np.median(one.strength[-_LONG:]) / np.median(other.strength[-_LONG:]))
    cost = 0.5 * (ratio / _LIKE) ** 2 + far / _GAP
    spoilt = _SPOILT if far > 3.0 else 0
    if min(len(before), len(after)) > _LONG:
        both = np.concatenate([before[: len(before) - spoilt], after[spoilt:]])
    else:
        # Of what is short only a little is known: an arc goes on into the other's middle.
        both = np.concatenate([before[-_LONG:], after[:_LONG]])
    axis = both[-1] - both[0]
    axis = axis / max(float(np.hypot(*axis)), 1e-9)
    x = (both - both[0]) @ axis
    y = (both - both[0]) @ [-axis[1], axis[0]]
    x = 2.0 * (x - x.min()) / max(float(np.ptp(x)), 1e-9) - 1.0
    degree = 4 if min(len(before), len(after)) > _LONG else 2
    basis = np.vander(x, degree + 1)
    rest = y - basis @ np.linalg.lstsq(basis, y)[0]
    return float(cost + np.mean(rest**2) / (2.0 * _EXACT**2))


def _chained(found: Sequence[Segment], joins: Sequence[tuple[float, int, int]]) -> list[Segment]:
    """Segments in rows, each end joined at most once."""
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


def _begun(chain: Segment, bodies: Bodies, moved: float) -> Curve | None:
    """Let a curve begin at a body, if there is one, and say how much it is like a whisker."""
    line, strength = chain
    if len(line) < _DIRECTION:
        return None
    direction = np.diff(line, axis=0)
    step = np.hypot(*direction.T)
    turns = np.unwrap(np.arctan2(*_even(line).T[::-1]))
    if np.ptp(turns) > _TURNING:
        return None
    length = float(step[step < 4.0].sum())
    base, body = _body_before(line, bodies)
    from_face = bool(bodies.face[body]) if body else False
    worth = _AT_FACE if from_face else _AT_BODY if body else _ALONE
    third = max(len(strength) // 3, 1)
    ratio = float(np.median(strength[:third]) / np.median(strength[-third:]))
    ratio = min(max(ratio, 1.0 / _FADES), _FADES)
    t = np.linspace(-1.0, 1.0, len(turns))
    basis = np.vander(t, 5)
    wavers = float(np.std(turns - basis @ np.linalg.lstsq(basis, turns)[0]))
    smooth = 1.0 / (1.0 + (wavers / _RAGGED) ** 2)
    if body:
        line = np.concatenate([base[None], line])
    return Curve(line, length, from_face, length * ratio**_TAPER * worth * smooth, moved)


def _even(line: Array) -> Array:
    """Steps of about six pixels along a line."""
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    wanted = np.linspace(0.0, s[-1], max(int(s[-1] / 6.0), 6))
    return np.diff(np.stack([np.interp(wanted, s, line[:, k]) for k in range(2)], axis=1), axis=0)


def _body_before(line: Array, bodies: Bodies) -> tuple[Array, int]:
    """Where a line, prolonged before its first point, enters a body, and which; 0: none."""
    back = line[0] - line[min(_DIRECTION, len(line) - 1)]
    back = back / max(float(np.hypot(*back)), 1e-9)
    way = line[0] + np.arange(0.0, _HIDDEN, 0.5)[:, None] * back
    body = bodies.at(way)
    inside = np.flatnonzero(body)
    if not inside.size:
        return line[0], 0
    return way[inside[0]], int(body[inside[0]])
