"""What is known of contacts before anything is measured: where they may be, and how strong.

A prior leaves out the candidates that it does not allow: a robot whose whisker meets things on one
side only knows that a contact is not on the other, and of two contacts with the same signals one
needs a force that the object could not stand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from vibrissa.contacts.channels import CIRCULAR, channels_of
from vibrissa.contacts.contact_map import spherical
from vibrissa.contacts.explanation import Explanation
from vibrissa.contacts.located import Located, nowhere
from vibrissa.contacts.posterior import CERTAIN
from vibrissa.contacts.readout import Measurement, Mixed, Named
from vibrissa.contacts.weighing import weigh
from vibrissa.numerics import AnyArray, Array
from vibrissa.rod import contact_tangents, discretize
from vibrissa.signals import REGIONS, concave_backward, in_region, within_turn
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.contacts.contact_map import ContactMap
    from vibrissa.whisker import Whisker

_COORDINATES = ("r", "theta", "phi")
_TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Prior:
    """Which contacts are possible.

    Parameters
    ----------
    region : str or mapping
        Where contacts may be: one of "all", "ELD", "CF", "CB", "ELD CF" and "ELD CB" (concave
        backward and forward; excluding large deflections), or the least and the greatest value of
        some of ``r`` (m), ``theta`` and ``phi`` (rad) in the whisker's frame. A θ whose least
        value is above the greatest goes through ±π.
    least_force, greatest_force : float
        Size of the contact force, N.

    Raises
    ------
    ValueError
        If a region is not known, or limits are not in order.

    Examples
    --------
    >>> Prior("CB", greatest_force=1e-4).region
    'CB'
    >>> Prior({"r": (0.02, 0.03), "theta": (0.0, 0.5)}).least_force
    0.0
    """

    region: str | Mapping[str, tuple[float, float]] = field(default="all", hash=False)
    least_force: float = 0.0
    greatest_force: float = np.inf

    def __post_init__(self) -> None:
        """Check it."""
        if not 0.0 <= self.least_force < self.greatest_force:
            raise ValueError(
                "a contact force has 0 ≤ least < greatest, N; got "
                f"{self.least_force!r} and {self.greatest_force!r}"
            )
        if isinstance(self.region, str):
            if self.region not in REGIONS:
                raise ValueError(f"a region is one of {', '.join(REGIONS)}; got {self.region!r}")
            return
        unknown = [name for name in self.region if name not in _COORDINATES]
        if unknown or not self.region:
            raise ValueError(
                f"a region has limits of {', '.join(_COORDINATES)}; got {dict(self.region)!r}"
            )
        for name, limits in self.region.items():
            pair = np.asarray(limits, dtype=np.float64)
            if pair.shape != (2,) or np.isnan(pair).any():
                raise ValueError(f"{name} is between two numbers; got {limits!r}")
            if name != "theta" and not pair[0] < pair[1]:
                raise ValueError(f"{name} has its least value first; got {limits!r}")

    def allows(
        self,
        whisker: Whisker,
        points: Array,
        arc_lengths: Array,
        contact_forces: Array,
    ) -> AnyArray:
        """Say which contacts are possible.

        Parameters
        ----------
        whisker : Whisker
            What is touched.
        points : (n, 3) array
            Contact points, whisker's frame, m.
        arc_lengths : (n,) array
            Arc lengths of the contacts, m.
        contact_forces : (n, 3) array
            Forces in the material frame at the contact (tangent, d1, d2), N.

        Returns
        -------
        (n,) bool array
            True for those.
        """
        size = np.linalg.norm(contact_forces, axis=1)
        allowed = (size >= self.least_force) & (size <= self.greatest_force)
        if isinstance(self.region, str):
            if self.region == "all":
                return np.asarray(allowed)
            d = discretize(whisker)
            x = np.column_stack([arc_lengths / d.length, contact_forces / d.force])
            large = contact_tangents(d, x)[:, 0] < 0.0
            return np.asarray(
                allowed & in_region(self.region, concave_backward(whisker, points), large)
            )
        for name, value in zip(_COORDINATES, spherical(points).T, strict=True):
            if name in self.region:
                allowed &= _between(name, value, *self.region[name])
        return np.asarray(allowed)


def _between(name: str, value: Array, least: float, greatest: float) -> AnyArray:
    if name != "theta" or greatest - least >= _TURN:
        return np.asarray((value >= least) & (value <= greatest))
    return np.asarray((value - least) % _TURN <= (greatest - least) % _TURN)


def allowed_first(allowed: AnyArray, values: Array) -> Array:
    """Bring what belongs to allowed candidates to the front of their rows."""
    order = np.argsort(~allowed, axis=1, kind="stable")
    out = np.take_along_axis(values, order.reshape(*order.shape, *[1] * (values.ndim - 2)), axis=1)
    out[np.arange(allowed.shape[1]) >= allowed.sum(axis=1)[:, None]] = np.nan
    return out


def among_allowed(
    prior: Prior, contact_map: ContactMap, readout: Named, measured: Array, found: Explanation
) -> Explanation:
    """Leave out candidates of a batch that a prior does not allow."""
    d, most = contact_map.chart.discretization, found.contacts.shape[1]
    there = np.arange(most) < found.number[:, None]
    allowed = np.zeros_like(there)
    x = found.contacts[there]
    allowed[there] = prior.allows(
        contact_map.whisker,
        found.values[there][:, 3:] * d.length,
        x[:, 0] * d.length,
        x[:, 1:] * d.force,
    )
    number, sorted_out = allowed.sum(axis=1), found._asdict()
    for name, values in sorted_out.items():
        if values.ndim > 1:
            sorted_out[name] = allowed_first(allowed, values)
    changed = there[:, 0] & ~allowed[:, 0]
    misfit = found.misfit.copy()
    targets = readout.channels.targets(measured)
    for row in np.flatnonzero(changed & (number > 0) & (misfit > 0.0)):
        value = sorted_out["values"][row, 0]
        misfit[row] = _misfit(readout, Measurement(measured[row], targets[row]), value)
    probability = _renormalised(sorted_out["probability"])
    status = found.status.copy()
    for row in np.flatnonzero(number < found.number):
        status[row] = _left(Status(int(status[row])), int(number[row]), probability[row, 0])
    sorted_out |= {
        "number": number,
        "misfit": misfit,
        "status": status,
        "probability": probability,
    }
    return Explanation(**sorted_out | {"linear": found.linear & ~changed})


def located_where_allowed(
    prior: Prior,
    contact_map: ContactMap,
    readout: Named | Mixed,
    measurement: Measurement,
    located: Located,
) -> Located:
    """Leave out candidates of one measurement that a prior does not allow."""
    whisker, d = contact_map.whisker, contact_map.chart.discretization
    points, forces = located.candidates, located.contact_forces
    kept = np.flatnonzero(prior.allows(whisker, points, located.arc_lengths, forces))
    if len(kept) == len(points):
        return located
    probabilities = _renormalised(located.probabilities[kept])
    status = _left(located.status, len(kept), probabilities[0] if len(kept) else math.nan)
    if not len(kept):
        return nowhere(status, located.misfit)
    covariances, base = located.covariances[kept], located.forces[kept]
    first, covariance, misfit = 0, covariances[0], located.misfit
    if status == Status.UNDERDETERMINED:  # samples of a set: the one in the middle stands for all
        mean = points[kept].mean(axis=0)
        first = int(np.linalg.norm(points[kept] - mean, axis=1).argmin())
        away = points[kept] - points[kept][first]
        covariance = away.T @ away / len(kept) + covariances.mean(axis=0)
    elif kept[0] > 0 and misfit > 0.0:
        value = np.concatenate([base[0] / d.force, points[kept[0]] / d.length])
        misfit = _misfit(readout, measurement, value)
    going_on = np.flatnonzero(kept == located.continuing)
    return Located(
        points[kept][first],
        status,
        points[kept],
        located.arc_lengths[kept],
        covariance,
        misfit,
        int(going_on[0]) if going_on.size else first,
        base,
        covariances,
        forces[kept],
        probabilities,
        bool(located.linear and kept[0] == 0),
    )


def _renormalised(probability: Array) -> Array:
    """Probabilities (..., k) of what is left; NaN stays where there are none.

    Equal ones where what is left had none worth a number.
    """
    total = np.nansum(probability, axis=-1, keepdims=True)
    weight = np.where(total > 0.0, probability, probability + 1.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(weight / np.nansum(weight, axis=-1, keepdims=True))


def _left(status: Status, number: int, probability: float) -> Status:
    """What to say once so many candidates are left, the first of them with this probability."""
    if status in (Status.UNIQUE, Status.AMBIGUOUS, Status.APPROXIMATE, Status.UNDERDETERMINED):
        if not number:
            return Status.OUTSIDE_PRIOR
        if status == Status.AMBIGUOUS and (number == 1 or probability > CERTAIN):
            return Status.UNIQUE
    return status


def _misfit(readout: Named | Mixed, measurement: Measurement, value: Array) -> float:
    """χ² of a contact with (F, p), non-dimensional."""
    how = readout.how
    away = channels_of(value)[how.codes] - measurement.target
    away = within_turn(away, [CIRCULAR[code] for code in how.codes])
    weights = np.zeros((len(away), len(away)))
    if not weigh(how, value, measurement.measured, weights):
        return float("nan")
    return float(((weights @ away) ** 2).sum())
