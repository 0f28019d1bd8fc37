"""States of the page and their transitions: whisker, load, deflection, contacts.

This module does not need a browser. For a load without an equilibrium, the last shape is kept, to
be shown together with the reason.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contacts import ContactMap
from vibrissa.deferred import spatial
from vibrissa.numerics import Array
from vibrissa.quantities import quantity, to_display
from vibrissa.rod import Deflection, PegContact, PointContact, PointForce, deflect
from vibrissa.scene import Bytes, Painted, column, sample_contacts, sheet, solid_surface
from vibrissa.signals import SIGNALS
from vibrissa.status import Status
from vibrissa.viewer.readout import CLOUD
from vibrissa.whisker import Whisker, constant

Kind = Literal["point", "peg", "force"]
KINDS: tuple[Kind, ...] = ("point", "peg", "force")
_MM, _UN = quantity("length").display_factor, quantity("force").display_factor
_GPA = 1e-9


@dataclass(frozen=True, eq=False)
class Bend:
    """State of a whisker with a load and the resulting deflection."""

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
        """Status of the load."""
        return Status(int(self.deflection.status))

    @property
    def target(self) -> Array:
        """Dragged point: requested contact point, origin of the peg, or position of the force."""
        if self.kind == "point":
            return self.point
        if self.kind == "peg":
            return self.origin
        return np.asarray(self.held.contact_point)


def force_scale(whisker: Whisker) -> float:
    """EI / L² at the base, N: order of the force for large bending near the base."""
    return whisker.base_bending_stiffness / whisker.length**2


def begin(whisker: Whisker) -> Bend:
    """Initial state: a whisker deflected slightly by a point."""
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
    """Move the contact point or the peg, m, and optionally rotate the peg."""
    place = np.array(to, dtype=np.float64)
    if bend.kind == "peg":
        turned = bend.axis if axis is None else np.array(axis, dtype=np.float64)
        return _solved(replace(bend, origin=place, axis=turned))
    return _solved(replace(bend, point=place)) if bend.kind == "point" else bend


def loaded(bend: Bend, kind: Kind) -> Bend:
    """Change the kind of load, starting from the current contact."""
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
    """Convert the current contact to a force with the same position, magnitude and direction."""
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
    """Set the radius of the peg, m."""
    return _solved(replace(bend, radius=radius))


def with_force(bend: Bend, place: float, magnitude: float, direction: float) -> Bend:
    """Set position (share of the length), magnitude (N) and direction (rad) of a force."""
    return _solved(replace(bend, place=place, magnitude=magnitude, direction=direction))


def link_of(bend: Bend) -> dict[str, str]:
    """Parameter of a link that restores the load: mm, µN, degrees."""
    if bend.kind == "point":
        return {"contact": words_of(_MM * bend.point)}
    if bend.kind == "peg":
        return {"peg": words_of([*(_MM * bend.origin), *bend.axis, _MM * bend.radius])}
    return {"force": words_of([bend.place, _UN * bend.magnitude, np.rad2deg(bend.direction)])}


def restored(bend: Bend, asked: Mapping[str, str]) -> Bend:
    """Restore the load from the parameters of a link, if they state one."""
    if (contact := numbers_in(asked.get("contact", ""), 3)) is not None:
        return moved(loaded(bend, "point"), contact / _MM)
    if (peg := numbers_in(asked.get("peg", ""), 7)) is not None and peg[3:6].any():
        bend = replace(loaded(bend, "peg"), radius=abs(peg[6]) / _MM)
        return moved(bend, peg[:3] / _MM, peg[3:6])
    if (force := numbers_in(asked.get("force", ""), 3)) is not None:
        place = float(np.clip(force[0], 0.05, 1.0))
        return with_force(loaded(bend, "force"), place, force[1] / _UN, np.deg2rad(force[2]))
    return bend


def words_of(numbers: ArrayLike) -> str:
    """Numbers as the value of a link's parameter."""
    return ",".join(f"{x:.6g}" for x in np.asarray(numbers, dtype=np.float64))


def numbers_in(word: str, count: int) -> Array | None:
    """Parse ``count`` finite numbers from a link's parameter; None if this fails."""
    try:
        numbers = np.array(word.split(","), dtype=np.float64)
    except ValueError:
        return None
    return numbers if numbers.shape == (count,) and np.isfinite(numbers).all() else None


def with_whisker(bend: Bend, whisker: Whisker) -> Bend:
    """Apply the same load to another whisker; points and pegs scale with its length."""
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
    """Solve for the deflection; without an equilibrium the last shape is kept."""
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


@dataclass(frozen=True)
class Shape:
    """Shape parameters set by the sliders."""

    length: float
    turn: float
    taper: float
    modulus: float


def words_of_shape(shape: Shape) -> str:
    """Parameter of a link that restores a shape: mm, degrees, ratio, GPa."""
    return words_of([_MM * shape.length, np.rad2deg(shape.turn), shape.taper, _GPA * shape.modulus])


def shape_in(word: str) -> Shape | None:
    """Parse a shape from a link's parameter; None if this fails."""
    if (numbers := numbers_in(word, 4)) is None:
        return None
    length, turn, taper, modulus = numbers.tolist()
    return Shape(length / _MM, float(np.deg2rad(turn)), taper, modulus / _GPA)


def shape_of(whisker: Whisker) -> Shape:
    """Shape parameters of a whisker."""
    taper = whisker.base_radius / whisker.tip_radius
    # The angle by which it turns from base to tip, ∫|κ| ds.
    s = (np.arange(400) + 0.5) / 400.0 * whisker.length
    bending = np.linalg.norm(whisker.curvature(s)[:, 1:], axis=1)
    turn = float(bending.mean() * whisker.length)
    return Shape(whisker.length, turn, taper, whisker.youngs_modulus)


def shaped(whisker: Whisker, asked: Shape) -> Whisker:
    """Change a whisker to a requested shape.

    The base radius stays. A taper other than its own is linear; a straight whisker that is to turn
    gets the same curvature everywhere.
    """
    own = shape_of(whisker)
    if asked == own:
        return whisker
    out = whisker.scaled(asked.length / own.length)
    if whisker.is_straight and asked.turn > 0.0:
        bend = np.array([0.0, 0.0, asked.turn / asked.length])
        out = replace(out, intrinsic_curvature=constant(bend, out.length))
    elif not np.isclose(asked.turn, own.turn):
        out = replace(
            out, intrinsic_curvature=out.intrinsic_curvature.scaled(1.0, asked.turn / own.turn)
        )
    if not np.isclose(asked.taper, own.taper):
        out = out.with_properties(tip_radius=whisker.base_radius / asked.taper)
    return out.with_properties(youngs_modulus=asked.modulus)


_SKIN, _SOLID = (12, 48, 6), (36, 72, 16)


@dataclass(frozen=True, eq=False)
class Chart:
    """Map of a whisker with the drawn samples."""

    contact_map: ContactMap
    samples: xr.Dataset
    line: Array
    points: Array
    signals: dict[str, Array]

    @property
    def whisker(self) -> Whisker:
        """Whisker of the map."""
        return self.contact_map.whisker


def charted(whisker: Whisker, contact_map: ContactMap | None = None) -> Chart:
    """Sample all stable contacts of a whisker; its map is computed unless given."""
    contact_map = contact_map or ContactMap.simulate(whisker, grid=False)
    samples, line = contact_map.to_dataset(), whisker.centerline()
    # The last bearing is the first again, and no load is not a contact.
    kept = samples.isel(bearing=slice(0, -1), load=slice(2, None, 2))
    aside = ~kept["small_deflection"].to_numpy().astype(bool)
    signals = {name: kept[name].to_numpy()[aside] for name in SIGNALS}
    return Chart(contact_map, samples, line, kept["contact_point"].to_numpy()[aside], signals)


def envelope(chart: Chart) -> Painted:
    """Surface at which the whisker slips off, drawn from the inside only."""
    nodes = sample_contacts(chart.samples, chart.line, shape=_SKIN)[..., :3]
    # The end near the base stays open.
    skin = np.concatenate([nodes[:, :, -1], nodes[-1, :, -2::-1].swapaxes(0, 1)])
    vertices, faces = sheet(to_display("contact_point", skin))
    triangles = vertices[faces]
    colours = np.broadcast_to(np.array(CLOUD, dtype=np.uint8), triangles.shape)
    return Painted(triangles, colours, 0.45, "back")


def coloured_solid(chart: Chart, colours: Bytes, cut: bool, opacity: float | None) -> Painted:
    """Draw all contacts, or those with z < 0, in the colours (n, 3) of the nearest samples."""
    nodes = sample_contacts(chart.samples, chart.line, shape=_SOLID)
    nodes = np.concatenate([nodes, -nodes[..., 2:3]], axis=-1)
    below = (nodes.shape[-1] - 1,) if cut else ()
    points = solid_surface(nodes, True, column("deflection"), *below)[..., :3]
    _, nearest = spatial.cKDTree(chart.points).query(points)
    return Painted(to_display("contact_point", points), colours[nearest], opacity)
