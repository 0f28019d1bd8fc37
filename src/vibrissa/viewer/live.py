"""Answers of a running stream, drawn as they come.

`vibrissa stream --send udp://HOST:PORT` sends each answer as a line of JSON. Of those that come
between two pictures only the newest is drawn; the contact points of all remain as a cloud. All of
it is in the whisker's frame.
"""

from __future__ import annotations

import contextlib
import json
import math
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any

import numpy as np

from vibrissa.rod import PointContact, deflect
from vibrissa.scene import Body, Cloud, Drawing, Mark, error_ellipsoid
from vibrissa.status import Status
from vibrissa.streaming import udp_address, udp_lines, udp_socket
from vibrissa.viewer.bend import NODES, force_arrow, mm, resting, whisker_body
from vibrissa.viewer.page import EXAGGERATION, Framing, whole
from vibrissa.viewer.readout import CLOUD, CONTACT, note, sentence, table
from vibrissa.viewer.stage import Stage

if TYPE_CHECKING:
    import viser

    from vibrissa.whisker import Whisker

_POINTS = 5000
"""Contact points that remain; those before are forgotten."""
_PICTURE = 0.05
"""Seconds between two pictures."""
_SIGMAS = 2.0
_WIDEST = 0.25
"""Largest semi-axis of an ellipsoid of uncertainty, over the whisker's length."""


class Live:
    """Answers of a stream so far, of one whisker; those of others, by name, are left out."""

    def __init__(self, whisker: Whisker, name: str = "") -> None:
        self.whisker, self.name = whisker, name
        self.newest: dict[str, Any] = {}
        self.number, self.faults = 0, 0
        self._points: deque[tuple[float, ...]] = deque(maxlen=_POINTS)

    def put(self, line: str) -> None:
        """Take one line; what is not an answer is counted."""
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
        """Draw the newest contact on the bent whisker, and the points of those before."""
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
        # At least as large as a point that is seen.
        widened = mm(mm(covariance)) + (size / _SIGMAS) ** 2 * np.eye(3)
        most = float(mm(_WIDEST * whisker.length))
        out["contact"] = Body(*error_ellipsoid(mm(point), widened, _SIGMAS, most), CONTACT, 0.6)
        return out

    def html(self) -> str:
        """State status, point and force of the newest answer, and how many there were."""
        answer = self.newest
        if not answer:
            return note("Waiting for answers of `vibrissa stream --send`.")
        status = answer["status"]
        rows = {
            name: answer[name]
            for name in ("r", "theta", "phi", "arc_length")
            if isinstance(answer.get(name), float)
        }
        faults = f", {self.faults} lines that are none" if self.faults else ""
        heading = note("Free whisker: the offset is taken.") if status is None else sentence(status)
        return heading + (table(rows) if rows else "") + note(f"{self.number} answers{faults}")


class LivePage:
    """Page that draws the answers which come to a UDP address until it is closed."""

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
        """Address at which answers are listened for."""
        host, port = self._socket.getsockname()[:2]
        return f"{host}:{port}"

    def _follow(self) -> None:
        lines, shown, due = udp_lines(self._socket), 0, 0.0
        while self._open:
            try:
                self.live.put(next(lines))
            except TimeoutError:  # a generator that has raised is at its end
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
