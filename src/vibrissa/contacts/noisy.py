"""Contacts that explain noisy signals: all that noise leaves open, with what it says of each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.explanation import Explanation
from vibrissa.contacts.inversion import MOST_CANDIDATES
from vibrissa.contacts.modes import settle
from vibrissa.contacts.noise import SensorNoise
from vibrissa.contacts.posterior import CERTAIN
from vibrissa.contacts.readout import Named, independent
from vibrissa.contacts.whitening import explained
from vibrissa.numerics import Array, share_out
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

_UNKNOWNS = 3
# What a search has found out that noise does not change.
_SETTLED = [int(Status.MISSING), int(Status.DEGENERATE)]
_ANSWERED = [int(Status.UNIQUE), int(Status.AMBIGUOUS)]


def under_noise(
    contact_map: ContactMap,
    names: tuple[str, ...],
    targets: Array,
    sensor: SensorNoise,
    found: Explanation,
) -> Explanation:
    """Complete and judge the contacts that explain measured signals."""
    readout = Named(contact_map, names, sensor)
    limit = explained(independent(contact_map, readout) - _UNKNOWNS)
    n, k, most = len(targets), found.contacts.shape[1], MOST_CANDIDATES
    aims = readout.channels.targets(targets)
    aims[np.isin(found.status, _SETTLED) | readout.bounds.exceeded(targets)] = np.nan
    number, x = found.number.copy(), np.full((n, most, 4), np.nan)
    values, misfits = np.full((n, most, 6), np.nan), np.full((n, most), np.nan)
    x[:, :k], values[:, :k] = found.contacts, found.values
    covariances, probability = np.full((n, most, 3, 3), np.nan), np.full((n, most), np.nan)
    valid = np.zeros(n, np.bool_)
    arrays = (number, x, values, misfits, covariances, probability, valid)
    share_out(
        n,
        lambda first, last: settle(
            readout.searched,
            readout.how,
            readout.passes,
            limit,
            aims,
            targets,
            *arrays,
            first,
            last,
        ),
    )
    explains = misfits[:, 0] <= limit
    certain = probability[:, 0] > CERTAIN
    status = found.status.copy()
    status[explains] = np.where(certain, int(Status.UNIQUE), int(Status.AMBIGUOUS))[explains]
    status[~explains & np.isin(status, _ANSWERED)] = int(Status.NOT_FRICTIONLESS)
    misfit = np.where(number > 0, misfits[:, 0], found.misfit)
    return Explanation(number, x, values, covariances, misfit, status, valid, probability)
