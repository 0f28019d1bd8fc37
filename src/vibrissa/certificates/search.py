"""Cover of a domain by boxes, subdivided until the signs of all conditions are proved on each.

A box is a row of integers, a level and an index for each unknown: it occupies the part
[i, i + 1]/2^level of the domain's extent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vibrissa.numerics import AnyArray, Array, IntArray

_BATCH = 2048
_MOST_HALVINGS = 3
_REMAINDER = 4  # remainders decrease at least with this power of a box's size
_CLEAR = 0.1  # largest remainder, relative to a condition, for which one halving suffices
_LONGER = 4  # how many more halvings arc length gets than other unknowns where nothing is enclosed

Evaluate = Callable[[IntArray], tuple[Array, Array]]


class Cover(NamedTuple):
    """Boxes on which all signs are proved, undecided ones, and one with a wrong sign if found."""

    certified: IntArray
    undecided: IntArray
    evaluated: int
    refuted: IntArray


def bounds(boxes: IntArray, domain: Array, stations: Array) -> Array:
    """Bounds (n, unknowns, 2) of boxes in a domain (unknowns, 2).

    The first unknown is interpolated between stations, 2^k + 1 of them with equal shares, so that
    boxes can end where the whisker's polynomials do.
    """
    part = 2.0 ** (-boxes[..., 0].astype(np.float64))
    share = np.stack([boxes[..., 1] * part, (boxes[..., 1] + 1) * part], axis=-1)
    out = domain[:, :1] + (domain[:, 1:] - domain[:, :1]) * share
    out = np.where(share == 1.0, domain[:, 1:], out)
    if domain[0, 0] < domain[0, 1]:
        cell, inside = np.divmod(share[:, 0] * (len(stations) - 1), 1.0)
        low = cell.astype(np.int64)
        high = np.minimum(low + 1, len(stations) - 1)
        out[:, 0] = stations[low] + (stations[high] - stations[low]) * inside
    return np.asarray(out)


def volume(boxes: IntArray) -> Array:
    """Share of the unit cube that each box occupies."""
    return np.asarray(2.0 ** (-boxes[..., 0].sum(axis=-1).astype(np.float64)))


def cover(
    evaluate: Evaluate, start: IntArray, most: int = 10**6, free: AnyArray | None = None
) -> Cover:
    """Subdivide boxes until all conditions are proved to be positive on each.

    ``evaluate`` returns conditions (n, c, unknowns + 3), each a centre, the contributions of each
    unknown and of their products to its range, and the remainder; and the relative widths
    (n, unknowns) of the quantities from which they are computed. About ``most`` boxes are
    evaluated; ``free`` marks the unknowns that may be subdivided.
    """
    left, none = start, start[:0]
    free = np.ones(start.shape[1], dtype=bool) if free is None else free
    done: list[IntArray] = [none]
    evaluated = 0
    while len(left) and evaluated < most:
        batch, left = left[-_BATCH:], left[:-_BATCH]
        found, widths = evaluate(batch)
        evaluated += len(batch)
        centre, rest = found[..., 0], found[..., -1]
        certain = (centre > found[..., 1:].sum(axis=-1) * (1.0 + 1e-12)).all(axis=-1)
        wrong = np.flatnonzero((centre < -rest).any(axis=-1))
        if wrong.size:
            bad = batch[wrong[:1]]
            return Cover(np.concatenate(done), np.concatenate([left, batch]), evaluated, bad)
        done.append(batch[certain])
        open_ = ~certain
        blurred = open_ & ~(rest < np.abs(centre)).all(axis=-1)
        times = np.zeros(widths.shape, dtype=np.int64)
        clear = open_ & ~blurred
        times[clear] = _halvings_by_estimate(found[clear], widths[clear] * free)
        times[blurred] = _halvings_by_trial(evaluate, batch[blurred], free)
        left = np.concatenate([left, _subdivide(batch[open_], times[open_])])
    return Cover(np.concatenate(done), left, evaluated, none)


def _halvings_by_trial(evaluate: Evaluate, boxes: IntArray, free: AnyArray) -> IntArray:
    """Number of halvings of each unknown for boxes with large remainders, by trial evaluations.

    Along each unknown, a quarter of the box at its middle is evaluated. Where none can be enclosed,
    the arc length is halved, because steps of the rod are longer than the contacts are spread,
    unless it has been halved much more often than the others; then all are.
    """
    number, unknowns = boxes.shape[:2]
    blur = np.full((number, unknowns), np.inf)
    for a in np.flatnonzero(free) if number else ():
        inner = boxes.copy()
        inner[:, a] = inner[:, a] * [1, 4] + [2, 1]
        found, _ = evaluate(inner)
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.abs(found[..., -1] / found[..., 0]).max(axis=1)
        blur[:, a] = np.where(np.isfinite(share), share, np.inf)
    best = np.argmin(blur, axis=1)
    least = blur[np.arange(number), best]
    axes = np.eye(unknowns, dtype=np.int64)
    times: IntArray = np.where(least < _CLEAR, 1, 2)[:, None] * axes[best]
    none, level = ~np.isfinite(least), boxes[..., 0]
    times[none] = free.astype(np.int64)
    if free[0]:
        long = level[:, 0] < level[:, 1:].max(axis=1) + _LONGER
        times[none & long] = 2 * axes[0]
    return times


def _halvings_by_estimate(found: Array, widths: Array) -> IntArray:
    """Number of halvings of each unknown that is expected to make the signs certain."""
    n, unknowns = widths.shape
    times = np.zeros((n, unknowns), dtype=np.int64)
    centre, curved, rest = found[..., 0], found[..., -2], found[..., -1]
    shares = found[..., 1:-2]
    for _ in range(_MOST_HALVINGS):
        scale = np.asarray(2.0 ** (-times.astype(np.float64)))
        now = ((widths * scale).sum(axis=1) / widths.sum(axis=1))[:, None]
        beyond = curved * now**2 + rest * now**_REMAINDER
        linear = shares * scale[:, None, :]
        more = (centre <= linear.sum(axis=-1) + beyond).any(axis=1) | (times.sum(axis=1) == 0)
        # The unknown that contributes most to the worst condition, directly and through its width.
        excess = (linear.sum(axis=-1) + beyond) / np.maximum(np.abs(centre), 1e-300)
        rows, worst = np.arange(n), np.argmax(excess, axis=1)
        gain = 2.0 * curved * now**2 + _REMAINDER * rest * now**_REMAINDER
        part = widths * scale / (widths * scale).sum(axis=1, keepdims=True)
        which = np.argmax(linear[rows, worst] + gain[rows, worst][:, None] * part, axis=1)
        times[rows[more], which[more]] += 1
    return times


def _subdivide(boxes: IntArray, times: IntArray) -> IntArray:
    """Subdivide boxes, each by its number of halvings."""
    parts = [boxes[:0]]
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
