"""Fit of the rod to the traces: contact and wrench over a whole trial, from the whisker's shape.

Per frame the unknowns are position and orientation of the base (six numbers) and, in contact, arc
length and force of the contact (s_c, f_x, f_y, f_z); they determine the bent rod exactly. Its
images in all views are fitted to the traces by least squares over all frames at once: the base
moves smoothly from frame to frame, and so does the contact while it lasts. Friction, the force
along the whisker, changes its shape; it is only restrained from being much larger than the force
across. The fit thus finds the contact even where it is hidden, and force and moment at the base,
with their covariance.

A whisker that is bent behind an object, or by little, looks nearly the same for contacts along
millimetres of it: the cost is flat there, or has several minima, and its curvature at one of them
does not show how uncertain the contact is. While a contact lasts, its arc lengths are tied
together, so what is uncertain is one number: the arc length s at one frame of the contact, the one
at which it is best known. The profile

    c(s) = min over all other unknowns of the cost, at this arc length,

is computed at steps to both sides of its minimum; the posterior of s is exp(−c/2). With x_i(s) the
unknowns of frame i at that minimum, the covariance of the frame is

    C_i = C_i|s + ∫ (x_i(s) − x_i)(x_i(s) − x_i)ᵀ exp(−c/2) ds / ∫ exp(−c/2) ds,

where C_i|s, that for a known s, is taken from the linearised equations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.deferred import interpolate, ndimage
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface
from vibrissa.rod import discretize, solve_forces
from vibrissa.tracking.refine.hook import Hook
from vibrissa.tracking.refine.inertia import Inertia
from vibrissa.tracking.refine.peg import UncertainPeg
from vibrissa.tracking.refine.problem import NEARLY, FitOptions, Linear, Problem
from vibrissa.tracking.refine.rods import (
    LIMITS,
    REST,
    Bent,
    State,
    TraceSeries,
    contact_slopes,
    first_contacts,
    rods,
    turns,
)
from vibrissa.tracking.space.pose import BasePose, HeadPose
from vibrissa.tracking.space.rest_shape import Length, turned_change
from vibrissa.tracking.trace.trace import correlated
from vibrissa.whisker import Whisker

# Distance from an object, over the length, within which contacts are on it; and what is not seen of
# the whisker, which it may hide.
_REACH = 0.1
# First step of a profile to each side, in standard deviations of the linearised equations; share by
# which its rise there differs from a parabola's from which it is computed; its steps then.
_FIRST, _ALIKE = 2.0, 0.5
_STEPS = (1.0, 2.0, 3.0, 4.5, 7.0, 11.0, 17.0, 26.0)
_ENOUGH = 12.0  # rise of the cost up to which the profile is computed
_LOWER = 0.5  # decrease of the cost that shows another, lower minimum
_MARGIN = 3  # number of frames before and after a contact that are fitted with it
_ROUNDS = 3  # number of Gauss-Newton steps at each step of a profile
_FINE = 801  # number of values between which the profile is integrated


@dataclass(frozen=True, eq=False)
class _Contact:
    """A contact that lasts, by rows of the problem, and how it responds in linearised equations."""

    rows: NDArray[np.intp]
    best: int  # the row at which its arc length is best known
    response: Array  # (time, unknown), to a pull of that arc length

    @property
    def sigma(self) -> float:
        """Standard deviation of that arc length."""
        return float(np.sqrt(self.response[self.best, 6]))

    @property
    def slope(self) -> Array:
        """Change of all unknowns (time, unknown) with that arc length."""
        return np.asarray(self.response / self.response[self.best, 6])


class _Profile(NamedTuple):
    """Costs of a contact at several of its arc lengths, in ascending order, and its states."""

    arcs: Array
    costs: Array
    states: list[State]

    def spread(self, state: State) -> Array:
        """Second moments (time, unknown, unknown) about a state."""
        steps = np.array([state.step_to(other) for other in self.states])
        fine = np.linspace(self.arcs[0], self.arcs[-1], _FINE)
        rise = interpolate.PchipInterpolator(self.arcs, self.costs - self.costs.min())(fine)
        weight = np.exp(-0.5 * rise)
        share = np.array([np.interp(fine, self.arcs, one) for one in np.eye(len(self.arcs))])
        moments = (share * weight / weight.sum()) @ share.T
        return np.asarray(np.einsum("jl,jti,ltk->tik", moments, steps, steps))


def profiled(problem: Problem, state: State, fit: Linear) -> tuple[State, Linear, Array]:
    """Find the state of least cost, its equations, and covariances (time, unknown, unknown)."""
    for last in (False, True):
        covariance, lower = fit.smoother.covariances(), state
        for contact in _with_margins(problem, fit, covariance):
            profile = _profile(problem, state, contact)
            if profile is None:
                continue
            rows, lowest = contact.rows, int(profile.costs.argmin())
            if profile.costs[lowest] < -_LOWER and not last:
                lower = lower.put(rows, profile.states[lowest])
            linear = contact.response[rows]
            known = linear[:, :, None] * linear[:, None] / contact.sigma**2
            covariance[rows] += profile.spread(state.rows(rows)) - known
        if lower is state:
            break
        state, fit = replace(problem, begun=lower).solved()
    uneven = problem.blurred(state, fit, covariance)
    return state, fit, covariance + uneven[:, :, None] * uneven[:, None]


def _with_margins(problem: Problem, fit: Linear, covariance: Array) -> list[_Contact]:
    """Contacts that last: frames in contact that follow each other."""
    touching = np.flatnonzero(problem.touching)
    if not touching.size:
        return []
    breaks = np.flatnonzero(np.diff(problem.frames[touching]) != 1) + 1
    runs = np.split(touching, breaks)
    best = [int(rows[covariance[rows, 6, 6].argmin()]) for rows in runs]
    pulls = np.zeros((len(runs), *fit.smoother.gradient.shape))
    pulls[np.arange(len(runs)), best, 6] = 1.0
    responses = fit.smoother.alone(pulls)
    return [_Contact(*each) for each in zip(runs, best, responses, strict=True)]


def _profile(problem: Problem, state: State, contact: _Contact) -> _Profile | None:
    """Costs along a contact's arc length, relative to the state's; None if it is a parabola."""
    first, last = contact.rows[0] - _MARGIN, contact.rows[-1] + _MARGIN
    near = np.arange(max(first, 0), min(last + 1, len(problem.frames)))
    short = replace(problem.options, rounds=_ROUNDS)
    part = replace(problem.rows(near, state), fixed=True, options=short, enough=NEARLY)
    row, inside = contact.best - near[0], contact.rows - near[0]
    middle = float(state.contact[contact.best, 0])

    def at(arc: float, before: State) -> tuple[float, State]:
        ahead = contact.slope[near] * (arc - before.contact[row, 0])
        held = replace(part, begun=before.moved(ahead), held=((row, arc),))
        found, fit = held.solved()
        return fit.cost, found

    lowest, begun = at(middle, state.rows(near))
    found = {middle: (lowest, begun)}
    sides = (-contact.sigma, contact.sigma)
    for side in sides:
        arc = float(np.clip(middle + _FIRST * side, *LIMITS))
        found[arc] = at(arc, begun)
    rises = np.array([cost - lowest for cost, _ in found.values()][1:])
    if len(found) == 3 and (np.abs(rises / _FIRST**2 - 1.0) < _ALIKE).all():
        return None
    for side in sides:
        before = begun
        for step in _STEPS:
            arc = float(np.clip(middle + step * side, *LIMITS))
            if arc not in found:
                found[arc] = at(arc, before)
            cost, before = found[arc]
            if cost - lowest > _ENOUGH or arc in LIMITS:
                break
    arcs = sorted(arc for arc, (cost, _) in found.items() if np.isfinite(cost))
    if len(arcs) < 2 or middle not in arcs:
        return None
    costs = np.array([found[arc][0] for arc in arcs]) - lowest
    return _Profile(np.array(arcs), costs, [found[arc][1].rows(inside) for arc in arcs])


_WAVES = 8  # number of waves along the whisker for common errors of a view's traces
# Standard deviation of the shift by light from the side at the base, pixels, less where the whisker
# is thinner, if its profile shows no more; that shift over the profile's third cumulant, in radii,
# for a flank of 0.65 radii that is lit by half; where on the whisker that is taken; and the largest
# shift, in radii, which is that by a flank as bright as the background.
_LIT, _SHIFTED, _NEARER, _MOST_LIT = 0.1, 3.2, 0.25, 0.5
# Shift by a halo over the cube root of the third cumulant, for one a third as bright as the whisker
# is dark; and number of standard deviations by which a cumulant must exceed that of a lit flank.
_HALO, _SURE = 0.25, 3.0
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
# Change of the inverse length, as a share, up to which its effects are linear, and the largest.
_LINEAR, _MOST_UNSURE = 0.04, 0.6
# Force, over the usual one, from which its direction shows the normal; and standard deviation of
# contacts along the whisker, over its length, by a taper that is only assumed.
_STRONG, _UNSURE = 0.3, 0.03


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

    def swung(self, inertia: Inertia, length: float) -> RodFit:
        """The fit with contacts and shapes where inertia has them; loads are those of contact."""
        nodes = np.linspace(0.0, 1.0, self.centerline.shape[1])
        moved = [inertia.at(np.full(len(self.misfit), share))[0] for share in nodes]
        aside, _ = inertia.at(self.arc_length / length)
        turned = np.einsum("tji,tj->ti", self.rotation, aside)
        return replace(
            self,
            contact_point=self.contact_point + aside,
            contact_point_whisker=self.contact_point_whisker + turned,
            contact_covariance=self.contact_covariance + inertia.spread(aside),
            centerline=self.centerline + np.stack(moved, axis=1),
        )


class Touches(NamedTuple):
    """Contacts (n, 3), m, with unit normals of what is touched and unit tangents of the whisker."""

    points: Array
    normals: Array
    tangents: Array
    radius: Array  # (n,) of the whisker, m
    sigma: float  # standard deviation of points along the whisker, m


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
    peg: UncertainPeg | None = None
    # (time,) Standard deviation of the logarithm of the curvature that one view shows.
    unsure: Array | None = None
    hook: Hook | None = None  # at the base, which is not on the whisker
    inertia: Inertia | None = None  # that traces and curves are without
    displaced: Callable[[Array], Array] | None = None  # `Problem.displaced`

    def fit(
        self, whisker: Whisker, pose: BasePose, nodes: int, length: Length | None = None
    ) -> tuple[RodFit, UncertainPeg | None]:
        """Fit a whisker of approximate pose, whose length may be uncertain, and the peg."""
        problem, state, linear = self._problem(whisker, pose).trusted()
        state, linear, spread = profiled(problem, state, linear)
        length = length or Length(whisker.length, 0.0)
        unsure = np.zeros(0) if self.unsure is None else self.unsure[problem.frames]
        found = _answer(problem, state, linear, spread, nodes, length, unsure, self.hook)
        whole = _whole(_in_laboratory(found, problem.head), problem.frames, len(self.curves))
        if self.peg is None or not linear.smoother.crossed.any():
            return whole, None
        return whole, UncertainPeg(self.peg.at(state.peg), linear.smoother.shared_covariance)

    def touches(self, whisker: Whisker, pose: BasePose) -> tuple[Touches, Array]:
        """Contacts, laboratory frame, and misfits (time,) of a whisker of approximate pose."""
        posed = np.isfinite(pose.rotation).all(axis=(1, 2))
        near = ndimage.binary_dilation(self.touching & posed, iterations=_MARGIN)
        near |= not near.any()
        curves = np.where(near[:, None, None], self.curves, np.nan)
        problem, state, linear = replace(self, curves=curves)._problem(whisker, pose).trusted()
        misfit = np.full(len(self.curves), np.nan)
        misfit[problem.frames] = linear.data.misfit
        point, wrench = _contacts(problem, state)
        force = np.einsum("tij,tj->ti", state.rotation, wrench[:, :3])
        size = np.linalg.norm(force, axis=1)
        rows = problem.touching & ~linear.data.wild & (size > 0.0)
        if rows.any():
            rows &= size > _STRONG * np.median(size[rows])
        tangent = Bent.of(problem.d, state, problem.touching).tangents(state.contact[:, 0])[0]
        normal = force - (force * tangent).sum(axis=1, keepdims=True) * tangent
        turn, length = problem.head.rotation, whisker.length
        point = np.einsum("tij,tj->ti", state.rotation, point) / length
        at, _ = problem.put_in(point, state, np.arange(len(point)))
        along = np.sqrt(np.median(linear.smoother.covariances()[rows, 6, 6])) if rows.any() else 0.0
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        found = Touches(
            at[rows],
            np.einsum("tij,tj->ti", turn, normal)[rows],
            np.einsum("tij,tj->ti", turn, tangent)[rows],
            whisker.radius(state.contact[rows, 0] * length),
            float(np.hypot(along, _UNSURE) * length),
        )
        return found, misfit

    def misfits(self, whisker: Whisker, pose: BasePose) -> Array:
        """Misfits of a rod (time,), in stated deviations; infinite where there are no traces."""
        problem = self._problem(whisker, pose)
        found = np.full(len(self.curves), np.inf)
        if len(problem.frames):
            _, linear = problem.solved()
            found[problem.frames] = np.where(linear.data.wild, np.inf, linear.data.misfit)
        return found

    def excess(self, whisker: Whisker, pose: BasePose) -> Array:
        """Costs (n,) of frames with contacts on the peg, over those with the same rod anywhere.

        The traces are as uncertain as those show that are fitted without the peg.
        """
        problem, state, _ = self._problem(whisker, pose).trusted()
        free, _, anywhere = replace(problem, peg=None, begun=state, variance=None).trusted()
        _, on = replace(free, peg=problem.peg, begun=state).solved()
        right = ~(anywhere.data.wild | on.data.wild) & problem.touching & problem.near
        return on.costs[right] - anywhere.costs[right]

    def costs(
        self, shown: float, ends: tuple[float, float] = (1.0, 0.0)
    ) -> Callable[[Whisker, BasePose], float]:
        """Function that compares whiskers by how well they explain the traces.

        Whiskers of all lengths are compared with the same part of the traces, up to the arc length
        ``shown``, m: a longer one would also have to explain the uncertain ends of longer traces.
        Those of equal length are also compared with these, which count by ``ends``.
        """
        before: tuple[Problem, State] | None = None
        traces = replace(self.traces, ends=self.traces.ends * ends)

        def cost(whisker: Whisker, pose: BasePose) -> float:
            nonlocal before
            share = min(shown / whisker.length, 1.0)
            begun = before and before[1].scaled(before[0].d.length / whisker.length)
            problem = replace(self, traces=traces)._problem(whisker, pose, begun)
            problem = replace(problem, shown=share, enough=NEARLY)
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
        near, arcs = self._nearest(frames)
        start = State(
            pose.rotation[frames], pose.position[frames] / d.length, np.zeros((len(frames), 4))
        )
        start.contact[:, 0] = REST[0]
        if begun is None:
            start.contact[touching] = first_contacts(d, start, self.curves[frames], touching)
            rows = near & touching
            moved = np.clip(arcs[rows] / d.length, *LIMITS)
            # The same bend at the base, approximately.
            start.contact[rows, 1:] *= ((start.contact[rows, 0] / moved) ** 2)[:, None]
            start.contact[rows, 0] = moved
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
            self.peg,
            near,
            begun,
            inertia=self.inertia and self.inertia.rows(frames),
            displaced=self.displaced,
        )

    def _nearest(self, frames: NDArray[np.intp]) -> tuple[Mask, Array]:
        """Frames in which the whisker, as seen, is next to a known object, and arc lengths, m."""
        things = self.objects if self.peg is None else [self.peg.expected]
        if not things:
            return np.zeros(len(frames), dtype=bool), np.zeros(len(frames))
        curves = self.head.rows(frames).put_in(self.curves[frames])
        away = np.min([thing.signed_distance(curves) for thing in things], axis=0)
        at = away.argmin(axis=1)
        steps = np.linalg.norm(np.diff(curves, axis=1), axis=2)
        arcs = np.pad(np.cumsum(steps, axis=1), ((0, 0), (1, 0)))
        whole = arcs[:, -1].max()
        near = away.min(axis=1) < _REACH * whole + whole - arcs[:, -1]
        return near, arcs[np.arange(len(at)), at]


def _shared(problem: Problem, state: State, fit: Linear, unsure: Array) -> Array:
    """Changes (error, time, unknown) due to errors of traces that all frames share, one sigma each.

    Light from the side, a halo of compression or fur over the base shift a trace equally in many
    frames, so neither many points nor many frames average it out: waves along the whisker, a bend
    at its base, and shifts of its ends along it. The part that the fit does not follow remains in
    the means of the residuals over frames with and without contact. The edge of an object displaces
    a trace next to the contact, by as much again as the residuals there.
    """
    pulls = problem.deformed(state, fit)
    parts = [fit.left(rows) for rows in (problem.touching, ~problem.touching)]
    trusted = problem.variance or [np.ones((1, 3)) for _ in fit.data.misses]
    together = correlated(
        [m / np.sqrt(v[:, :-2]) for m, v in zip(fit.data.misses, trusted, strict=True)]
    )
    for view, (design, weight, ends) in enumerate(
        zip(fit.data.designs, fit.data.weights, fit.data.ends, strict=True)
    ):
        n = design.shape[1] - 2
        s = np.linspace(0.0, 1.0, n)
        beyond = s > 2.0 * _AT_BASE
        # Errors common to neighbouring points are as strong in all long waves; the effect of an
        # edge next to the contact is local, and not part of them.
        square = sum(float(np.median(part[view][beyond] ** 2)) for part in parts) / _SQUARE
        sigma = np.sqrt(2.0 * together / n * square)
        waves = [sigma * np.cos(k * np.pi * s) for k in range(_WAVES)]
        lit, halo = _lit(problem, view)
        waves += [lit * (1.0 - s), np.full(n, halo)]
        waves.append(_FOLLOWED * _drawn(fit)[view] * np.exp(-s / _AT_BASE))
        across = design[:, :-2] * weight[:, :-2, None]
        pulls += [np.einsum("tni,n->ti", across, wave) for wave in waves]
        local = np.where(beyond, np.abs(parts[0][view]), 0.0)
        pulls.append(np.einsum("tni,n->ti", across, local) * problem.touching[:, None])
        for end, more in enumerate(_ENDS):
            miss = ends[weight[:, end - 2] > 0.0, end]
            size = np.hypot(miss.mean(), more * miss.std()) if miss.size else 0.0
            pulls.append(design[:, end - 2] * size)
    if unsure.any():
        # A whisker that one view shows more or less bent, as it leaves the plane of the image.
        points = problem.whisker.position(s * problem.whisker.length)
        curved = turned_change(points)[:, 1] * _scales(problem)[0]
        pulls.append(np.einsum("tni,n,t->ti", across, curved, unsure * problem.touching))
    return np.concatenate([fit.smoother.responses(np.array(pulls)), fit.smoother.by_shared()])


def _lit(problem: Problem, view: int) -> tuple[float, float]:
    """Root mean square shifts of a view's traces due to light from the side, pixels.

    Such light makes the profile of a whisker skew. On the whisker itself it shifts the trace at the
    base, and less where the whisker is thinner; the measured skewness, with its uncertainty, is
    combined with a prior. A bright halo next to the whisker, as wide as the blur of the image,
    shifts all of the trace; profiles that are more skew than any flank makes them show it.
    """
    skew = problem.traces.skew[:, view]
    skew = skew[np.isfinite(skew)]
    if not skew.size:
        return _LIT, 0.0
    usual = float(np.median(skew))
    sigma = _MEDIAN * float(np.median(np.abs(skew - usual))) / np.sqrt(len(skew))
    at_base, nearer = problem.whisker.radius(problem.whisker.length * np.array([0.0, _NEARER]))
    scale = _scales(problem)[view]
    size = float(at_base * nearer**-3.0) * _SHIFTED / scale**2
    known = _LIT**2 / (_LIT**2 + (size * sigma) ** 2)
    lit = float(np.hypot(known * size * usual, np.sqrt(known) * size * sigma))
    most = _MOST_LIT * float(at_base) * scale
    beyond = max(abs(usual) - _SURE * sigma - most / size, 0.0)
    return float(np.hypot(min(lit, most), _UNSEEN)), float(_HALO * np.cbrt(beyond))


def _scales(problem: Problem) -> list[float]:
    """Pixels per metre at the base in each view."""
    base = problem.head.put_in(problem.start.position * problem.d.length)
    slopes = (camera.project_with_slopes(base)[1] for camera in problem.cameras)
    return [float(np.linalg.norm(slope, axis=1).max()) for slope in slopes]


def _drawn(fit: Linear) -> list[float]:
    """Largest residual of each view at the base that all frames share, pixels."""
    return [
        float(np.abs(left[: round(2.0 * _AT_BASE * len(left))]).max())
        for left in fit.left(np.ones(len(fit.data.misfit), dtype=bool))
    ]


def _frame_errors(problem: Problem, fit: Linear, bent: Hook | None) -> Array:
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
    if bent is not None:
        aside, lean = float(np.hypot(aside, bent.sigma)), float(np.hypot(lean, bent.lean))
    share = np.linspace(0.0, _PROXIMAL, fit.data.misses[0].shape[1])
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
        altered = replace(problem, whisker=other, d=discretize(other), begun=state, enough=NEARLY)
        after = altered.solved()[0]
        moved, changed = _contacts(altered, after)
        turn = turns(after.rotation @ np.swapaxes(state.rotation, 1, 2))
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
    """Shared changes (3, t, 15) of contacts where the whisker's shape is extrapolated."""
    beyond = np.maximum(state.contact[:, 0] * problem.d.length - length.shown, 0.0)
    # The fourth power of a distance with an error is on average nearly this one's.
    farther = np.where(beyond > 0.0, 3.0 * np.trace(spread, axis1=1, axis2=2), 0.0)
    changes = np.zeros((3, len(beyond), 15))
    vectors = length.bending @ problem.whisker.pose.rotation
    changes[..., :3] = np.einsum("tij,kj->kti", state.rotation, vectors)
    return changes * length.astray(np.sqrt(beyond**2 + farther))[:, None]


def _answer(
    problem: Problem,
    state: State,
    fit: Linear,
    spread: Array,
    nodes: int,
    length: Length,
    unsure: Array,
    hook: Hook | None,
) -> RodFit:
    """Results in SI units, relative to the head."""
    d, touching = problem.d, problem.touching
    shared, misfit = _shared(problem, state, fit, unsure), fit.data.misfit
    covariance = spread + np.einsum("kti,ktj->tij", shared, shared)
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
    errors = _frame_errors(problem, fit, hook)
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
