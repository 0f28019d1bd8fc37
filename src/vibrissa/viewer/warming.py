"""On a fresh installation kernels are compiled ahead of who asks for them, and the page says so.

What bends a whisker by a point is compiled when the page starts. Pegs, candidates and their errors
take most of a minute more; they are gone through once in a thread of their own, so that it is over
before they are asked for, or nearly so.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

from numba.core import event

from vibrissa.viewer.bending import loaded, with_radius
from vibrissa.viewer.locating import coloured, located, usual_sensor
from vibrissa.viewer.page import Page

Job = Callable[[], object]

_done = threading.Event()
"""Set once this process has gone through all: kernels stay."""


def rehearsal(page: Page) -> list[Job]:
    """What someone may ask of a page, as jobs that change nothing."""
    bend = page.bend

    def locate() -> None:
        page.settle(600.0)
        if (chart := page.chart) is not None:
            sensor = usual_sensor(chart.whisker)
            located(chart, page.bend_by_point(), sensor)
            coloured(chart, "sensitivity", sensor)

    return [
        lambda: loaded(bend, "peg"),
        lambda: with_radius(loaded(bend, "peg"), 0.01 * bend.whisker.length),
        lambda: loaded(bend, "force"),
        locate,
    ]


class Warming(event.Listener):
    """Goes through jobs in a thread of its own, and tells when kernels are being compiled."""

    def __init__(self, told: Callable[[bool], None]) -> None:
        self._told = told
        self._lock = threading.Lock()
        self._depth = 0
        self._running = self._said = self._closed = False
        event.register("numba:compile", self)

    def start(self, jobs: Sequence[Job]) -> None:
        """Go through jobs, once in a process; what fails will fail where it counts."""
        if not _done.is_set():
            self._running = True
            threading.Thread(target=self._run, args=(jobs,), name="warming", daemon=True).start()

    def _run(self, jobs: Sequence[Job]) -> None:
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
            self._tell(0)

    def on_start(self, event: event.Event) -> None:
        """Hear that Numba begins to compile something."""
        if _ours(event):
            self._tell(+1)

    def on_end(self, event: event.Event) -> None:
        """Hear that it has done so."""
        if _ours(event):
            self._tell(-1)

    def _tell(self, step: int) -> None:
        with self._lock:
            self._depth += step
            busy = self._depth > 0 or (self._said and self._running)
            if busy != self._said and not self._closed:
                self._said = busy
                self._told(busy)

    def close(self) -> None:
        """Begin no more jobs, and tell nothing."""
        self._closed = True
        event.unregister("numba:compile", self)


def _ours(event: event.Event) -> bool:
    dispatcher = (event.data or {}).get("dispatcher")
    function = getattr(dispatcher, "py_func", None)
    return (getattr(function, "__module__", "") or "").startswith("vibrissa.")
