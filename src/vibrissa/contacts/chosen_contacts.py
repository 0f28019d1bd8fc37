"""Contacts at which sensitivity is evaluated: nodes of a map, the paper's grid, or a trial's."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.charted_whisker import need_map
from vibrissa.contacts.contact_map import ContactMap, node_coordinates
from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray, Array, IntArray, vectors
from vibrissa.rod import (
    PointContact,
    contact_forces,
    contact_tangents,
    deflect,
    determinant,
    solve_forces,
    with_normal_force,
)
from vibrissa.signals import base_signals
from vibrissa.status import Status

#: Choice of contacts; see :func:`chosen_contacts`.
At: TypeAlias = "xr.DataTree | xr.Dataset | Mapping[str, ArrayLike] | ArrayLike | str | None"


@dataclass(frozen=True, eq=False)
class ChosenContacts:
    """Contacts in a flat sequence, non-dimensional (lengths over L, forces over EI/L²)."""

    contacts: Array  # (n, 3), contacts (s, f_y, f_z)
    values: Array  # (n, 6), base force and contact point
    tangents: Array  # (n, 6, 3), derivatives of those with respect to the contacts
    status: IntArray  # (n,), status of each
    shape: tuple[int, ...]  # shape of the input, with n contacts in all
    dims: tuple[str, ...]  # names of the dimensions
    coords: dict[Hashable, Any]  # coordinates along them
    volume: Array | None = None  # (n,), volume of contact points that each represents, m³


def chosen_contacts(
    contact_map: ContactMap, at: At = None, triplet: tuple[str, ...] = ("Fx", "MB", "MD")
) -> ChosenContacts:
    """Contacts at the chosen points, solved with derivatives."""
    need_map(contact_map)
    if at is None:
        return _nodes(contact_map)
    if isinstance(at, str):
        if at != "grid":
            raise ValueError(f"at is 'grid', contacts, signals or a recording; got {at!r}")
        return _grid(contact_map)
    if isinstance(at, xr.DataTree):
        at = at.to_dataset(inherit=False)
    if isinstance(at, xr.Dataset):
        return _of_dataset(contact_map, at, triplet)
    if isinstance(at, Mapping):
        return _of_signals(contact_map, at, triplet, {})
    points = vectors("at", at)
    shape = points.shape[:-1]
    dims = ("contact",) if len(shape) == 1 else tuple(f"axis_{i}" for i in range(len(shape)))
    return _of_points(contact_map, points, dims, {})


def _nodes(contact_map: ContactMap) -> ChosenContacts:
    """All nodes of the chart without the last bearing, which repeats the first."""
    chart = contact_map.chart
    tangents = chart.tangents[:, :-1]
    shape = tangents.shape[:3]
    # Each represents the volume |∂p/∂(η, ψ, ρ)| of its cell, half as large at the box's faces.
    frames = np.abs(np.linalg.det(chart.frames[:, :-1]))
    ends = [np.ones(n) for n in shape]
    for k in (0, 2):
        ends[k][[0, -1]] = 0.5
    cell = 1.0 / (shape[0] - 1) * 2.0 * np.pi / shape[1] / (shape[2] - 1)
    weights = ends[0][:, None, None] * ends[1][:, None] * ends[2]
    volume = np.abs(determinant(tangents)) * frames * weights * cell
    coords = node_coordinates(chart)
    coords["bearing"] = coords["bearing"][:-1]
    n = int(np.prod(shape))
    return ChosenContacts(
        chart.contacts[:, :-1].reshape(n, 3),
        chart.values[:, :-1].reshape(n, 6),
        tangents.reshape(n, 6, 3),
        np.full(n, int(Status.OK)),
        shape,
        ("station", "bearing", "load"),
        coords,
        volume.reshape(n) * chart.discretization.length**3,
    )


def _grid(contact_map: ContactMap) -> ChosenContacts:
    if (grid := contact_map.grid) is None:
        raise ValueError("the map has no grid: simulate it with grid=True")
    axes = [grid[name].to_numpy() for name in ("r", "theta", "phi")]
    reached = grid["status"].to_numpy() == int(Status.OK)
    r, theta, phi = (a[reached] for a in np.meshgrid(*axes, indexing="ij"))
    along = (np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi))
    found = _of_points(contact_map, r[:, None] * np.stack(along, axis=1), ("contact",), {})
    dr, dtheta, dphi = (a[1] - a[0] for a in axes)
    return replace(found, volume=r**2 * np.cos(phi) * dr * dtheta * dphi)


def _of_dataset(
    contact_map: ContactMap, data: xr.Dataset, triplet: tuple[str, ...]
) -> ChosenContacts:
    if "whisker" in data.dims:
        if data.sizes["whisker"] != 1:
            raise ValueError(f"one whisker is needed; the data are of {data.sizes['whisker']}")
        data = data.isel(whisker=0)
    point = "contact_point_whisker"
    if point in data:
        labelled = data[point].transpose(..., "space")
        dims = tuple(str(d) for d in labelled.dims[:-1])
        return _of_points(contact_map, labelled.to_numpy(), dims, _coords(data, dims))
    if {"force", "moment"} <= set(data.variables):
        signals = base_signals(data["force"], data["moment"])
    elif set(triplet) <= set(data.variables):
        signals = data[list(triplet)]
    else:
        names = ", ".join(map(str, data.data_vars)) or "no variables"
        raise ValueError(
            f"{point}, or force and moment, or the signals {', '.join(triplet)} are needed; "
            f"got {names}"
        )
    return _of_signals(contact_map, signals, triplet, _coords(data, tuple(signals.dims)))


def _coords(data: xr.Dataset, dims: tuple[Hashable, ...]) -> dict[Hashable, Any]:
    return {d: data.coords[d] for d in dims if d in data.coords}


def _of_points(
    contact_map: ContactMap, points: Array, dims: tuple[str, ...], coords: dict[Hashable, Any]
) -> ChosenContacts:
    chart = contact_map.chart
    bent = deflect(
        contact_map.whisker, PointContact(points), proximal=chart.proximal, steps=contact_map.steps
    )
    d = chart.discretization
    contacts = np.concatenate(
        [bent.arc_length[..., None] / d.length, bent.contact_force[..., 1:] / d.force], axis=-1
    )
    return _solved(
        contact_map, contacts.reshape(-1, 3), bent.status.ravel(), points.shape[:-1], dims, coords
    )


def _of_signals(
    contact_map: ContactMap,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    triplet: tuple[str, ...],
    coords: dict[Hashable, Any],
) -> ChosenContacts:
    found = contact_map.estimate(signals, triplet)
    d = contact_map.chart.discretization
    force, point = found.force.reshape(-1, 3) / d.force, found.point.reshape(-1, 3) / d.length
    arc = found.arc_length.ravel() / d.length
    normal = contact_forces(d, np.concatenate([force, point], axis=1), arc)[:, 1:]
    contacts = np.concatenate([arc[:, None], normal], axis=1)
    shape, dims = found.status.shape, found.dims
    return _solved(contact_map, contacts, found.status.ravel(), shape, dims, coords)


def _solved(
    contact_map: ContactMap,
    contacts: Array,
    status: IntArray,
    shape: tuple[int, ...],
    dims: tuple[str, ...],
    coords: dict[Hashable, Any],
) -> ChosenContacts:
    """Force, point and derivatives of the contacts that exist."""
    n = len(contacts)
    values, tangents = np.full((n, 6), np.nan), np.full((n, 6, 3), np.nan)
    rows = np.flatnonzero(np.isfinite(contacts).all(axis=1))
    values[rows], tangents[rows] = solve_forces(
        contact_map.chart.discretization, with_normal_force(contacts[rows]), tangents=True
    )
    return ChosenContacts(contacts, values, tangents, status, shape, dims, coords)


def large_deflection(contact_map: ContactMap, chosen: ChosenContacts) -> AnyArray:
    """Whether the deflected whisker points back at each contact; False without a contact."""
    contacts = with_normal_force(chosen.contacts)
    tangents = contact_tangents(contact_map.chart.discretization, contacts)
    return np.asarray(tangents[:, 0] < 0.0)
