"""Shake of a camera: the shift of each image, from what never moves in it.

Static edges give the shift d of a frame I from their usual image M by least squares,

    I(x + d) = a(y) M(x) + b,

where a and b are changes of the light. As a rolling shutter exposes one row y after the other, a
lamp on alternating current makes bands: a(y) is a constant and a wave of the height of the image.
What moves differently, such as a part of the face or a
passing whisker, is weighted down by its residuals in all frames. Blocks of the image, whose pixels
have common errors, give the error of the shift by their disagreement.
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
_FEWEST = 4.0  # effective number of blocks from which a shift is determined
_EDGE = 4.0  # grey values by which the slope of an edge over a pixel exceeds that of the noise
_ROUNDS, _STEPS = 3, 3  # numbers of rounds that change the usual image, and of steps to a shift
_RARE = 3.0  # standard deviations above which a pixel shows something else
_FINE = 0.3  # standard deviation of grey values by rounding
_FARTHEST = 6.0  # largest shift, pixels
# Prior precisions of a shift, pixels, of changes of the light and its wave, and of a constant.
_PRIOR = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 1e-4])
# Standard deviation of shifts above which a camera shakes, pixels, and in units of their errors.
_SHAKES, _CERTAIN = 0.05, 4.0
_UNSEEN = 0.03  # standard deviation of the common shift of all blocks by compression, pixels
# Motion of a block, as a share of the shifts, below which it is fixed in the image, as dirt on the
# sensor is; required significance of that; and number of such blocks, and their share of all edges,
# above which something else moves instead.
_LESS, _KNOWN, _MOST, _DIRT = 0.5, 5.0, 2, 0.2
_BANDS = 0.02  # relative amplitude of waves of brightness that shift what is seen of edges
_PARTS = 8  # number of parts of a film whose means show slow motion


@dataclass(frozen=True, eq=False)
class Steady:
    """Usual image of what never moves, in a view that shakes."""

    at: NDArray[np.intp]  # (2, n): column and row of pixels, sorted by blocks
    blocks: NDArray[np.intp]  # (b,) first pixel of each block
    slopes: Array  # (n, 6): change by the shift along columns and rows, the light, and one
    soft: Array  # (n, 6): the same of a smoothed image, whose noise is another one
    weight: Array  # (n,)
    trust: Array  # (2, 2): weight of a measured shift
    sigma: Array  # (2,): standard deviation of the remaining shift, pixels

    @classmethod
    def of(cls, scene: Scene, frames: Sequence[Frame]) -> Steady | None:
        """Usual image from frames of a view; None if its camera does not shake."""
        unknown = cls.unknown()
        # A whisker begins before what moves with it: that may be most of what seems to be still.
        if scene.still is None or scene.still.before_body or scene.background is None:
            return unknown
        slopes = _slopes(scene.background)
        at, blocks = _edges(np.hypot(*slopes), noise_level(scene.background), scene.still.at)
        if len(blocks) < _FEWEST:
            return unknown
        ones = np.ones(len(at[0]))
        edges = [-each[at[1], at[0]] for each in slopes]
        soft = np.stack([*edges, *[ones] * (len(_PRIOR) - len(edges))], axis=1)
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
        """For a view that does not show whether its camera shakes."""
        none, empty = np.zeros(0, dtype=np.intp), np.zeros((0, len(_PRIOR)))
        left = np.full(2, np.nan)
        return cls(np.stack([none, none]), none, empty, empty, empty[:, 0], np.eye(2), left)

    def moved_back(self, frame: Frame) -> tuple[Frame, tuple[float, float, float, float]]:
        """Frame with its shift removed, and `Trace.shift`."""
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
        """Shift (2,) of a frame by its static edges, pixels."""
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
        wave = usual * _waves(len(frames[0]))[:, self.at[1]] * _banded(frames)
        light = [usual, *wave, np.ones_like(usual)]
        slopes = np.stack([0.5 * (left - right), 0.5 * (above - below), *light], axis=1)
        soft = np.concatenate([self.soft[:, :2], slopes[:, 2:]], axis=1)
        one = replace(self, slopes=slopes, soft=soft, weight=np.ones(len(usual)))
        # With shifts as they were until now: the first round prefers what moves least.
        misses = np.array([one._left(frame, d) for frame, d in pairs])
        return replace(one, weight=1.0 / (np.mean(misses**2, axis=0) + _FINE**2))

    def _resting(self, frames: Sequence[Frame], shifts: Array) -> tuple[Mask, float]:
        """Blocks (b,) that do not move with the shifts, and their share of all edges."""
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
        """The usual image without some blocks (b,)."""
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
        """Residual of a frame from the usual image after the change of light."""
        miss, light = _at(frame, self.at, shift) - self.slopes[:, 2], self.slopes[:, 2:]
        return np.asarray(miss - light @ np.linalg.lstsq(light, miss)[0])

    def _equations(self, frame: Frame, shift: Array) -> tuple[Array, Array, Array]:
        """Normal equations (6, 6), their right sides (block, 6), and residuals (n,)."""
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
        """Mean square difference of the shifts of two halves of the image, over their errors."""
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
        """Mean square error (2, 2) of shifts, and the number of blocks that determine them."""
        error = np.zeros((2, 2))
        for frame, shift in zip(frames, shifts, strict=True):
            normal, right, _ = self._equations(frame, shift)
            inverse = np.linalg.inv(normal)
            error += (inverse @ (right.T @ right + _PRIOR) @ inverse.T)[:2, :2] / len(frames)
        known = np.add.reduceat(self.weight * (self.slopes[:, :2] ** 2).sum(axis=1), self.blocks)
        return 0.5 * (error + error.T), float(known.sum() ** 2 / (known**2).sum())


def _waves(rows: int) -> Array:
    """Cosine and sine (2, rows) of a period over the height of an image."""
    phase = 2.0 * np.pi * np.arange(rows) / rows
    return np.stack([np.cos(phase), np.sin(phase)])


def _banded(frames: Sequence[Frame]) -> bool:
    """Whether the brightness of frames changes in bands, relative to the usual one of each row."""
    rows = np.array([frame.mean(axis=1) for frame in frames])
    rows /= np.maximum(rows.mean(axis=0), _FINE)
    rows /= np.maximum(rows.mean(axis=1, keepdims=True), _FINE)
    wave = 2.0 * _waves(rows.shape[1]) @ rows.T / rows.shape[1]
    return bool(np.hypot(*wave.std(axis=1)) > _BANDS)


def slow_motion(shifts: Array) -> Array:
    """Possible displacement (view, 2) of cameras since their calibration, pixels.

    Shifts (time, view, 2) are relative to the mean of a film, or of a part of it. A fast motion has
    the same mean during calibration; in a slow motion the calibration may be at any moment.
    """
    means = np.array([part.mean(axis=0) for part in np.array_split(shifts, _PARTS) if len(part)])
    return np.asarray(0.5 * np.ptp(means, axis=0))


def _at(frame: Frame, at: NDArray[np.intp], shift: Array) -> Array:
    """Grey values at pixels shifted by less than their distance from the border."""
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
    """Static pixels (2, n) that a shift changes most, and the first one of each block."""
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
