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

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.deferred import interpolate
from vibrissa.numerics import kernel
from vibrissa.tracking.trace.start import base_gap
from vibrissa.tracking.trace.trace import Trace, arc_lengths, interpolated

Array = NDArray[np.float64]

NODES = 101  # number of points of a whisker in space, equally spaced
_SAMPLES = 51  # number of points of the spline that are compared with the traces
_CONTROLS = 14  # number of the spline's control points
_ROUNDS = 5  # largest number of Gauss–Newton steps
_SPARSE = 2  # distance of the points of traces that are matched, in points
_FARTHEST = 30.0  # distance from an epipolar line at which the cost saturates, pixels
# Smallest standard deviation of a trace, pixels: calibration and the spline's freedom.
_FLOOR = 0.05
# Standard deviation of third differences of the control points, as a share of the length.
_LOOSE = 0.05
_END = 1.0  # standard deviation of a trace's ends along it, pixels
_BEYOND = 6.0  # distance of a tip from the end of a trace above which it is not the same, pixels
# Distance of lines of sight at the base, pixels, from which views may begin at different points of
# the whisker; share of it, and of twice that, left at most where they begin together; and share of
# a trace within which that is.
_APART, _NEARER, _CUT = 2.0, 0.4, 0.08
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
    if not all(map(_usable, traces)):
        return SpaceCurve.none()
    start = _matched(cameras, traces)
    if len(start) < 8 or not np.isfinite(start).all():
        return SpaceCurve.none()
    return _fitted(cameras, traces, _evenly_spaced(start, _SAMPLES))


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
    bases = np.array([[pairs[i][view].line[0] for i in whole] for view in (0, 1)])
    for i, gap in zip(whole, base_gap(cameras, bases.reshape(2, -1, 2)), strict=True):
        if not gap < _APART:
            pairs[i] = _cut(cameras, pairs[i], gap)
    return [list(view) for view in zip(*pairs, strict=True)]


def _usable(trace: Trace) -> bool:
    return len(trace.line) >= 8 and trace.base_seen


def _cut(cameras: Sequence[Camera], both: tuple[Trace, ...], gap: float) -> tuple[Trace, ...]:
    """Both traces of a frame, whose bases are a gap apart, the one that begins earlier cut."""
    best, place = min(_NEARER * gap, 2.0 * _APART), (0, 0)
    for view, other in ((0, 1), (1, 0)):
        line = both[view].line[: int(_CUT * len(both[view].line))]
        base = np.broadcast_to(both[other].line[0], line.shape)
        gaps = base_gap(cameras, np.stack([line, base] if view == 0 else [base, line]))
        if len(gaps) and gaps.min() < best:
            best, place = gaps.min(), (view, int(np.argmin(gaps)))
    view, first = place
    one = both[view]
    cut = one._replace(line=one.line[first:], sigma=one.sigma[first:], seen=one.seen[first:])
    return (cut, both[1]) if view == 0 else (both[0], cut)


def _matched(cameras: Sequence[Camera], traces: Sequence[Trace]) -> Array:
    """Points (n, 3) by matching the first trace with the others."""
    first = traces[0].line[::_SPARSE]
    partners = [np.zeros(len(first))]
    base = triangulate(cameras, np.stack([trace.line[0] for trace in traces]))[0]
    origin, direction = cameras[0].rays(first)
    # Two points of each ray near the base: their images make the epipolar line.
    depth = ((base - origin) * direction).sum(axis=1)
    scale = 1.0 / np.linalg.norm(cameras[0].project_with_slopes(base)[1], axis=0).max()
    ends = [origin + (depth + 100.0 * sign * scale)[:, None] * direction for sign in (-1.0, 1.0)]
    for camera, trace in zip(cameras[1:], traces[1:], strict=True):
        a, b = (camera.project(end) for end in ends)
        normal = np.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        other = trace.line[::_SPARSE]
        miss = np.abs(other @ normal.T - (a * normal).sum(axis=1)).T
        partners.append(_partners(np.minimum(miss, _FARTHEST) ** 2))
    known = np.all([np.isfinite(p) for p in partners], axis=0)
    pixels = [first[known]]
    for p, trace in zip(partners[1:], traces[1:], strict=True):
        other = trace.line[::_SPARSE]
        pixels.append(interpolated(p[known], np.arange(len(other)), other))
    return triangulate(cameras, np.stack(pixels))[0]


def _partners(cost: Array) -> Array:
    """Mean column of the cheapest monotone path for each row; NaN after its end."""
    rows = np.empty(sum(cost.shape), np.int64)
    columns = np.empty_like(rows)
    count = cheapest_path(np.ascontiguousarray(cost), rows, columns)
    total = np.bincount(rows[:count], columns[:count], cost.shape[0])
    number = np.bincount(rows[:count], minlength=cost.shape[0])
    return np.asarray(np.where(number > 0, total / np.maximum(number, 1), np.nan))


@kernel
def cheapest_path(cost: Any, rows: Any, columns: Any) -> int:
    """Cheapest monotone path from the first corner to the last row or column."""
    n, m = cost.shape
    total = np.empty((n, m))
    for i in range(n):
        for j in range(m):
            best = 0.0 if i == 0 and j == 0 else np.inf
            # A step in one direction alone costs a little, so that both advance together.
            if i > 0 and j > 0:
                best = min(best, total[i - 1, j - 1])
            if i > 0:
                best = min(best, total[i - 1, j] + 0.05)
            if j > 0:
                best = min(best, total[i, j - 1] + 0.05)
            total[i, j] = best + cost[i, j]
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
    count = 0
    while True:
        rows[count], columns[count] = i, j
        count += 1
        if i == 0 and j == 0:
            return count
        if i == 0:
            j -= 1
        elif j == 0:
            i -= 1
        else:
            a, b, c = total[i - 1, j - 1], total[i - 1, j] + 0.05, total[i, j - 1] + 0.05
            if a <= b and a <= c:
                i, j = i - 1, j - 1
            elif b <= c:
                i -= 1
            else:
                j -= 1


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


def _fitted(cameras: Sequence[Camera], traces: Sequence[Trace], start: Array) -> SpaceCurve:
    """Gauss-Newton fit to the distances of the spline's images from the traces."""
    basis = _basis(_SAMPLES)
    control = np.linalg.lstsq(basis, start)[0]
    size = float(np.linalg.norm(np.diff(start, axis=0), axis=1).sum())
    # Weak: the continuation of the whisker matters only where nothing is seen.
    stiff = np.kron(_THIRD.T @ _THIRD, np.eye(3)) / (_LOOSE * size) ** 2
    hessian, misfit = stiff, np.nan
    tangents = [np.gradient(trace.line, axis=0) for trace in traces]
    tangents = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in tangents]
    for _ in range(_ROUNDS):
        node, rows, misses = _equations(cameras, traces, tangents, basis @ control)
        design = (basis[node][:, :, None] * rows[:, None, :]).reshape(len(rows), -1)
        hessian = design.T @ design + stiff
        gradient = design.T @ misses - stiff @ control.reshape(-1)
        step = np.linalg.solve(hessian, gradient).reshape(-1, 3)
        control = control + step
        misfit = float(np.sqrt(np.mean((misses - design @ step.reshape(-1)) ** 2)))
        if np.abs(step).max() < 1e-8:
            break
    spread = np.linalg.inv(hessian).reshape(_CONTROLS, 3, _CONTROLS, 3)
    basis = _basis(NODES)
    half = np.tensordot(basis, spread, axes=1)  # (node, 3, control, 3)
    covariance = np.einsum("ialb,il->iab", half, basis) * max(1.0, misfit**2)
    dense = _basis(8 * NODES) @ control
    if len(cameras) == 1:
        dense[:, 2] = 0.0
    return SpaceCurve(_evenly_spaced(dense, NODES), covariance, misfit)


def _equations(
    cameras: Sequence[Camera], traces: Sequence[Trace], tangents: Sequence[Array], points: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Node (r,), gradient (r, 3) and residuals (r,) of all equations, in standard deviations."""
    along = np.gradient(points, axis=0)
    spacing = np.linalg.norm(along, axis=1, keepdims=True)
    # Points may slide along the curve by a fraction of their spacing per iteration.
    nodes = [np.arange(_SAMPLES)]
    rows = [along / spacing / (_SLIDING * spacing.mean())]
    misses = [np.zeros(_SAMPLES)]
    if len(cameras) == 1:
        nodes.append(np.arange(_SAMPLES))
        rows.append(np.tile([0.0, 0.0, 1.0 / _LEVEL], (_SAMPLES, 1)))
        misses.append(-points[:, 2] / _LEVEL)
    for camera, trace, tangent in zip(cameras, traces, tangents, strict=True):
        pixels, slopes = camera.project_with_slopes(points)
        line = trace.line
        near = np.argmin((line**2).sum(axis=1) - 2.0 * pixels @ line.T, axis=1)
        t, away = tangent[near], line[near] - pixels
        across = np.stack([-t[:, 1], t[:, 0]], axis=1)
        beyond = np.abs((away * t).sum(axis=1)) > 2.0
        sigma = np.sqrt(trace.sigma[near] ** 2 + _FLOOR**2)
        used = np.flatnonzero(~beyond)
        nodes.append(used)
        rows.append((across[:, None] @ slopes)[used, 0] / sigma[used, None])
        misses.append(((away * across).sum(axis=1) / sigma)[used])
        for node, end in ((0, 0), (_SAMPLES - 1, -1)):
            gap = float((line[end] - pixels[node]) @ tangent[end])
            # The whisker may continue in another view where this one no longer shows it.
            if node == 0 or (trace.tip_seen and abs(gap) < _BEYOND):
                nodes.append(np.array([node]))
                rows.append(tangent[end][None, :] @ slopes[node] / _END)
                misses.append(np.array([gap / _END]))
    return np.concatenate(nodes), np.concatenate(rows), np.concatenate(misses)
