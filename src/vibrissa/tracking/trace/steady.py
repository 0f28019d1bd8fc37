"""A camera that shakes: by how much each image is shifted, from what never moves in it.

Edges that stand still give the shift d of a frame I from their usual image M by least squares,

    I(x + d) = a M(x) + b,

where a and b are changes of the light. What does not move with the rest, as a part of the face or a
whisker that passes, is weighted down by what it leaves in all frames. Blocks of the image, whose
pixels have errors in common, show the error of the shift by what they disagree about.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import ndimage
from vibrissa.io import Frame
from vibrissa.numerics import Mask
from vibrissa.tracking.trace.ridge import noise_level
from vibrissa.tracking.trace.scene import Scene

Array = NDArray[np.float64]
_Numbers = NDArray[np.intp]

_BLOCK, _EACH = 8, 8  # width of a block and largest number of its pixels that are used
_FEWEST = 4.0  # number of blocks, as far as they count alike, from which a shift is known
_EDGE = 4.0  # grey values by which an edge's slope over a pixel exceeds the noise's
_ROUNDS, _STEPS = 3, 3  # numbers of rounds that change the usual image, and of steps to a shift
_RARE = 3.0  # standard deviations from which a pixel shows something else
_FINE = 0.3  # standard deviation of grey values by rounding
_FARTHEST = 6.0  # largest shift, pixels
# What is known of a shift, in pixels, and of the light's changes where nothing shows them.
_PRIOR = np.diag([1.0, 1.0, 1.0, 1e-4])
# Standard deviation of shifts from which a camera shakes, pixels, and in units of their errors.
_SHAKES, _CERTAIN = 0.05, 4.0
_UNSEEN = 0.03  # standard deviation of what compression adds to all blocks alike, pixels
# Share of the shifts by which a block moves below which it stands still in the image, as dirt on
# the sensor does, and how well that must be known. If there are more of these blocks than so many,
# with such a share of all edges, it is something else that moves.
_LESS, _KNOWN, _MOST, _DIRT = 0.5, 5.0, 2, 0.2
_PARTS = 8  # number of parts of a film whose means show slow motion


@dataclass(frozen=True, eq=False)
class Steady:
    """Where what never moves usually is in a view that shakes."""

    at: NDArray[np.intp]  # (2, n): column and row of pixels, sorted by blocks
    blocks: NDArray[np.intp]  # (b,) first pixel of each block
    slopes: Array  # (n, 4): change by the shift along columns and rows, the light, and one
    soft: Array  # (n, 4): the same of a smoothed image, whose noise is another one
    weight: Array  # (n,)
    trust: Array  # (2, 2): share of a measured shift that is believed
    sigma: Array  # (2,): standard deviation of what is left of it, pixels

    @classmethod
    def of(cls, scene: Scene, frames: Sequence[Frame]) -> Steady | None:
        """Take it from frames of a view; None if its camera does not shake."""
        unknown = cls.unknown()
        # A whisker begins before what moves with it: that may be most of what seems to be still.
        if scene.still is None or scene.still.before_body or scene.background is None:
            return unknown
        slopes = _slopes(scene.background)
        at, blocks = _edges(np.hypot(*slopes), noise_level(scene.background), scene.still.at)
        if len(blocks) < _FEWEST:
            return unknown
        ones = np.ones(len(at[0]))
        soft = np.stack([*(-each[at[1], at[0]] for each in slopes), ones, ones], axis=1)
        one = cls(at, blocks, soft, soft, ones, np.eye(2), np.zeros(2))
        shifts = np.zeros((len(frames), 2))
        one = one._with_usual(frames, shifts)
        for i in range(_ROUNDS + 1):
            shifts = np.array([one.measured(frame) for frame in frames])
            shifts -= shifts.mean(axis=0)
            if np.linalg.norm(np.cov(shifts.T), 2) < _SHAKES**2:
                return None
            one = one._with_usual(frames, shifts)
            if i == _ROUNDS - 1:
                rests, share = one._resting(frames, shifts)
                if rests.sum() > _MOST and share > _DIRT:
                    return None
                if not rests.any():
                    break
                one = one._without(rests)
        error, number = one._errors(frames, shifts)
        if number < _FEWEST:
            return unknown
        error *= number / (number - 2.0) * max(1.0, one._disagreement(frames, shifts))
        spread = np.cov(shifts.T)
        inverse = np.linalg.inv(np.linalg.cholesky(error))
        certain, ways = np.linalg.eigh(inverse @ spread @ inverse.T)
        ways = inverse.T @ ways[:, certain > _CERTAIN**2]
        sizes = ((spread - error) @ ways * ways).sum(axis=0) / (ways**2).sum(axis=0)
        size = float(sizes.max(initial=0.0))
        if size < _SHAKES**2:
            return unknown
        # As much in a direction in which nothing shows it.
        trust = np.asarray(size * np.linalg.inv(error + size * np.eye(2)))
        sigma = np.sqrt(np.diag(error @ trust) + _UNSEEN**2)
        return replace(one, trust=trust, sigma=sigma)

    @classmethod
    def unknown(cls) -> Steady:
        """Make one of a view that does not show whether its camera shakes."""
        none, empty = np.zeros(0, dtype=np.intp), np.zeros((0, 4))
        left = np.full(2, np.nan)
        return cls(np.stack([none, none]), none, empty, empty, empty[:, 0], np.eye(2), left)

    def moved_back(self, frame: Frame) -> tuple[Frame, tuple[float, float, float, float]]:
        """The frame as it would be without its shift, and `Trace.shift`."""
        if not self.at.size:
            return frame, (0.0, 0.0, np.nan, np.nan)
        shift = self.trust @ self.measured(frame)
        whole = np.floor(shift).astype(int)
        part = (shift - whole).astype(np.float32)
        rows, columns = frame.shape
        most = int(_FARTHEST) + 2
        wide = np.pad(frame, most, mode="edge")
        column, row = most + whole
        image = wide[row : row + rows] * (1 - part[1]) + wide[row + 1 : row + 1 + rows] * part[1]
        first, second = image[:, column : column + columns], image[:, column + 1 :][:, :columns]
        image = first * (1 - part[0]) + second * part[0]
        moved = np.asarray(np.rint(image, out=image), dtype=frame.dtype)
        column, row, *left = map(float, (*shift, *self.sigma))
        return moved, (column, row, left[0], left[1])

    def measured(self, frame: Frame) -> Array:
        """Shift (2,) of a frame that its edges show, pixels."""
        shift = np.zeros(2)
        for _ in range(_STEPS):
            normal, right, _ = self._equations(frame, shift)
            step = np.linalg.solve(normal, right.sum(axis=0))[:2]
            shift = np.clip(shift + step, -_FARTHEST, _FARTHEST)
        return shift

    def _with_usual(self, frames: Sequence[Frame], shifts: Array) -> Steady:
        """The same with the usual image of frames whose shifts are known."""
        steps = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        pairs = list(zip(frames, shifts, strict=True))
        grey = np.array([[_at(frame, self.at, d + step) for step in steps] for frame, d in pairs])
        usual, right, left, below, above = np.median(grey, axis=0)
        slopes = np.stack(
            [0.5 * (left - right), 0.5 * (above - below), usual, np.ones_like(usual)], axis=1
        )
        soft = np.concatenate([self.soft[:, :2], slopes[:, 2:]], axis=1)
        one = replace(self, slopes=slopes, soft=soft, weight=np.ones(len(usual)))
        # With shifts as they were until now: the first round prefers what moves least.
        misses = np.array([one._left(frame, d) for frame, d in pairs])
        return replace(one, weight=1.0 / (np.mean(misses**2, axis=0) + _FINE**2))

    def _resting(self, frames: Sequence[Frame], shifts: Array) -> tuple[Mask, float]:
        """Blocks (b,) that do not move by the shifts, and how strong their edges are in all."""
        moved = shifts @ self.slopes[:, :2].T
        seen = np.empty_like(moved)
        for i, (frame, shift) in enumerate(zip(frames, shifts, strict=True)):
            light = _at(frame, self.at, shift) - self.slopes[:, 2] - self._left(frame, shift)
            seen[i] = _at(frame, self.at, np.zeros(2)) - self.slopes[:, 2] - light
        both, known = (
            np.add.reduceat((each * moved).sum(axis=0) * self.weight, self.blocks)
            for each in (seen, moved)
        )
        rests = (both < _LESS * known) & (known > _KNOWN**2)
        edges = np.add.reduceat((self.slopes[:, :2] ** 2).sum(axis=1), self.blocks)
        return rests, float(edges[rests].sum() / edges.sum())

    def _without(self, some: Mask) -> Steady:
        """The same without some blocks (b,)."""
        size = np.diff(np.append(self.blocks, self.at.shape[1]))
        kept = np.repeat(~some, size)
        parts = (each[kept] for each in (self.slopes, self.soft, self.weight))
        first = np.cumsum(np.append(0, size[~some][:-1]))
        return replace(
            self,
            **dict(zip(("slopes", "soft", "weight"), parts, strict=True)),
            at=self.at[:, kept],
            blocks=first,
        )

    def _left(self, frame: Frame, shift: Array) -> Array:
        """What the light's change leaves of the difference from the usual image."""
        miss, light = _at(frame, self.at, shift) - self.slopes[:, 2], self.slopes[:, 2:]
        return np.asarray(miss - light @ np.linalg.lstsq(light, miss)[0])

    def _equations(self, frame: Frame, shift: Array) -> tuple[Array, Array, Array]:
        """Normal equations (4, 4), their right sides (block, 4), and what is left (n,)."""
        miss = _at(frame, self.at, shift) - self.slopes[:, 2]

        def equations(weight: Array) -> tuple[Array, Array]:
            weighted = self.soft * weight[:, None]
            return weighted.T @ self.slopes + _PRIOR, weighted * miss[:, None]

        normal, right = equations(self.weight)
        left = miss - self.slopes @ np.linalg.solve(normal, right.sum(axis=0))
        scaled = np.abs(left) * np.sqrt(self.weight)
        normal, right = equations(self.weight / np.maximum(scaled / _RARE, 1.0))
        return normal, np.add.reduceat(right, self.blocks), left

    def _disagreement(self, frames: Sequence[Frame], shifts: Array) -> float:
        """Mean square distance of the shifts of two halves of the image, in their errors."""
        along = self.at[int(np.argmax(np.ptp(self.at, axis=1)))]
        order = np.argsort(along)
        known = np.cumsum((self.weight * (self.slopes[:, :2] ** 2).sum(axis=1))[order])
        middle = along[order[np.searchsorted(known, 0.5 * known[-1])]]
        halves = [
            replace(self, weight=self.weight * half) for half in (along < middle, along >= middle)
        ]
        apart = np.array([np.subtract(*(half.measured(f) for half in halves)) for f in frames])
        error = sum(half._errors(frames, shifts)[0] for half in halves)
        inverse = np.linalg.inv(np.linalg.cholesky(error))
        return float(np.linalg.norm(inverse @ np.cov(apart.T) @ inverse.T, 2))

    def _errors(self, frames: Sequence[Frame], shifts: Array) -> tuple[Array, float]:
        """Mean square error (2, 2) of shifts, and the number of blocks that show them."""
        error = np.zeros((2, 2))
        for frame, shift in zip(frames, shifts, strict=True):
            normal, right, _ = self._equations(frame, shift)
            inverse = np.linalg.inv(normal)
            error += (inverse @ (right.T @ right + _PRIOR) @ inverse.T)[:2, :2] / len(frames)
        known = np.add.reduceat(self.weight * (self.slopes[:, :2] ** 2).sum(axis=1), self.blocks)
        return 0.5 * (error + error.T), float(known.sum() ** 2 / (known**2).sum())


def slow_motion(shifts: Array) -> Array:
    """How far (view, 2) cameras may have been from where they were calibrated, pixels.

    Shifts (time, view, 2) are from the mean of a film, or of a part of it. A fast motion has that
    mean, too, when the camera is calibrated; in a slow one that may be at any moment.
    """
    means = np.array([part.mean(axis=0) for part in np.array_split(shifts, _PARTS) if len(part)])
    return np.asarray(0.5 * np.ptp(means, axis=0))


def _at(frame: Frame, at: NDArray[np.intp], shift: Array) -> Array:
    """Grey values at pixels, shifted by less than the distance of all of them from the border."""
    whole = np.floor(shift).astype(int)
    (x, y), (column, row), wide = shift - whole, at, frame.shape[1]
    first, flat = (row + whole[1]) * wide + column + whole[0], frame.reshape(-1)
    above = (1.0 - x) * flat[first] + x * flat[first + 1]
    below = (1.0 - x) * flat[first + wide] + x * flat[first + wide + 1]
    return np.asarray((1.0 - y) * above + y * below)


def _slopes(image: Any) -> list[Any]:
    """Slopes of a smoothed image along columns and rows."""
    return [ndimage.gaussian_filter(image, 1.0, order) for order in ((0, 1), (1, 0))]


def _edges(slope: Any, noise: float, still: NDArray[np.intp]) -> tuple[_Numbers, _Numbers]:
    """Pixels (2, n) of what stands still that change most by a shift, and where blocks begin."""
    rows, columns = slope.shape
    row, column = np.divmod(still, columns)
    margin = int(_FARTHEST) + 3
    inside = np.minimum(row, rows - 1 - row) >= margin
    inside &= np.minimum(column, columns - 1 - column) >= margin
    inside &= slope[row, column] > _EDGE * max(noise, _FINE)
    row, column = row[inside], column[inside]
    block = row // _BLOCK * columns + column // _BLOCK
    order = np.lexsort([-slope[row, column], block])
    first = np.flatnonzero(np.diff(block[order], prepend=-1))
    size = np.diff(np.append(first, len(order)))
    order = order[np.arange(len(order)) - np.repeat(first, size) < _EACH]
    at = np.stack([column[order], row[order]])
    return at, np.flatnonzero(np.diff(block[order], prepend=-1))
