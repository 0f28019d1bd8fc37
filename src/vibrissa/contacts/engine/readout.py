"""Readouts: measurements as signals by name or as a linear mix, prepared for the estimator.

A readout converts a measurement to channels with weights
(:class:`~vibrissa.contacts.sensing.weighing`), and provides the search tree, over three quantities
of the map, for contacts that may explain it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.fitting.inversion import seeding_triplet
from vibrissa.contacts.sensing.channels import (
    FITTED,
    WRENCH,
    Channels,
    wrench_tangents,
    wrenches_of,
)
from vibrissa.contacts.sensing.noise import SensorNoise, rank
from vibrissa.contacts.sensing.weighing import Weighing, weighing_of
from vibrissa.contacts.uncertainty.nodes import Searched, at_nodes, searched
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import search_tree
from vibrissa.sensors import COMPONENTS
from vibrissa.signals import CIRCULAR, SIGNALS, check_signals, signal_scales, signals_of

# Ratio to the noise and to the other directions below which the contacts of the map vary too little
# along a direction of the readings for it to carry information.
_UNINFORMATIVE = 1e-9
# Number of fits, each with the weights at the contact before: if the noise of directions depends on
# their size; and if shared errors may far exceed the noise, so that weights at the first contact,
# which is wrong by these errors, would hold back the next fit.
_BY_DIRECTION, _WITH_ERRORS = 2, 8
# Ratio to the largest signal on the map above which signals are in another unit.
_FAR_BEYOND = 10.0
_UNKNOWNS = 3
# Components that together form signals; a sensor that reads these reads signals by name.
_BY_NAME = (("Fx",), ("Fy", "Fz"), ("Mx",), ("My", "Mz"))


class Bounds(NamedTuple):
    """Largest forces and moments of the contacts of a map."""

    sizes: list[int]
    largest: Array

    @classmethod
    def of(cls, contact_map: ChartedWhisker, names: tuple[str, ...]) -> Bounds:
        """Bounds of signals of a map."""
        sizes = [k for k, name in enumerate(names) if not CIRCULAR[SIGNALS.index(name)]]
        values = contact_map.chart.values.reshape(-1, 6)
        known = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
        largest = np.abs(known[:, [SIGNALS.index(names[k]) for k in sizes]]).max(axis=0)
        # M_x nearly vanishes on a planar whisker, but noise in it must not be out of bounds.
        of_kind = {"F": np.abs(values[:, :3]).max(), "M": np.abs(known[:, 3:5]).max()}
        return cls(sizes, np.maximum(largest, [0.1 * of_kind[names[k][0]] for k in sizes]))

    def nothing(self, targets: Array) -> AnyArray:
        """Whether signals (n, k) are those of a free whisker, shape (n,)."""
        return np.asarray((targets[:, self.sizes] == 0.0).all(axis=1) & bool(self.sizes))

    def exceeded(self, targets: Array) -> AnyArray:
        """Whether signals (n, k) are far larger than any on the map, shape (n,)."""
        return np.asarray((np.abs(targets[:, self.sizes]) > _FAR_BEYOND * self.largest).any(axis=1))

    def most(self) -> list[tuple[int, float]]:
        """Largest possible value of each signal."""
        return list(zip(self.sizes, (_FAR_BEYOND * self.largest).tolist(), strict=True))


@lru_cache(maxsize=16)
def searched_by_name(
    contact_map: ChartedWhisker, names: tuple[str, ...]
) -> tuple[Bounds, Searched | None]:
    """Bounds of signals, and the search structure for three or more; independent of the noise."""
    chart, channels, bounds = (
        contact_map.chart,
        Channels.of(names).names,
        Bounds.of(contact_map, names),
    )
    if len(names) < _UNKNOWNS:
        return bounds, None
    three = names if len(names) == _UNKNOWNS else seeding_triplet(chart, names)
    known, sizes, turns = at_nodes(chart, channels)
    return bounds, searched(
        chart,
        contact_map.tree(three),
        [names.index(name) for name in three],
        [SIGNALS.index(name) for name in three],
        known,
        sizes,
        turns,
        [2 if turn else "FM".index(name[0]) for name, turn in zip(channels, turns, strict=True)],
    )


@dataclass(frozen=True, eq=False)
class Measurement:
    """One measurement, non-dimensional: measured values, and target values of the channels."""

    measured: Array
    target: Array


class Named:
    """Readout of signals by name, and of components of force and moment."""

    def __init__(
        self, contact_map: ChartedWhisker, names: tuple[str, ...], sensor: SensorNoise | None
    ) -> None:
        chart = contact_map.chart
        d = chart.discretization
        self.names, self.sensor, self.channels = names, sensor, Channels.of(names)
        self.noisy = sensor is not None
        self.scale = signal_scales(names, d.force, d.moment)
        self._pairs = self.channels.pairs()
        self._circular = [CIRCULAR[SIGNALS.index(name)] for name in names]
        self._sizes = [i for i, name in enumerate(names) if name in ("FT", "MB")]
        self.bounds, found = searched_by_name(contact_map, names)
        self._most = self.bounds.most()
        self._straight = [i for i, turns in enumerate(self._circular) if not turns]
        self.how = weighing_of(self.channels, sensor, d.force, d.moment, self.scale)
        self.passes = 1 if constant_weights(self.channels, sensor) else _passes(self.how)
        self.rank = len(names)
        self._noise = [] if sensor is None else self._deviations(sensor)
        if found is not None:
            self.searched = found

    def _deviations(self, sensor: SensorNoise) -> list[tuple[int, float]]:
        """Standard deviations, without contact, of signals other than directions."""
        out = []
        for i in self._straight:
            name, scale = self.names[i], float(self.scale[i])
            if sensor.deviations is not None:
                sigma = sensor.deviations[name]
            else:
                assert sensor.wrench is not None
                parts = {"Fx": [0], "FT": [1, 2], "Mx": [3], "MB": [4, 5]}[name]
                sigma = float(np.sqrt(np.diag(sensor.wrench)[parts].mean()))
            out.append((i, sigma / scale))
        return out

    def scaled(self, values: Array) -> Measurement:
        """Check one measurement (k,), SI units, and make it non-dimensional; NaN remains NaN."""
        for i, value in enumerate(values.tolist()):
            if self._circular[i]:
                if abs(value) > 2.0 * math.pi:
                    check_signals(values, self.names)
            elif value < 0.0 and i in self._sizes:
                check_signals(values, self.names)
        measured = values / self.scale
        if not self._pairs:
            return Measurement(measured, measured)
        target = measured.copy()
        for i in self._pairs:
            size, angle = measured[i], measured[i + 1]
            target[i], target[i + 1] = size * math.cos(angle), size * math.sin(angle)
        return Measurement(measured, target)

    def nothing(self, measurement: Measurement) -> bool:
        """Whether the whisker is free."""
        values = measurement.measured.tolist()
        return bool(self._straight) and not any(values[i] for i in self._straight)

    def detected(self, measurement: Measurement, above: float) -> bool:
        """Whether a signal other than a direction exceeds zero by ``above`` standard deviations."""
        values = measurement.measured.tolist()
        return any(abs(values[i]) > above * sigma for i, sigma in self._noise)

    def excess(self, measurement: Measurement) -> Array:
        """Measurement (n,) in standard deviations of a free whisker's noise; empty without any."""
        out: list[float] = []
        for i, sigma in self._noise:
            if sigma > 0.0:
                values = measurement.target[i : i + 1 + (i in self._pairs)] / sigma
                lone = i in self._sizes and i not in self._pairs
                out += [math.sqrt(max(values[0] ** 2 - 2.0, 0.0))] if lone else values.tolist()
        return np.array(out)

    def beyond(self, measurement: Measurement) -> bool:
        """Whether the signals are far larger than any on the map."""
        values = measurement.measured.tolist()
        return any(abs(values[i]) > most for i, most in self._most)


class Mixed:
    """Readout of a linear mix of force and moment, z = H (F, M) + noise."""

    def __init__(
        self, contact_map: ChartedWhisker, mixing: Array, covariance: Array, errors: Array
    ) -> None:
        chart = contact_map.chart
        d = chart.discretization
        sizes = np.repeat([d.force, d.moment], 3)
        size, axes = np.linalg.eigh(covariance)
        if not size[0] > 0.0:
            raise ValueError("channels that mix force and moment need noise in all six components")
        whiten = axes.T / np.sqrt(size)[:, None]
        wrenches = wrenches_of(chart.values.reshape(-1, 6))
        typical = np.sqrt((wrenches**2).mean(axis=0))
        # Singular directions of the whitened readings of contacts, the strongest first.
        u, strength, _ = np.linalg.svd(whiten @ (mixing * sizes) * typical)
        self.noisy = True
        self.rank = int((strength > _UNINFORMATIVE * strength[0]).sum())
        self._reduce = (u.T @ whiten)[: self.rank]
        h = self._reduce @ (mixing * sizes)
        self._back = np.linalg.pinv(h)
        self.how = Weighing(
            np.array([FITTED.index(name) for name in WRENCH]),
            np.ascontiguousarray(h),
            np.eye(self.rank),
            np.zeros((6, 6)),
            0.0,
            np.full(6, np.nan),
            # The reduced reading has full rank, so that errors of readings are those of wrenches.
            np.ascontiguousarray(self._back @ (self._reduce @ errors) * np.append(sizes, 1.0)),
        )
        self.passes = _passes(self.how) if errors[..., :6].any() else 1
        seen = wrenches @ h.T
        self._largest = 10.0 * np.abs(seen).max(axis=0)
        if self.rank >= 3:
            n, m, k = chart.values.shape[:3]
            values = seen[:, :3].reshape(n, m, k, 3)
            slopes = h[:3] @ wrench_tangents(chart.values, chart.tangents)
            no, yes = (False, False, False), (True, True, True)
            tree = search_tree(chart, np.ascontiguousarray(values), slopes, no, vanishing=yes)
            self.searched = searched(
                chart,
                tree,
                range(3),
                range(3),
                np.ascontiguousarray(seen.T),
                np.ones(seen.T.shape),
                np.zeros(self.rank),
                [2] * self.rank,
            )
            size = np.linalg.norm(slopes, axis=-1, keepdims=True)
            with np.errstate(invalid="ignore", divide="ignore"):
                volume = np.abs(np.linalg.det(slopes / size))
            if np.nanmedian(volume) < _UNINFORMATIVE:
                self.rank = 2

    def scaled(self, values: Array) -> Measurement:
        """Make one measurement (k,) non-dimensional and white; NaN remains NaN."""
        z = self._reduce @ values
        return Measurement(z, self._back @ z)

    def nothing(self, measurement: Measurement) -> bool:
        """Whether the whisker is free."""
        return not measurement.measured.any()

    def detected(self, measurement: Measurement, above: float) -> bool:
        """Whether the readings together exceed zero by ``above`` standard deviations."""
        size = float((measurement.measured**2).sum())
        return size > len(measurement.measured) - 1 + above**2

    def excess(self, measurement: Measurement) -> Array:
        """Measurement (n,) in standard deviations of the noise."""
        return measurement.measured

    def beyond(self, measurement: Measurement) -> bool:
        """Whether the readings are far larger than any on the map."""
        return bool((np.abs(measurement.measured) > self._largest).any())


def _passes(how: Weighing) -> int:
    """Largest number of fits, each with the weights at the contact before."""
    return _WITH_ERRORS if how.errors.shape[0] else _BY_DIRECTION


def independent(contact_map: ChartedWhisker, readout: Named | Mixed) -> int:
    """Number of independent values in a measurement."""
    if isinstance(readout, Mixed):
        return len(readout.how.own)
    sensor, channels = readout.sensor, readout.channels
    if sensor is None or sensor.wrench is None:
        return len(channels.names)
    node = contact_map.chart.values[-1, :1, -1]
    ones = np.ones((1, len(channels.names)))
    return rank(channels.covariance(sensor, ones, node, contact_map.chart.discretization)[0])


def constant_weights(channels: Channels, sensor: SensorNoise | None) -> bool:
    """Whether the weights of channels are the same for all contacts."""
    if sensor is None or sensor.errors[..., :6].any():
        return False
    return sensor.deviations is not None or not set(channels.names) & {"FT", "FD", "MB", "MD"}


class ByName:
    """A sensor whose channels determine whole signals: its readings as those."""

    def __init__(self, named: Named, back: Array, places: list[int]) -> None:
        self.named, self._back, self._places = named, back, places
        self._wrench = np.zeros(6)

    def signals(self, values: Array) -> Array:
        """Convert readings (k,) to signals."""
        w = self._wrench
        w[self._places] = self._back @ values
        fx, fy, fz, mx, my, mz = w.tolist()
        known = {
            "Fx": fx,
            "FT": float(np.hypot(fy, fz)),
            "FD": float(np.arctan2(fz, fy)),
            "Mx": mx,
            "MB": float(np.hypot(my, mz)),
            "MD": float(np.arctan2(mz, my)),
        }
        return np.array([known[name] for name in self.named.names])


def readout_of(
    contact_map: ChartedWhisker, h: Array, covariance: Array, errors: Array
) -> ByName | Mixed:
    """Readout by name if the channels determine whole signals and nothing else, else of a mix."""
    read = [name for name, column in zip(COMPONENTS, h.T, strict=True) if column.any()]
    whole = [group for group in _BY_NAME if set(group) <= set(read)]
    places = [COMPONENTS.index(name) for name in read]
    own = h[:, places]
    complete = sum(map(len, whole)) == len(read) and len(read) >= _UNKNOWNS
    if not complete or np.linalg.matrix_rank(own / np.linalg.norm(own, axis=0)) < len(read):
        return Mixed(contact_map, h, covariance, errors)
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    back = np.linalg.pinv(root @ own) @ root
    wrench = np.zeros((6, 6))
    wrench[np.ix_(places, places)] = back @ covariance @ back.T
    names = {
        ("Fx",): ("Fx",),
        ("Fy", "Fz"): ("FT", "FD"),
        ("Mx",): ("Mx",),
        ("My", "Mz"): ("MB", "MD"),
    }
    chosen = [name for group in whole for name in names[group]]
    signals = tuple(name for name in SIGNALS if name in chosen)
    wrong = np.zeros((len(errors), 6, 7))
    wrong[:, places] = back @ errors
    noise = SensorNoise.of(0.5 * (wrench + wrench.T), signals, wrong)
    return ByName(Named(contact_map, signals, noise), np.asarray(back, dtype=np.float64), places)
