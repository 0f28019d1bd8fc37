"""Films of rows of whiskers that cross before a furry face, with truth, by the film maker."""

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from vibrissa import Whisker
from vibrissa.cameras import orthogonal_views
from vibrissa.simulation import ImageConditions, Motion, film_frames, simulate, with_true_traces

RATE = 500.0
FACE = (8e-3, 8e-3, 8e-3)
FUR = ImageConditions(fur=7.0, exposure=2e-4, face=FACE)


@dataclass
class RowFilm:
    """Frames of two views, and where each whisker truly is in them."""

    seed: int
    count: int = 3
    frames: int = 200
    size: tuple[int, int] = (640, 480)
    conditions: ImageConditions = FUR
    apart: tuple[float, float] = (1.5e-3, 1.3e-3)
    cameras: tuple = field(init=False)
    images: list = field(init=False)
    truth: list = field(init=False)

    def __post_init__(self):
        random = np.random.default_rng([self.seed, 5])
        each = [self._one(k, random) for k in range(self.count)]
        whiskers, motions = zip(*each, strict=True)
        self.cameras = orthogonal_views(size=self.size, center=(11e-3, 0.0, 0.0))
        recording = with_true_traces(simulate(whiskers, motions, []), self.cameras)
        self.images = [
            list(film_frames(recording, camera, self.conditions, seed=self.seed + 100 * v))
            for v, camera in enumerate(self.cameras)
        ]
        traces = recording["truth"]["trace"].values
        self.truth = [traces[:, :, v] for v in range(len(self.cameras))]

    def _one(self, k, random):
        """A whisker of the row: neighbours turn by different angles, so that they cross."""
        t = np.arange(self.frames) / RATE
        place = k - 0.5 * (self.count - 1)
        phase = 2.0 * np.pi * 8.0 * t + 0.7 * self.seed - random.normal(0.0, 0.25)
        swing = np.radians(random.uniform(12.0, 20.0))
        azimuth = np.radians(-7.0 * place + random.normal(0.0, 3.0)) + swing * np.sin(phase)
        up = np.radians(-7.0 * place + random.normal(0.0, 3.0))
        elevation = up + 0.25 * swing * np.sin(phase + 0.8)
        length = random.uniform(19e-3, 26e-3)
        bend = random.uniform(3.0, 11.0) * random.choice([-1.0, 1.0])
        whisker = Whisker.parabola(length=length, coefficient=bend, name=f"w{k}")
        at = place * np.array(self.apart)
        back = FACE[0] * (1.0 - np.sqrt(1.0 - (at**2 / np.square(FACE[1:])).sum()))
        base = np.tile([-back, *at], (self.frames, 1))
        return whisker, Motion(t, azimuth, elevation, 0.2 * azimuth, base)


def curve(nodes):
    """The true middle of a whisker, finely."""
    return CubicSpline(np.linspace(0.0, 1.0, len(nodes)), nodes)(np.linspace(0.0, 1.0, 400))


def whose(line, curves):
    """Whose line it is over most of its length (−1: nobody's), or −2 for a line without points."""
    if not len(line):
        return -2
    away = np.array([cKDTree(each).query(line)[0] for each in curves])
    share = (away < 2.0).mean(axis=1)
    own = np.median(away, axis=1)
    best = int(np.argmin(own))
    return best if own[best] < 1.5 and share[best] > 0.6 else -1


def covered(line, whole):
    """Share of a true line that is traced within two pixels."""
    return float((cKDTree(line).query(whole)[0] < 2.0).mean())


def apart(curves, near=4.0):
    """Whether each whisker is distinguishable: most of it is far from all others."""
    found = []
    for k, each in enumerate(curves):
        others = np.concatenate([c for j, c in enumerate(curves) if j != k])
        found.append((cKDTree(others).query(each)[0] > near).mean() > 0.7)
    return np.array(found)


def scored(traces, truth):
    """Of each image of a whisker: 1 right, 0 lost, −1 on another whisker, −2 wrong otherwise.

    NaN where it cannot be distinguished.
    """
    score = np.full(truth.shape[:2], np.nan)
    for i, nodes in enumerate(truth):
        curves = [curve(each) for each in nodes]
        clear = apart(curves)
        for k, row in enumerate(traces):
            if not clear[k]:
                continue
            found = whose(row[i].line, curves)
            if found == k:
                far = covered(row[i].line, curves[k]) >= 0.4
                score[i, k] = 1.0 if far else -2.0
            else:
                score[i, k] = {-2: 0.0, -1: -2.0}.get(found, -1.0)
    return score
