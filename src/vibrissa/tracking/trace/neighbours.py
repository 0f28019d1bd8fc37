"""Neighbours of the requested whiskers, which are followed too so that none takes their lines.

In some frames, lines that move and leave the face are found, and the motion of the face between
these frames from their beginnings. Lines that begin at one position on the face belong to one hair
or whisker; a whisker is sometimes as long as others. A hair may be joined to the end of a whisker
that it crosses: in some of the frames all are begun together, which assigns that end to the
whisker.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vibrissa.io import Frame
from vibrissa.numerics import Array
from vibrissa.tracking.trace.curves import Curve, find_curves
from vibrissa.tracking.trace.follower import start_at
from vibrissa.tracking.trace.row import CLICK, follow_row, from_click
from vibrissa.tracking.trace.scene import Scene
from vibrissa.tracking.trace.trace import TraceOptions

_MOVED = 0.4  # share of a line that moves, from which it may be a whisker
# Smallest length of a neighbour, pixels and as a share of those that are asked for, and smallest
# share of the frames in which a line begins there.
_HAIR, _COMPARABLE, _OFTEN = 80.0, 0.3, 0.3
# Largest distances of two beginnings of one whisker, and by which the face moves, pixels.
_STRAYS, _FARTHEST = 4.0, 25.0
# Distance from a base up to which a line begins at it, across: it may do so farther along itself.
_OTHER = 6.0
_TOGETHER = 0.5  # share of those that are asked for with which a neighbour is seen together
_BEGUN = 3  # number of frames in which all are begun together; most of them show a neighbour


def neighbours(
    frames: Sequence[Frame], clicks: Array, scene: Scene, options: TraceOptions
) -> list[Array]:
    """Bases (2,), in the first of some frames, of whiskers other than those clicked (n, 2)."""
    if scene.background is None:
        return []
    moves = [
        [c for c in find_curves(frame, scene, options) if c.from_face and c.moved > _MOVED]
        for frame in frames
    ]
    shifts, places = _on_face(moves)
    whose = [
        [_nearest(curve.line[0] - shift, places) for curve in curves]
        for shift, curves in zip(shifts, moves, strict=True)
    ]
    length = np.zeros((len(frames), len(places)))
    away = np.full((len(clicks), len(places)), np.inf)
    for i, curves in enumerate(moves):
        for place, curve in zip(whose[i], curves, strict=True):
            length[i, place] = max(length[i, place], curve.length)
            far = [from_click(click, curve.line - shifts[i]) for click in clicks]
            away[:, place] = np.minimum(away[:, place], far)
    asked = [int(np.argmin(row)) for row in away if row.min(initial=np.inf) < 2.0 * CLICK]
    if len(set(asked)) < len(clicks):
        return []
    often = (length > 0.0).mean(axis=0) >= _OFTEN
    longest = length.max(axis=0)
    often &= (longest > _HAIR) & (away.min(axis=0) > _OTHER)
    others = [k for k in np.flatnonzero(often) if k not in asked]
    if not others:
        return []
    # What is joined to a whisker's end, or is that whisker elsewhere, is not seen together with it.
    least = np.full(len(asked) + len(others), max(_HAIR, _COMPARABLE * longest[asked].max()))
    least[: len(asked)] = np.minimum(_HAIR, 0.5 * longest[asked])
    shown = np.zeros(len(others))
    for i in np.linspace(0, len(frames) - 1, _BEGUN).astype(int):
        every = [start_at(at + shifts[i], options) for at in (*clicks, *places[others])]
        seen = [trace.support for trace in follow_row(every, frames[i], {}, scene=scene)]
        long = np.array(seen) > least
        shown += long[len(asked) :] & (long[: len(asked)].mean() >= _TOGETHER)
    return [places[k] for k, count in zip(others, shown, strict=True) if 2 * count > _BEGUN]


def _on_face(moves: Sequence[Sequence[Curve]]) -> tuple[list[Array], Array]:
    """Shift of the face in each frame, and where lines begin on it in the first."""
    shifts, places = [np.zeros(2)], np.array([c.line[0] for c in moves[0]]).reshape(-1, 2)
    for curves in moves[1:]:
        at = np.array([curve.line[0] for curve in curves]).reshape(-1, 2)
        between = (at[None] - places[:, None]).reshape(-1, 2)
        tried = np.concatenate([shifts[-1][None], between])
        tried = tried[np.hypot(*tried.T) < _FARTHEST]
        distance = np.linalg.norm(
            at[None, :, None] - tried[:, None, None] - places[None, None], axis=3
        ).min(axis=2, initial=_STRAYS)
        shifts.append(tried[np.argmin((distance**2).sum(axis=1))])
        for begin in at - shifts[-1]:
            if not len(places) or np.hypot(*(places - begin).T).min() > _STRAYS:
                places = np.concatenate([places, begin[None]])
    return shifts, places


def _nearest(at: Array, places: Array) -> int:
    return int(np.argmin(np.hypot(*(places - at).T)))
