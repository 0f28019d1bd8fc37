"""Camera images as they are shown: the part where whiskers go, with the trace drawn in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vibrissa.simulation import silhouette
from vibrissa.viewer.drawing import Array, Bytes
from vibrissa.viewer.watching import Watched

Frame = NDArray[np.uint8]

WIDTH = 420
"""Of a picture, pixels."""

_MARGIN = 40.0
_TRACE = np.array([255, 96, 0], dtype=np.uint8)
_CONTACT = np.array([0, 150, 255], dtype=np.uint8)


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
    out = np.repeat(source[np.ix_(rows, columns)][..., None], 3, axis=2)
    assert trial.traces is not None  # else there are no views
    for trace in trial.traces[frame, :, view.number]:
        _mark(out, (_dense(trace, view.scale) - [left, top]) * view.scale, _TRACE, 1)
    touching = trial.contacts[frame][trial.felt[frame]]
    if touching.size:
        seen = trial.cameras[view.number].project(touching)
        _mark(out, (seen - [left, top]) * view.scale, _CONTACT, 4)
    return out


def _dense(trace: Array, scale: float) -> Array:
    """Points of a trace (k, 2), half a pixel of the picture apart; none where it is lost."""
    known = trace[np.isfinite(trace).all(axis=1)]
    if len(known) < 2:
        return np.empty((0, 2))
    steps = np.linalg.norm(np.diff(known, axis=0), axis=1) * scale
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.arange(0.0, along[-1], 0.5)
    return np.stack([np.interp(at, along, known[:, i]) for i in range(2)], axis=1)


def _mark(picture: Bytes, places: Array, colour: Bytes, size: int) -> None:
    """Paint squares at places (n, 2): column, row."""
    height, width = picture.shape[:2]
    corner = np.round(places - 0.5 * (size - 1)).astype(int)
    for i in range(size):
        for j in range(size):
            x, y = corner[:, 0] + i, corner[:, 1] + j
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            picture[y[inside], x[inside]] = colour
