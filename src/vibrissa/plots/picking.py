"""A window in which a person shows where whiskers begin, areas without whiskers, and the scale.

The logic is in `Picking`, which needs only a figure; it works without a screen. `pick` opens a
window on one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.backend_bases import Event, KeyEvent, MouseEvent
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vibrissa.io import Clicks, ViewClicks
from vibrissa.plots.correction import opened
from vibrissa.plots.style import BLUE, GREEN, ORANGE, RED

HELP = (
    "b base of a whisker (in every view, in the same order) · m corners of an area without "
    "whiskers, as a peg · r corners of where whiskers are\nl two ends of a known length, then type "
    "it in mm · enter closes a polygon or takes the length · u undo · s save · q save and close · "
    "esc close"
)
_MODES: Mapping[str, str] = MappingProxyType(
    {"b": "base", "m": "mask", "r": "region", "l": "length"}
)
_COLOURS = MappingProxyType({"base": GREEN, "mask": RED, "region": BLUE, "length": ORANGE})
_CORNERS = 3
"""Number of corners of a polygon, at least."""


@dataclass(frozen=True)
class Picks:
    """Clicks so far: a state, from which each click or key makes the next one.

    Parameters
    ----------
    clicks : Clicks
        Clicks that are complete.
    mode : str
        Meaning of a click: base, mask, region or length.
    view : int
        View of the points that are not complete.
    points : tuple of (column, row)
        Corners, or ends of a length, that are not complete, pixels.
    typed : str
        Length that is being typed, mm.
    remark : str
        Remark that is shown to the person.
    """

    clicks: Clicks
    mode: str = "base"
    view: int = 0
    points: tuple[tuple[float, float], ...] = ()
    typed: str = ""
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
class Picking:
    """The window: images side by side, what was clicked in them, and the keys."""

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
        self.figure.text(0.5, 0.03, HELP, ha="center", va="center", fontsize=7)
        self._state = self.figure.text(0.5, 0.97, "", ha="center", va="center", fontsize=9)
        self.figure.canvas.mpl_connect("button_press_event", self._clicked)
        self.figure.canvas.mpl_connect("key_press_event", self._pressed)
        self._draw()

    def _clicked(self, event: Event) -> None:
        assert isinstance(event, MouseEvent)
        toolbar = getattr(self.figure.canvas, "toolbar", None)
        inside = [view for view, axes in enumerate(self._axes) if event.inaxes is axes]
        if event.button == 1 and inside and not (toolbar is not None and toolbar.mode):
            assert event.xdata is not None
            assert event.ydata is not None
            self._go(self.picks.clicked(inside[0], event.xdata, event.ydata))

    def _pressed(self, event: Event) -> None:
        assert isinstance(event, KeyEvent)
        key = event.key or ""
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
        """Save what is not saved; to be called when the window is closed."""
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
    """Open a window to show bases, masks and the scale in, and wait until it is closed."""
    begun = clicks or Clicks(tuple(ViewClicks() for _ in images))
    window = opened(
        lambda figure: Picking(images, names, Picks(begun), save, figure),
        "state them: --base, --mask, --region, --pixel-size, or a file for --clicks",
        (7.0 * len(images), 7.5),
    )
    return window.saved
