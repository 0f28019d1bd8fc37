"""Fewer than three signals: the curve or surface of contacts that explain them, in samples.

A contact has three unknowns ξ = (s, f_y, f_z). Two signals leave a curve: at every arc length s of
a few stations of the map, the forces that give both. One signal leaves a surface: at every station,
in every direction of the force. Where the set passes the map's chart is seen from the signals at
its nodes; from there it is met exactly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.mapping.channels import CHANNELS, CIRCULAR, channel_derivatives, channels_of
from vibrissa.mapping.fitting import charted, fit
from vibrissa.mapping.readout import Measurement, Mixed, Named
from vibrissa.mapping.weighing import weigh
from vibrissa.rod.arrays import Array, IntArray
from vibrissa.rod.reach import Reach, contacts_at

# Every so many of the chart's stations is a sample of arc length, of a surface also of bearings.
_STATIONS = 2
_BEARINGS = 4
# Misfit, in shares of the signals' sizes, up to which a sample explains them.
_MET = 1e-6
# An arc length is held this firmly, next to signals relative to their sizes.
_FIRM = 100.0
_SAME = 1e-4
# A signal is nothing below this share of what it is on the map.
_SMALL = 1e-6


class Samples(NamedTuple):
    """Contacts x (n, 4), (F, p) (n, 6) and covariances (n, 3, 3) across the set."""

    contacts: Array
    values: Array
    covariances: Array


class Ambiguity:
    """Samples of the contacts that explain one or two signals.

    Parameters
    ----------
    chart : Reach
        The whisker's stable contacts.
    readout : Named or Mixed
        What is measured.
    """

    def __init__(self, chart: Reach, readout: Named | Mixed) -> None:
        self._chart, self._readout = chart, readout
        how = readout.how
        codes = how.codes.tolist()
        self._names = tuple(CHANNELS[code] for code in codes)
        self._mixing = how.mixing
        self._circular = np.array([CIRCULAR[code] for code in codes])[: len(how.mixing)]
        if isinstance(readout, Mixed):
            self._circular = np.zeros(len(how.mixing), bool)
        known = channels_of(chart.values)[::_STATIONS][..., codes]
        self._seen = known @ how.mixing.T
        self._typical = np.sqrt((self._seen**2).mean(axis=(0, 1, 2)))
        self._chart_places = np.stack(
            np.meshgrid(
                np.linspace(0.0, 1.0, len(chart.stations))[::_STATIONS],
                chart.bearings,
                chart.loads,
                indexing="ij",
            ),
            axis=-1,
        )

    def samples(self, measurement: Measurement) -> Samples:
        """Sample the set.

        Parameters
        ----------
        measurement : Measurement
            Of one or two signals.

        Returns
        -------
        Samples
            None where no contact on the map explains them.
        """
        wanted = self._mixing @ measurement.target
        away = self._seen - wanted
        turns = self._circular
        if turns.any():
            away[..., turns] = np.pi - (np.pi - away[..., turns]) % (2.0 * np.pi)
        starts = self._crossings(away) if len(wanted) > 1 else self._rises(away[..., 0])
        if not len(starts):
            return _none()
        chart, d = self._chart, self._chart.discretization
        xi = contacts_at(chart.fold, starts)
        x = np.insert(xi, 1, 0.0, axis=1)
        n, k = len(x), len(self._names)
        # Signals are compared relative to their size, and the arc length stays where it is.
        own = np.abs(wanted) if isinstance(self._readout, Named) else np.linalg.norm(wanted)
        size = np.where(turns, 1.0, np.maximum(own, _SMALL * self._typical))
        weights = np.zeros((n, k + 1, k + 1))
        weights[:, : len(wanted), :k] = self._mixing / size[:, None]
        weights[:, k, k] = _FIRM
        targets = np.column_stack([np.tile(measurement.target, (n, 1)), x[:, 0]])
        fits = fit(
            d,
            (*self._names, "s"),
            targets,
            weights,
            x,
            friction=False,
            least=chart.proximal,
            worth=np.inf,
        )
        good = charted(chart, fits, chart.proximal) & (fits.misfits < _MET**2)
        rows = _distinct(fits.contacts, np.flatnonzero(good))
        covariances = np.stack(
            [
                self._across(measurement, fits.contacts[i], fits.values[i], fits.tangents[i])
                for i in rows
            ]
            or [np.empty((3, 3))]
        )[: len(rows)]
        return Samples(fits.contacts[rows], fits.values[rows], covariances)

    def _crossings(self, away: Array) -> Array:
        """Middles (n, 3) of the chart's faces of equal s in which both signals may be met."""
        corners = np.stack(
            [away[:, i : i + away.shape[1] - 1, j : j + away.shape[2] - 1] for i, j in _CORNERS]
        )
        least, most = corners.min(axis=0), corners.max(axis=0)
        met = (least <= 0.0) & (most >= 0.0)
        met[..., self._circular] &= (most - least)[..., self._circular] < np.pi
        place = np.argwhere(met.all(axis=-1))
        near = self._chart_places[tuple(place.T)]
        far = self._chart_places[place[:, 0], place[:, 1] + 1, place[:, 2] + 1]
        return np.asarray(0.5 * (near + far))

    def _rises(self, away: Array) -> Array:
        """Where the one signal is met along the load, at some stations and bearings (n, 3)."""
        some = away[:, ::_BEARINGS][:, :-1]
        places = self._chart_places[:, ::_BEARINGS][:, :-1]
        low, high = some[..., :-1], some[..., 1:]
        met = (low * high <= 0.0) & (np.abs(high - low) > 0.0)
        if self._circular[0]:
            met &= np.abs(high - low) < np.pi
        i, j, k = np.nonzero(met)
        share = (low[i, j, k] / (low[i, j, k] - high[i, j, k]))[:, None]
        near, far = places[i, j, k], places[i, j, k + 1]
        return np.asarray(near + share * (far - near))

    def _across(self, measurement: Measurement, x: Array, value: Array, tangent: Array) -> Array:
        """Covariance (3, 3) of the contact point that noise makes, across the set."""
        k = len(self._names)
        weights = np.empty((k, k))
        if not weigh(self._readout.how, value, measurement.measured, weights):
            return np.zeros((3, 3))
        force = np.hypot(x[2], x[3])
        unit = np.array([1.0, force, force])
        t = tangent[:, [0, 2, 3]] * unit
        back = np.linalg.pinv(weights @ channel_derivatives(value, t, self._names), rcond=1e-9)
        root = t[3:] @ back
        return np.asarray(root @ root.T)


_CORNERS = ((0, 0), (1, 0), (0, 1), (1, 1))


def _none() -> Samples:
    return Samples(np.empty((0, 4)), np.empty((0, 6)), np.empty((0, 3, 3)))


def _distinct(contacts: Array, rows: IntArray) -> list[int]:
    """Rows whose contacts are not met before."""
    kept: list[int] = []
    for row in rows.tolist():
        x = contacts[row]
        others = contacts[kept]
        force = np.hypot(x[2], x[3])
        apart = np.abs(others[:, 0] - x[0]) + np.abs(others[:, 2:] - x[2:]).sum(axis=1) / force
        if not (apart < _SAME).any():
            kept.append(row)
    return kept
