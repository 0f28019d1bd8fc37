"""Values at scattered points in space, interpolated by natural neighbours or linearly.

The way of the paper's look-up tables. The weights are Sibson's, exact
(:mod:`vibrissa.paper.sibson`).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay, QhullError

from vibrissa.numerics import Array, IntArray, share_out
from vibrissa.paper.sibson import Mesh, interpolate, locate, measure, sibson_weights

Interpolation = Literal["natural", "linear"]


class NaturalNeighbour:
    """Values at scattered points in space, interpolated.

    Parameters
    ----------
    points : (n, 3) array_like
        Where the values are known; not all in one plane. Of points that coincide one counts.
    values : (n, k) array_like
        The values.
    scale : (3,) array_like, optional
        What to divide each coordinate by, so that distances along all axes are comparable; by
        default its range.

    Raises
    ------
    ValueError
        If shapes do not fit, something is not finite, or all points lie in one plane.
    """

    def __init__(
        self, points: ArrayLike, values: ArrayLike, scale: ArrayLike | None = None
    ) -> None:
        places = np.asarray(points, dtype=np.float64)
        self.values = np.ascontiguousarray(values, dtype=np.float64)
        if places.ndim != 2 or places.shape[1] != 3 or self.values.shape[:-1] != places.shape[:1]:
            raise ValueError(
                "points must be (n, 3) and values (n, k); "
                f"got {places.shape} and {self.values.shape}"
            )
        if not (np.isfinite(places).all() and np.isfinite(self.values).all()):
            raise ValueError("points and values must be finite")
        self.scale = np.ptp(places, axis=0) if scale is None else np.asarray(scale, np.float64)
        if self.scale.shape != (3,) or not (self.scale > 0.0).all():
            raise ValueError(
                "each coordinate needs a range, or a scale, above zero; "
                f"the scale is {self.scale.tolist()}"
            )
        try:
            triangulation = Delaunay(places / self.scale)
        except QhullError as error:
            raise ValueError("the points do not span space: all lie in one plane") from error
        self._mesh = _mesh(triangulation)

    def __call__(self, queries: ArrayLike, method: Interpolation = "natural") -> Array:
        """Interpolate."""
        if method not in ("natural", "linear"):
            raise ValueError(f"method is 'natural' or 'linear'; got {method!r}")
        wanted, inside = self._located(queries)
        out = np.full((len(wanted), self.values.shape[1]), np.nan)
        natural = method == "natural"
        share_out(
            len(wanted),
            lambda first, last: interpolate(
                self._mesh, self.values, wanted, inside, natural, out, first, last
            ),
        )
        return out

    def weights(self, query: ArrayLike) -> tuple[IntArray, Array]:
        """Sibson's weights of the points around one query.

        Parameters
        ----------
        query : (3,) array_like
            Where.

        Returns
        -------
        indices : (j,) int array
            The natural neighbours; none outside the convex hull.
        weights : (j,) array
            Their weights; they sum to one.
        """
        wanted, inside = self._located(np.asarray(query, dtype=np.float64)[None])
        if inside[0] < 0:
            return np.empty(0, np.int64), np.empty(0)
        n, tetrahedra = len(self._mesh[0]), len(self._mesh[1])
        found = (np.full(n, -1), np.empty(n, np.int64), np.empty(n))
        marks, cavity = np.full(tetrahedra, -1), np.empty(tetrahedra, np.int64)
        count = sibson_weights(self._mesh, wanted[0], int(inside[0]), 0, marks, cavity, found)
        _, members, weights = found
        return members[:count].copy(), weights[:count].copy()

    def _located(self, queries: ArrayLike) -> tuple[Array, IntArray]:
        """Scaled queries (m, 3), and the tetrahedra that hold them, -1 outside."""
        wanted = np.asarray(queries, dtype=np.float64)
        if wanted.ndim != 2 or wanted.shape[1] != 3:
            raise ValueError(f"queries must be (m, 3); got {wanted.shape}")
        wanted = np.ascontiguousarray(wanted / self.scale)
        inside = np.empty(len(wanted), np.int64)
        share_out(len(wanted), lambda first, last: locate(self._mesh, wanted, inside, first, last))
        return wanted, inside


def _mesh(triangulation: Delaunay) -> Mesh:
    vertices = np.ascontiguousarray(triangulation.points)
    corners = triangulation.simplices.astype(np.int64)
    n = len(corners)
    centres, shares, flat = np.zeros((n, 3)), np.zeros((n, 4)), np.zeros(n, np.int64)
    share_out(
        n,
        lambda first, last: measure(vertices, corners, centres, shares, flat, first, last),
    )
    return vertices, corners, triangulation.neighbors.astype(np.int64), centres, shares, flat
