"""Fit of a rod to the traces: residuals, priors, and their least squares over time.

Each frame has its own unknowns, and second differences couple frames. The normal equations are
block banded, with two blocks on each side; they are solved by a banded Cholesky factorisation, and
the covariance of each frame follows from a forward and a backward recursion over pairs of frames.

The standard deviations of a trace come from the noise of its image. They do not contain the effects
of compression, blur or a pattern of the background, whose errors are alike in neighbouring points.
Such errors look like a slightly different rod, so the fit follows most of them, and neither size
nor correlation of the residuals r are those of the errors e. With derivatives D and covariance C of
the unknowns,

    r = R e,   R = 1 − D C Dᵀ,   ⟨r rᵀ⟩ = σ² R V Rᵀ,   V_jk = exp(−|j − k|/ℓ)  in each view.

The length ℓ is the one with which the diagonals of R V Rᵀ are in the same proportions as those of
the residuals, and the variance of traces, relative to the stated one, is

    v = τ Σ r² / tr(R V Rᵀ),    τ = coth(1/2ℓ),

with τ the number of neighbouring points that count as one. A frame that fits worse than usual is
trusted less, and so is such a part of the whisker.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.deferred import linalg
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface
from vibrissa.rod import Discretization
from vibrissa.tracking.refine.inertia import Inertia
from vibrissa.tracking.refine.peg import PEG_UNKNOWNS, UncertainPeg
from vibrissa.tracking.refine.rods import (
    FAR,
    REST,
    UNKNOWNS,
    Bent,
    State,
    TraceSeries,
    contact_slopes,
    deformations,
    placed,
    turns,
)
from vibrissa.tracking.space.pose import HeadPose
from vibrissa.whisker import Whisker

# Share of the largest element that is added to diagonals, so that they can be factorised.
_REGULAR = 1e-12
_FREE = 0.1  # smallest share of the errors that residuals show, however many numbers are fitted
# Lengths over which errors are correlated that are tried, and largest lag compared, points; number
# of frames for which it is computed what the fit follows.
_LENGTHS, _LAGS, _FRAMES = (0.1, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 8.0), 12, 24
_ODD = 4.0  # mean square of a frame's residuals, over the usual one, above which it is scaled down
_NEAR = 2  # number of points to each side over which the variance along a trace is averaged


class Smoother:
    """Normal equations of a trial."""

    def __init__(self, hessian: Array, gradient: Array) -> None:
        self.diagonal = hessian.copy()
        self.first = np.zeros_like(hessian)  # frame i with i + 1; all couplings are diagonal
        self.second = np.zeros_like(hessian)
        self.gradient = gradient.copy()
        # Of unknowns that all frames share, with those of the frames and with each other.
        self.crossed = np.zeros((*gradient.shape, PEG_UNKNOWNS))
        self.shared = np.zeros((PEG_UNKNOWNS, PEG_UNKNOWNS))
        self.pull = np.zeros(PEG_UNKNOWNS)

    def add_at(self, values: Array, weight: Array, begin: int, target: Array) -> Array:
        """Pull unknowns, from index ``begin`` on, to a target; return the cost of each frame."""
        places = np.arange(begin, begin + values.shape[1])
        self.diagonal[:, places, places] += weight
        self.gradient[:, places] += weight * (target - values)
        return np.asarray((weight * (values - target) ** 2).sum(axis=1))

    def add_prior(self, information: Array, values: Array) -> float:
        """Pull the shared unknowns to zero; return the cost."""
        self.shared += information
        self.pull -= information @ values
        return float(values @ information @ values)

    def add_rows(
        self, at: NDArray[np.intp], rows: Array, values: Array, common: Array | None = None
    ) -> None:
        """Pull a combination of unknowns of some frames, and of shared ones, to zero."""
        self.diagonal[at] += rows[:, :, None] * rows[:, None]
        self.gradient[at] -= rows * values[:, None]
        if common is not None:
            self.crossed[at] += rows[:, :, None] * common[:, None]
            self.shared += common.T @ common
            self.pull -= values @ common

    def add_within(
        self, at: NDArray[np.intp], rows: Array, values: Array, common: Array | None = None
    ) -> tuple[Array, Array]:
        """Pull so where that is possible; return the costs, which are limited, and weights."""
        weight = 1.0 / (1.0 + (values / FAR) ** 2)
        each = weight[:, None]
        self.add_rows(at, each * rows, weight * values, None if common is None else each * common)
        return weight * values**2, weight

    def add_along(self, axis: Array, value: Array, begin: int, weight: float) -> Array:
        """Pull one direction of three unknowns to zero; return the cost of each frame."""
        part = slice(begin, begin + 3)
        self.diagonal[:, part, part] += weight**2 * axis[:, :, None] * axis[:, None, :]
        self.gradient[:, part] -= weight**2 * axis * value[:, None]
        return np.asarray((weight * value) ** 2)

    def add_second(self, at: NDArray[np.intp], values: Array, weight: Array) -> Array:
        """Pull second differences (n, unknown) at some frames to zero; return the cost of each."""
        square = weight**2
        n = np.arange(square.shape[1])
        pull = square * values
        for shift, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            self.diagonal[(at + shift)[:, None], n, n] += factor**2 * square
            self.gradient[at + shift] -= factor * pull
        for before in (at - 1, at):
            self.first[before[:, None], n, n] -= 2.0 * square
        self.second[(at - 1)[:, None], n, n] += square
        return np.asarray((pull * values).sum(axis=1))

    def solved(self, damping: float | Array = 0.0) -> tuple[Array, Array]:
        """Step (time, unknown), damped by a share (time,) of the diagonal, and the shared step."""
        pulls = np.concatenate([self.gradient[None], np.moveaxis(self.crossed, 2, 0)])
        if not self.crossed.any():
            return self.alone(pulls[:1], damping)[0], np.zeros(PEG_UNKNOWNS)
        step, *by = self.alone(pulls, damping)
        shared = np.linalg.solve(
            self._left(np.array(by)), self.pull - np.einsum("tuk,tu->k", self.crossed, step)
        )
        return step - np.einsum("ktu,k->tu", by, shared), shared

    def responses(self, pulls: Array) -> Array:
        """Steps (pull, time, unknown) in response to pulls on the unknowns."""
        steps = self.alone(pulls)
        if not self.crossed.any():
            return steps
        by, spread = self._by_shared
        drawn = np.einsum("ptu,tuk,kl->pl", steps, self.crossed, spread)
        return np.asarray(steps + np.einsum("pk,ktu->ptu", drawn, by))

    def by_shared(self) -> Array:
        """Changes (k, time, unknown) due to errors of the shared unknowns, one sigma each."""
        if not self.crossed.any():
            return np.zeros((0, *self.gradient.shape))
        by, spread = self._by_shared
        return np.asarray(np.einsum("ktu,kl->ltu", by, np.linalg.cholesky(spread)))

    @property
    def shared_covariance(self) -> Array:
        """Covariance (k, k) of the shared unknowns."""
        return self._by_shared[1]

    @cached_property
    def _by_shared(self) -> tuple[Array, Array]:
        """Steps (k, time, unknown) against shared unknowns, and covariance (k, k) of these."""
        by = self.alone(np.moveaxis(self.crossed, 2, 0))
        return by, np.asarray(np.linalg.inv(self._left(by)))

    def _left(self, by: Array) -> Array:
        """Normal equations of the shared unknowns, the others of which are solved for."""
        left = self.shared - np.einsum("tuk,ltu->kl", self.crossed, by)
        return np.asarray(0.5 * (left + left.T))

    def alone(self, pulls: Array, damping: float | Array = 0.0) -> Array:
        """Steps (pull, time, unknown) in response to pulls if shared unknowns are known."""
        count, n, _ = self.diagonal.shape
        band = np.zeros((3 * n, count, n))
        rows, columns = np.indices((n, n))
        lower = rows >= columns
        row, column = rows[lower], columns[lower]
        band[row - column, :, column] = self.diagonal[:, row, column].T
        for ahead, tie in ((1, self.first), (2, self.second)):
            each = np.moveaxis(tie[: count - ahead], 0, -1)  # (column, row, time)
            band[ahead * n + rows - columns, : count - ahead, columns] = np.swapaxes(each, 0, 1)
        band = band.reshape(3 * n, count * n)
        damped = np.repeat(np.broadcast_to(damping, count), n)
        band[0] += damped * band[0] + _REGULAR * band[0].max()
        step = linalg.solveh_banded(band, pulls.reshape(len(pulls), -1).T, lower=True)
        return np.asarray(step.T).reshape(len(pulls), count, n)

    def covariances(self) -> Array:
        """Blocks (time, unknown, unknown) on the diagonal of the inverse, shared unknowns known."""
        count, n, _ = self.diagonal.shape
        pairs = (count + 1) // 2
        size = 2 * n
        middle = np.zeros((pairs, size, size))
        tie = np.zeros((pairs, size, size))
        for p in range(pairs):
            i = 2 * p
            middle[p, :n, :n] = self.diagonal[i]
            if i + 1 < count:
                middle[p, n:, n:] = self.diagonal[i + 1]
                middle[p, :n, n:] = self.first[i]
                middle[p, n:, :n] = self.first[i].T
            else:
                middle[p, n:, n:] = np.eye(n)
            if i + 2 < count:
                tie[p, :n, :n] = self.second[i]
                tie[p, n:, :n] = self.first[i + 1]
            if i + 3 < count:
                tie[p, n:, n:] = self.second[i + 1]
        middle += _REGULAR * middle.max() * np.eye(size)
        ahead, back = middle.copy(), middle.copy()
        for p in range(1, pairs):
            ahead[p] -= tie[p - 1].T @ np.linalg.solve(ahead[p - 1], tie[p - 1])
        for p in range(pairs - 2, -1, -1):
            back[p] -= tie[p] @ np.linalg.solve(back[p + 1], tie[p].T)
        inverse = np.linalg.inv(ahead + back - middle)
        blocks = np.stack([inverse[:, :n, :n], inverse[:, n:, n:]], axis=1)
        return blocks.reshape(2 * pairs, n, n)[:count]


def trace_variance(
    misses: Sequence[Array],
    designs: Sequence[Array],
    covariance: Array,
    least: float,
    even: bool = False,
) -> list[Array]:
    """Variances (time, point) of each view's traces, relative to the stated ones.

    ``misses`` are the residuals (time, point) of each view, ``designs`` their derivatives (time,
    point, unknown) and ``covariance`` that of each frame's unknowns; no variance is below
    ``least``. The variance varies along the whisker, since a tip is often less accurate than
    stated, unless it is to be ``even``. Two further points are the ends.
    """
    known = [one != 0.0 for one in misses]
    square = np.sum([(one**2).sum(axis=1) for one in misses], axis=0)
    count = np.sum([one.sum(axis=1) for one in known], axis=0)
    shown = count > 0
    if not square[shown].any():
        return [np.ones((len(one), one.shape[1] + 2)) for one in misses]
    # Most frames are right, and so is their median.
    usual = float(np.median(square[shown] / count[shown]))
    each = np.maximum(square / np.maximum(count, 1), usual)
    along = [np.ones(one.shape[1]) for one in misses]
    if not even:
        for share, one, at in zip(along, misses, known, strict=True):
            total, number = _neighbours((one**2).T @ (1.0 / each)), _neighbours(at.sum(axis=0))
            np.divide(total, number, out=share, where=total > 0.0)
    miss, design = (np.concatenate(parts, axis=1) for parts in (misses, designs))
    size = np.sqrt(np.concatenate(along))
    some = np.flatnonzero(shown)
    some = some[np.linspace(0, len(some) - 1, min(_FRAMES, len(some))).astype(int)]
    odd = np.sqrt(np.maximum(each / (_ODD * usual), 1.0))[:, None]
    # The fit follows errors e as far as D C Dᵀ e.
    follows = (design[some] / size[:, None]) @ covariance[some], design[some] * size[:, None]
    together, left = _correlation(miss / (odd * size), some, follows, len(misses))
    variance = together * each / left
    return [np.maximum(np.outer(variance, [*share, 1.0, 1.0]), least) for share in along]


def _correlation(
    miss: Array, some: NDArray[np.intp], follows: tuple[Array, Array], views: int
) -> tuple[float, float]:
    """Number of neighbouring errors that count as one, and the share of them in the residuals.

    What the fit ``follows`` of the errors of some of the frames is the product P Qᵀ of two matrices
    (some, point, unknown): with R = 1 − P Qᵀ, R V Rᵀ = V − (H Pᵀ + P Hᵀ), H = V Q − ½ P Qᵀ V Q.
    """
    n = miss.shape[1] // views
    known = (miss[some] != 0.0).astype(np.float64)
    mask, numbers = known[:, :, None], known.T @ known
    p, q = (part * mask for part in follows)
    lags = range(min(_LAGS, n // 2) + 1)

    def diagonals(moments: Array) -> Array:
        within = np.einsum("vivj->ij", moments.reshape(views, n, views, n))
        return np.array([np.trace(within, offset=lag) for lag in lags])

    shown = diagonals(miss.T @ miss)
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    best = (np.inf, 1.0, 1.0)
    for length in _LENGTHS:
        errors = np.kron(np.eye(views), np.exp(-apart / length))
        h = mask * (errors @ q)
        h -= 0.5 * p @ (np.swapaxes(q, 1, 2) @ h)
        cross = np.tensordot(h, p, ((0, 2), (0, 2)))
        moments = diagonals(errors * numbers - cross - cross.T)
        differs = float(((shown / shown[0] - moments / moments[0]) ** 2).sum())
        left = float(moments[0] / known.sum())
        best = min(best, (differs, 1.0 / float(np.tanh(0.5 / length)), max(left, _FREE)))
    return best[1:]


def _neighbours(numbers: Array) -> Array:
    """Sums over each number and its neighbours."""
    return np.convolve(numbers, np.ones(2 * _NEAR + 1), mode="same")


# Levenberg's damping: initial, smallest, and that at which the fit ends.
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-8, 1e6
# Expected decrease of the cost below which a step is the last, and the same for fits of which only
# costs, variances of traces or changes are used.
_SETTLED, NEARLY = 0.1, 0.2
_HELD = 1e8  # weight with which frames without contact keep the contact at rest
# Unknowns across the plane z = 0: a shift, turns about two axes; the force across it.
_ACROSS = (slice(2, 5), slice(9, 10))
# Standard deviation of the force along the whisker if there is none across, in units of EI/L².
_RUBBING = 1e-4
_ROLLED = np.radians(3.0)  # standard deviation of the roll before its variation is known, rad
_ELSE = 3.0  # misfit, over the usual one, from which the traces of a frame are on something else
_HOLD = 1e5  # inverse standard deviation of an arc length that is held, in units of L
_ALONG = np.eye(UNKNOWNS)[6]  # the arc length among the unknowns
# Error of a trace, as a share of the second difference of its positions, if the exposure may be any
# part of a frame: an eighth if it is all, and the speed changes in the middle.
_EXPOSED = 0.05
# Standard deviation of the angle at which a whisker meets a surface, rad; and the arc length, in
# units of L, from which its tip may touch at any angle.
_TILTED, _TIP = 0.02, 0.97
# Factor of the standard deviation of the distance from objects, at first: contacts are found from
# farther away.
_SOFT = 10.0
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
    tangents: list[Array]  # at contacts, if they touch known objects; see `Bent.tangents`

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
    objects: Sequence[Surface]
    peg: UncertainPeg | None  # instead of them
    near: Mask  # (time,): where one of them is within reach
    begun: State | None = None
    variance: list[Array] | None = None
    shown: float = 1.0
    held: Sequence[tuple[int, float]] = ()  # rows whose contact's arc length is held, and that
    fixed: bool = False  # whether the peg is as it is in the state that the fit begins with
    enough: float = _SETTLED  # expected decrease of the cost below which a step is the last
    inertia: Inertia | None = None  # that traces are without
    displaced: Callable[[Array], Array] | None = None  # points (error, ..., 3) by cameras' errors

    def rows(self, rows: NDArray[np.intp], begun: State) -> Problem:
        """The problem restricted to some frames, which begins there."""
        return replace(
            self,
            traces=self.traces.rows(rows),
            touching=self.touching[rows],
            near=self.near[rows],
            frames=self.frames[rows],
            start=self.start.rows(rows),
            head=self.head.rows(rows),
            begun=begun.rows(rows),
            inertia=self.inertia and self.inertia.rows(rows),
            variance=self.variance and [each[rows] for each in self.variance],
        )

    def put_in(self, points: Array, state: State, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Contacts of some rows, relative to the base, in the laboratory, m, and turns of tangents.

        Inertia moves them, and changes tangents (time, 3), in the frame of the head, by so much.
        """
        head, length = self.head.rows(rows), self.d.length
        found = head.put_in((points + state.position) * length)
        if self.inertia is None:
            return found, np.zeros_like(found)
        moved, slopes = self.inertia.rows(rows).at(state.contact[:, 0])
        return found + moved, np.einsum("tji,tj->ti", head.rotation, slopes) / length

    def trusted(self, even: bool = False) -> tuple[Problem, State, Linear]:
        """The problem with traces weighted by their residuals, and its solution."""
        loose = replace(self.options, roll=max(self.options.roll, _ROLLED))
        begin = replace(loose, surface=_SOFT * loose.surface)
        state, fit = replace(self, options=begin, enough=NEARLY).solved()
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
        stuck = np.zeros(len(self.frames), dtype=bool)
        for _ in range(self.options.rounds):
            step, shared = fit.smoother.solved(damping)
            trial = state.moved(step, shared)
            decrease = (fit.smoother.gradient * step).sum(axis=1)
            decrease += fit.smoother.pull @ shared / len(decrease)
            if decrease.sum() < self.enough:
                costs = fit.costs - np.where(stuck, 0.0, decrease)
                rows = np.flatnonzero(stuck)
                return trial.put(rows, state.rows(rows)), fit._replace(costs=costs)
            tried = self.linear(trial)
            worse = tried.data.squares > fit.data.squares
            stuck = np.zeros_like(worse)
            if not tried.cost < fit.cost:
                # Frames depend little on each other: those that become worse stay as they are.
                stuck = worse
                rows = np.flatnonzero(stuck)
                trial = trial.put(rows, state.rows(rows))
                tried = self._linear(trial, tried.data.put(worse, fit.data))
            if tried.cost < fit.cost:
                state, fit = trial, tried
                damping = np.where(worse, 10.0 * damping, np.maximum(damping / 5.0, _LEAST_DAMPING))
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
        costs = data.squares + self._priors(smoother, state) + self._touched(smoother, state, data)
        if self.peg is not None and not self.fixed and len(costs):
            costs += smoother.add_prior(self.peg.information, state.peg) / len(costs)
        for i, arc in self.held:
            away = _HOLD * (state.contact[[i], 0] - arc)
            smoother.add_rows(np.array([i]), _HOLD * _ALONG[None], away)
        return Linear(smoother, costs, data)

    def _compared(self, state: State) -> Compared:
        """Compare with the traces; rods without equilibrium are infinitely far away."""
        rods = Bent.of(self.d, state, self.touching, self.shown)
        tangents = list[Array]()
        if self.objects or self.peg is not None:
            whole = rods if self.shown == 1.0 else Bent.of(self.d, state, self.touching)
            tangents = list(whole.tangents(state.contact[:, 0]))
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
        return Compared(
            hessian, gradient, weighted, misfit, wild, along, ends, designs, weights, tangents
        )

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
        pull = self._pulls(points, _EXPOSED * uneven, fit)
        return np.asarray(np.einsum("tij,tj->ti", covariance, pull))

    def deformed(self, state: State, fit: Linear) -> list[Array]:
        """Pulls (time, unknown) on the unknowns due to errors of the cameras, one sigma each."""
        if self.displaced is None:
            return []
        points = self.head.put_in(placed(self.d, state, self.shown) * self.d.length)
        rotation = self.head.rotation @ state.rotation
        shifts = deformations(self.displaced(points), points, rotation, ~self.touching)
        return [self._pulls(points, shift, fit) for shift in shifts]

    def _pulls(self, points: Array, shift: Array, fit: Linear) -> Array:
        """Pulls (time, unknown) on the unknowns if points (time, point, 3), m, appear displaced."""
        pull = np.zeros((len(points), UNKNOWNS))
        for view, (camera, design) in enumerate(zip(self.cameras, fit.data.designs, strict=True)):
            pixels, slopes = camera.project_with_slopes(points)
            moved = camera.project(points + shift)
            misses = [self.traces.equations(view, at, slopes)[1][:, :-2] for at in (pixels, moved)]
            seen = (misses[0] != 0.0) & (misses[1] != 0.0)
            pull += np.einsum("tni,tn->ti", design[:, :-2], seen * (misses[0] - misses[1]))
        return pull

    def _touched(self, smoother: Smoother, state: State, data: Compared) -> Array:
        """Pull contacts to the surfaces of known objects, and make them tangent; return the costs.

        Distances hardly change along a whisker that touches an object, but the normal does: only
        that of the contact is normal to the whisker.
        """
        costs = np.zeros(len(self.frames))
        if not data.tangents:
            return costs
        length, surface = self.d.length, self.options.surface
        at = np.flatnonzero(self.touching & self.near & ~data.wild)
        part, turn = state.rows(at), self.head.rotation[at]
        points, slopes, _ = contact_slopes(self.d, part)
        points, tilt = self.put_in(points, part, at)
        tangent, turning = (values[at] for values in data.tangents)
        tangent = tangent + tilt
        radius = self.whisker.radius(part.contact[:, 0] * length)
        nearer = tilted = None
        if self.peg is None:
            found = [
                min((t.local_geometry(p) for t in self.objects), key=lambda one: abs(one[0]))
                for p in points
            ]
            distance, normal, curvature = (
                np.array([one[k] for one in found]).reshape(len(at), *shape)
                for k, shape in enumerate(((), (3,), (3, 3)))
            )
        else:
            across = np.einsum("tij,tj->ti", turn, tangent)
            local, nearer, tilted = self.peg.geometry(state.peg, points, across)
            distance, normal, curvature = local
            nearer, tilted = (None, None) if self.fixed else (nearer / surface, tilted)
        normal = np.einsum("ti,tij->tj", normal, turn)
        curvature = np.swapaxes(turn, 1, 2) @ curvature @ turn
        row = np.einsum("ti,tij->tj", normal, slopes) * (length / surface)
        gap = (distance - radius) / surface
        costs[at], share = smoother.add_within(at, row, gap, nearer)
        # Of the tip, only the distance is known.
        share = np.where(part.contact[:, 0] > _TIP, 0.0, share)
        across = np.einsum("tij,tj->ti", curvature, tangent)
        share /= np.hypot(_TILTED, surface * np.linalg.norm(across, axis=1))
        row = np.einsum("ti,tij->tj", normal, turning)
        row += length * np.einsum("ti,tij->tj", across, slopes)
        angle = share * (normal * tangent).sum(axis=1)
        tilted = None if tilted is None else share[:, None] * tilted
        costs[at] += smoother.add_within(at, share[:, None] * row, angle, tilted)[0]
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
