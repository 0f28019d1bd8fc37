"""Fit of the rod to the traces: contact and wrench over a whole trial, from the whisker's shape.

Per frame the unknowns are position and orientation of the base (six numbers) and, in contact, arc
length and force of the contact (s_c, f_x, f_y, f_z); they determine the bent rod exactly. Its
images in all views are fitted to the traces by least squares over all frames at once: the base
moves smoothly from frame to frame, and so does the contact while it lasts. Friction, the force
along the whisker, changes its shape; it is only restrained from being much larger than the force
across. The fit thus finds the contact even where it is hidden, and force and moment at the base,
with their covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.deferred import transform
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface
from vibrissa.rod import Discretization, discretize, solve_forces
from vibrissa.tracking.refine.least_squares import Smoother, trace_variance
from vibrissa.tracking.refine.rods import (
    FAR,
    UNKNOWNS,
    State,
    TraceSeries,
    bent,
    contact_slopes,
    first_contacts,
    rods,
)
from vibrissa.tracking.space.pose import BasePose, HeadPose
from vibrissa.tracking.space.rest_shape import Length
from vibrissa.tracking.trace.trace import correlated
from vibrissa.whisker import Whisker

# Levenberg's damping: initial, smallest, and that at which the fit ends.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-8, 1e6
_SMALL = 1e-4  # relative decrease of the cost for another iteration
_HELD = 1e8  # weight with which frames without contact keep the contact at rest
# Unknowns across the plane z = 0: a shift, turns about two axes; the force across it.
_ACROSS = (slice(2, 5), slice(9, 10))
# Contact of a free frame: no force, half-way along the whisker.
_REST = np.array([0.5, 0.0, 0.0, 0.0])
# Standard deviation of the force along the whisker if there is none across, in units of EI/L².
_RUBBING = 1e-4
_WAVES = 8  # number of waves along the whisker for common errors of a view's traces
# Standard deviation of the shift by light from the side at the base, pixels, less where the whisker
# is thinner, if its profile shows no more; that shift over the profile's third cumulant, in radii,
# for a flank of 0.65 radii that is lit by half; where on the whisker that is taken; and the largest
# shift, in radii, which is that by a flank as bright as the background.
_LIT, _SHIFTED, _NEARER, _MOST_LIT = 0.1, 3.2, 0.25, 0.5
# Standard deviation of other shifts of a view's traces, largest at the base, pixels.
_UNSEEN = 0.02
_MEDIAN = 1.86  # standard deviation of a median of n normal numbers, over their median size and √n
_SQUARE = 0.455  # median of the square of a standard normal number
# Share of the length over which fur may draw a trace aside, and by how much more it does than what
# the rod, which follows it, leaves of that.
_AT_BASE, _FOLLOWED = 0.03, 2.0
# Standard deviation of how far the rest shape is drawn aside at its base, where its tangent is the
# axis of the whisker's frame, pixels, if residuals show no more; and its share of what they show.
_HOOKED, _HOOK = 0.01, 0.35
_PROXIMAL = 0.7  # share of the whisker that determines the roll of its frame
# Standard deviation of the error along the whisker that base and tip have in all frames, in units
# of what it scatters: fur hides a base by more than it does so unevenly.
_ENDS = (3.5, 1.0)
# Unknowns of a contact without friction: arc length and the force across the whisker.
_FREE = [0, 2, 3]
_ROLLED = np.radians(3.0)  # standard deviation of the roll before its variation is known, rad
_WILD = 1e6  # slopes of points of a rod, in units of L, above which it is not in equilibrium
# Change of the inverse length, as a share, up to which its effects are linear, and the largest.
_LINEAR, _MOST_UNSURE = 0.04, 0.6
_CURVED = 0.05  # distance of points that show the curvature at a contact, as a share of the length
_HALVED = 6  # largest number of times that initial forces without equilibrium are halved


@dataclass(frozen=True)
class FitOptions:
    """Smoothness of motion and contact over time, and the end of the fit.

    Standard deviations of second differences are those at 1,000 frames/s; at other rates they scale
    with the square of the time between frames.
    """

    turning: float = 2e-3  # standard deviation of second differences of the base's orientation, rad
    moving: float = 2e-5  # standard deviation of second differences of the base's position, m
    sliding: float = 2e-4  # standard deviation of second differences of the contact's arc length, m
    # Standard deviation of second differences of the contact force, in units of EI/L² at the base.
    pressing: float = 0.05
    # Standard deviation of the force along the whisker, as a share of that across it; 0 is a
    # contact without friction.
    friction: float = 0.1
    # Smallest standard deviation of the roll about what it is expected to be, rad.
    roll: float = np.radians(0.5)
    surface: float = 3e-5  # standard deviation of the distance of contacts from known objects, m
    # Smallest standard deviation of traces that residuals may show, as a share of the stated one;
    # at least 1 where a trace is a line between few points (`Trace.sparse`).
    sharpest: float = 0.2
    rounds: int = 12  # largest number of Gauss–Newton steps


@dataclass(frozen=True, eq=False)
class RodFit:
    """Pose, contact and wrench of every frame, SI units; NaN where unknown.

    Errors that all frames share, independent of each other, shift the contact point and the base
    and turn the base by ``shared``, each for one standard deviation. They are part of the
    covariances. Its last six values are changes of force and moment, for a fixed contact, due to
    errors of the whisker's shape.
    """

    rotation: Array  # (time, 3, 3), from the whisker's to the laboratory frame
    position: Array  # (time, 3) of the base, laboratory
    arc_length: Array  # (time,) of the contact
    contact_point_whisker: Array  # (time, 3)
    contact_point: Array  # (time, 3), laboratory
    contact_covariance: Array  # (time, 3, 3), laboratory
    shared: Array  # (time, error, 15), laboratory, but the last six in the whisker's frame
    force: Array  # (time, 3) at the base, whisker's frame; 0 without contact
    moment: Array  # the same
    wrench_covariance: Array  # (time, 6, 6) of both
    pose_covariance: Array  # (time, 6, 6) of position and small turns, laboratory axes
    pose_wrench_covariance: Array  # (time, 6, 6): both come from the same traces
    centerline: Array  # (time, node, 3), laboratory
    misfit: Array  # (time,), root mean square distance from the traces in their deviations


@dataclass(frozen=True, eq=False)
class Fitter:
    """Traces, and tables common to all rods fitted to them."""

    cameras: Sequence[Camera]
    traces: TraceSeries
    touching: Mask
    curves: Array
    rate: float
    options: FitOptions
    head: HeadPose
    objects: Sequence[Surface] = ()

    def fit(
        self, whisker: Whisker, pose: BasePose, nodes: int, length: Length | None = None
    ) -> RodFit:
        """Fit a whisker of approximate pose, whose length may be uncertain."""
        problem, state, linear = self._problem(whisker, pose).trusted()
        length = length or Length(whisker.length, 0.0)
        found = _answer(problem, state, linear, nodes, length)
        return _whole(_in_laboratory(found, problem.head), problem.frames, len(self.curves))

    def misfits(self, whisker: Whisker, pose: BasePose) -> Array:
        """Misfits of a rod (time,), in stated deviations; infinite where there are no traces."""
        problem = self._problem(whisker, pose)
        found = np.full(len(self.curves), np.inf)
        if len(problem.frames):
            _, linear = problem.solved()
            found[problem.frames] = np.where(linear.wild, np.inf, linear.misfit)
        return found

    def costs(self, shown: float) -> Callable[[Whisker, BasePose], float]:
        """Function that compares whiskers by how well they explain the traces.

        Whiskers of all lengths are compared with the same part of the traces, up to the arc length
        ``shown``, m: a longer one would also have to explain the uncertain ends of longer traces.
        """
        before: tuple[Problem, State] | None = None
        traces = replace(self.traces, ends=self.traces.ends * [1.0, 0.0])

        def cost(whisker: Whisker, pose: BasePose) -> float:
            nonlocal before
            share = min(shown / whisker.length, 1.0)
            begun = before and before[1].scaled(before[0].d.length / whisker.length)
            problem = replace(self, traces=traces)._problem(whisker, pose, begun)
            problem = replace(problem, shown=share)
            if before is None:
                # The first whisker sets the variance of the traces, but not where it is large: the
                # residuals of a wrong length are largest where it matters.
                problem, state, linear = problem.trusted(even=True)
            else:
                trusted = before[0]
                problem = replace(problem, variance=trusted.variance, options=trusted.options)
                state, linear = problem.solved()
            before = problem, state
            return linear.cost

        return cost

    def _problem(self, whisker: Whisker, pose: BasePose, begun: State | None = None) -> Problem:
        """Equations of the frames with traces, and the first guess of the solution."""
        d = discretize(whisker)
        known = np.isfinite(pose.rotation).all(axis=(1, 2))
        frames = np.flatnonzero(known & np.isfinite(self.curves).all(axis=(1, 2)))
        touching = self.touching[frames]
        start = State(
            pose.rotation[frames], pose.position[frames] / d.length, np.zeros((len(frames), 4))
        )
        start.contact[:, 0] = _REST[0]
        if begun is None:
            start.contact[touching] = first_contacts(d, start, self.curves[frames], touching)
        return Problem(
            whisker,
            d,
            self.cameras,
            self.traces.rows(frames),
            touching,
            frames,
            start,
            self.rate,
            self.options,
            self.head.rows(frames),
            self.objects,
            begun,
        )


class _Linear(NamedTuple):
    """Normal equations at a state, and their ingredients."""

    smoother: Smoother
    cost: float
    misfit: Array
    wild: Mask
    data: Array
    misses: list[Array]
    ends: list[Array]
    designs: list[Array]
    weights: list[Array]

    def left(self, rows: Mask) -> list[Array]:
        """Means over some frames of the residuals of each view, pixels."""
        found = []
        for misses, weight in zip(self.misses, self.weights, strict=True):
            sharp = weight[rows, :-2]
            pixels = np.divide(misses[rows], sharp, out=np.zeros(sharp.shape), where=sharp > 0.0)
            found.append(pixels.sum(axis=0) / np.maximum((sharp > 0.0).sum(axis=0), 1))
        return found


@dataclass(frozen=True, eq=False)
class Problem:
    """Equations of a fit: traces, motion over time, and the initial state."""

    whisker: Whisker
    d: Discretization
    cameras: Sequence[Camera]
    traces: TraceSeries
    touching: Mask
    frames: NDArray[np.intp]
    start: State
    rate: float
    options: FitOptions
    head: HeadPose
    objects: Sequence[Surface] = ()
    begun: State | None = None
    variance: list[Array] | None = None
    shown: float = 1.0

    def trusted(self, even: bool = False) -> tuple[Problem, State, _Linear]:
        """The problem with traces weighted by their residuals, and its solution."""
        loose = replace(self.options, roll=max(self.options.roll, _ROLLED))
        state, fit = replace(self, options=loose).solved()
        covariance = fit.smoother.covariances()
        fitted = np.einsum("tij,tji->t", covariance, fit.data)
        variance = trace_variance(fit.misses, fitted, self.options.sharpest**2, even)
        options = replace(loose, roll=self._unexpected(state, covariance, loose.roll))
        problem = replace(self, begun=state, variance=variance, options=options)
        return (problem, *problem.solved())

    def _unexpected(self, state: State, covariance: Array, loose: float) -> float:
        """Standard deviation of the roll in contact from that expected by free frames, rad.

        Contact moves a whisker to where no free frame shows its roll. Bent rods with a nearly free
        roll show it, each with its own uncertainty.
        """
        axis = state.rotation[:, :, 0]
        known = np.einsum("ti,tij,tj->t", axis, covariance[:, 3:6, 3:6], axis) / loose**2
        share = 1.0 - known
        rows = self.touching & (share > 0.5)
        if not rows.any():
            return loose
        rolled, share = (self._turned(state) * axis).sum(axis=1)[rows], share[rows]
        square = float(np.mean((rolled / share) ** 2 - loose**2 * known[rows] / share))
        return min(float(np.sqrt(max(square, self.options.roll**2))), loose)

    def _turned(self, state: State) -> Array:
        """Rotation of the base since the start (time, 3), rad, in the head's axes."""
        turn = state.rotation @ np.swapaxes(self.start.rotation, 1, 2)
        return np.asarray(transform.Rotation.from_matrix(turn).as_rotvec())

    def solved(self) -> tuple[State, _Linear]:
        """Gauss-Newton iteration with Levenberg's damping."""
        state, damping = self.begun or self.start, _DAMPING
        fit = self.linear(state)
        for _ in range(_HALVED):
            if not fit.wild.any():
                break
            # A force that another rod withstands may exceed the limit of this one.
            factor = np.where(fit.wild[:, None], [1.0, 0.5, 0.5, 0.5], 1.0)
            state = replace(state, contact=state.contact * factor)
            fit = self.linear(state)
        for _ in range(self.options.rounds):
            step = fit.smoother.solved(damping)
            trial = state.moved(step)
            tried = self.linear(trial)
            if tried.wild.any():
                # A contact near the thin tip easily gets a force without an equilibrium.
                contact = np.where(tried.wild[:, None], state.contact, trial.contact)
                trial = replace(trial, contact=contact)
                tried = self.linear(trial)
            if tried.cost < fit.cost:
                small = fit.cost - tried.cost < _SMALL * fit.cost
                state, fit = trial, tried
                damping = max(damping / 5.0, _LEAST_DAMPING)
                if small:
                    break
            else:
                damping *= 10.0
                if damping > _MOST_DAMPING:
                    break
        return state, fit

    def linear(self, state: State) -> _Linear:
        """Linearise at a state; rods without equilibrium count as infinitely far away."""
        points, slopes = bent(self.d, state, self.touching, self.shown)
        wild = ~(np.abs(slopes).max(axis=(1, 2, 3)) < _WILD)
        points[wild], slopes[wild] = state.position[wild, None], 0.0
        points = self.head.put_in(points * self.d.length)
        slopes = np.einsum("tij,tnjk->tnik", self.head.rotation, slopes)
        with_ends = np.concatenate([slopes, slopes[:, [0, -1]]], axis=1)
        hessian = np.zeros((len(points), UNKNOWNS, UNKNOWNS))
        gradient = np.zeros((len(points), UNKNOWNS))
        total, count, weighted = np.zeros((3, len(points)))
        along, ends, designs, weights = [], [], [], []
        for view, camera in enumerate(self.cameras):
            pixels, by_point = camera.project_with_slopes(points)
            rows, misses, sharp = self.traces.equations(view, pixels, by_point * self.d.length)
            design = np.einsum("tni,tnij->tnj", rows, with_ends)
            weight = np.ones(misses.shape) if self.variance is None else 1.0 / self.variance[view]
            trusted = design * weight[..., None]
            hessian += np.einsum("tni,tnj->tij", trusted, design)
            gradient += np.einsum("tni,tn->ti", trusted, misses)
            weighted += (weight * misses**2).sum(axis=1)
            total += (misses**2).sum(axis=1)
            count += (misses != 0.0).sum(axis=1)
            # The last two are errors of the ends along the trace.
            along.append(np.where(wild[:, None], 0.0, misses[:, :-2]))
            ends.append(misses[:, -2:])
            designs.append(trusted)
            weights.append(sharp)
        misfit = np.sqrt(total / np.maximum(count, 1.0))
        weighted[wild] = np.inf
        smoother = Smoother(hessian, gradient)
        cost = float(weighted.sum()) + self._priors(smoother, state)
        cost += self._touched(smoother, state)
        return _Linear(smoother, cost, misfit, wild, hessian, along, ends, designs, weights)

    def _touched(self, smoother: Smoother, state: State) -> float:
        """Pull contacts to the surfaces of known objects; return the cost."""
        cost = 0.0
        if not self.objects:
            return cost
        points, slopes, _ = contact_slopes(self.d, state)
        points = self.head.put_in((points + state.position) * self.d.length)
        radius = self.whisker.radius(state.contact[:, 0] * self.d.length)
        for i in np.flatnonzero(self.touching):
            found = [thing.local_geometry(points[i]) for thing in self.objects]
            distance, normal, _ = min(found, key=lambda one: abs(one[0]))
            # A contact far from all objects touches something else.
            gap = (distance - radius[i]) / self.options.surface
            weight = 1.0 / np.sqrt(max(abs(gap) / FAR, 1.0))
            row = (
                normal
                @ self.head.rotation[i]
                @ slopes[i]
                * (weight * self.d.length / self.options.surface)
            )
            cost += smoother.add_row(int(i), row, weight * gap)
        return cost

    def _priors(self, smoother: Smoother, state: State) -> float:
        o = self.options
        slower = (1000.0 / self.rate) ** 2
        turn = self._turned(state)
        place = np.concatenate([state.position, turn, state.contact], axis=1)
        # Second differences of the whole motion, of which the start is a part.
        begun = _turning(self.start.rotation)
        held = np.where(self.touching, 0.0, _HELD)[:, None]
        cost = smoother.add_at(place[:, 6:], held, 6, _REST)
        if len(self.cameras) == 1:
            # One view shows what happens in its plane: no lift, no tilt, no force across it.
            for unknowns in _ACROSS:
                level = np.zeros(unknowns.stop - unknowns.start)
                cost += smoother.add_at(
                    place[:, unknowns], np.array([[_HELD]]), unknowns.start, level
                )
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


def _turning(rotation: Array) -> Array:
    """Rotation vectors (t − 1, 3) from each frame to the next, laboratory axes."""
    step = rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)
    return np.asarray(transform.Rotation.from_matrix(step).as_rotvec())


def _shared(problem: Problem, fit: _Linear) -> Array:
    """Changes (error, time, unknown) due to errors of traces that all frames share, one sigma each.

    Light from the side, a halo of compression or fur over the base shift a trace equally in many
    frames, so neither many points nor many frames average it out: waves along the whisker, a bend
    at its base, and shifts of its ends along it. The part that the fit does not follow remains in
    the means of the residuals over frames with and without contact. The edge of an object displaces
    a trace next to the contact, by as much again as the residuals there.
    """
    pulls = []
    parts = [fit.left(rows) for rows in (problem.touching, ~problem.touching)]
    trusted = problem.variance or [np.ones((1, 3)) for _ in fit.misses]
    together = correlated(
        [m / np.sqrt(v[:, :-2]) for m, v in zip(fit.misses, trusted, strict=True)]
    )
    for view, (design, weight, ends) in enumerate(
        zip(fit.designs, fit.weights, fit.ends, strict=True)
    ):
        n = design.shape[1] - 2
        s = np.linspace(0.0, 1.0, n)
        beyond = s > 2.0 * _AT_BASE
        # Errors common to neighbouring points are as strong in all long waves; the effect of an
        # edge next to the contact is local, and not part of them.
        square = sum(float(np.median(part[view][beyond] ** 2)) for part in parts) / _SQUARE
        sigma = np.sqrt(2.0 * together / n * square)
        waves = [sigma * np.cos(k * np.pi * s) for k in range(_WAVES)]
        waves.append(_lit(problem, view) * (1.0 - s))
        waves.append(_FOLLOWED * _drawn(fit)[view] * np.exp(-s / _AT_BASE))
        across = design[:, :-2] * weight[:, :-2, None]
        pulls += [np.einsum("tni,n->ti", across, wave) for wave in waves]
        local = np.where(beyond, np.abs(parts[0][view]), 0.0)
        pulls.append(np.einsum("tni,n->ti", across, local) * problem.touching[:, None])
        for end, more in enumerate(_ENDS):
            miss = ends[weight[:, end - 2] > 0.0, end]
            size = np.hypot(miss.mean(), more * miss.std()) if miss.size else 0.0
            pulls.append(design[:, end - 2] * size)
    return fit.smoother.responses(np.array(pulls))


def _lit(problem: Problem, view: int) -> float:
    """Root mean square shift of a view's traces at the base due to light from the side, pixels.

    Such light makes the profile of a whisker skew. The measured skewness, with its uncertainty, is
    combined with a prior.
    """
    skew = problem.traces.skew[:, view]
    skew = skew[np.isfinite(skew)]
    if not skew.size:
        return _LIT
    usual = float(np.median(skew))
    sigma = _MEDIAN * float(np.median(np.abs(skew - usual))) / np.sqrt(len(skew))
    at_base, nearer = problem.whisker.radius(problem.whisker.length * np.array([0.0, _NEARER]))
    scale = _scales(problem)[view]
    size = float(at_base * nearer**-3.0) * _SHIFTED / scale**2
    known = _LIT**2 / (_LIT**2 + (size * sigma) ** 2)
    lit = float(np.hypot(known * size * usual, np.sqrt(known) * size * sigma))
    return float(np.hypot(min(lit, _MOST_LIT * float(at_base) * scale), _UNSEEN))


def _scales(problem: Problem) -> list[float]:
    """Pixels per metre at the base in each view."""
    base = problem.head.put_in(problem.start.position * problem.d.length)
    slopes = (camera.project_with_slopes(base)[1] for camera in problem.cameras)
    return [float(np.linalg.norm(slope, axis=1).max()) for slope in slopes]


def _drawn(fit: _Linear) -> list[float]:
    """Largest residual of each view at the base that all frames share, pixels."""
    return [
        float(np.abs(left[: round(2.0 * _AT_BASE * len(left))]).max())
        for left in fit.left(np.ones(len(fit.misfit), dtype=bool))
    ]


def _frame_errors(problem: Problem, fit: _Linear) -> Array:
    """Shifts and turns (2, 2, 3) of the whisker's frame, in its axes, due to its shape at the base.

    The shape follows the traces there, and the rod the shape: errors of the base, of its tangent
    (the x axis), and of the plane of the proximal part (from which the roll follows) leave only a
    part of themselves as residuals.
    """
    whisker = problem.whisker
    scales = np.array(_scales(problem))
    drawn = np.array(_drawn(fit))
    aside = _FOLLOWED * float((drawn / scales).max())
    hook = float((np.hypot(_HOOKED, _HOOK * drawn) / scales).max())
    lean = hook / (_AT_BASE * whisker.length)
    share = np.linspace(0.0, _PROXIMAL, fit.misses[0].shape[1])
    x, y, _ = whisker.position(share * whisker.length).T
    roll = min(lean * abs(x @ y) / max(y @ y, lean**2 * (x @ x)), 1.0)
    return np.array([[[0.0, aside, 0.0], [0.0, 0.0, lean]], [[0.0, 0.0, aside], [roll, lean, 0.0]]])


def _contacts(problem: Problem, state: State) -> tuple[Array, Array]:
    """Contact points (t, 3), m, and force and moment (t, 6), whisker's frame."""
    values, _ = solve_forces(problem.d, state.contact)
    force, point = values[:, :3], values[:, 3:]
    moment = np.cross(point, force) * problem.d.moment
    return point * problem.d.length, np.concatenate([force * problem.d.force, moment], axis=1)


def _by_length(
    problem: Problem, state: State, unsure: float, by_contact: Array, slope: Array
) -> tuple[Array, Array]:
    """Shared changes (k, t, 15) for a longer or shorter whisker, and of the wrench (k, t, 6).

    A longer one is thicker, as it tapers over a longer distance: this is the whole effect of a
    longer tip on a contact proximal to it. The inverse length, which is what bending shows, changes
    by a standard deviation; if that is large, to either side, each for half of the variance.
    """
    whisker, length = problem.whisker, problem.whisker.length
    point, wrench = _contacts(problem, state)
    # Back to the same contact point, without additional friction.
    back = by_contact[..., _FREE] @ np.linalg.pinv(slope[:, 3:, _FREE] * length)
    changes, wrenches = [], []
    signs = (1.0, -1.0) if unsure > _LINEAR * length else (1.0,)
    for sign in signs:
        share = 1.0 - sign * min(unsure / length, _MOST_UNSURE)
        other = whisker.with_properties(radius=partial(_tapered, whisker, share))
        altered = replace(problem, whisker=other, d=discretize(other), begun=state)
        after = altered.solved()[0]
        moved, changed = _contacts(altered, after)
        turn = transform.Rotation.from_matrix(
            after.rotation @ np.swapaxes(state.rotation, 1, 2)
        ).as_rotvec()
        shift = (after.position - state.position) * length
        contact = np.einsum("tij,tj->ti", after.rotation, moved) + shift
        contact -= np.einsum("tij,tj->ti", state.rotation, point)
        moved_by, alike = _contacts(altered, state)
        same = alike - wrench - np.einsum("tij,tj->ti", back, moved_by - point)
        changes.append(np.concatenate([contact, shift, turn, same], axis=1))
        wrenches.append(changed - wrench)
    return np.array(changes) / np.sqrt(len(signs)), np.array(wrenches) / np.sqrt(len(signs))


def _tapered(whisker: Whisker, share: float, s: Array) -> Array:
    """Radius of a whisker that reaches its tip where only a share of the length is left."""
    return whisker.radius(np.minimum(share * s, whisker.length))


def _by_bend(problem: Problem, state: State, length: Length, spread: Array) -> Array:
    """Shared changes (3, t, 15) of contacts beyond what all views show of the whisker.

    Its shape at rest is extrapolated to there, and to where they may be by their covariance.
    """
    beyond = np.maximum(state.contact[:, 0] * problem.d.length - length.shown, 0.0)
    # The fourth power of a distance with an error is on average nearly this one's.
    farther = np.where(beyond > 0.0, 3.0 * np.trace(spread, axis1=1, axis2=2), 0.0)
    changes = np.zeros((3, len(beyond), 15))
    vectors = length.bending @ problem.whisker.pose.rotation
    changes[..., :3] = np.einsum("tij,kj->kti", state.rotation, vectors)
    return changes * length.astray(np.sqrt(beyond**2 + farther))[:, None]


def _off_tangent(line: Array, share: Array, spread: Array) -> Array:
    """Second moments (t, 3, 3) of how far contacts that slide along a bent line leave its tangent.

    Covariances are those of points on the tangent. At the contact, lines bend as at rest.
    """
    n = line.shape[1]
    step = max(1, round(_CURVED * n))
    middle = np.clip(np.rint(share * (n - 1)).astype(int), step, n - 1 - step)
    before, here, after = (line[np.arange(len(line)), middle + k * step] for k in (-1, 0, 1))
    chord = after - before
    square = (chord**2).sum(axis=1)
    along = np.einsum("ti,tij,tj->t", chord, spread, chord) / square
    aside = 4.0 * (after - 2.0 * here + before) / square[:, None] * (0.5 * along)[:, None]
    # The mean of the fourth power of a normal number is three.
    return np.asarray(3.0 * aside[:, :, None] * aside[:, None])


def _answer(problem: Problem, state: State, fit: _Linear, nodes: int, length: Length) -> RodFit:
    """Results in SI units, relative to the head."""
    d, touching = problem.d, problem.touching
    shared, misfit = _shared(problem, fit), fit.misfit
    covariance = fit.smoother.covariances() + np.einsum("kti,ktj->tij", shared, shared)
    turned, slopes, slope = contact_slopes(d, state)
    point, wrench = _contacts(problem, state)
    force = wrench[:, :3] / d.force
    moment_slope = np.cross(slope[:, 3:], force[:, :, None], axis=1)
    moment_slope += np.cross(point[:, :, None] / d.length, slope[:, :3], axis=1)
    by_contact = np.concatenate([slope[:, :3] * d.force, moment_slope * d.moment], axis=1)
    inside = covariance[:, 6:, 6:]
    size = np.repeat([d.length, 1.0], 3)
    held = covariance[:, :6, :6] * np.outer(size, size)
    both = covariance[:, :6, 6:] * size[:, None] @ np.swapaxes(by_contact, 1, 2)
    none = np.where(touching, 1.0, np.nan)[:, None, None]
    moved = np.einsum("tij,ktj->tki", slopes, shared) * d.length
    moved = np.concatenate([moved, shared.swapaxes(0, 1)[..., :6] * size], axis=2)
    moved = np.pad(moved, ((0, 0), (0, 0), (0, 6)))
    # An error of the whisker's frame turns force and moment in it in the opposite sense.
    errors = _frame_errors(problem, fit)
    framed = np.einsum("tij,kpj->tkpi", state.rotation, errors).reshape(-1, 2, 6)
    framed = np.pad(framed, ((0, 0), (0, 0), (3, 6)))
    against = [np.cross(part[:, None], errors[:, 1]) for part in (wrench[:, :3], wrench[:, 3:])]
    aside = np.concatenate(against, axis=2)
    if length.sigma > 0.0:
        by_length, changed = _by_length(problem, state, length.sigma, by_contact, slope)
        framed = np.append(framed, np.moveaxis(by_length, 0, 1), axis=1)
        aside = np.append(aside, np.moveaxis(changed, 0, 1), axis=1)
    spread = slopes @ covariance @ np.swapaxes(slopes, 1, 2) * d.length**2
    spread += np.einsum("tki,tkj->tij", framed[..., :3], framed[..., :3])
    if length.shown < length.value:
        by_bend = np.moveaxis(_by_bend(problem, state, length, spread), 0, 1)
        spread += np.einsum("tki,tkj->tij", by_bend[..., :3], by_bend[..., :3])
        framed = np.append(framed, by_bend, axis=1)
        aside = np.append(aside, by_bend[..., 9:], axis=1)
    held = held + np.einsum("tki,tkj->tij", framed[..., 3:9], framed[..., 3:9])
    both = both + np.einsum("tki,tkj->tij", framed[..., 3:9], aside)
    wrench_spread = by_contact @ inside @ np.swapaxes(by_contact, 1, 2)
    wrench_spread += np.einsum("tki,tkj->tij", aside, aside)
    line = rods(d, state.contact, np.linspace(0.0, 1.0, nodes))
    line = np.einsum("tij,tnj->tni", state.rotation, line) + state.position[:, None]
    spread += _off_tangent(line * d.length, state.contact[:, 0], spread)
    shared = np.concatenate([moved, framed], axis=1)
    shared[..., [0, 1, 2, *range(9, 15)]] *= none
    return RodFit(
        rotation=state.rotation,
        position=state.position * d.length,
        arc_length=state.contact[:, 0] * d.length * none[:, 0, 0],
        contact_point_whisker=point * none[:, 0],
        contact_point=(turned + state.position) * d.length * none[:, 0],
        contact_covariance=spread * none,
        shared=shared,
        force=wrench[:, :3] * touching[:, None],
        moment=wrench[:, 3:] * touching[:, None],
        wrench_covariance=wrench_spread * touching[:, None, None],
        pose_covariance=held,
        pose_wrench_covariance=both * touching[:, None, None],
        centerline=line * d.length,
        misfit=misfit,
    )


def _in_laboratory(found: RodFit, head: HeadPose) -> RodFit:
    """Transform poses and points from the head's frame to the laboratory's."""
    turn = head.rotation
    both = np.zeros((len(turn), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = turn
    parts = found.shared[..., :9].reshape(*found.shared.shape[:2], 3, 3)
    moved = np.einsum("tij,tevj->tevi", turn, parts).reshape(*found.shared.shape[:2], 9)
    return replace(
        found,
        rotation=turn @ found.rotation,
        position=head.put_in(found.position),
        contact_point=head.put_in(found.contact_point),
        contact_covariance=turn @ found.contact_covariance @ np.swapaxes(turn, 1, 2),
        shared=np.concatenate([moved, found.shared[..., 9:]], axis=2),
        pose_covariance=both @ found.pose_covariance @ np.swapaxes(both, 1, 2),
        pose_wrench_covariance=both @ found.pose_wrench_covariance,
        centerline=head.put_in(found.centerline),
    )


def _whole(found: RodFit, frames: NDArray[np.intp], count: int) -> RodFit:
    """Results for all frames; NaN in those that were not fitted."""
    whole = {}
    for name in (each.name for each in fields(found)):
        values = getattr(found, name)
        whole[name] = np.full((count, *values.shape[1:]), np.nan)
        whole[name][frames] = values
    return RodFit(**whole)
