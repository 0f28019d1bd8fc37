"""Optics of cameras that are known only roughly, from the disagreement of two views.

A free whisker is a rigid body. Its shape S, its pose in every frame and the optics q are fitted
together so that its images are on the traces of all views, by least squares,

    | across the trace: trace − π_q(R_t S + p_t) |² / σ²  +  | (q − q₀) / s |²,

where q contains, for each view, the strength of its perspective (the inverse of its distance, 0 for
an orthographic one) and, for each but the first, its rotation, its relative scale and its shift
along its columns. Poses are eliminated frame by frame (Schur complement), so that the system solved
has the size of shape and optics together. Parameters that the whisker's motion does not determine
remain as stated, with the uncertainty s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.deferred import transform
from vibrissa.numerics import Array
from vibrissa.tracking.refine.fit import RodFit
from vibrissa.tracking.refine.rods import TraceSeries
from vibrissa.tracking.space.curve import merged
from vibrissa.tracking.space.rest_shape import RestShape, aligned_lengths, motions, rest_shape
from vibrissa.tracking.trace.steady import slow_motion
from vibrissa.tracking.trace.trace import Trace, arc_lengths, interpolated

# Standard deviation of the inverse of a distance that is not stated, 1/m: lenses at 0.5 m.
_STRENGTH = 2.0
_DISTANCE = 0.1  # standard deviation of the inverse of a stated distance, as a share of it
# Inverse of the largest distance that is not infinite, and of the smallest one, 1/m.
_FLAT, _STRONGEST = 1e-6, 20.0
_BEHIND = np.diag([-1.0, 1.0, -1.0])  # axes of a camera on the opposite side
# Standard deviations of a turn of a view, rad, of its scale, and of its shift, pixels.
_TURN, _SCALE, _SHIFT = np.radians(3.0), 0.03, 10.0
_LEAVES = np.radians(10.0)  # the same of how far a whisker leaves the plane of a single view
# Number of points of the shape, and the share of the usual length that they cover.
_NODES, _LENGTH = 33, 0.9
_FRAMES, _FEWEST = 60, 8  # largest and smallest number of free frames that are used
_SAMPLE = 150  # largest number of frames from which the free ones are selected
# Deviation from the rest shape up to which a frame may be free, as a share of the whisker's length:
# wrong optics make free frames differ too, and what is bent is left out later.
_ALIKE = 0.04
# Visible misfit of cameras, pixels; largest share of it that other optics may leave, if that is
# visible, too; and standard deviations by which these must differ from the stated ones.
_VISIBLE, _BETTER, _CERTAIN = 0.05, 0.6, 2.0
_EXPLAINED = (
    0.1  # distance of a rigid whisker from the traces below which nothing needs explaining, pixels
)
_ROUNDS, _DAMPING = 12, 1e-3  # number of Gauss–Newton steps, and Levenberg's damping
# Standard deviations of third differences of the shape, and of motions of its points along it, as a
# share of their spacing.
_LOOSE, _SLIDING = 0.02, 0.05
_STEP = 1e-3  # step of differences by the optics, in their standard deviations
# Standard deviation to which traces are set at first, pixels: as their errors are common to many
# points and frames, vary with the pose, and frames that are hardly bent may be among the free ones,
# it is far above that of one point.
_UNIT = 0.5
# The same in units of what is left of them, and its smallest value, pixels.
_COMMON, _SHARPEST = 10.0, 0.1
# Weight of where traces begin: fur hides more of the base in one view than in the other, by several
# pixels in all frames.
_BEGINNINGS = 0.2
_AROUND = 5e-3  # distance over which displacements by the cameras' errors are nearly linear, m
_DECIDED = 3.0  # difference of log-likelihoods from which a mirrored view is on one side
_SELECTIONS = 3  # number of rounds in which frames that are bent are left out
_ODD = 3.0  # misfit of frames that are left out, in units of the usual one: they are bent
_FAR = 6.0  # misses from which `TraceSeries.equations` weighs down, standard deviations


@dataclass(frozen=True, eq=False)
class Optics:
    """Errors of the cameras inferred from the motion of a free whisker.

    Values are the inverse distance of each view, 1/m, and then for each view but the first its
    rotation about the camera's axes, rad, its relative scale and its shift, pixels.
    """

    cameras: tuple[Camera, ...]  # that explain the views
    orthographic: tuple[Camera, ...]  # as they were stated, without perspective
    values: Array
    covariance: Array  # (value, value)
    stated: Array  # values of the cameras as they were stated
    prior: Array  # standard deviations of these
    before: float  # distance of the rigid whisker from the traces with stated cameras, pixels
    after: float  # and with these
    distance: float | None = None  # of the lenses, as it was stated, m

    @property
    def sigma(self) -> Array:
        """Standard deviations of the values."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def needed(self) -> bool:
        """Whether these optics explain the views, and differ from the stated ones for certain."""
        apart = np.abs(self.values - self.stated) / self.sigma
        explains = self.after < max(_VISIBLE, _BETTER * self.before)
        return bool(explains and apart.max() > _CERTAIN)

    def as_stated(self) -> Optics:
        """The stated cameras, with their uncertainty and their difference from these optics."""
        apart = self.values - self.stated
        # All together they are not known worse than before.
        most = np.sqrt(len(apart))
        apart /= max(1.0, float(np.linalg.norm(apart / self.prior)) / most)
        return replace(
            self,
            values=self.stated,
            covariance=self.covariance + np.outer(apart, apart),
            cameras=with_optics(self.orthographic, self.stated),
        )

    def displacements(self, points: Array) -> Array:
        """Shifts of points (error, ..., 3) by independent errors of the optics, one sigma each."""
        shifts = []
        for error in np.linalg.cholesky(self.covariance).T:
            other = with_optics(self.orthographic, self.values + error)
            seen = np.stack([camera.project(points) for camera in other])
            shifts.append(triangulate(self.cameras, seen)[0] - points)
        return np.stack(shifts)

    def __str__(self) -> str:
        """Distances, turns, scales and shifts with their standard deviations."""
        count = len(self.cameras)
        parts = []
        for camera, strength, error in zip(self.cameras, self.values, self.sigma, strict=False):
            least = 1.0 / max(abs(strength) + 2.0 * error, 1e-9)
            if abs(strength) > 2.0 * error:
                side = " on its other side" if strength < 0.0 else ""
                parts.append(
                    f"{camera.name} at {1.0 / abs(strength):.2f} m{side} (at least {least:.2f})"
                )
            else:
                parts.append(f"{camera.name} farther than {least:.2f} m")
        rest = zip(
            *(np.reshape(a[count:], (-1, 5)) for a in (self.values, self.sigma)), strict=True
        )
        for camera, (value, error) in zip(self.cameras[1:], rest, strict=True):
            turn, about = np.degrees((np.linalg.norm(value[:3]), error[:3].max()))
            parts.append(
                f"{camera.name} turned by {turn:.1f} ± {about:.1f}°, scaled by "
                f"{100.0 * value[3]:+.1f} ± {100.0 * error[3]:.1f} % and shifted by "
                f"{value[4]:+.1f} ± {error[4]:.1f} pixels"
            )
        return ", ".join(parts)


def rough_optics(
    cameras: Sequence[Camera], traces: Sequence[Sequence[Trace]], distance: float | None = None
) -> Optics | None:
    """Find the optics of orthographic cameras from simultaneous traces; None if few are free."""
    count = len(traces[0])
    rows = np.linspace(0, count - 1, min(_SAMPLE, count)).astype(int)
    some = [[view[i] for i in rows] for view in traces]
    stated = stated_lenses(cameras, distance)
    curves = np.array([curve.points for curve in merged(stated, zip(*some, strict=True))])
    try:
        # All of a whisker that is bent by wrong optics is needed to show these.
        shape = rest_shape(curves, fur=0.0)
    except ValueError:
        return None
    return estimated_optics(cameras, TraceSeries.of(some), curves, shape, distance)


def unchecked_optics(cameras: Sequence[Camera], distance: float | None = None) -> Optics:
    """Optics as they are stated, with their uncertainty, if no free frame can check them."""
    stated, size = _prior(cameras, distance)
    lenses = with_optics(cameras, stated)
    known = np.diag(size**2), stated, size, np.nan, np.nan, distance
    return Optics(lenses, tuple(cameras), stated, *known)


def _prior(cameras: Sequence[Camera], distance: float | None) -> tuple[Array, Array]:
    """Values of the optics as they are stated, and their standard deviations."""
    more = len(cameras) - 1
    lenses = [_strength(camera, distance) for camera in cameras]
    spreads = [spread for _, spread in lenses] + [_TURN, _TURN, _TURN, _SCALE, _SHIFT] * more
    return np.concatenate([[mean for mean, _ in lenses], np.zeros(5 * more)]), np.array(spreads)


def stated_lenses(cameras: Sequence[Camera], distance: float | None) -> tuple[Camera, ...]:
    """Give orthographic cameras lenses at a distance from the origin; None: none."""
    strength = 0.0 if distance is None else 1.0 / distance
    return tuple(lens(camera, strength, np.zeros(3), 0.0, 0.0) for camera in cameras)


def lens(camera: Camera, strength: float, turn: Array, scale: float, shift: float) -> Camera:
    """Give an orthographic view a lens at 1/strength from the origin; rotate, scale, shift it.

    An orthographic image does not show from which of two sides it is seen. A lens of negative
    strength is on the opposite side of the camera.
    """
    focal = camera.matrix.copy()
    focal[:2, :2] *= 1.0 + scale
    focal[0, 2] += shift
    rotation = transform.Rotation.from_rotvec(turn).as_matrix() @ camera.rotation
    translation = camera.translation
    if strength < 0.0:
        # From behind, the same image is mirrored.
        rotation, translation = _BEHIND @ rotation, _BEHIND @ translation
        focal[:, 0] *= -1.0
    if abs(strength) < _FLAT:
        return replace(camera, matrix=focal, rotation=rotation, translation=translation)
    focal[:2, :2] /= abs(strength)
    return replace(
        camera,
        matrix=focal,
        rotation=rotation,
        translation=translation + np.array([0.0, 0.0, 1.0 / abs(strength)]),
        projection="perspective",
    )


def with_optics(cameras: Sequence[Camera], values: Array) -> tuple[Camera, ...]:
    """Give orthographic cameras the optics of `Optics.values`."""
    count = len(cameras)
    rest = np.concatenate([np.zeros(5), values[count:]]).reshape(count, 5)
    return tuple(
        lens(camera, float(np.clip(strength, -_STRONGEST, _STRONGEST)), one[:3], one[3], one[4])
        for camera, strength, one in zip(cameras, values[:count], rest, strict=True)
    )


def estimated_optics(
    cameras: Sequence[Camera],
    traces: TraceSeries,
    curves: Array,
    shape: RestShape,
    distance: float | None = None,
) -> Optics | None:
    """Find the optics that explain a free whisker in space; None if too few frames are free."""
    known = np.isfinite(curves).all(axis=(1, 2))
    alike = np.nan_to_num(shape.deviation, nan=np.inf) < _ALIKE * shape.length
    fits = []
    for likely in (shape.free, shape.free | alike):
        rows = np.flatnonzero(likely & known)
        if len(rows) < _FEWEST:
            continue
        rows = rows[np.linspace(0, len(rows) - 1, min(_FRAMES, len(rows))).astype(int)]
        fits.append(_fitted(_Problem.of(cameras, traces.rows(rows), curves[rows], distance)))
        # Wrong optics may make free frames differ: then frames similar to them are tried too.
        if fits[-1].mean_miss < _EXPLAINED:
            break
    if not fits:
        return None
    fitted = min(fits, key=lambda fit: fit.mean_miss).sharper().solved()
    fitted = fitted if distance is None else fitted.on_one_side(distance)
    before = replace(fitted, q=np.zeros_like(fitted.q)).solved(optics=False)
    stated, size = fitted.prior
    return Optics(
        fitted.cameras_at(fitted.q),
        fitted.stated,
        stated + fitted.q * size,
        fitted.covariance * np.outer(size, size),
        stated,
        size,
        before.mean_miss,
        fitted.mean_miss,
        distance,
    )


def _fitted(problem: _Problem) -> _Problem:
    """Solution of a problem without the bent frames."""
    fitted = problem.solved()
    for _ in range(_SELECTIONS):
        each = fitted.misses()
        fine = each < _ODD * float(np.median(each))
        if _FEWEST <= fine.sum() < len(fine):
            fitted = fitted.rows(fine).solved()
    return fitted


def _mirrored(camera: Camera) -> bool:
    """Whether an image is mirrored, or seen from the opposite side."""
    return bool(np.linalg.det(camera.matrix[:2, :2]) < 0.0)


def _strength(camera: Camera, distance: float | None) -> tuple[float, float]:
    """Mean and standard deviation of the inverse of a lens's stated distance."""
    if distance is None:
        return 0.0, _STRENGTH
    if _mirrored(camera):
        return 0.0, 1.0 / distance
    return 1.0 / distance, _DISTANCE / distance


@dataclass(frozen=True, eq=False)
class _Problem:
    """A rigid shape, its poses and the optics, in units of their standard deviations."""

    stated: tuple[Camera, ...]
    traces: TraceSeries
    points: Array
    rotation: Array
    position: Array
    q: Array
    prior: tuple[Array, Array]
    unit: float = _UNIT

    @classmethod
    def of(
        cls, cameras: Sequence[Camera], traces: TraceSeries, curves: Array, distance: float | None
    ) -> _Problem:
        _, shapes = aligned_lengths(curves)
        known = np.isfinite(shapes[:, :, 0]).sum(axis=1)
        first = int(np.argmax(known))
        line = shapes[first, : known[first]]
        s = arc_lengths(line)
        points = interpolated(np.linspace(0.0, _LENGTH * s[-1], _NODES), s, line)
        back = [motions(line[None, :n], part[:n]) for n, part in zip(known, shapes, strict=True)]
        start, size = _prior(cameras, distance)
        even = replace(traces, sigma=np.where(np.isfinite(traces.sigma), _UNIT, np.nan))
        return cls(
            tuple(cameras),
            even,
            points,
            np.concatenate([b[0] for b in back]),
            np.concatenate([b[1] for b in back]),
            np.zeros(len(start)),
            (start, size),
        )

    @property
    def covariance(self) -> Array:
        """Covariance of the optics q."""
        return np.asarray(np.linalg.inv(self.normal()[0])[-len(self.q) :, -len(self.q) :])

    def sharper(self) -> _Problem:
        """The problem with traces weighted by their residuals."""
        unit = max(_COMMON * self.mean_miss, _SHARPEST)
        sigma = np.where(np.isfinite(self.traces.sigma), unit, np.nan)
        return replace(self, traces=replace(self.traces, sigma=sigma), unit=unit)

    def on_one_side(self, distance: float) -> _Problem:
        """Solution with mirrored views seen from the side that explains them, if one does."""
        mean, size = (values.copy() for values in self.prior)
        values, variance = mean + self.q * size, np.diag(self.covariance) * size**2
        for view, camera in enumerate(self.stated):
            # Difference of the log-likelihoods of both sides.
            apart = 2.0 * values[view] / (distance * variance[view])
            if _mirrored(camera) and abs(apart) > _DECIDED:
                mean[view] = np.sign(apart) / distance
                size[view] = _DISTANCE / distance
        if (size == self.prior[1]).all():
            return self
        return replace(self, prior=(mean, size), q=(values - mean) / size).solved()

    def rows(self, used: NDArray[np.bool_]) -> _Problem:
        """The problem restricted to some frames."""
        return replace(
            self,
            traces=self.traces.rows(np.flatnonzero(used)),
            rotation=self.rotation[used],
            position=self.position[used],
        )

    def cameras_at(self, q: Array) -> tuple[Camera, ...]:
        """Cameras with the optics q."""
        return with_optics(self.stated, self.prior[0] + q * self.prior[1])

    def placed(self) -> Array:
        """Points (time, node, 3) in the laboratory."""
        turned = np.einsum("tij,nj->tni", self.rotation, self.points)
        return np.asarray(turned + self.position[:, None])

    def misses(self) -> Array:
        """Root mean square distance of each frame's traces, pixels."""
        placed, total, count = self.placed(), 0.0, 0.0
        for view, camera in enumerate(self.cameras_at(self.q)):
            pixels, slopes = camera.project_with_slopes(placed)
            miss = np.abs(self.traces.equations(view, pixels, slopes)[1][:, :-2])
            whole = np.where(miss > _FAR, miss**2 / _FAR, miss)
            total, count = total + (whole**2).sum(1), count + (miss > 0.0).sum(1)
        return np.asarray(self.unit * np.sqrt(total / np.maximum(count, 1.0)))

    @property
    def mean_miss(self) -> float:
        """Root mean square distance of all traces, pixels."""
        return float(np.sqrt(np.mean(self.misses() ** 2)))

    def normal(self) -> tuple[Array, Array, Array, Array, Array, float]:
        """Normal equations of shape and optics without the poses, and data to recover these."""
        t, n, k = len(self.position), len(self.points), len(self.q)
        placed = self.placed()
        turned = placed - self.position[:, None]
        x, y, z = np.moveaxis(turned, -1, 0)
        o = np.zeros_like(x)
        cross = np.stack([o, z, -y, -z, o, x, y, -x, o], -1).reshape(t, n, 3, 3)
        own = np.broadcast_to(self.rotation[:, None], (t, n, 3, 3))
        moved = np.concatenate([np.broadcast_to(np.eye(3), (t, n, 3, 3)), cross, own], axis=-1)
        inner, mixed = np.zeros((t, 6, 6)), np.zeros((t, 6, 3 * n + k))
        common, right = np.zeros((3 * n + k,) * 2), np.zeros(3 * n + k)
        pull, cost = np.zeros((t, 6)), 0.0
        steps = _STEP * np.eye(k)
        ahead = [self.cameras_at(self.q + step) for step in steps]
        back = [self.cameras_at(self.q - step) for step in steps]
        where = np.concatenate([np.arange(n), [0, n - 1]])
        for view, camera in enumerate(self.cameras_at(self.q)):
            pixels, by_point = camera.project_with_slopes(placed)
            by_optics = np.stack(
                [
                    (a[view].project(placed) - b[view].project(placed)) / (2.0 * _STEP)
                    for a, b in zip(ahead, back, strict=True)
                ],
                axis=-1,
            )
            slopes = np.concatenate([by_point @ moved, by_optics], axis=-1)
            rows, misses, _ = self.traces.equations(view, pixels, slopes)
            pose, shape, optics = rows[..., :6], rows[..., 6:9], rows[..., 9:]
            design = np.zeros((t, n + 2, 3 * n + k))
            for axis in range(3):
                design[:, np.arange(n + 2), 3 * where + axis] = shape[..., axis]
            design[..., 3 * n :] = optics
            # The tip of the traces is not that of the part of the shape that is compared.
            for part in (design, pose, misses):
                part[:, -2] *= _BEGINNINGS
                part[:, -1] = 0.0
            inner += np.einsum("tni,tnj->tij", pose, pose)
            mixed += np.einsum("tni,tnj->tij", pose, design)
            common += np.einsum("tni,tnj->ij", design, design)
            pull += np.einsum("tni,tn->ti", pose, misses)
            right += np.einsum("tni,tn->i", design, misses)
            cost += float((misses**2).sum())
        cost += self._priors(common, right)
        inner += 1e-9 * np.trace(inner, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        solved = np.linalg.solve(inner, np.concatenate([mixed, pull[..., None]], axis=-1))
        reduced = common - np.einsum("tij,tik->jk", mixed, solved[..., :-1])
        reduced += 1e-9 * np.diag(np.diag(common))
        right = right - np.einsum("tij,ti->j", mixed, solved[..., -1])
        return reduced, right, solved, inner, mixed, cost

    def _priors(self, common: Array, right: Array) -> float:
        """Add priors of a smooth shape, of the points' positions and of the stated optics."""
        n, k = len(self.points), len(self.q)
        spacing = float(np.linalg.norm(self.points[1] - self.points[0]))
        third = np.diff(np.eye(n), n=3, axis=0) / (_LOOSE * spacing)
        stiff = np.kron(third.T @ third, np.eye(3))
        common[: 3 * n, : 3 * n] += stiff
        right[: 3 * n] -= stiff @ self.points.reshape(-1)
        along = np.gradient(self.points, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True) * _SLIDING * spacing
        for i, row in enumerate(along):
            common[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += np.outer(row, row)
        common[-k:, -k:] += np.eye(k)
        right[-k:] -= self.q
        return float(self.q @ self.q + ((third @ self.points) ** 2).sum())

    def solved(self, optics: bool = True) -> _Problem:
        """Gauss–Newton with Levenberg's damping."""
        best, damping = self, _DAMPING
        reduced, right, solved, _, _, cost = best.normal()
        n, k = len(self.points), len(self.q)
        for _ in range(_ROUNDS):
            system = reduced + damping * np.diag(np.diag(reduced))
            if not optics:
                system[-k:, :-k] = system[:-k, -k:] = 0.0
                system[-k:, -k:] = np.eye(k)
                right = np.concatenate([right[:-k], np.zeros(k)])
            step = np.linalg.solve(system, right)
            poses = solved[..., -1] - solved[..., :-1] @ step
            trial = replace(
                best,
                points=best.points + step[: 3 * n].reshape(n, 3),
                rotation=transform.Rotation.from_rotvec(poses[:, 3:]).as_matrix() @ best.rotation,
                position=best.position + poses[:, :3],
                q=best.q + step[-k:] if optics else best.q,
            )
            tried = trial.normal()
            if tried[-1] < cost:
                small = cost - tried[-1] < 1e-4 * cost
                best, (reduced, right, solved, _, _, cost) = trial, tried
                damping = max(damping / 5.0, 1e-7)
                if small:
                    break
            else:
                damping *= 10.0
        return best


def with_optics_unsure(fit: RodFit, optics: Optics) -> RodFit:
    """Add the uncertainty of the cameras to the covariances.

    Points are displaced by a nearly linear map. It also turns the base, and how it deforms space
    changes the wrench in the base's axes, relative to its size.
    """
    moved = [optics.displacements(points) for points in (fit.contact_point, fit.position)]
    contact, none = np.einsum("vti,vtj->tij", moved[0], moved[0]), np.zeros((3, 3))
    middle = np.nanmedian(fit.position, axis=0)
    ends = optics.displacements(middle + _AROUND * np.concatenate([np.eye(3), -np.eye(3)]))
    map_ = np.swapaxes(ends[:, :3] - ends[:, 3:], 1, 2) / (2.0 * _AROUND)
    back = np.swapaxes(map_, 1, 2)
    tangent = fit.rotation[:, :, 0]
    roll = 0.5 * (map_ - back)[:, [2, 0, 1], [1, 2, 0]] @ tangent.T
    turn = np.cross(tangent, np.einsum("vij,tj->vti", map_, tangent)) + roll[..., None] * tangent
    strain = np.einsum("tki,vkl,tlj->vtij", fit.rotation, 0.5 * (map_ + back), fit.rotation)
    loads = np.concatenate(
        [np.einsum("vtij,tj->vti", strain, load) for load in (fit.force, fit.moment)], axis=2
    )
    poses = np.concatenate([moved[1], turn], axis=2)
    fit = _widened(fit, contact, none, np.moveaxis(np.concatenate([moved[0], poses], axis=2), 0, 1))
    return replace(
        fit,
        pose_covariance=fit.pose_covariance + np.einsum("vti,vtj->tij", poses, poses),
        wrench_covariance=fit.wrench_covariance + np.einsum("vti,vtj->tij", loads, loads),
        pose_wrench_covariance=fit.pose_wrench_covariance + np.einsum("vti,vtj->tij", poses, loads),
    )


def with_depth_unsure(
    cameras: Sequence[Camera], fit: RodFit, rough: bool, distance: float | None
) -> RodFit:
    """Add what the unknown depth of contacts does to points in the only view, that of a lens.

    The size of a pixel is that at the base; nearer to the lens, all looks larger.
    """
    lens = cameras[0].projection == "perspective"
    if len(cameras) > 1 or not (rough or lens):
        return fit
    (camera,) = cameras
    depth = np.sin(_LEAVES) * np.linalg.norm(fit.contact_point - fit.position, axis=1)
    middle = 0.5 * (np.asarray(camera.size or (0, 0)) - 1.0)
    origin, direction = (ray[0] for ray in camera.rays(middle[None]))
    away = fit.contact_point - origin
    along = away @ direction
    away -= along[:, None] * direction
    if lens:
        depth /= along
    else:
        depth *= _STRENGTH if distance is None else 1.0 / distance
    shift = depth[:, None] * away
    spread = shift[:, :, None] * shift[:, None]
    shared = np.concatenate([shift, np.zeros_like(shift)], axis=1)[:, None]
    return _widened(fit, spread, np.zeros_like(spread), shared)


def _widened(fit: RodFit, contact: Array, base: Array, shared: Array) -> RodFit:
    """Add covariances (t, 3, 3) of contact and base, and errors (t, e, ·) that frames share."""
    pose = fit.pose_covariance.copy()
    pose[:, :3, :3] += base
    shared = np.pad(shared, ((0, 0), (0, 0), (0, fit.shared.shape[2] - shared.shape[2])))
    return replace(
        fit,
        contact_covariance=fit.contact_covariance + contact,
        shared=np.append(fit.shared, shared, axis=1),
        pose_covariance=pose,
    )


def with_shift_unsure(cameras: Sequence[Camera], fit: RodFit, shift: Array) -> RodFit:
    """Add the uncertainty of the cameras' shaking to the covariances of points."""
    seen = np.ptp(shift[..., :2], axis=0).any(axis=1)
    # A camera for which nothing shows it may shake as much as one that shakes.
    size = float(shift[:, seen, :2].std(axis=0).max(initial=0.0))
    sigma = np.nan_to_num(shift[..., 2:], nan=size).reshape(len(shift), -1)
    if not sigma.any():
        return fit
    common = slow_motion(shift[..., :2]).ravel()

    def moved(points: Array) -> Array:
        known = np.isfinite(points)
        slopes = [camera.project_with_slopes(np.where(known, points, 0.0))[1] for camera in cameras]
        back = np.asarray(np.linalg.pinv(np.concatenate(slopes, axis=1)))
        back[~np.all(known, axis=1)] = np.nan
        return back

    contact, base = (moved(points) for points in (fit.contact_point, fit.position))
    spread = [
        np.einsum("tij,tj,tkj->tik", one, sigma**2 + common**2, one) for one in (contact, base)
    ]
    shared = np.swapaxes(np.concatenate([contact, base], axis=1) * common, 1, 2)
    return _widened(fit, spread[0], spread[1], shared[:, common > 0.0])
