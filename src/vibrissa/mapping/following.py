"""A contact followed over time: a Bayesian filter, one hypothesis for each explanation.

What a whisker touches mostly stands still, so in the laboratory the contact point moves smoothly
while the base turns and travels. A hypothesis is a Gaussian over contact point p and velocity v,
whose velocity forgets itself (Ornstein and Uhlenbeck):

    dp = v dt,    dv = -v dt / τ + σ √(2 / τ) dW.

A measurement moves p to where χ² of the signals and of p - p_predicted together is least, with the
exact rod in between; of two signals it moves p only across the curve of contacts that explains them
(:mod:`~vibrissa.mapping.ambiguity`), and as the base moves, the curves of successive samples cross
where the contact is. Each hypothesis is weighed by how well it predicted (Laplace's approximation),

    log w ← log w - χ²/2 + ½ log(det P_after / det P_before),

and every candidate that none of them accounts for starts another, as improbable as new contacts
are, with all places on the map alike beforehand.

An uncertain stiffness is the same error in all samples, which no averaging removes: how the state
depends on it, b = ∂(p, v)/∂log(EI), is carried along, and σ²bbᵀ is part of the covariance (a
"consider" parameter, as Schmidt had it).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.mapping.channels import CHANNELS, channel_derivatives, channel_gradients
from vibrissa.mapping.estimator import Estimator
from vibrissa.mapping.fitting import Fits, charted, fit
from vibrissa.mapping.hypotheses import (
    VAGUE,
    Followed,
    Hypothesis,
    bounded,
    gaps_between,
    linear,
    same,
)
from vibrissa.mapping.located import Explanations, Located
from vibrissa.mapping.minima import reliable, unknowns_covariance
from vibrissa.mapping.readout import Measurement
from vibrissa.mapping.weighing import weigh
from vibrissa.mapping.whitening import explained
from vibrissa.rod.arrays import Array
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.reach import LEAST_ARC
from vibrissa.sensing.sensor import GRAVITY
from vibrissa.status import Status

_UNKNOWNS = 3
# Hypotheses less probable than this next to the best are dropped.
_LEAST = 1e-6
# At most so many are kept, and of a curve or surface of candidates so many start.
_MOST = 24
# A candidate so far (the same) from every hypothesis is a new one.
_NEW = 16.0
# What is surer than this is no longer ambiguous.
_SURE = 0.99
# For so many samples after the first it is looked for all that noise may explain.
_YOUNG = 20
# Smallest standard deviation of a starting hypothesis, over L, so that matrices stay regular.
_FINEST = 1e-7
_PLACE = ("px", "py", "pz")


class ContactFilter:
    """Follow a contact through a stream of signals, with the motion of the base.

    Parameters
    ----------
    estimator : Estimator
        Locates single samples; it must know the noise.
    speed : float, optional
        Standard deviation of a component of the contact point's velocity in the laboratory, m/s; by
        default a quarter of the whisker's length a second.
    persistence : float
        Time after which the velocity has changed, τ, s.
    pose_sigma : float
        Standard deviation of a component of the base's position, m: independent from sample to
        sample.
    birth : float
        Probability that a sample shows another contact than any before.

    Raises
    ------
    ValueError
        If the estimator has no noise, or a number is out of range.
    """

    def __init__(
        self,
        estimator: Estimator,
        *,
        speed: float | None = None,
        persistence: float = 0.05,
        pose_sigma: float = 0.0,
        birth: float = 1e-4,
    ) -> None:
        self._length = estimator.contacts.whisker.length
        speed = 0.25 * self._length if speed is None else speed
        if not (speed > 0.0 and persistence > 0.0 and pose_sigma >= 0.0 and 0.0 < birth < 1.0):
            raise ValueError(
                "speed and persistence are positive, pose_sigma is not negative and birth between "
                f"0 and 1; got {speed}, {persistence}, {pose_sigma} and {birth}"
            )
        if not estimator.noisy:
            raise ValueError(
                "a filter weighs what it knows against the noise: give its estimator's"
            )
        self.estimator = estimator
        self._speed, self._tau = speed / self._length, persistence
        self._pose = (pose_sigma / self._length) ** 2 * np.eye(3)
        self._birth = math.log(birth)
        how = estimator.readout.how
        self._names = tuple(CHANNELS[code] for code in how.codes)
        self._stiffness = how.stiffness
        self._quiet = how._replace(
            stiffness=0.0
        )  # noise alone, which differs from sample to sample
        self._limit = explained(len(how.own))
        self.reset()

    def reset(self) -> None:
        """Forget everything, as when the whisker has lost touch."""
        self._hypotheses: list[Hypothesis] = []
        self._time: float | None = None
        self._age = 0  # samples in a row that a hypothesis explained
        self.estimator.reset()

    def __call__(
        self,
        time: float,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        position: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
    ) -> Followed:
        """Take one sample.

        Parameters
        ----------
        time : float
            Of the sample, s, later than the one before.
        signals : (k,) array_like
            As for the estimator.
        rotation : (3, 3) array_like, optional
            From the whisker's to the laboratory frame; by default they are the same. NaN where it
            is not known: the sample then counts as missing.
        position : (3,) array_like, optional
            Of the base in the laboratory, m; by default its origin. NaN as for the rotation.
        gravity : (3,) array_like
            In the laboratory frame, m/s².

        Returns
        -------
        Followed
            The contact in the laboratory.

        Raises
        ------
        ValueError
            If time does not go on, the estimator refuses the signals, or its sensor carries a mass
            and the rotation is not given.
        """
        turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
        base = np.zeros(3) if position is None else np.asarray(position, dtype=np.float64)
        if turn.shape != (3, 3) or base.shape != (3,):
            raise ValueError(f"a pose is (3, 3) and (3,); got {turn.shape} and {base.shape}")
        if self._time is not None and not time > self._time:
            raise ValueError(f"time goes on; got {time} s after {self._time} s")
        measurement = self.estimator.measurement(signals, rotation, gravity)
        if self._time is not None:
            self._predict(time - self._time)
        self._time = time
        base = base / self._length
        nothing = self.estimator.nothing_in(measurement)
        if nothing is None and not (np.isfinite(turn).all() and np.isfinite(base).all()):
            nothing = Status.MISSING
        if nothing is not None:
            if nothing != Status.MISSING:
                self._hypotheses, self._age = [], 0
            return self._known(nothing, None, turn, base)
        explains = self._update(measurement, turn, base)
        self._age = self._age + 1 if explains else 0
        located = None
        if self.estimator.readout.told >= _UNKNOWNS or not explains:
            located = self.estimator.locate(measurement)
            self._start(measurement, located, turn, base)
        self._tidy()
        status = Status.AMBIGUOUS if located is None else located.status
        return self._known(status, located, turn, base)

    def _start(self, measurement: Measurement, located: Located, turn: Array, base: Array) -> None:
        """Start hypotheses from what one sample tells."""
        if located.status == Status.UNDERDETERMINED:
            self._begin(measurement, self._of(located), turn, base, curve=True)
        elif self._age <= _YOUNG and self.estimator.readout.told >= _UNKNOWNS:
            found = self.estimator.explanations(measurement)
            self._begin(measurement, found, turn, base)
        elif located.status in (Status.UNIQUE, Status.AMBIGUOUS):
            self._begin(measurement, self._of(located), turn, base)

    def _predict(self, step: float) -> None:
        x = step / self._tau
        a = math.exp(-x)
        moved = self._tau * (1.0 - a)
        by = np.eye(6)
        by[:3, 3:], by[3:, 3:] = moved * np.eye(3), a * np.eye(3)
        # 2x - 3 + 4a - a² loses its digits where x is small.
        walked = 2.0 * x - 3.0 + 4.0 * a - a * a if x > 0.01 else x**3 * (2.0 / 3.0 - 0.5 * x)
        noise = np.zeros((6, 6))
        noise[:3, :3] = (self._speed * self._tau) ** 2 * walked * np.eye(3)
        noise[:3, 3:] = noise[3:, :3] = self._speed**2 * self._tau * (1.0 - a) ** 2 * np.eye(3)
        noise[3:, 3:] = self._speed**2 * (1.0 - a * a) * np.eye(3)
        for one in self._hypotheses:
            one.mean = by @ one.mean
            one.spread = by @ one.spread @ by.T + noise
            one.by_stiffness = by @ one.by_stiffness

    def _update(self, measurement: Measurement, turn: Array, base: Array) -> bool:
        """Move each hypothesis to where measurement and prediction agree best.

        Returns whether any of them explains the measurement.
        """
        vague = [one for one in self._hypotheses if one.vague]
        self._hypotheses = [one for one in self._hypotheses if not one.vague]
        share = math.fsum(math.exp(one.weight) for one in vague)
        explained = bool(self._hypotheses) and self._fitted(measurement, turn, base)
        if self._hypotheses and vague:
            total = float(np.logaddexp.reduce([one.weight for one in self._hypotheses]))
            for one in self._hypotheses:
                one.weight += math.log(max(1.0 - share, _LEAST)) - total
        self._hypotheses += vague
        return explained

    def _fitted(self, measurement: Measurement, turn: Array, base: Array) -> bool:
        """Update all hypotheses, none of them vague; whether any explains the measurement."""
        how, chart = self.estimator.readout.how, self.estimator.contacts.chart
        d, k, n = chart.discretization, len(self._names), len(self._hypotheses)
        prior = np.empty((n, 3))
        before = np.empty((n, 3, 3))
        weights = np.zeros((n, k + 3, k + 3))
        x = np.array([one.x for one in self._hypotheses])
        for i, one in enumerate(self._hypotheses):
            prior[i] = turn.T @ (one.mean[:3] - base)
            before[i] = turn.T @ (one.spread[:3, :3] + self._pose) @ turn
            weights[i, k:, k:] = np.linalg.inv(np.linalg.cholesky(before[i]))
        values, _ = solve_forces(d, x)
        usable = np.array(
            [
                self._weigh(measurement, value, out)
                for value, out in zip(values, weights, strict=True)
            ]
        )
        targets = np.column_stack([np.tile(measurement.target, (n, 1)), prior])
        names = (*self._names, *_PLACE)
        fits = fit(
            d, names, targets, weights, x, friction=False, least=chart.proximal, worth=np.inf
        )
        good = usable & charted(chart, fits, chart.proximal) & np.isfinite(fits.misfits)
        if how.stiffness > 0.0 or self.estimator.readout.passes > 1:
            for i in np.flatnonzero(good).tolist():
                self._weigh(measurement, fits.values[i], weights[i])
        kept = []
        for i in np.flatnonzero(good).tolist():
            one = self._hypotheses[i]
            if self._moved(one, fits, i, weights[i], before[i], prior[i], turn):
                kept.append(one)
        self._hypotheses = kept
        return bool((good & (fits.misfits < self._limit)).any())

    def _weigh(self, measurement: Measurement, value: Array, out: Array) -> bool:
        k = len(self._names)
        weights = np.empty((k, k))
        good = weigh(self.estimator.readout.how, value, measurement.measured, weights)
        out[:k, :k] = weights
        return bool(good)

    def _moved(
        self,
        one: Hypothesis,
        fits: Fits,
        i: int,
        weights: Array,
        before: Array,
        prior: Array,
        turn: Array,
    ) -> bool:
        """Update one hypothesis from its fit; False where that has no covariance."""
        k = len(self._names)
        value, slope = fits.values[i], fits.tangents[i][:, [0, 2, 3]]
        try:
            by_point = np.linalg.inv(slope[3:])  # ∂ξ/∂p
            seen = weights[:k, :k] @ channel_derivatives(value, slope, self._names) @ by_point
            inverse = np.linalg.inv(before)
            after = np.linalg.inv(inverse + seen.T @ seen)
        except np.linalg.LinAlgError:
            return False
        if not np.isfinite(after).all():
            return False
        one.x = fits.contacts[i]
        told = self.estimator.readout.told >= _UNKNOWNS
        if told and not linear(by_point @ after @ by_point.T, one.x):
            one.vague = True
            return True
        ratio = np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]
        one.weight += 0.5 * float(ratio) - 0.5 * float(fits.misfits[i])
        # In the laboratory; G carries what p learns over to v.
        after, inverse = turn @ after @ turn.T, turn @ inverse @ turn.T
        gain = one.spread[:, :3] @ inverse
        kept = np.eye(6)
        kept[:, :3] -= gain @ (np.eye(3) - after @ inverse)
        noise = after - after @ inverse @ after
        b = one.by_stiffness
        if self._stiffness > 0.0:
            wrench = np.concatenate([value[:3], np.cross(value[3:], value[:3])])
            grown = weights[:k, :k] @ channel_gradients(value, self._names) @ wrench
            pushed = after @ (turn @ (seen.T @ grown))
            noise = noise - self._stiffness**2 * np.outer(pushed, pushed)
            b = kept @ b + gain @ pushed
        # What the base's own error adds passes through the same gain.
        through = gain @ (np.eye(3) - after @ inverse)
        spread = kept @ one.spread @ kept.T + gain @ noise @ gain.T
        spread = spread + through @ self._pose @ through.T
        one.mean = one.mean + gain @ (turn @ (value[3:] - prior))
        one.spread, one.by_stiffness = 0.5 * (spread + spread.T), b
        return True

    def _of(self, located: Located) -> Explanations:
        """The candidates of one sample, at most so many, non-dimensional."""
        d, number = self.estimator.contacts.chart.discretization, len(located.candidates)
        some = np.linspace(0, number - 1, min(number, _MOST)).astype(int)
        return Explanations(
            np.column_stack([located.arc_lengths / d.length, located.contact_forces / d.force])[
                some
            ],
            np.column_stack([located.forces / d.force, located.candidates / d.length])[some],
            located.covariances[some] / d.length**2,
            np.full(len(some), located.misfit),
        )

    def _begin(
        self,
        measurement: Measurement,
        found: Explanations,
        turn: Array,
        base: Array,
        *,
        curve: bool = False,
    ) -> None:
        """Start a hypothesis for each candidate that none accounts for."""
        number = len(found.contacts)
        if not number:
            return
        gaps = (
            gaps_between(found.values[:, 3:]) if curve and number > 1 else np.zeros((number, 3, 3))
        )
        before, first = self._hypotheses, not self._hypotheses
        self._hypotheses = [one for one in before if not one.vague]
        for x, value, own, misfit, gap in zip(*found, gaps, strict=True):
            known, by_stiffness = bool(np.isfinite(own).all()), np.zeros(6)
            if known and self._stiffness > 0.0:
                own, by_stiffness[:3] = self._parts(measurement, x, value, turn)
            covariance = bounded(own) if known else VAGUE**2 * np.eye(3)
            covariance = covariance + _FINEST**2 * np.eye(3) + gap
            point = turn @ value[3:] + base
            spread = turn @ covariance @ turn.T + self._pose
            its = [one for one in before if self._accounts(one, point, spread)]
            if any(not one.vague for one in its):
                continue
            vague = not known or (not curve and not self._known_well(measurement, x, value))
            # All places on the map are alike beforehand; its volume is about that of L³.
            weight = 0.5 * float(np.linalg.slogdet(spread)[1]) + 1.5 * math.log(2.0 * math.pi)
            weight += (0.0 if first else self._birth) - 0.5 * float(misfit)
            if its:
                weight = float(np.logaddexp.reduce([one.weight for one in its]))
            whole = np.zeros((6, 6))
            whole[:3, :3] = spread + (VAGUE**2 * np.eye(3) if vague else 0.0)
            whole[3:, 3:] = self._speed**2 * np.eye(3)
            mean = np.concatenate([point, np.zeros(3)])
            self._hypotheses.append(Hypothesis(mean, whole, x, weight, vague, by_stiffness))

    def _known_well(self, measurement: Measurement, x: Array, value: Array) -> bool:
        """Whether noise moves a contact about as its covariance says."""
        d, k = self.estimator.contacts.chart.discretization, len(self._names)
        weights = np.zeros((1, k, k))
        if not weigh(self._quiet, value, measurement.measured, weights[0]):
            return False
        _, slope = solve_forces(d, x[None], tangents=True)
        slope = np.insert(slope, 1, 0.0, axis=2)
        at = (x[None], value[None], slope)
        with np.errstate(over="ignore", invalid="ignore"):
            own = unknowns_covariance(self._names, value[None], slope, weights, friction=False)
            return bool(reliable(d, self._names, weights, *at, own, LEAST_ARC)[0])

    def _parts(
        self, measurement: Measurement, x: Array, value: Array, turn: Array
    ) -> tuple[Array, Array]:
        """Covariance of a contact point by noise alone, and its change with the log stiffness.

        The covariance in the whisker's frame, the change in the laboratory's.
        """
        d, k = self.estimator.contacts.chart.discretization, len(self._names)
        weights = np.zeros((k, k))
        if not weigh(self._quiet, value, measurement.measured, weights):
            return VAGUE**2 * np.eye(3), np.zeros(3)
        _, slope = solve_forces(d, x[None], tangents=True)
        force = np.hypot(x[2], x[3])
        unit = slope[0] * np.array([1.0, force, force])
        back = np.linalg.pinv(weights @ channel_derivatives(value, unit, self._names), rcond=1e-9)
        root = unit[3:] @ back
        wrench = np.concatenate([value[:3], np.cross(value[3:], value[:3])])
        grown = weights @ channel_gradients(value, self._names) @ wrench
        return np.asarray(root @ root.T), np.asarray(turn @ (root @ grown))

    def _accounts(self, one: Hypothesis, point: Array, spread: Array) -> bool:
        away = point - one.mean[:3]
        both = one.total(self._stiffness)[:3, :3] + spread
        return bool(away @ np.linalg.solve(both, away) < _NEW)

    def _tidy(self) -> None:
        """Normalise weights; drop what is improbable, and one of two that have become the same."""
        if not self._hypotheses:
            return
        ranked = sorted(self._hypotheses, key=lambda one: -one.weight)
        best = ranked[0].weight
        kept: list[Hypothesis] = []
        for one in ranked:
            if one.weight < best + math.log(_LEAST) or len(kept) >= _MOST:
                break
            twin = next((other for other in kept if same(one, other)), None)
            if twin is None:
                kept.append(one)
            else:
                twin.weight = float(np.logaddexp(twin.weight, one.weight))
        total = float(np.logaddexp.reduce([one.weight for one in kept]))
        for one in kept:
            one.weight -= total
        self._hypotheses = sorted(kept, key=lambda one: -one.weight)

    def _known(self, status: Status, located: Located | None, turn: Array, base: Array) -> Followed:
        none = np.full(3, np.nan)
        if not self._hypotheses:
            return Followed(
                none,
                np.full((3, 3), np.nan),
                none,
                0.0,
                status,
                np.empty((0, 3)),
                np.empty(0),
                none,
                located,
            )
        best, unit = self._hypotheses[0], self._length
        weights = np.exp([one.weight for one in self._hypotheses])
        weights = weights / weights.sum()
        if status != Status.MISSING:
            status = Status.UNIQUE if weights[0] > _SURE else Status.AMBIGUOUS
        away = np.array([one.mean[:3] for one in self._hypotheses]) - best.mean[:3]
        spreads = [one.total(self._stiffness)[:3, :3] for one in self._hypotheses]
        covariance = np.tensordot(weights, spreads, axes=1) + (away.T * weights) @ away
        return Followed(
            best.mean[:3] * unit,
            covariance * unit**2,
            best.mean[3:] * unit,
            float(weights[0]),
            status,
            np.array([one.mean[:3] for one in self._hypotheses]) * unit,
            weights,
            turn.T @ (best.mean[:3] - base) * unit,
            located,
        )
