"""Equations of one cell of a search tree, by the cell's interpolant, and their solution.

Forces and moments vanish at rest in proportion to the force f = ρ² f*. So V = T / f is interpolated
instead, and the equations compare ratios: with t_p the largest of the targets t that vanish,

    V_j - (t_j / t_p) V_p = 0   and   ρ - √(t_p / V_p f*) = 0,

or V_p f - t_p = 0 in cells where V_p changes sign. Of a quantity that vanishes with the square of
the force, V = T / f² is interpolated, and the equation is V_j - (t_j / t_p²) V_p² = 0. The
interpolated f* is accurate to 1e-3; a last step uses f* itself.

In a cell where a vector of the plane may vanish (:class:`~vibrissa.rod.SearchTree`), its length
ℓ and direction β are not smooth, but its components v are. There the equations are

    both known: v - ℓ (cos β, sin β) = 0;   β alone: v × (cos β, sin β) = 0, v · (cos β, sin β) > 0;
    ℓ alone: (v · v - ℓ²) / 2R = 0, with R the largest |v| in the cell.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, IntArray, copy, inlined, solve3
from vibrissa.rod.chart import log_fold_force
from vibrissa.rod.tree import EVEN, FOLDED, SearchTree

# Distance (in cell widths) outside a cell within which a solution still counts as the cell's:
# neighbours overlap.
_OVERLAP = 0.05
# Miss of the interpolant (over the cell's extent) up to which the map itself may attain the target.
_NEARLY = 0.02
# Distance (in cell widths) from a miss of a fold of the starts on either side of it.
_SIDE = 0.2
# Distance from the middle of a cell (in cell widths) beyond which a first step leaves it; and the
# same if the cell may contain a fold and is less linear.
_REACH, _REACH_CAREFUL = 1.3, 4.0
# Cells from rest in which signals that are not interpolated over the force are far from linear, and
# misses are common without a fold.
_RESTING = 3
# Longest step (in cell widths), and the share of the squared slopes by which a first one that
# leaves the cell is damped: it mostly follows the direction that is determined least.
_LONGEST, _DAMPING = 0.6, 0.01
# Miss of the linear equations (over the cell's extent) beyond which a damped step leaves the cell.
_FAR = 0.5
# Step (in cell widths) below which the next one, about its square, is the last: if there is one
# solution at most, and if two may be close together.
_LAST, _LAST_CAREFUL = 0.02, 0.002
# Linear equations with a determinant below this share of the product of their rows are singular.
_SINGULAR = 1e-3

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
# For quantities that vanish at rest: index of the one that determines the force (-1 if none) and
# its target; the targets over powers of that one, 0 for the others; ρ of the cell's near side, in
# cells, and whether that quantity has one sign in the cell; the last root of the force, and value
# and slopes of the quantity over the force.
_PIVOT = _ALONG + 1
_SHARES = _PIVOT + 2
_LAYER = _SHARES + 4
_SIGNED = _LAYER + 1
_ROOT = _SIGNED + 1
_HELD = _ROOT + 1
# For each target: the others over powers of it and, at its own index, its root.
_AIMS = _HELD + 4
# Whether each quantity vanishes with the square of the force.
_SQUARE = _AIMS + 9
CELL_BUFFER = _SQUARE + 4


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
def _compare(b: Array, x: Array) -> None:
    """Convert the interpolant in the buffer to equations; see the module."""
    p = int(b[_PIVOT])
    if p < 0:
        return
    value, by_x, by_y = b[_MISFIT + p], b[_SLOPES + p], b[_SLOPES + 4 + p]
    by_z = b[_SLOPES + 8 + p]
    for q in range(4):
        power = 1.0 + b[_SQUARE + q] * (value - 1.0)
        share = b[_SHARES + q] * (power + b[_SQUARE + q] * value)
        b[_MISFIT + q] -= b[_SHARES + q] * power * value
        b[_SLOPES + q] -= share * by_x
        b[_SLOPES + 4 + q] -= share * by_y
        b[_SLOPES + 8 + q] -= share * by_z
    b[_HELD], b[_HELD + 1], b[_HELD + 2], b[_HELD + 3] = value, by_x, by_y, by_z
    wide, rho = b[_MISFIT + 3], b[_LAYER] + x[2]
    root = rho / wide
    if b[_SIGNED] != 0.0:
        root = np.sqrt(max(b[_PIVOT + 1] / value, 0.0))
        b[_MISFIT + p], rise, by_force, by_root = (
            rho - root * wide,
            1.0,
            0.5 * root * wide / value,
            root,
        )
    else:
        b[_MISFIT + p] = root * root * value - b[_PIVOT + 1]
        by_root = 2.0 * root * root * value / wide
        rise, by_force = 2.0 * root * value / wide, root * root
    b[_SLOPES + p] = by_force * by_x - by_root * b[_SLOPES + 3]
    b[_SLOPES + 4 + p] = by_force * by_y - by_root * b[_SLOPES + 7]
    b[_SLOPES + 8 + p] = rise + by_force * by_z - by_root * b[_SLOPES + 11]
    b[_ROOT] = root


@inlined
def _evaluate(b: Array, x: Array) -> None:
    """Compute the cell's equations and their derivatives by x; left in the buffer."""
    _interpolate(b, x)
    largest = b[_TARGET + 3]
    if largest == 0.0:
        _compare(b, x)
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
def turned_difference(tree: SearchTree, q: int, target: float, base: float) -> float:
    """Difference of target and base; that of angles is wrapped to half a turn."""
    d = target - base
    return float(d - 2.0 * np.pi * np.rint(d * tree.turns[q]))


@inlined
def set_target(tree: SearchTree, target: Array, b: Array) -> None:
    """Write the target's length and direction, which polar cells need, into the buffer."""
    length, direction = tree.vector.roles[0], tree.vector.roles[1]
    b[_TARGET] = b[_TARGET + 1] = b[_TARGET + 3] = 0.0
    if direction >= 0:
        b[_TARGET], b[_TARGET + 1] = np.cos(target[direction]), np.sin(target[direction])
    b[_TARGET + 2] = target[length] if length >= 0 else -1.0
    pivot, most = -1, 0.0
    for q in range(3):
        scale = tree.scale[q]
        if tree.powers[q] == 1 and abs(target[q]) > most * scale:
            pivot, most = q, abs(target[q]) / scale
    b[_PIVOT], b[_SHARES + 3], b[_SQUARE + 3], b[_ROOT] = pivot, 0.0, 0.0, 1.0
    for q in range(3):
        square = tree.powers[q] == 2
        b[_SHARES + q], b[_SQUARE + q] = 0.0, 1.0 if square else 0.0
        for p in range(3):
            aim = np.sqrt(abs(target[p]))
            if p != q:
                aim = target[q] / (target[p] * target[p] if square else target[p])
            b[_AIMS + 3 * p + q] = aim
        if pivot >= 0 and q != pivot and tree.powers[q] > 0:
            b[_SHARES + q] = b[_AIMS + 3 * pivot + q]
    if pivot >= 0:
        b[_PIVOT + 1] = target[pivot]


@inlined
def _set_polar_target(tree: SearchTree, row: int, target: Array, b: Array) -> None:
    """Write the target relative to a polar cell's base into the buffer."""
    frame = tree.vector.frame[row]
    b[_RELATIVE], b[_RELATIVE + 1] = -frame[0], -frame[1]
    for n in range(2):
        q = tree.vector.roles[2 + n]
        b[_RELATIVE + 2 + n] = (
            turned_difference(tree, q, target[q], frame[2 + n]) if q >= 0 else 0.0
        )


@inlined
def _locate_polar(tree: SearchTree, row: int, b: Array, work: Array, x: Array) -> bool:
    """Whether a polar cell in the buffer may contain the target; if so, x is set to about where.

    If the direction is known, the equations are linear in the components and the other quantities:
    E T = E target. T is a linear function of x plus a remainder within bounds, so a solution is
    within bounds of that of the linear part.
    """
    linear = tree.vector.linear[row]
    cos, sin, length = b[_TARGET], b[_TARGET + 1], b[_TARGET + 2]
    x[0] = x[1] = x[2] = 0.5
    if cos == 0.0 and sin == 0.0:
        return True
    if tree.vector.lever.shape[0] > 0:
        lever = tree.vector.lever[row]
        moment = b[_RELATIVE + 2] + tree.vector.frame[row, 2]
        off = abs(length * (lever[0] * sin - lever[1] * cos) - moment)
        if off > length * (lever[2] * abs(sin) + lever[3] * abs(cos)) + 1e-12:
            return False
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
    volumes = tree.vector.volumes[row]
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
def _locate(tree: SearchTree, cell: int, target: Array, b: Array, x: Array) -> bool:
    """Whether a cell may contain the target; if so, x is set to about where."""
    frame, pivot = tree.blown[cell], tree.pivot[cell]
    p = abs(pivot) - 1
    if pivot != 0 and target[p] * pivot <= 0.0:
        return False
    for q in range(3):
        aim = target[q]
        if p >= 0 and tree.powers[q] > 0:
            aim = b[_AIMS + 3 * p + q]
        b[_RELATIVE + q] = turned_difference(tree, q, aim, frame[3, q])
    r0, r1, r2 = b[_RELATIVE], b[_RELATIVE + 1], b[_RELATIVE + 2]
    for a in range(3):
        y = frame[a, 0] * r0 + frame[a, 1] * r1 + frame[a, 2] * r2
        if y < frame[4, a] or y > frame[5, a]:
            return False
        x[a] = min(max(y, 0.0), 1.0)
    if p < 0 and b[_PIVOT] >= 0.0:
        layer = tree.place[cell, 2]
        x[2] = np.sqrt(layer * layer + x[2] * (2.0 * layer + 1.0)) - layer
    return True


@inlined
def _damped_step(b: Array, half: Array, x: Array, rows: Array, step: Array) -> float:
    """Fill a step that is short in directions that hardly matter; return what it would miss.

    The miss is that of the linear equations, over the cell's extent, nearest to it in the cell.
    """
    right, size, most = np.empty(3), 0.0, 0.0
    for a in range(3):
        right[a] = 0.0
        for q in range(3):
            by, scale = b[_SLOPES + 4 * a + q], 1.0 / (half[q] * half[q])
            right[a] += by * b[_MISFIT + q] * scale
            size += by * by * scale
    for a in range(3):
        for c in range(3):
            rows[a, c] = _DAMPING * size if a == c else 0.0
            for q in range(3):
                scale = 1.0 / (half[q] * half[q])
                rows[a, c] += b[_SLOPES + 4 * a + q] * b[_SLOPES + 4 * c + q] * scale
    solve3(rows, right, step)
    for q in range(3):
        miss = b[_MISFIT + q]
        for a in range(3):
            miss += b[_SLOPES + 4 * a + q] * (min(max(x[a] - step[a], 0.0), 1.0) - x[a])
        most = max(most, abs(miss) / half[q])
    return most


@inlined
def invert(b: Array, half: Array, work: Array, careful: bool, patient: bool, x: Array) -> int:
    """Solve a cell's interpolant: 2 solved, 1 nearly so (a fold of the map), 0 not in the cell.

    If ``patient``, the search goes on where only a direction that is hardly determined leads out of
    the cell. If not solved, x is left where the miss is least: work[5, 0] of the cell's extent.
    """
    rows, step, best = work[:3], work[3], work[4]
    least, done, left, farthest, last = np.inf, False, False, _REACH, _LAST
    if careful:
        farthest, last = _REACH_CAREFUL, _LAST_CAREFUL
        resting = b[_LAYER] < _RESTING
        if resting or b[_TARGET + 3] > 0.0:  # polar
            farthest, last = np.inf, _LAST
    work[5, 0] = np.inf
    for n in range(9):
        _evaluate(b, x)
        if done:
            return 2 if b[_ROOT] > 0.0 else 0
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
        if n == 0:  # the first step shows whether it is in this cell
            reach = max(
                abs(x[0] - step[0] - 0.5), abs(x[1] - step[1] - 0.5), abs(x[2] - step[2] - 0.5)
            )
            if reach > farthest:
                if not patient or _damped_step(b, half, x, rows, step) > _FAR:
                    return 0
                left, size = True, max(abs(step[0]), abs(step[1]), abs(step[2]))
        shorten = min(1.0, _LONGEST / max(size, 1e-300))
        for a in range(3):
            x[a] = min(max(x[a] - shorten * step[a], -0.5), 1.5)
        if size < last:
            if _outside(x) > _OVERLAP:
                return 0
            done = True
    for a in range(3):
        x[a] = best[a]
    # After a damped step the miss was least along the valley, not at a fold.
    work[5, 0] = least if _outside(x) <= 0.25 and not left else np.inf
    return 1 if least <= _NEARLY and _outside(x) <= 0.25 else 0


@inlined
def points_opposite(b: Array) -> bool:
    """Whether a polar cell's vector, as last interpolated, points opposite to the target."""
    directed = b[_TARGET] != 0.0 or b[_TARGET + 1] != 0.0
    polar = b[_TARGET + 3] > 0.0 and directed and b[_TARGET + 2] < 0.0
    return bool(polar and b[_ALONG] < -_NEARLY * b[_TARGET + 3])


@inlined
def fold_sides(b: Array, half: Array, x: Array, work: Array, sides: Array) -> bool:
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
def refine(tree: SearchTree, place: IntArray, b: Array, work: Array, x: Array) -> float:
    """Take a last step from x with the exact fold force; leave ∂x/∂T in work and return det."""
    grid, p = tree.grid, int(b[_PIVOT])
    force = 1.0
    if p >= 0:
        eta, psi = grid[1, 0] * (place[0] + x[0]), grid[1, 1] * (place[1] + x[1])
        log, by_eta, by_psi = log_fold_force(tree.fold, eta, psi)
        rho, strength, value = grid[1, 2] * (place[2] + x[2]), np.exp(log), b[_HELD]
        force = rho * rho * strength
        b[_MISFIT + p] = force * value - b[_PIVOT + 1]
        b[_SLOPES + p] = force * (b[_HELD + 1] + value * by_eta * grid[1, 0])
        b[_SLOPES + 4 + p] = force * (b[_HELD + 2] + value * by_psi * grid[1, 1])
        b[_SLOPES + 8 + p] = force * b[_HELD + 3] + 2.0 * rho * strength * value * grid[1, 2]
    det = _adjugate(b, work)
    if det == 0.0:
        return 0.0
    inverse = 1.0 / det
    for a in range(3):
        for c in range(3):
            work[a, c] *= inverse
        x[a] -= work[a, 0] * b[_MISFIT] + work[a, 1] * b[_MISFIT + 1] + work[a, 2] * b[_MISFIT + 2]
        for c in range(3):
            if tree.powers[c] > 0 and c != p:
                share = b[_SHARES + c]
                work[a, c] /= force
                if tree.powers[c] == 2:
                    work[a, c] /= force
                    share *= 2.0 * b[_PIVOT + 1]
                work[a, p] -= work[a, c] * share
    return det


@inlined
def load_cell(
    tree: SearchTree,
    cell: int,
    box: Array,
    c: int,
    target: Array,
    b: Array,
    work: Array,
    half: Array,
    x: Array,
) -> int:
    """Load a cell into the buffer; return the number of starts it needs (see `SearchTree.care`).

    Returns -1 if the target cannot be in the cell.
    """
    row = tree.polar[cell]
    b[_LAYER] = tree.place[cell, 2]
    if row >= 0:
        _set_polar_target(tree, row, target, b)
        if not _locate_polar(tree, row, b, work, x):
            return -1
        careful, edge = _polar_care(tree, row, b), tree.vector.edges[row]
        b[_TARGET + 3], b[_ROOT] = tree.vector.frame[row, 7], 1.0
        for a in range(3):
            half[a] = tree.vector.frame[row, 4 + a]
    else:
        if not _locate(tree, cell, target, b, x):
            return -1
        careful, edge = tree.care[cell], tree.edges[cell]
        b[_TARGET + 3] = b[_RELATIVE + 3] = 0.0
        extent, pivot = tree.blown[cell, 6], int(b[_PIVOT])
        for q in range(3):
            if tree.powers[q] > 0:
                share = abs(b[_SHARES + q])
                if tree.powers[q] == 2:
                    share *= 2.0 * abs(edge[pivot]) + extent[pivot]
                b[_RELATIVE + q] = 0.0
                half[q] = extent[q] + share * extent[pivot]
            else:
                half[q] = box[3 + q, c]
        if pivot >= 0:
            b[_SIGNED] = tree.pivot[cell]
            half[pivot] = 1.0 if tree.pivot[cell] != 0 else box[3 + pivot, c]
    for k in range(_MISFIT):
        b[k] = edge[k]
    return int(careful)


@inlined
def may_be_folded(careful: int, b: Array) -> bool:
    """Whether a miss of the loaded cell may be that of a fold."""
    return bool(careful == 2 and (b[_PIVOT] >= 0.0 or b[_LAYER] >= _RESTING))


@inlined
def is_polar(b: Array) -> bool:
    """Whether the loaded cell is polar."""
    return bool(b[_TARGET + 3] > 0.0)
