"""How a whisker looks: by this it is known again where its place does not tell it from others.

A look is the length that is seen, how dark the whisker is beside its surroundings, from its base
outward, and by how much it turns from one piece to the next. The first two are logarithms, so that
differences are relative. What a look does not show, because the whisker is too short there, is NaN.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vibrissa.io import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.trace import Trace

Array = NDArray[np.float64]

_DARK = ((5, 25), (25, 50), (50, 80))
_ALONG = ((3, 11), (20, 28), (40, 48), (60, 68))
"""Points of a trace over which darkness and direction are taken."""

FEATURES = 1 + len(_DARK) + len(_ALONG) - 1

_SPREAD = np.array([0.12, *[0.15] * len(_DARK), *[0.03] * (len(_ALONG) - 1)])
"""By how much a whisker's look differs between frames at least."""

_SHORTER = 3.0
"""What is hidden or beyond the image makes a whisker look shorter; longer nothing does."""

_MOST = 3.0
"""Standard deviations beyond which a difference counts no more: contact bends, blur pales."""

_HIDDEN = 2.0
"""Standard deviations as which it counts that a line does not show what is usual."""

_WEIGHT = 0.5
"""Of the sum of squares: pieces of one whisker do not change independently."""

ENOUGH = 5
"""Frames after which it is known how a whisker looks."""


def look_of(frame: Frame, trace: Trace) -> Array:
    """Say how a whisker looks in a frame."""
    look = np.full(FEATURES, np.nan)
    n = len(trace.line)
    if n < 2 or not trace.seen.any():
        return look
    offset, amplitude, flank, support = (np.empty(n) for _ in range(4))
    line = np.ascontiguousarray(trace.line)
    ridge.measure(frame, line, 1, 1.0, 1.0, offset, amplitude, flank, support)
    contrast = amplitude / np.maximum(flank, 1.0)
    look[0] = np.log(trace.support)
    for i, (a, b) in enumerate(_DARK):
        seen = contrast[a:b][trace.seen[a:b]]
        if 2 * len(seen) >= b - a:
            look[1 + i] = np.log(max(float(np.median(seen)), 1e-3))
    steps = np.diff(line, axis=0)
    angle = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    along = [float(angle[a:b].mean()) if len(angle) >= b else np.nan for a, b in _ALONG]
    look[1 + len(_DARK) :] = np.diff(along)
    return look


def usual_look(looks: Sequence[Array]) -> tuple[Array, Array]:
    """Say how a whisker usually looks."""
    if len(looks) < ENOUGH:
        return np.full(FEATURES, np.nan), _SPREAD
    known = np.array(looks)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of what no frame shows
        middle = np.nanmedian(known, axis=0)
        spread = 1.4826 * np.nanmedian(np.abs(known - middle), axis=0)
    return middle, np.hypot(_SPREAD, np.nan_to_num(spread))


def unlikeness(look: Array, middle: Array, spread: Array) -> float:
    """Say how much a line looks unlike a whisker."""
    away = (look - middle) / spread
    if away[0] < 0.0:
        away[0] /= _SHORTER
    if np.isfinite(look[0]):
        away[np.isnan(look) & np.isfinite(middle)] = _HIDDEN
    return float(0.5 * _WEIGHT * np.minimum(np.nan_to_num(away) ** 2, _MOST**2).sum())
