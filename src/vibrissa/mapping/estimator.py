"""One measurement at a time, in microseconds: for streams, without labelled datasets around it.

Each measurement is searched for in the whole map, so that no candidate is lost by looking only near
the last one; the search tree leads to the contacts in the time that a fit from the last one takes.
The contact that was followed so far is one more place to start from, and it tells which candidate
goes on from it.

Fewer than three signals leave a curve or a surface of contacts: see
:mod:`~vibrissa.mapping.ambiguity`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vibrissa.mapping.ambiguity import Ambiguity
from vibrissa.mapping.explanation import why_none
from vibrissa.mapping.fitting import Fits, charted
from vibrissa.mapping.inversion import polish
from vibrissa.mapping.least_squares import by_doubt
from vibrissa.mapping.located import Explanations, Located
from vibrissa.mapping.minima import same
from vibrissa.mapping.noise import sensor_noise
from vibrissa.mapping.readout import Measurement, Mixed, Named, independent
from vibrissa.mapping.sensor_readout import ByName, readout_of
from vibrissa.mapping.uncertainty import point_covariances
from vibrissa.mapping.weighing import explain, spread
from vibrissa.mapping.whitening import INDISTINCT, explained
from vibrissa.rod.arrays import AnyArray, Array
from vibrissa.rod.batch import solve_forces
from vibrissa.rod.kernels import evaluate
from vibrissa.rod.newton import ROUNDING, TOLERANCE
from vibrissa.rod.reach import LEAST_ARC
from vibrissa.sensing import Sensor
from vibrissa.sensing.sensor import GRAVITY
from vibrissa.signals import selection
from vibrissa.status import Status

if TYPE_CHECKING:
    from vibrissa.mapping.contact_map import ContactMap

# A contact moves no farther than this (over L) from one measurement to the next.
_NEAR = 0.02
_UNKNOWNS = 3
# Fits end within this (over L, and relative to the force) of a minimum that a fold makes flat.
_FLAT = 0.02
# Unknowns of a contact without friction, among all.
_FREE = [0, 2, 3]


class Estimator:
    """Locate contacts from a stream of signals.

    Parameters
    ----------
    contacts : ContactMap
        The whisker's map.
    triplet : str or sequence of str
        The signals that the stream carries, in this order; fewer than three do not determine a
        contact, but leave a curve or surface of them.
    noise : mapping or (6, 6) array_like, optional
        Standard deviation of each signal, or covariance of (F, M), SI units: gives covariances, and
        weighs more than three signals.
    stiffness_sigma : float
        Relative standard deviation of the whisker's bending stiffness E r⁴, in the covariances:
        √(σ_E² + 16 σ_r²) of those of modulus and radius. It needs noise.
    felt_above : float
        Signals within so many standard deviations of zero are ``NO_CONTACT``; 0, the default,
        locates all. It needs noise.

    See Also
    --------
    Estimator.of_sensor : From the raw readings of a sensor, however it mixes and is mounted.
    """

    def __init__(
        self,
        contacts: ContactMap,
        triplet: str | Sequence[str] = ("Fx", "MB", "MD"),
        noise: Mapping[str, float] | ArrayLike | None = None,
        stiffness_sigma: float = 0.0,
        felt_above: float = 0.0,
    ) -> None:
        names = selection(triplet, least=1)
        order = triplet.replace(",", " ").split() if isinstance(triplet, str) else list(triplet)
        sensor = sensor_noise(noise, names, stiffness_sigma)
        self._order: list[int] | None = [order.index(name) for name in names]
        if felt_above > 0.0 and sensor is None:
            raise ValueError("what is felt is judged by the noise, and there is none")
        self._start(contacts, Named(contacts, names, sensor), len(names), felt_above)

    @classmethod
    def of_sensor(
        cls,
        contacts: ContactMap,
        sensor: Sensor,
        stiffness_sigma: float = 0.0,
        felt_above: float = 0.0,
    ) -> Estimator:
        """Locate contacts from a sensor's raw readings.

        Parameters
        ----------
        contacts : ContactMap
            The whisker's map.
        sensor : Sensor
            What it reads, how it is mounted and its noise; offset and weight are taken away.
        stiffness_sigma : float
            Relative standard deviation of the whisker's bending stiffness.
        felt_above : float
            Readings within so many standard deviations of zero are ``NO_CONTACT``; 0 locates all.

        Returns
        -------
        Estimator
            To be called with readings, and where the sensor carries a mass with the rotation.

        Raises
        ------
        ValueError
            If a channel has no noise, or channels do not tell anything.
        """
        out = cls.__new__(cls)
        h, covariance = sensor.base_mixing, sensor.covariance()
        noise = np.diag(covariance)
        if not (noise > 0.0).all():
            silent = [n for n, v in zip(sensor.channels, noise, strict=True) if not v > 0.0]
            raise ValueError(f"readings are weighed by their noise; {', '.join(silent)} has none")
        if not h.any():
            raise ValueError("the sensor's channels read nothing of force and moment")
        readout = readout_of(contacts, h, covariance, stiffness_sigma)
        out._order = None
        out._start(contacts, readout, len(sensor.channels), felt_above)
        out._sensor = sensor
        return out

    def _start(
        self,
        contacts: ContactMap,
        readout: ByName | Named | Mixed,
        width: int,
        felt_above: float,
    ) -> None:
        self.felt_above = float(felt_above)
        self._sensor: Sensor | None = None
        self._components = readout if isinstance(readout, ByName) else None
        self.readout = readout.named if isinstance(readout, ByName) else readout
        self._width = width
        self.contacts, self._chart = contacts, contacts.chart
        told = self.readout.told
        self._ambiguity = Ambiguity(contacts.chart, self.readout) if told < _UNKNOWNS else None
        named = isinstance(self.readout, Named)
        self._determining = told < _UNKNOWNS or not named or contacts.determines(self.names)
        self._limit = explained(independent(contacts, self.readout) - _UNKNOWNS)
        self._length = self._chart.discretization.length
        sensor = self.readout.sensor if isinstance(self.readout, Named) else None
        self.noisy = sensor is not None or not named
        self.reset()

    @property
    def names(self) -> tuple[str, ...]:
        """Signals that contacts are found from, in canonical order; none of a mix of components."""
        return self.readout.names if isinstance(self.readout, Named) else ()

    @property
    def announced(self) -> tuple[str, ...]:
        """Names of the numbers of one measurement, in their order."""
        if self._sensor is not None:
            return tuple(self._sensor.channels)
        order = np.argsort(self._order or range(len(self.names))).tolist()
        return tuple(self.names[i] for i in order)

    def reset(self) -> None:
        """Forget the measurement before, as when the whisker has lost touch."""
        self._last: tuple[Array, Array] | None = None  # ξ and (F, p) of the contact followed
        self._number = 0  # of candidates

    def __call__(
        self,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
    ) -> Located:
        """Locate one measurement.

        Parameters
        ----------
        signals : (k,) array_like
            The signals in the order they were announced, SI units; or the sensor's readings.
        rotation : (3, 3) array_like, optional
            From the whisker's to the laboratory frame, for a sensor that carries a mass.
        gravity : (3,) array_like
            In the laboratory frame, m/s².

        Returns
        -------
        Located
            The contact, all candidates, and the status.

        Raises
        ------
        ValueError
            If there are not as many numbers as signals were announced, a size is negative, an
            angle is more than a full turn, or the rotation is needed but not given.
        """
        return self.locate(self.measurement(signals, rotation, gravity))

    def measurement(
        self,
        signals: ArrayLike,
        rotation: ArrayLike | None = None,
        gravity: ArrayLike = GRAVITY,
    ) -> Measurement:
        """Check one measurement and make it non-dimensional; as for calling the estimator.

        Parameters
        ----------
        signals : (k,) array_like
            The signals or readings.
        rotation : (3, 3) array_like, optional
            From the whisker's to the laboratory frame.
        gravity : (3,) array_like
            In the laboratory frame, m/s².

        Returns
        -------
        Measurement
            For `locate`; NaN for what is missing.
        """
        try:
            values = np.asarray(signals, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"one measurement has {self._width} numbers; got {signals!r}"
            ) from error
        if values.shape != (self._width,):
            raise ValueError(f"one measurement has {self._width} signals; got shape {values.shape}")
        if self._sensor is not None:
            values = self._sensor.felt(values, rotation, gravity)
            if self._components is not None:
                values = self._components.signals(values)
        elif self._order is not None:
            values = values[self._order]
        return self.readout.scaled(values)

    def locate(self, measurement: Measurement) -> Located:
        """Locate one measurement.

        Parameters
        ----------
        measurement : Measurement
            Of `measurement`.

        Returns
        -------
        Located
            The contact, all candidates, and the status.
        """
        nothing = self.nothing_in(measurement)
        if nothing is not None:
            return self._nowhere(nothing)
        if self._ambiguity is not None:
            return self._set(measurement, self._ambiguity)
        if len(self.names) == _UNKNOWNS:
            return self._by_triplet(measurement)
        return self._by_least_squares(measurement)

    def nothing_in(self, measurement: Measurement) -> Status | None:
        """Why a measurement is not worth a search: ``MISSING``, ``NO_CONTACT``, ``DEGENERATE``.

        Parameters
        ----------
        measurement : Measurement
            Of `measurement`.

        Returns
        -------
        Status or None
            None where it is worth one.
        """
        if not np.isfinite(measurement.measured).all():
            return Status.MISSING
        if self.felt_above > 0.0 and not self.readout.felt(measurement, self.felt_above):
            return Status.NO_CONTACT
        return None if self._determining else Status.DEGENERATE

    def explanations(self, measurement: Measurement) -> Explanations:
        """All minima of χ² that noise may explain: also those that miss the measurement a little.

        Three signals with noise may lie where no contact is, just across a fold from the true one.

        Parameters
        ----------
        measurement : Measurement
            Of three signals or more.

        Returns
        -------
        Explanations
            Found from all parts of the map; a millisecond.
        """
        readout, chart = self.readout, self._chart
        nodes = readout.nearest(measurement)
        exact, _ = readout.seeds(measurement)
        starts = np.concatenate([exact, chart.contacts.reshape(-1, 3)[nodes]])
        fits, inside = self._fitted(measurement, starts, None)
        limit = explained(len(readout.how.own))
        kept: list[int] = []
        for row in np.argsort(fits.misfits).tolist():
            x = fits.contacts[row]
            good = inside[row] and fits.misfits[row] <= limit
            if good and not any(_close(x, fits.contacts[other]) for other in kept):
                kept.append(row)
        some = Fits(*(part[kept] for part in fits))
        covariances = np.full((len(kept), 3, 3), np.nan)
        spread(
            readout.how,
            measurement.measured,
            some.contacts[:, _FREE],
            some.values,
            some.tangents[:, :, _FREE],
            covariances,
        )
        return Explanations(some.contacts, some.values, covariances, some.misfits)

    def _by_triplet(self, measurement: Measurement) -> Located:
        xi, values = self.readout.seeds(measurement)
        assert values is not None
        if len(xi) < self._number and not self._follows(values):
            xi, values = self._followed(measurement.measured[None], xi, values)
        if not len(xi):
            why, misfit = why_none(self.contacts, self.names, measurement.measured[None])
            return self._nowhere(Status(int(why[0])), float(misfit[0]))
        status = Status.UNIQUE if len(xi) == 1 else Status.AMBIGUOUS
        return self._located(measurement, xi, values, status, 0.0)

    def _follows(self, values: Array) -> bool:
        """Whether a candidate is near the contact followed so far."""
        assert self._last is not None
        away = np.abs(values[:, 3:] - self._last[1][3:]).max(axis=1)
        return bool((away < _NEAR).any())

    def _followed(self, targets: Array, xi: Array, values: Array) -> tuple[Array, Array]:
        """Add the contact that goes on from the last one, should the search have missed it."""
        assert self._last is not None
        at, value, residual, sign = polish(self._chart, self.names, targets, self._last[0][None])
        new = residual[0] <= TOLERANCE and sign[0] > 0.0 and at[0, 0] >= self._chart.proximal
        if not new or not np.abs(value[0, 3:] - self._last[1][3:]).max() < _NEAR:
            return xi, values
        xi, values = np.concatenate([xi, at]), np.concatenate([values, value])
        order = np.argsort(np.hypot(xi[:, 1], xi[:, 2]))
        return xi[order], values[order]

    def _by_least_squares(self, measurement: Measurement) -> Located:
        if self.readout.nothing(measurement):
            return self._nowhere(Status.DEGENERATE)
        if self.readout.beyond(measurement):
            return self._nowhere(Status.OUTSIDE_MAP)
        starts, values = self.readout.seeds(measurement)
        if self._last is not None and not (values is not None and self._follows(values)):
            starts = np.concatenate([starts, self._last[0][None]])
            if values is not None:
                values = np.concatenate([values, self._last[1][None]])
        fits, inside = self._fitted(measurement, starts, values)
        if not (inside & (fits.misfits <= self._limit)).any():
            # Nothing explains it: look everywhere.
            nodes = self.readout.nearest(measurement)
            starts = self._chart.contacts.reshape(-1, 3)[nodes]
            others, there = self._fitted(measurement, starts, None)
            fits = Fits(*(np.concatenate(pair) for pair in zip(fits, others, strict=True)))
            inside = np.concatenate([inside, there])
        good = fits.misfits <= self._limit
        if (inside & good).any():
            return self._chosen(measurement, _those(fits, inside))
        return self._unexplained(measurement, fits, inside, good)

    def _fitted(
        self, measurement: Measurement, starts: Array, values: Array | None
    ) -> tuple[Fits, AnyArray]:
        """Fits from some starts, and which of them are stable contacts on the map."""
        n, chart = len(starts), self._chart
        x = _with_normal_force(starts)
        if values is None:
            values, _ = solve_forces(chart.discretization, x)
        fits = Fits(
            x, np.array(values), np.zeros((n, 6, 4)), np.full(n, np.inf), np.ones(n, np.bool_)
        )
        inside = np.zeros(n, np.bool_)
        readout = self.readout
        explain(
            chart.discretization.rod,
            chart.fold,
            chart.proximal,
            readout.how,
            measurement.target,
            measurement.measured,
            readout.passes,
            self._limit + INDISTINCT,
            fits.contacts,
            fits.values,
            fits.tangents,
            fits.misfits,
            inside,
        )
        return fits, inside

    def _unexplained(
        self, measurement: Measurement, fits: Fits, inside: AnyArray, good: AnyArray
    ) -> Located:
        """The contact that comes nearest, and why none explains the measurement."""
        nearer = charted(self._chart, fits, LEAST_ARC + ROUNDING) & ~inside & good
        status = Status.OUTSIDE_MAP if nearer.any() else Status.NOT_FRICTIONLESS
        if not inside.any():
            return self._nowhere(status)
        best = [int(np.argmin(np.where(inside, fits.misfits, np.inf)))]
        xi, misfit = fits.contacts[best][:, _FREE], float(fits.misfits[best[0]])
        return self._located(measurement, xi, fits.values[best], status, misfit)

    def _chosen(self, measurement: Measurement, fits: Fits) -> Located:
        """The same choice as in a batch, of few fits."""
        misfits = fits.misfits.tolist()
        most = min(min(misfits) + INDISTINCT, self._limit)
        kept: list[int] = []
        order = [0] if len(misfits) == 1 else np.argsort(by_doubt(fits)).tolist()
        for row in order:
            if misfits[row] <= most and not any(
                same(fits.contacts[row], fits.contacts[other]) for other in kept
            ):
                kept.append(row)
        status = Status.UNIQUE if len(kept) == 1 else Status.AMBIGUOUS
        first = kept[0]
        which = slice(first, first + 1) if len(kept) == 1 else kept
        some = Fits(*(part[which] for part in fits))
        return self._located(
            measurement,
            some.contacts[:, _FREE],
            some.values,
            status,
            misfits[kept[0]],
            some.tangents[:, :, _FREE],
        )

    def _set(self, measurement: Measurement, ambiguity: Ambiguity) -> Located:
        """Samples of the curve or surface of contacts that explain fewer than three signals."""
        if self.readout.nothing(measurement):
            return self._nowhere(Status.DEGENERATE)
        found = ambiguity.samples(measurement)
        if not len(found.contacts):
            return self._nowhere(
                Status.OUTSIDE_MAP if self.readout.beyond(measurement) else Status.NOT_FRICTIONLESS
            )
        points = found.values[:, 3:] * self._length
        middle = int(np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
        away = points - points[middle]
        local = found.covariances * self._length**2
        covariance = away.T @ away / len(points) + local.mean(axis=0)
        d = self._chart.discretization
        self._last = None
        return Located(
            points[middle],
            Status.UNDERDETERMINED,
            points,
            found.contacts[:, 0] * self._length,
            covariance if self.noisy else np.full((3, 3), np.nan),
            0.0,
            middle,
            found.values[:, :3] * d.force,
            local if self.noisy else np.full_like(local, np.nan),
            found.contacts[:, 1:] * d.force,
        )

    def _nowhere(self, status: Status, misfit: float = np.nan) -> Located:
        self._last, self._number = None, 0
        none = np.full(3, np.nan)
        return Located(
            none,
            status,
            np.empty((0, 3)),
            np.empty(0),
            np.full((3, 3), np.nan),
            misfit,
            0,
            np.empty((0, 3)),
            np.empty((0, 3, 3)),
            np.empty((0, 3)),
        )

    def _located(
        self,
        measurement: Measurement,
        xi: Array,
        values: Array,
        status: Status,
        misfit: float,
        tangents: Array | None = None,
    ) -> Located:
        """Everything in SI units; remember which candidate goes on from the one before."""
        continuing, self._number = 0, len(xi)
        if self._last is not None and len(xi) > 1:
            away = values[:, 3:] - self._last[1][3:]
            continuing = int((away * away).sum(axis=1).argmin())
        self._last = xi[continuing], values[continuing]
        points = values[:, 3:] * self._length
        covariances = self._covariances(measurement, xi, values, tangents)
        return Located(
            points[0],
            status,
            points,
            xi[:, 0] * self._length,
            covariances[0],
            misfit,
            continuing,
            values[:, :3] * self._chart.discretization.force,
            covariances,
            _with_normal_force(xi)[:, 1:] * self._chart.discretization.force,
        )

    def _covariances(
        self, measurement: Measurement, xi: Array, values: Array, tangents: Array | None
    ) -> Array:
        """Of candidates, m²."""
        n, d = len(xi), self._chart.discretization
        out = np.full((n, 3, 3), np.nan)
        if not self.noisy:
            return out
        if tangents is None:
            tangents = np.empty((n, 6, 3))
            evaluate(d.rod, _with_normal_force(xi), np.empty((n, 6)), tangents, 0, n)
        readout = self.readout
        if not spread(readout.how, measurement.measured, xi, values, tangents, out):
            assert isinstance(readout, Named)
            assert readout.sensor is not None
            out = point_covariances(d, readout.names, xi, readout.sensor)[0]
        return out * self._length**2


def _with_normal_force(xi: Array) -> Array:
    """(s, f_y, f_z) as (s, 0, f_y, f_z), for few rows."""
    out = np.zeros((len(xi), 4))
    out[:, _FREE] = xi
    return out


def _close(a: Array, b: Array) -> bool:
    """Whether two minima are one: where a fold makes them flat, fits end a little apart."""
    force = max(float(np.hypot(a[2], a[3])), float(np.hypot(b[2], b[3])))
    apart = float(np.hypot(a[2] - b[2], a[3] - b[3]))
    return abs(float(a[0] - b[0])) < _FLAT and apart < _FLAT * force


def _those(fits: Fits, rows: AnyArray) -> Fits:
    return fits if rows.all() else Fits(*(part[rows] for part in fits))
