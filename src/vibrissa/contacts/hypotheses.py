"""What a filter tells of its hypotheses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.contacts.located import Located
from vibrissa.contacts.mixture import Mixture
from vibrissa.numerics import Array, IntArray
from vibrissa.status import Status

# What is surer than this is no longer ambiguous.
_SURE = 0.99
# Hypotheses nearer to each other (Mahalanobis distance squared, by the sum of both covariances) run
# together: there is no gap between them.
_TOGETHER = 4.0
_EXPLAINED = (Status.UNIQUE, Status.AMBIGUOUS, Status.UNDERDETERMINED)


class Followed(NamedTuple):
    """What a filter knows after a sample.

    Attributes
    ----------
    point : (3,) array
        Most probable contact point, laboratory frame, m; NaN if there is none. Where hypotheses run
        together, as along the valley that a light touch leaves, it is their mean.
    covariance : (3, 3) array
        Of the contact point about it, m²: of all hypotheses, weighed by their probabilities.
    velocity : (3,) array
        Of the contact point in the laboratory, m/s.
    probability : float
        That the contact is there, within the spread of the hypotheses that run together; 0 if there
        is none.
    status : Status
        ``UNIQUE`` where that is above 0.99, else ``AMBIGUOUS``. ``MISSING``, ``NOT_FRICTIONLESS``
        and other reasons are of this sample, which neither a hypothesis nor any contact explains:
        the point then is what was known before.
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


def nothing_known(status: Status, located: Located | None) -> Followed:
    """Tell that there is no hypothesis, and why."""
    none = np.full(3, np.nan)
    empty = np.empty((0, 3))
    return Followed(
        none, np.full((3, 3), np.nan), none, 0.0, status, empty, np.empty(0), none, located
    )


def told(
    mixture: Mixture,
    status: Status,
    located: Located | None,
    turn: Array,
    base: Array,
    length: float,
) -> Followed:
    """What hypotheses tell, in SI units."""
    n = len(mixture.weight)
    if not n:
        return nothing_known(status, located)
    weights = np.exp(mixture.weight)
    points, spreads = mixture.mean[:, :3], mixture.spread[:, :3, :3]
    b = mixture.by_errors[:, :3]
    spreads = spreads + b @ np.swapaxes(b, 1, 2)
    if n == 1:
        mean, probability, covariance = mixture.mean[0], 1.0, spreads[0]
    else:
        group = _groups(points, spreads)
        shares = np.bincount(group, weights)
        best = group == shares.argmax()
        mean = weights[best] @ mixture.mean[best] / weights[best].sum()
        probability = float(min(shares.max(), 1.0))
        away = points - mean[:3]
        covariance = np.tensordot(weights, spreads, axes=1) + (away.T * weights) @ away
    if status in _EXPLAINED:
        status = Status.UNIQUE if probability > _SURE else Status.AMBIGUOUS
    return Followed(
        mean[:3] * length,
        covariance * length**2,
        mean[3:] * length,
        probability,
        status,
        points * length,
        weights,
        turn.T @ (mean[:3] - base) * length,
        located,
    )


def _groups(points: Array, spreads: Array) -> IntArray:
    """Number of the group (n,) that each hypothesis belongs to: those that run together."""
    n = len(points)
    apart = points[:, None] - points[None]
    both = spreads[:, None] + spreads[None]
    far = (apart * np.linalg.solve(both, apart[..., None])[..., 0]).sum(axis=-1)
    near = far < _TOGETHER
    group = np.full(n, -1)
    number = 0
    for i in range(n):
        if group[i] >= 0:
            continue
        reached = np.zeros(n, np.bool_)
        reached[i] = True
        while True:
            more = near[reached].any(axis=0) | reached
            if (more == reached).all():
                break
            reached = more
        group[reached] = number
        number += 1
    return group
