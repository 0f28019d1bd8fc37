"""A recording as arrays for the page, and its camera images; missing parts are found or left out.

Lines, contacts and forces are in the laboratory frame. Of what is recorded several times the first
counts of: the groups of the stages, the recording itself, the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from vibrissa.cameras import Camera
from vibrissa.numerics import Array, Mask
from vibrissa.objects import Surface
from vibrissa.recording import Recording
from vibrissa.scene import Bytes
from vibrissa.signals import SIGNALS, base_signals
from vibrissa.simulation import silhouette
from vibrissa.viewer.bend import NODES
from vibrissa.whisker import Whisker


@dataclass(frozen=True, eq=False)
class Watched:
    """A trial of n frames, w whiskers and v views."""

    time: Array
    whiskers: tuple[Whisker, ...]
    names: tuple[str, ...]
    lines: Array
    contacts: Array
    covariance: Array | None
    touching: Mask
    forces: Array
    signals: dict[str, Array]
    objects: tuple[Surface, ...]
    contour: xr.Dataset | None
    cameras: tuple[Camera, ...]
    traces: Array | None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return int(self.time.size)

    def at(self, time: float) -> int:
        """The frame at a time, s."""
        return int(np.clip(np.searchsorted(self.time, time + 1e-9) - 1, 0, self.frames - 1))

    @property
    def busiest(self) -> int:
        """The whisker that touches most of the time; the first of equals."""
        return int(np.argmax(self.touching.sum(axis=0)))

    def onsets(self) -> NDArray[np.int64]:
        """Frames in which a whisker begins to touch."""
        before = np.concatenate([np.zeros((1, self.touching.shape[1]), bool), self.touching[:-1]])
        return np.flatnonzero((self.touching & ~before).any(axis=1))

    def next_contact(self, frame: int) -> int:
        """The frame in which the next contact begins; the first after the last, else the same."""
        onsets = self.onsets()
        after = onsets[onsets > frame]
        return int(after[0] if after.size else onsets[0] if onsets.size else frame)


def watched(recording: xr.DataTree) -> Watched:
    """Take from a recording what can be looked at."""
    root = recording.to_dataset()
    if not root.sizes.get("time") or not root.sizes.get("whisker"):
        raise ValueError("the recording has no frames of a whisker to look at")
    trial = Recording(recording)
    shape = (root.sizes["time"], root.sizes["whisker"])
    whiskers = tuple(trial.whiskers)
    contacts = trial.known("contact_point", ("estimates", "", "truth"))
    if contacts is None:
        contacts = np.full((*shape, 3), np.nan)
    in_contact = trial.known("in_contact", ("estimates", "", "truth"))
    touching: Mask = np.asarray(np.isfinite(contacts).all(axis=-1))
    if in_contact is not None:
        touching = touching & in_contact
    forces, signals = _measured(trial, shape)
    cameras = trial.cameras if "cameras" in trial else ()
    contour = trial.find("contour")
    return Watched(
        time=np.asarray(root["time"].to_numpy(), dtype=np.float64),
        whiskers=whiskers,
        names=tuple(trial.names),
        lines=_lines(trial, whiskers),
        contacts=np.where(touching[..., None], contacts, np.nan),
        covariance=trial.known("contact_covariance", ("estimates", "")),
        touching=touching,
        forces=forces,
        signals=signals,
        objects=trial.objects,
        contour=contour.data if contour else None,
        cameras=cameras,
        traces=trial.known("trace", ("", "truth")) if cameras else None,
    )


def _lines(trial: Recording, whiskers: Sequence[Whisker]) -> Array:
    """Centrelines as recorded, else the resting whisker where its base is."""
    lines = trial.known("centerline", ("", "truth"))
    if lines is not None:
        return lines
    place = trial.known("base_position", ("", "truth"))
    turn = trial.known("base_rotation", ("", "truth"))
    if place is None or turn is None:
        raise ValueError("the recording has neither centrelines nor poses of the whisker's base")
    rest = np.stack([whisker.centerline(NODES) for whisker in whiskers])
    return np.asarray(np.einsum("twij,wkj->twki", turn, rest) + place[:, :, None])


def _measured(trial: Recording, shape: tuple[int, int]) -> tuple[Array, dict[str, Array]]:
    """Forces in the laboratory and the six signals; NaN where nothing is known."""
    missing = np.full((*shape, 3), np.nan)
    force = trial.known("force", ("signals", "", "truth"))
    moment = trial.known("moment", ("signals", "", "truth"))
    if force is None or moment is None:
        force, moment = missing, missing
    turn = trial.known("base_rotation", ("signals", "", "truth"))
    in_lab = missing if turn is None else np.einsum("twij,twj->twi", turn, force)
    signals = base_signals(force, moment)
    return in_lab, {name: np.asarray(signals[name].to_numpy()) for name in SIGNALS}


Frame = NDArray[np.uint8]

WIDTH = 420
"""Width of a picture, pixels."""

_MARGIN = 40.0
_TRACE, _CONTACT = (255, 96, 0), (0, 150, 255)


@dataclass(frozen=True, eq=False)
class View:
    """One camera's window onto a trial."""

    name: str
    number: int
    box: tuple[int, int, int, int]
    empty: Frame

    @property
    def scale(self) -> float:
        """Pixels of the picture per pixel of the image."""
        return min(1.0, WIDTH / (self.box[2] - self.box[0]))


def views(trial: Watched) -> tuple[View, ...]:
    """One window per camera: where its traces go, with some room."""
    if trial.traces is None:
        return ()
    out = []
    middle = np.nanmean(trial.lines.reshape(-1, 3), axis=0)
    for i, camera in enumerate(trial.cameras):
        width, height = camera.size
        places = trial.traces[:, :, i].reshape(-1, 2)
        if not np.isfinite(places).any():
            continue
        low = np.maximum(np.nanmin(places, axis=0) - _MARGIN, 0.0).astype(int).tolist()
        high = np.minimum(np.nanmax(places, axis=0) + _MARGIN, camera.size).astype(int).tolist()
        covered = silhouette(camera, trial.objects, middle, 1.0)
        empty = np.round(236.0 - 130.0 * covered).astype(np.uint8)
        box = (low[0], low[1], max(high[0], low[0] + 8), max(high[1], low[1] + 8))
        assert empty.shape == (height, width)
        out.append(View(camera.name, i, box, empty))
    return tuple(out)


def picture(view: View, trial: Watched, frame: int, image: Frame | None = None) -> Bytes:
    """Show one frame of one camera."""
    left, top, right, bottom = view.box
    source = view.empty if image is None else image
    rows = np.arange(top, bottom, 1.0 / view.scale).astype(int)
    columns = np.arange(left, right, 1.0 / view.scale).astype(int)
    rows = rows[rows < source.shape[0]]
    columns = columns[columns < source.shape[1]]
    out = Image.fromarray(source[np.ix_(rows, columns)]).convert("RGB")
    draw = ImageDraw.Draw(out)
    assert trial.traces is not None  # else there are no views
    for trace in trial.traces[frame, :, view.number]:
        known = (trace[np.isfinite(trace).all(axis=1)] - [left, top]) * view.scale
        draw.line(np.round(known).ravel().tolist(), _TRACE)
    touching = trial.contacts[frame][trial.touching[frame]]
    if touching.size:
        seen = trial.cameras[view.number].project(touching)
        for at in np.round((seen - [left, top]) * view.scale):
            draw.ellipse([*(at - 3.0), *(at + 3.0)], _CONTACT)
    return np.asarray(out)
