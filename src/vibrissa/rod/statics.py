"""Deflection of a whisker by point forces, contacts at points, and pegs.

A known force, given in the deflected frame at the contact, has one equilibrium that grows from rest
with the force; it is integrated without iteration. A strong force, however, winds the whisker up in
waves as short as √(EI / force), which steps that are accurate up to slip-off do not resolve. The
magnitude of the force is an invariant of the equations, and its error indicates that steps are too
long. Then the number of steps is doubled until the result no longer changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import AnyArray, Array, IntArray, check_device
from vibrissa.rod.chart import PROXIMAL
from vibrissa.rod.deflection import (
    Deflection,
    Load,
    PegContact,
    PointContact,
    PointForce,
    finite_vectors,
    select_loads,
)
from vibrissa.rod.discretization import (
    MOST_STEPS,
    STEPS,
    Bendable,
    Discretization,
    check_whisker,
    discretize,
)
from vibrissa.rod.gravity import Resting, moved_moments, resting
from vibrissa.rod.integration import solve_forces
from vibrissa.rod.pegs import Pegs, Rest, nearest_side, solve_from_contact, solve_from_rest
from vibrissa.rod.points import Solutions, point_solver
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.objects import Surface
    from vibrissa.whisker import Whisker

_LARGEST_LENGTH = 1e100  # larger lengths (over L) are clipped, because their squares would overflow
# Relative error of the force's magnitude up to which steps are short enough; base force and contact
# point are then accurate to some 1e-5 (relative to the force and to L).
_KEPT = 1e-6
_SETTLED = 1e-4  # largest change by shorter steps, relative to the force and to L
# Contact points in mm given as m are this many lengths away, or up to 20 times as many.
_SUSPICIOUS_DISTANCE = 100.0


def deflect(
    whisker: Whisker,
    load: Load,
    *,
    gravity: ArrayLike | None = None,
    proximal: float = PROXIMAL,
    steps: int = STEPS,
    device: str = "cpu",
) -> Deflection:
    """Bend a whisker quasi-statically.

    Parameters
    ----------
    whisker : Whisker
        Whisker to be bent.
    load : PointForce, PointContact or PegContact
        Load that bends it; arrays of any leading shape.
    gravity : (..., 3) array_like, optional
        Gravitational acceleration minus that of the base, whisker frame, m/s²: one for all loads,
        or one each. The load then bends the whisker from its sagged shape at rest; the whisker must
        have a density. By default the weight is neglected.
    proximal : float
        Smallest arc length of a contact, over L; more proximal contacts get a status instead of a
        solution (except a ``PointForce``).
    steps : int
        Number of integration steps along the whisker. The default has an error of 1e-6 while the
        tangent turns by less than about 65°, and 1e-4 up to slip-off; the error falls with the
        sixth power. A ``PointForce`` that bends the whisker further gets as many more steps as it
        needs for 1e-4.
    device : str
        Device that solves: "cpu", on all cores, or "cuda", an NVIDIA GPU (extra ``gpu``), for a
        ``PointForce`` or a ``PointContact`` without gravity. The results agree to 1e-9.

    Returns
    -------
    Deflection
        Stable equilibrium that is connected to rest, for each contact, or a status that states why
        there is none; the one equilibrium of each ``PointForce``.

    Raises
    ------
    ValueError
        If the load does not fit (see the loads), though not if it has no equilibrium; or if the
        device cannot solve it.
    ImportError, RuntimeError
        If the device is a GPU, and the extra or the GPU is missing.

    Examples
    --------
    >>> import vibrissa as vb
    >>> whisker = vb.Whisker.parabola(length=39.4e-3, coefficient=10.0)
    >>> bent = vb.deflect(whisker, vb.PointContact([25e-3, 12e-3, 1e-3]))
    >>> vb.Status(bent.status).name
    'OK'
    """
    if isinstance(whisker, Load):
        raise ValueError("the whisker comes first, then its load: deflect(whisker, load)")
    if not isinstance(load, Load):
        raise ValueError(
            f"a load is a PointForce, a PointContact or a PegContact; got {type(load).__name__}"
        )
    check_whisker(whisker)
    if isinstance(load, PointContact):
        away = np.abs(np.asarray(load.points, dtype=np.float64)).max(axis=-1)
        check_reach(whisker, "contact points", away)
    elif isinstance(load, PegContact):
        with np.errstate(over="ignore", invalid="ignore"):
            away = np.linalg.norm(np.cross(load.origin, load.axis), axis=-1) - load.radius
        check_reach(whisker, "pegs", away)
    check_device(device)
    if device != "cpu" and (isinstance(load, PegContact) or gravity is not None):
        got = type(load).__name__ + (" with gravity" if gravity is not None else "")
        raise ValueError(
            f"device {device!r} solves a PointForce or a PointContact without gravity; got a {got}"
        )
    if gravity is None:
        solved, needed = _solve(whisker, load, proximal, steps, device)
        return replace(dimensional(whisker, load, solved, steps), _needed=needed)
    directions = _gravities(gravity, load)
    kinds, kind = np.unique(directions, axis=0, return_inverse=True)
    solved = Solutions.empty(len(directions))
    needed = np.full(len(directions), steps)
    moments = np.zeros((len(directions), 3))
    for k, one in enumerate(kinds):
        if np.isnan(one).any():
            continue
        rows = np.flatnonzero(kind.reshape(-1) == k)
        part = load if len(kinds) == 1 else select_loads(load, rows)
        bent = resting(whisker, one)
        found, finer = _solve(bent, part, proximal, steps, device)
        solved.put(rows, found)
        if finer is not None:
            needed[rows] = finer
        moments[rows] = moved_moments(discretize(bent, steps), found.contacts)
    out = dimensional(whisker, load, solved, steps, moments)
    kept = directions.reshape(*load.shape, 3)
    return replace(out, gravity=kept, _needed=needed)


def check_reach(whisker: Whisker, what: str, away: Array) -> None:
    """Raise a ValueError if all distances look like millimetres given as metres."""
    away, far = away[np.isfinite(away)], _SUSPICIOUS_DISTANCE * whisker.length
    if away.size and (away > far).all() and (away < 20.0 * far).all():
        raise ValueError(
            f"all {what} are {away.min() / whisker.length:.0f} lengths of the whisker from "
            "its base, or farther: these look like millimetres given as metres; multiply by 1e-3"
        )


def check_objects(whisker: Whisker, objects: Sequence[Surface], positions: Array) -> None:
    """Raise a ValueError if all objects are so far away that they seem to be given in mm."""
    if objects:
        away = np.min([one.signed_distance(positions) for one in objects], axis=0)
        check_reach(whisker, "objects", away)


def _gravities(gravity: ArrayLike, load: Load) -> Array:
    """Gravity of each load, (n, 3)."""
    values = finite_vectors("gravity", gravity)
    try:
        return np.broadcast_to(values, (*load.shape, 3)).reshape(-1, 3)
    except ValueError as error:
        raise ValueError(
            f"gravity of shape {values.shape} does not broadcast to the loads' {(*load.shape, 3)}"
        ) from error


def _solve(
    bent: Bendable, load: Load, proximal: float, steps: int, device: str
) -> tuple[Solutions, IntArray | None]:
    """Solve loads; for known forces also return the number of steps each needs."""
    d = discretize(bent, steps)
    if isinstance(load, PointForce):
        return _solve_force(bent, d, load, steps, device)
    if isinstance(load, PegContact):
        return _solve_peg(bent, d, load, proximal, steps), None
    with np.errstate(over="ignore"):
        points = np.asarray(load.points).reshape(-1, 3) / d.length
    return point_solver(bent, proximal, steps).solve(points, device), None


def _solve_force(
    whisker: Bendable, d: Discretization, load: PointForce, steps: int, device: str
) -> tuple[Solutions, IntArray]:
    """Solve known forces; also return the number of steps each needs."""
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
    values[rows], needed[rows], settled = _solve_known_forces(
        whisker, contacts[rows], steps, device
    )
    statuses[rows[~settled]] = Status.TOO_STRONG
    lost = statuses != Status.OK
    contacts[lost], values[lost], needed[lost] = np.nan, np.nan, steps
    return Solutions(contacts, values, np.where(lost, np.nan, 0.0), statuses), needed


def _solve_known_forces(
    whisker: Bendable, contacts: Array, steps: int, device: str
) -> tuple[Array, IntArray, AnyArray]:
    """Base force and contact point of known forces, steps needed, and whether these suffice."""
    values = solve_forces(discretize(whisker, steps), contacts, device=device)[0]
    needed = np.full(len(contacts), steps)
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.linalg.norm(contacts[:, 1:], axis=1)
        kept = np.abs(np.linalg.norm(values[:, :3], axis=1) - size) <= _KEPT * size
        scale = np.where(np.arange(6) < 3, size[:, None], 1.0)
        rows = np.flatnonzero(~kept)
        while rows.size and 2 * steps <= MOST_STEPS:
            steps *= 2
            finer = solve_forces(discretize(whisker, steps), contacts[rows], device=device)[0]
            settled = (np.abs(finer - values[rows]) <= _SETTLED * scale[rows]).all(axis=1)
            # Doubling changes nothing while the whole contact is within the first step.
            error = np.abs(np.linalg.norm(finer[:, :3], axis=1) - size[rows])
            settled &= error <= _SETTLED * size[rows]
            rows, finer = rows[~settled], finer[~settled]
            values[rows], needed[rows] = finer, min(2 * steps, MOST_STEPS)
    good = np.ones(len(contacts), dtype=bool)
    good[rows] = False
    return values, needed, good


def _pegs_of(load: PegContact, length: float) -> Pegs:
    """Pegs with lengths over L, within a range whose squares do not overflow."""
    with np.errstate(over="ignore"):
        radius = np.minimum(np.asarray(load.radius).reshape(-1) / length, _LARGEST_LENGTH)
        origin = np.asarray(load.origin).reshape(-1, 3) / length
    return Pegs(
        np.clip(origin, -_LARGEST_LENGTH, _LARGEST_LENGTH),
        np.array(load.axis, dtype=np.float64).reshape(-1, 3),
        np.where(radius == 0.0, -1.0, radius),
    )


def _solve_peg(
    whisker: Bendable, d: Discretization, load: PegContact, proximal: float, steps: int
) -> Solutions:
    """Solve contacts with pegs, from rest or continued from an earlier deflection."""
    pegs = _pegs_of(load, d.length)
    if (start := load.start) is None:
        if load.side is not None:
            side = np.asarray(load.side).reshape(-1, 3)
        else:
            side = nearest_side(Rest.of(whisker), pegs, outward=bool((pegs.radius >= 0.0).any()))
        return solve_from_rest(whisker, pegs, side, proximal, steps)
    if start.whisker is not (whisker.whisker if isinstance(whisker, Resting) else whisker):
        raise ValueError("start is a deflection of another whisker")
    assert isinstance(start.load, PegContact)  # checked when the load was created
    number = np.arange(start.status.size).reshape(start.status.shape)
    each = np.broadcast_to(number, load.shape).reshape(-1)  # earlier deflection of each load
    arc, force = start.arc_length / d.length, start.contact_force / d.force
    contacts = np.column_stack([arc.reshape(-1), force.reshape(-1, 3)])[each]
    status: AnyArray = start.status.reshape(-1)[each]
    before = _pegs_of(start.load, d.length).rows(each)
    touching = np.isin(status, (Status.OK, Status.TIP_CONTACT))
    out = Solutions.empty(status.size)
    rows = np.flatnonzero(touching)
    if rows.size:
        tip = status[rows] == Status.TIP_CONTACT
        moved = solve_from_contact(
            whisker, before.rows(rows), contacts[rows], tip, pegs.rows(rows), proximal, steps
        )
        out.put(rows, moved)
    # A whisker without contact stays on the side of the earlier peg on which it rested.
    rows = np.flatnonzero(~touching)
    if rows.size:
        side = nearest_side(Rest.of(whisker), before.rows(rows), outward=True)
        out.put(rows, solve_from_rest(whisker, pegs.rows(rows), side, proximal, steps))
    return out


def dimensional(
    whisker: Whisker, load: Load, solved: Solutions, steps: int, moments: Array | float = 0.0
) -> Deflection:
    """Convert solved rows to SI units and the load's shape; ``moments`` are added to p × F."""
    shape, d = load.shape, discretize(whisker, steps)
    force = solved.values[:, :3] * d.force
    point = solved.values[:, 3:] * d.length
    moment = np.cross(point, force) + moments * d.moment
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
