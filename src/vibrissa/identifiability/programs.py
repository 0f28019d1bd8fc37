"""Linear programs of climbs: how far a step within a box leads up, with what violations cost."""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array, kernel, solve

# By what an iteration shrinks the complementarity, how near to the faces it goes, and the
# complementarity at which it ends.
_SHRINK, _NEARLY, _DONE = 0.04, 0.97, 1e-12
_ITERATIONS = 25


@kernel
def steepest(levels: Array, slopes: Array, within: Array, cost: float, steps: Array) -> None:
    """Steps (n, 3) in boxes that raise the lower of two levels most, less the worst violation.

    ``levels`` (n, 2 + m) and their ``slopes`` (n, 3, 2 + m): the two, then margins that may not be
    negative but at a cost; ``within`` (n,): half widths of the boxes. A primal-dual interior
    method: unknowns are the step over the size of its box, the level reached t, and the worst
    violation e; maximised is t - cost·e.
    """
    n, m = levels.shape
    count = m + 7
    matrix, room = np.zeros((count, 5)), np.ones(count)
    slack, dual, target, ds = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    normal, x, dx, aim = np.empty((5, 5)), np.empty(5), np.empty(5), np.zeros(5)
    aim[3], aim[4] = 1.0, -cost
    for k in range(m):
        matrix[k, 3 if k < 2 else 4] = -1.0 if k < 2 else 1.0
    for a in range(3):
        matrix[m + a, a], matrix[m + 3 + a, a] = 1.0, -1.0
    matrix[m + 6, 4], room[m + 6] = 1.0, 0.0
    for row in range(n):
        least, worst = min(levels[row, 0], levels[row, 1]), 0.0
        for k in range(m):
            room[k] = (levels[row, k] - (least if k < 2 else 0.0)) / within[row]
            if k >= 2:
                worst = max(worst, -room[k])
            for a in range(3):
                matrix[k, a] = slopes[row, a, k]
        x[0] = x[1] = x[2] = 0.0
        x[3], x[4] = -1.0, 1.0 + worst
        for k in range(count):
            slack[k] = matrix[k, 3] * x[3] + matrix[k, 4] * x[4] + room[k]
            dual[k] = 1.0 / slack[k]
        for _ in range(_ITERATIONS):
            mean = 0.0
            for k in range(count):
                mean += slack[k] * dual[k] / count
            if mean < _DONE:
                break
            for a in range(5):
                dx[a] = aim[a]
                for c in range(5):
                    normal[a, c] = 0.0
            for k in range(count):
                target[k] = _SHRINK * mean / slack[k]
                weight = dual[k] / slack[k]
                for a in range(5):
                    dx[a] += matrix[k, a] * target[k]
                    for c in range(5):
                        normal[a, c] += weight * matrix[k, a] * matrix[k, c]
            if solve(normal, dx) == 0.0:
                break
            primal, other = 1.0, 1.0
            for k in range(count):
                ds[k] = 0.0
                for a in range(5):
                    ds[k] += matrix[k, a] * dx[a]
                target[k] -= dual[k] * (1.0 + ds[k] / slack[k])  # the step of the dual
                if ds[k] < 0.0:
                    primal = min(primal, -_NEARLY * slack[k] / ds[k])
                if target[k] < 0.0:
                    other = min(other, -_NEARLY * dual[k] / target[k])
            for a in range(5):
                x[a] += primal * dx[a]
            for k in range(count):
                slack[k] += primal * ds[k]
                dual[k] += other * target[k]
        for a in range(3):
            steps[row, a] = x[a] * within[row]
