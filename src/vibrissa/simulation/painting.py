"""Kernels that paint a frame: where the whisker takes light away, and the sensor's noise.

The image of a thin dark strip of half width w, blurred by a Gaussian of standard deviation σ, is

    c(d) = ½ [erf((w + d) / √2 σ) + erf((w − d) / √2 σ)]

at the distance d from its middle, whatever w is: a strip far thinner than a pixel is a faint line
of the right darkness. σ holds both the blur of the lens and the size of a pixel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from vibrissa.numerics import kernel

_REACH = 3.5
"""Standard deviations of the blur beyond which nothing is painted."""


@kernel
def cover(image: Any, line: Any, half_width: Any, shown: Any, sigma: float, share: float) -> None:
    """Paint how much of each pixel a strip covers, at most ``share`` of it."""
    rows, columns = image.shape
    last = line.shape[0] - 2
    scale = 1.0 / (math.sqrt(2.0) * sigma)
    for k in range(last + 1):
        x0, y0 = line[k, 0], line[k, 1]
        ex, ey = line[k + 1, 0] - x0, line[k + 1, 1] - y0
        length = math.sqrt(ex * ex + ey * ey)
        if not (length > 1e-9 and (shown[k] > 0.0 or shown[k + 1] > 0.0)):
            continue
        ex, ey = ex / length, ey / length
        reach = max(half_width[k], half_width[k + 1]) + _REACH * sigma
        left = max(0, math.floor(min(x0, line[k + 1, 0]) - reach))
        right = min(columns - 1, math.ceil(max(x0, line[k + 1, 0]) + reach))
        top = max(0, math.floor(min(y0, line[k + 1, 1]) - reach))
        bottom = min(rows - 1, math.ceil(max(y0, line[k + 1, 1]) + reach))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                along = (column - x0) * ex + (row - y0) * ey
                t = max(along, 0.0)
                end = 1.0
                if k == last:
                    end = 0.5 * (1.0 + math.erf((length - along) * scale))
                else:
                    t = min(t, length)
                dx, dy = column - x0 - t * ex, row - y0 - t * ey
                d = math.sqrt(dx * dx + dy * dy)
                if d > reach:
                    continue
                f = min(t / length, 1.0)
                w = half_width[k] + f * (half_width[k + 1] - half_width[k])
                seen = shown[k] + f * (shown[k + 1] - shown[k])
                c = 0.5 * (math.erf((w + d) * scale) + math.erf((w - d) * scale))
                value = share * c * end * seen
                if value > image[row, column]:
                    image[row, column] = value


@kernel
def collect(covered: Any, total: Any, line: Any, reach: float) -> None:
    """Move what was covered, near a line, to the total, and clear it."""
    rows, columns = covered.shape
    for k in range(line.shape[0] - 1):
        left = max(0, math.floor(min(line[k, 0], line[k + 1, 0]) - reach))
        right = min(columns - 1, math.ceil(max(line[k, 0], line[k + 1, 0]) + reach))
        top = max(0, math.floor(min(line[k, 1], line[k + 1, 1]) - reach))
        bottom = min(rows - 1, math.ceil(max(line[k, 1], line[k + 1, 1]) + reach))
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if covered[row, column] > 0.0:
                    total[row, column] += covered[row, column]
                    covered[row, column] = 0.0


@kernel
def expose(
    light: Any,
    total: Any,
    noise: Any,
    starts: Any,
    gain: float,
    read_noise: float,
    frame: Any,
) -> None:
    """Turn light into grey values with noise."""
    rows, columns = frame.shape
    for row in range(rows):
        start = starts[row]
        for column in range(columns):
            value = light[row, column] * (1.0 - min(total[row, column], 1.0))
            spread = math.sqrt(value / gain + read_noise * read_noise)
            value += spread * noise[start + column] + 0.5
            frame[row, column] = np.uint8(min(max(value, 0.0), 255.0))


@kernel
def shade(image: Any, center: Any, inverse: Any, level: float, edge: float, box: Any) -> None:
    """Paint a soft dark ellipse."""
    scale = 1.0 / (math.sqrt(2.0) * edge)
    a, b, c = inverse[0, 0], inverse[0, 1], inverse[1, 1]
    for row in range(box[0], box[1]):
        y = row - center[1]
        for column in range(box[2], box[3]):
            x = column - center[0]
            gx, gy = a * x + b * y, b * x + c * y
            m = math.sqrt(x * gx + y * gy) + 1e-12
            # Distance from the edge, to first order.
            v = (m - 1.0) * m / (math.sqrt(gx * gx + gy * gy) + 1e-12) * scale
            if v <= 2.5:
                w = 1.0 if v < -2.5 else 0.5 * (1.0 - math.erf(v))
                image[row, column] += (level - image[row, column]) * w
