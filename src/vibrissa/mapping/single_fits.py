"""Fits of one measurement, and all contacts that noise may explain it by."""

from __future__ import annotations

import numpy as np

from vibrissa.mapping.fitting import Fits
from vibrissa.mapping.located import Explanations
from vibrissa.mapping.readout import Measurement, Mixed, Named
from vibrissa.mapping.weighing import explain, spread
from vibrissa.mapping.whitening import INDISTINCT, explained
from vibrissa.rod.arrays import AnyArray, Array
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.reach import Reach

#: Unknowns of a contact without friction, among all.
FREE = [0, 2, 3]
# Fits end within this (over L, and relative to the force) of a minimum that a fold makes flat.
_FLAT = 0.02


class SingleFits:
    """Fits one measurement at a time.

    Parameters
    ----------
    chart : Reach
        The whisker's stable contacts.
    readout : Named or Mixed
        What is measured.
    limit : float
        Largest χ² of what counts as explained.
    """

    def __init__(self, chart: Reach, readout: Named | Mixed, limit: float) -> None:
        self._chart, self._readout, self.limit = chart, readout, limit

    def __call__(
        self, measurement: Measurement, starts: Array, values: Array | None = None
    ) -> tuple[Fits, AnyArray]:
        """Fit from some starts.

        Parameters
        ----------
        measurement : Measurement
            Of three signals or more.
        starts : (n, 3) array
            ξ.
        values : (n, 6) array, optional
            (F, p) there, where it is known.

        Returns
        -------
        fits : Fits
            One for each start.
        inside : (n,) bool array
            Which of them are stable contacts on the map.
        """
        n, chart, readout = len(starts), self._chart, self._readout
        x = with_normal_force(starts)
        if values is None:
            values, _ = solve_forces(chart.discretization, x)
        fits = Fits(
            x, np.array(values), np.zeros((n, 6, 4)), np.full(n, np.inf), np.ones(n, np.bool_)
        )
        inside = np.zeros(n, np.bool_)
        explain(
            chart.discretization.rod,
            chart.fold,
            chart.proximal,
            readout.how,
            measurement.target,
            measurement.measured,
            readout.passes,
            self.limit + INDISTINCT,
            fits.contacts,
            fits.values,
            fits.tangents,
            fits.misfits,
            inside,
        )
        return fits, inside

    def everywhere(self, measurement: Measurement) -> tuple[Fits, AnyArray]:
        """Fit from the nodes of all parts of the map that come nearest; as for calling."""
        nodes = self._readout.nearest(measurement)
        return self(measurement, self._chart.contacts.reshape(-1, 3)[nodes])

    def explanations(self, measurement: Measurement) -> Explanations:
        """All minima of χ² that noise may explain: also those that miss the measurement a little.

        Three signals with noise may lie where no contact is, just across a fold from the true one.

        Parameters
        ----------
        measurement : Measurement
            Of three signals or more.

        Returns
        -------
        Explanations
            Found from all parts of the map; a millisecond.
        """
        readout = self._readout
        nodes = readout.nearest(measurement)
        exact, _ = readout.seeds(measurement)
        starts = np.concatenate([exact, self._chart.contacts.reshape(-1, 3)[nodes]])
        fits, inside = self(measurement, starts)
        limit = explained(len(readout.how.own))
        kept: list[int] = []
        for row in np.argsort(fits.misfits).tolist():
            x = fits.contacts[row]
            good = inside[row] and fits.misfits[row] <= limit
            if good and not any(_close(x, fits.contacts[other]) for other in kept):
                kept.append(row)
        some = Fits(*(part[kept] for part in fits))
        covariances = np.full((len(kept), 3, 3), np.nan)
        spread(
            readout.how,
            measurement.measured,
            some.contacts[:, FREE],
            some.values,
            some.tangents[:, :, FREE],
            covariances,
        )
        return Explanations(some.contacts, some.values, covariances, some.misfits)


def with_normal_force(xi: Array) -> Array:
    """(s, f_y, f_z) (n, 3) as (s, 0, f_y, f_z) (n, 4), for few rows."""
    out = np.zeros((len(xi), 4))
    out[:, FREE] = xi
    return out


def _close(a: Array, b: Array) -> bool:
    """Whether two minima are one: where a fold makes them flat, fits end a little apart."""
    force = max(float(np.hypot(a[2], a[3])), float(np.hypot(b[2], b[3])))
    apart = float(np.hypot(a[2] - b[2], a[3] - b[3]))
    return abs(float(a[0] - b[0])) < _FLAT and apart < _FLAT * force
