"""A thin dark line in a grey image: followed, measured across and smoothed.

The image is sampled bilinearly across the line, at whole steps. A point is *supported* if it is
darker than both of its sides: the edge of a dark object is darker than one side only. At a
supported point the middle of the line is found to a fraction of a pixel by least squares,

    p(x) = b + c x − A g(x − δ) ≈ b + c x − A g(x) + A δ g'(x),

with a Gaussian g about as wide as the blurred line. Smoothing is least squares with a penalty on
third differences, each point weighted by its own uncertainty, so that hidden parts are bridged by a
curve of even bend.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbsv

from vibrissa.io import Frame
from vibrissa.numerics import inlined, kernel
from vibrissa.tracking.trace.trace import NOTHING, STEP, Clutter, TraceOptions, in_the_way

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HALF = 4  # the fit takes samples from −HALF to HALF
WIDTH = 1.4  # standard deviation of g, in steps
TURNING = 2.8  # largest turn of a whisker from base to tip, rad
# Depth above which a point is supported while a line is followed, standard deviations.
_CLEARLY_DARK = 3.0


def _fit_rows() -> tuple[Array, float, float]:
    """Rows that give −A and A δ, and their variances for unit noise."""
    x = np.arange(-HALF, HALF + 1.0)
    g = np.exp(-0.5 * (x / WIDTH) ** 2)
    basis = np.column_stack([np.ones_like(x), x, g, -x / WIDTH**2 * g])
    inverse = np.linalg.inv(basis.T @ basis)
    rows = inverse @ basis.T
    return np.ascontiguousarray(rows[2:]), float(inverse[2, 2]), float(inverse[3, 3])


ROWS, DEPTH_VARIANCE, SLOPE_VARIANCE = _fit_rows()


@inlined
def sample(frame: Any, x: float, y: float) -> Any:
    """Grey value between pixels; the border continues outside."""
    rows, columns = frame.shape
    x = min(max(x, 0.0), columns - 1.001)
    y = min(max(y, 0.0), rows - 1.001)
    i, j = int(y), int(x)
    u, v = x - j, y - i
    top = (1.0 - u) * frame[i, j] + u * frame[i, j + 1]
    low = (1.0 - u) * frame[i + 1, j] + u * frame[i + 1, j + 1]
    return (1.0 - v) * top + v * low


@inlined
def normal(line: Any, k: int) -> Any:
    """Unit vector to the left (−dy, dx) of a line at one of its points."""
    a, b = max(k - 1, 0), min(k + 1, line.shape[0] - 1)
    tx, ty = line[b, 0] - line[a, 0], line[b, 1] - line[a, 1]
    size = math.sqrt(tx * tx + ty * ty) + 1e-12
    return -ty / size, tx / size


@inlined
def sample_across(
    frame: Any, x: float, y: float, nx: float, ny: float, reach: int, scale: float, profile: Any
) -> None:
    """Grey values at whole steps along a normal, from −reach to reach."""
    for i in range(2 * reach + 1):
        o = (i - reach) * scale
        profile[i] = sample(frame, x + o * nx, y + o * ny)


@inlined
def depth(p: Any, j: int) -> Any:
    """Darkness of sample j compared with the darker one of its two sides."""
    left = (p[j - 5] + p[j - 4] + p[j - 3]) / 3.0
    right = (p[j + 3] + p[j + 4] + p[j + 5]) / 3.0
    return min(left, right) - 0.25 * (p[j - 1] + 2.0 * p[j] + p[j + 1])


@inlined
def fit(p: Any, j: int, rows: Any, out: Any) -> None:
    """Amplitude A and position δ relative to sample j."""
    amplitude, product = 0.0, 0.0
    for i in range(9):
        amplitude -= rows[0, i] * p[j - 4 + i]
        product += rows[1, i] * p[j - 4 + i]
    out[0] = amplitude
    out[1] = product / amplitude if amplitude > 1e-9 else 0.0


@inlined
def middle_of(histogram: Any, count: int, width: int) -> Any:
    """Median of values binned by multiples of a width, each uniform within its bin."""
    seen = 0
    for d in range(0, histogram.size, width):
        if 2 * (seen + histogram[d]) >= count:
            return d - 0.5 * width + width * (0.5 * count - seen) / max(histogram[d], 1)
        seen += histogram[d]
    return 0.0


#: Share of pixels that are not saturated from which they show the noise.
_UNSATURATED = 0.05


@kernel
def noise_level(frame: Any) -> float:
    """Standard deviation of the noise, from second differences on a sparse grid.

    Compression removes fine noise and leaves coarse noise: the larger of that of single pixels and
    of the differences used by `depth` counts. Saturated pixels show no noise, but what is seen
    before them has it; they do not count unless there is hardly anything else.
    """
    rows, columns = frame.shape
    fine, coarse = np.zeros(4096, np.int64), np.zeros(4096, np.int64)
    part = frame[3 : rows - 3 : 9, 5 : columns - 5 : 7]
    darkest, lightest, clipped = part.min(), part.max(), 0
    for row in range(part.shape[0]):
        for column in range(part.shape[1]):
            clipped += part[row, column] == darkest or part[row, column] == lightest
    every = part.size - clipped < _UNSATURATED * part.size
    count = 0
    for row in range(3, rows - 3, 9):
        for column in range(5, columns - 5, 7):
            p = frame[row, column - 5 : column + 6]
            if not every and (p[5] == darkest or p[5] == lightest):
                continue
            d = abs(2 * int(p[5]) - int(p[3]) - int(p[7]))
            left = int(p[0]) + int(p[1]) + int(p[2])
            right = int(p[8]) + int(p[9]) + int(p[10])
            middle = int(p[4]) + 2 * int(p[5]) + int(p[6])
            fine[min(12 * d, 4095)] += 1
            coarse[min(abs(4 * (left + right) - 6 * middle), 4095)] += 1
            count += 1
    # Variances of both for unit noise; the median of |x| is 0.6745 standard deviations.
    a = middle_of(fine, count, 12) / (12.0 * 0.6745 * math.sqrt(6.0))
    b = middle_of(coarse, count, 2) / (12.0 * 0.6745 * math.sqrt(13.0 / 6.0))
    return float(max(a, b, 0.3))


@inlined
def darkest_expected(profile: Any, gate: int, scale: float, sd: float, variance: float) -> Any:
    """Depth, in standard deviations, and number of the most probable sample; depth 0 if none."""
    reach = gate + 5
    best, value, at = 0.0, 0.0, -1
    for j in range(5, 2 * gate + 6):
        o = (j - reach) * scale
        d = depth(profile, j) / sd
        likely = min(d, 12.0) - 0.5 * o * o / (variance + 0.5 * scale * scale)
        if likely > best:
            best, value, at = likely, d, j
    return value, at


@inlined
def carried(
    p00: float, p01: float, p02: float, p11: float, p12: float, p22: float, h: float
) -> Any:
    """F P Fᵀ, without its last element, for F = [[1, h, h²/2], [0, 1, h], [0, 0, 1]]."""
    a01 = p01 + h * p11 + 0.5 * h * h * p12
    a02 = p02 + h * p12 + 0.5 * h * h * p22
    p00 = p00 + h * p01 + 0.5 * h * h * p02 + h * a01 + 0.5 * h * h * a02
    return p00, a01 + h * a02, a02, p11 + 2.0 * h * p12 + h * h * p22, p12 + h * p22


@kernel
def march(
    frame: Any,
    start: Any,
    curvature: Any,
    spread: Any,
    drift: float,
    step: float,
    bridge: float,
    noise: float,
    scale: float,
    bits: Any,
    which: int,
    line: Any,
    support: Any,
) -> int:
    """Follow a line outward from a point by a Kalman filter along arc length.

    Its state is the sideways offset, the direction and the curvature; its measurement is the
    darkest position across the line. Where nothing is seen it continues with the same curvature,
    and the gate widens with its variance. Clutter counts neither as seen nor as missed.
    """
    rows, columns = frame.shape
    x, y, angle, bend = start[0], start[1], start[2], 0.0
    p00, p11, p22 = spread[0] ** 2, spread[1] ** 2, spread[2] ** 2
    p01, p02, p12 = 0.0, 0.0, 0.0
    profile = np.empty(2 * (12 + 5) + 1)
    found = np.empty(2)
    sd = 0.8 * noise
    last, steps = 0, line.shape[0]
    turned, missed = 0.0, 0
    for k in range(steps):
        if k > 0:
            h = step
            kappa = curvature[k - 1] + bend
            x += h * math.cos(angle + 0.5 * kappa * h)
            y += h * math.sin(angle + 0.5 * kappa * h)
            angle += kappa * h
            turned += kappa * h
            if abs(turned) > TURNING:
                break
            p00, p01, p02, p11, p12 = carried(p00, p01, p02, p11, p12, p22, h)
            p22 += drift * drift * h
        line[k, 0], line[k, 1] = x, y
        support[k] = 0.0
        if x < 2.0 or y < 2.0 or x > columns - 3.0 or y > rows - 3.0:
            break
        if in_the_way(bits, which, x, y):
            continue
        nx, ny = -math.sin(angle), math.cos(angle)
        gate = min(12, math.ceil(3.0 * math.sqrt(p00) / scale + 0.7))
        reach = gate + 5
        sample_across(frame, x, y, nx, ny, reach, scale, profile)
        value, at = darkest_expected(profile, gate, scale, sd, p00)
        missed += 1
        if value > _CLEARLY_DARK:
            fit(profile, at, ROWS, found)
            if found[0] > 0.0:
                offset = (at - reach + min(max(found[1], -1.5), 1.5)) * scale
                if in_the_way(bits, which, x + offset * nx, y + offset * ny):
                    missed -= 1
                    continue
                r = (noise * scale / found[0]) ** 2 * SLOPE_VARIANCE + 0.01 * scale * scale
                total = p00 + r
                k0, k1, k2 = p00 / total, p01 / total, p02 / total
                x += k0 * offset * nx
                y += k0 * offset * ny
                angle += k1 * offset
                turned += k1 * offset
                bend += k2 * offset
                p22 -= k2 * p02
                p12 -= k1 * p02
                p11 -= k1 * p01
                p02 -= k0 * p02
                p01 -= k0 * p01
                p00 -= k0 * p00
                line[k, 0], line[k, 1] = x, y
                support[k] = value
                last, missed = k + 1, 0
        if missed * step > bridge:
            break
    return last


@kernel
def measure(
    frame: Any,
    line: Any,
    gate: int,
    noise: float,
    scale: float,
    bits: Any,
    which: int,
    points: Any,
    amplitude: Any,
    flank: Any,
    support: Any,
) -> None:
    """Measure a line across a nearby curve, where there is no clutter."""
    n = line.shape[0]
    rows, columns = frame.shape
    reach = gate + 5
    profile = np.empty(2 * reach + 1)
    found = np.empty(2)
    for k in range(n):
        nx, ny = normal(line, k)
        x, y = line[k, 0], line[k, 1]
        points[k, 0], points[k, 1] = x, y
        amplitude[k], support[k], flank[k] = 0.0, 0.0, 0.0
        if x < 1.0 or y < 1.0 or x > columns - 2.0 or y > rows - 2.0:
            continue
        if in_the_way(bits, which, x, y):
            continue
        sample_across(frame, x, y, nx, ny, reach, scale, profile)
        best, at = -1e9, reach
        for j in range(5, 2 * gate + 6):
            d = depth(profile, j) - 0.02 * noise * (j - reach) ** 2
            if d > best:
                best, at = d, j
        fit(profile, at, ROWS, found)
        offset = (at - reach + min(max(found[1], -1.0), 1.0)) * scale
        if in_the_way(bits, which, x + offset * nx, y + offset * ny):
            continue
        points[k, 0], points[k, 1] = x + offset * nx, y + offset * ny
        amplitude[k] = found[0]
        support[k] = depth(profile, at) / (0.8 * noise)
        flank[k] = (
            0.5 * (profile[at - 5] + profile[at + 5] + profile[at - 4] + profile[at + 4]) / 2.0
        )


@kernel
def measure_ends(
    frame: Any,
    lines: Any,
    noise: float,
    scale: float,
    bits: Any,
    which: int,
    supported: float,
    points: Any,
    counts: Any,
    gains: Any,
) -> None:
    """Measure alternative continuations of a line, and count the points up to the best end of each.

    A supported point adds one; an unsupported one without clutter subtracts one.
    """
    n = lines.shape[1]
    amplitude, flank, support = np.empty(n), np.empty(n), np.empty(n)
    for k in range(lines.shape[0]):
        measure(frame, lines[k], 1, noise, scale, bits, which, points[k], amplitude, flank, support)
        worth, counts[k], gains[k] = 0.0, 1, -np.inf
        for i in range(n):
            if flank[i] > 0.0:
                worth += 1.0 if support[i] > supported else -1.0
            if worth > gains[k]:
                counts[k], gains[k] = i + 1, worth
        gains[k] = max(gains[k], 0.0)


@kernel
def flanks(frame: Any, line: Any, distances: Any, bits: Any, which: int, out: Any) -> None:
    """Grey values at distances from a curve, left (−dy, dx) and right of it; NaN in clutter."""
    for k in range(line.shape[0]):
        nx, ny = normal(line, k)
        for i in range(distances.shape[0]):
            for side in range(2):
                away = distances[i] * (1 - 2 * side)
                x, y = line[k, 0] + away * nx, line[k, 1] + away * ny
                hidden = in_the_way(bits, which, x, y)
                out[i, side, k] = np.nan if hidden else sample(frame, x, y)


# Depth above which a point of an approximately known line is supported, standard deviations.
_SUPPORTED = 2.5
_MEDIAN = 0.455  # median of the square of a standard normal number
FEWEST = 12  # number of points of the shortest line
# Standard deviation next to an edge that never moves, common to neighbouring points, pixels.
_DISTURBED = 0.15


class Measured(NamedTuple):
    """Measurements along a line, point by point."""

    amplitude: Array
    sigma: Array
    seen: Mask
    open: Mask
    noise: float

    def part(self, rows: slice) -> Measured:
        """Select points."""
        return Measured(
            self.amplitude[rows], self.sigma[rows], self.seen[rows], self.open[rows], self.noise
        )


def fitted(
    frame: Frame,
    line: Array,
    gate: int,
    noise: float,
    options: TraceOptions,
    clutter: Clutter,
    skipped: int = 0,
    held: float = 0.0,
) -> tuple[Array, Array, Array, Mask, Array, float]:
    """Measure across a line and smooth it: line, amplitude, flank, seen, weight, and excess."""
    n, line = len(line), np.ascontiguousarray(line)
    points, amplitude, flank, support = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    measure(frame, line, gate, noise, options.scale, *clutter, points, amplitude, flank, support)
    seen = (support > _SUPPORTED) & (amplitude > 0.0)
    seen[:skipped] = False
    variance = SLOPE_VARIANCE * (noise * options.scale / np.maximum(amplitude, 1e-3)) ** 2
    weight = seen / (variance + 0.03**2)
    better = smooth(points, weight + held * ~seen, options.stiffness)
    # Points far from their neighbours are weighted down in the second pass.
    miss = ((points - better) ** 2).sum(axis=1) * weight
    # Compression removes noise from flat regions, and adds it near edges.
    excess = max(1.0, middle(miss[seen]) / _MEDIAN) if seen.any() else 1.0
    weight *= 9.0 / np.maximum(miss / excess, 9.0) / excess
    better = smooth(points, weight + held * ~seen, options.stiffness)
    return better, amplitude, flank, seen, weight, excess


def measured(
    frame: Frame,
    line: Array,
    gate: int,
    noise: float,
    options: TraceOptions,
    skipped: int = 0,
    clutter: Clutter = NOTHING,
    held: float = 0.0,
) -> tuple[Array, Measured]:
    """Measure across a line, smooth it, and state the uncertainty of each point."""
    better, amplitude, flank, seen, weight, excess = fitted(
        frame, line, gate, noise, options, clutter, skipped, held
    )
    information = np.convolve(weight, np.ones(min(9, len(line))), mode="same")
    sigma = 1.0 / np.sqrt(np.maximum(information, 1.0))
    sigma += 0.05 * (0.1 * STEP * _distance_to_seen(seen)) ** 1.5
    sigma = np.hypot(sigma, np.where(clutter.disturbs(line), _DISTURBED, 0.0))
    shown = ~clutter.hides(line)
    open_ = shown & (flank > 0.6 * middle(flank[shown] if shown.any() else flank))
    return better, Measured(amplitude, sigma, seen, open_, noise * math.sqrt(excess))


def middle(values: Array) -> float:
    """Median, without the checks of NumPy, which take longer."""
    half = len(values) // 2
    before = max(half - 1, 0)
    part = np.partition(values, (before, half))
    return float(part[half] if len(values) % 2 else 0.5 * (part[before] + part[half]))


def _distance_to_seen(seen: Mask) -> Array:
    """Number of points to the nearest seen one; 1000 if there is none."""
    if not seen.any():
        return np.full(len(seen), 1e3)
    points = np.arange(float(len(seen)))
    before = np.maximum.accumulate(np.where(seen, points, -np.inf))
    after = np.minimum.accumulate(np.where(seen, points, np.inf)[::-1])[::-1]
    return np.asarray(np.minimum(points - before, after - points))


def smooth(line: Array, weight: Array, stiffness: float) -> Array:
    """Smooth a line (n, 2): weighted least squares with a penalty on third differences."""
    band = _third_differences(len(line), stiffness).copy("K")
    # A weak pull to the first point, so that lines without any measurement have a solution.
    band[0] += weight + 1e-6
    # solveh_banded is avoided, since its checks take longer than the solution.
    right = weight[:, None] * (line - line[0])
    return np.asarray(dpbsv(band, right, lower=1, overwrite_ab=1, overwrite_b=1)[1] + line[0])


@cache
def _third_differences(n: int, stiffness: float) -> Array:
    """Lower bands (4, n) of stiffness Dᵀ D, where D takes the third differences of n numbers."""
    row, band = np.array([-1.0, 3.0, -3.0, 1.0]), np.zeros((4, n), order="F")
    for k in range(4):
        band[k, : n - k] = np.convolve(np.ones(n - 3), row[: 4 - k] * row[k:])
    return np.asarray(stiffness * band)
