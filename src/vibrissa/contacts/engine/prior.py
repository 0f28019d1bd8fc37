"""Prior knowledge of contacts: where they may be, and how strong.

A prior leaves out the candidates that it does not allow: for a robot whose whisker meets objects on
one side only, a contact is not on the other; and of two contacts with the same signals, one may
need a larger force than the object can exert.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from vibrissa.contacts.charted_whisker import ChartedWhisker
from vibrissa.contacts.contacts import Candidates
from vibrissa.contacts.engine.ranking import chi_squared_of
from vibrissa.contacts.engine.readout import Mixed, Named
from vibrissa.contacts.engine.tip import tip_contacts
from vibrissa.contacts.uncertainty.posterior import CERTAIN
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.rod import Discretization, contact_tangents, discretize
from vibrissa.signals import REGIONS, concave_backward, in_region, spherical
from vibrissa.status import Status
from vibrissa.whisker import Whisker

_REACHED = (0.5, 1.0, 2.0, 3.0)  # standard deviations at which a region is looked for
_COORDINATES = ("r", "theta", "phi")
_TURN = 2.0 * np.pi
_NEAREST = 0.01  # share of the length below which no contacts are searched for
# Forces in units of EI/L² beyond which a limit leaves out either no contact or all: one at 3 % of
# the length that bends the whisker by 1 rad has 2,000, one that bends it by 0.003° at the tip 1e-4.
_FAINTEST, _STRONGEST = 1e-4, 3e3


@dataclass(frozen=True)
class Prior:
    """Which contacts are possible.

    Parameters
    ----------
    region : str or mapping
        Region of the contacts: one of "all", "ELD", "CF", "CB", "ELD CF" and "ELD CB" (concave
        backward and forward; excluding large deflections), or the least and the greatest value of
        some of ``r`` (m), ``theta`` and ``phi`` (rad) in the whisker's frame. A range of θ whose
        least value is above the greatest passes through ±π. With noise, contacts from which the
        region is within three standard deviations are the answer if none is in it.
    least_force, greatest_force : float
        Size of the contact force, N.
    tip : float
        Prior probability that an object touches the tip itself, so that the force is normal to
        the object and not to the whisker; 0, the default: contacts of the side only. It is for
        three signals or more with noise; the wrench shows such contacts by itself. A tip that is
        pulled outward, by friction or a hook, has the same three signals as a contact of the side,
        and is taken for one; the wrench finds it.

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
    tip: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_force < self.greatest_force:
            raise ValueError(
                "a contact force has 0 ≤ least < greatest, N; got "
                f"{self.least_force!r} and {self.greatest_force!r}"
            )
        if not 0.0 <= self.tip < 1.0:
            raise ValueError(f"tip is a probability below 1; got {self.tip!r}")
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
            if name != "r" and (np.abs(pair[np.isfinite(pair)]) > _TURN).any():
                raise ValueError(f"{name} is an angle in rad; got {limits!r}, as of degrees")

    def allows(
        self, whisker: Whisker, points: Array, arc_lengths: Array, contact_forces: Array
    ) -> AnyArray:
        """Say which contacts are possible.

        Parameters
        ----------
        whisker : Whisker
            Whisker that is touched.
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

        Raises
        ------
        ValueError
            If the region is farther away than the whisker is long, as if it were in mm, or a force
            is not of the order of those that bend the whisker.
        """
        self._check_forces(whisker)
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
        nearest, farthest = self.region.get("r", (0.0, np.inf))
        if nearest > whisker.length or farthest < _NEAREST * whisker.length:
            raise ValueError(
                f"a region has r between {nearest:g} and {farthest:g} m; no contact of a whisker "
                f"of {whisker.length:g} m is there: are they in m (on the command line mm)?"
            )
        for name, value in zip(_COORDINATES, spherical(points).T, strict=True):
            if name in self.region:
                allowed &= _between(name, value, *self.region[name])
        return np.asarray(allowed)

    def _check_forces(self, whisker: Whisker) -> None:
        """Raise ValueError for forces that leave out all contacts of a whisker, or none."""
        unit = whisker.base_bending_stiffness / whisker.length**2
        for name in ("least_force", "greatest_force"):
            force = getattr(self, name)
            if 0.0 < force < np.inf and not _FAINTEST <= force / unit <= _STRONGEST:
                raise ValueError(
                    f"{name} is {force:g} N; contacts bend this whisker with the order of "
                    f"EI/L² = {unit:.2g} N: is it in N (on the command line µN)?"
                )


def possible_candidates(
    prior: Prior, whisker: Whisker, d: Discretization, found: Candidates, *, near: bool = True
) -> AnyArray:
    """Which candidates (n, k) of a whisker are possible; padding is not.

    Noise may displace a possible contact beyond the prior's region. Where it leaves none, those
    from which the region is within three standard deviations of the contact point count as
    possible, unless ``near`` is false.
    """
    there = np.arange(found.x.shape[1]) < found.number[:, None]

    def allowed_of(which: AnyArray, moved: Array | float = 0.0) -> AnyArray:
        x, points = found.x[which], found.values[which][:, 3:] + moved
        return prior.allows(whisker, points * d.length, x[:, 0] * d.length, x[:, 1:] * d.force)

    allowed: AnyArray = np.zeros(there.shape, np.bool_)
    allowed[there] = allowed_of(there)
    known = np.isfinite(found.covariances).all(axis=(2, 3))
    lost = there & known & ~allowed.any(axis=1, keepdims=True)
    if not (near and lost.any()):
        return allowed
    size, axes = np.linalg.eigh(found.covariances[lost])
    root = axes * np.sqrt(np.maximum(size, 0.0))[:, None, :]
    reached = np.zeros(len(root), bool)
    for direction in itertools.product((-1.0, 0.0, 1.0), repeat=3):
        step = np.linalg.norm(direction)
        for share in _REACHED if step > 0.0 else ():
            reached |= allowed_of(lost, root @ (np.array(direction) * share / step))
    allowed[lost] = reached
    return allowed


def refuse_tip(prior: Prior | None, what: str) -> None:
    """Refuse a prior with contacts of the tip where these cannot be compared with the others."""
    if prior is not None and prior.tip > 0.0:
        raise ValueError(
            f"contacts of the tip (tip = {prior.tip:g}) are compared with those of three signals "
            f"or more without friction, weight or a filter; {what}"
        )


def _between(name: str, value: Array, least: float, greatest: float) -> AnyArray:
    if name != "theta" or greatest - least >= _TURN:
        return np.asarray((value >= least) & (value <= greatest))
    return np.asarray((value - least) % _TURN <= (greatest - least) % _TURN)


def among_allowed(
    prior: Prior,
    contact_map: ChartedWhisker,
    readout: Named | Mixed,
    measured: tuple[Array, Array],
    found: Candidates,
    status: IntArray,
    chi_squared: Array,
) -> tuple[Candidates, IntArray, Array]:
    """Add contacts of the tip, and leave out candidates that a prior does not allow."""
    if prior.tip:
        tips = tip_contacts(contact_map, readout, prior.tip)
        found, status, chi_squared = tips.allow(measured, found, status, chi_squared)
    allowed = possible_candidates(
        prior, contact_map.whisker, contact_map.chart.discretization, found
    )
    number, before = allowed.sum(axis=1), found.number
    if (number == before).all():
        return found, status, chi_squared
    changed = (before > 0) & ~allowed[:, 0]
    found = found.allowed_first(allowed)
    fewer = number < before
    found.probability[fewer] = _renormalised(found.probability[fewer])
    status, chi_squared = status.copy(), chi_squared.copy()
    for row in np.flatnonzero(changed & (number > 0) & (chi_squared > 0.0)):
        x, value = found.x[row, 0], found.values[row, 0]
        chi_squared[row] = chi_squared_of(readout.how, x, value, measured[1][row], measured[0][row])
    for row in np.flatnonzero(fewer):
        chance = found.probability[row, 0]
        status[row] = _left(Status(int(status[row])), int(number[row]), chance)
    return found, status, chi_squared


def _renormalised(probability: Array) -> Array:
    """Probabilities (..., k) of the remaining candidates, NaN without any; equal if all vanish."""
    total = np.nansum(probability, axis=-1, keepdims=True)
    weight = np.where(total > 0.0, probability, probability + 1.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(weight / np.nansum(weight, axis=-1, keepdims=True))


def _left(status: Status, number: int, probability: float) -> Status:
    """Status for the remaining candidates, the first of them with this probability."""
    if status in (Status.UNIQUE, Status.AMBIGUOUS, Status.APPROXIMATE, Status.UNDERDETERMINED):
        if not number:
            return Status.OUTSIDE_PRIOR
        if status == Status.AMBIGUOUS and (number == 1 or probability > CERTAIN):
            return Status.UNIQUE
    return status
