"""Threads of the page: the job asked for last, a clock that plays, kernels compiled ahead."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from math import inf

from numba.core import event

Job = Callable[[], None]


class Latest:
    """One thread, one pending job per topic, the one that is due first comes first."""

    def __init__(self, fault: Callable[[Exception], None]) -> None:
        self._fault = fault
        self._jobs: dict[str, tuple[float, Job]] = {}
        self._wake = threading.Condition()
        self._busy = False
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def put(self, topic: str, job: Job, due: float = 0.0) -> None:
        """Ask for a job, in place of a pending one of the same topic; not once it is closed."""
        with self._wake:
            if self._closed:
                return
            self._jobs[topic] = (due, job)
            self._wake.notify_all()

    def drop(self, topic: str) -> None:
        """Take back what is pending of a topic."""
        with self._wake:
            self._jobs.pop(topic, None)
            self._wake.notify_all()

    def wait(self, timeout: float = 30.0) -> bool:
        """Wait until nothing is pending; return whether that happened in time, s."""
        with self._wake:
            return self._wake.wait_for(lambda: not self._jobs and not self._busy, timeout)

    def close(self) -> None:
        """Drop what is pending and end the thread."""
        with self._wake:
            self._closed = True
            self._jobs.clear()
            self._wake.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _pause(self) -> float:
        """Time for which nothing is due, s."""
        first = min((due for due, _ in self._jobs.values()), default=inf)
        return first - time.monotonic()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                while not self._closed and (pause := self._pause()) > 0.0:
                    self._wake.wait(None if pause == inf else pause)
                if self._closed:
                    return
                self._busy = True
                topic = min(self._jobs, key=lambda name: self._jobs[name][0])
                _, job = self._jobs.pop(topic)
            try:
                job()
            except Exception as error:
                # A window must not die of one bad input.
                self._fault(error)


RATE = 25.0
"""Ticks per second."""


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
        """Let time go on."""
        self._playing.set()

    def pause(self) -> None:
        """Let it stand still."""
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


Rehearsal = Callable[[], object]

_done = threading.Event()
"""Set once this process has gone through all: kernels stay."""


class CompileNotice(event.Listener):
    """Runs jobs in its own thread, and reports when kernels are being compiled."""

    def __init__(self, report: Callable[[bool], None]) -> None:
        self._report = report
        self._lock = threading.Lock()
        self._depth = 0
        self._running = self._reported = self._closed = False
        event.register("numba:compile", self)

    def start(self, jobs: Sequence[Rehearsal]) -> None:
        """Go through jobs, once in a process; what fails will fail where it counts."""
        if not _done.is_set():
            self._running = True
            threading.Thread(target=self._run, args=(jobs,), name="warming", daemon=True).start()

    def _run(self, jobs: Sequence[Rehearsal]) -> None:
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
        """Hear that Numba begins to compile something."""
        if _ours(event):
            self._count(+1)

    def on_end(self, event: event.Event) -> None:
        """Hear that it has done so."""
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
        """Begin no more jobs, and report nothing."""
        self._closed = True
        event.unregister("numba:compile", self)


def _ours(event: event.Event) -> bool:
    dispatcher = (event.data or {}).get("dispatcher")
    function = getattr(dispatcher, "py_func", None)
    return (getattr(function, "__module__", "") or "").startswith("vibrissa.")
