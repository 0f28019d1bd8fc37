"""A whisker at rest beside surfaces: how near it is, when it meets one, how it gets out of one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.numerics import Array
from vibrissa.objects import Placement, Surface, between
from vibrissa.rod.pegs import Rest

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

# Every so many samples of the resting whisker are enough to see whether it may touch, and a free
# whisker is looked at again whenever it has moved by this, m.
_EVERY = 4
_LOOK = 1e-4
#: Around the sample that is nearest, so many parts are looked at, so many times.
ZOOM, ZOOMS = 16, 4
# Ways tried to get a whisker out of what it would rest in.
_SIDES = 16


class Resting:
    """The resting whisker among surfaces."""

    def __init__(self, whisker: Whisker, surfaces: Sequence[Surface]) -> None:
        rest = Rest.of(whisker)
        every = slice(None, None, _EVERY)
        self._surfaces, self._length = surfaces, whisker.length
        self.s: Array = rest.s[every]
        self.place: Array = rest.position[every] * whisker.length
        self.radius: Array = rest.radius[every] * whisker.length
        self._slope: Array = rest.frame[every, :, 0] * whisker.length

    def at(self, s: Array) -> tuple[Array, Array]:
        """Places (n, 3) and radii (n,) at s/L, m, by cubics between the samples."""
        i = np.clip(np.searchsorted(self.s, s) - 1, 0, self.s.size - 2)
        h = self.s[i + 1] - self.s[i]
        t = (s - self.s[i]) / h
        radius = (1.0 - t) * self.radius[i] + t * self.radius[i + 1]
        t, h = t[:, None], h[:, None]
        u = 1.0 - t
        start = u * u * ((1.0 + 2.0 * t) * self.place[i] + t * h * self._slope[i])
        end = t * t * ((3.0 - 2.0 * t) * self.place[i + 1] - u * h * self._slope[i + 1])
        return start + end, radius

    def direction(self, s: float) -> Array:
        """Unit tangent (3,) near s/L."""
        slope = self._slope[int(np.argmin(np.abs(self.s - s)))]
        return np.asarray(slope / np.linalg.norm(slope))

    def gap(self, surface: int, place: Placement) -> tuple[float, float]:
        """Smallest distance between resting whisker and surface, m, and s/L there."""
        solid = self._surfaces[surface]
        gap = solid.signed_distance(place.outside(self.place)) - self.radius
        i = int(np.argmin(gap))
        least, at = float(gap[i]), float(self.s[i])
        spacing = (self.s[1] - self.s[0]) * self._length
        if abs(least) > spacing:
            return least, at
        # Between samples it may be nearer, beside an edge much nearer.
        inner = np.concatenate([[np.inf], gap, [np.inf]])
        dips = (inner[1:-1] <= inner[:-2]) & (inner[1:-1] <= inner[2:])
        for dip in np.flatnonzero(dips & (gap < least + 0.5 * spacing)).tolist():
            low, high = self.s[max(dip - 1, 0)], self.s[min(dip + 1, gap.size - 1)]
            for _ in range(ZOOMS):
                s = np.linspace(low, high, ZOOM + 1)
                place_s, radius = self.at(s)
                gap_s = solid.signed_distance(place.outside(place_s)) - radius
                j = int(np.argmin(gap_s))
                if gap_s[j] < least:
                    least, at = float(gap_s[j]), float(s[j])
                low, high = s[max(j - 1, 0)], s[min(j + 1, ZOOM)]
        return least, at

    def first_meeting(
        self, before: Placement, now: Placement
    ) -> tuple[int, Placement, Placement] | None:
        """Surface that the free whisker meets first, a placement where it does and one after."""
        way = np.linalg.norm(now.outside(self.place) - before.outside(self.place), axis=1).max()
        near = [i for i in range(len(self._surfaces)) if self.gap(i, now)[0] < way]
        if not near:
            return None
        looks = int(np.ceil(way / _LOOK)) + 1
        last = 0.0
        for look in range(1, looks + 1):
            share = look / looks
            place = between(before, now, share)
            first: tuple[float, int] | None = None
            for i in near:
                if self.gap(i, place)[0] < 0.0:
                    at = self.meeting(i, before, now, last, share)
                    first = (at, i) if first is None else min(first, (at, i))
            if first is not None:
                return first[1], between(before, now, first[0]), place
            last = share
        return None

    def meeting(
        self, surface: int, before: Placement, now: Placement, low: float, high: float
    ) -> float:
        """Share of the way at which a surface is met, between one that is clear and one inside."""
        for _ in range(12):
            middle = 0.5 * (low + high)
            if self.gap(surface, between(before, now, middle))[0] < 0.0:
                high = middle
            else:
                low = middle
        return high

    def outside(self, surface: int, now: Placement) -> Placement | None:
        """Where a whisker that would rest inside a surface is moved to touch it from outside.

        On the side of the surface that is nearest; None if there is none within two lengths.
        """
        _, s = self.gap(surface, now)
        place, slope = self.at(np.array([s]))[0][0], self.direction(s)
        _, normal, _ = self._surfaces[surface].local_geometry(now.outside(place))
        along = now.rotation @ slope
        toward = normal - (normal @ along) * along
        if np.linalg.norm(toward) < 1e-6:
            toward = now.rotation[:, 1] - (now.rotation[:, 1] @ along) * along
        toward = toward / np.linalg.norm(toward)
        across = np.cross(along, toward)
        angles = np.linspace(0.0, 2.0 * np.pi, _SIDES, endpoint=False)
        ways = np.cos(angles)[:, None] * toward + np.sin(angles)[:, None] * across
        far = [self._way_out(surface, now, way) for way in ways]
        # What is nearer by rounding alone is no nearer: then the surface's own normal counts.
        nearest = int(np.argmin(np.array(far) * np.r_[1.0 - 1e-6, np.ones(_SIDES - 1)]))
        if not np.isfinite(far[nearest]):
            return None
        clear = Placement(now.rotation, now.position + far[nearest] * ways[nearest])
        return between(clear, now, self.meeting(surface, clear, now, 0.0, 1.0))

    def _way_out(self, surface: int, now: Placement, way: Array) -> float:
        """How far a resting whisker has to move along a unit vector until it is clear, m."""
        length = self._length
        distances = length * np.r_[np.linspace(0.0, 0.5, 65)[1:], 0.6, 0.8, 1.0, 1.5, 2.0]
        line = now.outside(self.place) + distances[:, None, None] * way
        gap = self._surfaces[surface].signed_distance(line) - self.radius
        clear = np.flatnonzero(gap.min(axis=1) > 0.0)
        return float(distances[clear[0]]) if clear.size else np.inf
