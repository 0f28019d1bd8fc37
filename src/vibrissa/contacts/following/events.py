"""Onset, loss and slip of a contact, sample by sample, and the time of onset.

**Onset.** A light contact is detected some samples after it began, once signals exceed the noise.
After its onset τ, the force for a steadily moving base grows in proportion to time, so that
readings y (k,), in standard deviations of the noise of a free whisker, are

    y(t) = b max(t - τ, 0) + noise,

with an unknown slope b. Maximised over b, the log-likelihood of τ is

    log p(τ) = |Σ w g y|² / (2 Σ w g²) + const,    g = max(t - τ, 0),    w = 1 / (1 + (0.1 |y|)²),

over the samples since the last contact and the first ones of this; w allows for forces that do not
grow evenly. With a uniform prior of τ, the onset is its posterior mean, with its standard
deviation.

**Loss.** The contact is not detected, and readings are as small as noise. With the threshold of
detection alone, noise would split one light contact into several.

**Slip.** Since the last sample in which it was unique, the contact point has moved farther than
sliding and noise explain. On an object at rest it slides as the whisker moves: up to twice as far
as the base has carried the point of the whisker that was there.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array, IntArray
from vibrissa.status import Event

# A contact point slips if its step exceeds the 99.9 % quantile of noise (χ², three degrees of
# freedom) between samples that are at most this far apart, s.
_BEYOND_NOISE, _NEXT = 16.27, 0.5
_CARRIED = 2.0  # largest sliding distance, as a multiple of the displacement by the base
_HALVINGS = 30  # bisections of an interval of 80 in the logarithm of a multiplier
_SETTLING = 0.01  # time within which successive slips are one, s
_NO_VARIANCE = 1e-15  # share of the largest variance below which one counts as zero
# Samples before and after an onset by which it is dated, and trial times between two of them.
_BEFORE, _AFTER, _BETWEEN = 128, 8, 6
_UNEVEN = 0.1  # relative unevenness of a reading's growth
_HELD = 2.0  # standard deviations, beyond the noise, above which a contact is held

# Default speed above which a contact point slips, in whisker lengths per second.
SLIPPING = 2.0


class Place(NamedTuple):
    """Contact point (3,) in the laboratory frame and its covariance (3, 3), not finite if unknown.

    Also whether the covariance is valid, and rotation (3, 3) and position (3,) of the base.
    """

    point: Array
    covariance: Array
    valid: bool = True
    rotation: Array | None = None
    position: Array | None = None

    def carried(self, now: Place) -> float:
        """Displacement, by the base, of the point of the whisker that was at the contact, m."""
        if self.rotation is None or now.rotation is None:
            return 0.0
        before, after = self.position, now.position
        if before is None or after is None:
            before = after = np.zeros(3)
        carried = now.rotation @ (self.rotation.T @ (self.point - before)) + after
        return math.hypot(*(carried - self.point).tolist())

    @property
    def ellipsoid(self) -> Array:
        """Covariance; for an invalid one, of a bent valley, that of a sphere as large."""
        return self.covariance if self.valid else np.trace(self.covariance) * np.eye(3)


class ContactEvents:
    """Onset, loss and slip of a contact, sample by sample, beginning with a free whisker.

    A contact point faster than ``slip_speed``, m/s, slips. ``onset`` is the time at which the
    present contact began and its standard deviation, s: that of the first sample, and NaN, where
    readings do not show it; both are NaN without contact.
    """

    def __init__(self, slip_speed: float) -> None:
        if not slip_speed > 0.0:
            raise ValueError(f"the speed of a slip is positive, m/s; got {slip_speed!r}")
        self._slip_speed = slip_speed
        self.forget()

    def forget(self) -> None:
        """Start again with a free whisker."""
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
        self, time: float, touching: bool | None, reading: Array, place: Place | None
    ) -> Event:
        """Process a sample; ``touching`` is None where it does not show whether there is a contact.

        ``reading`` (k,) is in standard deviations of the noise, zero on the average where the
        whisker is free, and empty if unknown; ``place`` is None where several contacts are
        possible.
        """
        if touching is None:
            return Event.NONE
        # Noise must not end a contact that has just been detected or is nearly lost.
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
        # After a slip the whisker settles, or rings, for some samples.
        settling, self._slipped = time - self._slipped < _SETTLING, time
        return Event.NONE if settling else Event.SLIP

    def _date(self, time: float, reading: Array, *, first: bool) -> None:
        """Store a reading, and date the onset again from the first ones of a contact."""
        if first:
            self.onset = time, math.nan
            self._datable = bool(self._times)
        if self._times and not time > self._times[-1]:
            # Rows in another order, or of another trial, do not show when the contact began.
            self._times.clear()
            self._readings.clear()
            self._datable = False
        self._since += self._touching
        if self._since > 1 + _AFTER or not reading.size or not np.isfinite(reading).all():
            return
        self._times.append(time)
        self._readings.append(reading)
        if self._touching and self._datable:
            dated = dated_onset(np.array(self._times), np.array(self._readings))
            # Readings after forces begin to fall do not improve the date.
            if not dated[1] > self.onset[1]:
                self.onset = dated

    def _slips(self, step: float, last: Place, now: Place) -> bool:
        """Whether the point moved farther in this time than sliding and noise explain."""
        moved = now.point - last.point
        if not 0.0 < step < _NEXT or math.hypot(*moved.tolist()) < self._slip_speed * step:
            return False
        slid = self._slip_speed * step + _CARRIED * last.carried(now)
        spread = now.ellipsoid + last.ellipsoid
        if not np.isfinite(spread).all():  # the noise is unknown
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

    Readings (n, k) at two times (n,) or more, s, are in standard deviations of the noise; the last
    ones are in contact.
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
    """Events (n,) and onsets (n, 2) of a complete series: each contact starts at its final onset.

    An onset is assigned to the first sample after the contact began, which may precede the one in
    which it was detected.
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
    """Part of a displacement, along its axes, that sliding up to ``reach`` does not explain.

    The sliding part is moved / (1 + λ variance), with λ such that its length is ``reach``: this
    minimises the remaining χ².
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
