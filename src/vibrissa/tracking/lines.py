"""Thin lines in a difference image: points of ridges, and segments of points in a row.

With the image D smoothed by a Gaussian of standard deviation σ and λ the lower eigenvalue of its
second derivatives, n its eigenvector, a ridge runs through a pixel if λ < 0 and its top, at
t = −(∇D·n) / λ along n, is within the pixel (Steger 1998). Its strength is −σ²λ.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.numerics import inlined, kernel
from vibrissa.tracking.scene import Bodies, Image

Array = NDArray[np.float64]

SIGMA = 1.6
"""Smoothing, pixels, for a whisker of usual width."""

_LEAST, _CLEAR = 2.0, 4.0
"""Strength of points that belong to a line, and from which one is begun, in units of the noise."""

_QUIET = 0.4
"""Noise below which nothing is believed to be, grey values."""

_SHORTEST = 9
"""Points of the shortest segment."""

_ROUND = 0.6
"""How much the image may bend along a line, relative to across it."""

_MOST = 60_000
"""Points of a frame that are looked at."""


class Segment(NamedTuple):
    """A line without gaps."""

    places: Array
    strength: Array


def segments(
    difference: Image, bodies: Bodies, scale: float = 1.0, inside: bool = False
) -> list[Segment]:
    """Find the lines of a difference image."""
    sigma = SIGMA * scale
    reach = math.ceil(3.0 * sigma)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    smooth = np.empty_like(difference)
    blur(difference, (taps / taps.sum()).astype(np.float32), np.empty_like(difference), smooth)
    factors = np.zeros(2)
    for kind in range(1 + inside):
        values = np.empty(difference.size // 16 + 1)
        count = roughness(smooth, bodies.label, bool(kind), values)
        if count:
            noise = max(1.4826 * float(np.median(values[:count])) * sigma**2, _QUIET)
            factors[kind] = sigma**2 / noise
    points, index = np.empty((_MOST, 4)), np.full(difference.shape, -1, dtype=np.int32)
    count = ridge_points(smooth, bodies.label, factors, _LEAST, points, index)
    order = np.argsort(-points[:count, 3])
    order = order[points[order, 3] > _CLEAR]
    member, first = np.empty(count, dtype=np.int32), np.empty(count + 1, dtype=np.int32)
    number = link(points, index, order, _SHORTEST, member, first)
    return [
        Segment(points[chosen, :2], points[chosen, 3])
        for chosen in (member[first[i] : first[i + 1]] for i in range(number))
    ]


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


@kernel
def roughness(smooth: Any, label: Any, inside: bool, out: Any) -> int:
    """How much second derivatives along rows and columns differ, on a sparse grid."""
    rows, columns = smooth.shape
    count = 0
    for row in range(4, min(rows - 4, 2 * label.shape[0]), 5):
        for column in range(4, min(columns - 4, 2 * label.shape[1]), 5):
            if (label[row // 2, column // 2] != 0) == inside and count < out.shape[0]:
                across = smooth[row, column - 1] + smooth[row, column + 1]
                down = smooth[row - 1, column] + smooth[row + 1, column]
                out[count] = abs(across - down)
                count += 1
    return count


@inlined
def near_body(label: Any, row: int, column: int) -> Any:
    """1 if there is a body at a pixel of the frame or beside it, else 0."""
    i, j = row // 2, column // 2
    for a in range(max(i - 1, 0), min(i + 2, label.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, label.shape[1])):
            if label[a, b] != 0:
                return 1
    return 0


@kernel
def ridge_points(
    smooth: Any, label: Any, factors: Any, least: float, points: Any, index: Any
) -> int:
    """Find pixels through which a ridge runs."""
    rows, columns = smooth.shape
    count = 0
    highest = max(factors[0], factors[1])
    for row in range(3, rows - 3):
        for column in range(3, columns - 3):
            twice = 2.0 * smooth[row, column]
            xx = smooth[row, column - 1] + smooth[row, column + 1] - twice
            yy = smooth[row - 1, column] + smooth[row + 1, column] - twice
            xy = 0.25 * (
                smooth[row - 1, column - 1]
                + smooth[row + 1, column + 1]
                - smooth[row - 1, column + 1]
                - smooth[row + 1, column - 1]
            )
            mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
            root = math.sqrt(half * half + xy * xy)
            lower = mean - root
            if -lower * highest <= least or abs(mean + root) > _ROUND * abs(lower):
                continue
            strength = -lower * factors[near_body(label, row, column)]
            if strength <= least:
                continue
            along = 0.5 * math.atan2(xy, half)
            nx, ny = -math.sin(along), math.cos(along)
            gx = 0.5 * (smooth[row, column + 1] - smooth[row, column - 1])
            gy = 0.5 * (smooth[row + 1, column] - smooth[row - 1, column])
            t = -(gx * nx + gy * ny) / lower
            if abs(t * nx) > 0.65 or abs(t * ny) > 0.65:
                continue
            if count == points.shape[0]:
                return count
            points[count, 0], points[count, 1] = column + t * nx, row + t * ny
            points[count, 2], points[count, 3] = along, strength
            index[row, column] = count
            count += 1
    return count


@kernel
def link(points: Any, index: Any, order: Any, shortest: int, member: Any, first: Any) -> int:
    """Put points in rows."""
    used = np.zeros(points.shape[0], np.bool_)
    way = np.empty(2 * points.shape[0] + 1, np.int32)
    number, filled, middle = 0, 0, points.shape[0]
    first[0] = 0
    for seed in order:
        if used[seed]:
            continue
        used[seed] = True
        ends = [middle, middle]
        way[middle] = seed
        for side in range(2):
            step = 1 - 2 * side
            angle = points[seed, 2] + math.pi * side
            ends[side] = _walk(points, index, used, seed, angle, way, middle, step)
        count = ends[0] - ends[1] + 1
        if count >= shortest and filled + count <= member.shape[0]:
            for k in range(count):
                member[filled + k] = way[ends[1] + k]
            filled += count
            number += 1
            first[number] = filled
    return number


@kernel
def _walk(
    points: Any,
    index: Any,
    used: Any,
    seed: int,
    angle: float,
    way: Any,
    at: int,
    step: int,
) -> int:
    """Go from point to point in one direction; say where in ``way`` that ends."""
    rows, columns = index.shape
    here = seed
    while True:
        cos, sin = math.cos(angle), math.sin(angle)
        best, least, turn = -1, 2.6, 0.0
        column, row = round(points[here, 0]), round(points[here, 1])
        for i in range(max(row - 2, 0), min(row + 3, rows)):
            for j in range(max(column - 2, 0), min(column + 3, columns)):
                k = index[i, j]
                if k < 0 or used[k]:
                    continue
                dx, dy = points[k, 0] - points[here, 0], points[k, 1] - points[here, 1]
                far = math.sqrt(dx * dx + dy * dy) + 1e-9
                ahead = (dx * cos + dy * sin) / far
                if ahead < 0.6:
                    continue
                own = math.cos(points[k, 2] - angle)
                if abs(own) < 0.8:
                    continue
                cost = far + 1.5 * math.acos(min(ahead, 1.0)) + math.acos(min(abs(own), 1.0))
                if cost < least:
                    best, least = k, cost
                    turn = points[k, 2] if own > 0.0 else points[k, 2] + math.pi
        if best < 0:
            return at
        # A broad ridge has points side by side: what is left beside the way is no line of its own.
        for i in range(max(row - 1, 0), min(row + 2, rows)):
            for j in range(max(column - 1, 0), min(column + 2, columns)):
                if index[i, j] >= 0:
                    used[index[i, j]] = True
        used[best] = True
        at += step
        way[at] = best
        here, angle = best, turn
