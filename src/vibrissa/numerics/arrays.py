"""Array types, checks of numerical input, threads, and weighted quantiles.

Arrays are plain float64. Kernels release the GIL, so rows can be distributed over plain threads. In
quantiles over contacts, each is weighted by the volume that it represents.
"""

from __future__ import annotations

import os
import re
import reprlib
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, partial, wraps
from typing import Any, ParamSpec, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.deferred import xr

P = ParamSpec("P")
R = TypeVar("R")
Array: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
Mask: TypeAlias = NDArray[np.bool_]
AnyArray: TypeAlias = NDArray[Any]
Vector: TypeAlias = tuple[float, float, float]
#: A kernel and the arguments with which it will be called: values, or their types.
Call: TypeAlias = tuple[Callable[..., Any], tuple[Any, ...]]

# Units with a prefix, or degrees, whose numbers would be used as if they were in SI units
_MULTIPLE = re.compile(
    "([pnuµμmcdkMG]|pico|nano|micro|milli|centi|deci|kilo|mega|giga)"
    "([mNs]|Pa|rad|meters?|metres?|newtons?|seconds?|pascals?|radians?)|°|deg|degrees?"
)

SKEW = 1e-5
"""Largest entry of RᵀR − 1 for a rotation R that was written with few digits."""

_FIFTH = 0.2  # share of contacts whose signal is small, and of those whose signal is large


def contacts_in(touching: Mask, known: Mask | None = None) -> list[tuple[int, int]]:
    """First frame of each contact, or other run of true values, and the frame after its last.

    Frames that are not ``known``, between two frames in contact, count as contact: a frame lost by
    tracking does not end a contact.
    """
    held = np.asarray(touching, dtype=bool)
    if known is not None and not known.all():
        seen = np.flatnonzero(known)
        before = np.searchsorted(seen, np.arange(held.size), side="right") - 1
        after = np.searchsorted(seen, np.arange(held.size))
        inside = ~known & (before >= 0) & (after < seen.size)
        held = held & known
        held[inside] = held[seen[before[inside]]] & held[seen[after[inside]]]
    edges = np.flatnonzero(np.diff(held.astype(int), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def cross(a: Array, b: Array) -> Array:
    """Cross product of vectors (..., 3), more than twice as fast as NumPy's for some hundred."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out = np.empty((*np.broadcast_shapes(ax.shape, bx.shape), 3))
    out[..., 0] = ay * bz - az * by
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def cross_matrix(a: Array) -> Array:
    """Matrix (..., 3, 3) of the map b ↦ a × b, for a (..., 3)."""
    out = np.zeros((*np.shape(a), 3))
    x, y, z = np.moveaxis(np.asarray(a), -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def exponential(w: Array) -> tuple[Array, Array]:
    """Rotations exp [w]ₓ (..., 3, 3) of rotation vectors, and ∫ exp [t w]ₓ dt over t from 0 to 1.

    Below 0.1 rad the coefficients are computed from their series, which are exact to rounding,
    unlike (θ − sin θ)/θ³.
    """
    x = np.sum(w * w, axis=-1)[..., np.newaxis, np.newaxis]
    small = x < 1e-2
    theta = np.sqrt(np.where(small, 1.0, x))
    a = np.where(small, _series(x, 1.0, (6, 20, 42, 72)), np.sin(theta) / theta)
    b = np.where(small, _series(x, 1 / 2, (12, 30, 56, 90)), (1.0 - np.cos(theta)) / theta**2)
    c = np.where(small, _series(x, 1 / 6, (20, 42, 72, 110)), (theta - np.sin(theta)) / theta**3)
    k = cross_matrix(w)
    k2 = k @ k
    return np.eye(3) + a * k + b * k2, np.eye(3) + b * k + c * k2


def _series(x: Array, first: float, ratios: tuple[int, ...]) -> Array:
    """Power series with given first term and ratios of denominators."""
    total, term = np.full_like(x, first), np.full_like(x, first)
    for ratio in ratios:
        term = -term * x / ratio
        total = total + term
    return total


def numbers(
    name: str, value: object, order: Sequence[str] = ("x", "y", "z"), *, any_unit: bool = False
) -> Array:
    """Convert a user's input to float64, with masked values as NaN, which means missing.

    A ``space`` dimension is moved last. If columns, or labels of the last axis, have the names in
    ``order`` (such as Fx, Fy and Fz), they must be in this order, because arrays are indexed by
    position. A stated unit, of a labelled array or a quantity, must not be a multiple of SI units,
    except for readings of channels, which may have any unit.
    """
    given: Any = value
    if isinstance(given, list | tuple) and any(isinstance(v, np.ma.MaskedArray) for v in given):
        with suppress(ValueError):
            given = np.ma.array(given)  # np.asarray would use the hidden values of the items
    if type(given) in (np.ndarray, list, tuple):  # the usual case: quick for single measurements
        try:
            plain = np.asarray(given)
        except ValueError:
            plain = np.empty(0, dtype=object)
        if plain.dtype.kind in "fiu":
            return plain.astype(np.float64, copy=False)
    unit = getattr(given, "attrs", {}).get("units", getattr(given, "units", None))
    unit = getattr(given, "unit", "") if unit is None else unit
    parts = [] if any_unit else re.findall("[A-Za-zµμ°]+", str(unit))
    if any(map(_MULTIPLE.fullmatch, parts)):
        raise ValueError(f"{name} is stated in {unit}; SI units are needed (m, N, N·m, rad, s)")
    if "space" in getattr(given, "dims", ()):
        given = given.transpose(..., "space")
    labels = [str(label) for label in _last_labels(given)]
    found = [[label.lower().endswith(end.lower()) for end in order] for label in labels]
    places = [one.index(True) for one in found if any(one)]
    if len(labels) == len(set(places)) == len(order) and places != sorted(places):
        raise ValueError(
            f"{name} has columns {', '.join(labels)}; {', '.join(order)} are needed in this order"
        )
    try:
        if np.asarray(given).dtype.kind not in "iufO":
            raise TypeError
        if isinstance(given, np.ma.MaskedArray):
            given = np.ma.filled(given.astype(np.float64), np.nan)
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        of = getattr(given, "dtype", None)
        kind = reprlib.repr(given) if of is None else f"{type(given).__name__} of {of}"
        raise ValueError(f"{name} must be numbers; got {kind}") from error


def vectors(name: str, value: object) -> Array:
    """Convert a user's vectors (..., 3) to float64."""
    array = numbers(name, value)
    if array.ndim == 0 or array.shape[-1] != 3:
        raise ValueError(f"{name} must have shape (..., 3); got {array.shape}")
    return array


def _last_labels(value: Any) -> Iterable[object]:
    """Labels of the last axis of a table, a row of a table, or a labelled array."""
    if hasattr(value, "columns"):
        return cast(Iterable[object], value.columns)
    if hasattr(value, "index") and hasattr(value, "to_numpy"):  # a row of a table
        return cast(Iterable[object], value.index)
    last = (getattr(value, "dims", None) or (None,))[-1]
    labelled = last in getattr(value, "coords", ())
    return cast(Iterable[object], value.coords[last].values if labelled else ())


def rotation_matrices(name: str, value: object) -> Array:
    """Check a user's rotation matrices (..., 3, 3); NaN means missing."""
    turn = numbers(name, value)
    if turn.shape[-2:] != (3, 3):
        raise ValueError(f"{name} is of rotation matrices, (..., 3, 3); got shape {turn.shape}")
    one = turn.ndim == 2  # plain numbers take a third of the time of arrays
    x, y, z = turn.tolist() if one else np.moveaxis(turn, (-2, -1), (0, 1))
    skew = (
        *(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] - 1.0, x[1] * y[2] - x[2] * y[1] - z[0]),
        *(x[2] * y[0] - x[0] * y[2] - z[1], x[0] * y[1] - x[1] * y[0] - z[2]),
        *(y[1] * z[2] - y[2] * z[1] - x[0], y[2] * z[0] - y[0] * z[2] - x[1]),
        y[0] * z[1] - y[1] * z[0] - x[2],
    )
    if (np.abs(skew) > SKEW).any():
        raise ValueError(
            f"{name} is not a rotation: its columns must be right-handed unit vectors at 90°"
        )
    return turn


def relative(name: str, value: object) -> Array:
    """Check a user's relative standard deviations, which must not be in per cent."""
    sigma = numbers(name, value)
    if not ((sigma >= 0.0) & (sigma <= 1.0)).all():
        raise ValueError(
            f"{name} is a relative standard deviation from 0 to 1 (5 % is 0.05); got {value!r}"
        )
    return sigma


def spherical(points: ArrayLike) -> Array:
    """Spherical coordinates of points: distance, azimuth atan2(y, x), elevation asin(z / r).

    Parameters
    ----------
    points : (..., 3) array_like
        Points, whisker frame, m.

    Returns
    -------
    (..., 3) array
        Distance r, m, azimuth θ and elevation φ, rad.
    """
    points = vectors("points", points)
    r = np.linalg.norm(points, axis=-1)
    theta = np.arctan2(points[..., 1], points[..., 0])
    phi = np.arctan2(points[..., 2], np.hypot(points[..., 0], points[..., 1]))
    return np.stack([r, theta, phi], axis=-1)


def contact_weights(data: xr.Dataset, region: xr.DataArray | None = None) -> Array:
    """Volumes represented by the contacts of a region, flat; 0 for other contacts."""
    kept = ~data["small_deflection"] if region is None else region.broadcast_like(data["status"])
    kept = kept.transpose(*data["status"].dims).astype(bool) & np.isfinite(data["r"])
    size = data["volume"] if "volume" in data else xr.ones_like(data["r"])
    return np.where(kept, size, 0.0).ravel()


def weighted_quantile(values: AnyArray, weight: Array, shares: float | AnyArray = 0.5) -> Array:
    """Weighted quantiles of the finite values; NaN where no value has weight."""
    shares = np.asarray(shares, dtype=np.float64)
    kept = np.isfinite(values) & (weight > 0.0)
    if not kept.any():
        return np.full(shares.shape, np.nan)
    order = np.argsort(values[kept], kind="stable")
    sorted_values, w = values[kept][order], weight[kept][order]
    middle = (np.cumsum(w) - 0.5 * w) / w.sum()
    return np.asarray(np.interp(shares, middle, sorted_values))


def small_over_large(sizes: Array, signal: Array, weight: Array) -> float:
    """Median size in the fifth of the smallest |signal| over that in the fifth of the largest."""
    signal = np.abs(signal)
    low, high = weighted_quantile(signal, weight, np.array([_FIFTH, 1.0 - _FIFTH]))
    small, large = (
        weighted_quantile(sizes, weight * part) for part in (signal <= low, signal >= high)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(small / large)


def without_blas_threads(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: run linear algebra in the thread that calls a function.

    For small matrices, threads of BLAS mostly wait for each other; if other work keeps the cores
    busy, that takes up to a hundred times as long as the product itself.
    """

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        from threadpoolctl import threadpool_limits  # comes with scikit-learn

        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return alone


_of_thread = threading.local()


def on_one_core(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: keep all rows in the thread that calls a function.

    For one of several tasks that are distributed over all cores: threads that hand over parts of
    rows mostly wait for each other.
    """

    @wraps(function)
    def alone(*args: P.args, **kwargs: P.kwargs) -> R:
        before, _of_thread.alone = getattr(_of_thread, "alone", False), True
        try:
            return function(*args, **kwargs)
        finally:
            _of_thread.alone = before

    return alone


# Number of rows below which starting a thread costs more than it saves.
_SERIAL = 256
_PIECES_PER_THREAD = 4


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Thread pool of a process; threads do not survive a fork."""
    return ThreadPoolExecutor(max_workers=threads(), thread_name_prefix="vibrissa")


def threads() -> int:
    """Return the number of cores that this process may use; ``VIBRISSA_THREADS`` overrides it."""
    if wanted := os.environ.get("VIBRISSA_THREADS"):
        if not wanted.strip().isdecimal() or int(wanted) == 0:
            raise ValueError(
                f"the environment variable VIBRISSA_THREADS is {wanted!r}; a number of cores, 1 or "
                "more, is needed"
            )
        return int(wanted)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_out(rows: int, work: Callable[..., object], *given: object) -> None:
    """Call ``work(*given, first, last)`` on parts that cover all rows, on all cores."""
    if rows <= _SERIAL or threads() == 1 or getattr(_of_thread, "alone", False):
        if rows:
            work(*given, 0, rows)
        return
    pieces = min(threads() * _PIECES_PER_THREAD, -(-rows // (_SERIAL // 2)))
    edges = np.linspace(0, rows, pieces + 1).astype(int)
    parts = edges[:-1].tolist(), edges[1:].tolist()
    list(_pool(os.getpid()).map(partial(work, *given), *parts))
