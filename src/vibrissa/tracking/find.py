"""Find whiskers in a frame of which nothing is known."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.io import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.curves import find_curves
from vibrissa.tracking.ends import traced
from vibrissa.tracking.scene import Scene
from vibrissa.tracking.trace import Trace, TraceOptions

Array = NDArray[np.float64]


class Found(NamedTuple):
    """A whisker in one frame.

    Attributes
    ----------
    trace : Trace
        From base to tip.
    from_face : bool
        Whether it begins at something dark.
    """

    trace: Trace
    from_face: bool


def find_whiskers(frame: Frame, options: TraceOptions | None = None) -> list[Found]:
    """Find all whiskers of a frame.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.
    options : TraceOptions, optional
        How whiskers are traced; ``shortest`` says what is too short to be one.

    Returns
    -------
    list of Found
        Different ones, what is most like a whisker first; those that begin at something dark before
        others.
    """
    options = options or TraceOptions()
    noise = ridge.noise_level(frame)
    found: list[Found] = []
    for curve in find_curves(frame, Scene.of([frame], options.scale), options):
        if any(overlap(curve.line, other.trace.line) >= 0.5 for other in found):
            continue
        trace, from_face = traced(frame, noise, curve.line, options)
        if trace.support >= options.shortest:
            found.append(Found(trace, from_face))
    return sorted(found, key=lambda one: not one.from_face)


def overlap(line: Array, other: Array, near: float = 3.0) -> float:
    """Say which share of a line runs along another."""
    from scipy.spatial import cKDTree

    if not len(line) or not len(other):
        return 0.0
    distance, _ = cKDTree(other).query(line, distance_upper_bound=near)
    return float(np.isfinite(distance).mean())
