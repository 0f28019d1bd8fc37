"""Boxes that cover a domain, halved until the signs of all conditions are certain on each.

A box is a row of integers: for each unknown a level and an index, so that it takes the part
[i, i + 1]/2^level of the domain's extent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import Array, IntArray

_BATCH = 2048
_MOST_HALVINGS = 3
_DEEPEST = 40

Evaluate = Callable[[Array], tuple[Array, Array]]


class Cover(NamedTuple):
    """Result of a search.

    Attributes
    ----------
    certified, undecided : (n, unknowns, 2) arrays
        Levels and indices of the boxes on which all signs are certain, and of the others.
    evaluated : int
        Number of boxes that were evaluated.
    refuted : array
        Bounds (unknowns, 2) of a box at whose centre a sign is certainly wrong; empty if none.
    """

    certified: IntArray
    undecided: IntArray
    evaluated: int
    refuted: Array


def bounds(boxes: IntArray, domain: Array) -> Array:
    """Bounds (n, unknowns, 2) of boxes in a domain (unknowns, 2)."""
    part = 2.0 ** (-boxes[..., 0].astype(np.float64))
    extent = domain[:, 1] - domain[:, 0]
    low = domain[:, 0] + extent * (boxes[..., 1] * part)
    high = domain[:, 0] + extent * ((boxes[..., 1] + 1) * part)
    high = np.where((boxes[..., 1] + 1) * part == 1.0, domain[:, 1], high)
    return np.stack([low, high], axis=-1)


def volume(boxes: IntArray) -> Array:
    """Share of the domain that each box takes."""
    return np.asarray(2.0 ** (-boxes[..., 0].sum(axis=-1).astype(np.float64)))


def cover(
    evaluate: Evaluate,
    domain: Array,
    start: IntArray | None = None,
    most: int = 10**6,
) -> Cover:
    """Halve boxes until all conditions are certainly positive on each.

    Parameters
    ----------
    evaluate : callable
        Function of bounds (n, unknowns, 2) that returns conditions (n, c, unknowns + 2), each a
        centre, the share of each unknown in its range and the remainder, and the relative widths
        (n, unknowns) of what they are computed from.
    domain : (unknowns, 2) array
        Bounds of the unknowns.
    start : (n, unknowns, 2) array, optional
        Boxes to begin with; by default the whole domain.
    most : int
        Largest number of boxes that are evaluated.

    Returns
    -------
    Cover
        Boxes, certified or not.
    """
    unknowns = len(domain)
    left = np.zeros((1, unknowns, 2), dtype=np.int64) if start is None else start
    done: list[IntArray] = []
    evaluated = 0
    while len(left) and evaluated < most:
        batch, left = left[-_BATCH:], left[:-_BATCH]
        found, widths = evaluate(bounds(batch, domain))
        evaluated += len(batch)
        centre, shares, rest = found[..., 0], found[..., 1:-1], found[..., -1]
        certain = (centre > (shares.sum(axis=-1) + rest) * (1.0 + 1e-12)).all(axis=-1)
        wrong = (centre < -rest).any(axis=-1)
        if wrong.any():
            bad = bounds(batch, domain)[np.flatnonzero(wrong)[0]]
            return Cover(_joined(done, unknowns), np.concatenate([left, batch]), evaluated, bad)
        done.append(batch[certain])
        open_ = ~certain
        left = np.concatenate([left, _halved(batch[open_], found[open_], widths[open_])])
    return Cover(_joined(done, unknowns), left, evaluated, np.zeros((0, unknowns, 2)))


def _joined(parts: list[IntArray], unknowns: int) -> IntArray:
    return np.concatenate([np.zeros((0, unknowns, 2), dtype=np.int64), *parts])


def _halvings(found: Array, widths: Array) -> IntArray:
    """How often each unknown is to be halved: where that is expected to make the signs certain."""
    n, unknowns = widths.shape
    times = np.zeros((n, unknowns), dtype=np.int64)
    known = np.asarray(np.isfinite(found).all(axis=(1, 2)))
    centre = np.where(known[:, None], found[..., 0], 1.0)
    shares = np.where(known[:, None, None], found[..., 1:-1], 1.0)
    rest = np.where(known[:, None], found[..., -1], 4.0)
    widths = np.where(known[:, None], widths, 1.0)
    for _ in range(_MOST_HALVINGS):
        scale = np.asarray(2.0 ** (-times.astype(np.float64)))
        now = (widths * scale).sum(axis=1) / widths.sum(axis=1)
        misses = (
            centre <= (shares * scale[:, None, :]).sum(axis=-1) + rest * (now**2)[:, None]
        ).any(axis=1)
        more = misses | (times.sum(axis=1) == 0)
        # The unknown that matters most to the worst condition, by its own share and its width.
        excess = (shares.sum(axis=-1) + rest) / np.maximum(np.abs(centre), 1e-300)
        worst = np.argmax(excess, axis=1)
        rows = np.arange(n)
        linear = shares[rows, worst] * scale
        quadratic = (rest[rows, worst] * now)[:, None] * (widths * scale)
        quadratic = quadratic / widths.sum(axis=1, keepdims=True)
        which = np.argmax(linear + 2.0 * quadratic, axis=1)
        times[rows[more], which[more]] += 1
    return times


def _halved(boxes: IntArray, found: Array, widths: Array) -> IntArray:
    """Parts of boxes."""
    if not len(boxes):
        return boxes
    times = _halvings(found, widths)
    parts = []
    for pattern in np.unique(times, axis=0):
        rows = boxes[(times == pattern).all(axis=1)]
        steps = np.stack(
            np.meshgrid(*[np.arange(2**k) for k in pattern], indexing="ij"), axis=-1
        ).reshape(-1, len(pattern))
        children = np.repeat(rows, len(steps), axis=0)
        children[..., 1] = children[..., 1] * 2**pattern + np.tile(steps, (len(rows), 1))
        children[..., 0] += pattern
        parts.append(children)
    return np.concatenate(parts)


def covers(boxes: IntArray) -> bool:
    """Whether boxes, rows of (level, index) by unknown, fill the unit cube: by halving it."""
    unknowns = boxes.shape[1]
    cells = [(np.zeros(unknowns, int), np.zeros(unknowns, int), np.arange(len(boxes)))]
    while cells:
        level, index, rows = cells.pop()
        if not len(rows):
            return False
        finer = boxes[rows, :, 0] > level
        if (~finer.any(axis=1)).any():
            continue
        axis = int(np.argmax(finer.sum(axis=0)))
        for half in (0, 1):
            lower, at = level.copy(), index.copy()
            lower[axis] += 1
            at[axis] = 2 * at[axis] + half
            own = boxes[rows, axis]
            shift = own[:, 0] - lower[axis]
            inside = np.where(shift >= 0, own[:, 1] >> np.maximum(shift, 0) == at[axis], True)
            cells.append((lower, at, rows[inside]))
    return True
