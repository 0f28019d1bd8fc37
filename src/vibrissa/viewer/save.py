"""Files of what is on the page, and the buttons that hand them over.

The page is given a name, an icon, and less work for weak graphics before it starts: viser serves
one that is ready made and has no place for such things, so they are written into its head on the
way to the browser. Without them the page works as well, but not as fast.
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

from vibrissa.contacts import ContactMap
from vibrissa.io import netcdf_image, save_centerline, save_recording, write_movie
from vibrissa.quantities import attributes
from vibrissa.rod import Deflection
from vibrissa.signals import base_signals
from vibrissa.viewer.page import Page
from vibrissa.viewer.trial import TrialMode
from vibrissa.whisker import Whisker

Picture = np.ndarray[Any, np.dtype[np.uint8]]

NODES = 200
_MARGIN = 24
"""White around a picture, pixels."""


def whisker_csv(whisker: Whisker) -> bytes:
    """The resting centreline as a table, which `vibrissa.load_whisker` reads."""
    return _written("whisker.csv", lambda path: save_centerline(path, whisker.centerline(NODES)))


def whisker_netcdf(whisker: Whisker) -> bytes:
    """The whisker without loss: shape, radius, material."""
    return netcdf(whisker.to_dataset())


def map_netcdf(contact_map: ContactMap) -> bytes:
    """A map without loss, which `ContactMap.load` reads."""
    return _written("map.nc", contact_map.save)


def recording_netcdf(recording: xr.DataTree) -> bytes:
    """A trial with all its groups, which every verb reads."""
    return _written("trial.nc", lambda path: save_recording(path, recording))


def netcdf(data: xr.Dataset) -> bytes:
    """A dataset as a file."""
    return bytes(netcdf_image(data))


def deflection_dataset(bent: Deflection) -> xr.Dataset:
    """One bent whisker as a labelled dataset."""
    out = bent.to_dataset().assign_attrs(reference_frame="whisker")
    out["centerline"] = ("node", "space"), bent.centerline(NODES), attributes("centerline")
    out["contact_point"].attrs |= attributes("contact_point_whisker")
    return out.merge(base_signals(out["force"], out["moment"]))


def png(image: Picture) -> bytes:
    """A picture (height, width, 3 or 4) as PNG."""
    import imageio.v3 as imageio

    encoded: bytes = imageio.imwrite("<bytes>", image, extension=".png")
    return encoded


def _on_white(image: Picture) -> Picture:
    """A picture (height, width, 4) on white (height, width, 3)."""
    share = image[..., 3:] / 255.0
    return np.round(image[..., :3] * share + 255.0 * (1.0 - share)).astype(np.uint8)


def on_paper(image: Picture) -> Picture:
    """A picture (height, width, 4) on white (height, width, 3), without its empty margins."""
    out = _on_white(image)
    rows, columns = np.nonzero((out != 255).any(axis=-1))
    if not rows.size:
        return out
    top, left = (max(int(at.min()) - _MARGIN, 0) for at in (rows, columns))
    return out[top : rows.max() + _MARGIN + 1, left : columns.max() + _MARGIN + 1]


def _written(name: str, write: Callable[[Path], object]) -> bytes:
    """Return the bytes that a writer of files writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


_TIMEOUT = 20.0
_FRAMES = 100
"""Most frames of a movie."""


def _render(client: viser.ClientHandle) -> Picture:
    """Render what a browser shows, without the panels."""
    camera = client.camera
    return client.get_render(
        camera.image_height, camera.image_width, transport_format="png", timeout=_TIMEOUT
    )


def movie(client: viser.ClientHandle, mode: TrialMode) -> bytes:
    """A trial as a browser sees it, frame by frame on white, as MP4."""
    mode.pause()
    count = min(mode.trial.frames, _FRAMES)
    rows = np.linspace(0, mode.trial.frames - 1, count).round().astype(int)

    def frames() -> Iterator[Picture]:
        for row in rows:
            mode.show(int(row))
            paper = _on_white(_render(client))
            # Encoders need even sizes.
            yield paper[: paper.shape[0] // 2 * 2, : paper.shape[1] // 2 * 2]

    return _written("trial.mp4", lambda path: write_movie(path, frames(), 25.0))


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
            movie = gui.add_button_group("Movie", ("MP4",), hint="The trial from where one looks")
            data = gui.add_button_group(
                "Data", ("NetCDF",), hint="The bent whisker, the map or the trial that is seen"
            )
        files.on_click(self._whisker)
        picture.on_click(self._picture)
        movie.on_click(self._movie)
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
        """Picture of what the one who asks sees, without the panel."""
        client = event.client
        if client is None:
            return

        def drawn() -> bytes:
            self._page.grip.show(None)  # nobody takes hold of a picture
            try:
                return png(on_paper(_render(client)))
            finally:
                self._page.place_grip()

        self._send(event, "vibrissa.png", drawn)

    def _movie(self, event: viser.GuiEvent[Any]) -> None:
        """A short movie of the trial, seen as the browser that asks sees it."""
        client, mode = event.client, self._page.mode
        if client is None:
            return
        if not isinstance(mode, TrialMode):
            self._page.say("Not saved", "a movie is of a trial: choose the mode Trial", "red")
            return
        self._page.say("Movie", f"{_FRAMES} frames are drawn; it takes about a minute")
        self._send(event, "trial.mp4", lambda: movie(client, mode))

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


SCRIPT = """
(() => {
  document.title = "vibrissa";
  // The server shows what a link asks for; viser would take it for a part of the address.
  if (location.hash) {
    fetch("restore?" + location.hash.slice(1));
    history.replaceState(null, "", location.pathname + location.search);
  }
  // The page is dark as long as the browser is.
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const matched = () => {
    const asked = new URLSearchParams(location.search);
    if (dark.matches) asked.set("darkMode", ""); else asked.delete("darkMode");
    history.replaceState(null, "", "?" + asked + location.hash);
  };
  if (dark.matches) matched();
  dark.addEventListener("change", () => { matched(); location.reload(); });

  // Keys press buttons; a click in a plot over time sets the time.
  const button = (...texts) => [...document.querySelectorAll("button")].find(
    (each) => each.offsetParent && texts.includes(each.textContent.trim()));
  const setTime = (share) => {
    const label = [...document.querySelectorAll("label")].find(
      (each) => each.textContent.trim() === "Time (ms)");
    let box = label;
    const number = "input[type=text], input:not([type])";
    while (box && !box.querySelector(number)) box = box.parentElement;
    const input = box?.querySelector(number);
    const slider = box?.querySelector("[role=slider]");
    if (!input || !slider) return;
    const value = String(Number(slider.getAttribute("aria-valuemax")) * share);
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(input, value);
    input.dispatchEvent(new Event("input", { bubbles: true }));
    input.dispatchEvent(new Event("blur", { bubbles: true }));
  };
  const keys = {
    ",": ["◀ frame"], ".": ["frame ▶"], "n": ["Next contact"], " ": ["Play", "Pause"],
  };
  addEventListener("keydown", (event) => {
    const typing = /^(INPUT|TEXTAREA|BUTTON)$/.test(event.target.tagName);
    if (typing || event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    const found = button(...keys[event.key]);
    if (found) { event.preventDefault(); found.click(); }
  });
  addEventListener("click", (event) => {
    const plot = event.target.closest?.("svg[data-seek]");
    if (!plot) return;
    const box = plot.getBoundingClientRect(), left = Number(plot.dataset.seek);
    const share = ((event.clientX - box.left) / (box.width - 8) - left) / (1 - left);
    if (share >= 0 && share <= 1) setTime(share);
  });

  // The address keeps what is seen, so that a link leads back to it.
  setInterval(() => {
    const state = document.querySelector("[data-link]")?.dataset.link;
    if (state && location.hash !== "#" + state)
      history.replaceState(null, "", location.search + "#" + state);
  }, 500);

  // Arrow keys that move a slider are not for the view as well.
  addEventListener("DOMContentLoaded", () => document.body.addEventListener("keydown", (event) => {
    if (event.target.getAttribute?.("role") === "slider") event.stopPropagation();
  }));

  // The page sends the mouse every 50 ms; a whisker follows faster.
  const later = window.setTimeout.bind(window);
  window.setTimeout = (job, delay, ...rest) => later(job, delay === 50 ? 16 : delay, ...rest);

  // Smooth edges take four times the work: no more than what a graphics card does in passing, but
  // most of a frame where there is none.
  const plain = HTMLCanvasElement.prototype.getContext;
  let slow = null;
  const inSoftware = () => {
    const gl = plain.call(document.createElement("canvas"), "webgl2");
    const info = gl && gl.getExtension("WEBGL_debug_renderer_info");
    const name = info ? String(gl.getParameter(info.UNMASKED_RENDERER_WEBGL)) : "";
    if (gl) gl.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
  };
  HTMLCanvasElement.prototype.getContext = function (kind, options, ...rest) {
    if (options && options.antialias && kind.startsWith("webgl")) {
      slow ??= inSoftware();
      if (slow) options = { ...options, antialias: false };
    }
    return plain.call(this, kind, options, ...rest);
  };

  // Changes of what is there are taken in at once, not at the next frame, which would draw them
  // only a frame later.
  const changes = new Set([
    "SceneNodeUpdateMessage", "SetPositionMessage", "SetOrientationMessage", "GuiUpdateMessage",
    "SetSceneNodeVisibilityMessage",
  ]);
  const take = ({ type, messages }) => {
    const page = window.__viserMutable;
    if (type !== "message_batch" || !page || page.firstMessageBatch) return;
    if (page.getRenderRequestState !== "ready" || !page.drainMessageQueue) return;
    if (page.messageQueue.length !== messages.length) return;
    if (messages.every((message) => changes.has(message.type))) page.drainMessageQueue();
  };
  window.Worker = class extends Worker {
    set onmessage(heard) {
      super.onmessage = (event) => { heard(event); take(event.data); };
    }
    get onmessage() { return super.onmessage; }
  };

  const furnish = () => {
    const page = window.__viserMutable, root = page?.scene?.__r3f?.root?.getState?.();
    if (!page?.backgroundMaterial || !root) return later(furnish, 100);
    // A pane for background images is drawn over the whole window although there is no image.
    page.scene.traverse((thing) => {
      if (thing.material === page.backgroundMaterial) thing.visible = false;
    });
    // A mouse that drags, and whatever changes, asks for frames for a quarter of a second. Where
    // each takes its time they would keep that from being drawn which they wait for.
    if (!slow) return;
    let ask = page.requestRender, last = 0;
    const thrifty = () => {
      const held = page.cameraControl?.enabled === false;  // something, not the view
      if (!held || window.event?.type !== "pointermove") root.invalidate();
      clearTimeout(last);
      last = later(() => ask(), 150);
    };
    Object.defineProperty(page, "requestRender", { get: () => thrifty, set: (f) => { ask = f; } });
  };
  furnish();
})();
"""

STYLE = """
/* On a phone the panel is as wide as the screen, below what is drawn. */
@media (max-width: 36em) {
  .mantine-Paper-root[style*="position: fixed"]:not([data-floating-window]) {
    left: 0 !important; right: 0 !important; width: 100% !important; max-height: 55% !important;
  }
  .mantine-Paper-root:not([data-floating-window]) .mantine-ScrollArea-content > div {
    width: 100% !important;
  }
}
/* Between the cameras at the left and the panel at the right. */
@media (max-width: 1300px) {
  [data-floating-window]:has(svg[data-timeline]) {
    width: calc(100vw - 770px) !important; min-width: 220px !important;
  }
}
/* Blue can be read on black only if it is light. */
[data-mantine-color-scheme=dark] svg [stroke="#0072b2"] { stroke: #56b4e9; }
[data-mantine-color-scheme=dark] svg [fill="#0072b2"] { fill: #56b4e9; }
"""

_ICON = (
    "data:image/svg+xml,%3Csvg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 32 32'%3E"
    "%3Cpath d='M3 25C13 25 22 20 28 6' fill='none' stroke='%233e342c' stroke-width='3.5' "
    "stroke-linecap='round'/%3E%3Ccircle cx='21' cy='17.5' r='4.5' fill='%23d55e00'/%3E%3C/svg%3E"
)


def amended(response: Any) -> Any:
    """Put the script into a response that is a page; leave every other as it is."""
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
    """Put the script, an icon and a title first of all that a page loads."""
    ours = (
        f'<link rel="icon" href="{_ICON}"/><title>vibrissa</title><style>{STYLE}</style>'
        f"<script>{SCRIPT}</script>"
    )
    return page.replace(b"<head>", b"<head>" + ours.encode(), 1)
