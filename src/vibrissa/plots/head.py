"""Where a rat's head must be in a trial, and its outline from any side."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from vibrissa.plots.course import Course
from vibrissa.plots.style import Array
from vibrissa.plots.things import eye_triangles, head_triangles

_PAD = np.array([7.7e-3, -9.0e-3, -4.9e-3])
"""Where a whisker at the right begins if nothing else is known: right, forward, up of the snout."""

_FAR = 2e-3
"""From how far a base lies from the head's origin, m, this is the snout."""

_SKIN, _EDGE, _EYE = "#efe6dc", "#a89a8c", "#5a4f45"


class Head(NamedTuple):
    """Where a head is."""

    snout: Array
    axes: Array


def head_of(course: Course) -> Head:
    """Say where the head must be, on the average of a trial.

    Where the recording does not tell, the head is level, the whisker points away from it sideways
    and curves forward, and its base is on the snout.
    """
    base = np.nanmean(course.position, axis=0)
    if course.head is not None:
        position, rotation = course.head
        axes = _nearest_rotation(np.nanmean(rotation, axis=0))
        snout = np.nanmean(position, axis=0)
        if np.linalg.norm(base - snout) > _FAR:
            return Head(snout, axes)
    else:
        axes = _level(np.nanmean(course.rotation, axis=0))
    mean = np.nanmean(course.rotation, axis=0)
    side = np.sign(mean[:, 0] @ axes[:, 0]) or 1.0
    return Head(base - axes @ (_PAD * np.array([side, 1.0, 1.0])), axes)


def _level(mean: Array) -> Array:
    """Right, forward and up of a level head, from the mean of the base's axes."""
    sideways, forward = mean[:2, 0], mean[:2, 1]
    n = int(np.argmax(np.abs(sideways)))
    way = np.zeros(3)
    # A whisker that points more or less along x or y belongs to a head that stands straight.
    way[n] = np.sign(sideways[n]) or 1.0
    ahead = np.cross([0.0, 0.0, 1.0], way)
    if forward @ ahead[:2] < 0.0:
        ahead = -ahead
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    return np.stack([right, ahead, [0.0, 0.0, 1.0]], axis=1)


def _nearest_rotation(mean: Array) -> Array:
    left, _, right = np.linalg.svd(mean)
    return np.asarray(left @ right)


def draw_head(axes: Axes, head: Head, view: tuple[int, int]) -> None:
    """Draw the outline of a head, filled."""
    skin = _outline(head_triangles(head.axes, head.snout), view)
    axes.add_patch(Polygon(skin, facecolor=_SKIN, edgecolor=_EDGE, linewidth=0.8, zorder=0.5))
    eyes = eye_triangles(head.axes, head.snout)
    for eye in np.split(eyes, 2):
        axes.add_patch(Polygon(_outline(eye, view), facecolor=_EYE, edgecolor="none", zorder=0.6))


def _outline(triangles: Array, view: tuple[int, int]) -> Array:
    """Hull (n, 2) of what is seen: a head has no hollows."""
    from scipy.spatial import ConvexHull

    points = triangles.reshape(-1, 3)[:, list(view)]
    return np.asarray(points[ConvexHull(points).vertices])
