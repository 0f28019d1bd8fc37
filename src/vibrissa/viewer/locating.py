"""Which contacts feel the same: pure functions of a chart and a bent whisker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from vibrissa.contacts import Estimate
from vibrissa.identifiability import sensitivity
from vibrissa.rod import PointContact, deflect
from vibrissa.signals import SIGNALS, base_signals
from vibrissa.status import Status
from vibrissa.viewer.bend_drawing import NODES
from vibrissa.viewer.bending import Bend
from vibrissa.viewer.charting import Chart
from vibrissa.viewer.drawing import Array, Bytes, Ints
from vibrissa.viewer.shading import Legend, counted, shaded
from vibrissa.whisker import Whisker

_RAT = (1.5e-4, 6e-6)
"""EI/L², N, and EI/L, N·m, of a rat's whisker."""

COLOURS = ("uniqueness", "ambiguity", "sensitivity", *SIGNALS)
_APART = 0.005
"""Candidates nearer to the contact than this share of the length are the contact itself."""


@dataclass(frozen=True)
class Sensor:
    """What locates the contact."""

    triplet: tuple[str, ...] = ("Fx", "MB", "MD")
    force_noise: float = 1e-6
    moment_noise: float = 2e-8

    @property
    def covariance(self) -> Array | None:
        """Of force and moment (6, 6); None where there is no noise."""
        sigma = np.repeat([self.force_noise, self.moment_noise], 3)
        return np.diag(sigma**2) if (sigma > 0.0).all() else None


def usual_sensor(whisker: Whisker) -> Sensor:
    """A sensor that suits a whisker: as exact for a rod as 1 µN and 0.02 µN·m are for a rat's."""
    moment = whisker.base_bending_stiffness / whisker.length
    powers = np.log10([moment / whisker.length / _RAT[0], moment / _RAT[1]])
    force, turning = 10.0 ** np.round(powers)
    usual = Sensor()
    return Sensor(
        force_noise=float(force * usual.force_noise),
        moment_noise=float(turning * usual.moment_noise),
    )


@dataclass(frozen=True, eq=False)
class Located:
    """What three signals of a bent whisker tell."""

    sensor: Sensor
    signals: xr.Dataset
    contact: Array
    estimate: Estimate
    lines: Array

    @property
    def points(self) -> Array:
        """Contact points of the candidates (k, 3), m."""
        points = self.estimate.candidates
        return np.asarray(points[np.isfinite(points).all(axis=-1)])

    @property
    def distances(self) -> Array:
        """How far each candidate is from the true contact (k,), m."""
        return np.asarray(np.linalg.norm(self.points - self.contact, axis=-1))

    def others(self, length: float) -> Ints:
        """Numbers of the candidates that are not the contact itself."""
        return np.flatnonzero(self.distances > _APART * length)


def located(chart: Chart, bend: Bend, sensor: Sensor) -> Located | None:
    """Find every contact that feels the same in three signals; None where there is no contact."""
    bent = bend.deflection
    if not bend.status.ok or bend.status is Status.NO_CONTACT:
        return None
    signals = base_signals(np.asarray(bent.force), np.asarray(bent.moment))
    estimate = chart.contact_map.estimate(signals, sensor.triplet, noise=sensor.covariance)
    points = estimate.candidates[np.isfinite(estimate.candidates).all(axis=-1)]
    lines = deflect(chart.whisker, PointContact(points.reshape(-1, 3))).centerline(NODES)
    return Located(sensor, signals, np.asarray(bent.contact_point), estimate, lines)


def coloured(chart: Chart, what: str, sensor: Sensor) -> tuple[Bytes, Legend]:
    """Colours (n, 3) of the cloud: how many contacts feel the same there, or how far apart."""
    if what in SIGNALS:
        return shaded(what, chart.signals[what])
    if what == "sensitivity":
        return shaded("predicted_error", _predicted_error(chart, sensor))
    felt = {name: chart.signals[name] for name in sensor.triplet}
    estimate = chart.contact_map.estimate(felt, sensor.triplet)
    if what == "uniqueness":
        return counted(estimate.n_candidates)
    if what == "ambiguity":
        return shaded("separation", _separation(estimate, chart.points))
    raise ValueError(f"colours are one of {', '.join(COLOURS)}; got {what!r}")


def _predicted_error(chart: Chart, sensor: Sensor) -> Array:
    """RMS 3D error (n,), m, of the contacts of the cloud."""
    if sensor.covariance is None:
        return np.full(len(chart.points), np.nan)
    found = sensitivity(chart.contact_map, sensor.triplet, chart.points, noise=sensor.covariance)
    return np.asarray(found["predicted_error"].to_numpy(), dtype=np.float64)


def _separation(estimate: Estimate, points: Array) -> Array:
    """How far (n,), m, the farthest other candidate of each contact is; NaN without candidates."""
    away = np.linalg.norm(estimate.candidates - points[:, None], axis=-1)
    farthest = np.nanmax(np.nan_to_num(away), axis=1)
    farthest[farthest < 1e-9] = 0.0  # the contact itself, found again
    return np.where(estimate.status == Status.DEGENERATE, np.nan, farthest)
