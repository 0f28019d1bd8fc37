"""Position of an object and amplitude of whisking, for whiskers of any length and shape.

The peg is at a share of the whisker's reach. The turn at which the whisker slips past depends on
its shape and taper and is found by a coarse sweep in each direction, from clear of the peg until
the whisker is clear again on the other side.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vibrissa.objects import Box, Peg, Plane, Sphere, Surface
from vibrissa.rod import follow_surfaces
from vibrissa.simulation.motion import (
    ELEVATION_PER_AZIMUTH,
    ROLL_PER_AZIMUTH,
    Motion,
    whisking,
)
from vibrissa.status import Status
from vibrissa.whisker import Whisker, WhiskerArray, base_rotation

PEG_RADIUS = 1.35e-3
"""Half the diameter of the paper's peg, m."""

_STEP = np.radians(1.5)
"""Turn of a step of the coarse sweep."""

_FARTHEST = np.radians(120.0)
"""Largest turn of the coarse sweep."""

_MARGIN = np.radians(5.0)
"""Turn beyond the slip."""


def facing_peg(whisker: Whisker, distance: float = 0.65, radius: float = PEG_RADIUS) -> Peg:
    """Vertical peg near the head, within reach of a whisker.

    Parameters
    ----------
    whisker : Whisker
        Whisker that is to touch it.
    distance : float
        Distance from the base to the peg's axis, as a share of the farthest reach of the resting
        whisker.
    radius : float
        Radius of the peg, m.

    Returns
    -------
    Peg
        Peg on the x axis of the laboratory.

    Raises
    ------
    ValueError
        If the distance is not a share of the reach, or if the base would touch the peg.
    """
    if not 0.0 < distance < 1.0:
        raise ValueError(f"distance is {distance!r}; a share of the reach, in (0, 1), is needed")
    reach = float(np.linalg.norm(whisker.centerline(401), axis=1).max())
    if distance * reach < 1.5 * radius:
        raise ValueError(
            f"a peg of radius {radius * 1e3:.2f} mm at {distance * reach * 1e3:.2f} mm from the "
            f"base leaves no room for the whisker, which reaches {reach * 1e3:.2f} mm: choose a "
            "thinner peg or a larger distance"
        )
    return Peg(np.array([distance * reach, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), radius)


def within_reach(whisker: Whisker | WhiskerArray, kind: str | None = None) -> Surface:
    """Object within reach of a whisker, or of the whiskers of a face.

    Parameters
    ----------
    whisker : Whisker or WhiskerArray
        Whisker that is to touch it, or whiskers.
    kind : {"peg", "sphere", "box", "plane"}, optional
        Kind of the object; by default a peg for a whisker, and a sphere for an array.

    Returns
    -------
    Peg, Sphere, Box or Plane
        Object near the base of the whisker; or before the right side of a face at the origin of the
        laboratory, out of the reach of whiskers at rest, for a head that moves forward by 14 mm (a
        plane is square to its path).

    Raises
    ------
    ValueError
        If the kind is unknown.
    """
    things: dict[str, Surface]
    if isinstance(whisker, Whisker):
        reach = float(np.linalg.norm(whisker.centerline(401), axis=1).max())
        place = np.array([0.65 * reach, 0.0, 0.0])
        things = {
            "peg": facing_peg(whisker),
            "sphere": Sphere(place, 0.12 * reach),
            "box": Box(place, np.full(3, 0.2 * reach), edge_radius=0.02 * reach),
            "plane": Plane(np.array([0.0, 0.3 * reach, 0.0]), np.array([0.0, -1.0, 0.0])),
        }
    else:
        ahead = 1e-3 * np.array([22.0, 28.0, -10.0])
        things = {
            "sphere": Sphere(ahead, 15e-3),
            "peg": Peg(1e-3 * np.array([20.0, 22.0, 0.0]), np.array([0.0, 0.0, 1.0]), PEG_RADIUS),
            "box": Box(ahead, 1e-3 * np.array([24.0, 20.0, 24.0]), edge_radius=1e-3),
            "plane": Plane(np.array([0.0, 24e-3, 0.0]), np.array([0.0, -1.0, 0.0])),
        }
    chosen = next(iter(things)) if kind is None else kind
    if chosen not in things:
        raise ValueError(
            f"the object is of kind {kind!r}; one of {', '.join(things)} is needed (a mesh is "
            "written in the trial's text)"
        )
    return things[chosen]


def sweep_past(
    whisker: Whisker,
    thing: Peg | Sphere | Box,
    duration: float = 3.0,
    rate: float = 1000.0,
    *,
    row: str = "C",
    seed: int = 0,
    **motion: Any,
) -> Motion:
    """Whisking in which the whisker slips past an object, forward and back.

    Parameters
    ----------
    whisker : Whisker
        Whisker that whisks.
    thing : Peg, Sphere or Box
        Object near it; a peg more or less vertical.
    duration : float
        Duration of the trial, s.
    rate : float
        Frame rate, Hz.
    row : {"A", "B", "C", "D", "E"}
        Row of the array, by which elevation and roll follow the azimuth.
    seed : int
        Seed of the drifts.
    **motion
        Other parameters of `whisking`.

    Returns
    -------
    Motion
        Motion whose set point and amplitude lead past the slips on either side of the object.

    Raises
    ------
    ValueError
        If the row is unknown, if the whisker does not touch the object, or does not slip past it
        within 120°.
    """
    if row not in ROLL_PER_AZIMUTH:
        raise ValueError(f"row is {row!r}; one of {', '.join(ROLL_PER_AZIMUTH)} is needed")
    motion.setdefault("elevation_per_azimuth", ELEVATION_PER_AZIMUTH[row])
    motion.setdefault("roll_per_azimuth", ROLL_PER_AZIMUTH[row])
    motion.setdefault("variation", 0.05)
    motion.setdefault("position_drift", 0.03 * whisker.length)
    ratios = motion["elevation_per_azimuth"], motion["roll_per_azimuth"]
    rear = _slip(whisker, thing, -1.0, ratios) - _MARGIN
    front = _slip(whisker, thing, 1.0, ratios) + _MARGIN
    # A drift of set point or amplitude must not keep the whisker from slipping.
    amplitude = 0.5 * (front - rear) * (1.0 + 2.0 * motion["variation"])
    motion.setdefault("amplitude", amplitude)
    motion.setdefault("set_point", 0.5 * (front + rear))
    return whisking(duration, rate, seed=seed, **motion)


def _toward(whisker: Whisker, thing: Peg | Sphere | Box) -> float:
    """Azimuth of the base at which the resting whisker would run through an object, rad."""
    points = whisker.centerline(801)
    distance = np.hypot(*thing.origin[:2])
    near = np.abs(np.hypot(points[:, 0], points[:, 1]) - distance)
    # The nearest branch counts, where a whisker curls back to the same distance.
    i = int(np.argmax(near <= near.min() + 1e-3 * whisker.length))
    there = np.arctan2(thing.origin[1], thing.origin[0])
    return float(there - np.arctan2(points[i, 1], points[i, 0]))


def _slip(
    whisker: Whisker, thing: Peg | Sphere | Box, sense: float, ratios: tuple[float, float]
) -> float:
    """Azimuth at which the whisker slips past, sweeping forward (sense 1) or back (−1), rad."""
    middle = _toward(whisker, thing)
    turned = np.arange(-0.5 * _FARTHEST, _FARTHEST, _STEP) * sense
    rotations = base_rotation(middle + turned, ratios[0] * turned, ratios[1] * turned)
    bent = follow_surfaces(whisker, [thing], rotations, np.zeros((turned.size, 3))).bent
    touching = np.isin(bent.status, (Status.OK, Status.TIP_CONTACT))
    if not touching.any():
        raise ValueError(f"{whisker} does not meet {thing}")
    first = int(np.argmax(touching))
    past = np.flatnonzero(~touching[first:])
    if not past.size:
        degrees = np.degrees(_FARTHEST)
        raise ValueError(f"{whisker} does not slip past {thing} within {degrees:.0f}°")
    status = Status(int(bent.status[first + past[0]]))
    if status in (Status.NOT_CONVERGED, Status.TOO_PROXIMAL):
        raise ValueError(f"the sweep past {thing} cannot be planned: {status}")
    return float(middle + turned[first + past[0]])
