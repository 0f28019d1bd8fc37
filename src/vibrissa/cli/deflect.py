"""`vibrissa deflect`: equilibrium of a whisker under one load."""

from __future__ import annotations

import math
from typing import Literal

import typer

import vibrissa as vb
from vibrissa.cli.inputs import WhiskerOptions, print_notes, smallest_arc
from vibrissa.cli.options import numbers, refuse, with_options
from vibrissa.cli.terminal import fixed, print_table, remark, say

_MM = 1e-3
_MICRO = 1e-6
# Distance, relative to the whisker's length, below which a position may be in m instead of mm.
_NEXT_TO_BASE = 0.02
_XYZ = ("X", "Y", "Z")


@with_options()
def deflect(
    own: WhiskerOptions,
    point: str | None = None,
    point_force: str | None = None,
    peg: str | None = None,
    axis: str | None = None,
    push: str | None = None,
    gravity: str | None = None,
    density: float | None = None,
    proximal: float | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
) -> None:
    """Bend a whisker by a point, a force or a peg, and print force and moment at its base.

    All coordinates are in the whisker frame. Give one of --point, --point-force and --peg (vertical
    without --axis). With --gravity the whisker sags under its weight, and force and moment are
    those of a sensor that was tared at rest. If there is no equilibrium, the status states why, and
    the exit status is 1.
    Example: `vibrissa deflect --point 25,12,1`
    """
    load = _load(point, point_force, peg, axis, push)
    if point_force is not None:
        refuse({"--proximal": proximal}, "a --point-force acts at the stated position")
    if gravity is None:
        refuse({"--density": density}, "without --gravity the whisker has no weight")
    whisker = own.read()
    if density is not None:
        whisker = whisker.with_properties(density=density)
    pull = None if gravity is None else numbers(gravity, _XYZ, "--gravity")
    bent = vb.deflect(whisker, load, gravity=pull, proximal=smallest_arc(proximal), device=device)
    status = vb.Status(int(bent.status))
    # Advice with the name of the command-line option.
    option = " The option is --proximal." if status == vb.Status.TOO_PROXIMAL else ""
    say(f"{status}{option}")
    say(repr(whisker))
    print_notes(whisker)
    _doubt_the_unit(load, whisker)
    if not (status.ok and math.isfinite(bent.arc_length)):
        raise typer.Exit(1)
    _print(bent)


def _doubt_the_unit(load: vb.rod.Load, whisker: vb.Whisker) -> None:
    """Warn if a position seems to be in metres instead of mm."""
    import numpy as np

    if isinstance(load, vb.PointForce):
        away = float(load.arc_length)
    else:
        position = load.points if isinstance(load, vb.PointContact) else load.origin
        away = float(np.linalg.norm(position))
    if 0.0 < away < _NEXT_TO_BASE * whisker.length:
        remark(
            f"lengths are typed in mm: the load is {away / _MM:.4g} mm from the base of a whisker "
            f"of {whisker.length / _MM:.4g} mm. Were metres meant? {away / _MM:.4g} m is "
            f"{away / _MM / _MM:.4g} mm"
        )


def _load(
    point: str | None, force: str | None, peg: str | None, axis: str | None, push: str | None
) -> vb.rod.Load:
    """Construct the load from the options."""
    kinds = {"--point": point, "--point-force": force, "--peg": peg}
    given = [name for name, value in kinds.items() if value]
    if len(given) != 1:
        got = " and ".join(given) or "none of them"
        raise ValueError(f"one of --point, --point-force and --peg is needed; got {got}")
    if peg is None:
        refuse({"--axis": axis, "--push": push}, "they need a --peg")
    if point is not None:
        return vb.PointContact([x * _MM for x in numbers(point, _XYZ, "--point")])
    if force is not None:
        s, size, angle = numbers(force, ("S", "F", "ANGLE"), "--point-force")
        return vb.PointForce(s * _MM, size * _MICRO, math.radians(angle % 360.0))
    *origin, diameter = numbers(peg or "", (*_XYZ, "D"), "--peg")
    direction = numbers(axis or "0,0,1", _XYZ, "--axis")
    side = None if push is None else numbers(push, _XYZ, "--push")
    return vb.PegContact([x * _MM for x in origin], direction, 0.5 * diameter * _MM, side=side)


def _print(bent: vb.Deflection) -> None:
    signals = vb.signals.signals_of(bent.force, bent.moment)
    point, components = bent.contact_point, ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
    groups = {
        "contact": [
            *zip("xyz", point, strict=True),
            *zip(("r", "theta", "phi"), vb.signals.spherical(point), strict=True),
            ("arc_length", bent.arc_length),
        ],
        "signal": list(zip(vb.signals.SIGNALS, signals, strict=True)),
        "wrench": list(zip(components, (*bent.force, *bent.moment), strict=True)),
    }
    rows: list[tuple[str, ...] | None] = []
    for kind, values in groups.items():
        rows += [
            (kind, name, vb.quantities.quantity(name).long_name, fixed(name, float(value)))
            for name, value in values
        ]
        rows.append(None)
    print_table([""] * 4, rows[:-1], left=range(4))
