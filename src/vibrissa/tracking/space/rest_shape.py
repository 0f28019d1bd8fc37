"""Shape of the whisker at rest, and its length, from its shapes in space over time.

Bending changes the whisker's shape; its pose does not. Frames whose shapes agree up to a rigid
motion are therefore taken as free of contact, if there are enough of them: the largest such group.
Their median, each moved to fit best, is the rest shape. A whisker pressed against an object may
keep its shape too, but only while its base hardly moves, so frames are weighted by its speed; and a
whisker bent to the mirror image of its rest shape agrees only if rolled over, which no animal does.

After a release a whisker rings, and its own mass bends it as much as a light contact. If free
frames deviate unevenly, only the quietest of them give the shape, and poses by it.

A whisker tapers to its tip, so its length determines its radius everywhere, and hence how it bends.
If its tip is too faint to be seen, or not in the image, its length is estimated from how well rods
of different lengths explain the traces in contact, with a weak prior. The estimate is made in terms
of the visible share of the length, because bending determines this share equally well for all
lengths. If the contact is beyond the visible part, a longer whisker that is touched farther out has
nearly the same visible shape; the position of the contact then depends on the length.

Proximal to its tip a whisker bends as the cone of which it is a part: what matters is where the
cone ends, not how much of it is missing. So an unknown taper and a length seen too short are one
unknown, which bending determines; it is combined with a prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.trace.trace import arc_lengths, interpolated
from vibrissa.whisker import Whisker

Counts = NDArray[np.intp]

_COMMON = 0.85  # share of the usual length over which shapes are compared: tips are uncertain
# Share of the length at the base that is not compared: fur draws it aside, in some poses more.
_FURRED = 0.06
_LEAST = 0.4  # visible share of that needed to decide whether the whisker is bent
_FEWEST = 3  # smallest number of frames that give a shape
# Largest deviation of a free frame in units of the usual one, and if that is white noise.
_NEAR, _OF_NOISE = 4.0, 2.0
_EXACT = 1e-5  # deviation, over the length, below which a frame is always free
# A whisker rings where free frames usually deviate by so many times what this share of them does;
# then still ones deviate by at most so many times that.
_UNEVEN, _QUIETEST, _QUIET = 2.5, 0.1, 1.5
# Usual deviation from which this is done, over the length: by less the base hardly is turned.
_RINGS = 2e-5
# Depth of the shape from which this is done, in usual deviations: a straight whisker that rings is
# alike where it turns back, too.
_DEEP = 10.0
_LONGER = 1.1  # length over which a known whisker may be seen, in units of its own
_STILL = 0.008  # usual deviation of free frames at most, as a share of a known whisker's length
# Spread of lengths, 16 to 84 %, above which ends in less than this share of frames are not tips.
_FADES, _OFTEN = 0.02, 0.4
_ENDS = 3  # number of frames at rest that show the tip, from which the length is computed
# Factor of the noise of a shape: errors of neighbouring points are correlated, so that they seem
# smoother than they are right. Errors of separate points are also averaged over the frames.
_SMOOTH, _SEPARATE = 4.0, 1.0
# Share of its length by which a shape may begin elsewhere on the whisker than the others do, and
# what keeps that of a straight line, m²: none.
_SLIDES, _TINY = 0.02, 1e-30
# Largest relative change of the curvature seen by one view as the whisker leaves its plane.
_TURNED = 0.2
# Roll about the whisker's chord from which a rigid motion is not one that an animal makes.
_OVER = np.deg2rad(120.0)
_RESTS = 0.25  # share of the root mean square speed of the base below which a whisker rests
_BASE = 6  # number of parts of a shape of which the first shows the direction of its base
_ROUNDS = 4  # number of rounds in which the free frames are selected
# Step and smallest value of the seen share of a length that are tried, and number of those between
# which costs are interpolated.
_STEP, LEAST_SEEN, _FINE = 0.03, 0.34, 600
# Usual length of what is not seen, over that of what is.
_UNSEEN = 0.5
# Smallest standard deviation of the share of a length that is seen, as bending shows it: errors of
# traces, and of the taper, that all frames share.
_CERTAIN = 0.025
# The same of the taper of a whisker whose tip is seen; and the step in which tapers are tried and
# the largest, as shares of the length by which it would have to be longer to be as thick.
_BENDS, _TAPERS, _STOUTEST = 0.014, 0.03, 0.12
# Largest difference of costs of a probable length: three standard deviations.
_HARDLY = 9.0
_STATED = 0.01  # standard deviation of a stated length, as a share: fur hides the base
_ENDED = 0.7  # standard deviation of a seen length by where its tip is seen, pixels
_OUTER = 0.4  # share of the shape by which it is extrapolated


@dataclass(frozen=True, eq=False)
class RestShape:
    """Whisker at rest, and its deviation from that in each frame."""

    points: Array  # (n, 3), equally spaced, in the frame of the best free frame, m
    free: Mask  # (time,): free of contact
    deviation: Array  # (time,): root mean square distance from the fitted rest shape, m
    noise: float  # usual deviation of the free frames, m
    whole: bool = True  # whether it ends at the whisker's tip
    ringing: Mask | None = None  # (time,): bent by its own mass; None: no frame is
    sparse: bool = False  # whether its curves are lines between few points, with separate errors

    @property
    def still(self) -> Mask:
        """Whether each frame is free, and not bent by its own mass."""
        return self.free if self.ringing is None else self.free & ~self.ringing

    @property
    def undetected(self) -> float:
        """Largest deviation of a free frame, m: contacts that bend it less are not detected."""
        return float(np.max(self.deviation[self.free], initial=0.0))

    @property
    def spacing(self) -> float:
        """Distance of the points, m."""
        return float(np.median(np.linalg.norm(np.diff(self.points, axis=0), axis=1)))

    @property
    def length(self) -> float:
        """Length along the points, m."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


class Astray(NamedTuple):
    """Errors of curves besides noise, m: a bent whisker deviates by more than these."""

    pose: float = 0.0  # that vary with the pose only
    motion: Array | float = 0.0  # (time,) in each frame, by blur


_EXACTLY = Astray()


def rest_shape(
    curves: Array,
    least: float = 0.1,
    tips: Mask | None = None,
    astray: Astray = _EXACTLY,
    hidden: float = 0.0,
    *,
    fur: float = _FURRED,
) -> RestShape:
    """Find the rest shape among the shapes of a trial.

    Parameters
    ----------
    curves : array (time, node, 3)
        The whisker in every frame, equally spaced from base to tip, m; NaN where it is missing.
    least : float
        Smallest share of the frames that are free of contact.
    tips : array (time,), optional
        Whether the curve ends at the whisker's tip in each frame; by default in all.
    astray : Astray
        Errors of the curves besides noise.
    hidden : float
        Share of the curves at the base in which they are not on the whisker, and not compared.
    fur : float
        Share of the curves at the base in which fur may draw them aside, and which is not compared.

    Returns
    -------
    RestShape
        Shape with its free frames and deviations.

    Raises
    ------
    ValueError
        If the whisker is seen in less than three frames.
    """
    seen = _seen(curves)
    furred = _furred(curves, max(fur, hidden))
    _, shapes, known, compared = _compared(curves[seen])
    whole = _whole(known, compared)
    part = shapes[whole, furred:compared]
    best, near = _largest_group(part, least)
    group = np.flatnonzero(seen)[whole][near]
    lengths = np.linalg.norm(np.diff(curves[group], axis=1), axis=2).sum(axis=1)
    length, ends = length_shown(lengths, None if tips is None else tips[group])
    # Repeat with arc lengths that divide this length evenly.
    first = np.flatnonzero(whole)[best]
    _, shapes, known, compared = _compared(curves[seen], length / (curves.shape[1] - 1))
    whole = _whole(known, compared)
    near = np.isin(np.flatnonzero(seen)[whole], group)
    if not near.any():
        raise ValueError("no frame free of contact shows nearly the whole length of the whisker")
    part = shapes[whole, furred:compared]
    # The first frame may show less of the length than is compared now.
    mean = shapes[first, furred:compared] if whole[first] else part[near][0]
    deviation = np.full(len(shapes), np.inf)
    # While it rests, its traces have the same errors in all frames, and hardly deviate.
    pace = _pace(part)
    moves = np.minimum(pace, _RESTS * np.sqrt(np.mean(pace**2)))
    for _ in range(_ROUNDS):
        fitted = _onto(part, mean)
        mean = np.median(fitted[near], axis=0)
        deviation[whole] = _deviations(part, mean)
        away = (fitted - mean).reshape(len(part), -1) / len(mean) ** 0.5
        usual = _weighted_median(deviation[whole][near], moves[near])
        within = _limit(usual, _noise(away, near))
        near = deviation[whole] < max(within, _EXACT * length)
    spread, white = _weighted_median(deviation[whole][near], moves[near]), _noise(away, near)
    quiet, ringing = near, None
    # A ringing whisker also looks as if it began elsewhere.
    rings = _deviations(part, mean, slides=0.0)
    usual = float(np.median(rings[near]))
    uneven = usual > _UNEVEN * np.quantile(rings[near], _QUIETEST)
    if uneven and usual > _RINGS * length and _depth(mean) > _DEEP * usual:
        for _ in range(_ROUNDS):
            quiet = near & (rings <= _QUIET * np.quantile(rings[near], _QUIETEST))
            mean = np.median(_onto(part[quiet], mean), axis=0)
            rings = _deviations(part, mean, slides=0.0)
        deviation[whole] = _deviations(part, mean)
        ringing = np.ones(len(curves), dtype=bool)
        ringing[np.flatnonzero(seen)[whole][quiet]] = False
    shown = shapes[whole][:, : curves.shape[1]]
    # The quiet frames may all miss the tip.
    by = quiet if np.isfinite(shown[quiet, :, 0]).any(axis=0).all() else near
    shown = shown[by][:, np.isfinite(shown[by, :, 0]).any(axis=0)]
    points = np.nanmedian(_moved(shown, *motions(part[by], mean)), axis=0)
    # If less of the whisker is seen, the visible part shows whether it is bent.
    for i in np.flatnonzero(~whole & (known >= _LEAST * compared)):
        n = min(int(known[i]), len(points))
        deviation[i] = _deviations(shapes[i : i + 1, furred:n], points[furred:n])[0]
    noise = float(np.median(deviation[whole][quiet]))
    out = np.full(len(curves), np.nan)
    out[seen] = np.where(np.isfinite(deviation), deviation, np.nan)
    within = max(_limit(spread, white), _EXACT * length)
    limits = np.hypot(np.full(len(out), within), astray.motion)
    free = _free(out, limits, np.hypot(limits, astray.pose))
    return RestShape(points, free, out, noise, ends, ringing)


def _free(deviation: Array, within: Array, sure: Array) -> Mask:
    """Frames that are free of contact, by their deviations (time,) and the limits of each.

    Some errors of curves vary with the pose of the whisker, and exceed the usual limit in some
    poses. Contacts that are not sure are therefore only the beginnings and ends of sure ones,
    toward which the deviations rise from frame to frame.
    """
    known = np.nan_to_num(deviation, nan=0.0)
    touching = known >= sure
    for _ in range(2):
        for i in range(1, len(known)):
            touching[i] |= touching[i - 1] and within[i] <= known[i] < known[i - 1]
        known, within, touching = known[::-1], within[::-1], touching[::-1]
    return np.asarray(np.isfinite(deviation) & ~touching)


def _limit(usual: float, white: float) -> float:
    """Largest deviation of a free frame, by the usual one and the part of it that is white noise.

    The deviation due to noise of many points is nearly the same in all frames.
    """
    white = min(white, usual)
    return float(np.hypot(_NEAR * np.sqrt(usual**2 - white**2), _OF_NOISE * white))


def _seen(curves: Array) -> Mask:
    """Frames that show the whisker; there must be some."""
    seen: Mask = np.all(np.isfinite(curves), axis=(1, 2))
    if seen.sum() < _FEWEST:
        raise ValueError(
            f"the whisker is seen in {int(seen.sum())} frames; at least {_FEWEST} are needed for "
            "its shape"
        )
    return seen


def _compared(curves: Array, spacing: float | None = None) -> tuple[float, Array, Counts, int]:
    """Spacing and shapes at equal lengths, visible points of each, number of points compared."""
    spacing, shapes = aligned_lengths(curves, spacing)
    known = np.isfinite(shapes[:, :, 0]).sum(axis=1)
    return spacing, shapes, known, int(_COMMON * (curves.shape[1] - 1)) + 1


def _furred(curves: Array, fur: float = _FURRED) -> int:
    """Number of points at the base that are not compared."""
    count: int = round(fur * (curves.shape[1] - 1))
    return count


def _whole(known: Counts, compared: int) -> Mask:
    """Shapes that show all points compared."""
    whole: Mask = np.asarray(known >= compared, dtype=np.bool_)
    if whole.sum() < _FEWEST:
        raise ValueError("hardly any two frames show the whisker over the same length")
    return whole


def length_shown(lengths: Array, tips: Mask | None) -> tuple[float, bool]:
    """Length of the whisker, by those that are seen, m, and whether its tip is seen."""
    ends = np.ones(len(lengths), dtype=bool) if tips is None else tips
    whole = bool(ends.sum() >= _ENDS)
    if whole and ends.mean() < _OFTEN:
        # Where a whisker usually fades, some lines seem to end, but at random positions.
        low, high = np.percentile(lengths[ends], [16.0, 84.0])
        whole = bool(high - low < _FADES * high)
    # Part of a tip may be missed, but a trace rarely extends beyond it.
    return float(np.percentile(lengths[ends] if whole else lengths, 75.0)), whole


def known_rest(curves: Array, whisker: Whisker, least: float = 0.1) -> RestShape:
    """Find the frames in which a known whisker is at rest."""
    seen = _seen(curves)
    spacing, shapes, known, compared = _compared(curves[seen])
    shown = spacing * (curves.shape[1] - 1)
    if shown > _LONGER * whisker.length:
        raise ValueError(
            f"the whisker is seen over {shown * 1e3:.1f} mm, but the known one is "
            f"{whisker.length * 1e3:.1f} mm long: it is another, or the scale is wrong"
        )
    s, furred = np.arange(int(whisker.length / spacing) + 1) * spacing, _furred(curves)
    points = whisker.pose.to_source(whisker.position(np.minimum(s, whisker.length)))
    if not np.ptp(curves[seen][..., 2]):
        points[:, 2] = 0.0
    out = np.full(len(curves), np.nan)
    for row, shape, count in zip(np.flatnonzero(seen), shapes, known, strict=True):
        n = min(int(count), len(points), compared)
        if n >= _LEAST * compared:
            out[row] = _deviations(shape[None, furred:n], points[furred:n], rolled=True)[0]
    lowest = np.sort(out[np.isfinite(out)])
    noise = float(np.median(lowest[: max(_FEWEST, round(least * len(lowest)))]))
    free = np.zeros(len(curves), dtype=bool)
    if noise < _STILL * whisker.length:
        with np.errstate(invalid="ignore"):
            free = out < _NEAR * noise
    return RestShape(points, free, out, noise)


def _deviations(
    shapes: Array, target: Array, rolled: bool = False, slides: float = _SLIDES
) -> Array:
    """Root mean square distances from a target to which shapes are fitted; see `differences`."""
    away, _ = differences(shapes, target, rolled, slides)
    return np.asarray(np.sqrt((away**2).sum(axis=1) / len(target)))


def differences(
    shapes: Array, target: Array, rolled: bool = False, slides: float = _SLIDES
) -> tuple[Array, Array]:
    """Differences (t, 3 n) from a target to which shapes are fitted, rolled over or not.

    Shapes may begin slightly earlier or later on the whisker than the target, depending on the
    hairs in front of it. One view shows them more or less bent where the whisker leaves the plane
    of the image: by how much, as a share (t,) of the curvature, is the second result.
    """
    rotation, _ = motions(shapes, target)
    chord = shapes[:, -1] - shapes[:, 0]
    swing = _swings(chord, target[-1] - target[0])
    # About the chord of the target, onto which both rotations bring that of the shape.
    twist = np.trace(rotation @ np.swapaxes(swing, 1, 2), axis1=1, axis2=2)
    over = (twist < 1.0 + 2.0 * np.cos(_OVER)) & (not rolled)
    rotation[over] = swing[over]
    shift = target.mean(axis=0) - np.einsum("tij,tj->ti", rotation, shapes.mean(axis=1))
    away = (_moved(shapes, rotation, shift) - target).reshape(len(shapes), -1)
    changes = [(_slide(target).reshape(-1), slides)]
    if not (np.ptp(shapes[..., 2]) or np.ptp(target[:, 2])):
        changes = [*changes, (turned_change(target).reshape(-1), _TURNED)] * 2
    # Each in turn, as both are limited; none at first.
    shares = np.zeros((2 + len(changes), len(shapes)))
    for k, (change, most) in enumerate(changes):
        left = away + np.outer(shares[k], change)
        shares[k + 2] = np.clip(left @ change / (change @ change + _TINY), -most, most)
        away = left - np.outer(shares[k + 2], change)
    return away, shares[-1] * (len(changes) > 1)


def _slide(shape: Array) -> Array:
    """Change (n, 3) of a shape that begins later by its length, up to rigid motion."""
    return _but_rigid(shape, np.gradient(shape, axis=0) * (len(shape) - 1))


def turned_change(shape: Array) -> Array:
    """Change (n, 3) of a plane shape whose curvature becomes twice as large, up to rigid motion.

    A whisker that leaves the plane of the image looks shorter, or rolled to the side. Either
    changes what is seen of its curvature by nearly the same factor everywhere, unlike a contact,
    beyond which a whisker is not bent.
    """
    step = np.gradient(shape[:, :2], axis=0)
    angle = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    across = np.column_stack([-step[:, 1], step[:, 0], 0.0 * angle])
    return _but_rigid(shape, np.cumsum((angle - angle.mean())[:, None] * across, axis=0))


def _but_rigid(shape: Array, change: Array) -> Array:
    """Change (n, 3) of a shape without the part that is a rigid motion."""
    away = shape - shape.mean(axis=0)
    turns = np.cross(np.eye(3)[:, None], away)
    shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
    rigid = np.concatenate([shifts, turns]).reshape(6, -1).T
    along = change.reshape(-1)
    return np.asarray(along - rigid @ np.linalg.lstsq(rigid, along)[0]).reshape(change.shape)


def _depth(shape: Array) -> float:
    """Largest distance of a shape from its chord, m."""
    away, chord = shape - shape[0], shape[-1] - shape[0]
    across = away - np.outer(away @ chord / (chord @ chord), chord)
    return float(np.linalg.norm(across, axis=1).max())


def _swings(directions: Array, goal: Array) -> Array:
    """Smallest rotations (n, 3, 3) that bring directions (n, 3) onto a goal (3,)."""
    a = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    b = goal / np.linalg.norm(goal)
    outer = b[:, None] * a[:, None, :]
    across = outer - np.swapaxes(outer, 1, 2)
    # A whisker never points the opposite way; there the rotation would be undefined.
    nearness = np.maximum(1.0 + a @ b, 1e-6)[:, None, None]
    return np.asarray(np.eye(3) + across + across @ across / nearness)


def whisker_at_rest(
    shape: RestShape, name: str = "tracked", hidden: float = 0.0, **properties: float
) -> Whisker:
    """Whisker with the rest shape, whose base radii are those before a hidden part."""
    noise = (_SEPARATE if shape.sparse else _SMOOTH) * shape.noise
    whisker = Whisker.from_points(shape.points, noise=noise, name=name, **properties)  # type: ignore[arg-type]
    if hidden == 0.0:
        return whisker
    at_base, at_tip = whisker.radius(np.array([0.0, whisker.length]))
    share = hidden / (whisker.length + hidden)
    edge = float(at_base + share * (at_tip - at_base))
    return whisker.with_properties(base_radius=edge, tip_radius=float(at_tip))


def aligned_lengths(curves: Array, spacing: float | None = None) -> tuple[float, Array]:
    """Cut curves at the same arc lengths; their spacing, m, and points (t, n, 3)."""
    count = curves.shape[1]
    lengths = [arc_lengths(curve) for curve in curves]
    # Some frames may show less of the whisker, rarely more.
    if spacing is None:
        spacing = float(np.percentile([each[-1] for each in lengths], 75.0)) / (count - 1)
    s = np.arange(int(1.05 * count)) * spacing
    for each in lengths:
        each[-1] *= 1.0 + 1e-9
    pairs = zip(lengths, curves, strict=True)
    return spacing, np.stack([interpolated(s, at, curve, np.nan) for at, curve in pairs])


def _largest_group(shapes: Array, least: float) -> tuple[int, Mask]:
    """Frame with the nearest neighbours, and which frames are near it."""
    points = shapes[:, ::4]
    # Arrows of all arcs: unlike chords they show how a nearly straight whisker bends, too.
    first, last = np.triu_indices(points.shape[1], 2)
    first, last = (one[(last - first) % 2 == 0] for one in (first, last))
    middle = points[:, (first + last) // 2]
    arrows = np.linalg.norm(0.5 * (points[:, first] + points[:, last]) - middle, axis=-1)
    square = (arrows**2).sum(axis=1)
    away = square[:, None] + square[None] - 2.0 * arrows @ arrows.T
    # They do not distinguish mirror images, but opposite bends differ by as much as their depth.
    chord = shapes[:, -1] - shapes[:, 0]
    bends = (shapes - shapes[:, :1]).mean(axis=1) - 0.5 * chord
    bends = np.einsum("tij,tj->ti", _swings(chord, chord.mean(axis=0)), bends)
    depth = np.linalg.norm(bends, axis=1)
    over = bends @ bends.T < np.cos(_OVER) * depth[:, None] * depth
    away += over * arrows.shape[1] * (2.0 * np.minimum(depth[:, None], depth)) ** 2
    distance = np.sqrt(np.maximum(away, 0.0))
    pace = _pace(shapes)
    usual = float(np.median(pace))
    pace = np.minimum(pace / usual, 1.0) if usual else np.ones(len(pace))
    order = np.argsort(distance, axis=1)
    rank = np.argmax(np.cumsum(pace[order], axis=1) >= least * pace.sum(), axis=1)
    nearest = np.take_along_axis(distance, order, axis=1)
    rank = np.clip(rank, 2, len(shapes) - 1)
    radius = np.take_along_axis(nearest, rank[:, None], axis=1)[:, 0]
    # No distance counts that is smaller than the noise by which any two shapes differ.
    within = max(float(radius.min()), 2.0**0.5 * _noise(arrows))
    best = int(np.argmax((distance <= within) @ pace))
    return best, distance[best] <= max(2.0 * within, 1e-12)


def _noise(values: Array, near: Mask | None = None) -> float:
    """Norm of what is independent from frame to frame in values (time, n), or in some frames."""
    change = np.linalg.norm(np.diff(values, 4, axis=0), axis=1) / 70.0**0.5
    if near is not None and change.size:
        change = change[np.lib.stride_tricks.sliding_window_view(near, 5).all(axis=1)]
    return float(np.median(change)) if change.size else 0.0


def _pace(shapes: Array) -> Array:
    """Angular speed of the base in each frame, rad a frame."""
    ahead = shapes[:, shapes.shape[1] // _BASE] - shapes[:, 0]
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.asarray(np.linalg.norm(np.gradient(ahead, axis=0), axis=1))


def _weighted_median(values: Array, weight: Array) -> float:
    """Median of values, each of which counts by its weight; all alike if they have none."""
    order = np.argsort(values)
    total = np.cumsum(weight[order] if weight.any() else np.ones(len(values)))
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])


def motions(shapes: Array, target: Array) -> tuple[Array, Array]:
    """Find the rigid motions that fit shapes to a target."""
    n = min(shapes.shape[1], len(target))
    a, b = shapes[:, :n], target[:n]
    middle, goal = a.mean(axis=1), b.mean(axis=0)
    cross = np.einsum("tni,nj->tij", a - middle[:, None], b - goal)
    if not (np.ptp(a[..., 2]) or np.ptp(b[..., 2])):
        # Shapes known only in a plane are rotated within it.
        cross[:, 2, 2] = np.linalg.norm(cross, axis=(1, 2)) + 1.0
    u, _, vt = np.linalg.svd(cross)
    sign = np.linalg.det(u @ vt)
    u[:, :, 2] *= sign[:, None]
    rotation = np.swapaxes(u @ vt, 1, 2)
    return rotation, goal - np.einsum("tij,tj->ti", rotation, middle)


def _onto(shapes: Array, target: Array) -> Array:
    """Shapes fitted to a target by rigid motion."""
    return _moved(shapes, *motions(shapes, target))


def _moved(shapes: Array, rotation: Array, shift: Array) -> Array:
    return np.asarray(np.einsum("tij,tnj->tni", rotation, shapes) + shift[:, None])


class Length(NamedTuple):
    """Length of a whisker, and how much of it the views show."""

    value: float  # m; the seen length, if nothing bends the whisker
    sigma: float  # its standard deviation, m; NaN if nothing bends the whisker
    seen: bool = False  # whether it is seen or stated, not inferred from bending
    shown: float = np.inf  # length of the part that is seen, m
    # Standard deviations (vector, 3) of the slope of the other part's curvature, 1/m², in the frame
    # of the shape.
    bending: Array = np.zeros((3, 3))

    def astray(self, beyond: Array) -> Array:
        """Displacements of points so far beyond the part that is seen, over `bending`, m³.

        The shape is extrapolated with the curvature of the outer part.
        """
        return np.asarray(beyond**2 * (0.25 * _OUTER * self.shown + beyond / 6.0))


def seen_length(lengths: Array, lines: Array, tapers: bool = True) -> Length:
    """Length of whiskers that are seen to end; their lines in the images give its error in pixels.

    If the taper is unknown, the length does not determine the radius either.
    """
    pixels = np.linalg.norm(np.diff(lines, axis=2), axis=3).sum(axis=2)
    low, value, high = np.percentile(lengths, [16.0, 50.0, 84.0])
    seen = np.hypot(_ENDED * value / np.nanpercentile(pixels, 95.0), 0.5 * (high - low))
    sigma = seen if tapers else np.hypot(seen, _CERTAIN * value)
    return Length(float(value), float(sigma), seen=True)


def stated_length(shape: RestShape, length: float, tapers: bool = True) -> Length:
    """Check and weigh a length that is stated; see `seen_length`."""
    if shape.length > _LONGER * length:
        raise ValueError(
            f"the whisker is seen over {1e3 * shape.length:.1f} mm, but its stated length is "
            f"{1e3 * length:.1f} mm: it is another, or the scale is wrong"
        )
    value = max(length, shape.length)
    return Length(value, float(np.hypot(_STATED, 0.0 if tapers else _CERTAIN)) * value, seen=True)


def unseen_part(shape: RestShape, length: Length) -> Length:
    """Add the length that a shape shows, and how uncertain the curvature beyond it is.

    It may go on to change as it does between the middle of the whole and that of the outer part.
    """
    s = np.arange(len(shape.points)) * shape.spacing
    outer = s > s[-1] - _OUTER * shape.length
    bends = [np.polynomial.polynomial.polyfit(s[i], shape.points[i], 2)[2] for i in (outer, s >= 0)]
    change = 2.0 * float(np.linalg.norm(bends[0] - bends[1]))
    bending = change / (0.5 * (1.0 - _OUTER) * shape.length)
    return length._replace(shown=shape.length, bending=bending * np.eye(3))


def lengthened(shape: RestShape, length: float) -> RestShape:
    """Extrapolate a shape beyond its end."""
    points, spacing = shape.points, shape.spacing
    if length <= shape.length:
        return shape
    more = max(1, round((length - shape.length) / spacing))
    s = np.arange(1 - len(points), 1) * spacing
    outer = s > -_OUTER * shape.length
    bend = np.polynomial.polynomial.polyfit(s[outer], points[outer], 2)
    ahead = (length - shape.length) / more * np.arange(1, more + 1)
    there = np.polynomial.polynomial.polyval(ahead, bend).T + points[-1] - bend[0]
    return replace(shape, points=np.concatenate([points, there]))


def likeliest_length(seen: float, cost: Callable[[float], float]) -> Length:
    """Find the length with which the rod explains the traces best, as a posterior mean.

    The seen part of a cone bends by the share of it that is seen: that is estimated.
    """
    shares, costs = [1.0], [cost(seen)]
    while costs[-1] <= min(costs) + _HARDLY and shares[-1] - _STEP >= LEAST_SEEN:
        shares.append(shares[-1] - _STEP)
        costs.append(cost(seen / shares[-1]))
    share, shown = _likelihood(shares[::-1], costs[::-1])
    usual = np.exp((1.0 - 1.0 / share) / _UNSEEN) / share**2
    value, spread = _moments(share, shown * usual)
    return Length(seen / value, float(np.hypot(spread, _CERTAIN)) * seen / value**2)


def likeliest_taper(
    usual: float,
    thinnest: float,
    cost: Callable[[float], float],
    seen: float = 1.0,
    apart: bool = False,
) -> tuple[float, float]:
    """Find the length of a cone beyond the seen one, as a share of this, from its bending.

    ``usual`` is the share's standard deviation before it is known how the whisker bends; below the
    share ``thinnest`` the tip would have no thickness; ``cost`` is the misfit of the rod and the
    traces at a share. The standard deviation that is also returned is due to what bending shows,
    which errs, and what is usual; it errs more if only a share is ``seen``, and if views disagree
    about where the whisker begins (``apart``).
    """
    shares, costs = [0.0], [cost(0.0)]
    while costs[-1] <= min(costs) + _HARDLY and shares[-1] + _TAPERS <= _STOUTEST:
        shares.append(shares[-1] + _TAPERS)
        costs.append(cost(shares[-1]))
    while costs[0] <= min(costs) + _HARDLY and shares[0] - _TAPERS >= thinnest:
        shares.insert(0, shares[0] - _TAPERS)
        costs.insert(0, cost(shares[0]))
    errs = _CERTAIN / min(seen, 1.0) if apart or seen < 1.0 else _BENDS
    fine, shown = _likelihood(shares, costs, 3.0 * errs)
    blurred = np.exp(-0.5 * ((fine[:, None] - fine) / errs) ** 2)
    blurred /= blurred.sum(axis=1, keepdims=True)
    share, sigma = _moments(fine, blurred @ shown * np.exp(-0.5 * (fine / usual) ** 2))
    return max(share, thinnest), sigma


def _likelihood(
    values: Sequence[float], costs: Sequence[float], beyond: float = 0.0
) -> tuple[Array, Array]:
    """Likelihood of a number at many values, interpolated from costs at some."""
    fine = np.linspace(values[0] - beyond, values[-1] + beyond, _FINE)
    between = interpolate.CubicSpline(values, costs)(np.clip(fine, values[0], values[-1]))
    return fine, np.exp(-0.5 * (between - between.min()))


def _moments(values: Array, weight: Array) -> tuple[float, float]:
    """Mean and standard deviation."""
    weight = weight / weight.sum()
    mean = float(values @ weight)
    return mean, float(np.sqrt((values - mean) ** 2 @ weight))
