"""Bayesian filter that follows a contact over time, with one hypothesis for each explanation.

Objects are mostly at rest, so in the laboratory frame the contact point moves smoothly while the
base turns and travels. A hypothesis is a Gaussian over contact point p and velocity v, which
follows an Ornstein-Uhlenbeck process:

    dp = v dt,    dv = -v dt / τ + σ √(2 / τ) dW.

A contact that is held is slow, and one that slides along an object without friction a hundred times
as fast. So the speed σ of each hypothesis is one of a few, from which it may change to another at
any time ("interacting multiple models", Blom and Bar-Shalom 1988).

The likelihood of a contact's first sample is split into Gaussians
(:mod:`~vibrissa.contacts.following.onset`). Each further sample moves them and reweights them by
how well they predicted it (:mod:`~vibrissa.contacts.following.mixture`). A sample of two signals
moves p only across the curve of contacts that explains it
(:mod:`~vibrissa.contacts.engine.ambiguity`); as the base moves, the curves of successive samples
intersect at the contact. A candidate that no hypothesis accounts for starts a new one, with the
prior probability of a new contact and the evidence for it, compared with that for the others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.contacts import LEFT, THREE_SIGMA, Contact
from vibrissa.contacts.engine.prior import Prior, refuse_tip
from vibrissa.contacts.engine.readout import Measurement
from vibrissa.contacts.estimator import Estimator
from vibrissa.contacts.following.mixture import (
    Mixture,
    learn,
    predict,
    room,
    switch,
    tidy,
    unaccounted,
)
from vibrissa.contacts.following.onset import Beginning, Gaussians, groups
from vibrissa.contacts.following.units import Course, question_parameters
from vibrissa.contacts.sensing.noise import explained
from vibrissa.deferred import special
from vibrissa.numerics import AnyArray, Array, Vector
from vibrissa.rod import charted_rod
from vibrissa.status import Status

_UNKNOWNS = 3
_LEVEL, _ORIGIN = np.eye(3), np.zeros(3)  # pose of a base at rest in the laboratory frame
_LEAST = 1e-6  # probability relative to the best hypothesis below which one is dropped
# Largest number of hypotheses of one speed, and squared Mahalanobis distance, by the sum of both
# covariances, below which two are merged: if one sample determines a contact, and if it leaves a
# curve, which Gaussians describe only if they are short.
_MOST, _ONE = (24, 200), (0.3, 0.1)
_NEW = 16.0  # the same distance from every hypothesis above which a candidate is a new one
# Largest deflection (over L) before contact is detected: if the onset is unknown, and at least.
_ANYWHERE = 0.3
_LEAST_REACH = 0.01
# Distance (over L) that a contact may have moved in a gap, and RMS error of the hypotheses, above
# which the filter starts anew.
_GAP, _FORGOTTEN = 0.1, 0.5
# Speeds of contact points, over L per second, their prior probabilities, and the rate at which a
# contact takes a speed anew, 1/s. A contact that is held has the first; one that moves along an
# object the others; one just before it slips off, or whose base's motion is unknown, the last. With
# two signals all speeds above the true one are evidence for contacts too near the tip, where motion
# changes the signals least.
_SPEEDS = np.array([0.001, 0.05, 0.25, 1.25, 6.25])
_SHARES = np.array([0.3, 0.15, 0.3, 0.15, 0.1])
_RATE = 2.0
# Squared Mahalanobis distance, by the sum of both covariances, below which a hypothesis that takes
# another speed joins one that has it.
_JOINED = 4.0
_APPROACH = 0.25  # speed, over L per second, at which objects may approach the whisker
_SURE = 0.99  # probability above which a contact is no longer ambiguous
# Trial factors of a covariance, and a negligible probability.
_FACTORS, _NOTHING = np.linspace(1.0, 4.0, 31), 1e-12
_EXPLAINED = (Status.UNIQUE, Status.AMBIGUOUS, Status.UNDERDETERMINED)


class Followed(NamedTuple):
    """State of a filter after a sample."""

    # (3,), mean of the most probable hypothesis, laboratory frame, m; NaN if there is none. If
    # hypotheses form one group, as along the valley of a light contact, it is that of the group.
    point: Array
    # (3, 3), covariance of the contact point, m²: over all hypotheses, weighted by their
    # probabilities, and wide enough that 0.3 % of the group's probability is beyond three standard
    # deviations.
    covariance: Array
    velocity: Array  # (3,), velocity of the contact point in the laboratory, m/s
    # Probability of that group of hypotheses; 0 if there is none.
    probability: float
    # ``UNIQUE`` if that is above 0.99, else ``AMBIGUOUS``; ``UNDERDETERMINED`` for fewer than three
    # signals as long as no pose of the base has been stated: there is nothing with which the curves
    # of contacts of successive samples could intersect. ``MISSING``, ``NOT_FRICTIONLESS`` and
    # other reasons are those of this sample if neither a hypothesis nor any contact explains it:
    # the point is then predicted from earlier samples.
    status: Status
    # (k, 3), contact points of all hypotheses, the most probable first, laboratory frame, m
    points: Array
    probabilities: Array  # (k,), their probabilities
    point_whisker: Array  # (3,), ``point`` in the whisker's frame, m
    # Estimate from this sample alone; None for fewer than three signals that a hypothesis explains.
    located: Contact | None


class Drift:
    """Laws of motion of (p, v), which differ in speed, with their probabilities."""

    def __init__(self, speeds: Array, shares: Array, persistence: float) -> None:
        self.speeds, self.shares, self._tau = speeds, shares, persistence

    def over(self, step: float) -> tuple[float, float, Array]:
        """Coefficients of the motion over a time step; growth (n, 3) for n laws."""
        tau, speed = self._tau, self.speeds
        x = step / tau
        a = math.exp(-x)
        # 2x - 3 + 4a - a² suffers from cancellation if x is small.
        walked = 2.0 * x - 3.0 + 4.0 * a - a * a if x > 0.01 else x**3 * (2.0 / 3.0 - 0.5 * x)
        unit = np.array([tau**2 * walked, tau * (1.0 - a) ** 2, 1.0 - a * a])
        grown = speed[:, None] ** 2 * unit
        return tau * (1.0 - a), a, grown


class ContactFilter:
    """Follow a contact through a stream of signals, with the motion of the base.

    Parameters
    ----------
    estimator : Estimator
        Estimator of single samples, with noise.
    speed : float, optional
        Standard deviation of a component of the contact point's velocity in the laboratory, m/s. By
        default it is unknown, and found sample by sample between 0.001 and 6 lengths of the whisker
        per second.
    persistence : float
        Correlation time τ of the velocity, s.
    pose_sigma : float
        Standard deviation of a component of the base's position, m, independent from sample to
        sample.
    birth : float
        Probability that a sample belongs to a new contact.
    memory : float
        Correlation time, s, of the errors that samples share, those of the stiffness and of the
        sensor's gain and mixing: first-order Gauss-Markov processes. By default infinite, so that
        these errors are constant.

    Raises
    ------
    ValueError
        If the estimator has no noise, or a number is out of range.

    Warns
    -----
    UserWarning
        If times, positions or parameters suggest that they are in ms or mm.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        speed: float | None = None,
        persistence: float = 0.05,
        pose_sigma: float = 0.0,
        birth: float = 1e-4,
        memory: float = math.inf,
    ) -> None:
        if not isinstance(estimator, Estimator):
            raise ValueError(
                f"a filter needs an Estimator(contact_map, noise=...); got {estimator!r}"
            )
        self._length = estimator.contact_map.whisker.length
        approach = _APPROACH if speed is None else speed / self._length
        if not (approach > 0.0 and persistence > 0.0 and pose_sigma >= 0.0 and 0.0 < birth < 1.0):
            raise ValueError(
                "speed and persistence are positive, pose_sigma is not negative and birth between "
                f"0 and 1; got {speed}, {persistence}, {pose_sigma} and {birth}"
            )
        question_parameters(self._length, speed, persistence, pose_sigma)
        if not memory > 0.0:
            raise ValueError(f"memory is a time, positive, s; got {memory!r}")
        if estimator.softened:
            raise ValueError(
                "a filter does not support friction, compliance_sigma, uncertain gravity, or an "
                "uncertain stiffness of a whisker whose sag is then uncertain by more than 0.0003 L"
            )
        refuse_tip(estimator.prior, "a filter takes contacts of the side")
        if not estimator.noisy:
            raise ValueError(
                "a filter needs an estimator with noise: Estimator(contact_map, noise=...)"
            )
        # With weight, contacts are those of a weightless whisker with the sagged shape, for
        # measurements corrected by the effect of the weight.
        self._shape: Vector | None = None
        self._weighted = estimator if estimator.weighted else None
        if self._weighted is None:
            self._locate_by(estimator)
        else:
            self._sag()
        if speed is None:
            self._drift = Drift(_SPEEDS, _SHARES, persistence)
        else:
            self._drift = Drift(np.array([approach]), np.ones(1), persistence)
        self._approach = approach
        self._memory = memory
        self._pose = (pose_sigma / self._length) ** 2
        self._birth = math.log(birth)
        how = self.estimator.readout.how
        self._errors = len(how.errors)
        self._limit = explained(len(how.own))
        self._course = Course()
        self.reset()

    def _locate_by(self, estimator: Estimator) -> None:
        self.estimator, self._beginning = estimator, Beginning(estimator)

    def _sag(self) -> None:
        """Give the weightless whisker the shape of the whisker with weight in this pose.

        A light contact is as near to the resting shape as the sag of another pose is. Hypotheses
        of a contact that is held keep the shape as long as the base turns little.
        """
        assert self._weighted is not None
        shape, before = self._weighted.resting, self._shape
        if before is not None:
            held = len(self._mixture.weight) > 0 and self._weighted.rests_nearly(before)
            if held or shape == before:
                return
        self._shape = shape
        self._locate_by(self._weighted.sagged())

    def __repr__(self) -> str:
        return f"<ContactFilter of {self.estimator!r}>"

    def reset(self) -> None:
        """Discard all hypotheses, as when contact has been lost."""
        self._mixture = room(0, self._errors)
        self._time: float | None = None
        self._posed = False  # whether any pose of the base has been stated
        self._free: tuple[float, Array, Array] | None = (
            None  # time and pose of the last sample without contact
        )
        self.estimator.reset()

    def __call__(
        self,
        time: float,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        position: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
    ) -> Followed:
        """Update the filter by one sample."""
        self._posed = self._posed or rotation is not None or position is not None
        turn = np.ascontiguousarray(_LEVEL if rotation is None else rotation, dtype=np.float64)
        base = np.asarray(_ORIGIN if position is None else position, dtype=np.float64)
        if turn.shape != (3, 3) or base.shape != (3,):
            raise ValueError(f"a pose is (3, 3) and (3,); got {turn.shape} and {base.shape}")
        given = np.asarray(time)
        if given.ndim or given.dtype.kind not in "iuf" or not math.isfinite(time):
            raise ValueError(f"time is a finite number, s; got {time!r}")
        if self._time is not None and not time > self._time:
            raise ValueError(f"times must increase; got {time} s after {self._time} s")
        self._course.question(time, base)
        reason = None
        if self._weighted is None:
            measurement = self.estimator.measurement(signals, rotation, gravity)
        else:
            measurement = self._weighted.measurement(signals, rotation, gravity)
            if self._weighted.nothing_in(measurement) is None:
                self._sag()
            measurement, reason = self._weighted.of_sagged(measurement, self.estimator)
        base = base / self._length
        if self._time is not None:
            self._predict(time - self._time)
        self._time = time
        nothing = self.estimator.nothing_in(measurement)
        if nothing is None and not math.isfinite(float(turn.sum() + base.sum())):
            nothing = Status.MISSING
        if nothing is None:
            return self._known(*self._learned(measurement, turn, base), turn, base)
        if nothing != Status.MISSING:
            self._mixture = room(0, self._errors)
            touching = nothing != Status.NOT_FELT or not np.isfinite(turn).all()
            self._free = None if touching else (time, turn, base)
        elif reason is not None:
            nothing = reason  # the sample is complete, but no contact explains it
        return self._known(nothing, None, turn, base)

    def _learned(
        self, measurement: Measurement, turn: Array, base: Array
    ) -> tuple[Status, Contact | None]:
        """Update by a measurement that is not empty; also the estimate from it alone."""
        three = self.estimator.readout.rank >= _UNKNOWNS
        located = self.estimator.locate(measurement) if three else None
        x, values = np.empty((0, 4)), np.empty((0, 6))
        if located is not None and located.status in (Status.UNIQUE, Status.AMBIGUOUS):
            x, values = self._beginning.exact(located)
        first = not len(self._mixture.weight)
        explains, evidence = False, -math.inf
        if not first:
            explains, evidence = self._update(measurement, x, values, turn, base)
        if not three and not explains:
            located = self.estimator.locate(measurement)
        lost = not len(self._mixture.weight)
        reach = self._reach(turn, base) if first else _ANYWHERE
        prior = 0.0 if lost else self._birth - evidence
        if three and lost:
            assert located is not None
            found = self._beginning.all_that_may_be(measurement, located, reach)
            self._add(found, turn, base, prior)
        elif len(x) and located is not None:
            new = self._unaccounted(values, located, turn, base)
            if new.any():
                found = self._beginning.candidates(measurement, located, reach)
                self._add(Gaussians(*(part[new] for part in found)), turn, base, prior)
        elif located is not None and located.status == Status.UNDERDETERMINED:
            found = self._beginning.samples(measurement, located, reach)
            self._add(found, turn, base, prior)
        self._free = None
        if explains or located is None:
            return Status.AMBIGUOUS, located
        return located.status, located

    def _update(
        self, measurement: Measurement, x: Array, values: Array, turn: Array, base: Array
    ) -> tuple[bool, float]:
        """Update all hypotheses; whether any explains the measurement, and its log evidence."""
        chart, readout = self.estimator.contact_map.chart, self.estimator.readout
        most = len(self._mixture.weight) * (1 + len(x))
        out, misfits = room(most, self._errors), np.empty(most)
        n = learn(
            charted_rod(chart),
            chart.proximal,
            readout.how,
            measurement.target,
            measurement.measured,
            readout.passes,
            turn,
            base,
            self._pose,
            self._mixture,
            x,
            values,
            out,
            misfits,
        )
        explains = bool((misfits[:n] < self._limit).any())
        evidence = float(np.logaddexp.reduce(out.weight[:n]))
        self._mixture = self._tidied(out, n)
        return explains, evidence

    def _unaccounted(self, values: Array, located: Contact, turn: Array, base: Array) -> AnyArray:
        """Which candidates (n,) no hypothesis accounts for."""
        own = turn @ (located.candidates.covariance / self._length**2) @ turn.T
        if not math.isfinite(float(own.sum())):  # a point that the signals do not determine
            unknown = ~np.isfinite(own).all(axis=(1, 2))
            own[unknown] = _FORGOTTEN**2 * np.eye(3)
        out = np.empty(len(values), np.bool_)
        points = values[:, 3:] @ turn.T + base
        unaccounted(self._mixture, points, own, _NEW, out)
        return out

    def _reach(self, turn: Array, base: Array) -> float:
        """Largest possible approach of whisker and objects since the last free sample."""
        if self._free is None or self._time is None:
            return _ANYWHERE
        time, *pose = self._free
        moved = self._beginning.moved(turn, base, (pose[0], pose[1]))
        moved += 3.0 * self._approach * (self._time - time)
        return min(max(moved, _LEAST_REACH), _ANYWHERE)

    def _add(self, found: Gaussians, turn: Array, base: Array, log_prior: float) -> None:
        """Add those Gaussians of the whisker's frame to the hypotheses that the prior allows."""
        if self.estimator.prior is not None:
            found = self._possible(self.estimator.prior, found)
        n, old = len(found.weights), len(self._mixture.weight)
        out = room(old + n * len(self._drift.speeds), self._errors)
        for mine, before in zip(out, self._mixture, strict=True):
            mine[:old] = before
        laws = zip(self._drift.speeds, self._drift.shares, strict=True)
        for law, (speed, share) in enumerate(laws):
            new = slice(old + law * n, old + (law + 1) * n)
            out.mean[new, :3] = found.points @ turn.T + base
            out.spread[new, :3, :3] = turn @ found.covariances @ turn.T + self._pose * np.eye(3)
            out.spread[new, 3:, 3:] = speed**2 * np.eye(3)
            out.by_errors[new, :3] = turn @ found.by_errors
            out.contact[new], out.value[new] = found.contacts, found.values
            out.weight[new] = found.weights + log_prior + math.log(share)
            out.law[new] = law
        self._mixture = self._tidied(out, len(out.weight))

    def _possible(self, prior: Prior, found: Gaussians) -> Gaussians:
        d, whisker = (
            self.estimator.contact_map.chart.discretization,
            self.estimator.contact_map.whisker,
        )
        x, points = found.contacts, found.values[:, 3:] * d.length
        kept = prior.allows(whisker, points, x[:, 0] * d.length, x[:, 1:] * d.force)
        return Gaussians(*(part[kept] for part in found))

    def _predict(self, step: float) -> None:
        if not len(self._mixture.weight):
            return
        if len(self._drift.speeds) > 1:
            out = room(len(self._mixture.weight) * len(self._drift.speeds), self._errors)
            gone = -math.expm1(-step * _RATE)
            n = switch(self._mixture, gone, self._drift.shares, _JOINED, out)
            self._mixture = self._tidied(out, n)
        predict(self._mixture, *self._drift.over(step))
        if self._memory < math.inf:
            self._forget(math.exp(-step / self._memory))
        if step * self._drift.speeds[-1] < _GAP:
            return
        variance = np.trace(self._mixture.spread[:, :3, :3], axis1=1, axis2=2)
        if (variance > _FORGOTTEN**2).all():
            self._mixture = room(0, self._errors)

    def _forget(self, kept: float) -> None:
        """Reduce the memory of shared errors to this share; the rest becomes noise of the state.

        With ε' = a ε + √(1 - a²) w the state's covariance with the error is a b, and its own
        covariance, of which b bᵀ is part, does not change.
        """
        spread, by = self._mixture.spread, self._mixture.by_errors
        spread += (1.0 - kept**2) * by @ np.swapaxes(by, 1, 2)
        by *= kept

    def _tidied(self, mixture: Mixture, number: int) -> Mixture:
        vague = self.estimator.readout.rank < _UNKNOWNS
        most = _MOST[vague] * len(self._drift.speeds)
        kept = tidy(mixture, number, _LEAST, most, _ONE[vague])
        return Mixture._make(part[:kept] for part in mixture)

    def _known(self, status: Status, located: Contact | None, turn: Array, base: Array) -> Followed:
        whole = self._mixture
        if whole.law.any():  # what differs only in speed is one contact
            whole = Mixture._make(part.copy() for part in whole)
            whole.law[:] = 0
            whole = self._tidied(whole, len(whole.weight))
        known = combined(whole, status, located, turn, base, self._length)
        vague = self.estimator.readout.rank < _UNKNOWNS and not self._posed
        if vague and known.status in (Status.UNIQUE, Status.AMBIGUOUS):
            return known._replace(status=Status.UNDERDETERMINED)
        return known


def nothing_known(status: Status, located: Contact | None) -> Followed:
    """State of a filter without a hypothesis, and the reason."""
    none = np.full(3, np.nan)
    empty = np.empty((0, 3))
    return Followed(
        none, np.full((3, 3), np.nan), none, 0.0, status, empty, np.empty(0), none, located
    )


def combined(
    mixture: Mixture,
    status: Status,
    located: Contact | None,
    turn: Array,
    base: Array,
    length: float,
) -> Followed:
    """State of a filter with hypotheses, in SI units."""
    n = len(mixture.weight)
    if not n:
        return nothing_known(status, located)
    weights = np.exp(mixture.weight)
    points, spreads = mixture.mean[:, :3], mixture.spread[:, :3, :3]
    b = mixture.by_errors[:, :3]
    spreads = spreads + b @ np.swapaxes(b, 1, 2)
    if n == 1:
        mean, probability, covariance = mixture.mean[0], 1.0, spreads[0]
    else:
        group = groups(points, mixture.spread[:, :3, :3], b)
        shares = np.bincount(group, weights)
        best = group == shares.argmax()
        mean = weights[best] @ mixture.mean[best] / weights[best].sum()
        probability = float(min(shares.max(), 1.0))
        away = points - mean[:3]
        covariance = np.tensordot(weights, spreads, axes=1) + (away.T * weights) @ away
        covariance *= _widening(weights[best], away[best], spreads[best], covariance)
    if status in _EXPLAINED:
        status = Status.UNIQUE if probability > _SURE else Status.AMBIGUOUS
    return Followed(
        mean[:3] * length,
        covariance * length**2,
        mean[3:] * length,
        probability,
        status,
        points * length,
        weights,
        turn.T @ (mean[:3] - base) * length,
        located,
    )


def _widening(weights: Array, away: Array, spreads: Array, covariance: Array) -> float:
    """Factor, at least 1, by which an ellipsoid of three standard deviations contains its share.

    The sum of Gaussians about ``away`` (n, 3) may be bent and exceed the ellipsoid of its own
    second moment. The squared distances of each are taken as gamma distributed, with their exact
    mean and variance.
    """
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    own, middle = root @ spreads @ root.T, away @ root.T
    mean = np.trace(own, axis1=1, axis2=2) + (middle**2).sum(axis=1)
    through = np.einsum("ni,nij,nj->n", middle, own, middle)
    variance = 2.0 * (own**2).sum(axis=(1, 2)) + 4.0 * through
    squares = THREE_SIGMA * _FACTORS[:, None]
    beyond = special.gammaincc(mean**2 / variance, squares * mean / variance) @ weights
    left = np.log(np.maximum(beyond / weights.sum(), _NOTHING))
    return float(np.interp(-math.log(LEFT), -left, _FACTORS))
