"""A window in which a person marks where a whisker is: points from base to tip, frame by frame.

The logic is in `Correction`, which needs only a figure; it works without a screen. `correct` opens
a window on one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

import numpy as np
from matplotlib.backend_bases import Event, KeyEvent, MouseEvent
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from vibrissa.plots.style import BLUE, GREEN, ORANGE

Array = NDArray[np.float64]

Key = tuple[int, int]
"""Frame and whisker."""

Save = Callable[[dict[Key, Array]], None]

HELP = (
    "click: point, base to tip · right click: remove nearest · ←/→ frame · ↑/↓ 10 frames · "
    "l next lost · 0–9 whisker\nu undo · d delete all of this frame · s save · q save and close · "
    "esc close without saving"
)

_SAME = 2.0
"""Clicks nearer than this to another point are double clicks, pixels."""


class Frames(Protocol):
    """Frames by number, such as a list or `vibrissa.io.FrameReader`."""

    def __getitem__(self, number: int, /) -> NDArray[np.uint8]:
        """Give a frame; an ``IndexError`` where there is none."""


class Correction:
    """Corrected points of one view, and the figure in which they are made."""

    def __init__(
        self,
        frames: Frames,
        count: int,
        corrections: Mapping[Key, ArrayLike] | None = None,
        traces: Mapping[Key, ArrayLike] | None = None,
        save: Save | None = None,
        figure: Figure | None = None,
    ) -> None:
        if count < 1:
            raise ValueError(f"there are {count} frames; at least one is needed")
        self.frame, self.whisker, self.changed = 0, 0, False
        self._frames, self._count = frames, count
        self._points: dict[Key, list[tuple[float, float]]] = {
            key: [(float(x), float(y)) for x, y in np.asarray(points)]
            for key, points in (corrections or {}).items()
        }
        self._before: list[tuple[Key, list[tuple[float, float]]]] = []
        self._traces = traces or {}
        self._save = save
        self._said = ""
        self.figure = figure or Figure()
        self._axes = self.figure.add_axes((0.0, 0.06, 1.0, 0.88))
        self._axes.set_axis_off()
        self._image = self._axes.imshow(frames[0], cmap="gray", vmin=0, vmax=255)
        (self._trace,) = self._axes.plot([], [], color=BLUE, lw=0.8)
        (self._line,) = self._axes.plot([], [], "o-", color=ORANGE, ms=4, lw=0.8, mfc="none")
        (self._base,) = self._axes.plot([], [], "o", color=GREEN, ms=5)
        self.figure.text(0.5, 0.03, HELP, ha="center", va="center", fontsize=7)
        self.figure.canvas.mpl_connect("button_press_event", self._clicked)
        self.figure.canvas.mpl_connect("key_press_event", self._pressed)
        self._draw()

    @property
    def corrections(self) -> dict[Key, Array]:
        """All corrections that have at least two points, by frame and whisker."""
        return {key: np.array(p) for key, p in sorted(self._points.items()) if len(p) >= 2}

    def go(self, frame: int) -> None:
        """Show another frame."""
        self.frame = min(max(frame, 0), self._count - 1)
        self._draw()

    def next_lost(self) -> None:
        """Show the next frame in which the whisker is neither traced nor corrected."""
        for frame in range(self.frame + 1, self._count):
            if (frame, self.whisker) not in self._points and not len(self._known(frame)):
                self.go(frame)
                return
        self._said = "no frame after this one is lost"
        self._draw()

    def add(self, x: float, y: float) -> None:
        """Add a point beyond the last."""
        key = (self.frame, self.whisker)
        points = self._points.get(key, [])
        if any(np.hypot(x - a, y - b) < _SAME for a, b in points):
            return
        self._change(key, [*points, (x, y)])

    def remove(self, x: float, y: float) -> None:
        """Remove the point that is nearest."""
        key = (self.frame, self.whisker)
        points = self._points.get(key, [])
        if points:
            nearest = int(np.argmin([np.hypot(x - a, y - b) for a, b in points]))
            self._change(key, points[:nearest] + points[nearest + 1 :])

    def delete(self) -> None:
        """Remove all points of this frame and whisker."""
        if self._points.get((self.frame, self.whisker)):
            self._change((self.frame, self.whisker), [])

    def undo(self) -> None:
        """Take the last change back, and show where it was."""
        if not self._before:
            self._said = "nothing to undo"
            self._draw()
            return
        key, points = self._before.pop()
        self._put(key, points)
        (self.frame, self.whisker), self.changed = key, True
        self._draw()

    def choose(self, whisker: int) -> None:
        """Turn to another whisker."""
        self.whisker = whisker
        self._draw()

    def save(self) -> None:
        """Hand over what is corrected; traces of one point are kept here, but not saved."""
        single = sum(len(points) == 1 for points in self._points.values())
        if self._save is not None:
            self._save(self.corrections)
        self.changed = False
        self._said = f"saved {len(self.corrections)} traces"
        if single:
            self._said += f"; {single} with one point are left out"
        self._draw()

    def _change(self, key: Key, points: list[tuple[float, float]]) -> None:
        self._before.append((key, self._points.get(key, [])))
        self._put(key, points)
        self.changed = True
        self._draw()

    def _put(self, key: Key, points: list[tuple[float, float]]) -> None:
        if points:
            self._points[key] = points
        else:
            self._points.pop(key, None)

    def _known(self, frame: int) -> Array:
        """The trace of a frame; empty where it is lost."""
        line = np.asarray(self._traces.get((frame, self.whisker), np.empty((0, 2))))
        return line if np.isfinite(line).all() else np.empty((0, 2))

    def _shown(self) -> NDArray[np.uint8]:
        """The frame; the last one if the video holds fewer frames than its header states."""
        while True:
            try:
                return self._frames[self.frame]
            except IndexError as error:
                if self.frame == 0:
                    raise
                self._count, self._said = self.frame, str(error)
                self.frame -= 1

    def _draw(self) -> None:
        self._image.set_data(self._shown())
        points = np.array(self._points.get((self.frame, self.whisker), np.empty((0, 2))))
        self._line.set_data(*points.reshape(-1, 2).T)
        self._base.set_data(*points.reshape(-1, 2)[:1].T)
        self._trace.set_data(*self._known(self.frame).T)
        text = f"frame {self.frame} of {self._count}, whisker {self.whisker}"
        text += f", {len(points)} points" if len(points) else ""
        text += " · not saved" if self.changed else ""
        text += f" · {self._said}" if self._said else ""
        self._axes.set_title(text, fontsize=9)
        self._said = ""
        self.figure.canvas.draw_idle()

    def _clicked(self, event: Event) -> None:
        assert isinstance(event, MouseEvent)
        toolbar = getattr(self.figure.canvas, "toolbar", None)
        if event.inaxes is not self._axes or (toolbar is not None and toolbar.mode):
            return
        assert event.xdata is not None
        assert event.ydata is not None
        if event.button == 1:
            self.add(float(event.xdata), float(event.ydata))
        elif event.button == 3:
            self.remove(float(event.xdata), float(event.ydata))

    def _pressed(self, event: Event) -> None:
        assert isinstance(event, KeyEvent)
        key = event.key or ""
        if key.isdigit():
            self.choose(int(key))
        elif key in _STEPS:
            self.go(self.frame + _STEPS[key])
        elif key in _KEYS:
            getattr(self, _KEYS[key])()

    def close(self, event: Any = None) -> None:
        """Save what is not saved; to be called when the window is closed."""
        if self.changed:
            self.save()

    def discard(self) -> None:
        """Forget that there is anything to save."""
        self.changed = False


_STEPS: Mapping[str, int] = MappingProxyType({"right": 1, "left": -1, "up": 10, "down": -10})
_KEYS: Mapping[str, str] = MappingProxyType(
    {
        "u": "undo",
        "ctrl+z": "undo",
        "d": "delete",
        "delete": "delete",
        "s": "save",
        "ctrl+s": "save",
        "l": "next_lost",
        "q": "close",
        "escape": "discard",
    }
)


class _Window(Protocol):
    def close(self, event: Any = None) -> None:
        """Save what is not saved."""


W = TypeVar("W", bound=_Window)


def opened(make: Callable[[Figure], W], instead: str, size: tuple[float, float]) -> W:
    """Open a window, wait until it is closed, and return it; without a screen tell what to do."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=size)
    try:
        manager = figure.canvas.manager
        if manager is None or mpl.get_backend().lower() in ("agg", "pdf", "svg", "ps", "cairo"):
            raise ValueError(
                f"there is no screen for a window: {instead}, or run this where there is one"
            )
        # Matplotlib's own keys do other things with s, q, l and the arrows.
        handler = getattr(manager, "key_press_handler_id", None)
        if handler is not None:
            figure.canvas.mpl_disconnect(handler)
        window = make(figure)
        figure.canvas.mpl_connect("close_event", window.close)

        def leave(event: Event) -> None:
            if isinstance(event, KeyEvent) and event.key in ("q", "escape"):
                plt.close(figure)

        figure.canvas.mpl_connect("key_press_event", leave)
        plt.show()
    finally:
        plt.close(figure)
    return window


def correct(
    frames: Frames,
    count: int,
    corrections: Mapping[Key, ArrayLike] | None = None,
    traces: Mapping[Key, ArrayLike] | None = None,
    save: Save | None = None,
) -> dict[Key, Array]:
    """Open a window to correct traces in, and wait until it is closed."""
    window = opened(
        lambda figure: Correction(frames, count, corrections, traces, save, figure),
        "write the corrections as a table view,frame,whisker,x,y",
        (9.0, 9.0),
    )
    return window.corrections
