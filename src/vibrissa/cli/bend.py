"""`vibrissa deflect`: bend a whisker once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import fixed, numbers, output, refuse

if TYPE_CHECKING:
    from vibrissa.rod import Deflection, Load
    from vibrissa.status import Status
    from vibrissa.whisker import Whisker

_MM = 1e-3
_MICRO = 1e-6
# Share of the length below which a place looks like metres typed for mm.
_NEXT_TO_BASE = 0.02


def bend(
    whisker: Annotated[
        Path | None,
        typer.Option(help="Centreline as CSV; by default a built-in γ whisker.", metavar="FILE"),
    ] = None,
    point: Annotated[str | None, typer.Option(help="Contact point, mm.", metavar="X,Y,Z")] = None,
    force: Annotated[
        str | None,
        typer.Option(
            help="Arc length of a force, mm, its size, µN, and its angle from d1 to d2, degrees.",
            metavar="S,F,ANGLE",
        ),
    ] = None,
    peg: Annotated[
        str | None,
        typer.Option(
            help="A point of a peg's axis and its diameter, mm; 0 for a line.", metavar="X,Y,Z,D"
        ),
    ] = None,
    axis: Annotated[
        str | None,
        typer.Option(help="Direction of the peg's axis; 0,0,1 by default.", metavar="X,Y,Z"),
    ] = None,
    side: Annotated[
        str | None,
        typer.Option(
            help="About where the peg pushes; by default the nearest side.", metavar="X,Y,Z"
        ),
    ] = None,
    proximal: Annotated[
        float | None,
        typer.Option(
            help="Share of the length nearer to the base than which no contact is considered; "
            "0.3 by default.",
            min=0.0,
            max=1.0,
            metavar="SHARE",
        ),
    ] = None,
) -> None:
    """Bend a whisker by a point, a force or a peg, and print what its base feels.

    All in the whisker's frame. Give one of --point, --force, --peg. Without an answer the status
    says why, and the exit status is 1. Example: `vibrissa deflect --point 25,12,1`
    """
    from vibrissa.cli.sources import tell_notes, whisker_from
    from vibrissa.rod import PROXIMAL, deflect
    from vibrissa.status import Status

    load = _load(point, force, peg, axis, side)
    if force is not None:
        refuse({"--proximal": proximal}, "a --force acts where it is stated")
    chosen = whisker_from(whisker)
    output.print(repr(chosen), highlight=False, soft_wrap=True)
    tell_notes(chosen)
    bent = deflect(chosen, load, proximal=PROXIMAL if proximal is None else proximal)
    status = Status(int(bent.status))
    output.print(_told(status), highlight=False, soft_wrap=True)
    _doubt_the_unit(load, chosen)
    if not status.ok:
        raise typer.Exit(1)
    _print(bent)


def _told(status: Status) -> str:
    """A status with its advice, by the name that the advised option has here."""
    from vibrissa.status import Status

    option = " The option is --proximal." if status == Status.TOO_PROXIMAL else ""
    return f"{status}{option}"


def _doubt_the_unit(load: Load, whisker: Whisker) -> None:
    """Say so where a place would be on the whisker if it had been typed in metres."""
    import numpy as np

    from vibrissa.cli.terminal import errors
    from vibrissa.rod import PointContact, PointForce

    if isinstance(load, PointForce):
        place = float(load.arc_length)
    elif isinstance(load, PointContact):
        place = float(np.linalg.norm(load.points))
    else:
        place = float(np.linalg.norm(load.origin))
    if 0.0 < place < _NEXT_TO_BASE * whisker.length:
        errors.print(
            f"lengths are typed in mm: the load is {place / _MM:.4g} mm from the base of a whisker "
            f"of {whisker.length / _MM:.4g} mm. Were metres meant? {place / _MM:.4g} m is "
            f"{place / _MM / _MM:.4g} mm",
            highlight=False,
            soft_wrap=True,
        )


def _load(
    point: str | None, force: str | None, peg: str | None, axis: str | None, side: str | None
) -> Load:
    """Make the one load that was asked for."""
    from vibrissa.rod import PegContact, PointContact, PointForce

    given = [name for name, value in _named(point=point, force=force, peg=peg) if value]
    if len(given) != 1:
        got = " and ".join(f"--{name}" for name in given) or "none of them"
        raise ValueError(f"one of --point, --force and --peg is needed; got {got}")
    if peg is None:
        refuse({"--axis": axis, "--side": side}, "they are of a --peg")
    if point is not None:
        place = numbers(point, ("X", "Y", "Z"), "--point")
        return PointContact([x * _MM for x in place])
    if force is not None:
        s, size, angle = numbers(force, ("S", "F", "ANGLE"), "--force")
        return PointForce(s * _MM, size * _MICRO, math.radians(angle))
    assert peg is not None
    *origin, diameter = numbers(peg, ("X", "Y", "Z", "D"), "--peg")
    direction = numbers(axis or "0,0,1", ("X", "Y", "Z"), "--axis")
    push = None if side is None else numbers(side, ("X", "Y", "Z"), "--side")
    return PegContact([x * _MM for x in origin], direction, 0.5 * diameter * _MM, side=push)


def _named(**values: str | None) -> list[tuple[str, str | None]]:
    return list(values.items())


def _print(bent: Deflection) -> None:
    from rich.table import Table

    from vibrissa.contacts.contact_map import spherical
    from vibrissa.quantities import quantity
    from vibrissa.signals import SIGNALS, base_signals

    table = Table(show_header=False)
    rows = list(zip("xyz", bent.contact_point, strict=True))
    rows += zip(("r", "theta", "phi"), spherical(bent.contact_point), strict=True)
    rows.append(("arc_length", bent.arc_length))
    for name, value in rows:
        table.add_row("contact", name, quantity(name).long_name, fixed(name, float(value)))
    table.add_section()
    signals = base_signals(bent.force, bent.moment)
    for name in SIGNALS:
        value = float(signals[name])
        table.add_row("signal", name, quantity(name).long_name, fixed(name, value))
    table.add_section()
    components = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    for name, value in zip(components, (*bent.force, *bent.moment), strict=True):
        table.add_row("wrench", name, quantity(name).long_name, fixed(name, float(value)))
    output.print(table)
