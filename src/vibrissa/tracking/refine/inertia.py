"""What a whisker's own mass bends, and how much of it that is in each frame.

A whisker that is swung or rings is bent by its inertia, in air too, by as much as light contacts
bend it. Each part of it accelerates as its shapes in space over time show, which takes a force; the
moments of these forces about a place of the whisker bend it there, and damping takes the place of a
moment that is proportional to the rate at which it bends. So the displacement of the whisker from
the shape that contacts alone would give it is known up to two numbers: its mass over its stiffness,
relative to what is assumed, and the time constant of its damping. They are fitted to all frames so
that most shapes agree, which are then those in air.

The displacements are of first order in the bending by inertia, on the shape as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.numerics import Array, Mask
from vibrissa.tracking.refine.rods import TraceSeries
from vibrissa.tracking.space.pose import CUTOFF, base_pose
from vibrissa.tracking.space.rest_shape import RestShape, motions
from vibrissa.whisker import Whisker

_DENSITY = 1400.0  # of keratin, kg/m³: the scale of masses is fitted
_SPAN = 1e-3  # time to each side over which motion is fitted by a parabola, s
_FEWEST = 12  # smallest number of frames
# Share of the whisker that is compared, as fur and unseen tips are not, and number of its points.
_FROM, _TO, _POINTS = 0.06, 0.85, 24
_FAST = 2.0  # smallest number of frames in the period of the cut-off for poses that are filtered
_ROUNDS, _SETTLED = 5, 0.03  # number of rounds, and relative change of the scale after the last one
_REWEIGHTED = 20  # number of times that frames are weighted by what is left of them
# Misses from which a frame hardly counts, as it is bent by contact, and errors of curves, pixels.
_OUTLYING, _NOISE = 3.0, 0.05
# Scales of mass over stiffness, where the radius is stated and else, and longest time constant of
# the damping; that with which both begin, s.
_STATED, _SCALES = (0.65, 1.6), (0.1, 20.0)
_LONGEST, _DELAY = 5e-3, 1e-3
# Deviation of most frames, over what inertia would do, below which it does nothing; what must
# remain at most of the largest deviations of free frames, which this share of them has, and how
# large these must be, pixels.
_LITTLE, _FAR_LESS, _USUAL, _SMALL = 0.1, 0.6, 0.9, 0.05
# Standard deviation of displacements by inertia, over their size, and number of those up to which
# a frame may be free.
_UNSURE, _POSSIBLE = 0.15, 3.0
_NONE = 1e-12  # displacement that is none, m


@dataclass(frozen=True, eq=False)
class Inertia:
    """Displacement of a whisker by its own mass in every frame."""

    displacement: Array  # (time, node, 3) of the points of its curves, laboratory, m
    scale: float  # of its mass over its stiffness, over what is assumed
    delay: float  # time constant of its damping, s
    size: Array  # (time,), root mean square of what is not a rigid motion, m

    @property
    def unsure(self) -> Array:
        """Largest error (time,) of shapes, root mean square, m."""
        return _POSSIBLE * _UNSURE * self.size

    def remark(self, name: str) -> str:
        """State by how much inertia bends a whisker, and what its loads are."""
        usual, most = 1e6 * np.quantile(self.size, [0.5, 1.0])
        return (
            f"{name}: its inertia bends it by {usual:.0f} µm (median, root mean square; at most "
            f"{most:.0f} µm), as its motion shows, which is not taken for contact. Forces and "
            "moments are those of contact alone. Its mass over its stiffness is "
            f"{self.scale:.2f} times that of a rod of {_DENSITY:.0f} kg/m³ with the radius and "
            f"Young's modulus that it is taken to have, and its damping "
            f"{1e3 * self.delay:.1f} ms."
        )

    def at(self, share: Array) -> tuple[Array, Array]:
        """Displacements (time, 3) at shares (time,) of the length, and their slopes with it, m."""
        count = self.displacement.shape[1]
        where = np.nan_to_num(np.clip(share, 0.0, 1.0)) * (count - 1)
        first = np.minimum(where.astype(np.intp), count - 2)
        rows, part = np.arange(len(where)), (where - first)[:, None]
        before, after = (self.displacement[rows, first + k] for k in (0, 1))
        slopes = (after - before) * (count - 1)
        return np.asarray(before + part * (after - before)), slopes

    def without(self, cameras: Sequence[Camera], traces: TraceSeries, curves: Array) -> TraceSeries:
        """Traces of the whisker as it would be without mass, as uncertain as that is."""
        line, sigma = traces.line.copy(), traces.sigma.copy()
        # What moves a curve as a whole is not an error of its shape.
        moving = np.sqrt((self.displacement**2).sum(axis=2).mean(axis=1))
        share = _UNSURE * np.minimum(self.size / np.maximum(moving, _NONE), 1.0)
        for view, camera in enumerate(cameras):
            shown = camera.project(curves)
            shift = shown - camera.project(curves - self.displacement)
            known = np.isfinite(shift).all(axis=(1, 2)) & np.isfinite(line[:, view, 0, 0])
            for i in np.flatnonzero(known):
                away = ((line[i, view][:, None] - shown[i]) ** 2).sum(axis=2)
                moved = shift[i, away.argmin(axis=1)]
                line[i, view] -= moved
                sigma[i, view] = np.hypot(sigma[i, view], share[i] * np.linalg.norm(moved, axis=1))
        return replace(traces, line=line, sigma=sigma)

    def spread(self, displacement: Array) -> Array:
        """Covariances (time, 3, 3) of displacements (time, 3)."""
        unsure = _UNSURE * displacement
        return np.asarray(unsure[:, :, None] * unsure[:, None])

    def rows(self, frames: NDArray[np.intp]) -> Inertia:
        """Select frames."""
        return replace(self, displacement=self.displacement[frames], size=self.size[frames])


def inertia_of(
    curves: Array,
    before: RestShape,
    whisker: Whisker,
    rest: Callable[[Array, Array], RestShape],
    rate: float,
    pixel: float,
    stated: bool,
) -> Inertia | None:
    """Find by how much its inertia bends a whisker; None where it does not explain its shapes.

    ``before`` is the shape at rest of the curves (time, node, 3) as they are, and ``rest`` gives
    that of others with errors (time,), m. If the radius is ``stated``, the mass over the stiffness
    is nearly known.
    """
    seen: Mask = np.all(np.isfinite(curves), axis=(1, 2))
    if seen.sum() < _FEWEST or not _windows(seen, rate).any():
        return None
    swung = _Swung.of(curves, seen, whisker, rate, _NOISE * pixel)
    try:
        return _explaining(swung, before, rest, pixel, _STATED if stated else _SCALES)
    except ValueError:  # without it shapes have less in common than with it
        return None


def _explaining(
    swung: _Swung,
    before: RestShape,
    rest: Callable[[Array, Array], RestShape],
    pixel: float,
    limits: tuple[float, float],
) -> Inertia | None:
    """Inertia with a scale within limits, if it explains how shapes deviate from that at rest."""
    numbers = (1.0, _DELAY)
    found = swung.inertia(numbers, before, np.zeros_like(swung.curves))
    if np.nanmedian(before.deviation) < _LITTLE * np.median(found.size):
        return None
    curves = np.where(swung.seen[:, None, None], swung.curves, np.nan)
    for _ in range(_ROUNDS):
        shape = rest(curves - found.displacement, found.unsure)
        last, numbers = numbers, swung.fitted(shape, found.displacement, numbers, limits)
        if not numbers[0] > limits[0]:
            return None
        found = swung.inertia(numbers, shape, found.displacement)
        if abs(numbers[0] - last[0]) < _SETTLED * last[0]:
            break
    shape = rest(curves - found.displacement, found.unsure)
    free = shape.free & np.isfinite(before.deviation)
    kept = free & before.free
    if not kept.any():
        return None
    usual, left = (np.quantile(each.deviation[free], _USUAL) for each in (before, shape))
    # Where contacts are taken for inertia, frames in air deviate by what is subtracted from them.
    kept_before, kept_after = (
        np.quantile(each.deviation[kept], _USUAL) for each in (before, shape)
    )
    explains = usual > _SMALL * pixel and left < _FAR_LESS * usual and kept_after < kept_before
    return found if explains else None


@dataclass(frozen=True, eq=False)
class _Swung:
    """Shapes over time, and how inertia bends them."""

    curves: Array  # (time, node, 3), m
    seen: Mask  # (time,)
    whisker: Whisker
    by_mass: Array  # (time, node, 3): displacement for a scale of 1, m
    spacing: Array  # (time,) of the points, m
    rate: float
    noise: float  # error of the curves, m

    @classmethod
    def of(cls, curves: Array, seen: Mask, whisker: Whisker, rate: float, noise: float) -> _Swung:
        """Compute what the accelerations of all points do to a whisker."""
        times = np.arange(len(curves))
        flat = curves.reshape(len(curves), -1)
        whole = np.array([np.interp(times, times[seen], one[seen]) for one in flat.T]).T
        whole = whole.reshape(curves.shape)
        acceleration = _derivative(whole, rate, 2)
        # Lines across lost frames have kinks, which are not accelerations of the whisker.
        known = times[np.pad(_windows(seen, rate), _side(rate), mode="edge")]
        flat = acceleration[known].reshape(len(known), -1)
        acceleration = np.array([np.interp(times, known, one) for one in flat.T]).T
        acceleration = acceleration.reshape(curves.shape)
        by_mass = _bent(whole, acceleration, whisker)
        spacing = np.linalg.norm(np.diff(whole, axis=1), axis=2).mean(axis=1)
        return cls(whole, seen, whisker, by_mass, spacing, rate, noise)

    def _on(self, shape: RestShape, displacement: Array) -> tuple[Array, Array]:
        """Rotations (time, 3, 3) to the frame of a shape, and deviations (time, node, 3) there.

        Curves without the displacement are placed on the shape, the deviations are those with it.
        """
        arcs = self._arcs(shape)
        target = self._target(shape)
        bare = _along(self.curves - displacement, self.spacing, arcs)
        rotation, shift = motions(np.nan_to_num(bare), target)
        placed = np.einsum("tij,tnj->tni", rotation, self.curves) + shift[:, None]
        at = np.arange(self.curves.shape[1]) * self.spacing[:, None]
        known = np.arange(len(shape.points)) * shape.spacing
        rests = np.stack([np.interp(at, known, one) for one in shape.points.T], axis=2)
        return rotation, placed - rests

    def _arcs(self, shape: RestShape) -> Array:
        """Arc lengths at which shapes are compared, m."""
        return np.linspace(_FROM, _TO, _POINTS) * shape.length

    def _target(self, shape: RestShape) -> Array:
        spacing = np.array([shape.spacing])
        return np.asarray(_along(shape.points[None], spacing, self._arcs(shape))[0])

    def _by_damping(self, shape: RestShape, displacement: Array) -> Array:
        """Displacements (time, node, 3) by damping for a time constant of one second, m.

        They are those of a whisker that moves relative to its base, as it is posed without inertia.
        """
        pose = base_pose(self.curves - displacement, shape, self.whisker)
        pose = pose.filtered(self.rate, CUTOFF if self.rate > _FAST * CUTOFF else None)
        away = self.curves - pose.position[:, None]
        slopes = -_derivative(np.einsum("tji,tnj->tni", pose.rotation, away), self.rate, 1)
        return np.asarray(np.nan_to_num(np.einsum("tij,tnj->tni", pose.rotation, slopes)))

    def fitted(
        self,
        shape: RestShape,
        displacement: Array,
        begun: tuple[float, float],
        limits: tuple[float, float],
    ) -> tuple[float, float]:
        """Scale of mass and time constant of damping with which most shapes are those at rest."""
        arcs = self._arcs(shape)
        rotation, deviation = self._on(shape, displacement)
        damped = self._by_damping(shape, displacement)
        columns = [self._turned(each, rotation, arcs) for each in (self.by_mass, damped)]
        rigid = _rigid(self._target(shape))
        left = [_without(each, rigid) for each in (_along(deviation, self.spacing, arcs), *columns)]
        known = self.seen & np.isfinite(left).all(axis=(0, 2))
        away, by_mass, by_damping = (each[known] for each in left)
        both = np.stack([by_mass, by_damping], axis=2)
        floor = self.noise**2 * away.shape[1]
        scale, delay = begun
        for _ in range(_REWEIGHTED):
            moved = both @ [scale, delay]
            variance = floor + _UNSURE**2 * (moved**2).sum(axis=1)
            misses = ((away - moved) ** 2).sum(axis=1) / variance
            weights = 1.0 / (variance * (1.0 + misses / _OUTLYING**2) ** 2)
            normal = np.einsum("tik,til,t->kl", both, both, weights)
            pull = np.einsum("tik,ti,t->k", both, away, weights)
            delay = float(np.clip(np.linalg.lstsq(normal, pull)[0][1], 0.0, _LONGEST))
            scale = float(np.clip((pull[0] - normal[0, 1] * delay) / normal[0, 0], *limits))
        return scale, delay

    def _turned(self, values: Array, rotation: Array, arcs: Array) -> Array:
        along = _along(values, self.spacing, arcs)
        return np.asarray(np.einsum("tij,tnj->tni", rotation, along))

    def inertia(self, numbers: tuple[float, float], shape: RestShape, before: Array) -> Inertia:
        """Displacements by inertia, on a shape at rest to which curves without those before fit."""
        scale, delay = numbers
        rotation, _ = self._on(shape, before)
        moved = scale * self.by_mass + delay * self._by_damping(shape, before)
        bent = _without(
            self._turned(moved, rotation, self._arcs(shape)), _rigid(self._target(shape))
        )
        size = np.linalg.norm(bent, axis=1) / np.sqrt(_POINTS)
        return Inertia(moved, scale, delay, np.nan_to_num(size))


def _side(rate: float) -> int:
    """Number of frames to each side over which motion is fitted."""
    return max(1, round(rate * _SPAN))


def _windows(seen: Mask, rate: float) -> Mask:
    """Whether all frames of each window over which motion is fitted are seen."""
    width = 2 * _side(rate) + 1
    if len(seen) < width:
        return np.zeros(0, dtype=bool)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(seen, width).all(axis=1))


def _derivative(values: Array, rate: float, order: int) -> Array:
    """First or second derivatives over time, by parabolas over neighbouring frames."""
    side = _side(rate)
    offsets = np.arange(-side, side + 1)
    fit = np.linalg.pinv(np.vander(offsets, 3, increasing=True))[order] * order
    count = len(values) - 2 * side
    inner = sum(w * values[k : k + count] for k, w in enumerate(fit)) * rate**order
    return np.concatenate([inner[:1]] * side + [inner] + [inner[-1:]] * side)


def _bent(curves: Array, acceleration: Array, whisker: Whisker) -> Array:
    """Displacements (time, node, 3) by the inertia of accelerated points, of a clamped base."""
    count = curves.shape[1]
    radius = whisker.radius(np.linspace(0.0, whisker.length, count))
    steps = np.linalg.norm(np.diff(curves, axis=1), axis=2)
    weights = 0.5 * (np.pad(steps, ((0, 0), (0, 1))) + np.pad(steps, ((0, 0), (1, 0))))
    area = np.pi * radius**2
    force = -_DENSITY * (area * weights)[..., None] * acceleration
    beyond = np.cumsum(force[:, ::-1], axis=1)[:, ::-1]
    moment = np.cumsum(np.cross(curves, force)[:, ::-1], axis=1)[:, ::-1]
    moment -= np.cross(curves, beyond)
    tangent = np.gradient(curves, axis=1)
    tangent /= np.linalg.norm(tangent, axis=2, keepdims=True)
    twist = (moment * tangent).sum(axis=2, keepdims=True) * tangent
    stiffness = (whisker.youngs_modulus * area * radius**2 / 4.0)[:, None]
    turning = (moment + whisker.poisson_ratio * twist) / stiffness
    return _summed(np.cross(_summed(turning, steps), tangent), steps)


def _summed(values: Array, steps: Array) -> Array:
    """Integrals (time, node, 3) along the whisker."""
    means = 0.5 * (values[:, 1:] + values[:, :-1]) * steps[..., None]
    return np.pad(np.cumsum(means, axis=1), ((0, 0), (1, 0), (0, 0)))


def _along(values: Array, spacing: Array, arcs: Array) -> Array:
    """Values (time, arc, 3) at arc lengths, of nodes with a spacing (time,); NaN beyond them."""
    where = arcs / spacing[:, None]
    first = np.minimum(where.astype(np.intp), values.shape[1] - 2)
    part = (where - first)[..., None]
    part[where > values.shape[1] - 1] = np.nan
    rows = np.arange(len(values))[:, None]
    return np.asarray((1.0 - part) * values[rows, first] + part * values[rows, first + 1])


def _rigid(points: Array) -> Array:
    """Orthonormal basis (3 n, 6) of small rigid motions of points (n, 3)."""
    shifts = np.broadcast_to(np.eye(3)[:, None], (3, *points.shape))
    turns = np.cross(shifts, points - points.mean(axis=0))
    return np.asarray(np.linalg.qr(np.concatenate([shifts, turns]).reshape(6, -1).T)[0])


def _without(values: Array, rigid: Array) -> Array:
    """Values (time, 3 n) without their rigid motions."""
    flat = values.reshape(len(values), -1)
    return np.asarray(flat - flat @ rigid @ rigid.T)
