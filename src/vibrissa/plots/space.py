"""Three-dimensional panels: axes to one scale, and surfaces that are lit.

Matplotlib's 3D axes carry no types, hence ``Any``. Surfaces are painted as pixels in a PDF too, so
that files stay small.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.plots.style import INK, Array
from vibrissa.quantities import axis_label

ELEVATION, AZIMUTH = 24.0, -58.0
"""From where space is seen, degrees, unless said otherwise."""

_FLAT = 0.70
"""Brightness of a surface that the light only grazes."""


def space_axes(
    figure: Figure,
    box: tuple[float, float, float, float],
    limits: Array,
    view: tuple[float, float] = (ELEVATION, AZIMUTH),
    *,
    zoom: float = 1.0,
    frame: bool = True,
    aspect: tuple[float, float, float] | None = None,
) -> Any:
    """Add three-dimensional axes, by default to one scale."""
    wide, tall = 25.4 * figure.get_size_inches()
    left, bottom, width, height = box
    place = (left / wide, bottom / tall, width / wide, height / tall)
    axes: Any = figure.add_axes(place, projection="3d", computed_zorder=False)
    axes.patch.set_visible(False)
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    axes.set_box_aspect(aspect or tuple(np.ptp(limits, axis=1)), zoom=zoom)
    axes.view_init(*view)
    axes.set_proj_type("persp", focal_length=1.6)
    if not frame:
        axes.set_axis_off()
        return axes
    for name in "xyz":
        axis = getattr(axes, f"{name}axis")
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set(color=INK, linewidth=0.5)
        axis._axinfo["grid"].update(color="#e2e2e2", linewidth=0.4)
        axis._axinfo["tick"].update(inward_factor=0.0, outward_factor=0.25)
    axes.tick_params(labelsize=5.5, pad=-4.0)
    axes.locator_params(nbins=4)
    return axes


def name_axes(axes: Any, pads: Sequence[float] = (-9.0, -10.0, -11.0)) -> None:
    """Write x, y and z at the axes."""
    for name, pad in zip("xyz", pads, strict=True):
        axis = getattr(axes, f"{name}axis")
        axis.set_label_text(axis_label(name), fontsize=6.0)
        axis.labelpad = pad


def bounds(points: ArrayLike, room: float = 0.02) -> Array:
    """Limits that hold points and the origin."""
    places = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    places = np.concatenate([places, np.zeros((1, 3))])
    low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
    margin = room * (high - low).max()
    return np.stack([low - margin, high + margin], axis=1)


def painted(values: Array, norm: Normalize, colours: Colormap) -> Array:
    """Colours of triangles by the mean of the values at their corners."""
    return np.asarray(colours(norm(values.mean(axis=1))), dtype=np.float64)


def paint(
    axes: Any, triangles: Array, colours: ArrayLike, *, opacity: float = 1.0, flat: float = _FLAT
) -> None:
    """Draw lit triangles; those of one call hide each other rightly."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    sized = triangles / np.ptp(limits, axis=1) * np.array(axes._box_aspect)
    normal = np.cross(sized[:, 1] - sized[:, 0], sized[:, 2] - sized[:, 0])
    length = np.linalg.norm(normal, axis=1)
    kept = length > 1e-12 * length.max(initial=1e-300)
    lit = np.abs(normal[kept] @ _light(axes.elev, axes.azim)) / length[kept]
    rgba = np.broadcast_to(np.asarray(colours, dtype=np.float64), (len(triangles), 4))[kept].copy()
    rgba[:, :3] *= (flat + (1.0 - flat) * lit)[:, None]
    rgba[:, 3] = opacity
    # Edges in the same colour close the seams; where one sees through, they would show twice.
    surface = Poly3DCollection(
        triangles[kept],
        facecolors=rgba,
        edgecolors=rgba if opacity == 1.0 else "none",
        linewidths=0.25 if opacity == 1.0 else 0.0,
        rasterized=True,
    )
    axes.add_collection3d(surface, autolim=False)


def _light(elevation: float, azimuth: float) -> Array:
    """Toward the light: from above the viewer's left shoulder."""
    e, a = np.radians(elevation + 25.0), np.radians(azimuth - 30.0)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
