"""The space of contacts and the spaces of signals as things to look at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vibrissa.plots.chart import values_of
from vibrissa.rod import PointContact, deflect
from vibrissa.signals import SIGNALS
from vibrissa.status import Status
from vibrissa.viewer.bend_drawing import NODES, follicle, whisker_body
from vibrissa.viewer.drawing import (
    CONTACT,
    REST,
    WHISKER,
    Array,
    Body,
    Drawing,
    Label,
    Line,
    Painted,
    Thing,
    pieces,
)
from vibrissa.viewer.meshes import ellipsoid
from vibrissa.viewer.readout import note, of_deflection, table
from vibrissa.viewer.shading import Legend, shaded
from vibrissa.viewer.solids import COORDINATES, TURN, Solids

_NAMES = {"r": "r", "theta": "θ", "phi": "φ"}
_RINGS = 2


def frame_drawing(solids: Solids, exaggeration: float) -> Drawing:
    """What does not change: the resting whisker, and rings, rays and axes of the signals."""
    whisker, length = solids.chart.whisker, solids.length
    here = solids.place(None)
    line = whisker.centerline(NODES)
    out: dict[str, Thing] = {
        "rest": _moved(whisker_body(whisker, line, exaggeration, REST), here),
        "follicle": _moved(follicle(whisker, exaggeration), here),
        "title": Label(here + length * np.array([0.05, 0.0, 0.62]), "contacts"),
    }
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    floor = -0.5 * 0.85 * length
    for i, name in enumerate(COORDINATES):
        centre = solids.place(i)
        bottom = centre + np.array([0.0, 0.0, floor])
        rings = []
        for k in range(1, _RINGS + 1):
            radius = 0.5 * length * np.sqrt(k / _RINGS)
            flat = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0.0 * turn], axis=1)
            rings.append(pieces(flat + bottom))
        for angle in TURN + np.arange(4) * np.pi / 2.0:
            ray = 0.5 * length * np.array([[0.0, 0.0, 0.0], [np.cos(angle), np.sin(angle), 0.0]])
            rings.append(pieces(ray + bottom))
        out[f"floor {name}"] = Line(np.concatenate(rings), (205, 209, 214), 1.0)
        pole = np.array([[0.0, 0.0, floor], [0.0, 0.0, -floor]]) + centre
        out[f"axis {name}"] = Line(pieces(pole), (120, 126, 134), 1.0)
        above = np.array([0.0, 0.0, 0.07 * length])  # where Fx is never positive, 0 is at the top
        out[f"axis {name} name"] = Label(pole[1] + above, "Fx")
        out[f"zero {name}"] = Label(centre + np.array([0.0, 0.0, solids.axis_height()]), "0")
        edge = 0.5 * length * np.array([np.cos(TURN), np.sin(TURN), 0.0])
        out[f"rim {name}"] = Label(bottom + edge, "MD = 0°")
        out[f"title {name}"] = Label(
            centre + length * np.array([-0.45, 0.0, 0.62]), f"signals, coloured by {_NAMES[name]}"
        )
    return out


def _moved(body: Body, by: Array) -> Body:
    return replace(body, vertices=body.vertices + by)


def solids_drawing(
    solids: Solids, triangles: Array, by: str
) -> tuple[dict[str, Painted], dict[str, Legend]]:
    """Paint contacts where they are, coloured by a coordinate, and where their signals are."""
    painted: dict[str, Painted] = {}
    legends: dict[str, Legend] = {}
    for i, name in enumerate(COORDINATES):
        colours, legends[name] = shaded(name, values_of(name, triangles))
        painted[name] = Painted(solids.seen(triangles, i), colours)
        if name == by:
            painted["contacts"] = Painted(solids.seen(triangles, None), colours)
    return painted, legends


def picked_drawing(solids: Solids, row: Array, exaggeration: float) -> tuple[Drawing, str]:
    """Mark a contact in all spaces, bend the whisker there, and say what it feels."""
    whisker = solids.chart.whisker
    radius = 0.016 * solids.length
    out: dict[str, Thing] = {}
    for number in (None, 0, 1, 2):
        vertices, faces = ellipsoid(solids.seen(row, number), radius * np.eye(3))
        out[f"mark {number}"] = Body(vertices, faces, CONTACT)
    # On the surface a whisker is about to slip off; a little inside it holds.
    inside = np.asarray(whisker.position(values_of("arc_length", row))) - row[:3]
    for share in (0.0, 0.01, 0.05):
        bent = deflect(whisker, PointContact(row[:3] + share * inside))
        if Status(int(bent.status)).ok:
            line = np.asarray(bent.centerline(NODES))
            body = whisker_body(whisker, line, exaggeration, WHISKER)
            out["bent"] = _moved(body, solids.place(None))
            if share == 0.0:
                return out, of_deflection(bent)
            break
    felt = {name: float(values_of(name, row)) for name in SIGNALS}
    where = {name: float(values_of(name, row)) for name in ("arc_length", *COORDINATES)}
    edge = note("On the edge of what the whisker can reach: it is about to slip off.")
    return out, edge + table(felt, "At the base") + table(where, "Contact")
