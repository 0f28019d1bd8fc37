"""Ends of a whisker in one frame, traced from an approximate line.

A whisker begins where it leaves the dark face. In front of grey fur, or without a face, it begins
where the line does, if the line is clearly darker than streaks of the fur next to it. It ends where
it fades.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from vibrissa.io import Frame
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.trace.ridge import (
    DEPTH_VARIANCE,
    FEWEST,
    Measured,
    fitted,
    flanks,
    march,
    measure,
    measured,
    middle,
)
from vibrissa.tracking.trace.trace import (
    NOTHING,
    STEP,
    Clutter,
    Trace,
    TraceOptions,
    distances,
    even,
    normals,
)

OUTSIDE = 12.0  # how far inside the face the base is searched, pixels
_FUR = 3  # number of points next to the face that are not measured, since fur is dark too
# Numbers of the last points of a line, which give its bend, and of those beyond the last supported
# one in which the tip is searched.
_BENDING, _BEYOND = 30, 12
# Distance from the image's border within which a line may end because the image does, pixels.
_BORDER = 8.0
# Standard deviations of one point by which a line's last points are darker on average than what is
# beyond, for its end to be seen, to a few points: nearly five of the mean of ten.
_CLEAR = 1.5
# Noise below which an image is not a sensor's raw image, grey values: twice that of rounding.
_SMOOTHED = 0.6
_LAST = 10  # number of points before the end, and twice that of points beyond, that decide this
# Distances from a line at which its profile is taken, and smallest variance of that, samples.
_ACROSS, _NARROWEST = np.arange(6.0), 0.3
# Distances from the whisker at which the face's edge is searched, pixels.
_FLANKS = np.array([4.0, 7.0])
# Distances that distinguish it from a hair, and difference of edges from which there may be one,
# points.
_WIDER, _UNEVEN = np.array([4.0, 7.0, 10.0, 13.0]), 2.0
# Smallest darkness of a whisker next to its base, in standard deviations of the fur's streaks.
_CLEARER = 1.5
_STREAKS = 40  # number of points of a line's beginning next to which fur may look like it
# Darkness of a whisker relative to the twenty points before it, at least: toward its tip, as it
# tapers, and toward its base.
_TAPERED, _EVEN = 0.6, 0.9
# Number of hidden points from which a line may go on anywhere behind them, by a pixel or more (with
# the usual stiffness): what follows then belongs to it only if it is a line itself.
_ASTRAY = 23
# Share of a line before the point from which it is followed inward; share of the points on the way
# that must be seen; and distance from the line from which that may begin on something else, pixels.
_NEARER, _ENOUGH, _ASIDE = 0.55, 0.45, 1.5
# Standard deviations of offset, direction and curvature at that point, and drift of the last: less
# than when it is followed outward, so that what crosses it does not draw it away.
_INWARD = np.array([1.0, 0.03, 3e-4]), 2e-5
# Degree of the polynomials of a smooth curve, and share of a kink that may be left.
_SMOOTH, _STRAIGHTER = 4, 0.8


def traced(
    frame: Frame,
    noise: float,
    line: Array,
    options: TraceOptions,
    before: float = OUTSIDE,
    clutter: Clutter = NOTHING,
    held: float = 0.0,
) -> tuple[Trace, bool]:
    """Trace a whisker near a line, and find its ends; whether it begins at the face.

    If points that are not seen are held at the line, the whisker begins where it does, and what is
    seen of it behind something long belongs to it.
    """
    line = prolonged(even(line), _BENDING, _BEYOND)
    for gate in (3, 2):
        line = even(fitted(frame, line, gate, noise, options, clutter, held=held)[0])
        if len(line) < FEWEST:
            # Where nothing is seen, nothing determines the line.
            return Trace.lost(), False
    if not held:
        line = _beginning(frame, noise, line, options, clutter)
    line, from_face = (line, True) if held else _with_base(frame, line, before, clutter)
    if before > OUTSIDE and len(line) >= FEWEST:
        # Extrapolated parts are measured before they count.
        fur = _FUR if from_face else 0
        line = even(fitted(frame, line, 3, noise, options, clutter, fur)[0])
    if len(line) < FEWEST:
        return Trace.lost(), False
    if not from_face:
        # Without a face the whisker begins, as it ends, where the line does.
        line = prolonged(line[::-1], _BENDING, _BEYOND)[::-1]
    fur = _FUR if from_face else 0
    line, along = measured(frame, line, 1, noise, options, fur, clutter, held)
    first = 0
    if not from_face:
        bare, texture = _above_texture(frame, line, along, options, clutter)
        inward = bare.part(slice(None, None, -1))
        first = len(line) - _tip(inward, _EVEN, _CLEARER * texture)
    last = _tip(along)
    if not held:
        last = _connected(along.seen[:last])
    if last - first < FEWEST or not along.seen[first:last].any():
        return Trace.lost(), False
    # An image without noise was smoothed, as by compression, which removes faint lines.
    tip_seen = noise > _SMOOTHED and inside(frame, line[last - 1])
    tip_seen = tip_seen and _stops(frame, line, along, last)
    line, along = line[first:last], along.part(slice(first, last))
    trusted = min(1.0, float(along.seen.sum() / max(along.open.sum(), 1)))
    base_seen = inside(frame, line[0])
    skew, width = _profile(frame, line, options.scale, clutter)
    trace = Trace(line, along.sigma, along.seen, trusted, base_seen, tip_seen, skew, width=width)
    return trace, from_face


def _beginning(
    frame: Frame, noise: float, line: Array, options: TraceOptions, clutter: Clutter
) -> Array:
    """Line that begins along the smooth continuation of its outer part.

    What is followed outward may begin on a hair or on a whisker that was cut, and leave it at a
    kink. Followed inward from beyond, the whisker passes by them.
    """
    count = int(_NEARER * len(line))
    if min(count, len(line) - count) < FEWEST:
        return line
    angle = np.unwrap(np.arctan2(*-np.diff(line[count : count + _BENDING], axis=0).T[::-1]))
    s = STEP * (np.arange(len(angle)) + 0.5)
    bend = -float((s - s.mean()) @ angle / ((s - s.mean()) ** 2).sum())
    start = np.array([*line[count], angle.mean() + bend * s.mean()])
    path, support = np.empty((count + 1, 2)), np.empty(count + 1)
    scale, bridge = options.scale, options.bridge
    bends = np.full(count, bend)
    found = march(
        frame, start, bends, *_INWARD, STEP, bridge, noise, scale, *clutter, path, support
    )
    if (support[:found] > 0.0).sum() < _ENOUGH * count:
        return line
    path = path[:found][::-1]
    away = distances(path, line[: count + FEWEST])[~clutter.hides(path)]
    if away.max(initial=0.0) < _ASIDE:
        return line
    better = np.concatenate([path, line[count + 1 :]])
    if kink(better[: len(path) + _BENDING]) > _STRAIGHTER * kink(line[: count + _BENDING]):
        return line
    # A wider search would find what is next to it again.
    return even(fitted(frame, even(better), 1, noise, options, clutter)[0])


def kink(line: Array, seen: Mask | None = None) -> float:
    """Root mean square distance of what is seen of a line from a smooth curve, pixels."""
    t = np.linspace(-1.0, 1.0, len(line))
    points, t = (line, t) if seen is None else (line[seen], t[seen])
    basis = np.vander(t, _SMOOTH + 1)
    left = points - basis @ np.linalg.lstsq(basis, points)[0]
    return float(np.sqrt((left**2).sum(axis=1).mean()))


def _above_texture(
    frame: Frame, line: Array, along: Measured, options: TraceOptions, clutter: Clutter
) -> tuple[Measured, float]:
    """Excess darkness of a line over the fur next to its beginning, whose streaks look similar.

    The fur is measured in the same way along two parallel lines; their standard deviation is
    returned too.
    """
    part = np.ascontiguousarray(line[:_STREAKS])
    n, amplitudes, sigma = len(part), [], along.noise * np.sqrt(DEPTH_VARIANCE)
    if n < FEWEST:
        return along, sigma
    points, amplitude, flank, support = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    for away in (-_FLANKS[1], _FLANKS[1]):
        other = np.ascontiguousarray(part + away * options.scale * normals(part))
        measure(frame, other, 1, 1.0, options.scale, *clutter, points, amplitude, flank, support)
        amplitudes.append(amplitude[flank > 0.0])
    texture = np.concatenate(amplitudes)
    if len(texture) < n:
        return along, sigma
    usual = max(float(texture.mean()) - sigma, 0.0)
    spread = max(float(texture.std()), sigma)
    noise = spread / np.sqrt(DEPTH_VARIANCE)
    return along._replace(amplitude=along.amplitude - usual, noise=noise), spread


def _profile(frame: Frame, line: Array, scale: float, clutter: Clutter) -> tuple[float, float]:
    """Third cumulant of the darkness across a line's nearer half, pixels³, and its width, pixels.

    Both are NaN if it is hidden.

    Symmetric blur does not change it. With a Gaussian g of the profile's width and the distance u
    in units of it, the odd part of the profile is fitted by a slope of the background, a shift and
    a skew: b u + c u g + h (u³ − 3 u) g.
    """
    half = line[len(line) // 8 : len(line) // 2]
    sides = grey_flanks(frame, half, scale * _ACROSS, clutter)
    sides = sides[..., np.isfinite(sides).all(axis=(0, 1))]
    if not sides.shape[2]:
        return np.nan, np.nan
    left, right = sides.mean(axis=2).T
    dark = 0.5 * (left[-1] + right[-1]) - 0.5 * (left + right)
    # Distances occur on both sides, the middle once.
    count = np.where(_ACROSS > 0.0, 2.0, 1.0)
    square = float(count * dark @ _ACROSS**2) / max(float(count @ dark), 1e-9)
    width = np.sqrt(max(square, _NARROWEST))
    u = _ACROSS / width
    g = np.exp(-0.5 * u**2)
    depth = float(count * dark @ g) / float(count @ g**2)
    basis = np.array([u, u * g, (u**3 - 3.0 * u) * g])
    odd = np.linalg.lstsq(basis.T, 0.5 * (right - left))[0]
    if not depth > 0.0:
        return np.nan, np.nan
    return float(6.0 * odd[2] / depth * (width * scale) ** 3), float(width * scale)


def _with_base(frame: Frame, line: Array, before: float, clutter: Clutter) -> tuple[Array, bool]:
    """Line that begins where the whisker leaves the face."""
    longer = even(line, -before)
    near, far = map(_edge, grey_flanks(frame, longer[:40], _FLANKS, clutter))
    if near is None:
        return line, False
    if far is not None and abs(far - near) >= _UNEVEN:
        bare = _without_lines(grey_flanks(frame, longer[:40], _WIDER, clutter))
        closer, far = map(_edge, bare[: len(_FLANKS)])
        near = near if closer is None else closer
    at = near
    if far is not None and abs(far - near) < _UNEVEN:
        # The face is round: its edge on the whisker itself, to second order in the distance.
        a, b = _FLANKS
        at = near + (near - far) * a * a / (b * b - a * a)
    return even(longer, max(at, 0.0) * STEP), True


def _without_lines(sides: Array) -> Array:
    """Grey values (k, 2, n) next to a line without what is dark at one or two distances only.

    Hairs and whiskers that were cut are as dark as the face that they leave.
    """
    across = np.concatenate([sides[::-1, 0], sides[:, 1]])
    for most, fill in ((np.fmax, -np.inf), (np.fmin, np.inf)):
        padded = np.pad(across, ((1, 1), (0, 0)), constant_values=fill)
        across = most(most(padded[:-2], padded[1:-1]), padded[2:])
    k = len(sides)
    return np.stack([across[:k][::-1], across[k:]], axis=1)


def _edge(sides: Array) -> float | None:
    """Index of the point at which both sides (2, n) of a line leave the dark, on average."""
    numbers, points = [], np.arange(sides.shape[1])
    for level in sides:
        known = np.isfinite(level)
        if 2 * known.sum() < len(level):
            return None
        level = np.interp(points, points[known], level[known])
        bright, dark = middle(level[len(level) // 2 :]), float(level.min())
        half = 0.5 * (bright + dark)
        last = int(np.flatnonzero(level <= half)[-1])
        if dark > 0.6 * bright or last + 1 >= len(level):
            return None
        numbers.append(last + (half - level[last]) / (level[last + 1] - level[last]))
    return float(np.mean(numbers))


def grey_flanks(frame: Frame, line: Array, away: Array, clutter: Clutter = NOTHING) -> Array:
    """Grey values (k, 2, n) at distances (k,) to the left and right of a line, pixels."""
    levels = np.empty((len(away), 2, len(line)))
    flanks(frame, np.ascontiguousarray(line), away, *clutter, levels)
    return levels


def _tip(along: Measured, darkness: float = _TAPERED, least: float = 0.0) -> int:
    """Number of points of a line that belong to the whisker.

    Beyond the tip the line is as bright as its surroundings; before it, it remains about as dark as
    before. The end is where this is most probable, by the sum of log-likelihood ratios.
    """
    sigma = along.noise * np.sqrt(DEPTH_VARIANCE)
    amplitude = np.where(along.open, along.amplitude, 0.0)
    count = np.convolve(along.open.astype(float), np.ones(20))[: len(amplitude)]
    recent = np.convolve(np.maximum(amplitude, 0.0), np.ones(20))[: len(amplitude)]
    usual = darkness * np.concatenate([[0.0], (recent / np.maximum(count, 1.0))[:-1]])
    usual = np.maximum(usual, least)
    gain = np.where(along.open, (amplitude * usual - 0.5 * usual**2) / sigma**2, 0.0)
    return int(np.argmax(np.cumsum(np.clip(gain, -8.0, 8.0)))) + 1


def _connected(seen: Mask) -> int:
    """Number of points of a line before a long hidden part, unless there is a line beyond it."""
    at = np.flatnonzero(seen)
    for before in at[:-1][np.diff(at) > _ASTRAY]:
        # By chance, or where something casts a soft shadow, every second point may seem seen.
        if not (np.convolve(seen[before + 1 :], np.ones(FEWEST)) > FEWEST - 0.5).any():
            return int(before) + 1
    return len(seen)


def _stops(frame: Frame, line: Array, along: Measured, count: int) -> bool:
    """Whether a line of so many points is seen to end, rather than to fade or be hidden."""
    before, after = slice(max(count - _LAST, 0), count), slice(count, count + _LAST // 2)
    shown = along.open
    if not shown[after].any() or min(shown[before].mean(), shown[after].mean()) < 0.5:
        return False
    if middle(grey_flanks(frame, line[before], _FLANKS[:1]).ravel()) >= np.iinfo(frame.dtype).max:
        # Where the image is saturated, faint lines are invisible.
        return False
    sigma = along.noise * np.sqrt(DEPTH_VARIANCE)
    return bool(along.amplitude[before][shown[before]].mean() > _CLEAR * sigma)


def inside(frame: Frame, point: Array) -> bool:
    """Whether a point is away from the border of the image."""
    far = np.array(frame.shape[::-1]) - 1.0 - _BORDER
    return bool((point > _BORDER).all() and (point < far).all())


def prolonged(line: Array, used: int, ahead: int) -> Array:
    """Extrapolate a line by a number of points, with a parabola through the last ones."""
    n = min(used, len(line))
    return np.concatenate([line, _onward(n, ahead) @ line[-n:]])


@cache
def _onward(used: int, ahead: int) -> Array:
    """Matrix (ahead, used) that extrapolates a parabola, or of fewer points a line or constant."""
    t = np.arange(used + ahead) / max(used - 1, 1) - 0.5
    powers = np.vander(t, min(used, 3))
    return np.asarray(powers[used:] @ np.linalg.pinv(powers[:used]))
