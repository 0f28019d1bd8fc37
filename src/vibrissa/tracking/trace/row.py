"""Several whiskers of one view in one frame: assignment of a line to each.

In the first frame each whisker is known from its click up to where it meets another one. Beyond, it
may continue in several ways, with about the same bend, to where the image shows a line; the most
probable combination for all whiskers is chosen, no two with the same end. Where whiskers overlap
nothing is measured. From then on each is followed along its expected line; one that stops at
another, or has a kink there, is continued as in the first frame. In case of doubt, all lines of the
frame are found once, and the cheapest assignment of lines to whiskers is chosen
(`vibrissa.tracking.trace.identity`). A line costs more the farther it begins from where the whisker
is expected, and the shorter it is; the whole row may have turned and shifted by more than expected,
at a cost of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import optimize, spatial
from vibrissa.io import Frame
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.trace.curves import Curve, find_curves
from vibrissa.tracking.trace.ends import kink, prolonged, traced
from vibrissa.tracking.trace.follower import FEATURES, Follower, features_of
from vibrissa.tracking.trace.identity import (
    LOST,
    POINTS,
    SAME,
    Assignment,
    Seen,
    clashes,
    motion_between,
    same_whisker,
    sideways,
)
from vibrissa.tracking.trace.ridge import measure_ends, noise_level
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.trace import (
    NEAR,
    STEP,
    Trace,
    TraceOptions,
    aligned,
    arc_lengths,
    between_whiskers,
    even,
    given,
    overlap,
)

_DOUBT = 0.6  # least difference to a way that gives a whisker another line
_WAYS = 256  # largest number of ways to give lines to whiskers that are compared
_ROUNDS = 3  # number of rounds in which whiskers are kept apart where they cross
_SHORT = 3.0  # cost of a line that is hardly seen
# Share of a line that moves from which it may be a whisker, and cost of one that does not, such as
# a wire, at a click where another one does that has such a share of its length.
_MOVES, _STANDS, _COMPARABLE = 0.4, 3.0, 0.4
_MOSTLY = 0.6  # share of the frames in which the line at a base moves if its whisker does
# Turn, rad, and shift, pixels, of the whole row in a frame that cost as much as a lost whisker.
_ROW_TURN, _ROW_SHIFT = 0.1, 5.0
_UNLIKE = 3.0  # unlikeness above which a whisker's own line is in doubt
# Distance from a base within which lines begin that are searched without expectations, pixels.
_NEAR = 40.0
_MERGED = 0.8  # share of a line that lies on others from which they are not kept apart
_TRIED = 4  # number of lines that are measured for each whisker that is missing
# Weight of a click's distance along a line, and number of points that give its direction.
_ALONG, _DIRECTION = 0.4, 10
# Largest length of a line before a click, pixels, and by how much that adds to its distance.
_HAIR, _BEFORE = 40.0, 0.1
_LIKELY = 100.0  # score of a curve from which it is likely to be a whisker
_SAME_CURVE = 0.9  # share of a line along another one from which both are the same curve
# Numbers of points: of a whisker's beginning, of what gives its bend, by which it goes on at most,
# and by which it goes on beyond what is seen, so that its tip can be seen to end.
_FEWEST, _POLYNOMIAL, _AHEAD, _FURTHER = 15, 60, 150, 15
# Standard deviation of a whisker's bend beyond a crossing from that before it, 1/pixel, and of its
# change along the whisker, 1/pixel²; uncertainty of a bend, times the square of its length.
_BENDS, _BEND_CHANGES, _BEND_KNOWN = 2e-4, 1e-6, 2.7
# Standard deviations of the bend within which ends are searched, number of bends, and number of
# points at the far end by which two of them are distinguished.
_WIDEST, _FAN, _FAR = 3.0, 25, 40
# Likelihood that is gained with each point that is seen, and depth from which it is, in standard
# deviations.
_WORTH, _SUPPORTED = 0.1, 2.5
# Largest number of ends of a whisker that are considered, and of ways to give them to all.
_ENDS, _COMBINED = 6, 2e4
# Distance of a whisker from a smooth curve from which it may have a kink, pixels, and the share of
# a kink that may be left.
_KINKED, _STRAIGHTER = 0.25, 0.7
# Number of points before another whisker at which one may have been stopped by it, and by what
# factor it must be longer without, or may be shorter if it is straighter.
_STOPPED, _LONGER = 5, 1.1
_LARGEST_TURN = 0.35  # largest turn of the row between frames beyond what was expected, rad
# Cosine of the largest angle between the directions of a line and of the expected one.
_ALIGNED = 0.7
# Distance from a click that costs as much as a lost whisker, pixels, at most half of that to the
# next base.
CLICK = 12.0


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
    settled = dict(fixed)
    if all(line is None for line in before) and free:
        chosen = clear = _begun(followers, fixed, frame, noise, scene)
        # A whisker that hides at its click leaves the lines of the others alone.
        settled |= clear
    else:
        own |= _straightened(followers, own, fixed, frame, noise, scene)
        chosen = clear = _clearly(followers, own, fixed, frame)
    if len(clear) < len(free):
        left = [k for k in free if k not in settled]
        own = {k: [clear[k]] if k in clear else own[k] for k in left}
        pool = _pool(followers, own, clear, settled, frame, noise, scene)
        features = [features_of(frame, trace, followers[0].clutter) for trace in pool]
        apart = _distance_to_next(followers)
        lines = _assigned([followers[k] for k in left], pool, features, apart[left])
        chosen = {k: trace for k, trace in clear.items() if k in settled}
        chosen |= {k: pool[c] for k, c in zip(left, lines, strict=True) if c >= 0}
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
    followers: Sequence[Follower], lines: Mapping[int, Array], frame: Frame, scene: Scene | None
) -> None:
    """Exclude from measurement the parts where whiskers overlap, on known or expected lines."""
    every = [lines.get(k, follower.expected) for k, follower in enumerate(followers)]
    still = None if scene is None else scene.bits
    near = NEAR * followers[0].options.scale
    parted = between_whiskers(every, still, (frame.shape[0], frame.shape[1]), near)
    for follower, line, clutter in zip(followers, every, parted, strict=True):
        alone = line is not None and len(line) and clutter.hides(line).mean() < _MERGED
        follower.clutter = clutter if alone else clutter.still_only


def _begun(
    followers: Sequence[Follower],
    fixed: Mapping[int, Trace],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> dict[int, Trace]:
    """Whiskers in the first frame, each at its click.

    Where whiskers cross, a line may continue along another one: at first each is known up to there.
    """
    options = followers[0].options
    scene = scene or Scene.of([frame], options.scale)
    free = [k for k in range(len(followers)) if k not in fixed]
    clicked = np.array([followers[k].base for k in free])
    every = [
        curve
        for curve in find_curves(frame, scene, options, begins=clicked)
        if all(overlap(curve.line, other.line) < SAME for other in fixed.values())
    ]
    assigned = _at_clicks(clicked, every, _distance_to_next(followers)[free])
    lines = [one.line for one in every]
    starts = {
        free[i]: _up_to_a_crossing(even(lines[c][_passed(clicked[i], lines[c])[1] :]), lines)
        for i, c in assigned
    }
    # A line may have met another one where that is not seen any more.
    onward = {k: prolonged(start, _POLYNOMIAL, _AHEAD) for k, start in starts.items()}
    starts = {
        k: _up_to_a_crossing(start, [line for j, line in onward.items() if j != k])
        for k, start in starts.items()
    }
    known = {k: trace.line for k, trace in fixed.items()}
    found = _through_crossings(followers, starts, known, frame, noise, scene)
    found = {k: trace for k, trace in found.items() if followers[k].long_enough(trace)}
    return _without_clashes(found, fixed)


def _at_clicks(clicked: Array, every: Sequence[Curve], apart: Array) -> list[tuple[int, int]]:
    """Clicks and their curves, no two the same; a curve that stands still costs more."""
    price = np.array(
        [
            [_price(click, curve, half) for curve in every]
            for click, half in zip(clicked, 0.5 * apart, strict=True)
        ]
    ).reshape(len(clicked), len(every))
    moves = np.array([curve.moved > _MOVES for curve in every], dtype=bool)
    length = np.array([curve.length for curve in every])
    for row in price:
        longest = length[moves & (row < 2.0 * LOST)].max(initial=0.0)
        row[~moves & (_COMPARABLE * length < longest)] += _STANDS
    rows, columns = optimize.linear_sum_assignment(np.minimum(price, 2.0 * LOST))
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return [(i, c) for i, c in pairs if price[i, c] < 2.0 * LOST]


def moving(frames: Sequence[Frame], scene: Scene, bases: Array, options: TraceOptions) -> Mask:
    """Whether the whisker at each base (n, 2) moves: in most frames the line there does."""
    apart = _spacing(bases)
    count = np.zeros(len(bases))
    for frame in frames:
        every = find_curves(scene.without_still(frame), scene, options, begins=bases)
        for i, c in _at_clicks(bases, every, apart):
            count[i] += every[c].moved > _MOVES
    return np.asarray(count > _MOSTLY * len(frames))


def _through_crossings(
    followers: Sequence[Follower],
    starts: Mapping[int, Array],
    known: Mapping[int, Array],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> dict[int, Trace]:
    """Whiskers known up to where they cross others, each traced to its own end."""
    _part(followers, {**known, **starts}, frame, scene)
    guesses = _continued(followers, starts, [*known.values()], frame, noise)
    lines, found = guesses, dict[int, Trace]()
    for _ in range(_ROUNDS):
        _part(followers, {**known, **lines}, frame, scene)
        found = {
            k: traced(frame, noise, guess, followers[k].options, clutter=followers[k].clutter)[0]
            for k, guess in guesses.items()
        }
        lines = {k: trace.line for k, trace in found.items()}
    return found


class _End(NamedTuple):
    """Possible continuation of a whisker beyond a crossing."""

    line: Array
    shown: Array  # what the image shows next to its first points
    cost: float


def _continued(
    followers: Sequence[Follower],
    starts: Mapping[int, Array],
    known: Sequence[Array],
    frame: Frame,
    noise: float,
) -> dict[int, Array]:
    """Continuations that keep the bend and that the image shows, no two of them to the same end."""
    if not starts:
        return {}
    most = max(2, min(_ENDS, int(_COMBINED ** (1.0 / len(starts)))))
    ends = [_ends(followers[k], start, frame, noise, most) for k, start in starts.items()]
    total = np.zeros([len(some) for some in ends])
    # What is seen counts once.
    for i, some in enumerate(ends):
        own = [end.cost + sum(_twice(end.shown, line) for line in known) for end in some]
        total += np.expand_dims(own, [j for j in range(len(ends)) if j != i])
        for j, others in enumerate(ends[:i]):
            both = [[_twice(b.shown, a.shown) for b in some] for a in others]
            total += np.expand_dims(both, [m for m in range(len(ends)) if m not in (i, j)])
    best = np.unravel_index(int(np.argmin(total)), total.shape)
    chosen = (some[c] for some, c in zip(ends, best, strict=True))
    return {
        k: np.concatenate([start, end.line[: len(end.shown) + _FURTHER]])
        for (k, start), end in zip(starts.items(), chosen, strict=True)
    }


def _twice(line: Array, other: Array) -> float:
    """Gain from the points of a line that another one shows too."""
    return _WORTH * len(line) * overlap(line, other)


def _shared(line: Array, other: Array) -> bool:
    """Whether one of two lines ends on the other."""
    return max(overlap(line[-_FAR:], other), overlap(other[-_FAR:], line)) >= SAME


def _ends(follower: Follower, start: Array, frame: Frame, noise: float, most: int) -> list[_End]:
    """Alternative continuations of a whisker, whose bend changes slowly."""
    lines, unlike = _fan(start)
    shown, counts, gains = (
        np.empty_like(lines),
        np.empty(len(lines), np.int64),
        np.empty(len(lines)),
    )
    scale = follower.options.scale
    measure_ends(frame, lines, noise, scale, *follower.clutter, _SUPPORTED, shown, counts, gains)
    ends = [_End(np.empty((0, 2)), np.empty((0, 2)), 0.0)]
    ends += [
        _End(line, points[:count], cost)
        for line, points, count, cost in zip(
            lines, shown, counts.tolist(), (unlike - _WORTH * gains).tolist(), strict=True
        )
    ]
    kept: list[_End] = []
    for end in sorted(ends, key=lambda one: one.cost):
        if len(kept) < most and not any(_shared(end.shown, other.shown) for other in kept):
            kept.append(end)
    return kept


def _fan(start: Array) -> tuple[Array, Array]:
    """Lines (line, point, 2) that continue a whisker's beginning, and the cost of each."""
    n = min(len(start), _POLYNOMIAL)
    curving, slope, begin = np.polyfit(STEP * np.arange(1 - n, 1), start[-n:], 2)
    bend = 2.0 * (slope[0] * curving[1] - slope[1] * curving[0]) / np.hypot(*slope) ** 3
    spread = np.hypot(_BENDS, _BEND_KNOWN / (STEP * n) ** 2)
    s = STEP * (np.arange(_AHEAD) + 0.5)
    bends, changes = np.linspace(-_WIDEST, _WIDEST, _FAN), np.arange(-2.0, 3.0)
    more, change = (grid.reshape(-1, 1) for grid in np.meshgrid(bends, changes, indexing="ij"))
    angle = np.arctan2(slope[1], slope[0]) + (bend + more * spread) * s
    angle += 0.5 * change * _BEND_CHANGES * s**2
    steps = STEP * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    return begin + np.cumsum(steps, axis=1), 0.5 * (more**2 + change**2)[:, 0]


def _straightened(
    followers: Sequence[Follower],
    own: Mapping[int, list[Trace]],
    fixed: Mapping[int, Trace],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> dict[int, list[Trace]]:
    """Retrace whiskers that end, or have a kink, at others, and so may have taken another's end."""
    before = {k: traces[-1] for k, traces in own.items() if traces and len(traces[-1].line)}
    starts = {}
    for k, trace in before.items():
        hidden = followers[k].clutter.hides(prolonged(trace.line, _FEWEST, _STOPPED))
        met = np.flatnonzero(hidden[_FEWEST:]) + _FEWEST
        if met.size and (hidden[-_STOPPED:].any() or _kink(trace) > _KINKED):
            starts[k] = trace.line[: met[0]]
    if not starts:
        return {}
    known = {k: trace.line for k, trace in (before | dict(fixed)).items() if k not in starts}
    found = _through_crossings(followers, starts, known, frame, noise, scene)
    better = {}
    for k, trace in found.items():
        longer = followers[k].length_of(trace) / max(followers[k].length_of(before[k]), STEP)
        straight = _kink(trace) < _STRAIGHTER * _kink(before[k])
        if straight and longer < 1.0 / _LONGER:
            # What is straight as it stops at an object, which may have bent it, is no better.
            ahead = prolonged(trace.line, _FEWEST, _STOPPED)[-_STOPPED:]
            straight = not followers[k].clutter.disturbs(ahead).any()
        if followers[k].long_enough(trace) and (straight or longer > _LONGER):
            better[k] = [trace]
    return better


def _kink(trace: Trace) -> float:
    """Root mean square distance of the seen part of a whisker from a smooth curve, pixels."""
    return 0.0 if trace.seen.sum() < _FEWEST else kink(trace.line, trace.seen)


def _price(click: Array, curve: Curve, half: float) -> float:
    """Cost of assigning a curve to the whisker that was clicked."""
    away = min(from_click(click, curve.line), _passed(click, curve.line)[0])
    return LOST * (away / min(CLICK, half)) ** 2 + _SHORT / (1.0 + curve.score / _LIKELY)


def _passed(click: Array, line: Array) -> tuple[float, int]:
    """Distance of a click from a line, which may start with hairs before it, and the point."""
    near = line[arc_lengths(line) < _HAIR]
    far = np.hypot(*(near - click).T) + _BEFORE * arc_lengths(near)
    at = int(np.argmin(far))
    return float(far[at]), at


def _up_to_a_crossing(line: Array, every: Sequence[Array]) -> Array:
    """The beginning of a line, until it meets another one."""
    others = [one for one in every if overlap(one, line) < _SAME_CURVE]
    if others:
        away, _ = spatial.cKDTree(np.concatenate(others)).query(line)
        met = np.flatnonzero((away < NEAR) & (np.arange(len(line)) >= _FEWEST))
        line = line[: met[0]] if met.size else line
    return line


def _seen(
    frame: Frame,
    pool: Sequence[Trace],
    found: Sequence[Trace],
    followers: Sequence[Follower],
    fixed: set[int],
) -> Seen:
    """Record of a frame: lines that were considered, and the whiskers found."""
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
    """Whiskers whose own lines are certain."""
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
    """Whiskers whose lines are not also those of others."""
    every = {**chosen, **fixed}
    clash = clashes([trace.line for trace in every.values()])
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
    """Distinct lines that may be whiskers, the longest first."""
    proposed = [trace for traces in own.values() for trace in traces if len(trace.line)]
    options = followers[0].options
    missing = [followers[k] for k in own if k not in clear]
    taken = [trace.line for trace in (*clear.values(), *fixed.values())]
    still = None if scene is None else scene.bits
    shape = (frame.shape[0], frame.shape[1])
    # For a whisker of which nothing is known yet all others are in the way.
    clutter = between_whiskers([*taken, None], still, shape, NEAR * options.scale)[-1]
    scene = scene or Scene.of([frame], options.scale)
    tried: list[Array] = [*taken]
    begins = np.array([follower.base for follower in followers])
    for curve in find_curves(frame, scene, options, begins=begins):
        if len(tried) - len(taken) >= _TRIED * len(missing):
            break
        if min(from_click(follower.base, curve.line) for follower in missing) > _NEAR:
            continue
        if any(overlap(curve.line, other) >= SAME for other in tried):
            continue
        tried.append(curve.line)
        proposed.append(traced(frame, noise, curve.line, options, clutter=clutter)[0])
    kept: list[Trace] = []
    for trace in sorted(proposed, key=lambda t: -t.support):
        if not len(trace.line):
            continue
        if any(overlap(trace.line, other.line) >= SAME for other in fixed.values()):
            continue
        if not any(same_whisker(trace, other, 4.0) for other in kept):
            kept.append(trace)
    return kept


def from_click(click: Array, line: Array) -> float:
    """Distance of a click from the beginning of a line, pixels.

    Along the line's own direction a click may be farther away, since the face hides the beginning.
    """
    ahead = line[min(_DIRECTION, len(line) - 1)] - line[0]
    ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
    away = line[0] - click
    along, across = float(away @ ahead), float(away[1] * ahead[0] - away[0] * ahead[1])
    return float(np.hypot(_ALONG * along, across))


def _distance_to_next(followers: Sequence[Follower]) -> Array:
    """Distance of each base from the nearest other one, pixels."""
    return _spacing(np.array([follower.base for follower in followers]))


def _spacing(bases: Array) -> Array:
    """Distance of each base from the nearest other one, pixels, at least two."""
    distance = np.linalg.norm(bases[:, None] - bases[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(np.maximum(distance.min(axis=1, initial=np.inf), 2.0))


def _assigned(
    followers: Sequence[Follower], pool: Sequence[Trace], features: Sequence[Array], apart: Array
) -> list[int]:
    """Cheapest assignment over all motions of the row, without whiskers in doubt."""
    costs = _Costs.of(followers, pool, features, 0.5 * apart)
    problem = Assignment(pool, np.array([follower.base for follower in followers]).reshape(-1, 2))
    lost = np.full(len(followers), LOST)
    least, best = np.inf, (0.0, 0.0, 0.0)
    for motion in costs.motions():
        cost, _ = problem.ways(costs.after(*motion[1:]), lost, least - motion[0], most=1)
        if len(cost):
            least, best = cost[0] + motion[0], motion
    _, ways = problem.ways(costs.after(*best[1:]), lost, least - best[0] + _DOUBT, most=_WAYS)
    chosen, *others = ways.tolist()

    def differs(c: int, d: int) -> bool:
        return c != d and (min(c, d) < 0 or not same_whisker(pool[c], pool[d]))

    return [-1 if any(differs(c, way[k]) for way in others) else c for k, c in enumerate(chosen)]


class _Costs(NamedTuple):
    """Costs of lines, by the distance of their beginning from where each whisker is expected."""

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
        price, offsets = np.full(shape, np.inf), np.zeros((*shape, len(POINTS)))
        longest = max((trace.support for trace in pool), default=1.0)
        looks = np.array(features).reshape(-1, FEATURES)
        for k, follower in enumerate(followers):
            expected, unlike = follower.expected, follower.appearance.unlikeness(looks)
            for c, trace in enumerate(pool):
                if not follower.long_enough(trace):
                    continue
                if expected is None:
                    away = from_click(follower.base, trace.line)
                    far = LOST * (away / min(CLICK, half[k])) ** 2
                elif aligned(expected, trace.line) > _ALIGNED:
                    offsets[k, c], far = sideways(expected, trace.line), 0.0
                else:
                    continue
                share = min(1.0, trace.support / (follower.usual or longest))
                price[k, c] = _SHORT * (1.0 - share) + unlike[c] + far
        reach = np.array([[follower.reach] for follower in followers])
        seen = np.array([follower.expected is not None for follower in followers], dtype=bool)
        return cls(price, offsets, reach, half[:, None], seen)

    def motions(self) -> list[tuple[float, float, float]]:
        """Cost, shift and turn of motions of the whole row that bring some whisker to some line.

        They are relative to the expected motion; the cheapest comes first.
        """
        arms = STEP * POINTS
        design = np.linalg.pinv(np.stack([np.ones(len(arms)), arms], axis=1))
        fits = self.offsets[np.isfinite(self.price) & self.seen[:, None]] @ design.T
        rounded = np.round(fits / [1.0, 0.02]) * [1.0, 0.02]
        both = np.concatenate([np.zeros((1, 2)), rounded, rounded * [0.0, 1.0]])
        # A row that shifts by half of its spacing might as well have shifted the other way.
        usable = (np.abs(both[:, 0]) < self.half.min()) & (np.abs(both[:, 1]) < _LARGEST_TURN)
        motions = np.unique(both[usable], axis=0)
        prices = LOST * ((motions / [_ROW_SHIFT, _ROW_TURN]) ** 2).sum(axis=1)
        order = np.argsort(prices, kind="stable")
        return [(float(prices[i]), *motions[i].tolist()) for i in order]

    def after(self, shift: float, turn: float) -> Array:
        """Cost of each line for each whisker after a motion of the row; infinite out of reach."""
        moved = (shift + turn * STEP * POINTS) * self.seen[:, None, None]
        away = np.abs(self.offsets - moved)
        mean = away.mean(axis=2) / self.reach
        near = (mean <= 1.0) & (away[:, :, 0] <= self.half)
        return np.where(near, self.price + LOST * mean**2, np.inf)


def _carry(
    followers: Sequence[Follower], before: Sequence[Array | None], found: Sequence[Trace]
) -> None:
    """Move lost whiskers as the others have moved."""
    turns, shifts = [], []
    for line, trace in zip(before, found, strict=True):
        if line is not None and len(trace.line):
            shifts.append(trace.line[0] - line[0])
            turns.append(motion_between(line, trace.line)[1])
    if turns:
        for follower, trace in zip(followers, found, strict=True):
            if not len(trace.line):
                follower.carry(float(np.median(turns)), np.median(shifts, axis=0))
