"""Parts of the reachable space that the paper distinguishes.

- CB, concave backward: the contact has moved toward +y of the resting whisker at the same distance
  r from the base; CF, concave forward: toward -y. Beyond the resting whisker's largest r its curve
  is continued along the tip's tangent; where r(s) is not monotone the nearest branch counts.
- Large deflection: the deflected tangent at the contact points back, its x component is negative.
- The small-deflection cone: nearer to the resting whisker than tan 2° times the arc length there.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.numerics import AnyArray, Array
from vibrissa.whisker import nearest_on_chords

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

#: Half angle of the cone that the paper leaves out, rad.
CONE = np.deg2rad(2.0)
#: The regions, from the largest to the smallest; ELD is "excluding large deflections".
REGIONS = ("all", "ELD", "CF", "CB", "ELD CF", "ELD CB")
_BLOCKS, _SIZE = 64, 32  # blocks of chords of the resting whisker


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
    places : (n, 3) array
        Points of the centreline, m.
    bulge : (m,) array
        Largest distance of the points of each of m blocks from the chord of the block, m.
    tangent : (3,) array
        Tangent at the tip.
    """
    s = np.linspace(0.0, whisker.length, _BLOCKS * _SIZE + 1)
    places = whisker.position(s)
    chord = (places[_SIZE::_SIZE] - places[:-1:_SIZE])[:, None]
    away = places[:-1].reshape(_BLOCKS, _SIZE, 3) - places[:-1:_SIZE][:, None]
    t = np.clip((away * chord).sum(axis=2) / (chord * chord).sum(axis=2), 0.0, 1.0)
    bulge = np.linalg.norm(away - t[..., None] * chord, axis=2).max(axis=1)
    return s, places, bulge, whisker.frame(np.array(whisker.length))[:, 0]


def nearest_on_rest(whisker: Whisker, points: Array) -> tuple[Array, Array]:
    """Distance from the resting whisker, and the arc length of the nearest place.

    Parameters
    ----------
    whisker : Whisker
        Whisker at rest.
    points : (..., 3) array
        Points in the whisker frame, m; NaN gives NaN.

    Returns
    -------
    distance, arc_length : (...) arrays
        Distance and arc length of the nearest point, m.
    """
    points = np.asarray(points, dtype=np.float64)
    s, places, bulge, _ = resting(whisker)
    distance, position = np.empty(points.shape[:-1]), np.empty(points.shape[:-1])
    flat = np.ascontiguousarray(points.reshape(-1, 3))
    nearest_on_chords(places, bulge, flat, distance.reshape(-1), position.reshape(-1))
    return distance, position * s[1]


def in_region(region: str, backward: AnyArray, large: AnyArray) -> AnyArray:
    """Whether contacts belong to a region."""
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
    """Half angle of the cone about the resting whisker on which contact points lie."""
    return np.asarray(np.arctan2(*nearest_on_rest(whisker, points)))


def within_cone(whisker: Whisker, points: Array, angle: float = CONE) -> AnyArray:
    """Whether contact points lie within a cone about the resting whisker.

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
        True inside; False for NaN.
    """
    return np.asarray(cone_angle(whisker, points) < angle)


def backward_offset(whisker: Whisker, points: Array) -> Array:
    """How far contacts have moved toward +y of the resting whisker at the same r."""
    points = np.asarray(points, dtype=np.float64)
    y = points[..., 1]
    if whisker.is_straight:
        return np.asarray(y)
    _, places, _, tangent = resting(whisker)
    r_rest = np.linalg.norm(places, axis=1)
    r = np.linalg.norm(points, axis=-1)
    if np.all(np.diff(r_rest) > 0.0):
        rest_y = np.interp(r, r_rest, places[:, 1])
    else:
        rest_y = _nearest_branch(points, r, r_rest, places)
    tip = places[-1]
    beyond = r > r_rest.max()
    along = np.dot(tip, tangent)
    # |tip + a tangent| = r
    a = -along + np.sqrt(np.maximum(along**2 + r**2 - np.dot(tip, tip), 0.0))
    return np.asarray(y - np.where(beyond, tip[1] + a * tangent[1], rest_y))


def concave_backward(whisker: Whisker, points: Array) -> AnyArray:
    """Whether contacts have moved toward +y of the resting whisker at the same r: CB, not CF."""
    return np.asarray(backward_offset(whisker, points) > 0.0)


def _nearest_branch(points: Array, r: Array, r_rest: Array, places: Array) -> Array:
    """Y of the resting whisker at distance r, on the branch that passes nearest to the point."""
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
            [np.interp(radius, known, places[piece][order, i]) for i in range(3)], axis=1
        )
        away = np.linalg.norm(flat - place, axis=1)
        away[(radius < known[0]) | (radius > known[-1])] = np.inf
        closer = away < best
        out, best = np.where(closer, place[:, 1], out), np.where(closer, away, best)
    return out.reshape(r.shape)
