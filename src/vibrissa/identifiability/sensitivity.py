"""Sensitivity of the contact point to the base signals, and the best triplet.

Three signals T locate the contact point p, so ∂p/∂T is the effect of a small change of a signal on
the estimate: noise of covariance Σ gives p the covariance ∂p/∂T Σ (∂p/∂T)ᵀ, an ellipsoid. The
derivatives are exact (:mod:`vibrissa.contacts.sensing.channels`); for those of Huet, Emnett &
Hartmann (2022) on an interpolated table see :func:`vibrissa.paper.central_differences`.

Toward rest, where force and moment vanish and directions become undefined, the derivatives diverge.
They are returned there as well; summaries omit contacts within 2° of rest, as the paper does.

The best triplet of a contact is the one with the smallest RMS 3D error predicted from the sensor's
noise, the square root of the trace of that covariance. It refers to small errors: whether a distant
contact has the same signals is decided by the uniqueness of the triplet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from vibrissa.contacts import (
    At,
    ChosenContacts,
    ContactMap,
    Noise,
    SensorNoise,
    chosen_contacts,
    contact_signal_derivatives,
    ellipsoids,
    large_deflection,
    need_map,
    rms_error,
    spherical_derivatives,
    within_paper_bounds,
)
from vibrissa.numerics import Array, contact_weights, cross, weighted_quantile
from vibrissa.quantities import attributes, quantity
from vibrissa.signals import (
    TRIPLETS,
    base_signals,
    concave_backward,
    cone_angle,
    selection,
    spherical,
    within_cone,
)
from vibrissa.status import flag_attributes


def sensitivity(
    contact_map: ContactMap,
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    at: At = None,
    *,
    noise: Noise | None = None,
) -> xr.Dataset:
    """Compute the derivatives of the contact point by the three signals that locate it.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker.
    triplet : str or tuple of str
        The three signals.
    at : Dataset, DataTree, mapping, array_like, "grid" or None
        Contacts: None for the nodes of the map, all over Ω; ``"grid"`` for the reachable ones of
        the paper's grid; contact points (..., 3) in the whisker frame, m; or a recording or other
        dataset from whose ``contact_point_whisker``, or else ``force`` and ``moment``, or else
        signals of the triplet the contacts are found.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal of the triplet, or covariance of (F, M), SI units, from
        which error ellipsoids are computed.

    Returns
    -------
    Dataset
        Over the contacts' dimensions: ``sensitivity`` (coordinate, signal), ∂(r, θ, φ)/∂(signals),
        and ``point_sensitivity`` (space, signal), ∂(x, y, z)/∂(signals), with the SI unit of each
        entry in the coordinates ``unit`` and ``point_unit``; NaN where the signals do not determine
        the point. In addition the contact point, its spherical coordinates, the six signals, the
        regions (``small_deflection``, ``concave_backward``, ``large_deflection``,
        ``within_paper_bounds``), ``status``, and ``volume``, the volume of contact points that a
        node represents. With ``noise`` also ``covariance``, ``semi_axes`` and ``axis_directions``
        of its ellipsoid (one standard deviation, longest first), and ``predicted_error``, the RMS
        3D error.

    Examples
    --------
    >>> import vibrissa as vb
    >>> contact_map = vb.ContactMap.simulate(vb.samples.gamma(), grid=False)
    >>> found = vb.sensitivity(contact_map)
    >>> str(found.sensitivity.sel(coordinate="r", signal="MB").unit.values)
    'm/(N m)'
    """
    names = selection(triplet, exactly=3)
    chosen = chosen_contacts(contact_map, at, names)
    whisker = contact_map.whisker
    sensor = None if noise is None else SensorNoise.of(noise, names, whisker=whisker)
    d = contact_map.chart.discretization
    out = _contact_variables(contact_map, chosen)
    point = chosen.values[:, 3:] * d.length
    by_signal = contact_signal_derivatives(d, chosen.values, chosen.tangents, names)
    in_sphere = spherical_derivatives(point) @ by_signal
    for name, matrix, rows, long_name in (
        ("sensitivity", in_sphere, ("coordinate", ("r", "theta", "phi")), "spherical coordinates"),
        ("point_sensitivity", by_signal, ("space", ("x", "y", "z")), "the contact point"),
    ):
        out = out.merge(_jacobian(name, matrix, chosen, rows, names, long_name))
    out.attrs |= {"triplet": " ".join(names), "method": "exact"}
    if isinstance(at, str):
        out.attrs["at"] = at
    if sensor is not None:
        force = chosen.values[:, :3] * d.force
        sigma = sensor.covariance(names, force, cross(point, force))
        covariance = by_signal @ sigma @ np.swapaxes(by_signal, -1, -2)
        out = out.merge(ellipsoids(covariance, chosen.dims, chosen.shape))
    return out


def _contact_variables(contact_map: ContactMap, chosen: ChosenContacts) -> xr.Dataset:
    """Dataset of contacts with their points, signals and regions."""
    d, whisker = contact_map.chart.discretization, contact_map.whisker
    force, point = chosen.values[:, :3] * d.force, chosen.values[:, 3:] * d.length
    known = np.isfinite(point).all(axis=1)
    columns: dict[str, tuple[Any, dict[str, Any]]] = {
        "arc_length": (chosen.contacts[:, 0] * d.length, attributes("arc_length")),
        "deflection_angle": (cone_angle(whisker, point), attributes("deflection_angle")),
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
    for signal in base_signals(force, cross(point, force)).data_vars.values():
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


def _jacobian(
    name: str,
    matrix: Array,
    chosen: ChosenContacts,
    rows: tuple[str, tuple[str, ...]],
    names: tuple[str, ...],
    long_name: str,
) -> xr.Dataset:
    """One Jacobian (n, 3, 3), with the unit of each entry."""
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


def best_triplet(
    contact_map: ContactMap,
    noise: Noise,
    at: At = None,
    *,
    triplets: Sequence[str | tuple[str, ...]] = TRIPLETS,
) -> xr.Dataset:
    """Find the triplet with the smallest predicted 3D error for each contact.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker.
    noise : mapping or (6, 6) array_like
        Standard deviation of each signal, or covariance of (F, M), SI units.
    at : Dataset, DataTree, mapping, array_like, "grid" or None
        Contacts, as for :func:`~vibrissa.sensitivity`: all over Ω by default. If signals are given,
        contacts are found from (Fx, MB, MD).
    triplets : sequence
        Triplets to compare; all twenty by default.

    Returns
    -------
    Dataset
        ``predicted_error`` (triplet, ...), m, NaN where the triplet does not determine the contact;
        ``best`` (...), the triplet of least error, empty where none determines it; for each
        triplet, over the contacts outside the cone of 2° about rest: ``share`` where it is best,
        ``determined`` where it determines the contact, ``median_error`` where it does, and
        ``median_error_where_best``. Shares are of the volume of contact points where contacts
        sample space, else of the number of contacts. In addition the variables that describe
        contacts, as from :func:`~vibrissa.sensitivity`.
    """
    chosen_names = [selection(triplet, exactly=3) for triplet in triplets]
    if not chosen_names:
        raise ValueError("at least one triplet is needed; got none")
    need_map(contact_map)
    every = tuple(dict.fromkeys(n for t in chosen_names for n in t))
    sensor = SensorNoise.of(noise, every, whisker=contact_map.whisker)
    chosen = chosen_contacts(contact_map, at)
    errors = np.stack(
        [_predicted_errors(contact_map, chosen, names, sensor) for names in chosen_names]
    )
    labels = np.array([" ".join(names) for names in chosen_names])
    known = np.isfinite(errors).any(axis=0)
    winner = np.where(known, np.argmin(np.where(np.isfinite(errors), errors, np.inf), axis=0), -1)
    data = _contact_variables(contact_map, chosen)
    weight = contact_weights(data)
    wins = winner == np.arange(len(labels))[:, None]
    finite = np.isfinite(errors)
    total = weight.sum()
    with np.errstate(invalid="ignore"):
        summaries = {
            "share": (wins @ weight / total, "share of contacts where the triplet is best"),
            "determined": (finite @ weight / total, "share where it determines the contact"),
        }
    medians = {
        "median_error": np.array([weighted_quantile(e, weight) for e in errors]),
        "median_error_where_best": np.array(
            [weighted_quantile(e, weight * w) for e, w in zip(errors, wins, strict=True)]
        ),
    }
    best = np.where(known, labels[winner], "").reshape(chosen.shape)
    return data.assign(
        {
            "predicted_error": (
                ("triplet", *chosen.dims),
                errors.reshape(-1, *chosen.shape),
                attributes("predicted_error"),
            ),
            "best": (chosen.dims, best, {"units": "1", "long_name": "triplet of least error"}),
            **{
                name: ("triplet", values, {"units": "1", "long_name": long_name})
                for name, (values, long_name) in summaries.items()
            },
            **{name: ("triplet", v, attributes("predicted_error")) for name, v in medians.items()},
        }
    ).assign_coords(triplet=labels)


def _predicted_errors(
    contact_map: ContactMap, chosen: ChosenContacts, names: tuple[str, ...], sensor: SensorNoise
) -> Array:
    """Predicted RMS 3D errors (n,), m; NaN where the triplet does not determine the contact."""
    d = contact_map.chart.discretization
    force, point = chosen.values[:, :3] * d.force, chosen.values[:, 3:] * d.length
    by_signal = contact_signal_derivatives(d, chosen.values, chosen.tangents, names)
    sigma = sensor.covariance(names, force, cross(point, force))
    return rms_error(by_signal @ sigma @ np.swapaxes(by_signal, -1, -2))
