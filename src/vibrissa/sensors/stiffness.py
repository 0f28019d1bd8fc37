"""Modulus and base radius from measured loads, as far as loads determine them.

For contacts at known points on the centreline the shape does not depend on how stiff the whisker
is: force and moment are proportional to EI = E π r⁴ / 4 at the base (the twisting stiffness follows
by Poisson's ratio, the others by the taper). So loads determine EI, and only another measurement
separates E from r⁴: a radius under the microscope, or a modulus from a data sheet. Given the
uncertainties of both before, log E and log r are moved along their line

    log E + 4 log r = log(4 EI / π)

by Bayes' rule. Loads do determine how the stiffness falls toward the tip, if contacts are at
several positions along the whisker: the taper can be fitted too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.numerics import Array
from vibrissa.sensors.mixing import wrenches_of_contacts
from vibrissa.sensors.regression import warn_of_misfit, warn_of_surprise
from vibrissa.sensors.sensor import Sensor

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker


_OPEN = 2.0
"""Standard deviation of the logarithm of a taper from which it is not determined."""

_SLIM, _WIDE = 0.01, 2.0
"""Bounds of a fitted taper."""

_SOFT, _STIFF = 1.0, 1e4
"""Bounds of the fitted stiffness of a base, over EI/L; what is stiffer is rigid."""

_SPRING = 30.0
"""Stiffness of a base that the fit begins with, over EI/L."""

_TYPICAL_NOISE = 0.01
"""Noise of channels that state none, as a share of the size of their readings."""


@dataclass(frozen=True, eq=False)
class StiffnessFit:
    """A whisker's stiffness as determined by loads; standard deviations are relative.

    Attributes
    ----------
    whisker : Whisker
        Whisker with the modulus, radius and taper that were found.
    stiffness : float
        Bending stiffness EI at the base, N·m².
    stiffness_sigma : float
        Standard deviation of the stiffness.
    modulus, radius : float
        Young's modulus, Pa, and base radius, m.
    modulus_sigma, radius_sigma : float
        Standard deviations of these; infinite if both were unknown before.
    covariance : (2, 2) array
        Covariance of (log E, log r): strongly correlated, as loads determine log E + 4 log r.
    taper, taper_sigma : float
        Tip radius over base radius; the deviation is 0 where it was not fitted.
    misfit : float
        χ² per degree of freedom; where larger than 1 the deviations are scaled up by its
        root.
    base_stiffness : float
        Stiffness of the base in bending and in twist, N·m/rad; infinite where it was not fitted.
    compliance_sigma : float
        Standard deviation of its inverse, rad/(N·m), as of ``ContactMap.estimate``; 0 likewise.
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
        Contact points on the centreline, whisker's frame, m; without friction.
    readings : array_like (n, k)
        Readings of the sensor's channels, without offset and weight (`Sensor.compensated`).
    sensor : Sensor, optional
        Sensor with mixing and noise; by default (F, M) at the base with the usual noise. It must
        not have been calibrated on contacts of this whisker: that makes the stiffness part of the
        mix.
    modulus_sigma, radius_sigma : float
        Relative standard deviations of the whisker's modulus and radius before: ``inf`` for
        unknown, 0 for exact. At least one must be finite.
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
        If shapes do not fit, nothing is measured, or what is asked for is not determined.

    Warns
    -----
    UserWarning
        If residuals are more than five times the noise, or E r⁴ is more than five standard
        deviations from what was known before.
    """
    sensor = sensor or Sensor()
    y = np.asarray(readings, dtype=np.float64)
    contacts = np.asarray(points, dtype=np.float64)
    if y.shape != (len(contacts), len(sensor.channels)):
        raise ValueError(f"readings are ({len(contacts)}, {len(sensor.channels)}); got {y.shape}")
    if modulus_sigma < 0.0 or radius_sigma < 0.0 or np.isinf([modulus_sigma, radius_sigma]).all():
        raise ValueError(
            "loads determine E r⁴ only: modulus_sigma or radius_sigma must be finite, none "
            "negative; "
            f"got {modulus_sigma} and {radius_sigma}"
        )
    known = np.isfinite(y).all(axis=1) & np.isfinite(contacts).all(axis=1)
    y, contacts = y[known], contacts[known]
    noise = np.sqrt(np.diag(sensor.covariance()))
    size = np.sqrt((y**2).mean(axis=0)) if len(y) else noise
    noise = np.where(noise > 0.0, noise, _TYPICAL_NOISE * np.where(size > 0.0, size, 1.0))

    def modelled(ratio: float, spring: float | None = None) -> Array:
        held = _on_spring(_tapered(whisker, ratio), spring)
        return wrenches_of_contacts(held, contacts) @ sensor.base_mixing.T / noise

    ratio = whisker.tip_radius / whisker.base_radius
    scaled = y / noise
    if not len(y) or not (modelled(ratio) * scaled).sum() > 0.0:
        raise ValueError(
            "the readings do not grow with the loads: check the sensor's axes, sign (`reaction`) "
            "and offset, or nothing is measured"
        )
    ratio, factor, spring, spread, left = _fitted(modelled, scaled, ratio, taper, base)
    degrees = y.size - 1 - taper - base
    misfit = float((left**2).sum() / max(degrees, 1))
    warn_of_misfit(
        misfit,
        "contact points, shape and taper (which end is the base?), the sensor's frame, "
        "offset and weight",
    )
    spread = spread * max(1.0, misfit)
    if base and np.sqrt(spread[-1, -1]) > _OPEN:
        raise ValueError(
            "the contacts do not determine the stiffness of the base: it is too stiff to matter, "
            "or they are too few or too alike"
        )
    if taper and np.sqrt(spread[1, 1]) > _OPEN:
        raise ValueError(
            "the contacts do not determine the taper: touch the whisker nearer to the tip as well"
        )
    sigma = float(np.sqrt(spread[0, 0]))
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


def _on_spring(whisker: Whisker, spring: float | None) -> Whisker:
    """The whisker on a spring of this stiffness over EI/L; as it is held where there is none."""
    if spring is None:
        return whisker
    stiffness = spring * whisker.base_bending_stiffness / whisker.length
    return whisker.with_properties(base_stiffness=(stiffness, stiffness))


def _tapered(whisker: Whisker, ratio: float) -> Whisker:
    if ratio == whisker.tip_radius / whisker.base_radius:
        return whisker
    return whisker.with_properties(
        base_radius=whisker.base_radius, tip_radius=ratio * whisker.base_radius
    )


def _fitted(
    modelled: Callable[..., Array], scaled: Array, ratio: float, taper: bool, base: bool
) -> tuple[float, float, float | None, Array, Array]:
    """Taper, factor of the stiffness, spring of the base, covariance of their logs, residuals.

    The covariance is that of factor, taper and spring in this order, as far as they are fitted.
    """
    from scipy.optimize import least_squares

    model = modelled(ratio, _SPRING if base else None)
    factor = float((model * scaled).sum() / (model**2).sum())
    if not (taper or base):
        spread = np.full((1, 1), 1.0 / (factor**2 * (model**2).sum()))
        return ratio, factor, None, spread, scaled - factor * model

    def parts(unknowns: Array) -> tuple[float, float | None]:
        values = iter(np.exp(unknowns[1:]).tolist())
        return (next(values) if taper else ratio), (next(values) if base else None)

    def residuals(unknowns: Array) -> Array:
        return np.asarray((np.exp(unknowns[0]) * modelled(*parts(unknowns)) - scaled).ravel())

    unknowns = [(factor, 0.0, np.inf)]
    unknowns += [(ratio, _SLIM, _WIDE)] if taper else []
    unknowns += [(_SPRING, _SOFT, _STIFF)] if base else []
    with np.errstate(divide="ignore"):
        start, low, high = np.log(np.array(unknowns)).T
    found = least_squares(residuals, start, bounds=(low, high), diff_step=[1e-4] * len(start))
    jacobian = np.asarray(found.jac, dtype=np.float64)
    inverse = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64)
    ratio, spring = parts(found.x)
    return ratio, float(np.exp(found.x[0])), spring, inverse, found.fun


def _separated(
    log_factor: float, sigma: float, modulus_sigma: float, radius_sigma: float
) -> tuple[Array, Array]:
    """Shift of (log E, log r) by which log E + 4 log r grows so much, and their covariance."""
    by = np.array([1.0, 4.0])
    if np.isinf(modulus_sigma) or np.isinf(radius_sigma):
        # One is free: the other keeps its value and uncertainty, and it takes up the rest.
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
