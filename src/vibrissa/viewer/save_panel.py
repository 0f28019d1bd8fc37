"""Buttons that hand over what is on the page: the whisker, a picture, the data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser
import xarray as xr

from vibrissa.viewer.page import Page
from vibrissa.viewer.saving import (
    deflection_dataset,
    map_netcdf,
    netcdf,
    on_paper,
    png,
    recording_netcdf,
    whisker_csv,
    whisker_netcdf,
)

_TIMEOUT = 20.0


class SaveControls:
    """Whisker, picture and data, downloaded by whoever asks."""

    def __init__(self, page: Page, recording: xr.DataTree | None = None) -> None:
        self._page = page
        self._recording = recording
        gui = page.server.gui
        self.folder = gui.add_folder("Save", expand_by_default=False)
        with self.folder:
            files = gui.add_button_group("Whisker", ("CSV", "NetCDF"))
            picture = gui.add_button_group("Picture", ("PNG",))
            data = gui.add_button_group(
                "Data", ("NetCDF",), hint="The bent whisker, the map or the trial that is seen"
            )
        files.on_click(self._whisker)
        picture.on_click(self._picture)
        data.on_click(lambda event: self._send(event, *self._data()))

    def _whisker(self, event: viser.GuiEvent[Any]) -> None:
        whisker = self._page.bend.whisker
        if event.target.value == "CSV":
            self._send(event, "whisker.csv", lambda: whisker_csv(whisker))
        else:
            self._send(event, "whisker.nc", lambda: whisker_netcdf(whisker))

    def _data(self) -> tuple[str, Callable[[], bytes]]:
        page, recording = self._page, self._recording
        mode = "" if page.mode is None else page.mode.name
        if mode == "Trial" and recording is not None:
            return "trial.nc", lambda: recording_netcdf(recording)
        chart = page.chart
        if mode == "Map" and chart is not None:
            return "map.nc", lambda: map_netcdf(chart.contact_map)
        bent = page.bend.deflection
        return "bent.nc", lambda: netcdf(deflection_dataset(bent))

    def _picture(self, event: viser.GuiEvent[Any]) -> None:
        """What the one who asks sees, without the panel."""
        client = event.client
        if client is None:
            return
        camera = client.camera

        def drawn() -> bytes:
            grip = self._page.grip
            grip.show(None)  # nobody takes hold of a picture
            try:
                image = client.get_render(
                    camera.image_height,
                    camera.image_width,
                    transport_format="png",
                    timeout=_TIMEOUT,
                )
            finally:
                self._page.place_grip()
            return png(on_paper(image))

        self._send(event, "vibrissa.png", drawn)

    def _send(self, event: viser.GuiEvent[Any], name: str, made: Callable[[], bytes]) -> None:
        client = event.client
        if client is None:
            return
        try:
            content = made()
        except (OSError, RuntimeError, TimeoutError, ValueError) as error:
            self._page.say("Not saved", str(error), "red")
            return
        client.send_file_download(name, content, save_immediately=True)
