"""Morphology of an average rat's whiskers from published equations, by row and column.

Rows are counted from 1 (A) to 5 (E) and columns from 0 (Greek) to 6. All results are in SI units.

**The head's frame** is that of Towal et al. (2011): origin at the tip of the snout, x to the
animal's right, y forward along the midline, z up; the rows of whiskers lie parallel to the x–y
plane on average. The equations are those of the right side; the left one is its mirror image in the
y–z plane.

**Towal et al. (2011)**, *The morphology of the rat vibrissal array*, PLoS Comput Biol 7:e1001120,
354 whiskers of six rats, counts the Greek column as 1 and column 1 as 2, … 6 as 7. It gives length,
shape (a planar parabola y = A x²), base points on an ellipsoid, and four angles of emergence from
the face. Three of these are angles of projections, which are converted to a rotation as follows:

- θ, in the horizontal plane, from backward (0°) over sideways (90°) to forward (180°): the azimuth
  is θ − 90° (0 is sideways, forward is positive).
- φ, in the frontal plane, from sideways (0°) to upward (90°): with the azimuth,
  tan elevation = tan φ cos azimuth.
- ψ, in the sagittal plane, from backward (0°) over upward (90°) to forward (180°). It is redundant,
  because the three projections of a direction are related by an equation. It would be needed only
  for a whisker within 45° of the midline, and there is none at rest; it is given but not used.
- ζ, the roll about the tangent at the base: at 0° the whisker is concave downward, at 90° forward:
  the roll is ζ − 90°.

The measured points lie within 0.3 mm of a plane over the proximal 65 % of a whisker. Distally the
equations were not tested, and real whiskers leave the plane.

**Belli et al. (2017)**, *Variations in vibrissal geometry across the rat mystacial pad*,
J Neurophysiol 117:1807, 519 whiskers of seven studies, counts the Greek column as 0. It gives base
diameters and radius slopes. The two are independent fits; combined, they give tips of zero or
negative radius for most whiskers of the middle columns (see `tip_radius`).

**Quist & Hartmann (2012)**, J Neurophysiol 107:2298: an upper bound of A by length.

**Names**: a whisker is identified by side, row and column. The rows of large whiskers on a rat's
cheek are A (the uppermost) to E, the columns 1 to 6 from the back to the front. The four hindmost
whiskers are between the rows and have Greek letters; each is assigned to the row above it (α,
between A and B, to A). They are column 0 here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import transform
from vibrissa.numerics import Array

# Columns (0: Greek) of each row whose whiskers were measured: the range of validity.
MEASURED = {"A": range(5), "B": range(6), "C": range(7), "D": range(7), "E": range(1, 7)}
# Largest ratio of base to tip radius: the largest of the means in the literature (28 to 36).
MOST_TAPER = 36.0
_TOWAL_GREEK = 1  # column number of the Greek whiskers in Towal et al.
# Ellipsoid of the right cheek: m, and angles about z, y, x, rad, the last rotation applied first.
_CENTER = 1e-3 * np.array([1.9128, -7.6549, -5.4439])
_RADII = 1e-3 * np.array([9.5304, 5.5393, 6.9745])
_TURNED = np.radians([106.51, -2.5211, -19.5401])


def arc_length(row: ArrayLike, column: ArrayLike) -> Array:
    """Length of whiskers: S = −7.9312 column + 2.2224 row + 52.1110 mm (Towal et al. 2011)."""
    row, column = _towal_numbers(row, column)
    return np.asarray(1e-3 * (-7.9312 * column + 2.2224 * row + 52.1110))


def curvature_coefficient(column: ArrayLike) -> Array:
    """Coefficient A of the shape y = A x² (Towal et al. 2011).

    A = exp(1 / (−0.02052 column − 0.2045)) per mm. The table printed in the paper has a misprint;
    this form gives the value of its text, 0.0233 per mm for C2.
    """
    _, column = _towal_numbers(1, column)
    return np.asarray(1e3 * np.exp(1.0 / (-0.02052 * column - 0.2045)))


def curvature_bound(length: ArrayLike) -> Array:
    """Largest A of a length: 0.156 exp(−S / 15.6 mm) + 0.015 per mm (Quist & Hartmann 2012)."""
    s = 1e3 * np.asarray(length, dtype=np.float64)
    return np.asarray(1e3 * (0.156 * np.exp(-s / 15.6) + 0.015))


def base_point(row: ArrayLike, column: ArrayLike) -> Array:
    """Points at which whiskers of the right side leave the cheek (Towal et al. 2011).

    They are on the ellipsoid of the cheek. In its own axes the direction from its centre has the
    azimuth 15.2953 column − 144.2220 and the angle 18.2237 row + 34.7558 from the third axis, °.
    """
    row, column = _towal_numbers(row, column)
    azimuth = np.radians(15.2953 * column - 144.2220)
    polar = np.radians(18.2237 * row + 34.7558)
    direction = np.stack(
        [np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=-1
    )
    size = 1.0 / np.linalg.norm(direction / _RADII, axis=-1, keepdims=True)
    to_head = transform.Rotation.from_euler("ZYX", _TURNED).as_matrix()
    return np.asarray(_CENTER + size * direction @ to_head.T)


def projection_angles(row: ArrayLike, column: ArrayLike) -> Array:
    """Projected angles θ, φ, ψ, ζ of whiskers as given by Towal et al. (2011), rad."""
    row, column = _towal_numbers(row, column)
    degrees = [
        10.6475 * column + 37.3178,
        1.0988 * column - 18.0334 * row + 50.6005,
        18.5149 * column + 49.3499 * row - 50.5406,
        18.7700 * column - 11.3485 * row - 4.9844,
    ]
    return np.asarray(np.radians(np.stack(np.broadcast_arrays(*degrees), axis=-1)))


def emergence_angles(row: ArrayLike, column: ArrayLike) -> Array:
    """Azimuth, elevation and roll at which right-side whiskers emerge (Towal et al. 2011)."""
    theta, phi, _, zeta = np.moveaxis(projection_angles(row, column), -1, 0)
    azimuth = theta - np.pi / 2.0
    elevation = np.arctan(np.tan(phi) * np.cos(azimuth))
    return np.stack([azimuth, elevation, zeta - np.pi / 2.0], axis=-1)


def base_radius(row: ArrayLike, column: ArrayLike, length: ArrayLike) -> Array:
    """Radius of whiskers at the base (Belli et al. 2017).

    Its diameter is 0.041 + 0.002 S + 0.011 row − 0.0039 column, mm, with the length S in mm.
    """
    row, column, length = (np.asarray(one, dtype=np.float64) for one in (row, column, length))
    s = 1e3 * length
    return np.asarray(0.5e-3 * (0.041 + 0.002 * s + 0.011 * row - 0.0039 * column))


def radius_slope(row: ArrayLike, column: ArrayLike) -> Array:
    """Decrease of the radius per length, from base to tip (Belli et al. 2017).

    0.0012 + 0.00017 row − 0.000066 column + 0.00011 column².
    """
    row, column = np.asarray(row, np.float64), np.asarray(column, np.float64)
    return np.asarray(0.0012 + 0.00017 * row - 0.000066 * column + 0.00011 * column**2)


def tip_radius(row: ArrayLike, column: ArrayLike, length: ArrayLike) -> Array:
    """Radius of whiskers at the tip, from base radius and slope as far as these are compatible.

    It is at least the base radius over `MOST_TAPER`; the slope alone often leads to less than that,
    or to negative values.
    """
    base = base_radius(row, column, length)
    by_slope = base - radius_slope(row, column) * np.asarray(length)
    return np.asarray(np.maximum(by_slope, base / MOST_TAPER))


def _towal_numbers(row: ArrayLike, column: ArrayLike) -> tuple[Array, Array]:
    """Row and column as Towal et al. count them."""
    return np.asarray(row, np.float64), np.asarray(column, np.float64) + _TOWAL_GREEK


ANY = "any"  # name of a whisker of unknown row and column
_SIMILAR_LENGTH = 5e-3  # scale of the weights by length, m: about half a column
# Largest difference of a whisker's length from the published one, m: 9 mm among 27 of one rat.
_OTHER_LENGTH = 10e-3


def published_radii(name: str, length: float) -> tuple[float, float]:
    """Base and tip radius, m, of a rat's whisker by its name and length, m (Belli et al. 2017).

    For `ANY`, the mean over the measured whiskers, weighted by the similarity of their published
    lengths (Towal et al. 2011).
    """
    if name != ANY:
        identity = Identity.of(name)
        which = np.array([[identity.row_number, identity.column]])
        weight = np.ones(1)
    else:
        which = np.array(
            [(1 + i, column) for i, row in enumerate(ROWS) for column in MEASURED[row]]
        )
        away = (length - arc_length(*which.T)) / _SIMILAR_LENGTH
        weight = np.exp(-0.5 * (away**2 - (away**2).min()))
    row, column = which.T
    base = np.average(base_radius(row, column, length), weights=weight)
    tip = np.average(tip_radius(row, column, length), weights=weight)
    return float(base), float(tip)


def published_note(name: str, length: float) -> str:
    """State the source of published radii, and whether the regressions are extrapolated."""
    beyond = ""
    if name == ANY:
        which = "its length, of a rat's whisker of unknown row and column"
        known = [arc_length(1 + i, c) for i, row in enumerate(ROWS) for c in MEASURED[row]]
        shortest, longest = float(min(known)), float(max(known))
    else:
        identity = Identity.of(name)
        which = f"its length, of a rat's whisker {identity.name}"
        shortest = longest = float(arc_length(identity.row_number, identity.column))
        beyond = beyond_columns(identity)
    if not beyond and not shortest - _OTHER_LENGTH <= length <= longest + _OTHER_LENGTH:
        usual = f"{shortest * 1e3:.2g} to " if name == ANY else ""
        beyond = (
            f"{length * 1e3:.3g} mm is far from the {usual}{longest * 1e3:.2g} mm that such "
            "whiskers are long (Towal et al. 2011)"
        )
    beyond = f"; extrapolated: {beyond}" if beyond else ""
    return f"radius by published regressions (Belli et al. 2017) from {which}; not measured{beyond}"


def beyond_columns(identity: Identity) -> str:
    """State the columns for which the equations were measured if a whisker's is another."""
    known = MEASURED[identity.row]
    if identity.column in known:
        return ""
    return (
        f"outside the range of the equations, which in row {identity.row} were measured for "
        f"columns {known[0]} to {known[-1]}"
    )


Side = Literal["left", "right"]

ROWS = "ABCDE"  # rows, from the top down
GREEK = ("α", "β", "γ", "δ")  # whiskers of column 0, in rows A to D
_SPELLED = ("alpha", "beta", "gamma", "delta")
_SIDES: dict[str, Side] = {"l": "left", "left": "left", "r": "right", "right": "right"}
_PATTERN = re.compile(
    r"(?:(?P<before>left|right|l|r)[\s_-]*)?"
    r"(?:(?P<row>[a-e])[\s_-]*0*(?P<column>\d)|(?P<greek>" + "|".join((*GREEK, *_SPELLED)) + "))"
    r"(?:[\s_-]*(?P<after>left|right|l|r))?"
)


@dataclass(frozen=True)
class Identity:
    """Name of a whisker, in parts.

    Parameters
    ----------
    row : {"A", "B", "C", "D", "E"}
        Row, from the top down.
    column : int
        0 for the Greek whiskers, then 1 to 6 (in some animals 9) from the back to the front.
    side : {"left", "right"} or None
        Side of the animal; None if not stated.
    """

    row: str
    column: int
    side: Side | None = None

    def __post_init__(self) -> None:
        faults = []
        if self.row not in tuple(ROWS):
            faults.append(f"row is {self.row!r}; one of {', '.join(ROWS)} is needed")
        if self.column not in range(10):
            faults.append(f"column is {self.column!r}; a whole number from 0 (Greek) is needed")
        if self.side not in (None, "left", "right"):
            faults.append(f"side is {self.side!r}; left or right is needed")
        if faults:
            raise ValueError("no whisker's name: " + "; ".join(faults))

    @classmethod
    def of(cls, name: str) -> Identity:
        """Parse a whisker's name.

        Parameters
        ----------
        name : str
            Row and column such as ``C2``, a Greek letter or its name (``γ``, ``gamma``, also
            ``C0``), with or without a side before or after it: ``LC2``, ``left C2``,
            ``C2_right``. Case is ignored.

        Returns
        -------
        Identity

        Examples
        --------
        >>> Identity.of("left gamma")
        Identity(row='C', column=0, side='left')
        """
        found = _PATTERN.fullmatch(name.strip().lower())
        if found is None or (found["before"] and found["after"]):
            raise ValueError(
                f"{name!r} is not a whisker's name; row and column such as C2, or alpha, beta, "
                "gamma, delta (α, β, γ, δ), after L or R (left, right) where both sides count, are "
                "needed"
            )
        side = found["before"] or found["after"]
        side = _SIDES[side] if side else None
        if greek := found["greek"]:
            letters = _SPELLED if greek in _SPELLED else GREEK
            return cls(ROWS[letters.index(greek)], 0, side)
        return cls(found["row"].upper(), int(found["column"]), side)

    def on(self, side: Side | None) -> Identity:
        """Return the whisker of the same row and column on another side.

        Parameters
        ----------
        side : {"left", "right"} or None
            Side of the face.

        Returns
        -------
        Identity
        """
        return Identity(self.row, self.column, side)

    @property
    def row_number(self) -> int:
        """Row number: 1 for row A to 5 for row E."""
        return ROWS.index(self.row) + 1

    @property
    def name(self) -> str:
        """Standard name: ``C2``, ``γ``, ``LC2``, ``Rγ``."""
        bare = f"{self.row}{self.column}"
        if self.column == 0 and self.row in ROWS[: len(GREEK)]:
            bare = GREEK[self.row_number - 1]
        return (cast(str, self.side)[0].upper() if self.side else "") + bare

    @property
    def sort_key(self) -> tuple[str, str, int]:
        """Key that sorts left before right, then by row, then from the back to the front."""
        return (self.side or "", self.row, self.column)
