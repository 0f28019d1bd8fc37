"""Where the map from contacts to a triplet folds: the sign of det ∂T/∂p over samples of Ω."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vibrissa.identifiability.regions import Samples
from vibrissa.numerics import AnyArray, Array

# So many contacts of each region that are beside folds, or nearest to it, are named.
_BESIDE = 24


class Local(NamedTuple):
    """Local evidence, region by region.

    minority (regions,): share of the volume in which the determinant has the rarer sign; one_sided
    (regions,): the same with the two sides of the whisker's plane taken apart; angle (regions, 2):
    least and largest cone angle of contacts with the rarer sign of their side, rad; beside: samples
    beside folds.
    """

    minority: Array
    one_sided: Array
    angle: Array
    beside: AnyArray


def local_evidence(
    samples: Samples,
    by_contact: Array,
    regions: tuple[str, ...],
    cone: float,
    normal: Array,
    lost: bool,
) -> Local:
    """Look where det ∂T/∂p changes its sign.

    Where T collapses on the plane of a planar whisker, the sign may change there although T does
    not fold: with M_x and M_D, for example, both of which change sign with z. So the two sides of
    the plane are also taken apart.
    """
    n = len(regions)
    out = Local(np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2), np.nan), np.zeros(0, int))
    if lost:
        return out
    # Relative to the lengths of the gradients: how nearly they lie in a plane. det ∂p/∂ξ > 0 in Ω.
    size = np.prod(np.linalg.norm(by_contact, axis=2), axis=1)
    det = np.linalg.det(by_contact) / np.where(size > 0.0, size, 1.0)
    above = samples.places.values[:, 3:] @ normal > 0.0
    outside = samples.places.angle > cone
    beside: set[int] = set()
    for i, region in enumerate(regions):
        inside = samples.places.members(region) & outside
        total = samples.volume[inside].sum()
        if total == 0.0:
            continue
        out.minority[i] = samples.volume[_rarer(det, inside, samples.volume)[0]].sum() / total
        rare = np.zeros(len(det), dtype=bool)
        for side in (inside & above, inside & ~above):
            rarer, common = _rarer(det, side, samples.volume)
            rare |= rarer
            rows = np.flatnonzero(side)
            beside.update(rows[np.argsort(common * det[rows])[: _BESIDE // 2]].tolist())
        out.one_sided[i] = samples.volume[rare].sum() / total
        if rare.any():
            out.angle[i] = samples.places.angle[rare].min(), samples.places.angle[rare].max()
    return out._replace(beside=np.array(sorted(beside), dtype=np.int64))


def _rarer(det: Array, inside: AnyArray, volume: Array) -> tuple[AnyArray, float]:
    """Contacts with the rarer sign, and the sign that is more common."""
    up, down = inside & (det > 0.0), inside & (det < 0.0)
    if volume[up].sum() < volume[down].sum():
        return up, -1.0
    return down, 1.0
