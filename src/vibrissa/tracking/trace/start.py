"""Start of a whisker: the whisker that several frames of all views agree on.

In one view or one frame, a hair or the glint of a peg may look more like a whisker than the whisker
does. In each of some frames, candidate lines are combined, one of each view. A combination has more
weight the more its lines look like whiskers and the better the views agree about its base and its
tip. The bases with the most weight over all frames are chosen.

Static lines are left out unless nothing moves. Where a view shows the whisker in front of the
animal itself, it does not show where the whisker begins; the other views do.

In front of grey fur a whisker is a faint line among hairs that are as dark, and hard to see in that
view alone. Another view, which shows it in front of open ground, leaves one unknown for each of its
points: the distance t along its epipolar line. Of all smooth t(s), dynamic programming over t and
its slope finds the one along which the image is most like a line (`seen_along`): with the curvature
of the smoothed image across the curve in units of its noise, r, which is positive on dark lines,

    Σ r(s, t, t′) − _TURN · (number of changes of slope) → max

The same for the inverted image gives the score of fur and noise alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.io import Frame
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.trace.curves import Curve, find_curves, smoothed
from vibrissa.tracking.trace.ends import inside
from vibrissa.tracking.trace.follower import start_at
from vibrissa.tracking.trace.ridge import noise_level
from vibrissa.tracking.trace.scene import Bodies, Image, Scene
from vibrissa.tracking.trace.trace import (
    Bits,
    Clutter,
    TraceOptions,
    arc_lengths,
    interpolated,
    overlap,
)

_SPACING = 4.0  # distance of the points that are searched, pixels
_STEEP = 8  # largest change of t from one point to the next, pixels
_SLOPES = np.arange(-_STEEP, _STEEP + 1)

_TURN = 0.3  # cost of changing the slope by a pixel
_MOST = 12.0  # strength, in units of the noise, at which the score of a line saturates
_APART = 8.0  # distance from the dark curve within which its own flanks are bright, pixels
# Number of points next to the base that show whether the line begins there, and the smallest share
# of them before a body: where less is, the view by itself shows where the whisker begins.
_NEXT, _MOSTLY = 10, 0.75


def seen_along(
    curve: Curve, known: Camera, camera: Camera, frame: Frame, scene: Scene
) -> Curve | None:
    """Find a moving line along a curve that another camera sees; None if that is out of view."""
    s = arc_lengths(curve.line)
    wanted = np.linspace(0.0, s[-1], max(int(s[-1] / _SPACING), 2) + 1)
    start, along = epipolar_lines(interpolated(wanted, s, curve.line), known, camera)
    far = int(np.hypot(*camera.size))
    points = start[:, None] + np.arange(-far, far + 1)[:, None] * along[:, None]
    within = (points > 0.0) & (points < np.array(camera.size) - 1.0)
    in_image = np.asarray(within.all(axis=2))
    rows = np.flatnonzero(in_image.any(axis=0))
    if not rows.size:
        return None
    points = points[:, rows[0] : rows[-1] + 1]
    in_image = in_image[:, rows[0] : rows[-1] + 1]
    bodies = scene.bodies(frame)
    smooth, factors = smoothed(scene.change(frame), bodies)
    middle = points[:, points.shape[1] // 2]
    ways = np.gradient(middle, axis=0)[:, None] + _SLOPES[:, None] * along[:, None]
    strength = _strengths(points, ways, smooth, factors, bodies)
    dark, path = _best_path(strength + np.where(in_image, 0.0, -_MOST)[:, None])
    line = points[np.arange(len(points)), path]
    apart = np.linalg.norm(points - line[:, None], axis=2) > _APART
    bright, _ = _best_path(-strength + np.where(in_image & apart, 0.0, -_MOST)[:, None])
    # Its beginning is in front of a body, where the other view shows it: the line does not extend
    # beyond.
    on_body = float(np.mean(bodies.at(line[:_NEXT]) != 0))
    back = line[0] - line[min(_NEXT, len(line) - 1)]
    part = np.concatenate([line[0] + np.linspace(1.0, 0.0, _NEXT + 1)[:-1, None] * back, line])
    ways = np.gradient(part, axis=0)[:, None]
    seen = _strengths(part[:, None], ways, smooth, factors, bodies)[:, 0, 0]
    noise, before, first = bright / len(line), seen[:_NEXT].mean(), seen[_NEXT:][:_NEXT].mean()
    rest = max(noise / max(dark / len(line), 1e-9), max(noise, before) / max(first, 1e-9), 0.0)
    clear = max(1.0 - float(rest), 0.0) if on_body > _MOSTLY else 0.0
    length = float(arc_lengths(line)[-1])
    return Curve(line, length, from_face=False, score=length * clear, moved=1.0)


def epipolar_lines(pixels: Array, known: Camera, camera: Camera) -> tuple[Array, Array]:
    """Points (n, 2) in a view for points of another one, and directions of epipolar lines."""
    middle = np.broadcast_to(0.5 * (np.array(camera.size) - 1.0), pixels.shape)
    point, _ = triangulate([known, camera], np.stack([pixels, middle]))
    origin, ray = known.rays(pixels)
    point = origin + ((point - origin) * ray).sum(axis=1, keepdims=True) * ray
    start, slopes = camera.project_with_slopes(point)
    along = (slopes @ ray[..., None])[..., 0]
    return start, along / np.linalg.norm(along, axis=1, keepdims=True)


def _strengths(points: Array, ways: Array, smooth: Image, factors: Array, bodies: Bodies) -> Array:
    """Darkness (n, m, t) of a line through points (n, t, 2) in directions (n, m, 2)."""
    height, width = smooth.shape
    column = np.rint(points[..., 0]).astype(np.intp).clip(1, width - 2)
    row = np.rint(points[..., 1]).astype(np.intp).clip(1, height - 2)
    twice = 2.0 * smooth[row, column]
    xx = smooth[row, column - 1] + smooth[row, column + 1] - twice
    yy = smooth[row - 1, column] + smooth[row + 1, column] - twice
    xy = smooth[row - 1, column - 1] + smooth[row + 1, column + 1]
    xy = 0.25 * (xy - smooth[row - 1, column + 1] - smooth[row + 1, column - 1])
    on_body = bodies.at(points.reshape(-1, 2)).reshape(row.shape) != 0
    factor = factors[on_body.astype(np.intp)]
    ways = ways / np.maximum(np.linalg.norm(ways, axis=2, keepdims=True), 1e-9)
    # The normal is (−y, x) of the direction.
    x, y = ways[:, :, 0, None], ways[:, :, 1, None]
    across = y * y * xx[:, None] - 2.0 * x * y * xy[:, None] + x * x * yy[:, None]
    return np.asarray(np.clip(-across * factor[:, None], -_MOST, _MOST))


def _best_path(reward: Array) -> tuple[float, NDArray[np.intp]]:
    """Largest sum of rewards (n, slope, t) along a smooth path, and its t, (n,)."""
    count = reward.shape[2]
    before = np.arange(count) - _SLOPES[:, None]
    outside = (before < 0) | (before >= count)
    before = before.clip(0, count - 1)
    total, came = reward[0], []
    for one in reward[1:]:
        near = np.pad(total, ((1, 1), (0, 0)), constant_values=-np.inf)
        choices = np.stack([near[1:-1], near[:-2] - _TURN, near[2:] - _TURN])
        chosen = choices.argmax(axis=0)
        best = np.take_along_axis(choices.max(axis=0), before, axis=1)
        came.append(np.take_along_axis(chosen, before, axis=1))
        total = one + np.where(outside, -np.inf, best)
    slope, t = (int(k) for k in np.unravel_index(total.argmax(), total.shape))
    path, best_total = [t], float(total[slope, t])
    for chosen in reversed(came):
        change = (0, -1, 1)[chosen[slope, t]]
        t, slope = t - int(_SLOPES[slope]), slope + change
        path.append(t)
    return best_total, np.array(path[::-1])


FRAMES = 30
"""Number of frames in which a start is best found."""

_VOTES = 10  # number of those in which whiskers are searched
_LINES = 8  # largest number of lines of a view that are combined
_GAP = 6.0  # standard deviation of bases about their position by the other views, pixels
# The same of tips, which are cut where they are faint: as a share of the length. Where something
# hides one they may be anywhere.
_TIP = 0.15
# Distance within which tips of one whisker agree where both views show them, pixels, and the
# smallest share of frames in which they do: less than half, for they may be faint.
_TOGETHER, _SELDOM = 3.0, 0.2
# Distance before which something still may cut a line, pixels, number of the last points that give
# its direction, and share of the frames in which tips must be open to be compared.
_CUT, _LAST, _ENDING = 16.0, 10, 0.3
_SAME = 25.0  # largest distance between bases of one whisker in two frames, pixels
_MOVED = 0.4  # moving share of a whisker above which all of it counts as moving
_BETTER = 1.5  # factor by which more of a bright whisker must be seen than of a dark one
# Scores above which a line is a whisker rather than a hair: likely, and without doubt.
_LONG, _CERTAIN = 80.0, 200.0
# Factors of the confidence if one view alone shows where the whisker begins, and if what does not
# move begins at no face.
_ONE_VIEW, _NO_FACE = 0.85, 0.5
# How much better a whisker of another view is seen than noise would be, as a share of itself, from
# which it is clearly seen. Without one it is 0.1 to 0.2.
_CLEARLY = 0.5
# Number of candidates that are compared, and share of its line from which one is another one.
_SHOWN, _ALIKE = 4, 0.5
_FAINTEST = 0.05  # confidence from which another candidate is shown
_POLARITY = 3  # number of frames in which bright and dark whiskers are compared
# Distance of the pixels from which the brightest bodies are known, the share that is less bright,
# how much brighter than that the brightest are, and brightness at least, relative to the median.
_SPARSE, _BRIGHTEST, _BRIGHTER, _OPEN = 8, 0.99, 1.1, 3.0
_SURE, _GUESS = 0.5, 0.2  # confidence below which there is doubt, and below which nothing is found


class Candidate(NamedTuple):
    """Line that may be the whisker.

    Attributes
    ----------
    bases : list of array (2,)
        Column and row of its base in each view.
    lines : list of array (n, 2)
        Line in each view.
    confidence : float
        Confidence between 0 and 1, on the scale of that of `Start`.
    """

    bases: list[Array]
    lines: list[Array]
    confidence: float


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a whisker on which several frames of all views agree.

    Parameters
    ----------
    bases : list of array (2,), or None
        Column and row of its base in each view, in the first frame that shows it clearly; None if
        views show no line in common.
    lines : list of array (n, 2)
        Lines that are taken for the whisker, view by view, in the frame in which it is seen best;
        without points where there is nothing.
    frame : int
        Number of that frame.
    begins : int
        Number of the first frame that shows it.
    bright : bool
        Whether whiskers are bright on a dark background.
    confidence : float
        Confidence between 0 and 1: how much more frames show this than anything else.
    agreed : tuple of int
        Number of frames in which nothing else is likelier, and number of frames.
    doubts : tuple of str
        Reasons why it may be wrong, a sentence each.
    others : tuple of Candidate
        Other lines that may be the whisker, the likeliest first.
    """

    bases: list[Array] | None
    lines: list[Array]
    frame: int
    begins: int
    bright: bool
    confidence: float
    agreed: tuple[int, int]
    doubts: tuple[str, ...]
    others: tuple[Candidate, ...] = ()


class _Combination(NamedTuple):
    """A line of each view, in one frame."""

    frame: int
    worth: float
    bases: Array  # (view, 2)
    gap: float
    tip_gap: float  # as a share of the length
    share: float  # score of its lines relative to the best of their views
    curves: tuple[Curve, ...]


def negative(frame: Frame, white: float = np.inf) -> Frame:
    """Invert the brightness; what is as bright as ``white``, or brighter, becomes black."""
    most = frame.dtype.type(min(np.iinfo(frame.dtype).max, white))
    return np.asarray(most - np.minimum(frame, most), dtype=frame.dtype)


def _negatives(frames: Sequence[Frame]) -> list[Frame]:
    """Negatives in which the brightest bodies on a dark ground are black, as a face would be."""
    some = np.stack([frame[::_SPARSE, ::_SPARSE] for frame in frames])
    bodies = _BRIGHTER * float(np.quantile(some, _BRIGHTEST))
    white = max(bodies, _OPEN * float(np.median(some)))
    return [negative(frame, white) for frame in frames]


def is_bright(
    frames: Sequence[Frame],
    bases: Sequence[Sequence[ArrayLike] | None] | None = None,
    options: TraceOptions | None = None,
) -> bool:
    """Whether whiskers are bright on a dark background: seen clearly better in inverted frames.

    The frames of all views decide together: before a body, or next to an object with stripes, one
    view may show lines of either kind. ``bases`` are columns and rows where whiskers begin, view by
    view.
    """
    options = options or TraceOptions()
    if options.bright is not None:
        return options.bright
    dark, bright = 0.0, 0.0
    for frame, begins in zip(frames, bases or [None] * len(frames), strict=True):
        dark += _seen(frame, begins, options)
        bright += _seen(negative(frame), begins, options)
    return bright > _BETTER * dark


def _seen(frame: Frame, bases: Sequence[ArrayLike] | None, options: TraceOptions) -> float:
    """Clarity of lines seen, one for each base: length over the standard deviation of points."""
    if bases is None:
        curves = find_curves(frame, Scene.of([frame], options.scale), options)
        return max((curve.score for curve in curves), default=0.0)
    noise = noise_level(frame)
    lines = [
        (trace.clearness, k, trace.line)
        for k, base in enumerate(bases)
        for trace in start_at(base, options).from_base(frame, noise)
    ]
    # One line, such as a glint next to all bases, is not that of several whiskers.
    taken = dict[int, tuple[float, Array]]()
    for clear, k, line in sorted(lines, key=lambda each: -each[0]):
        if k not in taken and all(overlap(line, one) < _ALIKE for _, one in taken.values()):
            taken[k] = clear, line
    return sum(clear for clear, _ in taken.values())


def find_start(
    cameras: Sequence[Camera],
    frames: Sequence[Sequence[Frame]],
    options: TraceOptions | None = None,
    masks: Sequence[Mask | None] | None = None,
) -> Start:
    """Find the whisker that all views agree on.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    frames : sequence of sequence of array (height, width)
        Frames of the same moments, view by view, the first of the film first. Some 30 that are
        spread over a whisk or more distinguish the whisker from what does not move.
    options : TraceOptions, optional
        Settings of tracing; ``bright``, unless None, is not asked.
    masks : sequence of (array (height, width) of bool, or None), optional
        Pixels of each view in which no whisker is.

    Returns
    -------
    Start
        Bases and lines that were found, with their confidence and what there is to doubt.

    Raises
    ------
    ValueError
        If views and cameras do not fit, or there is no frame.
    """
    options = options or TraceOptions()
    counts = {len(view) for view in frames}
    if len(frames) != len(cameras) or len(counts) != 1 or 0 in counts:
        raise ValueError(
            f"{len(cameras)} cameras and {[len(view) for view in frames]} frames in the views do "
            "not fit: every view needs as many, one at least"
        )
    search, bright = _Search.of(cameras, frames, options, masks), bool(options.bright)
    if options.bright is not False:
        inverted = [_negatives(view) for view in frames]
        other = _Search.of(cameras, inverted, replace(options, bright=True), masks)
        few = search.moments(_POLARITY)
        bright = bright or other.worth(few) > _BETTER * search.worth(few)
        search = other if bright else search
    return _start(search, search.vote(), bright)


@dataclass(frozen=True, eq=False)
class _Search:
    """Views in which whiskers are dark."""

    cameras: Sequence[Camera]
    frames: Sequence[Sequence[Frame]]
    scenes: Sequence[Scene]
    options: TraceOptions
    known: dict[tuple[int, int], list[Curve]] = field(default_factory=dict)
    still: dict[int, Bits | None] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        cameras: Sequence[Camera],
        frames: Sequence[Sequence[Frame]],
        options: TraceOptions,
        masks: Sequence[Mask | None] | None,
    ) -> _Search:
        pairs = zip(frames, masks or [None] * len(frames), strict=True)
        scenes = [Scene.of(view, options.scale, mask) for view, mask in pairs]
        return cls(cameras, frames, scenes, options)

    def moments(self, count: int) -> list[int]:
        """Frames spread over the film, the first among them."""
        whole = len(self.frames[0])
        return sorted({int(i) for i in np.linspace(0, whole - 1, min(count, whole))})

    def vote(self) -> _Vote:
        """Choice of most frames among moving lines, or if nothing moves, among all lines."""
        moments = self.moments(_VOTES)
        views = range(len(self.cameras))
        vote = _voted([self._combined(m, self.curves(m)) for m in moments])
        if vote.confidence >= _SURE:
            return vote
        shown = [self._shown(view, moments) for view in views]
        if not any(shown):
            found = [self._combined(m, self.curves(m, resting=views)) for m in moments]
            return self._resting(_voted(found))
        # A view that shows the whisker before the animal does not show where it begins, and one
        # toward which it swings does not show that it moves.
        hardly = [view for view in views if any(shown[:view] + shown[view + 1 :])]
        for search in (self._faint, self._in_depth):
            if vote.confidence < _SURE:
                ways = [search(view, moments) for view in hardly]
                vote = max([vote, *ways], key=lambda one: one.confidence)
        return vote

    def _in_depth(self, view: int, moments: Sequence[int]) -> _Vote:
        """Choice if one view is along the whisker's motion, so that it hardly moves there."""
        vote = _voted([self._combined(m, self.curves(m, resting=[view])) for m in moments])
        from_face = all(one.curves[view].from_face for one in vote.winners)
        return vote._replace(confidence=vote.confidence * (1.0 if from_face else _NO_FACE))

    def _faint(self, view: int, moments: Sequence[int]) -> _Vote:
        """Choice if one view shows the whisker only along the epipolar lines of another."""
        vote = _voted([self._along(m, view) for m in moments])
        clear = [one.curves[view].score / one.curves[view].length for one in vote.winners]
        seen = min(1.0, float(np.median(clear)) / _CLEARLY) if clear else 0.0
        name, confidence = self.cameras[view].name, _ONE_VIEW * seen * vote.confidence
        return vote._replace(hidden=name, confidence=confidence)

    def _resting(self, vote: _Vote) -> _Vote:
        """Choice among static lines, if a motion would have been visible."""
        if all(scene.background is None for scene in self.scenes):
            return vote
        from_face = all(curve.from_face for one in vote.winners for curve in one.curves)
        confidence = vote.confidence * (1.0 if from_face else _NO_FACE)
        return vote._replace(moves=False, confidence=confidence)

    def curves(self, moment: int, resting: Sequence[int] = ()) -> list[list[Curve]]:
        """Candidate lines, the most probable first: moving ones, except in some views."""
        found = []
        for view in range(len(self.cameras)):
            curves = self._found(view, moment)
            if view not in resting:
                curves = [c._replace(score=c.score * min(1.0, c.moved / _MOVED)) for c in curves]
            found.append(sorted(curves, key=lambda curve: -curve.score)[:_LINES])
        return found

    def _found(self, view: int, moment: int) -> list[Curve]:
        key = view, moment
        if key not in self.known:
            frame, scene = self.frames[view][moment], self.scenes[view]
            lit = scene.lit(frame)
            self.known[key] = find_curves(frame, scene, self.options) if lit else []
        return self.known[key]

    def _shown(self, view: int, moments: Sequence[int]) -> bool:
        """Whether a view alone shows a long moving line in half of the frames."""
        best = [max((c.score for c in self.curves(m)[view]), default=0.0) for m in moments]
        return self.scenes[view].background is not None and float(np.median(best)) > _LONG

    def _along(self, moment: int, view: int) -> list[_Combination]:
        """Whiskers of one view, with the faint lines of another view along them."""
        found, camera = self.curves(moment), self.cameras[view]
        first = next(other for other in range(len(found)) if other != view)
        frame, scene = self.frames[view][moment], self.scenes[view]
        pairs: list[_Combination] = []
        for curve in found[first][:2]:
            seen = seen_along(curve, self.cameras[first], camera, frame, scene)
            if seen is not None:
                one = list(found)
                one[first], one[view] = [curve], [seen]
                pairs += self._combined(moment, one)
        return sorted(pairs, key=lambda pair: -pair.worth)

    def _combined(self, moment: int, curves: list[list[Curve]]) -> list[_Combination]:
        curves = [[curve for curve in view if curve.score > 0.0] for view in curves]
        every = list(product(*curves))
        if not every:
            return []
        ends = np.array([[[c.line[0], c.line[-1]] for c in one] for one in every])
        gaps = base_gap(self.cameras, np.moveaxis(ends, 1, 0))
        best = [view[0].score for view in curves]
        cut = [{id(c): self._cut(view, c) for c in row} for view, row in enumerate(curves)]
        found = []
        for one, bases, (gap, tip_gap) in zip(every, ends[:, :, 0], gaps, strict=True):
            tip = float(tip_gap) / min(curve.length for curve in one)
            worth = float(np.exp(np.mean([np.log(max(c.score, 1e-9)) for c in one])))
            # What cuts a line in one view hides its tip there.
            hidden = any(known[id(c)] for known, c in zip(cut, one, strict=True))
            apart = min(tip, _TIP) if hidden else tip
            worth *= np.exp(-0.5 * (gap / _GAP) ** 2) / (1.0 + (apart / _TIP) ** 2)
            share = min(c.score / most for c, most in zip(one, best, strict=True))
            if worth > 1.0:
                found.append(_Combination(moment, worth, bases, float(gap), tip, share, one))
        return sorted(found, key=lambda one: -one.worth)

    def ends(self, one: _Combination) -> bool:
        """Whether a line ends freely in all views."""
        return not any(self._cut(view, curve) for view, curve in enumerate(one.curves))

    def _cut(self, view: int, curve: Curve) -> bool:
        """Whether something static or the image's border may cut a line, or saturated ground."""
        if view not in self.still:
            base, frames = curve.line[:1], self.frames[view]
            self.still[view] = self.scenes[view].with_still(base, frames).bits
        bits, (before, last) = self.still[view], curve.line[[-_LAST, -1]]
        ahead = np.linspace(0.0, _CUT, 9)[:, None] * (last - before)
        ahead = last + ahead / max(float(np.hypot(*(last - before))), 1e-9)
        frame = self.frames[view][0]
        size = np.array(frame.shape[::-1]) - 1.0
        if ((ahead < 0.0) | (ahead > size)).any():
            return True
        column, row = np.rint(ahead).astype(np.intp).T
        if np.median(frame[row, column]) >= np.iinfo(frame.dtype).max:
            return True
        return bits is not None and bool(Clutter(bits, 0).disturbs(ahead).any())

    def worth(self, moments: Sequence[int]) -> float:
        """Evidence of whiskers in some frames."""
        found = [self._combined(m, self.curves(m)) for m in moments]
        return sum(row[0].worth for row in found if row)


class _Vote(NamedTuple):
    """Lines chosen by most frames."""

    winners: list[_Combination]  # of the frames that show it
    confidence: float
    # Number of frames in which nothing else is more probable, and number of frames.
    agreed: tuple[int, int]
    # With their weight relative to the winners.
    others: Sequence[tuple[float, list[_Combination]]] = ()
    moves: bool = True
    hidden: str = ""  # the view that shows it only along the lines of sight of another


def _voted(found: Sequence[Sequence[_Combination]]) -> _Vote:
    """Choose the bases with the most weight over all frames."""
    left = [list(row) for row in found]

    def supporters(center: _Combination) -> list[_Combination]:
        near = ([one for one in row if _near(one, center)][:1] for row in left)
        return [one for first in near for one in first]

    ranked: list[list[_Combination]] = []
    while any(left) and len(ranked) < _SHOWN:
        firsts = (one for row in left for one in row[:3])
        best = max(firsts, key=lambda one: sum(other.worth for other in supporters(one)))
        ranked.append(supporters(best))
        left = [[one for one in row if not _near(one, best)] for row in left]
    if not ranked:
        return _Vote([], 0.0, (0, len(found)))
    winners = ranked[0]
    total, *rest = (sum(one.worth for one in row) for row in ranked)
    rival = max(rest, default=0.0)
    agreed = sum(any(one is row[0] for row in found if row) for one in winners)
    # A whisker that omits the best line of a view is in doubt, whatever the others show.
    share = min(1.0, 2.0 * float(np.median([one.share for one in winners])))
    gap = float(np.median([one.gap for one in winners]))
    sure = share * float(np.exp(-0.5 * (gap / _GAP) ** 2))
    scores = np.median([[curve.score for curve in one.curves] for one in winners], axis=0)
    sure *= min(1.0, float(scores.max()) / _CERTAIN)
    confidence = sure * agreed / len(found) * total / (total + rival)
    others = [(worth / total, row) for worth, row in zip(rest, ranked[1:], strict=True)]
    return _Vote(winners, confidence, (agreed, len(found)), others)


def _near(one: _Combination, other: _Combination) -> bool:
    return bool((np.hypot(*(one.bases - other.bases).T) < _SAME).all())


def _start(search: _Search, vote: _Vote, bright: bool) -> Start:
    """Summary of the choice, with reasons for doubt."""
    if not vote.winners or vote.confidence < _GUESS:
        moment = search.moments(_VOTES)[0]
        alone = [curves[0].line if curves else np.empty((0, 2)) for curves in search.curves(moment)]
        missing = [c.name for c, line in zip(search.cameras, alone, strict=True) if not len(line)]
        why = (
            f"nothing in {' and '.join(missing)} is like a whisker"
            if missing
            else "the views show no line that could be one whisker in space"
        )
        return Start(None, alone, moment, 0, bright, 0.0, vote.agreed, (why,))
    best = max(vote.winners, key=lambda one: one.worth)
    confidence, doubts = vote.confidence, []
    if not vote.moves:
        doubts.append("nothing that moves resembles a whisker; this line does not move")
    if vote.hidden and confidence < _SURE:
        doubts.append(f"{vote.hidden} hardly shows it along the lines of sight of the other view")
    if confidence < _SURE:
        first, count = vote.agreed
        why = "or others are nearly as likely, or it is as short as a hair"
        doubts.append(f"it is the likeliest in {first} of {count} frames, {why}")
    gap = float(np.median([one.gap for one in vote.winners]))
    if gap > 0.5 * _GAP:
        doubts.append(f"its base is {gap:.0f} pixels from where the other view shows it")
    tips = [one.tip_gap * min(c.length for c in one.curves) for one in vote.winners]
    if np.mean(np.array(tips) < _TOGETHER) < _SELDOM:
        open_ = [tip for one, tip in zip(vote.winners, tips, strict=True) if search.ends(one)]
        tips = open_ if len(open_) > _ENDING * len(tips) else [0.0]
    together = float(np.mean(np.array(tips) < _TOGETHER))
    if together < _SELDOM:
        doubts.append(
            f"its tips in the views are one point in only {100.0 * together:.0f} % of the frames"
        )
    clear = [one for one in vote.winners if one.worth > 0.5 * best.worth]
    bases = list(min(clear, key=lambda one: one.frame).bases)
    views = zip(search.cameras, search.frames, bases, strict=True)
    if cut := [camera.name for camera, view, base in views if not inside(view[0], base)]:
        doubts.append(
            f"the border of the image of {' and '.join(cut)} cuts off its base, without which no "
            "contact is found"
        )
    return Start(
        bases,
        [curve.line for curve in best.curves],
        best.frame,
        min(one.frame for one in vote.winners),
        bright,
        confidence,
        vote.agreed,
        tuple(doubts),
        _others(vote, best, confidence),
    )


def _others(vote: _Vote, best: _Combination, confidence: float) -> tuple[Candidate, ...]:
    """Other candidates near the frame of the best, except those that are the same line."""
    found = [best]
    shown = []
    for worth, row in vote.others:
        if confidence * worth < _FAINTEST:
            continue
        one = min(row, key=lambda other: abs(other.frame - best.frame))
        pairs = [zip(one.curves, other.curves, strict=True) for other in found]
        if not any(all(overlap(a.line, b.line) > _ALIKE for a, b in pair) for pair in pairs):
            lines = [curve.line for curve in one.curves]
            shown.append(Candidate(list(one.bases), lines, confidence * worth))
            found.append(one)
    return tuple(shown)


def base_gap(cameras: Sequence[Camera], pixels: Array) -> Array:
    """Distance of points from the position that the views together determine, pixels."""
    point, _ = triangulate(cameras, pixels)
    seen = np.stack([camera.project(point) for camera in cameras])
    return np.asarray(np.linalg.norm(seen - pixels, axis=-1).max(axis=0))
