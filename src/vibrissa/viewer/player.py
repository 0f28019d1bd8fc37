"""A clock that goes on while something plays."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

RATE = 25.0
"""Ticks per second."""


class Player:
    """Tells the time that has passed while it plays, in a thread of its own."""

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
