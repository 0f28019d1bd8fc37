"""An average rat's whiskers, by the published equations of `vibrissa.whisker.morphology`."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal, Unpack

from vibrissa.whisker import morphology
from vibrissa.whisker.array import WhiskerArray, sides
from vibrissa.whisker.identity import ROWS, Identity
from vibrissa.whisker.model import Whisker
from vibrissa.whisker.morphology import published_radii
from vibrissa.whisker.pose import Pose, base_rotation, mirrored
from vibrissa.whisker.section import Properties


def whisker_array(
    side: Literal["both", "left", "right"] = "both",
    rows: Iterable[str] = ROWS,
    columns: Iterable[int] = range(7),
    *,
    names: Iterable[str] | None = None,
    **properties: Unpack[Properties],
) -> WhiskerArray:
    """Make an average rat's whiskers by the published equations.

    Parameters
    ----------
    side : {"both", "left", "right"}
        Of the animal.
    rows : iterable of {"A", "B", "C", "D", "E"}
        Rows to make, from the top down.
    columns : iterable of int
        Columns to make, from the back to the front; 0 is the Greek one. Of these rows and columns
        those whiskers are made that were measured: A0 to A4, B0 to B5, C0 to C6, D0 to D6 and E1
        to E6, 31 on each side.
    names : iterable of str, optional
        Whiskers to make instead of rows and columns, such as ``["C2", "left gamma"]``; on the
        given side(s) unless they tell one. With a warning also those that were never measured.
    **properties
        Radius and material instead of the published ones and the defaults; see `Whisker`.

    Returns
    -------
    WhiskerArray
        Their poses lead to the head's frame: origin at the tip of the snout, x to the animal's
        right, y forward, z up.

    Raises
    ------
    ValueError
        If there is no such side, row, column or whisker, or none is left.

    Warns
    -----
    UserWarning
        Where a whisker lies outside the range in which the equations were measured, or is more
        curved than any.

    References
    ----------
    Towal et al. (2011) and Belli et al. (2017): see `vibrissa.whisker.morphology`.

    Examples
    --------
    >>> len(whisker_array()), list(whisker_array("left", rows="C", columns=[0, 1]))
    (62, ['LC1', 'Lγ'])
    """
    if names is not None:
        identities = [Identity.of(name) for name in names]
        wanted = [
            one.on(s) for one in identities for s in ((one.side,) if one.side else sides(side))
        ]
    else:
        wanted = [
            Identity(row.upper(), int(column), s)
            for s in sides(side)
            for row in rows
            for column in columns
        ]
        wanted = [one for one in wanted if one.column in morphology.MEASURED[one.row]]
    return WhiskerArray([average_whisker(one, **properties) for one in wanted])


def average_whisker(identity: Identity, **properties: Unpack[Properties]) -> Whisker:
    """Make one whisker of an average rat; see `whisker_array`."""
    if identity.side is None:
        raise ValueError(f"{identity.name} does not state a side; left or right is needed")
    row, column = identity.row_number, identity.column
    length = float(morphology.arc_length(row, column))
    coefficient = float(morphology.curvature_coefficient(column))
    if column > 6 or length <= 0.0:
        raise ValueError(f"{identity.name}: the equations reach to column 6, not {column}")
    notes = _range_notes(identity, length, coefficient)
    for note in notes:
        warnings.warn(f"{identity.name}: {note}", UserWarning, stacklevel=3)
    radii = dict(
        zip(("base_radius", "tip_radius"), published_radii(identity.name, length), strict=True)
    )
    own = {"base_radius", "tip_radius", "radius", "rat"} & set(properties)
    if not own and radii["tip_radius"] == radii["base_radius"] / morphology.MOST_TAPER:
        notes.append(
            "the published radius slope leaves it no tip (or too thin a one); its base radius over "
            f"{morphology.MOST_TAPER:g} is taken instead"
        )
    stated: Any = ({} if own else radii) | dict(properties) | {"name": identity.name}
    whisker = Whisker.parabola(length, coefficient, **stated)
    angles = morphology.emergence_angles(row, column)
    place = morphology.base_point(row, column)
    if identity.side == "left":
        angles, place = mirrored(angles), place * [-1.0, 1.0, 1.0]
    pose = Pose(base_rotation(*angles), place)
    return replace(whisker, pose=pose, notes=(*whisker.notes, *notes))


def _range_notes(identity: Identity, length: float, coefficient: float) -> list[str]:
    """Say what lies outside the range of the equations."""
    notes = []
    if identity.column not in morphology.MEASURED[identity.row]:
        known = morphology.MEASURED[identity.row]
        notes.append(
            f"outside the range of the equations, which in row {identity.row} were measured for "
            f"columns {known[0]} to {known[-1]}"
        )
    bound = float(morphology.curvature_bound(length))
    if coefficient > bound:
        notes.append(
            f"its coefficient {coefficient * 1e-3:.4f} per mm is larger than the "
            f"{bound * 1e-3:.4f} per mm of the most curved whiskers of its length"
        )
    return notes
