"""Objects of a recording, and a rat's head, as triangles to be painted, mm.

The head is a sketch, after no measured one: sections through it, one behind the other, whose sides
pass near the base points of an average rat's whiskers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from vibrissa.plots.style import Array
from vibrissa.quantities import to_display

Ints = NDArray[np.int64]

_SECTIONS = np.array(
    [
        # forward, half width, middle height, half height; mm
        [0.6, 0.1, -1.6, 0.1],
        [0.3, 1.4, -1.6, 1.3],
        [-1.0, 3.4, -3.2, 3.2],
        [-3.0, 5.2, -4.2, 4.6],
        [-6.0, 6.9, -4.8, 5.9],
        [-10.0, 8.0, -4.9, 7.0],
        [-15.0, 9.0, -4.6, 8.2],
        [-22.0, 10.8, -3.6, 9.8],
        [-30.0, 12.3, -2.4, 10.8],
        [-37.0, 12.0, -1.8, 10.6],
        [-43.0, 9.5, -1.8, 9.0],
        [-46.0, 5.5, -2.2, 5.5],
        [-47.0, 0.1, -2.4, 0.1],
    ]
)
_EYES = np.array([[10.3, -24.0, 2.2], [-10.3, -24.0, 2.2]])
_EYE, _AROUND = 1.5, 40


def head_triangles(rotation: Array, position: Array) -> Array:
    """Sketch a rat's head."""
    turn = np.linspace(0.0, 2.0 * np.pi, _AROUND)
    # Smooth between the sections, which are closer together near the snout.
    number = np.arange(len(_SECTIONS))
    fine = np.linspace(0.0, number[-1], 6 * number[-1] + 1)
    forward, half, middle, tall = PchipInterpolator(number, _SECTIONS)(fine).T[..., None]
    grid = np.stack(
        np.broadcast_arrays(half * np.cos(turn), forward, middle + tall * np.sin(turn)), axis=-1
    )
    return _moved(_quilt(grid), rotation, position)


def eye_triangles(rotation: Array, position: Array) -> Array:
    """Give the head eyes."""
    balls = [place + _EYE * _ball(16) for place in _EYES]
    return _moved(np.concatenate(balls), rotation, position)


def _moved(triangles: Array, rotation: Array, position: Array) -> Array:
    moved: Array = triangles @ rotation.T + to_display("head_position", position)
    return moved


def object_triangles(thing: xr.Dataset, limits: Array) -> Array:
    """Give the surface of an object.

    Parameters
    ----------
    thing : Dataset
        Of a recording's group ``objects``: its attribute ``kind`` says what it is.
    limits : array (3, 2)
        What is seen, mm: an object without end is cut off outside of it.

    Returns
    -------
    array (n, 3, 3)
        Corners, mm.

    Raises
    ------
    ValueError
        If it is of an unknown kind.
    """
    vertices, faces = object_surface(thing, limits)
    return vertices[faces]


def object_surface(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    """Give the surface of an object as vertices that triangles share where it is smooth."""
    kind = str(thing.attrs.get("kind"))
    if kind not in _KINDS:
        raise ValueError(f"an object is of kind {kind!r}; one of {', '.join(_KINDS)} is known")
    return _KINDS[kind](thing, limits)


def ends_nearby(thing: xr.Dataset) -> bool:
    """Tell whether an object is to be shown as a whole."""
    return thing.attrs.get("kind") in ("sphere", "box", "mesh")


def _mm(thing: xr.Dataset, name: str) -> Array:
    return to_display(name, thing[name].values)


def _sphere(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    vertices, faces = _net(_round(48))
    return _mm(thing, "object_position") + _mm(thing, "object_radius") * vertices, faces


def _peg(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    axis, origin = thing["object_axis"].values, _mm(thing, "object_position")
    first, second = _across(axis)
    ends = _within(limits, origin, axis)
    turn = np.linspace(0.0, 2.0 * np.pi, 49)[:, None]
    ring = _mm(thing, "object_radius") * (np.cos(turn) * first + np.sin(turn) * second)
    return _net(origin + ends[:, None, None] * axis + ring)


def _within(limits: Array, origin: Array, axis: Array) -> Array:
    """From where to where (2,) a line is seen; if nowhere, where it comes nearest to the middle."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort((limits - origin[:, None]) / axis[:, None], axis=1)
    crossing = np.abs(axis) > 1e-9
    first, last = ends[crossing, 0].max(), ends[crossing, 1].min()
    if first < last:
        return np.array([first, last])
    middle = float((limits.mean(axis=1) - origin) @ axis)
    return np.asarray(middle + 0.5 * np.ptp(limits, axis=1).max() * np.array([-1.0, 1.0]))


def _plane(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    normal, origin = thing["object_axis"].values, _mm(thing, "object_position")
    first, second = _across(normal)
    middle, half = limits.mean(axis=1), 0.5 * np.ptp(limits, axis=1).max()
    foot = middle - ((middle - origin) @ normal) * normal
    side = np.linspace(-half, half, 13)
    return _net(foot + side[:, None, None] * first + side[:, None] * second)


def _box(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    half = 0.5 * _mm(thing, "object_size")
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    # Its sides share no corners, so that edges stay sharp.
    sides = [np.insert(square, k, end, axis=1) * half for k in range(3) for end in (-1.0, 1.0)]
    rotation = thing["object_rotation"].values
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(6)[:, None, None]
    vertices = _mm(thing, "object_position") + np.concatenate(sides) @ rotation.T
    return vertices, faces.reshape(-1, 3)


def _mesh(thing: xr.Dataset, limits: Array) -> tuple[Array, Ints]:
    return _mm(thing, "object_vertices"), thing["object_faces"].values.astype(np.int64)


_KINDS: dict[str, Callable[[xr.Dataset, Array], tuple[Array, Ints]]] = {
    "peg": _peg,
    "sphere": _sphere,
    "plane": _plane,
    "box": _box,
    "mesh": _mesh,
}


def _across(direction: Array) -> tuple[Array, Array]:
    """Two unit vectors across a unit vector and each other."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


def _ball(around: int) -> Array:
    """Triangles of a ball of radius 1."""
    return _quilt(_round(around))


def _round(around: int) -> Array:
    """A grid on a ball of radius 1."""
    latitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, around // 2 + 1)[:, None]
    turn = np.linspace(0.0, 2.0 * np.pi, around + 1)
    flat = np.cos(latitude)
    parts = flat * np.cos(turn), flat * np.sin(turn), np.sin(latitude)
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def _quilt(grid: Array) -> Array:
    """Triangles (n, 3, 3) between the points of a grid (rows, columns, 3)."""
    vertices, faces = _net(grid)
    return vertices[faces]


def _net(grid: Array) -> tuple[Array, Ints]:
    """The points of a grid (rows, columns, 3), and the triangles between them."""
    number = np.arange(grid.shape[0] * grid.shape[1]).reshape(grid.shape[:2])
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    halves = np.stack([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)])
    return grid.reshape(-1, 3), halves.reshape(-1, 3)
