"""How surely signals tell a contact: covariances, and how far they can be relied on."""

from __future__ import annotations

import numpy as np

from vibrissa.mapping.channels import CHANNELS, Channels, channels_of
from vibrissa.mapping.minima import reliable, unknowns_covariance
from vibrissa.mapping.noise import SensorNoise
from vibrissa.mapping.whitening import whitening
from vibrissa.rod.arrays import AnyArray, Array
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.discretize import Discretization
from vibrissa.rod.reach import LEAST_ARC, with_normal_force
from vibrissa.signals import SIGNALS
from vibrissa.signals.base import signal_derivatives


def point_covariances(
    discretization: Discretization,
    names: tuple[str, ...],
    contacts: Array,
    sensor: SensorNoise,
    checked: AnyArray | None = None,
) -> tuple[Array, AnyArray]:
    """Covariances of contact points that were found from signals.

    Parameters
    ----------
    discretization : Discretization
        The whisker.
    names : tuple of str
        The signals.
    contacts : (n, 3) array
        ξ.
    sensor : SensorNoise
        Noise of the signals.
    checked : (n,) bool array, optional
        For which contacts it is checked whether the covariance can be relied on; none by default.

    Returns
    -------
    covariances : (n, 3, 3) array
        Non-dimensional; NaN where the signals do not determine the contact.
    linear : (n,) bool array
        Whether they describe how contacts scatter; False where it was not checked.
    """
    d, x = discretization, with_normal_force(contacts)
    values, tangents = solve_forces(d, x, tangents=True)
    by_x = tangents[:, 3:]
    tangents = np.insert(tangents, 1, 0.0, axis=2)  # f_x stays zero
    channels = Channels(names, names) if len(names) == 3 else Channels.of(names)
    signals = channels_of(values)[:, [CHANNELS.index(name) for name in names]]
    sigma = channels.covariance(sensor, signals, values, d)
    weights = whitening(sigma)
    if len(names) == 3:
        spread = _exact_spread(names, values, tangents, sigma)
    else:
        spread = unknowns_covariance(channels.names, values, tangents, weights, friction=False)
    free = spread[:, [0, 2, 3]][:, :, [0, 2, 3]]
    covariances = by_x @ free @ np.swapaxes(by_x, -1, -2)
    linear = np.zeros(len(contacts), np.bool_)
    if checked is not None:
        rows = np.flatnonzero(checked)
        linear[rows] = reliable(
            d,
            channels.names,
            weights[rows],
            x[rows],
            values[rows],
            tangents[rows],
            spread[rows],
            LEAST_ARC,
        )
    return covariances, linear


def _exact_spread(names: tuple[str, ...], values: Array, tangents: Array, sigma: Array) -> Array:
    """Covariances of x, (n, 4, 4), from those of three signals that are met exactly."""
    which = [SIGNALS.index(name) for name in names]
    by_x = signal_derivatives(values, tangents[..., [0, 2, 3]])[:, which]
    out = np.zeros((len(values), 4, 4))
    with np.errstate(all="ignore"):
        good = (np.abs(np.linalg.det(by_x)) > 0.0) & np.isfinite(by_x).all(axis=(1, 2))
        inverse = np.full_like(by_x, np.nan)
        inverse[good] = np.linalg.inv(by_x[good])
        spread = inverse @ sigma @ np.swapaxes(inverse, -1, -2)
    out[np.ix_(range(len(out)), [0, 2, 3], [0, 2, 3])] = spread
    return out
