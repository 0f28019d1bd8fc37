"""Derivatives of the contact point with respect to measured signals, exact.

Contact point p and signals T are explicit functions of the contact ξ = (s_c, f_y, f_z), so

    ∂p/∂T = ∂p/∂ξ (∂T/∂ξ)⁻¹,    ∂(r, θ, φ)/∂T = ∂(r, θ, φ)/∂p ∂p/∂T.

Rows and columns of ∂T/∂ξ are made comparable before it is inverted: a force at the tip of a tapered
whisker is ten thousand times smaller than one near its base. Where the determinant is zero to
rounding, or a direction has no meaning, the derivatives are NaN.
"""

from __future__ import annotations

import numpy as np

from vibrissa.numerics import Array
from vibrissa.rod import Discretization
from vibrissa.signals import SIGNALS, signal_derivatives, signal_scales

#: A determinant smaller than this, rows and columns being of size one, is zero to rounding.
SINGULAR = 1e-11


def contact_signal_derivatives(
    discretization: Discretization, values: Array, tangents: Array, names: tuple[str, ...]
) -> Array:
    """Derivatives of the contact point with respect to three signals."""
    d = discretization
    which = [SIGNALS.index(name) for name in names]
    with np.errstate(all="ignore"):
        by_contact = signal_derivatives(values, tangents)[:, which]
        # What each signal's derivatives are measured against: all of F's or all of M's.
        rows = _row_sizes(values, tangents)[:, which]
        columns = np.linalg.norm(tangents, axis=1)
        scaled = by_contact / rows[:, :, None] / columns[:, None, :]
        usable = np.isfinite(scaled).all(axis=(1, 2))
        usable[usable] = np.abs(np.linalg.det(scaled[usable])) > SINGULAR
    out = np.full((len(values), 3, 3), np.nan)
    inverse = np.linalg.inv(scaled[usable])
    inverse = inverse / columns[usable][:, :, None] / rows[usable][:, None, :]
    si = d.length / signal_scales(names, d.force, d.moment)
    out[usable] = tangents[usable, 3:] @ inverse * si
    return out


def _row_sizes(values: Array, tangents: Array) -> Array:
    """Sizes (n, 6) to compare the derivatives of the six signals with."""
    force, point = values[:, :3], values[:, 3:]
    d_moment = np.cross(tangents[:, 3:], force[..., None], axis=1)
    d_moment += np.cross(point[..., None], tangents[:, :3], axis=1)
    sizes = [np.linalg.norm(d, axis=(1, 2)) for d in (tangents[:, :3], d_moment)]
    moment = np.cross(point, force)
    transverse = [np.hypot(v[:, 1], v[:, 2]) for v in (force, moment)]
    columns = [(size, size, size / t) for size, t in zip(sizes, transverse, strict=True)]
    return np.stack([c for three in columns for c in three], axis=1)


def spherical_derivatives(points: Array) -> Array:
    """∂(r, θ, φ)/∂(x, y, z) of points (..., 3), shape (..., 3, 3); NaN on the z axis."""
    x, y, z = np.moveaxis(points, -1, 0)
    across = np.hypot(x, y)
    r = np.hypot(across, z)
    with np.errstate(all="ignore"):
        rows = [
            np.stack([x, y, z], axis=-1) / r[..., None],
            np.stack([-y, x, 0.0 * z], axis=-1) / (across**2)[..., None],
            np.stack([-x * z / across, -y * z / across, across], axis=-1) / (r**2)[..., None],
        ]
    out = np.stack(rows, axis=-2)
    out[~np.isfinite(out).all(axis=(-1, -2))] = np.nan
    return out
