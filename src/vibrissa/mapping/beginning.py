"""Hypotheses about a contact that begin: what one measurement tells, and none accounts for yet."""

from __future__ import annotations

import math

import numpy as np

from vibrissa.mapping.channels import CHANNELS, channel_derivatives, channel_gradients
from vibrissa.mapping.estimator import Estimator
from vibrissa.mapping.hypotheses import MOST, VAGUE, Hypothesis, bounded, gaps_between
from vibrissa.mapping.located import Explanations, Located
from vibrissa.mapping.minima import reliable, unknowns_covariance
from vibrissa.mapping.readout import Measurement
from vibrissa.mapping.weighing import weigh
from vibrissa.rod.arrays import Array
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.reach import LEAST_ARC

# A candidate so far (the same) from every hypothesis is a new one.
_NEW = 16.0
# Smallest standard deviation of a starting hypothesis, over L, so that matrices stay regular.
_FINEST = 1e-7


class Beginning:
    """Starts hypotheses.

    Parameters
    ----------
    estimator : Estimator
        Of single samples; it knows the noise.
    speed : float
        Standard deviation of a component of the contact point's velocity, L/s.
    pose : (3, 3) array
        Covariance of the base's position, in L².
    birth : float
        Logarithm of the probability that a sample shows another contact than any before.
    """

    def __init__(self, estimator: Estimator, speed: float, pose: Array, birth: float) -> None:
        self._discretization = estimator.contacts.chart.discretization
        self._speed, self._pose, self._birth = speed, pose, birth
        how = estimator.readout.how
        self._names = tuple(CHANNELS[code] for code in how.codes)
        self._stiffness = how.stiffness
        # Noise alone, which differs from sample to sample.
        self._quiet = how._replace(stiffness=0.0)

    def candidates(self, located: Located) -> Explanations:
        """The candidates of one sample, at most so many, non-dimensional."""
        d, number = self._discretization, len(located.candidates)
        some = np.linspace(0, number - 1, min(number, MOST)).astype(int)
        return Explanations(
            np.column_stack([located.arc_lengths / d.length, located.contact_forces / d.force])[
                some
            ],
            np.column_stack([located.forces / d.force, located.candidates / d.length])[some],
            located.covariances[some] / d.length**2,
            np.full(len(some), located.misfit),
        )

    def __call__(
        self,
        before: list[Hypothesis],
        measurement: Measurement,
        found: Explanations,
        turn: Array,
        base: Array,
        *,
        curve: bool = False,
    ) -> list[Hypothesis]:
        """Start a hypothesis for each candidate that none accounts for.

        Parameters
        ----------
        before : list of Hypothesis
            Those there are.
        measurement : Measurement
            That the candidates explain.
        found : Explanations
            The candidates.
        turn, base : (3, 3), (3,) arrays
            Pose of the base, in L.
        curve : bool
            Whether they are samples of a curve or surface.

        Returns
        -------
        list of Hypothesis
            Those before, but for vague ones, and the new ones.
        """
        number = len(found.contacts)
        if not number:
            return before
        gaps = (
            gaps_between(found.values[:, 3:]) if curve and number > 1 else np.zeros((number, 3, 3))
        )
        first = not before
        out = [one for one in before if not one.vague]
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
            out.append(Hypothesis(mean, whole, x, weight, vague, by_stiffness))
        return out

    def _known_well(self, measurement: Measurement, x: Array, value: Array) -> bool:
        """Whether noise moves a contact about as its covariance says."""
        d, k = self._discretization, len(self._names)
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
        d, k = self._discretization, len(self._names)
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
