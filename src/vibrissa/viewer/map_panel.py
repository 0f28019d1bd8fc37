"""Mode Map: all contacts, and all that they can feel like, side by side."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from vibrissa.quantities import to_display
from vibrissa.viewer.drawing import Array
from vibrissa.viewer.map_drawing import frame_drawing, picked_drawing, solids_drawing
from vibrissa.viewer.page import Page, asked
from vibrissa.viewer.readout import note, number
from vibrissa.viewer.solids import COORDINATES, SLICES, Solids, picked, solids

_WHOLE = "none"
_SPACES = (None, 0, 1, 2)
_HINT = "Click on a solid: the same contact is marked in all four spaces."


class MapMode:
    """The controls of solids and slices, and what was picked."""

    name = "Map"

    def __init__(self, page: Page) -> None:
        self._page = page
        self._solids: Solids | None = None
        self._triangles: Array = np.empty((0, 3, 0))
        self.row: Array | None = None
        self._drawn: tuple[Any, ...] | None = None
        gui = page.server.gui
        self._folder = gui.add_folder("Contacts and signals", visible=False)
        with self._folder:
            self._by = gui.add_dropdown("Colours", COORDINATES, hint="Of the contacts")
            self._cut = gui.add_checkbox("Cut open", True)
            self._slice = gui.add_dropdown(
                "Slice", (_WHOLE, *SLICES), hint="Only contacts with one value of this"
            )
            self._share = gui.add_slider("At", 0.0, 1.0, 0.01, 0.5, visible=False)
            self._value = gui.add_html("")
            self._legends = gui.add_html("")
            self._words = gui.add_html(note(_HINT))
        scene: Any = page.server.scene  # coroutines may be given, and run one after the other
        scene.on_click()(self._clicked)
        for control in (self._by, self._cut, self._slice, self._share):
            asked(control, lambda _: page.work.put("map", self.redraw))

    def enter(self) -> None:
        """Show controls, and look at all four spaces."""
        self._folder.visible = True
        self._drawn = None
        length = float(to_display("length", self._page.bend.whisker.length))
        middle = np.array([1.0, 0.0, 0.0]) * length
        self._page.look_at(middle, 2.2 * length, (0.0, -0.95, 0.33))

    def leave(self) -> None:
        """Hide controls and things."""
        self._folder.visible = False
        self._solids = None
        for layer in ("frame", "solids", "picked"):
            self._page.stage.show(layer, {})

    def redraw(self) -> None:
        """Draw what is not yet drawn."""
        page, chart = self._page, self._page.chart
        if chart is None:
            self._words.content = note("Charting all contacts of this whisker …")
            return
        cut = bool(self._cut.value)
        if self._solids is None or (self._solids.chart, self._solids.cut) != (chart, cut):
            if self._solids is None or self._solids.chart is not chart:
                self.row = None
            self._solids = solids(chart, cut)
        page.stage.show("frame", frame_drawing(self._solids, page.exaggeration))
        self._paint(self._solids)
        self._mark()

    def write(self, brief: bool = False) -> None:
        """Nothing: all is written as it is drawn."""

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
            self._value.content = note(f"Contacts with {what} = {value}")
        painted, legends = solids_drawing(found, self._triangles, by)
        if not len(self._triangles):
            painted = {}
        self._page.stage.show("solids", painted)
        self._legends.content = "".join(legends[name].html() for name in COORDINATES)

    async def _clicked(self, event: viser.SceneClickEvent) -> None:
        """Pick where a solid is clicked."""
        origin = np.asarray(event.ray_origin, dtype=np.float64)
        direction = np.asarray(event.ray_direction, dtype=np.float64)
        self._page.work.put("pick", lambda: self.pick(origin, direction))

    def pick(self, origin: Array, direction: Array) -> None:
        """Mark the contact that a ray, mm, meets first in any space."""
        found = self._solids
        if found is None:
            return
        places = np.concatenate([found.seen(self._triangles, space) for space in _SPACES])
        rows = np.tile(self._triangles, (len(_SPACES), 1, 1))
        row = picked(rows, places, origin, direction)
        if row is not None:
            self.row = row
            self._mark()

    def _mark(self) -> None:
        if self._solids is None:
            return
        if self.row is None:
            self._page.stage.show("picked", {})
            self._words.content = note(_HINT)
            return
        drawing, words = picked_drawing(self._solids, self.row, self._page.exaggeration)
        self._page.stage.show("picked", drawing)
        self._words.content = words
