"""From force and moment at the base to the contact, whatever the friction there.

A contact has four unknowns, arc length and three components of force, and a wrench has six numbers.
Two are left over for checking: the force is normal to the moment (M · F = 0), and its line meets
the whisker. The rod equations integrated from the base outward (:mod:`vibrissa.rod.outward`) tell
where the moment vanishes, or nearly; from there the contact that explains the measured wrench best
is found by weighted least squares, integrating from the contact to the base, which does not
magnify noise at a thin tip as the way out does.

The rod beyond such a place may carry the same force on to another, where the moment vanishes again:
then one of them can only be told from the other by the friction that it takes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contacts.channels import WRENCH
from vibrissa.contacts.contact_map import spherical
from vibrissa.contacts.fitting import Fits, fit
from vibrissa.contacts.minima import Candidates, candidates, unknowns_covariance
from vibrissa.contacts.noise import (
    SensorNoise,
    common_covariance,
    common_errors,
    scaled_errors,
    sensor_noise,
)
from vibrissa.contacts.posterior import CERTAIN, judged, ranked
from vibrissa.contacts.prior import Prior, allowed_first
from vibrissa.contacts.showing import estimate_card, estimate_rows
from vibrissa.contacts.whitening import INDISTINCT, explained, rank, trusted, whitening
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.quantities import attributes
from vibrissa.rod import Discretization, discretize, solve_forces, vanishing_moments
from vibrissa.signals import Coordinates, labelled_wrench
from vibrissa.sketch import lines, shown
from vibrissa.status import Status, counted, flag_attributes

if TYPE_CHECKING:
    from vibrissa.whisker import Whisker

#: Steps along the whisker: contact points within 1e-8 L up to loads that slip off.
STEPS = 192
#: Contacts are looked for from this arc length on, over L.
PROXIMAL = 0.05
_COARSE = 36
_UNKNOWNS = 4
_MOST = 4
# Of contacts that explain a wrench equally well those that need less friction come first: as if
# friction angles scattered by so much.
_LIKELY = np.deg2rad(20.0)
# Where the way out from the base ends nowhere: arc lengths to start from.
_ELSEWHERE = (0.25, 0.5, 0.75, 0.95)
# Seeds whose wrench differs by so many standard deviations are not worth a start, if there are
# others.
_FAR = 100.0
# A contact that may lie this far away (over L, one standard deviation) is not known.
_UNKNOWN = 0.5


@dataclass(frozen=True, eq=False)
class WrenchEstimate:
    """Contacts that explain force and moment at the base; whisker frame, SI units.

    Attributes
    ----------
    point : (..., 3) array
        Contact point, m; NaN where there is none.
    covariance : (..., 3, 3) array
        Its covariance, m², widened where the contact does not move with the wrench as derivatives
        say; NaN without ``noise``.
    arc_length : (...) array
        Arc length of the contact, m.
    contact_force : (..., 3) array
        Force in the material frame at the contact (tangent, d1, d2), N.
    friction_angle : (...) array
        Angle between the force and the plane normal to the whisker, rad: positive where the object
        pulls toward the tip; its tangent is the least coefficient of friction that holds it.
    friction_angle_sigma : (...) array
        Standard deviation of that, rad; NaN without ``noise``.
    force, moment : (..., 3) arrays
        Base force and moment of that contact, N and N·m.
    misfit : (...) array
        χ², of two degrees of freedom: sum of squares of what is left of the six components, in
        standard deviations. Without ``noise`` components of F count as known to 1 % of |F|, and
        those of M to 1 % of |M|.
    linear : (...) bool array
        Whether the covariance can be relied on: contacts scatter as it says. False without
        ``noise``.
    status : (...) int array
        :class:`~vibrissa.Status`: ``UNIQUE`` (with ``noise``: all other candidates together are
        less than 5 % probable); ``AMBIGUOUS``; ``NOT_ONE_CONTACT`` where χ² is
        larger than one measurement in a thousand would have it, ``BEYOND_TIP`` where moreover the
        nearest contact is the tip, ``TOO_PROXIMAL`` where it is at 0.05 L (the nearest contact is
        given in all three); ``OUTSIDE_PRIOR`` where the prior allows none of the candidates;
        ``DEGENERATE`` for a force or a moment of zero, and where with this
        noise the contact may be anywhere; ``MISSING``.
    candidates : (..., k, 3) array
        Contact points of all contacts that cannot be told apart (χ² within 10.8 of the least), m,
        padded with NaN: by falling probability, or without ``noise`` by rising χ² + (friction
        angle / 20°)².
    candidate_arc_lengths : (..., k) array
        Their arc lengths, m.
    candidate_forces : (..., k, 3) array
        Their base forces, N.
    candidate_contact_forces : (..., k, 3) array
        Their forces in the material frame at the contact, N.
    candidate_probabilities : (..., k) array
        Their posterior probabilities, where contact points are as probable beforehand, and friction
        angles scatter by 20°; NaN without ``noise``.
    n_candidates : (...) int array
        How many.
    dims : tuple of str
        Names of the leading dimensions.
    coords : dict
        Coordinates along them.
    """

    point: Array
    covariance: Array
    arc_length: Array
    contact_force: Array
    friction_angle: Array
    friction_angle_sigma: Array
    force: Array
    moment: Array
    misfit: Array
    linear: AnyArray
    status: IntArray
    candidates: Array
    candidate_arc_lengths: Array
    candidate_forces: Array
    candidate_contact_forces: Array
    candidate_probabilities: Array
    n_candidates: IntArray
    dims: tuple[str, ...]
    coords: Coordinates

    @property
    def spherical(self) -> Array:
        """(r, θ, φ) of the contact point: m and rad, shape (..., 3)."""
        return spherical(self.point)

    @property
    def probability(self) -> Array:
        """Posterior probability of the contact given, shape (...); NaN without ``noise``."""
        return self.candidate_probabilities[..., 0]

    def to_dataset(self) -> xr.Dataset:
        """Return everything as a labelled dataset.

        Returns
        -------
        Dataset
            Over the measurements' dimensions, ``space`` and ``candidate``.
        """
        dims, space = self.dims, (*self.dims, "space")
        r, theta, phi = np.moveaxis(self.spherical, -1, 0)
        frame = (*dims, "material")
        data = {
            "contact_point": (space, self.point, attributes("contact_point_whisker")),
            "r": (dims, r, attributes("r")),
            "theta": (dims, theta, attributes("theta")),
            "phi": (dims, phi, attributes("phi")),
            "covariance": ((*space, "space_2"), self.covariance, attributes("covariance")),
            "arc_length": (dims, self.arc_length, attributes("arc_length")),
            "contact_force": (frame, self.contact_force, attributes("contact_force")),
            "friction_angle": (dims, self.friction_angle, attributes("friction_angle")),
            "friction_angle_sigma": (
                dims,
                self.friction_angle_sigma,
                attributes("friction_angle_sigma"),
            ),
            "force": (space, self.force, attributes("force")),
            "moment": (space, self.moment, attributes("moment")),
            "misfit": (dims, self.misfit, attributes("misfit")),
            "linear": (dims, self.linear, attributes("linear")),
            "candidates": (
                (*dims, "candidate", "space"),
                self.candidates,
                attributes("contact_point_whisker"),
            ),
            "probability": (dims, self.probability, attributes("probability")),
            "candidate_probabilities": (
                (*dims, "candidate"),
                self.candidate_probabilities,
                attributes("probability"),
            ),
            "n_candidates": (dims, self.n_candidates, attributes("candidates")),
            "status": (dims, self.status, {**attributes("status"), **flag_attributes()}),
        }
        axes = {"space": ["x", "y", "z"], "space_2": ["x", "y", "z"], "material": ["t", "d1", "d2"]}
        return xr.Dataset(data, coords={**self.coords, **axes})

    def __repr__(self) -> str:
        """Say how many there are and what became of them."""
        return f"<{self._title()}: {counted(self.status)}>"

    def _repr_html_(self) -> str:
        """Show the contact points about the base, with the numbers."""
        return estimate_card(self._title(), self, self._friction())

    def __str__(self) -> str:
        """Tell the numbers as well."""
        return lines(self._title(), estimate_rows(self, self._friction()))

    def _friction(self) -> list[tuple[str, str]]:
        return [("friction angle", shown("friction_angle", self.friction_angle))]

    def _title(self) -> str:
        return f"WrenchEstimate of {self.status.shape or 'one'}"


def estimate_from_wrench(
    whisker: Whisker,
    force: ArrayLike | xr.DataArray,
    moment: ArrayLike | xr.DataArray,
    *,
    noise: Mapping[str, float] | ArrayLike | None = None,
    stiffness_sigma: float = 0.0,
    gain_sigma: float | ArrayLike = 0.0,
    mixing_sigma: float | ArrayLike = 0.0,
    prior: Prior | None = None,
    steps: int = STEPS,
) -> WrenchEstimate:
    """Locate contacts from force and moment at the base, with or without friction.

    Parameters
    ----------
    whisker : Whisker
        What is touched. On a compliant base the wrench is that in the frame of the resting base.
    force : array_like or DataArray
        Of the object on the whisker, whisker frame, N, shape (..., 3); NaN means missing.
    moment : array_like or DataArray
        About the base, N·m, same shape.
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
    prior : Prior, optional
        Which contacts are possible; others are left out of the candidates.
    steps : int
        Integration steps along the whisker. The default is good to 1e-8 of the length.

    Returns
    -------
    WrenchEstimate
        For each wrench the contact, its force and friction angle, and their uncertainty.

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
    sensor = sensor_noise(noise, WRENCH, common_errors(stiffness_sigma, gain_sigma, mixing_sigma))
    f, m, dims, coords = labelled_wrench(force, moment)
    d = discretize(whisker, steps)
    scale = np.repeat([d.force, d.moment], 3)
    wrenches = np.concatenate([f, m], axis=-1).reshape(-1, 6) / scale
    known = np.isfinite(wrenches).all(axis=1)
    felt = known & wrenches[:, :3].any(axis=1) & wrenches[:, 3:].any(axis=1)
    rows = np.flatnonzero(felt)
    degrees = len(WRENCH) - _UNKNOWNS
    if sensor is None:
        weights = whitening(trusted(wrenches[rows]))
    else:
        covariance = _covariance(sensor) / np.outer(scale, scale)
        errors = scaled_errors(sensor.errors, d.force, d.moment)
        weights = whitening(covariance + common_covariance(errors, np.eye(6), wrenches[rows]))
        degrees = rank(covariance) - _UNKNOWNS
    solved = _solve(discretize(whisker, _COARSE), d, wrenches[rows], weights, explained(degrees))
    if prior is not None:
        solved = _possible(prior, whisker, d, solved)
    status = np.where(known, int(Status.DEGENERATE), int(Status.MISSING))
    found = _without_noise(solved)
    if sensor is not None:
        solved, found = _uncertain(d, solved, wrenches[rows], weights)
    status[rows] = _statuses(solved, found.probability, explained(degrees))
    status[rows[found.lost]] = int(Status.DEGENERATE)
    return _estimate(d, solved, found, felt, status, f.shape[:-1], dims, coords)


def _covariance(sensor: SensorNoise) -> Array:
    """Of (F, M), in SI units."""
    if sensor.wrench is not None:
        return sensor.wrench
    assert sensor.deviations is not None
    return np.diag([sensor.deviations[name] ** 2 for name in WRENCH])


def _solve(
    coarse: Discretization, fine: Discretization, wrenches: Array, weights: Array, limit: float
) -> Candidates:
    """Contacts that explain wrenches, or the one that comes nearest."""
    number, places = vanishing_moments(coarse, wrenches, PROXIMAL)
    row, place = np.nonzero(np.arange(places.shape[1]) < number[:, None])
    near = _promising(coarse, wrenches, weights, row, places[row, place])
    seeds = places[row[near], place[near]]
    found = _fit(coarse, wrenches, weights, row[near], seeds, limit)
    best = np.full(len(wrenches), np.inf)
    np.minimum.at(best, row[near], found.misfits)
    again = np.flatnonzero(~(best <= limit))
    if again.size:
        starts = np.array(_ELSEWHERE)
        more = np.repeat(again, starts.size)
        seeds = np.column_stack([np.tile(starts, again.size), wrenches[more, :3]])
        left = np.isin(row, again)
        more = np.concatenate([more, row[left]])
        seeds = np.concatenate([seeds, places[row[left], place[left]]])
        others = _fit(coarse, wrenches, weights, more, seeds, limit)
        found = Fits(*(np.concatenate(pair) for pair in zip(found, others, strict=True)))
        near = np.concatenate([row[near], more])
    else:
        near = row[near]
    doubt = found.misfits + (_friction_angle(found.contacts) / _LIKELY) ** 2
    kept = candidates(len(wrenches), near, found, doubt, limit, _MOST)
    row, place = np.nonzero(np.arange(kept.contacts.shape[1]) < kept.number[:, None])
    final = _fit(fine, wrenches, weights, row, kept.contacts[row, place], limit)
    return kept.replaced(row, place, final)


def _possible(prior: Prior, whisker: Whisker, d: Discretization, solved: Candidates) -> Candidates:
    """Candidates that a prior allows."""
    there = np.arange(solved.contacts.shape[1]) < solved.number[:, None]
    x, points = solved.contacts[there], solved.values[there][:, 3:] * d.length
    allowed = np.zeros_like(there)
    allowed[there] = prior.allows(whisker, points, x[:, 0] * d.length, x[:, 1:] * d.force)
    return Candidates(allowed.sum(axis=1), *(allowed_first(allowed, a) for a in solved[1:]))


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


def _promising(
    d: Discretization, wrenches: Array, weights: Array, row: IntArray, seeds: Array
) -> AnyArray:
    """Which seeds are about as good as the best of their row."""
    values, _ = solve_forces(d, seeds)
    felt = np.concatenate([values[:, :3], np.cross(values[:, 3:], values[:, :3])], axis=1)
    away = np.einsum("nij,nj->ni", weights[row], felt - wrenches[row])
    with np.errstate(over="ignore", invalid="ignore"):
        misfit = np.sqrt((away**2).sum(axis=1))
    misfit[~np.isfinite(misfit)] = np.inf
    best = np.full(len(wrenches), np.inf)
    np.minimum.at(best, row, misfit)
    return np.asarray(misfit <= _FAR * (1.0 + best[row]))


def _friction_angle(contacts: Array) -> Array:
    """Angle of forces (..., 1:4) from the plane normal to the whisker, rad."""
    return np.arctan2(contacts[..., 1], np.hypot(contacts[..., 2], contacts[..., 3]))


def _statuses(solved: Candidates, probability: Array, limit: float) -> IntArray:
    first = probability[:, 0]
    sure = np.where(np.isfinite(first), first > CERTAIN, solved.number == 1)
    status = np.where(sure, int(Status.UNIQUE), int(Status.AMBIGUOUS))
    s, misfit = solved.contacts[:, 0, 0], solved.misfits[:, 0]
    explains = misfit <= limit
    status[~explains] = int(Status.NOT_ONE_CONTACT)
    status[~explains & (s >= 1.0)] = int(Status.BEYOND_TIP)
    status[s <= PROXIMAL] = int(Status.TOO_PROXIMAL)
    status[solved.number == 0] = int(Status.OUTSIDE_PRIOR)
    return status


class _Uncertain(NamedTuple):
    """Of the first candidates: the point's covariance, m², and the friction angle's deviation, rad.

    And whether they can be relied on, and whether the contact is not known at all; and the
    posterior probabilities of all candidates.
    """

    covariance: Array
    angle: Array
    linear: AnyArray
    lost: AnyArray
    probability: Array


def _without_noise(solved: Candidates) -> _Uncertain:
    n = len(solved.number)
    nothing = np.zeros(n, np.bool_)
    unknown = np.full(solved.misfits.shape, np.nan)
    return _Uncertain(np.full((n, 3, 3), np.nan), np.full(n, np.nan), nothing, nothing, unknown)


def _uncertain(
    d: Discretization, solved: Candidates, wrenches: Array, weights: Array
) -> tuple[Candidates, _Uncertain]:
    """Put the most probable candidate first, and tell what noise leaves open."""
    n, most = solved.misfits.shape
    row, place = np.nonzero(np.arange(most) < solved.number[:, None])
    x, values, tangents = (a[row, place] for a in solved[1:4])
    judgement = judged(
        d,
        WRENCH,
        wrenches[row],
        weights[row],
        x,
        values,
        tangents,
        friction=True,
        least=PROXIMAL,
        proximal=PROXIMAL,
    )
    weight, covariance = np.full((n, most), -np.inf), np.full((n, most, 3, 3), np.nan)
    linear = np.zeros((n, most), np.bool_)
    weight[row, place] = judgement.weight - 0.5 * (_friction_angle(x) / _LIKELY) ** 2
    covariance[row, place], linear[row, place] = judgement.covariances, judgement.valid
    probability, order = ranked(weight, solved.number)
    line = np.arange(n)[:, None]
    solved = Candidates(solved.number, *(a[line, order] for a in solved[1:]))
    first = np.arange(n), order[:, 0]
    x, values, tangents = solved.contacts[:, 0], solved.values[:, 0], solved.tangents[:, 0]
    spread = unknowns_covariance(WRENCH, values, tangents, weights, friction=True)
    size = np.einsum("nai,nij,naj->n", tangents[:, 3:], spread, tangents[:, 3:])
    with np.errstate(invalid="ignore"):
        lost = np.isfinite(x[:, 0]) & ~(size <= _UNKNOWN**2)
    return solved, _Uncertain(
        d.length**2 * covariance[first],
        _angle_deviation(x, spread),
        linear[first],
        lost,
        probability,
    )


def _angle_deviation(x: Array, spread: Array) -> Array:
    """Standard deviations of friction angles (n,), rad, from covariances (n, 4, 4) of x (n, 4)."""
    normal = np.hypot(x[:, 2], x[:, 3])
    slope = np.zeros_like(x)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope[:, 1] = normal
        slope[:, 2:] = -x[:, 1:2] * x[:, 2:] / normal[:, None]
        slope /= (normal**2 + x[:, 1] ** 2)[:, None]
    return np.asarray(np.sqrt(np.einsum("na,nab,nb->n", slope, spread, slope)))


def _estimate(
    d: Discretization,
    solved: Candidates,
    found: _Uncertain,
    felt: AnyArray,
    status: IntArray,
    shape: tuple[int, ...],
    dims: tuple[str, ...],
    coords: Coordinates,
) -> WrenchEstimate:
    """Everything in SI units and in the shape of the measurements."""

    def whole(values: AnyArray, missing: float = np.nan) -> AnyArray:
        out = np.full((felt.size, *values.shape[1:]), missing, values.dtype)
        out[felt] = values
        return out.reshape((*shape, *values.shape[1:]))

    best = solved.values[:, 0]
    force, point = best[:, :3] * d.force, best[:, 3:] * d.length
    most = max(1, int(solved.number.max(initial=0)))
    return WrenchEstimate(
        point=whole(point),
        covariance=whole(found.covariance),
        arc_length=whole(solved.contacts[:, 0, 0] * d.length),
        contact_force=whole(solved.contacts[:, 0, 1:] * d.force),
        friction_angle=whole(_friction_angle(solved.contacts[:, 0])),
        friction_angle_sigma=whole(found.angle),
        force=whole(force),
        moment=whole(np.cross(point, force)),
        misfit=whole(solved.misfits[:, 0]),
        linear=whole(found.linear, missing=False),
        status=status.reshape(shape),
        candidates=whole(solved.values[:, :most, 3:] * d.length),
        candidate_arc_lengths=whole(solved.contacts[:, :most, 0] * d.length),
        candidate_forces=whole(solved.values[:, :most, :3] * d.force),
        candidate_contact_forces=whole(solved.contacts[:, :most, 1:] * d.force),
        candidate_probabilities=whole(found.probability[:, :most]),
        n_candidates=whole(solved.number, missing=0),
        dims=dims,
        coords=coords,
    )
