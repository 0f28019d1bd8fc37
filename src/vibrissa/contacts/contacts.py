"""Estimated contacts: the results of all methods of estimation."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from vibrissa.deferred import xr
from vibrissa.numerics import AnyArray, Array, IntArray
from vibrissa.quantities import attributes, shown_unit
from vibrissa.rod import Discretization
from vibrissa.signals import Coordinates, spherical
from vibrissa.sketch import CONTACT, REST, Mark, card, columns, lines, shown, table, views
from vibrissa.status import Status, counted, describe, flag_attributes, names

#: Largest number of candidates for one measurement.
MOST_CANDIDATES = 8
#: Posterior probability that three standard deviations of a valid covariance may leave out, and
#: their squared radius.
LEFT, THREE_SIGMA = 0.0033, 14.156
_LISTED = 5  # contacts in the table of a display
_CERTAIN = (Status.UNIQUE, Status.TIP_CONTACT)
_SPACE = ["x", "y", "z"]


class Candidates(NamedTuple):
    """Candidates of n measurements, non-dimensional, padded with NaN."""

    number: IntArray  # (n,), number of candidates
    x: Array  # (n, k, 4), arc length and contact force (s, f_x, f_y, f_z)
    values: Array  # (n, k, 6), base force and contact point (F, p)
    covariances: Array  # (n, k, 3, 3), covariances of the contact point
    chi_squared: Array  # (n, k), χ² of each candidate
    probability: Array  # (n, k), posterior probabilities
    valid: AnyArray  # (n, k), whether the covariances are valid
    angle_sigma: Array  # (n, k), standard deviations of the friction angle, rad

    @classmethod
    def room(cls, n: int, most: int = MOST_CANDIDATES) -> Candidates:
        """Allocate candidates of n measurements."""
        return candidates_within(*Room.of(n, most))

    def allowed_first(self, allowed: AnyArray) -> Candidates:
        """Drop candidates that are not allowed; the others keep their order."""
        return self.ordered(np.argsort(~allowed, axis=1, kind="stable"), allowed.sum(axis=1))

    def ordered(self, order: IntArray, number: IntArray) -> Candidates:
        """Candidates in another order (n, k), and how many of them remain."""
        line = np.arange(len(order))[:, None]
        gone = np.arange(order.shape[1]) >= number[:, None]
        parts = [values[line, order] for values in self[1:]]
        for part in parts:
            part[gone] = False if part.dtype == np.bool_ else np.nan
        return Candidates(number, *parts)

    def trimmed(self) -> Candidates:
        """Copy of the columns that any measurement uses."""
        most = max(1, int(self.number.max(initial=0)))
        return Candidates(self.number, *(values[:, :most].copy() for values in self[1:]))

    @classmethod
    def joined(cls, parts: list[Candidates]) -> Candidates:
        """Concatenate candidates of successive measurements; the list is emptied."""
        count, most = sum(len(one.number) for one in parts), max(one.x.shape[1] for one in parts)
        number = np.empty(count, np.int64)
        fields = [np.empty((count, most, *v.shape[2:]), v.dtype) for v in parts[0][1:]]
        start = count
        while parts:  # free the memory of a part before more is written
            part = parts.pop()
            start, end = start - len(part.number), start
            number[start:end] = part.number
            for whole, values in zip(fields, part[1:], strict=True):
                own = values.shape[1]
                whole[start:end, :own] = values
                whole[start:end, own:] = False if values.dtype == np.bool_ else np.nan
        return cls(number, *fields)

    def spread_out(self, rows: IntArray, n: int) -> Candidates:
        """Candidates of some measurements, at their rows among those of n."""
        out = Candidates.room(n, self.x.shape[1])
        for mine, theirs in zip(out, self, strict=True):
            mine[rows] = theirs
        return out


class Room(NamedTuple):
    """Memory for the candidates of n measurements, in few arrays, which kernels divide."""

    number: IntArray  # (n,), number of candidates
    flat: Array  # (22 n k,), all floating-point arrays of `Candidates`, concatenated
    valid: AnyArray  # (n, k), whether the covariances are valid

    @classmethod
    def of(cls, n: int, most: int = MOST_CANDIDATES) -> Room:
        """Allocate memory for n measurements."""
        flat = np.empty(22 * n * most)
        flat.fill(np.nan)  # takes half the time of `np.full`
        return cls(np.zeros(n, np.int64), flat, np.zeros((n, most), np.bool_))


def candidates_within(number: IntArray, flat: Array, valid: AnyArray) -> Candidates:
    """Candidates in the memory of a `Room`."""
    n, most = valid.shape
    rows = n * most
    return Candidates(
        number,
        flat[: 4 * rows].reshape(n, most, 4),
        flat[4 * rows : 10 * rows].reshape(n, most, 6),
        flat[10 * rows : 19 * rows].reshape(n, most, 3, 3),
        flat[19 * rows : 20 * rows].reshape(n, most),
        flat[20 * rows : 21 * rows].reshape(n, most),
        valid,
        flat[21 * rows :].reshape(n, most),
    )


def friction_assumed(friction: float) -> str:
    """End of a sentence on the friction that an estimate assumes, as of `Contacts.friction`."""
    if not friction:
        return "no friction assumed"
    if np.isinf(friction):
        return "any friction along the whisker allowed for"
    return f"friction along the whisker of {friction:g} (one sigma) allowed for"


class _Located:
    """Properties that follow from the stored fields of contacts."""

    point: Array
    force: Array
    contact_force: Array

    @property
    def spherical(self) -> Array:
        """Spherical form (r, θ, φ) of the contact point, m and rad, shape (..., 3)."""
        return spherical(self.point)

    @property
    def moment(self) -> Array:
        """Base moment p × F, N·m, shape (..., 3)."""
        return np.asarray(np.cross(self.point, self.force))

    @property
    def friction_angle(self) -> Array:
        """Angle between the force and the plane normal to the whisker, rad, shape (...).

        Positive where the object pulls toward the tip; its tangent is the least coefficient of
        friction that holds the contact. Zero where the contact was taken to be frictionless.
        """
        normal = np.hypot(self.contact_force[..., 1], self.contact_force[..., 2])
        return np.asarray(np.arctan2(self.contact_force[..., 0], normal))


@dataclass(frozen=True, eq=False, repr=False)
class Contacts(_Located):
    """Contacts that explain measurements, whisker frame, SI units.

    The fields are those of the most plausible contact of each measurement; `candidates` has all.

    Attributes
    ----------
    point : (..., 3) array
        Contact point, m; NaN where there is none.
    covariance : (..., 3, 3) array
        Covariance of the contact point, m², to first order where the contact moves with the signals
        as derivatives say; elsewhere, as near slip-off and where the deflection is small, that of
        the posterior probability, widened to contain its distant contacts; NaN without ``noise``.
    covariance_valid : (...) bool array
        Whether regions stated from the covariance hold what they state: the status is ``UNIQUE``,
        other candidates together are at most 0.33 % probable, and the 95 % ellipsoid of the widened
        covariance contains about 95 % of the contact's posterior. Of a candidate it is the last
        alone.
        False without ``noise``.
    chi_squared : (...) array
        χ² of the contact: sum of squares of the part of the signals that it leaves unexplained, in
        standard deviations. Without ``noise``, components of force and moment count as known to
        1 % of |F| and |M|; three signals then have 0 where they are explained, and else the
        distance to the nearest signals that are, as a share of each signal's range, and no contact.
    probability : (...) array
        Posterior probability of the contact, where any contact point of Ω is as probable
        beforehand (and, of the wrench, friction angles scatter by 20°); NaN without ``noise``.
    status : (...) int array
        Value of :class:`~vibrissa.Status` for each measurement: ``UNIQUE`` (with ``noise``: all
        other candidates together are less than 5 % probable); ``AMBIGUOUS``; ``NOT_FRICTIONLESS``
        where no contact explains the signals (with ``noise``, and of more than three signals: χ² is
        larger than in one measurement of a thousand; the contact nearest is given);
        ``OUTSIDE_MAP`` where one nearer to the base would, or where signals are ten times larger
        than any on the map; ``OUTSIDE_PRIOR`` where the prior allows none of the candidates;
        ``TIP_CONTACT`` as ``UNIQUE``, of a contact of the tip that the prior allows for;
        ``DEGENERATE`` where forces and moments are zero, where the signals do not determine
        contacts (:meth:`ContactMap.determines`), where without ``noise`` a relative error of 1e-7
        of three signals would move the contact by 1 % of the length, and also contacts 1 % to
        either side of it, or where with this noise the contact may be anywhere; ``MISSING``. Of the
        wrench also ``NOT_ONE_CONTACT`` where χ² is too large, ``BEYOND_TIP`` where moreover the
        nearest contact is the tip, ``TOO_PROXIMAL`` where
        it is at 0.05 L. Of fewer than three signals ``UNDERDETERMINED``: candidates are samples of
        the curve or surface of contacts that explain them. Of the paper's methods, which cannot see
        whether contacts are ambiguous: ``APPROXIMATE``, ``OUTSIDE_MAP`` or ``MISSING``.
    arc_length : (...) array
        Arc length of the contact, m.
    force : (..., 3) array
        Base force, N.
    contact_force : (..., 3) array
        Force in the material frame at the contact (tangent, d1, d2), N.
    friction_angle_sigma : (...) array
        Standard deviation of the friction angle, rad; NaN without ``noise`` and without friction.
    n_candidates : (...) int array
        Number of candidates.
    friction : float
        Standard deviation that was assumed of the ratio of the force along the whisker to that
        across it: 0 for contacts without friction, infinite where any ratio is allowed.
    candidates : Contacts
        All candidates, with one dimension more, padded with NaN (and the status ``MISSING``): with
        ``noise`` by falling probability; without, by rising force, or for more than three signals
        by rising χ² and then force. Their χ² is within 10.8 of the least (the likelihood ratio that
        one pair in a thousand exceeds by chance).
    using : tuple of str
        Signals used.
    dims : tuple of str
        Names of the leading dimensions.
    coords : dict
        Coordinates along them.
    """

    point: Array
    covariance: Array
    covariance_valid: AnyArray
    chi_squared: Array
    probability: Array
    status: IntArray
    arc_length: Array
    force: Array
    contact_force: Array
    friction_angle_sigma: Array
    n_candidates: IntArray
    using: tuple[str, ...]
    dims: tuple[str, ...] = ()
    coords: Coordinates = field(default_factory=dict)
    friction: float = 0.0
    _candidates: Contacts | None = None

    @property
    def candidates(self) -> Contacts:
        """All candidates, with one dimension more; see the class."""
        if self._candidates is None:
            raise ValueError("candidates have no candidates of their own")
        return self._candidates

    def to_dataset(self) -> xr.Dataset:
        """Return everything as a labelled dataset, whose attributes are the assumptions.

        Returns
        -------
        Dataset
            Variables of :meth:`Contacts.to_dataset`.
        """
        data = self._variables("")
        if self._candidates is not None:
            data |= self._candidates._variables("candidate_")
        coords = {**self.coords, "space": _SPACE, "space_2": _SPACE, "material": ["t", "d1", "d2"]}
        about = {"using": " ".join(self.using), "friction": self.friction}
        return xr.Dataset(data, coords=coords, attrs=about)

    def _variables(self, prefix: str) -> dict[str, Any]:
        r, theta, phi = np.moveaxis(self.spherical, -1, 0)
        named: list[tuple[str, str, AnyArray, tuple[str, ...]]] = [
            ("contact_point", "contact_point_whisker", self.point, ("space",)),
            ("r", "r", r, ()),
            ("theta", "theta", theta, ()),
            ("phi", "phi", phi, ()),
            ("covariance", "covariance", self.covariance, ("space", "space_2")),
            ("covariance_valid", "covariance_valid", self.covariance_valid, ()),
            ("chi_squared", "chi_squared", self.chi_squared, ()),
            ("probability", "probability", self.probability, ()),
            ("arc_length", "arc_length", self.arc_length, ()),
            ("force", "force", self.force, ("space",)),
            ("moment", "moment", self.moment, ("space",)),
            ("contact_force", "contact_force", self.contact_force, ("material",)),
            ("friction_angle", "friction_angle", self.friction_angle, ()),
            ("friction_angle_sigma", "friction_angle_sigma", self.friction_angle_sigma, ()),
        ]
        out: dict[str, Any] = {
            prefix + name: ((*self.dims, *axes), values, attributes(quantity))
            for name, quantity, values, axes in named
        }
        if not prefix:
            out["n_candidates"] = (self.dims, self.n_candidates, attributes("candidates"))
            flags = {**attributes("status"), **flag_attributes()}
            out["status"] = (self.dims, self.status, flags)
        return out

    def plot(self) -> str:
        """Draw the contact points and all candidates about the base.

        Returns
        -------
        str
            An SVG element: the x-y and the x-z plane of the whisker's frame.
        """
        every = self.point if self._candidates is None else self._candidates.point
        return _picture(self.point, every)

    def __repr__(self) -> str:
        return f"<{self._title()}: {counted(self.status)}>"

    def _repr_html_(self) -> str:
        """Show the contact points about the base, with the numbers."""
        heading, listed = self._listed()
        return card(self._title(), self._rows(), self.plot() + table(listed, heading))

    def __str__(self) -> str:
        heading, listed = self._listed()
        every = columns([heading, *listed]) if listed else []
        return "\n".join([lines(self._title(), self._rows()), *every])

    def _title(self) -> str:
        return f"Contacts of {self.status.shape or 'one'} from ({', '.join(self.using)})"

    def _rows(self) -> list[tuple[str, str]]:
        r, theta, phi = np.moveaxis(self.spherical, -1, 0)
        sigma = np.sqrt(np.einsum("...ii->...i", self.covariance).max(axis=-1))
        one = np.size(self.status) == 1
        rows = [
            ("status", next(iter(describe(self.status))) if one else counted(self.status)),
            ("r", shown("r", r)),
            ("θ", shown("theta", theta)),
            ("φ", shown("phi", phi)),
            ("largest standard deviation of x, y, z", shown("r", sigma)),
            ("arc length", shown("arc_length", self.arc_length)),
            ("contact force", shown("force", np.linalg.norm(self.contact_force, axis=-1))),
            ("candidates", shown("candidates", self.n_candidates)),
            ("assumption", friction_assumed(self.friction)),
        ]
        if np.nan_to_num(self.contact_force[..., 0]).any():
            rows.append(("friction angle", shown("friction_angle", self.friction_angle)))
        return rows

    def _listed(self) -> tuple[list[str], list[list[str]]]:
        """Heading and rows of a table: the candidates of one measurement, or the first contacts."""
        one = self.status.size == 1 and self._candidates is not None
        whole = self.candidates if one else self
        found = np.isfinite(whole.point).all(axis=-1).reshape(-1)
        at = np.flatnonzero(found)[:_LISTED]
        force = np.linalg.norm(whole.contact_force, axis=-1).reshape(-1)[at]
        sigma = np.sqrt(np.einsum("...ii->...i", whole.covariance).max(axis=-1)).reshape(-1)[at]
        newton, unit = shown_unit("force", force)
        heading = ["candidate" if one else "contact", "s (mm)", "x", "y", "z (mm)", "σ (mm)"]
        heading += [f"force ({unit})", "probability" if one else "status"]
        last = (
            [f"{value:.3f}" for value in whole.probability.reshape(-1)[at]]
            if one
            else [name.lower().replace("_", " ") for name in names(whole.status.reshape(-1)[at])]
        )
        place = np.column_stack([whole.arc_length.reshape(-1)[at], whole.point.reshape(-1, 3)[at]])
        cells = [
            [
                str(at[i]),
                *(f"{value:z.3f}" for value in 1e3 * place[i]),
                f"{1e3 * sigma[i]:.2g}",
                f"{newton * force[i]:.4g}",
                last[i],
            ]
            for i in range(at.size)
        ]
        rows = [[cell.replace("nan", "–").replace("-", "−") for cell in row] for row in cells]
        if found.sum() > _LISTED:
            rows.append(["…", f"{found.sum() - _LISTED} more"])
        return heading, rows


def contacts_of(
    found: Candidates,
    status: IntArray,
    chi_squared: Array,
    discretization: Discretization,
    using: tuple[str, ...],
    shape: tuple[int, ...],
    dims: tuple[str, ...],
    coords: Coordinates,
    friction: float = 0.0,
) -> Contacts:
    """Convert candidates of flat measurements to SI units, in place, in the measurements' shape."""
    d, most = discretization, max(1, int(found.number.max(initial=0)))
    found.values[..., :3] *= d.force
    found.values[..., 3:] *= d.length
    found.covariances[...] *= d.length**2
    found.x[..., 0] *= d.length
    found.x[..., 1:] *= d.force

    def whole(values: AnyArray) -> AnyArray:
        return values.reshape((*shape, *values.shape[1:]))

    there = np.arange(most) < found.number[:, None]
    every = Contacts(
        point=whole(found.values[:, :most, 3:]),
        covariance=whole(found.covariances[:, :most]),
        covariance_valid=whole(found.valid[:, :most] & there),
        chi_squared=whole(found.chi_squared[:, :most]),
        probability=whole(found.probability[:, :most]),
        status=whole(np.where(there, status[:, None], int(Status.MISSING))),
        arc_length=whole(found.x[:, :most, 0]),
        force=whole(found.values[:, :most, :3]),
        contact_force=whole(found.x[:, :most, 1:]),
        friction_angle_sigma=whole(found.angle_sigma[:, :most]),
        n_candidates=whole(there.astype(np.int64)),
        using=using,
        dims=(*dims, "candidate"),
        coords=coords,
        friction=friction,
    )
    first = (..., 0)
    valid = found.valid[:, 0] & np.isin(status, _CERTAIN)
    for row in np.flatnonzero(valid & (found.probability[:, 0] < 1.0 - LEFT)):
        covariance, points = found.covariances[row, 0], found.values[row, :most, 3:]
        valid[row] = _complete(covariance, points - points[0], found.probability[row, :most])
    return Contacts(
        point=every.point[..., 0, :],
        covariance=every.covariance[..., 0, :, :],
        covariance_valid=whole(valid),
        chi_squared=whole(chi_squared),
        probability=every.probability[first],
        status=whole(status),
        arc_length=every.arc_length[first],
        force=every.force[..., 0, :],
        contact_force=every.contact_force[..., 0, :],
        friction_angle_sigma=every.friction_angle_sigma[first],
        n_candidates=whole(found.number),
        using=using,
        dims=dims,
        coords=coords,
        friction=friction,
        _candidates=every,
    )


@dataclass(frozen=True, eq=False, repr=False)
class Contact(_Located):
    """The contact that explains one measurement; whisker frame, SI units.

    The fields are those of :class:`Contacts`, for one measurement.

    Attributes
    ----------
    point : (3,) array
        Contact point of the most plausible candidate, m; NaN if there is none. Of fewer than three
        signals the sample in the middle of all.
    covariance : (3, 3) array
        Covariance of the contact point, m²; NaN without noise. Of fewer than three signals that of
        the samples about it.
    covariance_valid : bool
        Whether regions stated from the covariance hold what they state.
    chi_squared : float
        χ² of the contact.
    probability : float
        Posterior probability of the contact; NaN without noise.
    status : Status
        Outcome, as of :class:`Contacts`; with a threshold also ``NOT_FELT``.
    arc_length : float
        Arc length of the contact, m.
    force : (3,) array
        Base force, N.
    contact_force : (3,) array
        Force in the material frame at the contact (tangent, d1, d2), N.
    continuing : int
        Index of the candidate that continues the measurement before; 0 if there was none.
    using : tuple of str
        Signals used.
    friction : float
        Standard deviation that was assumed of the ratio of the force along the whisker to that
        across it: 0 for contacts without friction.
    """

    point: Array
    covariance: Array
    covariance_valid: bool
    chi_squared: float
    probability: float
    status: Status
    arc_length: float
    force: Array
    contact_force: Array
    continuing: int
    using: tuple[str, ...]
    friction: float
    _found: Candidates
    _scales: tuple[float, float]

    @cached_property
    def candidates(self) -> Contacts:
        """All candidates, shape (k,)."""
        (length, force), found, n = self._scales, self._found, self.n_candidates
        return Contacts(
            found.values[0, :n, 3:] * length,
            found.covariances[0, :n] * length**2,
            found.valid[0, :n],
            found.chi_squared[0, :n],
            found.probability[0, :n],
            np.full(n, int(self.status)),
            found.x[0, :n, 0] * length,
            found.values[0, :n, :3] * force,
            found.x[0, :n, 1:] * force,
            found.angle_sigma[0, :n],
            np.ones(n, np.int64),
            self.using,
            ("candidate",),
            friction=self.friction,
        )

    @property
    def n_candidates(self) -> int:
        """Number of candidates."""
        return int(self._found.number[0])

    def to_dataset(self) -> xr.Dataset:
        """Return everything as a labelled dataset without dimensions but the candidates'.

        Returns
        -------
        Dataset
            Variables of :meth:`Contacts.to_dataset`.
        """
        return self._as_contacts().to_dataset()

    def plot(self) -> str:
        """Draw the contact point and all candidates about the base.

        Returns
        -------
        str
            An SVG element: the x-y and the x-z plane of the whisker's frame.
        """
        return _picture(self.point, self.candidates.point)

    def _as_contacts(self) -> Contacts:
        every = self.candidates
        sigma = every.friction_angle_sigma
        return Contacts(
            self.point,
            self.covariance,
            np.asarray(self.covariance_valid),
            np.asarray(self.chi_squared),
            np.asarray(self.probability),
            np.asarray(int(self.status)),
            np.asarray(self.arc_length),
            self.force,
            self.contact_force,
            sigma[0] if len(sigma) else np.asarray(np.nan),
            np.asarray(self.n_candidates),
            every.using,
            friction=self.friction,
            _candidates=every,
        )

    def __repr__(self) -> str:
        where = ", ".join(f"{1e3 * value:z.3f}" for value in self.point.tolist())
        return f"<Contact {self.status.name} at ({where}) mm, candidates: {self.n_candidates}>"

    def _repr_html_(self) -> str:
        """Show the contact point about the base, with the numbers."""
        return self._as_contacts()._repr_html_()

    def __str__(self) -> str:
        return str(self._as_contacts())


def contact_of(
    found: Candidates,
    status: Status,
    chi_squared: float,
    discretization: Discretization,
    using: tuple[str, ...],
    continuing: int = 0,
    first: int = 0,
    covariance: Array | None = None,
    friction: float = 0.0,
) -> Contact:
    """Convert candidates of one measurement to SI units; ``first`` is the most plausible one."""
    length, force = discretization.length, discretization.force
    rest = continuing, using, friction, found, (length, force)
    if not found.number[0]:
        none = np.full(3, np.nan)
        away = np.full((3, 3), np.nan)
        return Contact(
            none, away, False, chi_squared, np.nan, status, np.nan, none, none, 0, *rest[1:]
        )
    values, x = found.values[0, first], found.x[0, first] * force
    if covariance is None:
        covariance = found.covariances[0, first] * length**2
    probability = float(found.probability[0, first])
    complete = not probability < 1.0 - LEFT
    if not complete:
        away = (found.values[0, :, 3:] - values[3:]) * length
        complete = _complete(covariance, away, found.probability[0])
    return Contact(
        values[3:] * length,
        covariance,
        bool(found.valid[0, first]) and status in _CERTAIN and complete,
        chi_squared,
        probability,
        status,
        float(found.x[0, first, 0] * length),
        values[:3] * force,
        x[1:],
        *rest,
    )


def _complete(covariance: Array, away: Array, probability: Array) -> bool:
    """Whether candidates at (n, 3) within three standard deviations have nearly all probability."""
    near = np.einsum("ni,in->n", away, np.linalg.pinv(covariance) @ away.T) <= THREE_SIGMA
    return bool(probability[near].sum() >= 1.0 - LEFT)


def nowhere(status: Status, chi_squared: float, discretization: Discretization) -> Contact:
    """A measurement without a contact."""
    return contact_of(Candidates.room(1, 0), status, chi_squared, discretization, ())


def _picture(points: Array, candidates: Array) -> str:
    marks = [
        Mark(np.zeros((1, 3)), REST, dots=True, width=7.0, label="base"),
        Mark(np.reshape(candidates, (-1, 3)), REST, dots=True, width=3.0),
        Mark(
            np.reshape(points, (-1, 3)),
            CONTACT,
            dots=True,
            width=4.0,
            label="contact (candidates: grey)",
        ),
    ]
    return views(marks)
