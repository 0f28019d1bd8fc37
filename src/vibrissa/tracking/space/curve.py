"""One whisker in space from its traces in calibrated views.

A point of one trace is in another view on its epipolar line (for the paper's orthogonal views: in
the same column of the shared axis). First the traces are matched point by point, both from base to
tip, such that the sum of distances from those lines is minimal; this gives a curve in space. Then a
cubic spline is fitted so that its images are on the traces, each trace being weighted by its
uncertainty across. If no view shows a motion of the whisker in some direction, the spline's
covariance is large in that direction. A single view does not show depth at all: its whisker is
assumed to be in the laboratory's plane z = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from itertools import islice, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.deferred import interpolate
from vibrissa.numerics import Mask, kernel
from vibrissa.tracking.trace.start import base_gap
from vibrissa.tracking.trace.trace import STEP, Trace, arc_lengths, interpolated, nearest

Array = NDArray[np.float64]

NODES = 101  # number of points of a whisker in space, equally spaced
_ENDS_APART = 8.0  # distance of tips from one point, pixels, above which views end apart
_SAMPLES = 51  # number of points of the spline that are compared with the traces
_CONTROLS = 14  # number of the spline's control points
_ROUNDS = 5  # largest number of Gauss–Newton steps
_SMALL = 1e-8  # largest motion of control points, m, after which there are no more steps
_TOGETHER = 64  # number of frames that are fitted together
_SPARSE = 2  # distance of the points of traces that are matched, in points
_ALONE = 0.05  # cost of a step along one of the two traces alone, in the matching, pixels²
_BESIDE = 2.0  # distance along a trace from its nearest point above which a point is beyond its end
_FARTHEST = 30.0  # distance from an epipolar line at which the cost saturates, pixels
# Smallest standard deviation of a trace, pixels: calibration and the spline's freedom.
_FLOOR = 0.05
# Standard deviation of third differences of the control points, as a share of the length.
_LOOSE = 0.05
_END = 1.0  # standard deviation of a trace's ends along it, pixels
_BEYOND = 6.0  # distance of a tip from the end of a trace above which it is not the same, pixels
# Distance of lines of sight at the base, pixels, from which views may begin at different points of
# the whisker; share of it, and of twice that, left at most where they begin together; and shares of
# a trace within which that is, if they also end together, and if not.
_APART, _NEARER, _CUTS = 2.0, 0.4, (0.25, 0.08)
# Number of frames by which the part is measured that only one view shows; share of the whisker, as
# its inverse, whose direction that has; smallest length of its image, pixels; and percentile of
# lengths that is the whisker's.
_SOME, _NEAR_BASE, _TINY, _USUAL = 32, 10, 1.0, 75.0
# Standard deviation of the distance from the plane in which a single view's whisker is, m.
_LEVEL = 1e-7
# Standard deviation of a point's motion along the curve in a round, in units of their distance.
_SLIDING = 0.3


class SpaceCurve(NamedTuple):
    """Whisker in space."""

    # (NODES, 3) Points from the base to where the first of the views ends, laboratory frame, m; NaN
    # if there is none.
    points: Array
    covariance: Array  # (NODES, 3, 3), covariance of each point, m²
    # Root mean square distance of its images from the traces, in their standard deviations.
    misfit: float

    @classmethod
    def none(cls) -> SpaceCurve:
        """Empty curve for a frame without a whisker."""
        return cls(np.full((NODES, 3), np.nan), np.full((NODES, 3, 3), np.nan), np.nan)

    @property
    def length(self) -> float:
        """Length along the points, m."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())


def merge(cameras: Sequence[Camera], traces: Sequence[Trace]) -> SpaceCurve:
    """Find the whisker in space that the views show.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras of the views; the whisker of a single one is taken to be in the plane z = 0.
    traces : sequence of Trace
        Traces of one whisker in one frame, view by view.

    Returns
    -------
    SpaceCurve
        The whisker; NaN if a trace is missing, or does not show the whisker's base.

    Raises
    ------
    ValueError
        If there is not a trace for each camera.
    """
    if not cameras or len(cameras) != len(traces):
        raise ValueError(f"{len(cameras)} cameras and {len(traces)} traces: one each is needed")
    return next(merged(cameras, [traces]))


def merged(cameras: Sequence[Camera], frames: Iterable[Sequence[Trace]]) -> Iterator[SpaceCurve]:
    """Merge the traces, view by view, of many frames."""
    source = iter(frames)
    while rows := list(islice(source, _TOGETHER)):
        curves = [SpaceCurve.none()] * len(rows)
        shown = [i for i, views in enumerate(rows) if all(map(_usable, views))]
        starts = _matched(cameras, [rows[i] for i in shown]) if shown else []
        whole = [k for k, one in enumerate(starts) if len(one) >= 8 and np.isfinite(one).all()]
        if whole:
            shown = [shown[k] for k in whole]
            even = np.array([_evenly_spaced(starts[k], _SAMPLES) for k in whole])
            fits = _fitted(cameras, [rows[i] for i in shown], even)
            for i, curve in zip(shown, fits, strict=True):
                curves[i] = curve
        yield from curves


def all_merged(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    progress: Callable[[int, int], None],
) -> list[SpaceCurve]:
    """Merge all frames of a whisker's traces by view, reporting each."""
    curves = []
    for curve in merged(cameras, zip(*traces, strict=True)):
        curves.append(curve)
        progress(len(curves), len(traces[0]))
    return curves


def begun_together(
    cameras: Sequence[Camera], traces: Sequence[Sequence[Trace]]
) -> list[list[Trace]]:
    """Traces of two views, starting where both show the whisker.

    Fur may hide its base in one view more than in the other, and in front of grey fur a trace may
    begin at a streak of it: the base of one view is then, in the other, on the whisker and not at
    its base. A part that only one view shows has no position in space.
    """
    if len(cameras) != 2:
        return [list(view) for view in traces]
    pairs = list(zip(*traces, strict=True))
    whole = [i for i, both in enumerate(pairs) if all(map(_usable, both))]
    ends = np.array([[[pairs[i][v].line[k] for i in whole] for v in (0, 1)] for k in (0, -1)])
    gaps = [base_gap(cameras, end) for end in ends.reshape(2, 2, -1, 2)]
    best, parts = dict[int, tuple[float, int, int]](), list[tuple[int, int, Array]]()
    for i, gap, at_tip in zip(whole, *gaps, strict=True):
        if gap < _APART:
            continue
        best[i] = (min(_NEARER * gap, 2.0 * _APART), 0, 0)
        for view in (0, 1):
            line = pairs[i][view].line
            parts.append((i, view, line[: int(_CUTS[int(at_tip > _ENDS_APART)] * len(line))]))
    if not parts:
        return [list(view) for view in traces]
    pixels = [
        np.concatenate([p if v == view else 0.0 * p + pairs[i][v].line[0] for i, view, p in parts])
        for v in (0, 1)
    ]
    away = np.split(base_gap(cameras, np.stack(pixels)), np.cumsum([len(p) for *_, p in parts]))
    for (i, view, part), gap in zip(parts, away[:-1], strict=True):
        if len(part) and gap.min() < best[i][0]:
            best[i] = gap.min(), view, int(np.argmin(gap))
    more = np.zeros(len(pairs))
    for i, (_, view, first) in best.items():
        one = pairs[i][view]
        more[i] = STEP * first * (1 - 2 * view)
        one = one._replace(line=one.line[first:], sigma=one.sigma[first:], seen=one.seen[first:])
        pairs[i] = (one, pairs[i][1]) if view == 0 else (pairs[i][0], one)
    # Where one view shows more in some frames only, both begin elsewhere on the whisker in these.
    sigma = max(0.5 * float(np.ptp(np.percentile(more[whole], [16.0, 84.0]))), _END)
    pairs = [tuple(trace._replace(begin_sigma=sigma) for trace in both) for both in pairs]
    return [list(view) for view in zip(*pairs, strict=True)]


class HiddenPart(NamedTuple):
    """Part of a whisker before the first point that both views show."""

    more: float = 0.0  # length that one view shows, m
    longest: float = 0.0  # length of the whisker with it; 0 if all frames begin at one point

    def before(self, length: float) -> float:
        """Length before a shape at rest of a length, whose frames may show less or more."""
        return max(self.longest - length, 0.0) if self.longest else self.more


def shown_by_one(
    cameras: Sequence[Camera],
    traces: Sequence[Sequence[Trace]],
    begun: Sequence[Sequence[Trace]],
) -> HiddenPart:
    """What only one view shows of a whisker before where both do; see `begun_together`.

    It is that of the frames that show most of the whisker, in all views and in one.
    """
    whole = [both for both in zip(*traces, *begun, strict=True) if all(map(_usable, both))]
    if len(cameras) == 1 or not whole:
        return HiddenPart()
    lengths = []
    some = [whole[i] for i in np.unique(np.linspace(0, len(whole) - 1, _SOME).astype(int))]
    for both, curve in zip(some, merged(cameras, [b[len(cameras) :] for b in some]), strict=True):
        near = curve.points[: NODES // _NEAR_BASE]
        images = [camera.project(near) for camera in cameras]
        seen = np.linalg.norm(np.diff(images, axis=1), axis=2).sum(axis=1)
        cut = [both[v].length - both[v + len(cameras)].length for v in range(len(cameras))]
        more = np.max(np.array(cut) * arc_lengths(near)[-1] / np.maximum(seen, _TINY))
        lengths.append((curve.length, curve.length + more))
    known = np.isfinite(lengths).all(axis=1)
    shown = np.percentile(np.array(lengths)[known], _USUAL, axis=0) if known.any() else np.zeros(2)
    apart = any(trace.begin_sigma > _END for view in begun for trace in view)
    return HiddenPart(float(shown[1] - shown[0]), float(shown[1]) if apart else 0.0)


def _usable(trace: Trace) -> bool:
    return len(trace.line) >= 8 and trace.base_seen


def _matched(cameras: Sequence[Camera], frames: Sequence[Sequence[Trace]]) -> list[Array]:
    """Points (n, 3) of each frame by matching the first trace with the others."""
    base = triangulate(
        cameras, np.array([[views[v].line[0] for views in frames] for v in range(len(cameras))])
    )[0]
    lines = [views[0].line[::_SPARSE] for views in frames]
    bounds = np.cumsum([0, *map(len, lines)])
    first, of = np.concatenate(lines), np.repeat(np.arange(len(frames)), np.diff(bounds))
    origin, direction = cameras[0].rays(first)
    # Two points of each ray near the base: their images make the epipolar line.
    depth = ((base[of] - origin) * direction).sum(axis=1)
    slopes = cameras[0].project_with_slopes(base)[1]
    scale = 1.0 / np.linalg.norm(slopes, axis=1).max(axis=1)[of]
    ends = [origin + (depth + 100.0 * sign * scale)[:, None] * direction for sign in (-1.0, 1.0)]
    pixels = [first]
    for v, camera in enumerate(cameras[1:], start=1):
        a, b = (camera.project(end) for end in ends)
        normal = np.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        offset, partner = (a * normal).sum(axis=1), np.empty_like(first)
        for views, i, j in zip(frames, bounds[:-1], bounds[1:], strict=True):
            other, place = np.ascontiguousarray(views[v].line[::_SPARSE]), np.empty(j - i)
            match(normal[i:j], offset[i:j], other, place)
            partner[i:j] = interpolated(place, np.arange(len(other)), other)
        pixels.append(partner)
    points = triangulate(cameras, np.stack(pixels))[0]
    known: Mask = np.asarray(np.isfinite(pixels).all(axis=(0, 2)))
    return [points[i:j][known[i:j]] for i, j in pairwise(bounds)]


@kernel
def match(normal: Any, offset: Any, other: Any, place: Any) -> None:
    """Mean index, for each epipolar line, of the points matched with it; NaN after the last.

    Both are matched in order, along the cheapest monotone path from the first corner of all
    distances to the last row or column.
    """
    n, m = normal.shape[0], other.shape[0]
    total = np.empty((n, m))
    for i in range(n):
        for j in range(m):
            best = 0.0 if i == 0 and j == 0 else np.inf
            # A step in one direction alone costs a little, so that both advance together.
            if i > 0 and j > 0:
                best = min(best, total[i - 1, j - 1])
            if i > 0:
                best = min(best, total[i - 1, j] + _ALONE)
            if j > 0:
                best = min(best, total[i, j - 1] + _ALONE)
            miss = normal[i, 0] * other[j, 0] + normal[i, 1] * other[j, 1] - offset[i]
            miss = min(abs(miss), _FARTHEST)
            total[i, j] = best + miss * miss
        place[i] = np.nan
    i, j, least = n - 1, m - 1, np.inf
    # Per step of the path, so that a short one has no advantage.
    for k in range(m):
        mean = total[n - 1, k] / (n + k)
        if mean <= least:
            i, j, least = n - 1, k, mean
    for k in range(n):
        mean = total[k, m - 1] / (m + k)
        if mean <= least:
            i, j, least = k, m - 1, mean
    high = j
    while i > 0 or j > 0:
        both = total[i - 1, j - 1] if i > 0 and j > 0 else np.inf
        up = total[i - 1, j] + _ALONE if i > 0 else np.inf
        back = total[i, j - 1] + _ALONE if j > 0 else np.inf
        if back < both and back < up:
            j -= 1
            continue
        place[i] = 0.5 * (j + high)
        i -= 1
        if both <= up:
            j -= 1
        high = j
    place[0] = 0.5 * high


def _evenly_spaced(points: Array, count: int) -> Array:
    """Points equally spaced along a polyline, without those that hardly move."""
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.concatenate([[True], step > 1e-3 * np.median(step)])]
    s = arc_lengths(points)
    return interpolated(np.linspace(0.0, s[-1], count), s, points)


_KNOTS = np.concatenate([[0.0] * 3, np.linspace(0.0, 1.0, _CONTROLS - 2), [1.0] * 3])
_THIRD = np.diff(np.eye(_CONTROLS), n=3, axis=0)


@cache
def _basis(count: int) -> Array:
    """Spline basis (count, _CONTROLS) at equal distances."""
    places = np.linspace(0.0, 1.0, count)
    return np.asarray(interpolate.BSpline.design_matrix(places, _KNOTS, 3).toarray())


@cache
def _pairs(count: int) -> Array:
    """Products (count, _CONTROLS²) of each two functions of that basis."""
    basis = _basis(count)
    return np.asarray((basis[:, :, None] * basis[:, None]).reshape(count, -1))


def _fitted(
    cameras: Sequence[Camera], frames: Sequence[Sequence[Trace]], starts: Array
) -> list[SpaceCurve]:
    """Gauss-Newton fit to the distances of the splines' images from the traces."""
    basis, count = _basis(_SAMPLES), len(frames)
    control = np.linalg.pinv(basis) @ starts
    size = np.linalg.norm(np.diff(starts, axis=1), axis=2).sum(axis=1)
    # Weak: the continuation of the whisker matters only where nothing is seen.
    stiff = np.kron(_THIRD.T @ _THIRD, np.eye(3)) / (_LOOSE * size[:, None, None]) ** 2
    hessian, misfit = stiff.copy(), np.full(count, np.nan)
    rows, traces = np.arange(count), [_Lines.of(view) for view in zip(*frames, strict=True)]
    for _ in range(_ROUNDS):
        points = basis @ control[rows]
        # Points may slide along the curve by a fraction of their spacing per iteration.
        along = np.gradient(points, axis=1)
        spacing = np.linalg.norm(along, axis=2, keepdims=True)
        along /= spacing * _SLIDING * spacing.mean(axis=1, keepdims=True)
        square, pull = along[..., None] * along[..., None, :], np.zeros_like(points)
        sums = np.tile([0.0, _SAMPLES], (len(rows), 1))
        if len(cameras) == 1:
            square[..., 2, 2] += _LEVEL**-2.0
            pull[..., 2] = -points[..., 2] * _LEVEL**-2.0
            sums[:, 0] = (points[..., 2] ** 2).sum(axis=1) * _LEVEL**-2.0
            sums[:, 1] += _SAMPLES
        for camera, lines in zip(cameras, traces, strict=True):
            pixels, slopes = camera.project_with_slopes(points)
            compare(pixels, slopes, lines, rows, (square, pull, sums))
        data = _pairs(_SAMPLES).T @ square.reshape(len(rows), _SAMPLES, 9)
        data = data.reshape(-1, _CONTROLS, _CONTROLS, 3, 3).swapaxes(2, 3)
        data = data.reshape(len(rows), *stiff.shape[1:])
        right = (basis.T @ pull).reshape(len(rows), -1, 1)
        hessian[rows] = data + stiff[rows]
        gradient = right - stiff[rows] @ control[rows].reshape(len(rows), -1, 1)
        step = np.linalg.solve(hessian[rows], gradient)
        control[rows] += step.reshape(-1, *control.shape[1:])
        left = sums[:, 0] + (step * (data @ step - 2.0 * right)).sum(axis=(1, 2))
        misfit[rows] = np.sqrt(np.maximum(left, 0.0) / sums[:, 1])
        rows = rows[np.abs(step).max(axis=(1, 2)) >= _SMALL]
        if not rows.size:
            break
    spread = np.linalg.inv(hessian).reshape(-1, _CONTROLS, 3, _CONTROLS, 3)
    covariance = _pairs(NODES) @ spread.swapaxes(2, 3).reshape(count, -1, 9)
    covariance = (
        covariance.reshape(-1, NODES, 3, 3) * np.maximum(1.0, misfit**2)[:, None, None, None]
    )
    dense = _basis(8 * NODES) @ control
    if len(cameras) == 1:
        dense[..., 2] = 0.0
    even = (_evenly_spaced(line, NODES) for line in dense)
    return list(map(SpaceCurve, even, covariance, misfit.tolist()))


class _Lines(NamedTuple):
    """Traces of one view in several frames, one after the other."""

    bounds: NDArray[np.intp]  # (frame + 1,)
    line: Array
    tangent: Array
    sigma: Array
    tips: Mask  # (frame,): whether they are seen to end there
    step: float  # largest distance of two points

    @classmethod
    def of(cls, traces: Sequence[Trace]) -> _Lines:
        """Join traces."""
        tangents = [np.gradient(trace.line, axis=0) for trace in traces]
        tangent = np.concatenate(tangents)
        steps = [np.linalg.norm(np.diff(t.line, axis=0), axis=1).max() for t in traces]
        return cls(
            np.cumsum([0, *(len(trace.line) for trace in traces)]),
            np.concatenate([trace.line for trace in traces]),
            tangent / np.linalg.norm(tangent, axis=1, keepdims=True),
            np.sqrt(np.concatenate([trace.sigma for trace in traces]) ** 2 + _FLOOR**2),
            np.array([trace.tip_seen for trace in traces]),
            float(max(steps)),
        )


@kernel
def compare(pixels: Any, slopes: Any, lines: Any, rows: Any, found: Any) -> None:
    """Add the distances of points' images from a view's traces, in standard deviations.

    Those found are the normal equations of each point, and the sum of squares and the number of
    distances of each frame.
    """
    bounds, line, tangent, sigma, tips, step = lines
    square, pull, sums = found
    last = pixels.shape[1] - 1
    for f in range(rows.shape[0]):
        begin, end = bounds[rows[f]], bounds[rows[f] + 1]
        near = begin
        for j in range(last + 1):
            x, y = pixels[f, j, 0], pixels[f, j, 1]
            near = nearest(line, begin, end, x, y, step, near)
            for k in range(2):
                # The distance across, then that along, of an end of the trace.
                at = near if k == 0 else (begin if j == 0 else end - 1)
                dx, dy = line[at, 0] - x, line[at, 1] - y
                tx, ty = tangent[at, 0], tangent[at, 1]
                gap, weight = dx * tx + dy * ty, 1.0 / _END
                if k == 0:
                    if not abs(gap) <= _BESIDE:
                        continue
                    tx, ty, gap, weight = -ty, tx, dy * tx - dx * ty, 1.0 / sigma[at]
                # The whisker may continue in another view where this one no longer shows it.
                elif j != 0 and not (j == last and tips[rows[f]] and abs(gap) < _BEYOND):
                    continue
                for a in range(3):
                    left = weight * weight * (tx * slopes[f, j, 0, a] + ty * slopes[f, j, 1, a])
                    pull[f, j, a] += left * gap
                    for b in range(3):
                        square[f, j, a, b] += left * (
                            tx * slopes[f, j, 0, b] + ty * slopes[f, j, 1, b]
                        )
                sums[f, 0] += (weight * gap) ** 2
                sums[f, 1] += 1.0
