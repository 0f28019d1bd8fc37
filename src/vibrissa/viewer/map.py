"""Mode Map: all contacts and all their signals as solids side by side (the paper's Fig. 3).

Signals are positions in a cylinder: M_B is the distance from its axis, M_D the angle around it, and
F_x the height. M_B and F_x are on square-root scales, as most contacts are light. Four spaces are
side by side: that of contacts, and three times that of signals, coloured by r, θ and φ. A contact
selected in one of them is marked in all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vibrissa import scene
from vibrissa.numerics import Array
from vibrissa.quantities import to_display
from vibrissa.rod import PointContact, deflect
from vibrissa.signals import SIGNALS
from vibrissa.status import Status
from vibrissa.viewer import readout
from vibrissa.viewer.bend import NODES, follicle, whisker_body
from vibrissa.viewer.page import Mode, Page, asked
from vibrissa.viewer.readout import number
from vibrissa.viewer.state import Chart

# Quantities that can be held fixed in a slice.
SLICES = ("x", "y", "z", "r", "theta", "phi", "Fx", "Mx", "arc_length")
_SHAPE = (24, 48, 12)
_OPEN = (np.pi, 2.5 * np.pi)  # bearings of the force that are kept where solids are cut open
_HEIGHT = 0.85
# Positions of the spaces in the plane that faces the viewer, two above and two below, over L.
_PLACES = ((1.75, 0.62), (0.4, -0.78), (1.75, -0.78))
_CONTACTS = (0.0, 0.62)
# Angle by which signals are turned about their axis, so that cut solids are seen from the cut.
TURN = float(np.deg2rad(62.0))


@dataclass(frozen=True, eq=False)
class Solids:
    """Sampled contacts of a whisker, with their layout in the scene."""

    chart: Chart
    nodes: Array
    cut: bool

    @property
    def length(self) -> float:
        """Length of the whisker, mm."""
        return float(to_display("length", self.chart.whisker.length))

    def skin(self) -> Array:
        """Triangles (n, 3, columns) around all contacts outside 2° of rest."""
        return scene.solid_surface(self.nodes, not self.cut, scene.column("deflection"))

    def slice(self, name: str, share: float) -> Array:
        """Triangles (n, 3, columns) of contacts with one value, at a share of its range."""
        height = self.value(name, share)
        return scene.clip(
            scene.level_surface(self.nodes, scene.column(name), height), scene.column("deflection")
        )

    def value(self, name: str, share: float) -> float:
        """Value of a quantity at a share of its range, SI units; signals on a square-root scale."""
        low, high = self.range(name)
        if name not in SIGNALS:
            return low + share * (high - low)
        start, end = scene.root(np.array([low, high]))
        middle = start + share * (end - start)
        return float(np.sign(middle) * middle**2)

    def range(self, name: str) -> tuple[float, float]:
        """Smallest and largest value of a quantity that defines slices, SI units."""
        values = self.nodes[..., scene.column(name)]
        return float(values.min()), float(values.max())

    def signal_rows(self, rows: Array) -> Array:
        """Positions (..., 3) of rows in the space of signals, with the axis at the origin, mm."""
        reach, low, high = self.limits
        size = np.sqrt(scene.values_of("MB", rows)) / reach
        turn = scene.values_of("MD", rows) + TURN
        height = (scene.root(scene.values_of("Fx", rows)) - low) / (high - low)
        flat = [0.5 * size * np.cos(turn), 0.5 * size * np.sin(turn)]
        return self.length * np.stack([*flat, _HEIGHT * (height - 0.5)], axis=-1)

    @property
    def limits(self) -> tuple[float, float, float]:
        """Largest √M_B, and smallest and largest signed root of F_x."""
        heights = scene.root(scene.values_of("Fx", self.nodes))
        reach = float(np.sqrt(scene.values_of("MB", self.nodes).max()))
        return reach, float(heights.min()), float(heights.max())

    def axis_height(self) -> float:
        """Height of F_x = 0 on the axis of the signals, mm."""
        _, low, high = self.limits
        return self.length * _HEIGHT * (-low / (high - low) - 0.5)

    def place(self, number: int | None) -> Array:
        """Position of a space, mm: contacts (None), or signals coloured by r, θ, φ (0, 1, 2)."""
        x, z = _CONTACTS if number is None else _PLACES[number]
        return self.length * np.array([x, 0.0, z])

    def seen(self, rows: Array, number: int | None) -> Array:
        """Positions (..., 3) of rows in a space: contacts (None) or signals of a coordinate, mm."""
        if number is None:
            return to_display("contact_point", rows[..., :3]) + self.place(None)
        return self.signal_rows(rows) + self.place(number)


def solids(chart: Chart, cut: bool) -> Solids:
    """Sample the solids of a map, whole or cut open."""
    nodes = scene.sample_contacts(chart.samples, chart.line, _OPEN if cut else None, _SHAPE)
    return Solids(chart, nodes, cut)


def picked(triangles: Array, places: Array, origin: Array, direction: Array) -> Array | None:
    """Contact that a ray meets first; None if there is none."""
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


_NAMES = {"r": "r", "theta": "θ", "phi": "φ"}
_RINGS = 2


def frame_drawing(solids: Solids, exaggeration: float) -> scene.Drawing:
    """Draw the static parts: the resting whisker, and rings, rays and axes of the signals."""
    whisker, length = solids.chart.whisker, solids.length
    here = solids.place(None)
    line = whisker.centerline(NODES)
    out: dict[str, scene.Mark] = {
        "rest": _moved(whisker_body(whisker, line, exaggeration, readout.REST), here),
        "follicle": _moved(follicle(whisker, exaggeration), here),
        "title": scene.Label(here + length * np.array([0.05, 0.0, 0.62]), "contacts"),
    }
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    floor = -0.5 * _HEIGHT * length
    reach, low, _ = solids.limits
    largest, least = number("MB", reach**2, 3), number("Fx", float(scene.squared(low)), 3)
    for i, name in enumerate(scene.COORDINATES):
        centre = solids.place(i)
        bottom = centre + np.array([0.0, 0.0, floor])
        rings = []
        for k in range(1, _RINGS + 1):
            radius = 0.5 * length * np.sqrt(k / _RINGS)
            flat = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0.0 * turn], axis=1)
            rings.append(scene.pieces(flat + bottom))
        for angle in TURN + np.arange(4) * np.pi / 2.0:
            ray = 0.5 * length * np.array([[0.0, 0.0, 0.0], [np.cos(angle), np.sin(angle), 0.0]])
            rings.append(scene.pieces(ray + bottom))
        out[f"floor {name}"] = scene.Line(np.concatenate(rings), (205, 209, 214), 1.0)
        pole = np.array([[0.0, 0.0, floor], [0.0, 0.0, -floor]]) + centre
        out[f"axis {name}"] = scene.Line(scene.pieces(pole), (120, 126, 134), 1.0)
        out[f"title {name}"] = scene.Label(
            centre + length * np.array([-0.45, 0.0, 0.62]), f"signals, coloured by {_NAMES[name]}"
        )
    # The axes of all three are the same. No label hides another on a small screen.
    centre = solids.place(0)
    edge = 0.5 * length * np.array([np.cos(TURN), np.sin(TURN), 0.0])
    apart = np.array([0.0, 0.0, 0.06 * length])
    bottom = centre + np.array([0.0, 0.0, floor])
    for text, at in {
        "Fx": centre - np.array([0.0, 0.0, floor]) + apart,  # above 0, which may be at the top
        "0": centre + np.array([0.0, 0.0, solids.axis_height()]),
        least: bottom - np.array([0.85 * length, 0.0, 0.0]),
        "MD = 0°": bottom + edge + apart,
        f"MB = {largest}": bottom + np.array([0.55 * length, 0.0, 0.0]),
    }.items():
        out[f"axes {text}"] = scene.Label(at, text)
    return out


def overview(length: float) -> tuple[Array, float, tuple[float, float, float], float]:
    """Centre, distance, direction and height of the view of all four spaces; see `Page.look_at`."""
    return np.array([1.0, 0.0, 0.0]) * length, 2.2 * length, (0.0, -0.95, 0.33), 1.6


def _moved(body: scene.Body, by: Array) -> scene.Body:
    return replace(body, vertices=body.vertices + by)


def solids_drawing(
    solids: Solids, triangles: Array, by: str
) -> tuple[dict[str, scene.Painted], dict[str, readout.Legend]]:
    """Draw contacts, coloured by a coordinate, in space and in the space of signals."""
    painted: dict[str, scene.Painted] = {}
    legends: dict[str, readout.Legend] = {}
    for i, name in enumerate(scene.COORDINATES):
        colours, legends[name] = readout.shaded(name, scene.values_of(name, triangles))
        painted[name] = scene.Painted(solids.seen(triangles, i), colours)
        if name == by:
            painted["contacts"] = scene.Painted(solids.seen(triangles, None), colours)
    return painted, legends


def picked_drawing(solids: Solids, row: Array, exaggeration: float) -> tuple[scene.Drawing, str]:
    """Mark a contact in all spaces, and draw the bent whisker; also return its signals as HTML."""
    whisker = solids.chart.whisker
    radius = 0.016 * solids.length
    out: dict[str, scene.Mark] = {}
    for space in (None, 0, 1, 2):
        vertices, faces = scene.ellipsoid(solids.seen(row, space), radius * np.eye(3))
        out[f"mark {space}"] = scene.Body(vertices, faces, readout.CONTACT)
    # On the surface a whisker is about to slip off; a little inside it holds.
    inside = np.asarray(whisker.position(scene.values_of("arc_length", row))) - row[:3]
    for share in (0.0, 0.01, 0.05):
        bent = deflect(whisker, PointContact(row[:3] + share * inside))
        if Status(int(bent.status)).ok:
            line = np.asarray(bent.centerline(NODES))
            body = whisker_body(whisker, line, exaggeration, readout.WHISKER)
            out["bent"] = _moved(body, solids.place(None))
            if share == 0.0:
                return out, readout.of_deflection(bent)
            break
    measured = {name: float(scene.values_of(name, row)) for name in SIGNALS}
    where = {name: float(scene.values_of(name, row)) for name in ("arc_length", *scene.COORDINATES)}
    edge = readout.note("On the edge of what the whisker can reach: it is about to slip off.")
    return out, edge + readout.table(measured, "At the base") + readout.table(where, "Contact")


_WHOLE = "none"
_SPACES = (None, 0, 1, 2)
_HINT = "Click on a solid: the same contact is marked in all four spaces."


class MapMode(Mode):
    """Mode with the controls of solids and slices, and the selected contact."""

    name = "Map"
    layers = ("frame", "solids", "picked")

    def __init__(self, page: Page) -> None:
        gui = page.server.gui
        super().__init__(page, gui.add_folder("Contacts and signals", visible=False))
        self._solids: Solids | None = None
        self._triangles: Array = np.empty((0, 3, 0))
        self.row: Array | None = None
        self._drawn: tuple[Any, ...] | None = None
        with self._folder:
            self._by = gui.add_dropdown("Colours", scene.COORDINATES, hint="Of the contacts")
            self._cut = gui.add_checkbox("Cut open", True)
            self._slice = gui.add_dropdown(
                "Slice", (_WHOLE, *SLICES), hint="Only contacts with one value of this"
            )
            self._share = gui.add_slider("At", 0.0, 1.0, 0.01, 0.5, visible=False)
            self._value = gui.add_html("")
            self._legends = gui.add_html("")
            self._words = gui.add_html(readout.note(_HINT))
        for control in (self._by, self._cut, self._slice, self._share):
            asked(control, lambda _: page.work.put("map", self.redraw))

    def enter(self) -> None:
        """Show the controls, and point the cameras at all four spaces."""
        super().enter()
        self._drawn = None
        self._page.look_at(*overview(float(to_display("length", self._page.bend.whisker.length))))

    def leave(self) -> None:
        """Hide the controls and the objects."""
        super().leave()
        self._solids = None

    def redraw(self) -> None:
        """Draw the solids if they have not been drawn."""
        page, chart = self._page, self._page.chart
        if chart is None:
            self._words.content = readout.note("Sampling all contacts of this whisker …")
            return
        cut = bool(self._cut.value)
        if self._solids is None or (self._solids.chart, self._solids.cut) != (chart, cut):
            if self._solids is None or self._solids.chart is not chart:
                self.row = None
            self._solids = solids(chart, cut)
        page.stage.show("frame", frame_drawing(self._solids, page.exaggeration))
        self._paint(self._solids)
        self._mark()

    def _paint(self, found: Solids) -> None:
        what, share, by = str(self._slice.value), float(self._share.value), str(self._by.value)
        key = (found, what, share, by)
        if key == self._drawn:
            return
        self._drawn = key
        self._share.visible = what != _WHOLE
        if what == _WHOLE:
            self._triangles = found.skin()
            self._value.content = ""
        else:
            self._triangles = found.slice(what, share)
            value = number(what, found.value(what, share))
            self._value.content = readout.note(f"Contacts with {what} = {value}")
        painted, legends = solids_drawing(found, self._triangles, by)
        if not len(self._triangles):
            painted = {}
        self._page.stage.show("solids", painted)
        self._legends.content = "".join(legends[name].html() for name in scene.COORDINATES)

    def pick(self, origin: Array, direction: Array) -> None:
        """Mark the contact that a ray, mm, meets first in any space."""
        if (found := self._solids) is None:
            return
        places = np.concatenate([found.seen(self._triangles, space) for space in _SPACES])
        rows = np.tile(self._triangles, (len(_SPACES), 1, 1))
        if (row := picked(rows, places, origin, direction)) is not None:
            self.row = row
            self._mark()

    def _mark(self) -> None:
        if self._solids is None:
            return
        if self.row is None:
            self._page.stage.show("picked", {})
            self._words.content = readout.note(_HINT)
            return
        drawing, words = picked_drawing(self._solids, self.row, self._page.exaggeration)
        self._page.stage.show("picked", drawing)
        self._words.content = words
