"""Local web server of the viewer, and display of running streams.

Results of a running stream are drawn as they arrive: `vibrissa stream --send udp://HOST:PORT` sends
each result as a line of JSON. Of the results between two updates only the newest is drawn; the
contact points of all remain as a cloud. All coordinates are in the whisker frame.
"""

from __future__ import annotations

import contextlib
import errno
import io
import ipaddress
import json
import math
import os
import socket
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from os import PathLike
from typing import Any, Self
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import viser
import xarray as xr
from numba.core import event
from numpy.typing import ArrayLike

from vibrissa.contacts import ContactMap
from vibrissa.io import Footage
from vibrissa.rod import PointContact, deflect
from vibrissa.scene import Body, Cloud, Drawing, Mark, error_ellipsoid
from vibrissa.status import Status
from vibrissa.streaming import udp_address, udp_lines, udp_socket
from vibrissa.viewer.bend import (
    NODES,
    BendMode,
    WhiskerControls,
    force_arrow,
    mm,
    resting,
    whisker_body,
)
from vibrissa.viewer.locate import LocateMode, coloured, located, usual_sensor
from vibrissa.viewer.map import MapMode
from vibrissa.viewer.page import EXAGGERATION, VIEWS, Framing, Mode, Page, whole
from vibrissa.viewer.readout import CLOUD, CONTACT, instructions, note, sentence, table
from vibrissa.viewer.save import SaveControls, amended
from vibrissa.viewer.stage import Stage, lit
from vibrissa.viewer.state import loaded, moved, with_radius
from vibrissa.viewer.trial import TrialMode, Watched, watched
from vibrissa.whisker import Whisker

HOST = "127.0.0.1"
PORT = 8080

_HERE = "● "  # mark of the chosen mode
_COMPILING = (
    "Compiling, once for this installation, which takes a minute or two. Pegs, candidates and "
    "their errors follow when their part is ready."
)


class Served:
    """Handle of a served page; a context manager that stops it.

    Parameters
    ----------
    page : Page or LivePage
        Page that is served.
    """

    def __init__(self, page: Page | LivePage) -> None:
        self.shown = page

    @property
    def url(self) -> str:
        """Address of the page."""
        server = self.shown.server
        host = server.get_host()
        shown = "127.0.0.1" if host in ("0.0.0.0", "") else host
        return f"http://{f'[{shown}]' if ':' in shown else shown}:{server.get_port()}"

    def wait(self) -> None:
        """Serve until interrupted."""
        while True:
            time.sleep(3600.0)

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a message
            self.shown.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class Viewer(Served):
    """Handle of a served page of a whisker, a map or a trial; a context manager that stops it.

    Parameters
    ----------
    page : Page
        Page that is served.
    """

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self.page = page

    def put_contact(self, point: ArrayLike) -> None:
        """Set the requested contact point, as by dragging.

        Parameters
        ----------
        point : array_like (3,)
            Whisker frame, m.
        """
        self.page.change("drag", lambda bend: moved(loaded(bend, "point"), point))
        self.page.work.wait()


def view_stream(
    whisker: Whisker, address: str, *, name: str = "", host: str = HOST, port: int | None = None
) -> Served:
    """Serve a page that draws the results of a running stream as they arrive.

    Parameters
    ----------
    whisker : Whisker
        Whisker of the stream.
    address : str
        UDP address ``HOST:PORT`` to which ``vibrissa stream --send`` sends its results.
    name : str
        Name of the whisker, if the stream is of several.
    host : str
        Address to serve the page on; the default can only be reached from this machine.
    port : int, optional
        Port to serve the page on; by default the first free one from 8080.

    Returns
    -------
    Served
        Handle of the running server; close it to stop.

    Raises
    ------
    ValueError
        If one of the two addresses is invalid or taken.
    """
    with contextlib.ExitStack() as opened:
        live = LivePage(_served(host, port, opened, lambda _: None), Live(whisker, name), address)
        opened.pop_all()
    return Served(live)


def view(
    shown: Whisker | ContactMap | xr.DataTree,
    *,
    contact_map: ContactMap | None = None,
    recording: xr.DataTree | None = None,
    videos: Sequence[str | PathLike[str]] = (),
    host: str = HOST,
    port: int | None = None,
) -> Viewer:
    """Serve a page on which a whisker is bent, its contact map explored, and a trial replayed.

    Parameters
    ----------
    shown : Whisker, ContactMap or DataTree
        Whisker, contact map or recording to show; of a recording the whisker with the most frames
        in contact.
    contact_map : ContactMap, optional
        Map of the whisker; by default it is computed.
    recording : DataTree, optional
        Trial to show in addition to another whisker or a map.
    videos : sequence of path
        Videos of the recording, one for each of its cameras, in their order.
    host : str
        Address to listen on; the default can only be reached from this machine.
    port : int, optional
        Port to listen on; by default the first free one from 8080.

    Returns
    -------
    Viewer
        Handle of the running server; close it to stop.

    Raises
    ------
    ValueError
        If ``shown`` is of another type, a map or recording is given twice, the map is that of
        another whisker, the recording has no frames, the numbers of videos and cameras differ, or
        the port is taken or not on this machine.
    """
    if isinstance(shown, xr.DataTree):
        if recording is not None:
            raise ValueError("got two recordings; give one")
        recording = shown
    elif isinstance(shown, ContactMap):
        if contact_map is not None:
            raise ValueError("got two maps; give one")
        contact_map = shown
    elif not isinstance(shown, Whisker):
        raise ValueError(
            "what is shown is a Whisker, a ContactMap or a recording (DataTree); got "
            f"{type(shown).__name__}. Files are opened by load_whisker, ContactMap.load and "
            "load_recording, or by `vibrissa view FILE`"
        )
    trial = None if recording is None else watched(recording)
    if isinstance(shown, Whisker):
        whisker = shown
    elif contact_map is not None:
        whisker = contact_map.whisker
    else:
        assert trial is not None  # there is nothing else
        whisker = trial.whiskers[trial.busiest]
    if contact_map is not None and contact_map.whisker is not whisker:
        whisker = _of_one(contact_map, whisker)
    with contextlib.ExitStack() as opened:  # closed again if a later step fails
        footage = _footage(trial, videos, opened)

        def restore(asked: dict[str, str]) -> None:
            page.restore(asked)

        page = Page(_served(host, port, opened, restore), whisker, contact_map)
        opened.pop_all()
        page.closing += [film.close for film in footage]
        viewer = Viewer(page)
        opened.push(viewer)
        _furnished(page, recording, trial, footage)
        opened.pop_all()
    return viewer


def _of_one(contact_map: ContactMap, whisker: Whisker) -> Whisker:
    """Whisker of a map; raise ValueError if it is another than the requested one."""
    own = contact_map.whisker
    names = ("length", "base_radius", "tip_radius", "youngs_modulus")
    same = all(np.isclose(getattr(own, name), getattr(whisker, name)) for name in names)
    if not (same and np.allclose(own.centerline(20), whisker.centerline(20), atol=1e-9)):
        raise ValueError(
            f"the map is that of another whisker ({1e3 * own.length:.3f} mm long, this one "
            f"{1e3 * whisker.length:.3f} mm); omit it to have one computed"
        )
    return own


def _furnished(
    page: Page, recording: xr.DataTree | None, trial: Watched | None, footage: Sequence[Footage]
) -> None:
    """Add controls and modes to a page, and start with the most informative mode."""
    names = ("Bend", "Locate", "Map") if trial is None else ("Bend", "Locate", "Map", "Trial")
    choice = page.server.gui.add_button_group("Mode", names)
    choice.on_click(lambda event: page.choose(event.target.value.removeprefix(_HERE)))

    def chosen(name: str) -> None:
        choice.options = tuple(_HERE + each if each == name else each for each in names)

    page.chosen = chosen
    turned = page.server.gui.add_button_group("View", ("All", *VIEWS))
    turned.on_click(lambda event: page.turn(event.target.value))
    notice = page.server.gui.add_html(note(_COMPILING), visible=False)
    modes: list[Mode] = [BendMode(page), LocateMode(page), MapMode(page)]
    if trial is not None:
        modes.append(TrialMode(page, trial, footage))
    page.modes = {mode.name: mode for mode in modes}
    page.whisker_controls = WhiskerControls(page).folder
    SaveControls(page, recording)
    with page.server.gui.add_folder("Help", expand_by_default=False):
        page.server.gui.add_html(instructions(trial is not None))
    page.linked = page.server.gui.add_html("")
    page.choose("Trial" if trial is not None else "Map" if page.has_map else "Bend")
    page.work.wait()  # kernels are compiled one at a time, those of the first view before others
    page.prepare()

    def report(busy: bool) -> None:
        notice.visible = busy

    warming = CompileNotice(report)
    page.closing.append(warming.close)
    warming.start(rehearsal(page))


def rehearsal(page: Page) -> list[Callable[[], object]]:
    """Jobs that run typical requests of a page without changing it, to compile kernels."""
    bend = page.bend

    def locate() -> None:
        page.settle(600.0)
        if (chart := page.chart) is not None:
            sensor = usual_sensor(chart.whisker)
            located(chart, loaded(page.bend, "point"), sensor)
            coloured(chart, "sensitivity", sensor)

    return [
        lambda: loaded(bend, "peg"),
        lambda: with_radius(loaded(bend, "peg"), 0.01 * bend.whisker.length),
        lambda: loaded(bend, "force"),
        locate,
    ]


def _footage(
    trial: Watched | None, videos: Sequence[str | PathLike[str]], opened: contextlib.ExitStack
) -> tuple[Footage, ...]:
    """Open the videos of a trial."""
    if not videos:
        return ()
    if trial is None or len(videos) != len(trial.cameras):
        count = 0 if trial is None else len(trial.cameras)
        raise ValueError(f"the trial has {count} cameras; got {len(videos)} videos")
    return tuple(opened.enter_context(contextlib.closing(Footage(path))) for path in videos)


Restore = Callable[[dict[str, str]], None]  # called with the parameters of a link


def _served(
    host: str, port: int | None, opened: contextlib.ExitStack, restore: Restore
) -> viser.ViserServer:
    if port is None:
        port = free_port(host)
    elif not is_free(host, port):  # viser would silently use another one
        raise ValueError(f"port {port} of {host} is in use; omit it for a free one")
    with guarded(host, restore), contextlib.redirect_stdout(io.StringIO()):  # viser prints its URL
        server = viser.ViserServer(host=host, port=port, label="vibrissa", verbose=False)
    opened.callback(server.stop)
    server.gui.configure_theme(
        control_width="large", show_logo=False, show_share_button=False, brand_color=(0, 114, 178)
    )
    server.scene.set_up_direction("+z")
    server.scene.world_axes.visible = False
    lit(server.scene)
    return server


def free_port(host: str) -> int:
    """First free port from the default one on."""
    for port in range(PORT, PORT + 200):
        if is_free(host, port):
            return port
    raise OSError(f"no free port from {PORT} to {PORT + 199} on {host}")


def is_free(host: str, port: int) -> bool:
    """Whether a port is free."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        if os.name == "posix":  # a port that was released a moment ago is free
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
                return False
            raise ValueError(f"no page can be served at port {port} of {host}: {error}") from error
    return True


_ONE_AT_A_TIME = threading.Lock()


def is_loopback(host: str) -> bool:
    """Whether an address or name is a loopback address of this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def from_own_page(origin: str | None, asked: str | None, host: str) -> bool:
    """Whether a request comes from a page of this server, or not from a browser."""
    if origin is None:
        return True
    try:
        page = urlsplit(origin)
        name = page.hostname
    except ValueError:
        return False
    if not name or asked is None or page.netloc.lower() != asked.lower():
        return False
    return is_loopback(name) or not is_loopback(host)


@contextmanager
def guarded(host: str, restore: Restore) -> Iterator[None]:
    """Context in which started servers reject requests of other pages, and handle links.

    viser has no hook for such a check, so the function by which it listens is wrapped as it starts.
    """
    from websockets.asyncio import server

    module: Any = server
    plain = module.serve
    used = []

    def serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        used.append(True)

        def checked(connection: Any, request: Any) -> Any:
            headers = request.headers
            if not from_own_page(headers.get("Origin"), headers.get("Host"), host):
                return connection.respond(HTTPStatus.FORBIDDEN, "This is for its own page only.\n")
            asked = urlsplit(request.path)
            if asked.path == "/restore" and headers.get("Sec-Fetch-Site") in (None, "same-origin"):
                restore(dict(parse_qsl(asked.query)))
                return connection.respond(HTTPStatus.OK, "")
            if process_request is None:
                return None
            return amended(process_request(connection, request))

        return plain(*args, process_request=checked, **options)

    with _ONE_AT_A_TIME:
        module.serve = serve
        try:
            yield
        finally:
            module.serve = plain
    if not used:
        warnings.warn(
            "with this version of viser, other web pages in this browser can talk to this one",
            stacklevel=2,
        )


_POINTS = 5000  # number of contact points kept, the newest ones
_PICTURE = 0.05  # interval between two updates of the scene, s
_SIGMAS = 2.0
_WIDEST = 0.25  # largest semi-axis of an ellipsoid of uncertainty, over the whisker's length


class Live:
    """Results of a stream for one whisker; those of other names are ignored."""

    def __init__(self, whisker: Whisker, name: str = "") -> None:
        self.whisker, self.name = whisker, name
        self.newest: dict[str, Any] = {}
        self.number, self.faults = 0, 0
        self._points: deque[tuple[float, ...]] = deque(maxlen=_POINTS)

    def put(self, line: str) -> None:
        """Process one line; invalid lines are counted."""
        try:
            answer = json.loads(line)
            status = Status[answer["status"].upper()] if answer["status"] != "tare" else None
            point = tuple(float(answer.get(axis, math.nan)) for axis in "xyz")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            self.faults += 1
            return
        if self.name and answer.get("whisker") != self.name:
            return
        self.newest, self.number = answer | {"status": status, "point": point}, self.number + 1
        if np.isfinite(point).all():
            self._points.append(point)

    def drawing(self, exaggeration: float) -> Drawing:
        """Draw the newest contact with the bent whisker, and earlier contact points."""
        whisker, answer = self.whisker, self.newest
        out: dict[str, Mark] = dict(resting(whisker, exaggeration))
        size = float(mm(0.011 * whisker.length))
        if self._points:
            colours = np.tile(np.array(CLOUD, dtype=np.uint8), (len(self._points), 1))
            out["points"] = Cloud(mm(np.array(self._points)), colours, size)
        point = np.array(answer.get("point", (math.nan,)))
        if not np.isfinite(point).all():
            return out
        bent = deflect(whisker, PointContact(point))
        if Status(int(bent.status)).ok:
            out["whisker"] = whisker_body(whisker, bent.centerline(NODES), exaggeration)
            out |= force_arrow(whisker, np.asarray(answer.get("force", bent.force)), point)
        covariance = np.array(answer.get("covariance", np.full((3, 3), np.nan)), dtype=np.float64)
        if not np.isfinite(covariance).all():
            covariance = np.zeros((3, 3))
        # The ellipsoid is at least as large as a visible point.
        widened = mm(mm(covariance)) + (size / _SIGMAS) ** 2 * np.eye(3)
        most = float(mm(_WIDEST * whisker.length))
        out["contact"] = Body(*error_ellipsoid(mm(point), widened, _SIGMAS, most), CONTACT, 0.6)
        return out

    def html(self) -> str:
        """HTML with status, point and force of the newest result, and the number of results."""
        answer = self.newest
        if not answer:
            return note("Waiting for results of `vibrissa stream --send`.")
        status = answer["status"]
        rows = {
            name: answer[name]
            for name in ("r", "theta", "phi", "arc_length")
            if isinstance(answer.get(name), float)
        }
        faults = f", {self.faults} unreadable lines" if self.faults else ""
        free = "The whisker is free; the sensor's offset is being determined."
        heading = note(free) if status is None else sentence(status)
        return heading + (table(rows) if rows else "") + note(f"{self.number} results{faults}")


class LivePage:
    """Page that draws the results arriving at a UDP address until it is closed."""

    def __init__(self, server: viser.ViserServer, live: Live, address: str) -> None:
        self.server, self.live = server, live
        self._stage = Stage(server)
        Framing(server).show(whole(live.whisker))
        self._text = server.gui.add_html(live.html())
        self._socket = udp_socket(*udp_address(address))
        self._socket.settimeout(_PICTURE)
        self._stage.show("live", live.drawing(EXAGGERATION))
        self._open = True
        self._thread = threading.Thread(target=self._follow, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """UDP address at which results are received."""
        host, port = self._socket.getsockname()[:2]
        return f"{host}:{port}"

    def _follow(self) -> None:
        lines, shown, due = udp_lines(self._socket), 0, 0.0
        while self._open:
            try:
                self.live.put(next(lines))
            except TimeoutError:  # which ends a generator
                lines = udp_lines(self._socket)
            except OSError:  # closed
                return
            if (now := time.monotonic()) >= due and shown != self.live.number:
                shown, due = self.live.number, now + _PICTURE
                self._stage.show("live", self.live.drawing(EXAGGERATION))
                self._text.content = self.live.html()

    def close(self) -> None:
        """Stop listening and serving."""
        self._open = False
        self._thread.join(timeout=5.0)
        with contextlib.suppress(OSError):
            self._socket.close()
        self.server.stop()


_done = threading.Event()  # set once all jobs have run in this process, whose kernels remain


class CompileNotice(event.Listener):
    """Runner of jobs in a thread, which reports when kernels are being compiled."""

    def __init__(self, report: Callable[[bool], None]) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._depth = 0
        self._running = self._reported = self._closed = False
        event.register("numba:compile", self)

    def start(self, jobs: Sequence[Callable[[], object]]) -> None:
        """Run jobs, once per process, ignoring errors, which occur again when a job is needed."""
        if not _done.is_set():
            self._running = True
            threading.Thread(target=self._run, args=(jobs,), name="warming", daemon=True).start()

    def _run(self, jobs: Sequence[Callable[[], object]]) -> None:
        try:
            for job in jobs:
                if self._closed:
                    return
                job()
            _done.set()
        except Exception:
            return
        finally:
            self._running = False
            self._count(0)

    def on_start(self, event: event.Event) -> None:
        """Handle the start of a compilation by Numba."""
        if _ours(event):
            self._count(+1)

    def on_end(self, event: event.Event) -> None:
        """Handle the end of a compilation by Numba."""
        if _ours(event):
            self._count(-1)

    def _count(self, step: int) -> None:
        with self._lock:
            self._depth += step
            busy = self._depth > 0 or (self._reported and self._running)
            if busy != self._reported and not self._closed:
                self._reported = busy
                self._report(busy)

    def close(self) -> None:
        """Start no more jobs and stop reporting."""
        self._closed = True
        event.unregister("numba:compile", self)


def _ours(event: event.Event) -> bool:
    dispatcher = (event.data or {}).get("dispatcher")
    function = getattr(dispatcher, "py_func", None)
    return (getattr(function, "__module__", "") or "").startswith("vibrissa.")
