"""Hypotheses about where a contact is, and what a filter tells of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vibrissa.mapping.located import Located
from vibrissa.rod.arrays import Array
from vibrissa.status import Status

# Two points within this (Mahalanobis distance squared) are one.
_ONE = 1.0
# Errors of a contact's force and arc length (relative to the force, and to L) up to which noise
# moves it about linearly; a light touch whose place is not known so well teaches nothing yet.
_LINEAR_FORCE = 0.3
_LINEAR_ARC = 0.1
#: Standard deviation, over L, with which a hypothesis starts that is not known so well.
VAGUE = 0.2
#: Hypotheses less probable than this next to the best are dropped.
LEAST = 1e-6
#: At most so many are kept, and of a curve or surface of candidates so many start.
MOST = 24
# What is surer than this is no longer ambiguous.
_SURE = 0.99


class Followed(NamedTuple):
    """What a filter knows after a sample.

    Parameters
    ----------
    point : (3,) array
        Contact point of the most probable hypothesis, laboratory frame, m; NaN if there is none.
    covariance : (3, 3) array
        Of the contact point about it, m²: of all hypotheses, weighed by their probabilities.
    velocity : (3,) array
        Of the contact point in the laboratory, m/s.
    probability : float
        Of that hypothesis, among those there are; 0 if there is none.
    status : Status
        ``UNIQUE`` where that is above 0.99, else ``AMBIGUOUS``; or why there is no contact.
    points : (k, 3) array
        Contact points of all hypotheses, the most probable first, laboratory frame, m.
    probabilities : (k,) array
        Theirs.
    point_whisker : (3,) array
        ``point`` in the whisker's frame, m.
    located : Located or None
        What this sample alone tells, where it was looked for: not of fewer than three signals that
        a hypothesis explains.
    """

    point: Array
    covariance: Array
    velocity: Array
    probability: float
    status: Status
    points: Array
    probabilities: Array
    point_whisker: Array
    located: Located | None


@dataclass
class Hypothesis:
    """Gaussian over (p, v), laboratory, in L and L/s; ξ as x (4,); its log weight.

    A vague one stands for a light touch whose place noise does not leave a Gaussian: it is put in
    place anew by each sample, and keeps its share of the probability, until its place is known.
    """

    mean: Array
    spread: Array
    x: Array
    weight: float
    vague: bool = False
    by_stiffness: Array = field(default_factory=lambda: np.zeros(6))

    def total(self, stiffness: float) -> Array:
        """Covariance (6, 6) with that of the stiffness, by its relative standard deviation."""
        b = stiffness * self.by_stiffness
        return np.asarray(self.spread + np.outer(b, b))


def linear(covariance: Array, x: Array) -> bool:
    """Whether a contact x with this covariance of ξ is known well enough to linearise about it."""
    arc, force = covariance[0, 0], np.trace(covariance[1:, 1:])
    size = x[2] ** 2 + x[3] ** 2
    return bool(0.0 <= arc < _LINEAR_ARC**2 and 0.0 <= force < _LINEAR_FORCE**2 * size)


def bounded(covariance: Array) -> Array:
    """A covariance with no standard deviation beyond that of a vague contact."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.clip(values, 0.0, VAGUE**2) @ vectors.T)


def same(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether two hypotheses say the same: the less probable lies within the other's spread."""
    away = one.mean[:3] - other.mean[:3]
    return bool(away @ np.linalg.solve(other.spread[:3, :3], away) < _ONE)


def gaps_between(points: Array) -> Array:
    """Covariances (n, 3, 3) with which samples of a curve or surface fill what lies between them.

    Along the ways to the nearest two others, half way.
    """
    apart = points[None] - points[:, None]
    order = np.argsort((apart**2).sum(axis=2), axis=1)[:, 1:3]
    near = np.take_along_axis(apart, order[:, :, None], axis=1)
    return np.asarray(0.25 * np.einsum("nki,nkj->nij", near, near) / near.shape[1])


def tidied(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    """Sort and normalise; drop what is improbable, and one of two that have become the same.

    Parameters
    ----------
    hypotheses : list of Hypothesis
        In any order; weights are changed.

    Returns
    -------
    list of Hypothesis
        The most probable first; the exponentials of their weights sum to one.
    """
    if not hypotheses:
        return []
    ranked = sorted(hypotheses, key=lambda one: -one.weight)
    best = ranked[0].weight
    kept: list[Hypothesis] = []
    for one in ranked:
        if one.weight < best + math.log(LEAST) or len(kept) >= MOST:
            break
        twin = next((other for other in kept if same(one, other)), None)
        if twin is None:
            kept.append(one)
        else:
            twin.weight = float(np.logaddexp(twin.weight, one.weight))
    total = float(np.logaddexp.reduce([one.weight for one in kept]))
    for one in kept:
        one.weight -= total
    return sorted(kept, key=lambda one: -one.weight)


def told(
    hypotheses: list[Hypothesis],
    stiffness: float,
    status: Status,
    located: Located | None,
    turn: Array,
    base: Array,
    length: float,
) -> Followed:
    """What hypotheses tell, in SI units.

    Parameters
    ----------
    hypotheses : list of Hypothesis
        The most probable first.
    stiffness : float
        Relative standard deviation of the whisker's stiffness.
    status : Status
        Of the sample: ``MISSING`` stays.
    located : Located or None
        What the sample alone tells.
    turn, base : (3, 3), (3,) arrays
        Pose of the base, in L.
    length : float
        L, m.

    Returns
    -------
    Followed
        Of them.
    """
    none = np.full(3, np.nan)
    if not hypotheses:
        return Followed(
            none,
            np.full((3, 3), np.nan),
            none,
            0.0,
            status,
            np.empty((0, 3)),
            np.empty(0),
            none,
            located,
        )
    best = hypotheses[0]
    weights = np.exp([one.weight for one in hypotheses])
    weights = weights / weights.sum()
    if status != Status.MISSING:
        status = Status.UNIQUE if weights[0] > _SURE else Status.AMBIGUOUS
    points = np.array([one.mean[:3] for one in hypotheses])
    away = points - best.mean[:3]
    spreads = [one.total(stiffness)[:3, :3] for one in hypotheses]
    covariance = np.tensordot(weights, spreads, axes=1) + (away.T * weights) @ away
    return Followed(
        best.mean[:3] * length,
        covariance * length**2,
        best.mean[3:] * length,
        float(weights[0]),
        status,
        points * length,
        weights,
        turn.T @ (best.mean[:3] - base) * length,
        located,
    )
