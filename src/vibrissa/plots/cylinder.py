"""The space of (F_x, M_B, M_D) as a cylinder.

M_B is the distance from the axis, M_D the angle about it, and F_x the height. M_B and F_x are drawn
on square-root scales: most contacts are gentle.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from vibrissa.plots.chart import values_of
from vibrissa.plots.space import space_axes
from vibrissa.plots.style import INK, MUTED, Array, root
from vibrissa.quantities import axis_label, quantity, to_display

Box = tuple[float, float, float, float]
"""Left, bottom, width and height, mm."""

_VIEW = (16.0, -152.0)
_ASPECT = (1.0, 1.0, 0.85)
_FRONT = 222.0
"""Direction, degrees, in which rings carry their labels: toward the viewer."""

_FLOOR: dict[str, Any] = {"color": "#c8c8c8", "linewidth": 0.4, "zorder": 0}


def signal_places(axial: ArrayLike, bending: ArrayLike, direction: ArrayLike) -> Array:
    """Say where signals lie in the cylinder."""
    size = np.sqrt(to_display("MB", bending))
    turn = np.asarray(direction, dtype=np.float64)
    return np.stack(
        [size * np.cos(turn), size * np.sin(turn), root(to_display("Fx", axial))], axis=-1
    )


def felt(rows: Array) -> Array:
    """Say where rows of a chart lie in the cylinder."""
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
    axes = space_axes(figure, box, limits, _VIEW, zoom=zoom, frame=False, aspect=_ASPECT)
    reach, floor = limits[0, 1], limits[2, 0]
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    rings = _round_squares(0.0, reach)[1:]
    for ring in rings:
        places = np.sqrt(ring) * np.stack([np.cos(turn), np.sin(turn)])
        axes.plot(*places, floor, **_FLOOR)
        near = 1.0 if ring < rings[-1] else 1.28
        size, unit = quantity("MB").symbol, quantity("MB").display_unit
        label = f"{ring:g}" if ring < rings[-1] else f"${size}$ = {ring:g} {unit}"
        _write(axes, _FRONT, np.sqrt(ring) * near, floor, label, ha="left", va="top", color=MUTED)
    for angle in (0, 90, 180, -90):
        axes.plot(*np.outer(_toward(angle), [0.0, reach]), floor, **_FLOOR)
        label = f"{angle}°" if angle != 180 else f"${quantity('MD').symbol}$ = 180°"
        # The rays to the left end beside the solid and beside the largest ring's label, which
        # centred words would meet.
        far = {"ha": "right"} if angle in (90, 180) else {}
        _write(axes, angle, 1.17 * reach, floor, label.replace("-", "−"), **far)
    _height_axis(axes, limits)
    return axes


def _height_axis(axes: Any, limits: Array) -> None:
    """The axis of F_x, upright at the left."""
    reach, (floor, top) = limits[0, 1], limits[2]
    left = _VIEW[1] - 90.0
    place = 1.4 * reach * _toward(left)
    axes.plot(*np.repeat(place[:, None], 2, axis=1), [floor, top], color=INK, linewidth=0.5)
    for mark in _round_squares(floor, top):
        height = float(root(mark))
        tick = np.outer(_toward(left), [1.4 * reach, 1.45 * reach])
        axes.plot(*tick, height, color=INK, linewidth=0.5)
        label = f"{mark:g}".replace("-", "−")
        _write(axes, left, 1.49 * reach, height, label, ha="right")
    _write(axes, left, 1.4 * reach, top + 0.1 * (top - floor), axis_label("Fx"), fontsize=6.0)


def _toward(angle: float) -> Array:
    return np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])


def _write(axes: Any, angle: float, size: float, height: float, text: str, **look: Any) -> None:
    """A word in the cylinder, behind what is painted."""
    plain_look = {"fontsize": 5.5, "ha": "center", "va": "center", "zorder": 0}
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
