"""What was found for one measurement, in SI units and with covariances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.mapping.ambiguity import Samples
from vibrissa.mapping.located import Located
from vibrissa.mapping.readout import Measurement, Mixed, Named
from vibrissa.mapping.single_fits import with_normal_force
from vibrissa.mapping.trail import Trail
from vibrissa.mapping.uncertainty import point_covariances
from vibrissa.mapping.weighing import spread
from vibrissa.rod.arrays import Array
from vibrissa.rod.kernels import evaluate
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap


class Answers:
    """Makes :class:`Located` of what a search has found, and keeps the trail.

    Parameters
    ----------
    contacts : ContactMap
        The map.
    readout : Named or Mixed
        What is measured.
    noisy : bool
        Whether noise is known, so that there are covariances.
    trail : Trail
        The contact followed so far.
    """

    def __init__(
        self, contacts: ContactMap, readout: Named | Mixed, noisy: bool, trail: Trail
    ) -> None:
        self._d = contacts.chart.discretization
        self._readout, self._noisy, self._trail = readout, noisy, trail

    def nowhere(self, status: Status, misfit: float = np.nan) -> Located:
        """Say why there is no contact, and forget the trail."""
        self._trail.forget()
        none = np.full(3, np.nan)
        return Located(
            none,
            status,
            np.empty((0, 3)),
            np.empty(0),
            np.full((3, 3), np.nan),
            misfit,
            0,
            np.empty((0, 3)),
            np.empty((0, 3, 3)),
            np.empty((0, 3)),
        )

    def candidates(
        self,
        measurement: Measurement,
        xi: Array,
        values: Array,
        status: Status,
        misfit: float,
        tangents: Array | None = None,
    ) -> Located:
        """Tell candidates in their order, and remember which goes on from the one before.

        Parameters
        ----------
        measurement : Measurement
            That they explain.
        xi, values : (n, 3), (n, 6) arrays
            ξ and (F, p).
        status : Status
            What is to be said.
        misfit : float
            χ² of the first.
        tangents : (n, 6, 3) array, optional
            ∂(F, p)/∂ξ, where they are known.

        Returns
        -------
        Located
            In SI units.
        """
        d = self._d
        continuing = self._trail.go_on(xi, values)
        points = values[:, 3:] * d.length
        covariances = self._covariances(measurement, xi, values, tangents)
        return Located(
            points[0],
            status,
            points,
            xi[:, 0] * d.length,
            covariances[0],
            misfit,
            continuing,
            values[:, :3] * d.force,
            covariances,
            with_normal_force(xi)[:, 1:] * d.force,
        )

    def samples(self, found: Samples) -> Located:
        """Tell samples of a curve or surface of contacts; nothing goes on from them."""
        self._trail.forget()
        d = self._d
        points = found.values[:, 3:] * d.length
        middle = int(np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
        away = points - points[middle]
        local = found.covariances * d.length**2
        covariance = away.T @ away / len(points) + local.mean(axis=0)
        return Located(
            points[middle],
            Status.UNDERDETERMINED,
            points,
            found.contacts[:, 0] * d.length,
            covariance if self._noisy else np.full((3, 3), np.nan),
            0.0,
            middle,
            found.values[:, :3] * d.force,
            local if self._noisy else np.full_like(local, np.nan),
            found.contacts[:, 1:] * d.force,
        )

    def _covariances(
        self, measurement: Measurement, xi: Array, values: Array, tangents: Array | None
    ) -> Array:
        """Of candidates, m²."""
        n, d, readout = len(xi), self._d, self._readout
        out = np.full((n, 3, 3), np.nan)
        if not self._noisy:
            return out
        if tangents is None:
            tangents = np.empty((n, 6, 3))
            evaluate(d.rod, with_normal_force(xi), np.empty((n, 6)), tangents, 0, n)
        if not spread(readout.how, measurement.measured, xi, values, tangents, out):
            assert isinstance(readout, Named)
            assert readout.sensor is not None
            out = point_covariances(d, readout.names, xi, readout.sensor)[0]
        return out * d.length**2
