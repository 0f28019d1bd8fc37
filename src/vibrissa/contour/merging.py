"""Neighbouring contacts merged into one, where there are more than are wanted.

Space is divided into cubes, whose edge is the smallest for which no more are occupied than wanted.
What lies in one cube becomes one value at their mean place, all weighed by the inverse of their
variances, as they would be by a surface that is smooth on this scale; its variance is that of the
weighted mean. Nothing is thrown away, and a place that was touched a hundred times counts as much
as it should.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.contour.touches import Array

_FINER = 0.9
_FINEST = 1e-3
"""Edge of the smallest cubes, as a share of the points' extent."""


class Support(NamedTuple):
    """What a surface is made from: places (n, 3), values there (n,), their variances (n,)."""

    place: Array
    value: Array
    variance: Array


def merged(support: Support, most: int) -> Support:
    """Merge neighbours until no more are left than wanted."""
    if len(support.value) <= most:
        return support
    place = support.place - support.place.min(axis=0)
    edge = float(place.max())
    cell = _cells(place, edge)
    while edge > _FINEST * float(place.max()):
        finer = _cells(place, _FINER * edge)
        if finer.max() >= most:
            break
        edge, cell = _FINER * edge, finer
    weight = 1.0 / support.variance
    total = np.bincount(cell, weight)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(cell, weight * values) / total)

    middle = np.stack([mean(x) for x in support.place.T], axis=1)
    return Support(middle, mean(support.value), 1.0 / total)


def _cells(place: Array, edge: float) -> NDArray[np.intp]:
    """Number of the occupied cube of each place."""
    cube = np.floor(place / edge).astype(np.int64)
    return np.unique(cube, axis=0, return_inverse=True)[1].reshape(-1)
