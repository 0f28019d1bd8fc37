"""What touches the whisker, from its shape: contact and wrench that make the rod fit the traces.

Per frame the unknowns are where the base is and how it is turned (six numbers) and, in contact,
the contact's arc length and force (s_c, f_x, f_y, f_z); they give the bent rod exactly. They are
chosen such that its images in all views lie on the traces, by least squares over all frames at
once: from frame to frame the base moves smoothly, and so does the contact as long as it lasts.
Friction, the force along the whisker, shows in its shape; it is only kept from being much larger
than the force across. The contact is found this way even where it is hidden, and so are force and
moment at the base; the covariance says how well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vibrissa.rod.batch import solve_forces
from vibrissa.rod.discretize import Discretization, discretize
from vibrissa.rod.shape import shapes
from vibrissa.tracking.banded import Smoother
from vibrissa.tracking.pose import BasePose
from vibrissa.tracking.sight import Sight
from vibrissa.trial.cameras import Camera
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SAMPLES = 48
_STARTS = np.array([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
_LIMITS = (0.1, 0.995)
_STEP = 1e-5


@dataclass(frozen=True)
class RefineOptions:
    """How smooth motion and contact are over time, and when the fit ends.

    Standard deviations of second differences at 1,000 frames/s; at other rates they scale with the
    square of the time between frames.

    Parameters
    ----------
    turning : float
        Of the base's orientation, rad.
    moving : float
        Of the base's position, m.
    sliding : float
        Of the contact's arc length, m.
    pressing : float
        Of the contact force, in units of EI/L² at the base.
    friction : float
        Standard deviation of the force along the whisker, as a share of that across it; 0 is a
        contact without friction.
    roll : float
        How far the roll may be from what it is expected to be, rad.
    rounds : int
        Of Gauss–Newton, at most.
    """

    turning: float = 2e-3
    moving: float = 2e-5
    sliding: float = 2e-4
    pressing: float = 0.05
    friction: float = 0.1
    roll: float = np.radians(0.5)
    rounds: int = 12


@dataclass(frozen=True, eq=False)
class Refined:
    """Pose, contact and wrench of every frame.

    Parameters
    ----------
    rotation : array (time, 3, 3)
        From the whisker's to the laboratory frame; NaN where nothing is known.
    position : array (time, 3)
        Of the base, m.
    arc_length : array (time,)
        Of the contact, m; NaN without contact.
    contact_point_whisker, contact_point : array (time, 3)
        In the whisker's and the laboratory frame, m.
    contact_covariance : array (time, 3, 3)
        Of the contact point in the laboratory, m².
    force, moment : array (time, 3)
        At the base, whisker's frame, N and N·m; 0 without contact.
    wrench_covariance : array (time, 6, 6)
        Of both.
    centerline : array (time, node, 3)
        The fitted rod, laboratory frame, m.
    misfit : array (time,)
        Root mean square distance from the traces, in their standard deviations.
    """

    rotation: Array
    position: Array
    arc_length: Array
    contact_point_whisker: Array
    contact_point: Array
    contact_covariance: Array
    force: Array
    moment: Array
    wrench_covariance: Array
    centerline: Array
    misfit: Array


@dataclass(frozen=True, eq=False)
class _State:
    rotation: Array  # (t, 3, 3)
    position: Array  # (t, 3), units of L
    contact: Array  # (t, 4): s_c, f_x, f_y, f_z

    def moved(self, step: Array) -> _State:
        """Change by (t, 10): shift, turn about laboratory axes, contact."""
        turn = Rotation.from_rotvec(step[:, 3:6]).as_matrix()
        contact = self.contact + step[:, 6:]
        contact[:, 0] = np.clip(contact[:, 0], *_LIMITS)
        return _State(turn @ self.rotation, self.position + step[:, :3], contact)


def refine(
    cameras: Sequence[Camera],
    sight: Sight,
    whisker: Whisker,
    pose: BasePose,
    touching: NDArray[np.bool_],
    curves: Array,
    rate: float,
    options: RefineOptions | None = None,
    nodes: int = 65,
) -> Refined:
    """Fit the rod to the traces of a whole trial.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    sight : Sight
        The traces of one whisker, all frames and views.
    whisker : Whisker
        The whisker at rest.
    pose : BasePose
        How it is held, about.
    touching : array (time,)
        Frames in contact.
    curves : array (time, node, 3)
        The whisker in the laboratory, about, m; to start from.
    rate : float
        Frames per second.
    options : RefineOptions, optional
        How smooth.
    nodes : int
        Points of the fitted centrelines.

    Returns
    -------
    Refined
        NaN in frames that show nothing.
    """
    options = options or RefineOptions()
    d = discretize(whisker)
    known = np.isfinite(pose.rotation).all(axis=(1, 2)) & np.isfinite(curves).all(axis=(1, 2))
    frames = np.flatnonzero(known)
    sight, touching = sight.rows(frames), touching[frames]
    start = _State(
        pose.rotation[frames], pose.position[frames] / d.length, np.zeros((len(frames), 4))
    )
    start.contact[:, 0] = 0.5
    start.contact[touching] = _first_contacts(d, start, curves[frames], touching)
    problem = _Problem(d, cameras, sight, touching, frames, start, rate, options)
    state, smoother, misfit = problem.solved()
    return _answer(d, state, smoother.covariances(), touching, misfit, frames, len(curves), nodes)


@dataclass(frozen=True, eq=False)
class _Problem:
    d: Discretization
    cameras: Sequence[Camera]
    sight: Sight
    touching: Mask
    frames: NDArray[np.intp]
    start: _State
    rate: float
    options: RefineOptions

    def solved(self) -> tuple[_State, Smoother, Array]:
        """Gauss–Newton with Levenberg's damping."""
        state, damping = self.start, 1e-3
        smoother, cost, misfit = self._linear(state)
        for _ in range(self.options.rounds):
            step = smoother.solved(damping)
            trial = state.moved(step)
            tried, lower, spread = self._linear(trial)
            if lower < cost:
                small = cost - lower < 1e-4 * cost
                state, smoother, cost, misfit = trial, tried, lower, spread
                damping = max(damping / 5.0, 1e-8)
                if small:
                    break
            else:
                damping *= 10.0
                if damping > 1e6:
                    break
        return state, smoother, misfit

    def _linear(self, state: _State) -> tuple[Smoother, float, Array]:
        """Normal equations at a state, the cost, and each frame's misfit."""
        points, slopes = bent(self.d, state, self.touching)
        with_ends = np.concatenate([slopes, slopes[:, [0, -1]]], axis=1)
        hessian = np.zeros((len(points), UNKNOWNS, UNKNOWNS))
        gradient = np.zeros((len(points), UNKNOWNS))
        total, count = np.zeros(len(points)), np.zeros(len(points))
        for view, camera in enumerate(self.cameras):
            pixels, by_point = camera.project_with_slopes(points * self.d.length)
            rows, misses = self.sight.equations(view, pixels, by_point * self.d.length)
            design = np.einsum("tni,tnij->tnj", rows, with_ends)
            hessian += np.einsum("tni,tnj->tij", design, design)
            gradient += np.einsum("tni,tn->ti", design, misses)
            total += (misses**2).sum(axis=1)
            count += (misses != 0.0).sum(axis=1)
        misfit = np.sqrt(total / np.maximum(count, 1.0))
        smoother = Smoother(hessian, gradient)
        cost = float(total.sum()) + self._priors(smoother, state)
        return smoother, cost, misfit

    def _priors(self, smoother: Smoother, state: _State) -> float:
        o = self.options
        slower = (1000.0 / self.rate) ** 2
        # How it turned since the start, in laboratory axes.
        turn = Rotation.from_matrix(
            state.rotation @ np.swapaxes(self.start.rotation, 1, 2)
        ).as_rotvec()
        place = np.concatenate([state.position, turn, state.contact], axis=1)
        # Second differences of the whole motion, of which the start is a part.
        begun = _turning(self.start.rotation)
        cost = smoother.add_at(place[:, 6:], np.where(self.touching, 0.0, 1e8)[:, None], 6, _REST)
        across = np.linalg.norm(state.contact[:, 2:], axis=1)
        rubbing = 1.0 / (o.friction * across + _RUBBING) ** 2
        cost += smoother.add_at(place[:, 7:8], rubbing[:, None], 7, np.zeros(1))
        axis = state.rotation[:, :, 0]
        rolled = (turn * axis).sum(axis=1)
        cost += smoother.add_along(axis, rolled, 3, 1.0 / o.roll)
        together = np.diff(self.frames) == 1
        pose = (1.0 / (o.moving / self.d.length), 1.0 / o.turning)
        contact = (1.0 / (o.sliding / self.d.length), *[1.0 / o.pressing] * 3)
        weight = np.array([pose[0]] * 3 + [pose[1]] * 3 + list(contact)) / slower
        for i in range(1, len(place) - 1):
            if not (together[i - 1] and together[i]):
                continue
            second = place[i - 1] - 2.0 * place[i] + place[i + 1]
            second[3:6] += begun[i] - begun[i - 1]
            scale = weight.copy()
            if not self.touching[i - 1 : i + 2].all():
                scale[6:] = 0.0
            cost += smoother.add_second(i, second, scale)
        return cost


UNKNOWNS = 10
"""Of a frame: shift (3), turn (3), s_c, f_x, f_y, f_z."""

_RUBBING = 1e-4
_REST = np.array([0.5, 0.0, 0.0, 0.0])


def _turning(rotation: Array) -> Array:
    """Rotation vectors (t − 1, 3) from each frame to the next, laboratory axes."""
    step = rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)
    return np.asarray(Rotation.from_matrix(step).as_rotvec())


def bent(d: Discretization, state: _State, touching: Mask) -> tuple[Array, Array]:
    """Points of the bent rods and their derivatives.

    Parameters
    ----------
    d : Discretization
        The whisker.
    state : _State
        Pose and contact of every frame.
    touching : array (time,)
        Frames in contact.

    Returns
    -------
    points : array (time, n, 3)
        Equally spaced, laboratory frame, units of L.
    slopes : array (time, n, 3, 10)
        By shift, turn and contact.
    """
    s = np.linspace(0.0, 1.0, _SAMPLES)
    local = _rods(d, state.contact, s)
    turned = np.einsum("tij,tnj->tni", state.rotation, local)
    slopes = np.zeros((*local.shape, UNKNOWNS))
    slopes[..., :3] = np.eye(3)
    x, y, z = np.moveaxis(turned, -1, 0)
    slopes[..., 0, 4], slopes[..., 0, 5] = z, -y
    slopes[..., 1, 3], slopes[..., 1, 5] = -z, x
    slopes[..., 2, 3], slopes[..., 2, 4] = y, -x
    rows = np.flatnonzero(touching)
    for k in range(4):
        ahead, back = (state.contact[rows].copy() for _ in range(2))
        step = _STEP if k == 0 else 1e-4
        ahead[:, k] += step
        back[:, k] -= step
        change = (_rods(d, ahead, s) - _rods(d, back, s)) / (2.0 * step)
        slopes[rows, :, :, 6 + k] = np.einsum("tij,tnj->tni", state.rotation[rows], change)
    return turned + state.position[:, None], slopes


def _rods(d: Discretization, contact: Array, s: Array) -> Array:
    """Places (t, n, 3) of rods with contacts (t, 4), whisker frame, units of L."""
    values, _ = solve_forces(d, contact)
    return shapes(d, values, np.ascontiguousarray(contact[:, 0]), s)


def _tangents(d: Discretization, contact: Array) -> Array:
    """Derivatives (t, 6, 4) of base force and contact point by the contact."""
    columns = []
    for k in range(4):
        step = np.zeros(4)
        step[k] = _STEP if k == 0 else 1e-4
        ahead, back = (solve_forces(d, contact + sign * step)[0] for sign in (1.0, -1.0))
        columns.append((ahead - back) / (2.0 * step[k]))
    return np.stack(columns, axis=-1)


def _first_contacts(d: Discretization, state: _State, curves: Array, touching: Mask) -> Array:
    """Contacts (n, 4) of the touching frames that make the rod look most like the curves."""
    rows = np.flatnonzero(touching)
    if not rows.size:
        return np.empty((0, 4))
    s = np.linspace(0.0, 0.95, 25)
    target = _at_lengths(curves[rows], s * d.length) / d.length
    away = target - state.position[rows, None]
    wanted = np.einsum("tji,tnj->tni", state.rotation[rows], away).reshape(len(rows), -1)
    known = np.isfinite(wanted)
    wanted = np.where(known, wanted, 0.0)
    best, least = np.zeros((len(rows), 4)), np.full(len(rows), np.inf)
    for place in _STARTS:
        contact = np.zeros((len(rows), 4))
        contact[:, 0] = place
        for _ in range(5):
            now = _rods(d, contact, s).reshape(len(rows), -1) * known
            columns = []
            for k in (2, 3):
                ahead = contact.copy()
                ahead[:, k] += 1e-4
                columns.append((_rods(d, ahead, s).reshape(len(rows), -1) * known - now) / 1e-4)
            design = np.stack(columns, axis=-1)
            square = np.swapaxes(design, 1, 2) @ design
            right = (np.swapaxes(design, 1, 2) @ (wanted - now)[..., None])[..., 0]
            step = np.linalg.solve(square + 1e-9 * np.eye(2), right[..., None])[..., 0]
            size = np.linalg.norm(step, axis=1, keepdims=True)
            limit = 2.0 / place**2
            contact[:, 2:] += step * np.minimum(1.0, limit / np.maximum(size, 1e-12))
        missed = _rods(d, contact, s).reshape(len(rows), -1) * known - wanted
        cost = (missed**2).sum(axis=1)
        better = cost < least
        best[better], least[better] = contact[better], cost[better]
    return best


def _at_lengths(curves: Array, s: Array) -> Array:
    """Points (t, n, 3) of curves at arc lengths (n,), m; NaN beyond their ends."""
    out = np.empty((len(curves), len(s), 3))
    for i, curve in enumerate(curves):
        at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        for k in range(3):
            out[i, :, k] = np.interp(s, at, curve[:, k], right=np.nan)
    return out


def _answer(
    d: Discretization,
    state: _State,
    covariance: Array,
    touching: Mask,
    misfit: Array,
    frames: NDArray[np.intp],
    count: int,
    nodes: int,
) -> Refined:
    """Results in SI units, all frames."""
    values, _ = solve_forces(d, state.contact)
    tangents = _tangents(d, state.contact)
    n = len(frames)
    force, point = values[:, :3], values[:, 3:]
    wrench = np.concatenate([force * d.force, np.cross(point, force) * d.moment], axis=1)
    by_contact = np.concatenate(
        [
            tangents[:, :3] * d.force,
            np.stack(
                [
                    np.cross(tangents[:, 3:, k], force) + np.cross(point, tangents[:, :3, k])
                    for k in range(4)
                ],
                axis=-1,
            )
            * d.moment,
        ],
        axis=1,
    )
    turned = np.einsum("tij,tj->ti", state.rotation, point)
    slopes = np.zeros((n, 3, UNKNOWNS))
    slopes[:, :, :3] = np.eye(3)
    x, y, z = turned.T
    slopes[:, 0, 4], slopes[:, 0, 5] = z, -y
    slopes[:, 1, 3], slopes[:, 1, 5] = -z, x
    slopes[:, 2, 3], slopes[:, 2, 4] = y, -x
    slopes[:, :, 6:] = state.rotation @ tangents[:, 3:]
    inside = covariance[:, 6:, 6:]
    line = _rods(d, state.contact, np.linspace(0.0, 1.0, nodes))
    line = np.einsum("tij,tnj->tni", state.rotation, line) + state.position[:, None]
    none = np.where(touching, 1.0, np.nan)
    found = Refined(
        rotation=state.rotation,
        position=state.position * d.length,
        arc_length=state.contact[:, 0] * d.length * none,
        contact_point_whisker=point * d.length * none[:, None],
        contact_point=(turned + state.position) * d.length * none[:, None],
        contact_covariance=slopes
        @ covariance
        @ np.swapaxes(slopes, 1, 2)
        * (d.length**2 * none[:, None, None]),
        force=wrench[:, :3] * touching[:, None],
        moment=wrench[:, 3:] * touching[:, None],
        wrench_covariance=by_contact
        @ inside
        @ np.swapaxes(by_contact, 1, 2)
        * touching[:, None, None],
        centerline=line * d.length,
        misfit=misfit,
    )
    whole = {}
    for name, values in vars(found).items():
        out = np.full((count, *values.shape[1:]), np.nan)
        out[frames] = values
        whole[name] = out
    return replace(found, **whole)
