"""What one measurement tells: the contact, all candidates, and why there is none."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array
from vibrissa.status import Status


class Located(NamedTuple):
    """What one measurement tells.

    Attributes
    ----------
    point : (3,) array
        Contact point of the most plausible candidate, whisker frame, m; NaN if there is none.
    status : Status
        ``UNIQUE``, ``AMBIGUOUS``, ``NOT_FRICTIONLESS`` (no contact on the map explains it; of more
        than three signals ``point`` is the one that comes nearest), ``OUTSIDE_MAP``,
        ``OUTSIDE_PRIOR``, ``DEGENERATE`` or ``MISSING``, as in :class:`Estimate`. Of fewer than
        three signals ``UNDERDETERMINED``: the candidates are samples of the curve or surface of
        contacts that explain them, ``point`` the one in their middle.
    candidates : (k, 3) array
        All contact points, in the order of :class:`Estimate`, m.
    arc_lengths : (k,) array
        Their arc lengths, m.
    covariance : (3, 3) array
        Covariance of ``point``, m²; NaN without noise. Of fewer than three signals that of the
        samples about it.
    misfit : float
        As in :class:`Estimate`.
    continuing : int
        Number of the candidate that goes on from the measurement before; 0 where there was none.
    forces : (k, 3) array
        Base forces of the candidates, whisker frame, N.
    covariances : (k, 3, 3) array
        Covariances of all candidates, m²; NaN without noise.
    contact_forces : (k, 3) array
        Forces in the material frame at the contacts (tangent, d1, d2), N; the first is 0.
    probabilities : (k,) array
        Posterior probabilities of the candidates; NaN without noise, and of fewer than three
        signals.
    linear : bool
        Whether ``covariance`` can be relied on, as in :class:`Estimate`.
    """

    point: Array
    status: Status
    candidates: Array
    arc_lengths: Array
    covariance: Array
    misfit: float
    continuing: int
    forces: Array
    covariances: Array
    contact_forces: Array
    probabilities: Array
    linear: bool

    @property
    def probability(self) -> float:
        """Posterior probability of ``point``; NaN without noise."""
        return float(self.probabilities[0]) if len(self.probabilities) else math.nan


def nowhere(status: Status, misfit: float = np.nan) -> Located:
    """Say why there is no contact."""
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
        np.empty(0),
        False,
    )
