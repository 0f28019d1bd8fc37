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

from vibrissa.mapping.beginning import Beginning
from vibrissa.mapping.drift import Drift
from vibrissa.mapping.estimator import Estimator
from vibrissa.mapping.hypotheses import Followed, Hypothesis, tidied, told
from vibrissa.mapping.learning import Learning
from vibrissa.mapping.located import Located
from vibrissa.mapping.readout import Measurement
from vibrissa.rod.arrays import Array
from vibrissa.sensing.sensor import GRAVITY
from vibrissa.status import Status

_UNKNOWNS = 3
# For so many samples after the first it is looked for all that noise may explain.
_YOUNG = 20


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
        self._drift = Drift(speed / self._length, persistence)
        pose = (pose_sigma / self._length) ** 2 * np.eye(3)
        self._learning = Learning(estimator, pose)
        self._beginning = Beginning(estimator, self._drift.speed, pose, math.log(birth))
        self._stiffness = estimator.readout.how.stiffness
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
        self._hypotheses, explains = self._learning(self._hypotheses, measurement, turn, base)
        self._age = self._age + 1 if explains else 0
        located = None
        if self.estimator.readout.told >= _UNKNOWNS or not explains:
            located = self.estimator.locate(measurement)
            self._start(measurement, located, turn, base)
        self._hypotheses = tidied(self._hypotheses)
        status = Status.AMBIGUOUS if located is None else located.status
        return self._known(status, located, turn, base)

    def _start(self, measurement: Measurement, located: Located, turn: Array, base: Array) -> None:
        """Start hypotheses from what one sample tells."""
        curve = located.status == Status.UNDERDETERMINED
        if not curve and self._age <= _YOUNG and self.estimator.readout.told >= _UNKNOWNS:
            found = self.estimator.explanations(measurement)
        elif curve or located.status in (Status.UNIQUE, Status.AMBIGUOUS):
            found = self._beginning.candidates(located)
        else:
            return
        self._hypotheses = self._beginning(
            self._hypotheses, measurement, found, turn, base, curve=curve
        )

    def _predict(self, step: float) -> None:
        by, noise = self._drift.over(step)
        for one in self._hypotheses:
            one.mean = by @ one.mean
            one.spread = by @ one.spread @ by.T + noise
            one.by_stiffness = by @ one.by_stiffness

    def _known(self, status: Status, located: Located | None, turn: Array, base: Array) -> Followed:
        return told(self._hypotheses, self._stiffness, status, located, turn, base, self._length)
