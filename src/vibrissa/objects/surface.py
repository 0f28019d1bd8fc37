"""What a whisker can touch, and how the whisker's base sits beside it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array


class Surface(ABC):
    """A body in a frame in which it stands still, known by its signed distance."""

    stiffness: float

    def signed_distance(self, points: ArrayLike) -> Array:
        """Tell how far points are from its surface."""
        return self._distance(np.asarray(points, dtype=np.float64))

    def local_geometry(self, point: ArrayLike) -> tuple[float, Array, Array]:
        """Tell where its surface is as seen from one point."""
        return self._geometry(np.asarray(point, dtype=np.float64))

    @abstractmethod
    def _distance(self, points: Array) -> Array:
        """See `signed_distance`."""

    @abstractmethod
    def _geometry(self, point: Array) -> tuple[float, Array, Array]:
        """See `local_geometry`."""


class Placement(NamedTuple):
    """How the whisker's base sits in the surfaces' frame: rotation (3, 3), position (3,), m."""

    rotation: Array
    position: Array

    def outside(self, points: Array) -> Array:
        """Take points (..., 3) of the whisker's frame, m, to the surfaces' frame."""
        moved: Array = points @ self.rotation.T + self.position
        return moved


def between(before: Placement, now: Placement, share: float) -> Placement:
    """Give the placement on the way, turning steadily about one axis and moving straight."""
    turn = before.rotation.T @ now.rotation
    axis = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    sine, cosine = float(np.linalg.norm(axis)), 0.5 * float(np.trace(turn) - 1.0)
    position = before.position + share * (now.position - before.position)
    if sine == 0.0:
        return Placement(now.rotation, position)
    x, y, z = axis / sine
    angle = share * float(np.arctan2(sine, cosine))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return Placement(before.rotation @ rotation, position)
