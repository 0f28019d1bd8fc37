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

from vibrissa.deferred import spatial
from vibrissa.numerics import AnyArray, Array

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

#: Half angle of the cone that the paper leaves out, rad.
CONE = np.deg2rad(2.0)
#: The regions, from the largest to the smallest; ELD is "excluding large deflections".
REGIONS = ("all", "ELD", "CF", "CB", "ELD CF", "ELD CB")
_SAMPLES = 2049


@lru_cache(maxsize=16)
def resting(whisker: Whisker) -> tuple[Array, Array, spatial.cKDTree, Array]:
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
    tree : cKDTree
        Search tree of these points.
    tangent : (3,) array
        Tangent at the tip.
    """
    s = np.linspace(0.0, whisker.length, _SAMPLES)
    places = whisker.position(s)
    tree = spatial.cKDTree(places, leafsize=64)  # points far from the whisker visit most leaves
    return s, places, tree, whisker.frame(np.array(whisker.length))[:, 0]


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
    flat = points.reshape(-1, 3)
    distance, arc_length = np.full(len(flat), np.nan), np.full(len(flat), np.nan)
    rows = np.flatnonzero(np.isfinite(flat).all(axis=1))
    if rows.size:
        s, places, tree, _ = resting(whisker)
        flat = flat[rows]
        _, i = tree.query(flat)
        # Between samples the curve is straight enough: the nearest point of the two chords at
        # the sample.
        j = np.stack([np.maximum(i - 1, 0), np.minimum(i, s.size - 2)])
        start, chord = places[j], places[j + 1] - places[j]
        t = np.einsum("jni,jni->jn", flat - start, chord)
        t = np.clip(t / np.einsum("jni,jni->jn", chord, chord), 0.0, 1.0)
        away = flat - start - t[..., None] * chord
        away = np.sqrt(np.einsum("jni,jni->jn", away, away))
        second = away[1] < away[0]
        distance[rows] = np.where(second, away[1], away[0])
        along = s[j] + t * (s[j + 1] - s[j])
        arc_length[rows] = np.where(second, along[1], along[0])
    return distance.reshape(points.shape[:-1]), arc_length.reshape(points.shape[:-1])


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
