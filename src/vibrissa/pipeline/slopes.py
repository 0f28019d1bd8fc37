"""How a contact moves with the signals that it is found from, and the signals with the contact.

A contact is x = (s, f_x, f_y, f_z): arc length, and force in the material frame there. It gives
base force and contact point (F, p), the wrench w = (F, p × F) and the direction

    n = g / |g|,    g = F − (F · t) t,

of the force across the whisker, t being the whisker's tangent at the contact. A whisker that is
touched on its side lies in the tangent plane of the surface, so that n is the surface's normal even
where the contact rubs along the whisker; without friction it is the direction of the force. To
first order an error δw of the measured wrench makes errors δ(p, n) = G δw with the gain

    G = ∂(p, n)/∂x · K · ∂c/∂w,

c being the signals that the contact is found from, and K the inverse of ∂c/∂x for three of them, or
(JᵀWᵀWJ)⁻¹JᵀWᵀW for more, which are weighed by W.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vibrissa.contacts import (
    WRENCH,
    Channels,
    SensorNoise,
    channel_derivatives,
    channel_gradients,
    whitening,
)
from vibrissa.rod import Discretization, contact_tangents, discretize, solve_forces
from vibrissa.signals import signals_of
from vibrissa.whisker import Whisker

Array = NDArray[np.float64]

_FREE = [0, 2, 3]
"""What is unknown of x without friction."""

_STEP = 1e-5
_SINGULAR = 1e-10


class _Touch(NamedTuple):
    """(F, p) (n, 6), the normal (n, 3) and ∂(F, p)/∂x (n, 6, 4), ∂n/∂x (n, 3, 4)."""

    values: Array
    normal: Array
    value_slopes: Array
    normal_slopes: Array


def gains(
    whisker: Whisker,
    signals: tuple[str, ...],
    arc_length: Array,
    contact_force: Array,
    weighing: Array | None = None,
    errors: Array | None = None,
) -> Array:
    """Tell how contact points and normals move with the measured wrench."""
    d = discretize(whisker)
    friction = signals == WRENCH
    x = np.concatenate([arc_length[:, None] / d.length, contact_force / d.force], axis=1)
    out = np.full((len(x), 6, 6), np.nan)
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))
    if not rows.size:
        return out
    touch = _touch(d, x[rows])
    free = [0, 1, 2, 3] if friction else _FREE
    three = len(signals) == 3
    channels = Channels(signals, signals) if three or friction else Channels.of(signals)
    slopes = channel_derivatives(touch.values, touch.value_slopes[..., free], channels.names)
    by_wrench = channel_gradients(touch.values, channels.names)
    if not three:
        weights = _weights(d, channels, touch.values, weighing, errors)
        slopes, by_wrench = weights @ slopes, weights @ by_wrench
    moved = np.concatenate([touch.value_slopes[:, 3:], touch.normal_slopes], axis=1)[..., free]
    inner = np.repeat([d.length, 1.0], 3)[:, None] / np.repeat([d.force, d.moment], 3)
    out[rows] = moved @ _inverse(slopes) @ by_wrench * inner
    return out


def wrench_slopes(whisker: Whisker, arc_length: Array, contact_force: Array) -> Array:
    """Tell how the wrench of frictionless contacts moves with their points."""
    d = discretize(whisker)
    x = np.concatenate([arc_length[:, None] / d.length, contact_force / d.force], axis=1)
    out = np.full((len(x), 6, 3), np.nan)
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))
    if not rows.size:
        return out
    values, tangents = solve_forces(d, x[rows], tangents=True)
    by_x = channel_derivatives(values, tangents, WRENCH)
    scale = np.repeat([d.force, d.moment], 3)[:, None] / d.length
    out[rows] = by_x @ _inverse(tangents[:, 3:]) * scale
    return out


def _touch(d: Discretization, x: Array) -> _Touch:
    values, exact = solve_forces(d, x, tangents=True)
    tangent = contact_tangents(d, x)
    slopes, turning = np.empty((len(x), 6, 4)), np.empty((len(x), 3, 4))
    size = np.maximum(np.linalg.norm(x[:, 1:], axis=1), _STEP)
    for k in range(4):
        step = _STEP * (np.ones(len(x)) if k == 0 else size)
        ahead, back = x.copy(), x.copy()
        ahead[:, k] += step
        back[:, k] -= step
        if k == 0:
            # There is no whisker beyond the tip.
            ahead[:, 0] = np.minimum(ahead[:, 0], np.maximum(1.0, x[:, 0]))
        width = (ahead[:, k] - back[:, k])[:, None]
        turning[..., k] = (contact_tangents(d, ahead) - contact_tangents(d, back)) / width
        if k == 1:
            slopes[..., 1] = (solve_forces(d, ahead)[0] - solve_forces(d, back)[0]) / width
    slopes[..., _FREE] = exact
    force = values[:, :3]
    along = (force * tangent).sum(axis=1)[:, None]
    across = force - along * tangent
    length = np.linalg.norm(across, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = across / length
    change = slopes[:, :3] - along[..., None] * turning
    grown = np.einsum("ni,nik->nk", tangent, slopes[:, :3])
    grown += np.einsum("ni,nik->nk", force, turning)
    change -= tangent[:, :, None] * grown[:, None, :]
    flat = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        return _Touch(values, normal, slopes, flat @ change / length[..., None])


def contact_normals(whisker: Whisker, arc_length: Array, contact_force: Array) -> Array:
    """Give the direction of contact forces across the whisker."""
    d = discretize(whisker)
    x = np.concatenate([arc_length[:, None] / d.length, contact_force / d.force], axis=1)
    out = np.full((len(x), 3), np.nan)
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))
    if rows.size:
        force, tangent = solve_forces(d, x[rows])[0][:, :3], contact_tangents(d, x[rows])
        across = force - (force * tangent).sum(axis=1)[:, None] * tangent
        with np.errstate(divide="ignore", invalid="ignore"):
            out[rows] = across / np.linalg.norm(across, axis=1, keepdims=True)
    return out


def _weights(
    d: Discretization,
    channels: Channels,
    values: Array,
    weighing: Array | None,
    errors: Array | None,
) -> Array:
    sensor = None
    if weighing is not None:
        sensor = SensorNoise(None, weighing, np.zeros((0, 6, 7)) if errors is None else errors)
    measured = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
    return whitening(channels.covariance(sensor, measured, values, d))


def _inverse(slopes: Array) -> Array:
    """Pseudo-inverses (n, m, k) of slopes (n, k, m); NaN where they are not of full rank."""
    usable = np.asarray(np.isfinite(slopes).all(axis=(1, 2)))
    whole = np.where(usable[:, None, None], slopes, 0.0)
    size = np.linalg.norm(whole, axis=1)
    usable &= (size > 0.0).all(axis=1)
    u, s, vt = np.linalg.svd(whole / np.where(size > 0.0, size, 1.0)[:, None], full_matrices=False)
    usable &= s[:, -1] > _SINGULAR
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.swapaxes(vt, 1, 2) / s[:, None, :]
        out = root @ np.swapaxes(u, 1, 2) / size[:, :, None]
    return np.where(usable[:, None, None], out, np.nan)
