"""Contacts of a whisker whose base turns by an uncertain angle for a moment.

The compliance of the base is known to standard deviations, in bending and in twist: two unknowns
c ~ N(0, 1) more, which move base signals and contact point, to first order, by the difference that
one standard deviation makes. With r the residual and J, N the derivatives of the channels by
contact and compliance, weighted, the contact of least |r + J δx + N c|² + |c|² is found by Gauss's
and Newton's method from the one that the stated whisker gives. Signals that determine no more than
the contact leave it where it is, and its covariance takes up what c may move.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.channels import (
    CHANNELS,
    CIRCULAR,
    Channels,
    channel_derivatives,
    channels_of,
)
from vibrissa.contacts.contacts import Candidates
from vibrissa.contacts.noise import SensorNoise, explained, rank, whitening
from vibrissa.contacts.posterior import CERTAIN
from vibrissa.numerics import Array, IntArray
from vibrissa.rod import Discretization, discretize, solve_forces
from vibrissa.signals import within_turn
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

_ROUNDS = 4
_LONGEST = 0.05
# A rigid base is one so much stiffer than the whisker.
_RIGID = 1e9
_STEP = 1e-5
_MISFITS = (int(Status.NOT_FRICTIONLESS), int(Status.NOT_ONE_CONTACT))


def check_compliance(sigma: float, sensor: SensorNoise | None) -> None:
    """Refuse what is not a standard deviation, or one without noise to weigh it against."""
    if not 0.0 <= sigma < np.inf:
        raise ValueError(
            f"compliance_sigma is a standard deviation, rad/(N·m), not negative; got {sigma!r}"
        )
    if sigma > 0.0 and sensor is None:
        raise ValueError(
            "the uncertainty of the base's compliance adds to that of a sensor: give its noise"
        )


@lru_cache(maxsize=8)
def _softened(whisker: Whisker, steps: int, sigma: float) -> tuple[Discretization, ...]:
    """The whisker on a base softer by one standard deviation in bending, and in twist."""
    stiff = _RIGID * whisker.base_bending_stiffness / whisker.length
    soft = 1.0 / np.array(whisker.base_stiffness or (stiff, stiff))
    bases = (1.0 / (soft + sigma * axis) for axis in np.eye(2))
    return tuple(
        discretize(whisker.with_properties(base_stiffness=(float(b), float(t))), steps)
        for b, t in bases
    )


class SoftBase:
    """The uncertain compliance of a whisker's base, and the signals that contacts are found from.

    Parameters
    ----------
    whisker : Whisker
        Whisker.
    discretization : Discretization
        Rod.
    steps : int
        Steps along the whisker.
    channels : Channels
        Channels that contacts are fitted to.
    sensor : SensorNoise
        Noise.
    sigma : float
        Standard deviation of the compliance in bending and in twist, rad/(N·m).
    friction : bool
        Whether the force along the whisker is an unknown.
    """

    def __init__(
        self,
        whisker: Whisker,
        discretization: Discretization,
        steps: int,
        channels: Channels,
        sensor: SensorNoise,
        sigma: float,
        friction: bool = False,
    ) -> None:
        self.d, self.channels, self.sensor = discretization, channels, sensor
        self.softer = _softened(whisker, steps, sigma)
        self.free = [0, 1, 2, 3] if friction else [0, 2, 3]
        self._turned = np.array([CIRCULAR[CHANNELS.index(name)] for name in channels.names])

    def allow(
        self, flat: Array, targets: Array, found: Candidates, status: IntArray
    ) -> tuple[Candidates, IntArray, Array]:
        """Candidates with what the compliance moves, their statuses, and χ² of the first.

        Parameters
        ----------
        flat, targets : (n, k) arrays
            Measured signals and their channels, non-dimensional.
        found : Candidates
            Contacts of the stated whisker.
        status : (n,) array
            Statuses of the contacts.

        Returns
        -------
        tuple
            Candidates, statuses and χ² (n,).
        """
        there = np.arange(found.x.shape[1]) < found.number[:, None]
        row, place = np.nonzero(there)
        out = found.allowed_first(there)  # a copy
        if row.size:
            x, values, more, chi_squared = self._fitted(flat[row], targets[row], out.x[row, place])
            out.x[row, place], out.values[row, place] = x, values
            out.covariances[row, place] += more
            out.chi_squared[row, place] = chi_squared
        first = out.chi_squared[:, 0]
        degrees = len(self._turned) - len(self.free)
        if row.size and degrees > 0:
            sigma = self.channels.covariance(self.sensor, flat[row[:1]], values[:1], self.d)
            degrees = rank(sigma[0]) - len(self.free)
        better = np.isin(status, _MISFITS) & (found.number > 0) & (first <= explained(degrees))
        sure = (out.probability[:, 0] > CERTAIN) | (found.number == 1)
        known = np.where(sure, int(Status.UNIQUE), int(Status.AMBIGUOUS))
        return out, np.where(better, known, status), first.copy()

    def _fitted(self, flat: Array, targets: Array, x: Array) -> tuple[Array, Array, Array, Array]:
        """Contacts, (F, p), what is added to covariances, and χ²."""
        c = np.zeros((len(x), len(self.softer)))
        for _ in range(_ROUNDS):
            values, slopes, moved = self._model(x, c)
            residual, design = self._weighed(flat, targets, values, slopes, moved)
            whole = np.concatenate([residual, -c], axis=1)
            step = (np.linalg.pinv(design, rcond=1e-12) @ whole[..., None])[..., 0]
            n = len(self.free)
            step /= np.maximum(1.0, np.abs(step[:, :1]) / _LONGEST)
            x = x.copy()
            x[:, self.free] += step[:, :n]
            x[:, 0] = np.minimum(x[:, 0], 1.0)
            c = c + step[:, n:]
        values, slopes, moved = self._model(x, c)
        residual, design = self._weighed(flat, targets, values, slopes, moved)
        k = residual.shape[1]
        whole = np.linalg.pinv(design, rcond=1e-12)
        alone = np.linalg.pinv(design[:, :k, : len(self.free)], rcond=1e-12)
        by_all = np.concatenate([slopes, moved], axis=2)[:, 3:] @ whole
        by_contact = slopes[:, 3:] @ alone
        more = by_all @ np.swapaxes(by_all, 1, 2) - by_contact @ np.swapaxes(by_contact, 1, 2)
        return x, values, more, (residual**2).sum(axis=1) + (c**2).sum(axis=1)

    def _model(self, x: Array, c: Array) -> tuple[Array, Array, Array]:
        """(F, p) (n, 6), and derivatives by contact (n, 6, free) and compliance (n, 6, 2)."""
        values, exact = solve_forces(self.d, x, tangents=True)
        slopes = np.zeros((len(x), 6, 4))
        slopes[..., [0, 2, 3]] = exact
        if 1 in self.free:
            step = _STEP * np.linalg.norm(x[:, 1:], axis=1)
            ahead = x.copy()
            ahead[:, 1] += step
            slopes[..., 1] = (solve_forces(self.d, ahead)[0] - values) / step[:, None]
        softer = [solve_forces(d, x)[0] - values for d in self.softer]
        moved = np.stack(softer, axis=2)
        return values + np.einsum("nak,nk->na", moved, c), slopes[..., self.free], moved

    def _weighed(
        self, flat: Array, targets: Array, values: Array, slopes: Array, moved: Array
    ) -> tuple[Array, Array]:
        """Residuals (n, k) of the channels, and the design with the prior of the compliance."""
        weights = whitening(self.channels.covariance(self.sensor, flat, values, self.d))
        which = [CHANNELS.index(name) for name in self.channels.names]
        away = within_turn(targets - channels_of(values)[:, which], self._turned)
        both = np.concatenate([slopes, moved], axis=2)
        design = np.nan_to_num(weights @ channel_derivatives(values, both, self.channels.names))
        prior = np.zeros((len(flat), moved.shape[2], both.shape[2]))
        prior[:, :, slopes.shape[2] :] = np.eye(moved.shape[2])
        residual = np.nan_to_num(np.einsum("nij,nj->ni", weights, away))
        return residual, np.concatenate([design, prior], axis=1)
