"""What is bent, by what, and what became of it: a state and its transitions.

Nothing here knows of a browser. A load without an equilibrium leaves the last shape that had one,
so that there is something to look at beside the reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.rod import Deflection, PegContact, PointContact, PointForce, deflect
from vibrissa.status import Status
from vibrissa.viewer.drawing import Array
from vibrissa.whisker import Whisker

Kind = Literal["point", "peg", "force"]
KINDS: tuple[Kind, ...] = ("point", "peg", "force")


@dataclass(frozen=True, eq=False)
class Bend:
    """A whisker, a load, and the deflection by it."""

    whisker: Whisker
    kind: Kind
    point: Array
    origin: Array
    axis: Array
    radius: float
    place: float
    magnitude: float
    direction: float
    deflection: Deflection
    held: Deflection

    @property
    def status(self) -> Status:
        """What became of the load."""
        return Status(int(self.deflection.status))

    @property
    def target(self) -> Array:
        """What is dragged: the wanted contact point, the peg's origin, or where the force acts."""
        if self.kind == "point":
            return self.point
        if self.kind == "peg":
            return self.origin
        return np.asarray(self.held.contact_point)


def force_scale(whisker: Whisker) -> float:
    """EI / L² at the base, N: about the force that bends a whisker a lot near its base."""
    return whisker.base_bending_stiffness / whisker.length**2


def begin(whisker: Whisker) -> Bend:
    """Bend a whisker by a point a little aside of where it rests."""
    place = whisker.position(0.65 * whisker.length)
    frame = whisker.frame(0.65 * whisker.length)
    point = place + 0.12 * whisker.length * frame[:, 1]
    first = deflect(whisker, PointContact(point))
    return _solved(
        Bend(
            whisker=whisker,
            kind="point",
            point=point,
            origin=point,
            axis=np.array([0.0, 0.0, 1.0]),
            radius=0.0,
            place=0.65,
            magnitude=0.3 * force_scale(whisker),
            direction=0.0,
            deflection=first,
            held=first,
        )
    )


def moved(bend: Bend, to: ArrayLike, axis: ArrayLike | None = None) -> Bend:
    """Put the contact point or the peg elsewhere, m, and perhaps turn the peg."""
    place = np.array(to, dtype=np.float64)
    if bend.kind == "peg":
        turned = bend.axis if axis is None else np.array(axis, dtype=np.float64)
        return _solved(replace(bend, origin=place, axis=turned))
    return _solved(replace(bend, point=place)) if bend.kind == "point" else bend


def loaded(bend: Bend, kind: Kind) -> Bend:
    """Take another load, which begins where the one before acts."""
    at = np.asarray(bend.held.contact_point)
    if not np.isfinite(at).all():
        at = bend.target
    if kind == "peg":
        bend = replace(bend, kind=kind, origin=at, deflection=bend.held)
    elif kind == "point":
        bend = replace(bend, kind=kind, point=at)
    else:
        bend = _as_force(replace(bend, kind=kind))
    return _solved(bend)


def _as_force(bend: Bend) -> Bend:
    """Take place, size and direction of the force that now acts."""
    _, fy, fz = np.asarray(bend.held.contact_force)
    arc_length = float(bend.held.arc_length)
    if not np.isfinite([fy, fz, arc_length]).all() or arc_length <= 0.0:
        return bend
    return replace(
        bend,
        place=arc_length / bend.whisker.length,
        magnitude=float(np.hypot(fy, fz)),
        direction=float(np.arctan2(fz, fy)),
    )


def with_radius(bend: Bend, radius: float) -> Bend:
    """Give the peg a radius, m."""
    return _solved(replace(bend, radius=radius))


def with_force(bend: Bend, place: float, magnitude: float, direction: float) -> Bend:
    """Say where (share of the length) a force acts, how large it is, N, and its direction, rad."""
    return _solved(replace(bend, place=place, magnitude=magnitude, direction=direction))


def with_whisker(bend: Bend, whisker: Whisker) -> Bend:
    """Bend another whisker by the same load; points and pegs move along with its length."""
    scale = whisker.length / bend.whisker.length
    rest = deflect(whisker, PointForce(0.5 * whisker.length, 0.0, 0.0))
    stretched = replace(
        bend,
        whisker=whisker,
        point=scale * bend.point,
        origin=scale * bend.origin,
        deflection=rest,
        held=rest,
    )
    return _solved(stretched)


def _solved(bend: Bend) -> Bend:
    """Deflect; what has no answer leaves the last shape."""
    bent = deflect(bend.whisker, _load(bend))
    return replace(bend, deflection=bent, held=bent if Status(int(bent.status)).ok else bend.held)


def _load(bend: Bend) -> PointContact | PegContact | PointForce:
    if bend.kind == "point":
        return PointContact(bend.point)
    if bend.kind == "force":
        return PointForce(bend.place * bend.whisker.length, bend.magnitude, bend.direction)
    before = bend.deflection
    goes_on = (
        isinstance(before.load, PegContact)
        and before.whisker is bend.whisker
        and (float(before.load.radius) > 0.0) == (bend.radius > 0.0)
    )
    if goes_on:
        return PegContact(bend.origin, bend.axis, bend.radius, start=before)
    # The side on which the whisker is pushed now is the side on which it stays.
    side = np.asarray(bend.held.force)
    sideways = np.linalg.norm(np.cross(side, bend.axis)) > 1e-6 * np.linalg.norm(side) > 0.0
    return PegContact(bend.origin, bend.axis, bend.radius, side=side if sideways else None)
