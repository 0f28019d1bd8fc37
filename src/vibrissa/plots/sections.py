"""Objects cut open: outlines of cylinders, and sections of anything with a signed distance."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from vibrissa.plots.outlines import Body
from vibrissa.plots.style import MUTED, ORANGE, Array
from vibrissa.quantities import to_display

BAND: dict[str, Any] = {"facecolor": ORANGE, "alpha": 0.25, "linewidth": 0.0, "zorder": 2}
"""Look of a band."""

_CELLS = 91
_NORMAL_95 = 1.959963984540054
_FLAT = 0.8
_UNKNOWN = 0.05
"""Standard deviation, as a share of the view's width, from which a surface is not drawn."""


def is_cylinder(body: Body) -> bool:
    """Tell whether a body is a cylinder."""
    return hasattr(body, "axis") and hasattr(body, "radius")


def has_band(body: Body) -> bool:
    """Tell whether a body is drawn with a band."""
    return hasattr(body, "distance_sigma") and not is_cylinder(body)


def lies_flat(body: Body, view: tuple[int, int], places: Array) -> bool:
    """Tell whether one looks straight at a surface, so that a section would lie in it."""
    normals = getattr(body, "outward_normals", None)
    if normals is None:
        return False
    toward = np.abs(normals(1e-3 * places)[:, 3 - sum(view)])
    return bool(np.nanmedian(toward) > _FLAT)


def outline(cylinder: Any, view: tuple[int, int], height: float, limits: Array) -> Array:
    """Give the outline of a cylinder: from above its section, from the side its silhouette."""
    origin = to_display("peg_position", cylinder.origin)
    radius = float(to_display("peg_radius", cylinder.radius))
    axis = np.asarray(cylinder.axis, dtype=np.float64)
    axis = axis / np.linalg.norm(axis)
    if view == (0, 1) and abs(axis[2]) > 0.2:
        first = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        turn = np.linspace(0.0, 2.0 * np.pi, 181)[:, None]
        circle = origin + radius * (np.cos(turn) * first + np.sin(turn) * np.cross(axis, first))
        # Along the axis, until all of the circle is at this height.
        circle += (height - circle[:, 2:]) / axis[2] * axis
        return np.asarray(circle[:, :2])
    i, j = view
    along = np.array([axis[i], axis[j]])
    along = along / max(float(np.linalg.norm(along)), 1e-12)
    across = radius * np.array([-along[1], along[0]])
    far = 2.0 * float(np.ptp(limits, axis=1).max()) * along
    middle = origin[[i, j]]
    # From where the axis passes nearest to the middle of the view.
    middle = middle + ((limits[[i, j]].mean(axis=1) - middle) @ along) * along
    return np.array(
        [middle - far + across, middle + far + across, middle + far - across, middle - far - across]
    )


def draw_section(
    axes: Axes, body: Body, view: tuple[int, int], depth: float, limits: Array, look: str
) -> None:
    """Draw a section through an object, with its 95 % band where it has one."""
    i, j = view
    right, up = (np.linspace(limits[n, 0], limits[n, 1], _CELLS) for n in view)
    points: Array = np.empty((_CELLS, _CELLS, 3))
    points[..., i], points[..., j], points[..., 3 - i - j] = right, up[:, None], depth
    distance = 1e3 * np.asarray(body.signed_distance(1e-3 * points))
    if not distance.min() < 0.0 < distance.max():
        return
    if look == "true":
        axes.contourf(right, up, distance, [-np.inf, 0.0], colors=["#ececec"], zorder=1)
        axes.contour(right, up, distance, [0.0], colors=[MUTED], linewidths=0.8, zorder=1.5)
        return
    if has_band(body):
        sigma = 1e3 * np.asarray(getattr(body, "distance_sigma")(1e-3 * points))  # noqa: B009
        sure = sigma < _UNKNOWN * np.ptp(limits[i])
        if not sure.any():
            return
        distance = np.where(sure, distance, np.nan)
        within = np.abs(distance) - _NORMAL_95 * sigma
        shade: dict[str, Any] = {"colors": [ORANGE], "alpha": 0.25, "zorder": 2}
        if not (np.nanmin(distance) < 0.0 < np.nanmax(distance)):
            return
        axes.contourf(right, up, within, [-np.inf, 0.0], **shade)
    dashes: Any = [(0, (4, 2))]
    lines: dict[str, Any] = {"linewidths": 1.0, "linestyles": dashes, "zorder": 4}
    axes.contour(right, up, distance, [0.0], colors=[ORANGE], **lines)
