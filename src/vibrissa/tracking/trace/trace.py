"""Trace of a whisker in one frame of one view: middle line and uncertainty, base to tip.

Next to another whisker, or to an edge or a line that never moves, the image is dark because of that
and not because of the whisker. Such pixels are clutter; a trace is bridged over them, and its
uncertainty grows with the distance from where it is seen. Each source of clutter has a bit: one for
everything that is static, and one for each whisker, so that no whisker hides itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import interpolate
from vibrissa.numerics import Array, Mask, inlined, kernel

STEP = 2.0  # distance between points of a trace, pixels
# Points over which the direction is taken in which a line is prolonged before its start.
_DIRECTION = 4
# Change of its length from a frame to the next, as a share of the usual one, from which a trace may
# be on something else, and share of the frames in which that may be chance.
_JUMPS, _OFTEN = 0.3, 0.05
# Turn within a fifth of its length from which a trace goes on as something else, as along an edge,
# rad: contact bends a whisker by less.
_HOOKED = 0.7
_SHARPEST = 0.05  # lower limit of the standard deviation of a point in `clearness`, pixels
_GIVEN = 0.5  # standard deviation of points marked by a person, pixels
_BACKWARD = -0.5  # cosine of the angle between segments from which points are out of order
_UNLIKE = 0.05  # correlation that counts as none


@dataclass(frozen=True)
class TraceOptions:
    """Options of tracing a whisker.

    Parameters
    ----------
    bridge : float
        Longest piece that may be hidden, pixels.
    stiffness : float
        Weight of third differences in the smoothing, which lets through waves along the whisker
        longer than about 6 · stiffness^(1/6) steps where it is seen to 0.1 pixel.
    scale : float
        Distance of samples across the whisker, pixels: about a third of its width at the base, but
        not below 1.
    shortest : float
        Length of the shortest whisker that counts, pixels.
    jump : float
        Largest distance of the whisker's first 60 pixels from where they are expected, pixels. What
        is farther away is another whisker. Each frame in which it is lost adds a pixel.
    memory : int
        Number of frames over which the usual length is remembered.
    bright : bool, optional
        Whether whiskers are bright on dark; by default the first frame decides.
    """

    bridge: float = 90.0
    stiffness: float = 3e5
    scale: float = 1.0
    shortest: float = 40.0
    jump: float = 5.0
    memory: int = 25
    bright: bool | None = None


class Trace(NamedTuple):
    """A whisker in one frame of one view.

    Attributes
    ----------
    line : array (n, 2)
        Column and row from base to tip, `STEP` pixels apart.
    sigma : array (n,)
        Standard deviation across, pixels.
    seen : array (n,)
        Whether each point is seen, not bridged.
    confidence : float
        Confidence between 0 and 1.
    base_seen, tip_seen : bool
        Whether the whisker is seen to begin and to end there. If not it goes on outside of the
        image, or fades into the noise.
    skew : float
        Third cumulant of its darkness across its nearer half, pixels³, to the left of the way from
        base to tip: 0 if light is the same on both of its flanks. NaN if that is not known.
    sparse : bool
        Whether it is a line between few points, of which residuals do not show all errors.
    shift : tuple of 4 float
        Shift of the image along columns and rows by a camera that shakes, which is taken out of
        the line, and the standard deviations of what is left of both, pixels; NaN if nothing
        shows whether it shakes.
    begin_sigma : float
        Standard deviation, along it, of where on the whisker it begins, pixels.
    width : float
        Standard deviation of its darkness across it, on its nearer half, pixels; NaN if unknown.
    """

    line: Array
    sigma: Array
    seen: Mask
    confidence: float
    base_seen: bool = True
    tip_seen: bool = True
    skew: float = np.nan
    sparse: bool = False
    shift: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    begin_sigma: float = 1.0
    width: float = np.nan

    @classmethod
    def lost(cls) -> Trace:
        """Empty trace, with confidence 0.

        Returns
        -------
        Trace
            Trace without points.
        """
        return cls(np.empty((0, 2)), np.empty(0), np.empty(0, dtype=bool), 0.0)

    @property
    def length(self) -> float:
        """Length of the line, pixels."""
        return STEP * max(len(self.line) - 1, 0)

    @property
    def support(self) -> float:
        """Length that is seen, pixels."""
        return STEP * float(self.seen.sum())

    @property
    def clearness(self) -> float:
        """Seen length, each part weighted by the inverse of its standard deviation across."""
        return STEP * float((1.0 / np.hypot(self.sigma[self.seen], _SHARPEST)).sum())


def doubtful_frames(row: Sequence[Trace]) -> Mask:
    """Frames in which a whisker is lost, its length jumps or it has a hook; none if few."""
    # What hides a part changes what is seen, what is bridged the whole: both do on another line.
    lengths = np.array([[trace.length, trace.support] for trace in row]).reshape(-1, 2)
    lost = lengths[:, 0] == 0.0
    usual = np.median(lengths[~lost], axis=0) if not lost.all() else np.zeros(2)
    wrong = lost.copy()
    jumps = np.abs(np.diff(lengths, axis=0)) > _JUMPS * usual
    wrong[1:] |= jumps.all(axis=1) & ~lost[:-1]
    wrong |= [_turn(trace.line) > _HOOKED for trace in row]
    return np.asarray(wrong & (wrong.mean() > _OFTEN))


def _turn(line: Array) -> float:
    """Largest turn of a line within a fifth of its length, rad."""
    if len(line) < 3:
        return 0.0
    angle = np.unwrap(np.arctan2(*tangent(line).T[::-1]))
    n = max(len(line) // 5, 1)
    return float(np.abs(angle[n:] - angle[:-n]).max())


def given(points: ArrayLike) -> Trace:
    """Trace through points marked by a person."""
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or len(array) < 2 or not np.isfinite(array).all():
        raise ValueError(f"points have shape {array.shape}; finite (n, 2), n ≥ 2, are needed")
    s = arc_lengths(array)
    if not (np.diff(s) > 0.0).all():
        raise ValueError("two points of a trace are the same")
    step = np.diff(array, axis=0) / np.diff(s)[:, None]
    if (back := np.flatnonzero((step[1:] * step[:-1]).sum(axis=1) < _BACKWARD)).size:
        x, y = array[back[0] + 1]
        raise ValueError(
            f"the trace turns back at ({x:.1f}, {y:.1f}); points from base to tip are needed"
        )
    spline = interpolate.make_interp_spline(s, array, k=min(3, len(array) - 1))
    line = even(np.asarray(spline(np.linspace(0.0, s[-1], int(s[-1]) + 2))))
    return Trace(line, np.full(len(line), _GIVEN), np.ones(len(line), dtype=bool), 1.0)


def arc_lengths(points: Array) -> Array:
    """Arc length (n,) of the points (n, d) of a polyline."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def interpolated(
    wanted: Array, s: NDArray[Any], points: Array, right: float | None = None
) -> Array:
    """Points (m, d) of a polyline at arc lengths, linearly; ``right`` beyond its end."""
    columns = [np.interp(wanted, s, column, right=right) for column in points.T]
    return np.stack(columns, axis=1)


def even(line: Array, start: float = 0.0) -> Array:
    """Points `STEP` apart along a line (n, 2), from an arc length on, which may be negative."""
    line = np.ascontiguousarray(line)
    # No polyline is longer than its sides along the axes together.
    most = np.abs(line[1:] - line[:-1]).sum()
    points = np.empty((max(int((most - start) / STEP) + 2, 0), 2))
    return points[: space_evenly(line, start, STEP, points)]


@kernel
def space_evenly(line: Any, start: float, step: float, points: Any) -> int:
    """Find points a step apart along a line, before it in its first direction; their number."""
    last, before, count, at = line.shape[0] - 1, 0.0, 0, start
    ahead, away = min(_DIRECTION, last), 0.0
    for i in range(ahead):
        away += math.hypot(line[i + 1, 0] - line[i, 0], line[i + 1, 1] - line[i, 1])
    while at < 0.0 and ahead > 0:
        for k in range(2):
            points[count, k] = line[0, k] + at / away * (line[ahead, k] - line[0, k])
        count += 1
        at = start + count * step
    for i in range(last):
        size = math.hypot(line[i + 1, 0] - line[i, 0], line[i + 1, 1] - line[i, 1])
        while at < before + size:
            for k in range(2):
                slope = (line[i + 1, k] - line[i, k]) / size
                points[count, k] = line[i, k] + slope * (at - before)
            count += 1
            at = start + count * step
        before += size
    # Rounding may put a point that is on the line's end beyond it.
    if at < before + 1e-9:
        points[count] = line[last]
        count += 1
    return count


def tangent(line: Array) -> Array:
    """Change (n, 2) from point to point along a line: `numpy.gradient`, which takes longer."""
    along = np.empty_like(line)
    along[1:-1] = 0.5 * (line[2:] - line[:-2])
    along[0], along[-1] = line[1] - line[0], line[-1] - line[-2]
    return along


def normals(line: Array) -> Array:
    """Unit vectors (n, 2) to the left (−dy, dx) of a line at its points."""
    left = tangent(line)[:, ::-1] * [-1.0, 1.0]
    return np.asarray(left / np.maximum(np.hypot(*left.T), 1e-9)[:, None])


def aligned(line: Array, other: Array, points: int = 30) -> float:
    """Cosine between the initial directions of two lines, over at most so many points."""
    i = min(points, len(line) - 1, len(other) - 1)
    a, b = line[i] - line[0], other[i] - other[0]
    return float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-9))


def overlap(line: Array, other: Array, near: float = 3.0) -> float:
    """Share of a line that is nearer to another than some pixels."""
    if not len(line) or not len(other):
        return 0.0
    # One memory layout, for which the kernel is compiled once.
    line, other = np.ascontiguousarray(line), np.ascontiguousarray(other)
    return count_near(line, other, near) / len(line)


@kernel
def count_near(line: Any, other: Any, near: float) -> int:
    """Number of points of a line that are nearer to some point of another than some pixels.

    As lines usually follow each other, the search begins where the point before was near.
    """
    count, last, most = 0, 0, other.shape[0]
    left, right, top, low = np.inf, -np.inf, np.inf, -np.inf
    for j in range(most):
        left, right = min(left, other[j, 0] - near), max(right, other[j, 0] + near)
        top, low = min(top, other[j, 1] - near), max(low, other[j, 1] + near)
    for i in range(line.shape[0]):
        x, y = line[i, 0], line[i, 1]
        if x < left or x > right or y < top or y > low:
            continue
        for k in range(most):
            j = last + k
            if j >= most:
                j -= most
            dx, dy = other[j, 0] - x, other[j, 1] - y
            if dx * dx + dy * dy < near * near:
                count += 1
                last = max(j - 2, 0)
                break
    return count


def distances(line: Array, other: Array) -> Array:
    """Distance of each point of a line from the nearest one of another, pixels."""
    away = np.empty(len(line))
    nearest_distances(np.ascontiguousarray(line), np.ascontiguousarray(other), away)
    return away


@kernel
def nearest_distances(line: Any, other: Any, away: Any) -> None:
    """Distance of each point of a line from the nearest one of another."""
    for i in range(line.shape[0]):
        least = np.inf
        for k in range(other.shape[0]):
            dx, dy = other[k, 0] - line[i, 0], other[k, 1] - line[i, 1]
            least = min(least, dx * dx + dy * dy)
        away[i] = math.sqrt(least)


@inlined
def nearest(line: Any, first: int, last: int, x: float, y: float, step: float, near: int) -> int:
    """Index, from ``first`` to before ``last``, of the point of a line nearest to another one.

    Its points are at most ``step`` apart: those that cannot be nearer than the nearest one so far,
    at first a guess, are skipped.
    """
    least = math.sqrt((line[near, 0] - x) ** 2 + (line[near, 1] - y) ** 2)
    i = first if least < np.inf else last
    while i < last:
        away = math.sqrt((line[i, 0] - x) ** 2 + (line[i, 1] - y) ** 2)
        if away < least or (away == least and i < near):
            least, near = away, i
        i += max(1, int((away - least) / step))
    return near


def correlated(misses: Sequence[Array]) -> float:
    """Number of neighbouring residuals that count as one."""
    total, most = 1.0, min(one.shape[1] for one in misses) // 2
    size = sum(float((one**2).mean()) for one in misses)
    for lag in range(1, most):
        both = sum(float((one[:, lag:] * one[:, :-lag]).mean()) for one in misses)
        if both <= _UNLIKE * size:
            break
        total += 2.0 * both / size
    return total


Bits = NDArray[np.uint32]

# Distance within which another whisker disturbs, pixels, for a whisker of typical width.
NEAR = 5.0
# Bits of static objects that hide whiskers, and of those in front of or next to which they are
# seen.
STILL, EDGE = np.uint32(1), np.uint32(2)
_WHISKERS = 30  # number of bits for whiskers


class Clutter(NamedTuple):
    """Clutter for one whisker: pixels with any of the selected bits."""

    bits: Bits
    which: int

    def hides(self, points: Array) -> Mask:
        """Whether clutter hides points (n, 2)."""
        return self._at(points, self.which)

    def disturbs(self, points: Array) -> Mask:
        """Whether something static is behind points (n, 2) or next to them."""
        return self._at(points, int(EDGE))

    def _at(self, points: Array, which: int) -> Mask:
        column, row = np.rint(points).astype(np.intp).T
        at = np.ravel_multi_index((row, column), self.bits.shape, mode="clip")
        return np.asarray((self.bits.take(at) & np.uint32(which)) != 0)

    @property
    def still_only(self) -> Clutter:
        """The static clutter, without other whiskers."""
        return self._replace(which=int(STILL))


NOTHING = Clutter(np.zeros((1, 1), dtype=np.uint32), 0)  # no clutter


@inlined
def in_the_way(bits: Any, which: Any, x: float, y: float) -> Any:
    """Whether a point has any of the selected bits."""
    row = min(max(int(y + 0.5), 0), bits.shape[0] - 1)
    column = min(max(int(x + 0.5), 0), bits.shape[1] - 1)
    return (bits[row, column] & which) != 0


def between_whiskers(
    lines: Sequence[Array | None], still: Bits | None, shape: tuple[int, int], near: float = NEAR
) -> list[Clutter]:
    """Clutter for each of several whiskers, whose lines (n, 2) are approximately known, or None."""
    bits = np.zeros(shape, np.uint32) if still is None else still.copy()
    for k, line in enumerate(lines):
        if line is not None and len(line):
            paint(bits, np.ascontiguousarray(line), near, np.uint32(_own(k)))
    every = (1 << 32) - 1 - int(EDGE)
    return [Clutter(bits, every & ~_own(k)) for k in range(len(lines))]


def _own(whisker: int) -> int:
    return 1 << (2 + whisker % _WHISKERS)


@kernel
def paint(bits: Any, line: Any, near: float, bit: Any) -> None:
    """Mark the pixels near a line."""
    rows, columns = bits.shape
    for k in range(line.shape[0]):
        x, y = line[k, 0], line[k, 1]
        for row in range(max(0, math.ceil(y - near)), min(rows, math.floor(y + near) + 1)):
            for column in range(
                max(0, math.ceil(x - near)), min(columns, math.floor(x + near) + 1)
            ):
                if (row - y) ** 2 + (column - x) ** 2 <= near * near:
                    bits[row, column] |= bit
