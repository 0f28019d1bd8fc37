"""Mode Locate: which contacts feel the same, and how exactly they are found."""

from __future__ import annotations

from vibrissa.quantities import quantity
from vibrissa.signals import TRIPLETS
from vibrissa.viewer.bend_drawing import bend_drawing
from vibrissa.viewer.charting import Chart, coloured_cloud, places
from vibrissa.viewer.drawing import Bytes
from vibrissa.viewer.locate_drawing import locate_drawing, of_located
from vibrissa.viewer.locating import COLOURS, Located, Sensor, coloured, located, usual_sensor
from vibrissa.viewer.page import Page, asked
from vibrissa.viewer.readout import note
from vibrissa.viewer.shading import Legend

_UN = quantity("force").display_factor
_UNM = quantity("moment").display_factor


class LocateMode:
    """The controls of a sensor, and what it cannot tell apart."""

    name = "Locate"

    def __init__(self, page: Page) -> None:
        self._page = page
        self._sensor = usual_sensor(page.original)
        self._what = "uniqueness"
        self._cut = True
        self._drawn: tuple[object, ...] | None = None
        self._cloud: tuple[Chart, Bytes] | None = None
        self.found: Located | None = None
        gui = page.server.gui
        self._folder = gui.add_folder("Three signals", visible=False)
        with self._folder:
            triplet = gui.add_dropdown(
                "Signals",
                tuple(" ".join(names) for names in TRIPLETS),
                initial_value=" ".join(self._sensor.triplet),
            )
            noise, turning = _UN * self._sensor.force_noise, _UNM * self._sensor.moment_noise
            force = gui.add_slider("F noise (µN)", 0.0, 10.0 * noise, 0.1 * noise, noise)
            moment = gui.add_slider("M noise (µN·m)", 0.0, 10.0 * turning, 0.1 * turning, turning)
            colour = gui.add_dropdown("Colours", COLOURS, initial_value=self._what)
            cut = gui.add_checkbox("Cut open", self._cut, hint="Only contacts with z < 0")
            self._legend = gui.add_html("")
            self._words = gui.add_html("")
        asked(triplet, lambda value: self._sense(triplet=tuple(value.split())))
        asked(force, lambda value: self._sense(force_noise=value / _UN))
        asked(moment, lambda value: self._sense(moment_noise=value / _UNM))
        asked(colour, self._colour)
        asked(cut, self._open)

    def enter(self) -> None:
        """Show controls."""
        self._folder.visible = True
        self._page.face_whisker()
        self._drawn = None
        if self._page.bend.kind != "point":
            self._page.bend = self._page.bend_by_point()

    def leave(self) -> None:
        """Hide controls and things."""
        self._folder.visible = False
        for layer in ("bend", "candidates", "cloud"):
            self._page.stage.show(layer, {})

    def redraw(self) -> None:
        """Draw whisker, candidates and errors; colour the cloud if it is another."""
        page, bend, chart = self._page, self._page.bend, self._page.chart
        page.stage.show("bend", bend_drawing(bend, page.exaggeration))
        if chart is None:
            self.found = None
            page.stage.show("candidates", {})
            return
        self.found = located(chart, bend, self._sensor)
        drawing = (
            {}
            if self.found is None
            else locate_drawing(bend.whisker, self.found, page.exaggeration)
        )
        page.stage.show("candidates", drawing)
        self._paint(chart)

    def write(self, brief: bool = False) -> None:
        """Write what the three signals tell."""
        bend = self._page.bend
        if self._page.chart is None:
            self._words.content = note("Charting all contacts of this whisker …")
        else:
            self._words.content = of_located(bend.whisker, self.found, bend.status)

    def _paint(self, chart: Chart) -> None:
        """Colour the cloud beside everything else."""
        key = (chart, self._sensor, self._what)
        if self._drawn == key:
            return
        self._drawn = key
        sensor, what = self._sensor, self._what

        def ready(colours: Bytes, legend: Legend) -> None:
            if self._drawn == key:
                self._legend.content = legend.html()
                self._cloud = (chart, colours)
                self._show_cloud()

        def job() -> None:
            colours, legend = coloured(chart, what, sensor)
            self._page.work.put("colours", lambda: ready(colours, legend))

        self._page.slow_work.put("colours", job)

    def _show_cloud(self) -> None:
        if self._cloud is None or self._page.mode is not self:
            return
        chart, colours = self._cloud
        points = places(chart)
        keep = points[:, 2] <= 0.0 if self._cut else slice(None)
        cloud = coloured_cloud(chart, points[keep], colours[keep])
        self._page.stage.show("cloud", {"contacts": cloud})

    def _sense(self, **changes: object) -> None:
        self._sensor = Sensor(**{**vars(self._sensor), **changes})
        self._page.work.put("sensor", self._page.redraw)

    def _colour(self, what: str) -> None:
        self._what = what
        self._page.work.put("sensor", self._page.redraw)

    def _open(self, cut: bool) -> None:
        self._cut = cut
        self._page.work.put("cut", self._show_cloud)
