"""The paper's sensitivity: central differences on its look-up table.

The derivative with respect to a signal is the difference between one step (0.05 % of the signal's
range) more and one less. It is as inaccurate as the table is coarse, and there is none where a step
leaves the table: the exact derivatives of :func:`vibrissa.sensitivity` are compared with it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from vibrissa.contacts import At, Noise, SensorNoise, ellipsoids, spherical_derivatives
from vibrissa.identifiability import sensitivity
from vibrissa.numerics import Array
from vibrissa.paper.lookup import STEP, Interpolation, LookupTable
from vibrissa.signals import SIGNALS, measured, selection

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap


def central_differences(
    contact_map: ContactMap,
    using: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    at: At = None,
    *,
    noise: Noise | None = None,
    interpolation: Interpolation = "natural",
    step: float = STEP,
) -> xr.Dataset:
    """Derivatives of the contact point by central differences on the paper's interpolated grid.

    Parameters
    ----------
    contact_map : ContactMap
        Map with the paper's grid.
    using : str or tuple of str
        Three signals.
    at : Dataset, DataTree, mapping, array_like, "grid" or None
        Contacts, as for :func:`vibrissa.sensitivity`.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units; gives the error
        ellipsoids.
    interpolation : {"natural", "linear"} or callable
        Natural-neighbour as the paper's, or linear; or a function that, called as
        ``interpolation(points, values)``, returns a function of other points.
    step : float
        Step of the differences, as a share of each signal's range; the paper's is 0.05 %.

    Returns
    -------
    Dataset
        As of :func:`vibrissa.sensitivity`; NaN where a step leaves the table, and everywhere for
        signals of which one is next to zero throughout.

    Raises
    ------
    ValueError
        If the map has no grid, or signals, contacts, noise or step do not fit.
    """
    if not 0.0 < step < 1.0:
        raise ValueError(f"the step is a share of the range, above 0 and below 1; got {step}")
    names = selection(using, exactly=3)
    out = sensitivity(contact_map, names, at, noise=noise)
    values, dims, _ = measured(out, names)
    table = LookupTable.of(contact_map, names, near_rest=True, interpolation=interpolation)
    in_sphere = _differences(table, values.reshape(-1, 3), step)
    point = out["contact_point"].transpose(*dims, "space").to_numpy().reshape(-1, 3)
    by_signal = _inverted(spherical_derivatives(point)) @ in_sphere
    shape = values.shape[:-1]
    for name, matrix in (("sensitivity", in_sphere), ("point_sensitivity", by_signal)):
        exact = out[name].transpose(*dims, ...)
        out[name] = exact.copy(data=matrix.reshape(exact.shape))
    if noise is not None:
        sigma = SensorNoise.of(noise, names).covariance(names, *_wrench(out, dims))
        covariance = by_signal @ sigma @ np.swapaxes(by_signal, -1, -2)
        out = out.assign(ellipsoids(covariance, dims, shape).data_vars)
    return out.assign_attrs(method="differences")


def _differences(table: LookupTable, signals: Array, step: float) -> Array:
    """∂(r, θ, φ)/∂(signals), (n, 3, 3), at signals (n, 3)."""
    out = np.full((len(signals), 3, 3), np.nan)
    points = table.points(signals)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    for k in range(3):
        aside = step * np.eye(3)[k]
        more, less = (
            np.asarray(table.interpolation(points[rows] + side)) for side in (aside, -aside)
        )
        out[rows, :, k] = (more - less) / (2.0 * step * table.span[k])
    return out


def _inverted(matrices: Array) -> Array:
    """Inverses of matrices (n, 3, 3), NaN for those with NaN."""
    out = np.full_like(matrices, np.nan)
    known = np.isfinite(matrices).all(axis=(1, 2))
    out[known] = np.linalg.inv(matrices[known])
    return out


def _wrench(contacts: xr.Dataset, dims: tuple[str, ...]) -> tuple[Array, Array]:
    """Force and moment (n, 3) of contacts with their six signals."""
    signals = {name: contacts[name].transpose(*dims).to_numpy().ravel() for name in SIGNALS}
    force, moment = (
        np.stack(
            [
                signals[along],
                signals[across] * np.cos(signals[direction]),
                signals[across] * np.sin(signals[direction]),
            ],
            axis=1,
        )
        for along, across, direction in (("Fx", "FT", "FD"), ("Mx", "MB", "MD"))
    )
    return force, moment
