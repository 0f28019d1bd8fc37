"""The solid that contacts fill in the space of three signals: slices, and errors of a look-up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.contacts import Domain, spherical, within_paper_bounds
from vibrissa.identifiability import sensitivity
from vibrissa.numerics import Array
from vibrissa.paper.lookup import Interpolation, LookupTable, cartesian
from vibrissa.quantities import attributes
from vibrissa.signals import CIRCULAR, SIGNALS, measured, selection, within_cone

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

# The slice extends as far as the map's nodes within this share of the held signal's range (of a
# turn, for an angle).
_NEAR = 0.04


def signal_slice(
    contact_map: ContactMap,
    fixed: Mapping[str, float] | None = None,
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    *,
    points: int = 160,
    domain: Domain = "paper",
    interpolation: Interpolation = "natural",
) -> xr.Dataset:
    """Find the contacts on a plane through the space of three signals, exactly.

    Parameters
    ----------
    contact_map : ContactMap
        The whisker's map.
    fixed : mapping, optional
        Signal that is held, with its value, SI units; by default the paper's M_D = 3π/2, which is
        −π/2.
    using : str or tuple of str
        The three signals.
    points : int
        Number of samples of each of the other two signals.
    domain : {"paper", "reachable"}
        Contacts within the bounds of the paper's grid, or all of Ω.
    interpolation : {"natural", "linear"} or callable
        Interpolation of the look-up whose errors are given.

    Returns
    -------
    Dataset
        Over the two other signals, sampled more densely near zero (linearly up to the attribute
        ``linear_width`` of the coordinate, then logarithmically): the contact point, ``r``,
        ``theta`` and ``phi``, the three signals, ``n_candidates`` and ``small_deflection``, NaN
        outside the solid; and ``error_distance`` of the paper's look-up, if the map has its grid.

    Raises
    ------
    ValueError
        If not one signal of the triplet is held, or there are too few points.
    """
    names = selection(using, exactly=3)
    fixed = {"MD": -0.5 * np.pi} if fixed is None else fixed
    if len(fixed) != 1 or not set(fixed) <= set(names):
        raise ValueError(f"one of {', '.join(names)} is to be fixed; got {dict(fixed)}")
    if points < 2:
        raise ValueError(f"a slice needs at least 2 points a side; got {points}")
    ((held, value),) = fixed.items()
    free = [name for name in names if name != held]
    axes = _axes(contact_map, held, value, free, points, domain)
    signals = xr.Dataset(
        {held: ((), value, attributes(held))},
        {
            name: (name, axis, {**attributes(name), "linear_width": width})
            for name, (axis, width) in zip(free, axes, strict=True)
        },
    )
    found = contact_map.estimate({name: signals[name] for name in names}, names)
    dims, point = found.dims, found.point
    if domain == "paper":
        point = np.where(within_paper_bounds(contact_map.whisker, point)[..., None], point, np.nan)
    out = xr.Dataset(
        {
            "contact_point": (
                (*dims, "space"),
                point,
                attributes("contact_point_whisker"),
            ),
            "n_candidates": (dims, found.n_candidates, attributes("candidates")),
            "small_deflection": (
                dims,
                within_cone(contact_map.whisker, point),
                {"units": "1", "long_name": "within 2° of rest"},
            ),
            held: signals[held],
        },
        signals.coords,
        {"fixed": held, "value": value, "triplet": " ".join(names)},
    )
    for i, name in enumerate(("r", "theta", "phi")):
        out[name] = (dims, spherical(point)[..., i], attributes(name))
    if contact_map.grid is not None:
        there = signals.assign(contact_point=out["contact_point"])
        out["error_distance"] = interpolation_errors(contact_map, there, names, interpolation)
    return out


def error_solid(
    contact_map: ContactMap,
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    *,
    stride: int = 3,
    interpolation: Interpolation = "natural",
) -> xr.Dataset:
    """Look up contacts midway between those of the paper's grid, where its errors are largest."""
    if contact_map.grid is None:
        raise ValueError("the map has no grid to interpolate: simulate it with grid=True")
    axes = [contact_map.grid[name].to_numpy() for name in ("r", "theta", "phi")]
    r, theta, phi = (0.5 * (a[1:] + a[:-1]) for a in axes)
    between = np.meshgrid(r, theta[::stride], phi[::stride], indexing="ij")
    points = cartesian(np.stack(between, axis=-1)).reshape(-1, 3)
    out = sensitivity(contact_map, using, points)
    return out.assign(error_distance=interpolation_errors(contact_map, out, using, interpolation))


def interpolation_errors(
    contact_map: ContactMap,
    contacts: xr.Dataset,
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    interpolation: Interpolation = "natural",
) -> xr.DataArray:
    """Look up contacts in the interpolated grid, and compare them with the true ones."""
    names = selection(using, exactly=3)
    values, dims, _ = measured(contacts, names)
    table = LookupTable.of(contact_map, names, near_rest=True, interpolation=interpolation)
    rows = values.reshape(-1, 3)
    known = np.isfinite(rows).all(axis=1)
    true = contacts["contact_point"].transpose(*dims, "space").to_numpy().reshape(-1, 3)
    error = np.full(len(rows), np.nan)
    error[known] = np.linalg.norm(table(rows[known]) - true[known], axis=1)
    return xr.DataArray(
        error.reshape(values.shape[:-1]),
        dims=dims,
        name="error_distance",
        attrs=attributes("error_distance"),
    )


def _axes(
    contact_map: ContactMap, held: str, value: float, free: list[str], points: int, domain: Domain
) -> list[tuple[Array, float]]:
    """Samples of the free signals over the contacts near the slice, and where they turn sparse."""
    nodes = contact_map.to_dataset(domain)
    away = np.abs(nodes[held].to_numpy() - value)
    if CIRCULAR[SIGNALS.index(held)]:
        turn = 2.0 * np.pi
        away = np.minimum(away % turn, turn - away % turn) / turn
    else:
        away /= float(nodes[held].max() - nodes[held].min())
    near = away <= max(_NEAR, float(np.nanmin(away)))
    out = []
    for name in free:
        values = nodes[name].to_numpy()[near]
        width = float(np.quantile(np.abs(values), 0.5)) or 1.0
        low, high = np.arcsinh(np.array([values.min(), values.max()]) / width)
        out.append((width * np.sinh(np.linspace(float(low), float(high), points)), width))
    return out
