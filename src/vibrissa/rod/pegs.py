"""Contacts of a whisker with pegs: lines or cylinders, touched by the whisker's side or tip.

A peg is first displaced from its position, against the force, to where it just touches the resting
whisker, and then moved back with the contact followed (:mod:`vibrissa.rod.continuation`). A line
whose path misses the tip may still hold the bent whisker; it is moved straight from a contact near
the tip to its position. With an earlier deflection, a peg is moved straight from its earlier
position to its present one.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod.chart import LEAST_ARC, stable_set
from vibrissa.rod.continuation import LEAST_FORCE, SIDE, TIP
from vibrissa.rod.discretization import Bendable
from vibrissa.rod.points import Solutions, follow_all
from vibrissa.status import Status

_SAMPLES = 513
_DEPTH = 1e-6  # depth of the first contact, at which the force is about the least one
# Arc length (over L) of the contact from which a line that misses the tip is moved.
_NEAR_TIP = 0.95
# An axis nearer than this (over L) to the whisker passes through it.
_TOUCHING = 1e-9
_ROWS = 4096


class Pegs(NamedTuple):
    """Pegs in rows, lengths over L: a point of the axis, unit axis, radius (-1 for a line)."""

    origin: Array
    axis: Array
    radius: Array

    def rows(self, which: Any) -> Pegs:
        """Select rows."""
        return Pegs(self.origin[which], self.axis[which], self.radius[which])

    def parameters(self) -> Array:
        """(n, 7) parameters for :func:`vibrissa.rod.continuation.follow`."""
        return np.concatenate([self.origin, self.axis, self.radius[:, None]], axis=1)


class Rest(NamedTuple):
    """Samples of the resting whisker: s/L, position over L, material frame, radius over L."""

    s: Array
    position: Array
    frame: Array
    radius: Array

    @classmethod
    @lru_cache(maxsize=16)
    def of(cls, whisker: Bendable) -> Rest:
        """Sample a whisker; cached."""
        s = np.linspace(0.0, 1.0, _SAMPLES)
        arc_length = np.minimum(s * whisker.length, whisker.length)
        return cls(
            s,
            whisker.position(arc_length) / whisker.length,
            whisker.frame(arc_length),
            whisker.radius(arc_length) / whisker.length,
        )


def nearest_side(rest: Rest, pegs: Pegs, outward: bool) -> Array:
    """Unit vectors (n, 3) between axis and resting whisker at their closest points."""
    rows = np.arange(len(pegs.axis))
    away = _normal_part(rest.position - pegs.origin[:, None], pegs.axis[:, None])
    nearest = np.linalg.norm(away, axis=-1).argmin(axis=1)
    tangent = _normal_part(rest.frame[nearest][:, :, 0], pegs.axis)
    direction = away[rows, nearest]
    length = np.einsum("ni,ni->n", tangent, tangent)
    along = np.einsum("ni,ni->n", direction, tangent) / np.where(length > 0.0, length, 1.0)
    # The closest point is next to the closest sample, unless the axis is beyond an end.
    beyond_tip = (nearest == rest.s.size - 1) & (along < 0.0)
    beyond_base = (nearest == 0) & (along > 0.0)
    along = np.where(beyond_tip | beyond_base, 0.0, along)
    direction = direction - along[:, None] * tangent
    # For an axis that intersects the whisker both sides are equal: take the one toward +y.
    across = np.cross(pegs.axis, tangent)
    across *= np.where(across[:, 1:2] < 0.0, -1.0, 1.0) * (1.0 if outward else -1.0)
    size = np.linalg.norm(direction, axis=-1, keepdims=True)
    direction = np.where(size > _TOUCHING, direction, across)
    size = np.linalg.norm(direction, axis=-1, keepdims=True)
    direction = direction / np.where(size > 0.0, size, 1.0)
    return direction if outward else -direction


def solve_from_rest(
    whisker: Bendable, pegs: Pegs, side: Array, proximal: float, steps: int
) -> Solutions:
    """Solve pegs that move into contact with the resting whisker."""
    parts = [Solutions.empty(0)]
    rest = Rest.of(whisker)
    for first in range(0, len(side), _ROWS):
        rows = slice(first, first + _ROWS)
        parts.append(_solve_from_rest(whisker, rest, pegs.rows(rows), side[rows], proximal, steps))
    return Solutions(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _solve_from_rest(
    whisker: Bendable, rest: Rest, pegs: Pegs, side: Array, proximal: float, steps: int
) -> Solutions:
    """Solve pegs from rest, a block of rows."""
    out = Solutions.empty(len(side))
    there = np.isfinite(pegs.parameters()).all(axis=1) & np.isfinite(side).all(axis=1)
    out.statuses[there] = int(Status.NO_CONTACT)
    _set_no_contact(out, np.flatnonzero(there))
    push = _normal_part(side, pegs.axis)
    size = np.linalg.norm(push, axis=-1, keepdims=True)
    push = push / np.where(size > 0.0, size, 1.0)
    depth, s, direction = _first_contact(rest, pegs, push)
    out.statuses[there & (depth < 0.0) & (s < LEAST_ARC)] = int(Status.TOO_PROXIMAL)
    rows = np.flatnonzero(there & (depth < 0.0) & (s >= LEAST_ARC))
    near_base = np.flatnonzero(out.statuses == int(Status.TOO_PROXIMAL))
    out.values[near_base], out.contacts[near_base] = np.nan, np.nan
    out.misfits[near_base] = np.nan
    if rows.size:
        ends = pegs.parameters()[rows]
        begins = ends.copy()
        begins[:, :3] += (depth[rows] + _DEPTH)[:, None] * push[rows]
        kinds, unknowns = _first_contact_unknowns(rest, s[rows], direction[rows])
        _follow(whisker, begins, ends, kinds, unknowns, out, rows, proximal, steps)
    missed = there & (pegs.radius < 0.0) & (depth == np.inf)
    _from_near_tip(whisker, rest, pegs, push, out, np.flatnonzero(missed), proximal, steps)
    return out


def _from_near_tip(
    whisker: Bendable,
    rest: Rest,
    pegs: Pegs,
    push: Array,
    out: Solutions,
    rows: IntArray,
    proximal: float,
    steps: int,
) -> None:
    """Solve lines whose path misses the tip of the resting whisker, if they hold the bent one."""
    ends, axis = pegs.parameters()[rows], pegs.axis[rows]
    i = int(np.searchsorted(rest.s, _NEAR_TIP))
    normal = np.cross(axis, rest.frame[i][:, 0])
    normal *= np.sign(np.einsum("ni,ni->n", normal, push[rows]))[:, None]
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(size > 0.0, size, 1.0)
    touch = _normal_part(rest.position[i] - ends[:, :3], axis)
    pushing = np.flatnonzero(np.einsum("ni,ni->n", touch, normal) < 0.0)
    rows, ends, normal, touch = rows[pushing], ends[pushing], normal[pushing], touch[pushing]
    if not rows.size:
        return
    begins = ends.copy()
    begins[:, :3] += touch + _DEPTH * normal
    kinds, unknowns = _first_contact_unknowns(rest, np.full(rows.size, rest.s[i]), normal)
    found = Solutions.empty(len(out.statuses))
    _follow(whisker, begins, ends, kinds, unknowns, found, rows, proximal, steps)
    held = rows[found.statuses[rows] == Status.OK]
    out.put(held, Solutions(*(part[held] for part in found)))


def solve_from_contact(
    whisker: Bendable,
    before: Pegs,
    contacts: Array,
    tip: AnyArray,
    pegs: Pegs,
    proximal: float,
    steps: int,
) -> Solutions:
    """Continue contacts (s, f) from pegs ``before`` to the pegs' present position."""
    begins, ends = before.parameters(), pegs.parameters()
    # The sign of an axis is arbitrary; choose that for which it turns by less than 90°.
    turned = np.einsum("ij,ij->i", begins[:, 3:6], ends[:, 3:6]) < 0.0
    ends[turned, 3:6] *= -1.0
    unknowns = _polar_unknowns(contacts, tip)
    out = Solutions.empty(len(ends))
    rows = np.flatnonzero(np.isfinite(ends).all(axis=1))
    kinds = np.where(tip, TIP, SIDE)
    _follow(
        whisker, begins[rows], ends[rows], kinds[rows], unknowns[rows], out, rows, proximal, steps
    )
    return out


def _follow(
    whisker: Bendable,
    begins: Array,
    ends: Array,
    kinds: IntArray,
    unknowns: Array,
    out: Solutions,
    rows: IntArray,
    proximal: float,
    steps: int,
) -> None:
    """Follow contacts from ``begins`` to ``ends``, and write them into rows of ``out``."""
    chart = stable_set(whisker, proximal=proximal, steps=steps)
    solved = follow_all(
        chart, np.ascontiguousarray(begins), np.ascontiguousarray(ends), kinds.copy(), unknowns
    )
    good = (solved.statuses == Status.OK) | (solved.statuses == Status.TIP_CONTACT)
    out.statuses[rows], out.misfits[rows] = solved.statuses, solved.misfits
    out.contacts[rows[good]], out.values[rows[good]] = solved.contacts[good], solved.values[good]
    out.contacts[rows[~good]], out.values[rows[~good]] = np.nan, np.nan
    _set_no_contact(out, rows[solved.statuses == Status.NO_CONTACT])


def _set_no_contact(out: Solutions, rows: IntArray) -> None:
    """Set rows without contact: zero force and no contact point."""
    out.contacts[rows, 0], out.contacts[rows, 1:] = np.nan, 0.0
    out.values[rows, :3], out.values[rows, 3:] = 0.0, np.nan
    out.misfits[rows] = 0.0


def _normal_part(v: Array, axis: Array) -> Array:
    """Component of v normal to a unit axis."""
    return np.asarray(v - np.einsum("...i,...i->...", v, axis)[..., None] * axis)


def _first_contact(rest: Rest, pegs: Pegs, push: Array) -> tuple[Array, Array, Array]:
    """First contact of pegs moving along ``push`` with the resting whisker.

    Returns the distance still to go (negative: it is past), s of the contact and the unit
    direction of the force; the distance is inf where there is no contact.
    """
    relative = _normal_part(rest.position - pegs.origin[:, None], pegs.axis[:, None])
    across = np.cross(pegs.axis, push)
    x = np.einsum("nsi,ni->ns", relative, across)
    y = np.einsum("nsi,ni->ns", relative, push)
    solid = pegs.radius >= 0.0
    reach_of = np.where(solid[:, None], pegs.radius[:, None] + rest.radius, 0.0)
    with np.errstate(invalid="ignore"):
        height = y - np.sqrt(reach_of**2 - x**2)
    height = np.where(np.isfinite(height), height, np.inf)
    n = np.arange(len(push))
    i = height.argmin(axis=1)
    depth, s = height[n, i], rest.s[i]
    for row in np.flatnonzero(~solid & np.isfinite(x).all(axis=1)):
        # A line touches where the whisker crosses the plane through it along the push, and if the
        # whisker is in that plane, at the first point it meets.
        here, there = x[row, :-1], x[row, 1:]
        within = (here == 0.0) & (there == 0.0)
        cross = np.flatnonzero(((here <= 0.0) != (there <= 0.0)) | within)
        if there[-1] == 0.0:
            cross = np.append(cross, x.shape[1] - 2)
        if not cross.size:
            depth[row] = np.inf
            continue
        run = x[row, cross] - x[row, cross + 1]
        part = np.where(run != 0.0, x[row, cross] / np.where(run != 0.0, run, 1.0), 0.0)
        at = y[row, cross] + part * (y[row, cross + 1] - y[row, cross])
        first = at.argmin()
        depth[row] = at[first]
        s[row] = rest.s[cross[first]] + part[first] * (rest.s[1] - rest.s[0])
        i[row] = cross[first]
    tangent = rest.frame[i][:, :, 0]
    touching = relative[n, i] - np.where(np.isfinite(depth), depth, 0.0)[:, None] * push
    size = np.linalg.norm(touching, axis=1, keepdims=True)
    normal = np.cross(pegs.axis, tangent)
    normal *= np.sign(np.einsum("ni,ni->n", normal, push))[:, None]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 0.0, normal / np.where(length > 0.0, length, 1.0), push)
    direction = np.where(solid[:, None], touching / np.where(size > 0.0, size, 1.0), normal)
    return depth, s, direction


def _first_contact_unknowns(rest: Rest, s: Array, direction: Array) -> tuple[IntArray, Array]:
    """Kind of contact and unknowns (n, 3) at first contact."""
    i = np.clip(np.searchsorted(rest.s, s), 0, rest.s.size - 1)
    along, first, second = np.einsum("nij,ni->jn", rest.frame[i], direction)
    tip = (s >= 1.0 - 1e-9) & (along < -1e-3)
    psi = np.arctan2(second, first)
    force = np.full_like(s, LEAST_FORCE)
    lean = np.arcsin(np.clip(along, -1.0, 0.0))
    unknowns = np.where(
        tip[:, None], np.stack([force, lean, psi], axis=1), np.stack([s, force, psi], axis=1)
    )
    return np.where(tip, TIP, SIDE), unknowns


def _polar_unknowns(contacts: Array, tip: AnyArray) -> Array:
    """Unknowns of contacts (s, f) on the side or at the tip."""
    s, fx, fy, fz = contacts.T
    normal, psi = np.hypot(fy, fz), np.arctan2(fz, fy)
    force = np.maximum(np.hypot(normal, fx), LEAST_FORCE)
    return np.where(
        np.asarray(tip)[:, None],
        np.stack([force, np.arctan2(fx, normal), psi], axis=1),
        np.stack([s, np.maximum(normal, LEAST_FORCE), psi], axis=1),
    )
