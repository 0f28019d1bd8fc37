"""Nodes of the chart as a coarse sample of the posterior, with the search tree of cells; compiled.

The nodes complement the candidates: those nearest to a measurement are starting points, and all
probable nodes together show how much probability lies outside the candidates' regions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vibrissa.contacts.contacts import LEFT, THREE_SIGMA
from vibrissa.contacts.sensing.channels import CHANNELS, CIRCULAR, channels_of
from vibrissa.contacts.uncertainty.posterior import second_moment, squared_distances
from vibrissa.numerics import Array, IntArray, cholesky, inlined, mahalanobis, quick_exp, vectorised
from vibrissa.rod import Charted, Rod, SearchTree, StableSet, charted_rod

#: Parts of the chart; the nearest node of each is a starting point.
PARTS = 16
_PARTS_BY_AXIS = (4, 4, 1)
# Blocks of nodes along each axis of the chart; a block that is too far away is skipped as a whole.
_BLOCKS = (4, 8, 4)
# Effective number of nodes from which their moments replace those about one contact.
_MANY = 30.0
# Largest factor by which a covariance is widened, and bisections to find it.
_WIDEST, _BISECTIONS = 8.0, 8
_MOST_LOG = 700.0
# Nodes whose χ² exceeds that of the best candidate by more are neglected: ten thousand of them
# together have a ten thousandth of the candidate's likelihood.
_NEGLIGIBLE = 36.0


class Searched(NamedTuple):
    """Search tree, nodes of the chart and their channels, non-dimensional.

    The nodes are sorted into blocks. ``blocks`` (n + 1,) is the first node of each; ``extent``
    (4, q, n) contains the middle and half width of the channels within each, and the smallest and
    largest of the ``sizes`` of vectors, on which the noise of directions depends.
    """

    charted: Charted
    proximal: float
    tree: SearchTree
    where: IntArray
    codes: Array
    contacts: Array
    values: Array
    seen: Array
    sizes: Array
    turns: Array
    kinds: IntArray
    part: IntArray
    volume: Array
    blocks: IntArray
    extent: Array

    @classmethod
    def none(cls, rod: Rod) -> Searched:
        """Return an instance without nodes, as an example of the types."""
        one, two, three = (np.empty((0,) * n) for n in (1, 2, 3))
        count, tree = np.empty(0, np.int64), SearchTree.none()
        charted = Charted(rod, tree.fold, np.empty((0, 0, 0, 0)))
        nodes = one, two, two, two, two, one, count, count, one, count, three
        return cls(charted, 0.0, tree, count, *nodes)


def searched(
    chart: StableSet,
    tree: SearchTree,
    where: Sequence[int],
    codes: Sequence[int],
    seen: Array,
    sizes: Array,
    turns: Array,
    kinds: Sequence[int],
) -> Searched:
    """Combine a chart, its tree and the channels (q, nodes) at its nodes; sort the nodes."""
    block = _cut(chart, _BLOCKS)
    order = np.argsort(block, kind="stable")
    blocks = np.searchsorted(block[order], np.arange(math.prod(_BLOCKS) + 1))
    seen, sizes = (np.ascontiguousarray(a[:, order]) for a in (seen, sizes))
    away = seen - np.repeat(seen[:, blocks[:-1]], np.diff(blocks), axis=1)
    away -= np.where(turns > 0.0, 2.0 * np.pi, 0.0)[:, None] * np.rint(away * turns[:, None])
    low, high, least, largest = (
        ufunc.reduceat(a, blocks[:-1], axis=1)
        for a in (away, sizes)
        for ufunc in (np.minimum, np.maximum)
    )
    return Searched(
        charted_rod(chart),
        chart.proximal,
        tree,
        np.array(where),
        np.array(codes, dtype=np.float64),
        chart.contacts.reshape(-1, 3)[order],
        chart.values.reshape(-1, 6)[order],
        seen,
        sizes,
        turns,
        np.array(kinds),
        _cut(chart, _PARTS_BY_AXIS)[order],
        _volumes(chart)[order],
        blocks,
        np.stack([seen[:, blocks[:-1]] + 0.5 * (low + high), 0.5 * (high - low), least, largest]),
    )


def at_nodes(chart: StableSet, names: tuple[str, ...]) -> tuple[Array, Array, Array]:
    """Channels (k, nodes) at the chart's nodes, sizes of directions, and 1/2π for these."""
    which = [CHANNELS.index(name) for name in names]
    known = np.ascontiguousarray(channels_of(chart.values.reshape(-1, 6)).T)
    turns = np.array([0.5 / np.pi if CIRCULAR[w] else 0.0 for w in which])
    return known[which], np.where(turns[:, None] > 0.0, known[np.array(which) - 1], 1.0), turns


def _cut(chart: StableSet, number: tuple[int, int, int]) -> IntArray:
    """Flat index of the block of each node of the chart, for ``number`` blocks along each axis."""
    size = chart.values.shape[:3]
    axes = [n * np.arange(m) // m for n, m in zip(number, size, strict=True)]
    i, j, k = np.meshgrid(*axes, indexing="ij")
    return np.asarray(((i * number[1] + j) * number[2] + k).reshape(-1))


@lru_cache(maxsize=16)
def _volumes(chart: StableSet) -> Array:
    """Volume of contact points that each node of the chart represents, flat."""
    size = np.abs(np.linalg.det(chart.tangents[..., 3:, :] @ chart.frames))
    n, m, k = (number - 1 for number in size.shape)
    size *= 2.0 * np.pi / (n * m * k)  # the chart measures 1 × 2π × 1
    for axis in range(3):  # nodes on its faces represent half a cell
        ends = np.ones(size.shape[axis])
        ends[[0, -1]] = 0.5
        size = size * np.expand_dims(ends, [i for i in range(3) if i != axis])
    return np.asarray(np.maximum(size, np.finfo(float).tiny).reshape(-1))


@vectorised
def nearest_of(of: Searched, mixing: Array, target: Array, out: IntArray) -> None:
    """Fill the node of each part of the chart that is nearest to one measurement."""
    q, number, sizes = of.turns.shape[0], of.blocks.shape[0] - 1, np.zeros(2)
    fixed = np.zeros(q)
    wanted, scales, bounds = np.zeros(q), np.zeros((q, q)), np.zeros(number)
    least, nearest = np.full(PARTS, np.inf), np.full(PARTS, np.inf)
    for i in range(q):
        for c in range(target.shape[0]):
            wanted[i] += mixing[i, c] * target[c]
        if of.kinds[i] < 2:
            sizes[of.kinds[i]] += wanted[i] ** 2
    for i in range(q):
        known = of.kinds[i] < 2 and sizes[of.kinds[i]] > 0.0
        scales[i, i] = 1.0 / np.sqrt(sizes[of.kinds[i]]) if known else 1.0
    longest = 0
    for n in range(number):
        longest = max(longest, of.blocks[n + 1] - of.blocks[n])
        for i in range(q):
            away = of.extent[0, i, n] - wanted[i]
            away -= np.rint(away * of.turns[i]) * 2.0 * np.pi
            bounds[n] += (max(abs(away) - of.extent[1, i, n], 0.0) * scales[i, i]) ** 2
        p = of.part[of.blocks[n]]
        nearest[p] = min(nearest[p], bounds[n])
    work, here = np.empty((q + 1, longest)), np.empty(longest)
    for others in range(2):  # the most promising block of each part first
        for n in range(number):
            first, last = of.blocks[n], of.blocks[n + 1]
            p = of.part[first]
            if (bounds[n] > nearest[p]) != (others == 1) or bounds[n] > least[p]:
                continue
            _misfits_of_block(of, scales, fixed, wanted, first, work, here[: last - first])
            for k in range(last - first):
                if here[k] < least[p]:
                    least[p], out[p] = here[k], first + k


@inlined
def _near_blocks(
    of: Searched, weights: Array, unit: Array, target: Array, most: float, blocks: IntArray
) -> tuple[int, int]:
    """List the blocks with nodes of a χ² of at most ``most``, by bounds; count blocks and nodes."""
    q, number, nodes = of.turns.shape[0], 0, 0
    low, high = np.empty(q), np.empty(q)
    for n in range(blocks.shape[0]):
        least = 0.0
        for i in range(q):
            away = of.extent[0, i, n] - target[i]
            away -= 2.0 * np.pi * np.rint(away * of.turns[i])
            low[i], high[i] = away - of.extent[1, i, n], away + of.extent[1, i, n]
            if unit[i] > 0.0:
                small, large = of.extent[2, i, n] / unit[i], of.extent[3, i, n] / unit[i]
                low[i] *= large if low[i] < 0.0 else small
                high[i] *= small if high[i] < 0.0 else large
        for i in range(q):
            middle, half = 0.0, 0.0
            for c in range(q):
                middle += 0.5 * weights[i, c] * (low[c] + high[c])
                half += 0.5 * abs(weights[i, c]) * (high[c] - low[c])
            least += max(abs(middle) - half, 0.0) ** 2
        if least <= most:
            blocks[number] = n
            number, nodes = number + 1, nodes + of.blocks[n + 1] - of.blocks[n]
    return number, nodes


@inlined
def _misfits_of_block(
    of: Searched,
    weights: Array,
    unit: Array,
    target: Array,
    first: int,
    away: Array,
    misfits: Array,
) -> None:
    """Fill χ² (n,) at nodes from the first of a block on; ``away`` (q + 1, n) is working memory.

    Weights of directions are for vectors of size ``unit``, or for all sizes if that is zero.
    """
    q, number = of.turns.shape[0], misfits.shape[0]
    r = away[q]
    for i in range(q):
        seen, turn, aim, mine = of.seen[i], of.turns[i], target[i], away[i]
        for k in range(number):
            mine[k] = seen[first + k] - aim
        for k in range(number if turn > 0.0 else 0):
            mine[k] -= np.rint(mine[k] * turn) * 2.0 * np.pi
        for k in range(number if unit[i] > 0.0 else 0):
            mine[k] *= of.sizes[i, first + k] / unit[i]
    for k in range(number):
        misfits[k] = 0.0
    for i in range(q):
        r[:] = 0.0
        for c in range(q):
            w, mine = weights[i, c], away[c]
            for k in range(number if w != 0.0 else 0):
                r[k] += w * mine[k]
        for k in range(number):
            misfits[k] += r[k] * r[k]


@inlined
def _likely_nodes(
    of: Searched,
    weights: Array,
    unit: Array,
    target: Array,
    most: float,
    blocks: IntArray,
    near: int,
    size: int,
) -> tuple[int, IntArray, Array]:
    """List the nodes of some blocks with a χ² below ``most``: their number, indices and χ²."""
    nodes, misfits, kept, longest = np.empty(size, np.int64), np.empty(size), 0, 0
    for i in range(near):
        longest = max(longest, of.blocks[blocks[i] + 1] - of.blocks[blocks[i]])
    away, here = np.empty((of.turns.shape[0] + 1, longest)), np.empty(longest)
    for i in range(near):
        first = of.blocks[blocks[i]]
        number = of.blocks[blocks[i] + 1] - first
        _misfits_of_block(of, weights, unit, target, first, away, here[:number])
        for k in range(number):  # without branches: entries that do not count are overwritten
            nodes[kept], misfits[kept] = first + k, here[k]
            kept += 1 if here[k] < most else 0
    return kept, nodes, misfits


@vectorised
def probable_nodes(
    of: Searched, white: bool, weights: Array, unit: Array, target: Array, point: Array, chi: float
) -> tuple[Array, Array]:
    """Nodes of the chart that may be right: points (3, n), density and likelihood (2, n).

    Points are relative to the contact point ``point``, likelihoods to its χ². The channels may be
    ``white`` already. Weights of directions are for vectors of size ``unit`` unless that is zero;
    larger vectors have sharper directions, and the density of the measurement is higher there.
    """
    if white:
        weights = np.zeros((of.turns.shape[0], of.turns.shape[0]))
        for i in range(of.turns.shape[0]):
            weights[i, i] = 1.0
    blocks, most = np.empty(of.blocks.shape[0] - 1, np.int64), chi + _NEGLIGIBLE
    near, size = _near_blocks(of, weights, unit, target, most, blocks)
    n, nodes, misfits = _likely_nodes(of, weights, unit, target, most, blocks, near, size)
    points, likely = np.empty((3, n)), np.empty((2, n))
    for k in range(n):
        likely[1, k] = quick_exp(0.5 * (chi - misfits[k]))
    for i in range(unit.shape[0]):
        for k in range(n if unit[i] > 0.0 else 0):
            likely[1, k] *= of.sizes[i, nodes[k]] / unit[i]
    for k in range(n):
        node = nodes[k]
        likely[0, k] = of.volume[node] * likely[1, k]
        for a in range(3):
            points[a, k] = of.values[node, 3 + a] - point[a]
    return points, likely


@vectorised
def described_by_nodes(points: Array, likely: Array, covariance: Array) -> bool:
    """Replace a covariance by the second moment of the posterior over the nodes, if enough count.

    This applies where the posterior is too wide for an expansion about one contact. The moment is
    that of the mean of the densities with volumes and without, widened until no more is beyond
    three standard deviations than stated.
    """
    n, with_volumes, without, squares = likely.shape[1], 0.0, 0.0, 0.0
    root, far, density = np.zeros((3, 3)), np.empty(n), np.empty(n)
    for k in range(n):
        with_volumes += likely[0, k]
        without += likely[1, k]
    for k in range(n):
        density[k] = 0.5 * (likely[0, k] / with_volumes + likely[1, k] / without)
        squares += density[k] * density[k]
    if not 0.0 < _MANY * squares < 1.0:  # there may be no probable nodes at all
        return False
    second_moment(points, density, 1.0, covariance)
    if cholesky(covariance, root):
        squared_distances(root, points, far)
        wider, most = 1.0, _WIDEST
        for _ in range(_BISECTIONS):
            limit, beyond = math.sqrt(wider * most), 0.0
            for k in range(n):
                beyond += density[k] if far[k] > limit * THREE_SIGMA else 0.0
            if beyond > LEFT:
                wider = limit
            else:
                most = limit
        covariance *= wider
    return True


@vectorised
def outside_share(
    points: Array,
    likely: Array,
    point: Array,
    chi: float,
    log_mass: float,
    covariance: Array,
    others: Array,
) -> float:
    """Share of the posterior probability, by the probable nodes, outside a candidate's region.

    It is the share beyond three standard deviations, with or without volumes of contact points,
    whichever is larger: near slip-off volumes nearly vanish. ``others`` (n, 4), χ² and points of
    further contacts, count as well, for valleys that are too narrow for the nodes.
    """
    n, root, away = points.shape[1], np.zeros((3, 3)), np.empty(3)
    if not cholesky(covariance, root):
        return 0.0
    density, likelihood, far = likely[0], likely[1], np.empty(n)
    squared_distances(root, points, far)
    mass, mass_out, like, like_out = 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        if far[k] > THREE_SIGMA:
            mass_out += density[k]
            like_out += min(likelihood[k], 1.0)
        else:
            mass += density[k]
            like += min(likelihood[k], 1.0)
    for k in range(others.shape[0]):
        for a in range(3):
            away[a] = others[k, 1 + a] - point[a]
        if others[k, 0] < np.inf and mahalanobis(root, away) > THREE_SIGMA:
            like_out += quick_exp(min(0.5 * (chi - others[k, 0]), 0.0))
    # The nodes may be too far apart to sample the candidate's own peak.
    mass = max(mass, math.exp(min(log_mass + 0.5 * chi, _MOST_LOG)), 1e-300)
    like = max(like, 1.0)
    return max(mass_out / (mass + mass_out), like_out / (like + like_out))
