"""`vibrissa deflect`: bend a whisker once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vibrissa.cli.terminal import fixed, numbers, output, refuse

if TYPE_CHECKING:
    from vibrissa.rod import Deflection
    from vibrissa.rod.loads import Load

_MM = 1e-3
_MICRO = 1e-6


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
) -> None:
    """Bend a whisker by a point, a force or a peg, and print what its base feels.

    All in the whisker's frame. Give one of --point, --force, --peg. Example:
    `vibrissa deflect --point 25,12,1`
    """
    from vibrissa.cli.sources import whisker_from
    from vibrissa.rod import deflect

    load = _load(point, force, peg, axis, side)
    chosen = whisker_from(whisker)
    _print(repr(chosen), deflect(chosen, load))


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


def _print(whisker: str, bent: Deflection) -> None:
    from rich.table import Table

    from vibrissa.mapping.contact_map import spherical
    from vibrissa.quantities import quantity
    from vibrissa.signals import SIGNALS, base_signals
    from vibrissa.status import Status

    output.print(whisker, highlight=False, soft_wrap=True)
    output.print(str(Status(int(bent.status))), highlight=False, soft_wrap=True)
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
