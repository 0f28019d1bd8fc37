"""How long a whisker is whose tip is too faint to be seen, or not in the image: by how it bends.

A whisker tapers to its tip, so that its length says how thick it is everywhere, and so how it bends
where. Of all lengths that are not shorter than what is seen, the one counts with which the rod
explains the traces in contact best; how much worse others do says how well it is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vibrissa.tracking.refine import Refined
from vibrissa.tracking.rest import RestShape

Array = NDArray[np.float64]

_STEP = 0.03
_LONGEST = 1.45
"""Of the lengths that are tried, as a share of what is seen."""

_SURE = 0.005
"""How well a length is known at best, as a share: the taper is not quite that of the rod."""

_OUTER = 0.4
"""Share of the shape that says how it goes on."""


class Length(NamedTuple):
    """Of a whisker."""

    value: float
    sigma: float


def lengthened(shape: RestShape, length: float) -> RestShape:
    """Let a shape go on as it ends."""
    points, spacing = shape.points, shape.spacing
    more = round((length - shape.length) / spacing)
    if more < 1:
        return shape
    s = np.arange(1 - len(points), 1) * spacing
    outer = s > -_OUTER * shape.length
    bend = np.polynomial.polynomial.polyfit(s[outer], points[outer], 2)
    ahead = (length - shape.length) / more * np.arange(1, more + 1)
    there = np.polynomial.polynomial.polyval(ahead, bend).T + points[-1] - bend[0]
    return replace(shape, points=np.concatenate([points, there]))


def likeliest_length(seen: float, cost: Callable[[float], float]) -> Length:
    """Find the length with which the rod explains the traces best."""
    lengths = [seen, (1.0 + _STEP) * seen]
    costs = [cost(length) for length in lengths]
    while costs[-1] <= min(costs) and lengths[-1] < _LONGEST * seen:
        lengths.append(lengths[-1] + _STEP * seen)
        costs.append(cost(lengths[-1]))
    k = int(np.argmin(costs))
    if k == len(costs) - 1:
        return Length(seen, np.nan)
    if k == 0:
        lengths.insert(1, (1.0 + 0.5 * _STEP) * seen)
        costs.insert(1, cost(lengths[1]))
        k = int(np.argmin(costs[:2]))
    first = max(k - 1, 0)
    # A parabola about the lowest of three.
    a, b, _ = np.polyfit(lengths[first : first + 3], costs[first : first + 3], 2)
    if not a > 0.0:
        # It rises, though not as a parabola: one from here to the next.
        a = (costs[k + 1] - costs[k]) / (lengths[k + 1] - lengths[k]) ** 2
        return Length(lengths[k], float(np.hypot(a**-0.5, _SURE * seen)))
    value = float(np.clip(-0.5 * b / a, seen, lengths[-1]))
    return Length(value, float(np.hypot(a**-0.5, _SURE * seen)))


def with_length_unsure(found: Refined, other: Refined, share: float) -> Refined:
    """Add to all covariances that the length is not known."""
    point = share * (other.contact_point - found.contact_point)
    turn = np.full_like(found.position, np.nan)
    known = np.isfinite(found.rotation).all(axis=(1, 2)) & np.isfinite(other.rotation).all((1, 2))
    apart = other.rotation[known] @ np.swapaxes(found.rotation[known], 1, 2)
    turn[known] = Rotation.from_matrix(apart).as_rotvec()
    pose = share * np.concatenate([other.position - found.position, turn], axis=1)
    wrench = share * np.concatenate(
        [other.force - found.force, other.moment - found.moment], axis=1
    )
    return replace(
        found,
        contact_covariance=found.contact_covariance + point[:, :, None] * point[:, None],
        pose_covariance=found.pose_covariance + pose[:, :, None] * pose[:, None],
        wrench_covariance=found.wrench_covariance + wrench[:, :, None] * wrench[:, None],
        pose_wrench_covariance=found.pose_wrench_covariance + pose[:, :, None] * wrench[:, None],
    )
