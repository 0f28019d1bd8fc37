"""The whisker that the sliders ask for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vibrissa.whisker import Whisker, constant


@dataclass(frozen=True)
class Shape:
    """What the sliders say."""

    length: float
    turn: float
    taper: float
    modulus: float


def whole_turn(whisker: Whisker) -> float:
    """By how much a whisker turns from base to tip, ∫|κ| ds, rad."""
    s = (np.arange(400) + 0.5) / 400.0 * whisker.length
    bending = np.linalg.norm(whisker.curvature(s)[:, 1:], axis=1)
    return float(bending.mean() * whisker.length)


def shape_of(whisker: Whisker) -> Shape:
    """What the sliders say for a whisker as it is."""
    taper = whisker.base_radius / whisker.tip_radius
    return Shape(whisker.length, whole_turn(whisker), taper, whisker.youngs_modulus)


def shaped(whisker: Whisker, asked: Shape) -> Whisker:
    """Change a whisker to a shape that is asked for.

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
