"""Beginning of a whisker at which its traces are on something else in all frames.

Fur, a hair, or a neighbour that was cut covers a part of a whisker next to its base, and draws the
traces aside there, or they follow it. As it moves with the whisker, the shape at rest has the same
hook, which no whisker has: the curvature of a whisker changes slowly along it. Beyond the hook the
shape is a polynomial of low degree in the arc length, and the whisker goes on as this does.

There is a hook if polynomials of higher degree, which strongly curved whiskers are, do not fit all
of the shape. It ends where those that begin farther out fit hardly better, and counts if it is
larger than what traces err by anyhow; traces show nothing of the whisker there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vibrissa.cameras import Camera
from vibrissa.numerics import Array
from vibrissa.tracking.refine.rods import TraceSeries
from vibrissa.tracking.space.pose import BasePose
from vibrissa.tracking.space.rest_shape import RestShape
from vibrissa.tracking.trace.trace import correlated
from vibrissa.whisker import Whisker

# Shares of the shape before which a hook may end, and where its tip becomes uncertain.
_ENDS, _TIP = (0.0, 0.03, 0.06, 0.09, 0.12, 0.16, 0.2, 0.24, 0.28, 0.32, 0.36), 0.9
# Degrees of the polynomials; residuals, over those of the best one, with which one is good enough,
# and below which all are, pixels.
_DEGREES, _ALIKE, _SMALL = (3, 4, 5), 1.5, 0.01
# Degree of a polynomial that all of a smooth shape is, and its residual over the same.
_WHOLE, _AS_WELL = 7, 2.0
# Size of a hook from which it counts, pixels and in standard deviations.
_LARGE, _SURE = 0.3, 2.0
# Standard deviation of where a whisker goes on: in that of the fit, as long waves of the errors are
# like polynomials; share of the difference made by another degree; and the smallest one, pixels, by
# which a shape must be aside for its traces not to count.
_WAVES, _OTHER, _LEAST = 3.0, 0.5, 0.1


@dataclass(frozen=True, eq=False)
class Hook:
    """Part of a shape at rest that is not on the whisker."""

    count: int  # number of its points
    apart: int  # number of the points of which traces show something else
    aside: Array  # (n, 3): by how much all points of the shape are aside, m; 0 beyond
    sigma: float  # standard deviation of the base where the whisker goes on smoothly, m
    lean: float  # the same of the tangent there, rad

    @property
    def share(self) -> float:
        """Share of the shape."""
        return self.count / len(self.aside)


def hook_of(shape: RestShape, pixel: float) -> Hook | None:
    """Find the hook of a shape; None if it has none. The size of a pixel is in m."""
    points, last = shape.points, round(_TIP * len(shape.points))
    first = [round(end * len(points)) for end in _ENDS]
    beyond = points[first[-1] : last]
    sizes = [_Smooth.of(beyond, degree).rms for degree in _DEGREES]
    least = max(_ALIKE * sizes[-1], _SMALL * pixel)
    degree = next(d for d, size in zip(_DEGREES, sizes, strict=True) if size <= least)
    enough = max(_ALIKE * sizes[_DEGREES.index(degree)], _SMALL * pixel)
    if _Smooth.of(points[:last], _WHOLE).rms <= max(_AS_WELL * sizes[-1], _SMALL * pixel):
        return None
    fits = ((n, _Smooth.of(points[n:last], degree)) for n in first)
    count, smooth = next((n, fit) for n, fit in fits if fit.rms <= enough or n == first[-1])
    if count == first[-1]:  # it goes on: the whisker is strongly curved there
        return None
    aside = np.zeros_like(points)
    aside[:count] = points[:count] - smooth.before(count)
    other = _Smooth.of(points[count:last], degree + 1)
    differs = _OTHER * np.linalg.norm(other.begin(count) - smooth.begin(count), axis=1)
    usual = _LEAST * pixel * np.array([1.0, 1.0 / max(count, 1)])
    sigma, lean = np.sqrt((_WAVES * smooth.errors(count)) ** 2 + differs**2 + usual**2)
    size = np.linalg.norm(aside, axis=1)
    if size.max() < max(_LARGE * pixel, _SURE * sigma):
        return None
    apart = int(np.flatnonzero(size > _LEAST * pixel)[-1]) + 1
    return Hook(count, apart, aside, float(sigma), float(lean / shape.spacing))


class _Smooth(NamedTuple):
    """Polynomial in the number of a point that is fitted to points."""

    coefficients: Array  # (degree + 1, 3), of Chebyshev polynomials
    inverse: Array  # of the normal matrix
    left: Array  # residuals (n, 3)

    @classmethod
    def of(cls, points: Array, degree: int) -> _Smooth:
        """Fit a polynomial of a degree."""
        basis = np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, len(points)), degree)
        coefficients = np.asarray(np.linalg.lstsq(basis, points)[0], dtype=np.float64)
        inverse = np.asarray(np.linalg.inv(basis.T @ basis))
        return cls(coefficients, inverse, np.asarray(points - basis @ coefficients))

    @property
    def rms(self) -> float:
        """Root mean square residual."""
        free = len(self.left) - len(self.inverse)
        return float(np.sqrt((self.left**2).sum() / max(free, 1)))

    def _at(self, count: int) -> Array:
        """Positions of points before the first one, in units of half the length."""
        return np.asarray(-1.0 + 2.0 / (len(self.left) - 1) * np.arange(-count, 0))

    def before(self, count: int) -> Array:
        """Points (count, 3) before the first one."""
        values = np.polynomial.chebyshev.chebval(self._at(count), self.coefficients)
        return np.asarray(values.T)

    def _foremost(self, count: int) -> Array:
        """Polynomials (2, degree + 1), and their slopes, so many points before the first one."""
        units, step = np.eye(len(self.inverse)), 2.0 / (len(self.left) - 1)
        at = -1.0 - count * step
        rows = units, np.polynomial.chebyshev.chebder(units) * step
        return np.array([np.polynomial.chebyshev.chebval(at, row) for row in rows])

    def begin(self, count: int) -> Array:
        """Position and slope (2, 3) there."""
        return np.asarray(self._foremost(count) @ self.coefficients)

    def errors(self, count: int) -> Array:
        """Standard deviations (2,) of both, in any direction."""
        # Residuals of neighbouring points are alike.
        size = self.rms * np.sqrt(correlated([self.left.T]))
        rows = self._foremost(count)
        return np.asarray(size * np.sqrt(np.einsum("ki,ij,kj->k", rows, self.inverse, rows)))


def straightened(
    curves: Array, shape: RestShape, whisker: Whisker, pose: BasePose, hook: Hook
) -> Array:
    """Curves (time, n, 3) without the hook of their shape at rest, which moves with their base."""
    turn = pose.rotation @ whisker.pose.rotation.T
    begin = np.einsum("tij,j->ti", turn, whisker.pose.origin)
    hooked = np.einsum("tij,nj->tni", turn, shape.points) + (pose.position - begin)[:, None]
    found = curves.copy()
    for i in np.flatnonzero(np.isfinite(hooked).all(axis=(1, 2))):
        # Traces may begin later than the shape.
        part = curves[i, : 2 * hook.count]
        away = np.linalg.norm(part[:, None] - hooked[i, None, : 2 * hook.count], axis=2)
        found[i, : len(part)] -= hook.aside[np.argmin(away, axis=1)] @ turn[i].T
    return found


def off_hook(
    cameras: Sequence[Camera], traces: TraceSeries, curves: Array, hook: Hook | None
) -> tuple[TraceSeries, TraceSeries]:
    """Traces that do not show the whisker where a hook is, and those for its fit."""
    if hook is None:
        return traces, traces
    hooked = np.zeros(traces.seen.shape, dtype=bool)
    known = np.isfinite(curves).all(axis=(1, 2))
    ends, numbers = curves[known][:, hook.apart], np.arange(traces.line.shape[2])
    for view, camera in enumerate(cameras):
        away = np.linalg.norm(traces.line[known, view] - camera.project(ends)[:, None], axis=2)
        hooked[known, view] = numbers <= np.argmin(away, axis=1)[:, None]
    shown = replace(traces, seen=np.where(hooked, 0.0, traces.seen))
    return shown, replace(shown, sigma=np.where(hooked, np.inf, traces.sigma))
