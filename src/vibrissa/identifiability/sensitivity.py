"""How far the contact point moves when a signal at the base changes.

Three signals T locate the contact point p, so ∂p/∂T says what a small change of a signal, or its
noise, does to the estimate: noise of covariance Σ spreads p by ∂p/∂T Σ (∂p/∂T)ᵀ, an ellipsoid. The
derivatives are exact (:mod:`vibrissa.contacts.jacobian`); for those of Huet, Emnett & Hartmann
(2022) on an interpolated table see :func:`vibrissa.paper.central_differences`.

Toward rest, where force and moment vanish and directions lose their meaning, the derivatives grow
without bound. They are given there all the same; summaries leave out contacts within 2° of rest, as
the paper does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from vibrissa.contacts.chosen_contacts import (
    At,
    ChosenContacts,
    chosen_contacts,
    large_deflection,
)
from vibrissa.contacts.contact_map import spherical, within_paper_bounds
from vibrissa.contacts.jacobian import contact_signal_derivatives, spherical_derivatives
from vibrissa.contacts.noise import Noise, SensorNoise, ellipsoids
from vibrissa.numerics import Array
from vibrissa.quantities import attributes, quantity
from vibrissa.signals import base_signals, concave_backward, nearest_on_rest, selection, within_cone
from vibrissa.status import flag_attributes

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap


def sensitivity(
    contact_map: ContactMap,
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    at: At = None,
    *,
    noise: Noise | None = None,
) -> xr.Dataset:
    """Derivatives of the contact point with respect to the three signals that locate it.

    Parameters
    ----------
    contact_map : ContactMap
        The whisker's map.
    triplet : str or tuple of str
        The three signals.
    at : Dataset, DataTree, mapping, array_like, "grid" or None
        Which contacts: None, the nodes of the map, all over Ω; ``"grid"``, the reachable ones of
        the paper's grid; contact points (..., 3) in the whisker frame, m; or a recording, or any
        dataset with ``contact_point_whisker``, or else ``force`` and ``moment``, or else the
        signals of the triplet, which locate the contacts.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal of the triplet, or covariance of (F, M), SI units; gives
        the error ellipsoids.

    Returns
    -------
    Dataset
        Over the contacts' dimensions: ``sensitivity`` (coordinate, signal), ∂(r, θ, φ)/∂(signals),
        and ``point_sensitivity`` (space, signal), ∂(x, y, z)/∂(signals), with the SI unit of each
        entry in the coordinates ``unit`` and ``point_unit``; NaN where the signals do not determine
        the point. With it the contact point, its spherical form, the six signals, the regions
        (``small_deflection``, ``concave_backward``, ``large_deflection``, ``within_paper_bounds``),
        ``status``, and ``volume``, the volume of contact points that a node stands for. With
        ``noise`` also ``covariance``, ``semi_axes`` and ``axis_directions`` of its ellipsoid (one
        standard deviation, the longest first), and ``predicted_error``, the RMS 3D error.

    Raises
    ------
    ValueError
        If the triplet, the contacts or the noise do not fit.

    Examples
    --------
    >>> import vibrissa as vb
    >>> contact_map = vb.ContactMap.simulate(vb.samples.gamma(), grid=False)
    >>> found = vb.sensitivity(contact_map)
    >>> str(found.sensitivity.sel(coordinate="r", signal="MB").unit.values)
    'm/(N m)'
    """
    names = selection(triplet, exactly=3)
    sensor = None if noise is None else SensorNoise.of(noise, names)
    chosen = chosen_contacts(contact_map, at, names)
    d = contact_map.chart.discretization
    out = contacts_dataset(contact_map, chosen)
    point = chosen.values[:, 3:] * d.length
    by_signal = contact_signal_derivatives(d, chosen.values, chosen.tangents, names)
    in_sphere = spherical_derivatives(point) @ by_signal
    for name, matrix, rows, long_name in (
        ("sensitivity", in_sphere, ("coordinate", ("r", "theta", "phi")), "spherical coordinates"),
        ("point_sensitivity", by_signal, ("space", ("x", "y", "z")), "the contact point"),
    ):
        out = out.merge(_matrix(name, matrix, chosen, rows, names, long_name))
    out.attrs |= {"triplet": " ".join(names), "method": "exact"}
    if sensor is not None:
        force = chosen.values[:, :3] * d.force
        sigma = sensor.covariance(names, force, np.cross(point, force))
        covariance = by_signal @ sigma @ np.swapaxes(by_signal, -1, -2)
        out = out.merge(ellipsoids(covariance, chosen.dims, chosen.shape))
    return out


def contacts_dataset(contact_map: ContactMap, chosen: ChosenContacts) -> xr.Dataset:
    """Label contacts: where they are, what they feel like, in which regions they lie."""
    d, whisker = contact_map.chart.discretization, contact_map.whisker
    force, point = chosen.values[:, :3] * d.force, chosen.values[:, 3:] * d.length
    known = np.isfinite(point).all(axis=1)
    away, arc_length = nearest_on_rest(whisker, point)
    columns: dict[str, tuple[Any, dict[str, Any]]] = {
        "arc_length": (chosen.contacts[:, 0] * d.length, attributes("arc_length")),
        "deflection_angle": (np.arctan2(away, arc_length), attributes("deflection_angle")),
        "small_deflection": (within_cone(whisker, point), _flag("within 2° of rest")),
        "concave_backward": (known & concave_backward(whisker, point), _flag("CB, not CF")),
        "large_deflection": (
            large_deflection(contact_map, chosen),
            _flag("whether the whisker points back at the contact"),
        ),
        "within_paper_bounds": (
            known & within_paper_bounds(whisker, point),
            _flag("within the bounds of the paper's grid"),
        ),
        "status": (chosen.status, {**attributes("status"), **flag_attributes()}),
    }
    if chosen.volume is not None:
        units = {"units": "m^3", "long_name": "volume of contact points that a contact stands for"}
        columns["volume"] = (chosen.volume, units)
    for i, name in enumerate(("r", "theta", "phi")):
        columns[name] = (spherical(point)[:, i], attributes(name))
    for signal in base_signals(force, np.cross(point, force)).data_vars.values():
        name = str(signal.name)
        columns[name] = (signal.to_numpy(), attributes(name))
    data = {n: (chosen.dims, v.reshape(chosen.shape), a) for n, (v, a) in columns.items()}
    data["contact_point"] = (
        (*chosen.dims, "space"),
        point.reshape(*chosen.shape, 3),
        attributes("contact_point_whisker"),
    )
    return xr.Dataset(data, {**chosen.coords, "space": ["x", "y", "z"]})


def _flag(long_name: str) -> dict[str, str]:
    return {"units": "1", "long_name": long_name}


def _matrix(
    name: str,
    matrix: Array,
    chosen: ChosenContacts,
    rows: tuple[str, tuple[str, ...]],
    names: tuple[str, ...],
    long_name: str,
) -> xr.Dataset:
    """One Jacobian (n, 3, 3), the unit of each entry beside it."""
    dim, labels = rows
    units = [[_per(quantity(a).unit, quantity(b).unit) for b in names] for a in labels]
    unit = "unit" if name == "sensitivity" else "point_unit"
    above, below = (",".join(quantity(n).unit for n in group) for group in (labels, names))
    about = {"units": f"({above})/({below})", "long_name": f"derivatives of {long_name} by signals"}
    return xr.Dataset(
        {name: ((*chosen.dims, dim, "signal"), matrix.reshape(*chosen.shape, 3, 3), about)},
        {dim: list(labels), "signal": list(names), unit: ((dim, "signal"), units)},
    )


def _per(above: str, below: str) -> str:
    return f"{above}/({below})" if " " in below else f"{above}/{below}"
