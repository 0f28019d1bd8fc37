"""Modulus and base radius of a whisker, fitted to the loads of contacts at known points.

For contacts at known points on the centreline the shape does not depend on the whisker's stiffness,
and force and moment are proportional to EI = E π r⁴ / 4 at the base (the torsional stiffness
follows from Poisson's ratio, the stiffness elsewhere from the taper). Loads therefore determine EI
only; separating E from r⁴ requires another measurement, such as a radius under the microscope or a
modulus from a data sheet. Given prior uncertainties of both, Bayes' rule updates log E and log r
subject to

    log E + 4 log r = log(4 EI / π).

If contacts are at several positions along the whisker, loads also determine how the stiffness
decreases toward the tip, so that the taper can be fitted too.

Measured contact points have errors, e of covariance Σ_p. With the wrench w(p) of a contact and its
derivative G = ∂w/∂p, readings deviate from H w by noise and by H G e, so that their covariance is

    S = N + H G Σ_p Gᵀ Hᵀ

for each contact. The second part is proportional to EI², so S is computed anew for each EI that is
tried; with S fixed, the fitted stiffness would be too small, as in any regression on a quantity
with errors.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.deferred import optimize
from vibrissa.numerics import AnyArray, Array, cross_matrix, numbers
from vibrissa.rod import Deflection, PointContact, deflect, discretize, solve_forces
from vibrissa.sensors.regression import warn_of_misfit, warn_of_surprise
from vibrissa.sensors.sensor import Sensor
from vibrissa.status import Status, describe, is_ok
from vibrissa.whisker import Whisker

_MOST_NAMED = 10  # largest number of impossible contacts that are listed
_OPEN = 2.0  # standard deviation of a logarithm above which a quantity is not determined
_SLIM, _WIDE = 0.01, 2.0  # bounds of a fitted taper
# Bounds of the fitted stiffness of a base, in units of EI/L; a stiffer base is rigid in effect.
_SOFT, _STIFF = 1.0, 1e4
_SPRING = 30.0  # initial stiffness of a base in the fit, in units of EI/L
_DIFFERENCE = 1e-4  # of logarithms, in finite differences
_TYPICAL_NOISE = 0.01  # noise of channels without stated noise, relative to their readings
_IN_OTHER_UNITS = 300.0  # factor of the stated stiffness above which units are in question

# Taper, stiffness factor, base spring, covariance and residuals.
_Fit = tuple[float, float, float | None, Array, Array]


def deflections_to(whisker: Whisker, points: ArrayLike) -> Deflection:
    """Deflections by contacts at known points (n, 3); NaN, and named in a warning, if impossible.

    Raise ValueError if more than half of them are impossible.
    """
    contacts = numbers("points", points)
    if contacts.ndim != 2 or contacts.shape[1] != 3:
        raise ValueError(f"contact points are (n, 3), m; got {contacts.shape}")
    bent = deflect(whisker, PointContact(contacts))
    _report_impossible(bent.status, contacts, whisker.length)
    return bent


def _report_impossible(statuses: AnyArray, points: Array, length: float) -> None:
    """Warn of contacts that are not possible; raise ValueError if they are more than half."""
    rows = np.flatnonzero(~is_ok(statuses) & (statuses != int(Status.MISSING)))
    if not rows.size:
        return
    reasons = "; ".join(f"{n} × {text}" for text, n in describe(statuses[rows]).items())
    which = f"{rows.size} of {statuses.size} contacts are not possible: {reasons}"
    if 2 * rows.size > statuses.size:
        near, far = 1e3 * np.nanquantile(np.linalg.norm(points, axis=1), (0.1, 0.9))
        raise ValueError(
            f"{which} Most points are {near:.3g} to {far:.3g} mm from the base of this whisker of "
            f"{1e3 * length:.3g} mm: are their unit, their axes (x is along the whisker at its "
            "base) and their origin right?"
        )
    named = ", ".join(map(str, rows[:_MOST_NAMED])) + ", …" * (rows.size > _MOST_NAMED)
    warnings.warn(f"{which}; left out: {named} (of the rows, from 0)", stacklevel=4)


def wrenches_of(bent: Deflection) -> Array:
    """Wrenches (n, 6) at the base of deflected whiskers."""
    return np.concatenate([bent.force, bent.moment], axis=-1)


def wrench_slopes(bent: Deflection) -> Array:
    """Derivatives (n, 6, 3) of the wrench at the base by the contact point; NaN if impossible."""
    d = discretize(bent.whisker, bent.steps)
    known = np.asarray(is_ok(bent.status))
    contacts = np.column_stack([bent.arc_length / d.length, bent.contact_force / d.force])[known]
    tangents = solve_forces(d, contacts, tangents=True)[1]
    by_point = tangents[:, :3] @ np.linalg.inv(tangents[:, 3:]) * (d.force / d.length)
    turning = cross_matrix(bent.contact_point[known]) @ by_point - cross_matrix(bent.force[known])
    slopes = np.full((known.size, 6, 3), np.nan)
    slopes[known] = np.concatenate([by_point, turning], axis=1)
    return slopes


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
        If shapes do not match, more than half of the contacts are not possible, the readings do not
        follow the loads, or the contacts do not determine the taper or base stiffness to be fitted.

    Warns
    -----
    UserWarning
        If contacts are not possible, which are left out; if residuals are more than five times the
        noise, or E r⁴ is more than five standard deviations from its prior value.
    """
    sensor = sensor or Sensor()
    y = numbers("readings", readings)
    contacts = numbers("points", points)
    if y.shape != (len(contacts), len(sensor.channels)):
        raise ValueError(f"readings are ({len(contacts)}, {len(sensor.channels)}); got {y.shape}")
    if modulus_sigma < 0.0 or radius_sigma < 0.0 or np.isinf([modulus_sigma, radius_sigma]).all():
        raise ValueError(
            "loads determine E r⁴ only: modulus_sigma or radius_sigma must be finite, none "
            f"negative; got {modulus_sigma} and {radius_sigma}"
        )
    for name, sigma in (("modulus_sigma", modulus_sigma), ("radius_sigma", radius_sigma)):
        if 1.0 < sigma < np.inf:
            raise ValueError(
                f"{name} is {sigma:g}; it is relative, so that 0.1 is 10 %; inf: unknown"
            )
    known = np.isfinite(y).all(axis=1) & np.isfinite(contacts).all(axis=1)
    if not known.any():
        raise ValueError("no reading with a contact point is known")
    blur = spread_of_points(point_sigma, contacts, whisker.length)[known]
    y, contacts = y[known], contacts[known]
    noise = np.sqrt(np.diag(sensor.covariance()))
    size = np.sqrt((y**2).mean(axis=0)) if len(y) else noise
    noise = np.where(noise > 0.0, noise, _TYPICAL_NOISE * np.where(size > 0.0, size, 1.0))
    response = sensor.base_mixing / noise[:, None]
    fit, statuses = _fitted_to_possible(whisker, contacts, blur, response, y / noise, taper, base)
    ratio, factor, spring, spread, left = fit
    numbered = np.full(known.shape, int(Status.MISSING))
    numbered[known] = statuses
    _report_impossible(numbered, contacts, whisker.length)
    degrees = int(np.sum(is_ok(statuses))) * y.shape[1] - 1 - taper - base
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


def _fitted_to_possible(
    whisker: Whisker,
    contacts: Array,
    blur: Array,
    response: Array,
    scaled: Array,
    taper: bool,
    base: bool,
) -> tuple[_Fit, AnyArray]:
    """Fit of readings relative to their noise, without contacts that are not possible; statuses."""
    statuses = np.full(len(contacts), int(Status.OK))

    @lru_cache(maxsize=4)
    def modelled(ratio: float, spring: float | None) -> tuple[Array, Array | None]:
        bent = deflect(_on_spring(_tapered(whisker, ratio), spring), PointContact(contacts))
        statuses[:] = np.where(is_ok(statuses), bent.status, statuses)
        model, errors = wrenches_of(bent) @ response.T, None
        if blur.any():
            errors = response @ wrench_slopes(bent) * blur[:, None]
            errors[~is_ok(statuses)] = 0.0
        model[~is_ok(statuses)] = 0.0
        return model, errors

    ratio = whisker.tip_radius / whisker.base_radius
    if not (modelled(ratio, _SPRING if base else None)[0] * scaled).sum() > 0.0:
        _report_impossible(statuses, contacts, whisker.length)
        raise ValueError(
            "the readings do not increase with the loads: check the sensor's axes, sign "
            "(`reaction`) and offset, and whether the channels respond at all"
        )
    while True:
        # Contacts that a trial value makes impossible are left out, and the fit is done again.
        modelled.cache_clear()
        used = is_ok(statuses)
        readings = np.where(used[:, None], scaled, 0.0)
        fit = _fitted(modelled, readings, ratio, taper, base)
        if is_ok(statuses)[used].all():
            return fit, statuses


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


def spread_of_points(point_sigma: ArrayLike, contacts: Array, length: float) -> Array:
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
    if (most := spread.max(initial=0.0)) > length:
        raise ValueError(
            f"point_sigma is {most:g} m, more than the whisker is long; are these millimetres?"
        )
    return spread


def _warn_of_units(factor: float) -> None:
    """Warn if the fitted stiffness differs from the stated one by an implausible factor."""
    if not 1.0 / _IN_OTHER_UNITS < factor < _IN_OTHER_UNITS:
        warnings.warn(
            f"the fitted stiffness is {factor:.3g} times the whisker's stated one: are the "
            "readings in N and N·m, and is the whisker's radius right?",
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
) -> _Fit:
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
