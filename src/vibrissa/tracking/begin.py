"""Where to begin: what is seen in the first frames of all views together.

A view alone may take an edge of an object for the face, or a seam of the background for a whisker.
Of all lines, each one way or the other, those count that views see as one curve in space; of these
one that begins at the face in all views comes first, then one that gets thinner outward, then the
one that is seen over the longest way.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vibrissa.io.video import Frame
from vibrissa.tracking import ridge
from vibrissa.tracking.find import Found, darker_inward, find_whiskers
from vibrissa.tracking.follow import start_at
from vibrissa.tracking.space import merge
from vibrissa.tracking.trace import Trace, TraceOptions
from vibrissa.trial.cameras import Camera
from vibrissa.trial.triangulation import triangulate

Array = NDArray[np.float64]

_LINES = 6
"""How many lines of a view are looked at."""

_APART = 3.0
"""How far bases may be from where the other views say, pixels."""

_MISFIT = 40.0
"""Misfit of a curve in space, in standard deviations, from which it is none: a few pixels."""

_BETTER = 1.5
"""By how much more must be seen of a bright whisker than of a dark one."""

_THINNER = 2.0
"""By how much a whisker must get fainter to be told from its other end, in units of the noise."""


def negative(frame: Frame) -> Frame:
    """Turn bright into dark.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.

    Returns
    -------
    array (height, width)
        The largest grey value there can be, less these.
    """
    return np.asarray(np.iinfo(frame.dtype).max - frame, dtype=frame.dtype)


def is_bright(
    frame: Frame, bases: Sequence[ArrayLike] | None = None, options: TraceOptions | None = None
) -> bool:
    """Say whether whiskers are bright on a dark background.

    Parameters
    ----------
    frame : array (height, width)
        Grey values.
    bases : sequence of array_like (2,), optional
        Where whiskers begin.
    options : TraceOptions, optional
        How they are traced; ``bright``, unless None, is the answer.

    Returns
    -------
    bool
        Whether clearly more is seen of bright whiskers than of dark ones.
    """
    options = options or TraceOptions()
    if options.bright is not None:
        return options.bright
    dark, bright = (_seen(one, bases, options) for one in (frame, negative(frame)))
    return bright > _BETTER * dark


def _seen(frame: Frame, bases: Sequence[ArrayLike] | None, options: TraceOptions) -> float:
    """Length that is seen, pixels; twice that of what begins at a face."""
    if bases is None:
        found = find_whiskers(frame, options)[:1]
        return sum(f.trace.support * (2.0 if f.from_face else 1.0) for f in found)
    noise = ridge.noise_level(frame)
    return sum(
        max((t.support for t in start_at(base, options).from_base(frame, noise)), default=0.0)
        for base in bases
    )


def find_bases(
    cameras: Sequence[Camera], frames: Sequence[Frame], options: TraceOptions | None = None
) -> list[Array] | None:
    """Find where the whisker begins that all views show.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    frames : sequence of array (height, width)
        One of each view, of the same moment.
    options : TraceOptions, optional
        How whiskers are traced.

    Returns
    -------
    list of array (2,), or None
        Column and row of its base in each view; None if no line is the same in all.
    """
    options = options or TraceOptions()
    frames = [negative(f) if is_bright(f, None, options) else f for f in frames]
    lines = [_both_ways(find_whiskers(f, options)[:_LINES]) for f in frames]
    best: tuple[tuple[bool, int, int, float], list[Array]] | None = None
    for one in product(*lines):
        traces = [found.trace for found in one]
        if not _same(cameras, traces):
            continue
        faces = sum(found.from_face for found in one)
        thinner = sum(
            darker_inward(f, ridge.noise_level(f), t, options) / ridge.noise_level(f)
            for f, t in zip(frames, traces, strict=True)
        )
        sure = int(np.sign(thinner)) if abs(thinner) > _THINNER else 0
        worth = (faces == len(cameras), sure, faces, sum(t.support for t in traces))
        if best is None or worth > best[0]:
            best = worth, [trace.line[0] for trace in traces]
    return None if best is None else best[1]


def _both_ways(found: Sequence[Found]) -> list[Found]:
    turned = [
        Found(
            Trace(t.line[::-1], t.sigma[::-1], t.seen[::-1], t.confidence),
            from_face=False,
        )
        for t, _ in found
    ]
    return [*found, *turned]


def _same(cameras: Sequence[Camera], traces: Sequence[Trace]) -> bool:
    """Whether traces are images of one curve in space."""
    if base_gap(cameras, np.array([trace.line[0] for trace in traces])) > _APART:
        return False
    return bool(merge(cameras, traces).misfit < _MISFIT)


def base_gap(cameras: Sequence[Camera], pixels: Array) -> Array:
    """Say how far points are from where the views together see them.

    Parameters
    ----------
    cameras : sequence of Camera
        The views.
    pixels : array (view, ..., 2)
        Of points that are to be the same.

    Returns
    -------
    array (...)
        Largest distance in any view, pixels; NaN where a view does not tell.
    """
    place, _ = triangulate(cameras, pixels)
    seen = np.stack([camera.project(place) for camera in cameras])
    return np.asarray(np.linalg.norm(seen - pixels, axis=-1).max(axis=0))
