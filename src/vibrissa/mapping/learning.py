"""What hypotheses about a contact learn from one measurement.

A measurement moves p to where χ² of the signals and of p - p_predicted together is least, with the
exact rod in between. Each hypothesis is weighed by how well it predicted (Laplace's approximation),

    log w ← log w - χ²/2 + ½ log(det P_after / det P_before).

An uncertain stiffness is the same error in all samples, which no averaging removes: how the state
depends on it, b = ∂(p, v)/∂log(EI), is carried along, and σ²bbᵀ is part of the covariance (a
"consider" parameter, as Schmidt had it).
"""

from __future__ import annotations

import math

import numpy as np

from vibrissa.mapping.channels import CHANNELS, channel_derivatives, channel_gradients
from vibrissa.mapping.estimator import Estimator
from vibrissa.mapping.fitting import Fits, charted, fit
from vibrissa.mapping.hypotheses import LEAST, Hypothesis, linear
from vibrissa.mapping.readout import Measurement
from vibrissa.mapping.weighing import weigh
from vibrissa.mapping.whitening import explained
from vibrissa.rod.arrays import Array
from vibrissa.rod.batch import solve_forces

_UNKNOWNS = 3
_PLACE = ("px", "py", "pz")


class Learning:
    """Moves hypotheses to where measurement and prediction agree best.

    Parameters
    ----------
    estimator : Estimator
        Of single samples; it knows the noise.
    pose : (3, 3) array
        Covariance of the base's position, in L².
    """

    def __init__(self, estimator: Estimator, pose: Array) -> None:
        self._readout, self._chart = estimator.readout, estimator.contacts.chart
        self._pose = pose
        how = estimator.readout.how
        self._names = tuple(CHANNELS[code] for code in how.codes)
        self._limit = explained(len(how.own))

    def __call__(
        self, hypotheses: list[Hypothesis], measurement: Measurement, turn: Array, base: Array
    ) -> tuple[list[Hypothesis], bool]:
        """Update hypotheses.

        Parameters
        ----------
        hypotheses : list of Hypothesis
            As predicted; changed.
        measurement : Measurement
            That is not empty.
        turn, base : (3, 3), (3,) arrays
            Pose of the base, in L.

        Returns
        -------
        hypotheses : list of Hypothesis
            Those that can still be; vague ones as they were.
        explained : bool
            Whether any of them explains the measurement.
        """
        vague = [one for one in hypotheses if one.vague]
        placed = [one for one in hypotheses if not one.vague]
        share = math.fsum(math.exp(one.weight) for one in vague)
        explains = False
        if placed:
            placed, explains = self._fitted(placed, measurement, turn, base)
        if placed and vague:
            total = float(np.logaddexp.reduce([one.weight for one in placed]))
            for one in placed:
                one.weight += math.log(max(1.0 - share, LEAST)) - total
        return placed + vague, explains

    def _fitted(
        self, hypotheses: list[Hypothesis], measurement: Measurement, turn: Array, base: Array
    ) -> tuple[list[Hypothesis], bool]:
        """Update all hypotheses, none of them vague; whether any explains the measurement."""
        how, chart = self._readout.how, self._chart
        d, k, n = chart.discretization, len(self._names), len(hypotheses)
        prior = np.empty((n, 3))
        before = np.empty((n, 3, 3))
        weights = np.zeros((n, k + 3, k + 3))
        x = np.array([one.x for one in hypotheses])
        for i, one in enumerate(hypotheses):
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
        if how.stiffness > 0.0 or self._readout.passes > 1:
            for i in np.flatnonzero(good).tolist():
                self._weigh(measurement, fits.values[i], weights[i])
        kept = []
        for i in np.flatnonzero(good).tolist():
            one = hypotheses[i]
            if self._moved(one, fits, i, weights[i], before[i], prior[i], turn):
                kept.append(one)
        return kept, bool((good & (fits.misfits < self._limit)).any())

    def _weigh(self, measurement: Measurement, value: Array, out: Array) -> bool:
        k = len(self._names)
        weights = np.empty((k, k))
        good = weigh(self._readout.how, value, measurement.measured, weights)
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
        k, stiffness = len(self._names), self._readout.how.stiffness
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
        told = self._readout.told >= _UNKNOWNS
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
        if stiffness > 0.0:
            wrench = np.concatenate([value[:3], np.cross(value[3:], value[:3])])
            grown = weights[:k, :k] @ channel_gradients(value, self._names) @ wrench
            pushed = after @ (turn @ (seen.T @ grown))
            noise = noise - stiffness**2 * np.outer(pushed, pushed)
            b = kept @ b + gain @ pushed
        # What the base's own error adds passes through the same gain.
        through = gain @ (np.eye(3) - after @ inverse)
        spread = kept @ one.spread @ kept.T + gain @ noise @ gain.T
        spread = spread + through @ self._pose @ through.T
        one.mean = one.mean + gain @ (turn @ (value[3:] - prior))
        one.spread, one.by_stiffness = 0.5 * (spread + spread.T), b
        return True
