"""Shape at rest beyond where all views show the whisker, by the view that shows more of it.

A wall, or the edge of an image, may cut a whisker off in one view only. The whisker merged from the
views ends there, although another view shows it to its tip. Beyond the end of its shape p(s) at
rest, at s = ℓ, it is extrapolated with the curvature of its outer part and corrected,

    p(ℓ + x) = e(x) + a x² + b x³,

with vectors a and b that are fitted to the traces of free frames, whose poses are those of the
shared part. Priors of a and b say that the curvature may go on to change as it does along the
shared part, so directions that no view shows remain extrapolated, and uncertain by that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vibrissa.cameras import Camera
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.refine.rods import TraceSeries
from vibrissa.tracking.space.pose import HeadPose
from vibrissa.tracking.space.rest_shape import (
    LEAST_SEEN,
    Length,
    RestShape,
    aligned_lengths,
    length_shown,
    lengthened,
    motions,
    seen_length,
    unseen_part,
)
from vibrissa.tracking.trace.trace import arc_lengths

# Least share of its length by which a view shows more of a whisker, and number of frames that do.
_MORE, _FEWEST = 0.05, 3
_NEAR = 4.0  # largest distance of the end of a shape from a trace that goes on, pixels
_SHARED = 0.85  # share of the shape that gives a frame's pose
_ROUNDS = 4  # number of times that it is fitted, and how far it is shown is measured
_ALIKE = 10.0  # number of neighbouring errors of traces that count as one
_STEPS = 5  # number of Gauss–Newton steps, and of points' distances ahead of an end for its tangent
_LEAST = 0.3  # smallest expected change of the curvature over the shape, over the inverse length


@dataclass(frozen=True, eq=False)
class _Posed:
    """Traces of free frames, and their poses."""

    cameras: Sequence[Camera]
    traces: TraceSeries
    head: HeadPose
    rotation: Array  # (t, 3, 3), and
    shift: Array  # (t, 3): motions that move the whisker of a frame onto the shape at rest

    def put(self, points: Array) -> Array:
        """Points (n, 3) of the shape in all frames, (t, n, 3)."""
        away = points - self.shift[:, None]
        return self.head.put_in(np.einsum("tij,tni->tnj", self.rotation, away))

    def longer(self, view: int, end: Array) -> Array:
        """By how many pixels the traces (t,) of a view go on beyond a point; NaN if far from it."""
        at = self.cameras[view].project(self.put(end[None]))[:, 0]
        line = self.traces.line[:, view]
        step = np.linalg.norm(np.diff(line, axis=1), axis=2).mean(axis=1)
        away = np.linalg.norm(line - at[:, None], axis=2)
        near = np.argmin(np.nan_to_num(away, nan=np.inf), axis=1)
        more = (line.shape[1] - 1 - near) * step
        return np.where(away[np.arange(len(away)), near] < _NEAR, more, np.nan)

    def reached(self, view: int, points: Array, pixels: Array) -> Array:
        """Arc length (t,) along points (n, 3), m, at which their image is so many pixels long."""
        image = self.cameras[view].project(self.put(points))
        seen = np.linalg.norm(np.diff(image, axis=1), axis=2)
        seen = np.pad(np.cumsum(seen, axis=1), ((0, 0), (1, 0)))
        s = arc_lengths(points)
        inside = [np.interp(p, one, s) for p, one in zip(pixels, seen, strict=True)]
        return np.asarray(inside + np.maximum(pixels / seen[:, -1] - 1.0, 0.0) * s[-1])


def continued(
    shape: RestShape,
    curves: Array,
    cameras: Sequence[Camera],
    traces: TraceSeries,
    head: HeadPose,
    tapers: bool,
) -> tuple[RestShape, Length] | None:
    """Continue a shape at rest as far as one view shows it; None if none shows more."""
    posed = _posed(shape, curves, cameras, traces, head)
    if posed is None or len(cameras) == 1:
        return None
    pixels = [posed.longer(view, shape.points[-1]) for view in range(len(cameras))]
    view = int(np.argmax([np.nanmedian(np.append(more, 0.0)) for more in pixels]))
    known = np.isfinite(pixels[view])
    ahead = _STEPS * (shape.points[-1] - shape.points[-2])
    first = posed.reached(view, shape.points[-1] + np.outer([0.0, 1.0], ahead), pixels[view])[known]
    if len(first) < _FEWEST or np.median(first) < _MORE * shape.length:
        return None
    at_tip = posed.traces.ends[known, view, 1] > 0.5
    more, bending = first, np.zeros((3, 3))
    for _ in range(_ROUNDS):
        total, whole = length_shown(shape.length + more, at_tip)
        if not total > shape.length:  # frames that show the tip show no more
            return None
        if shape.length < LEAST_SEEN * total:
            raise ValueError(_too_short(posed, view))
        longer, bending = _fitted(posed, shape, total)
        outer = longer.points[len(shape.points) - 1 :]
        more = posed.reached(view, outer, pixels[view])[known]
    length = seen_length(
        shape.length + (more[at_tip] if whole else more), posed.traces.line[:, [view]], tapers
    )
    length = length._replace(value=longer.length, shown=shape.length, bending=bending)
    return replace(longer, whole=whole), length


def _too_short(posed: _Posed, view: int) -> str:
    """Say that only one view shows most of a whisker."""
    steps = np.linalg.norm(np.diff(posed.traces.line, axis=2), axis=3)
    pixels = np.nanmedian(steps.sum(axis=2), axis=0)
    shown = ", ".join(
        f"{camera.name} over {size:.0f}" for camera, size in zip(posed.cameras, pixels, strict=True)
    )
    return (
        f"the views show too little of one whisker to locate it: {shown} pixels (median), and what "
        f"{posed.cameras[view].name} shows goes on far beyond. Either another view follows "
        "something else, such as a whisker that was cut, or it hides most of it: look at the "
        "traces, and, of videos, state where it begins in each view (`vibrissa track --base`)"
    )


def _fitted(posed: _Posed, shape: RestShape, total: float) -> tuple[RestShape, Array]:
    """Shape of some total length that fits the traces, and its bending; see `Length`."""
    longer = lengthened(shape, total)
    count, points = len(shape.points), longer.points.copy()
    x = (total - shape.length) * np.linspace(0.0, 1.0, len(points) - count + 1)[1:]
    powers = np.stack([x**2, x**3], axis=1)
    prior = unseen_part(shape, Length(total, 0.0))
    least = max(float(prior.bending[0, 0]), _LEAST / shape.length**2)
    # The two parts of `astray`, by its values at one and two lengths.
    parts = np.linalg.solve([[1.0, 1.0], [4.0, 8.0]], prior.astray(shape.length * np.array([1, 2])))
    sigma = np.repeat(least * parts / shape.length ** np.array([2, 3]), 2)
    # Points may move across the whisker; where on it they are has no meaning.
    ahead = longer.points[count] - longer.points[count - 1]
    across = np.linalg.svd(ahead[None])[2][1:]
    modes = np.einsum("np,qi->npqi", powers, across).reshape(-1, 4, 3)
    turn = posed.head.rotation @ np.swapaxes(posed.rotation, 1, 2)
    solution, inverse = np.zeros(4), np.zeros((4, 4))
    for _ in range(_STEPS):
        put = posed.put(points[count:])
        data, pull, square, number = np.zeros((4, 4)), np.zeros(4), 0.0, 0
        for view, camera in enumerate(posed.cameras):
            pixels, slopes = camera.project_with_slopes(put)
            rows, misses, _ = posed.traces.equations(view, pixels, slopes @ turn[:, None])
            # The last two rows are of the ends.
            design = np.einsum("npi,tni->tnp", modes, rows[:, :-2]).reshape(-1, 4)
            missed = misses[:, :-2].ravel()
            data += design.T @ design
            pull += design.T @ missed
            square += float(missed @ missed)
            number += int(np.count_nonzero(missed))
        # Frames have most errors in common, and so have neighbouring points.
        weight = 1.0 / (_ALIKE * len(turn) * max(1.0, square / max(number, 1)))
        inverse = np.asarray(np.linalg.inv(np.diag(sigma**-2.0) + weight * data))
        step = inverse @ (weight * pull - solution / sigma**2)
        solution = solution + step
        points[count:] += np.einsum("npi,p->ni", modes, step)
    size, axes = np.linalg.eigh(modes[-1].T @ inverse @ modes[-1])
    bending = np.sqrt(np.maximum(size, 0.0))[:, None] * axes.T / prior.astray(x[-1])
    return replace(longer, points=points), bending


def _posed(
    shape: RestShape, curves: Array, cameras: Sequence[Camera], traces: TraceSeries, head: HeadPose
) -> _Posed | None:
    """Free frames that show enough of the whisker, and their poses; None if they are few."""
    frames = np.flatnonzero(shape.still & np.isfinite(curves).all(axis=(1, 2)))
    if len(frames) < _FEWEST:
        return None
    shapes = aligned_lengths(curves[frames], shape.spacing)[1]
    n = int(_SHARED * len(shape.points))
    known: Mask = np.asarray(np.isfinite(shapes[:, :n]).all(axis=(1, 2)))
    if known.sum() < _FEWEST:
        return None
    frames = frames[known]
    motion = motions(shapes[known, :n], shape.points[:n])
    return _Posed(cameras, traces.rows(frames), head.rows(frames), *motion)
