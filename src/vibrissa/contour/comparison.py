"""Comparison of contact points and fitted axes with known objects.

Distances are those of the whisker's surface from the object's, d(p) − ρ. The expected distances are
sampled, not linearised: each point is moved to where it touches the object's surface, displaced by
errors drawn from its covariance, once per replicate, and its distance is computed again. In this
way a point that is uncertain along a small round object is correctly expected outside of it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contour.fitted_shape import Body, check_variances
from vibrissa.numerics import Array, numbers
from vibrissa.quantities import QUANTITIES, attributes, to_display

REPLICATES = 20  # number of draws for each distance
CLASSES = 5  # default number of classes
_STEP = 1e-6  # step of finite differences, m


def compare_with(
    body: Body,
    points: ArrayLike,
    covariance: ArrayLike | None = None,
    whisker_radius: ArrayLike = 0.0,
    *,
    dims: Sequence[str] = ("point",),
    coords: Any = None,
    seed: int = 0,
) -> xr.Dataset:
    """Compare contact points with a known object.

    Parameters
    ----------
    body : object of a trial, or fitted shape
        Body with ``signed_distance(points)``, m, in the frame of the points.
    points : array_like (..., 3)
        Contact points on the whisker's centreline, m; NaN gives NaN.
    covariance : array_like (..., 3, 3), optional
        Covariance of the points, m²; without it no distances are predicted.
    whisker_radius : array_like (...)
        Radius of the whisker at the contacts, m.
    dims : sequence of str
        Dimensions of the points other than that of space.
    coords : mapping, optional
        Coordinates of these dimensions.
    seed : int
        Seed of the draws.

    Returns
    -------
    xarray.Dataset
        ``surface_distance``, m, positive outside, and with a covariance
        ``surface_distance_predicted``: ``REPLICATES`` samples of the distances expected if the
        covariance were the only error.
    """
    if not hasattr(body, "signed_distance"):
        raise ValueError(f"an object or a fitted shape is needed; got {type(body).__name__}")
    p = numbers("points", points)
    if p.ndim != len(dims) + 1 or p.shape[-1] != 3:
        raise ValueError(f"points have shape {p.shape}; {(*dims, 3)} is needed")
    radius = np.broadcast_to(numbers("whisker_radius", whisker_radius), p.shape[:-1])
    if (radius < 0.0).any():
        raise ValueError(f"whisker_radius is negative, {radius.min()} m")
    known = np.isfinite(p).all(axis=-1) & np.isfinite(radius)
    gap = np.full(p.shape[:-1], np.nan)
    gap[known] = body.signed_distance(p[known]) - radius[known]
    data: dict[str, Any] = {"surface_distance": (tuple(dims), gap, attributes("surface_distance"))}
    if covariance is not None:
        spread = np.asarray(covariance, dtype=np.float64)
        if spread.shape != (*p.shape, 3):
            raise ValueError(f"covariance has shape {spread.shape}; {(*p.shape, 3)} is needed")
        known = known & np.isfinite(spread).all(axis=(-2, -1))
        check_variances(np.linalg.eigvalsh(spread[known]))
        drawn = np.full((REPLICATES, *gap.shape), np.nan)
        drawn[:, known] = _draw_distances(
            body, p[known], spread[known], gap[known], radius[known], seed
        )
        name = "surface_distance_predicted"
        data[name] = (("replicate", *dims), drawn, attributes(name))
    return xr.Dataset(data, coords)


def _draw_distances(
    body: Body, points: Array, spread: Array, gap: Array, radius: Array, seed: int
) -> Array:
    """Sample distances (replicates, n) of points on the surface displaced by their errors."""
    steps = _STEP * np.eye(3)
    ahead, back = (body.signed_distance(points[:, None] + sign * steps) for sign in (1.0, -1.0))
    normal = (ahead - back) / (2.0 * _STEP)
    touching = points - gap[:, None] * normal
    size, direction = np.linalg.eigh(spread)
    root = direction * np.sqrt(np.maximum(size, 0.0))[:, None, :]
    draw = np.random.default_rng(seed).normal(size=(REPLICATES, len(points), 3))
    moved = touching + np.einsum("nij,rnj->rni", root, draw)
    return np.asarray(body.signed_distance(moved) - radius)


def distances_by(
    compared: xr.Dataset, quantity: str, values: ArrayLike, edges: ArrayLike | None = None
) -> xr.Dataset:
    """Summarise absolute distances by classes of another quantity.

    Parameters
    ----------
    compared : xarray.Dataset
        Dataset from `compare_with`.
    quantity : str
        Quantity of the classes, such as ``"deflection_angle"``, ``"r"`` or ``"MB"``.
    values : array_like (...)
        Value of the quantity at each contact, SI units.
    edges : array_like (k + 1,), optional
        Edges of the classes, increasing; the last class includes its upper edge. By default five
        classes with equal numbers of contacts.

    Returns
    -------
    xarray.Dataset
        Dataset with the dimension class and its label: ``lower``, ``upper``, the number of
        ``contacts``, ``median`` and ``largest_95`` (95 % quantile) of the absolute distance, and
        both as predicted, m. Classes without contacts are included, with NaN.
    """
    if quantity not in QUANTITIES:
        raise ValueError(f"{quantity!r} is not a known quantity")
    size = np.abs(compared["surface_distance"].values)
    v = np.asarray(values, dtype=np.float64)
    if v.shape != size.shape:
        raise ValueError(f"values have shape {v.shape}; {size.shape} is needed")
    known = np.isfinite(size) & np.isfinite(v)
    limits = _edges(v[known]) if edges is None else np.asarray(edges, dtype=np.float64)
    if limits.ndim != 1 or limits.size < 2 or not (np.diff(limits) > 0.0).all():
        raise ValueError(f"edges are {limits.tolist()}; two or more, increasing, are needed")
    predicted = compared.get("surface_distance_predicted")
    drawn = None if predicted is None else np.abs(predicted.values)
    rows: dict[str, list[Any]] = {name: [] for name in ("contacts", *_SUMS)}
    for low, high in itertools.pairwise(limits):
        within = known & (v >= low) & ((v < high) | ((high == limits[-1]) & (v == high)))
        rows["contacts"].append(int(within.sum()))
        sums = (*_median_and_95(size[None], within), *_median_and_95(drawn, within))
        for name, number in zip(_SUMS, sums, strict=True):
            rows[name].append(number)
    data: dict[str, Any] = {
        "lower": ("class", limits[:-1], attributes(quantity)),
        "upper": ("class", limits[1:], attributes(quantity)),
        "contacts": ("class", rows["contacts"], {"units": "1", "long_name": "number of contacts"}),
    }
    for name in _SUMS:
        about = {"units": "m", "long_name": _SUMS[name]}
        data[name] = ("class", np.asarray(rows[name]), about)
    labels = {"label": ("class", [_label(quantity, *pair) for pair in itertools.pairwise(limits)])}
    return xr.Dataset(data, labels, {"quantity": quantity})


_SUMS = {
    "median": "median distance from the surface",
    "largest_95": "95 % of distances from the surface are smaller",
    "median_predicted": "median distance as the covariance predicts",
    "largest_95_predicted": "95 % of distances, as the covariance predicts",
}


def _edges(values: Array) -> Array:
    """Edges of classes with equal numbers of values."""
    if values.size == 0:
        raise ValueError("no classes: no contact has a distance and a value")
    edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, CLASSES + 1)))
    return edges if edges.size > 1 else np.array([edges[0], np.nextafter(edges[0], np.inf)])


def _median_and_95(drawn: Array | None, within: Any) -> tuple[float, float]:
    """Median and 95 % quantile, as medians over the replicates; NaN without values."""
    if drawn is None:
        return float("nan"), float("nan")
    rows = drawn[:, within]
    rows = rows[:, np.isfinite(rows).all(axis=0)]
    if rows.size == 0:
        return float("nan"), float("nan")
    both = np.median(np.quantile(rows, [0.5, 0.95], axis=1), axis=1)
    return float(both[0]), float(both[1])


def _label(quantity: str, low: float, high: float) -> str:
    """Label of a class: its edges in display units."""
    ends = to_display(quantity, [low, high])
    return f"{ends[0]:.3g}–{ends[1]:.3g}"


def axis_offset(
    origin: ArrayLike, axis: ArrayLike, true_origin: ArrayLike, true_axis: ArrayLike
) -> tuple[Array, float]:
    """Offset vector and tilt angle of an axis relative to a true one."""
    direction, true = (np.asarray(a, dtype=np.float64) for a in (axis, true_axis))
    direction, true = direction / np.linalg.norm(direction), true / np.linalg.norm(true)
    away = np.asarray(origin, dtype=np.float64) - np.asarray(true_origin, dtype=np.float64)
    offset = away - (away @ true) * true
    # By the cross product, because the arc cosine loses half the digits of a small angle.
    tilt = np.arctan2(np.linalg.norm(np.cross(direction, true)), abs(direction @ true))
    return offset, float(tilt)
