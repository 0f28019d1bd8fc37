"""What can stand in the 3D scene: a handful of plain things, in mm, without a browser.

Functions of a state give a :data:`Drawing`; :mod:`vibrissa.viewer.stage` puts it on the page.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Colour = tuple[int, int, int]
Side = Literal["front", "back", "double"]

INK: Colour = (45, 50, 58)
WHISKER: Colour = (84, 68, 56)
REST: Colour = (150, 158, 168)
GHOST: Colour = (213, 94, 0)
CONTACT: Colour = (213, 94, 0)
FORCE: Colour = (0, 114, 178)
OBJECT: Colour = (160, 172, 186)
FIT: Colour = (0, 158, 115)
CLOUD: Colour = (150, 175, 200)


@dataclass(frozen=True, eq=False)
class Body:
    """A surface of one colour."""

    vertices: Array
    faces: Ints
    colour: Colour
    opacity: float | None = None
    side: Side = "front"
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Painted:
    """A surface of many colours, or one that is large: it costs little to draw."""

    triangles: Array
    colours: Bytes
    opacity: float | None = None
    side: Side = "double"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (n, 3), mm, with colours (n, 3), each so many mm wide."""

    points: Array
    colours: Bytes
    size: float


@dataclass(frozen=True, eq=False)
class Arrows:
    """From starts (n, 3) to ends (n, 3), mm, with colours (n, 3); all are drawn as one."""

    start: Array
    end: Array
    colours: Bytes
    thickness: float


@dataclass(frozen=True, eq=False)
class Line:
    """Pieces (n, 2, 3), mm, of one colour; width in pixels."""

    pieces: Array
    colour: Colour
    width: float = 2.0


@dataclass(frozen=True, eq=False)
class Label:
    """A few words at a place (3,), mm."""

    position: Array
    text: str


Thing = Body | Painted | Cloud | Arrows | Line | Label
Drawing = Mapping[str, Thing]
"""Things by name; what is missing from the next drawing goes."""


def pieces(points: Array) -> Array:
    """Pieces (n - 1, 2, 3) of a line through points (n, 3); those with a NaN are left out."""
    parts = np.stack([points[:-1], points[1:]], axis=1)
    return np.asarray(parts[np.isfinite(parts).all(axis=(1, 2))])
