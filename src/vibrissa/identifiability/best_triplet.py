"""Which three signals locate a contact best, contact by contact, for a given sensor.

For each triplet the RMS 3D error predicted from the sensor's noise is the square root of the trace
of ∂p/∂T Σ (∂p/∂T)ᵀ. It is a statement about small errors: whether another contact far away has the
same signals is not asked here, but in the uniqueness of the triplet.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.contacts.chosen_contacts import At, ChosenContacts, chosen_contacts
from vibrissa.contacts.jacobian import contact_signal_derivatives
from vibrissa.contacts.noise import Noise, SensorNoise, rms_error
from vibrissa.identifiability.sensitivity import contacts_dataset
from vibrissa.numerics import Array, contact_weights, weighted_quantile
from vibrissa.quantities import attributes
from vibrissa.signals import TRIPLETS, selection

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap


def best_triplet(
    contact_map: ContactMap,
    noise: Noise,
    at: At = None,
    *,
    triplets: Sequence[str | tuple[str, ...]] = TRIPLETS,
) -> xr.Dataset:
    """Find for each contact the triplet with the smallest predicted 3D error.

    Parameters
    ----------
    contact_map : ContactMap
        The whisker's map.
    noise : mapping or (6, 6) array_like
        Standard deviation of each signal, or covariance of (F, M), SI units.
    at : Dataset, DataTree, mapping, array_like, "grid" or None
        Which contacts, as for :func:`~vibrissa.sensitivity`: all over Ω by default. From signals
        contacts are found with (Fx, MB, MD).
    triplets : sequence
        That compete; all twenty by default.

    Returns
    -------
    Dataset
        ``predicted_error`` (triplet, ...), m, NaN where the triplet does not determine the contact;
        ``best`` (...), the triplet with the least, empty where none does; for each triplet, over
        the contacts outside the cone of 2° about rest: ``share`` where it is best, ``determined``
        where it determines the contact at all, ``median_error`` where it does, and
        ``median_error_where_best``. Shares are of the volume of contact points, where contacts
        sample space, or of contacts. With them what :func:`~vibrissa.sensitivity` says of contacts.

    Raises
    ------
    ValueError
        If triplets, contacts or noise do not fit.
    """
    chosen_names = [selection(triplet, exactly=3) for triplet in triplets]
    if not chosen_names:
        raise ValueError("at least one triplet is needed; got none")
    sensor = SensorNoise.of(noise, tuple(dict.fromkeys(n for t in chosen_names for n in t)))
    chosen = chosen_contacts(contact_map, at)
    errors = np.stack([_errors(contact_map, chosen, names, sensor) for names in chosen_names])
    labels = np.array([" ".join(names) for names in chosen_names])
    known = np.isfinite(errors).any(axis=0)
    winner = np.where(known, np.argmin(np.where(np.isfinite(errors), errors, np.inf), axis=0), -1)
    data = contacts_dataset(contact_map, chosen)
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


def _errors(
    contact_map: ContactMap,
    chosen: ChosenContacts,
    names: tuple[str, ...],
    sensor: SensorNoise,
) -> Array:
    """Predicted RMS 3D errors (n,), m; NaN where the triplet does not determine the contact."""
    d = contact_map.chart.discretization
    force, point = chosen.values[:, :3] * d.force, chosen.values[:, 3:] * d.length
    by_signal = contact_signal_derivatives(d, chosen.values, chosen.tangents, names)
    sigma = sensor.covariance(names, force, np.cross(point, force))
    return rms_error(by_signal @ sigma @ np.swapaxes(by_signal, -1, -2))
