"""The six base signals: definition, selection, and derivatives.

Force F and moment M about the base, of the object on the whisker, in the whisker frame::

    Fx           axial force, positive pulls the whisker out
    FT, FD       transverse force, its direction:  hypot(Fy, Fz),  atan2(Fz, Fy)
    Mx           twisting moment
    MB, MD       bending moment, its direction:    hypot(My, Mz),  atan2(Mz, My)

Directions are angles in (-π, π]; differences of them are taken modulo 2π.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Hashable, Iterable, Mapping, Sequence
from itertools import combinations
from typing import Any, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray, Array, IntArray, Vector, cross, inlined, numbers
from vibrissa.quantities import attributes

Coordinates: TypeAlias = "dict[Hashable, xr.Variable]"  # of a DataArray, by name

#: The signals in their canonical order.
SIGNALS = ("Fx", "FT", "FD", "Mx", "MB", "MD")
#: All choices of three of the six signals, in canonical order.
TRIPLETS = tuple(combinations(SIGNALS, 3))
#: Indices of the signals, and of other components of force and moment, as channels of kernels.
FX, FT, FD, MX, MB, MD, FY, FZ, MY, MZ = range(10)
_LONGEST_ARM = 10.0  # longest plausible lever arm of a whisker, m
#: Which of the signals are angles.
CIRCULAR = (False, False, True, False, False, True)
#: Signals from which contacts are estimated by default.
TRIPLET = ("Fx", "MB", "MD")
#: Bending moment above which a contact is detected, in standard deviations of its noise.
DETECTED = 5.0


def selection(
    signals: str | Sequence[str] | None, least: int = 3, exactly: int | None = None
) -> tuple[str, ...]:
    """Parse a choice of signals into their names, in canonical order."""
    given: Any = signals.replace(",", " ").split() if isinstance(signals, str) else signals
    given = [] if given is None else list(given) if isinstance(given, Iterable) else [given]
    spelt = {name.lower(): name for name in SIGNALS}
    names = [spelt.get(str(name).lower(), name) for name in given]
    unknown = [name for name in names if name not in SIGNALS]
    enough = len(names) >= least if exactly is None else len(names) == exactly
    if unknown or len(set(names)) != len(names) or not enough:
        number = f"at least {least}" if exactly is None else f"exactly {exactly}"
        known = ", ".join(SIGNALS)
        raise ValueError(f"expected {number} different signals of {known}; got {signals!r}")
    return tuple(name for name in SIGNALS if name in names)


def base_signals(force: ArrayLike | xr.DataArray, moment: ArrayLike | xr.DataArray) -> xr.Dataset:
    """Convert force and moment at the base into the six signals.

    Parameters
    ----------
    force : array_like or DataArray
        Force on the whisker in the whisker frame, N, shape (..., 3). The components of
        a DataArray are along ``space``, or else along its last dimension; its other dimensions are
        kept, with their coordinates. Those of a plain array are called ``sample``, or ``axis_0``,
        ``axis_1``, ... if several.
    moment : array_like or DataArray
        Moment about the base, N·m, same shape.

    Returns
    -------
    Dataset
        ``Fx``, ``FT`` (N), ``FD`` (rad), ``Mx``, ``MB`` (N·m), ``MD`` (rad), each of shape (...).
        A direction is 0 where its vector is zero.

    Warns
    -----
    UserWarning
        If all moments are those of forces more than 10 m from the base, as when force and moment
        are swapped.
    """
    f, m, dims, coords = labelled_wrench(force, moment)
    _check_arms(f, m)
    values = signals_of(f, m)
    return xr.Dataset(
        {name: (dims, values[..., i], attributes(name)) for i, name in enumerate(SIGNALS)}, coords
    )


def _check_arms(force: Array, moment: Array) -> None:
    """Warn if all moments are too large for their forces."""
    size, turning = np.linalg.norm(force, axis=-1), np.linalg.norm(moment, axis=-1)
    known = (size > 0.0) & np.isfinite(turning)
    arm = float(np.min(turning[known] / size[known])) if known.any() else 0.0
    if arm > _LONGEST_ARM:
        warnings.warn(
            f"all moments are those of forces {arm:.3g} m from the base or farther: force, N, "
            "comes before moment, N·m (1 N·mm is 1e-3 N·m)",
            stacklevel=3,
        )


def labelled_wrench(
    force: ArrayLike | xr.DataArray, moment: ArrayLike | xr.DataArray
) -> tuple[Array, Array, tuple[str, ...], Coordinates]:
    """Force and moment as arrays of one shape, with names and coordinates of leading dimensions."""
    given = [_space_last(a) if _is_labelled(a) else a for a in (force, moment)]
    labels = [a for a in given if _is_labelled(a)]
    if len(labels) == 2:
        together = xr.broadcast(*_align(*labels), exclude=("space",))
        labels = [a.transpose(..., "space") for a in together]
        given = [*labels]
    f, m = (numbers(name, a) for name, a in zip(("force", "moment"), given, strict=True))
    if f.shape != m.shape or f.ndim == 0 or f.shape[-1] != 3:
        raise ValueError(
            f"force and moment must have the same shape (..., 3); got {f.shape} and {m.shape}"
        )
    if not labels:
        return f, m, leading_dims(f.shape[:-1]), {}
    dims = tuple(str(d) for d in labels[0].dims[:-1])
    return f, m, dims, coordinates(labels[0], dims)


def _is_labelled(array: ArrayLike | xr.DataArray) -> TypeGuard[xr.DataArray]:
    """Whether an array is a DataArray, determined without importing xarray."""
    return "xarray" in sys.modules and isinstance(array, xr.DataArray)


def _space_last(array: xr.DataArray) -> xr.DataArray:
    """Array whose last dimension is that of the components, called ``space``."""
    if "space" in array.dims:
        return array.transpose(..., "space")
    return array.rename({array.dims[-1]: "space"}) if array.dims else array.expand_dims("space")


def _align(*arrays: xr.DataArray) -> tuple[xr.DataArray, ...]:
    """Align arrays; raise a ValueError if their coordinates do not agree."""
    try:
        return xr.align(*arrays, join="exact", copy=False)
    except ValueError as error:  # xarray's message refers to its own options
        sizes = ", ".join(str(dict(a.sizes)) for a in arrays)
        raise ValueError(f"sizes or coordinates do not agree: {sizes}") from error


def leading_dims(shape: tuple[int, ...]) -> tuple[str, ...]:
    """Default names for the leading dimensions of plain arrays."""
    return ("sample",) if len(shape) == 1 else tuple(f"axis_{i}" for i in range(len(shape)))


def coordinates(array: xr.DataArray, dims: tuple[str, ...]) -> Coordinates:
    """Coordinates along the named dimensions, or without dimensions."""
    return {
        name: coord.variable for name, coord in array.coords.items() if set(coord.dims) <= set(dims)
    }


def signals_of(force: Array, moment: Array) -> Array:
    """Compute the six signals of force and moment.

    Parameters
    ----------
    force, moment : (..., 3) array
        Base force and moment in the whisker frame, any unit.

    Returns
    -------
    (..., 6) array
        Signals in the order of :data:`SIGNALS`.
    """
    return np.stack(
        [
            force[..., 0],
            np.hypot(force[..., 1], force[..., 2]),
            np.arctan2(force[..., 2], force[..., 1]),
            moment[..., 0],
            np.hypot(moment[..., 1], moment[..., 2]),
            np.arctan2(moment[..., 2], moment[..., 1]),
        ],
        axis=-1,
    )


def wrench_derivatives(force: Array, moment: Array) -> Array:
    """Derivatives (..., 6, 6) of the six signals by force and moment."""
    out = np.zeros((*force.shape[:-1], 6, 6))
    for first, vector in ((0, force), (3, moment)):
        y, z = vector[..., 1], vector[..., 2]
        size = np.hypot(y, z)
        out[..., first, first] = 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            out[..., first + 1, first + 1], out[..., first + 1, first + 2] = y / size, z / size
            out[..., first + 2, first + 1] = -z / size**2
            out[..., first + 2, first + 2] = y / size**2
    return out


def measured(
    signals: xr.Dataset | Mapping[str, ArrayLike], names: tuple[str, ...]
) -> tuple[Array, tuple[str, ...], Coordinates]:
    """Return the named signals as one array.

    Parameters
    ----------
    signals : Dataset or mapping
        Signals in SI units: the named ones, or ``force`` and ``moment`` or components such as
        ``Fy`` and ``Fz``, from which they are computed, or components are computed from sizes and
        directions; shapes must broadcast. DataArrays are matched by dimension names.
    names : tuple of str
        Names of the signals.

    Returns
    -------
    values : (..., k) array
        Values in the order of ``names``; NaN means missing.
    dims : tuple of str
        Names of the leading dimensions.
    coords : dict
        Coordinates along them.
    """
    if not hasattr(signals, "keys"):
        raise ValueError(
            f"signals must be a dataset or mapping with {', '.join(names)}, as load_signals reads "
            f"it; got {signals!r}"
        )
    if {"force", "moment"} <= set(map(str, signals)) and any(n not in signals for n in names):
        if all(name in SIGNALS for name in names):
            force, moment, dims, coords = labelled_wrench(signals["force"], signals["moment"])
            _check_arms(force, moment)
            which = [SIGNALS.index(name) for name in names]
            return signals_of(force, moment).take(which, axis=-1), dims, coords
        signals = base_signals(signals["force"], signals["moment"])
    found = _completed(signals, names)
    if missing := [name for name in names if name not in found]:
        raise ValueError(
            f"signals lack {', '.join(missing)}; they have {', '.join(map(str, signals)) or 'none'}"
        )
    given = [found[name] for name in names]
    if any(_is_labelled(a) and a.dims for a in given):
        # A value without dimensions applies to all.
        labels = [a if _is_labelled(a) else _as_scalar(a, names, given) for a in given]
        arrays = xr.broadcast(*_align(*labels))
        dims = tuple(str(d) for d in arrays[0].dims)
        values = np.stack([a.to_numpy().astype(np.float64) for a in arrays], axis=-1)
        return values, dims, coordinates(arrays[0], dims)
    series: list[Any] = [a for a in given if hasattr(a, "to_numpy") and hasattr(a, "index")]
    if not all(a.index.equals(series[0].index) for a in series):
        raise ValueError(
            f"the columns {', '.join(names)} have different indices: their rows do not belong "
            "together, or have another order; put them into one table, or pass plain arrays"
        )
    plain = [numbers(name, a) for name, a in zip(names, given, strict=True)]
    try:
        values = np.stack(np.broadcast_arrays(*plain), axis=-1)
    except ValueError as error:
        shapes = ", ".join(f"{name} {a.shape}" for name, a in zip(names, plain, strict=True))
        raise ValueError(f"signals of different shapes: {shapes}") from error
    return values, leading_dims(values.shape[:-1]), {}


def check_signals(values: Array, names: tuple[str, ...]) -> None:
    """Refuse signals that no sensor in SI units can have measured."""
    for k, name in enumerate(names):
        if name in ("FT", "MB") and (values[..., k] < 0.0).any():
            raise ValueError(
                f"{name} is a size and cannot be negative; got {np.nanmin(values[..., k])}"
            )
        if name in ("FD", "MD") and (np.abs(values[..., k]) > 2.0 * np.pi).any():
            largest = np.nanmax(np.abs(values[..., k]))
            raise ValueError(
                f"{name} is an angle in rad; got {largest:g}, which looks like degrees"
            )


def _completed(
    signals: xr.Dataset | Mapping[str, ArrayLike], names: tuple[str, ...]
) -> dict[str, ArrayLike]:
    """The named signals, computed from others where those have the same content."""
    found = {name: signals[name] for name in names if name in signals}
    for y, z, size, angle in (("Fy", "Fz", "FT", "FD"), ("My", "Mz", "MB", "MD")):
        if {y, z, size, angle}.intersection(names) <= found.keys():
            continue
        if y in signals and z in signals:
            other = signals[y], signals[z]
            computed = {size: np.hypot(*other), angle: np.arctan2(*other[::-1])}
        elif size in signals and angle in signals:
            for name in (size, angle):
                check_signals(numbers(name, signals[name])[..., None], (name,))
            other = signals[size], signals[angle]
            computed = {y: other[0] * np.cos(other[1]), z: other[0] * np.sin(other[1])}
        else:
            continue
        found |= {name: value for name, value in computed.items() if name in names}
    return found


def _as_scalar(value: ArrayLike, names: tuple[str, ...], given: list[ArrayLike]) -> xr.DataArray:
    """Convert a plain number to a DataArray; plain arrays cannot be matched to dimensions."""
    if np.ndim(value):
        labelled = [n for n, a in zip(names, given, strict=True) if _is_labelled(a)]
        raise ValueError(
            f"{', '.join(labelled)} have named dimensions, so the other signals must have them too"
        )
    return xr.DataArray(np.asarray(value, dtype=np.float64))


def circular_among(names: tuple[str, ...]) -> AnyArray:
    """Mask (k,) of the named signals that are angles."""
    return np.array([CIRCULAR[SIGNALS.index(name)] for name in names])


def within_turn(signals: Array, circular: ArrayLike) -> Array:
    """Wrap angles, or differences of angles, to (−π, π]."""
    return np.where(circular, np.pi - (np.pi - signals) % (2.0 * np.pi), signals)


def signal_scales(names: tuple[str, ...], force: float, moment: float) -> Array:
    """Units of the named signals, given those of force and moment."""
    scales = dict.fromkeys(("Fx", "Fy", "Fz", "FT"), force)
    scales |= dict.fromkeys(("Mx", "My", "Mz", "MB"), moment)
    return np.array([scales.get(name, 1.0) for name in names])


@inlined
def _linear_channel(w: int, s: float, force: Vector, moment: Vector, point: Vector) -> float:
    """A channel that is linear in s, F, M and p, or its derivative from their derivatives."""
    if w == FX:
        return force[0]
    if w == MX:
        return moment[0]
    if w == FY:
        return force[1]
    if w == FZ:
        return force[2]
    if w == MY:
        return moment[1]
    if w == MZ:
        return moment[2]
    if w == 10:
        return s
    return point[0] if w == 11 else (point[1] if w == 12 else point[2])


@inlined
def signal_equations(
    s: float,
    value: Array,
    tangents: Array,
    wanted: bool,
    which: IntArray,
    signal: Array,
    jacobian: Array,
) -> None:
    """Compute channels of a contact and, if ``wanted``, their derivatives by the unknowns.

    Channels 0 to 5 are the six signals, 6 to 9 (F_y, F_z, M_y, M_z), 10 the arc length s (the first
    unknown), 11 to 13 the contact point. ``value`` is (F, p), or (F, p, μ) with the moment μ of the
    weight, and ``tangents`` its derivatives, both non-dimensional. Fills ``signal`` (k,) and
    ``jacobian`` (k, unknowns).
    """
    fx, fy, fz = value[0], value[1], value[2]
    px, py, pz = value[3], value[4], value[5]
    mx, my, mz = py * fz - pz * fy, pz * fx - px * fz, px * fy - py * fx
    weighted = value.shape[0] > 6
    if weighted:
        mx, my, mz = mx + value[6], my + value[7], mz + value[8]
    ft, mb = np.sqrt(fy * fy + fz * fz), np.sqrt(my * my + mz * mz)
    for k in range(which.shape[0]):
        w = which[k]
        if w == FT:
            signal[k] = ft
        elif w == FD:
            signal[k] = np.arctan2(fz, fy)
        elif w == MB:
            signal[k] = mb
        elif w == MD:
            signal[k] = np.arctan2(mz, my)
        else:
            signal[k] = _linear_channel(w, s, (fx, fy, fz), (mx, my, mz), (px, py, pz))
    if not wanted:
        return
    for c in range(jacobian.shape[1]):
        dfx, dfy, dfz = tangents[0, c], tangents[1, c], tangents[2, c]
        dpx, dpy, dpz = tangents[3, c], tangents[4, c], tangents[5, c]
        dmx = dpy * fz + py * dfz - dpz * fy - pz * dfy
        dmy = dpz * fx + pz * dfx - dpx * fz - px * dfz
        dmz = dpx * fy + px * dfy - dpy * fx - py * dfx
        if weighted:
            dmx, dmy, dmz = dmx + tangents[6, c], dmy + tangents[7, c], dmz + tangents[8, c]
        ds = 1.0 if c == 0 else 0.0
        for k in range(which.shape[0]):
            w = which[k]
            if w == FT:
                d = (fy * dfy + fz * dfz) / ft
            elif w == FD:
                d = (fy * dfz - fz * dfy) / (ft * ft)
            elif w == MB:
                d = (my * dmy + mz * dmz) / mb
            elif w == MD:
                d = (my * dmz - mz * dmy) / (mb * mb)
            else:
                d_force, d_point = (dfx, dfy, dfz), (dpx, dpy, dpz)
                d = _linear_channel(w, ds, d_force, (dmx, dmy, dmz), d_point)
            jacobian[k, c] = d


def signal_derivatives(values: Array, tangents: Array) -> Array:
    """Derivatives of the six signals by ξ, from (F, p) and its derivatives."""
    force, point = values[..., :3], values[..., 3:]
    d_force, d_point = tangents[..., :3, :], tangents[..., 3:, :]
    by_point = cross(np.swapaxes(d_point, -1, -2), force[..., None, :])
    by_force = cross(point[..., None, :], np.swapaxes(d_force, -1, -2))
    d_moment = np.swapaxes(by_point + by_force, -1, -2)
    by_wrench = wrench_derivatives(force, cross(point, force))
    return np.asarray(by_wrench @ np.concatenate([d_force, d_moment], axis=-2))
