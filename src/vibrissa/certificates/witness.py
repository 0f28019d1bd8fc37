"""Proofs that two contacts have the same signals: validated witnesses.

The first contact ξ₁ = (s, φ, ℓ) is given, with the force f = (1/s - α)² ℓ. It is proved that a box
X around the second contains exactly one contact with the same three signals, by Krawczyk's test:
for equations G(ξ₂) = 0, the middle x of X, its half widths ρ and any matrix Y,

    |Y G(x)| + |1 - Y G'(X)| ρ < ρ    in each component.

G compares F_x and M_x by their differences, magnitudes by their squares, and directions by the
product of one with the other rotated by 90°, and the sign of their scalar product. Enclosures are
those of the certificates, so that the proof applies to the continuous rod. Both contacts are stable
if det ∂p/∂ξ is positive at every smaller force of the same s and φ.

In the plane of a whisker M_x is zero and directions are parallel or antiparallel: equations that
hold by symmetry are omitted, and as many unknowns (φ first, which remains 0 or π). A straight
whisker's contacts are rotated into one plane; if the triplet contains no direction, any rotated
contact is a witness.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vibrissa.certificates.certificate import enclose_conditions
from vibrissa.certificates.conditions import DEGREES, Conditions, spatial_point_conditions
from vibrissa.certificates.domain import Bounds, is_planar
from vibrissa.certificates.equations import ExactRod, exact_rod
from vibrissa.certificates.search import bounds, cover
from vibrissa.contacts import need_map
from vibrissa.numerics import Array, IntArray

if TYPE_CHECKING:
    from vibrissa.contacts import ContactMap

# Ratio of Taylor coefficients to states; a witness needs narrow enclosures.
_TOLERANCE = 1e-12
# Newton steps that bring the second contact to the signals of the first; number of boxes tried.
_STEPS, _TRIALS = 6, 8
_FLAT = 1e-6  # largest deviation of φ/π from a whole number for a contact in the plane
_LOST = 1e-14  # rounding error of a sum of a few products of centres and radii, over its size
# Largest number of boxes into which the path from rest may be divided.
_MOST_BOXES = 4096
_PAIRS = {"FT": (1, 2), "FD": (1, 2), "MB": (4, 5), "MD": (4, 5)}
_SINGLE = {"Fx": 0, "Mx": 3}


class Witness(NamedTuple):
    """What is proved about two contacts.

    Attributes
    ----------
    proved : bool
        Whether two distinct, stable contacts are proved to have the same signals.
    reach : float
        Largest distance in arc length of the second contact from its stated position, over L.
    separation : float
        Lower bound of the distance of the two contact points, over L.
    doubt : str
        Statement that could not be proved; empty if all were.
    """

    proved: bool
    reach: float
    separation: float
    doubt: str


class _Range(NamedTuple):
    """Intervals as centres and radii."""

    centre: Array
    radius: Array

    def __add__(self, other: _Range) -> _Range:  # type: ignore[override]
        total = self.centre + other.centre
        radius = self.radius + other.radius + _LOST * np.abs(total)
        return _Range(total, radius * (1.0 + _LOST))

    def __neg__(self) -> _Range:
        return _Range(-self.centre, self.radius)

    def __mul__(self, other: _Range) -> _Range:  # type: ignore[override]
        a, b = np.abs(self.centre), np.abs(other.centre)
        radius = a * other.radius + b * self.radius + self.radius * other.radius
        return _Range(self.centre * other.centre, (radius + _LOST * a * b) * (1.0 + _LOST))

    def at(self, i: int) -> _Range:
        """Component of a vector, or row of a matrix."""
        return _Range(self.centre[i], self.radius[i])


def prove_witness(
    contact_map: ContactMap,
    triplet: str | Sequence[str],
    arc_length: Sequence[float],
    force: Sequence[Sequence[float]],
) -> Witness:
    """Prove that two contacts near given ones have the same three signals.

    Parameters
    ----------
    contact_map : ContactMap
        Map of the whisker; its base must be rigid.
    triplet : str or sequence of str
        Names of the three signals, such as ``"Fx MB MD"``.
    arc_length : (2,) sequence of float
        Arc lengths of the two contacts, m.
    force : (2, 2) sequence of float
        Forces across the whisker along d1 and d2, N. The proved pair consists of the first contact,
        up to rounding, and one near the second.

    Returns
    -------
    Witness
        Result for the pair, and the statement that could not be proved if there is one.
    """
    names = triplet.split() if isinstance(triplet, str) else list(triplet)
    need_map(contact_map)
    d = contact_map.chart.discretization
    rod, whisker = exact_rod(contact_map.whisker), contact_map.whisker
    alpha = 1.0 - whisker.tip_radius / whisker.base_radius
    factors = np.zeros((5, DEGREES))
    factors[0, 0] = 1.0
    system = _System(spatial_point_conditions("contact"), rod, Bounds(alpha, factors, 0.0))
    s = np.asarray(arc_length, dtype=np.float64) / d.length
    across = np.asarray(force, dtype=np.float64) / d.force
    level = np.hypot(*across.T) / (1.0 / s - alpha) ** 2
    first, second = np.stack([s, np.arctan2(across[:, 1], across[:, 0]), level], axis=1)
    if whisker.is_straight:
        turn = np.array([0.0, first[1], 0.0])
        first, second = first - turn, second - turn
        if not {"FD", "MD"} & set(names):
            second = first + np.array([0.0, np.pi, 0.0])
    sides = np.stack([first[1], second[1]]) / np.pi
    flat = is_planar(whisker) and bool((np.abs(sides - np.round(sides)) < _FLAT).all())
    wanted = names
    if flat:
        first[1], second[1] = np.pi * (np.round(sides) % 2.0)
        wanted = [name for name in names if name in ("Fx", "FT", "MB")]
        if whisker.is_straight and "MB" in names and not rod.coefficients[:, 3, 1:].any():
            wanted = [name for name in wanted if name != "Fx"]  # -M_B²/2EI of a cylinder
        if whisker.is_straight and not {"FD", "MD"} & set(names):
            wanted = []  # equal by symmetry of the whisker
    start = _box_around(first, np.zeros(3))
    one, two = system.at(start), system.at(_box_around(second, np.zeros(3)))
    if not np.isfinite(one.centre).all():
        return Witness(False, np.inf, 0.0, "the first contact could not be enclosed")
    free = np.arange(3)
    if flat and len(wanted) < 3:
        strong = np.abs(_equations(wanted, one, two)[1].centre[:, ::2] * second[::2]).sum(axis=0)
        free = np.sort(np.array([0, 2])[np.argsort(-strong)][: len(wanted)])
    for _ in range(_STEPS if wanted else 0):
        gap, slope = _equations(wanted, one, system.at(_box_around(second, np.zeros(3))))
        move = np.linalg.lstsq(slope.centre[:, free], gap.centre, rcond=1e-10)[0]
        if not np.isfinite(move).all():
            return Witness(False, np.inf, 0.0, "the second contact could not be enclosed")
        second[free] -= move
    if (box := _unique_box(system, (names, wanted), free, one, second)) is None:
        doubt = "no box around the second contact passes Krawczyk's test"
        return Witness(False, np.inf, 0.0, doubt)
    apart = one.at(slice(6, 9)) + -system.at(box).at(slice(6, 9))  # type: ignore[arg-type]
    least = float(np.linalg.norm(np.maximum(np.abs(apart.centre) - apart.radius, 0.0)) * 0.999999)
    doubt = "" if least > 0.0 else "the two contacts may be the same"
    for contact in (start, box):
        if not system.stable(contact):
            doubt = doubt or "that both contacts are stable could not be shown"
    return Witness(not doubt, float(np.ptp(box[0])), least, doubt)


class _System(NamedTuple):
    """The whisker, and the tables of what is computed on boxes of contacts."""

    tables: Conditions
    rod: ExactRod
    force: Bounds

    def at(self, box: Array) -> _Range:
        """F, M and p, and their derivatives by s, φ and ℓ (36,), over a box (3, 2)."""
        found = enclose_conditions(self.tables, self.rod, self.force, box[None], _TOLERANCE)[0][0]
        return _Range(found[1:, 0], found[1:, 1:].sum(axis=-1) * (1.0 + _LOST))

    def stable(self, box: Array) -> bool:
        """Whether det ∂p/∂ξ is proved positive from rest to a contact."""
        domain = box.copy()
        domain[2, 0] = 0.0
        start = np.zeros((1, 3, 2), dtype=np.int64)

        def evaluate(boxes: IntArray) -> tuple[Array, Array]:
            inside = bounds(boxes, domain, domain[0])
            found, widths = enclose_conditions(
                self.tables, self.rod, self.force, inside, _TOLERANCE
            )
            return found[:, :1], widths

        found = cover(evaluate, start, _MOST_BOXES, np.array([False, False, True]))
        return not len(found.undecided) and not len(found.refuted)


def _equations(names: list[str], one: _Range, two: _Range) -> tuple[_Range, _Range]:
    """Differences of signals (3,) and their derivatives by the second contact (3, 3)."""
    slope = _Range(two.centre[9:].reshape(9, 3), two.radius[9:].reshape(9, 3))
    gaps, slopes = [], []
    for name in names:
        if name in _SINGLE:
            i = _SINGLE[name]
            gaps.append(two.at(i) + -one.at(i))
            slopes.append(slope.at(i))
            continue
        i, j = _PAIRS[name]
        a, b = (two.at(i), two.at(j)) if name in ("FT", "MB") else (-one.at(j), one.at(i))
        x, y = two.at(i), two.at(j)
        value = a * x + b * y
        if name in ("FT", "MB"):
            value = value + -(one.at(i) * one.at(i) + one.at(j) * one.at(j))
            a, b = a + a, b + b
        gaps.append(value)
        slopes.append(a * slope.at(i) + b * slope.at(j))
    sizes = (len(names),), (len(names), 3)
    gap, by = (
        _Range(*(np.reshape([part[i] for part in parts], size) for i in range(2)))
        for parts, size in zip((gaps, slopes), sizes, strict=True)
    )
    return gap, by


def _box_around(contact: Array, half: Array) -> Array:
    """Box (3, 2) around a contact; it contains φ = π if that is the rounded value."""
    half = np.maximum(half, [0.0, 1e-15 * abs(contact[1]), 0.0])
    return np.stack([contact - half, contact + half], axis=-1)


def _unique_box(
    system: _System, names: tuple[list[str], list[str]], free: IntArray, one: _Range, second: Array
) -> Array | None:
    """Box (3, 2) with exactly one contact that has the first's signals; None if unproved."""
    everything, wanted = names
    gap, slope = _equations(wanted, one, system.at(_box_around(second, np.zeros(3))))
    by = slope.centre[:, free]
    if np.linalg.matrix_rank(by) < len(wanted):
        return None
    inverse = np.linalg.inv(by)
    off = np.abs(inverse) @ (np.abs(gap.centre) + gap.radius) * (1.0 + 1e-12)
    half, near = np.zeros(3), np.abs(second[free])
    half[free] = 2.0 * off + 1e-15 * near
    for _ in range(_TRIALS):
        box = _box_around(second, half)
        over = system.at(box)
        slope = _equations(wanted, one, over)[1]
        centre, radius = slope.centre[:, free], slope.radius[:, free]
        defect = np.abs(np.eye(len(wanted)) - inverse @ centre)
        rounded = 1e-13 * np.abs(inverse) @ np.abs(centre)
        spread = np.abs(inverse) @ radius + defect + rounded
        need = (off + spread @ half[free]) * (1.0 + 1e-9)
        # The ends of the box are rounded, by less than this.
        if (need < half[free] - 1e-15 * near).all():
            pairs = [_PAIRS[name] for name in everything if name in ("FD", "MD")]
            along = [one.at(i) * over.at(i) + one.at(j) * over.at(j) for i, j in pairs]
            return box if all(a.centre > a.radius for a in along) else None
        half[free] = 1.5 * np.maximum(need, half[free])
        if not np.isfinite(half).all():
            return None
    return None
