"""Base class of surfaces that a whisker can touch, and placements of the whisker's base."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array, vectors


class Surface(ABC):
    """A solid in a frame in which it does not move, defined by its signed distance."""

    stiffness: float

    def signed_distance(self, points: ArrayLike) -> Array:
        """Signed distances of points from the surface.

        Parameters
        ----------
        points : array_like (..., 3)
            Points in the body's frame, m.

        Returns
        -------
        array (...)
            Distances, m; negative inside.
        """
        return self._distance(vectors("points", points))

    def local_geometry(self, point: ArrayLike) -> tuple[float, Array, Array]:
        """Signed distance of one point, with its derivatives.

        Parameters
        ----------
        point : array_like (3,)
            Point in the body's frame, m.

        Returns
        -------
        distance : float
            Signed distance, m.
        normal : array (3,)
            Gradient of the distance, the outward normal.
        curvature : array (3, 3)
            Derivatives of the normal, 1/m.
        """
        return self._geometry(np.asarray(point, dtype=np.float64))

    def in_words(self) -> str:
        """Describe kind and properties, in mm, for reports.

        Returns
        -------
        str
            Description such as "peg: origin (25.000, 0.000, 0.000) mm, …".
        """
        kind, _, properties = repr(self).removesuffix(")").partition("(")
        return f"{kind.lower()}: {properties.replace('=', ' ')}"

    @abstractmethod
    def _distance(self, points: Array) -> Array:
        """Signed distances of points (..., 3); see `signed_distance`."""

    @abstractmethod
    def _geometry(self, point: Array) -> tuple[float, Array, Array]:
        """Distance, normal and curvature at a point; see `local_geometry`."""


class Placement(NamedTuple):
    """Placement of the whisker's base in the surfaces' frame."""

    rotation: Array  # (3, 3), from the whisker's to the surfaces' frame
    position: Array  # (3,), m

    def outside(self, points: Array) -> Array:
        """Transform points from the whisker's to the surfaces' frame."""
        return np.asarray(points @ self.rotation.T + self.position)


def between(before: Placement, now: Placement, share: float) -> Placement:
    """Interpolate two placements, by rotation about one axis and straight translation."""
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


def listed_objects(objects: Surface | Sequence[Surface]) -> list[Surface]:
    """Return one or several objects as a list; raise a ValueError for anything else."""
    solids = list(objects) if isinstance(objects, Sequence) else [objects]
    for one in solids:
        if not isinstance(one, Surface):
            raise ValueError(
                f"objects are Peg, Sphere, Box, Plane or Mesh of vibrissa.objects; got {one!r}"
            )
    return solids
