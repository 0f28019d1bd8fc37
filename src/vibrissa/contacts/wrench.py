"""Contacts with any friction from the force and moment at the base.

A contact has four unknowns, arc length and three components of force, and a wrench has six numbers.
The two left over are a check: the force is normal to the moment (M · F = 0), and its line meets the
whisker. The rod equations integrated from the base outward (:mod:`vibrissa.rod.outward`) show where
the moment vanishes, or nearly does. From there the contact that explains the measured wrench best
is found by weighted least squares, integrating from the contact to the base; unlike the integration
outward, this does not magnify noise near a thin tip.

The rod beyond such a point may carry the same force on to another one where the moment vanishes
again: then only the friction that each requires distinguishes them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.contacts.contacts import Candidates, Contacts, contacts_of
from vibrissa.contacts.engine.prior import Prior, possible_candidates, refuse_tip
from vibrissa.contacts.fitting.least_squares import Fits, fit, unknowns_covariance
from vibrissa.contacts.joint.joint_fit import soft_base
from vibrissa.contacts.sensing.channels import (
    WRENCH,
    Channels,
    friction_angle,
    friction_angle_derivatives,
    wrenches_of,
)
from vibrissa.contacts.sensing.noise import (
    INDISTINCT,
    SensorNoise,
    common_covariance,
    common_errors,
    explained,
    rank,
    scaled_errors,
    sensor_noise,
    trusted,
    whitening,
)
from vibrissa.contacts.uncertainty.posterior import CERTAIN, ranked
from vibrissa.contacts.uncertainty.valleys import LIKELY_FRICTION, Valleys, valleys
from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod import Discretization, discretize, solve_forces, vanishing_moments
from vibrissa.signals import Coordinates, labelled_wrench, measured
from vibrissa.status import Status
from vibrissa.whisker import Whisker

#: Steps along the whisker: contact points within 1e-8 L up to loads that slip off.
STEPS = 192
#: Smallest arc length of a contact, over L.
PROXIMAL = 0.05
_COARSE = 36
_UNKNOWNS = 4
_MOST = 4
# Friction angle above which a covariance is not valid: valleys end in such contacts.
_STEEP = 2.0 * LIKELY_FRICTION
# Arc lengths to start from if the integration outward gives no contact, or only one that may hide
# another, as where the valley of χ² through it is long.
_ELSEWHERE = (0.25, 0.5, 0.75, 0.95)
# Lever arm, over L, above which force and moment are swapped, or in other units.
_LONGEST_ARM = 10.0
# Difference of a seed's wrench, in standard deviations, above which it is dropped if there are
# others.
_FAR = 100.0
# Error of the coarse rod's wrench, in standard deviations, below which it is used to follow
# valleys.
_EQUAL = 0.05
_UNKNOWN = 0.5  # standard deviation of a contact point, over L, above which it is unknown
_SAME = 1e-3  # contacts within this (over L, and ten times it relative to the force) are the same


class Fitted(NamedTuple):
    """Fits by row and candidate, padded with NaN.

    Their number (n,), x (n, k, 4), (F, p) (n, k, 6), ∂(F, p)/∂x (n, k, 6, 4) and χ² (n, k).
    """

    number: IntArray
    contacts: Array
    values: Array
    tangents: Array
    misfits: Array

    def replaced(self, row: IntArray, place: IntArray, fits: Fits) -> Fitted:
        """Replace fits at these rows and columns by better ones."""
        out = Fitted(self.number, *(a.copy() for a in self[1:]))
        for mine, theirs in zip(out[1:], fits[:4], strict=True):
            mine[row, place] = theirs
        return out

    def allowed_first(self, allowed: AnyArray) -> Fitted:
        """Drop candidates that are not allowed; the others keep their order."""
        order = np.argsort(~allowed, axis=1, kind="stable")
        line = np.arange(len(order))[:, None]
        return Fitted(allowed.sum(axis=1), *(a[line, order] for a in self[1:]))


def estimate_from_wrench(
    whisker: Whisker,
    force: ArrayLike | xr.DataArray,
    moment: ArrayLike | xr.DataArray,
    *,
    noise: Mapping[str, float] | ArrayLike | None = None,
    stiffness_sigma: float = 0.0,
    gain_sigma: float | ArrayLike = 0.0,
    mixing_sigma: float | ArrayLike = 0.0,
    compliance_sigma: float = 0.0,
    prior: Prior | None = None,
    steps: int = STEPS,
) -> Contacts:
    """Locate contacts from force and moment at the base, with or without friction.

    Parameters
    ----------
    whisker : Whisker
        Whisker that is touched. On a compliant base the wrench is that in the frame of the resting
        base.
    force : array_like or DataArray
        Force of the object on the whisker, whisker frame, N, shape (..., 3); NaN means missing.
    moment : array_like or DataArray
        Moment of that force about the base, N·m, same shape.
    noise : mapping or (6, 6) array_like, optional
        Standard deviations of ``Fx``, ``Fy``, ``Fz``, ``Mx``, ``My`` and ``Mz``, or the covariance
        of (F, M), SI units.
    stiffness_sigma : float
        Relative standard deviation of the whisker's bending stiffness E r⁴, in the covariances; it
        needs noise, as the next two do.
    gain_sigma : float or (6,) array_like
        Relative standard deviation of the sensor's gains, of all or each of the six.
    mixing_sigma : float or (6, 6) array_like
        Standard deviations of what each component reads of all six; or one number, relative: of
        the cross-talk among forces, and among moments.
    compliance_sigma : float
        Standard deviation of the base's compliance, rad/(N·m), as of `ContactMap.estimate`.
    prior : Prior, optional
        Contacts that are possible; others are left out of the candidates.
    steps : int
        Integration steps along the whisker. The default is good to 1e-8 of the length.

    Returns
    -------
    Contacts
        Contact for each wrench, its force and friction angle, and their uncertainty.

    Raises
    ------
    ValueError
        If shapes, coordinates or the noise do not fit.

    Examples
    --------
    >>> import vibrissa as vb
    >>> whisker = vb.samples.gamma()
    >>> bent = vb.deflect(whisker, vb.PointForce(25e-3, components=(3e-6, 4e-5, 1e-5)))
    >>> found = vb.estimate_from_wrench(whisker, bent.force, bent.moment)
    >>> float(found.arc_length.round(6))
    0.025
    """
    errors = common_errors(stiffness_sigma, gain_sigma, mixing_sigma)
    if not isinstance(whisker, Whisker):
        raise ValueError(
            "the whisker comes first: estimate_from_wrench(whisker, force, moment); got "
            f"{type(whisker).__name__}"
        )
    return _located(
        whisker, wrench_on(whisker, force, moment), noise, errors, prior, steps, compliance_sigma
    )


def wrench_on(
    whisker: Whisker, force: ArrayLike | xr.DataArray, moment: ArrayLike | xr.DataArray
) -> tuple[Array, Array, tuple[str, ...], Coordinates]:
    """Force and moment with their labels, checked for plausible lever arms."""
    labelled = labelled_wrench(force, moment)
    size, turning = (np.linalg.norm(vectors, axis=-1) for vectors in labelled[:2])
    known = (size > 0.0) & np.isfinite(turning)
    arm = float(np.min(turning[known] / size[known])) if known.any() else 0.0
    if arm > _LONGEST_ARM * whisker.length:
        raise ValueError(
            f"the moment is that of a force {arm:.3g} m from the base or farther, of a whisker of "
            f"{whisker.length:.3g} m: force, N, comes before moment, N·m"
        )
    return labelled


def estimate_components(
    whisker: Whisker,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    noise: Mapping[str, float] | ArrayLike | None,
    errors: Array,
    prior: Prior | None,
    compliance_sigma: float = 0.0,
) -> Contacts:
    """Locate contacts from signals that have ``force`` and ``moment``, or the six components."""
    if "force" in signals and "moment" in signals:
        labelled = wrench_on(whisker, signals["force"], signals["moment"])
    else:
        values, dims, coords = measured(signals, WRENCH)
        labelled = values[..., :3], values[..., 3:], dims, coords
    return _located(whisker, labelled, noise, errors, prior, STEPS, compliance_sigma)


def _located(
    whisker: Whisker,
    labelled: tuple[Array, Array, tuple[str, ...], Coordinates],
    noise: Mapping[str, float] | ArrayLike | None,
    errors: Array,
    prior: Prior | None,
    steps: int,
    compliance_sigma: float,
) -> Contacts:
    refuse_tip(prior, "the wrench shows forces of any direction at the tip by itself")
    sensor = sensor_noise(noise, WRENCH, errors, whisker)
    channels = Channels(WRENCH, WRENCH)
    base = soft_base(whisker, steps, channels, sensor, compliance_sigma, friction=True)
    f, m, dims, coords = labelled
    d = discretize(whisker, steps)
    scale = np.repeat([d.force, d.moment], 3)
    wrenches = np.concatenate([f, m], axis=-1).reshape(-1, 6) / scale
    known = np.isfinite(wrenches).all(axis=1)
    loaded = known & wrenches[:, :3].any(axis=1) & wrenches[:, 3:].any(axis=1)
    rows = np.flatnonzero(loaded)
    degrees = len(WRENCH) - _UNKNOWNS
    if sensor is None:
        weights = whitening(trusted(wrenches[rows]))
    else:
        weights = wrench_weights(sensor, d, wrenches[rows])
        degrees = rank(_covariance(sensor) / np.outer(scale, scale)) - _UNKNOWNS
    limit = explained(degrees)
    coarse = discretize(whisker, _COARSE)

    def answers(which: IntArray, everywhere: bool) -> tuple[Candidates, AnyArray]:
        given = wrenches[rows[which]], weights[which]
        solved = _solve(coarse, d, *given, limit, everywhere)
        found = _candidates(solved)
        if prior is not None:
            allowed = possible_candidates(prior, whisker, d, found)
            if sensor is not None:  # which are near is judged below, by their covariances
                allowed |= ~allowed.any(axis=1, keepdims=True) & ~np.isnan(found.x[:, :, 0])
            found, solved = found.allowed_first(allowed), solved.allowed_first(allowed)
        if sensor is None:
            return found, np.zeros(which.size, np.bool_)
        found, lost = _judged(coarse, d, solved, found, *given)
        if prior is not None:
            found = found.allowed_first(possible_candidates(prior, whisker, d, found))
            found.probability[:] /= np.nansum(found.probability, axis=1, keepdims=True)
        return found, lost

    found, lost = answers(np.arange(rows.size), False)
    doubtful = (found.probability[:, 0] > CERTAIN) & ~found.valid[:, 0] & ~lost
    again = np.flatnonzero(doubtful)
    if again.size:
        more, lost[again] = answers(again, True)
        for mine, theirs in zip(found, more, strict=True):
            mine[again] = theirs
    status = np.where(known, int(Status.DEGENERATE), int(Status.MISSING))
    status[rows] = np.where(lost, int(Status.DEGENERATE), _statuses(found, limit))
    whole = found.spread_out(rows, len(wrenches))
    chi_squared = whole.chi_squared[:, 0]
    if base is not None:
        whole, status, chi_squared = base.allow(wrenches, wrenches, whole, status)
    return contacts_of(whole, status, chi_squared, d, WRENCH, f.shape[:-1], dims, coords, np.inf)


def _covariance(sensor: SensorNoise) -> Array:
    """Covariance of (F, M), in SI units."""
    if sensor.wrench is not None:
        return sensor.wrench
    assert sensor.deviations is not None
    return np.diag([sensor.deviations[name] ** 2 for name in WRENCH])


def wrench_weights(sensor: SensorNoise, d: Discretization, wrenches: Array) -> Array:
    """Weights (n, 6, 6) of wrenches by noise and shared errors, non-dimensional."""
    scale = np.repeat([d.force, d.moment], 3)
    scaled = scaled_errors(sensor.errors, d.force, d.moment)
    shared = common_covariance(scaled, np.eye(6), wrenches)
    return whitening(_covariance(sensor) / np.outer(scale, scale) + shared)


def rubbing_misfits(
    whisker: Whisker, force: Array, moment: Array, noise: Array, fitted: bool
) -> Array:
    """Minimum χ² (n,) of contacts with a prior of friction angles; infinite if there is none.

    Contacts are those ``fitted`` to each wrench, or else, which is faster, those where its moment
    vanishes, whose χ² is never smaller.
    """
    d, coarse = discretize(whisker, STEPS), discretize(whisker, _COARSE)
    scale = np.repeat([d.force, d.moment], 3)
    least = np.full(len(force), np.inf)
    rows = np.flatnonzero(force.any(axis=1) & moment.any(axis=1))
    if not rows.size:
        return least
    wrenches = np.concatenate([force, moment], axis=1)[rows] / scale
    weights = whitening(np.repeat([noise / np.outer(scale, scale)], rows.size, axis=0))
    if fitted:
        limit = explained(rank(noise / np.outer(scale, scale)) - _UNKNOWNS)
        number, contacts, _, _, misfits = _solve(coarse, d, wrenches, weights, limit)
    else:
        number, contacts = vanishing_moments(coarse, wrenches, PROXIMAL)
    row, place = np.nonzero(np.arange(contacts.shape[1]) < number[:, None])
    x = contacts[row, place]
    chi = misfits[row, place] if fitted else _misfits(coarse, wrenches, weights, row, x) ** 2
    with np.errstate(invalid="ignore"):
        doubt = chi + (friction_angle(x) / LIKELY_FRICTION) ** 2
    np.fmin.at(least, rows[row], doubt)
    return least


def _solve(
    coarse: Discretization,
    fine: Discretization,
    wrenches: Array,
    weights: Array,
    limit: float,
    everywhere: bool = False,
) -> Fitted:
    """Contacts that explain wrenches, or the nearest one, started along the whisker if needed."""
    number, places = vanishing_moments(coarse, wrenches, PROXIMAL)
    row, place = np.nonzero(np.arange(places.shape[1]) < number[:, None])
    near = _promising(coarse, wrenches, weights, row, places[row, place])
    seeds = places[row[near], place[near]]
    found = _fit(coarse, wrenches, weights, row[near], seeds, limit)
    best = np.full(len(wrenches), np.inf)
    np.minimum.at(best, row[near], found.misfits)
    again = np.flatnonzero(everywhere | ~(best <= limit))
    if again.size:
        starts = np.array(_ELSEWHERE)
        more = np.repeat(again, starts.size)
        seeds = np.column_stack([np.tile(starts, again.size), wrenches[more, :3]])
        left = np.isin(row, again) & ~near
        more = np.concatenate([more, row[left]])
        seeds = np.concatenate([seeds, places[row[left], place[left]]])
        others = _fit(coarse, wrenches, weights, more, seeds, limit)
        found = Fits(*(np.concatenate(pair) for pair in zip(found, others, strict=True)))
        near = np.concatenate([row[near], more])
    else:
        near = row[near]
    doubt = found.misfits + (friction_angle(found.contacts) / LIKELY_FRICTION) ** 2
    kept = chosen(len(wrenches), near, found, doubt, limit, _MOST)
    row, place = np.nonzero(np.arange(kept.contacts.shape[1]) < kept.number[:, None])
    final = _fit(fine, wrenches, weights, row, kept.contacts[row, place], limit)
    return kept.replaced(row, place, final)


def _candidates(solved: Fitted) -> Candidates:
    """Fits as candidates, without covariances."""
    out = Candidates.room(len(solved.number), solved.contacts.shape[1])
    return out._replace(
        number=solved.number, x=solved.contacts, values=solved.values, chi_squared=solved.misfits
    )


def _fit(
    d: Discretization, wrenches: Array, weights: Array, row: IntArray, seeds: Array, limit: float
) -> Fits:
    return fit(
        d,
        WRENCH,
        wrenches[row],
        weights[row],
        seeds,
        friction=True,
        least=PROXIMAL,
        worth=limit + INDISTINCT,
    )


def _misfits(
    d: Discretization, wrenches: Array, weights: Array, row: IntArray, contacts: Array
) -> Array:
    """Misfit (n,), in standard deviations, of contacts to the wrenches of their rows."""
    values, _ = solve_forces(d, contacts)
    away = np.einsum("nij,nj->ni", weights[row], wrenches_of(values) - wrenches[row])
    with np.errstate(over="ignore", invalid="ignore"):
        misfit = np.sqrt((away**2).sum(axis=1))
    misfit[~np.isfinite(misfit)] = np.inf
    return np.asarray(misfit)


def _promising(
    d: Discretization, wrenches: Array, weights: Array, row: IntArray, seeds: Array
) -> AnyArray:
    """Which seeds are about as good as the best of their row."""
    misfit = _misfits(d, wrenches, weights, row, seeds)
    best = np.full(len(wrenches), np.inf)
    np.minimum.at(best, row, misfit)
    return np.asarray(misfit <= _FAR * (1.0 + best[row]))


def by_probability(found: Candidates) -> IntArray:
    """UNIQUE or AMBIGUOUS, (n,), by the probability of the first candidates or by their number."""
    first = found.probability[:, 0]
    sure = np.where(np.isfinite(first), first > CERTAIN, found.number == 1)
    return np.where(sure, int(Status.UNIQUE), int(Status.AMBIGUOUS))


def _statuses(found: Candidates, limit: float) -> IntArray:
    status = by_probability(found)
    s, misfit = found.x[:, 0, 0], found.chi_squared[:, 0]
    explains = misfit <= limit
    status[~explains] = int(Status.NOT_ONE_CONTACT)
    status[~explains & (s >= 1.0)] = int(Status.BEYOND_TIP)
    status[s <= PROXIMAL] = int(Status.TOO_PROXIMAL)
    status[found.number == 0] = int(Status.OUTSIDE_PRIOR)
    return status


def _judged(
    coarse: Discretization,
    fine: Discretization,
    solved: Fitted,
    found: Candidates,
    wrenches: Array,
    weights: Array,
) -> tuple[Candidates, AnyArray]:
    """Candidates by probability with their covariances, and whether the first one is unknown."""
    n, most = found.chi_squared.shape
    row, place = np.nonzero(np.arange(most) < found.number[:, None])
    x, values, tangents = (a[row, place] for a in (found.x, found.values, solved.tangents))
    away = wrenches_of(solve_forces(coarse, x)[0]) - wrenches_of(values)
    away = np.einsum("nij,nj->ni", weights[row], away)
    near = np.abs(away).max(axis=1, initial=0.0) < _EQUAL
    valley = Valleys.room(len(row))
    for d, which in ((coarse, near), (fine, ~near)):
        i, at = row[which], (x[which], values[which], tangents[which])
        part = valleys(d, WRENCH, wrenches[i], weights[i], *at, PROXIMAL)
        for mine, theirs in zip(valley, part, strict=True):
            mine[which] = theirs
    spread = unknowns_covariance(WRENCH, values, tangents, weights[row], friction=True)
    size = np.einsum("nai,nij,naj->n", tangents[:, 3:], spread, tangents[:, 3:])
    weight, far = np.full((n, most), -np.inf), np.full((n, most), np.nan)
    weight[row, place] = valley.weight
    far[row, place] = size
    found.covariances[row, place] = valley.covariances
    found.valid[row, place] = valley.valid & (np.abs(friction_angle(x)) < _STEEP)
    turn = friction_angle_derivatives(x)
    found.angle_sigma[row, place] = np.sqrt(np.einsum("na,nab,nb->n", turn, spread, turn))
    probability, order = ranked(weight, found.number)
    line = np.arange(n)[:, None]
    found = found.ordered(order, found.number)
    with np.errstate(invalid="ignore"):
        lost = (found.number > 0) & ~(far[line, order][:, 0] <= _UNKNOWN**2)
    return found._replace(probability=probability), lost


def chosen(rows: int, row: IntArray, fits: Fits, doubt: Array, limit: float, most: int) -> Fitted:
    """Choose the fits that explain their measurement and are indistinguishable."""
    misfit = np.where(np.isfinite(fits.values).all(axis=1), fits.misfits, np.inf)
    best = np.full(rows, np.inf)
    np.minimum.at(best, row, misfit)
    kept = (misfit <= np.minimum(best[row] + INDISTINCT, np.maximum(best[row], limit))) & (
        misfit < np.inf
    )
    kept &= (best[row] <= limit) | (misfit == best[row])
    order = np.flatnonzero(kept)
    order = order[np.lexsort((doubt[order], row[order]))]
    number = np.zeros(rows, np.int64)
    where = np.full((rows, most), -1)
    for one in order:
        i = row[one]
        known = any(_same(fits.contacts[one], fits.contacts[j]) for j in where[i, : number[i]])
        if not known and number[i] < most:
            where[i, number[i]] = one
            number[i] += 1
    there = where >= 0

    def padded(values: Array) -> Array:
        out = np.full((rows, most, *values.shape[1:]), np.nan)
        out[there] = values[where[there]]
        return out

    return Fitted(number, *(padded(a) for a in fits[:4]))


def _same(a: Array, b: Array) -> bool:
    """Whether two contacts x (4,) are the same."""
    s, *force = (a - b).tolist()
    size = math.hypot(*a[1:].tolist())
    return abs(s) < _SAME and math.hypot(*force) < 10.0 * _SAME * size
