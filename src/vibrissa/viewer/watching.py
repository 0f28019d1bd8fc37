"""What a recording knows, as arrays for the page: missing parts are found or left out.

Lines, contacts and forces are in the laboratory frame. Of what is recorded several times the first
counts of: the groups of the stages, the recording itself, the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vibrissa.cameras import Camera
from vibrissa.objects import Surface
from vibrissa.recording import Recording
from vibrissa.signals import SIGNALS, base_signals
from vibrissa.viewer.bend_drawing import NODES
from vibrissa.viewer.drawing import Array
from vibrissa.whisker import Whisker

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Watched:
    """A trial of n frames, w whiskers and v views."""

    time: Array
    whiskers: tuple[Whisker, ...]
    names: tuple[str, ...]
    lines: Array
    contacts: Array
    felt: Mask
    forces: Array
    signals: dict[str, Array]
    objects: tuple[Surface, ...]
    contour: xr.Dataset | None
    cameras: tuple[Camera, ...]
    traces: Array | None

    @property
    def frames(self) -> int:
        """How many."""
        return int(self.time.size)

    def at(self, time: float) -> int:
        """The frame at a time, s."""
        return int(np.clip(np.searchsorted(self.time, time + 1e-9) - 1, 0, self.frames - 1))

    @property
    def busiest(self) -> int:
        """The whisker that touches most of the time; the first of equals."""
        return int(np.argmax(self.felt.sum(axis=0)))

    def onsets(self) -> NDArray[np.int64]:
        """Frames in which a whisker begins to touch."""
        before = np.concatenate([np.zeros((1, self.felt.shape[1]), bool), self.felt[:-1]])
        return np.flatnonzero((self.felt & ~before).any(axis=1))

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
    felt = trial.known("in_contact", ("estimates", "", "truth"))
    touching: Mask = np.asarray(np.isfinite(contacts).all(axis=-1))
    if felt is not None:
        touching = touching & felt
    forces, signals = _felt(trial, shape)
    cameras = trial.cameras if "cameras" in trial else ()
    contour = trial.find("contour")
    return Watched(
        time=np.asarray(root["time"].to_numpy(), dtype=np.float64),
        whiskers=whiskers,
        names=tuple(trial.names),
        lines=_lines(trial, whiskers),
        contacts=np.where(touching[..., None], contacts, np.nan),
        felt=touching,
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


def _felt(trial: Recording, shape: tuple[int, int]) -> tuple[Array, dict[str, Array]]:
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
