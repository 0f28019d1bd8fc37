"""Least squares over time: unknowns of each frame, and second differences that tie frames together.

The normal equations are block banded, two blocks wide on each side; they are solved by a banded
Cholesky factorisation, and the covariance of each frame comes from a forward and a backward
recursion over pairs of frames.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

Array = NDArray[np.float64]


class Smoother:
    """Normal equations of a trial."""

    def __init__(self, hessian: Array, gradient: Array) -> None:
        self.diagonal = hessian.copy()
        self.first = np.zeros_like(hessian)  # frame i with i + 1; all ties are diagonal
        self.second = np.zeros_like(hessian)
        self.gradient = gradient.copy()

    def add_at(self, values: Array, weight: Array, begin: int, target: Array) -> float:
        """Pull unknowns to a target."""
        m = values.shape[1]
        places = np.arange(begin, begin + m)
        self.diagonal[:, places, places] += weight
        self.gradient[:, places] += weight * (target - values)
        return float((weight * (values - target) ** 2).sum())

    def add_along(self, axis: Array, value: Array, begin: int, weight: float) -> float:
        """Pull one direction of three unknowns to zero."""
        part = slice(begin, begin + 3)
        self.diagonal[:, part, part] += weight**2 * axis[:, :, None] * axis[:, None, :]
        self.gradient[:, part] -= weight**2 * axis * value[:, None]
        return float(((weight * value) ** 2).sum())

    def add_second(self, i: int, value: Array, weight: Array) -> float:
        """Pull the second difference at a frame to zero."""
        square = weight**2
        n = np.arange(len(square))
        for j, factor in ((i - 1, 1.0), (i, 4.0), (i + 1, 1.0)):
            self.diagonal[j, n, n] += factor * square
        self.first[i - 1, n, n] -= 2.0 * square
        self.first[i, n, n] -= 2.0 * square
        self.second[i - 1, n, n] += square
        pull = square * value
        self.gradient[i - 1] -= pull
        self.gradient[i] += 2.0 * pull
        self.gradient[i + 1] -= pull
        return float((pull * value).sum())

    def solved(self, damping: float = 0.0) -> Array:
        """Solve for the step."""
        count, n, _ = self.diagonal.shape
        total = count * n
        band = np.zeros((3 * n, total))
        rows, columns = np.indices((n, n))
        for i in range(count):
            start = i * n
            lower = rows >= columns
            band[(rows - columns)[lower], start + columns[lower]] = self.diagonal[i][lower]
            if i + 1 < count:
                band[n + rows - columns, start + columns] = self.first[i].T
            if i + 2 < count:
                band[(2 * n + rows - columns), start + columns] = self.second[i].T
        band[0] += damping * band[0] + 1e-12 * band[0].max()
        step = solveh_banded(band, self.gradient.reshape(-1), lower=True)
        return np.asarray(step).reshape(count, n)

    def covariances(self) -> Array:
        """Invert, and keep what each frame has to do with itself."""
        count, n, _ = self.diagonal.shape
        pairs = (count + 1) // 2
        size = 2 * n
        middle = np.zeros((pairs, size, size))
        tie = np.zeros((pairs, size, size))
        for p in range(pairs):
            i = 2 * p
            middle[p, :n, :n] = self.diagonal[i]
            if i + 1 < count:
                middle[p, n:, n:] = self.diagonal[i + 1]
                middle[p, :n, n:] = self.first[i]
                middle[p, n:, :n] = self.first[i].T
            else:
                middle[p, n:, n:] = np.eye(n)
            if i + 2 < count:
                tie[p, :n, :n] = self.second[i]
                tie[p, n:, :n] = self.first[i + 1]
            if i + 3 < count:
                tie[p, n:, n:] = self.second[i + 1]
        middle += 1e-12 * middle.max() * np.eye(size)
        ahead, back = middle.copy(), middle.copy()
        for p in range(1, pairs):
            ahead[p] -= tie[p - 1].T @ np.linalg.solve(ahead[p - 1], tie[p - 1])
        for p in range(pairs - 2, -1, -1):
            back[p] -= tie[p] @ np.linalg.solve(back[p + 1], tie[p].T)
        inverse = np.linalg.inv(ahead + back - middle)
        blocks = np.stack([inverse[:, :n, :n], inverse[:, n:, n:]], axis=1)
        return blocks.reshape(2 * pairs, n, n)[:count]
