"""Three-dimensional panels, and two-dimensional views of objects and heads.

Matplotlib's 3D axes have no type annotations, hence ``Any``. Surfaces are rasterised, also in PDF,
to keep files small. The space of (F_x, M_B, M_D) is a cylinder: M_B is the distance from the axis,
M_D the angle around it, and F_x the height. M_B and F_x are drawn on square-root scales, as most
contacts are light, and in parallel projection, so that heights can be read from the axis.

Views of objects and a rat's head show silhouettes and sections.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike

from vibrissa.deferred import interpolate, spatial
from vibrissa.numerics import Array
from vibrissa.plots.style import INK, MUTED, ORANGE, PLAIN, SMALL, Box, box_axes
from vibrissa.quantities import axis_label, quantity, to_display
from vibrissa.scene import Course, head_surfaces, root, values_of

ELEVATION, AZIMUTH = 24.0, -58.0  # default direction of view, degrees
_FLAT = 0.70  # brightness of a surface that the light only grazes


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
    plain_frame(axes)
    axes.tick_params(pad=-4.0)
    return axes


def plain_frame(axes: Any) -> None:
    """Draw the frame of three-dimensional axes with thin lines and few ticks."""
    for name in "xyz":
        axis = getattr(axes, f"{name}axis")
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.line.set(color=INK, linewidth=0.5)
        axis._axinfo["grid"].update(color="#e2e2e2", linewidth=0.4)
        axis._axinfo["tick"].update(inward_factor=0.0, outward_factor=0.25)
    axes.locator_params(nbins=4)


def name_axes(axes: Any, pads: Sequence[float], names: Sequence[str] = "xyz") -> None:
    """Label the axes."""
    for letter, name, pad in zip("xyz", names, pads, strict=True):
        axis = getattr(axes, f"{letter}axis")
        axis.set_label_text(axis_label(name))
        axis.labelpad = pad


def bounds(points: ArrayLike, room: float = 0.02) -> Array:
    """Limits that include points and the origin."""
    places = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    places = np.concatenate([places, np.zeros((1, 3))])
    low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
    margin = room * (high - low).max()
    return np.stack([low - margin, high + margin], axis=1)


def contact_points(rows: Array) -> Array:
    """Contact points, mm, of rows of a sampled surface."""
    return to_display("contact_point", rows[..., :3])


def painted(values: Array, norm: Normalize, colours: Colormap) -> Array:
    """Colours of triangles by the mean of the values at their corners."""
    return np.asarray(colours(norm(values.mean(axis=1))), dtype=np.float64)


def paint(
    axes: Any, triangles: Array, colours: ArrayLike, *, opacity: float = 1.0, flat: float = _FLAT
) -> None:
    """Draw lit triangles; those of one call occlude each other correctly."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    sized = triangles / np.ptp(limits, axis=1) * np.array(axes._box_aspect)
    normal = np.cross(sized[:, 1] - sized[:, 0], sized[:, 2] - sized[:, 0])
    length = np.linalg.norm(normal, axis=1)
    kept = length > 1e-12 * length.max(initial=1e-300)
    # The light comes from above the viewer's left shoulder.
    e, a = np.radians(axes.elev + 25.0), np.radians(axes.azim - 30.0)
    light = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    lit = np.abs(normal[kept] @ light) / length[kept]
    rgba = np.broadcast_to(np.asarray(colours, dtype=np.float64), (len(triangles), 4))[kept].copy()
    rgba[:, :3] *= (flat + (1.0 - flat) * lit)[:, None]
    rgba[:, 3] = opacity
    # Edges of the same colour close the seams; in translucent surfaces they would be visible.
    surface = Poly3DCollection(
        triangles[kept],
        facecolors=rgba,
        edgecolors=rgba if opacity == 1.0 else "none",
        linewidths=0.25 if opacity == 1.0 else 0.0,
        rasterized=True,
    )
    axes.add_collection3d(surface, autolim=False)


_VIEW = (16.0, -152.0)
_ASPECT = (1.0, 1.0, 0.85)
_FRONT = 222.0  # direction, degrees, in which rings carry their labels: toward the viewer
_AXIS = 1.4  # distance of the axis of F_x from the cylinder's axis, over its radius
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
    """Limits of axes that include positions in the cylinder."""
    reach = float(np.hypot(places[..., 0], places[..., 1]).max()) * 1.02
    low, high = float(places[..., 2].min()), float(places[..., 2].max())
    room = 0.02 * (high - low)
    return np.array([[-reach, reach], [-reach, reach], [low - room, max(high, 0.0) + room]])


def square(box: Box) -> Box:
    """Extend square 3D axes somewhat beyond their panel."""
    left, bottom, width, height = box
    side = max(width, height)
    return left + 0.5 * (width - side), bottom - 1.0 + 0.5 * (height - side), side, side


def signal_axes(figure: Figure, panel: Box, limits: Array) -> Any:
    """Add axes for the cylinder: rings of equal M_B and rays of equal M_D on its floor."""
    left, bottom, side, _ = square(panel)
    box = left + 3.5, bottom + 0.5, side, side
    small = side < 50.0  # lettering does not shrink with the panel
    zoom = 0.86 if small else 0.98
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
        scale = "" if small else " (√ scale)"
        label = f"{ring:g}" if ring < rings[-1] else f"${size}$ = {ring:g} {unit}{scale}"
        look = {"ha": "center" if small else "left", "va": "top", "color": MUTED}
        _write(axes, _FRONT, np.sqrt(ring) * near, floor, label, **look)
    for angle in (0, 90, 180, -90):
        axes.plot(*np.outer(_toward(angle), [0.0, reach]), floor, **_FLOOR)
        if angle == 0:
            continue  # its end is hidden behind the solid
        label = f"{angle}°" if angle != 180 else f"${quantity('MD').symbol}$ = 180°"
        # The labels of the rays to the left are right-aligned, so that they do not cover the solid
        # and the label of the largest ring.
        far = {"ha": "right"} if angle in (90, 180) else {}
        far_out = 1.3 if angle == -90 else 1.17  # clear of the solid's corner
        _write(axes, angle, far_out * reach, floor, label.replace("-", "−"), **far)
    _height_axis(axes, limits, small)
    return axes


def _height_axis(axes: Any, limits: Array, small: bool) -> None:
    """Draw the axis of F_x, vertical at the left; in small panels for both scales."""
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
    named = (0.2, axis_label("Fx")) if small else (0.15, axis_label("Fx"))
    for up, text in (named, (0.045, "√ scales" if small else "√ scale")):
        height = top + up * (top - floor)
        _write(axes, left, 1.4 * reach, height, text, fontsize=PLAIN if up > 0.1 else SMALL)


def drop_lines(axes: Any, limits: Array, place: Array) -> None:
    """Draw lines from a position in the cylinder to the axis of F_x and to the floor."""
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
    """Draw a word in the cylinder, behind the surfaces."""
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


_CELLS, _COARSE = 121, 4
# Share of a panel covered by an object above which it is not drawn.
_FULL = 0.97


class Body(Protocol):
    """Interface of an object in the laboratory frame, m."""

    def signed_distance(self, points: ArrayLike) -> Array:
        """Distances (...) of points (..., 3) from its surface, negative inside."""


def draw_body(axes: Axes, body: Body, view: tuple[int, int], limits: Array, look: str) -> None:
    """Draw the outline of the part of an object within limits."""
    right, up, nearest = _shadow(body, view, limits)
    if 0.0 < np.mean(nearest < 0.0) < _FULL:
        _draw_zero(axes, right, up, nearest, look)


def outline_segments(body: Body, view: tuple[int, int], limits: Array) -> Array:
    """Segments (n, 2, 2), mm, of the outline of an object within limits."""
    from contourpy import contour_generator

    lines: Any = contour_generator(*_shadow(body, view, limits)).lines(0.0)
    pieces = [np.stack([line[:-1], line[1:]], axis=1) for line in lines]
    return np.concatenate([np.empty((0, 2, 2)), *pieces])


def _shadow(body: Body, view: tuple[int, int], limits: Array) -> tuple[Array, Array, Array]:
    """Smallest distance from a body, mm, over a grid of lines of sight, and the grid's axes."""
    i, j = view
    right, up = (np.linspace(limits[n, 0], limits[n, 1], _CELLS) for n in view)
    points: Array = np.zeros((_CELLS, _CELLS, 3))
    points[..., i], points[..., j] = right, up[:, None]
    return right, up, _nearest(body, points, limits, 3 - i - j)


def _draw_zero(axes: Axes, right: Array, up: Array, distance: Array, look: str) -> None:
    """Draw the region of negative distance: filled for a true object, dashed for a fitted one."""
    if look == "true":
        axes.contourf(right, up, distance, [-np.inf, 0.0], colors=["#ececec"], zorder=1)
        axes.contour(right, up, distance, [0.0], colors=[MUTED], linewidths=0.8, zorder=1.5)
        return
    dashes: Any = [(0, (4, 2))]
    lines: dict[str, Any] = {"linewidths": 1.0, "linestyles": dashes, "zorder": 4}
    axes.contour(right, up, distance, [0.0], colors=[ORANGE], **lines)


def _nearest(body: Body, points: Array, limits: Array, depth: int) -> Array:
    """Smallest distance from a body along lines of sight through points (m, m, 3), mm."""
    rough = np.arange(0, _CELLS, _COARSE)
    corners = points[np.ix_(rough, rough)]
    cell = float(np.ptp(corners[:2, :2].reshape(-1, 3), axis=0).max())
    coarse = _marched(body, corners.reshape(-1, 3), limits, depth, 2.0 * cell)
    table = interpolate.RegularGridInterpolator(
        (rough, rough), coarse.reshape(rough.size, rough.size)
    )
    rows, columns = np.indices((_CELLS, _CELLS))
    nearest = np.asarray(table((rows, columns)), dtype=np.float64)
    # A distance changes by no more than the length of the path.
    near = np.abs(nearest) < 1.5 * cell
    nearest[near] = _marched(body, points[near], limits, depth, 2.0 * cell)
    return nearest


def _marched(body: Body, points: Array, limits: Array, depth: int, deep: float) -> Array:
    """Smallest distance from a body along lines of sight through points (n, 3), mm."""
    start, end = limits[depth]
    least_step = 0.25 * deep
    points = points.copy()
    at = np.full(len(points), start)
    least = np.full(len(points), np.inf)
    active = np.arange(len(points))
    while active.size:
        points[active, depth] = at[active]
        distance = 1e3 * body.signed_distance(1e-3 * points[active])
        least[active] = np.minimum(least[active], distance)
        at[active] += np.maximum(np.abs(distance), least_step)
        active = active[(at[active] <= end) & (least[active] > -deep)]
    return least


def room_for(places: Array, bodies: Sequence[Body]) -> Array:
    """Limits, mm, that include most positions, and nearby bounded objects."""
    low, high = np.quantile(places, [0.04, 0.96], axis=0)
    half = 0.5 * (high - low)
    near = np.array([[-1.0], [1.0]]) * (2.0 * half.max() + 3.0)
    lines = 0.5 * (low + high) + near  # lower and upper ends of a cube
    steps = np.linspace(lines[0], lines[1], 25)
    grid = np.stack(np.meshgrid(*steps.T, indexing="ij"), axis=-1)
    for body in bodies:
        inside = grid[body.signed_distance(1e-3 * grid) < 0.0]
        if inside.size:
            least, most = inside.min(axis=0), inside.max(axis=0)
            bounded = (least > lines[0]) & (most < lines[1])
            low = np.where(bounded, np.minimum(low, least), low)
            high = np.where(bounded, np.maximum(high, most), high)
    margin = np.maximum(0.15 * (high - low), 1.0)
    return np.stack([low - margin, high + margin], axis=1)


def one_scale(limits: Array, views: Sequence[tuple[int, int]], sizes: Sequence[Any]) -> Array:
    """Widen limits so that panels of given sizes have the same scale."""
    shown, size = np.array(views), np.array(sizes)
    middle, span = limits.mean(axis=1)[shown], np.ptp(limits, axis=1)[shown]
    half = 0.5 * (span / size).max() * size
    return np.stack([middle - half, middle + half], axis=-1)


# Look of the 95 % band of a surface.
BAND: dict[str, Any] = {"facecolor": ORANGE, "alpha": 0.25, "linewidth": 0.0, "zorder": 2}
_SECTION_CELLS = 91
_NORMAL_95 = 1.959963984540054
_FACING = 0.8
# Standard deviation, as a share of the view's width, from which a surface is not drawn.
_UNKNOWN = 0.05


def is_cylinder(body: Body) -> bool:
    """Whether a body is a cylinder."""
    return hasattr(body, "axis") and hasattr(body, "radius")


def has_band(body: Body) -> bool:
    """Whether a body is drawn with a band."""
    return hasattr(body, "distance_sigma") and not is_cylinder(body)


def lies_flat(body: Body, view: tuple[int, int], places: Array) -> bool:
    """Whether a surface faces the view, so that it has no section."""
    if (normals := getattr(body, "outward_normals", None)) is None:
        return False
    toward = np.abs(normals(1e-3 * places)[:, 3 - sum(view)])
    return bool(np.nanmedian(toward) > _FACING)


def outline(cylinder: Any, view: tuple[int, int], height: float, limits: Array) -> Array:
    """Outline of a cylinder: its section from above, its silhouette from the side."""
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
    aside = radius * np.array([-along[1], along[0]])
    far = 2.0 * float(np.ptp(limits, axis=1).max()) * along
    middle = origin[[i, j]]
    # From where the axis passes nearest to the middle of the view.
    middle = middle + ((limits[[i, j]].mean(axis=1) - middle) @ along) * along
    return np.array(
        [middle - far + aside, middle + far + aside, middle + far - aside, middle - far - aside]
    )


def draw_section(
    axes: Axes, body: Body, view: tuple[int, int], depth: float, limits: Array, look: str
) -> None:
    """Draw a section through an object, with its 95 % band if it has one."""
    i, j = view
    right, up = (np.linspace(limits[n, 0], limits[n, 1], _SECTION_CELLS) for n in view)
    points: Array = np.empty((_SECTION_CELLS, _SECTION_CELLS, 3))
    points[..., i], points[..., j], points[..., 3 - i - j] = right, up[:, None], depth
    distance = 1e3 * np.asarray(body.signed_distance(1e-3 * points))
    if not distance.min() < 0.0 < distance.max():
        return
    if look != "true" and has_band(body):
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
    _draw_zero(axes, right, up, distance, look)


# Base of a whisker at the right if nothing else is known: right, forward, up of the snout.
_PAD = np.array([7.7e-3, -9.0e-3, -4.9e-3])
_FAR = 2e-3  # smallest distance of a base from the head's origin for this to be the snout, m
_SKIN, _EDGE, _EYE = "#efe6dc", "#a89a8c", "#5a4f45"


class Head(NamedTuple):
    """Pose of a head."""

    snout: Array
    axes: Array


def head_of(course: Course) -> Head:
    """Mean pose of the head over a trial.

    Unless the recording states it, the head is level, the whisker points away from it sideways
    and curves forward, and its base is on the snout.
    """
    base = np.nanmean(course.position, axis=0)
    if course.head is not None:
        position, rotation = course.head
        left, _, right = np.linalg.svd(np.nanmean(rotation, axis=0))
        axes = np.asarray(left @ right)  # the nearest rotation
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
    # The head is assumed to be aligned with x or y, whichever the whisker is closer to.
    way[n] = np.sign(sideways[n]) or 1.0
    ahead = np.cross([0.0, 0.0, 1.0], way)
    if forward @ ahead[:2] < 0.0:
        ahead = -ahead
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    return np.stack([right, ahead, [0.0, 0.0, 1.0]], axis=1)


def draw_head(axes: Axes, head: Head, view: tuple[int, int]) -> None:
    """Draw the outline of a head, filled."""
    skin, eyes = head_surfaces(head.axes, head.snout)
    axes.add_patch(
        Polygon(_outline(skin, view), facecolor=_SKIN, edgecolor=_EDGE, linewidth=0.8, zorder=0.5)
    )
    for eye in np.split(eyes, 2):
        axes.add_patch(Polygon(_outline(eye, view), facecolor=_EYE, edgecolor="none", zorder=0.6))


def _outline(triangles: Array, view: tuple[int, int]) -> Array:
    """Convex hull (n, 2) of the projected head."""
    points = triangles.reshape(-1, 3)[:, list(view)]
    return np.asarray(points[spatial.ConvexHull(points).vertices])
