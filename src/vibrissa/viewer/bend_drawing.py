"""A bent whisker as things to look at."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from vibrissa.quantities import to_display
from vibrissa.viewer.bending import Bend, force_scale
from vibrissa.viewer.drawing import (
    CONTACT,
    FORCE,
    GHOST,
    OBJECT,
    REST,
    WHISKER,
    Array,
    Arrows,
    Body,
    Colour,
    Drawing,
    Label,
    Line,
    Thing,
)
from vibrissa.viewer.meshes import cylinder, ellipsoid, tube
from vibrissa.viewer.readout import number
from vibrissa.whisker import Whisker

NODES = 48
_AXES = np.array([(190, 60, 60), (70, 140, 70), (70, 90, 190)], dtype=np.uint8)
_ARROW = 0.3
"""Length of the arrow of a force of EI/L², over L; others go with the square root."""


def whisker_body(
    whisker: Whisker,
    line: Array,
    exaggeration: float,
    colour: Colour = WHISKER,
    opacity: float | None = None,
) -> Body:
    """A whisker along a centreline (n, 3), m, so many times as thick as it is."""
    radius = whisker.radius(np.linspace(0.0, whisker.length, len(line)))
    vertices, faces = tube(_mm(line), exaggeration * _mm(radius))
    return Body(vertices, faces, colour, opacity)


def follicle(whisker: Whisker, exaggeration: float) -> Body:
    """A sleeve in which the base is clamped, so that one sees where it is."""
    radius = 1.9 * exaggeration * whisker.base_radius
    depth = 0.06 * whisker.length
    middle = np.array([-0.5 * depth, 0.0, 0.0])
    vertices, faces = cylinder(_mm(middle), np.array([1.0, 0.0, 0.0]), _size(radius), _size(depth))
    return Body(vertices, faces, (196, 152, 132))


def axes(whisker: Whisker) -> dict[str, Thing]:
    """The whisker frame at the base: x red, y green, z blue."""
    size = _size(0.14 * whisker.length)
    ends = size * np.eye(3)
    out: dict[str, Thing] = {"axes": Arrows(np.zeros((3, 3)), ends, _AXES, 0.05 * size)}
    return out | {f"axis {name}": Label(1.12 * ends[i], name) for i, name in enumerate("xyz")}


def arrow(start: Array, end: Array, thickness: float) -> Arrows:
    """The arrow of a force between two places (3,), m; so many mm thick."""
    return Arrows(_mm(start)[None], _mm(end)[None], np.array([FORCE], dtype=np.uint8), thickness)


def force_arrow(whisker: Whisker, force: Array, at: Array) -> dict[str, Thing]:
    """The force on a whisker as an arrow that ends where it acts, with its size."""
    size = float(np.linalg.norm(force))
    if not (np.isfinite(at).all() and size > 0.0):
        return {}
    reach = _ARROW * whisker.length * np.sqrt(size / force_scale(whisker))
    start = at - reach * force / size
    thickness = _size(0.006 * whisker.length)
    return {
        "force": arrow(start, at, thickness),
        "force size": Label(_mm(start), number("force", size, 3)),
    }


def bend_drawing(bend: Bend, exaggeration: float) -> Drawing:
    """Draw whisker, load and force; without an answer the last shape as a ghost."""
    whisker, held, ok = bend.whisker, bend.held, bend.status.ok
    out = dict(_resting(whisker, exaggeration))
    line = held.centerline(NODES)
    if ok:
        out["whisker"] = whisker_body(whisker, line, exaggeration)
        out |= force_arrow(whisker, np.asarray(held.force), np.asarray(held.contact_point))
    else:
        out["ghost"] = whisker_body(whisker, line, exaggeration, GHOST, 0.4)
        out |= _missed(bend)
    if bend.kind == "peg":
        out["peg"] = _peg(bend)
    elif ok:
        x, y, z = _mm(held.contact_point).tolist()
        out["contact"] = replace(_ball(whisker, exaggeration), place=(x, y, z))
    return out


@lru_cache(maxsize=4)
def _resting(whisker: Whisker, exaggeration: float) -> dict[str, Thing]:
    """What stays as it is while a whisker is bent."""
    return {
        "follicle": follicle(whisker, exaggeration),
        **axes(whisker),
        "rest": whisker_body(whisker, whisker.centerline(NODES), 0.7 * exaggeration, REST, 0.35),
    }


def _peg(bend: Bend) -> Body:
    """The peg; a line is drawn a little thick, so that it is seen."""
    length = bend.whisker.length
    radius = max(bend.radius, 0.004 * length)
    vertices, faces = cylinder(_mm(bend.origin), bend.axis, _size(radius), _size(0.8 * length))
    return Body(vertices, faces, OBJECT, 0.8)


@lru_cache(maxsize=4)
def _ball(whisker: Whisker, exaggeration: float) -> Body:
    """What marks the contact: it sticks out of the whisker where this can touch."""
    own = float(whisker.radius(0.5 * whisker.length))
    radius = max(1.7 * exaggeration * own, 0.006 * whisker.length)
    vertices, faces = ellipsoid(np.zeros(3), _size(radius) * np.eye(3), 12)
    return Body(vertices, faces, CONTACT)


def _missed(bend: Bend) -> dict[str, Thing]:
    """A line from the last contact to where it was wanted, and why it did not go there."""
    last = np.asarray(bend.held.contact_point)
    out: dict[str, Thing] = {}
    if np.isfinite(last).all() and bend.kind == "point":
        out["missed"] = Line(_mm(np.stack([last, bend.point])[None]), GHOST)
    words = bend.status.explanation.split(":")[0].rstrip(".")
    lift = np.array([0.0, 0.0, 0.05 * bend.whisker.length])
    return {**out, "reason": Label(_mm(bend.target + lift), words)}


def _mm(values: object) -> Array:
    return to_display("length", np.asarray(values, dtype=np.float64))


def _size(length: float) -> float:
    return float(to_display("length", length))
