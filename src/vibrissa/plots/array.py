"""Figures of a face with its whiskers, objects and contacts: from above, the front and the side.

The whiskers of an array are drawn at rest; those of a recording in one frame, with the contact
points of all frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from vibrissa.numerics import Array, Mask
from vibrissa.plots import style
from vibrissa.plots.space import paint, space_axes
from vibrissa.quantities import axis_label, to_display
from vibrissa.recording import Group
from vibrissa.scene import head_surfaces, is_bounded, object_surface
from vibrissa.whisker import Identity

# One colour a row, from the top down; whiskers of no known row are black.
ROW_COLOURS: Mapping[str, str] = MappingProxyType(
    {"A": "#0072b2", "B": "#56b4e9", "C": "#009e73", "D": "#e69f00", "E": "#d55e00"}
)
_HEAD, _THING, _EDGE = "#e9e2da", "#d5d9de", "#b3aba2"
# Views of space, elevation and azimuth, degrees: from in front of the animal's right, and from
# behind it, where the touched sides of objects are visible.
_AT_REST, _IN_A_TRIAL = (22.0, 38.0), (26.0, -22.0)
_CLEAR = 0.7  # opacity of objects in space, which hide what touches them from behind
_PANELS = (
    # letter, title, right and up, sense of the axis to the right, axis toward the viewer
    ("a", "from above", (0, 1), 1.0, 2),
    ("c", "from the front", (0, 2), -1.0, 1),
    ("d", "from its right", (1, 2), 1.0, 0),
)
# Room around and between the panels, mm.
_LEFT, _GAP, _BOTTOM, _TOP, _RIGHT = 10.0, 13.0, 8.5, 6.5, 3.0


@dataclass(frozen=True, eq=False)
class _Scene:
    """Objects to draw, mm: those of one frame, and all contact points."""

    lines: Array  # (whisker, node, 3)
    names: list[str]
    touching: Mask  # (whisker,)
    points: list[Array]  # of all moments, (n, 3) each
    now: Array  # (whisker, 3)
    objects: list[xr.Dataset]
    head: tuple[Array, Array]
    moment: str

    @property
    def colours(self) -> list[str]:
        return [_colour(name) for name in self.names]

    def rows(self, names: list[str]) -> list[str]:
        """Known rows of some whiskers."""
        return sorted({Identity.of(name).row for name in names if _colour(name) != style.INK})

    @property
    def limits(self) -> Array:
        """Limits (3, 2) that include whiskers, head and bounded objects."""
        parts = [self.lines.reshape(-1, 3), head_surfaces(*self.head)[0].reshape(-1, 3)]
        everywhere = np.zeros((3, 2))
        parts += [object_surface(o, everywhere)[0] for o in self.objects if is_bounded(o)]
        parts += self.points
        places = np.concatenate(parts)
        places = places[np.isfinite(places).all(axis=1)]
        low, high = places.min(axis=0), places.max(axis=0)
        margin = 0.03 * (high - low).max()
        return np.stack([low - margin, high + margin], axis=1)


def array_views(
    tree: xr.DataTree,
    *,
    frame: int | None = None,
    contacts: str = "truth",
    width: style.Width = "double",
) -> Figure:
    """Draw the whiskers of a face and the objects, in three views and in space.

    Parameters
    ----------
    tree : DataTree
        An array of whiskers (`WhiskerArray.to_tree`), which is drawn at rest in the head's frame;
        or a recording of a trial, in the laboratory frame.
    frame : int, optional
        Frame of a recording in which whiskers and head are drawn; by default the one in which most
        whiskers are in contact.
    contacts : str
        Group of a recording whose ``contact_point`` are drawn, for all frames ``in_contact``, such
        as ``truth`` or ``estimates``; ``/`` is the root.
    width : {"single", "double"}
        Columns of the page.

    Returns
    -------
    Figure
        Four panels with a colour per row of whiskers, and a sketch of the head. Dots are contact
        points; those of the drawn frame have rings.

    Raises
    ------
    ValueError
        If there are no centrelines, no such frame, or no such group.
    """
    scene = _scene(tree, frame, contacts)
    with style.looking():
        if scene is None:
            return style.sentence("no whisker", width)
        return _drawn(scene, width)


_SIDEWAYS = 0.5  # cosine between x and the animal's right from which on left and right are written


def _drawn(scene: _Scene, width: style.Width) -> Figure:
    limits, page = scene.limits, style.page_width(width)
    x, y, z = np.ptp(limits, axis=1)
    scale = (page - _LEFT - _GAP - _RIGHT) / (x + y)  # mm on paper per mm
    height = _BOTTOM + scale * (z + y) + _GAP + _TOP
    figure = style.new_figure(width, height, None)
    above, aside = _BOTTOM + scale * z + _GAP, _LEFT + scale * x + _GAP
    places = {"a": (_LEFT, above), "c": (_LEFT, _BOTTOM), "d": (aside, _BOTTOM)}
    for letter, title, view, sense, toward in _PANELS:
        (i, j), (left, bottom) = view, places[letter]
        size = scale * np.ptp(limits, axis=1)
        axes = style.box_axes(
            figure, (left, bottom, size[i], size[j]), xlim=limits[i][:: int(sense)], ylim=limits[j]
        )
        axes.set(xlabel=axis_label("xyz"[i]), ylabel=axis_label("xyz"[j]))
        style.head(axes, letter, title)
        _panel(axes, scene, limits, view, toward)
        if letter == "a":
            _legend(axes, scene)
    room = scale * float(y)
    box = (aside - 6.0, above - 6.0, room + 8.0, room + 10.0)
    _space(figure, box, scene, limits)
    style.corner_title(figure, (aside - 6.0, above, room, scale * y + _TOP - 1.5), "b", "in space")
    style.conclude(figure, _finding(scene))
    return figure


def _finding(scene: _Scene) -> str:
    """Describe the number of whiskers, and of those in contact."""
    touching = [name for name, points in zip(scene.names, scene.points, strict=True) if len(points)]
    if not touching:
        lengths = np.linalg.norm(np.diff(scene.lines, axis=1), axis=2).sum(axis=1)
        range_ = f"{np.nanmin(lengths):.0f} to {np.nanmax(lengths):.0f} mm"
        return f"{len(scene.names)} whiskers at rest, {range_} long"
    rows = ", ".join(scene.rows(touching))
    ever = f"Contact points of {len(touching)} of {len(scene.names)} whiskers"
    ever += f" (rows {rows})" if rows else ""
    return f"{ever}; {int(scene.touching.sum())} touch at {scene.moment}"


def _panel(axes: Axes, scene: _Scene, limits: Array, view: tuple[int, int], toward: int) -> None:
    """Draw one view, farther objects first."""
    skull, eyes = head_surfaces(*scene.head)
    middle = scene.head[1] * 1e3
    for thing in scene.objects:
        _flat(axes, _triangles(thing, limits)[..., view], _THING, "#9aa3ad", 1.0)
    _flat(axes, skull[..., view], _HEAD, _EDGE, 2.0)
    right = float(scene.head[0][0, 0]) * np.subtract(*axes.get_xlim()[::-1])
    if view[0] == 0 and abs(scene.head[0][0, 0]) > _SIDEWAYS:
        sides = ("L", "R") if right > 0.0 else ("R", "L")
        for x, side in zip((0.03, 0.97), sides, strict=True):
            words: dict[str, Any] = {"transform": axes.transAxes, "ha": "center", "va": "top"}
            axes.text(
                x, 0.97, side, fontsize=style.LARGE, fontweight="bold", color=style.MUTED, **words
            )
    if toward != 1:
        near = eyes[eyes[..., toward].mean(axis=1) > skull[..., toward].mean()]
        _flat(axes, near[..., view], style.INK, style.INK, 2.2)
    for line, colour, touching in zip(scene.lines, scene.colours, scene.touching, strict=True):
        # Whiskers on the far side are drawn behind the head, all others in front of it.
        behind = toward == 0 and line[0, 0] < middle[0]
        look: dict[str, Any] = {"color": colour, "linewidth": 1.1 if touching else 0.7}
        axes.plot(*line[:, view].T, zorder=1.5 if behind else 3.0, **look)
    for dots, colour in zip(scene.points, scene.colours, strict=True):
        axes.plot(*dots[:, view].T, ".", color=colour, markersize=1.6, zorder=3.5, alpha=0.6)
    now = scene.now[scene.touching]
    axes.plot(*now[:, view].T, "o", color=style.INK, markersize=3.2, fillstyle="none", zorder=4.0)


def _flat(axes: Axes, triangles: Array, colour: str, edge: str, order: float) -> None:
    """Draw triangles (n, 3, 2) in one colour, with their common outline."""
    rim: Any = {"edgecolors": edge, "facecolors": edge, "linewidths": 1.2, "zorder": order}
    axes.add_collection(PolyCollection(list(triangles), **rim), autolim=False)
    fill: Any = {"edgecolors": colour, "facecolors": colour, "linewidths": 0.2}
    axes.add_collection(PolyCollection(list(triangles), **fill, zorder=order), autolim=False)


def _triangles(thing: xr.Dataset, limits: Array) -> Array:
    vertices, faces = object_surface(thing, limits)
    return vertices[faces]


def _space(figure: Figure, box: style.Box, scene: _Scene, limits: Array) -> None:
    """Draw all objects in space, farther ones first."""
    view = _AT_REST if not scene.moment else _IN_A_TRIAL
    axes = space_axes(figure, box, limits, view, zoom=1.3, frame=False)
    elevation, azimuth = np.radians(view)
    flat = np.cos(elevation)
    eye = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])

    def solid(triangles: Array, colour: str, order: float) -> None:
        paint(axes, triangles, to_rgba(colour), opacity=_CLEAR if colour == _THING else 1.0)
        axes.collections[-1].set_zorder(order)

    def skull(order: float) -> None:
        triangles, eyes = sketch
        solid(triangles, _HEAD, order)
        solid(eyes[(eyes @ eye).mean(axis=1) > (triangles @ eye).mean()], style.INK, order + 0.5)

    def whisker(i: int, order: float) -> None:
        look: dict[str, Any] = {"color": scene.colours[i], "zorder": order}
        axes.plot(*scene.lines[i].T, linewidth=1.1 if scene.touching[i] else 0.7, **look)
        axes.plot(*scene.points[i].T, ".", markersize=1.6, **look)

    sketch = head_surfaces(*scene.head)
    things = [_triangles(thing, limits) for thing in scene.objects]
    items = [(float((sketch[0] @ eye).mean()), skull)]
    items += [(float((t @ eye).mean()), partial(solid, t, _THING)) for t in things]
    # The base counts as much as the mean, so that a whisker is on its side of the head.
    sides = 0.5 * (scene.lines[:, 0] + scene.lines.mean(axis=1)) @ eye
    items += [(float(side), partial(whisker, i)) for i, side in enumerate(sides)]
    for order, (_, draw) in enumerate(sorted(items, key=lambda item: item[0])):
        draw(order)
    now = scene.now[scene.touching]
    axes.plot(*now.T, "o", color=style.INK, markersize=3.2, fillstyle="none", zorder=len(items))


def _legend(axes: Axes, scene: _Scene) -> None:
    """Draw the names of the rows in their colours."""
    rows = ["rows", *scene.rows(scene.names)]
    for i, row in enumerate(rows):
        look: dict[str, Any] = {"fontweight": "bold", "ha": "right", "va": "bottom"}
        axes.annotate(
            row,
            (1.0, 1.0),
            xycoords="axes fraction",
            xytext=(-8.0 * (len(rows) - 1 - i) - (2.0 if i == 0 else 0.0), 4.0),
            textcoords="offset points",
            color=ROW_COLOURS.get(row, style.INK),
            **look,
        )


def _colour(name: str) -> str:
    try:
        return ROW_COLOURS[Identity.of(name).row]
    except ValueError:
        return style.INK


def _scene(tree: xr.DataTree, frame: int | None, contacts: str) -> _Scene | None:
    """Collect the objects to draw."""
    root = tree.to_dataset()
    truth = tree.children["truth"].to_dataset() if "truth" in tree.children else root
    held = truth if "centerline" in truth else root
    if "centerline" not in held:
        raise ValueError("there are no centrelines of whiskers to draw")
    line = held["centerline"]
    names = [str(name) for name in np.atleast_1d(root["whisker"].values)]
    if "time" not in line.dims:
        lines = to_display("centerline", Group(held)["centerline"])
        none = np.zeros(len(names), dtype=bool)
        empty = [np.empty((0, 3)) for _ in names]
        still = np.eye(3), np.zeros(3)
        return _Scene(lines, names, none, empty, np.full((len(names), 3), np.nan), [], still, "")
    touching, places = _contacts(tree, contacts)
    most = int(touching.sum(axis=1).argmax())
    at = most if frame is None else frame
    if not 0 <= at < len(touching):
        raise ValueError(f"frame is {frame}; from 0 to {len(touching) - 1} is needed")
    lines = Group(held)["centerline"][at]
    if not np.isfinite(lines).any():
        return None
    turn, place = np.eye(3), np.zeros(3)
    if "head_position" in root:
        moves = Group(root)
        place, turn = moves["head_position"][at], moves["head_rotation"][at]
    group = tree.children.get("objects")
    things = {} if group is None else group.children
    return _Scene(
        lines=to_display("centerline", lines),
        names=names,
        touching=touching[at],
        points=[places[touching[:, i], i] for i in range(len(names))],
        now=places[at],
        objects=[thing.to_dataset() for thing in things.values()],
        head=(turn, place),
        moment=f"{float(root['time'].values[at]):.3f} s",
    )


def _contacts(tree: xr.DataTree, group: str) -> tuple[Mask, Array]:
    """Contact (time, whisker) and contact points (time, whisker, 3), mm."""
    part = tree if group in ("/", "") else tree.children.get(group)
    if part is None or "contact_point" not in part:
        raise ValueError(f"the recording has no contact points in its group {group!r}")
    data = Group(part.to_dataset())
    places = to_display("contact_point", data["contact_point"])
    touching: Mask = np.asarray(np.isfinite(places).all(axis=-1))
    if "in_contact" in data:
        touching &= data["in_contact"]
    return touching, places
