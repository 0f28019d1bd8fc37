"""How a whisker is rolled that is bent in every frame, from its shape beyond the contact.

What carries no load keeps its curvature: of all rolls about the tangent at the base, the one counts
with which bent rods come nearest to the shapes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vibrissa.rod import discretize
from vibrissa.tracking.pose import BasePose
from vibrissa.tracking.rods import State, first_contacts
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

_FRAMES = 9
_TURNS = 24


def rolled(pose: BasePose, curves: Array, whisker: Whisker) -> BasePose:
    """Give a pose the roll that the bent shapes show."""
    known = np.flatnonzero(np.isfinite(pose.azimuth) & np.isfinite(curves).all(axis=(1, 2)))
    frames = known[np.linspace(0, len(known) - 1, min(_FRAMES, len(known))).astype(int)]
    d = discretize(whisker)

    def cost(roll: float) -> float:
        turned = replace(pose, roll=np.full(len(pose.azimuth), roll)).rotation[frames]
        state = State(turned, pose.position[frames] / d.length, np.zeros((len(frames), 4)))
        all_ = np.ones(len(frames), dtype=bool)
        return float(first_contacts(d, state, curves[frames], all_)[1].sum())

    best, step = 0.0, 2.0 * np.pi / _TURNS
    tries = best + step * np.arange(_TURNS)
    while step > np.radians(1.0):
        best = float(tries[np.argmin([cost(roll) for roll in tries])])
        step /= 3.0
        tries = best + step * np.arange(-2, 3)
    roll = np.where(np.isfinite(pose.roll), best, np.nan)
    return replace(pose, roll=roll)
