"""Objects as they are seen from a side, for anything that knows its signed distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import ArrayLike

from vibrissa.plots.style import MUTED, ORANGE, Array

_CELLS, _COARSE = 121, 4
_FULL = 0.97
"""Share of a panel from which an object is taken to fill it, so that it is no use drawing it."""


class Body(Protocol):
    """An object in the laboratory, m."""

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distances (...) of points (..., 3) from its surface, negative inside."""


def draw_body(axes: Axes, body: Body, view: tuple[int, int], limits: Array, look: str) -> None:
    """Draw the outline of an object, or rather of what of it lies within limits."""
    i, j = view
    right, up = (np.linspace(limits[n, 0], limits[n, 1], _CELLS) for n in view)
    points: Array = np.zeros((_CELLS, _CELLS, 3))
    points[..., i], points[..., j] = right, up[:, None]
    nearest = _nearest(body, points, limits, 3 - i - j)
    if not 0.0 < np.mean(nearest < 0.0) < _FULL:
        return
    if look == "true":
        axes.contourf(right, up, nearest, [-np.inf, 0.0], colors=["#ececec"], zorder=1)
        axes.contour(right, up, nearest, [0.0], colors=[MUTED], linewidths=0.8, zorder=1.5)
        return
    dashes: Any = [(0, (4, 2))]
    lines: dict[str, Any] = {"linewidths": 1.0, "linestyles": dashes, "zorder": 4}
    axes.contour(right, up, nearest, [0.0], colors=[ORANGE], **lines)


def _nearest(body: Body, points: Array, limits: Array, depth: int) -> Array:
    """Least distance from a body along lines of sight through points (m, m, 3), mm.

    Finely only where the outline is near: some bodies take their time to tell distances.
    """
    from scipy.interpolate import RegularGridInterpolator

    rough = np.arange(0, _CELLS, _COARSE)
    corners = points[np.ix_(rough, rough)]
    cell = float(np.ptp(corners[:2, :2].reshape(-1, 3), axis=0).max())
    coarse = _marched(body, corners.reshape(-1, 3), limits, depth, 2.0 * cell)
    table = RegularGridInterpolator((rough, rough), coarse.reshape(rough.size, rough.size))
    rows, columns = np.indices((_CELLS, _CELLS))
    nearest = np.asarray(table((rows, columns)), dtype=np.float64)
    # Within a cell a distance changes by no more than the way.
    near = np.abs(nearest) < 1.5 * cell
    nearest[near] = _marched(body, points[near], limits, depth, 2.0 * cell)
    return nearest


def _marched(body: Body, points: Array, limits: Array, depth: int, deep: float) -> Array:
    """Least distance from a body along lines of sight through points (n, 3), mm.

    Lines that go as deep into the body as ``deep`` are followed no farther. The distance to a body
    is also how far one may go without meeting it, so few steps lead past it.
    """
    start, end = limits[depth]
    least_step = 0.25 * deep
    points = points.copy()
    at = np.full(len(points), start)
    least = np.full(len(points), np.inf)
    active = np.arange(len(points))
    while active.size:
        points[active, depth] = at[active]
        distance = 1e3 * body.signed_distance(1e-3 * points[active])
        least[active] = np.minimum(least[active], distance)
        at[active] += np.maximum(np.abs(distance), least_step)
        active = active[(at[active] <= end) & (least[active] > -deep)]
    return least


def room_for(places: Array, bodies: Sequence[Body], least: float = 1.0) -> Array:
    """Limits that hold most places, and the objects there as far as they end nearby."""
    low, high = np.quantile(places, [0.04, 0.96], axis=0)
    half = 0.5 * (high - low)
    near = np.array([[-1.0], [1.0]]) * (2.0 * half.max() + 3.0 * least)
    lines = 0.5 * (low + high) + near  # lower and upper ends of a cube
    steps = np.linspace(lines[0], lines[1], 25)
    grid = np.stack(np.meshgrid(*steps.T, indexing="ij"), axis=-1)
    for body in bodies:
        inside = grid[body.signed_distance(1e-3 * grid) < 0.0]
        for n in range(3):
            if (
                inside.size
                and inside[:, n].min() > lines[0, n]
                and inside[:, n].max() < lines[1, n]
            ):
                low[n], high[n] = min(low[n], inside[:, n].min()), max(high[n], inside[:, n].max())
    margin = np.maximum(0.15 * (high - low), least)
    return np.stack([low - margin, high + margin], axis=1)


def one_scale(limits: Array, views: Sequence[tuple[int, int]], sizes: Sequence[Any]) -> Array:
    """Widen limits so that panels of given sizes show all of them to one scale."""
    middle, span = limits.mean(axis=1), np.ptp(limits, axis=1)
    scale = max(
        max(span[i] / wide, span[j] / tall)
        for (i, j), (wide, tall) in zip(views, sizes, strict=True)
    )
    return np.array(
        [
            [
                [middle[n] - 0.5 * scale * size, middle[n] + 0.5 * scale * size]
                for n, size in zip(view, both, strict=True)
            ]
            for view, both in zip(views, sizes, strict=True)
        ]
    )
