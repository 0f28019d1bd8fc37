"""Mode Trial: a recording over time, in space, in both cameras, in signals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser

from vibrissa.io import Footage
from vibrissa.viewer.page import Page, asked, put
from vibrissa.viewer.player import Player
from vibrissa.viewer.readout import table
from vibrissa.viewer.signal_chart import chart, cursor
from vibrissa.viewer.trial_drawing import extent, moment_drawing, surroundings, touched
from vibrissa.viewer.views import View, picture, views
from vibrissa.viewer.watching import Watched

_MS = 1e3
SPEEDS = {"real time": 1.0, "1 : 2": 0.5, "1 : 5": 0.2, "1 : 10": 0.1, "1 : 50": 0.02}
_USUAL = "1 : 10"


class TrialMode:
    """Time, and all that goes with it."""

    name = "Trial"

    def __init__(self, page: Page, trial: Watched, videos: Sequence[Footage] = ()) -> None:
        self.trial = trial
        self.frame = 0
        self._page = page
        self._videos = tuple(videos)
        self._now = float(trial.time[0])
        self._speed = SPEEDS[_USUAL]
        self._whisker = trial.busiest
        self._still: tuple[bool, bool] | None = None
        self._objects = self._fit = True
        self._views = views(trial)
        self._player = Player(self._tick)
        page.closing.append(self._player.close)
        self._controls(page.server)

    def _controls(self, server: viser.ViserServer) -> None:
        gui, trial = server.gui, self.trial
        self._folder = gui.add_folder("Trial", visible=False)
        end = round(_MS * float(trial.time[-1] - trial.time[0]), 3)
        step = max(round(end / max(trial.frames - 1, 1), 3), 1e-3)
        with self._folder:
            self._time = gui.add_slider("Time (ms)", 0.0, max(end, step), step, 0.0)
            self._play = gui.add_button("Play", color="blue")
            jump = gui.add_button("Next contact", color="blue")
            speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value=_USUAL)
            if len(trial.names) > 1:
                which = gui.add_dropdown(
                    "Signals of", trial.names, initial_value=trial.names[self._whisker]
                )
                asked(which, self._choose)
            objects = gui.add_checkbox("Objects", True, visible=bool(trial.objects))
            fit = gui.add_checkbox("Fitted shape", True, visible=trial.contour is not None)
            self._words = gui.add_html("")
            self._chart = gui.add_html("")
            self._cursor = gui.add_html("")
        self._window = gui.add_panel(visible=False) if self._views else None
        self._pictures: list[tuple[View, viser.GuiImageHandle]] = []
        if self._window is not None:
            with self._window.add_tab("Cameras"):
                for view in self._views:
                    blank = picture(view, trial, 0)
                    self._pictures.append((view, gui.add_image(blank, label=view.name)))
            self._window.dock_left()
            self._window.set_width(330.0)
        asked(self._time, lambda value: self.go(float(trial.time[0]) + value / _MS))
        asked(speed, self.hurry)
        asked(objects, lambda on: self._see(objects=on))
        asked(fit, lambda on: self._see(fit=on))
        self._play.on_click(lambda _: self.toggle())
        jump.on_click(lambda _: self.jump())

    def enter(self) -> None:
        """Show controls, and look at where whiskers go."""
        self._folder.visible = True
        if self._window is not None:
            self._window.visible = True
        middle, size = extent(self.trial)
        self._page.look_at(middle, 0.9 * size, (0.25, -0.75, 0.65))
        self._draw_chart()

    def leave(self) -> None:
        """Stop, and hide controls and things."""
        self.pause()
        self._folder.visible = False
        if self._window is not None:
            self._window.visible = False
        self._still = None
        for layer in ("moment", "touched", "surroundings"):
            self._page.stage.show(layer, {})

    def redraw(self) -> None:
        """Draw the frame of now."""
        trial, stage, frame = self.trial, self._page.stage, self.frame
        stage.show("moment", moment_drawing(trial, frame, self._page.exaggeration))
        stage.show("touched", touched(trial, frame))
        if self._still != (self._objects, self._fit):
            self._still = (self._objects, self._fit)
            stage.show("surroundings", surroundings(trial, *self._still))
        for view, shown in self._pictures:
            image = self._videos[view.number].frame(frame) if self._videos else None
            shown.image = picture(view, trial, frame, image)

    def write(self, brief: bool = False) -> None:
        """Write the signals of now, and where now is."""
        trial, frame = self.trial, self.frame
        passed = float(trial.time[frame] - trial.time[0])
        put(self._time, _MS * passed)
        self._cursor.content = cursor(passed / max(float(np.ptp(trial.time)), 1e-12))
        self._words.content = self._said(frame)

    def go(self, time: float) -> None:
        """Show the frame at a time, s."""

        def job() -> None:
            self._now = time
            self.frame = self.trial.at(time)
            if self._page.mode is self:
                self._page.redraw()

        self._page.work.put("time", job)

    def toggle(self) -> None:
        """Play or pause; from the end it begins anew."""
        if self._player.playing:
            self._player.pause()
        else:
            if self.frame >= self.trial.frames - 1:
                self._now = float(self.trial.time[0])
            self._player.play()
        self._play.label = "Pause" if self._player.playing else "Play"

    def pause(self) -> None:
        """Let time stand still."""
        self._player.pause()
        self._play.label = "Play"

    def hurry(self, words: str) -> None:
        """Play as fast as one of :data:`SPEEDS` says."""
        self._speed = SPEEDS[words]

    def jump(self) -> None:
        """Go to where the next contact begins."""
        self.go(float(self.trial.time[self.trial.next_contact(self.frame)]))

    def _tick(self, passed: float) -> None:
        time = self._now + self._speed * passed
        if time >= self.trial.time[-1]:
            self.pause()
        self._now = time
        self.go(time)

    def _choose(self, name: str) -> None:
        self._whisker = self.trial.names.index(name)
        self._page.work.put("chart", self._draw_chart)
        self._page.work.put("time", self._page.redraw)

    def _see(self, objects: bool | None = None, fit: bool | None = None) -> None:
        self._objects = self._objects if objects is None else objects
        self._fit = self._fit if fit is None else fit
        self._page.work.put("time", self._page.redraw)

    def _draw_chart(self) -> None:
        trial, i = self.trial, self._whisker
        signals = {name: values[:, i] for name, values in trial.signals.items()}
        for name in ("FD", "MD"):  # without contact a direction is noise
            signals[name] = np.where(trial.felt[:, i], signals[name], np.nan)
        self._chart.content = chart(trial.time, signals, trial.felt[:, i])

    def _said(self, frame: int) -> str:
        trial, i = self.trial, self._whisker
        rows = {name: float(values[frame, i]) for name, values in trial.signals.items()}
        touching = "in contact" if trial.felt[frame, i] else "free"
        passed = f"{_MS * float(trial.time[frame] - trial.time[0]):.1f} ms"
        count = int(trial.felt[: frame + 1].sum())
        so_far = f"{count} contact{'' if count == 1 else 's'} so far"
        return table(rows, f"{passed}: {touching}, {so_far}")
