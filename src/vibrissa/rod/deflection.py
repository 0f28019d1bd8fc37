"""Bend a whisker: a load in, base force and moment, contact point and shape out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod.chart import PROXIMAL
from vibrissa.rod.discretization import STEPS, Discretization, discretize
from vibrissa.rod.forces import solve_known_forces
from vibrissa.rod.loads import Load, PegContact, PointContact, PointForce
from vibrissa.rod.pegs import Pegs, Rest, nearest_side, solve_from_contact, solve_from_rest
from vibrissa.rod.points import Solutions, point_solver
from vibrissa.rod.shape import shapes
from vibrissa.sketch import (
    BENT,
    CONTACT,
    MOST_CURVES,
    REST,
    Mark,
    card,
    lines,
    shown,
    thinned,
    views,
)
from vibrissa.status import Status, counted, describe

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

# Lengths beyond this (over L) are as good as this: their squares would overflow.
_FARTHEST = 1e100


@dataclass(frozen=True, eq=False)
class Deflection:
    """Deflected whiskers, one for each load; all in the whisker frame.

    Attributes
    ----------
    whisker : Whisker
        What was bent.
    load : PointForce, PointContact or PegContact
        What bent it.
    force : (..., 3) array
        Force of the object on the whisker, N; zero without contact, NaN without an answer.
    moment : (..., 3) array
        Moment about the base, contact_point × force, N·m.
    contact_point : (..., 3) array
        Contact point on the centreline, m; NaN without contact or answer.
    arc_length : (...) array
        Arc length of the contact from the base, m.
    contact_force : (..., 3) array
        The force in the material frame at the contact (tangent, d1, d2), N.
    residual : (...) array
        How well the load's equations are met: lengths over L, directions; 0 for a PointForce.
    status : (...) int array
        A :class:`~vibrissa.Status` each.
    steps : int
        Integration steps along the whisker.
    """

    whisker: Whisker
    load: Load
    force: Array
    moment: Array
    contact_point: Array
    arc_length: Array
    contact_force: Array
    residual: Array
    status: IntArray
    steps: int = field(default=STEPS, repr=False)
    # Steps that each row needs, where some need more.
    _needed: IntArray | None = field(default=None, repr=False)

    def centerline(self, n: int = 100) -> Array:
        """Return the deflected centrelines.

        Parameters
        ----------
        n : int
            Points along the whisker, equally spaced in arc length from base to tip.

        Returns
        -------
        (..., n, 3) array
            Places, m; the resting whisker where there is no contact, NaN where there is no answer.
        """
        if n < 2:
            raise ValueError(f"a centreline needs at least 2 points; got n={n}")
        rows = np.arange(self.status.size)
        return self._centerlines(rows, n).reshape(*self.status.shape, n, 3)

    def _centerlines(self, rows: IntArray, n: int) -> Array:
        """Centrelines (rows, n, 3) of some loads, counted without regard to their shape."""
        d = discretize(self.whisker, self.steps)
        needed = np.full(rows.size, self.steps) if self._needed is None else self._needed[rows]
        values = np.concatenate([self.force / d.force, self.contact_point / d.length], axis=-1)
        values = values.reshape(-1, 6)[rows]
        arc = self.arc_length.reshape(-1)[rows] / d.length
        free = np.flatnonzero(self.status.reshape(-1)[rows] == Status.NO_CONTACT)
        values[free, 3:], arc[free] = 0.0, 0.0
        # All that are free are the same: the first of them stands for the others.
        own = np.delete(np.arange(arc.size), free[1:])
        places = np.empty((arc.size, n, 3))
        for steps in np.unique(needed[own]):
            which, finer = own[needed[own] == steps], discretize(self.whisker, int(steps))
            line = shapes(finer, values[which], arc[which], np.linspace(0.0, 1.0, n))
            places[which] = line * d.length
        places[free[1:]] = places[free[:1]]
        return places

    def __repr__(self) -> str:
        """Say how many loads there are and what became of them."""
        return f"<{self._title()}: {counted(self.status)}>"

    def _repr_html_(self) -> str:
        """Show the bent whiskers, the resting one and the contacts, with the numbers."""
        rest = Mark(self.whisker.centerline(41), REST, label="at rest")
        bent = self._centerlines(thinned(np.arange(self.status.size), MOST_CURVES), 41)
        picture = views(
            [
                rest,
                Mark(bent, BENT, label="bent"),
                Mark(self.contact_point, CONTACT, dots=True, width=4.0, label="contact"),
            ]
        )
        return card(self._title(), self._rows(), picture)

    def __str__(self) -> str:
        """Tell the numbers as well."""
        return lines(self._title(), self._rows())

    def _title(self) -> str:
        return f"Deflection of {self.status.shape or 'one'} by {type(self.load).__name__}"

    def _rows(self) -> list[tuple[str, str]]:
        """Status, contact, force and moment; of a single load the status in words."""
        size = np.linalg.norm
        status = counted(self.status)
        if self.status.size == 1:
            status = next(iter(describe(self.status)))
        return [
            ("status", status),
            ("contact, distance from base", shown("r", size(self.contact_point, axis=-1))),
            ("contact, arc length", shown("arc_length", self.arc_length)),
            ("force", shown("force", size(self.force, axis=-1))),
            ("moment", shown("moment", size(self.moment, axis=-1))),
        ]


def deflect(
    whisker: Whisker, load: Load, *, proximal: float = PROXIMAL, steps: int = STEPS
) -> Deflection:
    """Bend a whisker quasi-statically.

    Parameters
    ----------
    whisker : Whisker
        What is bent.
    load : PointForce, PointContact or PegContact
        What bends it; arrays of any leading shape.
    proximal : float
        Contacts at less than this fraction of the length from the base get a status instead of an
        answer (not for a ``PointForce``).
    steps : int
        Integration steps along the whisker. The default is good to 1e-6 while the tangent turns by
        less than about 65°, and to 1e-4 up to slip-off; the error falls with the sixth power. A
        ``PointForce`` that bends the whisker further gets as many more as it needs for 1e-4.

    Returns
    -------
    Deflection
        The stable equilibrium that is connected to rest, for each contact, or the reason why there
        is none; the one equilibrium of each ``PointForce``.

    Raises
    ------
    ValueError
        If the load does not fit (see the loads), not if it has no equilibrium.

    Examples
    --------
    >>> import vibrissa as vb
    >>> whisker = vb.Whisker.parabola(length=39.4e-3, coefficient=10.0)
    >>> bent = vb.deflect(whisker, vb.PointContact([25e-3, 12e-3, 1e-3]))
    >>> vb.Status(bent.status).name
    'OK'
    """
    d = discretize(whisker, steps)
    if isinstance(load, PointForce):
        solved, needed = _by_force(whisker, d, load, steps)
        return replace(dimensional(whisker, load, d, solved, steps), _needed=needed)
    if isinstance(load, PointContact):
        solver = point_solver(whisker, proximal, steps)
        with np.errstate(over="ignore"):
            points = np.asarray(load.points).reshape(-1, 3) / d.length
        solved = solver.solve(points)
    elif isinstance(load, PegContact):
        solved = _by_peg(whisker, d, load, proximal, steps)
    else:
        raise ValueError(
            f"a load is a PointForce, a PointContact or a PegContact; got {type(load).__name__}"
        )
    return dimensional(whisker, load, d, solved, steps)


def _by_force(
    whisker: Whisker, d: Discretization, load: PointForce, steps: int
) -> tuple[Solutions, IntArray]:
    s = np.asarray(load.arc_length).reshape(-1) / d.length
    with np.errstate(over="ignore"):
        forces = np.asarray(load.components).reshape(-1, 3) / d.force
    contacts = np.concatenate([s[:, None], forces], axis=1)
    contacts[(s > 1.0) & (s <= 1.0 + 1e-9), 0] = 1.0
    statuses = np.full(s.size, int(Status.OK))
    statuses[contacts[:, 0] > 1.0] = Status.BEYOND_TIP
    statuses[np.isnan(contacts).any(axis=1)] = Status.MISSING
    rows = np.flatnonzero(statuses == Status.OK)
    values = np.full((s.size, 6), np.nan)
    needed = np.full(s.size, steps)
    values[rows], needed[rows], settled = solve_known_forces(whisker, contacts[rows], steps)
    statuses[rows[~settled]] = Status.TOO_STRONG
    lost = statuses != Status.OK
    contacts[lost], values[lost], needed[lost] = np.nan, np.nan, steps
    return Solutions(contacts, values, np.where(lost, np.nan, 0.0), statuses), needed


def _rows(load: PegContact, length: float) -> Pegs:
    with np.errstate(over="ignore"):
        radius = np.minimum(np.asarray(load.radius).reshape(-1) / length, _FARTHEST)
        origin = np.asarray(load.origin).reshape(-1, 3) / length
    return Pegs(
        np.clip(origin, -_FARTHEST, _FARTHEST),
        np.array(load.axis, dtype=np.float64).reshape(-1, 3),
        np.where(radius == 0.0, -1.0, radius),
    )


def _by_peg(
    whisker: Whisker, d: Discretization, load: PegContact, proximal: float, steps: int
) -> Solutions:
    pegs = _rows(load, d.length)
    start = load.start
    if start is None:
        if load.side is not None:
            side = np.asarray(load.side).reshape(-1, 3)
        else:
            side = nearest_side(Rest.of(whisker), pegs, outward=bool((pegs.radius >= 0.0).any()))
        return solve_from_rest(whisker, pegs, side, proximal, steps)
    if start.whisker is not whisker:
        raise ValueError("start is a deflection of another whisker")
    shape = load.shape
    contacts = np.concatenate(
        [
            np.broadcast_to(start.arc_length / d.length, shape).reshape(-1, 1),
            np.broadcast_to(start.contact_force / d.force, (*shape, 3)).reshape(-1, 3),
        ],
        axis=1,
    )
    status: AnyArray = np.broadcast_to(start.status, shape).reshape(-1)
    assert isinstance(start.load, PegContact)  # checked when the load was made
    earlier = PegContact(
        np.broadcast_to(start.load.origin, (*shape, 3)),
        np.broadcast_to(start.load.axis, (*shape, 3)),
        np.broadcast_to(start.load.radius, shape),
    )
    before = _rows(earlier, d.length)
    touching = np.isin(status, (Status.OK, Status.TIP_CONTACT))
    out = Solutions.empty(status.size)
    rows = np.flatnonzero(touching)
    if rows.size:
        tip = status[rows] == Status.TIP_CONTACT
        moved = solve_from_contact(
            whisker, before.rows(rows), contacts[rows], tip, pegs.rows(rows), proximal, steps
        )
        out.put(rows, moved)
    # A whisker that was free lies on the side of the peg where it then rested.
    rows = np.flatnonzero(~touching)
    if rows.size:
        side = nearest_side(Rest.of(whisker), before.rows(rows), outward=True)
        out.put(rows, solve_from_rest(whisker, pegs.rows(rows), side, proximal, steps))
    return out


def dimensional(
    whisker: Whisker, load: Load, d: Discretization, solved: Solutions, steps: int
) -> Deflection:
    """Give solved rows their units and the shape of their load."""
    shape = load.shape
    force = solved.values[:, :3] * d.force
    point = solved.values[:, 3:] * d.length
    moment = np.cross(point, force)
    moment[solved.statuses == Status.NO_CONTACT] = 0.0
    return Deflection(
        whisker=whisker,
        load=load,
        force=force.reshape(*shape, 3),
        moment=moment.reshape(*shape, 3),
        contact_point=point.reshape(*shape, 3),
        arc_length=(solved.contacts[:, 0] * d.length).reshape(shape),
        contact_force=(solved.contacts[:, 1:] * d.force).reshape(*shape, 3),
        residual=solved.misfits.reshape(shape),
        status=solved.statuses.reshape(shape),
        steps=steps,
    )
