"""One measurement at a time, in microseconds: for streams, without labelled datasets around it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.mapping.inversion import invert
from vibrissa.rod.arrays import Array
from vibrissa.signals import selection, signal_scales
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap


class Located(NamedTuple):
    """What one measurement tells.

    Parameters
    ----------
    point : (3,) array
        Contact point with the least force, whisker frame, m; NaN if there is none.
    status : Status
        ``UNIQUE``, ``AMBIGUOUS``, ``NOT_FRICTIONLESS`` (no contact on the map explains it) or
        ``MISSING``.
    candidates : (k, 3) array
        All contact points, by rising force, m.
    arc_lengths : (k,) array
        Their arc lengths, m.
    """

    point: Array
    status: Status
    candidates: Array
    arc_lengths: Array


class Estimator:
    """Locate contacts from a stream of signals.

    Parameters
    ----------
    contacts : ContactMap
        The whisker's map.
    triplet : str or sequence of str
        The three signals that the stream carries, in this order.
    """

    def __init__(
        self, contacts: ContactMap, triplet: str | Sequence[str] = ("Fx", "MB", "MD")
    ) -> None:
        self.names = selection(triplet, exactly=3)
        order = triplet.replace(",", " ").split() if isinstance(triplet, str) else list(triplet)
        self._order = [order.index(name) for name in self.names]
        self._chart = contacts.chart
        self._tree = contacts.tree(self.names)
        d = self._chart.discretization
        self._length = d.length
        self._scale = signal_scales(self.names, d.force, d.moment)

    def __call__(self, signals: ArrayLike) -> Located:
        """Locate one measurement.

        Parameters
        ----------
        signals : (3,) array_like
            The three signals in the order they were announced, SI units.

        Returns
        -------
        Located
            The contact, all candidates, and the status.
        """
        values = np.asarray(signals, dtype=np.float64)
        if values.shape != (3,):
            raise ValueError(f"one measurement has 3 signals; got shape {values.shape}")
        found = invert(
            self._chart, self._tree, self.names, (values[self._order] / self._scale)[None]
        )
        n = int(found.number[0])
        candidates = found.values[0, :n, 3:] * self._length
        if n:
            status = Status.UNIQUE if n == 1 else Status.AMBIGUOUS
            return Located(
                candidates[0], status, candidates, found.contacts[0, :n, 0] * self._length
            )
        status = Status.NOT_FRICTIONLESS if np.isfinite(values).all() else Status.MISSING
        return Located(np.full(3, np.nan), status, candidates, np.empty(0))
