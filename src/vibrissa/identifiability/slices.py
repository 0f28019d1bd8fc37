"""A slice through the solid that the contacts fill in the space of three signals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.contacts.chosen_contacts import chosen_contacts
from vibrissa.contacts.contact_map import Domain, spherical, within_paper_bounds
from vibrissa.identifiability.sensitivity import contacts_dataset
from vibrissa.numerics import Array
from vibrissa.paper.differences import Interpolation, interpolation_errors
from vibrissa.quantities import attributes
from vibrissa.signals import CIRCULAR, SIGNALS, selection, within_cone

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

# Nodes of the map within this share of a signal's range (an angle's: of a turn) of the slice tell
# how far the slice reaches.
_NEAR = 0.04


def signal_slice(
    contact_map: ContactMap,
    fixed: Mapping[str, float] | None = None,
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
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
        The signal that is held and its value, SI units; by default the paper's M_D = 3π/2, which is
        −π/2.
    triplet : str or tuple of str
        The three signals.
    points : int
        Along each of the other two signals.
    domain : {"paper", "reachable"}
        Only the contacts within the bounds of the paper's grid, or all of Ω.
    interpolation : {"natural", "linear"} or callable
        How the look-up whose errors are told interpolates.

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
    names = selection(triplet, exactly=3)
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
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    *,
    stride: int = 3,
    interpolation: Interpolation = "natural",
) -> xr.Dataset:
    """Look contacts up that lie midway between those of the paper's grid, where it knows least.

    Parameters
    ----------
    contact_map : ContactMap
        With the paper's grid.
    triplet : str or tuple of str
        The three signals.
    stride : int
        Steps of azimuth and elevation from one contact to the next.
    interpolation : {"natural", "linear"} or callable
        How the grid is looked up.

    Returns
    -------
    Dataset
        What :func:`vibrissa.sensitivity` says of these contacts, and ``error_distance``, m.

    Raises
    ------
    ValueError
        If the map has no grid.
    """
    if contact_map.grid is None:
        raise ValueError("the map has no grid to interpolate: simulate it with grid=True")
    axes = [contact_map.grid[name].to_numpy() for name in ("r", "theta", "phi")]
    r, theta, phi = (0.5 * (a[1:] + a[:-1]) for a in axes)
    r, theta, phi = np.meshgrid(r, theta[::stride], phi[::stride], indexing="ij")
    along = (np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi))
    points = (r[..., None] * np.stack(along, axis=-1)).reshape(-1, 3)
    out = contacts_dataset(contact_map, chosen_contacts(contact_map, points))
    names = selection(triplet, exactly=3)
    out["error_distance"] = interpolation_errors(contact_map, out, names, interpolation)
    return out.assign_attrs(triplet=" ".join(names))


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
