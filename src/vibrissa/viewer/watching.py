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
from vibrissa.objects.surface import Surface
from vibrissa.recording import recorded_cameras, recorded_objects, recorded_whisker
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
    groups = {name: _group(recording, name) for name in ("estimates", "signals", "truth")}
    groups["root"] = root
    shape = (root.sizes["time"], root.sizes["whisker"])
    whiskers = tuple(recorded_whisker(recording, i) for i in range(shape[1]))
    contacts = _first(groups, "contact_point", ("estimates", "root", "truth"))
    if contacts is None:
        contacts = np.full((*shape, 3), np.nan)
    felt = _first(groups, "in_contact", ("estimates", "root", "truth"))
    touching: Mask = np.asarray(np.isfinite(contacts).all(axis=-1))
    if felt is not None:
        touching = touching & (np.nan_to_num(felt) > 0.0)
    forces, signals = _felt(groups, shape)
    cameras = recorded_cameras(recording) if "cameras" in recording.children else ()
    return Watched(
        time=np.asarray(root["time"].to_numpy(), dtype=np.float64),
        whiskers=whiskers,
        names=tuple(str(name) for name in root["whisker"].to_numpy()),
        lines=_lines(groups, whiskers),
        contacts=np.where(touching[..., None], contacts, np.nan),
        felt=touching,
        forces=forces,
        signals=signals,
        objects=recorded_objects(recording),
        contour=_group(recording, "contour"),
        cameras=cameras,
        traces=_first(groups, "trace", ("root", "truth")) if cameras else None,
    )


def _group(recording: xr.DataTree, name: str) -> xr.Dataset | None:
    group = recording.children.get(name)
    return None if group is None else group.to_dataset()


def _first(groups: dict[str, xr.Dataset | None], name: str, order: Sequence[str]) -> Array | None:
    """Values of a variable out of the first group that has some."""
    for key in order:
        group = groups[key]
        if group is not None and name in group:
            values = np.asarray(group[name].to_numpy(), dtype=np.float64)
            if np.isfinite(values).any():
                return values
    return None


def _lines(groups: dict[str, xr.Dataset | None], whiskers: Sequence[Whisker]) -> Array:
    """Centrelines as recorded, else the resting whisker where its base is."""
    lines = _first(groups, "centerline", ("root", "truth"))
    if lines is not None:
        return lines
    place = _first(groups, "base_position", ("root", "truth"))
    turn = _first(groups, "base_rotation", ("root", "truth"))
    if place is None or turn is None:
        raise ValueError("the recording has neither centrelines nor poses of the whisker's base")
    rest = np.stack([whisker.centerline(NODES) for whisker in whiskers])
    return np.asarray(np.einsum("twij,wkj->twki", turn, rest) + place[:, :, None])


def _felt(
    groups: dict[str, xr.Dataset | None], shape: tuple[int, int]
) -> tuple[Array, dict[str, Array]]:
    """Forces in the laboratory and the six signals; NaN where nothing is known."""
    missing = np.full((*shape, 3), np.nan)
    force = _first(groups, "force", ("signals", "root", "truth"))
    moment = _first(groups, "moment", ("signals", "root", "truth"))
    if force is None or moment is None:
        force, moment = missing, missing
    turn = _first(groups, "base_rotation", ("signals", "root", "truth"))
    in_lab = missing if turn is None else np.einsum("twij,twj->twi", turn, force)
    signals = base_signals(force, moment)
    return in_lab, {name: np.asarray(signals[name].to_numpy()) for name in SIGNALS}
