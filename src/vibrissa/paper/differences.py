"""The paper's sensitivity: central differences on an interpolated table of contacts.

The reachable contacts of the paper's grid are places in the space of the three signals, each over
its range, with (r, θ, φ) as values there. Between them a table interpolates; the derivative with
respect to a signal is the difference between one step (0.05 % of the range) more and one less. It
costs accuracy where the table is coarse, and there is none where a step leaves the table: that is
what the exact derivatives are compared with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import xarray as xr

from vibrissa.numerics import AnyArray, Array
from vibrissa.paper.natural import NaturalNeighbour
from vibrissa.quantities import attributes
from vibrissa.signals import circular_among, measured, selection, within_turn
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

#: Step of a difference, as a share of the signal's range.
STEP = 5e-4
# Places within this share of a turn from ±π are repeated a turn away, so that the table closes.
_OVERLAP = 0.08

#: Natural-neighbour as the paper's, or linear, or what takes places (n, 3) and values (n, 3) and
#: gives what takes other places (m, 3) and gives values (m, 3).
Interpolation: TypeAlias = (
    Literal["natural", "linear"] | Callable[[Array, Array], Callable[[Array], Array]]
)


def central_differences(
    contact_map: ContactMap,
    names: tuple[str, ...],
    contacts: xr.Dataset,
    interpolation: Interpolation = "natural",
    step: float = STEP,
) -> Array:
    """Derivatives of (r, θ, φ) by central differences on the interpolated grid."""
    if not 0.0 < step < 1.0:
        raise ValueError(f"the step is a share of the range, above 0 and below 1; got {step}")
    table = _Table.of(contact_map, names, interpolation)
    values, _, _ = measured(contacts, names)
    out = np.full((values[..., 0].size, 3, 3), np.nan)
    if table is None:
        return out
    wanted = table.places(values)
    rows = np.flatnonzero(np.isfinite(wanted).all(axis=1))
    for k in range(3):
        aside = step * np.eye(3)[k]
        more, less = (table.look_up(wanted[rows] + side) for side in (aside, -aside))
        out[rows, :, k] = (np.asarray(more) - np.asarray(less)) / (2.0 * step * table.span[k])
    return out


def interpolation_errors(
    contact_map: ContactMap,
    contacts: xr.Dataset,
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    interpolation: Interpolation = "natural",
) -> xr.DataArray:
    """How far off contacts are that are looked up in the interpolated grid."""
    names = selection(triplet, exactly=3)
    table = _Table.of(contact_map, names, interpolation)
    values, dims, _ = measured(contacts, names)
    error = np.full(values[..., 0].size, np.nan)
    if table is not None:
        wanted = table.places(values)
        rows = np.flatnonzero(np.isfinite(wanted).all(axis=1))
        r, theta, phi = np.asarray(table.look_up(wanted[rows])).T
        along = (np.cos(phi) * np.cos(theta), np.cos(phi) * np.sin(theta), np.sin(phi))
        true = contacts["contact_point"].transpose(*dims, "space").to_numpy().reshape(-1, 3)
        error[rows] = np.linalg.norm(r[:, None] * np.stack(along, axis=1) - true[rows], axis=1)
    return xr.DataArray(
        error.reshape(values.shape[:-1]),
        dims=dims,
        name="error_distance",
        attrs=attributes("error_distance"),
    )


@dataclass(frozen=True, eq=False)
class _Table:
    """The interpolated grid: signals over their ranges, (r, θ, φ) in between."""

    low: Array
    span: Array
    circular: AnyArray
    look_up: Callable[[Array], Array]

    @classmethod
    def of(
        cls, contact_map: ContactMap, names: tuple[str, ...], interpolation: Interpolation
    ) -> _Table | None:
        """Make it; None if a signal has no range, as M_x of a straight whisker."""
        if contact_map.grid is None:
            raise ValueError("the map has no grid to interpolate: simulate it with grid=True")
        places, values = grid_table(contact_map.grid, names)
        circular = circular_among(names)
        low = np.where(circular, -np.pi, places.min(axis=0))
        span = np.where(circular, 2.0 * np.pi, np.ptp(places, axis=0))
        if (span == 0.0).any():
            return None
        closed, values = closed_table((places - low) / span, values, circular)
        return cls(low, span, circular, _interpolated(closed, values, interpolation))

    def places(self, signals: Array) -> Array:
        """Signals (..., 3) over their ranges, in rows (n, 3)."""
        signals = within_turn(signals.reshape(-1, 3), self.circular)
        return np.asarray((signals - self.low) / self.span)


def grid_table(grid: xr.Dataset, names: tuple[str, ...]) -> tuple[Array, Array]:
    """Return the signals of the grid's reachable contacts, and where those are."""
    reached = grid["status"].to_numpy() == int(Status.OK)
    places = np.stack([grid[name].to_numpy()[reached] for name in names], axis=1)
    axes = np.meshgrid(*(grid[name].to_numpy() for name in ("r", "theta", "phi")), indexing="ij")
    return places, np.stack([a[reached] for a in axes], axis=1)


def _interpolated(
    places: Array, values: Array, interpolation: Interpolation
) -> Callable[[Array], Array]:
    if not isinstance(interpolation, str):
        return interpolation(places, values)
    if interpolation not in ("natural", "linear"):
        raise ValueError(f"interpolation is 'natural' or 'linear'; got {interpolation!r}")
    return partial(NaturalNeighbour(places, values, scale=np.ones(3)), method=interpolation)


def closed_table(places: Array, values: Array, circular: Array) -> tuple[Array, Array]:
    """Add copies a turn away, so that directions near ±π have neighbours on both sides."""
    for k in np.flatnonzero(circular):
        turn = np.eye(3)[k]
        start, end = places[:, k] < _OVERLAP, places[:, k] > 1.0 - _OVERLAP
        places = np.concatenate([places, places[start] + turn, places[end] - turn])
        values = np.concatenate([values, values[start], values[end]])
    return places, values
