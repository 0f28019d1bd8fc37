"""A short whisk past a peg, filmed small: its truth is known to the last digit."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from vibrissa import Whisker
from vibrissa.cameras import orthogonal_views
from vibrissa.objects import Peg
from vibrissa.simulation import Motion, film_frames, simulate, with_true_traces
from vibrissa.tracking import trace_video

sys.path.append(str(Path(__file__).parent))  # tests and studies share the maker of films, furry.py

FRAMES = 40
CAMERAS = orthogonal_views(size=(256, 256), center=(5e-3, 0.0, 0.0))


class Filmed:
    """A trial, its cameras and its frames, view by view."""

    def __init__(self, recording, cameras=CAMERAS):
        self.recording = with_true_traces(recording, cameras)
        self.cameras = cameras
        self.frames = [
            list(film_frames(recording, camera, seed=i)) for i, camera in enumerate(cameras)
        ]
        self.truth = self.recording["truth"].to_dataset().isel(whisker=0)

    def curve(self, frame, view):
        """The true middle of the whisker, densely, pixels."""
        nodes = self.truth["trace"].values[frame, view]
        return CubicSpline(np.linspace(0.0, 1.0, len(nodes)), nodes)(np.linspace(0.0, 1.0, 800))

    def errors(self, line, frame, view):
        """Distances of points from the true middle, and of base and tip from the true ones."""
        curve = self.curve(frame, view)
        tangent = np.gradient(curve, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        _, nearest = cKDTree(curve).query(line)
        x, y = (line - curve[nearest]).T
        away = np.abs(x * tangent[nearest, 1] - y * tangent[nearest, 0])
        ends = [np.linalg.norm(line[i] - curve[i]) for i in (0, -1)]
        return away, ends

    def tip_shows(self, frame, view):
        """Whether the last third is in the image, not hidden, and not dark on dark."""
        nodes = self.truth["trace"].values[frame, view, -12:].astype(int)
        if not self.truth["trace_visible"].values[frame, view, -12:].all():
            return False
        image = self.frames[view][frame]
        return all(
            np.median(image[max(y - 6, 0) : y + 7, max(x - 6, 0) : x + 7]) > 100 for x, y in nodes
        )


def whisk(whisker, peg, frames=FRAMES):
    """Protract into the peg from behind and slip past it."""
    t = np.arange(frames) / 1000.0
    azimuth = np.linspace(-0.10, 0.95, frames)
    return simulate(
        whisker,
        Motion(
            time=t,
            azimuth=azimuth,
            elevation=0.05 + 0.2 * azimuth,
            roll=0.2 * azimuth,
            base_position=np.outer(t, [0.002, -0.003, 0.001]),
        ),
        peg,
    )


@pytest.fixture(scope="session")
def filmed():
    whisker = Whisker.parabola(length=10e-3, coefficient=15.0)
    return Filmed(whisk(whisker, Peg([6e-3, 1.2e-3, 0.0], [0.0, 0.0, 1.0], 0.5e-3)))


@pytest.fixture(scope="session")
def traced(filmed):
    """Traces of that trial, view by view, without a click."""
    return [trace_video(frames) for frames in filmed.frames]


@pytest.fixture(scope="session")
def make_filmed():
    """Film any trial."""
    return Filmed
