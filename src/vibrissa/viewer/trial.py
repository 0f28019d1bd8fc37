"""Mode Trial: a recording over time, in space, in both cameras, in signals.

Lines, contacts and forces are in the laboratory frame. Variables that exist in several groups are
taken from the first of: the groups of the stages, the root, the truth.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
import xarray as xr
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from vibrissa import scene
from vibrissa.cameras import Camera
from vibrissa.contour import CylinderFit, SphereFit, shape_from_dataset, surface_grid
from vibrissa.io import Footage
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface, objects_datasets
from vibrissa.quantities import to_display
from vibrissa.recording import Recording
from vibrissa.scene import Bytes
from vibrissa.signals import SIGNALS, base_signals
from vibrissa.simulation import silhouette
from vibrissa.sketch import round_step
from vibrissa.viewer.bend import NODES, force_arrow, mm, ruler, whisker_body
from vibrissa.viewer.page import Mode, Page, Player, asked, put
from vibrissa.viewer.readout import CONTACT, FIT, OBJECT, Legend, chart, cursor, table, timeline
from vibrissa.whisker import Whisker


@dataclass(frozen=True, eq=False)
class Watched:
    """Data of a trial of n frames, w whiskers and v views, prepared for drawing."""

    time: Array
    whiskers: tuple[Whisker, ...]
    names: tuple[str, ...]
    lines: Array
    contacts: Array
    covariance: Array | None
    touching: Mask
    forces: Array
    signals: dict[str, Array]
    objects: tuple[Surface, ...]
    contour: xr.Dataset | None
    cameras: tuple[Camera, ...]
    traces: Array | None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.time.size)

    def at(self, time: float) -> int:
        """The frame at a time, s."""
        return int(np.clip(np.searchsorted(self.time, time + 1e-9) - 1, 0, self.frames - 1))

    @property
    def busiest(self) -> int:
        """Index of the whisker longest in contact; the first of equals."""
        return int(np.argmax(self.touching.sum(axis=0)))

    def onsets(self) -> NDArray[np.int64]:
        """Frames in which a contact begins."""
        before = np.concatenate([np.zeros((1, self.touching.shape[1]), bool), self.touching[:-1]])
        return np.flatnonzero((self.touching & ~before).any(axis=1))

    def onset_from(self, frame: int, ahead: bool = True) -> int:
        """Frame of the next or previous onset, in a circle; the same without onsets."""
        onsets = self.onsets()
        if not onsets.size:
            return frame
        after = np.searchsorted(onsets, frame, "right" if ahead else "left")
        return int(onsets[(after if ahead else after - 1) % onsets.size])

    def contact_at(self, frame: int, origin: Array, direction: Array) -> int | None:
        """Frame of the contact, up to a frame, that a ray, m, meets first; None without one."""
        away = self.contacts[: frame + 1] - origin
        direction = direction / np.linalg.norm(direction)
        depth = away @ direction
        aside = np.linalg.norm(away - depth[..., None] * direction, axis=-1)
        hit = (aside < _NEAR * self.whiskers[0].length) & (depth > 0.0)
        near = np.where(hit, depth, np.nan)
        if np.isnan(near).all():
            return None
        return int(np.unravel_index(np.nanargmin(near), near.shape)[0])


def watched(recording: xr.DataTree) -> Watched:
    """Extract the data to be drawn from a recording."""
    root = recording.to_dataset()
    if not root.sizes.get("time") or not root.sizes.get("whisker"):
        raise ValueError("the recording has no frames with a whisker")
    trial = Recording(recording)
    shape = (root.sizes["time"], root.sizes["whisker"])
    whiskers = tuple(trial.whiskers)
    if (contacts := trial.known("contact_point", ("estimates", "", "truth"))) is None:
        contacts = np.full((*shape, 3), np.nan)
    in_contact = trial.known("in_contact", ("estimates", "", "truth"))
    touching: Mask = np.asarray(np.isfinite(contacts).all(axis=-1))
    if in_contact is not None:
        touching = touching & in_contact
    forces, signals = _measured(trial, shape)
    cameras = trial.cameras if "cameras" in trial else ()
    contour = trial.find("contour")
    return Watched(
        time=np.asarray(root["time"].to_numpy(), dtype=np.float64),
        whiskers=whiskers,
        names=tuple(trial.names),
        lines=_lines(trial, whiskers),
        contacts=np.where(touching[..., None], contacts, np.nan),
        covariance=trial.known("contact_covariance", ("estimates", "")),
        touching=touching,
        forces=forces,
        signals=signals,
        objects=trial.objects,
        contour=contour.data if contour else None,
        cameras=cameras,
        traces=trial.known("trace", ("", "truth")) if cameras else None,
    )


def _lines(trial: Recording, whiskers: Sequence[Whisker]) -> Array:
    """Recorded centrelines, or else the resting whisker at the pose of its base."""
    if (lines := trial.known("centerline", ("", "truth"))) is not None:
        return lines
    place = trial.known("base_position", ("", "truth"))
    turn = trial.known("base_rotation", ("", "truth"))
    if place is None or turn is None:
        raise ValueError("the recording has neither centrelines nor poses of the whisker's base")
    rest = np.stack([whisker.centerline(NODES) for whisker in whiskers])
    return np.asarray(np.einsum("twij,wkj->twki", turn, rest) + place[:, :, None])


def _measured(trial: Recording, shape: tuple[int, int]) -> tuple[Array, dict[str, Array]]:
    """Forces in the laboratory frame and the six signals; NaN where unknown."""
    missing = np.full((*shape, 3), np.nan)
    force = trial.known("force", ("signals", "", "truth"))
    moment = trial.known("moment", ("signals", "", "truth"))
    if force is None or moment is None:
        force, moment = missing, missing
    turn = trial.known("base_rotation", ("signals", "", "truth"))
    in_lab = missing if turn is None else np.einsum("twij,twj->twi", turn, force)
    signals = base_signals(force, moment)
    return in_lab, {name: np.asarray(signals[name].to_numpy()) for name in SIGNALS}


Frame = NDArray[np.uint8]

WIDTH = 420  # width of a picture, pixels
_MARGIN = 40.0
_TRACE = (0, 150, 255)


@dataclass(frozen=True, eq=False)
class View:
    """Part of a camera's images shown for a trial."""

    name: str
    number: int
    box: tuple[int, int, int, int]
    empty: Frame

    @property
    def scale(self) -> float:
        """Pixels of the picture per pixel of the image."""
        return min(1.0, WIDTH / (self.box[2] - self.box[0]))


def views(trial: Watched) -> tuple[View, ...]:
    """Views of all cameras: the regions of their traces, with a margin."""
    if trial.traces is None:
        return ()
    out = []
    middle = np.nanmean(trial.lines.reshape(-1, 3), axis=0)
    for i, camera in enumerate(trial.cameras):
        width, height = camera.size
        places = trial.traces[:, :, i].reshape(-1, 2)
        if not np.isfinite(places).any():
            continue
        low = np.maximum(np.nanmin(places, axis=0) - _MARGIN, 0.0).astype(int).tolist()
        high = np.minimum(np.nanmax(places, axis=0) + _MARGIN, camera.size).astype(int).tolist()
        covered = silhouette(camera, trial.objects, middle, 1.0)
        empty = np.round(236.0 - 130.0 * covered).astype(np.uint8)
        box = (low[0], low[1], max(high[0], low[0] + 8), max(high[1], low[1] + 8))
        assert empty.shape == (height, width)
        out.append(View(camera.name, i, box, empty))
    return tuple(out)


def picture(view: View, trial: Watched, frame: int, image: Frame | None = None) -> Bytes:
    """Picture of one frame of one camera."""
    left, top, right, bottom = view.box
    source = view.empty if image is None else image
    rows = np.arange(top, bottom, 1.0 / view.scale).astype(int)
    columns = np.arange(left, right, 1.0 / view.scale).astype(int)
    rows = rows[rows < source.shape[0]]
    columns = columns[columns < source.shape[1]]
    out = Image.fromarray(source[np.ix_(rows, columns)]).convert("RGB")
    draw = ImageDraw.Draw(out)
    assert trial.traces is not None  # else there are no views
    for trace in trial.traces[frame, :, view.number]:
        known = (trace[np.isfinite(trace).all(axis=1)] - [left, top]) * view.scale
        draw.line(np.round(known).ravel().tolist(), _TRACE)
    touching = trial.contacts[frame][trial.touching[frame]]
    if touching.size:
        seen = trial.cameras[view.number].project(touching)
        for at in np.round((seen - [left, top]) * view.scale):
            draw.ellipse([*(at - 3.0), *(at + 3.0)], CONTACT)
    return np.asarray(out)


POINTS = 4000  # most contact points that are drawn
_COLOURS = np.array(
    [CONTACT, (0, 114, 178), (204, 121, 167), (0, 158, 115), (230, 159, 0), (86, 180, 233)]
)


def extent(trial: Watched) -> tuple[Array, float]:
    """Centre (3,) and size of the region of the whiskers, mm."""
    points = trial.lines.reshape(-1, 3)
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    return mm(0.5 * (low + high)), float(mm(np.linalg.norm(high - low)))


# Layers that can be switched.
LAYERS = ("Whiskers", "Forces", "Contacts", "Uncertainty", "Objects", "Fitted shape", "Scale")
_SIGMAS = 2.0  # size of the ellipsoid of a contact, standard deviations
_NEAR = 0.02  # distance from a click at which a contact is hit, over the whisker's length
_SHARP = 0.3e-3  # standard deviation, m, from which on contacts are paler
# Colour of the least certain contacts, as faint on white as on black.
_PALE: scene.Colour = (150, 152, 155)
_LEGEND: dict[str, tuple[scene.Colour, str]] = {
    "Contacts": (CONTACT, "contacts"),
    "Uncertainty": (_PALE, "uncertain"),
    "Objects": (OBJECT, "object"),
    "Fitted shape": (FIT, "fitted shape"),
}


def legends(trial: Watched, layers: Collection[str]) -> list[Legend]:
    """Meaning of the colours: of several whiskers, contacts have that of their whisker."""
    steps = [_LEGEND[layer] for layer in layers]
    names: list[tuple[scene.Colour, str]] = []
    if len(trial.names) > 1:
        steps.remove(_LEGEND["Contacts"])
        touching = np.flatnonzero(np.isfinite(trial.contacts).all(axis=-1).any(axis=0))
        names = [(tuple(_COLOURS[i % len(_COLOURS)].tolist()), trial.names[i]) for i in touching]
    return [
        Legend(title, tuple((f"rgb{colour}", words) for colour, words in these), smooth=False)
        for title, these in (("Contacts of", names), ("", steps))
        if these
    ]


def moment_drawing(
    trial: Watched, frame: int, exaggeration: float, layers: Collection[str] = LAYERS
) -> scene.Drawing:
    """Draw whiskers, forces and contacts of one frame."""
    out: dict[str, scene.Mark] = {}
    for i, whisker in enumerate(trial.whiskers):
        line = trial.lines[frame, i]
        if not np.isfinite(line).all():
            continue
        if "Whiskers" in layers:
            out[f"whisker {i}"] = whisker_body(whisker, line, exaggeration)
        at, force = trial.contacts[frame, i], trial.forces[frame, i]
        if not np.isfinite(at).all():
            continue
        if "Contacts" in layers:
            radius = float(mm(0.012 * whisker.length))
            vertices, faces = scene.ellipsoid(mm(at), radius * np.eye(3))
            out[f"contact {i}"] = scene.Body(vertices, faces, CONTACT)
        if "Uncertainty" in layers and trial.covariance is not None:
            covariance = trial.covariance[frame, i]
            if np.isfinite(covariance).all() and np.sqrt(np.trace(covariance)) < _SHARP * 10.0:
                vertices, faces = scene.error_ellipsoid(at, covariance, _SIGMAS)
                out[f"error {i}"] = scene.Body(mm(vertices), faces, CONTACT, 0.25)
        if "Forces" in layers and (drawn := force_arrow(whisker, force, at)):
            out[f"force {i}"] = drawn["force"]
    return out


def touched(trial: Watched, frame: int) -> scene.Drawing:
    """Draw all contact points up to a frame in their whisker's colour, paler if uncertain."""
    points = trial.contacts[: frame + 1]
    known = np.isfinite(points).all(axis=-1)
    which = np.nonzero(known)[1]
    chosen = points[known]
    step = max(1, int(np.ceil(trial.touching.sum() / POINTS)))
    if not chosen.size:
        return {}
    size = float(mm(0.011 * trial.whiskers[0].length))
    shown = np.asarray(_COLOURS[which[::step] % len(_COLOURS)], dtype=np.uint8)
    if trial.covariance is not None:
        spread = np.trace(trial.covariance[: frame + 1][known][::step], axis1=1, axis2=2)
        bold = np.nan_to_num(np.clip(_SHARP / np.sqrt(np.maximum(spread, 1e-20)), 0.08, 1.0))
        shown = np.asarray(bold[:, None] * shown + (1.0 - bold[:, None]) * _PALE, dtype=np.uint8)
    return {"contacts": scene.Cloud(mm(chosen[::step]), shown, size)}


def surroundings(trial: Watched, layers: Collection[str] = LAYERS) -> scene.Drawing:
    """Draw objects, the shape fitted to the contacts, and a scale."""
    middle, size = extent(trial)
    near = trial.contacts[np.isfinite(trial.contacts).all(axis=-1)]
    centre = np.mean(near, axis=0) if near.size else middle / to_display("length", 1.0)
    out: dict[str, scene.Mark] = {}
    if "Scale" in layers:
        length = 2.0 * round_step(size / 6.0)
        low = middle - np.array([0.5 * length, 0.2 * size, 0.15 * size])
        out |= ruler(low, length, size)
    if "Objects" in layers:
        for i, thing in enumerate(trial.objects):
            out[f"object {i}"] = object_body(thing, 0.6 * size, mm(centre))
    fitted = trial.contour if "Fitted shape" in layers else None
    if fitted is not None and (body := fitted_body(fitted, near)) is not None:
        out["fit"] = scene.Body(mm(body[0]), body[1], FIT, 0.4, "double")
    return out


def object_body(thing: Surface, extent: float, near: Array) -> scene.Body:
    """Body of an object; unbounded ones are clipped to a cube around a position (3,), mm."""
    half = 0.5 * extent
    (held,) = objects_datasets([thing]).values()
    vertices, faces = scene.object_surface(held, np.stack([near - half, near + half], axis=1))
    return scene.Body(vertices, faces, OBJECT, 0.55, "double")


def fitted_body(contour: xr.Dataset, near: Array) -> tuple[Array, scene.Ints] | None:
    """Vertices, m, and triangles of a fitted shape; None if it cannot be drawn."""
    try:
        shape = shape_from_dataset(contour)
    except ValueError:
        return None
    if isinstance(shape, SphereFit):
        return scene.ellipsoid(shape.origin, shape.radius * np.eye(3), 48)
    if not near.size:
        return None
    if isinstance(shape, CylinderFit):
        along = (near - shape.origin) @ shape.axis
        middle = shape.origin + 0.5 * (along.min() + along.max()) * shape.axis
        length = 1.3 * float(np.ptp(along)) + 2.0 * shape.radius
        return scene.cylinder(middle, shape.axis, shape.radius, length)
    grid = surface_grid(shape, near)["surface_grid_point"].to_numpy()
    return scene.sheet(grid)


_MS = 1e3
SPEEDS = {"real time": 1.0, "1 : 2": 0.5, "1 : 5": 0.2, "1 : 10": 0.1, "1 : 50": 0.02}
_USUAL = "1 : 10"
BACK, AHEAD = "◀ frame", "frame ▶"
EARLIER, LATER = "◀ contact", "contact ▶"


class TrialMode(Mode):
    """Mode with the controls of time, and the drawings that depend on it."""

    name = "Trial"
    layers = ("moment", "touched", "surroundings")

    def __init__(self, page: Page, trial: Watched, videos: Sequence[Footage] = ()) -> None:
        super().__init__(page, page.server.gui.add_folder("Trial", visible=False))
        self.trial = trial
        self.frame = 0
        self._videos = tuple(videos)
        self._now = float(trial.time[0])
        self._speed = SPEEDS[_USUAL]
        self._whisker = trial.busiest
        self._still: frozenset[str] | None = None
        self._visible = frozenset(LAYERS)
        self._views = views(trial)
        self._player = Player(self._tick)
        page.closing.append(self._player.close)
        self._controls(page.server)

    def _controls(self, server: viser.ViserServer) -> None:
        gui, trial = server.gui, self.trial
        end = round(_MS * float(trial.time[-1] - trial.time[0]), 3)
        step = max(round(end / max(trial.frames - 1, 1), 3), 1e-3)
        with self._folder:
            self._time = gui.add_slider("Time (ms)", 0.0, max(end, step), step, 0.0)
            self._play = gui.add_button("Play", color="blue")
            jump = gui.add_button_group("Onset", (EARLIER, LATER), hint="Keys p and n")
            step_by = gui.add_button_group("Step", (BACK, AHEAD), hint="Keys , and .")
            self._again = gui.add_checkbox("Repeat", False)
            speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value=_USUAL)
            if len(trial.names) > 1:
                which = gui.add_dropdown(
                    "Signals of", trial.names, initial_value=trial.names[self._whisker]
                )
                asked(which, self._choose)
            with gui.add_folder("Layers", expand_by_default=False):
                for layer in LAYERS:
                    box = gui.add_checkbox(layer, True, visible=self._has(layer))
                    asked(box, partial(self._see, layer))
            for legend in legends(trial, [layer for layer in _LEGEND if self._has(layer)]):
                gui.add_html(legend.html())
            self._words = gui.add_html("")
            self._chart = gui.add_html("")
            self._cursor = gui.add_html("")
        self._window = gui.add_panel(visible=False) if self._views else None
        self._pictures: list[tuple[View, viser.GuiImageHandle]] = []
        if self._window is not None:
            with self._window.add_tab("Cameras"):
                for view in self._views:
                    blank = picture(view, trial, 0)
                    self._pictures.append((view, gui.add_image(blank, label=view.name)))
            self._window.dock_left()
            self._window.set_width(330.0)
        asked(self._time, lambda value: self.go(float(trial.time[0]) + value / _MS))
        asked(speed, self.hurry)
        step_by.on_click(lambda event: self.step(1 if event.target.value == AHEAD else -1))
        self._timeline = gui.add_panel(visible=False)
        with self._timeline.add_tab("Timeline"):
            gui.add_html(
                timeline(trial.time, np.asarray(trial.touching.any(axis=1)), trial.onsets())
            )
            self._now_line = gui.add_html("")
        self._timeline.float(x=16.0, y=-16.0, width=520.0, height=112.0)
        self._timeline.expand()  # on a phone panels are closed otherwise
        self._play.on_click(lambda _: self.toggle())
        jump.on_click(lambda event: self.jump(event.target.value == LATER))

    def enter(self) -> None:
        """Show the controls, and point the cameras at the whiskers."""
        super().enter()
        self._timeline.visible = True
        if self._window is not None:
            self._window.visible = True
        middle, size = extent(self.trial)
        self._page.look_at(middle, 0.9 * size, (0.25, -0.75, 0.65))
        self._draw_chart()

    def leave(self) -> None:
        """Stop, and hide the controls and the objects."""
        super().leave()
        self.pause()
        self._timeline.visible = False
        if self._window is not None:
            self._window.visible = False
        self._still = None

    def redraw(self) -> None:
        """Draw the current frame."""
        trial, stage, frame = self.trial, self._page.stage, self.frame
        layers = self._visible
        stage.show("moment", moment_drawing(trial, frame, self._page.exaggeration, layers))
        stage.show("touched", touched(trial, frame) if "Contacts" in layers else {})
        if self._still != layers:
            self._still = layers
            stage.show("surroundings", surroundings(trial, layers))
        for view, shown in self._pictures:
            image = self._videos[view.number].frame(frame) if self._videos else None
            shown.image = picture(view, trial, frame, image)

    def write(self, brief: bool = False) -> None:
        """Show the signals and the time of the current frame."""
        trial, frame = self.trial, self.frame
        put(self._time, _MS * float(trial.time[frame] - trial.time[0]))
        share = self._share
        self._cursor.content = cursor(share)
        self._now_line.content = cursor(share, strip=True)
        self._words.content = self._words_of(frame)

    @property
    def _share(self) -> float:
        """Current time as a share of the trial."""
        time = self.trial.time
        return float((time[self.frame] - time[0]) / max(np.ptp(time), 1e-12))

    def link(self) -> dict[str, str]:
        """Parameter of a link with the time, as a share of the trial."""
        return {"t": f"{self._share:.6f}"}

    def restore(self, asked: Mapping[str, str]) -> None:
        """Go to a time."""
        try:
            share = float(asked.get("t", ""))
        except ValueError:
            return
        if 0.0 <= share <= 1.0:
            away = self.trial.time - self.trial.time[0] - share * np.ptp(self.trial.time)
            self.go(float(self.trial.time[np.abs(away).argmin()]))

    def go(self, time: float) -> None:
        """Show the frame at a time, s."""

        def job() -> None:
            self._now = time
            self.frame = self.trial.at(time)
            if self._page.mode is self:
                self._page.redraw()

        self._page.work.put("time", job)

    def toggle(self) -> None:
        """Play or pause; from the end it starts again."""
        if self._player.playing:
            self._player.pause()
        else:
            if self.frame >= self.trial.frames - 1:
                self._now = float(self.trial.time[0])
            self._player.play()
        self._play.label = "Pause" if self._player.playing else "Play"

    def pause(self) -> None:
        """Pause."""
        self._player.pause()
        self._play.label = "Play"

    def hurry(self, words: str) -> None:
        """Play at one of :data:`SPEEDS`."""
        self._speed = SPEEDS[words]

    def jump(self, ahead: bool = True) -> None:
        """Go to the next or previous onset of a contact."""
        self.go(float(self.trial.time[self.trial.onset_from(self.frame, ahead)]))

    def pick(self, origin: Array, direction: Array) -> None:
        """Go to the frame of the contact at a ray, mm."""
        frame = self.trial.contact_at(self.frame, origin / to_display("length", 1.0), direction)
        if frame is not None and "Contacts" in self._visible:
            self.pause()
            self.go(float(self.trial.time[frame]))

    def show(self, frame: int) -> None:
        """Show a frame, and wait until it is drawn."""
        self.go(float(self.trial.time[frame]))
        self._page.work.wait()

    def step(self, frames: int) -> None:
        """Go forward or back by a number of frames."""
        self.pause()
        frame = int(np.clip(self.frame + frames, 0, self.trial.frames - 1))
        self.go(float(self.trial.time[frame]))

    def _tick(self, passed: float) -> None:
        time = self._now + self._speed * passed
        if time >= self.trial.time[-1] and self._again.value:
            time = float(self.trial.time[0])
        elif time >= self.trial.time[-1]:
            self.pause()
        self._now = time
        self.go(time)

    def _choose(self, name: str) -> None:
        self._whisker = self.trial.names.index(name)
        self._page.work.put("chart", self._draw_chart)
        self._page.work.put("time", self._page.redraw)

    def _has(self, layer: str) -> bool:
        """Whether a layer has contents."""
        there = {
            "Objects": bool(self.trial.objects),
            "Fitted shape": self.trial.contour is not None,
            "Uncertainty": self.trial.covariance is not None,
        }
        return there.get(layer, True)

    def _see(self, layer: str, shown: bool) -> None:
        self._visible = self._visible | {layer} if shown else self._visible - {layer}
        self._page.work.put("time", self._page.redraw)

    def _draw_chart(self) -> None:
        trial, i = self.trial, self._whisker
        signals = {name: values[:, i] for name, values in trial.signals.items()}
        for name in ("FD", "MD"):  # without contact a direction is noise
            signals[name] = np.where(trial.touching[:, i], signals[name], np.nan)
        self._chart.content = chart(trial.time, signals, trial.touching[:, i])

    def _words_of(self, frame: int) -> str:
        trial, i = self.trial, self._whisker
        rows = {name: float(values[frame, i]) for name, values in trial.signals.items()}
        touching = "in contact" if trial.touching[frame, i] else "free"
        passed = f"{_MS * float(trial.time[frame] - trial.time[0]):.1f} ms"
        count = int(trial.touching[: frame + 1].sum())
        so_far = f"{count} contact point{'' if count == 1 else 's'}"
        return table(rows, f"{passed}: {touching}, {so_far}")
