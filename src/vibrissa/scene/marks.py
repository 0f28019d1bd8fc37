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
    """A surface of one colour.

    Parameters
    ----------
    vertices : array (n, 3)
        Corners that triangles share where the surface is smooth, mm.
    faces : array (m, 3) of int
        Vertices of each triangle.
    colour : tuple of int
        Red, green and blue, 0 to 255.
    opacity : float, optional
        Opacity from 0 to 1; opaque by default.
    side : {"front", "back", "double"}
        Sides that are drawn.
    position : tuple of float
        Shift of all vertices, mm.
    """

    vertices: Array
    faces: Ints
    colour: Colour
    opacity: float | None = None
    side: Side = "front"
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Painted:
    """A surface of many colours, or one that is large: it costs little to draw.

    Parameters
    ----------
    triangles : array (n, 3, 3)
        Corners, mm.
    colours : array (n, 3, 3) of uint8
        Colours of the corners.
    opacity : float, optional
        Opacity from 0 to 1; opaque by default.
    side : {"front", "back", "double"}
        Sides that are drawn.
    """

    triangles: Array
    colours: Bytes
    opacity: float | None = None
    side: Side = "double"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points.

    Parameters
    ----------
    points : array (n, 3)
        Positions, mm.
    colours : array (n, 3) of uint8
        Colours of the points.
    size : float
        Width of each point, mm.
    """

    points: Array
    colours: Bytes
    size: float


@dataclass(frozen=True, eq=False)
class Arrows:
    """Arrows that are drawn as one.

    Parameters
    ----------
    start, end : array (n, 3)
        Ends of each, mm.
    colours : array (n, 3) of uint8
        Colours of the arrows.
    thickness : float
        Radius of the shafts, mm.
    """

    start: Array
    end: Array
    colours: Bytes
    thickness: float


@dataclass(frozen=True, eq=False)
class Line:
    """Straight pieces of one colour.

    Parameters
    ----------
    pieces : array (n, 2, 3)
        Ends of each, mm.
    colour : tuple of int
        Red, green and blue, 0 to 255.
    width : float
        Width, pixels.
    """

    pieces: Array
    colour: Colour
    width: float = 2.0


@dataclass(frozen=True, eq=False)
class Label:
    """A few words.

    Parameters
    ----------
    position : array (3,)
        Position of the lower left corner, mm.
    text : str
        Plain text.
    """

    position: Array
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
