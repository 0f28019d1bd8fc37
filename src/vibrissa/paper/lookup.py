"""The paper's look-up table: contacts of its grid over the space of three signals, interpolated.

Each reachable contact of the grid is a place in the space of the three signals, each signal over
its range, with (r, θ, φ) as values; between places the table interpolates by natural neighbours or
linearly. A direction is an axis of one turn; places within half a radian of ±π are repeated a turn
away, so that the table has no seam. Contacts within 2° of the resting whisker, which the paper
leaves out of its figures, are left out: near rest directions lose their meaning, and all contacts
feel the same.

Outside the convex hull of the places there is no answer. The hull of a curved cloud also holds
places that no contact comes near; there the table answers from contacts far apart, as the paper's
does. And it answers with one contact wherever two have the same signals: what lies between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.numerics import AnyArray, Array
from vibrissa.paper.differences import closed_table, grid_table
from vibrissa.paper.natural import Interpolation, NaturalNeighbour
from vibrissa.signals import circular_among, within_cone, within_turn

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap

# Next to what the whisker can feel a signal with less range than this share is nothing.
_NOTHING = 1e-9


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
    interpolation : NaturalNeighbour
        (r, θ, φ) over the ranges.
    """

    names: tuple[str, ...]
    low: Array
    span: Array
    components: bool
    interpolation: NaturalNeighbour

    @classmethod
    def of(
        cls, contact_map: ContactMap, names: tuple[str, ...], components: bool = False
    ) -> LookupTable:
        """Make the table of three signals.

        Parameters
        ----------
        contact_map : ContactMap
            A map with the paper's grid.
        names : tuple of str
            The signals, in canonical order.
        components : bool
            Whether a size and its direction, where both are among the signals, are turned into two
            Cartesian components first: not the paper's way, but a better one.

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
        places, values = grid_table(contact_map.grid, names)
        away = ~within_cone(contact_map.whisker, cartesian(values))
        places, values = places[away], values[away]
        circular = circular_among(names)
        if components:
            places, circular = _with_components(places, names)
        low = np.where(circular, -np.pi, places.min(axis=0))
        span = np.where(circular, 2.0 * np.pi, np.ptp(places, axis=0))
        _check_ranges(contact_map, names, span)
        closed, values = closed_table((places - low) / span, values, circular)
        return cls(names, low, span, components, NaturalNeighbour(closed, values, np.ones(3)))

    def __call__(self, signals: Array, method: Interpolation = "natural") -> Array:
        """Look up contact points."""
        places = within_turn(signals, circular_among(self.names))
        if self.components:
            places, _ = _with_components(places, self.names)
        return cartesian(self.interpolation((places - self.low) / self.span, method))


def cartesian(spheres: Array) -> Array:
    """Points (..., 3) of spherical coordinates (r, θ, φ) (..., 3)."""
    r, theta, phi = np.moveaxis(spheres, -1, 0)
    across = r * np.cos(phi)
    return np.stack([across * np.cos(theta), across * np.sin(theta), r * np.sin(phi)], axis=-1)


def _with_components(places: Array, names: tuple[str, ...]) -> tuple[Array, AnyArray]:
    """Signals with each size and its direction as components; which are still directions."""
    out, circular = places.copy(), circular_among(names)
    for size, direction in (("FT", "FD"), ("MB", "MD")):
        if size in names and direction in names:
            i, j = names.index(size), names.index(direction)
            out[:, i] = places[:, i] * np.cos(places[:, j])
            out[:, j] = places[:, i] * np.sin(places[:, j])
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
