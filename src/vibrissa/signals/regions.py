"""Regions of the reachable space that the paper distinguishes.

- CB, concave backward: the contact point is displaced toward +y from the point of the resting
  whisker at the same distance r from the base; CF, concave forward: toward -y. Beyond the resting
  whisker's largest r its curve is extended along the tip's tangent; where r(s) is not monotone the
  nearest branch is used.
- Large deflection: the tangent of the deflected whisker at the contact points backward, with a
  negative x component.
- Small-deflection cone: points closer to the resting whisker than tan 2° times the arc length of
  the closest point.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.numerics import AnyArray, Array, inlined, kernel, vectors

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker


@inlined
def _squared_distance(
    nodes: Array, a: int, b: int, x: float, y: float, z: float
) -> tuple[float, float]:
    """Squared distance of a point from the chord between two nodes, and position on the chord."""
    cx, cy, cz = nodes[b, 0] - nodes[a, 0], nodes[b, 1] - nodes[a, 1], nodes[b, 2] - nodes[a, 2]
    x, y, z = x - nodes[a, 0], y - nodes[a, 1], z - nodes[a, 2]
    t = min(max((cx * x + cy * y + cz * z) / (cx * cx + cy * cy + cz * cz), 0.0), 1.0)
    x, y, z = x - t * cx, y - t * cy, z - t * cz
    return x * x + y * y + z * z, t


@kernel
def _nearest_on_chords(
    nodes: Array, bulge: Array, points: Array, distance: Array, position: Array
) -> None:
    """Compute distances (n,) of points (n, 3) from the polyline, and positions along it.

    Positions are in units of nodes. ``bulge`` (m,) bounds the distance of the chords in each of m
    equal blocks from the block's own chord, so that most blocks need not be searched.
    """
    blocks = bulge.shape[0]
    size = (nodes.shape[0] - 1) // blocks
    squares = np.empty(blocks)
    for row in range(points.shape[0]):
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        least, first = np.inf, 0
        for k in range(blocks):
            squares[k] = _squared_distance(nodes, k * size, (k + 1) * size, x, y, z)[0]
            if squares[k] < least:
                least, first = squares[k], k
        best, away, at = np.inf, np.inf, np.nan
        for n in range(-1, blocks if least < np.inf else -1):  # first the nearest block, then all
            k = first if n < 0 else n
            if n == first or squares[k] > (away + bulge[k]) ** 2:
                continue
            for j in range(k * size, (k + 1) * size):
                square, t = _squared_distance(nodes, j, j + 1, x, y, z)
                if square < best:
                    best, at = square, j + t
            away = np.sqrt(best)
        distance[row], position[row] = away if best < np.inf else np.nan, at


#: Half angle of the cone that the paper excludes, rad.
CONE = np.deg2rad(2.0)
#: Names of the regions, from the largest to the smallest; ELD is "excluding large deflections".
REGIONS = ("all", "ELD", "CF", "CB", "ELD CF", "ELD CB")
_BLOCKS, _SIZE = 64, 32  # number of blocks of chords of the resting whisker, and chords per block


@lru_cache(maxsize=16)
def resting(whisker: Whisker) -> tuple[Array, Array, Array, Array]:
    """Sample the resting whisker; cached.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest.

    Returns
    -------
    s : (n,) array
        Arc lengths, m.
    points_at_rest : (n, 3) array
        Points of the centreline, m.
    bulge : (m,) array
        Largest distance of the points of each of m blocks from the chord of the block, m.
    tangent : (3,) array
        Tangent at the tip.
    """
    s = np.linspace(0.0, whisker.length, _BLOCKS * _SIZE + 1)
    points_at_rest = whisker.position(s)
    chord = (points_at_rest[_SIZE::_SIZE] - points_at_rest[:-1:_SIZE])[:, None]
    away = points_at_rest[:-1].reshape(_BLOCKS, _SIZE, 3) - points_at_rest[:-1:_SIZE][:, None]
    t = np.clip((away * chord).sum(axis=2) / (chord * chord).sum(axis=2), 0.0, 1.0)
    bulge = np.linalg.norm(away - t[..., None] * chord, axis=2).max(axis=1)
    return s, points_at_rest, bulge, whisker.frame(np.array(whisker.length))[:, 0]


def nearest_on_rest(whisker: Whisker, points: Array) -> tuple[Array, Array]:
    """Distance of points from the resting whisker, and arc length of the closest point.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest.
    points : (..., 3) array
        Points in the whisker frame, m; NaN gives NaN.

    Returns
    -------
    distance, arc_length : (...) arrays
        Distance and arc length of the closest point, m.
    """
    points = vectors("points", points)
    s, points_at_rest, bulge, _ = resting(whisker)
    distance, position = np.empty(points.shape[:-1]), np.empty(points.shape[:-1])
    flat = np.ascontiguousarray(points.reshape(-1, 3))
    _nearest_on_chords(points_at_rest, bulge, flat, distance.reshape(-1), position.reshape(-1))
    return distance, position * s[1]


def in_region(region: str, backward: AnyArray, large: AnyArray) -> AnyArray:
    """Whether contacts belong to a region, given whether they are CB and largely deflected."""
    if region not in REGIONS:
        raise ValueError(f"a region is one of {', '.join(REGIONS)}; got {region!r}")
    inside = np.ones(np.shape(backward), dtype=bool)
    if "ELD" in region:
        inside &= ~large
    if "CF" in region:
        inside &= ~backward
    if "CB" in region:
        inside &= backward
    return inside


def cone_angle(whisker: Whisker, points: Array) -> Array:
    """Half angle of the cone about the resting whisker on which contact points lie, rad."""
    return np.asarray(np.arctan2(*nearest_on_rest(whisker, points)))


def within_cone(whisker: Whisker, points: Array, angle: float = CONE) -> AnyArray:
    """Whether contact points are within a cone about the resting whisker.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest.
    points : (..., 3) array
        Contact points in the whisker frame, m.
    angle : float
        Half angle of the cone, rad.

    Returns
    -------
    (...) bool array
        Result; False for NaN.
    """
    return np.asarray(cone_angle(whisker, points) < angle)


def backward_offset(whisker: Whisker, points: Array) -> Array:
    """Displacement of contact points toward +y from the resting whisker at the same r, m."""
    points = vectors("points", points)
    y = points[..., 1]
    if whisker.is_straight:
        return np.asarray(y)
    _, points_at_rest, _, tangent = resting(whisker)
    r_rest = np.linalg.norm(points_at_rest, axis=1)
    r = np.linalg.norm(points, axis=-1)
    if np.all(np.diff(r_rest) > 0.0):
        rest_y = np.interp(r, r_rest, points_at_rest[:, 1])
    else:
        rest_y = _nearest_branch(points, r, r_rest, points_at_rest)
    tip = points_at_rest[-1]
    beyond = r > r_rest.max()
    along = np.dot(tip, tangent)
    # |tip + a tangent| = r
    a = -along + np.sqrt(np.maximum(along**2 + r**2 - np.dot(tip, tip), 0.0))
    return np.asarray(y - np.where(beyond, tip[1] + a * tangent[1], rest_y))


def concave_backward(whisker: Whisker, points: Array) -> AnyArray:
    """Whether contacts are concave backward (CB) rather than concave forward (CF)."""
    return np.asarray(backward_offset(whisker, points) > 0.0)


def _nearest_branch(points: Array, r: Array, r_rest: Array, points_at_rest: Array) -> Array:
    """Y of the resting whisker at distance r, on the branch closest to the point."""
    flat, radius = points.reshape(-1, 3), r.reshape(-1)
    out = np.full(radius.size, np.nan)
    best = np.full(radius.size, np.inf)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(r_rest))) != 0) + 1
    edges = [0, *turns.tolist(), r_rest.size - 1]
    for a, b in pairwise(edges):
        piece = slice(a, b + 1)
        order = np.argsort(r_rest[piece])
        known = r_rest[piece][order]
        place = np.stack(
            [np.interp(radius, known, points_at_rest[piece][order, i]) for i in range(3)], axis=1
        )
        away = np.linalg.norm(flat - place, axis=1)
        away[(radius < known[0]) | (radius > known[-1])] = np.inf
        closer = away < best
        out, best = np.where(closer, place[:, 1], out), np.where(closer, away, best)
    return out.reshape(r.shape)
