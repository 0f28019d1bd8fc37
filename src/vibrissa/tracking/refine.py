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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vibrissa.cameras.camera import Camera
from vibrissa.rod import Discretization, discretize, solve_forces
from vibrissa.tracking.banded import Smoother
from vibrissa.tracking.head import HeadPose
from vibrissa.tracking.pose import BasePose
from vibrissa.tracking.rods import UNKNOWNS, State, bent, first_contacts, rods, tangents
from vibrissa.tracking.sight import Sight
from vibrissa.tracking.trust import trace_variance
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


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
    pose_covariance : array (time, 6, 6)
        Of the base's position, m, and of a small turn about the laboratory's axes, rad.
    pose_wrench_covariance : array (time, 6, 6)
        Of these with force and moment: both come from the same traces.
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
    pose_covariance: Array
    pose_wrench_covariance: Array
    centerline: Array
    misfit: Array


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
    head: HeadPose | None = None,
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
        How it is held, about, relative to the head.
    touching : array (time,)
        Frames in contact.
    curves : array (time, node, 3)
        The whisker, about, relative to the head, m; to start from.
    rate : float
        Frames per second.
    options : RefineOptions, optional
        How smooth.
    nodes : int
        Points of the fitted centrelines.
    head : HeadPose, optional
        The head in these frames, relative to which the base moves smoothly; by default it does not
        move, and its frame is that of the laboratory.

    Returns
    -------
    Refined
        NaN in frames that show nothing.
    """
    problem, frames = _problem(
        cameras, sight, whisker, pose, touching, curves, rate, options or RefineOptions(), head
    )
    _, state, fit = problem.trusted()
    found = _answer(problem.d, state, fit, problem.touching, nodes)
    return _whole(_in_laboratory(found, problem.head), frames, len(curves))


def cost_of(
    cameras: Sequence[Camera],
    sight: Sight,
    touching: NDArray[np.bool_],
    curves: Array,
    rate: float,
    options: RefineOptions,
    head: HeadPose,
) -> Callable[[Whisker, BasePose], float]:
    """Say how whiskers are compared: by how well they explain the same traces."""
    variance: Array | None = None

    def cost(whisker: Whisker, pose: BasePose) -> float:
        nonlocal variance
        problem, _ = _problem(cameras, sight, whisker, pose, touching, curves, rate, options, head)
        if variance is None:
            # The first says how far the traces are to be trusted.
            trusted, _, fit = problem.trusted()
            variance = trusted.variance
            return fit.cost
        return replace(problem, variance=variance).solved()[1].cost

    return cost


def _problem(
    cameras: Sequence[Camera],
    sight: Sight,
    whisker: Whisker,
    pose: BasePose,
    touching: Mask,
    curves: Array,
    rate: float,
    options: RefineOptions,
    head: HeadPose | None,
) -> tuple[_Problem, NDArray[np.intp]]:
    """Equations of the frames that show something, and which these are."""
    d = discretize(whisker)
    known = np.isfinite(pose.rotation).all(axis=(1, 2)) & np.isfinite(curves).all(axis=(1, 2))
    frames = np.flatnonzero(known)
    sight, touching = sight.rows(frames), touching[frames]
    head = (head or HeadPose.still(len(curves))).rows(frames)
    start = State(
        pose.rotation[frames], pose.position[frames] / d.length, np.zeros((len(frames), 4))
    )
    start.contact[:, 0] = 0.5
    start.contact[touching] = first_contacts(d, start, curves[frames], touching)[0]
    return _Problem(d, cameras, sight, touching, frames, start, rate, options, head), frames


class _Linear(NamedTuple):
    """Normal equations at a state, and what they were made of."""

    smoother: Smoother
    cost: float
    misfit: Array
    wild: Mask
    data: Array
    misses: list[Array]


@dataclass(frozen=True, eq=False)
class _Problem:
    d: Discretization
    cameras: Sequence[Camera]
    sight: Sight
    touching: Mask
    frames: NDArray[np.intp]
    start: State
    rate: float
    options: RefineOptions
    head: HeadPose
    begun: State | None = None
    variance: Array | None = None

    def trusted(self) -> tuple[_Problem, State, _Linear]:
        """The problem with traces that are trusted as far as they deserve, and its solution."""
        state, fit = self.solved()
        fitted = np.einsum("tij,tji->t", fit.smoother.covariances(), fit.data)
        variance = trace_variance(fit.misses, fitted)
        problem = replace(self, begun=state, variance=variance)
        return (problem, *((state, fit) if (variance == 1.0).all() else problem.solved()))

    def solved(self) -> tuple[State, _Linear]:
        """Gauss–Newton with Levenberg's damping."""
        state, damping = self.begun or self.start, 1e-3
        fit = self._linear(state)
        for _ in range(self.options.rounds):
            step = fit.smoother.solved(damping)
            trial = state.moved(step)
            tried = self._linear(trial)
            if tried.wild.any():
                # A contact near the thin tip soon has a force under which no rod is in balance.
                contact = np.where(tried.wild[:, None], state.contact, trial.contact)
                trial = replace(trial, contact=contact)
                tried = self._linear(trial)
            if tried.cost < fit.cost:
                small = fit.cost - tried.cost < 1e-4 * fit.cost
                state, fit = trial, tried
                damping = max(damping / 5.0, 1e-8)
                if small:
                    break
            else:
                damping *= 10.0
                if damping > 1e6:
                    break
        return state, fit

    def _linear(self, state: State) -> _Linear:
        """Linearise at a state; rods that blow up count as infinitely far away."""
        points, slopes = bent(self.d, state, self.touching)
        wild = ~(np.abs(slopes).max(axis=(1, 2, 3)) < _WILD)
        points[wild], slopes[wild] = state.position[wild, None], 0.0
        points = self.head.put_in(points * self.d.length)
        slopes = np.einsum("tij,tnjk->tnik", self.head.rotation, slopes)
        with_ends = np.concatenate([slopes, slopes[:, [0, -1]]], axis=1)
        hessian = np.zeros((len(points), UNKNOWNS, UNKNOWNS))
        gradient = np.zeros((len(points), UNKNOWNS))
        total, count = np.zeros(len(points)), np.zeros(len(points))
        weight = np.ones(len(points)) if self.variance is None else 1.0 / self.variance
        along = []
        for view, camera in enumerate(self.cameras):
            pixels, by_point = camera.project_with_slopes(points)
            rows, misses = self.sight.equations(view, pixels, by_point * self.d.length)
            design = np.einsum("tni,tnij->tnj", rows, with_ends)
            hessian += np.einsum("tni,tnj->tij", design, design)
            gradient += np.einsum("tni,tn->ti", design, misses)
            total += (misses**2).sum(axis=1)
            count += (misses != 0.0).sum(axis=1)
            # The last two are how far the ends are off along the trace.
            along.append(np.where(wild[:, None], 0.0, misses[:, :-2]))
        misfit = np.sqrt(total / np.maximum(count, 1.0))
        total[wild] = np.inf
        data = hessian * weight[:, None, None]
        smoother = Smoother(data, gradient * weight[:, None])
        cost = float((weight * total).sum()) + self._priors(smoother, state)
        return _Linear(smoother, cost, misfit, wild, data, along)

    def _priors(self, smoother: Smoother, state: State) -> float:
        o = self.options
        slower = (1000.0 / self.rate) ** 2
        # How it turned since the start, in the head's axes.
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


_RUBBING = 1e-4
_WILD = 1e6
"""Slopes of points of a rod, in units of L, from which it is none."""

_REST = np.array([0.5, 0.0, 0.0, 0.0])


def _turning(rotation: Array) -> Array:
    """Rotation vectors (t − 1, 3) from each frame to the next, laboratory axes."""
    step = rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)
    return np.asarray(Rotation.from_matrix(step).as_rotvec())


def _answer(d: Discretization, state: State, fit: _Linear, touching: Mask, nodes: int) -> Refined:
    """Results in SI units, relative to the head."""
    covariance, misfit = fit.smoother.covariances(), fit.misfit
    values, _ = solve_forces(d, state.contact)
    slope = tangents(d, state.contact)
    n = len(touching)
    force, point = values[:, :3], values[:, 3:]
    wrench = np.concatenate([force * d.force, np.cross(point, force) * d.moment], axis=1)
    by_contact = np.concatenate(
        [
            slope[:, :3] * d.force,
            np.stack(
                [
                    np.cross(slope[:, 3:, k], force) + np.cross(point, slope[:, :3, k])
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
    slopes[:, :, 6:] = state.rotation @ slope[:, 3:]
    inside = covariance[:, 6:, 6:]
    size = np.repeat([d.length, 1.0], 3)
    held = covariance[:, :6, :6] * np.outer(size, size)
    both = covariance[:, :6, 6:] * size[:, None] @ np.swapaxes(by_contact, 1, 2)
    line = rods(d, state.contact, np.linspace(0.0, 1.0, nodes))
    line = np.einsum("tij,tnj->tni", state.rotation, line) + state.position[:, None]
    none = np.where(touching, 1.0, np.nan)
    return Refined(
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
        pose_covariance=held,
        pose_wrench_covariance=both * touching[:, None, None],
        centerline=line * d.length,
        misfit=misfit,
    )


def _in_laboratory(found: Refined, head: HeadPose) -> Refined:
    """Take poses and points from the head's frame to the laboratory's."""
    turn = head.rotation
    both = np.zeros((len(turn), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = turn
    return replace(
        found,
        rotation=turn @ found.rotation,
        position=head.put_in(found.position),
        contact_point=head.put_in(found.contact_point),
        contact_covariance=turn @ found.contact_covariance @ np.swapaxes(turn, 1, 2),
        pose_covariance=both @ found.pose_covariance @ np.swapaxes(both, 1, 2),
        pose_wrench_covariance=both @ found.pose_wrench_covariance,
        centerline=head.put_in(found.centerline),
    )


def _whole(found: Refined, frames: NDArray[np.intp], count: int) -> Refined:
    """Put the frames in their places among all."""
    whole = {}
    for name, values in vars(found).items():
        out = np.full((count, *values.shape[1:]), np.nan)
        out[frames] = values
        whole[name] = out
    return Refined(**whole)
