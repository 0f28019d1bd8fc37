"""Derivatives of contact points and surface normals with respect to the measured wrench.

A contact is x = (s, f_x, f_y, f_z): the arc length and the force in the material frame there. It
determines the base force and contact point (F, p), the wrench w = (F, p × F) and the direction

    n = g / |g|,    g = F − (F · t) t,

of the force across the whisker, where t is the whisker's tangent at the contact. At a contact on
the whisker's side, the tangent lies in the tangent plane of the surface, so that n is the surface
normal even with friction along the whisker; without friction n is the direction of the force. Where
inertia was removed from the wrench, the known change ΔF of the contact force by inertia is added to
F in g. To first order an error δw of the measured wrench causes errors δ(p, n) = G δw with the gain

    G = ∂(p, n)/∂x · K · ∂c/∂w,

where c are the signals used for the estimate, J = ∂c/∂x, and K is J⁻¹ for three signals or
(JᵀWᵀWJ)⁻¹JᵀWᵀW, with weights W, for more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vibrissa.contacts import (
    WRENCH,
    Channels,
    SensorNoise,
    channel_derivatives,
    channel_gradients,
    ratio_derivatives,
    whitening,
)
from vibrissa.numerics import Array
from vibrissa.rod import Discretization, contact_tangents, discretize, solve_forces
from vibrissa.signals import signals_of
from vibrissa.whisker import Whisker

_FREE = [0, 2, 3]  # unknowns of x without friction
_STEP = 1e-5  # relative step of finite differences
# Smallest singular value of invertible derivatives whose columns are scaled to length one.
_SINGULAR = 1e-10


def gains(
    whisker: Whisker,
    signals: tuple[str, ...],
    arc_length: Array,
    contact_force: Array,
    weighing: Array | None = None,
    errors: Array | None = None,
    friction: float = 0.0,
    change: Array | float = 0.0,
) -> tuple[Array, Array]:
    """Derivatives (n, 6, 6) of contact points and normals with respect to the measured wrench.

    The second result (n, 6) is their change by one standard deviation of the assumed friction.

    With more than three signals, these are weighted by the noise ``weighing`` (6, 6) of the wrench
    and the common ``errors`` (k, 6, 7). ``friction`` is the standard deviation of the ratio of
    forces along and across the whisker. ``change`` (n, 3) is that of the contact force by inertia,
    whisker frame.
    """
    rubbing = signals == WRENCH or friction > 0.0
    d, x, rows = _unknowns(whisker, arc_length, contact_force)
    out, by_friction = np.full((len(rows), 6, 6), np.nan), np.zeros((len(rows), 6))
    if not rows.any():
        return out, by_friction
    values, value_slopes, normal_slopes = _touch(d, x, _scaled(d, change, rows))
    free = [0, 1, 2, 3] if rubbing else _FREE
    three = len(signals) == 3 and not friction > 0.0
    channels = Channels(signals, signals) if three or signals == WRENCH else Channels.of(signals)
    slopes = channel_derivatives(values, value_slopes[..., free], channels.names)
    by_wrench = channel_gradients(values, channels.names)
    if not three:
        # Whitening matrices of the channels at contacts with given values (F, p).
        sensor = None
        if weighing is not None:
            sensor = SensorNoise(None, weighing, np.zeros((0, 6, 7)) if errors is None else errors)
        measured = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
        weights = whitening(channels.covariance(sensor, measured, values, d))
        slopes, by_wrench = weights @ slopes, weights @ by_wrench
    if friction > 0.0:  # the prior acts as one more measurement, independent of the wrench
        prior = ratio_derivatives(x)[:, None] / friction
        slopes = np.concatenate([slopes, prior], axis=1)
        by_wrench = np.concatenate([by_wrench, np.zeros_like(by_wrench[:, :1])], axis=1)
    moved = np.concatenate([value_slopes[:, 3:], normal_slopes], axis=1)[..., free]
    solved = moved @ _inverse(slopes) * np.repeat([d.length, 1.0], 3)[:, None]
    out[rows] = solved @ by_wrench / np.repeat([d.force, d.moment], 3)
    if friction > 0.0:
        by_friction[rows] = solved[..., -1]
    return out, by_friction


def wrench_slopes(whisker: Whisker, arc_length: Array, contact_force: Array) -> Array:
    """Derivatives (n, 6, 3) of the wrench of frictionless contacts with respect to their points."""
    d, x, rows = _unknowns(whisker, arc_length, contact_force)
    out = np.full((len(rows), 6, 3), np.nan)
    if not rows.any():
        return out
    values, tangents = solve_forces(d, x, tangents=True)
    by_x = channel_derivatives(values, tangents, WRENCH)
    scale = np.repeat([d.force, d.moment], 3)[:, None] / d.length
    out[rows] = by_x @ _inverse(tangents[:, 3:]) * scale
    return out


def _touch(d: Discretization, x: Array, change: Array | float) -> tuple[Array, Array, Array]:
    """(F, p) (n, 6), ∂(F, p)/∂x (n, 6, 4) and, for the normal n, ∂n/∂x (n, 3, 4), scaled.

    Contacts are x (n, 4), and ``change`` (n, 3) is added to their forces; derivatives are computed
    partly by central differences.
    """
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
            # The whisker ends at the tip, s = 1.
            ahead[:, 0] = np.minimum(ahead[:, 0], np.maximum(1.0, x[:, 0]))
        width = (ahead[:, k] - back[:, k])[:, None]
        turning[..., k] = (contact_tangents(d, ahead) - contact_tangents(d, back)) / width
        if k == 1:
            slopes[..., 1] = (solve_forces(d, ahead)[0] - solve_forces(d, back)[0]) / width
    slopes[..., _FREE] = exact
    force = values[:, :3] + change
    along = (force * tangent).sum(axis=1)
    moved = slopes[:, :3] - along[:, None, None] * turning
    grown = np.einsum("ni,nik->nk", tangent, slopes[:, :3])
    grown += np.einsum("ni,nik->nk", force, turning)
    return (
        values,
        slopes,
        _across(force, tangent)[1] @ (moved - tangent[:, :, None] * grown[:, None, :]),
    )


def _across(force: Array, tangent: Array) -> tuple[Array, Array]:
    """Unit vectors n (n, 3) of the parts g of forces across the whisker, and ∂n/∂g (n, 3, 3)."""
    across = force - (force * tangent).sum(axis=1)[:, None] * tangent
    length = np.linalg.norm(across, axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = across / length
        return normal, (np.eye(3) - normal[:, :, None] * normal[:, None, :]) / length[..., None]


def contact_normals(
    whisker: Whisker,
    arc_length: Array,
    contact_force: Array,
    change: Array | float = 0.0,
    covariance: Array | float = 0.0,
) -> tuple[Array, Array, Array]:
    """Unit vectors (n, 3) of the contact forces across the whisker, covariances, and tangents.

    ``change`` (n, 3) is that of the forces by inertia, whisker frame, and ``covariance`` (n, 3, 3)
    its covariance, from which that of the normals follows. The tangents are the whisker's.
    """
    d, x, rows = _unknowns(whisker, arc_length, contact_force)
    out, tangents = np.full((2, len(rows), 3), np.nan)
    spread = np.full((len(rows), 3, 3), np.nan)
    if rows.any():
        force = solve_forces(d, x)[0][:, :3] + _scaled(d, change, rows)
        tangents[rows] = tangent = contact_tangents(d, x)
        out[rows], toward = _across(force, tangent)
        toward = toward @ (np.eye(3) - tangent[:, :, None] * tangent[:, None, :])
        change_spread = np.broadcast_to(covariance, spread.shape)[rows] / d.force**2
        spread[rows] = toward @ change_spread @ np.swapaxes(toward, 1, 2)
    return out, spread, tangents


def _scaled(d: Discretization, change: Array | float, rows: NDArray[np.bool_]) -> Array:
    """Changes (m, 3) of the contact forces of some rows, scaled."""
    return np.broadcast_to(change, (len(rows), 3))[rows] / d.force


def _unknowns(
    whisker: Whisker, arc_length: Array, contact_force: Array
) -> tuple[Discretization, Array, NDArray[np.bool_]]:
    """Scaled unknowns x (m, 4) of the finite contacts, and a mask (n,) of these."""
    d = discretize(whisker)
    x = np.concatenate([arc_length[:, None] / d.length, contact_force / d.force], axis=1)
    rows = np.isfinite(x).all(axis=1)
    return d, x[rows], rows


def _inverse(slopes: Array) -> Array:
    """Pseudo-inverses (n, m, k) of slopes (n, k, m); NaN for those not of full rank."""
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
