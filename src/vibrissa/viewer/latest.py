"""A thread that does what was asked last.

A mouse moves faster than some things can be computed. Jobs come by topic; one that has not begun
when the next of its topic comes is dropped, so that what is seen never lags behind the mouse. What
need not be done as often can be put off.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from math import inf

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
        """Wait until nothing is pending; tell whether that came true in time, s."""
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
        """How long nothing is due, s."""
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
