"""Where contacts that explain one measurement lie: exactly, by least squares, or a whole set."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts import locating
from vibrissa.contacts.ambiguity import Ambiguity
from vibrissa.contacts.explaining import explain
from vibrissa.contacts.explanation import why_none
from vibrissa.contacts.inversion import MOST_CANDIDATES
from vibrissa.contacts.located import Located, nowhere
from vibrissa.contacts.locating import COLUMNS, Trail, meet
from vibrissa.contacts.posterior import CERTAIN
from vibrissa.contacts.readout import Measurement, Mixed, Named, independent
from vibrissa.contacts.whitening import explained
from vibrissa.numerics import Array
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

_UNKNOWNS = 3
_STATUSES = {int(status): status for status in Status}


class ExactSearch:
    """All contacts that give three signals exactly."""

    def __init__(self, contact_map: ContactMap, readout: Named) -> None:
        self._contact_map, self._readout, self._trail = contact_map, readout, Trail.new()
        self._limit = explained(independent(contact_map, readout) - _UNKNOWNS)

    def forget(self) -> None:
        """Begin anew, as when the whisker has lost touch."""
        self._trail.number[0] = 0

    def __call__(self, measurement: Measurement) -> Located:
        """Search in the whole map."""
        readout, found = self._readout, np.empty((MOST_CANDIDATES, COLUMNS))
        probability = np.full((1, MOST_CANDIDATES), np.nan)
        if readout.nothing(measurement) or readout.beyond(measurement):
            self.forget()
            return self._none(measurement)
        number, continuing, misfit, valid = meet(
            readout.searched,
            readout.how,
            readout.noisy,
            readout.passes,
            self._limit,
            measurement.target,
            measurement.measured,
            self._trail,
            found,
            probability,
        )
        if not number:
            return self._none(measurement)
        sure = probability[0, 0] > CERTAIN if readout.noisy else number == 1
        status = Status.UNIQUE if sure else Status.AMBIGUOUS
        if not misfit <= self._limit:
            status = self._none(measurement).status
        return _located(found[:number], probability[0], status, misfit, continuing, valid)

    def _none(self, measurement: Measurement) -> Located:
        """Say why there is no contact."""
        measured = measurement.measured[None]
        why, misfit = why_none(self._contact_map, self._readout.names, measured)
        return nowhere(_STATUSES[int(why[0])], float(misfit[0]))


class LeastSquaresSearch:
    """The contacts that explain more than three signals, or a mix, best."""

    def __init__(self, contact_map: ContactMap, readout: Named | Mixed) -> None:
        self._readout, self._trail = readout, Trail.new()
        self._limit = explained(independent(contact_map, readout) - _UNKNOWNS)

    def forget(self) -> None:
        """Begin anew, as when the whisker has lost touch."""
        self._trail.number[0] = 0

    def __call__(self, measurement: Measurement) -> Located:
        """Search from the contacts that three quantities give, then from everywhere."""
        readout = self._readout
        if readout.nothing(measurement):
            self.forget()
            return nowhere(Status.DEGENERATE)
        if readout.beyond(measurement):
            self.forget()
            return nowhere(Status.OUTSIDE_MAP)
        found = np.empty((MOST_CANDIDATES, COLUMNS))
        probability = np.full((1, MOST_CANDIDATES), np.nan)
        number, status, continuing, misfit, valid = explain(
            readout.searched,
            readout.how,
            readout.noisy,
            readout.passes,
            self._limit,
            measurement.target,
            measurement.measured,
            self._trail,
            found,
            probability,
        )
        if not number:
            return nowhere(_STATUSES[status])
        return _located(
            found[:number], probability[0], _STATUSES[status], misfit, continuing, valid
        )


class SetSearch:
    """Samples of the curve or surface of contacts that explain fewer than three signals."""

    def __init__(self, contact_map: ContactMap, readout: Named | Mixed) -> None:
        self._ambiguity = Ambiguity(contact_map.chart, readout)
        self._readout = readout

    def forget(self) -> None:
        """Nothing goes on from a whole set."""

    def __call__(self, measurement: Measurement) -> Located:
        """Search in the whole map."""
        readout = self._readout
        if readout.nothing(measurement):
            return nowhere(Status.DEGENERATE)
        found, middle, covariance = self._ambiguity.samples(measurement)
        if not len(found):
            beyond = readout.beyond(measurement)
            return nowhere(Status.OUTSIDE_MAP if beyond else Status.NOT_FRICTIONLESS)
        if not readout.noisy:
            covariance[:], found[:, locating.COVARIANCE :] = np.nan, np.nan
        unknown = np.full(len(found), np.nan)
        located = _located(found, unknown, Status.UNDERDETERMINED, 0.0, middle, False)
        return located._replace(point=located.candidates[middle], covariance=covariance)


def _located(
    found: Array,
    probability: Array,
    status: Status,
    misfit: float,
    continuing: int,
    valid: bool,
) -> Located:
    """Tell candidates, see :mod:`~vibrissa.contacts.locating`, in their order."""
    points = found[:, : locating.ARC]
    covariances = found[:, locating.COVARIANCE :].reshape(-1, 3, 3)
    return Located(
        points[0],
        status,
        points,
        found[:, locating.ARC],
        covariances[0],
        misfit,
        continuing,
        found[:, locating.FORCE : locating.COVARIANCE],
        covariances,
        found[:, locating.CONTACT_FORCE : locating.FORCE],
        probability[: len(found)],
        valid,
    )
