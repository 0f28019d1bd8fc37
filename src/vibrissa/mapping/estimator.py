"""One measurement at a time, in microseconds: for streams, without labelled datasets around it.

Each measurement is searched for in the whole map, so that no candidate is lost by looking only near
the last one. The contact that was followed so far is one more place to start from (for three
signals, where candidates have become fewer), and it tells which candidate goes on from it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.mapping.channels import Channels
from vibrissa.mapping.fitting import Fits, charted, fit
from vibrissa.mapping.inversion import invert, polish
from vibrissa.mapping.least_squares import by_doubt, largest_misfit, least_squares, seeding_triplet
from vibrissa.mapping.minima import same
from vibrissa.mapping.noise import SensorNoise
from vibrissa.mapping.uncertainty import point_covariances
from vibrissa.mapping.whitening import INDISTINCT, whitening
from vibrissa.rod.arrays import Array
from vibrissa.rod.newton import TOLERANCE
from vibrissa.rod.reach import LEAST_ARC, with_normal_force
from vibrissa.signals import selection, signal_scales
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap

# Weights that depend on force and moment are kept while these change by less than this share.
_STEADY = 0.05
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
        than three signals ``point`` is the one that comes nearest), ``OUTSIDE_MAP`` or ``MISSING``.
    candidates : (k, 3) array
        All contact points, in the order of :class:`Estimate`, m.
    arc_lengths : (k,) array
        Their arc lengths, m.
    covariance : (3, 3) array
        Covariance of ``point``, m²; NaN without noise.
    misfit : float
        χ² of more than three signals; 0 where three are explained, NaN where they are not.
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
        self.reset()

    def reset(self) -> None:
        """Forget the measurement before, as when the whisker has lost touch."""
        self._last: tuple[Array, Array] | None = None  # ξ and (F, p) of the contact followed
        self._number = 0  # of candidates
        self._weights: tuple[Array, float, float] | None = None

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
        """
        values = np.asarray(signals, dtype=np.float64)
        if values.shape != (len(self.names),):
            raise ValueError(
                f"one measurement has {len(self.names)} signals; got shape {values.shape}"
            )
        targets = (values[self._order] / self._scale)[None]
        if not np.isfinite(targets).all():
            self.reset()
            return self._located(np.empty((0, 3)), np.empty((0, 6)), Status.MISSING, np.nan)
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
            return self._located(xi, values, Status.NOT_FRICTIONLESS, np.nan)
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
        exact = invert(self._chart, self._tree, self._three, targets[:, self._where])
        n = int(exact.number[0])
        starts, near = exact.contacts[0, :n], exact.values[0, :1]
        if self._last is not None:
            starts = np.concatenate([starts, self._last[0][None]])
            near = self._last[1][None]
        if len(starts):
            weights = self._weigh(targets, near)
            m = len(starts)
            fits = fit(
                self._chart.discretization,
                self._channels.names,
                np.repeat(self._channels.targets(targets), m, axis=0),
                np.repeat(weights, m, axis=0),
                with_normal_force(starts),
                friction=False,
                least=LEAST_ARC,
                worth=self._limit + INDISTINCT,
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

    def _weigh(self, targets: Array, near: Array) -> Array:
        """Weights for a contact with (F, p) near this, (1, k, k)."""
        fx, fy, fz, px, py, pz = near[0].tolist()
        force = math.hypot(fx, fy, fz)
        moment = math.hypot(py * fz - pz * fy, pz * fx - px * fz, px * fy - py * fx)
        if self._weights is not None:
            kept, f, m = self._weights
            if abs(force - f) < _STEADY * f and abs(moment - m) < _STEADY * m:
                return kept
        d = self._chart.discretization
        weights = whitening(self._channels.covariance(self._sensor, targets, near, d))
        self._weights = weights, force, moment
        return weights

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
