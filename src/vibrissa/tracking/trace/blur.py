"""Uncertainty of traces where the motion of the whisker blurs its image.

A whisker that moves by v pixels a frame across itself is blurred over b = e v, where e is the share
of a frame for which an image is exposed. A blurred line is wider, by b² / 12 in variance, and
fainter; where it is wider than what a trace is measured by, that wanders about within it. The
exposure is found from how much wider a whisker looks the faster it moves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vibrissa.numerics import Array
from vibrissa.tracking.trace.trace import Trace, normals

# Width of the blur up to which traces are not affected, pixels; and excess of it whose square
# is their error in pixels.
_SHARP, _ASTRAY = 2.5, 30.0**0.5
# Speeds between which the width shows the exposure, pixels a frame: wider profiles are cut off.
_SLOW, _FAST = 1.5, 6.0
_SHORT = 0.25  # share of a frame below which an exposure is not distinguished from none
_LARGEST = 2.0  # errors that are still due to blur, standard deviations
_FEWEST = 5  # number of frames that show the width, of a slow whisker and of a fast one


def with_blur(traces: Sequence[Sequence[Trace]]) -> tuple[list[list[Trace]], Array]:
    """Traces by view with the uncertainty due to motion, and the largest error of each frame.

    The latter, in pixels, is two standard deviations, as their root mean square along the whisker
    in the view that is blurred most.
    """
    found, errors = list[list[Trace]](), np.zeros((len(traces), len(traces[0])))
    for v, row in enumerate(traces):
        lost = Trace.lost()
        speeds = list(map(_speed, [lost, *row[:-1]], row, [*row[1:], lost]))
        share = exposure(row, speeds)
        found.append(list(row))
        for i, (trace, speed) in enumerate(zip(row, speeds, strict=True)):
            error = (np.maximum(share * speed - _SHARP, 0.0) / _ASTRAY) ** 2
            if error.any():
                errors[v, i] = np.sqrt(np.mean(error**2))
                found[v][i] = trace._replace(sigma=np.hypot(trace.sigma, error))
    return found, _LARGEST * errors.max(axis=0)


def exposure(row: Sequence[Trace], speeds: Sequence[Array]) -> float:
    """Share of a frame for which images are exposed; 0 if no motion shows it."""
    nearer = [speed[len(speed) // 8 : len(speed) // 2] for speed in speeds]
    pace = np.array([np.mean(v**2) if v.size else np.nan for v in nearer])
    square = np.array([trace.width**2 for trace in row])
    known = np.isfinite(square)
    slow = known & (pace < _SLOW**2)
    fast = known & (pace > _SLOW**2) & (pace < _FAST**2)
    if min(slow.sum(), fast.sum()) < _FEWEST:
        return 0.0
    wider = square[fast] - np.median(square[slow])
    share = float(np.sqrt(np.clip(12.0 * np.median(wider / pace[fast]), 0.0, 1.0)))
    return share if share > _SHORT else 0.0


def _speed(before: Trace, here: Trace, after: Trace) -> Array:
    """Speed of the points of a trace across it, pixels a frame; 0 where that is not known."""
    others = [(one, gap) for one, gap in ((before, -0.5), (after, 0.5)) if len(one.line) > 1]
    count = min([len(here.line), *(len(one.line) for one, _ in others)])
    if not others or count < 2:
        return np.zeros(len(here.line))
    if len(others) == 1:
        others = [(others[0][0], 2.0 * others[0][1]), (here, -2.0 * others[0][1])]
    moved = sum((gap * one.line[:count] for one, gap in others), np.zeros((count, 2)))
    across = np.abs((moved * normals(here.line)[:count]).sum(axis=1))
    return np.pad(across, (0, len(here.line) - count), mode="edge")
