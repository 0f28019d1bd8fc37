"""Basins of the chart's cells in which further contacts may explain a measurement; compiled.

The search tree lists the cells that may contain signals within two standard deviations of the
measured ones. Adjacent cells belong to one basin unless cells that miss the measurement by more
separate them, or cells in which the vector of a direction may vanish. A basin that no known
contact explains through its slopes supplies a starting point for a fit. Cells at the fold form
basins of their own, with starting points on the fold: χ² may have a minimum there, however near
another contact explains the measurement.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import MOST_CANDIDATES
from vibrissa.contacts.fitting.fit_within import by_slopes
from vibrissa.contacts.sensing.weighing import Weighing, channel_covariance
from vibrissa.contacts.uncertainty.nodes import Searched
from vibrissa.numerics import Array, IntArray, copy, inlined, kernel
from vibrissa.rod import MOST_CELLS, along, cells_around, chart_to_contact, fold_force
from vibrissa.signals import FD, FY, MD, MY

_LIGHT = 0.5  # least ρ of a starting contact, in cells
_WIDEST = 1e3  # largest distance searched for in one quantity; more than half a turn
# Height of a sill between two basins: by how much more its cells miss, relative to the slack.
_SILL = 0.5
# Largest χ² that the slopes of a known contact explain: three quantities, each up to the slack
# away, and as much again for the errors of cells.
_LINEAR = 25.0


@inlined
def slacks(
    of: Searched, how: Weighing, apart: float, value: Array, measured: Array, out: Array
) -> None:
    """Fill how far the three quantities searched for may be ``apart`` standard deviations away.

    The noise is that at (F, p). A direction may be any if its vector is not larger than its noise.
    """
    k = how.codes.shape[0]
    if how.own[0, 0] > 0.0:  # mixed components, white
        for q in range(3):
            out[q] = apart
        return
    sigma = np.empty((k, k))
    channel_covariance(how, value, measured, sigma)
    for q in range(3):
        i = of.where[q]
        code = how.codes[i]
        out[q], turns = sigma[i, i], code in (FD, MD)
        if code >= FY:  # components instead of a size (first) and its direction
            first = i if code in (FY, MY) else i - 1
            angle = measured[first + 1]
            along_y, along_z = math.cos(angle), math.sin(angle)
            turns = i > first
            if turns:
                size = max(measured[first], 1e-300)
                along_y, along_z = -along_z / size, along_y / size
            out[q] = (
                along_y * along_y * sigma[first, first]
                + 2.0 * along_y * along_z * sigma[first, first + 1]
                + along_z * along_z * sigma[first + 1, first + 1]
            )
        out[q] = min(apart * math.sqrt(out[q]), _WIDEST)
        if turns:
            out[q] = math.asin(out[q]) if out[q] < 1.0 else _WIDEST


@inlined
def _chart_of(of: Searched, x: Array, out: Array) -> None:
    """Chart coordinates (η, ψ, ρ) of a contact x (4,)."""
    out[1] = math.atan2(x[3], x[2])
    out[0] = along(of.charted.fold.bounds, x[0])
    out[2] = math.sqrt(math.hypot(x[2], x[3]) / fold_force(of.charted.fold, x[0], out[1]))


@inlined
def _start_at(of: Searched, spot: Array, start: Array) -> None:
    """Fill the contact x (4,) at a position in the chart."""
    chart_to_contact(of.charted.fold, spot, start[1:])
    start[0], start[1] = start[1], 0.0


@inlined
def _adjacent(of: Searched, a: int, b: int) -> bool:
    """Whether two cells may belong to one basin: they touch, and both or neither are at the fold.

    Cells in which a transverse vector may vanish contain any direction and would join the basins on
    either side of them, so they are adjacent only to each other. Near rest all bearings are.
    """
    if _at_fold(of, a) != _at_fold(of, b) or (of.tree.polar[a] < 0) != (of.tree.polar[b] < 0):
        return False
    one, other = of.tree.place[a], of.tree.place[b]
    around = round(2.0 * math.pi / of.tree.grid[1, 1])
    turn = abs(one[1] - other[1])
    near = min(turn, around - turn) <= 1 or one[2] + other[2] == 0
    return bool(near and abs(one[0] - other[0]) <= 1 and abs(one[2] - other[2]) <= 1)


@inlined
def _holds(of: Searched, cell: int, position: Array) -> bool:
    """Whether a position in the chart is in a cell or next to it."""
    place, grid, apart = of.tree.place[cell], of.tree.grid, np.empty(3)
    for a in range(3):
        apart[a] = abs((position[a] - grid[0, a]) / grid[1, a] - place[a] - 0.5)
    around = 2.0 * math.pi / grid[1, 1]
    apart[1] = abs(apart[1] - around * round(apart[1] / around))
    return bool(max(apart[0], apart[2]) <= 1.5 and (apart[1] <= 1.5 or place[2] == 0))


@inlined
def _at_fold(of: Searched, cell: int) -> bool:
    """Whether a cell of the chart ends at the fold."""
    grid = of.tree.grid
    return bool(of.tree.place[cell, 2] == round((1.0 - grid[0, 2]) / grid[1, 2]) - 1)


@inlined
def _root(parent: IntArray, i: int) -> int:
    """Root of the basin that a cell belongs to."""
    while parent[i] != i:
        i = parent[i]
    return i


@kernel
def _basins(
    of: Searched, cells: IntArray, away: Array, n: int, order: IntArray, parent: IntArray
) -> None:
    """Fill the order of cells by how far they miss, and the basin of each: sills separate these."""
    for i in range(n):
        place = i
        while place > 0 and away[order[place - 1]] > away[i]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = i
    for nth in range(n):
        i = order[nth]
        parent[i] = i
        for before in range(nth):
            j = order[before]
            mine, theirs = _root(parent, i), _root(parent, j)
            if mine == theirs or not _adjacent(of, cells[i], cells[j]):
                continue
            if away[mine] < away[theirs]:
                mine, theirs = theirs, mine
            if away[i] - away[mine] <= _SILL:
                parent[mine] = theirs


class BasinsRoom(NamedTuple):
    """Working memory of `starts_of_basins`.

    Target and slacks (3,), known contacts in the chart (n, 3); for each cell its number, nearest
    position in the chart (n, 3), the distance by which it misses, its rank and its basin.
    """

    target: Array
    slack: Array
    known: Array
    cells: IntArray
    spots: Array
    away: Array
    order: IntArray
    parent: IntArray


@inlined
def basins_room() -> BasinsRoom:
    """Allocate the working memory, once for many measurements."""
    return BasinsRoom(
        np.empty(3),
        np.empty(3),
        np.empty((MOST_CANDIDATES, 3)),
        np.empty(MOST_CELLS, np.int64),
        np.empty((MOST_CELLS, 3)),
        np.empty(MOST_CELLS),
        np.empty(MOST_CELLS, np.int64),
        np.empty(MOST_CELLS, np.int64),
    )


@kernel
def starts_of_basins(
    of: Searched,
    measured: Array,
    x: Array,
    residuals: Array,
    jacobians: Array,
    number: int,
    starts: Array,
    room: BasinsRoom,
) -> tuple[int, bool]:
    """Fill one starting contact for each basin that the known contacts x do not explain.

    The room contains the slacks. Starting contacts at rest would not have a direction.
    Return their number, and whether there are more.
    """
    target, slack, known, cells, spots, away, order, parent = room
    kept, count = 0, 0
    for q in range(3):
        target[q] = measured[of.where[q]]
    n = cells_around(of.tree, target, slack, cells, spots, away)
    for c in range(number):
        _chart_of(of, x[c], known[c])
    for i in range(n):
        start, new, folded = starts[0], True, _at_fold(of, cells[i])
        spots[i, 2] = 1.0 if folded else max(spots[i, 2], _LIGHT * of.tree.grid[1, 2])
        _start_at(of, spots[i], start)
        for c in range(number):
            new = new and (folded or not _holds(of, cells[i], known[c]))
            new = new and not by_slopes(x[c], residuals[c], jacobians[c], start) < _LINEAR
        if new:
            cells[kept], away[kept] = cells[i], away[i]
            copy(spots[i], spots[kept])
            kept += 1
    _basins(of, cells, away, kept, order, parent)
    for nth in range(kept):
        i = order[nth]
        if parent[i] == i:
            if count == starts.shape[0]:
                return count, True
            _start_at(of, spots[i], starts[count])
            count += 1
    return count, n == MOST_CELLS
