"""Search in a chart for contacts at which three quantities have given values.

The tree (:mod:`vibrissa.rod.tree`) lists the cells that may contain a target. In each of them the
interpolant is inverted by Newton's method (:mod:`vibrissa.rod.cell`), which gives seeds so near the
exact solution that the rod's own Newton iteration converges at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.numerics import (
    Array,
    Call,
    IntArray,
    compile_together,
    copy,
    inlined,
    shared,
    vectorised,
    wrapped,
)
from vibrissa.rod.cell import (
    CELL_BUFFER,
    fold_sides,
    invert,
    is_polar,
    load_cell,
    may_be_folded,
    points_opposite,
    refine,
    set_target,
    turned_difference,
)
from vibrissa.rod.discretization import Rod
from vibrissa.rod.integration import evaluate
from vibrissa.rod.tree import Balance, SearchTree, balance_rows, balanced

#: Largest number of contacts found for one target.
MOST_SEEDS = 64
#: Largest number of cells listed around one target.
MOST_CELLS = 64
# Where a cell that may contain a fold has no solution but misses one by at most this share of its
# extent, the map may have two, one on either side of the fold, and both are started from.
_LARGEST_MISS = 0.3
_STACK = 256


@inlined
def _add_seed(
    tree: SearchTree, cell: int, x: Array, solved: int, room: SeedRoom, count: int
) -> int:
    """Add a seed unless a neighbour found the same; a solved one replaces an unsolved one."""
    found, inverses, quality, b, work = room.found, room.inverses, room.quality, room.b, room.work
    grid, place = tree.grid, tree.place[cell]
    det = 0.0
    if solved == 2 and not is_polar(b):
        det = refine(tree, place, b, work, x)
    eta = grid[0, 0] + grid[1, 0] * (place[0] + x[0])
    psi = grid[0, 1] + grid[1, 1] * (place[1] + x[1])
    rho = grid[0, 2] + grid[1, 2] * (place[2] + x[2])
    row = count
    for n in range(count):
        apart = max(
            abs(eta - found[n, 0]) / grid[1, 0],
            abs(wrapped(psi - found[n, 1])) / grid[1, 1],
            abs(rho - found[n, 2]) / grid[1, 2],
        )
        both = solved + quality[n]
        if apart < 0.005 or (both < 4 and apart < (0.5 if both > 1 else 0.15)):
            if solved <= quality[n]:
                return count
            row = n
            break
    if row == MOST_SEEDS:
        for n in range(count):
            row = n if row == MOST_SEEDS and quality[n] < solved else row
        if row == MOST_SEEDS:
            return count
    found[row, 0], found[row, 1], found[row, 2] = eta, psi, rho
    quality[row] = solved
    for a in range(3):
        for c in range(3):
            inverses[row, a, c] = np.nan if det == 0.0 else work[a, c] * grid[1, a]
    return max(count, row + 1)


@inlined
def _boxes_around(turns: Array, box: Array, target: Array, slack: Array) -> int:
    """Bits of the eight sibling boxes that contain values within ``slack`` of the target."""
    t0, t1, t2 = target[0], target[1], target[2]
    s0, s1, s2 = slack[0], slack[1], slack[2]
    turn0, turn1, turn2, inside = turns[0], turns[1], turns[2], 0
    for c in range(8):  # without branches and stores, so that it vectorises
        d0, d1, d2 = t0 - box[0, c], t1 - box[1, c], t2 - box[2, c]
        d0 -= 2.0 * np.pi * np.rint(d0 * turn0)
        d1 -= 2.0 * np.pi * np.rint(d1 * turn1)
        d2 -= 2.0 * np.pi * np.rint(d2 * turn2)
        most = max(abs(d0) - box[3, c] - s0, abs(d1) - box[4, c] - s1)
        most = max(most, abs(d2) - box[5, c] - s2, -box[3, c])  # fillers have a negative width
        # The right side is NaN if any difference is, which a maximum may ignore.
        inside |= (1 << c) if most <= 0.0 * (d0 + d1 + d2) else 0
    return inside


@inlined
def _next_cells(
    tree: SearchTree, target: Array, slack: Array, stack: IntArray, top: int, near: IntArray
) -> tuple[int, int, int]:
    """Advance to the next eight cells, and list those that may contain values near a target.

    Return the number of blocks left on the stack, the index of the eight (-1 if there are none),
    and how many of them are listed in ``near``, within ``slack`` of the target.
    """
    last = tree.offsets.shape[0] - 2
    while top > 0:
        top -= 1
        level, node = stack[top, 0], stack[top, 1]
        inside = _boxes_around(tree.turns, tree.boxes[tree.offsets[level] + node], target, slack)
        if level == last:
            number = 0
            for c in range(8):
                near[number] = c
                number += (inside >> c) & 1
            return top, node, number
        top = min(top, _STACK - 8)
        for c in range(8):
            stack[top, 0], stack[top, 1] = level + 1, 8 * node + c
            top += (inside >> c) & 1
    return top, -1, 0


class SeedRoom(NamedTuple):
    """The seeds of a target, and working memory of the search for them; see :func:`seed_room`."""

    found: Array  # (n, 3), chart coordinates
    inverses: Array  # (n, 3, 3), their derivatives by the aim, NaN where they are not known
    # (n,) 2: solved; 1: nearly so, as near a fold; 0: to one side of a fold.
    quality: IntArray
    stack: IntArray  # (256, 2), blocks still to be looked at
    listed: IntArray  # (512,), cells whose boxes contain the target, see `_list_cells`
    near: IntArray  # (8,), which of eight cells may hold the target
    slack: Array  # (3,), how far from it
    aim: Array  # (3,), target in the quantities that cells interpolate
    x: Array  # (3,), where in a cell
    nearest: Array  # (3,), where in a cell it was missed least
    work: Array  # (6, 3), rows of `invert`
    b: Array  # buffer of the interpolant
    half: Array  # (3,), sizes of a cell's equations
    sides: Array  # (3, 3), starts to either side of a fold


@inlined
def seed_room() -> SeedRoom:
    """Allocate working memory for seeds, once for many targets."""
    return SeedRoom(
        np.empty((MOST_SEEDS, 3)),
        np.empty((MOST_SEEDS, 3, 3)),
        np.empty(MOST_SEEDS, np.int64),
        np.empty((_STACK, 2), np.int64),
        np.empty(2 * _STACK, np.int64),
        np.empty(8, np.int64),
        np.zeros(3),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty((6, 3)),
        np.zeros(CELL_BUFFER),
        np.empty(3),
        np.empty((3, 3)),
    )


@inlined
def _list_cells(
    tree: SearchTree, target: Array, slack: Array, stack: IntArray, near: IntArray, listed: IntArray
) -> tuple[int, int]:
    """List cells whose boxes contain the target: the polar ones backward, from the end.

    Goes on with the blocks on the stack, ``listed[0]`` of them, until the list may be full.
    Returns how many other cells are listed, from index 1 on, and the index of the last polar cell.
    """
    top, first, last = listed[0], 1, listed.shape[0]
    while top > 0 and first + 8 <= last - 8:
        top, node, number = _next_cells(tree, target, slack, stack, top, near)
        for i in range(number):
            child = 8 * node + near[i]
            if tree.polar[child] >= 0:
                last -= 1
                listed[last] = child
            else:
                listed[first] = child
                first += 1
    listed[0] = top
    return first, last


@shared
def seeds(tree: SearchTree, target: Array, room: SeedRoom) -> int:
    """Fill all contacts that may have the target's values; return their number.

    Polar cells come last: where the other quantities vanish with the vector, as on a curve through
    Ω, each of them has dozens of solutions near a light target, which must not crowd out others.
    """
    cells = tree.boxes[tree.offsets[-2] :]
    stack, listed, near, slack, aim = room[3:8]
    x, nearest, work, b, half, sides = room[8:]
    stack[0, 0] = stack[0, 1] = 0
    listed[0], count = 1, 0
    balanced(tree.balance, target, aim, x)
    set_target(tree, aim, b)
    while listed[0] > 0:
        end, polar = _list_cells(tree, target, slack, stack, near, listed)
        for i in range(1, end + listed.shape[0] - polar):
            child = listed[i if i < end else polar + i - end]
            c, box = child % 8, cells[child // 8]
            careful = load_cell(tree, child, box, c, aim, b, work, half, x)
            if careful < 0:
                continue
            least = np.inf
            missed = may_be_folded(careful, b)
            for start in range(9 if careful > 0 else 1):  # from the located position, then corners
                if start > 0:
                    for a in range(3):
                        x[a] = (start - 1) >> a & 1
                solved = invert(b, half, work, careful > 0, careful > 0 and start == 0, x)
                missed = missed and solved < 2
                if missed and work[5, 0] < least:
                    least = work[5, 0]
                    copy(x, nearest)
                if solved > 0 and not points_opposite(b):
                    count = _add_seed(tree, child, x, solved, room, count)
                if solved == 2 and careful < 2:
                    break
            if not missed or least > _LARGEST_MISS:
                continue
            if fold_sides(b, half, nearest, work, sides):
                for side in range(2):
                    count = _add_seed(tree, child, sides[side], 0, room, count)
    return count


def compile_seeds(rod: Rod, *later: Call) -> None:
    """Compile :func:`seeds` in another process, while this one compiles what its trees need.

    For callers that build a chart and then search in it. ``later`` are kernels that are then
    probably called; the other process compiles them next. Does nothing if ``seeds`` is cached.
    """
    if not seeds.overloads:  # type: ignore[attr-defined]
        rows, slopes = np.empty((0, 3)), np.empty((0, 3, 3))
        values = np.empty((0, 4)), np.empty((0, 6)), np.empty((0, 6, 3))
        room = seed_room.py_func()  # type: ignore[attr-defined]
        here: list[Call] = [(evaluate, (rod, *values, 0, 0))]
        here.append((balance_rows, (Balance.none(), rows, slopes)))
        compile_together(here, [(seeds, (SearchTree.none(), np.empty(3), room)), *later])


@inlined
def _near_cell(tree: SearchTree, cell: int, target: Array, slack: Array, x: Array) -> float:
    """Distance of the target beyond a cell, in units of the slack; -1 if it is more than that.

    x is set to the closest position in the cell.
    """
    frame, most = tree.frame[cell], 0.0
    for a in range(3):
        y, off = 0.0, 1e-300
        for q in range(3):
            y += frame[a, q] * turned_difference(tree, q, target[q], frame[3, q])
            off += abs(frame[a, q]) * slack[q]
        away = max(frame[4, a] - y, y - frame[5, a], 0.0) / off
        if away > 1.0:
            return -1.0
        most, x[a] = max(most, away), min(max(y, 0.0), 1.0)
    return most


@vectorised
def cells_around(
    tree: SearchTree, target: Array, slack: Array, cells: IntArray, spots: Array, away: Array
) -> int:
    """List ``cells`` (n,) that may hold values within ``slack`` of the target.

    Fills ``spots`` (n, 3), chart coordinates of the closest position in each cell, and ``away``
    (n,), the distance there in units of the slack. Returns the number of cells, at most n.
    """
    stack, x, near = np.zeros((_STACK, 2), np.int64), np.empty(3), np.empty(8, np.int64)
    return _cells_around(tree, target, slack, cells, spots, away, stack, x, near)


@vectorised
def _cells_around(
    tree: SearchTree,
    target: Array,
    slack: Array,
    cells: IntArray,
    spots: Array,
    away: Array,
    stack: IntArray,
    x: Array,
    near: IntArray,
) -> int:
    """List cells in given memory: arrays passed as arguments need no reference counting."""
    grid, place, count = tree.grid, tree.place, 0
    top, node, number = _next_cells(tree, target, slack, stack, 1, near)
    while node >= 0:
        for i in range(number):
            child, miss = 8 * node + near[i], 0.0
            x[:] = 0.5
            if tree.polar[child] < 0:
                miss = _near_cell(tree, child, target, slack, x)
            if miss < 0.0:
                continue
            for a in range(3):
                spots[count, a] = grid[0, a] + grid[1, a] * (place[child, a] + x[a])
            cells[count], away[count] = child, miss
            count += 1
            if count == spots.shape[0]:
                return count
        top, node, number = _next_cells(tree, target, slack, stack, top, near)
    return count
