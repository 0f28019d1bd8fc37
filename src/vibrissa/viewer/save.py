"""Downloads from the page: files of the displayed data, pictures and movies.

A title, an icon and a script that reduces the load of weak graphics are inserted into the head of
the page when it is served, as viser serves a prebuilt page without such settings. The page also
works without them, but more slowly.
"""

from __future__ import annotations

import gzip
import tempfile
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import viser
import xarray as xr

from vibrissa.io import netcdf_image, save_centerline, save_recording, write_movie
from vibrissa.numerics import Mask
from vibrissa.quantities import attributes
from vibrissa.rod import Deflection
from vibrissa.signals import base_signals
from vibrissa.viewer.page import Page
from vibrissa.viewer.trial import TrialMode

Picture = np.ndarray[Any, np.dtype[np.uint8]]

NODES = 200
_MARGIN = 24  # white around a picture, pixels


def deflection_dataset(bent: Deflection) -> xr.Dataset:
    """Dataset of one bent whisker."""
    out = bent.to_dataset().assign_attrs(reference_frame="whisker")
    out["centerline"] = ("node", "space"), bent.centerline(NODES), attributes("centerline")
    out["contact_point"].attrs |= attributes("contact_point_whisker")
    return out.merge(base_signals(out["force"], out["moment"]))


def png(image: Picture) -> bytes:
    """PNG file of a picture (height, width, 3 or 4)."""
    import imageio.v3 as imageio

    encoded: bytes = imageio.imwrite("<bytes>", image, extension=".png")
    return encoded


def _on_white(image: Picture) -> Picture:
    """Blend a picture (height, width, 4) with white (height, width, 3)."""
    share = image[..., 3:] / 255.0
    return np.round(image[..., :3] * share + 255.0 * (1.0 - share)).astype(np.uint8)


def on_paper(image: Picture) -> Picture:
    """Blend a picture (height, width, 4) with white and crop its empty margins (h, w, 3)."""
    out = _on_white(image)
    return out[_part((out != 255).any(axis=-1))]


def _part(filled: Mask) -> tuple[slice, slice]:
    """Rows and columns of the filled part of a picture (height, width), with a margin."""
    at = np.nonzero(filled)
    if not at[0].size:
        return slice(None), slice(None)
    top, left = (slice(max(int(k.min()) - _MARGIN, 0), int(k.max()) + _MARGIN + 1) for k in at)
    return top, left


def written(name: str, write: Callable[[Path], object]) -> bytes:
    """Contents of the file written by a function."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


_TIMEOUT = 60.0  # of a picture that the browser draws, s
_FRAMES = 100  # most frames of a movie
# Pixels of a picture per pixel of the browser, and longest side of a picture or movie, pixels.
_STILL, _LONGEST = 3.0, 4000.0
_SIZES = {"MP4": 2.0, "MP4, small": 1.0}  # the same for movies


def _render(client: viser.ClientHandle, fine: float) -> Picture:
    """Render the scene of a browser, without the panels."""
    size = np.array([client.camera.image_height, client.camera.image_width])
    height, width = (max(1.0, min(fine, _LONGEST / size.max())) * size).astype(int).tolist()
    return client.get_render(height, width, transport_format="png", timeout=_TIMEOUT)


def movie(
    client: viser.ClientHandle, mode: TrialMode, fine: float, progress: Callable[[int, int], None]
) -> bytes:
    """MP4 movie of a trial in the view of a browser, on white, without empty margins."""
    import imageio.v3 as imageio

    mode.pause()
    count = min(mode.trial.frames, _FRAMES)
    rows = np.linspace(0, mode.trial.frames - 1, count).round().astype(int)

    drawn, filled = [], np.zeros((), dtype=bool)
    for done, row in enumerate(rows):
        progress(done, count)
        mode.show(int(row))
        paper = _on_white(_render(client, fine))
        drawn.append(png(paper))
        filled = filled | (paper != 255).any(axis=-1)
    part = _part(filled)

    def frames() -> Iterator[Picture]:
        for each in drawn:
            frame = imageio.imread(each, extension=".png")[part]
            # Encoders need even sizes.
            yield frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2]

    return written("trial.mp4", lambda path: write_movie(path, frames(), 25.0))


class SaveControls:
    """Buttons to download the whisker, a picture and data."""

    def __init__(self, page: Page, recording: xr.DataTree | None = None) -> None:
        self._page = page
        self._recording = recording
        gui = page.server.gui
        self.folder = gui.add_folder("Save", expand_by_default=False)
        with self.folder:
            files = gui.add_button_group("Whisker", ("CSV", "NetCDF"))
            picture = gui.add_button_group("Picture", ("PNG",))
            movie = gui.add_button_group(
                "Movie",
                tuple(_SIZES),
                hint="The trial in the current view; small: as large as the window, faster to draw",
            )
            data = gui.add_button_group(
                "Data", ("NetCDF",), hint="The bent whisker, the map or the trial that is shown"
            )
        files.on_click(self._whisker)
        picture.on_click(self._picture)
        movie.on_click(self._movie)
        data.on_click(self._data)

    def _whisker(self, event: viser.GuiEvent[Any]) -> None:
        whisker = self._page.bend.whisker
        if event.target.value == "CSV":
            self._written(
                event, "whisker.csv", lambda path: save_centerline(path, whisker.centerline(NODES))
            )
        else:
            self._send(event, "whisker.nc", lambda: bytes(netcdf_image(whisker.to_dataset())))

    def _data(self, event: viser.GuiEvent[Any]) -> None:
        page, recording, chart = self._page, self._recording, self._page.chart
        mode = "" if page.mode is None else page.mode.name
        if mode == "Trial" and recording is not None:
            self._written(event, "trial.nc", lambda path: save_recording(path, recording))
        elif mode == "Map" and chart is not None:
            self._written(event, "map.nc", chart.contact_map.save)
        else:
            bent = page.bend.deflection
            self._send(event, "bent.nc", lambda: bytes(netcdf_image(deflection_dataset(bent))))

    def _written(
        self, event: viser.GuiEvent[Any], name: str, write: Callable[[Path], object]
    ) -> None:
        """Send the file that a function writes."""
        self._send(event, name, lambda: written(name, write))

    def _picture(self, event: viser.GuiEvent[Any]) -> None:
        """Send a picture of the requesting browser's view, without the panel."""
        if (client := event.client) is None:
            return

        def drawn() -> bytes:
            self._page.grip.show(None)
            try:
                return png(on_paper(_render(client, _STILL)))
            finally:
                self._page.place_grip()

        self._send(event, "vibrissa.png", drawn)

    def _movie(self, event: viser.GuiEvent[Any]) -> None:
        """Send a short movie of the trial in the requesting browser's view."""
        client, mode = event.client, self._page.mode
        if client is None:
            return
        if not isinstance(mode, TrialMode):
            self._page.say("Not saved", "movies show trials: choose the mode Trial", "red")
            return
        note = client.add_notification("Movie", "drawn by this browser", loading=True)

        def tell(done: int, total: int) -> None:
            note.body = f"frame {done + 1} of {total}"

        try:
            fine = _SIZES[event.target.value]
            self._send(event, "trial.mp4", lambda: movie(client, mode, fine, tell))
        finally:
            note.remove()

    def _send(self, event: viser.GuiEvent[Any], name: str, made: Callable[[], bytes]) -> None:
        if (client := event.client) is None:
            return
        try:
            content = made()
        except (OSError, RuntimeError, TimeoutError, ValueError) as error:
            self._page.say("Not saved", str(error), "red")
            return
        client.send_file_download(name, content, save_immediately=True)


SCRIPT, STYLE = (
    Path(__file__).with_name(name).read_text(encoding="utf-8") for name in ("page.js", "page.css")
)

_ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E"
    "%3Cpath d='M3 25C13 25 22 20 28 6' fill='none' stroke='%233e342c' stroke-width='3.5' "
    "stroke-linecap='round'/%3E%3Ccircle cx='21' cy='17.5' r='4.5' fill='%23d55e00'/%3E%3C/svg%3E"
)


def amended(response: Any) -> Any:
    """Insert the script into a response that is a page; other responses are unchanged."""
    if response is None or not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    zipped = response.headers.get("Content-Encoding") == "gzip"
    response.body = _zipped(response.body) if zipped else with_script(response.body)
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))
    return response


@lru_cache(maxsize=2)
def _zipped(page: bytes) -> bytes:
    return gzip.compress(with_script(gzip.decompress(page)))


def with_script(page: bytes) -> bytes:
    """Insert the script, an icon and a title at the beginning of a page's head."""
    ours = (
        f'<link rel="icon" href="{_ICON}"/><title>vibrissa</title><style>{STYLE}</style>'
        f"<script>{SCRIPT}</script>"
    )
    return page.replace(b"<head>", b"<head>" + ours.encode(), 1)
