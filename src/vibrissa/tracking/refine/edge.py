"""Where the outline of a round body is, by the brightness across it.

The steepest point of an image is not the outline of a body that is lit from the side or has a
stripe: close to the outline the brightness of a cylinder changes like the square root of the
distance. With u the depth inside of the outline, in radii, the angle of the normal from the outline
has the cosine 1 − u and the sine √(2u − u²), and a diffuse surface has the brightness

    I(u) = a + b √(2u − u²) + c u,

next to a constant one outside, all blurred by the lens. For each place of the outline and each blur
a, b, c and the brightness outside follow by linear least squares; place and blur are averaged
over all that explain the profile. Where shading and place cannot be distinguished, the standard
deviation of the place is large.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from vibrissa.deferred import ndimage
from vibrissa.numerics import Array

# Places of the outline and standard deviations of the blur that are tried, pixels.
_PLACES = np.arange(-2.0, 2.01, 0.1)
_BLURS = np.geomspace(0.45, 2.2, 9)
OFFSETS = np.arange(-3.5, 3.51, 0.5)
"""Distances from the outline at which the brightness is needed, outward, pixels."""
_USUAL, _VARIES = 0.8, 0.3  # usual blur, and the standard deviation of its logarithm
_FINE = 0.05  # distance of points at which the brightness is computed before it is blurred, pixels
# Error of the model, and standard deviations of the step and of both shadings, all as shares of the
# range of the profile.
_MODEL, _STEP, _SHADING = 0.02, 2.0, 0.7
_FEWEST = 8  # smallest number of points along the outline


@lru_cache(maxsize=64)
def _shapes(radius: float) -> Array:
    """Blurred brightness (place, blur, offset, 4): constant, step, and the two shadings."""
    reach = abs(_PLACES[0]) - OFFSETS[0] + 4.0 * _BLURS[-1]
    out = np.arange(-reach, reach + _FINE, _FINE)
    depth = np.clip(-out / radius, 0.0, 1.0)
    inside = [out < 0.0, np.sqrt(2.0 * depth - depth**2), depth]
    at = OFFSETS - _PLACES[:, None]
    shapes = [
        [np.interp(at, out, ndimage.gaussian_filter1d(part.astype(float), blur / _FINE))]
        for blur in _BLURS
        for part in inside
    ]
    shape = np.moveaxis(np.reshape(shapes, (len(_BLURS), 3, *at.shape)), (2, 0, 3, 1), range(4))
    return np.concatenate([np.ones((*shape.shape[:3], 1)), shape], axis=3)


def place_of_outline(profiles: Array, radius: float) -> tuple[float, float]:
    """Place of an outline, outward of where it is assumed, and its standard deviation, pixels.

    By the brightness (n, len(OFFSETS)) across the outline of a body of this radius in pixels.
    """
    if len(profiles) < _FEWEST:
        return 0.0, np.inf
    bright = np.median(profiles, axis=0)
    span = float(np.ptp(bright))
    noise = float(np.median(profiles.std(axis=0))) / np.sqrt(len(profiles))
    variance = noise**2 + (_MODEL * span) ** 2
    if variance == 0.0:
        return 0.0, np.inf
    shapes = _shapes(max(float(np.round(radius)), 1.0))
    prior = variance / (span * np.array([1e3, _STEP, _SHADING, _SHADING])) ** 2
    normal = np.einsum("pboi,pboj->pbij", shapes, shapes) + np.diag(prior)
    pull = np.einsum("pboi,o->pbi", shapes, bright)
    size = np.linalg.solve(normal, pull[..., None])[..., 0]
    # The square of what is left, and the logarithm of the determinant: a and b are integrated out.
    cost = (bright @ bright - (size * pull).sum(axis=-1)) / variance
    cost += np.linalg.slogdet(normal)[1] + (np.log(_BLURS / _USUAL) / _VARIES) ** 2
    weight = np.exp(-0.5 * (cost - cost.min())).sum(axis=1)
    weight /= weight.sum()
    place = float(weight @ _PLACES)
    return place, float(np.sqrt(weight @ (_PLACES - place) ** 2))
