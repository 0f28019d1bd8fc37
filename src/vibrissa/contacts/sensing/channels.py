"""Channels: the quantities that contacts are fitted to, chosen for nearly Gaussian noise.

A size and its direction, F_T with F_D or M_B with M_D, are replaced by the two components of their
vector if both are measured: these remain regular where the size is zero. A size or a direction
alone is a channel of its own. All quantities are non-dimensional.

The derivatives of the contact point with respect to signals are exact. Contact point p and signals
T are explicit functions of the contact ξ = (s_c, f_y, f_z), so

    ∂p/∂T = ∂p/∂ξ (∂T/∂ξ)⁻¹,    ∂(r, θ, φ)/∂T = ∂(r, θ, φ)/∂p ∂p/∂T.

Rows and columns of ∂T/∂ξ are made comparable before it is inverted: a force at the tip of a tapered
whisker is ten thousand times smaller than one near its base. Where the determinant is zero to
rounding, or a direction has no meaning, the derivatives are NaN.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.sensing.noise import SensorNoise, common_covariance, scaled_errors, trusted
from vibrissa.numerics import Array, cross
from vibrissa.rod import Discretization, discretize, fold_forces, solve_forces, with_normal_force
from vibrissa.signals import (
    CIRCULAR as CIRCULAR_SIGNALS,
    SIGNALS,
    circular_among,
    signal_derivatives,
    signal_scales,
    signals_of,
    wrench_derivatives,
)

#: Possible channels: the signals, and the components of force and moment.
CHANNELS = (*SIGNALS, "Fy", "Fz", "My", "Mz")
#: Further quantities that can be held: arc length and contact point, over L, and the ratio of the
#: force along the whisker to that across it.
FITTED = (*CHANNELS, "s", "px", "py", "pz", "ratio")
RATIO = FITTED.index("ratio")
#: Whether each channel is an angle.
CIRCULAR = (*CIRCULAR_SIGNALS, False, False, False, False)
#: The six components of force and moment.
WRENCH = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
# Components of (F, M), which are the last channels.
_COMPONENTS = (1, 2, 4, 5)
_PAIRS = {("FT", "FD"): ("Fy", "Fz"), ("MB", "MD"): ("My", "Mz")}


@dataclass(frozen=True)
class Channels:
    """Channels that a set of signals is fitted to."""

    signals: tuple[str, ...]  # in canonical order
    # channel of each: itself, or a component where size and direction are both there
    names: tuple[str, ...]

    @classmethod
    def of(cls, signals: tuple[str, ...]) -> Channels:
        """Choose the channels for signals in canonical order."""
        names = list(signals)
        for pair, components in _PAIRS.items():
            if set(pair) <= set(names):
                i = names.index(pair[0])
                names[i : i + 2] = components
        return cls(signals, tuple(names))

    def pairs(self) -> list[int]:
        """Indices of the sizes that are followed by their direction as components of one vector."""
        return [
            i
            for i, name in enumerate(self.names)
            if name in ("Fy", "My") and name != self.signals[i]
        ]

    def targets(self, measured: Array) -> Array:
        """Convert measured signals (n, k) to channels (n, k), non-dimensional."""
        out = measured.copy()
        for i in self.pairs():
            size, angle = measured[:, i], measured[:, i + 1]
            out[:, i], out[:, i + 1] = size * np.cos(angle), size * np.sin(angle)
        return out

    def covariance(
        self,
        sensor: SensorNoise | None,
        measured: Array,
        values: Array,
        discretization: Discretization,
    ) -> Array:
        """Covariances (n, k, k) of the channels of measured signals (n, k), non-dimensional.

        ``values`` (n, 6 or 9) are base force and contact point, and what the moment of the weight
        has changed by. Without a sensor components count as known to a share of force and moment.
        """
        if sensor is not None and sensor.deviations is not None:
            own = self._by_deviations(sensor.deviations, measured, discretization)
            if not len(sensor.errors):
                return own
        wrench = wrenches_of(values)
        g = channel_gradients(values, self.names)
        with np.errstate(invalid="ignore"):
            if sensor is None:
                return np.asarray(g @ trusted(wrench) @ np.swapaxes(g, -1, -2))
            if sensor.wrench is not None:
                sizes = np.repeat([discretization.force, discretization.moment], 3)
                components = sensor.wrench / np.outer(sizes, sizes)
                own = np.asarray(g @ components @ np.swapaxes(g, -1, -2))
            errors = scaled_errors(sensor.errors, discretization.force, discretization.moment)
            return own + common_covariance(errors, g, wrench)

    def _by_deviations(
        self, deviations: dict[str, float], measured: Array, discretization: Discretization
    ) -> Array:
        scale = signal_scales(self.signals, discretization.force, discretization.moment)
        sigma = np.array([deviations[name] for name in self.signals]) / scale
        out = np.tile(np.diag(sigma**2), (len(measured), 1, 1))
        for i in self.pairs():
            size, angle = measured[:, i], measured[:, i + 1]
            cos, sin = np.cos(angle), np.sin(angle)
            turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
            spread = np.zeros_like(turn)
            spread[:, 0, 0], spread[:, 1, 1] = sigma[i] ** 2, (size * sigma[i + 1]) ** 2
            out[:, i : i + 2, i : i + 2] = turn @ spread @ np.swapaxes(turn, -1, -2)
        return out


def wrenches_of(values: Array) -> Array:
    """(F, M) (..., 6) from (F, p) (..., 6), or from (F, p, μ) with the weight's moment μ."""
    moment = cross(values[..., 3:6], values[..., :3])
    if values.shape[-1] > len(WRENCH):
        moment = moment + values[..., 6:]
    return np.concatenate([values[..., :3], moment], axis=-1)


def channels_of(values: Array) -> Array:
    """All channels (..., 10) from (F, p) or (F, p, μ)."""
    wrench = wrenches_of(values)
    signals = signals_of(wrench[..., :3], wrench[..., 3:])
    return np.concatenate([signals, wrench[..., _COMPONENTS]], axis=-1)


def channel_gradients(values: Array, names: tuple[str, ...]) -> Array:
    """Derivatives of channels with respect to (F, M)."""
    wrench = wrenches_of(values)
    by_wrench = np.zeros((*values.shape[:-1], len(CHANNELS), 6))
    by_wrench[..., : len(SIGNALS), :] = wrench_derivatives(wrench[..., :3], wrench[..., 3:])
    for i, component in enumerate(_COMPONENTS, start=len(SIGNALS)):
        by_wrench[..., i, component] = 1.0
    return by_wrench[..., [CHANNELS.index(name) for name in names], :]


def channel_derivatives(values: Array, tangents: Array, names: tuple[str, ...]) -> Array:
    """Derivatives of channels with respect to the unknowns of the contact."""
    return np.asarray(channel_gradients(values, names) @ wrench_tangents(values, tangents))


def wrench_tangents(values: Array, tangents: Array) -> Array:
    """Derivatives of (F, M), (..., 6, u), from those of (F, p) or (F, p, μ)."""
    d_force, d_point = tangents[..., :3, :], tangents[..., 3:6, :]
    across = np.swapaxes(d_point, -1, -2), np.swapaxes(d_force, -1, -2)
    d_moment = cross(across[0], values[..., None, :3])
    d_moment += cross(values[..., None, 3:6], across[1])
    d_moment = np.swapaxes(d_moment, -1, -2)
    if values.shape[-1] > len(WRENCH):
        d_moment = d_moment + tangents[..., 6:, :]
    return np.concatenate([d_force, d_moment], axis=-2)


def ratio_of(x: Array) -> Array:
    """Ratios (n,) of the force along the whisker to that across it, for contacts (n, 4)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(x[:, 1] / np.hypot(x[:, 2], x[:, 3]))


def ratio_derivatives(x: Array) -> Array:
    """Differentiate the ratio of the force along the whisker to that across it."""
    normal = np.hypot(x[:, 2], x[:, 3])
    by = -x[:, 1:2] * x[:, 2:] / normal[:, None] ** 3
    return np.column_stack([np.zeros(len(x)), 1.0 / normal, by])


def friction_angle(x: Array) -> Array:
    """Angles (...) between forces x (..., 1:4) and the plane normal to the whisker, rad."""
    return np.arctan2(x[..., 1], np.hypot(x[..., 2], x[..., 3]))


def friction_angle_derivatives(x: Array) -> Array:
    """Derivatives (n, 4) of the friction angles with respect to contacts x (n, 4)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(ratio_derivatives(x) / (1.0 + ratio_of(x)[:, None] ** 2))


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
    size = chart.values[..., 0].size
    nodes = np.random.default_rng(0).choice(size, min(size, _TRIED), replace=False)
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
