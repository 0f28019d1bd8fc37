"""Calibration of a sensor by known wrenches and by readings without contact.

**Mixing and offset**, y = A w + b, are fitted channel by channel. The wrenches are those of known
loads, or those computed for contacts of the whisker.

**Offset and weight** are fitted to readings without contact in several orientations,

    y = b + H (m g, μ × g),

linear in the offset b, the mass m and its moment μ = m c, with g in the frame of the base.

If the wrenches have errors of known covariances W, least squares would make the mixing too small
(attenuation). A channel with weights a and noise σ then minimises Σ r² / (σ² + aᵀ W a) over a, with
the residuals r = y − aᵀ w − b; the sum equals the number of degrees of freedom at the fitted σ
(Fuller, *Measurement error models*, 1987).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import optimize
from vibrissa.numerics import Array, Mask, cross_matrix, numbers, rotation_matrices
from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.regression import Solution, solve, warn_of_misfit
from vibrissa.sensors.sensor import COMPONENTS, GRAVITY, Sensor, with_offset
from vibrissa.sensors.stiffness import deflections_to, spread_of_points, wrench_slopes, wrenches_of
from vibrissa.whisker import Whisker

_ROUNDING = 1e-6  # relative size below which components of a force or moment are set to zero
_ROUNDS = 50  # largest number of rounds in which mixing and noise are fitted in turn
_SETTLED = 1e-6  # relative change of the variance of the noise at which these end
_UNEXPLAINED = 0.5  # residual, over the spread of readings, above which the user is warned
_ADVICE = (
    "touch the whisker at other points and in other directions, or restrict `components` to those "
    "that the channels read"
)


@dataclass(frozen=True, eq=False)
class MixingCalibration:
    """Mixing of a sensor, calibrated by known wrenches.

    Attributes
    ----------
    sensor : Sensor
        Sensor with the fitted mixing (in the whisker frame), offset and noise, and the covariance
        of mixing and offset.
    components : tuple of str
        Components that the channels may read.
    covariance : (k, p + 1, p + 1) array
        Covariance of each channel's mixing of these p components and, last, its offset.
    residual : (k,) array
        Root mean square residual of each channel, in its unit.
    unexplained : tuple of str
        Channels of whose readings the loads explain only a part, as the warning states.
    """

    sensor: Sensor
    components: tuple[str, ...]
    covariance: Array
    residual: Array
    unexplained: tuple[str, ...]


def calibrate_mixing(
    readings: ArrayLike,
    wrenches: ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    components: Sequence[str] = COMPONENTS,
    wrench_covariances: ArrayLike = 0.0,
    noise: ArrayLike = 0.0,
    resolution: ArrayLike = 0.0,
    largest: ArrayLike = np.inf,
) -> MixingCalibration:
    """Fit mixing, offset and noise of a sensor to readings of known wrenches.

    Parameters
    ----------
    readings : array_like (n, k)
        Readings of the channels; rows with NaN are ignored.
    wrenches : array_like (n, 6)
        Wrenches (F, M) at the whisker's base, whisker frame, N and N·m, of known loads or of
        contacts at known points.
    channels : sequence of str, optional
        Names of the k channels.
    components : sequence of str
        Components that a channel may read; the mixing of the others is zero. The wrenches of
        frictionless contacts span only a small part of all wrenches; in most, Mx is nearly zero.
    wrench_covariances : array_like
        Covariances of the errors of the wrenches, which broadcast to (n, 6, 6); by default they are
        exact. Errors are independent of each other.
    noise : array_like (k,)
        Smallest standard deviation of the channels' noise, such as that of readings at rest. If
        errors of the wrenches are larger than the noise, residuals hardly determine it.
    resolution, largest : array_like (k,)
        Resolution and largest reading of the channels, as in `Sensor`. Rows with a saturated
        reading are ignored, and the fitted noise excludes rounding.

    Returns
    -------
    MixingCalibration
        Sensor with its uncertainty.

    Raises
    ------
    ValueError
        If shapes do not match or the wrenches do not separate the components.

    Warns
    -----
    UserWarning
        If errors of the wrenches hide the noise, or loads explain only a part of the readings.
    """
    y = numbers("readings", readings, channels or (), any_unit=True)
    w = numbers("wrenches", wrenches, components)
    if y.ndim != 2 or w.shape != (len(y), 6):
        raise ValueError(
            f"readings (n, k) and wrenches (n, 6) are needed; got {y.shape} and {w.shape}"
        )
    unknown = [name for name in components if name not in COMPONENTS]
    if unknown or not components:
        raise ValueError(f"components are of {', '.join(COMPONENTS)}; got {list(components)}")
    names = tuple(channels or (f"channel {i + 1}" for i in range(y.shape[1])))
    if len(names) != y.shape[1]:
        raise ValueError(f"{y.shape[1]} channels have {len(names)} names: {', '.join(names)}")
    which = [COMPONENTS.index(name) for name in components]
    known = (np.isfinite(y) & (np.abs(y) < largest)).all(axis=1) & np.isfinite(w).all(axis=1)
    if not known.any():
        raise ValueError(
            f"none of {len(y)} rows has both a reading and a load without NaN or saturation; at "
            f"least {len(which) + 2} are needed"
        )
    design = np.column_stack([_loaded(w[known])[:, which], np.ones(known.sum())])
    if known.sum() == design.shape[1]:
        raise ValueError(
            f"{known.sum()} contacts are too few for {design.shape[1]} unknowns and the noise: "
            "add some"
        )
    errors = np.zeros((len(design), len(which) + 1, len(which) + 1))
    errors[:, :-1, :-1] = _checked_errors(wrench_covariances, w)[known][:, which][:, :, which]
    rounding = np.asarray(resolution) ** 2 / 12.0
    floor = numbers("noise", noise, names, any_unit=True)
    if (floor < 0.0).any():
        raise ValueError(f"noise is {floor.tolist()}; it must not be negative")
    least = np.broadcast_to(floor**2 + rounding, y.shape[1:])
    unknowns, covariance, variance = _fit_channels(
        design, y[known], errors, least, (*components, "the offset")
    )
    mixing = np.zeros((y.shape[1], 6))
    mixing[:, which] = unknowns[:-1].T
    whole = np.zeros((y.shape[1], 7, 7))
    whole[np.ix_(range(y.shape[1]), [*which, 6], [*which, 6])] = covariance
    sensor = Sensor(
        names,
        mixing,
        np.sqrt(np.maximum(variance - rounding, 0.0)),
        unknowns[-1],
        resolution=resolution,
        largest=largest,
        frame=SensorFrame(),
        mixing_covariance=whole,
    )
    residual = np.sqrt(((y[known] - design @ unknowns) ** 2).mean(axis=0))
    read = y[known]
    spread = np.where(np.ptp(read, axis=0) > 0.0, read.std(axis=0), 0.0)
    loose = _doubt_channels(names, spread, residual)
    return MixingCalibration(sensor, tuple(components), covariance, residual, loose)


def _doubt_channels(names: Sequence[str], spread: Array, residual: Array) -> tuple[str, ...]:
    """Warn of channels whose readings the loads hardly explain; raise if readings are constant.

    Return their names.
    """
    if dead := [name for name, of in zip(names, spread, strict=True) if of == 0.0]:
        raise ValueError(
            f"{', '.join(dead)} always read the same: omit channels that are not connected"
        )
    share = {
        name: max(1.0 - (left / of) ** 2, 0.0)
        for name, of, left in zip(names, spread, residual, strict=True)
        if left > _UNEXPLAINED * of
    }
    if share:
        loose = ", ".join(f"{name} ({part:.0%})" for name, part in share.items())
        warnings.warn(
            f"the loads explain only a part of the readings of {loose}: do the rows of "
            "both belong together, are there outliers or much noise, or do the channels read other "
            "components too?",
            stacklevel=3,
        )
    return tuple(share)


def _checked_errors(covariances: ArrayLike, wrenches: Array) -> Array:
    """Covariances (n, 6, 6) of the wrenches' errors; raise ValueError if they are not valid."""
    given = numbers("wrench_covariances", covariances)
    try:
        errors = np.broadcast_to(given, (len(wrenches), 6, 6))
    except ValueError as fault:
        raise ValueError(
            f"wrench_covariances broadcast to ({len(wrenches)}, 6, 6); got {given.shape}"
        ) from fault
    known = errors[np.isfinite(wrenches).all(axis=1)]
    size = np.sqrt(np.diagonal(known, axis1=1, axis2=2))
    if not (np.isfinite(known).all() and np.isfinite(size).all()):
        raise ValueError("wrench_covariances must be finite, with variances that are not negative")
    return errors


def _fit_channels(
    design: Array, y: Array, errors: Array, least: Array, names: tuple[str, ...]
) -> tuple[Array, Array, Array]:
    """Fit readings (n, k) to loads (n, p) with error covariances (n, p, p).

    Return weights (p, k), their covariances (k, p, p), and the variances (k,) of the noise, which
    are at least ``least``.
    """
    fit = solve(design, y, names, _ADVICE)
    n, p = design.shape
    variance = np.maximum((fit.residuals**2).sum(axis=0) / (n - p), least)
    if not errors.any():
        return fit.unknowns, variance[:, None, None] * fit.spread, variance
    size = np.abs(design).max(axis=0)
    found = [
        _fit_with_errors(design / size, reading, errors / (size[:, None] * size), *start)
        for reading, *start in zip(y.T, fit.unknowns.T * size, variance, least, strict=True)
    ]
    weights, spread, variance, doubtful = (np.array(part) for part in zip(*found, strict=True))
    if (doubtful & (least == 0.0)).any():
        warnings.warn(
            "the stated errors of the points or loads explain most of the residuals, which "
            "therefore do not determine the sensor's noise: state it as `noise`, from readings at "
            "rest",
            stacklevel=3,
        )
    return (weights / size).T, spread / (size[:, None] * size), variance


def _fit_with_errors(
    design: Array, y: Array, errors: Array, weights: Array, variance: float, least: float
) -> tuple[Array, Array, float, bool]:
    """Fit a channel: return weights, covariance, variance of the noise and whether it is doubtful.

    The covariance is that of estimating equations (a sandwich), in which the loads, cleared of that
    part of their errors which the residuals show, stand for the true ones.
    """

    def residuals(weights: Array, variance: float) -> Array:
        return np.asarray((y - design @ weights) / np.sqrt(variance + _blur(weights, errors)))

    for _ in range(_ROUNDS):
        found = optimize.least_squares(residuals, weights, args=(variance,))
        weights, before = np.asarray(found.x), variance
        left, blur = y - design @ weights, _blur(weights, errors)
        variance = _remaining(left**2, blur, len(y) - len(weights), least)
        if abs(variance - before) <= _SETTLED * before:
            break
    total = variance + blur
    shown = errors @ weights / total[:, None]
    cleared = design + shown * left[:, None]
    hidden = errors - shown[:, :, None] * shown[:, None, :] * total[:, None, None]
    outer = cleared.T / total @ cleared
    slope = outer - (hidden / total[:, None, None]).sum(axis=0)
    if np.linalg.eigvalsh(slope)[0] <= 0.0:
        raise ValueError(
            "the loads differ by no more than their stated errors, so they do not determine the "
            f"mixing: {_ADVICE}"
        )
    inverse = np.linalg.inv(slope)
    doubtful = variance < np.sqrt(2.0 / (total**-2.0).sum())
    return weights, inverse @ outer @ inverse, variance, bool(doubtful)


def _blur(weights: Array, errors: Array) -> Array:
    """Variances (n,) of a channel due to errors of the loads."""
    return np.asarray(np.einsum("p,npq,q->n", weights, errors, weights))


def _remaining(squared: Array, blur: Array, degrees: int, least: float) -> float:
    """Variance σ² with which Σ r² / (σ² + blur) is the number of degrees of freedom, if any."""
    floor = max(least, _SETTLED * float(squared.mean()))

    def excess(variance: float) -> float:
        return float((squared / (variance + blur)).sum()) - degrees

    if excess(floor) <= 0.0:
        return floor
    return float(optimize.brentq(excess, floor, squared.sum() / degrees + floor))


def _loaded(wrenches: Array) -> Array:
    """Set components of wrenches (n, 6) that are due to rounding to zero."""
    out = wrenches.copy()
    for kind in (slice(0, 3), slice(3, 6)):
        size = np.abs(out[:, kind]).max(axis=0, initial=0.0)
        out[:, kind] *= size > _ROUNDING * size.max()
    return out


def calibrate_on_contacts(
    whisker: Whisker,
    points: ArrayLike,
    readings: ArrayLike,
    *,
    point_sigma: ArrayLike = 0.0,
    **options: Any,
) -> MixingCalibration:
    """Fit mixing, offset and noise of a sensor to readings of contacts at known points.

    Any error of the assumed stiffness is absorbed by the mixing: if the whisker is assumed twice
    too stiff, the mixing is half of the true one. With such a calibration, estimated contact points
    are correct in spite of the wrong stiffness, but forces are not.

    Parameters
    ----------
    whisker : Whisker
        Whisker on the sensor.
    points : array_like (n, 3)
        Frictionless contact points on its centreline, whisker frame, m.
    readings : array_like (n, k)
        Readings of the channels at these contacts; rows with NaN in either are ignored.
    point_sigma : array_like
        Standard deviation of the points' coordinates, m, as in `fit_stiffness`. If points with
        errors are taken as exact, the mixing is too small and its uncertainty too.
    **options
        Names of channels, components, resolution and largest reading, as in `calibrate_mixing`.

    Returns
    -------
    MixingCalibration
        Sensor with its uncertainty.

    Raises
    ------
    ValueError
        If more than half of the contacts are not possible, or they do not separate the components.

    Warns
    -----
    UserWarning
        If contacts are not possible, which are left out, or if errors of the points hide the noise.
    """
    bent = deflections_to(whisker, points)
    sigma = spread_of_points(point_sigma, np.asarray(points, dtype=np.float64), whisker.length)
    if sigma.any():
        slopes = wrench_slopes(bent) * sigma[:, None]
        options["wrench_covariances"] = slopes @ slopes.swapaxes(1, 2)
    return calibrate_mixing(readings, wrenches_of(bent), **options)


_HEAVY = 5.0  # mass above which the user is warned, kg
_SURELY = 4.0  # standard deviations by which a mass may be negative owing to noise
_IDLE = 1e-12  # relative effect on the channels below which an unknown has none
_POSES = (
    "hold the whisker free of contact in more orientations, at least three that differ in the "
    "direction of gravity"
)
_MASS = ("the mass", "its moment along x", "along y", "along z")


@dataclass(frozen=True, eq=False)
class WeightCalibration:
    """Offset and weight, calibrated without contact.

    Attributes
    ----------
    sensor : Sensor
        Sensor with the fitted offset and, if orientations were given, mass and its moment.
    covariance : (k + 4, k + 4) array
        Covariance of the offsets, the mass (kg) and its moment (kg·m); zero for quantities that
        were not fitted or have no effect on these channels.
    residual : (k,) array
        Root mean square residual of each channel.
    misfit : float
        χ² per degree of freedom: near 1, unless the noise or something else is not as stated; if
        it is above 1, the covariance is multiplied by it.
    """

    sensor: Sensor
    covariance: Array
    residual: Array
    misfit: float


def calibrate_weight(
    sensor: Sensor,
    readings: ArrayLike,
    rotations: ArrayLike | None = None,
    gravity: ArrayLike = GRAVITY,
) -> WeightCalibration:
    """Fit offset and weight to readings without contact.

    Parameters
    ----------
    sensor : Sensor
        Sensor with known mixing and frame; channels are weighted by its noise.
    readings : array_like (n, k)
        Readings without contact; rows with NaN or a saturated channel are ignored.
    rotations : array_like (n, 3, 3), optional
        Rotations from the whisker frame to the laboratory frame. Without them only the offset is
        fitted, which then includes the weight in this one orientation.
    gravity : array_like (3,)
        Gravitational acceleration in the laboratory frame, m/s².

    Returns
    -------
    WeightCalibration
        Sensor with offset and weight.

    Raises
    ------
    ValueError
        If shapes do not match, the orientations do not separate weight from offset, or the mass is
        significantly negative.

    Warns
    -----
    UserWarning
        If residuals are more than five times the noise or less than a hundredth of it, or the mass
        is more than 5 kg.
    """
    y = numbers("readings", readings, any_unit=True)
    k = len(sensor.channels)
    if y.ndim != 2 or y.shape[1] != k:
        raise ValueError(f"readings are (n, {k}): {', '.join(sensor.channels)}; got {y.shape}")
    known = np.flatnonzero((np.abs(y) < sensor.largest).all(axis=1))  # False for NaN
    n, y = len(y), y[known]
    if not len(y):
        raise ValueError("there is no reading without NaN or a saturated channel")
    noise = np.sqrt(np.diag(sensor.covariance()))
    noise = np.where(noise > 0.0, noise, np.median(noise[noise > 0.0]) if noise.any() else 1.0)
    if rotations is None:
        return _tared(sensor, y, noise)
    turn = rotation_matrices("rotations", rotations)
    if turn.shape != (n, 3, 3):
        raise ValueError(f"{n} readings need as many rotations (3, 3); got {turn.shape}")
    design = _design(sensor, turn[known], numbers("gravity", gravity))
    # Unknowns without effect in any orientation stay zero; the others must be determined.
    every = np.array([np.eye(3), *np.eye(3)[[[1, 2, 0], [2, 0, 1]]]])
    every = np.concatenate([every, -every, every[:, ::-1]])
    possible = _design(sensor, every, numbers("gravity", gravity))[:, :, k:]
    effect = np.abs(possible).max(axis=(0, 1))
    effective = np.concatenate(
        [np.ones(k, bool), effect > _IDLE * max(float(effect.max()), 1e-300)]
    )
    found, unknowns, covariance = _solved(sensor, design, y, noise, effective)
    if unknowns[k] < 0.0:
        sigma = float(np.sqrt(covariance[k, k]))
        if unknowns[k] < -_SURELY * sigma:
            raise ValueError(
                f"the readings weigh {1e3 * unknowns[k]:.3g} ± {1e3 * sigma:.2g} g: the sensor "
                "reports a reaction (`reaction` of its frame), has other axes, or gravity or the "
                "rotations point the other way"
            )
        effective[k] = False  # the mass is too small to be measured
        found, unknowns, covariance = _solved(sensor, design, y, noise, effective)
    misfit = float((found.residuals**2).sum() / max(found.residuals.size - effective.sum(), 1))
    covariance = max(1.0, misfit) * covariance
    calibrated = replace(
        sensor,
        bias=unknowns[:k],
        mass=float(unknowns[k]),
        mass_moment=unknowns[k + 1 :],
        mixing_covariance=with_offset(sensor.mixing_covariance, np.diag(covariance)[:k]),
    )
    if unknowns[k] > _HEAVY:
        warnings.warn(
            f"the sensor seems to carry {unknowns[k]:.3g} kg: are its channels in N and N·m, or in "
            "the units that its mixing implies?",
            stacklevel=2,
        )
    left = found.residuals.reshape(-1, k) * noise
    if sensor.covariance().any():
        warn_of_misfit(
            misfit,
            "that the rotations are those of the whisker's base (not of a flange), from the "
            "whisker frame to the laboratory frame, and the sensor's axes and handedness",
        )
    return WeightCalibration(calibrated, covariance, np.sqrt((left**2).mean(axis=0)), misfit)


def tare(
    sensor: Sensor,
    readings: ArrayLike,
    rotations: ArrayLike | None = None,
    gravity: ArrayLike = GRAVITY,
) -> Sensor:
    """Measure the offset again, as after a drift; mass and its moment are kept.

    Parameters
    ----------
    sensor : Sensor
        Calibrated sensor.
    readings : array_like (n, k)
        Readings without contact; those with NaN or a saturated channel are ignored.
    rotations : array_like (3, 3) or (n, 3, 3), optional
        Rotation from the whisker frame to the laboratory frame, required if the sensor carries a
        mass.
    gravity : array_like (3,)
        Gravitational acceleration in the laboratory frame, m/s².

    Returns
    -------
    Sensor
        Sensor with the new offset.
    """
    free = np.atleast_2d(sensor.compensated(readings, rotations, gravity))
    free = free[np.isfinite(free).all(axis=1)]
    if not len(free):
        raise ValueError("there is no reading without NaN or a saturated channel")
    return sensor.with_new_offset(len(free), sensor.bias + free.mean(axis=0))


def _solved(
    sensor: Sensor, design: Array, y: Array, noise: Array, effective: Mask
) -> tuple[Solution, Array, Array]:
    """Solution for the effective unknowns, all unknowns and their covariance."""
    k = len(sensor.channels)
    names = [f"the offset of {name}" for name in sensor.channels] + list(_MASS)
    rows = (design / noise[:, None]).reshape(-1, k + 4)[:, effective]
    found = solve(
        rows,
        (y / noise).reshape(-1),
        [name for name, used in zip(names, effective, strict=True) if used],
        _POSES,
    )
    unknowns, covariance = np.zeros(k + 4), np.zeros((k + 4, k + 4))
    unknowns[effective] = found.unknowns
    covariance[np.ix_(effective, effective)] = found.spread
    return found, unknowns, covariance


def _tared(sensor: Sensor, y: Array, noise: Array) -> WeightCalibration:
    """Calibrate the offset only, as the mean of readings (n, k)."""
    k = y.shape[1]
    bias = y.mean(axis=0)
    covariance = np.zeros((k + 4, k + 4))
    covariance[:k, :k] = np.diag(noise**2 / len(y))
    left = np.sqrt(((y - bias) ** 2).mean(axis=0))
    light = replace(sensor, mass=0.0, mass_moment=np.zeros(3))
    tared = light.with_new_offset(len(y), bias)
    misfit = float((left**2 / noise**2).sum() * len(y) / max(len(y) - 1, 1) / k)
    if sensor.covariance().any():
        what = "that nothing was touched, and that the orientation stayed the same"
        warn_of_misfit(misfit, what, stacklevel=4)
    return WeightCalibration(tared, covariance, left, misfit)


def _design(sensor: Sensor, rotations: Array, gravity: Array) -> Array:
    """Derivatives ∂y/∂(b, m, μ) of readings, (n, k, k + 4)."""
    g = gravity @ rotations
    h = sensor.base_mixing
    n, k = len(g), len(h)
    out = np.zeros((n, k, k + 4))
    out[:, :, :k] = np.eye(k)
    out[:, :, k] = g @ h[:, :3].T
    out[:, :, k + 1 :] = -h[:, 3:] @ cross_matrix(g)  # μ × g = -g × μ
    return out
