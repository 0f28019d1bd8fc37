"""Static scene of a view: its light, its background, and the darkness of bodies.

A whisker is thin and moves. A grey closing removes thin structures, leaving light and bodies (the
face, objects). The value that a pixel exceeds in a sixth of the frames is its background, on which
moving whiskers leave no trace; the difference from it does not show wires, glints and scale bars.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import ndimage
from vibrissa.io import Frame
from vibrissa.numerics import Mask, kernel
from vibrissa.tracking.trace.ridge import middle, noise_level
from vibrissa.tracking.trace.trace import EDGE, STILL, Bits, Trace, normals

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Labels = NDArray[np.int32]

_HALF = 2  # factor by which images are reduced before bodies are searched in them
_THIN = 7  # width of what a closing removes, pixels of half the size, for a whisker of usual width
# Smoothing of the light, and of bodies before their edge is taken, pixels of half the size.
_SOFT, _EDGE = 4.0, 0.75
_SPARSE = 8  # distance of the pixels from which the brightness of a frame is taken
_RANK = 0.15  # share of the frames in which a pixel is brighter than its background
_FEWEST = 6  # number of frames from which a background is computed
_UNLIT = 0.3  # brightness of a frame, relative to the usual, below which its lamp is off
# Largest brightness of bodies, in the mean and at their edges, relative to the light.
_DARK, _LIT = 0.75, 0.85
_EVEN = 0.01  # weight of the light being even, relative to that of the pixels
_SMALLEST = 40  # area of the smallest body, pixels of half the size
_LARGE = 0.02  # smallest share of the image that a face covers
_BESIDE = 10.0  # distance from a face up to which a point is taken to be on it, pixels
# Share of the light by which a thin line that never moves is darker: less where this many standard
# deviations of the background's noise are less, but no less than the second number.
_LINE, _FAINT, _NOISES = 0.06, 0.025, 8.0
_USUAL = 0.5  # part of that by which it, or a body, is also seen in the usual image
_MANY = 15  # number of frames from which it is clear what never moves
# Extent of the smallest still line and half the width of the thinnest still body, pixels.
_LONG, _THICK = 60, 5
# How far an edge is blurred, and the smoothing of the light around still things, pixels.
_BLUR, _AROUND = 3, 12.0
# Darkening from the background to the usual value from which a whisker passes there, standard
# deviations of the noise (one of them is the background's own rank), at least such a share of what
# the background is darker than the light, and the share of a line along which one does from which
# it is nothing else.
_SWEPT, _DARKER, _MOSTLY = 2.5, 0.25, 0.5
_SHADED = 12  # width of the softest edge of a shadow, pixels
_ENOUGH = 0.02  # share of open ground around a pixel from which its light is known
# Share of the light below which nothing is seen before a still thing, and how far from there a
# whisker's middle must be, pixels.
_OPAQUE, _SEEN = 0.5, 1
# Share of the light from which the blurred edge of a still thing does not disturb, and the width of
# the most blurred one, pixels.
_CLEAR, _SOFTEST = 0.97, 6
# Distance from a base within which a still thing is taken to be the face, and within which a still
# line may be the whisker, pixels.
_AT_BASE, _CLOSE = 25.0, 6.0
# How far a still body is seen around it, pixels, and mean of the directions to a line's points from
# which it begins at a base, as a resting whisker does, and does not pass it.
_RIM, _ONE_SIDE = 4, 0.8
# Distance within which a body covers such a share of all around a base that is before it.
_DEEP, _COVERED = 45.0, 0.98
# Change of brightness by pixel across a line, as a share of the light, from which something static
# ends there; how far from the line, pixels; and number of points along it from which the line
# follows that edge, and of those after it at most, if it ends there.
_SHARP, _WITHIN, _FOLLOWS, _AFTER = 0.026, 2, 25, 5
# Share of the points before on such edges from which the line is one itself: a whisker at rest.
_AT_REST = 0.3
# Differences that count, grey values: what is darker or brighter counts as these.
_RANGE = (-20.0, 80.0)


@dataclass(frozen=True, eq=False)
class Bodies:
    """Dark bodies in one frame, in an image of half its size."""

    label: Labels
    face: NDArray[np.bool_]

    def at(self, points: Array) -> Labels:
        """Number of the body that covers each point of the frame; 0 where there is none."""
        at = np.asarray(points / _HALF, dtype=np.int64)
        rows, columns = self.label.shape
        row, column = at[:, 1].clip(0, rows - 1), at[:, 0].clip(0, columns - 1)
        return np.asarray(self.label[row, column])

    def near(self, points: Array) -> list[int]:
        """Numbers of the bodies on which points are, or that are next to them."""
        around = np.stack(np.meshgrid([-_BESIDE, 0.0, _BESIDE], [-_BESIDE, 0.0, _BESIDE]), axis=-1)
        found = self.at((points[:, None] + around.reshape(-1, 2)).reshape(-1, 2))
        return sorted({int(body) for body in found if body})


@dataclass(frozen=True, eq=False)
class Scene:
    """One view without its whiskers."""

    light: Image
    level: Image
    background: Image | None
    sample: Image
    thin: int
    ground: Image
    count: int
    mask: NDArray[np.bool_] | None = None
    still: Still | None = None

    @classmethod
    def of(
        cls, frames: Sequence[Frame], scale: float = 1.0, mask: NDArray[np.bool_] | None = None
    ) -> Scene:
        """Scene from frames of one view; masked pixels contain no whisker."""
        if mask is not None and mask.shape != frames[0].shape:
            raise ValueError(
                f"a mask has {mask.shape[1]} × {mask.shape[0]} pixels and the video "
                f"{frames[0].shape[1]} × {frames[0].shape[0]}; one of its size is needed"
            )
        sparse = np.stack([f[::_SPARSE, ::_SPARSE] for f in frames]).astype(np.float32)
        usual = np.median(sparse, axis=0)
        thin = 2 * int(np.ceil(0.5 * _THIN * scale)) - 1
        background = None
        gains = np.array([_gain(one, usual) for one in sparse], dtype=np.float32)
        lit = [frame for frame, gain in zip(frames, gains, strict=True) if gain > _UNLIT]
        if len(lit) >= _FEWEST:
            background = np.empty(frames[0].shape, dtype=np.float32)
            rank = max(1, int(_RANK * len(lit)))
            nth_largest(np.stack(lit), gains[gains > _UNLIT], rank, background)
            background -= np.median(background[::_SPARSE, ::_SPARSE] - usual)
        light, ground, share = _light_and_ground(
            frames[0] if background is None else background, thin
        )
        usual = np.asarray(usual, dtype=np.float32)
        return cls(light, share * ground, background, usual, thin, ground, len(frames), mask)

    def gain(self, frame: Frame) -> float:
        """Brightness of a frame relative to the scene."""
        return _gain(frame[::_SPARSE, ::_SPARSE], self.sample)

    def bodies(self, frame: Frame) -> Bodies:
        """Find dark regions that are not thin in a frame."""
        dark = blurred(_closed(_halved(frame), self.thin), _EDGE) < self.level * self.gain(frame)
        labels, count = ndimage.label(dark)
        area = np.bincount(labels.ravel(), minlength=count + 1)
        area[0] = 0
        border = np.zeros(count + 1, dtype=bool)
        for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
            border[edge] = True
        number = np.where(area >= _SMALLEST, np.arange(count + 1), 0)
        label_ = number[labels].astype(np.int32)
        face = border & (area > _LARGE * labels.size)
        if self.mask is not None:
            rows, columns = label_.shape
            masked = self.mask[::_HALF, ::_HALF][:rows, :columns]
            label_ = np.where(masked & (label_ == 0), np.int32(count + 1), label_)
            face = np.append(face, False)
        return Bodies(label_, face)

    def lit(self, frame: Frame) -> bool:
        """Whether there is light on a frame: divided by its brightness, a dark one is noise."""
        return self.gain(frame) > _UNLIT

    def difference(self, frame: Frame) -> Image:
        """Darkness of a frame compared with the light, by pixel."""
        out = np.empty(frame.shape, dtype=np.float32)
        darker(frame, self.light, self.gain(frame), *_RANGE, out)
        return out

    def change(self, frame: Frame) -> Image:
        """Darkness of a frame compared with its background or, if that is unknown, the light."""
        if self.background is None:
            return self.difference(frame)
        out = np.empty(frame.shape, dtype=np.float32)
        darker(frame, self.background, self.gain(frame), *_RANGE, out)
        if self.mask is not None:
            out[self.mask] = 0.0
        return out

    @property
    def bits(self) -> Bits | None:
        """Bits of `Clutter` for static or masked pixels; None if there are none."""
        bits = None if self.still is None else self.still.bits
        if self.mask is None:
            return bits
        masked = STILL * self.mask.astype(np.uint32)
        return masked if bits is None else bits | masked

    def before_edge(self, trace: Trace) -> Trace:
        """The part of a trace before it follows the edge of something static to its end."""
        n = len(trace.line)
        if self._slopes is None or n < _FOLLOWS:
            return trace
        normal = normals(trace.line)
        away = np.arange(-_WITHIN, _WITHIN + 1)[:, None, None]
        near = np.rint(trace.line + away * normal).astype(np.intp)
        rows, columns = self._slopes.shape[1:]
        column, row = near[..., 0].clip(0, columns - 1), near[..., 1].clip(0, rows - 1)
        across = np.abs(np.einsum("kwn,nk->wn", self._slopes[:, row, column], normal))
        on = across.max(axis=0) > _SHARP
        last = int(np.flatnonzero(on)[-1]) + 1 if on.any() else 0
        off = np.flatnonzero(~on[:last])
        first = int(off[-1]) + 1 if off.size else 0
        if (
            last < n - _AFTER
            or last - first < _FOLLOWS
            or not first
            or on[:first].mean() > _AT_REST
        ):
            return trace
        part = slice(0, first)
        return trace._replace(
            line=trace.line[part], sigma=trace.sigma[part], seen=trace.seen[part], tip_seen=False
        )

    @cached_property
    def _slopes(self) -> Array | None:
        """Change of the background's brightness (2, rows, columns), along columns and rows."""
        if self.background is None:
            return None
        return np.stack(np.gradient(blurred(self.background, _EDGE) / self.light)[::-1])

    def without_still(self, frame: Frame) -> Frame:
        """A frame without static objects, if these are known."""
        return frame if self.still is None else self.still.removed(frame, self.gain(frame))

    def with_still(
        self, bases: Array, frames: Sequence[Frame], moving: Mask | None = None
    ) -> Scene:
        """Find static objects in these frames, except those at which whiskers begin (n, 2).

        A static line at the base of a whisker that is known to move is none.
        """
        if self.background is None or self.count < _MANY:
            return self
        shown = np.maximum(self.background, 1.0)
        ground = _doubled(self.ground, shown.shape)
        least = _NOISES * noise_level(shown) / float(np.median(self.light))
        least = min(max(least, _FAINT), _LINE)

        def things(image: Image, light: Image, ground: Image, share: float) -> NDArray[np.bool_]:
            body = np.abs(image / _doubled(ground, image.shape) - 1.0) > share * (1.0 - _LIT)
            return np.asarray(body | (light / image - 1.0 > share * least))

        stands = things(shown, self.light, self.ground, 1.0)
        # Whiskers in side light leave bright halos in the background, but not in the usual image.
        some = [frame for frame in frames if self.lit(frame)][::2]
        gains, usual = np.array(list(map(self.gain, some)), dtype=np.float32), np.empty_like(shown)
        nth_largest(np.stack(some), gains, len(some) // 2 + 1, usual)
        usual = np.maximum(usual, np.float32(1.0))
        stands &= things(usual, *_light_and_ground(usual, self.thin)[:2], _USUAL)
        stands = ndimage.binary_dilation(stands, iterations=_BLUR)

        def around(stands: NDArray[np.bool_]) -> Any:
            known = np.where(stands, 0.0, 1.0).astype(np.float32)
            weight, light = (
                ndimage.gaussian_filter(one, _AROUND) for one in (known, known * shown)
            )
            return np.where(weight > _ENOUGH, light / np.maximum(weight, 1e-6), ground)

        # A soft edge of a shadow without the shadow would be a line.
        wider = ndimage.binary_dilation(stands, iterations=_SHADED)
        soft = wider & (np.abs(shown / around(wider) - 1.0) > _FAINT)
        open_ = around(stands | soft)
        soft &= ~stands
        thick = ndimage.binary_erosion(stands, iterations=_BLUR + _THICK)
        wide = ndimage.binary_dilation(thick, iterations=_BLUR + _THICK + _RIM)
        bodies, lines = ndimage.label(wide & stands)[0], ndimage.label(stands & ~wide)[0]
        swept = self._swept(frames, lines)
        stands, lines = stands & ~swept, np.where(swept, 0, lines)
        parts, _ = ndimage.label(stands)
        across = np.isin(lines, _long(lines))
        # The face moves, with all that is attached to it, but not a line that only passes the base,
        # nor a body behind a base.
        row, column = (np.arange(n) for n in stands.shape)
        lifted, resting = np.zeros_like(stands), np.zeros(len(bases), dtype=bool)
        for i, (x, y) in enumerate(bases):
            away = np.hypot.outer(row - y, column - x)
            at_base = np.isin(parts, np.unique(parts[(away < _AT_BASE) & stands]))
            if stands[away < _DEEP].mean() > _COVERED:
                # Much darker static objects hide the whisker.
                lifted |= at_base & (shown > _OPAQUE * np.median(shown[away < _DEEP]))
                continue
            for k in np.unique(lines[(away < _AT_BASE) & across]):
                if _begins(np.argwhere(lines == k)[:, ::-1] - [x, y]):
                    resting[i] = True
                    across &= (lines != k) | (moving is not None and moving[i])
            other = (bodies > 0) & ~np.isin(bodies, np.unique(bodies[away < _AT_BASE]))
            stands &= ~at_base | across | other
        # Where whiskers cross or turn it is always dark too, but only over a short length.
        stands &= np.isin(parts, _long(parts)) | np.isin(parts, np.unique(parts[thick]))
        stands = ndimage.binary_dilation(stands, iterations=_SHADED, mask=stands | soft)
        at = np.flatnonzero(stands)
        factor = (open_ / shown).ravel()[at]
        dark = stands & (shown < _OPAQUE * open_) & ~lifted
        # Where the blurred edge of what hides it lies on a whisker, its farther part shows.
        edge = stands & (shown < _CLEAR * open_) & ~lifted
        rim = ndimage.binary_dilation(dark, iterations=_SOFTEST, mask=edge)
        hidden = ndimage.binary_dilation(dark, iterations=_SEEN) | rim
        bits = STILL * hidden.astype(np.uint32)
        bits |= EDGE * stands.astype(np.uint32)
        open_, dark = open_.ravel()[at], dark.ravel()[at]
        still = Still(at, factor, open_, dark, bool(lifted.any()), bits, resting)
        return replace(self, still=still)

    def _swept(self, frames: Sequence[Frame], lines: NDArray[Any]) -> NDArray[np.bool_]:
        """Pixels of lines that are only the trace of a whisker moving by less than its width.

        Such a whisker leaves part of its darkness in the background, but is usually darker than
        that.
        """
        assert self.background is not None
        where = lines > 0
        if not where.any():
            return where
        grey = np.stack([frame[where] / np.float32(self.gain(frame)) for frame in frames])
        noise = float(np.median([noise_level(frame) for frame in frames[:_FEWEST]]))
        darker_ = np.zeros_like(where)
        # With compression, static objects vary too, more so if they are darker.
        deep = ndimage.maximum_filter(self.light - self.background, 2 * _BLUR + 1)[where]
        least = np.maximum(_SWEPT * noise, _DARKER * deep)
        darker_[where] = self.background[where] - np.median(grey, axis=0) > least
        there = ndimage.binary_dilation(darker_, iterations=_BLUR)
        size = np.bincount(lines[where])
        share = np.bincount(lines[where], there[where]) / np.maximum(size, 1)
        return np.asarray(where & (share[lines] > _MOSTLY))

    def moved(self, frame: Frame, points: Array, gain: float) -> float:
        """Share of the dark points of a frame, of known brightness, that are usually not dark."""
        if self.background is None:
            return 1.0
        column, row = np.rint(points).astype(np.int64).T
        grey = frame[row, column].astype(np.float64)
        whole = gain * self.light[row, column] - grey
        return float((gain * self.background[row, column] - grey > 0.5 * whole).mean())


@dataclass(frozen=True, eq=False)
class Still:
    """Static objects: pixels, and their darkness compared with open ground.

    An image divided by that shows a whisker in front of bright or grey objects, or next to an edge,
    as in front of open ground. Where little light is left nothing can be seen.
    """

    at: NDArray[np.intp]
    factor: Array
    open: Array
    opaque: NDArray[np.bool_]
    before_body: bool  # some whisker begins before one of these, which is grey
    bits: Bits
    resting: Mask  # (n,) whether the whisker of each base may be one of them

    def removed(self, frame: Frame, gain: float) -> Frame:
        """A frame, of known brightness, without the static objects."""
        if not self.at.size:
            return frame
        out = frame.copy()
        flat, most = out.reshape(-1), np.iinfo(frame.dtype).max
        grey = np.where(self.opaque, gain * self.open, self.factor * flat[self.at])
        flat[self.at] = np.minimum(grey + 0.5, most).astype(frame.dtype)
        return out


def _light_and_ground(image: Any, thin: int) -> tuple[Image, Image, np.float32]:
    """Light of an image without what is thin and dark; open ground in half the size, and its share.

    Below that share of the ground there are bodies.
    """
    still = _closed(_halved(image), thin + 2)
    # Black ground, as that of negatives of overexposed images, divides as one grey value.
    light = np.maximum(_doubled(blurred(still, _SOFT), image.shape), np.float32(1.0))
    return light, *_ground(still)


def _long(labels: Any) -> list[int]:
    """Labels of the parts that are long enough for a static line."""
    boxes = enumerate(ndimage.find_objects(labels), 1)
    return [k for k, box in boxes if box and max(side.stop - side.start for side in box) >= _LONG]


def _begins(away: Array) -> bool:
    """Whether a static line, by its points (n, 2) from a base, may be a resting whisker."""
    far = np.hypot(*away.T)
    nearest = away[far.argmin()]
    ways = away - nearest
    ways = ways / np.maximum(np.hypot(*ways.T), 1.0)[:, None]
    return bool(far.min() < _CLOSE or np.hypot(*ways.mean(axis=0)) > _ONE_SIDE)


def _gain(sparse: Any, usual: Any) -> float:
    # With one grey value more, so that what is black in both is as bright.
    return middle(((sparse + np.float32(1.0)) / (usual + np.float32(1.0))).ravel())


def _halved(image: Any) -> Image:
    """Image of half the size, with the brightest of four pixels."""
    rows, columns = (n - n % _HALF for n in image.shape)
    image = image[:rows, :columns]
    rowwise = np.maximum(image[::2], image[1::2])
    return np.asarray(np.maximum(rowwise[:, ::2], rowwise[:, 1::2]), dtype=np.float32)


def _doubled(image: Image, shape: tuple[int, ...]) -> Image:
    """Image of twice the size, or one pixel more."""
    large = np.repeat(np.repeat(image, _HALF, axis=0), _HALF, axis=1)
    return np.pad(large, [(0, n - m) for n, m in zip(shape, large.shape, strict=True)], mode="edge")


def _closed(image: Image, width: int) -> Image:
    """Grey closing with a square of odd width: dark structures thinner than it vanish."""
    work, out = np.empty_like(image), np.empty_like(image)
    close(image, width // 2, work, out)
    return out


@kernel
def close(image: Any, reach: int, work: Any, out: Any) -> None:
    """Grey closing with a square: the largest of all around, and the smallest of these."""
    rows, columns = image.shape
    source = image
    for sign in (np.float32(1.0), np.float32(-1.0)):
        for row in range(rows):
            first, last = max(row - reach, 0), min(row + reach, rows - 1)
            for column in range(columns):
                work[row, column] = sign * source[first, column]
            for i in range(first + 1, last + 1):
                for column in range(columns):
                    work[row, column] = max(work[row, column], sign * source[i, column])
        for row in range(rows):
            for column in range(columns):
                out[row, column] = sign * work[row, column]
            for k in range(1, reach + 1):
                for column in range(columns - k):
                    a, b = out[row, column], sign * work[row, column + k]
                    out[row, column] = sign * max(sign * a, sign * b)
                for column in range(k, columns):
                    a, b = out[row, column], sign * work[row, column - k]
                    out[row, column] = sign * max(sign * a, sign * b)
        source = out.copy()


def blurred(image: Image, sigma: float) -> Image:
    """Smooth an image with a Gaussian."""
    reach = math.ceil(3.0 * sigma)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    out = np.empty_like(image)
    blur(image, (taps / taps.sum()).astype(np.float32), np.empty_like(image), out)
    return out


@kernel
def blur(image: Any, taps: Any, work: Any, out: Any) -> None:
    """Convolve an image with a symmetric row of numbers, along rows and columns."""
    rows, columns = image.shape
    reach = taps.shape[0] // 2
    for row in range(rows):
        for column in range(columns):
            work[row, column] = 0.0
        for k in range(taps.shape[0]):
            at = min(max(row + k - reach, 0), rows - 1)
            tap = taps[k]
            for column in range(columns):
                work[row, column] += tap * image[at, column]
    padded = np.empty(columns + 2 * reach, taps.dtype)
    for row in range(rows):
        for column in range(columns + 2 * reach):
            padded[column] = work[row, min(max(column - reach, 0), columns - 1)]
        for column in range(columns):
            out[row, column] = 0.0
        for k in range(taps.shape[0]):
            tap = taps[k]
            for column in range(columns):
                out[row, column] += tap * padded[column + k]


def _ground(still: Image) -> tuple[Image, np.float32]:
    """Light on open ground, which may be uneven, and the share of it below which bodies are."""
    part = still[::4, ::4].astype(np.float64)
    rows, columns = (np.linspace(-1.0, 1.0, n) for n in still.shape)

    def terms(y: Array, x: Array) -> Array:
        return np.stack([0.0 * x + 1.0, x, y, x * x, x * y, y * y], axis=-1)

    y, x = np.meshgrid(rows[::4], columns[::4], indexing="ij")
    design, value = terms(y.ravel(), x.ravel()), np.log(np.maximum(part.ravel(), 1.0))
    # Where all is dark, the light is that of elsewhere, not an extrapolated parabola.
    even = np.sqrt(_EVEN * len(value)) * np.eye(design.shape[1])[1:]
    coefficients = np.zeros(design.shape[1])
    coefficients[0] = np.quantile(value, 0.9)
    for _ in range(30):
        # Darker pixels are weighted down, so that the fit rises to the open ground.
        low = np.minimum(value - design @ coefficients, 0.0)
        weight = 1.0 / (1.0 + (low / 0.1) ** 2)
        coefficients = np.linalg.lstsq(
            np.concatenate([design * weight[:, None], even]),
            np.concatenate([value * weight, np.zeros(len(even))]),
        )[0]
    whole = terms(*np.meshgrid(rows, columns, indexing="ij"))
    share = _threshold(np.exp(value - design @ coefficients))
    return np.asarray(np.exp(whole @ coefficients), dtype=np.float32), np.float32(share)


def _threshold(share: Array) -> float:
    """Threshold between dark and bright by Otsu's method; 0 if they do not differ enough."""
    counts, edges = np.histogram(share, bins=128, range=(0.0, 1.5))
    middle = 0.5 * (edges[1:] + edges[:-1])
    below = np.cumsum(counts).astype(np.float64)
    above = below[-1] - below
    total = np.cumsum(counts * middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        dark, bright = total / below, (total[-1] - total) / above
        between = np.nan_to_num(below * above * (bright - dark) ** 2)
    # Nearer to the light it is the light's own unevenness that is divided.
    between[edges[1:] > _LIT] = 0.0
    # Between empty bins all thresholds are equivalent: the middle one is chosen.
    best = np.flatnonzero(between >= (1.0 - 1e-9) * between.max())
    at = int(best[len(best) // 2])
    return float(edges[at + 1]) if dark[at] < _DARK * bright[at] else 0.0


@kernel
def nth_largest(frames: Any, gains: Any, rank: int, out: Any) -> None:
    """The n-th largest value of each pixel over all frames."""
    count, rows, columns = frames.shape
    top = np.empty((rank, columns), np.float32)
    for row in range(rows):
        for k in range(rank):
            for column in range(columns):
                top[k, column] = -1.0
        for i in range(count):
            share = np.float32(1.0) / gains[i]
            # Each value descends the sorted list until it replaces a smaller one, which then
            # descends.
            for column in range(columns):
                value = share * frames[i, row, column]
                for k in range(rank):
                    other = top[k, column]
                    top[k, column] = max(value, other)
                    value = min(value, other)
        for column in range(columns):
            out[row, column] = top[rank - 1, column]


@kernel
def darker(frame: Any, light: Any, gain: float, low: float, high: float, out: Any) -> None:
    """Darkness of a frame compared with the light."""
    rows, columns = frame.shape
    for row in range(rows):
        for column in range(columns):
            value = gain * light[row, column] - frame[row, column]
            out[row, column] = min(max(value, low), high)
