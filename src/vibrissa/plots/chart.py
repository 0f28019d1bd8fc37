"""The chart of all stable contacts, sampled as finely as a picture needs.

A map knows contact point and signals at the nodes of a chart over arc length, bearing and load.
In between both are smooth, and here they are interpolated by cubic splines: for pictures only.
Every node carries one row of numbers, its columns named in :data:`COLUMNS`, so that what is cut out
of the chart (:mod:`vibrissa.plots.solids`) carries the contact point and all signals along.
Directions are carried as the components of a vector, which are smooth where angles jump.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.plots.style import Array

SIGNALS = ("Fx", "FT", "FD", "Mx", "MB", "MD")
DIRECTIONS = ("FD", "MD")
COLUMNS = (
    *("x", "y", "z", "r", "theta", "phi"),
    *("Fx", "FT cos FD", "FT sin FD", "Mx", "MB cos MD", "MB sin MD"),
    *("arc_length", "deflection"),
)
"""SI units; ``deflection`` is how far outside the cone of small deflections a contact lies, m."""

_COLUMN = {name: i for i, name in enumerate(COLUMNS)}
_DIMS = ("station", "bearing", "load")
_CONE = np.deg2rad(2.0)
_SHAPE = (36, 72, 24)
"""Cells of the whole chart."""


def column(name: str) -> int:
    """Tell where a quantity stands in a row."""
    return _COLUMN[name]


def values_of(name: str, rows: Array) -> Array:
    """Take a signal, a coordinate or another column out of rows."""
    if name in _COLUMN:
        return np.asarray(rows[..., _COLUMN[name]])
    kind = name[0]
    size, direction = ("FT", "FD") if kind == "F" else ("MB", "MD")
    first, second = (rows[..., _COLUMN[f"{size} {f} {direction}"]] for f in ("cos", "sin"))
    return np.hypot(first, second) if name == size else np.arctan2(second, first)


def fine_chart(
    samples: xr.Dataset,
    centerline: ArrayLike,
    bearings: tuple[float, float] | None = None,
    shape: tuple[int, int, int] | None = None,
) -> Array:
    """Sample the contacts of a map finely."""
    names = ("contact_point", "arc_length", *SIGNALS)
    missing = [name for name in names if name not in samples]
    if missing:
        raise ValueError(f"the map lacks {', '.join(missing)}")
    absent = [dim for dim in _DIMS if dim not in samples["Fx"].dims]
    if absent:
        raise ValueError(
            f"the map has no dimension {', '.join(absent)}; the chart of a map is needed, "
            "as of ContactMap.to_dataset()"
        )
    signals = {name: samples[name].transpose(*_DIMS).to_numpy() for name in SIGNALS}
    vectors = [
        signals[size] * turn(signals[direction])
        for size, direction in (("FT", "FD"), ("MB", "MD"))
        for turn in (np.cos, np.sin)
    ]
    point = samples["contact_point"].transpose(*_DIMS, "space").to_numpy()
    scalars = (signals["Fx"], *vectors[:2], signals["Mx"], *vectors[2:])
    arc = samples["arc_length"].transpose(*_DIMS).to_numpy()
    nodes = np.concatenate([point, np.stack([*scalars, arc], axis=-1)], axis=-1)
    if not np.isfinite(nodes).all():
        raise ValueError("the map lacks some values; all of the reachable space is needed")
    axes = [np.asarray(samples[dim].to_numpy(), dtype=np.float64) for dim in _DIMS]
    return _rows(
        _refined(nodes, axes, bearings, shape or _SHAPE), np.asarray(centerline, dtype=np.float64)
    )


def _refined(
    nodes: Array,
    axes: list[Array],
    bearings: tuple[float, float] | None,
    shape: tuple[int, int, int],
) -> Array:
    from scipy.interpolate import CubicSpline  # a fifth of a second, so only where it is needed

    station, bearing, load = axes
    start, stop = (bearing[0], bearing[-1]) if bearings is None else bearings
    around = max(2, round(shape[1] * (stop - start) / (2.0 * np.pi)))
    nodes = CubicSpline(station, nodes, axis=0)(np.linspace(station[0], station[-1], shape[0] + 1))
    nodes[:, -1] = nodes[:, 0]  # equal but for rounding
    wrapped = CubicSpline(bearing, nodes, axis=1, bc_type="periodic")
    nodes = wrapped(np.linspace(start, stop, around + 1))
    fine = CubicSpline(load, nodes, axis=2)(np.linspace(load[0], load[-1], shape[2] + 1))
    return np.asarray(fine, dtype=np.float64)


def _rows(nodes: Array, line: Array) -> Array:
    """Add what follows from contact points (the first three columns) to interpolated nodes."""
    point = nodes[..., :3]
    x, y, z = np.moveaxis(point, -1, 0)
    ball = np.stack(
        [np.linalg.norm(point, axis=-1), np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1
    )
    outside = outside_cone(point.reshape(-1, 3), line).reshape(x.shape)
    return np.concatenate([point, ball, nodes[..., 3:], outside[..., None]], axis=-1)


def outside_cone(points: Array, centerline: Array) -> Array:
    """How far contacts lie outside the cone of small deflections."""
    distance, arc_length = nearest_at_rest(points, centerline)
    return np.asarray(distance - arc_length * np.tan(_CONE))


def nearest_at_rest(points: Array, centerline: Array) -> tuple[Array, Array]:
    """How far contacts lie from the resting whisker."""
    from scipy.spatial import cKDTree

    count = max(2000, len(centerline))
    at = np.linspace(0.0, len(centerline) - 1.0, count)
    fine = np.stack([np.interp(at, np.arange(len(centerline)), c) for c in centerline.T], axis=1)
    step = np.linalg.norm(np.diff(fine, axis=0), axis=1)
    arc_length = np.concatenate([[0.0], np.cumsum(step)])
    distance, nearest = cKDTree(fine).query(points)
    return np.asarray(distance), arc_length[nearest]
