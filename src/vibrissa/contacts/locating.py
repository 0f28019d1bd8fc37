"""One measurement through compiled code: what is searched, and contacts that give three signals.

What batches do with arrays (:mod:`~vibrissa.contacts.inversion`), here for one measurement at a
time, where NumPy's overhead would be ten times the work: the contacts with their covariances, in SI
units. More than three signals, or a mix, are for :mod:`~vibrissa.contacts.explaining`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.inversion import MOST_CANDIDATES, _invert, _polish
from vibrissa.contacts.modes import settle
from vibrissa.contacts.weighing import Weighing
from vibrissa.numerics import Array, IntArray, copy, inlined, kernel
from vibrissa.rod import TOLERANCE, Fold, Rod, SearchTree

# Columns of a candidate: contact point, arc length, force in the material frame, base force, and
# the covariance of the point.
POINT, ARC, CONTACT_FORCE, FORCE, COVARIANCE, COLUMNS = 0, 3, 4, 7, 10, 19
# A contact moves no farther than this (over L) from one measurement to the next.
_NEAR = 0.02


class Searched(NamedTuple):
    """What is searched, non-dimensional but for the units."""

    rod: Rod
    fold: Fold
    proximal: float
    tree: SearchTree
    where: IntArray
    codes: Array
    contacts: Array
    values: Array
    seen: Array
    turns: Array
    kinds: IntArray
    part: IntArray
    volume: Array
    length: float
    force: float


class Trail(NamedTuple):
    """The contact that a stream has followed so far: which candidate of the next sample goes on."""

    number: IntArray
    contact: Array
    value: Array

    @classmethod
    def new(cls) -> Trail:
        """Begin without a contact."""
        return cls(np.zeros(1, np.int64), np.zeros((1, 3)), np.zeros((1, 6)))


@inlined
def near(trail: Trail, values: Array, n: int) -> bool:
    """Whether one of the first n of (F, p) is near the contact followed so far."""
    for row in range(n):
        away = 0.0
        for a in range(3, 6):
            away = max(away, abs(values[row, a] - trail.value[0, a]))
        if away < _NEAR:
            return True
    return False


@inlined
def go_on(trail: Trail, contacts: Array, values: Array, n: int) -> int:
    """Choose which of n candidates goes on from the contact before, and remember it."""
    chosen, least = 0, np.inf
    if trail.number[0] > 0 and n > 1:
        for row in range(n):
            away = 0.0
            for a in range(3, 6):
                away += (values[row, a] - trail.value[0, a]) ** 2
            if away < least:
                chosen, least = row, away
    trail.number[0] = n
    copy(contacts[chosen], trail.contact[0])
    copy(values[chosen], trail.value[0])
    return chosen


@kernel
def tell(
    length: float, force: float, contacts: Array, values: Array, covariances: Array, found: Array
) -> None:
    """Fill candidates in SI units."""
    for row in range(contacts.shape[0]):
        out = found[row]
        for a in range(3):
            out[POINT + a] = values[row, 3 + a] * length
            out[FORCE + a] = values[row, a] * force
            for c in range(3):
                out[COVARIANCE + 3 * a + c] = covariances[row, a, c] * length**2
        out[ARC] = contacts[row, 0] * length
        out[CONTACT_FORCE] = 0.0
        out[CONTACT_FORCE + 1] = contacts[row, 1] * force
        out[CONTACT_FORCE + 2] = contacts[row, 2] * force


@kernel
def conclude(
    of: Searched,
    how: Weighing,
    noisy: bool,
    passes: int,
    limit: float,
    target: Array,
    measured: Array,
    trail: Trail,
    number: int,
    x: Array,
    values: Array,
    found: Array,
    probability: Array,
) -> tuple[int, int, float, bool]:
    """Complete and judge candidates of one measurement where it is noisy, and tell them."""
    most, k = MOST_CANDIDATES, target.shape[0]
    misfits, covariances = np.zeros((1, most)), np.full((1, most, 3, 3), np.nan)
    count, valid = np.full(1, number), np.zeros(1, np.bool_)
    if noisy:
        settle(
            of,
            how,
            passes,
            limit,
            target.reshape(1, k),
            measured.reshape(1, measured.shape[0]),
            count,
            x,
            values,
            misfits,
            covariances,
            probability,
            valid,
            0,
            1,
        )
    n = count[0]
    if n == 0:
        trail.number[0] = 0
        return 0, 0, np.nan, False
    contacts = np.empty((n, 3))
    for row in range(n):
        for a in range(3):
            contacts[row, a] = x[0, row, a if a == 0 else a + 1]
    tell(of.length, of.force, contacts, values[0], covariances[0], found)
    return n, go_on(trail, contacts, values[0], n), misfits[0, 0], valid[0]


@kernel
def meet(
    of: Searched,
    how: Weighing,
    noisy: bool,
    passes: int,
    limit: float,
    target: Array,
    measured: Array,
    trail: Trail,
    found: Array,
    probability: Array,
) -> tuple[int, int, float, bool]:
    """Find all contacts that give three signals exactly, or as noise has them.

    The arguments and what is returned are those of :func:`conclude`.
    """
    aim, number = np.empty((1, 6)), np.zeros(1, np.int64)
    xi, solved = np.empty((1, MOST_CANDIDATES + 1, 3)), np.empty((1, MOST_CANDIDATES + 1, 6))
    for k in range(3):
        aim[0, k], aim[0, 3 + k] = measured[of.where[k]], of.codes[k]
    _invert(of.rod, of.fold, of.tree, of.proximal, aim, number, xi, solved, 0, 1)
    n = int(number[0])
    if n < trail.number[0] and not near(trail, solved[0], n):
        n = _followed(of, aim, trail, xi[0], solved[0], n)
    x, values = np.zeros((1, MOST_CANDIDATES, 4)), np.empty((1, MOST_CANDIDATES, 6))
    for row in range(n):
        for a in range(3):
            x[0, row, a if a == 0 else a + 1] = xi[0, row, a]
        copy(solved[0, row], values[0, row])
    return conclude(
        of, how, noisy, passes, limit, target, measured, trail, n, x, values, found, probability
    )


@kernel
def _followed(of: Searched, target: Array, trail: Trail, xi: Array, values: Array, n: int) -> int:
    """Add the contact that goes on from the last one, should the search have missed it."""
    at, value = trail.contact.copy(), np.empty((1, 6))
    residual, sign = np.full(1, np.inf), np.zeros(1)
    _polish(of.rod, of.fold, target, at, value, residual, sign, 0, 1)
    new = residual[0] <= TOLERANCE and sign[0] > 0.0 and at[0, 0] >= of.proximal
    if not new or not near(trail, value, 1):
        return n
    place = n  # by force
    while place > 0 and np.hypot(xi[place - 1, 1], xi[place - 1, 2]) > np.hypot(at[0, 1], at[0, 2]):
        copy(xi[place - 1], xi[place])
        copy(values[place - 1], values[place])
        place -= 1
    copy(at[0], xi[place])
    copy(value[0], values[place])
    return min(n + 1, MOST_CANDIDATES)
