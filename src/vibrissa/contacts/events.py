"""Onset, loss and slip of a contact, sample by sample, and the time at which it began.

**Onset.** A light contact is detected some samples after it began, once signals exceed the noise.
From its onset τ on, the force of a base that moves steadily grows in proportion to time, so that
readings y (k,), in standard deviations of the noise of a free whisker, are

    y(t) = b max(t - τ, 0) + noise,

with an unknown slope b. Its best fit leaves the likelihood of τ,

    log p(τ) = |Σ w g y|² / (2 Σ w g²) + const,    g = max(t - τ, 0),    w = 1 / (1 + (0.1 |y|)²),

over the samples since the last contact and the first ones of this; w allows for forces that do not
grow evenly. All τ being equally probable beforehand, the onset is its mean, with its standard
deviation.

**Loss.** The contact is not detected, and readings are as small as noise: with the threshold of
detection alone noise would end and begin one light contact several times.

**Slip.** The contact point has moved, since the last sample in which it was unique, farther than it
slides and noise moves it. On an object at rest it slides as the whisker moves: at a speed, and
twice as far as the base has carried the point of the whisker that was there.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array, IntArray
from vibrissa.status import Event

# A contact point slips if its step is larger than all but one in a thousand of noise (χ², three
# degrees of freedom), in samples that are not farther apart than this, s.
_BEYOND_NOISE, _NEXT = 16.27, 0.5
_CARRIED = 2.0  # how far a contact slides at most, as a multiple of how far the base carries it
_HALVINGS = 30  # halvings of an interval of 80 in the logarithm of a multiplier
_SETTLING = 0.01  # slips that follow each other within this time are one, s
_NO_VARIANCE = 1e-15  # share of the largest variance below which there is none
# Samples before an onset and after it that it is dated by, and times between two of them.
_BEFORE, _AFTER, _BETWEEN = 128, 8, 6
_UNEVEN = 0.1  # share of a reading by which its growth is not even
_HELD = 2.0  # standard deviations, beyond those of noise, that hold a contact

# Lengths of the whisker that a contact point moves in a second from which it slips, by default.
SLIPPING = 2.0


class Place(NamedTuple):
    """Contact point (3,) in the laboratory and its covariance (3, 3), not finite if not known.

    Also whether the covariance is valid, and rotation (3, 3) and position (3,) of the base.
    """

    point: Array
    covariance: Array
    valid: bool = True
    rotation: Array | None = None
    position: Array | None = None

    def carried(self, now: Place) -> float:
        """How far the base has carried the point of the whisker that was here, m."""
        if self.rotation is None or now.rotation is None:
            return 0.0
        before, after = self.position, now.position
        if before is None or after is None:
            before = after = np.zeros(3)
        carried = now.rotation @ (self.rotation.T @ (self.point - before)) + after
        return math.hypot(*(carried - self.point).tolist())

    @property
    def ellipsoid(self) -> Array:
        """The covariance; a ball as large where a valley that bends leaves it."""
        return self.covariance if self.valid else np.trace(self.covariance) * np.eye(3)


class ContactEvents:
    """Onset, loss and slip of a contact, sample by sample, beginning with a free whisker.

    Parameters
    ----------
    slip_speed : float
        Speed of a contact point from which it slips, m/s.

    Attributes
    ----------
    onset : (float, float)
        Time at which the present contact began and its standard deviation, s: that of the first
        sample, and NaN, where readings do not show it; both are NaN without contact.
    """

    def __init__(self, slip_speed: float) -> None:
        if not slip_speed > 0.0:
            raise ValueError(f"the speed of a slip is positive, m/s; got {slip_speed!r}")
        self._slip_speed = slip_speed
        self.forget()

    def forget(self) -> None:
        """Begin anew, with a free whisker."""
        self.onset = math.nan, math.nan
        self._touching = self._datable = False
        self._last: tuple[float, Place] | None = None
        self._slipped = -math.inf
        self._free()

    def _free(self) -> None:
        self._since = 0
        self._times: deque[float] = deque(maxlen=_BEFORE + _AFTER)
        self._readings: deque[Array] = deque(maxlen=_BEFORE + _AFTER)

    def __call__(
        self,
        time: float,
        touching: bool | None,
        reading: Array,
        place: Place | None,
    ) -> Event:
        """Take a sample.

        Parameters
        ----------
        time : float
            Time of the sample, s.
        touching : bool or None
            Whether there is a contact; None: the sample does not show it.
        reading : (k,) array
            Reading in standard deviations of the noise, zero on the average where the whisker is
            free; empty if it is not known.
        place : Place or None
            Place of the contact; None where several are possible.

        Returns
        -------
        Event
            What happened.
        """
        if touching is None:
            return Event.NONE
        # A contact that has just been detected, or is nearly lost, does not end by noise.
        if self._touching and not touching and (reading**2).sum() > len(reading) + _HELD**2:
            touching, place = True, None
        before, self._touching = self._touching, touching
        last, slips = self._last, False
        if not touching:
            self._last = None
        elif place is not None and np.isfinite(place.point).all():
            self._last = time, place
            slips = last is not None and self._slips(time - last[0], last[1], place)
        if before and not touching:
            self.onset = math.nan, math.nan
            self._free()
        self._date(time, reading, first=touching and not before)
        if before != touching:
            return Event.ONSET if touching else Event.LOSS
        if not slips:
            return Event.NONE
        # What has slipped settles, or rings, for some samples.
        settling, self._slipped = time - self._slipped < _SETTLING, time
        return Event.NONE if settling else Event.SLIP

    def _date(self, time: float, reading: Array, *, first: bool) -> None:
        """Remember a reading, and date the onset anew by the first ones of a contact."""
        if first:
            self.onset = time, math.nan
            self._datable = bool(self._times)
        self._since += self._touching
        if self._since > 1 + _AFTER or not reading.size or not np.isfinite(reading).all():
            return
        self._times.append(time)
        self._readings.append(reading)
        if self._touching and self._datable:
            dated = dated_onset(np.array(self._times), np.array(self._readings))
            # Forces that soon fall again do not date it better.
            if not dated[1] > self.onset[1]:
                self.onset = dated

    def _slips(self, step: float, last: Place, now: Place) -> bool:
        """Whether the point moved farther in this time than it slides and noise moves it."""
        moved = now.point - last.point
        if not 0.0 < step < _NEXT or math.hypot(*moved.tolist()) < self._slip_speed * step:
            return False
        slid = self._slip_speed * step + _CARRIED * last.carried(now)
        spread = now.ellipsoid + last.ellipsoid
        if not np.isfinite(spread).all():  # noise is not known
            return math.hypot(*moved.tolist()) > slid
        variance, axes = np.linalg.eigh(spread)
        known = variance > _NO_VARIANCE * variance[-1]
        along = moved @ axes
        if (along[known] ** 2 / variance[known]).sum() <= _BEYOND_NOISE:
            return False
        away = _beyond(along.tolist(), variance.tolist(), slid)[known]
        return bool((away**2 / variance[known]).sum() > _BEYOND_NOISE)


def dated_onset(time: Array, reading: Array) -> tuple[float, float]:
    """Time at which readings begin to grow from zero, and its standard deviation, s.

    Parameters
    ----------
    time : (n,) array
        Times of two samples or more, s.
    reading : (n, k) array
        Readings in standard deviations of the noise, the last ones in contact.

    Returns
    -------
    (float, float)
        Mean and standard deviation of the onset, as of the module.
    """
    t = time - time[-1]
    weight = 1.0 / (1.0 + _UNEVEN**2 * (reading**2).sum(axis=1))
    columns = [weight, weight * t, weight * t * t, *(weight * reading.T), *(weight * t * reading.T)]
    # Sums over the samples after each interval.
    s0, s1, s2, *others = np.cumsum(np.array(columns)[:, :0:-1], axis=1)[:, ::-1, None]
    y, ty = np.split(np.array(others), 2)
    step = np.diff(t)[:, None]
    begins = t[:-1, None] + step * (np.arange(_BETWEEN) + 0.5) / _BETWEEN
    grown = s2 - 2.0 * begins * s1 + begins**2 * s0
    explained = ((ty - begins * y) ** 2).sum(axis=0) / np.maximum(grown, 1e-300)
    share = np.exp(0.5 * (explained - explained.max())) * step
    share /= share.sum()
    mean = float((share * begins).sum())
    variance = float((share * ((begins - mean) ** 2 + (step / _BETWEEN) ** 2 / 12.0)).sum())
    return float(time[-1]) + mean, math.sqrt(variance)


def in_order(
    time: Array, events: Sequence[Event], onsets: Sequence[Sequence[float]]
) -> tuple[IntArray, Array]:
    """Events (n,) and onsets (n, 2) of samples that are all known: as each contact began at last.

    An onset is put to the first sample after the contact began, which may be before that by which
    it was detected.
    """
    out, known = np.array(events, dtype=np.int64), np.array(onsets, dtype=np.float64).reshape(-1, 2)
    edges = np.flatnonzero((out == Event.ONSET) | (out == Event.LOSS)).tolist()
    for first, end in zip(edges, [*edges[1:], len(out)], strict=False):
        if out[first] != Event.ONSET:
            continue
        begun = known[end - 1]
        row = min(int(np.searchsorted(time[:first], begun[0])), first)
        out[first] = Event.NONE
        out[row] = Event.ONSET
        known[row:end] = begun
    return out, known


def _beyond(moved: list[float], variance: list[float], reach: float) -> Array:
    """What is left of a displacement, along its axes, of which a reach that it exceeds is sliding.

    The part that slides is moved / (1 + λ variance), where λ makes it as long as the reach: that
    leaves the least χ².
    """
    largest = max(variance[-1], 1e-300)
    parts = [(m, max(v, 0.0) / largest) for m, v in zip(moved, variance, strict=True)]
    low, high, slid = -40.0, 40.0, moved
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        factor = math.exp(middle)
        slid = [m / (1.0 + factor * v) for m, v in parts]
        low, high = (middle, high) if math.hypot(*slid) > reach else (low, middle)
    return np.subtract(moved, slid)
