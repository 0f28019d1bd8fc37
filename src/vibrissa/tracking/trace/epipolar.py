"""Search for a faint whisker in one view along the epipolar lines of its points in another.

In front of grey fur a whisker is a faint line among hairs that are as dark, and hard to see in that
view alone. Another view, which shows it in front of open ground, leaves one unknown for each of its
points: the distance t along its epipolar line. Of all smooth t(s), dynamic programming over t and
its slope finds the one along which the image is most like a line: with the curvature of the
smoothed image across the curve in units of its noise, r, which is positive on dark lines,

    Σ r(s, t, t′) − _TURN · (number of changes of slope) → max

The same for the inverted image gives the score of fur and noise alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.cameras import Camera, triangulate
from vibrissa.io import Frame
from vibrissa.numerics import Array
from vibrissa.tracking.trace.curves import Curve, smoothed
from vibrissa.tracking.trace.scene import Bodies, Image, Scene
from vibrissa.tracking.trace.trace import arc_lengths, interpolated

_STEP = 4.0  # distance of the points that are searched, pixels
_STEEP = 8  # largest change of t from one point to the next, pixels
_SLOPES = np.arange(-_STEEP, _STEEP + 1)

_TURN = 0.3  # cost of changing the slope by a pixel
_MOST = 12.0  # strength, in units of the noise, at which the score of a line saturates
_APART = 8.0  # distance from the dark curve within which its own flanks are bright, pixels
# Number of points next to the base that show whether the line begins there, and the smallest share
# of them before a body: where less is, the view by itself shows where the whisker begins.
_FIRST, _MOSTLY = 10, 0.75


def seen_along(
    curve: Curve, known: Camera, camera: Camera, frame: Frame, scene: Scene
) -> Curve | None:
    """Find a moving line along a curve that another camera sees; None if that is out of view."""
    s = arc_lengths(curve.line)
    wanted = np.linspace(0.0, s[-1], max(int(s[-1] / _STEP), 2) + 1)
    start, along = _epipolar_lines(interpolated(wanted, s, curve.line), known, camera)
    far = int(np.hypot(*camera.size))
    points = start[:, None] + np.arange(-far, far + 1)[:, None] * along[:, None]
    within = (points > 0.0) & (points < np.array(camera.size) - 1.0)
    in_image = np.asarray(within.all(axis=2))
    rows = np.flatnonzero(in_image.any(axis=0))
    if not rows.size:
        return None
    points = points[:, rows[0] : rows[-1] + 1]
    in_image = in_image[:, rows[0] : rows[-1] + 1]
    bodies = scene.bodies(frame)
    smooth, factors = smoothed(scene.change(frame), bodies)
    middle = points[:, points.shape[1] // 2]
    ways = np.gradient(middle, axis=0)[:, None] + _SLOPES[:, None] * along[:, None]
    strength = _strengths(points, ways, smooth, factors, bodies)
    dark, path = _best_path(strength + np.where(in_image, 0.0, -_MOST)[:, None])
    line = points[np.arange(len(points)), path]
    apart = np.linalg.norm(points - line[:, None], axis=2) > _APART
    bright, _ = _best_path(-strength + np.where(in_image & apart, 0.0, -_MOST)[:, None])
    # Its beginning is in front of a body, where the other view shows it: the line does not extend
    # beyond.
    on_body = float(np.mean(bodies.at(line[:_FIRST]) != 0))
    back = line[0] - line[min(_FIRST, len(line) - 1)]
    part = np.concatenate([line[0] + np.linspace(1.0, 0.0, _FIRST + 1)[:-1, None] * back, line])
    ways = np.gradient(part, axis=0)[:, None]
    seen = _strengths(part[:, None], ways, smooth, factors, bodies)[:, 0, 0]
    noise, before, first = bright / len(line), seen[:_FIRST].mean(), seen[_FIRST:][:_FIRST].mean()
    rest = max(noise / max(dark / len(line), 1e-9), max(noise, before) / max(first, 1e-9), 0.0)
    clear = max(1.0 - float(rest), 0.0) if on_body > _MOSTLY else 0.0
    length = float(arc_lengths(line)[-1])
    return Curve(line, length, from_face=False, score=length * clear, moved=1.0)


def _epipolar_lines(pixels: Array, known: Camera, camera: Camera) -> tuple[Array, Array]:
    """Points (n, 2) in a view for points of another one, and directions of epipolar lines."""
    middle = np.broadcast_to(0.5 * (np.array(camera.size) - 1.0), pixels.shape)
    point, _ = triangulate([known, camera], np.stack([pixels, middle]))
    origin, ray = known.rays(pixels)
    point = origin + ((point - origin) * ray).sum(axis=1, keepdims=True) * ray
    start, slopes = camera.project_with_slopes(point)
    along = (slopes @ ray[..., None])[..., 0]
    return start, along / np.linalg.norm(along, axis=1, keepdims=True)


def _strengths(points: Array, ways: Array, smooth: Image, factors: Array, bodies: Bodies) -> Array:
    """Darkness (n, m, t) of a line through points (n, t, 2) in directions (n, m, 2)."""
    height, width = smooth.shape
    column = np.rint(points[..., 0]).astype(np.intp).clip(1, width - 2)
    row = np.rint(points[..., 1]).astype(np.intp).clip(1, height - 2)
    twice = 2.0 * smooth[row, column]
    xx = smooth[row, column - 1] + smooth[row, column + 1] - twice
    yy = smooth[row - 1, column] + smooth[row + 1, column] - twice
    xy = smooth[row - 1, column - 1] + smooth[row + 1, column + 1]
    xy = 0.25 * (xy - smooth[row - 1, column + 1] - smooth[row + 1, column - 1])
    on_body = bodies.at(points.reshape(-1, 2)).reshape(row.shape) != 0
    factor = factors[on_body.astype(np.intp)]
    ways = ways / np.maximum(np.linalg.norm(ways, axis=2, keepdims=True), 1e-9)
    # The normal is (−y, x) of the direction.
    x, y = ways[:, :, 0, None], ways[:, :, 1, None]
    across = y * y * xx[:, None] - 2.0 * x * y * xy[:, None] + x * x * yy[:, None]
    return np.asarray(np.clip(-across * factor[:, None], -_MOST, _MOST))


def _best_path(reward: Array) -> tuple[float, NDArray[np.intp]]:
    """Largest sum of rewards (n, slope, t) along a smooth path, and its t, (n,)."""
    count = reward.shape[2]
    before = np.arange(count) - _SLOPES[:, None]
    outside = (before < 0) | (before >= count)
    before = before.clip(0, count - 1)
    total, came = reward[0], []
    for one in reward[1:]:
        near = np.pad(total, ((1, 1), (0, 0)), constant_values=-np.inf)
        choices = np.stack([near[1:-1], near[:-2] - _TURN, near[2:] - _TURN])
        chosen = choices.argmax(axis=0)
        best = np.take_along_axis(choices.max(axis=0), before, axis=1)
        came.append(np.take_along_axis(chosen, before, axis=1))
        total = one + np.where(outside, -np.inf, best)
    slope, t = (int(k) for k in np.unravel_index(total.argmax(), total.shape))
    path, best_total = [t], float(total[slope, t])
    for chosen in reversed(came):
        change = (0, -1, 1)[chosen[slope, t]]
        t, slope = t - int(_SLOPES[slope]), slope + change
        path.append(t)
    return best_total, np.array(path[::-1])
