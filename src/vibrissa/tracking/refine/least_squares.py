"""Least squares over time, and variances of traces from residuals.

Each frame has its own unknowns, and second differences couple frames. The normal equations are
block banded, with two blocks on each side; they are solved by a banded Cholesky factorisation, and
the covariance of each frame follows from a forward and a backward recursion over pairs of frames.

The standard deviations of a trace come from the noise of its image. They do not contain the effects
of compression, blur or a pattern of the background, whose errors are alike in neighbouring points.
Such errors look like a slightly different rod, so the fit follows most of them, and neither size
nor correlation of the residuals r are those of the errors e. With derivatives D and covariance C of
the unknowns,

    r = R e,   R = 1 − D C Dᵀ,   ⟨r rᵀ⟩ = σ² R V Rᵀ,   V_jk = exp(−|j − k|/ℓ)  in each view.

The length ℓ is the one with which the diagonals of R V Rᵀ are in the same proportions as those of
the residuals, and the variance of traces, relative to the stated one, is

    v = τ Σ r² / tr(R V Rᵀ),    τ = coth(1/2ℓ),

with τ the number of neighbouring points that count as one. A frame that fits worse than usual is
trusted less, and so is such a part of the whisker.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vibrissa.deferred import linalg
from vibrissa.numerics import Array

# Share of the largest element that is added to diagonals, so that they can be factorised.
_REGULAR = 1e-12
_FREE = 0.1  # smallest share of the errors that residuals show, however many numbers are fitted
# Lengths over which errors are correlated that are tried, and largest lag compared, points; number
# of frames for which it is computed what the fit follows.
_LENGTHS, _LAGS, _FRAMES = (0.1, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 8.0), 12, 24
_ODD = 4.0  # mean square of a frame's residuals, over the usual one, above which it is scaled down
_NEAR = 2  # number of points to each side over which the variance along a trace is averaged


class Smoother:
    """Normal equations of a trial."""

    def __init__(self, hessian: Array, gradient: Array) -> None:
        self.diagonal = hessian.copy()
        self.first = np.zeros_like(hessian)  # frame i with i + 1; all couplings are diagonal
        self.second = np.zeros_like(hessian)
        self.gradient = gradient.copy()

    def add_at(self, values: Array, weight: Array, begin: int, target: Array) -> Array:
        """Pull unknowns, from index ``begin`` on, to a target; return the cost of each frame."""
        places = np.arange(begin, begin + values.shape[1])
        self.diagonal[:, places, places] += weight
        self.gradient[:, places] += weight * (target - values)
        return np.asarray((weight * (values - target) ** 2).sum(axis=1))

    def add_row(self, i: int, row: Array, value: float) -> float:
        """Pull a combination of a frame's unknowns to zero; return the cost."""
        self.diagonal[i] += np.outer(row, row)
        self.gradient[i] -= row * value
        return value**2

    def add_along(self, axis: Array, value: Array, begin: int, weight: float) -> Array:
        """Pull one direction of three unknowns to zero; return the cost of each frame."""
        part = slice(begin, begin + 3)
        self.diagonal[:, part, part] += weight**2 * axis[:, :, None] * axis[:, None, :]
        self.gradient[:, part] -= weight**2 * axis * value[:, None]
        return np.asarray((weight * value) ** 2)

    def add_second(self, at: NDArray[np.intp], values: Array, weight: Array) -> Array:
        """Pull second differences (n, unknown) at some frames to zero; return the cost of each."""
        square = weight**2
        n = np.arange(square.shape[1])
        pull = square * values
        for shift, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            self.diagonal[(at + shift)[:, None], n, n] += factor**2 * square
            self.gradient[at + shift] -= factor * pull
        for before in (at - 1, at):
            self.first[before[:, None], n, n] -= 2.0 * square
        self.second[(at - 1)[:, None], n, n] += square
        return np.asarray((pull * values).sum(axis=1))

    def solved(self, damping: float | Array = 0.0) -> Array:
        """Solve for the step (time, unknown), damped by a share (time,) of the diagonal."""
        return np.asarray(self.responses(self.gradient[None], damping)[0])

    def responses(self, pulls: Array, damping: float | Array = 0.0) -> Array:
        """Steps (pull, time, unknown) in response to pulls on the unknowns."""
        count, n, _ = self.diagonal.shape
        band = np.zeros((3 * n, count, n))
        rows, columns = np.indices((n, n))
        lower = rows >= columns
        row, column = rows[lower], columns[lower]
        band[row - column, :, column] = self.diagonal[:, row, column].T
        for ahead, tie in ((1, self.first), (2, self.second)):
            each = np.moveaxis(tie[: count - ahead], 0, -1)  # (column, row, time)
            band[ahead * n + rows - columns, : count - ahead, columns] = np.swapaxes(each, 0, 1)
        band = band.reshape(3 * n, count * n)
        damped = np.repeat(np.broadcast_to(damping, count), n)
        band[0] += damped * band[0] + _REGULAR * band[0].max()
        step = linalg.solveh_banded(band, pulls.reshape(len(pulls), -1).T, lower=True)
        return np.asarray(step.T).reshape(len(pulls), count, n)

    def covariances(self) -> Array:
        """Blocks (time, unknown, unknown) on the diagonal of the inverse."""
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
        middle += _REGULAR * middle.max() * np.eye(size)
        ahead, back = middle.copy(), middle.copy()
        for p in range(1, pairs):
            ahead[p] -= tie[p - 1].T @ np.linalg.solve(ahead[p - 1], tie[p - 1])
        for p in range(pairs - 2, -1, -1):
            back[p] -= tie[p] @ np.linalg.solve(back[p + 1], tie[p].T)
        inverse = np.linalg.inv(ahead + back - middle)
        blocks = np.stack([inverse[:, :n, :n], inverse[:, n:, n:]], axis=1)
        return blocks.reshape(2 * pairs, n, n)[:count]


def trace_variance(
    misses: Sequence[Array],
    designs: Sequence[Array],
    covariance: Array,
    least: float,
    even: bool = False,
) -> list[Array]:
    """Variances (time, point) of each view's traces, relative to the stated ones.

    ``misses`` are the residuals (time, point) of each view, ``designs`` their derivatives (time,
    point, unknown) and ``covariance`` that of each frame's unknowns; no variance is below
    ``least``. The variance varies along the whisker, since a tip is often less accurate than
    stated, unless it is to be ``even``. Two further points are the ends.
    """
    known = [one != 0.0 for one in misses]
    square = np.sum([(one**2).sum(axis=1) for one in misses], axis=0)
    count = np.sum([one.sum(axis=1) for one in known], axis=0)
    shown = count > 0
    if not square[shown].any():
        return [np.ones((len(one), one.shape[1] + 2)) for one in misses]
    # Most frames are right, and so is their median.
    usual = float(np.median(square[shown] / count[shown]))
    each = np.maximum(square / np.maximum(count, 1), usual)
    along = [np.ones(one.shape[1]) for one in misses]
    if not even:
        for share, one, at in zip(along, misses, known, strict=True):
            total, number = _neighbours((one**2).T @ (1.0 / each)), _neighbours(at.sum(axis=0))
            np.divide(total, number, out=share, where=total > 0.0)
    miss, design = (np.concatenate(parts, axis=1) for parts in (misses, designs))
    size = np.sqrt(np.concatenate(along))
    some = np.flatnonzero(shown)
    some = some[np.linspace(0, len(some) - 1, min(_FRAMES, len(some))).astype(int)]
    follows = design[some] @ covariance[some] @ np.swapaxes(design[some], 1, 2)
    odd = np.sqrt(np.maximum(each / (_ODD * usual), 1.0))[:, None]
    follows = follows * size / size[:, None]
    together, left = _correlation(miss / (odd * size), some, follows, len(misses))
    variance = together * each / left
    return [np.maximum(np.outer(variance, [*share, 1.0, 1.0]), least) for share in along]


def _correlation(
    miss: Array, some: NDArray[np.intp], follows: Array, views: int
) -> tuple[float, float]:
    """Number of neighbouring errors that count as one, and the share of them in the residuals.

    The fit ``follows`` errors (some, point, point) of some of the frames.
    """
    n = miss.shape[1] // views
    known = (miss[some] != 0.0).astype(np.float64)
    remains = known[:, :, None] * (np.eye(views * n) - follows) * known[:, None]
    lags = range(min(_LAGS, n // 2) + 1)

    def diagonals(moments: Array) -> Array:
        within = np.einsum("vivj->ij", moments.reshape(views, n, views, n))
        return np.array([np.trace(within, offset=lag) for lag in lags])

    shown = diagonals(miss.T @ miss)
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    best = (np.inf, 1.0, 1.0)
    for length in _LENGTHS:
        errors = np.kron(np.eye(views), np.exp(-apart / length))
        moments = diagonals((remains @ errors @ np.swapaxes(remains, 1, 2)).sum(axis=0))
        differs = float(((shown / shown[0] - moments / moments[0]) ** 2).sum())
        left = float(moments[0] / known.sum())
        best = min(best, (differs, 1.0 / float(np.tanh(0.5 / length)), max(left, _FREE)))
    return best[1:]


def _neighbours(numbers: Array) -> Array:
    """Sums over each number and its neighbours."""
    return np.convolve(numbers, np.ones(2 * _NEAR + 1), mode="same")
