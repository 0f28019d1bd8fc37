"""All contacts of a whisker as solids: where they are, what they feel like (the paper's Fig. 3).

Signals are laid out in a cylinder: M_B is the distance from its axis, M_D the angle about it, F_x
the height; M_B and F_x by their square roots, as most contacts are gentle. Four places stand side
by side: the space of contacts, and three times that of signals, coloured by r, θ and φ. What is
picked in one is shown in all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibrissa.plots.chart import column, fine_chart, values_of
from vibrissa.plots.solids import clipped, level, solid
from vibrissa.plots.style import root
from vibrissa.quantities import to_display
from vibrissa.signals import SIGNALS
from vibrissa.viewer.charting import Chart
from vibrissa.viewer.drawing import Array

COORDINATES = ("r", "theta", "phi")
SLICES = ("x", "y", "z", "r", "theta", "phi", "Fx", "Mx", "arc_length")
"""What can be held fixed in a slice."""

_SHAPE = (24, 48, 12)
_OPEN = (np.pi, 2.5 * np.pi)
"""Bearings of the force that are kept where solids are cut open."""

_HEIGHT = 0.85
_PLACES = ((1.75, 0.62), (0.4, -0.78), (1.75, -0.78))
_CONTACTS = (0.0, 0.62)
"""Where spaces stand in the plane that faces the viewer: two above, two below, in L."""

TURN = float(np.deg2rad(62.0))
"""By how much signals are turned about their axis, so that one looks into what is cut open."""


@dataclass(frozen=True, eq=False)
class Solids:
    """The contacts of a whisker, ready to be laid out."""

    chart: Chart
    nodes: Array
    cut: bool

    @property
    def length(self) -> float:
        """Of the whisker, mm."""
        return float(to_display("length", self.chart.whisker.length))

    def skin(self) -> Array:
        """Triangles (n, 3, columns) around all contacts outside 2° of rest."""
        return solid(self.nodes, not self.cut, column("deflection"))

    def slice(self, name: str, share: float) -> Array:
        """Triangles (n, 3, columns) of contacts with one value, at a share of its range."""
        height = self.value(name, share)
        return clipped(level(self.nodes, column(name), height), column("deflection"))

    def value(self, name: str, share: float) -> float:
        """The value at a share of a range, SI units; of signals by square roots, as in space."""
        low, high = self.range(name)
        if name not in SIGNALS:
            return low + share * (high - low)
        start, end = root(np.array([low, high]))
        middle = start + share * (end - start)
        return float(np.sign(middle) * middle**2)

    def range(self, name: str) -> tuple[float, float]:
        """Least and largest value of what a slice can hold fixed, SI units."""
        values = self.nodes[..., column(name)]
        return float(values.min()), float(values.max())

    def felt(self, rows: Array) -> Array:
        """Places (..., 3), mm, of rows in the space of signals, its axis at the origin."""
        reach, low, high = self._limits
        size = np.sqrt(values_of("MB", rows)) / reach
        turn = values_of("MD", rows) + TURN
        height = (root(values_of("Fx", rows)) - low) / (high - low)
        flat = [0.5 * size * np.cos(turn), 0.5 * size * np.sin(turn)]
        return self.length * np.stack([*flat, _HEIGHT * (height - 0.5)], axis=-1)

    @property
    def _limits(self) -> tuple[float, float, float]:
        """Largest √M_B, least and largest root of F_x."""
        heights = root(values_of("Fx", self.nodes))
        reach = float(np.sqrt(values_of("MB", self.nodes).max()))
        return reach, float(heights.min()), float(heights.max())

    def axis_height(self) -> float:
        """Where F_x = 0 is on the axis of the signals, mm."""
        _, low, high = self._limits
        return self.length * _HEIGHT * (-low / (high - low) - 0.5)

    def place(self, number: int | None) -> Array:
        """Where a space stands, mm: contacts (None), or signals coloured by r, θ, φ (0, 1, 2)."""
        x, z = _CONTACTS if number is None else _PLACES[number]
        return self.length * np.array([x, 0.0, z])

    def seen(self, rows: Array, number: int | None) -> Array:
        """Places (..., 3), mm, of rows: as contacts (None) or as signals of a coordinate."""
        if number is None:
            return to_display("contact_point", rows[..., :3]) + self.place(None)
        return self.felt(rows) + self.place(number)


def solids(chart: Chart, cut: bool) -> Solids:
    """Sample a chart for solids, whole or cut open."""
    nodes = fine_chart(chart.samples, chart.line, _OPEN if cut else None, _SHAPE)
    return Solids(chart, nodes, cut)


def picked(triangles: Array, places: Array, origin: Array, direction: Array) -> Array | None:
    """The contact that a ray meets first."""
    a, b, c = places.transpose(1, 0, 2)
    first, second = b - a, c - a
    across = np.cross(direction, second)
    volume = np.einsum("ij,ij->i", first, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (origin - a) / volume[:, None]
        u = np.einsum("ij,ij->i", away, across)
        turned = np.cross(away, first)
        v = turned @ direction
        distance = np.einsum("ij,ij->i", turned, second)
        met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
    if not met.any():
        return None
    hit = int(np.flatnonzero(met)[np.argmin(distance[met])])
    weights = np.array([1.0 - u[hit] - v[hit], u[hit], v[hit]])
    return np.asarray(weights @ triangles[hit])
