"""Where contacts that explain one measurement lie: exactly, by least squares, or a whole set."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.mapping.ambiguity import Ambiguity
from vibrissa.mapping.answers import Answers
from vibrissa.mapping.explanation import why_none
from vibrissa.mapping.fitting import Fits, charted
from vibrissa.mapping.inversion import polish
from vibrissa.mapping.least_squares import by_doubt
from vibrissa.mapping.located import Located
from vibrissa.mapping.minima import same
from vibrissa.mapping.readout import Measurement, Mixed, Named
from vibrissa.mapping.single_fits import FREE, SingleFits
from vibrissa.mapping.trail import Trail
from vibrissa.mapping.whitening import INDISTINCT
from vibrissa.rod.arrays import AnyArray, Array
from vibrissa.rod.newton import ROUNDING, TOLERANCE
from vibrissa.rod.reach import LEAST_ARC
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap


class ExactSearch:
    """All contacts that give three signals exactly.

    Parameters
    ----------
    contacts : ContactMap
        The map.
    readout : Named
        The three signals.
    answers : Answers
        Makes the answer.
    trail : Trail
        The contact followed so far: one more place to start from.
    """

    def __init__(
        self, contacts: ContactMap, readout: Named, answers: Answers, trail: Trail
    ) -> None:
        self._contacts, self._readout = contacts, readout
        self._answers, self._trail = answers, trail

    def __call__(self, measurement: Measurement) -> Located:
        """Search in the whole map."""
        xi, values = self._readout.seeds(measurement)
        if len(xi) < self._trail.number and not self._trail.near(values):
            xi, values = self._followed(measurement.measured[None], xi, values)
        if not len(xi):
            names = self._readout.names
            why, misfit = why_none(self._contacts, names, measurement.measured[None])
            return self._answers.nowhere(Status(int(why[0])), float(misfit[0]))
        status = Status.UNIQUE if len(xi) == 1 else Status.AMBIGUOUS
        return self._answers.candidates(measurement, xi, values, status, 0.0)

    def _followed(self, targets: Array, xi: Array, values: Array) -> tuple[Array, Array]:
        """Add the contact that goes on from the last one, should the search have missed it."""
        assert self._trail.last is not None
        chart = self._contacts.chart
        start = self._trail.last[0][None]
        at, value, residual, sign = polish(chart, self._readout.names, targets, start)
        new = residual[0] <= TOLERANCE and sign[0] > 0.0 and at[0, 0] >= chart.proximal
        if not new or not self._trail.near(value):
            return xi, values
        xi, values = np.concatenate([xi, at]), np.concatenate([values, value])
        order = np.argsort(np.hypot(xi[:, 1], xi[:, 2]))
        return xi[order], values[order]


class LeastSquaresSearch:
    """The contacts that explain more than three signals, or a mix, best.

    Parameters
    ----------
    contacts : ContactMap
        The map.
    readout : Named or Mixed
        What is measured.
    fits : SingleFits
        Fits a measurement.
    answers : Answers
        Makes the answer.
    trail : Trail
        The contact followed so far: one more place to start from.
    """

    def __init__(
        self,
        contacts: ContactMap,
        readout: Named | Mixed,
        fits: SingleFits,
        answers: Answers,
        trail: Trail,
    ) -> None:
        self._chart, self._readout, self._fits = contacts.chart, readout, fits
        self._answers, self._trail = answers, trail

    def __call__(self, measurement: Measurement) -> Located:
        """Search from the contacts that three signals give, then from everywhere."""
        if self._readout.nothing(measurement):
            return self._answers.nowhere(Status.DEGENERATE)
        if self._readout.beyond(measurement):
            return self._answers.nowhere(Status.OUTSIDE_MAP)
        limit = self._fits.limit
        fits, inside = self._fits(measurement, *self._starts(measurement))
        if not (inside & (fits.misfits <= limit)).any():
            others, there = self._fits.everywhere(measurement)
            fits = Fits(*(np.concatenate(pair) for pair in zip(fits, others, strict=True)))
            inside = np.concatenate([inside, there])
        good = fits.misfits <= limit
        if (inside & good).any():
            return self._chosen(measurement, _those(fits, inside))
        return self._unexplained(measurement, fits, inside, good)

    def _starts(self, measurement: Measurement) -> tuple[Array, Array | None]:
        """ξ of contacts to start from, with (F, p) where it is known."""
        starts, values = self._readout.seeds(measurement)
        last = self._trail.last
        if last is not None and not (values is not None and self._trail.near(values)):
            starts = np.concatenate([starts, last[0][None]])
            if values is not None:
                values = np.concatenate([values, last[1][None]])
        return starts, values

    def _unexplained(
        self, measurement: Measurement, fits: Fits, inside: AnyArray, good: AnyArray
    ) -> Located:
        """The contact that comes nearest, and why none explains the measurement."""
        nearer = charted(self._chart, fits, LEAST_ARC + ROUNDING) & ~inside & good
        status = Status.OUTSIDE_MAP if nearer.any() else Status.NOT_FRICTIONLESS
        if not inside.any():
            return self._answers.nowhere(status)
        best = [int(np.argmin(np.where(inside, fits.misfits, np.inf)))]
        xi, misfit = fits.contacts[best][:, FREE], float(fits.misfits[best[0]])
        return self._answers.candidates(measurement, xi, fits.values[best], status, misfit)

    def _chosen(self, measurement: Measurement, fits: Fits) -> Located:
        """The same choice as in a batch, of few fits."""
        misfits = fits.misfits.tolist()
        most = min(min(misfits) + INDISTINCT, self._fits.limit)
        kept: list[int] = []
        order = [0] if len(misfits) == 1 else np.argsort(by_doubt(fits)).tolist()
        for row in order:
            if misfits[row] <= most and not any(
                same(fits.contacts[row], fits.contacts[other]) for other in kept
            ):
                kept.append(row)
        status = Status.UNIQUE if len(kept) == 1 else Status.AMBIGUOUS
        first = kept[0]
        which = slice(first, first + 1) if len(kept) == 1 else kept
        some = Fits(*(part[which] for part in fits))
        return self._answers.candidates(
            measurement,
            some.contacts[:, FREE],
            some.values,
            status,
            misfits[first],
            some.tangents[:, :, FREE],
        )


class SetSearch:
    """Samples of the curve or surface of contacts that explain fewer than three signals.

    Parameters
    ----------
    contacts : ContactMap
        The map.
    readout : Named or Mixed
        What is measured.
    answers : Answers
        Makes the answer.
    """

    def __init__(self, contacts: ContactMap, readout: Named | Mixed, answers: Answers) -> None:
        self._ambiguity = Ambiguity(contacts.chart, readout)
        self._readout, self._answers = readout, answers

    def __call__(self, measurement: Measurement) -> Located:
        """Search in the whole map."""
        if self._readout.nothing(measurement):
            return self._answers.nowhere(Status.DEGENERATE)
        found = self._ambiguity.samples(measurement)
        if len(found.contacts):
            return self._answers.samples(found)
        beyond = self._readout.beyond(measurement)
        return self._answers.nowhere(Status.OUTSIDE_MAP if beyond else Status.NOT_FRICTIONLESS)


def _those(fits: Fits, rows: AnyArray) -> Fits:
    return fits if rows.all() else Fits(*(part[rows] for part in fits))
