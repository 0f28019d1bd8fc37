"""Derivatives of the contact point with respect to measured signals, exact.

Contact point p and signals T are explicit functions of the contact ξ = (s_c, f_y, f_z), so

    ∂p/∂T = ∂p/∂ξ (∂T/∂ξ)⁻¹,    ∂(r, θ, φ)/∂T = ∂(r, θ, φ)/∂p ∂p/∂T.

Rows and columns of ∂T/∂ξ are made comparable before it is inverted: a force at the tip of a tapered
whisker is ten thousand times smaller than one near its base. Where the determinant is zero to
rounding, or a direction has no meaning, the derivatives are NaN.
"""

from __future__ import annotations

import numpy as np

from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.sensing.channels import wrench_tangents, wrenches_of
from vibrissa.numerics import Array
from vibrissa.rod import (
    Discretization,
    discretize,
    fold_forces,
    solve_forces,
    with_normal_force,
)
from vibrissa.signals import (
    SIGNALS,
    circular_among,
    signal_derivatives,
    signal_scales,
    signals_of,
)

#: Determinant, for rows and columns of size one, below which it is zero to rounding.
SINGULAR = 1e-11
RANK = 1e-8  # share of the largest singular value below which one counts as zero
_LOST = 0.99  # a triplet is deficient if it is so at all contacts except this share
# Signals that the equations make dependent are so only to the error of the integration. With so
# many times the steps that error is below ``RANK``.
_FINER = 8
_TRIED = 256  # number of contacts sampled to test whether signals determine contacts


def contact_signal_derivatives(
    discretization: Discretization, values: Array, tangents: Array, names: tuple[str, ...]
) -> Array:
    """Derivatives of the contact point with respect to three signals."""
    d = discretization
    which = [SIGNALS.index(name) for name in names]
    with np.errstate(all="ignore"):
        by_contact = signal_derivatives(values, tangents)[:, which]
        # Reference of each signal's derivatives: those of all of F or of all of M.
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
    """Sizes (n, 6) that make the derivatives of the six signals comparable."""
    wrench, slopes = wrenches_of(values), wrench_tangents(values, tangents)
    sizes = [np.linalg.norm(slopes[:, part], axis=(1, 2)) for part in (slice(3), slice(3, 6))]
    transverse = [np.hypot(wrench[:, i], wrench[:, i + 1]) for i in (1, 4)]
    columns = [(size, size, size / t) for size, t in zip(sizes, transverse, strict=True)]
    return np.stack([c for three in columns for c in three], axis=1)


def spherical_derivatives(points: Array) -> Array:
    """Derivatives ∂(r, θ, φ)/∂(x, y, z) of points; NaN on the z axis."""
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


def determining(contact_map: ChartedWhisker, names: tuple[str, ...]) -> bool:
    """Whether signals determine contacts almost everywhere."""
    chart = contact_map.chart
    nodes = np.random.default_rng(0).choice(chart.values[..., 0].size, _TRIED, replace=False)
    xi, values = chart.contacts.reshape(-1, 3)[nodes], chart.values.reshape(-1, 6)[nodes]
    signals = signals_of(values[:, :3], np.cross(values[:, 3:], values[:, :3]))
    which = [SIGNALS.index(name) for name in names]
    span = np.where(circular_among(names), 2.0 * np.pi, np.ptp(signals[:, which], axis=0))
    return deficient(contact_map, names, xi, span) is None


def deficient(
    contact_map: ChartedWhisker, names: tuple[str, ...], xi: Array, span: Array
) -> int | None:
    """Integration steps with which signals are deficient at contacts; None if they are not."""
    # A signal without a range is zero everywhere, up to rounding.
    weight = np.where(span > RANK, 1.0 / np.maximum(span, RANK), 0.0)
    strength = fold_forces(contact_map.chart.fold, xi)
    unit = np.stack([np.ones(len(xi)), strength, strength], axis=1)
    which = [SIGNALS.index(name) for name in names]
    for number in (contact_map.steps, _FINER * contact_map.steps):
        values, tangents = solve_forces(
            discretize(contact_map.whisker, number), with_normal_force(xi), tangents=True
        )
        slope = np.nan_to_num(signal_derivatives(values, tangents)[:, which]) * unit[:, None, :]
        singular = np.linalg.svd(slope * weight[:, None], compute_uv=False)
        if (singular[:, 2] <= RANK * singular[:, 0]).mean() > _LOST:
            return number
    return None
