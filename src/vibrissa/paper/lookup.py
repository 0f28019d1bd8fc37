"""The paper's look-up table: contacts of its grid over the space of three signals, interpolated.

Each reachable contact of the grid is a point in the space of the three signals, each signal over
its range, with (r, θ, φ) as values; between points the table interpolates by natural neighbours or
linearly. A direction is an axis of one turn; points within half a radian of ±π are repeated a turn
away, so that the table has no seam. For estimates, contacts within 2° of the resting whisker are
left out, as in the paper's figures: near rest directions lose their meaning, and all contacts have
nearly the same signals.

Outside the convex hull of the points there is no answer. The hull of a curved cloud also contains
signals that no contact comes near; there the table answers from contacts far apart, as the paper's
does. And it gives one contact wherever two have the same signals: a mean of both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from vibrissa.numerics import AnyArray, Array
from vibrissa.paper.natural_neighbour import NaturalNeighbour
from vibrissa.signals import circular_among, within_cone, within_turn
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

#: Natural-neighbour as the paper's, or linear, or a function of points (n, 3) and values (n, 3)
#: that returns a function of other points (m, 3).
Interpolation: TypeAlias = (
    Literal["natural", "linear"] | Callable[[Array, Array], Callable[[Array], Array]]
)

#: Step of the paper's central differences, as a share of a signal's range.
STEP = 5e-4
# A signal whose range is below this share of the whisker's unit of force or moment is zero.
_NOTHING = 1e-9
# Points within this share of a turn from ±π are repeated a turn away, so that the table closes.
_OVERLAP = 0.08


@dataclass(frozen=True, eq=False)
class LookupTable:
    """Contact points over the space of three signals; made by :meth:`of`.

    Attributes
    ----------
    names : tuple of str
        The signals.
    low, span : (3,) arrays
        Start and size of each axis's range, SI units.
    components : bool
        Whether a size and its direction stand as two Cartesian components.
    interpolation : callable
        (r, θ, φ) of points over the ranges; of a :class:`NaturalNeighbour`, with the method as a
        second argument.
    """

    names: tuple[str, ...]
    low: Array
    span: Array
    components: bool
    interpolation: Callable[..., Array]

    @classmethod
    def of(
        cls,
        contact_map: ContactMap,
        names: tuple[str, ...],
        components: bool = False,
        *,
        near_rest: bool = False,
        interpolation: Interpolation | None = None,
    ) -> LookupTable:
        """Make the table of three signals.

        Parameters
        ----------
        contact_map : ContactMap
            Map with the paper's grid.
        names : tuple of str
            The signals, in canonical order.
        components : bool
            Whether a size and its direction, where both are among the signals, are turned into two
            Cartesian components first: not the paper's method, but a better one.
        near_rest : bool
            Whether contacts within 2° of rest are kept.
        interpolation : {"natural", "linear"} or callable, optional
            Interpolation for good; by default natural or linear, as each look-up asks.

        Returns
        -------
        LookupTable
            The table.

        Raises
        ------
        ValueError
            If the map has no grid, or one of the signals is next to zero everywhere.
        """
        if contact_map.grid is None:
            raise ValueError("the map has no grid to look up in: simulate it with grid=True")
        grid = contact_map.grid
        reached = grid["status"].to_numpy() == int(Status.OK)
        signals = np.stack([grid[name].to_numpy()[reached] for name in names], axis=1)
        axes = [grid[name].to_numpy() for name in ("r", "theta", "phi")]
        values = np.stack([a[reached] for a in np.meshgrid(*axes, indexing="ij")], axis=1)
        if not near_rest:
            away = ~within_cone(contact_map.whisker, cartesian(values))
            signals, values = signals[away], values[away]
        circular = circular_among(names)
        if components:
            signals, circular = _with_components(signals, names)
        low = np.where(circular, -np.pi, signals.min(axis=0))
        span = np.where(circular, 2.0 * np.pi, np.ptp(signals, axis=0))
        _check_ranges(contact_map, names, span)
        points, values = _closed((signals - low) / span, values, circular)
        return cls(names, low, span, components, _interpolated(points, values, interpolation))

    def points(self, signals: Array) -> Array:
        """Compute the points of signals in the table.

        Parameters
        ----------
        signals : (n, 3) array
            Signals, SI units.

        Returns
        -------
        (n, 3) array
            Signals, or their components, over their ranges.
        """
        signals = within_turn(signals, circular_among(self.names))
        if self.components:
            signals, _ = _with_components(signals, self.names)
        return np.asarray((signals - self.low) / self.span)

    def __call__(self, signals: Array, *method: str) -> Array:
        """Look up contact points."""
        return cartesian(self.interpolation(self.points(signals), *method))


def cartesian(spheres: Array) -> Array:
    """Points (..., 3) of spherical coordinates (r, θ, φ) (..., 3)."""
    r, theta, phi = np.moveaxis(spheres, -1, 0)
    across = r * np.cos(phi)
    return np.stack([across * np.cos(theta), across * np.sin(theta), r * np.sin(phi)], axis=-1)


def _interpolated(
    points: Array, values: Array, interpolation: Interpolation | None
) -> Callable[..., Array]:
    if callable(interpolation):
        return interpolation(points, values)
    natural: Any = NaturalNeighbour(points, values, scale=np.ones(3))
    return natural if interpolation is None else partial(natural, method=interpolation)


def _closed(points: Array, values: Array, circular: Array) -> tuple[Array, Array]:
    """Add copies a turn away, so that directions near ±π have neighbours on both sides."""
    for k in np.flatnonzero(circular):
        turn = np.eye(3)[k]
        start, end = points[:, k] < _OVERLAP, points[:, k] > 1.0 - _OVERLAP
        points = np.concatenate([points, points[start] + turn, points[end] - turn])
        values = np.concatenate([values, values[start], values[end]])
    return points, values


def _with_components(signals: Array, names: tuple[str, ...]) -> tuple[Array, AnyArray]:
    """Signals with each size and its direction as components; which are still directions."""
    out, circular = signals.copy(), circular_among(names)
    for size, direction in (("FT", "FD"), ("MB", "MD")):
        if size in names and direction in names:
            i, j = names.index(size), names.index(direction)
            out[:, i] = signals[:, i] * np.cos(signals[:, j])
            out[:, j] = signals[:, i] * np.sin(signals[:, j])
            circular[j] = False
    return out, circular


def _check_ranges(contact_map: ContactMap, names: tuple[str, ...], span: Array) -> None:
    d = contact_map.chart.discretization
    unit = {"F": d.force, "M": d.moment}
    for name, size in zip(names, span, strict=True):
        if size < _NOTHING * unit[name[0]]:
            raise ValueError(
                f"{name} is next to zero for every contact of this whisker, so that "
                f"({', '.join(names)}) do not span a table"
            )
