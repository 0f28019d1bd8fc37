"""Calibration of a sensor and of its whisker from known wrenches and from readings without contact.

**Mixing and offset**, y = A w + b, are fitted channel by channel. The wrenches are those of known
loads, or those computed for contacts of the whisker.

**Offset and weight** are fitted to readings without contact in several orientations,

    y = b + H (m g, μ × g),

linear in the offset b, the mass m and its moment μ = m c, with g in the frame of the base.

**Modulus and base radius** are fitted to measured loads. For contacts at known points on the
centreline the shape does not depend on the whisker's stiffness, and force and moment are
proportional to EI = E π r⁴ / 4 at the base (the torsional stiffness follows from Poisson's ratio,
the stiffness elsewhere from the taper). Loads therefore determine EI only; separating E from r⁴
requires another measurement, such as a radius under the microscope or a modulus from a data sheet.
Given prior uncertainties of both, Bayes' rule updates log E and log r subject to

    log E + 4 log r = log(4 EI / π).

If contacts are at several positions along the whisker, loads also determine how the stiffness
decreases toward the tip, so that the taper can be fitted too.

Measured contact points have errors, e of covariance Σ_p. With the wrench w(p) of a contact and its
derivative G = ∂w/∂p, readings deviate from H w by noise and by H G e, so that their covariance is

    S = N + H G Σ_p Gᵀ Hᵀ

for each contact. S is proportional to EI² in its second part, and is minimised over together with
the residuals' size; with S fixed, the fitted stiffness would be too small, as in any regression on
a quantity with errors.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import optimize
from vibrissa.numerics import Array, Mask, cross_matrix, numbers, rotation_matrices
from vibrissa.rod import Deflection, PointContact, deflect, discretize, solve_forces
from vibrissa.sensors.frame import SensorFrame
from vibrissa.sensors.regression import Solution, solve, warn_of_misfit, warn_of_surprise
from vibrissa.sensors.sensor import COMPONENTS, GRAVITY, Sensor, with_offset
from vibrissa.status import describe, is_ok
from vibrissa.whisker import Whisker

_ROUNDING = 1e-6  # relative size below which components of a force or moment are set to zero
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
    """

    sensor: Sensor
    components: tuple[str, ...]
    covariance: Array
    residual: Array


def calibrate_mixing(
    readings: ArrayLike,
    wrenches: ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    components: Sequence[str] = COMPONENTS,
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
        contacts at known points. They are treated as exact.
    channels : sequence of str, optional
        Names of the k channels.
    components : sequence of str
        Components that a channel may read; the mixing of the others is zero. The wrenches of
        frictionless contacts span only a small part of all wrenches; in most, Mx is nearly zero.
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
    """
    y, w = numbers("readings", readings, channels or ()), numbers("wrenches", wrenches, components)
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
    fit = solve(design, y[known], (*components, "the offset"), _ADVICE)
    free = known.sum() - design.shape[1]
    if free < 1:
        raise ValueError(
            f"{known.sum()} contacts are too few for {design.shape[1]} unknowns and the noise: "
            "add some"
        )
    variance = (fit.residuals**2).sum(axis=0) / free
    mixing = np.zeros((y.shape[1], 6))
    mixing[:, which] = fit.unknowns[:-1].T
    covariance = variance[:, None, None] * fit.spread
    whole = np.zeros((y.shape[1], 7, 7))
    whole[np.ix_(range(y.shape[1]), [*which, 6], [*which, 6])] = covariance
    sensor = Sensor(
        names,
        mixing,
        np.sqrt(np.maximum(variance - np.asarray(resolution) ** 2 / 12.0, 0.0)),
        fit.unknowns[-1],
        resolution=resolution,
        largest=largest,
        frame=SensorFrame(),
        mixing_covariance=whole,
    )
    residual = np.sqrt((fit.residuals**2).mean(axis=0))
    return MixingCalibration(sensor, tuple(components), covariance, residual)


def _loaded(wrenches: Array) -> Array:
    """Set components of wrenches (n, 6) that are due to rounding to zero."""
    out = wrenches.copy()
    for kind in (slice(0, 3), slice(3, 6)):
        size = np.abs(out[:, kind]).max(axis=0, initial=0.0)
        out[:, kind] *= size > _ROUNDING * size.max()
    return out


def wrenches_of_contacts(whisker: Whisker, points: ArrayLike) -> Array:
    """Wrenches (n, 6) at the base of frictionless contacts at known points (n, 3)."""
    return _wrenches(_touched(whisker, points))


def _touched(whisker: Whisker, points: ArrayLike) -> Deflection:
    """Deflections by contacts at known points (n, 3), all of which must be possible."""
    contacts = numbers("points", points)
    if contacts.ndim != 2 or contacts.shape[1] != 3:
        raise ValueError(f"contact points are (n, 3), m; got {contacts.shape}")
    bent = deflect(whisker, PointContact(contacts))
    bad = ~is_ok(bent.status) & np.isfinite(contacts).all(axis=1)
    if bad.any():
        reasons = "; ".join(f"{n} × {text}" for text, n in describe(bent.status[bad]).items())
        raise ValueError(f"{bad.sum()} of {bad.size} contacts are not possible: {reasons}")
    return bent


def _wrenches(bent: Deflection) -> Array:
    return np.concatenate([bent.force, bent.moment], axis=-1)


def _wrench_slopes(bent: Deflection) -> Array:
    """Derivatives (n, 6, 3) of the wrench at the base with respect to the contact point."""
    d = discretize(bent.whisker, bent.steps)
    contacts = np.column_stack([bent.arc_length / d.length, bent.contact_force / d.force])
    tangents = solve_forces(d, contacts, tangents=True)[1]
    by_point = tangents[:, :3] @ np.linalg.inv(tangents[:, 3:]) * (d.force / d.length)
    turning = cross_matrix(bent.contact_point) @ by_point - cross_matrix(bent.force)
    return np.concatenate([by_point, turning], axis=1)


def calibrate_on_contacts(
    whisker: Whisker, points: ArrayLike, readings: ArrayLike, **options: Any
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
    **options
        Names of channels, components, resolution and largest reading, as in `calibrate_mixing`.

    Returns
    -------
    MixingCalibration
        Sensor with its uncertainty.

    Raises
    ------
    ValueError
        If a contact is not possible, or the contacts do not separate the components.
    """
    return calibrate_mixing(readings, wrenches_of_contacts(whisker, points), **options)


_HEAVY = 5.0  # mass above which the user is warned, kg
_SURELY = 4.0  # standard deviations by which a mass may be negative owing to noise
_IN_OTHER_UNITS = 300.0  # factor of the stated stiffness above which units are in question
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
        If residuals are more than five times the noise, or the mass is more than 5 kg.
    """
    y = numbers("readings", readings)
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
    warn_of_misfit(
        misfit,
        "that the rotations are those of the whisker's base (not of a flange), from the whisker "
        "frame to the laboratory frame, and the sensor's axes and handedness",
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

    Raises
    ------
    ValueError
        If shapes do not match, a required rotation is missing, or no reading is complete.
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
    warn_of_misfit(misfit, "that nothing was touched, and that the orientation stayed the same")
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


_OPEN = 2.0  # standard deviation of a logarithm above which a quantity is not determined
_SLIM, _WIDE = 0.01, 2.0  # bounds of a fitted taper
# Bounds of the fitted stiffness of a base, in units of EI/L; a stiffer base is rigid in effect.
_SOFT, _STIFF = 1.0, 1e4
_SPRING = 30.0  # initial stiffness of a base in the fit, in units of EI/L
_DIFFERENCE = 1e-4  # of logarithms, in finite differences
_TYPICAL_NOISE = 0.01  # noise of channels without stated noise, relative to their readings


@dataclass(frozen=True, eq=False)
class StiffnessFit:
    """Stiffness of a whisker, fitted to loads; standard deviations are relative.

    Attributes
    ----------
    whisker : Whisker
        Whisker with the fitted modulus, radius and taper.
    stiffness : float
        Bending stiffness EI at the base, N·m².
    stiffness_sigma : float
        Standard deviation of the stiffness.
    modulus, radius : float
        Young's modulus, Pa, and base radius, m.
    modulus_sigma, radius_sigma : float
        Standard deviations of modulus and radius.
    covariance : (2, 2) array
        Covariance of (log E, log r): strongly correlated, as loads determine log E + 4 log r.
    taper, taper_sigma : float
        Ratio of tip to base radius, and its standard deviation, which is 0 if it was not fitted.
    misfit : float
        χ² per degree of freedom; if it is above 1, standard deviations are multiplied by its square
        root.
    base_stiffness : float
        Stiffness of the base in bending and twist, N·m/rad; infinite if it was not fitted.
    compliance_sigma : float
        Standard deviation of its inverse, rad/(N·m), as used by ``ContactMap.estimate``; 0 if it
        was not fitted.
    """

    whisker: Whisker
    stiffness: float
    stiffness_sigma: float
    modulus: float
    modulus_sigma: float
    radius: float
    radius_sigma: float
    covariance: Array
    taper: float
    taper_sigma: float
    misfit: float
    base_stiffness: float = np.inf
    compliance_sigma: float = 0.0


def fit_stiffness(
    whisker: Whisker,
    points: ArrayLike,
    readings: ArrayLike,
    sensor: Sensor | None = None,
    *,
    point_sigma: ArrayLike = 0.0,
    modulus_sigma: float = np.inf,
    radius_sigma: float = 0.02,
    taper: bool = False,
    base: bool = False,
) -> StiffnessFit:
    """Fit modulus and base radius to measured loads.

    Parameters
    ----------
    whisker : Whisker
        Whisker with the stated shape, modulus and radius.
    points : array_like (n, 3)
        Frictionless contact points on the centreline, whisker frame, m.
    readings : array_like (n, k)
        Readings of the sensor's channels, without offset and weight (`Sensor.compensated`).
    sensor : Sensor, optional
        Sensor with mixing and noise; by default (F, M) at the base with the default noise. It must
        not have been calibrated on contacts of this whisker, as its mixing then absorbs errors of
        the stiffness.
    point_sigma : array_like
        Standard deviation of the points' coordinates, m: one number, or an array that broadcasts to
        (n, 3). Errors are independent; one that all points share, such as that of the position of
        the base, is not included.
    modulus_sigma, radius_sigma : float
        Prior relative standard deviations of the whisker's modulus and radius: ``inf`` for unknown,
        0 for exact. At least one must be finite.
    taper : bool
        Whether the ratio of tip to base radius is fitted too (the radius then is linear).
    base : bool
        Whether the stiffness of the base is fitted too: a spring, the same in bending and in twist.

    Returns
    -------
    StiffnessFit
        Stiffness with its uncertainty.

    Raises
    ------
    ValueError
        If shapes do not match, the readings do not follow the loads, or the contacts do not
        determine the taper or base stiffness to be fitted.

    Warns
    -----
    UserWarning
        If residuals are more than five times the noise, or E r⁴ is more than five standard
        deviations from its prior value.
    """
    sensor = sensor or Sensor()
    y = numbers("readings", readings)
    contacts = numbers("points", points)
    if y.shape != (len(contacts), len(sensor.channels)):
        raise ValueError(f"readings are ({len(contacts)}, {len(sensor.channels)}); got {y.shape}")
    if modulus_sigma < 0.0 or radius_sigma < 0.0 or np.isinf([modulus_sigma, radius_sigma]).all():
        raise ValueError(
            "loads determine E r⁴ only: modulus_sigma or radius_sigma must be finite, none "
            "negative; "
            f"got {modulus_sigma} and {radius_sigma}"
        )
    known = np.isfinite(y).all(axis=1) & np.isfinite(contacts).all(axis=1)
    blur = _spread_of_points(point_sigma, contacts)[known]
    y, contacts = y[known], contacts[known]
    noise = np.sqrt(np.diag(sensor.covariance()))
    size = np.sqrt((y**2).mean(axis=0)) if len(y) else noise
    noise = np.where(noise > 0.0, noise, _TYPICAL_NOISE * np.where(size > 0.0, size, 1.0))

    response = sensor.base_mixing / noise[:, None]

    @lru_cache(maxsize=4)
    def modelled(ratio: float, spring: float | None) -> tuple[Array, Array | None]:
        bent = _touched(_on_spring(_tapered(whisker, ratio), spring), contacts)
        errors = response @ _wrench_slopes(bent) * blur[:, None] if blur.any() else None
        return _wrenches(bent) @ response.T, errors

    ratio = whisker.tip_radius / whisker.base_radius
    scaled = y / noise
    if not len(y) or not (modelled(ratio, None)[0] * scaled).sum() > 0.0:
        raise ValueError(
            "the readings do not increase with the loads: check the sensor's axes, sign "
            "(`reaction`) and offset, and whether the channels respond at all"
        )
    ratio, factor, spring, spread, left = _fitted(modelled, scaled, ratio, taper, base)
    degrees = y.size - 1 - taper - base
    misfit = float((left**2).sum() / max(degrees, 1))
    warn_of_misfit(
        misfit,
        "contact points (and their `point_sigma`), shape and taper (which end is the base?), the "
        "sensor's frame, offset and weight",
    )
    spread = spread * max(1.0, misfit)
    _check_determined(spread, taper, base)
    sigma = float(np.sqrt(spread[0, 0]))
    _warn_of_units(factor)
    shift, covariance = _separated(np.log(factor), sigma, modulus_sigma, radius_sigma)
    modulus = whisker.youngs_modulus * float(np.exp(shift[0]))
    growth = float(np.exp(shift[1]))
    shaped = _tapered(whisker, ratio).scaled(radius_factor=growth)
    found = _on_spring(shaped.with_properties(youngs_modulus=modulus), spring)
    held = np.inf if found.base_stiffness is None or not base else found.base_stiffness[0]
    return StiffnessFit(
        whisker=found,
        stiffness=found.base_bending_stiffness,
        stiffness_sigma=sigma,
        modulus=modulus,
        modulus_sigma=float(np.sqrt(covariance[0, 0])),
        radius=found.base_radius,
        radius_sigma=float(np.sqrt(covariance[1, 1])),
        covariance=covariance,
        taper=float(ratio),
        taper_sigma=float(np.sqrt(spread[1, 1])) if taper else 0.0,
        misfit=misfit,
        base_stiffness=held,
        compliance_sigma=float(np.sqrt(spread[-1, -1])) / held if base else 0.0,
    )


def _check_determined(spread: Array, taper: bool, base: bool) -> None:
    """Raise ValueError if the contacts do not determine the taper or the base's stiffness."""
    if base and np.sqrt(spread[-1, -1]) > _OPEN:
        raise ValueError(
            "the contacts do not determine the stiffness of the base: it is too stiff to matter, "
            "or they are too few or too alike"
        )
    if taper and np.sqrt(spread[1, 1]) > _OPEN:
        raise ValueError(
            "the contacts do not determine the taper: touch the whisker nearer to the tip as well"
        )


def _spread_of_points(point_sigma: ArrayLike, contacts: Array) -> Array:
    """Standard deviations (n, 3) of contact points; raise ValueError if they are not valid."""
    sigma = numbers("point_sigma", point_sigma)
    try:
        spread = np.broadcast_to(sigma, contacts.shape)
    except ValueError as fault:
        raise ValueError(
            f"point_sigma is one number or broadcasts to {contacts.shape}; got {sigma.shape}"
        ) from fault
    if not (np.isfinite(spread) & (spread >= 0.0)).all():
        raise ValueError(f"point_sigma must be finite and not negative, m; got {sigma.tolist()}")
    return spread


def _warn_of_units(factor: float) -> None:
    """Warn if the fitted stiffness differs from the stated one by an implausible factor."""
    if not 1.0 / _IN_OTHER_UNITS < factor < _IN_OTHER_UNITS:
        warnings.warn(
            f"the fitted stiffness is {factor:.3g} times the whisker's stated one: are the "
            "readings in N and N·m, and is the whisker's radius right?",
            UserWarning,
            stacklevel=3,
        )


def _on_spring(whisker: Whisker, spring: float | None) -> Whisker:
    """Whisker on a base spring of a stiffness in units of EI/L; unchanged if it is None."""
    if spring is None:
        return whisker
    stiffness = spring * whisker.base_bending_stiffness / whisker.length
    return whisker.with_properties(base_stiffness=(stiffness, stiffness))


def _tapered(whisker: Whisker, ratio: float) -> Whisker:
    """Whisker with another ratio of tip to base radius."""
    if ratio == whisker.tip_radius / whisker.base_radius:
        return whisker
    return whisker.with_properties(
        base_radius=whisker.base_radius, tip_radius=ratio * whisker.base_radius
    )


def _fitted(
    modelled: Callable[..., tuple[Array, Array | None]],
    scaled: Array,
    ratio: float,
    taper: bool,
    base: bool,
) -> tuple[float, float, float | None, Array, Array]:
    """Fit taper, stiffness factor and base spring; return these, a covariance and residuals.

    The covariance is that of the logarithms of factor, taper and spring in this order, as far as
    they are fitted. The model is that of the readings, and of errors (n, k, 3) due to those of the
    points if there are any, all relative to the noise.
    """
    model, errors = modelled(ratio, _SPRING if base else None)
    factor = float((model * scaled).sum() / (model**2).sum())
    if not (taper or base) and errors is None:
        spread = np.full((1, 1), 1.0 / (factor**2 * (model**2).sum()))
        return ratio, factor, None, spread, scaled - factor * model

    def parts(unknowns: Array) -> tuple[float, float | None]:
        values = iter(np.exp(unknowns[1:]).tolist())
        return (next(values) if taper else ratio), (next(values) if base else None)

    def residuals(change: Array) -> Array:
        factor = np.exp(start[0] + change[0])
        model, errors = modelled(*parts(start + change))
        wrong = factor * model - scaled
        if errors is not None:
            spread = np.eye(wrong.shape[1]) + factor**2 * errors @ errors.swapaxes(1, 2)
            wrong = np.linalg.solve(np.linalg.cholesky(spread), wrong[:, :, None])
        return np.asarray(wrong.ravel())

    def slopes(change: Array) -> Array:
        # SciPy's differences are relative to the unknowns, and useless for one near zero.
        here = residuals(change)
        there = [residuals(change + step) for step in _DIFFERENCE * np.eye(len(start))]
        return np.asarray((np.stack(there, axis=1) - here[:, None]) / _DIFFERENCE)

    unknowns = [(factor, 0.0, np.inf)]
    unknowns += [(ratio, _SLIM, _WIDE)] if taper else []
    unknowns += [(_SPRING, _SOFT, _STIFF)] if base else []
    with np.errstate(divide="ignore"):
        start, low, high = np.log(np.array(unknowns)).T
    found = optimize.least_squares(
        residuals, np.zeros(len(start)), slopes, bounds=(low - start, high - start)
    )
    jacobian = np.asarray(found.jac, dtype=np.float64)
    inverse = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64)
    logarithms = start + found.x
    ratio, spring = parts(logarithms)
    return ratio, float(np.exp(logarithms[0])), spring, inverse, found.fun


def _separated(
    log_factor: float, sigma: float, modulus_sigma: float, radius_sigma: float
) -> tuple[Array, Array]:
    """Change of (log E, log r) for a given change of log E + 4 log r, and their covariance."""
    by = np.array([1.0, 4.0])
    if np.isinf(modulus_sigma) or np.isinf(radius_sigma):
        # The unknown one is free; the other keeps its value and uncertainty.
        free = 0 if np.isinf(modulus_sigma) else 1
        kept = radius_sigma if free == 0 else modulus_sigma
        slope = by[1 - free] / by[free]
        shift, covariance = np.zeros(2), np.empty((2, 2))
        shift[free] = log_factor / by[free]
        covariance[1 - free, 1 - free] = kept**2
        covariance[0, 1] = covariance[1, 0] = -slope * kept**2
        covariance[free, free] = (sigma / by[free]) ** 2 + (slope * kept) ** 2
        return shift, covariance
    prior = np.diag([modulus_sigma**2, radius_sigma**2])
    total = by @ prior @ by + sigma**2
    warn_of_surprise(log_factor, float(np.sqrt(total)))
    if total == 0.0:
        return np.zeros(2), prior
    gain = prior @ by / total
    return gain * log_factor, prior - np.outer(gain, by @ prior)
