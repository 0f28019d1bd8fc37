"""Shapes as triangles: tubes along whiskers, cylinders, ellipsoids, sheets.

All lengths go in and come out in the same unit.
"""

from __future__ import annotations

from functools import lru_cache
from math import sqrt

import numpy as np

from vibrissa.viewer.drawing import Array, Ints

SIDES = 8


def across(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors that make a right-handed frame with a direction (3,)."""
    along = direction / np.linalg.norm(direction)
    helper = np.eye(3)[np.argmin(np.abs(along))]
    first = np.cross(along, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(along, first)


def tube(line: Array, radius: Array, sides: int = SIDES) -> tuple[Array, Ints]:
    """Vertices and triangles of a closed tube about a line (n, 3) with radii (n,).

    Its sections do not twist: the normal of each is that of the one before, made perpendicular to
    the tangent.
    """
    tangents = np.gradient(line, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = np.array(_transported(across(tangents[0])[0].tolist(), tangents.tolist()))
    turn = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = np.cos(turn)[:, None] * normals[:, None]
    ring += np.sin(turn)[:, None] * np.cross(tangents, normals)[:, None]
    walls = line[:, None] + radius[:, None, None] * ring
    return np.concatenate([walls.reshape(-1, 3), line[[0, -1]]]), _tube_faces(len(line), sides)


def _transported(normal: list[float], tangents: list[list[float]]) -> list[list[float]]:
    """A normal carried along; in plain numbers, which are faster than small arrays."""
    x, y, z = normal
    out = []
    for a, b, c in tangents:
        along = x * a + y * b + z * c
        x, y, z = x - along * a, y - along * b, z - along * c
        size = sqrt(x * x + y * y + z * z)
        x, y, z = x / size, y / size, z / size
        out.append([x, y, z])
    return out


@lru_cache(maxsize=32)
def _tube_faces(count: int, sides: int) -> Ints:
    ring, side = np.meshgrid(np.arange(count - 1), np.arange(sides), indexing="ij")
    here, beside = ring * sides + side, ring * sides + (side + 1) % sides
    walls = [(here, beside, beside + sides), (here, beside + sides, here + sides)]
    around = np.arange(sides)
    beyond = (around + 1) % sides
    first, last = count * sides, (count - 1) * sides
    ends = [
        (np.full(sides, first), beyond, around),
        (np.full(sides, first + 1), last + around, last + beyond),
    ]
    return np.concatenate([np.stack([p.ravel() for p in part], axis=1) for part in walls + ends])


def cylinder(
    origin: Array, axis: Array, radius: float, length: float, sides: int = 32
) -> tuple[Array, Ints]:
    """Vertices and triangles of a cylinder with its middle at the origin."""
    along = 0.5 * length * axis / np.linalg.norm(axis)
    return tube(np.stack([origin - along, origin + along]), np.full(2, radius), sides)


def ellipsoid(centre: Array, axes: Array, around: int = 24) -> tuple[Array, Ints]:
    """Vertices and triangles of an ellipsoid; the columns of axes (3, 3) are its semi-axes."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, around // 2 + 1)
    longitude = np.linspace(0.0, 2.0 * np.pi, around, endpoint=False)
    lat, lon = np.meshgrid(latitude, longitude, indexing="ij")
    ball = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    axes = axes * np.where(np.linalg.det(axes) < 0.0, np.array([1.0, 1.0, -1.0]), 1.0)
    faces = _tube_faces(len(latitude), around)[: 2 * (len(latitude) - 1) * around]
    return centre + ball.reshape(-1, 3) @ axes.T, faces


def error_ellipsoid(
    centre: Array, covariance: Array, sigmas: float, most: float = np.inf
) -> tuple[Array, Ints]:
    """Vertices and triangles of the ellipsoid of so many standard deviations.

    Semi-axes are cut to the longest that is to be drawn.
    """
    values, directions = np.linalg.eigh(covariance)
    sizes = np.minimum(sigmas * np.sqrt(np.clip(values, 0.0, None)), most)
    return ellipsoid(centre, directions * sizes)


def sheet(grid: Array) -> tuple[Array, Ints]:
    """Vertices and triangles of a surface that is given as a grid (m, n, 3) of its points."""
    count, beside = grid.shape[:2]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(beside - 1), indexing="ij")
    corner = (i * beside + j).ravel()
    first = np.stack([corner, corner + 1, corner + beside + 1], axis=1)
    second = np.stack([corner, corner + beside + 1, corner + beside], axis=1)
    return grid.reshape(-1, 3), np.concatenate([first, second])
