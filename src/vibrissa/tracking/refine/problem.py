"""Equations of the fit of a rod to the traces: residuals, priors, and their least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface
from vibrissa.rod import Discretization
from vibrissa.tracking.refine.least_squares import Smoother, trace_variance
from vibrissa.tracking.refine.rods import (
    FAR,
    UNKNOWNS,
    Bent,
    State,
    TraceSeries,
    contact_slopes,
    placed,
    turns,
)
from vibrissa.tracking.space.pose import HeadPose
from vibrissa.whisker import Whisker

# Levenberg's damping: initial, smallest, and that at which the fit ends.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-8, 1e6
_SMALL = 2e-5  # relative decrease of the cost for another iteration
_HELD = 1e8  # weight with which frames without contact keep the contact at rest
# Unknowns across the plane z = 0: a shift, turns about two axes; the force across it.
_ACROSS = (slice(2, 5), slice(9, 10))
# Contact of a free frame: no force, half-way along the whisker.
REST = np.array([0.5, 0.0, 0.0, 0.0])
# Standard deviation of the force along the whisker if there is none across, in units of EI/L².
_RUBBING = 1e-4
_ROLLED = np.radians(3.0)  # standard deviation of the roll before its variation is known, rad
_ELSE = 3.0  # misfit, over the usual one, from which the traces of a frame are on something else
_HOLD = 1e5  # inverse standard deviation of an arc length that is held, in units of L
_ALONG = np.eye(UNKNOWNS)[6]  # the arc length among the unknowns
# Error of a trace, as a share of the second difference of its positions, if the exposure may be any
# part of a frame: an eighth if it is all, and the speed changes in the middle.
_EXPOSED = 0.05
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
    rounds: int = 20  # largest number of Gauss–Newton steps


@dataclass(frozen=True, eq=False)
class Compared:
    """Rods compared with the traces of their frames: normal equations, and their ingredients."""

    hessian: Array
    gradient: Array
    squares: Array  # (time,): sums of squared residuals
    misfit: Array
    wild: Mask
    misses: list[Array]
    ends: list[Array]
    designs: list[Array]
    weights: list[Array]

    def put(self, rows: Mask, other: Compared) -> Compared:
        """The same with some frames of another state."""

        def chosen(own: Any, new: Any) -> Any:
            if isinstance(own, list):
                return [chosen(*each) for each in zip(own, new, strict=True)]
            return np.where(rows.reshape(-1, *[1] * (own.ndim - 1)), new, own)

        names = [each.name for each in fields(Compared)]
        return Compared(*(chosen(getattr(self, name), getattr(other, name)) for name in names))


class Linear(NamedTuple):
    """Normal equations at a state."""

    smoother: Smoother
    costs: Array  # (time,)
    data: Compared

    @property
    def cost(self) -> float:
        """Cost of all frames."""
        return float(self.costs.sum())

    def left(self, rows: Mask) -> list[Array]:
        """Means over some frames of the residuals of each view, pixels.

        Frames that fit far worse than usual are on something else, and left out.
        """
        rows = rows & (self.data.misfit < _ELSE * np.median(self.data.misfit))
        found = []
        for misses, weight in zip(self.data.misses, self.data.weights, strict=True):
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
    held: Sequence[tuple[int, float]] = ()  # rows whose contact's arc length is held, and that
    enough: float = 0.0  # expected decrease of the cost below which a step is the last

    def rows(self, rows: NDArray[np.intp], begun: State) -> Problem:
        """The problem restricted to some frames, which begins there."""
        return replace(
            self,
            traces=self.traces.rows(rows),
            touching=self.touching[rows],
            frames=self.frames[rows],
            start=self.start.rows(rows),
            head=self.head.rows(rows),
            begun=begun.rows(rows),
            variance=self.variance and [each[rows] for each in self.variance],
        )

    def trusted(self, even: bool = False) -> tuple[Problem, State, Linear]:
        """The problem with traces weighted by their residuals, and its solution."""
        loose = replace(self.options, roll=max(self.options.roll, _ROLLED))
        state, fit = replace(self, options=loose).solved()
        covariance = fit.smoother.covariances()
        designs = [design[:, :-2] for design in fit.data.designs]
        variance = trace_variance(
            fit.data.misses, designs, covariance, self.options.sharpest**2, even
        )
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
        return turns(state.rotation @ np.swapaxes(self.start.rotation, 1, 2))

    @cached_property
    def _turning(self) -> Array:
        """Rotation vectors (t − 1, 3) of the start from each frame to the next, laboratory axes."""
        return turns(self.start.rotation[1:] @ np.swapaxes(self.start.rotation[:-1], 1, 2))

    def solved(self) -> tuple[State, Linear]:
        """Gauss-Newton iteration with Levenberg's damping, by frame."""
        state, damping = self.begun or self.start, np.full(len(self.frames), _DAMPING)
        fit = self.linear(state)
        for _ in range(_HALVED):
            if not fit.data.wild.any():
                break
            # A force that another rod withstands may exceed the limit of this one.
            factor = np.where(fit.data.wild[:, None], [1.0, 0.5, 0.5, 0.5], 1.0)
            state = replace(state, contact=state.contact * factor)
            fit = self.linear(state)
        for _ in range(self.options.rounds):
            step = fit.smoother.solved(damping)
            trial, decrease = state.moved(step), (fit.smoother.gradient * step).sum(axis=1)
            if decrease.sum() < self.enough:
                return trial, fit._replace(costs=fit.costs - decrease)
            tried = self.linear(trial)
            worse = tried.data.squares > fit.data.squares
            if not tried.cost < fit.cost:
                # Frames depend little on each other: those that become worse stay as they are.
                rows = np.flatnonzero(worse)
                trial = trial.put(rows, state.rows(rows))
                tried = self._linear(trial, tried.data.put(worse, fit.data))
            if tried.cost < fit.cost:
                small = fit.cost - tried.cost < _SMALL * fit.cost
                state, fit = trial, tried
                damping = np.where(worse, 10.0 * damping, np.maximum(damping / 5.0, _LEAST_DAMPING))
                if small:
                    break
            else:
                damping = 10.0 * damping
                if damping.min() > _MOST_DAMPING:
                    break
        return state, fit

    def linear(self, state: State) -> Linear:
        """Linearise at a state."""
        return self._linear(state, self._compared(state))

    def _linear(self, state: State, data: Compared) -> Linear:
        """Linearise at a state whose rods were compared with the traces."""
        smoother = Smoother(data.hessian, data.gradient)
        costs = data.squares + self._priors(smoother, state) + self._touched(smoother, state)
        for i, arc in self.held:
            smoother.add_row(i, _HOLD * _ALONG, _HOLD * (state.contact[i, 0] - arc))
        return Linear(smoother, costs, data)

    def _compared(self, state: State) -> Compared:
        """Compare with the traces; rods without equilibrium are infinitely far away."""
        rods = Bent.of(self.d, state, self.touching, self.shown)
        wild = rods.wild
        rods.turned[wild], rods.change[:, rods.rows[wild & self.touching]] = 0.0, 0.0
        points = self.head.put_in((rods.turned + state.position[:, None]) * self.d.length)
        hessian = np.zeros((len(points), UNKNOWNS, UNKNOWNS))
        gradient = np.zeros((len(points), UNKNOWNS))
        total, count, weighted = np.zeros((3, len(points)))
        along, ends, designs, weights = [], [], [], []
        for view, camera in enumerate(self.cameras):
            pixels, by_point = camera.project_with_slopes(points)
            rows, misses, sharp = self.traces.equations(view, pixels, by_point * self.d.length)
            rows[wild] = 0.0
            weight = np.ones(misses.shape) if self.variance is None else 1.0 / self.variance[view]
            trusted = rods.normal(self.head.rotation, rows, misses, weight, hessian, gradient)
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
        return Compared(hessian, gradient, weighted, misfit, wild, along, ends, designs, weights)

    def blurred(self, state: State, fit: Linear, covariance: Array) -> Array:
        """Steps (time, unknown) due to motion that is uneven while a frame is exposed.

        An image shows the mean over the exposure, which is not where the whisker is in the middle
        of it when it hits an object or slips off: then it errs by a share of the second difference
        of its positions.
        """
        points = self.head.put_in(placed(self.d, state, self.shown) * self.d.length)
        even = np.diff(self.frames) == 1
        uneven = np.zeros_like(points)
        middle = np.flatnonzero(even[1:] & even[:-1]) + 1
        uneven[middle] = points[middle - 1] - 2.0 * points[middle] + points[middle + 1]
        pull = np.zeros((len(points), UNKNOWNS))
        for view, (camera, design) in enumerate(zip(self.cameras, fit.data.designs, strict=True)):
            pixels, slopes = camera.project_with_slopes(points)
            moved = camera.project(points + _EXPOSED * uneven)
            misses = [self.traces.equations(view, at, slopes)[1][:, :-2] for at in (pixels, moved)]
            shift = np.where((misses[0] == 0.0) | (misses[1] == 0.0), 0.0, misses[0] - misses[1])
            pull += np.einsum("tni,tn->ti", design[:, :-2], shift)
        return np.asarray(np.einsum("tij,tj->ti", covariance, pull))

    def _touched(self, smoother: Smoother, state: State) -> Array:
        """Pull contacts to the surfaces of known objects; return the costs."""
        costs = np.zeros(len(self.frames))
        if not self.objects:
            return costs
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
            costs[i] = smoother.add_row(int(i), row, weight * gap)
        return costs

    def _priors(self, smoother: Smoother, state: State) -> Array:
        o = self.options
        slower = (1000.0 / self.rate) ** 2
        turn = self._turned(state)
        place = np.concatenate([state.position, turn, state.contact], axis=1)
        held = np.where(self.touching, 0.0, _HELD)[:, None]
        costs = smoother.add_at(place[:, 6:], held, 6, REST)
        if len(self.cameras) == 1:
            # One view shows what happens in its plane: no lift, no tilt, no force across it.
            for unknowns in _ACROSS:
                level = np.zeros(unknowns.stop - unknowns.start)
                costs += smoother.add_at(
                    place[:, unknowns], np.array([[_HELD]]), unknowns.start, level
                )
        across = np.linalg.norm(state.contact[:, 2:], axis=1)
        rubbing = 1.0 / (o.friction * across + _RUBBING) ** 2
        costs += smoother.add_at(place[:, 7:8], rubbing[:, None], 7, np.zeros(1))
        axis = state.rotation[:, :, 0]
        rolled = (turn * axis).sum(axis=1)
        costs += smoother.add_along(axis, rolled, 3, 1.0 / o.roll)
        together = np.diff(self.frames) == 1
        pose = (1.0 / (o.moving / self.d.length), 1.0 / o.turning)
        contact = (1.0 / (o.sliding / self.d.length), *[1.0 / o.pressing] * 3)
        weight = np.array([pose[0]] * 3 + [pose[1]] * 3 + list(contact)) / slower
        at = np.flatnonzero(together[1:] & together[:-1]) + 1
        second = place[at - 1] - 2.0 * place[at] + place[at + 1]
        # Second differences of the whole motion, of which the start is a part.
        second[:, 3:6] += self._turning[at] - self._turning[at - 1]
        scale = np.tile(weight, (len(at), 1))
        scale[~(self.touching[at - 1] & self.touching[at] & self.touching[at + 1]), 6:] = 0.0
        costs[at] += smoother.add_second(at, second, scale)
        return costs
