"""Windows for marking whiskers, areas and lengths in images.

`correct` opens a window for marking whiskers frame by frame, with points from base to tip; `pick`
one for marking the bases of whiskers, areas without whiskers, and the scale. `Correction` and
`Picking` contain the logic, need only a figure, and work without a screen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from matplotlib.backend_bases import Event, KeyEvent, MouseEvent
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from vibrissa.io import Clicks, FrameReader, ViewClicks
from vibrissa.numerics import Array
from vibrissa.plots.style import BLUE, GREEN, ORANGE, RED

Key = tuple[int, int]  # frame and whisker
Save = Callable[[dict[Key, Array]], None]

HELP = (
    "click: point, base to tip · right click: remove nearest · ←/→ frame · ↑/↓ 10 frames · "
    "l next lost · 0–9 whisker\nu undo · d delete all of this frame · s save · q save and close · "
    "esc close without saving"
)

_SAME = 2.0  # clicks nearer than this to another point are double clicks, pixels


Frames = FrameReader | Sequence[NDArray[np.uint8]]  # by number; an ``IndexError`` beyond the last


class _Window:
    """Figure with images in which clicks and keys are handled; a base class."""

    figure: Figure

    def _listen(self) -> None:
        self.figure.canvas.mpl_connect("button_press_event", self._clicked)
        self.figure.canvas.mpl_connect("key_press_event", self._key)

    def _clicked(self, event: Event) -> None:
        assert isinstance(event, MouseEvent)
        toolbar = getattr(self.figure.canvas, "toolbar", None)
        if event.inaxes is None or (toolbar is not None and toolbar.mode):
            return
        assert event.xdata is not None
        assert event.ydata is not None
        image = self.figure.axes.index(event.inaxes)
        self._click(image, float(event.xdata), float(event.ydata), int(event.button or 0))

    def _key(self, event: Event) -> None:
        assert isinstance(event, KeyEvent)
        self._pressed(event.key or "")

    def _click(self, image: int, x: float, y: float, button: int) -> None:
        """Handle a click in an image."""

    def _pressed(self, key: str) -> None:
        """Handle a key."""

    def close(self, event: Any = None) -> None:
        """Save unsaved changes; to be called when the window is closed."""


class Correction(_Window):
    """Corrected points of one view, and the figure for editing them."""

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
        self._listen()
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
        if points := self._points.get(key, []):
            nearest = int(np.argmin([np.hypot(x - a, y - b) for a, b in points]))
            self._change(key, points[:nearest] + points[nearest + 1 :])

    def delete(self) -> None:
        """Remove all points of this frame and whisker."""
        if self._points.get((self.frame, self.whisker)):
            self._change((self.frame, self.whisker), [])

    def undo(self) -> None:
        """Undo the last change, and show its frame."""
        if not self._before:
            self._said = "nothing to undo"
            self._draw()
            return
        key, points = self._before.pop()
        self._put(key, points)
        (self.frame, self.whisker), self.changed = key, True
        self._draw()

    def choose(self, whisker: int) -> None:
        """Select another whisker."""
        self.whisker = whisker
        self._draw()

    def save(self) -> None:
        """Save the corrections; traces of one point are kept in the window, but not saved."""
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
        """Trace in a frame; empty if it is lost."""
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

    def _click(self, image: int, x: float, y: float, button: int) -> None:
        if button == 1:
            self.add(x, y)
        elif button == 3:
            self.remove(x, y)

    def _pressed(self, key: str) -> None:
        if key.isdigit():
            self.choose(int(key))
        elif key in _STEPS:
            self.go(self.frame + _STEPS[key])
        elif key in _KEYS:
            getattr(self, _KEYS[key])()

    def close(self, event: Any = None) -> None:
        """Save unsaved changes."""
        if self.changed:
            self.save()

    def discard(self) -> None:
        """Discard unsaved changes."""
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


W = TypeVar("W", bound=_Window)


def opened(make: Callable[[Figure], W], instead: str, size: tuple[float, float]) -> W:
    """Open a window, wait until it is closed, and return it; an error without a screen."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=size)
    try:
        manager = figure.canvas.manager
        if manager is None or mpl.get_backend().lower() in ("agg", "pdf", "svg", "ps", "cairo"):
            raise ValueError(
                f"there is no screen for a window: {instead}, or run this where there is one"
            )
        # Matplotlib's own shortcuts for s, q, l and the arrows are disabled.
        if (handler := getattr(manager, "key_press_handler_id", None)) is not None:
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


_PICKING_HELP = (
    "b base of a whisker (in every view, in the same order) · m corners of an area without "
    "whiskers, as a peg · r corners of where whiskers are\nl two ends of a known length, then type "
    "it in mm · enter closes a polygon or takes the length · u undo · s save · q save and close · "
    "esc close"
)
_MODES: Mapping[str, str] = MappingProxyType(
    {"b": "base", "m": "mask", "r": "region", "l": "length"}
)
_COLOURS = MappingProxyType({"base": GREEN, "mask": RED, "region": BLUE, "length": ORANGE})
_CORNERS = 3  # number of corners of a polygon, at least


@dataclass(frozen=True)
class Picks:
    """Clicks so far: a state, from which each click or key makes the next one."""

    clicks: Clicks
    mode: str = "base"
    view: int = 0
    points: tuple[tuple[float, float], ...] = ()  # column and row; not complete
    typed: str = ""  # length, mm
    remark: str = ""

    def clicked(self, view: int, x: float, y: float) -> Picks:
        """Click into a view."""
        point = (float(x), float(y))
        if self.mode == "base":
            return self._with(view, base=(*self.clicks.views[view].base, point))
        before = self.points if view == self.view else ()
        if self.mode == "length":
            before = before[-1:] if len(before) < 2 else ()
        return replace(self, view=view, points=(*before, point), remark="")

    def pressed(self, key: str) -> Picks:
        """Press a key."""
        if key in _MODES:
            return replace(self, mode=_MODES[key], points=(), typed="", remark="")
        if key == "enter":
            return self._length() if self.mode == "length" else self._polygon()
        if self.mode == "length" and key == "backspace":
            return replace(self, typed=self.typed[:-1])
        if self.mode == "length" and len(key) == 1 and key in "0123456789.":
            return replace(self, typed=self.typed + key)
        return self

    def _polygon(self) -> Picks:
        if self.mode == "base" or len(self.points) < _CORNERS:
            return replace(self, remark="a polygon has three corners at least")
        areas = getattr(self.clicks.views[self.view], self.mode)
        return self._with(self.view, **{self.mode: (*areas, self.points)})

    def _length(self) -> Picks:
        try:
            length = float(self.typed)
        except ValueError:
            length = 0.0
        if len(self.points) != 2 or not length > 0.0:
            return replace(self, typed="", remark="click two ends and type their distance, mm")
        size = 1e-3 * length / max(float(np.hypot(*np.subtract(*self.points))), 1e-9)
        done = replace(self.clicks, pixel_size=size)
        remark = f"a pixel is {1e3 * size:.4f} mm"
        return replace(self, clicks=done, points=(), typed="", remark=remark)

    def _with(self, view: int, **changes: Any) -> Picks:
        views = list(self.clicks.views)
        views[view] = replace(views[view], **changes)
        return replace(self, clicks=replace(self.clicks, views=tuple(views)), points=(), remark="")


@dataclass(eq=False)
class Picking(_Window):
    """Window with images side by side, in which bases, areas and a length are marked."""

    images: Sequence[NDArray[np.uint8]]
    names: Sequence[str]
    picks: Picks
    save: Callable[[Clicks], None]
    figure: Figure = field(default_factory=Figure)

    def __post_init__(self) -> None:
        """Draw the images and listen to the mouse and the keys."""
        self._before: list[Picks] = []
        self._marks: list[Any] = []
        self.saved = self.picks.clicks
        self._axes = self.figure.subplots(1, len(self.images), squeeze=False)[0]
        for axes, image, name in zip(self._axes, self.images, self.names, strict=True):
            axes.imshow(image, cmap="gray", vmin=0, vmax=255)
            axes.set_axis_off()
            axes.set_title(name, fontsize=9)
        self.figure.text(0.5, 0.03, _PICKING_HELP, ha="center", va="center", fontsize=7)
        self._state = self.figure.text(0.5, 0.97, "", ha="center", va="center", fontsize=9)
        self._listen()
        self._draw()

    def _click(self, image: int, x: float, y: float, button: int) -> None:
        if button == 1:
            self._go(self.picks.clicked(image, x, y))

    def _pressed(self, key: str) -> None:
        if key in ("u", "ctrl+z") and self._before:
            self.picks = self._before.pop()
            self._draw()
        elif key in ("s", "ctrl+s", "q"):
            self.close()
        elif key == "escape":
            self.saved = self.picks.clicks
        else:
            self._go(self.picks.pressed(key))

    def _go(self, picks: Picks) -> None:
        if picks != self.picks:
            self._before.append(self.picks)
            self.picks = picks
            self._draw()

    def close(self, event: Any = None) -> None:
        """Save unsaved changes."""
        if self.picks.clicks != self.saved:
            self.saved = self.picks.clicks
            self.save(self.saved)

    def _draw(self) -> None:
        for mark in self._marks:
            mark.remove()
        self._marks = []
        picks = self.picks
        for number, (axes, view) in enumerate(zip(self._axes, picks.clicks.views, strict=True)):
            for k, base in enumerate(view.base):
                self._marks += axes.plot(*base, "o", color=GREEN, ms=6, mfc="none")
                self._marks.append(axes.annotate(f"{k}", base, color=GREEN, fontsize=8))
            for kind in ("mask", "region"):
                for polygon in getattr(view, kind):
                    closed = np.array([*polygon, polygon[0]])
                    self._marks += axes.plot(*closed.T, color=_COLOURS[kind], lw=1.0)
            if picks.points and number == picks.view:
                points = np.array(picks.points)
                self._marks += axes.plot(*points.T, "o-", color=_COLOURS[picks.mode], ms=4, lw=0.8)
        text = f"{picks.mode} {picks.typed}".strip()
        self._state.set_text(f"{text} · {picks.remark}" if picks.remark else text)
        self.figure.canvas.draw_idle()


def pick(
    images: Sequence[NDArray[np.uint8]],
    names: Sequence[str],
    clicks: Clicks | None,
    save: Callable[[Clicks], None],
) -> Clicks:
    """Open a window for marking bases, masks and the scale, and wait until it is closed."""
    begun = clicks or Clicks(tuple(ViewClicks() for _ in images))
    window = opened(
        lambda figure: Picking(images, names, Picks(begun), save, figure),
        "state them: --base, --mask, --region, --pixel-size, or a file for --clicks",
        (7.0 * len(images), 7.5),
    )
    return window.saved
