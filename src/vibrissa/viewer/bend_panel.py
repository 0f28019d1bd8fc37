"""Mode Bend: drag the contact, turn the peg, push with a force."""

from __future__ import annotations

import numpy as np

from vibrissa.quantities import quantity
from vibrissa.viewer.bend_drawing import bend_drawing
from vibrissa.viewer.bending import (
    KINDS,
    Kind,
    force_scale,
    loaded,
    moved,
    with_force,
    with_radius,
)
from vibrissa.viewer.charting import Chart, envelope
from vibrissa.viewer.page import Page, asked, put, show
from vibrissa.viewer.readout import numbers, sentence

_MM = quantity("length").display_factor
_UN = quantity("force").display_factor
_HELD = "The whisker holds this force."


class BendMode:
    """The controls of a load, and the whisker that it bends."""

    name = "Bend"

    def __init__(self, page: Page) -> None:
        self._page = page
        self._clouded: Chart | None = None
        self._told: Kind | None = None
        gui = page.server.gui
        bend = page.bend
        length = page.original.length
        x, y, z = (_MM * bend.point).tolist()
        self._folder = gui.add_folder("Load", visible=False)
        with self._folder:
            self._kind = gui.add_dropdown(
                "Load", KINDS, hint="What bends the whisker: a point, a straight peg, or a force"
            )
            self._target = gui.add_vector3(
                "Place (mm)", (x, y, z), step=0.05, hint="Drag the ball, or type"
            )
            self._radius = gui.add_slider(
                "Radius (mm)", 0.0, _MM * 0.08 * length, 0.01, bend.radius, visible=False
            )
            self._place = gui.add_slider(
                "At s / L", 0.05, 1.0, 0.005, bend.place, visible=False, hint="Along the whisker"
            )
            self._size = gui.add_slider(
                "Force (µN)",
                0.0,
                round(3.0 * _UN * force_scale(page.original), 1),
                0.1,
                round(_UN * bend.magnitude, 1),
                visible=False,
            )
            self._way = gui.add_slider(
                "Direction (°)",
                -180.0,
                180.0,
                1.0,
                0.0,
                visible=False,
                hint="Round the whisker: 0° along what is y at its base, 90° along z",
            )
            self._state = gui.add_html("")
            self._numbers = gui.add_html("")
        asked(self._kind, self._chosen)
        asked(self._target, self._typed)
        asked(self._radius, self._widened)
        for slider in (self._place, self._size, self._way):
            asked(slider, lambda _: self._pushed())

    def enter(self) -> None:
        """Show controls."""
        self._folder.visible = True
        self._page.face_whisker()

    def leave(self) -> None:
        """Hide controls and things."""
        self._folder.visible = False
        self._clouded = None
        self._page.stage.show("bend", {})
        self._page.stage.show("reachable", {})

    def redraw(self) -> None:
        """Draw the whisker, and what it can reach."""
        page, bend = self._page, self._page.bend
        page.stage.show("bend", bend_drawing(bend, page.exaggeration))
        if page.chart is not self._clouded:
            self._clouded = page.chart
            cloud = {} if page.chart is None else {"envelope": envelope(page.chart)}
            page.stage.show("reachable", cloud)

    def write(self, brief: bool = False) -> None:
        """Write signals and contact, and where the load is."""
        bend = self._page.bend
        show(self._state, sentence(bend.status, _HELD if bend.kind == "force" else None))
        show(self._numbers, numbers(bend.deflection))
        if brief:
            return
        self._target.visible = bend.kind != "force"
        self._radius.visible = bend.kind == "peg"
        self._place.visible = self._size.visible = self._way.visible = bend.kind == "force"
        if bend.kind != "force":
            x, y, z = np.round(_MM * bend.target, 3).tolist()
            put(self._target, (x, y, z))
        if bend.kind != self._told:  # not while someone moves the sliders
            self._told = bend.kind
            put(self._kind, bend.kind)
            put(self._radius, round(_MM * bend.radius, 2))
            put(self._place, round(bend.place, 3))
            put(self._size, round(_UN * bend.magnitude, 1))
            put(self._way, round(np.rad2deg(bend.direction)))

    def _chosen(self, kind: Kind) -> None:
        self._page.change("kind", lambda bend: loaded(bend, kind))

    def _typed(self, place: tuple[float, float, float]) -> None:
        self._page.change("drag", lambda bend: moved(bend, np.array(place) / _MM))

    def _widened(self, radius: float) -> None:
        self._page.change("radius", lambda bend: with_radius(bend, radius / _MM))

    def _pushed(self) -> None:
        place, size, way = self._place.value, self._size.value / _UN, np.deg2rad(self._way.value)
        self._page.change("force", lambda bend: with_force(bend, place, size, way))
