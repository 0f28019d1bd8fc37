"""Search in a chart for contacts at which three quantities have given values.

The tree (:mod:`vibrissa.rod.tree`) lists the cells that may contain a target. In each of them the
interpolant is inverted by Newton's method, which gives seeds so near the exact solution that the
rod's own Newton iteration converges at once.

In a cell where a vector of the plane may vanish (:class:`~vibrissa.rod.SearchTree`), its length
ℓ and direction β are not smooth, but its components v are. There the equations are

    both known: v - ℓ (cos β, sin β) = 0;   β alone: v × (cos β, sin β) = 0, v · (cos β, sin β) > 0;
    ℓ alone: (v · v - ℓ²) / 2R = 0, with R the largest |v| in the cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.numerics import AnyArray, Array, IntArray, copy, inlined, solve3, vectorised, wrapped
from vibrissa.rod.tree import EVEN, FOLDED, SearchTree

#: Largest number of contacts found for one target.
MOST_SEEDS = 32
#: Largest number of cells listed around one target.
MOST_CELLS = 64
# Distance (in cell widths) outside a cell within which a solution still counts as the cell's:
# neighbours overlap.
_OVERLAP = 0.05
# Miss of the interpolant (over the cell's extent) up to which the map itself may attain the target.
_NEARLY = 0.02
# Where a cell that may contain a fold has no solution but misses one by at most this share of its
# extent, the map may have two, one on either side of the fold. They are reached from starts at this
# distance from the miss (in cell widths).
_LARGEST_MISS = 0.3
_SIDE = 0.2
# In the first cells from rest, where signals vanish, misses are common and do not indicate a fold.
_RESTING = 3
# Linear equations with a determinant below this share of the product of their rows are singular.
_SINGULAR = 1e-3
_STACK = 256


# Buffer of the interpolant, with four lanes: three quantities and padding. It is one flat array,
# without which the compiler does not vectorise. It holds the coefficients, T - target and ∂T/∂x,
# and the target relative to the cell's base.
_MISFIT = 160
_SLOPES = _MISFIT + 4
_RELATIVE = _SLOPES + 12
# For a polar cell: cos β and sin β (both 0 if β is unknown), ℓ (negative if unknown), the largest ℓ
# in the cell (0 in all other cells), and the last interpolated v · (cos β, sin β).
_TARGET = _RELATIVE + 4
_ALONG = _TARGET + 4
_BUFFER = _ALONG + 1


@inlined
def _cubic(b: Array, n: int, q: int, t: float) -> tuple[float, float]:
    """Quantity q along an edge whose four coefficients start at n, and its derivative."""
    c1, c2, c3 = b[4 * n + 4 + q], b[4 * n + 8 + q], b[4 * n + 12 + q]
    return b[4 * n + q] + t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + t * 3.0 * c3)


@inlined
def _bulge(b: Array, n: int, q: int, t: float) -> tuple[float, float]:
    """Deviation of an edge's cubic from the straight line between its ends, and its derivative."""
    c1, c2, c3 = b[4 * n + q], b[4 * n + 4 + q], b[4 * n + 8 + q]
    return t * (c1 + t * (c2 + t * c3)), c1 + t * (2.0 * c2 + t * 3.0 * c3)


@inlined
def _interpolate(b: Array, x: Array) -> None:
    """Compute T - target and ∂T/∂x at position x of a cell; left in the buffer."""
    x1, y1, z1 = x[0], x[1], x[2]
    x0, y0, z0 = 1.0 - x1, 1.0 - y1, 1.0 - z1
    for q in range(4):
        a0, s0 = _cubic(b, 0, q, x1)
        a1, s1 = _cubic(b, 4, q, x1)
        a2, s2 = _cubic(b, 8, q, x1)
        a3, s3 = _cubic(b, 12, q, x1)
        total = y0 * (z0 * a0 + z1 * a1) + y1 * (z0 * a2 + z1 * a3) - b[_RELATIVE + q]
        gx = y0 * (z0 * s0 + z1 * s1) + y1 * (z0 * s2 + z1 * s3)
        gy = z0 * (a2 - a0) + z1 * (a3 - a1)
        gz = y0 * (a1 - a0) + y1 * (a3 - a2)
        a0, s0 = _bulge(b, 16, q, y1)
        a1, s1 = _bulge(b, 19, q, y1)
        a2, s2 = _bulge(b, 22, q, y1)
        a3, s3 = _bulge(b, 25, q, y1)
        total += x0 * (z0 * a0 + z1 * a1) + x1 * (z0 * a2 + z1 * a3)
        gx += z0 * (a2 - a0) + z1 * (a3 - a1)
        gy += x0 * (z0 * s0 + z1 * s1) + x1 * (z0 * s2 + z1 * s3)
        gz += x0 * (a1 - a0) + x1 * (a3 - a2)
        a0, s0 = _bulge(b, 28, q, z1)
        a1, s1 = _bulge(b, 31, q, z1)
        a2, s2 = _bulge(b, 34, q, z1)
        a3, s3 = _bulge(b, 37, q, z1)
        b[_MISFIT + q] = total + x0 * (y0 * a0 + y1 * a1) + x1 * (y0 * a2 + y1 * a3)
        b[_SLOPES + q] = gx + y0 * (a2 - a0) + y1 * (a3 - a1)
        b[_SLOPES + 4 + q] = gy + x0 * (a1 - a0) + x1 * (a3 - a2)
        b[_SLOPES + 8 + q] = gz + x0 * (y0 * s0 + y1 * s1) + x1 * (y0 * s2 + y1 * s3)


@inlined
def _evaluate(b: Array, x: Array) -> None:
    """Compute the cell's equations and their derivatives by x; left in the buffer."""
    _interpolate(b, x)
    largest = b[_TARGET + 3]
    if largest == 0.0:
        return
    cos, sin, length = b[_TARGET], b[_TARGET + 1], b[_TARGET + 2]
    directed = cos != 0.0 or sin != 0.0
    if directed and length >= 0.0:
        b[_MISFIT] -= length * cos
        b[_MISFIT + 1] -= length * sin
        return
    v, w = b[_MISFIT], b[_MISFIT + 1]
    if directed:
        by_v, by_w = -sin, cos
        b[_MISFIT] = w * cos - v * sin
        b[_ALONG] = v * cos + w * sin
    else:
        by_v, by_w = v / largest, w / largest
        b[_MISFIT] = 0.5 * (v * v + w * w - length * length) / largest
    b[_MISFIT + 1], b[_MISFIT + 2] = b[_MISFIT + 2], b[_MISFIT + 3]
    for c in range(3):
        at = _SLOPES + 4 * c
        b[at] = by_v * b[at] + by_w * b[at + 1]
        b[at + 1], b[at + 2] = b[at + 2], b[at + 3]


@inlined
def _adjugate(b: Array, rows: Array) -> float:
    """Fill rows (3, 3) with the adjugate of ∂T/∂x; return its determinant."""
    for a in range(3):
        u, v = _SLOPES + 4 * ((a + 1) % 3), _SLOPES + 4 * ((a + 2) % 3)
        rows[a, 0] = b[u + 1] * b[v + 2] - b[u + 2] * b[v + 1]
        rows[a, 1] = b[u + 2] * b[v] - b[u] * b[v + 2]
        rows[a, 2] = b[u] * b[v + 1] - b[u + 1] * b[v]
    d = _SLOPES
    return float(b[d] * rows[0, 0] + b[d + 1] * rows[0, 1] + b[d + 2] * rows[0, 2])


@inlined
def _outside(x: Array) -> float:
    """Distance of a position outside its cell, in cell widths; negative inside."""
    return float(max(abs(x[0] - 0.5), abs(x[1] - 0.5), abs(x[2] - 0.5)) - 0.5)


@inlined
def _difference(tree: SearchTree, q: int, target: float, base: float) -> float:
    """Difference of target and base; that of angles is wrapped to half a turn."""
    d = target - base
    return float(d - 2.0 * np.pi * np.rint(d * tree.turns[q]))


@inlined
def _set_target(tree: SearchTree, target: Array, b: Array) -> None:
    """Write the target's length and direction, which polar cells need, into the buffer."""
    length, direction = tree.roles[0], tree.roles[1]
    b[_TARGET] = b[_TARGET + 1] = b[_TARGET + 3] = 0.0
    if direction >= 0:
        b[_TARGET], b[_TARGET + 1] = np.cos(target[direction]), np.sin(target[direction])
    b[_TARGET + 2] = target[length] if length >= 0 else -1.0


@inlined
def _set_polar_target(tree: SearchTree, row: int, target: Array, b: Array) -> None:
    """Write the target relative to a polar cell's base into the buffer."""
    frame = tree.polar_frame[row]
    b[_RELATIVE], b[_RELATIVE + 1] = -frame[0], -frame[1]
    for n in range(2):
        q = tree.roles[2 + n]
        b[_RELATIVE + 2 + n] = _difference(tree, q, target[q], frame[2 + n]) if q >= 0 else 0.0


@inlined
def _locate_polar(tree: SearchTree, row: int, b: Array, work: Array, x: Array) -> bool:
    """Whether a polar cell in the buffer may contain the target; if so, x is set to about where.

    If the direction is known, the equations are linear in the components and the other quantities:
    E T = E target. T is a linear function of x plus a remainder within bounds, so a solution is
    within bounds of that of the linear part.
    """
    linear = tree.polar_linear[row]
    cos, sin, length = b[_TARGET], b[_TARGET + 1], b[_TARGET + 2]
    x[0] = x[1] = x[2] = 0.5
    if cos == 0.0 and sin == 0.0:
        return True
    matrix, right, slack = work[:3], work[3], work[4]
    for a in range(3):
        n = a + 1
        if length >= 0.0:
            n = a
        first = length < 0.0 and a == 0
        for c in range(3):
            matrix[a, c] = linear[n, c]
            if first:
                matrix[a, c] = cos * linear[1, c] - sin * linear[0, c]
        right[a] = b[_RELATIVE + n] - linear[n, 3]
        slack[a] = linear[n, 4]
        if first:
            right[a] = cos * (b[_RELATIVE + 1] - linear[1, 3]) - sin * (b[_RELATIVE] - linear[0, 3])
            slack[a] = abs(cos) * linear[1, 4] + abs(sin) * linear[0, 4]
    if length >= 0.0:
        right[0] += length * cos
        right[1] += length * sin
    else:
        along = cos * (linear[0, 3] - b[_RELATIVE]) + sin * (linear[1, 3] - b[_RELATIVE + 1])
        along += abs(cos) * linear[0, 4] + abs(sin) * linear[1, 4]
        for c in range(3):
            along += max(cos * linear[0, c] + sin * linear[1, c], 0.0)
        if along < 0.0:
            return False
    return _solution_in_cube(matrix, right, slack, x)


@inlined
def _polar_care(tree: SearchTree, row: int, b: Array) -> int:
    """Number of starts that a polar cell in the buffer needs, as in `SearchTree.care`."""
    cos, sin, length = b[_TARGET], b[_TARGET + 1], b[_TARGET + 2]
    if cos == 0.0 and sin == 0.0:
        return 2
    least, most = np.inf, 0.0
    volumes = tree.polar_volumes[row]
    for k in range(8):
        volume = volumes[k, 0]
        if length < 0.0:
            volume = cos * volumes[k, 1] - sin * volume
        if k == 0:
            sign = np.sign(volume)
        least, most = min(least, sign * volume), max(most, abs(volume))
    if least <= FOLDED * most:
        return 2
    return 1 if least <= EVEN * most else 0


@inlined
def _solution_in_cube(matrix: Array, right: Array, slack: Array, x: Array) -> bool:
    """Whether matrix x = right, up to ``slack``, may have a solution in the unit cube.

    If so, x is set to the nearest point of the cube, or left unchanged if matrix is singular.
    """
    y, size = np.empty(3), 1.0
    for a in range(3):
        size *= max(abs(matrix[a, 0]), abs(matrix[a, 1]), abs(matrix[a, 2]))
    det = solve3(matrix, right, y)
    if not abs(det) > _SINGULAR * size:
        return True
    inverse = 1.0 / abs(det)
    for a in range(3):
        u, v = (a + 1) % 3, (a + 2) % 3
        off = 0.0
        for r in range(3):
            p, q = (r + 1) % 3, (r + 2) % 3
            cofactor = matrix[p, u] * matrix[q, v] - matrix[p, v] * matrix[q, u]
            off += abs(cofactor) * slack[r]
        off = _OVERLAP + off * inverse
        if y[a] < -off or y[a] > 1.0 + off:
            return False
        y[a] = min(max(y[a], 0.0), 1.0)
    copy(y, x)
    return True


@inlined
def _locate(tree: SearchTree, cell: int, target: Array, relative: Array, x: Array) -> bool:
    """Whether a cell may contain the target; if so, x is set to about where."""
    frame = tree.frame[cell]
    for q in range(3):
        relative[q] = _difference(tree, q, target[q], frame[3, q])
    for a in range(3):
        y = frame[a, 0] * relative[0] + frame[a, 1] * relative[1] + frame[a, 2] * relative[2]
        if y < frame[4, a] or y > frame[5, a]:
            return False
        x[a] = min(max(y, 0.0), 1.0)
    return True


@inlined
def _invert(b: Array, half: Array, work: Array, careful: bool, x: Array) -> int:
    """Solve a cell's interpolant: 2 solved, 1 nearly so (a fold of the map), 0 not in the cell.

    If not solved, x is left where the miss is least: work[5, 0] of the cell's extent.
    """
    rows, step, best = work[:3], work[3], work[4]
    least, done = np.inf, False
    work[5, 0] = np.inf
    for n in range(9):
        _evaluate(b, x)
        if done:
            return 2
        if n == 8:
            break
        m0, m1, m2 = b[_MISFIT], b[_MISFIT + 1], b[_MISFIT + 2]
        away = max(abs(m0) / half[0], abs(m1) / half[1], abs(m2) / half[2])
        if away < least:
            least = away
            for a in range(3):
                best[a] = x[a]
        det = _adjugate(b, rows)
        if det == 0.0:
            break
        for a in range(3):
            step[a] = (rows[a, 0] * m0 + rows[a, 1] * m1 + rows[a, 2] * m2) / det
        size = max(abs(step[0]), abs(step[1]), abs(step[2]))
        if n == 0 and not careful:  # nearly linear: the first step shows if it is in this cell
            reach = max(
                abs(x[0] - step[0] - 0.5), abs(x[1] - step[1] - 0.5), abs(x[2] - step[2] - 0.5)
            )
            if reach > 1.3:
                return 0
        shorten = min(1.0, 0.6 / max(size, 1e-300))
        for a in range(3):
            x[a] = min(max(x[a] - shorten * step[a], -0.5), 1.5)
        if size < 2e-2:  # quadratic convergence: the next step would be about its square
            if _outside(x) > _OVERLAP:
                return 0
            done = True
    for a in range(3):
        x[a] = best[a]
    work[5, 0] = least if _outside(x) <= 0.25 else np.inf
    return 1 if least <= _NEARLY and _outside(x) <= 0.25 else 0


@inlined
def _points_opposite(b: Array) -> bool:
    """Whether a polar cell's vector, as last interpolated, points opposite to the target."""
    directed = b[_TARGET] != 0.0 or b[_TARGET + 1] != 0.0
    polar = b[_TARGET + 3] > 0.0 and directed and b[_TARGET + 2] < 0.0
    return bool(polar and b[_ALONG] < -_NEARLY * b[_TARGET + 3])


@inlined
def _fold_sides(b: Array, half: Array, x: Array, work: Array, sides: Array) -> bool:
    """Fill ``sides`` with points _SIDE from x where T changes least; whether a fold is between."""
    rows, step = work[:3], work[3]
    sign = 1.0
    for at in range(3):
        if at == 0:
            copy(x, sides[2])
        else:
            for a in range(3):
                sides[2, a] = sides[at - 1, a]
        _evaluate(b, sides[2])
        if at > 0:
            sign *= _adjugate(b, rows)
            continue
        most = 0.0
        for q in range(3):
            u, v = _SLOPES + (q + 1) % 3, _SLOPES + (q + 2) % 3
            scale = 1.0 / (half[(q + 1) % 3] * half[(q + 2) % 3])
            d0 = scale * (b[u + 4] * b[v + 8] - b[u + 8] * b[v + 4])
            d1 = scale * (b[u + 8] * b[v] - b[u] * b[v + 8])
            d2 = scale * (b[u] * b[v + 4] - b[u + 4] * b[v])
            size = max(abs(d0), abs(d1), abs(d2))
            if size > most:
                most = size
                step[0], step[1], step[2] = d0 / size, d1 / size, d2 / size
        if most == 0.0:
            return False
        for a in range(3):
            sides[0, a], sides[1, a] = x[a] - _SIDE * step[a], x[a] + _SIDE * step[a]
    return bool(sign < 0.0)


@inlined
def _add_seed(
    grid: Array,
    place: IntArray,
    x: Array,
    b: Array,
    work: Array,
    solved: int,
    found: Array,
    inverses: Array,
    quality: IntArray,
    count: int,
) -> int:
    """Add a seed unless a neighbour found the same; one that is solved replaces one that is not."""
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
        if apart < 0.02 or (both < 4 and apart < (0.5 if both > 1 else 0.15)):
            if solved <= quality[n]:
                return count
            row = n
            break
    if row == MOST_SEEDS:
        return count
    found[row, 0], found[row, 1], found[row, 2] = eta, psi, rho
    quality[row] = solved
    det = _adjugate(b, work) if b[_TARGET + 3] == 0.0 else 0.0
    for a in range(3):
        for c in range(3):  # ∂(η, ψ, ρ)/∂T from ∂T/∂x in cell widths
            inverses[row, a, c] = np.nan if det == 0.0 else work[a, c] * grid[1, a] / det
    return max(count, row + 1)


@inlined
def _boxes_around(turns: Array, box: Array, target: Array, slack: Array, inside: AnyArray) -> None:
    """Which of eight sibling boxes contain values within ``slack`` of the target."""
    t0, t1, t2 = target[0], target[1], target[2]
    s0, s1, s2 = slack[0], slack[1], slack[2]
    for c in range(8):
        d0, d1, d2 = t0 - box[0, c], t1 - box[1, c], t2 - box[2, c]
        d0 -= 2.0 * np.pi * np.rint(d0 * turns[0])
        d1 -= 2.0 * np.pi * np.rint(d1 * turns[1])
        d2 -= 2.0 * np.pi * np.rint(d2 * turns[2])
        near = (abs(d0) <= box[3, c] + s0) & (abs(d1) <= box[4, c] + s1)
        inside[c] = near & (abs(d2) <= box[5, c] + s2) & (box[3, c] >= 0.0)  # not a filler


@inlined
def _next_cells(
    tree: SearchTree, target: Array, slack: Array, stack: IntArray, top: int, inside: AnyArray
) -> tuple[int, int]:
    """Find the next eight cells, and which of them may hold values within ``slack`` of the target.

    Return the number of blocks left on the stack, and the index of the eight; -1 if none is left.
    """
    last = tree.offsets.shape[0] - 2
    while top > 0:
        top -= 1
        level, node = stack[top, 0], stack[top, 1]
        _boxes_around(tree.turns, tree.boxes[tree.offsets[level] + node], target, slack, inside)
        if level == last:
            return top, node
        for c in range(8):
            if inside[c] and top < _STACK:
                stack[top, 0], stack[top, 1] = level + 1, 8 * node + c
                top += 1
    return top, -1


@inlined
def _load_cell(
    tree: SearchTree,
    cell: int,
    box: Array,
    c: int,
    target: Array,
    relative: Array,
    b: Array,
    work: Array,
    half: Array,
    x: Array,
) -> int:
    """Load a cell into the buffer; return the number of starts it needs (see `SearchTree.care`).

    Returns -1 if the target cannot be in the cell.
    """
    row = tree.polar[cell]
    if row >= 0:
        _set_polar_target(tree, row, target, b)
        if not _locate_polar(tree, row, b, work, x):
            return -1
        careful, edge = _polar_care(tree, row, b), tree.polar_edges[row]
        b[_TARGET + 3] = tree.polar_frame[row, 7]
        for a in range(3):
            half[a] = tree.polar_frame[row, 4 + a]
    else:
        if not _locate(tree, cell, target, relative, x):
            return -1
        careful, edge = tree.care[cell], tree.edges[cell]
        b[_TARGET + 3] = b[_RELATIVE + 3] = 0.0
        for a in range(3):
            half[a], b[_RELATIVE + a] = box[3 + a, c], relative[a]
    for k in range(_MISFIT):
        b[k] = edge[k]
    return int(careful)


class _Workspace(NamedTuple):
    """Working memory of a search.

    Stack of blocks to visit (256, 2); which of eight cells may hold the target (8,), and the slack
    (3,); position in a cell (3,), target relative to the cell's base (3,), and position of the
    least miss (3,); rows of `_invert` (6, 3); the interpolant's buffer; extent of a cell's values
    (3,); starts on either side of a fold (3, 3).
    """

    stack: IntArray
    inside: AnyArray
    slack: Array
    x: Array
    relative: Array
    nearest: Array
    work: Array
    b: Array
    half: Array
    sides: Array


@inlined
def _workspace() -> _Workspace:
    return _Workspace(
        np.zeros((_STACK, 2), np.int64),
        np.empty(8, np.bool_),
        np.zeros(3),
        np.empty(3),
        np.empty(3),
        np.empty(3),
        np.empty((6, 3)),
        np.zeros(_BUFFER),
        np.empty(3),
        np.empty((3, 3)),
    )


@vectorised
def seeds(tree: SearchTree, target: Array, found: Array, inverses: Array, quality: IntArray) -> int:
    """Find all contacts that may have the target's values, as chart coordinates (η, ψ, ρ).

    Fills ``found`` (n, 3), ``inverses`` (n, 3, 3), the derivatives by the quantities, and
    ``quality`` (n,): 2 solved, 1 nearly, 0 a guess. Returns their number, at most ``MOST_SEEDS``.
    """
    return _seeds(tree, target, found, inverses, quality, _workspace())


@vectorised
def _seeds(
    tree: SearchTree,
    target: Array,
    found: Array,
    inverses: Array,
    quality: IntArray,
    room: _Workspace,
) -> int:
    """Find seeds in given memory: arrays passed as arguments need no reference counting."""
    grid, place, cells = tree.grid, tree.place, tree.boxes[tree.offsets[-2] :]
    stack, inside, slack, x, relative, nearest, work, b, half, sides = room
    count = 0
    _set_target(tree, target, b)
    top, node = _next_cells(tree, target, slack, stack, 1, inside)
    while node >= 0:
        box = cells[node]
        for c in range(8):
            if not inside[c]:
                continue
            child = 8 * node + c
            careful = _load_cell(tree, child, box, c, target, relative, b, work, half, x)
            if careful < 0:
                continue
            least = np.inf
            missed = careful == 2 and place[child, 2] >= _RESTING
            for start in range(9 if careful > 0 else 1):  # from the located position, then corners
                if start > 0:
                    for a in range(3):
                        x[a] = (start - 1) >> a & 1
                solved = _invert(b, half, work, careful > 0, x)
                missed = missed and solved < 2
                if missed and work[5, 0] < least:
                    least = work[5, 0]
                    copy(x, nearest)
                if solved > 0 and not _points_opposite(b):
                    count = _add_seed(
                        grid, place[child], x, b, work, solved, found, inverses, quality, count
                    )
                if solved == 2 and careful < 2:
                    break
            if not missed or least > _LARGEST_MISS:
                continue
            if _fold_sides(b, half, nearest, work, sides):
                for side in range(2):
                    count = _add_seed(
                        grid,
                        place[child],
                        sides[side],
                        b,
                        work,
                        0,
                        found,
                        inverses,
                        quality,
                        count,
                    )
        top, node = _next_cells(tree, target, slack, stack, top, inside)
    return count


@inlined
def _near_cell(tree: SearchTree, cell: int, target: Array, slack: Array, x: Array) -> float:
    """Distance of the target beyond a cell, in units of the slack; -1 if it is more than that.

    x is set to the closest position in the cell.
    """
    frame, most = tree.frame[cell], 0.0
    for a in range(3):
        y, off = 0.0, 1e-300
        for q in range(3):
            y += frame[a, q] * _difference(tree, q, target[q], frame[3, q])
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
    stack, x, inside = np.zeros((_STACK, 2), np.int64), np.empty(3), np.empty(8, np.bool_)
    return _cells_around(tree, target, slack, cells, spots, away, stack, x, inside)


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
    inside: AnyArray,
) -> int:
    """List cells in given memory: arrays passed as arguments need no reference counting."""
    grid, place, count = tree.grid, tree.place, 0
    top, node = _next_cells(tree, target, slack, stack, 1, inside)
    while node >= 0:
        for c in range(8):
            child, miss = 8 * node + c, 0.0
            if not inside[c]:
                continue
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
        top, node = _next_cells(tree, target, slack, stack, top, inside)
    return count
