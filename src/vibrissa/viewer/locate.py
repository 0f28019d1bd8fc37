"""Mode Locate: contacts with the same signals, and the accuracy of their positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from vibrissa import scene
from vibrissa.contacts import Contacts
from vibrissa.identifiability import sensitivity
from vibrissa.numerics import Array
from vibrissa.quantities import quantity, to_display
from vibrissa.rod import PointContact, deflect
from vibrissa.signals import SIGNALS, TRIPLETS, base_signals
from vibrissa.status import Status
from vibrissa.viewer import readout
from vibrissa.viewer.bend import NODES, bend_drawing, mm, whisker_body
from vibrissa.viewer.page import Mode, Page, asked, put
from vibrissa.viewer.state import Bend, Chart, coloured_solid, loaded, numbers_in, words_of
from vibrissa.whisker import Whisker

_RAT = (1.5e-4, 6e-6)  # EI/L², N, and EI/L, N·m, of a rat's whisker
COLOURS = ("uniqueness", "ambiguity", "sensitivity", *SIGNALS)
# Candidates nearer to the contact than this share of the length are the contact itself.
_APART = 0.005


@dataclass(frozen=True)
class Sensor:
    """Signals used to locate the contact, and their noise."""

    triplet: tuple[str, ...] = ("Fx", "MB", "MD")
    force_noise: float = 1e-6
    moment_noise: float = 2e-8

    @property
    def covariance(self) -> Array | None:
        """Covariance of force and moment (6, 6); None without noise."""
        sigma = np.repeat([self.force_noise, self.moment_noise], 3)
        return np.diag(sigma**2) if (sigma > 0.0).all() else None


def usual_sensor(whisker: Whisker) -> Sensor:
    """Default sensor: noise of 1 µN and 0.02 µN·m for a rat's whisker, scaled for other rods."""
    moment = whisker.base_bending_stiffness / whisker.length
    powers = np.log10([moment / whisker.length / _RAT[0], moment / _RAT[1]])
    force, turning = 10.0 ** np.round(powers)
    usual = Sensor()
    return Sensor(
        force_noise=float(force * usual.force_noise),
        moment_noise=float(turning * usual.moment_noise),
    )


@dataclass(frozen=True, eq=False)
class Located:
    """Contacts compatible with three signals of a bent whisker."""

    sensor: Sensor
    signals: xr.Dataset
    contact: Array
    estimate: Contacts
    lines: Array

    @property
    def points(self) -> Array:
        """Contact points of the candidates (k, 3), m."""
        points = self.estimate.candidates.point
        return np.asarray(points[np.isfinite(points).all(axis=-1)])

    @property
    def distances(self) -> Array:
        """Distance of each candidate from the true contact (k,), m."""
        return np.asarray(np.linalg.norm(self.points - self.contact, axis=-1))

    def others(self, length: float) -> scene.Ints:
        """Indices of the candidates other than the contact itself."""
        return np.flatnonzero(self.distances > _APART * length)


def located(chart: Chart, bend: Bend, sensor: Sensor) -> Located | None:
    """Find all contacts with the same three signals; None without a contact."""
    bent = bend.deflection
    if not bend.status.ok or bend.status is Status.NO_CONTACT:
        return None
    signals = base_signals(np.asarray(bent.force), np.asarray(bent.moment))
    estimate = chart.contact_map.estimate(signals, sensor.triplet, noise=sensor.covariance)
    points = estimate.candidates.point[np.isfinite(estimate.candidates.point).all(axis=-1)]
    lines = deflect(chart.whisker, PointContact(points.reshape(-1, 3))).centerline(NODES)
    return Located(sensor, signals, np.asarray(bent.contact_point), estimate, lines)


def coloured(chart: Chart, what: str, sensor: Sensor) -> tuple[scene.Bytes, readout.Legend]:
    """Colours (n, 3) of the cloud: number of contacts with the same signals, or their distance."""
    if what in SIGNALS:
        return readout.shaded(what, chart.signals[what])
    if what == "sensitivity":
        error = np.full(len(chart.points), np.nan)
        if (noise := sensor.covariance) is not None:
            found = sensitivity(chart.contact_map, sensor.triplet, chart.points, noise=noise)
            error = found["predicted_error"].to_numpy()
        return readout.shaded("predicted_error", error)
    signals = {name: chart.signals[name] for name in sensor.triplet}
    estimate = chart.contact_map.estimate(signals, sensor.triplet)
    if what == "uniqueness":
        return readout.counted(estimate.n_candidates)
    if what == "ambiguity":
        # The distance of the farthest other candidate; NaN without candidates.
        away = np.linalg.norm(estimate.candidates.point - chart.points[:, None], axis=-1)
        farthest = np.nanmax(np.nan_to_num(away), axis=1)
        farthest[farthest < 1e-9] = 0.0  # the contact itself
        farthest[estimate.status == Status.DEGENERATE] = np.nan
        return readout.shaded("separation", farthest)
    raise ValueError(f"colours are one of {', '.join(COLOURS)}; got {what!r}")


SIGMAS = 2.0  # standard deviations of the ellipsoids
_CLEAR = 0.5  # opacity of all contacts, so that the whisker is seen among them
MOST = 0.3  # longest semi-axis drawn, over the length; longer ones mean an undetermined position


def locate_drawing(whisker: Whisker, found: Located, exaggeration: float) -> scene.Drawing:
    """Draw the whisker at all other contacts with the same signals, and the errors of all."""
    out: dict[str, scene.Mark] = {}
    covariances = found.estimate.candidates.covariance
    others = set(found.others(whisker.length).tolist())
    for i, point in enumerate(found.points):
        if i in others:
            out[f"ghost {i}"] = whisker_body(
                whisker, found.lines[i], exaggeration, readout.GHOST, 0.55
            )
            radius = float(to_display("length", 0.008 * whisker.length))
            ball = scene.ellipsoid(mm(point), radius * np.eye(3))
            out[f"ball {i}"] = scene.Body(*ball, readout.GHOST)
            apart = readout.number("separation", float(found.distances[i]), 3)
            out[f"apart {i}"] = scene.Label(mm(point), f"same signals, {apart} away")
        if np.isfinite(covariances[i]).all():
            most = MOST * whisker.length
            vertices, faces = scene.error_ellipsoid(point, covariances[i], SIGMAS, most)
            out[f"error {i}"] = scene.Body(mm(vertices), faces, readout.FIT, 0.45)
    return out


def of_located(whisker: Whisker, found: Located | None, status: Status) -> str:
    """Describe the number of contacts with the same signals, their distances and errors."""
    if found is None:
        return readout.sentence(status)
    names = found.sensor.triplet
    signals = {name: float(found.signals[name]) for name in SIGNALS}
    chosen = {name: signals[name] for name in names}
    parts = [
        readout.sentence(Status(int(found.estimate.status))),
        readout.table(chosen, "Measured"),
    ]
    others = found.others(whisker.length)
    if others.size:
        farthest = readout.number("separation", float(found.distances[others].max()), 3)
        parts.append(
            readout.note(f"The farthest contact with the same signals is {farthest} away.")
        )
    own = int(np.argmin(found.distances)) if found.points.size else -1
    if own >= 0 and np.isfinite(found.estimate.candidates.covariance[own]).all():
        spread = np.sqrt(np.diagonal(found.estimate.candidates.covariance[own]))
        errors = dict(zip(("sigma_x", "sigma_y", "sigma_z"), spread.tolist(), strict=True))
        parts.append(readout.table(errors, f"Error of the contact point ({SIGMAS:.0f}σ drawn)"))
        if SIGMAS * spread.max() > MOST * whisker.length:
            parts.append(
                readout.note("The ellipsoid is truncated: along it the position is undetermined.")
            )
    rest = {name: value for name, value in signals.items() if name not in names}
    parts.append(readout.table(rest, "Not used"))
    return "".join(parts)


_UN = quantity("force").display_factor
_UNM = quantity("moment").display_factor


class LocateMode(Mode):
    """Mode with the controls of a sensor, and the contacts that it cannot distinguish."""

    name = "Locate"
    layers = ("bend", "candidates", "cloud")

    def __init__(self, page: Page) -> None:
        gui = page.server.gui
        super().__init__(page, gui.add_folder("Three signals", visible=False))
        self._sensor = usual_sensor(page.original)
        self._what = "uniqueness"
        self._cut = True
        self._drawn: tuple[object, ...] | None = None
        self._cloud: tuple[Chart, scene.Bytes] | None = None
        self.found: Located | None = None
        with self._folder:
            self._triplet = gui.add_dropdown(
                "Signals",
                tuple(" ".join(names) for names in TRIPLETS),
                initial_value=" ".join(self._sensor.triplet),
            )
            noise, turning = _UN * self._sensor.force_noise, _UNM * self._sensor.moment_noise
            force = gui.add_slider("F noise (µN)", 0.0, 10.0 * noise, 0.1 * noise, noise)
            moment = gui.add_slider("M noise (µN·m)", 0.0, 10.0 * turning, 0.1 * turning, turning)
            self._colours = gui.add_dropdown("Colours", COLOURS, initial_value=self._what)
            cut = gui.add_checkbox("Cut open", self._cut, hint="Only contacts with z < 0")
            self._legend = gui.add_html("")
            self._words = gui.add_html("")
        asked(self._triplet, lambda value: self._sense(triplet=tuple(value.split())))
        self._noise = force, moment
        asked(force, lambda value: self._sense(force_noise=value / _UN))
        asked(moment, lambda value: self._sense(moment_noise=value / _UNM))
        asked(self._colours, self._colour)
        asked(cut, self._open)

    def enter(self) -> None:
        """Show the controls, and point the cameras at the whisker."""
        super().enter()
        self._page.face_whisker()
        self._drawn = None
        if self._page.bend.kind != "point":
            self._page.bend = loaded(self._page.bend, "point")

    def redraw(self) -> None:
        """Draw whisker, candidates and errors; colour the cloud of contacts if it has changed."""
        page, bend, chart = self._page, self._page.bend, self._page.chart
        page.stage.show("bend", bend_drawing(bend, page.exaggeration))
        if chart is None:
            self.found = None
            page.stage.show("candidates", {})
            return
        self.found = located(chart, bend, self._sensor)
        found = self.found
        drawing = {} if found is None else locate_drawing(bend.whisker, found, page.exaggeration)
        page.stage.show("candidates", drawing)
        key = (chart, self._sensor, self._what)
        if self._drawn == key:
            return
        self._drawn = key  # the cloud is coloured in the background

        def ready(colours: scene.Bytes, legend: readout.Legend) -> None:
            if self._drawn == key:
                self._legend.content = legend.html()
                self._cloud = (chart, colours)
                self._show_cloud()

        def job() -> None:
            colours, legend = coloured(chart, key[2], key[1])
            page.work.put("colours", lambda: ready(colours, legend))

        page.slow_work.put("colours", job)

    def write(self, brief: bool = False) -> None:
        """Show the contacts that follow from the three signals."""
        bend = self._page.bend
        if self._page.chart is None:
            self._words.content = readout.note("Sampling all contacts of this whisker …")
        else:
            self._words.content = of_located(bend.whisker, self.found, bend.status)

    def link(self) -> dict[str, str]:
        """Signals, noise and colours."""
        noise = words_of([force.value for force in self._noise])
        return {"signals": " ".join(self._sensor.triplet), "noise": noise, "colours": self._what}

    def restore(self, asked: Mapping[str, str]) -> None:
        """Choose signals, noise and colours."""
        if (noise := numbers_in(asked.get("noise", ""), 2)) is not None and (noise >= 0.0).all():
            for slider, value in zip(self._noise, noise, strict=True):
                put(slider, float(value))
            self._sense(force_noise=float(noise[0]) / _UN, moment_noise=float(noise[1]) / _UNM)
        if (signals := asked.get("signals", "")) in self._triplet.options:
            put(self._triplet, signals)
            self._sense(triplet=tuple(signals.split()))
        if (colours := asked.get("colours", "")) in COLOURS:
            put(self._colours, colours)
            self._colour(colours)

    def _show_cloud(self) -> None:
        if self._cloud is None or self._page.mode is not self:
            return
        chart, colours = self._cloud
        opacity = None if self._cut else _CLEAR
        solid = coloured_solid(chart, colours, self._cut, opacity)
        self._page.stage.show("cloud", {"contacts": solid})

    def _sense(self, **changes: object) -> None:
        self._sensor = Sensor(**{**vars(self._sensor), **changes})
        self._page.work.put("sensor", self._page.redraw)

    def _colour(self, what: str) -> None:
        self._what = what
        self._page.work.put("sensor", self._page.redraw)

    def _open(self, cut: bool) -> None:
        self._cut = cut
        self._page.work.put("cut", self._show_cloud)
