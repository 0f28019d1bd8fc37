"""Array types of the mechanics, threads that share rows out, and quantiles over contacts.

Arrays are plain float64, in and out. Kernels release the GIL, so plain threads share rows out. For
quantiles each contact is counted by the volume that it stands for.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import xr

Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]
AnyArray: TypeAlias = NDArray[Any]
Vector: TypeAlias = tuple[float, float, float]


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (..., 3), in less than half of NumPy's time for some hundred."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty((*np.broadcast_shapes(ax.shape, bx.shape), 3))
    out[..., 0] = ay * bz - az * by
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def cross_matrix(a: Array) -> Array:
    """Matrix (..., 3, 3) with which a (..., 3) × b is a product."""
    out = np.zeros((*np.shape(a), 3))
    x, y, z = np.moveaxis(np.asarray(a), -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def spherical(points: Array) -> Array:
    """Spherical form of points: distance, azimuth atan2(y, x), elevation asin(z / r).

    Parameters
    ----------
    points : (..., 3) array
        Points, whisker frame, m.

    Returns
    -------
    (..., 3) array
        Distance r, m, azimuth θ and elevation φ, rad.
    """
    r = np.linalg.norm(points, axis=-1)
    theta = np.arctan2(points[..., 1], points[..., 0])
    phi = np.arctan2(points[..., 2], np.hypot(points[..., 0], points[..., 1]))
    return np.stack([r, theta, phi], axis=-1)


def contact_weights(data: xr.Dataset, region: xr.DataArray | None = None) -> Array:
    """Volumes that contacts of a region stand for, as one row."""
    kept = ~data["small_deflection"] if region is None else region.broadcast_like(data["status"])
    kept = kept.transpose(*data["status"].dims).astype(bool) & np.isfinite(data["r"])
    size = data["volume"] if "volume" in data else xr.ones_like(data["r"])
    return np.where(kept, size, 0.0).ravel()


def weighted_quantile(values: AnyArray, weight: Array, shares: float | AnyArray = 0.5) -> Array:
    """Quantiles of values that are finite and have weight.

    Parameters
    ----------
    values : (n,) array
        Values of any unit.
    weight : (n,) array
        Weights, not negative.
    shares : float or array
        Shares of the total weight, from 0 to 1.

    Returns
    -------
    array
        Quantiles, of the shape of ``shares``; NaN where no value has weight.
    """
    shares = np.asarray(shares, dtype=np.float64)
    kept = np.isfinite(values) & (weight > 0.0)
    if not kept.any():
        return np.full(shares.shape, np.nan)
    order = np.argsort(values[kept], kind="stable")
    sorted_values, w = values[kept][order], weight[kept][order]
    middle = (np.cumsum(w) - 0.5 * w) / w.sum()
    return np.asarray(np.interp(shares, middle, sorted_values))


# Below this many rows starting a thread costs more than it saves.
_SERIAL = 256
_PIECES_PER_THREAD = 4


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    # One pool a process: threads do not survive a fork.
    return ThreadPoolExecutor(max_workers=threads(), thread_name_prefix="vibrissa")


def threads() -> int:
    """Return the number of cores that this process may use; ``VIBRISSA_THREADS`` overrides it."""
    wanted = os.environ.get("VIBRISSA_THREADS")
    if wanted is not None:
        return max(1, int(wanted))
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_out(rows: int, work: Callable[[int, int], object]) -> None:
    """Call ``work(first, last)`` for pieces that cover all rows, on all cores."""
    if rows <= _SERIAL or threads() == 1:
        if rows:
            work(0, rows)
        return
    pieces = min(threads() * _PIECES_PER_THREAD, -(-rows // (_SERIAL // 2)))
    edges = np.linspace(0, rows, pieces + 1).astype(int)
    list(_pool(os.getpid()).map(work, edges[:-1].tolist(), edges[1:].tolist()))
