"""Page of the viewer: one scene, one panel, and several modes.

All events of the page are handled by one thread (:class:`~vibrissa.viewer.page.Latest`), which
changes and draws the state, so that the state is never changed concurrently. Another thread is the
clock of a trial.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from math import inf
from typing import Any
from urllib.parse import urlencode

import numpy as np
import viser
from numpy.typing import ArrayLike
from viser import transforms

from vibrissa.contacts import ContactMap
from vibrissa.numerics import Array
from vibrissa.quantities import quantity, to_display
from vibrissa.scene import across
from vibrissa.viewer.stage import Stage, triple
from vibrissa.viewer.state import (
    Bend,
    Chart,
    Shape,
    begin,
    charted,
    link_of,
    moved,
    numbers_in,
    restored,
    shape_in,
    shape_of,
    shaped,
    with_whisker,
    words_of,
    words_of_shape,
)
from vibrissa.whisker import Whisker

EXAGGERATION = 8.0

# Interval at which numbers are updated during dragging, s: the browser takes half as long for them
# as for a whisker.
_READ = 0.05
_REST = 0.15  # time without dragging after which all texts are updated, s
Transition = Callable[[Bend], Bend]


class Mode:
    """A mode of the page, with a folder of controls and layers of objects in the scene."""

    name: str
    layers: tuple[str, ...]

    def __init__(self, page: Page, folder: viser.GuiFolderHandle) -> None:
        self._page = page
        self._folder = folder

    def enter(self) -> None:
        """Show the controls."""
        self._folder.visible = True

    def leave(self) -> None:
        """Hide the controls and the objects."""
        self._folder.visible = False
        for layer in self.layers:
            self._page.stage.show(layer, {})

    def redraw(self) -> None:
        """Update the scene after a change of the whisker or its load."""

    def write(self, brief: bool = False) -> None:
        """Update the texts of the panel; if ``brief``, only those read while dragging."""

    def pick(self, origin: Array, direction: Array) -> None:
        """Handle a click on the scene, at a ray, mm."""

    def link(self) -> dict[str, str]:
        """Parameters of a link that restore the state of the mode."""
        return {}

    def restore(self, asked: Mapping[str, str]) -> None:
        """Restore the state of the mode from the parameters of a link."""


class Page:
    """State of the page that is common to all modes."""

    def __init__(
        self, server: viser.ViserServer, whisker: Whisker, contact_map: ContactMap | None = None
    ) -> None:
        self.server = server
        self.stage = Stage(server)
        self.work = Latest(self._fault)
        self._all = whole(whisker)
        self.slow_work = Latest(self._fault)
        self.original = whisker
        self._contact_map = contact_map
        self.chart: Chart | None = None
        self.shape = shape_of(whisker)
        self.bend = begin(whisker)
        self.exaggeration = EXAGGERATION
        self.mode: Mode | None = None
        self.modes: dict[str, Mode] = {}
        self.whisker_controls: viser.GuiFolderHandle | None = None
        self.chosen: Callable[[str], None] = lambda name: None
        self.reshaped: Callable[[Shape], Shape] = lambda shape: shape
        self.closing: list[Callable[[], None]] = []
        self.linked: viser.GuiHtmlHandle | None = None
        self._written = 0.0
        self._framing = Framing(server, self._viewed)  # calls as soon as a browser is there
        size = float(to_display("length", 0.2 * whisker.length))
        self.grip = Grip(
            server,
            size,
            lambda place, turn: self.change("drag", lambda b: moved(b, place, turn[:, 2]), True),
        )
        shown: Any = server.scene  # its type does not allow coroutines, which run in order
        shown.on_click()(self._clicked)

    async def _clicked(self, event: viser.SceneClickEvent) -> None:
        """Schedule the handling of a click on the scene by the mode."""
        origin, direction = (
            np.asarray(of, dtype=np.float64) for of in (event.ray_origin, event.ray_direction)
        )
        if (mode := self.mode) is not None:
            self.work.put("pick", lambda: mode.pick(origin, direction))

    def change(self, topic: str, transition: Transition, dragging: bool = False) -> None:
        """Schedule a change of the load; a newer change replaces an older one."""

        def job() -> None:
            self.bend = transition(self.bend)
            self.redraw(dragging)

        self.work.put(topic, job)

    @property
    def has_map(self) -> bool:
        """Whether a map was given rather than computed."""
        return self._contact_map is not None

    def reshape(self, **asked: float) -> None:
        """Change length, turning angle, taper or modulus of the whisker, SI units."""
        values = {**vars(self.shape), **asked}
        self.shape = type(self.shape)(**values)

        def job() -> None:
            whisker = shaped(self.original, self.shape)
            self.bend = with_whisker(self.bend, whisker)
            self.chart = None
            self.redraw()
            self.prepare()

        self.work.put("shape", job)

    def prepare(self) -> None:
        """Sample the whisker's contacts in the background, and redraw when that is done."""
        whisker = self.bend.whisker
        own = self._contact_map if whisker is self.original else None

        def ready(chart: Chart) -> None:
            if chart.whisker is self.bend.whisker:
                self.chart = chart
                self.redraw()

        def job() -> None:
            chart = charted(whisker, own)
            self.work.put("chart", lambda: ready(chart))

        self.slow_work.put("chart", job)

    def settle(self, timeout: float = 60.0) -> bool:
        """Wait up to ``timeout`` s until all work is done; return whether it is."""
        return self.work.wait(timeout) and self.slow_work.wait(timeout) and self.work.wait(timeout)

    def thicken(self, factor: float) -> None:
        """Set the factor by which the drawn thickness of the whisker is exaggerated."""

        def job() -> None:
            self.exaggeration = factor
            self.redraw()

        self.work.put("thickness", job)

    def choose(self, name: str) -> None:
        """Change to another mode."""

        def job() -> None:
            if self.mode is not None:
                self.mode.leave()
            self.mode = self.modes[name]
            if self.whisker_controls is not None:
                self.whisker_controls.visible = name != "Trial"
            self.chosen(name)
            self.mode.enter()
            self.redraw()

        self.work.put("mode", job)

    def redraw(self, dragging: bool = False) -> None:
        """Draw the mode, all in one message to the browser; a dragged object stays at the mouse."""
        now = time.monotonic()
        words = not dragging or now >= self._written + _READ
        with self.server.atomic():
            if self.mode is not None:
                self.mode.redraw()
                if words:
                    self._write(brief=dragging)
            if dragging:
                self.grip.follow(self.bend.target)
            else:
                self.place_grip()
        self.server.flush()
        if dragging:
            self.work.put("words", self._write, now + _REST)
        else:
            self.work.drop("words")

    def _write(self, brief: bool = False) -> None:
        """Update the texts of the panel."""
        self._written = time.monotonic()
        if self.mode is None:
            return
        self.mode.write(brief)
        self._link()

    def _viewed(self) -> None:
        """Schedule an update of the link after a change of the view."""
        self.work.put("link", self._link, time.monotonic() + _REST)

    def _link(self) -> None:
        """Update the link that restores the current view."""
        if self.mode is None or self.linked is None:
            return
        state = {"mode": self.mode.name, **self.mode.link()}
        if self._draggable:
            state |= link_of(self.bend)
        if self.shape != shape_of(self.original):
            state["whisker"] = words_of_shape(self.shape)
        if self._framing.turned is not None:
            state["camera"] = words_of(self._framing.turned)
        show(self.linked, f'<i hidden data-link="{escape(urlencode(state))}"></i>')

    def restore(self, asked: Mapping[str, str]) -> None:
        """Restore the state in the parameters of a link, as far as they are valid."""
        if "mode" not in asked:
            if self.mode is not None:
                self.mode.restore(asked)
            return
        if (mode := self.modes.get(asked["mode"])) is None:
            return
        self.choose(mode.name)
        mode.restore(asked)
        if (shape := shape_in(asked.get("whisker", ""))) is not None and mode.name != "Trial":
            self.reshape(**vars(self.reshaped(shape)))
        self.change("drag", lambda bend: restored(bend, asked))
        if (camera := numbers_in(asked.get("camera", ""), 6)) is not None:
            self.work.put("camera", lambda: self._framing.place(camera[:3], camera[3:]))

    @property
    def _draggable(self) -> bool:
        """Whether the load can be dragged in this mode."""
        return self.mode is not None and self.mode.name in ("Bend", "Locate")

    def place_grip(self) -> None:
        """Move the grip to the load."""
        bend = self.bend
        if not self._draggable or bend.kind == "force":
            self.grip.show(None)
            return
        self.grip.show(bend.target, bend.axis if bend.kind == "peg" else None)

    def face_whisker(self) -> None:
        """Point all cameras at the whisker."""
        self._show(whole(self.bend.whisker))

    def look_at(
        self, centre: Array, distance: float, way: Sequence[float], height: float = 0.0
    ) -> None:
        """Point all cameras at a position, mm, from a distance, mm, and a direction."""
        self._show(Shot(centre, distance, np.asarray(way, dtype=np.float64), height))

    def _show(self, shot: Shot) -> None:
        self._all = shot
        self._framing.show(shot)

    def turn(self, name: str) -> None:
        """Point all cameras at everything, as at first or from one of `VIEWS`."""
        self._framing.show(replace(self._all, way=np.array(VIEWS.get(name, self._all.way))))

    def _fault(self, error: Exception) -> None:
        traceback.print_exception(error)
        self.say("Error", str(error) or type(error).__name__, "red")

    def say(self, title: str, body: str, colour: Any = None, seconds: float | None = 8.0) -> None:
        """Show a notification in all browsers."""
        for client in self.server.get_clients().values():
            client.add_notification(title, body, color=colour, auto_close_seconds=seconds)

    def close(self) -> None:
        """Stop all threads, and then close their sources, such as videos."""
        self.slow_work.close()
        self.work.close()
        for end in self.closing:
            end()
        self.server.stop()


def asked(handle: viser.GuiInputHandle[Any], then: Callable[[Any], None]) -> None:
    """Call ``then`` with the value of a control when a user changes it on the page."""

    @handle.on_update
    async def _(event: Any) -> None:
        if event.client is not None:
            then(event.target.value)


def put(handle: viser.GuiInputHandle[Any], value: Any) -> None:
    """Set the value of a control."""
    control: Any = handle  # type checkers take its value for read-only
    control.value = value


def show(handle: viser.GuiHtmlHandle, content: str) -> None:
    """Update a text of the panel if it has changed."""
    if handle.content != content:
        handle.content = content


_MM = quantity("length").display_factor

# Function called with the position (3,), m, and the orientation (3, 3) after dragging.
Moved = Callable[[Array, Array], None]


class Grip:
    """A ball and a gizmo in the scene that can be dragged."""

    def __init__(self, server: viser.ViserServer, size: float, moved: Moved) -> None:
        self._moved = moved
        self._gizmo = server.scene.add_transform_controls(
            "/grip",
            scale=size,
            line_width=2.5,
            disable_rotations=True,
            depth_test=False,
            opacity=0.75,
            visible=False,
        )
        self._ball = server.scene.add_icosphere(
            "/grip ball",
            radius=0.096 * size,
            color=(213, 94, 0),
            subdivisions=2,
            opacity=0.35,
            side="front",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        self._turning = False
        self._by_ball = False

        # Coroutines run one after the other, so that no older position can overtake a newer one.
        @self._gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.phase == "update":
                self._by_ball = False
                self._report(event.target.position)

        @self._ball.on_drag
        async def _(event: viser.SceneNodeDragEvent[viser.IcosphereHandle]) -> None:
            # The gizmo is hidden while the ball is dragged.
            self._gizmo.visible = event.phase == "end" and self._ball.visible
            if event.phase == "update":
                self._by_ball = True
                self._report(event.end_position)

    def _report(self, place: ArrayLike) -> None:
        turn = np.array(transforms.SO3(self._gizmo.wxyz).as_matrix(), dtype=np.float64)
        self._moved(np.array(place, dtype=np.float64) / _MM, turn)

    def follow(self, place: Array) -> None:
        """Move the part that the mouse does not hold to the position (3,) it was dragged to, m."""
        self._ball.position = triple(_MM * place)
        if self._by_ball:
            self._gizmo.position = self._ball.position

    def show(self, place: Array | None, axis: Array | None = None) -> None:
        """Show the grip at a position (3,), m, with arcs to rotate an axis; None hides it."""
        if place is not None:
            self._gizmo.position = self._ball.position = triple(_MM * place)
        if axis is not None:
            first, second = across(axis)
            turn = np.stack([first, second, axis / np.linalg.norm(axis)], axis=1)
            self._gizmo.wxyz = transforms.SO3.from_matrix(turn).wxyz
        elif self._turning:
            self._gizmo.wxyz = (1.0, 0.0, 0.0, 0.0)
        if (axis is not None) != self._turning:
            self._turning = axis is not None
            self._gizmo.disable_rotations = not self._turning
        self._gizmo.visible = self._ball.visible = place is not None


# Width of the panel and its margin, over the height of a usual window; in a narrow one at most half
# of the width counts. Its width in pixels is unknown, as the pixel ratio of screens differs.
PANEL = 0.52
# Width over height of a window below which the panel is below the scene, and its share of the
# height there.
PHONE, LOW = 0.65, 0.55
# Named directions of view; in the first two, x points to the right.
VIEWS = {"Top": (0.0, -1e-3, 1.0), "Front": (0.0, -1.0, 0.0), "Side": (1.0, 0.0, 0.0)}
_WIDTH = 1.35  # width of the region shown, over the distance of the camera


@dataclass(frozen=True, eq=False)
class Shot:
    """View of a region: centre, distance and direction."""

    centre: Array
    distance: float
    way: Array
    height: float = 0.0
    """Height of the region relative to the distance, used in narrow windows."""


def framed(shot: Shot, width: float, height: float, fov: float) -> tuple[Array, Array]:
    """Camera position and target, mm, for a window of this size."""
    phone = width < PHONE * height
    free = width if phone else max(width - PANEL * height, 0.5 * width)
    across = 2.0 * np.tan(0.5 * fov) / height  # of a pixel, over the distance
    least = max(1.0, _WIDTH / (free * across))
    if phone:
        least = max(least, shot.height / ((1.0 - LOW) * height * across))
    distance = shot.distance * least
    direction = shot.way / np.linalg.norm(shot.way)
    right = np.cross([0.0, 0.0, 1.0], direction)
    right /= np.linalg.norm(right)
    aside = 0.5 * (width - free) * right
    if phone:
        aside = -0.5 * LOW * height * np.cross(direction, right)
    middle = shot.centre + across * distance * aside
    return middle + distance * direction, middle


def whole(whisker: Whisker) -> Shot:
    """View of the whole whisker."""
    length = float(to_display("length", whisker.length))
    middle = np.array([0.45, 0.1, 0.0]) * length
    return Shot(middle, 0.95 * length, np.array([0.15, -0.8, 0.6]), height=1.7)


class Framing:
    """Controller of the cameras of all browsers, including those that connect later."""

    def __init__(
        self, server: viser.ViserServer, viewed: Callable[[], None] = lambda: None
    ) -> None:
        self._server = server
        self._viewed = viewed
        self._goal: Shot | Array | None = None  # a shot, or a position and a target (6,), mm
        self.turned: Array | None = None
        """Camera position and target (6,) of the view changed last, mm."""
        self._placed: dict[int, tuple[int, int, Array]] = {}
        self._given: dict[int, list[Array]] = {}  # positions that each window was given
        self._lock = threading.RLock()  # a window may connect while all are being moved
        server.on_client_connect(self._came)

    def show(self, shot: Shot) -> None:
        """Point all cameras at a shot."""
        self._move(shot, None)

    def place(self, position: Array, target: Array) -> None:
        """Put all cameras at a position and point them at a target, mm."""
        placed = np.concatenate([position, target])
        self._move(placed, placed)

    def _move(self, goal: Shot | Array, turned: Array | None) -> None:
        with self._lock:
            self._goal, self.turned = goal, turned
            camera = self._server.initial_camera
            place, target = self._wanted(goal, 1280.0, 720.0, camera.fov)
            camera.position, camera.look_at = triple(place), triple(target)
            for client in self._server.get_clients().values():
                self._turn(client, goal)

    def _came(self, client: viser.ClientHandle) -> None:
        cameras = client.camera, self._server.initial_camera
        with self._lock:
            given = self._given.setdefault(client.client_id, [])
            given += [np.array(camera.position) for camera in cameras]
            if self._goal is not None:
                self._turn(client, self._goal)

        @client.camera.on_update
        async def _(camera: viser.CameraHandle) -> None:
            # When a window is resized, views that the user has turned are kept. A window may have
            # missed its newest camera position, and report an earlier or initial one.
            with self._lock:
                wide, tall, place = self._placed.get(client.client_id, (0, 0, np.zeros(3)))
                resized = (camera.image_width, camera.image_height) != (wide, tall)
                here = np.allclose(camera.position, place, atol=0.1)
                unturned = any(np.allclose(camera.position, p, atol=0.1) for p in given)
                goal = self._goal
                if goal is not None and unturned and (resized or not here):
                    self._turn(client, goal)
                if not unturned:
                    self.turned = np.concatenate([camera.position, camera.look_at])
                elif isinstance(goal, Shot):
                    self.turned = None
            self._viewed()

    def _turn(self, client: viser.ClientHandle, goal: Shot | Array) -> None:
        camera = client.camera
        wide, tall = camera.image_width, camera.image_height
        place, target = self._wanted(goal, wide, tall, camera.fov)
        self._placed[client.client_id] = wide, tall, place
        self._given.setdefault(client.client_id, []).append(place)
        with client.atomic():
            camera.position, camera.look_at = triple(place), triple(target)

    @staticmethod
    def _wanted(goal: Shot | Array, wide: float, tall: float, fov: float) -> tuple[Array, Array]:
        """Position and target, mm, of a camera with a window of this size."""
        if isinstance(goal, Shot):
            return framed(goal, wide, tall, fov)
        return goal[:3], goal[3:]


Job = Callable[[], None]


class Latest:
    """Worker thread with at most one pending job per topic, in order of due times."""

    def __init__(self, fault: Callable[[Exception], None]) -> None:
        self._fault = fault
        self._jobs: dict[str, tuple[float, Job]] = {}
        self._wake = threading.Condition()
        self._busy = False
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def put(self, topic: str, job: Job, due: float = 0.0) -> None:
        """Schedule a job, replacing a pending one of the same topic, unless closed."""
        with self._wake:
            if self._closed:
                return
            self._jobs[topic] = (due, job)
            self._wake.notify_all()

    def drop(self, topic: str) -> None:
        """Cancel the pending job of a topic."""
        with self._wake:
            self._jobs.pop(topic, None)
            self._wake.notify_all()

    def wait(self, timeout: float = 30.0) -> bool:
        """Wait up to ``timeout`` s until no job is pending; return whether this is the case."""
        with self._wake:
            return self._wake.wait_for(lambda: not self._jobs and not self._busy, timeout)

    def close(self) -> None:
        """Cancel pending jobs and end the thread."""
        with self._wake:
            self._closed = True
            self._jobs.clear()
            self._wake.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                while not self._closed:
                    first = min((due for due, _ in self._jobs.values()), default=inf)
                    if (pause := first - time.monotonic()) <= 0.0:
                        break
                    self._wake.wait(None if pause == inf else pause)
                if self._closed:
                    return
                self._busy = True
                topic = min(self._jobs, key=lambda name: self._jobs[name][0])
                _, job = self._jobs.pop(topic)
            try:
                job()
            except Exception as error:
                self._fault(error)  # one invalid input must not end the viewer


RATE = 25.0  # ticks per second


class Player:
    """Clock that calls back with the elapsed time while it plays, in its own thread."""

    def __init__(self, tick: Callable[[float], None]) -> None:
        self._tick = tick
        self._playing = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="player", daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        """Whether it plays."""
        return self._playing.is_set()

    def play(self) -> None:
        """Start the clock."""
        self._playing.set()

    def pause(self) -> None:
        """Stop the clock."""
        self._playing.clear()

    def close(self) -> None:
        """End the thread."""
        self._closed = True
        self._playing.set()
        self._thread.join(timeout=5.0)

    def _run(self) -> None:
        while not self._closed:
            if not self._playing.is_set():
                self._playing.wait()
            before = time.monotonic()
            while self._playing.is_set() and not self._closed:
                time.sleep(1.0 / RATE)
                now = time.monotonic()
                self._tick(now - before)
                before = now
