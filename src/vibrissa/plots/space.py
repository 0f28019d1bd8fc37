"""Three-dimensional panels: axes to one scale, lit surfaces, and signals in a cylinder.

Matplotlib's 3D axes carry no types, hence ``Any``. Surfaces are painted as pixels in a PDF too, so
that files stay small. The space of (F_x, M_B, M_D) is a cylinder: M_B is the distance from
the axis, M_D the angle about it, and F_x the height. M_B and F_x are drawn on square-root scales,
as most contacts are light, and in parallel projection, so that heights can be read off the axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.plots.style import INK, MUTED, PLAIN, SMALL, Box, box_axes
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import root, values_of

ELEVATION, AZIMUTH = 24.0, -58.0
"""Default direction of view, degrees."""

_FLAT = 0.70
"""Brightness of a surface that the light only grazes."""


def space_axes(
    figure: Figure,
    box: Box,
    limits: Array,
    view: tuple[float, float] = (ELEVATION, AZIMUTH),
    *,
    zoom: float = 1.0,
    frame: bool = True,
    aspect: tuple[float, float, float] | None = None,
    parallel: bool = False,
) -> Any:
    """Add three-dimensional axes, by default to one scale and in perspective."""
    axes: Any = box_axes(figure, box, projection="3d", computed_zorder=False)
    axes.patch.set_visible(False)
    axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
    axes.set_box_aspect(aspect or tuple(np.ptp(limits, axis=1)), zoom=zoom)
    axes.view_init(*view)
    if parallel:
        axes.set_proj_type("ortho")
    else:
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
    axes.tick_params(pad=-4.0)
    axes.locator_params(nbins=4)
    return axes


def name_axes(axes: Any, pads: Sequence[float] = (-9.0, -10.0, -11.0)) -> None:
    """Write x, y and z at the axes."""
    for name, pad in zip("xyz", pads, strict=True):
        axis = getattr(axes, f"{name}axis")
        axis.set_label_text(axis_label(name))
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


_VIEW = (16.0, -152.0)
_ASPECT = (1.0, 1.0, 0.85)
_FRONT = 222.0
"""Direction, degrees, in which rings carry their labels: toward the viewer."""

_AXIS = 1.4
"""Distance of the axis of F_x from the cylinder's axis, over its radius."""

_FLOOR: dict[str, Any] = {"color": "#c8c8c8", "linewidth": 0.4, "zorder": 0}


def signal_places(axial: ArrayLike, bending: ArrayLike, direction: ArrayLike) -> Array:
    """Positions of signals in the cylinder."""
    size = np.sqrt(to_display("MB", bending))
    turn = np.asarray(direction, dtype=np.float64)
    return np.stack(
        [size * np.cos(turn), size * np.sin(turn), root(to_display("Fx", axial))], axis=-1
    )


def signal_rows(rows: Array) -> Array:
    """Positions in the cylinder of rows of a sampled surface."""
    return signal_places(*(values_of(name, rows) for name in ("Fx", "MB", "MD")))


def signal_limits(places: Array) -> Array:
    """Limits of axes that hold places in the cylinder."""
    reach = float(np.hypot(places[..., 0], places[..., 1]).max()) * 1.02
    low, high = float(places[..., 2].min()), float(places[..., 2].max())
    room = 0.02 * (high - low)
    return np.array([[-reach, reach], [-reach, reach], [low - room, max(high, 0.0) + room]])


def square(box: Box) -> Box:
    """Give axes in space, which are square, the room of a panel, and somewhat more."""
    left, bottom, width, height = box
    side = max(width, height)
    return left + 0.5 * (width - side), bottom - 1.0 + 0.5 * (height - side), side, side


def signal_axes(figure: Figure, panel: Box, limits: Array) -> Any:
    """Add axes for the cylinder: rings of equal M_B and rays of equal M_D on its floor."""
    left, bottom, side, _ = square(panel)
    box = left + 3.5, bottom + 0.5, side, side
    zoom = 0.98 if side > 50.0 else 0.86  # lettering does not shrink with the panel
    axes = space_axes(
        figure, box, limits, _VIEW, zoom=zoom, frame=False, aspect=_ASPECT, parallel=True
    )
    reach, floor = limits[0, 1], limits[2, 0]
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    rings = _round_squares(0.0, reach)[1:]
    for ring in rings:
        places = np.sqrt(ring) * np.stack([np.cos(turn), np.sin(turn)])
        axes.plot(*places, floor, **_FLOOR)
        near = 1.0 if ring < rings[-1] else 1.28
        size, unit = quantity("MB").symbol, quantity("MB").display_unit
        label = f"{ring:g}" if ring < rings[-1] else f"${size}$ = {ring:g} {unit} (√ scale)"
        _write(axes, _FRONT, np.sqrt(ring) * near, floor, label, ha="left", va="top", color=MUTED)
    for angle in (0, 90, 180, -90):
        axes.plot(*np.outer(_toward(angle), [0.0, reach]), floor, **_FLOOR)
        if angle == 0:
            continue  # its end is hidden behind the solid
        label = f"{angle}°" if angle != 180 else f"${quantity('MD').symbol}$ = 180°"
        # The rays to the left end next to the solid and the largest ring's label, which centred
        # words would cover.
        far = {"ha": "right"} if angle in (90, 180) else {}
        _write(axes, angle, 1.17 * reach, floor, label.replace("-", "−"), **far)
    _height_axis(axes, limits)
    return axes


def _height_axis(axes: Any, limits: Array) -> None:
    """The axis of F_x, upright at the left."""
    reach, (floor, top) = limits[0, 1], limits[2]
    left = _VIEW[1] - 90.0
    place = _AXIS * reach * _toward(left)
    axes.plot(*np.repeat(place[:, None], 2, axis=1), [floor, top], color=INK, linewidth=0.5)
    for mark in _round_squares(floor, top):
        height = float(root(mark))
        tick = np.outer(_toward(left), [1.4 * reach, 1.45 * reach])
        axes.plot(*tick, height, color=INK, linewidth=0.5)
        label = f"{mark:g}".replace("-", "−")
        _write(axes, left, 1.49 * reach, height, label, ha="right")
    for up, text in ((0.15, axis_label("Fx")), (0.045, "√ scale")):
        height = top + up * (top - floor)
        _write(axes, left, 1.4 * reach, height, text, fontsize=PLAIN if up > 0.1 else SMALL)


def drop_lines(axes: Any, limits: Array, place: Array) -> None:
    """Lead from a place in the cylinder to the axis of F_x and to its foot on the floor."""
    axis = _AXIS * limits[0, 1] * _toward(_VIEW[1] - 90.0)
    look = {"color": MUTED, "linewidth": 0.5, "linestyle": (0, (2, 2)), "zorder": 11}
    axes.plot(*np.stack([place, [*axis, place[2]]]).T, **look)
    axes.plot(*np.stack([place, [*place[:2], limits[2, 0]]]).T, **look)


def coloured_segments(places: Array, values: Array) -> tuple[Array, Array]:
    """Segments (m, 2, k) of a path (n, k), with the mean value of each; gaps are left out."""
    segments = np.stack([places[:-1], places[1:]], axis=1)
    means = 0.5 * (values[:-1] + values[1:])
    kept = np.isfinite(segments).all(axis=(1, 2)) & np.isfinite(means)
    return segments[kept], means[kept]


def _toward(angle: float) -> Array:
    return np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])


def _write(axes: Any, angle: float, size: float, height: float, text: str, **look: Any) -> None:
    """A word in the cylinder, behind what is painted."""
    plain_look = {"fontsize": SMALL, "ha": "center", "va": "center", "zorder": 0}
    axes.text(*(size * _toward(angle)), height, text, **(plain_look | look))


def _round_squares(low: float, high: float) -> list[float]:
    """Round numbers about evenly spread between the squares of two roots, with their signs."""
    largest = max(abs(low), abs(high)) ** 2
    step = 10.0 ** np.floor(np.log10(largest))
    step *= max(f for f in (1.0, 2.0, 4.0) if f * step <= largest)
    marks = [sign * f * step for sign in (-1.0, 1.0) for f in (1.0, 0.25)]
    return sorted(
        [0.0, *(m for m in marks if low <= np.sign(m) * np.sqrt(abs(m)) <= high)], key=abs
    )
