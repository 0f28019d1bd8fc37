"""Measured signals in, contacts out: all that explain them, each with its covariance.

Three signals T have as many unknowns ξ: every contact with T(ξ) = T is a candidate. More signals
are explained by weighted least squares, χ² = |T(ξ) - T|² in standard deviations. With noise three
are treated so too: contacts on the boundary of T(Ω) explain what noise has carried out of it. For
noise of covariance Σ the covariance is ∂p/∂ξ (JᵀΣ⁻¹J)⁻¹ ∂p/∂ξᵀ with J = ∂T/∂ξ to first order, see
:mod:`~vibrissa.contacts.posterior`. For a covariance of force and moment, Σ is carried over to the
signals by their derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from vibrissa.contacts.contact_map import spherical
from vibrissa.contacts.explanation import (
    Explanation,
    by_least_squares,
    by_triplet,
    check_signals,
    undetermined,
)
from vibrissa.contacts.noise import SensorNoise, common_errors, sensor_noise
from vibrissa.contacts.noisy import under_noise
from vibrissa.contacts.prior import Prior, among_allowed
from vibrissa.contacts.readout import Named
from vibrissa.contacts.showing import estimate_card, estimate_rows
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.quantities import attributes
from vibrissa.signals import Coordinates, measured, selection, signal_scales
from vibrissa.sketch import lines
from vibrissa.status import counted, flag_attributes

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap


@dataclass(frozen=True, eq=False)
class Estimate:
    """Contacts that explain measured signals, whisker frame, SI units.

    Attributes
    ----------
    point : (..., 3) array
        Contact point of the most plausible candidate, m; NaN where there is none.
    covariance : (..., 3, 3) array
        Its covariance, m², of the posterior probability about the point: to first order where the
        contact moves with the signals as the derivatives say, and widened where it does not, as
        near slip-off and where the deflection is small; NaN without ``noise``.
    linear : (...) bool array
        Whether the covariance can be relied on: regions stated from it hold what they state. False
        without ``noise``, and mostly where the noise is as large as the signals.
    status : (...) int array
        :class:`~vibrissa.Status`: ``UNIQUE`` (with ``noise``: all other candidates together are
        less than 5 % probable); ``AMBIGUOUS``; ``NOT_FRICTIONLESS`` where no contact on the map
        explains the signals (with ``noise``, and of more than three signals: where χ² is larger
        than one measurement in a thousand would have it; then the contact nearest is given);
        ``OUTSIDE_MAP`` where one nearer to the base would, or where signals are ten times larger
        than any on the map; ``OUTSIDE_PRIOR`` where the prior allows none of those that explain
        them; ``DEGENERATE`` where all forces and moments are zero, and everywhere if
        the signals do not determine contacts (:meth:`ContactMap.determines`); ``MISSING``.
        Of a look-up table or network, which cannot see whether contacts are ambiguous:
        ``APPROXIMATE``, ``OUTSIDE_MAP`` (outside the table) or ``MISSING``.
    misfit : (...) array
        χ² of k - 3 degrees of freedom: the sum of squares of what is left unexplained of k signals,
        in standard deviations; of three, more than 0 only where noise has carried them out of what
        contacts give. Of three signals without ``noise``, 0 where they are explained; else how far,
        in shares of each signal's range, they are from the nearest ones that are. Of a table
        or network, how far the signals of the contact given are from those measured, likewise in
        shares of ranges; NaN where the whisker cannot reach the point.
    arc_length : (...) array
        Arc length of the contact, m.
    force, moment : (..., 3) arrays
        Base force and moment of the candidate, N and N·m.
    candidates : (..., k, 3) array
        Contact points of all candidates, padded with NaN, m: with ``noise`` by falling probability;
        without, by rising force, or for more than three signals by rising χ² and then force.
        Candidates have χ² within 10.8 of the least (the likelihood ratio that one pair in a
        thousand exceeds by chance).
    candidate_covariances : (..., k, 3, 3) array
        Their covariances, m²; NaN without ``noise``.
    candidate_arc_lengths : (..., k) array
        Their arc lengths, m.
    candidate_forces : (..., k, 3) array
        Their base forces, N.
    candidate_contact_forces : (..., k, 3) array
        Their forces in the material frame at the contact (tangent, d1, d2), N.
    candidate_probabilities : (..., k) array
        Their posterior probabilities, where any contact point of Ω is as probable beforehand; NaN
        without ``noise``.
    n_candidates : (...) int array
        How many.
    triplet : tuple of str
        The signals used, three or more.
    dims : tuple of str
        Names of the leading dimensions.
    coords : dict
        Coordinates along them.
    """

    point: Array
    covariance: Array
    linear: AnyArray
    status: IntArray
    misfit: Array
    arc_length: Array
    force: Array
    moment: Array
    candidates: Array
    candidate_covariances: Array
    candidate_arc_lengths: Array
    candidate_forces: Array
    candidate_contact_forces: Array
    candidate_probabilities: Array
    n_candidates: IntArray
    triplet: tuple[str, ...]
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

    @property
    def candidate_moments(self) -> Array:
        """Base moments of the candidates, N·m, shape (..., k, 3)."""
        return np.cross(self.candidates, self.candidate_forces)

    def to_dataset(self) -> xr.Dataset:
        """Return everything as a labelled dataset.

        Returns
        -------
        Dataset
            Over the measurements' dimensions, ``space`` and ``candidate``.
        """
        dims, space = self.dims, (*self.dims, "space")
        r, theta, phi = np.moveaxis(self.spherical, -1, 0)
        return xr.Dataset(
            {
                "contact_point": (space, self.point, attributes("contact_point_whisker")),
                "r": (dims, r, attributes("r")),
                "theta": (dims, theta, attributes("theta")),
                "phi": (dims, phi, attributes("phi")),
                "covariance": ((*space, "space_2"), self.covariance, attributes("covariance")),
                "arc_length": (dims, self.arc_length, attributes("arc_length")),
                "force": (space, self.force, attributes("force")),
                "moment": (space, self.moment, attributes("moment")),
                "misfit": (dims, self.misfit, attributes("misfit")),
                "candidates": (
                    (*dims, "candidate", "space"),
                    self.candidates,
                    attributes("contact_point_whisker"),
                ),
                "candidate_covariances": (
                    (*dims, "candidate", "space", "space_2"),
                    self.candidate_covariances,
                    attributes("covariance"),
                ),
                "candidate_arc_lengths": (
                    (*dims, "candidate"),
                    self.candidate_arc_lengths,
                    attributes("arc_length"),
                ),
                "candidate_forces": (
                    (*dims, "candidate", "space"),
                    self.candidate_forces,
                    attributes("force"),
                ),
                "candidate_moments": (
                    (*dims, "candidate", "space"),
                    self.candidate_moments,
                    attributes("moment"),
                ),
                "candidate_probabilities": (
                    (*dims, "candidate"),
                    self.candidate_probabilities,
                    attributes("probability"),
                ),
                "n_candidates": (dims, self.n_candidates, attributes("candidates")),
                "probability": (dims, self.probability, attributes("probability")),
                "linear": (dims, self.linear, attributes("linear")),
                "status": (dims, self.status, {**attributes("status"), **flag_attributes()}),
            },
            coords={**self.coords, "space": ["x", "y", "z"], "space_2": ["x", "y", "z"]},
            attrs={"triplet": " ".join(self.triplet)},
        )

    def __repr__(self) -> str:
        """Say how many there are and what became of them."""
        return f"<{self._title()}: {counted(self.status)}>"

    def _repr_html_(self) -> str:
        """Show the contact points about the base, with the numbers."""
        return estimate_card(self._title(), self)

    def __str__(self) -> str:
        """Tell the numbers as well."""
        return lines(self._title(), estimate_rows(self))

    def _title(self) -> str:
        return f"Estimate of {self.status.shape or 'one'} from ({', '.join(self.triplet)})"


def estimate(
    contact_map: ContactMap,
    signals: xr.Dataset | Mapping[str, ArrayLike],
    triplet: str | tuple[str, ...] = ("Fx", "MB", "MD"),
    noise: Mapping[str, float] | ArrayLike | None = None,
    stiffness_sigma: float = 0.0,
    gain_sigma: float | ArrayLike = 0.0,
    mixing_sigma: float | ArrayLike = 0.0,
    prior: Prior | None = None,
) -> Estimate:
    """Find all frictionless contacts of a whisker that explain measured signals."""
    names = selection(triplet)
    errors = common_errors(stiffness_sigma, gain_sigma, mixing_sigma)
    sensor = sensor_noise(noise, names, errors)
    values, dims, coords = measured(signals, names)
    check_signals(values, names)
    shape = values.shape[:-1]
    d = contact_map.chart.discretization
    targets = values.reshape(-1, len(names)) / signal_scales(names, d.force, d.moment)
    found = _explained(contact_map, names, targets, sensor)
    if prior is not None:
        readout = Named(contact_map, names, sensor)
        found = among_allowed(prior, contact_map, readout, targets, found)
    most = max(1, int(found.number.max(initial=0)))

    def whole(array: AnyArray) -> AnyArray:
        return array.reshape((*shape, *array.shape[1:]))

    forces, points = found.values[..., :3] * d.force, found.values[..., 3:] * d.length
    return Estimate(
        point=whole(points[:, 0]),
        covariance=whole(found.covariances[:, 0] * d.length**2),
        linear=whole(found.linear),
        status=whole(found.status),
        misfit=whole(found.misfit),
        arc_length=whole(found.contacts[:, 0, 0] * d.length),
        force=whole(forces[:, 0]),
        moment=whole(np.cross(points[:, 0], forces[:, 0])),
        candidates=whole(points[:, :most]),
        candidate_covariances=whole(found.covariances[:, :most] * d.length**2),
        candidate_arc_lengths=whole(found.contacts[:, :most, 0] * d.length),
        candidate_forces=whole(forces[:, :most]),
        candidate_contact_forces=whole(found.contacts[:, :most, 1:] * d.force),
        candidate_probabilities=whole(found.probability[:, :most]),
        n_candidates=whole(found.number),
        triplet=names,
        dims=dims,
        coords=coords,
    )


def _explained(
    contact_map: ContactMap, names: tuple[str, ...], targets: Array, sensor: SensorNoise | None
) -> Explanation:
    if not contact_map.determines(names):
        return undetermined(targets)
    if len(names) == 3:
        found = by_triplet(contact_map, names, targets)
    else:
        found = by_least_squares(contact_map, names, targets, sensor)
    return found if sensor is None else under_noise(contact_map, names, targets, sensor, found)
