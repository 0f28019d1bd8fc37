"""A peg whose place, direction and radius are uncertain, as part of the fit of rods that touch it.

It is described by how it differs from where it is expected: two shifts across its axis, two tilts
of the axis, and the change of the radius. Contacts of all frames are on its surface, and determine
these numbers together with what is known of them before.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vibrissa.numerics import Array
from vibrissa.objects import Peg

PEG_UNKNOWNS = 5
UNITS = np.array([1e-3, 1e-3, 0.1, 0.1, 1e-3])  # of the unknowns: m, m, rad, rad, m
_LEAST = 2e-5  # smallest radius, m


def directions_across(axis: Array) -> Array:
    """Two directions (2, 3) across an axis."""
    first = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = first - (first @ axis) * axis
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first)])


@dataclass(frozen=True, eq=False)
class UncertainPeg:
    """A peg with the covariance (5, 5) of its unknowns, in units of `UNITS`."""

    expected: Peg
    covariance: Array

    @cached_property
    def _frame(self) -> Array:
        return directions_across(self.expected.axis)

    @cached_property
    def information(self) -> Array:
        """Inverse of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance))

    @property
    def radius_sigma(self) -> float:
        """Standard deviation of the radius, m."""
        return float(UNITS[4] * np.sqrt(self.covariance[4, 4]))

    def differs(self, other: Peg) -> float:
        """χ² of the difference of another peg, whose origin is at the same height."""
        shift, lean = other.origin - self.expected.origin, other.axis - self.expected.axis
        thicker = [other.radius - self.expected.radius]
        change = np.concatenate([self._frame @ shift, self._frame @ lean, thicker]) / UNITS
        return float(change @ self.information @ change)

    def at(self, unknowns: Array) -> Peg:
        """Peg with these unknowns (5,)."""
        change, expected = UNITS * unknowns, self.expected
        return Peg(
            expected.origin + change[:2] @ self._frame,
            expected.axis + change[2:4] @ self._frame,
            max(expected.radius + float(change[4]), _LEAST),
        )

    def geometry(
        self, unknowns: Array, points: Array, tangents: Array
    ) -> tuple[tuple[Array, Array, Array], Array, Array]:
        """Distances (n,) of points, normals (n, 3) and curvatures (n, 3, 3) of the surface.

        And derivatives (n, 5) by the unknowns of the distances, and of the cosines of the angles of
        normals with unit tangents (n, 3).
        """
        peg, frame = self.at(unknowns), self._frame
        away = points - peg.origin
        along = away @ peg.axis
        flat = away - along[:, None] * peg.axis
        far = np.linalg.norm(flat, axis=1)
        normal = flat / far[:, None]
        around = np.cross(peg.axis, normal)
        curvature = around[:, :, None] * around[:, None] / far[:, None, None]
        # Changes (n, 5, 3) of the vector from the axis to the point.
        change = np.zeros((len(points), PEG_UNKNOWNS, 3))
        change[:, :2] = -frame
        leaning = (away @ frame.T)[..., None] * peg.axis
        change[:, 2:4] = -along[:, None, None] * frame - leaning
        nearer = np.einsum("nkj,nj->nk", change, normal)
        tilted = np.einsum("nkj,nj->nk", change, tangents)
        tilted -= nearer * (normal * tangents).sum(axis=1, keepdims=True)
        nearer[:, 4] = -1.0
        local = far - peg.radius, normal, curvature
        return local, nearer * UNITS, tilted / far[:, None] * UNITS
