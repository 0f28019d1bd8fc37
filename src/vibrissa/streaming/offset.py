"""Offset of a sensor, measured while the whisker is free, and followed as it drifts.

The offset of each channel is a random walk with standard deviation `Sensor.drift` after one second.
A scalar Kalman filter for each channel estimates it from the readings of the free whisker. A slow
contact must not be taken for a drift: a reading is used only after a lag, one second or the shorter
time in which the drift exceeds the noise, and not at all if a contact has begun in the meantime
whose onset it follows. So a contact is detected if its signals grow, within the lag, by the
threshold of detection. After a long contact the offset is uncertain, and readings that the drift
may explain do not count as contact.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from vibrissa.numerics import Array
from vibrissa.sensors import Sensor

_LAG = 1.0  # longest time after which a reading without contact is used, s
_RECENT = 2.0  # time that the threshold of detection allows for a drift, s
_GUARD = 0.02  # time before an onset and after a loss in which readings are not used, s
_SAMPLES = 200  # number of samples over which free readings are averaged, to notice a drift
# Mean of free readings, in standard deviations, from which a drift is suspected, or one that is
# faster than the sensor's file states.
_OFF, _OFF_FOLLOWED = 1.5, 3.0
OFF_ZERO = (
    "Samples without contact were not zero on average, as after a drift of the offset: tare again, "
    "or state (a larger) drift in the sensor's file. Otherwise they will be taken for contacts, "
    "and the covariances of contacts are too small."
)


class Offset:
    """Offset of a sensor's readings, beyond the sensor's own.

    Parameters
    ----------
    sensor : Sensor, optional
        Sensor with its noise and drift.
    tare : int
        Number of initial readings without contact whose mean is the offset.

    Attributes
    ----------
    value : (k,) array or float
        Offset, in the units of the channels.
    follows : bool
        Whether the offset drifts.
    unsteadiness : float
        Standard deviation of readings without contact, in units of the noise.
    scatter : float
        Largest standard deviation of a channel in the initial readings, in units of the noise.
    """

    def __init__(self, sensor: Sensor | None, tare: int) -> None:
        if tare and sensor is None:
            raise ValueError("tare needs a sensor, to whose channels the offset belongs")
        self.value: Array | float = 0.0
        self.scatter = 0.0
        self._needed, self._tared = tare, list[Array]()
        self._time, self._touched = math.nan, -math.inf
        self._waiting: deque[tuple[float, Array]] = deque()
        if sensor is not None:
            self._noise, self._walk = np.diag(sensor.covariance()), sensor.drift**2
            self._variance = self._noise / tare if tare else _LAG * self._walk
        self.unsteadiness = 1.0 if sensor is None else sensor.unsteadiness
        self.follows = sensor is not None and bool((sensor.drift > 0.0).any())
        if self.follows:
            self._lag = min(_LAG, float((self._noise / np.maximum(self._walk, 1e-300)).min()))

    @property
    def missing(self) -> int:
        """Number of samples without contact that are still needed."""
        return self._needed - len(self._tared)

    def tare(self, time: float, reading: Array) -> None:
        """Use one of the initial readings without contact."""
        self._tared.append(reading)
        if not self.missing:
            self.value, self._time = np.mean(self._tared, axis=0), time
            if self._needed > 1 and self._noise.all():
                variance = np.var(self._tared, axis=0, ddof=1)
                self.scatter = float(np.sqrt((variance / self._noise).max()))

    def forget(self) -> None:
        """Forget readings and their times, as of a sender that starts again."""
        self._waiting.clear()
        self._time, self._touched = math.nan, -math.inf

    def follow(self, time: float, free: bool, onset: float, reading: Array) -> None:
        """Use a reading (k,) of a free whisker, or the onset of a contact if it is not."""
        if not free:
            self._touched = time
            while self._waiting and self._waiting[-1][0] > onset - _GUARD:
                self._waiting.pop()
        elif time > self._touched + _GUARD and np.isfinite(reading).all():
            self._waiting.append((time, reading))
        while self._waiting and self._waiting[0][0] <= time - self._lag:
            self._learn(*self._waiting.popleft())

    def hides(self, time: float, reading: Array, above: float) -> bool:
        """Whether the offset, long unknown, may have drifted by a reading (k,) without an offset.

        ``above`` is the threshold of detection for an offset that has drifted for a short time.
        """
        if not self.follows or not time - self._time > _RECENT:
            return False
        variance = self._noise + (time - self._time) * self._walk
        size = float((reading**2 / variance).sum())
        return size < len(reading) - 1 + (above / self.unsteadiness) ** 2

    def _learn(self, time: float, reading: Array) -> None:
        step = max(time - self._time, 0.0) if self._time == self._time else 0.0
        self._time = time
        variance = self._variance + step * self._walk
        gain = variance / (variance + self._noise)
        self.value = self.value + gain * (reading - self.value)
        self._variance = (1.0 - gain) * variance


class Zero:
    """Mean of the signals of a free whisker, in standard deviations of the noise.

    Parameters
    ----------
    followed : bool
        Whether a drift of the offset is followed.

    Attributes
    ----------
    off : bool
        Whether a component of the mean over the last samples has been suspiciously large.
    """

    def __init__(self, followed: bool = False) -> None:
        self.off, self._number, self._mean = False, 0, np.zeros(0)
        self._most = _OFF_FOLLOWED if followed else _OFF

    def put(self, excess: Array) -> None:
        """Add the signals (k,) of a sample without contact."""
        if excess.shape != self._mean.shape:
            self._number, self._mean = 0, np.zeros_like(excess)
        if not excess.size or not np.isfinite(excess).all():
            return
        self._number += 1
        self._mean += (excess - self._mean) / min(self._number, _SAMPLES)
        if self._number >= _SAMPLES:
            self.off |= bool((np.abs(self._mean) > self._most).any())
