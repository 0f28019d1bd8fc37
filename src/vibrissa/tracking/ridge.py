"""Kernels that find and measure a thin dark line in a grey image.

Across the line, at whole steps, the image is sampled bilinearly. A place is *supported* if it is
darker than both of its sides: the edge of a dark object is darker than one side only. Where it is
supported, the line's middle is found to a fraction of a pixel by least squares,

    p(x) = b + c x − A g(x − δ) ≈ b + c x − A g(x) + A δ g'(x),

g being a Gaussian about as wide as the blurred line.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import inlined, kernel

Array = NDArray[np.float64]

HALF = 4
"""The fit takes samples from −HALF to HALF."""

WIDTH = 1.4
"""Standard deviation of g, in steps."""

TURNING = 2.8
"""By how much a whisker turns from base to tip at most, rad: what goes round is none."""


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
    """Grey value between pixels; the border goes on outside."""
    rows, columns = frame.shape
    x = min(max(x, 0.0), columns - 1.001)
    y = min(max(y, 0.0), rows - 1.001)
    i, j = int(y), int(x)
    u, v = x - j, y - i
    top = (1.0 - u) * frame[i, j] + u * frame[i, j + 1]
    low = (1.0 - u) * frame[i + 1, j] + u * frame[i + 1, j + 1]
    return (1.0 - v) * top + v * low


@inlined
def depth(p: Any, j: int) -> Any:
    """How much darker sample j is than the darker one of its two sides."""
    left = (p[j - 5] + p[j - 4] + p[j - 3]) / 3.0
    right = (p[j + 3] + p[j + 4] + p[j + 5]) / 3.0
    return min(left, right) - 0.25 * (p[j - 1] + 2.0 * p[j] + p[j + 1])


@inlined
def fit(p: Any, j: int, rows: Any, out: Any) -> None:
    """Amplitude A and place δ relative to sample j."""
    amplitude, product = 0.0, 0.0
    for i in range(9):
        amplitude -= rows[0, i] * p[j - 4 + i]
        product += rows[1, i] * p[j - 4 + i]
    out[0] = amplitude
    out[1] = product / amplitude if amplitude > 1e-9 else 0.0


@inlined
def middle_of(histogram: Any, count: int, width: int) -> Any:
    """Median of numbers that lie at multiples of a width, each being anywhere within it."""
    seen = 0
    for d in range(0, histogram.size, width):
        if 2 * (seen + histogram[d]) >= count:
            return d - 0.5 * width + width * (0.5 * count - seen) / max(histogram[d], 1)
        seen += histogram[d]
    return 0.0


@kernel
def noise_level(frame: Any) -> float:
    """Standard deviation of the noise, from second differences on a sparse grid.

    Compression takes away fine noise and leaves coarse; differences of single pixels and those that
    `depth` takes are both looked at, and the larger noise counts.
    """
    rows, columns = frame.shape
    fine, coarse = np.zeros(4096, np.int64), np.zeros(4096, np.int64)
    count = 0
    for row in range(3, rows - 3, 9):
        for column in range(5, columns - 5, 7):
            p = frame[row, column - 5 : column + 6]
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
    line: Any,
    support: Any,
) -> int:
    """Follow a line outward from a place, as a Kalman filter along arc length.

    Its state is the sideways offset, the direction and the curvature; what it measures is where
    across its way the image is darkest. Where nothing is seen it goes straight on with the
    curvature it had, and looks the farther to the sides the longer that lasts.
    """
    rows, columns = frame.shape
    x, y, angle, bend = start[0], start[1], start[2], 0.0
    p00, p11, p22 = spread[0] ** 2, spread[1] ** 2, spread[2] ** 2
    p01, p02, p12 = 0.0, 0.0, 0.0
    profile = np.empty(2 * (12 + 5) + 1)
    found = np.empty(2)
    sd = 0.8 * noise
    last, steps = 0, line.shape[0]
    turned = 0.0
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
            # P ← F P Fᵀ + Q with F = [[1, h, h²/2], [0, 1, h], [0, 0, 1]]
            a01 = p01 + h * p11 + 0.5 * h * h * p12
            a02 = p02 + h * p12 + 0.5 * h * h * p22
            p00 = p00 + h * p01 + 0.5 * h * h * p02 + h * a01 + 0.5 * h * h * a02
            p01 = a01 + h * a02
            p02 = a02
            p11 = p11 + 2.0 * h * p12 + h * h * p22
            p12 = p12 + h * p22
            p22 += drift * drift * h
        line[k, 0], line[k, 1] = x, y
        support[k] = 0.0
        if x < 2.0 or y < 2.0 or x > columns - 3.0 or y > rows - 3.0:
            break
        nx, ny = -math.sin(angle), math.cos(angle)
        gate = min(12, math.ceil(3.0 * math.sqrt(p00) / scale + 0.7))
        reach = gate + 5
        for i in range(2 * reach + 1):
            o = (i - reach) * scale
            profile[i] = sample(frame, x + o * nx, y + o * ny)
        best, value, at = -1e9, 0.0, -1
        for j in range(5, 2 * gate + 6):
            o = (j - reach) * scale
            d = depth(profile, j) / sd
            # Far from where it is expected only a darker line counts.
            likely = min(d, 12.0) - 0.5 * o * o / (p00 + 0.5 * scale * scale)
            if likely > best:
                best, value, at = likely, d, j
        if value > 3.0 and best > 0.0:
            fit(profile, at, ROWS, found)
            if found[0] > 0.0:
                offset = (at - reach + min(max(found[1], -1.5), 1.5)) * scale
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
                last = k + 1
        if (k - last + 1) * step > bridge:
            break
    return last


@kernel
def measure(
    frame: Any,
    line: Any,
    gate: int,
    noise: float,
    scale: float,
    offset: Any,
    amplitude: Any,
    flank: Any,
    support: Any,
) -> None:
    """Measure a line across a curve near it."""
    n = line.shape[0]
    rows, columns = frame.shape
    reach = gate + 5
    profile = np.empty(2 * reach + 1)
    found = np.empty(2)
    for k in range(n):
        a, b = max(k - 1, 0), min(k + 1, n - 1)
        tx, ty = line[b, 0] - line[a, 0], line[b, 1] - line[a, 1]
        size = math.sqrt(tx * tx + ty * ty) + 1e-12
        nx, ny = -ty / size, tx / size
        x, y = line[k, 0], line[k, 1]
        offset[k], amplitude[k], support[k], flank[k] = 0.0, 0.0, 0.0, 0.0
        if x < 1.0 or y < 1.0 or x > columns - 2.0 or y > rows - 2.0:
            continue
        for i in range(2 * reach + 1):
            o = (i - reach) * scale
            profile[i] = sample(frame, x + o * nx, y + o * ny)
        best, at = -1e9, reach
        for j in range(5, 2 * gate + 6):
            d = depth(profile, j) - 0.02 * noise * (j - reach) ** 2
            if d > best:
                best, at = d, j
        fit(profile, at, ROWS, found)
        offset[k] = (at - reach + min(max(found[1], -1.0), 1.0)) * scale
        amplitude[k] = found[0]
        support[k] = depth(profile, at) / (0.8 * noise)
        flank[k] = (
            0.5 * (profile[at - 5] + profile[at + 5] + profile[at - 4] + profile[at + 4]) / 2.0
        )


@kernel
def smooth(value: Any, weight: Any, stiffness: float, out: Any) -> None:
    """Smooth a row of values: least squares with a penalty on third differences."""
    n = value.shape[0]
    band = np.zeros((n, 4))  # diagonal, then the next three above
    right = np.empty(n)
    for i in range(n):
        # A little pull to zero, so that rows without any measurement have an answer.
        band[i, 0] = weight[i] + 1e-6
        right[i] = weight[i] * value[i]
    c = (-1.0, 3.0, -3.0, 1.0)
    for i in range(n - 3):
        for a in range(4):
            for b in range(a, 4):
                band[i + a, b - a] += stiffness * c[a] * c[b]
    # Cholesky of a banded matrix, L Lᵀ, in place; band[i, j] becomes L[i + j, i].
    for i in range(n):
        for j in range(4):
            if i + j >= n:
                break
            total = band[i, j]
            for m in range(1, 4 - j):
                if i - m >= 0:
                    total -= band[i - m, m] * band[i - m, m + j]
            band[i, j] = math.sqrt(total) if j == 0 else total / band[i, 0]
    for i in range(n):
        total = right[i]
        for m in range(1, 4):
            if i - m >= 0:
                total -= band[i - m, m] * out[i - m]
        out[i] = total / band[i, 0]
    for i in range(n - 1, -1, -1):
        total = out[i]
        for m in range(1, 4):
            if i + m < n:
                total -= band[i, m] * out[i + m]
        out[i] = total / band[i, 0]


@kernel
def beside(frame: Any, line: Any, distance: float, out: Any) -> None:
    """Grey values beside a curve, on its left (−dy, dx) and on its right."""
    n = line.shape[0]
    for k in range(n):
        a, b = max(k - 1, 0), min(k + 1, n - 1)
        tx, ty = line[b, 0] - line[a, 0], line[b, 1] - line[a, 1]
        size = math.sqrt(tx * tx + ty * ty) + 1e-12
        nx, ny = -distance * ty / size, distance * tx / size
        out[k, 0] = sample(frame, line[k, 0] + nx, line[k, 1] + ny)
        out[k, 1] = sample(frame, line[k, 0] - nx, line[k, 1] - ny)
