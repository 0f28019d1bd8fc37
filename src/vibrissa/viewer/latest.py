"""A thread that does what was asked last.

A mouse moves faster than some things can be computed. Jobs come by topic; one that has not begun
when the next of its topic comes is dropped, so that what is seen never lags behind the mouse.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

Job = Callable[[], None]


class Latest:
    """One thread, one pending job per topic, the oldest topic first.

    Parameters
    ----------
    fault : callable
        Called with an exception that a job raised; the thread goes on.
    """

    def __init__(self, fault: Callable[[Exception], None]) -> None:
        self._fault = fault
        self._jobs: dict[str, Job] = {}
        self._wake = threading.Condition()
        self._busy = False
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    def put(self, topic: str, job: Job) -> None:
        """Ask for a job, in place of a pending one of the same topic; not once it is closed."""
        with self._wake:
            if self._closed:
                return
            self._jobs[topic] = job
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

    def _run(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                self._wake.wait_for(lambda: bool(self._jobs) or self._closed)
                if self._closed:
                    return
                self._busy = True
                topic = next(iter(self._jobs))
                job = self._jobs.pop(topic)
            try:
                job()
            except Exception as error:
                # A window must not die of one bad input.
                self._fault(error)
