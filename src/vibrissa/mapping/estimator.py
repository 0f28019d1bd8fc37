"""One measurement at a time, in microseconds: for streams, without labelled datasets around it.

Each measurement is searched for in the whole map, so that no candidate is lost by looking only near
the last one. The contact that was followed so far is one more place to start from (for three
signals, where candidates have become fewer), and it tells which candidate goes on from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.mapping.channels import Channels
from vibrissa.mapping.estimate import check_signals
from vibrissa.mapping.explanation import Bounds, why_none
from vibrissa.mapping.fitting import Fits, charted
from vibrissa.mapping.inversion import invert, polish
from vibrissa.mapping.least_squares import (
    by_doubt,
    largest_misfit,
    least_squares,
    nearby,
    seeding_triplet,
)
from vibrissa.mapping.minima import same
from vibrissa.mapping.noise import SensorNoise
from vibrissa.mapping.uncertainty import point_covariances
from vibrissa.mapping.whitening import INDISTINCT
from vibrissa.rod.arrays import Array
from vibrissa.rod.newton import TOLERANCE
from vibrissa.signals import CIRCULAR, SIGNALS, selection, signal_scales
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap

# A contact moves no farther than this (over L) from one measurement to the next.
_NEAR = 0.02


class Located(NamedTuple):
    """What one measurement tells.

    Parameters
    ----------
    point : (3,) array
        Contact point of the most plausible candidate, whisker frame, m; NaN if there is none.
    status : Status
        ``UNIQUE``, ``AMBIGUOUS``, ``NOT_FRICTIONLESS`` (no contact on the map explains it; of more
        than three signals ``point`` is the one that comes nearest), ``OUTSIDE_MAP``,
        ``DEGENERATE`` or ``MISSING``, as in :class:`Estimate`.
    candidates : (k, 3) array
        All contact points, in the order of :class:`Estimate`, m.
    arc_lengths : (k,) array
        Their arc lengths, m.
    covariance : (3, 3) array
        Covariance of ``point``, m²; NaN without noise.
    misfit : float
        As in :class:`Estimate`.
    continuing : int
        Number of the candidate that goes on from the measurement before; 0 where there was none.
    """

    point: Array
    status: Status
    candidates: Array
    arc_lengths: Array
    covariance: Array
    misfit: float
    continuing: int


class Estimator:
    """Locate contacts from a stream of signals.

    Parameters
    ----------
    contacts : ContactMap
        The whisker's map.
    triplet : str or sequence of str
        The signals that the stream carries, three or more, in this order.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units: gives covariances, and
        weighs more than three signals.
    """

    def __init__(
        self,
        contacts: ContactMap,
        triplet: str | Sequence[str] = ("Fx", "MB", "MD"),
        noise: Mapping[str, float] | ArrayLike | None = None,
    ) -> None:
        self.names = selection(triplet)
        order = triplet.replace(",", " ").split() if isinstance(triplet, str) else list(triplet)
        self._order = [order.index(name) for name in self.names]
        self._sensor = None if noise is None else SensorNoise.of(noise, self.names)
        self._contacts, self._chart = contacts, contacts.chart
        self._determining = contacts.determines(self.names)
        self._three = self.names
        if len(self.names) > 3:
            self._three = seeding_triplet(self._chart, self.names)
        self._where = [self.names.index(name) for name in self._three]
        self._tree = contacts.tree(self._three)
        self._channels = Channels.of(self.names)
        self._limit = largest_misfit(self._channels, self._sensor, contacts)
        d = self._chart.discretization
        self._length = d.length
        self._scale = signal_scales(self.names, d.force, d.moment)
        self._bounds = Bounds.of(contacts, self.names)
        circular = np.array([CIRCULAR[SIGNALS.index(name)] for name in self.names])
        size = np.isin(self.names, ("FT", "MB"))
        self._most = np.where(circular, 2.0 * np.pi, np.inf)
        self._least = np.where(size, 0.0, -self._most)
        self.reset()

    def reset(self) -> None:
        """Forget the measurement before, as when the whisker has lost touch."""
        self._last: tuple[Array, Array] | None = None  # ξ and (F, p) of the contact followed
        self._number = 0  # of candidates

    def __call__(self, signals: ArrayLike) -> Located:
        """Locate one measurement.

        Parameters
        ----------
        signals : (k,) array_like
            The signals in the order they were announced, SI units.

        Returns
        -------
        Located
            The contact, all candidates, and the status.

        Raises
        ------
        ValueError
            If there are not as many numbers as signals were announced, a size is negative, or an
            angle is more than a full turn.
        """
        try:
            values = np.asarray(signals, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"one measurement has {len(self.names)} numbers; got {signals!r}"
            ) from error
        if values.shape != (len(self.names),):
            raise ValueError(
                f"one measurement has {len(self.names)} signals; got shape {values.shape}"
            )
        values = values[self._order]
        if ((values < self._least) | (values > self._most)).any():
            check_signals(values, self.names)
        targets = (values / self._scale)[None]
        if not np.isfinite(targets).all():
            self.reset()
            return self._nowhere(Status.MISSING)
        if not self._determining:
            return self._nowhere(Status.DEGENERATE)
        if len(self.names) == 3:
            return self._by_triplet(targets)
        return self._by_least_squares(targets)

    def _by_triplet(self, targets: Array) -> Located:
        found = invert(self._chart, self._tree, self.names, targets)
        n = int(found.number[0])
        xi, values = found.contacts[0, :n], found.values[0, :n]
        if n < self._number and not self._follows(values):
            xi, values = self._followed(targets, xi, values)
        if not len(xi):
            why, misfit = why_none(self._contacts, self.names, targets)
            return self._nowhere(Status(int(why[0])), float(misfit[0]))
        status = Status.UNIQUE if len(xi) == 1 else Status.AMBIGUOUS
        return self._located(xi, values, status, 0.0)

    def _follows(self, values: Array) -> bool:
        """Whether a candidate is near the contact followed so far."""
        assert self._last is not None
        away = np.abs(values[:, 3:] - self._last[1][3:]).max(axis=1)
        return bool((away < _NEAR).any())

    def _followed(self, targets: Array, xi: Array, values: Array) -> tuple[Array, Array]:
        """Add the contact that goes on from the last one, should the search have missed it."""
        assert self._last is not None
        at, value, residual, sign = polish(self._chart, self.names, targets, self._last[0][None])
        new = residual[0] <= TOLERANCE and sign[0] > 0.0 and at[0, 0] >= self._chart.proximal
        if not new or not np.abs(value[0, 3:] - self._last[1][3:]).max() < _NEAR:
            return xi, values
        xi, values = np.concatenate([xi, at]), np.concatenate([values, value])
        order = np.argsort(np.hypot(xi[:, 1], xi[:, 2]))
        return xi[order], values[order]

    def _by_least_squares(self, targets: Array) -> Located:
        if self._bounds.nothing(targets)[0]:
            return self._nowhere(Status.DEGENERATE)
        if self._bounds.exceeded(targets)[0]:
            return self._nowhere(Status.OUTSIDE_MAP)
        exact = invert(self._chart, self._tree, self._three, targets[:, self._where])
        n = int(exact.number[0])
        starts, values = exact.contacts[0, :n], exact.values[0, :n]
        if self._last is not None:
            starts = np.concatenate([starts, self._last[0][None]])
            values = np.concatenate([values, self._last[1][None]])
        if len(starts):
            rows = np.repeat(targets, len(starts), axis=0)
            fits = nearby(
                self._chart, self._channels, self._sensor, rows, starts, self._limit, values
            )
            inside = charted(self._chart, fits, self._chart.proximal)
            if (inside & (fits.misfits <= self._limit)).any():
                return self._chosen(Fits(*(part[inside] for part in fits)))
        # Nothing explains it: look everywhere, and find out why.
        found, status = least_squares(self._contacts, self.names, targets, self._sensor)
        n = int(found.number[0])
        return self._located(
            found.contacts[0, :n][:, [0, 2, 3]],
            found.values[0, :n],
            Status(int(status[0])),
            float(found.misfits[0, 0]),
        )

    def _chosen(self, fits: Fits) -> Located:
        """The same choice as in a batch, of few fits."""
        best = float(fits.misfits.min())
        most = min(best + INDISTINCT, self._limit)
        kept: list[int] = []
        for row in np.argsort(by_doubt(fits)).tolist():
            if fits.misfits[row] <= most and not any(
                same(fits.contacts[row], fits.contacts[other]) for other in kept
            ):
                kept.append(row)
        status = Status.UNIQUE if len(kept) == 1 else Status.AMBIGUOUS
        xi = fits.contacts[kept][:, [0, 2, 3]]
        return self._located(xi, fits.values[kept], status, float(fits.misfits[kept[0]]))

    def _nowhere(self, status: Status, misfit: float = np.nan) -> Located:
        return self._located(np.empty((0, 3)), np.empty((0, 6)), status, misfit)

    def _located(self, xi: Array, values: Array, status: Status, misfit: float) -> Located:
        """Everything in SI units; remember which candidate goes on from the one before."""
        continuing, self._number = 0, len(xi)
        if len(xi):
            if self._last is not None:
                away = values[:, 3:] - self._last[1][3:]
                continuing = int((away * away).sum(axis=1).argmin())
            self._last = xi[continuing], values[continuing]
        else:
            self._last = None
        points = values[:, 3:] * self._length
        covariance = np.full((3, 3), np.nan)
        if len(xi) and self._sensor is not None:
            d = self._chart.discretization
            covariance = point_covariances(d, self.names, xi[:1], self._sensor)[0][0]
            covariance *= self._length**2
        return Located(
            points[0] if len(xi) else np.full(3, np.nan),
            status,
            points,
            xi[:, 0] * self._length,
            covariance,
            misfit,
            continuing,
        )
