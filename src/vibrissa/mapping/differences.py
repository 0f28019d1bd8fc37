"""The paper's sensitivity: central differences on an interpolated table of contacts.

The reachable contacts of the paper's grid are places in the space of the three signals, each over
its range, with (r, θ, φ) as values there. Between them a table interpolates; the derivative with
respect to a signal is the difference between one step (0.05 % of the range) more and one less. It
costs accuracy where the table is coarse, and there is none where a step leaves the table: that is
what the exact derivatives are compared with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import xarray as xr
from scipy.interpolate import LinearNDInterpolator

from vibrissa.rod.arrays import Array
from vibrissa.signals import CIRCULAR, SIGNALS
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap

#: Step of a difference, as a share of the signal's range.
STEP = 5e-4
# Places within this share of a turn from ±π are repeated a turn away, so that the table closes.
_OVERLAP = 0.08

#: Takes places (n, 3) and values (n, 3); gives what takes places (m, 3) and gives values (m, 3).
Interpolation: TypeAlias = Callable[[Array, Array], Callable[[Array], Array]]


def central_differences(
    contact_map: ContactMap,
    names: tuple[str, ...],
    contacts: xr.Dataset,
    interpolation: Interpolation | None = None,
    step: float = STEP,
) -> Array:
    """Derivatives of (r, θ, φ) by central differences on the interpolated grid.

    Parameters
    ----------
    contact_map : ContactMap
        With the paper's grid.
    names : tuple of str
        The three signals.
    contacts : Dataset
        Signals where derivatives are wanted, any shape.
    interpolation : callable, optional
        What interpolates; by default linear.
    step : float
        As a share of each signal's range.

    Returns
    -------
    (n, 3, 3) array
        ∂(r, θ, φ)/∂(signals), SI units; NaN where a step leaves the table.

    Raises
    ------
    ValueError
        If the map has no grid, or the step is not positive.
    """
    if contact_map.grid is None:
        raise ValueError("the map has no grid to interpolate: simulate it with grid=True")
    if not 0.0 < step < 1.0:
        raise ValueError(f"the step is a share of the range, above 0 and below 1; got {step}")
    places, values = _table(contact_map.grid, names)
    low, span = places.min(axis=0), np.ptp(places, axis=0)
    circular = np.array([CIRCULAR[SIGNALS.index(name)] for name in names])
    low, span = np.where(circular, -np.pi, low), np.where(circular, 2.0 * np.pi, span)
    # A signal that is zero everywhere (M_x of a straight whisker) has no range and no derivatives.
    if (span == 0.0).any():
        return np.full((contacts[names[0]].size, 3, 3), np.nan)
    closed, values = _closed((places - low) / span, values, circular)
    look_up = (interpolation or LinearNDInterpolator)(closed, values)
    wanted = np.stack([contacts[name].to_numpy().ravel() for name in names], axis=1)
    wanted = (wanted - low) / span
    out = np.full((len(wanted), 3, 3), np.nan)
    rows = np.flatnonzero(np.isfinite(wanted).all(axis=1))
    for k in range(3):
        aside = step * np.eye(3)[k]
        more, less = look_up(wanted[rows] + aside), look_up(wanted[rows] - aside)
        out[rows, :, k] = (np.asarray(more) - np.asarray(less)) / (2.0 * step * span[k])
    return out


def _table(grid: xr.Dataset, names: tuple[str, ...]) -> tuple[Array, Array]:
    """Signals (n, 3) and (r, θ, φ) (n, 3) of the grid's reachable contacts."""
    reached = grid["status"].to_numpy() == int(Status.OK)
    places = np.stack([grid[name].to_numpy()[reached] for name in names], axis=1)
    axes = np.meshgrid(*(grid[name].to_numpy() for name in ("r", "theta", "phi")), indexing="ij")
    return places, np.stack([a[reached] for a in axes], axis=1)


def _closed(places: Array, values: Array, circular: Array) -> tuple[Array, Array]:
    """Add copies a turn away, so that directions near ±π have neighbours on both sides."""
    for k in np.flatnonzero(circular):
        turn = np.eye(3)[k]
        start, end = places[:, k] < _OVERLAP, places[:, k] > 1.0 - _OVERLAP
        places = np.concatenate([places, places[start] + turn, places[end] - turn])
        values = np.concatenate([values, values[start], values[end]])
    return places, values
