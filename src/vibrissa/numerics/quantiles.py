"""Quantiles of quantities over contacts, each contact counted by the volume that it stands for."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vibrissa.numerics.arrays import AnyArray, Array


def contact_weights(data: xr.Dataset, region: xr.DataArray | None = None) -> Array:
    """Volumes that contacts of a region stand for, as one row."""
    kept = ~data["small_deflection"] if region is None else region.broadcast_like(data["status"])
    kept = kept.transpose(*data["status"].dims).astype(bool) & np.isfinite(data["r"])
    size = data["volume"] if "volume" in data else xr.ones_like(data["r"])
    return np.where(kept, size, 0.0).ravel()


def weighted_quantile(values: AnyArray, weight: Array, shares: float | AnyArray = 0.5) -> Array:
    """Quantiles of values that are finite and have weight.

    Parameters
    ----------
    values : (n,) array
        Values of any unit.
    weight : (n,) array
        Weights, not negative.
    shares : float or array
        Shares of the total weight, from 0 to 1.

    Returns
    -------
    array
        Quantiles, of the shape of ``shares``; NaN where no value has weight.
    """
    shares = np.asarray(shares, dtype=np.float64)
    kept = np.isfinite(values) & (weight > 0.0)
    if not kept.any():
        return np.full(shares.shape, np.nan)
    order = np.argsort(values[kept], kind="stable")
    sorted_values, w = values[kept][order], weight[kept][order]
    middle = (np.cumsum(w) - 0.5 * w) / w.sum()
    return np.asarray(np.interp(shares, middle, sorted_values))
