"""Several whiskers of one view in one frame: which line each of them has.

In the first frame each is followed from its click, through all crossings: where whiskers lie on one
another nothing is measured. From then on each is followed along where it is expected. Where there
is any doubt, all lines of the frame are found once, and the cheapest way to give lines to whiskers
is taken (`vibrissa.tracking.trace.identity`). Lines cost the more, the farther they begin from
where the whisker is expected, and the shorter they are; the whole row may have turned and shifted
by more than was expected, at a price of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from vibrissa.io import Frame
from vibrissa.tracking.trace.clutter import NEAR, between_whiskers
from vibrissa.tracking.trace.curves import Curve, find_curves
from vibrissa.tracking.trace.follower import Follower, features_of
from vibrissa.tracking.trace.identity import (
    LOST,
    POINTS,
    SAME,
    Assignment,
    Seen,
    Way,
    clashes,
    motion_between,
    same_whisker,
    sideways,
)
from vibrissa.tracking.trace.ridge import noise_level, prolonged, traced
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.trace import STEP, Trace, even, given, overlap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_DOUBT = 0.6
"""Least difference to a way that gives a whisker another line."""

_ROUNDS = 3
"""Number of rounds in which whiskers are kept apart where they cross."""

_SHORT = 3.0
"""Cost of a line that is hardly seen."""

_ROW_TURN, _ROW_SHIFT = 0.1, 5.0
"""Turn, rad, and shift, pixels, of the whole row in a frame that cost as much as a lost whisker."""

_UNLIKE = 3.0
"""Unlikeness above which a whisker's own line is in doubt."""

_NEAR = 40.0
"""Distance from a base within which lines begin that are searched without expectations, pixels."""

_MERGED = 0.8
"""Share of a line that lies on others from which they are not kept apart."""

_TRIED = 4
"""Number of lines that are measured for each whisker that is missing."""

_ALONG, _DIRECTION = 0.4, 10
"""Weight of a click's distance along a line, and number of points that give its direction."""

_LIKELY = 100.0
"""Score of a curve from which it is likely to be a whisker."""

_SAME_CURVE = 0.9
"""Share of a line along another one from which both are the same curve."""

_FEWEST, _POLYNOMIAL, _AHEAD = 15, 60, 150
"""Numbers of points: of a whisker's beginning, of what gives its bend, and by which it goes on."""

_KINKED, _SMOOTH, _STRAIGHTER = 0.25, 4, 0.7
"""Distance of a whisker from a smooth curve from which it may have a kink, pixels, the degree of
that curve's polynomials, and the share of a kink that may be left."""

_LARGEST_TURN = 0.35
"""Largest turn of the row between frames beyond what was expected, rad."""

_ALIGNED = 0.7
"""Cosine of the largest angle between the directions of a line and of the expected one."""

_CLICK = 12.0
"""Distance from a click that costs as much as a lost whisker, pixels, at most half of that to the
next base."""


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
    if all(line is None for line in before) and free:
        chosen = clear = _begun(followers, fixed, frame, noise, scene)
    else:
        own |= _straightened(followers, own, fixed, frame, noise, scene)
        chosen = clear = _clearly(followers, own, fixed, frame)
    if len(clear) < len(free):
        own = {k: [clear[k]] if k in clear else traces for k, traces in own.items()}
        pool = _pool(followers, own, clear, fixed, frame, noise, scene)
        features = [features_of(frame, trace, followers[0].clutter) for trace in pool]
        apart = _distance_to_next(followers)
        lines = _assigned([followers[k] for k in free], pool, features, apart[free])
        chosen = {k: pool[c] for k, c in zip(free, lines, strict=True) if c >= 0}
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
    followers: Sequence[Follower],
    lines: Mapping[int, Array],
    frame: Frame,
    scene: Scene | None,
) -> None:
    """Let nothing be measured where whiskers lie on one another, on known or expected lines."""
    every = [lines.get(k, follower.expected) for k, follower in enumerate(followers)]
    still = None if scene is None else scene.bits
    near = NEAR * followers[0].options.scale
    parted = between_whiskers(every, still, (frame.shape[0], frame.shape[1]), near)
    for follower, line, clutter in zip(followers, every, parted, strict=True):
        alone = line is not None and clutter.hides(line).mean() < _MERGED
        follower.clutter = clutter if alone else clutter.still_only


def _begun(
    followers: Sequence[Follower],
    fixed: Mapping[int, Trace],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> dict[int, Trace]:
    """Whiskers in the first frame, each where it was clicked.

    Where whiskers cross, a line may go on as another one. So each is known up to there at first,
    and followed beyond as it bends until there, with what others hide left out.
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
    apart = _distance_to_next(followers)[free]
    price = np.array(
        [
            [_price(click, curve, half) for curve in every]
            for click, half in zip(clicked, 0.5 * apart, strict=True)
        ]
    ).reshape(len(free), len(every))
    rows, columns = linear_sum_assignment(np.minimum(price, 2.0 * LOST))
    guesses = {
        free[i]: _up_to_a_crossing(every[c].line, [one.line for one in every])
        for i, c in zip(rows, columns, strict=True)
        if price[i, c] < 2.0 * LOST
    }
    known = {k: trace.line for k, trace in fixed.items()}
    found = _through_crossings(followers, guesses, known, frame, noise, scene)
    found = {k: trace for k, trace in found.items() if followers[k].long_enough(trace)}
    return _without_clashes(found, fixed)


def _through_crossings(
    followers: Sequence[Follower],
    guesses: Mapping[int, Array],
    known: Mapping[int, Array],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> dict[int, Trace]:
    """Whiskers along guessed lines, which show about where they cross one another and others."""
    lines, found = guesses, dict[int, Trace]()
    for _ in range(_ROUNDS):
        _part(followers, {**known, **lines}, frame, scene)
        found = {k: followers[k].along(frame, noise, g, "tight") for k, g in guesses.items()}
        lines = {k: trace.line for k, trace in found.items()}
    return found


def _straightened(
    followers: Sequence[Follower],
    own: Mapping[int, list[Trace]],
    fixed: Mapping[int, Trace],
    frame: Frame,
    noise: float,
    scene: Scene | None,
) -> dict[int, list[Trace]]:
    """Whiskers with a kink where they cross another one, as whose end theirs was taken, anew."""
    guesses, kinks = {}, {}
    for k, traces in own.items():
        if not traces or not len(traces[-1].line):
            continue
        line = traces[-1].line
        met = np.flatnonzero(followers[k].clutter.hides(line))
        met = met[met >= _FEWEST]
        if met.size and (kink := _kink(traces[-1])) > _KINKED:
            kinks[k], guesses[k] = kink, prolonged(line[: met[0]], _POLYNOMIAL, _AHEAD)
    if not guesses:
        return {}
    known = {k: traces[-1].line for k, traces in own.items() if traces and k not in guesses}
    known |= {k: trace.line for k, trace in fixed.items()}
    found = _through_crossings(followers, guesses, known, frame, noise, scene)
    return {
        k: [trace]
        for k, trace in found.items()
        if followers[k].long_enough(trace) and _kink(trace) < _STRAIGHTER * kinks[k]
    }


def _kink(trace: Trace) -> float:
    """Root mean square distance of what is seen of a whisker from a smooth curve, pixels."""
    points = trace.line[trace.seen]
    if len(points) < _FEWEST:
        return 0.0
    t = np.linspace(-1.0, 1.0, len(trace.line))[trace.seen]
    basis = np.vander(t, _SMOOTH + 1)
    left = points - basis @ np.linalg.lstsq(basis, points)[0]
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def _price(click: Array, curve: Curve, half: float) -> float:
    """Cost of taking a curve for the whisker that was clicked."""
    away = LOST * (_from_click(click, curve.line) / min(_CLICK, half)) ** 2
    return away + _SHORT / (1.0 + curve.score / _LIKELY)


def _up_to_a_crossing(line: Array, every: Sequence[Array]) -> Array:
    """The beginning of a line, until it meets another one, prolonged as a parabola."""
    line = even(line)
    others = [one for one in every if overlap(one, line) < _SAME_CURVE]
    if others:
        away, _ = cKDTree(np.concatenate(others)).query(line)
        met = np.flatnonzero((away < NEAR) & (np.arange(len(line)) >= _FEWEST))
        line = line[: met[0]] if met.size else line
    return prolonged(line, _POLYNOMIAL, _AHEAD)


def _seen(
    frame: Frame,
    pool: Sequence[Trace],
    found: Sequence[Trace],
    followers: Sequence[Follower],
    fixed: set[int],
) -> Seen:
    """What a frame shows: lines that were considered, and who was found where."""
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
    """Whiskers about whose own lines there is no doubt."""
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
    """Whiskers whose lines are nobody else's."""
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
    """Different lines that may be whiskers, the longest first."""
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
        if min(_from_click(follower.base, curve.line) for follower in missing) > _NEAR:
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


def _from_click(click: Array, line: Array) -> float:
    """Distance of a click from the beginning of a line, pixels.

    Along the line's own direction a click may miss by more: the face hides where that begins.
    """
    ahead = line[min(_DIRECTION, len(line) - 1)] - line[0]
    ahead = ahead / max(float(np.hypot(*ahead)), 1e-9)
    away = line[0] - click
    along, across = float(away @ ahead), float(away[1] * ahead[0] - away[0] * ahead[1])
    return float(np.hypot(_ALONG * along, across))


def _distance_to_next(followers: Sequence[Follower]) -> Array:
    """Distance of each base from the nearest other one, pixels."""
    bases = np.array([follower.base for follower in followers])
    distance = np.linalg.norm(bases[:, None] - bases[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(np.maximum(distance.min(axis=1, initial=np.inf), 2.0))


def _assigned(
    followers: Sequence[Follower], pool: Sequence[Trace], features: Sequence[Array], apart: Array
) -> Way:
    """The cheapest way, whatever the row's motion, without whiskers in doubt."""
    costs = _Costs.of(followers, pool, features, 0.5 * apart)
    problem = Assignment(pool, np.array([follower.base for follower in followers]).reshape(-1, 2))
    lost = np.full(len(followers), LOST)
    least, best = np.inf, (0.0, 0.0, 0.0)
    for motion in costs.motions():
        cheapest = next(problem.ways(costs.after(*motion[1:]), lost, least - motion[0]), None)
        if cheapest is not None:
            least, best = cheapest[0] + motion[0], motion
    ways = problem.ways(costs.after(*best[1:]), lost, least - best[0] + _DOUBT)
    _, chosen = next(ways)
    others = [way for _, way in ways]

    def differs(c: int, d: int) -> bool:
        return c != d and (min(c, d) < 0 or not same_whisker(pool[c], pool[d]))

    return tuple(
        -1 if any(differs(c, way[k]) for way in others) else c for k, c in enumerate(chosen)
    )


class _Costs(NamedTuple):
    """Costs of lines, by how far they begin from where each whisker is expected."""

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
        for k, follower in enumerate(followers):
            expected = follower.expected
            for c, trace in enumerate(pool):
                if not follower.long_enough(trace):
                    continue
                if expected is None:
                    away = _from_click(follower.base, trace.line)
                    far = LOST * (away / min(_CLICK, half[k])) ** 2
                elif _aligned(expected, trace.line) > _ALIGNED:
                    offsets[k, c], far = sideways(expected, trace.line), 0.0
                else:
                    continue
                share = min(1.0, trace.support / (follower.usual or longest))
                unlike = follower.appearance.unlikeness(features[c])
                price[k, c] = _SHORT * (1.0 - share) + unlike + far
        reach = np.array([[follower.reach] for follower in followers])
        seen = np.array([follower.expected is not None for follower in followers], dtype=bool)
        return cls(price, offsets, reach, half[:, None], seen)

    def motions(self) -> list[tuple[float, float, float]]:
        """Price, shift and turn of motions of the whole row that bring some whisker to some line.

        They are relative to what is expected; the cheapest comes first.
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
        """Cost of each line for each whisker if the row has moved; infinite beyond its reach."""
        moved = (shift + turn * STEP * POINTS) * self.seen[:, None, None]
        away = np.abs(self.offsets - moved)
        mean = away.mean(axis=2) / self.reach
        near = (mean <= 1.0) & (away[:, :, 0] <= self.half)
        return np.where(near, self.price + LOST * mean**2, np.inf)


def _carry(
    followers: Sequence[Follower], before: Sequence[Array | None], found: Sequence[Trace]
) -> None:
    """Let those that are lost move as those that are found did."""
    turns, shifts = [], []
    for line, trace in zip(before, found, strict=True):
        if line is not None and len(trace.line):
            shifts.append(trace.line[0] - line[0])
            turns.append(motion_between(line, trace.line)[1])
    if turns:
        for follower, trace in zip(followers, found, strict=True):
            if not len(trace.line):
                follower.carry(float(np.median(turns)), np.median(shifts, axis=0))


def _aligned(expected: Array, line: Array) -> float:
    """Cosine between the directions in which two lines begin."""
    i = min(int(POINTS[-1]), len(expected) - 1, len(line) - 1)
    a, b = expected[i] - expected[0], line[i] - line[0]
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))
