"""Marks, in mm, without a renderer; limits of colours and axes.

Marks are bodies, clouds, arrows, lines and labels. Limits are those that hold most values, and
roots show small ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.numerics import Array

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Colour = tuple[int, int, int]
Side = Literal["front", "back", "double"]


@dataclass(frozen=True, eq=False)
class Body:
    """A surface of one colour."""

    vertices: Array  # (n, 3), mm, shared where the surface is smooth
    faces: Ints  # (m, 3)
    colour: Colour
    opacity: float | None = None
    side: Side = "front"
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)  # shift of all vertices, mm


@dataclass(frozen=True, eq=False)
class Painted:
    """A surface of many colours, or one that is large: it costs little to draw."""

    triangles: Array  # (n, 3, 3), mm
    colours: Bytes  # (n, 3, 3), of the corners
    opacity: float | None = None
    side: Side = "double"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points."""

    points: Array  # (n, 3), mm
    colours: Bytes  # (n, 3)
    size: float  # width of a point, mm


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows that are drawn as one."""

    start: Array  # (n, 3), mm
    end: Array
    colours: Bytes  # (n, 3)
    thickness: float  # radius of the shafts, mm


@dataclass(frozen=True, eq=False)
class Line:
    """Straight pieces of one colour."""

    pieces: Array  # (n, 2, 3), ends of each, mm
    colour: Colour
    width: float = 2.0  # pixels


@dataclass(frozen=True, eq=False)
class Label:
    """A few words."""

    position: Array  # (3,), of the lower left corner, mm
    text: str


Mark = Body | Painted | Cloud | Arrows | Line | Label
Drawing = Mapping[str, Mark]
"""Marks by name; what is missing from the next drawing goes."""


def pieces(points: Array) -> Array:
    """Cut a line into straight pieces."""
    parts = np.stack([points[:-1], points[1:]], axis=1)
    return np.asarray(parts[np.isfinite(parts).all(axis=(1, 2))])


def robust_limits(values: ArrayLike, share: float = 0.98, symmetric: bool = False) -> Array:
    """Give limits between which most of the finite values are."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if finite.size == 0:
        return np.array([-1.0 if symmetric else 0.0, 1.0])
    low, high = np.quantile(finite, [(1.0 - share) / 2.0, (1.0 + share) / 2.0])
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    if not high - low > 1e-12 * max(abs(high), abs(low)):
        room = 0.05 * abs(high) or 1.0
        low, high = low - room, high + room
    return np.array([low, high])


def root(values: ArrayLike) -> Array:
    """Take square roots of sizes and keep signs, for scales on which small values are seen."""
    x = np.asarray(values, dtype=np.float64)
    return np.asarray(np.sign(x) * np.sqrt(np.abs(x)))


def squared(values: ArrayLike) -> Array:
    """Take squares and keep signs: the inverse of `root`."""
    x = np.asarray(values, dtype=np.float64)
    return np.asarray(np.sign(x) * np.square(x))
